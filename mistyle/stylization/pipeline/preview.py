"""`--preview`: a sheet of four views and the maps, painted in seconds without fit and repair.

It uses the job's own run folder and stages, so the full job reuses its cached results: the mesh with its UVs, and for
jobs within the preview's limits also texture layout and painting.
"""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

from mistyle.core.asset import Asset, Picture
from mistyle.core.camera import Camera, orbit
from mistyle.core.errors import UsageError
from mistyle.core.image import srgb_from_linear
from mistyle.core.maps import Maps
from mistyle.jobs.inputs import input_files
from mistyle.jobs.memory_budget import kept, size_of
from mistyle.jobs.progress import Progress, Report
from mistyle.jobs.stages import Run, claim_run
from mistyle.jobs.start import mesh_stage, start_engines
from mistyle.stylization.pipeline.budget import PLAIN, STYLED, TILED, counts
from mistyle.stylization.pipeline.job import PREVIEW_STAGES, Job
from mistyle.stylization.pipeline.painting import check_paint, paint_layers, raised, surface_stage
from mistyle.stylization.pipeline.start import lay_out, texels_stage
from mistyle.stylization.records import Atlas
from mistyle.stylization.settings import Settings

SAMPLES, ATLAS = 80_000, 1024  # upper limits, from the preset draft
SIDE = 448  # pixels of a view, and of a map for few sets
FEW_SETS = 4
VIEWS = (30.0, 120.0, 210.0, 300.0)  # azimuths
ELEVATION = 15.0
SPP = 8
SHEET = "preview.png"


def preview(job: Job, progress: Progress) -> dict[str, Any]:
    """Paint the mesh and write OUT/preview/preview.png; returns its path, the seconds of each stage and the notes."""
    from mistyle.deliver.colour import read_style
    from mistyle.stylization.pipeline.stylize import inputs_of

    s = job.settings
    if s.stylizer != "embedded":
        raise UsageError(f"--preview shows the embedded stylizer, not {s.stylizer}; leave --stylizer out, or --preview")
    files = input_files(job.mesh)
    claim_run(job, PREVIEW_STAGES, inputs_of(job))
    style = read_style(job.style, s.colour)
    check_paint(s.paint)
    with (
        Run(job, progress, PREVIEW_STAGES) as run,
        kept(s, run.hidden.root, counts, PLAIN, TILED, STYLED) as look_again,
    ):
        start_engines(s)
        asset = mesh_stage(run, files)
        look_again(*size_of(asset))
        progress.note(*asset.source.notes, *style.notes)
        small, after = reduced(s), ["mesh"]
        if small == s:
            atlas = texels_stage(run, asset)
            layers = surface_stage(run, asset, style, atlas)
            after = ["surface"]

            def maps_of(report: Report) -> list[Maps]:
                return raised(asset, layers, atlas, s)[1]
        else:
            progress.note(sentence(s, small))

            def maps_of(report: Report) -> list[Maps]:
                return painted_maps(asset, style, lay_out(asset, small, lambda done: None), small, report)

        inputs = [style.rgb, style.alpha, s.surface, s.paint, s.seed, s.atlas, s.fit.metallic]
        folder = run.stage("preview", after, inputs, lambda f, r: write(f / SHEET, asset, maps_of(r), s.seed))
    summary = {"preview": str(folder / SHEET), "seconds": {k: round(v, 3) for k, v in progress.seconds.items()}}
    return {**summary, "notes": list(progress.notes)}


def reduced(settings: Settings) -> Settings:
    """The settings, limited to a preview's surface samples and texels."""
    samples, size = min(settings.surface.samples, SAMPLES), min(settings.atlas.size, ATLAS)
    return settings.model_copy(
        update={
            "surface": settings.surface.model_copy(update={"samples": samples}),
            "atlas": settings.atlas.model_copy(update={"size": size}),
        }
    )


def sentence(full: Settings, small: Settings) -> str:
    """The note on a preview's lower resolution."""
    return (
        f"The preview was painted with {small.surface.samples:,} surface samples on {small.atlas.size}² texels; the "
        f"job uses {full.surface.samples:,} on {full.atlas.size}², and its strokes are finer."
    )


def painted_maps(asset: Asset, style: Picture, atlas: Atlas, settings: Settings, report: Report) -> list[Maps]:
    """Paint the surface and bake it with its relief, uncached."""
    layers = paint_layers(asset, style, atlas, settings, report)
    return raised(asset, layers, atlas, settings)[1]


def write(path: Path, asset: Asset, maps: Sequence[Maps], seed: int) -> None:
    """Write the sheet: four views in a row, and below them the maps of each texture set."""
    from mistyle.io.images.write import write_png
    from mistyle.jobs.report.parts import map_shots

    cameras = [orbit(azimuth, ELEVATION, distance=4, fov=30, size=(SIDE, SIDE)) for azimuth in VIEWS]
    views = lit_views(asset, seed)(maps, cameras)
    side = SIDE if len(maps) <= FEW_SETS else SIDE // 2
    shots = [squared(np.asarray(shot.picture), side) for one in maps for shot in map_shots(one, side)]
    write_png(path, np.concatenate([rows_of(views, len(VIEWS)), rows_of(shots, len(VIEWS) * SIDE // side)]))


def lit_views(
    asset: Asset, seed: int
) -> Callable[[Sequence[Maps], Sequence[Camera]], list[Float[np.ndarray, "h w 3"]]]:
    """A function that renders maps from cameras under the studio's light, on white, sRGB.

    Rays, light and ambient occlusion are computed once for all pictures.
    """
    from mistyle.jobs.report.draw import sky, studio_light
    from mistyle.render.lookdev.studio import Studio, prefiltered
    from mistyle.render.mitsuba.draw import tracer

    traced, light = tracer(asset.mesh), prefiltered(studio_light())
    open_sky = sky(asset.mesh, traced, seed)

    def drawn(maps: Sequence[Maps], cameras: Sequence[Camera]) -> list[np.ndarray]:
        studio = Studio(traced, light, open_sky, [maps])
        pictures = [picture for (picture,) in studio.pictures(cameras, (0,), SPP)]
        return [np.clip(srgb_from_linear(p[..., :3] + 1 - p[..., 3:]), 0, 1) for p in pictures]

    return drawn


def squared(picture: UInt8[np.ndarray, "h w c"], side: int) -> Float[np.ndarray, "s s 3"]:
    """A map as a tile of the sheet."""
    from mistyle.core.image import resize

    return np.clip(resize(picture[..., :3].astype(np.float32) / 255, (side, side)), 0, 1)


def rows_of(tiles: Sequence[Float[np.ndarray, "h w 3"]], columns: int) -> Float[np.ndarray, "H W 3"]:
    """Tiles in rows of `columns`, from the top left, the rest white."""
    height, width = tiles[0].shape[:2]
    result = np.ones((-(-len(tiles) // columns) * height, columns * width, 3), np.float32)
    for k, tile in enumerate(tiles):
        row, column = divmod(k, columns)
        result[row * height : (row + 1) * height, column * width : (column + 1) * width] = tile
    return result
