"""Files that a mesh file references: material libraries, textures, buffers, images."""

from contextlib import suppress
from pathlib import Path
from typing import Any

from mistyle.core.errors import InputRefused
from mistyle.io.gltf.check import parse_json
from mistyle.io.meshes.mtl_read import NAMING, read_library, statement, tile_name
from mistyle.io.meshes.obj_read import library_files
from mistyle.io.meshes.ply_read import MAX_HEADER, texture_files
from mistyle.io.sandbox.asset_folders import mesh_folders
from mistyle.io.sandbox.bounds import MAX_JSON_BYTES, beside, read_bytes
from mistyle.io.sandbox.nearby import named_file, unmarked


def references(path: Path) -> list[Path]:
    """The files that an .obj, .ply or .gltf file names, that exist and that its reader opens; none for other formats.

    None for an unreadable file: its reader refuses it with the reason.
    """
    kind = path.suffix.lower()
    try:
        files = NAMED[kind](path) if kind in NAMED else []
    except InputRefused:
        return []
    return sorted({file for file in files if file.is_file()})


def _of_obj(path: Path) -> list[Path]:
    statements = (line.split(None, 1) for line in unmarked(read_bytes(path)).splitlines())
    library_names = [line[1].strip() for line in statements if len(line) == 2 and line[0] == b"mtllib"]
    libraries = library_files(library_names, path)[0]
    return libraries + [texture for library in libraries for texture in _of_library(library, path)]


def _of_library(library: Path, path: Path) -> list[Path]:
    files: list[Path] = []
    for entry in read_library(library, path)[0].values():
        for key in NAMING & set(entry.values):
            file = statement(entry.values[key]).file
            first = tile_name(file, 1001)
            with suppress(InputRefused):
                target = named_file(library, entry.folders, first or file)[0]
                if target is not None:
                    files += [target] if first is None else target.parent.glob(target.name.replace("1001", "1???"))
    return files


def _of_ply(path: Path) -> list[Path]:
    header = read_bytes(path, count=MAX_HEADER).partition(b"end_header")[0]
    files: list[Path] = []
    for name in texture_files(header):
        with suppress(InputRefused):
            target = named_file(path, mesh_folders(path), name)[0]
            files += [] if target is None else [target]
    return files


def _of_gltf(path: Path) -> list[Path]:
    tree = parse_json(read_bytes(path, MAX_JSON_BYTES), path)
    lists: list[Any] = [tree.get("buffers"), tree.get("images")]
    entries = [entry for items in lists if isinstance(items, list) for entry in items if isinstance(entry, dict)]
    uris = [entry.get("uri") for entry in entries]
    return [file for uri in uris if isinstance(uri, str) and not uri.startswith("data:") for file in _inside(path, uri)]


def _inside(path: Path, name: str) -> list[Path]:
    try:
        return [beside(path, name)]
    except InputRefused:
        return []


NAMED = {".obj": _of_obj, ".ply": _of_ply, ".gltf": _of_gltf}
