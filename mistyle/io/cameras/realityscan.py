"""Reader of RealityScan's (RealityCapture's) cameras: the CSV of its registration export "Internal/External camera
parameters", and the XMP files that it writes beside the pictures.

Sources: "On the Coordinate Systems Employed in the Import, Estimation, and Export of Camera Geometry by RealityScan"
(Epic Games, June 2026), and for the angles "Registration export and camera orientations" in Epic's forum.

- The world has x east, y north and z up. The position is the camera's centre, in the coordinate system of the export.
- Heading (yaw), pitch and roll turn an aircraft in north, east and down, in the order Z, Y, X; the camera looks down
  with its x axis along the right wing. XMP files have the rotation camera from world, row after row.
- Lengths in the picture are shares of its longer side, counted from its middle; the focal length is 36 times that.
  Older readers divided px and py by 36.
- The lens is Brown's, with k1 to k4 on r² to r⁸ and

      x' = x (1 + k1 r² + ...) + t1 (r² + 2 x²) + 2 t2 x y
      y' = y (1 + k1 r² + ...) + t2 (r² + 2 y²) + 2 t1 x y.

  The paper, its OpenCV exporter, AliceVision and CAMORPH agree that t1, t2 are OpenCV's p2, p1; nerfstudio and brush
  exchange them. (47) and (48) of the paper print the same coefficients for x and y, against its own text.
- The division model x' = x / (1 + k1 r²) has k1 alone. A table does not name the model: k1 alone is refused there.

No source says whether the pixels are those that a file stores; EXIF orientation is ignored, as nerfstudio does.
"""

import csv
import re
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
from jaxtyping import Float

from mistyle.geometry.lens import Lens
from mistyle.geometry.similarity import similarity
from mistyle.io.cameras.camera_files import CameraFrame, check_rotation, unique_names
from mistyle.io.cameras.realityscan_files import LENS, MAX_BYTES, OPTIONAL, POSE, XCR, columns_in, header_of, sidecars
from mistyle.io.sandbox.bounds import read_bytes, refuse

MAX_CAMERAS = 4096
FILM = 36.0  # millimetres along the longer side
SHORTEST = 3.0  # millimetres of a focal length; a share of the side is less
AGAIN = "Export the registration again (Internal/External camera parameters, CSV)"
UNDISTORT = (
    "Choose Brown3 as the distortion model and align again, or export undistorted pictures with their registration"
)


def read_cameras(path: Path) -> list[CameraFrame]:
    """The cameras of a table, in its order, or of a folder's XMP files, by name.

    Files do not have the pictures' sizes: lengths of the lenses are shares of the longer side, `in_pixels` converts
    them. `CameraFrame.picture` of an XMP file is its name without the ending.
    """
    try:
        return _sidecar_frames(path) if path.is_dir() else _table_frames(path)
    except (ElementTree.ParseError, csv.Error, UnicodeDecodeError, ValueError) as error:
        raise refuse(path, f"a damaged file ({str(error)[:100]})", "RealityScan's cameras", AGAIN) from error


def cam_from_world(heading: float, pitch: float, roll: float) -> Float[np.ndarray, "3 3"]:
    """The rotation to the camera (x right, y down, z forward) of angles in degrees."""
    (cz, cy, cx), (sz, sy, sx) = (f(np.radians([heading, pitch, roll])) for f in (np.cos, np.sin))
    return np.array(
        [
            [cx * cz + sx * sy * sz, cz * sx * sy - cx * sz, -cy * sx],
            [-cy * sz, -cy * cz, -sy],
            [cx * sy * sz - cz * sx, cx * cz * sy + sx * sz, -cx * cy],
        ]
    )


def _table_frames(path: Path) -> list[CameraFrame]:
    lines = read_bytes(path, MAX_BYTES).decode("utf-8-sig").splitlines()
    at, header = header_of(lines)
    names = columns_in(header)
    if "," not in header:
        raise refuse(path, f"the columns '{header[:60]}'", "columns separated by commas", AGAIN)
    missing = [name for name in POSE if name not in names]
    if missing:
        fix = f"{AGAIN}; its template in calibration.xml may have been edited"
        raise refuse(path, f"no column {', '.join(missing)}", f"the columns {', '.join(POSE)}", fix)
    twice = [name for name, times in Counter(names).items() if times > 1 and name in (*POSE, *OPTIONAL)]
    if twice:
        raise refuse(path, f"two columns {twice[0]}", "each column once", AGAIN)
    reader = csv.reader(lines[at + 1 :])
    rows = [(at + 1 + reader.line_num, row) for row in reader if any(cell.strip() for cell in row)]
    _check_count(path, rows, lines[:at])
    values = [_row(path, names, row, f"line {line}") for line, row in rows]
    pictures = [name for name, _ in values]
    repeated = next((name for name, times in Counter(pictures).items() if times > 1), None)
    if repeated is not None:
        fix = "Export one component, and each picture once"
        raise refuse(path, f"two cameras of '{repeated}'", "a camera for each picture", fix)
    frames = []
    for name, (picture, value) in zip(unique_names(pictures), values, strict=True):
        where = f"camera '{name}'"
        if value["k1"] and not any(value[key] for key in LENS[1:]):
            found = f"k1 alone in the lens of {where}, as the division model has it"
            raise refuse(path, found, "the coefficients of Brown's model", UNDISTORT)
        rotation = cam_from_world(value["heading"], value["pitch"], value["roll"])
        pose = similarity(1.0, rotation.T, np.array([value["x"], value["y"], value["alt"]]))
        frames.append(CameraFrame(name, picture, None, pose, _lens(value, where, path), "stored"))
    return frames


def _check_count(path: Path, rows: list[tuple[int, list[str]]], before: list[str]) -> None:
    """Refuse no cameras, too many, and fewer than the line `#cameras N` announces."""
    if not 1 <= len(rows) <= MAX_CAMERAS:
        raise refuse(path, f"{len(rows)} cameras", f"1 to {MAX_CAMERAS}", AGAIN)
    counts = [int(word) for line in before for word in re.findall(r"^#cameras\s+(\d+)", line)]
    if counts and len(rows) < counts[0]:
        fix = f"{AGAIN}, or correct the count"
        raise refuse(path, f"{len(rows)} cameras", f"{counts[0]}, as its first line says", fix)


def _row(path: Path, names: list[str], row: list[str], where: str) -> tuple[str, dict[str, float]]:
    """A row's picture, and its numbers by column."""
    if len(row) != len(names):
        fix = f"{AGAIN}; numbers need decimal points, not commas"
        raise refuse(path, f"{len(row)} fields in {where}", f"{len(names)}, as its header has", fix)
    cells = {name: cell.strip() for name, cell in zip(names, row, strict=True)}
    if not cells["name"]:
        raise refuse(path, f"no name in {where}", "the picture's name", AGAIN)
    keys = [name for name in (*POSE[1:], *OPTIONAL) if name in cells]
    return cells["name"][:1000], dict.fromkeys(OPTIONAL, 0.0) | {
        key: _number(path, cells[key], key, where) for key in keys
    }


def _number(path: Path, text: str, name: str, where: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    if not np.isfinite(value):
        raise refuse(path, f"{name} = '{text[:40]}' in {where}", "a finite number", AGAIN)
    return value


def _sidecar_frames(folder: Path) -> list[CameraFrame]:
    files = sidecars(folder)
    if not 1 <= len(files) <= MAX_CAMERAS:
        raise refuse(folder, f"{len(files)} XMP files with a pose", f"1 to {MAX_CAMERAS}", AGAIN)
    frames = []
    for file in files:
        text = _fields(file)
        where = f"the camera of '{file.stem}'"
        if {"Rotation", "Position", "FocalLength35mm"} - set(text):
            raise refuse(file, f"the fields {', '.join(text)}", "Rotation, Position and FocalLength35mm", AGAIN)
        plain = (text.get("Skew", "0"), text.get("AspectRatio", "1"))
        if [_number(file, word, "Skew, AspectRatio", where) for word in plain] != [0, 1]:
            raise refuse(file, f"Skew {plain[0]}, AspectRatio {plain[1]}", "0 and 1: square pixels", UNDISTORT)
        lengths = {"f": "FocalLength35mm", "px": "PrincipalPointU", "py": "PrincipalPointV"}
        value = {key: _number(file, text.get(name, "0"), name, where) for key, name in lengths.items()}
        value |= _coefficients(file, text, where)
        rotation = _numbers(file, text["Rotation"], "Rotation", 9).reshape(3, 3)
        check_rotation(rotation, where, file)
        pose = similarity(1.0, rotation.T, _numbers(file, text["Position"], "Position", 3))
        frames.append(CameraFrame(file.stem, file.stem, None, pose, _lens(value, where, file), "stored"))
    return frames


def _fields(file: Path) -> dict[str, str]:
    """RealityScan's values in an XMP file, which are attributes or elements."""
    data = read_bytes(file, MAX_BYTES)
    if b"<!DOCTYPE" in data:
        raise refuse(file, "a document type definition", "an XMP file", AGAIN)
    result: dict[str, str] = {}
    for element in ElementTree.fromstring(data).iter():
        for name, text in ((element.tag, element.text), *element.attrib.items()):
            if name.startswith(f"{{{XCR}}}"):
                result[name.removeprefix(f"{{{XCR}}}")] = (text or "").strip()
    return result


def _coefficients(file: Path, text: Mapping[str, str], where: str) -> dict[str, float]:
    model = text.get("DistortionModel", "none")
    values = np.zeros(6)
    if model not in ("none", "perspective") and "DistortionCoeficients" in text:  # RealityScan's spelling
        values = _numbers(file, text["DistortionCoeficients"], "DistortionCoeficients", 6)
    if values.any() and not re.fullmatch("brown[34](t2)?", model):
        raise refuse(file, f"the distortion model '{model[:40]}' of {where}", "brown3 to brown4t2", UNDISTORT)
    return dict(zip(LENS, values.tolist(), strict=True))


def _numbers(file: Path, text: str, name: str, count: int) -> Float[np.ndarray, " n"]:
    values = np.array([_number(file, word, name, "the file") for word in text.split()])
    if len(values) != count:
        raise refuse(file, f"{len(values)} numbers of {name}", f"{count}", AGAIN)
    return values


def _lens(value: Mapping[str, float], where: str, path: Path) -> Lens:
    """The lens in shares of the longer side; its size is that of no picture."""
    if value["f"] < SHORTEST:
        found = f"a focal length of {value['f']:g} mm of {where}"
        raise refuse(path, found, f"at least {SHORTEST:g} mm on film of 36 mm", AGAIN)
    k1, k2, k3, k4, t1, t2 = (value[key] for key in LENS)
    focal = value["f"] / FILM
    return Lens((focal, focal), (value["px"], value["py"]), (1, 1), (k1, k2, k3), (t2, t1), k4)
