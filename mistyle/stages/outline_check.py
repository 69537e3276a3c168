"""Whether cameras fit the mesh: its outline as they see it, against alpha or masks.

The overlap is the intersection over union of the two silhouettes. A frame that is turned, mirrored or in another space
shows in it; a camera that moved along the outline (a ball's own turning) does not.
"""

from collections.abc import Iterable, Iterator, Sequence

import numpy as np
from jaxtyping import Bool

from mistyle.core.camera import Camera
from mistyle.core.image import overlap
from mistyle.core.mesh import Mesh
from mistyle.render.draw import gbuffer, tracer
from mistyle.stages.align import shrunk

SIDE = 160  # pixels of the longer side that is looked at: some 1 % of the overlap


def outline_overlaps(
    mesh: Mesh, cameras: Sequence[Camera], outlines: Iterable[Bool[np.ndarray, "h w"] | None]
) -> Iterator[float]:
    """The overlap 0..1 of each picture; NaN where it has no outline (None, everything or nothing is inside).

    The outlines are of their cameras' size and are asked for one at a time.
    """
    traced = tracer(mesh)
    for camera, outline in zip(cameras, outlines, strict=True):
        if outline is None or outline.all() or not outline.any():
            yield float("nan")
            continue
        small, seen, _ = shrunk(camera, outline, SIDE)
        yield overlap(gbuffer(traced, small).mask, seen)


def overlap_line(names: Sequence[str], overlaps: Sequence[float]) -> str:
    """Every picture's overlap in one line."""
    shown = ", ".join(f"{n} {o:.2f}" for n, o in zip(names, overlaps, strict=True) if np.isfinite(o))
    return f"outlines  overlap of the mesh with alpha or masks: {shown}"


def overlap_notes(names: Sequence[str], overlaps: Sequence[float], least: float, fix: str) -> tuple[str, ...]:
    """What there is to say of overlaps below `least`, or of cameras that could not be checked."""
    known = [(o, n) for n, o in zip(names, overlaps, strict=True) if np.isfinite(o)]
    if not known:
        return (
            "The pictures have neither alpha nor masks with an outline: it was not checked whether the cameras fit the "
            "mesh.",
        )
    bad = sorted(pair for pair in known if pair[0] < least)
    if not bad:
        return ()
    mean = float(np.mean([o for o, _ in known]))
    worst = ", ".join(f"{n} {o:.2f}" for o, n in bad[:3])
    return (
        f"Warning: the cameras do not fit the mesh in {len(bad)} of {len(known)} pictures: its outline overlaps alpha "
        f"or masks by less than {least:g} there (worst: {worst}; mean of all {mean:.2f}). {fix}",
    )
