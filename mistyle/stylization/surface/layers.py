"""Paint layers of an asset: pictures per area, protected areas, content guide, and the painting's relief and gloss.

The paper's 4.2 later refines those maps.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int

from mistyle.atlas.frames import texel_frames
from mistyle.core.asset import Asset, Picture
from mistyle.core.errors import InputRefused, UsageError
from mistyle.core.image import luminance, resize, srgb_from_linear
from mistyle.core.maps import Maps, Texels
from mistyle.core.mesh import Mesh, face_areas
from mistyle.geometry.tangents import corner_tangents
from mistyle.stylization.surface.guides.linefield import DirectionConstraint
from mistyle.stylization.surface.lookup import PaintedSurface
from mistyle.stylization.surface.settings import SurfaceSettings

PICTURE_STROKES = 32  # strokes along a picture's long side, to convert `stroke_size` into a scale
FEW_TEXELS = 200_000  # texels sampled for content or for a painted direction
PLAIN = 0.004  # standard deviation of lightness (0..1) below which an albedo has no content
ROUGHEST, SMOOTHEST = 1.0, 0.08
FLOW_FREE, FLOW_SURE = 0.1, 0.5  # distances from mid grey at which a painted direction has weight 0 and 1


@dataclass(frozen=True)
class StyleLayers:
    """One solution per picture, and per texture set each texel's solution index (0: the job's own style)."""

    solutions: tuple[PaintedSurface, ...]
    choice: tuple[np.ndarray, ...]


def masked_style(style: Picture, mask: Path | None) -> Picture:
    """The style picture, transparent in the dark parts of a mask picture (of any size)."""
    if mask is None:
        return style
    from mistyle.io.read import read_picture

    light = resize(read_picture(mask).rgb.mean(axis=2), style.rgb.shape[:2])
    if not (light > 0.5).any():
        raise InputRefused(f"{mask}: dark everywhere; expected a style mask that is light in the usable parts")
    alpha = np.ones(style.rgb.shape[:2], np.float32) if style.alpha is None else style.alpha
    return replace(style, alpha=(alpha * (light > 0.5)).astype(np.float32))


def scaled(surface: SurfaceSettings, asset: Asset, stroke_size: float | None) -> SurfaceSettings:
    """The settings with the `stroke_scale` that makes a stroke (a 32nd of the picture) `stroke_size` mesh units wide.

    Raises InputRefused where the number of samples cannot resolve it.
    """
    if stroke_size is None:
        return surface
    from mistyle.stylization.surface.samples import YIELD
    from mistyle.stylization.surface.synthesis import finest_size

    area = float(face_areas(asset.mesh).sum())
    spacing = np.sqrt(area / (YIELD * surface.samples))
    per_unit = float(np.cbrt(abs(np.linalg.det(asset.source.work_from_user[:3, :3]))))

    def stroke(scale: float) -> float:
        """Width of a stroke in the mesh's units at a stroke_scale, within the possible range."""
        size = finest_size(surface.model_copy(update={"stroke_scale": scale}))
        return float(size * spacing / PICTURE_STROKES / per_unit)

    scale = stroke_size / stroke(1.0)
    if not (0.1 <= scale <= 10 and np.isclose(stroke(scale), stroke_size, rtol=1e-3)):
        raise UsageError(
            f"strokes of {stroke_size:g} on this mesh would be {scale:.3g} times the usual size; choose from "
            f"{stroke(0.1):.3g} to {stroke(10):.3g} (in the mesh's own units) with {surface.samples} samples"
        )
    return surface.model_copy(update={"stroke_scale": scale})


def slot_masks(
    asset: Asset, texels: Sequence[Texels], slots: Sequence[str]
) -> tuple[list[Path], list[list[Bool[np.ndarray, "h w"]]]]:
    """The pictures of `slots` and, per picture and texture set, the mask of its texels.

    SLOT is a material (all its texels) or a picture in the mesh's UVs (its light texels).
    """
    pictures, masks = [], []
    for slot in slots:
        name, equals, picture = slot.rpartition("=")
        if not equals or not name or not picture:
            raise UsageError(
                f"'{slot}' is not of the form SLOT=PICTURE, for example wood=bark.jpg or mask.png=gold.jpg"
            )
        pictures.append(Path(picture))
        if name in asset.mesh.parts:
            own = zip(asset.mesh.parts, texels, strict=True)
            masks.append([np.full(t.covered.shape, part == name) for part, t in own])
        elif Path(name).is_file():
            masks.append([painted_mask(Path(name), t) for t in texels])
        else:
            raise UsageError(
                f"there is neither a material nor a picture called '{name}'; materials: {', '.join(asset.mesh.parts)}"
            )
    return pictures, masks


def painted_mask(path: Path, texels: Texels) -> Bool[np.ndarray, "h w"]:
    """A picture in the mesh's UVs (row 0 is v = 1) as a mask at the atlas's size: light (and opaque) is True."""
    from mistyle.io.read import read_picture

    mask = read_picture(path)
    light = mask.rgb.mean(axis=2) * (1 if mask.alpha is None else mask.alpha)
    return resize(light.astype(np.float32), texels.covered.shape) > 0.5


def content(texels: Sequence[Texels], start: Sequence[Maps]) -> Callable[[np.ndarray, np.ndarray], np.ndarray] | None:
    """Lightness (encoded luminance, 0..1) of the asset's own albedo at surface points; None for a uniform albedo.

    Uses the nearest of about 200,000 texels of the same side.
    """
    if not any(t.covered.any() for t in texels):
        return None
    near, chosen = nearest_texels(texels)
    own = zip(start, chosen, strict=True)
    light = np.concatenate([srgb_from_linear(luminance(m.albedo.reshape(-1, 3)[few])) for m, few in own])
    return None if light.std() < PLAIN else lambda where, facing: light[near(where, facing)]


def nearest_texels(
    texels: Sequence[Texels],
) -> tuple[Callable[[np.ndarray, np.ndarray], np.ndarray], list[Int[np.ndarray, " n"]]]:
    """About FEW_TEXELS covered texels, as flat indices of each set, and a function to the nearest of them.

    It takes surface points (positions, normals) and returns texels of the same side, counted through all sets.
    """
    from scipy.spatial import KDTree

    counts = np.cumsum([0] + [int(t.covered.sum()) for t in texels])
    every = max(int(counts[-1]) // FEW_TEXELS, 1)
    reach = np.float32(0.02)  # working units per radian between normals
    spans = zip(texels, counts[:-1], counts[1:], strict=True)
    chosen = [np.flatnonzero(t.covered)[int(-first % every) : end - first : every] for t, first, end in spans]
    both = zip(texels, chosen, strict=True)
    parts = [(t.position.reshape(-1, 3)[few], reach * t.normal.reshape(-1, 3)[few]) for t, few in both]
    tree = KDTree(np.concatenate([np.concatenate(part, axis=1) for part in parts]))

    def near(where: np.ndarray, facing: np.ndarray) -> np.ndarray:
        return np.asarray(tree.query(np.concatenate([where, reach * facing], axis=1), workers=-1)[1])

    return near, chosen


def painted_direction(path: Path | None, mesh: Mesh, texels: Sequence[Texels]) -> DirectionConstraint | None:
    """Stroke directions from a picture in the mesh's UVs (row 0 is v = 1).

    Red and green, minus one half, are the direction along u and v. The weight grows with the distance from mid grey
    (full at half of the range) and with opacity. Lines have no sign: opposite colours are equal.
    """
    if path is None:
        return None
    from mistyle.io.read import read_picture

    flow_map = read_picture(path)
    alpha = np.ones(flow_map.rgb.shape[:2], np.float32) if flow_map.alpha is None else flow_map.alpha
    near, chosen = nearest_texels(texels)
    tangents, flows, frames = corner_tangents(mesh), [], []
    for t, few in zip(texels, chosen, strict=True):
        wide = resize(2 * flow_map.rgb[..., :2] - 1, t.covered.shape) * resize(alpha, t.covered.shape)[..., None]
        flows.append(wide.reshape(-1, 2)[few])
        place = t.face.ravel()[few], t.position.reshape(-1, 3)[few], t.normal.reshape(-1, 3)[few]
        frames.append(texel_frames(mesh, *place, tangents)[:, :2])
    flow = np.concatenate(flows)
    length = np.linalg.norm(flow, axis=1)
    counts = np.clip((length - FLOW_FREE) / (FLOW_SURE - FLOW_FREE), 0, 1).astype(np.float32)
    world = np.einsum("tk,tkx->tx", flow, np.concatenate(frames))
    world /= np.maximum(np.linalg.norm(world, axis=1, keepdims=True), 1e-9)
    if not counts.any():
        raise InputRefused(
            f"{path}: mid grey or transparent everywhere; expected stroke directions in red (along u) and green "
            "(along v)"
        )

    def direction(where: np.ndarray, facing: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        index = near(where, facing)
        return world[index], counts[index]

    return direction


@dataclass(frozen=True)
class TexelBand:
    """Selected texels of a band of rows of a texture set; `at` masks them within these rows."""

    texels: Texels
    rows: slice
    at: Bool[np.ndarray, "h w"]


@dataclass(frozen=True)
class PaintRelief:
    """A painting's relief at some texels, in row order.

    gradient  of its height (world, along the surface)
    dull      the paint's offset of the roughness
    """

    gradient: Float[np.ndarray, "t 3"]
    dull: Float[np.ndarray, " t"]


def lay_relief(
    maps: Maps,
    band: TexelBand,
    relief: PaintRelief,
    height: float,
    gloss: float,
    mesh: Mesh,
    tangents: Float[np.ndarray, "f 3 4"],
) -> None:
    """Add the painting's relief to `maps`, in place, for the texels of a band.

    Normals tilt by `height` times the painting's slope; roughness grows by `gloss` times its dullness. The asset's own
    normal map is tilted, not overwritten. `tangents` are `corner_tangents` of the mesh.
    """
    texels, rows, at = band.texels, band.rows, band.at
    normal, roughness = maps.normal[rows], maps.roughness[rows]
    if height > 0:
        place = texels.face[rows][at], texels.position[rows][at], texels.normal[rows][at]
        frames = texel_frames(mesh, *place, tangents)
        world = np.einsum("tk,tkx->tx", normal[at], frames) - np.float32(height) * relief.gradient
        bent = np.einsum("tx,tkx->tk", world, frames)
        bent[:, 2] = np.maximum(bent[:, 2], 0.05)
        normal[at] = bent / np.linalg.norm(bent, axis=1, keepdims=True)
    if gloss > 0:
        roughness[at] = np.clip(roughness[at] + np.float32(gloss) * relief.dull, SMOOTHEST, ROUGHEST)


def protected(maps: Maps, start: Maps, mask: Bool[np.ndarray, "h w"]) -> Maps:
    """The maps with the asset's own values under the mask."""
    masks = {"albedo": mask[..., None], "normal": mask[..., None], "roughness": mask, "metallic": mask}
    return replace(
        maps, **{name: np.where(at, getattr(start, name), getattr(maps, name)) for name, at in masks.items()}
    )
