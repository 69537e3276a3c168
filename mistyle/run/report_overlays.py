"""What the report can lay over the maps of a texture set: what was seen, where the fit struggled, what was repaired."""

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from mistyle.core.image import gaussian
from mistyle.core.maps import Texels
from mistyle.run.report import Overlay

OPACITY = 0.8
MAGENTA = (1.0, 0.0, 0.8)
# Struggle is shown from the median to this share of the texels.
HIGHEST = 0.99


def viridis(share: Float[np.ndarray, "h w"]) -> UInt8[np.ndarray, "h w 3"]:
    """0..1 as sRGB colours from dark blue to yellow."""
    import cv2

    levels = np.clip(np.nan_to_num(share) * 255, 0, 255).astype(np.uint8)
    return np.ascontiguousarray(cv2.applyColorMap(levels, cv2.COLORMAP_VIRIDIS)[..., ::-1])


def layer(
    rgb: Float[np.ndarray, "h w 3"] | UInt8[np.ndarray, "h w 3"], alpha: Float[np.ndarray, "h w"], texels: Texels
) -> UInt8[np.ndarray, "h w 4"]:
    """Colours (0..1 or 8 bits) and opacity as a picture that is transparent off the islands."""
    colours = rgb if rgb.dtype == np.uint8 else np.round(np.clip(rgb, 0, 1) * 255).astype(np.uint8)
    opacity = np.round(np.where(texels.covered, np.clip(alpha, 0, 1), 0) * 255).astype(np.uint8)
    return np.concatenate([colours, opacity[..., None]], axis=-1)


def coverage(seen: Int[np.ndarray, "h w"], views: int, texels: Texels) -> Overlay:
    """How many of the views see each texel."""
    share = np.sqrt(seen / max(views, 1)).astype(np.float32)
    picture = layer(viridis(share), np.full(share.shape, OPACITY, np.float32), texels)
    return Overlay("coverage", picture, f"dark blue: no view sees it; yellow: all {views} do")


def confidence(values: Float[np.ndarray, "h w"], texels: Texels) -> Overlay:
    """How well the references determine each texel, 0..1."""
    picture = layer(viridis(values), np.full(values.shape, OPACITY, np.float32), texels)
    return Overlay("confidence", picture, "dark blue: the pictures say nothing of it; yellow: they determine it well")


def struggle(total: Float[np.ndarray, "h w"], looks: Float[np.ndarray, "h w"], texels: Texels) -> Overlay | None:
    """The mean |gradient| of a look in the last steps of the fit's albedo phase; None where that phase did not run."""
    looked = texels.covered & (looks > 0)
    if not looked.any():
        return None
    # Single texels' gradients are noise: what lies around them is told, as for the repair (stages/inpaint.py).
    total, looks = (gaussian(np.where(looked, a, 0).astype(np.float32), 0.002 * len(total)) for a in (total, looks))
    least = 0.25 * float(np.median(looks[looked]))
    mean = np.where(looked, total / np.maximum(looks, least), 0)
    low, high = np.quantile(mean[looked], [0.5, HIGHEST])
    share = np.clip((mean - low) / max(float(high - low), 1e-20), 0, 1).astype(np.float32)
    colours = np.stack([np.ones_like(share), 0.75 * (1 - share), np.zeros_like(share)], axis=-1)
    legend = "clear: settled like most; yellow to red: the fit kept pulling at its colour"
    return Overlay("struggle", layer(colours, OPACITY * np.sqrt(share), texels), legend)


def repaired(mask: Bool[np.ndarray, "h w"], texels: Texels) -> Overlay:
    """Which texels were painted again after the fit."""
    colours = np.broadcast_to(np.array(MAGENTA, np.float32), (*mask.shape, 3))
    picture = layer(np.ascontiguousarray(colours), 0.65 * mask.astype(np.float32), texels)
    return Overlay("repaired", picture, "magenta: painted again after the fit (masks/ has it as a picture to edit)")
