"""NumPy's memory as Dr.Jit may read it.

On the CPU Dr.Jit takes over NumPy's (and torch's) memory in place and walks through it in whole vectors: a kernel
reads the last vector to its end even where the array ends before, and dies where nothing is mapped behind it. It also
compiles the memory's alignment into its kernels. So nothing goes from NumPy to Dr.Jit but through these.
"""

from typing import Any

import numpy as np

LANES = 32  # numbers in a vector at most, with room to spare (16 with AVX-512)
ALIGNMENT = 64


def aligned(values: Any, kind: Any = np.float32) -> np.ndarray:
    """A copy that starts at a multiple of 64 bytes and that may be read to the end of its last vector.

    Arrays that happen to start elsewhere would be another kernel in every call.
    """
    values = np.asarray(values)
    kind = np.dtype(kind)
    count = values.size * kind.itemsize
    memory = np.empty(count + ALIGNMENT + LANES * kind.itemsize, np.uint8)
    first = -memory.ctypes.data % ALIGNMENT
    result = memory[first : first + count].view(kind).reshape(values.shape)
    result[...] = values
    return result


def whole(values: Any, kind: Any = np.float32) -> np.ndarray:
    """The values without a copy where they fill whole vectors already: for pictures too large to have twice."""
    values = np.ascontiguousarray(values, kind)
    return values if values.size % LANES == 0 else aligned(values, kind)
