"""The outputs of `mistyle fit` for other programs: the asset, and a Mitsuba scene of it."""

from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from mistyle.core.asset import Asset
from mistyle.core.capture import Captures
from mistyle.core.maps import Maps, Texels
from mistyle.deliver import asset_files
from mistyle.jobs.edits import UNEDITED, Edited
from mistyle.jobs.progress import Report

BORDER = 1  # texels around an island that the fit determines, since bilinear lookups reach them


def write(
    folder: Path,
    job: Any,
    asset: Asset,
    sets: Iterable[tuple[Texels, Maps]],
    report: Report = lambda done: None,
    edited: Edited = UNEDITED,
    state: str = "",
) -> None:
    """Write the asset of texture `sets`; `edited` holds textures that a person painted over, `state` is the share of
    passes done where some are missing."""
    provenance = {"mesh": job.mesh.name, "references": job.references.name, "material": job.settings.recover.model}
    provenance |= {"state": state} if state else {}
    asset_files.write(folder, job, asset, sets, provenance, report, edited, own=BORDER)


def scene(folder: Path, job: Any, asset: Asset, texels: Sequence[Texels], recovered: Any, captures: Captures) -> None:
    """Write a Mitsuba scene of the result that renders without mistyle."""
    from mistyle.atlas.frames import mitsuba_normals
    from mistyle.atlas.texels import pad_in_place, pad_maps
    from mistyle.render.mitsuba.scene_folder import write_scene

    padding, turned = job.settings.atlas.padding, list(recovered.maps)
    if job.settings.recover.frame == "mikkt":
        # Texels outside the islands have no tangent frame.
        for k, (m, t) in enumerate(zip(recovered.maps, texels, strict=True)):
            turned[k] = replace(m, normal=mitsuba_normals(asset.mesh, m, t))
            pad_in_place([turned[k].normal], t, padding)
    padded = [pad_maps(m, t, padding, own=BORDER) for m, t in zip(turned, texels, strict=True)]
    del turned
    write_scene(folder, job.name, asset.mesh, padded, captures.cameras, captures.lights[0])
