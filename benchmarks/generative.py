"""What the generative stages cost: `python -m benchmarks.generative [--quick] [--json FILE]`

The networks have their full size and random weights, made from their configurations: nothing is downloaded and the
pictures are noise, but time and memory are the real ones. On a GPU, in bfloat16: one training step of ConsisLoRA, one
denoising step of SDXL with two ControlNets and guidance, both at 1024², and one 1024² crop of the texture inpainter of
two steps. Figures: seconds of a second call each, and the peak memory of the device in GB. --quick, or no GPU: the same
calls on tiny networks on the CPU, only to see that they work.
"""

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import torch

from benchmarks.common import arguments, finish, timed

FULL: dict[str, Any] = {
    "xl": {
        "block_out_channels": (320, 640, 1280),
        "down_block_types": ("DownBlock2D", "CrossAttnDownBlock2D", "CrossAttnDownBlock2D"),
        "transformer_layers_per_block": (1, 2, 10),
        "attention_head_dim": (5, 10, 20),
        "cross_attention_dim": 2048,
        "use_linear_projection": True,
        "addition_embed_type": "text_time",
        "addition_time_embed_dim": 256,
        "projection_class_embeddings_input_dim": 2816,
    },
    "xl_up": ("CrossAttnUpBlock2D", "CrossAttnUpBlock2D", "UpBlock2D"),
    "15": {
        "block_out_channels": (320, 640, 1280, 1280),
        "down_block_types": ("CrossAttnDownBlock2D",) * 3 + ("DownBlock2D",),
        "attention_head_dim": 8,
        "cross_attention_dim": 768,
    },
    "15_up": ("UpBlock2D",) + ("CrossAttnUpBlock2D",) * 3,
    "stem": (16, 32, 96, 256),
    "vae": (128, 256, 512, 512),
    "pooled": 1280,
    "side": 1024,
    "rank": 64,
}
TINY: dict[str, Any] = {
    "xl": {
        "block_out_channels": (32, 64),
        "down_block_types": ("DownBlock2D", "CrossAttnDownBlock2D"),
        "transformer_layers_per_block": (1, 2),
        "attention_head_dim": (2, 4),
        "cross_attention_dim": 64,
        "use_linear_projection": True,
        "addition_embed_type": "text_time",
        "addition_time_embed_dim": 8,
        "projection_class_embeddings_input_dim": 80,
    },
    "xl_up": ("CrossAttnUpBlock2D", "UpBlock2D"),
    "15": {
        "block_out_channels": (32, 64),
        "down_block_types": ("DownBlock2D", "CrossAttnDownBlock2D"),
        "attention_head_dim": 4,
        "cross_attention_dim": 32,
    },
    "15_up": ("CrossAttnUpBlock2D", "UpBlock2D"),
    "stem": (16, 32),
    "vae": (32, 64),
    "pooled": 32,
    "side": 64,
    "rank": 4,
}


def unet(shape: dict[str, Any], kind: str, channels: int, device: str, dtype: torch.dtype) -> Any:
    from diffusers.models.unets.unet_2d_condition import UNet2DConditionModel

    with torch.device(device):
        made = UNet2DConditionModel(
            **shape[kind], up_block_types=shape[f"{kind}_up"], in_channels=channels, out_channels=4
        )
    return made.to(dtype).requires_grad_(False).eval()


def controlnet(shape: dict[str, Any], kind: str, device: str, dtype: torch.dtype) -> Any:
    from diffusers.models.controlnets.controlnet import ControlNetModel

    with torch.device(device):
        made = ControlNetModel(**shape[kind], conditioning_embedding_out_channels=shape["stem"])
    return made.to(dtype).requires_grad_(False).eval()


def sdxl(shape: dict[str, Any], device: str, dtype: torch.dtype) -> Any:
    """What training and denoising use of a pipeline."""
    from diffusers.models.controlnets.multicontrolnet import MultiControlNetModel
    from diffusers.schedulers.scheduling_euler_discrete import EulerDiscreteScheduler

    scheduler = EulerDiscreteScheduler(
        beta_start=0.00085, beta_end=0.012, beta_schedule="scaled_linear", timestep_spacing="trailing"
    )
    nets = MultiControlNetModel([controlnet(shape, "xl", device, dtype) for _ in range(2)])
    return SimpleNamespace(unet=unet(shape, "xl", 4, device, dtype), controlnet=nets, scheduler=scheduler)


def train_step(pipeline: Any, shape: dict[str, Any], device: str, dtype: torch.dtype) -> Callable[[], object]:
    """One step of a content picture, optimiser included."""
    from mistyle.backends import consislora
    from mistyle.backends.consislora_train import Lesson, joint_phase, run_phase
    from mistyle.backends.diffusion_settings import TrainSettings

    settings = TrainSettings(rank=shape["rank"], steps=1)
    for half in consislora.BLOCKS:
        if half not in getattr(pipeline.unet, "peft_config", {}):
            consislora.add_half(pipeline.unet, half, shape["rank"], 0)
    side, width = shape["side"], shape["xl"]["cross_attention_dim"]
    latent = side // 2 ** (len(shape["vae"]) - 1)
    shown = Lesson(
        torch.randn(1, 4, latent, latent, device=device),
        torch.randn(1, 77, width, device=device, dtype=dtype),
        torch.randn(1, shape["pooled"], device=device, dtype=dtype),
        torch.tensor([[side, side, 0, 0, side, side]], device=device, dtype=torch.float32),
    )
    return lambda: run_phase(pipeline, shown, joint_phase("[c]", settings), settings, 0)


def denoise_step(pipeline: Any, shape: dict[str, Any], device: str, dtype: torch.dtype) -> Callable[[], object]:
    """One noise level: two ControlNets and the UNet with its LoRAs, for the empty and the real prompt."""
    from mistyle.backends.diffusion_denoise import Asked, denoiser

    side, width = shape["side"], shape["xl"]["cross_attention_dim"]
    latent = side // 2 ** (len(shape["vae"]) - 1)
    asked = Asked(
        torch.randn(2, 77, width, device=device, dtype=dtype),
        torch.randn(2, shape["pooled"], device=device, dtype=dtype),
        torch.tensor([[side, side, 0, 0, side, side]] * 2, device=device, dtype=dtype),
        [torch.rand(2, 3, side, side, device=device, dtype=dtype) for _ in range(2)],
        (0.8, 0.4),
        (),
        {"content": 1.0, "style": 1.0},
        7.5,
    )
    denoise = denoiser(pipeline, asked)
    return lambda: denoise(torch.randn(1, 4, latent, latent, device=device), 5.0)


def crop_step(shape: dict[str, Any], device: str, dtype: torch.dtype) -> Callable[[], object]:
    """One crop of the texture, two sampling steps, without the IP-Adapter's few numbers."""
    import numpy as np
    from diffusers.models.autoencoders.autoencoder_kl import AutoencoderKL
    from diffusers.pipelines.controlnet.pipeline_controlnet_inpaint import StableDiffusionControlNetInpaintPipeline
    from diffusers.schedulers.scheduling_ddim import DDIMScheduler

    from mistyle.backends.diffusion_settings import Paint3dSettings
    from mistyle.backends.paint3d import RECIPES, Brush, inpaint

    channels = shape["vae"]
    with torch.device(device):
        vae = AutoencoderKL(
            block_out_channels=channels,
            down_block_types=("DownEncoderBlock2D",) * len(channels),
            up_block_types=("UpDecoderBlock2D",) * len(channels),
            layers_per_block=2 if len(channels) > 2 else 1,
            latent_channels=4,
        )
    parts: dict[str, Any] = dict.fromkeys(("text_encoder", "tokenizer", "safety_checker", "feature_extractor"))
    parts |= {"vae": vae.requires_grad_(False), "unet": unet(shape, "15", 9, device, dtype)}
    parts |= {"controlnet": controlnet(shape, "15", device, dtype)}
    parts["scheduler"] = DDIMScheduler(beta_start=0.00085, beta_end=0.012, beta_schedule="scaled_linear")
    pipeline = StableDiffusionControlNetInpaintPipeline(**parts, requires_safety_checker=False).to(device)
    pipeline.set_progress_bar_config(disable=True)
    text = torch.randn(1, 77, shape["15"]["cross_attention_dim"], device=device, dtype=dtype)
    brush = Brush(pipeline, [], text, text * 0, RECIPES["inpaint"], Paint3dSettings(size=shape["side"], steps=2))
    rng = np.random.default_rng(0)
    picture = rng.random((shape["side"], shape["side"], 3)).astype(np.float32)
    mask = np.zeros(picture.shape[:2], bool)
    mask[: shape["side"] // 2] = True
    return lambda: inpaint(brush, picture, mask, picture, 1.0, rng)


def measured(figures: dict[str, float], name: str, device: str, work: Callable[[], object]) -> None:
    """The second call's seconds (the first one warms up), and the peak of the device's memory."""

    def whole() -> None:
        work()
        if device == "cuda":
            torch.cuda.synchronize()

    whole()
    if device == "cuda":
        torch.cuda.reset_peak_memory_stats()
    timed(figures, name, whole)
    if device == "cuda":
        figures[f"{name}.peak_gb"] = torch.cuda.max_memory_allocated() / 1e9


def main() -> None:
    chosen = arguments(__doc__ or "")
    device = "cpu" if chosen.quick or not torch.cuda.is_available() else "cuda"
    shape, dtype = (TINY, torch.float32) if device == "cpu" else (FULL, torch.bfloat16)
    figures: dict[str, float] = {"full_size": float(shape is FULL)}
    pipeline = sdxl(shape, device, dtype)
    measured(figures, "train_step", device, train_step(pipeline, shape, device, dtype))
    measured(figures, "denoise_step", device, denoise_step(pipeline, shape, device, dtype))
    del pipeline
    measured(figures, "crop_two_steps", device, crop_step(shape, device, dtype))
    finish(figures, chosen.json)


if __name__ == "__main__":
    main()
