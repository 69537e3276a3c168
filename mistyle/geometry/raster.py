"""Watertight scan conversion of UV triangles to texel centres, in numpy."""

from collections.abc import Iterator

import numpy as np
from jaxtyping import Float, Int

CHUNK = 4_000_000


def fragments(
    uv: Float[np.ndarray, "f 3 2"], size: int, *, wrap: bool = True
) -> tuple[Int[np.ndarray, " n"], Int[np.ndarray, " n"]]:
    """Face and texel (row * size + column) of every texel centre inside a triangle, in face order.

    `uv` is in texels: x to the right, y up or down as the caller chooses (rows follow y). Centres lie at +0.5. A centre
    on an edge belongs to one of the two triangles that share the edge, never to both or neither. With `wrap`,
    coordinates are taken modulo `size`; otherwise fragments outside are dropped.
    """
    pieces = list(fragment_pieces(uv, size, wrap=wrap))
    if not pieces:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    return np.concatenate([face for face, _ in pieces]), np.concatenate([texel for _, texel in pieces])


def fragment_pieces(
    uv: Float[np.ndarray, "f 3 2"], size: int, *, wrap: bool = True
) -> Iterator[tuple[Int[np.ndarray, " n"], Int[np.ndarray, " n"]]]:
    """`fragments` in pieces, to bound the memory for a large atlas."""
    for face, column, row in _pieces(uv):
        if wrap:
            column, row = column % size, row % size
        else:
            inside = (column >= 0) & (column < size) & (row >= 0) & (row < size)
            face, column, row = face[inside], column[inside], row[inside]
        yield face, row * size + column


def _pieces(uv: Float[np.ndarray, "f 3 2"]) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Face, column and row of the covered centres, at most about CHUNK at a time (one face may exceed it)."""
    y = uv[:, :, 1]
    first = np.ceil(y.min(axis=1) - 0.5).astype(np.int64)
    rows = np.ceil(y.max(axis=1) - 0.5).astype(np.int64) - first
    width = np.ptp(uv[:, :, 0], axis=1) + 1
    work = np.cumsum(rows * np.ceil(width).astype(np.int64) + 1)
    start = 0
    while start < len(uv):
        done = work[start - 1] if start else 0
        stop = max(start + 1, int(np.searchsorted(work, done + CHUNK)))
        part = slice(start, stop)
        span_face = np.repeat(np.arange(start, stop), rows[part])
        step = np.arange(len(span_face)) - np.repeat(np.cumsum(rows[part]) - rows[part], rows[part])
        span_row = first[span_face] + step
        left, count = _spans(uv[span_face], span_row + 0.5)
        which = np.repeat(np.arange(len(left)), count)
        column = left[which] + np.arange(len(which)) - np.repeat(np.cumsum(count) - count, count)
        yield span_face[which], column, span_row[which]
        start = stop


def _spans(corners: Float[np.ndarray, "s 3 2"], y: Float[np.ndarray, " s"]) -> tuple[np.ndarray, np.ndarray]:
    """First column and number of columns whose centres lie inside each triangle at height y.

    Each edge is evaluated from its lower end, so that both of its triangles compute the same crossing.
    """
    left, right = np.full(len(y), np.inf), np.full(len(y), -np.inf)
    for k in range(3):
        p, q = corners[:, k], corners[:, (k + 1) % 3]
        swap = (p[:, 1] > q[:, 1])[:, None]
        low, high = np.where(swap, q, p), np.where(swap, p, q)
        crossed = (low[:, 1] <= y) & (y < high[:, 1])
        rise = np.where(crossed, high[:, 1] - low[:, 1], 1)
        x = low[:, 0] + (y - low[:, 1]) * (high[:, 0] - low[:, 0]) / rise
        left = np.where(crossed, np.minimum(left, x), left)
        right = np.where(crossed, np.maximum(right, x), right)
    empty = ~np.isfinite(left)
    first = np.ceil(np.where(empty, 0, left) - 0.5).astype(np.int64)
    last = np.ceil(np.where(empty, 0, right) - 0.5).astype(np.int64)
    return first, np.maximum(last - first, 0)
