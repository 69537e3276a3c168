"""Random models of the real architectures, small enough to run in tests, saved as users have them on disk."""

import atexit
import functools
import json
import shutil
import tempfile
from pathlib import Path

import torch
from diffusers import AutoencoderKL, ControlNetModel, DDIMScheduler, EulerDiscreteScheduler, UNet2DConditionModel
from safetensors.torch import save_file
from transformers import (
    CLIPImageProcessor,
    CLIPTextConfig,
    CLIPTextModel,
    CLIPTextModelWithProjection,
    CLIPTokenizer,
    CLIPVisionConfig,
    CLIPVisionModelWithProjection,
)

from mistyle.stylization.models.catalogue import MODELS
from mistyle.stylization.models.fetch import adopt

DOWN, UP = ("DownBlock2D", "CrossAttnDownBlock2D"), ("CrossAttnUpBlock2D", "UpBlock2D")
SDXL = {
    "attention_head_dim": (2, 4),
    "use_linear_projection": True,
    "addition_embed_type": "text_time",
    "addition_time_embed_dim": 8,
    "transformer_layers_per_block": (1, 2),
    "projection_class_embeddings_input_dim": 80,
    "cross_attention_dim": 64,
}
SD15 = {"attention_head_dim": (2, 4), "use_linear_projection": True, "cross_attention_dim": 32}


@functools.cache
def folder() -> Path:
    """A folder of models as `--models` wants it, made once per test run."""
    place = Path(tempfile.mkdtemp(prefix="mistyle-tiny-"))
    atexit.register(shutil.rmtree, place, True)
    build(place)
    for name in MODELS:
        adopt(name, place)
    return place


def vgg(place: Path) -> None:
    """VGG-19's layers up to relu3_1 in torchvision's order, with four channels, as a pickle."""
    place.mkdir(parents=True)
    layers, before = {}, 3
    for n in (0, 2, 5, 7, 10):
        layers |= {f"features.{n}.weight": torch.randn(4, before, 3, 3) * 0.3, f"features.{n}.bias": torch.zeros(4)}
        before = 4
    torch.save(layers, place / MODELS["vgg19"].loose[0])


def normalised_vgg(place: Path) -> None:
    """The same in the layout of Li et al., whose first layer changes the colours."""
    place.mkdir(parents=True)
    layers, before = {"0.weight": torch.eye(3)[..., None, None] * 255, "0.bias": torch.full((3,), -110.0)}, 3
    for n in (2, 5, 9, 12, 16):
        layers |= {f"{n}.weight": torch.randn(4, before, 3, 3) * 0.3, f"{n}.bias": torch.zeros(4)}
        before = 4
    torch.save(layers, place / MODELS["vgg19-normalised"].loose[0])


def birefnet(place: Path, half: bool = False, side: int = 64) -> None:
    """A network of BiRefNet's signature, one picture in and several logits out, the last at full size; it calls what is
    brighter than grey foreground."""
    import onnx
    from onnx import TensorProto, helper

    place.mkdir(parents=True)
    kind = TensorProto.FLOAT16 if half else TensorProto.FLOAT
    shape = [1, 3, side, side]
    given = helper.make_tensor_value_info("input_image", kind, shape)
    answers = [helper.make_tensor_value_info(n, kind, None) for n in ("coarse", "fine")]
    weights = [
        helper.make_tensor("w", kind, [1, 3, 1, 1], [1.0, 1.0, 1.0]),
        helper.make_tensor("b", kind, [1], [0.0]),
    ]
    nodes = [
        helper.make_node("Conv", ["input_image", "w", "b"], ["fine"]),
        helper.make_node("AveragePool", ["fine"], ["coarse"], kernel_shape=[4, 4], strides=[4, 4]),
    ]
    graph = helper.make_graph(nodes, "tiny", [given], answers, weights)
    made = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9)
    onnx.save(made, str(place / MODELS["birefnet"].loose[0]))


def build(place: Path, seed: int = 0) -> None:
    """sdxl, depth, canny, inpaint, sd15, position, inpaint-control and ip-adapter."""
    torch.manual_seed(seed)
    sdxl(place / "sdxl")
    for name in ("depth", "canny"):
        loud(ControlNetModel(**_common(SDXL), conditioning_embedding_out_channels=(16, 32))).save_pretrained(
            place / name
        )
    for name, channels in (("inpaint", 9), ("sd15", 4)):
        base(place / name, UNet2DConditionModel(**_common(SD15), **_up(), in_channels=channels, out_channels=4))
        DDIMScheduler(
            beta_start=0.00085,
            beta_end=0.012,
            beta_schedule="scaled_linear",
            clip_sample=False,
            set_alpha_to_one=False,
        ).save_pretrained(place / name / "scheduler")
    for name in ("position", "inpaint-control"):
        loud(ControlNetModel(**_common(SD15), conditioning_embedding_out_channels=(16, 32))).save_pretrained(
            place / name
        )
    ip_adapter(place / "ip-adapter")
    vgg(place / "vgg19")
    normalised_vgg(place / "vgg19-normalised")
    birefnet(place / "birefnet")


def _common(more: dict) -> dict:
    return {"block_out_channels": (32, 64), "layers_per_block": 2, "down_block_types": DOWN, **more}


def _up() -> dict:
    return {"up_block_types": UP, "sample_size": 32}


def sdxl(place: Path, second: int = 32) -> None:
    """The base model; `second` is the width of its second text encoder."""
    shape = _common(SDXL | {"cross_attention_dim": 32 + second})
    base(place, UNet2DConditionModel(**shape, **_up(), in_channels=4, out_channels=4))
    text(CLIPTextModelWithProjection, second).save_pretrained(place / "text_encoder_2")
    index = {"_class_name": "StableDiffusionXLPipeline", "vae": ["diffusers", "AutoencoderKL"]}
    index |= {"unet": ["diffusers", "UNet2DConditionModel"], "scheduler": ["diffusers", "EulerDiscreteScheduler"]}
    index |= {"text_encoder": ["transformers", "CLIPTextModel"], "tokenizer": ["transformers", "CLIPTokenizer"]}
    index |= {"text_encoder_2": ["transformers", "CLIPTextModelWithProjection"]}
    index |= {"tokenizer_2": ["transformers", "CLIPTokenizer"], "force_zeros_for_empty_prompt": True}
    (place / "model_index.json").write_text(json.dumps(index))
    tokenizer(place / "tokenizer_2")
    EulerDiscreteScheduler(
        beta_start=0.00085, beta_end=0.012, beta_schedule="scaled_linear", timestep_spacing="leading", steps_offset=1
    ).save_pretrained(place / "scheduler")


def base(place: Path, unet: UNet2DConditionModel) -> None:
    """The parts that every Stable Diffusion model has."""
    unet.save_pretrained(place / "unet")
    AutoencoderKL(
        block_out_channels=[32, 64],
        in_channels=3,
        out_channels=3,
        down_block_types=["DownEncoderBlock2D"] * 2,
        up_block_types=["UpDecoderBlock2D"] * 2,
        latent_channels=4,
    ).save_pretrained(place / "vae")
    text(CLIPTextModel).save_pretrained(place / "text_encoder")
    tokenizer(place / "tokenizer")


def text(kind: type, width: int = 32):
    return kind(
        CLIPTextConfig(
            bos_token_id=0,
            eos_token_id=1,
            pad_token_id=1,
            vocab_size=514,
            hidden_size=width,
            intermediate_size=37,
            num_attention_heads=4,
            num_hidden_layers=5,
            projection_dim=32,
        )
    )


def tokenizer(place: Path) -> None:
    """CLIP's byte alphabet without merges: every character is a token."""
    kept = [*range(33, 127), *range(161, 173), *range(174, 256)]
    letters = [chr(c) for c in kept] + [chr(256 + k) for k in range(256 - len(kept))]
    words = ["<|startoftext|>", "<|endoftext|>", *letters, *(c + "</w>" for c in letters)]
    made = CLIPTokenizer(vocab={w: k for k, w in enumerate(words)}, merges=[])
    made.model_max_length = 77
    made.save_pretrained(place)


def loud(controlnet: ControlNetModel) -> ControlNetModel:
    """A fresh ControlNet says nothing (its last convolutions are zero): noise gives it a voice."""
    for layer in (*controlnet.controlnet_down_blocks, controlnet.controlnet_mid_block):
        torch.nn.init.normal_(layer.weight, std=0.3)
    torch.nn.init.normal_(controlnet.controlnet_cond_embedding.conv_out.weight, std=0.3)
    return controlnet


def ip_adapter(place: Path) -> None:
    encoder = CLIPVisionModelWithProjection(
        CLIPVisionConfig(
            hidden_size=32,
            intermediate_size=37,
            projection_dim=32,
            num_hidden_layers=2,
            num_attention_heads=4,
            image_size=32,
            patch_size=8,
        )
    )
    encoder.save_pretrained(place / "models" / "image_encoder")
    CLIPImageProcessor(size={"shortest_edge": 32}, crop_size={"height": 32, "width": 32}).save_pretrained(
        place / "models" / "image_encoder"
    )
    for name, base_folder, width in (
        ("models/ip-adapter_sd15.safetensors", "inpaint", 32),
        ("sdxl_models/ip-adapter_sdxl_vit-h.safetensors", "sdxl", 64),
    ):
        unet = UNet2DConditionModel.from_pretrained(place.parent / base_folder / "unet")
        (place / name).parent.mkdir(parents=True, exist_ok=True)
        save_file(adapter_weights(unet, width), place / name)


def adapter_weights(unet: UNet2DConditionModel, width: int) -> dict[str, torch.Tensor]:
    """A random IP-Adapter for a UNet: keys are the odd places of its attention processors."""
    weights = {
        "image_proj.proj.weight": torch.randn(4 * width, 32),
        "image_proj.proj.bias": torch.zeros(4 * width),
        "image_proj.norm.weight": torch.ones(width),
        "image_proj.norm.bias": torch.zeros(width),
    }
    key = 1
    for name in unet.attn_processors:
        if name.endswith("attn2.processor"):
            hidden = unet.get_submodule(name.removesuffix(".processor")).to_k.out_features
            for part in ("to_k_ip", "to_v_ip"):
                weights[f"ip_adapter.{key}.{part}.weight"] = torch.randn(hidden, width) * 0.3
            key += 2
    return weights


def copy_without(place: Path, *names: str) -> Path:
    """A copy of the tiny models (links) at `place` that lacks some of them."""
    place.mkdir(parents=True, exist_ok=True)
    for part in folder().iterdir():
        if part.name not in names:
            (shutil.copytree if part.is_dir() else shutil.copy2)(part, place / part.name)
    return place


def edit_json(path: Path, **changes) -> None:
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))
