"""User settings of fitting materials to pictures under known light."""

from math import isqrt
from typing import Literal

from pydantic import Field, field_validator

from mistyle.core.settings import FrozenModel

SETTLING = 3
FEWER = 8  # factor of fewer samples for provisional estimates of indirect light
PASSES = 8  # most passes over the pictures, the last twice as long
DETAILED = 20_000_000  # most texels times pictures that are observed at once for the albedo's detail
LEAST_MEASURED = 4
LARGE = 4_000_000  # pixels of a picture from which it is averaged for a coarser level of the per-texel solver
SWEEPS = 2  # least epochs of a pass; fewer steps give fewer passes


class RecoverSettings(FrozenModel):
    """Settings of `solver/recover.py`; defaults come from measurements on synthetic maps with ground truth.

    Radiance settings are relative to the brightest observed radiance, so no default depends on the exposure.
    """

    model: Literal["principled", "gltf"] = "principled"
    """reflectance: Mitsuba's principled, or glTF's metallic-roughness exactly"""
    frame: Literal["mikkt", "mitsuba"] = "mikkt"
    """frame of the normal map: MikkTSpace as in engines, or Mitsuba 3.9's per face"""
    metallic: bool = False
    """fit metallic too, near 0 or 1 unless the data disagree; else the start's stays (0 if none)"""
    black_gloss: Literal["metal", "plastic"] = "metal"
    """with metallic: what black gloss is taken for where no picture shows its highlight"""
    solver: Literal["both", "texels", "pictures"] = "both"
    """per texel (Levenberg-Marquardt), then whole pictures (Adam), or one of them alone"""
    solver_texels: int = Field(default=2_000_000, ge=1)
    """most texels of the per-texel solver, under soft light a 16th of it; a finer atlas is solved at a coarser level"""
    solver_iterations: int = Field(default=12, ge=1, le=1000)
    """Levenberg-Marquardt steps from each start"""
    rounds: int = Field(default=3, ge=0, le=100)
    """rounds of defect correction: each adds the pictures' residual to the texels' targets and solves again; as many
    after each estimate of indirect light, which restarts the solver, and three times as many after the last"""
    neighbours: float = Field(default=0.03, gt=0)
    """standard deviation between a texel and its neighbours' mean; for tilts its upper bound"""
    smooth: bool = True
    """Empirical-Bayes smoothing of albedo, tilt and roughness; its strength is estimated locally and grows with their
    uncertainty; a sharp edge that few pictures show is rounded"""
    detail: bool = False
    """where the per-texel solver ran on a level coarser than the atlas: take the albedo's detail from the pictures,
    divided by the fitted shading"""
    noise: float = Field(default=0.0005, gt=0, le=1)
    """standard deviation of a dark pixel, larger than the rounding of 8-bit sRGB; with 0.002 the highlights of black
    rubber do not determine its roughness"""
    relative: float = Field(default=0.01, ge=0, le=1)
    """standard deviation of a pixel relative to its value"""
    facing: float = Field(default=0.2, gt=0, lt=1)
    """least cosine between a texel's normal and the direction to the camera"""
    iterations: int = Field(default=2160, ge=0, le=1_000_000)
    """steps of Adam, one picture each; after the per-texel solver in up to eight passes"""
    rate: float = Field(default=0.003, gt=0, le=1)
    """Adam's initial rate in each pass; it falls to zero along a cosine"""
    levels: int = Field(default=5, ge=1, le=16)
    """levels of the pyramid that preconditions Adam"""
    loss: Literal["log_srgb_l1", "l2"] = "log_srgb_l1"
    """loss that Adam minimises"""
    subsamples: int = Field(default=9, ge=1, le=64)
    """samples a pixel, a square number; with 4 the gradient's error at highlights triples"""
    soft_subsamples: int = Field(default=4, ge=1, le=64)
    """samples a pixel under environments and ambient light, a square number"""
    soft_cells: int = Field(default=128, ge=8, le=512)
    """cells of such light in a sample; with few, pictures are noisy, and Adam fits normals to the noise"""
    soft_bounces: int = Field(default=8, ge=0, le=8)
    """most estimates of indirect light under environments and ambient light"""
    soft_measured: int = Field(default=128, ge=8, le=512)
    """cells of such light in the pictures that measure the fit"""
    roughness_floor: float = Field(default=0.04, ge=0.0317, le=1)
    """least roughness; below 0.0316 it has no effect and no gradient"""
    bounces: int = Field(default=6, ge=0, le=8)
    """number of estimates of indirect light, which is subtracted from the pictures; joint steps add two estimates"""
    bounce_samples: int = Field(default=128, ge=1, le=4096)
    """samples a pixel of those estimates; the first and those between passes on whole pictures have an eighth, except
    for the last of all; that of the last joint steps has twice as many"""
    joint: int = Field(default=3, ge=0, le=100)
    """final joint Gauss-Newton steps over all texels and pictures with the smoothness prior, after each of two
    estimates of indirect light; under directional and point lights only"""
    joint_subsamples: int = Field(default=25, ge=1, le=256)
    """samples a pixel in those steps, a square number: with 9, which undersample a pixel's edges and texture, a
    helmet's normals had an error of 0.42° under direct light, with 25 of 0.34°"""
    polish: int = Field(default=0, ge=0, le=100_000)
    """final steps through Mitsuba's prb, with indirect light in picture and gradient: slow"""
    polish_rate: float = Field(default=0.0005, gt=0, le=1)
    """their initial rate, small because their gradients are noisy"""
    polish_depth: int = Field(default=6, ge=2, le=64)
    """path segments of those steps"""
    shadows: bool = True
    """whether the object shadows itself"""
    memory: float = Field(default=4.0, gt=0)
    """GB for cached samples of the pictures"""
    checkpoint: float = Field(default=60.0, gt=0)
    """seconds between checkpoints"""

    @field_validator("subsamples", "joint_subsamples", "soft_subsamples")
    @classmethod
    def _square(cls, value: int) -> int:
        if isqrt(value) ** 2 != value:
            raise ValueError("expected a square number: 1, 4, 9, 16, 25, …")
        return value


def measured_subsamples(settings: RecoverSettings, soft: bool, pixels: float = 0) -> int:
    """Samples a pixel of the pictures that measure a fit: at least LEAST_MEASURED, so that edges are averaged, and no
    more in pictures of more than LARGE pixels."""
    least = min(settings.subsamples, LEAST_MEASURED) if pixels > LARGE else settings.subsamples
    return max(settings.soft_subsamples, LEAST_MEASURED) if soft else least


def descent_steps(settings: RecoverSettings) -> int:
    """Number of steps on whole pictures; 0 with `solver` "texels"."""
    return 0 if settings.solver == "texels" else settings.iterations


def joint_steps(settings: RecoverSettings) -> int:
    """Number of joint steps; 0 unless the per-texel solver and whole pictures come before and `smooth` is on."""
    return settings.joint if settings.solver == "both" and settings.smooth and descent_steps(settings) else 0


def joint_estimates(settings: RecoverSettings) -> tuple[int, ...]:
    """Samples a pixel of each estimate of indirect light before joint steps: the last has more, since its maps hardly
    change any more."""
    several = joint_steps(settings) and settings.bounces
    return (settings.bounce_samples, 2 * settings.bounce_samples) if several else ()


def all_rounds(settings: RecoverSettings, pictures: int) -> int:
    """Rounds of the per-texel solver: `rounds` at first and after each estimate of indirect light, SETTLING times as
    many after the last, so that they converge."""
    among = len(estimates(settings, pictures)[0])
    return settings.rounds * (among + (SETTLING if among else 1))


def estimates(settings: RecoverSettings, pictures: int) -> tuple[list[int], list[int]]:
    """Samples a pixel of each estimate of indirect light: those among the rounds, those before last passes.

    The first has few, since its maps are inaccurate, and so have provisional ones. With joint steps the last estimate
    is theirs.
    """
    few, many = -(-settings.bounce_samples // FEWER), settings.bounce_samples
    late = min(_passes(settings, pictures) - 1, settings.bounces // 2) if settings.solver == "both" else 0
    among, last = settings.bounces - late, late > 0 and not joint_steps(settings)
    return [few] * (among > 1) + [many] * (among - (among > 1)), [few] * (late - last) + [many] * last


def passes(settings: RecoverSettings, pictures: int) -> list[tuple[int, int]]:
    """Steps of each pass on whole pictures, and samples of the estimate before it, 0 for none."""
    count, late = _passes(settings, pictures), estimates(settings, pictures)[1]
    ends = [settings.iterations * k // (count + 1) for k in range(count)] + [settings.iterations]
    steps = [end - begin for begin, end in zip(ends[:-1], ends[1:], strict=True)]
    return list(zip(steps, [0] * (count - len(late)) + late, strict=True))


def _passes(settings: RecoverSettings, pictures: int) -> int:
    return max(1, min(PASSES, settings.iterations // (SWEEPS * max(pictures, 1)) - 1))
