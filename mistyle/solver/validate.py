"""Validation of reference pictures, and factors by which they can be downsampled."""

from collections.abc import Sequence

import numpy as np

from mistyle.core.camera import Camera, in_frame, px_from_world
from mistyle.core.capture import Captures, subset
from mistyle.core.errors import InputRefused
from mistyle.core.light import Lights
from mistyle.core.maps import Texels
from mistyle.core.mesh import Mesh
from mistyle.solver.texels.observations import texel_sizes

LEAST_VIEWS = 3
FINE = 0.25  # largest share of texels narrower than ACROSS blocks of averaged pixels
ACROSS = 2
MANY = 2**22  # texels beyond which a part of them, at least a quarter of so many, is judged
LEAST_PIXELS = 32  # along the shorter side of a downsampled picture


def validate_captures(mesh: Mesh, captures: Captures, notes: list[str]) -> Captures:
    """The usable pictures; notes name the others. Raises InputRefused for a picture whose size differs from its
    camera's, and if none is usable."""
    if len(captures) == 0:
        raise InputRefused("Found no reference pictures; expected at least three views of the object.")
    usable, silent = [], []
    for k, camera in enumerate(captures.cameras):
        rgb, mask = captures.load(k)
        if rgb.shape[:2] != camera.size or mask.shape != camera.size:
            size, expected = "x".join(map(str, rgb.shape[1::-1])), "x".join(map(str, camera.size[::-1]))
            raise InputRefused(
                f"Picture '{camera.name}' has {size} pixels, its camera {expected}. Resize one to the other's size."
            )
        reason = _rejection(mesh, camera, captures.lights[k], rgb, mask)
        (silent if reason else usable).append((k, reason))
    for k, reason in silent:
        notes.append(f"Picture '{captures.cameras[k].name}' is skipped: {reason}.")
    if not usable:
        reasons = "; ".join(sorted({reason for _, reason in silent}))
        raise InputRefused(f"None of {len(captures)} reference pictures can be used ({reasons}). Check cameras, masks"
                           " and exposure.")  # fmt: skip
    views = {captures.cameras[k].world_from_cam.tobytes() for k, _ in usable}
    if len(views) < LEAST_VIEWS:
        notes.append(
            f"Only {len(views)} different view(s) can be used: the fit is singular, normals and roughness are not"
            f" reliable. Use at least {LEAST_VIEWS} views, better 16 around the object."
        )
    return subset(captures, [k for k, _ in usable])


def _rejection(mesh: Mesh, camera: Camera, lights: Lights, rgb: np.ndarray, mask: np.ndarray) -> str:
    """The reason why a picture cannot be used, or an empty string."""
    px, depth = px_from_world(camera, mesh.positions.astype(np.float64))
    if not (in_frame(camera, px) & (depth > 0)).any():
        return "its camera cannot see the mesh"
    if not lights:
        return "it has no light"
    if not mask.any():
        return "none of its pixels is valid (all are saturated, masked or not finite)"
    if not (rgb[mask] > 0).any():
        return "it is all black"
    return ""


def downsampling_factors(texels: Sequence[Texels], cameras: Sequence[Camera]) -> list[int]:
    """Downsampling factor of each camera's picture at which texels are still ACROSS blocks wide.

    At least three in four of the texels that face the camera, hidden ones included, are that wide. With texels one
    block wide the normals' error nearly doubles; with four it falls by a quarter (`python -m benchmarks.photographs`).
    """
    covered = [t.covered for t in texels]
    position, normal = (
        np.concatenate([field[c] for field, c in zip(fields, covered, strict=True)])
        for fields in ([t.position for t in texels], [t.normal for t in texels])
    )
    size = np.concatenate([texel_sizes(t)[c.ravel()] for t, c in zip(texels, covered, strict=True)])
    if len(size) > MANY:
        position, normal, size = (a[:: len(size) // (MANY // 4)] for a in (position, normal, size))
    result = []
    for camera in cameras:
        px, depth = px_from_world(camera, position)
        facing = ((camera.position - position) * normal).sum(axis=1) > 0
        visible = facing & (depth > 0) & (size > 0) & in_frame(camera, px)
        wide = size[visible] * camera.focal / depth[visible] / ACROSS
        most = max(1, min(camera.size) // LEAST_PIXELS)
        result.append(int(np.clip(np.quantile(wide, FINE), 1, most)) if len(wide) else 1)
    return result
