"""Wavefront OBJ and MTL, keeping vertex and face order, corner normals and UVs."""

import re
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from mistyle.core.asset import Primitive
from mistyle.core.errors import InputRefused
from mistyle.files.bounds import beside, read_bytes, refuse
from mistyle.files.pictures import Budget, texture
from mistyle.files.polygons import check_positions, parse_numbers, too_many, triangulate
from mistyle.files.raw import Maps, Raw, RawMap, RawMaterial, no_textures
from mistyle.files.texels import Kind

MAX_LIBRARY_BYTES = 16 << 20
AGAIN = "Export the mesh again as OBJ with triangles or convex polygons"
TEXTURES = {
    b"map_kd": "albedo",
    b"map_pr": "roughness",
    b"map_pm": "metallic",
    b"norm": "normal",
}
STATED = (b"usemtl", b"o", b"g")  # statements that hold for all faces until the next one
# Options of a texture statement and how many values follow; the file name is what comes after them.
OPTIONS = {b"-mm": 2, b"-o": 3, b"-s": 3, b"-t": 3, b"-blendu": 1, b"-blendv": 1, b"-boost": 1, b"-texres": 1}
OPTIONS |= {b"-clamp": 1, b"-bm": 1, b"-imfchan": 1, b"-type": 1, b"-cc": 1}


def read_obj(path: Path, max_faces: int) -> Raw:
    """Polygons become fans around their first corner (concave ones are cut into ears), in file order. Lines, points and
    free-form surfaces are left out; so are faces with fewer than three corners, with a note. Vertex colours are not
    read."""
    data = re.sub(rb"\\\r?\n", b" ", read_bytes(path))
    lines, notes = _sorted_lines(data), []
    positions = _table(lines[b"v"], 3, path, "vertices")
    if len(lines[b"f"]) == 0:
        fix = "Export the mesh with its faces"
        raise refuse(path, f"{len(positions)} vertices and no faces", "at least one triangle", fix)
    if max((len(line.split()) for line in lines[b"v"][:1]), default=3) >= 6:
        notes.append("Vertex colours were not read.")
    too_many(len(positions), 3 * max_faces, path, "vertices")
    corners, sizes = _corners(lines, path, max_faces)
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
    thing, things = _stated(lines[kind], lines[kind + b"_at"], polygon)
    library, said = _libraries(lines[b"mtllib"], path)
    budget = Budget(path)
    materials = tuple(library[n](budget) if n in library else _plain(n) for n in names)
    return Raw(
        kind="obj",
        positions=positions,
        faces=index[..., 0],
        normals=_pick(_table(lines[b"vn"], 3, path, "normals"), index[..., 2]),
        uvs=_pick(_table(lines[b"vt"], 2, path, "texture coordinates"), index[..., 1]),
        material=material,
        materials=materials,
        primitives=_runs(material, thing, things),
        notes=(*notes, *said),
    )


def _plain(name: str) -> RawMaterial:
    return RawMaterial(name or "material", no_textures, roughness_factor=0.5)


def _sorted_lines(data: bytes) -> dict[bytes, list]:
    """The statements' arguments by keyword; `usemtl_at`, `o_at` and `g_at` hold the number of faces before each,
    `counts` the numbers of v, vt and vn before each face (only where faces count backwards)."""
    found: dict[bytes, list] = {k: [] for k in (b"v", b"vt", b"vn", b"f", b"mtllib", b"counts")}
    found |= {k: [] for name in STATED for k in (name, name + b"_at")}
    v, vt, vn, f = found[b"v"], found[b"vt"], found[b"vn"], found[b"f"]
    backwards = re.search(rb"^[ \t]*f[ \t][^\n]*-", data, re.MULTILINE) is not None
    for line in data.splitlines():
        parts = line.split(None, 1)
        if len(parts) < 2:
            if parts and parts[0] in STATED:
                found[parts[0]].append(b"")
                found[parts[0] + b"_at"].append(len(f))
            continue
        keyword, rest = parts
        if keyword == b"f":
            f.append(rest.partition(b"#")[0])
            if backwards:
                found[b"counts"].append((len(v), len(vt), len(vn)))
        elif keyword in (b"v", b"vt", b"vn"):
            found[keyword].append(rest)
        elif keyword == b"mtllib":
            found[keyword].append(rest.strip())
        elif keyword in STATED:
            found[keyword].append(rest.strip())
            found[keyword + b"_at"].append(len(f))
    return found


def _table(lines: list[bytes], width: int, path: Path, what: str) -> Float[np.ndarray, "n w"]:
    """The first `width` numbers of every line."""
    if not lines:
        return np.zeros((0, width))
    widths = {len(line.split()) for line in lines}
    if len(widths) == 1 and (columns := widths.pop()) >= width and b"#" not in lines[0]:
        return parse_numbers(b" ".join(lines), path, what).reshape(-1, columns)[:, :width]
    rows = [line.partition(b"#")[0].split()[:width] for line in lines]
    if width == 2:
        rows = [row + [b"0"] * (2 - len(row)) for row in rows]  # one-dimensional textures leave v out
    short = next((i for i, row in enumerate(rows) if len(row) < width), None)
    if short is not None:
        raise refuse(path, f"line {short + 1} of its {what} with {len(rows[short])} numbers", f"{width}", AGAIN)
    return parse_numbers(b" ".join(b" ".join(row) for row in rows), path, what).reshape(-1, width)


def _corners(
    lines: dict[bytes, list], path: Path, max_faces: int
) -> tuple[Int[np.ndarray, "c 3"], Int[np.ndarray, " p"]]:
    """Vertex, texture and normal index (from 0; -1 where missing) of every polygon corner, and corners per polygon."""
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
        raise refuse(path, f"a face that is no list of indices ({str(error)[:80]})", "f v/vt/vn ...", AGAIN) from error
    index = np.pad(index.astype(np.int64), ((0, 0), (0, 3 - index.shape[1]))) if index.shape[1] < 3 else index[:, :3]
    counts = [len(lines[k]) for k in (b"v", b"vt", b"vn")]
    if (index < 0).any():
        before = np.repeat(np.array(lines[b"counts"]).reshape(-1, 3), sizes, axis=0)
        index = np.where(index < 0, before + index + 1, index)
        index[index < 0] = 2**31
    for column, (count, what) in enumerate(zip(counts, ("vertex", "texture coordinate", "normal"), strict=True)):
        top = int(index[:, column].max(initial=0))
        if top > count:
            shown = "before the first" if top == 2**31 else top
            raise refuse(path, f"a face that uses {what} {shown}", f"1 to {count}", AGAIN)
    if (index[:, 0] == 0).any():
        raise refuse(path, "a face that uses vertex 0", f"1 to {counts[0]}", AGAIN)
    return index - 1, sizes


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
    text = ["", *(n.decode("utf-8", "replace") for n in names)]
    statement = np.searchsorted(starts_at, polygon, side="right") - 1
    numbers: dict[str, int] = {}
    seen = np.zeros(len(text), np.int64)
    present = np.zeros(len(text), bool)
    present[statement] = True
    for s in np.flatnonzero(present):
        seen[s] = numbers.setdefault(text[s], len(numbers))
    return seen[statement], list(numbers)


def _runs(material: Int[np.ndarray, " f"], thing: Int[np.ndarray, " f"], things: list[str]) -> tuple[Primitive, ...]:
    """One primitive for each run of faces with the same material and object."""
    cuts = np.flatnonzero((np.diff(material) != 0) | (np.diff(thing) != 0)) + 1
    bounds = [0, *cuts.tolist(), len(material)]
    return tuple(
        Primitive(-1, -1, -1, a, b, int(material[a]), -1, -1, name=things[thing[a]])
        for a, b in zip(bounds[:-1], bounds[1:], strict=True)
        if b > a
    )


# --- materials ---


def _libraries(names: list[bytes], path: Path) -> tuple[dict, tuple[str, ...]]:
    """Material makers by name, from every library that can be read; notes about those that cannot."""
    found, notes = {}, []
    for name in dict.fromkeys(single for n in names for single in file_names(n.decode("utf-8", "replace"), path)):
        try:
            target = beside(path, name)
            if not target.is_file():
                notes.append(f"Material library {name} is not there; its materials were read as plain.")
                continue
            found |= _library(read_bytes(target, MAX_LIBRARY_BYTES), target)
        except InputRefused as error:
            notes.append(f"Material library {name} was left out: {error}")
    return found, tuple(notes)


def file_names(statement: str, path: Path) -> list[str]:
    """One statement may name several libraries; a single name may hold spaces."""
    parts = statement.split()
    several = len(parts) > 1 and all(part.lower().endswith(".mtl") for part in parts)
    return parts if several and not (path.parent / statement).is_file() else [statement]


def _library(data: bytes, path: Path) -> dict:
    entries: dict[str, dict[bytes, bytes]] = {}
    current: dict[bytes, bytes] = {}
    for line in data.splitlines():
        parts = line.split(None, 1)
        if len(parts) < 2 or parts[0].startswith(b"#"):
            continue
        if parts[0].lower() == b"newmtl":
            current = entries.setdefault(parts[1].strip().decode("utf-8", "replace"), {})
        else:
            current[parts[0].lower()] = parts[1].strip()
    return {name: partial(_material, name, entry, path) for name, entry in entries.items()}


def _numbers(entry: dict[bytes, bytes], key: bytes, default: list[float]) -> list[float]:
    try:
        found = [float(x) for x in entry.get(key, b"").split()[: len(default)]]
    except ValueError:
        return default
    return found if len(found) == len(default) and np.isfinite(found).all() else default


def _material(name: str, entry: dict[bytes, bytes], path: Path, budget: Budget) -> RawMaterial:
    """Kd counts where there is no map_Kd (many exporters write Kd 0 or 0.8 beside a texture), Pr and Pm likewise."""
    files = {TEXTURES[key]: file_name(value) for key, value in entry.items() if key in TEXTURES}
    colour = [1.0, 1.0, 1.0] if "albedo" in files else _numbers(entry, b"kd", [1.0, 1.0, 1.0])
    rough = 1.0 if "roughness" in files else _numbers(entry, b"pr", [0.5])[0]
    metal = 1.0 if "metallic" in files else _numbers(entry, b"pm", [0.0])[0]
    tiled = any(_tile_name(file, 1001) is not None for file in files.values())
    red, green, blue = (float(np.clip(c, 0, 1)) for c in colour)
    return RawMaterial(
        name,
        partial(_load, files, path, budget),
        (tiled or False) if files else None,
        (red, green, blue),
        float(np.clip(rough, 0, 1)),
        float(np.clip(metal, 0, 1)),
    )


def file_name(statement: bytes) -> str:
    """The file name behind a texture statement's options; it may hold spaces."""
    rest = statement
    while (parts := rest.split(None, 1)) and parts[0].lower() in OPTIONS and len(parts) == 2:
        values = OPTIONS[parts[0].lower()]
        rest = parts[1]
        for k in range(values):
            pieces = rest.split(None, 1)
            if len(pieces) < 2 or (k > 0 and not re.fullmatch(rb"[-+.\deE]+", pieces[0])):
                break
            rest = pieces[1]
    return rest.strip().decode("utf-8", "replace")


def _tile_name(file: str, tile: int) -> str | None:
    """The file of a UDIM tile, where the name marks tiles (<UDIM>, or 1001 between dots or underscores); else None."""
    if "<UDIM>" in file:
        return file.replace("<UDIM>", str(tile))
    marked = r"(?<=[._])1001(?=[._][^/\\]*$)"
    return re.sub(marked, str(tile), file) if re.search(marked, file) else None


def _load(files: dict[str, str], path: Path, budget: Budget, tile: int) -> tuple[Maps, tuple[str, ...]]:
    maps, notes = {}, []
    for name, file in files.items():
        wanted = _tile_name(file, tile) or file
        try:
            target = beside(path, wanted.replace("%", "%25"))
        except InputRefused as error:
            notes.append(f"Texture {wanted} was left out: {error}")
            continue
        if not target.is_file():
            notes.append(f"Texture {wanted} is not there and was left out.")
            continue
        kind: Kind = "colour" if name == "albedo" else "normal" if name == "normal" else "data"
        values = texture(read_bytes(target), str(target), budget)
        maps[name] = RawMap(values[..., 0] if kind == "data" else values, kind=kind)
    return maps, tuple(notes)
