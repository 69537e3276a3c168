"""The paper's texture inpainter (4.3): Stable Diffusion 1.5 with Paint3D's UV-position ControlNet and an IP-Adapter.

It has the Inpainter signature of `stylization/inpaint/repair.py`, which applies the mask and blends its edge. Two
recipes: the inpainting UNet (the paper), and Paint3D's own, plain SD 1.5 with a second ControlNet for inpainting. It
never downloads weights. Full-size networks have not been run yet; the tests run every path on tiny random ones.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from mistyle.core.image import dilate, linear_from_srgb, resize, srgb_from_linear
from mistyle.core.maps import Texels
from mistyle.core.mesh import Mesh
from mistyle.stylization.diffusion.settings import ModelSettings, Paint3dSettings
from mistyle.stylization.inpaint import paint3d_plan as plan
from mistyle.stylization.inpaint.repair import Inpainter
from mistyle.stylization.models import check as models_check
from mistyle.stylization.models import folder as models
from mistyle.stylization.models.catalogue import ENCODER, LOOSE_NEEDED


@dataclass(frozen=True)
class Recipe:
    """Networks and default values of a recipe; a setting of 0 (or -1) takes the default."""

    base: str
    channels: int
    controls: tuple[str, ...]
    scales: tuple[float, ...]
    steps: int
    guidance: float
    style: float
    scheduler: str
    sampling: Mapping[str, Any] = field(default_factory=dict)


RECIPES = {
    # Latents exceed the -1..1 to which DDIM clips samples by default.
    "inpaint": Recipe("inpaint", 9, ("position",), (1.0,), 30, 4.0, 0.6, "DDIMScheduler", {"clip_sample": False}),
    "paint3d": Recipe(
        "sd15", 4, ("position", "inpaint-control"), (1.0, 0.5), 20, 3.0, 1.0, "EulerAncestralDiscreteScheduler"
    ),
}
DILATION = 7  # of Paint3D's mask: a window of 15 x 15 at 1024 pixels
TELEA = 3  # pixels; the radius of OpenCV's fill, Paint3D's start inside the mask


@dataclass(frozen=True)
class Brush:
    """The loaded pipeline with the inputs that all crops share."""

    pipeline: Any
    picture: list[Any]
    text: Any
    negative: Any
    recipe: Recipe
    settings: Paint3dSettings


def check(settings: ModelSettings, chosen: Paint3dSettings) -> None:
    """Refuse an inpainting that cannot run, before anything is rendered: packages, files, architectures, memory."""
    models.need_extra()
    from mistyle.stylization.models.load import device_of, precision_of

    recipe = RECIPES[chosen.recipe]
    place, controls, ip = _places(settings, recipe)
    unet = models_check.base(place, "sd15", recipe.channels)
    for control in controls:
        models_check.controlnet(control, unet, "Stable Diffusion 1.5")
    adapter = ip / LOOSE_NEEDED["sd15"]
    models_check.ip_adapter(adapter, ip / ENCODER, unet, "Stable Diffusion 1.5")
    device = device_of(settings)
    width = precision_of(own(settings, chosen), device).itemsize
    folders = [*(place / n for n in ("unet", "vae", "text_encoder")), *controls, ip / ENCODER]
    needed = models_check.need("sd15", folders, chosen.size**2, width, settings.offload)
    models_check.memory(f"inpainting {chosen.size}² texels", needed, settings.memory, device, settings.offload)


def _places(settings: ModelSettings, recipe: Recipe) -> tuple[Path, list[Path], Path]:
    place = models.find(recipe.base, settings.folder)
    controls = [models.find(name, settings.folder) for name in recipe.controls]
    return place, controls, models.find("ip-adapter", settings.folder, [LOOSE_NEEDED["sd15"]])


def own(settings: ModelSettings, chosen: Paint3dSettings) -> ModelSettings:
    """The models' settings with the inpainter's own precision."""
    return settings if chosen.precision == "same" else settings.model_copy(update={"precision": chosen.precision})


def identity(settings: ModelSettings, chosen: Paint3dSettings) -> list[str]:
    """Fingerprints of the recipe's networks, and their precision; paths and device do not matter."""
    place, controls, ip = _places(settings, RECIPES[chosen.recipe])
    folders = [*(place / n for n in ("unet", "vae", "text_encoder")), *controls, ip / ENCODER]
    files = [file for folder in folders for file in models.weights(folder)]
    return [models.fingerprint([*files, ip / LOOSE_NEEDED["sd15"]]), own(settings, chosen).precision]


def inpainter(
    mesh: Mesh, style: Float[np.ndarray, "h w 3"], settings: ModelSettings, chosen: Paint3dSettings
) -> Inpainter:
    """Load the networks and return the function that paints an atlas's holes; `style` is sRGB.

    Albedo in and out is linear. Outside the hole the output equals the input, bit for bit.
    """
    check(settings, chosen)
    brush = load(settings, chosen, style)
    centre, radius = plan.centre_and_radius(mesh)

    def paint(albedo: np.ndarray, hole: np.ndarray, texels: Texels, rng: np.random.Generator) -> np.ndarray:
        hole = hole & texels.covered
        if not hole.any():
            return albedo
        where = plan.position_map(texels, centre, radius, chosen.shape_scale, chosen.shape_height)
        encoded = paint_atlas(brush, srgb_from_linear(albedo), hole, texels, where, rng)
        result = albedo.copy()
        result[hole] = linear_from_srgb(encoded[hole])
        return result

    return paint


def load(settings: ModelSettings, chosen: Paint3dSettings, style: Float[np.ndarray, "h w 3"]) -> Brush:
    """The recipe's pipeline on its device."""
    import diffusers
    from diffusers.pipelines.controlnet.pipeline_controlnet_inpaint import StableDiffusionControlNetInpaintPipeline

    from mistyle.stylization.models.load import add_ip_adapter, base_parts, controlnets, device_of, precision_of, settle

    recipe = RECIPES[chosen.recipe]
    place, controls, ip = _places(settings, recipe)
    device = device_of(settings)
    dtype = precision_of(own(settings, chosen), device)
    nets = controlnets(controls, dtype)
    parts: dict[str, Any] = base_parts(place, "sd15", dtype) | {"safety_checker": None, "feature_extractor": None}
    parts["scheduler"] = getattr(diffusers, recipe.scheduler).from_pretrained(place / "scheduler", **recipe.sampling)
    parts["controlnet"] = nets if len(nets) > 1 else nets[0]
    pipeline = StableDiffusionControlNetInpaintPipeline(**parts, requires_safety_checker=False)
    scale = chosen.style if chosen.style >= 0 else recipe.style
    picture = add_ip_adapter(pipeline, ip, LOOSE_NEEDED["sd15"], style, scale, device)
    pipeline = settle(pipeline, settings, device)
    text, negative = pipeline.encode_prompt(
        chosen.prompt, device, 1, do_classifier_free_guidance=True, negative_prompt=chosen.negative
    )
    return Brush(pipeline, [p.to(device) for p in picture], text, negative, recipe, chosen)


def paint_atlas(
    brush: Brush,
    encoded: Float[np.ndarray, "h w 3"],
    hole: Bool[np.ndarray, "h w"],
    texels: Texels,
    where: Float[np.ndarray, "h w 3"],
    rng: np.random.Generator,
) -> Float[np.ndarray, "h w 3"]:
    """The atlas (sRGB) with the hole painted; only the hole's texels change.

    The first pass paints the whole at the model's size. For a larger atlas, a second pass repaints overlapping crops at
    full resolution, starting from the first.
    """
    grain = brush.pipeline.vae_scale_factor * 2 ** (len(brush.pipeline.unet.config.block_out_channels) - 1)
    side = brush.settings.size // grain * grain
    larger = max(hole.shape) > side
    size = (side, side) if larger else tuple(-(-n // grain) * grain for n in hole.shape)
    open_part = hole | ~texels.covered
    filled = plan.filled(encoded, hole, texels)
    mask = resize(open_part.astype(np.float32), size) > 1e-6  # where any texel of a pixel is open
    painted = inpaint(brush, plan.shrink(filled, size), mask, plan.sampled(where, size), 1.0, rng)
    result = plan.spread_islands(painted, texels, hole, filled)
    if not larger or brush.settings.detail == 0 or min(hole.shape) < side:
        return np.where(hole[..., None], result, encoded).astype(np.float32)
    detailed = _detailed(brush, np.where(hole[..., None], result, filled), hole, texels, where, side, rng)
    return np.where(hole[..., None], detailed, encoded)


def _detailed(
    brush: Brush,
    start: Float[np.ndarray, "h w 3"],
    hole: Bool[np.ndarray, "h w"],
    texels: Texels,
    where: Float[np.ndarray, "h w 3"],
    side: int,
    rng: np.random.Generator,
) -> Float[np.ndarray, "h w 3"]:
    """The second pass: crops of `side` texels that start from the first pass's colours, feathered at overlaps."""
    total = np.zeros((*hole.shape, 3), np.float32)
    share = np.zeros(hole.shape, np.float32)
    ramp = plan.feather(side, brush.settings.overlap)
    for row, column in plan.crops(hole, side, brush.settings.overlap):
        box = slice(row, row + side), slice(column, column + side)
        mask = hole[box] | ~texels.covered[box]
        painted = inpaint(brush, start[box], mask, where[box], brush.settings.detail, rng)
        total[box] += ramp[..., None] * painted
        share[box] += ramp
    return total / np.maximum(share, 1e-6)[..., None]


def inpaint(
    brush: Brush,
    encoded: Float[np.ndarray, "h w 3"],
    mask: Bool[np.ndarray, "h w"],
    where: Float[np.ndarray, "h w 3"],
    strength: float,
    rng: np.random.Generator,
) -> Float[np.ndarray, "h w 3"]:
    """One call of the model on a picture of its size (sRGB); all pixels of the result come from its decoder."""
    import torch

    from mistyle.stylization.diffusion.denoiser import tensor_of

    recipe, chosen = brush.recipe, brush.settings
    condition: Any = tensor_of(where)
    scales: Any = recipe.scales[0] * chosen.position
    if len(recipe.controls) > 1:
        mask = dilate(mask, max(round(DILATION * mask.shape[1] / 1024), 1))
        encoded = telea(encoded, mask) if strength == 1 else encoded
        condition = [condition, tensor_of(np.where(mask[..., None], -1, encoded))]
        scales = [scales, recipe.scales[1]]
    generator = torch.Generator("cpu").manual_seed(int(rng.integers(2**63)))
    answer = brush.pipeline(
        prompt_embeds=brush.text,
        negative_prompt_embeds=brush.negative,
        image=tensor_of(encoded),
        mask_image=tensor_of(mask[..., None].astype(np.float32)),
        control_image=condition,
        height=encoded.shape[0],
        width=encoded.shape[1],
        strength=strength,
        num_inference_steps=chosen.steps or recipe.steps,
        guidance_scale=chosen.guidance or recipe.guidance,
        controlnet_conditioning_scale=scales,
        ip_adapter_image_embeds=brush.picture or None,
        generator=generator,
        output_type="np",
    )
    return np.clip(answer.images[0], 0, 1).astype(np.float32)


def telea(encoded: Float[np.ndarray, "h w 3"], mask: Bool[np.ndarray, "h w"]) -> Float[np.ndarray, "h w 3"]:
    """Paint3D's initial picture: the mask filled by OpenCV's Telea inpainting."""
    import cv2

    if mask.all():
        return encoded
    picture = np.round(encoded * 255).astype(np.uint8)
    return (cv2.inpaint(picture, mask.astype(np.uint8), TELEA, cv2.INPAINT_TELEA) / 255).astype(np.float32)
