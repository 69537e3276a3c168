"""Frozen records on disk: arrays as .npy beside one record.json, no pickle.

Only dataclasses that live in mistyle itself are read back, so a forged folder cannot name other code.
"""

import dataclasses
import importlib
import json
from pathlib import Path
from typing import Any

import numpy as np

from mistyle.core import memory
from mistyle.core.errors import InputRefused
from mistyle.files.own import read_own


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
    if isinstance(value, np.ndarray):
        name = f"a{len(arrays):03d}"
        arrays[name] = value
        return {"array": name}
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = {f.name: _pack(getattr(value, f.name), arrays) for f in dataclasses.fields(value)}
        return {"record": f"{type(value).__module__}:{type(value).__qualname__}", "fields": fields}
    if isinstance(value, (tuple, list)):
        return {"tuple" if isinstance(value, tuple) else "list": [_pack(item, arrays) for item in value]}
    if isinstance(value, dict):
        return {"dict": [[key, _pack(item, arrays)] for key, item in value.items()]}
    if isinstance(value, Path):
        return {"path": str(value)}
    if isinstance(value, np.generic):
        return value.item()
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    raise TypeError(f"a {type(value).__name__} cannot be part of a record")


def _unpack(tree: Any, folder: Path) -> Any:
    if not isinstance(tree, dict):
        return tree
    ((kind, value),) = [(k, v) for k, v in tree.items() if k != "fields"]
    if kind == "array":
        if not (isinstance(value, str) and value.isalnum()):
            raise ValueError(f"bad array name {value!r}")
        return memory.load(folder / f"{value}.npy")
    if kind == "record":
        return _class(value)(**{k: _unpack(v, folder) for k, v in tree["fields"].items()})
    if kind in ("tuple", "list"):
        items = [_unpack(item, folder) for item in value]
        return tuple(items) if kind == "tuple" else items
    if kind == "dict":
        return {key: _unpack(item, folder) for key, item in value}
    if kind == "path":
        return Path(value)
    raise ValueError(f"unknown kind '{kind}'")


def _class(name: str) -> type:
    module, _, qualname = name.partition(":")
    if not module.startswith("mistyle."):
        raise ValueError(f"{name} is not a record of mistyle")
    found = getattr(importlib.import_module(module), qualname)
    if not (isinstance(found, type) and dataclasses.is_dataclass(found)):
        raise ValueError(f"{name} is not a record of mistyle")
    return found
