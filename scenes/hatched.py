"""The demo's ink drawing: a still life of jug, pears, apple and bowl, hatched with a pen on laid paper.

A scene of distance functions is traced to depth, normals and light; the pen then follows the forms: each layer of
hatching is a set of evenly spaced streamlines (after Jobard and Lefer 1997) round the forms, across them, and upright,
and is laid where the tone is darker than the layer's own. Outlines are drawn last, with a pen that presses and lifts.
"""

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter, map_coordinates
from sculpt import blend, ellipsoid, local, turn
from sunset import clouds, hexa

SIZE = (832, 1024)
PAPER, INK = "#f1e6cd", "#1f1a1c"
SUN = np.array([-0.60, 0.62, 0.50])  # towards the light: upper left, before the things
EYE, SPAN = np.array([0.10, 1.72, 5.2]), 0.50  # where we stand, and the half height of what we see at distance 1
TILT = np.radians(-12.5)
TABLE, WALL = 0, 1
OVERSAMPLE = 3


@dataclass(frozen=True)
class Traced:
    """What is seen: thing (h, w) int, point and normal (h, w, 3), tone (h, w) 0 black .. 1 white."""

    thing: np.ndarray
    point: np.ndarray
    normal: np.ndarray
    tone: np.ndarray


@dataclass(frozen=True)
class Hatch:
    """One layer: pixels between lines, half width of the pen, degrees that lines are turned on the form, the tone below
    which it is laid, and its longest line in pixels."""

    apart: float
    pen: float
    turned: float
    tone: float
    longest: float


LAYERS = (
    Hatch(apart=6.6, pen=0.95, turned=0, tone=0.86, longest=210),
    Hatch(apart=6.8, pen=0.90, turned=52, tone=0.56, longest=150),
    Hatch(apart=6.2, pen=0.95, turned=-48, tone=0.33, longest=110),
    Hatch(apart=5.6, pen=1.05, turned=90, tone=0.20, longest=80),
)


def turned_form(p: np.ndarray, at, profile) -> np.ndarray:
    """A surface of revolution about an upright axis: `profile` are (height, radius) knots."""
    q = p - np.asarray(at, float)
    heights, radii = np.array(profile).T
    fine = np.linspace(heights[0], heights[-1], 200)
    from scipy.interpolate import PchipInterpolator

    radius = PchipInterpolator(heights, radii)(np.clip(q[:, 1], heights[0], heights[-1]))
    side = np.hypot(q[:, 0], q[:, 2]) - radius
    cap = np.maximum(q[:, 1] - fine[-1], fine[0] - q[:, 1])
    return np.where(cap > 0, np.hypot(np.maximum(side, 0), cap), np.maximum(side, cap) * 0.6)


def jug(p: np.ndarray) -> np.ndarray:
    """A big-bellied jug with a lip and a handle."""
    at = np.array([-0.62, 0.0, -0.25])
    body = turned_form(p, at, [(0, 0.34), (0.06, 0.36), (0.35, 0.56), (0.62, 0.60), (0.92, 0.44), (1.12, 0.26),
                               (1.30, 0.235), (1.46, 0.33), (1.49, 0.34)])  # fmt: skip
    hollow = turned_form(p, at + [0, 0.05, 0], [(1.0, 0.05), (1.2, 0.19), (1.46, 0.29), (1.60, 0.33)])
    spout = ellipsoid(p, at + [-0.27, 1.40, 0.04], (0.19, 0.10, 0.13), turn(z=-24))
    body = np.maximum(blend(body, spout, 0.09), -hollow)
    q = local(p, at + [0.40, 1.02, 0.0], turn(z=-10))
    ring = np.hypot(np.hypot(q[:, 0] / 0.80, q[:, 1]) - 0.34, q[:, 2]) - 0.062
    return blend(body, np.where(q[:, 0] > -0.10, ring, 1.0) * 0.75, 0.05)


def pear(p: np.ndarray, at, rotation) -> np.ndarray:
    """A pear that may lie."""
    q = local(p, at, rotation)
    d = blend(ellipsoid(q, (0, 0, 0), (0.255, 0.245, 0.255)), ellipsoid(q, (0.01, 0.27, 0), (0.135, 0.19, 0.135)), 0.17)
    stalk = np.hypot(q[:, 0] - 0.03 - 0.4 * np.clip(q[:, 1] - 0.44, 0, 1), q[:, 2]) - 0.019
    return np.minimum(d, np.maximum(stalk, np.abs(q[:, 1] - 0.50) - 0.09) * 0.8)


def apple(p: np.ndarray, at) -> np.ndarray:
    """An apple with its dimple and stalk."""
    q = local(p, at, turn(z=-12, x=14))
    r = np.hypot(q[:, 0], q[:, 2])
    d = np.hypot((r - 0.105) / 1.0, q[:, 1] / 1.06 + 0.10 * r) - 0.165
    d = np.where(r < 0.105, np.maximum(d, np.abs(q[:, 1]) - 0.155 - 0.25 * r), d)
    stalk = np.hypot(q[:, 0] - 0.5 * np.clip(q[:, 1] - 0.10, 0, 1) ** 1.2, q[:, 2]) - 0.014
    return np.minimum(d, np.maximum(stalk, np.abs(q[:, 1] - 0.20) - 0.10)) * 0.8


def bowl(p: np.ndarray) -> np.ndarray:
    """A footed bowl."""
    at = np.array([0.72, 0.0, -0.35])
    out = turned_form(p, at, [(0, 0.26), (0.05, 0.25), (0.10, 0.15), (0.17, 0.17), (0.32, 0.46), (0.52, 0.62),
                              (0.56, 0.63)])  # fmt: skip
    inner = turned_form(p, at + [0, 0.06, 0], [(0.12, 0.05), (0.26, 0.36), (0.50, 0.585), (0.70, 0.62)])
    return np.maximum(out, -inner)


THINGS = (
    lambda p: p[:, 1],
    lambda p: p[:, 2] + 1.75,
    jug,
    bowl,
    lambda p: pear(p, (0.02, 0.245, 0.62), turn(z=14, x=-8)),
    lambda p: pear(p, (0.52, 0.250, 0.50), turn(z=-74, y=24)),
    lambda p: apple(p, (0.58, 0.66, -0.30)),
    lambda p: apple(p, (0.93, 0.64, -0.22)),
    lambda p: apple(p, (-0.42, 0.165, 0.66)),
    lambda p: apple(p, (0.74, 0.62, -0.58)),
)


def world(p: np.ndarray) -> np.ndarray:
    """Distance (n,) to the nearest thing."""
    return np.min([thing(p) for thing in THINGS], axis=0)


def march(start: np.ndarray, way: np.ndarray, steps: int, far: float) -> np.ndarray:
    """Distances (n,) along rays to the first hit, or `far`."""
    t = np.full(len(start), 0.02)
    alive = np.arange(len(start))
    for _ in range(steps):
        d = world(start[alive] + t[alive, None] * way[alive])
        t[alive] += d * 0.85
        alive = alive[(d > 1e-3) & (t[alive] < far)]
        if not len(alive):
            break
    return np.minimum(t, far)


def traced(size: tuple[int, int]) -> Traced:
    """The scene from the eye, at half the picture's resolution, enlarged."""
    h, w = size[0] // 2, size[1] // 2
    y, x = np.mgrid[0:h, 0:w] + 0.5
    u, v = (x - w / 2) / (h / 2) * SPAN * 0.5, (h / 2 - y) / (h / 2) * SPAN * 0.5
    c, s = np.cos(TILT), np.sin(TILT)
    way = np.stack([u, v * c + s, v * s - c], axis=-1).reshape(-1, 3)
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    start = np.broadcast_to(EYE, way.shape)
    t = march(start, way, 110, 12.0)
    point = start + t[:, None] * way
    every = np.stack([thing(point) for thing in THINGS])
    thing = every.argmin(axis=0)
    e = 2e-3
    normal = np.stack([world(point + e * k) - world(point - e * k) for k in np.eye(3)], axis=1)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9)
    light = SUN / np.linalg.norm(SUN)
    lit = np.clip(normal @ light, 0, 1)
    shadow = march(point + 0.02 * normal, np.broadcast_to(light, point.shape), 60, 4.0) >= 4.0
    hollow = np.clip(world(point + 0.16 * normal) / 0.16, 0, 1)
    tone = 0.12 + 0.14 * hollow + 0.95 * lit * shadow
    front = np.clip((point[:, 2] - 0.2) / 2.2, 0, 1)
    away = np.clip(np.hypot(point[:, 0] + 0.9, point[:, 1] - 1.7) / 2.6, 0, 1)
    tone = tone * np.choose(np.minimum(thing, 2), [1.06 - 0.42 * front, 1.05 - 0.62 * away, 1.0])
    parts = [field.reshape(h, w, -1) for field in (thing, point, normal, tone)]
    big = [np.kron(part, np.ones((2, 2, 1))) for part in parts]
    return Traced(big[0][..., 0].astype(int), big[1], big[2], np.clip(gaussian_filter(big[3][..., 0], 1.0), 0, 1))


def courses(seen: Traced, size: tuple[int, int]) -> np.ndarray:
    """Angle (h, w) of the lines that go round each form: level for turned things, along the table, slanting on the
    wall."""
    axis = np.array([0.0, 1.0, 0.0])
    round_it = np.cross(seen.normal, axis)
    thin = np.linalg.norm(round_it, axis=2, keepdims=True)
    round_it = round_it / np.maximum(thin, 1e-6)
    # As the picture shows a direction at a point: the difference of two projections.
    ahead = projected(seen.point + 1e-3 * round_it) - projected(seen.point)
    angle = np.arctan2(ahead[..., 1], ahead[..., 0])
    angle = np.where(seen.thing == TABLE, np.radians(3.0), angle)
    angle = np.where(seen.thing == WALL, np.radians(-58.0), angle)
    c, s = np.cos(2 * angle), np.sin(2 * angle)
    soft = []
    for field in (c, s):
        total, weight = np.zeros(size), np.zeros(size)
        for number in range(len(THINGS)):
            inside = (seen.thing == number).astype(float)
            near = gaussian_filter(inside, 3) * inside
            total += gaussian_filter(field * inside, 3) * inside
            weight += near
        soft.append(total / np.maximum(weight, 1e-6))
    return np.arctan2(soft[1], soft[0]) / 2


def projected(p: np.ndarray) -> np.ndarray:
    """Where points (..., 3) are in the picture, x right and y down, in units of its half height."""
    q = p - EYE
    c, s = np.cos(TILT), np.sin(TILT)
    up, ahead = q[..., 1] * c + q[..., 2] * s, q[..., 1] * s - q[..., 2] * c
    return np.stack([q[..., 0], -up], axis=-1) / np.maximum(ahead, 1e-3)[..., None] / (SPAN * 0.5)


class Taken:
    """Which places lines already run through; a class because it grows with every line."""

    def __init__(self, size: tuple[int, int], apart: float) -> None:
        self.cell = apart / 1.5
        self.grid = np.full((int(size[0] / self.cell) + 3, int(size[1] / self.cell) + 3, 2), -1e9)
        self.reach = int(np.ceil(apart / self.cell))

    def free(self, x: float, y: float, apart: float) -> bool:
        """Whether no line is nearer than `apart` pixels."""
        i, j = int(y / self.cell) + 1, int(x / self.cell) + 1
        r = self.reach
        spot = self.grid[max(i - r, 0) : i + r + 1, max(j - r, 0) : j + r + 1]
        return bool(((spot[..., 0] - x) ** 2 + (spot[..., 1] - y) ** 2).min() > apart * apart)

    def take(self, line: list[tuple[float, float]]) -> None:
        """Enter a line's points."""
        for x, y in line:
            self.grid[int(y / self.cell) + 1, int(x / self.cell) + 1] = (x, y)


def streamline(start, angle, thing, wanted, taken: Taken, hatch: Hatch) -> list[tuple[float, float]]:
    """A line both ways from `start`, as long as it stays on its thing, where hatching is wanted, and off the others."""
    h, w = thing.shape
    step, gap = 2.0, hatch.apart * 0.62
    halves = []
    for sense in (1, -1):
        x, y = start
        heading = angle[int(y), int(x)] + (0 if sense > 0 else np.pi)
        half = []
        for _ in range(int(hatch.longest / step / 2)):
            x, y = x + step * np.cos(heading), y + step * np.sin(heading)
            if not (0 <= x < w and 0 <= y < h):
                break
            i, j = int(y), int(x)
            if thing[i, j] != thing[int(start[1]), int(start[0])] or not wanted[i, j] or not taken.free(x, y, gap):
                break
            here = angle[i, j]
            heading = here if np.cos(here - heading) > 0 else here + np.pi
            half.append((x, y))
        halves.append(half)
    return [*halves[1][::-1], start, *halves[0]]


def hatching(seen: Traced, angle: np.ndarray, hatch: Hatch, rng: np.random.Generator) -> list[np.ndarray]:
    """The lines of one layer, each (n, 3): x, y and half width in pixels."""
    size = seen.thing.shape
    wobble = 0.05 * clouds(rng, size, 12) + 0.03 * clouds(rng, size, 4)
    wanted = seen.tone + wobble < hatch.tone
    course = angle + np.radians(hatch.turned) + 0.05 * clouds(rng, size, 40)
    taken, lines = Taken(size, hatch.apart), []
    y, x = np.nonzero(wanted)
    order = rng.permutation(len(x))
    for k in order[: len(order) // 6]:
        start = (x[k] + 0.5, y[k] + 0.5)
        if not taken.free(*start, hatch.apart):
            continue
        line = streamline(start, course, seen.thing, wanted, taken, hatch)
        if len(line) < 8:
            continue
        taken.take(line)
        points = np.array(line)
        tone = seen.tone[points[:, 1].astype(int), points[:, 0].astype(int)]
        # The pen presses harder where it is darker, and lifts at both ends.
        press = 0.55 + 0.75 * np.clip((hatch.tone - tone) / 0.35, 0, 1)
        ends = np.minimum(np.arange(len(points)), np.arange(len(points))[::-1])
        lift = np.clip(0.30 + ends / 9, 0, 1)
        lines.append(np.column_stack([points, hatch.pen * press * lift]))
    return lines


def outlines(seen: Traced, rng: np.random.Generator) -> np.ndarray:
    """How much ink (h, w) the outlines leave: where the thing seen changes, or its surface turns sharply."""
    size = seen.thing.shape
    shaky = np.mgrid[0 : size[0], 0 : size[1]].astype(float) + 1.1 * np.stack([clouds(rng, size, 14) for _ in range(2)])
    thing = map_coordinates(seen.thing, shaky, order=0, mode="nearest")
    depth = map_coordinates(seen.point[..., 2], shaky, order=0, mode="nearest")
    normal = np.stack([map_coordinates(seen.normal[..., k], shaky, order=0, mode="nearest") for k in range(3)], -1)
    line = np.zeros(size)
    for axis in (0, 1):
        step = np.roll(thing, -1, axis) != thing
        turned = (np.roll(normal, -1, axis) * normal).sum(-1) < 0.35
        deep = np.abs(np.roll(depth, -1, axis) - depth) > 0.12
        flat = (thing > WALL) | (np.roll(thing, -1, axis) > WALL)
        line = np.maximum(line, (step | ((turned | deep) & flat)).astype(float))
    line[[0, -1]], line[:, [0, -1]] = 0, 0
    weight = 1.35 + 0.55 * clouds(rng, size, 30) + 0.5 * (seen.tone < 0.35)
    return np.clip(gaussian_filter(line, 1.15) * 2.6 * weight, 0, 1)


def painting(size: tuple[int, int] = SIZE, seed: int = 1634) -> np.ndarray:
    """The finished drawing, sRGB uint8 (h, w, 3)."""
    import cv2

    rng = np.random.default_rng(seed)
    seen = traced(size)
    angle = courses(seen, size)
    sheet = np.zeros((size[0] * OVERSAMPLE, size[1] * OVERSAMPLE), np.uint8)
    for hatch in LAYERS:
        for line in hatching(seen, angle, hatch, rng):
            soft = np.column_stack([gaussian_filter(line[:, k], 1.5, mode="nearest") for k in range(3)])
            for a, b in zip(soft[:-1], soft[1:], strict=True):
                wide = max(1, round((a[2] + b[2]) * OVERSAMPLE))
                ends = [tuple(int(round(v * OVERSAMPLE)) for v in end[:2]) for end in (a, b)]
                cv2.line(sheet, ends[0], ends[1], 255, wide, cv2.LINE_AA)
    h, w = size
    ink = sheet.reshape(h, OVERSAMPLE, w, OVERSAMPLE).mean(axis=(1, 3)) / 255
    ink = 1 - (1 - ink) * (1 - outlines(seen, rng))
    # Ink is not evenly black, and paper has its fibres.
    flow = np.clip(0.93 + 0.05 * clouds(rng, size, 5) + 0.03 * clouds(rng, size, 1), 0, 1)
    fibre = 1 + 0.006 * clouds(rng, size, 1.1) + 0.008 * clouds(rng, size, 22)
    paper = hexa(PAPER) * np.clip(fibre, 0, 1.03)[..., None]
    return np.round(np.clip(paper + (ink * flow)[..., None] * (hexa(INK) - paper), 0, 1) * 255).astype(np.uint8)
