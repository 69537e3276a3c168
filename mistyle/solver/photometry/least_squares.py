"""Robust linear least squares with one nuisance value per surface point.

Observation o of point p is y_o = l_p + A_o x + noise. The points are eliminated (Schur complement), the noise is
weighted by Huber's function of its scale, which is re-estimated from the median residual.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy import sparse

from mistyle.core.rows import weighted_median

STEPS = 8  # reweighted solves
HUBER = 1.5  # residuals beyond this many scales count linearly
RIDGE = 1e-6  # relative to the mean diagonal; it decides directions that no observation measures


@dataclass(frozen=True)
class LinearFit:
    """The unknowns x and their covariance, a point's value each, every observation's residual, and the residuals' scale
    (1.4826 median |residual|)."""

    x: Float[np.ndarray, " m"]
    covariance: Float[np.ndarray, "m m"]
    point: Float[np.ndarray, " p"]
    residual: Float[np.ndarray, " o"]
    scale: float


def one_hot(row: Int[np.ndarray, " o"], count: int) -> sparse.csr_array:
    """The o x count matrix that selects column row[o] in row o."""
    ones, each = np.ones(len(row)), np.arange(len(row) + 1)
    return sparse.csr_array((ones, row.astype(np.int64), each), shape=(len(row), count))


def solve(
    columns: sparse.csr_array,
    y: Float[np.ndarray, " o"],
    weight: Float[np.ndarray, " o"],
    point: Int[np.ndarray, " o"],
    cluster: Int[np.ndarray, " o"],
    ridge: Float[np.ndarray, " m"],
) -> LinearFit:
    """The robust solution. `point` counts from 0. `ridge` is a further precision of each unknown around 0, relative to
    the mean diagonal of the normal matrix.

    The covariance is the sandwich estimate with `cluster`s as independent samples: neighbouring points of a surface err
    alike, since they share their highlights.
    """
    selects, groups = one_hot(point, int(point.max()) + 1), one_hot(cluster, int(cluster.max()) + 1)
    robust = weight.astype(float)
    for _ in range(STEPS):
        weighted = sparse.diags_array(robust) @ columns
        total = selects.T @ robust
        inverse = 1 / np.maximum(total, 1e-12)
        cross = (selects.T @ weighted).tocsr()
        normal = (columns.T @ weighted).toarray() - (cross.T @ sparse.diags_array(inverse) @ cross).toarray()
        sums = selects.T @ (robust * y)
        rhs = weighted.T @ y - cross.T @ (inverse * sums)
        level = max(float(np.trace(normal)) / len(normal), 1e-30)
        normal += np.diag(level * (RIDGE + ridge))
        x = np.linalg.solve(normal, rhs)
        value = inverse * (sums - cross @ x)
        residual = y - value[point] - columns @ x
        scale = 1.4826 * max(weighted_median(np.abs(residual), weight), 1e-9)
        robust = weight * np.minimum(1, HUBER * scale / np.maximum(np.abs(residual), 1e-12))
    # A point's weighted residuals sum to 0, so its own value drops out of the sum over a cluster.
    slopes = (groups.T @ (sparse.diags_array(robust * residual) @ columns)).toarray()
    inverse_normal = np.linalg.inv(normal)
    return LinearFit(x, inverse_normal @ (slopes.T @ slopes) @ inverse_normal, value, residual, scale)
