"""Training of ConsisLoRA (paper 4.1.2): one picture, one latent, one prompt, new noise every step.

A content picture trains both halves together with "A [c]"; only the content half is used. A style picture does the same
with "A [v]" (stage 1). Stage 2 freezes that content half and trains a new style half on "An image in the style of [v]".
A step's noise depends only on seed, phase and step, so a killed training resumes from its last checkpoint with the same
bits.
"""

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from mistyle.core.errors import InputRefused, MistyleError, Stopped
from mistyle.core.image import resize
from mistyle.io.store.atomic import atomic_write
from mistyle.stylization.diffusion import consislora
from mistyle.stylization.diffusion.consislora import Half
from mistyle.stylization.diffusion.settings import TrainSettings

# (step, steps, loss / weight)
Watch = Callable[[int, int, float], None]


@dataclass(frozen=True)
class LoraPhase:
    """One run of the optimiser: trained halves, frozen active halves, prompt and loss schedule."""

    name: str
    prompt: str
    steps: int
    trained: tuple[Half, ...]
    frozen: tuple[Half, ...] = ()
    switch: int = 500
    rate: float = 2e-4
    later_rate: float = 1e-4
    noise_offset: float = 0.0


@dataclass(frozen=True)
class TrainingExample:
    """The network's constant inputs: latent, text, pooled text and SDXL's sizes; and its prediction type."""

    z0: Float[torch.Tensor, "1 c h w"]
    text: Float[torch.Tensor, "1 n d"]
    pooled: Float[torch.Tensor, "1 p"]
    sizes: Float[torch.Tensor, "1 6"]
    prediction: str = "epsilon"


def joint_phase(word: str, settings: TrainSettings) -> LoraPhase:
    """The phase of a content picture, or stage 1 of a style picture."""
    return LoraPhase(
        "joint",
        f"A {word}",
        settings.steps,
        ("content", "style"),
        switch=settings.switch,
        rate=settings.rate,
        later_rate=settings.later_rate,
    )


def style_phase(word: str, settings: TrainSettings) -> LoraPhase:
    """Stage 2 of a style picture: x0 loss from the first step, noise with an offset."""
    return LoraPhase(
        "style",
        f"An image in the style of {word}",
        settings.style_steps,
        ("style",),
        ("content",),
        switch=0,
        rate=settings.later_rate,
        later_rate=settings.later_rate,
        noise_offset=settings.noise_offset,
    )


def training_example(
    pipeline: Any, rgb: Float[np.ndarray, "h w 3"], prompt: str, resolution: int, seed: int
) -> TrainingExample:
    """Encode an sRGB picture and a prompt; the short side becomes `resolution` pixels, without cropping."""
    height, width = rgb.shape[:2]
    grain = pipeline.vae_scale_factor * 2 ** (len(pipeline.unet.config.block_out_channels) - 1)
    scale = resolution / min(height, width)
    size = (max(round(height * scale / grain), 1) * grain, max(round(width * scale / grain), 1) * grain)
    tensor = torch.from_numpy(resize(rgb.astype(np.float32), size)).permute(2, 0, 1)[None] * 2 - 1
    vae = pipeline.vae
    generator = torch.Generator("cpu").manual_seed(seed)
    with torch.no_grad():
        posterior = vae.encode(tensor).latent_dist
        noise = torch.randn(posterior.mean.shape, generator=generator).to(posterior.mean)
        z0 = (posterior.mean + posterior.std * noise) * vae.config.scaling_factor
        text, _, pooled, _ = pipeline.encode_prompt(prompt, do_classifier_free_guidance=False)
    sizes = torch.tensor([[height, width, 0, 0, *size]], dtype=torch.float32)
    return TrainingExample(z0.float(), text, pooled, sizes.to(z0.device), pipeline.scheduler.config.prediction_type)


def step_noise(
    phase: LoraPhase, shape: torch.Size, seed: int, step: int, levels: int
) -> tuple[int, Float[torch.Tensor, "b c h w"]]:
    """Noise level and noise of one step; the same on every device."""
    name = int.from_bytes(phase.name.encode()[:8], "big")
    state = np.random.SeedSequence([seed, name, step]).generate_state(1, np.uint64)[0]
    generator = torch.Generator("cpu").manual_seed(int(state) % 2**63)
    level = int(torch.randint(levels, (1,), generator=generator))
    noise = torch.randn(shape, generator=generator)
    if phase.noise_offset:
        noise = noise + phase.noise_offset * torch.randn((shape[0], shape[1], 1, 1), generator=generator)
    return level, noise


@dataclass(frozen=True)
class NoisyStep:
    """One step's noise, its level's index, and alpha_bar, the product of alphas up to it."""

    step: int
    level: int
    noise: Float[torch.Tensor, "b c h w"]
    alpha_bar: Float[torch.Tensor, ""]


def step_loss(
    unet: Any, example: TrainingExample, phase: LoraPhase, mode: str, at: NoisyStep
) -> tuple[torch.Tensor, float]:
    """The loss of one step, and the unweighted prediction error (loss / weight), which is comparable between steps."""
    noise, alpha_bar = at.noise, at.alpha_bar
    zt = consislora.noisy(example.z0, noise, alpha_bar)
    with consislora.below_without_gradients(unet):
        predicted = unet(
            zt.to(unet.dtype),
            torch.tensor([at.level], device=zt.device),
            encoder_hidden_states=example.text,
            added_cond_kwargs={"text_embeds": example.pooled, "time_ids": example.sizes.to(example.text.dtype)},
            return_dict=False,
        )[0]
    target = consislora.velocity(example.z0, noise, alpha_bar) if example.prediction == "v_prediction" else noise
    error = torch.mean((predicted.float() - target.float()) ** 2)
    if at.step < phase.switch:
        return error, float(error.detach())
    picture = consislora.x0_loss(predicted, example.z0, zt, alpha_bar, example.prediction)
    return (picture + error if mode == "sum" else picture), float(error.detach())


@dataclass(frozen=True)
class Checkpoint:
    """The checkpoint file of a training, and the key of the inputs that determine its bits."""

    path: Path
    key: str


def run_phase(
    pipeline: Any,
    example: TrainingExample,
    phase: LoraPhase,
    settings: TrainSettings,
    seed: int,
    checkpoint: Checkpoint | None = None,
    watch: Watch = lambda step, steps, loss: None,
) -> list[float]:
    """Train the phase's halves, which must exist as adapters of these names; returns each step's noise error.

    The checkpoint is written every `settings.save_every` steps and on a stop signal, resumed if its key matches, and
    removed at the end.
    """
    unet = pipeline.unet
    consislora.activate(unet, {half: 1.0 for half in (*phase.frozen, *phase.trained)}, phase.trained)
    named = {n: p for half in phase.trained for n, p in consislora.parameters(unet, half).items()}
    optimiser = torch.optim.AdamW(
        named.values(), lr=phase.rate, betas=(0.9, 0.999), eps=1e-8, weight_decay=settings.weight_decay
    )
    scaler = torch.amp.GradScaler(example.z0.device.type, enabled=unet.dtype == torch.float16)
    alphas = pipeline.scheduler.alphas_cumprod.to(example.z0.device)
    history = _take_up(checkpoint, named, optimiser, scaler)
    between = True
    try:
        for step in range(len(history), phase.steps):
            level, noise = step_noise(phase, example.z0.shape, seed, step, len(alphas))
            noise = noise.to(example.z0.device)
            loss, error = step_loss(
                unet, example, phase, settings.loss_mode, NoisyStep(step, level, noise, alphas[level])
            )
            between = False
            for group in optimiser.param_groups:
                group["lr"] = phase.rate if step < phase.switch else phase.later_rate
            scaler.scale(loss).backward()
            scaler.unscale_(optimiser)
            if settings.clip:
                torch.nn.utils.clip_grad_norm_(named.values(), settings.clip)
            scaler.step(optimiser)
            scaler.update()
            optimiser.zero_grad(set_to_none=True)
            history.append(error)
            between = True
            if not np.isfinite(error):
                raise MistyleError(
                    f"training diverged at step {step} (the loss is {error}); use --set models.precision=float32, or a "
                    "lower train.rate"
                )
            if checkpoint and (step + 1) % settings.save_every == 0 and step + 1 < phase.steps:
                _keep(checkpoint, named, optimiser, scaler, history)
            watch(step + 1, phase.steps, error)
    except (Stopped, KeyboardInterrupt):
        if checkpoint and between and history:
            _keep(checkpoint, named, optimiser, scaler, history)
        raise
    if checkpoint:
        checkpoint.path.unlink(missing_ok=True)
    return history


def _keep(checkpoint: Checkpoint, named: dict, optimiser: Any, scaler: Any, history: list[float]) -> None:
    """Write the checkpoint: weights, Adam's moments, losses so far."""
    from safetensors.torch import save_file

    tensors = {"history": torch.tensor(history, dtype=torch.float64)}
    if scaler.is_enabled():
        tensors["scale"] = torch.tensor([scaler.get_scale(), scaler.state_dict()["_growth_tracker"]])
    for name, parameter in named.items():
        tensors[f"weight:{name}"] = parameter.detach().cpu().contiguous()
        for moment, value in optimiser.state[parameter].items():  # empty while float16 steps are skipped
            tensors[f"{moment}:{name}"] = value.cpu().contiguous()
    about = {"mistyle": json.dumps({"key": checkpoint.key})}
    atomic_write(checkpoint.path, lambda path: save_file(tensors, path, about))


def _take_up(checkpoint: Checkpoint | None, named: dict, optimiser: Any, scaler: Any) -> list[float]:
    """Restore the checkpoint and return the losses of its steps; empty without a valid checkpoint."""
    from safetensors import SafetensorError
    from safetensors.torch import load_file

    if checkpoint is None or not checkpoint.path.is_file():
        return []
    try:
        if consislora.notes_of(checkpoint.path).get("key") != checkpoint.key:
            return []
        tensors = load_file(checkpoint.path)
    except (InputRefused, SafetensorError):
        return []
    history = tensors["history"].tolist()
    if "scale" in tensors:
        scale, tracker = tensors["scale"].tolist()
        scaler.load_state_dict(scaler.state_dict() | {"scale": scale, "_growth_tracker": int(tracker)})
    for name, parameter in named.items():
        parameter.data.copy_(tensors[f"weight:{name}"])
        moments = {m: tensors[f"{m}:{name}"] for m in ("step", "exp_avg", "exp_avg_sq") if f"{m}:{name}" in tensors}
        if moments:
            optimiser.state[parameter] = {m: v if m == "step" else v.to(parameter.device) for m, v in moments.items()}
    return history
