"""Recovering materials: albedo, normal, roughness and metallic from pictures of known cameras under known light.

First texel by texel (`recover_solve.py`): with geometry, cameras and lights known nothing has to be rendered to
solve for one texel, and Levenberg-Marquardt gets in twenty steps where gradient descent on pictures does not get in
hundreds. Then on whole pictures, by Adam through `render/shade.py`, which models pixels and interpolation exactly.
Before and after that neighbours have a word about what pictures leave open (`recover_smooth.py`).
Light that reaches the surface by way of other surfaces can be estimated with the maps found and taken off the
pictures (`bounces`). Lights and cameras are taken as they are given; a common factor of light and albedo cannot be
told apart, so albedo is as right as the lights' units are.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from mistyle.core import stopping
from mistyle.core.capture import Captures
from mistyle.core.maps import Maps, Texels
from mistyle.core.mesh import Mesh
from mistyle.stages import recover_solve as solving
from mistyle.stages.recover_check import trust, usable, without
from mistyle.stages.recover_settings import RecoverSettings
from mistyle.stages.recover_smooth import smoothed
from mistyle.stages.recover_texels import Found, Work, solve_level

__all__ = ["RecoverSettings", "Recovered", "recover"]

JUDGES = 48  # pictures that say whether the steps on whole pictures helped
DAMPING = 0.3  # of a descent that begins from nothing
# And multiples of the rate by channel: soft light says little of normals, less of roughness, most of albedo.
SHARES = (2, 2, 2, 0.2, 0.2, 0.6, 0.6, 0)
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
    confidence: tuple[Float[np.ndarray, "h w"], ...]
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

    notes: list[str] = []
    indirect: dict[int, np.ndarray] = {}
    whole = usable(mesh, captures, notes)
    captures = without(whole, indirect)
    traced = tracer(mesh)
    # The steps on whole pictures know no neighbours.
    where = solving.atlas(texels) if settings.solver == "pictures" else solving.linked(mesh, texels)
    work = Work(traced, tangents_of(mesh, settings.frame), texels, where, captures, settings, notes)
    shade = Shade(
        traced, captures, where.sizes, model=settings.model, frame=settings.frame, subsamples=settings.subsamples,
        shadows=settings.shadows, memory=settings.memory * 1e9, weights=trust(captures, indirect),
    )  # fmt: skip
    trace: dict[str, list[float]] = {}
    found = solve_level(work, shade, start, indirect, seed, trace, lambda done: progress(0.5 * done))
    if found.solved and settings.smooth:
        found = replace(found, table=smoothed(found.table, found.noise, where, settings.roughness_floor))
    table = found.table
    if settings.solver != "texels" and settings.iterations:
        before = total_loss(shade, table, settings)
        with stopping.at_checkpoints():
            table = descend(work, shade, found, seed, trace, lambda d: progress(0.5 + 0.45 * d), save, resume)
        after = total_loss(shade, table, settings)
        trace["pictures.whole"] = [before, after]
        if not after < before:
            notes.append(f"The steps on whole pictures were undone: the loss went from {before:.3g} to {after:.3g}.")
            table = found.table
        elif found.solved and settings.smooth:
            table = smoothed(table, found.noise, where, settings.roughness_floor)
    if settings.polish:
        # Its pictures keep the light between surfaces.
        table = polished(work, whole, table, seed, trace, lambda d: progress(0.95 + 0.05 * d))
    shade.table = table
    residuals = {camera.name: _residual(shade, k) for k, camera in enumerate(captures.cameras)}
    progress(1.0)
    return _recovered(work, found, table, trace, residuals)


def descend(
    work: Work,
    shade,
    found: Found,
    seed: int,
    trace: dict[str, list[float]],
    progress: Callable[[float], None],
    save: Callable[[dict[str, np.ndarray]], None] | None,
    resume: dict[str, np.ndarray] | None,
) -> Float[np.ndarray, "a 8"]:
    """Adam on whole pictures, one a step, in an order that is shuffled anew each time all have been looked at."""
    from mistyle.render.descent import Descent, table_on_device

    settings, count = work.settings, len(work.captures)
    levels = settings.levels or (1 if found.solved else 5)
    rates = [1.0, 1, 1, 1, 1, 1, 1 if settings.metallic else 0, 0]
    if not found.solved:
        rates = [rate * share for rate, share in zip(rates, SHARES, strict=True)]
    damping = 0.0 if found.solved else DAMPING
    descent = Descent(
        work.where.sizes, rates, levels=levels, floor=settings.roughness_floor, damping=damping,
        shares=_shares(found) if found.solved else None,
    )  # fmt: skip
    table, first, lost, losses = table_on_device(found.table), 0, [], trace.setdefault("pictures.loss", [])
    if resume is not None:
        first, table = int(resume["iteration"]), table_on_device(resume["table"])
        losses.extend(resume["losses"].tolist())
        descent.restore(resume)
    saved = time.monotonic()
    for k in range(first, settings.iterations):
        picture = int(np.random.default_rng([seed, k // count]).permutation(count)[k % count])
        shade.table = table
        loss, gradient = shade.step([picture], settings.loss)
        rate = settings.rate * 0.5 * (1 + np.cos(np.pi * k / settings.iterations))
        table = descent.step(table, gradient.array, rate, picture)
        lost.append(loss)
        if (k + 1) % count == 0 or k + 1 == settings.iterations:
            losses.extend(float(np.array(value)[0]) for value in lost)
            lost.clear()
            progress((k + 1) / settings.iterations)
            due = stopping.asked() or time.monotonic() - saved > settings.checkpoint
            if save is not None and due and k + 1 < settings.iterations:
                state = descent.state() | {"iteration": np.array(k + 1), "losses": np.array(losses)}
                save(state | {"table": np.array(table).reshape(-1, 8)})
                saved = time.monotonic()
                stopping.check()
    _note_stopped(work, descent.stopped())
    return np.array(table).reshape(-1, 8)


def _shares(found: Found) -> Float[np.ndarray, "a 8"]:
    """Multiples of Adam's rate: a step has the same length however little speaks for it, and a tilt that its neighbours
    decided would wander off. (Albedo and roughness gain more from steps on whole pictures than they lose.)"""
    shares = np.ones((len(found.decided), 8), np.float32)
    shares[:, 3:5] = np.sqrt(found.decided)[:, None]
    return shares


def polished(
    work: Work,
    captures: Captures,
    table: Float[np.ndarray, "a 8"],
    seed: int,
    trace: dict[str, list[float]],
    progress: Callable[[float], None],
) -> Float[np.ndarray, "a 8"]:
    """Steps through `prb` from `table`; a result that explains the pictures no better is dropped, with a note."""
    from mistyle.render.polish import polish
    from mistyle.render.shade import pack, unpack

    s = work.settings
    done = polish(
        work.traced.mesh, unpack(table, work.where.sizes), captures, s.polish, model=s.model, frame=s.frame,
        metallic=s.metallic, loss=s.loss, rate=s.polish_rate, depth=s.polish_depth, seed=seed, progress=progress,
    )  # fmt: skip
    trace["polish.loss"], trace["polish.whole"] = list(done.trace), list(done.loss)
    if not done.loss[1] < done.loss[0]:
        work.notes.append(f"The polish was undone: the loss went from {done.loss[0]:.3g} to {done.loss[1]:.3g}.")
        return table
    return pack(done.maps)


def _note_stopped(work: Work, stopped: list[tuple[int, str, int]]) -> None:
    """Say which texels stood still because their gradient was not a number."""
    offsets = work.where.offsets
    for texel, name, picture in stopped[:3]:
        part = int(np.searchsorted(offsets, texel, side="right")) - 1
        row, column = divmod(texel - offsets[part], work.where.sizes[part][1])
        label = work.traced.mesh.parts[part]
        work.notes.append(
            f"The gradient of map '{name}' at texel (row {row}, column {column}) of set '{label}' is not a number in"
            f" picture '{work.captures.cameras[picture].name}': the texel keeps its last good value."
        )
    if len(stopped) > 3:
        work.notes.append(f"The same held for {len(stopped) - 3} more texels.")


def total_loss(shade, table: Float[np.ndarray, "a 8"], settings: RecoverSettings) -> float:
    """Mean loss over the pictures, or over JUDGES of them, evenly chosen."""
    shade.table = table
    last = len(shade.captures) - 1
    chosen = np.unique(np.linspace(0, last, min(JUDGES, last + 1)).round().astype(int)).tolist()
    return float(np.mean([np.array(shade.step([k], settings.loss)[0])[0] for k in chosen]))


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
    parts = [slice(a, b) for a, b in zip(where.offsets[:-1], where.offsets[1:], strict=True)]

    def grids(values: np.ndarray) -> tuple[np.ndarray, ...]:
        return tuple(values[part].reshape(size) for part, size in zip(parts, where.sizes, strict=True))

    seen = grids(found.seen.astype(np.int32))
    maps = [replace(m, known=s > 0) for m, s in zip(unpack(table, where.sizes), seen, strict=True)]
    spreads = {n: grids(np.sqrt(v).astype(np.float32)) for n, v in variance.items()}
    return Recovered(
        maps=tuple(maps),
        confidence=grids(sure),
        spread=tuple({n: spreads[n][k] for n in CHANNELS} for k in range(len(parts))),
        seen=seen,
        views=grids(found.views.astype(np.int32)),
        trace=trace,
        residuals=residuals,
        notes=tuple(work.notes),
    )
