"""Renders of a mesh with a known material, in memory."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, overload

import numpy as np
from jaxtyping import Float

from mistyle.api import html
from mistyle.core.asset import Asset
from mistyle.core.camera import Camera
from mistyle.core.capture import Captures, in_memory
from mistyle.core.image import srgb_from_linear
from mistyle.core.light import Light, Lights
from mistyle.core.maps import Maps
from mistyle.core.mesh import Mesh
from mistyle.core.view import View
from mistyle.render.deferred.differentiable import lights_of_cameras

WHOLE = 0.999  # least coverage of a fully covered pixel


@dataclass(frozen=True)
class Views(Sequence[View]):
    """Rendered views and the lights of each; a sequence of `View` records."""

    views: tuple[View, ...]
    lights: tuple[Lights, ...]

    def __len__(self) -> int:
        return len(self.views)

    @overload
    def __getitem__(self, index: int) -> View: ...
    @overload
    def __getitem__(self, index: slice) -> "Views": ...
    def __getitem__(self, index: int | slice) -> "View | Views":
        return Views(self.views[index], self.lights[index]) if isinstance(index, slice) else self.views[index]

    @property
    def captures(self) -> Captures:
        """The views as references of `recover`; only fully covered pixels are valid."""
        cameras = [view.camera for view in self.views]
        pictures, masks = [v.rgb for v in self.views], [np.asarray(v.coverage >= WHOLE) for v in self.views]
        return in_memory(cameras, self.lights, pictures, masks)

    def _repr_html_(self) -> str:
        shown = {view.camera.name: straight(view) for view in self.views[:12]}
        more = "" if len(self.views) <= 12 else f", the first 12 of {len(self.views)}"
        return html.page(f"{len(self.views)} views{more}", html.thumbnails(shown))


def straight(view: View) -> Float[np.ndarray, "h w 4"]:
    """A view as sRGB with straight alpha."""
    colour = srgb_from_linear(view.rgb / np.maximum(view.coverage, np.float32(1e-6))[..., None])
    return np.concatenate([colour, view.coverage[..., None]], axis=-1).astype(np.float32)


def render_views(
    mesh: Mesh | Asset,
    maps: Maps | Sequence[Maps] | None,
    cameras: Camera | Sequence[Camera],
    lights: Light | Sequence[Light] | Sequence[Sequence[Light]],
    spp: int = 64,
    *,
    seed: int = 0,
    integrator: Literal["path", "direct"] = "path",
) -> Views:
    """Render a mesh with `principled` materials from known cameras under known lights.

    mesh        a mesh in working space, or an asset of `read_mesh`
    maps        `Maps` for each texture set (a single record for one set); None: the asset's own albedo, normal,
                roughness and metallic, or neutral grey for a mesh
    cameras     pinhole cameras (OpenCV axes, working units), for example of `orbit` and `look_at`
    lights      a light, a rig of lights for all cameras, or a rig for each camera; linear Rec.709
    spp         samples per pixel, rounded up to a power of two
    integrator  "path" with indirect light, "direct" without

    `view.rgb` (h, w, 3) is linear Rec.709 radiance, premultiplied by `view.coverage`; environments are invisible but
    light the mesh. Equal inputs, seed and threads give equal bytes. Opacity, emission, coats and transmission of an
    asset are not drawn (`mistyle.lookdev` draws them). Raises ValueError for light that only a scene file describes.
    """
    from mistyle.render.lookdev.scenes import material_maps
    from mistyle.render.mitsuba.lit_views import draw_lit_views

    seen_from = [cameras] if isinstance(cameras, Camera) else list(cameras)
    if maps is None and isinstance(mesh, Asset):
        maps = [material_maps(material) for material in mesh.materials]
    sets = [maps] if isinstance(maps, Maps) else maps
    rigs = lights_of_cameras(lights, len(seen_from))
    shape = mesh.mesh if isinstance(mesh, Asset) else mesh
    return Views(tuple(draw_lit_views(shape, sets, seen_from, rigs, spp, seed, integrator=integrator)), rigs)
