"""`mistyle batch`: many jobs in one folder, with a summary of failures and the command that retries them.

OUT/plan.json                    the resolved jobs
OUT/<name>/                      the run folder of each, as `stylize` and `fit` write it
OUT/shards/<name>.json, .log     markers and logs of the workers
OUT/batch.json, OUT/batch.html   the summary, machine-readable and as a page
"""

import json
import os
import shlex
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from mistyle.batch import engines
from mistyle.batch.jobs_file import MOST_LISTED, Record, read_file, resolve, source_of
from mistyle.batch.plan import (
    PLAN,
    SHARDS,
    BatchPlan,
    check_alone,
    check_moved,
    check_names,
    inputs_of,
    read_plan,
    write_plan,
)
from mistyle.batch.shard import claim_batch, finished, job_of, marker, outcome
from mistyle.core.errors import InputRefused, MistyleError, UsageError
from mistyle.core.names import folded
from mistyle.io.store.atomic import clean_leftovers
from mistyle.io.store.keeper import Keeper
from mistyle.io.store.output import keep_folder, write_file
from mistyle.jobs.progress import grouped
from mistyle.process.cores import cores


@dataclass(frozen=True)
class Choices:
    """The options of a batch run."""

    engine: str = "local"
    workers: int = 0
    threads: int = 0
    address: str | None = None
    gpus: float = 0.0
    wait: float = 300.0
    timeout: float | None = None
    only: tuple[str, ...] = ()
    watch: bool = False


def planned(jobs: Path, out: Path | None, choices: Choices) -> BatchPlan:
    """The plan of a jobs file, of a folder of meshes and pictures, or an existing plan (or its folder)."""
    is_plan = jobs.name == PLAN or (jobs.is_dir() and (jobs / PLAN).is_file())
    if is_plan:
        plan = read_plan(jobs)
        check_alone(jobs, plan)
        if out is not None and os.path.realpath(out) != os.path.realpath(plan.out):
            raise UsageError(
                f"{jobs}: this plan writes to {plan.out}; leave out -o, or write a new plan from the jobs file"
            )
        check_names(plan)
        check_moved(plan)
        return plan
    if out is None:
        raise UsageError(f"{jobs}: a new batch needs -o OUT, its output folder")
    before = _plan_in(out)
    file, left_out = read_file(jobs)
    plan = BatchPlan(out.absolute(), resolve(file, jobs, threads_each(choices), _names_of(before)), left_out)
    return replace(plan, notes=tuple(_other_files(plan, before)))


def _plan_in(out: Path) -> tuple[Record, ...]:
    """The jobs of the plan that an output folder has; empty where it has none that can be read."""
    try:
        return read_plan(out / PLAN).jobs
    except (InputRefused, UsageError):
        return ()


def _names_of(jobs: Sequence[Record]) -> dict[tuple[str, str], list[str]]:
    """The names of a plan's jobs by their files, for `names.job_names`."""
    result: dict[tuple[str, str], list[str]] = {}
    for job in jobs:
        result.setdefault(source_of(job).files(), []).append(job.name)
    return result


def _other_files(plan: BatchPlan, before: Sequence[Record]) -> list[str]:
    """Notes on jobs whose folder has results of another mesh or style, by the plan or the marker that it has."""
    known = {folded(job.name): [str(path) for path in inputs_of(job)] for job in before}
    notes = []
    for job in plan.jobs:
        if not (plan.out / job.name).is_dir():
            continue
        was = known.get(folded(job.name)) or outcome(plan, job).told.get("inputs")
        now = [str(path) for path in inputs_of(job)]
        if not was or list(map(os.path.realpath, was)) == list(map(os.path.realpath, now)):
            continue
        if finished(plan, job) is None:  # else the files are the same, in another place
            notes.append(
                f"{job.name}: its folder has results of {' with '.join(was)}; this run replaces them and continues "
                f"their versions with {' with '.join(now)}. Name the job, or choose another -o, to keep both."
            )
    more = len(notes) - MOST_LISTED
    return notes[:MOST_LISTED] + ([f"{more} more folders have results of other files."] if more > 0 else [])


def opening_notes(plan: BatchPlan) -> list[str]:
    """The notes of a plan that are due before anything runs."""
    notes = []
    if plan.moved_from is not None:
        notes.append(f"This batch was made in {plan.moved_from} and is in {plan.out} now; it continues there.")
    return [*notes, *plan.left_out, *plan.notes]


def workers_of(choices: Choices) -> int:
    """Shards at a time: as chosen, else one per two cores, since one job alone does not use many."""
    return choices.workers or max(1, cores() // (choices.threads or 2))


def threads_each(choices: Choices) -> int:
    """Threads of a shard: as chosen, else the cores divided by the workers. A job's result depends on it."""
    return choices.threads or max(1, cores() // workers_of(choices))


def run_batch(plan: BatchPlan, choices: Choices) -> dict[str, Any]:
    """Run every unfinished job of the plan; returns the summary. A failing job never stops the others."""
    known = {job.name for job in plan.jobs}
    unknown = [name for name in choices.only if name not in known]
    if unknown:
        raise UsageError(f"--only {unknown[0]}: no such job; the plan has {', '.join(sorted(known))[:300]}")
    claim_batch(plan)
    start = time.monotonic()
    with Keeper(plan.out / SHARDS, shared=True):
        clean_leftovers(plan.out)
        keep_folder(plan.out, SHARDS)
        write_plan(plan)
        chosen = [k for k, job in enumerate(plan.jobs) if not choices.only or job.name in choices.only]
        todo = [k for k in chosen if finished(plan, plan.jobs[k]) is None]
        for k in todo:
            marker(plan, plan.jobs[k], failed=True).unlink(missing_ok=True)
        ended = {e.index: e for e in _run(plan, todo, choices, len(chosen) - len(todo))}
        summary = summarise(plan, ended, time.monotonic() - start, reused=len(chosen) - len(todo))
        data = (json.dumps(summary, indent=1) + "\n").encode()
        write_file(plan.out, "batch.json", data, overwrite=plan.overwrite)
        from mistyle.batch.page import write_page

        write_page(plan, summary)
    return summary


def _run(plan: BatchPlan, todo: Sequence[int], choices: Choices, reused: int) -> list[engines.Ended]:
    from mistyle.batch.watch import watching

    with watching(plan, todo, reused, live=choices.watch) as watch:
        if not todo:
            return []
        if choices.engine == "ray":
            cluster = engines.RayCluster(choices.address, threads_each(choices), choices.gpus, choices.wait)
            return engines.ray(plan, todo, cluster, watch, choices.timeout)
        return engines.local(plan, todo, min(workers_of(choices), len(todo)), watch, choices.timeout)


def summarise(plan: BatchPlan, ended: dict[int, engines.Ended], seconds: float, reused: int) -> dict[str, Any]:
    """The summary: the state of every job of the plan, and the command that retries the failed ones."""
    rows = [_row(plan, k, job, ended.get(k)) for k, job in enumerate(plan.jobs)]
    failed = [row["name"] for row in rows if row["state"] == "failed"]
    return {
        "out": str(plan.out),
        "jobs": len(rows),
        "done": sum(row["state"] == "done" for row in rows),
        "failed": len(failed),
        "open": sum(row["state"] == "open" for row in rows),
        "reused": reused,
        "seconds": round(seconds, 2),
        "retry": retry_command(plan, failed) if failed else None,
        "left_out": list(plan.left_out),
        "rows": rows,
    }


def retry_command(plan: BatchPlan, names: Sequence[str]) -> str:
    """The shell command that runs these jobs again. Names that begin with a dash would be read as options."""
    plain = [name for name in names if not name.startswith("-")]
    only = [*(["--only", *plain] if plain else []), *(f"--only={name}" for name in names if name.startswith("-"))]
    return shlex.join(["mistyle", "batch", str(plan.out / PLAN), *only])


def _row(plan: BatchPlan, index: int, job: Record, ended: engines.Ended | None) -> dict[str, Any]:
    result = outcome(plan, job)
    state, content = result.state, result.told
    if ended is not None and ended.code != 0:
        state = "failed" if ended.code not in (75, 130) else "open"
    row: dict[str, Any] = {"name": job.name, "kind": job.kind, "state": state, "index": index} | _files(job)
    if state == "done":
        row |= {k: content[k] for k in ("seconds", "peak_gb", "figures")} | {"notes": content.get("notes", [])}
    if state == "failed":
        code = ended.code if ended is not None else content.get("exit_code", 1)
        error = ended.why if ended is not None else ""
        # A marker of an earlier try does not describe this crash.
        error = error or content.get("error") or f"the process ended with {code}"
        row |= {"exit_code": code, "error": error, "last_lines": engines.last_lines(plan, index)}
    return row


def _files(job: Record) -> dict[str, str]:
    """The paths of a job's files, for its row."""
    kind = "style" if job.style is not None else "references"
    return {"mesh": str(job.mesh), kind: str(job.style or job.references)}


def describe(summary: dict[str, Any]) -> str:
    """The summary as text for the terminal."""
    lines = [
        f"{summary['done']} of {summary['jobs']} done ({summary['reused']} before), {summary['failed']} failed, "
        f"{summary['open']} open, {summary['seconds']:.0f} s"
    ]
    for row in summary["rows"]:
        if row["state"] == "failed":
            lines.append(f"  {row['name']}: exit {row['exit_code']}: {row['error']}")
            if engines.crashed(row["exit_code"]):
                lines += [f"    | {line}" for line in row["last_lines"].splitlines()]
    notes = grouped((row["name"], text) for row in summary["rows"] for text in row.get("notes", ()))
    lines += [f"note      {text}" for text in notes]
    if summary["retry"]:
        lines.append(f"retry failed jobs: {summary['retry']}")
    lines.append(f"all jobs: {Path(summary['out']) / 'batch.html'}")
    return "\n".join(lines)


def dry_run(plan: BatchPlan, choices: Choices) -> dict[str, Any]:
    """The estimate of a batch: seconds, disk and memory of every unfinished job."""
    from mistyle.fitting.pipeline.plan import plan_material
    from mistyle.stylization.pipeline.plan import plan as plan_style

    rows = []
    for job in plan.jobs:
        done = finished(plan, job) is not None
        row: dict[str, Any] = {"name": job.name, "kind": job.kind, "done": done, "refused": None} | _files(job)
        try:
            estimate = (plan_material if job.kind == "fit" else plan_style)(job_of(plan, job))
        except MistyleError as error:
            estimate = {"seconds": 0, "disk_gb": 0.0, "memory_gb": 0.0}
            row["refused"] = str(error)
        rows.append(row | {key: estimate[key] for key in ("seconds", "disk_gb", "memory_gb")})
    remaining = [row for row in rows if not row["done"]]
    workers = min(workers_of(choices), max(len(remaining), 1))
    return {
        "out": str(plan.out),
        "left_out": list(plan.left_out),
        "jobs": rows,
        "workers": workers,
        "seconds": round(sum(row["seconds"] for row in remaining) / workers),
        "disk_gb": round(sum(row["disk_gb"] for row in remaining), 2),
        "memory_gb": round(sum(sorted((row["memory_gb"] for row in remaining), reverse=True)[:workers]), 1),
    }


def describe_dry_run(estimate: dict[str, Any]) -> str:
    """The estimate as text for the terminal."""
    lines = []
    for row in estimate["jobs"]:
        cost = "finished" if row["done"] else f"about {row['seconds']} s, {row['disk_gb']} GB of disk"
        if row["refused"]:
            cost = f"will be refused: {row['refused']}"
        lines.append(f"  {row['name']:<40} {row['kind']:<8} {cost}")
    lines.append(
        f"{sum(not row['done'] for row in estimate['jobs'])} jobs, {estimate['workers']} at a time: "
        f"about {estimate['seconds']} s, {estimate['disk_gb']} GB of disk, {estimate['memory_gb']} GB of memory "
        f"-> {estimate['out']}"
    )
    return "\n".join(lines)


def say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)
