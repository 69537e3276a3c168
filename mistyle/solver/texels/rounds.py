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
from jaxtyping import Bool, Float

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
from mistyle.solver.schedule import CLASS_ROUNDS, RESTARTS
from mistyle.solver.settings import RecoverSettings
from mistyle.solver.table import OVER_SEAMS, PRIOR_MEAN, Atlas, Values, neighbourhood, scatter, with_seam_weights
from mistyle.solver.texels.classes import apparent_albedo, metal_regions
from mistyle.solver.texels.levenberg_marquardt import Problem, Solution
from mistyle.solver.texels.observations import TexelObservations, sample_image, with_extra_std

STARTS = (0.08, 0.25, 0.7)  # roughness has local minima
CLASSES = (0.0, 1.0)  # metallic of dielectrics and metals
LEAST_SHARE = 0.02  # of a class around a texel: below it, its neighbours give no prior as that class
NEVER = 1e9  # cost of a solution of the other class
UNLIKE = 0.3  # share of the correction that is added to an observation's standard deviation

Candidate = tuple[Solution, Float[np.ndarray, " t"]]  # a solution, and its cost beyond the observations'
Keep = Callable[[str, Callable[[], Solution]], Solution]


def _unkept(name: str, solve: Callable[[], Solution]) -> Solution:
    """A `Keep` without a journal."""
    return solve()


class SolverRound(NamedTuple):
    """`since`, the number of a round as `schedule.rounds_since` counts it, and `keep`, which computes a solution or
    takes it from a journal by its name."""

    since: int
    keep: Keep = _unkept


def first_solve(
    problem: Problem,
    begin: tuple[Values, Values],
    observed: TexelObservations,
    atlas: Atlas,
    settings: RecoverSettings,
    progress: Callable[[float], None],
    keep: Keep = _unkept,
) -> Solution:
    """The best of several starts: `begin`'s first, and every roughness of a coarse grid, as dielectric and as metal.

    `begin` is (start, prior mean). With `metallic` the class is decided by regions (`classes.py`).
    """
    start, mean = begin
    prior = np.tile(1 / np.array(PRIOR_SPREAD, np.float32) ** 2, (len(mean), 1)).astype(np.float32)
    tries = [(start, mean, prior)] if not np.array_equal(start, mean) else []
    for metal in CLASSES if settings.metallic else (None,):
        for roughness in STARTS:
            guess, around, weight = mean.copy(), mean.copy(), prior
            guess[:, ROUGHNESS] = roughness
            if metal is not None:
                guess[:, METALLIC], around[:, METALLIC] = abs(metal - 0.1), metal
                around, weight, _ = metal_f0_prior(around, prior, np.full(len(mean), metal, np.float32))
            tries.append((guess, around, weight))
    solved = []
    for k, (each, around, weight) in enumerate(tries):
        done = lambda share, k=k: progress((k + share) / len(tries))  # noqa: E731
        arguments = each, around, weight, settings.solver_iterations, done
        solution = keep(f"start{k}", lambda given=arguments: problem.solve(*given))
        extra = log_prior_penalty(solution.values, observed.seen, settings.black_gloss) if settings.metallic else 0
        solved.append((solution, penalty(solution.values, around, weight) + extra))
    return best_by_region(problem, solved, observed, atlas) if settings.metallic else best(solved)[0]


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

    near, kept = (mean, prior), None
    if settings.metallic and current.since < CLASS_ROUNDS:
        candidates = []
        for metal in CLASSES:
            around = _class_neighbours(solution, near, metal, observed, atlas)
            own = np.where((_is_metal(solution.values) == metal)[:, None], solution.values, around[0])
            labels = np.full(len(own), metal, np.float32)
            keep = lambda name, solve, metal=metal: current.keep(f"{name}_class{metal:.0f}", solve)  # noqa: E731
            candidates += _tries((problem, keep, settings), own, around, labels, observed, True)
        return best_by_region(problem, candidates, observed, atlas)
    if settings.metallic:
        kept = _is_metal(solution.values)
    restart = current.since < RESTARTS and not settings.metallic
    return best(_tries((problem, current.keep, settings), solution.values, near, kept, observed, restart))[0]


def _tries(
    solver: tuple[Problem, Keep, RecoverSettings],
    own: Values,
    near: tuple[Values, Values],
    metal: Float[np.ndarray, " t"] | None,
    observed: TexelObservations,
    restart: bool,
) -> list[Candidate]:
    """Solutions from a texel's `own` values and, with `restart`, from its neighbours' mean with several roughnesses.

    `near` is (mean, precision) of the prior from neighbours; `metal` the class of each texel, None if metallic is not
    fitted.
    """
    starts = [(own, 5)]
    for roughness in (None, 0.15, 0.4, 0.8) if restart else ():
        guess = near[0].copy()
        if roughness is not None:
            guess[:, ROUGHNESS] = roughness
        starts.append((guess, 8))
    around, weight, constant = (*near, 0) if metal is None else combine_class_prior(*near, metal)
    problem, keep, settings = solver
    solved = []
    for k, (start, steps) in enumerate(starts):
        solution = keep(f"try{k}", lambda begin=start, steps=steps: problem.solve(begin, around, weight, steps))
        extra = penalty(solution.values, around, weight) + constant
        if metal is not None:
            extra = extra + log_prior_penalty(solution.values, observed.seen, settings.black_gloss)
        solved.append((solution, extra))
    return solved


def _class_neighbours(
    solution: Solution, near: tuple[Values, Values], metal: float, observed: TexelObservations, atlas: Atlas
) -> tuple[Values, Values]:
    """Prior of a texel as one of a class: its neighbours of that class; where it has none, a typical surface of the
    class with the wide prior."""
    mean, prior = (values.copy() for values in near)
    same = (_is_metal(solution.values) == metal).astype(np.float32)[:, None]
    weight = neighbour_weight(solution, observed) * same
    own = neighbourhood(solution.values, weight, observed, atlas, BLUR, OVER_SEAMS)
    share = neighbourhood(same, np.ones_like(same), observed, atlas, BLUR)
    among = (share > LEAST_SHARE)[:, 0]
    columns = [0, 1, 2, ROUGHNESS]
    mean[:, columns] = np.where(among[:, None], own, np.array(PRIOR_MEAN, np.float32))[:, columns]
    wide = 1 / np.array(PRIOR_SPREAD, np.float32) ** 2
    prior[:, columns] = np.where(among[:, None], prior, wide)[:, columns]
    mean[:, METALLIC] = metal
    return mean, prior


def best_by_region(
    problem: Problem, solved: Sequence[Candidate], observed: TexelObservations, atlas: Atlas
) -> Solution:
    """The best solution of each texel among those of its region's class."""
    classes = [[(s, np.where(_is_metal(s.values) == m, extra, NEVER)) for s, extra in solved] for m in CLASSES]
    (dielectric, as_dielectric), (metal, as_metal) = map(best, classes)
    evidence = as_dielectric - as_metal
    chosen = metal_regions(evidence, apparent_albedo(problem, observed), observed.texel, atlas)
    return chosen_of(chosen, metal, dielectric)


def best(solutions: Sequence[Candidate]) -> Candidate:
    """Per texel the solution of least cost plus penalty, the first of equals; and that sum."""
    result, least = solutions[0][0], solutions[0][0].cost + solutions[0][1]
    for candidate, extra in solutions[1:]:
        cost = candidate.cost + extra
        better = cost < least
        least = np.where(better, cost, least)
        result = chosen_of(better, candidate, result)
    return result, least


def chosen_of(choice: Bool[np.ndarray, " t"], a: Solution, b: Solution) -> Solution:
    """Solution `a` where `choice`, else `b`."""
    pairs = {f.name: (getattr(a, f.name), getattr(b, f.name)) for f in fields(Solution)}
    return Solution(**{n: np.where(choice.reshape(-1, *[1] * (x.ndim - 1)), x, y) for n, (x, y) in pairs.items()})


def _is_metal(values: Values) -> Float[np.ndarray, " t"]:
    """1 for metal, 0 for dielectric."""
    return (values[:, METALLIC] > 0.5).astype(np.float32)
