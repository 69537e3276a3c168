"""Shading normals for meshes without any, and the identity of vertices at equal positions."""

import numpy as np
from jaxtyping import Bool, Float, Int

from mistyle.core.rows import sums, unit

CREASE_DEGREES = 50.0
# A corner compares every face around its vertex; beyond this many faces (poles, fans) it compares their sum.
MAX_VALENCE = 128
CHUNK = 2_000_000


def same_points(positions: Float[np.ndarray, "v 3"]) -> Int[np.ndarray, " v"]:
    """A number per vertex, equal for vertices at bit-equal positions (0 and -0 are equal), in order of appearance.

    Files split vertices at UV seams; connectivity and smoothing must cross the seams. The mesh itself stays unmerged.
    """
    x, y, z = (positions + 0.0).T
    order = np.lexsort((z, y, x))
    sorted_points = positions[order]
    new = np.ones(len(order), bool)
    new[1:] = (sorted_points[1:] != sorted_points[:-1]).any(axis=1)
    group = np.cumsum(new) - 1
    first = order[new]  # lexsort is stable, so this is each group's first vertex
    rank = np.empty(len(first), np.int64)
    rank[np.argsort(first, kind="stable")] = np.arange(len(first))
    result = np.empty(len(order), np.int64)
    result[order] = rank[group]
    return result


def area_vectors(positions: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]) -> Float[np.ndarray, "f 3"]:
    """Half the cross product of two edges: its length is the face's area, its direction the face's front."""
    a, b, c = (positions[faces[:, k]].astype(np.float64) for k in range(3))
    return np.cross(b - a, c - a) / 2


def crease_normals(
    positions: Float[np.ndarray, "v 3"],
    faces: Int[np.ndarray, "f 3"],
    points: Int[np.ndarray, " v"],
    degrees: float = CREASE_DEGREES,
) -> Float[np.ndarray, "f 3 3"]:
    """Unit normal per face corner: the area-weighted mean over the faces around the point whose own normals lie
    within `degrees` of the corner's face. Corners of degenerate faces take the plain mean around their point, and
    (0, 1, 0) where it vanishes. `points` comes from `same_points`. At points with more than MAX_VALENCE faces the
    mean of all of them decides whether the corner is smooth.
    """
    vectors = area_vectors(positions, faces)
    areas = np.linalg.norm(vectors, axis=1)
    units = vectors / np.where(areas > 0, areas, 1)[:, None]
    corner_point = points[faces.reshape(-1)]
    count = int(corner_point.max(initial=-1)) + 1
    around = sums(corner_point, np.repeat(vectors, 3, axis=0), count)
    valence = np.bincount(corner_point, minlength=count)
    total = around[corner_point]
    limit = np.cos(np.radians(degrees))
    own = np.repeat(units, 3, axis=0)
    sharp = (unit(total) * own).sum(axis=1) < limit
    degenerate = np.repeat(areas == 0, 3)
    result = np.where((sharp & ~degenerate)[:, None], np.repeat(vectors, 3, axis=0), total)
    pairwise = ~degenerate & (valence[corner_point] <= MAX_VALENCE)
    _smooth_pairs(result, np.flatnonzero(pairwise), corner_point, valence, vectors, units, limit)
    normals = unit(result)
    zero = ~normals.any(axis=1)
    normals[zero] = np.where(own[zero].any(axis=1, keepdims=True), own[zero], np.array([0.0, 1.0, 0.0]))
    return normals.reshape(-1, 3, 3).astype(np.float32)


def _smooth_pairs(
    result: Float[np.ndarray, "c 3"],
    corners: Int[np.ndarray, " k"],
    corner_point: Int[np.ndarray, " c"],
    valence: Int[np.ndarray, " p"],
    vectors: Float[np.ndarray, "f 3"],
    units: Float[np.ndarray, "f 3"],
    limit: float,
) -> None:
    """Write into `result`, for each listed corner, the sum over all corners at its point that lie within the crease."""
    by_point = np.argsort(corner_point, kind="stable")
    first = np.concatenate([[0], np.cumsum(valence)])
    sizes = valence[corner_point[corners]]
    ends = np.cumsum(sizes)
    start = 0
    while start < len(corners):
        done = ends[start - 1] if start else 0
        stop = max(start + 1, int(np.searchsorted(ends, done + CHUNK)))
        chosen, n = corners[start:stop], sizes[start:stop]
        row = np.repeat(np.arange(len(chosen)), n)
        step = np.arange(len(row)) - np.repeat(np.cumsum(n) - n, n)
        face = by_point[first[corner_point[chosen]][row] + step] // 3
        near = (units[chosen // 3][row] * units[face]).sum(axis=1) >= limit
        result[chosen] = sums(row[near], vectors[face[near]], len(chosen))
        start = stop


def usable_normals(normals: Float[np.ndarray, "f 3 3"]) -> Bool[np.ndarray, "f 3"]:
    """Mask of corner normals that are finite and long enough for a direction."""
    with np.errstate(over="ignore", invalid="ignore"):
        length = np.linalg.norm(normals.astype(np.float64), axis=2)
    return np.isfinite(length) & (length > 1e-6)
