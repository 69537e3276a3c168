"""Which other files a mesh file names: material libraries, textures, buffers, images."""

from pathlib import Path
from typing import Any

from mistyle.core.errors import InputRefused
from mistyle.files.bounds import MAX_JSON_BYTES, beside, read_bytes
from mistyle.files.gltf_check import parse_json
from mistyle.files.obj_read import MAX_LIBRARY_BYTES, TEXTURES, file_name, file_names


def references(path: Path) -> list[Path]:
    """The files that an .obj or .gltf file names, that exist and lie in its folder or below; others name none.

    A file that cannot be read names none: the reader refuses it, with the sentence that explains it.
    """
    kind = path.suffix.lower()
    try:
        named = _of_obj(path) if kind == ".obj" else _of_gltf(path) if kind == ".gltf" else []
    except InputRefused:
        return []
    return sorted({file for file in named if file.is_file()})


def _of_obj(path: Path) -> list[Path]:
    found: list[Path] = []
    for line in read_bytes(path).splitlines():
        words = line.split(None, 1)
        if len(words) == 2 and words[0] == b"mtllib":
            for name in file_names(words[1].strip().decode("utf-8", "replace"), path):
                found += _inside(path, name)
    return found + [texture for library in found if library.is_file() for texture in _of_library(library)]


def _of_library(path: Path) -> list[Path]:
    found: list[Path] = []
    for line in read_bytes(path, MAX_LIBRARY_BYTES).splitlines():
        words = line.split(None, 1)
        if len(words) == 2 and words[0].lower() in TEXTURES:
            found += _inside(path, file_name(words[1].strip()).replace("%", "%25"))
    return found


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
