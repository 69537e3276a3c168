"""The folders in which a mesh may name files: its own, and each folder of MISTYLE_ASSETS that holds it.

The rule for all formats: a mesh names files in its own folder or below. A mesh whose real path lies in a folder of
MISTYLE_ASSETS may name every file in that folder. Links are resolved before the check, so a link leads nowhere else.
"""

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from mistyle.core.errors import UsageError
from mistyle.core.paths import real_path

ASSETS = "MISTYLE_ASSETS"
requested: str | None = None  # in the reader process: the variable's value in its client, at the request


@dataclass(frozen=True)
class MeshFolders:
    """Folders of what a mesh names: relative names start at one of `anchors`; `shared` are those of MISTYLE_ASSETS."""

    mesh: Path
    anchors: tuple[Path, ...]
    shared: tuple[Path, ...]

    def hold(self, target: Path) -> bool:
        """Whether a file, without links in its path, lies in one of the folders."""
        return any(target.is_relative_to(folder) for folder in (*self.anchors, *self.shared))

    @property
    def expected(self) -> str:
        """The expected place, for refusals."""
        return " or ".join(["a file inside the mesh's own folder", *(f"inside {folder}" for folder in self.shared)])


def mesh_folders(path: Path) -> MeshFolders:
    """Those of a mesh file: its own folder, then that of a link's target."""
    anchors = tuple(dict.fromkeys((real_path(path.parent), real_path(path).parent)))
    return MeshFolders(path, anchors, shared_folders(path))


def shared_folders(path: Path) -> tuple[Path, ...]:
    """The folders of MISTYLE_ASSETS that hold the file. UsageError for an entry that is relative, or not a folder."""
    mesh = real_path(path)
    result: dict[Path, None] = {}
    for entry in filter(None, map(str.strip, _value().split(os.pathsep))):
        found = None if os.path.isabs(entry) else "a relative path"
        found = found or (None if os.path.isdir(entry) else "not a folder")
        if found:
            raise UsageError(
                f"{ASSETS} names {entry[:400]!r}, which is {found}; expected absolute paths of folders, separated by "
                f"'{os.pathsep}'. Correct {ASSETS}, or unset it"
            )
        folder = real_path(Path(entry))
        if mesh.is_relative_to(folder):
            result[folder] = None
    return tuple(result)


def remedy(mesh: Path, target: Path, first: str, last: Sequence[str] = ()) -> str:
    """The fix for a file that a mesh may not name: `first`, the value of MISTYLE_ASSETS that allows it, and `last`.

    The value names the nearest folder that holds both. It is left out where the file does not exist, or where that
    folder is the root, the home folder or above it, or the folder for temporary files.
    """
    fixes = [first]
    folder, home = real_path(mesh).parent, real_path(Path(os.path.expanduser("~")))
    temporary = [real_path(Path(place)) for place in (os.environ.get("TMPDIR") or "/tmp", "/var/tmp")]
    wide = (Path(folder.anchor), home, *home.parents, *temporary)
    common = next((place for place in (folder, *folder.parents) if target.is_relative_to(place)), wide[0])
    if target.is_file() and common not in wide:
        others = [entry for entry in _value().split(os.pathsep) if entry and not Path(entry).is_relative_to(common)]
        value = os.pathsep.join([*others, str(common)])
        fixes.append(f"set {ASSETS}={value} (meshes there may name each other's files)")
    fixes += last
    return fixes[0] if len(fixes) == 1 else f"{', '.join(fixes[:-1])}, or {fixes[-1]}"


def _value() -> str:
    return os.environ.get(ASSETS, "") if requested is None else requested
