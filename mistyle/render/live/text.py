"""The text of a Mitsuba scene file: position and replacement of a parameter's element."""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any
from xml.sax.saxutils import quoteattr

import numpy as np

from mistyle.render.live.parameters import Parameter
from mistyle.render.live.source import Edit, Element, elements_of
from mistyle.render.mitsuba.device import mi


def children(node: Any) -> list[tuple[str, int]]:
    """Property names and node numbers of a parsed node's children, in the file's order."""
    kind = mi.Properties.Type.ResolvedReference
    return [(name, node.props[name].index()) for name in node.props.keys() if node.props.type(name) == kind]


def _find(state: Any, p: Parameter) -> tuple[Any, str | None] | None:
    """The parsed node of a parameter's texture, or the node and the name of its literal."""
    roots = {state.nodes[index].props.id(): index for _, index in children(state.nodes[0])}
    for name in p.names:
        head, *parts = name.split(".")
        if head not in roots:
            continue
        node, left = state.nodes[roots[head]], parts
        while left:
            inner = _child(state, node, left[0])
            if inner is None:
                break
            node, left = state.nodes[inner], left[1:]
            if left == ["value"]:  # a literal that is spelt as a plugin
                return None
        if left == ["data"]:
            return node, None
        if len(left) == 1 or (len(left) == 2 and left[1] == "value"):
            return node, left[0]
    return None


def _child(state: Any, node: Any, name: str) -> int | None:
    """The child with the `mi.traverse` name `name`: by its name in the file, else the n-th material, the emitter, …"""
    held = children(node)
    for called, index in held:
        if called == name:
            return index
    stem, number = re.fullmatch(r"(.*?)(?:_(\d+))?", name).groups()  # pyright: ignore[reportOptionalMemberAccess]
    kinds = {"bsdf": mi.ObjectType.BSDF, "brdf": mi.ObjectType.BSDF, "nested_bsdf": mi.ObjectType.BSDF}
    kinds |= {"emitter": mi.ObjectType.Emitter, "normalmap": mi.ObjectType.Texture, "shape": mi.ObjectType.Shape}
    fitting = [index for _, index in held if state.nodes[index].type == kinds.get(stem)]
    place = int(number or 0)
    return fitting[place] if place < len(fitting) else None


def edits_of(
    state: Any, sources: Sequence[bytes], p: Parameter, values: np.ndarray, file: Path | None
) -> tuple[int, list[Edit]] | str:
    """The number of the file and its edits for one parameter, or the reason why it cannot be written.

    `sources` are the texts of `state.files`: the scene's, then its includes.
    """
    place = _find(state, p)
    if place is None:
        return "its element could not be distinguished from the others."
    node, literal = place
    edits = _edits(node, literal, sources[node.file_index], p, values, file)
    return edits if isinstance(edits, str) else (node.file_index, edits)


def _edits(
    node: Any, literal: str | None, source: bytes, p: Parameter, values: np.ndarray, file: Path | None
) -> list[Edit] | str:
    elements = elements_of(source)
    at = next((k for k, e in enumerate(elements) if e.begin == node.offset - 1), None)
    if at is None:
        return "its element could not be found in the text."
    inner = {e.attributes.get("name"): e for e in elements if e.parent == at}
    if literal is None:
        if file is None or "filename" not in inner:
            return "its texture has no file name that could be replaced."
        old = inner["filename"]
        edits = [(old.begin, old.end, f'<string name="filename" value={quoteattr(file.name)}/>')]
        # An 8-bit or 16-bit format would round the file's values.
        return edits + [(inner[name].begin, inner[name].end, "") for name in ("format",) if name in inner]
    if p.kind == "attribute":
        return _mesh_edits(elements, at, file)
    if p.kind != "value":
        return f"a scene file cannot store it; it was written as {file.name if file else 'nothing'}."
    old = inner.get(literal)
    numbers = " ".join(f"{float(v):.9g}" for v in values)
    tag = "rgb" if len(values) == 3 else "float"
    if len(values) not in (1, 3):
        return f"it has {len(values)} numbers."
    text = f"<{tag} name={quoteattr(literal)} value={quoteattr(numbers)}/>"
    if old is not None:
        return [(old.begin, old.end, text)]
    element = elements[at]
    if element.body != element.end:
        return [(element.body, element.body, text)]
    return [(element.end - 2, element.end, f">{text}</{element.tag}>")]


def _mesh_edits(elements: Sequence[Element], at: int, file: Path | None) -> list[Edit] | str:
    """The written mesh replaces a PLY mesh; its vertices are in world space already."""
    inner = {e.attributes.get("name"): e for e in elements if e.parent == at}
    if file is None or elements[at].attributes.get("type") != "ply" or "filename" not in inner:
        return (
            f"only a mesh that comes from a PLY can be replaced; it was written as {file.name if file else 'nothing'}."
        )
    old = inner["filename"]
    moved = [(inner["to_world"].begin, inner["to_world"].end, "")] if "to_world" in inner else []
    return [(old.begin, old.end, f'<string name="filename" value={quoteattr(file.name)}/>'), *moved]
