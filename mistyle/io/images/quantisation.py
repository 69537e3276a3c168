"""Conversion of integer pixels to the float values of materials. The reader process sends integers, a quarter of the
bytes, and the job's own process converts them."""

from typing import Literal

import numpy as np
from jaxtyping import Float, Shaped

from mistyle.core.image import linear_from_srgb

Kind = Literal["colour", "normal", "data"]


def fractions(pixels: Shaped[np.ndarray, "*shape"]) -> Float[np.ndarray, "*shape"]:
    """8- or 16-bit integers as float32 0..1; floats stay."""
    if pixels.dtype.kind == "f":
        return pixels
    return np.divide(pixels, np.float32(np.iinfo(pixels.dtype).max), dtype=np.float32)


def finished(
    pixels: Shaped[np.ndarray, "h w *c"], kind: Kind, scale: float, longest: int
) -> Float[np.ndarray, "h2 w2 *c"]:
    """A texture as `Material` has it: linear colour, unit normals (x and y times `scale`) or plain data, halved until
    no side exceeds `longest`."""
    values = linear_rows(pixels) if kind == "colour" else fractions(pixels)
    if kind == "normal":
        values = values * 2 - 1
    while max(values.shape[:2]) > longest:
        values = _halved(values)
    return _unit(values, scale) if kind == "normal" else values


def linear_rows(encoded: Shaped[np.ndarray, "h w *c"]) -> Float[np.ndarray, "h w *c"]:
    """sRGB to linear: integers through a table, floats by blocks of rows, to bound the temporary memory."""
    if encoded.dtype.kind == "u":
        import cv2

        table = linear_from_srgb(fractions(np.arange(np.iinfo(encoded.dtype).max + 1, dtype=encoded.dtype)))
        return cv2.LUT(encoded, table).reshape(encoded.shape) if encoded.dtype == np.uint8 else table[encoded]
    result = np.empty(encoded.shape, np.float32)
    for start in range(0, len(encoded), 256):
        result[start : start + 256] = linear_from_srgb(fractions(encoded[start : start + 256]))
    return result


def _halved(values: Float[np.ndarray, "h w *c"]) -> Float[np.ndarray, "h2 w2 *c"]:
    """Means of 2 x 2 texels; an odd last row or column is repeated."""
    h, w = values.shape[:2]
    padded = np.pad(values, ((0, h % 2), (0, w % 2), *[(0, 0)] * (values.ndim - 2)), mode="edge")
    return (padded[::2, ::2] + padded[1::2, ::2] + padded[::2, 1::2] + padded[1::2, 1::2]) / 4


def _unit(normal: Float[np.ndarray, "h w 3"], scale: float) -> Float[np.ndarray, "h w 3"]:
    """Unit normals that point outwards; texels without a direction become (0, 0, 1)."""
    scaled = normal * np.array([scale, scale, 1], np.float32)
    scaled[..., 2] = np.maximum(scaled[..., 2], 1e-3)
    return (scaled / np.linalg.norm(scaled, axis=2, keepdims=True)).astype(np.float32)
