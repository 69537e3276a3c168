"""Pictures of a live Mitsuba scene by its own sensors and integrator."""

from typing import Any

import numpy as np
from jaxtyping import Float

from mistyle.render import device
from mistyle.render.scene import passes


def sensor_picture(scene: Any, sensor: int, spp: int = 64, seed: int = 0) -> Float[np.ndarray, "h w 3"]:
    """Linear Rec.709 from sensor number `sensor`, at least `spp` samples a pixel, by the scene's integrator."""
    import mitsuba as mi

    device.use()
    times, each = passes(spp)
    total: Any = 0
    for k in range(times):
        picture = mi.render(scene, sensor=sensor, spp=each, seed=(seed + k * 0x9E3779B1) % 2**32)
        total = total + np.array(picture, dtype=np.float32)[..., :3]
    return np.ascontiguousarray(total / np.float32(times))
