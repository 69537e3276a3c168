"""Rounds of the per-texel solver: neighbours help those that saw little, and the pictures correct what they model not.

The solver takes a texel's radiance for that of the picture at one place, but a pixel is a mean over its area of
interpolated texels. So after each solve the pictures are rendered as they are really made (`render/shade.py`), and
what they still differ by is added to what the texels should reach (defect correction): at the end the pictures agree.
Where a texel's radiance is far from that of the picture drawn there, as where highlights are narrower than pixels and
normals still vary, what is added is far off too, and the observation counts for less.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from mistyle.core.image import nearest
from mistyle.core.maps import Texels
from mistyle.core.mesh import Mesh
from mistyle.render.texel_lm import UNKNOWNS, Problem, Solution
from mistyle.stages.neighbours import Links, believed, links
from mistyle.stages.recover_observe import Gathered, fetch, less_sure
from mistyle.stages.recover_settings import RecoverSettings

# Where a texel is thought to be before anything was seen, and how far from there (standard deviations).
PRIOR_MEAN = (0.5, 0.5, 0.5, 0.0, 0.0, 0.5, 0.0)
PRIOR_SPREAD = (1.0, 1.0, 1.0, 0.6, 0.6, 0.8, 0.2)
METAL_SPREAD = 0.1  # of metallic about 0 or 1: surfaces are metal or not, and few are in between
# How much metals reflect, and its standard deviation. Where no highlight is seen, much of it on a smooth metal looks
# like little on a rough one, and this decides.
METAL_ALBEDO, METAL_ALBEDOS = 0.6, 0.2
# What having no colour at all costs what is no metal, from which albedo on it costs nothing, and after how many looks.
BLACK_COST, PALEST_BLACK, OFTEN = 20.0, 0.02, 8
# From which roughness on its gloss shows, so that it could not as well be a mirror, in part and fully.
GLOSSY, MATT = 0.3, 0.6
METAL_COST = 10.0  # what being a metal costs: twice the logarithm of how much rarer metals are
STARTS = (0.08, 0.25, 0.7)  # roughness has local minima
UNLIKE = 0.3  # of what a texel and the picture drawn there differ by: what it adds to an observation's deviation
RESTARTS = 3  # rounds in which texels also try what their neighbours found
MISFIT = 0.1  # cost per observation above which a texel has less to say to its neighbours
BLUR = 4  # steps of spreading, each to the four nearest texels
AMONG = 4 * np.pi * BLUR / 3  # how many texels such a mean is one of
WIDE = 24  # steps over which it is measured how much the surface's tilt varies
LEAST_SEEN = 3  # times that a texel was seen, for what was seen to decide anything
AROUND = 8  # steps over which it is measured how badly observations fit
KNOWN = 0.05  # what a texel may leave open of its tilt and still say how much tilts vary at all
BEST_FIT = 0.02  # of what `noise` and `relative` say, as variance: observations are never thought better than that
MARGIN = 1.5  # on the variance of what observations tell, since they err together
NOTHING = 1.0  # standard deviation of what nothing was told about
LEAST = 0.002  # of the standard deviation between a texel's tilt and the mean of its neighbours

# Which of the unknowns go on across seams. Tilts would have to be turned into the other chart's frame, and where charts
# meet at an edge, normal maps often bevel it: neighbours from beyond would level that.
OVER_SEAMS = np.array([1, 1, 1, 0, 0, 1, 1], np.float32)

Table = Float[np.ndarray, "a 8"]
Values = Float[np.ndarray, "t 7"]


@dataclass(frozen=True)
class Atlas:
    """All texels of all sets in one row after the other: which are covered, which covered one is closest to each, and
    per set which are neighbours, where that was asked for."""

    sizes: tuple[tuple[int, int], ...]
    covered: tuple[np.ndarray, ...]
    closest: tuple[np.ndarray, ...]
    links: tuple[Links, ...] = ()

    @property
    def offsets(self) -> list[int]:
        """Where each set begins, and the end."""
        return [0, *np.cumsum([rows * columns for rows, columns in self.sizes]).tolist()]


def atlas(texels: Sequence[Texels]) -> Atlas:
    """The atlas of some texture sets."""
    covered = tuple(t.covered for t in texels)
    return Atlas(
        sizes=tuple((t.covered.shape[0], t.covered.shape[1]) for t in texels),
        covered=covered,
        closest=tuple(nearest(c)[0].ravel() if c.any() else np.arange(c.size) for c in covered),
    )


def linked(mesh: Mesh, texels: Sequence[Texels]) -> Atlas:
    """The same with neighbours."""
    return replace(atlas(texels), links=tuple(links(mesh, t) for t in texels))


def spread_out(values: Values, gathered: Gathered, where: Atlas) -> Table:
    """The table of an atlas: covered texels have their values, the others those of the nearest covered one."""
    table = np.zeros((where.offsets[-1], 8), np.float32)
    table[:, :7] = PRIOR_MEAN
    table[gathered.texel, :7] = values
    return fill(table, where)


def placed(values: np.ndarray, gathered: Gathered, where: Atlas, otherwise) -> np.ndarray:
    """The covered texels' values in an array of the whole atlas, which has `otherwise` elsewhere."""
    result = np.zeros((where.offsets[-1], *values.shape[1:]), values.dtype)
    result[...] = otherwise
    result[gathered.texel] = values
    return result


def fill(table: Float[np.ndarray, "a c"], where: Atlas, only: np.ndarray | None = None) -> Float[np.ndarray, "a c"]:
    """Uncovered texels (of `only`, where given) take the values of the nearest covered one of their set."""
    result = table.copy()
    for k, closest in enumerate(where.closest):
        low, high = where.offsets[k], where.offsets[k + 1]
        empty = ~where.covered[k].ravel()
        if only is not None:
            empty &= only[low:high]
        result[low:high][empty] = table[low:high][closest[empty]]
    return result


def neighbourhood(
    values: Float[np.ndarray, "t c"],
    weight: Float[np.ndarray, "t c"],
    gathered: Gathered,
    where: Atlas,
    steps: int,
    over: Float[np.ndarray, " c"] | float = 1.0,
) -> Float[np.ndarray, "t c"]:
    """Weighted mean over the neighbours and theirs; `over`: how much those beyond seams count, 0..1 (of each column).
    Where none has a weight, the texel's own value."""
    channels = values.shape[1]
    full = np.zeros((2, where.offsets[-1], channels), np.float32)
    full[0, gathered.texel], full[1, gathered.texel] = values * weight, weight
    for k, size in enumerate(where.sizes):
        part = full[:, where.offsets[k] : where.offsets[k + 1]].reshape(2, *size, channels)
        part[...] = diffused(part, where.links[k], steps, over)
    summed, weights = full[:, gathered.texel]
    return np.where(weights > 1e-12, summed / np.maximum(weights, 1e-12), values).astype(np.float32)


def diffused(
    part: Float[np.ndarray, "n h w c"], among: Links, steps: int, over: Float[np.ndarray, " c"] | float = 1.0
) -> Float[np.ndarray, "n h w c"]:
    """Sums that every texel shares with the four around it, step by step. What would go to others is lost, so sums mean
    something only beside sums of weights."""
    right, below = among.right[..., None], among.below[..., None]
    seams = among.seams if np.any(over) else ()
    for _ in range(steps):
        total = 2 * part
        total[:, :, :-1] += part[:, :, 1:] * right
        total[:, :, 1:] += part[:, :, :-1] * right
        total[:, :-1] += part[:, 1:] * below
        total[:, 1:] += part[:, :-1] * below
        flat, sums = (grid.reshape(len(part), -1, part.shape[-1]) for grid in (part, total))
        for seam in seams:
            sums[:, seam.here] += flat[:, seam.there] * (seam.share[:, None] * over)
        part = total * np.float32(0.2)
    return part


def first_solve(
    problem: Problem,
    start: Values,
    mean: Values,
    seen: Int[np.ndarray, " t"],
    settings: RecoverSettings,
    progress: Callable[[float], None],
) -> Solution:
    """The best of several starts: `start` itself, and every roughness of a coarse grid, as paint and as metal."""
    prior = np.tile(1 / np.array(PRIOR_SPREAD, np.float32) ** 2, (len(mean), 1)).astype(np.float32)
    tries = [(start, mean, prior)]
    for metal in (0.0, 1.0) if settings.metallic else (None,):
        for roughness in STARTS:
            other, around, weight = mean.copy(), mean.copy(), prior
            other[:, 5] = roughness
            if metal is not None:
                other[:, 6], around[:, 6] = abs(metal - 0.1), metal
                around, weight, _ = _reflecting(around, prior, np.full(len(mean), metal, np.float32))
            tries.append((other, around, weight))
    tries = tries if not np.array_equal(start, mean) else tries[1:]
    solved = []
    for k, (each, around, weight) in enumerate(tries):
        done = lambda share, k=k: progress((k + share) / len(tries))  # noqa: E731
        solution = problem.solve(each, around, weight, settings.solver_iterations, done)
        extra = unlikely(solution.values, seen) if settings.metallic else 0
        solved.append((solution, penalty(solution.values, around, weight) + extra))
    return best(solved)


def penalty(values: Values, mean: Values, prior: Values) -> Float[np.ndarray, " t"]:
    """What a prior adds to the cost."""
    return ((values - mean) ** 2 * prior).sum(axis=1)


def unlikely(values: Values, seen: Int[np.ndarray, " t"]) -> Float[np.ndarray, " t"]:
    """What being a metal costs, and what looking black often and yet being none costs, where no gloss shows either:
    paint is never that black."""
    black = np.maximum(1 - values[:, :3].max(axis=1) / PALEST_BLACK, 0) * np.minimum(seen / OFTEN, 1)
    black *= np.clip((MATT - values[:, 5]) / (MATT - GLOSSY), 0, 1)
    return np.where(values[:, 6] > 0.5, METAL_COST, BLACK_COST * black).astype(np.float32)


def best(solutions: Sequence[tuple[Solution, Float[np.ndarray, " t"]]]) -> Solution:
    """Texel by texel the solution of least cost with its penalty; the first of equals."""
    result, least = solutions[0][0], solutions[0][0].cost + solutions[0][1]
    for other, extra in solutions[1:]:
        cost = other.cost + extra
        better = cost < least
        least = np.where(better, cost, least)
        names = [f.name for f in fields(Solution)]
        result = Solution(**{n: _pick(better, getattr(other, n), getattr(result, n)) for n in names})
    return result


def _pick(choice: Bool[np.ndarray, " t"], a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.where(choice.reshape(-1, *[1] * (a.ndim - 1)), a, b)


def another_round(
    problem: Problem,
    gathered: Gathered,
    where: Atlas,
    solution: Solution,
    differences: Callable[[int], np.ndarray],
    settings: RecoverSettings,
    number: int,
) -> Solution:
    """Solve again for targets corrected by `differences(k)`, reference minus render of picture k for `solution`; the
    references, and how much they count, are `gathered`'s observations.

    Each texel's prior is the mean of its neighbours, weighted by how sure they are, as firm as the surface is smooth.
    """
    target = problem.predict(solution.values)
    if len(target) < len(gathered.observations.rgb):
        target = np.pad(target, ((0, len(gathered.observations.rgb) - len(target)), (0, 0)))
    for k, sighting in enumerate(gathered.sightings):
        if len(sighting.rows):
            target[sighting.rows] += fetch(differences(k), sighting)
    problem.retarget(target)
    apart = np.abs(target - gathered.observations.rgb).max(axis=1)
    problem.reweight(less_sure(gathered.observations.weight, UNLIKE * apart))
    where = joined(where, *(placed(v, gathered, where, 0) for v in (solution.values, _open(solution, gathered))))
    mean = neighbourhood(solution.values, sureness(solution, gathered), gathered, where, BLUR, OVER_SEAMS)
    prior = belief(solution, mean, gathered, where, settings.neighbours)
    mean, prior = levelled(solution, mean, prior, gathered, where)

    def tried(start: Values, steps: int, metal: Float[np.ndarray, " t"]) -> tuple[Solution, Float[np.ndarray, " t"]]:
        if not settings.metallic:
            solved = problem.solve(start, mean, prior, steps)
            return solved, penalty(solved.values, mean, prior)
        around, weight, constant = _both(mean, prior, metal)
        solved = problem.solve(start, around, weight, steps)
        return solved, penalty(solved.values, around, weight) + constant + unlikely(solved.values, gathered.seen)

    solved = [tried(solution.values, 5, _nearest(solution.values))]
    if number < RESTARTS:
        for roughness in (None, 0.15, 0.4, 0.8):
            other = mean.copy()
            if roughness is not None:
                other[:, 5] = roughness
            solved.append(tried(other, 8, _nearest(mean)))
    return best(solved)


def joined(where: Atlas, values: Float[np.ndarray, "a 7"], spread: Float[np.ndarray, "a 7"]) -> Atlas:
    """The same with seams believed by albedo and roughness; `spread`: standard deviations."""
    found = []
    for k, (among, size) in enumerate(zip(where.links, where.sizes, strict=True)):
        part = slice(where.offsets[k], where.offsets[k + 1])
        fields = ((values[part, c].reshape(size), spread[part, c].reshape(size)) for c in (0, 1, 2, 5))
        found.append(believed(among, fields))
    return replace(where, links=tuple(found))


def _open(solution: Solution, gathered: Gathered, scale: float | Float[np.ndarray, " t"] = 1.0) -> Values:
    """Standard deviations of what the texels' observations tell, `scale` on their variance; NOTHING without any."""
    found = np.minimum(likelihood(solution)[0] * np.sqrt(np.reshape(scale, (-1, 1))), NOTHING)
    found[gathered.seen == 0] = NOTHING
    return found.astype(np.float32)


def sureness(solution: Solution, gathered: Gathered) -> Values:
    """What a texel counts in its neighbours' means: by its spread, and less where its observations do not fit."""
    sure = 1 / np.maximum(solution.spread, 1e-4) ** 2
    sure = np.minimum(sure, np.quantile(sure, 0.9, axis=0))
    wrong = solution.cost / np.maximum(gathered.seen, 1) / MISFIT
    sure = (sure / (1 + wrong[:, None]) ** 2).astype(np.float32)
    sure[gathered.seen == 0] = 1e-6
    return sure


def belief(solution: Solution, mean: Values, gathered: Gathered, where: Atlas, neighbours: float) -> Values:
    """How firmly each texel is held to `mean`, as weights of (x - mean)²: one over the variance of the surface itself.

    Of the tilt by empirical Bayes: that variance is what the texels around differ by from their means, less what their
    own observations leave open, at most `neighbours`² and at least LEAST². Everything else has `neighbours`: albedo,
    roughness and metallic can stand for each other, and held to its neighbours' albedo a texel becomes a metal.
    """
    open_, gain = open_tilts(solution, gathered), likelihood(solution)[1][:, 3:5]
    apart = (solution.values - mean)[:, 3:5] / np.maximum(gain, 1e-3)
    weight = (1 / (open_**2 + neighbours**2) ** 2).astype(np.float32)
    weight[gathered.seen == 0] = 0
    variance = neighbourhood((apart**2 - open_**2).astype(np.float32), weight, gathered, where, WIDE, OVER_SEAMS[3:5])
    prior = np.full(mean.shape, 1 / neighbours**2, np.float32)
    prior[:, 3:5] = 1 / np.clip(variance, min(LEAST, neighbours) ** 2, neighbours**2)
    return prior


def levelled(
    solution: Solution, mean: Values, prior: Values, gathered: Gathered, where: Atlas
) -> tuple[Values, Values]:
    """`mean` and `prior` with the tilt drawn towards none where little is known of the texels around.

    All that is known of a tilt there is how much tilts vary at all: the variance V among texels that are known. Of a
    mean of precision P the share P / (P + 1 / V) is kept, and 1 / (P + 1 / V) of variance is left open. Where
    observations do not fit, tilts would take up what the model lacks, and are held by the root of `misfit` more firmly:
    more costs strong relief, less lets light between surfaces through.
    """
    precision = np.where(gathered.seen[:, None] > 0, 1 / open_tilts(solution, gathered) ** 2, 0).astype(np.float32)
    precision = AMONG * neighbourhood(precision, np.ones_like(precision), gathered, where, BLUR, OVER_SEAMS[3:5])
    left = 1 / (precision + 1 / varied(solution, gathered))
    mean, prior = mean.copy(), prior.copy()
    mean[:, 3:5] *= precision * left
    prior[:, 3:5] = 1 / (1 / prior[:, 3:5] + left)
    prior[:, 3:5] *= np.sqrt(1 + misfit(solution, gathered, where))[:, None]
    return mean, prior


def varied(solution: Solution, gathered: Gathered) -> Float[np.ndarray, "2"]:
    """The variance of tilts over the whole surface, by texels that are known: that of what was found, less what was
    left open."""
    open_ = open_tilts(solution, gathered)
    weight = np.where(gathered.seen[:, None] > 0, 1 / (open_**2 + KNOWN**2) ** 2, 0)
    mean = ((solution.values[:, 3:5] ** 2 - open_**2) * weight).sum(axis=0) / np.maximum(weight.sum(axis=0), 1e-12)
    return np.clip(mean, LEAST**2, PRIOR_SPREAD[3] ** 2)


def open_tilts(solution: Solution, gathered: Gathered) -> Float[np.ndarray, "t 2"]:
    """Standard deviations of the tilt that a texel's observations leave open."""
    return likelihood(solution)[0][:, 3:5] * inflation(solution, gathered)


def inflation(solution: Solution, gathered: Gathered) -> Float[np.ndarray, "t 1"]:
    """What standard deviations are multiplied by: observations that do not fit say less than their number promises."""
    return np.sqrt(1 + solution.cost / np.maximum(gathered.seen, 1))[:, None]


def misfit(solution: Solution, gathered: Gathered, where: Atlas) -> Float[np.ndarray, " t"]:
    """Cost per observation that is one too many, of the texels around each one together; 0 where there is none.

    An observation has three channels and a texel UNKNOWNS unknowns: one that few saw can explain whatever they saw, so
    only those around it tell how far its model can be believed.
    """
    spare = np.maximum(gathered.seen - len(UNKNOWNS) / 3, 0)
    each = np.where(spare[:, None] > 0, np.stack([solution.cost, spare], axis=1), 0).astype(np.float32)
    cost, count = neighbourhood(each, np.ones_like(each), gathered, where, AROUND).T
    return np.where(count > 1e-6, cost / np.maximum(count, 1e-6), 0).astype(np.float32)


def told(solution: Solution, gathered: Gathered, where: Atlas) -> Values:
    """Standard deviations of what a texel's observations tell, by how well they and those of the texels around it fit:
    where they fit far better than `noise` and `relative` say, they also tell more; NOTHING where there are none."""
    around = misfit(solution, gathered, where)
    own = np.where(gathered.seen >= OFTEN, solution.cost / np.maximum(gathered.seen - len(UNKNOWNS) / 3, 1), 0)
    scale = MARGIN * np.maximum(np.maximum(around, own) / 3, BEST_FIT)
    return _open(solution, gathered, scale)


def decided(solution: Solution, gathered: Gathered) -> Float[np.ndarray, " t"]:
    """The share of a texel's tilt that its own pictures decide and not its neighbours, 0..1. Texels that too few saw
    whole are left to the pictures, which show parts of them that the solver knows nothing of, as far as tilts vary."""
    variance = float(varied(solution, gathered).mean())
    share = likelihood(solution)[1][:, 3:5].mean(axis=1)
    return np.where(gathered.seen >= LEAST_SEEN, share, variance / (variance + KNOWN**2)).astype(np.float32)


def likelihood(solution: Solution) -> tuple[Values, Values]:
    """What the observations alone leave open (standard deviations), and the share of a texel's distance from its prior
    that they decide: 1 all of it, 0 none. Unknown by unknown, as if they did not depend on each other."""
    alone = np.maximum(1 / np.maximum(solution.spread, 1e-6) ** 2 - solution.prior, 1e-6)
    return 1 / np.sqrt(alone), alone / (alone + solution.prior)


def _nearest(values: Values) -> Float[np.ndarray, " t"]:
    """Metal or not."""
    return (values[:, 6] > 0.5).astype(np.float32)


def _both(mean: Values, prior: Values, metal: Float[np.ndarray, " t"]) -> tuple[Values, Values, np.ndarray]:
    """A prior and the belief that a texel is a metal or not as one prior, and the constant that this leaves."""
    mean, prior, left = _reflecting(mean, prior, metal)
    mean[:, 6:], prior[:, 6:], constant = _product(mean[:, 6:], prior[:, 6:], metal[:, None], 1 / METAL_SPREAD**2)
    return mean, prior, left + constant


def _reflecting(mean: Values, prior: Values, metal: Float[np.ndarray, " t"]) -> tuple[Values, Values, np.ndarray]:
    """The same of a prior and of how much metals reflect, where a texel is one."""
    mean, prior = mean.copy(), prior.copy()
    mean[:, :3], prior[:, :3], constant = _product(
        mean[:, :3], prior[:, :3], METAL_ALBEDO, metal[:, None] / METAL_ALBEDOS**2
    )
    return mean, prior, constant


def _product(
    mean: Float[np.ndarray, "t c"], prior: Float[np.ndarray, "t c"], other: Any, weight: Any
) -> tuple[Float[np.ndarray, "t c"], Float[np.ndarray, "t c"], Float[np.ndarray, " t"]]:
    """Mean, weight and constant of prior (x - mean)² + weight (x - other)²."""
    both = prior + np.float32(weight)
    constant = ((mean - other) ** 2 * prior * weight / both).sum(axis=1)
    return ((mean * prior + np.float32(other) * weight) / both).astype(np.float32), both, constant.astype(np.float32)
