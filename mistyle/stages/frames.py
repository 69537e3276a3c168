"""Normal maps between tangent frames.

A job keeps its normals in the MikkTSpace frame, as glTF and every engine do. Mitsuba 3.9's own `normalmap` shades in
a frame of its own: s = dp/du of the face, made perpendicular to the interpolated normal, t = n x s, whatever the
chart's handedness. A map for Mitsuba alone is therefore turned, texel by texel, from one into the other.
"""

import numpy as np
from jaxtyping import Float

from mistyle.core.maps import Maps, Texels
from mistyle.core.mesh import Mesh, weld
from mistyle.core.tangents import mikktspace
from mistyle.stages.texels import corner_weights


def mitsuba_normals(mesh: Mesh, maps: Maps, texels: Texels) -> Float[np.ndarray, "h w 3"]:
    """The MikkTSpace normal map of a texture set for Mitsuba 3.9's `normalmap`; uncovered texels stay as they are.

    Exact at texel centres; between them Mitsuba interpolates vectors of what may be two faces' frames.
    """
    welded = weld(mesh)
    corners = mikktspace(welded.positions, welded.normals, welded.uvs, welded.faces)
    rows, columns, face, weights = corner_weights(mesh, texels)
    w = weights[..., None].astype(np.float32)
    normal = _unit((mesh.corner_normals[face] * w).sum(axis=1))
    # Handedness belongs to the face, not to its corners: interpolating it would pass through zero.
    hand = corners[face, 0, 3:]
    tangent = _perpendicular((corners[face, :, :3] * w).sum(axis=1), normal)
    x, y, z = np.moveaxis(maps.normal[rows, columns], -1, 0)[..., None]
    world = x * tangent + y * hand * np.cross(normal, tangent) + z * normal
    s = _perpendicular(_along_u(mesh)[face], normal)
    turned = np.stack([(world * axis).sum(axis=1) for axis in (s, np.cross(normal, s), normal)], axis=1)
    result = maps.normal.copy()
    result[rows, columns] = _unit(turned)
    return result


def _along_u(mesh: Mesh) -> Float[np.ndarray, "f 3"]:
    """dp/du of every face; some direction where its UVs have no area."""
    p, t = mesh.positions[mesh.faces].astype(np.float64), mesh.corner_uvs.astype(np.float64)
    e1, e2, d1, d2 = p[:, 1] - p[:, 0], p[:, 2] - p[:, 0], t[:, 1] - t[:, 0], t[:, 2] - t[:, 0]
    area = d1[:, 0] * d2[:, 1] - d1[:, 1] * d2[:, 0]
    along = e1 * d2[:, 1:] - e2 * d1[:, 1:]
    return np.where(area[:, None] != 0, along * np.sign(area)[:, None], e1)


def _perpendicular(v: Float[np.ndarray, "n 3"], normal: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    return _unit(v - (v * normal).sum(axis=1, keepdims=True) * normal)


def _unit(v: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    return (v / np.maximum(np.linalg.norm(v, axis=1, keepdims=True), 1e-20)).astype(np.float32)
