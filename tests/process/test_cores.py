"""How many threads the libraries use, and that torch is loaded only by what computes with it."""

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
