"""Priors of the per-texel solver, and the uncertainty that a texel's own observations leave."""

from typing import Any, Literal

import numpy as np
from jaxtyping import Float, Int

from mistyle.render.deferred.material_table import ALBEDO, METALLIC, ROUGHNESS, TILT
from mistyle.solver.table import OVER_SEAMS, Atlas, Values, neighbourhood
from mistyle.solver.texels.levenberg_marquardt import UNKNOWNS, Solution
from mistyle.solver.texels.observations import TexelObservations

PRIOR_SPREAD = (1.0, 1.0, 1.0, 0.6, 0.6, 0.8, 0.2)  # standard deviations from PRIOR_MEAN without observations
METAL_SPREAD = 0.1  # standard deviation of metallic about 0 or 1: few surfaces are in between
# F0 of metals and its standard deviation. Without a visible highlight, a smooth metal of high F0 looks like a rough one
# of low F0; this prior decides.
METAL_ALBEDO, METAL_ALBEDOS = 0.6, 0.2
METAL_COST = 8.0  # -2 log of the prior odds of a metal
# Cost of a black dielectric by what black gloss is taken for, the albedo from which it is zero, and the observations at
# which it is full. With 4, DamagedHelmet's metals become plastic.
BLACK_COST = {"metal": 10.0, "plastic": 4.0}
PALEST_BLACK, OFTEN = 0.02, 8
# Roughness range over which a highlight becomes visible, so that the texel cannot be a mirror instead.
GLOSSY, MATT = 0.3, 0.6
BLUR = 4  # diffusion steps, each over the four nearest texels, of a mean of neighbours
AMONG = 4 * np.pi * BLUR / 3  # effective number of texels in that mean
MISFIT = 0.1  # cost per observation above which a texel's weight in its neighbours' means falls
AROUND = 8  # diffusion steps of the local misfit
WIDE = 24  # diffusion steps of the local variance of tilts
KNOWN = 0.05  # standard deviation of a tilt that limits its weight in the global variance of tilts
LEAST = 0.002  # least standard deviation between a texel's tilt and the mean of its neighbours
LEAST_SEEN = 3  # observations from which a texel's own data weight is used
BEST_FIT = 0.02  # lower bound of the observations' variance, relative to `noise` and `relative`
MARGIN = 1.5  # factor of the estimates' variance: errors of observations are correlated
NOTHING = 1.0  # standard deviation of texels without observations


def penalty(values: Values, mean: Values, prior: Values) -> Float[np.ndarray, " t"]:
    """The prior's part of the cost, summed over the unknowns."""
    return ((values - mean) ** 2 * prior).sum(axis=1)


def log_prior_penalty(
    values: Values, seen: Int[np.ndarray, " t"], black_gloss: Literal["metal", "plastic"]
) -> Float[np.ndarray, " t"]:
    """Cost of a metal, and of a texel that is often observed as black but dielectric and too smooth for a visible
    highlight; `black_gloss` is what such a texel is more often."""
    black = np.maximum(1 - values[:, ALBEDO].max(axis=1) / PALEST_BLACK, 0) * np.minimum(seen / OFTEN, 1)
    black *= np.clip((MATT - values[:, ROUGHNESS]) / (MATT - GLOSSY), 0, 1)
    return np.where(values[:, METALLIC] > 0.5, METAL_COST, BLACK_COST[black_gloss] * black).astype(np.float32)


def prior_precision(
    solution: Solution, mean: Values, observed: TexelObservations, atlas: Atlas, neighbours: float
) -> Values:
    """Prior precision of each texel about `mean`, weights of (x - mean)²: the inverse of the surface's own variance.

    Tilts by empirical Bayes: the local variance of differences from the neighbours' means, less the observations' own
    variance, clipped to LEAST² .. `neighbours`². The other unknowns have `neighbours`²: albedo, roughness and metallic
    are interchangeable, and a texel tied to its neighbours' albedo becomes a metal.
    """
    open_, gain = unconstrained_tilts(solution, observed), likelihood(solution)[1][:, TILT]
    apart = (solution.values - mean)[:, TILT] / np.maximum(gain, 1e-3)
    weight = (1 / (open_**2 + neighbours**2) ** 2).astype(np.float32)
    weight[observed.seen == 0] = 0
    variance = neighbourhood((apart**2 - open_**2).astype(np.float32), weight, observed, atlas, WIDE, OVER_SEAMS[3:5])
    prior = np.full(mean.shape, 1 / neighbours**2, np.float32)
    prior[:, TILT] = 1 / np.clip(variance, min(LEAST, neighbours) ** 2, neighbours**2)
    return prior


def shrink_normals(
    solution: Solution, mean: Values, prior: Values, observed: TexelObservations, atlas: Atlas
) -> tuple[Values, Values]:
    """`mean` and `prior` with poorly observed normals shrunk towards a zero tilt.

    The global variance V of well-observed tilts is the prior there. A mean of precision P is multiplied by
    P / (P + 1 / V), and its remaining variance is 1 / (P + 1 / V). Where observations do not fit, tilts would absorb
    the model's errors, so their precision grows with the root of `misfit`. A larger exponent flattens strong relief; a
    smaller one lets indirect light through.
    """
    precision = np.where(observed.seen[:, None] > 0, 1 / unconstrained_tilts(solution, observed) ** 2, 0).astype(
        np.float32
    )
    precision = AMONG * neighbourhood(precision, np.ones_like(precision), observed, atlas, BLUR, OVER_SEAMS[3:5])
    left = 1 / (precision + 1 / tilt_variance(solution, observed))
    mean, prior = mean.copy(), prior.copy()
    mean[:, TILT] *= precision * left
    prior[:, TILT] = 1 / (1 / prior[:, TILT] + left)
    prior[:, TILT] *= np.sqrt(1 + misfit(solution, observed, atlas))[:, None]
    return mean, prior


def tilt_variance(solution: Solution, observed: TexelObservations) -> Float[np.ndarray, "2"]:
    """Global variance of tilts, from well-observed texels: the variance of the estimates less that of their errors."""
    open_ = unconstrained_tilts(solution, observed)
    weight = np.where(observed.seen[:, None] > 0, 1 / (open_**2 + KNOWN**2) ** 2, 0)
    mean = ((solution.values[:, TILT] ** 2 - open_**2) * weight).sum(axis=0) / np.maximum(weight.sum(axis=0), 1e-12)
    return np.clip(mean, LEAST**2, PRIOR_SPREAD[3] ** 2)


def unconstrained_tilts(solution: Solution, observed: TexelObservations) -> Float[np.ndarray, "t 2"]:
    """Standard deviations of a texel's tilt under its observations alone."""
    # Observations that fit badly are less certain than their number suggests.
    inflation = np.sqrt(1 + solution.cost / np.maximum(observed.seen, 1))[:, None]
    return likelihood(solution)[0][:, TILT] * inflation


def neighbour_weight(solution: Solution, observed: TexelObservations) -> Values:
    """A texel's weight in its neighbours' means: its precision, reduced where its observations fit badly."""
    sure = 1 / np.maximum(solution.spread, 1e-4) ** 2
    sure = np.minimum(sure, np.quantile(sure, 0.9, axis=0))
    misfits = solution.cost / np.maximum(observed.seen, 1) / MISFIT
    sure = (sure / (1 + misfits[:, None]) ** 2).astype(np.float32)
    sure[observed.seen == 0] = 1e-6
    return sure


def misfit(solution: Solution, observed: TexelObservations, atlas: Atlas) -> Float[np.ndarray, " t"]:
    """Cost per redundant observation, pooled over each texel's neighbourhood; 0 without redundant observations.

    An observation has three channels and a texel UNKNOWNS unknowns. A few observations can always be fitted, so only
    the neighbourhood shows how well the model holds.
    """
    spare = np.maximum(observed.seen - len(UNKNOWNS) / 3, 0)
    each = np.where(spare[:, None] > 0, np.stack([solution.cost, spare], axis=1), 0).astype(np.float32)
    cost, count = neighbourhood(each, np.ones_like(each), observed, atlas, AROUND).T
    return np.where(count > 1e-6, cost / np.maximum(count, 1e-6), 0).astype(np.float32)


def observation_std(solution: Solution, observed: TexelObservations, atlas: Atlas) -> Values:
    """Standard deviations of a texel's estimate, scaled by the local misfit. NOTHING without observations."""
    return unconstrained_std(solution, observed, MARGIN * misfit_scale(solution, observed, atlas))


def misfit_scale(solution: Solution, observed: TexelObservations, atlas: Atlas) -> Float[np.ndarray, " t"]:
    """Factor of the observations' variance, from a texel's own misfit and that around it. It falls below 1 where
    observations fit far better than `noise` and `relative` predict."""
    around = misfit(solution, observed, atlas)
    own = np.where(observed.seen >= OFTEN, solution.cost / np.maximum(observed.seen - len(UNKNOWNS) / 3, 1), 0)
    return np.maximum(np.maximum(around, own) / 3, BEST_FIT)


def data_weight(solution: Solution, observed: TexelObservations) -> Float[np.ndarray, " t"]:
    """The data's share in a texel's tilt against its neighbours', 0..1. Texels with fewer than LEAST_SEEN observations
    are left to the pictures, which show parts of them that the solver does not observe, in proportion to the tilts'
    variance."""
    variance = float(tilt_variance(solution, observed).mean())
    share = likelihood(solution)[1][:, TILT].mean(axis=1)
    return np.where(observed.seen >= LEAST_SEEN, share, variance / (variance + KNOWN**2)).astype(np.float32)


def likelihood(solution: Solution) -> tuple[Values, Values]:
    """Standard deviations under the observations alone, and the data's share against the prior: 1 is all data, 0 all
    prior. Unknowns are treated as independent."""
    alone = np.maximum(1 / np.maximum(solution.spread, 1e-6) ** 2 - solution.prior, 1e-6)
    return 1 / np.sqrt(alone), alone / (alone + solution.prior)


def unconstrained_std(
    solution: Solution, observed: TexelObservations, scale: float | Float[np.ndarray, " t"] = 1.0
) -> Values:
    """Standard deviations under the observations alone, with `scale` on their variance; NOTHING without
    observations."""
    std = np.minimum(likelihood(solution)[0] * np.sqrt(np.reshape(scale, (-1, 1))), NOTHING)
    std[observed.seen == 0] = NOTHING
    return std.astype(np.float32)


def combine_class_prior(
    mean: Values, prior: Values, metal: Float[np.ndarray, " t"]
) -> tuple[Values, Values, np.ndarray]:
    """The product of a prior and the class prior (metal or dielectric), and its constant."""
    mean, prior, left = metal_f0_prior(mean, prior, metal)
    mean[:, 6:], prior[:, 6:], constant = _product(mean[:, 6:], prior[:, 6:], metal[:, None], 1 / METAL_SPREAD**2)
    return mean, prior, left + constant


def metal_f0_prior(mean: Values, prior: Values, metal: Float[np.ndarray, " t"]) -> tuple[Values, Values, np.ndarray]:
    """The product of a prior and, for metals, the F0 prior, and its constant."""
    mean, prior = mean.copy(), prior.copy()
    mean[:, ALBEDO], prior[:, ALBEDO], constant = _product(
        mean[:, ALBEDO], prior[:, ALBEDO], METAL_ALBEDO, metal[:, None] / METAL_ALBEDOS**2
    )
    return mean, prior, constant


def _product(
    mean: Float[np.ndarray, "t c"], prior: Float[np.ndarray, "t c"], centre: Any, weight: Any
) -> tuple[Float[np.ndarray, "t c"], Float[np.ndarray, "t c"], Float[np.ndarray, " t"]]:
    """Mean, weight and constant of prior (x - mean)² + weight (x - centre)²."""
    both = prior + np.float32(weight)
    constant = ((mean - centre) ** 2 * prior * weight / both).sum(axis=1)
    return ((mean * prior + np.float32(centre) * weight) / both).astype(np.float32), both, constant.astype(np.float32)
