"""The same jobs at another commit and here, in turn: `python -m benchmarks.pipeline --against COMMIT`.

Each run is a process of its own with the same packages. Of several runs (--repeat) the quickest counts: the first may
have compiled kernels. `ratio.JOB` is wall time here over wall time there, `ratio.JOB.cpu` the same of processor time.
"""

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.common import DATA, ROOT
from benchmarks.look.paint import Tree, environment, this_tree, tree_at

MAIN = """import sys
try:
    from mistyle.cli.main import main
except ImportError:  # a tree of before the packages
    from mistyle.run.cli import main
sys.exit(main(sys.argv[1:]))"""
JOBS = ("draft", "standard", "demo", "materials", "preview")
REPORTED = ("draft", "standard", "materials")  # whose report counts
COLOURS = ("0.7 0.2 0.2", "0.2 0.6 0.3", "0.2 0.3 0.7", "0.7 0.6 0.2", "0.6 0.3 0.6", "0.4 0.4 0.4")
STAGE = ("write the report", "report")  # how a job's progress names it, and its name in the summary


@dataclass(frozen=True)
class Took:
    """What one run took: seconds, processor seconds, those of its report (None where unknown), and its summary."""

    wall: float
    cpu: float
    report: float | None
    report_cpu: float | None
    summary: dict[str, Any]


def words(job: str, here: bool, materials: Path) -> list[str]:
    """The command line of a job. A preview here stands against a draft there, which has none."""
    spot, bunny = DATA / "meshes/plain/spot.obj", DATA / "meshes/plain/stanford-bunny.obj"
    wave, night = DATA / "styles/great_wave.jpg", DATA / "styles/starry_night.jpg"
    if job == "demo":
        return ["demo"]
    mesh, style, preset = {
        "draft": (spot, wave, "draft"),
        "preview": (spot, wave, "draft"),
        "standard": (bunny, night, "standard"),
        "materials": (materials, night, "draft"),
    }[job]
    return ["stylize", str(mesh), str(style), "--preset", preset, *(["--preview"] if job == "preview" and here else [])]


def six_materials(folder: Path) -> Path:
    """An OBJ of six objects in two rows, each with a material of its own, made of the demo's mesh and of spot."""
    sources = [ROOT / "scenes/demo.obj", DATA / "meshes/plain/spot.obj"]
    lines, library, before = ["mtllib six.mtl"], [], np.zeros(3, int)
    for k in range(6):
        own, counts = placed(sources[k % 2], k, before)
        lines += [f"o object{k}", f"usemtl material{k}", *own]
        library.append(f"newmtl material{k}\nKd {COLOURS[k]}")
        before = before + counts
    (folder / "six.mtl").write_text("\n".join(library) + "\n")
    (folder / "six.obj").write_text("\n".join(lines) + "\n")
    return folder / "six.obj"


def placed(source: Path, number: int, before: np.ndarray) -> tuple[list[str], np.ndarray]:
    """The lines of an OBJ, of unit size, in its place, indices counted from `before`; and its numbers of v, vt, vn."""
    statements = [line.split() for line in source.read_text().splitlines() if line.strip()]
    points = np.array([[float(x) for x in s[1:4]] for s in statements if s[0] == "v"])
    low, high = points.min(axis=0), points.max(axis=0)
    offset = np.array([1.1 * (number % 3), 0.0, 1.1 * (number // 3)])
    points = (points - (low + high) / 2) / (high - low).max() + offset
    lines = [f"v {x:.6f} {y:.6f} {z:.6f}" for x, y, z in points]
    lines += [" ".join(s) for s in statements if s[0] in ("vt", "vn")]
    for statement in statements:
        if statement[0] == "f":
            corners = [corner.split("/") for corner in statement[1:]]
            moved = [[str(int(x) + before[k]) if x else "" for k, x in enumerate(corner)] for corner in corners]
            lines.append("f " + " ".join("/".join(corner) for corner in moved))
    return lines, np.array([sum(s[0] == kind for s in statements) for kind in ("v", "vt", "vn")])


def processor_seconds(pid: int) -> float | None:
    """What a process has used so far, all its threads, without its children; None where the system does not tell."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return None
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def run(tree: Tree, arguments: Sequence[str], out: Path) -> Took:
    """One job; SystemExit where it fails. Processor time is that of the job and of its children."""
    # A home of its own would also have kernels of its own: every run would compile them.
    command = [sys.executable, "-P", "-c", MAIN, *arguments, "-o", str(out), "--json"]
    start, marks, tail = time.perf_counter(), {}, []
    answer = out.with_name(out.name + ".json")
    with answer.open("w") as stdout:
        child = subprocess.Popen(
            command, cwd=out.parent, env=environment(tree), stdout=stdout, stderr=subprocess.PIPE, text=True
        )
        assert child.stderr is not None
        for line in child.stderr:
            tail = [*tail[-20:], line]
            if line.strip().startswith(STAGE[0]):
                marks["begin" if line.strip().endswith("...") else "end"] = processor_seconds(child.pid)
        _, status, used = os.wait4(child.pid, 0)
    child.returncode = os.waitstatus_to_exitcode(status)
    wall = time.perf_counter() - start
    if child.returncode != 0:
        raise SystemExit(f"{tree.name}: mistyle {' '.join(arguments)} ended with {child.returncode}:\n{''.join(tail)}")
    summary = json.loads(answer.read_text().strip().splitlines()[-1])
    begin, end = marks.get("begin"), marks.get("end")
    spent = None if begin is None or end is None else end - begin
    return Took(wall, used.ru_utime + used.ru_stime, summary.get("seconds", {}).get(STAGE[1]), spent, summary)


def has_preview(tree: Tree) -> bool:
    """Whether the tree's `stylize` knows --preview."""
    command = [sys.executable, "-P", "-c", MAIN, "stylize", "--help"]
    return "--preview" in subprocess.run(command, env=environment(tree), capture_output=True, text=True).stdout


def against(commit: str, jobs: Sequence[str] | None, repeat: int, cache: Path) -> dict[str, float]:
    """The figures of all jobs; without names, all that this tree knows."""
    here, there = this_tree(), tree_at(commit, cache)
    names = list(jobs) if jobs else [name for name in JOBS if name != "preview" or has_preview(here)]
    figures: dict[str, float] = {}
    with tempfile.TemporaryDirectory() as scratch:
        materials = six_materials(Path(scratch)) if "materials" in names else Path(scratch)
        for name in names:
            took: dict[str, list[Took]] = {"there": [], "here": []}
            for turn in range(repeat):
                for side, tree in (("there", there), ("here", here)):
                    arguments = words(name, side == "here", materials)
                    took[side].append(run(tree, arguments, Path(scratch) / f"{name}-{side}-{turn}"))
                    print(f"{name} {side}: {took[side][-1].wall:.1f} s", file=sys.stderr)
            figures |= compared(name, took["there"], took["here"])
    return figures | of_reports(figures)


def compared(name: str, there: Sequence[Took], here: Sequence[Took]) -> dict[str, float]:
    """Seconds of both sides (the quickest run), ratios, and what the summaries say of the result."""
    figures: dict[str, float] = {}
    kinds = {"seconds": "wall", "cpu": "cpu", "report": "report", "report_cpu": "report_cpu"}
    for kind, field in kinds.items():
        both = [[v for v in (getattr(took, field) for took in side) if v is not None] for side in (there, here)]
        if all(both):
            least = [min(values) for values in both]
            figures |= {f"{name}.{kind}.there": least[0], f"{name}.{kind}.here": least[1]}
            stem = f"ratio.{name}" if kind in ("seconds", "cpu") else f"ratio.report.{name}"
            figures[stem + (".cpu" if kind.endswith("cpu") else "")] = least[1] / max(least[0], 1e-9)
    for side, took in (("there", there), ("here", here)):
        said = took[-1].summary.get("figures", {})
        numbers = {k: v for k, v in said.items() if isinstance(v, (int, float)) and np.isfinite(v)}
        figures |= {f"{name}.{side}.{figure}": float(value) for figure, value in numbers.items()}
    return figures


def of_reports(figures: dict[str, float]) -> dict[str, float]:
    """`ratio.report`, and of processor time: the largest over the jobs whose report counts."""
    result = {}
    for ending in ("", ".cpu"):
        ratios = [figures[f"ratio.report.{n}{ending}"] for n in REPORTED if f"ratio.report.{n}{ending}" in figures]
        if ratios:
            result[f"ratio.report{ending}"] = max(ratios)
    return result
