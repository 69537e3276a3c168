"""Limits on untrusted files: sizes, counts, and the paths that they may reference."""

import errno
import re
from pathlib import Path
from urllib.parse import unquote

import numpy as np

from mistyle.core.errors import InputRefused
from mistyle.core.paths import real_path
from mistyle.io.sandbox.asset_folders import MeshFolders, mesh_folders, remedy
from mistyle.process.cores import in_pieces

USD = (".usd", ".usda", ".usdc", ".usdz")
MAX_FILE_BYTES = 2 << 30
MAX_JSON_BYTES = 64 << 20
MAX_SETTINGS_BYTES = 4 << 20  # of a TOML or YAML file
MAX_VALUES = 1_000_000  # in a TOML or YAML file, with aliases expanded
MAX_DEPTH = 128  # of nested JSON and of the node graph
MAX_NODES = 200_000
MAX_PIXELS = 1 << 26  # of one picture: 8192 x 8192
MAX_TEXTURE_PIXELS = 1 << 27  # of all textures of one mesh
WORK_TEXTURE = 4096  # a mesh's own textures are halved until no side is longer
COPY = "Copy the file into the mesh's folder and name it relative to the mesh"
READ_THREADS = 1  # for one large file; the reader process uses more


def refuse(path: Path | str, found: str, expected: str, fix: str) -> InputRefused:
    """A refusal in the common form: file, content found, content expected, fix."""
    return InputRefused(f"{path}: found {found[:400]}; expected {expected[:800]}. {fix}")


def read_bytes(path: Path, limit: int | None = None, count: int = -1) -> bytes:
    """The whole file (or its first `count` bytes), if it is one and not larger than `limit` (MAX_FILE_BYTES)."""
    _check_size(path, limit)
    try:
        with open(path, "rb") as file:
            return file.read(count)
    except OSError as error:
        raise _unreadable(path, error) from error


def read_part(path: Path, start: int, count: int) -> memoryview:
    """`count` bytes of a file from `start` on, fewer where it ends before; READ_THREADS threads share the work."""
    available = _check_size(path, None) - start
    place = np.empty(max(min(count, available), 0), np.uint8).data

    def read(at: int, piece: memoryview) -> None:
        with open(path, "rb", buffering=0) as file:
            file.seek(start + at)
            while piece:
                done = file.readinto(piece)
                if not done:
                    raise OSError(errno.EIO, "it became shorter while it was read")
                piece = piece[done:]

    try:
        in_pieces(place, read, READ_THREADS)
    except OSError as error:
        raise _unreadable(path, error) from error
    return place


def _check_size(path: Path, limit: int | None) -> int:
    """The size of a file in bytes, if it is one and not larger than `limit` (MAX_FILE_BYTES)."""
    limit = MAX_FILE_BYTES if limit is None else limit
    if not path.exists():
        raise refuse(path, "nothing", "a file", "Check the path")
    if not path.is_file():
        raise refuse(path, "something that is not a plain file", "a file", "Check the path")
    size = path.stat().st_size
    if size > limit:
        found, most = f"{size / 2**20:.0f} MiB", f"at most {limit / 2**20:.0f} MiB"
        raise refuse(path, found, most, "Reduce the file (fewer faces, smaller textures)")
    return size


def _unreadable(path: Path, error: OSError) -> InputRefused:
    return refuse(path, f"a file that cannot be read ({error.strerror})", "a readable file", "Check its permissions")


def inside(folder: Path, name: str, where: Path, fix: str, folders: MeshFolders | None = None) -> Path:
    """The file of that name in `folder` or below, which need not exist; links are resolved before the check.

    The name is literal (a percent sign is a letter), but backslashes separate folders. Raises InputRefused
    for network addresses and everything that leads out of the folder; `where` is the file that names it. `folders` are
    those of the mesh that `where` belongs to: a file in their `shared` ones is accepted, too.
    """
    problem = f"the file name {name[:120]!r}"
    plain = name.replace("\\", "/")
    if re.match(r"[A-Za-z][A-Za-z0-9+.-]+://", plain) or plain.startswith("//"):
        raise refuse(where, problem, "a relative file name (nothing is fetched)", fix)
    if "\0" in plain or not plain:
        raise refuse(where, problem, "a file name", fix)
    root = real_path(folder)
    try:
        target = real_path(root / plain)
    except OSError as error:  # a loop of links
        raise refuse(where, problem, "a file name", fix) from error
    drive = re.match(r"[A-Za-z]:/", plain)
    shared = () if folders is None else folders.shared
    if drive or not any(target.is_relative_to(place) for place in (root, *shared)):
        suffix = "" if drive else f", which is {target}"
        expected = " or ".join(f"a file inside the folder {place}" for place in (root, *shared))
        fix = fix if folders is None or drive else remedy(folders.mesh, target, fix)
        raise refuse(where, f"{problem}{suffix}", expected, fix)
    return target


def beside(path: Path, reference: str) -> Path:
    """The file that `path` names, if it lies in one of its folders (sandbox/asset_folders.py) or below; links are
    resolved before the check.

    A `path` that is a link has two folders, its own and that of its target, searched in this order. Percent escapes are
    decoded as in URIs (not in `inside`). Raises InputRefused for network addresses and everything that leads out of
    the folders.
    """
    name = unquote(reference).replace("\\", "/")
    problem = f"a reference to {reference[:120]!r}"
    if re.match(r"[A-Za-z][A-Za-z0-9+.-]+:", name) or name.startswith("//"):
        raise refuse(path, problem, "a relative file name (nothing is fetched)", COPY)
    if "\0" in name or not name:
        raise refuse(path, problem, "a file name", COPY)
    try:
        folders = mesh_folders(path)
        targets = [real_path(anchor / name) for anchor in folders.anchors]
    except OSError as error:  # a loop of links
        raise refuse(path, problem, "a file name", COPY) from error
    drive = re.match(r"[A-Za-z]:", name)
    usable = [] if drive else [target for target in targets if folders.hold(target)]
    if not usable:
        raise refuse(path, problem, folders.expected, COPY if drive else remedy(path, targets[-1], COPY))
    return next((target for target in usable if target.exists()), usable[0])
