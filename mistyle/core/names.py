"""Safe names, by one rule for files, USD, MaterialX and MTL.

A safe name is limited in bytes of UTF-8, keeps its ending, and differs from its neighbours even where a file system
ignores case. The same names in the same order give the same result.
"""

import re
import string
import unicodedata
from collections.abc import Callable, Mapping, Sequence

from mistyle.core.errors import UsageError

FILE_NAME = 255  # bytes that ext4, APFS and NTFS allow for the name of a file
HIDDEN = 96  # bytes that io/store/atomic.py adds to temporary names: .<name>.tmp-<host>-<pid>-<n>.<ending>
WRITTEN = FILE_NAME - HIDDEN
ENDING = 31  # room for the longest "_<map>.<tile>.<ending>": _metallicsmoothness.1001.png
STEM = WRITTEN - ENDING
ASSET = 80
IDENTIFIER = 120

_RESERVED = re.compile(r"(?i)(con|prn|aux|nul|com\d|lpt\d)(\..*)?")
_TILE = re.compile(r"(.*?)(\.1\d{3})", re.DOTALL)
_IDENTIFIER = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")


def safe_name(text: str, limit: int = ASSET, filler: str = "_") -> str:
    """A file name that every system accepts, of at most `limit` bytes; a safe name stays.

    Letters, digits and marks of every script stay (NFC), and so do '-', '_' and '.'; each run of other characters
    becomes one `filler`.
    """
    text = unicodedata.normalize("NFC", text)
    if is_safe(text, limit):
        return text
    name = re.sub("\0+", filler, "".join(c if _is_allowed(c) else "\0" for c in text)).strip(f"._ {filler}")
    name = name or _points(text.strip("._ ")) or "_"
    name = cut(name, limit)
    return cut(f"_{name}", limit) if _RESERVED.fullmatch(name) else name


def is_safe(text: str, limit: int = ASSET) -> bool:
    """Whether `safe_name` has nothing to change."""
    return (
        bool(text)
        and all(map(_is_allowed, text))
        and not text.startswith(".")
        and not text.endswith(".")
        and not _RESERVED.fullmatch(text)
        and len(text.encode()) <= limit
        and unicodedata.is_normalized("NFC", text)
    )


def checked(name: str) -> str:
    """A name that the user gave, as it is (NFC). UsageError, with a safe name, where no file can have it."""
    name = unicodedata.normalize("NFC", name)
    if is_safe(name):
        return name
    size = len(name.encode(errors="replace"))
    why = f"{size} bytes of UTF-8" if size > ASSET else "characters that do not suit file names"
    expected = f"letters, digits, '-', '_' and '.', at most {ASSET} bytes"
    raise UsageError(f"--name {name!r}: found {why}, expected {expected}; try {safe_name(name)!r}")


def asset_name(chosen: str | None, *parts: str) -> str:
    """The asset's name: the user's (`checked`), else the parts, cut to equal length and joined by '_'."""
    if chosen:
        return checked(chosen)
    plain = {f"p{k}": safe_name(part, FILE_NAME) for k, part in enumerate(parts)}
    pattern = "_".join(f"{{{key}}}" for key in plain)
    return safe_name(pattern.format(**shortened(pattern, plain, list(plain), ASSET)))


def identifier(text: str, limit: int = IDENTIFIER) -> str:
    """A name as USD and MaterialX take it: ASCII letters, digits and '_', no digit first, at most `limit` bytes.

    Accents are dropped; other letters become their code points, so that names of other scripts stay distinct. USD
    before 24.03 and MaterialX refuse a whole file for one letter outside ASCII, hence no Unicode identifiers.
    """
    text = unicodedata.normalize("NFC", text)
    if _IDENTIFIER.fullmatch(text):
        return text[:limit]
    name = re.sub("\0+", "_", "".join(map(_ascii, text))) or "material"
    name = _points(text) if name == "_" else name
    return f"_{name}"[:limit] if name[0].isdigit() else name[:limit]


def distinct(
    names: Sequence[str], *, limit: int | None = None, joint: str = "_", key: Callable[[str], str] | None = None
) -> list[str]:
    """The names in their order, each different from all before it; a repeated one gets _2, _3, … before its UDIM tile.

    `limit` (bytes) cuts the name before such a suffix. Names with equal `key` are equal: by default those that a file
    system may not distinguish.
    """
    key, taken, result = key or folded, set(), []
    numbers: dict[str, int] = {}
    for name in names:
        base, tile = split_tile(name)
        number = numbers.get(key(name), 1)
        while key(candidate := _numbered(base, tile, number, limit, joint)) in taken:
            number += 1
        numbers[key(name)] = number
        taken.add(key(candidate))
        result.append(candidate)
    return result


def folded(name: str) -> str:
    """The name as a file system compares it that ignores case and Unicode normalisation."""
    return unicodedata.normalize("NFC", unicodedata.normalize("NFD", name).casefold())


def split_tile(name: str) -> tuple[str, str]:
    """A name without its UDIM tile, and the tile with its dot ('.1001'; '' where it has none)."""
    match = _TILE.fullmatch(name)
    return (match[1], match[2]) if match else (name, "")


def cut(text: str, limit: int) -> str:
    """As many whole characters as fit into `limit` bytes of UTF-8; a cut text never ends in '.', '_' or a space."""
    if len(text.encode()) <= limit:
        return text
    return text.encode()[: max(limit, 0)].decode(errors="ignore").rstrip("._ ")


def shortened(pattern: str, fields: Mapping[str, object], long: Sequence[str], limit: int) -> dict[str, object]:
    """The fields for `pattern`.format, the `long` ones (texts) cut to equal length until the result fits `limit` bytes.

    They are empty where the rest of the pattern alone is longer.
    """
    result = dict(fields)
    for room in range(limit, -1, -1):
        result |= {name: cut(str(fields[name]), room) for name in long if name in fields}
        if len(pattern.format(**result).encode()) <= limit:
            break
    return result


def uses(pattern: str, field: str) -> int:
    """Number of uses of a field in a format pattern."""
    return sum(name == field for _, name, _, _ in string.Formatter().parse(pattern))


def _numbered(base: str, tile: str, number: int, limit: int | None, joint: str) -> str:
    suffix = ("" if number == 1 else f"{joint}{number}") + tile
    return (base if limit is None else cut(base, limit - len(suffix.encode()))) + suffix


def _is_allowed(c: str) -> bool:
    return c in "._-" or unicodedata.category(c)[0] in "LMN"


def _points(text: str) -> str:
    """Code points, for names without any allowed character."""
    return "".join(f"u{ord(c):04x}" for c in text)


def _ascii(c: str) -> str:
    if c.isascii():
        return c if c.isalnum() or c == "_" else "\0"
    if unicodedata.category(c)[0] not in "LMN":
        return "\0"
    plain = "".join(d for d in unicodedata.normalize("NFKD", c) if unicodedata.category(d)[0] != "M")
    return plain if plain.isascii() and plain.isalnum() else _points(c)
