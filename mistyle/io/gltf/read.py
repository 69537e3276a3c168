"""Reader of glTF: triangles with node transforms, posed skins, morphs, instances, strips, fans and materials."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from mistyle.core.asset import Primitive, Shading
from mistyle.geometry.normals import area_vectors
from mistyle.io.gltf.check import AGAIN, load_gltf
from mistyle.io.gltf.glb import Buffers, values
from mistyle.io.gltf.infos import base_set, sees_through, wanted_sets
from mistyle.io.gltf.materials import read_material
from mistyle.io.gltf.pose import INSTANCING, instances, joint_matrices, mirrors, morphed, posed, skinned, turned
from mistyle.io.gltf.variants import variant_notes
from mistyle.io.gltf.vertices import triangles
from mistyle.io.images.read import Budget
from mistyle.io.meshes.parsed_mesh import Corners, Indexed, Raw, RawMaterial
from mistyle.io.meshes.polygons import check_indices, check_positions, too_many
from mistyle.io.sandbox.bounds import refuse

Tree = dict[str, Any]
MAX_INSTANCED = 500_000  # faces up to which all instances of a node are read


@dataclass(frozen=True)
class _PrimitivePiece:
    """One primitive under one node; `uvs` are those of its base set."""

    node: int
    mesh: int
    primitive: int
    material: int
    texcoord: int
    first_vertex: int
    faces: np.ndarray
    normals: Corners
    uvs: Corners | None
    other_uvs: dict[int, np.ndarray]
    colours: Corners | None
    alphas: Corners | None


@dataclass(frozen=True)
class _Place:
    """A primitive's vertices in world space: their first index, their positions and their matrices."""

    node: int
    start: int
    positions: np.ndarray
    places: np.ndarray


def read_gltf(path: Path, max_faces: int) -> Indexed:
    """Triangles of the default scene (of all nodes where there is none), in node order and file order.

    Positions are in world space, node transforms applied. A skinned mesh has the pose of its joints' nodes: its own
    node's transform is ignored (glTF 2.0, 3.7.3.3). Morph targets apply with the file's weights. Points, lines, hidden
    nodes (KHR_node_visibility) and nodes of zero scale are dropped with a note. Faces without NORMAL are flat, as the
    specification demands.
    """
    notes: list[str] = []
    tree, buffers = load_gltf(path, notes.append)
    with np.errstate(over="ignore", invalid="ignore"):  # transforms may overflow; infinite results are refused
        pieces, positions = _pieces(tree, buffers, path, max_faces, notes)
    if not pieces:
        raise refuse(
            path,
            "no triangles in its scene",
            "at least one triangle",
            "Export the mesh itself, visible and as triangles",
        )
    used = sorted({p.material for p in pieces})
    counts = [len(p.faces) for p in pieces]
    # The smallest integer type: the array is sent between processes.
    kind = np.min_scalar_type(-len(used))
    material = np.repeat(np.array([used.index(p.material) for p in pieces], kind), counts)
    materials = _materials(tree, buffers, path, pieces, used, notes)
    notes += variant_notes(tree, set(used))
    starts = np.cumsum([0, *counts])
    primitives = tuple(
        Primitive(
            p.node, p.mesh, p.primitive, int(a), int(b), p.material, p.texcoord, -1, p.first_vertex, _name(tree, p.node)
        )
        for p, a, b in zip(pieces, starts[:-1], starts[1:], strict=True)
    )
    faces = np.concatenate([p.faces for p in pieces])
    raw = Raw(
        kind="glb" if path.suffix.lower() == ".glb" else "gltf",
        positions=np.concatenate(positions),
        faces=faces,
        normals=None,
        uvs=None,
        material=material,
        materials=materials,
        primitives=primitives,
        twin=_twins(pieces, starts),
        notes=tuple(dict.fromkeys(notes)),
    )
    uvs = _joined([p.uvs or _same_for_all(len(p.faces), [np.nan] * 2) for p in pieces], faces)
    return Indexed(
        raw,
        _joined([p.normals for p in pieces], faces),
        uvs if np.isfinite(uvs.values).any() else None,
        _factors([p.colours for p in pieces], counts, 3, faces),
        _factors([p.alphas for p in pieces], counts, 1, faces),
    )


def _materials(
    tree: Tree, buffers: Buffers, path: Path, pieces: list[_PrimitivePiece], used: list[int], notes: list[str]
) -> tuple[RawMaterial, ...]:
    """The materials `used` by the pieces, by their indices in the file; -1 is a primitive without one."""
    budget = Budget(path)
    materials = tuple(read_material(tree, buffers, path, m, _other_sets(pieces, m), budget) for m in used)
    if -1 not in used:
        return materials
    notes.append(
        "A primitive has no material: it is drawn matt and grey, as Blender draws it, and painted as a white "
        "dielectric of roughness 0.5; glTF's default is white rough metal."
    )
    if any(p.material < 0 and p.colours is not None for p in pieces):
        # Vertex colours are a statement, which glTF's default material shows.
        materials = (replace(materials[0], shading=Shading(stated="colour")), *materials[1:])
    return materials


def _factors(
    pieces: list[Corners | None], counts: list[int], width: int, faces: Int[np.ndarray, "f 3"]
) -> Corners | None:
    """Concatenated factors of all pieces' corners, 1 for pieces without; None where every factor is 1."""
    if not any(corners is not None and (corners.values != 1).any() for corners in pieces):
        return None
    ones = [1.0] * width
    return _joined([c or _same_for_all(count, ones) for c, count in zip(pieces, counts, strict=True)], faces)


def _same_for_all(faces: int, values: list[float]) -> Corners:
    return Corners(np.array([values], np.float32), np.zeros((faces, 3), np.int32))


def _joined(corners: list[Corners], faces: Int[np.ndarray, "f 3"]) -> Corners:
    """Concatenated corners. Indices equal to `faces` are returned as that array, which is then sent only once."""
    starts = np.cumsum([0, *(len(c.values) for c in corners)])
    index = np.concatenate([c.index + np.int32(start) for c, start in zip(corners, starts[:-1], strict=True)])
    same = np.array_equal(index, faces)
    return Corners(np.concatenate([c.values for c in corners]), faces if same else index)


def _pieces(
    tree: Tree, buffers: Buffers, path: Path, max_faces: int, notes: list[str]
) -> tuple[list[_PrimitivePiece], list[np.ndarray]]:
    pieces: list[_PrimitivePiece] = []
    positions: list[np.ndarray] = []
    world = world_matrices(tree)
    faces = vertices = 0
    nodes = [node for node in _scene_nodes(tree, notes) if "mesh" in tree["nodes"][node]]
    later = sum(_corner_count(tree, tree["nodes"][node]) for node in nodes) // 3  # faces, one instance a node
    for node in nodes:
        entry = tree["nodes"][node]
        later -= _corner_count(tree, entry) // 3
        matrix, joints = world[node], None
        if "skin" in entry:
            joints, root = joint_matrices(tree, buffers, entry["skin"], world, path)
            matrix = joints[root]
            notes.append("A skinned mesh was read in the pose of its joints; skin and animations stay in the GLB.")
        if not np.isfinite(matrix if joints is None else joints).all():
            raise refuse(path, f"node {node} with a transform that is not finite", "finite numbers", AGAIN)
        if _flattened(matrix):
            notes.append("Nodes that are scaled to a point or a line were left out; they stay in the GLB.")
            continue
        limit = min(MAX_INSTANCED, max_faces - later)
        for instance in _instances(tree, buffers, entry, (faces, limit), notes):
            placed: dict[str, _Place] = {}
            for number, primitive in enumerate(tree["meshes"][entry["mesh"]]["primitives"]):
                _check_counts(tree, primitive, max_faces, path)
                index = _indices(tree, buffers, primitive, path)
                if index is None or "POSITION" not in primitive["attributes"] or len(index) == 0:
                    notes.append("Points and lines were left out.")
                    continue
                faces += len(index)
                too_many(faces, max_faces, path)
                # Primitives that share their vertices share the positions as well.
                key = _vertices_of(primitive)
                if key not in placed:
                    places = matrix @ instance
                    if joints is not None:
                        places = skinned(tree, buffers, joints, primitive, matrix, path)
                    placed[key] = _place(tree, buffers, path, node, primitive, vertices, places)
                    positions.append(placed[key].positions)
                    vertices += len(positions[-1])
                    too_many(vertices, 3 * max_faces, path, "vertices")
                pieces.append(_piece(tree, buffers, path, placed[key], number, index, notes))
    return pieces, positions


def _place(
    tree: Tree, buffers: Buffers, path: Path, node: int, primitive: Tree, start: int, places: np.ndarray
) -> _Place:
    local = _vectors(tree, buffers, primitive["attributes"]["POSITION"], 3, path)
    at = posed(morphed(tree, buffers, tree["nodes"][node], primitive, "POSITION", local), places)
    check_positions(at, path)
    return _Place(node, start, at, places)


def _vertices_of(primitive: Tree) -> str:
    """A key of a primitive's vertex positions: their accessors' indices."""
    attributes = primitive["attributes"].items()
    own = sorted((n, a) for n, a in attributes if n == "POSITION" or n.startswith(("JOINTS_", "WEIGHTS_")))
    return str([own, [target.get("POSITION") for target in primitive.get("targets", [])]])


def _corner_count(tree: Tree, node: Tree) -> int:
    """The corners of one instance of a node's mesh."""
    primitives = [p for p in tree["meshes"][node["mesh"]]["primitives"] if "POSITION" in p["attributes"]]
    return sum(tree["accessors"][p.get("indices", p["attributes"]["POSITION"])]["count"] for p in primitives)


def _instances(
    tree: Tree, buffers: Buffers, node: Tree, count: tuple[int, int], notes: list[str]
) -> list[Float[np.ndarray, "4 4"]]:
    """The matrices of a node's instances, as many as fit and at least the first.

    `count` is the number of faces that were read, and the number up to which instances are.
    """
    matrices = instances(tree, buffers, node, notes)
    if len(matrices) <= 1 or "skin" in node:
        return matrices[:1]
    corners, (faces, limit) = _corner_count(tree, node), count
    fit = min(max(3 * (limit - faces) // max(corners, 1), 1), len(matrices))
    if fit < len(matrices):
        cause = "a fixed limit" if limit == MAX_INSTANCED else "by read.max_faces"
        notes.append(
            f"Only the first {fit} of {len(matrices)} instances ({INSTANCING}) of a mesh with {corners // 3} faces "
            f"were read: instances are read up to {max(limit, 0)} faces of the scene ({cause}). All show the same "
            "texels."
        )
    return matrices[:fit]


def _name(tree: Tree, node: int) -> str:
    """A node's name, that of its mesh, or ""."""
    entry = tree["nodes"][node]
    return str(entry.get("name") or tree["meshes"][entry["mesh"]].get("name") or "")


def _flattened(matrix: Float[np.ndarray, "4 4"]) -> bool:
    """Whether a transform collapses all areas to zero."""
    first, second, _ = np.linalg.svd(matrix[:3, :3], compute_uv=False)
    return bool(second <= 1e-9 * first)


def _piece(
    tree: Tree, buffers: Buffers, path: Path, where: _Place, number: int, index, notes: list[str]
) -> _PrimitivePiece:
    """One primitive's corners in world space, v up; the winding is flipped where the node mirrors space."""
    node = tree["nodes"][where.node]
    primitive = tree["meshes"][node["mesh"]]["primitives"][number]
    attributes = primitive["attributes"]
    count = tree["accessors"][attributes["POSITION"]]["count"]
    check_indices(index, count, path, "vertex")
    index = index.astype(np.int32)
    if mirrors(where.places):
        index = index[:, [0, 2, 1]]
    if "NORMAL" in attributes:
        vectors = _vectors(tree, buffers, attributes["NORMAL"], 3, path).astype(np.float64)
        vectors = turned(morphed(tree, buffers, node, primitive, "NORMAL", vectors), where.places)
        corner = index
    else:
        notes.append("A primitive has no normals: its faces are shaded flat, as glTF demands.")
        vectors = area_vectors(where.positions, index)
        corner = np.repeat(np.arange(len(index), dtype=np.int32)[:, None], 3, axis=1)
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    normals = Corners((vectors / np.where(length > 0, length, 1)).astype(np.float32), corner)
    sets = {
        n: Corners(_texcoords(tree, buffers, attributes[f"TEXCOORD_{n}"], path), index)
        for n in wanted_sets(tree, primitive.get("material"))
        if f"TEXCOORD_{n}" in attributes
    }
    base = base_set(tree, primitive.get("material"))
    colours = _colours(tree, buffers, attributes["COLOR_0"], path) if "COLOR_0" in attributes else None
    through = "material" in primitive and sees_through(tree, primitive["material"])
    return _PrimitivePiece(
        node=where.node,
        mesh=node["mesh"],
        primitive=number,
        material=primitive.get("material", -1),
        texcoord=base if base in sets else -1,
        first_vertex=where.start,
        faces=index + np.int32(where.start),
        normals=normals,
        uvs=sets.get(base),
        other_uvs={n: uvs.finished() for n, uvs in sets.items() if n != base},
        colours=None if colours is None else Corners(colours[:, :3], index),
        alphas=Corners(colours[:, 3:], index) if colours is not None and colours.shape[1] == 4 and through else None,
    )


def _check_counts(tree: Tree, primitive: Tree, max_faces: int, path: Path) -> None:
    """Check counts before decoding: accessors without a buffer view can declare any number of zeros in a few bytes."""
    for name, accessor in primitive["attributes"].items():
        too_many(tree["accessors"][accessor]["count"], 3 * max_faces, path, f"elements of {name[:40]}")
    if "indices" in primitive:
        too_many(tree["accessors"][primitive["indices"]]["count"], 3 * max_faces + 2, path, "indices")


def _indices(tree: Tree, buffers: Buffers, primitive: Tree, path: Path) -> Int[np.ndarray, "f 3"] | None:
    if "indices" in primitive:
        accessor = tree["accessors"][primitive["indices"]]
        if accessor["type"] != "SCALAR" or accessor["componentType"] not in (5121, 5123, 5125):
            raise refuse(path, "indices that are not unsigned integers", "unsigned scalars", AGAIN)
    return triangles(tree, buffers, primitive)


def _vectors(tree: Tree, buffers: Buffers, accessor: int, width: int, path: Path) -> np.ndarray:
    """A float (or quantised) vector attribute as numbers."""
    if tree["accessors"][accessor]["type"] != f"VEC{width}":
        raise refuse(path, f"accessor {accessor} of {tree['accessors'][accessor]['type']}", f"VEC{width}", AGAIN)
    return values(tree, buffers, accessor)


def _texcoords(tree: Tree, buffers: Buffers, accessor: int, path: Path) -> Float[np.ndarray, "n 2"]:
    uv = _vectors(tree, buffers, accessor, 2, path).astype(np.float32)
    return np.stack([uv[:, 0], 1 - uv[:, 1]], axis=1)


def _colours(tree: Tree, buffers: Buffers, accessor: int, path: Path) -> Float[np.ndarray, "n k"]:
    """Linear vertex colours 0..1, with their alpha where they have one."""
    kind = tree["accessors"][accessor]
    if kind["type"] not in ("VEC3", "VEC4"):
        raise refuse(path, f"vertex colours of {kind['type']}", "VEC3 or VEC4", AGAIN)
    raw = values(tree, buffers, accessor)
    if raw.dtype.kind != "f":  # integers without the normalised flag
        raw = raw / np.float32(np.iinfo(raw.dtype).max)
    return np.clip(np.nan_to_num(raw.astype(np.float32), nan=1.0), 0, 1)


def _hidden(node: Tree) -> bool:
    visibility = node.get("extensions", {}).get("KHR_node_visibility")
    return isinstance(visibility, dict) and visibility.get("visible", True) is False


def _scene_nodes(tree: Tree, notes: list[str]) -> list[int]:
    """Nodes of the default scene that are not hidden, parents before children; without scenes all such nodes. A hidden
    node hides all below it."""
    nodes = tree.get("nodes", [])
    if tree.get("scenes"):
        roots = tree["scenes"][tree.get("scene", 0)].get("nodes", [])
    else:
        children = {c for n in nodes for c in n.get("children", [])}
        roots = [i for i in range(len(nodes)) if i not in children]
    order, stack, seen = [], list(reversed(roots)), set()
    while stack:
        node = stack.pop()
        if node in seen:
            continue
        seen.add(node)
        if _hidden(nodes[node]):
            notes.append("Hidden nodes (KHR_node_visibility) were left out; they stay in the GLB.")
            continue
        order.append(node)
        stack.extend(reversed(nodes[node].get("children", [])))
    return order


def world_matrices(tree: Tree) -> list[Float[np.ndarray, "4 4"]]:
    """world_from_node for every node (glTF 2.0, 3.5.3: matrix, or translation * rotation * scale)."""
    from scipy.spatial.transform import Rotation

    nodes = tree.get("nodes", [])
    local = []
    for node in nodes:
        if "matrix" in node:
            local.append(np.array(node["matrix"], np.float64).reshape(4, 4).T)
            continue
        matrix = np.eye(4)
        quaternion = np.array(node.get("rotation", [0, 0, 0, 1]), np.float64)
        turn = Rotation.from_quat(quaternion).as_matrix() if np.linalg.norm(quaternion) > 0 else np.eye(3)
        matrix[:3, :3] = turn * np.array(node.get("scale", [1, 1, 1]), np.float64)
        matrix[:3, 3] = node.get("translation", [0, 0, 0])
        local.append(matrix)
    world: list[np.ndarray] = [np.eye(4)] * len(nodes)
    children = {c for n in nodes for c in n.get("children", [])}
    stack = [i for i in range(len(nodes)) if i not in children]
    for i in stack:
        world[i] = local[i]
    while stack:
        i = stack.pop()
        for child in nodes[i].get("children", []):
            world[child] = world[i] @ local[child]
            stack.append(child)
    return world


def _other_sets(pieces: list[_PrimitivePiece], material: int) -> dict[int, Float[np.ndarray, "f 3 2"]]:
    """The UV sets besides the base that a material's textures use, for all faces; NaN where a face has none."""
    numbers = {n for p in pieces if p.material == material for n in p.other_uvs}
    blanks = [np.full((len(p.faces), 3, 2), np.nan, np.float32) for p in pieces]
    return {
        n: np.concatenate([p.other_uvs.get(n, blank) for p, blank in zip(pieces, blanks, strict=True)]) for n in numbers
    }


def _twins(pieces: list[_PrimitivePiece], starts: Int[np.ndarray, " n"]) -> Int[np.ndarray, " f"] | None:
    """For each face the corresponding face of the primitive's first instance; instances share UVs. None without
    instances."""
    if len({(piece.mesh, piece.primitive) for piece in pieces}) == len(pieces):
        return None
    twin = np.arange(starts[-1])
    first: dict[tuple[int, int], int] = {}
    for piece, a, b in zip(pieces, starts[:-1], starts[1:], strict=True):
        start = first.setdefault((piece.mesh, piece.primitive), int(a))
        twin[a:b] = np.arange(start, start + (b - a))
    return twin
