"""Which files hold RealityScan's cameras, and their lenses in a picture's pixels; `realityscan.py` decodes them."""

import re
from dataclasses import replace
from pathlib import Path

from mistyle.io.cameras.camera_files import CameraFrame
from mistyle.io.sandbox.bounds import read_bytes

HEAD = 4096  # bytes in which the columns of a table are looked for
XCR = "http://www.capturingreality.com/ns/xcr/1.1#"
POSE = ("name", "x", "y", "alt", "heading", "pitch", "roll", "f")
LENS = ("k1", "k2", "k3", "k4", "t1", "t2")
OPTIONAL = ("px", "py", *LENS)  # 0 where a table has no such column
RENAMED = {"yaw": "heading", "f_35mm": "f", "px_norm": "px", "py_norm": "py"}
MAX_BYTES = 16 << 20


def columns_of(path: Path) -> list[str]:
    """The columns of a table of RealityScan's cameras, by its older names; empty for any other file."""
    return columns_in(header_of(read_bytes(path, count=HEAD).decode("utf-8-sig", "replace").splitlines())[1])


def is_sidecar(path: Path) -> bool:
    """Whether an XMP file holds a pose by RealityScan."""
    data = read_bytes(path, MAX_BYTES)
    return XCR.encode() in data and b"Rotation" in data and b"Position" in data


def sidecars(folder: Path) -> list[Path]:
    """The XMP files of a folder with a pose by RealityScan."""
    files = [file for file in sorted(folder.iterdir()) if file.suffix.lower() == ".xmp" and file.is_file()]
    return [file for file in files if is_sidecar(file)]


def in_pixels(frame: CameraFrame, size: tuple[int, int]) -> CameraFrame:
    """The frame of `read_cameras` for a picture of `size` (height, width)."""
    lens, side = frame.lens, max(size)
    centre = (size[1] / 2 + lens.centre[0] * side, size[0] / 2 + lens.centre[1] * side)
    focal = (lens.focal[0] * side, lens.focal[1] * side)
    return replace(frame, lens=replace(lens, focal=focal, centre=centre, size=size))


def header_of(lines: list[str]) -> tuple[int, str]:
    """The index and text of the line with the columns: the first after a count of cameras."""
    known = (k for k, line in enumerate(lines) if line.strip() and not line.startswith("#cameras"))
    return (k, lines[k]) if (k := next(known, None)) is not None else (0, "")


def columns_in(header: str) -> list[str]:
    names = [name.strip().lower() for name in re.split("[,;\t]", header.lstrip("#"))]
    names = [RENAMED.get(name, name) for name in names]
    return names if header.startswith("#name") or {"name", "pitch", "roll"} <= set(names) else []
