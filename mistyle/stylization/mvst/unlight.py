"""Removal of painted light from stylized views, as far as the known shading explains it.

A network that paints from rendered views paints lit objects. The light of those views is known, and so is the shading
of the bare shape. The painted share of it is the regression slope of a view's log luminance on the shading's, and its
certainty is their correlation. Both are first blurred beyond stroke size, and lose their linear dependence on the
normal's height: painters lighten upward surfaces even without light. Views of one sweep depend on each other, so one
median over all views is used. Without correlation nothing is removed, and never more than the shading itself.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from mistyle.core.image import erode, gaussian, luminance
from mistyle.core.view import View

STROKE = 1 / 48  # of the picture's width: blur that removes strokes and keeps the form's shading
NOISE = 1 / 512  # of its width: blur that removes low-sample noise from the shading
BOUND = 4.0  # largest factor by which a pixel is made brighter or darker
LEAST = 0.02  # of the brightest: darker pixels are excluded from the regression
# Largest correlation with the shading of the embedded stylizer's paintings, which show no light (median over views,
# `python -m benchmarks.unlight`), and the correlation that counts as certain.
CHANCE, CERTAIN = 0.5, 0.65


def share(views: Sequence[View], shading: Sequence[Float[np.ndarray, "h w"]], largest: float = 1.0) -> float:
    """The exponent of the shading in the views, 0..`largest`; `shading` is the luminance of the bare shape under the
    views' light, premultiplied by coverage like `view.rgb`."""
    fits = [pair for pair in map(_together, views, shading) if pair is not None]
    if not fits:
        return 0.0
    slope, correlation = np.median(fits, axis=0)
    certain = np.clip((correlation - CHANCE) / (CERTAIN - CHANCE), 0, 1)
    return float(min(certain * np.clip(slope, 0, 1), largest))


def _together(view: View, shading: Float[np.ndarray, "h w"]) -> tuple[float, float] | None:
    """Slope and correlation of a view's log luminance with the shading's; None without enough pixels or contrast."""
    width = view.mask.shape[1]
    inside = erode(view.mask & (view.coverage > 0.99) & np.isfinite(view.rgb).all(axis=-1), 1)
    brightness = luminance(np.nan_to_num(view.rgb))
    if inside.sum() < 16 or brightness[inside].max() <= 0 or shading[inside].max() <= 0:
        return None
    planes = _log(shading, inside), _log(brightness, inside), view.normal[..., 1]
    bare, painted, upward = (blurred(p, inside, STROKE * width)[inside].astype(np.float64) for p in planes)
    form = np.stack([np.ones_like(upward), upward], axis=1)
    x, y = (values - form @ np.linalg.lstsq(form, values, rcond=None)[0] for values in (bare, painted))
    spread = float(x @ x)
    if min(spread, float(y @ y)) <= 1e-6 * len(x):
        return None
    return float(x @ y) / spread, float(x @ y) / float(np.sqrt(spread * (y @ y)))


def gain(view: View, shading: Float[np.ndarray, "h w"], exponent: float) -> Float[np.ndarray, "h w"]:
    """The factor that removes a share of the shading from a view and keeps its mean lightness; 1 off the mesh."""
    if exponent == 0:
        return np.ones(view.mask.shape, np.float32)
    logs = blurred(_log(shading, view.mask), view.mask, NOISE * view.mask.shape[1])
    factor = np.exp(-exponent * (logs - logs[view.mask].mean()))
    return np.where(view.mask, np.clip(factor, 1 / BOUND, BOUND), 1).astype(np.float32)


def unlit(views: Sequence[View], gains: Sequence[Float[np.ndarray, "h w"]]) -> list[View]:
    """The views multiplied by their gains."""
    return [replace(v, rgb=(v.rgb * g[..., None]).astype(np.float32)) for v, g in zip(views, gains, strict=True)]


def _log(plane: Float[np.ndarray, "h w"], inside: np.ndarray) -> Float[np.ndarray, "h w"]:
    return np.log(np.maximum(plane, LEAST * float(plane[inside].max()))).astype(np.float32)


def blurred(plane: Float[np.ndarray, "h w"], inside: np.ndarray, sigma: float) -> Float[np.ndarray, "h w"]:
    """Gaussian mean around each pixel over the pixels inside."""
    weight = inside.astype(np.float32)
    return gaussian(plane * weight, sigma) / np.maximum(gaussian(weight, sigma), 1e-3)
