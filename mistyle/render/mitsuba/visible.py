"""Exact visibility and facing weight of surface points from cameras, by rays to the cameras."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from mistyle.core.camera import Camera, in_frame, px_from_world
from mistyle.core.drjit_arrays import aligned
from mistyle.render.mitsuba import device
from mistyle.render.mitsuba.device import dr, mi
from mistyle.render.mitsuba.draw import Tracer

LIFT = 1e-3  # start of rays above the surface, working units
RAYS = 1 << 21  # rays per batch


def face_on(
    traced: Tracer,
    cameras: Sequence[Camera],
    positions: Float[np.ndarray, "s 3"],
    normals: Float[np.ndarray, "s 3"],
    fronts: Float[np.ndarray, "s 3"],
) -> Float[np.ndarray, "c s"]:
    """Facing weight of each surface point and camera: max(0, n . (c - P) / |c - P|), 0 where the camera does not see
    it.

    A point is visible if it is in the frame, its face shows the camera its front and no face blocks the line to the
    camera. `normals` are the shading normals n, `fronts` the unit normals of the faces on their outer side. World
    space.
    """
    device.use()
    eyes = mi.Float(aligned(np.stack([c.position for c in cameras]).ravel()))
    points, shading, outer = (mi.Float(aligned(np.ascontiguousarray(a).ravel())) for a in (positions, normals, fronts))
    count, weights = len(positions), np.empty(len(cameras) * len(positions), np.float32)
    rows = max(1, RAYS // max(count, 1))
    for first in range(0, len(cameras), rows):
        last = min(first + rows, len(cameras))
        index = dr.arange(mi.UInt32, (last - first) * count)
        camera, point = index // dr.opaque(mi.UInt32, count), index % dr.opaque(mi.UInt32, count)
        n, front = dr.gather(mi.Vector3f, shading, point), dr.gather(mi.Vector3f, outer, point)
        place, eye = (
            dr.gather(mi.Point3f, points, point),
            dr.gather(mi.Point3f, eyes, camera + dr.opaque(mi.UInt32, first)),
        )
        towards = dr.normalize(eye - place)
        seen = (dr.dot(towards, front) > 0) & (dr.dot(towards, n) > 0)
        # Twice, since one ray in some millions passes through an edge between two faces.
        for lift in (LIFT, 1.5 * LIFT):
            origin = place + dr.opaque(mi.Float, lift) * mi.Point3f(front)
            away = eye - origin
            distance = dr.norm(away)
            ray = mi.Ray3f(origin, away / distance, distance * (1 - 1e-4), 0.0, [])
            seen &= ~traced.scene.ray_test(ray, active=seen)
        weights[first * count : last * count] = np.array(dr.select(seen, dr.dot(towards, n), 0))
    result = weights.reshape(len(cameras), count)
    for k, camera in enumerate(cameras):
        px, z = px_from_world(camera, positions)
        result[k, ~(in_frame(camera, px) & (z > 0))] = 0
    return result
