"""A painter of brush strokes: every stroke is a bent ribbon with bristles, paint thickness and a dry end.

A composition gives a colour, a direction and a wish for detail at every place; layers of strokes from broad to fine
follow them (after Hertzmann 1998, "Painterly rendering with curved brush strokes of multiple sizes", with arcs for
splines). Thickness is kept beside colour, and at the end lit as relief. Colours are mixed in OKLab.
"""

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter

OKLAB_LMS = np.array([[0.8189330101, 0.3618667424, -0.1288597137], [0.0329845436, 0.9293118715, 0.0361456387],
                      [0.0482003018, 0.2643662691, 0.6338517070]])  # fmt: skip
OKLAB_LAB = np.array([[0.2104542553, 0.7936177850, -0.0040720468], [1.9779984951, -2.4285922050, 0.4505937099],
                      [0.0259040371, 0.7827717662, -0.8086757660]])  # fmt: skip
XYZ_RGB = np.array([[0.4123908, 0.3575843, 0.1804808], [0.2126390, 0.7151687, 0.0721923],
                    [0.0193308, 0.1191948, 0.9505322]])  # fmt: skip


def oklab_from_srgb(rgb: np.ndarray) -> np.ndarray:
    """OKLab (Ottosson 2020) of encoded sRGB 0..1."""
    rgb = np.asarray(rgb, float)
    linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    return np.cbrt(linear @ (OKLAB_LMS @ XYZ_RGB).T) @ OKLAB_LAB.T


def srgb_from_oklab(lab: np.ndarray) -> np.ndarray:
    """Encoded sRGB 0..1 of OKLab, clipped to the gamut."""
    lms = (lab @ np.linalg.inv(OKLAB_LAB).T) ** 3
    linear = np.clip(lms @ np.linalg.inv(OKLAB_LMS @ XYZ_RGB).T, 0, 1)
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


@dataclass(frozen=True)
class Composition:
    """What to paint.

    colour (h, w, 3) in OKLab; angle (h, w) of the strokes in radians, x right, y down; bend (h, w) in radians a pixel
    along the stroke; length (h, w) as a factor; detail (h, w) 0..1, how fine the strokes become; region (h, w) int,
    across whose borders no colour is fetched.
    """

    colour: np.ndarray
    angle: np.ndarray
    bend: np.ndarray
    length: np.ndarray
    detail: np.ndarray
    region: np.ndarray


@dataclass(frozen=True)
class Layer:
    """One pass with one brush: half width and half length in pixels, spacing in half widths, least wish for detail."""

    width: float
    length: float
    spacing: float
    detail: float
    jitter: float


@dataclass
class Canvas:
    """Wet paint: OKLab colour and thickness (pixels)."""

    colour: np.ndarray
    thickness: np.ndarray


def bristles(rng: np.random.Generator, count=48, across=40, along=48) -> tuple[np.ndarray, np.ndarray]:
    """A bank of brush marks (count, along, across): thickness -1..1 of each bristle's trail, and when it runs dry."""
    lines = gaussian_filter(rng.normal(size=(count, 1, across)), (0, 0, 0.9)).repeat(along, axis=1)
    wander = gaussian_filter(rng.normal(size=(count, along, across)), (0, 9, 0.8))
    marks = lines / lines.std() + 0.8 * wander / wander.std()
    dry = gaussian_filter(rng.normal(size=(count, along, across)), (0, 4, 0.7))
    dry = gaussian_filter(lines, (0, 0, 0.6)) / lines.std() + 1.1 * dry / dry.std()
    return np.clip(marks / 2.2, -1, 1), dry


def stroke(canvas: Canvas, centre, angle: float, bend: float, half: tuple[float, float], colour: np.ndarray,
           mark: tuple[np.ndarray, np.ndarray], load: float) -> None:  # fmt: skip
    """Lay one stroke: an arc of half length and half width `half`, painted from its tail to its dry tip.

    Along (s) and across (t) coordinates of a pixel come from the arc's second-order form, exact enough for the bends
    that brush strokes have (less than about one radian in all).
    """
    length, width = half
    reach = length + width
    sag = abs(bend) * length * length / 2 + 1.3 * width
    wide = abs(np.cos(angle)) * reach + abs(np.sin(angle)) * sag + 1
    high = abs(np.sin(angle)) * reach + abs(np.cos(angle)) * sag + 1
    h, w = canvas.thickness.shape
    x0, x1 = max(int(centre[0] - wide), 0), min(int(centre[0] + wide) + 2, w)
    y0, y1 = max(int(centre[1] - high), 0), min(int(centre[1] + high) + 2, h)
    if x0 >= x1 or y0 >= y1:
        return
    dx, dy = np.arange(x0, x1) + 0.5 - centre[0], (np.arange(y0, y1) + 0.5 - centre[1])[:, None]
    c, s = np.cos(angle), np.sin(angle)
    along, across = dx * c + dy * s, -dx * s + dy * c
    across = across - bend * along * along / 2 + bend * length * length / 6
    place = along / length
    taper = width * (1 - 0.30 * np.clip(place, 0, 1.2) ** 2) * (1 - 0.12 * np.clip(-place, 0, 1.2) ** 2)
    t = across / taper
    # Round ends: the along coordinate is measured from where the cap begins.
    cap = np.clip(np.abs(along) - (length - 0.55 * width), 0, None) / width
    edge = (1 - np.sqrt(t * t + cap * cap)) * width
    cover = np.clip(edge / 1.2 + 0.5, 0, 1)
    marks, dry = mark
    i = np.clip((place * 0.5 + 0.5) * (marks.shape[0] - 1), 0, marks.shape[0] - 1).astype(np.int32)
    j = np.clip((t * 0.5 + 0.5) * (marks.shape[1] - 1), 0, marks.shape[1] - 1).astype(np.int32)
    trail = marks[i, j]
    wet = load - 1.9 * np.clip(place + 0.1, 0, 1.2) ** 2 + 0.75 * dry[i, j] - 1.6 * np.clip(np.abs(t) - 0.72, 0, 1)
    alpha = cover * np.clip(wet * 2.2 + 0.5, 0, 1) * 0.96
    ridge = np.exp(-(((np.abs(t) - 0.86) / 0.16) ** 2)) * 0.55
    body = width**0.5 * (0.75 + 0.55 * trail + ridge + 0.25 * np.clip(place, 0, 1))
    area = (slice(y0, y1), slice(x0, x1))
    old = canvas.thickness[area]
    canvas.thickness[area] = old + alpha * (0.35 * old + body - old)
    tone = np.zeros((*trail.shape, 3))
    tone[..., 0] = 0.030 * trail
    old_colour = canvas.colour[area]
    # Wet in wet: a little of what lies below is dragged along, more towards the tip.
    drag = (0.06 + 0.12 * np.clip(place, 0, 1))[..., None]
    paint = (colour + tone) * (1 - drag) + old_colour * drag
    canvas.colour[area] = old_colour + alpha[..., None] * (paint - old_colour)


def blurred_within(composition: Composition, sigma: float) -> np.ndarray:
    """The colours blurred, each region by itself."""
    result = np.zeros_like(composition.colour)
    for region in np.unique(composition.region):
        inside = composition.region == region
        weight = np.maximum(gaussian_filter(inside.astype(float), sigma), 1e-6)
        soft = gaussian_filter(composition.colour * inside[..., None], (sigma, sigma, 0)) / weight[..., None]
        result[inside] = soft[inside]
    return result


def lay(canvas: Canvas, composition: Composition, layer: Layer, rng: np.random.Generator, bank) -> int:
    """One pass over the canvas where the wish for detail is large enough; how many strokes it took."""
    h, w = canvas.thickness.shape
    step = layer.width * layer.spacing
    y, x = np.mgrid[step / 2 : h : step, step / 2 : w : step]
    places = np.stack([x.ravel(), y.ravel()], axis=1)
    places = places + rng.uniform(-0.6, 0.6, places.shape) * step
    places = places[rng.permutation(len(places))]
    aim = blurred_within(composition, layer.width * 0.35)
    count = 0
    for place in places:
        column, row = int(np.clip(place[0], 0, w - 1)), int(np.clip(place[1], 0, h - 1))
        if composition.detail[row, column] + rng.normal() * 0.10 < layer.detail:
            continue
        angle = composition.angle[row, column]
        # The colour is fetched a little beside the stroke: neighbours differ as bands of paint do.
        off = rng.normal() * 0.9 * layer.width
        r = int(np.clip(row + off * np.cos(angle), 0, h - 1))
        c = int(np.clip(column - off * np.sin(angle), 0, w - 1))
        if composition.region[r, c] != composition.region[row, column]:
            r, c = row, column
        colour = aim[r, c] + rng.normal(size=3) * [0.040, 0.014, 0.014] * layer.jitter
        size = float(np.exp(rng.normal() * 0.22))
        length = layer.length * composition.length[row, column] * size * (0.75 + 0.5 * rng.random())
        bend = np.clip(composition.bend[row, column], -0.9 / length, 0.9 / length)
        k = rng.integers(len(bank[0]))
        heading = angle + rng.normal() * 0.10 + (np.pi if rng.random() < 0.3 else 0)
        sign = 1 if np.cos(heading - angle) > 0 else -1
        flip = slice(None, None, -1 if rng.random() < 0.5 else 1)
        mark = (bank[0][k][:, flip], bank[1][k][:, flip])
        bend = sign * bend + rng.normal() * 0.1 / length
        load = 1.0 + 0.45 * rng.random()
        stroke(canvas, place, heading, bend, (length, layer.width * size**0.5), colour, mark, load)
        count += 1
    return count


def relief(canvas: Canvas, strength: float = 0.11) -> np.ndarray:
    """The canvas under a raking light from the upper left: encoded sRGB (h, w, 3), 0..1."""
    height = gaussian_filter(canvas.thickness, 0.6)
    gy, gx = np.gradient(height)
    slope = (gx * 0.75 + gy * 0.66) * -1
    lit = np.tanh(slope * 0.55)
    lab = canvas.colour.copy()
    lab[..., 0] = lab[..., 0] * (1 + strength * lit) + 0.012 * lit
    lab[..., 0] += 0.05 * np.clip(lit - 0.55, 0, 1) ** 1.5
    return srgb_from_oklab(lab)
