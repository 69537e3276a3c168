"""Checks of a deformed surface: no triangle turns over, and no two triangles intersect that did not before."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from mistyle.core.rows import distinct_integers
from mistyle.geometry.intersections import self_intersections
from mistyle.geometry.normals import area_vectors
from mistyle.solver.shape.surface import WeldedSurface

TRIES = 10  # halvings of a step around bad triangles; then their points stay
SPREAD = 5  # tries after which the points beside the bad triangles shrink their steps, too
LEAST_AREA = 1e-3  # of a triangle, relative to its area at the start
LEAST_TURN = 0.02  # cosine between a triangle's normals at the start and now


@dataclass(frozen=True)
class Start:
    """The surface before any deformation: its area vectors and its intersecting pairs of faces as keys a f + b."""

    vectors: Float[np.ndarray, "f 3"]
    pairs: Int[np.ndarray, " k"]


@dataclass(frozen=True)
class CheckedStep:
    """A displacement that passed the checks; `held` counts the points whose step was shortened."""

    displacement: Float[np.ndarray, "n 3"]
    held: int


def start_of(surface: WeldedSurface) -> Start:
    """Area vectors and self-intersections of the surface as it is."""
    pairs = self_intersections(surface.points, surface.faces)
    return Start(area_vectors(surface.points, surface.faces), _keys(surface, pairs))


def flipped(start: Start, surface: WeldedSurface, points: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, " f"]:
    """Triangles whose normal has turned by 90 degrees or more from the start, or that have collapsed. Triangles that
    were degenerate at the start do not count."""
    now = area_vectors(points, surface.faces)
    was, size = np.linalg.norm(start.vectors, axis=1), np.linalg.norm(now, axis=1)
    turned = (now * start.vectors).sum(axis=1) < LEAST_TURN * was * size
    return (was > 0) & (turned | (size < LEAST_AREA * was))


def new_intersections(
    start: Start, surface: WeldedSurface, points: Float[np.ndarray, "n 3"], moved: Bool[np.ndarray, " f"] | None = None
) -> Int[np.ndarray, "k 2"]:
    """Intersecting pairs of faces that did not intersect at the start; with `moved`, only pairs with such a face."""
    pairs = self_intersections(points, surface.faces, moved)
    return pairs[~np.isin(_keys(surface, pairs), start.pairs)]


def checked_step(
    start: Start, surface: WeldedSurface, x: Float[np.ndarray, "n 3"], target: Float[np.ndarray, "n 3"]
) -> CheckedStep:
    """From the valid displacement `x` towards `target`: steps are halved around triangles that would be bad, and the
    last resort is to stay."""
    share = np.ones(len(x))
    for attempt in range(2 * TRIES):
        now = x + share[:, None] * (target - x)
        bad = flipped(start, surface, surface.points + now)
        moved = (now != x).any(axis=1)[surface.faces].any(axis=1)
        if not bad.any():
            bad[new_intersections(start, surface, surface.points + now, moved).reshape(-1)] = True
        if not bad.any():
            return CheckedStep(now, int((share < 1).sum()))
        points = distinct_integers(surface.faces[bad])
        if attempt >= SPREAD:
            beside = np.isin(surface.edges, points).any(axis=1)
            points = np.union1d(points, surface.edges[beside].reshape(-1))
        share[points] = share[points] / 2 if attempt < TRIES else 0
    return CheckedStep(x, int((target != x).any(axis=1).sum()))


def _keys(surface: WeldedSurface, pairs: Int[np.ndarray, "k 2"]) -> Int[np.ndarray, " k"]:
    return pairs[:, 0] * len(surface.faces) + pairs[:, 1]
