"""The machine's speed, which the plans' seconds are multiplied by."""

import subprocess
import sys

from mistyle.process.cores import cores
from mistyle.process.speed import slowness


def test_a_busy_machine_is_slow():
    quiet = slowness(cores())
    busy = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(4 * cores())]
    try:
        slowness.cache_clear()
        assert slowness(cores()) > 1.3 * quiet > 0
    finally:
        for one in busy:
            one.kill()
            one.wait()
        slowness.cache_clear()
