"""USD's analytic shapes (spheres, cubes, cylinders, cones, capsules, planes) as polygons with normals."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int

ROUND = 64  # corners of a circle
RINGS = 32  # circles of a sphere from pole to pole
SHAPES = ("Sphere", "Cube", "Cylinder", "Cone", "Capsule", "Plane")
TURNS = {"X": (2, 0, 1), "Y": (1, 2, 0), "Z": (0, 1, 2)}  # (x, y, z) of a shape along Z -> along the named axis


@dataclass(frozen=True)
class Outline:
    """Polygons: points, corners of each, their points, and the normal at every corner (not unit)."""

    points: Float[np.ndarray, "v 3"]
    sizes: Int[np.ndarray, " p"]
    vertices: Int[np.ndarray, " c"]
    normals: Float[np.ndarray, "c 3"]


def is_shape(prim: Any) -> bool:
    return str(prim.GetTypeName()) in SHAPES


def outline(prim: Any, time: Any) -> Outline:
    """The surface of a shape at a time, with its own attributes (radius, height, size, axis)."""

    def attribute_value(name: str, default: Any) -> Any:
        attribute = prim.GetAttribute(name)
        value = attribute.Get(time) if attribute else None
        return default if value is None else value

    kind = str(prim.GetTypeName())
    if kind == "Cube":
        return _box(np.full(3, float(attribute_value("size", 2.0)) / 2))
    radius, height = (
        float(attribute_value("radius", 0.5 if kind == "Capsule" else 1.0)),
        float(attribute_value("height", 1.0 if kind == "Capsule" else 2.0)),
    )
    builders: dict[str, Callable[[], Outline]] = {
        "Sphere": lambda: _turned(*_ball(radius, 0.0)),
        "Capsule": lambda: _turned(*_ball(radius, height / 2)),
        "Cylinder": lambda: _turned(*_drum(radius, radius, height)),
        "Cone": lambda: _turned(*_drum(radius, 0.0, height)),
        "Plane": lambda: _sheet(float(attribute_value("width", 2.0)), float(attribute_value("length", 2.0))),
    }
    shape = builders[kind]()
    order = list(TURNS.get(str(attribute_value("axis", "Z")), TURNS["Z"]))
    return Outline(shape.points[:, order], shape.sizes, shape.vertices, shape.normals[:, order])


def _box(half: Float[np.ndarray, "3"]) -> Outline:
    points, normals, vertices = [], [], []
    for axis in range(3):
        for side in (-1.0, 1.0):
            u, v = (axis + 1) % 3, (axis + 2) % 3
            for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))[:: int(side)]:
                corner = np.zeros(3)
                corner[axis], corner[u], corner[v] = side, a, b
                points.append(corner * half)
                normals.append(np.eye(3)[axis] * side)
            vertices += range(len(points) - 4, len(points))
    # Corners at equal positions are one point: faces of a cube are connected.
    unique, inverse = np.unique(np.array(points), axis=0, return_inverse=True)
    return Outline(unique, np.full(6, 4), inverse.reshape(-1)[vertices], np.array(normals))


def _sheet(width: float, length: float) -> Outline:
    half = np.array([width / 2, length / 2, 0.0])
    points = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) * half
    return Outline(points, np.array([4]), np.arange(4), np.tile([0.0, 0.0, 1.0], (4, 1)))


def _ball(radius: float, half: float) -> tuple[np.ndarray, np.ndarray]:
    """Profiles (distance from the axis, height) and normals of a sphere whose halves are 2 · half apart."""
    angle = np.linspace(-np.pi / 2, np.pi / 2, RINGS + 1)
    normals = np.stack([np.cos(angle), np.sin(angle)], axis=1).round(15) + 0.0  # the poles lie on the axis
    below, above = normals[: RINGS // 2 + 1], normals[RINGS // 2 :]
    profile = np.concatenate([below * radius - [0, half], above * radius + [0, half]])
    directions = np.concatenate([below, above])
    return np.stack([profile[:-1], profile[1:]], axis=1), np.stack([directions[:-1], directions[1:]], axis=1)


def _drum(low: float, high: float, height: float) -> tuple[np.ndarray, np.ndarray]:
    """Profiles and normals of a cylinder or a cone with its caps."""
    ends = np.array([[0, -height / 2], [low, -height / 2], [high, height / 2], [0, height / 2]])
    slope = np.array([height, low - high])
    normals = np.array([[[0, -1]] * 2, [slope] * 2, [[0, 1]] * 2], float)
    return np.stack([ends[:-1], ends[1:]], axis=1), normals


def _turned(profile: Float[np.ndarray, "s 2 2"], normals: Float[np.ndarray, "s 2 2"]) -> Outline:
    """The surface that a profile's strips sweep about Z; degenerate strips are dropped."""
    keep = np.abs(profile[:, 0] - profile[:, 1]).max(axis=1) > 0
    profile, normals = profile[keep], normals[keep]
    angle = 2 * np.pi * np.arange(ROUND) / ROUND
    c, s = np.cos(angle), np.sin(angle)
    sizes, corners, directions = [], [], []
    for (low, high), (n_low, n_high) in zip(profile, normals, strict=True):
        for k in range(ROUND):
            start, end = (c[k], s[k]), (c[(k + 1) % ROUND], s[(k + 1) % ROUND])
            ring = [(low, start, n_low), (low, end, n_low), (high, end, n_high), (high, start, n_high)]
            ring = ring[1:] if low[0] == 0 else ring[:3] if high[0] == 0 else ring
            sizes.append(len(ring))
            corners += [(p[0] * at[0], p[0] * at[1], p[1]) for p, at, _ in ring]
            directions += [(n[0] * at[0], n[0] * at[1], n[1]) for _, at, n in ring]
    unique, inverse = np.unique(np.round(np.array(corners), 12), axis=0, return_inverse=True)
    return Outline(unique, np.array(sizes), inverse.reshape(-1), np.array(directions))
