"""Priors of the per-texel solver, and the uncertainty that a texel's own observations leave."""

from typing import Any

import numpy as np
from jaxtyping import Float, Int

from mistyle.render.deferred.material_table import ALBEDO, METALLIC, ROUGHNESS, TILT
from mistyle.solver.table import OVER_SEAMS, Atlas, Values, neighbourhood
from mistyle.solver.texels.levenberg_marquardt import UNKNOWNS, Solution
from mistyle.solver.texels.observations import TexelObservations

PRIOR_SPREAD = (1.0, 1.0, 1.0, 0.6, 0.6, 0.8, 0.2)  # standard deviations from PRIOR_MEAN before anything was seen
METAL_SPREAD = 0.1  # of metallic about 0 or 1: surfaces are metal or not, and few are in between
# How much metals reflect, and its standard deviation. Where no highlight is seen, much of it on a smooth metal looks
# like little on a rough one, and this decides.
METAL_ALBEDO, METAL_ALBEDOS = 0.6, 0.2
METAL_COST = 10.0  # what being a metal costs: twice the logarithm of how much rarer metals are
# What having no colour at all costs what is no metal, from which albedo on it costs nothing, and after how many looks.
BLACK_COST, PALEST_BLACK, OFTEN = 20.0, 0.02, 8
# From which roughness on its gloss shows, so that it could not as well be a mirror, in part and fully.
GLOSSY, MATT = 0.3, 0.6
BLUR = 4  # steps of spreading, each to the four nearest texels, that make a mean of neighbours
AMONG = 4 * np.pi * BLUR / 3  # how many texels such a mean is one of
MISFIT = 0.1  # cost per observation above which a texel has less to say to its neighbours
AROUND = 8  # steps over which it is measured how badly observations fit
WIDE = 24  # steps over which it is measured how much the surface's tilt varies
KNOWN = 0.05  # what a texel may leave open of its tilt and still say how much tilts vary at all
LEAST = 0.002  # of the standard deviation between a texel's tilt and the mean of its neighbours
LEAST_SEEN = 3  # times that a texel was seen, for what was seen to decide anything
BEST_FIT = 0.02  # of what `noise` and `relative` say, as variance: observations are never thought better than that
MARGIN = 1.5  # on the variance of what observations tell, since they err together
NOTHING = 1.0  # standard deviation of texels without observations


def penalty(values: Values, mean: Values, prior: Values) -> Float[np.ndarray, " t"]:
    """What a prior adds to the cost."""
    return ((values - mean) ** 2 * prior).sum(axis=1)


def log_prior_penalty(values: Values, seen: Int[np.ndarray, " t"]) -> Float[np.ndarray, " t"]:
    """What being a metal costs, and what looking black often and yet being none costs, where no gloss shows either:
    paint is never that black."""
    black = np.maximum(1 - values[:, ALBEDO].max(axis=1) / PALEST_BLACK, 0) * np.minimum(seen / OFTEN, 1)
    black *= np.clip((MATT - values[:, ROUGHNESS]) / (MATT - GLOSSY), 0, 1)
    return np.where(values[:, METALLIC] > 0.5, METAL_COST, BLACK_COST * black).astype(np.float32)


def prior_precision(
    solution: Solution, mean: Values, observed: TexelObservations, atlas: Atlas, neighbours: float
) -> Values:
    """How firmly each texel is held to `mean`, as weights of (x - mean)²: one over the variance of the surface itself.

    Of the tilt by empirical Bayes: that variance is what the texels around differ by from their means, less what their
    own observations leave open, at most `neighbours`² and at least LEAST². Everything else has `neighbours`: albedo,
    roughness and metallic can stand for each other, and held to its neighbours' albedo a texel becomes a metal.
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
    """`mean` and `prior` with the tilt drawn towards none where little is known of the texels around.

    All that is known of a tilt there is how much tilts vary at all: the variance V among texels that are known. Of a
    mean of precision P the share P / (P + 1 / V) is kept, and 1 / (P + 1 / V) of variance is left open. Where
    observations do not fit, tilts would take up what the model lacks, and are held by the root of `misfit` more firmly:
    more costs strong relief, less lets light between surfaces through.
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
    """The variance of tilts over the whole surface, by texels that are known: that of what was found, less what was
    left open."""
    open_ = unconstrained_tilts(solution, observed)
    weight = np.where(observed.seen[:, None] > 0, 1 / (open_**2 + KNOWN**2) ** 2, 0)
    mean = ((solution.values[:, TILT] ** 2 - open_**2) * weight).sum(axis=0) / np.maximum(weight.sum(axis=0), 1e-12)
    return np.clip(mean, LEAST**2, PRIOR_SPREAD[3] ** 2)


def unconstrained_tilts(solution: Solution, observed: TexelObservations) -> Float[np.ndarray, "t 2"]:
    """Standard deviations of the tilt that a texel's observations leave open."""
    return likelihood(solution)[0][:, TILT] * inflation(solution, observed)


def inflation(solution: Solution, observed: TexelObservations) -> Float[np.ndarray, "t 1"]:
    """What standard deviations are multiplied by: observations that do not fit say less than their number promises."""
    return np.sqrt(1 + solution.cost / np.maximum(observed.seen, 1))[:, None]


def neighbour_weight(solution: Solution, observed: TexelObservations) -> Values:
    """What a texel counts in its neighbours' means: by its spread, and less where its observations do not fit."""
    sure = 1 / np.maximum(solution.spread, 1e-4) ** 2
    sure = np.minimum(sure, np.quantile(sure, 0.9, axis=0))
    misfits = solution.cost / np.maximum(observed.seen, 1) / MISFIT
    sure = (sure / (1 + misfits[:, None]) ** 2).astype(np.float32)
    sure[observed.seen == 0] = 1e-6
    return sure


def misfit(solution: Solution, observed: TexelObservations, atlas: Atlas) -> Float[np.ndarray, " t"]:
    """Cost per observation that is one too many, of the texels around each one together; 0 where there is none.

    An observation has three channels and a texel UNKNOWNS unknowns: one that few saw can explain whatever they saw, so
    only those around it tell how far its model can be believed.
    """
    spare = np.maximum(observed.seen - len(UNKNOWNS) / 3, 0)
    each = np.where(spare[:, None] > 0, np.stack([solution.cost, spare], axis=1), 0).astype(np.float32)
    cost, count = neighbourhood(each, np.ones_like(each), observed, atlas, AROUND).T
    return np.where(count > 1e-6, cost / np.maximum(count, 1e-6), 0).astype(np.float32)


def observation_std(solution: Solution, observed: TexelObservations, atlas: Atlas) -> Values:
    """Standard deviations of what a texel's observations tell, by how well they and those of the texels around it fit:
    where they fit far better than `noise` and `relative` say, they also tell more; NOTHING where there are none."""
    around = misfit(solution, observed, atlas)
    own = np.where(observed.seen >= OFTEN, solution.cost / np.maximum(observed.seen - len(UNKNOWNS) / 3, 1), 0)
    scale = MARGIN * np.maximum(np.maximum(around, own) / 3, BEST_FIT)
    return unconstrained_std(solution, observed, scale)


def data_weight(solution: Solution, observed: TexelObservations) -> Float[np.ndarray, " t"]:
    """The share of a texel's tilt that its own pictures decide and not its neighbours, 0..1. Texels that too few saw
    whole are left to the pictures, which show parts of them that the solver knows nothing of, as far as tilts vary."""
    variance = float(tilt_variance(solution, observed).mean())
    share = likelihood(solution)[1][:, TILT].mean(axis=1)
    return np.where(observed.seen >= LEAST_SEEN, share, variance / (variance + KNOWN**2)).astype(np.float32)


def likelihood(solution: Solution) -> tuple[Values, Values]:
    """What the observations alone leave open (standard deviations), and the share of a texel's distance from its prior
    that they decide: 1 all of it, 0 none. Unknown by unknown, as if they did not depend on each other."""
    alone = np.maximum(1 / np.maximum(solution.spread, 1e-6) ** 2 - solution.prior, 1e-6)
    return 1 / np.sqrt(alone), alone / (alone + solution.prior)


def unconstrained_std(
    solution: Solution, observed: TexelObservations, scale: float | Float[np.ndarray, " t"] = 1.0
) -> Values:
    """Standard deviations of what the texels' observations tell, `scale` on their variance; NOTHING without any."""
    std = np.minimum(likelihood(solution)[0] * np.sqrt(np.reshape(scale, (-1, 1))), NOTHING)
    std[observed.seen == 0] = NOTHING
    return std.astype(np.float32)


def combine_class_prior(
    mean: Values, prior: Values, metal: Float[np.ndarray, " t"]
) -> tuple[Values, Values, np.ndarray]:
    """A prior and the belief that a texel is a metal or not as one prior, and the constant that this leaves."""
    mean, prior, left = metal_f0_prior(mean, prior, metal)
    mean[:, 6:], prior[:, 6:], constant = _product(mean[:, 6:], prior[:, 6:], metal[:, None], 1 / METAL_SPREAD**2)
    return mean, prior, left + constant


def metal_f0_prior(mean: Values, prior: Values, metal: Float[np.ndarray, " t"]) -> tuple[Values, Values, np.ndarray]:
    """The same of a prior and of how much metals reflect, where a texel is one."""
    mean, prior = mean.copy(), prior.copy()
    mean[:, ALBEDO], prior[:, ALBEDO], constant = _product(
        mean[:, ALBEDO], prior[:, ALBEDO], METAL_ALBEDO, metal[:, None] / METAL_ALBEDOS**2
    )
    return mean, prior, constant


def _product(
    mean: Float[np.ndarray, "t c"], prior: Float[np.ndarray, "t c"], other: Any, weight: Any
) -> tuple[Float[np.ndarray, "t c"], Float[np.ndarray, "t c"], Float[np.ndarray, " t"]]:
    """Mean, weight and constant of prior (x - mean)² + weight (x - other)²."""
    both = prior + np.float32(weight)
    constant = ((mean - other) ** 2 * prior * weight / both).sum(axis=1)
    return ((mean * prior + np.float32(other) * weight) / both).astype(np.float32), both, constant.astype(np.float32)
