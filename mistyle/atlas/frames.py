"""Tangent frames of texels, and conversion of normal maps between frames.

A job stores its normals in the MikkTSpace frame, as glTF and every engine do. Mitsuba 3.9's own `normalmap` shades in
another frame: s = dp/du of the face, made perpendicular to the interpolated normal, t = n x s, whatever the chart's
handedness. A map for Mitsuba alone is therefore converted texel by texel.
"""

import numpy as np
from jaxtyping import Float, Int

from mistyle.core.maps import Maps, Texels
from mistyle.core.mesh import Mesh
from mistyle.geometry.tangents import corner_tangents


def mitsuba_normals(mesh: Mesh, maps: Maps, texels: Texels) -> Float[np.ndarray, "h w 3"]:
    """The MikkTSpace normal map of a texture set for Mitsuba 3.9's `normalmap`; uncovered texels stay unchanged.

    Exact at texel centres; between them Mitsuba interpolates vectors that may belong to two faces' frames.
    """
    at = texels.covered
    place = texels.face[at], texels.position[at], texels.normal[at]
    ours = texel_frames(mesh, *place, corner_tangents(mesh))
    theirs = texel_frames(mesh, *place, None)
    world = np.einsum("tk,tkx->tx", maps.normal[at], ours)
    turned = np.einsum("tx,tkx->tk", world, theirs)
    result = maps.normal.copy()
    result[at] = turned / np.maximum(np.linalg.norm(turned, axis=1, keepdims=True), 1e-20)
    return result


def texel_frames(
    mesh: Mesh,
    face: Int[np.ndarray, " t"],
    position: Float[np.ndarray, "t 3"],
    normal: Float[np.ndarray, "t 3"],
    tangents: Float[np.ndarray, "f 3 4"] | None,
) -> Float[np.ndarray, "t 3 3"]:
    """Tangent, bitangent and normal at surface points, as `render/deferred/integrator.py` builds them at samples.

    With `tangents` (MikkTSpace, per corner), the interpolated tangent made perpendicular to the normal; without them
    Mitsuba's own frame, the face's dp/du made perpendicular.
    """
    if tangents is None:
        tangent, hand = _along_u(mesh)[face], np.ones(len(face), np.float32)
    else:
        corners = mesh.positions[mesh.faces[face]].astype(np.float32)
        weights = _barycentric(corners, position)
        tangent = (tangents[face, :, :3] * weights[..., None]).sum(axis=1)
        hand = np.sign(tangents[face, 2, 3])
    s = tangent - normal * (normal * tangent).sum(axis=1, keepdims=True)
    length = np.linalg.norm(s, axis=1, keepdims=True)
    spare = np.where(np.abs(normal[:, :1]) < 0.9, np.array([[1.0, 0, 0]]), np.array([[0, 1.0, 0]]))
    spare = spare - normal * (normal * spare).sum(axis=1, keepdims=True)
    s = np.where(length > 1e-6, s / np.maximum(length, 1e-6), spare / np.linalg.norm(spare, axis=1, keepdims=True))
    t = np.cross(normal, s) * hand[:, None]
    return np.stack([s, t, normal], axis=1).astype(np.float32)


def uv_derivatives(mesh: Mesh) -> Float[np.ndarray, "f 2 3"]:
    """dp/du and dp/dv of every face, in the mesh's unit; faces without UV area have only a direction."""
    p, uv = mesh.positions[mesh.faces].astype(np.float64), mesh.corner_uvs.astype(np.float64)
    e1, e2, d1, d2 = p[:, 1] - p[:, 0], p[:, 2] - p[:, 0], uv[:, 1] - uv[:, 0], uv[:, 2] - uv[:, 0]
    area = d1[:, :1] * d2[:, 1:] - d1[:, 1:] * d2[:, :1]
    along = np.stack([d2[:, 1:] * e1 - d1[:, 1:] * e2, d1[:, :1] * e2 - d2[:, :1] * e1], axis=1)
    return along / np.where(area != 0, area, 1)[..., None]


def _along_u(mesh: Mesh) -> Float[np.ndarray, "f 3"]:
    """The direction of dp/du of every face."""
    along = uv_derivatives(mesh)[:, 0]
    return (along / np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-30)).astype(np.float32)


def _barycentric(corners: Float[np.ndarray, "t 3 3"], position: Float[np.ndarray, "t 3"]) -> Float[np.ndarray, "t 3"]:
    e1, e2, d = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0], position - corners[:, 0]
    a, b, c = (e1 * e1).sum(1), (e1 * e2).sum(1), (e2 * e2).sum(1)
    f, g = (e1 * d).sum(1), (e2 * d).sum(1)
    area = a * c - b * b
    safe = np.where(area > 1e-20, area, 1)
    l1 = np.clip(np.where(area > 1e-20, (c * f - b * g) / safe, 1 / 3), 0, 1)
    l2 = np.clip(np.where(area > 1e-20, (a * g - b * f) / safe, 1 / 3), 0, 1)
    return np.stack([1 - l1 - l2, l1, l2], axis=1)
