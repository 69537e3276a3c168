"""Material variants of a glTF (KHR_materials_variants): materials that a primitive has instead of its own."""

from collections.abc import Mapping
from typing import Any

from mistyle.io.gltf.shading import extension

NAME = "KHR_materials_variants"


def variant_notes(tree: Mapping[str, Any], painted: set[int]) -> list[str]:
    """A sentence for each variant whose material none of the painted primitives has."""
    return [
        f"Variant '{variant}' was not painted: its material '{tree['materials'][k].get('name') or f'material_{k}'}' "
        "stays in the GLB as it is."
        for variant, k in variants(tree)
        if k not in painted
    ]


def variants(tree: Mapping[str, Any]) -> list[tuple[str, int]]:
    """Name and material of every variant that changes a primitive's material; entries of other types are skipped."""
    entries = _objects(extension(tree.get("extensions", {}), NAME).get("variants"))
    names = dict(enumerate(str(entry.get("name") or f"variant_{k}") for k, entry in enumerate(entries)))
    changes: dict[tuple[str, int], None] = {}
    for primitive in (p for mesh in tree.get("meshes", []) for p in mesh["primitives"]):
        for mapping in _objects(extension(primitive.get("extensions", {}), NAME).get("mappings")):
            k, numbers = mapping.get("material"), mapping.get("variants")
            if type(k) is int and 0 <= k < len(tree.get("materials", [])) and k != primitive.get("material"):
                chosen = numbers if isinstance(numbers, list) else []
                changes |= {(names[n], k): None for n in chosen if type(n) is int and n in names}
    return list(changes)


def _objects(value: Any) -> list[dict[str, Any]]:
    return [entry if isinstance(entry, dict) else {} for entry in value] if isinstance(value, list) else []
