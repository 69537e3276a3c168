"""What a batch costs beside its jobs: engines against a shell loop that starts the same shards, and several workers.

Twelve jobs (real meshes and paintings of MISTYLE_DATA; with --quick four small ones), each a process of about half a
minute. Every row begins with an empty folder and the same plan, except that threads of a job are what the row says:
`overhead_*` compare rows of one job at a time with all cores each, `speedup_2_workers` two jobs at a time with half of
the cores each against one job at a time with half of the cores (half of the jobs).
"""

import subprocess
import sys
import tempfile
import time
from pathlib import Path

from benchmarks.common import DATA, arguments, finish
from mistyle.batch import engines
from mistyle.batch.pipeline import Choices, planned, run_batch
from mistyle.batch.plan import BatchPlan, write_plan
from mistyle.batch.shard import outcome
from mistyle.core.paths import scenes
from mistyle.process.cores import cores

MESHES, STYLES = ("spot.obj", "teapot.obj"), ("starry_night", "great_wave", "mosaic", "woodcut")
# Drafts that take about half a minute.
USUAL = (
    "report = { frames = 6, resolution = 160 }, fit = { iterations1 = 24, iterations2 = 24 }, atlas = { size = 512 }"
)
QUICK = """report = { frames = 4, resolution = 64, spp = 1 }, fit = { refine = "off" }, atlas = { size = 256 }, \
rig = { kind = "turntable", views = 4, resolution = 128 }, surface = { samples = 8000 }, draw = { spp = 1 }"""


def jobs(folder: Path, quick: bool, most: int = 4) -> Path:
    """The jobs file: every mesh in at most `most` styles (with --quick: seeds)."""
    meshes = [p for name in MESHES for p in sorted((DATA / "meshes").rglob(name))[:1]]
    styles = [p for name in STYLES for p in sorted((DATA / "styles").glob(f"{name}*"))[:1]][:most]
    demo = scenes() / "demo.obj"
    if quick or not meshes or not styles:
        meshes, styles = [demo], [scenes() / "demo_style.png"]
    else:
        meshes.append(demo)
    seeds = ", ".join(f"{{ seed = {k} }}" for k in range(most))
    variants = f"[{seeds}]" if len(meshes) == 1 else "[]"
    settings = f"settings = {{ {QUICK if quick else USUAL} }}\n"
    grid = f"[[grid]]\nmeshes = {_list(meshes)}\nstyles = {_list(styles)}\nvariants = {variants}\n"
    path = folder / f"jobs_{most}.toml"
    path.write_text(f'preset = "draft"\n{settings}{grid}', encoding="utf-8")
    return path


def _list(paths: list[Path]) -> str:
    return "[" + ", ".join(f'"{p.as_posix()}"' for p in paths) + "]"


def shell_loop(plan: BatchPlan) -> None:
    """What anyone would write: for i in ...; do mistyle shard plan.json --index $i; done."""
    path = write_plan(plan)
    loop = f'for i in $(seq 0 {len(plan.jobs) - 1}); do "$0" -m mistyle shard "$1" --index $i || exit 1; done'
    subprocess.run(["sh", "-c", loop, sys.executable, str(path)], check=True, stderr=subprocess.DEVNULL)


def row(jobs_file: Path, name: str, choices: Choices | None, threads: int) -> tuple[float, float]:
    """Seconds of all jobs, and the most memory that one of them held, GB."""
    with tempfile.TemporaryDirectory(prefix=f"mistyle-{name}-") as folder:
        plan = planned(jobs_file, Path(folder) / "out", Choices(workers=1, threads=threads))
        start = time.monotonic()
        if choices is None:
            shell_loop(plan)
        else:
            run_batch(plan, choices)
        seconds = time.monotonic() - start
        told = [outcome(plan, job) for job in plan.jobs]
        if any(each.state != "done" for each in told):
            raise SystemExit(f"{name}: a shard failed: {engines.last_lines(plan, 0)}")
        return seconds, max(each.told["peak_gb"] for each in told)


def main() -> None:
    options = arguments((__doc__ or "").splitlines()[0])
    all_cores, half = cores(), max(1, cores() // 2)
    figures: dict[str, float] = {}
    with tempfile.TemporaryDirectory(prefix="mistyle-batch-") as folder:
        file, half_of_them = jobs(Path(folder), options.quick), jobs(Path(folder), options.quick, 2)
        rows = {
            "loop": (None, all_cores),
            "local": (Choices(workers=1, threads=all_cores), all_cores),
            "ray": (Choices(engine="ray", workers=1, threads=all_cores), all_cores),
            "one_worker": (Choices(workers=1, threads=half), half),
            "two_workers": (Choices(workers=2, threads=half), half),
        }
        # Without the clock, so that no row alone pays for the kernel cache.
        row(jobs(Path(folder), options.quick, 1), "warm", None, all_cores)
        for name, (choices, threads) in rows.items():
            chosen = half_of_them if name.endswith(("worker", "workers")) else file
            figures[f"{name}.seconds"], figures[f"{name}.peak_gb_of_a_job"] = row(chosen, name, choices, threads)
            print(f"{name}: {figures[f'{name}.seconds']:.1f} s", file=sys.stderr, flush=True)
    figures["overhead_local"] = figures["local.seconds"] / figures["loop.seconds"] - 1
    figures["overhead_ray"] = figures["ray.seconds"] / figures["loop.seconds"] - 1
    figures["speedup_2_workers"] = figures["one_worker.seconds"] / figures["two_workers.seconds"]
    finish(figures, options.json)


if __name__ == "__main__":
    main()
