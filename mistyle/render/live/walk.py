"""The plugins of a live Mitsuba scene and all paths to them; `mi.traverse` keeps only the first path."""

import re
from collections.abc import Iterable
from typing import Any

from mistyle.render.mitsuba.device import mi

MAX_NAMES = 64


def children(scene: Any) -> dict[Any, list[tuple[str, Any]]]:
    """Every plugin's children with their names, each child once per plugin."""

    class Listing(mi.TraversalCallback):
        def __init__(self) -> None:
            super().__init__()
            self.names: dict[Any, str] = {}

        def put(self, name: str, value: Any, flags: Any, cpptype: Any = None) -> None:
            if isinstance(value, mi.Object):
                self.put_object(name, value, flags)

        def put_object(self, name: str, obj: Any, flags: Any) -> None:
            if obj is not None:
                self.names.setdefault(obj, name)

        def put_value(self, name: str, ptr: Any, flags: Any, cpptype: Any = None) -> None:
            pass

    result: dict[Any, list[tuple[str, Any]]] = {}
    left = [scene]
    while left:
        node = left.pop()
        if node in result:
            continue
        listing = Listing()
        node.traverse(listing)
        result[node] = [(name, child) for child, name in listing.names.items()]
        left.extend(listing.names)
    return result


def ways(scene: Any, held: dict[Any, list[tuple[str, Any]]]) -> dict[Any, list[str]]:
    """Every plugin's paths from the root, at most MAX_NAMES each; addresses become "unnamed1", "unnamed2", …"""
    unnamed: dict[str, str] = {}
    paths: dict[Any, list[str]] = {scene: [""]}

    def walk(node: Any, way: str, above: frozenset) -> None:
        taken: dict[str, int] = {}
        for name, child in held[node]:
            if re.fullmatch(r"object_\d+", name):
                name = unnamed.setdefault(name, f"unnamed{len(unnamed) + 1}")
            taken[name] = taken.get(name, 0) + 1
            if taken[name] > 1:
                name = f"{name}_{taken[name] - 1}"
            path = f"{way}.{name}" if way else name
            known = paths.setdefault(child, [])
            if child in above or path in known or len(known) >= MAX_NAMES:
                continue
            known.append(path)
            walk(child, path, above | {child})

    walk(scene, "", frozenset([scene]))
    return paths


def names(paths: Iterable[str]) -> tuple[str, ...]:
    """The paths, those with an address last, and each without the wrappers around its material."""
    ordered = sorted(dict.fromkeys(paths), key=lambda path: path.startswith("unnamed"))
    short = [re.sub(r"\.(brdf_0|nested_bsdf)(?=\.)", "", path) for path in ordered]
    return tuple(dict.fromkeys([*ordered, *short]))
