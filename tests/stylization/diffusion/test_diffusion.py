"""The diffusion stylizer on tiny random networks: each condition, the sampler's numbers, resuming, refusals."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from mistyle.core.camera import orbit
from mistyle.core.errors import EnvironmentMissing, InputRefused, Stopped, UsageError
from mistyle.core.view import Prior, View
from mistyle.stylization.diffusion import consislora
from mistyle.stylization.diffusion import denoiser as diffusion_denoise
from mistyle.stylization.diffusion import lora_files as consislora_make
from mistyle.stylization.diffusion import stylizer as diffusion
from mistyle.stylization.diffusion.settings import DiffusionSettings, ModelSettings, TrainSettings
from mistyle.stylization.models import folder as models
from mistyle.stylization.mvst.settings import SweepSettings
from mistyle.stylization.mvst.sweep import ViewPainter, ViewStore, sweep
from tests.support import tiny_models

torch.set_num_threads(1)
SIDE = 32
QUICK = DiffusionSettings(content="none", steps=4, block=2, repeats=2, refinement=0.25)
TRAINING = TrainSettings(rank=4, steps=3, style_steps=2, switch=2, resolution=16)


def view(azimuth: float = 0.0, size: tuple[int, int] = (SIDE, SIDE)) -> View:
    """A ball with stripes, by formula."""
    camera = orbit(azimuth, 0, distance=4, fov=30, size=size)
    y, x = (np.mgrid[: size[0], : size[1]] + 0.5) / size[0] * 2 - 1
    mask = x**2 + y**2 < 0.8
    height = np.sqrt(np.maximum(0.8 - x**2 - y**2, 0))
    depth = np.where(mask, 4 - height, np.inf).astype(np.float32)
    normal = np.where(mask[..., None], np.stack([x, -y, height], -1), 0).astype(np.float32)
    stripes = (np.sin(12 * x) > 0).astype(np.float32)
    rgb = np.where(mask[..., None], stripes[..., None] * [0.8, 0.5, 0.3] + 0.1, 0).astype(np.float32)
    share = mask.astype(np.float32)
    zero = np.zeros((*size, 2), np.float32)
    return View(camera, rgb, depth, normal, zero, np.where(mask, 0, -1), mask, share)


def picture(seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).random((24, 20, 3)).astype(np.float32)


def job(
    tmp_path: Path, chosen: DiffusionSettings = QUICK, style: np.ndarray | None = None, **more
) -> diffusion.DiffusionJob:
    settings = ModelSettings(**({"folder": tiny_models.folder(), "device": "cpu"} | more))
    return diffusion.DiffusionJob(
        settings, TRAINING, chosen, picture() if style is None else style, "wave", tmp_path, 0
    )


@pytest.fixture(scope="module")
def loras(tmp_path_factory) -> dict[str, Path]:
    """Two loud LoRAs for each half."""
    folder = tmp_path_factory.mktemp("loras")
    pipeline = consislora_make.trainer(ModelSettings(folder=tiny_models.folder(), device="cpu"))
    made = {}
    for half in consislora.BLOCKS:
        for seed in (1, 2):
            consislora.add_half(pipeline.unet, half, 4, seed)
            torch.manual_seed(seed)
            for name, value in consislora.parameters(pipeline.unet, half).items():
                if "lora_B" in name:
                    torch.nn.init.normal_(value.data, std=0.5)
            made[f"{half}{seed}"] = folder / f"{half}{seed}.safetensors"
            consislora.save_half(made[f"{half}{seed}"], pipeline.unet, half, {})
            pipeline.unet.delete_adapters([half])
    return made


@pytest.fixture(scope="module")
def pipeline(tmp_path_factory):
    made, _ = diffusion._pipeline(job(tmp_path_factory.mktemp("x")))
    return made


def paint(pipeline, chosen=QUICK, seen=None, prior=None, seed=0, pictures=(), terms=()):
    rng = np.random.default_rng(seed)
    return diffusion.paint_view(pipeline, chosen, seen or view(), prior, rng, pictures, terms)


def differs(a: np.ndarray, b: np.ndarray) -> bool:
    return bool(np.abs(a - b).max() > 1e-4)


def test_a_view_is_painted_and_the_seed_decides(pipeline):
    one, same, other = paint(pipeline), paint(pipeline), paint(pipeline, seed=1)
    assert one.shape == (SIDE, SIDE, 3) and one.dtype == np.float32 and 0 <= one.min() and one.max() <= 1
    assert np.array_equal(one, same) and differs(one, other)


@pytest.mark.parametrize("precision", ["bfloat16", "float16"])
def test_half_precision_paints_what_float32_paints(pipeline, loras, tmp_path, precision):
    made, _ = diffusion._pipeline(job(tmp_path, precision=precision))
    assert made.vae.dtype == torch.float32 and made.unet.dtype == getattr(torch, precision)
    short = QUICK.model_copy(update={"steps": 2, "repeats": 1})
    for prior in (None, half_prior()):
        seen, exact = paint(made, short, prior=prior), paint(pipeline, short, prior=prior)
        assert np.isfinite(seen).all() and np.abs(seen - exact).mean() < 0.05
    consislora.load_half(made, loras["style1"], "style", "style")
    assert np.isfinite(paint(made, short)).all()
    ip = short.model_copy(update={"adapter": "ip"})
    made, pictures = diffusion._pipeline(job(tmp_path, ip, precision=precision))
    assert np.isfinite(paint(made, ip, prior=half_prior(), pictures=pictures)).all()


def velocity_scheduler(**more):
    from diffusers import EulerDiscreteScheduler

    place = tiny_models.folder() / "sdxl" / "scheduler"
    return EulerDiscreteScheduler.from_pretrained(
        place, timestep_spacing="trailing", prediction_type="v_prediction", **more
    )


@pytest.mark.parametrize("zero_snr", [False, True])
def test_velocity_checkpoints_walk_diffusers_own_path(pipeline, monkeypatch, zero_snr):
    monkeypatch.setattr(pipeline, "scheduler", velocity_scheduler(rescale_betas_zero_snr=zero_snr))
    walks_as_diffusers(pipeline)
    assert pipeline.scheduler.sigmas[0] > (4000 if zero_snr else 14)


def test_single_files_say_that_they_predict_velocities(tmp_path):
    from safetensors.torch import save_file

    from mistyle.stylization.models import load as models_load

    place = tiny_models.folder() / "sdxl"
    for names, kind, zero in (((), "epsilon", False), (("v_pred", "ztsnr"), "v_prediction", True)):
        save_file({n: torch.zeros(1) for n in ("x", *names)}, tmp_path / "x.safetensors")
        found = models_load.schedule(place, tmp_path / "x.safetensors", "auto").config
        assert (found.prediction_type, found.rescale_betas_zero_snr) == (kind, zero)
    assert models_load.schedule(place, None, "v_prediction").config.prediction_type == "v_prediction"


def test_sizes_that_the_network_cannot_take_are_enlarged(pipeline):
    assert paint(pipeline, seen=view(size=(30, 30))).shape == (30, 30, 3)
    assert diffusion_denoise.fitting_size((1000, 1024), 32) == (1024, 1024)


@pytest.mark.parametrize("what", ["depth", "canny", "depth scale", "canny scale", "guidance", "prompt"])
def test_each_condition_alone_changes_the_picture(pipeline, what):
    base, chosen, seen = view(), QUICK, view()
    if what == "depth":
        bump = np.where(seen.mask, seen.depth + 0.3 * np.sin(9 * seen.normal[..., 0]), np.inf).astype(np.float32)
        seen = replace(seen, depth=bump)
        assert np.array_equal(*(diffusion_denoise.conditions(v, (SIDE, SIDE))[1] for v in (base, seen)))
    elif what == "canny":
        seen = replace(seen, rgb=np.ascontiguousarray(np.swapaxes(seen.rgb, 0, 1)))
        assert np.array_equal(*(diffusion_denoise.conditions(v, (SIDE, SIDE))[0] for v in (base, seen)))
    else:
        change = {
            "depth scale": {"depth": 0.0},
            "canny scale": {"canny": 0.0},
            "guidance": {"guidance": 2.0},
            "prompt": {"look": "a wave"},
        }[what]
        chosen = QUICK.model_copy(update=change)
    assert differs(paint(pipeline, seen=base), paint(pipeline, chosen, seen))


def test_conditions_are_as_the_controlnets_were_trained(pipeline):
    depth, edges = diffusion_denoise.conditions(view(), (SIDE, SIDE))
    assert depth[SIDE // 2, SIDE // 2, 0] > 0.95 and depth[0, 0].max() == 0, "near white, background black"
    assert set(np.unique(edges)) == {0.0, 1.0} and 0.01 < edges.mean() < 0.5


@pytest.mark.parametrize("half", ["content", "style"])
def test_each_lora_alone_changes_the_picture(pipeline, loras, half):
    plain = paint(pipeline)
    consislora.load_half(pipeline, loras[f"{half}1"], half, half)
    one = paint(pipeline)
    consislora.load_half(pipeline, loras[f"{half}2"], half, half)
    two = paint(pipeline)
    pipeline.delete_adapters(half)
    assert differs(plain, one) and differs(one, two) and differs(plain, two)
    np.testing.assert_array_equal(paint(pipeline), plain)


def test_the_ip_adapter_hears_the_style_picture_through_the_style_block(tmp_path):
    ip = QUICK.model_copy(update={"adapter": "ip"})
    answers = []
    for style in (picture(0), picture(1)):
        painter = diffusion.stylizer(job(tmp_path, ip, style), [view()])
        answers.append(painter(view(), None, np.random.default_rng(0)))
    assert differs(*answers) and not list(tmp_path.iterdir()), "nothing is trained"
    made, pictures = diffusion._pipeline(job(tmp_path, ip))
    scales = {n: p.scale for n, p in made.unet.attn_processors.items() if hasattr(p, "scale")}
    loud = {n.split(".transformer")[0] for n, s in scales.items() if any(s)}
    assert loud == {consislora.BLOCKS["style"]} and len(scales) > 4
    assert pictures[0].shape == (2, 1, 32) and not pictures[0][0].any()
    silent = paint(made, ip.model_copy(update={"adapter_scale": 0.0}), pictures=pictures)
    made.set_ip_adapter_scale(0.0)
    assert differs(silent, paint(made, ip, pictures=pictures))


def test_the_ip_recipe_needs_no_words_that_nothing_taught():
    assert diffusion.prompt_of(DiffusionSettings()) == "a [c] in the style of [v]"
    assert diffusion.prompt_of(QUICK) == "an object in the style of [v]"
    assert diffusion.prompt_of(QUICK.model_copy(update={"adapter": "ip"})) == "an object"
    named = DiffusionSettings(subject="bunny", look="a woodcut", content="none", adapter="ip")
    assert diffusion.prompt_of(named) == "a bunny in the style of a woodcut"


@pytest.mark.parametrize("which", ["content_guidance", "style_guidance"])
def test_guidance_takes_four_more_looks_a_pair_and_changes_the_picture(pipeline, loras, which):
    for half in consislora.BLOCKS:
        consislora.load_half(pipeline, loras[f"{half}1"], half, half)
    ours = consislora_make.LoraPair(loras["content1"], loras["style1"])
    theirs = consislora_make.LoraPair(loras["content2"], loras["style2"])
    plain = paint(pipeline)
    terms = diffusion._guidance(pipeline, QUICK.model_copy(update={which: 2.0}), theirs, ours)
    calls = counted(pipeline)
    guided = paint(pipeline, terms=terms)
    assert calls.count(2) == 4 and calls.count(1) == 8, "each step: the main pass of two, and two sides of one"
    pipeline.delete_adapters(["content", "style", "other_content", "other_style"])
    restore(pipeline)
    assert differs(plain, guided)


def counted(pipeline) -> list[int]:
    """The batch sizes of the UNet's calls from now on."""
    calls: list[int] = []
    pipeline.unet.count = pipeline.unet.register_forward_pre_hook(lambda module, inputs: calls.append(len(inputs[0])))
    return calls


def restore(pipeline) -> None:
    pipeline.unet.count.remove()


def half_prior() -> Prior:
    """The left half known, in two colours that no network paints by chance."""
    rgb = np.zeros((SIDE, SIDE, 3), np.float32)
    rgb[:, : SIDE // 2] = [0.9, 0.1, 0.1]
    rgb[: SIDE // 2, : SIDE // 2] = [0.1, 0.1, 0.9]
    known = np.zeros((SIDE, SIDE), bool)
    known[:, : SIDE // 2 + 1] = True
    rgb[:, SIDE // 2] = rgb[:, 0]
    return Prior(rgb, known)


def test_the_papers_numbers_of_calls(pipeline, monkeypatch):
    """N = 30, L = 10, r = 10: 30 for the first view, 300 + 3 for a later one, each of two (guidance)."""
    paper = DiffusionSettings()
    assert (paper.steps, paper.block, paper.repeats, paper.refinement) == (30, 10, 10, 0.1)
    calls: list[float] = []

    def denoiser(*_):
        return lambda x, sigma: calls.append(sigma) or x * 0

    monkeypatch.setattr(diffusion_denoise, "denoiser", denoiser)
    paint(pipeline, paper)
    assert len(calls) == 30
    first = list(calls)
    calls.clear()
    paint(pipeline, paper, prior=half_prior())
    assert len(calls) == 303 and calls[:10] == first[:10] and calls[10:20] == first[:10]
    assert calls[-3:] == first[-3:]
    # Trailing spacing: the levels that components.md gives, and eq. (3)'s jumps over the three blocks.
    assert first[0] == pytest.approx(14.615, abs=2e-3) and first[-1] == pytest.approx(0.176, abs=2e-3)
    edges = [first[0], first[10], first[20], 0.0]
    jumps = [math.sqrt(a * a - b * b) for a, b in zip(edges, edges[1:], strict=False)]
    assert jumps == pytest.approx([14.320, 2.766, 0.929], abs=2e-3)


def test_time_steps_belong_to_their_levels(pipeline):
    levels = diffusion_denoise.noise_levels(pipeline.scheduler, 30)
    steps = [diffusion_denoise.time_step(pipeline.scheduler, s) for s in levels[:-1]]
    assert steps == pytest.approx(pipeline.scheduler.timesteps.tolist())
    assert steps[0] == 999 and steps[-1] == 32
    between = diffusion_denoise.time_step(pipeline.scheduler, (levels[3] + levels[4]) / 2)
    assert steps[4] < between < steps[3]


def test_the_denoiser_agrees_with_diffusers_own_pipeline(pipeline):
    walks_as_diffusers(pipeline)


def walks_as_diffusers(pipeline) -> None:
    """The plain twin: diffusers' pipeline with the same latents, conditions and prompts walks the same path."""
    from mistyle.stylization.diffusion.repaint import Resampling, sample

    seen = view()
    conditioning = diffusion._conditioning(pipeline, QUICK, seen, (SIDE, SIDE), ())
    levels = diffusion_denoise.noise_levels(pipeline.scheduler, 4)
    noise = torch.randn((1, 4, 16, 16), generator=torch.Generator().manual_seed(0))
    ours = sample(
        diffusion_denoise.denoiser(pipeline, conditioning),
        None,
        None,
        levels,
        Resampling(refine=0.0),
        rng=torch.Generator().manual_seed(0),
        like=torch.zeros_like(noise),
    )
    theirs = pipeline(
        diffusion.prompt_of(QUICK),
        image=[p[:1] for p in conditioning.conditions],
        controlnet_conditioning_scale=[QUICK.depth, QUICK.canny],
        latents=noise,
        num_inference_steps=4,
        guidance_scale=QUICK.guidance,
        output_type="latent",
    ).images
    torch.testing.assert_close(ours, theirs, atol=1e-4, rtol=1e-4)


def test_pinned_latents_end_as_the_prior_and_the_rest_does_not(pipeline):
    from mistyle.stylization.diffusion.repaint import Resampling, sample

    known, mask = diffusion_denoise.prior_latent(pipeline.vae, half_prior(), (SIDE, SIDE), 2)
    conditioning = diffusion._conditioning(pipeline, QUICK, view(), (SIDE, SIDE), ())
    denoise = diffusion_denoise.denoiser(pipeline, conditioning)
    levels = diffusion_denoise.noise_levels(pipeline.scheduler, 4)

    def run():
        return sample(denoise, known, mask, levels, Resampling(2, 3, refine=0.0), rng=torch.Generator().manual_seed(5))

    end, again = run(), run()
    pinned = mask.bool().expand_as(end)
    assert 0.4 < float(mask.mean()) < 0.6 and torch.equal(end[pinned], known[pinned])
    assert not torch.isclose(end[~pinned], known[~pinned], atol=1e-2).all() and torch.equal(end, again)


def test_masks_shrink_to_cells_that_are_known_throughout():
    known = np.zeros((64, 64), bool)
    known[10:50, 10:50] = True
    cells = diffusion_denoise.pooled(known, 8)
    assert cells.sum() == 16 and np.array_equal(np.argwhere(cells).min(0), [2, 2])


def test_black_beside_the_prior_does_not_leak_into_its_latents(pipeline):
    """What lies under the unknown part, and how it would be encoded, must not count."""
    dark, bright = half_prior(), half_prior()
    bright.rgb[~bright.known] = 1.0
    (a, _), (b, _) = (diffusion_denoise.prior_latent(pipeline.vae, p, (SIDE, SIDE), 2) for p in (dark, bright))
    assert torch.equal(a, b)
    flat = Prior(np.full((SIDE, SIDE, 3), 0.5, np.float32), half_prior().known)
    whole = Prior(flat.rgb, np.ones((SIDE, SIDE), bool))
    (a, _), (b, _) = (diffusion_denoise.prior_latent(pipeline.vae, p, (SIDE, SIDE), 2) for p in (flat, whole))
    assert torch.equal(a, b), "a flat colour is continued over the rest"


@pytest.fixture(scope="module")
def views() -> list[View]:
    return [view(a) for a in (0.0, 30.0, 60.0, 90.0)]


@pytest.mark.parametrize(
    ("content", "steps"), [("none", 5), ("shared", 5 + 3), ("per-view", 5 + 4 * 3)], ids=lambda p: str(p)
)
def test_content_loras_cost_what_is_said(tmp_path, views, content, steps):
    chosen = QUICK.model_copy(update={"content": content})
    wanted = job(tmp_path, chosen)
    said, watched = [], []
    diffusion.stylizer(wanted, views, said.append, lambda *a: watched.append(a))
    assert f"{steps} training steps" in said[0] and [w[:2] for w in watched] == [(k + 1, steps) for k in range(steps)]
    diffusion.stylizer(wanted, views, said.append)
    assert "nothing is trained" in said[-1]
    halves = {"none": 1, "shared": 2, "per-view": 5}[content]
    assert len(list(tmp_path.glob("*.safetensors"))) == 2 * halves


def test_a_killed_sweep_goes_on_in_the_view_it_was_in(tmp_path, views, loras):
    """Stopped in the last view and run again: two views are taken over, the pictures are those of one run."""
    views, wanted = views[:3], job(tmp_path / "loras", style_lora=loras["style1"])
    settings, key = SweepSettings(), diffusion.key(wanted, views)
    painter = diffusion.stylizer(wanted, views)
    whole = sweep(views, ViewPainter(painter), settings, 0)
    seen: list[str] = []

    def stopping(v, prior, rng):
        seen.append(v.camera.name)
        if len(seen) == 3:
            raise Stopped("on request")
        return painter(v, prior, rng)

    with pytest.raises(Stopped):
        sweep(views, ViewPainter(stopping), settings, 0, store=ViewStore(tmp_path / "kept", key))
    again: list[str] = []
    rest = ViewPainter(lambda v, p, r: again.append(v.camera.name) or painter(v, p, r))
    resumed = sweep(views, rest, settings, 0, store=ViewStore(tmp_path / "kept", key))
    assert len(again) == 1 and again[0] == seen[-1]
    for a, b in zip(resumed.views, whole.views, strict=True):
        np.testing.assert_array_equal(a.rgb, b.rgb)
    other = job(tmp_path / "loras", style_lora=loras["style2"])
    assert diffusion.key(other, views) != key == diffusion.key(wanted, views)


def test_content_loras_follow_their_views(tmp_path, views, monkeypatch):
    chosen = QUICK.model_copy(update={"content": "per-view"})
    painter = diffusion.stylizer(job(tmp_path, chosen), views[:2])
    loaded = []
    original = consislora.load_half
    monkeypatch.setattr(consislora, "load_half", lambda p, path, *a: loaded.append(path.name) or original(p, path, *a))
    for v in views[:2]:
        painter(v, None, np.random.default_rng(0))
    assert [name.split("-")[0] for name in loaded] == [v.camera.name.split("-")[0] for v in views[:2]]


# What is refused, each before anything is rendered.


def refused(tmp_path, match: str, chosen=QUICK, error=EnvironmentMissing, side=SIDE, **more) -> None:
    settings = ModelSettings(**({"folder": tiny_models.folder(), "device": "cpu"} | more))
    with pytest.raises(error, match=match):
        diffusion.check(settings, chosen, side)


def test_what_fits_is_not_refused(tmp_path):
    diffusion.check(ModelSettings(folder=tiny_models.folder(), device="cpu"), QUICK, SIDE)
    ip = QUICK.model_copy(update={"adapter": "ip"})
    diffusion.check(ModelSettings(folder=tiny_models.folder(), device="cpu"), ip, SIDE)


def test_missing_packages_are_named_with_the_command(tmp_path, monkeypatch):
    monkeypatch.setattr(models, "find_spec", lambda name: None if name in ("peft", "diffusers") else object())
    refused(tmp_path, r"diffusers, peft, which are not installed; run: pip install 'mistyle\[diffusion\]'")


def test_missing_models_are_named_with_the_command(tmp_path, monkeypatch):
    monkeypatch.setenv("HF_HUB_CACHE", str(tmp_path / "cache"))
    folder = tiny_models.copy_without(tmp_path / "models", "canny")
    refused(tmp_path, r"'canny' .*2\.5 GB.*mistyle models fetch canny --models .*--allow-download", folder=folder)
    refused(tmp_path, r"'sdxl' .*was found not in .*cache", folder=None)


def test_missing_files_are_named(tmp_path):
    folder = tiny_models.copy_without(tmp_path / "models")
    (folder / "sdxl/unet/diffusion_pytorch_model.safetensors").unlink()
    refused(tmp_path, "lacks unet/diffusion_pytorch_model.safetensors", folder=folder)


@pytest.mark.parametrize(
    ("file", "change", "match"),
    [
        ("sdxl/unet", {"addition_embed_type": None}, "addition_embed_type is None.*not an SDXL base model"),
        ("sdxl/unet", {"in_channels": 9}, "in_channels is 9, expected 4"),
        ("sdxl/text_encoder", {"hidden_size": 48}, "the folders come from different models"),
        ("sdxl/scheduler", {"prediction_type": "sample"}, "prediction_type is 'sample', expected epsilon or v_pred"),
        ("depth", {"cross_attention_dim": 32}, "cross_attention_dim is 32, expected 64.*a ControlNet for SDXL"),
        ("canny", {"_class_name": "ControlNetUnionModel"}, "unions of several conditions are not supported"),
    ],
)
def test_wrong_architectures_are_refused(tmp_path, file, change, match):
    folder = tiny_models.copy_without(tmp_path / "models")
    name = "scheduler_config.json" if file.endswith("scheduler") else "config.json"
    tiny_models.edit_json(folder / file / name, **change)
    refused(tmp_path, match, folder=folder)


def test_a_wrong_style_lora_is_refused(tmp_path, loras):
    from safetensors.torch import load_file, save_file

    refused(tmp_path, "check the path", error=InputRefused, style_lora=tmp_path / "no.safetensors")
    tensors = load_file(loras["style1"])
    save_file({k.replace("up_blocks.0", "up_blocks.2"): v for k, v in tensors.items()}, tmp_path / "other.safetensors")
    refused(tmp_path, "no LoRA weights for up_blocks.0.attentions.1", style_lora=tmp_path / "other.safetensors")
    wide = {k: torch.zeros(4, 1280) if "down" in k else v for k, v in tensors.items()}
    save_file(wide, tmp_path / "wide.safetensors")
    refused(tmp_path, "take 1280 channels, expected 64", style_lora=tmp_path / "wide.safetensors")
    refused(tmp_path, "or the guidance", QUICK.model_copy(update={"style_guidance": 1.0}), UsageError)


def test_too_little_memory_is_refused(tmp_path):
    refused(
        tmp_path, r"a view of 1024² pixels needs about .* GB on the CPU, 0\.5 GB may be used", side=1024, memory=0.5
    )


def test_a_checkpoint_of_another_kind_is_refused(tmp_path, loras):
    refused(tmp_path, "not an SDXL checkpoint", checkpoint=loras["style1"])
    (tmp_path / "x.safetensors").write_bytes(b"\x80\x04pickle")
    refused(tmp_path, "expected a .safetensors file", error=InputRefused, checkpoint=tmp_path / "x.safetensors")
