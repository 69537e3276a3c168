"""The references of `mistyle fit` at the resolution of the fit: checked once, and block-averaged.

A photograph of 12 megapixels shows each texel of a usual atlas in many pixels, and the cost of a fit is proportional to
pixels. Blocks of pixels are averaged so that a texel stays about two blocks wide; the run folder stores the averages.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np

from mistyle.core.capture import Captures, Loaded, shrunk
from mistyle.core.maps import Texels
from mistyle.io.store.records import load_record, save_record
from mistyle.jobs.progress import Report
from mistyle.process import memory

KEPT = 2  # pictures cached in memory


@dataclass(frozen=True)
class Looked:
    """by     pixels a side of the averaged blocks of each picture
    notes  notes about the pictures"""

    by: tuple[int, ...]
    notes: tuple[str, ...]


def pixels_of(captures: Captures) -> list[int]:
    """The number of pixels of each picture."""
    return [camera.size[0] * camera.size[1] for camera in captures.cameras]


def write_averaged(folder: Path, texels: Sequence[Texels], captures: Captures, average: int, report: Report) -> None:
    """Write the averaged pictures into `folder`. InputRefused where no picture has usable pixels."""
    from mistyle.io.cameras.captures import check_pixels
    from mistyle.solver.validate import downsampling_factors

    by = [average] * len(captures) if average else downsampling_factors(texels, captures.cameras)
    small = shrunk(captures, by)

    def load(k: int) -> Loaded:
        # check_pixels loads every picture once.
        rgb, valid = small.load(k)
        if by[k] > 1:
            # NaN marks invalid pixels, so that one array holds both.
            np.save(_file(folder, k), np.where(valid[..., None], rgb, np.float32(np.nan)), allow_pickle=False)
        return rgb, valid

    notes = check_pixels(Captures(small.cameras, small.lights, load), report)
    save_record(folder / "record", Looked(tuple(by), (*notes, *_average_notes(by))))


def watched(captures: Captures, most: int, report: Report) -> Captures:
    """The captures; `report` receives the loaded share of the `most` pictures that will be loaded."""
    loaded: set[int] = set()

    def load(k: int) -> Loaded:
        result = captures.load(k)
        loaded.add(k)
        report(min(1.0, len(loaded) / most))
        return result

    return replace(captures, load=load)


def read_averaged(folder: Path, captures: Captures) -> tuple[Captures, tuple[str, ...]]:
    """The captures of `write_averaged` at the resolution of the fit, and notes about them."""
    record: Looked = load_record(folder / "record")
    small = shrunk(captures, record.by)

    @lru_cache(maxsize=KEPT)
    def load(k: int) -> Loaded:
        if record.by[k] == 1:
            return small.load(k)
        stored = memory.load(_file(folder, k))
        valid = np.asarray(np.isfinite(stored).all(axis=-1))
        rgb = np.where(valid[..., None], stored, np.float32(0))
        for array in (rgb, valid):
            array.setflags(write=False)  # the cache shares the arrays
        return rgb, valid

    return Captures(small.cameras, small.lights, load), record.notes


def _file(folder: Path, k: int) -> Path:
    return folder / f"{k:05d}.npy"


def _average_notes(by: Sequence[int]) -> tuple[str, ...]:
    averaged = sorted({times for times in by if times > 1})
    if not averaged:
        return ()
    size = " or ".join(f"{times} x {times}" for times in averaged[:: max(1, len(averaged) - 1)])
    count = sum(times > 1 for times in by)
    return (
        f"Blocks of {size} pixels were averaged in {count} of {len(by)} pictures, which are much finer than the texels;"
        " figures are of the averages (--set references.average=1 turns averaging off).",
    )
