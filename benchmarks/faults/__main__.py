"""What happens when things go wrong: kills, signals, full disks, vanished files, native crashes, hostile inputs.

Kills: small jobs are killed with -9 at random moments (half of them in the middle of a write), run again, and must end
with the bytes of an undisturbed job and nothing left behind. Rows: every other fault, once each.
--full: 50 kills, the rows and 2,000 inputs; --quick: 8 kills and 300 inputs.
Figures: kills, kills_survived, rows, rows_held, inputs, inputs_held. Ends with 1 where anything did not hold.
"""

import argparse
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from benchmarks.common import finish, program
from benchmarks.faults.jobs import Job, made
from benchmarks.faults.kills import Kill, undisturbed
from benchmarks.faults.kills import run as kills
from benchmarks.faults.rows import Row
from benchmarks.faults.rows import run as rows
from mistyle.core.paths import scenes
from mistyle.process.cores import cores

PARTS = ("kills", "rows", "inputs")
JOBS = ("stylize", "fit", "fit --scene", "batch")


def options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog=program(), description=(__doc__ or "").splitlines()[0])
    size = parser.add_mutually_exclusive_group()
    size.add_argument("--quick", action="store_true", help="8 kills and 300 inputs (the default)")
    size.add_argument("--full", action="store_true", help="50 kills and 2,000 inputs")
    parser.add_argument("--only", nargs="+", choices=PARTS, help="these parts (default: all; --quick: no rows)")
    parser.add_argument("--kills", type=int, metavar="N", help="so many kills")
    parser.add_argument("--jobs", nargs="+", choices=JOBS, default=list(JOBS), help="kill these only")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path, metavar="FILE", help="also write the figures as JSON")
    chosen = parser.parse_args()
    chosen.only = chosen.only or (PARTS if chosen.full else ("kills", "inputs"))
    return chosen


def table(head: Sequence[str], lines: Sequence[Sequence[Any]]) -> str:
    """A markdown table."""
    cells = [[str(cell).replace("|", "/").replace("\n", " ") for cell in line] for line in lines]
    return "\n".join("| " + " | ".join(line) + " |" for line in [list(head), ["---"] * len(head), *cells])


def killed(found: Sequence[Kill]) -> str:
    """Kills by job: how many, how many survived, and what was wrong with the others."""
    lines = []
    for name in dict.fromkeys(k.name for k in found):
        own = [k for k in found if k.name == name]
        wrong = [f"{k.moment}: {k.wrong}" for k in own if k.wrong]
        lines.append((f"kill -9, {name}", len(own), len(own) - len(wrong), "; ".join(wrong)))
    return table(("fault", "tried", "the same bytes in the end", "what was wrong"), lines)


def others(found: Sequence[Row]) -> str:
    return table(
        ("fault", "on", "outcome", "held"),
        [(r.fault, r.on, r.outcome, "yes" if not r.wrong else f"no: {r.wrong}") for r in found],
    )


def quick_jobs(asset: Path) -> dict[str, tuple[Job, Job]]:
    """Jobs of a second or two, and others that would put their folder in the place of the first one's."""
    picture = str(scenes() / "demo_style.png")
    compare, export = ("compare", picture, picture, "-o", "OUT", "--metrics"), ("export", str(asset), "-o", "OUT")
    return {
        "compare": (Job("compare", (*compare, "psnr")), Job("compare", (*compare, "psnr,ssim"))),
        "export": (Job("export", export), Job("export", (*export, "--formats", "obj", "glb", "maps"))),
    }


def inputs(full: bool, report: Callable[[str], None]) -> dict[str, float]:
    from benchmarks.faults import inputs as faults_inputs

    return faults_inputs.run(full, report)


def main() -> None:
    chosen = options()
    figures: dict[str, float] = {}
    start = time.perf_counter()
    with tempfile.TemporaryDirectory(prefix="mistyle-faults-") as name:
        folder = Path(name)
        if "kills" in chosen.only:
            count = chosen.kills or (50 if chosen.full else 8)
            found = kills(count, folder / "kills", tuple(chosen.jobs), cores(), chosen.seed)
            figures |= {"kills": len(found), "kills_survived": sum(not k.wrong for k in found)}
            print(killed(found) + "\n", flush=True)
        if "rows" in chosen.only:
            place = folder / "rows"
            jobs = made(place / "inputs", JOBS)
            wholes = {job: undisturbed(each, place / f"whole{k}") for k, (job, each) in enumerate(jobs.items())}
            tried = rows(wholes, quick_jobs(place / "whole0"), place)
            figures |= {"rows": len(tried), "rows_held": sum(not r.wrong for r in tried)}
            print(others(tried) + "\n", flush=True)
        if "inputs" in chosen.only:
            figures |= inputs(chosen.full, lambda text: print(text, flush=True))
    figures["seconds"] = time.perf_counter() - start
    finish(figures, chosen.json)
    pairs = (("kills", "kills_survived"), ("rows", "rows_held"), ("inputs", "inputs_held"))
    sys.exit(any(figures.get(tried) != figures.get(held) for tried, held in pairs))


if __name__ == "__main__":
    main()
