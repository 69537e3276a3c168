"""Which gains of a set of pictures a material explains best, under known light.

Three candidates are compared with the same material model (`material.py`): the pictures as photographed, the gains that
points alone gave (`solve.py`), and those solved together with the material. Points alone fail on metals and dark gloss,
where a highlight that moves looks like an exposure.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from mistyle.core.capture import Captures
from mistyle.render.mitsuba.draw import Tracer
from mistyle.solver.photometry.material import (
    MaterialFit,
    fixed_gains,
    material_samples,
    problem_of,
    solve_with_material,
)
from mistyle.solver.photometry.record import Gains, Photometry, with_gains
from mistyle.solver.photometry.solve import AGREE, LOWER
from mistyle.solver.texels.levenberg_marquardt import Options


@dataclass(frozen=True)
class Explained:
    """The photometry, the gains by which the captures still have to be divided, and whether these were solved with the
    material."""

    photometry: Photometry
    gains: Gains
    solved: bool


def explained(
    traced: Tracer,
    captures: Captures,
    found: Photometry,
    tangents: Float[np.ndarray, "f 3 4"] | None,
    options: Options,
    *,
    full: bool = True,
    start: Gains | None = None,
    progress: Callable[[float], None] = lambda done: None,
) -> Explained:
    """The photometry that a material explains best.

    `captures` are those of `corrected` for `found`, under known light; `start` are gains to begin at. Metallic is free
    whatever is fitted later. Nothing is corrected where the gains do not lower the difference between pictures and
    model to LOWER of that of the pictures as photographed.
    """
    samples = material_samples(traced, captures, tangents, progress=lambda done: progress(0.3 * done))
    problem, n = problem_of(samples, replace(options, metallic=True)), len(captures)
    none = Gains(np.zeros((n, 3)), np.zeros(3))
    veiled = bool(np.abs(found.veil).max() > 0)
    raw = none
    if found.applied and not veiled:
        raw = Gains(-(found.exposure[:, None] + found.balance), -found.vignetting)
    points = fixed_gains(samples, problem, none)
    plain = points if raw is none else fixed_gains(samples, problem, raw)
    progress(0.5)
    if start is None:
        start = raw if plain.cost < points.cost else none
    fit = solve_with_material(samples, problem, start, full=full)
    progress(1.0)
    chosen = min((fit, points), key=lambda each: each.spread)
    agree = not veiled and (chosen.spread > LOWER * plain.spread or _small(chosen, raw))
    if agree:
        note = "Photometry: different exposures do not explain the pictures better; nothing was corrected."
        chosen = plain
    else:
        note = _note(plain, points, fit)
    result = with_gains(found, chosen.gains, (plain.spread, chosen.spread), not agree)
    return Explained(replace(result, notes=(note,)), chosen.gains, chosen is fit)


def _small(fit: MaterialFit, raw: Gains) -> bool:
    """Whether a fit's gains differ from those as photographed by less than AGREE."""
    gain, corner = fit.gains.gain - raw.gain, (fit.gains.vignetting - raw.vignetting).sum()
    return max(float(np.abs(gain).max()), abs(float(corner))) < AGREE


def _note(plain: MaterialFit, points: MaterialFit, fit: MaterialFit) -> str:
    values = [f"{100 * each.spread:.1f} %" for each in (plain, points, fit)]
    kept = "solved with it" if fit.spread <= points.spread else "of points alone"
    return (
        f"Photometry: a material differs from the pictures by {values[0]} as photographed, by {values[1]} at the "
        f"exposures of points alone and by {values[2]} at those solved with it; those {kept} are used."
    )
