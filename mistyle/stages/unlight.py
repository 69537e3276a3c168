"""Light that a stylizer painted into its views, divided out as far as the known shading explains it.

A network that paints from rendered views paints lit objects. The light of those views is known, and with it the
shading of the bare shape. How much of it a view shows is measured: the slope of the view's log luminance over the
shading's, both blurred until strokes are gone, and what share of the view it explains. A picture without light has a
slope about zero and stays as it is; no more than the shading itself is ever taken away.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from mistyle.core.image import erode, gaussian, luminance
from mistyle.core.view import View

STROKE = 1 / 48  # of the picture's width: the blur under which strokes are lost and the form's shading stays
NOISE = 1 / 512  # of its width: the blur that takes the noise of few samples from the shading
BOUND = 4.0  # largest factor by which a pixel is made brighter or darker
LEAST = 0.02  # of the brightest: darker shading and darker paint say nothing of each other
CHANCE = 0.2  # correlation that a painting may have with a shading by chance


def share(view: View, shading: Float[np.ndarray, "h w"], largest: float = 1.0) -> float:
    """The exponent of the shading that a view shows, 0..`largest`; `shading` is the luminance of the bare shape under
    the view's light, multiplied by coverage as `view.rgb` is."""
    width = view.mask.shape[1]
    inside = erode(view.mask & (view.coverage > 0.99) & np.isfinite(view.rgb).all(axis=-1), 1)
    seen = luminance(np.nan_to_num(view.rgb))
    if inside.sum() < 16 or seen[inside].max() <= 0 or shading[inside].max() <= 0:
        return 0.0
    logs = [_blurred(_log(plane, inside), inside, STROKE * width) for plane in (shading, seen)]
    x, y = (values[inside] - values[inside].mean() for values in logs)
    spread, other = float(x @ x), float(y @ y)
    if spread <= 1e-6 * len(x) or other <= 1e-6 * len(x):
        return 0.0
    correlation = float(x @ y) / np.sqrt(spread * other)
    certain = np.clip((correlation - CHANCE) / CHANCE, 0, 1)
    return float(certain * np.clip(x @ y / spread, 0, largest))


def gain(view: View, shading: Float[np.ndarray, "h w"], exponent: float) -> Float[np.ndarray, "h w"]:
    """The factor that takes a share of the shading out of a view and leaves its mean lightness; 1 off the mesh."""
    if exponent == 0:
        return np.ones(view.mask.shape, np.float32)
    logs = _blurred(_log(shading, view.mask), view.mask, NOISE * view.mask.shape[1])
    factor = np.exp(-exponent * (logs - logs[view.mask].mean()))
    return np.where(view.mask, np.clip(factor, 1 / BOUND, BOUND), 1).astype(np.float32)


def unlit(views: Sequence[View], gains: Sequence[Float[np.ndarray, "h w"]]) -> list[View]:
    """The views without the light that was found in them."""
    return [replace(v, rgb=(v.rgb * g[..., None]).astype(np.float32)) for v, g in zip(views, gains, strict=True)]


def _log(plane: Float[np.ndarray, "h w"], inside: np.ndarray) -> Float[np.ndarray, "h w"]:
    return np.log(np.maximum(plane, LEAST * float(plane[inside].max()))).astype(np.float32)


def _blurred(plane: Float[np.ndarray, "h w"], inside: np.ndarray, sigma: float) -> Float[np.ndarray, "h w"]:
    """A mean over what is inside, about each pixel."""
    weight = inside.astype(np.float32)
    return gaussian(plane * weight, sigma) / np.maximum(gaussian(weight, sigma), 1e-3)
