"""The material table: one row of 8 float32 per texel, all texture sets one after the other, row by row.

Columns: albedo 3 (linear Rec.709), tilt 2 (x and y of the unit tangent-space normal), roughness, metallic, one spare.
The per-texel solver has the same columns without the spare one; the joint solver has those before metallic.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from mistyle.core.maps import Maps, rows_of

COLUMNS = 8
ALBEDO, TILT, ROUGHNESS, METALLIC = slice(0, 3), slice(3, 5), 5, 6
TILT_X, TILT_Y = 3, 4
SOLVED = slice(0, 7)  # unknowns of the per-texel solver
JOINT = slice(0, 6)  # unknowns of the joint solver, which fixes metallic
# An interpolated row holds the whole normal instead of its tilt.
NORMAL = slice(3, 6)
FETCHED_ROUGHNESS, FETCHED_METALLIC = 6, 7
# A tilt longer than sqrt(1 - this²) has no gradient along its length.
LEAST_Z = 0.05

MaterialTable = Float[np.ndarray, "a 8"]


def pack(maps: Sequence[Maps]) -> MaterialTable:
    """The table of texture sets' maps; normals of any length, z > 0."""
    rows = []
    for m in maps:
        tilt = m.normal[..., :2] / np.linalg.norm(m.normal, axis=-1, keepdims=True)
        parts = (m.albedo, tilt, m.roughness[..., None], m.metallic[..., None], np.zeros((*m.roughness.shape, 1)))
        rows.append(np.concatenate(parts, axis=-1, dtype=np.float32).reshape(-1, COLUMNS))
    return np.concatenate(rows)


def unpack(table: MaterialTable, sizes: Sequence[tuple[int, int]]) -> list[Maps]:
    """The inverse of `pack`; `known` is True everywhere."""
    result = []
    for part, size in zip(rows_of(sizes), sizes, strict=True):
        rows = table[part].reshape(*size, COLUMNS).astype(np.float32)
        tilt = rows[..., TILT]
        z = np.sqrt(np.maximum(1 - (tilt**2).sum(-1, keepdims=True), LEAST_Z**2))
        normal = np.concatenate([tilt, z], axis=-1)
        normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
        albedo, roughness, metallic = (np.ascontiguousarray(rows[..., k]) for k in (ALBEDO, ROUGHNESS, METALLIC))
        result.append(Maps(albedo, normal, roughness, metallic, np.ones(size, bool)))
    return result
