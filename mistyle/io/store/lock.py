"""A lock file that names its holder: one process at a time in a folder, and a dead holder's lock is taken over.

Where the system has flock, the holder keeps the file locked as long as it lives, however it ends: that decides for
every process on the same kernel, in another container too. Elsewhere the holder's number and start time decide.
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
    """Make the lock file and return its content (pid, host, when the process began, time), which `release` wants.

    Raises UsageError when a living process holds it, or a process of another computer, which cannot be asked from
    here; the message says how to go on.
    """
    with _one_at_a_time(lock.parent):
        for _ in range(5):
            _remove_dead_lock(lock)
            try:
                return _made(lock)
            except FileExistsError:
                time.sleep(0.2)
    raise UsageError(f"{lock}: another run keeps taking this folder; wait for it, or choose another output folder")


def _made(lock: Path) -> str:
    """Put a complete lock file in place, which fails where there is one: FileExistsError."""
    pid = os.getpid()
    part = lock.with_name(f".{lock.name}.tmp-{this_host()}-{pid}-{next(_COUNTER)}")
    handle = os.open(part, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o644)
    kept = False
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
            # No hard links here (FAT, some network shares): a lock of this kind is first empty for an instant.
            owner = json.dumps(values | {"flock": False})
            with open(lock, "x", encoding="utf-8") as file:
                file.write(owner)
            return owner
        if flocked:
            _HANDLES[str(lock)], kept = handle, True
        return owner
    finally:
        if not kept:
            os.close(handle)
        part.unlink(missing_ok=True)


def held(lock: Path, owner: str) -> bool:
    """Whether the lock file is still the one that `take` made."""
    try:
        return lock.read_text(encoding="utf-8") == owner
    except OSError:
        return False


def busy(lock: Path) -> bool:
    """Whether a living process holds the lock, as far as can be known from here."""
    try:
        found = _owner(lock)
    except (OSError, ValueError):
        return False
    return _lives(lock, found) is not False


def _remove_dead_lock(lock: Path) -> None:
    """Remove a lock whose process is gone; raises UsageError when it lives or cannot be asked."""
    try:
        text, age = lock.read_text(encoding="utf-8"), time.time() - lock.stat().st_mtime
        found = _owner(lock)
    except FileNotFoundError:
        return
    except ValueError:
        # A lock without a readable owner is one being written just now, or one cut off by a crash.
        if age < 5:
            time.sleep(0.2)
            return
        found = None
    lives = False if found is None else _lives(lock, found)
    if lives is not False and found is not None:
        when = time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(float(found["time"])))
        if lives is None:
            raise UsageError(
                f"{lock.parent}: a run on the computer '{found['host']}' (process {found['pid']}) has held this folder "
                f"since {when}; wait for it, or, if it no longer runs, remove {lock}"
            )
        raise UsageError(
            f"{lock.parent}: process {found['pid']} has been working in this folder since {when}; "
            "wait for it, stop it, or choose another output folder"
        )
    aside = lock.with_name(f".{lock.name}.tmp-{this_host()}-{os.getpid()}-{next(_COUNTER)}")
    try:
        os.rename(lock, aside)
    except FileNotFoundError:
        return
    if aside.read_text(encoding="utf-8") != text:
        # Another run took the dead lock over between our look and our rename: what we hold is its living one.
        os.rename(aside, lock)
        return
    aside.unlink()


def _owner(lock: Path) -> dict[str, Any]:
    """What the lock says of its holder. Raises ValueError where it says nothing that can be read."""
    found = read_own(lock)
    try:
        known = {k: kind(found[k]) for k, kind in (("pid", int), ("host", str), ("time", float))}
        return {"started": found["started"], "flock": found.get("flock") is True} | known
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
    """Remove the lock file if it is still the one that `take` made in this process."""
    # A forked child inherits the finalizer, not the lock.
    if json.loads(owner)["pid"] != os.getpid():
        return
    handle = _HANDLES.pop(str(lock), None)
    with contextlib.suppress(OSError):
        if held(lock, owner):
            lock.unlink()
    if handle is not None:
        # Unlocked by hand: a forked child may still hold the same open file.
        with contextlib.suppress(OSError):
            if fcntl is not None:
                fcntl.flock(handle, fcntl.LOCK_UN)
            os.close(handle)


def _flock(handle: int) -> bool:
    """Lock an open file without waiting; False where another holds it, or the file system knows no such locks."""
    if fcntl is None:
        return False
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return False
    return True


@contextlib.contextmanager
def _one_at_a_time(folder: Path) -> Iterator[None]:
    """Keeps those who look at a dead lock of this folder at the same time apart, where the system can."""
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
    """Whether a process of this number runs on this computer; one that has ended and was not yet collected does not."""
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
    """When the process began (boot and ticks), where the system tells: a number used again is another process."""
    boot, fields = _boot(), _fields(pid)
    return f"{boot} {fields[19]}" if boot and len(fields) > 19 else None


def _boot() -> str | None:
    """The name of this run of the kernel."""
    try:
        return Path("/proc/sys/kernel/random/boot_id").read_text().strip()
    except OSError:
        return None


def _fields(pid: int) -> list[str]:
    """/proc's fields of a process from its state on; nothing where there is no /proc."""
    try:
        # The command's name stands in parentheses and may hold spaces; the start time is the 20th field after it.
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return []


def this_host() -> str:
    """This computer's name on the network."""
    return socket.gethostname() or "localhost"
