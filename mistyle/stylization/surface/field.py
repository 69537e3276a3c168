"""Nearest-neighbour field: the exemplar place of each sample of a level."""

from dataclasses import dataclass
from types import ModuleType
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float, Int

from mistyle.stylization.surface import kernels
from mistyle.stylization.surface.exemplar.exemplar import Exemplar

LEAST_TARGET = 0.1  # target use of a pixel at least


@dataclass(frozen=True)
class NearestNeighbourField:
    """A place in the exemplar for each sample; x, y in pixels of that page (index coordinates)."""

    page: Int[np.ndarray, " n"]
    x: Float[np.ndarray, " n"]
    y: Float[np.ndarray, " n"]


def within(exemplar: Exemplar, page: np.ndarray, x: np.ndarray, y: np.ndarray) -> NearestNeighbourField:
    """Places clamped so that the whole patch lies on the page."""
    height, width = exemplar.shapes[page].T
    border = kernels.BORDER
    return NearestNeighbourField(
        page.astype(np.int32),
        np.clip(x, border, width - 1 - border).astype(np.float32),
        np.clip(y, border, height - 1 - border).astype(np.float32),
    )


def from_pixels(exemplar: Exemplar, pixel: Int[np.ndarray, " n"]) -> NearestNeighbourField:
    """Flat pixel indices as places."""
    page = np.searchsorted(exemplar.starts, pixel, side="right") - 1
    rest, width = pixel - exemplar.starts[page], exemplar.shapes[page, 1]
    row, column = (rest // width).astype(np.float32), (rest % width).astype(np.float32)
    return NearestNeighbourField(page.astype(np.int32), column, row)


def pixels(exemplar: Exemplar, field: NearestNeighbourField) -> Int[np.ndarray, " n"]:
    """The flat index of each place's pixel; the inverse of `from_pixels`."""
    row = np.rint(field.y).astype(np.int64)
    return exemplar.starts[field.page] + row * exemplar.shapes[field.page, 1] + np.rint(field.x).astype(np.int64)


def usage(exemplar: Exemplar, field: NearestNeighbourField) -> Float[np.ndarray, " k"]:
    """Use of each pixel of the unturned picture over its 5x5 neighbourhood, relative to its target use.

    A surface smaller than the picture (wide strokes) shows only a part of it, so a single use is not above the target.
    """
    height, width = exemplar.size
    count = np.bincount(exemplar.origin[pixels(exemplar, field)], minlength=height * width).reshape(height, width)
    mean = max(len(field.page) / (height * width), 1.0)
    around = cv2.blur(count.astype(np.float32), (5, 5), borderType=cv2.BORDER_CONSTANT) / np.float32(mean)
    return around.reshape(-1) / np.maximum(exemplar.target_use, LEAST_TARGET)


def on_device(dj: ModuleType, field: NearestNeighbourField) -> kernels.FieldArrays:
    """The field as arrays of Dr.Jit."""
    return kernels.FieldArrays(kernels.whole(dj, field.page), kernels.floats(dj, field.x), kernels.floats(dj, field.y))


def on_host(field: kernels.FieldArrays) -> NearestNeighbourField:
    """The field as arrays of NumPy."""
    return NearestNeighbourField(field.page.numpy().astype(np.int32), field.x.numpy(), field.y.numpy())


def exemplar_arrays(
    dj: ModuleType, exemplar: Exemplar, colour: Any, descriptor: Float[np.ndarray, "m 24"]
) -> kernels.ExemplarArrays:
    """The exemplar as arrays of Dr.Jit, with its colours (already on the device) and its pixels' descriptors."""
    return kernels.ExemplarArrays(
        height=kernels.floats(dj, exemplar.shapes[:, 0]),
        width=kernels.floats(dj, exemplar.shapes[:, 1]),
        start=kernels.whole(dj, exemplar.starts),
        colour=colour,
        descriptor=kernels.floats(dj, descriptor),
        origin=kernels.whole(dj, exemplar.origin),
    )
