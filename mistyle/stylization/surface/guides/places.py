"""Where on the surface a colour goes when no light decides: places that follow the parts of the shape.

The lowest vibrations of the surface change where it is narrow or creased and rest on its parts, so that an ear, a leg
or a lid takes a colour of its own. What a light could explain of them (the direction of the surface, openness) is taken
out, so that the albedo holds no shading.
"""

import numpy as np
from jaxtyping import Float
from scipy.sparse import csr_matrix, diags, identity

from mistyle.stylization.surface.samples import Level

FIELDS = 3  # one for lightness, two for the axes of chroma
MODES = 24  # vibrations among which the fields are chosen
FIRM = 0.45  # share of a vibration that must be left when the light is taken out of it
CONCAVE = 8.0  # how much a crease of one radian inwards loosens two neighbours
SHIFT = 1e-5  # keeps the factorised matrix regular; far below the first vibration
TURNED = 0.5  # height of the normal from which on a place counts as facing up (or down)


def light(normals: Float[np.ndarray, "n 3"], openness: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n 8"]:
    """What any light from afar could paint: a constant, the normal, facing up and down, openness and its square."""
    up = normals[:, 1:2]
    columns = [np.ones_like(up), normals, up > TURNED, up < -TURNED, openness[:, None], openness[:, None] ** 2]
    return np.concatenate(columns, axis=1).astype(np.float64)


def without(values: Float[np.ndarray, "n k"], explained: Float[np.ndarray, "n m"]) -> Float[np.ndarray, "n k"]:
    """The part of the values that is orthogonal to the columns (least squares)."""
    return values - explained @ np.linalg.lstsq(explained, values, rcond=1e-6)[0]


def vibrations(level: Level, count: int) -> Float[np.ndarray, "n k"]:
    """The lowest eigenvectors of the surface's graph Laplacian, without the constant one; unit variance.

    Neighbours across a concave crease are loosely bound (Au et al. 2012, concavity-aware fields), so that the vectors
    step at the borders of parts. Fewer come back where the level has few samples.
    """
    from scipy.sparse.linalg import eigsh

    size = len(level.directed)
    count = min(count, max(size // 8, 1))
    positions, normals = level.points.positions.astype(np.float64), level.points.normals.astype(np.float64)
    neighbour = level.neighbours
    away = positions[neighbour] - positions[:, None]
    length = np.maximum(np.linalg.norm(away, axis=2), 1e-12)
    bend = ((normals[neighbour] - normals[:, None]) * away).sum(axis=2) / length
    weight = np.exp(-CONCAVE * np.maximum(-bend, 0)) * (neighbour != np.arange(size)[:, None])
    rows = np.repeat(np.arange(size), neighbour.shape[1])
    bound = csr_matrix((weight.reshape(-1), (rows, neighbour.reshape(-1))), shape=(size, size))
    # Pieces of the mesh that do not touch are bound as loosely as can be, so that each vibrates as a whole first.
    bound = (bound + bound.T) / 2 + loose(positions)
    degree = np.asarray(bound.sum(axis=1))[:, 0]
    scale = diags(1 / np.sqrt(degree))
    laplacian = (identity(size) - scale @ bound @ scale).tocsc()
    start = np.cos(np.arange(size) * 0.7548776662)
    values, vectors = eigsh(laplacian, count + 1, sigma=-SHIFT, v0=start)
    chosen = vectors[:, np.argsort(values, kind="stable")[1:]] / np.sqrt(degree)[:, None]
    chosen -= chosen.mean(axis=0)
    chosen *= np.where(chosen[np.abs(chosen).argmax(axis=0), np.arange(chosen.shape[1])] < 0, -1, 1)
    return chosen / np.maximum(chosen.std(axis=0), 1e-12)


def loose(positions: Float[np.ndarray, "n 3"]) -> csr_matrix:
    """Weak bonds between points that are near in space, whatever side of the surface they are on."""
    from scipy.spatial import KDTree

    size, reach = len(positions), min(8, len(positions))
    index = KDTree(positions).query(positions, k=reach)[1].reshape(size, reach)
    rows = np.repeat(np.arange(size), reach)
    bonds = csr_matrix((np.full(rows.size, 1e-3), (rows, index.reshape(-1))), shape=(size, size))
    return (bonds + bonds.T) / 2


def place_fields(level: Level, openness: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n 3"]:
    """Three smooth fields over the surface (mean 0, standard deviation 1) of which no light explains anything linear.

    The first of the vibrations of which enough is left when the light is taken out, lowest first; where too few are,
    the others follow in the order of what is left of them.
    """
    modes = vibrations(level, MODES)
    rest = without(modes, light(level.points.normals, openness))
    left = rest.std(axis=0)
    order = np.concatenate([np.flatnonzero(left >= FIRM), np.argsort(-left, kind="stable")])
    chosen = list(dict.fromkeys(order.tolist()))[:FIELDS]
    fields = rest[:, chosen + chosen[-1:] * (FIELDS - len(chosen))]
    return (fields / np.maximum(fields.std(axis=0), 1e-12)).astype(np.float32)
