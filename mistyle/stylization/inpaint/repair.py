"""Repair (paper 4.3): where the fit could not settle, what to put there, and how to join it to what was there.

The paper gives no sizes for its dilations and its blending boundary; here they are shares of the atlas's side. It fills
with a diffusion model; any function of the Inpainter signature does, and `stylization/inpaint/fill.py` needs no
weights.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float, Int

from mistyle.core.image import dilate_within, distance_to, gaussian
from mistyle.core.maps import Maps, Texels
from mistyle.process import memory
from mistyle.stylization.inpaint.settings import RepairSettings

# (albedo (h w 3) linear, hole (h w), texels, generator) -> albedo (h w 3); only what it answers inside the hole counts.
Inpainter = Callable[[np.ndarray, np.ndarray, Texels, np.random.Generator], np.ndarray]

FEWEST = 0.25  # share of the median number of looks below which a texel's mean gradient is chance


def radius(share: float, size: int) -> int:
    """A share of the atlas's side in texels: 0 for 0, else at least 1."""
    return max(1, round(share * size)) if share > 0 else 0


def struggle_mask(
    accumulated: Float[np.ndarray, "h w"],
    looks: Float[np.ndarray, "h w"],
    seen: Int[np.ndarray, "h w"],
    texels: Texels,
    settings: RepairSettings,
    agreed: Float[np.ndarray, "h w"] | None = None,
) -> Bool[np.ndarray, "h w"]:
    """The texels to paint again: those around which the mean |gradient| of a look exceeds mean + 0.5 std over the
    texels that were looked at, and `settings.outlier` times their median, while its looks contradict one another; and
    those that no view sees. Dilated by max-pooling inside their islands.

    A large gradient alone is the mark of contrast and of a fit that was not run to its end: it pulls the same way in
    all views, and more steps would mend it. `agreed` (`Fit.agreed`) tells the two apart; None leaves it out.

    "Around" is a Gaussian of `settings.smooth`: single texels' gradients are noise, and thresholded one by one they lie
    scattered over everything, which the dilation then joins. `accumulated` is the sum of absolute albedo gradients over
    the last steps of phase 2, `looks` how often these steps looked at a texel (`Fit.touched`), `seen` how many views
    see it. The paper thresholds the sum; without the division the mask would show how often a texel was looked at. What
    was hardly looked at counts as looked at FEWEST times the median, or one chance pixel would decide; what was not
    looked at at all says nothing.
    """
    struggling = texels.covered & (seen <= 0)
    looked = texels.covered & (seen > 0) & (looks > 0)
    if looked.any():
        least = FEWEST * float(np.median(looks[looked]))
        side = settings.smooth * texels.covered.shape[1]
        total, times = (gaussian(np.where(looked, a, 0).astype(np.float32), side) for a in (accumulated, looks))
        average = total[looked].astype(np.float64) / np.maximum(times[looked], least)
        limit = average.mean() + settings.deviations * average.std()
        struggling[looked] = average > max(limit, settings.outlier * float(np.median(average)))
        if agreed is not None and settings.agreement < 1:
            one_way = gaussian(np.where(looked, agreed, 0).astype(np.float32), side)[looked]
            struggling[looked] &= one_way <= settings.agreement * total[looked]
    return dilate_within(struggling, texels.island, radius(settings.dilation, texels.covered.shape[1]))


def blend_weights(
    mask: Bool[np.ndarray, "h w"], known: Bool[np.ndarray, "h w"], texels: Texels, settings: RepairSettings
) -> Float[np.ndarray, "h w"]:
    """How much of the new colour each texel takes: 1 inside the eroded mask, 0 outside the dilated one, a smooth step
    over the difference of the two. Both stay inside islands, and an island's own border does not erode the mask: there
    is nothing behind it to blend with. A masked texel that nobody saw has nothing worth keeping and takes all.
    """
    side = radius(settings.blend, mask.shape[1])
    mask = mask & texels.covered
    outer = dilate_within(mask, texels.island, side)
    rest = texels.covered & ~mask
    inner = mask & ~dilate_within(rest, texels.island, side)
    # Signed distance to the mask's boundary, which runs half way between texel centres.
    signed = np.where(mask, distance_to(rest) - 0.5, 0.5 - distance_to(mask))
    t = np.clip((signed + side) / max(2 * side, 1), 0, 1)
    weights = np.where(outer, t * t * (3 - 2 * t), 0)
    return np.where(inner | (mask & ~known), 1, weights).astype(np.float32)


def repair(
    maps: Maps,
    mask: Bool[np.ndarray, "h w"],
    texels: Texels,
    inpainter: Inpainter,
    settings: RepairSettings,
    rng: np.random.Generator | None = None,
) -> Maps:
    """The maps with the albedo under `mask` painted anew and joined by `blend_weights`; the rest stays as it is.

    Texels outside the dilated mask (by `settings.blend`) keep their bits. Normal, roughness, metallic and `known` are
    not touched: they follow by a short fit against renders of the repaired albedo. Padding is not redone.
    """
    weights = blend_weights(mask, maps.known, texels, settings)
    hole = weights > 0
    if not hole.any():
        return maps
    painted = inpainter(maps.albedo, hole, texels, np.random.default_rng(0) if rng is None else rng)
    if painted.shape != maps.albedo.shape:
        raise ValueError(f"the inpainter returned {painted.shape}, not the albedo's {maps.albedo.shape}")
    if not np.isfinite(painted[hole]).all():
        raise ValueError("the inpainter returned numbers that are not finite; it must answer every texel of the hole")
    albedo = memory.copied(maps.albedo)
    w = weights[hole][:, None]
    albedo[hole] = np.where(w == 1, painted[hole], albedo[hole] + w * (painted[hole] - albedo[hole]))
    return replace(maps, albedo=albedo)
