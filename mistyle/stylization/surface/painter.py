"""Weight-free stylizer, without a network: of a whole surface, evaluated at any point, or of single views."""

from collections.abc import Callable

import numpy as np

from mistyle.core.asset import Picture
from mistyle.core.image import linear_from_srgb
from mistyle.core.mesh import Mesh
from mistyle.core.view import Prior, View
from mistyle.render.mitsuba import occlusion
from mistyle.render.mitsuba.draw import tracer
from mistyle.stylization.mvst.sweep import Stylizer
from mistyle.stylization.surface import kernels
from mistyle.stylization.surface.guides.guides import Content, Occlusion
from mistyle.stylization.surface.guides.linefield import DirectionConstraint
from mistyle.stylization.surface.lookup import PaintedSurface
from mistyle.stylization.surface.settings import ResolvedSettings, SurfaceSettings
from mistyle.stylization.surface.synthesis import SurfaceFields, mesh_guides, solve
from mistyle.stylization.surface.view_samples import paint_view


def open_sky(mesh: Mesh, seed: int) -> Occlusion:
    """A function for the share of open sky at points of a mesh; builds the ray-tracing structure once."""
    traced = tracer(mesh)
    return lambda positions, normals: occlusion.open_sky(traced, positions, normals, seed=seed)[:, 3].copy()


def solve_surface(
    mesh: Mesh,
    style: Picture,
    settings: SurfaceSettings | ResolvedSettings,
    seed: int = 0,
    progress: Callable[[float], None] = lambda done: None,
    *,
    content: Content | None = None,
    direction: DirectionConstraint | None = None,
) -> PaintedSurface:
    """Paint `mesh` in the style of a picture; see `mistyle.stylization.surface.synthesis.solve` for limits and errors.

    `content(positions, normals)` is the lightness (0..1) of the mesh's own texture, `direction` that of strokes.
    """
    fields = SurfaceFields(open_sky(mesh, seed), content, direction)
    return solve(mesh, style, fields, settings, seed, progress)


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
    """A Stylizer of views of `mesh` in the style of a picture, for `mvst.sweep.sweep`; it keeps outlines.

    The guides are those of `solve_surface`, computed once. Known pixels of priors stay; see
    `mistyle.stylization.surface.view_samples.paint_view`.
    """
    fields = SurfaceFields(open_sky(mesh, seed), content, direction)
    base = mesh_guides(mesh, style, fields, settings, seed, kernels.module(), progress)

    def paint(view: View, prior: Prior | None, rng: np.random.Generator) -> np.ndarray:
        rgb = linear_from_srgb(paint_view(view, prior, base, int(rng.integers(2**31))))
        return rgb if prior is None else np.where((prior.known & view.mask)[..., None], prior.rgb, rgb)

    return paint
