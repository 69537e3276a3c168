"""Fitting texture parameters of any Mitsuba scene to pictures of known cameras, through `prb` or another integrator.

Nothing is assumed about the materials: any parameter whose plugin has gradients can be fitted, several at once. The
few numbers of literals and colours use Gauss–Newton (`gauss_newton.py`). Textures and attributes use Adam on the
Laplacian pyramid (`pyramid.py`) with a falling rate; with noisy gradients the result is the mean of the last steps.
Values stay in their ranges (`parameters.limits`). A result worse than its start is undone.
"""

import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from mistyle.process import stopping
from mistyle.render.deferred import pyramid as laplacian
from mistyle.render.live import parameters as scene_keys
from mistyle.render.mitsuba import device
from mistyle.solver.scene import gauss_newton as scene_newton
from mistyle.solver.scene import gradients as scene_grad
from mistyle.solver.scene import result as scene_result
from mistyle.solver.scene import state as scene_job
from mistyle.solver.scene.result import FittedScene, Residual
from mistyle.solver.scene.state import Bad, Regularizer

RATE = 0.02
SHARE = 0.7  # of the rate that each coarser level of the pyramid has
LAST_RATE = 0.05  # share of the rate at the end
COURSE = 0.3  # share of the last steps that estimate drift and spread
TAIL = 0.15  # share of the last steps whose mean is the result with noisy gradients
DOING = "the scene was fitted"
MOST_BAD = 100  # non-finite gradients that are reported one by one


def fit_scene(
    scene: Any,
    keys: Sequence[str],
    sensors: Sequence[Any] | None = None,
    references: Sequence[np.ndarray] = (),
    *,
    loss: str | scene_grad.Loss | None = None,
    regularizers: Sequence[Regularizer] = (),
    callback: Callable[[int, float, Mapping[str, np.ndarray]], Any] | None = None,
    iterations: int = 128,
    spp: int = 16,
    spp_grad: int | None = None,
    rate: float = RATE,
    pyramid: bool = True,
    sensors_per_step: int = 1,
    seed: int = 0,
    solver: str = "auto",
    integrator: Any = None,
    fast: bool = True,
    masks: Sequence[np.ndarray | None] | None = None,
    only: Mapping[str, np.ndarray] | None = None,
    save: Callable[[dict[str, np.ndarray]], None] | None = None,
    save_every: float = 60.0,
    resume: Mapping[str, np.ndarray] | None = None,
    progress: Callable[[float], None] = lambda done: None,
) -> FittedScene:
    """`mistyle.fit_scene`, which documents the arguments; in addition:

    save, resume   `save` receives a dictionary of arrays every `save_every` seconds, and when the callback ends or
    aborts
                   the fit. Passed back as `resume` with all other arguments equal, it resumes the fit to the same
                   result. One thread gives the same bytes; with more, Mitsuba sums texture gradients in varying order,
                   and results differ as between any two runs.
    progress       receives the finished share, 0..1
    """
    device.use()
    plan = scene_job.FitPlan(iterations, spp, spp_grad, rate, pyramid, sensors_per_step, seed, solver)
    unknowns, objective = scene_job.Unknowns(keys, only), scene_job.Objective(loss, regularizers)
    evidence = scene_job.Evidence(references, sensors, masks)
    with device.plain_errors(DOING):
        job, notes = scene_job.prepare(scene, unknowns, evidence, objective, plan, integrator, fast)
    state = scene_job.begun(job) if resume is None else scene_job.restored(resume, job)
    edge = len(job.views) / (2 * len(job.views) + iterations * sensors_per_step)
    with device.plain_errors(DOING):
        before = scene_result.looks(job, state.start, lambda done: progress(edge * done))
    _descend(job, state, callback, save, save_every, lambda done: progress(edge + (1 - 2 * edge) * done))
    with device.plain_errors(DOING):
        return _finished(job, state, before, notes, lambda done: progress(1 - edge + edge * done))


def _descend(
    job: scene_job.SceneProblem, state: scene_job.FitState, callback: Any, save: Any, save_every: float, progress: Any
) -> None:
    """All remaining steps; ends early if the callback returns true."""
    saved, stopped = time.monotonic(), False

    def store() -> None:
        if save is not None:
            save(scene_job.checkpoint(state, job))

    while state.iteration < job.plan.iterations and not stopped:
        with device.plain_errors(DOING):
            if not job.newton:
                _step(job, state)
            elif not scene_newton.advance(job, state, lambda step, slot: _camera(job, step, slot)):
                store()
                stopping.check()
        progress(state.iteration / job.plan.iterations)
        try:
            stopped = callback is not None and bool(callback(state.iteration - 1, state.trace[-1], dict(state.values)))
        except BaseException:
            store()
            raise
        if save is not None and (stopped or stopping.asked() or time.monotonic() - saved >= save_every):
            store()
            saved = time.monotonic()
            stopping.check()


def _finished(
    job: scene_job.SceneProblem,
    state: scene_job.FitState,
    before: Sequence[scene_result.ViewLook],
    notes: Sequence[str],
    progress: Any,
) -> FittedScene:
    """The result, compared with the start and undone where it is worse."""
    if (count := state.iteration - _first_of_last(job, TAIL)) > 0 and not (job.newton or job.fast):
        mean = {p.key: (state.tail[p.key] / count).astype(np.float32) for p in job.chosen}
        # Unchanged values keep their bytes.
        state.values = {k: np.where(state.values[k] == state.start[k], state.start[k], v) for k, v in mean.items()}
    after = scene_result.looks(job, state.values, progress)
    errors, unconverged = scene_result.errors(job, state)
    if state.newton is not None and (best := scene_newton.left_behind(job, state.newton, errors)) is not None:
        values = scene_newton.spread(job, best, state.values)
        earlier = scene_result.looks(job, values, lambda done: None)
        if scene_result.worse(job, earlier, after):
            state.values, after, unconverged = values, earlier, tuple(p.name for p in job.chosen)
    undone = scene_result.worse(job, before, after)
    if undone:
        state.values, after = dict(state.start), list(before)
    scene_grad.put(job.table, job.chosen, state.values)
    rows = [
        Residual(k, (a.loss, b.loss), (a.psnr, b.psnr), (a.noise, b.noise))
        for k, (a, b) in enumerate(zip(before, after, strict=True))
    ]
    return FittedScene(
        values={p.key: state.values[p.key] for p in job.chosen},
        start=state.start,
        errors=errors,
        seen={p.key: state.moments[p.key][0].steps for p in job.chosen},
        trace=tuple(state.trace),
        residuals=tuple(rows),
        bad=tuple(state.bad),
        parameters=job.chosen,
        unconverged=unconverged,
        undone=undone,
        notes=(*notes, *scene_result.afterthoughts(job, state, unconverged, undone)),
    )


def _step(job: scene_job.SceneProblem, state: scene_job.FitState) -> None:
    """One step of Adam on the mean loss of the next cameras."""
    plan, step = job.plan, state.iteration
    gradient = {p.key: np.zeros(p.shape, np.float32) for p in job.chosen}
    total = 0.0
    for slot in range(plan.sensors_per_step):
        k = _camera(job, step, slot)
        value, added, broken = _gradients(job, state, k, scene_grad.seeds(plan.seed, step, slot))
        total += value / plan.sensors_per_step
        state.broken[k] = state.broken.get(k, 0) + broken
        _add_gradients(gradient, added, state, 1 / plan.sensors_per_step, k)
    if job.regularizers:
        value, added = scene_grad.regularized(job.table, job.chosen, state.values, job.regularizers)
        total += value
        _add_gradients(gradient, added, state, 1.0, None)
    noisy, paces = job.fast is None, []
    for p in job.chosen:
        usable = job.free[p.key] & ~state.held[p.key]
        rate = plan.rate * _rate_factor(step, plan.iterations, noisy) * job.scales[p.key]
        own = np.where(usable, gradient[p.key], 0)
        change = laplacian.change(state.moments[p.key], own, rate, SHARE, fair=noisy)
        moved = scene_keys.project(p, state.values[p.key] + change)
        old = state.values[p.key]
        state.values[p.key] = np.where(usable, moved, old)
        paces.append(scene_result.pace(p, state.values[p.key] - old, rate))
    state.trace.append(total)
    state.iteration += 1
    if step >= _first_of_last(job, TAIL):
        for p in job.chosen:
            state.tail[p.key] += state.values[p.key]
    if step >= _first_of_last(job, COURSE):
        state.paces.append(np.concatenate(paces))
        state.course.append(np.concatenate([scene_result.brief(p, state.values[p.key]) for p in job.chosen]))


def _first_of_last(job: scene_job.SceneProblem, share: float) -> int:
    """The first of the last steps that form this share of all."""
    return int(np.ceil((1 - share) * job.plan.iterations))


def _rate_factor(step: int, steps: int, noisy: bool) -> float:
    """Factor of the rate, along a cosine; with noisy gradients it ends before the averaged steps."""
    end = (1 - TAIL) * steps if noisy else steps
    return LAST_RATE + (1 - LAST_RATE) * 0.5 * (1 + np.cos(np.pi * min(step / end, 1.0)))


def _gradients(job: scene_job.SceneProblem, state: scene_job.FitState, k: int, seeds: tuple[int, int]):
    """Loss and gradient of camera k, and the number of non-finite values in its picture."""
    if job.fast is not None:
        return *job.fast.gradients(state.values, k), 0
    samples = (job.plan.spp, job.plan.spp_grad or 1)
    live = scene_grad.LiveScene(job.scene, job.table, job.chosen, job.engine)
    return scene_grad.gradients(live, state.values, job.views[k], job.losses[k], samples, seeds)


def _add_gradients(total: dict, gradients: dict, state: scene_job.FitState, weight: float, sensor: int | None) -> None:
    """Add gradients; texels with non-finite gradients are recorded and frozen."""
    for key, gradient in gradients.items():
        invalid = ~np.isfinite(gradient)
        if invalid.any():
            where = np.argwhere(invalid & ~state.held[key])
            state.lost += len(where)
            room = max(MOST_BAD - len(state.bad), 0)
            state.bad += [Bad(key, tuple(int(n) for n in row), sensor, state.iteration) for row in where[:room]]
            state.held[key] |= invalid.any(axis=-1, keepdims=True) if invalid.ndim == 3 else invalid
            gradient = np.where(invalid, 0, gradient)
        total[key] += np.float32(weight) * gradient


def _camera(job: scene_job.SceneProblem, step: int, slot: int) -> int:
    """The next camera: each once per epoch, in an order that is shuffled anew."""
    place, views = step * job.plan.sensors_per_step + slot, len(job.views)
    return int(np.random.default_rng([job.plan.seed, place // views]).permutation(views)[place % views])
