"""Material queries on a glTF's checked JSON: textures, their lookups, emission. Nothing is decoded here."""

from typing import Any

import numpy as np
from jaxtyping import Float

from mistyle.geometry.retexture import Wrap, Wraps
from mistyle.io.gltf.glb import CLAMP_TO_EDGE, MIRRORED_REPEAT, REPEAT

Tree = dict[str, Any]
WRAPS: dict[int | None, Wrap] = {CLAMP_TO_EDGE: "clamp", MIRRORED_REPEAT: "mirror", REPEAT: "repeat"}
FLIP_V = np.array([[1.0, 0, 0], [0, -1, 1], [0, 0, 1]])  # (u, v) -> (u, 1 - v): glTF's origin is at the top left


def texture_infos(tree: Tree, material: int | None) -> dict[str, Tree]:
    """The texture references of a material that the reader uses: albedo, orm, normal, emission, specular (the colour of
    F0), gloss (the same and, in its alpha, glossiness)."""
    if material is None or material < 0:
        return {}
    entry = tree["materials"][material]
    pbr = entry.get("pbrMetallicRoughness", {})
    glossy = entry.get("extensions", {}).get("KHR_materials_pbrSpecularGlossiness", {})
    specular = entry.get("extensions", {}).get("KHR_materials_specular", {})
    specular = specular if isinstance(specular, dict) else {}
    base = pbr.get("baseColorTexture") if not glossy else glossy.get("diffuseTexture")
    infos = {
        "albedo": entry.get("emissiveTexture") if shadeless(entry) else base,
        "orm": None if glossy else pbr.get("metallicRoughnessTexture"),
        "normal": entry.get("normalTexture"),
        "emission": entry.get("emissiveTexture") if emits(entry) and not shadeless(entry) else None,
        "specular": None if glossy else specular.get("specularColorTexture"),
        "gloss": glossy.get("specularGlossinessTexture"),
    }
    return {name: info for name, info in infos.items() if isinstance(info, dict) and "index" in info}


def emits(entry: Tree) -> bool:
    return any(c > 0 for c in entry.get("emissiveFactor", [0, 0, 0]))


def shadeless(entry: Tree) -> bool:
    """Whether a material shows only its emission: files without an extension encode this by a black base colour."""
    glossy = "KHR_materials_pbrSpecularGlossiness" in entry.get("extensions", {})
    base = entry.get("pbrMetallicRoughness", {}).get("baseColorFactor", [1, 1, 1, 1])
    return emits(entry) and not glossy and not any(c > 0 for c in base[:3])


def sees_through(tree: Tree, material: int) -> bool:
    """Whether a material may be cut out or blended: by its alpha mode, and by a factor, a texture or vertex colours
    that have an alpha."""
    entry = tree["materials"][material]
    if entry.get("alphaMode", "OPAQUE") == "OPAQUE":
        return False
    pbr = entry.get("pbrMetallicRoughness", {})
    glossy = entry.get("extensions", {}).get("KHR_materials_pbrSpecularGlossiness", {})
    factors = [*pbr.get("baseColorFactor", [])[3:], *glossy.get("diffuseFactor", [])[3:]]
    primitives = [p for mesh in tree.get("meshes", []) for p in mesh["primitives"] if p.get("material") == material]
    colours = [p["attributes"]["COLOR_0"] for p in primitives if "COLOR_0" in p["attributes"]]
    return (
        any(alpha < 1 for alpha in factors)
        or "baseColorTexture" in pbr
        or "diffuseTexture" in glossy
        or any(tree["accessors"][c]["type"] == "VEC4" for c in colours)
    )


def has_tangents(tree: Tree, material: int) -> bool:
    """Whether the file has the tangents of the material's normal map."""
    primitives = [p for mesh in tree.get("meshes", []) for p in mesh["primitives"] if p.get("material") == material]
    return all("TANGENT" in p["attributes"] for p in primitives)


def image_of(tree: Tree, texture: int) -> int | None:
    """The index of a texture's image; None without a readable one."""
    entry, images = tree["textures"][texture], tree.get("images", [])
    named = [entry.get("extensions", {}).get(name) for name in ("EXT_texture_webp", "EXT_texture_avif")]
    sources = [option.get("source") for option in named if isinstance(option, dict)] + [entry.get("source")]
    return next((s for s in sources if isinstance(s, int) and 0 <= s < len(images)), None)


def wrap_of(tree: Tree, texture: int) -> Wraps:
    """The wrap modes of a texture's sampler along u and v; by default it repeats."""
    number, samplers = tree["textures"][texture].get("sampler"), tree.get("samplers", [])
    sampler = samplers[number] if number is not None else {}
    return WRAPS.get(sampler.get("wrapS"), "repeat"), WRAPS.get(sampler.get("wrapT"), "repeat")


def nearest(tree: Tree, texture: int) -> bool:
    """Whether a texture's sampler magnifies without interpolation."""
    number, samplers = tree["textures"][texture].get("sampler"), tree.get("samplers", [])
    return number is not None and samplers[number].get("magFilter") == 9728


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
