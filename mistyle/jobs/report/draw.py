"""Pictures of the asset for a report: the turntable, the close-up, and a path-traced close-up.

Turntable and close-up come from the noise-free renderer `render/lookdev/studio.py`. It traces each frame once for all
looks (a look is the asset with one set of maps). The close-up uses the path-traced picture's backdrop.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from mistyle.core.asset import Asset
from mistyle.core.camera import Camera, orbit
from mistyle.core.image import nearest_fill, srgb_from_linear
from mistyle.core.maps import Maps
from mistyle.core.mesh import Mesh
from mistyle.jobs.report.pictures import eight_bit

ELEVATION = 15.0
FIRST = 30.0  # azimuth of the first frame and of the close-up
SKY_TEXELS, SKY_RAYS = 256, 64  # a side of a set, and rays for each
# The path-traced picture: samples per pixel and pass, the mean sRGB error (0..1) that ends it, and its largest number
# of samples as a multiple of `report.spp`.
PASS, GOOD, MOST = 2, 0.6 / 255, 4
PLAIN = 0.18  # radiance behind the close-up without a path-traced picture


@dataclass(frozen=True)
class Drawn:
    """Pictures in sRGB: the turntable (h w 4, 8 bits, straight alpha) and the close-up (h w 3) of each look, and the
    path-traced close-up of the first look, or None."""

    turns: tuple[list[np.ndarray], ...]
    close: tuple[Float[np.ndarray, "h w 3"], ...]
    traced: Float[np.ndarray, "h w 3"] | None


def draw(
    asset: Asset,
    looks: Sequence[Sequence[Maps]],
    settings: Any,
    report: Callable[[float], None],
    *,
    turning: int = 1,
    path_traced: bool = True,
) -> Drawn:
    """Draw the close-up of every look, the turntable of the first `turning` looks, and the path-traced close-up."""
    from mistyle.render.lookdev.studio import Studio, prefiltered
    from mistyle.render.mitsuba.draw import as_fine_as, tracer

    chosen, close = settings.report, close_up(settings)
    fine = [[as_fine_as(m, max(close.size)) for m in look] for look in looks]
    traced = tracer(asset.mesh)
    studio = Studio(traced, prefiltered(studio_light()), sky(asset.mesh, traced, settings.seed), fine)
    del fine
    report(0.1)
    turns: list[list[np.ndarray]] = [[] for _ in range(turning)]
    for k, pictures in enumerate(studio.pictures(cameras(settings), range(turning), chosen.spp)):
        for turn, picture in zip(turns, pictures, strict=True):
            turn.append(eight_bit(shown(picture)))
        report(0.1 + 0.5 * (k + 1) / chosen.frames)
    near = next(studio.pictures([close], range(len(looks)), chosen.spp))
    del studio
    behind, beauty = np.full((*close.size, 3), PLAIN, np.float32), None
    if path_traced:
        beauty, behind = path_trace(asset, looks[0], close, settings, near[0])
    report(1.0)
    return Drawn(
        turns=tuple(turns),
        close=tuple(over(picture, behind) for picture in near),
        traced=None if beauty is None else srgb_from_linear(beauty),
    )


def cameras(settings: Any) -> list[Camera]:
    """The cameras of the turntable."""
    chosen = settings.report
    size = (chosen.resolution, chosen.resolution)
    return [
        orbit(FIRST + 360 * k / chosen.frames, ELEVATION, distance=4, fov=30, size=size) for k in range(chosen.frames)
    ]


def close_up(settings: Any) -> Camera:
    """The camera of the close-up."""
    size = (settings.report.resolution * 2, settings.report.resolution * 2)
    return orbit(FIRST, ELEVATION, distance=4, fov=30, size=size)


def studio_light() -> Float[np.ndarray, "h w 3"]:
    """The softboxes of scenes/studio.xml as an environment map, linear Rec.709."""
    from mistyle.core.paths import scenes
    from mistyle.io.read import read_exr

    planes = read_exr(scenes() / "studio_lights.exr")
    return np.stack([planes[c] for c in "RGB"], axis=-1).astype(np.float32)


def sky(mesh: Mesh, traced: Any, seed: int) -> Any:
    """Sky visibility of every texture set, SKY_TEXELS a side, since it has no finer detail than the mesh."""
    from mistyle.atlas.texels import rasterise
    from mistyle.render.lookdev.studio import StudioSky
    from mistyle.render.mitsuba.occlusion import open_sky

    pages = np.zeros((len(mesh.parts), SKY_TEXELS, SKY_TEXELS, 4), np.float32)
    for part, page in enumerate(pages):
        texels = rasterise(mesh, part, SKY_TEXELS)
        at = texels.covered
        if at.any():
            page[at] = open_sky(traced, texels.position[at], texels.normal[at], rays=SKY_RAYS, seed=seed)
            page[...] = nearest_fill(page, at)
    return StudioSky(SKY_TEXELS, pages)


def path_trace(
    asset: Asset, maps: Sequence[Maps], camera: Camera, settings: Any, guide: Float[np.ndarray, "h w 4"]
) -> tuple[Float[np.ndarray, "h w 3"], Float[np.ndarray, "h w 3"]]:
    """The asset on its backdrop and the backdrop alone, linear; sampling stops at the error GOOD."""
    from mistyle.render.mitsuba.device import give_back
    from mistyle.render.mitsuba.draw import passes
    from mistyle.render.mitsuba.scene import Staging
    from mistyle.render.mitsuba.settle import settled

    most = max(2, settings.report.spp * MOST // PASS)
    drawn = passes(asset.mesh, maps, camera, Staging("studio", PASS, settings.seed))
    beauty, behind, _ = settled(drawn, guide, GOOD, most)
    give_back()
    return beauty, behind


def over(picture: Float[np.ndarray, "h w 4"], behind: Float[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h w 3"]:
    """A premultiplied picture composited over `behind`, sRGB."""
    return srgb_from_linear(np.clip(picture[..., :3] + (1 - picture[..., 3:]) * behind, 0, None))


def shown(picture: np.ndarray) -> np.ndarray:
    """A rendered picture (premultiplied, linear) as straight sRGB and alpha."""
    alpha = np.clip(picture[..., 3:], 0, 1)
    return np.concatenate([srgb_from_linear(picture[..., :3] / np.maximum(alpha, 1e-4)), alpha], axis=-1)
