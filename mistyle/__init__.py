"""mistyle: one mesh and one style image in, the same mesh with stylized, physically based textures out."""

from __future__ import annotations

from os import PathLike
from typing import Any

__version__ = "0.1.0"
__all__ = ["__version__", "fit", "fit_scene", "stylize"]


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

    from mistyle.core.names import asset_name
    from mistyle.run.pipeline import stylize as run
    from mistyle.run.progress import Progress
    from mistyle.run.settings import resolve
    from mistyle.run.stages import Job

    mesh, style = Path(mesh), Path(style)
    job = Job(mesh, style, Path(out), resolve(preset, None, settings), asset_name(name, mesh.stem, style.stem))
    return run(job, Progress(quiet=True))


def fit(
    mesh: str | PathLike,
    pictures: str | PathLike,
    out: str | PathLike,
    *,
    lights: str | PathLike | None = None,
    masks: str | PathLike | None = None,
    preset: str = "standard",
    name: str | None = None,
    **settings: Any,
) -> dict[str, Any]:
    """Albedo, normal, roughness (and metallic) of a mesh from pictures of known cameras under known light.

    `pictures` is a folder with camera.json, transforms.json or a COLMAP model, and the pictures; `lights` a
    lights.json (None: the one in the folder; "unknown": solved for). `settings` are nested as `mistyle fit
    --print-config` prints them, for example `recover={"metallic": True}` or `references={"hold_out": 2}`.
    Returns the paths of what was written and the figures of `run.json`. Raises `mistyle.core.errors.MistyleError`.
    """
    from pathlib import Path

    from mistyle.core.names import asset_name
    from mistyle.run.material import MaterialJob, fit_material
    from mistyle.run.material_settings import MATERIAL_PRESETS, MaterialSettings
    from mistyle.run.progress import Progress
    from mistyle.run.settings import resolve

    mesh = Path(mesh)
    job = MaterialJob(
        mesh,
        Path(pictures),
        Path(out),
        resolve(preset, None, settings, root=MaterialSettings, presets=MATERIAL_PRESETS),
        asset_name(name, mesh.stem),
        lights="unknown" if lights == "unknown" else None if lights is None else Path(lights),
        masks=None if masks is None else Path(masks),
    )
    return fit_material(job, Progress(quiet=True))


def fit_scene(scene: Any, keys: Any, sensors: Any = None, references: Any = (), **options: Any) -> Any:
    """Texture parameters of a live `mi.Scene`, fitted to a picture per sensor: see `mistyle.render.scene_fit.fit_scene`
    for the options (loss, regularizers, callback, iterations, ...) and what comes back."""
    from mistyle.render.scene_fit import fit_scene as run

    return run(scene, keys, sensors, references, **options)
