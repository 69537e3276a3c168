"""Texture repair (paper 4.3): struggle mask, inpainting of masked texels, blending at the mask's boundary.

The paper gives no sizes for its dilations and its blending boundary; here they are shares of the atlas's side. It
inpaints with a diffusion model. Any function of the Inpainter signature works; `stylization/inpaint/fill.py` needs no
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

# (albedo (h w 3) linear, hole (h w), texels, generator) -> albedo (h w 3); only values inside the hole are used.
Inpainter = Callable[[np.ndarray, np.ndarray, Texels, np.random.Generator], np.ndarray]

FEWEST = 0.25  # share of the median number of samples below which a texel's mean gradient is noise


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
    """The texels to repaint: struggling ones, and those that no view sees; dilated by max-pooling inside islands.

    A texel struggles where its samples' gradients contradict one another and their mean magnitude is large. It must
    exceed mean + 0.5 std over sampled texels, and `settings.outlier` times their median.

    A large gradient alone also marks contrast and an unconverged fit: then it has the same sign in all views, and more
    steps would reduce it. `agreed` (`Fit.agreed`) separates the two cases; None skips this test.

    Gradients are smoothed by a Gaussian of `settings.smooth`: single texels' gradients are noise, and the dilation
    would join their scattered mask. `accumulated` is the sum of absolute albedo gradients over the last steps of phase
    2; `looks` is the number of samples per texel in these steps (`Fit.touched`); `seen` is the number of views that see
    it. The paper thresholds the sum, which without the division would show the number of samples. Rarely sampled texels
    count as sampled FEWEST times the median, or one chance pixel would decide; unsampled texels do not struggle.
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
    """Weight of the new colour per texel: 1 inside the eroded mask, 0 outside the dilated one, a smooth step between.

    Both stay inside islands. An island's own border does not erode the mask, since nothing lies behind it to blend
    with. Masked texels that no view saw have weight 1.
    """
    side = radius(settings.blend, mask.shape[1])
    mask = mask & texels.covered
    outer = dilate_within(mask, texels.island, side)
    rest = texels.covered & ~mask
    inner = mask & ~dilate_within(rest, texels.island, side)
    # Signed distance to the mask's boundary, half way between texel centres.
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
    """The maps with the albedo under `mask` repainted and blended by `blend_weights`.

    Texels outside the dilated mask (by `settings.blend`) keep their bits. Normal, roughness, metallic and `known` stay:
    a later short fit adapts them to renders of the repaired albedo. Padding is not redone.
    """
    weights = blend_weights(mask, maps.known, texels, settings)
    hole = weights > 0
    if not hole.any():
        return maps
    painted = inpainter(maps.albedo, hole, texels, np.random.default_rng(0) if rng is None else rng)
    if painted.shape != maps.albedo.shape:
        raise ValueError(f"the inpainter returned {painted.shape}, not the albedo's {maps.albedo.shape}")
    if not np.isfinite(painted[hole]).all():
        raise ValueError("the inpainter returned non-finite values; it must fill every texel of the hole")
    albedo = memory.copied(maps.albedo)
    w = weights[hole][:, None]
    albedo[hole] = np.where(w == 1, painted[hole], albedo[hole] + w * (painted[hole] - albedo[hole]))
    return replace(maps, albedo=albedo)
