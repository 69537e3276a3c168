"""Metal or dielectric, decided by regions: texels that look alike share what their highlights tell.

Off its highlight a black dielectric looks like a smooth metal, and most texels see no highlight. Each texel is solved
as either class. The difference of the two costs is its evidence, in -2 log units. A binary Markov random field (Ising
model) joins neighbours: labels that differ cost JOIN, less where the two texels' apparent albedo differs. Mean-field
iterations from each texel's own evidence find the labels. They end in a local minimum near it, on purpose: at the
global one a few highlights outvote weak evidence far away.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, Int

from mistyle.core.image import luminance
from mistyle.render.deferred.material_table import ALBEDO, ROUGHNESS
from mistyle.solver.table import Atlas
from mistyle.solver.texels.levenberg_marquardt import Problem
from mistyle.solver.texels.observations import TexelObservations

JOIN = 40.0  # cost of a pair of like neighbours with different labels
DARK, RELATIVE = 0.002, 1.0  # difference of apparent albedos from which that cost is 0: absolute, and relative
STRONG = 60.0  # bound of a texel's own evidence: errors of the model are not independent
SWEEPS = 60
HOT = 4.0  # first temperature; it falls to 1


def metal_regions(
    evidence: Float[np.ndarray, " t"],
    apparent: Float[np.ndarray, "t 3"],
    texel: Int[np.ndarray, " t"],
    atlas: Atlas,
) -> Bool[np.ndarray, " t"]:
    """Whether each texel is metal. `evidence`: cost as dielectric less cost as metal; `apparent`: see
    `apparent_albedo`; `texel`: its index in the atlas."""
    own, alike = np.zeros(atlas.count, np.float32), np.zeros((atlas.count, 3), np.float32)
    own[texel], alike[texel] = np.clip(evidence, -STRONG, STRONG), apparent
    lean = np.tanh(own / (2 * HOT))
    pairs = _pairs(atlas, alike)
    for sweep in range(SWEEPS):
        heat = HOT ** (1 - sweep / (SWEEPS - 1))
        field = own.copy()
        for here, there, weight in pairs:
            field[here] += JOIN * weight * lean[there]  # no pair array names a texel twice
        lean = 0.5 * lean + 0.5 * np.tanh(field / (2 * heat))
    return (lean > 0)[texel]


def _pairs(atlas: Atlas, alike: Float[np.ndarray, "a 3"]) -> Sequence[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """(texel, neighbour, weight 0..1) in both directions, over grids and seams."""
    found = []
    for part, size, among in zip(atlas.parts, atlas.sizes, atlas.links, strict=True):
        index = np.arange(part.start, part.stop).reshape(size)
        for one, two, linked in (
            (index[:, :-1], index[:, 1:], among.right),
            (index[:-1], index[1:], among.below),
        ):
            a, b = one[linked], two[linked]
            weight = _likeness(alike[a], alike[b])
            found += [(a, b, weight), (b, a, weight)]
        for seam in among.seams:
            a, b = part.start + seam.here, part.start + seam.there
            found.append((a, b, seam.share * _likeness(alike[a], alike[b])))
    return found


def _likeness(a: Float[np.ndarray, "n 3"], b: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
    apart = (a - b) / (DARK + RELATIVE * (a + b) / 2)
    return np.maximum(1 - (apart**2).mean(axis=1), 0)


def apparent_albedo(problem: Problem, observed: TexelObservations) -> Float[np.ndarray, "t 3"]:
    """Per texel the observation of median brightness relative to a white diffuse surface: off its highlight, a black
    dielectric and a smooth metal have 0."""
    white = np.zeros((len(observed.seen), 7), np.float32)
    white[:, ALBEDO], white[:, ROUGHNESS] = 1, 1
    rgb, start = observed.observations.rgb, observed.observations.start
    expected = problem.predict(white)
    ratio = rgb[: len(expected)] / np.maximum(expected, 1e-6)
    owner = np.repeat(np.arange(len(start) - 1), np.diff(start))[: len(ratio)]
    order = np.lexsort((luminance(ratio), owner))
    result = np.zeros((len(observed.seen), 3), np.float32)
    some = np.diff(start) > 0
    result[some] = ratio[order[(start[:-1] + np.diff(start) // 2)[some]]]
    return np.clip(result, 0, 1)
