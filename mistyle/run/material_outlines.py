"""Whether the cameras of `mistyle fit` and `mistyle bake` fit the mesh, as the user hears of it."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from mistyle.core.mesh import Mesh
from mistyle.core.view import View
from mistyle.run.material_settings import LEAST_OVERLAP, ReferenceSettings
from mistyle.run.progress import Progress


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
    from mistyle.stages.outline_check import overlap_line

    if np.isfinite(placed.overlap).any():
        progress.say(overlap_line([camera.name for camera in placed.cameras], placed.overlap))
    for text in placed.notes:
        if text.startswith("Warning:"):
            progress.say(text)
    progress.note(*placed.notes)


def tell_views(mesh: Mesh, views: Sequence[View], progress: Progress) -> None:
    """The same for the pictures of `mistyle bake`, whose alpha is their coverage."""
    from mistyle.stages.outline_check import check_outlines, overlap_line, overlap_notes

    names = [view.camera.name for view in views]
    found = check_outlines(mesh, [view.camera for view in views], (view.coverage > 0.5 for view in views))
    if np.isfinite(found.overlap).any():
        progress.say(overlap_line(names, found.overlap))
    fix = "Check the cameras' axes, and that they are in working units (camera.json of `mistyle render`)."
    progress.note(*overlap_notes(names, found, LEAST_OVERLAP, fix, trusted=True))
