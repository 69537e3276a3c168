"""Ambient occlusion and bent normals of surface points."""

import numpy as np
from jaxtyping import Float

from mistyle.core.drjit_arrays import aligned
from mistyle.core.mesh import Mesh
from mistyle.render.mitsuba import device
from mistyle.render.mitsuba.device import dr, mi
from mistyle.render.mitsuba.draw import Tracer, tracer

CHUNK = 1 << 18
LIFT = 2e-3  # start of rays above the surface, in working units: exceeds the distance of facets from the smooth surface


def open_sky(
    mesh: Mesh | Tracer,
    positions: Float[np.ndarray, "n 3"],
    normals: Float[np.ndarray, "n 3"],
    *,
    rays: int = 64,
    distance: float = 1.2,
    seed: int = 0,
) -> Float[np.ndarray, "n 4"]:
    """The mean direction of unoccluded sky about unit `normals` (unit; the normal without any), and its share, 0..1,
    cosine-weighted: glTF's occlusion.

    Rays up to `distance` (working units) against all faces from both sides, stratified per point by a rank-1 lattice
    that is shifted by a hash of the point's index and `seed`. A Tracer avoids rebuilding the structure. Hollows
    narrower than 0.002 are missed.
    """
    device.use()
    scene = (mesh if isinstance(mesh, Tracer) else tracer(mesh)).scene
    out = np.empty((len(positions), 4), np.float32)
    golden = (5**0.5 - 1) / 2
    for low in range(0, len(positions), CHUNK):
        part = slice(low, low + CHUNK)
        lifted = positions[part] + LIFT * normals[part]
        origin = mi.Point3f(aligned(lifted.T))
        frame = mi.Frame3f(mi.Vector3f(aligned(normals[part].T)))
        index = dr.arange(mi.UInt32, len(lifted)) + low
        shift_x = mi.sample_tea_float32(index, mi.UInt32(2 * seed))
        shift_y = mi.sample_tea_float32(index, mi.UInt32(2 * seed + 1))

        def body(k, open_rays, towards, frame=frame, origin=origin, shift_x=shift_x, shift_y=shift_y):
            x, y = shift_x + (mi.Float(k) + 0.5) / rays, shift_y + mi.Float(k) * golden
            local = mi.warp.square_to_cosine_hemisphere(mi.Point2f(x - dr.floor(x), y - dr.floor(y)))
            away = frame.to_world(local)
            seen = dr.select(scene.ray_test(mi.Ray3f(origin, away, distance, 0.0, [])), 0.0, 1.0)
            return k + 1, open_rays + seen, towards + away * seen

        state = (mi.UInt32(0), dr.zeros(mi.Float, len(lifted)), dr.zeros(mi.Vector3f, len(lifted)))
        _, count, total = dr.while_loop(state, lambda k, *_: k < rays, body)
        length = dr.norm(total)
        mean = dr.select(length > 1e-3, total / length, frame.n)
        out[part, :3], out[part, 3] = np.array(mean).T, np.array(count) / rays
    return out
