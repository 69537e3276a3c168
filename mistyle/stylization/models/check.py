"""Whether found models fit together and fit into memory, from their configurations and headers alone: before any
rendering, and before torch is loaded."""

import gc
import math
import os
import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from mistyle.core.errors import EnvironmentMissing, InputRefused
from mistyle.stylization.models import folder as models

# Layers' working memory per megapixel of picture, GB at 2 bytes a number; an estimate, not measured here.
WORKING = {"sdxl": 4.0, "sd15": 3.0}
PREDICTIONS = ("epsilon", "v_prediction")
# Tensors by whose names finetunes in one file say that they predict velocities, and that their last level is all noise.
MARKS = {"v_pred": ("prediction_type", "v_prediction"), "ztsnr": ("rescale_betas_zero_snr", True)}
STYLE_BLOCK, CONTENT_BLOCK = "up_blocks.0.attentions.1", "up_blocks.0.attentions.0"


def expect(path: Path, what: str, fix: str, **wanted: Any) -> dict[str, Any]:
    """The configuration at `path`, refused where one of its values is not the wanted one."""
    config = models.read_json(path)
    for key, value in wanted.items():
        found = config.get(key)
        if found != value:
            raise EnvironmentMissing(f"{path}: {key} is {found!r}, expected {value!r}: this is not {what}; {fix}")
    return config


def base(place: Path, kind: str, channels: int) -> dict[str, Any]:
    """The UNet's configuration of a base model of kind 'sdxl' or 'sd15' with so many input channels."""
    what = {
        ("sdxl", 4): "an SDXL base model",
        ("sd15", 9): "an inpainting model of Stable Diffusion 1.5",
        ("sd15", 4): "a Stable Diffusion 1.5 base model",
    }[kind, channels]
    fix = f"put {what} there (mistyle models lists the one that is meant)"
    expect(place / "vae" / "config.json", what, fix, _class_name="AutoencoderKL", latent_channels=4)
    wanted: dict[str, Any] = {"_class_name": "UNet2DConditionModel", "in_channels": channels, "out_channels": 4}
    wanted["addition_embed_type"] = "text_time" if kind == "sdxl" else None
    config = expect(place / "unet" / "config.json", what, fix, **wanted)
    text = models.read_json(place / "text_encoder" / "config.json")["hidden_size"]
    schedule = place / "scheduler" / "scheduler_config.json"
    found = models.read_json(schedule).get("prediction_type", "epsilon")
    if found not in PREDICTIONS:
        raise EnvironmentMissing(
            f"{schedule}: prediction_type is {found!r}, expected {' or '.join(PREDICTIONS)}; {fix}"
        )
    if kind == "sdxl":
        text += models.read_json(place / "text_encoder_2" / "config.json")["hidden_size"]
    if config["cross_attention_dim"] != text:
        raise EnvironmentMissing(
            f"{place}: the UNet takes text of {config['cross_attention_dim']} numbers a token, the text encoders give "
            f"{text}; the folders come from different models"
        )
    return config


def controlnet(place: Path, unet: Mapping[str, Any], base_name: str) -> None:
    """A ControlNet must be of the base model's own shape."""
    what = f"a ControlNet for {base_name}"
    fix = "put one trained for that base model there (unions of several conditions are not supported)"
    wanted = {k: unet.get(k) for k in ("cross_attention_dim", "block_out_channels", "addition_embed_type")}
    expect(place / "config.json", what, fix, _class_name="ControlNetModel", **wanted)


def ip_adapter(path: Path, encoder: Path, unet: Mapping[str, Any], base_name: str) -> None:
    """A plain IP-Adapter (four tokens of the pooled picture) for this base model and this image encoder."""
    shapes = models.shapes([path])
    found = shapes.get("image_proj.proj.weight")
    gives = models.read_json(encoder / "config.json").get("projection_dim")
    wanted = [4 * unet["cross_attention_dim"], gives]
    if found != wanted:
        raise EnvironmentMissing(
            f"{path}: image_proj.proj.weight is {found}, expected {wanted}: this is not a plain IP-Adapter for "
            f"{base_name} with the image encoder in {encoder}; fetch the model 'ip-adapter' again"
        )


def lora(path: Path, unet: Mapping[str, Any]) -> None:
    """A LoRA that reaches the style block of this SDXL model."""
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
            f"{path}: its weights take {downs[0][1]} numbers, the base model has {width}: trained for another model"
        )


def checkpoint(path: Path, place: Path) -> None:
    """A single file must be SDXL in its original layout, not an inpainting or a refiner model; the configurations that
    go with it come from the folder of the model 'sdxl'.
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
    """What a single file says of its noise levels, as its scheduler's configuration."""
    names = models.header(checkpoint)
    return {key: value for mark, (key, value) in MARKS.items() if mark in names}


def numbers(paths: Iterable[Path]) -> int:
    """How many numbers weight files hold."""
    return sum(math.prod(shape) for shape in models.shapes(paths).values())


def need(
    kind: str, folders: Sequence[Path], pixels: int, width: int, offload: bool, checkpoint: Path | None = None
) -> float:
    """GB that networks of `width` bytes a number need for one picture of `pixels`, weights and layers' working memory.

    With offloading text and image encoders, whose folders say so, leave before the rest comes.
    """
    counted = {folder: numbers(models.weights(folder)) * width / 1e9 for folder in folders}
    gone = {f: n for f, n in counted.items() if offload and "encoder" in f.name}
    whole = numbers([checkpoint]) * width / 1e9 if checkpoint else 0.0
    return whole + sum(counted.values()) - sum(gone.values()) + WORKING[kind] * pixels / 1e6 * width / 2


def room(device: str) -> float:
    """GB that are free on a device, networks that nobody holds any more counted as gone."""
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
    """Give back what networks left on a device: those that nobody holds any more, and memory kept for later ones."""
    import torch

    gc.collect()
    if "drjit" in sys.modules:
        from mistyle.render.mitsuba.device import give_back

        give_back()
    if device in ("cuda", "mps"):
        getattr(torch, device).empty_cache()


def memory(what: str, needed: float, allowed: float, device: str, offload: bool) -> None:
    """Refuse a stage that will not fit."""
    free = room(device)
    limit = min(allowed, free) if allowed else free
    if needed <= limit:
        return
    less = "" if offload or device == "cpu" else "; --set models.offload=true needs less"
    raise EnvironmentMissing(
        f"{what} needs about {needed:.1f} GB on the {'CPU' if device == 'cpu' else 'GPU'}, {limit:.1f} GB may be used"
        f"{less}; or use a smaller --resolution, or free some memory"
    )
