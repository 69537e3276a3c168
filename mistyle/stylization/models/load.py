"""Loading of networks from safetensors files; no code of a model's author is run."""

import warnings
from collections.abc import Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from mistyle.core.errors import EnvironmentMissing
from mistyle.core.image import resize
from mistyle.stylization.diffusion.settings import ModelSettings
from mistyle.stylization.models import check as models_check
from mistyle.stylization.models import folder as models
from mistyle.stylization.models.catalogue import ENCODER

CLIP_MEAN, CLIP_STD = (0.48145466, 0.4578275, 0.40821073), (0.26862954, 0.26130258, 0.27577711)


def device_of(settings: ModelSettings) -> str:
    """The device that the networks run on."""
    available = {"cpu": True, "cuda": torch.cuda.is_available(), "mps": torch.backends.mps.is_available()}
    if settings.device == "auto":
        return next(name for name in ("cuda", "mps", "cpu") if available[name])
    if not available[settings.device]:
        raise EnvironmentMissing(f"models.device={settings.device}: torch finds no such device; use cpu or auto")
    return settings.device


def precision_of(settings: ModelSettings, device: str) -> torch.dtype:
    """The frozen networks' dtype; auto: float32 on a CPU, bfloat16 on a device that supports it, else float16."""
    chosen = settings.precision
    if chosen == "auto":
        chosen = "float32" if device == "cpu" else "bfloat16" if computes_bfloat16(device) else "float16"
    elif chosen == "bfloat16" and not computes_bfloat16(device):
        raise EnvironmentMissing(
            "models.precision=bfloat16: this device does not support it; use auto, float16 or float32"
        )
    return getattr(torch, chosen)


def computes_bfloat16(device: str) -> bool:
    """Whether a device supports bfloat16 natively: CPUs do, CUDA cards from Ampere on, MPS is assumed not to."""
    if device == "cuda":
        return torch.cuda.is_bf16_supported(including_emulation=False)
    return device != "mps"


@contextmanager
def quiet():
    """Silence the progress bars and warnings of diffusers and transformers."""
    from diffusers.utils import logging as of_diffusers
    from transformers.utils import logging as of_transformers

    for library in (of_diffusers, of_transformers):
        library.set_verbosity_error()
        library.disable_progress_bar()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


def network(kind: Any, folder: Path, dtype: torch.dtype) -> Any:
    """A frozen network of a diffusers or transformers class."""
    from diffusers.models.modeling_utils import ModelMixin

    key = "torch_dtype" if issubclass(kind, ModelMixin) else "dtype"
    with quiet():
        loaded = kind.from_pretrained(
            folder, use_safetensors=True, local_files_only=True, variant=models.variant(folder), **{key: dtype}
        )
    return loaded.requires_grad_(False).eval()


def base_parts(
    place: Path, kind: str, dtype: torch.dtype, checkpoint: Path | None = None, prediction: str = "auto"
) -> dict[str, Any]:
    """The parts of a base model ('sdxl' or 'sd15'), as diffusers' pipelines take them; the VAE is float32 (vae.py)."""
    from diffusers.models.unets.unet_2d_condition import UNet2DConditionModel
    from transformers import CLIPTextModel, CLIPTextModelWithProjection, CLIPTokenizer

    from mistyle.stylization.models.vae import ExactVae

    if checkpoint is not None:
        return _from_checkpoint(place, dtype, checkpoint) | {"scheduler": schedule(place, checkpoint, prediction)}
    parts = {
        "tokenizer": CLIPTokenizer.from_pretrained(place / "tokenizer", local_files_only=True),
        "text_encoder": network(CLIPTextModel, place / "text_encoder", dtype),
        "unet": network(UNet2DConditionModel, place / "unet", dtype),
        "vae": network(ExactVae, place / "vae", torch.float32),
    }
    if kind == "sdxl":
        parts["tokenizer_2"] = CLIPTokenizer.from_pretrained(place / "tokenizer_2", local_files_only=True)
        parts["text_encoder_2"] = network(CLIPTextModelWithProjection, place / "text_encoder_2", dtype)
        parts["scheduler"] = schedule(place, None, prediction)
    return parts


def schedule(place: Path, checkpoint: Path | None, prediction: str) -> Any:
    """SDXL's Euler scheduler with trailing spacing (ConsisLoRA's choice) and the network's prediction type.

    The paper's equations (1)-(3) need its unscaled levels. The prediction type is the setting, else that of a single
    file's marker tensors, else the configuration's.
    """
    from diffusers.schedulers.scheduling_euler_discrete import EulerDiscreteScheduler

    more: dict[str, Any] = {} if checkpoint is None else models_check.marks(checkpoint)
    if prediction != "auto":
        more["prediction_type"] = prediction
    return EulerDiscreteScheduler.from_pretrained(place / "scheduler", timestep_spacing="trailing", **more)


def _from_checkpoint(place: Path, dtype: torch.dtype, checkpoint: Path) -> dict[str, Any]:
    from diffusers.pipelines.stable_diffusion_xl.pipeline_stable_diffusion_xl import StableDiffusionXLPipeline

    from mistyle.stylization.models.vae import ExactVae

    with quiet():
        pipeline = StableDiffusionXLPipeline.from_single_file(
            str(checkpoint), config=str(place), local_files_only=True, torch_dtype=dtype, add_watermarker=False
        )
        vae = ExactVae.from_single_file(
            str(checkpoint), config=str(place), subfolder="vae", local_files_only=True, torch_dtype=torch.float32
        )
    names = ("tokenizer", "tokenizer_2", "text_encoder", "text_encoder_2", "unet")
    parts = {name: getattr(pipeline, name) for name in names}
    parts["vae"] = vae
    for name in ("text_encoder", "text_encoder_2", "unet", "vae"):
        parts[name].requires_grad_(False).eval()
    return parts


def controlnets(places: list[Path], dtype: torch.dtype) -> list[Any]:
    """ControlNets in the order of their scales."""
    from diffusers.models.controlnets.controlnet import ControlNetModel

    return [network(ControlNetModel, place, dtype) for place in places]


def settle(pipeline: Any, settings: ModelSettings, device: str) -> Any:
    """Move a pipeline to its device, whole or network by network (offloading); both give the same numbers."""
    pipeline.set_progress_bar_config(disable=True)
    if settings.offload and device not in ("cpu", "mps"):
        pipeline.enable_model_cpu_offload(device=device)
        return pipeline
    return pipeline.to(device)


def image_embedding(encoder: Any, rgb: Float[np.ndarray, "h w 3"]) -> torch.Tensor:
    """The pooled CLIP embedding (1, d) of an sRGB picture, stretched to a square: a crop would lose borders."""
    size = encoder.config.image_size
    picture = resize(np.clip(rgb, 0, 1).astype(np.float32), (size, size))
    tensor = torch.from_numpy(((picture - CLIP_MEAN) / CLIP_STD).astype(np.float32)).permute(2, 0, 1)[None]
    with torch.no_grad():
        return encoder(tensor.to(encoder.device, encoder.dtype)).image_embeds


def add_ip_adapter(
    pipeline: Any,
    place: Path,
    name: str,
    rgb: Float[np.ndarray, "h w 3"],
    scale: float | Mapping[str, Any],
    device: str,
) -> list[torch.Tensor]:
    """Load an IP-Adapter into a pipeline; returns the image embeddings [(2, 1, d)]: zeros first, the picture second.

    The image encoder, 2.5 GB in full size, is freed.
    """
    from transformers import CLIPVisionModelWithProjection

    dtype = pipeline.unet.dtype
    encoder = network(CLIPVisionModelWithProjection, place / ENCODER, dtype).to(device)
    embedding = image_embedding(encoder, rgb)
    del encoder
    folder, _, file = name.rpartition("/")
    with quiet():
        pipeline.load_ip_adapter(
            str(place), subfolder=folder, weight_name=file, image_encoder_folder=None, local_files_only=True
        )
    pipeline.set_ip_adapter_scale(scale if isinstance(scale, (int, float)) else [dict(scale)])
    return [torch.stack([torch.zeros_like(embedding), embedding])]
