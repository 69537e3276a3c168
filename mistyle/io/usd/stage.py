"""The stage of a USD file: opening, skeleton pose, and its meshes in world space. Needs `usd-core`.

layers.py checks every layer before composition. Each prototype of a point instancer is read once, at its first
instance, since all instances show the same texels.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from mistyle.core.asset import TURNED
from mistyle.core.paths import real_path
from mistyle.geometry.similarity import Y_FROM_Z
from mistyle.io.sandbox.bounds import MAX_NODES, refuse
from mistyle.io.usd.layers import COPY, CheckedLayers, check_layers, place_of, usd_message
from mistyle.io.usd.mtlx import preview_layer
from mistyle.io.usd.shapes import is_shape


def open_stage(pxr: Any, path: Path, notes: list[str] | None = None) -> Any:
    """The composed stage of a file whose layers have passed. Raises InputRefused for every composition error.

    References to MaterialX documents become preview materials in memory (mtlx.py); the files stay unchanged.
    """
    checked = check_layers(pxr, path)
    try:
        layers = _with_previews(pxr, checked, [] if notes is None else notes)  # edited in memory: kept until it is open
        stage = pxr.Usd.Stage.Open(str(real_path(path)))
        # A document's layer holds its materials only; what else it is referenced for is absent.
        absent = [f"prim path @{layer.identifier}@" for layer in layers.values() if layer and layer.anonymous]
        errors = [e for e in stage.GetCompositionErrors() if not any(words in str(e) for words in absent)]
        used = [place_of(layer).file for layer in stage.GetUsedLayers() if not layer.anonymous]
    except pxr.Tf.ErrorException as error:
        raise refuse(
            path, f"a stage that USD cannot open ({usd_message(error)})", "a USD file", "Export it again"
        ) from None
    if errors:
        problem = f"a stage that does not compose ({str(errors[0]).strip().splitlines()[0][:160]})"
        raise refuse(path, problem, "references without cycles to existing prims", "Flatten or repair the stage")
    unknown = [file for file in used if file not in checked.files]
    if unknown:  # USD resolves `..` in a layer behind a link from the link's folder
        raise refuse(path, f"a link to a layer that names {unknown[0]}", checked.folders.expected, COPY)
    return stage


def _with_previews(pxr: Any, checked: CheckedLayers, notes: list[str]) -> dict[str, Any]:
    """Replace the references to MaterialX documents, in memory, by layers with their materials; returns these layers
    and the edited ones."""
    layers: dict[str, Any] = {}
    notes += checked.notes
    for place, name, document in checked.documents:
        key = str(document)
        if document is not None and key not in layers:
            layers[key] = preview_layer(pxr, document, checked.folders, notes)[0]
        preview, edited = layers.get(key), pxr.Sdf.Layer.FindOrOpen(str(place))
        layers[f"edited {place}"] = edited
        edited.UpdateCompositionAssetDependency(name, preview.identifier if preview else "")
    return layers


def pose(pxr: Any, stage: Any) -> None:
    """Put skinned meshes into the pose of their skeletons at the first time; the file stays unchanged."""
    stage.SetEditTarget(stage.GetSessionLayer())
    # Each prototype once, not at every instance: a small file may have millions of nested instances.
    prims = list(stage.Traverse())
    shared = [prim for prototype in stage.GetPrototypes() for prim in pxr.Usd.PrimRange(prototype)]
    moving = [p for p in (*prims, *shared) if p.IsA(pxr.UsdSkel.Animation)]
    times = [t for p in moving for a in p.GetAttributes() for t in a.GetTimeSamples()[:1]]
    first = min(times, default=0.0)
    for prim in prims:
        if prim.IsA(pxr.UsdSkel.Root):
            pxr.UsdSkel.BakeSkinning(pxr.UsdSkel.Root(prim), pxr.Gf.Interval(first, first))


def metres(pxr: Any, stage: Any) -> float:
    """The stage's unit; accepts numbers of another type than the schema's, which USD refuses."""
    try:
        return float(pxr.UsdGeom.GetStageMetersPerUnit(stage))
    except pxr.Tf.ErrorException:
        value = stage.GetRootLayer().pseudoRoot.GetInfo("metersPerUnit")
        return float(value) if isinstance(value, int | float) else 0.01


def user_matrix(pxr: Any, stage: Any, notes: list[str]) -> Float[np.ndarray, "4 4"]:
    """From the stage's units and axis to metres and Y up, for row vectors."""
    unit = metres(pxr, stage)
    unit = unit if np.isfinite(unit) and unit > 0 else 1.0
    z_up = pxr.UsdGeom.GetStageUpAxis(stage) == pxr.UsdGeom.Tokens.z
    if z_up or unit != 1:
        turned = f"turned from Z{TURNED}" if z_up else ""
        scaled = f"scaled from units of {unit:g} m to metres" if unit != 1 else ""
        notes.append(f"The stage was {' and '.join(x for x in (turned, scaled) if x)}.")
    matrix = np.eye(4)
    matrix[:3, :3] = unit * (Y_FROM_Z.T if z_up else np.eye(3))
    return matrix


def mesh_prims(pxr: Any, stage: Any, path: Path, notes: list[str]) -> Iterator[tuple[Any, str, np.ndarray]]:
    """(prim, path shared by its instances, world matrix for row vectors) of every visible mesh, in stage order."""
    time = pxr.Usd.TimeCode.EarliestTime()
    cache = pxr.UsdGeom.XformCache(time)
    every = pxr.Usd.TraverseInstanceProxies(pxr.Usd.PrimDefaultPredicate)
    visited = iter(pxr.Usd.PrimRange(stage.GetPseudoRoot(), every))
    for count, prim in enumerate(visited):
        if count > MAX_NODES:
            raise refuse(path, f"more than {MAX_NODES} prims", "fewer", "Flatten instances that are not needed")
        if not _shown(pxr, prim, time, notes):
            visited.PruneChildren()
        elif prim.IsA(pxr.UsdGeom.PointInstancer):
            visited.PruneChildren()
            yield from _prototypes(pxr, prim, cache, time, notes)
        elif prim.IsA(pxr.UsdGeom.Mesh) or is_shape(prim):
            inside = prim.GetPrimInPrototype() if prim.IsInstanceProxy() else prim
            yield prim, str(inside.GetPath()), np.array(cache.GetLocalToWorldTransform(prim))
        elif prim.IsA(pxr.UsdGeom.Gprim):
            notes.append("Shapes that are not surfaces (curves, points, volumes) were left out.")


def _shown(pxr: Any, prim: Any, time: Any, notes: list[str]) -> bool:
    imageable = pxr.UsdGeom.Imageable(prim)
    if not imageable:
        return True
    if imageable.GetVisibilityAttr().Get(time) == pxr.UsdGeom.Tokens.invisible:
        notes.append("Invisible prims were left out.")
        return False
    if imageable.ComputePurpose() in (pxr.UsdGeom.Tokens.proxy, pxr.UsdGeom.Tokens.guide):
        notes.append("Prims of purpose proxy or guide were left out.")
        return False
    return True


def _prototypes(pxr: Any, prim: Any, cache: Any, time: Any, notes: list[str]) -> Iterator[tuple[Any, str, np.ndarray]]:
    """The meshes of each prototype, placed by its first instance (scale, rotation, translation)."""
    instancer = pxr.UsdGeom.PointInstancer(prim)
    which = np.array(instancer.GetProtoIndicesAttr().Get(time) or [], np.int64)
    at = instancer.GetPositionsAttr().Get(time)
    turns, scales = instancer.GetOrientationsAttr().Get(time), instancer.GetScalesAttr().Get(time)
    notes.append("Each prototype of a point instancer was read once, at its first instance.")
    world = np.array(cache.GetLocalToWorldTransform(prim))
    for k, target in enumerate(instancer.GetPrototypesRel().GetForwardedTargets()):
        own, first = prim.GetStage().GetPrimAtPath(target), np.flatnonzero(which == k)
        if not own or not len(first) or at is None or first[0] >= len(at):
            continue
        i = int(first[0])
        place = np.eye(4)
        if turns is not None and i < len(turns):
            place = np.array(pxr.Gf.Matrix4d().SetRotate(pxr.Gf.Quatd(turns[i])))
        if scales is not None and i < len(scales):
            place = np.diag([*map(float, scales[i]), 1.0]) @ place
        place[3, :3] = np.array(at[i], float)
        above = np.linalg.pinv(np.array(cache.GetParentToWorldTransform(own)))
        for inner in pxr.Usd.PrimRange(own, pxr.Usd.TraverseInstanceProxies(pxr.Usd.PrimDefaultPredicate)):
            if inner.IsA(pxr.UsdGeom.Mesh) or is_shape(inner):
                local = np.array(cache.GetLocalToWorldTransform(inner)) @ above
                yield inner, str(inner.GetPath()), local @ place @ world
