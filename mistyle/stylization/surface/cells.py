"""Spatial hash grid of points: blue-noise thinning and neighbour lists.

A cell's bucket is a hash of its three integer coordinates. Several cells may share a bucket: distance tests reject
points of other cells, which cost time only. Everything runs in Dr.Jit; a thread reads only the previous kernel's values
and writes only its own point.
"""

from collections.abc import Callable
from dataclasses import dataclass
from types import ModuleType
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from mistyle.render.mitsuba.device import dr
from mistyle.stylization.surface.kernels import floats, whole

PRIMES = (73856093, 19349663, 83492791)
UNDECIDED, STAYS, GONE = 0, 1, 2
FEWEST = 12  # least bits of a bucket index, so that with few points, too, nearby cells rarely share a bucket


@dataclass(frozen=True)
class PointGrid:
    """Points by bucket: those of bucket b are rows range[2 b] to range[2 b + 1] of the sorted arrays.

    at      flat (n 4): position, and the point's number
    facing  flat (n 4): normal, and its index in the input order
    row     row of each input point
    crowd   mean number of points in a point's own bucket, itself included
    """

    size: float
    mask: int
    range: Any
    at: Any
    facing: Any
    row: Int[np.ndarray, " n"]
    crowd: float


def point_grid(
    dj: ModuleType,
    positions: Float[np.ndarray, "n 3"],
    normals: Float[np.ndarray, "n 3"],
    size: float,
    number: Int[np.ndarray, " n"] | None = None,
) -> PointGrid:
    """Points sorted into cubes of side `size`, with their `number` (under 2^32)."""
    count = len(positions)
    buckets = 1 << max(int(np.ceil(np.log2(max(count, 2)))), FEWEST)
    # The same float32 arithmetic as in the kernels, so that both agree on a point's cell.
    cell = np.floor(positions.astype(np.float32) * np.float32(1 / size)).astype(np.int32).view(np.uint32)
    key = np.zeros(count, np.uint32)
    for axis, prime in enumerate(PRIMES):
        key ^= cell[:, axis] * np.uint32(prime)
    key &= np.uint32(buckets - 1)
    held = np.bincount(key, minlength=buckets)
    end = np.cumsum(held)
    member = np.sort((key.astype(np.int64) << 32) | np.arange(count)) & 0xFFFFFFFF
    row = np.empty(count, np.int64)
    row[member] = np.arange(count)
    numbers = np.zeros(count, np.uint32) if number is None else number.astype(np.uint32)[member]
    at = np.concatenate([positions[member].astype(np.float32), numbers.view(np.float32)[:, None]], axis=1)
    own = member.astype(np.uint32).view(np.float32)[:, None]
    facing = np.concatenate([normals[member].astype(np.float32), own], axis=1)
    return PointGrid(
        size=size,
        mask=buckets - 1,
        range=whole(dj, np.stack([end - held, end], axis=1)),
        at=floats(dj, at),
        facing=floats(dj, facing),
        row=row,
        crowd=float((held.astype(np.float64) ** 2).sum()) / count,
    )


def each_near(
    dj: ModuleType, grid: PointGrid, point: Any, state: tuple[Any, ...], visit: Callable[..., tuple[Any, ...]]
) -> tuple[Any, ...]:
    """Fold `visit(row, inside, *state)` over the rows of the 27 cells about `point`.

    Where `inside` is false the row is invalid. Some rows belong to other cells; with few points some repeat.
    """
    scale = dr.opaque(dj.Float, float(np.float32(1 / grid.size)))
    base = [dj.Int(dr.floor(point[axis] * scale)) for axis in range(3)]
    mask = dr.opaque(dj.UInt, grid.mask)

    def bucket(k: Any) -> Any:
        step = (dj.Int(k % 3) - 1, dj.Int(k // 3 % 3) - 1, dj.Int(k // 9) - 1)
        key = dj.UInt(0)
        for axis, prime in enumerate(PRIMES):
            key ^= dj.UInt(base[axis] + step[axis]) * dj.UInt(prime)
        return dr.gather(dj.Array2u, grid.range, key & mask)

    def body(k: Any, at: Any, end: Any, *inner: Any) -> tuple[Any, ...]:
        inside = at < end
        new = visit(dr.select(inside, at, 0), inside, *inner)
        at = at + 1
        turn = at >= end
        k = dr.select(turn, k + 1, k)
        first, last = bucket(dr.minimum(k, 26))
        return k, dr.select(turn, first, at), dr.select(turn, last, end), *new

    first, last = bucket(dj.UInt(0))
    return dr.while_loop((dj.UInt(0), first, last, *state), lambda k, *rest: k < 27, body)[3:]


def thin(dj: ModuleType, grid: PointGrid, radius: float) -> Bool[np.ndarray, " n"]:
    """Mask of the points that stay when, by falling number, each removes all others of its side within `radius`.

    Parallel rounds: a point that outranks all undecided neighbours stays, and its neighbours are removed. `radius` is
    at most the cells' size. The mask is in the input order.
    """
    fate = dr.zeros(dj.UInt, len(grid.row))
    limit = dr.opaque(dj.Float, float(radius) ** 2)
    open_ones = grid.row
    while len(open_ones):
        i = whole(dj, open_ones)
        now = _fates(dj, grid, fate, i, limit)
        after = dj.UInt(fate)
        dr.scatter(after, now, i)
        dr.eval(after, now)
        fate = after
        open_ones = open_ones[now.numpy() == UNDECIDED]
    return (fate.numpy() == STAYS)[grid.row]


def _fates(dj: ModuleType, grid: PointGrid, fate: Any, i: Any, limit: Any) -> Any:
    """The fates of the points in rows `i` after one more round; `limit` is the squared radius."""

    def number(bits: Any) -> Any:
        return dr.reinterpret_array(dj.UInt, bits)

    own: Any = dr.gather(dj.Array4f, grid.at, i)
    normal: Any = dr.gather(dj.Array4f, grid.facing, i)
    own_number = number(own[3])

    def visit(j: Any, inside: Any, beaten: Any, gone: Any) -> tuple[Any, Any]:
        neighbour, facing = dr.gather(dj.Array4f, grid.at, j), dr.gather(dj.Array4f, grid.facing, j)
        step = [neighbour[axis] - own[axis] for axis in range(3)]
        near = inside & (step[0] * step[0] + step[1] * step[1] + step[2] * step[2] <= limit) & (j != i)
        near &= facing[0] * normal[0] + facing[1] * normal[1] + facing[2] * normal[2] > 0
        neighbour_fate = dr.gather(dj.UInt, fate, j)
        beaten |= near & (neighbour_fate == UNDECIDED) & (number(neighbour[3]) > own_number)
        return beaten, gone | (near & (neighbour_fate == STAYS))

    beaten, gone = each_near(dj, grid, own, (dj.Bool(False), dj.Bool(False)), visit)
    return dr.select(gone, dj.UInt(GONE), dr.select(beaten, dj.UInt(UNDECIDED), dj.UInt(STAYS)))


def near(
    dj: ModuleType,
    positions: Float[np.ndarray, "n 3"],
    normals: Float[np.ndarray, "n 3"],
    reach: float,
    turning: float,
    most: int,
) -> Int[np.ndarray, "n k"]:
    """Up to `most` points j with |p_j - p_i|^2 + (turning |n_j - n_i|)^2 < reach^2, padded with the own index."""
    count = len(positions)
    grid = point_grid(dj, positions, normals, reach)
    row = whole(dj, grid.row)
    i = dr.arange(dj.UInt, count)
    own, normal = dr.gather(dj.Array4f, grid.at, row), dr.gather(dj.Array4f, grid.facing, row)
    limit, weight = dr.opaque(dj.Float, float(reach) ** 2), dr.opaque(dj.Float, float(turning) ** 2)
    listed = whole(dj, np.repeat(np.arange(count, dtype=np.uint32), most))

    def visit(j: Any, inside: Any, held: Any) -> tuple[Any]:
        neighbour, facing = dr.gather(dj.Array4f, grid.at, j), dr.gather(dj.Array4f, grid.facing, j)
        away = dr.square(neighbour[0] - own[0]) + dr.square(neighbour[1] - own[1]) + dr.square(neighbour[2] - own[2])
        turn = [dr.square(facing[axis] - normal[axis]) for axis in range(3)]
        away += weight * (turn[0] + turn[1] + turn[2])
        take = inside & (away < limit) & (held < most)
        dr.scatter(listed, dr.reinterpret_array(dj.UInt, facing[3]), i * most + held, take)
        return (dr.select(take, held + 1, held),)

    each_near(dj, grid, own, (dr.zeros(dj.UInt, count),), visit)
    dr.eval(listed)
    return listed.numpy().reshape(count, most).astype(np.int32)
