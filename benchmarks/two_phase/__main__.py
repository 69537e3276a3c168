"""What the two phases find of materials that are known: `python -m benchmarks.two_phase [--quick] [--json FILE]`

A mesh is painted with known relief, roughness and albedo (`truth.py`). Three kinds of views show it: `lit`,
by Mitsuba's `path` under the three lights of phase 1, which are fixed to the camera; `soft`, the same under the lights
of the paper's views, which stand still; and `unlit`, the albedo. Rows: `flat` (the baked albedo, flat, roughness 0.5),
`painter` (true albedo, the painter's guess of relief and gloss), `paper` (both phases as the paper has them, which are
Adam alone), `phase1`, `phase2` (after both) and `solver` (`mistyle fit`, the bound). Figures by row: `normal` (mean,
degrees), `roughness` (root mean square error), `albedo` (dB), over the surface that three views see. `normal_ratio` and
`roughness_ratio` are phase 1's error over the flat start's; `albedo_light_left` is the slope of log(albedo / truth)
after phase 2 over the same of the baked views, `albedo_spread_left` the ratio of their standard deviations, which has
the errors of detail too. `struggle.precision` and `struggle.recall`: what the repair finds of contradictions planted in
unlit views (`struggle.py`); `struggle.clean` is the share of the surface that it marks where none are.
`--slopes` are those of the true relief. `--sheets FOLDER` writes the maps and a relit picture of every row.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from benchmarks.common import DATA, finish, parser, timed
from benchmarks.material_recovery.metrics import map_errors
from benchmarks.material_recovery.truth import Truth, observed_areas, seen
from benchmarks.two_phase import struggle
from benchmarks.two_phase import truth as known
from benchmarks.two_phase.truth import Painted, silent
from mistyle.core.camera import Camera
from mistyle.core.capture import in_memory
from mistyle.core.image import luminance, srgb_from_linear
from mistyle.core.light import Directional, Lights, has_soft, lights
from mistyle.core.maps import Maps
from mistyle.io.read import read_picture
from mistyle.io.read_mesh import read_mesh
from mistyle.jobs import start
from mistyle.solver.recover import recover
from mistyle.solver.settings import RecoverSettings
from mistyle.stylization.inpaint.settings import RepairSettings
from mistyle.stylization.optimise.lit_views import lit_phases
from mistyle.stylization.optimise.two_phase import FitStart, FitTargets, two_phase, view_mask
from mistyle.stylization.pipeline import start as stylize_start
from mistyle.stylization.settings import Settings

KINDS = {"lit": "phase1", "soft": "paper"}
DARK = 0.02  # linear albedo under which a logarithm says nothing of light
LAMP = Directional((0.87, -0.3, -0.39), (4.0, 4.0, 4.0), "camera")  # of the sheets: no light of the views


@dataclass(frozen=True)
class Bench:
    """A painted object, its views' cameras, and the weight of each texel in the figures."""

    scene: Painted
    cameras: tuple[Camera, ...]
    weights: tuple[np.ndarray, ...]
    seen: tuple[np.ndarray, ...]
    settings: Settings
    spp: int
    cache: Path | None


def main(argv: list[str] | None = None) -> None:
    options = parser(__doc__ or "")
    options.add_argument("--mesh", type=Path, default=DATA / "meshes" / "plain" / "spot.obj")
    options.add_argument("--style", type=Path, default=DATA / "styles" / "starry_night.jpg")
    options.add_argument("--slopes", type=float, nargs="+", default=None)
    options.add_argument("--kinds", nargs="+", choices=[*KINDS, "unlit", "struggle"], default=None)
    options.add_argument("--cache", type=Path, metavar="FOLDER", help="where rendered views are kept")
    options.add_argument("--sheets", type=Path, metavar="FOLDER")
    chosen = options.parse_args(argv)
    settings = sized(chosen.quick)
    start.start_engines(settings)
    figures: dict[str, float] = {}
    slopes = chosen.slopes or ([0.2] if chosen.quick else [0.1, 0.2, 0.3])
    for slope in slopes:
        bench = prepare(chosen.mesh, chosen.style, settings, slope, 64 if chosen.quick else 128, chosen.cache)
        prefix = "" if slope == 0.2 else f"slope_{slope:g}."
        for kind in chosen.kinds or [*KINDS, "unlit", "struggle"]:
            rows, more = measure(bench, kind)
            figures |= {f"{prefix}{kind}.{name}": value for name, value in more.items()}
            if chosen.sheets and rows:
                write_sheet(bench, rows, chosen.sheets / f"{prefix}{kind}.png")
    finish(figures, chosen.json)


def sized(quick: bool) -> Settings:
    """The job's settings: a stroke covers as many texels as at the standard sizes."""
    samples, resolution, size, scale = (8_000, 160, 128, 4.0) if quick else (20_000, 256, 256, 2.0)
    steps = 40 if quick else 80
    return Settings.model_validate(
        {
            "surface": {"samples": samples, "stroke_scale": scale},
            "atlas": {"size": size},
            "rig": {"resolution": resolution},
            "fit": {"iterations1": steps, "iterations2": steps, "crops": 2, "crop_size": 96, "refine": "all"},
        }
    )


def prepare(mesh: Path, style: Path, settings: Settings, slope: float, spp: int, cache: Path | None) -> Bench:
    """The object painted, and which of its texels count."""
    asset = read_mesh(mesh, size=settings.atlas.size)
    atlas = stylize_start.lay_out(asset, settings, silent)
    scene = known.painted(asset, read_picture(style), atlas, settings, slope, seed=0)
    cameras = known.cameras_of(settings.rig.resolution, 16)
    truth = Truth("", asset.mesh, atlas.texels, scene.truth, scene.areas)
    count = seen(truth, cameras)
    return Bench(scene, tuple(cameras), tuple(observed_areas(truth, count)), count, settings, spp, cache)


def measure(bench: Bench, kind: str) -> tuple[dict[str, Sequence[Maps]], dict[str, float]]:
    """The maps by row, and the figures, of one kind of views."""
    if kind == "struggle":
        return {}, struggling(bench)
    return unlit_rows(bench) if kind == "unlit" else lit_rows(bench, lights(KINDS[kind]))


def lit_rows(bench: Bench, lit: Lights) -> tuple[dict[str, Sequence[Maps]], dict[str, float]]:
    """Views that show light."""
    scene, mesh, figures = bench.scene, bench.scene.asset.mesh, dict[str, float]()
    views = known.lit_views(scene, scene.truth, bench.cameras, lit, bench.spp, bench.cache)
    flat = known.baked(scene, views)
    chosen = bench.settings.fit.model_copy(update={"painted": "with-light"})
    paper = chosen.model_copy(update={"judge": False})
    old = timed(
        figures,
        "paper.seconds",
        lambda: two_phase(mesh, FitStart(flat), FitTargets(views), scene.atlas.texels, paper, 0),
    )
    new = timed(figures, "phase2.seconds", lambda: lit_phases(mesh, flat, views, scene.atlas.texels, lit, chosen, 0))
    first = [_with(b, m, "normal", "roughness") for b, m in zip(flat, new.maps, strict=True)]
    captures = in_memory(bench.cameras, [lit] * len(views), [v.rgb for v in views], [view_mask(v) for v in views])
    bound = timed(figures, "solver.seconds", lambda: solver(bench, captures))
    rows = {"flat": flat, "painter": scene.painter, "paper": old.maps, "phase1": first, "phase2": new.maps}
    rows["solver"] = bound
    figures |= errors(bench, rows)
    for name in ("normal", "roughness"):
        figures[f"{name}_ratio"] = figures[f"phase1.{name}"] / figures[f"flat.{name}"]
    for row in ("paper", "phase2", "solver"):
        slope, spread = light_left(bench.weights, scene.truth, flat, rows[row])
        prefix = "" if row == "phase2" else f"{row}."
        figures |= {f"{prefix}albedo_light_left": slope, f"{prefix}albedo_spread_left": spread}
    return rows, figures


def unlit_rows(bench: Bench) -> tuple[dict[str, Sequence[Maps]], dict[str, float]]:
    """Views that show the albedo: nothing in them but the painter's rule tells of relief."""
    scene, mesh, texels = bench.scene, bench.scene.asset.mesh, bench.scene.atlas.texels
    views, figures = known.unlit_views(scene, bench.cameras), dict[str, float]()
    chosen = bench.settings.fit.model_copy(update={"judge": False})
    rows: dict[str, Sequence[Maps]] = {"flat": scene.flat, "painter": scene.painter}
    for row, refine in (("phase1", "normal-roughness"), ("phase2", "all")):
        each = chosen.model_copy(update={"refine": refine})
        rows[row] = two_phase(mesh, FitStart(scene.flat, begin=scene.painter), FitTargets(views), texels, each, 0).maps
    return rows, figures | errors(bench, rows)


def struggling(bench: Bench) -> dict[str, float]:
    """Precision and recall of the repair's mask over views with planted contradictions and views without, after few
    steps and after four times as many; by `repair.outlier` and `repair.agreement`, and at their defaults."""
    scene, steps = bench.scene, bench.settings.fit.iterations2
    views = known.unlit_views(scene, bench.cameras)
    fits = []
    for planted in (struggle.clean(scene, views), *(struggle.plant(scene, views, seed) for seed in (0, 1))):
        begin = known.baked(scene, planted.views)
        for iterations, crops in ((steps, 2), (4 * steps, 4)):
            more = {"iterations1": 0, "iterations2": iterations, "crops": crops, "judge": False}
            chosen = bench.settings.fit.model_copy(update=more)
            fits.append(
                (
                    planted,
                    two_phase(
                        scene.asset.mesh, FitStart(begin), FitTargets(planted.views), scene.atlas.texels, chosen, 0
                    ),
                )
            )
    figures: dict[str, float] = {}
    choices = {
        f".outlier_{outlier:g}.agreement_{agreement:g}": RepairSettings(outlier=outlier, agreement=agreement)
        for outlier in struggle.OUTLIERS
        for agreement in struggle.AGREEMENTS
    }
    for name, repair in (choices | {"": RepairSettings()}).items():
        each = [struggle.found(scene, fit, bench.seen, planted, repair) for planted, fit in fits]
        both = struggle.precision_and_recall(np.sum(each, axis=0))
        figures |= {f"{key}{name}": value for key, value in both.items()}
        seen_area = sum(float(a[s > 0].sum()) for a, s in zip(scene.areas, bench.seen, strict=True))
        figures[f"clean{name}"] = float(np.mean([e[1] for e in each[:2]])) / seen_area
    return figures


def solver(bench: Bench, captures: Any) -> Sequence[Maps]:
    """The material solver with its own settings, but for fewer steps on so small pictures."""
    steps = 240 if has_soft(captures.lights) else 960
    chosen = RecoverSettings(iterations=steps, bounces=4, bounce_samples=64)
    return recover(bench.scene.asset.mesh, bench.scene.atlas.texels, captures, chosen, 0).maps


def errors(bench: Bench, rows: dict[str, Sequence[Maps]]) -> dict[str, float]:
    """normal, roughness and albedo of every row."""
    result = {}
    for row, maps in rows.items():
        e = map_errors(bench.scene.truth, maps, bench.weights)
        result[f"{row}.normal"], result[f"{row}.roughness"] = e.normal_mean_deg, float(np.sqrt(e.roughness_mse))
        result[f"{row}.albedo"] = min(e.albedo_psnr, 99.0)
    return result


def light_left(
    weights: Sequence[np.ndarray], truth: Sequence[Maps], flat: Sequence[Maps], maps: Sequence[Maps]
) -> tuple[float, float]:
    """What is left of the light that `flat` has baked in: slope, and ratio of standard deviations, of the log."""
    weight = np.concatenate([w.ravel() for w in weights])
    weight = weight / weight.sum()

    def logs(of: Sequence[Maps]) -> np.ndarray:
        return np.log(np.maximum(np.concatenate([luminance(m.albedo).ravel() for m in of]), DARK))

    def excess(of: Sequence[Maps]) -> np.ndarray:
        ratio = logs(of) - logs(truth)
        return ratio - (weight * ratio).sum()

    before, after = excess(flat), excess(maps)
    square = float((weight * before**2).sum())
    return float((weight * before * after).sum()) / square, float(np.sqrt((weight * after**2).sum() / square))


def write_sheet(bench: Bench, rows: dict[str, Sequence[Maps]], file: Path) -> None:
    """Truth and every row, a line each: albedo, normal, roughness, and the object under a lamp from the side."""
    lines, camera = [], bench.cameras[1]
    for maps in [bench.scene.truth, *rows.values()]:
        view = known.lit_views(bench.scene, maps, [camera], (LAMP,), 32)[0]
        at, columns = np.nonzero(view.mask)
        shown = view.rgb[at.min() : at.max() + 1, columns.min() : columns.max() + 1]
        m, size = maps[0], bench.settings.rig.resolution
        rough = np.repeat(m.roughness[..., None], 3, axis=-1)
        flat = [srgb_from_linear(np.clip(m.albedo, 0, 1)), m.normal / 2 + 0.5, rough, srgb_from_linear(shown)]
        tiles = [Image.fromarray(np.round(np.clip(t, 0, 1) * 255).astype(np.uint8)).resize((size, size)) for t in flat]
        lines.append(np.concatenate([np.asarray(t) for t in tiles], axis=1))
    file.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.concatenate(lines)).save(file)


def _with(maps: Maps, other: Maps, *names: str) -> Maps:
    return replace(maps, **{name: getattr(other, name) for name in names})


if __name__ == "__main__":
    main()
