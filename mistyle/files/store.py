"""Files that are whole or not there: atomic writes, content hashes, and the keeper of finished stages.

Everything is written under a hidden temporary name beside its place (`.<name>.tmp-<host>-<pid>-<n>`), flushed to the
disk and then renamed. A run that is killed at any moment leaves only such names behind; the next run removes them.
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
import weakref
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
from pydantic import BaseModel

from mistyle.core.errors import MistyleError
from mistyle.files import faults, lock
from mistyle.files.own import read_own

DONE = "done.json"
LOCK = ".mistyle.lock"
_COUNTER = itertools.count()
_LEFTOVER = re.compile(r"\.(?P<name>.+)\.(?P<kind>tmp|old)-(?P<host>.+)-(?P<pid>\d+)-(?P<n>\d+)(\.\w+)?")


def atomic_write(path: Path, data: bytes | Callable[[Path], None]) -> None:
    """Write a file so that it is seen either whole or not at all.

    `data` is the content, or a function that writes it to the temporary path it is given (same folder, same suffix).
    A disk that is full, not to be written or gone raises MistyleError (`files/faults.py`) and leaves neither the file
    nor a temporary one; any other error passes through.
    """
    temporary = _hidden(path, next(_COUNTER), "tmp", path.suffix)
    with faults.told(path):
        path.parent.mkdir(parents=True, exist_ok=True)
    try:
        with faults.told(path, temporary):
            if callable(data):
                data(temporary)
            else:
                temporary.write_bytes(data)
            _flush(temporary)
            os.replace(temporary, path)
            _flush_folder(path.parent)
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)


def atomic_folder(target: Path, write: Callable[[Path], None]) -> None:
    """Fill a new folder by `write(folder)` and put it at `target`, in the place of an older one, when it is complete.

    The older folder stays until then. Between the two renames of the swap `target` is absent for an instant; a run
    killed just there is mended by the next call (or the next Keeper) for the same place.
    """
    target = Path(os.path.realpath(target))  # a link to a folder elsewhere stays a link
    count = next(_COUNTER)
    temporary, old = _hidden(target, count, "tmp"), _hidden(target, count, "old")
    with faults.told(target):
        target.parent.mkdir(parents=True, exist_ok=True)
        clean_leftovers(target.parent, name=target.name)
        temporary.mkdir()
    try:
        with faults.told(target, temporary):
            write(temporary)
            for path in _files(temporary):
                _flush(path)
            for folder in [*(p for p in sorted(temporary.rglob("*")) if p.is_dir()), temporary]:
                _flush_folder(folder)
            _swap(temporary, target, old)
            _flush_folder(target.parent)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def _swap(temporary: Path, target: Path, old: Path) -> None:
    with contextlib.suppress(FileNotFoundError):  # none there, or another run has just taken it away
        os.rename(target, old)
    try:
        os.rename(temporary, target)
    except OSError:
        with contextlib.suppress(OSError):  # where another run's folder stands by now, that one stays
            os.rename(old, target)
        raise
    shutil.rmtree(old, ignore_errors=True)


def clean_leftovers(folder: Path, *, name: str | None = None, everyones: bool = False) -> None:
    """Remove what killed runs left in a folder (not below it): temporary files and folders, half-done swaps.

    Only names of the pattern of this module are touched (with `name`: only those of this target), and only those of
    processes of this host that are no longer alive, unless `everyones` (for the holder of the folder's lock).
    """
    matches = [(_LEFTOVER.fullmatch(p.name), p) for p in sorted(folder.glob(".*"))]
    found = [(m, p) for m, p in matches if m and name in (None, m["name"])]
    for match, path in found:
        here, pid, target = match["host"] == lock.this_host(), int(match["pid"]), folder / match["name"]
        if (here and pid == os.getpid()) or not (everyones or (here and not lock.alive(pid))) or not path.exists():
            continue
        if match["kind"] == "old" and not target.exists():
            # Killed between the two renames of a swap: the new folder is complete and still has its temporary name.
            swap = match.group("name", "host", "pid", "n")
            new = [p for m, p in found if m["kind"] == "tmp" and m.group("name", "host", "pid", "n") == swap]
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
    and JSON's own values. A Path that names a file or folder counts by its content, not by where it lies; any other
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


def seal(folder: Path, **told: object) -> None:
    """Write the marker of a finished folder: what is told, and the sha256 of every file in it."""
    hashes = {p.relative_to(folder).as_posix(): sha256_file(p) for p in _files(folder)}
    text = json.dumps({**told, "files": hashes}, indent=1, sort_keys=True) + "\n"
    (folder / DONE).write_text(text, encoding="utf-8")


def intact(folder: Path, editable: Callable[[str], bool] = lambda name: False) -> set[str] | None:
    """The files that a sealed folder was finished with, marker included; None when one is missing or changed.

    Files whose names are `editable` may have changed.
    """
    done = _done(folder)
    if done is None:
        return None
    whole = all(
        (folder / name).is_file() and (editable(name) or sha256_file(folder / name) == value)
        for name, value in done[1].items()
    )
    return {DONE, *done[1]} if whole else None


class Keeper:
    """Keeps the folders of finished stages of one run and lets one process at a time work there.

    `root/<stage>/` holds a stage's files and `done.json` (its key and the sha256 of every file). The lock
    `root/.mistyle.lock` names process, host and time; it is released by `close`, at the end of a `with` block, and
    when the object or the process goes. A lock whose process is gone is taken over.
    """

    def __init__(self, root: Path, say: Callable[[str], None] = lambda text: None, *, shared: bool = False) -> None:
        """Take the lock (UsageError when another run holds it) and clear away what killed runs left.

        `say` gets a sentence about every folder that is set aside. In a `shared` folder others write single files
        without the lock: only what dead processes of this computer left is cleared.
        """
        self.root, self._say = Path(os.path.abspath(root)), say
        with faults.told(self.root):
            self.root.mkdir(parents=True, exist_ok=True)
            self._owner = lock.take(self.root / LOCK)
        self._release = weakref.finalize(self, lock.release, self.root / LOCK, self._owner)
        clean_leftovers(self.root, everyones=not shared)

    def __enter__(self) -> "Keeper":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Release the lock; may be called twice."""
        self._release()

    def get(self, stage: str, key: str, editable: Callable[[str], bool] = lambda name: False) -> Path | None:
        """The folder of a stage finished under this key with every file as it was written, else None.

        A folder of another key stays where it is; a damaged one is renamed to `<stage>.broken-N`, never deleted.
        Files that the stage did not write are ignored, and `editable` ones may have changed (run/edits.py).
        """
        folder = self.root / _checked(stage)
        self._check_lock()
        if not folder.exists():
            return None
        done = _done(folder)
        if done is not None and done[0] != key:
            return None
        if done is not None and intact(folder, editable) is not None:
            return folder
        self._set_aside(folder)
        return None

    def put(self, stage: str, key: str, write: Callable[[Path], None], edited: Mapping[str, str] | None = None) -> Path:
        """Run `write(folder)` on a new empty folder and keep it as the stage's result under `key`.

        An older result of the stage is replaced only once the new one is complete; when `write` raises, or the disk
        is full (MistyleError), the older one stays and nothing else does. What a user did there is not lost: an older
        result with changed files is set aside like a broken one, and files that the stage had not written come along.
        `edited` (name to sha256) are changed files that `write` has taken up: the marker remembers them.
        """
        target = self.root / _checked(stage)
        self._check_lock()

        def fill(folder: Path) -> None:
            write(folder)
            self._check_lock()
            seal(folder, stage=stage, key=key, **({"edited": dict(edited)} if edited else {}))
            if target.exists():
                written = intact(target, lambda name: name in (edited or {}))
                if written is None:
                    self._set_aside(target)
                else:
                    carry_over(target, folder, without=written)

        atomic_folder(target, fill)
        return target

    def _set_aside(self, folder: Path) -> None:
        number = next(n for n in itertools.count(1) if not (self.root / f"{folder.name}.broken-{n}").exists())
        aside = self.root / f"{folder.name}.broken-{number}"
        os.rename(folder, aside)
        self._say(f"{folder}: not as it was finished (a file is missing or has changed); set aside as {aside.name}")

    def _check_lock(self) -> None:
        """Raises MistyleError where the folder was removed, or removed and taken by another run."""
        if not lock.held(self.root / LOCK, self._owner):
            raise MistyleError(
                f"{self.root}: this folder, or the lock in it, was removed while a run worked there; it stops, so that "
                "it cannot mix with another run. Run the same command again"
            )


def carry_over(old: Path, new: Path, *, without: set[str]) -> None:
    """Bring the files of folder `old` that are not in `without` (paths inside it) and not in `new` to `new`."""
    for path in _files(old):
        name = path.relative_to(old)
        if name.as_posix() not in without and not (new / name).exists():
            (new / name).parent.mkdir(parents=True, exist_ok=True)
            try:
                os.link(path, new / name)  # the old folder goes; its files need not be copied for that
            except OSError:
                shutil.copy2(path, new / name)


def _done(folder: Path) -> tuple[str, dict[str, str]] | None:
    """Key and hashes of a finished stage's marker; None when there is no readable one."""
    try:
        done = read_own(folder / DONE)
        return str(done["key"]), {str(k): str(v) for k, v in done["files"].items()}
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return None


def _checked(stage: str) -> str:
    if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9_-]*", stage):
        raise ValueError(f"'{stage}' is no name for a stage; use letters, digits, '-' and '_'")
    return stage


def _hidden(path: Path, count: int, kind: str, suffix: str = "") -> Path:
    return path.with_name(f".{path.name}.{kind}-{lock.this_host()}-{os.getpid()}-{count}{suffix}")


def _files(folder: Path) -> list[Path]:
    return sorted(p for p in folder.rglob("*") if p.is_file())


def _flush(path: Path) -> None:
    with open(path, "rb+") as file:
        os.fsync(file.fileno())


def _flush_folder(folder: Path) -> None:
    if os.name != "posix":
        return
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
