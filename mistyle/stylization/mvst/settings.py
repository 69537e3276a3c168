"""Settings of view warping and the sweep over views."""

from pathlib import Path
from typing import Literal

from pydantic import Field

from mistyle.core.settings import FrozenModel


class WarpSettings(FrozenModel):
    """Warping of earlier views into a later one (paper 4.1.3)."""

    fill: int = Field(default=3, ge=0, le=16)
    """holes this many pixels from a painted pixel are filled"""
    erosion: int | None = Field(default=None, ge=0, le=200)
    """pixels (at 1024 across) cut off beside occlusion shadows, where outlines may have moved; unset: 20, or 2 for a
    stylizer that keeps outlines"""
    depth_tolerance: float = Field(default=0.05, gt=0, le=1)
    """largest depth difference within one surface"""
    facing: float = Field(default=0.2, ge=0, lt=1)
    """least cosine at which a source pixel is used; below it the angle is too grazing"""
    sharpness: float = Field(default=0.5, ge=0, le=1)
    """least cosine of a source pixel, as a share of the target view's: surfaces that would only be stretched are
    repainted"""
    look_up: bool = True
    """sample colours bilinearly at the projection of the view's own surface into the source, instead of the scattered
    points' colours"""


class SweepSettings(FrozenModel):
    """The sweep over views (paper 4.1.3)."""

    order: Literal["angular", "paper", "given"] = "angular"
    """angular: nearest to finished views; paper: ascending |azimuth| + |elevation|; given: the rig's"""
    histogram: float = Field(default=0.0, ge=0.0, le=1.0)
    """strength of matching later views' colours to the first one's distribution; the paper's is 1"""
    segmenter: Path | None = None
    """ONNX file that segments the foreground of a stylized view, or birefnet (see `mistyle models`); unset: the
    rendered mask"""
    follow_outline: bool | None = None
    """warp a view's depth to the segmenter's outline before the view is warped into others; unset: for stylizers that
    may move outlines"""
    mask_erosion: int = Field(default=1, ge=0, le=64)
    """pixels by which the rendered coverage is eroded"""
    warp: WarpSettings = WarpSettings()
