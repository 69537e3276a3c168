"""Scale and colour of an unknown light from a surface of known albedo, such as a grey card."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Bool

from mistyle.core.camera import Camera
from mistyle.core.errors import InputRefused
from mistyle.core.image import bilinear
from mistyle.core.mesh import Mesh
from mistyle.fitting.light.unknown_light import FoundLight
from mistyle.render.mitsuba.draw import gbuffer

LEAST = 16  # pixels of the surface


def gauged(
    mesh: Mesh, found: FoundLight, camera: Camera, surface: Bool[np.ndarray, "h w"], albedo: Sequence[float]
) -> tuple[FoundLight, tuple[float, float, float]]:
    """The light under which the surface has this albedo (linear Rec.709), and the factors of the albedo.

    `surface` masks the camera's picture. InputRefused where it shows fewer than LEAST pixels of the mesh.
    """
    hits = gbuffer(mesh, camera)
    chosen = surface & hits.mask
    if chosen.sum() < LEAST:
        raise InputRefused(
            f"the mask of the known albedo shows {int(chosen.sum())} pixels of the mesh in '{camera.name}', expected "
            f"{LEAST}. The surface must be part of the mesh; check the mask and its name."
        )
    values = []
    for part, maps in enumerate(found.maps):
        own, size = chosen & (hits.part == part), np.array(maps.albedo.shape[1::-1])
        uv = hits.uv[own] % 1
        px = np.stack([uv[:, 0], 1 - uv[:, 1]], axis=-1) * size
        values.append(bilinear(maps.albedo, px.astype(np.float32)))
    solved = np.median(np.concatenate(values), axis=0)
    factor = np.asarray(albedo, float) / np.maximum(solved, 1e-4)
    light = replace(found.light, radiance=(found.light.radiance / factor).astype(np.float32))
    sun = found.sun
    if sun is not None:
        r, g, b = (np.asarray(sun.irradiance) / factor).tolist()
        sun = replace(sun, irradiance=(r, g, b))
    maps = tuple(replace(m, albedo=np.clip(m.albedo * factor, 0, 1).astype(np.float32)) for m in found.maps)
    x, y, z = factor.tolist()
    return replace(found, light=light, sun=sun, maps=maps), (x, y, z)
