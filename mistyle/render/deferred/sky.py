"""Soft light (environment maps, ambient light, spherical Gaussians) as a few directions and a map.

The sphere is divided into D cells of about equal importance, half by luminance and half by solid angle, and each cell
into VARIANTS parts. A sample sees one part of every cell, and its neighbours see others. Their mean has the accuracy of
D · VARIANTS directions, and the parts together preserve the light's energy exactly. Where a glossy lobe is narrower
than the cells, the map is sampled instead (`kernels.soft_light`). Everything is in world axes, NumPy only.
"""

import heapq
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from mistyle.core.light import SOFT, Environment, Light, soft_radiance

REC709 = np.array([0.2126, 0.7152, 0.0722])
# Rows of the map: coarser environments are interpolated, finer ones averaged.
LEAST_ROWS, MOST_ROWS = 128, 512
VARIANTS = 16


@dataclass(frozen=True)
class Sky:
    """d cells and a latitude-longitude map of h rows: θ from +Y down, φ = atan2(x, -z), pixel centres at +0.5.

    direction  unit, the light's centroid in each of a cell's v parts
    energy     v times ∫ radiance dω over the part, linear Rec.709
    angle      solid angle of the cell
    radiance   mean radiance of each pixel of the map
    cell       the pixel's cell
    """

    direction: Float[np.ndarray, "d v 3"]
    energy: Float[np.ndarray, "d v 3"]
    angle: Float[np.ndarray, " d"]
    radiance: Float[np.ndarray, "h w 3"]
    cell: Int[np.ndarray, "h w"]


def sky(lights: Sequence[Light], directions: int = 128) -> Sky | None:
    """The soft light among `lights`, in `directions` cells; None without any."""
    soft = [light for light in lights if isinstance(light, SOFT)]
    if not soft:
        return None
    radiance, angle = _map(soft)
    rows = len(radiance)
    bright = (radiance @ REC709) * angle
    share = angle / (4 * np.pi)
    if bright.sum() > 0:
        share = 0.5 * share + 0.5 * bright / bright.sum()
    cell, part, times = _partition(share, directions)
    flat = (cell * VARIANTS + part).ravel()

    def total(values: np.ndarray) -> np.ndarray:
        return np.bincount(flat, values.ravel(), minlength=(cell.max() + 1) * VARIANTS).reshape(-1, VARIANTS)

    energy = np.stack([total(radiance[..., c] * angle) for c in range(3)], axis=-1)
    # A black part still needs a direction, so its solid angle is its weight.
    pull = bright + angle * max(bright.sum(), 1e-20) * 1e-9
    centre = np.stack([total(_directions(rows)[..., c] * pull) for c in range(3)], axis=-1)
    first = np.arange(VARIANTS) // times * times
    energy, centre = (np.take_along_axis(a, first[..., None], axis=1) for a in (energy, centre))
    energy *= (VARIANTS / times)[..., None]
    # Shuffled, so that the parts that one sample sees do not share a side of their cells.
    order = np.random.default_rng(0).permuted(np.tile(np.arange(VARIANTS), (len(energy), 1)), axis=1)[..., None]
    energy, centre = (np.take_along_axis(a, order, axis=1) for a in (energy, centre))
    centre /= np.linalg.norm(centre, axis=-1, keepdims=True)
    solid = total(angle).sum(axis=1)
    return Sky(centre.astype(np.float32), energy.astype(np.float32), solid.astype(np.float32), radiance, cell)


@dataclass(frozen=True)
class EnvironmentCells:
    """Soft light binned into cells of the sphere, one directional light each.

    direction  unit, from the surface towards the light's centroid in the cell
    irradiance ∫ radiance dω over it, linear Rec.709
    width2     mean squared angle between the cell's light and that direction, along one axis
    """

    direction: Float[np.ndarray, "k 3"]
    irradiance: Float[np.ndarray, "k 3"]
    width2: Float[np.ndarray, " k"]


def even_directions(count: int) -> Float[np.ndarray, "k 3"]:
    """Unit vectors spread evenly over the sphere (a Fibonacci spiral)."""
    k = np.arange(count) + 0.5
    y, phi = 1 - 2 * k / count, np.pi * (1 + 5**0.5) * k
    side = np.sqrt(1 - y**2)
    return np.stack([side * np.sin(phi), y, side * np.cos(phi)], axis=1).astype(np.float32)


def bin_environment(lights: Sequence[Light], middles: Float[np.ndarray, "k 3"]) -> EnvironmentCells:
    """The soft light among `lights`; each direction's light is added to the nearest of `middles`."""
    radiance, angle = _map([light for light in lights if isinstance(light, SOFT)])
    rows = len(radiance)
    towards = _directions(rows).reshape(-1, 3)
    cell = np.concatenate([(part @ middles.T).argmax(axis=1) for part in np.array_split(towards, max(rows // 16, 1))])
    flux = (radiance * angle[..., None]).reshape(-1, 3)
    bright = flux @ REC709 + angle.ravel() * max(float((flux @ REC709).sum()), 1e-20) * 1e-9

    def total(values: np.ndarray) -> np.ndarray:
        return np.bincount(cell, values, minlength=len(middles))

    weight = np.maximum(total(bright), 1e-30)
    centre = np.stack([total(towards[:, c] * bright) for c in range(3)], axis=1) / weight[:, None]
    length = np.linalg.norm(centre, axis=1)
    return EnvironmentCells(
        (centre / np.maximum(length, 1e-9)[:, None]).astype(np.float32),
        np.stack([total(flux[:, c]) for c in range(3)], axis=1).astype(np.float32),
        np.clip(1 - length, 0, 1).astype(np.float32),
    )


def _map(soft: Sequence[Light]) -> tuple[Float[np.ndarray, "h w 3"], Float[np.ndarray, "h w"]]:
    """Mean radiance of every pixel of a latitude-longitude map, and its solid angle."""
    finest = max((len(light.radiance) for light in soft if isinstance(light, Environment)), default=LEAST_ROWS)
    rows = int(np.clip(finest, LEAST_ROWS, MOST_ROWS))
    fine = -(-finest // rows)
    radiance = soft_radiance(soft, _directions(rows * fine))
    edges = np.cos(np.arange(rows + 1) / rows * np.pi)
    angle = np.repeat(((edges[:-1] - edges[1:]) * np.pi / rows)[:, None], 2 * rows, axis=1)
    return radiance.reshape(rows, fine, 2 * rows, fine, 3).mean(axis=(1, 3)), angle


def _partition(share: Float[np.ndarray, "h w"], count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Cell and part of every pixel, and per cell how many variants share a part (1 unless the cell is tiny).

    Parts are numbered 0, times, 2 · times, …, `times` being a power of two.
    """
    boxes = _cut(share, count, 0, len(share))
    cell, part = np.zeros(share.shape, np.int32), np.zeros(share.shape, np.int32)
    times = np.ones((len(boxes), 1), np.int64)
    for k, (top, bottom, left, right) in enumerate(boxes):
        cell[top:bottom, left:right] = k
        inside = share[top:bottom, left:right]
        number = VARIANTS
        while len(parts := _cut(inside, number, top, len(share))) < number:
            number //= 2
        times[k] = VARIANTS // number
        for j, (t, b, l, r) in enumerate(parts):  # noqa: E741
            part[top + t : top + b, left + l : left + r] = j * times[k]
    return cell, part, times


def _directions(rows: int) -> Float[np.ndarray, "h w 3"]:
    theta, phi = (np.arange(rows) + 0.5) / rows * np.pi, (np.arange(2 * rows) + 0.5) / rows * np.pi
    sin, cos = np.sin(theta)[:, None], np.cos(theta)[:, None]
    return np.stack([np.sin(phi) * sin, np.broadcast_to(cos, (rows, 2 * rows)), -np.cos(phi) * sin], axis=-1)


def _cut(share: Float[np.ndarray, "h w"], count: int, start: int, whole: int) -> list[tuple[int, int, int, int]]:
    """Up to `count` boxes (top, bottom, left, right): the heaviest is repeatedly halved along its longer side.

    `share` begins at row `start` of a map of `whole` rows; the row determines a pixel's width.
    """
    rows, columns = share.shape
    table = np.zeros((rows + 1, columns + 1))
    table[1:, 1:] = share.cumsum(axis=0).cumsum(axis=1)

    def mass(top, bottom, left, right):
        return table[bottom, right] - table[top, right] - table[bottom, left] + table[top, left]

    def halves(top, bottom, left, right):
        narrow = np.sin((start + (top + bottom) / 2) / whole * np.pi)
        if bottom - top > 1 and (right - left == 1 or (bottom - top) >= (right - left) * narrow):
            marginal = table[top : bottom + 1, right] - table[top : bottom + 1, left]
            at = top + _middle(marginal)
            return (top, at, left, right), (at, bottom, left, right)
        marginal = table[bottom, left : right + 1] - table[top, left : right + 1]
        at = left + _middle(marginal)
        return (top, bottom, left, at), (top, bottom, at, right)

    waiting, done = [(-mass(0, rows, 0, columns), (0, rows, 0, columns))], []
    while waiting and len(waiting) + len(done) < count:
        _, box = heapq.heappop(waiting)
        if (box[1] - box[0]) * (box[3] - box[2]) == 1:
            done.append(box)
            continue
        for half in halves(*box):
            heapq.heappush(waiting, (-mass(*half), half))
    return sorted(done + [box for _, box in waiting])


def _middle(cumulative: np.ndarray) -> int:
    """The position that cuts a box into two halves of equal mass, neither empty."""
    half = (cumulative[0] + cumulative[-1]) / 2
    return int(np.clip(np.abs(cumulative - half).argmin(), 1, len(cumulative) - 2))
