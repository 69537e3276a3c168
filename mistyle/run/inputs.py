"""Which files a mesh file stands on: the file itself and those it names, so that a change in any of them is noticed."""

import json
import re
from pathlib import Path
from urllib.parse import unquote

from mistyle.core.errors import InputRefused


def input_files(path: Path) -> tuple[Path, ...]:
    """The mesh file, then the material libraries, buffers and images that it names and that exist, in a fixed order."""
    if not path.is_file():
        found = "a folder" if path.is_dir() else "nothing"
        raise InputRefused(
            f"{path}: found {found}, expected a mesh file (.obj .ply .stl .off .glb .gltf); check the path"
        )
    named: list[str] = []
    if path.suffix.lower() == ".gltf":
        named = _gltf_uris(path)
    elif path.suffix.lower() == ".obj":
        libraries = _lines(path, rb"^\s*mtllib\s+(.+?)\s*$")
        maps = [
            m
            for lib in libraries
            if (path.parent / lib).is_file()
            for m in _lines(path.parent / lib, rb"^\s*(?:map_\w+|norm|bump)\s+.*?(\S+)\s*$")
        ]
        named = libraries + maps
    beside = {(path.parent / name).resolve() for name in named}
    return (path, *sorted(p for p in beside if p.is_file()))


def _gltf_uris(path: Path) -> list[str]:
    try:
        tree = json.loads(path.read_text(encoding="utf-8"))
        entries = [*tree.get("buffers", []), *tree.get("images", [])]
        return [
            unquote(e["uri"]) for e in entries if isinstance(e.get("uri"), str) and not e["uri"].startswith("data:")
        ]
    except (ValueError, AttributeError, TypeError):
        return []  # the reader itself refuses the file, with the sentence that explains it


def _lines(path: Path, pattern: bytes) -> list[str]:
    found = re.findall(pattern, path.read_bytes(), flags=re.MULTILINE)
    return [name.decode("utf-8", "replace") for name in found]
