"""Removal of unused textures, images, samplers, buffer views and extension names from a patched glTF."""

from collections.abc import Iterator
from typing import Any

from mistyle.core.errors import InputRefused
from mistyle.io.gltf.glb import Builder, Tree

# Extensions that reference textures, images and buffer views only as core glTF does or in "...Texture" and "source".
_UNDERSTOOD = (
    "KHR_materials_",
    "EXT_texture_webp",
    "EXT_texture_avif",
    "KHR_texture_basisu",
    "KHR_texture_transform",
    "KHR_lights_punctual",
    "KHR_mesh_quantization",
    "KHR_animation_pointer",
    "KHR_node_visibility",
    "KHR_xmp_json_ld",
    "EXT_mesh_gpu_instancing",
    "MSFT_lod",
)
# Extensions that may have been removed with the replaced textures.
_GOES_WITH_TEXTURES = (
    "KHR_texture_transform",
    "KHR_materials_pbrSpecularGlossiness",
    "KHR_materials_emissive_strength",
    "KHR_materials_unlit",
    "EXT_texture_webp",
    "EXT_texture_avif",
    "KHR_texture_basisu",
)


def drop_unused(builder: Builder) -> None:
    """Remove textures, images, samplers and buffer views without references, and renumber the rest.

    Accessors, materials, meshes and nodes keep their indices. A file with an extension that may reference images or
    buffer views in unknown ways stays unchanged.
    """
    tree = builder.tree
    _forget_extensions(tree)
    if not all(name.startswith(_UNDERSTOOD) for name in tree.get("extensionsUsed", [])):
        return
    infos = list(_texture_infos(tree.get("materials", [])))
    _renumber(tree, "textures", [(info, "index") for info in infos])
    _forget_extensions(tree)
    textures = tree.get("textures", [])
    sources = [(t, "source") for t in textures if "source" in t]
    extensions = [e for t in textures for e in t.get("extensions", {}).values() if isinstance(e, dict)]
    sources += [(e, "source") for e in extensions if "source" in e]
    _renumber(tree, "images", sources)
    _renumber(tree, "samplers", [(t, "sampler") for t in textures if "sampler" in t])
    parts = [a["sparse"][k] for a in tree.get("accessors", []) if "sparse" in a for k in ("indices", "values")]
    owners = [*tree.get("accessors", []), *parts, *tree.get("images", [])]
    remaining = _renumber(tree, "bufferViews", [(o, "bufferView") for o in owners if "bufferView" in o])
    builder.blobs[:] = [builder.blobs[i] for i in remaining]


def _renumber(tree: Tree, key: str, references: list[tuple[Tree, str]]) -> list[int]:
    """Keep the referenced entries of tree[key] and renumber the references; returns the kept entries' old indices."""
    count = len(tree.get(key, []))
    for owner, field in references:
        if not isinstance(owner[field], int) or not 0 <= owner[field] < count:
            reference = f"{key} number {owner[field]!r} of {count}"
            raise InputRefused(f"the glTF file names {reference}; it is damaged, export it again")
    used = sorted({owner[field] for owner, field in references})
    new = {old: number for number, old in enumerate(used)}
    for owner, field in references:
        owner[field] = new[owner[field]]
    if key in tree:
        tree[key] = [tree[key][i] for i in used]
        if not used:
            del tree[key]  # glTF forbids empty lists
    return used


def _texture_infos(node: Any) -> Iterator[Tree]:
    if isinstance(node, list):
        for item in node:
            yield from _texture_infos(item)
    elif isinstance(node, dict):
        for key, item in node.items():
            if key == "extras":
                continue
            if key.endswith("Texture") and isinstance(item, dict) and isinstance(item.get("index"), int):
                yield item
            yield from _texture_infos(item)


def _forget_extensions(tree: Tree) -> None:
    present = set(_extension_names(tree))
    for key in ("extensionsUsed", "extensionsRequired"):
        if key in tree:
            tree[key] = [n for n in tree[key] if n in present or n not in _GOES_WITH_TEXTURES]
            if not tree[key]:
                del tree[key]


def _extension_names(node: Any) -> Iterator[str]:
    if isinstance(node, list):
        for item in node:
            yield from _extension_names(item)
    elif isinstance(node, dict):
        for key, item in node.items():
            if key == "extensions" and isinstance(item, dict):
                yield from item
            if key != "extras":
                yield from _extension_names(item)
