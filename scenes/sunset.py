"""The demo's style: a stormy evening over the sea, composed as fields and painted by paint.py.

Coordinates: x to the right and y down in units of the picture's height. Sky and sea have stream functions; strokes run
along their level lines and the colours lie in bands between them, so that hue and hand follow one movement.
"""

import numpy as np
from paint import Canvas, Composition, Layer, bristles, lay, oklab_from_srgb, relief
from scipy.ndimage import gaussian_filter

SIZE = (1024, 1280)
HORIZON = 0.615
SUN = (0.86, 0.50)
# Centre, radius, and the sense in which the arms wind.
SWIRLS = ((0.42, 0.250, 0.160, 1), (1.05, 0.170, 0.100, -1), (0.09, 0.150, 0.080, -1))

# Palettes: stops along a parameter 0..1.
EVENING = [(0.0, "#0f1c50"), (0.10, "#1d3f90"), (0.19, "#2f65ba"), (0.27, "#4f8fc9"), (0.33, "#8a93c6"),
           (0.41, "#bf6f95"), (0.50, "#e05a40"), (0.60, "#ef8329"), (0.74, "#f8b53a"),
           (0.88, "#fcdc80"), (1.0, "#fff4c8")]  # fmt: skip
WHIRL = [(0, "#13296b"), (0.3, "#2b6fb8"), (0.55, "#6cc3cc"), (0.8, "#d9ecc9"), (1.0, "#fbf3c4")]
WATER = [(0.0, "#07163f"), (0.25, "#12377e"), (0.5, "#1f6a9c"), (0.7, "#3f9fae"), (0.9, "#9fd3c4")]
EMBERS = [(0.0, "#7a2f62"), (0.3, "#d2473c"), (0.55, "#f28b34"), (0.8, "#fbd067"), (1.0, "#fff3bf")]
HEATH = [(0, "#0c1f3d"), (0.35, "#123f4f"), (0.6, "#1f6656"), (0.85, "#5c8a4a"), (1.0, "#a9a650")]
WHEAT = [(0, "#2a1d3f"), (0.2, "#6a2c3c"), (0.4, "#a8502b"), (0.6, "#d6902c"), (0.78, "#ecbf4b"), (0.92, "#f8e190")]
GRASS = [(0, "#14324a"), (0.4, "#1f6b55"), (0.75, "#6fa04c"), (1.0, "#c9cc62")]


def ramp(t: np.ndarray, stops) -> np.ndarray:
    """Colours (…, 3) in OKLab along stops (position, '#rrggbb')."""
    at = [p for p, _ in stops]
    lab = np.array([oklab_from_srgb(hexa(c)) for _, c in stops])
    return np.stack([np.interp(t, at, lab[:, k]) for k in range(3)], axis=-1)


def hexa(code: str) -> np.ndarray:
    """'#rrggbb' as sRGB 0..1."""
    return np.array([int(code[i : i + 2], 16) for i in (1, 3, 5)]) / 255


def clouds(rng: np.random.Generator, shape, sigma: float) -> np.ndarray:
    """Smooth noise of unit variance."""
    noise = gaussian_filter(rng.normal(size=shape), sigma, mode="wrap")
    return noise / noise.std()


def bands(phase: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """One-dimensional noise -1..1 along `phase`: bands of unequal width."""
    knots = rng.uniform(-1, 1, 400)
    t = np.mod(phase, len(knots) - 1)
    i = t.astype(int)
    f = t - i
    f = f * f * (3 - 2 * f)
    return knots[i] * (1 - f) + knots[i + 1] * f


def mix(a: np.ndarray, b: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """a where weight is 0, b where it is 1."""
    return a + np.clip(weight, 0, 1)[..., None] * (b - a)


def step(x: np.ndarray, low: float, high: float) -> np.ndarray:
    """Smooth step from 0 at `low` to 1 at `high`."""
    t = np.clip((x - low) / (high - low), 0, 1)
    return t * t * (3 - 2 * t)


def polar(x, y, centre) -> tuple[np.ndarray, np.ndarray]:
    """Distance from `centre` and angle about it."""
    return np.hypot(x - centre[0], y - centre[1]), np.arctan2(y - centre[1], x - centre[0])


def sky(x, y, rng) -> tuple[np.ndarray, np.ndarray]:
    """Colour and stream function of the sky: swirls in a westerly flow, the sun in its rings."""
    psi = y - 0.06 * np.sin(3.1 * x + 0.6) * np.exp(-(((y - 0.33) / 0.20) ** 2)) + 0.003 * clouds(rng, x.shape, 30)
    for cx, cy, radius, _ in SWIRLS:
        r, _ = polar(x, y, (cx, cy))
        hold = np.exp(-((r / radius) ** 4))
        psi = psi * (1 - hold) + (cy + 1.1 * radius - 0.9 * r) * hold
    sun, _ = polar(x, y, SUN)
    near = np.exp(-((sun / 0.20) ** 3))
    psi = psi * (1 - near) + (0.62 - sun) * near
    glow = np.exp(-sun / 0.28) + 0.33 * np.exp(-(((y - HORIZON) / 0.12) ** 2))
    glow = glow - 0.25 * step(y, 0.30, 0.0) - 0.10 * step(x, 0.45, 0)
    wave = bands(psi * 44, rng)
    warmth = np.clip(glow + 0.12 * wave * (0.6 + near) + 0.030 * clouds(rng, x.shape, 45), 0, 1)
    colour = ramp(warmth, EVENING)
    # Turquoise and pale streaks in the blue, dark furrows beside them.
    fine = bands(psi * 95 + 7, rng)
    blue = step(warmth, 0.42, 0.18)
    colour = mix(colour, oklab_from_srgb(hexa("#7fd0d2")), blue * step(fine, 0.35, 0.9) * 0.70)
    colour = mix(colour, oklab_from_srgb(hexa("#0c1440")), blue * step(-fine, 0.50, 0.95) * 0.70)
    for cx, cy, radius, sense in SWIRLS:
        r, around = polar(x, y, (cx, cy))
        r = r / radius
        arms = 0.5 + 0.5 * np.cos(9.5 * r + sense * 2 * around)
        tint = ramp(arms + 0.25 * fine, WHIRL)
        colour = mix(colour, tint, np.exp(-((r / 0.95) ** 6)) * 0.92)
        heart = ramp(r, [(0, "#fff3b8"), (0.12, "#ffd866"), (0.24, "#f29a3f")])
        colour = mix(colour, heart, np.exp(-((r / 0.22) ** 6)) * 0.95)
    rings = bands(sun * 110 + 2, rng)
    halo = step(sun, 0.20, 0.10) * 0.6
    colour = mix(colour, ramp(0.5 + 0.5 * rings, [(0, "#ee7a2b"), (0.5, "#fbc04a"), (1, "#fff0b0")]), halo)
    disc = step(sun, 0.090, 0.078)
    return mix(colour, ramp(sun / 0.085 + 0.12 * rings, [(0, "#fffbe2"), (0.6, "#ffeb94"), (1, "#ffc93f")]), disc), psi


def sea(x, y, rng) -> tuple[np.ndarray, np.ndarray]:
    """Colour and stream function of the water: swell that grows towards us, the sun's road across it."""
    depth = np.clip((y - HORIZON) / (1 - HORIZON), 0, 1)
    scale = 0.18 + depth
    swell = 0.020 * scale * np.sin((x * 8.5 - 2.2 * depth) / scale**0.8 + 9 * depth)
    swell = swell + 0.008 * scale * np.sin(x * 23 / scale**0.5 + 31 * depth)
    psi = np.log(0.10 + depth) * 0.42 + swell / (0.25 + depth)
    wave = bands(psi * 52, rng)
    colour = ramp(0.5 + 0.5 * wave - 0.18 * depth, WATER)
    road = np.exp(-(((x - SUN[0] - 0.03 * np.sin(9 * depth)) / (0.055 + 0.16 * depth)) ** 2))
    warm = ramp(0.5 + 0.5 * wave, EMBERS)
    colour = mix(colour, warm, road * (0.45 + 0.75 * step(wave, -0.6, 0.2)) * (1 - 0.15 * depth))
    colour = mix(colour, oklab_from_srgb(hexa("#c98ab0")), step(wave, 0.2, 0.8) * 0.40 * (1 - depth) * (1 - road))
    foam = step(bands(psi * 52 + 0.35, rng) + 0.35 * clouds(rng, x.shape, 9), 0.95, 1.25) * depth
    return mix(colour, oklab_from_srgb(hexa("#eef3e2")), foam * 0.85), psi


def land(x, y, rng) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """(mask, colour, stream function) of the far hills, the headland and the near slope, back to front."""
    result = []
    crest = HORIZON - 0.035 * np.exp(-(((x - 1.22) / 0.16) ** 2)) - 0.022 * np.exp(-(((x - 0.56) / 0.10) ** 2))
    crest = crest + 0.004 * np.sin(x * 40)
    inside = (y > crest) & (y < HORIZON + 0.002)
    tone = bands((y - crest) * 160 + 3, rng)
    result.append((inside, ramp(0.5 + 0.5 * tone, [(0, "#3a2f78"), (0.5, "#6c4f97"), (1, "#b0718f")]), y - 0.6 * crest))
    crest = 0.47 + 0.055 * np.sin(5 * x + 0.4) + 0.52 * np.clip(x - 0.02, 0, 1) ** 1.5 + 0.010 * np.sin(31 * x)
    shore = HORIZON + 0.055 + 0.02 * np.sin(9 * x) - 0.12 * x
    inside = (y > crest) & (y < np.maximum(shore, HORIZON + 0.01)) & (x < 0.55)
    lean = y - crest - 0.25 * x
    tone = bands(lean * 70 + 11, rng)
    colour = ramp(0.5 + 0.5 * tone, HEATH)
    brink = np.exp(-(((y - crest) / 0.013) ** 2)) * step(x, 0.05, 0.4)
    colour = mix(colour, oklab_from_srgb(hexa("#f0813a")), brink * 0.9)
    result.append((inside, colour, lean))
    crest = 0.872 - 0.17 * np.exp(-(((x - 0.0) / 0.36) ** 2)) + 0.050 * np.sin(2.6 * x + 0.4) + 0.006 * np.sin(23 * x)
    down = y - crest
    # Furrows of a field that run together at a point behind the crest.
    far, about = polar(x, y, (0.34, 0.60))
    furrow = about * 0.42 + 0.05 * np.sin(9 * far + 2)
    tone = bands(furrow * 75 + 5, rng)
    patch = clouds(rng, x.shape, 24)
    colour = ramp(0.5 + 0.5 * tone + 0.08 * patch, WHEAT)
    colour = mix(colour, ramp(0.5 + 0.5 * tone, GRASS), step(patch, 0.1, 0.9) * 0.85)
    poppies = step(clouds(rng, x.shape, 5), 1.5, 2.0) * step(down, 0.0, 0.03)
    colour = mix(colour, oklab_from_srgb(hexa("#d7263d")), poppies)
    colour = mix(colour, oklab_from_srgb(hexa("#f7d57a")), np.exp(-((down / 0.008) ** 2)) * 0.7)
    result.append((down > 0, colour, furrow))
    return result


def compose(size: tuple[int, int], seed: int) -> Composition:
    """The picture as fields."""
    rng = np.random.default_rng(seed)
    h, w = size
    y, x = (np.mgrid[0:h, 0:w] + 0.5) / h
    colour, psi = sky(x, y, rng)
    layers = [(np.ones(size, bool), colour, psi), (y > HORIZON, *sea(x, y, rng)), *land(x, y, rng)]
    colour, angle = np.zeros((h, w, 3)), np.zeros(size)
    bend, detail, which = np.zeros(size), np.zeros(size), np.zeros(size, int)
    for number, (mask, tint, stream) in enumerate(layers):
        gy, gx = np.gradient(gaussian_filter(stream, 3))
        direction = np.arctan2(-gx, gy)
        c, s = gaussian_filter(np.cos(2 * direction), 4), gaussian_filter(np.sin(2 * direction), 4)
        direction = np.arctan2(s, c) / 2
        cy, cx = np.gradient(c)
        sy, sx = np.gradient(s)
        along_s, along_c = (np.cos(direction) * gx + np.sin(direction) * gy for gx, gy in ((sx, sy), (cx, cy)))
        turn = (c * along_s - s * along_c) / (2 * np.maximum(c * c + s * s, 0.1))
        colour[mask], angle[mask], bend[mask], which[mask] = tint[mask], direction[mask], turn[mask], number
    length = np.choose(which, [1.0, 0.85, 0.8, 0.75, 0.85]) / (1 + 30 * gaussian_filter(np.abs(bend), 6))
    edges = gaussian_filter(np.hypot(*np.gradient(gaussian_filter(colour[..., 0], 2))), 4)
    border = gaussian_filter(np.abs(np.gradient(which.astype(float))).sum(0), 5)
    detail = 0.75 * np.clip(edges / np.percentile(edges, 97), 0, 1)
    detail = np.maximum(detail, 0.8 * np.clip(border / 0.08, 0, 1))
    for cx, cy, radius, _ in SWIRLS:
        detail = np.maximum(detail, 0.62 * np.exp(-((np.hypot(x - cx, y - cy) / radius) ** 4)))
    sun = np.hypot(x - SUN[0], y - SUN[1])
    detail = np.maximum(detail, 0.9 * np.exp(-((sun / 0.15) ** 2)))
    detail = np.maximum(detail, 0.8 * np.exp(-(((y - HORIZON) / 0.02) ** 2)) * (which < 2))
    return Composition(colour, angle, bend, length, detail, which)


LAYERS = (
    Layer(width=30, length=95, spacing=0.85, detail=-9, jitter=1.0),
    Layer(width=15, length=62, spacing=0.95, detail=-9, jitter=1.3),
    Layer(width=8.5, length=42, spacing=1.15, detail=-9, jitter=1.5),
    Layer(width=5.5, length=30, spacing=1.5, detail=0.30, jitter=1.2),
    Layer(width=3.4, length=18, spacing=1.9, detail=0.60, jitter=0.9),
)


def painting(size: tuple[int, int] = SIZE, seed: int = 1889) -> np.ndarray:
    """The finished painting, sRGB uint8 (h, w, 3)."""
    composition = compose(size, seed)
    rng = np.random.default_rng(seed + 1)
    bank = bristles(rng)
    ground = np.broadcast_to(oklab_from_srgb(hexa("#a8572c")), (*size, 3)).copy()
    canvas = Canvas(ground, clouds(rng, size, 1.0) * 0.15 + 1)
    for layer in LAYERS:
        lay(canvas, composition, layer, rng, bank)
    return np.round(relief(canvas) * 255).astype(np.uint8)
