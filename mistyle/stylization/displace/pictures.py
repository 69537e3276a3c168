"""Pictures of the shape before and after the displacement: matt grey under a hard key light."""

import numpy as np
from jaxtyping import Float

from mistyle.core.camera import Camera, orbit, resized
from mistyle.core.image import srgb_from_linear
from mistyle.core.maps import flat_maps
from mistyle.core.mesh import Mesh
from mistyle.render.lookdev.scenes import asset_scene, drawn, light_rig
from mistyle.render.mitsuba.scene import object_shapes

SPP = 16
GROUND = 0.18  # linear radiance behind the mesh
ASIDE = 60.0  # degrees from an edited view to the second camera


def cameras_of(views: list[Camera], size: int) -> list[Camera]:
    """The first changed view and one from the side, `size` pixels high."""
    first = views[0]
    if not np.isfinite([first.azimuth, first.elevation]).all():
        return [resized(first, (size, size)) if first.size[0] == first.size[1] else first]
    ways = ((first.azimuth, first.elevation), (first.azimuth + ASIDE, 15.0))
    return [orbit(azimuth, elevation, distance=4, fov=30, size=(size, size)) for azimuth, elevation in ways]


def under_key(mesh: Mesh, cameras: list[Camera], seed: int) -> Float[np.ndarray, "h w 3"]:
    """The mesh as matt grey clay from every camera, side by side, sRGB."""
    shapes = object_shapes(mesh, [flat_maps(2, 0.5, 0.9)] * len(mesh.parts))
    light, pictures = light_rig("key", None), []
    for camera in cameras:
        picture = drawn(asset_scene(shapes, camera, light, "direct"), 0, SPP, seed)
        pictures.append(picture[..., :3] + (1 - np.clip(picture[..., 3:4], 0, 1)) * GROUND)
    return srgb_from_linear(np.clip(np.concatenate(pictures, axis=1), 0, None))
