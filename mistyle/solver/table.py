"""Table of all texels of all texture sets, and weighted means over neighbours in it."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from mistyle.atlas.neighbours import Links, links, weighted_seams
from mistyle.core.image import nearest
from mistyle.core.maps import Texels, rows_of
from mistyle.core.mesh import Mesh
from mistyle.render.deferred.material_table import COLUMNS, ROUGHNESS, SOLVED
from mistyle.solver.texels.observations import TexelObservations

# Prior mean of a texel without observations.
PRIOR_MEAN = (0.5, 0.5, 0.5, 0.0, 0.0, 0.5, 0.0)
# Unknowns whose means cross seams. Tilts do not: they are in their chart's frame, and normal maps often bevel an edge
# where charts meet, which a mean across it would flatten.
OVER_SEAMS = np.array([1, 1, 1, 0, 0, 1, 1], np.float32)

Table = Float[np.ndarray, "a 8"]
Values = Float[np.ndarray, "t 7"]


@dataclass(frozen=True)
class Atlas:
    """All texels of all sets in one row after the other: coverage, the nearest covered texel of each, and per set the
    links between neighbours (from `linked`)."""

    sizes: tuple[tuple[int, int], ...]
    covered: tuple[np.ndarray, ...]
    closest: tuple[np.ndarray, ...]
    links: tuple[Links, ...] = ()

    @property
    def parts(self) -> list[slice]:
        """The rows of each set."""
        return rows_of(self.sizes)

    @property
    def count(self) -> int:
        """Number of texels."""
        return self.parts[-1].stop


def atlas_of(texels: Sequence[Texels]) -> Atlas:
    """The atlas of texture sets, without links."""
    covered = tuple(t.covered for t in texels)
    return Atlas(
        sizes=tuple((t.covered.shape[0], t.covered.shape[1]) for t in texels),
        covered=covered,
        closest=tuple(nearest(c)[0].ravel() if c.any() else np.arange(c.size) for c in covered),
    )


def linked(mesh: Mesh, texels: Sequence[Texels]) -> Atlas:
    """The atlas of texture sets with links between neighbours."""
    return replace(atlas_of(texels), links=tuple(links(mesh, t) for t in texels))


def scatter_to_atlas(values: Values, observed: TexelObservations, atlas: Atlas) -> Table:
    """The table of an atlas from the covered texels' values; uncovered texels take those of the nearest covered one."""
    table = np.zeros((atlas.count, COLUMNS), np.float32)
    table[:, SOLVED] = PRIOR_MEAN
    table[observed.texel, SOLVED] = values
    return fill(table, atlas)


def scatter(values: np.ndarray, observed: TexelObservations, atlas: Atlas, otherwise) -> np.ndarray:
    """An array of the whole atlas with the covered texels' values and `otherwise` elsewhere."""
    result = np.zeros((atlas.count, *values.shape[1:]), values.dtype)
    result[...] = otherwise
    result[observed.texel] = values
    return result


def fill(table: Float[np.ndarray, "a c"], atlas: Atlas) -> Float[np.ndarray, "a c"]:
    """Uncovered texels take the values of the nearest covered one of their set."""
    result = table.copy()
    for part, covered, closest in zip(atlas.parts, atlas.covered, atlas.closest, strict=True):
        empty = ~covered.ravel()
        result[part][empty] = table[part][closest[empty]]
    return result


def neighbourhood(
    values: Float[np.ndarray, "t c"],
    weight: Float[np.ndarray, "t c"],
    observed: TexelObservations,
    atlas: Atlas,
    steps: int,
    over: Float[np.ndarray, " c"] | float = 1.0,
) -> Float[np.ndarray, "t c"]:
    """Weighted mean over a neighbourhood of `steps` diffusion steps; `over`: weight across seams, 0..1 (per column). A
    texel without weights around it keeps its own value."""
    channels = values.shape[1]
    full = np.zeros((2, atlas.count, channels), np.float32)
    full[0, observed.texel], full[1, observed.texel] = values * weight, weight
    for part, size, among in zip(atlas.parts, atlas.sizes, atlas.links, strict=True):
        sums = full[:, part].reshape(2, *size, channels)
        sums[...] = diffused(sums, among, steps, over)
    summed, weights = full[:, observed.texel]
    return np.where(weights > 1e-12, summed / np.maximum(weights, 1e-12), values).astype(np.float32)


def diffused(
    part: Float[np.ndarray, "n h w c"], among: Links, steps: int, over: Float[np.ndarray, " c"] | float = 1.0
) -> Float[np.ndarray, "n h w c"]:
    """Diffuse sums over the four neighbours, step by step. Shares beyond a border are lost, so sums need division by
    diffused weights."""
    right, below = among.right[..., None], among.below[..., None]
    seams = among.seams if np.any(over) else ()
    part, total = part.copy(), np.empty_like(part)
    for _ in range(steps):
        np.multiply(part, 2, out=total)
        total[:, :, :-1] += part[:, :, 1:] * right
        total[:, :, 1:] += part[:, :, :-1] * right
        total[:, :-1] += part[:, 1:] * below
        total[:, 1:] += part[:, :-1] * below
        flat, sums = (grid.reshape(len(part), -1, part.shape[-1]) for grid in (part, total))
        for seam in seams:
            sums[:, seam.here] += flat[:, seam.there] * (seam.share[:, None] * over)
        total *= np.float32(0.2)
        part, total = total, part
    return part


def with_seam_weights(atlas: Atlas, values: Float[np.ndarray, "a 7"], spread: Float[np.ndarray, "a 7"]) -> Atlas:
    """The atlas with seams weighted by agreement of albedo and roughness; `spread`: standard deviations."""
    links_by_set = []
    for part, size, among in zip(atlas.parts, atlas.sizes, atlas.links, strict=True):
        fields = ((values[part, c].reshape(size), spread[part, c].reshape(size)) for c in (0, 1, 2, ROUGHNESS))
        links_by_set.append(weighted_seams(among, fields))
    return replace(atlas, links=tuple(links_by_set))
