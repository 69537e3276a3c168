"""mistyle: one mesh and one style image in, the same mesh with stylized, physically based textures out."""

from __future__ import annotations

from os import PathLike
from typing import Any

__version__ = "0.1.0"
__all__ = ["__version__", "stylize"]


def stylize(
    mesh: str | PathLike,
    style: str | PathLike,
    out: str | PathLike,
    *,
    preset: str = "standard",
    name: str | None = None,
    **settings: Any,
) -> dict[str, Any]:
    """Mesh + one style picture -> stylized asset, textures and report in the folder `out` (the paper's section 4).

    `settings` are nested as `mistyle stylize --print-config` prints them, for example `fit={"refine": "off"}`.
    Returns the paths of what was written and the figures of `run.json`; goes on from the last finished stage when
    `out` holds an earlier run of the same job. Raises `mistyle.core.errors.MistyleError`.
    """
    from pathlib import Path

    from mistyle.run.pipeline import stylize as run
    from mistyle.run.progress import Progress
    from mistyle.run.settings import resolve
    from mistyle.run.stages import Job

    mesh, style = Path(mesh), Path(style)
    job = Job(mesh, style, Path(out), resolve(preset, None, settings), name or f"{mesh.stem}_{style.stem}")
    return run(job, Progress(quiet=True))
