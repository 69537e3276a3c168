"""Reader of a USD mesh prim: triangles, and normals, texture coordinates and colours at their corners."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from mistyle.geometry.normals import crease_normals, same_points
from mistyle.io.meshes.polygons import check_indices, check_positions, too_many, triangulate
from mistyle.io.sandbox.bounds import refuse
from mistyle.io.usd.materials import UsdMaterial
from mistyle.io.usd.shapes import is_shape, outline

CAGE_CREASE = 89.0  # degrees; beyond it, smooth normals at a cage's edges could face away from the viewer
UV_NAMES = ("st", "UVMap", "map1", "uv")


@dataclass(frozen=True)
class Polygons:
    """A mesh prim's faces: `corner` (t 3) are the polygon corners of every triangle, `polygon` its polygon.

    vertices  the point of every polygon corner
    turned    the file's corners are clockwise (leftHanded): corners 1 and 2 of every triangle are swapped
    normals   at every polygon corner (not unit); None where the prim is a mesh and not a shape
    """

    points: Float[np.ndarray, "v 3"]
    sizes: Int[np.ndarray, " p"]
    vertices: Int[np.ndarray, " c"]
    corner: Int[np.ndarray, "t 3"]
    polygon: Int[np.ndarray, " t"]
    turned: bool
    normals: Float[np.ndarray, "c 3"] | None = None


def polygons(pxr: Any, prim: Any, path: Path, max_faces: int = 2**31) -> Polygons | None:
    """The faces of a mesh prim as triangles, in file order; None where it has none. Holes are dropped."""
    mesh, time = pxr.UsdGeom.Mesh(prim), pxr.Usd.TimeCode.EarliestTime()
    if is_shape(prim):
        shape = outline(prim, time)
        corner = triangulate(shape.sizes, shape.points[shape.vertices])
        polygon = np.repeat(np.arange(len(shape.sizes)), shape.sizes)[corner[:, 0]]
        return Polygons(shape.points, shape.sizes, shape.vertices, corner, polygon, False, shape.normals)
    points = triples(mesh.GetPointsAttr().Get(time))
    sizes = np.array(mesh.GetFaceVertexCountsAttr().Get(time) or [], np.int64)
    vertices = np.array(mesh.GetFaceVertexIndicesAttr().Get(time) or [], np.int64)
    if points is None or not len(points) or not len(sizes):
        return None
    again = "Export the mesh again"
    if (sizes < 0).any() or sizes.sum() != len(vertices):
        problem = f"{prim.GetPath()} with {len(vertices)} corners for faces of {int(sizes.sum())}"
        raise refuse(path, problem, "as many indices as its faces have corners", again)
    too_many(len(sizes), max_faces, path)
    too_many(len(points), 3 * max_faces, path, "vertices")
    check_indices(vertices, len(points), path, "vertex")
    check_positions(points, path)
    corner = triangulate(sizes, points[vertices])
    polygon = np.repeat(np.arange(len(sizes)), sizes)[corner[:, 0]] if len(corner) else np.zeros(0, np.int64)
    holes = np.array(mesh.GetHoleIndicesAttr().Get(time) or [], np.int64)
    solid = ~np.isin(polygon, holes)
    turned = mesh.GetOrientationAttr().Get(time) == pxr.UsdGeom.Tokens.leftHanded
    corner = corner[solid][:, [0, 2, 1]] if turned else corner[solid]
    return Polygons(points, sizes, vertices, corner, polygon[solid], turned)


def triples(values: Any) -> Float[np.ndarray, "n 3"] | None:
    """Rows of three numbers, no rows without an authored value; None for a value of another type."""
    if values is None:
        return np.zeros((0, 3))
    table = np.array(values, np.float64)
    if table.size == 0:
        return np.zeros((0, 3))
    return table if table.ndim == 2 and table.shape[1] == 3 else None


def is_cage(pxr: Any, prim: Any, time: Any) -> bool:
    """Whether a prim is the control cage of a subdivision surface."""
    if is_shape(prim):
        return False
    flat = (pxr.UsdGeom.Tokens.none, pxr.UsdGeom.Tokens.bilinear)
    return pxr.UsdGeom.Mesh(prim).GetSubdivisionSchemeAttr().Get(time) not in flat


def corner_normals(pxr: Any, prim: Any, shape: Polygons, time: Any, notes: list[str]) -> np.ndarray | None:
    """A prim's own normals; smooth normals of the cage where it is subdivided and has none."""
    if shape.normals is not None:
        return shape.normals[shape.corner].astype(np.float32)
    normals = _own_normals(pxr, pxr.UsdGeom.Mesh(prim), shape, time, notes)
    if normals is None and is_cage(pxr, prim, time):
        normals = crease_normals(shape.points, shape.vertices[shape.corner], same_points(shape.points), CAGE_CREASE)
    return normals


def _own_normals(pxr: Any, mesh: Any, shape: Polygons, time: Any, notes: list[str]) -> np.ndarray | None:
    primvar = pxr.UsdGeom.PrimvarsAPI(mesh).GetPrimvar("normals")
    if primvar and primvar.HasValue():
        return _spread(primvar.ComputeFlattened(time), primvar.GetInterpolation(), shape, 3, "normals", notes)
    values = mesh.GetNormalsAttr().Get(time)
    if values is not None and triples(values) is None:
        notes.append("Normals of another type than normal3f[] were left out.")
        return None
    return _spread(values, mesh.GetNormalsInterpolation(), shape, 3, "normals", notes)


def uv_primvar(pxr: Any, mesh: Any, preferred: list[str]) -> Any:
    """The UV primvar of textures: the materials' own, a usual name, else the first with coordinates."""
    primvars = pxr.UsdGeom.PrimvarsAPI(mesh)
    for name in (*preferred, *UV_NAMES):
        primvar = primvars.FindPrimvarWithInheritance(name)
        if primvar and primvar.HasValue() and _is_pair(primvar):
            return primvar
    return next(
        (p for p in primvars.GetPrimvarsWithValues() if _is_pair(p) and "texCoord" in str(p.GetTypeName())), None
    )


def _is_pair(primvar: Any) -> bool:
    """Whether its first two components can be texture coordinates (a third is for volumes)."""
    return re.fullmatch(r"(texCoord|float|double|half)[23][fdh]?(\[\])?", str(primvar.GetTypeName())) is not None


@dataclass(frozen=True)
class CornerValues:
    """Reads the values of a mesh prim at the corners of its triangles, `shape` at `time`.

    `material` is the index of every triangle's material in `materials`. `notes` collects sentences on dropped values.
    """

    pxr: Any
    mesh: Any
    shape: Polygons
    time: Any
    material: Int[np.ndarray, " f"]
    materials: Sequence[UsdMaterial]
    notes: list[str]

    def uvs(self) -> Float[np.ndarray, "f 3 2"] | None:
        """Every triangle's corners at the primvar of its own material."""
        result = None
        for name in dict.fromkeys(self.materials[k].primvar for k in np.unique(self.material)):
            primvar = uv_primvar(self.pxr, self.mesh, [name] if name else [])
            if primvar and name and primvar.GetPrimvarName() != name:
                self.notes.append(
                    f"A mesh has no texture coordinates '{name}'; '{primvar.GetPrimvarName()}' were used."
                )
            values = self._spread(primvar, 2, "UVs") if primvar else None
            if values is not None:
                result = np.full(values.shape, np.nan, np.float32) if result is None else result
                rows = np.isin(self.material, [k for k, m in enumerate(self.materials) if m.primvar == name])
                result[rows] = values[rows]
        return result

    def other_uvs(self) -> dict[str, Float[np.ndarray, "f 3 2"]]:
        """Additional coordinates that maps of the triangles' materials use, by primvar."""
        values_of = {}
        for name in dict.fromkeys(n for k in np.unique(self.material) for n in self.materials[k].others().values()):
            primvar = self.pxr.UsdGeom.PrimvarsAPI(self.mesh).FindPrimvarWithInheritance(name)
            if primvar and primvar.HasValue() and _is_pair(primvar):
                values_of[name] = self._spread(primvar, 2, "UVs")
        return {name: values for name, values in values_of.items() if values is not None}

    def colours(self) -> Float[np.ndarray, "f 3 3"] | None:
        """Linear corner colours, from the primvar that is a material's albedo, white elsewhere; None without such a
        material."""
        result = None
        for name in dict.fromkeys(self.materials[k].colour for k in np.unique(self.material)):
            primvar = self.pxr.UsdGeom.PrimvarsAPI(self.mesh).FindPrimvarWithInheritance(name) if name else None
            if not primvar or not primvar.HasValue():
                continue
            values = self._spread(primvar, 3, f"{name} values")
            if values is not None:
                result = np.ones_like(values) if result is None else result
                rows = np.isin(self.material, [k for k, m in enumerate(self.materials) if m.colour == name])
                result[rows] = np.clip(np.nan_to_num(values[rows], nan=1.0), 0, 1)
        return result

    def _spread(self, primvar: Any, width: int, label: str) -> Float[np.ndarray, "f 3 w"] | None:
        table = table_of(primvar, self.time)
        return _spread(table, primvar.GetInterpolation(), self.shape, width, label, self.notes)


def table_of(primvar: Any, time: Any) -> Float[np.ndarray, "n w"] | None:
    """A primvar's values, its indices resolved, one row each; a single value is one row."""
    values = primvar.ComputeFlattened(time) if primvar.GetTypeName().isArray else [primvar.Get(time)]
    if values is None or len(values) == 0 or values[0] is None:
        return None
    return np.array(values, np.float32).reshape(len(values), -1)


def _spread(
    values: Any, interpolation: str, shape: Polygons, width: int, label: str, notes: list[str]
) -> Float[np.ndarray, "f 3 w"] | None:
    """A primvar's values at every triangle corner; None, with a note, where their number is wrong."""
    if values is None or len(values) == 0:
        return None
    table = np.array(values, np.float32).reshape(len(values), -1)[:, : width if label == "UVs" else None]
    where = {
        "faceVarying": (len(shape.vertices), shape.corner),
        "vertex": (len(shape.points), shape.vertices[shape.corner]),
        "varying": (len(shape.points), shape.vertices[shape.corner]),
        "uniform": (len(shape.sizes), np.repeat(shape.polygon[:, None], 3, axis=1)),
        "constant": (1, np.zeros_like(shape.corner)),
    }
    count, index = where.get(str(interpolation), (-1, shape.corner))
    if count != len(table) or table.shape[1] != width:
        notes.append(f"{label} were left out: their number does not match their interpolation ({interpolation}).")
        return None
    return table[index]
