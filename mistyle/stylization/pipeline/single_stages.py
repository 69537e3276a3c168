"""The verbs `render` and `bake`: single stages for users who paint the views themselves."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from mistyle.core.asset import Asset
from mistyle.core.errors import UsageError
from mistyle.core.maps import Maps, Texels
from mistyle.core.mesh import Mesh
from mistyle.core.view import View
from mistyle.io.store.output import claim, read_written, replace_files
from mistyle.jobs.inputs import input_files
from mistyle.jobs.job_settings import LEAST_OVERLAP
from mistyle.jobs.memory_budget import kept, size_of
from mistyle.jobs.plan import existing
from mistyle.jobs.progress import Progress, Report
from mistyle.jobs.start import read, start_engines
from mistyle.stylization.pipeline.budget import (
    BAKE,
    BAKE_TILED,
    BAKED,
    DRAWN,
    RENDER,
    RENDER_TILED,
    bake_counts,
    render_counts,
)
from mistyle.stylization.pipeline.job import Job
from mistyle.stylization.pipeline.painting import with_geometry
from mistyle.stylization.pipeline.start import cameras_of, draw, lay_out_one, own_maps
from mistyle.stylization.pipeline.stylize import write_asset
from mistyle.stylization.settings import Settings


def render_views(
    mesh: Path, out: Path, settings: Settings, progress: Progress, *, overwrite: bool = False, unlit: bool = False
) -> list[Path]:
    """`mistyle render`: the views of section 4.1.1 for any mesh; `unlit` ones show the albedo alone.

    UsageError where unlit views should have the light of a scene.
    """
    if unlit and settings.draw.scene is not None:
        raise UsageError(f"--unlit: unlit views cannot show {settings.draw.scene}; leave --scene or --unlit out")
    inputs, drawing = claim_views(mesh, out, settings, overwrite), _draw_unlit if unlit else draw
    with kept(settings, existing(out), render_counts, RENDER, RENDER_TILED, DRAWN) as look_again:
        start_engines(settings)
        with progress.stage("mesh", "read the mesh") as report:
            asset = read(mesh, settings.read, settings.atlas.size, report)
        progress.note(*asset.source.notes)
        look_again(*size_of(asset))
        maps = own_maps(asset, settings)
        with progress.stage("views", "render the views") as report:
            replace_files(
                out, "render", lambda folder: drawing(folder, asset, maps, settings, report, progress.note),
                inputs=inputs, overwrite=overwrite,
            )  # fmt: skip
    return sorted(out / name for name, entry in read_written(out).files.items() if entry.by == "render")


def _draw_unlit(
    folder: Path,
    asset: Asset,
    maps: Sequence[Maps],
    settings: Settings,
    report: Report,
    say: Callable[[str], None],
) -> None:
    """`draw` without light: an empty lights.json lies beside the views."""
    from mistyle.io.cameras.views import write_views
    from mistyle.process import memory
    from mistyle.render.mitsuba.draw import tracer, view_of
    from mistyle.render.mitsuba.unlit import unlit

    cameras, traced = cameras_of(settings, asset.mesh, say), tracer(asset.mesh)
    pictures = unlit(traced, maps, cameras, progress=report)
    views = [
        memory.away(view_of(traced, camera, np.dstack([rgb, share])))
        for camera, (rgb, share) in zip(cameras, pictures, strict=True)
    ]
    write_views(folder, views, (), paper_files=settings.draw.paper_files)


def claim_views(mesh: Path, out: Path, settings: Settings, overwrite: bool) -> list[Path]:
    """The inputs of `mistyle render`; UsageError where it would overwrite one of them or a foreign file."""
    inputs = [*input_files(mesh), *filter(None, (settings.rig.file, settings.draw.scene))]
    claim(out, files_of_views(settings), inputs=inputs, overwrite=overwrite)
    return inputs


def claim_baked(mesh: Path, views: Path, out: Path, name: str, overwrite: bool) -> list[Path]:
    """The same for `mistyle bake`, for the outputs known before the mesh is read."""
    inputs = [*input_files(mesh), views]
    claim(out, [f"{name}.glb", f"{name}.json"], inputs=inputs, overwrite=overwrite)
    return inputs


def files_of_views(settings: Settings) -> list[str]:
    """File names of a folder of views; for next-best-view rigs those of all candidate cameras."""
    from mistyle.core.camera import rig
    from mistyle.geometry.next_best_view import candidate_cameras
    from mistyle.io.cameras.views import file_names, read_cameras

    chosen = settings.rig
    if chosen.kind == "file":
        assert chosen.file is not None
        cameras = read_cameras(chosen.file)
    else:
        cameras = candidate_cameras(chosen) if chosen.kind == "nbv" else rig(chosen)
    return file_names([camera.name for camera in cameras], settings.draw.paper_files)


LIT = (
    "The folder of the pictures has lights.json: they show its light and shadow, which the albedo now holds. "
    "`mistyle fit` separates light from albedo; `mistyle render --unlit` draws views without light."
)


def bake_views(
    mesh: Path, views: Path, out: Path, settings: Settings, name: str, progress: Progress, *, overwrite: bool = False
) -> dict[str, Any]:
    """`mistyle bake`: project pictures of known cameras onto the texture (section 4.1.4).

    The pictures' colours become the albedo as they are; a note names light that they are known to show.
    """
    from mistyle.deliver.asset import asset_names
    from mistyle.io.cameras.views import is_lit, read_views, view_cameras

    inputs = claim_baked(mesh, views, out, name, overwrite)
    sizes = [camera.size[0] * camera.size[1] for camera in view_cameras(views)]
    with kept(settings, existing(out), partial(bake_counts, sizes), BAKE, BAKE_TILED, BAKED) as look_again:
        with progress.stage("mesh", "read the mesh") as report:
            asset = read(mesh, settings.read, settings.atlas.size, report)
        claim(out, asset_names(name, asset.mesh.parts), inputs=inputs, overwrite=overwrite)
        start_engines(settings)
        progress.note(*asset.source.notes)
        look_again(*size_of(asset))
        pictures = read_views(views)
        progress.note(*([LIT] if is_lit(views) else []))
        tell_views(asset.mesh, pictures, progress)
        seen_by = with_geometry(asset, pictures)
        shares: list[float] = []
        job = Job(mesh, views, out, settings, name)
        with progress.stage("asset", "bake and write the texture") as report:
            sets = baked_sets(asset, seen_by, settings, shares)
            replace_files(
                out, "bake", lambda folder: write_asset(folder, job, asset, sets, report), inputs=inputs,
                overwrite=overwrite,
            )  # fmt: skip
    painted = dict(zip(asset.mesh.parts, shares, strict=True))
    return {"asset": str(out / f"{name}.glb"), "painted": painted, "notes": list(progress.notes)}


def baked_sets(
    asset: Asset, views: Sequence[View], settings: Settings, shares: list[float]
) -> Iterator[tuple[Texels, Maps]]:
    """Texels and maps of each texture set, computed lazily: its own material with the views' colours as albedo.

    `shares` receives the share of each set's texels that a view saw.
    """
    for part in range(len(asset.mesh.parts)):
        # No local name keeps a set alive: it can be freed before the next one is computed.
        yield baked_set(asset, part, views, settings, shares)


def baked_set(
    asset: Asset, part: int, views: Sequence[View], settings: Settings, shares: list[float]
) -> tuple[Texels, Maps]:
    """One texture set of `baked_sets`."""
    from mistyle.atlas.bake import backproject, fill

    texels, start = lay_out_one(asset, part, settings)
    baked = backproject(views, texels, settings.bake, mesh=asset.mesh)
    shares.append(float(baked.known.sum() / max(texels.covered.sum(), 1)))
    return texels, replace(start, albedo=fill(baked, texels), known=baked.known)


def tell_views(mesh: Mesh, views: Sequence[View], progress: Progress) -> None:
    """Report every picture's overlap with the mesh's outline, and warn about cameras; alpha is the coverage."""
    from mistyle.solver.cameras.outline_check import check_outlines, overlap_line, overlap_notes

    names = [view.camera.name for view in views]
    outlines = check_outlines(mesh, [view.camera for view in views], (view.coverage > 0.5 for view in views))
    if np.isfinite(outlines.overlap).any():
        progress.say(overlap_line(names, outlines.overlap))
    fix = "Check the cameras' axes, and that they are in working units (camera.json of `mistyle render`)."
    progress.note(*overlap_notes(names, outlines, LEAST_OVERLAP, fix, trusted=True))
