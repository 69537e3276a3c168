"""Client of the reader process: one child process opens and decodes untrusted files.

The child (io/sandbox/reader_child.py) is started once per process, at the first file or by `start`. It serves one
request after another, from any thread. It returns decoded values (io/sandbox/rpc_codec.py). A file on
which it crashes, hangs or runs out of memory is refused with a sentence; the next file gets a new child. A forked copy
of this process starts its own child. The child ends with its parent, however that ends.

Limits per file, in the child: address space MEMORY and 64 bytes for every byte of the file, processor time SECONDS and
SECONDS_PER_MIB, no file may be written. The client limits the wall-clock time to PATIENCE times the processor time.
Without a `resource` module (Windows) only the wall-clock limit applies, and macOS does not enforce the limit on memory.
"""

import atexit
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from mistyle.core import errors
from mistyle.core.errors import EnvironmentMissing, InputRefused
from mistyle.core.paths import PACKAGE
from mistyle.io.sandbox import rpc_codec, shared_copy
from mistyle.io.sandbox.asset_folders import ASSETS
from mistyle.io.sandbox.bounds import MAX_FILE_BYTES, refuse

MEMORY = 2 << 30
MEMORY_PER_BYTE = 64
SECONDS = 120.0
SECONDS_PER_MIB = 4.0
PATIENCE = 4.0
AGAIN = "Write it again, best with another program"
WHOLE = "a file that can be decoded"
# Modules of mistyle/io whose bounds (MAX_..., WORK_...) the child copies from this process.
BOUNDED = (
    "sandbox.bounds",
    "images.read",
    "images.hdr",
    "meshes.mtl_read",
    "meshes.polygons",
    "gltf.schema",
    "gltf.check",
    "cameras.colmap",
    "cameras.metashape",
    "cameras.realityscan",
    "cameras.camera_files",
)
PIPE_BYTES = 1 << 20
KEPT = 256 << 20  # bytes of free heap that the child may retain for the next file
F_SETPIPE_SZ = 1031  # fcntl.h of Linux; Python has the name only since 3.10 and only there

_lock = threading.Lock()
_reader: "Reader | None" = None


class OutOfMemory(Exception):
    """The child exceeded its limit on address space."""


class Reader:
    """A running child (state across calls). `peak` is its peak memory in bytes."""

    def __init__(self) -> None:
        paths = os.pathsep.join(p for p in (str(PACKAGE.parent), os.environ.get("PYTHONPATH", "")) if p)
        # One thread per library and few heaps: each reserves address space, which is limited.
        limits_env = {
            "OPENBLAS_NUM_THREADS": "1",
            "OMP_NUM_THREADS": "1",
            "MKL_NUM_THREADS": "1",
            "MALLOC_ARENA_MAX": "2",
        }
        # glibc: freed blocks are reused for the next file, which else waits for the system to clear new pages. They are
        # returned when no file follows (reader_child.py).
        limits_env |= {"MALLOC_MMAP_THRESHOLD_": str(KEPT // 4), "MALLOC_TRIM_THRESHOLD_": str(KEPT)}
        try:
            self.process = subprocess.Popen(
                [sys.executable, "-B", "-m", "mistyle.io.sandbox.reader_child"],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                bufsize=0,
                env={**os.environ, "PYTHONPATH": paths, **limits_env},
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
        """Wait until the child has loaded its decoders. Raises EnvironmentMissing with its last message on failure."""
        if self.ready:
            return
        try:
            _, head = rpc_codec.receive(self.output.readinto)  # type: ignore[attr-defined]
        except rpc_codec.BrokenMessage as error:
            message = self.stderr.read().decode("utf-8", "replace").strip().splitlines()[-1:] or ["no message"]
            self.close()
            raise EnvironmentMissing(
                f"the process that reads files did not start ({message[0][:300]}); run `python -m mistyle doctor`"
            ) from error
        self.lends = shared_copy.can_read(self.process.pid, int(head.get("sign", 0)))
        self.ready = True

    def ask(self, path: Path, task: str, arguments: tuple[Any, ...], size: int) -> Any:
        """The task's result for the file; see the function `ask`. After OutOfMemory, and after any failure without an
        answer, the child has ended."""
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
            request |= {"may_lend": self.lends, "assets": os.environ.get(ASSETS, "")}
            rpc_codec.send(self.input.write, (path, *arguments), **request)  # type: ignore[arg-type]
            value, head = rpc_codec.receive(self.output.readinto, self._copy)  # type: ignore[attr-defined]
            if self.borrowed:
                self.input.write(b"\0")
        except (rpc_codec.BrokenMessage, OSError) as error:
            raise refuse(path, self._end(late.is_set(), PATIENCE * seconds, seconds), WHOLE, AGAIN) from error
        except BaseException:  # an interrupt within an answer: the rest of it must not be read as the next one
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
        """The reason why the child sent no answer."""
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


def ask(task: str, path: Path, *arguments: Any, more: Callable[[], Sequence[Path]] = tuple) -> Any:
    """The result of `task` (io/sandbox/reader_tasks.py) for the file at `path`, decoded in the child.

    Raises the task's own errors (InputRefused and related, with their messages). InputRefused where the child crashed,
    hung or ran out of memory over the file; EnvironmentMissing where no child can be started. `more` lists the files
    that it names: if memory runs out, one more try has the limits for them all.
    """
    size = _size(path)
    for last in (False, True):
        try:
            return _limited(task, path, arguments, size)
        except OutOfMemory:
            largest = size if last else min(size + sum(map(_size, more())), MAX_FILE_BYTES)
        if largest == size:
            break
        size = largest
    memory = MEMORY + MEMORY_PER_BYTE * size
    raise refuse(path, f"a file whose decoding takes more than {memory / 2**30:.1f} GiB", WHOLE, AGAIN)


def _limited(task: str, path: Path, arguments: tuple[Any, ...], size: int) -> Any:
    """The task's result with the limits of `size` bytes. Raises OutOfMemory."""
    with _lock:
        # A child that has served before may have fragmented memory: the request is repeated in a new one.
        if _running().served:
            with suppress(OutOfMemory):
                return _running().ask(path, task, arguments, size)
        return _running().ask(path, task, arguments, size)


def start() -> None:
    """Start the child now, without waiting for it, so that it is ready when the first file is read."""
    with _lock:
        _current()


def peak_bytes() -> int:
    """The peak memory of the current child in bytes; 0 without a child or where unknown."""
    return _reader.peak if _reader is not None else 0


def stop() -> None:
    """End the child; the next file starts another."""
    global _reader
    with _lock:
        if _reader is not None:
            _reader.close()
        _reader = None


def _at_exit() -> None:
    """Stop the child. If a daemon thread holds the lock in a pending request, kill the child without the lock."""
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
    """The bounds of this process, for the child."""
    bounds = {}
    for name in BOUNDED:
        module = sys.modules.get(f"mistyle.io.{name}")
        if module is not None:
            bounds[name] = {k: v for k, v in vars(module).items() if k.startswith(("MAX_", "WORK_"))}
    return bounds


def _size(path: Path) -> int:
    """Bytes of a file, or of all files in a folder; text formats of meshes may refer to other files in their folder."""
    several = path.is_dir() or path.suffix.lower() in (".gltf", ".obj")
    folder = path if path.is_dir() else path.parent
    try:
        if several:
            return min(sum(entry.stat().st_size for entry in os.scandir(folder) if entry.is_file()), MAX_FILE_BYTES)
        return min(path.stat().st_size, MAX_FILE_BYTES)
    except OSError:
        return 0  # the task itself refuses the file with a reason


def _widen(handle: int) -> None:
    """Enlarge the pipe, so that arrays need fewer writes. A refusal beyond the user's quota costs only speed."""
    if sys.platform == "linux":
        import fcntl

        with suppress(OSError):
            fcntl.fcntl(handle, F_SETPIPE_SZ, PIPE_BYTES)


def _forget() -> None:
    """In a forked copy the child belongs to the parent: close its pipes here, so that the parent's close takes
    effect."""
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
