"""How soon a fit is as good as one of another commit: `python -m benchmarks.fit_speed --against COMMIT [--quick]`.

WaterBottle and Suzanne with strong maps, 16 views of 256² x 3 lights one at a time (--quick: 8 views of 96²), metallic
unknown, default settings. Both sides fit the same pictures in processes of their own, one after the other. The figures
are those of `material_recovery`: `normal` (mean, degrees), `roughness` (MSE), `albedo` and `relit` (PSNR-L, dB).

    ratio.time_to_figures   seconds until our maps have the four figures of the other commit's end, at the precision of
                            the tables (two digits, 0.1 dB), over its seconds; the larger of both assets. After each
                            pass our maps are finished as `--passes N` finishes them, and the first that suffice count
    ratio.draft             the same for a draft (`--preset draft`) until it has 1°, 1e-2 and 33 dB
    NAME.…                  both sides' figures and seconds, there; `….whole_seconds` are those of the whole fit
    ….cpu                   the same of processor time

A ratio is NEVER where the figures are not reached.
"""

import json
import subprocess
import sys
from argparse import Namespace
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory, gettempdir
from typing import Any

import numpy as np

from benchmarks.fit_speed.worker import NAMES, inputs_hash
from benchmarks.look.paint import Tree, environment, this_tree, tree_at
from benchmarks.material_recovery import __main__ as material_recovery
from benchmarks.material_recovery import pictures as drawing
from benchmarks.material_recovery.truth import ASSETS, Truth, find_asset, observed_areas, seen, truth
from mistyle.core.maps import Maps
from mistyle.fitting.settings.material import MATERIAL_PRESETS

WORKER = Path(__file__).with_name("worker.py")
CHOSEN = ("waterbottle", "suzanne")
NEVER = 1000.0
# Of each figure: its name among those of `material_recovery`, whether less is better, and what a draft must have.
FIGURES = {
    "normal": ("normal_mean_deg", True, 1.0),
    "roughness": ("roughness_mse", True, 1e-2),
    "albedo": ("albedo_psnr", False, 33.0),
    "relit": ("relight_psnr_l", False, None),
}


@dataclass(frozen=True)
class Case:
    """One asset: its truth, its judge, and the request of the worker without `out`, `settings` and `stops`."""

    name: str
    known: Truth
    judge: material_recovery.Judge
    request: dict[str, Any]


@dataclass(frozen=True)
class Stop:
    """A fit after some passes: seconds to there, and the maps."""

    passes: int
    wall: float
    cpu: float
    maps: list[Maps]


def against(commit: str, quick: bool) -> dict[str, float]:
    """The figures of the module."""
    there, here = tree_at(commit, Path(gettempdir()) / "mistyle-look"), this_tree()
    figures: dict[str, float] = {}
    with TemporaryDirectory() as scratch:
        for name in CHOSEN:
            figures |= compared(case_of(name, quick, Path(scratch)), there, here, Path(scratch))
    for ratio in ("time_to_figures", "draft"):
        for ending in ("", ".cpu"):
            figures[f"ratio.{ratio}{ending}"] = max(figures[f"{name}.{ratio}_ratio{ending}"] for name in CHOSEN)
    return figures


def case_of(name: str, quick: bool, scratch: Path) -> Case:
    """The pictures of an asset, drawn here for both sides."""
    side, views = (96, 8) if quick else (256, 16)
    words = ["--resolution", side, "--views", views, "--spp", 32 if quick else 128, *(["--quick"] if quick else [])]
    options: Namespace = material_recovery.parse([str(word) for word in words])
    file, uv, cameras = find_asset(name, options.data), ASSETS[name][1], drawing.fibonacci(views, side)
    known = truth(file, name, cameras[0], uv, True)
    shots = drawing.one_at_a_time(cameras)
    pictures = drawing.render(known.mesh, known.maps, shots, frame=options.frame, spp=options.spp, cache=options.cache)
    np.save(scratch / f"{name}.npy", np.stack(pictures))
    weights = observed_areas(known, seen(known, cameras))
    request = {"file": str(file), "name": name, "uv": uv, "resolution": side, "views": views}
    request["pictures"] = str(scratch / f"{name}.npy")
    return Case(name, known, material_recovery.Judge(known, weights, options), request)


def compared(case: Case, there: Tree, here: Tree, scratch: Path) -> dict[str, float]:
    """The figures of one asset."""
    (end,) = fit(case, there, scratch / f"{case.name}-there", {}, stops=False)
    theirs = four(case, end)
    result = told(f"{case.name}.there", end, theirs)
    ours = fit(case, here, scratch / f"{case.name}-here", {}, stops=True)
    result |= until(case, "here", "time_to_figures_ratio", ours, (theirs, end))
    settings, wanted = MATERIAL_PRESETS["draft"]["recover"], {n: b for n, (_, _, b) in FIGURES.items() if b is not None}
    drafts = fit(case, here, scratch / f"{case.name}-draft", dict(settings), stops=True)
    return result | until(case, "draft", "draft_ratio", drafts, (wanted, end))


def until(
    case: Case, side: str, ratio: str, stops: Sequence[Stop], goal: tuple[Mapping[str, float], Stop]
) -> dict[str, float]:
    """The first stop with the wanted figures, else the last: its figures, and its seconds over those of the other
    side's end; `goal` is both."""
    wanted, end = goal
    reached, values = None, {}
    for stop in stops:
        values = four(case, stop, wanted)
        if as_good(values, wanted):
            reached = stop
            break
    shown, whole = reached or stops[-1], stops[-1]
    result = told(f"{case.name}.{side}", shown, values) | {f"{case.name}.{side}.passes": shown.passes}
    result |= {f"{case.name}.{side}.whole_seconds": whole.wall, f"{case.name}.{side}.whole_seconds.cpu": whole.cpu}
    return result | ratios(f"{case.name}.{ratio}", reached, end)


def fit(case: Case, tree: Tree, out: Path, settings: Mapping[str, Any], stops: bool) -> list[Stop]:
    """The stops of a fit in a tree, one without `stops`. SystemExit where it fails or reads other inputs."""
    out.mkdir()
    request = case.request | {"out": str(out), "settings": dict(settings), "stops": stops}
    done = subprocess.run(
        [sys.executable, "-P", str(WORKER)], cwd=out, env=environment(tree), input=json.dumps(request), text=True,
        stderr=subprocess.PIPE, stdout=subprocess.DEVNULL,
    )  # fmt: skip
    if done.returncode != 0:
        raise SystemExit(f"{tree.name}: the fit of {case.name} ended with {done.returncode}:\n{done.stderr[-3000:]}")
    found = json.loads((out / "stops.json").read_text())
    if found["inputs"] != inputs_hash(case.known):
        raise SystemExit(f"{tree.name} reads {case.name} in another way: the two sides cannot be compared")
    print(f"{case.name} {out.name}: {found['stops'][-1]['wall']:.1f} s", file=sys.stderr, flush=True)
    return [Stop(row["passes"], row["wall"], row["cpu"], maps_of(case, out / row["maps"])) for row in found["stops"]]


def maps_of(case: Case, file: Path) -> list[Maps]:
    """The maps of a worker's file."""
    with np.load(file, allow_pickle=False) as stored:
        return [
            Maps(*(stored[f"{name}_{k}"] for name in NAMES), known=texels.covered)
            for k, texels in enumerate(case.known.texels)
        ]


def four(case: Case, stop: Stop, wanted: Mapping[str, float] | None = None) -> dict[str, float]:
    """The four figures of a stop; without the relit one, which is slow, where another falls short of `wanted`."""
    from dataclasses import asdict

    from benchmarks.material_recovery.metrics import map_errors

    errors = asdict(map_errors(case.known.maps, stop.maps, case.judge.weights))
    values = {name: errors[key] for name, (key, _, _) in FIGURES.items() if key in errors}
    if wanted is None or as_good(values, {name: bound for name, bound in wanted.items() if name in values}):
        relit = case.judge.differences(case.judge.relit(stop.maps, "mikkt"))
        values["relit"] = relit[FIGURES["relit"][0]]
    return values


def as_good(values: Mapping[str, float], wanted: Mapping[str, float]) -> bool:
    """Whether the wanted figures are reached, at the tables' precision."""
    for name, bound in wanted.items():
        if name not in values:
            return False
        less = FIGURES[name][1]
        value, bound = (float(f"{v:.2g}") if less else round(v, 1) for v in (values[name], bound))
        if value > bound if less else value < bound:
            return False
    return True


def told(name: str, stop: Stop, values: Mapping[str, float]) -> dict[str, float]:
    """Figures and seconds of a stop."""
    seconds = {f"{name}.seconds": stop.wall, f"{name}.seconds.cpu": stop.cpu}
    return {f"{name}.{figure}": value for figure, value in values.items()} | seconds


def ratios(name: str, stop: Stop | None, end: Stop) -> dict[str, float]:
    """Wall and processor seconds of a stop over those of the other side's end."""
    if stop is None:
        return {name: NEVER, f"{name}.cpu": NEVER}
    return {name: stop.wall / end.wall, f"{name}.cpu": stop.cpu / end.cpu}
