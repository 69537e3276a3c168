"""Neighbours of texels on the surface: in the grid of the atlas, and across the seams of its charts.

A chart's border is not a border of the surface. Where a texel has no neighbour of its island on one side, the surface
is followed by one texel's width in that direction. The texel whose centre is nearest to that point is linked.
Charts often end at material borders, too: `weighted_seams` detects these from the values.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from mistyle.atlas.frames import uv_derivatives
from mistyle.atlas.texels import beside
from mistyle.core.maps import Texels
from mistyle.core.mesh import Mesh

STEPS = ((0, 1), (0, -1), (1, 0), (-1, 0))  # rows and columns to the right, left, lower and upper texel
NEAR = 1.0  # largest distance of the linked texel's centre from the extrapolated point, in texel sides
OTHER_SIDE = -0.5  # cosine between normals below which a texel is on the other side of a thin part
BESIDE = 2  # rows and columns around a texel within which its own island is not across a seam
CANDIDATES = 8  # nearest texels tried for each link

Grid = Float[np.ndarray, "h w"]


@dataclass(frozen=True)
class Seam:
    """Texels of one set (flat indices, each once) and the texels linked as their neighbours in one direction; `share`
    is the link's weight, 0..1."""

    here: Int[np.ndarray, " n"]
    there: Int[np.ndarray, " n"]
    share: Float[np.ndarray, " n"]


@dataclass(frozen=True)
class Links:
    """The neighbours in one set: whether a texel and its right or lower one share an island, and one seam for each of
    STEPS."""

    right: Bool[np.ndarray, "h v"]
    below: Bool[np.ndarray, "u w"]
    seams: tuple[Seam, Seam, Seam, Seam]


def _seam(here: np.ndarray, there: np.ndarray) -> Seam:
    return Seam(here, there, np.ones(len(here), np.float32))


NONE = _seam(np.zeros(0, int), np.zeros(0, int))


def of_islands(island: Int[np.ndarray, "h w"]) -> Links:
    """The neighbours within islands (-1: none), without seams."""
    right, below = beside(island)
    return Links(right, below, (NONE, NONE, NONE, NONE))


def within(among: Links) -> Links:
    """The links without seams."""
    return replace(among, seams=(NONE, NONE, NONE, NONE))


def weighted_seams(among: Links, fields: Iterable[tuple[Grid, Grid]]) -> Links:
    """The links with seams weighted by continuity. The weight is a half where any of `fields` (values and their
    standard deviations) jumps by twice its expected difference, from these and the mean difference of neighbours in the
    grid.
    """
    worst = [np.zeros(len(seam.here), np.float32) for seam in among.seams]
    for values, spread in fields:
        steps = (values[:, 1:] - values[:, :-1])[among.right], (values[1:] - values[:-1])[among.below]
        usual = sum(float((step**2).sum()) for step in steps) / max(sum(map(len, steps)), 1)
        flat, open_ = values.ravel(), spread.ravel()
        for jump, seam in zip(worst, among.seams, strict=True):
            expected = usual + open_[seam.here] ** 2 + open_[seam.there] ** 2
            np.maximum(jump, (flat[seam.here] - flat[seam.there]) ** 2 / np.maximum(expected, 1e-12), out=jump)
    right, left, below, above = (
        replace(seam, share=1 / (1 + (jump / 4) ** 2)) for seam, jump in zip(among.seams, worst, strict=True)
    )
    return replace(among, seams=(right, left, below, above))


def links(mesh: Mesh, texels: Texels) -> Links:
    """The links of a mesh's texels. Separate surfaces within NEAR of each other are linked too; charts of other sets
    are not."""
    return replace(of_islands(texels.island), seams=_seams(mesh, texels))


def _seams(mesh: Mesh, texels: Texels) -> tuple[Seam, Seam, Seam, Seam]:
    from scipy.spatial import KDTree

    at = np.flatnonzero(texels.covered)
    if not len(at):
        return NONE, NONE, NONE, NONE
    position, normal = texels.position.reshape(-1, 3)[at], texels.normal.reshape(-1, 3)[at]
    own, island = texels.island.ravel()[at], np.pad(texels.island, 1, constant_values=-1)
    row, column = np.divmod(at, texels.covered.shape[1])
    sides, tree = _texel_steps(mesh, texels.covered.shape)[texels.face.ravel()[at]], KDTree(position)
    most = min(CANDIDATES, len(at))

    def across(down: int, right: int) -> Seam:
        alone = np.flatnonzero(island[row + 1 + down, column + 1 + right] != own)
        step = right * sides[alone, 0] + down * sides[alone, 1]
        distance, near = (a.reshape(-1, most) for a in tree.query(position[alone] + step, k=most))
        good = distance < NEAR * np.linalg.norm(step, axis=1)[:, None]
        good &= np.einsum("nd,nkd->nk", normal[alone], normal[near]) > OTHER_SIDE
        away = np.maximum(np.abs(row[near] - row[alone, None]), np.abs(column[near] - column[alone, None]))
        good &= (away > BESIDE) | (own[near] != own[alone, None])
        first, sewn = good.argmax(axis=1), good.any(axis=1)
        return _seam(at[alone[sewn]], at[near[sewn, first[sewn]]])

    right, left, below, above = (across(*step) for step in STEPS)
    return right, left, below, above


def _texel_steps(mesh: Mesh, size: tuple[int, ...]) -> Float[np.ndarray, "f 2 3"]:
    """The step on the surface of one texel to the right, and one down, on every face."""
    return (uv_derivatives(mesh) / np.array([[size[1]], [-size[0]]])).astype(np.float32)
