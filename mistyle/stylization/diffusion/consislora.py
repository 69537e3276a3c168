"""ConsisLoRA's adapters, losses and LoRA files (paper 4.1.2; arXiv 2503.10614).

LoRAs on the attention projections adapt only two blocks of SDXL's UNet:
up_blocks.0.attentions.0 holds content, up_blocks.0.attentions.1 style (B-LoRA's finding).
"""

import json
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal

import torch
from jaxtyping import Float

from mistyle.core.errors import InputRefused
from mistyle.io.store.atomic import atomic_write
from mistyle.stylization.models.folder import header

Half = Literal["content", "style"]
BLOCKS: dict[Half, str] = {"content": "up_blocks.0.attentions.0", "style": "up_blocks.0.attentions.1"}
PROJECTIONS = r"(to_q|to_k|to_v|to_out\.0)"


def add_half(unet: Any, half: Half, rank: int, seed: int) -> None:
    """Add a new LoRA on one block: A ~ N(0, 1/rank), B = 0, scale 1, float32 over the frozen network.

    peft leaves only the last added adapter active; see `activate`.
    """
    from peft import LoraConfig

    block = re.escape(BLOCKS[half])
    config = LoraConfig(
        r=rank,
        lora_alpha=rank,
        lora_dropout=0.0,
        init_lora_weights="gaussian",
        # peft matches a string as a whole; a list would match endings and reach every block.
        target_modules=rf"{block}\..*\.{PROJECTIONS}",
    )
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        unet.add_adapter(config, adapter_name=half)
    for parameter in parameters(unet, half).values():
        parameter.data = parameter.data.float()


def parameters(unet: Any, name: str) -> dict[str, torch.nn.Parameter]:
    """An adapter's weights by their parameter names in the UNet."""
    return {n: p for n, p in unet.named_parameters() if ".lora_" in n and f".{name}.weight" in n}


def activate(unet: Any, active: Mapping[str, float], trained: tuple[str, ...] = ()) -> None:
    """Activate these adapters at these scales; only the weights of `trained` get gradients."""
    unet.set_adapters(list(active), list(active.values()))
    unet.requires_grad_(False)
    for name in trained:
        for parameter in parameters(unet, name).values():
            parameter.requires_grad_(True)


@contextmanager
def below_without_gradients(unet: Any) -> Iterator[None]:
    """Context in which the UNet's down and middle blocks run without autograd: no trained weight is below them."""
    hooks = [
        unet.conv_in.register_forward_pre_hook(lambda *_: torch.set_grad_enabled(False) and None),
        unet.mid_block.register_forward_hook(lambda *_: torch.set_grad_enabled(True) and None),
    ]
    try:
        with torch.enable_grad():
            yield
    finally:
        for hook in hooks:
            hook.remove()


def noisy(
    z0: Float[torch.Tensor, "b c h w"], noise: Float[torch.Tensor, "b c h w"], alpha_bar: Float[torch.Tensor, ""]
) -> Float[torch.Tensor, "b c h w"]:
    """The latent at a noise level: sqrt(alpha_bar) z0 + sqrt(1 - alpha_bar) noise."""
    return alpha_bar.sqrt() * z0 + (1 - alpha_bar).sqrt() * noise


def x0_loss(
    output: Float[torch.Tensor, "b c h w"],
    z0: Float[torch.Tensor, "b c h w"],
    zt: Float[torch.Tensor, "b c h w"],
    alpha_bar: Float[torch.Tensor, ""],
    prediction: str = "epsilon",
) -> Float[torch.Tensor, ""]:
    """Mean squared error of the x0 predicted by the network's `output`, unweighted; equals the noise error times
    (1 - alpha_bar) / alpha_bar, 0.001 to 214 over SDXL's levels."""
    if prediction == "v_prediction":
        predicted = alpha_bar.sqrt() * zt - (1 - alpha_bar).sqrt() * output.float()
    else:
        predicted = (zt - (1 - alpha_bar).sqrt() * output.float()) / alpha_bar.sqrt()
    return torch.mean((predicted - z0) ** 2)


def velocity(
    z0: Float[torch.Tensor, "b c h w"], noise: Float[torch.Tensor, "b c h w"], alpha_bar: Float[torch.Tensor, ""]
) -> Float[torch.Tensor, "b c h w"]:
    """The target of `v_prediction` networks: sqrt(alpha_bar) noise - sqrt(1 - alpha_bar) z0."""
    return alpha_bar.sqrt() * noise - (1 - alpha_bar).sqrt() * z0


def half_names(unet: Any, name: str) -> dict[str, torch.nn.Parameter]:
    """An adapter's weights by their names in its file.

    The layout is diffusers', which ComfyUI also reads: unet.<attention>.processor.to_q_lora.down.weight.
    """
    tensors = {}
    for key, value in parameters(unet, name).items():
        match = re.fullmatch(rf"(.*)\.{PROJECTIONS}\.lora_([AB])\.{re.escape(name)}\.weight", key)
        assert match is not None
        part = "down" if match[3] == "A" else "up"
        projection = match[2].removesuffix(".0")
        tensors[f"unet.{match[1]}.processor.{projection}_lora.{part}.weight"] = value
    return tensors


def save_half(path: Path, unet: Any, name: str, notes: Mapping[str, str]) -> None:
    """Write an adapter as safetensors; `notes` go into its header."""
    from safetensors.torch import save_file

    tensors = {n: p.detach().cpu().clone().contiguous() for n, p in half_names(unet, name).items()}
    # One entry: safetensors writes several entries in an order that varies between runs.
    note = {"mistyle": json.dumps(notes, sort_keys=True)}
    atomic_write(path, lambda place: save_file(tensors, place, note))


def notes_of(path: Path) -> dict[str, str]:
    """The notes that `save_half` wrote into a LoRA's header; empty for foreign files."""
    try:
        notes = json.loads(header(path).get("__metadata__", {}).get("mistyle", "{}"))
    except (ValueError, RecursionError):
        return {}
    return {str(k): str(v) for k, v in notes.items()} if isinstance(notes, dict) else {}


def read_lora(path: Path, half: Half | None = None) -> dict[str, torch.Tensor]:
    """A LoRA's tensors. From a file of the two blocks only, `half` selects one block.

    Doubled prefixes ('unet.unet.', in some published B-LoRAs) are corrected.
    """
    from safetensors import SafetensorError
    from safetensors.torch import load_file

    try:
        tensors = load_file(path)
    except (OSError, SafetensorError) as error:
        raise InputRefused(f"{path}: {error}; expected a LoRA as .safetensors") from None
    tensors = {re.sub(r"^(unet\.)+", "unet.", name): value for name, value in tensors.items()}
    if half and all(any(block in name for block in BLOCKS.values()) for name in tensors):
        tensors = {name: value for name, value in tensors.items() if BLOCKS[half] in name}
    return tensors


def put_half(unet: Any, half: Half, path: Path) -> None:
    """Add an adapter named after its half, with the float32 weights that `save_half` wrote."""
    tensors = read_lora(path, half)
    rank = next(value.shape[0] for name, value in tensors.items() if name.endswith("down.weight"))
    add_half(unet, half, rank, 0)
    for name, empty in half_names(unet, half).items():
        empty.data.copy_(tensors[name])


def load_half(pipeline: Any, path: Path, name: str, half: Half) -> None:
    """Load a LoRA into a pipeline under an adapter's name, replacing an earlier one of that name."""
    from mistyle.stylization.models.load import quiet

    if name in getattr(pipeline.unet, "peft_config", {}):
        pipeline.delete_adapters(name)
    with quiet():
        pipeline.load_lora_weights(read_lora(path, half), adapter_name=name)
    if not parameters(pipeline.unet, name):
        raise InputRefused(f"{path}: none of its weights fit this model; expected a LoRA for SDXL's UNet")
    pipeline.unet.requires_grad_(False)
