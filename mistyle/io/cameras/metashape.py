"""Reader of Metashape's cameras: its XML of File > Export > Export Cameras.

A camera's transform is the chunk from the camera, row after row, with OpenCV's axes. The transform of its component, in
older files of the chunk, leads on to the space of exported meshes: x = scale · R · x_chunk + t. Lenses are Brown's,

    x' = x (1 + k1 r² + k2 r⁴ + k3 r⁶ + k4 r⁸) + p1 (r² + 2 x²) + 2 p2 x y
    y' = y (1 + k1 r² + k2 r⁴ + k3 r⁶ + k4 r⁸) + p2 (r² + 2 y²) + 2 p1 x y
    pixel = (width / 2 + cx + x' (f + b1) + y' b2, height / 2 + cy + y' f)

(Metashape Professional Edition User Manual, appendix D). geometry/lens.py has p1 and p2 exchanged; b2 is its skew.
"""

from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np
from jaxtyping import Float

from mistyle.geometry.lens import Lens
from mistyle.geometry.similarity import similarity
from mistyle.io.cameras.camera_files import MAX_SIDE, CameraFrame, check_rotation, unique_names
from mistyle.io.sandbox.bounds import read_bytes, refuse

MAX_CAMERAS = 4096
MAX_BYTES = 256 << 20
AGAIN = "Export the cameras again (File > Export > Export Cameras, Agisoft XML)"
UNDISTORT = "Undistort the photographs in Metashape (Export > Undistort Photos), or export a COLMAP model"
# The coefficients of a calibration; a missing one is 0.
COEFFICIENTS = ("cx", "cy", "k1", "k2", "k3", "k4", "p1", "p2", "p3", "p4", "b1", "b2")


def read_cameras(path: Path) -> list[CameraFrame]:
    """The enabled, aligned cameras of the file's one chunk with such cameras, in the file's order.

    They are in the space of exported meshes. `CameraFrame.picture` is the camera's label.

    Refused: lenses other than `frame` (fisheye, spherical), p3 and p4, several chunks.
    """
    data = read_bytes(path, MAX_BYTES)
    try:
        if b"<!DOCTYPE" in data:
            raise ValueError("a document type definition")
        root = ElementTree.fromstring(data)
        chunks = [chunk for chunk in root.iter("chunk") if _aligned(chunk)]
        if len(chunks) != 1:
            found = f"{len(chunks)} chunks with aligned cameras"
            raise refuse(path, found, "one", "Align the photographs, and export the cameras of one chunk")
        return _frames(chunks[0], path)
    except (ElementTree.ParseError, ValueError, TypeError, KeyError, AttributeError, OverflowError) as error:
        raise refuse(path, f"a damaged file ({str(error)[:100]})", "Metashape's cameras", AGAIN) from error


def _aligned(chunk: Element) -> list[Element]:
    """The enabled cameras with a pose, in groups or not."""
    cameras = [each for each in chunk.iterfind("cameras//camera") if each.get("enabled") not in ("false", "0")]
    return [each for each in cameras if each.find("transform") is not None]


def _frames(chunk: Element, path: Path) -> list[CameraFrame]:
    cameras = _aligned(chunk)
    if len(cameras) > MAX_CAMERAS:
        raise refuse(path, f"{len(cameras)} cameras", f"at most {MAX_CAMERAS}", "Export fewer cameras")
    lenses = {sensor.get("id"): sensor for sensor in chunk.iterfind("sensors/sensor")}
    spaces = {part.get("id"): part.find("transform") for part in chunk.iterfind("components/component")}
    labels = [(each.get("label") or f"camera_{each.get('id')}")[:1000] for each in cameras]
    frames = []
    for camera, label, name in zip(cameras, labels, unique_names(labels), strict=True):
        where = f"camera '{name}'"
        space = spaces.get(camera.get("component_id"))
        world = _world(chunk.find("transform") if space is None else space, where, path)
        if camera.get("sensor_id") not in lenses:
            raise refuse(path, f"no sensor of {where}", "an entry of 'sensors'", AGAIN)
        pose = _numbers(camera.findtext("transform"), 16, where, path).reshape(4, 4)
        rotation = world[:3, :3] / np.cbrt(np.linalg.det(world[:3, :3])) @ pose[:3, :3]
        check_rotation(rotation, where, path)
        world_from_cam = similarity(1.0, rotation, world[:3, :3] @ pose[:3, 3] + world[:3, 3])
        lens = _lens(lenses[camera.get("sensor_id")], where, path)
        frames.append(CameraFrame(name, label, None, world_from_cam, lens, "stored"))
    return frames


def _world(transform: Element | None, where: str, path: Path) -> Float[np.ndarray, "4 4"]:
    """The space of exported meshes from the chunk: the identity where a chunk has no reference."""
    result = np.eye(4)
    if transform is None:
        return result
    scale = float(transform.findtext("scale") or 1)
    if not (np.isfinite(scale) and scale > 0):
        raise refuse(path, f"the scale {scale:g} of the component of {where}", "more than 0", AGAIN)
    if (rotation := transform.findtext("rotation")) is not None:
        result[:3, :3] = _numbers(rotation, 9, where, path).reshape(3, 3)
        check_rotation(result[:3, :3], f"the component of {where}", path)
    if (shift := transform.findtext("translation")) is not None:
        result[:3, 3] = _numbers(shift, 3, where, path)
    result[:3, :3] *= scale
    return result


def _numbers(text: str | None, count: int, where: str, path: Path) -> Float[np.ndarray, " n"]:
    values = np.array([float(word) for word in (text or "").split()])
    if len(values) != count or not np.isfinite(values).all():
        raise refuse(path, f"{len(values)} numbers in a transform of {where}", f"{count} finite ones", AGAIN)
    return values


def _lens(sensor: Element, where: str, path: Path) -> Lens:
    calibrations = sensor.findall("calibration")
    # "adjusted" is the result of the alignment, "initial" its start.
    known = next((each for each in calibrations if each.get("class") == "adjusted"), None)
    known = known if known is not None or not calibrations else calibrations[-1]
    if known is None:
        raise refuse(path, f"no calibration of the sensor of {where}", "an adjusted one", AGAIN)
    kind = known.get("type") or sensor.get("type") or "frame"
    if kind != "frame":
        raise refuse(path, f"the lens model '{kind[:40]}' of {where}", "frame", UNDISTORT)
    size = known.find("resolution")
    size = sensor.find("resolution") if size is None else size
    if size is None:
        raise refuse(path, f"no resolution of the sensor of {where}", "width and height", AGAIN)
    width, height = int(size.get("width", "0")), int(size.get("height", "0"))
    if not (1 <= width <= MAX_SIDE and 1 <= height <= MAX_SIDE):
        raise refuse(path, f"{width} x {height} pixels of {where}", f"1 to {MAX_SIDE} on a side", AGAIN)
    focal = float(known.findtext("f") or "nan")
    value = {name: float(known.findtext(name) or 0) for name in COEFFICIENTS}
    if not (focal > 0 and np.isfinite([focal, *value.values()]).all()):
        raise refuse(path, f"a focal length of {focal:g} or coefficients of {where}", "finite numbers", AGAIN)
    unread = [name for name in ("p3", "p4") if value[name]]
    if unread:
        raise refuse(path, f"{', '.join(unread)} in the lens of {where}", "k1 to k4, p1, p2, b1 and b2", UNDISTORT)
    return Lens(
        (focal + value["b1"], focal), (width / 2 + value["cx"], height / 2 + value["cy"]), (height, width),
        (value["k1"], value["k2"], value["k3"]), (value["p2"], value["p1"]), value["k4"], value["b2"],
    )  # fmt: skip
