"""Regression suites: a folder of approved pictures, and how a new picture gets into it."""

import json
from collections.abc import Sequence
from datetime import UTC, datetime
from fnmatch import fnmatchcase
from pathlib import Path

from mistyle.core.errors import UsageError
from mistyle.files.store import atomic_write, sha256_file
from mistyle.run.compare_inputs import ENDINGS, pictures_of

RECORD = "approved.json"


def approve(baseline: Path, tests: Path, patterns: Sequence[str]) -> list[str]:
    """Copy the pictures of `tests` whose names fit one of `patterns` into `baseline`; returns their names.

    approved.json there notes the sha256 and the time of each. An older picture of the same name goes, whatever its
    ending was. UsageError where a pattern fits nothing.
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
    for name in chosen:
        target = baseline / f"{name}{there[name].suffix.lower()}"
        target.parent.mkdir(parents=True, exist_ok=True)
        atomic_write(target, there[name].read_bytes())
        for old in target.parent.glob("*"):
            if old.is_file() and old != target and old.with_suffix("") == target.with_suffix("") and _picture(old):
                old.unlink()
        noted[name] = {
            "sha256": sha256_file(target),
            "approved": datetime.now(UTC).isoformat(timespec="seconds"),
        }
    atomic_write(baseline / RECORD, (json.dumps(noted, indent=1, sort_keys=True) + "\n").encode())
    return chosen


def _picture(path: Path) -> bool:
    return path.suffix.lower() in ENDINGS


def _some(names: Sequence[str] | dict) -> str:
    found = sorted(names)
    return ", ".join(found[:5]) + (", …" if len(found) > 5 else "") if found else "none"


def _read(baseline: Path) -> dict[str, dict[str, str]]:
    from mistyle.files.read import read_json

    path = baseline / RECORD
    return read_json(path) if path.is_file() else {}
