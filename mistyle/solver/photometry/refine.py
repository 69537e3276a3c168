"""Exposures between the rounds of a recovery: gains that the current maps leave unexplained.

The pictures are rendered with the current maps. Their residual at a sample of the texels, less that of the per-texel
model, is kept as a defect (`texels/rounds.py`), and gains and texels are solved together (`material.py`).
"""

from dataclasses import replace

import numpy as np

from mistyle.solver.context import DirectCaptures
from mistyle.solver.journal import Arrays, Journal
from mistyle.solver.photometry.material import MaterialSamples, chosen_samples, solve_with_material
from mistyle.solver.photometry.record import Gains
from mistyle.solver.schedule import MATCHED
from mistyle.solver.table import scatter_to_atlas
from mistyle.solver.texels.levenberg_marquardt import Options, Problem, Solution
from mistyle.solver.texels.observations import ImageSamples, sample_image
from mistyle.solver.texels.solve import RoundResiduals, TexelLevel

STEPS = 4  # of the gains in a pass


def exposures_pass(level: TexelLevel, solution: Solution, direct: DirectCaptures, journal: Journal) -> DirectCaptures:
    """The captures with gains at which the texels of `solution` explain them better; mean log gains stay 0."""
    arrays = journal.part("exposures", lambda: _solved(level, solution, direct, journal))
    gains = Gains(**arrays)
    before = np.zeros_like(gains.gain) if direct.gains is None else direct.gains.gain
    moved = float(np.abs(np.expm1(gains.gain - before)).max())
    level.context.trace.setdefault("exposures.moved", []).append(moved)
    return replace(direct, gains=gains)


def _solved(level: TexelLevel, solution: Solution, direct: DirectCaptures, journal: Journal) -> Arrays:
    context, settings = level.context, level.context.settings
    cameras = context.captures.cameras
    samples, kept, rows = chosen_samples(
        level.observed, cameras, (settings.noise, settings.relative), MATCHED, context.seed
    )
    n = len(cameras)
    start = Gains(np.zeros((n, 3)), np.zeros(3)) if direct.gains is None else direct.gains
    if not len(rows):
        return dict(vars(start))
    options = Options(settings.model, settings.metallic, floor=settings.roughness_floor)
    problem = Problem(samples.points, samples.rig, samples.observations, options)
    values = solution.values[kept]
    pictures, residual = _sampled(level, solution, direct, rows, journal)
    # At `values` and the gains of `direct` the model's residual is that of the render.
    samples = replace(
        samples,
        observations=replace(samples.observations, rgb=pictures),
        defect=problem.predict(values) + residual - _corrected(samples, pictures, start),
        prior=(values, solution.prior[kept]),
    )
    fit = solve_with_material(
        samples, problem, start, full=settings.exposures == "full", values=values, steps=STEPS
    )
    return dict(vars(fit.gains))


def _corrected(samples: MaterialSamples, pictures: np.ndarray, gains: Gains) -> np.ndarray:
    from mistyle.solver.photometry.material import log_gain

    return (pictures / np.exp(log_gain(samples, gains))).astype(np.float32)


def _sampled(
    level: TexelLevel, solution: Solution, direct: DirectCaptures, rows: np.ndarray, journal: Journal
) -> tuple[np.ndarray, np.ndarray]:
    """At the chosen observations: the pictures without indirect light at their own gains, and reference minus render.
    """
    observed = level.observed
    table = scatter_to_atlas(solution.values, observed, level.context.atlas)
    residuals = RoundResiduals(direct, level.renderer, level.renderer.upload(table), [], journal)
    number = np.full(len(observed.observations.rgb), -1, np.int64)
    number[rows] = np.arange(len(rows))
    pictures, residual = np.zeros((len(rows), 3), np.float32), np.zeros((len(rows), 3), np.float32)
    for k, at in enumerate(observed.per_image):
        own = number[at.rows]
        chosen = own >= 0
        if not chosen.any():
            continue
        some = ImageSamples(own[chosen], at.pixel[chosen], at.x[chosen], at.y[chosen])
        residual[some.rows] = sample_image(residuals(k), some)
        rgb = np.nan_to_num(direct.load(k)[0])
        if direct.gains is not None:
            rgb = rgb * direct.gains.factor(k, direct.captures.cameras[k])
        pictures[some.rows] = sample_image(rgb.astype(np.float32), some)
    return pictures, residual
