"""Checks of model architectures and memory needs, from configurations and headers alone; without torch."""

import gc
import math
import os
import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from mistyle.core.errors import EnvironmentMissing, InputRefused
from mistyle.stylization.models import folder as models

# Activation memory per megapixel of picture, GB at 2 bytes a number; an estimate, not measured here.
WORKING = {"sdxl": 4.0, "sd15": 3.0}
PREDICTIONS = ("epsilon", "v_prediction")
# Tensor names that mark a single-file finetune: it predicts velocities; its terminal SNR is zero.
MARKS = {"v_pred": ("prediction_type", "v_prediction"), "ztsnr": ("rescale_betas_zero_snr", True)}
STYLE_BLOCK = "up_blocks.0.attentions.1"


def expect(path: Path, label: str, fix: str, **expected: Any) -> dict[str, Any]:
    """The configuration at `path`; EnvironmentMissing where a value differs from `expected`."""
    config = models.read_json(path)
    for key, value in expected.items():
        found = config.get(key)
        if found != value:
            raise EnvironmentMissing(f"{path}: {key} is {found!r}, expected {value!r}: this is not {label}; {fix}")
    return config


def base(place: Path, kind: str, channels: int) -> dict[str, Any]:
    """The UNet's configuration of a base model of kind 'sdxl' or 'sd15' with `channels` input channels, checked."""
    label = {
        ("sdxl", 4): "an SDXL base model",
        ("sd15", 9): "an inpainting model of Stable Diffusion 1.5",
        ("sd15", 4): "a Stable Diffusion 1.5 base model",
    }[kind, channels]
    fix = f"replace it with {label} (see mistyle models)"
    expect(place / "vae" / "config.json", label, fix, _class_name="AutoencoderKL", latent_channels=4)
    expected: dict[str, Any] = {"_class_name": "UNet2DConditionModel", "in_channels": channels, "out_channels": 4}
    expected["addition_embed_type"] = "text_time" if kind == "sdxl" else None
    config = expect(place / "unet" / "config.json", label, fix, **expected)
    text = models.read_json(place / "text_encoder" / "config.json")["hidden_size"]
    schedule = place / "scheduler" / "scheduler_config.json"
    prediction = models.read_json(schedule).get("prediction_type", "epsilon")
    if prediction not in PREDICTIONS:
        raise EnvironmentMissing(
            f"{schedule}: prediction_type is {prediction!r}, expected {' or '.join(PREDICTIONS)}; {fix}"
        )
    if kind == "sdxl":
        text += models.read_json(place / "text_encoder_2" / "config.json")["hidden_size"]
    if config["cross_attention_dim"] != text:
        raise EnvironmentMissing(
            f"{place}: the UNet expects text embeddings of {config['cross_attention_dim']} channels, the text encoders "
            f"give {text}; the folders come from different models"
        )
    return config


def controlnet(place: Path, unet: Mapping[str, Any], base_name: str) -> None:
    """EnvironmentMissing unless a ControlNet has the base model's architecture."""
    label = f"a ControlNet for {base_name}"
    fix = "replace it with one trained for that base model (unions of several conditions are not supported)"
    expected = {k: unet.get(k) for k in ("cross_attention_dim", "block_out_channels", "addition_embed_type")}
    expect(place / "config.json", label, fix, _class_name="ControlNetModel", **expected)


def ip_adapter(path: Path, encoder: Path, unet: Mapping[str, Any], base_name: str) -> None:
    """EnvironmentMissing unless a file is a plain IP-Adapter (four tokens of the pooled embedding) for this base model
    and image encoder."""
    shapes = models.shapes([path])
    shape = shapes.get("image_proj.proj.weight")
    gives = models.read_json(encoder / "config.json").get("projection_dim")
    expected = [4 * unet["cross_attention_dim"], gives]
    if shape != expected:
        raise EnvironmentMissing(
            f"{path}: image_proj.proj.weight is {shape}, expected {expected}: this is not a plain IP-Adapter for "
            f"{base_name} with the image encoder in {encoder}; fetch the model 'ip-adapter' again"
        )


def lora(path: Path, unet: Mapping[str, Any]) -> None:
    """EnvironmentMissing unless a LoRA has weights for the style block of this SDXL model."""
    if not path.is_file():
        raise InputRefused(f"{path}: found nothing, expected a LoRA (.safetensors); check the path")
    shapes = models.shapes([path])
    block = [STYLE_BLOCK, STYLE_BLOCK.replace(".", "_"), "output_blocks_1_1", "output_blocks.1.1"]
    reach = {name: shape for name, shape in shapes.items() if any(b in name for b in block)}
    downs = [s for n, s in reach.items() if "to_q" in n and any(d in n for d in ("down", "lora_A"))]
    if not downs:
        raise EnvironmentMissing(
            f"{path}: no LoRA weights for {STYLE_BLOCK}, the block that carries style in SDXL; expected an SDXL LoRA "
            "in the layout of diffusers or kohya"
        )
    width = unet["block_out_channels"][-1]
    if any(shape[1] != width for shape in downs):
        raise EnvironmentMissing(
            f"{path}: its weights take {downs[0][1]} channels, expected {width}; it was trained for another base model"
        )


def checkpoint(path: Path, place: Path) -> None:
    """Refuse a single file unless it is SDXL in its original layout, not an inpainting or a refiner model.

    Its configurations come from the folder of the model 'sdxl'.
    """
    if not (place / "model_index.json").is_file():
        raise EnvironmentMissing(
            f"{place} lacks model_index.json, which a single checkpoint needs beside configurations and tokenizers; "
            "fetch the model 'sdxl', or copy that file from it"
        )
    if not path.is_file():
        raise InputRefused(f"{path}: found nothing, expected an SDXL checkpoint (.safetensors); check the path")
    if path.suffix.lower() != ".safetensors":
        raise InputRefused(f"{path}: expected an SDXL checkpoint that ends in .safetensors (pickles are not opened)")
    shapes = models.shapes([path])
    first = shapes.get("model.diffusion_model.input_blocks.0.0.weight")
    if first is None or not any(name.startswith("conditioner.embedders.1.") for name in shapes):
        raise EnvironmentMissing(
            f"{path}: not an SDXL checkpoint in the original layout (SD 1.5, a LoRA, one network?)"
        )
    if first[1] != 4:
        raise EnvironmentMissing(f"{path}: its UNet takes {first[1]} channels, expected 4: an inpainting model")


def marks(checkpoint: Path) -> dict[str, Any]:
    """Scheduler configuration that a single file's marker tensors imply."""
    names = models.header(checkpoint)
    return {key: value for mark, (key, value) in MARKS.items() if mark in names}


def numbers(paths: Iterable[Path]) -> int:
    """Number of parameters in weight files."""
    return sum(math.prod(shape) for shape in models.shapes(paths).values())


def need(
    kind: str, folders: Sequence[Path], pixels: int, width: int, offload: bool, checkpoint: Path | None = None
) -> float:
    """GB for weights and activations of networks at `width` bytes a number, for one picture of `pixels`.

    With offloading, text and image encoders (by their folders' names) are unloaded before the rest is loaded.
    """
    counted = {folder: numbers(models.weights(folder)) * width / 1e9 for folder in folders}
    gone = {f: n for f, n in counted.items() if offload and "encoder" in f.name}
    whole = numbers([checkpoint]) * width / 1e9 if checkpoint else 0.0
    return whole + sum(counted.values()) - sum(gone.values()) + WORKING[kind] * pixels / 1e6 * width / 2


def room(device: str) -> float:
    """Free memory of a device, GB, after unreferenced networks are released."""
    empty(device)
    if device == "cuda":
        import torch

        return torch.cuda.mem_get_info()[0] / 1e9
    meminfo = Path("/proc/meminfo")
    if meminfo.is_file():
        line = next((x for x in meminfo.read_text().splitlines() if x.startswith("MemAvailable")), "")
        if line:
            return int(line.split()[1]) * 1024 / 1e9
    try:
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 1e9
    except (AttributeError, ValueError, OSError):
        return math.inf


def empty(device: str) -> None:
    """Release unreferenced networks and cached memory of a device."""
    import torch

    gc.collect()
    if "drjit" in sys.modules:
        from mistyle.render.mitsuba.device import give_back

        give_back()
    if device in ("cuda", "mps"):
        getattr(torch, device).empty_cache()


def memory(stage: str, needed: float, allowed: float, device: str, offload: bool) -> None:
    """EnvironmentMissing for a stage that needs more memory (GB) than it may use."""
    free = room(device)
    limit = min(allowed, free) if allowed else free
    if needed <= limit:
        return
    less = "" if offload or device == "cpu" else "; --set models.offload=true needs less"
    raise EnvironmentMissing(
        f"{stage} needs about {needed:.1f} GB on the {'CPU' if device == 'cpu' else 'GPU'}, {limit:.1f} GB may be used"
        f"{less}; or use a smaller --resolution, or free some memory"
    )
