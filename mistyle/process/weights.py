"""Weights of networks from files: safetensors, checked and mapped in place; all others only through a child process.

A safetensors file is eight bytes of header length, a JSON header {name: {dtype, shape, data_offsets}} and raw
little-endian data. These are checked before use: the header's length (at most HEADER_LIMIT), every type, shape and
range, and that the data lie inside the file without overlaps. A pickle (.pth, .bin, .pt, .ckpt) can run code when it
is opened. process/weights_worker.py opens it with `weights_only=True`, limits on memory and time and no right to write,
and returns the same layout; it also unpacks .npz archives.
"""

import json
import math
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np

from mistyle.core.errors import InputRefused
from mistyle.core.paths import PACKAGE

HEADER_LIMIT = 100_000_000
SIZES = {"F64": 8, "I64": 8, "U64": 8, "C64": 8, "F32": 4, "I32": 4, "U32": 4, "F16": 2, "BF16": 2, "I16": 2, "U16": 2}
SIZES |= {"I8": 1, "U8": 1, "BOOL": 1, "F8_E4M3": 1, "F8_E5M2": 1, "F8_E8M0": 1, "F8_E4M3FNUZ": 1, "F8_E5M2FNUZ": 1}
PATIENCE = 600.0  # seconds for a pickle, torch's start included


def header(path: Path) -> tuple[dict[str, Any], int]:
    """The checked header of a safetensors file, '__metadata__' included, and the byte offset of its data.

    Raises InputRefused for anything that safetensors does not allow.
    """
    try:
        with open(path, "rb") as file:
            size = os.fstat(file.fileno()).st_size
            length = int.from_bytes(file.read(8), "little")
            if not 2 <= length <= min(HEADER_LIMIT, size - 8):
                raise ValueError(f"a header of {length} bytes")
            table = json.loads(file.read(length))
        _check(table, size - 8 - length)
    except (OSError, ValueError, TypeError, KeyError, RecursionError) as error:
        raise InputRefused(f"{path}: {error}; expected a .safetensors file (pickles are not opened)") from None
    return table, 8 + length


def _check(table: Any, size: int) -> None:
    """Check the header's entries against each other and against the `size` bytes of data."""
    if not isinstance(table, dict):
        raise ValueError("a header that is not a table")
    spans = []
    for name, entry in table.items():
        if name == "__metadata__":
            if not isinstance(entry, dict) or not all(isinstance(v, str) for v in entry.values()):
                raise ValueError("metadata that are not a table of texts")
            continue
        if not isinstance(entry, dict) or not {"dtype", "shape", "data_offsets"} <= set(entry):
            raise ValueError(f"the tensor {name[:80]!r} without dtype, shape and data_offsets")
        kind, shape, offsets = entry["dtype"], entry["shape"], entry["data_offsets"]
        whole = [n for n in (*shape, *offsets) if isinstance(n, int) and not isinstance(n, bool) and n >= 0]
        if kind not in SIZES or len(whole) != len(shape) + len(offsets) or len(offsets) != 2 or len(shape) > 32:
            raise ValueError(f"the tensor {name[:80]!r} of {str(kind)[:20]} {str(shape)[:80]} at {str(offsets)[:80]}")
        begin, end = offsets
        if not begin <= end <= size:
            raise ValueError(f"{name[:80]} lies outside the file")
        if math.prod(shape) * SIZES[kind] != end - begin:
            raise ValueError(f"the tensor {name[:80]!r} of {math.prod(shape)} numbers in {end - begin} bytes")
        spans.append((begin, end))
    spans.sort()
    if any(first[1] > second[0] for first, second in zip(spans, spans[1:], strict=False)):
        raise ValueError("tensors that overlap")


def tensors(path: Path) -> dict[str, Any]:
    """Name to torch tensor of a .safetensors file, an .npz archive, or a pickle of a table of tensors with any ending.

    A .safetensors file is mapped copy-on-write. Raises InputRefused. Types that torch lacks (8-bit floats) are skipped.
    """
    if Path(path).suffix.lower() == ".safetensors":
        table, start = header(path)
        empty = path.stat().st_size == start
        return _views(table, np.zeros(0, np.uint8) if empty else np.memmap(path, np.uint8, "c", start))
    return converted(path)


def converted(path: Path) -> dict[str, Any]:
    """The tensors of a pickle or an .npz archive, opened in a child process. InputRefused for any other content."""
    paths = os.pathsep.join(p for p in (str(PACKAGE.parent), os.environ.get("PYTHONPATH", "")) if p)
    if not path.is_file():
        raise InputRefused(f"{path}: no such file of weights.")
    try:
        done = subprocess.run(
            [sys.executable, "-B", "-m", "mistyle.process.weights_worker", str(path)],
            stdin=subprocess.DEVNULL,
            capture_output=True,
            env={**os.environ, "PYTHONPATH": paths},
            timeout=PATIENCE,
        )
    except subprocess.TimeoutExpired as error:
        raise InputRefused(f"{path}: was not read within {PATIENCE:.0f} s; expected a table of tensors") from error
    if done.returncode != 0:
        last = done.stderr.decode("utf-8", "replace").strip().splitlines()[-1:] or [f"code {done.returncode}"]
        raise InputRefused(f"{path}: cannot be read as weights ({last[0][:300]}); expected a plain table of tensors")
    data = np.frombuffer(bytearray(done.stdout), np.uint8)
    length = int.from_bytes(data[:8].tobytes(), "little")
    try:
        table = json.loads(data[8 : 8 + length].tobytes())
        _check(table, len(data) - 8 - length)
    except (ValueError, TypeError, KeyError) as error:
        raise InputRefused(f"{path}: cannot be read as weights ({error}); expected a plain table of tensors") from error
    return _views(table, data[8 + length :])


def _views(table: dict[str, Any], data: np.ndarray) -> dict[str, Any]:
    import torch

    kinds = {
        **{"F64": torch.float64, "F32": torch.float32, "F16": torch.float16, "BF16": torch.bfloat16},
        **{"I64": torch.int64, "I32": torch.int32, "I16": torch.int16, "I8": torch.int8, "U8": torch.uint8},
        **{"BOOL": torch.bool, "C64": torch.complex64},
    }
    result = {}
    for name, entry in table.items():
        if name == "__metadata__" or entry["dtype"] not in kinds:
            continue
        begin, end = entry["data_offsets"]
        if begin == end:
            result[name] = torch.zeros(entry["shape"], dtype=kinds[entry["dtype"]])
            continue
        part = data[begin:end]
        if part.ctypes.data % SIZES[entry["dtype"]]:
            part = part.copy()
        result[name] = torch.from_numpy(part).view(kinds[entry["dtype"]]).reshape(entry["shape"])
    return result
