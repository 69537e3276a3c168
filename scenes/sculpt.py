"""Sculpting by signed distances: primitives, smooth unions, and the way from a distance function to triangles.

A shape is a function from points (n, 3) to distances (n,), negative inside. The blends are Quilez' polynomial smooth
minimum (quadratic, blending width k), whose result is a lower bound of the distance and smooth enough to polygonise.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter, map_coordinates, spline_filter, zoom
from scipy.spatial import cKDTree

Shape = Callable[[np.ndarray], np.ndarray]


def blend(a: np.ndarray, b: np.ndarray, k: float) -> np.ndarray:
    """Smooth union: min(a, b) with a fillet of width k."""
    h = np.maximum(k - np.abs(a - b), 0) / k
    return np.minimum(a, b) - h * h * k / 4


def carve(a: np.ndarray, b: np.ndarray, k: float) -> np.ndarray:
    """Smooth difference: a without b, with a rounded rim of width k."""
    return -blend(-a, b, k)


def meet(a: np.ndarray, b: np.ndarray, k: float) -> np.ndarray:
    """Smooth intersection."""
    return -blend(-a, -b, k)


def turn(x: float = 0, y: float = 0, z: float = 0) -> np.ndarray:
    """Rotation matrix, degrees: about X, then Y, then Z."""
    a, b, c = np.radians([x, y, z])
    rx = np.array([[1, 0, 0], [0, np.cos(a), -np.sin(a)], [0, np.sin(a), np.cos(a)]])
    ry = np.array([[np.cos(b), 0, np.sin(b)], [0, 1, 0], [-np.sin(b), 0, np.cos(b)]])
    rz = np.array([[np.cos(c), -np.sin(c), 0], [np.sin(c), np.cos(c), 0], [0, 0, 1]])
    return rz @ ry @ rx


def local(p: np.ndarray, centre, rotation: np.ndarray | None = None) -> np.ndarray:
    """Points in the frame of something that stands at `centre`, turned by `rotation`."""
    q = p - np.asarray(centre, p.dtype)
    return q if rotation is None else q @ rotation.astype(p.dtype)


def mirrored(p: np.ndarray) -> np.ndarray:
    """Both sides of the plane x = 0 as the side x > 0."""
    return np.concatenate([np.abs(p[:, :1]), p[:, 1:]], axis=1)


def near(p: np.ndarray, centre, radius: float, part: Shape) -> np.ndarray:
    """`part` where it matters: it lies inside the ball, and far from the ball the distance to the ball is answered."""
    far = np.linalg.norm(p - np.asarray(centre, p.dtype), axis=1) - radius
    close = far < 0.15
    far[close] = part(p[close])
    return far


def ellipsoid(p: np.ndarray, centre, radii, rotation: np.ndarray | None = None) -> np.ndarray:
    """Distance to an ellipsoid, first order: exact on the surface, sign right everywhere."""
    q = local(p, centre, rotation)
    r = np.asarray(radii, p.dtype)
    k0 = np.linalg.norm(q / r, axis=1)
    k1 = np.linalg.norm(q / (r * r), axis=1)
    return np.where(k1 > 1e-9, k0 * (k0 - 1) / np.maximum(k1, 1e-9), -r.min())


def spline(knots, samples: int = 400) -> np.ndarray:
    """Uniform Catmull-Rom curve through `knots` (k, d), as (samples, d) points evenly spaced by parameter."""
    knots = np.asarray(knots, float)
    ends = np.vstack([2 * knots[0] - knots[1], knots, 2 * knots[-1] - knots[-2]])
    t = np.linspace(0, len(knots) - 1 - 1e-9, samples)
    i, f = t.astype(int), (t % 1)[:, None]
    a, b, c, d = (ends[i + j] for j in range(4))
    return 0.5 * (2 * b + (c - a) * f + (2 * a - 5 * b + 4 * c - d) * f**2 + (3 * b - a - 3 * c + d) * f**3)


def tube(knots, *, rings: Callable[[np.ndarray], np.ndarray] | None = None) -> Shape:
    """A tube along a Catmull-Rom curve; knots are (x, y, z, radius), `rings` (of arc length) is added to the radius."""
    curve = spline(knots)
    tree = cKDTree(curve[:, :3])
    arc = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(curve[:, :3], axis=0), axis=1))])

    def distance(p: np.ndarray) -> np.ndarray:
        _, i = tree.query(p, workers=1)
        # The nearest sample is refined to the nearest point of the two segments that meet there.
        best = np.full(len(p), np.inf)
        for step in (-1, 0):
            j = np.clip(i + step, 0, len(curve) - 2)
            a, ab = curve[j], curve[j + 1] - curve[j]
            t = np.clip(((p - a[:, :3]) * ab[:, :3]).sum(1) / np.maximum((ab[:, :3] ** 2).sum(1), 1e-12), 0, 1)
            point = a + ab * t[:, None]
            radius = point[:, 3]
            if rings is not None:
                radius = radius + rings(arc[j] + (arc[j + 1] - arc[j]) * t)
            best = np.minimum(best, np.linalg.norm(p - point[:, :3], axis=1) - radius)
        return best

    return distance


def polygon(q: np.ndarray, outline: np.ndarray) -> np.ndarray:
    """Signed distance (n,) of planar points to a closed polygon (m, 2)."""
    best = np.full(len(q), np.inf)
    inside = np.zeros(len(q), bool)
    for a, b in zip(outline, np.roll(outline, -1, axis=0), strict=True):
        ab = b - a
        t = np.clip((q - a) @ ab / (ab @ ab), 0, 1)
        best = np.minimum(best, np.linalg.norm(q - a - t[:, None] * ab, axis=1))
        crosses = (a[1] > q[:, 1]) != (b[1] > q[:, 1])
        with np.errstate(divide="ignore", invalid="ignore"):
            x = a[0] + (q[:, 1] - a[1]) / (b[1] - a[1]) * ab[0]
        inside ^= crosses & (q[:, 0] < x)
    return np.where(inside, -best, best)


def closed_curve(knots, samples: int = 72) -> np.ndarray:
    """Closed Catmull-Rom outline through `knots` (k, 2) as a polygon (samples, 2)."""
    knots = np.asarray(knots, float)
    wrapped = np.vstack([knots[-2:], knots, knots[:3]])
    curve = spline(wrapped, 40 * (len(wrapped) - 1) + 1)
    inner = curve[80 : 80 + 40 * len(knots)]
    return inner[:: max(1, len(inner) // samples)]


@dataclass(frozen=True)
class Clay:
    """A shape sampled on a grid and softened: what marching cubes and the later polish of the vertices both read."""

    field: np.ndarray
    low: np.ndarray
    cell: float

    def __call__(self, p: np.ndarray) -> np.ndarray:
        """Cubic interpolation of the distance at points (n, 3)."""
        return map_coordinates(self.field, ((p - self.low) / self.cell).T, order=3, mode="nearest", prefilter=False)

    def polygonise(self) -> tuple[np.ndarray, np.ndarray]:
        """Marching cubes (Lewiner): vertices (v, 3), counter-clockwise faces (f, 3)."""
        from skimage.measure import marching_cubes

        every = np.indices(self.field.shape).reshape(3, -1)
        grid = map_coordinates(self.field, every, order=3, mode="nearest", prefilter=False)
        vertices, faces, _, _ = marching_cubes(grid.reshape(self.field.shape), 0.0, spacing=(self.cell,) * 3)
        return vertices + self.low, faces.astype(np.int64)


def sample(shape: Shape, low, high, cell: float, soften: float) -> Clay:
    """Sample `shape` in the box low..high, finely near its surface only, and blur by `soften` cells against cusps."""
    low, coarse = np.asarray(low, float), 4
    counts = np.ceil((np.asarray(high) - low) / (cell * coarse)).astype(int) + 1

    def points(index: np.ndarray, step: float) -> np.ndarray:
        return low + step * index

    rough = shape(points(np.indices(counts).reshape(3, -1).T, cell * coarse)).reshape(counts)
    fine_counts = (counts - 1) * coarse + 1
    fine = zoom(rough, fine_counts / counts, order=1, grid_mode=False)
    close = np.flatnonzero(np.abs(fine.ravel()) < 3.0 * cell * coarse)
    index = np.stack(np.unravel_index(close, fine_counts), axis=1)
    flat = fine.reshape(-1)
    for start in range(0, len(close), 400_000):
        flat[close[start : start + 400_000]] = shape(points(index[start : start + 400_000], cell))
    soft = gaussian_filter(flat.reshape(fine_counts), soften)
    return Clay(spline_filter(soft, order=3), low, cell)


def gradient(shape: Shape, p: np.ndarray, step: float) -> np.ndarray:
    """Central differences of the distance: (n, 3), not normalised."""
    return np.stack([(shape(p + step * e) - shape(p - step * e)) / (2 * step) for e in np.eye(3)], axis=1)


def settle(shape: Shape, p: np.ndarray, step: float, rounds: int = 2) -> np.ndarray:
    """Move vertices onto shape = 0 by Newton steps along the gradient, at most `step` each."""
    for _ in range(rounds):
        g = gradient(shape, p, step / 2)
        move = -shape(p)[:, None] * g / np.maximum((g * g).sum(1, keepdims=True), 0.1)
        length = np.linalg.norm(move, axis=1, keepdims=True)
        p = p + move * np.minimum(1, step / np.maximum(length, 1e-12))
    return p
