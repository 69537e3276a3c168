"""Settings of the deformation to outlines."""

from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field

from mistyle.core.settings import FrozenModel


def share(value: Any) -> Any:
    """'2%' as 0.02; anything else unchanged, for pydantic to judge."""
    if isinstance(value, str) and value.strip().endswith("%"):
        try:
            return float(value.strip()[:-1]) / 100
        except ValueError:
            return value
    return value


class DisplaceSettings(FrozenModel):
    """How far and how smoothly the mesh follows the outlines of stylized views (paper 6.2.2)."""

    most: Annotated[float, BeforeValidator(share)] = Field(default=0.0, ge=0, le=0.5)
    """how far a vertex may move, as a share of the mesh's bounding radius (0.02 or '2%'); 0: the mesh stays
    unchanged"""
    along: Literal["any", "normal"] = "any"
    """directions of the displacement: any, or only the vertex's normal"""
    smooth: float = Field(default=0.015, ge=0.002, le=0.5)
    """size of the smallest feature of an outline that the mesh follows, in bounding radii"""
    height_map: bool = False
    """also write the painting's relief as a height map (16-bit PNG, EXR); it does not move vertices"""
    steps: int = Field(default=30, ge=1, le=500)
    """most Gauss-Newton steps"""
