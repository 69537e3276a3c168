"""Our own fit as the benchmarks call it."""

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from benchmarks.material_recovery.pictures import Shot
from benchmarks.material_recovery.truth import Truth
from mistyle.core.capture import in_memory
from mistyle.core.maps import Maps
from mistyle.fitting.light.unknown_light import find_light
from mistyle.process.cores import cores, use_threads
from mistyle.render.mitsuba.scene import Frame
from mistyle.solver.recover import NO_LIMITS, Limits, recover
from mistyle.solver.settings import RecoverSettings


@dataclass(frozen=True)
class Fitted:
    """Maps, confidence and standard deviations per texture set; seconds from pictures in memory to maps, everything
    included."""

    maps: tuple[Maps, ...]
    confidence: tuple[np.ndarray, ...]
    spread: tuple[dict[str, np.ndarray], ...]
    seconds: float
    notes: tuple[str, ...]


def ours(
    known: Truth,
    shots: Sequence[Shot],
    pictures: Sequence[np.ndarray],
    frame: Frame,
    seed: int = 0,
    *,
    unknown: bool = False,
    limits: Limits = NO_LIMITS,
    **chosen: Any,
) -> Fitted:
    """Fit from scratch, metallic unknown, default settings but for `chosen`. The truth lends mesh and atlas only; the
    pictures' light too, unless it is `unknown`."""
    cameras = [s.camera for s in shots]
    masks = [p[..., 3] > 0.999 for p in pictures] if unknown else None
    captures = in_memory(
        cameras, [s.lights for s in shots], [np.ascontiguousarray(p[..., :3]) for p in pictures], masks
    )
    settings = RecoverSettings(**({"metallic": True, "frame": frame} | chosen))
    use_threads(cores())  # as a job does
    start = time.perf_counter()
    if unknown:
        light = find_light(known.mesh, captures, settings).light
        captures = replace(captures, lights=tuple((light,) for _ in cameras))
    found = recover(known.mesh, known.texels, captures, settings, seed, limits=limits)
    return Fitted(found.maps, found.confidence, found.spread, time.perf_counter() - start, found.notes)
