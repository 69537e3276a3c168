"""What a job will do and what it will cost, before it does it (`--dry-run`). Imports nothing heavy.

The times are products of counts and constants that were read off `python -m benchmarks.pipeline` and
`benchmarks.photographs` on two cores of a server; they are guides of a factor of two, not promises. Memory is
`run/budget.py`'s. Disk is what stays in the run folder.
"""

import shutil
from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal

from mistyle.core.errors import InputRefused
from mistyle.files.raw import Extent
from mistyle.run.budget import (
    BAKE,
    BAKE_TILED,
    BAKED,
    COVERED,
    DRAWN,
    MATERIAL,
    PLAIN,
    RENDER,
    RENDER_TILED,
    SEEN,
    SHOWN,
    STYLED,
    TILED,
    Counts,
    Need,
    bake_counts,
    check_material,
    counts,
    looked_at,
    material_counts,
    material_gb,
    must_tile,
    peaks,
    render_counts,
    view_pixels,
    within_gb,
)
from mistyle.run.inputs import input_files
from mistyle.run.settings import Settings, thread_count
from mistyle.run.stages import FINISH, MATERIAL_STAGES, STAGES, Job, claim_run
from mistyle.stages.recover_settings import all_rounds, descent_steps, estimates, joint_estimates, joint_steps, passes

# Seconds on two cores, per unit named.
PER_UNWRAPPED_FACE = 3.6e-4
PER_SAMPLE_RAY = 1.0e-6
PER_SURFACE_SAMPLE = 1.3e-4
PER_TEXEL = 1.0e-6
PER_VIEW_PIXEL = 8.0e-7
PER_CROP_PIXEL = 1.6e-6
PER_VGG_PIXEL = 7e-6  # of a crop of the finish: twice forward, once back, to relu3_1
# Of fits to pictures: a pixel read and made straight; a sample of one predicted, or stepped on; a texel in a picture; a
# path of light between surfaces; a covered texel in one word of its neighbours.
PER_READ_PIXEL = 8e-7
PER_LOOK = 2e-7
PER_OBSERVATION = 4e-7  # in one step of a solve; of one that begins anew, with two starts
PER_BOUNCED_PATH = 1e-7
PER_SMOOTHED = 1.5e-5
PER_JOINT = 1.5e-5  # of a pixel that shows the object, for each joint step

PER_TABLE_PIXEL = 4e-8  # of all views, for each texture set that is baked

BYTES_PER_TEXEL = 190
BYTES_PER_VIEW_PIXEL = 60


def plan(job: Job) -> dict[str, Any]:
    """Stages with estimated seconds, and the disk they take; refuses a missing mesh or picture, and a folder with the
    user's files in the way, as the job would."""
    from mistyle.run.pipeline import inputs_of

    extent = extent_of(job.mesh, job.settings)
    claim_run(job, STAGES, inputs_of(job))
    if not job.style.is_file():
        raise InputRefused(f"{job.style}: found nothing, expected a picture; check the path")
    s = job.settings
    pixels = view_pixels(s)
    texels = extent.sets * s.atlas.size**2
    crops = fit_steps(s) * s.fit.crops
    repaired = not s.keeps_painting
    frames = s.report.frames * s.report.resolution**2 * s.report.spp
    seconds = {
        "mesh": _reading(extent),
        "texels": texels * PER_TEXEL,
        "views": pixels * (s.draw.samples(s.stylizer != "embedded") * PER_SAMPLE_RAY * 0.3 + PER_VIEW_PIXEL),
        "surface": s.surface.samples * PER_SURFACE_SAMPLE,
        "bake": 2 * texels * PER_TEXEL + pixels * PER_VIEW_PIXEL,
        **_finishing(s),
        "stylized": 2 * pixels * PER_VIEW_PIXEL,
        "fit": crops * s.fit.crop_size**2 * PER_CROP_PIXEL,
        "masks": repaired * 0.3 * texels * PER_TEXEL,
        "repair": repaired * texels * PER_TEXEL + 0.1 * crops * s.fit.crop_size**2 * PER_CROP_PIXEL,
        "asset": 2 * texels * PER_TEXEL,
        "report": 5 + frames * PER_SAMPLE_RAY,
    }
    return {
        "mesh": str(job.mesh),
        "style": str(job.style),
        **_costs(job, STAGES | FINISH, seconds, extent.sets),
        **_memory(s, lambda c: counts(c, extent.faces, extent.sets, extent.own), PLAIN, TILED, STYLED),
        "disk_gb": round((texels * BYTES_PER_TEXEL + 2 * pixels * BYTES_PER_VIEW_PIXEL) / 1e9, 2),
    }


def fit_steps(settings: Settings) -> int:
    """The steps of the phases that will run."""
    steps = {"normal-roughness": settings.fit.iterations1, "albedo": settings.fit.iterations2}
    return sum(count for name, count in steps.items() if settings.refined in (name, "all"))


def plan_render(mesh: Path, out: Path, settings: Settings) -> dict[str, Any]:
    """The same for `mistyle render`."""
    extent = extent_of(mesh, settings)

    def count(chosen: Settings) -> Counts:
        return render_counts(chosen, extent.faces, extent.sets, extent.own)

    pixels = count(settings).view
    seconds = {
        "mesh": _reading(extent),
        "views": 2 + pixels * (settings.draw.samples() * PER_SAMPLE_RAY * 0.3 + PER_VIEW_PIXEL),
    }
    job = Job(mesh, mesh, out, settings, mesh.stem)
    return {
        "mesh": str(mesh),
        "views": f"{pixels / 1e6:.1f} megapixels of views",
        **_costs(job, STAGES, seconds, extent.sets),
        **_memory(settings, count, RENDER, RENDER_TILED, DRAWN),
        "disk_gb": round(pixels * BYTES_PER_VIEW_PIXEL / 1e9, 2),
    }


def plan_bake(mesh: Path, views: Path, out: Path, settings: Settings, name: str) -> dict[str, Any]:
    """The same for `mistyle bake`, whose views' cameras are read."""
    from mistyle.files.views import view_cameras

    extent = extent_of(mesh, settings)
    sizes = [camera.size[0] * camera.size[1] for camera in view_cameras(views)]
    texels = extent.sets * settings.atlas.size**2

    def count(chosen: Settings) -> Counts:
        return bake_counts(sizes, chosen, extent.faces, extent.sets, extent.own)

    seconds = {
        "mesh": _reading(extent),
        "asset": 4 * texels * PER_TEXEL + extent.sets * sum(sizes) * PER_TABLE_PIXEL,
    }
    return {
        "mesh": str(mesh),
        "pictures": len(sizes),
        "megapixels": round(sum(sizes) / 1e6, 1),
        "references": str(views),
        **_costs(Job(mesh, views, out, settings, name), STAGES, seconds, extent.sets),
        **_memory(settings, count, BAKE, BAKE_TILED, BAKED),
        "disk_gb": round(texels * BYTES_PER_TEXEL / 1e9, 2),
    }


def plan_material(job: Any) -> dict[str, Any]:
    """The same for a `MaterialJob`, whose cameras, lights and pictures' headers are read and refused as it does.

    How much of the pictures shows the object is not known yet: run/budget.py's shares are taken.
    """
    from mistyle.render.indirect import MOST
    from mistyle.run.material import inputs_of, pixels_of, references_of
    from mistyle.stages.recover_solve import STARTS

    s, extent = job.settings, extent_of(job.mesh, job.settings)
    claim_run(job, MATERIAL_STAGES, inputs_of(job))
    size = extent.faces, extent.sets, extent.own
    sizes = pixels_of(references_of(job))
    texels = extent.sets * s.atlas.size**2
    chosen = check_material(s, sizes, *size)
    averaged = looked_at(s, sizes)
    looked, observed = SHOWN * sum(averaged) * s.recover.subsamples, COVERED * SEEN * texels * len(sizes)
    solves = s.recover.solver != "pictures"
    rounds, estimated = solves * all_rounds(s.recover, len(sizes)), estimates(s.recover, len(sizes))
    begun = solves * (1 + len(estimated[0]))
    steps, joint = descent_steps(s.recover), joint_steps(s.recover)
    samples = solves * sum(sum(part) for part in estimated)
    again = joint_estimates(s.recover)
    samples += sum(again)
    paths = samples * sum(min(n, MOST**2) for n in averaged)
    words = solves * s.recover.smooth * (1 + (steps > 0) * len(passes(s.recover, len(sizes))))
    seconds = {
        "mesh": _reading(extent),
        "texels": texels * PER_TEXEL,
        "cameras": 1,
        "pictures": sum(sizes) * PER_READ_PIXEL,
        "recover": (rounds + 2 + steps / len(sizes)) * looked * PER_LOOK
        + (begun * len(STARTS) / 2 + rounds) * s.recover.solver_iterations * observed * PER_OBSERVATION
        + paths * PER_BOUNCED_PATH
        + joint * max(1, len(again)) * SHOWN * sum(averaged) * PER_JOINT
        + words * COVERED * texels * PER_SMOOTHED,
        "measure": 2 * looked * PER_LOOK,
        "asset": 2 * texels * PER_TEXEL,
        "scene": 2 * texels * PER_TEXEL,
        "report": 5 + s.report.frames * s.report.resolution**2 * s.report.spp * PER_SAMPLE_RAY,
    }
    kept = sum(12 * n for n, whole in zip(averaged, sizes, strict=True) if n < whole)
    return {
        "mesh": str(job.mesh),
        "references": str(job.references),
        "pictures": len(sizes),
        "megapixels": round(sum(sizes) / 1e6, 1),
        **_costs(job, MATERIAL_STAGES, seconds, extent.sets),
        "memory_gb": material_gb(chosen, sizes, *size),
        "in_files": False,
        "peaks_gb": peaks(MATERIAL, material_counts(s, sizes, *size)),
        "disk_gb": round((texels * BYTES_PER_TEXEL + kept) / 1e9, 2),
    }


def extent_of(mesh: Path, settings: Any) -> Extent:
    """How large the asset of a mesh file will be; the file is read, but nothing is unwrapped."""
    files = input_files(mesh)
    stamps = tuple((str(file), file.stat().st_mtime_ns, file.stat().st_size) for file in files)
    return _extent(mesh, settings.read.uv, settings.read.max_faces, settings.atlas.size, stamps)


@lru_cache(maxsize=64)  # a batch names few meshes many times
def _extent(mesh: Path, uv: Literal["keep", "new", "auto"], max_faces: int, size: int, stamps: object) -> Extent:
    """`stamps` tells a file that was changed from what it was."""
    from mistyle.files.read import read_extent

    return read_extent(mesh, uv=uv, max_faces=max_faces, size=size)


def _finishing(settings: Settings) -> dict[str, float]:
    """Seconds of the stage 'finish', where it is wanted, with the crops that judge it before and after."""
    from mistyle.stages.finish_settings import JUDGED

    chosen = settings.finish
    if chosen.method == "off":
        return {}
    return {"finish": (chosen.steps + 2 * JUDGED) * chosen.crops * chosen.crop_size**2 * PER_VGG_PIXEL}


def _reading(extent: Extent) -> float:
    """Seconds of the stage 'mesh'."""
    return 1 + extent.unwrapped * PER_UNWRAPPED_FACE


def _memory(
    settings: Any,
    count: Callable[[Any], Counts],
    plain: Mapping[str, Need],
    tiled: Mapping[str, Need],
    keys: Sequence[str],
) -> dict[str, Any]:
    """GB at most and of each stage, and whether large arrays will lie in files; refuses what the job would refuse."""
    tile = must_tile(settings, count, plain, tiled, keys)
    return {
        "memory_gb": within_gb(settings, count(settings), plain, tiled),
        "in_files": tile,
        "peaks_gb": peaks(tiled if tile else plain, count(settings)),
    }


def _costs(job: Any, stages: Mapping[str, str], seconds: Mapping[str, float], sets: int) -> dict[str, Any]:
    scale = 2 / thread_count(job.settings)
    return {
        "out": str(job.out),
        "name": job.name,
        "texture_sets": sets,
        "stages": [{"stage": k, "what": stages[k], "seconds": round(v * scale, 1)} for k, v in seconds.items()],
        "seconds": round(sum(seconds.values()) * scale),
        "free_gb": round(shutil.disk_usage(existing(job.out)).free / 1e9, 1),
    }


def existing(folder: Path) -> Path:
    """The folder, or the nearest one above it that is there."""
    folder = folder.absolute()
    return folder if folder.exists() else existing(folder.parent)


def describe_plan(estimate: dict[str, Any]) -> str:
    """The plan as a person reads it."""
    if "style" in estimate:
        relation = f"in the style of {estimate['style']}"
    elif "views" in estimate:
        relation = f"in {estimate['views']}"
    else:
        told = f"{estimate['pictures']} pictures, {estimate['megapixels']} megapixels"
        relation = f"from {told} of {estimate['references']}"
    lines = [f"{estimate['mesh']} {relation} -> {estimate['out']}"]
    lines += [f"  {row['what']:<36} about {row['seconds']:7.1f} s" for row in estimate["stages"]]
    sets = "1 texture set" if estimate["texture_sets"] == 1 else f"{estimate['texture_sets']} texture sets"
    lines.append(f"  in all about {estimate['seconds']} s for {sets}, without reused stages")
    files = ", large arrays in files" if estimate["in_files"] else ""
    lines.append(f"  memory at most about {estimate['memory_gb']} GB{files}")
    lines.append(f"  disk about {estimate['disk_gb']} GB; free there: {estimate['free_gb']} GB")
    return "\n".join(lines)
