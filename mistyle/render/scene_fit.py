"""Fitting texture parameters of any Mitsuba scene to pictures of known cameras, through `prb` or another integrator.

Nothing is assumed about the materials: whatever plugin passes gradients to its parameters can be fitted, several at
once. Adam works on the Laplacian pyramid of every texture (`render/pyramid.py`), the rate falls along a cosine, and
values stay in their ranges (`scene_keys.limits`). The gradients are Monte Carlo estimates.
"""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from mistyle.core import stopping
from mistyle.render import device, scene_grad, scene_job, scene_keys
from mistyle.render import pyramid as laplacian
from mistyle.render.scene_job import Bad, Regularizer
from mistyle.render.scene_keys import Parameter

RATE = 0.02
SHARE = 0.7  # of the rate that each coarser level of the pyramid has
LAST_RATE = 0.05  # share of the rate at the end
MOST_BAD = 100  # numbers that are reported one by one


@dataclass(frozen=True)
class Residual:
    """How far a camera's picture is from its reference, before and after: the loss, and PSNR (dB) of clipped sRGB."""

    sensor: int
    loss: tuple[float, float]
    psnr: tuple[float, float]


@dataclass(frozen=True)
class FittedScene:
    """What the fit made; the scene itself holds the values too.

    values      by `mi.traverse` key: (h, w, c) of textures, (n,) of the rest, float32
    seen        by key, the same shapes: in how many steps a gradient reached the number; 0 means that what stands there
                was only carried over from its neighbours by the pyramid, or is as it came
    trace       loss of each step
    residuals   per camera
    bad         gradients that were no numbers (the first MOST_BAD)
    parameters  what was fitted
    notes       sentences for the report
    """

    values: dict[str, np.ndarray]
    seen: dict[str, np.ndarray]
    trace: tuple[float, ...]
    residuals: tuple[Residual, ...]
    bad: tuple[Bad, ...]
    parameters: tuple[Parameter, ...]
    notes: tuple[str, ...]


def fit_scene(
    scene: Any,
    keys: Sequence[str],
    sensors: Sequence[Any] | None = None,
    references: Sequence[np.ndarray] = (),
    *,
    loss: str | scene_grad.Loss = "log_srgb_l1",
    regularizers: Sequence[Regularizer] = (),
    callback: Callable[[int, float, Mapping[str, np.ndarray]], Any] | None = None,
    iterations: int = 128,
    spp: int = 16,
    spp_grad: int = 1,
    rate: float = RATE,
    pyramid: bool = True,
    sensors_per_step: int = 1,
    seed: int = 0,
    integrator: Any = None,
    fast: bool = True,
    masks: Sequence[np.ndarray | None] | None = None,
    only: Mapping[str, np.ndarray] | None = None,
    save: Callable[[dict[str, np.ndarray]], None] | None = None,
    save_every: float = 60.0,
    resume: Mapping[str, np.ndarray] | None = None,
    progress: Callable[[float], None] = lambda done: None,
) -> FittedScene:
    """Fit the parameters that `keys` (of `mi.traverse`, or globs) name, so that renders look like `references`.

    scene             a live `mi.Scene`; it is changed, and holds the result afterwards
    sensors           `mi.Sensor`s or indices into the scene's; None takes all of the scene's
    references        linear Rec.709 radiance (h, w, 3), one a sensor, of the film's size
    loss              "log_srgb_l1", "l2", or a function (picture, reference) -> number on Mitsuba tensors (h, w, 3);
                      pixels that do not count have the reference's value in both
    regularizers      functions ({key: value}) -> number on Mitsuba tensors and arrays, added to the loss
    callback          (iteration, loss, values) after each step; a true answer ends the fit there
    spp, spp_grad     samples a pixel of the picture and of its gradient
    rate              of Adam, for values in 0..1; what has no range is scaled by its first root mean square
    pyramid           False: plain Adam on the texels
    integrator        see `scene_grad.ad_integrator`
    fast              take gradients from `scene_fast.Fast` where its pictures are the scene's; a note says whether
    masks             pixels that count, bool (h, w), one a sensor (None: all)
    only              by key (or name): bool, which numbers of a value may change; all others keep their bytes
    save, resume      `save` receives a dictionary of arrays every `save_every` seconds, and when the callback ends or
                      breaks off the fit; given back as `resume`, with all else as it was, the fit goes on to the same
                      result: the same bytes with one thread; with more, Mitsuba's texture gradient adds up in another
                      order in every run, and results differ as those of two runs do
    progress          receives the share that is done, 0..1

    A texel whose gradient is no number keeps its last good value from then on, and is reported. Light that comes by
    way of other surfaces is followed as far as the integrator goes. Raises UsageError for keys or settings that cannot
    be, InputRefused for references.
    """
    device.use()
    plan = scene_job.Plan(iterations, spp, spp_grad, rate, pyramid, sensors_per_step, seed)
    given = (scene, keys, sensors, references, masks, only, loss, regularizers, integrator)
    job, notes = scene_job.prepare(*given, plan, fast)
    edge = len(job.views) / (2 * len(job.views) + iterations * sensors_per_step)
    if resume is None:
        values = {p.key: scene_job.first(p, job) for p in job.chosen}
        moments = {p.key: laplacian.start(p.shape, pyramid) for p in job.chosen}
        held = {p.key: np.zeros(p.shape, bool) for p in job.chosen}
        state = scene_job.State(0, values, moments, held, _residuals(job, values, progress, 0, edge), [])
    else:
        state = scene_job.restored(resume, job)
    saved, stopped = time.monotonic(), False
    while state.iteration < iterations and not stopped:
        _step(job, state)
        progress(edge + (1 - 2 * edge) * state.iteration / iterations)
        try:
            stopped = callback is not None and bool(callback(state.iteration - 1, state.trace[-1], dict(state.values)))
        except BaseException:
            if save is not None:
                save(scene_job.checkpoint(state, job))
            raise
        if save is not None and (stopped or stopping.asked() or time.monotonic() - saved >= save_every):
            save(scene_job.checkpoint(state, job))
            saved = time.monotonic()
            stopping.check()
    after = _residuals(job, state.values, progress, 1 - edge, 1)
    return FittedScene(
        values={p.key: state.values[p.key] for p in job.chosen},
        seen={p.key: state.moments[p.key][0].steps for p in job.chosen},
        trace=tuple(state.trace),
        residuals=tuple(
            Residual(k, (float(a[0]), float(b[0])), (float(a[1]), float(b[1])))
            for k, (a, b) in enumerate(zip(state.before, after, strict=True))
        ),
        bad=tuple(state.bad),
        parameters=job.chosen,
        notes=(*notes, *_afterthoughts(job, state)),
    )


def _step(job: scene_job.Job, state: scene_job.State) -> None:
    """One step of Adam on the mean loss of the next cameras."""
    plan, step = job.plan, state.iteration
    gradient = {p.key: np.zeros(p.shape, np.float32) for p in job.chosen}
    total = 0.0
    for slot in range(plan.sensors_per_step):
        k = _turn(plan.seed, step * plan.sensors_per_step + slot, len(job.views))
        value, found, broken = _gradients(job, state, k, scene_grad.seeds(plan.seed, step, slot))
        total += value / plan.sensors_per_step
        state.broken[k] = state.broken.get(k, 0) + broken
        _add(gradient, found, state, 1 / plan.sensors_per_step, k)
    if job.regularizers:
        value, found = scene_grad.regularized(job.table, job.chosen, state.values, job.regularizers)
        total += value
        _add(gradient, found, state, 1.0, None)
    falling = LAST_RATE + (1 - LAST_RATE) * 0.5 * (1 + np.cos(np.pi * step / plan.iterations))
    for p in job.chosen:
        usable = job.free[p.key] & ~state.held[p.key]
        rate = plan.rate * falling * job.scales[p.key]
        change = laplacian.change(state.moments[p.key], np.where(usable, gradient[p.key], 0), rate, SHARE)
        moved = scene_keys.project(p, state.values[p.key] + change)
        state.values[p.key] = np.where(usable, moved, state.values[p.key])
    state.trace.append(total)
    state.iteration += 1


def _gradients(job: scene_job.Job, state: scene_job.State, k: int, seeds: tuple[int, int]):
    """Loss and gradient of camera k, and how many values of its picture were no numbers."""
    if job.fast is not None:
        return *job.fast.gradients(state.values, k), 0
    samples = (job.plan.spp, job.plan.spp_grad)
    return scene_grad.gradients(
        job.scene, job.table, job.chosen, state.values, job.engine, job.views[k], job.loss, samples, seeds
    )


def _add(total: dict, found: dict, state: scene_job.State, weight: float, sensor: int | None) -> None:
    """Add gradients; texels with a number that is none are noted and held."""
    for key, gradient in found.items():
        wrong = ~np.isfinite(gradient)
        if wrong.any():
            where = np.argwhere(wrong & ~state.held[key])
            state.lost += len(where)
            room = max(MOST_BAD - len(state.bad), 0)
            state.bad += [Bad(key, tuple(int(n) for n in row), sensor, state.iteration) for row in where[:room]]
            state.held[key] |= wrong.any(axis=-1, keepdims=True) if wrong.ndim == 3 else wrong
            gradient = np.where(wrong, 0, gradient)
        total[key] += np.float32(weight) * gradient


def _turn(seed: int, place: int, views: int) -> int:
    """Which camera is next: every one once a round, each round in another order."""
    return int(np.random.default_rng([seed, place // views]).permutation(views)[place % views])


def _residuals(
    job: scene_job.Job, values: Mapping[str, np.ndarray], progress: Any, begin: float, end: float
) -> np.ndarray:
    """Loss and PSNR (n, 2) of every camera."""
    scene_grad.put(job.table, job.chosen, values)
    rows = []
    for k, view in enumerate(job.views):
        # The same seeds before and after: no difference comes from the noise alone.
        shown = scene_grad.picture(
            job.scene, job.engine, view.sensor, job.plan.spp, scene_grad.seeds(job.plan.seed, k, 2**31)[0]
        )
        rows.append((scene_grad.compare(shown, view, job.loss)[0], scene_grad.psnr(shown, view)))
        progress(begin + (end - begin) * (k + 1) / len(job.views))
    return np.array(rows)


def _afterthoughts(job: scene_job.Job, state: scene_job.State) -> list[str]:
    notes = []
    for p in job.chosen:
        if not state.moments[p.key][0].steps.any():
            notes.append(f"{p.name} never had a gradient: no camera sees it, or its plugin passes none on.")
    if state.lost:
        first = state.bad[0]
        source = "a regularizer" if first.sensor is None else f"sensor {first.sensor}"
        notes.append(
            f"{state.lost} gradients were no numbers, the first at {first.key}{list(first.texel)} from {source} in "
            f"step {first.iteration}; their texels kept their last good values from then on."
        )
    for k, count in sorted(state.broken.items()):
        if count:
            notes.append(f"sensor {k}: {count} values of its pictures were NaN or infinite; they were left out.")
    return notes
