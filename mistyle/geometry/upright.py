"""Detection of a mesh with Z up that is read as Y up, from the bases on which it could stand. A form that could stand
on several of its sides, or on none, gives no decision."""

import numpy as np
from jaxtyping import Float, Int

from mistyle.core.rows import distinct_integers
from mistyle.geometry.normals import area_vectors

CONTACT = 0.01  # points this close to the lowest one touch the ground, in shares of the height
LEAST_BASE = 0.15  # a visible base: its hull in shares of the footprint's box
NO_BASE = 0.03
LESSER = 0.25  # a cap, against the base at the other end
TALL = 1.2  # length of the axis over that of the assumed up axis


def standing(positions: Float[np.ndarray, "n 3"], centre: Float[np.ndarray, "3"], axis: int, side: int) -> float:
    """Stability of a form with `side` (+1 or -1) of `axis` below: the hull of its ground contact, in shares of the
    footprint's box 0..1; 0 where `centre` (of mass, about) is not above that hull."""
    from scipy.spatial import ConvexHull

    depth = positions[:, axis] * side
    plane = [k for k in range(3) if k != axis]
    box = np.ptp(positions[:, plane], axis=0)
    below = positions[depth >= depth.max() - CONTACT * np.ptp(depth)][:, plane]
    spread = np.linalg.svd(below - below.mean(axis=0), compute_uv=False) if len(below) > 2 else np.zeros(2)
    if box.min() <= 0 or spread.min() < 1e-3 * box.max():
        return 0.0
    hull = ConvexHull(below)
    inside = (hull.equations[:, :2] @ centre[plane] + hull.equations[:, 2] < 0).all()
    return float(hull.volume / box.prod()) if inside else 0.0  # of a planar hull "volume" is the area


def lies_on_its_side(positions: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]) -> bool:
    """Whether Z clearly points up: the form is tallest along z and stands on its lower z end, far worse on the upper
    one. It falls over on both ends of y and x."""
    weight = np.linalg.norm(area_vectors(positions, faces), axis=1)
    used = positions[distinct_integers(faces[weight > 0])] if (weight > 0).any() else positions[:0]
    if len(used) < 4:
        return False
    size = np.ptp(used, axis=0)
    if size[2] < TALL * size[1] or size[2] < size[0] or size.min() <= 0:
        return False
    centre = (positions[faces].mean(axis=1) * weight[:, None]).sum(axis=0) / weight.sum()
    base = standing(used, centre, 2, -1)
    if base < LEAST_BASE or standing(used, centre, 2, 1) > LESSER * base:
        return False
    return all(standing(used, centre, axis, side) < NO_BASE for axis, side in ((1, -1), (1, 1), (0, -1), (0, 1)))
