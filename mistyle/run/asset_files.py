"""The asset that other programs open, as every kind of job writes it."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

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
    texels: Sequence[Texels],
    maps: Sequence[Maps],
    provenance: Mapping[str, Any],
    report: Report,
    edited: Edited,
    own: int = 0,
) -> None:
    """The files of `maps`, one per texture set; `edited` holds textures that a person painted over, `own` is as in
    `pad_maps`."""
    from mistyle.stages.export import write_asset
    from mistyle.stages.texels import pad_maps

    s = job.settings
    occlusion = [ambient(asset, part, s.atlas.size, s.seed, report) for part in range(len(asset.mesh.parts))]
    padded = [pad_maps(m, t, s.atlas.padding, own) for m, t in zip(maps, texels, strict=True)]
    padded, occlusion = edited(part_stems(job.name, asset.mesh.parts), padded, occlusion)
    told = {**provenance, **edited.provenance}
    write_asset(folder, job.name, asset, padded, occlusion, texels, provenance=told)
