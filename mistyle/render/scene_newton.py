"""Gauss–Newton on the few numbers of a scene: literals and colours under a squared loss, from noisy renders.

A round renders the picture's derivative J by every number (forward mode) at the values θ, then pictures I by other
random numbers, and solves H Δ = -g with g = Jᵀ W (mean I - R) and H = Jᵀ W J. J and I are independent, so g has no
bias; H multiplies two independent estimates of J, of this round and of the one before, so it has none from J's noise.

The first rounds are short and walk to the neighbourhood of the solution. The rest share the remaining steps and do
not replace one another: each adds its H and H θ - g to one system, whose solution is the mean of all of them, weighted
by how much each knew. Their disagreement is the result's standard error.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Float

from mistyle.core import stopping
from mistyle.render import scene_grad, scene_keys
from mistyle.render.scene_keys import Parameter

MOST_NUMBERS = 32
MOST_BYTES = 1e9  # of the derivatives that are kept
SPP = 8  # of the derivatives, unless given
APPROACH = 0.6  # share of the steps at most that the short rounds take
SHORT = 4  # steps of a short round, at least
NEAR = 0.1  # relative change from which the long rounds begin
LONG = (4, 8)  # fewest and most long rounds
WORSE = 1.3  # times the best loss from which a round goes half the way back
WEAK = 1e-3  # eigenvalues of the scaled H below which a direction stays as it is
DAMPING = 1e-3  # of the short rounds


@dataclass
class Newton:
    """What moves, all of it small; `columns` are the last round's derivatives, which `previous` brings back."""

    theta: Float[np.ndarray, " n"]
    round: int = 0
    near: bool = False
    size: int = 0  # steps of a long round; 0 before them
    previous: Float[np.ndarray, " n"] | None = None
    best: tuple[float, Float[np.ndarray, " n"]] | None = None
    system: list[tuple[Float[np.ndarray, "n n"], Float[np.ndarray, " n"]]] = field(default_factory=list)
    steps: list[int] = field(default_factory=list)
    noise: Float[np.ndarray, "n n"] | None = None  # covariance of g by the references' noise
    columns: dict[int, Float[np.ndarray, "n h w 3"]] = field(default_factory=dict)


@dataclass
class _Seen:
    """Sums of I - R and of its square over one camera's pictures of a round, and the weights of the loss."""

    weights: Float[np.ndarray, "h w 3"]
    count: int = 0
    total: Any = 0.0
    square: Any = 0.0

    def products(self) -> Float[np.ndarray, "h w 3"]:
        """Estimates of the expected picture's squared difference, without the render noise where there are two."""
        if self.count < 2:
            return self.square
        return (self.total**2 - self.square) / (self.count * (self.count - 1))

    def noise(self) -> float:
        """The loss of the mean picture's noise alone."""
        return float((self.weights * (self.total**2 / self.count**2 - self.products())).sum())


def refusal(chosen: Sequence[Parameter], free: Mapping[str, np.ndarray], views: Sequence[Any], loss: Any) -> str:
    """Why Gauss–Newton does not suit a fit; nothing where it does."""
    count = sum(int(free[p.key].sum()) for p in chosen)
    if any(p.kind != "value" for p in chosen):
        return "textures and attributes have too many numbers"
    if not 0 < count <= MOST_NUMBERS:
        return f"there are {count} numbers; expected 1 to {MOST_NUMBERS}"
    if loss not in scene_grad.SQUARED:
        return "the loss is not a square"
    size = 2 * 4 * count * sum(int(np.prod(view.reference.shape)) for view in views)
    return f"the derivatives would take {size / 1e9:.1f} GB" if size > MOST_BYTES else ""


def gathered(job: Any, values: Mapping[str, np.ndarray]) -> Float[np.ndarray, " n"]:
    """The numbers that move, in one vector."""
    return np.concatenate([values[p.key][job.free[p.key]] for p in job.chosen]).astype(np.float64)


def spread(job: Any, theta: Float[np.ndarray, " n"], fill: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The reverse of `gathered`; numbers that stand still come from `fill`."""
    result, start = {}, 0
    for p in job.chosen:
        free = job.free[p.key]
        result[p.key] = np.array(fill[p.key], np.float32)
        result[p.key][free] = theta[start : start + int(free.sum())]
        start += int(free.sum())
    return result


def advance(job: Any, state: Any, camera: Callable[[int, int], int]) -> bool:
    """One round; False, with nothing changed, where the run was asked to stop. `camera` of a step and a slot."""
    newton: Newton = state.newton
    size, long = _size(job, state)
    turns = [[camera(state.iteration + m, slot) for slot in range(job.plan.sensors_per_step)] for m in range(size)]
    views = sorted({k for turn in turns for k in turn})
    columns = {k: _columns(job, state.values, newton.theta, k, newton.round) for k in views}
    if newton.previous is not None and not newton.columns:
        newton.columns = {k: _columns(job, state.values, newton.previous, k, newton.round - 1) for k in views}
    scene_grad.put(job.table, job.chosen, state.values)
    seen = {k: _Seen(_weights(job, k)) for k in views}
    losses, broken = [], dict.fromkeys(views, 0)
    for m, turn in enumerate(turns):
        if stopping.asked():
            return False
        numbers = [scene_grad.seeds(job.plan.seed, state.iteration + m, slot)[0] for slot in range(len(turn))]
        found = [_look(job, k, number, seen[k]) for k, number in zip(turn, numbers, strict=True)]
        losses.append(float(np.mean([value for value, _ in found])))
        for k, (_, wrong) in zip(turn, found, strict=True):
            broken[k] += wrong
    matrix, gradient = _normal(columns, newton.columns, seen)
    old = newton.theta
    if long:
        newton.size = newton.size or size
        newton.system.append((size * matrix, size * (matrix @ old - gradient)))
        newton.steps.append(size)
        newton.noise = _reference_noise(columns, newton.columns, seen)
        new = _bounded(job, old, *_total(newton))
    else:
        new = _short(job, newton, matrix, gradient, seen)
        newton.near = newton.round >= 2 and bool((np.abs(new - old) < NEAR * (np.abs(new) + 0.02 * _scales(job))).all())
    newton.previous, newton.columns = old, columns
    newton.theta, newton.round = new, newton.round + 1
    state.values = spread(job, new, state.values)
    state.trace += losses
    state.iteration += size
    for k, count in broken.items():
        state.broken[k] = state.broken.get(k, 0) + count
    for p in job.chosen:
        reached = np.zeros(p.shape, bool)
        reached[job.free[p.key]] = True
        state.moments[p.key][0].steps[reached] += size
    return True


def _size(job: Any, state: Any) -> tuple[int, bool]:
    """Steps of the next round, and whether it is a long one."""
    left = job.plan.iterations - state.iteration
    if state.newton.size:
        return min(state.newton.size, left), True
    all_views = math.ceil(len(job.views) / job.plan.sensors_per_step)
    short = max(SHORT, all_views)
    if not state.newton.near and state.iteration + short <= APPROACH * job.plan.iterations:
        return short, False
    cost = len(state.newton.theta) * len(job.views) / job.plan.sensors_per_step
    rounds = min(max(int(left / cost), LONG[0]), LONG[1], left)
    return math.ceil(left / rounds), True


def _columns(job: Any, fill: Any, theta: Float[np.ndarray, " n"], k: int, number: int) -> Float[np.ndarray, "n h w 3"]:
    """The picture's derivatives of camera k at theta; round `number` gives the seeds."""
    values, zero = spread(job, theta, fill), {p.key: np.zeros(p.shape, np.float32) for p in job.chosen}
    result = []
    for n in range(len(theta)):
        one = np.zeros(len(theta))
        one[n] = 1
        direction = spread(job, one, zero)
        seed, sensor = scene_grad.seeds(job.plan.seed, 2**30 + number, k, n)[0], job.views[k].sensor
        given = (job.scene, job.table, job.chosen, values, direction, job.engine, sensor)
        result.append(scene_grad.derivative(*given, job.plan.spp_grad or SPP, seed))
    return np.stack(result)


def _weights(job: Any, k: int) -> Float[np.ndarray, "h w 3"]:
    """Of the squared differences, so that their sum is the loss: 0 where nothing counts."""
    view = job.views[k]
    counts = np.array(view.counts).astype(np.float64)
    weights = counts * np.array(view.weights) if job.loss == "relative" else counts
    return weights / (counts.sum() * len(job.views))


def _look(job: Any, k: int, seed: int, seen: _Seen) -> tuple[float, int]:
    """Render camera k, add the picture; its loss with its noise, and how many values are no numbers."""
    view = job.views[k]
    shown = np.array(scene_grad.picture(job.scene, job.engine, view.sensor, job.plan.spp, seed))[..., :3]
    finite = np.isfinite(shown)
    wrong = np.where(finite, shown - np.array(view.reference), 0).astype(np.float64)
    square = wrong**2
    seen.count, seen.total, seen.square = seen.count + 1, seen.total + wrong, seen.square + square
    return float((seen.weights * square).sum()) * len(job.views), int((~finite).sum())


def _normal(columns: Any, before: Any, seen: Mapping[int, _Seen]) -> tuple[np.ndarray, np.ndarray]:
    """H and g of the loss's half."""
    matrix: Any = 0.0
    gradient: Any = 0.0
    for k, sums in seen.items():
        now = columns[k].reshape(len(columns[k]), -1).astype(np.float64)
        other = now if k not in before else before[k].reshape(now.shape).astype(np.float64)
        weights = sums.weights.ravel()
        product = (now * weights) @ other.T
        matrix = matrix + (product + product.T) / 2
        gradient = gradient + ((now + other) / 2) @ (weights * (sums.total / sums.count).ravel())
    return matrix, gradient


def _reference_noise(columns: Any, before: Any, seen: Mapping[int, _Seen]) -> np.ndarray:
    """Covariance of g by what is left of I - R without render noise: Σ J W² r² Jᵀ."""
    total: Any = 0.0
    for k, sums in seen.items():
        now = columns[k].reshape(len(columns[k]), -1).astype(np.float64)
        other = now if k not in before else before[k].reshape(now.shape)
        product = (now * (sums.weights**2 * sums.products()).ravel()) @ other.T
        total = total + (product + product.T) / 2
    return total


def _short(job: Any, newton: Newton, matrix: Any, gradient: Any, seen: Mapping[int, _Seen]) -> np.ndarray:
    """Where a short round goes: a damped step, or half the way back to the best place so far."""
    loss = sum(float((s.weights * s.products()).sum()) for s in seen.values())
    noise = sum(s.noise() for s in seen.values())
    if newton.best is not None and loss > WORSE * newton.best[0] + noise:
        return (newton.theta + newton.best[1]) / 2
    if newton.best is None or loss < newton.best[0]:
        newton.best = loss, newton.theta
    matrix = matrix + DAMPING * np.diag(np.diag(matrix))
    return _bounded(job, newton.theta, matrix, matrix @ newton.theta - gradient)


def _total(newton: Newton, first: int | None = None, last: int | None = None) -> tuple[np.ndarray, np.ndarray]:
    """The system of the long rounds `first`..`last`; of all but the first, which began furthest away, by default."""
    begin = int(len(newton.system) >= LONG[0]) if first is None else first
    part = newton.system[begin:last]
    return np.sum([m for m, _ in part], axis=0), np.sum([r for _, r in part], axis=0)


def _inverse(matrix: Float[np.ndarray, "n n"]) -> Float[np.ndarray, "n n"]:
    """Pseudo-inverse of the scaled matrix: directions of which the pictures say next to nothing stay."""
    size = np.sqrt(np.maximum(np.diag(matrix), 0))
    scale = np.where(size > 0, 1 / np.where(size > 0, size, 1), 0)
    values, vectors = np.linalg.eigh(matrix * np.outer(scale, scale))
    strong = np.where(values > WEAK, 1 / np.maximum(values, WEAK), 0)
    return np.outer(scale, scale) * ((vectors * strong) @ vectors.T)


def _bounded(job: Any, theta: np.ndarray, matrix: np.ndarray, right: np.ndarray) -> np.ndarray:
    """The solution of matrix · x = right inside the bounds, not too far from theta."""
    low, high = _bounds(job)
    scales = _scales(job)
    reach = np.where(np.isfinite(high), 0.3 * scales, 2 * np.maximum(np.abs(theta), 0.05 * scales))
    low = np.maximum(low, np.where(np.isfinite(high), theta - reach, np.minimum(theta / 4, theta - reach * (low < 0))))
    high = np.minimum(high, theta + reach)
    held = np.zeros(len(theta), bool)
    step = np.zeros(len(theta))
    wanted = right - matrix @ theta
    for _ in range(len(theta)):
        step[~held] = _inverse(matrix[np.ix_(~held, ~held)]) @ (wanted - matrix[:, held] @ step[held])[~held]
        new = theta + step
        outside = ~held & ((new < low) | (new > high))
        if not outside.any():
            break
        step = np.clip(new, low, high) - theta
        held |= outside
    return np.clip(theta + step, low, high)


def _scales(job: Any) -> np.ndarray:
    return np.concatenate([np.full(int(job.free[p.key].sum()), job.scales[p.key]) for p in job.chosen])


def _bounds(job: Any) -> tuple[np.ndarray, np.ndarray]:
    ends = []
    for p in job.chosen:
        ends += [scene_keys.limits(p) or (-np.inf, np.inf)] * int(job.free[p.key].sum())
    low, high = np.array(ends, float).T
    return low, high


def errors(job: Any, newton: Newton) -> tuple[np.ndarray, np.ndarray]:
    """Standard error of every number (NaN where nothing tells), and whether its rounds still drift.

    Render noise comes from the long rounds' disagreement, the references' noise from what is left of the residuals.
    """
    count = len(newton.theta)
    begin = int(len(newton.system) >= LONG[0])
    used = newton.system[begin:]
    if len(used) < 2 or newton.noise is None:
        return np.full(count, np.nan), np.zeros(count, bool)
    matrix, _ = _total(newton)
    inverse = _inverse(matrix)
    left = np.array([m @ newton.theta - r for m, r in used])
    rendered = left.T @ left * len(used) / (len(used) - 1)
    own = sum(newton.steps[begin:]) ** 2 * newton.noise
    variance = np.diag(inverse @ rendered @ inverse) + np.maximum(np.diag(inverse @ own @ inverse), 0)
    error = np.sqrt(np.maximum(variance, 0))
    error[~(np.diag(inverse) > 0)] = np.nan
    half = begin + len(used) // 2
    ends = [_bounded(job, newton.theta, *_total(newton, *part)) for part in ((begin, half), (half, None))]
    drift = np.abs(ends[1] - ends[0])
    return error, (drift > 6 * np.nan_to_num(error)) & (drift > 0.02 * (np.abs(newton.theta) + 0.02 * _scales(job)))


def saved(newton: Newton) -> dict[str, np.ndarray]:
    """Everything but the derivatives, which are rendered again."""
    count = len(newton.theta)
    best = (np.nan, np.full(count, np.nan)) if newton.best is None else newton.best
    return {
        "theta": newton.theta,
        "counts": np.array([newton.round, int(newton.near), newton.size]),
        "previous": np.full(count, np.nan) if newton.previous is None else newton.previous,
        "best": np.append(best[0], best[1]),
        "matrices": np.array([m for m, _ in newton.system]).reshape(-1, count, count),
        "rights": np.array([r for _, r in newton.system]).reshape(-1, count),
        "steps": np.array(newton.steps, int),
        "noise": np.full((count, count), np.nan) if newton.noise is None else newton.noise,
    }


def brought_back(arrays: Mapping[str, np.ndarray]) -> Newton:
    """The reverse of `saved`."""
    held = {name: np.array(value) for name, value in arrays.items()}
    number, near, size = (int(n) for n in held["counts"])
    best = None if np.isnan(held["best"]).all() else (float(held["best"][0]), held["best"][1:])
    return Newton(
        held["theta"],
        number,
        bool(near),
        size,
        None if np.isnan(held["previous"]).any() else held["previous"],
        best,
        list(zip(held["matrices"], held["rights"], strict=True)),
        [int(n) for n in held["steps"]],
        None if np.isnan(held["noise"]).any() else held["noise"],
    )
