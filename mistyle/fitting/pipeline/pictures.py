"""The references of `mistyle fit` as the fit looks at them: checked once, not much finer than the texels.

A photograph of 12 megapixels shows each texel of a usual atlas many times over, and everything that a fit does costs
by the pixel. Blocks of pixels are averaged that leave a texel about two of them wide, once, and kept in the run folder.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np

from mistyle.core.capture import Captures, Loaded, shrunk
from mistyle.core.maps import Texels
from mistyle.io.store.records import load_record, save_record
from mistyle.jobs.progress import Report
from mistyle.process import memory

KEPT = 2  # pictures held in memory


@dataclass(frozen=True)
class Looked:
    """by     pixels along a side of the blocks of each picture that were averaged
    notes  what there is to say of the pictures"""

    by: tuple[int, ...]
    notes: tuple[str, ...]


def look_through(folder: Path, texels: Sequence[Texels], captures: Captures, average: int, report: Report) -> None:
    """Write into `folder` what `looked` reads. InputRefused where no picture says anything."""
    from mistyle.io.cameras.captures import check_pixels
    from mistyle.solver.validate import downsampling_factors

    by = [average] * len(captures) if average else downsampling_factors(texels, captures.cameras)
    small = shrunk(captures, by)

    def load(k: int) -> Loaded:
        # The check asks for every picture, once.
        rgb, counts = small.load(k)
        if by[k] > 1:
            # What does not count is no number: one array says both.
            np.save(_file(folder, k), np.where(counts[..., None], rgb, np.float32(np.nan)), allow_pickle=False)
        return rgb, counts

    notes = check_pixels(Captures(small.cameras, small.lights, load), report)
    save_record(folder / "record", Looked(tuple(by), (*notes, *_said(by))))


def looked(folder: Path, captures: Captures) -> tuple[Captures, tuple[str, ...]]:
    """The captures that `look_through` was given as the fit is to see them, and what there is to say of them."""
    found: Looked = load_record(folder / "record")
    small = shrunk(captures, found.by)

    @lru_cache(maxsize=KEPT)
    def load(k: int) -> Loaded:
        if found.by[k] == 1:
            return small.load(k)
        stored = memory.load(_file(folder, k))
        counts = np.asarray(np.isfinite(stored).all(axis=-1))
        rgb = np.where(counts[..., None], stored, np.float32(0))
        for array in (rgb, counts):
            array.setflags(write=False)  # shared with whoever asks next
        return rgb, counts

    return Captures(small.cameras, small.lights, load), found.notes


def _file(folder: Path, k: int) -> Path:
    return folder / f"{k:05d}.npy"


def _said(by: Sequence[int]) -> tuple[str, ...]:
    averaged = sorted({times for times in by if times > 1})
    if not averaged:
        return ()
    size = " or ".join(f"{times} x {times}" for times in averaged[:: max(1, len(averaged) - 1)])
    count = sum(times > 1 for times in by)
    return (
        f"Blocks of {size} pixels were averaged in {count} of {len(by)} pictures, which are much finer than the texels;"
        " figures are of the averages (--set references.average=1 leaves the pictures as they are).",
    )
