"""Do the views agree, does the style come through, is the shape still there: `python -m benchmarks.consistency`

Rows: `per_view` (each view stylized alone), `sweep` (each from what earlier ones show), `default` (the embedded surface
stylizer), `ebsynth` (a peer, with --ebsynth PROGRAM), and as floors `colour_field` (smooth colours, no strokes) and
`halves` (the painting's left half against its right). Columns: `benchmarks.consistency.judge.judged`, and
seconds_per_view and peak_gb of the row's own process. Six of the paper's 16 views are stylized and judged.

Figures `<row>.<column>` are means over the pairs of mesh and style, `<mesh>_<style>.<row>.<column>` those of a pair. A
contact sheet for every pair is left in --out: look at it before believing the numbers. The weights and the default
meshes and styles are read from MISTYLE_DATA. --quick: one pair, small, without the peer.
"""

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from benchmarks.common import DATA, finish
from benchmarks.consistency.judge import halves, judged, sheet
from benchmarks.consistency.peer import ebsynth
from benchmarks.consistency.rows import ROWS, run
from benchmarks.consistency.scene import Scene, load, make

PAIRS = (("plain/stanford-bunny.obj", "starry_night.jpg"), ("plain/spot.obj", "great_wave.jpg"))


def parser() -> argparse.ArgumentParser:
    options = argparse.ArgumentParser(
        prog="python -m benchmarks.consistency", description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    options.add_argument("--quick", action="store_true", help="spot and great_wave, 256 pixels, no peer")
    options.add_argument("--json", type=Path, metavar="FILE", help="also write the figures as JSON")
    options.add_argument("--mesh", type=Path, help="with --style: this pair instead of the default ones")
    options.add_argument("--style", type=Path)
    options.add_argument("--resolution", type=int, default=512, help="pixels along each side of a view (default 512)")
    options.add_argument("--samples", type=int, default=250_000, help="surface samples (default 250000)")
    options.add_argument("--rows", help=f"which of {','.join([*ROWS, 'ebsynth'])} (default: all that can run)")
    options.add_argument("--ebsynth", type=Path, metavar="PROGRAM", help="EbSynth's program (see peer.py)")
    options.add_argument("--out", type=Path, help="folder for the contact sheets (default: a temporary one)")
    options.add_argument("--keep", type=Path, metavar="FOLDER", help="keep scenes and rows, take over what is there")
    options.add_argument("--one", nargs=2, metavar=("ROW", "FOLDER"), help=argparse.SUPPRESS)
    return options


def main(argv: list[str] | None = None) -> None:
    chosen = parser().parse_args(argv)
    if chosen.one:
        name, folder = chosen.one
        run(name, Path(folder), ebsynth(chosen.ebsynth) if name == "ebsynth" else None)
        return
    if (chosen.mesh is None) != (chosen.style is None):
        raise SystemExit("--mesh and --style belong together: give both, or neither")
    pairs = [(DATA / "meshes" / mesh, DATA / "styles" / style) for mesh, style in PAIRS]
    if chosen.mesh is not None:
        pairs = [(chosen.mesh, chosen.style)]
    elif chosen.quick:
        pairs = pairs[1:]
    out = chosen.out or Path(tempfile.mkdtemp(prefix="consistency-"))
    every = [measure(mesh, style, chosen, out) for mesh, style in pairs]
    figures: dict[str, float] = {}
    for name in sorted({k for found in every for k in found}):
        figures[name] = float(np.mean([found[name] for found in every if name in found]))
    for (mesh, style), found in zip(pairs, every, strict=True):
        if len(pairs) > 1:
            figures |= {f"{mesh.stem}_{style.stem}.{k}": v for k, v in found.items()}
    table(every, [f"{mesh.stem}, {style.stem}" for mesh, style in pairs])
    finish(figures, chosen.json)
    print(f"contact sheets: {out}")


def measure(mesh: Path, style: Path, chosen: argparse.Namespace, out: Path) -> dict[str, float]:
    """All rows of one pair."""
    sizes = (256, 30_000, 512) if chosen.quick else (chosen.resolution, chosen.samples, 2048)
    names = chosen.rows.split(",") if chosen.rows else list(ROWS) + (["ebsynth"] if chosen.ebsynth else [])
    figures: dict[str, float] = {}
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(chosen.keep or scratch) / f"{mesh.stem}_{style.stem}_{sizes[0]}"
        scene = load(folder) if (folder / "scene").is_dir() else make(folder, mesh, style, *sizes)
        pictures: dict[str, list[np.ndarray]] = {}
        for name in names:
            if name == "ebsynth" and chosen.quick:
                continue
            found = row(name, folder, chosen.ebsynth)
            pictures[name] = [found[f"picture{k}"] for k in range(len(scene.views))]
            figures |= {f"{name}.{k}": v for k, v in columns(folder / f"{name}.json", scene, found).items()}
            sheet(out / f"{mesh.stem}_{style.stem}.png", scene, pictures)
        figures |= {f"halves.{k}": v for k, v in halves(scene).items()}
    return figures


def columns(kept: Path, scene: Scene, found: dict[str, np.ndarray]) -> dict[str, float]:
    """A row's figures, or what was found of it before."""
    if kept.exists():
        return json.loads(kept.read_text(encoding="utf-8"))
    pictures, albedo, blind = ([found[k] for k in found if k.startswith(n)] for n in ("picture", "albedo", "blind"))
    result = judged(scene, pictures, albedo or None, blind or None)
    result["seconds_per_view"] = float(found["seconds"]) / len(scene.views)
    result["peak_gb"] = float(found["peak_gb"])
    kept.write_text(json.dumps(result), encoding="utf-8")
    return result


def row(name: str, folder: Path, program: Path | None) -> dict[str, np.ndarray]:
    """A row computed in a process of its own, or taken over where it was kept."""
    if not (folder / f"{name}.npz").exists():
        compute(name, folder, program)
    with np.load(folder / f"{name}.npz", allow_pickle=False) as stored:
        return {k: stored[k] for k in stored}


def compute(name: str, folder: Path, program: Path | None) -> None:
    """Run this module for one row."""
    command = [sys.executable, "-m", "benchmarks.consistency", "--one", name, str(folder)]
    command += ["--ebsynth", str(program)] if program else []
    done = subprocess.run(command, stdout=sys.stderr)
    if done.returncode != 0:
        raise SystemExit(f"row {name} ended with {done.returncode}")


def table(every: list[dict[str, float]], titles: list[str]) -> None:
    """Rows against columns for each pair, on stderr so that --json - stays JSON."""
    for title, figures in zip(titles, every, strict=True):
        rows = list(dict.fromkeys(k.partition(".")[0] for k in figures))
        columns = list(dict.fromkeys(k.partition(".")[2] for k in figures))
        print(f"\n{title}\n{'':<24}" + "".join(f"{r:>14}" for r in rows), file=sys.stderr)
        for column in columns:
            cells = (figures.get(f"{r}.{column}") for r in rows)
            print(f"{column:<24}" + "".join(f"{'' if c is None else f'{c:.4f}':>14}" for c in cells), file=sys.stderr)


if __name__ == "__main__":
    main()
