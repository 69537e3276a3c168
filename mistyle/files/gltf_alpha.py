"""The opacity of a user's cut-out and blended glTF materials, which a new base colour has to carry on."""

import io
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from mistyle.core.asset import Asset
from mistyle.core.errors import InputRefused
from mistyle.files.bounds import MAX_PIXELS, beside, read_bytes
from mistyle.files.glb import Tree, values
from mistyle.files.gltf_check import data_uri, load_gltf
from mistyle.files.gltf_materials import set_of, texture_transform


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
        alpha = _alpha(image_of(tree, info["index"]), tree, buffers, path) if texcoord is not None else None
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


def image_of(tree: Tree, texture: int) -> Tree | None:
    """The image of a texture; None where there is none that can be read."""
    entry = tree["textures"][texture]
    webp = entry.get("extensions", {}).get("EXT_texture_webp")
    source = webp.get("source") if isinstance(webp, dict) else entry.get("source")
    images = tree.get("images", [])
    return images[source] if isinstance(source, int) and 0 <= source < len(images) else None


def image_bytes(image: Tree, tree: Tree, buffers: list[bytes], path) -> bytes | None:
    """The file of an image, from a buffer view, a data URI or beside `path`; None where it is missing or out of
    bounds."""
    if "bufferView" in image:
        view = tree["bufferViews"][image["bufferView"]]
        start = view.get("byteOffset", 0)
        return buffers[view["buffer"]][start : start + view["byteLength"]]
    uri = image.get("uri", "")
    try:
        return data_uri(uri, path) if uri.startswith("data:") else read_bytes(beside(path, uri))
    except InputRefused:
        return None


def _alpha(image: Tree | None, tree: Tree, buffers: list[bytes], path) -> Float[np.ndarray, "h w"] | None:
    """The alpha channel, or None where the image has none (JPEG) or is opaque."""
    from PIL import Image, UnidentifiedImageError

    data = image_bytes(image, tree, buffers, path) if image is not None else None
    if data is None:
        return None
    try:
        opened = Image.open(io.BytesIO(data), formats=("PNG", "WEBP"))
    except UnidentifiedImageError:
        return None
    if opened.width * opened.height > MAX_PIXELS:
        raise InputRefused(f"{path}: a texture of {opened.width} x {opened.height} pixels; scale it down")
    if not opened.has_transparency_data:
        return None
    alpha = np.asarray(opened.convert("RGBA").getchannel("A"), np.float32) / 255
    return alpha if (alpha < 1).any() else None
