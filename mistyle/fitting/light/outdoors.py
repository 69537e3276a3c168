"""A sun beside the cells of an unknown light.

The cells of `cells.py` are too wide for the borders of shadows, and a shadow that the light does not explain ends up in
the albedo. The sun is one more cell, of SUN steradian and without neighbours. Its direction is the one whose shading
and shadows explain most of the differences between neighbouring texels, whose albedo is more often alike than not.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import KDTree

from mistyle.core.image import luminance
from mistyle.core.light import Directional
from mistyle.fitting.light.cells import LightCells
from mistyle.render.deferred.sky import even_directions
from mistyle.render.mitsuba.draw import Tracer
from mistyle.solver.texels.gbuffer import open_sky
from mistyle.solver.texels.observations import TexelObservations

SUN = 0.01  # solid angle of the sun's cell, sr: 3° in radius, so that the system stays well conditioned
DIRECTIONS = 512  # candidates over the sphere
STRENGTHS = (0.5, 1.0, 2.0, 4.0)  # irradiance of a facing surface over that of the sky
NEIGHBOURS = 6  # of a texel
AGAINST = 0.9  # largest share of the differences that a sun may leave


@dataclass(frozen=True)
class Sun:
    """Unit direction towards the sun, and the share of neighbouring texels' differences that it leaves, 0..1."""

    direction: Float[np.ndarray, "3"]
    left: float


def find_sun(traced: Tracer, observed: TexelObservations, normal: Float[np.ndarray, "t 3"]) -> Sun | None:
    """The direction that explains most; None where none leaves less than AGAINST of the differences."""
    radiance = mean_radiance(observed)
    position = observed.points.position
    seen = (observed.seen > 0) & (radiance.min(axis=1) > 0)
    pairs = _pairs(position, normal, np.flatnonzero(seen))
    step = np.log(np.maximum(luminance(radiance.astype(np.float32)), 1e-6)).astype(float)
    differences = step[pairs[:, 0]] - step[pairs[:, 1]]
    best: Sun | None = None
    directions = even_directions(DIRECTIONS).astype(np.float32)
    bits = open_sky(traced, position, normal, directions)
    nothing = float(np.abs(differences).mean())
    for k, direction in enumerate(directions.astype(float)):
        free = (bits[:, k // 32] >> np.uint32(k % 32)) & 1
        facing = np.maximum(normal @ direction, 0) * free
        if facing[seen].max(initial=0) < 0.1:
            continue
        for strength in STRENGTHS:
            shade = np.log1p(strength * facing)
            left = float(np.abs(differences - (shade[pairs[:, 0]] - shade[pairs[:, 1]])).mean()) / max(nothing, 1e-12)
            if left < AGAINST and (best is None or left < best.left):
                best = Sun(direction, left)
    return best


def mean_radiance(observed: TexelObservations) -> Float[np.ndarray, "t 3"]:
    """The mean of each texel's observations; 0 without any."""
    owner = np.repeat(np.arange(len(observed.texel)), observed.seen)
    sums = [np.bincount(owner, observed.observations.rgb[:, c], len(observed.texel)) for c in range(3)]
    return np.stack(sums, axis=1) / np.maximum(observed.seen, 1)[:, None]


def _pairs(position: np.ndarray, normal: np.ndarray, chosen: Int[np.ndarray, " n"]) -> Int[np.ndarray, "p 2"]:
    """Pairs of near texels among `chosen`."""
    near = np.asarray(KDTree(position[chosen]).query(position[chosen], NEIGHBOURS + 1)[1])[:, 1:]
    both = np.stack([np.repeat(np.arange(len(chosen)), near.shape[1]), near.ravel()], axis=1)
    return chosen[np.unique(np.sort(both, axis=1), axis=0)]


def with_sun(
    cells: LightCells, radiance: Float[np.ndarray, "k 3"], sun: Sun | None
) -> tuple[LightCells, Float[np.ndarray, "n 3"]]:
    """The cells with the sun, if any, as the last of them, and their radiance; it begins as bright as its
    surroundings."""
    if sun is None:
        return cells, radiance
    own = radiance[int((cells.direction @ sun.direction).argmax())]
    direction = np.concatenate([cells.direction, sun.direction[None]])
    whole = LightCells(direction, np.concatenate([cells.angle, [SUN]]), cells.pairs)
    return whole, np.concatenate([radiance, own[None]])


def without_sun(
    cells: LightCells, radiance: Float[np.ndarray, "n 3"]
) -> tuple[LightCells, Float[np.ndarray, "k 3"], Directional]:
    """The inverse of `with_sun`: the sky's cells and radiance, and the sun as a directional light."""
    x, y, z = cells.direction[-1].tolist()
    r, g, b = (radiance[-1] * cells.angle[-1]).tolist()
    sky = LightCells(cells.direction[:-1], cells.angle[:-1], cells.pairs)
    return sky, radiance[:-1], Directional((x, y, z), (r, g, b))
