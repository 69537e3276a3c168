"""TIFFs of floating-point numbers: linear values, as an OpenEXR file has them."""

import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from mistyle.io.sandbox.bounds import MAX_PIXELS, read_bytes, refuse

MAX_BYTES = 1 << 30
# Tags of TIFF 6.0, and values of them.
WIDTH, HEIGHT, BITS, ORIENTATION, PLANES, EXTRA_SAMPLES, SAMPLE_FORMAT = 256, 257, 258, 274, 284, 338, 339
FLOATS, PREMULTIPLIED = 3, (1,)
CONVERT = "Convert it to OpenEXR (oiiotool IN.tif -o OUT.exr)"


def tags_of_tiff(data: bytes) -> Mapping[int, Any]:
    """The tags of a TIFF's first page; empty for every other file and where they cannot be read."""
    from PIL.TiffImagePlugin import ImageFileDirectory_v2

    if data[:4] not in (b"II*\0", b"MM\0*"):
        return {}
    file = io.BytesIO(data)
    try:
        tags = ImageFileDirectory_v2(file.read(8))
        file.seek(tags.next)
        tags.load(file)
        return dict(tags)
    except (OSError, ValueError, SyntaxError, KeyError, TypeError, OverflowError):
        return {}


def holds_floats(tags: Mapping[int, Any]) -> bool:
    """Whether the samples of a TIFF are floating-point numbers."""
    kinds = tags.get(SAMPLE_FORMAT, 1)
    return FLOATS in (kinds if isinstance(kinds, tuple) else (kinds,))


def read_float_tiff(path: Path) -> Float[np.ndarray, "h w c"] | None:
    """The linear values of a TIFF of floating-point numbers, float32, three channels or four with alpha, premultiplied.

    None for every other TIFF. InputRefused for 16-bit floats, planes, turned pictures and other numbers of channels.
    """
    import cv2

    data = read_bytes(path, MAX_BYTES)
    tags = tags_of_tiff(data)
    if not holds_floats(tags):
        return None
    found = "a TIFF of floating-point numbers"
    expected = "upright pixels of 32 bits side by side, grey, RGB or RGB with alpha"
    bits, turned, planes = tags.get(BITS, 1), tags.get(ORIENTATION, 1) != 1, tags.get(PLANES, 1) != 1
    if turned or planes or max(bits if isinstance(bits, tuple) else (bits,)) != 32:
        what = "turned" if turned else "in separate planes" if planes else f"of {bits} bits"
        raise refuse(path, f"{found}, {what}", expected, CONVERT)
    if not 0 < int(tags.get(WIDTH, 0)) * int(tags.get(HEIGHT, 0)) <= MAX_PIXELS:
        raise refuse(path, "too many pixels", f"1 to {MAX_PIXELS / 1e6:.0f} million", "Scale the picture down")
    try:
        pixels = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:
        pixels = None
    if pixels is None or pixels.dtype != np.float32 or pixels.shape[2:] not in ((), (3,), (4,)):
        raise refuse(path, f"{found} that cannot be decoded", expected, CONVERT)
    if pixels.ndim == 2:
        return np.repeat(pixels[..., None], 3, axis=2)
    values = np.ascontiguousarray(pixels[..., [2, 1, 0, 3][: pixels.shape[2]]])
    if values.shape[2] == 4 and tags.get(EXTRA_SAMPLES) != PREMULTIPLIED:
        values[..., :3] *= values[..., 3:]
    return values
