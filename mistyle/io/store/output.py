"""Output folders: mistyle replaces only files that it wrote itself.

`.mistyle.written` in an output folder lists those files with their sha256, and the subfolders that mistyle owns:
the stages of a run, each with its own list in done.json. All other content belongs to the user: bytes, names, times,
links and empty folders stay. A verb refuses, before it works, to replace a file that is not in the list or has changed
since. `overwrite` replaces files of colliding names, never an input, and deletes nothing.
"""

import errno
import hashlib
import itertools
import json
import os
import shutil
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from mistyle.core.errors import UsageError
from mistyle.io.store.atomic import (
    COUNTER,
    DONE,
    atomic_folder,
    atomic_write,
    clean_leftovers,
    flush_all,
    flush_folder,
    hidden,
    sha256_file,
    swap,
)
from mistyle.io.store.trusted_json import read_own
from mistyle.process import disk_errors

RECORD = ".mistyle.written"
# Files that identify a folder of a version without a record.
OLDER = (
    *("run.json", "camera.json", "compare.json", "verify.json", "converge.json", "lookdev.json", "batch.json"),
    *("done.json", "SHA256SUMS", "*.export.json", "*/done.json"),
)
WAY_OUT = "Choose another folder with -o, move it away"


class Entry(NamedTuple):
    """A file of ours: the verb that wrote it, and its sha256; two hashes while one content replaces the other."""

    by: str
    sha256: tuple[str, ...]


@dataclass(frozen=True)
class Written:
    """The files that mistyle wrote into a folder, by their names inside it, and the subfolders that it owns."""

    files: Mapping[str, Entry]
    folders: frozenset[str] = frozenset()


NOTHING = Written({})


def read_written(root: Path) -> Written:
    """The record of a folder; empty where it is absent or damaged."""
    try:
        record = read_own(root / RECORD)
        files = {str(k): Entry(str(v["by"]), tuple(map(str, v["sha256"]))) for k, v in record["files"].items()}
        return Written(files, frozenset(map(str, record["folders"])))
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return NOTHING


def _write_record(root: Path, written: Written) -> None:
    files = {name: {"by": entry.by, "sha256": list(entry.sha256)} for name, entry in sorted(written.files.items())}
    record = {"about": "what mistyle wrote into this folder", "files": files, "folders": sorted(written.folders)}
    atomic_write(root / RECORD, (json.dumps(record, indent=1) + "\n").encode())


def claim(
    root: Path,
    files: Iterable[str] = (),
    folders: Iterable[str] = (),
    inputs: Iterable[Path] = (),
    *,
    aside: bool = False,
    overwrite: bool = False,
) -> None:
    """Refuse an output folder in which a verb would replace a file that mistyle did not write; writes nothing.

    `files` are the names inside `root` that a verb will write, `folders` the subfolders that it will own. With `aside`
    a file of ours may have been edited: the verb will set it aside (`write_file`). Raises UsageError, which names the
    file, the reason and the fix.
    """
    root = real(root)
    if os.path.lexists(root) and not root.is_dir():
        raise UsageError(f"{root}: found a file, expected a folder to write into. Choose another folder with -o")
    files, folders = list(files), list(folders)
    _refuse_inputs(root, files, folders, inputs)
    if not root.is_dir():
        return
    written = read_written(root)
    for name in files:
        _refuse_file(root, name, written, overwrite or (aside and name in written.files))
    for name in folders:
        if not keeps(root, name, written):
            _refuse_folder(root, name, overwrite)


def keeps(root: Path, name: str, written: Written | None = None) -> bool:
    """Whether mistyle owns this subfolder of an output folder, or may claim it: it holds no user's file."""
    folder = root / name
    if not os.path.lexists(folder):
        return True
    known = name in (written or read_written(root)).folders
    return folder.is_dir() and (known or not any(files_of(folder)))


def _refuse_inputs(root: Path, files: list[str], folders: list[str], inputs: Iterable[Path]) -> None:
    covered, owned = {real(root / name): name for name in files}, {real(root / name): name for name in folders}
    for path in inputs:
        place = real(path)
        inside = next((name for folder, name in owned.items() if place.is_relative_to(folder)), None)
        if place in covered or inside is not None:
            reason = f"is in {inside}/, which this command replaces" if inside else "would be replaced"
            raise UsageError(f"{path}: this input {reason}. Choose a folder with -o that holds no input")


def _refuse_file(root: Path, name: str, written: Written, overwrite: bool) -> None:
    path = root / name
    for parent in itertools.takewhile(lambda p: p != root, path.parents):
        if os.path.lexists(parent) and not parent.is_dir():
            raise UsageError(f"{parent}: found a file, a folder is needed here for {path.name}. {WAY_OUT}")
    if not os.path.lexists(path):
        return
    if path.is_dir() and not path.is_symlink():
        raise UsageError(f"{path}: found a folder, a file of this name would be written here. {WAY_OUT}")
    if overwrite or ours(root, name, written):
        return
    if name in written.files and not path.is_symlink():
        raise UsageError(
            f"{path}: this file was edited after mistyle wrote it, and would be replaced. {WAY_OUT}, or replace it "
            "with --overwrite"
        )
    raise UsageError(
        f"{path}: mistyle did not write this file{_why(root)}, and would replace it. {WAY_OUT}, or replace files of "
        "such names with --overwrite"
    )


def _refuse_folder(root: Path, name: str, overwrite: bool) -> None:
    if not (root / name).is_dir():
        raise UsageError(f"{root / name}: found a file, a folder of this name would be written here. {WAY_OUT}")
    if not overwrite:
        raise UsageError(
            f"{root / name}: mistyle did not make this folder{_why(root)}, and needs one of this name. {WAY_OUT}, or "
            "write into it with --overwrite, which replaces files of colliding names only"
        )


def _why(root: Path) -> str:
    """Why mistyle does not recognise its files in a folder that seems to hold some."""
    if (root / RECORD).is_file():
        return "" if read_written(root) is not NOTHING else f" ({RECORD}, the list of what it wrote here, is damaged)"
    if any(next(root.glob(pattern), None) for pattern in OLDER):
        return " (an older version of mistyle may have: it kept no list of its files, so they look like yours)"
    return ""


def ours(root: Path, name: str, written: Written) -> bool:
    """Whether the file exists as mistyle wrote it."""
    entry, path = written.files.get(name), root / name
    return entry is not None and path.is_file() and not path.is_symlink() and sha256_file(path) in entry.sha256


def replace_files(
    root: Path,
    by: str,
    fill: Callable[[Path], object],
    *,
    inputs: Iterable[Path] = (),
    overwrite: bool = False,
    lasting: Callable[[str], bool] = lambda name: False,
) -> None:
    """Fill a new folder by `fill(folder)` and put its files into `root`, once all of them are complete.

    `by` names the writer (a verb). Its files of an earlier call that are not written again are deleted, except edited
    ones and `lasting` ones, which several writers share. A `root` that is new, or holds only this writer's unchanged
    files, is swapped as a whole; elsewhere each file is replaced atomically. Raises UsageError as `claim` does, for the
    names of the new files.
    """
    root = real(root)
    inputs = [real(path) for path in inputs]
    inside = [path for path in inputs if path.is_relative_to(root)]

    def stays(name: str) -> bool:
        return lasting(name) or any((root / name).is_relative_to(path) for path in inside)

    def whole() -> bool:
        return _wholly(root, by) and not any(stays(name) for name in read_written(root).files)

    with disk_errors.translated(root):
        root.parent.mkdir(parents=True, exist_ok=True)
    clean_leftovers(root.parent, name=root.name)
    if root.is_dir():
        clean_leftovers(root)
    # Beside the folder, so that it can be swapped; inside where it is a mount point or its parent is read-only.
    alone = os.path.ismount(root) or (root.is_dir() and not os.access(root.parent, os.W_OK))
    place = root / "files" if alone else root
    count = next(COUNTER)
    temporary = hidden(place, count, "tmp")
    try:
        with disk_errors.translated(root, temporary):
            temporary.mkdir()
            fill(temporary)
            new = {name: sha256_file(temporary / name) for name in files_of(temporary)}
            claim(root, new, inputs=inputs, overwrite=overwrite)
            flush_all(temporary)
            if not os.path.lexists(root) or (place == root and whole()):
                _write_record(temporary, Written({name: Entry(by, (value,)) for name, value in new.items()}))
                swap(temporary, root, hidden(root, count, "old"))
                flush_folder(root.parent)
            else:
                _merge(temporary, root, by, new, stays)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def _merge(temporary: Path, root: Path, by: str, new: Mapping[str, str], stays: Callable[[str], bool]) -> None:
    """Move the files one by one. The record first names old and new contents, so that a kill leaves no file unknown."""
    before = read_written(root)
    both = {name: Entry(by, (*_hashes(before, name), value)) for name, value in new.items()}
    _write_record(root, Written({**before.files, **both}, before.folders))
    for name in sorted(new, key=lambda name: name.endswith(".json")):  # lists last: they name only present files
        move(temporary / name, root / name)
    obsolete = [name for name, entry in before.files.items() if entry.by == by and name not in new and not stays(name)]
    for name in obsolete:
        if ours(root, name, before):
            (root / name).unlink()
    remaining = {name: entry for name, entry in before.files.items() if name not in obsolete}
    _write_record(root, Written({**remaining, **{k: Entry(by, (v,)) for k, v in new.items()}}, before.folders))


def _hashes(written: Written, name: str) -> tuple[str, ...]:
    return written.files[name].sha256 if name in written.files else ()


def move(source: Path, target: Path) -> None:
    """Move a finished file to its target atomically, also from another disk."""
    target.parent.mkdir(parents=True, exist_ok=True)
    try:
        os.replace(source, target)
    except OSError as error:
        if error.errno != errno.EXDEV:
            raise
        atomic_write(target, source.read_bytes())


def write_file(root: Path, name: str, data: bytes, *, overwrite: bool = False) -> Path | None:
    """Write one file of a folder that mistyle uses repeatedly (run.json).

    An edited older file is set aside as `<stem>.edited-N<suffix>`, whose path is returned. UsageError for a file that
    is not ours.
    """
    root = real(root)
    written, path, aside = read_written(root), root / name, None
    if path.is_file() and path.read_bytes() == data:
        return None
    if name in written.files and os.path.lexists(path) and not ours(root, name, written):
        places = (path.with_stem(f"{path.stem}.edited-{n}") for n in itertools.count(1))
        aside = next(place for place in places if not os.path.lexists(place))
        with disk_errors.translated(path):
            os.rename(path, aside)
    _refuse_file(root, name, written, overwrite)
    with disk_errors.translated(root):
        root.mkdir(parents=True, exist_ok=True)
    entry = Entry("run", (*_hashes(written, name), hashlib.sha256(data).hexdigest()))
    _write_record(root, Written({**written.files, name: entry}, written.folders))
    atomic_write(path, data)
    _write_record(root, Written({**written.files, name: Entry("run", entry.sha256[-1:])}, written.folders))
    return aside


def put_folder(
    target: Path,
    fill: Callable[[Path], object],
    written: Callable[[Path], set[str]],
    *,
    overwrite: bool = False,
) -> None:
    """Fill a new folder by `fill(folder)` and put it at `target`: swapped in where only files of ours lie, else merged.

    `written(target)` names those files. In a merged folder they are replaced or deleted, and all others stay.
    UsageError where a file that is not ours has the name of a new one.
    """

    def put(new: Path, place: Path, aside: Path) -> None:
        old = written(place) if place.is_dir() else set()
        if not os.path.lexists(place) or _only(place, old):
            swap(new, place, aside)
        else:
            _lay_into(new, place, old, overwrite)

    atomic_folder(target, fill, put)


def _lay_into(temporary: Path, target: Path, old: set[str], overwrite: bool) -> None:
    new = list(files_of(temporary))
    foreign = [name for name in new if os.path.lexists(target / name) and name not in old]
    if foreign and not overwrite:
        raise UsageError(
            f"{target / foreign[0]}: mistyle did not write this file, and would replace it. {WAY_OUT}, or replace "
            "files of such names with --overwrite"
        )
    for name in old.difference(new):
        (target / name).unlink(missing_ok=True)
    for name in sorted(new, key=lambda name: name == DONE):  # the marker last: until then the folder is unfinished
        move(temporary / name, target / name)


def _only(folder: Path, names: set[str]) -> bool:
    """Whether a folder holds only these files, and may be swapped as a whole."""
    return not os.path.ismount(folder) and set(files_of(folder)) <= names and not _empty_folders(folder)


def keep_folder(root: Path, name: str) -> None:
    """Record that mistyle owns this subfolder; it must have been claimed."""
    written = read_written(root)
    if name not in written.folders:
        _write_record(root, Written(written.files, written.folders | {name}))


def forget_folder(root: Path, name: str) -> None:
    """Undo `keep_folder` for a removed subfolder; an empty record is deleted."""
    written = read_written(root)
    remaining = Written(written.files, written.folders - {name})
    if remaining == NOTHING:
        (root / RECORD).unlink(missing_ok=True)
    elif remaining != written:
        _write_record(root, remaining)


def move_aside(folder: Path, label: str, names: Iterable[str]) -> Path:
    """Move these files of a folder to `<folder>.<label>-N`; all others stay. Returns the new path."""
    number = next(n for n in itertools.count(1) if not os.path.lexists(f"{folder}.{label}-{n}"))
    aside = folder.with_name(f"{folder.name}.{label}-{number}")
    chosen = set(names)
    if set(files_of(folder)) <= chosen and not _empty_folders(folder):
        os.rename(folder, aside)
        return aside
    aside.mkdir()
    for name in sorted(chosen):
        if os.path.lexists(folder / name):
            (aside / name).parent.mkdir(parents=True, exist_ok=True)
            os.rename(folder / name, aside / name)
    return aside


def files_of(folder: Path) -> Iterable[str]:
    """Names of the files and links in a folder and below it, '/' between parts, in a fixed order."""
    for place, folders, files in os.walk(folder):
        folders.sort()
        links = [name for name in folders if os.path.islink(os.path.join(place, name))]
        for name in sorted([*files, *links]):
            yield Path(place, name).relative_to(folder).as_posix()


def _empty_folders(folder: Path) -> bool:
    return any(not folders and not files for place, folders, files in os.walk(folder) if place != str(folder))


def _wholly(root: Path, by: str) -> bool:
    """Whether a folder holds only this writer's unchanged files, and may be swapped.

    A folder with a lock is not: other processes wait for the lock inside it.
    """
    written = read_written(root)
    if written is NOTHING or written.folders or any(entry.by != by for entry in written.files.values()):
        return False
    unchanged = all(ours(root, name, written) for name in written.files if os.path.lexists(root / name))
    return unchanged and _only(root, {RECORD, *written.files})


def real(path: Path) -> Path:
    """The absolute path with links followed: a link to a folder elsewhere stays a link."""
    return Path(os.path.realpath(path))
