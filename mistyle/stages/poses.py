"""Cameras refined by what the mesh's surface shows, while the material is not known yet.

A silhouette says nothing about turning a bottle around its axis; the surface's own pattern does. So a coarse material
is fitted with the cameras as they are, which blurs it where they disagree, every camera is brought to where it sees
that material best (`align.refine_poses`), and both are done again. Pictures taken from one place move together. What
all cameras have in common (turned about the object as one) shows in no picture and stays as it was.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from mistyle.core.camera import Camera
from mistyle.core.capture import Captures, Loaded
from mistyle.core.contours import block_means
from mistyle.core.light import Directional, Lights, Point
from mistyle.core.mesh import Mesh
from mistyle.stages.align import Poses, refine_poses
from mistyle.stages.recover_settings import RecoverSettings

ROUNDS = 3  # of a coarse material and better cameras
SIDE, ATLAS = 384, 256  # pixels along a picture's longer side, and along the coarse texture's
STEPS = 200  # on whole pictures, where soft light leaves nothing to solve texel by texel
QUICK = {"iterations": 0, "rounds": 1, "bounces": 0, "polish": 0, "solver": "texels", "subsamples": 4}


def refine_by_shading(
    mesh: Mesh,
    captures: Captures,
    masks: Sequence[Bool[np.ndarray, "h w"]],
    settings: RecoverSettings,
    seed: int,
    progress: Callable[[float], None] = lambda done: None,
) -> Poses:
    """Every camera (working space), moved so that outline and shading fit; masks are the object's silhouettes.

    The lights have to be known, and cameras right within a few pixels: `refine_poses` alone comes first. `before` and
    `after` are as in `Poses`, but by place, in the order of the first picture from each.
    """
    from mistyle.stages.recover import recover
    from mistyle.stages.texels import rasterise

    texels = [rasterise(mesh, part, ATLAS) for part in range(len(mesh.parts))]
    groups = _groups(captures.cameras)
    first = [group[0] for group in groups]
    begin, poses = captures.cameras, None
    solver = (
        QUICK if any(_delta(own) for own in captures.lights) else QUICK | {"solver": "pictures", "iterations": STEPS}
    )
    for number in range(ROUNDS):
        step = lambda share, number=number: progress((number + share) / ROUNDS)  # noqa: E731
        coarse = _coarse(captures)
        found = recover(
            mesh, texels, coarse, settings.model_copy(update=solver), seed, lambda done, step=step: step(0.6 * done)
        )
        poses = refine_poses(
            # From where it began each time: what the first, blurred material led astray comes back.
            mesh, [begin[k] for k in first], [masks[k] for k in first],
            pictures=lambda g, load=captures.load: _sum([load(k) for k in groups[g]]),
            predict=_Seen(mesh, found.maps, [[captures.lights[k] for k in group] for group in groups], settings),
            progress=lambda done, step=step: step(0.6 + 0.4 * done),
        )  # fmt: skip
        moved = {k: camera for group, camera in zip(groups, poses.cameras, strict=True) for k in group}
        cameras = [replace(moved[k], name=camera.name) for k, camera in enumerate(begin)]
        captures = replace(captures, cameras=tuple(cameras))
    assert poses is not None
    return Poses(captures.cameras, poses.before, poses.after)


class _Seen:
    """What a camera should see of the maps: the sum over the lights of its group's pictures."""

    def __init__(self, mesh: Mesh, maps: Any, lights: Sequence[Any], settings: RecoverSettings) -> None:
        from mistyle.render.draw import tracer
        from mistyle.render.shade import pack

        self.traced, self.lights, self.settings = tracer(mesh), lights, settings
        self.table, self.sizes = pack(maps), [m.roughness.shape for m in maps]

    def __call__(self, camera: Camera, group: int) -> Float[np.ndarray, "h w 3"]:
        from mistyle.render.shade import Shade

        lights = self.lights[group]

        def load(k: int) -> Loaded:
            return np.zeros((*camera.size, 3), np.float32), np.ones(camera.size, bool)

        # Every camera is looked through once: recording its shading would take longer than tracing it anew.
        shade = Shade(
            self.traced, Captures((camera,) * len(lights), tuple(lights), load), self.sizes, freeze=False,
            model=self.settings.model, frame=self.settings.frame, shadows=self.settings.shadows, memory=0.0,
        )  # fmt: skip
        shade.table = self.table
        return np.sum([shade.image(k) for k in range(len(lights))], axis=0)


def _delta(lights: Lights) -> bool:
    return all(isinstance(light, Directional | Point) for light in lights)


def _groups(cameras: Sequence[Camera]) -> list[list[int]]:
    """Pictures by the place and lens that took them."""
    groups: dict[tuple, list[int]] = {}
    for k, camera in enumerate(cameras):
        groups.setdefault((camera.world_from_cam.tobytes(), camera.focal, camera.centre, camera.size), []).append(k)
    return list(groups.values())


def _sum(pictures: Sequence[Loaded]) -> Loaded:
    return np.sum([np.nan_to_num(rgb) for rgb, _ in pictures], axis=0), np.all([mask for _, mask in pictures], axis=0)


def _coarse(captures: Captures) -> Captures:
    """The pictures at most SIDE pixels long (odd numbers of pixels to one, as the outlines have them)."""
    times = [2 * max(round((max(c.size) / SIDE - 1) / 2), 0) + 1 for c in captures.cameras]
    cameras = [
        replace(
            camera, focal=camera.focal / by, centre=(camera.centre[0] / by, camera.centre[1] / by),
            size=(camera.size[0] // by, camera.size[1] // by),
        )
        for camera, by in zip(captures.cameras, times, strict=True)
    ]  # fmt: skip

    def load(k: int) -> Loaded:
        rgb, mask = captures.load(k)
        by = times[k]
        return block_means(np.nan_to_num(rgb), by), block_means(mask.astype(np.float32), by) > 0.999

    return Captures(tuple(cameras), captures.lights, load)
