"""What the C library does with memory that is given back."""

import ctypes
import sys
from collections.abc import Iterator
from contextlib import contextmanager

# mallopt's names for numbers; from how many bytes on a block is mapped on its own, and how much free heap is kept.
M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -1, -3
DEFAULT = 128 * 1024
MOST = 2**30


@contextmanager
def kept() -> Iterator[None]:
    """Inside, freed blocks stay with the process; what is free at the end goes back to the system.

    A loop that makes and drops pictures of tens of megabytes otherwise has the kernel hand out, and clear, all their
    pages anew at every turn. Does nothing where there is no glibc.
    """
    if not sys.platform.startswith("linux"):
        yield
        return
    library = ctypes.CDLL(None)
    if not all(hasattr(library, name) for name in ("mallopt", "malloc_trim")):
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
