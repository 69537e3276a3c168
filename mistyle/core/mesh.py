"""The mesh of every stage: positions shared by faces, all other attributes per face corner."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from mistyle.core.rows import corner_rows, distinct, unit

# Distance from the origin, in radii, beyond which float32 rounds visibly: by 4 mm for 10 km of terrain at 80 km.
FAR = 8.0
POINTS = 16_384  # of a surface, to estimate how much of it pictures show


@dataclass(frozen=True)
class Mesh:
    """Triangles in the working space: Y up, right-handed, bounding sphere of radius 1 about the origin.

    UVs and normals belong to face corners, so a UV seam never duplicates a position and the user's vertex order
    survives. `part` is the texture set of a face; `parts` names the sets. UVs are v up and taken modulo 1
    (textures repeat): a kept island that crosses the square's border keeps its place, so single coordinates may lie in
    [-1, 2]. Where faces share texels, the first in face order is the one painted.
    """

    positions: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"]
    corner_normals: Float[np.ndarray, "f 3 3"]
    corner_uvs: Float[np.ndarray, "f 3 2"]
    part: Int[np.ndarray, " f"]
    parts: tuple[str, ...]


@dataclass(frozen=True)
class Welded:
    """The mesh for renderers and glTF: one index per distinct (position, normal, uv); `vertex` is the index in
    `Mesh`."""

    positions: Float[np.ndarray, "w 3"]
    normals: Float[np.ndarray, "w 3"]
    uvs: Float[np.ndarray, "w 2"]
    faces: Int[np.ndarray, "f 3"]
    vertex: Int[np.ndarray, " w"]


def weld(mesh: Mesh, part: int | None = None) -> Welded:
    """Merge equal corners of one part (or of all): bit-equal normals and uvs at the same position share an index."""
    chosen = np.arange(len(mesh.faces)) if part is None else np.flatnonzero(mesh.part == part)
    vertex = mesh.faces[chosen].reshape(-1)
    normals = mesh.corner_normals[chosen].reshape(-1, 3).astype(np.float32)
    uvs = mesh.corner_uvs[chosen].reshape(-1, 2).astype(np.float32)
    first, inverse = distinct(corner_rows(vertex, normals, uvs))
    return Welded(
        positions=mesh.positions[vertex[first]].astype(np.float32),
        normals=normals[first],
        uvs=uvs[first],
        faces=inverse.reshape(-1, 3).astype(np.int32),
        vertex=vertex[first].astype(np.int32),
    )


def local_origin(positions: Float[np.ndarray, "v 3"]) -> Float[np.ndarray, " 3"]:
    """An integer offset to subtract before float32: the middle of a mesh further from its own origin than `FAR` radii,
    else the origin."""
    low, high = positions.min(axis=0), positions.max(axis=0)
    middle, radius = (low + high) / 2, float(np.linalg.norm(high - low)) / 2
    return np.rint(middle).astype(float) if np.abs(middle).max() > FAR * radius else np.zeros(3)


def face_normals(mesh: Mesh) -> Float[np.ndarray, "f 3"]:
    """Unit geometric normal of every face (counter-clockwise front); zero for degenerate faces."""
    a, b, c = (mesh.positions[mesh.faces[:, k]].astype(np.float64) for k in range(3))
    return unit(np.cross(b - a, c - a))


def face_areas(mesh: Mesh) -> Float[np.ndarray, " f"]:
    """Area of every face in working units."""
    return _areas(*(mesh.positions[mesh.faces[:, k]].astype(np.float64) for k in range(3)))


class SpreadPoints(NamedTuple):
    """Points spread evenly over a surface, and the unit normals of their faces."""

    position: Float[np.ndarray, "n 3"]
    normal: Float[np.ndarray, "n 3"]


def spread_points(
    positions: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"], count: int, rng: np.random.Generator
) -> SpreadPoints:
    """`count` points of equal area, stratified over the faces in their order."""
    areas = _areas(*(positions[faces[:, k]].astype(np.float64) for k in range(3)))
    steps = (np.arange(count) + rng.random(count)) / count * areas.sum()
    face = np.minimum(np.searchsorted(np.cumsum(areas), steps), len(areas) - 1)
    u, v = rng.random((2, count))
    over = u + v > 1
    u, v = np.where(over, 1 - u, u), np.where(over, 1 - v, v)
    a, b, c = (positions[faces[face, k]].astype(np.float64) for k in range(3))
    position = a + u[:, None] * (b - a) + v[:, None] * (c - a)
    return SpreadPoints(position, unit(np.cross(b - a, c - a)))


def surface_of(positions: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]) -> SpreadPoints:
    """POINTS of a surface, always the same ones."""
    return spread_points(positions, faces, POINTS, np.random.default_rng(0))


def _areas(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> Float[np.ndarray, " f"]:
    return np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
