"""Settings of the generative stages: models, LoRA training, view stylizer and texture inpainter."""

from pathlib import Path
from typing import Literal

from pydantic import Field

from mistyle.core.settings import FrozenModel


class ModelSettings(FrozenModel):
    """Model files, device, precision and memory."""

    folder: Path | None = Field(
        default=None, description="folder of models as `mistyle models` writes it; else the Hugging Face cache"
    )
    checkpoint: Path | None = Field(
        default=None, description="SDXL or a finetune of it as one .safetensors file, in place of the folder's weights"
    )
    style_lora: Path | None = Field(default=None, description="a style LoRA trained elsewhere (.safetensors)")
    loras: Path | None = Field(default=None, description="where trained LoRAs are kept; else in the run folder")
    device: Literal["auto", "cpu", "cuda", "mps"] = Field(
        default="auto", description="auto: a GPU where torch sees one"
    )
    precision: Literal["auto", "float32", "bfloat16", "float16"] = Field(
        default="auto",
        description="of frozen networks; auto: bfloat16 on a GPU that supports it, float16 on others, float32 on a "
        "CPU. VAEs stay float32",
    )
    prediction: Literal["auto", "epsilon", "v_prediction"] = Field(
        default="auto", description="prediction type of an SDXL checkpoint; auto: read from its scheduler or file"
    )
    offload: bool = Field(
        default=False,
        description="keep only the running network on the GPU: slower, the same pictures",
    )
    memory: float = Field(default=0, ge=0, description="GB that may be used; 0: the device's free memory")


class TrainSettings(FrozenModel):
    """ConsisLoRA training (paper 4.1.2); the numbers are those of ConsisLoRA's own scripts."""

    rank: int = Field(default=64, ge=1, le=1024, description="rank of the LoRAs; alpha equals it, so the scale is 1")
    steps: int = Field(default=1500, ge=1, le=100_000, description="steps of a content image and of style stage 1")
    style_steps: int = Field(default=1000, ge=1, le=100_000, description="steps of style stage 2")
    switch: int = Field(default=500, ge=0, description="step from which the x0 loss counts")
    loss_mode: Literal["switch", "sum"] = Field(
        default="switch", description="from `switch` on: the x0 loss in place of the epsilon loss, or added to it"
    )
    rate: float = Field(default=2e-4, gt=0, description="learning rate before `switch`")
    later_rate: float = Field(default=1e-4, gt=0, description="learning rate from `switch` on, and of style stage 2")
    noise_offset: float = Field(default=0.03, ge=0, description="noise shared by a channel's pixels, style stage 2")
    weight_decay: float = Field(default=1e-4, ge=0, description="of AdamW")
    clip: float = Field(
        default=0,
        ge=0,
        description="largest norm of a step's gradient; 0: unlimited, as in ConsisLoRA's script, whose clipping gets "
        "an exhausted iterator and has no effect",
    )
    resolution: int = Field(default=1024, ge=16, le=4096, description="pixels of the picture's short side")
    save_every: int = Field(default=100, ge=1, description="steps between checkpoints")


class DiffusionSettings(FrozenModel):
    """The paper's stylizer (4.1.2, 4.1.3): SDXL with depth and Canny ControlNets, two LoRAs and RePaint."""

    content: Literal["auto", "none", "shared", "per-view"] = Field(
        default="auto",
        description="content LoRAs: none, shared (one, of the first view), per-view (the paper); auto: shared beside a "
        "style LoRA, none beside an IP-Adapter",
    )
    adapter: Literal["lora", "ip"] = Field(
        default="lora", description="style adapter: a trained LoRA, or an IP-Adapter on the style block"
    )
    subject: str = Field(default="[c]", description="the prompt's word for the content")
    look: str = Field(default="[v]", description="the prompt's word for the style")
    steps: int = Field(default=30, ge=1, le=1000, description="noise levels of the sampler (N)")
    guidance: float = Field(default=7.5, ge=1, description="classifier-free guidance")
    depth: float = Field(default=0.8, ge=0, le=2, description="scale of the depth ControlNet")
    canny: float = Field(default=0.4, ge=0, le=2, description="scale of the Canny ControlNet")
    block: int = Field(default=10, ge=1, description="steps of a RePaint block (L)")
    repeats: int = Field(default=10, ge=1, description="passes over a block (r)")
    refinement: float = Field(default=0.1, ge=0, le=1, description="strength of the refinement after the main pass")
    content_guidance: float = Field(default=0, ge=0, description="ConsisLoRA's content guidance; 0 is off")
    style_guidance: float = Field(default=0, ge=0, description="ConsisLoRA's style guidance; 0 is off")
    adapter_scale: float = Field(default=1.0, ge=0, le=2, description="scale of the IP-Adapter on the style block")


LIGHTING = "shadow, shade, shading, highlight, specular reflection, strong light, backlight, dimness, text"


class Paint3dSettings(FrozenModel):
    """The paper's texture inpainting (4.3): SD 1.5 with the UV-position ControlNet and an IP-Adapter."""

    recipe: Literal["inpaint", "paint3d"] = Field(
        default="inpaint",
        description="the paper's inpainting UNet, or Paint3D's SD 1.5 with an inpaint ControlNet",
    )
    prompt: str = Field(
        default="UV map, texture of an object, even flat lighting, high quality", description="text prompt"
    )
    negative: str = Field(
        default=LIGHTING, description="negative prompt: excludes light and shadow, which the renderer adds"
    )
    size: int = Field(default=1024, ge=16, le=2048, description="pixels along a side of the model's input")
    overlap: int = Field(default=128, ge=0, description="pixels that crops share, and context around holes")
    detail: float = Field(
        default=0.5, ge=0, le=1, description="strength of the pass over crops; 0 leaves it out (low frequencies only)"
    )
    steps: int = Field(default=0, ge=0, le=1000, description="sampling steps; 0 takes the recipe's (30, Paint3D 20)")
    guidance: float = Field(default=0, ge=0, description="classifier-free; 0 takes the recipe's (4, Paint3D 3)")
    precision: Literal["same", "float32", "bfloat16", "float16"] = Field(
        default="same", description="of its frozen networks; same: models.precision"
    )
    position: float = Field(default=1.0, ge=0, le=2, description="scale of the UV-position ControlNet")
    style: float = Field(default=-1, ge=-1, le=2, description="IP-Adapter; -1 takes the recipe's (0.6, Paint3D 1)")
    shape_scale: float = Field(default=0.6, gt=0, le=1, description="radius of the mesh in the position map")
    shape_height: float = Field(default=0.25, ge=-1, le=1, description="how far the position map raises the mesh")
