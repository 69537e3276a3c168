"""Stages, time and disk estimates of `stylize`, `render` and `bake` (`--dry-run`); see jobs/plan.py."""

from math import ceil, log2
from pathlib import Path
from typing import Any

from mistyle.core.errors import InputRefused
from mistyle.jobs.memory_budget import Counts
from mistyle.jobs.plan import (
    BYTES_PER_TEXEL,
    BYTES_PER_VIEW_PIXEL,
    PER_CROP_PIXEL,
    PER_PAINTING,
    PER_SAMPLE_RAY,
    PER_SURFACE_SAMPLE,
    PER_TABLE_PIXEL,
    PER_TEXEL,
    PER_VGG_PIXEL,
    PER_VIEW_PIXEL,
    costs,
    extent_of,
    needed_memory,
    reading,
)
from mistyle.jobs.stages import claim_run
from mistyle.solver.schedule import COVERED, SHOWN, size_from, whole_seconds
from mistyle.stylization.optimise.settings import lit_solver
from mistyle.stylization.pipeline.budget import (
    BAKE,
    BAKE_TILED,
    BAKED,
    DRAWN,
    PLAIN,
    RENDER,
    RENDER_TILED,
    STYLED,
    TILED,
    bake_counts,
    counts,
    render_counts,
    view_count,
    view_pixels,
)
from mistyle.stylization.pipeline.job import FINISH, STAGES, Job
from mistyle.stylization.settings import Settings


def plan(job: Job) -> dict[str, Any]:
    """Stages with estimated seconds, and the disk they take.

    Refuses a missing mesh or picture, and a folder with the user's own files, as the job would.
    """
    from mistyle.stylization.pipeline.stylize import inputs_of

    extent = extent_of(job.mesh, job.settings)
    claim_run(job, STAGES, inputs_of(job))
    if not job.style.is_file():
        raise InputRefused(f"{job.style}: found nothing, expected a picture; check the path")
    s = job.settings
    pixels = view_pixels(s)
    texels = extent.sets * s.atlas.size**2
    solve = lit_seconds(s, texels)
    # The solve of lit views replaces phase 1.
    steps = fit_steps(s) - (s.fit.iterations1 if solve else 0)
    crops = steps * s.fit.crops
    repaired = not s.keeps_painting
    frames = s.report.frames * s.report.resolution**2 * s.report.spp
    seconds = {
        "mesh": reading(extent),
        "texels": texels * PER_TEXEL,
        "views": pixels * (s.draw.samples(s.stylizer != "embedded") * PER_SAMPLE_RAY * 0.3 + PER_VIEW_PIXEL),
        "surface": s.surface.samples * PER_SURFACE_SAMPLE,
        "bake": 2 * texels * PER_TEXEL + pixels * PER_VIEW_PIXEL,
        **_finishing(s),
        "stylized": 2 * pixels * PER_VIEW_PIXEL,
        "fit": solve + crops * s.fit.crop_size**2 * PER_CROP_PIXEL,
        "masks": repaired * 0.3 * texels * PER_TEXEL,
        "repair": repaired * texels * PER_TEXEL + 0.1 * crops * s.fit.crop_size**2 * PER_CROP_PIXEL,
        "asset": 2 * texels * PER_TEXEL,
        "report": 5 + frames * PER_SAMPLE_RAY,
    }
    return {
        "mesh": str(job.mesh),
        "style": str(job.style),
        **costs(job, STAGES | FINISH, seconds, extent.sets),
        **needed_memory(s, lambda c: counts(c, extent.faces, extent.sets, extent.own), PLAIN, TILED, STYLED),
        "disk_gb": round((texels * BYTES_PER_TEXEL + 2 * pixels * BYTES_PER_VIEW_PIXEL) / 1e9, 2),
    }


def fit_steps(settings: Settings) -> int:
    """Steps of all phases that will run."""
    steps = {"normal-roughness": settings.fit.iterations1, "albedo": settings.fit.iterations2}
    return sum(count for name, count in steps.items() if settings.refined in (name, "all"))


def plan_render(mesh: Path, out: Path, settings: Settings) -> dict[str, Any]:
    """The same for `mistyle render`."""
    extent = extent_of(mesh, settings)

    def count(chosen: Settings) -> Counts:
        return render_counts(chosen, extent.faces, extent.sets, extent.own)

    pixels = count(settings).view
    seconds = {
        "mesh": reading(extent),
        "views": 2 + pixels * (settings.draw.samples() * PER_SAMPLE_RAY * 0.3 + PER_VIEW_PIXEL),
    }
    job = Job(mesh, mesh, out, settings, mesh.stem)
    return {
        "mesh": str(mesh),
        "views": f"{pixels / 1e6:.1f} megapixels of views",
        **costs(job, STAGES, seconds, extent.sets),
        **needed_memory(settings, count, RENDER, RENDER_TILED, DRAWN),
        "disk_gb": round(pixels * BYTES_PER_VIEW_PIXEL / 1e9, 2),
    }


def plan_bake(mesh: Path, views: Path, out: Path, settings: Settings, name: str) -> dict[str, Any]:
    """The same for `mistyle bake`, whose views' cameras are read."""
    from mistyle.io.cameras.views import view_cameras

    extent = extent_of(mesh, settings)
    sizes = [camera.size[0] * camera.size[1] for camera in view_cameras(views)]
    texels = extent.sets * settings.atlas.size**2

    def count(chosen: Settings) -> Counts:
        return bake_counts(sizes, chosen, extent.faces, extent.sets, extent.own)

    seconds = {
        "mesh": reading(extent),
        "asset": 4 * texels * PER_TEXEL + extent.sets * sum(sizes) * PER_TABLE_PIXEL,
    }
    return {
        "mesh": str(mesh),
        "pictures": len(sizes),
        "megapixels": round(sum(sizes) / 1e6, 1),
        "references": str(views),
        **costs(Job(mesh, views, out, settings, name), STAGES, seconds, extent.sets),
        **needed_memory(settings, count, BAKE, BAKE_TILED, BAKED),
        "disk_gb": round(texels * BYTES_PER_TEXEL / 1e9, 2),
    }


def lit_seconds(settings: Settings, texels: int) -> float:
    """Seconds of the solve of lit views, on texels as large as the views resolve (optimise/two_phase.py, shrinkage);
    0 where none are solved for."""
    from mistyle.core.light import has_soft
    from mistyle.stylization.pipeline.generative import fit_settings, lights_of_views, solves_lit

    lit = lights_of_views(settings) if solves_lit(fit_settings(settings)) else None
    if lit is None:
        return 0.0
    shown = settings.rig.resolution**2
    # A surface's mean projection is a quarter of its area (Cauchy).
    density = COVERED * texels / (4 * SHOWN * shown)
    by = 2 ** max(ceil(log2(density**0.5 / settings.fit.texels_per_pixel)), 0)
    solver, soft = lit_solver(settings.fit, has_soft([lit])), has_soft([lit])
    size = size_from(solver, [shown] * view_count(settings), COVERED * texels / by**2, soft)
    return whole_seconds(solver, size)


def _finishing(settings: Settings) -> dict[str, float]:
    """Seconds of the stage 'finish', if enabled, with its evaluation crops before and after."""
    from mistyle.stylization.optimise.finish_settings import JUDGED, JUDGING

    chosen = settings.finish
    if chosen.method == "off":
        return {}
    steps = chosen.steps + JUDGING * 2 * JUDGED
    return {"finish": PER_PAINTING + steps * chosen.crops * chosen.crop_size**2 * PER_VGG_PIXEL}
