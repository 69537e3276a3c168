"""The prior of the texels under an unknown light: their metallic, and the roughness of a class.

Under a dielectric model a metal's reflections call for a light many times too bright. A texel whose roughness no
highlight shows keeps that of the prior, and the light pays for its error: the highlights' strength is what the scale
and the colour of the light are known from.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Bool

from mistyle.atlas.texels import start_maps
from mistyle.core.asset import Material
from mistyle.core.maps import Texels
from mistyle.fitting.light.solve import INNER, MEAN, Bundle, State, Values, solved_texels, texels_under
from mistyle.render.deferred.material_table import METALLIC, ROUGHNESS
from mistyle.solver.table import Atlas
from mistyle.solver.texels.classes import apparent_albedo, metal_regions

STARTS = (0.2, 0.6)  # roughness has local minima
STEPS = 16  # of the texel solver from each start
UPDATES = 3  # of the mean roughness


def first_mean(texels: Sequence[Texels], materials: Sequence[Material]) -> Values:
    """Grey, flat and rough; with the materials' own metallic where there are any."""
    mean = np.tile(np.array(MEAN, np.float32), (sum(int(t.covered.sum()) for t in texels), 1))
    if materials:
        own = [start_maps(m, t, len(t.covered)).metallic[t.covered] for m, t in zip(materials, texels, strict=True)]
        mean[:, METALLIC] = np.concatenate(own)
    return mean


def metals(bundled: Bundle, state: State, atlas: Atlas) -> Bool[np.ndarray, " t"]:
    """Whether each texel is rather metal than dielectric under a state's light; `atlas` has links."""
    costs = []
    for metal in (0.0, 1.0):
        mean, start, tried = bundled.mean.copy(), state.values.copy(), []
        mean[:, METALLIC] = start[:, METALLIC] = metal
        for rough in STARTS:
            start[:, ROUGHNESS] = rough
            tried.append(solved_texels(bundled, start, mean, STEPS)[1])
        costs.append(np.minimum(*tried))
    evidence = np.where(bundled.reliable, costs[0] - costs[1], 0)
    return metal_regions(evidence, apparent_albedo(bundled.problem, bundled.observed), bundled.observed.texel, atlas)


def with_metals(bundled: Bundle, state: State, metal: Bool[np.ndarray, " t"]) -> tuple[Bundle, State]:
    """The problem with these classes, and its texels under the same light."""
    mean, start = bundled.mean.copy(), state.values.copy()
    mean[:, METALLIC] = start[:, METALLIC] = metal
    changed = replace(bundled, mean=mean)
    return changed, texels_under(changed, state.radiance, start, INNER, state.gains)


def with_common_roughness(bundled: Bundle, state: State) -> tuple[Bundle, State]:
    """The prior's roughness is the mean of each class's texels, found by expectation maximisation."""
    seen = bundled.reliable
    for _ in range(UPDATES):
        mean, metal = bundled.mean.copy(), bundled.mean[:, METALLIC] > 0.5
        for own in (metal, ~metal):
            if (own & seen).any():
                mean[own, ROUGHNESS] = state.values[own & seen, ROUGHNESS].mean()
        bundled = replace(bundled, mean=mean)
        state = texels_under(bundled, state.radiance, state.values, INNER, state.gains)
    return bundled, state
