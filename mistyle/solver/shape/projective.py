"""Silhouettes by Mitsuba's projective integrator, the judge of a deformation: picture loss and vertex gradient.

`direct_projective` (Zhang et al. 2023) samples the silhouettes themselves, so gradients of coverage by vertices are
unbiased. The mesh has face normals: with smooth ones the derivative is wrong where shading decides what faces the
camera. The film has a Gaussian filter and samples its border, for which Mitsuba 3.9.1 makes the gradient too large:
by the area of the film with its border over the area of the film (6 % at 128 pixels). It is divided out here. Values
repeat bit for bit with one seed and thread count. Gradients are scattered by atomic additions: they agree between runs
to about 1e-4, relative to the largest.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from mistyle.core.camera import Camera
from mistyle.core.drjit_arrays import aligned
from mistyle.core.image import gaussian
from mistyle.render.mitsuba import device
from mistyle.render.mitsuba.device import dr, mi
from mistyle.render.mitsuba.scene import samples, sensor_dict

FILTER = 0.5  # pixels, standard deviation of the film's filter
# A coverage is a mean over the pixel's square, of variance 1/12; this much more smoothing gives the film's filter.
SMOOTHING = float(np.sqrt(FILTER**2 - 1 / 12))


def silhouette_loss(
    points: Float[np.ndarray, "n 3"],
    faces: Int[np.ndarray, "f 3"],
    cameras: Sequence[Camera],
    coverages: Sequence[Float[np.ndarray, "h w"]],
    spp: int = 16,
    seed: int = 0,
    *,
    gradient: bool = False,
) -> tuple[float, Float[np.ndarray, "n 3"]]:
    """Mean squared difference of the rendered coverages from the targets, and its gradient by the points (zero unless
    requested)."""
    device.use()
    scene = mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "direct_projective", "sppi": 0, "sppc": 0},
            "sky": {"type": "constant", "radiance": {"type": "rgb", "value": 1.0}},
            "object": _shape(points, faces),
        }
    )
    params = mi.traverse(scene)
    key = "object.vertex_positions"
    params.keep([key])
    total, slope = 0.0, np.zeros(points.size)
    for k, (camera, coverage) in enumerate(zip(cameras, coverages, strict=True)):
        target = mi.TensorXf(aligned(1 - gaussian(np.asarray(coverage, np.float32), SMOOTHING)))
        if gradient:
            dr.enable_grad(params[key])
            params.update()
        sensor = mi.load_dict(_sensor(camera, spp, seed + k))
        picture = mi.render(scene, params, sensor=sensor, spp=spp, seed=mi.UInt32(seed + k))
        loss = dr.mean(dr.square(picture[:, :, 0] - target), axis=None)
        total += float(np.array(dr.detach(loss)).ravel()[0])
        if gradient:
            dr.backward(loss)
            slope += np.array(dr.grad(params[key]), np.float64) / _excess(sensor.film())
            params[key] = mi.Float(dr.detach(params[key]))
    count = max(len(cameras), 1)
    return total / count, (slope / count).reshape(-1, 3)


def _shape(points: Float[np.ndarray, "n 3"], faces: Int[np.ndarray, "f 3"]) -> Any:
    """A black mesh with face normals."""
    props = mi.Properties()
    props["mesh_bsdf"] = mi.load_dict(
        {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.0}}}
    )
    props["face_normals"] = True
    shape = mi.Mesh("object", len(points), len(faces), props=props)
    values = mi.traverse(shape)
    values["vertex_positions"] = mi.Float(aligned(np.asarray(points, np.float32).ravel()))
    values["faces"] = mi.UInt32(aligned(np.asarray(faces, np.uint32).ravel(), np.uint32))
    values.update()
    return shape


def _excess(film: Any) -> float:
    """The area of the film with its border, relative to the film's."""
    border = film.rfilter().border_size()
    return float(np.prod([1 + 2 * border / side for side in film.crop_size()]))


def _sensor(camera: Camera, spp: int, seed: int) -> dict[str, Any]:
    sensor = sensor_dict(camera, samples(spp), seed)
    film = {"rfilter": {"type": "gaussian", "stddev": FILTER}, "sample_border": True, "pixel_format": "luminance"}
    return sensor | {"film": sensor["film"] | film}
