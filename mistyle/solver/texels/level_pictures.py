"""Pictures for a level of the atlas that is coarser than they are: averaged once, and kept."""

from collections.abc import Sequence

import numpy as np

from mistyle.core.camera import Camera
from mistyle.core.capture import Captures, Loaded, shrunk
from mistyle.core.maps import Texels
from mistyle.process import memory as memory_of_process
from mistyle.solver.indirect import MOST
from mistyle.solver.settings import LARGE
from mistyle.solver.validate import downsampling_factors


def level_captures(texels: Sequence[Texels], captures: Captures, memory: float) -> tuple[Captures, float]:
    """The captures with blocks of large pictures averaged, so that the level's `texels` stay about two blocks wide; and
    the bytes of `memory` that remain. Averages are kept in files, or where they fit into half of it."""
    wanted = downsampling_factors(texels, captures.cameras)
    by = [_block(camera, most) for camera, most in zip(captures.cameras, wanted, strict=True)]
    if max(by) == 1:
        return captures, memory
    small = shrunk(captures, by)
    count = sum(12 * camera.size[0] * camera.size[1] for camera in small.cameras)
    if memory_of_process.tight():
        return _kept(small), memory
    return (_kept(small), memory - count) if count < memory / 2 else (small, memory)


def _block(camera: Camera, most: int) -> int:
    """Pixels along a block's side: at most `most`, and a divisor of those of an estimate of indirect light: it serves
    both resolutions."""
    if camera.size[0] * camera.size[1] <= LARGE:
        return 1
    light = -(-max(camera.size) // MOST)
    return max(by for by in range(1, max(most, 1) + 1) if light % by == 0)


def _kept(captures: Captures) -> Captures:
    """The captures, each picture loaded once and kept: 12 bytes a pixel."""
    sizes = [(*camera.size, 3) for camera in captures.cameras]
    starts = np.cumsum([0, *(int(np.prod(size)) for size in sizes)])
    stored, known = memory_of_process.empty(int(starts[-1])), np.zeros(len(sizes), bool)

    def load(k: int) -> Loaded:
        picture = stored[starts[k] : starts[k + 1]].reshape(sizes[k])
        if not known[k]:
            rgb, valid = captures.load(k)
            # NaN marks invalid pixels, so that one array holds both.
            picture[...] = np.where(valid[..., None], rgb, np.float32(np.nan))
            known[k] = True
        valid = np.asarray(np.isfinite(picture).all(axis=-1))
        return np.where(valid[..., None], picture, np.float32(0)), valid

    return Captures(captures.cameras, captures.lights, load)
