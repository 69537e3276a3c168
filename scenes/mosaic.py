"""The demo's mosaic: two fish that leap over waves below a sun, laid in stone and glass.

`compose` gives every place a colour and the direction of the rows of tesserae: along the outlines of what is shown, as
a mosaicist lays them. Tesserae are the cells of a centroidal Voronoi diagram in a rotated maximum norm (after Hausner
2001, "Simulating decorative mosaics"), with mortar where two cells meet. x to the right, y down, in heights.
"""

from dataclasses import dataclass

import numpy as np
from paint import oklab_from_srgb, srgb_from_oklab
from scipy.ndimage import distance_transform_edt, gaussian_filter
from scipy.spatial import cKDTree
from sculpt import closed_curve
from sunset import clouds, hexa

SIZE = (832, 1024)
STONE = 19.0  # pixels along a tessera
MORTAR = 2.6  # pixels between two
ROUNDS = 36
NEIGHBOURS = 9

GOLD = ("#d9a429", "#e8bd4a", "#c98a1d", "#f2d479")
INK = ("#1b1d33", "#26294a", "#141527")
WHITE = ("#f3ead2", "#fbf6e6", "#e6d8b8")
SKY = ("#efe0bc", "#e9d3a4", "#f4e9cf", "#e2c796")
HAZE = ("#e9b98c", "#e0a274", "#f0cda4")
DEEP = ("#12326f", "#1a4690", "#0f2757")
TEAL = ("#1d8a96", "#2aa6a8", "#15707f")
AQUA = ("#6cc5bd", "#8fd6c8", "#4fb0ad")
RED = ("#b5301f", "#cf4a2c", "#96241a")
ORANGE = ("#e27b2c", "#ee9440", "#cf6420")
VIOLET = ("#6a3c78", "#7f4f8c", "#543064")


@dataclass(frozen=True)
class Plan:
    """What to lay: colour (h, w, 3) in OKLab, angle (h, w) of the rows in radians, region (h, w) int, whose borders no
    tessera crosses, and spread (h, w), how far the tint of a stone strays."""

    colour: np.ndarray
    angle: np.ndarray
    region: np.ndarray
    spread: np.ndarray


class Board:
    """Shapes laid on each other; a class because every one covers what lies below it."""

    def __init__(self, size: tuple[int, int], rng: np.random.Generator) -> None:
        h, w = size
        self.y, self.x = (np.mgrid[0:h, 0:w] + 0.5) / h
        self.rng = rng
        self.region = np.zeros(size, int)
        self.shade = np.zeros((*size, 3))
        self.lines = np.zeros(size)
        self.count = 0

    def lay(self, mask: np.ndarray, tints: tuple[str, ...], lines: np.ndarray | None = None) -> None:
        """Cover `mask` with stones of `tints`; rows run along the level lines of `lines`, or of the distance from the
        mask's border."""
        self.count += 1
        self.region[mask] = self.count
        pick = self.rng.integers(0, len(tints), mask.shape)
        self.shade[mask] = oklab_from_srgb(np.array([hexa(t) for t in tints]))[pick[mask]]
        inside = distance_transform_edt(mask) if lines is None else lines
        self.lines[mask] = inside[mask]

    def ring(self, mask: np.ndarray, rows: int) -> np.ndarray:
        """The first `rows` rows of stones outside of `mask`."""
        return (distance_transform_edt(~mask) < rows * STONE * self.scale) & ~mask

    @property
    def scale(self) -> float:
        """Pixels here over pixels of the finished picture."""
        return self.region.shape[0] / SIZE[0]


def filled(board: Board, outline: np.ndarray) -> np.ndarray:
    """The inside (h, w) of a closed polygon (n, 2) in heights."""
    from PIL import Image, ImageDraw

    h, w = board.region.shape
    picture = Image.new("1", (w, h))
    ImageDraw.Draw(picture).polygon([(float(x * h), float(y * h)) for x, y in outline], fill=1)
    return np.asarray(picture)


def placed(knots, at: tuple[float, float], size: float, degrees: float, flip: bool) -> np.ndarray:
    """An outline drawn to the right, moved to its place."""
    points = np.asarray(knots, float) * [1, -1 if flip else 1]
    a = np.radians(degrees)
    return points @ np.array([[np.cos(a), np.sin(a)], [-np.sin(a), np.cos(a)]]) * size + at


BODY = [(0.50, 0.02), (0.40, -0.085), (0.22, -0.150), (0.0, -0.155), (-0.22, -0.095), (-0.40, -0.035),
        (-0.40, 0.030), (-0.22, 0.090), (0.0, 0.140), (0.22, 0.140), (0.40, 0.095)]  # fmt: skip
TAIL = [(-0.36, 0.0), (-0.47, -0.08), (-0.64, -0.20), (-0.70, -0.19), (-0.60, -0.06), (-0.585, 0.0), (-0.61, 0.07),
        (-0.70, 0.19), (-0.64, 0.20), (-0.47, 0.08)]  # fmt: skip
BACK_FIN = [(0.22, -0.13), (0.12, -0.235), (-0.06, -0.275), (-0.20, -0.225), (-0.15, -0.115), (0.0, -0.135)]
BELLY_FIN = [(0.06, 0.12), (-0.02, 0.245), (-0.17, 0.255), (-0.13, 0.165), (-0.09, 0.105)]
SIDE_FIN = [(0.17, 0.03), (0.06, -0.012), (-0.07, 0.02), (-0.09, 0.062), (0.02, 0.082), (0.13, 0.072)]


def fish(board: Board, at: tuple[float, float], size: float, degrees: float, flip: bool, tints) -> None:
    """One fish: an outline of dark stones, fins, a back and a belly, scales in bands, gills and an eye."""
    back, band, belly, fins = tints

    def spot(knots, closed: bool = True) -> np.ndarray:
        return filled(board, placed(closed_curve(knots) if closed else knots, at, size, degrees, flip))

    parts = [spot(k) for k in (TAIL, BACK_FIN, BELLY_FIN, BODY)]
    whole = np.logical_or.reduce(parts)
    board.lay(board.ring(whole, 1), INK)
    turn = np.radians(degrees)
    x, y = board.x - at[0], board.y - at[1]
    u, v = (x * np.cos(turn) + y * np.sin(turn)) / size, (-x * np.sin(turn) + y * np.cos(turn)) / size
    v = -v if flip else v
    for part in parts[:3]:
        board.lay(part, fins, np.arctan2(v, u - 0.1) * 300)
    body = parts[3]
    bend = v + 0.16 * (u - 0.05) ** 2
    board.lay(body, back)
    board.lay(body & (bend > -0.045), band, bend * 800)
    board.lay(body & (bend > 0.055), belly, bend * 800)
    for k, centre in enumerate((-0.30, -0.16, -0.02)):
        stripe = np.abs(u - centre - 0.10 * (v * 6) ** 2 * 0.5) < 0.018
        board.lay(body & stripe & (bend < 0.055), (fins, WHITE, fins)[k])
    head = body & (np.hypot(u - 0.52, v * 1.05) < 0.265)
    board.lay(body & (np.hypot(u - 0.52, v * 1.05) < 0.265 + 0.85 * STONE / SIZE[0] / size), INK)
    board.lay(head, belly)
    board.lay(spot(SIDE_FIN), fins, np.arctan2(v - 0.03, u - 0.20) * 300)
    eye = np.hypot(u - 0.385, v + 0.030) * size * SIZE[0] / STONE
    board.lay(eye < 2.0, WHITE)
    board.lay(eye < 1.0, INK)


def sun(board: Board, at: tuple[float, float], radius: float) -> None:
    """A disc of gold with a red rim, and twelve rays of two kinds."""
    r, around = np.hypot(board.x - at[0], board.y - at[1]) / radius, np.arctan2(board.y - at[1], board.x - at[0])
    for number in range(12):
        off = np.abs(np.angle(np.exp(1j * (around - (number + 0.5) * np.pi / 6))))
        long = 2.15 if number % 2 else 1.75
        ray = (r > 1.25) & (r < long) & (off < 0.20 * (long - r) / (long - 1.25))
        board.lay(ray, ORANGE if number % 2 else GOLD, off * 300)
    board.lay(r < 1.20, RED, r * 300)
    board.lay(r < 0.98, GOLD, r * 300)
    board.lay(r < 0.50, WHITE[:2] + GOLD[3:], r * 300)


def waves(board: Board) -> None:
    """Rows of swell from far to near, each with a crest of foam."""
    rows = ((0.660, 0.018, 6.4, 0.4, AQUA), (0.735, 0.030, 5.2, 2.0, TEAL), (0.825, 0.036, 4.4, 4.1, DEEP),
            (0.925, 0.036, 5.0, 0.9, TEAL))  # fmt: skip
    for level, height, pace, phase, tints in rows:
        wave = 0.5 + 0.5 * np.sin(pace * 2.8 * board.x + phase)
        crest = board.y - level - height * (0.8 - 1.9 * wave**2)
        lines = crest * 800
        board.lay(crest > 0, WHITE, lines)
        board.lay(crest > 0.024, tints, lines)
        board.lay(crest > 0.096, AQUA if tints is not AQUA else TEAL, lines)
        board.lay(crest > 0.120, tints, lines)


def compose(size: tuple[int, int], seed: int) -> Plan:
    """The picture as fields."""
    rng = np.random.default_rng(seed)
    board = Board(size, rng)
    at = (0.94, 0.235)
    far = np.hypot(board.x - at[0], board.y - at[1])
    board.lay(np.ones(size, bool), SKY, far * 800)
    board.lay(np.abs(board.y - 0.585 + 0.02 * np.sin(5 * board.x)) < 0.075, HAZE, board.y * 800)
    sun(board, at, 0.098)
    hills = (
        0.575 - 0.085 * np.exp(-(((board.x - 0.22) / 0.16) ** 2)) - 0.055 * np.exp(-(((board.x - 0.52) / 0.12) ** 2))
    )
    board.lay((board.y > hills) & (board.y < 0.70), VIOLET, (board.y - hills) * 800)
    waves(board)
    fish(board, (0.40, 0.345), 0.60, -24, False, (DEEP, TEAL, GOLD, RED))
    fish(board, (0.855, 0.735), 0.44, -14, False, (RED, ORANGE, WHITE, VIOLET))
    gy, gx = np.gradient(gaussian_filter(board.lines, 1.5))
    double = np.exp(2j * np.arctan2(gy, gx))
    weight = np.maximum(np.hypot(gx, gy), 1e-3).clip(None, 1)
    soft = gaussian_filter((double * weight).real, 6) + 1j * gaussian_filter((double * weight).imag, 6)
    angle = np.angle(soft) / 2 + np.pi / 2
    spread = 0.7 + 0.3 * (board.y < 0.66)
    return Plan(board.shade, angle, board.region, spread)


def nearest(points: np.ndarray, stones: np.ndarray, angle: np.ndarray, own: np.ndarray, region: np.ndarray):
    """Of pixels (n, 2): the nearest stone of their own region in its rotated maximum norm, that distance, and the
    second one, in pixels."""
    _, near = cKDTree(stones).query(points, k=NEIGHBOURS)
    off = points[:, None] - stones[near]
    c, s = np.cos(angle[near]), np.sin(angle[near])
    across = np.maximum(np.abs(off[..., 0] * c + off[..., 1] * s), np.abs(-off[..., 0] * s + off[..., 1] * c))
    across = across + np.where(region[near] == own[:, None], 0.0, 1e3)
    order = np.argsort(across, axis=1)[:, :2]
    rows = np.arange(len(points))
    first, second = across[rows, order[:, 0]], across[rows, order[:, 1]]
    return near[rows, order[:, 0]], first, second


def settle(plan: Plan, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Places (n, 2) of the stones and their angles: Lloyd's steps, every region by itself."""
    h, w = plan.region.shape
    points = np.stack(np.meshgrid(np.arange(w) + 0.5, np.arange(h) + 0.5), axis=-1).reshape(-1, 2)
    own = plan.region.ravel()
    stones = []
    for region in np.unique(own):
        rows = np.flatnonzero(own == region)
        count = max(1, round(len(rows) / STONE**2))
        stones.append(points[rng.choice(rows, count, replace=False)])
    stones = np.concatenate(stones)
    coarse = slice(None, None, 3)
    some = points.reshape(h, w, 2)[coarse, coarse].reshape(-1, 2)
    kept = plan.region[coarse, coarse].ravel()

    def at(field: np.ndarray) -> np.ndarray:
        return field[np.clip(stones[:, 1].astype(int), 0, h - 1), np.clip(stones[:, 0].astype(int), 0, w - 1)]

    region = at(plan.region)
    for _ in range(ROUNDS):
        which, first, _ = nearest(some, stones, at(plan.angle), kept, region)
        fine = first < 1e3
        count = np.bincount(which[fine], minlength=len(stones))
        total = np.stack([np.bincount(which[fine], some[fine, k], len(stones)) for k in (0, 1)], axis=1)
        moved = total / np.maximum(count, 1)[:, None]
        moved = np.where(count[:, None] > 0, moved, stones)
        inside = plan.region[moved[:, 1].astype(int), moved[:, 0].astype(int)] == region
        stones = np.where(inside[:, None], moved, stones)
    return stones, at(plan.angle)


def painting(size: tuple[int, int] = SIZE, seed: int = 547) -> np.ndarray:
    """The finished mosaic, sRGB uint8 (h, w, 3)."""
    plan, rng = compose(size, seed), np.random.default_rng(seed + 1)
    h, w = size
    stones, angle = settle(plan, rng)
    rows = stones.astype(int)
    points = np.stack(np.meshgrid(np.arange(w) + 0.5, np.arange(h) + 0.5), axis=-1).reshape(-1, 2)
    angle = angle + rng.normal(size=len(angle)) * 0.03
    region = plan.region[rows[:, 1], rows[:, 0]]
    which, first, second = nearest(points, stones, angle, plan.region.ravel(), region)
    # Mortar lies where two stones of a region meet, at the borders of regions, and where a stone would grow too large.
    border = np.ones(size)
    border[:, 1:] *= plan.region[:, 1:] == plan.region[:, :-1]
    border[1:] *= plan.region[1:] == plan.region[:-1]
    edge = np.minimum((second - first) / 2, distance_transform_edt(border).ravel() - 0.5)
    edge = np.minimum(edge, 0.66 * STONE - first) + 0.35 * clouds(rng, size, 1.2).ravel()
    cover = np.clip(edge - MORTAR / 2 + 0.5, 0, 1)[:, None]
    tint = plan.colour[rows[:, 1], rows[:, 0]] + rng.normal(size=(len(stones), 3)) * [0.028, 0.007, 0.007]
    # Every stone is tilted a little in its bed, so that one side is lighter; its rim is worn.
    tilt = rng.normal(size=(len(stones), 2)) * 0.0016
    colour = tint[which]
    lean = ((points - stones[which]) * tilt[which]).sum(axis=1)
    worn = np.exp(-np.clip(edge - MORTAR / 2, 0, None) / 1.6)
    grain = 0.010 * clouds(rng, size, 0.8).ravel() + 0.008 * clouds(rng, size, 2.5).ravel()
    colour[:, 0] += np.clip(lean, -0.03, 0.03) - 0.05 * worn + grain
    mortar = oklab_from_srgb(hexa("#8b8171")) + np.array([0.022, 0, 0]) * clouds(rng, size, 1.0).reshape(-1, 1)
    laid = mortar + cover * (colour - mortar)
    return np.round(srgb_from_oklab(laid.reshape(h, w, 3)) * 255).astype(np.uint8)
