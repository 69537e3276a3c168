"""Exposures between the rounds of a recovery: gains that the current maps leave unexplained.

The pictures are rendered with the current maps. Their residual at a sample of the texels, less that of the per-texel
model, is kept as a defect (`texels/rounds.py`), and gains and texels are solved together (`material.py`).
"""

from dataclasses import replace

import numpy as np

from mistyle.solver.context import DirectCaptures
from mistyle.solver.journal import Arrays, Journal
from mistyle.solver.photometry.material import chosen_samples, log_gain, solve_with_material
from mistyle.solver.photometry.record import Gains
from mistyle.solver.schedule import MATCHED
from mistyle.solver.table import scatter_to_atlas
from mistyle.solver.texels.levenberg_marquardt import Options, Problem, Solution
from mistyle.solver.texels.observations import ImageSamples, sample_image
from mistyle.solver.texels.solve import RoundResiduals, TexelLevel

STEPS = 4  # of the gains in a pass
LARGEST = 0.1  # log gain


def exposures_pass(level: TexelLevel, solution: Solution, direct: DirectCaptures, journal: Journal) -> DirectCaptures:
    """The captures with gains at which the texels of `solution` explain them better; mean log gains stay 0. The
    captures are unchanged, with a note, where a gain would exceed LARGEST: then the maps do not explain the pictures.
    """
    seen = replace(direct, captures=level.context.captures)
    arrays = journal.part("exposures", lambda: _solved(level, solution, seen, journal))
    gains, context = Gains(**arrays), level.context
    largest = float(np.abs(gains.gain).max())
    context.trace.setdefault("exposures.largest", []).append(largest)
    if largest > LARGEST:
        note = f"The exposures were not solved with the maps: one would change by {100 * np.expm1(largest):.0f} %."
        context.notes.extend([note] * (note not in context.notes))
        return direct
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
        defect=problem.predict(values) + residual - pictures / np.exp(log_gain(samples, start)).astype(np.float32),
        prior=(values, solution.prior[kept]),
    )
    fit = solve_with_material(samples, problem, start, full=settings.exposures == "full", values=values, steps=STEPS)
    return dict(vars(fit.gains))


def _sampled(
    level: TexelLevel, solution: Solution, direct: DirectCaptures, rows: np.ndarray, journal: Journal
) -> tuple[np.ndarray, np.ndarray]:
    """At the chosen observations: pictures without indirect light at their own gains, and reference minus render."""
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
