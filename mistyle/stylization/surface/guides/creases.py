"""Detail guide from the shape's lines at stroke scale: creases and borders of parts dark, ridges light."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from mistyle.stylization.surface.samples import Level, carry, drop, smooth

LEAST_RELIEF = 0.03  # least mean height of a 5x5 neighbourhood, in spacings, at a full hollow or ridge
NARROW = 0.7  # subtracted share of the broader relief: bands become lines
SALIENT = (82, 98)  # percentiles of line strength of weight 0 and 1
LEAST_LINE = 0.08  # least strength of weight 1: a smooth ball has no lines
CREASE, RIDGE = -1.6, 0.7  # detail at lines of weight 1


def cavity_of(level: Level) -> Float[np.ndarray, " n"]:
    """Mean height of the neighbourhood over the tangent plane, in spacings: positive in hollows."""
    height = np.zeros(len(level.directed), np.float32)
    positions, normals = level.points.positions, level.points.normals
    own = (positions * normals).sum(axis=1)
    for k in range(level.neighbours.shape[1]):
        height += (positions[level.neighbours[:, k]] * normals).sum(axis=1) - own
    return height / np.float32(level.neighbours.shape[1] * level.points.spacing)


def bounded(values: Float[np.ndarray, " n"], share: float, least: float, limit: float) -> Float[np.ndarray, " n"]:
    """Values divided by the percentile `share` of their magnitude (at least `least`), clamped to +-limit."""
    return np.clip(values / max(float(np.percentile(np.abs(values), share)), least), -limit, limit)


def creases(levels: Sequence[Level]) -> list[Float[np.ndarray, " _"]]:
    """Detail -1.6 (a crease) .. 0.7 (a ridge) of every level, 0 on most of the surface.

    The relief at two scales minus a broader one; the strongest tenth of the surface gets strokes. It does not
    distinguish an eye from a dent; a scan that is rough everywhere gets lines at its deepest places.
    """
    fine, middle, coarse = levels[-1], levels[max(len(levels) - 2, 0)], levels[max(len(levels) - 3, 0)]
    narrow = bounded(smooth(middle, cavity_of(middle), 1), 99, LEAST_RELIEF, 1)
    broad = carry(coarse.points, smooth(coarse, cavity_of(coarse), 1), middle.points)
    relief = (narrow + bounded(broad, 99, LEAST_RELIEF, 1)) / 2
    around = smooth(coarse, drop(middle.points, smooth(middle, relief, 1), coarse.points), 1)
    line = relief - np.float32(NARROW) * carry(coarse.points, around, middle.points)
    lines = CREASE * salient(np.maximum(line, 0)) + RIDGE * salient(np.maximum(-line, 0))
    finest = carry(middle.points, lines.astype(np.float32), fine.points)
    softened = smooth(fine, finest, 1)
    return [drop(fine.points, softened, level.points) for level in levels[:-1]] + [finest]


def salient(strength: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """0..1: 0 below the first of SALIENT's percentiles, 1 from the second on."""
    low, high = (float(np.percentile(strength, share)) for share in SALIENT)
    return np.clip((strength - low) / max(max(high, LEAST_LINE) - low, 1e-6), 0, 1)
