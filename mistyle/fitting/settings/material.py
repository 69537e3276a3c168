"""The settings of `mistyle fit`: one record per stage, resolved by the functions of jobs/settings.py."""

from typing import Any, Literal

from pydantic import Field

from mistyle.atlas.settings import AtlasSettings
from mistyle.core.settings import FrozenModel
from mistyle.jobs.deliver_settings import ColourSettings, DeliverSettings
from mistyle.jobs.job_settings import LEAST_OVERLAP, ReadSettings, ReportSettings
from mistyle.solver.settings import RecoverSettings


class ReferenceSettings(FrozenModel):
    """Reading and alignment of the reference pictures."""

    saturation: float = Field(default=1.0, gt=0, le=1)
    """least encoded value of a saturated channel (below 1 for JPEGs)"""
    up: Literal["y", "z"] = "y"
    """axis that points up in the world of cameras and lights; z: Blender's cameras beside a mesh with Y up, such as its
    glTF; environments stand upright in both"""
    align: bool = False
    """find the similarity that brings the mesh into the cameras' space"""
    refine_poses: bool = False
    """improve every camera against the mesh before fitting"""
    overlap: float = Field(default=LEAST_OVERLAP, ge=0, le=1)
    """overlap of the mesh's outline with alpha or mask (intersection over union) below which a warning reports that the
    picture's camera does not fit the mesh"""
    average: int = Field(default=0, ge=0, le=64)
    """pixels a side of the averaged blocks of each picture; 0: so that texels stay two blocks wide"""
    hold_out: int = Field(default=-1, ge=-1, le=1000)
    """pictures held out of the fit and used to measure it; -1: one in twelve, from 24 pictures on"""
    hold_out_light: int = Field(default=-1, ge=-1, le=1000)
    """hold out the pictures of this light (by order of appearance) and measure on them; -1: none"""


class PhotometrySettings(FrozenModel):
    """Solving for the pictures' exposure, white balance and vignetting."""

    mode: Literal["auto", "none", "exposure", "full"] = "auto"
    """solve for each picture's exposure, or (full) also its white balance, the vignetting of all and veiling light;
    auto: full for 8-bit pictures without given exposures, else none"""
    exif: bool = True
    """use EXIF's exposure time, f-number and ISO speed as a prior"""


class LightSettings(FrozenModel):
    """Solving for an unknown light."""

    sun: bool = False
    """look for a sun beside the environment (--light outdoors)"""
    albedo: tuple[float, float, float] | None = None
    """albedo (linear) of the surface that --albedo-of masks; it fixes the light's scale"""


class MaterialSettings(FrozenModel):
    """The settings of one fit of a material to pictures."""

    seed: int = Field(default=0, ge=0, lt=2**31)
    """every random choice follows from it"""
    memory: float = Field(default=0, ge=0, le=100_000)
    """GB of main memory that the job may take; a job that needs more is refused; 0: nine tenths of the machine's
    memory, with recover.memory for the pictures' samples"""
    threads: int = Field(default=0, ge=0, le=1024)
    """threads of the renderer; 0 takes all cores"""
    passes: int = Field(default=0, ge=0, le=10_000)
    """end the fit after so many of its passes; 0: all. The same number gives the same bytes"""
    minutes: float = Field(default=0, ge=0, le=100_000)
    """end the fit so that the job takes about so many minutes, after one pass at least; 0: no limit. run.json records
    the passes; a later run with more minutes continues"""
    variant: Literal["auto", "llvm_ad_rgb", "cuda_ad_rgb", "metal_ad_rgb"] = "auto"
    start: Literal["nothing", "own"] = "nothing"
    """start of the fit: nothing, or the mesh's own material"""
    read: ReadSettings = ReadSettings()
    references: ReferenceSettings = ReferenceSettings()
    photometry: PhotometrySettings = PhotometrySettings()
    light: LightSettings = LightSettings()
    atlas: AtlasSettings = AtlasSettings(size=1024)
    recover: RecoverSettings = RecoverSettings()
    report: ReportSettings = ReportSettings(frames=12, resolution=384)
    deliver: DeliverSettings = DeliverSettings()
    colour: ColourSettings = ColourSettings()


MATERIAL_PRESETS: dict[str, dict[str, Any]] = {
    "draft": {
        "atlas": {"size": 512},
        "recover": {
            "iterations": 96,
            "bounces": 2,
            "bounce_samples": 32,
            "solver_texels": 500_000,
            "soft_subsamples": 1,
            "soft_bounces": 1,
            "soft_measured": 32,
            "detail": True,
        },
    },
    "standard": {},
}
