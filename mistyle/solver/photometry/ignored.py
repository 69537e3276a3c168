"""Regions of pictures that the mesh does not explain: people, trees and wrong geometry in front of it.

A point's radiance, corrected for exposure, is compared with its value in the other pictures. A cell of a picture is
ignored where most of its points differ by far. Highlights are too small, or on mirrors everywhere, to fill such cells
alone: the limit grows with the robust difference of all points.
"""

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.ndimage import binary_dilation

CELLS = 42  # along the longer side of a picture
FAR, SCALES = 0.5, 4.0  # least log difference of a point that differs, absolute and in robust scales
MOST, LEAST = 0.6, 3  # share of a cell's points that differ, and the least number of points


def ignored_cells(
    residual: Float[np.ndarray, "o 3"],
    scale: float,
    picture: Int[np.ndarray, " o"],
    share: Float[np.ndarray, "o 2"],
    shapes: tuple[tuple[int, int], ...],
) -> tuple[Bool[np.ndarray, "_ _"], ...]:
    """The ignored cells of each picture, and their neighbours.

    residual  log difference of each observation from its point's value, of robust `scale`
    share     its position in the picture, 0..1 along x and y
    shapes    height and width of the pictures
    """
    differs = np.abs(residual).max(axis=1) > max(FAR, SCALES * scale)
    result = []
    for k, (height, width) in enumerate(shapes):
        rows = max(1, round(CELLS * height / max(height, width)))
        columns = max(1, round(CELLS * width / max(height, width)))
        own = picture == k
        x, y = np.clip(share[own], 0, 1 - 1e-9).T
        cell = (y * rows).astype(int) * columns + (x * columns).astype(int)
        count = np.bincount(cell, minlength=rows * columns)
        far = np.bincount(cell, differs[own], minlength=rows * columns)
        bad = ((count >= LEAST) & (far > MOST * count)).reshape(rows, columns)
        result.append(binary_dilation(bad))
    return tuple(result)
