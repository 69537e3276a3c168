"""Texts and file names from other machines: byte-order marks, other encodings, paths of another disk."""

import os
import re
import unicodedata
from collections.abc import Sequence
from itertools import islice
from pathlib import Path

from mistyle.core.errors import InputRefused
from mistyle.core.paths import real_path
from mistyle.io.sandbox.asset_folders import MeshFolders
from mistyle.io.sandbox.bounds import COPY, inside

TEXTURES = "textures"  # folder in archives of models, in the mesh's folder or beside it
MARKS = ((b"\xef\xbb\xbf", "utf-8"), (b"\xff\xfe", "utf-16-le"), (b"\xfe\xff", "utf-16-be"))
MAX_ENTRIES = 20_000  # entries of a folder that are searched


def unmarked(data: bytes) -> bytes:
    """A text's bytes without a byte-order mark; UTF-16 becomes UTF-8."""
    for mark, encoding in MARKS:
        if data.startswith(mark):
            text = data[len(mark) :]
            return text if encoding == "utf-8" else text.decode(encoding, "replace").encode()
    return data


def decoded(*texts: bytes) -> tuple[list[str], bool]:
    """Names from one file, and whether they are UTF-8; else all of them are decoded as Windows-1252 or Latin-1."""
    for encoding in ("utf-8", "cp1252"):
        try:
            return [text.decode(encoding) for text in texts], encoding == "utf-8"
        except UnicodeDecodeError:
            continue
    return [text.decode("latin-1") for text in texts], False


def named_file(where: Path, folders: MeshFolders, name: str, *, picture: bool = True) -> tuple[Path | None, str | None]:
    """The file that `where` names, and its actual place if that differs from the name.

    The literal name is tried first, relative to each anchor of the mesh's `folders`. Then its last parts are searched
    there, and the whole name in the shared folders, ignoring case. For a `picture`, its last part is also searched in
    the folder `textures` of an anchor or beside it: the only folder outside that is ever opened. None without such a
    file. Raises InputRefused where there is none and the name leads out of the folders.
    """
    name = name.strip().strip('"')
    refused: InputRefused | None = None
    for root in folders.anchors:
        try:
            target = inside(root, name, where, COPY, folders)
        except InputRefused as error:
            refused = error
            continue
        if target.is_file():
            return target, None
    for root in folders.anchors:
        match = _search(real_path(root), name, picture) or _shared(folders.shared, root, name)
        if match is not None:
            return match, os.path.relpath(match, real_path(where.parent)).replace("\\", "/")
    if refused is not None:
        raise refused
    return None, None


def _search(root: Path, name: str, picture: bool) -> Path | None:
    parts = [part for part in re.split(r"[/\\]", name) if part not in ("", ".", "..") and not part.endswith(":")]
    if not parts or "\0" in name:
        return None
    places = [(root, parts[k:]) for k in range(len(parts))]
    if picture:
        folders = [_entry(root, TEXTURES), _entry(root.parent, TEXTURES)]
        places += [(folder, parts[-1:]) for folder in folders if folder is not None]
    for folder, tail in places:
        # Links to files outside are not followed.
        target = _walk(folder, tail)
        if target is not None and real_path(target).is_relative_to(folder) and target.is_file():
            return real_path(target)
    return None


def _shared(shared: Sequence[Path], anchor: Path, name: str) -> Path | None:
    """The file of that name, ignoring case, in a shared folder; `..` leads to the folder above."""
    if "\0" in name:
        return None
    whole = Path(os.path.normpath(anchor / name.replace("\\", "/")))
    for folder in shared:
        target = _walk(folder, whole.relative_to(folder).parts) if whole.is_relative_to(folder) else None
        if target is not None and real_path(target).is_relative_to(folder) and target.is_file():
            return real_path(target)
    return None


def _walk(folder: Path, parts: Sequence[str]) -> Path | None:
    current: Path | None = folder
    for part in parts:
        current = _entry(current, part) if current is not None else None
    return current


def _entry(folder: Path, name: str) -> Path | None:
    """The entry of that name, else the only one that differs only in case or Unicode form."""
    names = _names(folder)
    if name in names:
        return folder / name
    matches = [n for n in names if _folded(n) == _folded(name)]
    return folder / matches[0] if len(matches) == 1 else None


def _folded(name: str) -> str:
    return unicodedata.normalize("NFC", name).casefold()


def _names(folder: Path) -> set[str]:
    try:
        with os.scandir(folder) as entries:
            return {entry.name for entry in islice(entries, MAX_ENTRIES)}
    except OSError:
        return set()
