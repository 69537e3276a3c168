"""Adam on the table of texels (`render/deferred/renderer.py`), preconditioned by an image pyramid, without host syncs.

A texture's step is the sum of the steps of all levels of its pyramid. Level 0 is the texture; each further level has
half the rows and columns and sums the gradients of its texels. Adam's step has the same length on every level, so
low-frequency errors are corrected at once (Weier et al. 2025, Laplacian mipmaps). Texels with a zero gradient keep
value and moments (masked updates). A texel whose gradient is not finite is frozen from then on; the first picture and
channel where that happened are recorded.

Each step is one frozen function; sums are gathers in a fixed order.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from mistyle.core.drjit_arrays import aligned
from mistyle.render.deferred.material_table import ALBEDO, COLUMNS, METALLIC, ROUGHNESS, TILT_X, TILT_Y
from mistyle.render.mitsuba import device
from mistyle.render.mitsuba.device import dr, mi

CHANNELS = ("albedo", "albedo", "albedo", "normal", "normal", "roughness", "metallic")
BETA1, BETA2, EPSILON = 0.9, 0.99, 1e-12
FINE = 0xFFFFFFFF  # all gradients of this texel were finite


@dataclass(frozen=True)
class AdamOptions:
    """Settings of a Descent's steps.

    levels   of the pyramid, 1: the texture alone
    floor    least roughness
    tilt     bounds |tilt|; all other channels stay within 0..1
    damping  this multiple of a channel's RMS gradient on a level is added to Adam's denominator: without it an unknown
             that hardly affects the pictures moves as fast as all others, driven by noise
    """

    levels: int = 1
    floor: float = 0.04
    tilt: float = 0.95
    damping: float = 0.0


DEFAULT_OPTIONS = AdamOptions()


class Descent:
    """Moments of every level of every texture set's pyramid, and the step.

    `rates` are factors of the rate per channel of the table (8; 0 freezes a channel), `shares` further factors by texel
    and channel.
    """

    def __init__(
        self,
        sizes: Sequence[tuple[int, int]],
        rates: Sequence[float],
        options: AdamOptions = DEFAULT_OPTIONS,
        *,
        shares: Float[np.ndarray, "t 8"] | None = None,
    ) -> None:
        device.use()
        self.sizes = [(rows, columns) for rows, columns in sizes]
        self.rates, self.options = tuple(rates), options
        self.texels = sum(rows * columns for rows, columns in sizes)
        self.pyramids = [_levels(size, options.levels) for size in self.sizes]
        widths = [rows * columns for pyramid in self.pyramids for rows, columns in pyramid]
        self.moments = [[mi.Float(aligned(np.zeros(8 * n))) for n in widths] for _ in range(2)]
        self.ages = [mi.Float(aligned(np.zeros(n))) for n in widths]
        self.blame = mi.UInt32(aligned(np.full(self.texels, FINE), np.uint32))
        self.shares = [] if shares is None else [mi.Float(aligned(shares.ravel()))]
        self._run = device.Frozen(self._step)

    def step(self, table: Any, gradient: Any, rate: float, picture: int) -> Any:
        """The table (a Dr.Jit Float, 8 a texel) after one step along `gradient` (same layout) of `picture`."""
        table, self.moments, self.ages, self.blame = self._run(
            table, gradient, (self.moments, self.ages, self.blame), self.shares,
            dr.opaque(mi.Float, float(rate)), dr.opaque(mi.UInt32, COLUMNS * picture),
        )  # fmt: skip
        return table

    def state(self) -> dict[str, np.ndarray]:
        """The state, beside the table, from which a descent resumes."""
        names = ("first", "second")
        result = {
            f"{n}{k}": np.array(a) for n, part in zip(names, self.moments, strict=True) for k, a in enumerate(part)
        }
        return result | {f"age{k}": np.array(a) for k, a in enumerate(self.ages)} | {"blame": np.array(self.blame)}

    def restore(self, state: dict[str, np.ndarray]) -> None:
        """Resume from `state()`."""
        count = len(self.ages)
        self.moments = [[mi.Float(aligned(state[f"{n}{k}"])) for k in range(count)] for n in ("first", "second")]
        self.ages = [mi.Float(aligned(state[f"age{k}"])) for k in range(count)]
        self.blame = mi.UInt32(aligned(state["blame"], np.uint32))

    def stopped(self) -> list[tuple[int, str, int]]:
        """(texel, map, picture) of every texel whose gradient was not finite."""
        blame: Int[np.ndarray, " t"] = np.array(self.blame)
        bad = np.flatnonzero(blame < FINE)
        return [(int(k), CHANNELS[int(blame[k]) % 8], int(blame[k]) // 8) for k in bad]

    def _step(self, table, gradient, state, shares, rate, picture) -> Any:
        """New table, moments, ages and records of non-finite gradients; `state` holds the old ones."""
        moments, ages, blame = state
        texel = dr.arange(mi.UInt32, self.texels)
        rows = [dr.gather(mi.Float, gradient, texel * COLUMNS + c) for c in range(7)]
        finite = mi.Bool(True)
        channel = mi.UInt32(0)
        for c in reversed(range(7)):
            good = dr.isfinite(rows[c])
            finite &= good
            channel = dr.select(good, channel, c)
        blame = dr.select((blame == FINE) & ~finite, picture + channel, blame)
        moves = blame == FINE
        packed = dr.ravel(mi.ArrayXf([dr.select(moves, r, 0) for r in rows] + [dr.zeros(mi.Float, self.texels)]))
        old = [dr.gather(mi.Float, table, texel * COLUMNS + c) for c in range(8)]
        first, second, age, moved, start, k = [], [], [], [], 0, 0
        for size, pyramid in zip(self.sizes, self.pyramids, strict=True):
            count = size[0] * size[1]
            fine = dr.gather(mi.ArrayXf, packed, dr.arange(mi.UInt32, count) + start, shape=(8, count))
            total = None
            for level, shape in enumerate(pyramid):
                if level == 1:
                    fine = _halved(packed, start, size, shape)
                elif level:
                    fine = _halved(dr.ravel(fine), 0, pyramid[level - 1], shape)
                new1, new2, new_age, step = self._adam(fine, moments[0][k], moments[1][k], ages[k])
                first.append(new1)
                second.append(new2)
                age.append(new_age)
                total = step if total is None else total + _upsample(step, shape, size)
                k += 1
            moved.append(total)
            start += count
        change = moved[0] if len(moved) == 1 else [dr.concat([m[c] for m in moved]) for c in range(8)]
        for share in shares:
            change = [change[c] * dr.gather(mi.Float, share, texel * COLUMNS + c) for c in range(8)]
        new = [old[c] - rate * self.rates[c] * change[c] if self.rates[c] else old[c] for c in range(8)]
        new = [dr.select(moves, a, b) for a, b in zip(self._projected(new), old, strict=True)]
        table = dr.ravel(mi.ArrayXf(new))
        dr.eval(table, first, second, age, blame)
        return table, [first, second], age, blame

    def _adam(self, g, first, second, age) -> tuple[Any, Any, Any, Any]:
        """Moments and step of one level; 0 where the gradient is 0."""
        width = dr.width(age)
        row = dr.arange(mi.UInt32, width)
        old1, old2 = (dr.gather(mi.ArrayXf, a, row, shape=(8, width)) for a in (first, second))
        on = g[0] != 0
        for c in range(1, 7):
            on |= g[c] != 0
        age = dr.select(on, age + 1, age)
        new1, new2 = BETA1 * old1 + (1 - BETA1) * g, BETA2 * old2 + (1 - BETA2) * dr.square(g)
        scale1, scale2 = 1 / (1 - BETA1**age), 1 / (1 - BETA2**age)
        least = mi.ArrayXf([dr.zeros(mi.Float, width) + EPSILON] * 8)
        if self.options.damping:
            share = dr.maximum(mi.Float(dr.mean(dr.select(on, mi.Float(1), mi.Float(0)))), mi.Float(1e-6))
            square = [dr.mean(dr.select(on, new2[c] * scale2, 0)) / share for c in range(8)]
            least = mi.ArrayXf(
                [dr.zeros(mi.Float, width) + self.options.damping * dr.sqrt(s) + EPSILON for s in square]
            )
        step = dr.select(on, new1 * scale1 / (dr.sqrt(new2 * scale2) + least), 0)
        return dr.ravel(dr.select(on, new1, old1)), dr.ravel(dr.select(on, new2, old2)), age, step

    def _projected(self, x: list) -> list:
        scale = dr.minimum(
            1, self.options.tilt / dr.maximum(dr.sqrt(dr.square(x[TILT_X]) + dr.square(x[TILT_Y])), 1e-9)
        )
        colour = [dr.clip(v, 0, 1) for v in x[ALBEDO]]
        tilt = x[TILT_X] * scale, x[TILT_Y] * scale
        return [*colour, *tilt, dr.clip(x[ROUGHNESS], self.options.floor, 1), dr.clip(x[METALLIC], 0, 1), x[-1]]


def _levels(size: tuple[int, int], levels: int) -> list[tuple[int, int]]:
    result = [size]
    while len(result) < levels and min(result[-1]) > 8:
        result.append((-(-result[-1][0] // 2), -(-result[-1][1] // 2)))
    return result


def _halved(packed: Any, start: int, size: tuple[int, int], half: tuple[int, int]) -> Any:
    """Sums over 2 x 2 texels of the `size` ones from `start` on."""
    count = half[0] * half[1]
    index = dr.arange(mi.UInt32, count)
    row, column = index // half[1], index % half[1]
    total = dr.zeros(mi.ArrayXf, (8, count))
    for dy in (0, 1):
        for dx in (0, 1):
            y, x = 2 * row + dy, 2 * column + dx
            inside = (y < size[0]) & (x < size[1])
            total += dr.gather(mi.ArrayXf, packed, y * size[1] + x + start, active=inside, shape=(8, count))
    return total


def _upsample(coarse: Any, shape: tuple[int, int], size: tuple[int, int]) -> Any:
    """Bilinear interpolation of a level's texels at those of the texture."""
    packed, count = dr.ravel(coarse), size[0] * size[1]
    index = dr.arange(mi.UInt32, count)
    by = 2 ** round(np.log2(size[0] / shape[0]))
    y, x = (mi.Float(index // size[1]) + 0.5) / by - 0.5, (mi.Float(index % size[1]) + 0.5) / by - 0.5
    low_y, low_x = dr.floor(y), dr.floor(x)
    total = dr.zeros(mi.ArrayXf, (8, count))
    for dy, wy in ((0, 1 - (y - low_y)), (1, y - low_y)):
        for dx, wx in ((0, 1 - (x - low_x)), (1, x - low_x)):
            row = mi.UInt32(dr.clip(low_y + dy, 0, shape[0] - 1))
            column = mi.UInt32(dr.clip(low_x + dx, 0, shape[1] - 1))
            total += wx * wy * dr.gather(mi.ArrayXf, packed, row * shape[1] + column, shape=(8, count))
    return total


def table_on_device(table: Float[np.ndarray, "t 8"]) -> Any:
    """The table as a Dr.Jit array in memory aligned to 64 bytes."""
    return mi.Float(aligned(table.ravel()))
