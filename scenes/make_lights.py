"""Make what the scenes beside this one read: paper_lights.exr, studio_lights.exr, studio_backdrop.obj and .exr.

    python scenes/make_lights.py [--out FOLDER]

The numbers of the paper's three lights stand in paper_lights.json, those of the studio below.
"""

import argparse
import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parent))

from mistyle.core.light import bake_environment, environment_directions, lights  # noqa: E402
from mistyle.io.images.write import write_exr  # noqa: E402

# The narrowest of the paper's lobes (sharpness 6) is 40 degrees wide; a texel of this map spans 2.8 degrees.
PAPER_HEIGHT = 64


class Softbox(NamedTuple):
    """A rectangle of light at infinity: where it hangs and how far it reaches to each side (degrees), its radiance.

    Azimuth 0 is behind the camera, positive to the right.
    """

    azimuth: float
    elevation: float
    half_width: float
    half_height: float
    radiance: tuple[float, float, float]


STUDIO = (
    Softbox(-42, 44, 22, 22, (6.2, 6.05, 5.8)),  # key
    Softbox(74, 10, 26, 40, (0.60, 0.63, 0.68)),  # fill
    Softbox(146, 34, 11, 30, (6.6, 6.8, 7.2)),  # rim, right
    Softbox(-150, 28, 8, 26, (3.4, 3.5, 3.7)),  # rim, left
)
STUDIO_SKY, STUDIO_GROUND = (0.26, 0.26, 0.27), (0.16, 0.16, 0.16)
STUDIO_HEIGHT = 128

# The studio's floor runs towards -Z, bends up with this radius and ends as a wall, low enough for the rim lights.
FRONT, BACK, BEND, TOP, HALF_WIDTH = 9.0, -7.0, 4.0, 6.5, 16.0
BACKDROP_DARK, BACKDROP_LIGHT, BACKDROP_TINT = 0.26, 0.60, (1.0, 1.0, 1.02)
BACKDROP_TEXELS = 128


def channels(rgb: np.ndarray) -> dict[str, np.ndarray]:
    return {name: np.ascontiguousarray(rgb[..., k], np.float32) for k, name in enumerate("RGB")}


def softbox(box: Softbox, directions: np.ndarray, edge: float = 2.0) -> np.ndarray:
    """Radiance from unit directions; the rim of the box fades over `edge` degrees."""
    a, e = np.radians(box.azimuth), np.radians(box.elevation)
    forward = np.array([np.sin(a) * np.cos(e), np.sin(e), np.cos(a) * np.cos(e)])
    right = np.array([np.cos(a), 0, -np.sin(a)])
    up = np.cross(forward, right)
    x, y, z = (directions @ axis for axis in (right, up, forward))
    beyond_x = np.degrees(np.abs(np.arctan2(x, z))) - box.half_width
    beyond_y = np.degrees(np.abs(np.arctan2(y, z))) - box.half_height
    inside = np.clip(0.5 - np.maximum(beyond_x, beyond_y) / edge, 0, 1) * (z > 0)
    return inside[..., None] * np.asarray(box.radiance)


def studio(height: int) -> np.ndarray:
    """The softboxes over a sky that is a little lighter than the ground."""
    directions = environment_directions(height, 2 * height)
    share = (directions[..., 1:2] + 1) / 2
    total = share * np.asarray(STUDIO_SKY) + (1 - share) * np.asarray(STUDIO_GROUND)
    for box in STUDIO:
        light = softbox(box, directions)
        total = np.where(light.any(axis=-1, keepdims=True), np.maximum(total, light), total)
    return total


def write_backdrop(path: Path, steps: int = 24) -> None:
    """A seamless backdrop (floor at y = 0, wall behind) as an OBJ with smooth normals, facing the camera on +Z."""
    angles = np.linspace(0, np.pi / 2, steps + 1)
    bend = [(BACK + BEND - BEND * np.sin(a), BEND - BEND * np.cos(a), np.sin(a), np.cos(a)) for a in angles]
    profile = [(FRONT, 0.0, 0.0, 1.0), *bend, (BACK, TOP, 1.0, 0.0)]
    steps_taken = np.hypot(*np.diff(np.array(profile)[:, :2], axis=0).T)
    along = np.concatenate([[0], np.cumsum(steps_taken)])
    lines = ["# the studio's backdrop, made by make_lights.py"]
    for z, y, _, _ in profile:
        lines += [f"v {x:.4f} {y:.4f} {z:.4f}" for x in (-HALF_WIDTH, HALF_WIDTH)]
    for way in along / along[-1]:
        lines += [f"vt {u} {way:.5f}" for u in (0, 1)]
    lines += [f"vn 0 {up:.5f} {front:.5f}" for _, _, front, up in profile]
    for k in range(len(profile) - 1):
        a, b, c, d = 2 * k + 1, 2 * k + 2, 2 * k + 4, 2 * k + 3
        lines.append(f"f {a}/{a}/{k + 1} {b}/{b}/{k + 1} {c}/{c}/{k + 2} {d}/{d}/{k + 2}")
    path.write_text("\n".join(lines) + "\n", encoding="ascii")


def backdrop_colour(texels: int) -> np.ndarray:
    """The backdrop's reflectance: a pool of light behind the object, so that dark objects stand out as well."""
    across, along = np.meshgrid((np.arange(texels) + 0.5) / texels, 1 - (np.arange(texels) + 0.5) / texels)
    pool = np.exp(-(((across - 0.5) / 0.13) ** 2) - ((along - 0.80) / 0.16) ** 2)
    return (BACKDROP_DARK + (BACKDROP_LIGHT - BACKDROP_DARK) * pool)[..., None] * np.asarray(BACKDROP_TINT)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--out", type=Path, default=HERE)
    out = parser.parse_args().out
    write_exr(out / "paper_lights.exr", channels(bake_environment(lights("paper"), PAPER_HEIGHT)), half=True)
    write_exr(out / "studio_lights.exr", channels(studio(STUDIO_HEIGHT)), half=True)
    write_exr(out / "studio_backdrop.exr", channels(backdrop_colour(BACKDROP_TEXELS)), half=True)
    write_backdrop(out / "studio_backdrop.obj")


if __name__ == "__main__":
    main()
