"""Light and texels solved together: Gauss-Newton in which every texel follows the light (its Schur complement).

A picture is linear in the light and nearly so in a texel, but each can stand for the other, so that solving them in
turn creeps. With J the derivatives of a texel's observations by its own unknowns and G those by the radiances L of the
cells, the texels' best answer to a step of the light is known, and what is left is a system of the light alone,

    sum over texels of  GᵀG - GᵀJ (JᵀJ + prior)⁻¹ JᵀG,

which is solved for L >= 0 with a prior for smoothness and one for the convention of `unknown_light.py`.
Levenberg's damping keeps each step where it helps.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from mistyle.fitting.light.cells import EnvironmentCells, Radiance
from mistyle.render.deferred.material_table import ALBEDO, ROUGHNESS, TILT
from mistyle.render.mitsuba.draw import Tracer
from mistyle.solver.prior import LEAST_SEEN
from mistyle.solver.texels.gbuffer import open_sky
from mistyle.solver.texels.levenberg_marquardt import Options, Points, Problem, Rig
from mistyle.solver.texels.light_transport import light_transport_matrix
from mistyle.solver.texels.observations import TexelObservations

# Of a texel's unknowns: where they are thought to be, and standard deviations. Tilts are small on the whole, or the
# whole surface would lean towards where the light is residual.
MEAN = (0.5, 0.5, 0.5, 0.0, 0.0, 0.6, 0.0)
SPREAD = (1.0, 1.0, 1.0, 0.1, 0.1, 0.3, 0.1)
SMOOTH = 0.05  # weight of the squared relative difference between neighbouring cells
FLAT = 0.05  # of the mean radiance: differences below it count in full
CONVENTION = 0.1  # weight of the mean light's squared relative distance from the convention, per observation
STEP = 0.01  # of differences by tilt, roughness and metallic
BLOCK = 1024  # texels at once
TRIES, STEPS = 5, 15  # dampings that a step tries; iterations of the texels' solver after it
SETTLED = 1e-3  # relative gain below which nothing more is to be had

Values = Float[np.ndarray, "t 7"]


@dataclass(frozen=True)
class Bundle:
    """Everything that stays while light and texels move: `owner` is each observation's texel, `used` whether its
    texel says something of the light, `free` how many of a texel's unknowns may move."""

    observed: TexelObservations
    cells: EnvironmentCells
    problem: Problem
    owner: Int[np.ndarray, " o"]
    used: Bool[np.ndarray, " o"]
    free: int


@dataclass(frozen=True)
class State:
    """Radiance of the cells, the texels' values, the cost of both without the light's own priors, and the pictures'
    relative residual."""

    radiance: Radiance
    values: Values
    cost: float
    residual: float


def bundle(
    traced: Tracer,
    observed: TexelObservations,
    normal: Float[np.ndarray, "t 3"],
    cells: EnvironmentCells,
    options: Options,
) -> Bundle:
    """The problem with these cells for a sky; `normal` is the texels' geometric one."""
    points, count, number = observed.points, len(cells.angle), len(observed.rig.eye)
    words = open_sky(traced, points.position, normal, cells.direction.astype(np.float32))
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
    problem = Problem(Points(points.position, points.frame, words), rig, observed.observations, options)
    owner = np.repeat(np.arange(len(observed.texel)), observed.seen)
    used = (observed.seen >= LEAST_SEEN)[owner]
    return Bundle(observed, cells, problem, owner, used, 7 if options.metallic else 6)


def first_values(bundled: Bundle) -> Values:
    """Grey, flat and rough: where texels begin."""
    return np.tile(np.array(MEAN, np.float32), (len(bundled.observed.texel), 1))


def texels_under(bundled: Bundle, radiance: Radiance, start: Values, steps: int) -> State:
    """The texels' best answer to a light."""
    _relight(bundled, radiance)
    mean, prior = first_values(bundled), _prior(len(start))
    solution = bundled.problem.solve(start, mean, prior, steps)
    cost = solution.cost + ((solution.values - mean) ** 2 * prior).sum(axis=1)
    seen = bundled.observed.observations.rgb
    residual = (seen - bundled.problem.predict(solution.values))[bundled.used]
    residual = np.sqrt((residual.astype(float) ** 2).sum() / max(float((seen[bundled.used] ** 2).sum()), 1e-30))
    often = bundled.observed.seen >= LEAST_SEEN
    return State(radiance, solution.values, float(cost[often].sum()), float(residual))


def light_over(bundled: Bundle, radiance: Radiance, values: Values) -> Radiance:
    """The light that explains the pictures best with the texels as they are."""
    matrix, gradient = _system(bundled, radiance, values, follow=False)
    flat = radiance.T.ravel()
    held = 1e-3 * np.diag(np.diag(matrix))
    full = matrix + held + _smoothness(bundled.cells, radiance)
    return _least_squares(full, gradient + (matrix + held) @ flat)


def solve_light_and_texels(
    bundled: Bundle,
    state: State,
    convention: Callable[[Bundle, State], Float[np.ndarray, "3"]],
    steps: int,
    progress: Callable[[State], None],
) -> State:
    """At most `steps` steps of both; `convention` says which mean radiance a state would have by it."""
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
            held = damping * np.diag(np.diag(matrix + smooth))
            right = gradient + (matrix + held) @ flat + weight * means.sum(axis=0)
            radiance = _least_squares(matrix + held + smooth + weight * means.T @ means, right)
            tried = texels_under(bundled, radiance, state.values, STEPS)
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
    """Normal matrix and gradient of the light, channel after channel; with `follow` the texels go along with it."""
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
    # Robust, and at first, when nothing fits yet, no more so than the middle one of all.
    most = bundled.problem.options.huber * max(1.0, float(np.median(size[bundled.used])) / 1.5)
    weight = seen.weight * np.sqrt(np.minimum(1, most / np.maximum(size, 1e-9)) * bundled.used)
    residual = residual * weight[:, None]
    by_light = [(part * weight[:, None]).astype(np.float32) for part in by_light]
    matrix, gradient = np.zeros((3 * count, 3 * count)), np.zeros(3 * count)
    for c in range(3):
        # In double precision: what the texels take away later leaves little of it.
        own, part = slice(c * count, (c + 1) * count), by_light[c].astype(float)
        matrix[own, own], gradient[own] = part.T @ part, part.T @ residual[:, c]
    if follow:
        by_texel = _by_texel(bundled, values, [linear @ radiance[:, c] for c in range(3)]) * weight[:, None, None]
        by_texel *= ~_stuck(bundled, values)[bundled.owner, None]
        lost, slope = _followed(bundled, values, by_texel, by_light, residual)
        matrix -= lost
        gradient -= slope
    return matrix, gradient


def _by_texel(bundled: Bundle, values: Values, shine: Sequence[np.ndarray]) -> Float[np.ndarray, "o 3 7"]:
    """Derivatives of the model by the texel's own unknowns: of the albedo as it is, of the rest by differences."""
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


def _stuck(bundled: Bundle, values: Values) -> Bool[np.ndarray, "t 7"]:
    """Unknowns at their bounds, which follow nothing."""
    low, high = np.zeros(7), np.ones(7)
    low[TILT], low[ROUGHNESS] = -1, bundled.problem.options.floor
    return (values < low + 1e-5) | (values > high - 1e-5)


def _followed(
    bundled: Bundle, values: Values, by_texel: np.ndarray, by_light: Sequence[np.ndarray], residual: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """What the texels' own answers take from the light's matrix and gradient."""
    cells, start, prior = len(bundled.cells.angle), bundled.observed.observations.start, np.array(SPREAD) ** -2.0
    seen = np.flatnonzero(bundled.observed.seen >= LEAST_SEEN)
    lost, slope = np.zeros((3 * cells, 3 * cells)), np.zeros(3 * cells)
    for low in range(0, len(seen), BLOCK):
        texel = seen[low : low + BLOCK]
        # Those in between were seen too rarely and weigh nothing: they may be summed along.
        rows = slice(int(start[texel[0]]), int(start[texel[-1] + 1]))
        at = start[texel] - rows.start

        def summed(per_row: np.ndarray, at=at) -> np.ndarray:
            return np.add.reduceat(per_row, at, axis=0)

        own = by_texel[rows]
        normal = summed(np.einsum("oci,ocj->oij", own, own)).astype(float) + np.diag(prior)
        pull = summed(np.einsum("oci,oc->oi", own, residual[rows])) - prior * (values[texel] - np.array(MEAN))
        cross = np.zeros((len(texel), 7, 3 * cells))
        for c in range(3):
            for k in range(bundled.free):
                cross[:, k, c * cells : (c + 1) * cells] = summed(own[:, c, k : k + 1] * by_light[c][rows])
        factor = np.linalg.cholesky(normal)
        half = np.linalg.solve(factor, cross).reshape(-1, 3 * cells)
        lost += half.T @ half
        slope += half.T @ np.linalg.solve(factor, pull[..., None]).ravel()
    return lost, slope


def _smoothness(cells: EnvironmentCells, radiance: Radiance) -> Float[np.ndarray, "n n"]:
    """Squared differences of neighbours relative to how bright they are: lamps have edges, and walls are dim."""
    bright, count = radiance.mean(axis=1), len(cells.angle)
    i, j = cells.pairs.T
    flat = FLAT * float((bright * cells.angle).sum() / cells.angle.sum())
    weight = SMOOTH / np.maximum((bright[i] + bright[j]) / 2 + flat, 1e-12) ** 2
    one = np.zeros((count, count))
    for a, b, sign in ((i, i, 1), (j, j, 1), (i, j, -1), (j, i, -1)):
        np.add.at(one, (a, b), sign * weight)
    return np.kron(np.eye(3), one)


def _means(cells: EnvironmentCells, target: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 n"]:
    """Rows that give each channel's mean radiance relative to `target`."""
    share = cells.angle / cells.angle.sum()
    return np.kron(np.diag(1 / np.maximum(target, 1e-12)), share)


def _least_squares(matrix: np.ndarray, right: np.ndarray) -> Radiance:
    """x >= 0 of least xᵀMx / 2 - xᵀr, channel after channel."""
    from scipy.optimize import nnls

    size = len(matrix)
    matrix = (matrix + matrix.T) / 2
    level = max(float(np.trace(matrix)) / size, 1e-30)
    matrix += max(0.0, 1e-7 * level - float(np.linalg.eigvalsh(matrix)[0])) * np.eye(size)
    factor = np.linalg.cholesky(matrix)
    return nnls(factor.T, np.linalg.solve(factor, right), maxiter=20 * size)[0].reshape(3, -1).T
