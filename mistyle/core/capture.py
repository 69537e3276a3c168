"""Reference pictures with known cameras and lights: the data of the material fit."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from mistyle.core.camera import Camera, binned
from mistyle.core.light import Ambient, Lights

Loaded = tuple[Float[np.ndarray, "h w 3"], Bool[np.ndarray, "h w"]]


@dataclass(frozen=True)
class Captures:
    """n pictures of one object, in working units; the pixels are loaded one picture at a time.

    cameras  camera of each picture; their names are the pictures' names
    lights   lights of each picture
    load     picture k: linear Rec.709 radiance (divided by its exposure), and the mask of valid pixels (inside the
             user's mask, finite, not saturated); pixels beside the mesh may be marked valid and are ignored
    """

    cameras: tuple[Camera, ...]
    lights: tuple[Lights, ...]
    load: Callable[[int], Loaded]

    def __len__(self) -> int:
        return len(self.cameras)


def in_memory(
    cameras: Sequence[Camera],
    lights: Sequence[Lights],
    pictures: Sequence[Float[np.ndarray, "h w 3"]],
    masks: Sequence[Bool[np.ndarray, "h w"]] | None = None,
) -> Captures:
    """Captures of pictures in memory; without masks every finite pixel is valid."""
    if not len(cameras) == len(lights) == len(pictures):
        raise ValueError(f"{len(cameras)} cameras, {len(lights)} lights and {len(pictures)} pictures do not match")

    def load(k: int) -> Loaded:
        picture = pictures[k]
        usable = np.asarray(np.isfinite(picture).all(axis=-1))
        return picture, usable & masks[k] if masks is not None else usable

    return Captures(tuple(cameras), tuple(lights), load)


def subset(captures: Captures, chosen: Sequence[int]) -> Captures:
    """A subset of the pictures, in the order of `chosen`."""
    rows = [int(k) for k in chosen]
    return Captures(
        tuple(captures.cameras[k] for k in rows),
        tuple(captures.lights[k] for k in rows),
        lambda k: captures.load(rows[k]),
    )


def shrunk(captures: Captures, by: Sequence[int]) -> Captures:
    """Picture k with blocks of by[k] x by[k] pixels averaged.

    A block is valid when all its pixels are. The remainder at the right and the bottom is dropped.
    """
    cameras = tuple(binned(camera, factor) for camera, factor in zip(captures.cameras, by, strict=True))

    def load(k: int) -> Loaded:
        (rgb, valid), factor = captures.load(k), by[k]
        if factor == 1:
            return rgb, valid
        height, width = cameras[k].size
        rgb, valid = rgb[: height * factor, : width * factor], valid[: height * factor, : width * factor]
        means = rgb.reshape(height, factor, width, factor, 3).mean(axis=(1, 3))
        return means.astype(np.float32), np.asarray(valid.reshape(height, factor, width, factor).all(axis=(1, 3)))

    return Captures(cameras, captures.lights, load)


def shrunk_to(captures: Captures, side: int) -> Captures:
    """The pictures averaged to at most `side` pixels along their longer side."""
    return shrunk(captures, [-(-max(camera.size) // side) for camera in captures.cameras])


def evenly_lit(captures: Captures) -> Captures:
    """The captures under white ambient light, so that no pixel counts as one at a shadow's edge."""
    return replace(captures, lights=((Ambient((1.0, 1.0, 1.0)),),) * len(captures))
