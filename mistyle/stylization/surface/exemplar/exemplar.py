"""Exemplar of the synthesis: the painting in four quarter turns, each pixel with colour, patch and guides."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int

from mistyle.core.errors import InputRefused
from mistyle.core.image import erode, nearest_fill
from mistyle.stylization.surface import kernels

LONGEST = 2048  # largest long side, pixels
SLIMMEST = 3  # largest aspect ratio; slimmer pictures are repeated by mirroring
BROAD = 1 / 48  # blur that leaves only the large areas of colour, in long sides
FORM = 0.12  # of BROAD: blur that keeps the form in the strokes
BASIS_PATCHES = 10_000
PALETTE_SIZE = 256
PALETTE_COLOURS = 20_000
TWO_TONED = 0.95  # between-class share of the variance of lightness from which a painting has two tones only
RARITY_CELL = 0.05  # Lab / 100
Crop = tuple[float, float, float, float]  # top, left, bottom, right, in shares of the height or width
Box = tuple[float, float, float, float]  # top, left, bottom, right, in shares of the height or width
UNCROPPED: Crop = (0.0, 0.0, 0.0, 0.0)
RAREST = 0.01  # share of the most common colour's pixels below which rarity does not grow


@dataclass(frozen=True)
class StyleImage:
    """A style picture: encoded sRGB 0..1, and the mask of its usable pixels."""

    rgb: Float[np.ndarray, "h w 3"]
    opaque: Bool[np.ndarray, "h w"]


@dataclass(frozen=True)
class Exemplar:
    """A painting at one size; flat arrays run over the pages one after another, row by row.

    lab     CIE Lab / 100            broad   the same, blurred: the large areas of colour
    grain   (cos 2t, sin 2t) times 0..1, t being the direction of the strokes from the x axis
    band    lightness of middle-sized strokes, around 0
    origin  index of the pixel in the unturned page
    target_use  desired use of each of those pixels, 1 on average
    allowed whether a whole opaque 5x5 patch fits there
    """

    size: tuple[int, int]
    shapes: Int[np.ndarray, "4 2"]
    starts: Int[np.ndarray, " 4"]
    lab: Float[np.ndarray, "m 3"]
    broad: Float[np.ndarray, "m 3"]
    grain: Float[np.ndarray, "m 2"]
    band: Float[np.ndarray, " m"]
    origin: Int[np.ndarray, " m"]
    allowed: Bool[np.ndarray, " m"]
    target_use: Float[np.ndarray, " k"]


@dataclass(frozen=True)
class Basis:
    """Principal components of the painting's patches: (patch - mean) . axes. Order: grid position, channel."""

    mean: Float[np.ndarray, " 75"]
    axes: Float[np.ndarray, "75 16"]


def lab_from_srgb(rgb: Float[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h w 3"]:
    """CIE Lab (D65) divided by 100 from encoded sRGB 0..1."""
    return cv2.cvtColor(np.ascontiguousarray(rgb, np.float32), cv2.COLOR_RGB2Lab) / np.float32(100)


def lightened(rgb: Float[np.ndarray, "n 3"], by: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n 3"]:
    """Encoded sRGB with `by` added to its lightness (Lab / 100), clipped to the sRGB gamut."""
    lab = lab_from_srgb(rgb[None])[0]
    lab[:, 0] = np.clip(lab[:, 0] + by, 0, 1)
    return np.clip(cv2.cvtColor(lab[None] * np.float32(100), cv2.COLOR_Lab2RGB)[0], 0, 1)


def inside(shape: tuple[int, ...], crop: Crop) -> tuple[slice, slice]:
    """The remaining rows and columns after a crop; at least one of each."""
    spans = []
    for axis in (0, 1):
        first, last = int(shape[axis] * crop[axis]), shape[axis] - int(shape[axis] * crop[axis + 2])
        spans.append(slice(first, max(last, first + 1)))
    return spans[0], spans[1]


def filled(
    rgb: Float[np.ndarray, "h w 3"], alpha: Float[np.ndarray, "h w"] | None
) -> tuple[Float[np.ndarray, "h w 3"], Bool[np.ndarray, "h w"]]:
    """The picture within 0..1, transparent pixels in the colour of the nearest opaque one, and the opaque mask."""
    size = f"the style picture ({rgb.shape[1]} x {rgb.shape[0]})"
    if rgb.size == 0 or not np.isfinite(rgb).all():
        raise InputRefused(f"{size} is empty or has NaN or infinite values; use another one")
    picture = np.clip(rgb, 0, 1).astype(np.float32)
    opaque = np.ones(picture.shape[:2], bool) if alpha is None else alpha > 0.5
    if not opaque.any():
        raise InputRefused(f"{size} is transparent everywhere; a picture with opaque parts is needed")
    return (picture if opaque.all() else nearest_fill(picture, opaque)), opaque


def prepare(
    rgb: Float[np.ndarray, "h w 3"], crop: Crop = UNCROPPED, alpha: Float[np.ndarray, "h w"] | None = None
) -> StyleImage:
    """Prepare a painting for synthesis: cropped (shares at the top, left, bottom, right), at most 2048 px long, at
    least 8 px and a third of its length wide.

    Transparent pixels take the colour of the nearest opaque one. Raises InputRefused without any usable pixel.
    """
    window = inside(rgb.shape, crop)
    picture, opaque = filled(rgb[window], None if alpha is None else alpha[window])
    long = max(picture.shape[:2])
    if long > LONGEST:
        size = long_side(picture.shape[:2], LONGEST)
        picture, opaque = resized(picture, size), resized(opaque.astype(np.float32), size) > 0.99
    for axis in (0, 1):
        while picture.shape[axis] < max(8, picture.shape[1 - axis] / SLIMMEST):
            picture = np.concatenate([picture, np.flip(picture, axis)], axis=axis)
            opaque = np.concatenate([opaque, np.flip(opaque, axis)], axis=axis)
    return StyleImage(np.ascontiguousarray(picture), opaque)


def without(
    alpha: Float[np.ndarray, "h w"] | None, shape: tuple[int, ...], boxes: Sequence[Box]
) -> Float[np.ndarray, "h w"] | None:
    """The alpha of a picture of `shape` with `boxes` transparent."""
    if not boxes:
        return alpha
    height, width = shape[:2]
    left_out = np.ones((height, width), np.float32) if alpha is None else alpha.copy()
    for top, left, bottom, right in boxes:
        rows = slice(int(top * height), int(np.ceil(bottom * height)))
        left_out[rows, int(left * width) : int(np.ceil(right * width))] = 0
    return left_out


def long_side(shape: tuple[int, ...], long: float) -> tuple[int, int]:
    """(height, width) scaled so that the longer is `long`, neither under 8."""
    factor = long / max(shape[:2])
    return max(8, round(shape[0] * factor)), max(8, round(shape[1] * factor))


def resized(picture: Float[np.ndarray, "h w *c"], size: tuple[int, int]) -> Float[np.ndarray, "h2 w2 *c"]:
    """A picture at another size: area average when smaller, bilinear when larger (no new extreme colours)."""
    smaller = size[0] < picture.shape[0]
    return cv2.resize(picture, size[::-1], interpolation=cv2.INTER_AREA if smaller else cv2.INTER_LINEAR)


def blurred(picture: np.ndarray, sigma: float) -> np.ndarray:
    """Gaussian blur in pixels, edges repeated."""
    return cv2.GaussianBlur(picture, (0, 0), max(sigma, 0.3), borderType=cv2.BORDER_REPLICATE)


def for_bilinear(picture: np.ndarray) -> np.ndarray:
    """Prefilter that compensates the blur of bilinear look-ups; edges repeated.

    The quasi-interpolation [-1/12, 7/6, -1/12] of Condat, Blu and Unser (Beyond interpolation: optimal reconstruction
    by quasi-interpolation, ICIP 2005): look-ups between pixels blur by a variance of 1/6 on average. Edges overshoot by
    a twelfth of their step along each axis.
    """
    kernel = np.array([-1, 14, -1]) / 12
    return cv2.sepFilter2D(picture, -1, kernel, kernel, borderType=cv2.BORDER_REPLICATE)


def grain(lightness: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w 2"]:
    """Direction of strokes from the structure tensor: (cos 2t, sin 2t) times its anisotropy."""
    base = blurred(lightness, 0.8)
    gx, gy = cv2.Scharr(base, cv2.CV_32F, 1, 0) / 32, cv2.Scharr(base, cv2.CV_32F, 0, 1) / 32
    reach = max(1.5, max(lightness.shape) / 128)
    xx, yy, xy = (blurred(v, reach) for v in (gx * gx, gy * gy, gx * gy))
    # The gradient's doubled angle is (xx - yy, 2 xy); strokes run across the gradient, which negates both.
    # The constant suppresses directions in flat areas, where the gradient is rounding and paper grain.
    return np.stack([yy - xx, -2 * xy], axis=2) / (xx + yy + 1e-5)[..., None]


def exemplar(painting: StyleImage, long: float, liveliness: float, mix: float = 0.0) -> Exemplar:
    """The painting with its longer side at `long` pixels, in four quarter turns; the rest as in `palette`."""
    size = long_side(painting.opaque.shape, long)
    lab = lab_from_srgb(resized(painting.rgb, size))
    height, width = lab.shape[:2]
    sigma = max(0.6, max(height, width) * BROAD)
    broad = blurred(lab, sigma)
    band = blurred(lab[..., 0], max(0.6, FORM * sigma)) - broad[..., 0]
    rim = kernels.BORDER
    inner = np.zeros((height, width), bool)
    inner[rim:-rim, rim:-rim] = True
    opaque = inner & erode(resized(painting.opaque.astype(np.float32), size) > 0.99, rim)
    origin = np.arange(height * width).reshape(height, width)
    direction = grain(lab[..., 0])

    def turned(image: np.ndarray) -> np.ndarray:
        return np.concatenate([np.rot90(image, k).reshape(-1, *image.shape[2:]) for k in range(kernels.PAGES)])

    # A quarter turn adds 90 degrees to every direction and 180 to its double.
    sign = np.repeat(np.array([1, -1, 1, -1], np.float32), height * width)[:, None]
    return Exemplar(
        size=(height, width),
        shapes=np.array([(height, width), (width, height)] * 2),
        starts=np.arange(4) * height * width,
        lab=turned(lab),
        broad=turned(broad),
        grain=turned(direction) * sign,
        band=turned(band),
        origin=turned(origin),
        # If nothing is opaque at this size, use transparent pixels (filled from their neighbours).
        allowed=turned(opaque if opaque.any() else inner),
        target_use=(demand(lab, broad, sigma, liveliness) * rarity(broad, mix)).reshape(-1),
    )


def page(exemplar: Exemplar, values: np.ndarray, k: int) -> np.ndarray:
    """Page k of a flat array as an image."""
    height, width = exemplar.shapes[k]
    return values[exemplar.starts[k] : exemplar.starts[k] + height * width].reshape(height, width, *values.shape[1:])


def patch_basis(exemplar: Exemplar, rng: np.random.Generator) -> Basis:
    """The 16 leading principal components of the painting's patches."""
    chosen = np.flatnonzero(exemplar.allowed)
    chosen = np.sort(rng.choice(chosen, min(BASIS_PATCHES, len(chosen)), replace=False, shuffle=False))
    sample = []
    for k in range(kernels.PAGES):
        height, width = exemplar.shapes[k]
        pixel = (
            chosen[(chosen >= exemplar.starts[k]) & (chosen < exemplar.starts[k] + height * width)] - exemplar.starts[k]
        )
        row, column = pixel // width, pixel % width
        lab = page(exemplar, exemplar.lab, k)
        sample.append(np.stack([lab[row + dy, column + dx] for dy in range(-2, 3) for dx in range(-2, 3)], axis=1))
    patches = np.concatenate(sample).reshape(-1, 75).astype(np.float64)
    mean = patches.mean(axis=0)
    axes = np.linalg.eigh((patches - mean).T @ (patches - mean))[1][:, ::-1][:, : kernels.PATCH]
    return Basis(mean.astype(np.float32), np.ascontiguousarray(axes, np.float32))


def middle_tones(lightness: Float[np.ndarray, "..."]) -> float:
    """0 for a picture of one or two tones, 1 for one with middle tones.

    Uses the share of the variance of lightness that the best single threshold explains (Otsu 1979): 1 for two values,
    0.75 for a uniform distribution.
    """
    values = np.sort(lightness.reshape(-1).astype(np.float64))
    values = values[:: max(len(values) // 4096, 1)]
    variance = values.var()
    if variance < 1e-6:
        return 0.0
    count = np.arange(1, len(values))
    low = np.cumsum(values)[:-1]
    between = (low * len(values) - values.sum() * count) ** 2 / (count * (len(values) - count)) / len(values) ** 2
    return float(np.clip((TWO_TONED - between.max() / variance) / 0.15, 0, 1))


def demand(
    lab: Float[np.ndarray, "h w 3"], broad: Float[np.ndarray, "h w 3"], sigma: float, liveliness: float
) -> Float[np.ndarray, "h w"]:
    """Target use of each part of the painting, 1 on average: uniform, or (liveliness 1) by its contrast."""
    busy = np.sqrt(blurred(((lab - broad) ** 2).sum(axis=2), sigma))
    return (1 - liveliness) + liveliness * busy / max(float(busy.mean()), 1e-6)


def rarity(colours: Float[np.ndarray, "*n 3"], mix: float) -> Float[np.ndarray, "*n"]:
    """Weights that favour pixels of rare colours: the pixel count of a pixel's cell in Lab space, to the power -mix.

    Cells are RARITY_CELL wide and blurred, so that similar colours count too. With mix 1 every cell that is not nearly
    empty has the same total. 1 on average.
    """
    if mix == 0:
        return np.ones(colours.shape[:-1], np.float32)
    bins = round(1.5 / RARITY_CELL)
    cell = np.clip((colours.reshape(-1, 3) + np.array([0.25, 0.75, 0.75])) / RARITY_CELL, 0, bins - 1).astype(np.int64)
    flat = (cell[:, 0] * bins + cell[:, 1]) * bins + cell[:, 2]
    count = np.bincount(flat, minlength=bins**3).reshape(bins, bins, bins).astype(np.float64)
    for axis in range(3):
        count = (np.roll(count, 1, axis) + 2 * count + np.roll(count, -1, axis)) / 4
    common = count.reshape(-1)[flat]
    weight = np.maximum(common, common.max() * RAREST) ** -mix
    return (weight / weight.mean()).reshape(colours.shape[:-1]).astype(np.float32)


def palette(
    painting: StyleImage, liveliness: float, rng: np.random.Generator, mix: float = 0.0
) -> Float[np.ndarray, "n 3"]:
    """Large-area colours (Lab / 100) in the surface's target proportions.

    `liveliness` 0 uses the painting's proportions, 1 weights colours by local contrast: a large empty sky or paper
    ground then no longer fills the surface. `mix` as in `rarity`.
    """
    size = long_side(painting.opaque.shape, PALETTE_SIZE)
    small = lab_from_srgb(resized(painting.rgb, size))
    sigma = max(0.6, max(small.shape[:2]) * BROAD)
    broad = blurred(small, sigma)
    # Above zero, so that a picture with a single opaque pixel still has a palette.
    opaque = np.maximum(resized(painting.opaque.astype(np.float32), size), 1e-6)
    weight = demand(small, broad, sigma, liveliness) * opaque * rarity(broad, mix)
    share = np.cumsum(weight.reshape(-1).astype(np.float64))
    at = (np.arange(PALETTE_COLOURS) + rng.random(PALETTE_COLOURS)) / PALETTE_COLOURS * share[-1]
    return broad.reshape(-1, 3)[np.minimum(np.searchsorted(share, at), len(share) - 1)]
