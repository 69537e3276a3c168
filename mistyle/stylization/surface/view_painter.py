"""Weight-free stylizer of single views, for `mistyle.stylization.mvst.sweep.sweep`."""

from collections.abc import Callable

import numpy as np

from mistyle.core.asset import Picture
from mistyle.core.image import linear_from_srgb
from mistyle.core.mesh import Mesh
from mistyle.core.view import Prior, View
from mistyle.stylization.mvst.sweep import Stylizer
from mistyle.stylization.surface.guides.guides import Content
from mistyle.stylization.surface.guides.linefield import DirectionConstraint
from mistyle.stylization.surface.settings import ResolvedSettings, SurfaceSettings


def stylizer(
    mesh: Mesh,
    style: Picture,
    settings: SurfaceSettings | ResolvedSettings,
    seed: int = 0,
    progress: Callable[[float], None] = lambda done: None,
    *,
    content: Content | None = None,
    direction: DirectionConstraint | None = None,
) -> Stylizer:
    """A Stylizer of views of `mesh` in the style of a picture; it keeps outlines.

    The guides are those of the embedded stylizer, computed once. Known pixels of priors stay; see
    `mistyle.stylization.surface.view_samples.paint_view`.
    """
    from mistyle.stylization.surface import kernels
    from mistyle.stylization.surface.surface_painter import open_sky
    from mistyle.stylization.surface.synthesis import SurfaceFields, mesh_guides
    from mistyle.stylization.surface.view_samples import paint_view

    fields = SurfaceFields(open_sky(mesh, seed), content, direction)
    base = mesh_guides(mesh, style, fields, settings, seed, kernels.module(), progress)

    def paint(view: View, prior: Prior | None, rng: np.random.Generator) -> np.ndarray:
        rgb = linear_from_srgb(paint_view(view, prior, base, int(rng.integers(2**31))))
        return rgb if prior is None else np.where((prior.known & view.mask)[..., None], prior.rgb, rgb)

    return paint
