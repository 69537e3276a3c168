"""The content of an asset that a delivered format lacks: features of its glTF, and the formats that hold them.

An asset's GLB is the source with new textures, so its tree has every feature of the source.
"""

import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from mistyle.core.asset import Material
from mistyle.deliver.read_asset import FinishedAsset
from mistyle.io.gltf.variants import variants
from mistyle.io.usd.contents import listed

Tree = Mapping[str, Any]
GLTF = (".glb", ".gltf")
LACKING = re.compile(r"The USD file has (.+), which the asset lacks\.")  # a note of io/usd/contents.py
UNREAD = re.compile(r"Only the first (\d+) of (\d+) instances")  # a note of io/gltf/read.py
LABELS = {"usd": "USD", "obj": "OBJ", "mtlx": "MaterialX", "maps": "the maps"}

# Kinds of features that are about the mesh: MaterialX and maps have none, so they lose none.
MESH = (
    *("hierarchy", "instances", "unread instances", "skins", "morph targets", "animations", "cameras", "lights"),
    *("points", "hidden nodes", "scenes"),
)
SURFACE = (
    *("alpha", "opacity", "emission", "emission textures", "unlit", "transmission"),
    *("double sides", "some double sides", "variants", "extensions"),
)
LACKS: Mapping[str, frozenset[str]] = {
    "usd": frozenset((*MESH, *SURFACE)) - {"alpha", "opacity", "emission", "double sides"},
    "obj": frozenset((*MESH, *SURFACE)) - {"emission"},
    "mtlx": frozenset(SURFACE),
    "maps": frozenset(SURFACE) - {"alpha"},
}
# Extensions that have a sentence of their own, or whose effect is in the painted mesh and its textures.
TOLD = {
    *("KHR_materials_unlit", "KHR_materials_transmission", "KHR_materials_variants", "KHR_materials_emissive_strength"),
    *("KHR_lights_punctual", "EXT_mesh_gpu_instancing", "KHR_node_visibility", "KHR_texture_transform"),
    *("KHR_mesh_quantization", "EXT_texture_webp", "EXT_texture_avif", "KHR_texture_basisu"),
}


def features(finished: FinishedAsset) -> dict[str, str]:
    """The features of an asset besides one mesh with painted maps, by kind, each as words of a sentence."""
    from mistyle.io.read_mesh import load_gltf

    tree, _ = load_gltf(finished.folder / f"{finished.manifest['name']}.glb")
    found = mesh_features(tree, finished.asset.source.notes)
    if suffix_of_source(finished) not in GLTF:
        return found  # the surfaces of a GLB that mistyle made have nothing but the maps
    transparent = [textures.alpha is not None for textures in finished.sets]
    return found | surface_features(tree, finished.asset.materials, transparent)


def suffix_of_source(finished: FinishedAsset) -> str:
    """The ending of the mesh file that an asset was made from, in lower case."""
    return Path(str(finished.manifest.get("source", ""))).suffix.lower()


def losses(found: Mapping[str, str], formats: Sequence[str]) -> tuple[str, ...]:
    """A sentence for each of the features that some of the formats lack."""
    result = []
    for kind in (*MESH, *SURFACE):
        without = [LABELS[f] for f in LABELS if f in formats and kind in LACKS[f]]
        if kind in found and without:
            verb = "lack" if len(without) > 1 or "maps" in without[0] else "lacks"
            result.append(f"{_capital(listed(without))} {verb} {found[kind]}, which the GLB has.")
    return tuple(result)


def source_losses(notes: Iterable[str], formats: Sequence[str]) -> tuple[str, ...]:
    """The sentence on the contents of a USD source that its GLB and OBJ lack; `notes` are those of its reading."""
    without = [label for f, label in (("glb", "GLB"), ("obj", "OBJ")) if f in formats]
    held = [match[1] for match in map(LACKING.fullmatch, notes) if match]
    if not without:
        return ()
    verb = "lacks" if len(without) == 1 else "lack"
    return tuple(f"{listed(without)} {verb} {text}, which the USD source has." for text in held)


def mesh_features(tree: Tree, notes: Sequence[str] = ()) -> dict[str, str]:
    """The features of a glTF's scene besides one mesh, by kind; `notes` are those of its reading."""
    nodes, meshes = tree.get("nodes", []), tree.get("meshes", [])
    primitives = [p for mesh in meshes for p in mesh["primitives"]]
    placed = [node["mesh"] for node in nodes if "mesh" in node]
    copied = sum(placed.count(mesh) for mesh in set(placed) if placed.count(mesh) > 1)
    lights = _count(_items(_items(tree.get("extensions")).get("KHR_lights_punctual")), "lights")
    unread = next((f"all but the first {m[1]} of {m[2]} instances" for m in map(UNREAD.match, notes) if m), "")
    gpu = _extended(nodes, "EXT_mesh_gpu_instancing")
    found = {
        "hierarchy": len(nodes) > 1 and f"the hierarchy of {len(nodes)} nodes with their names and pivots",
        "instances": copied and f"the instancing of {copied} nodes (the faces are copied)",
        "unread instances": gpu and (unread or "the instancing on the GPU (the faces are copied)"),
        "skins": tree.get("skins") and "the skin (the mesh has one pose)",
        "morph targets": any(p.get("targets") for p in primitives) and "the morph targets (the mesh has one shape)",
        "animations": tree.get("animations") and f"the animations ({_count(tree, 'animations')})",
        "cameras": tree.get("cameras") and f"the cameras ({_count(tree, 'cameras')})",
        "lights": lights and f"the lights ({lights})",
        "points": any(p.get("mode", 4) < 4 for p in primitives) and "the points and lines",
        "hidden nodes": _extended(nodes, "KHR_node_visibility") and "the hidden nodes (KHR_node_visibility)",
        "scenes": _count(tree, "scenes") > 1 and f"the further scenes ({_count(tree, 'scenes') - 1})",
    }
    return {kind: str(text) for kind, text in found.items() if text}


def surface_features(tree: Tree, materials: Sequence[Material], transparent: Sequence[bool]) -> dict[str, str]:
    """The features of a glTF's materials besides the painted maps, by kind.

    `materials` are those of its texture sets, `transparent` whether a set's albedo has an alpha.
    """
    entries = _used(tree)
    cut = [m.name for m, alpha in zip(materials, transparent, strict=True) if alpha]
    textured = [m.name for m in materials if m.emission is not None and any(m.shading.emission)]
    glowing = [m.name for m in materials if m.emission is None and any(m.shading.emission)]
    double = [name for name, entry in entries if entry.get("doubleSided") is True]
    sides = "double sides" if len(double) == len(entries) else "some double sides"
    own = [(n, e) for n, entry in entries for e in _items(entry.get("extensions")) if e not in TOLD]
    further = [f"{e} of {_named(n for n, each in own if each == e)}" for e in dict.fromkeys(e for _, e in own)]
    further += [e for e in tree.get("extensionsUsed", []) if e not in TOLD and e not in {each for _, each in own}]
    names = {
        "alpha": (cut, "the alpha of {}"),
        "opacity": ([m.name for m in materials if m.shading.opacity < 1], "the opacity factor of {}"),
        "emission": (glowing, "the emission of {}"),
        "emission textures": (textured, "the emission texture of {}"),
        "unlit": ([m.name for m in materials if m.shading.unlit], "the unlit look of {}"),
        "transmission": (_with(entries, "KHR_materials_transmission"), "the transmission of {}"),
        sides: (double, "the double-sidedness of {}"),
    }
    found = {kind: text.format(_named(those)) for kind, (those, text) in names.items() if those}
    other = [f"'{name}'" for name in dict.fromkeys(name for name, _ in variants(tree))]
    found |= {"variants": f"all variants but the default one ({listed(other)})"} if other else {}
    return found | ({"extensions": listed(further)} if further else {})


def _used(tree: Tree) -> list[tuple[str, Mapping[str, Any]]]:
    """Name and entry of every material on a primitive."""
    used = {p["material"] for mesh in tree.get("meshes", []) for p in mesh["primitives"] if "material" in p}
    return [(tree["materials"][k].get("name") or f"material_{k}", tree["materials"][k]) for k in sorted(used)]


def _with(entries: Sequence[tuple[str, Mapping[str, Any]]], extension: str) -> list[str]:
    return [name for name, entry in entries if extension in _items(entry.get("extensions"))]


def _extended(nodes: Iterable[Mapping[str, Any]], extension: str) -> bool:
    return any(extension in _items(node.get("extensions")) for node in nodes)


def _items(value: Any) -> Any:
    """An object of the JSON that nothing has checked; {} where it is missing or of another type."""
    return value if isinstance(value, dict) else {}


def _count(tree: Tree, key: str) -> int:
    value = tree.get(key)
    return len(value) if isinstance(value, list) else 0


def _named(names: Iterable[str]) -> str:
    distinct = [f"'{name}'" for name in dict.fromkeys(names)]
    return f"material{'s' if len(distinct) > 1 else ''} {listed(distinct)}"


def _capital(text: str) -> str:
    return text[:1].upper() + text[1:]
