"""USD to triangles: every visible mesh of the stage, in metres and Y up, with its preview surfaces. Needs `usd-core`.

Nothing is composed before usd_layers.py has seen every layer. Values are those of the default time, of animated ones
the earliest. A subdivision surface comes as its control cage; of point instancers each prototype is read once, where
its first instance stands, since all instances show the same texels.
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from mistyle.core.asset import TURNED, Primitive, Shading
from mistyle.core.normals import crease_normals, same_points
from mistyle.files.bounds import MAX_NODES, refuse
from mistyle.files.pictures import Budget
from mistyle.files.polygons import check_indices, check_positions, too_many, triangulate
from mistyle.files.raw import Raw
from mistyle.files.usd import library
from mistyle.files.usd_layers import check_layers, said, textures_named
from mistyle.files.usd_materials import Found, at_own_coordinates, outside, plain, read_material
from mistyle.files.usd_shapes import is_shape, outline

Y_FROM_Z = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
CAGE_CREASE = 89.0  # degrees; sharper edges of a cage would have normals that face away from who sees them
UV_NAMES = ("st", "UVMap", "map1", "uv")


@dataclass(frozen=True)
class Polygons:
    """A mesh prim's faces: `corner` (t 3) are the polygon corners of every triangle, `polygon` its polygon.

    vertices  the point of every polygon corner
    turned    the file's corners are clockwise (leftHanded): corners 1 and 2 of every triangle are swapped
    """

    points: Float[np.ndarray, "v 3"]
    sizes: Int[np.ndarray, " p"]
    vertices: Int[np.ndarray, " c"]
    corner: Int[np.ndarray, "t 3"]
    polygon: Int[np.ndarray, " t"]
    turned: bool


@dataclass(frozen=True)
class _Piece:
    """One mesh prim where it stands; `owner` is what instances of it share."""

    name: str
    owner: str
    positions: np.ndarray
    faces: np.ndarray
    normals: np.ndarray | None
    uvs: np.ndarray | None
    material: np.ndarray
    colours: np.ndarray | None
    others: dict[str, np.ndarray]


def open_stage(pxr: Any, path: Path) -> Any:
    """The composed stage of a file whose layers have passed. Raises InputRefused for every composition error."""
    check_layers(pxr, path)
    try:
        stage = pxr.Usd.Stage.Open(str(path.resolve()))
        errors = stage.GetCompositionErrors()
    except pxr.Tf.ErrorException as error:
        raise refuse(path, f"a stage that USD cannot open ({said(error)})", "a USD file", "Export it again") from None
    if errors:
        found = f"a stage that does not compose ({str(errors[0]).strip().splitlines()[0][:160]})"
        raise refuse(path, found, "references without cycles to prims that are there", "Flatten or repair the stage")
    return stage


def files_of(path: Path) -> list[Path]:
    """The layers, packages and textures that a file stands on, itself among them."""
    pxr = library()
    files = check_layers(pxr, path)
    return [*files, *textures_named(pxr, files, path.resolve().parent)]


def read_usd(path: Path, max_faces: int) -> Raw:
    """Triangles of all visible meshes of purpose default or render, in stage order, one material per bound material."""
    pxr = library()
    stage = open_stage(pxr, path)
    time, notes = pxr.Usd.TimeCode.EarliestTime(), []
    found: dict[str, int] = {}
    materials: list[Found] = []
    budget, root = Budget(path), path.resolve().parent

    def number(material: Any, shown: Found) -> int:
        here = shown.material
        key = str(material.GetPath()) if material else f"{here.albedo_factor} {shown.colour} {here.shading}"
        if key not in found:
            found[key] = len(materials)
            materials.append(read_material(pxr, material, root, budget, time, notes) if material else shown)
        return found[key]

    _pose(pxr, stage)
    user, pieces, faces = _user_matrix(pxr, stage, notes), [], 0
    for prim, owner, matrix in mesh_prims(pxr, stage, path, notes):
        piece = _piece(pxr, prim, owner, matrix @ user, time, path, max_faces, number, materials, notes)
        if piece is not None:
            faces += len(piece.faces)
            too_many(faces, max_faces, path)
            pieces.append(piece)
    if not pieces:
        raise refuse(path, "no mesh on its stage", "at least one visible mesh", "Export the mesh itself")
    return _raw(pieces, materials, notes, path)


def _raw(pieces: list[_Piece], materials: list[Found], notes: list[str], path: Path) -> Raw:
    starts = np.cumsum([0, *(len(p.faces) for p in pieces)])
    first = np.cumsum([0, *(len(p.positions) for p in pieces)])[:-1]
    twin, owners = np.arange(starts[-1]), {}
    for piece, a in zip(pieces, starts[:-1], strict=True):
        begin = owners.setdefault(piece.owner, int(a))
        twin[a : a + len(piece.faces)] = np.arange(begin, begin + len(piece.faces))
    if (twin != np.arange(len(twin))).any():
        notes.append("Instances of a mesh share their texels; the first one's are painted.")

    def joined(name: str, width: int, missing: float = np.nan) -> np.ndarray | None:
        parts = [getattr(p, name) for p in pieces]
        if all(part is None for part in parts):
            return None
        nothing = [np.full((len(p.faces), 3, width), missing, np.float32) for p in pieces]
        return np.concatenate([no if part is None else part for part, no in zip(parts, nothing, strict=True)])

    material, uvs = np.concatenate([p.material for p in pieces]), joined("uvs", 2)
    used = np.unique(material)
    missing = [np.full((len(p.faces), 3, 2), np.nan, np.float32) for p in pieces]
    names = dict.fromkeys(name for k in used for name in materials[k].others().values())
    others = {n: np.concatenate([p.others.get(n, no) for p, no in zip(pieces, missing, strict=True)]) for n in names}
    notes += [note for k in used for note in outside(materials[k], None if uvs is None else uvs[material == k])]
    return Raw(
        kind="usd",
        positions=np.concatenate([p.positions for p in pieces]),
        faces=np.concatenate([p.faces + f for p, f in zip(pieces, first, strict=True)]),
        normals=joined("normals", 3),
        uvs=uvs,
        material=np.searchsorted(used, material),
        materials=tuple(at_own_coordinates(materials[k], others) for k in used),
        primitives=tuple(
            Primitive(-1, -1, -1, int(a), int(b), -1, -1, -1, int(f), p.name)
            for p, a, b, f in zip(pieces, starts[:-1], starts[1:], first, strict=True)
        ),
        twin=twin,
        notes=tuple(dict.fromkeys(notes)),
        colours=joined("colours", 3, 1.0),
    )


def _pose(pxr: Any, stage: Any) -> None:
    """Put skinned meshes into the pose of their skeletons at the first time; the file stays as it is."""
    stage.SetEditTarget(stage.GetSessionLayer())
    # Each prototype once and not at every instance: nested instances of a small file may be millions.
    prims = list(stage.Traverse())
    shared = [prim for prototype in stage.GetPrototypes() for prim in pxr.Usd.PrimRange(prototype)]
    moving = [p for p in (*prims, *shared) if p.IsA(pxr.UsdSkel.Animation)]
    times = [t for p in moving for a in p.GetAttributes() for t in a.GetTimeSamples()[:1]]
    first = min(times, default=0.0)
    for prim in prims:
        if prim.IsA(pxr.UsdSkel.Root):
            pxr.UsdSkel.BakeSkinning(pxr.UsdSkel.Root(prim), pxr.Gf.Interval(first, first))


def metres(pxr: Any, stage: Any) -> float:
    """The stage's unit; numbers of another type than the schema's, which USD would refuse, count as well."""
    try:
        return float(pxr.UsdGeom.GetStageMetersPerUnit(stage))
    except pxr.Tf.ErrorException:
        said = stage.GetRootLayer().pseudoRoot.GetInfo("metersPerUnit")
        return float(said) if isinstance(said, int | float) else 0.01


def _user_matrix(pxr: Any, stage: Any, notes: list[str]) -> Float[np.ndarray, "4 4"]:
    """From the stage's units and axis to metres and Y up, for row vectors."""
    unit = metres(pxr, stage)
    unit = unit if np.isfinite(unit) and unit > 0 else 1.0
    z_up = pxr.UsdGeom.GetStageUpAxis(stage) == pxr.UsdGeom.Tokens.z
    if z_up or unit != 1:
        turned = TURNED if z_up else ""
        scaled = f"scaled from units of {unit:g} m to metres" if unit != 1 else ""
        notes.append(f"The stage was {' and '.join(x for x in (turned, scaled) if x)}.")
    matrix = np.eye(4)
    matrix[:3, :3] = unit * (Y_FROM_Z.T if z_up else np.eye(3))
    return matrix


def mesh_prims(pxr: Any, stage: Any, path: Path, notes: list[str]) -> Iterator[tuple[Any, str, np.ndarray]]:
    """(prim, what its instances share, world matrix for row vectors) of every mesh that is shown, in stage order."""
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


def polygons(pxr: Any, prim: Any, path: Path, max_faces: int = 2**31) -> Polygons | None:
    """The faces of a mesh prim as triangles, in file order; None where it has none. Holes are left out."""
    mesh, time = pxr.UsdGeom.Mesh(prim), pxr.Usd.TimeCode.EarliestTime()
    if is_shape(prim):
        shape = outline(prim, time)
        corner = triangulate(shape.sizes, shape.points[shape.vertices])
        polygon = np.repeat(np.arange(len(shape.sizes)), shape.sizes)[corner[:, 0]]
        return Polygons(shape.points, shape.sizes, shape.vertices, corner, polygon, False)
    points = _triples(mesh.GetPointsAttr().Get(time))
    sizes = np.array(mesh.GetFaceVertexCountsAttr().Get(time) or [], np.int64)
    vertices = np.array(mesh.GetFaceVertexIndicesAttr().Get(time) or [], np.int64)
    if points is None or not len(points) or not len(sizes):
        return None
    again = "Export the mesh again"
    if (sizes < 0).any() or sizes.sum() != len(vertices):
        found = f"{prim.GetPath()} with {len(vertices)} corners for faces of {int(sizes.sum())}"
        raise refuse(path, found, "as many indices as its faces have corners", again)
    too_many(len(sizes), max_faces, path)
    too_many(len(points), 3 * max_faces, path, "vertices")
    check_indices(vertices, len(points), path, "vertex")
    check_positions(points, path)
    corner = triangulate(sizes, points[vertices])
    polygon = np.repeat(np.arange(len(sizes)), sizes)[corner[:, 0]] if len(corner) else np.zeros(0, np.int64)
    holes = np.array(mesh.GetHoleIndicesAttr().Get(time) or [], np.int64)
    kept = ~np.isin(polygon, holes)
    turned = mesh.GetOrientationAttr().Get(time) == pxr.UsdGeom.Tokens.leftHanded
    corner = corner[kept][:, [0, 2, 1]] if turned else corner[kept]
    return Polygons(points, sizes, vertices, corner, polygon[kept], turned)


def _triples(values: Any) -> Float[np.ndarray, "n 3"] | None:
    """A list of three numbers each, no rows where nothing is authored; None for a value of another type."""
    if values is None:
        return np.zeros((0, 3))
    found = np.array(values, np.float64)
    if found.size == 0:
        return np.zeros((0, 3))
    return found if found.ndim == 2 and found.shape[1] == 3 else None


def _piece(pxr, prim, owner, matrix, time, path, max_faces, number, materials, notes) -> _Piece | None:
    mesh = pxr.UsdGeom.Mesh(prim)
    shape = polygons(pxr, prim, path, max_faces)
    if is_shape(prim):
        notes.append("Shapes other than meshes (spheres, cubes and the like) were read as meshes.")
    elif shape is None and mesh.GetPointsAttr().HasAuthoredValue() and _triples(mesh.GetPointsAttr().Get(time)) is None:
        notes.append("A mesh whose points are of another type than point3f[] was left out.")
    if shape is None or not len(shape.corner):
        return None
    if _subdivides(pxr, prim, time):
        notes.append("A subdivision surface was read as its control cage.")
    if "SkelBindingAPI" in prim.GetAppliedSchemas():
        notes.append("A skinned mesh was read in the pose of its skeleton at the first time.")
    elif not is_shape(prim) and mesh.GetPointsAttr().ValueMightBeTimeVarying():
        notes.append("Only the first frame of an animated mesh was read.")
    if not np.isfinite(matrix).all():
        raise refuse(path, f"{prim.GetPath()} with a transform that is not finite", "finite numbers", "Export it again")
    linear = matrix[:3, :3]
    if np.linalg.det(linear) < 0:
        shape = Polygons(shape.points, shape.sizes, shape.vertices, shape.corner[:, [0, 2, 1]], shape.polygon, True)
    positions = shape.points @ linear + matrix[3, :3]
    material = _bound(pxr, prim, shape, number, time, notes)
    normals = _normals(pxr, prim, shape, time, notes)
    return _Piece(
        name=str(prim.GetPath()),
        owner=owner,
        positions=positions,
        faces=shape.vertices[shape.corner],
        normals=None if normals is None else _turned(normals, linear),
        uvs=_uvs(pxr, mesh, shape, material, materials, time, notes),
        material=material,
        colours=_colours(pxr, mesh, shape, material, materials, time, notes),
        others=_other_uvs(pxr, mesh, shape, material, materials, time, notes),
    )


def _turned(normals: np.ndarray, linear: np.ndarray) -> Float[np.ndarray, "f 3 3"]:
    """Unit normals by the inverse transpose (row vectors)."""
    turned = normals.astype(np.float64) @ np.linalg.pinv(linear).T
    length = np.linalg.norm(turned, axis=-1, keepdims=True)
    return (turned / np.where(length > 0, length, 1)).astype(np.float32)


def _bound(pxr: Any, prim: Any, shape: Polygons, number: Any, time: Any, notes: list[str]) -> Int[np.ndarray, " f"]:
    """The material of every triangle: that of its subset, else the mesh's own, else its display colour."""
    api = pxr.UsdShade.MaterialBindingAPI
    shown = _display(pxr, prim, time)
    of_polygon = np.full(len(shape.sizes), -1, np.int64)
    for subset in api(prim).GetMaterialBindSubsets():
        rows = np.array(subset.GetIndicesAttr().Get(time) or [], np.int64)
        rows = rows[(rows >= 0) & (rows < len(of_polygon))]
        of_polygon[rows] = number(_material_of(pxr, subset.GetPrim(), notes), shown)
    if (of_polygon < 0).any():
        own = _material_of(pxr, prim, notes)
        of_polygon[of_polygon < 0] = number(own, shown)
        colour = pxr.UsdGeom.PrimvarsAPI(prim).FindPrimvarWithInheritance("displayColor")
        if not own and not (colour and colour.HasValue()):
            notes.append(
                "A mesh has neither a material nor a display colour: it is drawn matt and grey, as Blender "
                "draws it, and painted as white."
            )
        opacity = pxr.UsdGeom.PrimvarsAPI(prim).FindPrimvarWithInheritance("displayOpacity")
        if not own and opacity and opacity.HasValue() and np.size(opacity.Get(time)) > 1:
            notes.append("displayOpacity was not read where it is not the same everywhere.")
    return of_polygon[shape.polygon]


def _material_of(pxr: Any, prim: Any, notes: list[str]) -> Any:
    """The material bound for previews or for all purposes; where there is none, that for full renders."""
    tokens = pxr.UsdShade.Tokens
    binding = pxr.UsdShade.MaterialBindingAPI(prim)
    found = binding.ComputeBoundMaterial(tokens.preview)[0]
    if found:
        return found
    found = binding.ComputeBoundMaterial(tokens.full)[0]
    if found:
        notes.append("Materials that are bound for full renders alone were taken.")
    return found


def _display(pxr: Any, prim: Any, time: Any) -> Found:
    """What a mesh without a material shows: its display colour, by vertex where it has more than one."""
    primvars = pxr.UsdGeom.PrimvarsAPI(prim)
    primvar = primvars.FindPrimvarWithInheritance("displayColor")
    values = _table(primvar, time) if primvar and primvar.HasValue() else None
    cover = primvars.FindPrimvarWithInheritance("displayOpacity")
    opacity = _table(cover, time) if cover and cover.HasValue() else None
    shading = Shading()
    if opacity is not None and opacity.shape == (1, 1):
        shading = Shading(opacity=float(np.clip(opacity[0, 0], 0, 1)))
    if values is None or values.shape[1] != 3:
        return plain("material", shading=replace(shading, stated="nothing"))
    if len(values) > 1:
        return plain("material", colour="displayColor", shading=shading)
    red, green, blue = (float(c) for c in np.clip(np.nan_to_num(values[0], nan=1.0), 0, 1))
    return plain("material", (red, green, blue), shading=shading)


def _subdivides(pxr: Any, prim: Any, time: Any) -> bool:
    """Whether a prim is the cage of a smooth surface."""
    if is_shape(prim):
        return False
    flat = (pxr.UsdGeom.Tokens.none, pxr.UsdGeom.Tokens.bilinear)
    return pxr.UsdGeom.Mesh(prim).GetSubdivisionSchemeAttr().Get(time) not in flat


def _normals(pxr: Any, prim: Any, shape: Polygons, time: Any, notes: list[str]) -> np.ndarray | None:
    """A prim's own normals; those of the cage, smooth, where it is subdivided and has none."""
    if is_shape(prim):
        return outline(prim, time).normals[shape.corner].astype(np.float32)
    found = _own_normals(pxr, pxr.UsdGeom.Mesh(prim), shape, time, notes)
    if found is None and _subdivides(pxr, prim, time):
        found = crease_normals(shape.points, shape.vertices[shape.corner], same_points(shape.points), CAGE_CREASE)
    return found


def _own_normals(pxr: Any, mesh: Any, shape: Polygons, time: Any, notes: list[str]) -> np.ndarray | None:
    primvar = pxr.UsdGeom.PrimvarsAPI(mesh).GetPrimvar("normals")
    if primvar and primvar.HasValue():
        return _spread(primvar.ComputeFlattened(time), primvar.GetInterpolation(), shape, 3, "normals", notes)
    values = mesh.GetNormalsAttr().Get(time)
    if values is not None and _triples(values) is None:
        notes.append("Normals of another type than normal3f[] were left out.")
        return None
    return _spread(values, mesh.GetNormalsInterpolation(), shape, 3, "normals", notes)


def uv_primvar(pxr: Any, mesh: Any, wanted: list[str]) -> Any:
    """The primvar to look textures up at: the materials' own, a usual name, else the first that holds coordinates."""
    primvars = pxr.UsdGeom.PrimvarsAPI(mesh)
    for name in (*wanted, *UV_NAMES):
        found = primvars.FindPrimvarWithInheritance(name)
        if found and found.HasValue() and _is_pair(found):
            return found
    return next(
        (p for p in primvars.GetPrimvarsWithValues() if _is_pair(p) and "texCoord" in str(p.GetTypeName())), None
    )


def _is_pair(primvar: Any) -> bool:
    """Whether its first two components can be texture coordinates (a third is for volumes)."""
    return re.fullmatch(r"(texCoord|float|double|half)[23][fdh]?(\[\])?", str(primvar.GetTypeName())) is not None


def _uvs(pxr, mesh, shape: Polygons, material, materials: list[Found], time, notes: list[str]) -> np.ndarray | None:
    """Every triangle's corners at the primvar of its own material."""
    result = None
    for name in dict.fromkeys(materials[k].primvar for k in np.unique(material)):
        found = uv_primvar(pxr, mesh, [name] if name else [])
        if found and name and found.GetPrimvarName() != name:
            notes.append(f"There are no texture coordinates '{name}' on a mesh; '{found.GetPrimvarName()}' were used.")
        table = _table(found, time) if found else None
        values = _spread(table, found.GetInterpolation(), shape, 2, "UVs", notes) if found else None
        if values is not None:
            result = np.full(values.shape, np.nan, np.float32) if result is None else result
            rows = np.isin(material, [k for k, m in enumerate(materials) if m.primvar == name])
            result[rows] = values[rows]
    return result


def _other_uvs(pxr, mesh, shape, material, materials: list[Found], time, notes: list[str]) -> dict[str, np.ndarray]:
    """The coordinates that maps of the triangles' materials have beside those of the first map, by primvar."""
    found = {}
    for name in dict.fromkeys(n for k in np.unique(material) for n in materials[k].others().values()):
        primvar = pxr.UsdGeom.PrimvarsAPI(mesh).FindPrimvarWithInheritance(name)
        if primvar and primvar.HasValue() and _is_pair(primvar):
            found[name] = _spread(_table(primvar, time), primvar.GetInterpolation(), shape, 2, "UVs", notes)
    return {name: values for name, values in found.items() if values is not None}


def _colours(pxr, mesh, shape: Polygons, material, materials: list[Found], time, notes: list[str]) -> np.ndarray | None:
    """Linear corner colours of the triangles whose material has a primvar as its albedo, white on the others; None
    where none has."""
    result = None
    for name in dict.fromkeys(materials[k].colour for k in np.unique(material)):
        primvar = pxr.UsdGeom.PrimvarsAPI(mesh).FindPrimvarWithInheritance(name) if name else None
        if not primvar or not primvar.HasValue():
            continue
        values = _spread(_table(primvar, time), primvar.GetInterpolation(), shape, 3, f"{name} values", notes)
        if values is not None:
            result = np.ones_like(values) if result is None else result
            rows = np.isin(material, [k for k, m in enumerate(materials) if m.colour == name])
            result[rows] = np.clip(np.nan_to_num(values[rows], nan=1.0), 0, 1)
    return result


def _table(primvar: Any, time: Any) -> Float[np.ndarray, "n w"] | None:
    """A primvar's values, its indices resolved, one row each; a single value is one row."""
    values = primvar.ComputeFlattened(time) if primvar.GetTypeName().isArray else [primvar.Get(time)]
    if values is None or len(values) == 0 or values[0] is None:
        return None
    return np.array(values, np.float32).reshape(len(values), -1)


def _spread(
    values: Any, interpolation: str, shape: Polygons, width: int, what: str, notes: list[str]
) -> Float[np.ndarray, "f 3 w"] | None:
    """A primvar's values at every triangle corner; None, with a note, where there are not as many as there must be."""
    if values is None or len(values) == 0:
        return None
    table = np.array(values, np.float32).reshape(len(values), -1)[:, : width if what == "UVs" else None]
    where = {
        "faceVarying": (len(shape.vertices), shape.corner),
        "vertex": (len(shape.points), shape.vertices[shape.corner]),
        "varying": (len(shape.points), shape.vertices[shape.corner]),
        "uniform": (len(shape.sizes), np.repeat(shape.polygon[:, None], 3, axis=1)),
        "constant": (1, np.zeros_like(shape.corner)),
    }
    count, index = where.get(str(interpolation), (-1, shape.corner))
    if count != len(table) or table.shape[1] != width:
        notes.append(f"{what} of another number than {interpolation} values need were left out.")
        return None
    return table[index]
