"""A folder as a batch: its meshes and its pictures, and what of it takes no part.

A file that is passed over in silence is missed only after the work, hence one line for each kind of them.
"""

import os
from collections import Counter
from collections.abc import Collection, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from mistyle.core.errors import InputRefused, MistyleError
from mistyle.io.read_mesh import MESHES
from mistyle.io.store.output import RECORD
from mistyle.jobs.inputs import input_files

PICTURES = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".bmp")
OTHER_PICTURES = (".avif", ".dds", ".exr", ".gif", ".hdr", ".heic", ".jp2", ".jxl", ".psd", ".svg", ".tga")
OTHER_MESHES = (
    *(".3dm", ".3ds", ".3mf", ".abc", ".blend", ".bgeo", ".c4d", ".dae", ".fbx", ".hip", ".iges", ".igs", ".lwo"),
    *(".ma", ".max", ".mb", ".skp", ".step", ".stp", ".vrm", ".wrl", ".x3d", ".ztl"),
)
MOST_NAMES = 4
MOST_ENTRIES = 20_000  # of subfolders, which are only counted


@dataclass(frozen=True)
class FolderJobs:
    """The meshes and styles of a folder, and a sentence on each kind of file that is left out."""

    meshes: tuple[Path, ...]
    styles: tuple[Path, ...]
    left_out: tuple[str, ...]


def folder_jobs(folder: Path) -> FolderJobs:
    """The meshes and styles of a folder, or of its subfolders `meshes` and `styles`. InputRefused without one of each.

    A picture that one of the meshes names as its texture is not a style.
    """
    places = [folder / name if (folder / name).is_dir() else folder for name in ("meshes", "styles")]
    here = {place: sorted(p for p in place.iterdir() if p.is_file()) for place in {folder, *places}}

    def ending(place: Path, kinds: Collection[str]) -> list[Path]:
        return [path for path in here[place] if path.suffix.lower() in kinds]

    meshes, pictures = ending(places[0], MESHES), ending(places[1], PICTURES)
    own = _own_textures(meshes, ending(places[1], (*PICTURES, *OTHER_PICTURES)))
    styles = [path for path in pictures if path not in own]
    unread = [path for place in dict.fromkeys((folder, places[0])) for path in ending(place, OTHER_MESHES)]
    unseen = [path for path in ending(places[1], OTHER_PICTURES) if path not in own]
    beside = [path for path in ending(folder, PICTURES) if places[1] != folder]
    sentences = (
        _sentence(unread, "file", "of mesh formats that are not read", f"expected {' '.join(MESHES)}"),
        _sentence(unseen, "picture", "of formats that are not taken for styles", f"expected {' '.join(PICTURES)}"),
        _sentence([p for p in pictures if p in own], "picture", "that meshes name as their textures, hence not styles"),
        _sentence(beside, "picture", "beside the folder styles"),
        _subfolders(folder, places[0]),
    )
    left_out = tuple(sentence for sentence in sentences if sentence)
    if not meshes or not styles:
        raise InputRefused(
            f"{folder}: found {len(meshes)} meshes and {len(styles)} style pictures; expected at least one of each, in "
            "it or in its subfolders meshes/ and styles/" + "".join(f"\n  {sentence}" for sentence in left_out)
        )
    return FolderJobs(tuple(meshes), tuple(styles), left_out)


def _own_textures(meshes: Sequence[Path], pictures: Sequence[Path]) -> set[Path]:
    """The pictures that the meshes name as textures. Only pictures in a mesh's folder can be: without any, nothing is
    read."""
    near = {path for path in pictures if path.parent in {mesh.parent for mesh in meshes}}
    named: set[str] = set()
    for mesh in meshes if near else ():
        with suppress(MistyleError):  # a mesh that cannot be read is refused later, with its reason
            named |= {os.path.realpath(path) for path in input_files(mesh)[1:]}
    return {path for path in near if os.path.realpath(path) in named}


def _subfolders(folder: Path, place: Path) -> str:
    """A sentence on the meshes below `folder` that do not lie in `place`; "" without any.

    Hidden folders and folders that mistyle wrote do not count.
    """
    counts: Counter[str] = Counter()
    entries = 0
    for root, folders, files in os.walk(folder):
        folders[:] = sorted(f for f in folders if f[0] != "." and not os.path.lexists(os.path.join(root, f, RECORD)))
        entries += 0 if Path(root) == folder else len(folders) + len(files)
        if Path(root) != place:
            counts[os.path.relpath(root, folder)] += sum(Path(name).suffix.lower() in MESHES for name in files)
        if entries > MOST_ENTRIES:
            break
    found = {"the folder itself" if name == "." else name: count for name, count in counts.items() if count}
    if not found:
        return (
            f"Left out: the subfolders; {entries} files and folders were looked through, none is a mesh."
            if entries > MOST_ENTRIES
            else ""
        )
    number = f"{'at least ' if entries > MOST_ENTRIES else ''}{_count(sum(found.values()), 'mesh', 'meshes')}"
    listed = _names([f"{name} ({count})" for name, count in found.items()])
    return f'Left out: {number} in other folders: {listed}; a jobs file takes them, as meshes = ["**/*.obj"].'


def _sentence(paths: Sequence[Path], noun: str, kind: str, expected: str = "") -> str:
    if not paths:
        return ""
    listed = _names([path.name for path in paths])
    return f"Left out: {_count(len(paths), noun, f'{noun}s')} {kind}: {listed}{f'; {expected}' if expected else ''}."


def _count(number: int, one: str, many: str) -> str:
    return f"{number} {one if number == 1 else many}"


def _names(names: Sequence[str]) -> str:
    more = len(names) - MOST_NAMES
    return ", ".join(names[:MOST_NAMES]) + (f" and {more} more" if more > 0 else "")
