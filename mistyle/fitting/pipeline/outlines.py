"""Messages of `mistyle fit` about cameras that do not fit the mesh."""

from typing import Any

import numpy as np

from mistyle.fitting.settings.material import ReferenceSettings
from mistyle.jobs.progress import Progress


def camera_advice(chosen: ReferenceSettings) -> str:
    """The advice for cameras that do not fit, without the options already in use."""
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
