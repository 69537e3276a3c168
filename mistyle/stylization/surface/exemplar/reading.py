"""Measures of a painting: size of strokes or tiles, flatness, line-likeness, number of tones, pixel grid.

They are computed once before the synthesis, whose settings derive from them
(`mistyle.stylization.surface.exemplar.chosen`). Nothing is learned: they are deterministic image statistics.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float

from mistyle.stylization.surface.exemplar import edges
from mistyle.stylization.surface.exemplar import exemplar as style
from mistyle.stylization.surface.exemplar.lettering import lettering

LONG = 512  # pixels along the longer side for most measures
FINE = 1.0  # pixels of blur before local differences, against noise of paper, canvas and JPEG
FLAT_WINDOW = 9  # pixels (of LONG) of the window for flat regions
FLAT = 0.012  # largest standard deviation of Lab / 100 in a flat window
MOST_TONES = 8
EXPLAINED = 0.95  # share of the variance of lightness that the tones explain
BINS = 64
SCALES, LEAST_SCALE = 16, 0.6  # blurs in steps of sqrt(2), from this one on (pixels of LONG)
PERIOD = 5.33  # wavelength, in blurs, of the largest difference between two such blurs
PROMINENT = 0.04  # least relative prominence of a maximum over scales
LOCAL = 4.0  # blurs above which contrast belongs to the composition
LARGEST_UNIT = 0.35  # in long sides
RAYS = 24  # search directions, 7.5 degrees apart
ALL_BUT = 0.8  # of the clearest peak: the nearest peak at least as clear is the period
PERIODIC = 0.12  # least rise of the autocorrelation from its first dip to a period's peak
ANGLES = 36
STANDS_OUT = 1.6  # times the mean of the histogram of directions
AXIS_WIDTH = 10.0  # degrees on both sides of an axis
TILE_LONG = 1024  # pixels along the longer side for tiles: their joints are thin
JOINTS = (9, 15)  # pixels: joints are narrower than this
JOINT_AREA = 8  # times that width: side of the window whose mean is the usual strength of a line
JOINT_LEVELS = (0.8, 1.2)  # times that mean: pixels above it are joints
LEAST_TILE, LARGEST_TILE = 20, 1 / 200  # pixels, and share of the picture
COMPACT = 0.4  # least area of a tile over the square of its longer extent
EVEN_TILES = 3.0  # tiles differ from the median area by this factor at most
FEWEST_TILES = 30


@dataclass(frozen=True)
class StyleReading:
    """A painting's own measures; shares are 0..1.

    unit          width of the structural unit (tile, stroke with its gap), in long sides
    clarity       relative loss of contrast from the unit's scale to coarser ones
    line_likeness share of the contrast along lines
    flatness      share of the area with uniform colour, up to noise
    tones         number of tones that explain 95 % of the variance of lightness, at most 8
    pixel_grid    sides (down, across) of one art pixel in picture pixels; 0 where it is not pixel art
    directions    dominant directions of lines, degrees counter-clockwise from the picture's x axis, 0..180
    rectilinear   share of the contrast along two axes at right angles
    tiled         share of the area between thin lines that lies in closed, compact cells of one size
    border        border outside the picture (top, left, bottom, right), shares of the height or width
    lettering     boxes of titles, signatures and cartouches (top, left, bottom, right), the same shares
    """

    unit: float
    clarity: float
    line_likeness: float
    flatness: float
    tones: int
    pixel_grid: tuple[int, int]
    directions: tuple[float, ...]
    rectilinear: float
    tiled: float
    border: style.Crop
    lettering: tuple[style.Box, ...]


def read_style(rgb: Float[np.ndarray, "h w 3"], alpha: Float[np.ndarray, "h w"] | None = None) -> StyleReading:
    """Measure a picture (encoded sRGB 0..1) of any size, prepared by `style.prepare`.

    Transparent pixels take the colour of the nearest opaque one; a picture with transparent parts has no border.
    """
    picture, opaque = style.filled(rgb, alpha)
    grid = edges.pixel_grid(picture)
    border = edges.border(picture, grid != (0, 0)) if opaque.all() else style.UNCROPPED
    inner = picture[style.inside(picture.shape, border)]
    art = (
        cv2.resize(inner, None, fx=1 / grid[1], fy=1 / grid[0], interpolation=cv2.INTER_AREA)
        if min(grid) > 1
        else inner
    )
    size, finer = (style.long_side(art.shape, min(most, max(art.shape[:2]))) for most in (LONG, TILE_LONG))
    lab = style.lab_from_srgb(style.resized(art, size))
    unit, clarity = structural_unit(lab)
    lines, directions, rectilinear = line_reading(lab[..., 0])
    return StyleReading(
        unit=unit,
        clarity=clarity,
        line_likeness=lines,
        flatness=flatness(lab),
        tones=tone_count(lab[..., 0]),
        pixel_grid=grid,
        directions=directions,
        rectilinear=rectilinear,
        tiled=tiled(style.lab_from_srgb(style.resized(art, finer))[..., 0]),
        border=border,
        lettering=lettering(picture, border) if grid == (0, 0) and opaque.all() else (),
    )


def flatness(lab: Float[np.ndarray, "h w 3"]) -> float:
    """Share of the area with little change within a window."""
    calm = style.blurred(lab, FINE)
    side = (FLAT_WINDOW, FLAT_WINDOW)
    mean, square = cv2.blur(calm, side), cv2.blur(calm**2, side)
    spread = np.sqrt(np.maximum(square - mean**2, 0).sum(axis=2))
    return float((spread < FLAT).mean())


def tone_count(lightness: Float[np.ndarray, "h w"]) -> int:
    """The fewest tones that explain EXPLAINED of the variance of lightness (exact one-dimensional k-means)."""
    share, edge = np.histogram(lightness, BINS, (0, 1))
    centre = (edge[1:] + edge[:-1]) / 2
    weight, first, second = (np.concatenate([[0], np.cumsum(share * centre**k)]) for k in range(3))
    low, high = np.arange(BINS + 1)[:, None], np.arange(BINS + 1)[None]
    mass = weight[high] - weight[low]
    with np.errstate(invalid="ignore", divide="ignore"):
        inside = second[high] - second[low] - (first[high] - first[low]) ** 2 / mass
    cost = np.where(high < low, np.inf, np.where(mass > 0, inside, 0))
    best, whole = cost[0], cost[0, -1]
    for count in range(1, MOST_TONES):
        if best[-1] <= (1 - EXPLAINED) * whole + 1e-9:
            return count
        best = (best[:, None] + cost).min(axis=0)
    return MOST_TONES


def structural_unit(lab: Float[np.ndarray, "h w 3"]) -> tuple[float, float]:
    """Width of the unit in long sides, and its clarity (0..1).

    The scale (Lindeberg 1998) is the first maximum of the contrast between successive blurs. A clear peak in the
    autocorrelation of detail finer than a few such scales overrides it: its lag is the unit. The autocorrelation is
    along one direction or averaged over all.
    """
    long = max(lab.shape[:2])
    sigma, clarity = first_scale(lab)
    fine = lab[..., 0] - style.blurred(lab[..., 0], LOCAL * sigma)
    peaks = [first_peak(curve) for curve in correlations(fine, long)]
    rise = max(one[1] for one in peaks)
    lag = min(one[0] for one in peaks if one[1] >= ALL_BUT * rise)
    unit = lag if rise >= PERIODIC else PERIOD * sigma
    return float(np.clip(unit / long, 1 / long, LARGEST_UNIT)), clarity


def first_scale(lab: Float[np.ndarray, "h w 3"]) -> tuple[float, float]:
    """The blur (pixels) of the first prominent maximum of contrast over scales, else of the highest contrast; and the
    relative fall of contrast after it."""
    scales = LEAST_SCALE * np.sqrt(2) ** np.arange(SCALES)
    largest = max(lab.shape[:2]) * LARGEST_UNIT / PERIOD
    scales = scales[: max(4, int((scales <= largest).sum()) + 1)]
    blurs = [style.blurred(lab, sigma) for sigma in scales]
    contrast = np.array([np.sqrt(((a - b) ** 2).mean()) for a, b in zip(blurs[:-1], blurs[1:], strict=True)])
    best = int(contrast.argmax())
    for k in range(1, len(contrast) - 1):
        lower = np.flatnonzero(contrast[k:] < (1 - PROMINENT) * contrast[k])
        rises = contrast[k] > (1 + PROMINENT) * contrast[: k + 1].min()
        if rises and len(lower) and contrast[k : k + lower[0]].max() <= contrast[k]:
            best = k
            break
    return float(scales[best]), float(1 - contrast[best:].min() / max(float(contrast[best]), 1e-9))


def correlations(fine: Float[np.ndarray, "h w"], long: int) -> list[Float[np.ndarray, " n"]]:
    """Autocorrelation over the lag in pixels: averaged over all directions, and along RAYS of them."""
    fine = fine * np.outer(np.hanning(fine.shape[0]), np.hanning(fine.shape[1]))
    shape = [cv2.getOptimalDFTSize(2 * n) for n in fine.shape]
    table = np.fft.irfft2(np.abs(np.fft.rfft2(fine, shape)) ** 2, shape)
    reach = max(4, min(int(LARGEST_UNIT * long), min(fine.shape) // 2))
    table = np.roll(table, (reach, reach), (0, 1))[: 2 * reach + 1, : 2 * reach + 1]
    table = (table / max(float(table[reach, reach]), 1e-12)).astype(np.float32)
    angle, lag = np.pi * np.arange(RAYS)[:, None] / RAYS, np.arange(reach + 1)
    x, y = (reach + turn(angle) * lag for turn in (np.cos, np.sin))
    rays = cv2.remap(table, x.astype(np.float32), y.astype(np.float32), cv2.INTER_LINEAR)
    return [rays.mean(axis=0), *rays]


def first_peak(curve: Float[np.ndarray, " n"]) -> tuple[int, float]:
    """Lag of the first peak after the first dip, and its height over the dip; height 0 for none."""
    smooth = np.convolve(np.pad(curve, 1, mode="edge"), [0.25, 0.5, 0.25], "valid")
    rising = np.flatnonzero(np.diff(smooth) > 0)
    if len(rising) == 0:
        return len(curve) - 1, 0.0
    dip = int(rising[0])
    falling = np.flatnonzero(np.diff(smooth[dip:]) < 0)
    if len(falling) == 0:
        return len(curve) - 1, 0.0
    peak = dip + int(falling[0])
    return peak, float(smooth[peak] - smooth[dip])


def line_reading(lightness: Float[np.ndarray, "h w"]) -> tuple[float, tuple[float, ...], float]:
    """Line-likeness, the dominant directions and the rectilinear share, from the structure tensor."""
    calm = style.blurred(lightness, FINE)
    gx, gy = cv2.Scharr(calm, cv2.CV_32F, 1, 0) / 32, cv2.Scharr(calm, cv2.CV_32F, 0, 1) / 32
    energy = gx**2 + gy**2
    reach = max(1.5, max(lightness.shape) / 128)
    xx, yy, xy = (style.blurred(v, reach) for v in (gx * gx, gy * gy, gx * gy))
    along = np.hypot(xx - yy, 2 * xy)
    lines = float(along.sum() / max(float((xx + yy).sum()), 1e-9))
    # Lines run across the gradient; the picture's y points down, angles count upwards.
    angle = np.degrees(np.arctan2(gx, gy)) % 180
    share = np.histogram(angle, ANGLES * 5, (0, 180), weights=energy)[0] / max(float(energy.sum()), 1e-12)
    wheel = np.convolve(np.concatenate([share[-12:], share, share[:12]]), np.hanning(27)[1:-1] / 13, "same")[12:-12]
    top = wheel * len(wheel)
    around = np.stack([np.roll(top, k) for k in range(-15, 16)])
    peaks = np.flatnonzero((top >= around.max(axis=0)) & (top > STANDS_OUT))
    peaks = peaks[np.argsort(-top[peaks], kind="stable")][:4]
    width = int(AXIS_WIDTH)
    both = np.array([np.roll(share, -k)[list(range(-width, width + 1))].sum() for k in range(180)])
    pair = float((both + np.roll(both, -90)).max())
    even = 2 * (2 * width + 1) / 180
    return lines, tuple(float(p) + 0.5 for p in peaks), float(np.clip((pair - even) / (1 - even), 0, 1))


def tiled(lightness: Float[np.ndarray, "h w"]) -> float:
    """Share (0..1) of the area between thin lines that lies in closed, compact cells of one size: tiles in joints.

    Lines, dark or light, are top-hats of the lightness above their local mean; cells are the connected components of
    the rest. Rows may bend: nothing here depends on directions. The largest share over widths, signs and levels counts.
    Brushwork has 0.04 at most, since its lines end and its cells join; noise of one scale has 0.11, mosaics and leaded
    glass have 0.13 to 0.65. Tiles above LARGEST_TILE do not count.
    """
    calm, best = style.blurred(lightness, FINE), 0.0
    for width in JOINTS:
        disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (width, width))
        for kind in (cv2.MORPH_BLACKHAT, cv2.MORPH_TOPHAT):
            hat = cv2.morphologyEx(calm, kind, disc, borderType=cv2.BORDER_REPLICATE)
            usual = cv2.blur(hat, (JOINT_AREA * width, JOINT_AREA * width)) + 1e-3
            best = max(best, *(even_cells(hat < level * usual) for level in JOINT_LEVELS))
    return best


def even_cells(inside: Bool[np.ndarray, "h w"]) -> float:
    """Share of a mask's area in compact connected components whose area is near the median of such components."""
    found = cv2.connectedComponentsWithStats(inside.astype(np.uint8), connectivity=4)[2][1:]
    area, extent = found[:, cv2.CC_STAT_AREA].astype(np.float64), found[:, 2:4].max(axis=1).astype(np.float64)
    tile = (area >= LEAST_TILE) & (area < LARGEST_TILE * inside.size) & (area > COMPACT * extent**2)
    if tile.sum() < FEWEST_TILES:
        return 0.0
    sizes = np.sort(area[tile])
    middle = sizes[np.searchsorted(np.cumsum(sizes), sizes.sum() / 2)]
    even = tile & (area > middle / EVEN_TILES) & (area < middle * EVEN_TILES)
    return float(area[even].sum() / area.sum())
