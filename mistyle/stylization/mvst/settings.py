"""What a user may choose about views that are painted one after another."""

from pathlib import Path
from typing import Literal

from pydantic import BaseModel, ConfigDict, Field


class WarpSettings(BaseModel):
    """How earlier views are carried into a later one (paper 4.1.3)."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    fill: int = Field(default=3, ge=0, le=16, description="holes this many pixels from a painted pixel are filled")
    erosion: int | None = Field(
        default=None,
        ge=0,
        le=200,
        description="pixels (at 1024 across) cut off beside occlusion shadows, where outlines may have moved; "
        "left out: 20, or 2 for a stylizer that keeps outlines",
    )
    depth_tolerance: float = Field(
        default=0.05, gt=0, le=1, description="largest difference in depth that still is the same surface"
    )
    facing: float = Field(
        default=0.2,
        ge=0,
        lt=1,
        description="cosine below which a source sees a surface at too grazing an angle to be used",
    )
    sharpness: float = Field(
        default=0.5,
        ge=0,
        le=1,
        description="least cosine at which a source must have seen a surface, in shares of that of the view it is "
        "carried to: what would only be stretched is painted anew",
    )
    look_up: bool = Field(
        default=True,
        description="take colours bilinearly from where the view's own surface lies in the source, instead of those of "
        "the points that landed",
    )


class SweepSettings(BaseModel):
    """How views are painted one after another (paper 4.1.3)."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    order: Literal["angular", "paper", "given"] = Field(
        default="angular",
        description="angular: nearest to the views done; paper: ascending |azimuth| + |elevation|; given: the rig's",
    )
    histogram: float = Field(
        default=0.0,
        ge=0.0,
        le=1.0,
        description="how far the colours of later views are moved to the first one's distribution; the paper's is 1",
    )
    segmenter: Path | None = Field(
        default=None,
        description="ONNX file that finds the foreground of a stylized view, or birefnet, which `mistyle models` "
        "lists; left out: the rendered mask",
    )
    follow_outline: bool | None = Field(
        default=None,
        description="move a view's depth to the outline that a segmenter finds in it before it is carried elsewhere; "
        "left out: for stylizers that may move outlines",
    )
    mask_erosion: int = Field(default=1, ge=0, le=64, description="pixels by which the rendered coverage is cut back")
    warp: WarpSettings = WarpSettings()
