"""Bindings to materials that a USD stage does not have: those of a layer that references the file, for example."""

from collections.abc import Sequence
from typing import Any

NAMED = 5  # paths that a note lists


def missing_binding(pxr: Any, prim: Any) -> str:
    """The path of the material that `prim` or the nearest prim above it is bound to; "" where none is bound.

    For prims without a bound material on the stage: the path then leads to nothing.
    """
    tokens = pxr.UsdShade.Tokens
    while prim and not prim.IsPseudoRoot():
        binding = pxr.UsdShade.MaterialBindingAPI(prim)
        for purpose in (tokens.preview, tokens.allPurpose, tokens.full):
            # The relationship itself: an empty one blocks a weaker binding.
            targets = binding.GetDirectBindingRel(purpose).GetTargets() if binding else []
            if len(targets) == 1:
                return str(targets[0])
        prim = prim.GetParent()
    return ""


def missing_notes(paths: Sequence[str]) -> list[str]:
    """The note on the materials at `paths`, which meshes are bound to and the stage does not have."""
    if not paths:
        return []
    listed = ", ".join(paths[:NAMED]) + (f" and {len(paths) - NAMED} more" if len(paths) > NAMED else "")
    materials = "A bound material is" if len(paths) == 1 else f"{len(paths)} bound materials are"
    return [
        f"{materials} missing on the stage: {listed}. The slots keep these names and have no surface; open the file "
        "that holds both meshes and materials."
    ]
