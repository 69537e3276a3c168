"""Light that reaches the camera by way of more than one surface point: what a fit under direct light must take off.

Mitsuba's `path` renders every picture twice with the same samples, once with all its bounces and once without; the
difference is the indirect light, free of the noise that both share, and of most of what smooth surfaces mirror of each
other. It is smooth and small, so a coarse picture of few samples, blurred and enlarged, says enough.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Float

from mistyle.core.camera import Camera, resized
from mistyle.core.image import gaussian, nearest_fill
from mistyle.core.light import Directional, Light, Lights, Point, direction_in_world, position_in_world
from mistyle.core.maps import Maps
from mistyle.core.mesh import Mesh
from mistyle.render import device
from mistyle.render import scene as scenery

COARSER = 4  # pixels along a side of the picture that one pixel of the estimate covers, at most
LEAST = 128  # pixels along a side of the estimate, at least, where the picture has so many
ROUGH = 0.4  # least roughness: light that mirrors carry comes in few bright samples and adds little
DEPTH = 5  # path segments: light comes over up to four surface points
BLUR = 1.0  # pixels of the estimate


class Indirect:
    """The indirect light of pictures of one object; its maps stand until another object of this class is made."""

    def __init__(
        self, mesh: Mesh, maps: Sequence[Maps], *, model: scenery.Model = "principled", frame: scenery.Frame = "mikkt"
    ) -> None:
        device.use()
        import mitsuba

        mi: Any = mitsuba
        matt = [replace(m, roughness=np.maximum(m.roughness, np.float32(ROUGH))) for m in maps]
        self.shapes = scenery.object_shapes(mesh, matt, model=model, frame=frame)
        self.integrators = [
            mi.load_dict({"type": "path", "max_depth": depth, "rr_depth": 100, "hide_emitters": True})
            for depth in (2, DEPTH)
        ]

    def picture(self, camera: Camera, lights: Lights, samples: int, seed: int) -> Float[np.ndarray, "h w 3"]:
        """Indirect radiance, linear Rec.709, of a coarser picture of the camera, to be enlarged; beside the object
        that of the nearest pixel on it.

        `lights` are directional or point lights, others raise ValueError. `samples` are those of a pixel of the coarse
        picture.
        """
        import mitsuba

        mi: Any = mitsuba
        by = next(
            f for f in range(COARSER, 0, -1) if f == 1 or all(n % f == 0 and n // f >= LEAST for n in camera.size)
        )
        small = resized(camera, (camera.size[0] // by, camera.size[1] // by))
        count = scenery.samples(samples)
        described = {"type": "scene", "sensor": scenery.sensor_dict(small, count), **self.shapes}
        described |= {f"light{k}": emitter(light, camera) for k, light in enumerate(lights)}
        scene = mi.load_dict(described, optimize=False)
        direct, whole = (
            np.array(mi.render(scene, integrator=integrator, spp=count, seed=seed)) for integrator in self.integrators
        )
        share = whole[..., 3:4]
        inside = np.isfinite(whole).all(axis=-1) & (share[..., 0] > 0)
        light = np.where(inside[..., None], np.maximum(whole[..., :3] - direct[..., :3], 0), 0).astype(np.float32)
        if not inside.any():
            return np.zeros((*small.size, 3), np.float32)
        light = nearest_fill(light / np.where(inside, np.maximum(share[..., 0], 0.05), 1)[..., None], inside)
        return gaussian(np.ascontiguousarray(light, np.float32), BLUR)


def emitter(light: Light, camera: Camera) -> dict[str, Any]:
    """A delta light as Mitsuba describes it."""
    if isinstance(light, Directional):
        towards = direction_in_world(light, camera)
        colour = {"type": "rgb", "value": list(light.irradiance)}
        return {"type": "directional", "direction": (-towards).tolist(), "irradiance": colour}
    if isinstance(light, Point):
        colour = {"type": "rgb", "value": list(light.intensity)}
        return {"type": "point", "position": position_in_world(light, camera).tolist(), "intensity": colour}
    raise ValueError(f"the indirect light of {type(light).__name__} cannot be estimated")


def retarget(shade: Any, picture: int, rgb: Float[np.ndarray, "h w 3"]) -> None:
    """Give a picture of a `Shade` another reference; pictures it does not keep load theirs again anyway."""
    import mitsuba

    mi: Any = mitsuba
    for block in shade.blocks(picture):
        target = np.array(block.target).reshape(-1, 4)
        target[: len(block.pixel), :3] = rgb.reshape(-1, 3)[block.pixel]
        block.target = mi.Float(target.ravel())
