"""Whether the cameras of `mistyle fit` fit the mesh, as the user hears of it."""

from typing import Any

import numpy as np

from mistyle.fitting.settings.material import ReferenceSettings
from mistyle.jobs.progress import Progress


def fix_of(chosen: ReferenceSettings) -> str:
    """What helps cameras that do not fit, beyond what was asked for already."""
    options = [f"--{name.replace('_', '-')}" for name in ("align", "refine_poses") if not getattr(chosen, name)]
    start = f"Try {' and '.join(options)}; check" if options else "Check"
    return (
        f"{start} the cameras' axes and units, and that pictures and masks are those that the cameras were "
        "made for. Masks that leave out parts of the object lower the overlap too."
    )


def tell_placed(placed: Any, progress: Progress) -> None:
    """Every picture's overlap of outlines, and a warning about the cameras at once, as the fit takes long."""
    from mistyle.solver.cameras.outline_check import overlap_line

    if np.isfinite(placed.overlap).any():
        progress.say(overlap_line([camera.name for camera in placed.cameras], placed.overlap))
    for text in placed.notes:
        if text.startswith("Warning:"):
            progress.say(text)
    progress.note(*placed.notes)
