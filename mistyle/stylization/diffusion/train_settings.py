"""The settings of `mistyle train`."""

from typing import Any

from pydantic import Field

from mistyle.core.settings import FrozenModel
from mistyle.stylization.diffusion.settings import ModelSettings, TrainSettings


class TrainJobSettings(FrozenModel):
    """LoRAs from pictures."""

    seed: int = Field(default=0, ge=0, lt=2**31)
    """every random choice follows from it"""
    threads: int = Field(default=0, ge=0, le=1024)
    """threads of torch; 0 takes all cores"""
    word: str = ""
    """the prompt's word for the picture; empty: [c] or [v]"""
    models: ModelSettings = ModelSettings()
    train: TrainSettings = TrainSettings()


TRAIN_PRESETS: dict[str, dict[str, Any]] = {
    "draft": {"train": {"steps": 500, "switch": 200, "style_steps": 400}},
    "standard": {},
}
