"""User settings of baking views into texels."""

from pydantic import BaseModel, ConfigDict, Field


class BakeSettings(BaseModel):
    """Acceptance of a view for a texel (paper 4.1.4)."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    depth_tolerance: float = Field(
        default=0.05, gt=0, le=1, description="largest difference between a texel's and the view's depth"
    )
    window: int = Field(
        default=5,
        ge=1,
        le=31,
        description="side in pixels of the window in which a silhouette pixel takes its pure colour",
    )
