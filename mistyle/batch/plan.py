"""The plan of a batch: one file that every worker reads.

OUT/plan.json holds the resolved jobs in order; shard number I is job I. Path maps serve workers on machines that see
the files under other paths.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePath
from typing import Any

from mistyle import __version__
from mistyle.batch.jobs_file import Record
from mistyle.core.errors import InputRefused, UsageError
from mistyle.io.store.output import write_file
from mistyle.io.store.trusted_json import read_own
from mistyle.jobs.settings import merge, validate

PLAN = "plan.json"
VERSION = 1
MAX_PLAN_BYTES = 1 << 30  # some hundred thousand jobs


@dataclass(frozen=True)
class BatchPlan:
    """The jobs of a batch, and the parent of their run folders.

    `overwrite` allows this call to replace files in it that are not mistyle's; plan.json does not hold it.
    """

    out: Path
    jobs: tuple[Record, ...]
    overwrite: bool = False


def write_plan(plan: BatchPlan) -> Path:
    """Write OUT/plan.json; equal jobs give equal bytes. An edited plan is set aside; UsageError for a user's file."""
    values = {
        "version": VERSION,
        "mistyle": __version__,
        "out": str(plan.out.absolute()),
        "jobs": [job.model_dump(mode="json") for job in plan.jobs],
    }
    write_file(plan.out, PLAN, (json.dumps(values, indent=1, sort_keys=True) + "\n").encode(), overwrite=plan.overwrite)
    return plan.out / PLAN


def read_plan(path: Path, maps: Sequence[tuple[str, str]] = ()) -> BatchPlan:
    """A plan (the file or its folder), with its paths mapped to this machine. Raises InputRefused or UsageError."""
    path = path / PLAN if path.is_dir() else path
    try:
        values = read_own(path, MAX_PLAN_BYTES)
    except FileNotFoundError:
        raise InputRefused(f"{path}: found nothing, expected the plan that `mistyle batch` writes") from None
    except (OSError, ValueError) as error:
        raise InputRefused(f"{path}: not a plan: {error}") from None
    if not isinstance(values, dict) or values.get("version") != VERSION or not isinstance(values.get("jobs"), list):
        raise InputRefused(f"{path}: found no plan of version {VERSION}; write it again with `mistyle batch`")
    jobs = tuple(mapped(validate(job, str(path), Record), maps) for job in values["jobs"])
    return BatchPlan(Path(replaced(str(values["out"]), maps)), jobs)


def mapped(job: Record, maps: Sequence[tuple[str, str]]) -> Record:
    """A job with all paths mapped, also those inside its settings."""
    if not maps:
        return job
    changed: dict[str, Any] = {"settings": _mapped_values(job.settings, maps)}
    for name in ("mesh", "style", "references", "masks", "exposure"):
        value = getattr(job, name)
        if value is not None:
            changed[name] = Path(replaced(str(value), maps))
    if job.lights not in (None, "unknown"):
        changed["lights"] = replaced(str(job.lights), maps)
    return job.model_copy(update=changed)


def _mapped_values(value: Any, maps: Sequence[tuple[str, str]]) -> Any:
    if isinstance(value, dict):
        return {k: _mapped_values(v, maps) for k, v in value.items()}
    if isinstance(value, list):
        return [_mapped_values(v, maps) for v in value]
    return replaced(value, maps) if isinstance(value, str) else value


def replaced(text: str, maps: Sequence[tuple[str, str]]) -> str:
    """The path `text` with its longest mapped parent folder replaced; only whole path components match."""
    for source, target in sorted(maps, key=lambda pair: -len(pair[0])):
        start = source.rstrip("/\\")
        rest = text[len(start) :]
        if text.startswith(start) and (not rest or rest[0] in "/\\"):
            return target.rstrip("/\\") + rest.replace("\\", "/")
    return text


def path_maps(pairs: Sequence[str]) -> tuple[tuple[str, str], ...]:
    """`--path-map FROM=TO` as pairs. Raises UsageError."""
    result = []
    for pair in pairs:
        source, equals, target = pair.partition("=")
        absolute = PurePath(source).is_absolute() or source[1:3] in (":\\", ":/") or source.startswith("\\\\")
        if not equals or not target or not absolute:
            raise UsageError(f"--path-map {pair}: expected FROM=TO with FROM absolute, for example /mnt/show=/vol/show")
        result.append((source, target))
    return tuple(result)


def indices(text: str, count: int) -> tuple[int, ...]:
    """'3', '0-7' or '0-3,8' as numbers, in order. Raises UsageError."""
    numbers: list[int] = []
    for piece in text.split(","):
        first, dash, last = piece.strip().partition("-")
        if not first.isdigit() or (dash and not last.isdigit()):
            raise UsageError(f"--index {text}: expected numbers such as 3, 0-7 or 0-3,8")
        numbers += range(int(first), int(last if dash else first) + 1)
    missing = [n for n in numbers if n >= count]
    if missing:
        raise UsageError(f"--index {text}: the plan has {count} shards, numbered from 0; found {missing[0]}")
    return tuple(dict.fromkeys(numbers))


def with_delivery(plan: BatchPlan, delivery: Mapping[str, Any]) -> BatchPlan:
    """The plan with the command line's delivery settings in every job. UsageError where a job cannot deliver."""
    from mistyle.deliver import export as deliver
    from mistyle.fitting.settings.material import MaterialSettings
    from mistyle.stylization.settings import Settings

    if not delivery:
        return plan
    jobs = []
    for job in plan.jobs:
        root = MaterialSettings if job.kind == "fit" else Settings
        settings = validate(merge(job.settings, delivery), "command line", root)
        deliver.check(settings)
        jobs.append(job.model_copy(update={"settings": settings.model_dump(mode="json")}))
    return replace(plan, jobs=tuple(jobs))
