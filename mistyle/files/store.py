"""Files that are whole or not there: atomic writes, content hashes, and the keeper of finished stages.

Everything is written under a hidden temporary name beside its place (`.<name>.tmp-<host>-<pid>-<n>`), flushed to the
disk and then renamed. A run that is killed at any moment leaves only such names behind; the next run removes them.
"""

import dataclasses
import enum
import errno
import hashlib
import itertools
import json
import os
import re
import shutil
import weakref
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from pydantic import BaseModel

from mistyle.core.errors import MistyleError
from mistyle.files import lock

DONE = "done.json"
LOCK = ".mistyle.lock"
_COUNTER = itertools.count()
_LEFTOVER = re.compile(r"\.(?P<name>.+)\.(?P<kind>tmp|old)-(?P<host>.+)-(?P<pid>\d+)-\d+(\.\w+)?")
_NO_ROOM = (errno.ENOSPC, errno.EDQUOT)


def atomic_write(path: Path, data: bytes | Callable[[Path], None]) -> None:
    """Write a file so that it is seen either whole or not at all.

    `data` is the content, or a function that writes it to the temporary path it is given (same folder, same suffix).
    A full disk raises MistyleError and leaves neither the file nor a temporary one; any other error passes through.
    """
    temporary = _hidden(path, "tmp", path.suffix)
    with _sentence_when_full(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            if callable(data):
                data(temporary)
            else:
                temporary.write_bytes(data)
            _flush(temporary)
            os.replace(temporary, path)
        finally:
            temporary.unlink(missing_ok=True)
    _flush_folder(path.parent)


def atomic_folder(target: Path, write: Callable[[Path], None]) -> None:
    """Fill a new folder by `write(folder)` and put it at `target`, in the place of an older one, when it is complete.

    The older folder stays until then. Between the two renames of the swap `target` is absent for an instant; a run
    killed just there is mended by the next call (or the next Keeper) for the same place.
    """
    target = Path(os.path.realpath(target))  # a link to a folder elsewhere stays a link
    temporary, old = _hidden(target, "tmp"), _hidden(target, "old")
    with _sentence_when_full(target):
        target.parent.mkdir(parents=True, exist_ok=True)
        clean_leftovers(target.parent, name=target.name)
        try:
            temporary.mkdir()
            write(temporary)
            for path in _files(temporary):
                _flush(path)
            for folder in [*(p for p in sorted(temporary.rglob("*")) if p.is_dir()), temporary]:
                _flush_folder(folder)
            _swap(temporary, target, old)
        finally:
            shutil.rmtree(temporary, ignore_errors=True)
    _flush_folder(target.parent)


def _swap(temporary: Path, target: Path, old: Path) -> None:
    if target.exists():
        os.rename(target, old)
    try:
        os.rename(temporary, target)
    except OSError:
        if old.exists():
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
            run = match.group("name", "host", "pid")
            new = [p for m, p in found if m["kind"] == "tmp" and m.group("name", "host", "pid") == run]
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


def save_arrays(folder: Path, name: str, **arrays: np.ndarray) -> None:
    """Write arrays to `folder/name/<key>.npy` (no others stay there), without pickles: objects raise ValueError."""
    place = folder / name
    place.mkdir(parents=True, exist_ok=True)
    for path in place.glob("*.npy"):
        if path.stem not in arrays:
            path.unlink()
    for key, array in arrays.items():
        atomic_write(place / f"{key}.npy", lambda path, array=array: np.save(path, array, allow_pickle=False))


def load_arrays(folder: Path, name: str) -> dict[str, np.ndarray]:
    """Read back what `save_arrays` wrote: key to array, keys in alphabetical order."""
    place = folder / name
    if not place.is_dir():
        raise MistyleError(f"{place}: expected a folder of .npy files, found none; run the stage that writes it again")
    return {p.stem: np.load(p, allow_pickle=False) for p in sorted(place.glob("*.npy"))}


class Keeper:
    """Keeps the folders of finished stages of one run and lets one process at a time work there.

    `root/<stage>/` holds a stage's files and `done.json` (its key and the sha256 of every file). The lock
    `root/.mistyle.lock` names process, host and time; it is released by `close`, at the end of a `with` block, and
    when the object or the process goes. A lock whose process is gone is taken over.
    """

    def __init__(self, root: Path) -> None:
        """Take the lock (UsageError when another run holds it) and clear away what a killed run left."""
        self.root = Path(root)
        with _sentence_when_full(self.root):
            self.root.mkdir(parents=True, exist_ok=True)
            owner = lock.take(self.root / LOCK)
        self._release = weakref.finalize(self, lock.release, self.root / LOCK, owner)
        clean_leftovers(self.root, everyones=True)

    def __enter__(self) -> "Keeper":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Release the lock; may be called twice."""
        self._release()

    def get(self, stage: str, key: str) -> Path | None:
        """The folder of a stage finished under this key with every file as it was written, else None.

        A folder of another key stays where it is; a damaged one is renamed to `<stage>.broken-N`, never deleted.
        Files that the stage did not write are ignored.
        """
        folder = self.root / _checked(stage)
        if not folder.exists():
            return None
        done = _done(folder)
        if done is not None and done[0] != key:
            return None
        if done is not None and _written(folder) is not None:
            return folder
        self._set_aside(folder)
        return None

    def put(self, stage: str, key: str, write: Callable[[Path], None]) -> Path:
        """Run `write(folder)` on a new empty folder and keep it as the stage's result under `key`.

        An older result of the stage is replaced only once the new one is complete; when `write` raises, or the disk
        is full (MistyleError), the older one stays and nothing else does. What a user did there is not lost: an older
        result with changed files is set aside like a broken one, and files that the stage had not written come along.
        """
        target = self.root / _checked(stage)

        def fill(folder: Path) -> None:
            write(folder)
            hashes = {p.relative_to(folder).as_posix(): sha256_file(p) for p in _files(folder)}
            done = {"stage": stage, "key": key, "files": hashes}
            (folder / DONE).write_text(json.dumps(done, indent=1, sort_keys=True) + "\n", encoding="utf-8")
            if target.exists():
                written = _written(target)
                if written is None:
                    self._set_aside(target)
                else:
                    carry_over(target, folder, without=written)

        atomic_folder(target, fill)
        return target

    def _set_aside(self, folder: Path) -> None:
        number = next(n for n in itertools.count(1) if not (self.root / f"{folder.name}.broken-{n}").exists())
        os.rename(folder, self.root / f"{folder.name}.broken-{number}")


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
        done = json.loads((folder / DONE).read_text(encoding="utf-8"))
        return str(done["key"]), {str(k): str(v) for k, v in done["files"].items()}
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return None


def _written(folder: Path) -> set[str] | None:
    """The files that a finished stage wrote, marker included; None when one is missing or changed."""
    done = _done(folder)
    if done is None:
        return None
    whole = all((folder / name).is_file() and sha256_file(folder / name) == value for name, value in done[1].items())
    return {DONE, *done[1]} if whole else None


def _checked(stage: str) -> str:
    if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9_-]*", stage):
        raise ValueError(f"'{stage}' is no name for a stage; use letters, digits, '-' and '_'")
    return stage


def _hidden(path: Path, kind: str, suffix: str = "") -> Path:
    return path.with_name(f".{path.name}.{kind}-{lock.this_host()}-{os.getpid()}-{next(_COUNTER)}{suffix}")


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


@contextmanager
def _sentence_when_full(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        if error.errno not in _NO_ROOM:
            raise
        raise MistyleError(
            f"{path}: the disk is full ({error.strerror}); nothing half-written was left there. "
            "Free some space, or choose an output folder on another disk, and run the same command again"
        ) from error
