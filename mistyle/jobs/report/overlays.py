"""Overlays on the maps of a texture set in the report: coverage, confidence, struggle and repair.

Every overlay is at most `longest` pixels wide and high; its source arrays may be much larger.
"""

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from mistyle.core.image import gaussian, resize
from mistyle.core.maps import Texels
from mistyle.jobs.report.page import Overlay
from mistyle.jobs.report.pictures import in_bands

OPACITY = 0.8
MAGENTA = (1.0, 0.0, 0.8)
# The struggle overlay shows the range from the median to this quantile of the texels.
HIGHEST = 0.99


def viridis(share: Float[np.ndarray, "h w"]) -> UInt8[np.ndarray, "h w 3"]:
    """0..1 as sRGB colours from dark blue to yellow."""
    import cv2

    levels = np.clip(np.nan_to_num(share) * 255, 0, 255).astype(np.uint8)
    return np.ascontiguousarray(cv2.applyColorMap(levels, cv2.COLORMAP_VIRIDIS)[..., ::-1])


def layer(
    rgb: Float[np.ndarray, "h w 3"] | UInt8[np.ndarray, "h w 3"],
    alpha: Float[np.ndarray, "h w"],
    covered: Bool[np.ndarray, "h w"],
) -> UInt8[np.ndarray, "h w 4"]:
    """Colours (0..1 or 8 bits) and opacity as a picture that is transparent where nothing is covered."""
    colours = rgb if rgb.dtype == np.uint8 else np.round(np.clip(rgb, 0, 1) * 255).astype(np.uint8)
    opacity = np.round(np.where(covered, np.clip(alpha, 0, 1), 0) * 255).astype(np.uint8)
    return np.concatenate([colours, opacity[..., None]], axis=-1)


def coverage(seen: Int[np.ndarray, "h w"], views: int, texels: Texels, longest: int) -> Overlay:
    """The number of views that see each texel."""

    def rows(at: slice) -> np.ndarray:
        share = np.sqrt(seen[at] / max(views, 1)).astype(np.float32)
        return layer(viridis(share), np.full(share.shape, OPACITY, np.float32), texels.covered[at])

    picture = in_bands(seen.shape[:2], rows, longest, sharp=True)
    return Overlay("coverage", picture, f"dark blue: no view sees it; yellow: all {views} do")


def confidence(values: Float[np.ndarray, "h w"], texels: Texels, longest: int) -> Overlay:
    """The confidence of each texel, 0 undetermined to 1."""

    def rows(at: slice) -> np.ndarray:
        share = values[at]
        return layer(viridis(share), np.full(share.shape, OPACITY, np.float32), texels.covered[at])

    picture = in_bands(values.shape[:2], rows, longest, sharp=True)
    return Overlay("confidence", picture, "dark blue: undetermined by the pictures; yellow: well determined")


def struggle(
    total: Float[np.ndarray, "h w"], looks: Float[np.ndarray, "h w"], texels: Texels, longest: int
) -> Overlay | None:
    """The mean |gradient| per observation in the last steps of the fit's albedo phase; None without that phase."""
    total, looks, covered = _means(total, looks, texels.covered, longest)
    looked = covered & (looks > 0)
    if not looked.any():
        return None
    # Gradients of single texels are noise: the overlay shows their local mean, as the repair uses it
    # (stylization/inpaint/repair.py).
    total, looks = (gaussian(np.where(looked, a, 0).astype(np.float32), 0.002 * len(total)) for a in (total, looks))
    least = 0.25 * float(np.median(looks[looked]))
    mean = np.where(looked, total / np.maximum(looks, least), 0)
    low, high = np.quantile(mean[looked], [0.5, HIGHEST])
    share = np.clip((mean - low) / max(float(high - low), 1e-20), 0, 1).astype(np.float32)
    colours = np.stack([np.ones_like(share), 0.75 * (1 - share), np.zeros_like(share)], axis=-1)
    legend = "clear: converged as most; yellow to red: large albedo gradients at the end of the fit"
    alpha = OPACITY * np.sqrt(share)
    picture = in_bands(share.shape, lambda at: layer(colours[at], alpha[at], covered[at]), longest, sharp=True)
    return Overlay("struggle", picture, legend)


def _means(
    total: np.ndarray, looks: np.ndarray, covered: np.ndarray, longest: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """All three arrays as means over squares of texels; the grid has at least `longest` cells a side."""
    side, by = min(covered.shape), 1
    while side // (2 * by) >= longest and all(length % (2 * by) == 0 for length in covered.shape):
        by *= 2
    if by == 1:
        return total, looks, covered
    shape = (covered.shape[0] // by, covered.shape[1] // by)
    some = covered.reshape(shape[0], by, shape[1], by).any(axis=(1, 3))
    return resize(total, shape), resize(looks, shape), np.asarray(some)


def repaired(mask: Bool[np.ndarray, "h w"], texels: Texels, longest: int) -> Overlay:
    """The texels that were painted again after the fit."""

    def rows(at: slice) -> np.ndarray:
        share = mask[at].astype(np.float32)
        colours = np.broadcast_to(np.array(MAGENTA, np.float32), (*share.shape, 3))
        return layer(np.ascontiguousarray(colours), 0.65 * share, texels.covered[at])

    picture = in_bands(mask.shape, rows, longest, sharp=True)
    return Overlay("repaired", picture, "magenta: painted again after the fit (edit it in masks/)")
