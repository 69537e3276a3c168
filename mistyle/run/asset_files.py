"""The asset that other programs open, as every kind of job writes it."""

from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from mistyle.core.asset import Asset
from mistyle.core.maps import Maps, Texels
from mistyle.files.textures import part_stems
from mistyle.run.edits import Edited
from mistyle.run.progress import Report
from mistyle.run.start import ambient


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
    from mistyle.stages.export import write_sets

    told = {**provenance, **edited.provenance}
    write_sets(folder, job.name, asset, _finished(job, asset, sets, report, edited, own), provenance=told)


def _finished(
    job: Any, asset: Asset, sets: Iterable[tuple[Texels, Maps]], report: Report, edited: Edited, own: int
) -> Iterator[tuple[Maps, np.ndarray, Texels]]:
    """Each set with its occlusion, its islands continued outwards and a person's edits in it."""
    from mistyle.stages.texels import pad_maps

    s = job.settings
    stems = part_stems(job.name, asset.mesh.parts)
    for part, (texels, maps) in enumerate(sets):
        occlusion = ambient(asset, part, s.atlas.size, s.seed, report)
        padded = pad_maps(maps, texels, s.atlas.padding, own)
        (padded,), (occlusion,) = edited([stems[part]], [padded], [occlusion])
        yield padded, occlusion, texels
