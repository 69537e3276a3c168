"""Blue-noise surface samples, and tables of their 5x5 neighbourhoods, which replace a pixel grid.

Distances between samples are six-dimensional, [position, 3 h normal]. Two sides of a thin wall or of a crease are far
apart although they touch in space. So paint on one side does not reach the other.
"""

from dataclasses import dataclass
from types import ModuleType
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from mistyle.core.errors import InputRefused
from mistyle.core.mesh import Mesh, face_areas, face_normals
from mistyle.core.rows import distinct, unit
from mistyle.geometry.normals import crease_normals, same_points
from mistyle.render.mitsuba.device import dr
from mistyle.stylization.surface import cells, kernels

OVERSAMPLING = 5  # candidates per requested sample
YIELD = 0.8  # remaining points per requested sample
COINCIDENT_ROUNDS = 4
SPACING = 0.8  # least distance of two samples, in sqrt(area per requested sample)
NORMAL_REACH = 3.0  # sample spacings per radian between normals
NEAR_REACH = 4.0  # spacings within which the 5 x 5 table is chosen, with normals as above
NEAR = 60  # candidates for the table: such a disc holds 50 samples
CROWDED = 25.0  # candidates in a cell, on average, above which coincident layers are thinned on a grid first
GRID = np.array([(dx, dy) for dy in range(-2, 3) for dx in range(-2, 3)], np.float32)  # (25 2): row by row, x fastest
CENTRE = 12


@dataclass(frozen=True)
class SurfacePoints:
    """Blue noise on a surface: unit normals, `spacing` h = sqrt(area / n), `tree` a k-d tree of [p, 3 h normal]."""

    positions: Float[np.ndarray, "n 3"]
    normals: Float[np.ndarray, "n 3"]
    spacing: float
    tree: Any


@dataclass(frozen=True)
class Level:
    """Points with tangent frames and 5 x 5 neighbourhoods; entry k of a row belongs to the grid position GRID[k].

    tangent     along the stroke, the picture's x; y is `across`
    directed    0..1, certainty of the tangent's direction
    neighbours  the sample nearest to p + h (dx tangent + dy across)
    turned      whether that neighbour's tangent is opposite, so that its picture is turned by 180 degrees
    offsets     (x, y) of the sample in its neighbour's frame, in spacings, within -4..4
    """

    points: SurfacePoints
    tangent: Float[np.ndarray, "n 3"]
    across: Float[np.ndarray, "n 3"]
    directed: Float[np.ndarray, " n"]
    neighbours: Int[np.ndarray, "n 25"]
    turned: Bool[np.ndarray, "n 25"]
    offsets: Float[np.ndarray, "n 25 2"]


def workers() -> int:
    """Threads for k-d trees, as many as Dr.Jit uses, so that one setting controls both; results do not depend on it."""
    return max(int(dr.thread_count()), 1)


def sample_normals(mesh: Mesh) -> Float[np.ndarray, "f 3 3"]:
    """Per-corner normals for samples: smooth up to 50 degrees, sharp beyond, on the side of the shading normals.

    The mesh's own shading normals are unsuitable: smoothed around the rim of a thin wall, they would join its sides.
    """
    normals = face_normals(mesh)
    inward = ((normals * mesh.corner_normals.sum(axis=1)).sum(axis=1) < 0)[:, None]
    faces = np.where(inward, mesh.faces[:, ::-1], mesh.faces)
    normals = crease_normals(mesh.positions, faces, same_points(mesh.positions))
    return np.where(inward[..., None], normals[:, ::-1], normals)


def spread(
    mesh: Mesh,
    corner_normals: Float[np.ndarray, "f 3 3"],
    count: int,
    rng: np.random.Generator,
    dj: ModuleType | None = None,
) -> SurfacePoints:
    """Blue-noise points on the mesh: about 0.8 `count` of them, no two of one side nearer than 0.8 sqrt(area / count).

    Stratified candidates by area, thinned by random priority (a parallel form of dart throwing). `corner_normals`
    come from `sample_normals`; `dj` is Dr.Jit's array module (None: the CPU's). Refuses a mesh without area.
    """
    dj = dj or kernels.module("llvm")
    areas = face_areas(mesh)
    area = float(areas.sum())
    if not area > 0 or not np.isfinite(area):
        raise InputRefused(
            f"the mesh has a surface area of {area:g}; a mesh with at least one triangle of non-zero area is needed"
        )
    candidates = OVERSAMPLING * count
    share = np.cumsum(areas) / area
    # side="right" skips faces without area: their share equals that of the face before.
    face = np.searchsorted(share, (np.arange(candidates) + rng.random(candidates)) / candidates, side="right")
    face = np.minimum(face, np.flatnonzero(areas > 0)[-1])
    root, v = np.sqrt(rng.random(candidates, np.float32)), rng.random(candidates, np.float32)
    bary = np.stack([1 - root, root * (1 - v), root * v], axis=1)
    positions = combined(bary, mesh.positions.astype(np.float32), mesh.faces[face])
    normals = unit(combined(bary, corner_normals.astype(np.float32).reshape(-1, 3), 3 * face[:, None] + np.arange(3)))
    # Along a Z-order curve, equals by index.
    order = np.sort((morton(positions) << 32) | np.arange(len(positions))) & 0xFFFFFFFF
    positions, normals = positions[order], normals[order]
    radius = SPACING * float(np.sqrt(area / count))
    selected = thin(positions, normals, radius, rng, dj)
    # Coincident layers count several times in the area but hold one layer's points: shrink the radius for more.
    for _ in range(COINCIDENT_ROUNDS):
        if len(selected) > count / 2:
            break
        radius *= max(0.25, float(np.sqrt(len(selected) / (YIELD * count))))
        selected = thin(positions, normals, radius, rng, dj)
    own_area = radius**2 / SPACING**2 * len(selected) / YIELD
    return as_points(positions[selected], normals[selected], float(np.sqrt(min(area, 1.1 * own_area) / len(selected))))


def combined(
    weights: Float[np.ndarray, "n 3"], values: Float[np.ndarray, "m 3"], index: Int[np.ndarray, "n 3"]
) -> Float[np.ndarray, "n 3"]:
    """Weighted sums of three rows each."""
    result = values[index[:, 0]] * weights[:, :1]
    for k in (1, 2):
        result += values[index[:, k]] * weights[:, k : k + 1]
    return result


def as_points(positions: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"], spacing: float) -> SurfacePoints:
    """Points with their tree; `spacing` is h."""
    from scipy.spatial import KDTree

    positions, normals = positions.astype(np.float32), normals.astype(np.float32)
    return SurfacePoints(positions, normals, spacing, KDTree(lifted(positions, normals, spacing)))


def lifted(
    positions: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"], spacing: float
) -> Float[np.ndarray, "n 6"]:
    """[position, 3 h normal]: the space of neighbour searches."""
    return np.concatenate([positions, normals * np.float32(NORMAL_REACH * spacing)], axis=1, dtype=np.float64)


def thin(
    positions: Float[np.ndarray, "n 3"],
    normals: Float[np.ndarray, "n 3"],
    radius: float,
    rng: np.random.Generator,
    dj: ModuleType,
) -> Int[np.ndarray, " m"]:
    """Indices of the points that stay when, in random order, each removes all others of its side within `radius`."""
    grid = cells.point_grid(dj, positions, normals, radius, rng.permutation(len(positions)))
    if grid.crowd <= CROWDED:
        return np.flatnonzero(cells.thin(dj, grid, radius))
    index = np.flatnonzero(first_per_cell(positions, normals, radius / 3))
    grid = cells.point_grid(dj, positions[index], normals[index], radius, rng.permutation(len(index)))
    return index[cells.thin(dj, grid, radius)]


def first_per_cell(
    positions: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"], size: float
) -> Bool[np.ndarray, " n"]:
    """Mask of one point per cubic cell and octant of the normal: bounds the density of coincident layers."""
    cell = np.floor(positions / size).astype(np.int64)
    octant = (normals > 0) @ np.array([1, 2, 4])
    key = np.concatenate([cell, octant[:, None]], axis=1)
    mask = np.zeros(len(positions), bool)
    mask[distinct(key)[0]] = True
    return mask


def morton(positions: Float[np.ndarray, "n 3"]) -> Int[np.ndarray, " n"]:
    """Z-order codes of 10 bits an axis: sorted by them, neighbours in space are neighbours in memory."""
    low, high = positions.min(axis=0), positions.max(axis=0)
    cell = ((positions - low) * (1023 / max(float((high - low).max()), 1e-20))).astype(np.int64)
    code = np.zeros(len(positions), np.int64)
    for axis in range(3):
        # Insert two zero bits between neighbouring bits.
        bits = cell[:, axis]
        for shift, mask in ((16, 0x30000FF), (8, 0x300F00F), (4, 0x30C30C3), (2, 0x9249249)):
            bits = (bits | (bits << shift)) & mask
        code |= bits << axis
    return code


def nearest(
    source: SurfacePoints, target: SurfacePoints, count: int
) -> tuple[Float[np.ndarray, "n k"], Int[np.ndarray, "n k"]]:
    """The `count` points of `source` nearest to each of `target` in the lifted space: distances and indices."""
    count = min(count, len(source.positions))
    query = lifted(target.positions, target.normals, source.spacing)
    distance, index = source.tree.query(query, k=np.arange(1, count + 1), workers=workers())
    return distance.astype(np.float32), index.astype(np.int32)


def carry(
    source: SurfacePoints, values: Float[np.ndarray, "n ..."], target: SurfacePoints
) -> Float[np.ndarray, "m ..."]:
    """Values interpolated from one point set to another: the four nearest, weighted by 1 / (distance + 0.3 h)."""
    distance, index = nearest(source, target, 4)
    weight = 1 / (distance + np.float32(0.3 * source.spacing))
    weight /= weight.sum(axis=1, keepdims=True)
    return np.einsum("nk,nk...->n...", weight, values[index]).astype(np.float32)


def drop(
    source: SurfacePoints, values: Float[np.ndarray, "n ..."], target: SurfacePoints
) -> Float[np.ndarray, "m ..."]:
    """Values of the nearest points, from one point set to another."""
    return values[nearest(source, target, 1)[1][:, 0]]


def with_tables(
    points: SurfacePoints, tangent: Float[np.ndarray, "n 3"], directed: Float[np.ndarray, " n"], dj: ModuleType
) -> Level:
    """A level from its points and tangents (unit, orthogonal to the normals): adds the 5 x 5 tables.

    Seen from outside with x along the tangent, `across` = tangent x normal points down, like a picture's y.
    """
    across = unit(np.cross(tangent, points.normals))
    h = points.spacing
    near = cells.near(dj, points.positions, points.normals, NEAR_REACH * h, NORMAL_REACH * h, NEAR)
    frame = kernels.Frames(
        kernels.floats(dj, points.positions),
        kernels.floats(dj, points.normals),
        kernels.floats(dj, tangent),
        kernels.floats(dj, across),
        h,
    )
    neighbours = kernels.choose_neighbours(dj, frame, near)
    turned, offsets = kernels.offsets(dj, frame, neighbours)
    return Level(points, tangent, across, directed, neighbours, turned, offsets)


def smooth(level: Level, values: Float[np.ndarray, " n"], times: int) -> Float[np.ndarray, " n"]:
    """The mean over the 5 x 5 neighbourhood, repeated `times` times."""
    for _ in range(times):
        values = values[level.neighbours].mean(axis=1, dtype=np.float32)
    return values
