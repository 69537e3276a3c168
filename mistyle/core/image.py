"""Pictures as float32 arrays: colour encoding, resampling, masks.

Pixel coordinates are (x, y) with pixel centres at +0.5, as for cameras. OpenCV is used for plain filters only; its
`remap` rounds coordinates to 1/32 pixel, so fetches are written out here.
"""

from collections.abc import Sequence
from typing import Literal

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int

REC709_LUMINANCE = np.array([0.2126, 0.7152, 0.0722], np.float32)


def srgb_from_linear(linear: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    """The sRGB transfer function (IEC 61966-2-1), linear 0..1 to encoded 0..1; values outside are clipped."""
    x = np.clip(linear, 0.0, 1.0)
    curve = 1.055 * np.power(np.maximum(x, 0.0031308), 1 / 2.4) - 0.055
    return np.where(x <= 0.0031308, 12.92 * x, curve).astype(np.float32)


def linear_from_srgb(encoded: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    """The inverse of `srgb_from_linear`; values outside 0..1 are clipped."""
    x = np.clip(encoded, 0.0, 1.0)
    return np.where(x <= 0.04045, x / 12.92, np.power((np.maximum(x, 0.04045) + 0.055) / 1.055, 2.4)).astype(np.float32)


def luminance(linear: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n"]:
    """Relative luminance of linear Rec.709."""
    return linear @ REC709_LUMINANCE


def bilinear(
    image: Float[np.ndarray, "h w *c"], px: Float[np.ndarray, "n 2"], edge: Literal["clamp", "repeat"] = "clamp"
) -> Float[np.ndarray, " n *c"]:
    """Values of `image` at pixel coordinates `px`; beyond the border its edge is extended or the image repeats."""
    height, width = image.shape[:2]
    low = np.floor(px - 0.5)
    tx, ty = ((px - 0.5) - low).astype(np.float32).T
    x, y = low.astype(np.int64).T
    flat = image.reshape(height * width, -1)
    result = np.zeros((len(px), flat.shape[1]), np.float32)
    for dy, wy in ((0, 1 - ty), (1, ty)):
        row = (y + dy) % height if edge == "repeat" else np.clip(y + dy, 0, height - 1)
        for dx, wx in ((0, 1 - tx), (1, tx)):
            column = (x + dx) % width if edge == "repeat" else np.clip(x + dx, 0, width - 1)
            result += flat.take(row * width + column, axis=0) * (wx * wy)[:, None]
    return result.reshape(len(px), *image.shape[2:])


def resize(
    image: Float[np.ndarray, "h w *c"], size: tuple[int, int], edge: Literal["clamp", "repeat"] = "clamp"
) -> Float[np.ndarray, "H W *c"]:
    """Resample to `size` (height, width): the mean over each new pixel's area where the picture shrinks along both
    sides, else bilinear; `edge` sets the values beyond the border."""
    if image.shape[:2] == size:
        return image.astype(np.float32, copy=True)
    if size[0] <= image.shape[0] and size[1] <= image.shape[1]:
        small = cv2.resize(image.astype(np.float32, copy=False), (size[1], size[0]), interpolation=cv2.INTER_AREA)
        return small.reshape(*size, *image.shape[2:])
    return resized_rows(image, size, slice(0, size[0]), edge)


def resized_rows(
    image: Float[np.ndarray, "h w *c"], size: tuple[int, int], rows: slice, edge: Literal["clamp", "repeat"] = "clamp"
) -> Float[np.ndarray, "H W *c"]:
    """`resize(image, size, edge)[rows]` without the rest; not for sizes that shrink the picture along both sides."""
    if image.shape[:2] == size:
        return image[rows].astype(np.float32, copy=True)
    return _stretch(_stretch(image.astype(np.float32), 0, size[0], edge, rows), 1, size[1], edge)


def _stretch(image: np.ndarray, axis: int, count: int, edge: str, part: slice = slice(None)) -> np.ndarray:
    """Linear interpolation along one axis to `count` pixels; computes only `part` of them."""
    size = image.shape[axis]
    x = (np.arange(count)[part] + 0.5) * size / count - 0.5
    low = np.floor(x).astype(np.int64)
    shape = [1] * image.ndim
    shape[axis] = len(x)
    t = (x - low).astype(np.float32).reshape(shape)
    first, second = (k % size if edge == "repeat" else np.clip(k, 0, size - 1) for k in (low, low + 1))
    result, rest = image.take(first, axis=axis), image.take(second, axis=axis)
    result *= 1 - t
    rest *= t
    result += rest
    return result


def gaussian(image: Float[np.ndarray, "h w *c"], sigma: float) -> Float[np.ndarray, "h w *c"]:
    """Gaussian blur with standard deviation `sigma` in pixels, cut off at 3 sigma, mirrored at the border."""
    if sigma <= 0:
        return image.astype(np.float32, copy=True)
    side = 2 * max(1, round(3 * sigma)) + 1
    blurred = cv2.GaussianBlur(image.astype(np.float32), (side, side), sigma, borderType=cv2.BORDER_REFLECT_101)
    return blurred.reshape(image.shape)


def dilate(mask: Bool[np.ndarray, "h w"], radius: int) -> Bool[np.ndarray, "h w"]:
    """Max-pooling over a window of 2 radius + 1 pixels; nothing lies beyond the border."""
    if radius <= 0:
        return mask.copy()
    return cv2.dilate(mask.view(np.uint8), _window(radius), borderValue=0) > 0


def erode(mask: Bool[np.ndarray, "h w"], radius: int) -> Bool[np.ndarray, "h w"]:
    """Min-pooling over a window of 2 radius + 1 pixels; the border itself does not eat into the mask."""
    if radius <= 0:
        return mask.copy()
    return cv2.erode(mask.view(np.uint8), _window(radius), borderValue=1) > 0


def dilate_within(mask: Bool[np.ndarray, "h w"], label: Int[np.ndarray, "h w"], radius: int) -> Bool[np.ndarray, "h w"]:
    """`dilate` that stays inside regions: a pixel joins when a mask pixel of its own label (>= 0) is in its window.

    The window's highest and lowest masked labels are compared; a third label between them in one window is missed.
    """
    if radius <= 0:
        return mask & (label >= 0)
    own = label.astype(np.float32)  # exact below 2^24 labels
    masked = mask & (label >= 0)
    highest = cv2.dilate(np.where(masked, own, -2).astype(np.float32), _window(radius), borderValue=-2)
    lowest = cv2.erode(np.where(masked, own, 2**25).astype(np.float32), _window(radius), borderValue=2**25)
    return (label >= 0) & ((highest == own) | (lowest == own))


def _window(radius: int) -> np.ndarray:
    return np.ones((2 * radius + 1, 2 * radius + 1), np.uint8)


def nearest(valid: Bool[np.ndarray, "h w"]) -> tuple[Int[np.ndarray, "h w"], Float[np.ndarray, "h w"]]:
    """Flat index of (about) the nearest valid pixel of every pixel, and its distance in pixels; itself where valid.

    A distance transform with a 5x5 chamfer: the pixel found is at most 4 % farther than the nearest one. At least one
    pixel must be valid.
    """
    if not valid.any():
        raise ValueError(f"no pixel of the {valid.shape} mask is valid, so none has a nearest valid one")
    holes = (~valid).view(np.uint8)
    distance, label = cv2.distanceTransformWithLabels(holes, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
    labels, flat = np.asarray(label, np.int32).reshape(-1), valid.reshape(-1)
    table = np.zeros(int(labels.max()) + 1, np.int32)
    for start in range(0, len(flat), 2**20):  # in pieces, since indices are eight times as large as the mask
        seeds = start + np.flatnonzero(flat[start : start + 2**20])
        table[labels[seeds]] = seeds
    table.take(labels, out=labels, mode="clip")
    return labels.reshape(valid.shape), np.asarray(distance, np.float32)


def nearest_fill(values: Float[np.ndarray, "h w *c"], valid: Bool[np.ndarray, "h w"]) -> Float[np.ndarray, "h w *c"]:
    """Every invalid pixel takes the value of the nearest valid one; unchanged where no pixel is valid."""
    result = values.copy()
    nearest_fill_in_place([result], valid)
    return result


def nearest_fill_in_place(maps: Sequence[np.ndarray], valid: Bool[np.ndarray, "h w"]) -> None:
    """`nearest_fill` for several maps (h w *c) of one size, written into them."""
    if not maps or valid.all() or not valid.any():
        return
    index = nearest(valid)[0].reshape(-1)
    flat = valid.reshape(-1)
    for values in maps:
        rows = values.reshape(valid.size, -1)
        for start in range(0, valid.size, 2**20):  # in pieces, since indices are eight times as large as the mask
            holes = start + np.flatnonzero(~flat[start : start + 2**20])
            rows[holes] = rows.take(index[holes], axis=0)


def distance_to(mask: Bool[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    """Distance of every pixel's centre to that of the nearest mask pixel, in pixels; infinite where there is none."""
    if not mask.any():
        return np.full(mask.shape, np.inf, np.float32)
    # Intel's version chooses its square root by the result's memory alignment: its last bit varies.
    used = cv2.ipp.useIPP()
    cv2.ipp.setUseIPP(False)  # of this thread only
    try:
        return np.asarray(cv2.distanceTransform((~mask).view(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE), np.float32)
    finally:
        cv2.ipp.setUseIPP(used)


def match_histogram(
    values: Float[np.ndarray, "n c"], target: Float[np.ndarray, "m c"], strength: float = 1.0, knots: int = 1024
) -> Float[np.ndarray, "n c"]:
    """Values moved, channel by channel, until their distribution is that of `target`; `strength` 0 leaves them alone.

    A monotone map through `knots` quantiles; equal values stay equal (a single one goes to the target's mean). Empty
    sets change nothing.
    """
    if len(values) == 0 or len(target) == 0 or strength == 0:
        return values.copy()
    share = np.linspace(0, 1, knots)
    result = values.astype(np.float32, copy=True)
    for channel in range(values.shape[1]):
        levels, which = np.unique(np.quantile(values[:, channel], share), return_inverse=True)
        target_levels = np.bincount(which, np.quantile(target[:, channel], share)) / np.bincount(which)
        moved = np.interp(values[:, channel], levels, target_levels)
        result[:, channel] += np.float32(strength) * (moved.astype(np.float32) - result[:, channel])
    return result


def overlap(a: Bool[np.ndarray, "h w"], b: Bool[np.ndarray, "h w"]) -> float:
    """Intersection over union of two masks; 1 where both are empty."""
    either = int((a | b).sum())
    return int((a & b).sum()) / either if either else 1.0


def canny(encoded: Float[np.ndarray, "h w 3"], low: float = 100, high: float = 200) -> Bool[np.ndarray, "h w"]:
    """Canny edges of the 8-bit grey picture, thresholds 100 and 200 as in the paper's 4.1.1; `encoded` is sRGB 0..1."""
    grey = cv2.cvtColor(np.round(np.clip(encoded, 0, 1) * 255).astype(np.uint8), cv2.COLOR_RGB2GRAY)
    return cv2.Canny(grey, low, high) > 0
