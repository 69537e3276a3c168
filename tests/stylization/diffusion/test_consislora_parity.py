"""Parity with ConsisLoRA's published training, re-derived here from its description in the paper and its own order of
steps, with diffusers' DDPM scheduler and torch's schedule of rates; and LoRA files in the layouts of others."""

import json

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file

from mistyle.core.errors import EnvironmentMissing
from mistyle.stylization.diffusion import consislora
from mistyle.stylization.diffusion import lora_files as consislora_make
from mistyle.stylization.diffusion import lora_training as consislora_train
from mistyle.stylization.diffusion.settings import ModelSettings, TrainSettings
from mistyle.stylization.models import check as models_check
from tests.support import tiny_models

torch.set_num_threads(1)
SETTINGS = TrainSettings(rank=4, steps=24, style_steps=6, switch=12, resolution=16)


@pytest.fixture(scope="module")
def pipeline():
    return consislora_make.trainer(ModelSettings(folder=tiny_models.folder(), device="cpu"))


def published(unet, scheduler, shown, phase, settings, draws) -> None:
    """One run as the original trains: the noise's loss up to the switch, then that of the picture which the scheduler's
    own step expects; the rate falls at the switch; gradients are not limited."""
    trained = [p for half in phase.trained for p in consislora.parameters(unet, half).values()]
    optimiser = torch.optim.AdamW(trained, lr=phase.rate, betas=(0.9, 0.999), weight_decay=1e-4, eps=1e-8)
    factor = phase.later_rate / phase.rate
    rates = torch.optim.lr_scheduler.LambdaLR(optimiser, lambda step: 1.0 if step < phase.switch else factor)
    for step, (level, noise) in enumerate(draws):
        levels = torch.tensor([level])
        zt = scheduler.add_noise(shown.z0, noise, levels)
        more = {"text_embeds": shown.pooled, "time_ids": shown.sizes}
        said = unet(zt, levels, shown.text, added_cond_kwargs=more).sample
        if step < phase.switch:
            loss = torch.nn.functional.mse_loss(said.float(), noise.float())
        else:
            expected = scheduler.step(said, levels, zt).pred_original_sample
            loss = torch.nn.functional.mse_loss(expected.float(), shown.z0.float())
        loss.backward()
        optimiser.step()
        rates.step()
        optimiser.zero_grad()


@pytest.mark.parametrize("kind", ["joint", "style"])
def test_training_walks_the_published_path(pipeline, kind):
    """24 steps across the switch from noise to picture, and stage 2 with its noise offset over a frozen half."""
    from diffusers import DDPMScheduler

    scheduler = DDPMScheduler.from_pretrained(tiny_models.folder() / "sdxl" / "scheduler", clip_sample=False)
    scheduler.set_timesteps(1000)
    word = "[c]" if kind == "joint" else "[v]"
    make = consislora_train.joint_phase if kind == "joint" else consislora_train.style_phase
    phase, picture = make(word, SETTINGS), np.random.default_rng(0).random((20, 16, 3)).astype(np.float32)
    shown = consislora_train.training_example(pipeline, picture, phase.prompt, 16, 0)
    draws = [consislora_train.step_noise(phase, shown.z0.shape, 5, k, 1000) for k in range(phase.steps)]
    ends = []
    for ours in (True, False):
        for half in consislora.BLOCKS:
            consislora.add_half(pipeline.unet, half, 4, 7)
        if ours:
            consislora_train.run_phase(pipeline, shown, phase, SETTINGS, 5)
        else:
            scales = {half: 1.0 for half in (*phase.frozen, *phase.trained)}
            consislora.activate(pipeline.unet, scales, phase.trained)
            published(pipeline.unet, scheduler, shown, phase, SETTINGS, draws)
        halves = consislora.BLOCKS
        ends.append({n: p.detach().clone() for h in halves for n, p in consislora.parameters(pipeline.unet, h).items()})
        pipeline.unet.delete_adapters(list(halves))
    moved = [float((v - ends[0][n]).abs().max()) for n, v in ends[1].items()]
    assert len(moved) == 64 and max(moved) < 2e-5, "the rate alone moves a weight by 1e-4 a step"
    assert any("lora_B" in n and v.abs().max() > 3e-4 for n, v in ends[0].items())


def test_gradients_are_unlimited_unless_asked(pipeline, monkeypatch):
    """The original's limit is handed an iterator that the optimiser has used up, and so limits nothing."""
    limits = []
    monkeypatch.setattr(torch.nn.utils, "clip_grad_norm_", lambda values, limit: limits.append(limit))
    picture = np.random.default_rng(0).random((16, 16, 3)).astype(np.float32)
    phase = consislora_train.LoraPhase("joint", "A [c]", 1, ("content",))
    shown = consislora_train.training_example(pipeline, picture, phase.prompt, 16, 0)
    for clip in (0.0, 1.0):
        consislora.add_half(pipeline.unet, "content", 4, 7)
        consislora_train.run_phase(pipeline, shown, phase, SETTINGS.model_copy(update={"clip": clip}), 5)
        pipeline.unet.delete_adapters(["content"])
    assert TrainSettings().clip == 0 and limits == [1.0]


def test_velocity_networks_learn_the_same_picture():
    """What follows from the velocity is what follows from the noise: both losses, at every level."""
    z0, noise, error = (torch.randn(1, 4, 8, 8, dtype=torch.float64) for _ in range(3))
    for alpha in (torch.tensor(a, dtype=torch.float64) for a in (0.99, 0.5, 0.01)):
        zt = consislora.noisy(z0, noise, alpha)
        eps = noise + error
        v = (eps - (1 - alpha).sqrt() * zt) / alpha.sqrt()
        exact = ((1 - alpha) / alpha) * torch.mean(error**2)
        assert float(consislora.x0_loss(v, z0, zt, alpha, "v_prediction")) == pytest.approx(float(exact), rel=1e-4)
        wanted = consislora.velocity(z0, noise, alpha)
        assert float(torch.mean((v - wanted) ** 2)) == pytest.approx(float(torch.mean(error**2) / alpha), rel=1e-9)


LAYOUTS = ["processor", "peft", "lora", "kohya", "doubled"]


def renamed(tensors: dict, layout: str) -> dict:
    """The style half as other programs write it."""
    found = {}
    for name, value in tensors.items():
        module, part = name.removeprefix("unet.").replace(".processor", "").rsplit("_lora.", 1)
        module = module + ".0" if module.endswith("to_out") else module
        kind = part.removesuffix(".weight")
        if layout == "processor":
            found[name] = value
        elif layout == "doubled":
            found[f"unet.{name}"] = value
        elif layout == "peft":
            found[f"unet.{module}.lora_{'A' if kind == 'down' else 'B'}.weight"] = value
        elif layout == "lora":
            found[f"unet.{module}.lora.{kind}.weight"] = value
        else:
            flat = f"lora_unet_{module.replace('.', '_')}"
            found[f"{flat}.lora_{kind}.weight"] = value
            found[f"{flat}.alpha"] = torch.tensor(float(value.shape[0 if kind == "down" else 1]))
    return found


@pytest.mark.parametrize("layout", LAYOUTS)
def test_every_layout_of_a_style_lora_says_the_same(pipeline, tmp_path, layout):
    consislora.add_half(pipeline.unet, "style", 4, 3)
    torch.manual_seed(0)
    for name, value in consislora.parameters(pipeline.unet, "style").items():
        if "lora_B" in name:
            torch.nn.init.normal_(value.data, std=0.3)
    consislora.save_half(tmp_path / "ours.safetensors", pipeline.unet, "style", {})
    z = torch.randn(1, 4, 8, 8, generator=torch.Generator().manual_seed(1))
    more = {"text_embeds": torch.ones(1, 32), "time_ids": torch.full((1, 6), 16.0)}

    def says() -> torch.Tensor:
        with torch.no_grad():
            return pipeline.unet(z, 300, encoder_hidden_states=torch.ones(1, 7, 64), added_cond_kwargs=more).sample

    wanted = says()
    pipeline.unet.delete_adapters(["style"])
    assert (says() - wanted).abs().max() > 1e-3
    save_file(renamed(load_file(tmp_path / "ours.safetensors"), layout), tmp_path / "theirs.safetensors")
    models_check.lora(tmp_path / "theirs.safetensors", pipeline.unet.config)
    consislora.load_half(pipeline, tmp_path / "theirs.safetensors", "style", "style")
    found = says()
    pipeline.delete_adapters("style")
    torch.testing.assert_close(found, wanted, atol=1e-5, rtol=1e-4)


# What the published configurations say where mistyle reads them; the rest of their keys does not matter to it.
PUBLISHED = {
    "sdxl/unet": {
        "_class_name": "UNet2DConditionModel",
        "in_channels": 4,
        "out_channels": 4,
        "addition_embed_type": "text_time",
        "cross_attention_dim": 2048,
        "block_out_channels": [320, 640, 1280],
    },
    "sdxl/vae": {"_class_name": "AutoencoderKL", "latent_channels": 4, "force_upcast": True, "scaling_factor": 0.13025},
    "sdxl/text_encoder": {"hidden_size": 768},
    "sdxl/text_encoder_2": {"hidden_size": 1280},
    "sdxl/scheduler": {"_class_name": "EulerDiscreteScheduler", "prediction_type": "epsilon", "steps_offset": 1},
    "inpaint/unet": {
        "_class_name": "UNet2DConditionModel",
        "in_channels": 9,
        "out_channels": 4,
        "cross_attention_dim": 768,
        "block_out_channels": [320, 640, 1280, 1280],
    },
    "inpaint/vae": {"_class_name": "AutoencoderKL", "latent_channels": 4},
    "inpaint/text_encoder": {"hidden_size": 768},
    "inpaint/scheduler": {"_class_name": "PNDMScheduler", "skip_prk_steps": True, "clip_sample": False},
    "depth": {
        "_class_name": "ControlNetModel",
        "addition_embed_type": "text_time",
        "cross_attention_dim": 2048,
        "block_out_channels": [320, 640, 1280],
    },
    "position": {
        "_class_name": "ControlNetModel",
        "cross_attention_dim": 768,
        "block_out_channels": [320, 640, 1280, 1280],
    },
}


@pytest.fixture
def configurations(tmp_path):
    for name, values in PUBLISHED.items():
        file = "scheduler_config.json" if name.endswith("scheduler") else "config.json"
        (tmp_path / name).mkdir(parents=True)
        (tmp_path / name / file).write_text(json.dumps(values))
    return tmp_path


def test_published_configurations_are_taken(configurations):
    unet = models_check.base(configurations / "sdxl", "sdxl", 4)
    models_check.controlnet(configurations / "depth", unet, "SDXL")
    small = models_check.base(configurations / "inpaint", "sd15", 9)
    models_check.controlnet(configurations / "position", small, "Stable Diffusion 1.5")
    for wrong, base in (("depth", small), ("position", unet)):
        with pytest.raises(EnvironmentMissing, match="expected"):
            models_check.controlnet(configurations / wrong, base, "that")
    with pytest.raises(EnvironmentMissing, match="in_channels is 9, expected 4"):
        models_check.base(configurations / "inpaint", "sd15", 4)


def test_published_schedules_give_the_samplers_that_are_meant(configurations):
    from diffusers import DDIMScheduler

    from mistyle.stylization.inpaint import paint3d
    from mistyle.stylization.models import load as models_load

    found = models_load.schedule(configurations / "sdxl", None, "auto").config
    assert (found.timestep_spacing, found.prediction_type) == ("trailing", "epsilon")
    ddim = DDIMScheduler.from_pretrained(
        configurations / "inpaint" / "scheduler", **paint3d.RECIPES["inpaint"].sampling
    )
    assert ddim.config.clip_sample is False and ddim.config.prediction_type == "epsilon"
