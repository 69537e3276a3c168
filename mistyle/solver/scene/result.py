"""Results of a scene fit: values before and after with standard errors, residuals, and notes."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from mistyle.render.live import parameters as scene_keys
from mistyle.render.live.parameters import Parameter
from mistyle.solver.scene import gauss_newton as scene_newton
from mistyle.solver.scene import gradients as scene_grad
from mistyle.solver.scene.state import Bad, FitState, SceneProblem

BATCHES = 8  # batches of the last steps; the spread of their means gives the standard error
DRIFT = 0.02  # relative change over the last steps that counts as not converged
PACE = 0.3  # mean change, as a share of the rate, that counts as not converged: most gradients share a sign
SURE = 2.0  # standard errors by which a result must be worse to be undone


@dataclass(frozen=True)
class Residual:
    """Difference between a camera's picture and its reference, before and after the fit.

    loss   of the expected picture: without its render noise if the loss is a square
    psnr   dB of clipped sRGB, of the mean of two pictures
    noise  share of one picture's relative squared difference that is render noise, 0..1
    """

    sensor: int
    loss: tuple[float, float]
    psnr: tuple[float, float]
    noise: tuple[float, float]


@dataclass(frozen=True)
class FittedScene:
    """The result of a fit; the scene itself also holds the values.

    values       by `mi.traverse` key: (h, w, c) of textures, (n,) of the rest, float32
    start        the same before the fit
    errors       by key: standard errors of `brief`, NaN with too few steps
    seen         by key, the values' shapes: number of steps in which a gradient reached the number; 0 means that the
                 pyramid propagated the value from its neighbours, or that it is the start's
    trace        loss of each step, render noise included
    residuals    per camera
    bad          non-finite gradients (the first MOST_BAD)
    parameters   the fitted parameters
    unconverged  names of parameters that still drifted at the end
    undone       the result was worse than its start, which is restored
    notes        sentences for the report
    """

    values: dict[str, np.ndarray]
    start: dict[str, np.ndarray]
    errors: dict[str, np.ndarray]
    seen: dict[str, np.ndarray]
    trace: tuple[float, ...]
    residuals: tuple[Residual, ...]
    bad: tuple[Bad, ...]
    parameters: tuple[Parameter, ...]
    unconverged: tuple[str, ...]
    undone: bool
    notes: tuple[str, ...]


@dataclass(frozen=True)
class ViewLook:
    """One camera: loss, PSNR and noise as in `Residual`, and the squared difference of every valid value."""

    loss: float
    psnr: float
    noise: float
    squares: np.ndarray


def brief(p: Parameter, values: np.ndarray) -> np.ndarray:
    """A parameter as few numbers: its own if it has at most 4, else the mean of every channel."""
    if len(p.shape) < 3:
        if values.size <= 4:
            return values.astype(np.float64)
        return values.reshape(-1, p.channels).mean(axis=0, dtype=np.float64)
    return values.mean(axis=(0, 1), dtype=np.float64)


def pace(p: Parameter, change: np.ndarray, rate: float) -> np.ndarray:
    """The numbers of `brief` for one step's change, over moved values only, as a share of the rate."""
    moved = change.reshape(-1, change.size if len(p.shape) < 3 and change.size <= 4 else p.channels)
    count = np.count_nonzero(moved, axis=0)
    return moved.sum(axis=0, dtype=np.float64) / np.maximum(count, 1) / rate


def looks(job: SceneProblem, values: Mapping[str, np.ndarray], progress: Callable[[float], None]) -> list[ViewLook]:
    """Two pictures of every camera, with the same seeds in every call, so that noise alone causes no difference."""
    scene_grad.put(job.table, job.chosen, values)
    result = []
    for k, view in enumerate(job.views):
        seeds = scene_grad.seeds(job.plan.seed, k, 2**31)
        pair = [scene_grad.picture(job.scene, job.engine, view.sensor, job.plan.spp, s) for s in seeds]
        result.append(_evaluate_view(job, k, pair))
        progress((k + 1) / len(job.views))
    return result


def _evaluate_view(job: SceneProblem, k: int, pair: Sequence[Any]) -> ViewLook:
    view = job.views[k]
    counts, reference = np.array(view.counts), np.array(view.reference, np.float64)
    residuals = []
    for shown in pair:
        plain = np.array(shown, dtype=np.float64)[..., :3]
        residuals.append(np.where(counts & np.isfinite(plain), plain - reference, 0))
    weights = np.array(view.weights, np.float64)
    squares = (weights if job.loss != "l2" else 1) * residuals[0] * residuals[1]
    noise = (weights * (residuals[0] - residuals[1]) ** 2).sum() / 2
    whole = (weights * (residuals[0] ** 2 + residuals[1] ** 2)).sum() / 2
    mean = (pair[0] + pair[1]) / 2
    loss = float(squares.sum() / counts.sum())
    if job.loss not in scene_grad.SQUARED:
        loss = scene_grad.compare(mean, view, job.losses[k])[0]
    return ViewLook(loss, scene_grad.psnr(mean, view), float(min(noise / max(whole, 1e-300), 1)), squares[counts])


def worse(job: SceneProblem, before: Sequence[ViewLook], after: Sequence[ViewLook]) -> bool:
    """Whether the fit is worse than before, beyond the noise of that comparison."""
    change = sum(a.loss - b.loss for a, b in zip(after, before, strict=True))
    if job.loss not in scene_grad.SQUARED:
        return change > 0
    parts = [a.squares - b.squares for a, b in zip(after, before, strict=True)]
    spread = np.sqrt(sum(float(np.var(x)) / x.size for x in parts))
    return bool(change > SURE * spread)


def errors(job: SceneProblem, state: FitState) -> tuple[dict[str, np.ndarray], tuple[str, ...]]:
    """Standard errors of `brief` by key, and the names of parameters that still drift."""
    if state.newton is not None:
        error, drifts = scene_newton.errors(job, state.newton, scene_newton.gathered(job, state.start))
        zero = {p.key: np.zeros(p.shape, np.float32) for p in job.chosen}
        by_key, moving = (scene_newton.spread(job, x.astype(float), zero) for x in (error, drifts))
        names = tuple(p.name for p in job.chosen if moving[p.key].any())
        return {p.key: by_key[p.key].astype(np.float64) for p in job.chosen}, names
    widths = [len(brief(p, state.values[p.key])) for p in job.chosen]
    course = np.array(state.course).reshape(-1, sum(widths))
    paces = np.array(state.paces).reshape(-1, sum(widths))
    stds, names, start = {}, [], 0
    for p, width in zip(job.chosen, widths, strict=True):
        part = course[:, start : start + width]
        stds[p.key], drifts = _batch_error(part, job.scales[p.key])
        drifts |= _share_direction(paces[:, start : start + width])
        start += width
        if drifts:
            names.append(p.name)
    return stds, tuple(names)


def _share_direction(paces: np.ndarray) -> bool:
    """Whether the steps share a direction, beyond momentum-filtered noise."""
    if len(paces) < 2:
        return False
    # Adam's running mean correlates (1 + β) / (1 - β) steps.
    error = paces.std(axis=0, ddof=1) * np.sqrt(19 / len(paces))
    return bool((np.abs(paces.mean(axis=0)) > np.maximum(PACE, 4 * error)).any())


def _batch_error(course: np.ndarray, scale: float) -> tuple[np.ndarray, bool]:
    """Standard error of the mean over correlated steps, by batch means; and whether they drift."""
    if len(course) < 2 * BATCHES:
        return np.full(course.shape[1], np.nan), False
    means = np.array([part.mean(axis=0) for part in np.array_split(course, BATCHES)])
    error = means.std(axis=0, ddof=1) / np.sqrt(BATCHES)
    half = BATCHES // 2
    drift = np.abs(means[half:].mean(axis=0) - means[:half].mean(axis=0))
    # A trend also spreads the batches within a half: the halves of a straight line differ by 6 of these errors.
    rest = means - np.repeat([means[:half].mean(axis=0), means[half:].mean(axis=0)], half, axis=0)
    own = rest.std(axis=0, ddof=2) / np.sqrt(half)
    far = drift > DRIFT * (np.abs(course[-1]) + 0.02 * scale)
    return error, bool((far & (drift > 4 * own)).any())


def afterthoughts(job: SceneProblem, state: FitState, unconverged: Sequence[str], undone: bool) -> list[str]:
    """Notes on unexpected outcomes."""
    notes = []
    if undone:
        notes.append(
            "The fitted values matched the references less well than the start: they were undone, and the start is "
            "restored. Other parameters, more views or another start may help."
        )
    for p in job.chosen:
        if not state.moments[p.key][0].steps.any():
            notes.append(f"{p.name} never had a gradient: no camera sees it, or its plugin propagates none.")
            continue
        ends = [end for end in scene_keys.limits(p) or () if np.isfinite(end)]
        value = state.values[p.key][job.free[p.key]]
        if p.kind == "value" and any(np.isclose(value, end).any() for end in ends) and not undone:
            notes.append(f"{p.name} is at the end of its range, {' '.join(f'{v:.4g}' for v in value)}.")
    if unconverged:
        notes.append(f"{', '.join(unconverged)} still moved at the end: raise --iterations.")
    if state.lost:
        first = state.bad[0]
        source = "a regularizer" if first.sensor is None else f"sensor {first.sensor}"
        notes.append(
            f"{state.lost} gradients were not finite, the first at {first.key}{list(first.texel)} from {source} in "
            f"step {first.iteration}; their texels kept their last good values from then on."
        )
    for k, count in sorted(state.broken.items()):
        if count:
            notes.append(f"sensor {k}: {count} values of its pictures were NaN or infinite; they were masked.")
    return notes
