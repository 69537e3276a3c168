"""How much memory jobs take, beside what `--dry-run` says: `python -m benchmarks.memory [--quick] [--json FILE]`

Each job runs in a process of its own, with few steps and turntable frames, on which memory does not hang. Figures:
`<case>.estimate_gb`, `<case>.peak_gb`, `<case>.error` (estimate / peak - 1); and for a job that is given less than it
would take, `budget.asked_gb`, `budget.peak_gb` and `budget.same_bytes` (1: its asset is that of the job without a
budget, byte for byte); `tiled.asked_gb` and `tiled.peak_gb` of an atlas of 8192² with 64 views. --quick runs the draft
on spot, the fit at 256² and a small budget. `--stages` also prints every stage's peak beside its estimate, from which
the constants of stylization/pipeline/budget.py and fitting/pipeline/budget.py come.
"""

import argparse
import hashlib
import json
import sys
import tempfile
from pathlib import Path
from typing import Any

from benchmarks.common import DATA, finish, run_mistyle

SPOT, BUNNY = DATA / "meshes/plain/spot.obj", DATA / "meshes/plain/stanford-bunny.obj"
WAVE, STARS = DATA / "styles/great_wave.jpg", DATA / "styles/starry_night.jpg"
FEW = ["--set", "fit.iterations1=3", "--set", "fit.iterations2=3", "--set", "report.frames=4"]
DRAFT = ["--preset", "draft", *FEW]

STYLIZE: dict[str, list[Any]] = {
    "draft_spot": ["stylize", SPOT, WAVE, *DRAFT],
    "draft_bunny": ["stylize", BUNNY, STARS, *DRAFT],
    "demo": ["demo", *FEW],
    "atlas_4096": ["stylize", SPOT, WAVE, *DRAFT, "--atlas", "4096"],
    "views_64": ["stylize", SPOT, WAVE, *DRAFT, "--set", "rig.kind=turntable", "--set", "rig.views=64"],
}
TILED = [*DRAFT, "--atlas", "8192", "--set", "rig.kind=turntable", "--set", "rig.views=64"]
FITS = {"fit_256": (256, 256, 16), "fit_512": (512, 256, 16), "fit_200": (1024, 128, 200)}  # atlas, pixels, pictures


def main() -> None:
    options = argparse.ArgumentParser(prog="python -m benchmarks.memory", description=__doc__)
    options.add_argument("--quick", action="store_true", help="three small jobs")
    options.add_argument("--json", type=Path)
    options.add_argument("--only", action="append", help="only this case (repeatable)")
    options.add_argument("--stages", action="store_true", help="also print every stage's peak and estimate")
    options.add_argument("--keep", type=Path, help="folder for the runs, to look at afterwards")
    chosen = options.parse_args()
    wanted = chosen.only or (
        ["draft_spot", "fit_256", "budget"] if chosen.quick else [*STYLIZE, *FITS, "budget", "tiled"]
    )
    figures: dict[str, float] = {}
    with tempfile.TemporaryDirectory() as scratch:
        place = chosen.keep or Path(scratch)
        for name in wanted:
            if name in STYLIZE:
                found = stylized(place / name, STYLIZE[name], chosen.stages)
            elif name in FITS:
                found = fitted(place / name, *FITS[name], chosen.stages)
            elif name == "tiled":
                found = tiled(place / name, 4.0)
            else:
                found = budget(place / name, chosen.quick)
            figures |= {f"{name}.{key}": value for key, value in found.items()}
            print(name, {key: round(value, 3) for key, value in found.items()}, file=sys.stderr, flush=True)
    finish(figures, chosen.json)


def error(estimate: float, peak: float) -> dict[str, float]:
    return {"estimate_gb": estimate, "peak_gb": peak, "error": estimate / peak - 1}


def stylized(out: Path, words: list[Any], stages: bool) -> dict[str, float]:
    """Estimate and peak of a job."""
    told = run_mistyle(*words, "-o", out, "--dry-run")
    made = run_mistyle(*words, "-o", out)
    if stages:
        show(told.get("peaks_gb", {}), out)
    return error(told["memory_gb"], made["peak_gb"])


def fitted(out: Path, atlas: int, side: int, pictures: int, stages: bool) -> dict[str, float]:
    """Estimate and peak of a fit to pictures that were rendered for it."""
    from mistyle.core.light import lights, to_json
    from mistyle.fitting.pipeline.budget import MATERIAL, material_counts, material_gb
    from mistyle.fitting.settings.material import MaterialSettings
    from mistyle.jobs.memory_budget import peaks

    views, light = out / "pictures", out / "lights.json"
    rig = ["--rig", "turntable", "--set", f"rig.views={pictures}"]
    run_mistyle("render", SPOT, "-o", views, "--resolution", side, "--spp", "4", *rig)
    # Not what lit them: memory does not hang on how well the pictures are explained.
    light.write_text(json.dumps(to_json(lights("phase1"))))
    few = ["--lights", light, "--set", "recover.iterations=32", "--set", "report.frames=4"]
    made = run_mistyle("fit", SPOT, views, "-o", out / "fit", "--atlas", atlas, *few)
    settings = MaterialSettings.model_validate(json.loads((out / "fit" / "run.json").read_text())["settings"])
    count = [side**2] * pictures
    if stages:
        show(peaks(MATERIAL, material_counts(settings, count)), out / "fit")
    return error(material_gb(settings, count), made["peak_gb"])


def budget(out: Path, quick: bool) -> dict[str, float]:
    """A job that would take more than it is given, without gradients, and the same without a budget."""
    size, asked = ("1024", 1.25) if quick else ("4096", 2.2)
    words = ["stylize", SPOT, WAVE, *DRAFT, "--atlas", size, "--refine", "off"]
    free = run_mistyle(*words, "-o", out / "free")
    made = run_mistyle(*words, "-o", out / "kept", "--memory", f"{asked}G")
    same = assets(out / "free") == assets(out / "kept")
    return {"free_gb": free["peak_gb"], "asked_gb": asked, "peak_gb": made["peak_gb"], "same_bytes": float(same)}


def tiled(out: Path, asked: float) -> dict[str, float]:
    """What a job that is far too large for its budget held of main memory."""
    made = run_mistyle("stylize", SPOT, WAVE, *TILED, "-o", out, "--memory", f"{asked}G")
    return {"asked_gb": asked, "peak_gb": made["peak_gb"]}


def assets(out: Path) -> list[str]:
    """Digests of what a job wrote for others."""
    files = sorted(p for part in ("asset", "stylized") for p in (out / part).rglob("*") if p.name != "done.json")
    return [hashlib.sha256(p.read_bytes()).hexdigest() for p in files if p.is_file()]


def show(estimates: dict[str, float], out: Path) -> None:
    found = json.loads((out / "run.json").read_text())["peaks_gb"]
    for stage, peak in found.items():
        print(f"  {stage:<10} {estimates.get(stage, float('nan')):8.3f} {peak:8.3f}", file=sys.stderr)


if __name__ == "__main__":
    main()
