"""Camera files `camera.json` and `transforms.json`: writer and reader.

`camera.json` is `{"version": 1, "space": ..., "views": [view, ...]}`; a view has

    name, width, height, fx, fy, cx, cy     pixels; the first pixel's centre is (0.5, 0.5)
    azimuth, elevation                      degrees, or null
    opencv  {R, t, z_min, z_max}            x_cam = R x_world + t; x right, y down, z forward; z_min: nearest
    opengl  {R, t, z_min, z_max}            y up, z backward: z is negative, z_max: nearest (paper 4.1.3)
    exr, png, png_sha256                    the view's files beside it, and the PNG's sha256 when written

z_min and z_max are null where the view is empty. On reading, R and t of one of the two conventions are enough. The
space is the working space: the mesh in a bounding sphere of radius 1 about the origin, Y up.

`transforms.json` is the NeRF/Blender convention: `transform_matrix` is world from camera with OpenGL axes. In ours,
"space" declares the working space; those of other programs are in their own space. nerfstudio transforms the space of
its reconstruction: stored = applied_scale * (applied_transform @ original). The reader inverts this.

Every camera describes either the pixels that a picture file stores or those of the upright picture (EXIF orientation):
see `CameraFrame.pixels`. COLMAP and the readers of transforms.json (nerfstudio,
instant-ngp) ignore the orientation, so their cameras describe stored pixels. A camera.json describes upright
pixels.
"""

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Annotated, Any

import numpy as np
from jaxtyping import Float
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from mistyle.core.asset import RAW, Pixels
from mistyle.core.camera import OPENGL_FROM_OPENCV, Camera
from mistyle.core.errors import InputRefused
from mistyle.geometry.lens import Lens, is_distorted
from mistyle.geometry.similarity import moved_camera, similarity
from mistyle.io.read import read_json
from mistyle.io.sandbox.bounds import refuse

SPACE = "working space: bounding sphere of radius 1 about the origin, right-handed, Y up"
PIXELS: Pixels = "upright"  # that a camera.json describes
MAX_SIDE = 16384
# Tolerance of stored rotations: files with five digits pass.
RIGID = 1e-4
ENDINGS = (".exr", ".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", *RAW)

Number = Annotated[float, Field(allow_inf_nan=False)]
Side = Annotated[int, Field(ge=1, le=MAX_SIDE)]
Row3 = Annotated[list[Number], Field(min_length=3, max_length=3)]


class _Pose(BaseModel):
    model_config = ConfigDict(frozen=True)

    R: Annotated[list[Row3], Field(min_length=3, max_length=3)]
    t: Row3


class ViewEntry(BaseModel):
    """One view of a `camera.json`; unknown fields are ignored."""

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
    """A frame of a transforms.json; intrinsics are in the frame or at the top level."""

    file_path: str = Field("", max_length=1000)
    mask_path: str | None = Field(None, max_length=1000)
    transform_matrix: Any = None


class _Transforms(BaseModel):
    frames: Annotated[list[dict[str, Any]], Field(min_length=1, max_length=4096)]


@dataclass(frozen=True)
class CameraFrame:
    """One photograph of a camera model: its name (unique), its files as the model names them, its pose and its lens.
    `pixels` are the pixels of the files (stored or upright) that pose and lens describe."""

    name: str
    picture: str
    mask: str | None
    world_from_cam: Float[np.ndarray, "4 4"]
    lens: Lens
    pixels: Pixels


def camera_entry(camera: Camera, depth: Float[np.ndarray, "h w"] | None = None) -> dict[str, Any]:
    """The entry of one camera in `camera.json`; the depth range covers the finite depths."""
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
    """The content of `transforms.json`; intrinsics are repeated in each frame, as the views may differ."""
    frames = [
        {
            "file_path": file,
            **_intrinsics(camera),
            "transform_matrix": (camera.world_from_cam @ OPENGL_FROM_OPENCV).tolist(),
        }
        for camera, file in zip(cameras, files, strict=True)
    ]
    first = _intrinsics(cameras[0]) if cameras else {}
    return {"camera_model": "PINHOLE", "aabb_scale": 1, "space": SPACE, **first, "frames": frames}


def read_entries(path: Path) -> list[tuple[Camera, ViewEntry]]:
    """The cameras of a `camera.json` with their entries. Raises InputRefused with the view and the reason."""
    try:
        entries = _CameraFile.model_validate(read_json(path)).views
    except ValidationError as error:
        raise _unfit(path, error, "a camera.json as mistyle writes it") from error
    names = [entry.name for entry in entries]
    duplicate = next((name for name in names if names.count(name) > 1), None)
    if duplicate is not None:
        raise refuse(path, f"two views named '{duplicate}'", "a name for each view", "Rename one")
    return [(_camera(entry, path), entry) for entry in entries]


def read_cameras(path: Path, size: tuple[int, int] = (1024, 1024)) -> list[Camera]:
    """The cameras of a `camera.json` or `transforms.json` (distinguished by content), in working units.

    `size` (height, width) is the default for a transforms.json without (w, h). Lens distortion, unequal focal lengths
    and matrices that are not rigid motions are refused.
    """
    tree = read_json(Path(path))
    if "frames" not in tree:
        return [camera for camera, _ in read_entries(Path(path))]
    frames = read_frames(Path(path), lambda file: size)
    for frame in frames:
        where = f"view '{frame.name}'"
        if is_distorted(frame.lens):
            fix = "Undistort the pictures and cameras first"
            raise refuse(path, f"lens distortion in {where}", "pinhole cameras", fix)
        _check_square(*frame.lens.focal, where, Path(path))
    return [Camera(f.world_from_cam, f.lens.focal[0], f.lens.centre, f.lens.size, f.name) for f in frames]


def read_frames(path: Path, size_of: Callable[[str], tuple[int, int]]) -> list[CameraFrame]:
    """The frames of a `transforms.json` with their lenses (k1 to k4, p1 p2), in the file's order and the space before
    nerfstudio's `applied_transform` and `applied_scale`.

    `size_of` returns (height, width) of the picture that a frame names, for files without (w, h). A frame's own
    intrinsics override those at the top level. Refused: fisheye and other camera models, matrices (3 x 4 or 4 x 4) that
    are not rigid motions.
    """
    tree = read_json(path)
    original = np.linalg.inv(applied_transform(tree, path))
    try:
        known = [_Frame.model_validate(frame) for frame in _Transforms.model_validate(tree).frames]
        names = unique_names([frame.file_path or f"view_{k:03d}" for k, frame in enumerate(known)])
        return [
            _frame(frame, _fields(tree, raw), name, size_of, original, path)
            for frame, raw, name in zip(known, tree["frames"], names, strict=True)
        ]
    except ValidationError as error:
        raise _unfit(path, error, "a transforms.json (NeRF/Blender convention)") from error


def unique_names(files: Sequence[str]) -> list[str]:
    """A name for each picture: its file's without folder and ending, or with the folders where two names are equal."""
    paths = [PurePosixPath(file.replace("\\", "/")) for file in files]
    short = [stem(path.name) for path in paths]
    repeated = {name for name, times in Counter(short).items() if times > 1}
    return [
        stem("_".join(part for part in path.parts if part not in ("/", ".", ".."))) if name in repeated else name
        for path, name in zip(paths, short, strict=True)
    ]


def stem(name: str) -> str:
    """The name without a picture's ending; other dots stay."""
    return name[: -len(ending)] if (ending := PurePosixPath(name).suffix).lower() in ENDINGS else name


def _fields(tree: Mapping[str, Any], frame: Mapping[str, Any]) -> dict[str, Any]:
    """A frame's fields, completed by those at the top level. The focal lengths are one group: a focal length at the top
    level does not override a frame's own field of view."""
    kinds = ("fl_x", "fl_y", "camera_angle_x")
    own = any(frame.get(key) is not None for key in kinds)
    return {**{key: value for key, value in tree.items() if not (own and key in kinds)}, **frame}


def applied_transform(tree: Mapping[str, Any], path: Path) -> Float[np.ndarray, "4 4"]:
    """nerfstudio's transform of the space of the reconstruction: a similarity, by default the identity."""
    matrix = tree.get("applied_transform")
    scale = tree.get("applied_scale", 1.0)
    if isinstance(scale, bool) or not isinstance(scale, int | float) or not (0 < scale < math.inf):
        raise refuse(path, f"applied_scale = {scale!r}", "a finite number > 0", "Correct the file")
    if matrix is None:
        return similarity(float(scale), np.eye(3), np.zeros(3))
    known = _matrix(matrix, "applied_transform", path)
    own = np.cbrt(np.linalg.det(known[:3, :3]))
    if not own > 0:
        raise refuse(path, "an applied_transform that mirrors", "a rotation, shift and scale", "Export it again")
    check_rotation(known[:3, :3] / own, "applied_transform", path)
    left, _, right = np.linalg.svd(known[:3, :3])  # the nearest rotation: files may have five digits
    return similarity(float(scale), np.eye(3), np.zeros(3)) @ similarity(float(own), left @ right, known[:3, 3])


def _matrix(rows: Any, where: str, path: Path) -> Float[np.ndarray, "4 4"]:
    """A matrix of 3 or 4 rows of 4 finite numbers, its last row 0 0 0 1."""
    try:
        matrix = np.asarray(rows, float)
    except (TypeError, ValueError):
        matrix = np.zeros(0)
    if matrix.shape not in ((3, 4), (4, 4)) or not np.isfinite(matrix).all():
        sides = " x ".join(map(str, matrix.shape))
        found = f"a matrix of {sides} numbers" if matrix.ndim == 2 else "something else than a matrix of numbers"
        raise refuse(path, f"{found} in {where}", "3 or 4 rows of 4 finite numbers", "Correct the file")
    whole = np.vstack([matrix[:3], [0.0, 0, 0, 1]])
    if len(matrix) == 4 and not np.allclose(matrix[3], whole[3], atol=1e-9):
        raise refuse(path, f"a projective matrix in {where}", "a last row 0 0 0 1", "Write rigid matrices")
    return whole


def _frame(
    known: _Frame,
    fields: Mapping[str, Any],
    name: str,
    size_of: Callable[[str], tuple[int, int]],
    original: Float[np.ndarray, "4 4"],
    path: Path,
) -> CameraFrame:
    where = f"view '{name}'"

    def number(key: str) -> float | None:
        value = fields.get(key)
        if value is None or (isinstance(value, int | float) and math.isfinite(value)):
            return value
        raise refuse(path, f"{key} = {value!r} in {where}", "a finite number", "Correct the file")

    model = fields.get("camera_model", "OPENCV")
    fix = "Undistort the pictures and cameras first"
    if model not in ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL") or fields.get("is_fisheye"):
        raise refuse(path, f"the camera model {str(model)[:80]!r} in {where}", "PINHOLE or OPENCV", fix)
    high, wide = number("h"), number("w")
    height, width = (int(high), int(wide)) if high and wide else size_of(known.file_path)
    if not (1 <= width <= MAX_SIDE and 1 <= height <= MAX_SIDE):
        raise refuse(path, f"{width} x {height} pixels in {where}", f"1 to {MAX_SIDE} on a side", "Correct the file")
    angle = number("camera_angle_x")
    fx = number("fl_x") or (width / (2 * math.tan(angle / 2)) if angle and 0 < angle < math.pi else None)
    fy = number("fl_y") or fx
    if fx is None or fy is None or fx <= 0 or fy <= 0:
        raise refuse(path, f"no focal length in {where}", "fl_x or camera_angle_x", "Add one of them")
    cx, cy = number("cx"), number("cy")
    matrix = _matrix(known.transform_matrix, where, path) @ OPENGL_FROM_OPENCV
    check_rotation(matrix[:3, :3], where, path)
    k1, k2, k3, k4, p1, p2 = (float(number(key) or 0.0) for key in ("k1", "k2", "k3", "k4", "p1", "p2"))
    centre = (width / 2 if cx is None else float(cx), height / 2 if cy is None else float(cy))
    lens = Lens((float(fx), float(fy)), centre, (height, width), (k1, k2, k3), (p1, p2), k4)
    world_from_cam = moved_camera(Camera(matrix, float(fx), centre, (height, width), name), original).world_from_cam
    return CameraFrame(name, known.file_path, known.mask_path, world_from_cam, lens, "stored")


def _camera(entry: ViewEntry, path: Path) -> Camera:
    where = f"view '{entry.name}'"
    pose, flip = (entry.opencv, np.eye(4)) if entry.opencv else (entry.opengl, OPENGL_FROM_OPENCV)
    if pose is None:
        raise refuse(path, f"no pose in {where}", "opencv {R, t} or opengl {R, t}", "Add one of them")
    if entry.name != PurePosixPath(entry.name).name or "\\" in entry.name or "\0" in entry.name:
        raise refuse(path, f"the name {entry.name!r}", "a file name without folders", "Rename the view")
    cam_from_world = flip @ similarity(1.0, np.array(pose.R), np.array(pose.t))
    _check_square(entry.fx, entry.fy, where, path)
    back = cam_from_world[:3, :3].T
    check_rotation(back.T, where, path)
    world_from_cam = similarity(1.0, back, -back @ cam_from_world[:3, 3])
    azimuth, elevation = (float("nan") if a is None else float(a) for a in (entry.azimuth, entry.elevation))
    size = (entry.height, entry.width)
    return Camera(world_from_cam, entry.fx, (entry.cx, entry.cy), size, entry.name, azimuth, elevation)


def _check_square(fx: float, fy: float, where: str, path: Path) -> None:
    if abs(fx - fy) > RIGID * fx:
        raise refuse(path, f"fx = {fx:g}, fy = {fy:g} in {where}", "square pixels", "Resample the pictures")


def check_rotation(rotation: Float[np.ndarray, "3 3"], where: str, path: Path) -> None:
    """Refuse a matrix that is not a rotation within RIGID."""
    if np.abs(rotation @ rotation.T - np.eye(3)).max() > RIGID or np.linalg.det(rotation) < 0:
        fix = "Take scale and mirroring out of the matrix"
        raise refuse(path, f"a matrix that is not a rotation in {where}", "an orthonormal right-handed one", fix)


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
