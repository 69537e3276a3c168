"""The mesh as a deformable surface: welded points, edges, and the thin-plate energy of displacements."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.sparse as sp
from jaxtyping import Bool, Float, Int

from mistyle.core.mesh import Mesh
from mistyle.core.rows import distinct, unit
from mistyle.geometry.normals import area_vectors, same_points

LEAST_COTANGENT, MOST_COTANGENT = 0.02, 5.0  # of an edge; slivers would otherwise stiffen or free it


@dataclass(frozen=True)
class WeldedSurface:
    """The welded mesh: vertices at one place are one point, so that seams move as one.

    of_vertex   point of every vertex of the mesh
    edges       distinct, by their points
    beside      the two faces of an edge; the second is -1 at a boundary
    fixed       points of boundary edges, and points without a face
    """

    points: Float[np.ndarray, "n 3"]
    faces: Int[np.ndarray, "f 3"]
    of_vertex: Int[np.ndarray, " v"]
    edges: Int[np.ndarray, "e 2"]
    beside: Int[np.ndarray, "e 2"]
    fixed: Bool[np.ndarray, " n"]


def surface_of(mesh: Mesh) -> WeldedSurface:
    """The welded surface of a mesh, in its order of points. Edges of more than two faces count once for every two."""
    of_vertex = same_points(mesh.positions)
    points = np.zeros((int(of_vertex.max(initial=-1)) + 1, 3))
    points[of_vertex] = mesh.positions
    faces = of_vertex[mesh.faces]
    corners = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    face = np.tile(np.arange(len(faces)), 3)
    real = corners[:, 0] != corners[:, 1]
    corners, face = np.sort(corners[real], axis=1), face[real]
    _, edge = distinct(corners)
    order = np.argsort(edge, kind="stable")
    corners, face, edge = corners[order], face[order], edge[order]
    place = np.arange(len(edge)) - np.searchsorted(edge, edge)
    first = np.flatnonzero(place % 2 == 0)
    follows = np.minimum(first + 1, len(edge) - 1)
    paired = (edge[follows] == edge[first]) & (follows > first)
    beside = np.stack([face[first], np.where(paired, face[follows], -1)], axis=1)
    fixed = np.ones(len(points), bool)
    fixed[faces.reshape(-1)] = False
    fixed[corners[first[~paired]].reshape(-1)] = True
    return WeldedSurface(points, faces, of_vertex, corners[first], beside, fixed)


def normals_of(surface: WeldedSurface, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Unit normals of the points, area-weighted means over their faces; zero where these cancel."""
    vectors = area_vectors(points, surface.faces)
    total = np.zeros_like(points)
    for k in range(3):
        for axis in range(3):
            total[:, axis] += np.bincount(surface.faces[:, k], weights=vectors[:, axis], minlength=len(points))
    return unit(total)


def plate(surface: WeldedSurface) -> Any:
    """The matrix S M^-1 S of the thin-plate energy of a displacement, n x n, sparse.

    S is the cotangent stiffness (Pinkall and Polthier 1993), M the lumped area: the energy is the integral of the
    squared Laplacian, independent of the tessellation. Cotangents are clamped, so S is positive semidefinite.
    """
    count = len(surface.points)
    a, b, c = (surface.points[surface.faces[:, k]] for k in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    safe = np.where(area > 0, area, 1)
    weights, rows, columns = [], [], []
    for k in range(3):
        i, j, opposite = (surface.faces[:, (k + step) % 3] for step in range(3))
        p, q = surface.points[i] - surface.points[opposite], surface.points[j] - surface.points[opposite]
        cotangent = np.clip((p * q).sum(axis=1) / safe, LEAST_COTANGENT, MOST_COTANGENT) / 2
        rows.append(i)
        columns.append(j)
        weights.append(np.where((area > 0) & (i != j), cotangent, 0))
    upper = sp.coo_array((np.concatenate(weights), (np.concatenate(rows), np.concatenate(columns))), (count, count))
    both = (upper + upper.T).tocsr()
    stiffness = sp.diags_array(both.sum(axis=1)) - both
    return (stiffness @ sp.diags_array(1 / mass_of(surface)) @ stiffness).tocsc()


def mass_of(surface: WeldedSurface) -> Float[np.ndarray, " n"]:
    """A third of the area around every point, at least a thousandth of the mean."""
    area = np.linalg.norm(area_vectors(surface.points, surface.faces), axis=1)
    shares = np.repeat(area / 3, 3)
    mass = np.bincount(surface.faces.reshape(-1), weights=shares, minlength=len(surface.points))
    return np.maximum(mass, 1e-3 * float(mass.mean()))
