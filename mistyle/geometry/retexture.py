"""Resampling of a texture from one set of UVs to another."""

from typing import Literal

import numpy as np
from jaxtyping import Float, Int

from mistyle.geometry.normals import area_vectors
from mistyle.geometry.raster import fragments
from mistyle.geometry.uvs import signed_areas

# Wrap mode outside the unit square: repeated, mirrored at every integer, or clamped to the last texel.
Wrap = Literal["repeat", "mirror", "clamp"]
Wraps = tuple[Wrap, Wrap]  # along u and along v
REPEAT: Wraps = ("repeat", "repeat")
Covered = tuple[Int[np.ndarray, " n"], Int[np.ndarray, " n"], Float[np.ndarray, "n 3"]]


def carry(
    values: np.ndarray,
    lookup: Float[np.ndarray, "f 3 2"],
    uvs: Float[np.ndarray, "f 3 2"],
    size: int,
    wrap: Wraps = REPEAT,
    covered: Covered | None = None,
) -> tuple[np.ndarray, Int[np.ndarray, "h w"]]:
    """A texture of size² for `uvs` that equals `values` at `lookup` on every face, and each texel's face.

    Both UVs are v up, row 0 is v = 1; the new texture repeats, the old one wraps by `wrap`. Sampled bilinearly at
    texel centres; the first of several faces at a texel counts; texels without a face (face -1) take their
    nearest covered neighbour. `covered` is `covered_texels(uvs, size)` where the caller has it already.
    """
    channels = values if values.ndim == 3 else values[..., None]
    pieces, face, weights = covered_texels(uvs, size) if covered is None else covered
    at = np.einsum("nk,nkc->nc", weights, lookup[face].astype(np.float64))
    result, faces = _filled(pieces, face, fetch(channels, at, wrap), size)
    return (result if values.ndim == 3 else result[..., 0]), faces


def carry_corners(
    values: Float[np.ndarray, "f 3 c"], uvs: Float[np.ndarray, "f 3 2"], size: int
) -> Float[np.ndarray, "h w c"]:
    """A texture of size² for `uvs` from the corner values `values`, interpolated over each face at the texels of
    `carry`."""
    pieces, face, weights = covered_texels(uvs, size)
    return _filled(
        pieces, face, np.einsum("nk,nkc->nc", weights.astype(np.float32), values[face].astype(np.float32)), size
    )[0]


def covered_texels(uvs: Float[np.ndarray, "f 3 2"], size: int) -> Covered:
    """The texels (row * size + column) whose centres a face covers, the first such face, and the centre's barycentric
    coordinates in it. UVs are v up and repeat."""
    spot = uvs.astype(np.float64) * [size, -size] + [0, size]  # y grows with the row
    face, texel = fragments(spot, size)
    owner = np.full(size * size, -1, np.int64)
    # Written in reverse order, so that the first face stays.
    owner[texel[::-1]] = np.arange(len(texel))[::-1]
    pieces = np.flatnonzero(owner >= 0)
    face = face[owner[pieces]]
    return pieces, face, texel_weights(spot[face], pieces, size)


def _filled(
    pieces: Int[np.ndarray, " n"], face: Int[np.ndarray, " n"], values: Float[np.ndarray, "n c"], size: int
) -> tuple[Float[np.ndarray, "h w c"], Int[np.ndarray, "h w"]]:
    """The texture with these values and faces at the texels `pieces`; all others take their nearest neighbour's
    value."""
    result = np.zeros((size * size, values.shape[1]), np.float32)
    result[pieces] = values
    faces = np.full(size * size, -1, np.int64)
    faces[pieces] = face
    return _spread(result.reshape(size, size, -1), faces.reshape(size, size) >= 0), faces.reshape(size, size)


def texel_weights(
    spot: Float[np.ndarray, "n 3 2"], texel: Int[np.ndarray, " n"], size: int
) -> Float[np.ndarray, "n 3"]:
    """Barycentric coordinates of a texel's centre in the triangle that covers it, in any tile."""
    centre = np.stack([texel % size, texel // size], axis=1) + 0.5
    a, b, c = spot[:, 0], spot[:, 1], spot[:, 2]
    lowest = np.minimum(np.minimum(a, b), c)
    centre += np.ceil((lowest - centre) / size) * size  # the copy inside the triangle's box
    area = _cross(b - a, c - a)
    area = np.where(area == 0, 1, area)
    w0, w1 = _cross(b - centre, c - centre) / area, _cross(c - centre, a - centre) / area
    return np.clip(np.stack([w0, w1, 1 - w0 - w1], axis=1), 0, 1)


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]


def wrapped(index: Int[np.ndarray, " n"], count: int, wrap: Wrap) -> Int[np.ndarray, " n"]:
    """The texel of `count` at `index`, which may be any integer."""
    if wrap == "clamp":
        return np.clip(index, 0, count - 1)
    if wrap == "mirror":
        folded = index % (2 * count)
        return np.minimum(folded, 2 * count - 1 - folded)
    return index % count


def fetch(
    values: Float[np.ndarray, "h w c"], uv: Float[np.ndarray, "n 2"], wrap: Wraps = REPEAT
) -> Float[np.ndarray, "n c"]:
    """Bilinear lookup, v up; `wrap` sets the values outside the unit square."""
    h, w = values.shape[:2]
    x, y = uv[:, 0] * w - 0.5, (1 - uv[:, 1]) * h - 0.5
    left, top = np.floor(x).astype(np.int64), np.floor(y).astype(np.int64)
    s, t = (x - left)[:, None].astype(np.float32), (y - top)[:, None].astype(np.float32)
    x0, x1 = wrapped(left, w, wrap[0]), wrapped(left + 1, w, wrap[0])
    y0, y1 = wrapped(top, h, wrap[1]), wrapped(top + 1, h, wrap[1])
    upper = values[y0, x0] * (1 - s) + values[y0, x1] * s
    lower = values[y1, x0] * (1 - s) + values[y1, x1] * s
    return upper * (1 - t) + lower * t


def _spread(values: Float[np.ndarray, "h w c"], covered: np.ndarray) -> Float[np.ndarray, "h w c"]:
    from scipy.ndimage import distance_transform_edt

    if covered.all() or not covered.any():
        return values
    row, column = np.asarray(distance_transform_edt(~covered, return_distances=False, return_indices=True))
    return values[row, column]


def turn_normals(
    normal: Float[np.ndarray, "h w 3"],
    face: Int[np.ndarray, "h w"],
    positions: Float[np.ndarray, "v 3"],
    faces: Int[np.ndarray, "f 3"],
    old: Float[np.ndarray, "f 3 2"],
    new: Float[np.ndarray, "f 3 2"],
) -> Float[np.ndarray, "h w 3"]:
    """Tangent-space normals converted from the frame of the old UVs to that of the new ones.

    Frames are taken per face (exact where UVs are conformal, which MikkTSpace's averages also assume); texels
    without a face, and faces without area in either set, stay unchanged.
    """
    tangent_old, bitangent_old = _frames(positions, faces, old)
    tangent_new, bitangent_new = _frames(positions, faces, new)
    rows = [[(n * o).sum(axis=1) for o in (tangent_old, bitangent_old)] for n in (tangent_new, bitangent_new)]
    rotation = np.moveaxis(np.array(rows), 2, 0)
    singular = ~np.isfinite(rotation).all(axis=(1, 2)) | (np.abs(np.linalg.det(np.nan_to_num(rotation))) < 0.5)
    rotation[singular] = np.eye(2)
    result = normal.copy()
    covered = face >= 0
    result[covered, :2] = np.einsum("nij,nj->ni", rotation[face[covered]], normal[covered][:, :2])
    return (result / np.linalg.norm(result, axis=2, keepdims=True)).astype(np.float32)


def _frames(
    positions: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"], uvs: Float[np.ndarray, "f 3 2"]
) -> tuple[np.ndarray, np.ndarray]:
    """Unit tangent (along u) of every face, and the bitangent; the sign of the UV area flips it."""
    corners, uv = positions[faces].astype(np.float64), uvs.astype(np.float64)
    e1, e2 = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    v1, v2 = uv[:, 1, 1] - uv[:, 0, 1], uv[:, 2, 1] - uv[:, 0, 1]
    sign = np.sign(signed_areas(uvs))[:, None]
    with np.errstate(invalid="ignore", divide="ignore"):
        tangent = (e1 * v2[:, None] - e2 * v1[:, None]) * sign
        tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
        normal = area_vectors(positions, faces)
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        return tangent, np.cross(normal, tangent) * sign
