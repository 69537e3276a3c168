"""ConsisLoRA: its losses, what it may touch, that it learns, resumes to the same bits, and writes files that load."""

import numpy as np
import pytest
import torch
from diffusers import StableDiffusionXLPipeline

from mistyle.core.errors import InputRefused, Stopped
from mistyle.stylization.diffusion import consislora
from mistyle.stylization.diffusion import lora_files as consislora_make
from mistyle.stylization.diffusion import lora_training as consislora_train
from mistyle.stylization.diffusion.settings import ModelSettings, TrainSettings
from tests.support import tiny_models

torch.set_num_threads(1)
SETTINGS = TrainSettings(rank=4, steps=6, style_steps=4, switch=3, resolution=32, save_every=2)


@pytest.fixture(scope="module")
def pipeline():
    return consislora_make.trainer(ModelSettings(folder=tiny_models.folder(), device="cpu"))


@pytest.fixture(scope="module")
def picture() -> np.ndarray:
    y, x = np.mgrid[:64, :80] / 10
    return np.stack([np.sin(x) * 0.5 + 0.5, np.cos(y) * 0.5 + 0.5, np.sin(x + y) * 0.5 + 0.5], axis=-1).astype(
        np.float32
    )


@pytest.fixture
def halves(pipeline):
    """Both halves as fresh adapters, removed afterwards."""
    for half in consislora.BLOCKS:
        consislora.add_half(pipeline.unet, half, 4, 0)
    yield pipeline.unet
    pipeline.unet.delete_adapters(list(consislora.BLOCKS))


def weights(unet, name: str) -> dict[str, torch.Tensor]:
    return {k: v.detach().clone() for k, v in consislora.parameters(unet, name).items()}


def shout(unet, name: str) -> None:
    """Noise in B, which is zero at first, so that the adapter says something."""
    for key, value in consislora.parameters(unet, name).items():
        if "lora_B" in key:
            torch.nn.init.normal_(value.data, std=0.3)


@pytest.mark.parametrize("offset", [0.0, 0.03])
@pytest.mark.parametrize("level", [0, 300, 700, 999])
def test_the_picture_loss_is_the_noise_loss_times_its_weight(pipeline, offset, level):
    phase = consislora_train.LoraPhase("p", "x", 1, ("style",), noise_offset=offset)
    alpha = pipeline.scheduler.alphas_cumprod[level].double()
    _, noise = consislora_train.step_noise(phase, torch.Size([1, 4, 8, 8]), 0, 0, 1000)
    z0, eps, noise = (t.double() for t in (torch.randn(1, 4, 8, 8), torch.randn(1, 4, 8, 8), noise))
    zt = consislora.noisy(z0, noise, alpha)
    predicted = (zt - (1 - alpha).sqrt() * eps) / alpha.sqrt()
    # In double the identity holds to rounding; x0_loss itself takes the network's float32 answer.
    exact = torch.mean((eps - noise) ** 2) * ((1 - alpha) / alpha)
    assert torch.mean((predicted - z0) ** 2) == pytest.approx(float(exact), rel=1e-12)
    ours = consislora.x0_loss(eps.float(), z0.float(), zt.float(), alpha.float())
    assert float(ours) == pytest.approx(float(exact), rel=2e-3 if level == 0 else 1e-5)


def test_weights_are_those_of_sdxl(pipeline):
    alphas = pipeline.scheduler.alphas_cumprod
    found = [float((1 - alphas[t]) / alphas[t]) for t in (100, 500, 700, 900, 999)]
    assert found == pytest.approx([0.118, 2.6, 11.1, 70, 214], rel=0.03)


def test_the_noise_offset_is_one_number_a_channel():
    plain = consislora_train.LoraPhase("style", "x", 1, ("style",))
    shifted = consislora_train.LoraPhase("style", "x", 1, ("style",), noise_offset=0.5)
    shape = torch.Size([1, 4, 6, 5])
    (_, a), (_, b) = (consislora_train.step_noise(p, shape, 3, 7, 1000) for p in (plain, shifted))
    shift = (b - a).reshape(4, -1)
    assert shift.std(dim=1).max() < 1e-6 and shift.mean(dim=1).std() > 0.05


def test_only_the_two_blocks_are_reached(pipeline, halves):
    names = [n for n, _ in halves.named_parameters() if "lora" in n]
    assert {n[: len("up_blocks.0.attentions.0")] for n in names} == set(consislora.BLOCKS.values())
    # Two transformer blocks of two attentions of four projections of two matrices.
    assert len(consislora.parameters(halves, "style")) == len(consislora.parameters(halves, "content")) == 32
    a = consislora.parameters(halves, "style")
    assert all(v.dtype == torch.float32 and v.shape[0] == 4 for k, v in a.items() if "lora_A" in k)
    assert all(not v.any() for k, v in a.items() if "lora_B" in k)


def training_example(pipeline, picture, prompt="A [v]"):
    return consislora_train.training_example(pipeline, picture, prompt, 32, 0)


def loss_of(pipeline, shown, step=0, level=500):
    phase = consislora_train.joint_phase("[v]", SETTINGS)
    _, noise = consislora_train.step_noise(phase, shown.z0.shape, 0, step, 1000)
    alpha = pipeline.scheduler.alphas_cumprod[level]
    return consislora_train.step_loss(
        pipeline.unet, shown, phase, "switch", consislora_train.NoisyStep(step, level, noise, alpha)
    )


@pytest.mark.parametrize("trained", [("content", "style"), ("style",)])
def test_gradients_reach_what_learns_and_nothing_else(pipeline, halves, picture, trained):
    for half in consislora.BLOCKS:
        shout(halves, half)
    consislora.activate(halves, {"content": 1.0, "style": 1.0}, trained)
    loss, _ = loss_of(pipeline, training_example(pipeline, picture))
    loss.backward()
    got = {n for n, p in halves.named_parameters() if p.grad is not None}
    assert got == {n for half in trained for n in consislora.parameters(halves, half)}
    assert all(halves.get_parameter(n).grad.abs().max() > 0 for n in got)
    halves.zero_grad(set_to_none=True)


def test_the_lower_half_of_the_network_keeps_no_graph_and_says_the_same(pipeline, halves, picture):
    shout(halves, "style")
    consislora.activate(halves, {"content": 1.0, "style": 1.0}, ("style",))
    shown = training_example(pipeline, picture)
    more = {"text_embeds": shown.pooled, "time_ids": shown.sizes}
    inside = []
    hook = halves.mid_block.register_forward_hook(lambda m, i, o: inside.append(torch.is_grad_enabled()), prepend=True)
    with consislora.below_without_gradients(halves):
        ours = halves(shown.z0, 5, encoder_hidden_states=shown.text, added_cond_kwargs=more).sample
    hook.remove()
    plain = halves(shown.z0, 5, encoder_hidden_states=shown.text, added_cond_kwargs=more).sample
    assert inside == [False] and ours.requires_grad and torch.equal(ours, plain)
    assert torch.is_grad_enabled()


def test_a_training_example_keeps_the_pictures_shape(pipeline, picture):
    shown = training_example(pipeline, picture)
    assert shown.z0.shape == (1, 4, 16, 20)
    assert shown.sizes.tolist() == [[64, 80, 0, 0, 32, 40]]
    assert shown.text.shape[-1] == 64 and shown.pooled.shape == (1, 32)


def test_training_lowers_the_loss(pipeline, halves, picture):
    shown = training_example(pipeline, picture)
    phase = consislora_train.LoraPhase("learn", "A [v]", 40, ("content", "style"), switch=100, rate=5e-2)

    def mean_error() -> float:
        return float(np.mean([loss_of(pipeline, shown, step=k, level=100 * k + 50)[1] for k in range(10)]))

    before = mean_error()
    consislora_train.run_phase(pipeline, shown, phase, SETTINGS, 0)
    assert mean_error() < 0.97 * before


@pytest.mark.parametrize("mode", ["switch", "sum"])
def test_the_switch_replaces_or_adds(pipeline, halves, picture, mode):
    shown = training_example(pipeline, picture)
    consislora.activate(halves, {"content": 1.0, "style": 1.0}, ("style",))
    phase = consislora_train.joint_phase("[v]", SETTINGS)
    _, noise = consislora_train.step_noise(phase, shown.z0.shape, 0, 0, 1000)
    alpha = pipeline.scheduler.alphas_cumprod[800]

    def at(step):
        return consislora_train.step_loss(
            pipeline.unet, shown, phase, mode, consislora_train.NoisyStep(step, 800, noise, alpha)
        )

    (before, error), (after, _) = at(SETTINGS.switch - 1), at(SETTINGS.switch)
    assert float(before) == error
    factor = float((1 - alpha) / alpha) + (mode == "sum")
    assert float(after) == pytest.approx(error * factor, rel=1e-4)


def made(pipeline, picture, folder, name="style", kind="style", settings=SETTINGS, **more):
    image = consislora_make.TrainingImage(kind, name, picture, "[v]")
    key = consislora_make.lora_key(image, settings, ModelSettings(folder=tiny_models.folder()), 0)
    halves = consislora_make.paths(folder, name, key)
    errors = consislora_make.make(pipeline, image, halves, key, settings, 0, **more)
    return halves, key, errors


@pytest.fixture(scope="module")
def whole(pipeline, picture, tmp_path_factory):
    """An undisturbed training: its folder, its halves, its errors, and both phases with the weights around them."""
    folder, seen = tmp_path_factory.mktemp("whole"), []
    original = consislora_train.run_phase

    def watched(pipeline, shown, phase, *rest):
        before = {half: weights(pipeline.unet, half) for half in consislora.BLOCKS}
        errors = original(pipeline, shown, phase, *rest)
        seen.append((phase, before, {half: weights(pipeline.unet, half) for half in consislora.BLOCKS}))
        return errors

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(consislora_train, "run_phase", watched)
        halves, _, errors = made(pipeline, picture, folder)
    return folder, halves, errors, seen


def test_stage_two_leaves_the_content_half_untouched(whole):
    folder, halves, errors, seen = whole
    (one, _, after_one), (two, before, after) = seen
    assert (one.prompt, two.prompt) == ("A [v]", "An image in the style of [v]") and len(errors) == 10
    assert (two.switch, two.noise_offset, two.trained, two.frozen) == (0, 0.03, ("style",), ("content",))
    for name, value in after["content"].items():
        assert torch.equal(value, before["content"][name]) and torch.equal(value, after_one["content"][name])
    assert all(not v.any() for k, v in before["style"].items() if "lora_B" in k), "the style half starts afresh"
    assert any(not torch.equal(v, before["style"][k]) for k, v in after["style"].items())
    assert halves.content.is_file() and halves.style.is_file() and not list(folder.glob("*training*"))


@pytest.mark.parametrize("stop", [1, 5, 8])
def test_a_stopped_training_ends_with_the_same_bits(pipeline, picture, whole, tmp_path, stop):
    def watch(step: int, steps: int, loss: float) -> None:
        if step == stop:
            raise Stopped("on request")

    with pytest.raises(Stopped):
        made(pipeline, picture, tmp_path / "cut", watch=watch)
    again, _, errors = made(pipeline, picture, tmp_path / "cut")
    assert len(errors) <= 10
    for ours, theirs in ((again.content, whole[1].content), (again.style, whole[1].style)):
        assert ours.read_bytes() == theirs.read_bytes()


def test_a_killed_training_goes_on_from_its_last_checkpoint(pipeline, picture, whole, tmp_path):
    def watch(step: int, steps: int, loss: float) -> None:
        if step == 5:
            raise RuntimeError("killed: nothing more is written")

    with pytest.raises(RuntimeError):
        made(pipeline, picture, tmp_path / "cut", watch=watch)
    steps = []
    again, _, _ = made(pipeline, picture, tmp_path / "cut", watch=lambda step, *_: steps.append(step))
    assert steps[0] == 5, "four steps were in the checkpoint"
    assert again.style.read_bytes() == whole[1].style.read_bytes()


def test_a_finished_lora_is_taken_over_and_settings_change_its_name(pipeline, picture, tmp_path):
    image = consislora_make.TrainingImage("style", "wave", picture, "[v]")
    folder = consislora_make.LoraFolder(tmp_path)
    settings, said = ModelSettings(folder=tiny_models.folder(), device="cpu"), []
    first = consislora_make.make_all(settings, [image], folder, SETTINGS, 0, said.append)
    times = [p.stat().st_mtime_ns for p in (first[0].content, first[0].style)]
    again = consislora_make.make_all(settings, [image], folder, SETTINGS, 0, said.append)
    assert again == first and times == [p.stat().st_mtime_ns for p in (first[0].content, first[0].style)]
    assert "10 training steps" in said[0] and "minutes" in said[0] and "nothing is trained" in said[1]
    other = SETTINGS.model_copy(update={"noise_offset": 0.1})
    key = consislora_make.lora_key(image, other, settings, 0)
    assert consislora_make.paths(tmp_path, "wave", key) != first[0]
    assert key != consislora_make.lora_key(image, other, settings, 1)


def test_the_papers_training_takes_hours_and_says_so():
    text = consislora_make.forecast(26_500, 1024)
    assert "26,500 training steps" in text and "1.8 to 3.7 hours" in text


def fresh() -> StableDiffusionXLPipeline:
    place = tiny_models.folder() / "sdxl"
    from mistyle.stylization.models.load import base_parts

    return StableDiffusionXLPipeline(**base_parts(place, "sdxl", torch.float32), add_watermarker=False)


def predict(pipeline) -> torch.Tensor:
    generator = torch.Generator().manual_seed(1)
    text, pooled = torch.randn(1, 7, 64, generator=generator), torch.randn(1, 32, generator=generator)
    more = {"text_embeds": pooled, "time_ids": torch.tensor([[64.0, 64, 0, 0, 64, 64]])}
    z = torch.randn(1, 4, 16, 16, generator=generator)
    with torch.no_grad():
        return pipeline.unet(z, 300, encoder_hidden_states=text, added_cond_kwargs=more).sample


@pytest.fixture(scope="module")
def saved(pipeline, tmp_path_factory):
    """A content and a style LoRA with noise in them, and what the network says with each and with both."""
    folder = tmp_path_factory.mktemp("loras")
    said = {}
    for half in consislora.BLOCKS:
        consislora.add_half(pipeline.unet, half, 4, 0)
        shout(pipeline.unet, half)
        consislora.save_half(folder / f"{half}.safetensors", pipeline.unet, half, {"note": "x"})
    for names in (("content",), ("style",), ("content", "style")):
        consislora.activate(pipeline.unet, {n: 1.0 for n in names})
        said[names] = predict(pipeline)
    pipeline.unet.delete_adapters(list(consislora.BLOCKS))
    said[()] = predict(pipeline)
    return folder, said


def test_saved_loras_load_into_a_fresh_pipeline_and_change_it_alone(saved):
    folder, said = saved
    plain = fresh()
    assert torch.equal(predict(plain), said[()])
    for half in consislora.BLOCKS:
        consislora.load_half(plain, folder / f"{half}.safetensors", half, half)
    for names in (("content",), ("style",), ("content", "style")):
        plain.set_adapters(list(names), [1.0] * len(names))
        torch.testing.assert_close(predict(plain), said[names], atol=1e-6, rtol=1e-5)
    answers = list(said.values())
    assert all((a - b).abs().max() > 1e-3 for k, a in enumerate(answers) for b in answers[:k])
    plain.delete_adapters(list(consislora.BLOCKS))
    assert torch.equal(predict(plain), said[()])


def test_diffusers_itself_loads_the_file(saved):
    folder, said = saved
    plain = fresh()
    plain.load_lora_weights(folder, weight_name="style.safetensors", adapter_name="any")
    torch.testing.assert_close(predict(plain), said[("style",)], atol=1e-6, rtol=1e-5)


def test_names_follow_the_rule_by_which_comfyui_finds_weights(saved):
    """ComfyUI looks for `unet.` + the name in diffusers with `.to_` as `.processor.to_` and `to_out.0` as `to_out`,
    followed by `_lora.up.weight`."""
    from safetensors.torch import load_file

    modules = [n for n, _ in fresh().unet.named_modules() if n.startswith(consislora.BLOCKS["style"] + ".")]
    linear = [n for n in modules if n.endswith((".to_q", ".to_k", ".to_v", ".to_out.0"))]
    wanted = {f"unet.{n.replace('.to_', '.processor.to_').removesuffix('.0')}_lora" for n in linear}
    found = load_file(saved[0] / "style.safetensors")
    assert {f"{n}.{part}.weight" for n in wanted for part in ("up", "down")} == set(found)
    assert consislora.notes_of(saved[0] / "style.safetensors")["note"] == "x"


def test_doubled_prefixes_and_whole_b_loras_are_read(saved, tmp_path):
    from safetensors.torch import load_file, save_file

    both = {}
    for half in consislora.BLOCKS:
        both |= {f"unet.{k}": v for k, v in load_file(saved[0] / f"{half}.safetensors").items()}
    save_file(both, tmp_path / "blora.safetensors")
    plain = fresh()
    consislora.load_half(plain, tmp_path / "blora.safetensors", "style", "style")
    torch.testing.assert_close(predict(plain), saved[1][("style",)], atol=1e-6, rtol=1e-5)


def test_what_is_no_lora_is_refused(tmp_path):
    (tmp_path / "x.safetensors").write_bytes(b"not a header")
    with pytest.raises(InputRefused, match="expected a LoRA"):
        consislora.read_lora(tmp_path / "x.safetensors")


@pytest.mark.parametrize("precision", ["bfloat16", "float16"])
def test_float32_loras_learn_over_a_frozen_half_precision_network(picture, precision, tmp_path):
    settings = ModelSettings(folder=tiny_models.folder(), device="cpu", precision=precision)
    half = consislora_make.trainer(settings)
    halves, _, errors = made(
        half, picture, tmp_path, settings=SETTINGS.model_copy(update={"steps": 1, "style_steps": 1})
    )
    assert half.vae.dtype == torch.float32 and half.unet.dtype == getattr(torch, precision)
    assert np.isfinite(errors).all()
    assert all(v.dtype == torch.float32 for v in consislora.read_lora(halves.style).values())


def test_the_real_architecture_has_the_numbers_of_consislora():
    """SDXL in full size, without its weights: 80 projections a block, 14.09 million numbers at rank 64."""
    from diffusers import UNet2DConditionModel

    with torch.device("meta"):
        unet = UNet2DConditionModel(
            sample_size=128,
            block_out_channels=(320, 640, 1280),
            down_block_types=("DownBlock2D", "CrossAttnDownBlock2D", "CrossAttnDownBlock2D"),
            up_block_types=("CrossAttnUpBlock2D", "CrossAttnUpBlock2D", "UpBlock2D"),
            transformer_layers_per_block=(1, 2, 10),
            attention_head_dim=(5, 10, 20),
            cross_attention_dim=2048,
            use_linear_projection=True,
            addition_embed_type="text_time",
            addition_time_embed_dim=256,
            projection_class_embeddings_input_dim=2816,
        )
    assert sum(p.numel() for p in unet.parameters()) == pytest.approx(2567.5e6, rel=1e-4)
    for half in consislora.BLOCKS:
        with torch.device("meta"):
            consislora.add_half(unet, half, 64, 0)
        found = consislora.parameters(unet, half)
        assert len(found) == 2 * 80 and sum(p.numel() for p in found.values()) == pytest.approx(14.09e6, rel=1e-3)
        assert len(consislora.half_names(unet, half)) == 2 * 80
