"""Vertex positions of a glTF file at rest: morph weights, skinning by the joints' nodes, instances of a mesh."""

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from mistyle.io.gltf.check import AGAIN
from mistyle.io.gltf.glb import Buffers, values
from mistyle.io.gltf.shading import number
from mistyle.io.sandbox.bounds import refuse

Tree = dict[str, Any]
Places = Float[np.ndarray, "*n 4 4"]  # one matrix for all vertices, or one for each
INSTANCING = "EXT_mesh_gpu_instancing"
MAX_WEIGHT = 1e3
SAME = 1e-5  # joint matrices that differ by less, relative to their size, are equal


def posed(local: Float[np.ndarray, "v 3"], places: Places) -> Float[np.ndarray, "v 3"]:
    """Positions in world space; for an identity transform the file's own float32, half of the bytes."""
    if places.ndim == 3:
        return np.einsum("nij,nj->ni", places[:, :3, :3], local.astype(np.float64)) + places[:, :3, 3]
    if local.dtype == np.float32 and np.array_equal(places, np.eye(4)):
        return local
    return local.astype(np.float64) @ places[:3, :3].T + places[:3, 3]


def turned(vectors: Float[np.ndarray, "v 3"], places: Places) -> Float[np.ndarray, "v 3"]:
    """Normals in world space, of any length: by the inverse transpose."""
    if places.ndim == 3:
        a, b, c = np.moveaxis(places[:, :3, :3], 1, 0)
        cofactors = np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)], axis=1)
        sign = np.sign(np.einsum("ni,ni->n", a, cofactors[:, 0]))
        return np.einsum("nij,nj->ni", cofactors, vectors) * np.where(sign == 0, 1, sign)[:, None]
    if np.array_equal(places[:3, :3], np.eye(3)):
        return vectors
    return vectors @ np.linalg.pinv(places[:3, :3])  # the inverse transpose, for row vectors


def mirrors(places: Places) -> bool:
    """Whether the transforms mirror space (by majority of vertices)."""
    return bool(np.median(np.linalg.det(places[..., :3, :3])) < 0)


def morphed(
    tree: Tree, buffers: Buffers, node: Tree, primitive: Tree, name: str, base: np.ndarray
) -> Float[np.ndarray, "v 3"]:
    """An attribute (POSITION or NORMAL) at the morph weights of the node, else of its mesh (glTF 2.0, 3.7.2.2)."""
    entry = node.get("weights") or tree["meshes"][node["mesh"]].get("weights")
    weights = entry if isinstance(entry, list) else []
    result = base
    for weight, target in zip(weights, primitive.get("targets", []), strict=False):
        factor = number({"weight": weight}, "weight", 0.0, -MAX_WEIGHT, MAX_WEIGHT)
        if factor == 0 or name not in target:
            continue
        step = values(tree, buffers, target[name])
        if step.shape == base.shape:
            result = result + factor * step.astype(np.float64)
    return result


def skinned(
    tree: Tree, buffers: Buffers, joints: Float[np.ndarray, "j 4 4"], primitive: Tree, rest: Places, path: Path
) -> Places:
    """The matrices of a primitive's vertices: the weighted sum of their joints', `rest` for vertices without any. One
    matrix where all used joints have the same one, as in the bind pose."""
    attributes = primitive["attributes"]
    total = np.zeros((tree["accessors"][attributes["POSITION"]]["count"], 4, 4))
    sums = np.zeros(len(total))
    used: set[int] = set()
    for k in range(8):
        if f"JOINTS_{k}" not in attributes or f"WEIGHTS_{k}" not in attributes:
            break
        which = _quadruples(tree, buffers, attributes[f"JOINTS_{k}"], path).astype(np.int64)
        weight = np.nan_to_num(_quadruples(tree, buffers, attributes[f"WEIGHTS_{k}"], path).astype(np.float64))
        which = np.where(weight > 0, which, 0)
        if which.min(initial=0) < 0 or which.max(initial=0) >= len(joints):
            raise refuse(path, f"a vertex of joint {which.max()}", f"0 to {len(joints) - 1}", AGAIN)
        used |= set(np.unique(which[weight > 0]).tolist())
        for corner in range(4):
            share = np.clip(weight[:, corner], 0, None)
            total += share[:, None, None] * joints[which[:, corner]]
            sums += share
    chosen = joints[sorted(used)]
    if not used or np.abs(chosen - rest).max() <= SAME * max(float(np.abs(rest).max()), 1e-12):
        return rest
    return np.where(sums[:, None, None] > 0, total / np.where(sums > 0, sums, 1)[:, None, None], rest)


def joint_matrices(
    tree: Tree, buffers: Buffers, skin: int, world: list[np.ndarray], path: Path
) -> tuple[Float[np.ndarray, "j 4 4"], int]:
    """World matrix times inverse bind matrix of every joint, and the index of the root joint."""
    joints = tree["skins"][skin]["joints"]
    below = {c for j in joints for c in tree["nodes"][j].get("children", [])}
    root = next((k for k, j in enumerate(joints) if j not in below), 0)
    inverse = np.broadcast_to(np.eye(4), (len(joints), 4, 4))
    if "inverseBindMatrices" in tree["skins"][skin]:
        accessor = tree["skins"][skin]["inverseBindMatrices"]
        entry = tree["accessors"][accessor]
        if entry["type"] != "MAT4" or entry["componentType"] != 5126 or entry["count"] < len(joints):
            raise refuse(path, "inverse bind matrices of another kind", "one float MAT4 per joint", AGAIN)
        flat = values(tree, buffers, accessor)[: len(joints)].astype(np.float64)
        inverse = np.swapaxes(flat.reshape(-1, 4, 4), 1, 2)
    return np.stack([world[j] for j in joints]) @ inverse, root


def instances(tree: Tree, buffers: Buffers, node: Tree, notes: list[str]) -> list[Float[np.ndarray, "4 4"]]:
    """The matrices of a node's instances relative to it; the identity where it has none."""
    from scipy.spatial.transform import Rotation

    entry = node.get("extensions", {}).get(INSTANCING)
    if entry is None:
        return [np.eye(4)]
    attributes = entry.get("attributes") if isinstance(entry, dict) else None
    kinds = {"TRANSLATION": "VEC3", "ROTATION": "VEC4", "SCALE": "VEC3"}
    indices = {name: (attributes or {}).get(name) for name in kinds}
    known, count = tree.get("accessors", []), None
    arrays: dict[str, np.ndarray] = {}
    for name, index in indices.items():
        if index is None:
            continue
        fits = isinstance(index, int) and 0 <= index < len(known) and known[index]["type"] == kinds[name]
        if not fits or known[index]["count"] != (count or known[index]["count"]):
            notes.append(f"Instances ({INSTANCING}) whose {name} cannot be used were read once.")
            return [np.eye(4)]
        arrays[name], count = values(tree, buffers, index).astype(np.float64), known[index]["count"]
    if count is None:
        return [np.eye(4)]
    places = np.tile(np.eye(4), (count, 1, 1))
    if "ROTATION" in arrays:
        turns = arrays["ROTATION"]
        length = np.linalg.norm(turns, axis=1, keepdims=True)
        places[:, :3, :3] = Rotation.from_quat(np.where(length > 0, turns, [0, 0, 0, 1])).as_matrix()
    places[:, :3, :3] *= arrays.get("SCALE", np.ones((count, 3)))[:, None, :]
    places[:, :3, 3] = arrays.get("TRANSLATION", np.zeros((count, 3)))
    return list(places)


def _quadruples(tree: Tree, buffers: Buffers, accessor: int, path: Path) -> Int[np.ndarray, "v 4"] | np.ndarray:
    if tree["accessors"][accessor]["type"] != "VEC4":
        raise refuse(path, f"joints of {tree['accessors'][accessor]['type']}", "VEC4", AGAIN)
    return values(tree, buffers, accessor)
