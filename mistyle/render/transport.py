"""How much each direction of distant light adds to each pixel: the linear half of finding an unknown light."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from mistyle.core.camera import Camera
from mistyle.core.lanes import aligned
from mistyle.render import bsdf, deferred, device, seam
from mistyle.render.draw import Tracer

AT_ONCE = 1 << 22  # pairs of pixel and direction in one kernel


def transport(
    traced: Tracer,
    camera: Camera,
    tangents: Float[np.ndarray, "f 3 4"] | None,
    table: Float[np.ndarray, "t 8"],
    sizes: Sequence[tuple[int, int]],
    directions: Float[np.ndarray, "d 3"],
    model: str = "principled",
) -> Float[np.ndarray, "n d 3"]:
    """Radiance of every pixel of `camera` (row by row, through its centre) per unit irradiance from each direction.

    f(wi, wo) cos θ · visibility; directions are unit, in the world, towards the light. `table` and `sizes` are the
    materials as `render/shade.py` packs them. Pixels beside the mesh are zero. Direct light only.
    """
    import drjit as dr
    import mitsuba as mi

    device.use()
    surface = deferred.trace(traced, [camera], tangents)
    values = seam.bilinear(table.astype(np.float32), seam.taps(surface, sizes))
    on = np.flatnonzero(surface.mask)
    result = np.zeros((len(surface.mask), len(directions), 3), np.float32)
    wi = surface.frame.to_local(surface.towards)
    material = mi.Float(aligned(values).ravel())
    towards = mi.Float(aligned(directions).ravel())
    step = max(1, AT_ONCE // len(directions))
    for start in range(0, len(on), step):
        rows = on[start : start + step]
        pair = dr.arange(mi.UInt32, len(rows) * len(directions))
        pixel = dr.gather(mi.UInt32, mi.UInt32(aligned(rows, np.uint32)), pair // len(directions))
        world = dr.gather(mi.Vector3f, towards, pair % len(directions))
        lit = ~traced.scene.ray_test(dr.gather(type(surface.point), surface.point, pixel).spawn_ray(world))
        frame = dr.gather(type(surface.frame), surface.frame, pixel)
        found: Any = [dr.gather(mi.Float, material, pixel * 8 + k) for k in range(8)]
        normal = mi.Normal3f(found[3], found[4], dr.sqrt(dr.maximum(1 - found[3] ** 2 - found[4] ** 2, 1e-3)))
        value = bsdf.evaluate(
            model,
            dr.gather(mi.Vector3f, wi, pixel),
            frame.to_local(world),
            normal,
            mi.Color3f(found[0], found[1], found[2]),
            found[5],
            found[6],
        )
        radiance = np.array(dr.select(lit, value, 0)).T.reshape(len(rows), len(directions), 3)
        result[rows] = radiance
    return result
