"""Do the views of a stylized object agree, and can its shape still be read? Figures over all views of a rig.

Pictures are (h w 3), sRGB-encoded 0..1, one per view. Lower is better for warp errors and borders, higher for
readability.
"""

from collections.abc import Sequence
from itertools import combinations

import numpy as np
from jaxtyping import Bool, Float, Int

from mistyle.core.image import dilate, erode, gaussian
from mistyle.core.view import View
from mistyle.measure.lpips import Lpips
from mistyle.measure.metrics import carried_over, lab

SHORT, LONG = (
    (0.0, 46.0),
    (46.0, 95.0),
)  # degrees between the cameras of a pair: neighbours, and a part of the way round
LEAST_SHARED = 0.05  # share of a view's pixels that a pair must have in common to count
BAND = (
    1.5 / 512,
    10 / 512,
)  # of the width of the view: what lies between these blurs is the detail that guides ask for
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
    """Root mean square difference (all channels, sRGB) of a picture and another carried over into its view.

    Pooled over the pixels of all pairs; pairs that share less than LEAST_SHARED of the view are left out, NaN where
    none is left. What one view shows finer than the other leaves some error even in one painting of the surface.
    """
    squares, count = 0.0, 0
    for i, j in chosen:
        carried, both = carried_over(views[i], views[j], pictures[j])
        if both.sum() >= max(LEAST_SHARED * views[i].mask.sum(), 1):
            squares += float(((carried[both] - pictures[i][both]) ** 2).sum(dtype=np.float64))
            count += 3 * int(both.sum())
    return float(np.sqrt(squares / count)) if count else float("nan")


def round_trip_rmse(
    views: Sequence[View], pictures: Sequence[Float[np.ndarray, "h w 3"]], chosen: Sequence[Pair]
) -> float:
    """What carrying over alone costs, to be read beside `warp_rmse`: the same difference between a picture and itself
    carried into the other view and back.

    No view contradicts itself, so this is the error of two lookups and the blur of a place seen at another scale. The
    other view's own pixels are antialiased when they are drawn, and these are not, so it is no strict bound.
    """
    squares, count = 0.0, 0
    for i, j in chosen:
        there, seen = carried_over(views[j], views[i], pictures[i])
        back, both = carried_over(views[i], views[j], np.concatenate([there, seen[..., None]], axis=-1))
        if both.sum() >= max(LEAST_SHARED * views[i].mask.sum(), 1):
            both &= np.abs(back[..., 3] - 1) < 1e-3  # nothing of what the other view does not show was mixed in
            carried = back[both][:, :3] / back[both][:, 3:]
            squares += float(((carried - pictures[i][both]) ** 2).sum(dtype=np.float64))
            count += 3 * int(both.sum())
    return float(np.sqrt(squares / count)) if count else float("nan")


def warp_lpips(
    views: Sequence[View], pictures: Sequence[Float[np.ndarray, "h w 3"]], chosen: Sequence[Pair], lpips: Lpips
) -> float:
    """LPIPS of a picture and another carried over into its view, over the pixels both see; mean over the pairs."""
    found = []
    for i, j in chosen:
        carried, both = carried_over(views[i], views[j], pictures[j])
        if both.sum() >= max(LEAST_SHARED * views[i].mask.sum(), 1):
            found.append(lpips(pictures[i], carried, both))
    return float(np.mean(found)) if found else float("nan")


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
