"""Texel table of the fit: all texture sets at the views' resolution, optimised by Adam.

An atlas is usually finer than the views: several texels fall into one pixel, and fitting them one by one gives noise.
The fit therefore optimises a coarser mip level, about one texel per pixel. Its change is interpolated and added to the
input maps, whose finer detail stays.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from mistyle.atlas.texels import bands, beside
from mistyle.core.image import gaussian, nearest, resized_rows
from mistyle.core.maps import Maps, Texels, rows_of
from mistyle.process import memory

CHANNELS = {"tilt": 2, "roughness": 1, "albedo": 3, "metallic": 1}
TILT_LIMIT = 0.95  # a normal tilted by more than 72 degrees faces away from most views, where its gradient is zero
ROUGHNESS_FLOOR = 0.05  # below 0.0316 Mitsuba's roughness has no gradient
BETA1, BETA2, EPSILON = 0.9, 0.99, 1e-8  # with 0.999 texels that few views see keep stale second moments
# Share of a map's RMS gradient that damps Adam's steps. Plain Adam moves texels with a tenth of the gradient as fast as
# others, so blank parts of a picture, where the gradient is noise, drift.
DAMPING = 0.3
SMOOTH = 0.7  # texels of the table; finer changes are noise of single steps
FILL = 6  # texels of the table by which a change extends beyond the seen texels


@dataclass
class FitTable:
    """All texels (t) of all texture sets at the fit's resolution, row by row, set after set; mutable.

    tilt is the tangent-space normal's x and y. `start` holds the values before the fit, `plain` those of an unpainted
    surface. `right` and `below`: whether a texel's neighbour in the same set belongs to the same UV island. `still`
    texels do not move. `steps` counts Adam's steps per texel. `place` is -1 everywhere, scratch of `pairs`.
    """

    sizes: tuple[tuple[int, int], ...]
    values: dict[str, Float[np.ndarray, "t c"]]
    start: dict[str, Float[np.ndarray, "t c"]]
    plain: dict[str, Float[np.ndarray, "t c"]]
    right: Bool[np.ndarray, " t"]
    below: Bool[np.ndarray, " t"]
    columns: Int[np.ndarray, " t"]
    still: Bool[np.ndarray, " t"]
    place: Int[np.ndarray, " t"]
    first: dict[str, Float[np.ndarray, "t c"]] = field(default_factory=dict)
    second: dict[str, Float[np.ndarray, "t c"]] = field(default_factory=dict)
    steps: dict[str, Int[np.ndarray, " t"]] = field(default_factory=dict)
    squares: dict[str, tuple[float, int]] = field(default_factory=dict)

    @property
    def parts(self) -> list[slice]:
        """The rows of each set."""
        return rows_of(self.sizes)


def build(
    maps: Sequence[Maps],
    texels: Sequence[Texels],
    shrink: int,
    only: Sequence[Bool[np.ndarray, "h w"]] | None = None,
) -> FitTable:
    """A table of `maps` shrunk by the factor `shrink`: means over covered texels; uncovered ones take the nearest.

    With `only`, cells without a texel of these masks do not move.
    """
    sizes, rows = [], []
    right, below, columns, still = [], [], [], []
    for k, (material, where) in enumerate(zip(maps, texels, strict=True)):
        height, width = where.covered.shape
        by = shrink if height % shrink == 0 and width % shrink == 0 else 1
        island = where.island.reshape(height // by, by, width // by, by).max(axis=(1, 3))
        rows.append({name: _shrink(material, name, where.covered, by).reshape(-1, n) for name, n in CHANNELS.items()})
        same = np.zeros((2, *island.shape), bool)
        same[0, :, :-1], same[1, :-1] = beside(island)
        right.append(same[0].ravel())
        below.append(same[1].ravel())
        sizes.append(island.shape)
        free = only[k] if only is not None else np.ones_like(where.covered)
        still.append(~free.reshape(height // by, by, width // by, by).any(axis=(1, 3)).ravel())
        columns.append(np.full(island.size, island.shape[1], np.int64))
    values = {name: np.concatenate([r[name] for r in rows]) for name in CHANNELS}
    values = {name: project(name, table) for name, table in values.items()}
    start = {name: table.copy() for name, table in values.items()}
    return FitTable(
        tuple(sizes),
        values,
        start,
        start,
        np.concatenate(right),
        np.concatenate(below),
        np.concatenate(columns),
        np.concatenate(still),
        np.full(len(start["albedo"]), -1, np.int64),
    )


def project(name: str, values: Float[np.ndarray, "*t c"]) -> Float[np.ndarray, "*t c"]:
    """The nearest allowed values: tilt in the disk of TILT_LIMIT, roughness from ROUGHNESS_FLOOR to 1, else 0..1."""
    if name == "tilt":
        length = np.sqrt(values[..., :1] ** 2 + values[..., 1:] ** 2)
        return (values * np.minimum(1, TILT_LIMIT / np.maximum(length, 1e-6))).astype(np.float32)
    return np.clip(values, ROUGHNESS_FLOOR if name == "roughness" else 0, 1)


def step(
    table: FitTable, name: str, texels: Int[np.ndarray, " n"], gradient: Float[np.ndarray, "n c"], rate: float
) -> None:
    """One step of Adam for `texels`; those of zero gradient keep their values and moments (`mask_updates`).

    The step is rate · m / (sqrt(v) + DAMPING · root mean square of all gradients of this map so far).
    """
    import torch

    if name not in table.first:
        shape = table.values[name].shape
        table.first[name], table.second[name] = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
        table.steps[name] = np.zeros(shape[0], np.int32)
    moving = np.flatnonzero(nonzero(gradient) & ~table.still[texels])
    # torch computes these sums in place and on all cores.
    slope = torch.from_numpy(np.ascontiguousarray(gradient)).index_select(0, torch.from_numpy(moving))
    rows, count = texels[moving], slope.numel()
    before = table.squares.get(name, (0.0, 0))
    total, count = before[0] + float(torch.sum(slope * slope, dtype=torch.float64)), before[1] + count
    table.squares[name] = total, count
    typical = DAMPING * np.sqrt(total / max(count, 1)) + EPSILON
    at, age = torch.from_numpy(rows), table.steps[name][rows] + 1
    table.steps[name][rows] = age
    first, second, values = (torch.from_numpy(part[name]) for part in (table.first, table.second, table.values))
    m = first.index_select(0, at).mul_(BETA1).add_(slope, alpha=1 - BETA1)
    v = second.index_select(0, at).mul_(BETA2).addcmul_(slope, slope, value=1 - BETA2)
    first.index_copy_(0, at, m)
    second.index_copy_(0, at, v)
    unbiased = [torch.from_numpy(_unbiased(beta, age)) for beta in (BETA1, BETA2)]
    moved = m.mul_(unbiased[0]).div_(v.mul_(unbiased[1]).sqrt_().add_(typical)).mul_(-rate)
    moved.add_(values.index_select(0, at))
    values.index_copy_(0, at, torch.from_numpy(project(name, moved.numpy())))


def _unbiased(beta: float, age: Int[np.ndarray, " n"]) -> Float[np.ndarray, "n 1"]:
    """1 / (1 - beta^age): bias correction of a moving average of `age` values that starts at zero."""
    powers = beta ** np.arange(int(age.max(initial=1)) + 1)
    powers[0] = 0
    return (1 / (1 - powers)).astype(np.float32)[age][:, None]


def nonzero(gradient: Float[np.ndarray, "n c"]) -> Bool[np.ndarray, " n"]:
    """Rows that are not all zero; written out because reductions along a short axis are slow."""
    result = gradient[:, 0] != 0
    for channel in range(1, gradient.shape[1]):
        result |= gradient[:, channel] != 0
    return result


@dataclass(frozen=True)
class Pairs:
    """Neighbours among n texels of a step, per direction (right, below).

    `next` and `previous` index each texel's neighbours among the n texels, or the texel itself if it has none in the
    same island; `count` is the number of pairs.
    """

    texels: Int[np.ndarray, " n"]
    next: tuple[Int[np.ndarray, " n"], ...]
    previous: tuple[Int[np.ndarray, " n"], ...]
    count: tuple[int, ...]


def pairs(table: FitTable, texels: Int[np.ndarray, " n"]) -> Pairs:
    """The pairs of `texels` (sorted) that are neighbours in the same island."""
    own = np.arange(len(texels))
    table.place[texels] = own
    following, preceding, count = [], [], []
    for joined, stride in ((table.right, None), (table.below, table.columns)):
        first = np.flatnonzero(joined[texels])
        at = texels[first]
        second = table.place[at + (1 if stride is None else stride[at])]
        first, second = first[second >= 0], second[second >= 0]
        ahead, behind = own.copy(), own.copy()
        ahead[first], behind[second] = second, first
        following.append(ahead)
        preceding.append(behind)
        count.append(len(first))
    table.place[texels] = -1
    return Pairs(texels, tuple(following), tuple(preceding), tuple(count))


def variation(table: FitTable, name: str, near: Pairs) -> tuple[float, Float[np.ndarray, "n c"]]:
    """Total variation among the texels of `near` and its gradient: means of |difference| to the right and below.

    For the albedo its values (the paper's L_TV(A)); for other maps the fit's change, or an asset's own normal map would
    be flattened. Only neighbours in the same island count. Written out, since torch's gradient of an indexed read sums
    in any order.
    """
    import torch

    at = torch.from_numpy(near.texels)
    values = torch.from_numpy(table.values[name]).index_select(0, at)
    if name != "albedo":
        values -= torch.from_numpy(table.start[name]).index_select(0, at)
    gradient, total = torch.zeros_like(values), 0.0
    for ahead, behind, count in zip(near.next, near.previous, near.count, strict=True):
        if count == 0:
            continue
        size = count * values.shape[1]
        onward = values.index_select(0, torch.from_numpy(ahead)).sub_(values)
        total += float(onward.abs().sum(dtype=torch.float64)) / size
        backward = values.index_select(0, torch.from_numpy(behind)).sub_(values)
        gradient.sub_(onward.sign_().add_(backward.sign_()), alpha=1 / size)
    return total, gradient.numpy()


def finished(
    table: FitTable, maps: Sequence[Maps], only: Sequence[Bool[np.ndarray, "h w"]] | None = None
) -> list[Maps]:
    """The input maps plus the fit's change, at their own resolution (inside `only`)."""
    result = []
    for k, material in enumerate(maps):
        fields = {}
        for name in CHANNELS:
            change = _change(table, k, name)
            if change is not None:
                own = "normal" if name == "tilt" else name
                fields[own] = _laid(getattr(material, own), name, change, None if only is None else only[k])
        result.append(replace(material, **fields))
    return result


def _laid(
    values: Float[np.ndarray, "h w *c"],
    name: str,
    change: Float[np.ndarray, "H W c"],
    mask: Bool[np.ndarray, "h w"] | None,
) -> Float[np.ndarray, "h w *c"]:
    """A map plus an upsampled change (inside the mask)."""
    result, shape = memory.empty(values.shape), (values.shape[0], values.shape[1])
    for rows in bands(*shape):
        before = values[rows]
        after = _apply(before, name, resized_rows(change, shape, rows, "repeat"))
        result[rows] = after
        if mask is not None:
            outside = ~mask[rows]
            result[rows][outside] = before[outside]
    return result


def spread(table: FitTable, maps: Sequence[Maps], values: Float[np.ndarray, " t"]) -> list[Float[np.ndarray, "h w"]]:
    """Values per texel of the table at the maps' resolution (each texel takes its cell's value)."""
    result = []
    for k, (material, part) in enumerate(zip(maps, table.parts, strict=True)):
        rows, columns = material.roughness.shape
        cells = values[part].reshape(table.sizes[k]).astype(np.float32)
        by, enlarged = rows // table.sizes[k][0], memory.empty((rows, columns))
        enlarged.reshape(rows // by, by, columns // by, by)[...] = cells[:, None, :, None]
        result.append(enlarged)
    return result


def _change(table: FitTable, k: int, name: str) -> Float[np.ndarray, "H W c"] | None:
    """The fit's change of a map, at the table's resolution; None if unchanged."""
    part, size = table.parts[k], table.sizes[k]
    change = (table.values[name][part] - table.start[name][part]).reshape(*size, -1)
    change = np.where(np.isfinite(change), change, 0)  # a texel that is non-finite in the input stays unchanged
    moved = change.any(axis=-1)
    if not moved.any():
        return None
    index, distance = nearest(np.asarray(moved))
    filled = change.reshape(-1, change.shape[-1])[index.ravel()].reshape(change.shape)
    filled = gaussian(filled, SMOOTH)
    return np.where((distance <= FILL)[..., None], filled, 0).astype(np.float32)


def _apply(
    values: Float[np.ndarray, "h w *c"], name: str, change: Float[np.ndarray, "h w C"]
) -> Float[np.ndarray, "h w *c"]:
    if name == "tilt":
        xy = project("tilt", _tilt(values) + change)
        z = np.sqrt(np.maximum(1 - (xy**2).sum(axis=-1, keepdims=True), 0))
        return np.concatenate([xy, z], axis=-1).astype(np.float32)
    return project(name, values + (change if name == "albedo" else change[..., 0])).astype(np.float32)


def _tilt(normal: Float[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h w 2"]:
    return normal[..., :2] / np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-6)


def _shrink(material: Maps, name: str, covered: Bool[np.ndarray, "h w"], by: int) -> Float[np.ndarray, "H W c"]:
    """Means of a map over the covered texels of cells; cells without any take the nearest."""
    channels, (height, width) = CHANNELS[name], covered.shape
    values = material.normal if name == "tilt" else getattr(material, name).reshape(height, width, channels)
    weight = covered.reshape(height // by, by, width // by, by).sum(axis=(1, 3), dtype=np.float32)
    counted = covered if (weight > 0).any() else np.ones_like(covered)
    weight = weight if (weight > 0).any() else np.full_like(weight, by * by)
    mean = np.empty((*weight.shape, channels), np.float32)
    for rows in bands(height // by, width * by):  # of cells
        texels = slice(rows.start * by, rows.stop * by)
        block = _tilt(values[texels]) if name == "tilt" else values[texels]
        cells = (block * counted[texels][..., None]).reshape(-1, by, width // by, by, channels)
        mean[rows] = cells.sum(axis=(1, 3), dtype=np.float32) / np.maximum(weight[rows], 1)[..., None]
    index, _ = nearest(weight > 0)
    return np.ascontiguousarray(mean.reshape(-1, channels)[index.ravel()].reshape(*weight.shape, channels))
