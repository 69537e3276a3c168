"""Reader of OpenEXR and Radiance files, header first."""

import math
import re
import sys
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Shaped

from mistyle.io.images.write import REC709_CHROMATICITIES
from mistyle.io.sandbox.bounds import MAX_PIXELS, read_bytes, refuse

MAX_CHANNELS = 256
MAX_SAMPLES = 1 << 29  # texels times channels: 2 GiB of float32
AGAIN = "Write or copy it again"
# Linear Rec.709 of CIE XYZ (IEC 61966-2-1).
RGB_FROM_XYZ = np.array([[3.2406, -1.5372, -0.4986], [-0.9689, 1.8758, 0.0415], [0.0557, -0.2040, 1.0570]], np.float32)
EXR_MAGIC = b"\x76\x2f\x31\x01"


def read_exr(path: Path, colours: bool = False) -> dict[str, Shaped[np.ndarray, "h w"]]:
    """See io/read.py; in the file's own precision."""
    parts = parts_of_exr(path)
    found = chromaticities(parts[0].header, path)
    if colours and not np.allclose(found, REC709_CHROMATICITIES, atol=2e-3):
        numbers = " ".join(f"{v:.4f}" for v in found)
        raise refuse(path, f"colours of other primaries ({numbers})", "linear Rec.709", "Convert it, or export it so")
    planes: dict[str, np.ndarray] = {}
    for part in parts:
        prefix = f"{part.header['name']}." if len(parts) > 1 and part.header.get("name") else ""
        for name, channel in part.channels.items():
            planes[prefix + name] = _shown(np.asarray(channel.pixels), part.header, path)
    if len({plane.shape for plane in planes.values()}) > 1:
        raise refuse(path, "parts of different sizes", "one size", "Save the parts as files of their own")
    return planes


def colour_of_exr(path: Path) -> Float[np.ndarray, "h w 3"]:
    """The picture in a file that serves as a texture: R, G and B, also of a layer (the first by name), else its first
    channel three times. NaN and infinities are 0."""
    planes = read_exr(path)
    layers = sorted(name[:-1] for name in planes if name.endswith("R"))
    layer = next((x for x in layers if {f"{x}G", f"{x}B"} <= set(planes)), None)
    names = [f"{layer}{c}" for c in "RGB"] if layer is not None else ["Y" if "Y" in planes else sorted(planes)[0]] * 3
    colour = np.stack([planes[name] for name in names], axis=-1).astype(np.float32)
    return np.nan_to_num(colour, nan=0.0, posinf=0.0, neginf=0.0)


def chromaticities(header: dict[str, Any], path: Path) -> tuple[float, ...]:
    """(x, y) of red, green, blue and white; those of Rec.709 without an entry."""
    entry = header.get("chromaticities")
    if entry is None:
        return REC709_CHROMATICITIES
    try:
        values = tuple(float(v) for pair in entry for v in (pair if np.ndim(pair) else [pair]))
    except (TypeError, ValueError) as error:
        raise refuse(path, f"chromaticities of type {type(entry).__name__}", "eight numbers", AGAIN) from error
    return values if len(values) == 8 else REC709_CHROMATICITIES


def size_of_exr(path: Path) -> tuple[int, int]:
    """See `read_stored_size` in io/read.py."""
    width, height = window_of(headers_of_exr(path)[0], "displayWindow")[2:]
    return height, width


def parts_of_exr(path: Path) -> list[Any]:
    """The decoded parts of a file whose headers have passed; no announced part is missing."""
    import OpenEXR

    if read_bytes(path, count=4) != EXR_MAGIC:
        raise refuse(path, "no OpenEXR header", "an .exr file", "Check that it is the right file")
    headers = headers_of_exr(path)
    try:
        parts = OpenEXR.File(str(path), separate_channels=True).parts
    except (RuntimeError, ValueError, TypeError, KeyError, MemoryError) as error:
        raise refuse(
            path, f"pixels that cannot be read ({str(error)[:120]})", "a complete OpenEXR file", AGAIN
        ) from error
    # Where decoding fails the library drops the part and prints a warning instead of raising.
    if len(parts) != len(headers):
        raise refuse(path, f"{len(parts)} of {len(headers)} parts whose pixels can be read", "a complete file", AGAIN)
    return parts


def headers_of_exr(path: Path) -> list[dict[str, Any]]:
    """The headers of all parts, checked before decoding."""
    import OpenEXR

    try:
        headers = [part.header for part in OpenEXR.File(str(path), separate_channels=True, header_only=True).parts]
    except (RuntimeError, ValueError, TypeError, KeyError) as error:
        raise refuse(path, f"a header that cannot be read ({str(error)[:120]})", "an OpenEXR file", AGAIN) from error
    check_headers(headers, path)
    return headers


def window_of(header: dict[str, Any], name: str) -> tuple[int, int, int, int]:
    """x0, y0, width and height."""
    low, high = header[name]
    return int(low[0]), int(low[1]), int(high[0]) - int(low[0]) + 1, int(high[1]) - int(low[1]) + 1


def check_headers(headers: list[dict[str, Any]], path: Path) -> None:
    samples = 0
    if not headers:
        raise refuse(path, "no image", "an OpenEXR image", AGAIN)
    for header in headers:
        kind = str(header.get("type", "scanlineimage"))
        if "deep" in kind:
            raise refuse(path, f"a deep image ({kind})", "a flat one", "Flatten it")
        channels = header["channels"]
        if not 0 < len(channels) <= MAX_CHANNELS:
            raise refuse(path, f"{len(channels)} channels", f"1 to {MAX_CHANNELS}", "Leave channels out")
        if any(c.xSampling != 1 or c.ySampling != 1 for c in channels):
            raise refuse(path, "subsampled channels", "all channels at full resolution", "Convert it to RGB")
        for name in ("dataWindow", "displayWindow"):
            width, height = window_of(header, name)[2:]
            if width < 1 or height < 1 or width * height > MAX_PIXELS:
                found, most = f"a {name} of {width} x {height}", f"1 to {MAX_PIXELS / 1e6:.0f} million texels"
                raise refuse(path, found, most, "Scale it down, or write it again if it is damaged")
            samples += width * height * len(channels)
    if samples > 2 * MAX_SAMPLES:
        raise refuse(path, f"{samples} samples", f"at most {2 * MAX_SAMPLES}", "Scale it down or leave channels out")


def _shown(pixels: Shaped[np.ndarray, "h w"], header: dict[str, Any], path: Path) -> Shaped[np.ndarray, "h2 w2"]:
    """The pixels of the display window, zero outside the data window."""
    x, y, width, height = window_of(header, "dataWindow")
    sx, sy, shown_width, shown_height = window_of(header, "displayWindow")
    if pixels.shape != (height, width):
        raise refuse(path, f"{pixels.shape} texels", f"{(height, width)} by its header", AGAIN)
    if (x, y, width, height) == (sx, sy, shown_width, shown_height):
        return pixels
    result = np.zeros((shown_height, shown_width), pixels.dtype)
    x0, y0 = max(x, sx), max(y, sy)
    x1, y1 = min(x + width, sx + shown_width), min(y + height, sy + shown_height)
    if x1 > x0 and y1 > y0:
        result[y0 - sy : y1 - sy, x0 - sx : x1 - sx] = pixels[y0 - y : y1 - y, x0 - x : x1 - x]
    return result


def read_hdr(path: Path) -> Float[np.ndarray, "h w 3"]:
    """See io/read.py."""
    data = read_bytes(path, 512 << 20)
    size = re.search(rb"\n\n-Y (\d{1,6}) \+X (\d{1,6})\n", data[: 1 << 16])
    if not data.startswith(b"#?") or size is None:
        raise refuse(
            path, "no Radiance header (-Y height +X width)", "an .hdr file, upright", "Write it again, or as .exr"
        )
    height, width = int(size[1]), int(size[2])
    if not 0 < height * width <= MAX_PIXELS:
        raise refuse(path, f"{width} x {height} pixels", f"1 to {MAX_PIXELS / 1e6:.0f} million", "Scale it down")
    if re.search(rb"\nFORMAT=32-bit_rle_xyze[ \t]*\r?\n", data[: size.start() + 1]):
        return _xyze(data, size.end(), height, width, path)
    pixels = _rgbe(path, data)
    if pixels is None or pixels.shape != (height, width, 3) or pixels.dtype != np.float32:
        raise refuse(path, "pixels that cannot be decoded", f"{width} x {height} RGBE pixels", AGAIN)
    return np.ascontiguousarray(pixels[..., ::-1])


def read_pfm(path: Path) -> Float[np.ndarray, "h w 3"]:
    """A portable float map, in colour or grey, times the scale in its header: linear values, row 0 at the top."""
    data = read_bytes(path, 512 << 20)
    header = re.match(rb"P([Ff])\s+(\d{1,6})\s+(\d{1,6})\s+([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s", data)
    if header is None or not float(header[4]):
        raise refuse(path, "no PFM header (PF or Pf, width, height, scale)", "a .pfm file", "Write it again as .exr")
    shape = int(header[3]), int(header[2]), 3 if header[1] == b"F" else 1
    if not 0 < shape[0] * shape[1] <= MAX_PIXELS:
        raise refuse(path, f"{shape[1]} x {shape[0]} pixels", f"1 to {MAX_PIXELS / 1e6:.0f} million", "Scale it down")
    count, order = math.prod(shape), "<" if header[4].startswith(b"-") else ">"
    if len(data) - header.end() < 4 * count:
        raise refuse(path, f"{len(data) - header.end()} bytes of pixels", f"{4 * count}", AGAIN)
    # As Mitsuba; OpenCV divides by the scale.
    rows = np.frombuffer(data, f"{order}f4", count, header.end()).reshape(shape) * np.float32(abs(float(header[4])))
    return np.broadcast_to(rows[::-1], (*shape[:2], 3)).astype(np.float32)


def _rgbe(path: Path, data: bytes) -> Any:
    import cv2

    try:
        # OpenCV decodes Radiance from files only: it writes bytes to a temporary file first, which the
        # reader process may not do. On Windows it accepts only ASCII paths.
        from_file = sys.platform != "win32" or str(path).isascii()
        return (
            cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
            if from_file
            else cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
        )
    except cv2.error as error:
        raise refuse(path, f"pixels that cannot be decoded ({str(error)[:120]!r})", "an .hdr file", AGAIN) from error


def _xyze(data: bytes, at: int, height: int, width: int, path: Path) -> Float[np.ndarray, "h w 3"]:
    """CIE XYZ with a common exponent (which OpenCV does not read) as linear Rec.709; colours outside it become 0."""
    quads = np.empty((height, width, 4), np.uint8)
    try:
        for row in quads:
            at = _scanline(data, at, row)
    except (IndexError, ValueError) as error:
        raise refuse(path, "pixels that cannot be decoded", f"{width} x {height} XYZE pixels", AGAIN) from error
    scale = np.where(quads[..., 3] > 0, np.ldexp(np.float32(1), quads[..., 3].astype(np.int32) - 136), 0)
    xyz = quads[..., :3] * scale[..., None].astype(np.float32)
    return np.maximum(xyz @ RGB_FROM_XYZ.T, 0).astype(np.float32)


def _scanline(data: bytes, at: int, row: Shaped[np.ndarray, "w 4"]) -> int:
    """Fill one row of a Radiance picture, plain or run-length encoded by component; returns the next row's offset.
    Raises IndexError or ValueError for truncated or invalid data."""
    width = len(row)
    if not (8 <= width < 32768 and data[at] == data[at + 1] == 2 and data[at + 2] < 128):
        row[:] = np.frombuffer(data, np.uint8, 4 * width, at).reshape(width, 4)
        if (row[:, :3] == 1).all(axis=1).any():
            raise ValueError("runs of the oldest kind")
        return at + 4 * width
    if (data[at + 2] << 8 | data[at + 3]) != width:
        raise ValueError("a row of another width")
    at += 4
    for component in range(4):
        filled = 0
        while filled < width:
            count = data[at]
            run = count > 128
            count -= 128 if run else 0
            if count == 0 or filled + count > width:
                raise ValueError("a run of a wrong length")
            row[filled : filled + count, component] = (
                data[at + 1] if run else np.frombuffer(data, np.uint8, count, at + 1)
            )
            filled, at = filled + count, at + (2 if run else 1 + count)
    return at
