"""STL and OFF, keeping vertex and face order."""

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from mistyle.core.asset import Primitive
from mistyle.geometry.normals import same_points
from mistyle.io.meshes.parsed_mesh import Raw, RawMaterial, no_textures
from mistyle.io.meshes.polygons import check_indices, check_positions, parse_numbers, too_many, triangulate
from mistyle.io.meshes.vertex_colours import linear_colours
from mistyle.io.sandbox.bounds import read_bytes, refuse
from mistyle.io.sandbox.nearby import unmarked

AGAIN = "Export the mesh again"
MAX_PADDING = 512  # bytes that some programs leave after the last face of an STL
CUT_OFF = "The file is cut off or damaged; copy it again"


def plain_mesh(
    kind: str,
    positions: Float[np.ndarray, "v 3"],
    faces: Int[np.ndarray, "f 3"],
    normals: Float[np.ndarray, "f 3 3"] | None = None,
    uvs: Float[np.ndarray, "f 3 2"] | None = None,
    notes: Sequence[str] = (),
    colours: Float[np.ndarray, "f 3 3"] | None = None,
) -> Raw:
    """A mesh with one plain material; `colours` are its corners' albedo, linear."""
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
        colours=colours,
    )


def read_stl(path: Path, max_faces: int) -> Raw:
    """Binary or ASCII STL. The format repeats every vertex in every face: corners at bit-equal positions become one
    vertex, numbered in order of appearance, with a note. Facet normals and colours in the
    attributes are not read; up to MAX_PADDING bytes after the last face are skipped."""
    data, notes = read_bytes(path), []
    count = int.from_bytes(data[80:84], "little") if len(data) >= 84 else -1
    more = len(data) - (84 + 50 * count)
    plain = unmarked(data) if more else data
    text = re.match(rb"\s*solid\b", plain[:1024], re.IGNORECASE) and re.search(rb"\bfacet\b", plain, re.IGNORECASE)
    if count >= 0 and (more == 0 or (count > 0 and not text and 0 < more <= MAX_PADDING)):
        too_many(count, max_faces, path)
        facet = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
        rows = np.frombuffer(data, facet, count, 84)
        with np.errstate(invalid="ignore"):  # a signalling NaN in a damaged file
            corners = rows["corners"].reshape(-1, 3).astype(np.float64)
        if more:
            notes.append(f"{more} byte(s) after the last face were ignored.")
        if b"COLOR=" in data[:80] or (rows["attribute"] & 0x8000).any():
            notes.append("Face colours (STL attributes) were not read.")
    elif text:
        rows = re.findall(rb"\bvertex[ \t]+([^\r\n]+)", plain, re.IGNORECASE)
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
    welding = f"{len(corners)} corners at equal positions were joined to {len(first)} vertices."
    notes.append(f"STL repeats vertices in every face: {welding}")
    return plain_mesh("stl", corners[first], vertex.reshape(-1, 3), notes=notes)


def read_off(path: Path, max_faces: int) -> Raw:
    """OFF, also with normals, colours or texture coordinates in its vertices (N, C and ST prefixes) and colours after
    its faces' indices. The counts may follow OFF without a space (ModelNet40)."""
    data = re.sub(rb"#[^\r\n]*", b"", unmarked(read_bytes(path)))
    head = re.match(rb"\s*(ST)?(C)?(N)?(4)?(n)?(?:OFF|off)(?![A-Za-z_])[ \t]*(BINARY)?", data)
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
    rows = [line.split() for line in lines[1 : 1 + vertices]]
    positions, more = _off_table(rows, 0, 3, path), min((len(row) for row in rows), default=0) - 3
    texture, colour, normal = (2 if head[1] else 0), bool(head[2]), (3 if head[3] else 0)
    polygons = [line.split() for line in lines[1 + vertices : 1 + vertices + faces]]
    sizes, corners = _off_faces(polygons, path)
    check_indices(corners, vertices, path, "vertex")
    check_positions(positions, path)
    pick = triangulate(sizes, positions[corners])
    triangles = corners[pick]
    too_many(len(triangles), max_faces, path)
    notes, colours = small_faces(sizes), None
    behind = [len(p) - 1 - int(n) for p, n in zip(polygons, sizes, strict=True)]
    if more < texture + normal + 3 * colour:
        notes.append("Its vertices have fewer numbers than its header declares; only positions were read.")
        texture, colour, normal = 0, False, 0
    if colour:
        colours = linear_colours(_off_table(rows, 3 + normal, 3, path))[triangles]
    elif max(behind, default=0) >= 3:
        of_polygon = [p[-n:][:3] if n >= 3 else [b"nan"] * 3 for p, n in zip(polygons, behind, strict=True)]
        polygon = np.repeat(np.arange(len(sizes)), np.maximum(sizes - 2, 0))
        colours = np.repeat(linear_colours(_off_table(of_polygon, 0, 3, path))[polygon][:, None], 3, axis=1)
    elif any(behind):
        notes.append("Face colours by their number in a colour map were not read.")
    normals = _off_table(rows, 3, 3, path).astype(np.float32)[triangles] if normal else None
    uvs = _off_table([row[-2:] for row in rows], 0, 2, path).astype(np.float32)[triangles] if texture else None
    return plain_mesh("off", positions, triangles, normals, uvs, notes, colours)


def _off_table(rows: list[list[bytes]], start: int, width: int, path: Path) -> Float[np.ndarray, "n w"]:
    """`width` numbers of every row, from number `start` on."""
    if any(len(row) < start + width for row in rows):
        raise refuse(path, "a vertex with fewer than three numbers", "three", AGAIN)
    text = b" ".join(b" ".join(row[start : start + width]) for row in rows)
    return parse_numbers(text, path, "vertices").reshape(-1, width)


def _off_faces(polygons: list[list[bytes]], path: Path) -> tuple[Int[np.ndarray, " p"], Int[np.ndarray, " c"]]:
    try:
        sizes = np.array([int(p[0]) for p in polygons], np.int64)
        corners = np.array([int(c) for p, n in zip(polygons, sizes, strict=True) for c in p[1 : n + 1]], np.int64)
    except (ValueError, OverflowError) as error:
        raise refuse(
            path, f"a face that is not a list of whole numbers ({str(error)[:80]})", "count and indices", AGAIN
        ) from error
    if (sizes < 0).any() or len(corners) != sizes.sum():
        raise refuse(path, "a face with fewer indices than it announces", "as many", CUT_OFF)
    return sizes, corners


def small_faces(sizes: Int[np.ndarray, " p"]) -> list[str]:
    small = int((sizes < 3).sum())
    return [f"{small} face(s) with fewer than three corners were left out."] if small else []
