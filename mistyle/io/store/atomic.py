"""Atomic writes of files and folders, content hashes, and the markers of finished folders.

Every file is written under a hidden temporary name beside its target (`.<name>.tmp-<host>-<pid>-<n>`), flushed to the
disk and then renamed. A killed run leaves only such names; the next run removes them.
"""

import contextlib
import dataclasses
import enum
import hashlib
import itertools
import json
import os
import re
import shutil
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
from pydantic import BaseModel

from mistyle.io.store import lock
from mistyle.io.store.trusted_json import read_own
from mistyle.process import disk_errors

DONE = "done.json"
LOCK = ".mistyle.lock"
COUNTER = itertools.count()
_LEFTOVER = re.compile(r"\.(?P<name>.+)\.(?P<kind>tmp|old)-(?P<host>.+)-(?P<pid>\d+)-(?P<n>\d+)(\.\w+)?")


def atomic_write(path: Path, data: bytes | Callable[[Path], None]) -> None:
    """Write a file atomically: a reader sees the whole file or none.

    `data` is the content, or a function that writes it to a temporary path (same folder, same suffix). A disk that is
    full, read-only or missing raises MistyleError (`process/disk_errors.py`) and leaves neither the file nor a
    temporary one; any other error passes through.
    """
    temporary = hidden(path, next(COUNTER), "tmp", path.suffix)
    with disk_errors.translated(path):
        path.parent.mkdir(parents=True, exist_ok=True)
    try:
        with disk_errors.translated(path, temporary):
            if callable(data):
                data(temporary)
            else:
                temporary.write_bytes(data)
            flush(temporary)
            os.replace(temporary, path)
            flush_folder(path.parent)
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)


def atomic_folder(
    target: Path, write: Callable[[Path], object], put: Callable[[Path, Path, Path], None] | None = None
) -> None:
    """Fill a new folder by `write(folder)`; once complete, it replaces the folder at `target`.

    Only for folders that no user shares (checkpoints): all files of the older one are deleted. Use `output.put_folder`
    or `output.replace_files` for folders with a user's files.

    The older folder stays until then. Between the two renames of the swap `target` is absent for an instant; the next
    call (or the next Keeper) for the same target repairs a run killed in between. `put(new, target, old)` replaces
    `swap`.
    """
    target = Path(os.path.realpath(target))  # a link to a folder elsewhere stays a link
    count = next(COUNTER)
    temporary, old = hidden(target, count, "tmp"), hidden(target, count, "old")
    with disk_errors.translated(target):
        target.parent.mkdir(parents=True, exist_ok=True)
        clean_leftovers(target.parent, name=target.name)
        temporary.mkdir()
    try:
        with disk_errors.translated(target, temporary):
            write(temporary)
            flush_all(temporary)
            (put or swap)(temporary, target, old)
            flush_folder(target.parent)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def swap(temporary: Path, target: Path, old: Path) -> None:
    with contextlib.suppress(FileNotFoundError):  # absent, or another run has just removed it
        os.rename(target, old)
    try:
        os.rename(temporary, target)
    except OSError:
        with contextlib.suppress(OSError):  # another run's folder may exist by now; it stays
            os.rename(old, target)
        raise
    shutil.rmtree(old, ignore_errors=True)


def clean_leftovers(folder: Path, *, name: str | None = None, everyones: bool = False) -> None:
    """Remove leftovers of killed runs in a folder (not below it): temporary files and folders, incomplete swaps.

    Only names of this module's pattern are removed (with `name`: only those of this target). Only names of dead
    processes of this host are removed, unless `everyones` is set (for the holder of the folder's lock).
    """
    matches = [(_LEFTOVER.fullmatch(p.name), p) for p in sorted(folder.glob(".*"))]
    leftovers = [(m, p) for m, p in matches if m and name in (None, m["name"])]
    for match, path in leftovers:
        local, pid, target = match["host"] == lock.this_host(), int(match["pid"]), folder / match["name"]
        if (local and pid == os.getpid()) or not (everyones or (local and not lock.alive(pid))) or not path.exists():
            continue
        if match["kind"] == "old" and not target.exists():
            # Killed between the two renames of a swap: the new folder is complete and still has its temporary name.
            swap = match.group("name", "host", "pid", "n")
            new = [p for m, p in leftovers if m["kind"] == "tmp" and m.group("name", "host", "pid", "n") == swap]
            os.rename(new[0] if new else path, target)
        if not path.exists():
            continue
        if path.is_dir():
            shutil.rmtree(path, ignore_errors=True)
        else:
            path.unlink(missing_ok=True)


def sha256_file(path: Path) -> str:
    """The sha256 of a file's bytes as 64 hexadecimal digits."""
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def digest(obj: object) -> str:
    """A hash (64 hexadecimal digits) of settings and inputs that is the same in every process.

    Takes pydantic models, dataclasses, enums, mappings, lists, tuples, sets, arrays (dtype, shape and bytes), bytes
    and JSON's own values. A Path that names a file or folder counts by its content, not by its location; any other
    Path counts by its text. Files that a file refers to (textures of a mesh) do not count: pass them too.
    Raises TypeError for anything else.
    """
    return hashlib.sha256(json.dumps(_plain(obj), sort_keys=True, separators=(",", ":")).encode()).hexdigest()


def _plain(obj: object) -> object:
    match obj:
        case enum.Enum():
            return _plain(obj.value)
        case None | bool() | int() | float() | str():
            return obj
        case np.generic():
            return _plain(obj.item())
        case bytes():
            return {"bytes": hashlib.sha256(obj).hexdigest()}
        case np.ndarray():
            if obj.dtype.hasobject:
                raise TypeError("an array of Python objects has no stable hash; pass numbers")
            content = hashlib.sha256(np.ascontiguousarray(obj).tobytes()).hexdigest()
            return {"array": [obj.dtype.str, list(obj.shape), content]}
        case Path():
            if obj.is_dir():
                return {"folder": [[p.relative_to(obj).as_posix(), sha256_file(p)] for p in _files(obj)]}
            return {"file": sha256_file(obj)} if obj.is_file() else {"path": obj.as_posix()}
        case BaseModel():
            return {"model": type(obj).__name__, "fields": {k: _plain(getattr(obj, k)) for k in type(obj).model_fields}}
        case Mapping():
            return {"mapping": sorted(([_plain(k), _plain(v)] for k, v in obj.items()), key=json.dumps)}
        case list() | tuple():
            return [_plain(x) for x in obj]
        case set() | frozenset():
            return {"set": sorted((_plain(x) for x in obj), key=json.dumps)}
    if dataclasses.is_dataclass(obj) and not isinstance(obj, type):
        fields = {f.name: _plain(getattr(obj, f.name)) for f in dataclasses.fields(obj)}
        return {"record": type(obj).__name__, "fields": fields}
    raise TypeError(f"cannot make a stable hash of a {type(obj).__name__}; pass numbers, text, paths, arrays, records")


def seal(folder: Path, **values: object) -> None:
    """Write the marker of a finished folder: `values`, and the sha256 of every file in it."""
    hashes = {p.relative_to(folder).as_posix(): sha256_file(p) for p in _files(folder)}
    text = json.dumps({**values, "files": hashes}, indent=1, sort_keys=True) + "\n"
    (folder / DONE).write_text(text, encoding="utf-8")


def intact(folder: Path, editable: Callable[[str], bool] = lambda name: False) -> set[str] | None:
    """The files that a sealed folder lists, marker included; None when one is missing or changed.

    Files whose names are `editable` may have changed.
    """
    marker = done(folder)
    if marker is None:
        return None
    whole = all(
        (folder / name).is_file() and (editable(name) or sha256_file(folder / name) == value)
        for name, value in marker[1].items()
    )
    return {DONE, *marker[1]} if whole else None


def done(folder: Path) -> tuple[str, dict[str, str]] | None:
    """Key and hashes of a finished stage's marker; None without a readable one."""
    try:
        marker = read_own(folder / DONE)
        return str(marker["key"]), {str(k): str(v) for k, v in marker["files"].items()}
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return None


def notes_of(folder: Path) -> list[str]:
    """The sentences in a finished stage's marker; empty without a readable one."""
    try:
        return [str(text) for text in read_own(folder / DONE).get("notes", [])]
    except (OSError, ValueError, AttributeError, TypeError):
        return []


def hidden(path: Path, count: int, kind: str, suffix: str = "") -> Path:
    return path.with_name(f".{path.name}.{kind}-{lock.this_host()}-{os.getpid()}-{count}{suffix}")


def _files(folder: Path) -> list[Path]:
    return sorted(p for p in folder.rglob("*") if p.is_file())


def flush_all(folder: Path) -> None:
    """Flush a folder's files and folders to the disk."""
    for path in _files(folder):
        flush(path)
    for place in [*(p for p in sorted(folder.rglob("*")) if p.is_dir()), folder]:
        flush_folder(place)


def flush(path: Path) -> None:
    with open(path, "rb+") as file:
        os.fsync(file.fileno())


def flush_folder(folder: Path) -> None:
    if os.name != "posix":
        return
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
