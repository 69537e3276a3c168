"""Processor cores: how many this process may use, and how many it uses."""

import os
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager
from typing import Any

PIECE = 1 << 23


def cores() -> int:
    """Cores that the system grants this process: in a container or on a farm, fewer than the machine has."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def use_threads(count: int) -> None:
    """Set the thread count of torch and OpenCV in this process to `count`, that of NumPy's and SciPy's BLAS to 1.

    Matrices are small here, and the threads of a BLAS wait for one another: where others use the cores too, they take
    up to hundreds of times as long as one. The last digits of a matrix product depend on the count as well. Dr.Jit has
    its own count: `render/mitsuba/device.use`.
    """
    # torch spins for milliseconds after each operation, on cores that Dr.Jit's threads and other jobs need: most of a
    # fit's processor time. OpenMP reads this variable when it is loaded; a user's value stays.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    # OpenMP also reads its thread count at load time. Importing torch only to set it would take seconds.
    os.environ["OMP_NUM_THREADS"] = str(count)
    import cv2

    if torch := sys.modules.get("torch"):
        torch.set_num_threads(count)
    cv2.setNumThreads(count)
    single_blas()


def single_blas() -> AbstractContextManager[Any]:
    """Set the thread count of NumPy's and SciPy's BLAS to 1: see `use_threads`. A `with` block restores it."""
    import scipy.linalg  # noqa: F401  (SciPy's own BLAS; loaded later it would keep all threads)
    from threadpoolctl import threadpool_limits

    return threadpool_limits(limits=1, user_api="blas")


def in_pieces(place: memoryview, fill: Callable[[int, memoryview], None], threads: int) -> None:
    """Call `fill(at, piece)` for all of `place`, PIECE bytes at a time, on `threads` threads. Its errors propagate.

    A large copy spends most of its time on page faults, which the system serves per thread.
    """
    starts = range(0, len(place), PIECE)
    if threads < 2 or len(starts) < 2:
        for at in starts:
            fill(at, place[at : at + PIECE])
        return
    with ThreadPoolExecutor(min(len(starts), threads)) as pool:
        for _ in pool.map(lambda at: fill(at, place[at : at + PIECE]), starts):
            pass
