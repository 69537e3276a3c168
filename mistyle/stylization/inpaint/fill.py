"""Weight-free texture inpainter: colours of the surface solution if available, else continued from the hole's rim.

It replaces the paper's 4.3 (Stable Diffusion inpainting with ControlNet and IP-Adapter), which needs weights.
"""

from collections.abc import Callable

import cv2
import numpy as np
from jaxtyping import Bool, Float

from mistyle.atlas.gaps import island_boxes, nearest_in_space
from mistyle.core.image import gaussian, nearest
from mistyle.core.maps import Texels
from mistyle.stylization.inpaint.repair import Inpainter

# Standard deviation, as a share of the atlas's side, of the blur that separates smooth colour (continued harmonically)
# from detail (mirrored): about the width of a brush stroke.
DETAIL = 0.01
# Offsets of the mirrored detail beyond the nearest rim texel, as factors of the step from the texel to it.
TURNS = (1, 0.7 + 0.7j, 0.7 - 0.7j, 1j, -1j, 0.5, 0.25, 0.125)
SWEEPS = 12  # Jacobi sweeps on every pyramid level; coarse levels carry colour across holes

# positions (n 3), normals (n 3) in working space -> linear rgb (n 3); not finite where it has no answer
Colours = Callable[[np.ndarray, np.ndarray], np.ndarray]


def inpainter(colours: Colours | None = None) -> Inpainter:
    """An Inpainter that takes `colours` where finite and grows the other texels inside their islands."""

    def paint(albedo: np.ndarray, hole: np.ndarray, texels: Texels, rng: np.random.Generator) -> np.ndarray:
        hole = hole & texels.covered
        if colours is None or not hole.any():
            return grow(albedo, hole, texels)
        answer = np.asarray(colours(texels.position[hole], texels.normal[hole]), np.float32)
        result, left = albedo.copy(), hole.copy()
        finite = np.isfinite(answer).all(axis=1)
        left[hole] = ~finite
        result[hole & ~left] = np.clip(answer[finite], 0, 1)
        return grow(result, left, texels)

    return paint


def from_paint(painted: Float[np.ndarray, "h w 3"]) -> Inpainter:
    """An Inpainter that copies a painting of the whole surface (linear, finite on covered texels)."""

    def paint(albedo: np.ndarray, hole: np.ndarray, texels: Texels, rng: np.random.Generator) -> np.ndarray:
        return np.where((hole & texels.covered)[..., None], painted, albedo)

    return paint


def grow(
    albedo: Float[np.ndarray, "h w 3"], hole: Bool[np.ndarray, "h w"], texels: Texels
) -> Float[np.ndarray, "h w 3"]:
    """Continue every island into its own holes; no colour crosses from one island to another.

    The smooth part of the surrounding colour is continued harmonically (Laplace's equation with no flow through the
    island's border). The detail around the hole is mirrored at the nearest rim texel. An island without known texels
    takes the nearest colours on the surface. Values under the hole are ignored. Content is not modelled: large holes
    look plain, and strokes run back from the rim.
    """
    result = albedo.copy()
    known = texels.covered & ~hole
    if not hole.any() or not known.any():
        return result
    sigma = DETAIL * albedo.shape[1]
    for island, box in island_boxes(texels.island, np.unique(texels.island[hole & texels.covered])):
        own = texels.island[box] == island
        gap, rim = own & hole[box], own & known[box]
        part = result[box]
        if rim.any():
            part[gap] = _grow_island(albedo[box], gap, rim, own, sigma)
        else:
            rows, columns = np.nonzero(gap)
            flat = (rows + box[0].start) * hole.shape[1] + columns + box[1].start
            source = nearest_in_space(known.reshape(-1), texels.position.reshape(-1, 3), flat)
            part[gap] = albedo.reshape(-1, 3)[source]
    return result


def _grow_island(
    colour: Float[np.ndarray, "h w 3"],
    gap: Bool[np.ndarray, "h w"],
    rim: Bool[np.ndarray, "h w"],
    own: Bool[np.ndarray, "h w"],
    sigma: float,
) -> Float[np.ndarray, "n 3"]:
    """Colours for the gap's texels (in row order) from the rest of the island."""
    share = gaussian(rim.astype(np.float32), sigma)
    smooth = gaussian(np.where(rim[..., None], colour, 0), sigma) / np.maximum(share, 1e-6)[..., None]
    smooth = np.where(rim[..., None], smooth, 0).astype(np.float32)
    base = _harmonic(smooth, rim, own)
    row, column = _mirrored(gap, rim)
    return np.clip(base[gap] + colour[row, column] - smooth[row, column], 0, 1)


def _mirrored(gap: Bool[np.ndarray, "h w"], rim: Bool[np.ndarray, "h w"]) -> tuple[np.ndarray, np.ndarray]:
    """For each gap texel the rim texel opposite to it across the nearest rim texel.

    Where the opposite texel is not rim, one beside it at the same distance, else one closer to the nearest. All agree
    with the gap at its border.
    """
    rows, columns = np.nonzero(gap)
    near_row, near_column = np.unravel_index(nearest(rim)[0][gap], gap.shape)
    row, column = near_row.copy(), near_column.copy()
    pending = np.arange(len(rows))
    for turn in TURNS:
        step = ((near_column - columns)[pending] + 1j * (near_row - rows)[pending]) * turn
        r = near_row[pending] + np.round(step.imag).astype(np.int64)
        c = near_column[pending] + np.round(step.real).astype(np.int64)
        inside = (r >= 0) & (c >= 0) & (r < gap.shape[0]) & (c < gap.shape[1])
        valid = inside & rim[np.where(inside, r, 0), np.where(inside, c, 0)]
        row[pending[valid]], column[pending[valid]] = r[valid], c[valid]
        pending = pending[~valid]
    return row, column


def _harmonic(
    values: Float[np.ndarray, "h w 3"], known: Bool[np.ndarray, "h w"], own: Bool[np.ndarray, "h w"]
) -> Float[np.ndarray, "h w 3"]:
    """Values continued into own & ~known, each the mean of its neighbours: coarse to fine, Jacobi sweeps."""
    height, width = known.shape
    if max(height, width) <= 4 or (known | ~own).all():
        start = np.where(known[..., None], values, values[known].mean(axis=0))
    else:
        size = ((width + 1) // 2, (height + 1) // 2)
        weight = cv2.resize(known.astype(np.float32), size, interpolation=cv2.INTER_AREA)
        mean = cv2.resize(values * known[..., None], size, interpolation=cv2.INTER_AREA)
        mean = (mean / np.maximum(weight, 1e-6)[..., None]).astype(np.float32)
        whole = cv2.resize(own.astype(np.float32), size, interpolation=cv2.INTER_AREA)
        coarse = _harmonic(mean, weight > 1e-3, whole > 1e-3)
        start = np.where(known[..., None], values, cv2.resize(coarse, (width, height), interpolation=cv2.INTER_LINEAR))
    share = own.astype(np.float32)[..., None]
    kernel = np.array([[0, 1, 0], [1, 0, 1], [0, 1, 0]], np.float32)
    count = cv2.filter2D(own.astype(np.float32), -1, kernel, borderType=cv2.BORDER_CONSTANT)[..., None]
    free = (own & ~known & (count[..., 0] > 0))[..., None]
    result = start.astype(np.float32)
    for _ in range(SWEEPS):
        total = cv2.filter2D(result * share, -1, kernel, borderType=cv2.BORDER_CONSTANT)
        result = np.where(free, total / np.maximum(count, 1), result)
    return result
