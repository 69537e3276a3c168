"""Reader of glTF materials: factors, and textures decoded on demand."""

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from mistyle.core.asset import SHOWN, Shading
from mistyle.io.gltf.check import data_uri
from mistyle.io.gltf.glb import Buffers
from mistyle.io.gltf.infos import (
    base_set,
    emits,
    has_tangents,
    image_of,
    nearest,
    sees_through,
    set_of,
    shadeless,
    texture_infos,
    texture_transform,
    wrap_of,
)
from mistyle.io.gltf.shading import DRAWN, GLOSSY, READ, extension, number, shading_of, triple
from mistyle.io.images.read import Budget, alpha_map, alpha_of, texture
from mistyle.io.meshes.parsed_mesh import Maps, RawMap, RawMaterial, no_textures
from mistyle.io.sandbox.bounds import beside, read_bytes

Tree = dict[str, Any]


def read_material(
    tree: Tree, buffers: Buffers, path: Path, index: int, other_uvs: dict[int, np.ndarray], budget: Budget
) -> RawMaterial:
    if index < 0:
        return RawMaterial("material", no_textures, roughness_factor=0.5, shading=Shading(stated="nothing"))
    entry = tree["materials"][index]
    extensions = entry.get("extensions", {})
    # glTF's default is rough metal, which a file without surface parameters hardly intends.
    pbr = entry.get("pbrMetallicRoughness", {"metallicFactor": 0.0, "roughnessFactor": 0.5})
    if GLOSSY in extensions:
        glossy = extension(extensions, GLOSSY)
        gloss = number(glossy, "glossinessFactor", 1.0, 0.0, 1.0)
        pbr = {
            "baseColorFactor": triple(glossy, "diffuseFactor", (1.0, 1.0, 1.0), 1.0),
            "metallicFactor": 0.0,
            "roughnessFactor": 1.0 if "gloss" in texture_infos(tree, index) else 1 - gloss,
        }
    colour = entry["emissiveFactor"] if shadeless(entry) else pbr.get("baseColorFactor", [1, 1, 1])
    rough, metal = pbr.get("roughnessFactor", 1.0), pbr.get("metallicFactor", 1.0)
    if "KHR_materials_unlit" in entry.get("extensions", {}):
        metal = 0.0
    load = partial(_load, tree, buffers, path, index, other_uvs, budget)
    red, green, blue = (float(np.clip(c, 0, 1)) for c in colour[:3])
    return RawMaterial(
        entry.get("name") or f"material_{index}",
        load,
        False if texture_infos(tree, index) else None,
        (red, green, blue),
        float(np.clip(rough, 0, 1)),
        float(np.clip(metal, 0, 1)),
        shading_of(entry, sees_through(tree, index)),
    )


def _load(
    tree: Tree, buffers: Buffers, path: Path, index: int, other_uvs: dict[int, np.ndarray], budget: Budget, tile: int
) -> tuple[Maps, tuple[str, ...]]:
    """The material's textures. glTF has no tiles."""
    maps: dict[str, RawMap] = {}
    notes = _unseen(tree, index)
    base = base_set(tree, index)
    for name, info in texture_infos(tree, index).items():
        image = _image(tree, buffers, path, info["index"], notes)
        if image is None:
            continue
        where, data = image
        if nearest(tree, info["index"]):
            notes.append(
                f"Textures of material '{_name(tree, index)}' show their nearest texel (magFilter NEAREST); renders "
                "here interpolate."
            )
        chosen = set_of(info)
        lookup: Tree = dict(
            uvs=other_uvs.get(chosen) if chosen != base else None,
            transform=texture_transform(info),
            wrap=wrap_of(tree, info["index"]),
        )
        pixels = texture(data, where, budget)
        if name == "albedo":
            maps["albedo"] = RawMap(pixels, **lookup, kind="colour")
            alpha = alpha_of(data, where) if sees_through(tree, index) else None
            if alpha is not None:
                maps["opacity"] = RawMap(alpha, **lookup, kind="data")
        elif name in ("emission", "specular"):
            maps[name] = RawMap(pixels, **lookup, kind="colour")
        elif name == "gloss":
            maps["specular"] = RawMap(pixels, **lookup, kind="colour")
            glossy = extension(tree["materials"][index]["extensions"], GLOSSY)
            gloss = np.float32(number(glossy, "glossinessFactor", 1.0, 0.0, 1.0))
            maps["roughness"] = RawMap(1 - alpha_map(data, where) * gloss, **lookup, kind="data")
        elif name == "normal":
            # Without TANGENT the frames follow the lookup coordinates (as in three.js and Khronos' viewer).
            frame: Tree = dict(scale=float(info.get("scale", 1.0)))
            frame |= dict(tangents="authored" if has_tangents(tree, index) else "looked up")
            maps["normal"] = RawMap(pixels, **lookup, kind="normal", **frame)
        else:
            maps["roughness"] = RawMap(np.ascontiguousarray(pixels[..., 1]), **lookup, kind="data")
            maps["metallic"] = RawMap(np.ascontiguousarray(pixels[..., 2]), **lookup, kind="data")
    return maps, tuple(dict.fromkeys(notes))


def _name(tree: Tree, index: int) -> str:
    return tree["materials"][index].get("name") or f"material_{index}"


def _unseen(tree: Tree, index: int) -> list[str]:
    """Notes on the material's properties that renders here show differently."""
    entry = tree["materials"][index]
    name, notes = _name(tree, index), []
    if shadeless(entry):
        notes.append(
            f"Material '{name}' is black and shows only its emission, which was read as its albedo, also in "
            "finished assets."
        )
    elif emits(entry):
        notes.append(
            f"Material '{name}' emits light, which {SHOWN}; views and paintings omit it. It stays in the GLB and is "
            "added to the painting."
        )
    if "KHR_materials_unlit" in entry.get("extensions", {}):
        notes.append(f"Material '{name}' is unlit: without --lit, viewers of a result show its albedo alone.")
    return notes + _left_out(tree, index, name)


def _left_out(tree: Tree, index: int, name: str) -> list[str]:
    """Notes on properties of a material that its maps lack: alpha, extensions, and defaults that were replaced."""
    entry, notes = tree["materials"][index], []
    if sees_through(tree, index):
        mode = "cut out" if entry["alphaMode"] == "MASK" else "blended"
        notes.append(
            f"Material '{name}' is {mode} by its alpha, which stays in the GLB and {SHOWN}; views, paintings and fits "
            "take it as opaque."
        )
    more = sorted(n for n in entry.get("extensions", {}) if n.startswith("KHR_materials_") and n not in READ)
    drawn = [n for n in more if n in DRAWN]
    if drawn:
        notes.append(
            f"Material '{name}' has {', '.join(drawn)}, which stays in the GLB and {SHOWN}; views, paintings and fits "
            "omit it."
        )
    with_maps = [n for n in drawn if any(k.endswith("Texture") for k in extension(entry["extensions"], n))]
    if any(n != "KHR_materials_specular" for n in with_maps):
        notes.append(f"Material '{name}': the factors of {' and '.join(with_maps)} were read, not the textures.")
    more = [n for n in more if n not in DRAWN]
    if more:
        notes.append(f"Material '{name}' has {', '.join(more)}, which stays in the GLB; renders here leave it out.")
    if GLOSSY in entry.get("extensions", {}):
        notes.append(
            f"Material '{name}' ({GLOSSY}): diffuse colour and glossiness are painted; its specular colour is drawn, "
            "but a finished asset has none."
        )
    elif "pbrMetallicRoughness" not in entry and "KHR_materials_unlit" not in entry.get("extensions", {}):
        notes.append(
            f"Material '{name}' sets neither metalness nor roughness: it is drawn as rough metal, glTF's default, and "
            "painted as a dielectric of roughness 0.5."
        )
    return notes


def _image(tree: Tree, buffers: Buffers, path: Path, texture: int, notes: list[str]) -> tuple[str, bytes] | None:
    """The source of a texture's image, and its bytes; None with a note where it is missing or unreadable."""
    source = image_of(tree, texture)
    if source is None:
        notes.append(f"Texture {texture} has no PNG, JPEG, WebP or AVIF image and was left out.")
        return None
    image = tree["images"][source]
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
