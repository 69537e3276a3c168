"""An unknown environment light as spherical cells of constant radiance: geometry, refinement, environment map."""

from dataclasses import dataclass
from functools import cache

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import KDTree

from mistyle.core.image import luminance
from mistyle.core.light import Environment, environment_directions
from mistyle.render.deferred.sky import even_directions

CELLS = 128
FINE = 64  # additional cells where the light is, after the first solve
ROWS = 128  # rows of the environment map
GRID = 256  # rows of the direction grid that measures the cells
AROUND = 6  # neighbours of a cell


@dataclass(frozen=True)
class LightCells:
    """Every direction belongs to the nearest of k unit vectors (world, towards the light).

    angle  solid angle of each cell
    pairs  neighbours, each pair once
    """

    direction: Float[np.ndarray, "k 3"]
    angle: Float[np.ndarray, " k"]
    pairs: Int[np.ndarray, "p 2"]

    def mean(self, radiance: Float[np.ndarray, "k 3"]) -> Float[np.ndarray, "3"]:
        """The mean over the sphere of a radiance per cell."""
        return (radiance * (self.angle / self.angle.sum())[:, None]).sum(axis=0)

    @property
    def width2(self) -> Float[np.ndarray, " k"]:
        """Mean squared angle from the cell's centre along one axis, for a disc of its solid angle: radius²/4."""
        return self.angle / (4 * np.pi)


Radiance = Float[np.ndarray, "k 3"]


def cells_at(directions: Float[np.ndarray, "k 3"]) -> LightCells:
    """The Voronoi cells of these directions; their solid angles are measured on the direction grid."""
    towards, angle = _sphere()
    own = np.bincount(_owners(directions, towards), angle, minlength=len(directions))
    near = np.asarray(KDTree(directions).query(directions, AROUND + 1)[1])[:, 1:]
    both = np.stack([np.repeat(np.arange(len(directions)), AROUND), near.ravel()], axis=1)
    return LightCells(directions, np.maximum(own, 1e-6), np.unique(np.sort(both, axis=1), axis=0))


def even_cells() -> LightCells:
    """CELLS cells of nearly equal size."""
    return cells_at(even_directions(CELLS).astype(float))


def refined(cells: LightCells, radiance: Radiance) -> tuple[LightCells, Float[np.ndarray, "n 3"]]:
    """CELLS even cells, FINE more in proportion to the old cells' energy, and the radiance resampled to them."""
    energy = luminance(radiance) * cells.angle
    share = FINE * energy / max(float(energy.sum()), 1e-20)
    count = np.floor(share).astype(int)
    count[np.argsort(count - share, kind="stable")[: FINE - count.sum()]] += 1
    inside = [_within(cells, k, int(count[k])) for k in np.flatnonzero(count).tolist()]
    new = cells_at(np.concatenate([even_directions(CELLS), *inside]))
    towards, angle = _sphere()
    old, own = radiance[_owners(cells.direction, towards)], _owners(new.direction, towards)
    total = [np.bincount(own, angle * old[:, c], minlength=len(new.angle)) for c in range(3)]
    return new, np.stack(total, axis=1) / new.angle[:, None]


def environment_of(cells: LightCells, radiance: Radiance) -> Environment:
    """The environment map of the cells' radiance, ROWS x 2 ROWS."""
    towards = environment_directions(ROWS, 2 * ROWS)
    own = _owners(cells.direction, towards.reshape(-1, 3))
    return Environment(radiance[own].reshape(towards.shape).astype(np.float32))


def _owners(middles: Float[np.ndarray, "k 3"], towards: Float[np.ndarray, "n 3"]) -> Int[np.ndarray, " n"]:
    """The index of each direction's cell."""
    return np.asarray(KDTree(middles).query(towards)[1])


def _within(cells: LightCells, k: int, count: int) -> Float[np.ndarray, "n 3"]:
    """Even directions (Fibonacci spiral) over a disc at the centre of cell k with the cell's solid angle."""
    middle = cells.direction[k]
    across = np.cross(middle, np.eye(3)[np.abs(middle).argmin()])
    across /= np.linalg.norm(across)
    number = np.arange(count) + 0.5
    away, turn = np.sqrt(cells.angle[k] / np.pi * number / count), np.pi * (1 + 5**0.5) * number
    offset = np.cos(turn)[:, None] * across + np.sin(turn)[:, None] * np.cross(middle, across)
    towards = middle + away[:, None] * offset
    return towards / np.linalg.norm(towards, axis=1, keepdims=True)


@cache
def _sphere() -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, " n"]]:
    """A direction grid of the whole sphere, and the solid angle of each direction."""
    towards = environment_directions(GRID, 2 * GRID).reshape(-1, 3)
    weight = np.repeat(np.sin(np.arange(GRID) / (GRID - 1) * np.pi), 2 * GRID)
    return towards, 4 * np.pi * weight / weight.sum()
