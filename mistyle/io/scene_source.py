"""The XML text of a Mitsuba scene file: element positions, parameter values, and paths to its own folder."""

import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.parsers import expat
from xml.sax.saxutils import quoteattr

from mistyle.core.errors import InputRefused
from mistyle.core.paths import real_path

Edit = tuple[int, int, str]  # first byte, byte after the last, replacement


@dataclass(frozen=True)
class Element:
    """One element of the text: bytes `begin`..`end`, its start tag ends at `body`."""

    tag: str
    attributes: dict[str, str]
    begin: int
    body: int
    end: int
    parent: int | None


def elements_of(source: bytes) -> list[Element]:
    """The elements of a scene file's text in the order of their start tags. Raises InputRefused if it is not XML."""
    parser = expat.ParserCreate()
    elements: list[dict[str, Any]] = []
    above: list[int] = []

    def opened(tag: str, attributes: dict[str, str]) -> None:
        begin = parser.CurrentByteIndex
        body = begin + len(re.match(rb"<(?:[^<>\"']|\"[^\"]*\"|'[^']*')*>", source[begin:])[0])  # pyright: ignore
        parent = above[-1] if above else None
        above.append(len(elements))
        elements.append({"tag": tag, "attributes": attributes, "begin": begin, "body": body, "parent": parent})

    def closed(tag: str) -> None:
        element = elements[above.pop()]
        end = parser.CurrentByteIndex
        alone = source[: element["body"]].endswith(b"/>")
        element["end"] = element["body"] if alone else end + source[end:].index(b">") + 1

    parser.StartElementHandler, parser.EndElementHandler = opened, closed
    try:
        parser.Parse(source, True)
    except expat.ExpatError as error:
        raise InputRefused(f"found a scene file that is not XML ({error}); check the file.") from error
    return [Element(**element) for element in elements]


def include_edit(source: bytes, included: Path, defines: Mapping[str, str], new: str) -> list[Edit]:
    """The edit by which `source` includes the file `new` instead of `included`; empty if it does not include it."""
    every = elements_of(source)
    values = {e.attributes.get("name", ""): e.attributes.get("value", "") for e in every if e.tag == "default"}
    values |= defines
    for e in every:
        name = e.attributes.get("filename", "")
        for key in sorted(values, key=len, reverse=True):
            name = name.replace(f"${key}", values[key])
        if e.tag == "include" and name and included.as_posix().endswith(Path(name).as_posix().lstrip("./")):
            return [(e.begin, e.end, f"<include filename={quoteattr(new)}/>")]
    return []


def surroundings(source: bytes, path: Path, defines: Mapping[str, str], out: Path) -> list[Edit]:
    """Edits that set the given defaults, add missing ones, and keep paths to the original's folder valid."""
    edits: list[Edit] = []
    every = elements_of(source)
    present = {e.attributes.get("name", "") for e in every if e.tag == "default"}
    new = [f"\n<default name={quoteattr(k)} value={quoteattr(v)}/>" for k, v in defines.items() if k not in present]
    for e in every:
        name = e.attributes.get("name", "")
        if e.tag == "default" and name in defines:
            text = f"<default name={quoteattr(name)} value={quoteattr(defines[name])}/>"
            edits.append((e.begin, e.end, text))
    if real_path(out.parent) == real_path(path.parent):
        return edits + [(every[0].body, every[0].body, "".join(new))] if new else edits
    for e in every:
        if e.tag == "path" and not Path(e.attributes.get("value", "/")).is_absolute():
            value = _from(out, path.parent / e.attributes["value"])
            edits.append((e.begin, e.end, f"<path value={quoteattr(value)}/>"))
    body = every[0].body
    edits.append((body, body, f"\n<path value={quoteattr(_from(out, path.parent))}/>" + "".join(new)))
    return edits


def resolved(path: Path, defines: Mapping[str, str], out: Path) -> bytes:
    """A scene file's text for another folder, with its parameters set: it loads as `path` does with `defines`."""
    source = path.read_bytes()
    return spliced(source, surroundings(source, path, defines, out))


def _from(out: Path, folder: Path) -> str:
    try:
        return Path(os.path.relpath(real_path(folder), real_path(out.parent))).as_posix()
    except ValueError:  # another drive
        return real_path(folder).as_posix()


def spliced(source: bytes, edits: Sequence[Edit]) -> bytes:
    """The text with all edits applied, equal ones once; an end tag follows what is inserted at the same place."""
    result, at = [], 0
    for begin, end, text in sorted(set(edits), key=lambda e: (e[0], e[1], e[2].startswith("</"), e[2])):
        result += [source[at:begin], text.encode()]
        at = end
    return b"".join([*result, source[at:]])
