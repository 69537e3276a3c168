"""Recovering materials: albedo, normal, roughness and metallic from pictures of known cameras under known light.

First texel by texel (`recover_solve.py`): with geometry, cameras and lights known nothing has to be rendered to
solve for one texel, and Levenberg-Marquardt gets in twenty steps where gradient descent on pictures does not get in
hundreds. Then on whole pictures (`recover_pictures.py`), by Adam through `render/shade.py`, which models pixels and
interpolation exactly. Before, in between and after that neighbours have a word about what pictures leave open
(`recover_smooth.py`). Under delta lights texels, pictures and neighbours are at last solved for together
(`recover_joint.py`). Light that reaches the surface by way of other surfaces is estimated with the maps found so far
and taken off the pictures, in all parts (`bounces`). Lights and cameras are taken as they are given; a common factor
of light and albedo cannot be told apart, so albedo is as right as the lights' units are.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from jaxtyping import Float, Int

from mistyle.core.capture import Captures
from mistyle.core.maps import Maps, Texels
from mistyle.core.mesh import Mesh
from mistyle.stages.recover_check import trust, usable, without
from mistyle.stages.recover_joint import together, where_possible
from mistyle.stages.recover_pictures import improved
from mistyle.stages.recover_settings import RecoverSettings, descent_steps
from mistyle.stages.recover_smooth import smoothed
from mistyle.stages.recover_table import atlas, linked
from mistyle.stages.recover_texels import Found, Work, solve_level

__all__ = ["RecoverSettings", "Recovered", "recover"]

# Standard deviations at which a texel's confidence has fallen to a half: normal (sine), roughness, albedo, metallic.
HALF_SURE = {"normal": 0.05, "roughness": 0.1, "albedo": 0.05, "metallic": 0.2}
CHANNELS = {"albedo": slice(0, 3), "normal": slice(3, 5), "roughness": slice(5, 6), "metallic": slice(6, 7)}


@dataclass(frozen=True)
class Recovered:
    """What was found, per texture set.

    maps        `known` is True where at least one picture observed the texel in the light
    confidence  0..1, 1 sure, 0 nothing seen: 1 / (1 + mean of (standard deviation / HALF_SURE)²)
    spread      standard deviations of albedo, normal (of the tilt: radians), roughness and metallic
    seen        how many pictures observed the texel in the light
    views       how many different cameras did
    trace       figures per round and step, by name
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
    save: Callable[[dict[str, np.ndarray]], None] | None = None,
    resume: dict[str, np.ndarray] | None = None,
) -> Recovered:
    """Fit one set of maps per texture set to `captures`; equal input, settings, seed and threads give equal bytes.

    `start` maps help the solver and keep their metallic where that is not fitted. Every `settings.checkpoint` seconds
    `save` receives what `resume` needs to end with the same bytes (only within the steps on whole pictures; what comes
    before is computed again). Raises InputRefused where no picture can be used; a picture that cannot is left out,
    and a note says so.
    """
    from mistyle.render.draw import tracer
    from mistyle.render.hits import tangents_of
    from mistyle.render.shade import Shade

    settings, notes = where_possible(settings, captures), []
    indirect: dict[int, np.ndarray] = {}
    whole = usable(mesh, captures, notes)
    captures = without(whole, indirect)
    traced = tracer(mesh)
    # The steps on whole pictures know no neighbours.
    where = atlas(texels) if settings.solver == "pictures" else linked(mesh, texels)
    work = Work(traced, tangents_of(mesh, settings.frame), texels, where, captures, settings, notes)
    pictured = partial(
        Shade, traced, captures, where.sizes, model=settings.model, frame=settings.frame, shadows=settings.shadows
    )
    descends = descent_steps(settings) > 0
    shade = pictured(
        subsamples=settings.subsamples, memory=settings.memory * 1e9, weights=trust(captures, indirect),
        gradients=descends,
    )  # fmt: skip
    trace: dict[str, list[float]] = {}
    found = solve_level(work, shade, start, indirect, seed, trace, lambda done: progress(0.5 * done))
    if found.solved and settings.smooth:
        table = smoothed(found.table, found.noise, where, settings.roughness_floor, settings.metallic)
        found = replace(found, table=table)
    table = found.table
    if descends:
        table = improved(work, shade, found, indirect, seed, trace, lambda d: progress(0.5 + 0.35 * d), save, resume)
        if found.solved and settings.joint:
            # Of finer pictures; what was kept for the others makes room.
            shade = pictured(subsamples=settings.joint_subsamples, memory=0, gradients=False)
            table = together(work, shade, table, indirect, seed, trace, lambda d: progress(0.85 + 0.1 * d))
    if settings.polish:
        # Its pictures keep the light between surfaces.
        table = polished(work, whole, table, seed, trace, lambda d: progress(0.95 + 0.05 * d))
    shade.table = table
    residuals = {camera.name: _residual(shade, k) for k, camera in enumerate(captures.cameras)}
    progress(1.0)
    return _recovered(work, found, table, trace, residuals)


def polished(
    work: Work,
    captures: Captures,
    table: Float[np.ndarray, "a 8"],
    seed: int,
    trace: dict[str, list[float]],
    progress: Callable[[float], None],
) -> Float[np.ndarray, "a 8"]:
    """Steps through `prb` from `table`; a result that explains the pictures no better is dropped, with a note."""
    from mistyle.render.polish import PolishSettings, polish
    from mistyle.render.shade import pack, unpack

    s = work.settings
    chosen = PolishSettings(s.polish, s.loss, s.polish_rate, s.metallic, s.polish_depth, model=s.model, frame=s.frame)
    done = polish(work.traced.mesh, unpack(table, work.where.sizes), captures, chosen, seed, progress)
    trace["polish.loss"], trace["polish.whole"] = list(done.trace), list(done.loss)
    if not done.loss[1] < done.loss[0]:
        work.notes.append(f"The polish was undone: the loss went from {done.loss[0]:.3g} to {done.loss[1]:.3g}.")
        return table
    return pack(done.maps)


def _residual(shade, k: int) -> float:
    rgb, mask = shade.captures.load(k)
    image, coverage = shade.image_and_coverage(k)
    inside = mask & (coverage > 0.999)
    reference = rgb[inside].astype(np.float64)
    wrong = reference - image[inside]
    return float(np.sqrt((wrong**2).sum() / max((reference**2).sum(), 1e-30)))


def _recovered(work: Work, found: Found, table: np.ndarray, trace, residuals) -> Recovered:
    from mistyle.render.shade import unpack

    where, settings = work.where, work.settings
    names = [n for n in CHANNELS if n != "metallic" or settings.metallic]
    variance = {n: (found.spread[:, CHANNELS[n]] ** 2).mean(axis=1) for n in CHANNELS}
    doubt = np.mean([variance[n] / HALF_SURE[n] ** 2 for n in names], axis=0)
    sure = np.where(found.seen > 0, 1 / (1 + doubt), 0).astype(np.float32)

    def grids(values: np.ndarray) -> tuple[np.ndarray, ...]:
        return tuple(values[part].reshape(size) for part, size in zip(where.parts, where.sizes, strict=True))

    seen = grids(found.seen.astype(np.int32))
    maps = [replace(m, known=s > 0) for m, s in zip(unpack(table, where.sizes), seen, strict=True)]
    spreads = {n: grids(np.sqrt(v).astype(np.float32)) for n, v in variance.items()}
    return Recovered(
        maps=tuple(maps),
        confidence=grids(sure),
        spread=tuple({n: spreads[n][k] for n in CHANNELS} for k in range(len(where.sizes))),
        seen=seen,
        views=grids(found.views.astype(np.int32)),
        trace=trace,
        residuals=residuals,
        notes=tuple(work.notes),
    )
