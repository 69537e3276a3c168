"""A vase for the notebook: a profile turned about the Y axis, one chart that goes once around, open at both ends."""

import numpy as np

SIDES, RINGS, HEIGHT = 40, 24, 1.6
# Height and radius, from the foot to the lip; a spline runs through them.
PROFILE = [(0.0, 0.30), (0.18, 0.48), (0.42, 0.60), (0.68, 0.40), (0.86, 0.24), (1.0, 0.30)]
FRONT = 0.66  # u of the middle, which looks along +Z


def vase() -> tuple[tuple[np.ndarray, np.ndarray, np.ndarray], np.ndarray]:
    """Vertices (v, 3), faces (f, 3) and unit normals (v, 3); corner UVs (f, 3, 2), v up. The back seam has its
    vertices twice."""
    from scipy.interpolate import CubicSpline

    spline = CubicSpline(*np.array(PROFILE).T, bc_type="natural")
    v, u = np.meshgrid(np.linspace(0, 1, RINGS + 1), np.linspace(0, 1, SIDES + 1), indexing="ij")
    sin, cos = np.sin(2 * np.pi * (u - FRONT)), np.cos(2 * np.pi * (u - FRONT))
    vertices = np.stack([spline(v) * sin, HEIGHT * v, spline(v) * cos], axis=-1).reshape(-1, 3)
    normals = np.stack([HEIGHT * sin, -spline(v, 1), HEIGHT * cos], axis=-1).reshape(-1, 3)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    first = np.arange(v.size).reshape(v.shape)[:-1, :-1].ravel()
    right, above = first + 1, first + SIDES + 1
    faces = np.concatenate([np.stack(c, axis=-1) for c in ((first, right, above + 1), (first, above + 1, above))])
    return (vertices, faces, normals), np.stack([u, v], axis=-1).reshape(-1, 2)[faces]
