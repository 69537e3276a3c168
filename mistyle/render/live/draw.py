"""Pictures of a live Mitsuba scene by its own sensors and integrator."""

from typing import Any

import numpy as np
from jaxtyping import Float

from mistyle.render.mitsuba import device
from mistyle.render.mitsuba.device import dr, mi
from mistyle.render.mitsuba.scene import passes


def sensor_picture(
    scene: Any, sensor: int, spp: int = 64, seed: int = 0, integrator: Any = None
) -> Float[np.ndarray, "h w 3"]:
    """Linear Rec.709 from sensor number `sensor`, at least `spp` samples a pixel, by `integrator` or the scene's
    own."""
    device.use()
    times, each = passes(spp)
    total: Any = 0
    for k in range(times):
        number = (seed + k * 0x9E3779B1) % 2**32
        picture = mi.render(scene, sensor=sensor, integrator=integrator, spp=each, seed=number)
        total = total + np.array(picture, dtype=np.float32)[..., :3]
    return np.ascontiguousarray(total / np.float32(times))


def values(scene: Any) -> dict[str, Any]:
    """Every parameter of a scene as it is now, by key, textures and meshes included: the inputs of a fit."""
    return {key: np.array(v) if dr.is_array_v(v) else str(v) for key, v in mi.traverse(scene)}
