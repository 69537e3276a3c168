"""Estimates of `--dry-run` for a fit to pictures; see jobs/plan.py."""

from typing import Any

from mistyle.fitting.pipeline.budget import (
    COVERED,
    MATERIAL,
    SEEN,
    SHOWN,
    averaged_pixels,
    check_material,
    material_counts,
    material_gb,
)
from mistyle.fitting.pipeline.job import MATERIAL_STAGES
from mistyle.jobs.memory_budget import peaks
from mistyle.jobs.plan import (
    BYTES_PER_TEXEL,
    PER_BOUNCED_PATH,
    PER_JOINT,
    PER_LOOK,
    PER_OBSERVATION,
    PER_READ_PIXEL,
    PER_SAMPLE_RAY,
    PER_SMOOTHED,
    PER_TEXEL,
    costs,
    extent_of,
    reading,
)
from mistyle.jobs.stages import claim_run
from mistyle.solver.settings import all_rounds, descent_steps, estimates, joint_estimates, joint_steps, passes

PHOTOMETRY_SECONDS = 15  # the number of points is bounded


def plan_material(job: Any) -> dict[str, Any]:
    """The plan of a `MaterialJob`; cameras, lights and pictures' headers are read and refused as the job does.

    The object's share of the pictures is still unknown: fitting/pipeline/budget.py gives typical shares.
    """
    from mistyle.fitting.pipeline.material import inputs_of, pixels_of, references_of
    from mistyle.solver.indirect import MOST
    from mistyle.solver.texels.rounds import STARTS

    s, extent = job.settings, extent_of(job.mesh, job.settings)
    claim_run(job, MATERIAL_STAGES, inputs_of(job))
    size = extent.faces, extent.sets, extent.own
    sizes = pixels_of(references_of(job))
    texels = extent.sets * s.atlas.size**2
    chosen = check_material(s, sizes, *size)
    averaged = averaged_pixels(s, sizes)
    sampled, observed = SHOWN * sum(averaged) * s.recover.subsamples, COVERED * SEEN * texels * len(sizes)
    solves = s.recover.solver != "pictures"
    rounds, estimated = solves * all_rounds(s.recover, len(sizes)), estimates(s.recover, len(sizes))
    begun = solves * (1 + len(estimated[0]))
    steps, joint = descent_steps(s.recover), joint_steps(s.recover)
    samples = solves * sum(sum(part) for part in estimated)
    again = joint_estimates(s.recover)
    samples += sum(again)
    paths = samples * sum(min(n, MOST**2) for n in averaged)
    smoothings = solves * s.recover.smooth * (1 + (steps > 0) * len(passes(s.recover, len(sizes))))
    seconds = {
        "mesh": reading(extent),
        "texels": texels * PER_TEXEL,
        "cameras": 1,
        "photometry": PHOTOMETRY_SECONDS + 1.5 * sum(sizes) * PER_READ_PIXEL if job.lights == "unknown" else 0,
        "pictures": sum(sizes) * PER_READ_PIXEL,
        "recover": (rounds + 2 + steps / len(sizes)) * sampled * PER_LOOK
        + (begun * len(STARTS) / 2 + rounds) * s.recover.solver_iterations * observed * PER_OBSERVATION
        + paths * PER_BOUNCED_PATH
        + joint * max(1, len(again)) * SHOWN * sum(averaged) * PER_JOINT
        + smoothings * COVERED * texels * PER_SMOOTHED,
        "measure": 2 * sampled * PER_LOOK,
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
