"""Photometry solved with a material under known light: exposures that a material explains, highlights included.

A sample of the surface's texels is observed in small pictures. Observation o of texel t in picture i and channel c is

    y_oc = exp(g_ic + fall(r_o) · a) f_oc(x_t),

where f is the model of `texels/levenberg_marquardt.py`. The log gains g and the vignetting a are few, so each
Gauss-Newton step eliminates the texels (Schur complement; Triggs et al., Bundle Adjustment, 2000):

    S = AᵀA - AᵀJ (JᵀJ + P)⁻¹ JᵀA.

J is the Jacobian by a texel's own unknowns and A that by g and a, whose columns are f and f r², f r⁴, f r⁶. After each
step the texels are solved again at the new gains. Far from the solution the observations' standard deviation grows
with the median residual, so that priors keep the texels plain and the gains explain the difference first.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import sparse

from mistyle.core.camera import Camera
from mistyle.core.capture import Captures, shrunk_to
from mistyle.core.light import has_soft
from mistyle.core.rows import weighted_median, weighted_medians
from mistyle.render.deferred.material_table import ALBEDO, METALLIC, ROUGHNESS, TILT
from mistyle.render.deferred.sky import even_directions
from mistyle.render.mitsuba.draw import Tracer
from mistyle.solver.photometry.least_squares import one_hot
from mistyle.solver.photometry.record import Gains, fall_terms, reach_of
from mistyle.solver.photometry.solve import positions
from mistyle.solver.prior import log_prior_penalty, metal_f0_prior, penalty
from mistyle.solver.table import Atlas, linked
from mistyle.solver.texels.gbuffer import open_sky, rig
from mistyle.solver.texels.levenberg_marquardt import Observations, Points, Problem, Rig, Solution
from mistyle.solver.texels.observations import (
    ObservationOptions,
    TexelObservations,
    coarse_observations,
    observation_std,
    points_of,
)
from mistyle.solver.texels.rounds import CLASSES, STARTS, best, best_by_region

SIDE = 256  # pixels along the longer side of the small pictures
ATLAS = 128  # texels a side of the coarse atlas, all sets together
LEAST_EACH = 300  # observations of a picture, at least on average
SHOWN = 12  # observations from which on a picture has an exposure of its own, and a spread
CELLS = 256  # of soft light: highlights of metals must not depend on where a cell is
OBSERVATIONS = 20_000  # at most, about
MEAN = (0.5, 0.5, 0.5, 0.0, 0.0, 0.6, 0.0)  # prior of a texel: a sample of a bumpy surface, hardly tilted
SPREAD = (1.0, 1.0, 1.0, 0.15, 0.15, 0.4, 0.1)
NOISY = 0.0007, 0.03  # standard deviation of an observation, as in `observation_std`
USUAL = 1.5  # median residual in standard deviations, above which the latter grow
STEP = 0.01  # of finite differences by tilt, roughness and metallic
STARTED, INNER = 12, 6  # Levenberg-Marquardt steps from a start, and after a change of the gains
RESTARTS = 2  # steps of the gains between two solves of the texels from all starts
STEPS = 14
FIRST_SCALE = 4.0  # of the standard deviations in the first solve
FACING = 0.2  # least cosine of the angle of view
DARK, LEAST = 0.01, 1e-6  # radiance of half the weight in the spread, and the least radiance in it
SETTLED = 3e-3  # largest change of a log gain that counts as convergence
LONGEST = 1.0  # largest change of a log gain in a step
# Standard deviations of exposures, balances and vignetting around 0, and of those not solved for; INDEPENDENT is the
# share of independent observations.
EXPOSURE, BALANCE, FALL, FIXED = 1.0, 0.2, 0.5, 1e-4
INDEPENDENT = 0.02


@dataclass(frozen=True)
class MaterialSamples:
    """o observations of t texels in n pictures; `x` is the position in the picture (`record.coordinates`), `worth` the
    observation's weight times its standard deviation, 0..1, `noise` the arguments of `observation_std`."""

    points: Points
    rig: Rig
    observations: Observations
    x: Float[np.ndarray, "o 2"]
    worth: Float[np.ndarray, " o"]
    noise: tuple[float, float]
    regions: tuple[TexelObservations, Atlas] | None = None

    @property
    def pictures(self) -> int:
        return len(self.rig.eye)

    @property
    def shown(self) -> Int[np.ndarray, " n"]:
        """Number of observations of each picture."""
        return np.bincount(self.observations.picture, minlength=self.pictures)

    @property
    def owner(self) -> Int[np.ndarray, " o"]:
        """Each observation's texel."""
        return np.repeat(np.arange(len(self.points.position)), np.diff(self.observations.start))


@dataclass(frozen=True)
class MatchedMaterial:
    """Gains, the robust cost of their texels, and the robust log difference between pictures and model: of all, and of
    each picture, 0 for those with fewer than SHOWN observations."""

    gains: Gains
    cost: float
    spread: float
    spreads: Float[np.ndarray, " n"]


def material_samples(
    traced: Tracer,
    captures: Captures,
    tangents: Float[np.ndarray, "f 3 4"] | None,
) -> MaterialSamples:
    """The observations of a coarse atlas in small pictures."""
    mesh = traced.mesh
    small = shrunk_to(captures, SIDE)
    small = replace(small, load=cache(small.load))  # observed twice, and photographs are slow to decode
    options = ObservationOptions(FACING, *NOISY, skies=False, move=0)
    most = max(OBSERVATIONS, LEAST_EACH * len(captures))
    texels, observed = coarse_observations(traced, small, tangents, options, ATLAS, most)
    if has_soft(captures.lights):
        position, normal, _ = points_of(texels)
        sky = open_sky(traced, position, normal, even_directions(CELLS).astype(np.float32))
        points = replace(observed.points, open=sky)
        observed = replace(observed, points=points, rig=rig(small.cameras, small.lights, CELLS))
    return replace(all_samples(observed, small.cameras, NOISY), regions=(observed, linked(mesh, texels)))


def all_samples(observed: TexelObservations, cameras: Sequence[Camera], noise: tuple[float, float]) -> MaterialSamples:
    """All observations; `noise` are the arguments of their `observation_std`."""
    seen = observed.observations
    worth = seen.weight * observation_std(np.maximum(seen.rgb.max(axis=1, initial=0), 0), *noise)
    x = positions(observed, cameras)
    return MaterialSamples(observed.points, observed.rig, seen, x, worth.astype(np.float32), noise)


def log_gain(samples: MaterialSamples, gains: Gains) -> Float[np.ndarray, "o 3"]:
    """Log gain of every observation."""
    return gains.gain[samples.observations.picture] + (fall_terms(samples.x, gains.reach) @ gains.vignetting)[:, None]


def corrected_samples(
    samples: MaterialSamples, gains: Gains
) -> tuple[Float[np.ndarray, "o 3"], Float[np.ndarray, " o"]]:
    """The observations without their gains, and their weights."""
    y = (samples.observations.rgb / np.exp(log_gain(samples, gains))).astype(np.float32)
    level = np.maximum(y.max(axis=1, initial=0), 0)
    return y, (samples.worth / observation_std(level, *samples.noise)).astype(np.float32)


class _Solve:
    """The alternation; a class, since the problem on the device has a state: its targets and weights."""

    def __init__(self, samples: MaterialSamples, problem: Problem) -> None:
        self.samples, self.problem, self.scale = samples, problem, 1.0
        self.y, self.weight = samples.observations.rgb, samples.observations.weight

    def target(self, gains: Gains) -> None:
        """Correct the observations by these gains."""
        self.y, weight = corrected_samples(self.samples, gains)
        self.weight = (weight / self.scale).astype(np.float32)
        self.problem.retarget(self.y)
        self.problem.reweight(self.weight)

    def texels(self, values: np.ndarray, steps: int = INNER) -> Solution:
        """The texels from `values`, in their classes."""
        return self.problem.solve(values, *prior_of(self.problem, values), steps)

    def anew(self, values: np.ndarray | None = None) -> np.ndarray:
        """The best of all starts and of `values`."""
        count, tries = len(self.samples.points.position), []
        seen, metallic = np.diff(self.samples.observations.start), self.problem.options.metallic
        starts = [] if values is None else [values]
        for metal in CLASSES if metallic else (0.0,):
            for roughness in STARTS:
                guess = np.tile(np.array(MEAN, np.float32), (count, 1))
                guess[:, ROUGHNESS], guess[:, METALLIC] = roughness, metal
                starts.append(guess)
        for guess in starts:
            solution = self.texels(guess, STARTED)
            extra = penalty(solution.values, *prior_of(self.problem, guess))
            if metallic:
                extra = extra + log_prior_penalty(solution.values, seen, "metal")
            tries.append((solution, extra))
        if metallic and self.samples.regions is not None:
            return best_by_region(self.problem, tries, *self.samples.regions).values
        return best(tries)[0].values

    def cost(self, solution: Solution) -> float:
        """Robust cost and prior of all texels."""
        extra = penalty(solution.values, *prior_of(self.problem, solution.values))
        return float((solution.cost + extra).sum(dtype=np.float64))

    def residual(self, values: np.ndarray) -> float:
        """Median residual, in standard deviations of `noise`."""
        residual = (self.y - self.problem.predict(values)) * self.weight[:, None]
        return float(np.median(np.sqrt((residual**2).sum(axis=1)))) * self.scale


def prior_of(problem: Problem, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean and precision of texels: MEAN and SPREAD, and those of the class of `values`."""
    mean = np.tile(np.array(MEAN, np.float32), (len(values), 1))
    precision = np.tile(1 / np.array(SPREAD, np.float32) ** 2, (len(values), 1)).astype(np.float32)
    if not problem.options.metallic:
        return mean, precision
    mean[:, METALLIC] = metal = (values[:, METALLIC] > 0.5).astype(np.float32)
    return metal_f0_prior(mean, precision, metal)[:2]


def solve_with_material(
    samples: MaterialSamples,
    problem: Problem,
    start: Gains,
    *,
    full: bool = True,
    progress: Callable[[float], None] = lambda done: None,
) -> MatchedMaterial:
    """Gains, vignetting and texels from a start; `full` adds balances and vignetting to the exposures. A picture with
    fewer than SHOWN observations keeps the mean exposure."""
    work, shown = _Solve(samples, problem), samples.shown >= SHOWN
    gains = Gains(np.where(shown[:, None], start.gain - start.gain[shown].mean(axis=0), 0), start.vignetting)
    work.scale = FIRST_SCALE
    work.target(gains)
    values = work.anew()
    for k in range(STEPS):
        work.scale = max(1.0, work.residual(values) / USUAL)
        work.target(gains)
        values = work.texels(values).values if k % RESTARTS else work.anew(values)
        system = reduced_system(samples, problem, values, work.y, work.weight)
        change = np.clip(_step(system, gains, full, shown), -LONGEST, LONGEST)
        gains = gains.moved(change)
        work.target(gains)
        values = work.texels(values).values
        progress((k + 1) / STEPS)
        if np.abs(change).max() < SETTLED and k % RESTARTS == 0:
            break
    work.scale = 1.0
    work.target(gains)
    return _fit_of(work, replace(gains, reach=reach_of(samples.x)), work.texels(work.anew(values)))


def fixed_gains(samples: MaterialSamples, problem: Problem, gains: Gains) -> MatchedMaterial:
    """The texels at given gains."""
    work = _Solve(samples, problem)
    work.target(gains)
    return _fit_of(work, gains, work.texels(work.anew()))


def _fit_of(work: _Solve, gains: Gains, solution: Solution) -> MatchedMaterial:
    f, y = np.maximum(work.problem.predict(solution.values), LEAST), np.maximum(work.y, LEAST)
    weight, apart = y**2 / (y**2 + DARK**2), 1.4826 * np.abs(np.log(y / f))
    spreads, picture = np.zeros(len(gains.gain)), work.samples.observations.picture
    shown, medians = weighted_medians(np.repeat(picture, 3), apart.ravel(), weight.ravel())
    spreads[shown] = np.where(work.samples.shown[shown] >= SHOWN, medians, 0)
    return MatchedMaterial(gains, work.cost(solution), weighted_median(apart.ravel(), weight.ravel()), spreads)


@dataclass(frozen=True)
class ReducedSystem:
    """Normal matrix and gradient of the gains (n x 3, row by row) and the vignetting, the texels eliminated."""

    matrix: Float[np.ndarray, "m m"]
    gradient: Float[np.ndarray, " m"]


def reduced_system(
    samples: MaterialSamples, problem: Problem, values: np.ndarray, y: np.ndarray, weight: np.ndarray
) -> ReducedSystem:
    """The Schur complement at `values` for observations `y` with `weight`s."""
    predicted = problem.predict(values)
    residual = y - predicted
    size = np.sqrt(((residual * weight[:, None]) ** 2).sum(axis=1))
    robust = weight * np.sqrt(np.minimum(1, problem.options.huber / np.maximum(size, 1e-9)))
    own = texel_jacobian(samples, problem, values, predicted) * robust[:, None, None]
    columns = gain_columns(samples, predicted * robust[:, None])
    r = (residual * robust[:, None]).astype(float).ravel()
    free = own.shape[2]
    o, t, owner = len(predicted), len(values), samples.owner
    index = (free * owner[:, None, None] + np.arange(free)).repeat(3, axis=1).ravel()
    by_texel = sparse.csr_array(
        (own.astype(float).ravel(), index, np.arange(0, 3 * o * free + 1, free)), shape=(3 * o, free * t)
    )
    mean, precision = prior_of(problem, values)
    # A last row of zeros, since texels without observations would take the next one's.
    each = np.concatenate([np.einsum("oci,ocj->oij", own, own, dtype=float), np.zeros((1, free, free))])
    normal = np.add.reduceat(each, samples.observations.start[:-1], axis=0)
    normal[np.diff(samples.observations.start) == 0] = 0
    normal[:, np.arange(free), np.arange(free)] += precision[:, :free]
    slope = (by_texel.T @ r).reshape(t, free)
    slope -= (precision * (values - mean))[:, :free]
    inverse = np.linalg.inv(np.linalg.cholesky(normal))
    blocks = sparse.bsr_array((inverse, np.arange(t), np.arange(t + 1)), shape=(free * t, free * t))
    cross = sparse.csr_array(blocks @ (by_texel.T @ columns))
    half = np.einsum("tij,tj->ti", inverse, slope).ravel()
    matrix = (columns.T @ columns).toarray() - (cross.T @ cross).toarray()
    return ReducedSystem(matrix, columns.T @ r - cross.T @ half)


def gain_columns(samples: MaterialSamples, predicted: Float[np.ndarray, "o 3"]) -> sparse.csr_array:
    """Derivatives of the (weighted) model by log gains and vignetting; rows are observations' channels."""
    o, n = len(predicted), samples.pictures
    gains = (3 * samples.observations.picture[:, None].astype(np.int64) + np.arange(3))[..., None]
    falls = np.broadcast_to(3 * n + np.arange(3), (o, 3, 3))
    index = np.concatenate([gains, falls], axis=2).ravel()
    terms = np.broadcast_to(fall_terms(samples.x)[:, None, :], (o, 3, 3))
    data = predicted[..., None].astype(float) * np.concatenate([np.ones((o, 3, 1)), terms], axis=2)
    return sparse.csr_array((data.ravel(), index, np.arange(0, 12 * o + 1, 4)), shape=(3 * o, 3 * n + 3))


def gain_terms(samples: MaterialSamples) -> Float[np.ndarray, "o k"]:
    """Derivatives of a channel's log radiance by the pictures' log gains in it, and by the vignetting."""
    picks = one_hot(samples.observations.picture, samples.pictures).toarray()
    return np.concatenate([picks, fall_terms(samples.x)], axis=1)


def texel_jacobian(
    samples: MaterialSamples, problem: Problem, values: np.ndarray, predicted: np.ndarray
) -> Float[np.ndarray, "o 3 k"]:
    """Derivatives of the model by the texel's own unknowns: differences, exact for the albedo, 0 at bounds."""
    options, owner = problem.options, samples.owner
    free = 7 if options.metallic else 6
    result = np.zeros((len(predicted), 3, free), np.float32)
    low_bound, high_bound = np.zeros(7), np.ones(7)
    low_bound[TILT], low_bound[ROUGHNESS] = -1, options.floor
    dark = values.copy()
    dark[:, ALBEDO] = 0
    constant = problem.predict(dark)
    lit = values.copy()
    lit[:, ALBEDO] = 1
    linear = problem.predict(lit) - constant
    for c in range(3):
        result[:, c, c] = linear[:, c]
    for k in range(3, free):
        low, high = values.copy(), values.copy()
        low[:, k] = np.maximum(low[:, k] - STEP, low_bound[k])
        high[:, k] = np.minimum(high[:, k] + STEP, high_bound[k])
        between = (problem.predict(high) - problem.predict(low)) / (high - low)[owner, k, None]
        result[:, :, k] = between
    fixed = (values < low_bound + 1e-5) | (values > high_bound - 1e-5)
    return result * ~fixed[owner, None, :free]


def gain_prior(n: int, full: bool) -> Float[np.ndarray, "m m"]:
    """Precision of gains and vignetting around 0."""
    third = np.full((3, 3), 1 / 3)
    own = third / EXPOSURE**2 + (np.eye(3) - third) / (BALANCE if full else FIXED) ** 2
    matrix = np.zeros((3 * n + 3, 3 * n + 3))
    matrix[: 3 * n, : 3 * n] = np.kron(np.eye(n), own)
    matrix[3 * n :, 3 * n :] = np.eye(3) / (FALL if full else FIXED) ** 2
    return matrix / INDEPENDENT


def _step(system: ReducedSystem, gains: Gains, full: bool, shown: Bool[np.ndarray, " n"]) -> Float[np.ndarray, " m"]:
    """The change of gains and vignetting; the gains of each channel keep their mean at 0, those of pictures that are
    not `shown` keep theirs."""
    n, x = len(gains.gain), np.concatenate([gains.gain.ravel(), gains.vignetting])
    held = gain_prior(n, full)
    level = float(np.trace(system.matrix)) / len(x)
    held[: 3 * n, : 3 * n] += level * np.kron(np.outer(shown, shown) + n * np.diag(~shown), np.eye(3))
    return np.linalg.solve(system.matrix + held, system.gradient - held @ x)
