"""The whole job, stage by stage, on real data: `python -m benchmarks.pipeline [--quick] [--json FILE]`

Runs `mistyle stylize` as a user would, each job in a process of its own, so that imports, kernel compilation and peak
memory count. Figures: draft.seconds (spot, has UVs), draft_bunny.seconds, standard.seconds and standard.peak_gb
(bunny, without UVs: unwrapping counts), and `<job>.<stage>` in seconds for every stage. --quick runs the draft on spot.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from benchmarks.common import finish

DATA = Path(os.environ.get("MISTYLE_DATA", Path(__file__).resolve().parents[2] / "shared" / "data"))

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
    chosen = options.parse_args()
    figures: dict[str, float] = {}
    with tempfile.TemporaryDirectory() as scratch:
        for name in ["draft"] if chosen.quick else JOBS:
            figures |= run(name, *JOBS[name], (chosen.keep or Path(scratch)) / name)
    finish(figures, chosen.json)


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
