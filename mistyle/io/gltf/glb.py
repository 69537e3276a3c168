"""The glTF container: reading and adding accessors and images, and packing one .glb (glTF 2.0, chapter 4).

A tree is glTF's JSON as dicts and lists. A `Builder` holds a tree and the bytes of its buffer views. Additions go to
new buffer views; old ones keep their bytes.
"""

import json
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from mistyle.core.errors import InputRefused, MistyleError

Tree = dict[str, Any]
Buffers = Sequence[bytes | memoryview]

ARRAY_BUFFER, ELEMENT_ARRAY_BUFFER = 34962, 34963
LINEAR, LINEAR_MIPMAP_LINEAR = 9729, 9987
REPEAT, MIRRORED_REPEAT, CLAMP_TO_EDGE = 10497, 33648, 33071
TRIANGLES, STRIP, FAN = 4, 5, 6

_TYPES = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_SHAPES = {"SCALAR": (1, 1), "VEC2": (1, 2), "VEC3": (1, 3), "VEC4": (1, 4)}
_SHAPES |= {"MAT2": (2, 2), "MAT3": (3, 3), "MAT4": (4, 4)}
_LARGEST = 2**32 - 1


def element_bytes(tree: Tree, buffers: Buffers, index: int) -> np.ndarray:
    """An accessor's elements as (count, bytes per element) uint8, without the stride's gaps, sparse values applied."""
    accessor = tree["accessors"][index]
    count, size = accessor["count"], _element_size(accessor)
    if "bufferView" in accessor:
        result = _elements(tree, buffers, accessor["bufferView"], accessor.get("byteOffset", 0), count, size)
    else:
        result = np.zeros((count, size), np.uint8)
    if "sparse" in accessor:
        sparse = accessor["sparse"]
        kind = np.dtype(_TYPES[sparse["indices"]["componentType"]])
        places, values = sparse["indices"], sparse["values"]
        number = sparse["count"]
        where = _elements(
            tree, buffers, places["bufferView"], places.get("byteOffset", 0), number, kind.itemsize, tight=True
        )
        new = _elements(tree, buffers, values["bufferView"], values.get("byteOffset", 0), number, size, tight=True)
        result = result.copy()
        result[where.copy().view(kind).reshape(-1)] = new
    return result


def values(tree: Tree, buffers: Buffers, index: int) -> np.ndarray:
    """An accessor of scalars or vectors as numbers (count, components); normalised integers become floats."""
    accessor = tree["accessors"][index]
    kind = np.dtype(_TYPES[accessor["componentType"]])
    raw = np.ascontiguousarray(element_bytes(tree, buffers, index)).view(kind)
    if not accessor.get("normalized"):
        return raw
    scaled = raw.astype(np.float32) / np.float32(np.iinfo(kind).max)
    return np.maximum(scaled, np.float32(-1))


def _element_size(accessor: Tree) -> int:
    columns, rows = _SHAPES[accessor["type"]]
    size = np.dtype(_TYPES[accessor["componentType"]]).itemsize * rows
    return size if columns == 1 else columns * (-(-size // 4) * 4)  # each column of a matrix begins at a multiple of 4


def _elements(
    tree: Tree, buffers: Buffers, view: int, offset: int, count: int, size: int, tight: bool = False
) -> np.ndarray:
    table = tree["bufferViews"][view]
    stride = size if tight else table.get("byteStride", size)
    start = table.get("byteOffset", 0) + offset
    data = np.frombuffer(buffers[table["buffer"]], np.uint8)
    end = start + stride * (count - 1) + size if count else start
    if start < 0 or end > len(data) or end > table.get("byteOffset", 0) + table["byteLength"] or stride < size:
        raise InputRefused(
            f"an accessor of the glTF file reads bytes {start} to {end} of buffer view {view}, which ends before; "
            "the file is damaged, export it again"
        )
    if not count:
        return np.zeros((0, size), np.uint8)
    return np.lib.stride_tricks.as_strided(data[start:end], (count, size), (stride, 1), writeable=False)


def unit_normals(normals: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Unit normals for glTF: unit ones stay bit-equal, others are normalised, zero ones point up."""
    normals = normals.astype(np.float32)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    fixed = np.where(length > 1e-12, normals / np.maximum(length, 1e-12), np.array([0, 1, 0], np.float32))
    return np.where(np.abs(length - 1) < 1e-4, normals, fixed).astype(np.float32)


class Builder:
    """A glTF under construction: the tree, and the bytes of every buffer view."""

    def __init__(self, tree: Tree, buffers: Buffers) -> None:
        """Take over a tree, which the builder modifies, and the content of its buffers."""
        self.tree = tree
        self.blobs: list[bytes | memoryview] = []
        for view in tree.get("bufferViews", []):
            start = view.get("byteOffset", 0)
            self.blobs.append(buffers[view["buffer"]][start : start + view["byteLength"]])

    def put(self, key: str, item: Tree) -> int:
        """Append to one of the tree's lists; returns the index."""
        items = self.tree.setdefault(key, [])
        items.append(item)
        return len(items) - 1

    def view(self, data: bytes, **entries: int) -> int:
        """A new buffer view with this content."""
        self.blobs.append(data)
        return self.put("bufferViews", {"buffer": 0, "byteLength": len(data), **entries})

    def attribute(self, array: np.ndarray, *, bounds: bool = False) -> int:
        """A new accessor of float32 vectors (n, 2..4) for a vertex attribute; `bounds` writes min and max."""
        array = np.ascontiguousarray(array, "<f4")
        item: Tree = {
            "bufferView": self.view(array.tobytes(), target=ARRAY_BUFFER),
            "componentType": 5126,
            "count": len(array),
            "type": f"VEC{array.shape[1]}",
        }
        if bounds:
            # float32 to float and its shortest decimal form: exactly the stored value.
            item["min"], item["max"] = array.min(axis=0).tolist(), array.max(axis=0).tolist()
        return self.put("accessors", item)

    def raw_attribute(self, elements: np.ndarray, like: Tree) -> int:
        """A new accessor for a vertex attribute whose elements (n, bytes) have the type of the accessor `like`."""
        count, size = elements.shape
        padded = -(-size // 4) * 4
        data = np.zeros((count, padded), np.uint8)
        data[:, :size] = elements
        stride = {} if padded == size else {"byteStride": padded}
        view = self.view(data.tobytes(), **stride, target=ARRAY_BUFFER)
        type_entries = {k: v for k, v in like.items() if k not in ("bufferView", "byteOffset", "count", "sparse")}
        return self.put("accessors", {"bufferView": view, "count": count, **type_entries})

    def indices(self, faces: np.ndarray) -> int:
        """A new accessor of vertex numbers, two bytes each where they fit."""
        flat = faces.reshape(-1)
        small = flat.max(initial=0) < 65535  # 65535 itself restarts a primitive
        data = flat.astype("<u2" if small else "<u4").tobytes()
        view = self.view(data, target=ELEMENT_ARRAY_BUFFER)
        item = {"bufferView": view, "componentType": 5123 if small else 5125, "count": len(flat), "type": "SCALAR"}
        return self.put("accessors", item)

    def png(self, data: bytes, name: str) -> int:
        """A new image with these bytes of a PNG."""
        return self.put("images", {"name": name, "mimeType": "image/png", "bufferView": self.view(data)})

    def sampler(self, *, repeat: bool) -> int:
        """A sampler with mipmaps; an equal one is reused."""
        wrap = REPEAT if repeat else CLAMP_TO_EDGE
        item = {"magFilter": LINEAR, "minFilter": LINEAR_MIPMAP_LINEAR, "wrapS": wrap, "wrapT": wrap}
        samplers = self.tree.get("samplers", [])
        return samplers.index(item) if item in samplers else self.put("samplers", item)

    def pack(self) -> bytes:
        """The glTF as one .glb: every buffer view at a multiple of four bytes, in order."""
        offset, chunks = 0, []
        for view, blob in zip(self.tree.get("bufferViews", []), self.blobs, strict=True):
            view |= {"buffer": 0, "byteOffset": offset, "byteLength": len(blob)}
            padding = -len(blob) % 4
            chunks += [blob, bytes(padding)]
            offset += len(blob) + padding
        if offset:
            extra = {k: v for k, v in (self.tree.get("buffers") or [{}])[0].items() if k not in ("uri", "byteLength")}
            self.tree["buffers"] = [{"byteLength": offset, **extra}]
        text = json.dumps(self.tree, separators=(",", ":"), ensure_ascii=False, allow_nan=False).encode()
        text += b" " * (-len(text) % 4)
        total = 12 + 8 + len(text) + (8 + offset if offset else 0)
        if total > _LARGEST:
            raise MistyleError(f"the .glb would have {total} bytes and may have {_LARGEST}; use smaller textures")
        header = b"glTF" + np.array([2, total, len(text)], "<u4").tobytes() + b"JSON"
        body = [np.array([offset], "<u4").tobytes(), b"BIN\0", *chunks] if offset else []
        return b"".join([header, text, *body])
