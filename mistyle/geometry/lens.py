"""Lens distortion of photographs, and the equivalent pinhole camera with square pixels.

Brown's model as OpenCV, COLMAP and transforms.json write it. With x, y = tangents in the camera (x right, y down) and
r² = x² + y²,

    x' = x (1 + k1 r² + k2 r⁴ + k3 r⁶ + k4 r⁸) + 2 p1 x y + p2 (r² + 2 x²)
    y' = y (1 + k1 r² + k2 r⁴ + k3 r⁶ + k4 r⁸) + p1 (r² + 2 y²) + 2 p2 x y
    pixel = (fx x' + skew y' + cx, fy y' + cy)

in the pixel convention of core/camera.py. Metashape has k4 and skew, nerfstudio and RealityScan k4. The
model holds as far as its radial part rises; beyond, it folds back.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from mistyle.core.camera import pixel_centres
from mistyle.core.image import bilinear

# Focal lengths that differ by less than this share are equal: 0.02 pixels at the border of 4000.
SQUARE = 1e-5
ROWS = 256  # of a picture at a time, to bound the memory for the coordinates of 12 megapixels


@dataclass(frozen=True)
class Lens:
    """The map from tangents to a photograph's pixels: `focal` (x, y) and `centre` in pixels, `size` (height, width),
    `radial` k1 k2 k3, `k4` and `tangential` p1 p2 without unit, `skew` in pixels."""

    focal: tuple[float, float]
    centre: tuple[float, float]
    size: tuple[int, int]
    radial: tuple[float, float, float] = (0.0, 0.0, 0.0)
    tangential: tuple[float, float] = (0.0, 0.0)
    k4: float = 0.0
    skew: float = 0.0


def is_distorted(lens: Lens) -> bool:
    """Whether straight lines appear curved."""
    return any((*lens.radial, *lens.tangential, lens.k4))


def is_pinhole(lens: Lens) -> bool:
    """Whether core/camera.py's Camera describes the photograph: no distortion or skew, square pixels."""
    return not (is_distorted(lens) or lens.skew) and abs(lens.focal[0] - lens.focal[1]) <= SQUARE * lens.focal[0]


def pinhole(lens: Lens) -> tuple[float, tuple[float, float], tuple[int, int]]:
    """Focal length, centre and size of the pinhole camera that a photograph is resampled to.

    The longer focal length applies to both axes, so that no direction loses resolution; the field of view is that of
    the photograph without its distortion.
    """
    if is_pinhole(lens):
        return lens.focal[0], lens.centre, lens.size
    focal = max(lens.focal)
    wide, high = focal / lens.focal[0], focal / lens.focal[1]
    size = (max(1, round(lens.size[0] * high)), max(1, round(lens.size[1] * wide)))
    return focal, (lens.centre[0] * wide, lens.centre[1] * high), size


def distort(lens: Lens, tangents: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n 2"]:
    """Distorted tangents of tangents (x, y) of the camera; NaN beyond the radius where the radial part stops rising."""
    x, y = np.moveaxis(np.asarray(tangents, float), -1, 0)
    (k1, k2, k3), (p1, p2) = lens.radial, lens.tangential
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * (k3 + r2 * lens.k4)))
    across = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    down = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    return np.where((r2 < _reach(lens))[..., None], np.stack([across, down], axis=-1), np.nan)


def px_in_photograph(lens: Lens, px: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n 2"]:
    """Pixel coordinates in the photograph of pixel coordinates of its `pinhole`; NaN outside the model's valid
    radius."""
    focal, centre, _ = pinhole(lens)
    bent = distort(lens, (px - np.asarray(centre)) / focal)
    return bent * lens.focal + bent[..., 1:] * (lens.skew, 0.0) + np.asarray(lens.centre)


def resample(
    lens: Lens, picture: Float[np.ndarray, "h w c"], counts: Bool[np.ndarray, "h w"]
) -> tuple[Float[np.ndarray, "H W c"], Bool[np.ndarray, "H W"]]:
    """The photograph resampled to its `pinhole` (linear values, bilinear), and the mask of valid pixels.

    A pixel is valid when every pixel in its footprint is; pixels beyond the photograph are 0 and invalid. A photograph
    that needs no resampling is returned unchanged.
    """
    if is_pinhole(lens):
        return picture, counts
    size = pinhole(lens)[2]
    height, width = lens.size
    values = np.concatenate([np.where(counts[..., None], picture, 0), counts[..., None]], axis=-1).astype(np.float32)
    result = np.zeros((*size, values.shape[-1]), np.float32)
    for start in range(0, size[0], ROWS):
        rows = pixel_centres((min(ROWS, size[0] - start), size[1])) + np.array([0, start])
        px = px_in_photograph(lens, rows)
        with np.errstate(invalid="ignore"):
            inside = ((px >= 0) & (px <= [width, height])).all(axis=-1)
        result[start : start + ROWS][inside] = bilinear(values, px[inside])
    whole = result[..., -1] > 0.999  # the weights of four pixels add to 1 but for rounding
    return np.where(whole[..., None], result[..., :-1], 0), whole


def _reach(lens: Lens) -> float:
    """The square of the radius up to which r (1 + k1 r² + k2 r⁴ + k3 r⁶ + k4 r⁸) rises."""
    k1, k2, k3 = lens.radial
    roots = np.roots([9 * lens.k4, 7 * k3, 5 * k2, 3 * k1, 1.0])
    rising = [float(root.real) for root in roots if abs(root.imag) < 1e-9 * max(abs(root), 1) and root.real > 0]
    return min(rising, default=np.inf)
