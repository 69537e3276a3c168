"""Reader of COLMAP's sparse models, text and binary: cameras, images and points.

COLMAP's conventions are ours: camera axes x right, y down, z forward; x_cam = R x + t; the first pixel's centre is
(0.5, 0.5). The two-dimensional observations are skipped.
"""

import re
import struct
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from jaxtyping import Float

from mistyle.geometry.lens import Lens
from mistyle.geometry.similarity import similarity
from mistyle.io.cameras.camera_files import MAX_SIDE, CameraFrame, check_rotation, unique_names
from mistyle.io.sandbox.bounds import read_bytes, refuse

# By the number in binary files: the name in text files and the number of parameters.
MODELS = (
    *(("SIMPLE_PINHOLE", 3), ("PINHOLE", 4), ("SIMPLE_RADIAL", 4), ("RADIAL", 5), ("OPENCV", 8)),
    *(("OPENCV_FISHEYE", 8), ("FULL_OPENCV", 12), ("FOV", 5), ("SIMPLE_RADIAL_FISHEYE", 4), ("RADIAL_FISHEYE", 5)),
    *(("THIN_PRISM_FISHEYE", 12), ("RAD_TAN_THIN_PRISM_FISHEYE", 16)),
)
READ = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV")
MAX_IMAGES = 4096
FILES = ("cameras", "images")
UNDISTORT = "Run `colmap image_undistorter` and hand in its output"
AGAIN = "Export the model again (`colmap model_converter`)"


def find_model(path: Path) -> Path | None:
    """The folder with cameras and images (.bin or .txt): `path` itself, or the largest of the numbered models in its
    `sparse`, its sparse, or its own largest numbered model; else None."""
    for folder in (path, *_largest(path / "sparse"), path / "sparse", *_largest(path)):
        if _is_model(folder):
            return folder
    return None


def models_below(folder: Path) -> list[tuple[Path, int]]:
    """The numbered models in a folder, as COLMAP writes one for each connected part, with their numbers of images;
    the largest first, equal ones by number."""
    numbered = [f for f in folder.iterdir() if f.name.isdecimal() and _is_model(f)] if folder.is_dir() else []
    return sorted(((f, _image_count(f)) for f in numbered), key=lambda pair: (-pair[1], int(pair[0].name)))


def _largest(folder: Path) -> list[Path]:
    return [model for model, _ in models_below(folder)[:1]]


def _is_model(folder: Path) -> bool:
    return all(any((folder / f"{name}{ending}").is_file() for ending in (".bin", ".txt")) for name in FILES)


def _image_count(folder: Path) -> int:
    """The number of images of a model, by the head of its file; 0 where a text does not state it."""
    path, binary = _file(folder, "images")
    head = read_bytes(path, count=1000)
    if binary:
        return struct.unpack("<Q", head[:8])[0] if len(head) >= 8 else 0
    stated = re.search(rb"# Number of images: (\d+)", head)
    return int(stated[1]) if stated else 0


def read_model(folder: Path) -> list[CameraFrame]:
    """The registered images of a model as frames, ordered by the images' names.

    `CameraFrame.picture` is COLMAP's own name.

    Refused: camera models other than SIMPLE_PINHOLE, PINHOLE, SIMPLE_RADIAL, RADIAL and OPENCV, by their names;
    damaged files; images of missing cameras; no images at all.
    """
    path, binary = _file(folder, "cameras")
    lenses = _guarded(_cameras_bin if binary else _cameras_txt, path)
    path, binary = _file(folder, "images")
    rows = sorted(_guarded(_images_bin if binary else _images_txt, path), key=lambda row: row[2])
    if not 1 <= len(rows) <= MAX_IMAGES:
        raise refuse(path, f"{len(rows)} registered images", f"1 to {MAX_IMAGES}", "Reconstruct the scene first")
    frames = []
    for (pose, camera, picture), name in zip(rows, unique_names([row[2] for row in rows]), strict=True):
        if camera not in lenses:
            raise refuse(path, f"camera {camera} of the image {picture!r}", "one of cameras' numbers", AGAIN)
        # COLMAP reads the stored pixels and ignores the EXIF orientation.
        frames.append(CameraFrame(name, picture, None, _world_from_cam(pose, picture, path), lenses[camera], "stored"))
    return frames


def read_points(folder: Path) -> Float[np.ndarray, "n 3"] | None:
    """The points of a model (the model's units), or None where it has no points3D file."""
    files = [path for ending in (".bin", ".txt") if (path := folder / f"points3D{ending}").is_file()]
    if not files:
        return None
    rows = _guarded(_points_bin if files[0].suffix == ".bin" else _points_txt, files[0])
    points = np.asarray(rows, float).reshape(-1, 3)
    if not np.isfinite(points).all():
        raise refuse(files[0], "points at NaN or infinity", "finite points", AGAIN)
    return points


def _file(folder: Path, name: str) -> tuple[Path, bool]:
    binary = folder / f"{name}.bin"
    return (binary, True) if binary.is_file() else (folder / f"{name}.txt", False)


def _guarded(reader, path: Path):
    """The result of `reader`; truncated and invalid files are refused."""
    try:
        return reader(path)
    except (struct.error, ValueError, IndexError, OverflowError, UnicodeDecodeError) as error:
        problem = f"a damaged or cut-off file ({str(error)[:100]})"
        raise refuse(path, problem, f"COLMAP's {path.name}", AGAIN) from error


def _lens(model: str, width: int, height: int, values: list[float], path: Path) -> Lens:
    if model not in READ:
        raise refuse(path, f"the camera model {model[:40]}", f"one of {', '.join(READ)}", UNDISTORT)
    if not (1 <= width <= MAX_SIDE and 1 <= height <= MAX_SIDE):
        raise refuse(path, f"{width} x {height} pixels", f"1 to {MAX_SIDE} on a side", AGAIN)
    count = dict(MODELS)[model]
    if len(values) != count or not np.isfinite(values).all():
        raise refuse(path, f"{len(values)} parameters of {model}", f"{count} finite numbers", AGAIN)
    two = model in ("PINHOLE", "OPENCV")
    fx, fy, cx, cy = values[:4] if two else (values[0], *values[:3])
    if fx <= 0 or fy <= 0:
        raise refuse(path, f"a focal length of {min(fx, fy):g}", "more than 0", AGAIN)
    rest = values[4 if two else 3 :]
    k1, k2, p1, p2 = [*rest, 0.0, 0.0, 0.0, 0.0][:4]
    return Lens((fx, fy), (cx, cy), (height, width), (k1, k2, 0.0), (p1, p2))


def _world_from_cam(pose: tuple[float, ...], picture: str, path: Path) -> Float[np.ndarray, "4 4"]:
    """From the quaternion (w, x, y, z) and the translation of x_cam = R x + t."""
    quaternion, shift = np.asarray(pose[:4]), np.asarray(pose[4:])
    length = np.linalg.norm(quaternion)
    if not np.isfinite(pose).all() or length < 1e-6:
        raise refuse(path, f"an invalid pose of {picture!r}", "a quaternion and a translation", AGAIN)
    w, x, y, z = quaternion / length
    rotation = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    check_rotation(rotation, picture, path)
    return similarity(1.0, rotation.T, -rotation.T @ shift)


class _Bytes:
    """Reader of a file's bytes; it raises where the file ends too soon (state: the offset)."""

    def __init__(self, path: Path) -> None:
        self.data, self.at = read_bytes(path), 0

    def take(self, layout: str) -> tuple:
        values = struct.unpack_from("<" + layout, self.data, self.at)
        self.at += struct.calcsize("<" + layout)
        return values

    def skip(self, size: int) -> None:
        self.at += size
        if self.at > len(self.data):
            raise ValueError(f"it ends at byte {len(self.data)}")

    def text(self) -> str:
        end = self.data.index(b"\0", self.at, self.at + 2000)
        start, self.at = self.at, end + 1
        return self.data[start:end].decode()


def _cameras_bin(path: Path) -> dict[int, Lens]:
    head = _Bytes(path)
    lenses = {}
    for _ in range(head.take("Q")[0]):
        camera, number, width, height = head.take("IiQQ")
        if not 0 <= number < len(MODELS):
            raise refuse(path, f"a camera model of number {number}", f"one of {', '.join(READ)}", UNDISTORT)
        model, count = MODELS[number]
        lenses[camera] = _lens(model, width, height, list(head.take(f"{count}d")), path)
    return lenses


def _images_bin(path: Path) -> list[tuple[tuple[float, ...], int, str]]:
    head = _Bytes(path)
    rows = []
    for _ in range(head.take("Q")[0]):
        _, *pose, camera = head.take("I7dI")
        rows.append((tuple(pose), camera, head.text()))
        head.skip(24 * head.take("Q")[0])
    return rows


def _points_bin(path: Path) -> list[tuple[float, ...]]:
    head = _Bytes(path)
    rows = []
    for _ in range(head.take("Q")[0]):
        _, x, y, z, _, _, _, _, seen = head.take("Q3d3BdQ")
        rows.append((x, y, z))
        head.skip(8 * seen)
    return rows


def _lines(path: Path) -> Iterator[str]:
    """The lines that are not comments, with any line ending; a byte-order mark is skipped."""
    for line in re.split(r"\r\n|\r|\n", read_bytes(path).decode("utf-8-sig")):
        if not line.lstrip().startswith("#"):
            yield line


def _cameras_txt(path: Path) -> dict[int, Lens]:
    lenses = {}
    for line in _lines(path):
        if line.strip():
            camera, model, width, height, *values = line.split()
            lenses[int(camera)] = _lens(model, int(width), int(height), [float(v) for v in values], path)
    return lenses


def _images_txt(path: Path) -> list[tuple[tuple[float, ...], int, str]]:
    """The images' lines. The line of observations after each may be absent: some writers omit empty ones."""
    rows = []
    after_image = False  # whether observations may come
    for line in _lines(path):
        if not line.strip() or (after_image and _is_observations(line)):
            after_image = False
            continue
        fields = re.split(r"\s+", line.strip(), maxsplit=9)
        if len(fields) != 10:
            raise ValueError(f"an image of {len(fields)} fields: {line[:60]!r}")
        rows.append((tuple(float(v) for v in fields[1:8]), int(fields[8]), fields[9]))
        after_image = True
    return rows


def _is_observations(line: str) -> bool:
    """Whether a line of images.txt holds triples of X, Y and POINT3D_ID, and so is not an image with its name."""
    fields = line.split()
    try:
        [float(v) for v in fields]
        [int(v) for v in fields[2::3]]
    except ValueError:
        return False
    return len(fields) % 3 == 0


def _points_txt(path: Path) -> list[tuple[float, ...]]:
    rows = []
    for line in _lines(path):
        if line.strip():
            fields = line.split()
            x, y, z, _ = (float(fields[k]) for k in (1, 2, 3, 7))
            rows.append((x, y, z))
    return rows
