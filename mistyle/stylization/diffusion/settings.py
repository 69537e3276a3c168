"""Settings of the generative stages: models, LoRA training, view stylizer and texture inpainter."""

from pathlib import Path
from typing import Literal

from pydantic import Field

from mistyle.core.settings import FrozenModel


class ModelSettings(FrozenModel):
    """Model files, device, precision and memory."""

    folder: Path | None = None
    """folder of models as `mistyle models` writes it; else the Hugging Face cache"""
    checkpoint: Path | None = None
    """SDXL or a finetune of it as one .safetensors file, in place of the folder's weights"""
    style_lora: Path | None = None
    """a style LoRA trained elsewhere (.safetensors)"""
    loras: Path | None = None
    """where trained LoRAs are kept; else in the run folder"""
    device: Literal["auto", "cpu", "cuda", "mps"] = "auto"
    """auto: a GPU where torch sees one"""
    precision: Literal["auto", "float32", "bfloat16", "float16"] = "auto"
    """of frozen networks; auto: bfloat16 on a GPU that supports it, float16 on others, float32 on a CPU. VAEs stay
    float32"""
    prediction: Literal["auto", "epsilon", "v_prediction"] = "auto"
    """prediction type of an SDXL checkpoint; auto: read from its scheduler or file"""
    offload: bool = False
    """keep only the running network on the GPU: slower, the same pictures"""
    memory: float = Field(default=0, ge=0)
    """GB that may be used; 0: the device's free memory"""


class TrainSettings(FrozenModel):
    """ConsisLoRA training (paper 4.1.2); the numbers are those of ConsisLoRA's own scripts."""

    rank: int = Field(default=64, ge=1, le=1024)
    """rank of the LoRAs; alpha equals it, so the scale is 1"""
    steps: int = Field(default=1500, ge=1, le=100_000)
    """steps of a content image and of style stage 1"""
    style_steps: int = Field(default=1000, ge=1, le=100_000)
    """steps of style stage 2"""
    switch: int = Field(default=500, ge=0)
    """step from which the x0 loss counts"""
    loss_mode: Literal["switch", "sum"] = "switch"
    """from `switch` on: the x0 loss in place of the epsilon loss, or added to it"""
    rate: float = Field(default=2e-4, gt=0)
    """learning rate before `switch`"""
    later_rate: float = Field(default=1e-4, gt=0)
    """learning rate from `switch` on, and of style stage 2"""
    noise_offset: float = Field(default=0.03, ge=0)
    """noise shared by a channel's pixels, style stage 2"""
    weight_decay: float = Field(default=1e-4, ge=0)
    """of AdamW"""
    clip: float = Field(default=0, ge=0)
    """largest norm of a step's gradient; 0: unlimited, as in ConsisLoRA's script, whose clipping gets an exhausted
    iterator and has no effect"""
    resolution: int = Field(default=1024, ge=16, le=4096)
    """pixels of the picture's short side"""
    save_every: int = Field(default=100, ge=1)
    """steps between checkpoints"""


class DiffusionSettings(FrozenModel):
    """The paper's stylizer (4.1.2, 4.1.3): SDXL with depth and Canny ControlNets, two LoRAs and RePaint."""

    content: Literal["auto", "none", "shared", "per-view"] = "auto"
    """content LoRAs: none, shared (one, of the first view), per-view (the paper); auto: shared beside a style LoRA,
    none beside an IP-Adapter"""
    adapter: Literal["lora", "ip"] = "lora"
    """style adapter: a trained LoRA, or an IP-Adapter on the style block"""
    subject: str = "[c]"
    """the prompt's word for the content"""
    look: str = "[v]"
    """the prompt's word for the style"""
    steps: int = Field(default=30, ge=1, le=1000)
    """noise levels of the sampler (N)"""
    guidance: float = Field(default=7.5, ge=1)
    """classifier-free guidance"""
    depth: float = Field(default=0.8, ge=0, le=2)
    """scale of the depth ControlNet"""
    canny: float = Field(default=0.4, ge=0, le=2)
    """scale of the Canny ControlNet"""
    block: int = Field(default=10, ge=1)
    """steps of a RePaint block (L)"""
    repeats: int = Field(default=10, ge=1)
    """passes over a block (r)"""
    refinement: float = Field(default=0.1, ge=0, le=1)
    """strength of the refinement after the main pass"""
    content_guidance: float = Field(default=0, ge=0)
    """ConsisLoRA's content guidance; 0 is off"""
    style_guidance: float = Field(default=0, ge=0)
    """ConsisLoRA's style guidance; 0 is off"""
    adapter_scale: float = Field(default=1.0, ge=0, le=2)
    """scale of the IP-Adapter on the style block"""


LIGHTING = "shadow, shade, shading, highlight, specular reflection, strong light, backlight, dimness, text"


class Paint3dSettings(FrozenModel):
    """The paper's texture inpainting (4.3): SD 1.5 with the UV-position ControlNet and an IP-Adapter."""

    recipe: Literal["inpaint", "paint3d"] = "inpaint"
    """the paper's inpainting UNet, or Paint3D's SD 1.5 with an inpaint ControlNet"""
    prompt: str = "UV map, texture of an object, even flat lighting, high quality"
    """text prompt"""
    negative: str = LIGHTING
    """negative prompt: excludes light and shadow, which the renderer adds"""
    size: int = Field(default=1024, ge=16, le=2048)
    """pixels along a side of the model's input"""
    overlap: int = Field(default=128, ge=0)
    """pixels that crops share, and context around holes"""
    detail: float = Field(default=0.5, ge=0, le=1)
    """strength of the pass over crops; 0 leaves it out (low frequencies only)"""
    steps: int = Field(default=0, ge=0, le=1000)
    """sampling steps; 0 takes the recipe's (30, Paint3D 20)"""
    guidance: float = Field(default=0, ge=0)
    """classifier-free; 0 takes the recipe's (4, Paint3D 3)"""
    precision: Literal["same", "float32", "bfloat16", "float16"] = "same"
    """of its frozen networks; same: models.precision"""
    position: float = Field(default=1.0, ge=0, le=2)
    """scale of the UV-position ControlNet"""
    style: float = Field(default=-1, ge=-1, le=2)
    """IP-Adapter; -1 takes the recipe's (0.6, Paint3D 1)"""
    shape_scale: float = Field(default=0.6, gt=0, le=1)
    """radius of the mesh in the position map"""
    shape_height: float = Field(default=0.25, ge=-1, le=1)
    """how far the position map raises the mesh"""
