"""A tiny SDXL written as one file in the layout that Stability AI published: the inverse of what diffusers reads."""

import re
from pathlib import Path

import torch
from safetensors.torch import load_file

RESNET = {
    "norm1": "in_layers.0",
    "conv1": "in_layers.2",
    "time_emb_proj": "emb_layers.1",
    "norm2": "out_layers.0",
    "conv2": "out_layers.3",
    "conv_shortcut": "skip_connection",
}
EDGES = {
    "time_embedding.linear_1": "time_embed.0",
    "time_embedding.linear_2": "time_embed.2",
    "add_embedding.linear_1": "label_emb.0.0",
    "add_embedding.linear_2": "label_emb.0.2",
    "conv_in": "input_blocks.0.0",
    "conv_norm_out": "out.0",
    "conv_out": "out.2",
}
OPEN_CLIP = {
    "layer_norm1": "ln_1",
    "layer_norm2": "ln_2",
    "mlp.fc1": "mlp.c_fc",
    "mlp.fc2": "mlp.c_proj",
    "self_attn.out_proj": "attn.out_proj",
}


def single_file(place: Path, per_block: int = 2) -> dict[str, torch.Tensor]:
    """All tensors of the model in `place` (diffusers' folders) under their original names."""
    whole = {}
    for name, value in load_file(place / "unet" / "diffusion_pytorch_model.safetensors").items():
        whole[f"model.diffusion_model.{unet_name(name, per_block)}"] = value
    for name, value in load_file(place / "vae" / "diffusion_pytorch_model.safetensors").items():
        whole[f"first_stage_model.{vae_name(name)}"] = value
    first = load_file(place / "text_encoder" / "model.safetensors")
    for name, value in first.items():
        whole[f"conditioner.embedders.0.transformer.text_model.{name.removeprefix('text_model.')}"] = value
    second = load_file(place / "text_encoder_2" / "model.safetensors")
    whole |= {f"conditioner.embedders.1.model.{k}": v for k, v in open_clip(second).items()}
    return {name: value.contiguous() for name, value in whole.items()}


def unet_name(name: str, per_block: int) -> str:
    for ours, theirs in EDGES.items():
        if name.startswith(ours + "."):
            return name.replace(ours, theirs, 1)
    found = re.match(r"(down|up)_blocks\.(\d+)\.(resnets|attentions|downsamplers|upsamplers)\.(\d+)\.(.*)", name)
    if found:
        block, kind, k, rest = int(found[2]), found[3], int(found[4]), found[5]
        down = found[1] == "down"
        stride = per_block + 1
        at = 1 + stride * block + k if down else stride * block + k
        if kind == "downsamplers":
            return f"input_blocks.{stride * (block + 1)}.0.op.{rest.removeprefix('conv.')}"
        if kind == "upsamplers":
            return f"output_blocks.{stride * block + per_block}.{2 if block == 0 else 1}.{rest}"
        place = f"{'input' if down else 'output'}_blocks.{at}"
        return f"{place}.0.{resnet(rest)}" if kind == "resnets" else f"{place}.1.{rest}"
    middle = re.fullmatch(r"mid_block\.(resnets|attentions)\.(\d+)\.(.*)", name)
    assert middle, name
    if middle[1] == "attentions":
        return f"middle_block.1.{middle[3]}"
    return f"middle_block.{2 * int(middle[2])}.{resnet(middle[3])}"


def resnet(rest: str) -> str:
    head, _, tail = rest.partition(".")
    return f"{RESNET[head]}.{tail}"


def vae_name(name: str, blocks: int = 2) -> str:
    found = re.match(
        r"(encoder|decoder)\.(down|up)_blocks\.(\d+)\.(resnets|downsamplers|upsamplers)\.(\d+)\.(.*)", name
    )
    if found:
        side, way, block, kind, k, rest = found.groups()
        number = int(block) if way == "down" else blocks - 1 - int(block)
        rest = rest.replace("conv_shortcut", "nin_shortcut")
        middle = f"block.{k}" if kind == "resnets" else kind.removesuffix("rs").removesuffix("e") + "e"
        return f"{side}.{way}.{number}.{middle}.{rest}"
    name = name.replace("conv_norm_out", "norm_out")
    name = re.sub(r"mid_block\.resnets\.(\d)", lambda m: f"mid.block_{int(m[1]) + 1}", name)
    for ours, theirs in (("group_norm", "norm"), ("to_q", "q"), ("to_k", "k"), ("to_v", "v"), ("to_out.0", "proj_out")):
        name = name.replace(f"mid_block.attentions.0.{ours}", f"mid.attn_1.{theirs}")
    return name


def open_clip(state: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """OpenCLIP's names: queries, keys and values in one matrix."""
    plain = {name.removeprefix("text_model."): value for name, value in state.items()}
    made = {
        "positional_embedding": plain.pop("embeddings.position_embedding.weight"),
        "token_embedding.weight": plain.pop("embeddings.token_embedding.weight"),
        "ln_final.weight": plain.pop("final_layer_norm.weight"),
        "ln_final.bias": plain.pop("final_layer_norm.bias"),
        "text_projection": plain.pop("text_projection.weight").T,
    }
    for name, value in plain.items():
        found = re.fullmatch(r"encoder\.layers\.(\d+)\.(.*)\.(weight|bias)", name)
        assert found, name
        layer = f"transformer.resblocks.{found[1]}"
        if found[2].endswith(("q_proj", "k_proj", "v_proj")):
            parts = [plain[f"encoder.layers.{found[1]}.self_attn.{p}_proj.{found[3]}"] for p in "qkv"]
            made[f"{layer}.attn.in_proj_{found[3]}"] = torch.cat(parts)
        else:
            made[f"{layer}.{OPEN_CLIP[found[2]]}.{found[3]}"] = value
    return made
