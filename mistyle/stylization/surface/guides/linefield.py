"""Line field of stroke directions: smooth, unsigned, in the tangent planes.

Lines are 3x3 tensors, so opposite directions are equal, and conflicting ones cancel into "no direction". They follow
the direction of least curvature where curvature is anisotropic, and lines of equal tone where the shading has a slope;
elsewhere they are horizontal. Diffusion over the surface joins these into one field.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from mistyle.stylization.surface.samples import SurfacePoints, nearest, unit

KEY = np.array([-0.5, 0.75, 0.6]) / np.linalg.norm([-0.5, 0.75, 0.6])  # a painter's light: above, left, in front
UP = np.array([0.0, 1.0, 0.0])
AROUND = 17  # neighbours of a point, itself included
ROUNDS = 60
HOLD = 0.06  # share of the data in each round of diffusion
LEVEL_LINES = 0.02  # weight of horizontal strokes, effective without other data
PAINTED_LINES = 2.0  # weight of strokes from a direction map: the largest weight of the form

DirectionConstraint = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]
"""User-defined directions: (positions, normals) of surface points -> unit directions (n, 3) along the surface, and
their weight against the form, 0..1."""


@dataclass(frozen=True)
class LineField:
    """Tensors T = sum w d d^T (unit lines d, weights w) at a few thousand points of the surface."""

    points: SurfacePoints
    tensors: Float[np.ndarray, "n 3 3"]


def line_field(
    points: SurfacePoints, follow: str = "curvature", direction: DirectionConstraint | None = None
) -> LineField:
    """The field at `points` (5,000 to 10,000 are enough; the diffusion reaches some tens of spacings).

    `follow` "curvature" uses the form; "up" makes strokes vertical, "around" horizontal, wherever the surface is not
    horizontal itself. `direction` replaces these by its weight.
    """
    index = nearest(points, points, AROUND)[1]
    normals = points.normals.astype(np.float64)
    weight = ((normals[index] * normals[:, None]).sum(axis=2) > 0.1).astype(np.float64)
    data = observed(points, normals, index, weight) if follow == "curvature" else axis_lines(normals, follow)
    if direction is not None:
        towards, share = direction(points.positions, points.normals)
        data = (1 - share)[:, None, None] * data + PAINTED_LINES * lines(towards.astype(np.float64), share)
    project = np.eye(3) - normals[:, :, None] * normals[:, None, :]
    share = weight / weight.sum(axis=1, keepdims=True)
    tensors = data
    for _ in range(ROUNDS):
        mean = np.einsum("nk,nkij->nij", share, tensors[index])
        tensors = HOLD * data + (1 - HOLD) * project @ mean @ project
    return LineField(points, tensors.astype(np.float32))


def axis_lines(normals: Float[np.ndarray, "n 3"], follow: str) -> Float[np.ndarray, "n 3 3"]:
    """Lines along the vertical or around it, with more weight on steeper surfaces."""
    level = np.cross(normals, UP)
    steep = (level**2).sum(axis=1)
    return lines(np.cross(level, normals) if follow == "up" else level, np.ones(len(normals))) * steep[:, None, None]


def observed(
    points: SurfacePoints, normals: Float[np.ndarray, "n 3"], index: np.ndarray, weight: Float[np.ndarray, "n k"]
) -> Float[np.ndarray, "n 3 3"]:
    """Each point's own direction data, before diffusion."""
    first = any_tangent(normals)
    basis = np.stack([first, np.cross(normals, first)], axis=2)  # (n 3 2)
    smoothed = normals
    for _ in range(3):
        smoothed = unit((smoothed[index] * weight[..., None]).sum(axis=1))
    # Shading alone, without occlusion: it shows changes of the form, is cheap and has no noise.
    tone = 0.5 * smoothed @ KEY + 0.5 * smoothed[:, 1]
    away = points.positions[index].astype(np.float64) - points.positions[:, None]
    local = np.einsum("nkc,nci->nki", away, basis) * weight[..., None]
    turn = np.einsum("nkc,nci->nki", smoothed[index] - smoothed[:, None], basis) * weight[..., None]
    change = (tone[index] - tone[:, None]) * weight
    # Least squares in the tangent plane for the shape operator and the slope of the tone.
    gram = np.einsum("nki,nkj->nij", local, local) + 1e-5 * AROUND * points.spacing**2 * np.eye(2)
    shape = np.linalg.solve(gram, np.einsum("nki,nkj->nij", local, turn))
    slope = np.linalg.solve(gram, np.einsum("nki,nk->ni", local, change)[..., None])[..., 0]
    curvature, axes = np.linalg.eigh((shape + shape.transpose(0, 2, 1)) / 2)
    flat = np.argmin(np.abs(curvature), axis=1)
    along = np.take_along_axis(axes, flat[:, None, None], axis=2)[..., 0]
    bend = np.abs(np.abs(curvature[:, 1]) - np.abs(curvature[:, 0]))
    steep = np.linalg.norm(slope, axis=1)
    contour = np.stack([-slope[:, 1], slope[:, 0]], axis=1) / np.maximum(steep, 1e-12)[:, None]
    level = np.cross(normals, UP)
    return (
        lines(np.einsum("nci,ni->nc", basis, along), confidence(bend))
        + lines(np.einsum("nci,ni->nc", basis, contour), confidence(steep))
        + LEVEL_LINES * lines(level, np.ones(len(level)))
    )


def lines(directions: Float[np.ndarray, "n 3"], weight: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n 3 3"]:
    """w d d^T."""
    return weight[:, None, None] * directions[:, :, None] * directions[:, None, :]


def confidence(strength: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """0..1, one from the 80th percentile on; all zero where the strength is at rounding level."""
    top = float(np.percentile(strength, 80))
    return np.clip(strength / top, 0, 1) if top > 1e-6 else np.zeros_like(strength)


def any_tangent(normals: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """A unit vector orthogonal to each unit normal."""
    helper = np.where(np.abs(normals[:, :1]) < 0.7, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
    return unit(np.cross(normals, helper))


def directions(field: LineField, points: SurfacePoints) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, " n"]]:
    """Unit tangents at `points` and their certainty (0..1: difference over sum of the tensor's eigenvalues)."""
    distance, index = nearest(field.points, points, 4)
    weight = 1 / (distance + 1e-6)
    weight /= weight.sum(axis=1, keepdims=True)
    tensors = np.einsum("nk,nkij->nij", weight, field.tensors[index])
    # The tensor in a tangent basis is 2x2, whose eigenvector has a closed form: half the angle of (a - c, 2 b).
    normals = points.normals
    first = any_tangent(normals).astype(np.float32)
    second = np.cross(normals, first)
    a = np.einsum("ni,nij,nj->n", first, tensors, first, optimize=True)
    b = np.einsum("ni,nij,nj->n", first, tensors, second, optimize=True)
    c = np.einsum("ni,nij,nj->n", second, tensors, second, optimize=True)
    angle = np.arctan2(2 * b, a - c) / 2
    tangent = unit(first * np.cos(angle)[:, None] + second * np.sin(angle)[:, None])
    certainty = np.hypot(a - c, 2 * b) / np.maximum(a + c, 1e-9)
    return tangent.astype(np.float32), np.clip(certainty, 0, 1).astype(np.float32)
