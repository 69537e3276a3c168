"""How the files of benchmarks/faults/corpus.py are damaged: bytes, numbers, words, lines, and values of JSON trees.

`damaged` draws its decisions from `draw` (n -> 0..n-1): a random generator's, or Hypothesis's, which can then shrink
what fails.
"""

import json
import struct
from collections.abc import Callable
from typing import Any

from benchmarks.faults.corpus import Seed

Draw = Callable[[int], int]

NUMBERS = (b"nan", b"inf", b"-inf", b"1e999", b"-1", b"0", b"99999999999", b"1e30", b"1e-320", b"0x10", b"1_0", b"")
INTEGERS = (0, 1, 0x7F, 0x80, 0xFF, 0x7FFF, 0xFFFF, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF, 0xFFFFFFFE, 0x40000000)
VALUES: tuple[Any, ...] = (
    *(None, True, [], {}, "", "a", 0, -1, 1, 1e999, -1e999, 1e308, 1e-320, 2**31, 2**63, 10**400, 0.5),
    *(
        "../../../etc/passwd",
        "/etc/passwd",
        "http://127.0.0.1:9/a.bin",
        "file:///etc/passwd",
        "a\0b",
        "C:\\a",
        "\ud800",
    ),
    *("data:application/octet-stream;base64,AAAA", "data:,x", "..", ".", "a" * 5000, [[]], [0, 0, 0], [1e999] * 3),
    *({"a": {"b": []}}, [None], ["x"], [1e308, 1e308, 1e308], [0] * 16),
)


def damaged(seed: Seed, draw: Draw) -> dict[str, bytes]:
    """The seed's files, one of them (a folder's any, else mostly the one handed in) damaged one to four times."""
    names = sorted(seed.files)
    chosen = names[draw(len(names))] if seed.entry == "." or draw(3) == 0 else seed.entry
    data = seed.files[chosen]
    for _ in range(1 + draw(4)):
        data = _damage(chosen, data, draw)
    return {**seed.files, chosen: data}


def _damage(name: str, data: bytes, draw: Draw) -> bytes:
    ways: list[Callable[[bytes, Draw], bytes]] = [_flip, _integer, _cut, _repeat, _splice]
    if name.endswith((".json", ".gltf")):
        ways += [_tree] * 6
    elif name.endswith(".glb"):
        ways += [_glb_tree] * 6
    elif name.endswith(".safetensors"):
        ways += [_header_tree] * 6
    elif name.endswith((".obj", ".mtl", ".off", ".txt", ".toml", ".yaml", ".ply", ".stl", ".usda")):
        ways += [_word, _word, _line]
    return ways[draw(len(ways))](data, draw)


def _flip(data: bytes, draw: Draw) -> bytes:
    if not data:
        return b"\0"
    at = draw(len(data))
    return data[:at] + bytes([data[at] ^ (1 << draw(8))]) + data[at + 1 :]


def _integer(data: bytes, draw: Draw) -> bytes:
    """A number of 1 to 8 bytes, of either order, over what is there."""
    size, order = (1, 2, 4, 8)[draw(4)], ("little", "big")[draw(2)]
    value = INTEGERS[draw(len(INTEGERS))] % (1 << 8 * size)
    at = draw(max(len(data) - size, 0) + 1)
    return data[:at] + value.to_bytes(size, order) + data[at + size :]  # type: ignore[arg-type]


def _cut(data: bytes, draw: Draw) -> bytes:
    at = draw(len(data) + 1)
    return data[:at] if draw(2) else data[:at] + data[at + 1 + draw(16) :]


def _repeat(data: bytes, draw: Draw) -> bytes:
    at, size = draw(len(data) + 1), 1 + draw(64)
    return data[:at] + data[at : at + size] * (1 + draw(20)) + data[at:]


def _splice(data: bytes, draw: Draw) -> bytes:
    if not data:
        return data
    at, source = draw(len(data)), draw(len(data))
    size = 1 + draw(32)
    return data[:at] + data[source : source + size] + data[at + size :]


def _word(data: bytes, draw: Draw) -> bytes:
    words = data.split(b" ")
    words[draw(len(words))] = NUMBERS[draw(len(NUMBERS))]
    return b" ".join(words)


def _line(data: bytes, draw: Draw) -> bytes:
    lines = data.split(b"\n")
    at = draw(len(lines))
    if draw(2):
        lines.insert(at, lines[draw(len(lines))])
    else:
        del lines[at]
    return b"\n".join(lines)


def _tree(data: bytes, draw: Draw) -> bytes:
    """A value of a JSON text, anywhere in it, replaced, doubled or taken away."""
    try:
        tree = json.loads(data)
    except (ValueError, RecursionError):
        return _flip(data, draw)
    spots: list[tuple[Any, Any]] = []
    left: list[Any] = [tree]
    while left:
        item = left.pop()
        pairs = item.items() if isinstance(item, dict) else enumerate(item) if isinstance(item, list) else ()
        for key, value in pairs:
            spots.append((item, key))
            left.append(value)
    if not spots:
        return data
    holder, key = spots[draw(len(spots))]
    way = draw(8)
    if way == 0:
        del holder[key]
    elif way == 1 and isinstance(holder, list):
        holder.extend([holder[key]] * (1 + draw(200)))
    elif way == 2:
        _, other = spots[draw(len(spots))]
        found = next(h[k] for h, k in spots if k == other)
        holder[key] = json.loads(json.dumps(found))
    elif way == 3 and isinstance(holder[key], int | float):
        holder[key] = (-1, 0, 1, 2, 3, 4, 5, 7, 100, 5121, 5125, 5126, 10**8)[draw(13)]
    else:
        holder[key] = VALUES[draw(len(VALUES))]
    return json.dumps(tree).encode()


def _glb_tree(data: bytes, draw: Draw) -> bytes:
    if len(data) < 20 or data[:4] != b"glTF":
        return _flip(data, draw)
    size = struct.unpack_from("<I", data, 12)[0]
    text = _tree(data[20 : 20 + size], draw)
    text += b" " * (-len(text) % 4)
    rest = data[20 + size :]
    return (
        b"glTF"
        + struct.pack("<II", 2, 20 + len(text) + len(rest))
        + struct.pack("<I4s", len(text), b"JSON")
        + text
        + rest
    )


def _header_tree(data: bytes, draw: Draw) -> bytes:
    size = int.from_bytes(data[:8], "little")
    text = _tree(data[8 : 8 + size], draw)
    return len(text).to_bytes(8, "little") + text + data[8 + size :]
