"""Look-dev sheet: an asset on a turntable under fixed light, beside a grey ball, a chrome ball and a ColorChecker in
the same light.

Camera and light are fixed and the asset turns: the light of a picture from azimuth a is the rig rotated by a. Every rig
is one latitude-longitude map, scaled so that the visible half of the 18 % ball has a mean luminance of 0.18.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np
from jaxtyping import Float

from mistyle.core.asset import Asset
from mistyle.core.camera import Camera, look_at, orbit
from mistyle.core.drjit_arrays import aligned
from mistyle.core.image import luminance
from mistyle.core.light import Ambient, Environment, SphericalGaussian, bake_environment, environment_directions
from mistyle.render.lookdev.scenes import asset_scene, asset_shapes, drawn, light_rig
from mistyle.render.mitsuba import device
from mistyle.render.mitsuba.device import mi

GREY = 0.18
FOV = 30.0
# Name -> azimuth, elevation.
CAMERAS = {"front": (0.0, 8.0), "3/4": (35.0, 15.0), "side": (90.0, 8.0), "back": (180.0, 8.0), "top": (0.0, 88.0)}
# The column of references, in units of COLUMN[0] / 100 pixels: balls above, chart below.
COLUMN = (240, 560)
BALLS = {"grey": (-29.0, 76.0), "chrome": (19.0, 76.0)}
BALL_RADIUS = 21.0
CHART_CENTRE, CHART_SIZE, PATCHES = (-5.0, -22.0), (90.0, 135.0), (4, 6)
UNIT = 0.01


@dataclass(frozen=True)
class LightRig:
    """A light of the sheet: its name, the map, and its exposure in stops that brings the grey ball to 0.18."""

    name: str
    light: Environment
    stops: float = 0.0


def rigs(hdri: Float[np.ndarray, "h w 3"] | None, name: str = "", read: Any = None) -> tuple[LightRig, ...]:
    """The three lights of the sheet: soft studio, hard key, and the HDRI (None: a clear sky of ours)."""
    key = (
        SphericalGaussian((-0.5773503, 0.5773503, 0.5773503), 1500.0, (600.0, 580.0, 540.0)),
        Ambient((0.06, 0.065, 0.075)),
    )
    sky = Environment(clear_sky(256) if hdri is None else hdri)
    return (
        LightRig("soft studio", light_rig("studio", read)[0]),  # type: ignore[arg-type]
        LightRig("hard key", Environment(bake_environment(key, 256))),
        LightRig(f"HDRI: {name}" if name else "HDRI: clear sky", sky),
    )


def clear_sky(rows: int) -> Float[np.ndarray, "h w 3"]:
    """A simple procedural clear sky: blue above, pale at the horizon, a warm sun 35 degrees high, brownish ground."""
    towards = environment_directions(rows, 2 * rows)
    up = towards[..., 1:2]
    zenith, horizon, ground = (np.array(c) for c in ((0.10, 0.24, 0.62), (0.75, 0.85, 1.0), (0.16, 0.13, 0.10)))
    sky = horizon + (zenith - horizon) * np.clip(up, 0, 1) ** 0.45
    sun = np.array([0.62, 0.574, 0.534])
    cosine = towards @ (sun / np.linalg.norm(sun))
    warm = np.array([1.0, 0.86, 0.66])
    glow = 1.6 * np.exp(18 * (cosine - 1))[..., None] * warm
    disc = 900.0 * np.exp(2500 * (cosine - 1))[..., None] * warm
    # Half a degree of blending between sky and ground.
    share = np.clip(up / 0.02 + 0.5, 0, 1)
    return (ground + share * (sky + glow + disc - ground)).astype(np.float32)


@cache
def colour_checker() -> Float[np.ndarray, "24 3"]:
    """Linear Rec.709 (D65) of the 24 patches, row by row of the chart held landscape, dark skin first.

    X-Rite's values after November 2014 (colour-science), adapted from their D50 to D65 by Bradford's matrix. Cyan lies
    outside Rec.709: its red is negative, which no reflectance can be; renderers clip it to 0.
    """
    import warnings

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        import colour

        chart = colour.CCS_COLOURCHECKERS["ColorChecker24 - After November 2014"]
        xyz = colour.xyY_to_XYZ(np.array(list(chart.data.values())))
        rgb = colour.XYZ_to_RGB(xyz, "sRGB", illuminant=chart.illuminant, chromatic_adaptation_transform="Bradford")
    return np.asarray(rgb, np.float32)


def chart_texture(side: int = 32, gap: int = 3) -> Float[np.ndarray, "h w 3"]:
    """The chart in portrait (four patches wide, six high: rotated right by 90 degrees), black between the patches."""
    columns, rows = PATCHES
    landscape = np.clip(colour_checker(), 0, 1).reshape(columns, rows, 3)
    upright = np.rot90(landscape, -1)
    picture = np.full((rows * side, columns * side, 3), 0.012, np.float32)
    for row in range(rows):
        for column in range(columns):
            top, left = row * side + gap, column * side + gap
            picture[top : top + side - 2 * gap, left : left + side - 2 * gap] = upright[row, column]
    return picture


def column_camera(scale: float = 1.0) -> Camera:
    """The camera of the references: COLUMN pixels times `scale`, far away, so that balls are round."""
    width, height = (max(1, round(side * scale)) for side in COLUMN)
    distance = 40.0
    across = 100 * UNIT * COLUMN[0] / 240 * 1.2
    fov = float(np.degrees(2 * np.arctan(across / 2 / distance)))
    return look_at((0.0, 0.0, distance), fov=fov, size=(height, width), name="references")


def reference_shapes() -> dict[str, Any]:
    """Mitsuba shapes of the two balls and the chart, in the plane z = 0, facing +Z."""
    device.use()

    def rgb(value: float) -> dict[str, Any]:
        return {"type": "rgb", "value": [value] * 3}

    to = mi.ScalarTransform4f
    shapes: dict[str, Any] = {}
    materials = {
        "grey": {"type": "diffuse", "reflectance": rgb(GREY)},
        "chrome": {"type": "conductor", "material": "none"},
    }
    for name, (x, y) in BALLS.items():
        place = to().translate([x * UNIT, y * UNIT, 0]) @ to().scale(BALL_RADIUS * UNIT)
        shapes[name] = {"type": "sphere", "to_world": place, "bsdf": materials[name]}
    # Mitsuba's texture row 0 is v = 0, the rectangle's lower edge.
    data = mi.TensorXf(aligned(chart_texture()[::-1]))
    texture = {"type": "bitmap", "data": data, "raw": True, "filter_type": "nearest"}
    half = [side * UNIT / 2 for side in CHART_SIZE]
    place = to().translate([CHART_CENTRE[0] * UNIT, CHART_CENTRE[1] * UNIT, 0]) @ to().scale([*half, 1])
    shapes["chart"] = {
        "type": "rectangle",
        "to_world": place,
        "bsdf": {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": texture}},
    }
    return shapes


def references(light: Environment, spp: int, seed: int = 0, scale: float = 1.0) -> Float[np.ndarray, "h w 4"]:
    """The column of references in a light: linear premultiplied Rec.709 and alpha.

    Each is rendered alone, so that none shades or tints another.
    """
    camera, total = column_camera(scale), np.zeros((), np.float32)
    for name, shape in reference_shapes().items():
        total = total + drawn(asset_scene({name: shape}, camera, (light,), "direct"), 0, spp, seed)
    return total


def pixel_of(x: float, y: float, scale: float = 1.0) -> tuple[float, float]:
    """Column and row in the references' picture of a point of their plane (units)."""
    camera = column_camera(scale)
    return camera.centre[0] + camera.focal * x * UNIT / 40.0, camera.centre[1] - camera.focal * y * UNIT / 40.0


def ball_mean(picture: Float[np.ndarray, "h w 4"], name: str, scale: float = 1.0) -> Float[np.ndarray, "3"]:
    """The mean linear colour of a ball's disc, without its rim."""
    centre, radius = pixel_of(*BALLS[name], scale), column_camera(scale).focal * BALL_RADIUS * UNIT / 40.0
    y, x = np.mgrid[: picture.shape[0], : picture.shape[1]] + 0.5
    inside = np.hypot(x - centre[0], y - centre[1]) < 0.95 * radius
    return picture[inside][:, :3].mean(axis=0)


def exposed(rig: LightRig, seed: int = 0) -> LightRig:
    """The rig scaled so that the grey ball's visible half has a mean luminance of 0.18."""
    seen = float(luminance(ball_mean(references(rig.light, 64, seed, 0.5), "grey", 0.5)[None])[0])
    factor = GREY / max(seen, 1e-9)
    light = replace(rig.light, scale=rig.light.scale * factor)
    return LightRig(rig.name, light, float(np.log2(factor)))


class Stage:
    """An asset for rendering under many lights; a class because its shapes are loaded once."""

    def __init__(self, asset: Asset) -> None:
        self.asset, self.shapes = asset, asset_shapes(asset)

    def picture(
        self, azimuth: float, elevation: float, light: Environment, size: int, spp: int, seed: int = 0
    ) -> Float[np.ndarray, "h w 4"]:
        """The asset turned so that `azimuth` faces the camera; linear premultiplied Rec.709 and alpha."""
        camera = asset_camera(azimuth, elevation, size)
        turned = replace(light, turn=light.turn + azimuth)
        return drawn(asset_scene(self.shapes, camera, (turned,), "path"), 0, spp, seed)

    def turn(
        self,
        frames: int,
        light: Environment,
        size: int,
        spp: int,
        seed: int,
        progress: Callable[[float], None],
        of_light: bool = False,
    ) -> list[Float[np.ndarray, "h w 4"]]:
        """The asset, or with `of_light` the light, turned by a full circle; the camera and the other are fixed."""
        (azimuth, elevation), pictures = CAMERAS["3/4"], []
        for angle in (360 * k / frames for k in range(frames)):
            turned = azimuth, elevation, replace(light, turn=light.turn + angle)
            shown = turned if of_light else (azimuth + angle, 12.0, light)
            pictures.append(self.picture(*shown, size, spp, seed))
            progress(len(pictures) / frames)
        return pictures


def asset_camera(azimuth: float, elevation: float, size: int) -> Camera:
    """The camera of the sheet: the asset's bounding sphere (radius 1) fills 93 % of the height."""
    return orbit(azimuth, elevation, distance=1.075 / np.sin(np.radians(FOV / 2)), fov=FOV, size=(size, size))


def over(picture: Float[np.ndarray, "h w 4"], ground: Sequence[float]) -> Float[np.ndarray, "h w 3"]:
    """A premultiplied picture over a linear colour."""
    return (picture[..., :3] + (1 - np.clip(picture[..., 3:], 0, 1)) * np.asarray(ground, np.float32)).astype(
        np.float32
    )
