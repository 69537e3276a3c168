"""Outlines as points: the contours of a view's coverage, and the mesh's own silhouette with its derivative.

A silhouette edge lies between a face towards the camera and one away from it, or at a boundary. Its points on the
picture's outline (the mesh ends beside them) move with the two ends of the edge. That is the derivative of the outline
without any sampling noise; `projective.py` is its independent twin.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from mistyle.core.camera import Camera, px_by_cam, px_from_world
from mistyle.core.image import bilinear, gaussian
from mistyle.geometry.normals import area_vectors
from mistyle.solver.shape.surface import WeldedSurface

BLUR = 0.7  # pixels of smoothing before the contour: hard masks lose their stairs
STEP = 1.0  # pixels between silhouette points
BESIDE = 1.0  # pixels outside a silhouette point where the mesh must have ended


@dataclass(frozen=True)
class Contour:
    """Points of a coverage's contour at one half (x, y in pixels), and their unit normals out of the object."""

    points: Float[np.ndarray, "k 2"]
    normals: Float[np.ndarray, "k 2"]


@dataclass(frozen=True)
class Silhouette:
    """The mesh's outline in one view.

    place    pixels (x, y)
    normal   unit, out of the object, in the picture
    ends     the points of the edge
    share    of the second end, 0..1
    jacobian derivative of `place` by the place in space, of the point at the same depth (2 x 3)
    length   of outline that the point has, in working units at its depth
    pixel    size of a pixel in working units at its depth
    """

    place: Float[np.ndarray, "k 2"]
    normal: Float[np.ndarray, "k 2"]
    ends: Int[np.ndarray, "k 2"]
    share: Float[np.ndarray, " k"]
    jacobian: Float[np.ndarray, "k 2 3"]
    length: Float[np.ndarray, " k"]
    pixel: Float[np.ndarray, " k"]


def contour_of(coverage: Float[np.ndarray, "h w"]) -> Contour:
    """The contour of a coverage (0..1), at the crossings of one half between neighbouring pixel centres.

    The border of the picture is not a contour. About 1.3 points per pixel of contour; errors of hard masks are about
    0.15 pixels, of antialiased ones 0.05.
    """
    smooth = gaussian(coverage.astype(np.float32), BLUR).astype(np.float64)
    down, right = np.gradient(smooth)
    points = []
    for axis in (0, 1):
        a, b = (smooth[:-1], smooth[1:]) if axis == 0 else (smooth[:, :-1], smooth[:, 1:])
        rows, columns = np.nonzero((a >= 0.5) != (b >= 0.5))
        share = (0.5 - a[rows, columns]) / (b[rows, columns] - a[rows, columns])
        place = np.stack([columns + 0.5, rows + 0.5], axis=1)
        place[:, 1 - axis] += share
        points.append(place)
    place = np.concatenate(points)
    slope = bilinear(np.stack([right, down], axis=-1), place)
    length = np.linalg.norm(slope, axis=1, keepdims=True)
    good = length[:, 0] > 1e-6
    return Contour(place[good], -slope[good] / length[good])


def silhouette_of(
    surface: WeldedSurface, points: Float[np.ndarray, "n 3"], camera: Camera, empty: Callable[[np.ndarray], np.ndarray]
) -> Silhouette:
    """The silhouette of the surface at `points`; `empty` tells at which pixels (x, y) the camera sees no surface."""
    facing = (area_vectors(points, surface.faces) * (camera.position - points[surface.faces[:, 0]])).sum(axis=1) > 0
    one, two = facing[surface.beside[:, 0]], facing[surface.beside[:, 1]]
    open_edge = surface.beside[:, 1] < 0
    edge = np.flatnonzero(open_edge | (one != two))
    # The face towards the camera tells the side of the edge on which the object lies.
    front = np.where(one[edge] | open_edge[edge], surface.beside[edge, 0], surface.beside[edge, 1])
    px, depth = px_from_world(camera, points)
    ends = surface.edges[edge]
    span = px[ends[:, 1]] - px[ends[:, 0]]
    across = np.linalg.norm(span, axis=1)
    third = surface.faces[front].sum(axis=1) - ends.sum(axis=1)
    good = (across > 1e-9) & (depth[ends].min(axis=1) > 1e-6)
    ends, span, across, third = ends[good], span[good], across[good], third[good]
    normal = np.stack([span[:, 1], -span[:, 0]], axis=1) / across[:, None]
    inwards = ((px[third] - px[ends[:, 0]]) * normal).sum(axis=1) > 0
    normal[inwards] *= -1
    count = np.maximum(np.ceil(across / STEP).astype(np.int64), 1)
    row = np.repeat(np.arange(len(ends)), count)
    step = np.arange(len(row)) - np.repeat(np.cumsum(count) - count, count)
    flat = (step + 0.5) / count[row]  # along the edge in the picture
    z = depth[ends[row]]
    share = flat * z[:, 0] / (flat * z[:, 0] + (1 - flat) * z[:, 1])  # along the edge in space
    place = px[ends[row, 0]] + flat[:, None] * span[row]
    height, width = camera.size
    inside = ((place > 1) & (place < np.array([width - 1, height - 1]))).all(axis=1)
    kept = inside & empty(place + BESIDE * normal[row])
    row, share, place = row[kept], share[kept], place[kept]
    here = points[ends[row, 0]] * (1 - share)[:, None] + points[ends[row, 1]] * share[:, None]
    cam, by_cam = px_by_cam(camera, here)
    pixel = cam[:, 2] / camera.focal
    return Silhouette(
        place,
        normal[row],
        ends[row],
        share,
        by_cam @ camera.cam_from_world[:3, :3],
        across[row] / count[row] * pixel,
        pixel,
    )
