"""Settings of the two-phase fit."""

from pathlib import Path
from typing import Literal

from pydantic import Field

from mistyle.core.settings import FrozenModel
from mistyle.solver.settings import RecoverSettings

# Of the solver of lit views. Stylized views are not measurements: fewer steps and samples than for photographs.
ITERATIONS, BOUNCES, BOUNCE_SAMPLES, JOINT_SAMPLES = 640, 2, 32, 9


class FitSettings(FrozenModel):
    """Settings of the fit: the paper's values (4.2) where given, else values measured on real data."""

    refine: Literal["auto", "off", "normal-roughness", "albedo", "all"] = "auto"
    """which maps may change: those of phase 1, of phase 2, or of both; auto: `refine_painted` for the embedded
    stylizer, else all"""
    refine_painted: Literal["off", "normal-roughness", "albedo", "all"] = "albedo"
    """maps of a painted surface that auto refines (its views are rendered from these maps); drafts: off"""
    painted: Literal["auto", "without-light", "with-light"] = "auto"
    """whether the stylized views show lit objects; auto: as the stylizer paints (diffusion with light)"""
    unlight: float = Field(default=1.0, ge=0, le=1)
    """largest share of the shading under the views' own lights that is divided out of views painted with light, before
    the bake and phase 2; 0: none (the paper)"""
    solve: bool = True
    """for views painted with light, solve for normal, roughness and albedo under the views' own light, before phase 2;
    false: both phases by Adam alone (the paper)"""
    lights: Literal["together", "one-per-view"] = "one-per-view"
    """phase 1's lights for views without light: all at once (the paper), or one per crop, in turn"""
    metallic: Literal["keep", "zero", "fit"] = "keep"
    """the asset's own metallic map (0 without one), 0, or fitted by phase 1"""
    features: Path | None = None
    """weights of VGG-19, or vgg19 (vgg19-normalised), which `mistyle models` lists; none: the embedded filter bank"""
    bridge: Literal["frozen", "wrap"] = "frozen"
    """between torch and Dr.Jit: recorded functions, or dr.wrap around mi.render (slower, same numbers)"""
    iterations1: int = Field(default=200, ge=0, le=100_000)
    """steps of phase 1: normal and roughness"""
    iterations2: int = Field(default=300, ge=0, le=100_000)
    """steps of phase 2: albedo"""
    crops: int = Field(default=4, ge=1, le=64)
    """crops per step"""
    crop_size: int = Field(default=256, ge=32, le=1024)
    """pixels along a crop's side (the paper's 256)"""
    crop_scale: tuple[float, float] = (0.75, 1.25)
    """range of a crop's side in pixels of the view / crop_size"""
    texels_per_pixel: float = Field(default=1.25, gt=0)
    """largest number of texels along a pixel's side; selects the fit's mip level"""
    style1: float = Field(default=1.0, ge=0)
    """weight of the style loss in phase 1"""
    statistics: float = Field(default=0.001, ge=0)
    """weight of the features' statistics in phase 1, for views without light"""
    statistic: Literal["gram", "mean-std", "swd"] = "gram"
    """statistics: Gram matrices, mean and deviation, or sliced Wasserstein distance"""
    relief: float = Field(default=0.15, ge=0, le=1)
    """slope of the strokes' relief (root mean square), for views without light"""
    smooth: float = Field(default=1.0, gt=0)
    """smoothing of strokes before their relief, pixels of a view"""
    sheen: float = Field(default=0.05, ge=0, le=1)
    """share of the strokes' own contrast that roughness may explain"""
    radius: float = Field(default=12.0, gt=0)
    """radius of local mean and contrast, pixels of a view"""
    tv_normal: float = Field(default=0.02, ge=0)
    """weight of the normal's total variation"""
    tv_roughness: float = Field(default=0.01, ge=0)
    """weight of the roughness's total variation"""
    style2: float = Field(default=15.0, ge=0)
    """weight of the style loss in phase 2 (the paper's)"""
    statistics2: float = Field(default=0.0, ge=0)
    """weight of the features' statistics in phase 2"""
    tv_albedo: float = Field(default=0.05, ge=0)
    """largest weight of the albedo's total variation, reached for a flat style"""
    tv_from: Literal["views", "style"] = "views"
    """source of the mean gradient that lowers `tv_albedo`: the stylized views, at the fit's scale, or the style picture
    (the paper)"""
    colour2: float = Field(default=5.0, ge=0)
    """weight of the sliced Wasserstein distance in phase 2 (the paper's)"""
    projections: int = Field(default=32, ge=1, le=1024)
    """directions of the sliced Wasserstein distance"""
    colour_samples: int = Field(default=8192, ge=16)
    """pixels of the sliced Wasserstein distance"""
    rate_normal: float = Field(default=0.05, gt=0)
    """Adam's rate for the normal's tilt"""
    rate_roughness: float = Field(default=0.03, gt=0)
    """Adam's rate for the roughness"""
    rate_albedo: float = Field(default=0.005, gt=0)
    """Adam's rate for the albedo"""
    reduced: float = Field(default=0.05, ge=0, le=1)
    """learning rate of normal and roughness in phase 2, as a share of phase 1's"""
    judge: bool = True
    """undo a phase that makes detail, style or view-to-view agreement worse"""
    struggle_window: int = Field(default=100, ge=1)
    """last steps whose albedo gradient is accumulated (the paper's 100)"""


def lit_solver(settings: FitSettings, soft: bool) -> RecoverSettings:
    """The material solver's settings for stylized views under known light, which may be `soft`."""
    return RecoverSettings(
        # Under soft light, steps on whole pictures took as long as the texels and were undone.
        solver="texels" if soft else "both",
        metallic=settings.metallic == "fit",
        iterations=ITERATIONS,
        bounces=BOUNCES,
        bounce_samples=BOUNCE_SAMPLES,
        joint_subsamples=JOINT_SAMPLES,
    )
