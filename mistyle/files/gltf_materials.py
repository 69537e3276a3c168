"""Materials of glTF: factors, and textures decoded when they are asked for."""

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from mistyle.files.bounds import beside, read_bytes
from mistyle.files.glb import Buffers
from mistyle.files.gltf_check import data_uri
from mistyle.files.pictures import Budget, texture
from mistyle.files.raw import Maps, RawMap, RawMaterial, no_textures

Tree = dict[str, Any]
FLIP_V = np.array([[1.0, 0, 0], [0, -1, 1], [0, 0, 1]])  # (u, v) -> (u, 1 - v): glTF's origin is at the top left


def texture_infos(tree: Tree, material: int | None) -> dict[str, Tree]:
    """The texture references of a material that reading uses: albedo, orm, normal."""
    if material is None or material < 0:
        return {}
    entry = tree["materials"][material]
    pbr = entry.get("pbrMetallicRoughness", {})
    glossy = entry.get("extensions", {}).get("KHR_materials_pbrSpecularGlossiness", {})
    found = {
        "albedo": pbr.get("baseColorTexture") or glossy.get("diffuseTexture"),
        "orm": pbr.get("metallicRoughnessTexture"),
        "normal": entry.get("normalTexture"),
    }
    return {name: info for name, info in found.items() if isinstance(info, dict) and "index" in info}


def set_of(info: Tree) -> int:
    moved = info.get("extensions", {}).get("KHR_texture_transform", {})
    return int(moved.get("texCoord", info.get("texCoord", 0)))


def base_set(tree: Tree, material: int | None) -> int:
    """The TEXCOORD set that the material's first texture uses, 0 without textures."""
    infos = texture_infos(tree, material)
    return next((set_of(infos[name]) for name in ("albedo", "orm", "normal") if name in infos), 0)


def wanted_sets(tree: Tree, material: int | None) -> set[int]:
    return {base_set(tree, material), *(set_of(info) for info in texture_infos(tree, material).values())}


def texture_transform(info: Tree) -> Float[np.ndarray, "3 3"] | None:
    """KHR_texture_transform (uv' = translation * rotation * scale * uv, v down) as a matrix for v up; None without."""
    moved = info.get("extensions", {}).get("KHR_texture_transform")
    if not moved:
        return None
    x, y = moved.get("offset", [0, 0])
    c, s = np.cos(moved.get("rotation", 0.0)), np.sin(moved.get("rotation", 0.0))
    sx, sy = moved.get("scale", [1, 1])
    down = np.array([[c, s, x], [-s, c, y], [0, 0, 1]]) @ np.diag([sx, sy, 1.0])
    return FLIP_V @ down @ FLIP_V


def read_material(
    tree: Tree, buffers: Buffers, path: Path, index: int, other: dict[int, np.ndarray], budget: Budget
) -> RawMaterial:
    if index < 0:
        return RawMaterial("material", no_textures, roughness_factor=0.5)
    entry = tree["materials"][index]
    glossy = entry.get("extensions", {}).get("KHR_materials_pbrSpecularGlossiness")
    # glTF's default is rough metal, which a file that says nothing about its surface hardly means.
    pbr = entry.get("pbrMetallicRoughness", {"metallicFactor": 0.0, "roughnessFactor": 0.5})
    if glossy and "pbrMetallicRoughness" not in entry:
        rough = 1 - float(glossy.get("glossinessFactor", 1.0))
        pbr = {
            "baseColorFactor": glossy.get("diffuseFactor", [1, 1, 1]),
            "metallicFactor": 0.0,
            "roughnessFactor": rough,
        }
    colour = pbr.get("baseColorFactor", [1, 1, 1])
    rough, metal = pbr.get("roughnessFactor", 1.0), pbr.get("metallicFactor", 1.0)
    if "KHR_materials_unlit" in entry.get("extensions", {}):
        metal = 0.0
    load = partial(_load, tree, buffers, path, index, other, budget)
    red, green, blue = (float(np.clip(c, 0, 1)) for c in colour[:3])
    return RawMaterial(
        entry.get("name") or f"material_{index}",
        load,
        False if texture_infos(tree, index) else None,
        (red, green, blue),
        float(np.clip(rough, 0, 1)),
        float(np.clip(metal, 0, 1)),
    )


def _load(
    tree: Tree, buffers: Buffers, path: Path, index: int, other: dict[int, np.ndarray], budget: Budget, tile: int
) -> tuple[Maps, tuple[str, ...]]:
    """The material's textures. glTF has no tiles."""
    maps: dict[str, RawMap] = {}
    notes: list[str] = []
    base = base_set(tree, index)
    for name, info in texture_infos(tree, index).items():
        image = _image(tree, buffers, path, info["index"], notes)
        if image is None:
            continue
        where, data = image
        number = set_of(info)
        lookup: Tree = dict(uvs=other.get(number) if number != base else None, transform=texture_transform(info))
        pixels = texture(data, where, budget)
        if name == "albedo":
            maps["albedo"] = RawMap(pixels, **lookup, kind="colour")
        elif name == "normal":
            maps["normal"] = RawMap(pixels, **lookup, kind="normal", scale=float(info.get("scale", 1.0)))
        else:
            maps["roughness"] = RawMap(np.ascontiguousarray(pixels[..., 1]), **lookup, kind="data")
            maps["metallic"] = RawMap(np.ascontiguousarray(pixels[..., 2]), **lookup, kind="data")
    return maps, tuple(notes)


def _image(tree: Tree, buffers: Buffers, path: Path, texture: int, notes: list[str]) -> tuple[str, bytes] | None:
    """Where a texture's image comes from, and its bytes; None with a note where it is not there or of a kind that
    cannot be read."""
    images = tree.get("images", [])
    entry = tree["textures"][texture]
    webp = entry.get("extensions", {}).get("EXT_texture_webp", {})
    source = webp.get("source", entry.get("source")) if isinstance(webp, dict) else entry.get("source")
    if not isinstance(source, int) or not 0 <= source < len(images):
        notes.append(f"Texture {texture} has no PNG, JPEG or WebP image and was left out.")
        return None
    image = images[source]
    where = f"{path} image {source}"
    if "bufferView" in image:
        view = tree["bufferViews"][image["bufferView"]]
        start = view.get("byteOffset", 0)
        return where, bytes(buffers[view["buffer"]][start : start + view["byteLength"]])
    uri = image.get("uri") or ""
    if uri.startswith("data:"):
        return where, data_uri(uri, path)
    target = beside(path, uri)
    if not target.is_file():
        notes.append(f"Texture {uri} is not there and was left out.")
        return None
    return str(target), read_bytes(target)
