"""Similarity transforms between a mesh's space and the cameras', and references transformed by them.

A similarity is a 4 x 4 matrix [s R, t; 0, 1] with a rotation R and a scale s > 0. `work_from_cams` takes the
references' space (COLMAP's, a NeRF's) to the working space, in which the mesh has a bounding sphere of radius 1. For
references in the mesh's own units it is the mesh's `Source.work_from_user`.
"""

from dataclasses import replace

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from mistyle.core.camera import Camera
from mistyle.core.capture import Captures
from mistyle.core.light import (
    Directional,
    Environment,
    Light,
    Lights,
    Point,
    SphericalGaussian,
    environment_directions,
    environment_radiance,
)

Y_FROM_Z = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])  # (x, y, z) with Z up -> (x, z, -y)


def similarity(
    scale: float, rotation: Float[np.ndarray, "3 3"], shift: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "4 4"]:
    """The matrix of x -> scale · rotation x + shift."""
    result = np.eye(4)
    result[:3, :3], result[:3, 3] = scale * rotation, shift
    return result


def scale_of(matrix: Float[np.ndarray, "4 4"]) -> float:
    """The scale of a similarity. ValueError for any other matrix (a mirror, a shear, a projection)."""
    linear = matrix[:3, :3]
    determinant = float(np.linalg.det(linear))
    scale = np.cbrt(determinant)
    upright = determinant > 0 and np.allclose(matrix[3], [0, 0, 0, 1])
    if not upright or np.abs(linear @ linear.T / scale**2 - np.eye(3)).max() > 1e-6:
        raise ValueError(f"not a similarity: {np.asarray(matrix).tolist()}")
    return float(scale)


def moved_camera(camera: Camera, matrix: Float[np.ndarray, "4 4"]) -> Camera:
    """The camera whose picture of the moved world equals `camera`'s of the original."""
    pose = matrix @ camera.world_from_cam
    pose[:3, :3] /= scale_of(matrix)
    return replace(camera, world_from_cam=pose)


def moved_lights(rig: Lights, matrix: Float[np.ndarray, "4 4"], environments: bool = True) -> Lights:
    """The lights of the moved world: the illumination of every surface stays the same.

    A point light's distances grow by the scale, so its intensity grows by the scale's square. An environment's map is
    resampled unless the motion only turns it about Y.
    """
    still = () if environments else (Environment,)
    return tuple(light if isinstance(light, still) else _moved(light, matrix) for light in rig)


def moved(captures: Captures, work_from_cams: Float[np.ndarray, "4 4"], environments: bool = True) -> Captures:
    """References with cameras and lights in another space; the pictures do not change, nor do environments without
    `environments`."""
    rig_cache: dict[int, Lights] = {}
    rigs = []
    for rig in captures.lights:
        if id(rig) not in rig_cache:
            rig_cache[id(rig)] = moved_lights(rig, work_from_cams, environments)
        rigs.append(rig_cache[id(rig)])
    cameras = tuple(moved_camera(camera, work_from_cams) for camera in captures.cameras)
    return Captures(cameras, tuple(rigs), captures.load)


def _moved(light: Light, matrix: Float[np.ndarray, "4 4"]) -> Light:
    scale = scale_of(matrix)
    turn = matrix[:3, :3] / scale
    if isinstance(light, Directional):
        return light if light.frame == "camera" else replace(light, direction=_triple(turn @ light.direction))
    if isinstance(light, Point):
        place = np.asarray(light.position)
        place = place * scale if light.frame == "camera" else matrix[:3, :3] @ place + matrix[:3, 3]
        return replace(light, position=_triple(place), intensity=_triple(np.asarray(light.intensity) * scale**2))
    if isinstance(light, SphericalGaussian):
        return replace(light, axis=_triple(turn @ light.axis))
    if isinstance(light, Environment):
        return turned(light, turn)
    return light


def turned(light: Environment, rotation: Float[np.ndarray, "3 3"]) -> Environment:
    """The rotated environment; exact about Y, else resampled (bilinear) at the map's own size."""
    if abs(rotation[1, 1] - 1) < 1e-12:
        return replace(light, turn=light.turn + float(np.degrees(np.arctan2(rotation[0, 2], rotation[2, 2]))))
    directions = environment_directions(*light.radiance.shape[:2])
    radiance = environment_radiance(replace(light, scale=1.0), directions @ rotation)
    return replace(light, radiance=radiance.astype(np.float32), turn=0.0)


def _triple(values: Float[np.ndarray, "3"]) -> tuple[float, float, float]:
    x, y, z = np.asarray(values, float).tolist()
    return (x, y, z)


def upright(captures: Captures) -> Captures:
    """References of a world with Z up, in one with Y up. The first row of an environment is up in both, so its map
    stays as it is: the middle looks along -Y of the world with Z up, the columns to the right of it towards -X."""
    return moved(captures, similarity(1.0, Y_FROM_Z, np.zeros(3)), environments=False)


def fit_similarity(a: Float[np.ndarray, "n 3"], b: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "4 4"]:
    """The similarity that takes points a to points b with the least sum of squares (Umeyama 1991)."""
    mean_a, mean_b = a.mean(axis=0), b.mean(axis=0)
    u, d, vt = np.linalg.svd((b - mean_b).T @ (a - mean_a) / len(a))
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(u) * np.linalg.det(vt))])
    rotation = u * sign @ vt
    scale = float((d * sign).sum() / max(((a - mean_a) ** 2).sum() / len(a), 1e-300))
    return similarity(scale, rotation, mean_b - scale * rotation @ mean_a)


def degrees_between(a: Float[np.ndarray, "4 4"], b: Float[np.ndarray, "4 4"]) -> float:
    """The angle of the rotation from one similarity to another."""
    turn = (a[:3, :3] / scale_of(a)).T @ (b[:3, :3] / scale_of(b))
    return float(np.degrees(Rotation.from_matrix(turn).magnitude()))
