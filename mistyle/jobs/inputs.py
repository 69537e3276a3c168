"""The files that a mesh depends on: the file itself and those that it names. Stage keys hash all of them."""

from pathlib import Path

from mistyle.core.errors import InputRefused
from mistyle.core.paths import real_path
from mistyle.io.sandbox.bounds import USD


def input_files(path: Path) -> tuple[Path, ...]:
    """The mesh file, then the material libraries, buffers and images that it names and that exist, in a fixed order."""
    if not path.is_file():
        found = "a folder" if path.is_dir() else "nothing"
        raise InputRefused(
            f"{path}: found {found}, expected a mesh file (.obj .ply .stl .off .glb .gltf .usd); check the path"
        )
    if path.suffix.lower() in USD:
        from mistyle.io.read_mesh import read_usd_files

        return (path, *sorted(p for p in read_usd_files(path) if p != real_path(path)))
    from mistyle.io.read_mesh import read_references

    return (path, *read_references(path))
