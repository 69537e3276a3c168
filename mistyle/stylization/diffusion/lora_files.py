"""Trained LoRA files: one training for each picture, prompt token, settings, seed and base model."""

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from mistyle.core.errors import UsageError
from mistyle.core.names import ASSET, cut
from mistyle.io.store.atomic import digest
from mistyle.stylization.diffusion.settings import ModelSettings, TrainSettings
from mistyle.stylization.models import check as models_check
from mistyle.stylization.models import folder as models

NETWORKS = ("unet", "vae", "text_encoder", "text_encoder_2")
STEPS_A_SECOND = (2.0, 4.0)  # of a 1024² picture on a recent GPU; an estimate, not measured here


Kind = Literal["content", "style"]


@dataclass(frozen=True)
class TrainingImage:
    """A training picture (sRGB), the name of its LoRA files, and its prompt token (`word`)."""

    kind: Kind
    name: str
    rgb: Float[np.ndarray, "h w 3"]
    word: str


@dataclass(frozen=True)
class LoraPair:
    """The two LoRAs of one picture; the half of the other kind is only for ConsisLoRA's guidance."""

    content: Path
    style: Path

    def finished(self, key: str) -> tuple[bool, bool]:
        """Which of the two files (content, style) exists under this key."""
        from mistyle.stylization.diffusion.consislora import notes_of

        content, style = (p.is_file() and notes_of(p).get("mistyle_key") == key for p in (self.content, self.style))
        return content, style


def identity(settings: ModelSettings) -> str:
    """Fingerprint of the base model's weights."""
    if settings.checkpoint:
        return models.fingerprint([settings.checkpoint])
    place = models.find("sdxl", settings.folder)
    return models.fingerprint(file for name in NETWORKS for file in models.weights(place / name))


def lora_key(image: TrainingImage, training: TrainSettings, settings: ModelSettings, seed: int) -> str:
    """Key of all inputs that determine a LoRA's bits, except the machine."""
    # The checkpoint interval does not matter.
    numbers = training.model_dump(exclude={"save_every"})
    own = settings.model_dump(include={"precision", "prediction"})
    return digest([image.kind, np.float32(image.rgb), image.word, numbers, identity(settings), own, seed])


def paths(folder: Path, name: str, key: str) -> LoraPair:
    """Paths of a picture's LoRAs: its name, and the start of the key."""
    stem = f"{cut(re.sub(r'[^A-Za-z0-9._+-]+', '_', name), ASSET)}-{key[:10]}"
    return LoraPair(folder / f"{stem}.content.safetensors", folder / f"{stem}.style.safetensors")


def refuse_unknown(every: Sequence[LoraPair]) -> None:
    """UsageError for a file at a LoRA's path that mistyle did not train."""
    from mistyle.stylization.diffusion.consislora import notes_of

    for path in (p for pair in every for p in (pair.content, pair.style)):
        if path.exists() and not (path.is_file() and "mistyle_key" in notes_of(path)):
            raise UsageError(
                f"{path}: mistyle did not train this LoRA, and would replace it. Choose another folder with -o "
                "(--loras of stylize), or move it away"
            )


def steps_left(kind: Kind, pair: LoraPair, key: str, training: TrainSettings) -> int:
    """Remaining training steps of a picture; ignores checkpoints within a phase."""
    content, style = pair.finished(key)
    if kind == "content":
        return 0 if content and style else training.steps
    return (0 if content else training.steps) + (0 if style and content else training.style_steps)


def forecast(steps: int, resolution: int) -> str:
    """The estimate of training time, reported before it starts."""
    if steps == 0:
        return "all LoRAs exist, nothing is trained"
    slow, fast = (steps / rate * (resolution / 1024) ** 2 / 3600 for rate in STEPS_A_SECOND)
    span = f"{fast:.1f} to {slow:.1f} hours" if slow >= 1 else f"{60 * fast:.0f} to {60 * slow:.0f} minutes"
    return f"{steps:,} training steps: about {span} on a recent GPU (estimate: 2 to 4 steps a second at 1024²)"


def check(settings: ModelSettings, training: TrainSettings) -> None:
    """Refuse a training that cannot run, before anything is loaded: packages, files, architecture, memory."""
    models.need_extra()
    from mistyle.stylization.models.load import device_of, precision_of

    place = models.find("sdxl", settings.folder, weightless=NETWORKS if settings.checkpoint else ())
    models_check.base(place, "sdxl", 4)
    if settings.checkpoint:
        models_check.checkpoint(settings.checkpoint, place)
    device = device_of(settings)
    width = precision_of(settings, device).itemsize
    folders = [place / name for name in NETWORKS]
    needed = models_check.need("sdxl", folders, training.resolution**2, width, False, settings.checkpoint)
    models_check.memory(f"training at {training.resolution}²", needed, settings.memory, device, offload=True)


def trainer(settings: ModelSettings) -> Any:
    """SDXL for training: a pipeline without ControlNets on its device, all weights frozen."""
    from diffusers.pipelines.stable_diffusion_xl.pipeline_stable_diffusion_xl import StableDiffusionXLPipeline

    from mistyle.stylization.models.load import base_parts, device_of, precision_of

    device = device_of(settings)
    weightless = NETWORKS if settings.checkpoint else ()
    place = models.find("sdxl", settings.folder, weightless=weightless)
    parts = base_parts(place, "sdxl", precision_of(settings, device), settings.checkpoint, settings.prediction)
    pipeline = StableDiffusionXLPipeline(**parts, add_watermarker=False)
    pipeline.set_progress_bar_config(disable=True)
    return pipeline.to(device)


def make(
    pipeline: Any,
    image: TrainingImage,
    pair: LoraPair,
    key: str,
    training: TrainSettings,
    seed: int,
    watch: Callable[[int, int, float], None] = lambda step, steps, loss: None,
) -> list[float]:
    """Train and write a picture's missing LoRAs; returns the noise errors of the steps run."""
    from mistyle.stylization.diffusion import consislora
    from mistyle.stylization.diffusion.lora_training import (
        Checkpoint,
        joint_phase,
        run_phase,
        style_phase,
        training_example,
    )

    kind, rgb, word = image.kind, image.rgb, image.word
    notes = {"mistyle_key": key, "mistyle_kind": kind, "prompt_word": word, "base_model": "SDXL", "seed": str(seed)}
    content, style = pair.finished(key)
    unet, left = pipeline.unet, steps_left(kind, pair, key, training)
    state = pair.content.with_name(f"{pair.content.name.removesuffix('.content.safetensors')}.training.safetensors")
    done, errors = 0, []

    def note(step: int, steps: int, loss: float) -> None:
        watch(done + step, left, loss)

    try:
        if not content or (kind == "content" and not style):
            phase = joint_phase(word, training)
            example = training_example(pipeline, rgb, phase.prompt, training.resolution, seed)
            for half in phase.trained:
                consislora.add_half(unet, half, training.rank, seed + (half == "style"))
            errors += run_phase(pipeline, example, phase, training, seed, Checkpoint(state, key + phase.name), note)
            if kind == "content":
                consislora.save_half(pair.style, unet, "style", notes)
            consislora.save_half(pair.content, unet, "content", notes)
            unet.delete_adapters(list(phase.trained))
            done += phase.steps
            style = kind == "content"
        if not style:
            phase = style_phase(word, training)
            example = training_example(pipeline, rgb, phase.prompt, training.resolution, seed)
            consislora.put_half(unet, "content", pair.content)
            consislora.add_half(unet, "style", training.rank, seed + 2)
            errors += run_phase(pipeline, example, phase, training, seed, Checkpoint(state, key + phase.name), note)
            consislora.save_half(pair.style, unet, "style", notes)
    finally:
        loaded = [name for name in ("content", "style") if name in getattr(unet, "peft_config", {})]
        if loaded:
            unet.delete_adapters(loaded)
    return errors


@dataclass(frozen=True)
class LoraFolder:
    """A folder of LoRAs; without `overwrite`, files that mistyle did not train are refused."""

    path: Path
    overwrite: bool = False


def make_all(
    settings: ModelSettings,
    images: Sequence[TrainingImage],
    folder: LoraFolder,
    training: TrainSettings,
    seed: int,
    say: Callable[[str], None],
    watch: Callable[[int, int, float], None] = lambda step, steps, loss: None,
) -> list[LoraPair]:
    """LoRAs of several pictures; trains the missing ones in this order.

    Reports the estimated time before anything is loaded; loads nothing if all exist.
    """
    keys = [lora_key(image, training, settings, seed) for image in images]
    loras = [paths(folder.path, image.name, key) for image, key in zip(images, keys, strict=True)]
    if not folder.overwrite:
        refuse_unknown(loras)
    left = [steps_left(image.kind, pair, key, training) for image, pair, key in zip(images, loras, keys, strict=True)]
    say(f"LoRAs: {forecast(sum(left), training.resolution)}")
    if not any(left):
        return loras
    check(settings, training)
    pipeline = trainer(settings)
    done = 0
    for image, pair, key, steps in zip(images, loras, keys, left, strict=True):
        if steps:

            def note(step: int, steps: int, loss: float, before: int = done) -> None:
                watch(before + step, sum(left), loss)

            make(pipeline, image, pair, key, training, seed, note)
            done += steps
    device = pipeline.device.type
    del pipeline
    models_check.empty(device)
    return loras
