"""Detection of titles, signatures and cartouches: blocks of letters on a calm ground near the picture's edge.

Letters are top-hats of the lightness, dark or light: strokes narrower than STROKE. Letters within REACH of one another
form a block. A block counts if it is small, lies near an edge, has several letters of similar size and clear contrast,
and if its ground and its surroundings are calm. Monograms of joined letters and lettering on a busy ground are missed.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int

from mistyle.stylization.surface.exemplar import exemplar as style

LONG = 1024  # pixels along the longer side
BLUR = 0.7  # pixels, against noise
STROKE = 0.024  # in long sides: strokes of letters are narrower
INK = 0.1  # least top-hat (Lab / 100) of ink
CLEAR = 0.15  # least mean top-hat of a block's ink
LEAST_LETTER, LARGEST_LETTER = 0.005, 0.16  # long sides; the largest are frames around letters
LEAST_INK = 8  # pixels of a letter
OUTSIDE = 0.2  # share of a component beyond the picture's border from which it belongs to the border
REACH = 0.012  # long sides
BLOCK = (0.02, 0.22)  # long sides: longer extent of a block
LARGEST_BLOCK = 0.03  # share of the picture
FEWEST = 3  # letters, and letters within a factor of two of the median size
NEAR = 0.12  # of the height or width: distance of a block from the nearest edge
CALM_AROUND, CALM_GROUND = 0.07, 0.06  # largest median deviation of lightness around a block and of its ground
GROUND_RANGE = 0.25  # largest difference of lightness within a block's ground
INKED = (0.08, 0.65)  # share of ink in a block
INKED_AROUND = 0.03  # largest share of ink around a block


@dataclass(frozen=True)
class Inked:
    """A picture's lightness, its ground without strokes, the strokes' top-hats, and the area inside its border."""

    lightness: Float[np.ndarray, "h w"]
    ground: Float[np.ndarray, "h w"]
    hat: Float[np.ndarray, "h w"]
    inner: Bool[np.ndarray, "h w"]


def lettering(rgb: Float[np.ndarray, "h w 3"], border: style.Crop) -> tuple[style.Box, ...]:
    """Boxes of the lettering in a picture (encoded sRGB) inside its `border`, from top to bottom."""
    size = style.long_side(rgb.shape, min(LONG, max(rgb.shape[:2])))
    lightness = style.blurred(style.lab_from_srgb(style.resized(rgb, size))[..., 0], BLUR)
    inner = np.zeros(size, bool)
    inner[style.inside(size, border)] = True
    width = 2 * max(1, round(STROKE * max(size) / 2)) + 1
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (width, width))
    found = []
    for kind, sign in ((cv2.MORPH_BLACKHAT, 1), (cv2.MORPH_TOPHAT, -1)):
        hat = cv2.morphologyEx(lightness, kind, disc, borderType=cv2.BORDER_REPLICATE)
        found += blocks(Inked(lightness, lightness + sign * hat, hat, inner))
    margin, scale = REACH * max(size) / 2, np.array([*size, *size])
    grown = (np.clip((np.array(box) + [-margin, -margin, margin, margin]) / scale, 0, 1) for box in sorted(found))
    return tuple((float(box[0]), float(box[1]), float(box[2]), float(box[3])) for box in grown)


def blocks(picture: Inked) -> list[tuple[int, int, int, int]]:
    """Blocks of letters in pixels: top, left, bottom, right."""
    long = max(picture.hat.shape)
    count, label, stats, _ = cv2.connectedComponentsWithStats((picture.hat > INK).astype(np.uint8), connectivity=8)
    extent, area = stats[:, 2:4].max(axis=1), stats[:, cv2.CC_STAT_AREA]
    letter = (extent >= round(LEAST_LETTER * long)) & (extent <= round(LARGEST_LETTER * long)) & (area >= LEAST_INK)
    letter &= np.bincount(label[~picture.inner], minlength=count) <= OUTSIDE * area
    letter[0] = False
    marks = np.where(letter[label], label, 0)
    reach = max(1, round(REACH * long))
    kernel = np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)
    grown = cv2.dilate(np.pad((marks > 0).astype(np.uint8), reach), kernel)
    _, group, boxes, _ = cv2.connectedComponentsWithStats(grown, connectivity=8)
    group, result = group[reach:-reach, reach:-reach], []
    for k, (left, top, across, down, _) in enumerate(boxes[1:], start=1):
        box = int(top), int(left), int(top + down - 2 * reach), int(left + across - 2 * reach)
        inside = slice(box[0], box[2]), slice(box[1], box[3])
        own = np.where(group[inside] == k, marks[inside], 0)
        if small_near_edge(box, group.shape) and letters_alike(own, extent) and calm(picture, box, own > 0, reach):
            result.append(box)
    return result


def calm(picture: Inked, box: tuple[int, int, int, int], letters: Bool[np.ndarray, "h w"], reach: int) -> bool:
    """Whether a block's letters are clear, and its ground and the surroundings within `reach` pixels are calm."""
    inside = slice(box[0], box[2]), slice(box[1], box[3])
    around = slice(max(0, box[0] - reach), box[2] + reach), slice(max(0, box[1] - reach), box[3] + reach)
    ring = picture.inner.copy()
    ring[inside] = False
    beside, ground = picture.lightness[around][ring[around]], picture.ground[inside]
    if len(beside) == 0 or deviation(beside) >= CALM_AROUND or deviation(ground) >= CALM_GROUND:
        return False
    if (picture.hat[around][ring[around]] > INK).mean() >= INKED_AROUND or np.ptp(ground) >= GROUND_RANGE:
        return False
    return float(picture.hat[inside][letters].mean()) > CLEAR


def small_near_edge(box: tuple[int, int, int, int], shape: tuple[int, ...]) -> bool:
    """Whether a block is as small as lettering and lies near an edge of the picture."""
    (top, left, bottom, right), (height, width) = box, shape
    longer = max(bottom - top, right - left)
    if not (round(BLOCK[0] * max(shape)) <= longer <= round(BLOCK[1] * max(shape))):
        return False
    if (bottom - top) * (right - left) > LARGEST_BLOCK * height * width:
        return False
    return min(top / height, left / width, 1 - bottom / height, 1 - right / width) < NEAR


def letters_alike(own: Int[np.ndarray, "h w"], extent: Int[np.ndarray, " n"]) -> bool:
    """Whether a block's labels are several letters of similar size that fill it as text does."""
    sizes = extent[np.unique(own[own > 0])]
    middle = np.median(sizes) if len(sizes) else 0
    alike = (sizes > middle / 2) & (sizes < middle * 2)
    return bool(alike.sum() >= FEWEST and INKED[0] < (own > 0).mean() < INKED[1])


def deviation(values: Float[np.ndarray, "..."]) -> float:
    """Median absolute deviation from the median."""
    return float(np.median(np.abs(values - np.median(values))))
