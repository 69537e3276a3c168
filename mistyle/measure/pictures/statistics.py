"""Welch's test whether two noisy renders have the same expectation, and convergence rates."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

LEAST = 1e-6  # negligible difference, in linear radiance


@dataclass(frozen=True)
class Tested:
    """The result of a test of two means.

    passed    whether no block of any scale is rejected
    share     share of the pixels in rejected blocks, without the whole picture's
    worst     the largest |t|
    bias      mean of test minus reference over the reference's mean, all pixels together
    whole     whether the whole picture's mean is rejected
    t         (h w), of the smallest blocks, the channel that differs most, at full size; rejected likewise
    limit     the p below which a block is rejected (Šidák)
    """

    passed: bool
    share: float
    worst: float
    bias: float
    whole: bool
    t: Float[np.ndarray, "h w"]
    rejected: Bool[np.ndarray, "h w"]
    limit: float


def same_picture(
    reference: Float[np.ndarray, "n h w 3"],
    test: Float[np.ndarray, "m h w 3"],
    level: float = 0.01,
    block: int = 4,
    floor: float = 1e-3,
) -> Tested:
    """Welch's test of the means of independent renders, per block and channel, at three scales.

    The blocks are `block` pixels wide, four times as wide, and the whole picture: small ones detect local differences,
    large ones faint ones. Each seed's block mean is one observation; means and variances come from the seeds alone. The
    hypothesis "both have the same expectation" is rejected for the picture at `level` with Šidák's correction over all
    blocks, so that an equal pair fails at most once in 1 / level times. A standard error is at least `floor` times the
    block's brightness (few seeds may agree by chance; smaller differences are ignored). Fireflies make block means less
    normal than the test assumes. Raises ValueError for fewer than 2 seeds.
    """
    if len(reference) < 2 or len(test) < 2:
        raise ValueError(f"{len(reference)} and {len(test)} renders; expected at least two of each for a variance")
    size = reference.shape[1:3]
    sides = [block, 4 * block, max(size)]
    tests = [_welch(_blocks(reference, side), _blocks(test, side), floor) for side in sides]
    limit = -math.expm1(math.log1p(-level) / sum(p.size for _, p in tests))
    rejected = [np.asarray((p < limit).any(axis=-1)) for _, p in tests]
    bias = float((test.mean() - reference.mean()) / max(float(reference.mean()), 1e-12))
    smallest = tests[0][0]
    picked = np.take_along_axis(smallest, np.abs(smallest).argmax(axis=-1)[..., None], axis=-1)[..., 0]
    fine, coarse = (_spread(r, side, size) for r, side in zip(rejected[:2], sides[:2], strict=True))
    # The map omits a large rejected block that a small rejected one inside explains.
    explained = np.asarray(_blocks(np.repeat(fine[None, ..., None], 3, axis=3), sides[1])[0, ..., 0] > 0)
    where = fine | (coarse & ~_spread(explained, sides[1], size))
    return Tested(
        passed=not any(r.any() for r in rejected),
        share=float(where.mean()),
        worst=max(float(np.abs(t).max()) for t, _ in tests),
        bias=bias,
        whole=bool(rejected[2].any()),
        t=_spread(picked, block, size).astype(np.float32),
        rejected=where,
        limit=limit,
    )


def _welch(a: np.ndarray, b: np.ndarray, floor: float) -> tuple[np.ndarray, np.ndarray]:
    """t and p of every block and channel, seeds along the first axis."""
    from scipy.stats import t as student

    n, m = len(a), len(b)
    va, vb = a.var(axis=0, ddof=1) / n, b.var(axis=0, ddof=1) / m
    error = np.maximum(va + vb, (floor * np.abs(a.mean(axis=0)) + LEAST) ** 2)
    spread = np.maximum(va**2 / (n - 1) + vb**2 / (m - 1), 1e-300)
    freedom = np.where(va + vb > 0, np.maximum((va + vb) ** 2 / spread, 1.0), n + m - 2)
    t = (b.mean(axis=0) - a.mean(axis=0)) / np.sqrt(error)
    return t, 2 * student.sf(np.abs(t), freedom)


def _blocks(stack: np.ndarray, block: int) -> Float[np.ndarray, "n r c 3"]:
    """Block means; blocks at the border average the pixels inside the picture."""
    rows, columns = (np.arange(0, s, block) for s in stack.shape[1:3])
    total = np.add.reduceat(np.add.reduceat(stack.astype(np.float64), rows, axis=1), columns, axis=2)
    heights, widths = (np.diff([*starts, s]) for starts, s in ((rows, stack.shape[1]), (columns, stack.shape[2])))
    return total / (heights[:, None] * widths)[None, :, :, None]


def _spread(values: np.ndarray, block: int, size: tuple[int, int]) -> np.ndarray:
    return np.repeat(np.repeat(values, block, axis=0), block, axis=1)[: size[0], : size[1]]


def interval(values: Sequence[float], level: float = 0.95) -> tuple[float, float]:
    """Mean and half the width of its confidence interval, by Student's t; NaN half-width for a single value."""
    from scipy.stats import t as student

    numbers = np.asarray(values, np.float64)
    if len(numbers) < 2:
        return float(numbers.mean()), math.nan
    half = student.ppf(0.5 + level / 2, len(numbers) - 1) * numbers.std(ddof=1) / math.sqrt(len(numbers))
    return float(numbers.mean()), float(half)


def slope(x: Sequence[float], y: Sequence[float]) -> float:
    """The exponent k of y ~ x^k by least squares of the logarithms; NaN with fewer than two usable points."""
    points = [(math.log(a), math.log(b)) for a, b in zip(x, y, strict=True) if a > 0 and b > 0]
    if len(points) < 2:
        return math.nan
    u, v = np.array(points).T
    spread = float(((u - u.mean()) ** 2).sum())
    return float(((u - u.mean()) * (v - v.mean())).sum() / spread) if spread > 0 else math.nan
