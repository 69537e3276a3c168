"""Baked light in an albedo: dependence on the surface's direction and on its openness.

An albedo without baked light has the same mean above and below, and is not correlated with the normal or with ambient
occlusion. Pure functions of surface samples (texels, points), each with its area.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from mistyle.core.image import luminance

STEEP = 0.5  # a sample faces up if its normal's y is above this, and down if it is below the negative
DARKEST = 1e-3  # least linear luminance in the logarithm: slightly above the first step of 8-bit sRGB
LEAST_SHARE = 1e-3  # least share of the area that faces up, and down, for a ratio
LEAST_SPREAD = 1e-6  # standard deviation below which a quantity is constant and has correlation 0


@dataclass(frozen=True)
class BakedLight:
    """Indicators of baked light in an albedo.

    ratio       mean luminance facing up over mean luminance facing down; 1 without light from above. None if too little
                of the surface faces one of them
    x, y, z     correlation (-1..1) of log luminance with that axis of the normal
    openness    the same with the share of open sky
    """

    ratio: float | None
    x: float
    y: float
    z: float
    openness: float

    @property
    def strongest(self) -> float:
        """The largest absolute value of the four correlations."""
        return max(abs(value) for value in (self.x, self.y, self.z, self.openness))


def baked_light(
    albedo: Float[np.ndarray, "n 3"],
    normals: Float[np.ndarray, "n 3"],
    openness: Float[np.ndarray, " n"],
    area: Float[np.ndarray, " n"],
) -> BakedLight:
    """Light in an albedo (linear Rec.709) of samples with unit normals (Y up), openness 0..1 and area.

    Means and correlations are weighted by area. One painting may be darker on one side by chance; only the mean over
    many styles indicates baked light.
    """
    light = luminance(albedo).astype(np.float64)
    logarithm = np.log(np.maximum(light, DARKEST))
    x, y, z = (correlation(logarithm, normals[:, k], area) for k in range(3))
    return BakedLight(up_over_down(light, normals[:, 1], area), x, y, z, correlation(logarithm, openness, area))


def up_over_down(
    light: Float[np.ndarray, " n"], height: Float[np.ndarray, " n"], area: Float[np.ndarray, " n"]
) -> float | None:
    """Mean light where `height` (the normal's y) is above STEEP over the mean where it is below -STEEP.

    None where less than LEAST_SHARE of the area faces one of them.
    """
    weight = area.astype(np.float64)
    means = []
    for chosen in (height > STEEP, height < -STEEP):
        share = weight[chosen].sum()
        if share <= LEAST_SHARE * weight.sum():
            return None
        means.append(max(float((weight[chosen] * light[chosen]).sum() / share), DARKEST))
    return means[0] / means[1]


def correlation(a: Float[np.ndarray, " n"], b: Float[np.ndarray, " n"], weight: Float[np.ndarray, " n"]) -> float:
    """Pearson's correlation of two quantities under weights; 0 where one of them is constant."""
    share = weight.astype(np.float64) / max(float(weight.sum()), 1e-30)
    first, second = (values - (share * values).sum() for values in (a.astype(np.float64), b.astype(np.float64)))
    spreads = [float(np.sqrt((share * values**2).sum())) for values in (first, second)]
    if min(spreads) < LEAST_SPREAD:
        return 0.0
    return float(np.clip((share * first * second).sum() / (spreads[0] * spreads[1]), -1, 1))


def texel_areas(faces_of_texels: np.ndarray, face_areas: Float[np.ndarray, " f"]) -> Float[np.ndarray, " n"]:
    """The surface area of each texel (n; the face under it): a face's area divided among its texels.

    Faces too small for a texel are omitted.
    """
    count = np.bincount(faces_of_texels, minlength=len(face_areas))
    return (face_areas / np.maximum(count, 1))[faces_of_texels]
