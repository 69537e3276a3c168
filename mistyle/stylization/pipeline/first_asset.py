"""First asset: the painted and baked maps, written before fit and repair, which then replace it.

It is complete, and has the finished asset's path. It is marked as first in `asset/done.json` ("first"), its file list,
the GLB's provenance, and `run.json` ("finished": false).
"""

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from mistyle.core.asset import Asset
from mistyle.core.maps import Maps
from mistyle.deliver import asset_files
from mistyle.io.store.atomic import DONE, digest
from mistyle.io.store.trusted_json import read_own
from mistyle.jobs.edits import UNEDITED
from mistyle.jobs.progress import Report
from mistyle.jobs.run_record import merged_peaks, merged_seconds, write_record
from mistyle.stylization.records import Atlas, Baked

STATE = "painted and baked; not fitted, not repaired"


def write_first(run: Any, asset: Asset, atlas: Atlas, baked: Baked) -> None:
    """Write and announce the first asset, unless the run folder already has an asset of this painting."""
    job, painted = run.job, run.keys["bake"]
    key = digest([painted, "first", job.name])
    if painted == _painted(job.out / "asset"):
        return
    maps: Sequence[Maps] = baked.begin or baked.maps

    def write(folder: Path, report: Report) -> None:
        sets = zip(atlas.texels, maps, strict=True)
        provenance = {"mesh": job.mesh.name, "style": job.style.name, "seed": job.settings.seed, "state": STATE}
        asset_files.write(folder, job, asset, sets, provenance, report, UNEDITED)

    run.early("asset", key, "write the first asset", write, {"painted": painted, "first": True})
    place = job.out / "asset" / f"{job.name}.glb"
    record = {
        "name": job.name,
        "asset": str(place),
        "finished": False,
        "state": STATE,
        "seconds": merged_seconds(job.out / "run.json", run),
        "peaks_gb": merged_peaks(job.out / "run.json", run),
        "notes": list(run.progress.notes),
    }
    write_record(job, record, run.progress)
    after = time.perf_counter() - run.progress.began
    run.progress.say(f"asset     {place}: painted and baked {after:.0f} s after the start; fit and repair refine it")


def _painted(folder: Path) -> str | None:
    """Key of the painting from which a folder's asset, first or finished, was written."""
    try:
        return str(read_own(folder / DONE)["painted"])
    except (OSError, ValueError, KeyError, TypeError):
        return None
