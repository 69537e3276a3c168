"""Unlit views of a texture: one kernel traces, fetches and averages."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from mistyle.core.camera import Camera
from mistyle.core.drjit_arrays import aligned, whole
from mistyle.core.maps import Maps
from mistyle.core.mesh import Mesh
from mistyle.process import memory
from mistyle.render.deferred.image_samples import window
from mistyle.render.mitsuba import device
from mistyle.render.mitsuba.device import dr, mi
from mistyle.render.mitsuba.draw import Tracer, tracer

FINE = 3  # rays along each side of a pixel
Picture = tuple[Float[np.ndarray, "h w 3"], Float[np.ndarray, "h w"]]


def unlit(
    mesh: Mesh | Tracer,
    maps: Sequence[Maps],
    cameras: Sequence[Camera],
    fine: int = FINE,
    progress: Callable[[float], None] = lambda done: None,
) -> list[Picture]:
    """Linear rgb, premultiplied, and coverage of every camera: the mean over `fine` x `fine` exact rays a pixel.

    Each ray takes the albedo of the texture set at its first hit, bilinear, UVs modulo 1.
    """
    device.use()
    traced = mesh if isinstance(mesh, Tracer) else tracer(mesh)
    starts = np.cumsum([0, *(chosen.albedo.size // 3 for chosen in maps)])
    flat = [np.ascontiguousarray(chosen.albedo, np.float32).reshape(-1) for chosen in maps]
    texels = mi.Float(whole(np.concatenate(flat) if len(flat) > 1 else flat[0]))
    del flat
    start = mi.UInt32(aligned(starts[:-1], np.uint32))
    rows = mi.UInt32(aligned([chosen.albedo.shape[0] for chosen in maps], np.uint32))
    columns = mi.UInt32(aligned([chosen.albedo.shape[1] for chosen in maps], np.uint32))
    part = mi.UInt32(aligned(traced.mesh.part, np.uint32))

    def fetch(hit: Any) -> Any:
        """Albedo at a hit (zero without one); Mitsuba's v points down, as rows do."""
        valid = hit.is_valid()
        where = dr.gather(mi.UInt32, part, hit.prim_index, valid)
        height, width = (dr.gather(mi.UInt32, size, where, valid) for size in (rows, columns))
        first = dr.gather(mi.UInt32, start, where, valid)
        x = (hit.uv.x - dr.floor(hit.uv.x)) * width - 0.5
        y = (hit.uv.y - dr.floor(hit.uv.y)) * height - 0.5
        left, top = dr.floor(x), dr.floor(y)

        def texel(dx: int, dy: int) -> Any:
            column = (mi.Int32(left) + dx + mi.Int32(width)) % mi.Int32(dr.maximum(width, 1))
            row = (mi.Int32(top) + dy + mi.Int32(height)) % mi.Int32(dr.maximum(height, 1))
            return dr.gather(mi.Color3f, texels, first + mi.UInt32(row) * width + mi.UInt32(column), valid)

        upper = dr.lerp(texel(0, 0), texel(1, 0), x - left)
        lower = dr.lerp(texel(0, 1), texel(1, 1), x - left)
        return dr.lerp(upper, lower, y - top), dr.select(valid, mi.Float(1), 0)

    pictures = []
    for camera in cameras:
        rgb, share = _picture(traced, camera, fine, fetch)
        pictures.append((memory.copied(rgb), memory.copied(share)) if memory.tight() else (rgb, share))
        progress(len(pictures) / len(cameras))
    return pictures


def _picture(traced: Tracer, camera: Camera, fine: int, fetch: Callable[[Any], Any]) -> Picture:
    down, across = window(traced.mesh, camera)
    height, width = down.stop - down.start, across.stop - across.start
    rgb, share = np.zeros((*camera.size, 3), np.float32), np.zeros(camera.size, np.float32)
    if height * width == 0:
        return rgb, share
    # Opaque: a literal would compile one kernel per camera.
    corner = np.ravel(camera.centre) - (across.start, down.start)
    numbers = [*camera.position, *camera.world_from_cam[:3, :3].reshape(-1), *corner, camera.focal]
    value = [dr.opaque(mi.Float, float(v)) for v in numbers]
    origin, turn, centre, focal = mi.Point3f(*value[:3]), value[3:12], value[12:14], value[14]
    i = dr.arange(mi.UInt32, height * width)
    columns = dr.opaque(mi.UInt32, width)
    px, py = mi.Float(i % columns), mi.Float(i // columns)

    def body(k: Any, colour: Any, coverage: Any) -> tuple[Any, ...]:
        x = (px + (mi.Float(k % fine) + 0.5) / fine - centre[0]) / focal
        y = (py + (mi.Float(k // fine) + 0.5) / fine - centre[1]) / focal
        away = mi.Vector3f(*(turn[3 * r] * x + turn[3 * r + 1] * y + turn[3 * r + 2] for r in range(3)))
        ray = mi.Ray3f(origin, dr.normalize(away))
        rgb, share = fetch(traced.scene.ray_intersect(ray, mi.RayFlags.UV, coherent=True))
        return k + 1, colour + rgb, coverage + share

    state = (mi.UInt32(0), dr.zeros(mi.Color3f, height * width), dr.zeros(mi.Float, height * width))
    _, colour, coverage = dr.while_loop(state, lambda k, *rest: k < fine * fine, body)
    count = np.float32(fine * fine)
    rgb[down, across] = np.array(dr.ravel(colour)).reshape(height, width, 3) / count
    share[down, across] = np.array(coverage).reshape(height, width) / count
    return rgb, share
