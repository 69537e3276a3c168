"""Style pictures made of marks: printed dots, pen strokes, dabs, washes.

Each function draws one picture, (h w 3) uint8 sRGB, the same pixels each time.
"""

import cv2
import numpy as np

from benchmarks.look.made import SIDE, eight, grid, noise, rgb


def halftone() -> np.ndarray:
    """A comic panel: a burst over a skyline in flat inks, tints of round dots, thick black outlines."""
    fine = 2
    side = SIDE * fine
    x, y = grid(side)
    angle, away = np.arctan2(y - 0.42, x - 0.5), np.hypot(x - 0.5, y - 0.42)
    rays = np.sin(12 * angle) > 0
    dots = screen(side, 15 * fine, np.radians(45))
    white, red, blue, yellow, black = (rgb(c) for c in ("fdf6e3", "e2231a", "1f4fa3", "ffd91f", "121212"))
    picture = np.where(rays[..., None], yellow, white)
    tint = np.clip(1.1 - 1.5 * away, 0.12, 0.85)
    picture = np.where((~rays & (dots < tint))[..., None], red, picture)
    star = away < 0.2 + 0.075 * np.abs(((angle / (2 * np.pi) * 14) % 1) * 2 - 1) + 0.02 * np.cos(5 * angle)
    inner = away < 0.125 + 0.06 * np.abs(((angle / (2 * np.pi) * 14 + 0.0) % 1) * 2 - 1)
    picture = np.where(star[..., None], white, picture)
    picture = np.where((star & (dots < 0.35))[..., None], rgb("2aa7df"), picture)
    picture = np.where(inner[..., None], red, picture)
    label = star.astype(int) + inner + 10 * rays * ~star
    for cx, cy, r in ((0.12, 0.16, 0.1), (0.22, 0.13, 0.12), (0.33, 0.17, 0.08), (0.8, 0.12, 0.1), (0.9, 0.17, 0.09)):
        cloud = np.hypot(x - cx, (y - cy) * 1.25) < r
        label[cloud] = 50
        picture[cloud] = white
    shade = np.roll(label == 50, -9 * fine, axis=0) < (label == 50)
    picture[shade] = rgb("2aa7df")
    rng = np.random.default_rng(4)
    left = 0.0
    while left < 1:
        width, top = rng.uniform(0.07, 0.15), rng.uniform(0.6, 0.8)
        tower = (x >= left) & (x < left + width) & (y > top)
        ink = (blue, rgb("6a2c91"), black)[rng.integers(3)]
        lit = (((x - left) * 42 % 1) < 0.5) & (((y - top) * 30 % 1) < 0.5) & (y > top + 0.02) & (x > left + 0.012)
        paper = (
            np.where((dots < 0.4)[..., None], ink, white)
            if rng.random() < 0.45
            else np.broadcast_to(ink, picture.shape)
        )
        picture = np.where(tower[..., None], np.where((lit & tower)[..., None], yellow, paper), picture)
        label[tower] = 100 + int(1000 * left)
        left += width
    outline = np.zeros(label.shape, np.uint8)
    outline[:, :-1] |= label[:, :-1] != label[:, 1:]
    outline[:-1] |= label[:-1] != label[1:]
    outline = cv2.dilate(outline, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (9 * fine, 9 * fine)))
    picture = np.where(outline[..., None] > 0, black, picture)
    return eight(cv2.resize(picture, (SIDE, SIDE), interpolation=cv2.INTER_AREA))


def screen(side: int, pitch: float, turn: float) -> np.ndarray:
    """A halftone screen: the share of ink (0..1) from which a pixel is printed."""
    y, x = np.mgrid[:side, :side].astype(float)
    u = (np.cos(turn) * x + np.sin(turn) * y) / pitch % 1 - 0.5
    v = (np.cos(turn) * y - np.sin(turn) * x) / pitch % 1 - 0.5
    return np.pi * (u**2 + v**2)


def still_life(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Tone (0 black .. 1 white) and regions of a bottle, a bowl with three apples and a pear on a table."""
    tone, label = 0.93 - 0.62 * np.clip(x - 0.25, 0, 1) * (1 - 0.4 * y), np.zeros(x.shape, int)
    table = y > 0.7
    tone[table], label[table] = (0.86 - 0.25 * (y - 0.7) / 0.3)[table], 1
    cast = table & (((x - 0.62) / 0.42) ** 2 + ((y - 0.83) / 0.07) ** 2 < 1)
    tone[cast] = 0.22
    width = np.where(y < 0.3, 0.035, np.where(y < 0.42, 0.035 + 0.075 * np.sin((y - 0.3) / 0.12 * np.pi / 2), 0.11))
    bottle = (np.abs(x - 0.3) < width) & (y > 0.12) & (y < 0.86)
    across = (x - 0.3) / width
    tone[bottle] = (0.42 - 0.4 * across + 0.9 * np.exp(-(((across + 0.5) / 0.14) ** 2)))[bottle]
    label[bottle] = 2
    for k, (cx, cy, rx, ry) in enumerate(((0.56, 0.55, 0.1, 0.1), (0.78, 0.56, 0.095, 0.095), (0.67, 0.46, 0.1, 0.1))):
        u, v = (x - cx) / rx, (y - cy) / ry
        fruit = u**2 + v**2 < 1
        light = -0.55 * u - 0.6 * v + 0.58 * np.sqrt(np.clip(1 - u**2 - v**2, 0, 1))
        tone[fruit], label[fruit] = np.clip(0.3 + 0.75 * light, 0.05, 1)[fruit], 3 + k
        stalk = (np.abs(x - cx - 0.012) < 0.006) & (np.abs(v + 0.98) < 0.24)
        tone[stalk], label[stalk] = 0.02, 8
    u, v = (x - 0.67) / 0.25, (y - 0.6) / 0.22
    bowl = (u**2 + v**2 < 1) & (y > 0.6)
    tone[bowl] = (0.72 - 0.62 * u - 0.15 * v)[bowl]
    label[bowl] = 9
    rim = (np.abs(y - 0.605) < 0.012) & (np.abs(u) < 1)
    tone[rim], label[rim] = 0.95, 10
    return np.clip(tone, 0, 1), label


def cross_hatching() -> np.ndarray:
    """A still life in pen and ink: strokes in five directions, laid where the tone asks for them, and outlines."""
    rng, fine = np.random.default_rng(17), 2
    side = SIDE * fine
    tone, label = still_life(*grid(side))
    ink = np.zeros((side, side), np.uint8)
    layers = ((-0.75, 0.84, 9), (0.72, 0.64, 9), (0.02, 0.47, 8), (1.5, 0.33, 8), (-0.35, 0.2, 7))
    for turn, darker, pitch in layers:
        hatch(ink, tone, turn, darker, pitch * fine, rng)
    edges = np.zeros(label.shape, np.uint8)
    edges[:, :-1] |= label[:, :-1] != label[:, 1:]
    edges[:-1] |= label[:-1] != label[1:]
    shift = [np.float32(2.2 * fine) * noise(side, 14, rng).astype(np.float32) for _ in range(2)]
    rows, columns = np.mgrid[:side, :side].astype(np.float32)
    for offset in (0.0, 3.0):
        x, y = (base + drift + np.float32(offset) for base, drift in zip((columns, rows), shift, strict=True))
        moved = cv2.remap(cv2.dilate(edges, np.ones((4, 4), np.uint8)) * 255, x, y, cv2.INTER_LINEAR)
        ink = np.maximum(ink, moved)
    drawn = cv2.resize(ink, (SIDE, SIDE), interpolation=cv2.INTER_AREA)[..., None] / 255
    paper = rgb("f6f0e2") * (1 + 0.012 * noise(SIDE, 220, rng) + 0.01 * noise(SIDE, 5, rng))[..., None]
    return eight(paper * (1 - drawn) + rgb("1b1a22") * drawn)


def hatch(
    ink: np.ndarray, tone: np.ndarray, turn: float, darker: float, pitch: float, rng: np.random.Generator
) -> None:
    """Draw strokes along one direction where the tone is darker than `darker`, in place."""
    side, along, across = len(ink), np.array([np.cos(turn), np.sin(turn)]), np.array([-np.sin(turn), np.cos(turn)])
    reach = side * 0.75
    for offset in np.arange(-reach, reach, pitch):
        place = -reach
        while place < reach:
            length = rng.uniform(5, 12) * pitch
            steps = np.linspace(place, place + length, 8)
            bow = rng.normal(0, 0.12) * pitch * np.sin(np.linspace(0, np.pi, 8)) + rng.normal(0, 0.13) * pitch
            path = side / 2 + steps[:, None] * along + (offset + bow)[:, None] * across
            inside = ((path >= 0) & (path < side)).all(axis=1)
            pixels = np.clip(path, 0, side - 1).astype(int)
            wanted = inside & (tone[pixels[:, 1], pixels[:, 0]] < darker + rng.normal(0, 0.025))
            for k in range(7):
                if wanted[k] and wanted[k + 1]:
                    wide = 3 + (2 <= k <= 5)
                    ends = [tuple(int(v) for v in np.round(path[j])) for j in (k, k + 1)]
                    cv2.line(ink, ends[0], ends[1], 255, wide, cv2.LINE_AA)
            place += length + rng.uniform(0.3, 1.2) * pitch


def river_park(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Colours (0..255) of a river bank on a summer afternoon: sky, far trees, water with sails, lawn, shade, trunks."""
    colour = rgb("a9cdea") + (rgb("f7e6c3") - rgb("a9cdea")) * np.clip(y / 0.3, 0, 1)[..., None]
    colour[y > 0.27 + 0.03 * np.sin(9 * x) + 0.02 * np.sin(23 * x)] = rgb("5d8f6a")
    shore = 0.36 + 0.01 * np.sin(6 * x)
    water = y > shore
    ripple = 0.5 + 0.5 * np.sin(120 * y + 4 * np.sin(9 * x))
    colour[water] = (rgb("3f7fb5") + ripple[..., None] * (rgb("8fc0dc") - rgb("3f7fb5")))[water]
    for cx, size in ((0.22, 0.09), (0.4, 0.06), (0.58, 0.075)):
        sail = (
            (y < 0.43)
            & (y > 0.43 - 1.9 * size)
            & (np.abs(x - cx) < size * 0.55 * (y - 0.43 + 1.9 * size) / (1.9 * size))
        )
        colour[sail] = rgb("fff6e6")
        colour[(np.abs(y - 0.437) < 0.008) & (np.abs(x - cx) < size * 0.7)] = rgb("7a3b2e")
    lawn = y > 0.58 + 0.18 * (x - 0.5) ** 2 - 0.12 * x
    colour[lawn] = rgb("a8bf45")
    shade = lawn & (y > 0.74 + 0.04 * np.sin(8 * x) - 0.05 * x)
    colour[shade] = rgb("3e7048")
    crown = (np.hypot((x - 0.9) / 1.25, y - 0.13) < 0.24 + 0.02 * np.sin(14 * x)) | (np.hypot(x - 0.02, y - 0.1) < 0.17)
    colour[crown] = rgb("2f6b3c")
    colour[(np.abs(x - 0.86 - 0.02 * np.sin(6 * y)) < 0.022) & (y > 0.3) & (y < 0.8)] = rgb("5a3a4e")
    for cx, cy, dress in ((0.3, 0.8, "b8324a"), (0.52, 0.72, "3b3f8f"), (0.66, 0.86, "e08a2e")):
        h = 0.2
        body = (y < cy) & (y > cy - 0.65 * h) & (np.abs(x - cx) < 0.018 + 0.055 * (y - cy + 0.65 * h) / (0.65 * h))
        colour[body] = rgb(dress)
        colour[np.hypot(x - cx, y - cy + 0.75 * h) < 0.02] = rgb("e9b48c")
        colour[(np.hypot((x - cx) / 2.6, y - cy + 0.98 * h) < 0.03) & (y < cy - 0.98 * h + 0.008)] = rgb("e9dfb8")
    return colour


def pointillism() -> np.ndarray:
    """The park in dabs of unmixed colour: dots of each place's hue, of its neighbours, and a few of its opposite."""
    rng, fine = np.random.default_rng(2), 2
    side = SIDE * fine
    colours = river_park(*grid(512))
    picture = np.broadcast_to(rgb("efe4cc"), (side, side, 3)).astype(np.uint8).copy()
    for count, radius in ((26000, 6.2), (30000, 4.8)):
        places = rng.random((count, 2))
        at = np.clip(((places + rng.normal(0, 0.004, places.shape)) * 512).astype(int), 0, 511)
        chosen = cv2.cvtColor(eight(colours[at[:, 1], at[:, 0]])[None], cv2.COLOR_RGB2HSV)[0].astype(float)
        chosen[:, 0] += rng.normal(0, 9, count) + np.where(rng.random(count) < 0.1, 90, 0)
        chosen[:, 1] = np.clip(chosen[:, 1] * rng.uniform(0.9, 1.7, count) + 18, 0, 255)
        chosen[:, 2] = np.clip(chosen[:, 2] * rng.normal(1.02, 0.13, count), 0, 255)
        chosen[:, 0] %= 180
        dabs = cv2.cvtColor(chosen.astype(np.uint8)[None], cv2.COLOR_HSV2RGB)[0]
        for place, dab in zip(places, dabs, strict=True):
            size = radius * fine * rng.uniform(0.75, 1.2) * 0.8
            centre = (int(place[0] * side), int(place[1] * side))
            axes = (int(size * 1.15), int(size * 0.9))
            cv2.ellipse(
                picture, centre, axes, float(rng.uniform(0, 180)), 0, 360, [int(v) for v in dab], -1, cv2.LINE_AA
            )
    canvas = 1 + 0.02 * noise(SIDE, 250, rng)
    return eight(cv2.resize(picture, (SIDE, SIDE), interpolation=cv2.INTER_AREA) * canvas[..., None])


def watercolour() -> np.ndarray:
    """Hills, a lake and blossoms in transparent washes: dark rims, blooms, granulation, white paper left between."""
    rng, (x, y) = np.random.default_rng(9), grid()
    warp = [0.012 * noise(SIDE, 9, rng) + 0.003 * noise(SIDE, 40, rng) for _ in range(2)]
    u, v = x + warp[0], y + warp[1]
    ridge = [0.3 + 0.1 * np.sin(4 * u + 1) + 0.04 * np.sin(13 * u), 0.42 + 0.09 * np.sin(5 * u + 3.4), 0.62]
    sun = 0.075 - np.hypot(u - 0.72, v - 0.14)
    areas = [
        (0.25 - v, "4f8fc9", 0.5), (np.minimum(v - 0.04, 0.16 - np.abs(u - 0.35) * 0.3 - v), "8fb6d8", 0.35),
        (np.minimum(v - ridge[0], ridge[2] - v), "7d74b8", 0.7),
        (np.minimum(v - ridge[1], ridge[2] + 0.01 - v), "3d8a74", 0.8),
        (np.minimum(v - 0.63, 0.8 - v), "2f79a8", 0.75),
        (np.minimum(v - 0.7 - 0.03 * np.sin(9 * u), 0.76 - v), "1f4f86", 0.5),
        (v - 0.79 - 0.05 * np.sin(4 * u), "8aa53a", 0.75), (v - 0.9 - 0.04 * np.sin(7 * u + 1), "3f6b2f", 0.7),
    ]  # fmt: skip
    near_u, near_v = x + 0.25 * warp[0], y + 0.25 * warp[1]
    blossoms, hearts = [], []
    for _ in range(34):
        cx, cy, r = rng.uniform(0.03, 0.97), rng.uniform(0.72, 0.97), rng.uniform(0.02, 0.042)
        away = np.hypot(near_u - cx, near_v - cy)
        petals = 0.8 + 0.24 * np.cos(5 * np.arctan2(near_v - cy, near_u - cx) + rng.uniform(0, 6))
        hue = ("d8436a", "e8743b", "b03a8a", "f2b632")[rng.integers(4)]
        blossoms.append((r * petals - away, hue, 0.95))
        hearts.append((0.26 * r - away, "5a2a3a", 0.9))
    # Blossoms and the sun stand on paper that the washes left white.
    left = np.max([sun, *(inside for inside, *_ in blossoms)], axis=0)
    light = np.ones((SIDE, SIDE, 3))
    for inside, hue, strength in areas:
        light *= wash(np.minimum(inside, -left - 0.002), rgb(hue) / 255, strength, rng)
    for inside, hue, strength in [*blossoms, *hearts, (sun, "f2a03d", 0.9)]:
        light *= wash(inside, rgb(hue) / 255, strength, rng)
    paper = rgb("fbf8f0") * (1 + 0.014 * noise(SIDE, 170, rng))[..., None]
    return eight(paper * light)


def wash(inside: np.ndarray, hue: np.ndarray, strength: float, rng: np.random.Generator) -> np.ndarray:
    """Transmission (h w 3) of one wash: pigment where `inside` (signed distance, in pictures) is positive.

    It is thicker at its rim, thin in blooms, and settles in the paper's grain.
    """
    cover = np.clip(inside * SIDE / 2.5 + 0.5, 0, 1)
    rim = np.exp(-((np.clip(inside, 0, None) * SIDE / 5) ** 2)) * cover
    flow = 1 + 0.22 * noise(SIDE, 5, rng) + 0.12 * noise(SIDE, 18, rng)
    bloom = noise(SIDE, 8, rng)
    edge = np.exp(-(((bloom - 1.1) / 0.09) ** 2))
    flow = np.where(bloom > 1.1, 0.75 * flow, flow) + 0.18 * edge
    grain = 1 + 0.1 * noise(SIDE, 260, rng)
    amount = strength * np.clip(cover * flow * grain + 0.45 * rim, 0, 2.2)
    return np.clip(hue, 0.02, 0.98) ** amount[..., None]
