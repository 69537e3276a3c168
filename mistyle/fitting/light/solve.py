"""Joint Gauss-Newton over light and texels; the Schur complement eliminates the texels.

A picture is linear in the light and nearly linear in a texel. Light and albedo trade off against each other, so that
alternating solves converge slowly. Let J be the Jacobian of a texel's observations by its own unknowns, and G that by
the radiances L of the cells. Each texel's optimal step is linear in the step of the light, which leaves the system

    sum over texels of  GᵀG - GᵀJ (JᵀJ + prior)⁻¹ JᵀG.

It is solved for L >= 0 with a smoothness prior and a prior for the convention of `unknown_light.py`.
Levenberg-Marquardt damping accepts only steps that lower the cost.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from mistyle.fitting.light.cells import LightCells, Radiance
from mistyle.render.deferred.material_table import ALBEDO, ROUGHNESS, TILT
from mistyle.render.mitsuba.draw import Tracer
from mistyle.solver.prior import LEAST_SEEN
from mistyle.solver.texels.gbuffer import open_sky
from mistyle.solver.texels.levenberg_marquardt import Options, Points, Problem, Rig
from mistyle.solver.texels.light_transport import light_transport_matrix
from mistyle.solver.texels.observations import TexelObservations

# Prior of a texel's unknowns: means and standard deviations. The prior keeps tilts small; otherwise errors of the
# light would tilt the whole surface.
MEAN = (0.5, 0.5, 0.5, 0.0, 0.0, 0.6, 0.0)
SPREAD = (1.0, 1.0, 1.0, 0.1, 0.1, 0.3, 0.1)
SMOOTH = 0.05  # weight of the squared relative difference between neighbouring cells
FLAT = 0.05  # floor of the brightness that scales differences, as a share of the mean radiance
CONVENTION = 0.1  # weight of the mean light's squared relative distance from the convention, per observation
STEP = 0.01  # of finite differences by tilt, roughness and metallic
BLOCK = 1024  # texels per batch
TRIES, INNER = 5, 8  # damping values per step; iterations of the texel solver after it
SETTLED = 1e-3  # relative decrease of the cost that counts as convergence
LEAST_CURVATURE = 1e-7  # added to the diagonal of the light's matrix, relative to its mean
EXCHANGES = 3  # block exchanges without progress before single ones

Values = Float[np.ndarray, "t 7"]


@dataclass(frozen=True)
class Bundle:
    """The constants of the solve: `owner` is each observation's texel, `used` whether its texel has at least
    LEAST_SEEN observations, `free` the number of free unknowns per texel."""

    observed: TexelObservations
    cells: LightCells
    problem: Problem
    owner: Int[np.ndarray, " o"]
    used: Bool[np.ndarray, " o"]
    free: int


@dataclass(frozen=True)
class State:
    """Radiance of the cells, values of the texels, the cost without the light's priors, and the relative residual of
    the pictures."""

    radiance: Radiance
    values: Values
    cost: float
    residual: float


def bundle(
    traced: Tracer,
    observed: TexelObservations,
    normal: Float[np.ndarray, "t 3"],
    cells: LightCells,
    options: Options,
) -> Bundle:
    """The problem with these cells as the environment; `normal` is the geometric normal of the texels."""
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
    return Bundle(observed, cells, problem, owner, used, 7 if options.metallic else 6)


def first_values(bundled: Bundle) -> Values:
    """The start values of the texels, the prior's means: grey, flat and rough."""
    return np.tile(np.array(MEAN, np.float32), (len(bundled.observed.texel), 1))


def texels_under(bundled: Bundle, radiance: Radiance, start: Values, steps: int) -> State:
    """The optimal texels under a given light."""
    _relight(bundled, radiance)
    mean, prior = first_values(bundled), _prior(len(start))
    solution = bundled.problem.solve(start, mean, prior, steps)
    cost = solution.cost + ((solution.values - mean) ** 2 * prior).sum(axis=1)
    seen = bundled.observed.observations.rgb
    residual = (seen - bundled.problem.predict(solution.values))[bundled.used]
    residual = np.sqrt((residual.astype(float) ** 2).sum() / max(float((seen[bundled.used] ** 2).sum()), 1e-30))
    reliable = bundled.observed.seen >= LEAST_SEEN
    return State(radiance, solution.values, float(cost[reliable].sum()), float(residual))


def light_over(bundled: Bundle, radiance: Radiance, values: Values) -> Radiance:
    """The optimal light for fixed texels."""
    matrix, gradient = _system(bundled, radiance, values, follow=False)
    flat = radiance.T.ravel()
    damping = 1e-3 * np.diag(np.diag(matrix))
    full = matrix + damping + _smoothness(bundled.cells, radiance)
    return _least_squares(full, gradient + (matrix + damping) @ flat, radiance)


def solve_light_and_texels(
    bundled: Bundle,
    state: State,
    convention: Callable[[Bundle, State], Float[np.ndarray, "3"]],
    steps: int,
    progress: Callable[[State], None],
) -> State:
    """At most `steps` joint steps; `convention` gives a state's mean radiance under the convention."""
    damping = 1e-2
    weight = CONVENTION * int(bundled.used.sum())
    for _ in range(steps):
        matrix, gradient = _system(bundled, state.radiance, state.values, follow=True)
        smooth, flat = _smoothness(bundled.cells, state.radiance), state.radiance.T.ravel()
        means = _means(bundled.cells, convention(bundled, state))

        def total(at: State, smooth=smooth, means=means) -> float:
            x = at.radiance.T.ravel()
            return at.cost + float(x @ smooth @ x) + weight * float(((means @ x - 1) ** 2).sum())

        before = total(state)
        for _ in range(TRIES):
            damped = damping * np.diag(np.diag(matrix + smooth))
            rhs = gradient + (matrix + damped) @ flat + weight * means.sum(axis=0)
            radiance = _least_squares(matrix + damped + smooth + weight * means.T @ means, rhs, state.radiance)
            tried = texels_under(bundled, radiance, state.values, INNER)
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


def _prior(count: int) -> Values:
    return np.tile(1 / np.array(SPREAD, np.float32) ** 2, (count, 1))


def _relight(bundled: Bundle, radiance: Radiance) -> None:
    irradiance = (radiance * bundled.cells.angle[:, None]).astype(np.float32)
    bundled.problem.relight(np.tile(irradiance, (len(bundled.observed.rig.eye), 1)))


def _system(bundled: Bundle, radiance: Radiance, values: Values, *, follow: bool) -> tuple[np.ndarray, np.ndarray]:
    """Normal matrix and gradient of the light, channel by channel; `follow` eliminates the texels."""
    cells, seen = bundled.cells, bundled.observed.observations
    count, total = len(cells.angle), len(seen.rgb)
    _relight(bundled, radiance)
    linear, constant = light_transport_matrix(bundled.problem, values, total, count)
    linear *= cells.angle.astype(np.float32)
    constant *= cells.angle.astype(np.float32)
    albedo = values[bundled.owner, ALBEDO]
    by_light = [albedo[:, c : c + 1] * linear + constant for c in range(3)]
    residual = seen.rgb - np.stack([by_light[c] @ radiance[:, c] for c in range(3)], axis=1)
    size = np.sqrt(((residual * seen.weight[:, None]) ** 2).sum(axis=1))
    # Huber weights; far from the solution the threshold follows the median residual.
    most = bundled.problem.options.huber * max(1.0, float(np.median(size[bundled.used])) / 1.5)
    weight = seen.weight * np.sqrt(np.minimum(1, most / np.maximum(size, 1e-9)) * bundled.used)
    residual = residual * weight[:, None]
    by_light = [(part * weight[:, None]).astype(np.float32) for part in by_light]
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
    cells, start, prior = len(bundled.cells.angle), bundled.observed.observations.start, np.array(SPREAD) ** -2.0
    seen, free = np.flatnonzero(bundled.observed.seen >= LEAST_SEEN), bundled.free
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
        rhs = rhs - prior[:free] * (values[texel, :free] - np.array(MEAN)[:free])
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


def _smoothness(cells: LightCells, radiance: Radiance) -> Float[np.ndarray, "n n"]:
    """Quadratic form of neighbours' squared differences relative to their brightness: lamps may have sharp edges."""
    bright, count = radiance.mean(axis=1), len(cells.angle)
    i, j = cells.pairs.T
    flat = FLAT * float((bright * cells.angle).sum() / cells.angle.sum())
    weight = SMOOTH / np.maximum((bright[i] + bright[j]) / 2 + flat, 1e-12) ** 2
    one = np.zeros((count, count))
    for a, b, sign in ((i, i, 1), (j, j, 1), (i, j, -1), (j, i, -1)):
        np.add.at(one, (a, b), sign * weight)
    return np.kron(np.eye(3), one)


def _means(cells: LightCells, target: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 n"]:
    """Rows that give each channel's mean radiance relative to `target`."""
    share = cells.angle / cells.angle.sum()
    return np.kron(np.diag(1 / np.maximum(target, 1e-12)), share)


def _least_squares(matrix: np.ndarray, rhs: np.ndarray, near: Radiance) -> Radiance:
    """The x >= 0 that minimises xᵀMx / 2 - xᵀr, as one column per channel; `near` is a guess.

    Block principal pivoting (Júdice and Pires 1994): the signs of x and of its dual decide which entries are zero. It
    needs a Cholesky factor per exchange, and few exchanges from a good guess.
    """
    from scipy.linalg import cho_factor, cho_solve

    size = len(matrix)
    matrix = (matrix + matrix.T) / 2
    level = max(float(np.trace(matrix)) / size, 1e-30)
    matrix[np.diag_indices(size)] += LEAST_CURVATURE * level
    free, x, dual = near.T.ravel() > 0, np.zeros(size), -rhs
    fewest, tries = size + 1, EXCHANGES
    for _ in range(20 * size):
        rows = np.flatnonzero(free)
        x, dual = np.zeros(size), np.zeros(size)
        x[rows] = cho_solve(cho_factor(matrix[np.ix_(rows, rows)], check_finite=False), rhs[rows], check_finite=False)
        dual[~free] = (matrix[:, rows] @ x[rows] - rhs)[~free]
        wrong = np.flatnonzero((free & (x < 0)) | (~free & (dual < -1e-9 * np.abs(rhs).max())))
        if not len(wrong):
            break
        if len(wrong) < fewest:
            fewest, tries = len(wrong), EXCHANGES
        elif tries:
            tries -= 1
        else:
            wrong = wrong[-1:]  # Murty's rule: one exchange at a time ends in any case
        free[wrong] = ~free[wrong]
    return np.maximum(x, 0).reshape(3, -1).T
