"""The job's side of the border: one child process that opens and decodes what strangers wrote.

The child (io/sandbox/reader_child.py) is started once per process, when the first file is read or `start` is called,
and serves one request after another, from whatever thread. What it decodes comes back as numbers
(io/sandbox/rpc_codec.py). A file on which it crashes, hangs or runs out of memory is refused with a sentence; the next
file gets a new child. A forked copy of this process starts a child of its own, and the child ends when its parent does,
however that ends.

Limits per file, in the child: address space MEMORY and 64 bytes for every byte of the file, processor time SECONDS and
SECONDS_PER_MIB, no file may be written; from here: wall-clock time PATIENCE times as long as the processor time. Where
the system has no `resource` module (Windows) only the wall-clock limit holds, and macOS does not enforce the limit on
memory.
"""

import atexit
import os
import signal
import subprocess
import sys
import threading
from contextlib import suppress
from pathlib import Path
from typing import Any

from mistyle.core import errors
from mistyle.core.errors import EnvironmentMissing, InputRefused
from mistyle.core.paths import PACKAGE
from mistyle.io.sandbox import rpc_codec, shared_copy
from mistyle.io.sandbox.bounds import MAX_FILE_BYTES, refuse

MEMORY = 2 << 30
MEMORY_PER_BYTE = 64
SECONDS = 120.0
SECONDS_PER_MIB = 4.0
PATIENCE = 4.0
AGAIN = "Write it again, best with another program"
WHOLE = "a file that can be decoded"
# Modules of mistyle/io whose bounds (MAX_..., WORK_...) hold in the child as they stand here.
BOUNDED = (
    "sandbox.bounds",
    "images.read",
    "images.hdr",
    "meshes.mtl_read",
    "meshes.polygons",
    "gltf.schema",
    "gltf.check",
    "cameras.colmap",
    "cameras.camera_files",
)
PIPE_BYTES = 1 << 20
KEPT = 256 << 20  # bytes that the child may hold for the next file
F_SETPIPE_SZ = 1031  # fcntl.h of Linux; Python has the name only since 3.10 and only there

_lock = threading.Lock()
_reader: "Reader | None" = None


class OutOfMemory(Exception):
    """The child asked for more address space than it may have."""


class Reader:
    """A running child (state: it outlives the calls). `peak` is the most memory it has held, in bytes."""

    def __init__(self) -> None:
        paths = os.pathsep.join(p for p in (str(PACKAGE.parent), os.environ.get("PYTHONPATH", "")) if p)
        # One thread each and few heaps: all of them reserve address space, which is limited.
        alone = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1", "MALLOC_ARENA_MAX": "2"}
        # glibc: blocks that one file gave back serve the next, which else waits for the system to clear new pages. What
        # is free goes back when no file follows (reader_child.py).
        alone |= {"MALLOC_MMAP_THRESHOLD_": str(KEPT // 4), "MALLOC_TRIM_THRESHOLD_": str(KEPT)}
        try:
            self.process = subprocess.Popen(
                [sys.executable, "-B", "-m", "mistyle.io.sandbox.reader_child"],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                bufsize=0,
                env={**os.environ, "PYTHONPATH": paths, **alone},
            )
        except OSError as error:
            raise EnvironmentMissing(
                f"the process that reads files could not be started ({error}); check {sys.executable} and the limits "
                "on processes and memory"
            ) from error
        assert self.process.stdin and self.process.stdout and self.process.stderr
        self.input, self.output, self.stderr = self.process.stdin, self.process.stdout, self.process.stderr
        self.ready = self.lends = self.borrowed = False
        self.peak = self.served = 0
        _widen(self.output.fileno())

    def wait_ready(self) -> None:
        """Until the child has loaded its decoders. Raises EnvironmentMissing with its last words where it cannot."""
        if self.ready:
            return
        try:
            _, head = rpc_codec.receive(self.output.readinto)  # type: ignore[attr-defined]
        except rpc_codec.BrokenMessage as error:
            said = self.stderr.read().decode("utf-8", "replace").strip().splitlines()[-1:] or ["no message"]
            self.close()
            raise EnvironmentMissing(
                f"the process that reads files did not start ({said[0][:300]}); run `python -m mistyle doctor`"
            ) from error
        self.lends = shared_copy.can_read(self.process.pid, int(head.get("sign", 0)))
        self.ready = True

    def ask(self, path: Path, task: str, arguments: tuple[Any, ...], size: int) -> Any:
        """What the task gives for the file; see the function `ask`. After OutOfMemory, and after any other end than an
        answer, the child is gone."""
        memory, seconds = MEMORY + MEMORY_PER_BYTE * size, SECONDS + SECONDS_PER_MIB * size / 2**20
        late, self.borrowed = threading.Event(), False

        def stop() -> None:
            late.set()
            self.process.kill()

        timer = threading.Timer(PATIENCE * seconds, stop)
        timer.daemon = True
        timer.start()
        try:
            request = {"task": task, "cwd": os.getcwd(), "limits": _bounds(), "memory": memory, "seconds": seconds}
            request["may_lend"] = self.lends
            rpc_codec.send(self.input.write, (path, *arguments), **request)  # type: ignore[arg-type]
            value, head = rpc_codec.receive(self.output.readinto, self._copy)  # type: ignore[attr-defined]
            if self.borrowed:
                self.input.write(b"\0")
        except (rpc_codec.BrokenMessage, OSError) as error:
            raise refuse(path, self._end(late.is_set(), PATIENCE * seconds, seconds), WHOLE, AGAIN) from error
        except BaseException:  # an interrupt amid an answer: the rest of it must not be taken for the next one
            self.close(kill=True)
            raise
        finally:
            timer.cancel()
        self.peak = max(self.peak, int(head.get("peak", 0)))
        self.served += 1
        if "memory" in head:
            self.close(kill=True)
            raise OutOfMemory
        if "stumbled" in head:
            raise refuse(path, f"a file that the reader cannot make sense of ({head['stumbled']})", WHOLE, AGAIN)
        if "refused" in head:
            kind = getattr(errors, str(head.get("kind")), InputRefused)
            raise kind(str(head["refused"])) if issubclass(kind, errors.MistyleError) else InputRefused(value)
        return value

    def _copy(self, address: int, place: memoryview) -> None:
        self.borrowed = True
        shared_copy.copy_from(self.process.pid, address, place)

    def _end(self, late: bool, patience: float, seconds: float) -> str:
        """What became of the child that sent no answer."""
        self.close(kill=late)
        code = self.process.returncode
        if late:
            return f"a file that was not decoded within {patience:.0f} s"
        if code == -getattr(signal, "SIGXCPU", 0) and code:
            return f"a file that was not decoded within {seconds:.0f} s of processor time"
        if code is not None and code < 0:
            with suppress(ValueError):
                return f"a file on which its decoder crashed ({signal.Signals(-code).name})"
        return f"a file on which its decoder ended (code {code})"

    def close(self, kill: bool = False) -> None:
        """End the child and wait for it; no zombie stays."""
        if kill:
            self.process.kill()
        for pipe in (self.input, self.output, self.stderr):
            with suppress(OSError):
                pipe.close()
        try:
            self.process.wait(timeout=5)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()


def ask(task: str, path: Path, *arguments: Any) -> Any:
    """What `task` (io/sandbox/reader_tasks.py) makes of the file at `path`, decoded in the child.

    Raises what the task raises (InputRefused and its kin, with their sentences), InputRefused where the child crashed,
    hung or ran out of memory over the file, EnvironmentMissing where no child can be started.
    """
    size = _size(path)
    with _lock:
        # A child that has served before may hold memory in pieces: then a new one is asked once more.
        for fresh in (_running().served == 0, True):
            try:
                return _running().ask(path, task, arguments, size)
            except OutOfMemory:
                if fresh:
                    break
        memory = MEMORY + MEMORY_PER_BYTE * size
        raise refuse(path, f"a file whose decoding takes more than {memory / 2**30:.1f} GiB", WHOLE, AGAIN)


def start() -> None:
    """Start the child now, without waiting for it, so that it is ready when the first file is read."""
    with _lock:
        _current()


def peak_bytes() -> int:
    """The most memory that the present child has held; 0 where there is none, or nothing tells."""
    return _reader.peak if _reader is not None else 0


def stop() -> None:
    """End the child; the next file starts another."""
    global _reader
    with _lock:
        if _reader is not None:
            _reader.close()
        _reader = None


def _at_exit() -> None:
    """A daemon thread may be amid a request for good: then its child is killed, and not waited for the lock."""
    if _lock.acquire(timeout=1.0):
        _lock.release()
        stop()
    elif _reader is not None:
        _reader.process.kill()
        _reader.process.wait()


def _current() -> Reader:
    global _reader
    if _reader is None or _reader.process.poll() is not None:
        if _reader is not None:
            _reader.close()
        _reader = Reader()
    return _reader


def _running() -> Reader:
    reader = _current()
    reader.wait_ready()
    return reader


def _bounds() -> dict[str, dict[str, int]]:
    """The bounds as they stand in this process, so that the child keeps the same."""
    found = {}
    for name in BOUNDED:
        module = sys.modules.get(f"mistyle.io.{name}")
        if module is not None:
            found[name] = {k: v for k, v in vars(module).items() if k.startswith(("MAX_", "WORK_"))}
    return found


def _size(path: Path) -> int:
    """Bytes of a file, or of all files in a folder; a mesh's text may lean on other files in its folder."""
    several = path.is_dir() or path.suffix.lower() in (".gltf", ".obj")
    folder = path if path.is_dir() else path.parent
    try:
        if several:
            return min(sum(entry.stat().st_size for entry in os.scandir(folder) if entry.is_file()), MAX_FILE_BYTES)
        return min(path.stat().st_size, MAX_FILE_BYTES)
    except OSError:
        return 0  # the task itself says what is wrong with the file


def _widen(handle: int) -> None:
    """A larger pipe: arrays go through it in fewer turns. Refused beyond the user's share, which costs only speed."""
    if sys.platform == "linux":
        import fcntl

        with suppress(OSError):
            fcntl.fcntl(handle, F_SETPIPE_SZ, PIPE_BYTES)


def _forget() -> None:
    """In a forked copy: the child belongs to the parent; its pipes are closed here so that they can end there."""
    global _lock, _reader
    _lock = threading.Lock()
    if _reader is not None:
        for pipe in (_reader.input, _reader.output, _reader.stderr):
            with suppress(OSError):
                pipe.close()
        _reader.process.returncode = 0
        _reader = None


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_forget)
atexit.register(_at_exit)
