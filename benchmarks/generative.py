"""What the generative stages cost, and that all of their paths run: `python -m benchmarks.generative [--device cuda]
[--tiny] [--precision bfloat16] [--quick] [--json FILE]`

The networks have their full size and random weights, made from their configurations: nothing is downloaded and the
pictures are noise, but time and memory are the real ones. On a GPU, in bfloat16: one training step of ConsisLoRA, one
denoising step of SDXL with two ControlNets and guidance, both at 1024², and one 1024² crop of the texture inpainter of
two steps. Figures: seconds of a second call each, and the peak memory of the device in GB. --tiny (or no GPU):
the same calls on tiny networks, only to see that they work, and then every path from models on disk to a texture:
stylizer x inpainter x offloaded or not x resumed or not, in the precision asked for. Figures: `paths`, how many there
are, `paths_run`, how many gave finite pictures, and the seconds of each.
"""

import tempfile
from argparse import ArgumentParser
from collections.abc import Callable
from contextlib import suppress
from itertools import product
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import torch

from benchmarks.common import finish, timed

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
    "side": 32,
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
    from mistyle.stylization.diffusion import consislora
    from mistyle.stylization.diffusion.lora_training import TrainingExample, joint_phase, run_phase
    from mistyle.stylization.diffusion.settings import TrainSettings

    settings = TrainSettings(rank=shape["rank"], steps=1)
    for half in consislora.BLOCKS:
        if half not in getattr(pipeline.unet, "peft_config", {}):
            consislora.add_half(pipeline.unet, half, shape["rank"], 0)
    side, width = shape["side"], shape["xl"]["cross_attention_dim"]
    latent = side // 2 ** (len(shape["vae"]) - 1)
    shown = TrainingExample(
        torch.randn(1, 4, latent, latent, device=device),
        torch.randn(1, 77, width, device=device, dtype=dtype),
        torch.randn(1, shape["pooled"], device=device, dtype=dtype),
        torch.tensor([[side, side, 0, 0, side, side]], device=device, dtype=torch.float32),
    )
    return lambda: run_phase(pipeline, shown, joint_phase("[c]", settings), settings, 0)


def denoise_step(pipeline: Any, shape: dict[str, Any], device: str, dtype: torch.dtype) -> Callable[[], object]:
    """One noise level: two ControlNets and the UNet with its LoRAs, for the empty and the real prompt."""
    from mistyle.stylization.diffusion.denoiser import Conditioning, denoiser

    side, width = shape["side"], shape["xl"]["cross_attention_dim"]
    latent = side // 2 ** (len(shape["vae"]) - 1)
    asked = Conditioning(
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
    from diffusers.pipelines.controlnet.pipeline_controlnet_inpaint import StableDiffusionControlNetInpaintPipeline
    from diffusers.schedulers.scheduling_ddim import DDIMScheduler

    from mistyle.stylization.diffusion.settings import Paint3dSettings
    from mistyle.stylization.inpaint.paint3d import RECIPES, Brush, inpaint
    from mistyle.stylization.models.vae import ExactVae

    channels = shape["vae"]
    with torch.device(device):
        vae = ExactVae(
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


SIDE = 32  # pixels of the paths' views and atlas


def ball(azimuth: float) -> Any:
    """A view of a striped ball, by formula."""
    from mistyle.core.camera import orbit
    from mistyle.core.view import View

    y, x = (np.mgrid[:SIDE, :SIDE] + 0.5) / SIDE * 2 - 1
    mask = x**2 + y**2 < 0.8
    height = np.sqrt(np.maximum(0.8 - x**2 - y**2, 0))
    depth = np.where(mask, 4 - height, np.inf).astype(np.float32)
    normal = np.where(mask[..., None], np.stack([x, -y, height], axis=-1), 0).astype(np.float32)
    rgb = np.where(mask[..., None], (np.sin(12 * x) > 0)[..., None] * [0.8, 0.5, 0.3] + 0.1, 0).astype(np.float32)
    camera, uv = orbit(azimuth, 0, distance=4, fov=30, size=(SIDE, SIDE)), np.zeros((SIDE, SIDE, 2), np.float32)
    return View(camera, rgb, depth, normal, uv, np.where(mask, 0, -1), mask, mask.astype(np.float32))


def painted_views(job: Any, views: list[Any], kept: Path, resumed: bool) -> list[np.ndarray]:
    """The sweep over the views; resumed: stopped in the last one and begun again with networks loaded anew."""
    from mistyle.core.errors import Stopped
    from mistyle.stylization.diffusion import stylizer as diffusion
    from mistyle.stylization.mvst.settings import SweepSettings
    from mistyle.stylization.mvst.sweep import ViewPainter, ViewStore, sweep

    key = diffusion.key(job, views)

    def stops(view: Any, prior: Any, rng: np.random.Generator) -> np.ndarray:
        if prior is not None:
            raise Stopped("on request")
        return paint(view, prior, rng)

    paint = diffusion.stylizer(job, views)
    if resumed:
        with suppress(Stopped):
            sweep(views, ViewPainter(stops), SweepSettings(), 0, store=ViewStore(kept, key))
        paint = diffusion.stylizer(job, views)
    return [one.rgb for one in sweep(views, ViewPainter(paint), SweepSettings(), 0, store=ViewStore(kept, key)).painted]


def painted(made: Any, stylizer: str, resumed: bool, work: Path) -> bool:
    """Two views, from models on disk: LoRAs trained where the stylizer takes some; whether all colours are finite."""
    from mistyle.stylization.diffusion.settings import DiffusionSettings, TrainSettings
    from mistyle.stylization.diffusion.stylizer import DiffusionJob

    sampling = DiffusionSettings(adapter=cast(Any, stylizer), steps=1, block=1, repeats=2, refinement=1.0)
    training = TrainSettings(rank=4, steps=2, style_steps=1, switch=1, resolution=16)
    job = DiffusionJob(made, training, sampling, noise(), "style", work / "loras", 0)
    with tempfile.TemporaryDirectory() as kept:
        views = painted_views(job, [ball(0.0), ball(30.0)], Path(kept), resumed)
    return all(bool(np.isfinite(one).all()) for one in views)


def filled(made: Any, recipe: str) -> bool:
    """A hole in the texture of a triangle, from models on disk; whether all colours are finite."""
    from mistyle.atlas.texels import rasterise
    from mistyle.core.mesh import Mesh
    from mistyle.stylization.diffusion.settings import Paint3dSettings
    from mistyle.stylization.inpaint import paint3d

    corners = np.array([[-1, -1, 0], [1, -1, 0], [0, 1, 0]], np.float32)
    flat = np.tile(np.array([0, 0, 1], np.float32), (1, 3, 1))
    uvs = np.array([[[0.05, 0.05], [0.95, 0.05], [0.5, 0.95]]], np.float32)
    mesh = Mesh(corners, np.array([[0, 1, 2]]), flat, uvs, np.zeros(1, np.int64), ("a",))
    chosen = Paint3dSettings(recipe=cast(Any, recipe), size=SIDE, overlap=8, steps=2)
    paint = paint3d.inpainter(mesh, noise(), made, chosen)
    hole = np.zeros((SIDE, SIDE), bool)
    hole[SIDE // 2 :] = True
    albedo = np.full((SIDE, SIDE, 3), 0.3, np.float32)
    return bool(np.isfinite(paint(albedo, hole, rasterise(mesh, 0, SIDE), np.random.default_rng(0))).all())


def noise() -> np.ndarray:
    return np.random.default_rng(0).random((24, 20, 3)).astype(np.float32)


def paths(figures: dict[str, float], device: str, precision: str, quick: bool) -> None:
    """Every path on tiny random models, as users have models on disk; what paths share is run once. `quick`: half of
    them, in which every pair of choices meets."""
    from mistyle.stylization.diffusion.settings import ModelSettings
    from mistyle.stylization.inpaint.paint3d import RECIPES
    from tests.support import tiny_models

    made: Any = {"folder": tiny_models.folder(), "device": device, "precision": precision}
    places = {word: ModelSettings(**made, offload=word == "offloaded") for word in ("whole", "offloaded")}
    stylizers, times, good = ("lora", "ip"), ("fresh", "resumed"), {}
    numbered = product(*map(enumerate, (places, stylizers, times)))
    ways = [(p, s, t) for (a, p), (b, s), (c, t) in numbered if not quick or (a + b + c) % 2 == 0]
    with tempfile.TemporaryDirectory() as work:
        for place, stylizer, when in ways:
            given = places[place], stylizer, when == "resumed", Path(work)
            name = f"{stylizer}.{precision}.{place}.{when}"
            good[place, stylizer, when] = timed(figures, name, lambda given=given: painted(*given))
    for place, recipe in product(places, RECIPES):
        name = f"inpainter.{recipe}.{precision}.{place}"
        good[place, recipe] = timed(figures, name, lambda at=(places[place], recipe): filled(*at))
    every = [(way, (way[0], recipe)) for way in ways for recipe in RECIPES]
    figures |= {"paths": len(every), "paths_run": sum(good[way] and good[fill] for way, fill in every)}


def main() -> None:
    parser = ArgumentParser(description=__doc__)
    there = "cuda" if torch.cuda.is_available() else "cpu"
    parser.add_argument("--device", choices=["cpu", "cuda"], default=there)
    parser.add_argument("--tiny", action="store_true", help="tiny networks, and every path on them")
    parser.add_argument("--precision", choices=["float32", "bfloat16", "float16"], help="else bfloat16 in full size")
    parser.add_argument("--quick", action="store_true", help="--tiny on the CPU, and half of the paths")
    parser.add_argument("--json", type=Path, metavar="FILE", help="also write the figures as JSON ('-': stdout only)")
    chosen = parser.parse_args()
    device = "cpu" if chosen.quick else chosen.device
    tiny = chosen.tiny or device == "cpu"
    precision = chosen.precision or ("float32" if tiny else "bfloat16")
    shape, dtype = TINY if tiny else FULL, getattr(torch, precision)
    figures: dict[str, float] = {"full_size": float(shape is FULL)}
    if tiny:
        torch.set_num_threads(1)  # threads that wait for each other would take most of the time
    pipeline = sdxl(shape, device, dtype)
    measured(figures, "train_step", device, train_step(pipeline, shape, device, dtype))
    measured(figures, "denoise_step", device, denoise_step(pipeline, shape, device, dtype))
    del pipeline
    measured(figures, "crop_two_steps", device, crop_step(shape, device, dtype))
    if tiny:
        paths(figures, device, precision, chosen.quick)
    finish(figures, chosen.json)


if __name__ == "__main__":
    main()
