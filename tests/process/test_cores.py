"""How many threads the libraries use, and that torch is loaded only by what computes with it."""

import os
import subprocess
import sys

LINES = """
import sys
from mistyle.process.cores import use_threads
use_threads(1)
assert "torch" not in sys.modules
import torch
first = torch.get_num_threads()
use_threads(2)
print(first, torch.get_num_threads())
"""


def test_torch_takes_its_threads_whether_it_is_loaded_later_or_already():
    done = subprocess.run([sys.executable, "-c", LINES], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["1", "2"]


BLAS = """
import numpy, scipy.linalg
from threadpoolctl import threadpool_info
from mistyle.process.cores import single_blas, use_threads
count = lambda: {each["num_threads"] for each in threadpool_info() if each["user_api"] == "blas"}
counts = [count()]
with single_blas():
    counts.append(count())
counts.append(count())
use_threads(2)
print(*counts, count())
"""


def test_a_blas_uses_one_thread_whatever_the_environment_says():
    environment = os.environ | {"OPENBLAS_NUM_THREADS": "2"}
    done = subprocess.run([sys.executable, "-c", BLAS], capture_output=True, text=True, check=True, env=environment)
    assert done.stdout.split() == ["{2}", "{1}", "{2}", "{1}"]
