"""New vertex attributes for primitives of a user's glTF: old vertices keep their indices, copies are appended."""

import json
from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from mistyle.core.rows import corner_rows, distinct
from mistyle.geometry.tangents import mikktspace
from mistyle.io.gltf.glb import FAN, STRIP, TRIANGLES, Buffers, Builder, Tree, element_bytes, unit_normals, values


@dataclass(frozen=True)
class Patch:
    """A painted primitive of the file: its faces in the file's own vertex indices and winding, UVs and parts.

    `uvs` are per corner, v up. With `texcoord` >= 0 the file's own set of that number is used and stays unchanged;
    else `uvs` are written to the sets TEXCOORD_n of `fresh` (several, where gaps must be filled).
    """

    mesh: int
    primitive: int
    faces: Int[np.ndarray, "f 3"]
    uvs: Float[np.ndarray, "f 3 2"]
    part: Int[np.ndarray, " f"]
    material: int
    texcoord: int
    fresh: tuple[int, ...] = ()


def triangles(tree: Tree, buffers: Buffers, primitive: Tree) -> Int[np.ndarray, "f 3"] | None:
    """The triangles of a primitive, with strips and fans expanded as specified; None for points and lines."""
    mode = primitive.get("mode", TRIANGLES)
    if mode not in (TRIANGLES, STRIP, FAN):
        return None
    if "indices" in primitive:
        flat = values(tree, buffers, primitive["indices"]).reshape(-1).astype(np.int64)
    else:
        flat = np.arange(tree["accessors"][primitive["attributes"]["POSITION"]]["count"])
    if mode == TRIANGLES:
        return flat[: len(flat) // 3 * 3].reshape(-1, 3)
    i = np.arange(max(len(flat) - 2, 0))
    if mode == STRIP:
        return np.stack([flat[i], flat[i + 1 + i % 2], flat[i + 2 - i % 2]], axis=1)
    return np.stack([flat[i + 1], flat[i + 2], np.broadcast_to(flat[:1], i.shape)], axis=1)


def rewrite(builder: Builder, buffers: Buffers, patches: Sequence[Patch]) -> dict[tuple[int, int], np.ndarray]:
    """Give the painted primitives TANGENT and, where needed, NORMAL and new TEXCOORD sets.

    Returns the new vertex indices of each patch's faces by (mesh, primitive). The specification shades a file without
    normals flat; the added NORMAL encodes this, since TANGENT needs it. Tangents of morph targets are kept with the
    file's own texture coordinates and dropped with new ones, which they do not match.
    """
    families = _families(builder.tree)
    owners = _owners(builder.tree, families)
    by_primitive = {(p.mesh, p.primitive): p for p in patches}
    result: dict[tuple[int, int], np.ndarray] = {}
    for number, members in enumerate(families):
        pool = [by_primitive[m] for m in members if m in by_primitive]
        if pool:
            result |= _rewrite_family(_Family(builder, buffers, number, members, pool, owners))
    return result


def _families(tree: Tree) -> list[list[tuple[int, int]]]:
    """(mesh, primitive) of primitives that share all their vertices (attributes and morph targets of one mesh)."""
    groups: dict[str, list[tuple[int, int]]] = defaultdict(list)
    for m, mesh in enumerate(tree["meshes"]):
        for n, primitive in enumerate(mesh["primitives"]):
            shared = [m, primitive["attributes"], primitive.get("targets", [])]
            groups[json.dumps(shared, sort_keys=True)].append((m, n))
    return list(groups.values())


def _owners(tree: Tree, families: list[list[tuple[int, int]]]) -> dict[int, Counter[int]]:
    """Users of each accessor with counts: indices of families, -1 for skins, animations and instancing."""
    owners: dict[int, Counter[int]] = defaultdict(Counter)
    for number, members in enumerate(families):
        primitives = [tree["meshes"][m]["primitives"][n] for m, n in members]
        for group in (primitives[0]["attributes"], *primitives[0].get("targets", [])):
            for index in group.values():
                owners[index][number] += 1
        for primitive in primitives:
            if "indices" in primitive:
                owners[primitive["indices"]][number] += 1
    external = [s["inverseBindMatrices"] for s in tree.get("skins", []) if "inverseBindMatrices" in s]
    samplers = [s for a in tree.get("animations", []) for s in a.get("samplers", [])]
    external += [s[k] for s in samplers for k in ("input", "output") if k in s]
    for node in tree.get("nodes", []):
        external += node.get("extensions", {}).get("EXT_mesh_gpu_instancing", {}).get("attributes", {}).values()
    for index in external:
        owners[index][-1] += 1
    return owners


def _rewrite_family(family: "_Family") -> dict[tuple[int, int], np.ndarray]:
    tree, pool = family.builder.tree, family.pool
    attributes = family.primitives[0]["attributes"]
    count = tree["accessors"][attributes["POSITION"]]["count"]
    new = _corner_values(tree, family.buffers, pool, attributes)
    corner_vertex = np.concatenate([p.faces.reshape(-1) for p in pool])
    vertex, origin, chosen = split(corner_vertex, np.concatenate(list(new.values()), axis=1), count)
    renamed: dict[str, int] = {}
    if len(origin):
        renamed = {name: family.extended(index, origin) for name, index in attributes.items() if name not in new}
    for name, array in new.items():
        full = _filler(name, count + len(origin))
        full[vertex[chosen]] = array[chosen]
        renamed[name] = family.place(attributes.get(name), family.builder.attribute(full))
    for n in sorted({n for p in pool for n in p.fresh}):
        renamed[f"TEXCOORD_{n}"] = renamed["fresh"]
    renamed.pop("fresh", None)
    for primitive in family.primitives:
        primitive["attributes"] |= renamed
        for target in primitive.get("targets", []):
            if any(p.fresh for p in pool):
                target.pop("TANGENT", None)
            if len(origin):
                target |= {name: family.extended(index, origin) for name, index in target.items()}
    return family.point_at(vertex, count, bool(len(origin)))


def _corner_values(tree: Tree, buffers: Buffers, pool: Sequence[Patch], attributes: Tree) -> dict[str, np.ndarray]:
    """New attributes at every corner of the pool, in the file's conventions: name to (corners, 2..4) float32."""
    positions = values(tree, buffers, attributes["POSITION"]).astype(np.float32)
    with_normals = "NORMAL" in attributes
    old = unit_normals(values(tree, buffers, attributes["NORMAL"])) if with_normals else None
    normal, tangent, fresh = [], [], []
    for patch in pool:
        flat = patch.faces.reshape(-1)
        corner_normals = old[flat] if old is not None else _flat_normals(positions, patch.faces)
        if patch.texcoord >= 0:
            file_uvs = values(tree, buffers, attributes[f"TEXCOORD_{patch.texcoord}"])[flat].astype(np.float32)
        else:
            u, v = patch.uvs.reshape(-1, 2).astype(np.float32).T
            file_uvs = np.stack([u, 1 - v], axis=1)
        # glTF's tangents are for v up; -v has the same differences as 1 - v, without its rounding.
        up = file_uvs * np.array([1, -1], np.float32)
        corners = np.arange(len(flat)).reshape(-1, 3)
        tangent.append(mikktspace(positions[flat], corner_normals, up, corners).reshape(-1, 4))
        normal.append(corner_normals)
        fresh.append(file_uvs)
    new = {"TANGENT": np.concatenate(tangent)}
    if not with_normals:
        new["NORMAL"] = np.concatenate(normal)
    if any(p.fresh for p in pool):
        new["fresh"] = np.concatenate(fresh)
    return new


def _flat_normals(positions: Float[np.ndarray, "n 3"], faces: Int[np.ndarray, "f 3"]) -> Float[np.ndarray, "c 3"]:
    a, b, c = (positions[faces[:, k]].astype(np.float64) for k in range(3))
    normal = np.cross(b - a, c - a)
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    unit = np.where(length > 0, normal / np.where(length > 0, length, 1), [0, 1, 0])
    return np.repeat(unit, 3, axis=0).astype(np.float32)


def split(
    corner_vertex: Int[np.ndarray, " c"], keys: Float[np.ndarray, "c k"], count: int
) -> tuple[Int[np.ndarray, " c"], Int[np.ndarray, " e"], Int[np.ndarray, " m"]]:
    """Vertices for corners, so that equal vertices have equal keys.

    Returns the new vertex of every corner, the old vertex of every appended one (indices from `count` on), and one
    corner of every vertex in use. One key of each old vertex keeps its index.
    """
    rows = corner_rows(corner_vertex, keys)
    chosen, inverse = distinct(rows)
    old = rows[chosen, 0].astype(np.int64)
    again = np.r_[False, old[1:] == old[:-1]]
    number = np.where(again, count + np.cumsum(again) - 1, old)
    return number[inverse], old[again], chosen


def _filler(name: str, count: int) -> np.ndarray:
    """Values for vertices that no painted face uses (those of lines, or unused ones)."""
    default = {"TANGENT": [1, 0, 0, 1], "NORMAL": [0, 1, 0], "fresh": [0, 0]}[name]
    return np.tile(np.array(default, np.float32), (count, 1))


class _Family:
    """All primitives of a mesh that use the same vertices, painted or not, and their exclusive accessors."""

    def __init__(self, builder: Builder, buffers: Buffers, number: int, members, pool: list[Patch], owners) -> None:
        self.builder, self.buffers, self.number, self.pool, self.owners = builder, buffers, number, pool, owners
        self.primitives = [builder.tree["meshes"][m]["primitives"][n] for m, n in members]
        self.replacements: dict[int, int] = {}

    def place(self, old: int | None, new: int) -> int:
        """Move the accessor just added (`new` is the last) to the index of the one that it replaces, if that has no
        other user. Returns its index."""
        if old is None:
            return new
        users = self.owners[old]
        if set(users) == {self.number} and (users[self.number] == 1 or old in self.replacements):
            users[-1] += 1  # its index is in use now
            self.builder.tree["accessors"][old] = self.builder.tree["accessors"].pop()
            return old
        users -= Counter({self.number: 1})
        return new

    def extended(self, old: int, origin: np.ndarray) -> int:
        """The index of the accessor with the appended vertices' copies."""
        if old not in self.replacements:
            elements = element_bytes(self.builder.tree, self.buffers, old)
            like = self.builder.tree["accessors"][old]
            new = self.builder.raw_attribute(np.concatenate([elements, elements[origin]]), like)
            self.replacements[old] = new
            self.replacements[old] = self.place(old, new)
        return self.replacements[old]

    def point_at(self, vertex: np.ndarray, count: int, more: bool) -> dict[tuple[int, int], np.ndarray]:
        """Point the painted primitives' indices at the new vertices; equal ones stay unchanged."""
        end, result = 0, {}
        for patch in self.pool:
            primitive = self.builder.tree["meshes"][patch.mesh]["primitives"][patch.primitive]
            start, end = end, end + patch.faces.size
            faces = result[patch.mesh, patch.primitive] = vertex[start:end].reshape(-1, 3)
            if (faces != patch.faces).any():
                index = self.place(primitive.get("indices"), self.builder.indices(faces))
                primitive |= {"indices": index, "mode": TRIANGLES}
        for primitive in self.primitives:
            if more and "indices" not in primitive:
                primitive["indices"] = self.builder.indices(np.arange(count))
        return result
