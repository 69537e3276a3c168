"""Joint Gauss-Newton over light and texels; the Schur complement eliminates the texels.

A picture is linear in the light and nearly linear in a texel. Light and albedo trade off against each other, so that
alternating solves converge slowly. Let J be the Jacobian of a texel's observations by its own unknowns, and G that by
the radiances L of the cells. Each texel's optimal step is linear in the step of the light, which leaves the system

    sum over texels of  GᵀG - GᵀJ (JᵀJ + prior)⁻¹ JᵀG.

It is solved for L >= 0 with a smoothness prior and a prior for the convention of `unknown_light.py`. Where the
pictures' exposures are unknown too, log gains and vignetting are further columns of G
(`solver/photometry/material.py`).
Levenberg-Marquardt damping accepts only steps that lower the cost.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from mistyle.fitting.light.cells import LightCells, Radiance
from mistyle.render.deferred.material_table import ALBEDO, ROUGHNESS, TILT
from mistyle.render.mitsuba.draw import Tracer
from mistyle.solver.photometry.material import MaterialSamples, corrected_samples, gain_prior, gain_terms
from mistyle.solver.photometry.record import Gains
from mistyle.solver.prior import LEAST_SEEN
from mistyle.solver.texels.gbuffer import open_sky
from mistyle.solver.texels.levenberg_marquardt import Options, Points, Problem, Rig, Solution
from mistyle.solver.texels.light_transport import light_transport_matrix
from mistyle.solver.texels.observations import TexelObservations

# Prior of a texel's unknowns: means and standard deviations. The prior keeps tilts small; otherwise errors of the
# light would tilt the whole surface. Albedo is nearly free: thousands of texels that lean to grey, each a little, would
# set the scale and the colour of the light.
MEAN = (0.5, 0.5, 0.5, 0.0, 0.0, 0.6, 0.0)
SPREAD = (10.0, 10.0, 10.0, 0.1, 0.1, 0.3, 0.1)
SMOOTH = 0.05  # weight of the squared relative difference between neighbouring cells
FLAT = 0.05  # floor of the brightness that scales differences, as a share of the mean radiance
STEP = 0.01  # of finite differences by tilt, roughness and metallic
BLOCK = 1024  # texels per batch
TRIES, INNER = 5, 8  # damping values per step; iterations of the texel solver after it
SETTLED = 1e-3  # relative decrease of the cost that counts as convergence
LEAST_CURVATURE = 1e-7  # added to the diagonal of the light's matrix, relative to its mean
HELD = 10.0  # weight of the mean gain's square, and of the difference of the channels' vignetting, per observation
EXCHANGES = 3  # block exchanges without progress before single ones

Values = Float[np.ndarray, "t 7"]


@dataclass(frozen=True)
class Bundle:
    """The constants of the solve: `owner` is each observation's texel, `used` whether its texel has at least
    LEAST_SEEN observations, `free` the number of free unknowns per texel, `mean` the mean of its prior.

    samples  the observations as photographed, with `used` texels alone; None where their exposures are known
    """

    observed: TexelObservations
    cells: LightCells
    problem: Problem
    owner: Int[np.ndarray, " o"]
    used: Bool[np.ndarray, " o"]
    free: int
    mean: Values
    samples: MaterialSamples | None = None

    @property
    def reliable(self) -> Bool[np.ndarray, " t"]:
        """Whether each texel has at least LEAST_SEEN observations."""
        return self.observed.seen >= LEAST_SEEN

    @property
    def more(self) -> int:
        """Unknowns of a channel beside the cells' radiances: gains and vignetting."""
        return 0 if self.samples is None else self.samples.pictures + 3


@dataclass(frozen=True)
class State:
    """Radiance of the cells, values of the texels, the cost without the light's priors, the relative residual of the
    pictures, and their gains; None where they are known."""

    radiance: Radiance
    values: Values
    cost: float
    residual: float
    gains: Gains | None = None


def bundle(
    traced: Tracer,
    observed: TexelObservations,
    normal: Float[np.ndarray, "t 3"],
    cells: LightCells,
    options: Options,
    mean: Values,
    samples: MaterialSamples | None = None,
) -> Bundle:
    """The problem with these cells as the environment; `normal` is the geometric normal of the texels, `mean` that of
    their prior. `samples` are all observations, where their gains are to be solved."""
    points, count, number = observed.points, len(cells.angle), len(observed.rig.eye)
    visibility = open_sky(traced, points.position, normal, cells.direction.astype(np.float32))
    first = count * np.arange(number + 1)
    rig = Rig(
        eye=observed.rig.eye,
        first=first,
        vector=np.tile(cells.direction, (number, 1)).astype(np.float32),
        near=np.zeros(number * count, np.float32),
        irradiance=np.zeros((number * count, 3), np.float32),
        cells=first[:-1],
        width2=np.tile(cells.width2, number).astype(np.float32),
    )
    problem = Problem(Points(points.position, points.frame, visibility), rig, observed.observations, options)
    owner = np.repeat(np.arange(len(observed.texel)), observed.seen)
    used = (observed.seen >= LEAST_SEEN)[owner]
    return Bundle(observed, cells, problem, owner, used, 7 if options.metallic else 6, mean, samples)


def texels_under(bundled: Bundle, radiance: Radiance, start: Values, steps: int, gains: Gains | None = None) -> State:
    """The optimal texels under a given light, at given gains."""
    _relight(bundled, radiance)
    seen, weight = _corrected(bundled, gains)
    if gains is not None:
        bundled.problem.retarget(seen)
        bundled.problem.reweight(weight)
    solution, cost = solved_texels(bundled, start, bundled.mean, steps)
    residual = (seen - bundled.problem.predict(solution.values))[bundled.used]
    residual = np.sqrt((residual.astype(float) ** 2).sum() / max(float((seen[bundled.used] ** 2).sum()), 1e-30))
    return State(radiance, solution.values, float(cost[bundled.reliable].sum()), float(residual), gains)


def solved_texels(bundled: Bundle, start: Values, mean: Values, steps: int) -> tuple[Solution, Float[np.ndarray, " t"]]:
    """The texels' solution with these means of the prior, and its cost with the prior's part."""
    prior = np.tile(1 / np.array(SPREAD, np.float32) ** 2, (len(start), 1))
    solution = bundled.problem.solve(start, mean, prior, steps)
    return solution, solution.cost + ((solution.values - mean) ** 2 * prior).sum(axis=1)


def _corrected(bundled: Bundle, gains: Gains | None) -> tuple[np.ndarray, np.ndarray]:
    """The observations at these gains, and their weights."""
    if gains is None or bundled.samples is None:
        return bundled.observed.observations.rgb, bundled.observed.observations.weight
    return corrected_samples(bundled.samples, gains)


def light_over(bundled: Bundle, radiance: Radiance, values: Values, gains: Gains | None = None) -> Radiance:
    """The optimal light for fixed texels and gains."""
    at = State(radiance, values, 0.0, 0.0, gains)
    matrix, gradient = _system(bundled, at, follow=False)
    flat = radiance.T.ravel()
    damping = 1e-3 * np.diag(np.diag(matrix))
    full = matrix + damping + _smoothness(bundled.cells, radiance)
    return _least_squares(full, gradient + (matrix + damping) @ flat, radiance)[0]


def solve_light_and_texels(
    bundled: Bundle,
    state: State,
    convention: Callable[[Bundle, State], Float[np.ndarray, "3"]],
    weight: float,
    steps: int,
    progress: Callable[[State], None],
) -> State:
    """At most `steps` joint steps. `convention` gives a state's mean radiance under the convention; `weight` is that
    of the mean radiance's squared relative distance from it, per observation."""
    damping = 1e-2
    weight = weight * int(bundled.used.sum())
    more = bundled.more
    for _ in range(steps):
        matrix, gradient = _system(bundled, state, follow=True)
        smooth, flat = _smoothness(bundled.cells, state.radiance, more), _flat(state.radiance, more)
        means = _means(bundled.cells, convention(bundled, state), more)
        held, pull = _held(bundled, state)

        def total(at: State, smooth=smooth, means=means) -> float:
            x = _flat(at.radiance, more)
            return at.cost + float(x @ smooth @ x) + weight * float(((means @ x - 1) ** 2).sum()) + _gain_cost(at)

        before = total(state)
        for _ in range(TRIES):
            damped = damping * np.diag(np.diag(matrix + smooth))
            rhs = gradient + (matrix + damped) @ flat + weight * means.sum(axis=0) - pull
            whole = matrix + damped + smooth + weight * means.T @ means + held
            radiance, change = _least_squares(whole, rhs, state.radiance, more)
            gains = None if state.gains is None else state.gains.moved(change)
            tried = texels_under(bundled, radiance, state.values, INNER, gains)
            after = total(tried)
            if after < before:
                break
            damping *= 6
        else:
            return state
        state, damping = tried, max(damping / 4, 1e-5)
        progress(state)
        if after > before * (1 - SETTLED):
            return state
    return state


def _relight(bundled: Bundle, radiance: Radiance) -> None:
    irradiance = (radiance * bundled.cells.angle[:, None]).astype(np.float32)
    bundled.problem.relight(np.tile(irradiance, (len(bundled.observed.rig.eye), 1)))


def _system(bundled: Bundle, state: State, *, follow: bool) -> tuple[np.ndarray, np.ndarray]:
    """Normal matrix and gradient of the light, channel by channel; with `follow` each channel's gains and vignetting
    come after its light, and the texels are eliminated."""
    cells, values, radiance = bundled.cells, state.values, state.radiance
    rgb, weight = _corrected(bundled, state.gains)
    count, total = len(cells.angle), len(rgb)
    _relight(bundled, radiance)
    linear, constant = light_transport_matrix(bundled.problem, values, total, count)
    linear *= cells.angle.astype(np.float32)
    constant *= cells.angle.astype(np.float32)
    albedo = values[bundled.owner, ALBEDO]
    by_light = [albedo[:, c : c + 1] * linear + constant for c in range(3)]
    predicted = np.stack([by_light[c] @ radiance[:, c] for c in range(3)], axis=1)
    residual = rgb - predicted
    size = np.sqrt(((residual * weight[:, None]) ** 2).sum(axis=1))
    # Huber weights; far from the solution the threshold follows the median residual.
    most = bundled.problem.options.huber * max(1.0, float(np.median(size[bundled.used])) / 1.5)
    weight = weight * np.sqrt(np.minimum(1, most / np.maximum(size, 1e-9)) * bundled.used)
    residual = residual * weight[:, None]
    by_light = [(part * weight[:, None]).astype(np.float32) for part in by_light]
    if bundled.samples is not None and follow:
        terms = gain_terms(bundled.samples)
        for c in range(3):
            more = terms * (weight * predicted[:, c])[:, None]
            by_light[c] = np.concatenate([by_light[c], more], axis=1, dtype=np.float32)
    count = by_light[0].shape[1]
    matrix, gradient = np.zeros((3 * count, 3 * count)), np.zeros(3 * count)
    for c in range(3):
        # In double precision: the Schur complement cancels most of it.
        own, part = slice(c * count, (c + 1) * count), by_light[c].astype(float)
        matrix[own, own], gradient[own] = part.T @ part, part.T @ residual[:, c]
    if follow:
        by_texel = _by_texel(bundled, values, [linear @ radiance[:, c] for c in range(3)]) * weight[:, None, None]
        by_texel *= ~_at_bounds(bundled, values)[bundled.owner, None]
        schur, slope = _schur_terms(bundled, values, by_texel, by_light, residual)
        matrix -= schur
        gradient -= slope
    return matrix, gradient


def _by_texel(bundled: Bundle, values: Values, shine: Sequence[np.ndarray]) -> Float[np.ndarray, "o 3 7"]:
    """Derivatives of the model by the texel's own unknowns: exact for albedo, central differences for the rest."""
    result = np.zeros((len(bundled.owner), 3, 7), np.float32)
    for c in range(3):
        result[:, c, c] = shine[c]
    for k in range(TILT.start, bundled.free):
        low, high = values.copy(), values.copy()
        low[:, k] = np.maximum(low[:, k] - STEP, bundled.problem.options.floor) if k == ROUGHNESS else low[:, k] - STEP
        high[:, k] += STEP
        between = (bundled.problem.predict(high) - bundled.problem.predict(low)) / (high - low)[bundled.owner, k, None]
        result[:, :, k] = between
    return result


def _at_bounds(bundled: Bundle, values: Values) -> Bool[np.ndarray, "t 7"]:
    """Unknowns at their bounds, which the Schur complement leaves out."""
    low, high = np.zeros(7), np.ones(7)
    low[TILT], low[ROUGHNESS] = -1, bundled.problem.options.floor
    return (values < low + 1e-5) | (values > high - 1e-5)


def _schur_terms(
    bundled: Bundle, values: Values, by_texel: np.ndarray, by_light: Sequence[np.ndarray], residual: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The texels' part of the Schur complement: subtracted from the light's matrix and gradient.

    A channel's albedo meets only that channel's light. It comes first in the Cholesky factor, so its rows of the
    whitened cross terms have one block; the other unknowns' rows have three.
    """
    start, prior, cells = bundled.observed.observations.start, np.array(SPREAD) ** -2.0, by_light[0].shape[1]
    seen, free = np.flatnonzero(bundled.reliable), bundled.free
    schur, slope = np.zeros((3 * cells, 3 * cells)), np.zeros(3 * cells)
    blocks = [slice(c * cells, (c + 1) * cells) for c in range(3)]
    for low in range(0, len(seen), BLOCK):
        texel = seen[low : low + BLOCK]
        # Texels between them have too few observations and zero weight: the sums may include them.
        rows = slice(int(start[texel[0]]), int(start[texel[-1] + 1]))
        at = start[texel] - rows.start

        def summed(per_row: np.ndarray, at=at) -> np.ndarray:
            return np.add.reduceat(per_row, at, axis=0)

        own = by_texel[rows][:, :, :free]
        normal = summed(np.einsum("oci,ocj->oij", own, own)).astype(float) + np.diag(prior[:free])
        rhs = summed(np.einsum("oci,oc->oi", own, residual[rows]))
        rhs = rhs - prior[:free] * (values[texel, :free] - bundled.mean[texel, :free])
        factor = np.linalg.cholesky(normal)
        whole = np.zeros((len(texel), free - 3, 3 * cells))
        for c, block in enumerate(blocks):
            light = by_light[c][rows]
            albedo = summed(own[:, c, c, None] * light) / factor[:, c, c, None]
            schur[block, block] += albedo.T @ albedo
            for k in range(3, free):
                whole[:, k - 3, block] = summed(own[:, c, k, None] * light) - factor[:, k, c, None] * albedo
            rhs_c = rhs[:, c] / factor[:, c, c]
            slope[block] += albedo.T @ rhs_c
            rhs[:, 3:] -= factor[:, 3:, c] * rhs_c[:, None]
        half = np.linalg.solve(factor[:, 3:, 3:], whole).reshape(-1, 3 * cells)
        schur += half.T @ half
        slope += half.T @ np.linalg.solve(factor[:, 3:, 3:], rhs[:, 3:, None]).ravel()
    return schur, slope


def _smoothness(cells: LightCells, radiance: Radiance, more: int = 0) -> Float[np.ndarray, "n n"]:
    """Quadratic form of neighbours' squared differences relative to their brightness: lamps may have sharp edges.
    `more` unknowns of each channel, after its radiances, are free."""
    bright, count = radiance.mean(axis=1), len(cells.angle) + more
    i, j = cells.pairs.T
    flat = FLAT * float((bright * cells.angle).sum() / cells.angle.sum())
    weight = SMOOTH / np.maximum((bright[i] + bright[j]) / 2 + flat, 1e-12) ** 2
    one = np.zeros((count, count))
    for a, b, sign in ((i, i, 1), (j, j, 1), (i, j, -1), (j, i, -1)):
        np.add.at(one, (a, b), sign * weight)
    return np.kron(np.eye(3), one)


def _means(cells: LightCells, target: Float[np.ndarray, "3"], more: int = 0) -> Float[np.ndarray, "3 n"]:
    """Rows that give each channel's mean radiance relative to `target`."""
    share = np.concatenate([cells.angle / cells.angle.sum(), np.zeros(more)])
    return np.kron(np.diag(1 / np.maximum(target, 1e-12)), share)


def _least_squares(
    matrix: np.ndarray, rhs: np.ndarray, near: Radiance, more: int = 0
) -> tuple[Radiance, Float[np.ndarray, " m"]]:
    """The x that minimises xᵀMx / 2 - xᵀr: radiances >= 0, one column per channel, and changes of gains, row by row,
    and of the vignetting, of either sign. `near` is a guess.

    Block principal pivoting (Júdice and Pires 1994): the signs of x and of its dual decide which entries are zero. It
    needs a Cholesky factor per exchange, and few exchanges from a good guess.
    """
    from scipy.linalg import cho_factor, cho_solve

    size = len(matrix)
    matrix = (matrix + matrix.T) / 2
    level = max(float(np.trace(matrix)) / size, 1e-30)
    matrix[np.diag_indices(size)] += LEAST_CURVATURE * level
    signed = _flat(np.zeros_like(near), more, 1.0) > 0
    free, x, dual = signed | (_flat(near, more) > 0), np.zeros(size), -rhs
    fewest, tries = size + 1, EXCHANGES
    for _ in range(20 * size):
        rows = np.flatnonzero(free)
        x, dual = np.zeros(size), np.zeros(size)
        x[rows] = cho_solve(cho_factor(matrix[np.ix_(rows, rows)], check_finite=False), rhs[rows], check_finite=False)
        dual[~free] = (matrix[:, rows] @ x[rows] - rhs)[~free]
        wrong = np.flatnonzero((free & ~signed & (x < 0)) | (~free & (dual < -1e-9 * np.abs(rhs).max())))
        if not len(wrong):
            break
        if len(wrong) < fewest:
            fewest, tries = len(wrong), EXCHANGES
        elif tries:
            tries -= 1
        else:
            wrong = wrong[-1:]  # Murty's rule: one exchange at a time ends in any case
        free[wrong] = ~free[wrong]
    columns, count = x.reshape(3, -1).T, len(near)
    gains, falls = columns[count : count + max(more - 3, 0)], columns[count + max(more - 3, 0) :]
    return np.maximum(columns[:count], 0), np.concatenate([gains.ravel(), falls.mean(axis=1)])


def _flat(radiance: Radiance, more: int, filled: float = 0.0) -> Float[np.ndarray, " n"]:
    """Radiances channel by channel, each followed by `more` values."""
    return np.concatenate([radiance, np.full((more, 3), filled)]).T.ravel()


def _held(bundled: Bundle, state: State) -> tuple[np.ndarray, np.ndarray]:
    """Quadratic form and gradient of the prior of gains and vignetting; it ties the channels' vignetting."""
    count, more = len(bundled.cells.angle), bundled.more
    size = 3 * (count + more)
    held, pull = np.zeros((size, size)), np.zeros(size)
    if state.gains is None:
        return held, pull
    n = more - 3
    gains = np.array([[c * (count + more) + count + k for c in range(3)] for k in range(n)]).ravel()
    prior = gain_prior(n, True)
    strong = HELD * float(bundled.used.sum())
    prior[: 3 * n, : 3 * n] += strong * np.kron(np.ones((n, n)), np.eye(3))
    x = np.concatenate([state.gains.gain.ravel(), state.gains.vignetting])
    held[np.ix_(gains, gains)] = prior[: 3 * n, : 3 * n]
    pull[gains] = prior[: 3 * n, : 3 * n] @ state.gains.gain.ravel()
    falls = np.array([[c * (count + more) + count + n + k for k in range(3)] for c in range(3)])
    third = np.full((3, 3), 1 / 3)
    for k in range(3):
        held[np.ix_(falls[:, k], falls[:, k])] = prior[3 * n + k, 3 * n + k] * third + strong * (np.eye(3) - third)
        pull[falls[:, k]] = prior[3 * n + k, 3 * n + k] * x[3 * n + k] / 3
    return held, pull


def _gain_cost(state: State) -> float:
    """The prior's part of the cost."""
    if state.gains is None:
        return 0.0
    x = np.concatenate([state.gains.gain.ravel(), state.gains.vignetting])
    return float(x @ gain_prior(len(state.gains.gain), True) @ x)
