"""Do the views of a stylized object agree, and can its shape still be read? Figures over all views of a rig.

Pictures are (h w 3), sRGB-encoded 0..1, one per view. Lower is better for warp errors and borders, higher for
readability.
"""

from collections.abc import Iterator, Sequence
from itertools import combinations

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int

from mistyle.core.image import dilate, erode, gaussian
from mistyle.core.view import View
from mistyle.measure.colour_difference import lab
from mistyle.measure.lpips import Lpips
from mistyle.measure.metrics import band_correlation, detail
from mistyle.measure.overlap import DEPTH_TOLERANCE, Overlap, overlap, seen_here, seen_there

# Degrees between the cameras of a pair: neighbours, and a part of the way round.
SHORT, LONG = (0.0, 46.0), (46.0, 95.0)
LEAST_SHARED = 0.05  # share of a view's pixels that a pair must have in common to count
# Shares of the view's width: the detail that guides ask for lies between these blurs.
BAND = (1.5 / 512, 10 / 512)
SEAM_JUMP = 8.0  # times the usual uv step between neighbouring pixels
Pair = tuple[int, int]


def pairs(views: Sequence[View], degrees: tuple[float, float]) -> list[Pair]:
    """Ordered pairs of views whose cameras' directions from the origin differ by more than the first and at most the
    second number of degrees; both ways round, since what one view carries into the other differs."""
    towards = [v.camera.position / np.linalg.norm(v.camera.position) for v in views]
    found = []
    for i, j in combinations(range(len(views)), 2):
        angle = np.degrees(np.arccos(np.clip(towards[i] @ towards[j], -1, 1)))
        if degrees[0] < angle <= degrees[1]:
            found += [(i, j), (j, i)]
    return found


def warp_rmse(views: Sequence[View], pictures: Sequence[Float[np.ndarray, "h w 3"]], chosen: Sequence[Pair]) -> float:
    """Root mean square difference (all channels, sRGB) of what two pictures show of the same places, at the coarser of
    their pixels (`measure/overlap.py`).

    Pooled over the pixels of all pairs; pairs that share less than LEAST_SHARED of the view are left out, NaN where
    none is left.
    """
    squares, count = 0.0, 0
    for i, j, shared in _shared(views, chosen):
        wrong = seen_there(shared, pictures[j]) - seen_here(shared, pictures[i])
        squares += float((wrong**2).sum(dtype=np.float64))
        count += wrong.size
    return float(np.sqrt(squares / count)) if count else float("nan")


def round_trip_rmse(
    views: Sequence[View], pictures: Sequence[Float[np.ndarray, "h w 3"]], chosen: Sequence[Pair]
) -> float:
    """What carrying over alone costs, to be read beside `warp_rmse`: the same difference between a picture and itself
    carried into the other view and back.

    No view contradicts itself, so this is the error of two lookups. It is no strict bound: `warp_rmse` makes one.
    """
    squares, count = 0.0, 0
    for i, j, shared in _shared(views, chosen):
        there = overlap(views[j], views[i])
        carried = np.zeros((*there.both.shape, 4), np.float32)
        carried[there.both, :3], carried[there.both, 3] = seen_there(there, pictures[i]), 1
        back = seen_there(shared, carried)
        whole = np.abs(back[:, 3] - 1) < 1e-3  # nothing of what the other view does not show was mixed in
        wrong = back[whole, :3] / back[whole, 3:] - seen_here(shared, pictures[i])[whole]
        squares += float((wrong**2).sum(dtype=np.float64))
        count += wrong.size
    return float(np.sqrt(squares / count)) if count else float("nan")


def warp_lpips(
    views: Sequence[View], pictures: Sequence[Float[np.ndarray, "h w 3"]], chosen: Sequence[Pair], lpips: Lpips
) -> float:
    """LPIPS of what two pictures show of the same places, at the coarser of their pixels; mean over the pairs."""
    found = []
    for i, j, shared in _shared(views, chosen):
        mine = pictures[i].astype(np.float32)
        theirs = mine.copy()  # what is not shared does not count
        mine[shared.both], theirs[shared.both] = seen_here(shared, pictures[i]), seen_there(shared, pictures[j])
        found.append(lpips(mine, theirs, shared.both))
    return float(np.mean(found)) if found else float("nan")


def _shared(views: Sequence[View], chosen: Sequence[Pair]) -> Iterator[tuple[int, int, Overlap]]:
    """The pairs that share enough, and what they share."""
    for i, j in chosen:
        shared = overlap(views[i], views[j])
        if shared.both.sum() >= max(LEAST_SHARED * views[i].mask.sum(), 1):
            yield i, j, shared


def detail_correlation(
    picture: Float[np.ndarray, "h w 3"], reference: Float[np.ndarray, "h w 3"], mask: Bool[np.ndarray, "h w"]
) -> float:
    """Correlation of the pictures' `detail` over the mask."""
    return band_correlation(detail(picture, mask), detail(reference, mask), mask)


def guide_correlation(
    pictures: Sequence[Float[np.ndarray, "h w 3"]],
    guides: Sequence[Float[np.ndarray, "h w"]],
    masks: Sequence[Bool[np.ndarray, "h w"]],
) -> float:
    """Correlation about zero of the pictures' middle band of lightness with a detail guide, -1..1, over all views.

    sum w b g / sqrt(sum w b² sum w g²), w = |g|^1.5: places that ask for a dark or a light stroke count, others are
    free. b is the difference of two blurs inside the mask (BAND).
    """
    product, mine, theirs = 0.0, 0.0, 0.0
    for picture, guide, mask in zip(pictures, guides, masks, strict=True):
        inner = erode(mask, 2)
        light, share = lab(picture)[..., 0] / 100, inner.astype(np.float32)
        fine, coarse = (
            gaussian(light * share, s * mask.shape[1]) / np.maximum(gaussian(share, s * mask.shape[1]), 1e-3)
            for s in BAND
        )
        b, g = (fine - coarse)[inner].astype(np.float64), guide[inner].astype(np.float64)
        w = np.abs(g) ** 1.5
        product, mine, theirs = product + (w * b * g).sum(), mine + (w * b * b).sum(), theirs + (w * g * g).sum()
    scale = float(np.sqrt(mine * theirs))
    return float(product / scale) if scale > 0 else float("nan")


def border_ratio(
    albedo: Float[np.ndarray, "h w 3"], label: Int[np.ndarray, "h w"], island: Int[np.ndarray, "h w"]
) -> float:
    """How much more neighbouring texels differ where the label (the view that painted them) changes than beside it.

    Texels with label -1 are left out, and only neighbours of one island are compared, with those within eight texels of
    a change. 1: the borders cannot be seen. NaN where nothing changes.
    """
    on, off = [], []
    for a, b in ((np.s_[:-1], np.s_[1:]), (np.s_[:, :-1], np.s_[:, 1:])):
        joined = (label[a] >= 0) & (label[b] >= 0) & (island[a] == island[b])
        border = joined & (label[a] != label[b])
        difference = np.abs(albedo[a] - albedo[b]).sum(axis=-1)
        on.append(difference[border])
        off.append(difference[dilate(border, 8) & joined & ~border])
    across, beside = np.concatenate(on), np.concatenate(off)
    return float(across.mean() / max(float(beside.mean()), 1e-9)) if len(across) and len(beside) else float("nan")


def edge_recall(
    picture: Float[np.ndarray, "h w 3"],
    reference: Float[np.ndarray, "h w 3"],
    mask: Bool[np.ndarray, "h w"],
    thresholds: tuple[float, float] = (20, 60),
) -> float:
    """Share of the reference's Canny edges (8-bit lightness, 2 px blur) with an edge of the picture within one pixel,
    minus the share that edges thrown at random would meet. Without the second, noise would score best."""
    inner = erode(mask, 3)
    mine, theirs = (_edges(p, mask, thresholds) & inner for p in (picture, reference))
    if not theirs.any():
        return float("nan")
    near = dilate(mine, 1)
    return float(near[theirs].mean() - near[inner].mean())


def _edges(picture, mask, thresholds) -> Bool[np.ndarray, "h w"]:
    light, weight = lab(picture)[..., 0], mask.astype(np.float32)
    smooth = gaussian(light * weight, 2) / np.maximum(gaussian(weight, 2), 1e-3)
    return cv2.Canny(np.clip(smooth * 2.55, 0, 255).astype(np.uint8), *thresholds) > 0


def seam_ratio(view: View, picture: Float[np.ndarray, "h w 3"]) -> float:
    """How much more neighbouring pixels differ across UV seams than beside them: 1 where seams cannot be seen.

    A pair of neighbours is a seam where both lie on the surface, their depths continue each other, and their uv jump
    is over SEAM_JUMP times the view's median step, or their texture sets differ. Compared with the pairs within eight
    pixels of a seam. NaN where the view shows no seam.
    """
    differences, steps, pairs = [], [], []
    depth = np.where(view.mask, view.depth, 0)
    for a, b in ((np.s_[:-1], np.s_[1:]), (np.s_[:, :-1], np.s_[:, 1:])):
        joined = view.mask[a] & view.mask[b] & (np.abs(depth[a] - depth[b]) < DEPTH_TOLERANCE)
        jump = np.linalg.norm(view.uv[a] - view.uv[b], axis=-1)
        steps.append(jump[joined])
        pairs.append((joined, jump, view.part[a] != view.part[b]))
        differences.append(np.abs(picture[a] - picture[b]).sum(axis=-1))
    if not sum(map(len, steps)):
        return float("nan")
    usual = float(np.median(np.concatenate(steps)))
    seams = [joined & ((jump > SEAM_JUMP * usual) | parts) for joined, jump, parts in pairs]
    on = np.concatenate([d[s] for d, s in zip(differences, seams, strict=True)])
    beside = [dilate(s, 8) & ~s & joined for s, (joined, _, _) in zip(seams, pairs, strict=True)]
    off = np.concatenate([d[s] for d, s in zip(differences, beside, strict=True)])
    return float(on.mean() / max(float(off.mean()), 1e-9)) if len(on) and len(off) else float("nan")
