"""Estimates of `--dry-run`: stages, time, memory and disk of a job. Imports nothing heavy.

The times are products of counts, constants and the machine's slowness now. The constants are seconds of two cores of
a server, measured by `python -m benchmarks.pipeline` and `benchmarks.photographs`. Memory comes from
`jobs/memory_budget.py`. Disk is the final size of the run folder.
"""

import shutil
from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal

from mistyle.core.asset import UpAxis
from mistyle.io.meshes.parsed_mesh import Extent
from mistyle.jobs.inputs import input_files
from mistyle.jobs.memory_budget import Counts, Need, must_tile, peaks, within_gb
from mistyle.jobs.settings import thread_count
from mistyle.process.speed import slowness

# Seconds on two cores, per unit named.
PER_UNWRAPPED_FACE = 3.6e-4
PER_SAMPLE_RAY = 1.0e-6
PER_SURFACE_SAMPLE = 1.3e-4
PER_TEXEL = 1.0e-6
PER_VIEW_PIXEL = 8.0e-7
PER_CROP_PIXEL = 1.6e-6
PER_VGG_PIXEL = 3.4e-6  # of a crop in a step of the finish: twice forward, once back, to relu3_1
PER_PAINTING = 2.0  # the painting's own features, once
# Fits to pictures:
PER_READ_PIXEL, PER_BENT_PIXEL = 1e-7, 3e-7  # a pixel read, and made straight

PER_TABLE_PIXEL = 4e-8  # of all views, for each texture set that is baked

BYTES_PER_TEXEL = 190
BYTES_PER_VIEW_PIXEL = 60


def extent_of(mesh: Path, settings: Any) -> Extent:
    """The size of a mesh file's asset; the file is read, but nothing is unwrapped."""
    files = input_files(mesh)
    stamps = tuple((str(file), file.stat().st_mtime_ns, file.stat().st_size) for file in files)
    read = settings.read
    return _extent(mesh, read.uv, read.up, read.max_faces, settings.atlas.size, stamps)


@lru_cache(maxsize=64)  # a batch names few meshes many times
def _extent(
    mesh: Path, uv: Literal["keep", "new", "auto"], up: UpAxis, max_faces: int, size: int, stamps: object
) -> Extent:
    """`stamps` makes a changed file a new key of the cache."""
    from mistyle.io.read_mesh import read_extent

    return read_extent(mesh, uv=uv, up=up, max_faces=max_faces, size=size)


def reading(extent: Extent) -> float:
    """Seconds of the stage 'mesh', which reads and unwraps."""
    return 1 + extent.unwrapped * PER_UNWRAPPED_FACE


def needed_memory(
    settings: Any,
    count: Callable[[Any], Counts],
    plain: Mapping[str, Need],
    tiled: Mapping[str, Need],
    keys: Sequence[str],
) -> dict[str, Any]:
    """Peak GB, GB of each stage, and whether large arrays will lie in files. Refuses as the job would."""
    tile = must_tile(settings, count, plain, tiled, keys)
    return {
        "memory_gb": within_gb(settings, count(settings), plain, tiled),
        "in_files": tile,
        "peaks_gb": peaks(tiled if tile else plain, count(settings)),
    }


def costs(job: Any, stages: Mapping[str, str], seconds: Mapping[str, float], sets: int) -> dict[str, Any]:
    """The common part of plans: folder, name, texture sets, seconds of each stage on the job's threads, free GB."""
    scale = machine_scale(job.settings)
    return {
        "out": str(job.out),
        "name": job.name,
        "texture_sets": sets,
        "stages": [{"stage": k, "what": stages[k], "seconds": round(v * scale, 1)} for k, v in seconds.items()],
        "seconds": round(sum(seconds.values()) * scale),
        "free_gb": round(shutil.disk_usage(existing(job.out)).free / 1e9, 1),
    }


def machine_scale(settings: Any) -> float:
    """Seconds on the job's threads of this machine as it is now, over those of the constants."""
    threads = thread_count(settings)
    return slowness(threads) * 2 / threads


def existing(folder: Path) -> Path:
    """The folder, or its nearest ancestor that exists."""
    folder = folder.absolute()
    return folder if folder.exists() else existing(folder.parent)


def describe_plan(estimate: dict[str, Any]) -> str:
    """The plan as text for the terminal."""
    if "style" in estimate:
        relation = f"in the style of {estimate['style']}"
    elif "views" in estimate:
        relation = f"in {estimate['views']}"
    else:
        pictures = f"{estimate['pictures']} pictures, {estimate['megapixels']} megapixels"
        relation = f"from {pictures} of {estimate['references']}"
    lines = [f"{estimate['mesh']} {relation} -> {estimate['out']}"]
    lines += [f"  {row['what']:<36} about {row['seconds']:7.1f} s" for row in estimate["stages"]]
    sets = "1 texture set" if estimate["texture_sets"] == 1 else f"{estimate['texture_sets']} texture sets"
    lines.append(f"  in all about {estimate['seconds']} s for {sets}, without reused stages")
    files = ", large arrays in files" if estimate["in_files"] else ""
    lines.append(f"  memory at most about {estimate['memory_gb']} GB{files}")
    lines.append(f"  disk about {estimate['disk_gb']} GB; free disk: {estimate['free_gb']} GB")
    return "\n".join(lines)
