"""PLY, STL and OFF, keeping vertex and face order."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from mistyle.core.asset import Primitive
from mistyle.core.normals import same_points
from mistyle.files.bounds import read_bytes, refuse
from mistyle.files.polygons import check_indices, check_positions, parse_numbers, too_many, triangulate
from mistyle.files.raw import Raw, RawMaterial, no_textures

AGAIN = "Export the mesh again"
CUT_OFF = "The file is cut off or damaged; copy it again"
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


def _plain(
    kind: str,
    positions: Float[np.ndarray, "v 3"],
    faces: Int[np.ndarray, "f 3"],
    normals: Float[np.ndarray, "f 3 3"] | None = None,
    uvs: Float[np.ndarray, "f 3 2"] | None = None,
    notes: Sequence[str] = (),
) -> Raw:
    """A mesh of one plain material."""
    return Raw(
        kind=kind,
        positions=np.ascontiguousarray(positions, np.float64),
        faces=faces,
        normals=normals,
        uvs=uvs,
        material=np.zeros(len(faces), np.int64),
        materials=(RawMaterial("material", no_textures, None, roughness_factor=0.5),),
        primitives=(Primitive(-1, -1, -1, 0, len(faces), -1, -1, -1),),
        notes=tuple(notes),
    )


def read_stl(path: Path, max_faces: int) -> Raw:
    """Binary or ASCII STL. The format repeats every vertex in every face: corners at bit-equal positions become one
    vertex, numbered in order of appearance, and a note says so. Its facet normals are not used."""
    data = read_bytes(path)
    count = int.from_bytes(data[80:84], "little") if len(data) >= 84 else -1
    if len(data) == 84 + 50 * count:
        too_many(count, max_faces, path)
        facet = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
        with np.errstate(invalid="ignore"):  # a signalling NaN in a damaged file
            corners = np.frombuffer(data, facet, count, 84)["corners"].reshape(-1, 3).astype(np.float64)
    elif re.match(rb"\s*solid\b", data[:1024], re.IGNORECASE) and b"facet" in data:
        rows = re.findall(rb"\bvertex[ \t]+([^\r\n]+)", data, re.IGNORECASE)
        too_many(len(rows) // 3, max_faces, path)
        corners = parse_numbers(b" ".join(rows), path, "vertices")
        if corners.size != 3 * len(rows) or len(rows) % 3:
            raise refuse(
                path, f"{len(rows)} vertices with {corners.size} numbers", "three of three for every facet", CUT_OFF
            )
        corners = corners.reshape(-1, 3)
    else:
        size = f"{len(data)} bytes"
        expected = f"{84 + 50 * count} for the {count} faces its header names" if count >= 0 else "a header of 84 bytes"
        raise refuse(path, size, f"{expected}, or an ASCII STL", CUT_OFF)
    check_positions(corners, path)
    vertex = same_points(corners)
    first = np.unique(vertex, return_index=True)[1]
    joined = f"{len(corners)} corners at equal positions were joined to {len(first)} vertices."
    note = f"STL repeats vertices in every face: {joined}"
    return _plain("stl", corners[first], vertex.reshape(-1, 3), notes=[note])


def read_off(path: Path, max_faces: int) -> Raw:
    """OFF, also with normals, colours or texture coordinates in its vertices (N, C and ST prefixes; only positions are
    read of NOFF and COFF)."""
    data = re.sub(rb"#[^\r\n]*", b"", read_bytes(path))
    head = re.match(rb"\s*(ST)?(C)?(N)?(4)?(n)?OFF\b[ \t]*(BINARY)?", data)
    if head is None or any(head.group(k) for k in (4, 5, 6)):
        raise refuse(path, "no ASCII OFF header", "a file that begins with OFF", AGAIN)
    lines = [line for line in data[head.end() :].splitlines() if line.strip()]
    counts = parse_numbers(lines[0], path, "counts") if lines else np.zeros(0)
    if len(counts) < 2 or (counts[:2] < 0).any() or (counts[:2] % 1 != 0).any():
        raise refuse(path, "no vertex and face counts", "two whole numbers after OFF", AGAIN)
    vertices, faces = int(counts[0]), int(counts[1])
    too_many(faces, max_faces, path)
    if len(lines) < 1 + vertices + faces:
        raise refuse(path, f"{len(lines) - 1} lines", f"{vertices} vertices and {faces} faces", CUT_OFF)
    rows = [line.split()[:3] for line in lines[1 : 1 + vertices]]
    if any(len(row) < 3 for row in rows):
        raise refuse(path, "a vertex with fewer than three numbers", "three", AGAIN)
    positions = parse_numbers(b" ".join(b" ".join(row) for row in rows), path, "vertices").reshape(-1, 3)
    polygons = [line.split() for line in lines[1 + vertices : 1 + vertices + faces]]
    try:
        sizes = np.array([int(p[0]) for p in polygons], np.int64)
        corners = np.array([int(c) for p, n in zip(polygons, sizes, strict=True) for c in p[1 : n + 1]], np.int64)
    except (ValueError, OverflowError) as error:
        raise refuse(
            path, f"a face that is no list of whole numbers ({str(error)[:80]})", "count and indices", AGAIN
        ) from error
    if (sizes < 0).any() or len(corners) != sizes.sum():
        raise refuse(path, "a face with fewer indices than it announces", "as many", CUT_OFF)
    check_indices(corners, vertices, path, "vertex")
    check_positions(positions, path)
    triangles = corners[triangulate(sizes, positions[corners])]
    too_many(len(triangles), max_faces, path)
    return _plain("off", positions, triangles, notes=_small(sizes))


def _small(sizes: Int[np.ndarray, " p"]) -> list[str]:
    small = int((sizes < 3).sum())
    return [f"{small} face(s) with fewer than three corners were left out."] if small else []


# --- PLY ---


@dataclass(frozen=True)
class _Property:
    name: str
    kind: str
    count: str | None  # the type of a list's length, None for a plain value


@dataclass(frozen=True)
class _Element:
    name: str
    count: int
    properties: tuple[_Property, ...]


def read_ply(path: Path, max_faces: int) -> Raw:
    """PLY, ASCII or binary, with polygons of any size; normals nx ny nz, texture coordinates per vertex (u v, s t,
    texture_u texture_v) or per face corner (the list texcoord). Colours and texture files are not read."""
    data = read_bytes(path)
    elements, form, start = _ply_header(data, path)
    for element in elements:
        limit = max_faces if element.name == "face" else 3 * max_faces
        too_many(element.count, limit, path, f"elements '{element.name}'")
    tables = (
        _ply_ascii(data[start:], elements, path) if form == "ascii" else _ply_binary(data, start, elements, form, path)
    )
    vertex, face = tables.get("vertex", {}), tables.get("face", {})
    if not {"x", "y", "z"} <= set(vertex):
        raise refuse(path, "no vertices with x, y and z", "a mesh", AGAIN)
    with np.errstate(invalid="ignore"):  # a signalling NaN in a damaged file
        positions = np.stack([vertex[k].astype(np.float64) for k in "xyz"], axis=1)
    lists = face.get("vertex_indices", face.get("vertex_index"))
    if lists is None or len(lists[0]) == 0:
        raise refuse(
            path, f"{len(positions)} points and no faces", "at least one triangle", "Export the mesh with its faces"
        )
    sizes, corners = lists[0].astype(np.int64), lists[1].astype(np.int64)
    check_indices(corners, len(positions), path, "vertex")
    check_positions(positions, path)
    pick = triangulate(sizes, positions[corners])
    triangles = corners[pick]
    too_many(len(triangles), max_faces, path)
    normals = None
    if {"nx", "ny", "nz"} <= set(vertex):
        with np.errstate(invalid="ignore", over="ignore"):
            normals = np.stack([vertex[k].astype(np.float32) for k in ("nx", "ny", "nz")], axis=1)[triangles]
    notes = _small(sizes)
    if "red" in vertex or "red" in face:
        notes.append("Vertex colours were not read.")
    return _plain("ply", positions, triangles, normals, _ply_uvs(vertex, face, sizes, triangles, pick), notes)


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


def _ply_header(data: bytes, path: Path) -> tuple[list[_Element], str, int]:
    """Elements, byte order ("<", ">" or "ascii") and where the data begin."""
    end = re.search(rb"\bend_header[ \t]*\r?\n", data[: 1 << 20])
    if not data.startswith(b"ply") or end is None:
        raise refuse(path, "no PLY header", "a text from 'ply' to 'end_header'", AGAIN)
    elements: list[_Element] = []
    form = ""
    for line in data[: end.start()].decode("ascii", "replace").splitlines()[1:]:
        words = line.split()
        try:
            if words[:1] == ["format"]:
                form = {"ascii": "ascii", "binary_little_endian": "<", "binary_big_endian": ">"}[words[1]]
            elif words[:1] == ["element"]:
                elements.append(_Element(words[1], int(words[2]), ()))
            elif words[:1] == ["property"]:
                new = (
                    _Property(words[4], TYPES[words[3]], TYPES[words[2]])
                    if words[1] == "list"
                    else _Property(words[2], TYPES[words[1]], None)
                )
                last = elements[-1]
                elements[-1] = _Element(last.name, last.count, (*last.properties, new))
        except (KeyError, IndexError, ValueError) as error:
            raise refuse(path, f"the header line {line[:80]!r}", "PLY 1.0", AGAIN) from error
    if not form or any(e.count < 0 for e in elements):
        raise refuse(path, "a header without format or with negative counts", "PLY 1.0", AGAIN)
    for names in ([e.name for e in elements], *([p.name for p in e.properties] for e in elements)):
        if len(set(names)) < len(names):
            raise refuse(path, "two elements or properties of one name", "PLY 1.0", AGAIN)
    return elements, form, end.end()


def _ply_ascii(data: bytes, elements: list[_Element], path: Path) -> dict[str, dict]:
    numbers = parse_numbers(data, path, "its data")
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
    return tables


def _ply_rows(element: _Element, numbers: np.ndarray, at: int, path: Path) -> tuple[dict, int]:
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


def _ply_binary(data: bytes, at: int, elements: list[_Element], order: str, path: Path) -> dict[str, dict]:
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


def _uniform(data: bytes, at: int, element: _Element, order: str) -> np.ndarray | None:
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


def _ragged(data: bytes, at: int, element: _Element, order: str, path: Path) -> tuple[dict, int]:
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
    except ValueError as error:  # also what numpy says where the buffer is too small
        raise refuse(
            path, f"an element '{element.name}' that ends early", f"{element.count} of them", CUT_OFF
        ) from error
    joined = {name: np.concatenate(parts) if parts else np.zeros(0) for name, parts in flat.items()}
    return {n: (np.array(sizes[n], np.int64), v) if n in sizes else v for n, v in joined.items()}, at
