"""Place fields: smooth functions over the surface that follow its parts and assign colours without light.

Lightness follows height, chroma the lowest Laplacian eigenvectors, which change where the surface is narrow or creased
and are nearly constant on its parts: a leg or a lid has its own colour. Their components explained by light (surface
direction, openness) are removed. Symmetric shapes have symmetric fields: both horns of a head have one colour.
"""

import numpy as np
from jaxtyping import Float
from scipy.sparse import csr_matrix, diags, identity
from scipy.spatial import KDTree

from mistyle.stylization.surface.samples import Level, workers

FIELDS = 3  # one for lightness, two for the axes of chroma
MODES = 24  # candidate eigenvectors for the fields
FIRM = 0.45  # least share of a field that must remain without the light's component
CONCAVE = 8.0  # decay of two neighbours' weight per radian of a concave crease
SHIFT = 1e-5  # keeps the factorised matrix regular; far below the first eigenvalue
NEAR, ALIKE, SHARE = 2.0, 0.7, 0.9  # of a mirror image: spacings to a point, cosine of their normals, share of points
TURNED = 0.5  # height of the normal from which a point counts as facing up (or down)


def light(normals: Float[np.ndarray, "n 3"], openness: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n 8"]:
    """Regressors of distant light: a constant, the normal, facing up and down, openness and its square."""
    up = normals[:, 1:2]
    columns = [np.ones_like(up), normals, up > TURNED, up < -TURNED, openness[:, None], openness[:, None] ** 2]
    return np.concatenate(columns, axis=1).astype(np.float64)


def without(values: Float[np.ndarray, "n k"], explained: Float[np.ndarray, "n m"]) -> Float[np.ndarray, "n k"]:
    """The part of the values that is orthogonal to the columns (least squares)."""
    return values - explained @ np.linalg.lstsq(explained, values, rcond=1e-6)[0]


def laplacian_modes(level: Level, count: int) -> Float[np.ndarray, "n k"]:
    """The lowest eigenvectors of the surface's graph Laplacian, without the constant one; unit variance.

    Neighbours across a concave crease have small weights (Au et al. 2012, concavity-aware fields), so that the vectors
    step at the borders of parts. Returns fewer vectors for a level of few samples.
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
    # Disconnected pieces of the mesh get minimal weights, so that the lowest vectors are constant on each.
    bound = (bound + bound.T) / 2 + loose(positions)
    # Twins weigh as much as a point's neighbours together; with more, pairs in deep creases would be their own parts.
    inner = diags(np.sqrt(np.asarray(bound.sum(axis=1))[:, 0]))
    bound = bound + inner @ mirrored(level) @ inner
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
    """Small weights between points near in space, independent of the surface's side."""
    size, reach = len(positions), min(8, len(positions))
    index = KDTree(positions).query(positions, k=reach)[1].reshape(size, reach)
    rows = np.repeat(np.arange(size), reach)
    bonds = csr_matrix((np.full(rows.size, 1e-3), (rows, index.reshape(-1))), shape=(size, size))
    return (bonds + bonds.T) / 2


def mirrored(level: Level) -> csr_matrix:
    """Pairs of points that are mirror images, if the shape has an upright plane of symmetry; else none.

    The plane contains the centroid. Its normal is the x or z axis or a horizontal principal axis.
    """
    positions, normals = level.points.positions.astype(np.float64), level.points.normals.astype(np.float64)
    centred = positions - positions.mean(axis=0)
    axes = np.linalg.eigh(np.cov(centred[:, [0, 2]].T))[1].T
    planes = [np.array([x, 0.0, z]) for x, z in (*np.eye(2), *axes)]
    size, tree = len(positions), KDTree(centred)
    best, twin = SHARE, np.arange(size)
    for plane in planes:
        away, found = tree.query(centred - 2 * np.outer(centred @ plane, plane), workers=workers())
        turned = normals - 2 * np.outer(normals @ plane, plane)
        fits = (away < NEAR * level.points.spacing) & ((turned * normals[found]).sum(axis=1) > ALIKE)
        if fits.mean() > best:
            best, twin = fits.mean(), np.where(fits, found, np.arange(size))
    rows = np.flatnonzero(twin != np.arange(size))
    bonds = csr_matrix((np.full(len(rows), 0.5), (rows, twin[rows])), shape=(size, size))
    return bonds + bonds.T


def place_fields(level: Level, openness: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n 3"]:
    """Three smooth fields over the surface (mean 0, standard deviation 1), linearly independent of light.

    They are the lowest eigenvectors with a share of at least FIRM after removal of the light's component. If too few
    qualify, the others follow by remaining share. Height replaces the first unless light explains it (on a ball).
    """
    explained = light(level.points.normals, openness)
    rest = without(laplacian_modes(level, MODES), explained)
    left = rest.std(axis=0)
    order = np.concatenate([np.flatnonzero(left >= FIRM), np.argsort(-left, kind="stable")])
    chosen = list(dict.fromkeys(order.tolist()))[:FIELDS]
    fields = rest[:, chosen + chosen[-1:] * (FIELDS - len(chosen))]
    height = level.points.positions[:, 1:2].astype(np.float64)
    free = without(height, explained)
    if free.std() > max(FIRM * height.std(), 1e-6):
        fields[:, :1] = free
    return (fields / np.maximum(fields.std(axis=0), 1e-12)).astype(np.float32)
