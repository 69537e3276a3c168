"""The demo's form: a young elephant that steps forward, curls its trunk and carries a bird.

Y up, it looks along +Z, its feet stand on y = 0; metres. Every part is a distance function of points (n, 3).
"""

import numpy as np
from sculpt import blend, carve, closed_curve, ellipsoid, local, meet, mirrored, near, polygon, tube, turn

LOW, HIGH = (-1.15, -0.05, -1.1), (1.15, 2.1, 1.6)

# The head's frame: larger than life, turned to the elephant's right and tilted, about the nape.
NAPE, HEAD, HEAD_SIZE = np.array([0.0, 1.12, 0.30]), turn(x=3, y=-15, z=5), 1.16


def rings(arc: np.ndarray) -> np.ndarray:
    """Wrinkles of the trunk: rounded rings with narrow furrows that fade towards both ends."""
    wave = np.abs(np.sin(np.pi * arc / 0.088))
    return 0.019 * (np.sqrt(wave + 0.02) - 0.75) * np.clip((1.55 - arc) / 0.5, 0, 1) * np.clip((arc - 0.12) / 0.2, 0, 1)


# Trunk, nostril and tusk live in the head's frame (the nape is its origin).
TRUNK = tube(
    [(0, 0.05, 0.27, 0.215), (0, -0.09, 0.44, 0.185), (-0.005, -0.32, 0.53, 0.148), (-0.02, -0.55, 0.575, 0.122),
     (-0.05, -0.735, 0.675, 0.105), (-0.10, -0.77, 0.83, 0.093), (-0.145, -0.64, 0.945, 0.083),
     (-0.155, -0.49, 0.915, 0.075), (-0.135, -0.42, 0.82, 0.072)],
    rings=rings,
)  # fmt: skip
NOSTRIL = tube([(-0.125, -0.39, 0.76, 0.036), (-0.145, -0.44, 0.86, 0.018)])
TUSK = tube(
    [(0.13, -0.18, 0.36, 0.05), (0.185, -0.32, 0.53, 0.047), (0.225, -0.385, 0.66, 0.037), (0.25, -0.35, 0.775, 0.018)]
)
EYE_AT, EYE_TURN, EYE_SIZE = (0.262, 0.085, 0.372), turn(y=50) @ turn(x=-6), 1.2
LIDS = (
    tube([(-0.080, -0.016, -0.006, 0.013), (-0.046, 0.030, 0.018, 0.017), (0.0, 0.046, 0.026, 0.020),
          (0.046, 0.028, 0.016, 0.017), (0.088, -0.012, -0.016, 0.012)]),
    tube([(-0.076, -0.020, -0.006, 0.011), (-0.034, -0.046, 0.012, 0.013), (0.02, -0.050, 0.014, 0.013),
          (0.080, -0.016, -0.012, 0.011)]),
    tube([(-0.088, 0.056, -0.008, 0.008), (-0.03, 0.090, 0.000, 0.014), (0.03, 0.090, -0.004, 0.014),
          (0.092, 0.056, -0.026, 0.008)]),
)  # fmt: skip
SMILE_KNOTS = [(0.15, -0.325, 0.43, 0.026), (0.225, -0.262, 0.40, 0.022), (0.296, -0.205, 0.335, 0.014)]
SMILE = tube([*SMILE_KNOTS, (0.335, -0.14, 0.28, 0.006)])
TAIL = tube(
    [(0, 0.97, -0.66, 0.075), (-0.01, 0.92, -0.78, 0.048), (-0.06, 0.72, -0.86, 0.034), (-0.12, 0.54, -0.86, 0.028),
     (-0.20, 0.43, -0.87, 0.026)]
)  # fmt: skip
BIRD_SIZE = 1.3
BEAK = tube([(0, 0.092, 0.11, 0.028), (0, 0.084, 0.145, 0.020), (0, 0.075, 0.178, 0.011)])
LEGS = (
    [(-0.22, 0.66, 0.22, 0.20), (-0.235, 0.38, 0.25, 0.158), (-0.24, 0.21, 0.265, 0.150), (-0.24, 0.06, 0.275, 0.170)],
    [(0.22, 0.66, 0.25, 0.20), (0.24, 0.40, 0.39, 0.160), (0.25, 0.21, 0.47, 0.148), (0.255, 0.06, 0.50, 0.170)],
    [(-0.21, 0.68, -0.44, 0.24), (-0.235, 0.40, -0.31, 0.18), (-0.24, 0.21, -0.29, 0.152), (-0.245, 0.06, -0.26, 0.17)],
    [(0.21, 0.68, -0.46, 0.24), (0.23, 0.40, -0.50, 0.18), (0.235, 0.21, -0.57, 0.152), (0.235, 0.06, -0.58, 0.17)],
)
LEG_TUBES = tuple(tube(knots) for knots in LEGS)

EAR_OUTLINE = closed_curve(
    [(-0.06, 0.18), (0.08, 0.34), (0.30, 0.42), (0.53, 0.33), (0.66, 0.10), (0.645, -0.16), (0.53, -0.37),
     (0.37, -0.60), (0.25, -0.50), (0.14, -0.28), (-0.04, -0.14)]
)  # fmt: skip
EAR_AT, EAR_TURN = (0.255, 0.10, 0.08), turn(x=-8, y=26, z=5)


def leg(p: np.ndarray, index: int) -> np.ndarray:
    """One leg with a soft pad, creases that run round it unevenly, and four toenails, standing on y = 0."""
    foot = np.array(LEGS[index][-1][:3])
    d = LEG_TUBES[index](p)
    d = blend(d, ellipsoid(p, foot + [0, -0.01, 0.035], (0.178, 0.10, 0.182)), 0.06)
    round_it = np.arctan2(p[:, 0] - foot[0], p[:, 2] - foot[2])
    front = np.clip(0.35 + 0.65 * np.cos(round_it), 0.15, 1)
    for height, depth, wave in ((0.17, 0.013, 0.3), (0.225, 0.009, 1.3), (0.36, 0.012, 2.2), (0.405, 0.007, 0.9)):
        crease = p[:, 1] - height + 0.018 * np.cos(round_it) - 0.006 * np.sin(3 * round_it + wave + index)
        d = d + depth * front * np.exp(-((crease / 0.013) ** 2))
    d = meet(d, -p[:, 1], 0.03)
    for angle in (-57, -20, 20, 57):
        a = np.radians(angle)
        nail = foot + [0.170 * np.sin(a), -0.015, 0.035 + 0.174 * np.cos(a)]
        d = blend(d, ellipsoid(p, nail, (0.043, 0.045, 0.024), turn(y=angle) @ turn(x=-14)), 0.010)
    return d


def body(p: np.ndarray) -> np.ndarray:
    """Barrel, rump, shoulders, hips and neck; a low spine and folds where skin hangs."""
    m = mirrored(p)
    d = ellipsoid(p, (0, 0.83, -0.10), (0.415, 0.40, 0.50))
    d = blend(d, ellipsoid(p, (0, 0.88, -0.40), (0.38, 0.39, 0.34)), 0.18)
    d = blend(d, ellipsoid(m, (0.20, 0.80, 0.18), (0.20, 0.33, 0.21), turn(x=10)), 0.12)
    d = blend(d, ellipsoid(m, (0.205, 0.72, -0.41), (0.205, 0.31, 0.25)), 0.12)
    d = blend(d, ellipsoid(p, (0, 1.03, 0.22), (0.26, 0.27, 0.28)), 0.2)
    spine = np.exp(-((p[:, 0] / 0.045) ** 2)) * np.clip((p[:, 1] - 0.95) / 0.2, 0, 1)
    d = d - 0.014 * spine
    # Hanging folds of the flank: arcs between shoulder and hip, and two across the chest.
    flank = np.hypot(p[:, 1] - 1.32, p[:, 2] + 0.12)
    for radius, depth in ((0.58, 0.007), (0.66, 0.010), (0.74, 0.008)):
        d = d + depth * np.exp(-(((flank - radius) / 0.016) ** 2)) * np.clip(1 - np.abs(p[:, 2] + 0.12) / 0.22, 0, 1)
    return d


def ear(m: np.ndarray) -> np.ndarray:
    """A thin cupped sheet with rolled rim, folded upper edge, ruffles and low veins (x > 0 side)."""
    q = local(m, EAR_AT, EAR_TURN)
    u, v, w = q[:, 0], q[:, 1], q[:, 2]
    reach = np.clip(u / 0.66, 0, 1.2)
    angle = np.arctan2(v + 0.05, u + 0.15)
    ruffle = 0.055 * np.sin(6.0 * angle + 0.4) * reach**2
    sheet = 0.20 * reach - 0.30 * reach**2 + ruffle - 0.20 * np.clip(v - 0.24, 0, 1)
    edge = polygon(np.stack([u, v], axis=1), EAR_OUTLINE)
    inner = np.clip(-edge / 0.08, 0, 1)
    vein = np.exp(-((np.sin(4.5 * angle + 0.5 * reach) / 0.26) ** 2)) * np.clip(reach * 2, 0, 1) * inner
    rim = np.exp(-(((edge + 0.028) / 0.020) ** 2))
    thick = 0.019 + 0.034 * np.clip(1 - reach * 1.6, 0, 1) + 0.014 * vein + 0.015 * rim
    return meet(edge, (np.abs(w - sheet) - thick) * 0.85, 0.03)


def eye(skull: np.ndarray, m: np.ndarray) -> np.ndarray:
    """Brow, socket, ball with a drilled pupil, two lids and a fold above, in a frame that lies on the temple."""
    q = local(m, EYE_AT, EYE_TURN) / EYE_SIZE
    d = skull / EYE_SIZE
    d = blend(d, ellipsoid(q, (-0.015, 0.105, -0.020), (0.105, 0.045, 0.045), turn(z=8)), 0.08)
    d = carve(d, ellipsoid(q, (0, -0.004, 0.026), (0.092, 0.064, 0.034)), 0.06)
    d = blend(d, ellipsoid(q, (0, 0, -0.036), (0.064, 0.064, 0.064)), 0.006)
    d = carve(d, ellipsoid(q, (-0.010, 0.004, 0.030), (0.021, 0.023, 0.016)), 0.008)
    for lid in LIDS:
        d = blend(d, lid(q), 0.026)
    return EYE_SIZE * d


def head(p: np.ndarray) -> np.ndarray:
    """Skull with two forehead domes, cheeks, a smile, eyes, trunk, tusks and ears."""
    q = local(p, NAPE, HEAD) / HEAD_SIZE
    m = mirrored(q)
    d = ellipsoid(q, (0, 0.07, 0.18), (0.315, 0.33, 0.325))
    d = blend(d, ellipsoid(m, (0.115, 0.255, 0.22), (0.165, 0.165, 0.20)), 0.09)
    d = blend(d, ellipsoid(m, (0.205, -0.085, 0.26), (0.13, 0.16, 0.17)), 0.10)
    d = blend(d, TRUNK(q), 0.12)
    d = blend(d, ellipsoid(q, (0, -0.285, 0.27), (0.15, 0.085, 0.20), turn(x=30)), 0.05)
    d = carve(d, SMILE(m), 0.02)
    d = eye(d, m)
    d = blend(d, TUSK(m), 0.022)
    d = carve(d, NOSTRIL(q), 0.02)
    return HEAD_SIZE * blend(d, near(m, (0.52, 0.05, 0.0), 0.62, ear), 0.05)


def tail(p: np.ndarray) -> np.ndarray:
    """A thin tail with a twisted tuft."""
    at, rotation = (-0.225, 0.355, -0.875), turn(z=-18)
    q = local(p, at, rotation)
    twist = np.arctan2(q[:, 2], q[:, 0]) * 3 + 20 * q[:, 1]
    tuft = ellipsoid(p, at, (0.055, 0.130, 0.055), rotation) + 0.007 * np.sin(twist)
    return blend(TAIL(p), tuft, 0.03)


def bird(p: np.ndarray) -> np.ndarray:
    """A small round bird with open beak, folded wings and a cocked tail, nestled on the back."""
    q = local(p, (-0.04, 1.375, -0.30), turn(y=50)) / BIRD_SIZE
    m = mirrored(q)
    d = ellipsoid(q, (0, 0, 0), (0.080, 0.082, 0.108), turn(x=-20))
    d = blend(d, ellipsoid(q, (0, 0.088, 0.072), (0.062, 0.060, 0.062)), 0.035)
    d = blend(d, BEAK(q), 0.012)
    d = blend(d, ellipsoid(m, (0.049, 0.104, 0.103), (0.015, 0.015, 0.015)), 0.004)
    d = blend(d, ellipsoid(m, (0.070, 0.004, -0.030), (0.030, 0.055, 0.110), turn(x=-24, y=8)), 0.016)
    d = blend(d, ellipsoid(q, (0, 0.050, -0.150), (0.042, 0.024, 0.105), turn(x=32)), 0.025)
    return BIRD_SIZE * blend(d, ellipsoid(q, (0, -0.075, 0.0), (0.055, 0.06, 0.065)), 0.02)


def world_from_head(q) -> np.ndarray:
    """A point of the head's frame in the world."""
    return NAPE + HEAD @ (HEAD_SIZE * np.asarray(q, float))


# Where the decimation looks closer: (centre, radius, gain) of the eyes and the bird.
LENSES = (
    (world_from_head(EYE_AT), 0.22, 1.4),
    (world_from_head(np.array(EYE_AT) * [-1, 1, 1]), 0.22, 1.4),
    (np.array([-0.04, 1.42, -0.30]), 0.34, 1.3),
)


def elephant(p: np.ndarray) -> np.ndarray:
    """Distance (n,) of points (n, 3) to the whole figure."""
    d = body(p)
    for index in range(4):
        d = blend(d, near(p, (LEGS[index][1][0], 0.4, LEGS[index][1][2]), 0.72, lambda x, i=index: leg(x, i)), 0.09)
    d = blend(d, tail(p), 0.05)
    d = blend(d, head(p), 0.08)
    d = blend(d, near(p, (-0.04, 1.39, -0.30), 0.34, bird), 0.014)
    return meet(d, -p[:, 1], 0.02)
