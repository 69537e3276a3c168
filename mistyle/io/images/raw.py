"""Reader of cameras' RAW files by LibRaw; needs the extra `raw` (rawpy).

Development is the same for all pictures, so that they stay comparable: white balance of daylight, the sensor's own
exposure (no automatic brightness or maximum), AHD demosaicing, linear Rec.709 primaries. A value of 65535 is saturated.
"""

from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt16

from mistyle.core.asset import Pixels
from mistyle.io.sandbox.bounds import MAX_PIXELS, read_bytes, refuse

EXPECTED = "a RAW file that LibRaw reads"
CONVERT = "Develop it, and save it as a TIFF of 16 bits or a JPEG"
ORIENTATIONS = {0: 1, 3: 3, 5: 8, 6: 6}  # EXIF's number of LibRaw's flip
MAX_RAW_BYTES = 512 << 20


def size_of_raw(path: Path) -> tuple[int, int, int]:
    """See `read_stored_size` in io/read.py."""
    with _opened(path) as file:
        sizes = file.sizes
        return sizes.iheight, sizes.iwidth, ORIENTATIONS[sizes.flip]


def read_raw(path: Path, pixels: Pixels = "stored") -> UInt16[np.ndarray, "h w 3"]:
    """Linear Rec.709 radiance in 65535ths of the sensor's maximum, clipped there.

    Refused: damaged files, cameras that LibRaw does not know, more than MAX_PIXELS, pixels that are not square.
    """
    rawpy = _library(path)
    with _opened(path) as file:
        try:
            return file.postprocess(
                gamma=(1, 1), no_auto_bright=True, adjust_maximum_thr=0.0, output_bps=16, use_camera_wb=False,
                use_auto_wb=False, output_color=rawpy.ColorSpace.sRGB, user_flip=0 if pixels == "stored" else None,
            )  # fmt: skip
        except rawpy.LibRawError as error:
            raise refuse(path, f"pixels that cannot be developed ({_first(error)})", EXPECTED, CONVERT) from error


def _library(path: Path) -> Any:
    try:
        return import_module("rawpy")
    except (ImportError, OSError):
        fix = (
            "Install the reader (pip install 'mistyle[raw]'), or develop it and save it as a TIFF of 16 bits or a JPEG"
        )
        raise refuse(path, "a RAW photograph", "a picture that can be read here", fix) from None


def _opened(path: Path) -> Any:
    """The opened file, whose header passed the checks; its pixels are not developed yet."""
    rawpy = _library(path)
    read_bytes(path, MAX_RAW_BYTES, count=1)
    try:
        file = rawpy.imread(str(path))
    except rawpy.LibRawError as error:
        raise refuse(path, f"a file that LibRaw does not read ({_first(error)})", EXPECTED, CONVERT) from error
    sizes = file.sizes
    if not 1 <= sizes.iheight * sizes.iwidth <= MAX_PIXELS:
        found, most = f"{sizes.iwidth} x {sizes.iheight} pixels", f"1 to {MAX_PIXELS / 1e6:.0f} million"
    elif abs(sizes.pixel_aspect - 1) > 1e-3 or sizes.flip not in ORIENTATIONS:
        found, most = f"pixels of aspect {sizes.pixel_aspect:g}, flip {sizes.flip}", "square pixels, turned or not"
    else:
        return file
    file.close()
    raise refuse(path, found, most, CONVERT)


def _first(error: Exception) -> str:
    """LibRaw's message, a byte string, on one line."""
    detail = error.args[0] if error.args else type(error).__name__
    text = detail.decode(errors="replace") if isinstance(detail, bytes) else str(detail)
    return text.splitlines()[0][:120] if text else type(error).__name__
