"""Estimates of `--dry-run` for a fit to pictures; see jobs/plan.py."""

from collections.abc import Sequence
from typing import Any

from mistyle.core.light import has_soft
from mistyle.fitting.pipeline.budget import (
    averaged_pixels,
    check_material,
    in_files,
    material_counts,
    material_gb,
    needs_of,
)
from mistyle.fitting.pipeline.job import MATERIAL_STAGES
from mistyle.fitting.pipeline.photometry import photometry_mode
from mistyle.fitting.pipeline.times import FIRST_PICTURES, closing_stages, recover_seconds
from mistyle.jobs.memory_budget import peaks
from mistyle.jobs.plan import (
    BYTES_PER_TEXEL,
    PER_READ_PIXEL,
    PER_TEXEL,
    costs,
    extent_of,
    reading,
)
from mistyle.jobs.settings import thread_count
from mistyle.jobs.stages import claim_run
from mistyle.solver.schedule import COVERED, FILLED, SHOWN

LIGHT_SECONDS = 12  # of an unknown light, of few observations whatever the pictures
PER_ALIGNED = 0.1  # a picture that is placed, and its outline checked
EXPLAINED_SECONDS = 20  # of exposures with a material
PHOTOMETRY_SECONDS = 12  # the number of points is bounded
READS = 1.5  # of every picture for each of both


def plan_material(job: Any) -> dict[str, Any]:
    """The plan of a `MaterialJob`; cameras, lights and pictures' headers are read and refused as the job does.

    The object's share of the pictures is still unknown: solver/schedule.py and fitting/pipeline/budget.py give typical
    shares.
    """
    from mistyle.fitting.pipeline.material import inputs_of, pixels_of, references_of
    from mistyle.io.cameras.captures import read_shots

    s, extent = job.settings, extent_of(job.mesh, job.settings)
    claim_run(job, MATERIAL_STAGES, inputs_of(job))
    size = extent.faces, extent.sets, extent.own
    captures = references_of(job)
    sizes = pixels_of(captures)
    texels = extent.sets * s.atlas.size**2
    chosen = check_material(s, sizes, *size)
    shots = read_shots(job.references, masks=job.masks, exposure=job.exposure, pictures=job.pictures)
    averaged, shown = averaged_pixels(s, sizes), SHOWN if masked(shots) else FILLED
    unknown, reads = job.lights == "unknown", READS * sum(sizes) * PER_READ_PIXEL
    matched = photometry_mode(job, shots) != "none"
    soft = unknown or has_soft(captures.lights)
    stages = {
        "mesh": reading(extent),
        "texels": texels * PER_TEXEL,
        "cameras": 1 + PER_ALIGNED * len(sizes) + first_asset_seconds(sizes),
        **({"photometry": PHOTOMETRY_SECONDS + reads} if matched else {}),
        **({"exposures": EXPLAINED_SECONDS + unknown * LIGHT_SECONDS + reads} if matched else {}),
        "pictures": sum(sizes) * PER_READ_PIXEL,
        **({"light": 1 if matched else LIGHT_SECONDS} if unknown else {}),
        "recover": recover_seconds(s, averaged, COVERED * texels, soft, shown),
        **closing_stages(s, averaged, texels, soft, shown),
    }
    stored = sum(12 * n for n, whole in zip(averaged, sizes, strict=True) if n < whole)
    return {
        "mesh": str(job.mesh),
        "references": str(job.references),
        "pictures": len(sizes),
        "megapixels": round(sum(sizes) / 1e6, 1),
        **costs(job, MATERIAL_STAGES, _limited(s, stages), extent.sets),
        "memory_gb": material_gb(chosen, sizes, *size),
        "in_files": in_files(s, sizes, *size),
        "peaks_gb": peaks(needs_of(s, sizes, *size), material_counts(s, sizes, *size)),
        "disk_gb": round((texels * BYTES_PER_TEXEL + stored) / 1e9, 2),
    }


def first_asset_seconds(sizes: list[int]) -> float:
    """Seconds of reading and projecting the few pictures of the first asset, of so many pixels each."""
    return 1 + sum(sizes) * min(1, FIRST_PICTURES / len(sizes)) * PER_READ_PIXEL


def masked(shots: Sequence[Any]) -> bool:
    """Whether a picture has a mask or alpha, so that the object is likely to fill less of it."""
    return any(shot.mask is not None or shot.alpha_of is not None for shot in shots)


def _limited(settings: Any, stages: dict[str, float]) -> dict[str, float]:
    """The stages with "recover" ended by `--minutes`, if it would take longer."""
    if not settings.minutes:
        return stages
    threads = thread_count(settings) / 2
    left = 60 * settings.minutes * threads - sum(v for k, v in stages.items() if k != "recover")
    return stages | {"recover": min(stages["recover"], max(left, 0))}
