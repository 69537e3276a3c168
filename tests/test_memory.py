"""Memory that stays with the process inside `memory.kept`."""

import ctypes
import sys

import pytest

from mistyle.core import memory

BLOCK = 48_000_000  # larger than any that glibc keeps of its own accord


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="glibc's allocator is only on Linux")
def test_freed_blocks_are_not_mapped_again_inside_and_are_given_back_afterwards():
    import resource

    library = ctypes.CDLL(None)
    library.malloc.restype, library.malloc.argtypes = ctypes.c_void_p, [ctypes.c_size_t]
    library.free.argtypes = [ctypes.c_void_p]

    def faults() -> int:
        before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
        for _ in range(8):
            block = library.malloc(BLOCK)
            ctypes.memset(block, 1, BLOCK)
            library.free(block)
        return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before

    def resident() -> int:
        with open("/proc/self/statm", encoding="ascii") as file:
            return int(file.read().split()[1])

    outside = faults()
    with memory.kept():
        faults()
        inside, held = faults(), resident()
    assert inside < 0.05 * outside
    assert resident() < held - 4000  # pages: half of a block at least
    assert faults() > 0.5 * outside
