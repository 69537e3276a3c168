"""Frozen records on disk: arrays as .npy beside one record.json, without pickle.

Only dataclasses of mistyle itself are read back, so a forged folder cannot name other code.
"""

import dataclasses
import importlib
import json
from pathlib import Path
from typing import Any

import numpy as np

from mistyle.core.errors import InputRefused
from mistyle.io.store.record_tree import from_tree, to_tree
from mistyle.io.store.trusted_json import read_own
from mistyle.process import memory


def save_record(folder: Path, record: Any) -> None:
    """Write a dataclass, or a tuple, list or dict of such, with all its arrays into `folder`."""
    arrays: dict[str, np.ndarray] = {}
    tree = _pack(record, arrays)
    folder.mkdir(parents=True, exist_ok=True)
    for name, array in arrays.items():
        np.save(folder / f"{name}.npy", array, allow_pickle=False)
    (folder / "record.json").write_text(json.dumps(tree, indent=1), encoding="utf-8")


def load_record(folder: Path) -> Any:
    """The record that `save_record` wrote into `folder`."""
    path = folder / "record.json"
    try:
        return _unpack(read_own(path), folder)
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputRefused(
            f"{path}: not a record of this version of mistyle ({error}); delete the folder and run again"
        ) from error


def _pack(value: Any, arrays: dict[str, np.ndarray]) -> Any:
    """The tree of a value; its arrays are added to `arrays` under new names."""

    def leaf(value: Any) -> dict[str, Any] | None:
        if not isinstance(value, np.ndarray):
            return None
        name = f"a{len(arrays):03d}"
        arrays[name] = value
        return {"array": name}

    return to_tree(value, leaf, _name)


def _name(value: Any) -> str:
    if not dataclasses.is_dataclass(value) or isinstance(value, type):
        raise TypeError(f"a {type(value).__name__} cannot be part of a record")
    return f"{type(value).__module__}:{type(value).__qualname__}"


def _unpack(tree: Any, folder: Path) -> Any:
    def leaf(kind: str, value: Any) -> Any:
        if kind != "array":
            raise ValueError(f"unknown kind '{kind}'")
        if not (isinstance(value, str) and value.isalnum()):
            raise ValueError(f"bad array name {value!r}")
        return memory.load(folder / f"{value}.npy")

    return from_tree(tree, leaf, _class)


def _class(name: str) -> type:
    module, _, qualname = name.partition(":")
    if not module.startswith("mistyle."):
        raise ValueError(f"{name} is not a record of mistyle")
    record_class = getattr(importlib.import_module(module), qualname)
    if not (isinstance(record_class, type) and dataclasses.is_dataclass(record_class)):
        raise ValueError(f"{name} is not a record of mistyle")
    return record_class
