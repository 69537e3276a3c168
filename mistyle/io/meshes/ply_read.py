"""PLY, ASCII and binary, keeping vertex and face order."""

import re
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from mistyle.core.asset import Primitive
from mistyle.core.errors import InputRefused
from mistyle.io.images.read import Budget, named_texture
from mistyle.io.meshes.parsed_mesh import Maps, Raw, RawMap, RawMaterial
from mistyle.io.meshes.polygons import check_indices, check_positions, parse_numbers, too_many, triangulate
from mistyle.io.meshes.stl_off_read import AGAIN, CUT_OFF, plain_mesh, small_faces
from mistyle.io.meshes.vertex_colours import coloured, linear_colours
from mistyle.io.sandbox.asset_folders import mesh_folders
from mistyle.io.sandbox.bounds import read_bytes, refuse
from mistyle.io.sandbox.nearby import decoded, unmarked

MAX_HEADER = 1 << 20
MAX_POINTS = 30_000_000
TYPES = {
    "char": "i1",
    "uchar": "u1",
    "short": "i2",
    "ushort": "u2",
    "int": "i4",
    "uint": "u4",
    "float": "f4",
    "double": "f8",
}
TYPES |= {"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"}
TYPES |= {"float32": "f4", "float64": "f8"}


@dataclass(frozen=True)
class _Property:
    name: str
    kind: str
    count: str | None  # the type of a list's length, None for a plain value


@dataclass(frozen=True)
class _PlyElement:
    name: str
    count: int
    properties: tuple[_Property, ...]


def read_ply(path: Path, max_faces: int) -> Raw:
    """PLY with polygons of any size, or triangle strips.

    Also read: normals nx ny nz; texture coordinates per vertex (u v, s t, texture_u texture_v) or per face corner (the
    list texcoord); pictures of `comment TextureFile` (several by the faces' texnumber); colours of vertices or faces,
    which are the albedo where no picture is.
    """
    header, elements, tables, surplus = _tables(path, max_faces)
    vertex, face = tables.get("vertex", {}), tables.get("face", {})
    positions = _positions(vertex, path)
    sizes, corners = _polygons(tables)
    if len(sizes) == 0:
        raise refuse(
            path, f"{len(positions)} points and no faces", "at least one triangle", "Export the mesh with its faces"
        )
    check_indices(corners, len(positions), path, "vertex")
    check_positions(positions, path)
    pick = triangulate(sizes, positions[corners])
    triangles = corners[pick]
    too_many(len(triangles), max_faces, path)
    normals = None
    if {"nx", "ny", "nz"} <= set(vertex):
        with np.errstate(invalid="ignore", over="ignore"):
            normals = np.stack([vertex[k].astype(np.float32) for k in ("nx", "ny", "nz")], axis=1)[triangles]
    polygon = np.repeat(np.arange(len(sizes)), np.maximum(sizes - 2, 0))
    raw = plain_mesh("ply", positions, triangles, normals, _ply_uvs(vertex, face, sizes, triangles, pick))
    raw, notes = _textured(raw, texture_files(header), face, polygon, path), surplus + small_faces(sizes)
    colours = _colours(tables, elements, triangles, polygon)
    if colours is not None:
        colours, materials, colour_notes = coloured(colours, raw.material, raw.materials)
        raw, notes = replace(raw, colours=colours, materials=materials), notes + colour_notes
    return replace(raw, notes=(*notes, *raw.notes))


def read_ply_points(path: Path) -> Float[np.ndarray, "n 3"]:
    """The finite vertices of a PLY, with or without faces; at most MAX_POINTS."""
    tables = _tables(path, MAX_POINTS // 3)[2]
    points = _positions(tables.get("vertex", {}), path)
    return points[np.isfinite(points).all(axis=1)]


def _tables(path: Path, max_faces: int) -> tuple[bytes, list[_PlyElement], dict[str, dict], list[str]]:
    """Header, elements, the values of each element's properties, and notes."""
    data = read_bytes(path)
    data = unmarked(data) if data.startswith(b"\xef\xbb\xbf") else data
    elements, form, start = _ply_header(data, path)
    for element in elements:
        limit = max_faces if element.name == "face" else 3 * max_faces
        too_many(element.count, limit, path, f"elements '{element.name}'")
    if form == "ascii":
        tables, notes = _ply_ascii(data[start:], elements, path)
    else:
        tables, notes = _ply_binary(data, start, elements, form, path), []
    return data[:start], elements, tables, notes


def _positions(vertex: dict, path: Path) -> Float[np.ndarray, "v 3"]:
    if not {"x", "y", "z"} <= set(vertex):
        raise refuse(path, "no vertices with x, y and z", "a mesh", AGAIN)
    with np.errstate(invalid="ignore"):  # a signalling NaN in a damaged file
        return np.stack([vertex[k].astype(np.float64) for k in "xyz"], axis=1)


def texture_files(header: bytes) -> list[str]:
    """The pictures that a header names, in order."""
    named = re.findall(rb"^comment[ \t]+texturefile[ \t]+([^\r\n]+)", header, re.IGNORECASE | re.MULTILINE)
    return [name.strip() for name in decoded(*named)[0]]


def _polygons(tables: dict[str, dict]) -> tuple[Int[np.ndarray, " p"], Int[np.ndarray, " c"]]:
    """Corners per polygon, and all corners, of the faces; without any, of the triangle strips."""
    face = tables.get("face", {})
    lists = face.get("vertex_indices", face.get("vertex_index"))
    if lists is not None and len(lists[0]):
        return lists[0].astype(np.int64), lists[1].astype(np.int64)
    strips = tables.get("tristrips", {})
    lists = strips.get("vertex_indices", strips.get("vertex_index"))
    if lists is None:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    triangles = _unrolled(lists[0].astype(np.int64), lists[1].astype(np.int64))
    return np.full(len(triangles), 3), triangles.reshape(-1)


def _unrolled(counts: Int[np.ndarray, " s"], index: Int[np.ndarray, " c"]) -> Int[np.ndarray, "t 3"]:
    """The triangles of strips: -1 begins a new strip, every second triangle is flipped, degenerate ones only flip
    parity."""
    ends = np.zeros(len(index) + 1, bool)
    ends[np.cumsum(counts)] = True
    first = np.flatnonzero(np.concatenate([[True], (index[:-1] < 0)]) | ends[:-1])  # of each strip
    place = np.arange(len(index)) - first[np.searchsorted(first, np.arange(len(index)), side="right") - 1]
    a, b, c = index[:-2], index[1:-1], index[2:]
    whole = (place[2:] >= 2) & (np.minimum(np.minimum(a, b), c) >= 0) & (a != b) & (b != c) & (c != a)
    odd = place[2:] % 2 == 1
    return np.stack([np.where(odd, b, a), np.where(odd, a, b), c], axis=1)[whole]


def _textured(raw: Raw, files: list[str], face: dict, polygon: Int[np.ndarray, " t"], path: Path) -> Raw:
    """The mesh with one material for every picture that its header names."""
    if not files or not len(raw.faces):
        return raw
    if raw.uvs is None:
        return replace(raw, notes=("Its header names a texture, but there are no texture coordinates for it.",))
    budget, notes = Budget(path), raw.notes
    stems = [Path(file.replace("\\", "/")).stem or "material" for file in files]
    loads = [partial(_load, file, path, budget) for file in files]
    materials = [RawMaterial(*pair, False, roughness_factor=0.5) for pair in zip(stems, loads, strict=True)]
    number = face.get("texnumber", np.zeros(0))
    numbered = len(number) > polygon.max(initial=0)
    if len(files) > 1 and not numbered:
        notes = (*notes, "Its header names several textures, but faces have no texnumber; the first was used.")
    with np.errstate(invalid="ignore"):
        file_number = np.nan_to_num(number[polygon]) if numbered else np.zeros(len(polygon))
        which = np.clip(file_number, 0, len(files) - 1).astype(np.int64)
    used, material = np.unique(which, return_inverse=True)
    cuts = [0, *(np.flatnonzero(np.diff(material)) + 1).tolist(), len(material)]
    runs = (Primitive(-1, -1, -1, a, b, int(material[a]), -1, -1) for a, b in zip(cuts[:-1], cuts[1:], strict=True))
    chosen = tuple(materials[k] for k in used)
    return replace(raw, material=material.reshape(-1), materials=chosen, primitives=tuple(runs), notes=notes)


def _load(file: str, path: Path, budget: Budget, tile: int) -> tuple[Maps, tuple[str, ...]]:
    notes: list[str] = []
    texture = named_texture(path, mesh_folders(path), file, budget, notes)
    if texture is None:
        return {}, tuple(notes)
    pixels, linear = texture
    entry = RawMap(np.clip(pixels, 0, 1), kind="data") if linear else RawMap(pixels, kind="colour")
    return {"albedo": entry}, tuple(notes)


def _colours(tables: dict, elements: list[_PlyElement], triangles, polygon) -> Float[np.ndarray, "f 3 3"] | None:
    """Linear colours of the corners, by vertex or by face; None where the file has none."""
    for name in ("vertex", "face"):
        kinds = {p.name: p for element in elements if element.name == name for p in element.properties}
        table = tables.get(name, {})
        for keys in (("red", "green", "blue"), ("diffuse_red", "diffuse_green", "diffuse_blue"), ("r", "g", "b")):
            if set(keys) <= set(table) and not any(kinds[k].count for k in keys):
                kind = np.dtype(kinds[keys[0]].kind)
                top = None if kind.kind == "f" else float(np.iinfo(kind).max)
                linear = linear_colours(np.stack([table[k] for k in keys], axis=1), top)
                if name == "vertex":
                    return linear[triangles]
                if len(linear) > polygon.max(initial=0):  # faces, not strips
                    return np.repeat(linear[polygon][:, None], 3, axis=1)
    return None


def _ply_uvs(vertex, face, sizes, triangles, pick) -> Float[np.ndarray, "f 3 2"] | None:
    with np.errstate(invalid="ignore", over="ignore"):  # a signalling NaN in a damaged file; doubles beyond float32
        return _uvs_of(vertex, face, sizes, triangles, pick)


def _uvs_of(vertex, face, sizes, triangles, pick) -> Float[np.ndarray, "f 3 2"] | None:
    if "texcoord" in face:
        counts, values = face["texcoord"]
        whole = counts == 2 * sizes
        uvs = np.full((int(sizes.sum()), 2), np.nan, np.float32)
        uvs[np.repeat(whole, sizes)] = values[np.repeat(whole, counts.astype(np.int64))].reshape(-1, 2)
        return uvs[pick]
    for u, v in (("u", "v"), ("s", "t"), ("texture_u", "texture_v")):
        if u in vertex and v in vertex:
            return np.stack([vertex[u], vertex[v]], axis=1).astype(np.float32)[triangles]
    return None


def _ply_header(data: bytes, path: Path) -> tuple[list[_PlyElement], str, int]:
    """Elements, byte order ("<", ">" or "ascii") and the offset of the data."""
    end = re.search(rb"\bend_header[ \t]*\r?\n", data[:MAX_HEADER])
    if not data.startswith(b"ply") or end is None:
        raise refuse(path, "no PLY header", "a text from 'ply' to 'end_header'", AGAIN)
    elements: list[_PlyElement] = []
    form = ""
    for line in data[: end.start()].decode("ascii", "replace").splitlines()[1:]:
        words = line.split()
        try:
            if words[:1] == ["format"]:
                form = {"ascii": "ascii", "binary_little_endian": "<", "binary_big_endian": ">"}[words[1]]
            elif words[:1] == ["element"]:
                elements.append(_PlyElement(words[1], int(words[2]), ()))
            elif words[:1] == ["property"]:
                new = (
                    _Property(words[4], TYPES[words[3]], TYPES[words[2]])
                    if words[1] == "list"
                    else _Property(words[2], TYPES[words[1]], None)
                )
                last = elements[-1]
                elements[-1] = _PlyElement(last.name, last.count, (*last.properties, new))
        except (KeyError, IndexError, ValueError) as error:
            raise refuse(path, f"the header line {line[:80]!r}", "PLY 1.0", AGAIN) from error
    if not form or any(e.count < 0 for e in elements):
        raise refuse(path, "a header without format or with negative counts", "PLY 1.0", AGAIN)
    for names in ([e.name for e in elements], *([p.name for p in e.properties] for e in elements)):
        if len(set(names)) < len(names):
            raise refuse(path, "two elements or properties of one name", "PLY 1.0", AGAIN)
    return elements, form, end.end()


def _ply_ascii(data: bytes, elements: list[_PlyElement], path: Path) -> tuple[dict[str, dict], list[str]]:
    """The values, however lines are broken. Where they are not as many as the header describes, each element's line is
    read by itself (MeshLab wrote faces with more numbers than its header describes)."""
    numbers = parse_numbers(data, path, "its data")
    try:
        return _ply_columns(numbers, elements, path), []
    except InputRefused:
        rows = [row.split() for row in data.splitlines() if row.strip()]
        if len(rows) != sum(element.count for element in elements):
            raise
    described = [element for element in elements for _ in range(element.count)]
    kept = [_described(row, element, path) for row, element in zip(rows, described, strict=True)]
    longer = sum(len(row) > len(own) for row, own in zip(rows, kept, strict=True))
    tables = _ply_columns(
        parse_numbers(b" ".join(token for own in kept for token in own), path, "its data"), elements, path
    )
    return tables, [f"{longer} lines have more numbers than the header describes; the last ones were ignored."]


def _described(row: list[bytes], element: _PlyElement, path: Path) -> list[bytes]:
    """The first tokens of an element's line, as many as its properties take."""
    at = 0
    for p in element.properties:
        length = row[at] if p.count and at < len(row) else b"0"
        if not length.isdigit():
            raise refuse(path, f"a list of {length[:40]!r} values in an element '{element.name}'", "a count", CUT_OFF)
        at += 1 + int(length)
    if at > len(row):
        raise refuse(path, f"a line of {len(row)} numbers", f"{at} of an element '{element.name}'", CUT_OFF)
    return row[:at]


def _ply_columns(numbers: Float[np.ndarray, " n"], elements: list[_PlyElement], path: Path) -> dict[str, dict]:
    tables, at = {}, 0
    for element in elements:
        if all(p.count is None for p in element.properties):
            width = len(element.properties)
            block = numbers[at : at + element.count * width]
            if len(block) < element.count * width:
                raise refuse(
                    path, "fewer numbers than its header names", f"{element.count} of '{element.name}'", CUT_OFF
                )
            columns = block.reshape(element.count, width) if width else block
            tables[element.name] = {p.name: columns[:, k] for k, p in enumerate(element.properties)}
            at += element.count * width
        else:
            tables[element.name], at = _ply_rows(element, numbers, at, path)
    if at < len(numbers):
        raise refuse(path, f"{len(numbers)} numbers", f"{at}, as its header describes", AGAIN)
    return tables


def _ply_rows(element: _PlyElement, numbers: np.ndarray, at: int, path: Path) -> tuple[dict, int]:
    """An ASCII element with lists, row by row."""
    flat: dict[str, list] = {p.name: [] for p in element.properties}
    sizes: dict[str, list] = {p.name: [] for p in element.properties if p.count}
    for _ in range(element.count):
        for p in element.properties:
            length = 1
            if p.count:
                length = int(numbers[at]) if at < len(numbers) and np.isfinite(numbers[at]) else -1
                at += 1
                sizes[p.name].append(length)
            if length < 0 or at + length > len(numbers):
                raise refuse(path, f"an element '{element.name}' that ends early", f"{element.count} of them", CUT_OFF)
            flat[p.name].append(numbers[at : at + length])
            at += length
    joined = {name: np.concatenate(parts) if parts else np.zeros(0) for name, parts in flat.items()}
    return {n: (np.array(sizes[n], np.int64), v) if n in sizes else v for n, v in joined.items()}, at


def _ply_binary(data: bytes, at: int, elements: list[_PlyElement], order: str, path: Path) -> dict[str, dict]:
    tables = {}
    for element in elements:
        rows = _uniform(data, at, element, order)
        if rows is not None:
            table = {}
            for p in element.properties:
                table[p.name] = (
                    (rows[f"{p.name}#"].astype(np.int64), rows[p.name].reshape(-1)) if p.count else rows[p.name]
                )
            tables[element.name] = table
            at += rows.nbytes
        else:
            tables[element.name], at = _ragged(data, at, element, order, path)
    return tables


def _uniform(data: bytes, at: int, element: _PlyElement, order: str) -> np.ndarray | None:
    """All rows at once, where every row's lists are as long as the first row's; None otherwise."""
    fields, where = [], at
    for p in element.properties:
        kind = np.dtype(order + p.kind)
        if p.count:
            count_kind = np.dtype(order + p.count)
            if where + count_kind.itemsize > len(data):
                return None
            length = int(np.frombuffer(data, count_kind, 1, where)[0])
            if length < 0 or where + length * kind.itemsize > len(data):
                return None
            fields += [(f"{p.name}#", count_kind), (p.name, kind, (length,))]
            where += count_kind.itemsize + length * kind.itemsize
        else:
            fields.append((p.name, kind))
            where += kind.itemsize
    row = np.dtype(fields)
    if at + row.itemsize * element.count > len(data) or row.itemsize == 0:
        return None
    rows = np.frombuffer(data, row, element.count, at)
    same = all((rows[f"{p.name}#"] == rows[f"{p.name}#"][:1]).all() for p in element.properties if p.count)
    return rows if same else None


def _ragged(data: bytes, at: int, element: _PlyElement, order: str, path: Path) -> tuple[dict, int]:
    """A binary element whose lists differ in length, row by row."""
    kinds = [(p, np.dtype(order + p.kind), np.dtype(order + p.count) if p.count else None) for p in element.properties]
    flat: dict[str, list] = {p.name: [] for p in element.properties}
    sizes: dict[str, list] = {p.name: [] for p in element.properties if p.count}
    try:
        for _ in range(element.count):
            for p, kind, count_kind in kinds:
                length = 1
                if count_kind is not None:
                    length = int(np.frombuffer(data, count_kind, 1, at)[0])
                    at += count_kind.itemsize
                    sizes[p.name].append(length)
                if length < 0:
                    raise ValueError("a negative length")
                flat[p.name].append(np.frombuffer(data, kind, length, at) if length else np.zeros(0, kind))
                at += length * kind.itemsize
    except ValueError as error:  # also numpy's error where the buffer is too small
        raise refuse(
            path, f"an element '{element.name}' that ends early", f"{element.count} of them", CUT_OFF
        ) from error
    joined = {name: np.concatenate(parts) if parts else np.zeros(0) for name, parts in flat.items()}
    return {n: (np.array(sizes[n], np.int64), v) if n in sizes else v for n, v in joined.items()}, at
