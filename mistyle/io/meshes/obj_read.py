"""Wavefront OBJ, keeping vertex and face order, corner normals and UVs."""

import re
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from mistyle.core.asset import Primitive
from mistyle.core.errors import InputRefused
from mistyle.io.images.read import Budget
from mistyle.io.meshes.mtl_read import MtlEntry, material, read_library, unread
from mistyle.io.meshes.parsed_mesh import Raw, RawMaterial, no_textures
from mistyle.io.meshes.polygons import check_positions, parse_numbers, too_many, triangulate
from mistyle.io.meshes.vertex_colours import coloured, linear_colours
from mistyle.io.sandbox.asset_folders import mesh_folders
from mistyle.io.sandbox.bounds import read_bytes, refuse
from mistyle.io.sandbox.nearby import decoded, named_file, unmarked

AGAIN = "Export the mesh again as OBJ with triangles or convex polygons"
STATED = (b"usemtl", b"o", b"g")  # statements that hold for all faces until the next one
NAMED = ("vertex", "texture coordinate", "normal")  # by a corner of a face, in this order
LINES = {b"l", b"p"}
FREE_FORM = {b"vp", b"cstype", b"deg", b"bmat", b"step", b"curv", b"curv2", b"surf", b"parm", b"trim", b"hole", b"scrv"}
FREE_FORM |= {b"sp", b"end", b"con", b"bzp", b"bsp", b"cdc", b"cdp", b"res"}
# Statements without effect on appearance: smoothing and merging groups, levels of detail, legacy rendering.
WITHOUT_LOOKS = {b"s", b"mg", b"lod", b"bevel", b"c_interp", b"d_interp", b"ctech", b"stech", b"shadow_obj"}
WITHOUT_LOOKS |= {b"trace_obj", b"maplib", b"usemap"}


def read_obj(path: Path, max_faces: int) -> Raw:
    """Polygons become fans around their first corner (concave ones are cut into ears), in file order. Lines, points,
    free-form surfaces and faces with fewer than three corners are dropped, with a note. Vertex colours (v x y z r g b)
    are the albedo where no texture is."""
    data = re.sub(rb"\\\r?\n", b" ", unmarked(read_bytes(path)))
    lines, notes = _sorted_lines(data), []
    positions = _table(lines[b"v"], 3, path, "vertices")
    if len(lines[b"f"]) == 0:
        fix = "Export the mesh with its faces"
        raise refuse(path, f"{len(positions)} vertices and no faces", "at least one triangle", fix)
    too_many(len(positions), 3 * max_faces, path, "vertices")
    corners, sizes, absent = _corners(lines, path, max_faces)
    notes += [f"The faces name {kinds} but the file has none; they were ignored." for kinds in absent]
    small = int((sizes < 3).sum())
    if small:
        notes.append(f"{small} face(s) with fewer than three corners were left out.")
    check_positions(positions, path)
    triangles = triangulate(sizes, positions[corners[:, 0]])
    too_many(len(triangles), max_faces, path)
    polygon = np.repeat(np.arange(len(sizes)), np.maximum(sizes - 2, 0))
    index = corners[triangles]
    material, names = _stated(lines[b"usemtl"], lines[b"usemtl_at"], polygon)
    kind = b"o" if lines[b"o"] else b"g"
    group, groups = _stated(lines[kind], lines[kind + b"_at"], polygon)
    materials, new_notes = _materials(names, lines, path)
    notes += new_notes
    colours = _colours(lines[b"v"], path)
    if colours is not None:
        colours, materials, new_notes = coloured(colours[index[..., 0]], material, materials)
        notes += new_notes
    return Raw(
        kind="obj",
        positions=positions,
        faces=index[..., 0],
        normals=_pick(_table(lines[b"vn"], 3, path, "normals"), index[..., 2]),
        uvs=_pick(_table(lines[b"vt"], 2, path, "texture coordinates"), index[..., 1]),
        material=material,
        materials=materials,
        primitives=_runs(material, group, groups),
        notes=(*notes, *_left_out(lines)),
        colours=colours,
    )


def _plain(name: str) -> RawMaterial:
    return RawMaterial(name or "material", no_textures, roughness_factor=0.5)


def _sorted_lines(data: bytes) -> dict[bytes, list]:
    """The statements' arguments by keyword; `usemtl_at`, `o_at` and `g_at` hold the number of faces before each.
    `others` are all other keywords; `counts` the numbers of v, vt and vn before each face (for negative face
    indices)."""
    statements: dict[bytes, list] = {k: [] for k in (b"v", b"vt", b"vn", b"f", b"mtllib", b"counts", b"others")}
    statements |= {k: [] for name in STATED for k in (name, name + b"_at")}
    others: dict[bytes, None] = {}
    v, vt, vn, f = statements[b"v"], statements[b"vt"], statements[b"vn"], statements[b"f"]
    backwards = re.search(rb"^[ \t]*f[ \t][^\n]*-", data, re.MULTILINE) is not None
    for line in data.splitlines():
        parts = line.split(None, 1)
        if len(parts) < 2 or parts[0].startswith(b"#"):
            if parts and parts[0] in STATED:
                statements[parts[0]].append(b"")
                statements[parts[0] + b"_at"].append(len(f))
            continue
        keyword, rest = parts
        if keyword == b"f":
            f.append(rest.partition(b"#")[0])
            if backwards:
                statements[b"counts"].append((len(v), len(vt), len(vn)))
        elif keyword in (b"v", b"vt", b"vn"):
            statements[keyword].append(rest)
        elif keyword == b"mtllib":
            statements[keyword].append(rest.strip())
        elif keyword in STATED:
            statements[keyword].append(rest.strip())
            statements[keyword + b"_at"].append(len(f))
        else:
            others[keyword] = None
    return statements | {b"others": list(others)}


def _table(lines: list[bytes], width: int, path: Path, label: str) -> Float[np.ndarray, "n w"]:
    """The first `width` numbers of every line."""
    if not lines:
        return np.zeros((0, width))
    widths = {len(line.split()) for line in lines}
    if len(widths) == 1 and (columns := widths.pop()) >= width and b"#" not in lines[0]:
        return parse_numbers(b" ".join(lines), path, label).reshape(-1, columns)[:, :width]
    rows = [line.partition(b"#")[0].split()[:width] for line in lines]
    if width == 2:
        rows = [row + [b"0"] * (2 - len(row)) for row in rows]  # one-dimensional textures leave v out
    short = next((i for i, row in enumerate(rows) if len(row) < width), None)
    if short is not None:
        raise refuse(path, f"line {short + 1} of its {label} with {len(rows[short])} numbers", f"{width}", AGAIN)
    return parse_numbers(b" ".join(b" ".join(row) for row in rows), path, label).reshape(-1, width)


def _colours(lines: list[bytes], path: Path) -> Float[np.ndarray, "v 3"] | None:
    """Linear vertex colours, white for vertices without one; None where no vertex has any."""
    if max((line.count(b" ") + line.count(b"\t") for line in lines), default=0) < 5:
        return None
    rows = [line.partition(b"#")[0].split()[3:6] for line in lines]
    if not any(len(row) == 3 for row in rows):
        return None
    text = b" ".join(b" ".join(row) if len(row) == 3 else b"nan nan nan" for row in rows)
    return linear_colours(parse_numbers(text, path, "vertex colours").reshape(-1, 3))


def _corners(
    lines: dict[bytes, list], path: Path, max_faces: int
) -> tuple[Int[np.ndarray, "c 3"], Int[np.ndarray, " p"], list[str]]:
    """Vertex, texture and normal index (from 0; -1 where missing) of every polygon corner, corners per polygon, and
    what the faces name although the file has none of it."""
    faces = lines[b"f"]
    too_many(len(faces), max_faces, path)
    tokens = [line.split() for line in faces]
    sizes = np.array([len(t) for t in tokens])
    flat = [token for line in tokens for token in line]
    slashes = {token.count(b"/") for token in flat}
    try:
        if slashes == {0}:
            index = np.array([int(t) for t in flat]).reshape(-1, 1)
        elif len(slashes) == 1 and not any(b"//" in t or t.endswith(b"/") for t in flat):
            index = np.array(b"/".join(flat).split(b"/")).astype(np.int64).reshape(len(flat), -1)
        else:
            index = np.array([[int(x or b"0") for x in (t.split(b"/") + [b"", b""])[:3]] for t in flat])
    except (ValueError, OverflowError) as error:
        raise refuse(path, f"a face that is not indices ({str(error)[:80]})", "f v/vt/vn ...", AGAIN) from error
    index = np.pad(index.astype(np.int64), ((0, 0), (0, 3 - index.shape[1]))) if index.shape[1] < 3 else index[:, :3]
    counts = [len(lines[k]) for k in (b"v", b"vt", b"vn")]
    absent = [k for k in (1, 2) if counts[k] == 0 and index[:, k].any()]
    index[:, absent] = 0
    if (index < 0).any():
        before = np.repeat(np.array(lines[b"counts"]).reshape(-1, 3), sizes, axis=0)
        index = np.where(index < 0, before + index + 1, index)
        index[index < 0] = 2**31
    for column, (count, label) in enumerate(zip(counts, NAMED, strict=True)):
        top = int(index[:, column].max(initial=0))
        if top > count:
            shown = "before the first" if top == 2**31 else top
            raise refuse(path, f"a face that uses {label} {shown}", f"1 to {count}", AGAIN)
    if (index[:, 0] == 0).any():
        raise refuse(path, "a face that uses vertex 0", f"1 to {counts[0]}", AGAIN)
    return index - 1, sizes, [f"{NAMED[k]}s" for k in absent]


def _pick(table: Float[np.ndarray, "n w"], index: Int[np.ndarray, "f 3"]) -> Float[np.ndarray, "f 3 w"] | None:
    """Table rows by corner, NaN where the index is missing; None where all are."""
    if len(table) == 0 or (index < 0).all():
        return None
    picked = table[np.maximum(index, 0)].astype(np.float32)
    picked[index < 0] = np.nan
    return picked


def _stated(
    names: list[bytes], starts: list[int], polygon: Int[np.ndarray, " t"]
) -> tuple[Int[np.ndarray, " t"], list[str]]:
    """Material, object or group of every triangle, numbered in order of first use by a face."""
    starts_at = np.array([0, *starts])
    text = ["", *decoded(*names)[0]]
    statement = np.searchsorted(starts_at, polygon, side="right") - 1
    numbers: dict[str, int] = {}
    seen = np.zeros(len(text), np.int64)
    present = np.zeros(len(text), bool)
    present[statement] = True
    for s in np.flatnonzero(present):
        seen[s] = numbers.setdefault(text[s], len(numbers))
    return seen[statement], list(numbers)


def _runs(material: Int[np.ndarray, " f"], group: Int[np.ndarray, " f"], groups: list[str]) -> tuple[Primitive, ...]:
    """One primitive for each run of faces with the same material and object."""
    cuts = np.flatnonzero((np.diff(material) != 0) | (np.diff(group) != 0)) + 1
    bounds = [0, *cuts.tolist(), len(material)]
    return tuple(
        Primitive(-1, -1, -1, a, b, int(material[a]), -1, -1, name=groups[group[a]])
        for a, b in zip(bounds[:-1], bounds[1:], strict=True)
        if b > a
    )


# --- materials ---


def library_files(names: list[bytes], path: Path) -> tuple[list[Path], list[str]]:
    """The existing material libraries among those that statements name, and notes about the others."""
    libraries: dict[Path, None] = {}
    notes: list[str] = []
    for name in dict.fromkeys(single for n in decoded(*names)[0] for single in file_names(n, path)):
        try:
            target, place = named_file(path, mesh_folders(path), name, picture=False)
        except InputRefused as error:
            notes.append(f"Material library {name} was left out: {error}")
            continue
        if target is None:
            notes.append(f"Material library {name} is not there; its materials were read as plain.")
            continue
        libraries[target] = None
        if place is not None:
            notes.append(f"Material library {name} was found by its name at {place}.")
    return list(libraries), notes


def file_names(statement: str, path: Path) -> list[str]:
    """One statement may name several libraries; a single name may hold spaces."""
    parts = statement.split()
    several = len(parts) > 1 and all(part.lower().endswith(".mtl") for part in parts)
    return parts if several and not (path.parent / statement).is_file() else [statement]


def _materials(names: list[str], lines: dict[bytes, list], path: Path) -> tuple[tuple[RawMaterial, ...], list[str]]:
    """The material of every name that faces use ("" without a statement), and notes."""
    files, notes = library_files(lines[b"mtllib"], path)
    library: dict[str, MtlEntry] = {}
    for file in files:
        try:
            entries, library_notes = read_library(file, path)
        except InputRefused as error:
            notes.append(f"Material library {file.name} was left out: {error}")
            continue
        library |= entries
        notes.extend(library_notes)
    used = [_entry_of(name, library, bool(lines[b"usemtl"]), notes) for name in names]
    unknown = [name for name, entry in zip(names, used, strict=True) if entry is None and name]
    if unknown:
        shown = ", ".join(f"'{name}'" for name in unknown[:8]) + (" and others" if len(unknown) > 8 else "")
        notes.append(f"No library has the material(s) {shown}; they were read as plain.")
    if library and "" in names and used[names.index("")] is None:
        notes.append("Some faces state no material (usemtl) and were read as plain.")
    notes.extend(unread([entry for entry in used if entry is not None]))
    budget = Budget(path)
    materials = (_plain(n) if entry is None else material(entry, budget) for n, entry in zip(names, used, strict=True))
    return tuple(materials), notes


def _entry_of(name: str, library: dict[str, MtlEntry], stated: bool, notes: list[str]) -> MtlEntry | None:
    """A name's material: the exact name, else the only case-insensitive match, else the library's only material where
    the file states none."""
    if name in library:
        return library[name]
    matches = [entry for key, entry in library.items() if name and key.casefold() == name.casefold()]
    if len(matches) == 1:
        notes.append(f"Material '{name}' was matched to '{matches[0].name}' of its library.")
        return matches[0]
    if not stated and len(library) == 1:
        (entry,) = library.values()
        notes.append(f"No face states a material (usemtl): '{entry.name}', the only one of its library, was used.")
        return entry
    return None


def _left_out(lines: dict[bytes, list]) -> list[str]:
    """Notes on statements that were not read."""
    names = set(lines[b"others"])
    notes = ["Lines and points were left out."] if names & LINES else []
    notes += ["Free-form curves and surfaces were left out."] if names & FREE_FORM else []
    unknown = sorted(names - LINES - FREE_FORM - WITHOUT_LOOKS)
    if unknown:
        shown = ", ".join(repr(name[:20].decode("ascii", "replace")) for name in unknown[:8])
        notes.append(f"Statements that OBJ does not have were left out: {shown}.")
    return notes
