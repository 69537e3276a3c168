"""One job of a plan as one process: `mistyle shard PLAN --index I`.

It may run any number of times, on any machine, by any queue. A job is finished if its marker OUT/shards/<name>.json has
the job's key and its files have their hashes. Any other job resumes from its last finished stage. A failure leaves
OUT/shards/<name>.failed.json, which the next success removes; a stopped shard leaves neither.
"""

import contextlib
import json
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mistyle.batch.jobs_file import Record
from mistyle.batch.plan import SHARDS, BatchPlan, inputs_of
from mistyle.core.errors import MistyleError, Stopped
from mistyle.fitting.pipeline.job import MATERIAL_STAGES
from mistyle.io.store import lock
from mistyle.io.store.atomic import LOCK, atomic_write, digest, sha256_file
from mistyle.io.store.output import claim, keep_folder
from mistyle.io.store.trusted_json import read_own
from mistyle.jobs.inputs import input_files
from mistyle.jobs.progress import Progress
from mistyle.jobs.stages import claim_run, program
from mistyle.process.disk_errors import unexpected
from mistyle.stylization.pipeline.job import STAGES


@dataclass(frozen=True)
class Outcome:
    """The state of a shard, "done", "failed" or "open"; `told` is the content of its marker."""

    state: str
    told: dict[str, Any]


def key_of(job: Record) -> str:
    """The digest of everything that the result depends on: files, settings, program."""
    files = [list(input_files(job.mesh)), job.style, job.references, job.masks, job.exposure]
    lights = Path(job.lights) if job.lights not in (None, "unknown") else job.lights
    return digest([program(), job.kind, job.name, files, lights, job.settings])


def marker(plan: BatchPlan, job: Record, failed: bool = False) -> Path:
    """The marker file of a finished job, or of its failure."""
    return plan.out / SHARDS / f"{job.name}{'.failed' if failed else ''}.json"


def outcome(plan: BatchPlan, job: Record) -> Outcome:
    """The state of a job by its markers alone, which is fast; `finished` also checks the files."""
    for state, failed in (("done", False), ("failed", True)):
        content = _read(marker(plan, job, failed))
        if content is not None:
            return Outcome(state, content)
    return Outcome("open", {})


def finished(plan: BatchPlan, job: Record, key: str | None = None) -> dict[str, Any] | None:
    """The marker of a job that is finished under its present key, with all files unchanged; else None."""
    content = _read(marker(plan, job))
    if content is None or content.get("key") != (key or key_of(job)):
        return None
    files = content.get("files", {})
    unchanged = all((plan.out / p).is_file() and sha256_file(plan.out / p) == h for p, h in files.items())
    return content if unchanged and files else None


def claim_batch(plan: BatchPlan) -> None:
    """UsageError where the batch would overwrite an input, or a file in any job's folder that is not mistyle's."""
    every = [path for job in plan.jobs for path in inputs_of(job)]
    claim(plan.out, ("plan.json", "batch.json", "batch.html"), [SHARDS], every, aside=True, overwrite=plan.overwrite)
    for job in plan.jobs:
        stages = MATERIAL_STAGES if job.kind == "fit" else STAGES
        claim_run(job_of(plan, job), stages, every)


def run_shard(plan: BatchPlan, index: int, progress: Progress) -> dict[str, Any]:
    """Run job `index` unless it is finished; returns its marker's content. Raises the job's errors."""
    job = plan.jobs[index]
    claim(plan.out, folders=[SHARDS], overwrite=plan.overwrite)
    keep_folder(plan.out, SHARDS)
    key = key_of(job)  # of the present files: a file that changes during the run changes the key
    content = finished(plan, job, key)
    if content is not None:
        progress.say(f"{job.name}: reused from an earlier run")
        return content | {"reused": True}
    start = time.monotonic()
    failure = marker(plan, job, failed=True)
    marker(plan, job).unlink(missing_ok=True)  # it has another key, or its files have changed
    _wait_for_folder(plan.out / job.name, progress)
    try:
        summary = _run(plan, job, progress)
    except Stopped:
        raise
    except Exception as error:
        expected = unexpected(error) if isinstance(error, OSError) else error
        known = expected if isinstance(expected, MistyleError) else None
        code, text = (known.exit_code, str(known)) if known else (1, f"{type(error).__name__}: {error}")
        note = {"name": job.name, "exit_code": code, "error": text, "seconds": round(time.monotonic() - start, 2)}
        with contextlib.suppress(MistyleError, OSError):  # on a full disk only the log has the error
            _write(failure, note)
        raise
    written = [p for p in sorted((plan.out / job.name / "asset").rglob("*")) if p.is_file()]
    written += [p for p in (plan.out / job.name / "report").glob("*.html")]
    written += [
        Path(p) for files in summary.get("delivered", {}).values() for p in files if not p.endswith("_look.usda")
    ]
    content = {
        "name": job.name,
        "key": key,
        "inputs": [str(path) for path in inputs_of(job)],
        "files": {p.relative_to(plan.out).as_posix(): sha256_file(p) for p in written},
        "seconds": round(time.monotonic() - start, 2),
        "peak_gb": round(float(summary["peak_gb"]), 3),
        "figures": summary["figures"],
        "stages": summary["seconds"],
        "notes": summary["notes"],
    }
    _write(marker(plan, job), content)
    failure.unlink(missing_ok=True)
    return content


def _wait_for_folder(folder: Path, progress: Progress, seconds: float = 30.0) -> None:
    """Wait for the folder's lock: the shard of a killed engine may take a moment to end."""
    since = time.monotonic()
    while lock.busy(folder / LOCK) and time.monotonic() - since < seconds:
        if time.monotonic() - since < 0.1:
            progress.say(f"{folder}: another process uses this folder; waiting up to {seconds:g} s")
        time.sleep(0.2)


def job_of(plan: BatchPlan, record: Record) -> Any:
    """The `Job` or `MaterialJob` of a record of the plan."""
    out = plan.out / record.name
    if record.kind == "fit":
        from mistyle.fitting.pipeline.job import MaterialJob
        from mistyle.fitting.settings.material import MaterialSettings

        assert record.references is not None
        lights = record.lights if record.lights in (None, "unknown") else Path(record.lights)
        settings = MaterialSettings.model_validate(record.settings)
        arguments = (record.mesh, record.references, out, settings, record.name, lights, record.masks, record.exposure)
        return MaterialJob(*arguments, overwrite=plan.overwrite)
    from mistyle.stylization.pipeline.job import Job
    from mistyle.stylization.settings import Settings

    assert record.style is not None
    settings = Settings.model_validate(record.settings)
    return Job(record.mesh, record.style, out, settings, record.name, overwrite=plan.overwrite)


def _run(plan: BatchPlan, record: Record, progress: Progress) -> dict[str, Any]:
    if record.kind == "fit":
        from mistyle.fitting.pipeline.material import fit_material

        return fit_material(job_of(plan, record), progress)
    from mistyle.stylization.pipeline.stylize import stylize

    return stylize(job_of(plan, record), progress)


def stages_of(job: Record) -> Sequence[str]:
    """The stages of a job, for progress displays."""
    return tuple(MATERIAL_STAGES if job.kind == "fit" else STAGES)


class FarmProgress(Progress):
    """Progress of a shard in the stdout messages of Open Job Description."""

    def __init__(self, stages: int) -> None:
        super().__init__()
        self.stages = max(stages, 1)

    def say(self, text: str) -> None:
        done = 100 * min(len(self.seconds) / self.stages, 1.0)
        print(f"openjd_progress: {done:.1f}\nopenjd_status: {text}", flush=True)
        print(text, file=sys.stderr, flush=True)


def _read(path: Path) -> dict[str, Any] | None:
    try:
        content = read_own(path)
    except (OSError, ValueError):
        return None
    return content if isinstance(content, dict) else None


def _write(path: Path, values: dict[str, Any]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    atomic_write(path, (json.dumps(values, indent=1) + "\n").encode())
