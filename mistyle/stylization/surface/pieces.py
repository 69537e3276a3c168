"""Connected pieces that the synthesis copies from the painting, their labels and their extent.

Neighbours on the surface with neighbouring places in the painting belong to one piece. A large piece can reproduce
motifs of the painting: a face, a house, lettering. Coarse levels determine the pieces, finer levels only refine them.
"""

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from mistyle.stylization.surface.exemplar.exemplar import Exemplar
from mistyle.stylization.surface.field import NearestNeighbourField
from mistyle.stylization.surface.kernels import BESIDE
from mistyle.stylization.surface.samples import Level

SAME = 2.0  # largest offset in pixels from a neighbour's continued picture within one piece


def labels(level: Level, exemplar: Exemplar, field: NearestNeighbourField) -> Int[np.ndarray, " n"]:
    """The piece label of each sample."""
    page, x, y = field.page, field.x, field.y
    count, beside = len(page), np.array(BESIDE)
    neighbour, turned = level.neighbours[:, beside], level.turned[:, beside]
    goes_on = np.stack([x[neighbour], y[neighbour]], axis=-1) + level.offsets[:, beside]
    height, width = exemplar.shapes[page[neighbour]].astype(np.float32).transpose(2, 0, 1)
    goes_on = np.where(turned[..., None], np.stack([width - 1, height - 1], axis=-1) - goes_on, goes_on)
    same = np.where(turned, (page[neighbour] + 2) % 4, page[neighbour]) == page[:, None]
    jump = ((goes_on - np.stack([x, y], axis=-1)[:, None]) ** 2).sum(axis=-1)
    sample, slot = np.nonzero(same & (jump < SAME**2))
    joined = coo_matrix((np.ones(len(sample), bool), (sample, neighbour[sample, slot])), shape=(count, count))
    return connected_components(joined, directed=False)[1]


def reach(piece: Int[np.ndarray, " n"], at: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, " n"]:
    """Distance of each sample's place `at` from the centre of its piece, in the unit of `at`."""
    size = np.bincount(piece)
    middle = np.stack([np.bincount(piece, at[:, k]) / size for k in range(2)], axis=1)
    return np.linalg.norm(at - middle[piece], axis=1)


def on_picture(exemplar: Exemplar, pixel: Int[np.ndarray, " n"]) -> Float[np.ndarray, "n 2"]:
    """Positions (x, y) of exemplar pixels in the unturned picture, in shares of its long side."""
    height, width = exemplar.size
    origin = exemplar.origin[pixel]
    return np.stack([origin % width, origin // width], axis=1) / max(height, width)
