"""Check of cameras against the mesh: overlap of its silhouette with alpha or masks.

The overlap is the intersection over union of the two silhouettes. It detects a rotated, mirrored or mistaken frame,
unless the mesh looks the same from there. The mesh is therefore also compared under the rotations of other conventions.
They show whether the check can decide, and which frame fits where the cameras' own does not.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

from mistyle.core.camera import Camera
from mistyle.core.image import overlap
from mistyle.core.mesh import Mesh
from mistyle.core.rows import evenly
from mistyle.geometry.similarity import moved_camera, similarity
from mistyle.render.mitsuba.draw import gbuffer, tracer
from mistyle.solver.cameras.align import shrunk

SIDE = 160  # pixels of the longer side: resolves some 1 % of the overlap
FEW = 6  # pictures that are also compared under rotated cameras
CENTRE = np.zeros(3)  # of the mesh in working space
ALIKE = 0.02  # insignificant difference of mean overlaps
# Frames that conventions confuse, as rotations of the cameras about X, degrees.
Z_UP = "by -90 degrees about X"  # turns cameras of a world with Z up
MESH_Z_UP = "by 90 degrees about X"  # turns cameras of a world with Y up to a mesh with Z up
TURNS = {MESH_Z_UP: 90.0, Z_UP: -90.0, "by 180 degrees about X": 180.0}


@dataclass(frozen=True)
class Outlines:
    """Silhouette overlaps of all pictures.

    overlap  0..1 of each picture; NaN where it has no outline
    base     the mean over the few pictures that are also compared under rotated cameras; NaN if there are none
    turned   the same mean with all cameras rotated about the mesh or the origin of its file, whichever fits better, by
             the names of TURNS
    """

    overlap: tuple[float, ...]
    base: float
    turned: dict[str, float]


def check_outlines(
    mesh: Mesh,
    cameras: Sequence[Camera],
    outlines: Iterable[Bool[np.ndarray, "h w"] | None],
    progress: Callable[[float], None] = lambda done: None,
    origin: Float[np.ndarray, "3"] = CENTRE,
) -> Outlines:
    """The overlaps of the mesh (working space) with the outlines, each of its camera's size and read one at a time.
    None, a full mask and an empty mask count as no outline. `origin` is that of the mesh's file."""
    traced = tracer(mesh)

    def drawn(camera: Camera) -> np.ndarray:
        return gbuffer(traced, camera).mask

    overlaps, seen = [], []
    for camera, outline in zip(cameras, outlines, strict=True):
        if outline is None or outline.all() or not outline.any():
            overlaps.append(float("nan"))
        else:
            seen.append(shrunk(camera, outline, SIDE)[:2])
            overlaps.append(overlap(drawn(seen[-1][0]), seen[-1][1]))
        progress(len(overlaps) / len(cameras))
    few = [seen[k] for k in evenly(len(seen), FEW)]

    def mean(degrees: float) -> float:
        turn = Rotation.from_euler("x", degrees, degrees=True).as_matrix()
        turns = [similarity(1.0, turn, pivot - turn @ pivot) for pivot in (CENTRE, origin)[: 2 if degrees else 1]]
        return float(max(np.mean([overlap(drawn(moved_camera(c, t)), mask) for c, mask in few]) for t in turns))

    if not few:
        return Outlines(tuple(overlaps), float("nan"), {})
    return Outlines(tuple(overlaps), mean(0.0), {name: mean(degrees) for name, degrees in TURNS.items()})


def overlap_line(names: Sequence[str], overlaps: Sequence[float]) -> str:
    """Every picture's overlap in one line."""
    shown = ", ".join(f"{n} {o:.2f}" for n, o in zip(names, overlaps, strict=True) if np.isfinite(o))
    return f"outlines  overlap of the mesh with alpha or masks: {shown}"


def overlap_notes(
    names: Sequence[str], outlines: Outlines, least: float, fix: str, *, trusted: bool = False
) -> tuple[str, ...]:
    """Notes on overlaps below `least`, on unchecked cameras, and on rotations that the check cannot detect (these only
    unless the cameras' frame is `trusted`, such as that of our own files)."""
    known = [(o, n) for n, o in zip(names, outlines.overlap, strict=True) if np.isfinite(o)]
    if not known:
        return (
            "The pictures have neither alpha nor masks with an outline: it was not checked whether the cameras fit the "
            "mesh.",
        )
    bad = sorted(pair for pair in known if pair[0] < least)
    if bad:
        mean = float(np.mean([o for o, _ in known]))
        worst = ", ".join(f"{n} {o:.2f}" for o, n in bad[:3])
        best = max(outlines.turned, key=lambda name: outlines.turned[name])
        better = f"With the cameras turned {best} it would be {outlines.turned[best]:.2f} on average. "
        hint = better if outlines.turned[best] >= max(least, outlines.base + ALIKE) else ""
        return (
            f"Warning: the cameras do not fit the mesh in {len(bad)} of {len(known)} pictures: its outline overlaps "
            f"alpha or masks by less than {least:g} there (worst: {worst}; mean of all {mean:.2f}). {hint}{fix}",
        )
    alike = [name for name, value in outlines.turned.items() if value >= outlines.base - ALIKE]
    if trusted or not alike:
        return ()
    return (
        f"The mesh's outlines fit, but as well with the cameras turned {' or '.join(alike)}: they do not show whether "
        "the frame is the right one.",
    )
