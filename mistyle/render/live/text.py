"""The text of a Mitsuba scene file: position and replacement of a parameter's element."""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any
from xml.sax.saxutils import quoteattr

import numpy as np

from mistyle.io.scene_source import Edit, Element, elements_of
from mistyle.render.live.parameters import Parameter
from mistyle.render.mitsuba.device import mi

# Plugins that read two indices of refraction; `mi.traverse` has their ratio `eta`.
TWO_INDICES = {"dielectric", "roughdielectric", "thindielectric", "plastic", "roughplastic", "pplastic", "hair"}
# A property whose default depends on another's, and the other: a file must hold both, or neither.
PARTNERS = {("conductor", "eta"): "k", ("conductor", "k"): "eta", ("spot", "cutoff_angle"): "beam_width"}
PARTNERS |= {("roughconductor", name): other for (plugin, name), other in PARTNERS.items() if plugin == "conductor"}
# Names of children in `mi.traverse` and in the file, and of children that need no name there.
READ_AS = {"interior_medium": "interior", "exterior_medium": "exterior"}
KINDS = {"bsdf": "BSDF", "brdf": "BSDF", "nested_bsdf": "BSDF", "emitter": "Emitter", "phase": "PhaseFunction"}
KINDS |= {"phase_function": "PhaseFunction", "normalmap": "Texture", "nested_texture": "Texture", "shape": "Shape"}


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
        # A plugin that is a literal in other words (a d65 spectrum) is replaced as a whole.
        while left and left[1:] != ["value"] and (inner := _child(state, node, left[0])) is not None:
            node, left = state.nodes[inner], left[1:]
        if left == ["data"]:
            return node, None
        if left and set(left[1:]) <= {"value"}:
            return node, left[0]
    return None


def _child(state: Any, node: Any, name: str) -> int | None:
    """The child with the `mi.traverse` name `name`: by its name in the file, else the n-th material, the emitter, …"""
    held = children(node)
    for called, index in held:
        if called == READ_AS.get(name, name):
            return index
    stem, number = re.fullmatch(r"(.*?)(?:_(\d+))?", name).groups()  # pyright: ignore[reportOptionalMemberAccess]
    fitting = [index for _, index in held if state.nodes[index].type.name == KINDS.get(stem)]
    place = int(number or 0)
    return fitting[place] if place < len(fitting) else None


def edits_of(
    state: Any, sources: Sequence[bytes], p: Parameter, values: Any, file: Path | None
) -> tuple[int, list[Edit]] | str:
    """The number of the file and its edits for one parameter, or the reason why it cannot be written.

    `sources` are the texts of `state.files`: the scene's, then its includes. `values` is the scene's
    `mi.traverse` table.
    """
    place = _find(state, p)
    if place is None:
        return "its element could not be distinguished from the others."
    node, literal = place
    elements = elements_of(sources[node.file_index])
    at = next((k for k, e in enumerate(elements) if e.begin == node.offset - 1), None)
    if at is None:
        return "its element could not be found in the text."
    if literal is None:
        # An 8-bit or 16-bit format would round the file's values.
        edits = _file_edits(elements, at, file, "format")
        edits = edits or "its texture has no file name that could be replaced."
    elif p.kind == "attribute":
        # The written mesh's vertices are in world space already.
        edits = _file_edits(elements, at, file, "to_world") if elements[at].attributes.get("type") == "ply" else []
        where = file.name if file else "nothing"
        edits = edits or f"only a mesh that comes from a PLY can be replaced; it was written as {where}."
    elif p.kind != "value":
        return f"a scene file cannot store it; it was written as {file.name if file else 'nothing'}."
    else:
        edits = _literal_edits(elements, at, _properties(node, literal, p, values))
    return edits if isinstance(edits, str) else (node.file_index, edits)


def _properties(node: Any, literal: str, p: Parameter, values: Any) -> dict[str, np.ndarray | None]:
    """The numbers of the properties that the plugin reads for a parameter; None: without the property."""
    plugin, own = node.props.plugin_name(), np.array(values[p.key], np.float64).ravel()
    if literal == "eta" and plugin in TWO_INDICES:
        return {"int_ior": own * _outside(node.props["ext_ior"] if "ext_ior" in node.props else "air")}
    result: dict[str, np.ndarray | None] = {literal: own}
    partner = PARTNERS.get((plugin, literal))
    if partner is not None and partner not in node.props:
        stem, leaf = p.key.rsplit(f".{literal}", 1)
        result[partner] = np.array(values[f"{stem}.{partner}{leaf}"], np.float64).ravel()
    if partner is not None and "material" in node.props:
        result["material"] = None
    return result


def _outside(index: float | str) -> float:
    """An index of refraction, given as a number or as one of Mitsuba's names."""
    glass: Any = mi.load_dict({"type": "dielectric", "int_ior": 1.0, "ext_ior": index})
    return 1 / float(mi.traverse(glass)["eta"])


def _file_edits(elements: Sequence[Element], at: int, file: Path | None, dropped: str) -> list[Edit]:
    """The written file replaces an element's, whose property `dropped` goes; none where there is no such file."""
    inner = {e.attributes.get("name"): e for e in elements if e.parent == at}
    if file is None or "filename" not in inner:
        return []
    old = inner["filename"]
    gone = [(inner[dropped].begin, inner[dropped].end, "")] if dropped in inner else []
    return [(old.begin, old.end, f'<string name="filename" value={quoteattr(file.name)}/>'), *gone]


def _literal_edits(
    elements: Sequence[Element], at: int, properties: Mapping[str, np.ndarray | None]
) -> list[Edit] | str:
    """Set or remove properties of one element."""
    element, inner = elements[at], {e.attributes.get("name"): e for e in elements if e.parent == at}
    edits: list[Edit] = []
    for name, numbers in properties.items():
        old = inner.get(name)
        if numbers is None:
            edits += [(old.begin, old.end, "")] if old is not None else []
            continue
        tag = {1: "float", 3: "rgb"}.get(len(numbers))
        if old is not None and old.tag == "string" and name == "values":  # of a tabulated phase function
            tag = "string"
        if tag is None or (old is not None and old.tag == "ref"):
            return f"it has {len(numbers)} numbers." if tag is None else "another element also refers to its spectrum."
        shown = quoteattr((", " if tag == "string" else " ").join(f"{v:.9g}" for v in numbers))
        text = f"<{tag} name={quoteattr(name)} value={shown}/>"
        if old is not None:
            edits.append((old.begin, old.end, text))
        elif element.body != element.end:
            edits.append((element.body, element.body, text))
        else:  # <bsdf/> becomes <bsdf>…</bsdf>
            slash = (element.end - 2, element.end - 1, "")
            edits += [slash, (element.end, element.end, text), (element.end, element.end, f"</{element.tag}>")]
    return edits
