"""The whole job, stage by stage, on real data: `python -m benchmarks.pipeline [--quick] [--json FILE]`

Runs `mistyle stylize` as a user would, each job in a process of its own, so that imports, kernel compilation and peak
memory count. Figures: draft.seconds (spot, has UVs), draft_bunny.seconds, standard.seconds and standard.peak_gb
(bunny, without UVs: unwrapping counts), and `<job>.<stage>` in seconds for every stage. --quick runs the draft on spot.

`--against COMMIT` runs jobs at that commit and here, in turn: ratio.draft (spot), ratio.standard (bunny), ratio.demo,
ratio.materials (six materials, draft), ratio.preview (against the draft), and ratio.report, the largest of the reports.
"""

import argparse
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from benchmarks.common import DATA, finish
from benchmarks.pipeline import against as pipeline_against

JOBS = {
    "draft": ("meshes/plain/spot.obj", "styles/great_wave.jpg", "draft"),
    "draft_bunny": ("meshes/plain/stanford-bunny.obj", "styles/starry_night.jpg", "draft"),
    "standard": ("meshes/plain/stanford-bunny.obj", "styles/starry_night.jpg", "standard"),
}


def main() -> None:
    options = argparse.ArgumentParser(prog="python -m benchmarks.pipeline", description=__doc__)
    options.add_argument("--quick", action="store_true", help="only the draft on spot")
    options.add_argument("--json", type=Path)
    options.add_argument("--keep", type=Path, help="folder for the runs, to look at afterwards")
    options.add_argument("--against", metavar="COMMIT", help="compare with this commit")
    options.add_argument("--jobs", metavar="A,B", help=f"with --against: which of {', '.join(pipeline_against.JOBS)}")
    options.add_argument("--repeat", type=int, default=1, metavar="N", help="with --against: the quickest of N counts")
    chosen = options.parse_args()
    if chosen.against:
        finish(compared(chosen), chosen.json)
        return
    figures: dict[str, float] = {}
    with tempfile.TemporaryDirectory() as scratch:
        for name in ["draft"] if chosen.quick else JOBS:
            figures |= run(name, *JOBS[name], (chosen.keep or Path(scratch)) / name)
    finish(figures, chosen.json)


def compared(chosen: argparse.Namespace) -> dict[str, float]:
    """The figures against another commit."""
    names = chosen.jobs.split(",") if chosen.jobs else ["draft"] if chosen.quick else None
    wrong = [name for name in names or () if name not in pipeline_against.JOBS]
    if wrong:
        raise SystemExit(f"--jobs: there is no job '{wrong[0]}'; choose among {', '.join(pipeline_against.JOBS)}")
    cache = Path(tempfile.gettempdir()) / "mistyle-look"
    return pipeline_against.against(chosen.against, names, max(chosen.repeat, 1), cache)


def run(name: str, mesh: str, style: str, preset: str, out: Path) -> dict[str, float]:
    """One job from nothing; its wall time, peak memory and the seconds of each stage."""
    if (out / "run.json").exists():
        raise SystemExit(f"{out} holds an earlier run, which would be taken over; choose another --keep folder")
    command = [sys.executable, "-m", "mistyle", "stylize", str(DATA / mesh), str(DATA / style), "-o", str(out)]
    start = time.perf_counter()
    done = subprocess.run([*command, "--preset", preset, "--json"], stdout=subprocess.PIPE, text=True)
    seconds = time.perf_counter() - start
    if done.returncode != 0:
        raise SystemExit(f"{name}: mistyle ended with {done.returncode}: {done.stdout}")
    summary = json.loads(done.stdout)
    return {
        f"{name}.seconds": seconds,
        f"{name}.peak_gb": summary["peak_gb"],
        **{f"{name}.{stage}": took for stage, took in summary["seconds"].items()},
    }


if __name__ == "__main__":
    main()
