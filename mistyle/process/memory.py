"""Memory of this process: current and peak use, a budget, and the C library's heap thresholds.

Within a budget (`within`) the large arrays of a job lie in files. `empty`, `copied`, `away` and `load` then return maps
of unlinked files. The kernel may evict their pages at any time, and a thread releases them as soon as the process
exceeds its limit. Results do not change.
"""

import contextlib
import ctypes
import dataclasses
import mmap
import os
import sys
import tempfile
import threading
import weakref
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from typing import Any, TypeVar

import numpy as np
from numpy.typing import DTypeLike

# Parameters of mallopt: the block size from which malloc uses mmap, and the free heap that it retains.
M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -1, -3
DEFAULT = 128 * 1024
MOST = 2**30


def trim() -> None:
    """Return free heap blocks to the system. Does nothing without glibc."""
    library = _glibc()
    if library is not None:
        library.malloc_trim(0)


def _glibc() -> Any:
    library = ctypes.CDLL(None) if sys.platform.startswith("linux") else None
    return library if all(hasattr(library, name) for name in ("mallopt", "malloc_trim")) else None


@contextmanager
def kept() -> Iterator[None]:
    """Retain freed heap blocks inside the context; return free memory to the system at its end.

    Otherwise the kernel allocates and clears all pages anew in every iteration of a loop over pictures of tens of
    megabytes. Does nothing without glibc.
    """
    library = _glibc()
    if library is None:
        yield
        return
    library.mallopt(M_MMAP_THRESHOLD, MOST)
    library.mallopt(M_TRIM_THRESHOLD, MOST)
    try:
        yield
    finally:
        library.mallopt(M_MMAP_THRESHOLD, DEFAULT)
        library.mallopt(M_TRIM_THRESHOLD, DEFAULT)
        library.malloc_trim(0)


def limit(proc: Path = Path("/proc"), groups: Path = Path("/sys/fs/cgroup")) -> int | None:
    """Bytes of main memory that this process can get: the machine's, or the limit of a control group (v1 or v2) or one
    of its parents; None where unknown. `proc` and `groups` are the mount points of procfs and cgroupfs."""
    limits = [_total(proc), *_group_limits(proc, groups)]
    return min((n for n in limits if n is not None), default=None)


def _total(proc: Path) -> int | None:
    """The machine's main memory in bytes; None where unknown."""
    try:
        lines = (proc / "meminfo").read_text(encoding="ascii", errors="replace").splitlines()
        return next(int(line.split()[1]) * 1024 for line in lines if line.startswith("MemTotal:"))
    except (OSError, ValueError, IndexError, StopIteration):
        pass
    try:  # not Linux
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, OSError, ValueError):
        return None


def _group_limits(proc: Path, groups: Path) -> Iterator[int]:
    """Memory limits (bytes) of this process's control groups, from its own up to the root.

    In a container the path may be the host's and not visible; the root is then the container's own group.
    """
    try:
        lines = (proc / "self/cgroup").read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        return
    for line in lines:
        _, kinds, path = (line.split(":", 2) + ["", ""])[:3]
        if kinds and "memory" not in kinds.split(","):
            continue
        roots = [groups / "memory"] if kinds else [groups, groups / "unified"]
        own = PurePosixPath(path.lstrip("/"))
        name = "memory.limit_in_bytes" if kinds else "memory.max"
        for folder in [root / group for root in roots for group in (own, *own.parents)]:
            try:
                yield int((folder / name).read_text(encoding="ascii", errors="replace"))
            except (OSError, ValueError):  # no such group here, or "max"
                continue


_seen = [0]  # bytes: the highest returned so far; the kernel's own peak is reset, and lacks some pages of each core


def resident() -> int:
    """Bytes of main memory that this process holds now; 0 where unknown (not Linux)."""
    return _status("VmRSS")


def highest() -> int:
    """The most bytes that this process, or the largest of its children that have ended, has held so far."""
    _seen[0] = max(_seen[0], _status("VmHWM"), *map(_of, ("RUSAGE_SELF", "RUSAGE_CHILDREN")))
    return _seen[0]


@contextmanager
def watched() -> Iterator[Callable[[], int]]:
    """Yields a function that returns the peak memory (bytes) of this process since the block began.

    Linux records the peak itself, so no peak is missed between two readings, and it can be reset. Where it cannot be
    reset (another system, a closed /proc), the result is the peak so far. A child that ends within the block and was
    larger than all before it counts as well. Blocks do not nest: the inner one resets the outer one's peak.
    """
    children = _of("RUSAGE_CHILDREN")
    highest()  # recorded now, since the reset clears it
    reset = _reset()

    def most() -> int:
        own = _status("VmHWM") if reset else highest()
        grown = _of("RUSAGE_CHILDREN")
        return max(own, grown if grown > children else 0)

    yield most


def _reset() -> bool:
    try:
        with open("/proc/self/clear_refs", "w", encoding="ascii") as file:
            file.write("5")
    except OSError:
        return False
    return True


def _of(whom: str) -> int:
    """Peak bytes of RUSAGE_SELF or of one of RUSAGE_CHILDREN; 0 where unknown (Windows)."""
    try:
        import resource
    except ImportError:
        return 0
    return resource.getrusage(getattr(resource, whom)).ru_maxrss * (1 if sys.platform == "darwin" else 1024)


def _status(name: str) -> int:
    """A line of /proc/self/status in bytes."""
    try:
        with open("/proc/self/status", encoding="ascii", errors="replace") as file:
            entry = next((line for line in file if line.startswith(name + ":")), "")
    except OSError:
        return 0
    return int(entry.split()[1]) * 1024 if entry else 0


LEAST = 2**20  # bytes: smaller arrays stay in memory
MARGIN = 0.8  # share of the budget above which mapped pages are released
EVERY = 0.005  # seconds between two readings
_scratch: list[Path] = []  # folder of the files; empty without a budget
_limit = [float("inf")]
_mapped: "weakref.WeakSet[mmap.mmap]" = weakref.WeakSet()
T = TypeVar("T")


@contextmanager
def within(budget: float, folder: Path | None) -> Iterator[None]:
    """Keep large arrays in files of `folder` (None: in memory, as outside), and resident memory near `budget` bytes.

    The working set of a stage does not shrink: `jobs/memory_budget.py` decides whether a job fits its budget. Blocks do
    not nest.
    """
    if folder is None:
        yield
        return
    if not possible():
        raise RuntimeError("large arrays can lie in files on Linux only")
    folder.mkdir(parents=True, exist_ok=True)
    _scratch.append(folder)
    done = threading.Event()
    _limit[0] = MARGIN * budget
    watch = threading.Thread(target=_watch, args=(done,), daemon=True)
    watch.start()
    try:
        yield
    finally:
        done.set()
        watch.join()
        _scratch.clear()


def possible() -> bool:
    """Whether this system can release mapped pages and reports resident memory."""
    return sys.platform.startswith("linux")


def tight() -> bool:
    """Whether a budget is active: large arrays go to files."""
    return bool(_scratch)


def empty(shape: tuple[int, ...] | int, dtype: DTypeLike = np.float32) -> np.ndarray:
    """`np.empty`, in a file where there is a budget; zeros then. Raises OSError on a full disk."""
    shape, kind = (shape,) if isinstance(shape, int) else shape, np.dtype(dtype)
    count = int(np.prod(shape, dtype=np.int64)) * kind.itemsize
    if not _scratch or count < LEAST:
        return np.empty(shape, kind)
    return np.frombuffer(_file(count), kind).reshape(shape)


def zeros(shape: tuple[int, ...] | int, dtype: DTypeLike = np.float32) -> np.ndarray:
    """`np.zeros`, in a file where there is a budget."""
    result = empty(shape, dtype)
    if not _scratch or result.nbytes < LEAST:
        result.fill(0)
    return result


def copied(values: np.ndarray) -> np.ndarray:
    """A copy, in a file where there is a budget."""
    result = empty(values.shape, values.dtype)
    np.copyto(result, values)
    return result


def away(record: T) -> T:
    """A dataclass with its large arrays moved to one file where there is a budget; else itself."""
    if not _scratch:
        return record
    assert dataclasses.is_dataclass(record) and not isinstance(record, type)
    every = {f.name: getattr(record, f.name) for f in dataclasses.fields(record)}
    large = {k: v for k, v in every.items() if isinstance(v, np.ndarray) and v.nbytes >= LEAST // 16}
    if sum(v.nbytes for v in large.values()) < LEAST:
        return record
    starts = np.cumsum([0] + [-(-v.nbytes // 64) * 64 for v in large.values()]).tolist()
    data = _file(starts[-1])
    moved: dict[str, Any] = {}
    for (name, values), start in zip(large.items(), starts, strict=False):
        view = np.frombuffer(data, values.dtype, values.size, start).reshape(values.shape)
        np.copyto(view, values)
        moved[name] = view
    return dataclasses.replace(record, **moved)


def load(path: Path) -> np.ndarray:
    """An array of a .npy file; where there is a budget, a large one is mapped and cannot be written to."""
    if not _scratch or path.stat().st_size < LEAST:
        return np.load(path, allow_pickle=False)
    mapped = np.load(path, mmap_mode="r", allow_pickle=False)
    _mapped.add(mapped._mmap)
    return np.asarray(mapped)


def _file(count: int) -> mmap.mmap:
    """`count` bytes of a file without a name, which vanishes however the process ends."""
    _let_go()
    with tempfile.TemporaryFile(dir=_scratch[0]) as file:
        # Allocated at once: a full disk would later end the process with SIGBUS.
        os.posix_fallocate(file.fileno(), 0, count)
        data = mmap.mmap(file.fileno(), count)
    _mapped.add(data)
    return data


def _watch(done: threading.Event) -> None:
    while not done.wait(EVERY):
        _let_go()


def _let_go() -> None:
    """Release mapped pages while the process exceeds its limit; they stay in the kernel's cache."""
    if _resident_now() > _limit[0]:
        let_go()


def let_go() -> None:
    """Release all mapped pages; call it before a library call that lets no other thread run."""
    for data in list(_mapped):
        with contextlib.suppress(ValueError, OSError):  # closed meanwhile
            data.madvise(mmap.MADV_DONTNEED)


def _resident_now() -> int:
    """`resident`, from the file that is quicker to read."""
    with open("/proc/self/statm", "rb") as file:
        return int(file.read().split()[1]) * mmap.PAGESIZE
