"""Estimates of `--dry-run` for a fit to pictures; see jobs/plan.py."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from mistyle.core.capture import Captures
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
from mistyle.fitting.pipeline.pictures import pixels_of
from mistyle.fitting.pipeline.times import (
    FIRST_PICTURES,
    LIGHT_SECONDS,
    closing_stages,
    explaining_seconds,
    reading_seconds,
    recover_seconds,
    running,
)
from mistyle.geometry.similarity import moved, upright
from mistyle.io.meshes.parsed_mesh import Extent
from mistyle.jobs.memory_budget import peaks
from mistyle.jobs.plan import (
    BYTES_PER_TEXEL,
    PER_READ_PIXEL,
    PER_TEXEL,
    costs,
    extent_of,
    machine_scale,
    reading,
)
from mistyle.jobs.stages import claim_run
from mistyle.solver.schedule import COVERED, FILLED, TYPICAL, Visible

if TYPE_CHECKING:
    from mistyle.io.cameras.captures import CapturedPicture

STARTING = 1  # of the program
ALIGNED = 1.5  # of a mesh that is aligned
PER_OUTLINE = 0.003  # a picture that is placed, and its outline checked
PER_MATCHED = 0.15  # a picture whose exposure is solved by points
# Of an unknown light where exposures are solved: the mean of fits that they gave the light and of others.
LEFT_LIGHT = 6
PER_FIRST_TEXEL, FIRST_TEXELS = 3e-6, 512**2  # a texel of the first asset, and most of them


def plan_material(job: Any) -> dict[str, Any]:
    """The plan of a `MaterialJob`; cameras, lights and pictures' headers are read and refused as the job does.

    How much the pictures show of the mesh is measured, unless it must be aligned first: solver/schedule.py then gives
    typical shares.
    """
    from mistyle.fitting.pipeline.material import inputs_of, references_of
    from mistyle.io.cameras.captures import read_shots

    s, extent = job.settings, extent_of(job.mesh, job.settings)
    claim_run(job, MATERIAL_STAGES, inputs_of(job))
    size = extent.faces, extent.sets, extent.own
    captures = references_of(job)
    sizes = pixels_of(captures)
    texels = extent.sets * s.atlas.size**2
    covered = texels * (extent.covered if extent.covered > 0 else COVERED)
    shots = read_shots(job.references, masks=job.masks, exposure=job.exposure, pictures=job.pictures)
    averaged, visible = averaged_pixels(s, sizes), shares_of(job, (captures, shots), extent)
    read = reading_seconds(shots, sizes)
    unknown, matched = job.lights == "unknown", photometry_mode(job, shots) != "none"
    soft = unknown or has_soft(captures.lights)
    s = running(s, soft, texels, visible.shown * sum(averaged))
    chosen = check_material(s, sizes, *size)
    stages = {
        "mesh": STARTING + reading(extent),
        "texels": texels * PER_TEXEL,
        "cameras": cameras_seconds(job, shots, sizes) + first_asset_seconds(len(sizes), texels, read),
        **({"photometry": 8 + PER_MATCHED * len(sizes) + read} if matched else {}),
        **({"exposures": sum(explaining_seconds(len(sizes), read, unknown))} if matched else {}),
        "pictures": read,
        **({"light": LEFT_LIGHT if matched else LIGHT_SECONDS} if unknown else {}),
        "recover": recover_seconds(s, averaged, covered, soft, visible),
        **closing_stages(s, averaged, texels, soft, visible),
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


def first_asset_seconds(count: int, texels: float, read: float) -> float:
    """Seconds of projecting few of `count` pictures, all of which take `read` seconds to be read."""
    return 0.2 + min(1, FIRST_PICTURES / count) * read + min(texels, FIRST_TEXELS) * PER_FIRST_TEXEL


def cameras_seconds(job: Any, shots: Sequence["CapturedPicture"], sizes: Sequence[int]) -> float:
    """Seconds of placing the cameras: masks, and pictures that can have an alpha, are read."""
    from mistyle.io.cameras.captures import may_have_alpha

    masked = sum(n for n, shot in zip(sizes, shots, strict=True) if shot.mask is not None or may_have_alpha(shot))
    aligned = ALIGNED * (job.settings.references.align + job.settings.references.refine_poses * len(sizes))
    return 0.1 + aligned + PER_OUTLINE * len(sizes) + masked * PER_READ_PIXEL


def shares_of(job: Any, references: tuple[Captures, Sequence["CapturedPicture"]], extent: Extent) -> Visible:
    """The shares of the mesh in the pictures. Typical ones where it must be aligned first: with masks or alpha the
    object is likely to fill less of a picture."""
    from mistyle.io.cameras.captures import camera_space
    from mistyle.solver.visible import visible_shares

    captures, shots = references
    if not job.settings.references.align:
        own = camera_space(job.references) == "own"
        placed = upright(captures) if job.settings.references.up == "z" else captures
        placed = moved(placed, extent.work_from_user) if own else placed
        return visible_shares(extent.surface, placed.cameras, placed.lights)
    masked = any(shot.mask is not None or shot.alpha_of is not None for shot in shots)
    return TYPICAL if masked else Visible(FILLED, FILLED, FILLED)


def _limited(settings: Any, stages: dict[str, float]) -> dict[str, float]:
    """The stages with "recover" ended by `--minutes`, if it would take longer."""
    if not settings.minutes:
        return stages
    left = 60 * settings.minutes / machine_scale(settings) - sum(v for k, v in stages.items() if k != "recover")
    return stages | {"recover": min(stages["recover"], max(left, 0))}
