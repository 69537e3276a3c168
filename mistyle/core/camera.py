"""Cameras, their frames and the pixel convention; the paper's rig of 16 views and its visiting order.

Camera axes are OpenCV's: x right, y down, z forward. Pixel centres lie at +0.5: the centre of the first pixel
is (0.5, 0.5), the bottom right corner of the image is (width, height). The world is right-handed with Y up.
Conversions to OpenGL (x right, y up, z backward) and to Mitsuba (x left, y up, z forward) live here only.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from mistyle.core.settings import RigSettings

OPENGL_FROM_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])
MITSUBA_FROM_OPENCV = np.diag([-1.0, -1.0, 1.0, 1.0])


@dataclass(frozen=True)
class Camera:
    """A pinhole camera with square pixels.

    `world_from_cam` is a rigid motion (OpenCV axes), `focal` and `centre` are in pixels, `size` is (height, width).
    Azimuth and elevation (degrees) name the view and are NaN where undefined.
    """

    world_from_cam: Float[np.ndarray, "4 4"]
    focal: float
    centre: tuple[float, float]
    size: tuple[int, int]
    name: str = "view"
    azimuth: float = float("nan")
    elevation: float = float("nan")

    @property
    def cam_from_world(self) -> Float[np.ndarray, "4 4"]:
        rotation = self.world_from_cam[:3, :3].T
        result = np.eye(4)
        result[:3, :3] = rotation
        result[:3, 3] = -rotation @ self.world_from_cam[:3, 3]
        return result

    @property
    def position(self) -> Float[np.ndarray, "3"]:
        """Camera position in the world: c = -R^T t."""
        return self.world_from_cam[:3, 3]

    @property
    def fov(self) -> float:
        """Horizontal field of view in degrees (of the full width; exact only for a centred principal point)."""
        return float(np.degrees(2 * np.arctan(self.size[1] / (2 * self.focal))))


def look_at(
    position: Sequence[float],
    target: Sequence[float] = (0, 0, 0),
    *,
    fov: float,
    size: tuple[int, int],
    name: str = "view",
) -> Camera:
    """A camera at `position` that looks at `target`, Y up; near the poles the up vector turns to the horizontal."""
    eye, aim = np.asarray(position, float), np.asarray(target, float)
    forward = aim - eye
    length = np.linalg.norm(forward)
    if not np.isfinite(length) or length < 1e-9:
        raise ValueError(f"camera '{name}' coincides with its target {aim.tolist()}; move it away")
    forward /= length
    # Within 0.5 degrees of a pole the cross product with Y loses its direction; the heading is then taken as -Z.
    up = np.array([0.0, 1.0, 0.0]) if abs(forward[1]) < np.cos(np.radians(0.5)) else np.array([0.0, 0.0, -1.0])
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    down = np.cross(forward, right)
    world_from_cam = np.eye(4)
    world_from_cam[:3, :3] = np.stack([right, down, forward], axis=1)
    world_from_cam[:3, 3] = eye
    height, width = size
    return Camera(world_from_cam, width / (2 * np.tan(np.radians(fov) / 2)), (width / 2, height / 2), size, name)


def orbit(azimuth: float, elevation: float, *, distance: float, fov: float, size: tuple[int, int]) -> Camera:
    """A camera on the sphere of radius `distance`: azimuth 0 looks from +Z, 90 from +X; elevation 90 from +Y."""
    a, e = np.radians(azimuth), np.radians(elevation)
    eye = distance * np.array([np.sin(a) * np.cos(e), np.sin(e), np.cos(a) * np.cos(e)])
    camera = look_at(eye.tolist(), fov=fov, size=size, name=f"az{azimuth:05.1f}_el{elevation:+05.1f}")
    return replace(camera, azimuth=float(azimuth), elevation=float(elevation))


PAPER_ANGLES = tuple((30.0 * k, 0.0) for k in range(1, 13)) + tuple((30.0, e) for e in (45.0, -45.0, 89.0, -89.0))


def rig(settings: RigSettings) -> list[Camera]:
    """The cameras of a job in visiting order; 'paper' gives the 16 views of section 4.1.1, 'turntable' a ring.

    Cameras of kind 'file' are read by `io/cameras/camera_files.py`, since `core` opens no files; those of kind
    'nbv' depend on the mesh (`render/mitsuba/rigs.py`).
    """
    if settings.kind == "file":
        raise ValueError("cameras from a file are read by mistyle.io.cameras.camera_files.read_cameras")
    if settings.kind == "nbv":
        raise ValueError("cameras of kind 'nbv' are chosen for a mesh by mistyle.render.mitsuba.rigs.next_best_views")
    size = (settings.resolution, settings.resolution)
    angles = (
        PAPER_ANGLES
        if settings.kind == "paper"
        else [(360.0 * k / settings.views, 15.0) for k in range(settings.views)]
    )
    cameras = [orbit(a, e, distance=settings.distance, fov=settings.fov, size=size) for a, e in angles]
    return visiting_order(cameras) if settings.kind == "paper" else cameras


def visiting_order(cameras: Sequence[Camera]) -> list[Camera]:
    """Ascending |azimuth| + |elevation| (paper 4.1.3); ties keep their order."""
    return sorted(cameras, key=lambda c: abs(c.azimuth) + abs(c.elevation))


def angular_order(cameras: Sequence[Camera]) -> list[int]:
    """Indices of `cameras` from the first on; each next camera has the least angle to any already chosen.

    Angles are those between camera positions seen from the origin. Ties (within 0.01 degrees) go to the least angle
    from the first camera, then to the lower index. The paper's rig is so visited both ways round and closes at the
    back.
    """
    towards = np.array([c.position / np.linalg.norm(c.position) for c in cameras])
    angles = np.round(np.degrees(np.arccos(np.clip(towards @ towards.T, -1, 1))), 2)
    order, remaining = [0], list(range(1, len(cameras)))
    while remaining:
        order.append(min(remaining, key=lambda k: (angles[k, order].min(), angles[k, order[0]], k)))
        remaining.remove(order[-1])
    return order[: len(cameras)]


def by_camera(cameras: Sequence[Camera]) -> list[list[int]]:
    """Groups of indices of cameras that are equal but for their names: pictures from one place with one lens."""
    groups: dict[tuple, list[int]] = {}
    for k, camera in enumerate(cameras):
        key = (camera.world_from_cam.tobytes(), camera.focal, camera.centre, camera.size)
        groups.setdefault(key, []).append(k)
    return list(groups.values())


def px_from_world(
    camera: Camera, points: Float[np.ndarray, "*n 3"]
) -> tuple[Float[np.ndarray, "*n 2"], Float[np.ndarray, "*n"]]:
    """Project world points: pixel coordinates (x, y) and metric z in the camera (negative: behind it)."""
    cam = points @ camera.cam_from_world[:3, :3].T + camera.cam_from_world[:3, 3]
    z = cam[..., 2]
    safe = np.where(np.abs(z) < 1e-12, 1e-12, z)
    return cam[..., :2] / safe[..., None] * camera.focal + np.asarray(camera.centre), z


def px_by_cam(
    camera: Camera, points: Float[np.ndarray, "n 3"]
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 2 3"]]:
    """Camera coordinates of world points, and the derivative of their pixels by these coordinates."""
    cam = points @ camera.cam_from_world[:3, :3].T + camera.cam_from_world[:3, 3]
    z = np.maximum(cam[:, 2], 1e-6)
    moves = np.zeros((len(cam), 2, 3))
    moves[:, 0, 0] = moves[:, 1, 1] = 1
    moves[:, :, 2] = -cam[:, :2] / z[:, None]
    return cam, moves * (camera.focal / z)[:, None, None]


def world_from_px(
    camera: Camera, px: Float[np.ndarray, "*n 2"], depth: Float[np.ndarray, "*n"]
) -> Float[np.ndarray, "*n 3"]:
    """Lift pixel coordinates (x, y) at metric z `depth` to world points; the inverse of `px_from_world`."""
    xy = (px - np.asarray(camera.centre)) / camera.focal * depth[..., None]
    cam = np.concatenate([xy, depth[..., None]], axis=-1)
    return cam @ camera.world_from_cam[:3, :3].T + camera.world_from_cam[:3, 3]


def of_corners(camera: Camera) -> Camera:
    """The camera whose pixels' centres are the corners of this one's pixels; one more in each row and column."""
    (x, y), (height, width) = camera.centre, camera.size
    return replace(camera, centre=(x + 0.5, y + 0.5), size=(height + 1, width + 1))


def pixel_centres(size: tuple[int, int]) -> Float[np.ndarray, "h w 2"]:
    """Pixel coordinates (x, y) of every pixel centre of an image of `size` (height, width)."""
    x, y = np.meshgrid(np.arange(size[1]) + 0.5, np.arange(size[0]) + 0.5)
    return np.stack([x, y], axis=-1)


def zoom(camera: Camera, x: float, y: float, width: float, size: tuple[int, int]) -> Camera:
    """The camera whose image of `size` is the square window with top left corner (x, y) and side `width` pixels."""
    scale = size[1] / width
    centre = ((camera.centre[0] - x) * scale, (camera.centre[1] - y) * scale)
    return replace(camera, focal=camera.focal * scale, centre=centre, size=size)


def resized(camera: Camera, size: tuple[int, int]) -> Camera:
    """The same camera with another number of pixels along each side; the aspect ratio must not change."""
    if size[0] * camera.size[1] != size[1] * camera.size[0]:
        raise ValueError(f"cannot resize a camera of {camera.size} to {size}: the aspect ratio differs")
    return zoom(camera, 0.0, 0.0, float(camera.size[1]), size)


def binned(camera: Camera, by: int) -> Camera:
    """The camera whose pixels are blocks of `by` x `by`; the remainder at the right and the bottom is dropped."""
    size = (camera.size[0] // by, camera.size[1] // by)
    centre = (camera.centre[0] / by, camera.centre[1] / by)
    return replace(camera, focal=camera.focal / by, centre=centre, size=size)


def in_frame(camera: Camera, px: Float[np.ndarray, "*n 2"]) -> Bool[np.ndarray, "*n"]:
    """Mask of the pixel coordinates inside the image."""
    return (px[..., 0] >= 0) & (px[..., 1] >= 0) & (px[..., 0] < camera.size[1]) & (px[..., 1] < camera.size[0])
