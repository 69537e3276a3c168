"""Runs `mistyle` jobs of one source tree one after another, in one process: `python -P worker.py < jobs.json`.

It is started with PYTHONPATH set to the tree, which may be an older commit, so it knows nothing but the command line.
A job is {"arguments": [...], "out": run folder, "keep": file, "goes_on": whether the run folder of the job before is
taken over}. The GLB that the job made becomes `keep`, and `keep.json` says how large the painting lies on the surface
and what the run took.
"""

import contextlib
import json
import os
import shutil
import sys
import time
from importlib import import_module
from pathlib import Path
from typing import Any


def command_line() -> Any:
    """The tree's own `main(arguments)`."""
    try:
        from mistyle.cli.main import main
    except ImportError:  # a tree of before the packages
        main = import_module("mistyle.run.cli").main
    return main


def painting_on_surface(out: Path) -> float | None:
    """One pixel of the painting on the surface, in working units; None where the run folder does not say."""
    try:
        record = json.loads((out / "work/surface/record/record.json").read_text())
    except (OSError, ValueError):
        return None
    for fields in _fields(record):
        if "spacing" in fields and "scale" in fields:
            scale = fields["scale"]
            numbers = [x for x in _numbers(scale) if x > 0]
            if numbers and isinstance(fields["spacing"], float):
                return fields["spacing"] / max(numbers)
    return None


def finish_seconds(out: Path) -> float | None:
    """Seconds of the stage "finish"; None where there was none."""
    return json.loads((out / "run.json").read_text())["seconds"].get("finish")


def _fields(tree: Any) -> Any:
    """Every dictionary in a tree, depth first."""
    if isinstance(tree, dict):
        yield tree
    for inner in tree.values() if isinstance(tree, dict) else tree if isinstance(tree, list) else ():
        yield from _fields(inner)


def _numbers(tree: Any) -> Any:
    """Every number in a tree."""
    if isinstance(tree, (int, float)) and not isinstance(tree, bool):
        yield float(tree)
    for inner in tree.values() if isinstance(tree, dict) else tree if isinstance(tree, list) else ():
        yield from _numbers(inner)


def run(main: Any, job: dict[str, Any]) -> None:
    """One job; SystemExit where it failed."""
    out, keep = Path(job["out"]), Path(job["keep"])
    if not job.get("goes_on"):
        shutil.rmtree(out, ignore_errors=True)
    start = time.process_time()
    with contextlib.redirect_stdout(sys.stderr):
        code = main(job["arguments"])
    if code != 0:
        raise SystemExit(f"mistyle {' '.join(job['arguments'])} ended with {code}")
    made = next(iter(sorted((out / "asset").glob("*.glb"))))
    about = {"pixel": painting_on_surface(out), "cpu": time.process_time() - start, "finish": finish_seconds(out)}
    keep.with_name(keep.name + ".json").write_text(json.dumps(about))
    shutil.copy(made, keep.with_suffix(".part"))
    os.replace(keep.with_suffix(".part"), keep)


if __name__ == "__main__":
    chosen = command_line()
    for one in json.load(sys.stdin):
        run(chosen, one)
        print(one["keep"], flush=True)
