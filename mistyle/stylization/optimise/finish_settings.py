"""Settings of the finish of a painted albedo."""

from pathlib import Path
from typing import Literal

from pydantic import Field

from mistyle.core.settings import FrozenModel

JUDGED = 3  # batches of held-out crops that compare before and after
JUDGING = 0.4  # cost of such a batch, in steps: nothing is differentiated


class FinishSettings(FrozenModel):
    """VGG-19 style losses on many rendered crops, after the painting and before the fit."""

    method: Literal["off", "vgg"] = "off"
    """vgg: style losses of VGG-19 move the painted albedo (needs --vgg FILE)"""
    features: Path | None = None
    """weights of VGG-19 for the finish alone; unset: those of fit.features (--vgg)"""
    steps: int = Field(default=240, ge=1, le=100_000)
    """gradient steps"""
    crops: int = Field(default=4, ge=1, le=64)
    """rendered crops per step"""
    crop_size: int = Field(default=256, ge=64, le=1024)
    """pixels along a crop's side"""
    texels_per_pixel: int = Field(default=2, ge=1, le=8)
    """texels along a pixel's side; finer detail stays the painter's own"""
    statistic: Literal["gram", "mean-std", "swd"] = "gram"
    """statistic of the features: Gram matrices, mean and deviation, or sliced Wasserstein distance"""
    style: float = Field(default=1.0, ge=0)
    """weight of that statistic's distance to the painting's"""
    content: float = Field(default=0.3, ge=0)
    """weight of the painter's own features, doubled along edges of the shape"""
    rate: float = Field(default=0.06, gt=0, le=0.5)
    """typical change of the albedo in a step (sRGB units)"""
    coarse: float = Field(default=0.5, ge=0, le=1)
    """share of that rate on each coarser level of the texture's pyramid"""
    damping: float = Field(default=3.0, ge=0, le=100)
    """0: Adam's steps, equal for every texel; higher: texels with small gradients hardly move"""
