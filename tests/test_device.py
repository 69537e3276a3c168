"""Networks on a device, by a stand-in for it: what lies where, offloading, and what is left between the stages."""

from dataclasses import replace

import numpy as np
import pytest
import standin
import test_diffusion as views_of
import test_paint3d as atlas_of
import tiny_models
import torch

from mistyle.backends import consislora_make, diffusion, models_check, models_load, paint3d
from mistyle.backends.diffusion_settings import ModelSettings
from mistyle.core.errors import EnvironmentMissing

torch.set_num_threads(1)


def test_the_stand_in_refuses_what_cuda_refuses_and_counts(monkeypatch):
    with standin.device(monkeypatch) as found:
        there = torch.ones(1000).to("cuda") + 1
        with pytest.raises(RuntimeError, match="expected all tensors on the same device"):
            there + torch.ones(1000)
        assert there.device.type == "cuda" and torch.equal(there.cpu(), torch.full((1000,), 2.0))
        assert models_check.room("cuda") == pytest.approx((standin.TOTAL - 4000) / 1e9)
        del there
        assert models_check.room("cuda") == standin.TOTAL / 1e9 and found == [4000, 0]


ONCE = views_of.QUICK.model_copy(update={"steps": 1, "block": 1, "repeats": 1, "refinement": 0.0})


def painter(tmp_path, seen, change: dict, **more):
    """The stylizer with as little work as shows what lies where."""
    job = views_of.job(tmp_path, ONCE.model_copy(update=change), **more)
    short = job.training.model_copy(update={"steps": 1, "style_steps": 1, "switch": 0})
    return diffusion.stylizer(replace(job, training=short), seen)


def paint(tmp_path, adapter: str, **more) -> list[np.ndarray]:
    """A later view first, as a resumed sweep has it, then one whose content LoRA takes the first one's place."""
    content = "per-view" if adapter == "lora" else "none"
    seen = [views_of.view(0.0), views_of.view(30.0)]
    paints = painter(tmp_path, seen, {"adapter": adapter, "content": content}, precision="float32", **more)
    rng = np.random.default_rng(0)
    return [paints(v, p, rng) for v, p in ((seen[1], views_of.half_prior()), (seen[0], None))]


@pytest.mark.parametrize("adapter", ["lora", "ip"])
def test_views_are_painted_on_the_device_offloaded_or_not(tmp_path, monkeypatch, adapter):
    plain = paint(tmp_path, adapter)
    with standin.device(monkeypatch):
        answers = [paint(tmp_path, adapter, offload=offload) for offload in (False, True)]
        assert standin.bytes_alive() == 0
    assert np.array_equal(*(np.stack(pictures) for pictures in answers)), "offloading changes no number"
    np.testing.assert_allclose(np.stack(answers[0]), np.stack(plain), atol=2e-3)


def test_guidance_finds_everything_on_the_device(tmp_path, monkeypatch):
    change = {"content": "shared", "style_guidance": 1.0, "content_guidance": 1.0}
    with standin.device(monkeypatch):
        paints = painter(tmp_path, [views_of.view()], change, offload=True)
        assert np.isfinite(paints(views_of.view(), views_of.half_prior(), np.random.default_rng(0))).all()


@pytest.mark.parametrize("recipe", list(paint3d.RECIPES))
def test_the_inpainter_runs_on_the_device_offloaded_or_not(monkeypatch, recipe):
    chosen = atlas_of.SETTINGS.model_copy(update={"recipe": recipe, "steps": 1})
    with standin.device(monkeypatch):
        answers = []
        for offload in (False, True):
            brush = paint3d.load(atlas_of.settings(offload=offload), chosen, atlas_of.picture())
            answers.append(atlas_of.answer(brush))
        held = standin.bytes_alive()
        del brush
        assert 0 == standin.bytes_alive() < held
    assert np.array_equal(*answers) and np.isfinite(answers[0]).all()


def test_offloading_keeps_less_on_the_device(tmp_path, monkeypatch):
    held = []
    with standin.device(monkeypatch):
        for offload in (False, True):
            made, _ = diffusion._pipeline(views_of.job(tmp_path, offload=offload))
            views_of.paint(made, ONCE)
            held.append(standin.bytes_alive())
            del made
    assert held[1] < 0.7 * held[0]


def test_nothing_is_left_on_the_device_when_a_stage_asks_what_is_free(tmp_path, monkeypatch):
    """The whole job: every question is asked of an empty device."""
    from test_generative import SETTINGS, stylize

    few = {"rig.views": 2, "train.steps": 2, "train.style_steps": 1, "train.switch": 1, "diffusion.steps": 2}
    few |= {"fit.iterations1": 1, "fit.iterations2": 1, "paint3d.steps": 1, "models.device": "auto"}
    assert set(few) <= set(SETTINGS)
    with standin.device(monkeypatch) as found:
        assert stylize(tmp_path / "out", **few) == 0
    assert len(found) >= 5, "stylizer and inpainter before the job, stylizer, training, inpainter in it"
    assert not any(found)


def test_training_gives_its_memory_back_before_the_stylizer_loads(tmp_path, monkeypatch):
    left = []
    original = diffusion._pipeline
    monkeypatch.setattr(diffusion, "_pipeline", lambda job: left.append(standin.bytes_alive()) or original(job))
    with standin.device(monkeypatch):
        painter(tmp_path, [views_of.view()], {})
    assert left == [0]


@pytest.mark.parametrize(
    ("device", "card", "chosen"), [("cpu", None, "float32"), ("cuda", True, "bfloat16"), ("cuda", False, "float16")]
)
def test_bfloat16_only_where_the_card_has_it(monkeypatch, device, card, chosen):
    monkeypatch.setattr(torch.cuda, "is_bf16_supported", lambda including_emulation=True: card or including_emulation)
    assert models_load.precision_of(ModelSettings(), device) == getattr(torch, chosen)
    assert models_load.precision_of(ModelSettings(), "mps") == torch.float16
    if card is False:
        with pytest.raises(EnvironmentMissing, match="this card does not compute it"):
            models_load.precision_of(ModelSettings(precision="bfloat16"), device)


def test_what_decides_nothing_is_in_no_key(tmp_path):
    from mistyle.core.asset import Picture
    from mistyle.run.generative import inpainter_inputs
    from mistyle.run.settings import resolve

    style, seen = Picture(views_of.picture(), None), [views_of.view()]
    plain = {"folder": str(tiny_models.folder()), "device": "cpu"}

    def keys(paint: dict, **more) -> tuple:
        s = resolve("standard", None, {"inpainter": "paint3d", "models": plain | more, "paint3d": paint}, {})
        job = diffusion.Job(s.models, s.train, s.diffusion, style.rgb, "wave", tmp_path, 0)
        trained = consislora_make.lora_key("style", style.rgb, "[v]", s.train, s.models, 0)
        return diffusion.key(job, seen), trained, inpainter_inputs(s, style)

    base = keys({})
    assert keys({}, offload=True) == keys({}, device="auto") == keys({}, memory=3) == base
    for other in ({"precision": "float16"}, {"prediction": "v_prediction"}):
        assert keys({}, **other)[:2] != base[:2]
    repaired = keys({"precision": "float16"})
    assert repaired[:2] == base[:2] and repaired[2] != base[2], "the repair's precision repaints no view"
    assert keys({"precision": "float16"}, precision="float16")[2] == keys({}, precision="float16")[2]
