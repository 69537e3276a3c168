"""Worker process: reads a weight file that is not safetensors and writes its tensors to stdout as safetensors.

process/weights.py runs it as `python -m mistyle.process.weights_worker FILE`. torch opens pickles with
`weights_only=True`: tensors, numbers, texts and tables, no code. An .npz archive is opened without pickles, if it
unpacks to at most MAX_RATIO times its size. The process can write no file (RLIMIT_FSIZE 0). Its address space is
limited to 8 GiB plus four times the file, its processor time to five minutes. Windows has no such limits; there only
the restricted readers protect.
"""

import json
import os
import sys
from collections.abc import Mapping
from typing import Any

import numpy as np

MAX_RATIO = 200  # float32 zeros deflate to a thousandth, trained weights hardly at all
MAX_UNPACKED = 8 << 30
TYPES = {"<f8": "F64", "<f4": "F32", "<f2": "F16", "<i8": "I64", "<i4": "I32", "<i2": "I16", "|i1": "I8", "|u1": "U8"}
TYPES |= {"|b1": "BOOL"}


def main(path: str) -> None:
    """Write the tensors, or exit with a one-sentence message on stderr."""
    output = os.dup(1)
    os.dup2(2, 1)
    opened = _archive if path.lower().endswith(".npz") else _pickle
    if opened is _pickle:
        import torch  # noqa: F401  (before the limits: it maps gigabytes of libraries)
    _confine(os.path.getsize(path))
    try:
        table = opened(path)
    except MemoryError:
        sys.exit("it takes too much memory")
    except Exception as error:  # any error of a damaged or hostile file
        first = (str(error).splitlines() or [""])[0]
        sys.exit(f"not a plain table of tensors, so it was not opened: {type(error).__name__}: {first[:200]}")
    with os.fdopen(output, "wb") as out:
        _write(table, out)


def _pickle(path: str) -> dict[str, tuple[str, np.ndarray]]:
    """Name to safetensors type and array (bfloat16 as int16 bits)."""
    import torch

    state = torch.load(path, map_location="cpu", weights_only=True)
    if not isinstance(state, dict):
        sys.exit(f"holds a {type(state).__name__}; expected a dictionary of tensors")
    result = {}
    for name, value in state.items():
        if not isinstance(value, torch.Tensor) or value.layout != torch.strided:
            sys.exit(f"expected a table of tensors; '{str(name)[:80]}' is a {type(value).__name__}")
        value = value.detach().contiguous()
        if value.dtype == torch.bfloat16:
            result[str(name)] = ("BF16", value.view(torch.int16).numpy())
        else:
            result[str(name)] = _typed(str(name), value.numpy())
    return result


def _archive(path: str) -> dict[str, tuple[str, np.ndarray]]:
    """The arrays of an .npz file."""
    from zipfile import ZipFile

    with ZipFile(path) as archive:
        unpacked = sum(entry.file_size for entry in archive.infolist())
    if unpacked > min(MAX_UNPACKED, MAX_RATIO * os.path.getsize(path)):
        sys.exit(f"unpacks to {unpacked} bytes; expected at most {MAX_RATIO} times its size and {MAX_UNPACKED} bytes")
    with np.load(path, allow_pickle=False) as stored:
        return {name: _typed(name, np.ascontiguousarray(stored[name])) for name in stored}


def _typed(name: str, array: np.ndarray) -> tuple[str, np.ndarray]:
    if array.dtype.str not in TYPES:
        sys.exit(f"expected plain numbers; '{name[:80]}' is {array.dtype}")
    return TYPES[array.dtype.str], array


def _write(tensors: Mapping[str, tuple[str, np.ndarray]], out: Any) -> None:
    table, at = {}, 0
    for name, (kind, array) in tensors.items():
        table[name] = {"dtype": kind, "shape": list(array.shape), "data_offsets": [at, at + array.nbytes]}
        at += array.nbytes
    head = json.dumps(table).encode()
    head += b" " * (-len(head) % 8)
    out.write(len(head).to_bytes(8, "little") + head)
    for _, array in tensors.values():
        if array.nbytes:
            out.write(array.reshape(-1).view(np.uint8).data)


def _confine(size: int) -> None:
    try:
        import resource
    except ImportError:  # Windows
        return
    for kind, limit in (
        (resource.RLIMIT_FSIZE, 0),
        (resource.RLIMIT_CORE, 0),
        (resource.RLIMIT_CPU, 300),
        (resource.RLIMIT_AS, (8 << 30) + 4 * size),
    ):
        most = resource.getrlimit(kind)[1]
        resource.setrlimit(kind, (limit if most == resource.RLIM_INFINITY else min(limit, most), most))


if __name__ == "__main__":
    main(sys.argv[1])
