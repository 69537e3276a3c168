"""Target features of the finish, sampled from the painting at each surface pixel's source place.

A patch of the surface shows pieces of the painting, rotated along the strokes. Its features are compared with those of
the original painting at the same places and rotation. The painting's global statistics would pull every patch towards
the mean of all colours.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from mistyle.core.image import resize
from mistyle.measure.features import Features
from mistyle.stylization.surface.lookup import PaintedSurface
from mistyle.stylization.surface.samples import as_points, lifted, workers

TURNED = 35.0  # largest angle in degrees between a piece of the painting and its nearest quarter-turn page


@dataclass(frozen=True)
class FeatureLevel:
    """One level of the painting's features on four quarter turns, one row per pixel (half precision, torch).

    values  (m, k), page after page, row by row        by  pixels of the painting along a pixel of the level
    starts  first row of each page                     shapes  (rows, columns) of each page
    """

    values: Any
    by: int
    starts: Int[np.ndarray, " 4"]
    shapes: Int[np.ndarray, "4 2"]


@dataclass(frozen=True)
class PaintingFeatures:
    """The painting's features on four quarter turns (page k is np.rot90(picture, k)).

    solution  the painted surface           tree   of its samples, in `lifted` space
    size      (rows, columns) of the unturned painting at the renders' scale
    """

    solution: PaintedSurface
    tree: Any
    size: tuple[int, int]
    levels: tuple[FeatureLevel, ...]


@dataclass(frozen=True)
class Places:
    """Places of n pixels in the painting: page, position on it in pixels (x, y), validity, and the painter's nearest
    sample."""

    page: Int[np.ndarray, " n"]
    at: Float[np.ndarray, "n 2"]
    sure: Bool[np.ndarray, " n"]
    sample: Int[np.ndarray, " n"]


def painting_features(solution: PaintedSurface, pixel: float, features: Features) -> PaintingFeatures:
    """The painting at `pixel` working units a pixel, and its features (half precision)."""
    import torch

    own = solution.spacing / max(solution.scale)
    rows, columns = (max(32, round(side * own / pixel)) for side in solution.painting.shape[:2])
    picture = resize(solution.painting, (rows, columns))
    pages = []
    for turn in range(4):
        page = torch.from_numpy(np.ascontiguousarray(np.rot90(picture, turn).transpose(2, 0, 1)))[None]
        with torch.no_grad():
            pages.append([_thin(maps[0], rows * columns).half() for maps in features(page)])
    tree = as_points(solution.positions, solution.normals, solution.spacing).tree
    levels = tuple(_level(maps, columns) for maps in zip(*pages, strict=True))
    return PaintingFeatures(solution, tree, (rows, columns), levels)


def _level(pages: Sequence[Any], columns: int) -> FeatureLevel:
    """A level from its maps (k, rows, columns) on the four pages."""
    import torch

    shapes = np.array([maps.shape[1:] for maps in pages])
    starts = np.concatenate([[0], np.cumsum(shapes.prod(axis=1))[:3]])
    values = torch.cat([maps.permute(1, 2, 0).flatten(0, 1) for maps in pages])
    return FeatureLevel(values, max(1, round(columns / pages[0].shape[2])), starts, shapes)


def places(
    painting: PaintingFeatures,
    on: Bool[np.ndarray, " n"],
    positions: Float[np.ndarray, "n 3"],
    normals: Float[np.ndarray, "n 3"],
    right: Float[np.ndarray, "n 3"],
    down: Float[np.ndarray, "n 3"],
) -> Places:
    """The painting's places at surface points; `right` and `down` are the axes of each point's camera.

    Pixels that are not `on` the surface have no place: not `sure`. The tree is not asked for them, since points far
    from all samples cost it hundreds of times as much as points among them.
    """
    whole, found = len(on), np.flatnonzero(on)
    positions, normals, right, down = (values[found] for values in (positions, normals, right, down))
    solution = painting.solution
    sample = painting.tree.query(lifted(positions, normals, solution.spacing), workers=workers())[1]
    tangent, turn = solution.tangent[sample], solution.turn[sample]
    across = np.cross(tangent, solution.normals[sample])
    step = positions - solution.positions[sample]
    u, v = ((step * axis).sum(axis=1) for axis in (tangent, across))
    # A step (u, v) on the page turned k times is this step in the picture itself (as in stylization/surface/lookup.py).
    own = np.stack([np.choose(turn, [u, -v, -u, v]), np.choose(turn, [v, u, -v, -u])], axis=1)
    per_unit = np.array(solution.scale, np.float32) / np.float32(solution.spacing)
    shrink = np.array(painting.size[::-1]) / np.array(solution.painting.shape[1::-1])
    x, y = ((solution.centre[sample] + own * per_unit) * shrink).T
    # The page's x axis on the screen selects the quarter turn; the remaining angle is at most TURNED.
    angle = np.degrees(np.arctan2((tangent * down).sum(axis=1), (tangent * right).sum(axis=1)))
    quarter = np.round(angle / 90)
    page = (turn - quarter.astype(np.int64)) % 4
    rows, columns = painting.size
    at = [np.choose(page, [x, y, columns - x, rows - y]), np.choose(page, [y, columns - x, rows - y, x])]
    inside = (x > 0) & (x < columns) & (y > 0) & (y < rows)
    valid = inside & (np.abs(angle - 90 * quarter) < TURNED)

    def spread(values: np.ndarray) -> np.ndarray:
        result = np.zeros((whole, *values.shape[1:]), values.dtype)
        result[found] = values
        return result

    return Places(spread(page), spread(np.stack(at, axis=1).astype(np.float32)), spread(valid), spread(sample))


def target_features(painting: PaintingFeatures, where: Places, crops: int, size: int) -> list[Any]:
    """Per level the painting's features at the places of n square crops, (n, k, rows, columns), torch."""
    import torch

    result = []
    for level in painting.levels:
        by = level.by
        middle = slice(by // 2, None, by)
        page = where.page.reshape(crops, size, size)[:, middle, middle]
        at = (where.at.reshape(crops, size, size, 2)[:, middle, middle] / by).astype(np.int64)
        rows, columns = level.shapes[page, 0], level.shapes[page, 1]
        y, x = np.clip(at[..., 1], 0, rows - 1), np.clip(at[..., 0], 0, columns - 1)
        index = torch.from_numpy(level.starts[page] + y * columns + x)
        values = level.values.index_select(0, index.flatten()).float()
        result.append(values.view(*index.shape, -1).permute(0, 3, 1, 2))
    return result


def _thin(maps: Any, pixels: int) -> Any:
    """Every second row and column of full-size maps: enough for statistics, and these maps take the most memory."""
    return maps[:, ::2, ::2] if maps[0].numel() == pixels else maps
