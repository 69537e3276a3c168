"""Intersections of a mesh's triangles with one another, exhaustive within a broad phase of sorted boxes."""

from collections.abc import Iterator

import numpy as np
from jaxtyping import Bool, Float, Int

CHUNK = 1_000_000  # candidate pairs at a time
INSIDE = 1e-9  # relative margin of the signed volumes: an edge that only touches a plane does not cross it


def self_intersections(
    points: Float[np.ndarray, "n 3"],
    faces: Int[np.ndarray, "f 3"],
    chosen: Bool[np.ndarray, " f"] | None = None,
) -> Int[np.ndarray, "k 2"]:
    """Pairs (a < b) of faces that intersect, sorted; with `chosen`, only pairs with a chosen face.

    `points` are welded: equal places have equal indices. Pairs that share an edge are left out: they meet there, and
    fold only where a normal turns over. Pairs that share one point intersect where the edge opposite it passes through
    the other face. Coplanar overlaps are not found. An edge passes through a triangle if its ends lie strictly on
    different sides of the plane and no edge of the triangle sees it with another orientation (signed volumes): an edge
    through an edge counts.
    """
    found, near = [np.zeros((0, 2), np.int64)], np.arange(len(faces))
    if chosen is not None:
        if not chosen.any():
            return found[0]
        low, high = points[faces].min(axis=1), points[faces].max(axis=1)
        least, most = low[chosen].min(axis=0), high[chosen].max(axis=0)
        near = np.flatnonzero(((low <= most) & (high >= least)).all(axis=1))
    for a, b in _candidates(points, faces[near], None if chosen is None else chosen[near]):
        a, b = near[a], near[b]
        shared = (faces[a][:, :, None] == faces[b][:, None, :]).any(axis=2)
        few = shared.sum(axis=1) < 2
        a, b = a[few], b[few]
        crossing = _pierces(points, faces, a, b) | _pierces(points, faces, b, a)
        found.append(np.stack([a, b], axis=1)[crossing])
    pairs = np.sort(np.concatenate(found), axis=1)
    return np.unique(pairs, axis=0)


def _candidates(
    points: Float[np.ndarray, "n 3"], faces: Int[np.ndarray, "f 3"], chosen: Bool[np.ndarray, " f"] | None
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Pairs of faces whose boxes overlap, each once.

    Boxes are sorted by their low end along x. Later boxes that begin before a box ends are its candidates; grid rows
    along y keep them few.
    """
    corners = points[faces]
    low, high = corners.min(axis=1), corners.max(axis=1)
    cell = max(float(np.mean(high[:, 1] - low[:, 1])) * 2, 1e-12)
    first = np.floor((low[:, 1] - points[:, 1].min()) / cell).astype(np.int64)
    rows = np.floor((high[:, 1] - points[:, 1].min()) / cell).astype(np.int64) - first + 1
    face = np.repeat(np.arange(len(faces)), rows)
    row = first[face] + np.arange(len(face)) - np.repeat(np.cumsum(rows) - rows, rows)
    order = np.lexsort((low[face, 0], row))
    face, row = face[order], row[order]
    # One key for row and place: boxes of one row are neighbours, sorted by their low ends.
    span = float(np.ptp(points[:, 0])) + 1.0
    start = row * span + (low[face, 0] - points[:, 0].min())
    stop = np.searchsorted(start, row * span + (high[face, 0] - points[:, 0].min()), side="right")
    count = stop - np.arange(len(face)) - 1
    begin = 0
    ends = np.cumsum(count)
    while begin < len(face):
        done = ends[begin - 1] if begin else 0
        end = max(begin + 1, int(np.searchsorted(ends, done + CHUNK)))
        n = count[begin:end]
        one = np.repeat(np.arange(begin, end), n)
        other = one + 1 + np.arange(len(one)) - np.repeat(np.cumsum(n) - n, n)
        a, b = face[one], face[other]
        # A pair that shares several rows counts in the first of them.
        apart = ((low[a] > high[b]) | (low[b] > high[a])).any(axis=1)
        keep = ~apart & (row[one] == np.maximum(first[a], first[b])) & (a != b)
        if chosen is not None:
            keep &= chosen[a] | chosen[b]
        yield a[keep], b[keep]
        begin = end


def _pierces(
    points: Float[np.ndarray, "n 3"], faces: Int[np.ndarray, "f 3"], a: Int[np.ndarray, " k"], b: Int[np.ndarray, " k"]
) -> Bool[np.ndarray, " k"]:
    """Whether an edge of face a that has no point in common with face b passes through face b."""
    result = np.zeros(len(a), bool)
    p, q, r = (points[faces[b, k]] for k in range(3))
    size = np.linalg.norm(np.cross(q - p, r - p), axis=1)
    for k in range(3):
        i, j = faces[a, k], faces[a, (k + 1) % 3]
        apart = (faces[b] != i[:, None]).all(axis=1) & (faces[b] != j[:, None]).all(axis=1)
        s, t = points[i], points[j]
        limit = INSIDE * size * (np.linalg.norm(t - s, axis=1) + np.sqrt(size))
        above, below = _volume(p, q, r, s), _volume(p, q, r, t)
        crosses = (np.minimum(above, below) < -limit) & (np.maximum(above, below) > limit)
        sides = np.stack([_volume(s, t, p, q), _volume(s, t, q, r), _volume(s, t, r, p)], axis=1)
        inside = (sides >= -limit[:, None]).all(axis=1) | (sides <= limit[:, None]).all(axis=1)
        result |= apart & crosses & inside
    return result


def _volume(a: np.ndarray, b: np.ndarray, c: np.ndarray, d: np.ndarray) -> np.ndarray:
    """Six times the signed volume of tetrahedra, (k)."""
    return np.einsum("ki,ki->k", np.cross(b - a, c - a), d - a)
