"""Weight-free stylizer: paints the surface once and evaluates it at any point, without a network."""

from collections.abc import Callable

from mistyle.core.asset import Picture
from mistyle.core.mesh import Mesh
from mistyle.render.mitsuba.draw import tracer
from mistyle.render.mitsuba.occlusion import ambient_occlusion
from mistyle.stylization.surface.guides.guides import Content, Occlusion
from mistyle.stylization.surface.guides.linefield import DirectionConstraint
from mistyle.stylization.surface.lookup import PaintedSurface
from mistyle.stylization.surface.settings import ResolvedSettings, SurfaceSettings


def open_sky(mesh: Mesh, seed: int) -> Occlusion:
    """A function for the share of open sky at points of a mesh; builds the ray-tracing structure once."""
    traced = tracer(mesh)
    return lambda positions, normals: ambient_occlusion(traced, positions, normals, seed=seed)


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
    from mistyle.stylization.surface.synthesis import SurfaceFields, solve

    fields = SurfaceFields(open_sky(mesh, seed), content, direction)
    return solve(mesh, style, fields, settings, seed, progress)
