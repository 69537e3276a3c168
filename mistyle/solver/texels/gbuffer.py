"""G-buffers of pictures: visible surface points and the lights that reach them."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, UInt32

from mistyle.core.camera import Camera
from mistyle.core.drjit_arrays import aligned
from mistyle.core.light import SOFT, Directional, Light, Lights, Point, direction_in_world, position_in_world
from mistyle.render.deferred import integrator as deferred
from mistyle.render.deferred.image_samples import BLOCK_RAYS, camera_rays
from mistyle.render.deferred.sky import bin_environment, even_directions
from mistyle.render.mitsuba import device
from mistyle.render.mitsuba.device import dr, mi
from mistyle.render.mitsuba.draw import Tracer
from mistyle.solver.texels.levenberg_marquardt import Rig

SKY_CELLS = 128


@dataclass(frozen=True)
class GBuffer:
    """Surface points through the pixel centres of a camera, world; zero beside the mesh.

    normal  interpolated shading normal, unit, not turned towards the camera
    lit     per light whether a shadow ray from the point reaches it
    """

    position: Float[np.ndarray, "h w 3"]
    normal: Float[np.ndarray, "h w 3"]
    mask: Bool[np.ndarray, "h w"]
    lit: tuple[Bool[np.ndarray, "h w"], ...]


def trace_gbuffer(traced: Tracer, camera: Camera, lights: Sequence[Light]) -> GBuffer:
    """One exact ray through every pixel centre, and one shadow ray from its hit to every delta light.

    Lights are Directional or Point; their frame "camera" is that of `camera`. Shadow rays start where Mitsuba's do.
    """
    device.use()
    height, width = camera.size
    position, normal = np.zeros((height * width, 3), np.float32), np.zeros((height * width, 3), np.float32)
    mask, lit = np.zeros(height * width, bool), np.zeros((len(lights), height * width), bool)
    for low in range(0, height * width, BLOCK_RAYS):
        part = slice(low, min(low + BLOCK_RAYS, height * width))
        index = dr.arange(mi.UInt32, part.start, part.stop)
        point, _ = deferred.intersect(traced, camera_rays(camera, index, 0.5, 0.5), None)
        valid = point.is_valid()
        reached = [valid & ~traced.scene.ray_test(_shadow(point, light, camera), active=valid) for light in lights]
        where, facing = point.p & valid, point.sh_frame.n & valid
        dr.eval(where, facing, valid, reached)
        position[part], normal[part], mask[part] = np.array(where).T, np.array(facing).T, np.array(valid)
        for k, each in enumerate(reached):
            lit[k, part] = np.array(each)
    shape = camera.size
    return GBuffer(
        position.reshape(*shape, 3),
        normal.reshape(*shape, 3),
        mask.reshape(shape),
        tuple(a.reshape(shape) for a in lit),
    )


def rig(cameras: Sequence[Camera], lights: Sequence[Lights], count: int = SKY_CELLS) -> Rig:
    """The solver's rig of pictures and their lights; soft lights are binned into `count` cells."""
    vector, near, irradiance, width2 = [], [], [], []
    first, cells, known = [0], [], {}
    for camera, own in zip(cameras, lights, strict=True):
        for light in own:
            if isinstance(light, Directional):
                vector.append(direction_in_world(light, camera))
                irradiance.append(light.irradiance)
            elif isinstance(light, Point):
                vector.append(position_in_world(light, camera))
                irradiance.append(light.intensity)
            elif isinstance(light, SOFT):
                continue
            else:
                raise ValueError(f"{type(light).__name__} is not a light that the solver supports")
            near.append(float(isinstance(light, Point)))
            width2.append(0.0)
        cells.append(len(near))
        soft = tuple(light for light in own if isinstance(light, SOFT))
        if soft:
            key = tuple(map(id, soft))
            if key not in known:
                known[key] = bin_environment(soft, even_directions(count))
            sky = known[key]
            vector.extend(sky.direction)
            irradiance.extend(sky.irradiance)
            near.extend([0.0] * count)
            width2.extend(sky.width2)
        first.append(len(near))
    return Rig(
        eye=np.stack([camera.position for camera in cameras]).astype(np.float32),
        first=np.array(first),
        vector=np.array(vector, np.float32).reshape(-1, 3),
        near=np.array(near, np.float32),
        irradiance=np.array(irradiance, np.float32).reshape(-1, 3),
        cells=np.array(cells) if known else None,
        width2=np.array(width2, np.float32) if known else None,
    )


def open_sky(
    traced: Tracer,
    position: Float[np.ndarray, "n 3"],
    normal: Float[np.ndarray, "n 3"],
    directions: Float[np.ndarray, "k 3"] | None = None,
) -> UInt32[np.ndarray, "n w"]:
    """Visibility of directions (default: the SKY_CELLS cells) from points just above the surface, as packed bits: bit
    k % 32 of word k // 32."""
    device.use()
    origin = mi.Point3f(*(mi.Float(aligned(c)) for c in (position + 1e-3 * normal).T))
    directions = even_directions(SKY_CELLS) if directions is None else directions
    words = np.zeros((len(position), -(-len(directions) // 32)), np.uint32)
    for k, direction in enumerate(directions):
        away = dr.opaque(mi.Vector3f, direction.tolist())
        free = ~np.array(traced.scene.ray_test(mi.Ray3f(origin, away)))
        words[:, k // 32] |= free.astype(np.uint32) << np.uint32(k % 32)
    return words


def _shadow(point: Any, light: Light, camera: Camera) -> Any:
    if isinstance(light, Directional):
        return point.spawn_ray(dr.opaque(mi.Vector3f, direction_in_world(light, camera).tolist()))
    if isinstance(light, Point):
        return point.spawn_ray_to(dr.opaque(mi.Point3f, position_in_world(light, camera).tolist()))
    raise ValueError(f"{type(light).__name__} is not a delta light")
