"""The style fit (paper 4.2): seconds, where they go, and what its choices are worth. `python -m benchmarks.style_fit`

standard.seconds          the whole fit of the standard preset (2048 atlas, 16 views of 1024², embedded features) on
                          the bunny; .cpu its processor time, .phase1_step and .phase2_step the seconds of one step
split.<phase>.<part>      seconds per step: surface (rays, lights, texel weights), picture (fetch and shading),
                          features, backward (of which pull is Dr.Jit's), texels (total variation and Adam), other
bridge.<phase>.<way>      least seconds of a step by the frozen split and by dr.wrap, in turns, one run; .speedup of the
                          whole step, bridge.<phase>.shading_speedup of picture and gradient alone
vgg.<phase>_step          seconds per step with the VGG-19 of data/weights, at crops of the size vgg.crop_size, and
                          vgg.<phase>_fall, by which share the style loss of a fixed set of crops fell
ranking.<statistic>.…     the filter bank's style distances against those of VGG relu1_1-3_1 over halves and quarter
                          turns of all pictures in data/styles: spearman, and triplets, the share of (a; b, c) for which
                          both find the same one closer to a; statistic is gram, or mean_std of every map
lights.<choice>.…         phase 1 on spot: slope_correlation of the fitted tilt with the slopes of the strokes that it
                          should show; detail (more is better), style and views (less is better) as in the report

--quick takes small sizes and few steps, only to see that it works. --only NAME … runs some of the five parts.
"""

import argparse
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np

from benchmarks.common import DATA, finish, timed
from benchmarks.style_fit.ranking import ranking
from mistyle.core.camera import rig
from mistyle.core.maps import Maps, Texels
from mistyle.core.mesh import Mesh
from mistyle.core.view import View
from mistyle.stylization.settings import Settings, resolve

VGG = DATA / "weights" / "vgg19_normalised_relu3_1.pth"
PROBES = 4  # sets of crops by which the fall of the loss is measured
PARTS = ("standard", "bridge", "vgg", "ranking", "lights")


@dataclass(frozen=True)
class Problem:
    """What the fit of a job starts from."""

    mesh: Mesh
    maps: list[Maps]
    texels: list[Texels]
    views: list[View]
    settings: Settings


def problem(mesh: str, style: str, preset: str, changes: dict[str, Any]) -> Problem:
    """The stages of `mistyle stylize` up to the fit, without files."""
    from mistyle.core.image import linear_from_srgb
    from mistyle.io.read import read_picture
    from mistyle.jobs import start
    from mistyle.render.mitsuba.draw import gbuffer, tracer
    from mistyle.stylization.pipeline import painting
    from mistyle.stylization.pipeline import start as stylize_start
    from mistyle.stylization.surface.lookup import colour

    def silent(done: float) -> None:
        pass

    settings = resolve(preset, None, changes)
    start.start_engines(settings)
    asset = start.read(DATA / mesh, settings.read, settings.atlas.size, silent)
    atlas = stylize_start.lay_out(asset, settings, silent)
    solution = painting.paint(asset, read_picture(DATA / style), settings, silent)
    maps = []
    for part, (texels, own) in enumerate(zip(atlas.texels, atlas.start, strict=True)):
        albedo, at = np.zeros_like(own.albedo), texels.covered
        side = painting.texel_side(asset, part, texels)
        painted = colour(solution, texels.position[at], texels.normal[at], footprint=side)
        albedo[at] = linear_from_srgb(painted)
        maps.append(replace(own, albedo=albedo, known=texels.covered))
    traced, views = tracer(asset.mesh), []
    for camera in rig(settings.rig):
        hits = gbuffer(traced, camera)
        rgb, inside = np.zeros((*hits.mask.shape, 3), np.float32), hits.mask.astype(np.float32)
        views.append(View(camera, rgb, hits.depth, hits.normal, hits.uv, hits.part, hits.mask, inside))
    return Problem(asset.mesh, maps, list(atlas.texels), painting.unlit_views(asset, maps, views, silent), settings)


def whole(where: Problem, figures: dict[str, float]) -> None:
    """The fit as a job runs it; then a few steps of each phase, part by part."""
    from mistyle.stylization.optimise.two_phase import FitStart, FitTargets, two_phase

    marks: list[float] = []

    def fit() -> Any:
        return two_phase(
            where.mesh,
            FitStart(where.maps),
            FitTargets(where.views),
            where.texels,
            where.settings.fit,
            0,
            lambda done: marks.append(time.perf_counter()),
        )

    timed(figures, "standard.seconds", fit)
    figures["standard.cpu"] = figures.pop("standard.seconds.cpu")
    first = where.settings.fit.iterations1
    for name, part in (("phase1", marks[:first]), ("phase2", marks[first:])):
        figures[f"standard.{name}_step"] = float(np.median(np.diff(part)))
    for name, run in steppers(where, where.settings.fit):
        for k in range(3):
            run.step(k)
        count, spent = 8, defaultdict(float)
        with watched(run, spent):
            start = time.perf_counter()
            for k in range(count):
                run.step(3 + k)
            total = (time.perf_counter() - start) / count
        parts = {part: seconds / count for part, seconds in spent.items()}
        parts["other"] = total - sum(seconds for part, seconds in parts.items() if part != "pull")
        figures |= {f"split.{name}.{part}": seconds for part, seconds in parts.items()}
        figures[f"split.{name}.step"] = total


def steppers(where: Problem, settings: Any) -> Iterator[tuple[str, Any]]:
    """Both phases, ready to step, one after the other on one table."""
    from mistyle.stylization.optimise import phase as fit_run
    from mistyle.stylization.optimise import table as fit_table
    from mistyle.stylization.optimise import two_phase as fit

    scene = fit._scene(where.mesh, where.views, settings)
    shrink = fit.shrinkage(where.mesh, where.texels, where.views, settings.texels_per_pixel)
    table = fit_table.build(where.maps, where.texels, shrink)
    for phase in fit._phases(settings, fit.FitTargets(where.views)):
        yield phase.name, fit_run.PhaseRunner(scene, table, phase, settings, np.random.default_rng(0))


@contextmanager
def watched(run: Any, spent: dict[str, float]) -> Iterator[None]:
    """Adds up the seconds of the parts of a step."""
    import torch

    from mistyle.render.deferred import integrator as deferred
    from mistyle.render.deferred import split, torch_bridge
    from mistyle.stylization.optimise import table as fit_table

    def clocked(name: str, function: Callable) -> Callable:
        def work(*arguments: Any, **options: Any) -> Any:
            start = time.perf_counter()
            try:
                return function(*arguments, **options)
            finally:
                spent[name] += time.perf_counter() - start

        return work

    places = [("surface", deferred, "trace"), ("surface", run, "_light"), ("surface", torch_bridge, "taps")]
    places += [("picture", torch_bridge, "fetch"), ("picture", run, "shader"), ("backward", torch.Tensor, "backward")]
    places += [("pull", split.Split, "pull")]
    places += [("texels", fit_table, name) for name in ("pairs", "variation", "step")]
    features = clocked("features", run.scene.features)
    with ExitStack() as stack:
        for name, owner, attribute in places:
            stack.enter_context(patch.object(owner, attribute, clocked(name, getattr(owner, attribute))))
        stack.enter_context(patch.object(run, "scene", replace(run.scene, features=features)))
        yield


def bridges(where: Problem, figures: dict[str, float], count: int) -> None:
    """The same steps by both ways between torch and Dr.Jit, turn about."""
    ways = {way: where.settings.fit.model_copy(update={"bridge": way}) for way in ("frozen", "wrap")}
    runs = {way: steppers(where, settings) for way, settings in ways.items()}
    for _ in range(2):
        pair = {way: next(runs[way]) for way in ways}
        took: dict[str, list[float]] = {way: [] for way in ways}
        shading: dict[str, list[float]] = {way: [] for way in ways}
        for k in range(count + 3):
            for way, (_, run) in pair.items():
                start = time.perf_counter()
                run.step(k)
                took[way].append(time.perf_counter() - start)
                shading[way].append(_shading(run))
        name = pair["frozen"][0]
        for way in ways:
            figures[f"bridge.{name}.{way}"] = float(np.min(took[way][3:]))
            figures[f"bridge.{name}.{way}_shading"] = float(np.min(shading[way][3:]))
        figures[f"bridge.{name}.speedup"] = figures[f"bridge.{name}.wrap"] / figures[f"bridge.{name}.frozen"]
        figures[f"bridge.{name}.shading_speedup"] = (
            figures[f"bridge.{name}.wrap_shading"] / figures[f"bridge.{name}.frozen_shading"]
        )


def _shading(run: Any) -> float:
    """Seconds of a picture of new crops and its gradient, without tracing, fetching and losses."""
    import torch

    from mistyle.core.camera import zoom
    from mistyle.render.deferred import integrator as deferred
    from mistyle.render.deferred import torch_bridge
    from mistyle.stylization.optimise import phase as fit_run

    scene, size = run.scene, run.settings.crop_size
    cameras = [zoom(scene.cameras[c.view], c.x, c.y, c.width, (size, size)) for c in run._crops()]
    surface = deferred.trace(scene.traced, cameras, scene.tangents)
    lit, _ = run._light(surface)
    where = torch_bridge.taps(surface, run.table.sizes)
    leaves = {n: torch.from_numpy(v[where.texels]) for n, v in run.table.values.items()}
    pixels = torch_bridge.fetch(fit_run.materials(leaves, run.phase.clay), where).requires_grad_()
    moving = ["normal" if name == "tilt" else name for name in run.phase.rates]
    start = time.perf_counter()
    run.shader(lit, pixels, moving).square().mean().backward()
    return time.perf_counter() - start


def with_vgg(where: Problem, figures: dict[str, float], count: int, size: int) -> None:
    """Both phases with the real VGG-19, on smaller crops."""
    update = {"features": VGG, "crops": 2, "crop_size": size, "iterations1": count, "iterations2": count}
    settings = where.settings.fit.model_copy(update=update)
    figures["vgg.crop_size"] = size
    for name, run in steppers(where, settings):
        crops = [run._crops() for _ in range(PROBES)]
        before, took = _style(run, crops), []
        for k in range(count):
            start = time.perf_counter()
            note = run.step(k)
            took.append(time.perf_counter() - start)
            if note:
                raise SystemExit(note)
        figures[f"vgg.{name}_step"] = float(np.median(took[1:]))
        figures[f"vgg.{name}_fall"] = 1 - _style(run, crops) / before


def _style(run: Any, sets: Sequence[Any]) -> float:
    """The style loss of some sets of crops, lit as the first steps light them; nothing moves."""
    from mistyle.stylization.optimise.phase import PhaseRunner

    probe = PhaseRunner(run.scene, replace(run.table), run.phase, run.settings, np.random.default_rng(0))
    for crops in sets:
        probe._gradients(crops)
    return float(np.mean(probe.trace["style"]))


def lights(where: Problem, figures: dict[str, float]) -> None:
    """Phase 1 under all lights together, and one a crop."""
    from mistyle.core.light import lights as scene_lights
    from mistyle.geometry.tangents import corner_tangents
    from mistyle.render.mitsuba.draw import tracer
    from mistyle.stylization.optimise import judge as fit_judge
    from mistyle.stylization.optimise.two_phase import FitStart, FitTargets, two_phase

    judge = fit_judge.build_evaluation(tracer(where.mesh), corner_tangents(where.mesh), where.views)
    for choice in ("together", "one-per-view"):
        update = {"refine": "normal-roughness", "lights": choice, "judge": False}
        settings = where.settings.fit.model_copy(update=update)
        fit = two_phase(where.mesh, FitStart(where.maps), FitTargets(where.views), where.texels, settings, 0)
        name = choice.replace("-", "_")
        figures[f"lights.{name}.slope_correlation"] = slope_correlation(where, fit.maps)
        for figure, value in fit_judge.evaluate(judge, fit.maps, scene_lights("phase1")).items():
            figures[f"lights.{name}.{figure}"] = value


def slope_correlation(where: Problem, fitted: Sequence[Maps]) -> float:
    """Of the tilt with minus the slope of the painting's brightness, over covered texels away from islands' rims.

    Charts keep angles and, nearly, lengths, so slopes in the texture are slopes on the surface, up to one factor.
    """
    from mistyle.core.image import erode, gaussian, srgb_from_linear

    tilts, slopes = [], []
    for before, after, texels in zip(where.maps, fitted, where.texels, strict=True):
        height = gaussian(srgb_from_linear(before.albedo).mean(axis=-1), 1.5)
        down, across = np.gradient(height)
        inner = erode(texels.covered, 6)
        tilts.append(after.normal[inner][:, :2] - before.normal[inner][:, :2])
        slopes.append(np.stack([-across[inner], down[inner]], axis=1))
    tilt, slope = np.concatenate(tilts).ravel(), np.concatenate(slopes).ravel()
    return float(np.corrcoef(tilt, slope)[0, 1])


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.style_fit", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--quick", action="store_true", help="small sizes, only to see that it works")
    parser.add_argument("--json", type=Path, metavar="FILE", help="also write the figures as JSON")
    parser.add_argument("--only", nargs="+", choices=PARTS, default=PARTS, help="some of the parts")
    options = parser.parse_args()
    quick = {"fit": {"iterations1": 12, "iterations2": 12, "crop_size": 128}, "surface": {"samples": 20_000}}
    bunny, spot, style = "meshes/plain/stanford-bunny.obj", "meshes/plain/spot.obj", "styles/starry_night.jpg"
    figures: dict[str, float] = {}
    if set(options.only) & {"standard", "bridge", "vgg"}:
        large = problem(spot, style, "draft", quick) if options.quick else problem(bunny, style, "standard", {})
        if "standard" in options.only:
            whole(large, figures)
        if "bridge" in options.only:
            bridges(large, figures, 4 if options.quick else 12)
        if "vgg" in options.only:
            with_vgg(large, figures, 4 if options.quick else 24, 64 if options.quick else 128)
    if "ranking" in options.only:
        figures |= ranking(DATA / "styles", VGG, 128 if options.quick else 256)
    if "lights" in options.only:
        changes = quick if options.quick else {"fit": {"iterations1": 120, "crops": 4, "crop_size": 192}}
        lights(problem(spot, style, "draft", changes), figures)
    finish(figures, options.json)


if __name__ == "__main__":
    main()
