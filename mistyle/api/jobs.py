"""The verbs that write a folder, from Python: `stylize`, `fit`, `bake`, `lookdev`."""

from collections.abc import Mapping
from os import PathLike
from pathlib import Path
from typing import Any, Unpack

import numpy as np

from mistyle.api import html
from mistyle.api.settings import FitSettings, LookdevSettings, StylizeSettings
from mistyle.core.errors import InputRefused

MOST = 8  # thumbnails


class JobResult(dict[str, Any]):
    """The written paths and the figures: the dictionary of `--json`, with an HTML display for notebooks."""

    @property
    def asset(self) -> Path:
        """The GLB with its textures. KeyError for a verb that writes none."""
        return Path(self["asset"])

    @property
    def figures(self) -> Mapping[str, float]:
        """Quality figures; empty for verbs that do not measure."""
        return self.get("figures", {})

    @property
    def notes(self) -> tuple[str, ...]:
        """Notes about omissions, guesses and repairs."""
        return tuple(self.get("notes", ()))

    def _repr_html_(self) -> str:
        paths = [(name, value) for name, value in self.items() if isinstance(value, str) and name != "name"]
        return html.page(
            str(self.get("name", "Result")),
            html.table(("figure", "value"), self.figures.items()),
            html.table(("file", "path"), paths),
            html.thumbnails(self._pictures()),
            notes=self.notes,
        )

    def _pictures(self) -> dict[str, np.ndarray]:
        """The files' pictures, at most MOST; missing and unreadable files are left out."""
        from mistyle.io.read import read_picture

        named = [Path(self[name]) for name in ("picture", "sheet") if name in self]
        folder = Path(self["textures"]) if "textures" in self else None
        files = [*named, *(sorted(folder.glob("*.png")) if folder is not None else [])]
        pictures = {}
        for path in [path for path in files if path.is_file()][:MOST]:
            try:
                pictures[path.stem] = read_picture(path).rgb
            except InputRefused:
                continue
        return pictures


def stylize(
    mesh: str | PathLike,
    style: str | PathLike,
    out: str | PathLike,
    *,
    preset: str = "standard",
    name: str | None = None,
    overwrite: bool = False,
    quiet: bool = True,
    **settings: Unpack[StylizeSettings],
) -> JobResult:
    """Mesh + one style picture -> stylized asset, textures and report in the folder `out` (the paper's section 4).

    mesh       OBJ, PLY, STL, OFF, GLB, glTF or USD
    style      a picture file, in the colour space of its profile, else sRGB
    preset     "draft", "standard", "fine" or "paper"
    name       of the asset; None: of the mesh and the style
    overwrite  replace files in `out` that mistyle did not write
    quiet      False: progress on stderr
    settings   nested by stage as `mistyle stylize --print-config` prints them, for example `fit={"refine": "off"}`

    Returns the written paths and the figures of `run.json`. If `out` holds an earlier run of the same job, it resumes
    from the last finished stage. Raises `mistyle.core.errors.MistyleError`.
    """
    from mistyle.core.names import asset_name
    from mistyle.jobs.progress import Progress
    from mistyle.stylization.pipeline.job import Job
    from mistyle.stylization.pipeline.stylize import stylize as run
    from mistyle.stylization.settings import resolve

    mesh, style, chosen = Path(mesh), Path(style), resolve(preset, None, dict(settings))
    job = Job(mesh, style, Path(out), chosen, asset_name(name, mesh.stem, style.stem), overwrite=overwrite)
    return JobResult(run(job, Progress(quiet=quiet)))


def fit(
    mesh: str | PathLike,
    pictures: str | PathLike,
    out: str | PathLike,
    *,
    lights: str | PathLike | None = None,
    masks: str | PathLike | None = None,
    exposure: str | PathLike | None = None,
    preset: str = "standard",
    name: str | None = None,
    overwrite: bool = False,
    quiet: bool = True,
    **settings: Unpack[FitSettings],
) -> JobResult:
    """Albedo, normal, roughness (and metallic) of a mesh from pictures of known cameras under known light.

    pictures   a folder with a camera.json, a transforms.json or a COLMAP model, and the pictures
    lights     a lights.json; None: the one in the folder; "unknown": an environment is estimated
    masks      a folder with a picture of the same name for each view
    exposure   a JSON file with the factor or the stops of each picture
    preset     "draft" or "standard"
    name       of the asset; None: the mesh's
    overwrite  replace files in `out` that mistyle did not write
    quiet      False: progress on stderr
    settings   nested by stage as `mistyle fit --print-config` prints them, for example `recover={"metallic": True}`
               or `references={"hold_out": 2}`

    Returns the written paths and the figures of `run.json`. `mistyle.recover` does the same in memory. Raises
    `mistyle.core.errors.MistyleError`.
    """
    from mistyle.core.names import asset_name
    from mistyle.fitting.pipeline.material import MaterialJob, fit_material
    from mistyle.fitting.settings.material import MATERIAL_PRESETS, MaterialSettings
    from mistyle.jobs.progress import Progress
    from mistyle.jobs.settings import resolve

    mesh = Path(mesh)
    job = MaterialJob(
        mesh,
        Path(pictures),
        Path(out),
        resolve(preset, None, dict(settings), root=MaterialSettings, presets=MATERIAL_PRESETS),
        asset_name(name, mesh.stem),
        lights="unknown" if lights == "unknown" else None if lights is None else Path(lights),
        masks=None if masks is None else Path(masks),
        exposure=None if exposure is None else Path(exposure),
        overwrite=overwrite,
    )
    return JobResult(fit_material(job, Progress(quiet=quiet)))


def bake(
    mesh: str | PathLike,
    views: str | PathLike,
    out: str | PathLike,
    *,
    preset: str = "standard",
    name: str | None = None,
    overwrite: bool = False,
    quiet: bool = True,
    **settings: Unpack[StylizeSettings],
) -> JobResult:
    """Project pictures of known cameras onto the mesh's texture (the paper's section 4.1.4).

    views      a folder with a camera.json (or transforms.json) and a picture for each view, as `mistyle render` writes
    preset     "draft", "standard", "fine" or "paper"
    name       of the asset; None: the mesh's
    overwrite  replace files in `out` that mistyle did not write
    quiet      False: progress on stderr
    settings   nested by stage, for example `atlas={"size": 4096}`

    Returns the asset's path, the share of each texture set that any view sees ("painted"), and notes. Raises
    `mistyle.core.errors.MistyleError`.
    """
    from mistyle.core.names import asset_name
    from mistyle.jobs.progress import Progress
    from mistyle.stylization.pipeline.single_stages import bake_views
    from mistyle.stylization.settings import resolve

    mesh, chosen = Path(mesh), resolve(preset, None, dict(settings))
    asset_title = asset_name(name, mesh.stem)
    progress = Progress(quiet=quiet)
    return JobResult(bake_views(mesh, Path(views), Path(out), chosen, asset_title, progress, overwrite=overwrite))


def lookdev(
    asset: str | PathLike,
    out: str | PathLike,
    *,
    hdri: str | PathLike | None = None,
    date: str | None = None,
    overwrite: bool = False,
    quiet: bool = True,
    **settings: Unpack[LookdevSettings],
) -> JobResult:
    """A look-dev sheet of a mesh file or run folder: three lights, five sides, balls, chart, AOVs, and turntables.

    hdri       an .hdr or .exr environment map for the third light
    date       stands in the burn-in; None: the day on which the asset's file was last changed, UTC
    overwrite  replace files in `out` that mistyle did not write
    quiet      False: progress on stderr
    settings   size, spp, seed, frame, threads, variant, the frames of `turntable` and `hdri_turn` (0: none), and `mp4`

    Returns the written paths, and notes. Raises `mistyle.core.errors.MistyleError`.
    """
    from mistyle.deliver.lookdev.job import LookSettings
    from mistyle.deliver.lookdev.job import lookdev as run
    from mistyle.jobs.progress import Progress
    from mistyle.jobs.settings import validate

    chosen, progress = validate(settings, "lookdev", LookSettings), Progress(quiet=quiet)
    place = None if hdri is None else Path(hdri)
    written = run(Path(asset), Path(out), chosen, progress, hdri=place, date=date, overwrite=overwrite)
    return JobResult(written | {"notes": list(progress.notes)})
