"""Estimates of `--dry-run` for a fit to pictures; see jobs/plan.py."""

from typing import Any

from mistyle.fitting.pipeline.budget import (
    MATERIAL,
    averaged_pixels,
    check_material,
    material_counts,
    material_gb,
)
from mistyle.fitting.pipeline.job import MATERIAL_STAGES
from mistyle.jobs.memory_budget import peaks
from mistyle.jobs.plan import (
    BYTES_PER_TEXEL,
    PER_LOOK,
    PER_READ_PIXEL,
    PER_SAMPLE_RAY,
    PER_TEXEL,
    SHOWN,
    costs,
    extent_of,
    reading,
    solving,
)
from mistyle.jobs.stages import claim_run


def plan_material(job: Any) -> dict[str, Any]:
    """The plan of a `MaterialJob`; cameras, lights and pictures' headers are read and refused as the job does.

    The object's share of the pictures is still unknown: fitting/pipeline/budget.py gives typical shares.
    """
    from mistyle.fitting.pipeline.material import inputs_of, pixels_of, references_of

    s, extent = job.settings, extent_of(job.mesh, job.settings)
    claim_run(job, MATERIAL_STAGES, inputs_of(job))
    size = extent.faces, extent.sets, extent.own
    sizes = pixels_of(references_of(job))
    texels = extent.sets * s.atlas.size**2
    chosen = check_material(s, sizes, *size)
    averaged = averaged_pixels(s, sizes)
    seconds = {
        "mesh": reading(extent),
        "texels": texels * PER_TEXEL,
        "cameras": 1,
        "pictures": sum(sizes) * PER_READ_PIXEL,
        "recover": solving(s.recover, averaged, texels),
        "measure": 2 * SHOWN * sum(averaged) * s.recover.subsamples * PER_LOOK,
        "asset": 2 * texels * PER_TEXEL,
        "scene": 2 * texels * PER_TEXEL,
        "report": 5 + s.report.frames * s.report.resolution**2 * s.report.spp * PER_SAMPLE_RAY,
    }
    stored = sum(12 * n for n, whole in zip(averaged, sizes, strict=True) if n < whole)
    return {
        "mesh": str(job.mesh),
        "references": str(job.references),
        "pictures": len(sizes),
        "megapixels": round(sum(sizes) / 1e6, 1),
        **costs(job, MATERIAL_STAGES, seconds, extent.sets),
        "memory_gb": material_gb(chosen, sizes, *size),
        "in_files": False,
        "peaks_gb": peaks(MATERIAL, material_counts(s, sizes, *size)),
        "disk_gb": round((texels * BYTES_PER_TEXEL + stored) / 1e9, 2),
    }
