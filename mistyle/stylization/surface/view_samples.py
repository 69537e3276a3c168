"""Patch synthesis of one view: its pixels are the samples, its known pixels are pinned.

The guides (colours, detail, stroke directions) are computed once on the mesh, so that all views share them. A view is
then painted like a flat sheet: samples lie on the pixel grid. 5x5 neighbourhoods are rotated along the strokes, sampled
from the grid, and never cross a depth step. Strokes have a constant size in the picture, without foreshortening.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from mistyle.core.camera import world_from_px
from mistyle.core.image import distance_to, gaussian, srgb_from_linear
from mistyle.core.view import Prior, View
from mistyle.stylization.surface import kernels, lookup
from mistyle.stylization.surface.exemplar import exemplar as style
from mistyle.stylization.surface.guides.guides import Guide
from mistyle.stylization.surface.samples import CENTRE, GRID, Level, SurfacePoints, as_points, carry, drop, unit
from mistyle.stylization.surface.settings import ResolvedSettings
from mistyle.stylization.surface.synthesis import ColourConstraints, MeshGuides, synthesise

STEEP = 4.0  # depth per width of a surface seen at 76 degrees
LEAST_STEP = 0.05  # depth difference within one surface at any resolution
FEWEST = 16  # least samples of a level
PINNED_SHARE = 0.5  # known share of a cell's foreground from which the cell is pinned
DEPTH_WEIGHT = 0.5  # of depth against the picture plane in the search for a pixel's nearest samples
MARGIN = 12  # finest cells around unknown pixels that are painted with them, as context for their patches
JOIN = (6.0, 1.5)  # pixels over which the painting blends to the prior's colours: tone, then strokes
TOWARDS = np.array([0.0, 0.0, -1.0], np.float32)  # the sheet's normal: to the viewer


@dataclass(frozen=True)
class ViewLevel:
    """One level of a view: its samples as a flat level, in pixels, with each sample's pixel and cell.

    pixel  flat index in the view       cell  flat index in the level's grid of `size` (rows, columns)
    """

    level: Level
    guide: Guide
    pixel: Int[np.ndarray, " n"]
    cell: Int[np.ndarray, " n"]
    size: tuple[int, int]
    side: int


def paint_view(view: View, prior: Prior | None, base: MeshGuides, seed: int) -> Float[np.ndarray, "h w 3"]:
    """Encoded sRGB (0..1) of the view's foreground, zero elsewhere.

    The prior's known colours stay. The rest is painted to continue them, together with a margin of known pixels.
    """
    dj = kernels.module()
    result = np.zeros(view.rgb.shape, np.float32)
    active = view.mask
    if prior is not None:
        active = view.mask & (distance_to(view.mask & ~prior.known) <= MARGIN * finest_side(view, base))
    if not active.any():
        return result if prior is None else joined(result, prior, view.mask)
    views = view_levels(view, active, base)
    constraints = None if prior is None else [constrain(own.cell, own.side, view, prior) for own in views]
    levels, guides = tuple(own.level for own in views), tuple(own.guide for own in views)
    flat = MeshGuides(levels, guides, base.picture, at_same_size(base, views[-1], view))
    field, exemplar = synthesise(flat, seed, dj, constraints=constraints)
    surface = lookup.painted_surface(levels[-1], field, exemplar.size, base.picture.rgb)
    pixels = np.flatnonzero(active)
    positions = flat_positions(view, pixels)
    normals = np.broadcast_to(TOWARDS, positions.shape)
    result.reshape(-1, 3)[pixels] = lookup.colour(surface, positions, normals, footprint=1.0)
    return result if prior is None else joined(result, prior, view.mask)


def footprint(view: View) -> float:
    """Size of a pixel on the surface, at the foreground's median depth."""
    return float(np.median(view.depth[view.mask])) / view.camera.focal


def at_same_size(base: MeshGuides, level: ViewLevel, view: View) -> ResolvedSettings:
    """The settings that give strokes the same size as on the mesh's samples, whose spacing is a fraction of pixels."""
    ratio = level.side * footprint(view) / base.levels[-1].points.spacing
    return base.settings.model_copy(update={"stroke_scale": base.settings.stroke_scale * ratio})


def flat_positions(view: View, pixels: Int[np.ndarray, " n"]) -> Float[np.ndarray, "n 3"]:
    """Pixel centres (x, y) and weighted depth, in pixels, for nearest-sample searches."""
    rows, columns = np.divmod(pixels, view.camera.size[1])
    depth = DEPTH_WEIGHT * view.depth.reshape(-1)[pixels] / footprint(view)
    return np.stack([columns + 0.5, rows + 0.5, depth], axis=1).astype(np.float32)


def finest_side(view: View, base: MeshGuides) -> int:
    """Pixels along a cell of the finest level: about the spacing of the mesh's finest samples."""
    return max(1, round(base.levels[-1].points.spacing / footprint(view)))


def view_levels(view: View, active: Bool[np.ndarray, "h w"], base: MeshGuides) -> list[ViewLevel]:
    """The levels of a view's active pixels, coarse to fine; the cell width halves per level. Levels with fewer than
    FEWEST samples are left out."""
    finest = finest_side(view, base)
    levels = []
    for k, (level, guide) in enumerate(zip(base.levels[::-1], base.guides[::-1], strict=True)):
        own = view_level(view, active, finest * 2**k, level, guide)
        if k > 0 and len(own.pixel) < FEWEST:
            break
        levels.append(own)
    return levels[::-1]


def view_level(view: View, active: Bool[np.ndarray, "h w"], side: int, level: Level, guide: Guide) -> ViewLevel:
    """One level with cells of side x side pixels; a cell's sample is its active pixel nearest to the centre."""
    pixel, cell, size = representatives(active, side)
    camera, width = view.camera, view.camera.size[1]
    px = np.stack([pixel % width, pixel // width], axis=1) + 0.5
    depth = view.depth.reshape(-1)[pixel]
    at = SurfacePoints(
        world_from_px(camera, px, depth.astype(np.float64)).astype(np.float32),
        view.normal.reshape(-1, 3)[pixel],
        level.points.spacing,
        None,
    )
    tangent, length = on_screen(view, px, drop(level.points, level.tangent, at))
    directed = drop(level.points, guide.directed, at) * length
    own = Guide(carry(level.points, guide.colour, at), carry(level.points, guide.detail, at), directed)
    points = as_points(flat_positions(view, pixel), np.broadcast_to(TOWARDS, (len(pixel), 3)), float(side))
    return ViewLevel(
        flat_level(points, tangent, directed, cell, size, depth, camera.focal), own, pixel, cell, size, side
    )


def representatives(
    mask: Bool[np.ndarray, "h w"], side: int
) -> tuple[Int[np.ndarray, " n"], Int[np.ndarray, " n"], tuple[int, int]]:
    """Flat pixel index of the sample and flat cell index, for every cell with foreground; and the grid's size."""
    height, width = mask.shape
    rows, columns = -(-height // side), -(-width // side)
    padded = np.zeros((rows * side, columns * side), bool)
    padded[:height, :width] = mask
    blocks = padded.reshape(rows, side, columns, side).transpose(0, 2, 1, 3).reshape(rows * columns, side * side)
    offset = np.arange(side) - (side - 1) / 2
    nearest_first = np.argsort((offset[:, None] ** 2 + offset**2).ravel(), kind="stable")
    cell = np.flatnonzero(blocks.any(axis=1))
    within = nearest_first[blocks[cell][:, nearest_first].argmax(axis=1)]
    row, column = cell // columns * side + within // side, cell % columns * side + within % side
    return row * width + column, cell, (rows, columns)


def on_screen(
    view: View, px: Float[np.ndarray, "n 2"], tangent: Float[np.ndarray, "n 3"]
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, " n"]]:
    """Tangents projected into the picture, unit, z = 0, and their projected length (1: not foreshortened)."""
    cam = tangent @ view.camera.cam_from_world[:3, :3].T
    ray = (px - np.asarray(view.camera.centre)) / view.camera.focal
    seen = cam[:, :2] - ray * cam[:, 2:]
    length = np.linalg.norm(seen, axis=1)
    straight = np.where(length[:, None] > 1e-3, seen, [[1.0, 0.0]])
    flat = np.concatenate([straight, np.zeros((len(seen), 1))], axis=1)
    return unit(flat).astype(np.float32), np.clip(length, 0, 1).astype(np.float32)


def flat_level(
    points: SurfacePoints,
    tangent: Float[np.ndarray, "n 3"],
    directed: Float[np.ndarray, " n"],
    cell: Int[np.ndarray, " n"],
    size: tuple[int, int],
    depth: Float[np.ndarray, " n"],
    focal: float,
) -> Level:
    """The 5x5 tables from the grid: the sample of the cell whose centre is nearest to a rotated grid position.

    Off the foreground, or behind a depth step, half the distance is tried, then the sample itself.
    """
    rows, columns = size
    number = np.full(rows * columns, -1, np.int32)
    number[cell] = np.arange(len(cell))
    across = np.stack([-tangent[:, 1], tangent[:, 0], tangent[:, 2]], axis=1)
    place = points.positions[:, :2]
    own = np.arange(len(cell), dtype=np.int32)
    neighbours = np.tile(own[:, None], (1, len(GRID)))
    middle = (int(points.spacing) - 1) // 2 + 0.5  # offset of the sample in a full cell
    for k, (dx, dy) in enumerate(GRID):
        if k == CENTRE:
            continue
        for share in (1.0, 0.5):
            pending = np.flatnonzero(neighbours[:, k] == own)
            step = share * points.spacing * (dx * tangent[pending, :2] + dy * across[pending, :2])
            column, row = np.floor((place[pending] + step - middle) / points.spacing + 0.5).astype(np.int64).T
            inside = (row >= 0) & (row < rows) & (column >= 0) & (column < columns)
            candidate = number[np.where(inside, row * columns + column, 0)]
            reach = STEEP * points.spacing * np.hypot(dx, dy) * depth[pending] / focal
            near = np.abs(depth[candidate] - depth[pending]) <= np.maximum(LEAST_STEP, reach)
            valid = inside & (candidate >= 0) & near
            neighbours[pending[valid], k] = candidate[valid]
    offsets = np.empty((*neighbours.shape, 2), np.float32)
    offset = (place[:, None] - place[neighbours]) / np.float32(points.spacing)
    offsets[..., 0] = (offset * tangent[neighbours][..., :2]).sum(axis=2)
    offsets[..., 1] = (offset * across[neighbours][..., :2]).sum(axis=2)
    turned = np.einsum("nc,nkc->nk", tangent, tangent[neighbours]) < 0
    return Level(points, tangent, across, directed, neighbours, turned, np.clip(offsets, -4, 4))


def constrain(cell: Int[np.ndarray, " n"], side: int, view: View, prior: Prior) -> ColourConstraints:
    """The prior's colours in cells of side x side pixels: the sRGB mean of known pixels, from PINNED_SHARE on."""
    known = prior.known & view.mask
    colour = np.where(known[..., None], srgb_from_linear(prior.rgb), 0)
    shares = [_sums(values, side) for values in (known, view.mask)]
    total = _sums(colour, side).reshape(-1, 3)[cell]
    count, whole = (s.reshape(-1)[cell] for s in shares)
    mean = (total / np.maximum(count, 1)[:, None]).astype(np.float32)
    return ColourConstraints(count >= PINNED_SHARE * whole, style.lab_from_srgb(mean[None])[0])


def _sums(values: np.ndarray, side: int) -> np.ndarray:
    """Sums over cells of side x side pixels."""
    height, width = values.shape[:2]
    pad = [(0, -height % side), (0, -width % side)] + [(0, 0)] * (values.ndim - 2)
    padded = np.pad(values.astype(np.float32), pad)
    rows, columns = padded.shape[0] // side, padded.shape[1] // side
    return padded.reshape(rows, side, columns, side, *values.shape[2:]).sum(axis=(1, 3))


def joined(
    painted: Float[np.ndarray, "h w 3"], prior: Prior, mask: Bool[np.ndarray, "h w"]
) -> Float[np.ndarray, "h w 3"]:
    """The prior where known, the painting elsewhere, shifted near the prior by the difference of both."""
    known = prior.known & mask
    if not known.any():
        return painted
    encoded = srgb_from_linear(prior.rgb)
    result = painted
    for reach in JOIN:
        share = gaussian(known.astype(np.float32), reach)[..., None]
        gap = gaussian(np.where(known[..., None], encoded - result, 0), reach) / np.maximum(share, 1e-3)
        result = np.clip(result + np.exp(-distance_to(known) / reach)[..., None] * gap, 0, 1)
    return np.where(mask[..., None], np.where(known[..., None], encoded, result), 0).astype(np.float32)
