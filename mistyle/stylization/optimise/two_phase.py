"""Two-phase fit of normal, roughness and albedo to stylized views (paper 4.2), by Adam through Mitsuba's gradients.

Phase 1 moves normal and roughness under the directional lights of `scenes/phase1_directional.xml`, in grey. Phase 2
moves the albedo under the ambient light of `scenes/phase2_ambient.xml`, normal and roughness at a reduced rate. The
target of both is the stylized view of the same camera, compared on random jittered crops.

Phase 1's objective depends on the stylizer (`painted`):

- "with-light": the view shows a lit object. The render with the baked albedo is compared with the view, feature by
  feature (the paper's style loss).
- "without-light": the view is as flat as an albedo. A direct comparison would make the normals cancel the light. So the
  object is rendered as clay and divided by its own render before the fit, which removes the shape's shading. The view
  is normalised by its local mean and contrast, which leaves the strokes. Strokes are assumed to be raised, bright ones
  most, with a relief of slope `relief`. The clay is compared with this relief's shading under the crop's light, by
  features and by their statistics. Each crop uses one light of the rig, in turn: only lights from several sides
  separate a slope from a bright spot. A key light from the opposite side inverts the relief's shading.

Phase 2 likewise: a view painted without light shows the paint's own colour, so its render has no specular reflection.
With it, an albedo below about 0.05 could not compensate, and dark strokes would become black.

Both phases are evaluated afterwards (`optimise/judge.py`), and undone where they made the renders worse.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from mistyle.core.image import erode, srgb_from_linear
from mistyle.core.light import Lights, lights
from mistyle.core.maps import Maps, Texels
from mistyle.core.mesh import Mesh, face_areas
from mistyle.core.stage_progress import StageProgress
from mistyle.core.view import View
from mistyle.geometry.tangents import corner_tangents
from mistyle.process import memory
from mistyle.render.mitsuba.draw import tracer
from mistyle.stylization.optimise import judge as fit_judge
from mistyle.stylization.optimise import table as fit_table
from mistyle.stylization.optimise.phase import CropBatch, Loss, Phase, PhaseRunner, SceneContext
from mistyle.stylization.optimise.settings import FitSettings

DARK = 0.01  # radiance of the clay below which a ratio is meaningless


@dataclass(frozen=True)
class Fit:
    """Result of the fit.

    maps      the fitted maps, one per texture set
    struggle  sum over the last steps of phase 2 of |d loss / d albedo| (mean over rgb); zero where phase 2 did not run
    touched   samples of a texel in those steps: the sum of its bilinear weights over pixels and steps, at the fit's
              resolution; struggle / touched is the mean gradient per sample
    trace     losses per step, by name ("phase1.style", …)
    kept      whether each phase that ran was kept
    figures   by "phase.figure": (before, after)
    notes     sentences for the report
    agreed    |sum| of the signed gradients (mean over rgb): equal to `struggle` where all steps have one sign, near 0
              where they contradict one another
    """

    maps: tuple[Maps, ...]
    struggle: tuple[Float[np.ndarray, "_ _"], ...]
    touched: tuple[Float[np.ndarray, "_ _"], ...]
    trace: dict[str, list[float]]
    kept: dict[str, bool]
    figures: dict[str, tuple[float, float]]
    notes: tuple[str, ...]
    agreed: tuple[Float[np.ndarray, "_ _"], ...] = ()


@dataclass(frozen=True)
class FitStart:
    """The maps as baked, one per texture set.

    begin  start of the fit; empty: the baked maps. Their detail finer than the views stays, and they are returned if
           every phase is undone. Phase 1's clay is still compared with clay of the baked maps
    only   the texels that may change; all others keep their bytes
    """

    maps: Sequence[Maps]
    begin: Sequence[Maps] = ()
    only: Sequence[Bool[np.ndarray, "_ _"]] | None = None


@dataclass(frozen=True)
class FitTargets:
    """Targets of the fit.

    views   stylized (linear rgb)
    unlit   the same without light, for phase 2
    style   the picture (sRGB) whose gradient lowers the albedo's total-variation weight; None: that of the views
    lights  of phase 1; None: those of `scenes/phase1_directional.xml`
    """

    views: Sequence[View]
    unlit: Sequence[View] | None = None
    style: Float[np.ndarray, "sh sw 3"] | None = None
    lights: Lights | None = None


def two_phase(
    mesh: Mesh,
    start: FitStart,
    targets: FitTargets,
    texels: Sequence[Texels],
    settings: FitSettings,
    seed: int,
    progress: Callable[[float], None] = lambda done: None,
) -> Fit:
    """Fit maps (one per texture set) so that renders match the targets.

    The same inputs, settings, seed and thread count give the same bytes. A non-finite gradient ends its phase at the
    last good state, and a note names the texel.
    """
    maps, views = start.maps, targets.views
    first = tuple(start.begin or maps)
    if settings.metallic == "zero":
        maps, first = (tuple(replace(m, metallic=np.zeros_like(m.metallic)) for m in each) for each in (maps, first))
    nothing = tuple(np.zeros(m.roughness.shape, np.float32) for m in maps)
    fit = Fit(first, nothing, nothing, {}, {}, {}, (), nothing)
    if settings.refine == "off" or not any(view.mask.any() for view in views):
        return fit
    scene = _scene(mesh, views, settings)
    shrink = shrinkage(mesh, texels, views, settings.texels_per_pixel)
    table = fit_table.build(first, texels, shrink, start.only)
    if start.begin:
        unpainted = fit_table.build(maps, texels, shrink, start.only).values
        table.plain = table.start | {name: unpainted[name] for name in ("tilt", "roughness")}
    phases = _phases(settings, targets)
    evaluation = fit_judge.build_evaluation(scene.traced, scene.tangents, views) if settings.judge else None
    total, done = max(sum(phase.iterations for phase in phases), 1), 0
    for phase, rng in zip(phases, np.random.default_rng(seed).spawn(len(phases)), strict=True):
        if phase.iterations:
            unlit = targets.unlit
            if phase.name == "phase2" and unlit is not None:
                scene = replace(scene, targets=_pictures(unlit))
                if settings.judge:
                    evaluation = fit_judge.build_evaluation(scene.traced, scene.tangents, unlit)
            with memory.kept():
                runner = PhaseRunner(scene, table, phase, settings, rng)
                part = StageProgress(progress, done / total, (done + phase.iterations) / total)
                fit = _one_phase(runner, fit, first, start.only, evaluation, part)
            done += phase.iterations
    return fit


def _one_phase(
    runner: PhaseRunner,
    fit: Fit,
    first: tuple[Maps, ...],
    only: Sequence[Bool[np.ndarray, "_ _"]] | None,
    evaluation: fit_judge.EvaluationSet | None,
    progress: Callable[[float], None],
) -> Fit:
    """Run a phase and keep its result unless a metric got worse.

    At the steps of `judge.checks`, a phase far beyond the tolerances is stopped: it would be undone.
    """
    phase, table, notes = runner.phase, runner.table, list(fit.notes)
    saved = {name: table.values[name].copy() for name in phase.rates}

    def figures(maps: Sequence[Maps]) -> dict[str, float]:
        assert evaluation is not None
        return fit_judge.evaluate(evaluation, maps, phase.lights, gloss=phase.gloss)

    old = figures(fit.maps) if evaluation is not None else {}
    stops = fit_judge.checks(phase.iterations) if evaluation is not None else ()
    after, new, stopped = fit.maps, old, 0
    for iteration in range(phase.iterations):
        note = runner.step(iteration)
        if note:
            notes.append(note)
            break
        progress((iteration + 1) / phase.iterations)
        if iteration + 1 in stops:
            after = tuple(fit_table.finished(table, first, only))
            new = figures(after)
            if fit_judge.regressed(old, new, fit_judge.HOPELESS):
                stopped = iteration + 1
                break
    if not stopped:
        after = tuple(fit_table.finished(table, first, only))
        new = figures(after) if evaluation is not None else {}
    worse = fit_judge.regressed(old, new) if evaluation is not None else []
    if worse:
        early = f" after {stopped} of {phase.iterations} steps" if stopped else ""
        notes.append(f"{phase.name} was undone{early}: {', '.join(worse)} got worse.")
        table.values.update(saved)
    return Fit(
        maps=fit.maps if worse else after,
        struggle=tuple(fit_table.spread(table, first, runner.struggle)),
        touched=tuple(fit_table.spread(table, first, runner.touched)),
        agreed=tuple(fit_table.spread(table, first, np.abs(runner.pulled).mean(axis=1))),
        trace=fit.trace | {f"{phase.name}.{name}": values for name, values in runner.trace.items()},
        kept=fit.kept | {phase.name: not worse},
        figures=fit.figures | {f"{phase.name}.{name}": (old[name], new[name]) for name in old},
        notes=tuple(notes),
    )


def shrinkage(mesh: Mesh, texels: Sequence[Texels], views: Sequence[View], texels_per_pixel: float) -> int:
    """The power of two by which the atlas is shrunk for the fit: the finest resolution that the views resolve.

    Compares texels per unit of surface (covered texels over area) with pixels per unit of surface that faces a camera.
    """
    covered = sum(int(where.covered.sum()) for where in texels)
    area = float(face_areas(mesh).sum())
    closest = max(view.camera.focal / float(view.depth[view.mask].mean()) for view in views if view.mask.any())
    ratio = np.sqrt(covered / max(area, 1e-12)) / closest
    return 2 ** max(int(np.ceil(np.log2(ratio / texels_per_pixel))), 0)


def view_mask(view: View) -> Bool[np.ndarray, "h w"]:
    """Pixels wholly on the mesh with a finite colour."""
    return view.mask & (view.coverage > 0.999) & np.isfinite(view.rgb).all(axis=-1)


def _inside(view: View) -> Bool[np.ndarray, "h w"]:
    return erode(view_mask(view), 1)


def _pictures(targets: Sequence[View]) -> tuple[Any, ...]:
    """Targets in a SceneContext's layout."""
    import torch

    pictures = []
    for view in targets:
        rgb = srgb_from_linear(np.nan_to_num(view.rgb, posinf=1.0))
        stacked = np.concatenate([rgb, _inside(view)[..., None].astype(np.float32)], axis=-1)
        pictures.append(torch.from_numpy(memory.copied(stacked.transpose(2, 0, 1))))
    return tuple(pictures)


def _scene(mesh: Mesh, targets: Sequence[View], settings: FitSettings) -> SceneContext:
    from mistyle.measure.features import load_features

    return SceneContext(
        traced=tracer(mesh),
        tangents=corner_tangents(mesh),
        cameras=tuple(view.camera for view in targets),
        targets=_pictures(targets),
        masks=tuple(_inside(view) for view in targets),
        features=load_features(settings.features),
    )


def _phases(settings: FitSettings, targets: FitTargets) -> list[Phase]:
    """The phases that `refine` names (auto: both)."""
    flat = settings.painted != "with-light"
    moving = {"tilt": settings.rate_normal, "roughness": settings.rate_roughness}
    first = Phase(
        name="phase1",
        lights=targets.lights or lights("phase1"),
        one_by_one=flat and settings.lights == "one-per-view",
        clay=flat,
        gloss=True,
        rates=moving | ({"metallic": settings.rate_roughness} if settings.metallic == "fit" else {}),
        variation={"tilt": settings.tv_normal, "roughness": settings.tv_roughness},
        iterations=settings.iterations1,
        loss=_relief_loss(settings) if flat else _lit_loss(settings),
    )
    if settings.refine == "normal-roughness":
        return [first]
    alone = settings.refine == "albedo"
    reduced = 0.0 if alone else settings.reduced
    second = Phase(
        name="phase2",
        lights=lights("phase2"),
        one_by_one=False,
        clay=False,
        gloss=not (flat or targets.unlit is not None),
        rates={"albedo": settings.rate_albedo} | {name: rate * reduced for name, rate in moving.items() if reduced},
        variation={"albedo": _albedo_variation(settings, targets)},
        iterations=settings.iterations2,
        loss=_colour_loss(settings),
    )
    return [second] if alone else [first, second]


def _albedo_variation(settings: FitSettings, targets: FitTargets) -> float:
    from mistyle.measure.losses import adaptive_tv_weight, mean_gradient

    if targets.style is not None:
        return adaptive_tv_weight(mean_gradient(targets.style), settings.tv_albedo)
    gradients = [mean_gradient(srgb_from_linear(np.nan_to_num(view.rgb)), view_mask(view)) for view in targets.views]
    return adaptive_tv_weight(float(np.mean(gradients)), settings.tv_albedo)


def _relief_loss(settings: FitSettings) -> Loss:
    """Phase 1's loss for targets painted without light."""
    from mistyle.measure import losses

    def loss(batch: CropBatch, features, rng):
        radius = settings.radius * batch.zoomed
        grey = losses.srgb_from_linear(losses.luminance(losses.linear_from_srgb(batch.target)))
        strokes = losses.without_light(grey, batch.mask, radius, standard=True)
        smooth = losses.blur(strokes, settings.smooth * batch.zoomed)
        expected, mask = losses.stroke_shading(
            smooth, batch.position, batch.normal, batch.light, batch.mask, settings.relief
        )
        expected = expected + settings.sheen * strokes * mask
        before = losses.luminance(batch.plain).clamp_min(DARK)
        shading = (losses.luminance(batch.render) / before - 1) * mask
        maps, theirs = losses.masked_features(features, shading, expected, mask, mask)
        result = {"style": settings.style1 * losses.style_aligned(maps, theirs, mask)}
        if settings.statistics:
            distance = losses.style_statistics(maps, theirs, mask, mask, kind=settings.statistic, rng=rng)
            result["statistics"] = settings.statistics * distance
        return result

    return loss


def _lit_loss(settings: FitSettings) -> Loss:
    """Phase 1's loss for targets that show light: grey render against grey target."""
    from mistyle.measure import losses

    def loss(batch: CropBatch, features, rng):
        grey = losses.srgb_from_linear(losses.luminance(batch.render))
        target = losses.srgb_from_linear(losses.luminance(losses.linear_from_srgb(batch.target)))
        maps, expected = losses.masked_features(features, grey, target, batch.mask, batch.mask)
        return {"style": settings.style1 * losses.style_aligned(maps, expected, batch.mask)}

    return loss


def _colour_loss(settings: FitSettings) -> Loss:
    """Phase 2's loss: 15 style + 5 sliced Wasserstein in RGB, statistics on demand (the table adds total variation)."""
    from mistyle.measure import losses

    def loss(batch: CropBatch, features, rng):
        colour = losses.srgb_from_linear(batch.render)
        chosen = batch.mask[:, 0] > 0
        rendered, target = colour.permute(0, 2, 3, 1)[chosen], batch.target.permute(0, 2, 3, 1)[chosen]
        distance = losses.sliced_wasserstein(rendered, target, rng, settings.projections, settings.colour_samples)
        maps, expected = losses.masked_features(features, colour, batch.target, batch.mask, batch.mask)
        result = {"style": settings.style2 * losses.style_aligned(maps, expected, batch.mask)}
        result["colour"] = settings.colour2 * distance
        if settings.statistics2:
            distance = losses.style_statistics(maps, expected, batch.mask, batch.mask, kind=settings.statistic, rng=rng)
            result["statistics"] = settings.statistics2 * distance
        return result

    return loss
