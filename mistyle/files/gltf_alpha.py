"""The opacity of a user's cut-out and blended glTF materials, which a new base colour has to carry on."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from mistyle.core.asset import Asset
from mistyle.core.errors import InputRefused
from mistyle.files.bounds import beside, read_bytes
from mistyle.files.glb import Buffers, Tree, values
from mistyle.files.gltf_check import data_uri
from mistyle.files.gltf_materials import set_of, texture_transform
from mistyle.files.read import load_gltf, read_gltf_alpha


@dataclass(frozen=True)
class Cutout:
    """A base colour's alpha (row 0 is v = 1, repeats outside the square) and where every corner of the mesh lies in it
    (v up; zero for faces of other parts)."""

    alpha: Float[np.ndarray, "h w"]
    uvs: Float[np.ndarray, "f 3 2"]


def cutouts(asset: Asset) -> dict[int, Cutout]:
    """For every part whose material is cut out or blended (alphaMode) by its texture: that texture's alpha.

    Opaque materials ignore their alpha, and so do we. Alpha factors and vertex colours are not in it: they stay in
    the file.
    """
    path = asset.source.path
    tree, buffers = load_gltf(path)
    result: dict[int, Cutout] = {}
    for entry in asset.source.primitives:
        primitive = tree["meshes"][entry.mesh]["primitives"][entry.primitive]
        info = _base_texture(tree, primitive.get("material"))
        if info is None:
            continue
        texcoord = primitive["attributes"].get(f"TEXCOORD_{set_of(info)}")
        image = image_of(tree, info["index"])
        alpha = read_gltf_alpha(path, image) if texcoord is not None and image is not None else None
        if texcoord is None or alpha is None:
            continue
        faces = asset.mesh.faces[entry.start : entry.stop] - entry.first_vertex
        uvs = values(tree, buffers, texcoord)[faces].astype(np.float64)
        uvs = np.stack([uvs[..., 0], 1 - uvs[..., 1]], axis=-1)
        transform = texture_transform(info)
        if transform is not None:
            uvs = uvs @ transform[:2, :2].T + transform[:2, 2]
        for part in np.unique(asset.mesh.part[entry.start : entry.stop]).tolist():
            old = result.get(part) or Cutout(alpha, np.zeros((len(asset.mesh.faces), 3, 2)))
            old.uvs[entry.start : entry.stop] = uvs
            result[part] = old
    return result


def _base_texture(tree: Tree, material: int | None) -> Tree | None:
    if material is None or tree["materials"][material].get("alphaMode", "OPAQUE") == "OPAQUE":
        return None
    entry = tree["materials"][material]
    glossy = entry.get("extensions", {}).get("KHR_materials_pbrSpecularGlossiness", {})
    return entry.get("pbrMetallicRoughness", {}).get("baseColorTexture") or glossy.get("diffuseTexture")


def image_of(tree: Tree, texture: int) -> int | None:
    """The number of a texture's image; None where there is none that can be read."""
    entry = tree["textures"][texture]
    webp = entry.get("extensions", {}).get("EXT_texture_webp")
    source = webp.get("source") if isinstance(webp, dict) else entry.get("source")
    images = tree.get("images", [])
    return source if isinstance(source, int) and 0 <= source < len(images) else None


def image_bytes(image: Tree, tree: Tree, buffers: Buffers, path) -> bytes | None:
    """The file of an image, from a buffer view, a data URI or beside `path`; None where it is missing or out of
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
