"""Rounds of the per-texel solver, with priors from neighbours, and defect correction by rendered pictures.

The solver compares a texel's radiance with the picture at one point, but a pixel is an area mean of interpolated
texels. After each solve the pictures are rendered exactly (`render/deferred/renderer.py`), and their residual is added
to the texels' targets (defect correction): at the fixed point the renders agree with the pictures. Where a texel's
radiance is far from its render, as with highlights narrower than a pixel on varying normals, the correction is
unreliable and the observation's weight falls.
"""

from collections.abc import Callable, Sequence
from dataclasses import fields
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from mistyle.render.deferred.material_table import METALLIC, ROUGHNESS
from mistyle.solver.prior import (
    BLUR,
    PRIOR_SPREAD,
    combine_class_prior,
    log_prior_penalty,
    metal_f0_prior,
    neighbour_weight,
    penalty,
    prior_precision,
    shrink_normals,
    unconstrained_std,
)
from mistyle.solver.schedule import RESTARTS
from mistyle.solver.settings import RecoverSettings
from mistyle.solver.table import OVER_SEAMS, Atlas, Values, neighbourhood, scatter, with_seam_weights
from mistyle.solver.texels.levenberg_marquardt import Problem, Solution
from mistyle.solver.texels.observations import TexelObservations, sample_image, with_extra_std

STARTS = (0.08, 0.25, 0.7)  # roughness has local minima
UNLIKE = 0.3  # share of the correction that is added to an observation's standard deviation

Keep = Callable[[str, Callable[[], Solution]], Solution]


def _unkept(name: str, solve: Callable[[], Solution]) -> Solution:
    """A `Keep` without a journal."""
    return solve()


class SolverRound(NamedTuple):
    """The number of a round, and `keep`, which computes a solution or takes it from a journal by its name."""

    number: int
    keep: Keep = _unkept


def first_solve(
    problem: Problem,
    begin: tuple[Values, Values],
    seen: Int[np.ndarray, " t"],
    settings: RecoverSettings,
    progress: Callable[[float], None],
    keep: Keep = _unkept,
) -> Solution:
    """The best of several starts: `begin`'s first, and every roughness of a coarse grid, as dielectric and as metal.

    `begin` is (start, prior mean).
    """
    start, mean = begin
    prior = np.tile(1 / np.array(PRIOR_SPREAD, np.float32) ** 2, (len(mean), 1)).astype(np.float32)
    tries = [(start, mean, prior)]
    for metal in (0.0, 1.0) if settings.metallic else (None,):
        for roughness in STARTS:
            guess, around, weight = mean.copy(), mean.copy(), prior
            guess[:, ROUGHNESS] = roughness
            if metal is not None:
                guess[:, METALLIC], around[:, METALLIC] = abs(metal - 0.1), metal
                around, weight, _ = metal_f0_prior(around, prior, np.full(len(mean), metal, np.float32))
            tries.append((guess, around, weight))
    tries = tries if not np.array_equal(start, mean) else tries[1:]
    solved = []
    for k, (each, around, weight) in enumerate(tries):
        done = lambda share, k=k: progress((k + share) / len(tries))  # noqa: E731
        arguments = each, around, weight, settings.solver_iterations, done
        solution = keep(f"start{k}", lambda given=arguments: problem.solve(*given))
        extra = log_prior_penalty(solution.values, seen) if settings.metallic else 0
        solved.append((solution, penalty(solution.values, around, weight) + extra))
    return best(solved)


def another_round(
    problem: Problem,
    observed: TexelObservations,
    atlas: Atlas,
    solution: Solution,
    residuals: Callable[[int], np.ndarray],
    settings: RecoverSettings,
    current: SolverRound,
) -> Solution:
    """Solve again for targets corrected by `residuals(k)`, reference minus render of picture k for `solution`.
    `observed` holds the references and their weights.

    Each texel's prior is the precision-weighted mean of its neighbours; its strength is estimated (`prior_precision`).
    """
    target = problem.predict(solution.values)
    if len(target) < len(observed.observations.rgb):
        target = np.pad(target, ((0, len(observed.observations.rgb) - len(target)), (0, 0)))
    for k, samples in enumerate(observed.per_image):
        if len(samples.rows):
            target[samples.rows] += sample_image(residuals(k), samples)
    problem.retarget(target)
    apart = np.abs(target - observed.observations.rgb).max(axis=1)
    problem.reweight(with_extra_std(observed.observations.weight, UNLIKE * apart))
    atlas = with_seam_weights(
        atlas, *(scatter(v, observed, atlas, 0) for v in (solution.values, unconstrained_std(solution, observed)))
    )
    mean = neighbourhood(solution.values, neighbour_weight(solution, observed), observed, atlas, BLUR, OVER_SEAMS)
    prior = prior_precision(solution, mean, observed, atlas, settings.neighbours)
    mean, prior = shrink_normals(solution, mean, prior, observed, atlas)

    def tried(start: Values, steps: int, metal: Float[np.ndarray, " t"]) -> tuple[Solution, Float[np.ndarray, " t"]]:
        name = f"try{len(solved)}"
        if not settings.metallic:
            one = current.keep(name, lambda: problem.solve(start, mean, prior, steps))
            return one, penalty(one.values, mean, prior)
        around, weight, constant = combine_class_prior(mean, prior, metal)
        one = current.keep(name, lambda: problem.solve(start, around, weight, steps))
        return one, penalty(one.values, around, weight) + constant + log_prior_penalty(one.values, observed.seen)

    solved: list[tuple[Solution, np.ndarray]] = []
    solved.append(tried(solution.values, 5, _is_metal(solution.values)))
    if current.number < RESTARTS:
        for roughness in (None, 0.15, 0.4, 0.8):
            guess = mean.copy()
            if roughness is not None:
                guess[:, ROUGHNESS] = roughness
            solved.append(tried(guess, 8, _is_metal(mean)))
    return best(solved)


def best(solutions: Sequence[tuple[Solution, Float[np.ndarray, " t"]]]) -> Solution:
    """Per texel the solution of least cost plus penalty; the first of equals."""
    result, least = solutions[0][0], solutions[0][0].cost + solutions[0][1]
    for candidate, extra in solutions[1:]:
        cost = candidate.cost + extra
        better = cost < least
        least = np.where(better, cost, least)
        names = [f.name for f in fields(Solution)]
        result = Solution(**{n: _select(better, getattr(candidate, n), getattr(result, n)) for n in names})
    return result


def _select(choice: Bool[np.ndarray, " t"], a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.where(choice.reshape(-1, *[1] * (a.ndim - 1)), a, b)


def _is_metal(values: Values) -> Float[np.ndarray, " t"]:
    """1 for metal, 0 for dielectric."""
    return (values[:, METALLIC] > 0.5).astype(np.float32)
