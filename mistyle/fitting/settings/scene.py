"""The settings of `mistyle fit --scene`, resolved by the functions of jobs/settings.py."""

from typing import Any, Literal

from pydantic import Field

from mistyle.core.settings import FrozenModel


class SceneSettings(FrozenModel):
    """The settings of one fit of a Mitsuba scene's parameters."""

    seed: int = Field(default=0, ge=0, lt=2**31)
    """every random choice follows from it"""
    threads: int = Field(default=0, ge=0, le=1024)
    """threads of the renderer; 0 takes all cores"""
    variant: Literal["auto", "llvm_ad_rgb", "cuda_ad_rgb", "metal_ad_rgb"] = "auto"
    iterations: int = Field(default=256, ge=1, le=1_000_000)
    """steps; each renders one sensor"""
    spp: int = Field(default=16, ge=1, le=65536)
    """samples per pixel of the picture in a step"""
    spp_grad: int = Field(default=0, ge=0, le=65536)
    """samples per pixel of the derivative; 0: 8 for numbers, 1 for textures"""
    loss: Literal["auto", "relative", "log_srgb_l1", "l2"] = "auto"
    """auto: relative for noisy renders (its minimum does not depend on the samples), log_srgb_l1 for noise-free ones"""
    channels: str = ""
    """channels of an EXR reference: a prefix (image), or three names (image.R,image.G,image.B)"""


SCENE_PRESETS: dict[str, dict[str, Any]] = {"draft": {"iterations": 64}, "standard": {}}
