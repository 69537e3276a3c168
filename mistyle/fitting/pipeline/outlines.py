"""Messages of `mistyle fit` about cameras that do not fit the mesh."""

from typing import Any

import numpy as np

from mistyle.fitting.settings.material import ReferenceSettings
from mistyle.jobs.progress import Progress


def camera_advice(chosen: ReferenceSettings, found: Any) -> str:
    """The advice for cameras whose `found` outlines do not fit, without the options already in use."""
    from mistyle.solver.cameras.outline_check import Z_UP

    best = max(found.turned, key=lambda name: found.turned[name], default=None)
    if chosen.up == "y" and best == Z_UP and found.turned[best] >= chosen.overlap:
        return "Blender's world has Z up and a glTF file Y up: --set references.up=z turns such cameras and lights."
    options = [f"--{name.replace('_', '-')}" for name in ("align", "refine_poses") if not getattr(chosen, name)]
    start = f"Try {' and '.join(options)}; check" if options else "Check"
    return (
        f"{start} the cameras' axes and units, and that pictures and masks belong to these cameras. "
        "Masks that omit parts of the object lower the overlap too."
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
