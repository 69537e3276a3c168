"""Messages of `mistyle fit` about cameras that do not fit the mesh, and about a mesh that is not upright."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from mistyle.core.asset import UpAxis
from mistyle.core.camera import Camera
from mistyle.fitting.settings.material import ReferenceSettings
from mistyle.jobs.progress import Progress


def camera_advice(chosen: ReferenceSettings, found: Any) -> str:
    """The advice for cameras whose `found` outlines do not fit, without the options already in use."""
    from mistyle.solver.cameras.outline_check import MESH_Z_UP, Z_UP

    best = max(found.turned, key=lambda name: found.turned[name], default=None)
    if chosen.up == "y" and best == Z_UP and found.turned[best] >= chosen.overlap:
        return "Blender's world has Z up and a glTF file Y up: --set references.up=z turns such cameras and lights."
    if chosen.up == "y" and not chosen.align and best == MESH_Z_UP and found.turned[best] >= chosen.overlap:
        return "The mesh's file has Z up and the cameras' world Y up: use --align, or write the mesh with Y up."
    options = [f"--{name.replace('_', '-')}" for name in ("align", "refine_poses") if not getattr(chosen, name)]
    start = f"Try {' and '.join(options)}; check" if options else "Check"
    return (
        f"{start} the cameras' axes and units, and that pictures and masks belong to these cameras. "
        "Masks that omit parts of the object lower the overlap too."
    )


# Upwards in the pixels that a file stores, x right and y down, by its EXIF orientation 1..8.
UPWARDS = ((0, -1), (0, -1), (0, 1), (0, 1), (-1, 0), (-1, 0), (1, 0), (1, 0))
AGREED = 0.4  # length of the mean upward direction of pictures, below which they show none
TILTED, ALONG = 0.5, 0.8  # cosines: of a mesh that is not upright, and of an axis that is


def upright_note(
    cameras: Sequence[Camera], orientations: Sequence[int], turn: Float[np.ndarray, "3 3"], up: UpAxis
) -> tuple[str, ...]:
    """A note where the cameras (working space) show that another axis of the mesh's file points up. People hold a
    camera upright: its upward direction, on average of pictures from around, is that of the world.

    orientations  EXIF's, of pictures whose camera describes the stored pixels; else 1
    turn          working axes from those of the file, times any factor
    """
    across, down = (np.stack([c.world_from_cam[:3, k] for c in cameras]) for k in (0, 1))
    x, y = np.array([UPWARDS[k - 1] for k in orientations], float).T[..., None]
    mean = (x * across + y * down).mean(axis=0)
    length = float(np.linalg.norm(mean))
    if length < AGREED or mean[1] > TILTED * length:
        return ()
    own = turn.T @ mean / np.linalg.norm(turn.T @ mean)
    along = {"y": own[1], "z": own[2], "-y": -own[1], "-z": -own[2]}
    best = max(along, key=lambda axis: along[axis])
    if along[best] < ALONG or best == up:
        return ()
    turned = " If the mesh is upright, --set references.up=z turns the cameras." if best == "z" else ""
    return (
        f"The mesh is not upright: by the cameras {best.upper()} of its file points up. --up={best} turns it.{turned}",
    )


def report_placement(placed: Any, progress: Progress) -> None:
    """Print every picture's outline overlap, and warnings about cameras at once, since the fit takes long."""
    from mistyle.solver.cameras.outline_check import overlap_line

    if np.isfinite(placed.overlap).any():
        progress.say(overlap_line([camera.name for camera in placed.cameras], placed.overlap))
    for text in placed.notes:
        if text.startswith("Warning:"):
            progress.say(text)
    progress.note(*placed.notes)
