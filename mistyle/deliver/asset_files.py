"""The asset that other programs open, as every kind of job writes it."""

from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from mistyle.core.asset import Asset
from mistyle.core.maps import Maps, Texels
from mistyle.io.images.textures import part_stems
from mistyle.jobs.edits import Edited
from mistyle.jobs.progress import Report
from mistyle.jobs.start import ambient


def write(
    folder: Path,
    job: Any,
    asset: Asset,
    sets: Iterable[tuple[Texels, Maps]],
    provenance: Mapping[str, Any],
    report: Report,
    edited: Edited,
    own: int = 0,
) -> None:
    """The files of the texture sets, each finished and written before the next is taken; `edited` holds textures that
    a person painted over, `own` is as in `pad_maps`."""
    from mistyle.deliver.asset import write_sets

    told = {**provenance, **edited.provenance}
    write_sets(folder, job.name, asset, _finished(job, asset, sets, report, edited, own), provenance=told)


def _finished(
    job: Any, asset: Asset, sets: Iterable[tuple[Texels, Maps]], report: Report, edited: Edited, own: int
) -> Iterator[tuple[Maps, np.ndarray, Texels]]:
    """Each set with its occlusion, its islands continued outwards and a person's edits in it."""
    stems, given = part_stems(job.name, asset.mesh.parts), iter(sets)
    for part, stem in enumerate(stems):
        # No name here holds a set: it can go before the next one is made.
        yield _finish(job, asset, part, stem, next(given), report, (edited, own))


def _finish(
    job: Any, asset: Asset, part: int, stem: str, given: tuple[Texels, Maps], report: Report, how: tuple[Edited, int]
) -> tuple[Maps, np.ndarray, Texels]:
    from mistyle.atlas.texels import pad_maps

    (texels, maps), (edited, own), s = given, how, job.settings
    occlusion = ambient(asset, part, s.atlas.size, s.seed, report)
    (padded,), (occlusion,) = edited([stem], [pad_maps(maps, texels, s.atlas.padding, own)], [occlusion])
    return padded, occlusion, texels
