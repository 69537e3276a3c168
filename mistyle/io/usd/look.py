"""A look layer: new materials for a USD file, which stays unchanged.

    #usda 1.0                    sublayers the source
    over "Chair" (               bindings (and, where a mesh was unwrapped, its new UVs) as overs on the source's prims
        variantSets = "look"     one variant per style: the materials that the bindings name
    )

The bindings lie outside the variants: the source's opinions are local ones, which are stronger than any variant's. So
the variants hold only the materials, in the scope `look` of the root prim.
"""

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mistyle.core.asset import Asset
from mistyle.core.errors import InputRefused, MistyleError, UsageError
from mistyle.io.materialx import TexturedMaterial
from mistyle.io.usd.mesh import Polygons, polygons, uv_primvar
from mistyle.io.usd.shapes import is_shape
from mistyle.io.usd.stage import mesh_prims, open_stage
from mistyle.io.usd.write import define_material, library

SET = "look"


@dataclass(frozen=True)
class _SourceMesh:
    """A mesh prim of the source: its path, its faces in the asset, its polygons, whether its transform mirrors it."""

    name: str
    faces: slice
    shape: Polygons
    mirrored: bool


def write_look(
    path: Path, before: str | None, asset: Asset, looks: Sequence[TexturedMaterial], variant: str, *, beside: Path
) -> None:
    """Write the layer `path` (.usda): `before` with one variant more, or a new one; the new variant is selected.

    `asset` is the USD file as it was read, `looks` its materials by part, `beside` the folder of the layer. Raises
    InputRefused where the file has changed since, UsageError where `before` lies over another file.
    """
    pxr = library()
    source = open_stage(pxr, asset.source.path)
    path.write_text(before or "#usda 1.0\n", encoding="utf-8")
    stage = _opened(pxr, path, source, os.path.relpath(asset.source.path, beside))
    shapes = _shapes(pxr, source, asset)
    root = "/" + shapes[0].name.strip("/").split("/")[0]
    default_prim = source.GetDefaultPrim()
    root = str(default_prim.GetPath()) if default_prim else root
    if not stage.GetRootLayer().HasDefaultPrim():
        stage.SetDefaultPrim(stage.GetPrimAtPath(root))
    prim = stage.OverridePrim(root)
    sets = prim.GetVariantSets().AddVariantSet(SET)
    sets.AddVariant(variant)
    sets.SetVariantSelection(variant)
    used = sorted({int(k) for mesh in shapes for k in np.unique(asset.mesh.part[mesh.faces])})
    names = {part: f"{root}/{SET}/{looks[part].name}" for part in used}
    primvars = {_authored_primvar(pxr, source, asset, mesh) for mesh in shapes}
    primvar = primvars.pop() if len(primvars) == 1 else None
    if primvar is None:
        primvar = f"st_{variant}"
        for mesh in shapes:
            _author(pxr, stage, asset, mesh, primvar)
    for mesh in shapes:
        _editable(stage, mesh.name)
    with sets.GetVariantEditContext():
        pxr.UsdGeom.Scope.Define(stage, f"{root}/{SET}")
        for part, place in names.items():
            define_material(pxr, stage, place, looks[part], primvar)
    for mesh in shapes:
        _bind(pxr, stage, mesh, asset.mesh.part[mesh.faces], names, looks)
    stage.GetRootLayer().Save()


def _opened(pxr: Any, path: Path, source: Any, relative: str) -> Any:
    """The layer over the source, with the stage metadata that only a root layer can hold."""
    layer = pxr.Sdf.Layer.FindOrOpen(str(path))
    over = Path(relative).as_posix()
    over = over if over.startswith("..") else f"./{over}"
    if list(layer.subLayerPaths) not in ([], [over]):
        raise UsageError(
            f"{path.name}: this layer lies over {layer.subLayerPaths[0]}, not over {over}; deliver into another folder"
        )
    layer.subLayerPaths = [over]
    stage = pxr.Usd.Stage.Open(layer)
    pxr.UsdGeom.SetStageUpAxis(stage, pxr.UsdGeom.GetStageUpAxis(source))
    pxr.UsdGeom.SetStageMetersPerUnit(stage, pxr.UsdGeom.GetStageMetersPerUnit(source))
    if source.HasAuthoredTimeCodeRange():
        stage.SetStartTimeCode(source.GetStartTimeCode())
        stage.SetEndTimeCode(source.GetEndTimeCode())
        stage.SetTimeCodesPerSecond(source.GetTimeCodesPerSecond())
    return stage


def _shapes(pxr: Any, source: Any, asset: Asset) -> list[_SourceMesh]:
    """Every mesh prim of the asset in the source. InputRefused where the file has other meshes than the asset."""
    path = asset.source.path
    prims = {str(prim.GetPath()): (prim, matrix) for prim, _, matrix in mesh_prims(pxr, source, path, [])}
    result: dict[str, _SourceMesh] = {}
    for entry in asset.source.primitives:
        prim, matrix = prims.get(entry.name, (None, None))
        if prim is not None and is_shape(prim):
            kind = str(prim.GetTypeName())
            raise InputRefused(
                f"{path}: {entry.name} is a {kind}, which has no faces for a look to name; expected meshes. Turn it "
                "into a mesh, or deliver another format"
            )
        shape = None if prim is None else polygons(pxr, prim, path)
        if shape is None or matrix is None or len(shape.corner) != entry.stop - entry.start:
            raise InputRefused(f"{path}: {entry.name} is no longer the mesh that the run read; run the job again")
        mirrored = bool(np.linalg.det(matrix[:3, :3]) < 0)
        result[entry.name] = _SourceMesh(entry.name, slice(entry.start, entry.stop), shape, mirrored)
    return list(result.values())


def _authored_primvar(pxr: Any, source: Any, asset: Asset, mesh: _SourceMesh) -> str | None:
    """The primvar of the file that holds the asset's UVs; None where it holds others."""
    primvar = uv_primvar(pxr, pxr.UsdGeom.Mesh(source.GetPrimAtPath(mesh.name)), [])
    if (
        asset.source.old_uvs is None or not primvar or "2" not in str(primvar.GetTypeName())
    ):  # readers of two components
        return None
    step = asset.mesh.corner_uvs[mesh.faces] - asset.source.old_uvs[mesh.faces]
    # Equal up to whole tiles: the texture repeats, so the file's own UVs suffice.
    same = np.abs(step - np.round(step[:, :1])).max(initial=0) < 1e-4
    return str(primvar.GetPrimvarName()) if same else None


def _author(pxr: Any, stage: Any, asset: Asset, mesh: _SourceMesh, primvar: str) -> None:
    """Author the UVs that a mesh has in the asset as `primvar`."""
    prim, shape, mirrored = _editable(stage, mesh.name), mesh.shape, mesh.mirrored
    new = asset.mesh.corner_uvs[mesh.faces]
    corner = shape.corner[:, [0, 2, 1]] if mirrored else shape.corner
    values = np.zeros((len(shape.vertices), 2), np.float32)
    values[corner.reshape(-1)] = new.reshape(-1, 2)
    api = pxr.UsdGeom.PrimvarsAPI(prim)
    if np.abs(values[corner] - new).max() > 1e-6 or _is_cut(stage, mesh.name):
        # A chart ends inside a polygon: its triangles become the faces.
        _cut(pxr, stage, prim, shape)
        values = new.reshape(-1, 2) if shape.turned == mirrored else new[:, [0, 2, 1]].reshape(-1, 2)
    st = api.CreatePrimvar(primvar, pxr.Sdf.ValueTypeNames.TexCoord2fArray, pxr.UsdGeom.Tokens.faceVarying)
    st.Set(pxr.Vt.Vec2fArray.FromNumpy(np.ascontiguousarray(values, np.float32)))


def _editable(stage: Any, name: str) -> Any:
    """The prim without instancing: prims inside an instance cannot be overridden."""
    parts = name.strip("/").split("/")
    for count in range(1, len(parts) + 1):
        prim = stage.GetPrimAtPath("/" + "/".join(parts[:count]))
        if prim.IsInstance():
            prim.SetInstanceable(False)
    return stage.GetPrimAtPath(name)


def _is_cut(stage: Any, name: str) -> bool:
    spec = stage.GetRootLayer().GetAttributeAtPath(f"{name}.faceVertexCounts")
    return spec is not None


def _cut(pxr: Any, stage: Any, prim: Any, shape: Polygons) -> None:
    """Override a mesh's topology by its triangles, with its per-face and per-corner primvars."""
    if _is_cut(stage, str(prim.GetPath())):
        return
    corner = shape.corner[:, [0, 2, 1]] if shape.turned else shape.corner
    mesh = pxr.UsdGeom.Mesh(prim)
    taken = {"faceVarying": corner.reshape(-1), "uniform": np.repeat(shape.polygon, 3)}
    for primvar in pxr.UsdGeom.PrimvarsAPI(prim).GetPrimvarsWithValues():
        if primvar.GetInterpolation() in taken:
            values = primvar.ComputeFlattened()
            rows = taken[primvar.GetInterpolation()].tolist()
            primvar.BlockIndices() if primvar.IsIndexed() else None
            primvar.Set(type(values)([values[k] for k in rows]))
            primvar.SetInterpolation(pxr.UsdGeom.Tokens.faceVarying)
    normals, interpolation = mesh.GetNormalsAttr().Get(), mesh.GetNormalsInterpolation()
    if normals and interpolation in taken:
        mesh.GetNormalsAttr().Set(type(normals)([normals[k] for k in taken[interpolation].tolist()]))
        mesh.SetNormalsInterpolation(pxr.UsdGeom.Tokens.faceVarying)
    mesh.GetFaceVertexCountsAttr().Set(pxr.Vt.IntArray.FromNumpy(np.full(len(corner), 3, np.int32)))
    indices = shape.vertices[corner].reshape(-1).astype(np.int32)
    mesh.GetFaceVertexIndicesAttr().Set(pxr.Vt.IntArray.FromNumpy(indices))
    if mesh.GetHoleIndicesAttr().Get():
        mesh.GetHoleIndicesAttr().Set(pxr.Vt.IntArray())


def _bind(
    pxr: Any, stage: Any, source: _SourceMesh, part: np.ndarray, names: Any, looks: Sequence[TexturedMaterial]
) -> None:
    """Bind a mesh and its subsets; where these do not fit the parts, a subset per part takes their place."""
    api = pxr.UsdShade.MaterialBindingAPI
    prim = stage.GetPrimAtPath(source.name)
    parts = np.unique(part)
    subsets = [s for s in api(prim).GetMaterialBindSubsets() if not s.GetPrim().GetName().startswith(f"{SET}_")]
    own = None if _is_cut(stage, source.name) else _parts_of_subsets(pxr, subsets, source.shape, part)
    if own is not None:
        rest, of_subset = own
        _bound(pxr, stage, prim, names[parts[0] if rest is None else rest])
        for subset, k in zip(subsets, of_subset, strict=True):
            if k is not None:
                _bound(pxr, stage, subset.GetPrim(), names[k])
        if subsets and api(prim).GetMaterialBindSubsetsFamilyType() == pxr.UsdGeom.Tokens.unrestricted:
            api(prim).SetMaterialBindSubsetsFamilyType(pxr.UsdGeom.Tokens.nonOverlapping)
        return
    for subset in subsets:
        subset.GetPrim().SetActive(False)
    _bound(pxr, stage, prim, names[parts[0]])
    if len(parts) == 1:
        return
    face = np.arange(len(part)) if _is_cut(stage, source.name) else source.shape.polygon
    mesh, taken = pxr.UsdGeom.Mesh(prim), np.zeros(0, np.int64)
    for k in parts:
        rows = np.setdiff1d(np.unique(face[part == k]), taken)
        taken = np.union1d(taken, rows)
        indices = pxr.Vt.IntArray.FromNumpy(rows.astype(np.int32))
        label = f"{SET}_{looks[k].name}"
        subset = pxr.UsdGeom.Subset.CreateGeomSubset(mesh, label, pxr.UsdGeom.Tokens.face, indices, "materialBind")
        _bound(pxr, stage, subset.GetPrim(), names[k])
    whole = len(taken) == len(mesh.GetFaceVertexCountsAttr().Get())
    kind = pxr.UsdGeom.Tokens.partition if whole else pxr.UsdGeom.Tokens.nonOverlapping
    api(mesh).SetMaterialBindSubsetsFamilyType(kind)


def _parts_of_subsets(
    pxr: Any, subsets: Sequence[Any], shape: Polygons, part: np.ndarray
) -> tuple[int | None, list[int | None]] | None:
    """The part of the faces outside all subsets and that of each subset (None: no faces); None where one has several
    parts."""
    outside, found = np.ones(len(part), bool), []
    for subset in subsets:
        rows = np.array(subset.GetIndicesAttr().Get(pxr.Usd.TimeCode.EarliestTime()) or [], np.int64)
        inside = np.isin(shape.polygon, rows)
        outside &= ~inside
        found.append(np.unique(part[inside]).tolist())
    rest, *of_subset = [np.unique(part[outside]).tolist(), *found]
    if len(rest) > 1 or any(len(own) > 1 for own in of_subset):
        return None
    return next(iter(rest), None), [next(iter(own), None) for own in of_subset]


def _bound(pxr: Any, stage: Any, prim: Any, place: str) -> None:
    """Bind, for every purpose that the source binds a material for."""
    material = pxr.UsdShade.Material.Get(stage, place)
    api = pxr.UsdShade.MaterialBindingAPI.Apply(prim)
    api.Bind(material)
    for purpose in ("full", "preview"):
        if prim.GetRelationship(f"material:binding:{purpose}"):
            api.Bind(material, materialPurpose=purpose)
    bound = api.ComputeBoundMaterial()[0]
    if not bound or str(bound.GetPath()) != place:
        raise MistyleError(
            f"{prim.GetPath()}: a stronger binding in the source keeps {bound.GetPath() if bound else 'no material'}; "
            "remove its strongerThanDescendants or collection binding"
        )
