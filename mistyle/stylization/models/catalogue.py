"""Catalogue of the generative stages' models: names, repositories, revisions, hashes, licences, purposes.

Revisions and hashes come from other projects' published lock files; several of these agree on every hash of SDXL and
its ControlNets. They were not compared with the hub itself. Models without a hash: no published one was found.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

BASE = ("tokenizer", "text_encoder", "unet", "vae", "scheduler")  # folders of a Stable Diffusion model


@dataclass(frozen=True)
class PublishedModel:
    """One model that mistyle can use.

    `folders` hold networks or tokenizers ('' is the model's own folder), `loose` are single weight files, `patterns`
    are fetched. `sha256` may hold only the first digits. A model with a `url` is one file outside the hub, which the
    user downloads.
    """

    name: str
    repo: str
    revision: str
    gigabytes: float
    licence: str
    purpose: str
    folders: tuple[str, ...]
    patterns: tuple[str, ...]
    loose: tuple[str, ...] = ()
    sha256: Mapping[str, str] = field(default_factory=dict)
    url: str = ""


def _network(*folders: str) -> tuple[str, ...]:
    return tuple(f"{f}/{name}" if f else name for f in folders for name in ("*.json", "*model.fp16.safetensors"))


SDXL = (*BASE, "tokenizer_2", "text_encoder_2")
TOKENS = ("tokenizer*/*", "scheduler/*.json", "model_index.json")
ENCODER = "models/image_encoder"
MODELS = {
    model.name: model
    for model in (
        PublishedModel(
            "sdxl",
            "stabilityai/stable-diffusion-xl-base-1.0",
            "462165984030d82259a11f4367a4eed129e94a7b",
            7.1,
            "CreativeML Open RAIL++-M",
            "stylizer and LoRA training: the base model",
            SDXL,
            (*_network("unet", "text_encoder", "text_encoder_2"), *TOKENS, "vae/*.json", "vae/*model.safetensors"),
            (),
            {
                "unet/diffusion_pytorch_model.fp16.safetensors": (
                    "83e012a805b84c7ca28e5646747c90a243c65c8ba4f070e2d7ddc9d74661e139"
                ),
                "text_encoder/model.fp16.safetensors": (
                    "660c6f5b1abae9dc498ac2d21e1347d2abdb0cf6c0c0c8576cd796491d9a6cdd"
                ),
                "text_encoder_2/model.fp16.safetensors": (
                    "ec310df2af79c318e24d20511b601a591ca8cd4f1fce1d8dff822a356bcdb1f4"
                ),
                "vae/diffusion_pytorch_model.safetensors": (
                    "1598f3d24932bcfe6634e8b618ea1e30ab1d57f5aad13a6d2de446d2199f2341"
                ),
            },
        ),
        PublishedModel(
            "depth",
            "diffusers/controlnet-depth-sdxl-1.0",
            "17bb97973f29801224cd66f192c5ffacf82648b4",
            2.5,
            "openrail++",
            "stylizer: depth ControlNet",
            ("",),
            _network(""),
            (),
            {
                "diffusion_pytorch_model.fp16.safetensors": (
                    "66a6813e6bd7270ecfe68206a59ddd605a011ae85321188376605c66e0a4f303"
                )
            },
        ),
        PublishedModel(
            "canny",
            "diffusers/controlnet-canny-sdxl-1.0",
            "eb115a19a10d14909256db740ed109532ab1483c",
            2.5,
            "openrail++",
            "stylizer: Canny ControlNet",
            ("",),
            _network(""),
            (),
            {
                "diffusion_pytorch_model.fp16.safetensors": (
                    "b2e7d3921058a442cc80430d1ec8847f42599c705e2451c95e77cf4dcf8d6c25"
                )
            },
        ),
        PublishedModel(
            "ip-adapter",
            "h94/IP-Adapter",
            "018e402774aeeddd60609b4ecdb7e298259dc729",
            3.3,
            "Apache-2.0",
            "inpainter: the style picture; stylizer with --style-adapter ip",
            (ENCODER,),
            (
                f"{ENCODER}/config.json",
                f"{ENCODER}/model.safetensors",
                "models/ip-adapter_sd15.safetensors",
                "sdxl_models/ip-adapter_sdxl_vit-h.safetensors",
            ),
            ("models/ip-adapter_sd15.safetensors", "sdxl_models/ip-adapter_sdxl_vit-h.safetensors"),
            {
                "models/ip-adapter_sd15.safetensors": (
                    "289b45f16d043d0bf542e45831f971dcdaabe18b656f11e86d9dfba7e9ee3369"
                ),
                "sdxl_models/ip-adapter_sdxl_vit-h.safetensors": (
                    "ebf05d918348aec7abb02a5e9ecef77e0aaea6914a5c4ea13f50d45eb1681831"
                ),
                f"{ENCODER}/model.safetensors": "6ca9667da1ca9e0b0f75e46bb030f7e011f44f86cbfb8d5a36590fcd7507b030",
            },
        ),
        PublishedModel(
            "inpaint",
            "stable-diffusion-v1-5/stable-diffusion-inpainting",
            "8a4288a76071f7280aedbdb3253bdb9e9d5d84bb",
            2.2,
            "CreativeML OpenRAIL-M",
            "inpainter: the base model (the copy of the deleted runwayml/stable-diffusion-inpainting)",
            BASE,
            (*_network("unet", "text_encoder", "vae"), *TOKENS),
        ),
        PublishedModel(
            "position",
            "GeorgeQi/Paint3d_UVPos_Control",
            "main",
            1.5,
            "Apache-2.0 (its training data has licences of its own)",
            "inpainter: UV-position ControlNet; published as a pickle, converted once",
            ("",),
            ("config.json", "diffusion_pytorch_model.bin"),
        ),
        PublishedModel(
            "sd15",
            "stable-diffusion-v1-5/stable-diffusion-v1-5",
            "451f4fe16113bff5a5d2269ed5ad43b0592e9a14",
            2.2,
            "CreativeML OpenRAIL-M",
            "inpainter with paint3d.recipe=paint3d: the base model",
            BASE,
            (*_network("unet", "text_encoder", "vae"), *TOKENS),
            (),
            {
                "unet/diffusion_pytorch_model.fp16.safetensors": (
                    "c83908253f9a64d08c25fc90874c9c8aef9a329ce1ca5fb909d73b0c83d1ea21"
                ),
                "text_encoder/model.fp16.safetensors": (
                    "77795e2023adcf39bc29a884661950380bd093cf0750a966d473d1718dc9ef4e"
                ),
                "vae/diffusion_pytorch_model.fp16.safetensors": (
                    "4fbcf0ebe55a0984f5a5e00d8c4521d52359af7229bb4d81890039d2aa16dd7c"
                ),
            },
        ),
        PublishedModel(
            "inpaint-control",
            "lllyasviel/control_v11p_sd15_inpaint",
            "c96e03a807e64135568ba8aecb66b3a306ec73bd",
            0.7,
            "openrail",
            "inpainter with paint3d.recipe=paint3d: inpaint ControlNet",
            ("",),
            _network(""),
        ),
        PublishedModel(
            "vgg19",
            "torchvision, IMAGENET1K_V1",
            "dcbb9e9d",
            0.6,
            "BSD-3-Clause (torchvision; trained on ImageNet)",
            "fit with fit.features=vgg19: the features of the style loss",
            (),
            (),
            ("vgg19-dcbb9e9d.pth",),
            {"vgg19-dcbb9e9d.pth": "dcbb9e9d"},  # torchvision names files by the first digits of their sha256
            "https://download.pytorch.org/models/vgg19-dcbb9e9d.pth",
        ),
        PublishedModel(
            "vgg19-normalised",
            "naoto0804/pytorch-AdaIN",
            "v0.0.0",
            0.1,
            "CC-BY-4.0 (Oxford's VGG-19; scaled by Li et al.)",
            "fit with fit.features=vgg19-normalised: the features that AdaIN and WCT use",
            (),
            (),
            ("vgg_normalised.pth",),
            {},
            "https://github.com/naoto0804/pytorch-AdaIN/releases/download/v0.0.0/vgg_normalised.pth",
        ),
        PublishedModel(
            "birefnet",
            "danielgatis/rembg",
            "v0.0.0",
            1.0,
            "MIT",
            "sweep with sweep.segmenter=birefnet: the foreground of stylized views (pip install onnxruntime)",
            (),
            (),
            ("BiRefNet-general-epoch_244.onnx",),
            {"BiRefNet-general-epoch_244.onnx": "58f621f00f5d756097615970a88a791584600dcf7c45b18a0a6267535a1ebd3c"},
            "https://github.com/danielgatis/rembg/releases/download/v0.0.0/BiRefNet-general-epoch_244.onnx",
        ),
    )
}
LOOSE_NEEDED = {"sdxl": "sdxl_models/ip-adapter_sdxl_vit-h.safetensors", "sd15": "models/ip-adapter_sd15.safetensors"}
