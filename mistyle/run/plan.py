"""What a job will do and what it will cost, before it does it (`--dry-run`). Imports nothing heavy.

The times are products of counts and constants that were read off `python -m benchmarks.pipeline` and
`benchmarks.photographs` on two cores of a server; they are guides of a factor of two, not promises. Memory is
`run/budget.py`'s. Disk is what stays in the run folder.
"""

import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from mistyle.core.errors import InputRefused
from mistyle.run.budget import (
    COVERED,
    MATERIAL,
    PLAIN,
    SEEN,
    SHOWN,
    TILED,
    check_material,
    counts,
    looked_at,
    material_counts,
    material_gb,
    memory_gb,
    peaks,
    tiles,
    view_pixels,
)
from mistyle.run.inputs import input_files
from mistyle.run.settings import thread_count
from mistyle.run.stages import MATERIAL_STAGES, STAGES, Job
from mistyle.stages.recover_settings import all_rounds, descent_steps, estimates, joint_estimates, joint_steps, passes

# Seconds on two cores, per unit named.
PER_UNWRAPPED_FACE = 3.6e-4
PER_SAMPLE_RAY = 1.0e-6
PER_SURFACE_SAMPLE = 1.3e-4
PER_TEXEL = 1.0e-6
PER_VIEW_PIXEL = 8.0e-7
PER_CROP_PIXEL = 1.6e-6
# Of fits to pictures: a pixel read and made straight; a sample of one predicted, or stepped on; a texel in a picture; a
# path of light between surfaces; a covered texel in one word of its neighbours.
PER_READ_PIXEL = 8e-7
PER_LOOK = 2e-7
PER_OBSERVATION = 4e-7  # in one step of a solve; of one that begins anew, with two starts
PER_BOUNCED_PATH = 1e-7
PER_SMOOTHED = 1.5e-5
PER_JOINT = 1.5e-5  # of a pixel that shows the object, for each joint step

# Bytes of a face in a file of each kind, roughly; only the time of unwrapping hangs on it.
BYTES_PER_FACE = {".obj": 60, ".ply": 35, ".stl": 50, ".off": 50, ".glb": 40, ".gltf": 40}

BYTES_PER_TEXEL = 190
BYTES_PER_VIEW_PIXEL = 60


def plan(job: Job) -> dict[str, Any]:
    """Stages with estimated seconds, and the disk they take; refuses a missing mesh or picture as the job would."""
    files = input_files(job.mesh)
    if not job.style.is_file():
        raise InputRefused(f"{job.style}: found nothing, expected a picture; check the path")
    s = job.settings
    pixels = view_pixels(s)
    texels = s.atlas.size**2
    faces = _faces(files)
    crops = (s.fit.iterations1 + (s.fit.iterations2 if s.fit.refine == "all" else 0)) * s.fit.crops
    crops *= s.fit.refine != "off"
    frames = s.report.frames * s.report.resolution**2 * s.report.spp
    seconds = {
        "mesh": 1 + (0 if s.read.uv == "keep" else faces * PER_UNWRAPPED_FACE),
        "texels": texels * PER_TEXEL,
        "views": pixels * (s.draw.spp * PER_SAMPLE_RAY * 0.3 + PER_VIEW_PIXEL),
        "surface": s.surface.samples * PER_SURFACE_SAMPLE,
        "bake": 2 * texels * PER_TEXEL + pixels * PER_VIEW_PIXEL,
        "stylized": 2 * pixels * PER_VIEW_PIXEL,
        "fit": crops * s.fit.crop_size**2 * PER_CROP_PIXEL,
        "masks": 0.3 * texels * PER_TEXEL,
        "repair": texels * PER_TEXEL + 0.1 * crops * s.fit.crop_size**2 * PER_CROP_PIXEL,
        "asset": 2 * texels * PER_TEXEL,
        "report": 5 + frames * PER_SAMPLE_RAY,
    }
    return {
        "mesh": str(job.mesh),
        "style": str(job.style),
        **_costs(job, STAGES, seconds),
        "memory_gb": memory_gb(s, faces),
        "in_files": tiles(s, faces),
        "peaks_gb": peaks(TILED if tiles(s, faces) else PLAIN, counts(s, faces)),
        "disk_gb": round((texels * BYTES_PER_TEXEL + 2 * pixels * BYTES_PER_VIEW_PIXEL) / 1e9, 2),
    }


def plan_material(job: Any) -> dict[str, Any]:
    """The same for a `MaterialJob`, whose cameras, lights and pictures' headers are read and refused as it does.

    How much of the pictures shows the object is not known yet: run/budget.py's shares are taken.
    """
    from mistyle.render.indirect import MOST
    from mistyle.run.material import pixels_of, references_of
    from mistyle.stages.recover_solve import STARTS

    s, files = job.settings, input_files(job.mesh)
    sizes = pixels_of(references_of(job))
    faces, texels = _faces(files), s.atlas.size**2
    check_material(s, sizes, faces)
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
        "mesh": 1 + (0 if s.read.uv == "keep" else faces * PER_UNWRAPPED_FACE),
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
        **_costs(job, MATERIAL_STAGES, seconds),
        "memory_gb": material_gb(s, sizes, faces),
        "in_files": False,
        "peaks_gb": peaks(MATERIAL, material_counts(s, sizes, faces)),
        "disk_gb": round((texels * BYTES_PER_TEXEL + kept) / 1e9, 2),
    }


def _faces(files: Sequence[Path]) -> int:
    """Of a mesh in these files, by their size."""
    size = sum(f.stat().st_size for f in files if f.suffix.lower() in (*BYTES_PER_FACE, ".bin"))
    return size // BYTES_PER_FACE.get(files[0].suffix.lower(), 50)


def _costs(job: Any, stages: Mapping[str, str], seconds: Mapping[str, float]) -> dict[str, Any]:
    scale = 2 / thread_count(job.settings)
    return {
        "out": str(job.out),
        "name": job.name,
        "stages": [{"stage": k, "what": stages[k], "seconds": round(v * scale, 1)} for k, v in seconds.items()],
        "seconds": round(sum(seconds.values()) * scale),
        "free_gb": round(shutil.disk_usage(_existing(job.out)).free / 1e9, 1),
    }


def _existing(folder: Path) -> Path:
    """The folder, or the nearest one above it that is there."""
    folder = folder.absolute()
    return folder if folder.exists() else _existing(folder.parent)


def describe_plan(estimate: dict[str, Any]) -> str:
    """The plan as a person reads it."""
    if "style" in estimate:
        relation = f"in the style of {estimate['style']}"
    else:
        told = f"{estimate['pictures']} pictures, {estimate['megapixels']} megapixels"
        relation = f"from {told} of {estimate['references']}"
    lines = [f"{estimate['mesh']} {relation} -> {estimate['out']}"]
    lines += [f"  {row['what']:<36} about {row['seconds']:7.1f} s" for row in estimate["stages"]]
    lines.append(f"  in all about {estimate['seconds']} s, if one texture set is made and nothing is taken over")
    files = ", large arrays in files" if estimate["in_files"] else ""
    lines.append(f"  memory at most about {estimate['memory_gb']} GB{files}")
    lines.append(f"  disk about {estimate['disk_gb']} GB; free there: {estimate['free_gb']} GB")
    return "\n".join(lines)
