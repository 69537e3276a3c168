"""Weight-free stylizer: paints the surface once and evaluates it at any point, without a network."""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float

from mistyle.core.asset import Picture
from mistyle.core.mesh import Mesh
from mistyle.stylization.surface.guides.guides import Content, Occlusion
from mistyle.stylization.surface.guides.linefield import DirectionConstraint
from mistyle.stylization.surface.lookup import Neighbours, PaintedSurface
from mistyle.stylization.surface.settings import ResolvedSettings, SurfaceSettings


def array_module() -> str:
    """Dr.Jit's array module for the Mitsuba variant in use: "llvm", "cuda" or "metal"."""
    from mistyle.render.mitsuba import device

    return device.use().split("_")[0]


def open_sky(mesh: Mesh, seed: int) -> Occlusion:
    """A function for the share of open sky at points of a mesh; builds the ray-tracing structure once."""
    from mistyle.render.mitsuba.draw import tracer
    from mistyle.render.mitsuba.occlusion import ambient_occlusion

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

    module, occlusion = array_module(), open_sky(mesh, seed)
    return solve(mesh, style, SurfaceFields(occlusion, content, direction), settings, seed, progress, module)


def surface_colour(
    surface: PaintedSurface,
    positions: Float[np.ndarray, "n 3"],
    normals: Float[np.ndarray, "n 3"],
    footprint: float = 0.0,
    near: Neighbours | None = None,
) -> Float[np.ndarray, "n 3"]:
    """Encoded sRGB of surface points; `footprint` (working units): query spacing, over which colour is averaged."""
    from mistyle.stylization.surface.lookup import colour

    return colour(surface, positions, normals, footprint=footprint, device=array_module(), near=near)


def surface_relief(
    surface: PaintedSurface,
    positions: Float[np.ndarray, "n 3"],
    normals: Float[np.ndarray, "n 3"],
    footprint: float = 0.0,
    near: Neighbours | None = None,
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, " n"]]:
    """Gradient of the painted height along the surface (root mean square about 1) and offset of the roughness;
    `footprint` as in `surface_colour`."""
    from mistyle.stylization.surface.lookup import relief

    return relief(surface, positions, normals, footprint=footprint, device=array_module(), near=near)


def surface_height(
    surface: PaintedSurface,
    positions: Float[np.ndarray, "n 3"],
    normals: Float[np.ndarray, "n 3"],
    footprint: float = 0.0,
) -> Float[np.ndarray, " n"]:
    """The painted height in working units, whose gradient is that of `surface_relief`; `footprint` as there."""
    from mistyle.stylization.surface.lookup import height

    return height(surface, positions, normals, footprint=footprint, device=array_module())
