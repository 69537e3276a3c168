"""Frozen records as trees of plain JSON, for the disk (records.py) and the reader process (io/sandbox/rpc_codec.py).

The caller handles arrays and the names of classes.
"""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

Leaf = dict[str, Any]


# Plain recursion without inner functions: a self-referencing closure would hold the arrays until garbage collection.
def to_tree(value: Any, leaf: Callable[[Any], Leaf | None], name_of: Callable[[Any], str]) -> Any:
    """`value` as JSON. `leaf` gives the node of an array and the like, None for other values; `name_of` the name of a
    record's class, or TypeError for other values."""
    if value is None or isinstance(value, bool | str | int | float):
        return value
    node = leaf(value)
    if node is not None:
        return node
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, Path):
        return {"path": str(value)}
    if isinstance(value, tuple | list):
        kind = "tuple" if isinstance(value, tuple) else "list"
        return {kind: [to_tree(item, leaf, name_of) for item in value]}
    if isinstance(value, dict):
        pairs = value.items()
        return {"dict": [[to_tree(key, leaf, name_of), to_tree(item, leaf, name_of)] for key, item in pairs]}
    name = name_of(value)
    fields = {f.name: to_tree(getattr(value, f.name), leaf, name_of) for f in dataclasses.fields(value)}
    return {"record": name, "fields": fields}


def from_tree(tree: Any, leaf: Callable[[str, Any], Any], class_of: Callable[[str], type]) -> Any:
    """The inverse of `to_tree`, with inverse `leaf` and `class_of`. ValueError, KeyError, TypeError or AttributeError
    for an invalid tree."""
    if isinstance(tree, list):
        raise ValueError("a bare list")
    if not isinstance(tree, dict):
        return tree
    if "record" in tree:
        fields = {key: from_tree(item, leaf, class_of) for key, item in tree["fields"].items()}
        return class_of(tree["record"])(**fields)
    ((kind, inner),) = tree.items()
    if kind == "path":
        return Path(inner)
    if kind in ("tuple", "list"):
        items = [from_tree(item, leaf, class_of) for item in inner]
        return tuple(items) if kind == "tuple" else items
    if kind == "dict":
        return {from_tree(key, leaf, class_of): from_tree(item, leaf, class_of) for key, item in inner}
    return leaf(kind, inner)
