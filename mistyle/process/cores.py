"""How many processor cores this process may use, and how many it does."""

import os
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

PIECE = 1 << 23


def cores() -> int:
    """Those that the system lets it run on, which in a container or on a farm are fewer than the machine has."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def use_threads(count: int) -> None:
    """Have torch, OpenCV and the BLAS of NumPy and SciPy work on `count` threads from here on, in this process.

    A product of matrices has other last digits at another count, and a BLAS left alone takes all cores, however many
    shards share them. Dr.Jit has its own count: `render/device.use`.
    """
    # torch waits for its threads by spinning, for milliseconds after each operation, on cores that Dr.Jit's threads and
    # other jobs need: most of a fit's processor time. Its OpenMP reads this when it is loaded; a user's choice stays.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    # So is its number of threads; loading torch for that alone takes seconds that a job without a fit does not have.
    os.environ["OMP_NUM_THREADS"] = str(count)
    import cv2
    import scipy.linalg  # noqa: F401  (loads SciPy's own BLAS, which could not be told later)
    from threadpoolctl import threadpool_limits

    if torch := sys.modules.get("torch"):
        torch.set_num_threads(count)
    cv2.setNumThreads(count)
    threadpool_limits(limits=count, user_api="blas")


def in_pieces(place: memoryview, fill: Callable[[int, memoryview], None], threads: int) -> None:
    """`fill(at, piece)` for all of `place`, PIECE bytes at a time, on so many threads. Raises what `fill` raises.

    Most of the time that a large copy takes goes into pages that the system hands out anew, which it does for every
    thread by itself.
    """
    starts = range(0, len(place), PIECE)
    if threads < 2 or len(starts) < 2:
        for at in starts:
            fill(at, place[at : at + PIECE])
        return
    with ThreadPoolExecutor(min(len(starts), threads)) as pool:
        for _ in pool.map(lambda at: fill(at, place[at : at + PIECE]), starts):
            pass
