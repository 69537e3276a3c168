"""Pictures as float32 arrays: colour encoding, resampling, masks."""

import numpy as np
from jaxtyping import Float

REC709_LUMINANCE = np.array([0.2126, 0.7152, 0.0722], np.float32)


def srgb_from_linear(linear: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    """The sRGB transfer function (IEC 61966-2-1), linear 0..1 to encoded 0..1; values outside are clipped."""
    x = np.clip(linear, 0.0, 1.0)
    return np.where(x <= 0.0031308, 12.92 * x, 1.055 * np.power(np.maximum(x, 0.0031308), 1 / 2.4) - 0.055).astype(np.float32)


def linear_from_srgb(encoded: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    """The inverse of `srgb_from_linear`; values outside 0..1 are clipped."""
    x = np.clip(encoded, 0.0, 1.0)
    return np.where(x <= 0.04045, x / 12.92, np.power((np.maximum(x, 0.04045) + 0.055) / 1.055, 2.4)).astype(np.float32)


def luminance(linear: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n"]:
    """Relative luminance of linear Rec.709."""
    return linear @ REC709_LUMINANCE
