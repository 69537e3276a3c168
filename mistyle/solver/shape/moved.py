"""An asset with displaced vertices: normals turn with the surface; topology, UVs, materials and skinning stay."""

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from mistyle.core.asset import Asset
from mistyle.core.mesh import Mesh
from mistyle.core.rows import corner_rows, distinct, sums, unit
from mistyle.geometry.normals import area_vectors, same_points


def displaced_asset(asset: Asset, positions: Float[np.ndarray, "v 3"]) -> Asset:
    """The asset with new positions (working space). Vertices that did not move keep their bits everywhere."""
    mesh, source = asset.mesh, asset.source
    moved = (positions != mesh.positions).any(axis=1)
    inverse = np.linalg.inv(source.work_from_user[:3, :3])
    step = (positions.astype(np.float64) - mesh.positions) @ inverse.T
    user = np.where(moved[:, None], source.user_positions + step, source.user_positions)
    new = replace(mesh, positions=positions, corner_normals=turned_normals(mesh, positions))
    own = replace(source, user_positions=user, displacement=np.where(moved[:, None], step, 0.0))
    return replace(asset, mesh=new, source=own)


def turned_normals(mesh: Mesh, positions: Float[np.ndarray, "v 3"]) -> Float[np.ndarray, "f 3 3"]:
    """Corner normals of the moved mesh.

    Corners at one point that share a normal form a group: a smooth vertex, one side of a crease, or a flat face. Each
    normal turns by the least rotation from the group's summed area vector before to that after. Creases and authored
    normals so stay as they are relative to the surface, and UV seams stay invisible.
    """
    point = same_points(mesh.positions)[mesh.faces.reshape(-1)]
    normals = mesh.corner_normals.reshape(-1, 3)
    kinds, group = distinct(corner_rows(point, normals.astype(np.float32)))
    before, after = (
        sums(group, np.repeat(area_vectors(p, mesh.faces), 3, axis=0), len(kinds)) for p in (mesh.positions, positions)
    )
    changed = (before != after).any(axis=1)
    result = normals.copy()
    corners = np.flatnonzero(changed[group])
    turned = _turned(normals[corners].astype(np.float64), unit(before)[group[corners]], unit(after)[group[corners]])
    result[corners] = turned.astype(normals.dtype)
    return result.reshape(-1, 3, 3)


def _turned(
    vectors: Float[np.ndarray, "k 3"], one: Float[np.ndarray, "k 3"], two: Float[np.ndarray, "k 3"]
) -> Float[np.ndarray, "k 3"]:
    """Vectors after the least rotation from unit `one` to unit `two`: v + a x v + a x (a x v) / (1 + c), a = one x two.
    Where the two are opposite or zero, the vectors stay."""
    axis, cosine = np.cross(one, two), (one * two).sum(axis=1, keepdims=True)
    good = (cosine > -0.999) & one.any(axis=1, keepdims=True) & two.any(axis=1, keepdims=True)
    across = np.cross(axis, vectors)
    turned = vectors + across + np.cross(axis, across) / np.where(good, 1 + cosine, 1)
    return np.where(good, turned, vectors)
