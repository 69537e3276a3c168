"""mistyle: one mesh and one style image in, the same mesh with stylized, physically based textures out.

The names of `__all__` are found in `mistyle.api` when they are first used: importing mistyle itself loads nothing.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mistyle.api import (
        Ambient,
        Asset,
        Camera,
        Captures,
        Comparison,
        Directional,
        Environment,
        Gallery,
        JobResult,
        Maps,
        MaterialFit,
        Mesh,
        MistyleError,
        Point,
        RecoverSettings,
        Renderer,
        SceneFit,
        SphericalGaussian,
        View,
        Views,
        bake,
        captures_of,
        compare,
        fit,
        fit_scene,
        flat_maps,
        gallery,
        look_at,
        lookdev,
        orbit,
        read_cameras,
        read_captures,
        read_lights,
        read_mesh,
        read_picture,
        read_views,
        recover,
        render_views,
        stylize,
        subset_of,
    )

__version__ = "0.1.0"
__all__ = [
    "__version__",
    "Ambient",
    "Asset",
    "Camera",
    "Captures",
    "Comparison",
    "Directional",
    "Environment",
    "Gallery",
    "JobResult",
    "Maps",
    "MaterialFit",
    "Mesh",
    "MistyleError",
    "Point",
    "RecoverSettings",
    "Renderer",
    "SceneFit",
    "SphericalGaussian",
    "View",
    "Views",
    "bake",
    "captures_of",
    "compare",
    "fit",
    "fit_scene",
    "flat_maps",
    "gallery",
    "look_at",
    "lookdev",
    "orbit",
    "read_cameras",
    "read_captures",
    "read_lights",
    "read_mesh",
    "read_picture",
    "read_views",
    "recover",
    "render_views",
    "stylize",
    "subset_of",
]


def __getattr__(name: str) -> Any:
    """What `mistyle.api` has under this name (PEP 562)."""
    if name not in __all__:
        raise AttributeError(f"module 'mistyle' has no attribute {name!r}")
    from mistyle import api

    return getattr(api, name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
