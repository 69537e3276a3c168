"""Settings of `stylize`, `render` and `bake` (one record per stage), and the presets."""

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

from pydantic import Field

from mistyle.atlas.settings import AtlasSettings, BakeSettings
from mistyle.core.settings import FrozenModel, RigSettings
from mistyle.jobs import settings
from mistyle.jobs.deliver_settings import ColourSettings, DeliverSettings
from mistyle.jobs.job_settings import ReadSettings, ReportSettings
from mistyle.solver.shape.settings import DisplaceSettings
from mistyle.stylization.diffusion.settings import DiffusionSettings, ModelSettings, Paint3dSettings, TrainSettings
from mistyle.stylization.inpaint.settings import RepairSettings
from mistyle.stylization.mvst.settings import SweepSettings
from mistyle.stylization.optimise.finish_settings import FinishSettings
from mistyle.stylization.optimise.settings import FitSettings
from mistyle.stylization.surface.settings import PaintSettings, SurfaceSettings

READ_SAMPLES = 8  # per pixel of a view that a stylizer reads


class DrawSettings(FrozenModel):
    """How the views of the mesh are rendered (paper 4.1.1)."""

    spp: int = Field(default=0, ge=0, le=65536)
    """samples per pixel of the rendered views; 0: 8 where a stylizer reads their colours, else 1"""
    scene: Path | None = None
    """a Mitsuba scene with a shape called 'object' in place of scenes/paper_views.xml"""
    paper_files: bool = False
    """also write the 8-bit depth maps and Canny edges of the paper"""

    def samples(self, read: bool = True) -> int:
        """Samples per pixel; more if a stylizer reads the views' colours (`read`)."""
        return self.spp or (READ_SAMPLES if read else 1)


class Settings(FrozenModel):
    """Settings of one job."""

    seed: int = Field(default=0, ge=0, lt=2**31)
    """every random choice follows from it"""
    threads: int = Field(default=0, ge=0, le=1024)
    """threads of the renderer and of torch; 0 takes all cores"""
    memory: float = Field(default=0, ge=0, le=100_000)
    """GB of main memory that the job may use; 0: nine tenths of the available memory. Large arrays move to files in its
    work folder if needed, with the same result; a job that still exceeds it is refused"""
    variant: Literal["auto", "llvm_ad_rgb", "cuda_ad_rgb", "metal_ad_rgb"] = "auto"
    stylizer: Literal["embedded", "embedded-view", "diffusion"] = "embedded"
    """embedded paints the surface once; embedded-view paints view after view from earlier ones; diffusion does the same
    with SDXL (needs models)"""
    inpainter: Literal["fill", "paint3d"] = "fill"
    """fill reuses the painting; paint3d is Stable Diffusion (needs models)"""
    read: ReadSettings = ReadSettings()
    rig: RigSettings = RigSettings()
    draw: DrawSettings = DrawSettings()
    surface: SurfaceSettings = SurfaceSettings()
    paint: PaintSettings = PaintSettings()
    sweep: SweepSettings = SweepSettings()
    atlas: AtlasSettings = AtlasSettings()
    bake: BakeSettings = BakeSettings()
    finish: FinishSettings = FinishSettings()
    displace: DisplaceSettings = DisplaceSettings()
    fit: FitSettings = FitSettings()
    repair: RepairSettings = RepairSettings()
    report: ReportSettings = ReportSettings()
    deliver: DeliverSettings = DeliverSettings()
    colour: ColourSettings = ColourSettings()
    models: ModelSettings = ModelSettings()
    train: TrainSettings = TrainSettings()
    diffusion: DiffusionSettings = DiffusionSettings()
    paint3d: Paint3dSettings = Paint3dSettings()

    @property
    def refined(self) -> Literal["off", "normal-roughness", "albedo", "all"]:
        """Which maps the fit may change.

        `fit.refine_painted` decides for the embedded stylizer, unless another setting needs the full fit: its metallic,
        its own features, an inpainter.
        """
        if self.fit.refine != "auto":
            return self.fit.refine
        features = self.fit.features is not None and self.finish.method == "off"
        refine = self.fit.metallic == "fit" or features or self.inpainter != "fill"
        return "all" if refine or self.stylizer != "embedded" else self.fit.refine_painted

    @property
    def keeps_painting(self) -> bool:
        """Whether the baked maps are final: the fit is off, and the repair would reuse the painting."""
        return self.refined == "off" and self.stylizer == "embedded" and self.inpainter == "fill"


# Presets; the records' defaults are the standard ones.
PRESETS: dict[str, dict[str, Any]] = {
    "draft": {
        "rig": {"resolution": 512},
        "surface": {"samples": 80_000},
        "atlas": {"size": 1024},
        "finish": {"steps": 20, "crops": 2},
        "fit": {"refine_painted": "off", "iterations1": 40, "iterations2": 40, "crops": 2, "crop_size": 192},
        "report": {"frames": 12, "resolution": 320, "spp": 4},
    },
    "standard": {},
    "fine": {
        "draw": {"paper_files": True},
        "surface": {"samples": 1_000_000},
        "atlas": {"size": 4096},
        "fit": {"refine": "all", "iterations1": 400, "iterations2": 600, "crops": 8, "lights": "together"},
        "diffusion": {"content": "per-view"},
    },
    # The paper's values, also where mistyle/stylization/README.md lists departures. The paper gives no step counts;
    # these are from `fine`.
    "paper": {
        "stylizer": "diffusion",
        "inpainter": "paint3d",
        "draw": {"paper_files": True},
        "sweep": {
            "order": "paper",
            "histogram": 1.0,
            "segmenter": "birefnet",
            "follow_outline": False,
            "warp": {"look_up": False, "facing": 0.0, "sharpness": 0.0},
        },
        "atlas": {"size": 4096},
        "fit": {
            "refine": "all",
            "painted": "with-light",
            "unlight": 0.0,
            "solve": False,
            "lights": "together",
            "features": "vgg19",
            "bridge": "wrap",
            "iterations1": 400,
            "iterations2": 600,
            "crops": 8,
            "tv_from": "style",
            "judge": False,
        },
        "repair": {"agreement": 1.0, "outlier": 0.0},
        "train": {"loss_mode": "sum"},
        "diffusion": {"content": "per-view"},
    },
}
# The demo should take three minutes: the draft with finer strokes and a larger texture.
PRESETS["demo"] = PRESETS["draft"] | {"surface": {"samples": 150_000}, "atlas": {"size": 2048}}


def resolve(
    preset: str | None,
    config: Path | None,
    command_line: Mapping[str, Any],
    environment: Mapping[str, str] = os.environ,
) -> Settings:
    """The settings of a job after all layers; see `resolve` of jobs/settings.py."""
    return settings.resolve(preset, config, command_line, environment, root=Settings, presets=PRESETS)
