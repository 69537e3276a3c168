"""The refusal of pictures that observe no texel of the mesh: a fit would take long and deliver its start values."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from mistyle.atlas.texels import rasterise
from mistyle.core.asset import Asset
from mistyle.core.camera import Camera
from mistyle.core.capture import Captures, Loaded, evenly_lit, shrunk_to, subset
from mistyle.core.errors import InputRefused
from mistyle.core.maps import Texels
from mistyle.core.rows import evenly
from mistyle.fitting.pipeline.job import MaterialJob
from mistyle.fitting.pipeline.times import FIRST_PICTURES
from mistyle.render.mitsuba.draw import Tracer, tracer
from mistyle.solver.texels.observations import ObservationOptions, collect_observations

SIDE, ATLAS = 512, 512  # pixels along the longer side of a small picture, texels a side
# The finer and the coarser of two units that people mix up, by their ratio.
UNITS = {1000: ("millimetres", "metres"), 100: ("centimetres", "metres"), 10: ("millimetres", "centimetres")}
NEAR = 10**0.5  # largest factor between a ratio and that of two units
PARALLEL = 1e-3  # mean squared sine of the axes' angles, below which they meet in no point


def refuse_unseen(job: MaterialJob, asset: Asset, captures: Captures) -> None:
    """InputRefused where no picture observes a texel in its light; cameras and lights are in working space.

    The first small picture answers for almost every job. Only where a few of them show nothing, all pictures are
    read at their own size.
    """
    lit = captures if any(captures.lights) else evenly_lit(captures)
    traced = tracer(asset.mesh)
    texels = [rasterise(asset.mesh, part, min(ATLAS, job.settings.atlas.size)) for part in range(len(asset.mesh.parts))]
    facing = job.settings.recover.facing
    few = shrunk_to(subset(lit, evenly(len(lit), FIRST_PICTURES)), SIDE)
    if any(observed(traced, texels, subset(few, [k]), facing) for k in range(len(few))):
        return
    if not observed(traced, texels, lit, facing):
        raise refusal(job, asset, captures, (traced, texels, lit))


def observed(traced: Tracer, texels: Sequence[Texels], captures: Captures, facing: float) -> bool:
    """Whether a picture observes a texel in the light."""
    options = ObservationOptions(facing, skies=False)
    return bool(collect_observations(traced, texels, captures, None, options).seen.any())


def refusal(
    job: MaterialJob, asset: Asset, captures: Captures, judged: tuple[Tracer, Sequence[Texels], Captures]
) -> InputRefused:
    """The reason why nothing is observed: the cameras, the lights or the pictures' valid pixels. `judged`: the
    arguments of `observed`."""
    from mistyle.io.cameras.captures import camera_space, check_pixels

    traced, texels, lit = judged
    facing, own = job.settings.recover.facing, camera_space(job.references) == "own"
    blank = Captures(lit.cameras, lit.lights, lambda k: _all_valid(lit.cameras[k]))
    start = f"{job.references}: no picture shows a texel of {job.mesh.name}"
    aligned = job.settings.references.align
    unit = float(np.cbrt(np.linalg.det(asset.source.work_from_user[:3, :3]))) if own else 1.0
    where, fix = distances(captures.cameras, unit), advice(own, aligned)
    if not observed(traced, texels, evenly_lit(blank), facing):
        return InputRefused(f"{start}. {where} Expected cameras around the mesh that look at it. {fix}")
    if not observed(traced, texels, blank, facing):
        return InputRefused(
            f"{start} in the light: the cameras see the mesh, but all that they see is in shadow. Expected lights that "
            f"reach it. Check positions, directions and frames in lights.json. {where}"
        )
    check_pixels(captures)
    return InputRefused(
        f"{start} in a valid pixel: alpha or masks leave out all that the cameras see of it. Expected them to keep the "
        f"object. {where} Check the masks. {fix}"
    )


def distances(cameras: Sequence[Camera], unit: float) -> str:
    """The size of the mesh, the cameras' median distances from its centre and from the point that they look at, and the
    units that these suggest. The cameras are in working space, where the mesh's sphere has radius 1; `unit` is one unit
    of the mesh's file. A scale about the origin moves the mesh's centre too, so the ratio is that of the point."""
    away = float(np.median([np.linalg.norm(camera.position) for camera in cameras]))
    target = looked_at(cameras)
    to_target = float(np.median([np.linalg.norm(camera.position - target) for camera in cameras]))
    fits = float(np.median([np.hypot(1, 2 * camera.focal / min(camera.size)) for camera in cameras]))
    found = (
        f"The mesh is {_short(2 / unit)} across; the cameras are {_short(away / unit)} from its centre"
        f"{', inside its bounding sphere,' if away < 1 else ''} and look at a point {_short(to_target / unit)} away."
    )
    ratio = max(to_target, 1e-12) / fits
    factor = max(ratio, 1 / ratio)
    near = next((times for times in UNITS if times / NEAR <= factor < times * NEAR), None)
    if near is None:
        return found
    mesh, other = UNITS[near] if ratio < 1 else UNITS[near][::-1]
    return f"{found} A factor near {near} suggests a mesh in {mesh} and cameras in {other}."


def looked_at(cameras: Sequence[Camera]) -> Float[np.ndarray, "3"]:
    """The point nearest to all optical axes; the mesh's centre for axes that are nearly parallel."""
    axes = np.stack([camera.world_from_cam[:3, 2] for camera in cameras])
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    if np.linalg.eigvalsh(across.mean(axis=0))[0] < PARALLEL:
        return np.zeros(3)
    places = np.stack([camera.position for camera in cameras])
    return np.linalg.solve(across.sum(axis=0), np.einsum("nij,nj->i", across, places))


def advice(own: bool, aligned: bool) -> str:
    """The fix for cameras in the mesh's `own` units or in working space, without --align where it is in use."""
    if aligned:
        return "The cameras were aligned already: check that the pictures show this mesh."
    scale = "scale the mesh to the cameras' unit" if own else (
        "write the cameras for a mesh in its bounding sphere of radius 1, which camera.json expects"
    )  # fmt: skip
    return f"Use --align (it needs alpha, masks or a reconstruction's points), or {scale}."


def _all_valid(camera: Camera) -> Loaded:
    return np.ones((*camera.size, 3), np.float32), np.ones(camera.size, bool)


def _short(value: float) -> str:
    """Three digits, without an exponent up to a million."""
    return f"{float(f'{value:.3g}'):g}"
