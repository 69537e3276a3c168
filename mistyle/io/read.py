"""Reader of all pictures and tables that come from outside; `read_mesh.py` reads meshes.

Unusable files are refused (core/errors.py InputRefused) with the file, the content found, the content expected and the
fix. No network is used, and no repair is silent: `Picture.notes` lists the conversions.

Files are opened and decoded in the reader process (io/sandbox/reader_process.py), which has limits on memory and time
and cannot write; this module only assembles its numbers. A user's Mitsuba scene (`--scene`) is not read here: it can
name any file and plugin and is trusted like code.
"""

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, UInt16

from mistyle.core.asset import Picture, Pixels
from mistyle.io.images.layers import LayeredPicture, frame_of
from mistyle.io.images.quantisation import fractions
from mistyle.io.images.read import picture_of
from mistyle.io.sandbox.reader_process import ask

__all__ = [
    "LayeredPicture",
    "Picture",
    "read_colmap",
    "read_exposure",
    "read_exr",
    "read_frame",
    "read_hdr",
    "read_json",
    "read_metashape",
    "read_npy",
    "read_picture",
    "read_points",
    "read_radiance",
    "read_raw",
    "read_realityscan",
    "read_size",
    "read_stored_pixels",
    "read_stored_size",
    "read_toml",
    "read_yaml",
    "shrink_picture",
]

HIGH = (".exr", ".hdr", ".pfm", ".tif", ".tiff")  # pictures whose values may be linear floats


def read_exposure(path: Path) -> tuple[float, float, float]:
    """Exposure time in seconds, f-number and ISO speed by EXIF; NaN for each that the picture does not have."""
    seconds, f_number, iso = ask("exposure", Path(path))
    return seconds, f_number, iso


def read_exr(path: Path, colours: bool = False) -> dict[str, Float[np.ndarray, "h w"]]:
    """The channels of an OpenEXR file by full name ("R", "normal.X"), float32, display window, row 0 at the top.

    The header is checked before decoding: windows, number of channels, texels. All parts of a file are read, with their
    names before the channels'. Deep files and subsampled channels are refused; with `colours` also files whose header
    names other primaries than those of Rec.709.
    """
    return {name: np.asarray(plane, np.float32) for name, plane in ask("exr", Path(path), colours).items()}


def read_frame(path: Path) -> LayeredPicture:
    """A picture to compare: the layers of an .exr (of all its parts, whatever their windows) by name, or the one layer
    of an .hdr, .pfm, PNG, JPEG, WebP or TIFF; linear Rec.709, premultiplied, NaN and infinities kept. A TIFF of
    floating-point numbers holds linear values.

    Checked like `read_exr` and `read_picture`: header first, bounded. Two layers of one name are refused.
    """
    path = Path(path)
    frame = ask("frame", path) if path.suffix.lower() in HIGH else None
    return frame_of(read_picture(path)) if frame is None else frame


def read_hdr(path: Path) -> Float[np.ndarray, "h w 3"]:
    """A Radiance .hdr file: linear Rec.709 radiance, float32, row 0 at the top."""
    return ask("hdr", Path(path))


def read_json(path: Path) -> dict[str, Any]:
    """A JSON object from a file of at most 64 MiB, nested at most 128 deep, without NaN or Infinity."""
    return ask("json", Path(path))


def shrink_picture(path: Path, data: bytes, longest: int, quality: int) -> tuple[bytes, str]:
    """The picture in `data`, embedded in the file at `path`, as a JPEG (PNG with transparency) of at most `longest`
    pixels on a side: its bytes and MIME type."""
    return ask("shrink", Path(path), data, longest, quality)


def read_toml(path: Path) -> dict[str, Any]:
    """A TOML file of at most 4 MiB; dates and times, which no setting has, are refused."""
    return ask("toml", Path(path))


def read_yaml(path: Path) -> Any:
    """The numbers, texts, lists and tables of a YAML file of at most 4 MiB; objects and dates are refused."""
    return ask("yaml", Path(path))


def read_npy(path: Path) -> np.ndarray:
    """The array of numbers in an .npy file; files of objects and damaged ones are refused."""
    return ask("npy", Path(path))


def read_picture(path: Path, pixels: Pixels = "upright") -> Picture:
    """A style or any other picture file as sRGB-encoded float32 0..1; see io/images/read.py."""
    return picture_of(Path(path), ask("picture", Path(path), pixels))


def read_stored_pixels(path: Path, pixels: Pixels = "upright") -> tuple[np.ndarray, Float[np.ndarray, "h w"] | None]:
    """The colours of `read_picture` as 8- or 16-bit integers (floats where the file has them), and its alpha."""
    rgb, alpha, _ = ask("picture", Path(path), pixels)
    return rgb, None if alpha is None else fractions(alpha)


def read_radiance(path: Path) -> Float[np.ndarray, "h w 3"]:
    """An environment map: linear Rec.709 radiance >= 0 of an .exr (its R, G, B) or .hdr, row 0 at the top."""
    return ask("radiance", Path(path))


def read_raw(path: Path, pixels: Pixels = "stored") -> UInt16[np.ndarray, "h w 3"]:
    """A camera's RAW file (endings `core.asset.RAW`) as linear Rec.709, developed as io/images/raw.py describes."""
    return ask("raw", Path(path), pixels)


def read_size(path: Path, pixels: Pixels = "upright") -> tuple[int, int]:
    """Height and width of a picture (EXIF orientation applied unless "stored") or an .exr (display window), from its
    header alone."""
    height, width, orientation = read_stored_size(path)
    return (width, height) if pixels == "upright" and orientation > 4 else (height, width)


def read_stored_size(path: Path) -> tuple[int, int, int]:
    """Height and width of the pixels that a picture file stores, and its EXIF orientation 1..8 (1: none)."""
    height, width, orientation = ask("size", Path(path))
    return height, width, orientation


def read_colmap(folder: Path) -> list[Any]:
    """The registered images of a COLMAP model as io/cameras/camera_files.py Frames; see io/cameras/colmap.py
    `read_model`.
    """
    return ask("colmap_model", Path(folder))


def read_metashape(path: Path) -> list[Any]:
    """The aligned cameras of Metashape's XML as Frames; see io/cameras/metashape.py `read_cameras`."""
    return ask("metashape", Path(path))


def read_realityscan(path: Path) -> list[Any]:
    """The cameras of RealityScan's table or folder of XMP files as Frames, in shares of the pictures' longer side; see
    io/cameras/realityscan.py `read_cameras`."""
    return ask("realityscan", Path(path))


def read_points(path: Path) -> Any:
    """The points (n, 3) of a PLY, or of the folder of a COLMAP model; None where that has no points3D file."""
    return ask("points", Path(path))
