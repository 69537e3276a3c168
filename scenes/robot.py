"""The demo's second form: a tin toy robot that waves, with a key in its back.

Y up, it looks along +Z, its feet stand on y = 0; metres. Every part is a closed shell of its own, rounded boxes, turned
forms and bent tubes, so that there are flat faces, cylinders and small parts, all with edges that catch light.
"""

import numpy as np
from sculpt import spline, turn

Shell = tuple[np.ndarray, np.ndarray]  # vertices (v, 3), counter-clockwise faces (f, 3)
SIDES = 14
RIBS = 25  # rings of an arm, four a rib


def from_quads(vertices: np.ndarray, quads: np.ndarray) -> Shell:
    """Quads (q, 4) of any vertices, welded, as triangles without those that have no area."""
    keys, index = np.unique(np.round(vertices, 7), axis=0, return_inverse=True)
    faces = index.reshape(-1)[np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])]
    solid = (faces != np.roll(faces, 1, axis=1)).all(axis=1)
    return keys, faces[solid]


def grid_quads(rows: int, columns: int) -> np.ndarray:
    """Quads (q, 4) of a grid of vertices, row by row."""
    i = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).ravel()
    return np.stack([i, i + 1, i + columns + 1, i + columns], axis=1)


def box(half, radius: float, at=(0, 0, 0), rotation: np.ndarray | None = None) -> Shell:
    """A rounded box of half sizes `half`."""
    half = np.asarray(half, float)
    bends = radius * (1 - np.tan(np.radians([45, 22.5, 0] if radius > 0.03 else [45, 0])))
    cuts = [np.unique(np.round(np.concatenate([bends - h, h - bends]), 9)) for h in half]
    vertices, quads, count = [], [], 0
    for axis in range(3):
        a, b = (axis + 1) % 3, (axis + 2) % 3
        for side in (-1, 1):
            v, u = np.meshgrid(cuts[b], cuts[a], indexing="ij")
            p = np.zeros((v.size, 3))
            p[:, a], p[:, b], p[:, axis] = u.ravel(), v.ravel(), side * half[axis]
            q = grid_quads(*v.shape) + count
            vertices.append(p)
            quads.append(q if side > 0 else q[:, ::-1])
            count += len(p)
    p = np.concatenate(vertices)
    core = np.clip(p, radius - half, half - radius)
    away = p - core
    p = core + radius * away / np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-12)
    return placed(from_quads(p, np.concatenate(quads)), at, rotation)


def lathe(profile, at=(0, 0, 0), rotation: np.ndarray | None = None, sides: int = SIDES) -> Shell:
    """A turned form about +Y: `profile` are (radius, height) from the lower pole to the upper one; outer corners of
    the profile are the maker's to round."""
    radius, height = np.array(profile, float).T
    around = np.linspace(0, 2 * np.pi, sides + 1)[:-1]
    around = np.append(around, around[:1])
    p = np.stack(
        [
            radius[:, None] * np.sin(around),
            np.broadcast_to(height[:, None], (len(radius), len(around))),
            radius[:, None] * np.cos(around),
        ],
        axis=-1,
    )
    return placed(from_quads(p.reshape(-1, 3), grid_quads(len(radius), len(around))), at, rotation)


def drum(radius: float, length: float, bevel: float) -> list[tuple[float, float]]:
    """Profile of a disc with rounded rims that lies between heights 0 and `length`."""
    bend = np.radians(np.linspace(0, 90, 3))
    low = [(radius - bevel + bevel * np.sin(a), bevel - bevel * np.cos(a)) for a in bend]
    return [(0, 0), *low, *[(r, length - h) for r, h in reversed(low)], (0, length)]


def ball(radius: float, rows: int = 11) -> list[tuple[float, float]]:
    """Profile of a sphere."""
    return [(radius * np.sin(a), -radius * np.cos(a)) for a in np.linspace(0, np.pi, rows)]


def bellows(radius: float, length: float, folds: int) -> list[tuple[float, float]]:
    """Profile of a pleated tube."""
    t = np.linspace(0, 1, 4 * folds + 1)
    ring = radius * (1 - 0.16 * np.abs(np.cos(np.pi * folds * t)) ** 0.7)
    return [(0, 0), *zip(ring, t * length, strict=True), (0, length)]


def hose(knots, sides: int = 14, samples: int = 20, closed: bool = False) -> Shell:
    """A bent tube through `knots` (x, y, z, radius), with rounded ends, or joined into a ring."""
    knots = np.asarray(knots, float)
    curve = spline(np.vstack([knots, knots[:2]]) if closed else knots, samples)
    if closed:
        curve = spline(np.vstack([knots[-1:], knots, knots[:2]]), 3 * (len(knots) + 2) + 1)[3 : 3 * (len(knots) + 1)]
    line, radius = curve[:, :3], curve[:, 3]
    along = np.roll(line, -1, 0) - np.roll(line, 1, 0) if closed else np.gradient(line, axis=0)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    side = np.cross(along[0], np.eye(3)[np.abs(along[0]).argmin()])
    around = np.linspace(0, 2 * np.pi, sides + 1)
    around[-1] = 0
    rings = []
    for centre, way, r in zip(line, along, radius, strict=True):
        side = side - (side @ way) * way
        side /= np.linalg.norm(side)
        other = np.cross(way, side)
        rings.append((centre, way, side, other, r))
    if closed:
        rings.append(rings[0])
    else:
        rings = [*cap(rings[0], -1), *rings, *cap(rings[-1], 1)]
    p = np.stack([c + r * (np.cos(around)[:, None] * s + np.sin(around)[:, None] * o) for c, _, s, o, r in rings])
    return from_quads(p.reshape(-1, 3), grid_quads(len(rings), len(around)))


def cap(ring, sense: int) -> list:
    """The rounded end of a tube: rings that shrink to a point."""
    centre, way, side, other, r = ring
    bend = np.radians([30, 60, 90] if sense > 0 else [90, 60, 30])
    return [(centre + sense * np.sin(a) * r * way, way, side, other, r * np.cos(a)) for a in bend]


def placed(shell: Shell, at, rotation: np.ndarray | None) -> Shell:
    """Turned, then moved."""
    vertices, faces = shell
    return (vertices if rotation is None else vertices @ rotation.T) + np.asarray(at, float), faces


FRONT, LEFT, RIGHT, BACK = turn(x=90), turn(z=-90), turn(z=90), turn(x=-90)


def legs() -> list[Shell]:
    """Boots, pleated legs and the hip."""
    shells = [box((0.215, 0.065, 0.135), 0.045, (0, 0.395, 0))]
    for side in (-1, 1):
        x, forward = 0.120 * side, 0.030 * side
        shells += [
            box((0.092, 0.058, 0.150), 0.040, (x, 0.058, 0.035 + forward)),
            lathe(drum(0.082, 0.05, 0.018), (x, 0.100, forward)),
            lathe(bellows(0.070, 0.215, 4), (x, 0.140, forward * 0.7)),
        ]
    return shells


def trunk() -> list[Shell]:
    """The body's box with a panel, a dial and its needle, three knobs, rivets, and the key in the back."""
    shells = [
        box((0.270, 0.225, 0.180), 0.055, (0, 0.665, 0)),
        box((0.195, 0.140, 0.022), 0.020, (0, 0.680, 0.178)),
        lathe([(0, 0), (0.080, 0), (0.090, 0.006), (0.092, 0.022), (0.086, 0.032), (0.076, 0.034), (0.070, 0.026),
               (0.066, 0.022), (0, 0.022)], (-0.085, 0.700, 0.196), FRONT),
        box((0.0075, 0.033, 0.008), 0.0055, (-0.072, 0.722, 0.222), turn(z=-32)),
    ]  # fmt: skip
    for k, y in enumerate((0.765, 0.695, 0.625)):
        dome = [
            (0, 0),
            (0.034, 0),
            (0.038, 0.006),
            (0.036, 0.018 + 0.004 * k),
            (0.024, 0.034),
            (0.010, 0.040),
            (0, 0.041),
        ]
        shells.append(lathe(dome, (0.105, y, 0.196), FRONT, 16))
    shells.append(box((0.072, 0.014, 0.012), 0.010, (-0.085, 0.575, 0.202)))
    for x in (-0.226, 0.226):
        for y in (0.485, 0.845):
            shells.append(lathe([(0, -0.01), (0.017, -0.01), (0.017, 0.003), (0.010, 0.011), (0, 0.013)], (x, y, 0.172),
                                FRONT, 10))  # fmt: skip
    shells.append(lathe(drum(0.028, 0.130, 0.010), (0, 0.690, -0.170), BACK, 14))
    for side in (-1, 1):
        a = np.linspace(0, 2 * np.pi, 9)[:-1]
        ring = np.stack(
            [side * (0.070 + 0.058 * np.cos(a)), 0.690 + 0.050 * np.sin(a), 0 * a - 0.290, 0 * a + 0.019], 1
        )
        shells.append(hose(ring, 8, closed=True))
    return shells


def skull() -> list[Shell]:
    """Neck, head, eyes in rings, a mouth of teeth, ears with bolts, brows and a spring with a ball on top."""
    at = np.array([0.0, 1.120, 0.0])
    lean = turn(z=7, y=-9)

    def on(shell: Shell) -> Shell:
        return placed(shell, at, lean)

    shells = [lathe(bellows(0.088, 0.100, 3), (0, 0.880, 0)), on(box((0.215, 0.160, 0.170), 0.060))]
    for side in (-1, 1):
        rim = [(0, 0), (0.066, 0), (0.072, 0.008), (0.072, 0.026), (0.064, 0.034), (0.056, 0.030), (0.052, 0.018),
               (0.050, 0.014), (0.044, 0.030), (0.030, 0.042), (0.014, 0.048), (0, 0.049)]  # fmt: skip
        shells.append(on(lathe(rim, (0.093 * side, 0.038, 0.164), FRONT)))
        shells.append(on(box((0.058, 0.011, 0.016), 0.009, (0.093 * side, 0.131, 0.176), turn(z=-13 * side))))
        ear = [(0, 0), (0.080, 0), (0.086, 0.010), (0.086, 0.030), (0.072, 0.042), (0.040, 0.046), (0.034, 0.060),
               (0.034, 0.078), (0.024, 0.088), (0, 0.090)]  # fmt: skip
        shells.append(on(lathe(ear, (0.205 * side, 0.0, 0.0), LEFT if side > 0 else RIGHT)))
    shells.append(on(box((0.125, 0.040, 0.016), 0.014, (0, -0.085, 0.168))))
    for x in np.linspace(-0.084, 0.084, 4):
        shells.append(on(box((0.0195, 0.027, 0.014), 0.008, (x, -0.085, 0.182))))
    spring = [(0, 0), (0.075, 0), (0.080, 0.010), (0.062, 0.028), (0.034, 0.034)]
    t = np.linspace(0, 1, 17)
    spring += [(0.021 + 0.008 * np.cos(2 * np.pi * 4 * s), 0.036 + 0.115 * s) for s in t]
    shells.append(on(lathe([*spring, (0, 0.152)], (0, 0.155, 0), sides=14)))
    shells.append(on(lathe(ball(0.056), (0, 0.350, 0), sides=14)))
    return shells


def arm(side: int, raised: bool) -> list[Shell]:
    """A shoulder, a ribbed hose for an arm, a cuff and a claw of three fingers."""
    shoulder = np.array([0.262 * side, 0.800, 0.0])
    if raised:
        path = [(0.0, 0, 0), (0.10, -0.015, 0.015), (0.20, 0.045, 0.035), (0.235, 0.170, 0.045), (0.225, 0.270, 0.050)]
        turned = turn(z=4 * side)
    else:
        path = [
            (0.0, 0, 0),
            (0.09, -0.045, 0.01),
            (0.135, -0.160, 0.035),
            (0.125, -0.270, 0.095),
            (0.115, -0.325, 0.150),
        ]
        turned = turn(x=-46, z=0) @ turn(x=180)
    line = spline([(x * side, y, z, 0.05) for x, y, z in path], RIBS)
    line[:, 3] = 0.050 * (1 - 0.17 * np.abs(np.cos(np.pi * np.arange(RIBS) / 4)) ** 0.7)
    line[:, :3] += shoulder
    hand = line[-1, :3]

    def on(shell: Shell) -> Shell:
        return placed(shell, hand, turned)

    shells = [
        lathe(drum(0.092, 0.058, 0.022), shoulder - [0.018 * side, 0, 0], LEFT if side > 0 else RIGHT),
        hose(line, 10, RIBS),
        on(lathe([(0, -0.02), (0.058, -0.02), (0.064, -0.008), (0.072, 0.060), (0.080, 0.068), (0.080, 0.084),
                  (0.070, 0.092), (0, 0.094)], sides=20)),
    ]  # fmt: skip
    for angle in (0, 120, 240):
        finger = [
            (0.038, 0.080, 0, 0.022),
            (0.082, 0.118, 0, 0.022),
            (0.092, 0.165, 0, 0.020),
            (0.060, 0.205, 0, 0.014),
        ]
        spun = turn(y=angle + (90 if side > 0 else 30))
        vertices, faces = hose(finger, 8, 6)
        shells.append(on((vertices @ spun.T, faces)))
    return shells


def shells() -> list[Shell]:
    """All parts, from the ground up."""
    return [*legs(), *trunk(), *arm(-1, True), *arm(1, False), *skull()]


def normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Unit vertex normals (v, 3): large faces weigh more, so that flat sides look flat and bevels round."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    across = np.cross(b - a, c - a)
    total = np.zeros_like(vertices)
    for k in range(3):
        np.add.at(total, faces[:, k], across)
    return total / np.linalg.norm(total, axis=1, keepdims=True)


def robot() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Vertices (v, 3), faces (f, 3) and unit vertex normals (v, 3) of the whole figure, its soles on y = 0."""
    vertices, faces, count = [], [], 0
    for points, corners in shells():
        vertices.append(points)
        faces.append(corners + count)
        count += len(points)
    every, index = np.concatenate(vertices), np.concatenate(faces)
    every = every - [0, every[:, 1].min(), 0]
    return every, index, normals(every, index)
