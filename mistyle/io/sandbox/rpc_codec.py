"""Message codec between the reader process and the job: a JSON tree and the raw bytes of its arrays, no pickle.

A message is eight bytes of length (little endian), a JSON header, then each array's bytes in the order of the header's
table [dtype, shape]; or [dtype, shape, address] for large arrays that the receiver copies from the sender's memory
(io/sandbox/shared_copy.py). Only plain values, arrays of numbers and the records in RECORDS can be in it, and the
receiver builds nothing else: a process under a hostile file's control can send wrong numbers, but no code.
"""

import importlib
import json
import math
import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np

from mistyle.io.sandbox.shared_copy import LENT
from mistyle.io.store.record_tree import from_tree, to_tree

# Records that may be sent, by their name in messages. A reader that returns another record adds it here.
RECORDS = {
    "Picture": "mistyle.core.asset:Picture",
    "Primitive": "mistyle.core.asset:Primitive",
    "Shading": "mistyle.core.asset:Shading",
    "Lens": "mistyle.geometry.lens:Lens",
    "Corners": "mistyle.io.meshes.parsed_mesh:Corners",
    "Indexed": "mistyle.io.meshes.parsed_mesh:Indexed",
    "CameraFrame": "mistyle.io.cameras.camera_files:CameraFrame",
    "LayeredPicture": "mistyle.io.images.layers:LayeredPicture",
    "Layer": "mistyle.io.images.layers:Layer",
    "Raw": "mistyle.io.meshes.parsed_mesh:Raw",
    "RawMap": "mistyle.io.meshes.parsed_mesh:RawMap",
    "RawMaterial": "mistyle.io.meshes.parsed_mesh:RawMaterial",
    "Textures": "mistyle.io.meshes.parsed_mesh:Textures",
    "Tile": "mistyle.io.meshes.parsed_mesh:Tile",
}
NAMES = {place: name for name, place in RECORDS.items()}
MAX_HEADER = 1 << 30
MAX_ARRAYS = 16 << 30  # bytes of all arrays of one message
CHUNK = 1 << 24
DTYPE = re.compile(r"[<>|][?biuf](1|2|4|8|16)")


class BrokenMessage(Exception):
    """The other side has ended, or sent an invalid message."""


@dataclass(frozen=True)
class Json:
    """A JSON value, sent unchanged and without a traversal."""

    tree: Any


Read = Callable[[memoryview], int]
Write = Callable[[memoryview], int]
Copy = Callable[[int, memoryview], None]  # from an address in the sender's memory


def send(write: Write, value: Any, lend: bool = False, **entries: Any) -> list[np.ndarray]:
    """Write one message: `value`, and plain `entries` of its header.

    With `lend`, large arrays are not written but returned: they must live until the other side confirms the copy.
    """
    arrays: list[np.ndarray] = []
    seen: dict[int, int] = {}
    tree = _pack(value, arrays, seen)
    least = LENT if lend else math.inf
    table = [[a.dtype.str, a.shape, *([a.ctypes.data] if a.nbytes >= least else [])] for a in arrays]
    head = json.dumps({"value": tree, "arrays": table, **entries}).encode()
    _write_all(write, memoryview(len(head).to_bytes(8, "little") + head))
    for array in arrays:
        if 0 < array.nbytes < least:
            _write_all(write, array.reshape(-1).view(np.uint8).data)
    return [array for array in arrays if array.nbytes >= least]


def receive(read: Read, copy: Copy | None = None) -> tuple[Any, dict[str, Any]]:
    """The value of the next message and its header's other entries. Raises BrokenMessage, and what `copy` raises."""
    size = int.from_bytes(_bytes(read, 8), "little")
    if size > MAX_HEADER:
        raise BrokenMessage(f"a header of {size} bytes")
    try:
        head = json.loads(_bytes(read, size))
        table = _allowed(head.pop("arrays"))
        arrays = [np.empty(shape, np.dtype(kind)) for kind, shape, _ in table]
        tree = head.pop("value")
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
        raise BrokenMessage(f"no message ({error})") from error
    for array, (_, _, address) in zip(arrays, table, strict=True):
        place = array.reshape(-1).view(np.uint8).data
        if address is None:
            _fill(read, place)
        elif copy is None:
            raise BrokenMessage("a lent array without a copy function")
        else:
            copy(address, place)
    try:
        return _unpack(tree, arrays), head
    except (ValueError, TypeError, KeyError, IndexError, AttributeError, RecursionError) as error:
        raise BrokenMessage(f"no value ({error})") from error


def _write_all(write: Write, data: memoryview) -> None:
    while data:
        data = data[write(data[:CHUNK]) :]


def _fill(read: Read, data: memoryview) -> None:
    while data:
        count = read(data[:CHUNK])
        if not count:
            raise BrokenMessage("the other side is gone")
        data = data[count:]


def _bytes(read: Read, size: int) -> bytearray:
    data = bytearray(size)
    _fill(read, memoryview(data))
    return data


def _allowed(table: Iterable[Any]) -> list[tuple[str, tuple[int, ...], int | None]]:
    entries, total = [], 0
    for kind, shape, *address in table:
        if not DTYPE.fullmatch(kind) or not all(isinstance(n, int) and n >= 0 for n in shape) or len(shape) > 8:
            raise ValueError(f"an array of {kind!r} {shape!r}")
        total += np.dtype(kind).itemsize * math.prod(shape)
        if len(address) > 1 or not all(isinstance(a, int) and 0 < a < 1 << 63 for a in address):
            raise ValueError(f"an array at {address!r}")
        entries.append((kind, tuple(shape), address[0] if address else None))
    if total > MAX_ARRAYS:
        raise ValueError(f"arrays of {total} bytes")
    return entries


def _pack(value: Any, arrays: list[np.ndarray], seen: dict[int, int]) -> Any:
    """The tree of a value; its arrays are added to `arrays`, each once."""

    def leaf(value: Any) -> dict[str, Any] | None:
        if isinstance(value, np.ndarray):
            if id(value) not in seen:
                if not DTYPE.fullmatch(value.dtype.str):
                    raise TypeError(f"an array of {value.dtype} cannot be sent")
                seen[id(value)] = len(arrays)
                arrays.append(np.asarray(value, order="C"))
            return {"array": seen[id(value)]}
        if isinstance(value, Json):
            return {"json": value.tree}
        if isinstance(value, bytes | bytearray | memoryview):
            arrays.append(np.frombuffer(value, np.uint8))
            return {"bytes": len(arrays) - 1}
        return None

    return to_tree(value, leaf, _name)


def _name(value: Any) -> str:
    name = NAMES.get(f"{type(value).__module__}:{type(value).__qualname__}")
    if name is None:
        raise TypeError(f"a {type(value).__name__} cannot be sent")
    return name


def _unpack(tree: Any, arrays: list[np.ndarray]) -> Any:
    """The value of a tree, built only of the records in RECORDS."""

    def leaf(kind: str, value: Any) -> Any:
        if kind == "array":
            return arrays[value]
        if kind == "bytes":
            return arrays[value].tobytes()
        if kind == "json":
            return value
        raise ValueError(f"a value of kind {kind!r}")

    return from_tree(tree, leaf, _class)


def _class(name: str) -> type:
    module, _, attribute = RECORDS[name].partition(":")
    return getattr(importlib.import_module(module), attribute)
