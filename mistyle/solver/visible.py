"""How much of the pictures shows a mesh in the light, and how much of the mesh each observes: counts of plans.

Points spread over the surface are projected into a coarse picture, whose cells keep the nearest of them (a z-buffer of
points). No ray is traced, so a plan imports no renderer. Shadows are left out.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float

from mistyle.core.camera import Camera, by_camera, in_frame, px_from_world
from mistyle.core.light import DELTA, Directional, Lights, direction_in_world, has_soft, position_in_world
from mistyle.core.mesh import SpreadPoints
from mistyle.core.rows import evenly
from mistyle.solver.schedule import Visible

CELLS, EACH = 48, 12  # most cells along the longer side of the box of the points; points of a cell, at least
PICTURES = 24  # most pictures that are judged, evenly chosen
FACING = 0.2  # least cosine of the angle of view of an observation
BEHIND = 3.0  # depth, in widths of a cell, at which a point lies behind another one


def visible_shares(surface: SpreadPoints, cameras: Sequence[Camera], lights: Sequence[Lights]) -> Visible:
    """The shares for `cameras` and their `lights`; none or soft lights reach every point."""
    pixels, rows = [], []
    for k in evenly(len(cameras), PICTURES):
        pixels.append(cameras[k].size[0] * cameras[k].size[1])
        rows.append(_shares(*surface, cameras[k], lights[k]))
    shown, seen, whole = np.array(rows)[:, :3].T
    shares = (float(shown @ pixels / sum(pixels)), float(seen.mean()), float(whole @ pixels / sum(pixels)))
    return Visible(*shares, len(by_camera(cameras)) / len(cameras))


def _shares(
    points: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"], camera: Camera, lights: Lights
) -> Visible:
    """The shares of one picture."""
    (height, width), (px, depth) = camera.size, px_from_world(camera, points)
    inside = (depth > 0) & in_frame(camera, px)
    if not inside.any():
        return Visible(0.0, 0.0, 0.0)
    low, cells = px[inside].min(axis=0), min(CELLS, max(1, int((inside.sum() / EACH) ** 0.5)))
    cell = max(float((px[inside].max(axis=0) - low).max()) / cells, 1.0)
    column, row = np.minimum((px[inside] - low) // cell, cells).astype(int).T
    place, far = row * (cells + 1) + column, depth[inside]
    nearest = np.full((cells + 1) ** 2, np.inf)
    np.minimum.at(nearest, place, far)
    front = far <= nearest[place] + BEHIND * cell * far / camera.focal
    away = camera.position - points[inside]
    distance = np.linalg.norm(away, axis=1)
    cosine = (away * normals[inside]).sum(axis=1) / np.maximum(distance, 1e-12)
    lit = _in_the_light(points[inside], np.sign(cosine)[:, None] * normals[inside], camera, lights)
    area = front * np.abs(cosine) / np.maximum(distance, 1e-12) ** 2
    covered = _filled(np.isfinite(nearest).reshape(cells + 1, cells + 1)) * cell**2 / (height * width)
    whole = min(covered, 1.0)
    shown = whole * float((area * lit).sum() / max(area.sum(), 1e-30))
    return Visible(shown, float((front & (cosine > FACING) & lit).sum() / len(points)), whole)


def _in_the_light(points: np.ndarray, normals: np.ndarray, camera: Camera, lights: Lights) -> Bool[np.ndarray, " n"]:
    """Points that face a delta light; all under soft light, and where lights are unknown."""
    if not lights or has_soft([lights]):
        return np.ones(len(points), bool)
    lit = np.zeros(len(points), bool)
    for light in lights:
        if isinstance(light, Directional):
            lit |= normals @ direction_in_world(light, camera) > 0
        elif isinstance(light, DELTA):
            lit |= ((position_in_world(light, camera) - points) * normals).sum(axis=1) > 0
    return lit


def _filled(cells: Bool[np.ndarray, "h w"]) -> float:
    """The number of cells, of which those at the outline count half."""
    wide = np.pad(cells, 1)
    inner = wide[1:-1, :-2] & wide[1:-1, 2:] & wide[:-2, 1:-1] & wide[2:, 1:-1] & cells
    return float(inner.sum() + 0.5 * (cells & ~inner).sum())
