"""Wavefront OBJ with the MTL extension for physically based materials (map_Pr, map_Pm, norm): plain text."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from mistyle.core import names as safe
from mistyle.core.mesh import Mesh
from mistyle.core.rows import distinct
from mistyle.io.materialx import TexturedMaterial
from mistyle.io.store.atomic import atomic_write


def write_obj(
    path: Path,
    mesh: Mesh,
    positions: Float[np.ndarray, "v 3"],
    tiles: Sequence[int],
    looks: Sequence[TexturedMaterial],
    objects: tuple[Int[np.ndarray, " f"], Sequence[str]],
) -> None:
    """Write `path` and the .mtl beside it: the mesh with its own `positions`, one material per part.

    `objects` are the number of every face's object and the objects' names: each has its faces after an `o` of its own.

    Vertices keep their order; equal UVs and normals are shared. `tiles` are the parts' UDIM tiles, to which
    their UVs are moved. Texture names are relative to the folder.
    """
    uvs = mesh.corner_uvs.astype(np.float64)
    offset = np.array([[(t - 1001) % 10, (t - 1001) // 10] for t in tiles], float)
    uvs = uvs + offset[mesh.part][:, None]
    uv, uv_of = _shared(uvs.reshape(-1, 2))
    normal, normal_of = _shared(mesh.corner_normals.reshape(-1, 3).astype(np.float64))
    lines = [f"mtllib {path.with_suffix('.mtl').name}"]
    digits = _digits(positions)
    lines += [f"v {x:.{digits}g} {y:.{digits}g} {z:.{digits}g}" for x, y, z in positions.tolist()]
    lines += [f"vt {u:.9g} {v:.9g}" for u, v in uv.tolist()]
    lines += [f"vn {x:.7g} {y:.7g} {z:.7g}" for x, y, z in normal.tolist()]
    corners = np.stack([mesh.faces.reshape(-1), uv_of, normal_of], axis=1).reshape(-1, 3, 3) + 1
    object_of_face, names = objects
    order = np.lexsort((mesh.part, object_of_face))
    owner, part = object_of_face[order], mesh.part[order]
    starts = np.flatnonzero(np.r_[True, (np.diff(owner) != 0) | (np.diff(part) != 0)])
    titles = safe.distinct([_line(name) for name in names], key=str)
    for k, (start, stop) in enumerate(zip(starts, [*starts[1:], len(order)], strict=True)):
        if k == 0 or owner[start] != owner[start - 1]:
            lines.append(f"o {titles[owner[start]]}")
        lines.append(f"usemtl {looks[part[start]].title or looks[part[start]].name}")
        for face in corners[order[start:stop]].tolist():
            lines.append("f " + " ".join("/".join(map(str, corner)) for corner in face))
    atomic_write(path, ("\n".join(lines) + "\n").encode())
    atomic_write(path.with_suffix(".mtl"), _materials(looks).encode())


def _line(name: str) -> str:
    """A name that fits a line of OBJ: without control characters and without a backslash, which joins lines."""
    shown = "".join(c if c.isprintable() and c != "\\" else " " for c in name)
    return " ".join(shown.split()) or "object"


def _digits(positions: Float[np.ndarray, "v 3"]) -> int:
    """Digits that resolve the mesh's own size to eight or nine digits at any offset; 17 are all of a double."""
    size, reach = float(np.ptp(positions, axis=0).max()), float(np.abs(positions).max())
    far = int(np.log10(reach / size)) if reach > size > 0 else 0
    return min(9 + max(far - 1, 0), 17)


def _materials(looks: Sequence[TexturedMaterial]) -> str:
    lines = []
    for look in looks:
        lines += [
            f"newmtl {look.title or look.name}",
            "Kd 1 1 1",
            *([f"Ke {' '.join(f'{c:.6g}' for c in look.light.emission)}"] if any(look.light.emission) else []),
            "Pr 1",
            "Pm 1",
            f"map_Kd {look.albedo}",
            f"map_Pr {look.roughness}",
            f"map_Pm {look.metallic}",
            f"norm {look.normal}",
            "",
        ]
    return "\n".join(lines)


def _shared(rows: Float[np.ndarray, "n c"]) -> tuple[np.ndarray, np.ndarray]:
    """Distinct rows, and the index of each row among them."""
    rounded = np.round(rows, 9) + 0.0
    first, index = distinct(rounded)
    return rounded[first], index
