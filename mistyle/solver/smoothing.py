"""Empirical-Bayes smoothing of the maps; its strength is estimated locally.

The error of a texel's own albedo, tilt and roughness is approximately known (`TexelEstimate.unconstrained`). Second
differences along a row have the surface's own variance plus that of these errors. Empirical Bayes subtracts the errors
and so estimates the surface's own variance around every texel. The maximum a posteriori values minimise

    sum (x - estimate)² / noise²  +  sum (x[k] - (x[k-1] + x[k+1]) / 2)² / variance  +  SHARE sum x² / spread²

over rows and columns of each island, for albedo and roughness also across seams (a Gaussian field of second
differences: Rue and Held, Gaussian Markov Random Fields, 2005, section 3.4). On a rough surface the variance is large,
and the estimate stays. The last sum is for tilts only. Without it, the slope of a few texels would continue through
poorly observed regions, beyond all observed tilts. `spread` is estimated around every texel too.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from mistyle.atlas.neighbours import Links, within
from mistyle.core.rows import distinct_integers
from mistyle.render.deferred.material_table import ALBEDO, METALLIC, ROUGHNESS, SOLVED, TILT_X, TILT_Y
from mistyle.solver.prior import METAL_SPREAD
from mistyle.solver.schedule import WHOLE
from mistyle.solver.table import OVER_SEAMS, Atlas, diffused, fill, with_seam_weights

# The smoothed channels of the table, and the least standard deviation of their second differences. Metallic is not
# smoothed: it is binary.
LEAST = {0: 0.008, 1: 0.008, 2: 0.008, TILT_X: 0.006, TILT_Y: 0.006, ROUGHNESS: 0.008}
TILTS = TILT_X, TILT_Y
MOST = 0.3  # largest of these standard deviations
ODD = 20  # prior odds of metallic near 0 or 1 against a value between them
OPEN = 0.3  # standard deviation of unobserved texels
SURE = 0.01  # standard deviation of a second difference that limits its weight
AROUND = 24  # diffusion steps of the local variance
KNOWN = 0.02  # standard deviation of a tilt that limits its weight in the local spread
ELSEWHERE = 0.1  # weight of the whole atlas in the local spread, in exactly known texels
SHARE = 0.3  # precision of a tilt relative to 1 / spread², since its neighbours are correlated
WIDER = 2.0  # factor of the variance across a seam: the linked texel lies beside the neighbour's true place
STEPS, CLOSE = 300, 1e-4  # most iterations of conjugate gradients, and their relative residual
# Texels of a band of rows, where a set has more than WHOLE, and the rows on either side that are solved with it, which
# are several correlation lengths of LEAST and OPEN.
BAND, HALO = 2**20, 64

Grid = Float[np.ndarray, "h w"]
Both = tuple[np.ndarray, np.ndarray]  # along rows, and along columns (transposed)


@dataclass(frozen=True)
class Field:
    """One channel in one texture set: its rows of the table, the estimate and its errors, the variance of its second
    differences, the weight of x², and the links between neighbours."""

    part: slice
    estimate: Grid
    error: Grid
    variance: Grid
    ridge: Grid
    among: Links


def map_smoothing(
    table: Float[np.ndarray, "a 8"],
    noise: Float[np.ndarray, "a 7"],
    atlas: Atlas,
    floor: float,
    metallic: bool,
) -> Float[np.ndarray, "a 8"]:
    """`table` with smoothed albedo, tilt and roughness (not below `floor`). With `metallic`, metallic moves towards 0
    or 1. Uncovered texels move as the nearest covered one.

    `noise`: standard deviations under the pictures alone, at least OPEN without observations. Edges are not detected: a
    crease in a smooth surround is rounded in proportion to its texels' uncertainty.
    """
    moved, atlas = np.zeros_like(table), with_seam_weights(atlas, table[:, SOLVED], noise)
    for c in LEAST:
        for one in _fields(table, noise, atlas, c):
            moved[one.part, c] = (_map_estimate(one) - one.estimate).ravel()
    result = table + fill(moved, atlas)
    if metallic:
        result = binarise_metallic(result, noise)
    result[:, ALBEDO] = np.clip(result[:, ALBEDO], 0, 1)
    result[:, ROUGHNESS] = np.clip(result[:, ROUGHNESS], floor, 1)
    return result


def prior_precision_matrix(
    table: Float[np.ndarray, "a 8"], noise: Float[np.ndarray, "a 7"], atlas: Atlas, channel: int
) -> Any:
    """The second and third sum above for one of LEAST's channels, as a sparse symmetric matrix P of the whole atlas, x'
    P x. Variances are those of `map_smoothing` on `table`. `atlas` comes from `with_seam_weights`."""
    from scipy.sparse import block_diag

    return block_diag([_field_prior(one) for one in _fields(table, noise, atlas, channel)], format="csr")


def _fields(table: np.ndarray, noise: np.ndarray, atlas: Atlas, channel: int) -> Iterator[Field]:
    """One channel as a field per texture set."""
    ridge = ridge_weight(table, noise, atlas, channel) if channel in TILTS else np.zeros(len(table), np.float32)
    for part, size, links in zip(atlas.parts, atlas.sizes, atlas.links, strict=True):
        estimate = table[part, channel].reshape(size)
        error = np.minimum(noise[part, channel].reshape(size), OPEN)
        among = links if OVER_SEAMS[channel] else within(links)
        error, variance = _estimate_variance(estimate, error, among, LEAST[channel])
        yield Field(part, estimate, error, variance, ridge[part].reshape(size), among)


def ridge_weight(table: np.ndarray, noise: np.ndarray, atlas: Atlas, channel: int) -> Float[np.ndarray, " a"]:
    """SHARE / spread² of every texel, from well-observed tilts around it. The whole atlas has a small weight and
    decides where no tilt around is known; 0 where none is known at all.

    Errors are not subtracted: most are overestimated, and the difference would regularise tilts too strongly.
    """
    x2, error = table[:, channel].astype(np.float64) ** 2, noise[:, channel].astype(np.float64)
    weight = np.where(error < OPEN, 1 / (error**2 + KNOWN**2) ** 2, 0)
    sums = np.stack([weight * x2, weight], axis=1)
    every = sums.sum(axis=0) / max(sums[:, 1].sum(), 1e-12) * (ELSEWHERE / KNOWN**4)
    for part, size, links in zip(atlas.parts, atlas.sizes, atlas.links, strict=True):
        sums[part] = diffused(sums[part].reshape(1, *size, 2), within(links), AROUND).reshape(-1, 2)
    spread2, weights = (sums + every).T
    return (SHARE * weights / np.maximum(spread2, weights * LEAST[channel] ** 2 + 1e-12)).astype(np.float32)


def binarise_metallic(table: Float[np.ndarray, "a 8"], noise: Float[np.ndarray, "a 7"]) -> Float[np.ndarray, "a 8"]:
    """`table` with metallic moved to the nearer of 0 and 1 in proportion to its uncertainty, since it is binary. Values
    far from both stay. Dielectrics keep their diffuse reflectance, albedo (1 - metallic)."""
    metallic, nearer = table[:, METALLIC], np.round(table[:, METALLIC])
    away = metallic - nearer
    likely = np.exp(-0.5 * (away / METAL_SPREAD) ** 2)
    error2 = np.minimum(noise[:, METALLIC], OPEN) ** 2
    open_ = error2 / (METAL_SPREAD**2 + error2) * likely / (likely + 1 / ODD)
    result = table.copy()
    result[:, METALLIC] = metallic - open_ * away
    result[:, ALBEDO] *= np.where(nearer == 0, (1 - metallic) / np.maximum(1 - result[:, METALLIC], 0.5), 1)[:, None]
    return result


def _inner_texels(among: Links) -> Both:
    """Texels with a neighbour in the grid on either side, along rows and along columns (transposed)."""
    return among.right[:, :-1] & among.right[:, 1:], (among.below[:-1] & among.below[1:]).T


def _estimate_variance(estimate: Grid, error: Grid, among: Links, least: float) -> tuple[Grid, Grid]:
    """Errors of the estimate, and the surface's own variance of second differences, both from a local window.

    Where values vary less than their errors predict, the errors are correlated (by the solver's prior). Errors then
    shrink to the observed variation, since smoothing cannot remove the correlated part.
    """
    total = np.zeros((3, *estimate.shape, 1), np.float32)
    for turned, link in enumerate(_inner_texels(among)):
        x, e = (estimate.T, error.T) if turned else (estimate, error)
        noise = 0.25 * (e[:, :-2] ** 2 + e[:, 2:] ** 2) + e[:, 1:-1] ** 2
        weight = np.where(link, 1 / (noise + SURE**2) ** 2, 0)
        sums = total[..., 0].transpose(0, 2, 1) if turned else total[..., 0]
        second = np.where(link, 0.5 * (x[:, :-2] + x[:, 2:]) - x[:, 1:-1], 0).astype(np.float32)
        for own, value in zip(sums, (second**2, noise, 1), strict=True):
            own[:, 1:-1] += weight * value
    varies, noise, weights = diffused(total, among, AROUND)[..., 0]
    own = np.clip((varies - noise) / np.maximum(weights, 1e-12), least**2, MOST**2)
    share = np.clip(varies / np.maximum(noise, 1e-12), 0, 1)
    return error * np.sqrt(share), own


def _grid_differences(variance: Grid, among: Links) -> tuple[np.ndarray, np.ndarray]:
    """Flat indices (both neighbours, the texel) of every texel with two neighbours in the grid, along rows and columns,
    and the precisions of their second differences."""
    number, own = np.arange(variance.size, dtype=np.int32).reshape(variance.shape), variance.ravel()
    lines, texels = _inner_texels(among), []
    for grid, link in zip((number, number.T), lines, strict=True):
        texels.append(np.stack([grid[:, :-2][link], grid[:, 2:][link], grid[:, 1:-1][link]], axis=1))
    every = np.concatenate(texels)
    return every, 1 / own[every[:, 2]]


def _seam_differences(variance: Grid, among: Links) -> tuple[np.ndarray, np.ndarray]:
    """Indices and precisions, as of `_grid_differences`, of texels with a seam on one or both sides."""
    width, rows, firm = variance.shape[1], [], []
    grids = np.pad(among.right, ((0, 0), (0, 1))).ravel(), np.pad(among.below, ((0, 1), (0, 0))).ravel()
    for grid, step, sides in zip(grids, (1, width), (among.seams[:2], among.seams[2:]), strict=True):
        at = distinct_integers(np.concatenate([seam.here for seam in sides]))
        before = np.maximum(at - step, 0)
        beside = np.stack([np.where(grid[at], at + step, -1), np.where(grid[before] & (at >= step), before, -1)])
        share = np.ones(beside.shape, np.float32)
        for k, seam in enumerate(sides):
            row = np.searchsorted(at, seam.here)
            beside[k, row], share[k, row] = seam.there, seam.share
        whole = (beside >= 0).all(axis=0)
        rows.append(np.stack([*beside[:, whole], at[whole]], axis=1))
        firm.append(share.prod(axis=0)[whole] / (WIDER * variance.ravel()[at[whole]]))
    return np.concatenate(rows).astype(np.int32), np.concatenate(firm)


def _difference_matrix(variance: Grid, among: Links, band: slice | None = None) -> Any:
    """Sparse matrix of second differences, each row divided by its standard deviation; those of all texels, or of the
    rows `band` of the grid."""
    from scipy.sparse import csr_array

    lines, first = slice(0, len(variance)) if band is None else band, 0
    inside = Links(among.right[lines], among.below[lines.start : lines.stop - 1], among.seams)
    texels, firm = _grid_differences(variance[lines], inside)
    across, loose = _seam_differences(variance, among)
    if band is not None:
        first = lines.start * variance.shape[1]
        here = (across[:, 2] >= first) & (across[:, 2] < lines.stop * variance.shape[1])
        texels, across, loose = texels + np.int32(first), across[here], loose[here]
    texels, firm = np.concatenate([texels, across]), np.concatenate([firm, loose])
    root = np.sqrt(firm).astype(np.float32)[:, None]
    values = (root * np.array([0.5, 0.5, -1], np.float32)).ravel()
    starts = np.arange(0, values.size + 1, 3, dtype=np.int32)
    return csr_array((values, texels.ravel(), starts), shape=(len(texels), variance.size))


def _field_prior(one: Field) -> Any:
    """The second and third sum of one set as a sparse matrix."""
    return _normal_matrix(_difference_matrix(one.variance, one.among), one.ridge.ravel())


def _normal_matrix(differences: Any, ridge: Float[np.ndarray, " n"]) -> Any:
    from scipy.sparse import dia_array

    return (differences.T @ differences + dia_array((ridge[None], 0), shape=(ridge.size, ridge.size))).tocsr()


def _map_estimate(one: Field) -> Float[np.ndarray, "h w"]:
    """The minimum of the sums: of a set of at most WHOLE texels at once, else band by band.

    A band is solved with HALO rows on either side. Texels beyond, at a seam's other end, keep their estimates.
    """
    x, (height, width) = one.estimate, one.estimate.shape
    if x.size <= WHOLE:
        return x + _change(_field_prior(one), one.error, x, None)
    result, rows = x.copy(), max(1, BAND // width)
    for top in range(0, height, rows):
        own, band = slice(top, min(top + rows, height)), slice(max(top - HALO, 0), min(top + rows + HALO, height))
        differences = _difference_matrix(one.variance, one.among, band)
        inside = differences[:, band.start * width : band.stop * width]
        beyond = inside.T @ (differences @ x.ravel() - inside @ x[band].ravel())
        change = _change(_normal_matrix(inside, one.ridge[band].ravel()), one.error[band], x[band], beyond)
        result[own] += change[own.start - band.start :][: own.stop - own.start]
    return result


def _change(
    prior: Any, error: Grid, estimate: Grid, beyond: Float[np.ndarray, " n"] | None
) -> Float[np.ndarray, "h w"]:
    """The change from the estimate, which has smaller rounding errors than the minimum itself; `beyond`: the gradient's
    part that texels outside the grid give."""
    from scipy.sparse import dia_array
    from scipy.sparse.linalg import cg

    sure = (1 / np.maximum(error, 1e-4) ** 2).astype(np.float32).ravel()
    matrix = prior + dia_array((sure[None], 0), shape=prior.shape)
    inverse = dia_array((1 / matrix.diagonal()[None], 0), shape=prior.shape)
    gradient = prior @ estimate.ravel()
    right = -gradient if beyond is None else -(gradient + beyond)
    change, _ = cg(matrix, right, rtol=CLOSE, maxiter=STEPS, M=inverse)
    return change.reshape(estimate.shape).astype(np.float32)
