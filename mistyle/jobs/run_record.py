"""`run.json` of any kind of job: written whole, with the times and peaks of the reused stages."""

import json
from typing import Any

from mistyle.io.store.output import write_file
from mistyle.io.store.trusted_json import read_own
from mistyle.jobs.progress import Progress
from mistyle.jobs.stages import Run


def report_files(job: Any) -> dict[str, str]:
    """The paths of the report and its picture; empty without a report."""
    if job.settings.report.detail == "none":
        return {}
    folder = job.out / "report"
    return {"report": str(folder / "index.html"), "picture": str(folder / "overview.png")}


def old_report(job: Any) -> tuple[str, ...]:
    """A note where this run writes no report and the report of an earlier run remains."""
    folder = job.out / "report"
    if job.settings.report.detail != "none" or not folder.exists():
        return ()
    return (f"{folder} shows an earlier run: --report none wrote no new one.",)


def write_record(job: Any, record: dict[str, Any], progress: Progress) -> None:
    """Write the job's `run.json`; an edited one is set aside, with a note."""
    aside = write_file(job.out, "run.json", (json.dumps(record, indent=1) + "\n").encode(), overwrite=job.overwrite)
    if aside is not None:
        progress.note(f"run.json was edited: your version now lies in {aside}.")


def earlier(path: Any) -> dict[str, Any]:
    """The `run.json` of the previous run, or nothing."""
    try:
        return read_own(path)
    except (OSError, ValueError):
        return {}


def merged_seconds(path: Any, run: Run) -> dict[str, float]:
    """The seconds of every stage; a reused stage keeps the time of its own run."""
    before = earlier(path).get("seconds", {})
    now = run.progress.seconds
    return {name: round(before.get(name, 0.0) if name in run.progress.reused else now[name], 3) for name in now}


def merged_peaks(path: Any, run: Run) -> dict[str, float]:
    """The peak memory of each stage, GB; a reused stage keeps the peak of its own run."""
    before = earlier(path).get("peaks_gb", {})
    now = run.progress.peaks | {name: before[name] for name in run.progress.reused if name in before}
    return {name: round(now[name], 3) for name in run.progress.seconds if name in now}
