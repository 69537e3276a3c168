"""Lock file of a folder: admits one process at a time; a dead holder's lock is taken over.

Where the system has flock, the holder locks the file until it ends, however it ends. The flock decides for every
process on the same kernel, in another container too. Elsewhere the holder's PID and start time decide.
"""

import contextlib
import itertools
import json
import os
import socket
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from mistyle.core.errors import UsageError
from mistyle.io.store.trusted_json import read_own

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None

_HANDLES: dict[str, int] = {}
_COUNTER = itertools.count()


def take(lock: Path) -> str:
    """Create the lock file and return its content (pid, host, start of the process, time), which `release` needs.

    Raises UsageError when a living process holds it, or a process of another computer, whose state is unknown here; the
    message names the fix.
    """
    with _one_at_a_time(lock.parent):
        for _ in range(5):
            _remove_dead_lock(lock)
            try:
                return _create(lock)
            except FileExistsError:
                time.sleep(0.2)
    raise UsageError(f"{lock}: another run keeps taking this folder; wait for it, or choose another output folder")


def _create(lock: Path) -> str:
    """Create a complete lock file atomically. FileExistsError where one exists."""
    pid = os.getpid()
    part = lock.with_name(f".{lock.name}.tmp-{this_host()}-{pid}-{next(_COUNTER)}")
    handle = os.open(part, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o644)
    retained = False
    try:
        flocked = _flock(handle)
        values = {"pid": pid, "host": this_host(), "started": started_at(pid), "time": time.time(), "flock": flocked}
        owner = json.dumps(values)
        os.write(handle, owner.encode())
        try:
            os.link(part, lock)
        except FileExistsError:
            raise
        except OSError:
            # Without hard links (FAT, some network shares) the lock file is empty for an instant.
            owner = json.dumps(values | {"flock": False})
            with open(lock, "x", encoding="utf-8") as file:
                file.write(owner)
            return owner
        if flocked:
            _HANDLES[str(lock)], retained = handle, True
        return owner
    finally:
        if not retained:
            os.close(handle)
        part.unlink(missing_ok=True)


def held(lock: Path, owner: str) -> bool:
    """Whether the lock file is still the one that `take` created."""
    try:
        return lock.read_text(encoding="utf-8") == owner
    except OSError:
        return False


def busy(lock: Path) -> bool:
    """Whether a living process holds the lock, or may hold it on another computer."""
    try:
        owner = _owner(lock)
    except (OSError, ValueError):
        return False
    return _lives(lock, owner) is not False


def _remove_dead_lock(lock: Path) -> None:
    """Remove a dead process's lock; raises UsageError when the process lives or its state is unknown."""
    try:
        text, age = lock.read_text(encoding="utf-8"), time.time() - lock.stat().st_mtime
        owner = _owner(lock)
    except FileNotFoundError:
        return
    except ValueError:
        # A lock without a readable owner is being written just now, or a crash truncated it.
        if age < 5:
            time.sleep(0.2)
            return
        owner = None
    lives = False if owner is None else _lives(lock, owner)
    if lives is not False and owner is not None:
        when = time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(float(owner["time"])))
        if lives is None:
            raise UsageError(
                f"{lock.parent}: a run on the computer '{owner['host']}' (process {owner['pid']}) has held this folder "
                f"since {when}; wait for it, or, if it no longer runs, remove {lock}"
            )
        raise UsageError(
            f"{lock.parent}: process {owner['pid']} has been working in this folder since {when}; "
            "wait for it, stop it, or choose another output folder"
        )
    aside = lock.with_name(f".{lock.name}.tmp-{this_host()}-{os.getpid()}-{next(_COUNTER)}")
    try:
        os.rename(lock, aside)
    except FileNotFoundError:
        return
    if aside.read_text(encoding="utf-8") != text:
        # Another run took the dead lock over between our read and our rename: we renamed its living lock.
        os.rename(aside, lock)
        return
    aside.unlink()


def _owner(lock: Path) -> dict[str, Any]:
    """The lock's entries about its holder. Raises ValueError where they are unreadable."""
    record = read_own(lock)
    try:
        known = {k: kind(record[k]) for k, kind in (("pid", int), ("host", str), ("time", float))}
        return {"started": record["started"], "flock": record.get("flock") is True} | known
    except (KeyError, TypeError, AttributeError) as error:
        raise ValueError(f"no owner: {error}") from error


def _lives(lock: Path, owner: Mapping[str, Any]) -> bool | None:
    """Whether the holder lives; None for one on another computer."""
    boot = _boot()
    if owner["flock"] and boot and str(owner["started"]).startswith(boot):
        with contextlib.suppress(OSError):
            handle = os.open(lock, os.O_RDWR)
            try:
                return not _flock(handle)
            finally:
                os.close(handle)
    if owner["host"] != this_host():
        return None
    return owner["pid"] > 0 and alive(owner["pid"]) and owner["started"] == started_at(owner["pid"])


def release(lock: Path, owner: str) -> None:
    """Remove the lock file if it is still the one that `take` created in this process."""
    # A forked child inherits the finalizer, not the lock.
    if json.loads(owner)["pid"] != os.getpid():
        return
    handle = _HANDLES.pop(str(lock), None)
    with contextlib.suppress(OSError):
        if held(lock, owner):
            lock.unlink()
    if handle is not None:
        # Unlocked explicitly: a forked child may still hold the same open file.
        with contextlib.suppress(OSError):
            if fcntl is not None:
                fcntl.flock(handle, fcntl.LOCK_UN)
            os.close(handle)


def _flock(handle: int) -> bool:
    """Lock an open file without waiting; False where another process holds it, or the file system has no such locks."""
    if fcntl is None:
        return False
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return False
    return True


@contextlib.contextmanager
def _one_at_a_time(folder: Path) -> Iterator[None]:
    """Serialise processes that examine a dead lock of this folder, where the system can."""
    if fcntl is None:
        yield
        return
    handle = os.open(folder, os.O_RDONLY)
    try:
        with contextlib.suppress(OSError):
            fcntl.flock(handle, fcntl.LOCK_EX)
        yield
    finally:
        os.close(handle)


def alive(pid: int) -> bool:
    """Whether a process with this PID runs on this computer; a zombie does not."""
    if os.name == "nt":
        import ctypes

        # os.kill(pid, 0) would end the process on Windows; 0x1000 is PROCESS_QUERY_LIMITED_INFORMATION.
        kernel = ctypes.windll.kernel32  # type: ignore[attr-defined]
        handle = kernel.OpenProcess(0x1000, False, pid)
        if handle:
            kernel.CloseHandle(handle)
        return bool(handle)
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    fields = _fields(pid)
    return not (fields and fields[0] in "ZX")


def started_at(pid: int) -> str | None:
    """Start of the process (boot and ticks), None where unknown. It distinguishes processes with a reused PID."""
    boot, fields = _boot(), _fields(pid)
    return f"{boot} {fields[19]}" if boot and len(fields) > 19 else None


def _boot() -> str | None:
    """The kernel's boot ID."""
    try:
        return Path("/proc/sys/kernel/random/boot_id").read_text().strip()
    except OSError:
        return None


def _fields(pid: int) -> list[str]:
    """/proc's fields of a process from its state on; empty without /proc."""
    try:
        # The command's name stands in parentheses and may hold spaces; the start time is the 20th field after it.
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return []


def this_host() -> str:
    """This computer's name on the network."""
    return socket.gethostname() or "localhost"
