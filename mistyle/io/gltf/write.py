"""Writer of glTF 2.0 as one .glb: new files for meshes of other formats, patched ones for glTF (see patch.py).

Memory has v up, glTF has its origin at the top left: texture coordinates are flipped here and in patch.py only.
Textures are never flipped (row 0 of a map is v = 1, the top row of its PNG).
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from mistyle import __version__
from mistyle.core.asset import Asset
from mistyle.core.maps import Maps
from mistyle.core.mesh import local_origin, weld
from mistyle.core.rows import corner_rows, distinct
from mistyle.geometry.tangents import mikktspace
from mistyle.io.gltf.glb import Builder, Tree, unit_normals
from mistyle.io.gltf.patch import patch_tree
from mistyle.io.images.textures import Pictures, add_textures, encode_pictures, part_stems, set_textures
from mistyle.io.meshes.objects import objects
from mistyle.io.store.atomic import atomic_write


def write_glb(
    path: Path,
    asset: Asset,
    maps: Sequence[Maps],
    occlusion: Sequence[Float[np.ndarray, "h w"]],
    *,
    name: str,
    provenance: dict | None = None,
    pictures: Sequence[Pictures] | None = None,
) -> None:
    """Write the asset as a new .glb: a node per object that the source names, one material and set of textures per
    part, a primitive for each part of each object; atomically.

    Positions are the user's: file units, file axes, corners in the order of the source's vertices. For
    Z-up files that reading has rotated, the node holds that rotation, since glTF's scene is Y-up. The position of a
    mesh very far from its origin is split between node and float32 vertices. TANGENT is MikkTSpace.
    `maps` and `occlusion` (1 is open) have one entry per part; `pictures` are their encoded
    PNG files, which replace them. Equal inputs give equal bytes. The result is a static mesh: other formats have no
    animation to keep.
    """
    pictures = pictures or [encode_pictures(m, o) for m, o in zip(maps, occlusion, strict=True)]
    rotation, offset = _node_frame(asset)
    frame: Tree = {}
    if offset.any():
        frame["translation"] = (rotation @ offset).tolist()
    if not np.array_equal(rotation, np.eye(3)):
        frame["rotation"] = _quaternion(rotation)
    object_of_face, names = objects(asset)
    tree: Tree = {
        "asset": {"version": "2.0", "generator": f"mistyle {__version__}", "extras": {"mistyle": provenance or {}}},
        "scene": 0,
        "scenes": [{"name": name, "nodes": list(range(len(names)))}],
        "nodes": [{"name": each, "mesh": k, **frame} for k, each in enumerate(names)],
        "meshes": [{"name": each, "primitives": []} for each in names],
    }
    builder = Builder(tree, [])
    for part, stem in enumerate(part_stems(name, asset.mesh.parts)):
        if (asset.mesh.part == part).any():
            uvs = asset.mesh.corner_uvs[asset.mesh.part == part]
            textures = add_textures(builder, pictures[part], stem, repeat=_leaves_square(uvs))
            material = builder.put("materials", _material(asset, part, textures))
            for k, primitive in _primitives(builder, asset, part, object_of_face, rotation, offset):
                tree["meshes"][k]["primitives"].append(primitive | {"material": material})
    atomic_write(path, builder.pack())


def patch_glb(
    path: Path,
    asset: Asset,
    maps: Sequence[Maps],
    occlusion: Sequence[Float[np.ndarray, "h w"]],
    *,
    name: str,
    provenance: dict | None = None,
    pictures: Sequence[Pictures] | None = None,
) -> None:
    """Write the user's glTF as one .glb in which only the materials' textures are new (see patch.py)."""
    pictures = pictures or [encode_pictures(m, o) for m, o in zip(maps, occlusion, strict=True)]
    atomic_write(path, patch_tree(asset, pictures, name=name, provenance=provenance or {}).pack())


def _node_frame(asset: Asset) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "3"]]:
    """The rotation that makes the user's axes Y-up, and an offset (in the user's frame) to subtract before float32."""
    linear = asset.source.work_from_user[:3, :3]
    # Rounded, since turns between axes are exact and the scale leaves noise in the last digits.
    rotation = np.round(linear / np.cbrt(np.linalg.det(linear)), 12) + 0.0
    return rotation, local_origin(asset.source.user_positions)


def _quaternion(rotation: Float[np.ndarray, "3 3"]) -> list[float]:
    from scipy.spatial.transform import Rotation

    return (Rotation.from_matrix(rotation).as_quat(canonical=True) + 0.0).tolist()


def _primitives(
    builder: Builder,
    asset: Asset,
    part: int,
    object_of_face: Int[np.ndarray, " f"],
    rotation: np.ndarray,
    offset: np.ndarray,
) -> list[tuple[int, Tree]]:
    """The faces of a part, object by object. Tangents are computed for the whole part, as in its normal map."""
    welded = weld(asset.mesh, part)
    positions = (asset.source.user_positions[welded.vertex] - offset).astype(np.float32)
    normals = unit_normals(welded.normals if np.array_equal(rotation, np.eye(3)) else welded.normals @ rotation)
    uvs = np.stack([welded.uvs[:, 0], 1 - welded.uvs[:, 1]], axis=1)
    # -v instead of v = 1 - v': tangents depend on differences only, and those of the file's own numbers are exact.
    tangents = mikktspace(positions, normals, uvs * np.array([1, -1], np.float32), welded.faces)
    owner = object_of_face[asset.mesh.part == part]
    result = []
    for k in np.unique(owner).tolist():
        rows = np.flatnonzero(owner == k)
        vertex, faces = split_corners(welded.faces[rows], tangents[rows])
        corner = np.zeros((len(vertex), 4), np.float32)
        corner[faces.reshape(-1)] = tangents[rows].reshape(-1, 4)
        attributes = {
            "POSITION": builder.attribute(positions[vertex], bounds=True),
            "NORMAL": builder.attribute(normals[vertex]),
            "TANGENT": builder.attribute(corner),
            "TEXCOORD_0": builder.attribute(uvs[vertex]),
        }
        result.append((k, {"attributes": attributes, "indices": builder.indices(faces), "mode": 4}))
    return result


def split_corners(
    faces: Int[np.ndarray, "f 3"], tangents: Float[np.ndarray, "f 3 4"]
) -> tuple[Int[np.ndarray, " n"], Int[np.ndarray, "f 3"]]:
    """Give corners of one vertex with different tangents vertices of their own: old vertex of each new, new faces."""
    flat = faces.reshape(-1)
    first, inverse = distinct(corner_rows(flat, tangents.reshape(-1, 4)))
    return flat[first], inverse.reshape(-1, 3).astype(np.int32)


def _material(asset: Asset, part: int, textures: dict[str, int]) -> Tree:
    material: Tree = {"name": asset.materials[part].name}
    set_textures(material, textures)
    faces = asset.mesh.faces[asset.mesh.part == part]
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    if (np.bincount(distinct(edges)[1]) == 1).any():
        material["doubleSided"] = True  # an open surface is visible from behind, also in our renders
    return material


def _leaves_square(uvs: Float[np.ndarray, "f 3 2"]) -> bool:
    return bool(((uvs < 0) | (uvs > 1)).any())
