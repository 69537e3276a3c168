"""Contradictions planted into unlit views in known places, and how well the repair's mask finds them."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from benchmarks.two_phase.truth import Painted
from mistyle.core.camera import px_from_world
from mistyle.core.image import dilate_within
from mistyle.core.view import View
from mistyle.stylization.inpaint.repair import radius, struggle_mask
from mistyle.stylization.inpaint.settings import RepairSettings
from mistyle.stylization.optimise.two_phase import Fit

PLACES, RADIUS = 10, 0.13  # discs on the surface, and their radius in working units
SHIFT = 0.12  # share of the view's side by which a planted piece was moved
AGREEMENTS, OUTLIERS = (0.3, 0.5, 0.7, 1.0), (0.0, 3.0, 4.0, 5.0, 6.0)


@dataclass(frozen=True)
class Planted:
    """Views with contradictions; per texture set, the texels of which a changed view says another colour than an
    unchanged one."""

    views: tuple[View, ...]
    where: tuple[Bool[np.ndarray, "h w"], ...]


def clean(scene: Painted, views: Sequence[View]) -> Planted:
    """Nothing planted: all that is found is wrong."""
    return Planted(tuple(views), tuple(np.zeros_like(t.covered) for t in scene.atlas.texels))


def plant(scene: Painted, views: Sequence[View], seed: int) -> Planted:
    """In every other view that sees one of PLACES discs, the disc shows a piece of the same view from elsewhere."""
    rng, texels = np.random.default_rng(seed), scene.atlas.texels
    points = np.concatenate([t.position[t.covered] for t in texels])
    changed = [view.rgb.copy() for view in views]
    counts = [
        np.zeros((2, *t.covered.shape), np.int32) for t in texels
    ]  # unchanged and changed views of a planted texel
    for middle in _apart(points, rng):
        seers = [k for k, view in enumerate(views) if _shows(view, middle)]
        chosen = set(seers[::2])
        angle = rng.uniform(0, 2 * np.pi)
        for k in seers:
            view = views[k]
            inside = view.mask & (np.linalg.norm(_positions(view) - middle, axis=-1) < RADIUS)
            if k in chosen:
                changed[k] = np.where(inside[..., None], _moved(view, angle), changed[k])
            for count, t in zip(counts, texels, strict=True):
                disc = t.covered & (np.linalg.norm(t.position - middle, axis=-1) < RADIUS)
                count[int(k in chosen)][disc] += _seen(view, t.position[disc])
    where = tuple(np.asarray((count > 0).all(axis=0)) for count in counts)
    return Planted(tuple(replace(v, rgb=c.astype(np.float32)) for v, c in zip(views, changed, strict=True)), where)


def found(
    scene: Painted, fit: Fit, seen: Sequence[np.ndarray], planted: Planted, settings: RepairSettings
) -> Float[np.ndarray, "4"]:
    """Areas among the texels that a view sees: of the repair's mask what is right and what is wrong, and of what was
    planted what is masked and all. What lies within the mask's own dilation of a planted texel is right."""
    areas = np.zeros(4)
    for k, (texels, area) in enumerate(zip(scene.atlas.texels, scene.areas, strict=True)):
        looked = seen[k] > 0
        mask = struggle_mask(fit.struggle[k], fit.touched[k], seen[k], texels, settings, fit.agreed[k]) & looked
        near = dilate_within(planted.where[k], texels.island, radius(settings.dilation, len(mask)) + 1)
        at = planted.where[k] & looked
        areas += [float(area[each].sum()) for each in (mask & near, mask & ~near, mask & at, at)]
    return areas


def precision_and_recall(areas: Float[np.ndarray, "4"]) -> dict[str, float]:
    """Of areas as `found` gives them."""
    right, wrong, hit, whole = areas
    return {"precision": right / max(right + wrong, 1e-12), "recall": hit / max(whole, 1e-12)}


def _apart(points: Float[np.ndarray, "n 3"], rng: np.random.Generator) -> list[np.ndarray]:
    """PLACES points whose discs do not meet, as far as there are."""
    chosen: list[np.ndarray] = []
    for k in rng.permutation(len(points)):
        if all(np.linalg.norm(points[k] - other) > 3 * RADIUS for other in chosen):
            chosen.append(points[k])
        if len(chosen) == PLACES:
            break
    return chosen


def _positions(view: View) -> Float[np.ndarray, "h w 3"]:
    from mistyle.core.camera import pixel_centres, world_from_px

    depth = np.where(np.isfinite(view.depth), view.depth, 0).ravel().astype(float)
    return world_from_px(view.camera, pixel_centres(view.camera.size).reshape(-1, 2), depth).reshape(
        *view.depth.shape, 3
    )


def _seen(view: View, points: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
    """Whether the view's depth at a point's pixel is that of the point."""
    px, z = px_from_world(view.camera, points.astype(float))
    height, width = view.camera.size
    column, row = (np.clip(np.floor(px[:, k]).astype(int), 0, limit - 1) for k, limit in ((0, width), (1, height)))
    return np.asarray(np.abs(view.depth[row, column] - z) < 0.03)


def _shows(view: View, middle: Float[np.ndarray, "3"]) -> bool:
    return bool(_seen(view, middle[None])[0])


def _moved(view: View, angle: float) -> Float[np.ndarray, "h w 3"]:
    """The view's colours from SHIFT of its side away; from off the mesh, the colours turned around."""
    by = [round(SHIFT * len(view.mask) * float(part)) for part in (np.sin(angle), np.cos(angle))]
    rgb, there = np.roll(view.rgb, by, axis=(0, 1)), np.roll(view.mask & (view.coverage > 0.999), by, axis=(0, 1))
    return np.where(there[..., None], rgb, view.rgb[..., ::-1])
