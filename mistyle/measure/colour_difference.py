"""CIELAB and CIE Delta E 2000, perceptual colour differences."""

import warnings

import numpy as np
from jaxtyping import Float

from mistyle.core.image import linear_from_srgb

XYZ_FROM_LINEAR = np.array(
    [[0.4123908, 0.3575843, 0.1804808], [0.2126390, 0.7151687, 0.0721923], [0.0193308, 0.1191948, 0.9505322]]
)
D65 = XYZ_FROM_LINEAR.sum(axis=1)


def delta_e(a: Float[np.ndarray, "*n 3"], b: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n"]:
    """CIE Delta E 2000 between CIELAB colours."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # it announces at import that matplotlib is not there
        from colour.difference import delta_E_CIE2000

    return np.asarray(delta_E_CIE2000(a, b), dtype=np.float64)


def lab(picture: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
    """CIELAB (L 0..100) of an sRGB picture, white D65."""
    xyz = linear_from_srgb(picture) @ XYZ_FROM_LINEAR.T / D65
    f = np.where(xyz > (6 / 29) ** 3, np.cbrt(xyz), xyz / (3 * (6 / 29) ** 2) + 4 / 29)
    return np.stack(
        [116 * f[..., 1] - 16, 500 * (f[..., 0] - f[..., 1]), 200 * (f[..., 1] - f[..., 2])], axis=-1
    ).astype(np.float32)
