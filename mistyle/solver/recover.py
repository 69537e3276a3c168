"""Recovering materials: albedo, normal, roughness and metallic from pictures of known cameras under known light.

1. `texels/solve.py` solves each texel alone by Levenberg-Marquardt. It renders nothing: cameras and lights are known.
   Twenty such steps reach a result that hundreds of gradient steps on pictures do not.
2. `pictures/descend.py` minimises the loss of whole pictures by Adam, through `render/deferred/renderer.py`, which
   models pixels and interpolation exactly.
3. `joint/gauss_newton.py` ends with a joint Gauss-Newton over all texels and pictures, under delta lights only.

Smoothness priors (`solver/smoothing.py`) act before, between and after the passes of Adam. All stages fit to direct
light: indirect light is estimated with the current maps and subtracted from the pictures (`bounces`). Lights and
cameras are fixed. A common factor of light and albedo is not identifiable: albedo is as accurate as the lights' units.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from mistyle.core.capture import Captures
from mistyle.core.maps import Maps, Texels
from mistyle.core.mesh import Mesh
from mistyle.core.stage_progress import StageProgress
from mistyle.render.deferred.material_table import ALBEDO, METALLIC, ROUGHNESS, TILT, MaterialTable
from mistyle.solver.context import DirectCaptures, FitContext
from mistyle.solver.joint.gauss_newton import joint_gauss_newton, where_possible
from mistyle.solver.pictures.descend import Checkpoints, optimise_on_pictures
from mistyle.solver.settings import RecoverSettings, descent_steps
from mistyle.solver.smoothing import map_smoothing
from mistyle.solver.table import atlas_of, linked
from mistyle.solver.texels.solve import TexelEstimate, solve_level
from mistyle.solver.validate import validate_captures

__all__ = ["Checkpoints", "RecoverSettings", "Recovered", "recover"]

# Standard deviations at which a texel's confidence is a half: normal (sine), roughness, albedo, metallic.
HALF_SURE = {"normal": 0.05, "roughness": 0.1, "albedo": 0.05, "metallic": 0.2}
CHANNELS = {
    "albedo": ALBEDO,
    "normal": TILT,
    "roughness": slice(ROUGHNESS, ROUGHNESS + 1),
    "metallic": slice(METALLIC, METALLIC + 1),
}
NO_CHECKPOINTS = Checkpoints()


@dataclass(frozen=True)
class Recovered:
    """The fitted maps and their uncertainty, per texture set.

    maps        `known` is True where at least one picture observed the texel in the light
    confidence  0..1: 1 / (1 + mean of (standard deviation / HALF_SURE)²); 1 is certain, 0 unobserved
    spread      standard deviations of albedo, normal (of the tilt: radians), roughness and metallic
    seen        number of pictures that observed the texel in the light
    views       number of different cameras that did
    trace       values per round and step, by name
    residuals   per picture by its name: root mean square of reference - render, relative to the reference's
    notes       sentences for the report
    """

    maps: tuple[Maps, ...]
    confidence: tuple[Float[np.ndarray, "_ _"], ...]
    spread: tuple[dict[str, Float[np.ndarray, "h w"]], ...]
    seen: tuple[Int[np.ndarray, "h w"], ...]
    views: tuple[Int[np.ndarray, "h w"], ...]
    trace: dict[str, list[float]]
    residuals: dict[str, float]
    notes: tuple[str, ...]


def recover(
    mesh: Mesh,
    texels: Sequence[Texels],
    captures: Captures,
    settings: RecoverSettings,
    seed: int,
    progress: Callable[[float], None] = lambda done: None,
    *,
    start: Sequence[Maps] | None = None,
    checkpoints: Checkpoints = NO_CHECKPOINTS,
) -> Recovered:
    """Fit one set of maps per texture set to `captures`; equal input, settings, seed and threads give equal bytes.

    `start` maps initialise the solver and keep their metallic unless it is fitted. `checkpoints` save the state from
    which a later call ends with the same bytes. Unusable pictures are skipped with a note. Raises InputRefused if all
    are.
    """
    from mistyle.render.deferred.image_samples import tangents_of
    from mistyle.render.mitsuba.draw import tracer

    settings, notes = where_possible(settings, captures), []
    usable, traced = validate_captures(mesh, captures, notes), tracer(mesh)
    # The steps on whole pictures have no neighbours.
    grid = atlas_of(texels) if settings.solver == "pictures" else linked(mesh, texels)
    tangents = tangents_of(mesh, settings.frame)
    context = FitContext(traced, tangents, texels, grid, usable, settings, seed, notes)
    part, descends = StageProgress(progress).part, descent_steps(settings) > 0
    renderer = context.renderer(gradients=descends)
    estimate, direct = solve_level(context, renderer, start, part(0, 0.5))
    renderer.retarget(direct.direct_only(), direct.pixel_confidence)
    if estimate.solved and settings.smooth:
        table = map_smoothing(estimate.table, estimate.unconstrained, grid, settings.roughness_floor, settings.metallic)
        estimate = replace(estimate, table=table)
    table = estimate.table
    if descends:
        table, direct = optimise_on_pictures(context, renderer, estimate, direct, part(0.5, 0.85), checkpoints)
        if estimate.solved and settings.joint:
            # This renderer has finer pictures; the samples of the other one are freed first.
            renderer = context.renderer(subsamples=settings.joint_subsamples, memory=0)
            table, direct = joint_gauss_newton(context, renderer, table, direct, part(0.85, 0.95))
    if settings.polish:
        table = polished(context, table, part(0.95, 1))
    uploaded = renderer.upload(table)
    residuals = {
        camera.name: _residual(direct, renderer.image_and_coverage(uploaded, k), k)
        for k, camera in enumerate(usable.cameras)
    }
    progress(1.0)
    return _recovered(context, estimate, table, residuals)


def polished(context: FitContext, table: MaterialTable, progress: Callable[[float], None]) -> MaterialTable:
    """Steps through `prb` from `table`, against pictures with all their light.

    A result whose loss does not fall is dropped, with a note.
    """
    from mistyle.render.deferred.material_table import pack, unpack
    from mistyle.solver.pictures.polish import PolishSettings, polish

    s = context.settings
    chosen = PolishSettings(s.polish, s.loss, s.polish_rate, s.metallic, s.polish_depth, model=s.model, frame=s.frame)
    start = unpack(table, context.atlas.sizes)
    result = polish(context.traced.mesh, start, context.captures, chosen, context.seed, progress)
    context.trace["polish.loss"], context.trace["polish.whole"] = list(result.trace), list(result.loss)
    if not result.loss[1] < result.loss[0]:
        context.notes.append(
            f"The polish was undone: the loss changed from {result.loss[0]:.3g} to {result.loss[1]:.3g}."
        )
        return table
    return pack(result.maps)


def _residual(direct: DirectCaptures, drawn: tuple[np.ndarray, np.ndarray], k: int) -> float:
    """RMS of reference - render (`image_and_coverage`) of picture k, relative to the RMS of the reference."""
    (rgb, mask), (image, coverage) = direct.load(k), drawn
    inside = mask & (coverage > 0.999)
    reference = rgb[inside].astype(np.float64)
    residual = reference - image[inside]
    return float(np.sqrt((residual**2).sum() / max((reference**2).sum(), 1e-30)))


def _recovered(
    context: FitContext, estimate: TexelEstimate, table: MaterialTable, residuals: dict[str, float]
) -> Recovered:
    from mistyle.render.deferred.material_table import unpack

    grid, settings = context.atlas, context.settings
    names = [n for n in CHANNELS if n != "metallic" or settings.metallic]
    variance = {n: (estimate.std[:, CHANNELS[n]] ** 2).mean(axis=1) for n in CHANNELS}
    doubt = np.mean([variance[n] / HALF_SURE[n] ** 2 for n in names], axis=0)
    sure = np.where(estimate.seen > 0, 1 / (1 + doubt), 0).astype(np.float32)

    def grids(values: np.ndarray) -> tuple[np.ndarray, ...]:
        return tuple(values[part].reshape(size) for part, size in zip(grid.parts, grid.sizes, strict=True))

    seen = grids(estimate.seen.astype(np.int32))
    maps = [replace(m, known=s > 0) for m, s in zip(unpack(table, grid.sizes), seen, strict=True)]
    spreads = {n: grids(np.sqrt(v).astype(np.float32)) for n, v in variance.items()}
    return Recovered(
        maps=tuple(maps),
        confidence=grids(sure),
        spread=tuple({n: spreads[n][k] for n in CHANNELS} for k in range(len(grid.sizes))),
        seen=seen,
        views=grids(estimate.views.astype(np.int32)),
        trace=context.trace,
        residuals=residuals,
        notes=tuple(context.notes),
    )
