"""Settings of the texture repair."""

from pydantic import Field

from mistyle.core.settings import FrozenModel


class RepairSettings(FrozenModel):
    """Struggle mask and blending of the repair (paper 4.3)."""

    deviations: float = Field(default=0.5, ge=0, le=10)
    """a texel struggles above mean + this many standard deviations (the paper's 0.5)"""
    outlier: float = Field(default=4.0, ge=0, le=100)
    """and above this many times the median: for consistent views, mean and deviation alone mark a third; 0: no such
    limit (the paper)"""
    agreement: float = Field(default=0.7, ge=0, le=1)
    """and only where views contradict one another: |sum| of the gradients is at most this share of the sum of
    |gradients|; 1: wherever gradients are large (the paper)"""
    dilation: float = Field(default=0.004, ge=0, le=0.1)
    """radius of the mask's max-pooling as a share of the atlas's side"""
    smooth: float = Field(default=0.004, ge=0, le=0.1)
    """share of the atlas's side over which gradients are averaged: single texels do not struggle"""
    blend: float = Field(default=0.003, ge=0, le=0.1)
    """half the width of the blended boundary as a share of the atlas's side"""
