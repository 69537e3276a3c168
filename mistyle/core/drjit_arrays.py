"""NumPy arrays whose memory Dr.Jit can read safely.

On the CPU Dr.Jit uses NumPy's (and torch's) memory in place and reads it in whole vectors. A kernel reads the last
vector to its end, beyond a shorter array, and crashes where no page is mapped behind it. Dr.Jit also compiles the
memory's alignment into its kernels. So every NumPy array passes through these functions on its way to Dr.Jit.
"""

from typing import Any

import numpy as np

LANES = 32  # numbers in a vector at most, with room to spare (16 with AVX-512)
ALIGNMENT = 64


def aligned(values: Any, kind: Any = np.float32) -> np.ndarray:
    """A copy that starts at a multiple of 64 bytes and that may be read to the end of its last vector.

    Arrays of varying alignment would compile another kernel in every call.
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
    """The values without a copy where they fill whole vectors already: for pictures too large to copy."""
    values = np.ascontiguousarray(values, kind)
    return values if values.size % LANES == 0 else aligned(values, kind)
