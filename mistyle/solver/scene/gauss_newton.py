"""Gauss–Newton on the few numbers of a scene: literals and colours under a squared loss, from noisy renders.

A round renders the picture's derivative J by every number (forward mode) at the values θ, then pictures I with other
random numbers. It solves H Δ = -g with g = Φᵀ W (mean I - R) and H = Φᵀ W J. Φ is J without outliers. At the solution
the expected I is R, so any Φ that does not depend on I gives a g without bias. H multiplies the Φ of some rounds with
the J of others, so it has no bias from J's noise.

The first rounds are short and approach the solution. They share their random numbers, so that the difference of two
noisy losses has little noise, and a step is kept only if the loss falls. The rest share the remaining steps and do not
replace one another: the result is the mean of their solutions, and their disagreement its standard error.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Float

from mistyle.process import stopping
from mistyle.render.live import parameters as scene_keys
from mistyle.render.live.parameters import Parameter
from mistyle.solver.scene import gradients as scene_grad

MOST_NUMBERS = 32
MOST_BYTES = 2.5e8  # largest size of the stored derivatives, also in checkpoints
SPP = (8, 64)  # range of the derivatives' default samples, which cost about as much as the pictures
OUTLIER, BESIDE = 8.0, 5  # limit of a derivative relative to its local mean size, and the window's side in pixels
APPROACH = 0.6  # largest share of the steps in short rounds
SHORT = 4  # pictures of each camera in a short round of one or two cameras
SECANT = 0.03  # half the difference of roughness, over which its derivative is taken
NEAR = 0.1  # relative change below which the long rounds begin
LONG = (4, 8)  # fewest and most long rounds
LOST = 0.01  # share of non-finite values above which a round returns half the way
WEAK = 1e-3  # eigenvalues of the scaled H below which a direction stays unchanged
FAR = 4.0  # standard errors between the short and the long rounds' results above which the two are compared
DAMPING = 1e-3  # of the short rounds


@dataclass(frozen=True)
class Round:
    """A long round: cameras, steps, its values, and g at them."""

    views: tuple[int, ...]
    steps: int
    theta: Float[np.ndarray, " n"]
    gradient: Float[np.ndarray, " n"]


@dataclass
class Newton:
    """The changing state; `columns` are sums of derivatives by camera, of alternating rounds, and `counts` their
    numbers."""

    theta: Float[np.ndarray, " n"]
    round: int = 0
    near: bool = False
    size: int = 0  # steps of a long round; 0 before them
    best: tuple[float, Float[np.ndarray, " n"]] | None = None
    rounds: list[Round] = field(default_factory=list)
    noise: Float[np.ndarray, "n n"] | None = None  # covariance of g by the references' noise
    columns: dict[int, Float[np.ndarray, "2 n h w 3"]] = field(default_factory=dict)
    counts: dict[int, Float[np.ndarray, " 2"]] = field(default_factory=dict)


@dataclass
class _PictureSums:
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


def refusal(chosen: Sequence[Parameter], free: Mapping[str, np.ndarray], views: Sequence[Any], loss: Any) -> str:
    """The reason why Gauss–Newton does not suit a fit; empty if it does."""
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
    """The free numbers as one vector."""
    return np.concatenate([values[p.key][job.free[p.key]] for p in job.chosen]).astype(np.float64)


def spread(job: Any, theta: Float[np.ndarray, " n"], fill: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The inverse of `gathered`; fixed numbers come from `fill`."""
    result, start = {}, 0
    for p in job.chosen:
        free = job.free[p.key]
        result[p.key] = np.array(fill[p.key], np.float32)
        result[p.key][free] = theta[start : start + int(free.sum())]
        start += int(free.sum())
    return result


def advance(job: Any, state: Any, camera: Callable[[int, int], int]) -> bool:
    """One round; False, without changes, on a request to stop. `camera` maps a step and a slot to a camera."""
    newton: Newton = state.newton
    size, long = _size(job, state)
    begin = state.iteration if long else 0
    turns = [[camera(begin + m, slot) for slot in range(job.plan.sensors_per_step)] for m in range(size)]
    views = tuple(sorted({k for turn in turns for k in turn}))
    # A short round needs both halves at its own values: H then has no bias from J's noise either.
    parts = [{k: _columns(job, state.values, newton, k, size, part) for k in views} for part in range(1 if long else 2)]
    scene_grad.put(job.table, job.chosen, state.values)
    seen = {k: _PictureSums(_weights(job, k)) for k in views}
    losses, broken = [], dict.fromkeys(views, 0)
    for m, turn in enumerate(turns):
        if stopping.asked():
            return False
        numbers = [scene_grad.seeds(job.plan.seed, begin + m, slot)[0] for slot in range(len(turn))]
        renders = [_render_view(job, k, number, seen[k]) for k, number in zip(turn, numbers, strict=True)]
        losses.append(float(np.mean([value for value, _ in renders])))
        for k, (_, invalid) in zip(turn, renders, strict=True):
            broken[k] += invalid
    _store_derivatives(newton, parts)
    old, gradient = newton.theta, _gradient(newton, seen)
    if long:
        newton.size = newton.size or size
        newton.rounds.append(Round(views, size, old, gradient))
        newton.noise = _reference_noise(newton, seen)
        new = _bounded(job, old, *_system(job, newton, _averaged_rounds(newton)))
    else:
        lost = sum(broken.values()) / (size * job.plan.sensors_per_step * np.size(next(iter(seen.values())).weights))
        new = _short_step(job, newton, gradient, seen, lost)
        newton.near = newton.round >= 2 and bool((np.abs(new - old) < NEAR * (np.abs(new) + 0.02 * _scales(job))).all())
    newton.theta, newton.round = new, newton.round + 1
    state.values = spread(job, new, state.values)
    state.trace += losses
    state.iteration += size
    for k, count in broken.items():
        state.broken[k] = state.broken.get(k, 0) + count
    reached = np.any([np.any(newton.columns[k] != 0, axis=(0, 2, 3, 4)) for k in views], axis=0)
    shown = spread(job, reached.astype(float), {p.key: np.zeros(p.shape) for p in job.chosen})
    for p in job.chosen:
        state.moments[p.key][0].steps[shown[p.key] > 0] += size
    return True


def _size(job: Any, state: Any) -> tuple[int, bool]:
    """Steps of the next round, and whether it is a long one."""
    left = job.plan.iterations - state.iteration
    if state.newton.size:
        return min(state.newton.size, left), True
    all_views = math.ceil(len(job.views) / job.plan.sensors_per_step)
    short = max(SHORT * min(all_views, 2), all_views)
    if not state.newton.near and state.iteration + short <= APPROACH * job.plan.iterations:
        return short, False
    cost = len(state.newton.theta) * len(job.views) / job.plan.sensors_per_step
    rounds = min(max(int(left / cost), LONG[0]), LONG[1], left)
    return math.ceil(left / rounds), True


def _columns(job: Any, fill: Any, newton: Newton, k: int, size: int, part: int) -> Float[np.ndarray, "n h w 3"]:
    """The derivatives of camera k's picture at the values of the round, which has `size` steps.

    That by a roughness is a difference of two pictures with the same random numbers: the derivative of a narrow lobe's
    sampled density has so many outliers that what is left without them need not lead downhill.
    """
    theta = newton.theta
    values, zero = spread(job, theta, fill), {p.key: np.zeros(p.shape, np.float32) for p in job.chosen}
    own = size * job.plan.spp * job.plan.sensors_per_step // (2 * len(theta) * len(job.views))
    spp = job.plan.spp_grad or min(max(own, SPP[0]), SPP[1])
    live = scene_grad.LiveScene(job.scene, job.table, job.chosen, job.engine)
    rough = np.concatenate([np.full(int(job.free[p.key].sum()), p.role in scene_keys.ROUGH) for p in job.chosen])
    result = []
    for n in range(len(theta)):
        one = np.zeros(len(theta))
        one[n] = 1
        seed, sensor = scene_grad.seeds(job.plan.seed, 2**30 + 2 * newton.round + part, k, n)[0], job.views[k].sensor
        if not rough[n]:
            result.append(scene_grad.derivative(live, values, spread(job, one, zero), sensor, spp, seed))
            continue
        ends = [np.clip(theta + step * one, *_bounds(job)) for step in (-SECANT, SECANT)]
        pictures = []
        for end in ends:
            scene_grad.put(job.table, job.chosen, spread(job, end, fill))
            pictures.append(np.array(scene_grad.picture(job.scene, job.engine, sensor, spp, seed))[..., :3])
        slope = (pictures[1] - pictures[0]) / np.float32((ends[1] - ends[0])[n])
        result.append(np.where(np.isfinite(slope), slope, np.float32(0)))
    return np.stack(result)


def _store_derivatives(newton: Newton, parts: Sequence[Mapping[int, Float[np.ndarray, "n h w 3"]]]) -> None:
    """Add a long round's derivatives to one half. A short round's two replace all earlier ones, since its J differs."""
    for part, columns in enumerate(parts):
        for k, new in columns.items():
            if k not in newton.columns:
                newton.columns[k], newton.counts[k] = np.zeros((2, *new.shape), np.float32), np.zeros(2)
            half = part if len(parts) == 2 else newton.round % 2
            if len(parts) == 2:
                newton.columns[k][half], newton.counts[k][half] = 0, 0
            newton.columns[k][half] += new
            newton.counts[k][half] += 1


def _halves(newton: Newton, k: int) -> tuple[np.ndarray, np.ndarray]:
    """The mean derivatives (n, values) of either half of the rounds; twice the same if only one half exists."""
    means = [s.reshape(len(s), -1) / max(c, 1) for s, c in zip(newton.columns[k], newton.counts[k], strict=True)]
    first, second = (means[h if newton.counts[k][h] else 1 - h].astype(np.float64) for h in (0, 1))
    return first, second


def _without_outliers(columns: Float[np.ndarray, "n v"], shape: tuple[int, ...]) -> Float[np.ndarray, "n v"]:
    """Derivatives without outliers: each is limited to OUTLIER times its local mean size, plus its picture's mean."""
    result = []
    for column in columns:
        size = np.abs(column.reshape(shape))
        inside = scene_grad.sums_around(np.ones_like(size[..., :1]), BESIDE) - 1
        beside = (scene_grad.sums_around(size, BESIDE) - size) / np.maximum(inside, 1)
        most = OUTLIER * np.maximum(beside, 0) + size.mean()
        result.append(np.clip(column, -most.ravel(), most.ravel()))
    return np.stack(result)


def _weights(job: Any, k: int) -> Float[np.ndarray, "h w 3"]:
    """Weights of the squared differences whose sum is the loss; 0 at invalid values."""
    view = job.views[k]
    counts = np.array(view.counts).astype(np.float64)
    weights = counts * np.array(view.weights) if job.loss == "relative" else counts
    return weights / counts.sum()


def _render_view(job: Any, k: int, seed: int, seen: _PictureSums) -> tuple[float, int]:
    """Render camera k and add the picture; returns its loss with noise and its number of non-finite values."""
    view = job.views[k]
    shown = np.array(scene_grad.picture(job.scene, job.engine, view.sensor, job.plan.spp, seed))[..., :3]
    finite = np.isfinite(shown)
    residual = np.where(finite, shown - np.array(view.reference), 0).astype(np.float64)
    square = residual**2
    seen.count, seen.total, seen.square = seen.count + 1, seen.total + residual, seen.square + square
    return float((seen.weights * square).sum()), int((~finite).sum())


def _gradient(newton: Newton, seen: Mapping[int, _PictureSums]) -> Float[np.ndarray, " n"]:
    """g of half the loss, mean over the rendered cameras."""
    total: Any = 0.0
    for k, sums in seen.items():
        test = _without_outliers(np.mean(_halves(newton, k), axis=0), sums.weights.shape)
        total = total + test @ (sums.weights * sums.total / sums.count).ravel()
    return total / len(seen)


def _matrices(job: Any, newton: Newton, views: Sequence[int]) -> dict[int, Float[np.ndarray, "n n"]]:
    """H of half the loss by camera."""
    result = {}
    for k in views:
        weights, shape = _weights(job, k).ravel(), _weights(job, k).shape
        first, second = _halves(newton, k)
        robust = [_without_outliers(half, shape) * weights for half in (first, second)]
        product = robust[0] @ second.T + robust[1] @ first.T
        result[k] = (product + product.T) / 4
    return result


def _reference_noise(newton: Newton, seen: Mapping[int, _PictureSums]) -> Float[np.ndarray, "n n"]:
    """Covariance of g by the residuals I - R without render noise: Σ Φ W² r² Φᵀ."""
    total: Any = 0.0
    for k, sums in seen.items():
        first, second = (_without_outliers(half, sums.weights.shape) for half in _halves(newton, k))
        product = (first * (sums.weights**2 * sums.products()).ravel()) @ second.T
        total = total + (product + product.T) / 2
    return total / len(seen) ** 2


def _short_step(
    job: Any, newton: Newton, gradient: np.ndarray, seen: Mapping[int, _PictureSums], lost: float
) -> Float[np.ndarray, " n"]:
    """The values after a short round: a damped step, or half the way back to the best values so far.

    It returns if the loss with the same random numbers has increased, or if `lost`, the share of non-finite values,
    shows that the last step left the plugins' domain.
    """
    loss = float(np.mean([(s.weights * s.products()).sum() for s in seen.values()]))
    if newton.best is not None and (lost > LOST or loss > newton.best[0]):
        return (newton.theta + newton.best[1]) / 2
    newton.best = loss, newton.theta
    matrix: Any = np.mean(list(_matrices(job, newton, list(seen)).values()), axis=0)
    matrix = matrix + DAMPING * np.diag(np.abs(np.diag(matrix)))
    return _bounded(job, newton.theta, matrix, matrix @ newton.theta - gradient)


def _averaged_rounds(newton: Newton) -> list[Round]:
    """The long rounds that are averaged: all but the first, which began furthest away."""
    return newton.rounds[int(len(newton.rounds) >= LONG[0]) :]


def _system(job: Any, newton: Newton, rounds: Sequence[Round]) -> tuple[np.ndarray, np.ndarray]:
    """Matrix and right-hand side whose solution is the rounds' mean, each weighted by its steps."""
    each = _matrices(job, newton, sorted({k for r in rounds for k in r.views}))
    matrix: Any = 0.0
    right: Any = 0.0
    for r in rounds:
        own = np.mean([each[k] for k in r.views], axis=0)
        matrix = matrix + r.steps * own
        right = right + r.steps * (own @ r.theta - r.gradient)
    return matrix, right


def _inverse(matrix: Float[np.ndarray, "n n"]) -> Float[np.ndarray, "n n"]:
    """Pseudo-inverse of the scaled matrix: directions that the pictures hardly constrain stay unchanged."""
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
    residual = right - matrix @ theta
    for _ in range(len(theta)):
        step[~held] = _inverse(matrix[np.ix_(~held, ~held)]) @ (residual - matrix[:, held] @ step[held])[~held]
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


def errors(job: Any, newton: Newton, start: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Standard error of every number (NaN if unconstrained), and whether it has not converged: its rounds still drift,
    or it moved to where nothing constrains it.

    Render noise is estimated from the long rounds' disagreement, the references' noise from the residuals.
    """
    count, used = len(newton.theta), _averaged_rounds(newton)
    if len(used) < 2 or newton.noise is None:
        return np.full(count, np.nan), np.zeros(count, bool)
    inverse = _inverse(_system(job, newton, used)[0])
    ends = [_system(job, newton, [r]) for r in used]
    left = np.array([m @ newton.theta - right for m, right in ends])
    rendered = left.T @ left * len(used) / (len(used) - 1)
    own = sum(r.steps for r in used) ** 2 * newton.noise
    variance = np.diag(inverse @ rendered @ inverse) + np.maximum(np.diag(inverse @ own @ inverse), 0)
    error = np.sqrt(np.maximum(variance, 0))
    error[~(np.diag(inverse) > 0)] = np.nan
    half = len(used) // 2
    first, second = (_bounded(job, newton.theta, *_system(job, newton, part)) for part in (used[:half], used[half:]))
    drift = np.abs(second - first)
    drifts = (drift > 6 * np.nan_to_num(error)) & (drift > 0.02 * (np.abs(newton.theta) + 0.02 * _scales(job)))
    return error, drifts | (np.isnan(error) & (newton.theta != start))


def left_behind(job: Any, newton: Newton, errors: Mapping[str, np.ndarray]) -> Float[np.ndarray, " n"] | None:
    """The best values of the short rounds if the long ones, which keep every step, ended outside their own errors."""
    if newton.best is None or (np.abs(newton.best[1] - newton.theta) <= FAR * gathered(job, errors)).all():
        return None
    return newton.best[1]


def saved(newton: Newton) -> dict[str, np.ndarray]:
    """The whole state as arrays."""
    count = len(newton.theta)
    best = (np.nan, np.full(count, np.nan)) if newton.best is None else newton.best
    result = {
        "theta": newton.theta,
        "numbers": np.array([newton.round, int(newton.near), newton.size, len(newton.rounds)]),
        "best": np.append(best[0], best[1]),
        "noise": np.full((count, count), np.nan) if newton.noise is None else newton.noise,
    }
    for n, r in enumerate(newton.rounds):
        result[f"round{n}"] = np.concatenate([[r.steps], r.theta, r.gradient])
        result[f"views{n}"] = np.array(r.views, int)
    for k, sums in newton.columns.items():
        result |= {f"columns{k}": sums.copy(), f"counts{k}": newton.counts[k].copy()}
    return result


def brought_back(arrays: Mapping[str, np.ndarray]) -> Newton:
    """The inverse of `saved`."""
    held = {name: np.array(value) for name, value in arrays.items()}
    number, near, size, rounds = (int(n) for n in held["numbers"])
    count = len(held["theta"])
    views = [int(name.removeprefix("columns")) for name in held if name.startswith("columns")]
    return Newton(
        held["theta"],
        number,
        bool(near),
        size,
        None if np.isnan(held["best"]).all() else (float(held["best"][0]), held["best"][1:]),
        [
            Round(tuple(int(k) for k in held[f"views{n}"]), int(row[0]), row[1 : 1 + count], row[1 + count :])
            for n, row in ((n, held[f"round{n}"]) for n in range(rounds))
        ],
        None if np.isnan(held["noise"]).any() else held["noise"],
        {k: held[f"columns{k}"] for k in views},
        {k: held[f"counts{k}"] for k in views},
    )
