"""How much open sky points of a surface see."""

from typing import Any

import numpy as np
from jaxtyping import Float

from mistyle.core.lanes import aligned
from mistyle.core.mesh import Mesh
from mistyle.render import device
from mistyle.render.draw import Tracer, tracer

CHUNK = 1 << 18
LIFT = 2e-3  # how far above the surface rays start, in working units: more than facets leave the smooth surface


def ambient_occlusion(
    mesh: Mesh | Tracer,
    positions: Float[np.ndarray, "n 3"],
    normals: Float[np.ndarray, "n 3"],
    *,
    rays: int = 64,
    distance: float = 1.2,
    seed: int = 0,
) -> Float[np.ndarray, " n"]:
    """Share of unoccluded sky about unit `normals`, cosine-weighted (glTF's occlusion): 1 open, 0 closed.

    Rays up to `distance` (working units) against all faces from both sides, stratified per point by a rank-1 lattice
    that is shifted by a hash of the point's index and `seed`. A Tracer saves building the structure again. Hollows
    narrower than 0.002 are not seen.
    """
    device.use()
    import drjit as dr
    import mitsuba

    mi: Any = mitsuba  # its type stubs know one variant only
    scene = (mesh if isinstance(mesh, Tracer) else tracer(mesh)).scene
    out = np.empty(len(positions), np.float32)
    golden = (5**0.5 - 1) / 2
    for low in range(0, len(positions), CHUNK):
        part = slice(low, low + CHUNK)
        lifted = positions[part] + LIFT * normals[part]
        origin = mi.Point3f(aligned(lifted.T))
        frame = mi.Frame3f(mi.Vector3f(aligned(normals[part].T)))
        index = dr.arange(mi.UInt32, len(lifted)) + low
        shift_x = mi.sample_tea_float32(index, mi.UInt32(2 * seed))
        shift_y = mi.sample_tea_float32(index, mi.UInt32(2 * seed + 1))

        def body(k, open_rays, frame=frame, origin=origin, shift_x=shift_x, shift_y=shift_y):
            x, y = shift_x + (mi.Float(k) + 0.5) / rays, shift_y + mi.Float(k) * golden
            local = mi.warp.square_to_cosine_hemisphere(mi.Point2f(x - dr.floor(x), y - dr.floor(y)))
            ray = mi.Ray3f(origin, frame.to_world(local), distance, 0.0, [])
            return k + 1, open_rays + dr.select(scene.ray_test(ray), 0.0, 1.0)

        state = dr.while_loop((mi.UInt32(0), dr.zeros(mi.Float, len(lifted))), lambda k, _: k < rays, body)
        out[part] = np.array(state[1]) / rays
    return out
