"""Opacity of a user's cut-out and blended glTF materials, which a new base colour must preserve."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from mistyle.core.asset import Asset
from mistyle.core.errors import InputRefused
from mistyle.geometry.retexture import REPEAT, Wraps
from mistyle.io.gltf.check import data_uri
from mistyle.io.gltf.glb import Buffers, Tree, values
from mistyle.io.gltf.infos import image_of, set_of, texture_transform, wrap_of
from mistyle.io.read_mesh import load_gltf, read_gltf_alpha
from mistyle.io.sandbox.bounds import beside, read_bytes


@dataclass(frozen=True)
class Cutout:
    """A base colour's alpha (row 0 is v = 1, `wrap` outside the square), the UVs of every corner of the mesh in it (v
    up; zero for faces of other parts), and every corner's own alpha (1 for those faces)."""

    alpha: Float[np.ndarray, "h w"]
    uvs: Float[np.ndarray, "f 3 2"]
    corners: Float[np.ndarray, "f 3"]
    wrap: Wraps = REPEAT


def cutouts(asset: Asset) -> dict[int, Cutout]:
    """The alpha of every part whose material is cut out or blended (alphaMode) by its texture or vertex colours.

    The alpha of opaque materials is ignored, as in glTF. Alpha factors are excluded: they stay in the file.
    """
    path = asset.source.path
    tree, buffers = load_gltf(path)
    result: dict[int, Cutout] = {}
    for entry in asset.source.primitives:
        primitive = tree["meshes"][entry.mesh]["primitives"][entry.primitive]
        material = primitive.get("material")
        if material is None or tree["materials"][material].get("alphaMode", "OPAQUE") == "OPAQUE":
            continue
        faces = asset.mesh.faces[entry.start : entry.stop] - entry.first_vertex
        corners = _corner_alpha(tree, buffers, primitive, faces)
        info = _base_texture(tree, material)
        texture = None if info is None else _texture_alpha(tree, buffers, path, primitive, info, faces)
        if texture is None and (corners == 1).all():
            continue
        alpha, uvs = texture or (np.ones((1, 1), np.float32), np.zeros((*faces.shape, 2)))
        for part in np.unique(asset.mesh.part[entry.start : entry.stop]).tolist():
            count = len(asset.mesh.faces)
            wrap = REPEAT if info is None else wrap_of(tree, info["index"])
            old = result.get(part) or Cutout(alpha, np.zeros((count, 3, 2)), np.ones((count, 3)), wrap)
            old.uvs[entry.start : entry.stop] = uvs
            old.corners[entry.start : entry.stop] = corners
            result[part] = old
    return result


def _corner_alpha(tree: Tree, buffers: Buffers, primitive: Tree, faces: np.ndarray) -> Float[np.ndarray, "f 3"]:
    colours = primitive["attributes"].get("COLOR_0")
    if colours is None or tree["accessors"][colours]["type"] != "VEC4":
        return np.ones(faces.shape)
    return np.clip(np.nan_to_num(values(tree, buffers, colours)[faces][..., 3].astype(np.float64), nan=1.0), 0, 1)


def _texture_alpha(
    tree: Tree, buffers: Buffers, path: Path, primitive: Tree, info: Tree, faces: np.ndarray
) -> tuple[Float[np.ndarray, "h w"], Float[np.ndarray, "f 3 2"]] | None:
    """The alpha of a texture and the UVs of the faces' corners; None where it is opaque or missing."""
    texcoord = primitive["attributes"].get(f"TEXCOORD_{set_of(info)}")
    image = image_of(tree, info["index"])
    alpha = read_gltf_alpha(path, image) if texcoord is not None and image is not None else None
    if texcoord is None or alpha is None:
        return None
    uvs = values(tree, buffers, texcoord)[faces].astype(np.float64)
    uvs = np.stack([uvs[..., 0], 1 - uvs[..., 1]], axis=-1)
    transform = texture_transform(info)
    return alpha, uvs if transform is None else uvs @ transform[:2, :2].T + transform[:2, 2]


def _base_texture(tree: Tree, material: int) -> Tree | None:
    entry = tree["materials"][material]
    glossy = entry.get("extensions", {}).get("KHR_materials_pbrSpecularGlossiness", {})
    return glossy.get("diffuseTexture") if glossy else entry.get("pbrMetallicRoughness", {}).get("baseColorTexture")


def image_bytes(image: Tree, tree: Tree, buffers: Buffers, path) -> bytes | None:
    """An image file's bytes, from a buffer view, a data URI or beside `path`; None where it is missing or out of
    bounds."""
    if "bufferView" in image:
        view = tree["bufferViews"][image["bufferView"]]
        start = view.get("byteOffset", 0)
        return bytes(buffers[view["buffer"]][start : start + view["byteLength"]])
    uri = image.get("uri") or ""
    try:
        return data_uri(uri, path) if uri.startswith("data:") else read_bytes(beside(path, uri))
    except InputRefused:
        return None
