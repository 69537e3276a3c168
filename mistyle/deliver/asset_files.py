"""The asset stage of every kind of job: occlusion, padding, edits, and the asset folder."""

from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from mistyle.core.asset import Asset
from mistyle.core.maps import Heights, Maps, Texels
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
    heights: Heights | None = None,
) -> None:
    """Write the asset, one texture set after another; `edited` holds textures that a person painted over, `own` is
    that of `pad_maps`; `heights` are written as they are."""
    from mistyle.deliver.asset import write_sets

    merged = {**provenance, **edited.provenance}
    finished = _finished(job, asset, sets, report, edited, own)
    write_sets(folder, job.name, asset, finished, provenance=merged, heights=heights)


def _finished(
    job: Any, asset: Asset, sets: Iterable[tuple[Texels, Maps]], report: Report, edited: Edited, own: int
) -> Iterator[tuple[Maps, np.ndarray, Texels]]:
    """Each set with occlusion, padding around its islands, and a person's edits."""
    stems, remaining = part_stems(job.name, asset.mesh.parts), iter(sets)
    for part, stem in enumerate(stems):
        # No variable of the loop holds a set: its memory is free before the next one is computed.
        yield _finish(job, asset, part, stem, next(remaining), report, (edited, own))


def _finish(
    job: Any,
    asset: Asset,
    part: int,
    stem: str,
    texture_set: tuple[Texels, Maps],
    report: Report,
    options: tuple[Edited, int],
) -> tuple[Maps, np.ndarray, Texels]:
    from mistyle.atlas.texels import pad_maps

    (texels, maps), (edited, own), s = texture_set, options, job.settings
    occlusion = ambient(asset, part, s.atlas.size, s.seed, report)
    (padded,), (occlusion,) = edited([stem], [pad_maps(maps, texels, s.atlas.padding, own)], [occlusion])
    return padded, occlusion, texels
