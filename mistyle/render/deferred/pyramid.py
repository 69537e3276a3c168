"""Adam on a Laplacian pyramid of a texture: coarse and fine at once (Weier et al. 2025, section 4).

A texture T is the sum of its pyramid's levels, T = Σ_l U_l c_l, where U_l upsamples level l by 2^l with smooth weights.
The gradient of a level is U_l^T dL/dT, so a coarse level pools many texels and moves them together, long before the
fine levels have enough gradients. Every level has its own Adam (beta_1 0.9, beta_2 0.99). T is linear in the levels, so
the levels themselves need no storage: a step adds Σ_l U_l Δc_l to the texture.

Noisy gradients bias Adam: a gradient that is large by chance is divided by a larger number. `fair` divides every
gradient by the root mean square of the earlier ones, which are independent of its noise, and then takes the running
mean.

Everything here is NumPy in a fixed order: the same gradients give the same bytes.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int

BETA_1, BETA_2 = 0.9, 0.99
WARM = 10  # first gradients, whose divisor includes themselves because earlier ones are too few
MOST = 10.0  # limit of a gradient relative to the earlier root mean square, as in Adam


@dataclass(frozen=True)
class Moments:
    """Adam's state of one level, changed in place: running means of gradient and its square, steps per number."""

    first: Float[np.ndarray, "..."]
    second: Float[np.ndarray, "..."]
    steps: Int[np.ndarray, "..."]


def start(shape: tuple[int, ...], pyramid: bool = True) -> tuple[Moments, ...]:
    """A fresh state, finest level first. Shapes other than (h, w, c), or `pyramid` False, have one level."""
    return tuple(
        Moments(np.zeros(size, np.float32), np.zeros(size, np.float32), np.zeros(size, np.int32))
        for size in sizes(shape, pyramid)
    )


def sizes(shape: tuple[int, ...], pyramid: bool = True) -> list[tuple[int, ...]]:
    """The levels' shapes, each half the previous one, down to a side of one texel."""
    result = [tuple(shape)]
    while pyramid and len(shape) == 3 and min(result[-1][:2]) > 1:
        rows, columns, channels = result[-1]
        result.append(((rows + 1) // 2, (columns + 1) // 2, channels))
    return result


def change(
    moments: tuple[Moments, ...],
    gradient: Float[np.ndarray, "..."],
    rate: float,
    share: float = 1.0,
    fair: bool = False,
    damping: float = 0.0,
) -> Float[np.ndarray, "..."]:
    """The texture's change for the gradient dL/dT; the state advances.

    Numbers whose gradient is exactly zero keep value and moments (masked updates): one camera does not see most texels.
    Every number counts its own steps for Adam's start-up correction. Level l moves at the rate rate · share^l. `fair`:
    see the module. Otherwise `damping` times the root mean square of a level's gradients is added to Adam's
    denominator, so that numbers with small gradients, mostly noise, move little.
    """
    steps = []
    level = np.ascontiguousarray(gradient, np.float32)
    for k, state in enumerate(moments):
        if k:
            level = reduce(level)
        pace = rate * share**k
        steps.append(_fair(state, level, pace) if fair else _adam(state, level, pace, damping))
    total = steps[-1]
    for finer in reversed(steps[:-1]):
        total = finer + enlarge(total, finer.shape[:2])
    return total


def _adam(
    state: Moments, gradient: Float[np.ndarray, "..."], rate: float, damping: float = 0.0
) -> Float[np.ndarray, "..."]:
    flat = gradient.ravel()
    moved: Any = np.flatnonzero(flat)
    if len(moved) == flat.size:
        moved = slice(None)  # avoids copies
    first, second, steps = state.first.ravel(), state.second.ravel(), state.steps.ravel()
    g = flat[moved]
    count = steps[moved] + 1
    m = np.float32(BETA_1) * first[moved] + np.float32(1 - BETA_1) * g
    v = np.float32(BETA_2) * second[moved] + np.float32(1 - BETA_2) * g * g
    first[moved], second[moved], steps[moved] = m, v, count
    past = np.arange(int(count.max(initial=0)) + 1)
    mean = m / (1 - BETA_1**past).astype(np.float32)[count]
    spread = np.sqrt(v / (1 - BETA_2**past).astype(np.float32)[count])
    if damping and spread.size:
        spread += np.float32(damping) * np.sqrt(np.mean(spread * spread))
    result = np.zeros_like(flat)
    result[moved] = np.float32(-rate) * mean / (spread + np.float32(1e-20))
    return result.reshape(gradient.shape)


def _fair(state: Moments, gradient: Float[np.ndarray, "..."], rate: float) -> Float[np.ndarray, "..."]:
    """As `_adam`; `first` holds the running mean of normalised gradients."""
    flat = gradient.ravel()
    moved = np.flatnonzero(flat)
    first, second, steps = state.first.ravel(), state.second.ravel(), state.steps.ravel()
    g, count = flat[moved], steps[moved] + 1
    known = second[moved]
    v = np.float32(BETA_2) * known + np.float32(1 - BETA_2) * g * g
    past = np.arange(int(count.max(initial=0)) + 1)
    with np.errstate(divide="ignore"):
        weight_1, weight_2 = (1 / (1 - beta**past) for beta in (BETA_1, BETA_2))
    own = v * weight_2.astype(np.float32)[count]
    before = known * weight_2.astype(np.float32)[np.maximum(count - 1, 1)]
    spread = np.sqrt(np.where(count > WARM, np.maximum(before, g * g / np.float32(MOST**2)), own))
    m = np.float32(BETA_1) * first[moved] + np.float32(1 - BETA_1) * g / (spread + np.float32(1e-20))
    first[moved], second[moved], steps[moved] = m, v, count
    result = np.zeros_like(flat)
    result[moved] = np.float32(-rate) * m * weight_1.astype(np.float32)[count]
    return result.reshape(gradient.shape)


def enlarge(coarse: Float[np.ndarray, "h w c"], size: tuple[int, int]) -> Float[np.ndarray, "h2 w2 c"]:
    """Upsampled by two, bilinear (weights 3/4 and 1/4), with a repeated border, cropped to `size`."""
    return _twice(_twice(coarse, 0), 1)[: size[0], : size[1]]


def reduce(fine: Float[np.ndarray, "h w c"]) -> Float[np.ndarray, "h2 w2 c"]:
    """The transpose of `enlarge`: sums, not means."""
    rows, columns = fine.shape[:2]
    padded = np.pad(fine, ((0, rows % 2), (0, columns % 2), (0, 0)))
    return _half(_half(padded, 0), 1)


def _twice(values: np.ndarray, axis: int) -> np.ndarray:
    values = np.moveaxis(values, axis, 0)
    before = np.concatenate([values[:1], values[:-1]])
    after = np.concatenate([values[1:], values[-1:]])
    result = np.empty((2 * len(values), *values.shape[1:]), np.float32)
    result[0::2] = np.float32(0.75) * values + np.float32(0.25) * before
    result[1::2] = np.float32(0.75) * values + np.float32(0.25) * after
    return np.moveaxis(result, 0, axis)


def _half(values: np.ndarray, axis: int) -> np.ndarray:
    values = np.moveaxis(values, axis, 0)
    even, odd = values[0::2], values[1::2]
    result = np.float32(0.75) * (even + odd)
    result[:-1] += np.float32(0.25) * even[1:]
    result[:1] += np.float32(0.25) * even[:1]
    result[1:] += np.float32(0.25) * odd[:-1]
    result[-1:] += np.float32(0.25) * odd[-1:]
    return np.moveaxis(result, 0, axis)
