"""SDXL with ControlNets as a denoiser in the sampler's coordinates; encoding and decoding of pictures.

The sampler (`stylization/diffusion/repaint.py`) works on unscaled latents, the clean latent plus sigma times noise. The
network takes x / sqrt(sigma^2 + 1) and a time step.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float

from mistyle.core.image import canny, nearest_fill, resize, srgb_from_linear
from mistyle.core.view import Prior, View
from mistyle.io.cameras.views import paper_depth

# Extra guidance terms: (weight, positive adapters and prompt, negative adapters and prompt).
Term = tuple[float, tuple[Mapping[str, float], str], tuple[Mapping[str, float], str]]


@dataclass(frozen=True)
class Conditioning:
    """The network's conditioning for a view; batch entry 0 is the empty prompt, entry 1 the real one.

    text, pooled   (2, n, d) and (2, p); `sizes` SDXL's (2, 6)
    conditions     depth and Canny pictures, each (2, 3, h, w) in 0..1, with `scales`
    picture        image embeddings of an IP-Adapter: [(2, 1, d)], or empty
    adapters       LoRAs active in the main pass, with their scales
    """

    text: torch.Tensor
    pooled: torch.Tensor
    sizes: torch.Tensor
    conditions: Sequence[torch.Tensor]
    scales: Sequence[float]
    picture: Sequence[torch.Tensor]
    adapters: Mapping[str, float]
    guidance: float


def noise_levels(scheduler: Any, steps: int) -> list[float]:
    """Noise levels of a schedule of `steps` steps, falling to 0."""
    scheduler.set_timesteps(steps)
    return [float(s) for s in scheduler.sigmas]


def time_step(scheduler: Any, sigma: float) -> float:
    """The time step of noise level sigma; linear in sigma between trained levels, as in Euler's scheduler."""
    alphas = scheduler.alphas_cumprod.double().cpu().numpy()
    at = float(np.interp(sigma, np.sqrt((1 - alphas) / alphas), np.arange(len(alphas))))
    return float(round(at)) if abs(at - round(at)) < 1e-3 else at


def grain(pipeline: Any) -> int:
    """Pixels; a picture's sides must be multiples of it."""
    return pipeline.vae_scale_factor * 2 ** (len(pipeline.unet.config.block_out_channels) - 1)


def fitting_size(size: tuple[int, int], multiple: int) -> tuple[int, int]:
    """The sides (height, width) rounded up to multiples."""
    height, width = (-(-side // multiple) * multiple for side in size)
    return height, width


def conditions(view: View, size: tuple[int, int]) -> list[Float[np.ndarray, "h w 3"]]:
    """Depth (near white, background black) and Canny edges of a rendered view, in the ControlNets' training format."""
    depth = paper_depth(view.depth)
    edges = canny(srgb_from_linear(view.rgb)).astype(np.float32)
    return [np.repeat(resize(np.asarray(p, np.float32), size)[..., None], 3, axis=-1) for p in (depth, edges)]


def tensor_of(rgb: Float[np.ndarray, "h w c"]) -> Float[torch.Tensor, "1 c h w"]:
    """A picture as a network input."""
    return torch.from_numpy(np.ascontiguousarray(rgb, np.float32)).permute(2, 0, 1)[None]


def encode(vae: Any, encoded: Float[np.ndarray, "h w 3"]) -> Float[torch.Tensor, "1 c h2 w2"]:
    """The latent of an sRGB picture: the posterior's mode, scaled, float32."""
    with torch.no_grad():
        return vae.encode(tensor_of(encoded) * 2 - 1).latent_dist.mode().float() * vae.config.scaling_factor


def decode(vae: Any, latent: Float[torch.Tensor, "1 c h w"]) -> Float[np.ndarray, "h2 w2 3"]:
    """The sRGB picture of a latent, 0..1."""
    with torch.no_grad():
        picture = vae.decode(latent / vae.config.scaling_factor).sample
    return (picture[0].permute(1, 2, 0).float().cpu().numpy() / 2 + 0.5).clip(0, 1).astype(np.float32)


def prior_latent(
    vae: Any, prior: Prior, size: tuple[int, int], factor: int
) -> tuple[Float[torch.Tensor, "1 c h w"], Float[torch.Tensor, "1 1 h w"]]:
    """The prior's latent and the mask of its known cells: those whose pixels are all known (min-pooling).

    Known colours are first extended into the unknown area: the encoder's receptive field crosses cells, and black
    there would leak into the pinned border.
    """
    filled = nearest_fill(prior.rgb, prior.known)
    latent = encode(vae, srgb_from_linear(resize(filled, size)))
    known = resize(prior.known.astype(np.float32), size) > 1 - 1e-6
    return latent, torch.from_numpy(pooled(known, factor).astype(np.float32))[None, None].to(latent.device)


def pooled(known: Bool[np.ndarray, "h w"], factor: int) -> Bool[np.ndarray, "h2 w2"]:
    """Cells of `factor` x `factor` pixels whose pixels are all known."""
    height, width = known.shape
    return np.asarray(known.reshape(height // factor, factor, width // factor, factor).all(axis=(1, 3)))


def denoiser(
    pipeline: Any, conditioning: Conditioning, terms: Sequence[Term] = (), prompts: Mapping[str, Any] | None = None
) -> Callable[[torch.Tensor, float], torch.Tensor]:
    """(latent, sigma) -> the network's estimate of the clean latent, with classifier-free guidance.

    `terms` add ConsisLoRA's guidance, each with two more passes; `prompts` holds their prompts' embeddings.
    """
    unet, dtype = pipeline.unet, pipeline.unet.dtype
    activate(pipeline, conditioning.adapters)

    def denoise(x: torch.Tensor, sigma: float) -> torch.Tensor:
        scaled = (x / (sigma**2 + 1) ** 0.5).to(dtype)
        time = torch.tensor(time_step(pipeline.scheduler, sigma), device=x.device)
        both = torch.cat([scaled, scaled])
        more: dict[str, Any] = {"text_embeds": conditioning.pooled, "time_ids": conditioning.sizes}
        with torch.no_grad():
            down, middle = pipeline.controlnet(
                both,
                time,
                encoder_hidden_states=conditioning.text,
                controlnet_cond=list(conditioning.conditions),
                conditioning_scale=list(conditioning.scales),
                added_cond_kwargs=more,
                return_dict=False,
            )
            if conditioning.picture:
                more = more | {"image_embeds": list(conditioning.picture)}
            output = unet(
                both,
                time,
                encoder_hidden_states=conditioning.text,
                added_cond_kwargs=more,
                down_block_additional_residuals=down,
                mid_block_additional_residual=middle,
                return_dict=False,
            )[0].float()
            nothing, something = output.chunk(2)
            guided = nothing + conditioning.guidance * (something - nothing)
            if terms:
                residuals = [d[1:] for d in down], middle[1:]
                guided = guided + _terms(pipeline, terms, prompts or {}, scaled, time, conditioning, residuals)
        return clean(pipeline.scheduler.config.prediction_type, guided, x, sigma)

    return denoise


def clean(prediction: str, output: torch.Tensor, x: torch.Tensor, sigma: float) -> torch.Tensor:
    """The clean latent from the network's `output` for `x`: its noise, or its velocity."""
    if prediction == "v_prediction":
        return x / (sigma**2 + 1) - output * (sigma / (sigma**2 + 1) ** 0.5)
    return x - sigma * output


def activate(pipeline: Any, adapters: Mapping[str, float]) -> None:
    """Activate only these LoRAs."""
    if adapters:
        pipeline.unet.enable_adapters()
        pipeline.unet.set_adapters(list(adapters), list(adapters.values()))
    elif getattr(pipeline.unet, "peft_config", None):
        pipeline.unet.disable_adapters()


def _terms(
    pipeline: Any,
    terms: Sequence[Term],
    prompts: Mapping[str, tuple[torch.Tensor, torch.Tensor]],
    scaled: torch.Tensor,
    time: torch.Tensor,
    conditioning: Conditioning,
    residuals: tuple[list[torch.Tensor], torch.Tensor],
) -> torch.Tensor:
    """The sum of weight x (output with one LoRA - output with its opposite), under the same ControlNets."""
    total = torch.zeros_like(scaled, dtype=torch.float32)
    for weight, *sides in terms:
        for sign, (adapters, prompt) in zip((1, -1), sides, strict=True):
            activate(pipeline, adapters)
            text, pooled_text = prompts[prompt]
            eps = pipeline.unet(
                scaled,
                time,
                encoder_hidden_states=text,
                added_cond_kwargs={"text_embeds": pooled_text, "time_ids": conditioning.sizes[:1]},
                down_block_additional_residuals=residuals[0],
                mid_block_additional_residual=residuals[1],
                return_dict=False,
            )[0].float()
            total += sign * weight * eps
    activate(pipeline, conditioning.adapters)
    return total
