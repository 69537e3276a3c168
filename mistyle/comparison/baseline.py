"""Regression suites: a folder of approved pictures, and the approval of new ones."""

import json
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from fnmatch import fnmatchcase
from pathlib import Path

from mistyle.comparison.frames import ENDINGS, pictures_of
from mistyle.core.errors import UsageError
from mistyle.io.store.atomic import atomic_write, sha256_file

RECORD = "approved.json"


def approve(baseline: Path, tests: Path, patterns: Sequence[str], *, overwrite: bool = False) -> list[str]:
    """Copy the pictures of `tests` whose names match one of `patterns` into `baseline`; returns their names.

    approved.json in `baseline` records the sha256 and the time of each. Older pictures of the same name are removed,
    whatever their extension. UsageError where a pattern matches nothing, and, without `overwrite`, where an older
    picture has changed since its approval.
    """
    if not tests.is_dir():
        raise UsageError(f"--approve takes pictures from a folder; {tests} is not a folder")
    available = {name: files[0] for name, files in pictures_of(tests).items()}
    chosen: list[str] = []
    for pattern in patterns:
        matching = [name for name in available if fnmatchcase(name, pattern)]
        if not matching:
            raise UsageError(
                f"--approve {pattern}: no picture of {tests} has this name; it has {_first_names(available)}"
            )
        chosen += [name for name in matching if name not in chosen]
    approvals = _read(baseline)
    older = {name: _same_stem(baseline / name) for name in chosen}
    if not overwrite:
        _refuse_unknown(older, approvals)
    for name in chosen:
        target = baseline / f"{name}{available[name].suffix.lower()}"
        atomic_write(target, available[name].read_bytes())
        for old in older[name]:
            if old != target:
                old.unlink()
        approvals[name] = {
            "sha256": sha256_file(target),
            "approved": datetime.now(UTC).isoformat(timespec="seconds"),
        }
    atomic_write(baseline / RECORD, (json.dumps(approvals, indent=1, sort_keys=True) + "\n").encode())
    return chosen


def _same_stem(stem: Path) -> list[Path]:
    """The pictures of this name with any extension."""
    if not stem.parent.is_dir():
        return []
    return [p for p in sorted(stem.parent.iterdir()) if p.suffix.lower() in ENDINGS and p.with_suffix("") == stem]


def _refuse_unknown(older: Mapping[str, Sequence[Path]], approvals: Mapping[str, Mapping[str, str]]) -> None:
    """UsageError for the first picture without an approval, or changed since its approval."""
    for name, pictures in older.items():
        for path in pictures:
            if sha256_file(path) != approvals.get(name, {}).get("sha256"):
                raise UsageError(
                    f"{path}: no approval wrote this picture in its present form (see {RECORD}), and it would be "
                    "replaced. Move it away, or replace it with --overwrite"
                )


def _first_names(names: Sequence[str] | dict) -> str:
    ordered = sorted(names)
    return ", ".join(ordered[:5]) + (", …" if len(ordered) > 5 else "") if ordered else "none"


def _read(baseline: Path) -> dict[str, dict[str, str]]:
    from mistyle.io.read import read_json

    path = baseline / RECORD
    return read_json(path) if path.is_file() else {}
