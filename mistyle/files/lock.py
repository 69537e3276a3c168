"""A lock file that names its holder: one process at a time in a folder, and a dead holder's lock is taken over."""

import json
import os
import socket
import time
from pathlib import Path

from mistyle.core.errors import UsageError


def take(lock: Path) -> str:
    """Make the lock file and return its content (pid, host, when the process began, time), which `release` wants.

    Raises UsageError when a living process of this host holds it, or any process of another host, which cannot be
    asked from here; the message says how to go on.
    """
    pid = os.getpid()
    owner = json.dumps({"pid": pid, "host": this_host(), "started": started_at(pid), "time": time.time()})
    for _ in range(5):
        try:
            with open(lock, "x", encoding="utf-8") as file:
                file.write(owner)
            return owner
        except FileExistsError:
            _remove_dead_lock(lock)
    raise UsageError(f"{lock}: another run keeps taking this folder; wait for it, or choose another output folder")


def _remove_dead_lock(lock: Path) -> None:
    """Remove a lock whose process is gone; raises UsageError when it lives or cannot be asked."""
    try:
        text, age = lock.read_text(encoding="utf-8"), time.time() - lock.stat().st_mtime
    except FileNotFoundError:
        return
    try:
        owner = json.loads(text)
        pid, host, started, since = int(owner["pid"]), str(owner["host"]), owner["started"], float(owner["time"])
    except (ValueError, KeyError, TypeError):
        # A lock without a readable owner is one being written just now, or one cut off by a crash.
        if age < 5:
            time.sleep(0.2)
            return
        pid, host, started, since = -1, this_host(), None, 0.0
    when = time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(since))
    if host != this_host():
        raise UsageError(
            f"{lock.parent}: a run on the computer '{host}' (process {pid}) has held this folder since {when}; "
            f"wait for it, or, if it no longer runs, remove {lock}"
        )
    if pid > 0 and alive(pid) and started == started_at(pid):
        raise UsageError(
            f"{lock.parent}: process {pid} has been working in this folder since {when}; "
            "wait for it, stop it, or choose another output folder"
        )
    aside = lock.with_name(f".{lock.name}.tmp-{this_host()}-{os.getpid()}-0")
    try:
        os.rename(lock, aside)
    except FileNotFoundError:
        return
    if aside.read_text(encoding="utf-8") != text:
        # Another run took the dead lock over between our look and our rename: what we hold is its living one.
        os.rename(aside, lock)
        return
    aside.unlink()


def release(lock: Path, owner: str) -> None:
    """Remove the lock file if it is still the one that `take` made in this process."""
    # A forked child inherits the finalizer, not the lock.
    if json.loads(owner)["pid"] != os.getpid():
        return
    try:
        if lock.read_text(encoding="utf-8") == owner:
            lock.unlink()
    except OSError:
        return


def alive(pid: int) -> bool:
    """Whether a process of this number runs on this computer."""
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
    return True


def started_at(pid: int) -> str | None:
    """When the process began (boot and ticks), where the system tells: a number used again is another process."""
    try:
        boot = Path("/proc/sys/kernel/random/boot_id").read_text().strip()
        # The command's name stands in parentheses and may hold spaces; the start time is the 20th field after it.
        return f"{boot} {Path(f'/proc/{pid}/stat').read_text().rpartition(')')[2].split()[19]}"
    except (OSError, IndexError):
        return None


def this_host() -> str:
    """This computer's name on the network."""
    return socket.gethostname() or "localhost"
