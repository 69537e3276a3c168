"""The plan of a batch: one file that every worker reads.

OUT/plan.json holds the resolved jobs in order; shard number I is job I. Path maps serve workers on machines that see
the files under other paths. A batch works in the folder in which its plan lies: a folder that was moved or copied
continues where it is, and paths inside it follow.
"""

import json
import os
import shlex
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePath
from typing import Any

from mistyle import __version__
from mistyle.batch.jobs_file import Record
from mistyle.batch.names import why_not
from mistyle.core.errors import InputRefused, UsageError
from mistyle.core.names import folded
from mistyle.io.store.output import RECORD, write_file
from mistyle.io.store.trusted_json import read_own
from mistyle.jobs.settings import merge, validate

PLAN = "plan.json"
SHARDS = "shards"
VERSION = 1
MAX_PLAN_BYTES = 1 << 30  # some hundred thousand jobs


@dataclass(frozen=True)
class BatchPlan:
    """The jobs of a batch, and the parent of their run folders.

    `left_out` are sentences on files of a folder that take no part. plan.json does not hold the last three: `overwrite`
    allows this call to replace files that are not mistyle's, `moved_from` is the folder in which the plan was written,
    where that is another one, and `notes` are due before anything runs.
    """

    out: Path
    jobs: tuple[Record, ...]
    left_out: tuple[str, ...] = ()
    overwrite: bool = False
    moved_from: Path | None = None
    notes: tuple[str, ...] = ()


def write_plan(plan: BatchPlan) -> Path:
    """Write OUT/plan.json; equal jobs give equal bytes. An edited plan is set aside; UsageError for a user's file."""
    values = {
        "version": VERSION,
        "mistyle": __version__,
        "out": str(plan.out.absolute()),
        "jobs": [job.model_dump(mode="json") for job in plan.jobs],
    } | ({"left_out": plan.left_out} if plan.left_out else {})
    write_file(plan.out, PLAN, (json.dumps(values, indent=1, sort_keys=True) + "\n").encode(), overwrite=plan.overwrite)
    return plan.out / PLAN


def read_plan(path: Path, maps: Sequence[tuple[str, str]] = ()) -> BatchPlan:
    """A plan (the file or its folder), with its paths mapped to this machine. Raises InputRefused or UsageError.

    Where no map decides the batch's folder, it is the one in which the plan lies, if that is a batch's folder. A plan
    alone, as a queue copies it, writes where it was made for.
    """
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
    out = replaced(str(values["out"]), maps)
    left_out = values.get("left_out")
    plan = BatchPlan(Path(out), jobs, tuple(map(str, left_out)) if isinstance(left_out, list) else ())
    return plan if out != str(values["out"]) else _where_it_lies(plan, path.parent.absolute())


def _where_it_lies(plan: BatchPlan, here: Path) -> BatchPlan:
    """The plan of the folder `here`; if that is a batch's own, which was moved, paths inside the old folder follow."""
    old = plan.out
    if os.path.realpath(old) == os.path.realpath(here) or (old.exists() and old.samefile(here)) or _alone(here):
        return plan
    spellings = dict.fromkeys((str(old), os.path.normpath(old), os.path.realpath(old)))
    maps = [(spelling, str(here)) for spelling in spellings]

    def follow(text: str) -> str:
        plain = os.path.normpath(text) if os.path.isabs(text) else text  # may be spelled JOBS/../OUT/
        moved = replaced(plain, maps)
        if moved == plain and os.path.isabs(plain) and not os.path.lexists(plain):
            # The whole project may have moved: inputs then lie beside the batch as they did before.
            beside = os.path.normpath(here / os.path.relpath(plain, old))
            return beside if os.path.lexists(beside) else text
        return text if moved == plain else moved

    return replace(plan, out=here, jobs=tuple(with_paths(job, follow) for job in plan.jobs), moved_from=old)


def _alone(here: Path) -> bool:
    """Whether a folder has nothing else of a batch than a copy of its plan."""
    return not (here / SHARDS).is_dir() and not (here / RECORD).is_file()


def check_alone(path: Path, plan: BatchPlan) -> None:
    """UsageError where `path` is a copy of a plan alone: its finished jobs lie elsewhere."""
    here = path.absolute() if path.is_dir() else path.absolute().parent
    if os.path.realpath(here) != os.path.realpath(plan.out) and (plan.out / PLAN).is_file() and _alone(here):
        raise UsageError(
            f"{here / PLAN}: this is a copy of a plan whose batch is in {plan.out}, not in {here}. Resume it there "
            f"(mistyle batch {shlex.quote(str(plan.out))}), or copy its whole folder"
        )


def check_names(plan: BatchPlan) -> None:
    """UsageError where a job of an older or edited plan has the name of one of the batch's own files."""
    known = {folded(job.name) for job in plan.jobs}
    for job in plan.jobs:
        if reason := why_not(job.name, known):
            raise UsageError(f"{plan.out / PLAN}: {reason} in the jobs file, and write the plan anew from it")


def check_moved(plan: BatchPlan) -> None:
    """InputRefused where a moved batch has lost inputs: they lie neither where they were nor as they did beside it."""
    if plan.moved_from is None:
        return
    lost = list(dict.fromkeys(str(path) for job in plan.jobs for path in inputs_of(job) if not path.exists()))
    if lost:
        raise InputRefused(
            f"{plan.out}: this batch was made in {plan.moved_from}; {len(lost)} of its inputs are not where its plan "
            f"expects them, first {lost[0]}. Move them back, or write the plan anew from the jobs file: "
            f"mistyle batch JOBS -o {shlex.quote(str(plan.out))} (jobs whose files are the same stay done)"
        )


def inputs_of(job: Record) -> list[Path]:
    """The mesh of a job, and its style or references."""
    return [path for path in (job.mesh, job.style, job.references) if path is not None]


def mapped(job: Record, maps: Sequence[tuple[str, str]]) -> Record:
    """A job with all paths mapped, also those inside its settings."""
    return with_paths(job, lambda text: replaced(text, maps)) if maps else job


def with_paths(job: Record, change: Callable[[str], str]) -> Record:
    """A job with all its paths changed, also the texts of its settings, which may be paths."""
    changed: dict[str, Any] = {"settings": _with_texts(job.settings, change)}
    for name in ("mesh", "style", "references", "masks", "exposure"):
        value = getattr(job, name)
        if value is not None:
            changed[name] = Path(change(str(value)))
    if job.lights not in (None, "unknown"):
        changed["lights"] = change(str(job.lights))
    return job.model_copy(update=changed)


def _with_texts(value: Any, change: Callable[[str], str]) -> Any:
    if isinstance(value, dict):
        return {k: _with_texts(v, change) for k, v in value.items()}
    if isinstance(value, list):
        return [_with_texts(v, change) for v in value]
    return change(value) if isinstance(value, str) else value


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
