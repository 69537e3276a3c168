"""Views of a mesh under light records, path traced: Mitsuba's `principled` with the frames of a fit."""

from collections.abc import Sequence
from typing import Literal

from mistyle.core.camera import Camera
from mistyle.core.light import Lights
from mistyle.core.maps import Maps
from mistyle.core.mesh import Mesh
from mistyle.core.view import View
from mistyle.process import memory
from mistyle.render.lookdev.scenes import asset_scene
from mistyle.render.mitsuba import device
from mistyle.render.mitsuba import scene as scenery
from mistyle.render.mitsuba.draw import mean_of_passes, tracer, view_of


def draw_lit_views(
    mesh: Mesh,
    maps: Sequence[Maps] | None,
    cameras: Sequence[Camera],
    lights: Sequence[Lights],
    spp: int = 64,
    seed: int = 0,
    *,
    integrator: Literal["path", "direct"] = "path",
) -> list[View]:
    """Render `mesh` with one set of maps per texture set (None: neutral grey), view k under the lights `lights[k]`.

    Normal maps are in MikkTSpace frames, and a perturbed normal that faces away from the camera is black, as in the
    fits. "path" includes indirect light, "direct" omits it. `View.rgb` is linear and premultiplied by the coverage; the
    environment lights the mesh but is invisible. Views have independent noise. `spp` is rounded up to a power of two.
    Raises ValueError for light that only a scene file describes.
    """
    traced = tracer(mesh)
    shapes = scenery.object_shapes(mesh, maps, frame="mikkt")
    views = []
    for k, (camera, rig) in enumerate(zip(cameras, lights, strict=True)):
        scene = asset_scene(shapes, camera, rig, integrator)
        picture = mean_of_passes(scene, scene.sensors()[0], camera.size, spp, (seed + k) % 2**32)
        views.append(memory.away(view_of(traced, camera, picture)))
    device.give_back()
    return views
