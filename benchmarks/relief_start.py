"""Does a relief guessed from the painting help the fit? `python -m benchmarks.relief_start [--quick] [--json FILE]`

Phase 1 (normal and roughness of strokes) of the demo mesh is run from flat maps and from the painting's own height and
gloss (`mistyle.stylization.surface.exemplar.relief`), with the same crops. What counts as unfitted is the flat object
both times. Figures: `<start>.loss_<step>` (mean of ten steps about it, style and statistics together), `steps_to_match`
(steps after which the painted start is where the flat one ends) and `correlation` (of both starts' final tilts).
`--sheet FILE` draws clay and paint under a raking light: flat maps, painted start, both fits.
"""

import argparse
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from benchmarks.common import ROOT, finish, timed
from mistyle.core.camera import rig
from mistyle.core.image import srgb_from_linear
from mistyle.core.settings import RigSettings
from mistyle.core.view import View
from mistyle.io.read import read_picture
from mistyle.io.read_mesh import read_mesh
from mistyle.jobs import start
from mistyle.stylization.optimise import two_phase as fit
from mistyle.stylization.pipeline import painting
from mistyle.stylization.pipeline import start as stylize_start
from mistyle.stylization.settings import Settings

SCENES = ROOT / "scenes"
WINDOW = 10


def silent(done: float) -> None:
    pass


def views_of(asset: Any, maps: Any, resolution: int) -> list[View]:
    """The unlit views that the fit aims at."""
    from mistyle.render.mitsuba.draw import gbuffer, tracer

    traced, blank = tracer(asset.mesh), []
    for camera in rig(RigSettings(resolution=resolution)):
        hits = gbuffer(traced, camera)
        cover = hits.mask.astype(np.float32)
        blank.append(View(camera, hits.position, hits.depth, hits.normal, hits.uv, hits.part, hits.mask, cover))
    return painting.unlit_views(asset, maps, blank, silent)


def lit(asset: Any, maps: Any, resolution: int) -> np.ndarray:
    """The object in the studio from two sides, as it is and as clay."""
    from mistyle.render.mitsuba.draw import pictures
    from mistyle.render.mitsuba.scene import Staging

    cameras = rig(RigSettings(resolution=resolution))[:2]
    clay = [replace(m, albedo=np.full_like(m.albedo, 0.5)) for m in maps]
    shown = [p for each in (maps, clay) for p in pictures(asset.mesh, each, cameras, Staging(spp=32))]
    return np.concatenate([srgb_from_linear(p[..., :3]) for p in shown], axis=1)


def main() -> None:
    options = argparse.ArgumentParser(prog="python -m benchmarks.relief_start", description=__doc__)
    options.add_argument("--quick", action="store_true")
    options.add_argument("--json", type=Path, metavar="FILE")
    options.add_argument("--sheet", type=Path, metavar="FILE")
    chosen = options.parse_args()
    samples, resolution, steps, crop = (20_000, 192, 40, 64) if chosen.quick else (80_000, 512, 150, 192)
    size = 512 if chosen.quick else 1024
    base: dict[str, Any] = {"surface": {"samples": samples}, "atlas": {"size": size}}
    base["fit"] = {"iterations1": steps, "crops": 2, "crop_size": crop, "refine": "normal-roughness", "judge": False}
    plain = Settings.model_validate(base)
    start.start_engines(plain)
    asset = read_mesh(SCENES / "demo.obj")
    atlas = stylize_start.lay_out(asset, plain, silent)
    layers = painting.paint_layers(asset, read_picture(SCENES / "demo_style.png"), atlas, plain, silent)
    flat, begun = painting.raised(asset, layers, atlas, plain)
    targets = views_of(asset, flat, resolution)
    figures: dict[str, float] = {}
    results: dict[str, Any] = {}
    for name, begin in (("flat", ()), ("painted", begun)):
        results[name] = timed(
            figures,
            f"{name}.seconds",
            lambda begin=begin: fit.two_phase(
                asset.mesh, fit.FitStart(flat, begin=begin), fit.FitTargets(targets), atlas.texels, plain.fit, 0
            ),
        )
    losses = {name: loss(found.trace, steps) for name, found in results.items()}
    for name, course in losses.items():
        for step in (0, steps // 8, steps // 4, steps // 2, steps - WINDOW):
            figures[f"{name}.loss_{step}"] = float(course[step : step + WINDOW].mean())
    smooth = np.convolve(losses["painted"], np.ones(WINDOW) / WINDOW, "valid")
    reached = np.flatnonzero(smooth <= losses["flat"][-WINDOW:].mean())
    figures["steps"] = steps
    figures["steps_to_match"] = float(reached[0]) if len(reached) else float(steps)
    at = atlas.texels[0].covered
    tilts = [results[name].maps[0].normal[at][:, :2].ravel() for name in ("flat", "painted")]
    figures["correlation"] = float(np.corrcoef(*tilts)[0, 1])
    if chosen.sheet:
        rows = [flat, begun, results["flat"].maps, results["painted"].maps]
        sheet = np.concatenate([lit(asset, maps, min(resolution, 384)) for maps in rows])
        Image.fromarray(np.round(np.clip(sheet, 0, 1) * 255).astype(np.uint8)).save(chosen.sheet)
    finish(figures, chosen.json)


def loss(trace: dict[str, list[float]], steps: int) -> np.ndarray:
    """Phase 1's style and statistics, step by step."""
    parts = [np.array(values) for name, values in trace.items() if name in ("phase1.style", "phase1.statistics")]
    return np.sum(parts, axis=0)[:steps]


if __name__ == "__main__":
    main()
