"""Next-best-view rigs (paper 6.2.1, which leaves them open): the fewest cameras that see a surface well.

The surface is a set of points of equal area, `weight` (c s) says how much each of c candidate cameras faces each of
them, max(0, n . (c - P) / |c - P|) as in `stages.backproject`, and 0 where the point is hidden or out of the frame.
A view sees a point well from the weight `least` on. This module knows nothing of meshes or rays.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from mistyle.core.camera import Camera, orbit
from mistyle.core.rig_settings import RigSettings

GOLDEN_ANGLE = 180 * (3 - 5**0.5)
STARTS = 8  # first views that are tried, the most seeing ones
PASSES = 3  # rounds of exchange; later ones hardly ever find anything


@dataclass(frozen=True)
class Choice:
    """Which candidates make the rig.

    order      candidates in visiting order: each after the one it overlaps most
    overlap    of each view with that earlier one (NaN for the first), as in `overlaps`
    reachable  which points any candidate sees well
    covered    which points the chosen ones see well
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
    """Share of what one view sees well that the other sees well too; of the two ways to take it, the smaller.

    Points count by their weight, which is their share of the picture as long as all are about equally far away.
    """
    good = weight >= least
    seen = np.where(good, weight, 0).astype(np.float32)
    both = seen @ good.T.astype(np.float32)
    share = both / np.maximum(seen.sum(axis=1, keepdims=True), 1e-9)
    return np.minimum(share, share.T)


def choose(weight: Float[np.ndarray, "c s"], least: float = 0.4, least_overlap: float = 0.4, most: int = 32) -> Choice:
    """The smallest set of candidates found by which every reachable point is seen well, `most` at the utmost.

    Neighbouring views overlap: in the graph that joins views whose overlap is `least_overlap` or more, the rig is
    connected, so each view but the first can be warped into from an earlier one. Greedy from STARTS first views (the
    candidate with the largest gain per view that has to be added to reach it through overlapping ones), then exchange
    of single views, then views are left out as long as an exchange makes up for them. Greedy alone stays within 1 + ln
    s of the smallest set (Chvatal 1979) when the overlap does not bind. Where `most` binds, the points covered are what
    is maximised.
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
    left = np.flatnonzero(good[:, first] == 0)
    while len(left) and len(chosen) < most:
        gain = value[left] @ good[left]
        steps, before = distances(linked, chosen, gain)
        worth = np.where((steps > 0) & (steps <= most - len(chosen)), gain / np.maximum(steps, 1), 0)
        best = int(worth.argmax())
        if worth[best] <= 0:
            break
        path = [best]
        while steps[path[0]] > 1:
            path.insert(0, int(before[path[0]]))
        chosen += path
        left = left[good[np.ix_(left, np.array(path))].max(axis=1) == 0]
    return chosen


def distances(
    linked: Bool[np.ndarray, "c c"], chosen: Sequence[int], gain: Float[np.ndarray, " c"]
) -> tuple[Int[np.ndarray, " c"], Int[np.ndarray, " c"]]:
    """How many views away each candidate is from the chosen ones (-1: not to be reached), and the candidate before it
    on the way, of equally short ways the one of largest gain."""
    steps = np.full(len(linked), -1)
    before = np.full(len(linked), -1)
    steps[list(chosen)] = 0
    rim = np.array(chosen)
    while len(rim):
        met = linked[:, rim] & (steps < 0)[:, None]
        fresh = np.flatnonzero(met.any(axis=1))
        before[fresh] = rim[np.where(met[fresh], gain[rim], -1).argmax(axis=1)]
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
    """Single views are replaced while the points covered grow and the rig stays connected."""
    chosen = list(start)
    count = good[:, chosen].sum(axis=1)
    for _ in range(PASSES):
        changed = False
        for k, old in enumerate(chosen):
            if count.all():
                return chosen
            rest = count - good[:, old]
            left = np.flatnonzero(rest == 0)
            gain = value[left] @ good[left]
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
    """Views are left out, the least missed first, as long as exchanges cover all that `start` covers."""
    chosen, goal = list(start), covered_value(good, value, start)
    while len(chosen) > 1:
        alone = good[:, chosen].sum(axis=1) == 1
        missed = value[alone] @ good[np.ix_(alone, np.array(chosen))]
        trials = (chosen[:k] + chosen[k + 1 :] for k in np.argsort(missed, kind="stable"))
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
    """Visiting order, first the view that sees most, and each one's overlap with the earlier one it overlaps most."""
    left = sorted(chosen)
    order, overlap = [max(left, key=lambda c: area[c])], [float("nan")]
    left.remove(order[0])
    while left:
        best = share[np.ix_(left, order)].max(axis=1)
        order.append(left.pop(int(best.argmax())))
        overlap.append(float(best.max()))
    return np.array(order), np.array(overlap, np.float32)
