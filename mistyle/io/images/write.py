"""Writer of pictures: PNG with 8 or 16 bits and multi-layer OpenEXR. Equal pixels give equal bytes."""

import io
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Float

from mistyle.io.store.atomic import atomic_write

# Rec. ITU-R BT.709 primaries and D65 as (x, y) of red, green, blue, white.
REC709_CHROMATICITIES = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290)
LINEAR_REC709 = "lin_rec709_scene"
DATA = "data"
ROWS = 2**20  # pixels encoded at a time


def encode_png(
    array: Float[np.ndarray, "h w *c"],
    bits: int = 8,
    encode: Callable[[np.ndarray], np.ndarray] = np.asarray,
) -> bytes:
    """The bytes of a PNG of shape (h w), (h w 3) or (h w 4), values 0..1 in the file's encoding.

    Only `encode`, applied to blocks of rows, may convert colours. Values are clipped and rounded to the nearest step;
    no time, colour space or other metadata is stored. Raises ValueError for another shape or NaN.
    """
    import cv2

    if bits not in (8, 16):
        raise ValueError(f"a PNG has 8 or 16 bits per channel, not {bits}")
    if not (array.ndim == 2 or (array.ndim == 3 and array.shape[2] in (3, 4))) or 0 in array.shape:
        raise ValueError(f"a PNG needs an array of shape (h w), (h w 3) or (h w 4), not {array.shape}")
    limit = 2**bits - 1
    pixels = np.empty(array.shape, np.uint8 if bits == 8 else np.uint16)
    step = max(1, ROWS // array.shape[1])
    for top in range(0, len(array), step):
        rows = encode(array[top : top + step])
        if not np.isfinite(rows).all():
            raise ValueError("a PNG cannot hold NaN or infinity; fill the holes before writing")
        if rows.ndim == 3:
            rows = rows[..., [2, 1, 0, 3][: rows.shape[2]]]  # OpenCV orders channels blue, green, red, alpha
        pixels[top : top + step] = np.rint(np.clip(rows, 0, 1) * np.float32(limit))
    done, data = cv2.imencode(".png", pixels, [cv2.IMWRITE_PNG_COMPRESSION, 6])
    if not done:
        raise ValueError(f"the PNG encoder refused an array of shape {array.shape}")
    return data.tobytes()


def write_png(path: Path, array: Float[np.ndarray, "h w *c"], bits: int = 8) -> None:
    """Write `encode_png(array, bits)` to a file, atomically."""
    atomic_write(path, encode_png(array, bits))


def write_exr(
    path: Path, channels: Mapping[str, np.ndarray], half: bool = False, attributes: Mapping[str, object] | None = None
) -> None:
    """Write arrays of one shape (h w) as the channels of an OpenEXR file (one part, ZIP), atomically.

    A dotted name is a channel of a layer ("normal.X"). The values are stored unchanged: linear, infinities and NaN
    included; `half` stores 16-bit floats (overflow to infinity beyond 65504), else 32-bit ones. A file with red,
    green and blue, in a layer or outside, is tagged as linear Rec.709 (`chromaticities` and `colorInteropID`
    "lin_rec709_scene"), any other as "data". `attributes` adds or replaces header entries; with colorInteropID "data"
    the chromaticities are omitted. Raises ValueError for arrays of other shapes.
    """
    import OpenEXR

    shapes = {np.shape(c) for c in channels.values()}
    if len(shapes) != 1 or len(shape := shapes.pop()) != 2 or 0 in shape:
        found = {name: np.shape(c) for name, c in channels.items()}
        raise ValueError(f"the channels of an EXR need one shape (h w); found {found}")
    layers = {name.rpartition(".")[0] for name in channels}
    is_colour = any(all((f"{x}." if x else "") + c in channels for c in "RGB") for x in layers)
    header = {"colorInteropID": LINEAR_REC709 if is_colour else DATA} | dict(attributes or {})
    if header["colorInteropID"] == LINEAR_REC709:
        header.setdefault("chromaticities", REC709_CHROMATICITIES)
    header |= {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    kind = np.float16 if half else np.float32
    with np.errstate(over="ignore"):
        pixels = {name: np.ascontiguousarray(channels[name], dtype=kind) for name in sorted(channels)}
    # Written to memory first: a full disk then raises OSError with errno, not the library's RuntimeError.
    buffer = io.BytesIO()
    with OpenEXR.File(header, pixels) as file:
        file.write(buffer)
    atomic_write(path, buffer.getvalue())
