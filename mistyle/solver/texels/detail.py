"""Albedo at the atlas's resolution where the per-texel solver ran on a coarser level: a quotient image.

With normal, roughness and metallic given, the radiance of an observation is albedo · linear + constant. Each picture so
gives an albedo, observed radiance less `constant` over `linear`, and a texel takes the median of them, weighted by
`linear` (Shashua and Riklin-Raviv, The quotient image, 2001, for one light; here the light is known). Light, shadows
and indirect light are those of the fit; the detail is the pictures'.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from mistyle.core.maps import Texels
from mistyle.core.rows import weighted_medians
from mistyle.render.deferred.material_table import ALBEDO, SOLVED, MaterialTable
from mistyle.solver.context import DirectCaptures, FitContext
from mistyle.solver.settings import DETAILED
from mistyle.solver.table import fill
from mistyle.solver.texels.levenberg_marquardt import Options, Problem
from mistyle.solver.texels.observations import ObservationOptions, TexelObservations, collect_observations
from mistyle.solver.texels.solve import observed_direct

DIMMEST = 0.02  # of the median of `linear`: observations that reflect less give no albedo


class Observed(NamedTuple):
    """A band of the atlas, observed, and its model."""

    observed: TexelObservations
    problem: Problem


class Detail:
    """The albedo's detail of one fit; a class, since it keeps the observations of an atlas that is observed at once."""

    def __init__(self, context: FitContext) -> None:
        self.context = context
        self._kept: list[Observed] | None = None
        self._bands = bands(context.texels, len(context.captures))

    def __call__(self, table: MaterialTable, direct: DirectCaptures) -> MaterialTable:
        """The table with the albedo of the pictures; texels without an observation keep theirs."""
        if self._kept is None and len(self._bands) == 1:
            self._kept = list(self._observed())
        result = table.copy()
        for band in self._observed() if self._kept is None else self._kept:
            _write_albedo(result, band, direct)
        return fill(result, self.context.atlas)

    def _observed(self) -> Iterator[Observed]:
        settings, context = self.context.settings, self.context
        options = ObservationOptions(settings.facing, settings.noise, settings.relative)
        chosen = Options(settings.model, settings.metallic, floor=settings.roughness_floor)
        for texels in self._bands:
            found = collect_observations(context.traced, texels, context.captures, context.tangents, options)
            if len(found.observations.rgb):
                yield Observed(found, Problem(found.points, found.rig, found.observations, chosen))


def bands(texels: Sequence[Texels], pictures: int) -> list[list[Texels]]:
    """The texture sets as bands of rows with at most about DETAILED texels times pictures each."""
    count = -(-sum(int(t.covered.sum()) for t in texels) * pictures // DETAILED)
    result = []
    for k in range(max(count, 1)):
        within = [np.arange(len(t.covered)) * max(count, 1) // len(t.covered) == k for t in texels]
        result.append([replace(t, covered=t.covered & rows[:, None]) for t, rows in zip(texels, within, strict=True)])
    return result


def _write_albedo(table: MaterialTable, band: Observed, direct: DirectCaptures) -> None:
    observed = band.observed
    values = np.ascontiguousarray(table[observed.texel, SOLVED])
    black, white = values.copy(), values
    black[:, ALBEDO], white[:, ALBEDO] = 0, 1
    constant, linear = band.problem.predict(black), band.problem.predict(white)
    linear -= constant
    count = len(linear)
    rgb = observed_direct(observed, direct).observations.rgb[:count] - constant
    texel = np.repeat(np.arange(len(observed.texel)), observed.seen)[:count]
    for c in range(3):
        bright = np.flatnonzero(linear[:, c] > DIMMEST * np.median(linear[:, c]))
        ratio = np.clip(rgb[bright, c] / linear[bright, c], 0, 1)
        rows, median = weighted_medians(texel[bright], ratio, linear[bright, c])
        table[observed.texel[rows], c] = median
