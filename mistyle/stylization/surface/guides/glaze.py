"""Glaze: a smooth lightness correction over the synthesised strokes.

The synthesis copies strokes unchanged, so some places are lighter or darker than the detail guide. The difference in
the band between strokes and large areas is added to the lightness. Strokes are finer, so they keep their contrast and
hue.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from mistyle.stylization.surface.exemplar import exemplar as style
from mistyle.stylization.surface.guides.guides import Guide
from mistyle.stylization.surface.samples import Level, carry, drop, smooth
from mistyle.stylization.surface.settings import PlainSettings

THICKEST = 0.12  # largest change of lightness (Lab / 100)


def glaze(
    levels: Sequence[Level],
    guide: Guide,
    lightness: Float[np.ndarray, " n"],
    exemplar: style.Exemplar,
    settings: PlainSettings,
) -> Float[np.ndarray, " n"]:
    """The offset of the finest level's `lightness` (Lab / 100); zero for paintings of two tones.

    It is the detail guide's target lightness against the surroundings, minus the same band of the samples' lightness.
    """
    strength = settings.glaze * style.middle_tones(exemplar.lab[:, 0])
    fine = levels[-1]
    if strength == 0 or len(levels) < 3:
        return np.zeros(len(fine.directed), np.float32)
    shown = band(levels, lightness)
    target = guide.detail * np.float32(settings.relief * exemplar.band.std())
    certainty = np.minimum(np.abs(guide.detail), 1).astype(np.float32)
    missing = np.float32(strength) * certainty * (target - shown)
    return smooth(fine, np.clip(missing, -THICKEST, THICKEST), 2)


def band(levels: Sequence[Level], values: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Band-pass of the finest level's values between strokes and large areas, like the detail guide's."""
    fine, middle, coarse = levels[-1], levels[-2], levels[-3]
    sharp = smooth(fine, values, 2)
    medium = smooth(middle, drop(fine.points, sharp, middle.points), 2)
    broad = smooth(coarse, drop(middle.points, smooth(middle, medium, 2), coarse.points), 2)
    return sharp - carry(coarse.points, broad, fine.points)
