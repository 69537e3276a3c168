"""Reader of USD stages: triangles of every visible mesh, in metres and Y up, with preview surfaces. Needs `usd-core`.

Values are those of the default time, of animated ones the earliest. A subdivision surface is read as its control cage.
"""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from mistyle.core.asset import Primitive, Shading
from mistyle.io.images.read import Budget
from mistyle.io.meshes.parsed_mesh import Raw
from mistyle.io.meshes.polygons import too_many
from mistyle.io.sandbox.bounds import refuse
from mistyle.io.usd.bindings import missing_binding, missing_notes
from mistyle.io.usd.contents import unheld_notes
from mistyle.io.usd.layers import check_layers, textures_named, tiles_of, usd_folders
from mistyle.io.usd.materials import UsdMaterial, at_own_coordinates, outside, plain, read_material
from mistyle.io.usd.mesh import CornerValues, Polygons, corner_normals, is_cage, polygons, table_of, triples
from mistyle.io.usd.mtlx import preview_layer
from mistyle.io.usd.shapes import is_shape
from mistyle.io.usd.stage import mesh_prims, open_stage, pose, user_matrix
from mistyle.io.usd.write import library


@dataclass(frozen=True)
class _MeshPiece:
    """One mesh prim in world space; `owner` is the path that its instances share."""

    name: str
    owner: str
    positions: np.ndarray
    faces: np.ndarray
    normals: np.ndarray | None
    uvs: np.ndarray | None
    material: np.ndarray
    colours: np.ndarray | None
    others: dict[str, np.ndarray]


class _Reading:
    """State of reading one stage: materials and notes collected over the prims."""

    def __init__(self, pxr: Any, path: Path, max_faces: int) -> None:
        self.pxr, self.path, self.max_faces = pxr, path, max_faces
        self.time = pxr.Usd.TimeCode.EarliestTime()
        self.notes: list[str] = []
        self.materials: list[UsdMaterial] = []
        self.missing: list[str] = []  # paths of bound materials that the stage does not have
        self._numbers: dict[str, int] = {}
        self._budget, self._folders = Budget(path), usd_folders(path)

    def number(self, prim: Any, shown: UsdMaterial) -> tuple[int, bool]:
        """The index in `materials` of the material bound to `prim`, and whether one is.

        A bound material that the stage does not have looks like `shown` and has its own name; without a binding the
        material is `shown`.
        """
        material, display = _material_of(self.pxr, prim, self.notes), shown.material
        key = str(material.GetPath()) if material else f"{display.albedo_factor} {shown.colour} {display.shading}"
        path = "" if material else missing_binding(self.pxr, prim)
        if path:
            self.missing += [path] if path not in self.missing else []
            key = f"{path} {key}"
            shown = replace(shown, material=replace(display, name=path.rsplit("/", 1)[-1]))
        if key not in self._numbers:
            self._numbers[key] = len(self.materials)
            arguments = (self._folders, self._budget, self.time, self.notes)
            self.materials.append(read_material(self.pxr, material, *arguments) if material else shown)
        return self._numbers[key], bool(material or path)


def files_of(path: Path) -> list[Path]:
    """The layers, packages and textures that a file depends on, including itself."""
    pxr = library()
    checked = check_layers(pxr, path)
    files = [*checked.files, *textures_named(pxr, checked)]
    documents = {str(document): document for _, _, document in checked.documents if document is not None}
    for document in documents.values():
        textures = [Path(name) for name in preview_layer(pxr, document, checked.folders, [])[1]]
        files += [tile for texture in textures for tile in tiles_of(texture)]
    return list(dict.fromkeys(files))


def read_usd(path: Path, max_faces: int) -> Raw:
    """Triangles of all visible meshes of purpose default or render, in stage order, one material per bound material."""
    pxr = library()
    reading = _Reading(pxr, path, max_faces)
    stage = open_stage(pxr, path, reading.notes)
    reading.notes += unheld_notes(pxr, stage)
    pose(pxr, stage)
    user, pieces, faces = user_matrix(pxr, stage, reading.notes), [], 0
    for prim, owner, matrix in mesh_prims(pxr, stage, path, reading.notes):
        piece = _piece(reading, prim, owner, matrix @ user)
        if piece is not None:
            faces += len(piece.faces)
            too_many(faces, max_faces, path)
            pieces.append(piece)
    if not pieces:
        raise refuse(path, "no mesh on its stage", "at least one visible mesh", "Export the mesh itself")
    return _raw(pieces, reading.materials, [*reading.notes, *missing_notes(reading.missing)])


def _raw(pieces: list[_MeshPiece], materials: list[UsdMaterial], notes: list[str]) -> Raw:
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
        blanks = [np.full((len(p.faces), 3, width), missing, np.float32) for p in pieces]
        return np.concatenate([blank if part is None else part for part, blank in zip(parts, blanks, strict=True)])

    material, uvs = np.concatenate([p.material for p in pieces]), joined("uvs", 2)
    used = np.unique(material)
    missing = [np.full((len(p.faces), 3, 2), np.nan, np.float32) for p in pieces]
    names = dict.fromkeys(name for k in used for name in materials[k].others().values())
    others = {
        n: np.concatenate([p.others.get(n, blank) for p, blank in zip(pieces, missing, strict=True)]) for n in names
    }
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


def _piece(reading: _Reading, prim: Any, owner: str, matrix: Float[np.ndarray, "4 4"]) -> _MeshPiece | None:
    """A mesh prim transformed by `matrix` (row vectors); None, perhaps with a note, where it has no triangles."""
    pxr, time, notes = reading.pxr, reading.time, reading.notes
    mesh = pxr.UsdGeom.Mesh(prim)
    shape = polygons(pxr, prim, reading.path, reading.max_faces)
    if is_shape(prim):
        notes.append("Shapes other than meshes (spheres, cubes and the like) were read as meshes.")
    elif shape is None and mesh.GetPointsAttr().HasAuthoredValue() and triples(mesh.GetPointsAttr().Get(time)) is None:
        notes.append("A mesh whose points are of another type than point3f[] was left out.")
    if shape is None or not len(shape.corner):
        return None
    if is_cage(pxr, prim, time):
        notes.append("A subdivision surface was read as its control cage.")
    if "SkelBindingAPI" in prim.GetAppliedSchemas():
        notes.append("A skinned mesh was read in the pose of its skeleton at the first time.")
    elif not is_shape(prim) and mesh.GetPointsAttr().ValueMightBeTimeVarying():
        notes.append("Only the first frame of an animated mesh was read.")
    if not np.isfinite(matrix).all():
        problem = f"{prim.GetPath()} with a transform that is not finite"
        raise refuse(reading.path, problem, "finite numbers", "Export it again")
    linear = matrix[:3, :3]
    if np.linalg.det(linear) < 0:
        shape = replace(shape, corner=shape.corner[:, [0, 2, 1]], turned=True)
    material = _bound(reading, prim, shape)
    normals = corner_normals(pxr, prim, shape, time, notes)
    values = CornerValues(pxr, mesh, shape, time, material, reading.materials, notes)
    return _MeshPiece(
        name=str(prim.GetPath()),
        owner=owner,
        positions=shape.points @ linear + matrix[3, :3],
        faces=shape.vertices[shape.corner],
        normals=None if normals is None else _turned(normals, linear),
        uvs=values.uvs(),
        material=material,
        colours=values.colours(),
        others=values.other_uvs(),
    )


def _turned(normals: np.ndarray, linear: np.ndarray) -> Float[np.ndarray, "f 3 3"]:
    """Unit normals by the inverse transpose (row vectors)."""
    turned = normals.astype(np.float64) @ np.linalg.pinv(linear).T
    length = np.linalg.norm(turned, axis=-1, keepdims=True)
    return (turned / np.where(length > 0, length, 1)).astype(np.float32)


def _bound(reading: _Reading, prim: Any, shape: Polygons) -> Int[np.ndarray, " f"]:
    """The material of every triangle: that of its subset, else the mesh's own, else its display colour."""
    pxr, time, notes = reading.pxr, reading.time, reading.notes
    api = pxr.UsdShade.MaterialBindingAPI
    shown = _display(pxr, prim, time)
    of_polygon = np.full(len(shape.sizes), -1, np.int64)
    for subset in api(prim).GetMaterialBindSubsets():
        rows = np.array(subset.GetIndicesAttr().Get(time) or [], np.int64)
        rows = rows[(rows >= 0) & (rows < len(of_polygon))]
        of_polygon[rows], _ = reading.number(subset.GetPrim(), shown)
    if (of_polygon < 0).any():
        of_polygon[of_polygon < 0], own = reading.number(prim, shown)
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
    """The material bound for previews or for all purposes, else that for full renders."""
    tokens = pxr.UsdShade.Tokens
    binding = pxr.UsdShade.MaterialBindingAPI(prim)
    material = binding.ComputeBoundMaterial(tokens.preview)[0]
    if material:
        return material
    material = binding.ComputeBoundMaterial(tokens.full)[0]
    if material:
        notes.append("Materials bound only for full renders were used.")
    return material


def _display(pxr: Any, prim: Any, time: Any) -> UsdMaterial:
    """The material of a mesh without one: its display colour, by vertex where it has several."""
    primvars = pxr.UsdGeom.PrimvarsAPI(prim)
    primvar = primvars.FindPrimvarWithInheritance("displayColor")
    values = table_of(primvar, time) if primvar and primvar.HasValue() else None
    cover = primvars.FindPrimvarWithInheritance("displayOpacity")
    opacity = table_of(cover, time) if cover and cover.HasValue() else None
    shading = Shading()
    if opacity is not None and opacity.shape == (1, 1):
        shading = Shading(opacity=float(np.clip(opacity[0, 0], 0, 1)))
    if values is None or values.shape[1] != 3:
        return plain("material", shading=replace(shading, stated="nothing"))
    if len(values) > 1:
        return plain("material", colour="displayColor", shading=shading)
    red, green, blue = (float(c) for c in np.clip(np.nan_to_num(values[0], nan=1.0), 0, 1))
    return plain("material", (red, green, blue), shading=shading)
