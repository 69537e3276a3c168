"""Reader of Meshroom's cameras: AliceVision's SfMData as JSON (`cameras.sfm`, `sfm.json`).

Numbers may be texts. A pose holds the rotation camera from world, column after column, and the camera's centre; the
axes are OpenCV's. The principal point counts from the picture's middle, before version 1.2.1 from its corner. The focal
length is in millimetres beside `sensorWidth`, in older files in pixels (`pxFocalLength`).
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from pydantic import BaseModel, Field, ValidationError

from mistyle.core.errors import InputRefused
from mistyle.geometry.lens import Lens
from mistyle.geometry.similarity import similarity
from mistyle.io.cameras.camera_files import MAX_SIDE, CameraFrame, check_rotation, unique_names
from mistyle.io.read import read_json
from mistyle.io.sandbox.bounds import refuse

UNDISTORT = "Undistort the pictures in Meshroom (PrepareDenseScene) and hand in its cameras, or export a COLMAP model"
# Coefficients of a lens by `distortionType`, or by `type` in older files: radial, then tangential.
DISTORTIONS = {"none": 0, "pinhole": 0, "radialk1": 1, "radial1": 1, "radialk3": 3, "radial3": 3, "brown": 5}


class _View(BaseModel):
    viewId: str | int
    poseId: str | int | None = None
    intrinsicId: str | int | None = None
    path: str = Field("", max_length=1000)


class _Intrinsic(BaseModel):
    intrinsicId: str | int
    width: int = Field(ge=1, le=MAX_SIDE)
    height: int = Field(ge=1, le=MAX_SIDE)
    type: str = "pinhole"
    distortionType: str | None = None
    focalLength: float | None = None
    sensorWidth: float | None = None
    pxFocalLength: float | list[float] | None = None
    pixelRatio: float = 1.0
    principalPoint: list[float] = Field(default=[0.0, 0.0], min_length=2, max_length=2)
    distortionParams: list[float] | str = ""


class _Transform(BaseModel):
    rotation: list[float] = Field(min_length=9, max_length=9)
    center: list[float] = Field(min_length=3, max_length=3)


class _SfmPose(BaseModel):
    transform: _Transform


class _NamedPose(BaseModel):
    poseId: str | int
    pose: _SfmPose


class _SfmData(BaseModel):
    version: list[int] = Field(default=[1, 0, 0], min_length=3, max_length=3)
    views: list[_View] = Field(min_length=1, max_length=4096)
    intrinsics: list[_Intrinsic] = Field(min_length=1, max_length=4096)
    poses: list[_NamedPose] = []


def is_sfm(tree: Mapping[str, Any]) -> bool:
    """Whether a JSON object is an SfMData."""
    return {"views", "intrinsics"} <= set(tree)


def read_sfm(path: Path) -> list[CameraFrame]:
    """The reconstructed views, in the file's order. Refused: no pose at all, other lens models than DISTORTIONS,
    rigs' poses and pixels that are not square."""
    tree = read_json(path)
    if tree.get("rigs"):
        raise refuse(path, "camera rigs", "a pose for each view", "Reconstruct without rig constraints")
    try:
        data = _SfmData.model_validate(tree)
    except ValidationError as error:
        first = error.errors()[0]
        at = ".".join(str(step) for step in first["loc"])
        raise refuse(path, f"{first['msg']} at {at}", "an SfMData of Meshroom", "Export it again") from error
    poses = {str(each.poseId): each.pose.transform for each in data.poses}
    lenses = {str(each.intrinsicId): each for each in data.intrinsics}
    views = [view for view in data.views if str(view.poseId) in poses]
    if not views:
        fix = "Hand in the cameras.sfm of the node StructureFromMotion"
        raise refuse(path, "no view with a pose", "reconstructed cameras", fix)
    names = unique_names([view.path or f"view_{view.viewId}" for view in views])
    frames = []
    for view, name in zip(views, names, strict=True):
        where = f"view '{name}'"
        if str(view.intrinsicId) not in lenses:
            raise refuse(path, f"no intrinsics of {where}", "an entry of 'intrinsics'", "Export it again")
        lens = _lens(lenses[str(view.intrinsicId)], tuple(data.version) >= (1, 2, 1), where, path)
        pose = poses[str(view.poseId)]
        world_from_cam = similarity(1.0, np.reshape(pose.rotation, (3, 3)), np.array(pose.center))
        check_rotation(world_from_cam[:3, :3], where, path)
        frames.append(CameraFrame(name, view.path, None, world_from_cam, lens, "stored"))
    return frames


def read_landmarks(path: Path) -> Float[np.ndarray, "n 3"]:
    """The points of the reconstruction, as many as the file holds: `cameras.sfm` holds none."""
    try:
        found = [landmark["X"] for landmark in read_json(path).get("structure", [])]
        points = np.array(found, float).reshape(-1, 3)
    except (KeyError, TypeError, ValueError) as error:
        raise refuse(path, "a structure without points X", "three numbers each", "Export it again") from error
    return points[np.isfinite(points).all(axis=1)]


def _lens(known: _Intrinsic, from_middle: bool, where: str, path: Path) -> Lens:
    kind = known.distortionType or known.type
    if known.type not in DISTORTIONS or kind not in DISTORTIONS:
        raise _unsupported(f"the lens model '{kind if known.type in DISTORTIONS else known.type}' in {where}", path)
    if abs(known.pixelRatio - 1) > 1e-6:
        raise refuse(path, f"pixelRatio {known.pixelRatio:g} in {where}", "square pixels", UNDISTORT)
    given = known.distortionParams if isinstance(known.distortionParams, list) else []
    values = [*given, *[0.0] * 5]
    if any(given[DISTORTIONS[kind] :]):
        raise _unsupported(f"{len(given)} distortion parameters of '{kind}' in {where}", path)
    width, height = known.width, known.height
    if known.focalLength is not None and known.sensorWidth is not None and known.sensorWidth > 0:
        fx = fy = known.focalLength / known.sensorWidth * width
    else:
        px = known.pxFocalLength if isinstance(known.pxFocalLength, list) else [known.pxFocalLength]
        fx, fy = (float(px[k] or 0) if px else 0.0 for k in (0, -1))
    if not (fx > 0 and fy > 0 and np.isfinite(fx + fy)):
        raise refuse(path, f"no focal length in {where}", "focalLength with sensorWidth", "Export it again")
    x, y = known.principalPoint
    centre = (width / 2 + x, height / 2 + y) if from_middle else (x, y)
    return Lens((fx, fy), centre, (height, width), (values[0], values[1], values[2]), (values[3], values[4]))


def _unsupported(found: str, path: Path) -> InputRefused:
    return refuse(path, found, "pinhole, radial1, radial3 or brown", UNDISTORT)
