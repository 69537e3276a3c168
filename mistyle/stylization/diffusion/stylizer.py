"""The paper's stylizer (4.1.2, 4.1.3): SDXL with depth and Canny ControlNets, content and style LoRAs, RePaint.

It paints one view at a time for the sweep of `stylization/mvst/sweep.py`. It never downloads weights. Full-size
networks have not been run yet; the tests run every path on tiny random ones of the same architecture.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from mistyle.core.errors import UsageError
from mistyle.core.image import linear_from_srgb, resize, srgb_from_linear
from mistyle.core.view import Prior, View
from mistyle.io.store.atomic import digest
from mistyle.stylization.diffusion.lora_files import (
    NETWORKS,
    LoraFolder,
    LoraPair,
    TrainingImage,
    forecast,
    identity,
    lora_key,
    make_all,
)
from mistyle.stylization.diffusion.settings import DiffusionSettings, ModelSettings, TrainSettings
from mistyle.stylization.models import check as models_check
from mistyle.stylization.models import folder as models
from mistyle.stylization.models.catalogue import ENCODER, LOOSE_NEEDED


@dataclass(frozen=True)
class DiffusionJob:
    """The stylizer's inputs: settings, the style picture (sRGB) and its name, the LoRA folder, the seed."""

    models: ModelSettings
    training: TrainSettings
    diffusion: DiffusionSettings
    style: Float[np.ndarray, "h w 3"]
    style_name: str
    loras: Path
    seed: int


def check(settings: ModelSettings, chosen: DiffusionSettings, side: int) -> None:
    """Refuse a job that cannot run, before anything is rendered: packages, files, architectures, memory."""
    models.need_extra()
    from mistyle.stylization.models.load import device_of, precision_of

    guided = chosen.content_guidance > 0 or chosen.style_guidance > 0
    if guided and (settings.style_lora or chosen.adapter == "ip" or content_of(chosen) == "none"):
        raise UsageError(
            "diffusion.content_guidance and style_guidance need both halves of a style LoRA and of content LoRAs that "
            "were trained here; leave out --style-lora, --style-adapter ip and --content none, or the guidance"
        )
    place, controls = _places(settings, chosen)
    unet = models_check.base(place, "sdxl", 4)
    for control in controls:
        models_check.controlnet(control, unet, "SDXL")
    if settings.checkpoint:
        models_check.checkpoint(settings.checkpoint, place)
    if settings.style_lora:
        models_check.lora(settings.style_lora, unet)
    if chosen.adapter == "ip":
        ip = models.find("ip-adapter", settings.folder, [LOOSE_NEEDED["sdxl"]])
        models_check.ip_adapter(ip / LOOSE_NEEDED["sdxl"], ip / ENCODER, unet, "SDXL")
    device = device_of(settings)
    width = precision_of(settings, device).itemsize
    folders = [*(place / n for n in NETWORKS), *controls]
    needed = models_check.need("sdxl", folders, side * side, width, settings.offload, settings.checkpoint)
    models_check.memory(f"a view of {side}² pixels", needed, settings.memory, device, settings.offload)


def _places(settings: ModelSettings, chosen: DiffusionSettings) -> tuple[Path, list[Path]]:
    place = models.find("sdxl", settings.folder, weightless=NETWORKS if settings.checkpoint else ())
    return place, [models.find(name, settings.folder) for name in ("depth", "canny")]


def training_set(job: DiffusionJob, views: Sequence[View]) -> list[TrainingImage]:
    """The pictures to train LoRAs on: the style first, then the first view or all views."""
    images: list[TrainingImage] = []
    if job.diffusion.adapter == "lora" and job.models.style_lora is None:
        images.append(TrainingImage("style", job.style_name, job.style, job.diffusion.look))
    for view in views[: content_count(job.diffusion, len(views))]:
        rgb = srgb_from_linear(view.rgb)
        images.append(TrainingImage("content", view.camera.name, rgb, job.diffusion.subject))
    return images


def content_of(chosen: DiffusionSettings) -> str:
    """The kind of content LoRAs: none, shared or per-view."""
    if chosen.content != "auto":
        return chosen.content
    return "none" if chosen.adapter == "ip" else "shared"


def content_count(chosen: DiffusionSettings, views: int) -> int:
    """Number of content LoRAs for a job of `views` views."""
    return {"none": 0, "shared": min(1, views), "per-view": views}[content_of(chosen)]


def announcement(settings: ModelSettings, training: TrainSettings, chosen: DiffusionSettings, views: int) -> str:
    """Upper cost of a job of `views` views, reported before it starts: training steps and network evaluations."""
    own = chosen.adapter == "lora" and settings.style_lora is None
    steps = (training.steps + training.style_steps) * own + training.steps * content_count(chosen, views)
    evaluations = chosen.steps + (views - 1) * (chosen.steps * chosen.repeats + int(chosen.refinement * chosen.steps))
    trained = f"at most {forecast(steps, training.resolution)}" if steps else "no LoRA is trained"
    return f"diffusion: {trained}; then {evaluations:,} denoising steps over {views} views"


def key(job: DiffusionJob, views: Sequence[View]) -> str:
    """Cache key of painted views, besides the sweep's settings, the seed and the rig."""
    loras = [lora_key(image, job.training, job.models, job.seed) for image in training_set(job, views)]
    _, controls = _places(job.models, job.diffusion)
    files = [file for place in controls for file in models.weights(place)]
    if job.diffusion.adapter == "ip":
        ip = models.find("ip-adapter", job.models.folder, [LOOSE_NEEDED["sdxl"]])
        files += [ip / LOOSE_NEEDED["sdxl"], *models.weights(ip / ENCODER)]
    networks = [identity(job.models), models.fingerprint(files)]
    own = job.models.model_dump(include={"precision", "prediction"})
    pictures = [view.rgb for view in views]
    return digest([loras, networks, own, job.models.style_lora, job.diffusion, job.style, pictures])


def prompt_of(chosen: DiffusionSettings) -> str:
    """ "a [c] in the style of [v]"; without LoRAs, which define the bracketed tokens, a prompt of plain text."""
    named = content_of(chosen) != "none" or chosen.subject != "[c]"
    subject = f"a {chosen.subject}" if named else "an object"
    if chosen.adapter == "ip" and chosen.look == "[v]":
        return subject
    return f"{subject} in the style of {chosen.look}"


def stylizer(
    job: DiffusionJob,
    views: Sequence[View],
    say: Callable[[str], None] = lambda text: None,
    watch: Callable[[int, int, float], None] = lambda step, steps, loss: None,
) -> Callable[[View, Prior | None, np.random.Generator], np.ndarray]:
    """Train the missing LoRAs, load SDXL, and return the function that paints a view.

    `view.rgb` and the result are linear; all randomness comes from the generator. Camera names identify views. Sides
    are enlarged to multiples of 32 pixels and reduced again.
    """
    side = max(max(view.camera.size) for view in views)
    check(job.models, job.diffusion, side)
    images = training_set(job, views)
    loras = make_all(job.models, images, LoraFolder(job.loras), job.training, job.seed, say, watch)
    trained = {(image.kind, image.name): pair for image, pair in zip(images, loras, strict=True)}
    style = next((h for (kind, _), h in trained.items() if kind == "style"), None)
    contents = {name: h for (kind, name), h in trained.items() if kind == "content"}
    pipeline, picture = _pipeline(job)
    if job.models.style_lora or style:
        _load(pipeline, job.models.style_lora or style.style, "style")  # pyright: ignore[reportOptionalMemberAccess]
    current: dict[str, str] = {}

    def paint(view: View, prior: Prior | None, rng: np.random.Generator) -> np.ndarray:
        content = contents.get(view.camera.name) or next(iter(contents.values()), None)
        if content and current.get("content") != str(content.content):
            _load(pipeline, content.content, "content")
            current["content"] = str(content.content)
        terms = _guidance(pipeline, job.diffusion, style, content)
        return paint_view(pipeline, job.diffusion, view, prior, rng, picture, terms)

    return paint


def _load(pipeline: Any, path: Path, half: Any, name: str | None = None) -> None:
    from mistyle.stylization.diffusion.consislora import load_half

    load_half(pipeline, path, name or half, half)


def _pipeline(job: DiffusionJob) -> tuple[Any, list[Any]]:
    """SDXL with its ControlNets on the device, and the style picture's IP-Adapter embedding, if used."""
    from diffusers.pipelines.controlnet.pipeline_controlnet_sd_xl import StableDiffusionXLControlNetPipeline

    from mistyle.stylization.models.load import add_ip_adapter, base_parts, controlnets, device_of, precision_of, settle

    device = device_of(job.models)
    dtype = precision_of(job.models, device)
    place, controls = _places(job.models, job.diffusion)
    parts = base_parts(place, "sdxl", dtype, job.models.checkpoint, job.models.prediction)
    pipeline = StableDiffusionXLControlNetPipeline(
        **parts, controlnet=controlnets(controls, dtype), add_watermarker=False
    )
    picture: list[Any] = []
    if job.diffusion.adapter == "ip":
        ip, name = models.find("ip-adapter", job.models.folder), LOOSE_NEEDED["sdxl"]
        # InstantStyle's block of SDXL, also the style LoRA's.
        scale = {"up": {"block_0": [0.0, job.diffusion.adapter_scale, 0.0]}}
        picture = [e.to(device) for e in add_ip_adapter(pipeline, ip, name, job.style, scale, device)]
    return settle(pipeline, job.models, device), picture


def _guidance(pipeline: Any, chosen: DiffusionSettings, style: LoraPair | None, content: LoraPair | None) -> list[Any]:
    """ConsisLoRA's guidance terms (its section 4.3), if enabled: each half against the other picture's same half."""
    terms: list[Any] = []
    if style is None or content is None or not (chosen.content_guidance or chosen.style_guidance):
        return terms
    _load(pipeline, style.content, "content", "other_content")
    _load(pipeline, content.style, "style", "other_style")
    c, v = chosen.subject, chosen.look
    if chosen.content_guidance:
        sides = ({"content": 1.0}, f"a {c}"), ({"other_content": 1.0}, f"a {v}")
        terms.append((chosen.content_guidance, *sides))
    if chosen.style_guidance:
        sides = ({"style": 1.0}, f"in the style of {v}"), ({"other_style": 1.0}, f"in the style of {c}")
        terms.append((chosen.style_guidance, *sides))
    return terms


def paint_view(
    pipeline: Any,
    chosen: DiffusionSettings,
    view: View,
    prior: Prior | None,
    rng: np.random.Generator,
    picture: Sequence[Any] = (),
    terms: Sequence[Any] = (),
) -> Float[np.ndarray, "h w 3"]:
    """One view: the sampler over the network, N steps for the first view, N x r and a refinement for later ones."""
    import torch

    from mistyle.stylization.diffusion import denoiser as d
    from mistyle.stylization.diffusion.repaint import Resampling, sample

    size = d.fitting_size(view.camera.size, d.grain(pipeline))
    device, factor = pipeline._execution_device, pipeline.vae_scale_factor
    conditioning = _conditioning(pipeline, chosen, view, size, picture)
    prompts = {p: _text(pipeline, p) for _, *sides in terms for _, p in sides}
    denoise = d.denoiser(pipeline, conditioning, terms, prompts)
    levels = d.noise_levels(pipeline.scheduler, chosen.steps)
    generator = torch.Generator("cpu").manual_seed(int(rng.integers(2**63)))
    if prior is None or not prior.known.any():
        shape = (1, pipeline.unet.config.in_channels, size[0] // factor, size[1] // factor)
        # The refinement smooths the border between known and new pixels; a first view has none.
        like = torch.zeros(shape, device=device)
        latent = sample(denoise, None, None, levels, Resampling(refine=0.0), rng=generator, like=like)
    else:
        known, mask = d.prior_latent(pipeline.vae, prior, size, factor)
        known, mask = known.to(device), mask.to(device)
        resampling = Resampling(chosen.block, chosen.repeats, chosen.refinement)
        latent = sample(denoise, known, mask, levels, resampling, rng=generator)
    painted = d.decode(pipeline.vae, latent)
    return linear_from_srgb(resize(painted, view.camera.size))


def _text(pipeline: Any, prompt: str, negative: bool = False) -> tuple[Any, Any]:
    """Embeddings of a prompt; with `negative` the empty prompt's come first."""
    import torch

    text, empty, pooled, pooled_empty = pipeline.encode_prompt(prompt, do_classifier_free_guidance=negative)
    return (torch.cat([empty, text]), torch.cat([pooled_empty, pooled])) if negative else (text, pooled)


def _conditioning(
    pipeline: Any, chosen: DiffusionSettings, view: View, size: tuple[int, int], picture: Sequence[Any]
) -> Any:
    import torch

    from mistyle.stylization.diffusion.denoiser import Conditioning, conditions, tensor_of

    device, dtype = pipeline._execution_device, pipeline.unet.dtype
    text, pooled = _text(pipeline, prompt_of(chosen), negative=True)
    adapters: Mapping[str, float] = {
        name: 1.0 for name in ("content", "style") if name in getattr(pipeline.unet, "peft_config", {})
    }
    pictures = [tensor_of(p).repeat(2, 1, 1, 1).to(device, dtype) for p in conditions(view, size)]
    sizes = torch.tensor([[*size, 0, 0, *size]] * 2, device=device, dtype=dtype)
    scales = (chosen.depth, chosen.canny)
    return Conditioning(text, pooled, sizes, pictures, scales, picture, adapters, chosen.guidance)
