"""The first steps of every kind of job: Mitsuba variant, thread counts, and the mesh."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mistyle.core.asset import Asset
from mistyle.jobs.job_settings import ReadSettings
from mistyle.jobs.progress import Report
from mistyle.jobs.settings import thread_count
from mistyle.process.cores import use_threads


def start_engines(settings: Any) -> str:
    """Choose the Mitsuba variant and set the thread counts of all libraries; returns the variant.

    `settings` is the root record of any kind of job; only its `threads` and `variant` matter.
    """
    from mistyle.render.mitsuba import device

    threads = thread_count(settings)
    use_threads(threads)
    return device.use(None if settings.variant == "auto" else settings.variant, threads)


def read(path: Path, chosen: ReadSettings, size: int, report: Report) -> Asset:
    """The mesh, normalised and with UVs usable for an atlas of `size`."""
    from mistyle.io.read_mesh import read_mesh

    how: dict[str, Any] = dict(uv=chosen.uv, up=chosen.up, max_faces=chosen.max_faces, lit=chosen.lit)
    return read_mesh(path, **how, size=size, progress=report)


def mesh_stage(run: Any, files: Sequence[Path]) -> Asset:
    """The stage "mesh" of a job; `files` are the mesh file and all that it names."""
    s = run.job.settings
    return run.record(
        "mesh", [], [list(files), s.read, s.atlas.size], lambda r: read(run.job.mesh, s.read, s.atlas.size, r)
    )


def ambient(asset: Asset, part: int, size: int, seed: int, report: Report) -> np.ndarray:
    """Ambient occlusion of a texture set, computed at a quarter of the atlas: it has no finer detail than the mesh."""
    from mistyle.atlas.texels import pad, rasterise
    from mistyle.core.image import resize
    from mistyle.render.mitsuba.occlusion import open_sky

    coarse = rasterise(asset.mesh, part, max(size // 4, 64))
    values = np.ones(coarse.covered.shape, np.float32)
    at = coarse.covered
    values[at] = open_sky(asset.mesh, coarse.position[at], coarse.normal[at], seed=seed)[:, 3]
    report((part + 1) / len(asset.mesh.parts))
    return np.clip(resize(pad(values, coarse, 8), (size, size)), 0, 1)
