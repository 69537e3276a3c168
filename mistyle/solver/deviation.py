"""Standard deviations that a fit states with its maps.

The solver's posterior is no measure of a map's error: its prior ties neighbours closely, and neighbours share what is
ambiguous. (Off its highlight a smooth metal looks like a rough one of lower F0.) Stated instead are

1. `open_std`: what a texel's own observations leave open. The tilts' prior is estimated from the surface, so it and
   their neighbours count too.
2. The change by Adam on whole pictures where no joint steps follow: two estimates of one truth, from different
   approximations of light and pixels, differ by their errors. Stated is the root of the mean of both squares.
3. Metallic is 0 or 1. Up to the class, its error is known: its distance from the nearer of both (`class_std`).
"""

import numpy as np
from jaxtyping import Bool, Float

from mistyle.render.deferred.material_table import METALLIC, TILT
from mistyle.solver.prior import BLUR, PRIOR_SPREAD, misfit_scale
from mistyle.solver.table import OVER_SEAMS, Atlas, Values, diffused, neighbourhood
from mistyle.solver.texels.levenberg_marquardt import Problem, Solution
from mistyle.solver.texels.observations import TexelObservations

BINARY = 0.5  # standard deviation of a metallic that is 0 or 1 with equal odds
WITHIN = 0.683  # share of a normal distribution within its standard deviation
AROUND = 24  # diffusion steps of the distance of metallic from its class


def open_std(problem: Problem, solution: Solution, observed: TexelObservations, atlas: Atlas, joint: bool) -> Values:
    """Standard deviations of the solution, all unknowns of a texel free within PRIOR_SPREAD, scaled by the local
    misfit. Replaces the problem's targets and weights.

    The normal matrix is that of the pictures' own weights at zero residuals. The solution's has the weights of the last
    round; the ratio of the two diagonals brings it to these. The rounds correct targets by renders, so a good fit hides
    errors of the pixels' areas, which turn normals most: the tilts' scale is at least 1 unless `joint` steps follow.
    """
    widest = np.array(PRIOR_SPREAD, np.float32)
    widest[METALLIC] = BINARY
    prior = np.tile(1 / widest**2, (len(solution.values), 1))
    problem.retarget(problem.predict(solution.values))
    problem.reweight(observed.observations.weight)
    alone = problem.solve(solution.values, solution.values, prior, 0)
    lost = np.maximum(alone.diagonal / np.maximum(solution.diagonal, 1e-12), 1)
    scale = misfit_scale(solution, observed, atlas)[:, None]
    variance = alone.spread**2 * lost * scale
    if not joint:
        variance[:, TILT] /= np.minimum(scale, 1)
    variance = np.minimum(variance, widest**2)
    variance = np.where((observed.seen > 0)[:, None] & np.isfinite(variance), variance, widest**2)
    sure = 1 / variance[:, TILT]
    around = neighbourhood(sure, np.ones_like(sure), observed, atlas, BLUR, OVER_SEAMS[TILT])
    variance[:, TILT] = 1 / (sure + 1 / (1 / solution.prior[:, TILT] + 1 / around))
    return np.sqrt(variance).astype(np.float32)


def class_std(
    metallic: Float[np.ndarray, " a"], std: Float[np.ndarray, " a"], known: Bool[np.ndarray, " a"], atlas: Atlas
) -> Float[np.ndarray, " a"]:
    """Deviation of metallic from its class: the mean distance around a texel, times one factor for all. Within it lies
    WITHIN of the surface, texels of the wrong class counted as beyond; their share follows from `std`, the deviation of
    metallic without the class."""
    from scipy.special import ndtr

    away = np.abs(metallic - np.round(metallic))
    sums = np.where(known[:, None], np.stack([away, np.ones_like(away)], axis=1), 0).astype(np.float32)
    for part, size, among in zip(atlas.parts, atlas.sizes, atlas.links, strict=True):
        sums[part] = diffused(sums[part].reshape(1, *size, 2), among, AROUND).reshape(-1, 2)
    around = np.where(sums[:, 1] > 1e-9, sums[:, 0] / np.maximum(sums[:, 1], 1e-9), std)
    if not known.any():
        return around.astype(np.float32)
    wrong = float(ndtr(-np.abs(metallic - 0.5) / np.maximum(std, 1e-6))[known].mean())
    factor = np.quantile((away / np.maximum(around, 1e-9))[known], min(WITHIN / (1 - wrong), 1))
    return (factor * around).astype(np.float32)
