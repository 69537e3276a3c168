"""`camera.json` and `transforms.json`: cameras as other programs know them, written and read back with care.

`camera.json` is `{"version": 1, "space": ..., "views": [view, ...]}`; a view has

    name, width, height, fx, fy, cx, cy     pixels; the first pixel's centre is (0.5, 0.5)
    azimuth, elevation                      degrees, or null
    opencv  {R, t, z_min, z_max}            x_cam = R x_world + t; x right, y down, z forward; z_min: nearest
    opengl  {R, t, z_min, z_max}            y up, z backward: z is negative, z_max: nearest (paper 4.1.3)
    exr, png, png_sha256                    the view's files beside it, and what the PNG's bytes were when written

z_min and z_max are null where nothing is seen. On reading, R and t of one of the two conventions are enough. The space
is the working space: the mesh in a bounding sphere of radius 1 about the origin, Y up.

`transforms.json` is the NeRF/Blender convention: `transform_matrix` is world from camera with OpenGL axes.
"""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path, PurePosixPath
from typing import Annotated, Any

import numpy as np
from jaxtyping import Float
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from mistyle.core.camera import OPENGL_FROM_OPENCV, Camera
from mistyle.core.errors import InputRefused
from mistyle.files.bounds import refuse
from mistyle.files.read import read_json

SPACE = "working space: bounding sphere of radius 1 about the origin, right-handed, Y up"
MAX_SIDE = 16384
# How far a stored rotation may be from a rotation: files with five digits pass.
RIGID = 1e-4
DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2")

Number = Annotated[float, Field(allow_inf_nan=False)]
Side = Annotated[int, Field(ge=1, le=MAX_SIDE)]
Row3 = Annotated[list[Number], Field(min_length=3, max_length=3)]
Row4 = Annotated[list[Number], Field(min_length=4, max_length=4)]


class _Pose(BaseModel):
    model_config = ConfigDict(frozen=True)

    R: Annotated[list[Row3], Field(min_length=3, max_length=3)]
    t: Row3


class ViewEntry(BaseModel):
    """One view of a `camera.json`; what is unknown to us is passed over."""

    model_config = ConfigDict(frozen=True)

    name: str = Field(min_length=1, max_length=200)
    width: Side
    height: Side
    fx: float = Field(gt=0, allow_inf_nan=False)
    fy: float = Field(gt=0, allow_inf_nan=False)
    cx: Number
    cy: Number
    azimuth: Number | None = None
    elevation: Number | None = None
    opencv: _Pose | None = None
    opengl: _Pose | None = None
    exr: str | None = None
    png: str | None = None
    png_sha256: str | None = None


class _CameraFile(BaseModel):
    views: Annotated[list[ViewEntry], Field(min_length=1, max_length=4096)]


class _Frame(BaseModel):
    """A frame of a transforms.json; intrinsics stand in the frame or above all frames."""

    file_path: str = Field("", max_length=1000)
    transform_matrix: Annotated[list[Row4], Field(min_length=4, max_length=4)]


class _Transforms(BaseModel):
    frames: Annotated[list[dict[str, Any]], Field(min_length=1, max_length=4096)]


def camera_entry(camera: Camera, depth: Float[np.ndarray, "h w"] | None = None) -> dict[str, Any]:
    """The entry of one camera in `camera.json`; the depth range is of the finite depths."""
    seen = depth[np.isfinite(depth)] if depth is not None else np.zeros(0)
    near, far = (float(seen.min()), float(seen.max())) if seen.size else (None, None)
    opencv, opengl = camera.cam_from_world, OPENGL_FROM_OPENCV @ camera.cam_from_world
    return {
        "name": camera.name,
        "width": camera.size[1],
        "height": camera.size[0],
        "fx": camera.focal,
        "fy": camera.focal,
        "cx": camera.centre[0],
        "cy": camera.centre[1],
        "azimuth": _or_null(camera.azimuth),
        "elevation": _or_null(camera.elevation),
        "opencv": {**_pose(opencv), "z_min": near, "z_max": far},
        "opengl": {**_pose(opengl), "z_min": None if far is None else -far, "z_max": None if near is None else -near},
    }


def transforms(cameras: Sequence[Camera], files: Sequence[str]) -> dict[str, Any]:
    """The content of `transforms.json`; intrinsics also stand in each frame, as the views may differ."""
    frames = [
        {
            "file_path": file,
            **_intrinsics(camera),
            "transform_matrix": (camera.world_from_cam @ OPENGL_FROM_OPENCV).tolist(),
        }
        for camera, file in zip(cameras, files, strict=True)
    ]
    first = _intrinsics(cameras[0]) if cameras else {}
    return {"camera_model": "PINHOLE", "aabb_scale": 1, **first, "frames": frames}


def read_entries(path: Path) -> list[tuple[Camera, ViewEntry]]:
    """The cameras of a `camera.json` with their entries. Raises InputRefused with the view and the reason."""
    try:
        entries = _CameraFile.model_validate(read_json(path)).views
    except ValidationError as error:
        raise _unfit(path, error, "a camera.json as mistyle writes it") from error
    names = [entry.name for entry in entries]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise refuse(path, f"two views named '{twice}'", "a name for each view", "Rename one")
    return [(_camera(entry, path), entry) for entry in entries]


def read_cameras(path: Path, size: tuple[int, int] = (1024, 1024)) -> list[Camera]:
    """The cameras of a `camera.json` or `transforms.json` (told apart by what is in it), in working units.

    `size` (height, width) is taken where a transforms.json does not say (w, h). Lens distortion, unequal focal
    lengths and matrices that are no rigid motion are refused.
    """
    tree = read_json(Path(path))
    if "frames" not in tree:
        return [camera for camera, _ in read_entries(Path(path))]
    try:
        frames = _Transforms.model_validate(tree).frames
        return [_frame_camera(frame, tree, size, k, Path(path)) for k, frame in enumerate(frames)]
    except ValidationError as error:
        raise _unfit(Path(path), error, "a transforms.json (NeRF/Blender convention)") from error


def _frame_camera(
    frame: Mapping[str, Any], tree: Mapping[str, Any], size: tuple[int, int], k: int, path: Path
) -> Camera:
    known = _Frame.model_validate(frame)
    name = PurePosixPath(known.file_path.replace("\\", "/")).name or f"view_{k:03d}"
    for ending in (".png", ".jpg", ".jpeg", ".exr", ".webp"):
        name = name.removesuffix(ending)
    where = f"view '{name}'"

    def number(key: str) -> float | None:
        value = frame.get(key, tree.get(key))
        if value is None or (isinstance(value, int | float) and math.isfinite(value)):
            return value
        raise refuse(path, f"{key} = {value!r} in {where}", "a finite number", "Correct the file")

    if any(number(key) for key in DISTORTION):
        raise refuse(path, f"lens distortion in {where}", "pinhole cameras", "Undistort the pictures and cameras first")
    width, height = int(number("w") or size[1]), int(number("h") or size[0])
    if not (1 <= width <= MAX_SIDE and 1 <= height <= MAX_SIDE):
        raise refuse(path, f"{width} x {height} pixels in {where}", f"1 to {MAX_SIDE} on a side", "Correct the file")
    angle = number("camera_angle_x")
    fx = number("fl_x") or (width / (2 * math.tan(angle / 2)) if angle and 0 < angle < math.pi else None)
    if fx is None or fx <= 0:
        raise refuse(path, f"no focal length in {where}", "fl_x or camera_angle_x", "Add one of them")
    fy = number("fl_y") or fx
    cx, cy = number("cx"), number("cy")
    matrix = np.asarray(known.transform_matrix) @ OPENGL_FROM_OPENCV
    _check(matrix[:3, :3], fx, fy, where, path)
    if not np.allclose(matrix[3], [0, 0, 0, 1], atol=1e-9):
        raise refuse(path, f"a projective matrix in {where}", "a last row 0 0 0 1", "Write rigid matrices")
    centre = (width / 2 if cx is None else cx, height / 2 if cy is None else cy)
    return Camera(matrix, float(fx), centre, (height, width), name)


def _camera(entry: ViewEntry, path: Path) -> Camera:
    where = f"view '{entry.name}'"
    pose, flip = (entry.opencv, np.eye(4)) if entry.opencv else (entry.opengl, OPENGL_FROM_OPENCV)
    if pose is None:
        raise refuse(path, f"no pose in {where}", "opencv {R, t} or opengl {R, t}", "Add one of them")
    if entry.name != PurePosixPath(entry.name).name or "\\" in entry.name or "\0" in entry.name:
        raise refuse(path, f"the name {entry.name!r}", "a file name without folders", "Rename the view")
    cam_from_world = np.eye(4)
    cam_from_world[:3, :3], cam_from_world[:3, 3] = pose.R, pose.t
    cam_from_world = flip @ cam_from_world
    _check(cam_from_world[:3, :3], entry.fx, entry.fy, where, path)
    world_from_cam = np.eye(4)
    world_from_cam[:3, :3] = cam_from_world[:3, :3].T
    world_from_cam[:3, 3] = -cam_from_world[:3, :3].T @ cam_from_world[:3, 3]
    azimuth, elevation = (float("nan") if a is None else float(a) for a in (entry.azimuth, entry.elevation))
    size = (entry.height, entry.width)
    return Camera(world_from_cam, entry.fx, (entry.cx, entry.cy), size, entry.name, azimuth, elevation)


def _check(rotation: Float[np.ndarray, "3 3"], fx: float, fy: float, where: str, path: Path) -> None:
    if abs(fx - fy) > RIGID * fx:
        raise refuse(path, f"fx = {fx:g}, fy = {fy:g} in {where}", "square pixels", "Resample the pictures")
    if np.abs(rotation @ rotation.T - np.eye(3)).max() > RIGID or np.linalg.det(rotation) < 0:
        fix = "Take scale and mirroring out of the matrix"
        raise refuse(path, f"a matrix that is no rotation in {where}", "an orthonormal right-handed one", fix)


def _unfit(path: Path, error: ValidationError, expected: str) -> InputRefused:
    first = error.errors()[0]
    at = ".".join(str(step) for step in first["loc"])
    return refuse(path, f"{first['msg']} at {at or 'the top'}", expected, "Correct the file")


def _pose(matrix: Float[np.ndarray, "4 4"]) -> dict[str, Any]:
    return {"R": matrix[:3, :3].tolist(), "t": matrix[:3, 3].tolist()}


def _intrinsics(camera: Camera) -> dict[str, Any]:
    height, width = camera.size
    return {
        "camera_angle_x": 2 * math.atan(width / (2 * camera.focal)),
        "camera_angle_y": 2 * math.atan(height / (2 * camera.focal)),
        "fl_x": camera.focal,
        "fl_y": camera.focal,
        "cx": camera.centre[0],
        "cy": camera.centre[1],
        "w": width,
        "h": height,
    }


def _or_null(angle: float) -> float | None:
    return float(angle) if math.isfinite(angle) else None
