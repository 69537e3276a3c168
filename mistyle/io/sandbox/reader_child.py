"""Reader process: decodes untrusted files; serves requests from stdin on stdout until stdin ends.

io/sandbox/reader_process.py runs it as `python -m mistyle.io.sandbox.reader_child`. It may not write files
(RLIMIT_FSIZE 0). An audit hook refuses to open for writing, to remove, to start programs and to make sockets. Every
request gets new limits on address space and processor time. The process leaves no core file. Without a
`resource` module (Windows) only the audit hook applies. The parent handles interrupts and stop requests.
"""

import os
import select
import signal
import sys
from importlib import import_module
from typing import Any

import numpy as np

from mistyle.core.errors import MistyleError
from mistyle.io.sandbox import asset_folders, bounds, rpc_codec, shared_copy
from mistyle.process.cores import cores
from mistyle.process.memory import trim

try:
    import resource
except ImportError:  # Windows
    resource = None

FORBIDDEN = (
    *("os.remove", "os.rename", "os.mkdir", "os.rmdir", "os.link", "os.symlink", "os.truncate", "os.chmod", "os.chown"),
    *("os.system", "os.exec", "os.posix_spawn", "os.spawn", "os.fork", "os.forkpty", "subprocess.Popen"),
    *("socket.__new__", "socket.connect", "socket.bind", "os.putenv", "os.kill", "signal.pthread_kill"),
)
MAX_THREADS = 4
IDLE = 1.0  # seconds after which no further file is expected soon
WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND


def main() -> None:
    """Serve requests until the input ends."""
    requests, answers = os.fdopen(os.dup(0), "rb", buffering=0), os.dup(1)
    devnull = os.open(os.devnull, os.O_RDWR)
    os.dup2(devnull, 0)
    os.dup2(devnull, 1)  # output of libraries must not mix with the answers
    for number in (signal.SIGINT, signal.SIGTERM):  # may go to the whole group; this process ends when its input ends
        signal.signal(number, signal.SIG_IGN)
    import OpenEXR

    from mistyle.io.sandbox.reader_tasks import TASKS

    # Several threads compensate for the transfer of the pixels to the job's process.
    OpenEXR.set_global_thread_count(min(cores(), MAX_THREADS))
    bounds.READ_THREADS = min(cores(), MAX_THREADS)
    base = _confine()
    sign = np.frombuffer(shared_copy.SIGN, np.uint8)  # the parent tests here whether it can read this process's memory
    rpc_codec.send(lambda data: os.write(answers, data), None, sign=sign.ctypes.data)
    os.dup2(devnull, 2)
    while True:
        if resource is not None and not select.select([requests], [], [], IDLE)[0]:
            trim()
        try:
            arguments, request = rpc_codec.receive(requests.readinto)
        except rpc_codec.BrokenMessage:
            return
        _limit(base + request["memory"], request["seconds"])
        value, entries, ending = _answer(TASKS[request["task"]], arguments, request)
        try:
            lent = rpc_codec.send(
                lambda data: os.write(answers, data), value, request["may_lend"], peak=_peak(), **entries
            )
        except MemoryError:
            rpc_codec.send(lambda data: os.write(answers, data), None, memory=True)
            return
        except BrokenPipeError:
            return
        if ending or lent and not requests.read(1):  # lent arrays stay until the parent confirms the copy
            return
        del value, lent


def _answer(task: Any, arguments: tuple[Any, ...], request: dict[str, Any]) -> tuple[Any, dict[str, Any], bool]:
    """The value, entries of the answer's header, and whether this process must end."""
    try:
        for module, values in request["limits"].items():
            for name, limit in values.items():
                setattr(import_module(f"mistyle.io.{module}"), name, limit)
        asset_folders.requested = request["assets"]
        os.chdir(request["cwd"])
        return task(*arguments), {}, False
    except MistyleError as error:
        # A decoder may wrap a failed allocation: memory is then fragmented or short.
        return None, {"refused": str(error), "kind": type(error).__name__}, _out_of_memory(error)
    except MemoryError:
        return None, {"memory": True}, True
    except Exception as error:  # a reader's defect must not reach the user as a traceback; tests check for this answer
        first = (str(error).splitlines() or [""])[0][:120]
        return None, {"stumbled": f"{type(error).__name__}: {first}"}, False


def _out_of_memory(error: BaseException | None) -> bool:
    while error is not None:
        if isinstance(error, MemoryError):
            return True
        error = error.__cause__ or error.__context__
    return False


def _confine() -> int:
    """Forbid writing permanently; returns the address space in use, in bytes."""
    sys.addaudithook(_audit)
    if resource is None:
        return 0
    resource.setrlimit(resource.RLIMIT_FSIZE, (0, 0))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    try:
        with open("/proc/self/statm") as table:
            return int(table.read().split()[0]) * resource.getpagesize()
    except (OSError, ValueError):
        return 0


def _audit(event: str, arguments: tuple[Any, ...]) -> None:
    if event == "open":
        _, mode, flags = arguments
        if isinstance(flags, int) and flags & WRITING or isinstance(mode, str) and set(mode) & set("wax+"):
            raise PermissionError("the reader does not write")
    elif event in FORBIDDEN:
        raise PermissionError(f"the reader does not do {event}")


def _limit(memory: int, seconds: float) -> None:
    if resource is None:
        return
    _, most = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (memory if most == resource.RLIM_INFINITY else min(memory, most), most))
    used = resource.getrusage(resource.RUSAGE_SELF)
    _, most = resource.getrlimit(resource.RLIMIT_CPU)
    allowed = int(used.ru_utime + used.ru_stime + seconds) + 1
    resource.setrlimit(resource.RLIMIT_CPU, (allowed if most == resource.RLIM_INFINITY else min(allowed, most), most))


def _peak() -> int:
    """The peak memory so far, in bytes; 0 where unknown."""
    if resource is None:
        return 0
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)


if __name__ == "__main__":
    main()
