"""Parsing of numbers, triangulation of polygons, and checks of parsed meshes."""

from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from mistyle.core.rows import sums
from mistyle.io.sandbox.bounds import refuse

MAX_EARS = 500
MAX_COORDINATE = 1e18


def parse_numbers(text: bytes, path: Path, label: str) -> Float[np.ndarray, " n"]:
    """All numbers of a text separated by white space; refuses all other tokens."""
    tokens = text.split()
    try:
        return np.array(tokens, dtype=np.bytes_).astype(np.float64) if tokens else np.zeros(0)
    except ValueError as error:
        bad = next((t for t in tokens if not _is_number(t)), b"")
        raise refuse(
            path, f"{bad[:40].decode('ascii', 'replace')!r} among {label}", "a number", "Export the mesh again"
        ) from error


def _is_number(token: bytes) -> bool:
    try:
        float(token)
        return True
    except ValueError:
        return False


def fan(sizes: Int[np.ndarray, " p"]) -> Int[np.ndarray, "t 3"]:
    """Corner indices of the triangles of polygons with `sizes` corners, in order. Each polygon is a fan around its
    first corner (right for convex polygons). Corners are numbered across all polygons.
    Polygons with fewer than three corners give no triangle."""
    first = np.cumsum(sizes) - sizes
    count = np.maximum(sizes - 2, 0)
    start = np.repeat(first, count)
    step = np.arange(len(start)) - np.repeat(np.cumsum(count) - count, count)
    return np.stack([start, start + step + 1, start + step + 2], axis=1)


def triangulate(sizes: Int[np.ndarray, " p"], corners: Float[np.ndarray, "c 3"]) -> Int[np.ndarray, "t 3"]:
    """As `fan`, but concave polygons are cut into ears, so that their triangles neither overlap nor leave the polygon.

    `corners` holds the position of every polygon corner. Polygons of more than MAX_EARS corners, and those that cross
    themselves, stay fans.
    """
    triangles = fan(sizes)
    first_triangle = np.cumsum(np.maximum(sizes - 2, 0)) - np.maximum(sizes - 2, 0)
    first_corner = np.cumsum(sizes) - sizes
    for p in _concave(sizes, corners):
        if sizes[p] <= MAX_EARS:
            start, count = first_corner[p], sizes[p]
            ears = _ears(_flattened(corners[start : start + count]))
            if ears is not None:
                triangles[first_triangle[p] : first_triangle[p] + count - 2] = start + ears
    return triangles


def _concave(sizes: Int[np.ndarray, " p"], corners: Float[np.ndarray, "c 3"]) -> Int[np.ndarray, " k"]:
    """Polygons of four and more corners with a reflex corner (against their Newell normal)."""
    first = np.repeat(np.cumsum(sizes) - sizes, sizes)
    size = np.repeat(sizes, sizes)
    step = np.arange(len(first)) - first
    corner, after, before = corners, corners[first + (step + 1) % size], corners[first + (step - 1) % size]
    polygon = np.repeat(np.arange(len(sizes)), sizes)
    around = np.cross(corner - corners[first], after - corners[first])
    normal = sums(polygon, around, len(sizes))
    turn = (np.cross(corner - before, after - corner) * normal[polygon]).sum(axis=1)
    scale = (normal**2).sum(axis=1)[polygon]
    return np.unique(polygon[(turn < -1e-9 * scale) & (size > 3)])


def _flattened(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 2"]:
    """A polygon projected to a coordinate plane, counter-clockwise."""
    away = points - points[0]
    normal = np.cross(away, np.roll(away, -1, axis=0)).sum(axis=0)
    drop = int(np.abs(normal).argmax())
    plane = np.delete(points, drop, axis=1)
    return plane if (normal[drop] > 0) == (drop != 1) else plane[:, ::-1]


def _ears(points: Float[np.ndarray, "n 2"]) -> Int[np.ndarray, "t 3"] | None:
    """Ear clipping (Meisters 1975) of a counter-clockwise polygon; None where no ear is left (it crosses itself)."""
    rest = list(range(len(points)))
    ears = []
    while len(rest) > 3:
        for k in range(len(rest)):
            a, b, c = (points[rest[(k + d) % len(rest)]] for d in (-1, 0, 1))
            if _turn(a, b, c) <= 0:
                continue
            others = points[[i for d, i in enumerate(rest) if (d - k + 1) % len(rest) > 2]]
            inside = (_turn(a, b, others) >= 0) & (_turn(b, c, others) >= 0) & (_turn(c, a, others) >= 0)
            at_corner = (others[:, None] == np.stack([a, b, c])).all(axis=2).any(axis=1)
            if not (inside & ~at_corner).any():
                ears.append((rest[k - 1], rest[k], rest[(k + 1) % len(rest)]))
                del rest[k]
                break
        else:
            return None
    return np.array([*ears, tuple(rest)])


def _turn(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray | np.float64:
    """Twice the signed area of a, b, c; c may be many points."""
    return (b[0] - a[0]) * (c[..., 1] - a[1]) - (b[1] - a[1]) * (c[..., 0] - a[0])


def check_indices(index: Int[np.ndarray, "..."], count: int, path: Path, label: str) -> None:
    """Refuse indices outside 0..count-1."""
    if index.size and (index.min() < 0 or index.max() >= count):
        bad = int(index.max() if index.max() >= count else index.min())
        raise refuse(path, f"a face that uses {label} {bad}", f"0 to {count - 1}", "Export the mesh again")


def check_positions(positions: Float[np.ndarray, "v 3"], path: Path) -> None:
    """Refuse positions that are not finite or beyond MAX_COORDINATE."""
    finite = np.isfinite(positions)
    if not finite.all():
        found = f"a position that is not finite (vertex {int(np.flatnonzero(~finite.all(axis=1))[0])})"
        raise refuse(path, found, "finite numbers", "Repair the mesh or export it again")
    if np.abs(positions).max(initial=0) > MAX_COORDINATE:
        found = f"coordinates up to {np.abs(positions).max():.1e}"
        raise refuse(path, found, f"at most {MAX_COORDINATE:.0e}", "Scale the mesh")


def too_many(count: int, limit: int, path: Path, label: str = "faces") -> None:
    """Refuse more than `limit` elements."""
    if count > limit:
        fix = "Simplify the mesh (Blender: Decimate), or raise --max-faces"
        raise refuse(path, f"{count} {label}", f"at most {limit}", fix)
