"""Next-best-view rigs (an open point of paper 6.2.1): the fewest cameras that see a surface well.

The surface is a set of points of equal area. `weight` (c s) is the cosine at which each of c candidate cameras
faces each of them, max(0, n . (c - P) / |c - P|) as in `atlas.bake.backproject`, and 0 where the point is hidden or out
of the frame. A view sees a point well at a weight of `least` or more. This module has no meshes and no rays.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from mistyle.core.camera import Camera, orbit
from mistyle.core.settings import RigSettings

GOLDEN_ANGLE = 180 * (3 - 5**0.5)
STARTS = 8  # first views that are tried: those with the largest covered area
PASSES = 3  # rounds of exchange; later ones hardly ever improve


@dataclass(frozen=True)
class Choice:
    """The chosen candidates of a rig.

    order      candidates in visiting order: each after the one it overlaps most
    overlap    of each view with that earlier one (NaN for the first), as in `overlaps`
    reachable  points that any candidate sees well
    covered    points that the chosen ones see well
    """

    order: Int[np.ndarray, " k"]
    overlap: Float[np.ndarray, " k"]
    reachable: Bool[np.ndarray, " s"]
    covered: Bool[np.ndarray, " s"]


def candidate_cameras(settings: RigSettings) -> list[Camera]:
    """`settings.candidates` cameras on a sphere of radius `settings.distance`, on a Fibonacci spiral from the top down,
    each looking at the origin."""
    count = settings.candidates
    elevation = np.degrees(np.arcsin(1 - (2 * np.arange(count) + 1) / count))
    azimuth = GOLDEN_ANGLE * np.arange(count) % 360
    size = (settings.resolution, settings.resolution)
    return [
        orbit(a, e, distance=settings.distance, fov=settings.fov, size=size)
        for a, e in zip(azimuth, elevation, strict=True)
    ]


def overlaps(weight: Float[np.ndarray, "c s"], least: float) -> Float[np.ndarray, "c c"]:
    """Share of the points seen well by one view that the other also sees well; the smaller of the two directions.

    Points are weighted by `weight`, which is their share of the picture where all are about equally far away.
    """
    good = weight >= least
    seen = np.where(good, weight, 0).astype(np.float32)
    both = seen @ good.T.astype(np.float32)
    share = both / np.maximum(seen.sum(axis=1, keepdims=True), 1e-9)
    return np.minimum(share, share.T)


def choose(weight: Float[np.ndarray, "c s"], least: float = 0.4, least_overlap: float = 0.4, most: int = 32) -> Choice:
    """A small set of at most `most` candidates that together see every reachable point well.

    Neighbouring views overlap: the rig is connected in the graph of views with an overlap of `least_overlap` or more.
    So an earlier view can be warped into each view but the first. The search is greedy from STARTS first views: it adds
    the candidate with the largest gain per view, counting the overlapping views on the path to it. Then it exchanges
    single views, then it drops views as long as an exchange compensates. Greedy alone stays within 1 + ln s of the
    smallest set (Chvatal 1979) when the overlap does not bind. Where `most` binds, the search maximises the covered
    points.
    """
    reachable = (weight >= least).max(axis=0)
    share = overlaps(weight, least)
    # Candidates that see nothing overlap with nothing, themselves included.
    linked = (share >= least_overlap) & ~np.eye(len(share), dtype=bool)
    # Points that the same candidates see count once, with their number.
    bits = np.packbits((weight[:, reachable] >= least).T, axis=1)
    patterns, multiplicity = np.unique(bits, axis=0, return_counts=True)
    good = np.unpackbits(patterns, axis=1, count=len(weight)).astype(np.float32)
    value = multiplicity.astype(np.float32)
    area = value @ good
    starts = np.argsort(-area, kind="stable")[:STARTS]
    tries = [greedy(good, value, linked, most, int(first)) for first in starts]
    best = min(tries, key=lambda views: (-covered_value(good, value, views), len(views)))
    chosen = shrink(good, value, linked, exchange(good, value, linked, best))
    order, overlap = visit(area, share, chosen)
    return Choice(order, overlap, reachable, (weight[order] >= least).max(axis=0))


def covered_value(good: Float[np.ndarray, "s c"], value: Float[np.ndarray, " s"], views: Sequence[int]) -> float:
    """The value of the points that the views see well."""
    return float(value[good[:, list(views)].any(axis=1)].sum())


def greedy(
    good: Float[np.ndarray, "s c"],
    value: Float[np.ndarray, " s"],
    linked: Bool[np.ndarray, "c c"],
    most: int,
    first: int,
) -> list[int]:
    """`first`, then candidates in the order of their gain; points that no linked candidate reaches stay uncovered."""
    chosen = [first]
    uncovered = np.flatnonzero(good[:, first] == 0)
    while len(uncovered) and len(chosen) < most:
        gain = value[uncovered] @ good[uncovered]
        steps, before = distances(linked, chosen, gain)
        worth = np.where((steps > 0) & (steps <= most - len(chosen)), gain / np.maximum(steps, 1), 0)
        best = int(worth.argmax())
        if worth[best] <= 0:
            break
        path = [best]
        while steps[path[0]] > 1:
            path.insert(0, int(before[path[0]]))
        chosen += path
        uncovered = uncovered[good[np.ix_(uncovered, np.array(path))].max(axis=1) == 0]
    return chosen


def distances(
    linked: Bool[np.ndarray, "c c"], chosen: Sequence[int], gain: Float[np.ndarray, " c"]
) -> tuple[Int[np.ndarray, " c"], Int[np.ndarray, " c"]]:
    """Path length from the chosen views to each candidate (-1: unreachable), and the candidate before it on the path;
    of equally short paths the one of largest gain."""
    steps = np.full(len(linked), -1)
    before = np.full(len(linked), -1)
    steps[list(chosen)] = 0
    rim = np.array(chosen)
    while len(rim):
        reached = linked[:, rim] & (steps < 0)[:, None]
        fresh = np.flatnonzero(reached.any(axis=1))
        before[fresh] = rim[np.where(reached[fresh], gain[rim], -1).argmax(axis=1)]
        steps[fresh] = steps[rim[0]] + 1
        rim = fresh
    return steps, before


def connected(linked: Bool[np.ndarray, "c c"], chosen: Sequence[int]) -> bool:
    """Whether every chosen view can be reached from the first through chosen ones."""
    inside = linked[np.ix_(np.array(chosen), np.array(chosen))]
    reached = np.zeros(len(chosen), bool)
    reached[:1] = True
    for _ in chosen:
        reached |= inside[reached].any(axis=0)
    return bool(reached.all())


def exchange(
    good: Float[np.ndarray, "s c"], value: Float[np.ndarray, " s"], linked: Bool[np.ndarray, "c c"], start: list[int]
) -> list[int]:
    """Replace single views while coverage grows and the rig stays connected."""
    chosen = list(start)
    count = good[:, chosen].sum(axis=1)
    for _ in range(PASSES):
        changed = False
        for k, old in enumerate(chosen):
            if count.all():
                return chosen
            rest = count - good[:, old]
            uncovered = np.flatnonzero(rest == 0)
            gain = value[uncovered] @ good[uncovered]
            for new in np.argsort(-gain, kind="stable"):
                if gain[new] <= gain[old]:
                    break
                if connected(linked, chosen[:k] + [int(new)] + chosen[k + 1 :]):
                    chosen[k], count, changed = int(new), rest + good[:, new], True
                    break
        if not changed:
            break
    return chosen


def shrink(
    good: Float[np.ndarray, "s c"], value: Float[np.ndarray, " s"], linked: Bool[np.ndarray, "c c"], start: list[int]
) -> list[int]:
    """Drop views, the smallest loss first, as long as exchanges restore the coverage of `start`."""
    chosen, goal = list(start), covered_value(good, value, start)
    while len(chosen) > 1:
        alone = good[:, chosen].sum(axis=1) == 1
        loss = value[alone] @ good[np.ix_(alone, np.array(chosen))]
        trials = (chosen[:k] + chosen[k + 1 :] for k in np.argsort(loss, kind="stable"))
        trial = next((t for t in trials if connected(linked, t)), None)
        if trial is None:
            break
        trial = exchange(good, value, linked, trial)
        if covered_value(good, value, trial) < goal:
            break
        chosen = trial
    return chosen


def visit(
    area: Float[np.ndarray, " c"], share: Float[np.ndarray, "c c"], chosen: Sequence[int]
) -> tuple[Int[np.ndarray, " k"], Float[np.ndarray, " k"]]:
    """Visiting order from the view with the largest area, and each view's largest overlap with an earlier one."""
    remaining = sorted(chosen)
    order, overlap = [max(remaining, key=lambda c: area[c])], [float("nan")]
    remaining.remove(order[0])
    while remaining:
        best = share[np.ix_(remaining, order)].max(axis=1)
        order.append(remaining.pop(int(best.argmax())))
        overlap.append(float(best.max()))
    return np.array(order), np.array(overlap, np.float32)
