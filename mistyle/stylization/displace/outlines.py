"""Which outlines of stylized or edited views differ from the mesh's own, and the mesh that follows them (paper 6.2.2).

A view counts only where its coverage differs from the mesh's. A person draws a horn into one view: the other views,
which show the old outline, are no evidence against it.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float

from mistyle.core.asset import Asset
from mistyle.core.image import overlap
from mistyle.core.maps import Maps, flat_maps
from mistyle.core.mesh import Mesh
from mistyle.core.view import View
from mistyle.render.mitsuba.draw import tracer, view_of
from mistyle.render.mitsuba.unlit import unlit
from mistyle.solver.shape.displace import Displaced, TargetOutline, displace
from mistyle.solver.shape.settings import DisplaceSettings

CHANGED = 0.5  # of a pixel's coverage
FEWEST = 6  # pixels of a connected change; fewer are rounding


@dataclass(frozen=True)
class Shape:
    """How the mesh followed the outlines.

    result    the displaced positions and their account; None where every outline agrees with the mesh's
    views     names of the views whose outline differs
    overlap   mean intersection over union of these outlines with the mesh's, before and after
    apart     painted pieces that do not touch the object, which were left out
    """

    result: Displaced | None
    views: tuple[str, ...]
    overlap: tuple[float, float]
    apart: int

    @property
    def changed(self) -> bool:
        """Whether a vertex moved."""
        return self.result is not None and self.result.moved[1] > 0


def follow_outlines(
    mesh: Mesh,
    views: Sequence[View],
    masks: Sequence[Bool[np.ndarray, "h w"]] | None,
    settings: DisplaceSettings,
    report: Callable[[float], None],
) -> Shape:
    """Displace the mesh to the outlines of the views: to their coverage, or to `masks` where a segmenter found them."""
    wanted = [v.coverage for v in views] if masks is None else [mask.astype(np.float32) for mask in masks]
    own, outlines, apart = coverages(mesh, views), [], 0
    for view, coverage, drawn in zip(views, wanted, own, strict=True):
        outline, pieces = outline_of(view, coverage, drawn)
        apart += pieces
        outlines += [] if outline is None else [(outline, drawn)]
    report(0.1)
    names = tuple(outline.camera.name for outline, _ in outlines)
    if not outlines:
        return Shape(None, (), (1.0, 1.0), apart)
    result = displace(mesh, [outline for outline, _ in outlines], settings, lambda done: report(0.1 + 0.85 * done))
    chosen = [view for view in views if view.camera.name in names]
    after = coverages(replace(mesh, positions=result.positions), chosen)
    pairs = [(o.coverage > 0.5, was > 0.5, now > 0.5) for (o, was), now in zip(outlines, after, strict=True)]
    shares = [[overlap(one, other) for one, *both in pairs for other in [both[k]]] for k in (0, 1)]
    return Shape(result, names, (float(np.mean(shares[0])), float(np.mean(shares[1]))), apart)


def outline_of(
    view: View, coverage: Float[np.ndarray, "h w"], drawn: Float[np.ndarray, "h w"]
) -> tuple[TargetOutline | None, int]:
    """The outline that a view asks for, and the count of painted pieces apart from the object; None where the coverage
    agrees with the mesh's own."""
    count, label = cv2.connectedComponents((coverage > 0.5).astype(np.uint8), connectivity=8)
    touching = np.unique(label[(drawn > 0.5) & (label > 0)])
    apart = (label > 0) & ~np.isin(label, touching)
    coverage = np.where(apart, 0, coverage).astype(np.float32)
    changed = (np.abs(coverage - drawn) > CHANGED).astype(np.uint8)
    _, group, stats, _ = cv2.connectedComponentsWithStats(changed, connectivity=8)
    counts = (changed > 0) & (stats[:, cv2.CC_STAT_AREA].take(np.asarray(group, np.int64)) >= FEWEST)
    pieces = count - 1 - len(touching)
    return (TargetOutline(view.camera, coverage, counts) if counts.any() else None), pieces


def coverages(mesh: Mesh, views: Sequence[View]) -> list[Float[np.ndarray, "h w"]]:
    """The mesh's own coverage in every view, by the rays that drew the stylized views."""
    grey = [flat_maps(2)] * len(mesh.parts)
    return [share for _, share in unlit(mesh, grey, [view.camera for view in views])]


def moved_views(asset: Asset, maps: Sequence[Maps], views: Sequence[View], edited: Sequence[str]) -> list[View]:
    """The stylized views on the displaced mesh: geometry traced again, colours drawn from the texture.

    The `edited` views (camera names) keep a person's pixels where the mesh now lies behind them.
    """
    traced, result = tracer(asset.mesh), []
    drawn = unlit(traced, maps, [view.camera for view in views])
    for view, (rgb, share) in zip(views, drawn, strict=True):
        kept = view.coverage > CHANGED if view.camera.name in edited else np.zeros(share.shape, bool)
        own = view.rgb / np.maximum(view.coverage, 1e-3)[..., None] * share[..., None]
        colour = np.where(kept[..., None], own, rgb).astype(np.float32)
        result.append(view_of(traced, view.camera, np.concatenate([colour, share[..., None]], axis=-1)))
    return result
