"""Moved vertices in a user's glTF: POSITION and NORMAL of the moved primitives, in the space of each vertex.

The scene shows world = place x local, where a place is the node's matrix or a vertex's weighted joint matrices. So a
displacement d of the world becomes the inverse of the place's linear part, times d. Joints, weights, morph targets,
indices and texture coordinates stay. Nodes must not share a moved mesh, since each would need another shape.
"""

from collections import Counter
from typing import Any

import numpy as np
from jaxtyping import Float

from mistyle.core.asset import Asset, Primitive
from mistyle.core.errors import UsageError
from mistyle.io.gltf.glb import Buffers, Tree, unit_normals, values
from mistyle.io.gltf.pose import Places, joint_matrices, skinned
from mistyle.io.gltf.read import world_matrices


def refuse_shared(asset: Asset) -> None:
    """UsageError where several nodes or instances show one mesh of a glTF file."""
    if asset.source.kind not in ("glb", "gltf"):
        return
    places = {(p.mesh, p.primitive, p.first_vertex) for p in asset.source.primitives}
    uses = Counter((mesh, primitive) for mesh, primitive, _ in places)
    shared = sorted({mesh for (mesh, _), count in uses.items() if count > 1})
    if shared:
        raise UsageError(
            f"--displace: {asset.source.path.name} shows mesh {shared[0]} in several places; expected one, since each "
            "place would need its own shape. Make the meshes single-user and export again, or leave out --displace"
        )


def displaced_buffers(tree: Tree, buffers: Buffers, asset: Asset) -> list[bytes | memoryview]:
    """Point the moved primitives of `tree` at new POSITION and NORMAL accessors; returns the buffers with the new data
    as a last one."""
    data, views = bytearray(), len(buffers)
    world, moved = world_matrices(tree), asset.source.displacement
    assert moved is not None
    done: dict[tuple[int, int], int] = {}
    for p in asset.source.primitives:
        primitive = tree["meshes"][p.mesh]["primitives"][p.primitive]
        old = primitive["attributes"]["POSITION"]
        if (p.mesh, old) in done or old in done.values():
            continue
        local = values(tree, buffers, old)
        rows = slice(p.first_vertex, p.first_vertex + len(local))
        if not moved[rows].any():
            continue
        places = _places(tree, buffers, asset, p, primitive, world)
        inverse = np.linalg.pinv(places[..., :3, :3])
        step = np.einsum("...ij,...j->...i", inverse, moved[rows])
        positions = np.where(moved[rows].any(axis=1, keepdims=True), local + step, local).astype("<f4")
        new = _added(tree, data, views, positions)
        tree["accessors"][new] |= {"min": positions.min(axis=0).tolist(), "max": positions.max(axis=0).tolist()}
        done[p.mesh, old] = new
        normals = _normals(tree, buffers, asset, rows, primitive, places)
        own = primitive["attributes"].get("NORMAL")
        turned = None if normals is None else _added(tree, data, views, normals)
        for other in tree["meshes"][p.mesh]["primitives"]:
            if other["attributes"].get("POSITION") == old:
                other["attributes"]["POSITION"] = new
                if turned is not None and other["attributes"].get("NORMAL") == own:
                    other["attributes"]["NORMAL"] = turned
    if not data:
        return list(buffers)
    tree.setdefault("buffers", []).append({"byteLength": len(data)})
    return [*buffers, bytes(data)]


def _places(
    tree: Tree, buffers: Buffers, asset: Asset, p: Primitive, primitive: Tree, world: list[np.ndarray]
) -> Places:
    node = tree["nodes"][p.node]
    if "skin" not in node:
        return world[p.node]
    joints, root = joint_matrices(tree, buffers, node["skin"], world, asset.source.path)
    return skinned(tree, buffers, joints, primitive, joints[root], asset.source.path)


def _normals(
    tree: Tree, buffers: Buffers, asset: Asset, rows: slice, primitive: Tree, places: Places
) -> Float[np.ndarray, "n 3"] | None:
    """The file's normals with those of the mesh's corners in local space; None for a file without normals."""
    if "NORMAL" not in primitive["attributes"]:
        return None
    result = values(tree, buffers, primitive["attributes"]["NORMAL"]).astype(np.float64)
    vertex = asset.mesh.faces.reshape(-1)
    corners = np.flatnonzero((vertex >= rows.start) & (vertex < rows.stop))
    near = np.zeros(len(asset.mesh.positions), bool)
    assert asset.source.displacement is not None
    moved: Any = asset.source.displacement.any(axis=1)
    faces = moved[asset.mesh.faces].any(axis=1)
    near[asset.mesh.faces[faces].reshape(-1)] = True
    corners = corners[near[vertex[corners]]]
    at = vertex[corners] - rows.start
    linear = places[..., :3, :3] if places.ndim == 2 else places[at, :3, :3]
    normals = asset.mesh.corner_normals.reshape(-1, 3)[corners].astype(np.float64)
    result[at] = np.einsum("...ji,...j->...i", linear, normals)
    return unit_normals(result)


def _added(tree: Tree, data: bytearray, buffer: int, array: np.ndarray) -> int:
    """A new accessor of float32 vectors over the bytes appended to `data`, the content of buffer `buffer`."""
    raw = np.ascontiguousarray(array, "<f4").tobytes()
    tree.setdefault("bufferViews", []).append(
        {"buffer": buffer, "byteOffset": len(data), "byteLength": len(raw), "target": 34962}
    )
    data += raw
    item = {"bufferView": len(tree["bufferViews"]) - 1, "componentType": 5126, "count": len(array), "type": "VEC3"}
    tree["accessors"].append(item)
    return len(tree["accessors"]) - 1
