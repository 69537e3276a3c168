"""Memory that stays with the process inside `memory.kept`, peaks of stages, and budgets that are kept."""

import errno
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from mistyle.core.maps import Texels
from mistyle.io.store.records import load_record, save_record
from mistyle.process import memory
from tests.support.helpers import ROOT

FREED = """
import ctypes, resource
from mistyle.process import memory
BLOCK = 48_000_000  # larger than any that glibc keeps of its own accord
library = ctypes.CDLL(None)
library.malloc.restype, library.malloc.argtypes = ctypes.c_void_p, [ctypes.c_size_t]
library.free.argtypes = [ctypes.c_void_p]

def faults():
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for _ in range(8):
        block = library.malloc(BLOCK)
        ctypes.memset(block, 1, BLOCK)
        library.free(block)
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before

def resident():
    with open("/proc/self/statm", encoding="ascii") as file:
        return int(file.read().split()[1])

outside = faults()
with memory.kept():
    faults()
    inside, held = faults(), resident()
assert inside < 0.05 * outside, (inside, outside)
assert resident() < held - 4000, (resident(), held)  # pages: half of a block at least
assert faults() > 0.5 * outside
"""


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="glibc's allocator is only on Linux")
def test_freed_blocks_are_not_mapped_again_inside_and_are_given_back_afterwards():
    """In a process of its own: what ran before in this one decides how its allocator answers."""
    done = subprocess.run([sys.executable, "-c", FREED], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


LINUX = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="the kernel's mark of the peak is Linux's")


PEAK = """
import numpy as np
from mistyle.process import memory
BLOCK = 48_000_000
large = np.ones(2 * BLOCK, np.uint8)
before = memory.highest()
del large
with memory.watched() as most:
    held = memory.resident()
    np.ones(BLOCK, np.uint8)
    peak = most() - held
assert BLOCK - 1_000_000 < peak < BLOCK + 10_000_000, peak
assert memory.highest() >= before
"""


@LINUX
def test_the_peak_of_a_block_is_its_own():
    """In a process of its own: an allocator that kept freed blocks takes the next one from them."""
    done = subprocess.run([sys.executable, "-c", PEAK], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


@LINUX
def test_arrays_within_a_budget_lie_in_files_and_what_is_held_stays_near_it(tmp_path):
    held = memory.resident()
    with memory.within(held + 250e6, tmp_path / "work"), memory.watched() as most:
        arrays = [memory.empty((1000, 4, 5000)) for _ in range(12)]  # 960 MB in all
        for number, array in enumerate(arrays):
            for rows in array:
                rows[...] = number
        assert [float(a[-1, -1, -1] + a[0, 0, 0]) for a in arrays] == [2.0 * n for n in range(12)]
        assert most() - held < 500e6
        assert list((tmp_path / "work").iterdir()) == []
    assert [float(a.sum(dtype=np.float64)) for a in arrays] == [n * 2e7 for n in range(12)]
    assert not memory.tight() and type(memory.empty(2_000_000)) is np.ndarray


def test_a_record_goes_to_a_file_as_it_is(tmp_path, rng):
    texels = Texels(
        rng.random((300, 310, 3), np.float32),
        rng.random((300, 310, 3), np.float32),
        rng.random((300, 310)) < 0.5,
        rng.integers(0, 9, (300, 310)).astype(np.int32),
        rng.integers(0, 9, (300, 310)).astype(np.int32),
    )
    assert memory.away(texels) is texels
    with memory.within(1e9, tmp_path):
        moved = memory.away(texels)
        save_record(tmp_path / "record", moved)
        again = load_record(tmp_path / "record")
    for name, values in vars(texels).items():
        for other in (getattr(moved, name), getattr(again, name)):
            assert other.dtype == values.dtype and np.array_equal(other, values)
    assert moved.position is not texels.position and not again.position.flags.writeable


@LINUX
def test_a_full_disk_is_an_error_and_no_signal(tmp_path, monkeypatch):
    def full(file: int, start: int, count: int) -> None:
        raise OSError(errno.ENOSPC, "no space")

    monkeypatch.setattr("os.posix_fallocate", full)
    with memory.within(1e9, tmp_path), pytest.raises(OSError, match="no space"):
        memory.zeros(10_000_000)


def kernel(folder: Path, files: dict[str, str], groups: str) -> int | None:
    """`memory.limit` of a machine with 8 GiB whose control groups say what `files` do."""
    for name, text in {"proc/meminfo": "MemTotal:  8388608 kB\nMemFree: 1 kB\n", **files}.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)
    (folder / "proc/self").mkdir(exist_ok=True)
    (folder / "proc/self/cgroup").write_text(groups)
    return memory.limit(folder / "proc", folder / "groups")


UNLIMITED = "9223372036854771712\n"  # as v1 says it


@pytest.mark.parametrize(
    ("groups", "files", "gib"),
    [
        ("0::/\n", {}, 8),
        ("0::/job/step\n", {"groups/job/step/memory.max": "max\n", "groups/job/memory.max": "max\n"}, 8),
        ("0::/job/step\n", {"groups/job/step/memory.max": f"{2 << 30}\n", "groups/job/memory.max": "max\n"}, 2),
        # The group around it allows less than its own.
        ("0::/job/step\n", {"groups/job/step/memory.max": f"{4 << 30}\n", "groups/job/memory.max": f"{3 << 30}\n"}, 3),
        # A container sees its own group at the root, and the host's path leads nowhere.
        ("0::/docker/abc\n", {"groups/memory.max": f"{1 << 30}\n"}, 1),
        ("5:cpu,memory:/job\n0::/\n", {"groups/memory/job/memory.limit_in_bytes": f"{2 << 30}\n"}, 2),
        ("5:memory:/job\n", {"groups/memory/job/memory.limit_in_bytes": UNLIMITED}, 8),
        ("5:memory:/docker/abc\n", {"groups/memory/memory.limit_in_bytes": f"{3 << 30}\n"}, 3),
        ("5:memory:/job\n", {"groups/memory/job/memory.limit_in_bytes": f"{64 << 30}\n"}, 8),
        # Both at once, as systemd mounts them; groups of another kind, and what is no list of groups, count nothing.
        (
            "5:cpu:/job\n0::/job\n",
            {"groups/unified/job/memory.max": f"{2 << 30}\n", "groups/cpu/job/memory.max": "1"},
            2,
        ),
        ("nonsense\n::\n", {"groups/memory.max": "nonsense"}, 8),
    ],
)
def test_the_limit_is_the_machines_or_that_of_the_smallest_group(tmp_path, groups, files, gib):
    assert kernel(tmp_path, files, groups) == gib << 30


def test_the_limit_where_the_kernel_shows_nothing(tmp_path, monkeypatch):
    monkeypatch.setattr("os.sysconf", lambda name: {"SC_PHYS_PAGES": 1 << 20, "SC_PAGE_SIZE": 4096}[name])
    assert memory.limit(tmp_path, tmp_path) == 4 << 30

    def unknown(name: str) -> int:
        raise ValueError("unrecognized configuration name")

    monkeypatch.setattr("os.sysconf", unknown)
    assert memory.limit(tmp_path, tmp_path) is None
