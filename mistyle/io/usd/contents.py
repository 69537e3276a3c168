"""The contents of a USD stage that an asset of mistyle cannot hold: skins, animations, variants, cameras and lights."""

from collections import Counter
from collections.abc import Iterable
from typing import Any

MOVING = ("moving prims", "moving skeletons", "moving shapes")


def unheld_notes(pxr: Any, stage: Any) -> list[str]:
    """One note that lists the contents which stay in the file, or none. Call it before `stage.pose`.

    deliver/losses.py reads the sentence.
    """
    counts: Counter[str] = Counter()
    sets: dict[str, None] = {}
    for prim in stage.Traverse():
        counts.update(_kinds(pxr, prim))
        if prim.HasVariantSets():
            own = prim.GetVariantSets()
            sets |= dict.fromkeys(name for name in own.GetNames() if len(own.GetVariantSet(name).GetVariantNames()) > 1)
    words = {
        "skin": "a skin and its skeleton" if counts["skeleton"] < 2 else f"skins with {counts['skeleton']} skeletons",
        "blend shapes": f"blend shapes ({counts['blend shapes']})",
        "animation": f"an animation ({listed([f'{k}: {counts[k]}' for k in MOVING if counts[k]])})",
        "cameras": f"cameras ({counts['cameras']})",
        "lights": f"lights ({counts['lights']})",
    }
    held = [text for kind, text in words.items() if counts[kind]]
    if sets:
        held.append(f"further variants of {listed([repr(name) for name in sets])}")
    return [f"The USD file has {listed(held)}, which the asset lacks."] if held else []


def _kinds(pxr: Any, prim: Any) -> list[str]:
    """The kinds of contents of one prim; `animation` beside each of MOVING."""
    kinds = []
    if prim.IsA(pxr.UsdSkel.Animation):
        changing = any(attribute.GetNumTimeSamples() > 1 for attribute in prim.GetAuthoredAttributes())
        return ["animation", "moving skeletons"] if changing else []
    if prim.IsA(pxr.UsdSkel.BlendShape):
        return ["blend shapes"]
    if prim.IsA(pxr.UsdSkel.Skeleton):
        kinds.append("skeleton")
    if prim.HasAPI(pxr.UsdSkel.BindingAPI) and prim.IsA(pxr.UsdGeom.Mesh):
        kinds.append("skin")
    if prim.IsA(pxr.UsdGeom.Camera):
        kinds.append("cameras")
    if prim.HasAPI(pxr.UsdLux.LightAPI):
        kinds.append("lights")
    if prim.IsA(pxr.UsdGeom.PointBased) and pxr.UsdGeom.PointBased(prim).GetPointsAttr().ValueMightBeTimeVarying():
        kinds += ["animation", "moving shapes"]
    elif prim.IsA(pxr.UsdGeom.Xformable) and pxr.UsdGeom.Xformable(prim).TransformMightBeTimeVarying():
        kinds += ["animation", "moving prims"]
    return kinds


def listed(words: Iterable[str]) -> str:
    """The words as part of a sentence: "a, b and c"; "" for none."""
    *first, last = [*words] or [""]
    return f"{', '.join(first)} and {last}" if first else last
