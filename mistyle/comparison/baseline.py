"""Regression suites: a folder of approved pictures, and how a new picture gets into it."""

import json
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from fnmatch import fnmatchcase
from pathlib import Path

from mistyle.comparison.inputs import ENDINGS, pictures_of
from mistyle.core.errors import UsageError
from mistyle.io.store.atomic import atomic_write, sha256_file

RECORD = "approved.json"


def approve(baseline: Path, tests: Path, patterns: Sequence[str], *, overwrite: bool = False) -> list[str]:
    """Copy the pictures of `tests` whose names fit one of `patterns` into `baseline`; returns their names.

    approved.json there notes the sha256 and the time of each. An older picture of the same name goes, whatever its
    ending was. UsageError where a pattern fits nothing, and where an older picture is not as an approval left it,
    unless `overwrite`.
    """
    if not tests.is_dir():
        raise UsageError(f"--approve takes pictures out of a folder; {tests} is none")
    there = pictures_of(tests)
    chosen: list[str] = []
    for pattern in patterns:
        fitting = [name for name in there if fnmatchcase(name, pattern)]
        if not fitting:
            raise UsageError(f"--approve {pattern}: no picture of {tests} is called so; there are {_some(there)}")
        chosen += [name for name in fitting if name not in chosen]
    noted = _read(baseline)
    older = {name: _older(baseline / name) for name in chosen}
    if not overwrite:
        _refuse_unknown(older, noted)
    for name in chosen:
        target = baseline / f"{name}{there[name].suffix.lower()}"
        atomic_write(target, there[name].read_bytes())
        for old in older[name]:
            if old != target:
                old.unlink()
        noted[name] = {
            "sha256": sha256_file(target),
            "approved": datetime.now(UTC).isoformat(timespec="seconds"),
        }
    atomic_write(baseline / RECORD, (json.dumps(noted, indent=1, sort_keys=True) + "\n").encode())
    return chosen


def _older(stem: Path) -> list[Path]:
    """The pictures that are called like this one but for the ending."""
    if not stem.parent.is_dir():
        return []
    return [p for p in sorted(stem.parent.iterdir()) if p.suffix.lower() in ENDINGS and p.with_suffix("") == stem]


def _refuse_unknown(older: Mapping[str, Sequence[Path]], noted: Mapping[str, Mapping[str, str]]) -> None:
    """UsageError for the first picture that no approval wrote, or that has changed since."""
    for name, pictures in older.items():
        for path in pictures:
            if sha256_file(path) != noted.get(name, {}).get("sha256"):
                raise UsageError(
                    f"{path}: no approval wrote this picture as it is ({RECORD} does not list it so), and it would be "
                    "replaced. Move it away, or replace it with --overwrite"
                )


def _some(names: Sequence[str] | dict) -> str:
    found = sorted(names)
    return ", ".join(found[:5]) + (", …" if len(found) > 5 else "") if found else "none"


def _read(baseline: Path) -> dict[str, dict[str, str]]:
    from mistyle.io.read import read_json

    path = baseline / RECORD
    return read_json(path) if path.is_file() else {}
