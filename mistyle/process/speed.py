"""How fast this machine is now, beside the server whose seconds the plans' constants are."""

import time
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache

import numpy as np

from mistyle.process.cores import cores

NUMBERS, TABLE = 2**16, 2**20  # of a round: a core's own cache holds NUMBERS, not the TABLE that they look up
ROUNDS, TIMES = 160, 7
# Seconds of ROUNDS on each of two quiet cores of that server. Derived on a second machine, where the calculation takes
# 0.036, the per-texel solver is 1.7 times slower, and the jobs of `benchmarks.captures --only plan` 2.0 to 2.4 times.
REFERENCE = 0.018


@lru_cache
def slowness(threads: int) -> float:
    """Seconds of a fixed calculation on `threads` threads, over those of the plans' server: 2 on a machine that is half
    as fast. It sees what else runs on the machine when it is called first, and takes a quarter of a second there.

    It measures arithmetic and look-ups, not large memory, disks or GPUs.
    """
    numbers = np.linspace(0.01, 1, NUMBERS, dtype=np.float32)
    table, at = np.zeros(TABLE, np.float32), np.arange(NUMBERS) * 7919 % TABLE
    count = max(1, min(threads, cores()))

    def calculate(_: int) -> None:
        out = np.empty_like(numbers)
        for _ in range(ROUNDS):
            np.take(table, at, out=out, mode="clip")
            np.add(numbers, out, out=out)
            np.exp(out, out=out)
            np.sqrt(out, out=out)

    def once(pool: ThreadPoolExecutor) -> float:
        start = time.perf_counter()
        list(pool.map(calculate, range(count)))
        return time.perf_counter() - start

    with ThreadPoolExecutor(count) as pool:
        once(pool)  # starts the threads
        return min(once(pool) for _ in range(TIMES)) / REFERENCE
