"""An unknown sky as cells of even radiance: their geometry, how they are refined where light is, their map."""

from dataclasses import dataclass
from functools import cache

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import KDTree

from mistyle.core.image import luminance
from mistyle.core.light import Environment, environment_directions
from mistyle.render.deferred.sky import even_directions

CELLS = 128
FINE = 64  # more of them go where the light is, once that is roughly known
ROWS = 128  # of the map that is made of them
GRID = 256  # rows of the directions by which cells are measured
AROUND = 6  # neighbours of a cell


@dataclass(frozen=True)
class EnvironmentCells:
    """Every direction belongs to the nearest of k unit vectors (world, towards the light).

    angle  solid angle of each cell
    pairs  neighbours, each pair once
    """

    direction: Float[np.ndarray, "k 3"]
    angle: Float[np.ndarray, " k"]
    pairs: Int[np.ndarray, "p 2"]

    def mean(self, radiance: Float[np.ndarray, "k 3"]) -> Float[np.ndarray, "3"]:
        """Of a radiance of every cell, over the sphere."""
        return (radiance * (self.angle / self.angle.sum())[:, None]).sum(axis=0)

    @property
    def width2(self) -> Float[np.ndarray, " k"]:
        """Mean square of the angle from the middle, along one axis: a disc of that solid angle has radius²/4."""
        return self.angle / (4 * np.pi)


Radiance = Float[np.ndarray, "k 3"]


def cells_at(directions: Float[np.ndarray, "k 3"]) -> EnvironmentCells:
    """The cells of these directions."""
    towards, angle = _sphere()
    own = np.bincount(_owners(directions, towards), angle, minlength=len(directions))
    near = np.asarray(KDTree(directions).query(directions, AROUND + 1)[1])[:, 1:]
    both = np.stack([np.repeat(np.arange(len(directions)), AROUND), near.ravel()], axis=1)
    return EnvironmentCells(directions, np.maximum(own, 1e-6), np.unique(np.sort(both, axis=1), axis=0))


def even_cells() -> EnvironmentCells:
    """CELLS cells of nearly one size."""
    return cells_at(even_directions(CELLS).astype(float))


def refined(cells: EnvironmentCells, radiance: Radiance) -> tuple[EnvironmentCells, Float[np.ndarray, "n 3"]]:
    """CELLS even cells and FINE more inside the old ones, as their light demands, and the same light in all of them."""
    energy = luminance(radiance) * cells.angle
    wish = FINE * energy / max(float(energy.sum()), 1e-20)
    count = np.floor(wish).astype(int)
    count[np.argsort(count - wish, kind="stable")[: FINE - count.sum()]] += 1
    inside = [_within(cells, k, int(count[k])) for k in np.flatnonzero(count).tolist()]
    new = cells_at(np.concatenate([even_directions(CELLS), *inside]))
    towards, angle = _sphere()
    old, own = radiance[_owners(cells.direction, towards)], _owners(new.direction, towards)
    total = [np.bincount(own, angle * old[:, c], minlength=len(new.angle)) for c in range(3)]
    return new, np.stack(total, axis=1) / new.angle[:, None]


def environment_of(cells: EnvironmentCells, radiance: Radiance) -> Environment:
    """The map of the cells' light."""
    towards = environment_directions(ROWS, 2 * ROWS)
    own = _owners(cells.direction, towards.reshape(-1, 3))
    return Environment(radiance[own].reshape(towards.shape).astype(np.float32))


def _owners(middles: Float[np.ndarray, "k 3"], towards: Float[np.ndarray, "n 3"]) -> Int[np.ndarray, " n"]:
    """To which cell each direction belongs."""
    return np.asarray(KDTree(middles).query(towards)[1])


def _within(cells: EnvironmentCells, k: int, count: int) -> Float[np.ndarray, "n 3"]:
    """Directions spread evenly over a disc about the middle of cell k, as large as the cell (a Fibonacci spiral)."""
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
    """Directions all over the sphere, and the solid angle that each stands for."""
    towards = environment_directions(GRID, 2 * GRID).reshape(-1, 3)
    weight = np.repeat(np.sin(np.arange(GRID) / (GRID - 1) * np.pi), 2 * GRID)
    return towards, 4 * np.pi * weight / weight.sum()
