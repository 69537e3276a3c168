"""Fused Dr.Jit kernels of the synthesis: neighbour tables, patch descriptors, votes, search, look-ups.

Every function takes the array module to run on as its first argument: `drjit.llvm` (CPU) or `drjit.cuda`. A thread
reads only the previous kernel's values and writes only its own sample, so results do not depend on thread order.
"""

from collections.abc import Callable
from dataclasses import dataclass
from types import ModuleType
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from mistyle.core.drjit_arrays import aligned
from mistyle.render.mitsuba import device
from mistyle.render.mitsuba.device import dr

TURNED = np.uint32(1 << 31)  # bit of a table entry whose neighbour's picture is turned by 180 degrees
PAGES = 4  # quarter turns of the picture
WIDTH = 24  # floats per style pixel: 16 patch components, 3 colour, 2 orientation, 1 band, 2 unused by pixels
PATCH = 16
LINEAR = 21  # number of components in the squared distance with weight one; the band has this index
CLOSED = 22  # index of a sample's share of the coherence price, 0..1
BORDER = 2  # half a patch: centres keep this far from a page's edge
SIGMA = 1.6  # of the vote's Gaussian, in samples
FOLLOW = (7, 11, 13, 17, 2, 10, 14, 22)  # table entries at distance 1 and 2 along the axes, used by the coherent search
BESIDE = (7, 11, 13, 17)  # table entries of the four nearest neighbours
SEEN = 8  # leading patch components that measure a seam's visibility
HIDDEN_SEAM = 0.3  # share of the coherence price at an invisible seam
STAY = 0.1  # price of extending a piece of the largest size: exceeds any difference between places
PROBES = np.array(
    [(1, 0), (-1, 0), (0, 1), (0, -1), (1, 1), (-1, 1), (1, -1), (-1, -1), (0, 3), (0, -3), (3, 0), (-3, 0)], np.float32
)


@dataclass(frozen=True)
class Tables:
    """A level's neighbourhoods on the device: index (with the TURNED bit), offsets (x, y) and voting weight."""

    count: int
    neighbour: Any
    offset: Any
    weight: Any


@dataclass(frozen=True)
class ExemplarArrays:
    """The exemplar on the device: sizes and first pixels of its four pages; per pixel colour, descriptor and pixel of
    the unturned picture."""

    height: Any
    width: Any
    start: Any
    colour: Any
    descriptor: Any
    origin: Any


@dataclass(frozen=True)
class FieldArrays:
    """The nearest-neighbour field on the device: page, column and row in pixels (index coordinates) of each sample."""

    page: Any
    x: Any
    y: Any


@dataclass(frozen=True)
class TargetDescriptors:
    """Per sample the target descriptor (as wide as a style pixel's), and the weight of its band."""

    descriptor: Any
    band_weight: Any


@dataclass(frozen=True)
class PatchSizeLimit:
    """1 for samples whose piece neighbours may not extend, else 0; and the radius (pixels) of this limit."""

    sample: Any
    around: Any


@dataclass(frozen=True)
class Prices:
    """Costs of a place besides its descriptor.

    weights  flat: coherence, variety, one over the squared patch difference of a fully visible seam
    use      use of each pixel of the unturned picture (1 = its target)
    limit    pieces of the largest size
    """

    weights: Any
    use: Any
    limit: PatchSizeLimit | None = None


def module(name: str = "") -> ModuleType:
    """Dr.Jit's array module "llvm", "cuda" or "metal"; by default that of the Mitsuba variant in use."""
    import importlib

    return importlib.import_module(f"drjit.{name or device.use().split('_')[0]}")


def floats(dj: ModuleType, values: np.ndarray) -> Any:
    """A flat device array of float32."""
    return dj.Float(aligned(values).reshape(-1))


def whole(dj: ModuleType, values: np.ndarray) -> Any:
    """A flat device array of uint32."""
    return dj.UInt(aligned(values, np.uint32).reshape(-1))


def tables(
    dj: ModuleType,
    neighbours: Int[np.ndarray, "n 25"],
    turned: Bool[np.ndarray, "n 25"],
    offsets: Float[np.ndarray, "n 25 2"],
) -> Tables:
    """Copy neighbourhoods to the device."""
    index = neighbours.astype(np.uint32) | np.where(turned, TURNED, np.uint32(0))
    weight = np.exp(-(offsets**2).sum(axis=2) / np.float32(2 * SIGMA**2))
    return Tables(len(neighbours), whole(dj, index), floats(dj, offsets), floats(dj, weight))


@dataclass(frozen=True)
class Frames:
    """Samples on the device, flat (n 3): positions, normals, tangents, and `across` them; `spacing` is h."""

    position: Any
    normal: Any
    tangent: Any
    across: Any
    spacing: float


def choose_neighbours(dj: ModuleType, frame: Frames, near: Int[np.ndarray, "n k"]) -> Int[np.ndarray, "n 25"]:
    """For every grid position (row by row, x fastest) the nearest sample of `near`.

    Nearest means smallest |p_j - p_i - h (dx t + dy s)|^2 + (3 h)^2 |n_j - n_i|^2; the first of equals is taken.
    """
    count, reach = near.shape
    candidates = whole(dj, near)
    i = dr.arange(dj.UInt, count)
    own_p, own_n = dr.gather(dj.Array3f, frame.position, i), dr.gather(dj.Array3f, frame.normal, i)
    # Opaque: a literal would compile one kernel for every mesh.
    scale = dr.opaque(dj.Float, 1 / frame.spacing)
    x_axis = dr.gather(dj.Array3f, frame.tangent, i) * scale
    y_axis = dr.gather(dj.Array3f, frame.across, i) * scale
    grid = [(dx, dy) for dy in range(-2, 3) for dx in range(-2, 3)]

    def body(k: Any, *state: Any) -> tuple[Any, ...]:
        best, which = state[:25], state[25:]
        j = dr.gather(dj.UInt, candidates, i * reach + k)
        step = dr.gather(dj.Array3f, frame.position, j) - own_p
        u, v = dr.dot(step, x_axis), dr.dot(step, y_axis)
        turn = dr.squared_norm(dr.gather(dj.Array3f, frame.normal, j) - own_n)
        # |step|^2 - u^2 - v^2 is the squared height over the tangent plane.
        rest = dr.squared_norm(step * scale) - u * u - v * v + 9 * turn
        new_best, new_which = [], []
        for slot, (dx, dy) in enumerate(grid):
            distance = rest + dr.square(u - dx) + dr.square(v - dy)
            closer = distance < best[slot]
            new_best.append(dr.select(closer, distance, best[slot]))
            new_which.append(dr.select(closer, j, which[slot]))
        return (k + 1, *new_best, *new_which)

    start = (dj.UInt(0), *[dr.full(dj.Float, np.inf, count)] * 25, *[i] * 25)
    state = dr.while_loop(start, lambda k, *rest: k < reach, body)
    chosen = dr.empty(dj.UInt, count * 25)
    for slot in range(25):
        dr.scatter(chosen, state[26 + slot], i * 25 + slot)
    result = chosen.numpy().reshape(count, 25).astype(np.int32)
    result[:, 12] = np.arange(count)
    return result


def offsets(
    dj: ModuleType, frame: Frames, neighbours: Int[np.ndarray, "n 25"]
) -> tuple[Bool[np.ndarray, "n 25"], Float[np.ndarray, "n 25 2"]]:
    """For every table entry: whether the neighbour's tangent is opposite, and the sample's position (x, y) in the
    neighbour's frame, in spacings, clamped to +-4."""
    entry = dr.arange(dj.UInt, neighbours.size)
    i, j = entry // 25, whole(dj, neighbours)
    step = dr.gather(dj.Array3f, frame.position, i) - dr.gather(dj.Array3f, frame.position, j)
    step *= dr.opaque(dj.Float, 1 / frame.spacing)
    along = dr.gather(dj.Array3f, frame.tangent, j)
    turned: Any = dr.dot(dr.gather(dj.Array3f, frame.tangent, i), along) < 0
    x, y = dr.dot(step, along), dr.dot(step, dr.gather(dj.Array3f, frame.across, j))
    place: Any = dr.ravel(dj.Array2f(dr.clip(x, -4, 4), dr.clip(y, -4, 4)))
    return turned.numpy().reshape(neighbours.shape), place.numpy().reshape(*neighbours.shape, 2)


def describe(dj: ModuleType, table: Tables, colour: Any, basis: Any, mean: Any) -> Any:
    """Patch components of every sample: (colours of its 25 neighbours - mean) . basis; flat (n 16).

    `colour` flat (n 3); `basis` flat (25 3 16) and `mean` flat (25 3): grid position, channel, component.
    """
    i = dr.arange(dj.UInt, table.count)
    return _components(
        dj, table.count, lambda k: dr.gather(dj.UInt, table.neighbour, i * 25 + k) & ~TURNED, colour, basis, mean
    )


def describe_pixels(dj: ModuleType, colour: Any, shapes: Int[np.ndarray, "4 2"], basis: Any, mean: Any) -> Any:
    """Patch components of every pixel of the four pages (height x width in `shapes`); invalid at a page's border."""
    area = int(shapes[0].prod())
    count = PAGES * area
    i = dr.arange(dj.Int, count)
    width = dr.gather(dj.Int, dj.Int(aligned(shapes[:, 1], np.int32)), i // dr.opaque(dj.Int, area))
    last = dr.opaque(dj.Int, count - 1)

    def pixel(k: Any) -> Any:
        return dj.UInt(dr.clip(i + (dj.Int(k) // 5 - 2) * width + dj.Int(k) % 5 - 2, 0, last))

    return _components(dj, count, pixel, colour, basis, mean)


def _components(dj: ModuleType, count: int, member: Callable[[Any], Any], colour: Any, basis: Any, mean: Any) -> Any:
    """Sum over grid positions k and channels of (colour[member(k)] - mean[k]) basis[k], flat (count 16)."""

    def body(k: Any, *parts: Any) -> tuple[Any, ...]:
        c = dr.gather(dj.Array3f, colour, member(k)) - dr.gather(dj.Array3f, mean, k)
        out = list(parts)
        for channel in range(3):
            for component in range(PATCH):
                weight = dr.gather(dj.Float, basis, (k * 3 + channel) * PATCH + component)
                out[component] = dr.fma(c[channel], weight, out[component])
        return (k + 1, *out)

    zero = dr.zeros(dj.Float, count)
    state = dr.while_loop((dj.UInt(0), *[zero] * PATCH), lambda k, *parts: k < 25, body)
    result = dr.empty(dj.Float, count * PATCH)
    i = dr.arange(dj.UInt, count)
    for component in range(PATCH):
        dr.scatter(result, state[1 + component], i * PATCH + component)
    dr.eval(result)
    return result


def vote(dj: ModuleType, table: Tables, exemplar: ExemplarArrays, field: FieldArrays) -> Any:
    """The colour of every sample, flat (n 3): the weighted mean of its 25 neighbours' patches at its position."""
    i = dr.arange(dj.UInt, table.count)

    def body(k: Any, total: Any, weights: Any) -> tuple[Any, ...]:
        slot = i * 25 + k
        j = dr.gather(dj.UInt, table.neighbour, slot) & ~TURNED
        page = dr.gather(dj.UInt, field.page, j)
        step = dr.gather(dj.Array2f, table.offset, slot)
        height, width = dr.gather(dj.Float, exemplar.height, page), dr.gather(dj.Float, exemplar.width, page)
        x = dr.clip(dr.gather(dj.Float, field.x, j) + step[0], 0, width - 1.001)
        y = dr.clip(dr.gather(dj.Float, field.y, j) + step[1], 0, height - 1.001)
        left, top = dr.floor(x), dr.floor(y)
        right, down = x - left, y - top
        row = dj.UInt(width)
        pixel = dr.gather(dj.UInt, exemplar.start, page) + dj.UInt(top) * row + dj.UInt(left)

        def colour(index: Any) -> Any:
            return dr.gather(dj.Array3f, exemplar.colour, index)

        upper = dr.lerp(colour(pixel), colour(pixel + 1), right)
        lower = dr.lerp(colour(pixel + row), colour(pixel + row + 1), right)
        weight = dr.gather(dj.Float, table.weight, slot)
        return k + 1, total + dr.lerp(upper, lower, down) * weight, weights + weight

    start = (dj.UInt(0), dj.Array3f(0), dr.zeros(dj.Float, table.count))
    _, total, weights = dr.while_loop(start, lambda k, *rest: k < 25, body)
    result = dr.ravel(total / weights)
    dr.eval(result)
    return result


def continued(
    dj: ModuleType, table: Tables, exemplar: ExemplarArrays, field: FieldArrays, slot: Any
) -> tuple[Any, Any, Any]:
    """A sample's place (page, x, y) if it continues the picture of its neighbour in table entry `slot`."""
    entry = dr.gather(dj.UInt, table.neighbour, slot)
    j, turned = entry & ~TURNED, entry >= TURNED
    step = dr.gather(dj.Array2f, table.offset, slot)
    page = dr.gather(dj.UInt, field.page, j)
    x, y = dr.gather(dj.Float, field.x, j) + step[0], dr.gather(dj.Float, field.y, j) + step[1]
    x = dr.select(turned, dr.gather(dj.Float, exemplar.width, page) - 1 - x, x)
    y = dr.select(turned, dr.gather(dj.Float, exemplar.height, page) - 1 - y, y)
    return dr.select(turned, (page + 2) % PAGES, page), x, y


def search(
    dj: ModuleType,
    table: Tables,
    exemplar: ExemplarArrays,
    field: FieldArrays,
    targets: TargetDescriptors,
    prices: Prices,
    also: FieldArrays | None = None,
) -> tuple[Any, FieldArrays]:
    """One round: every sample takes the best of its own place, its neighbours' continued places, and fixed offsets.

    `also` is one more candidate per sample (from `exhaustive`). Returns costs and places.
    """
    i = dr.arange(dj.UInt, table.count)
    cost = _cost(dj, table, exemplar, field, targets, prices)
    own, other = ((f.page, f.x, f.y) for f in (field, field if also is None else also))
    slots, probes = whole(dj, np.array(FOLLOW)), floats(dj, PROBES)
    follow, probe, last = np.cumsum([2, len(FOLLOW), len(PROBES)]).tolist()

    def choose(take: Any, new: tuple[Any, ...], old: tuple[Any, ...]) -> tuple[Any, ...]:
        return tuple(dr.select(take, a, b) for a, b in zip(new, old, strict=True))

    # One loop over all candidates, so that Dr.Jit traces and LLVM compiles the cost once.
    def body(k: Any, *best: Any) -> tuple[Any, ...]:
        slot = dr.gather(dj.UInt, slots, k - follow, (k >= follow) & (k < probe))
        step = dr.gather(dj.Array2f, probes, k - probe, k >= probe)
        beside = continued(dj, table, exemplar, field, i * 25 + slot)
        place = choose(k < probe, beside, (best[1], best[2] + step[0], best[3] + step[1]))
        page, x, y = choose(k < 1, own, choose(k < follow, other, place))
        x, y = _inside(dj, exemplar, page, x, y)
        price = cost(page, x, y)
        return (k + 1, *choose(price < best[0], (price, page, x, y), best))

    start = (dj.UInt(0), dr.full(dj.Float, np.inf, table.count), *own)
    _, price, page, x, y = dr.while_loop(start, lambda k, *best: k < last, body)
    dr.eval(price, page, x, y)
    return price, FieldArrays(page, x, y)


def _cost(
    dj: ModuleType,
    table: Tables,
    exemplar: ExemplarArrays,
    field: FieldArrays,
    targets: TargetDescriptors,
    prices: Prices,
) -> Callable[[Any, Any, Any], Any]:
    """The cost of a place (page, x, y), for all samples, with neighbours' places from `field`."""
    i = dr.arange(dj.UInt, table.count)
    target = _descriptor(dj, targets.descriptor, i, WIDTH)
    band_weight = dr.gather(dj.Float, targets.band_weight, i)
    coherence = dr.gather(dj.Float, prices.weights, dj.UInt(0)) * target[CLOSED // 4][CLOSED % 4]
    variety, seam = (dr.gather(dj.Float, prices.weights, dj.UInt(k)) for k in (1, 2))
    limit, closed, around = prices.limit, [], None
    if limit is not None:
        members = [dr.gather(dj.UInt, table.neighbour, i * 25 + slot) & ~TURNED for slot in BESIDE]
        closed = [dr.gather(dj.Float, limit.sample, j) for j in members]
        around = dr.square(dr.gather(dj.Float, limit.around, dj.UInt(0)))
    beside = [continued(dj, table, exemplar, field, i * 25 + slot) for slot in BESIDE]
    shown = [
        _descriptor(dj, exemplar.descriptor, _pixel_at(dj, exemplar, page, *_inside(dj, exemplar, page, u, v)), SEEN)
        for page, u, v in beside
    ]

    def cost(page: Any, x: Any, y: Any) -> Any:
        pixel = _pixel_at(dj, exemplar, page, x, y)
        total = variety * dr.gather(dj.Float, prices.use, dr.gather(dj.UInt, exemplar.origin, pixel))
        own = _descriptor(dj, exemplar.descriptor, pixel, SEEN)
        for k in range(WIDTH // 4):
            entries = own[k] if k < len(own) else dr.gather(dj.Array4f, exemplar.descriptor, pixel * (WIDTH // 4) + k)
            gap = target[k] - entries
            if k < LINEAR // 4:
                total += dr.squared_norm(gap)
            else:
                total += dr.square(gap[0]) + band_weight * dr.square(gap[1])
        for k, (neighbour_page, u, v) in enumerate(beside):
            away = dr.square(u - x) + dr.square(v - y)
            apart = sum((dr.squared_norm(a - b) for a, b in zip(own, shown[k], strict=True)), start=dj.Float(0))
            visible = HIDDEN_SEAM + (1 - HIDDEN_SEAM) * dr.minimum(apart * seam, 1)
            price = coherence * visible * dr.select(neighbour_page == page, dr.minimum(away, 4) / 4, 1)
            if around is not None:
                near = dr.select(neighbour_page == page, dr.maximum(1 - away / around, 0), 0)
                price = dr.select(closed[k] > 0, STAY * near, price)
            total += price
        return total

    return cost


def _inside(dj: ModuleType, exemplar: ExemplarArrays, page: Any, x: Any, y: Any) -> tuple[Any, Any]:
    """A place clamped so that its patch lies on the page."""
    width, height = dr.gather(dj.Float, exemplar.width, page), dr.gather(dj.Float, exemplar.height, page)
    return dr.clip(x, BORDER, width - 1 - BORDER), dr.clip(y, BORDER, height - 1 - BORDER)


def _pixel_at(dj: ModuleType, exemplar: ExemplarArrays, page: Any, x: Any, y: Any) -> Any:
    """The flat index of the pixel nearest to a place."""
    row = dj.UInt(dr.gather(dj.Float, exemplar.width, page))
    return dr.gather(dj.UInt, exemplar.start, page) + dj.UInt(dr.round(y)) * row + dj.UInt(dr.round(x))


def _descriptor(dj: ModuleType, values: Any, index: Any, width: int) -> list[Any]:
    """The first `width` entries of a descriptor, in groups of four."""
    return [dr.gather(dj.Array4f, values, index * (WIDTH // 4) + k) for k in range(width // 4)]
