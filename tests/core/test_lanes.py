"""NumPy's memory as Dr.Jit reads it: nothing is read that is not there, and nothing goes past core/drjit_arrays.py."""

import ast
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from mistyle.core.drjit_arrays import ALIGNMENT, LANES, aligned, whole
from tests.support.helpers import ROOT

# An array that ends with its page, behind which nothing may be read.
AT_THE_END_OF_A_PAGE = """
import ctypes, mmap, sys
import numpy as np
import drjit as dr
from drjit.llvm import Float
from mistyle.core.drjit_arrays import aligned, whole

memory = mmap.mmap(-1, 3 * mmap.PAGESIZE)
base = ctypes.addressof(ctypes.c_char.from_buffer(memory))
protect = ctypes.CDLL(None, use_errno=True).mprotect
protect.argtypes = [ctypes.c_void_p, ctypes.c_size_t, ctypes.c_int]
assert protect(base + 2 * mmap.PAGESIZE, mmap.PAGESIZE, 0) == 0
values = np.frombuffer(memory, np.float32, count=mmap.PAGESIZE // 2)[-1001:]
values[:] = np.arange(1001)
for given in (aligned(values), whole(values)):
    assert np.array_equal((Float(given) + 1).numpy(), np.arange(1001) + 1)
print("read")
"""
ARRAYS = ("Float", "UInt", "UInt32", "Int", "Int32", "TensorXf", "TensorXb", "TensorXu", "Point3f", "Vector3f")


@pytest.mark.skipif(sys.platform == "win32", reason="mprotect is not there")
def test_no_kernel_reads_beyond_an_array():
    done = subprocess.run([sys.executable, "-c", AT_THE_END_OF_A_PAGE], capture_output=True, text=True, cwd=ROOT)
    assert done.stdout.strip() == "read", (done.returncode, done.stderr)


@pytest.mark.parametrize("kind", [np.float32, np.uint32, np.uint8, bool])
@pytest.mark.parametrize("shape", [(1,), (1001,), (7, 5, 3), (64, 32)])
def test_values_stay_and_memory_goes_on(kind, shape):
    values = (np.arange(np.prod(shape)) % 2).reshape(shape)
    found = aligned(values, kind)
    assert found.dtype == kind and np.array_equal(found, values.astype(kind)) and found.flags.c_contiguous
    assert found.ctypes.data % ALIGNMENT == 0
    root = found
    while isinstance(root.base, np.ndarray):
        root = root.base
    end = found.ctypes.data + found.nbytes
    assert root.ctypes.data + root.nbytes >= end + LANES * found.itemsize
    assert np.array_equal(whole(values, kind), values.astype(kind))


def test_large_pictures_are_not_copied():
    picture = np.zeros((64, 64, 3), np.float32)
    assert whole(picture) is picture and not np.shares_memory(whole(picture[:63, :63]), picture)


def test_no_array_goes_to_the_device_by_another_way():
    """Calls such as mi.Float(np.…) or mi.Float(x.astype(…)) in render/ and surface/."""
    found = []
    for path in sorted([*Path(ROOT, "mistyle").rglob("*.py")]):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if not (isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr in ARRAYS):
                continue
            text = [ast.unparse(argument) for argument in node.args]
            arrays = [t for t in text if ("np." in t or ".astype(" in t) and "float(" not in t and ".tolist()" not in t]
            if any("aligned(" not in t and "whole(" not in t for t in arrays):
                found.append(f"{path.name}:{node.lineno}: {ast.unparse(node)}")
    assert not found, found
