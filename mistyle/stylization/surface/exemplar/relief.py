"""Estimated height and gloss of a painting: strokes are raised; cracks, grout and outlines are deep and dull.

A picture does not determine the thickness of its paint. This heuristic by lightness gives a first normal and roughness
map, which the fit refines.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float

from mistyle.stylization.surface.exemplar.exemplar import blurred, lab_from_srgb

FINE, BROAD = 1 / 700, 1 / 60  # range of stroke widths, in long sides of the painting
GROOVE = 1 / 80  # widest groove
STEADY = 0.02  # local contrast of lightness (Lab / 100) below which texture is paper grain
LEAST_SLOPE = 1e-3  # height per pixel below which a picture is flat: rounding
DULL, SHINY = 0.3, 0.12  # roughness added at a groove, and subtracted at a stroke's crest


@dataclass(frozen=True)
class Relief:
    """Per pixel of a painting: its height about a mean of 0 (pixels), the slope of that along x and y (root mean square
    1 together), and the offset of the roughness."""

    height: Float[np.ndarray, "h w"]
    slope: Float[np.ndarray, "h w 2"]
    dull: Float[np.ndarray, "h w"]


def height_and_grooves(painting: Float[np.ndarray, "h w 3"]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Height, groove strength (0..1) and crest strength (-1..1) of each pixel.

    A stroke's crest is lighter than its surroundings, in units of local contrast; a groove is a dark line narrower than
    GROOVE (a black top-hat).
    """
    long = max(painting.shape[:2])
    light = blurred(lab_from_srgb(painting)[..., 0], max(0.6, FINE * long))
    around = blurred(light, BROAD * long)
    contrast = np.sqrt(blurred((light - around) ** 2, BROAD * long)) + STEADY
    crest = np.tanh((light - around) / contrast).astype(np.float32)
    reach = 2 * max(1, round(GROOVE * long / 2)) + 1
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (reach, reach))
    hat = cv2.morphologyEx(light, cv2.MORPH_BLACKHAT, disc, borderType=cv2.BORDER_REPLICATE)
    groove = np.clip(hat / max(float(np.percentile(hat, 99)), 5 * STEADY), 0, 1).astype(np.float32)
    return 0.5 * crest - groove, groove, crest


def relief(painting: Float[np.ndarray, "h w 3"]) -> Relief:
    """Slopes and dullness of an encoded sRGB painting; zero slopes for a flat one."""
    height, groove, crest = height_and_grooves(painting)
    smooth = blurred(height, max(0.6, FINE * max(painting.shape[:2])))
    slope = np.stack([cv2.Scharr(smooth, cv2.CV_32F, 1, 0), cv2.Scharr(smooth, cv2.CV_32F, 0, 1)], axis=2) / 32
    size = float(np.sqrt((slope**2).sum(axis=2).mean()))
    size = max(size, LEAST_SLOPE)
    return Relief((smooth - smooth.mean()) / size, slope / size, DULL * groove - SHINY * crest)
