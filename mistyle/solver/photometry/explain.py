"""Which gains of a set of pictures a material explains best, under known light.

Three candidates are compared with the same material model (`material.py`): the pictures as photographed, the gains that
points alone gave (`solve.py`), and those solved together with the material. Points alone fail on metals and dark gloss,
where a highlight that moves looks like an exposure.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from mistyle.solver.photometry.material import (
    MatchedMaterial,
    MaterialSamples,
    fixed_gains,
    solve_with_material,
)
from mistyle.solver.photometry.record import Gains, Photometry, with_gains, without_gains
from mistyle.solver.photometry.solve import AGREE, LOWER
from mistyle.solver.texels.levenberg_marquardt import Options, Problem

FIXED = 0.1  # of the time: the texels at given gains
EXPLAINED = 0.05  # difference up to which a material without a veil shows that the veil was gloss


def worth_explaining(found: Photometry) -> bool:
    """False where points found a veil and still differ by far: photographs with clutter and lens flare."""
    return not _veiled(found) or found.spread[1] < 2 * EXPLAINED


def explained(
    samples: MaterialSamples,
    found: Photometry,
    options: Options,
    *,
    full: bool = True,
    start: Gains | None = None,
    progress: Callable[[float], None] = lambda done: None,
) -> tuple[Photometry, bool]:
    """The photometry that a material explains best, and whether it was solved with the material.

    `samples` are of the pictures as photographed, under known light; `start` are gains to begin at. Metallic is free
    whatever is fitted later. Nothing is corrected where the gains make no picture's difference from the model smaller,
    by AGREE and to LOWER of that as photographed: errors of the model (indirect light) pass for gains of some percent
    and lower it by up to 0.008. A veil of `found` stays unless a material explains the pictures without.
    """
    n, options = samples.pictures, replace(options, metallic=True)
    problem = Problem(samples.points, samples.rig, samples.observations, options)
    none = Gains(np.zeros((n, 3)), np.zeros(3))
    plain = fixed_gains(samples, problem, none)
    progress(FIXED)
    points = fixed_gains(samples, problem, found.gains) if found.applied else plain
    if start is None:
        start = min((plain, points), key=lambda each: each.cost).gains
    progress(2 * FIXED)
    fit = solve_with_material(
        samples, problem, start, full=full, progress=lambda done: progress(2 * FIXED + (1 - 2 * FIXED) * done)
    )
    veiled = _veiled(found)
    if veiled and fit.spread > EXPLAINED:
        return found, False
    chosen = fit if veiled else min((fit, points), key=lambda each: each.spread)
    bare = without_gains(found)
    better = (chosen.spreads < LOWER * plain.spreads) & (chosen.spreads < plain.spreads - AGREE)
    if not better.any() or _small(chosen.gains):
        note = "Photometry: different exposures do not explain the pictures better; nothing was corrected."
        return replace(bare, spread=(plain.spread, plain.spread), notes=(note,)), False
    result = with_gains(bare, chosen.gains, (plain.spread, chosen.spread))
    return replace(result, notes=(_note(plain, points, fit, chosen is fit),)), chosen is fit


def _veiled(found: Photometry) -> bool:
    return bool(np.abs(found.veil).max() > 0)


def _small(gains: Gains) -> bool:
    """Whether all gains are below AGREE."""
    return max(float(np.abs(gains.gain).max()), abs(gains.edge[1])) < AGREE


def _note(plain: MatchedMaterial, points: MatchedMaterial, fit: MatchedMaterial, solved: bool) -> str:
    values = [f"{100 * each.spread:.1f} %" for each in (plain, points, fit)]
    kept = "solved with it" if solved else "of points alone"
    return (
        f"Photometry: a material differs from the pictures by {values[0]} as photographed, by {values[1]} at the "
        f"exposures of points alone and by {values[2]} at those solved with it; those {kept} are used."
    )
