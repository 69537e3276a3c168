"""User settings of the texture sets, and of baking views into them."""

from pydantic import Field

from mistyle.core.settings import FrozenModel


class AtlasSettings(FrozenModel):
    """The texture sets that are painted (paper 4.1.4 uses 4096)."""

    size: int = Field(default=2048, ge=16, le=16384)
    """texels along each side of every texture set"""
    padding: int = Field(default=16, ge=0, le=1024)
    """texels by which islands are extended outwards"""


class BakeSettings(FrozenModel):
    """Acceptance of a view for a texel (paper 4.1.4)."""

    depth_tolerance: float = Field(default=0.05, gt=0, le=1)
    """largest difference between a texel's and the view's depth"""
    window: int = Field(default=5, ge=1, le=31)
    """side in pixels of the window in which a silhouette pixel takes its pure colour"""
