"""Networks on a device, by a stand-in for it: what lies where, offloading, and what is left between the stages."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from mistyle.atlas.texels import rasterise
from mistyle.core.asset import Picture
from mistyle.core.errors import EnvironmentMissing
from mistyle.core.maps import flat_maps
from mistyle.jobs.progress import Progress
from mistyle.jobs.stages import Run
from mistyle.stylization.diffusion import lora_files as consislora_make
from mistyle.stylization.diffusion import stylizer as diffusion
from mistyle.stylization.diffusion.settings import ModelSettings
from mistyle.stylization.inpaint import paint3d
from mistyle.stylization.models import check as models_check
from mistyle.stylization.models import load as models_load
from mistyle.stylization.optimise.two_phase import Fit
from mistyle.stylization.pipeline.generative import inpainter_inputs
from mistyle.stylization.pipeline.job import STAGES, Job
from mistyle.stylization.records import Atlas, Baked
from mistyle.stylization.settings import resolve
from tests.stylization.diffusion import test_diffusion as views_of
from tests.stylization.diffusion import test_paint3d as atlas_of
from tests.stylization.surface.test_surface_paint import asset_of
from tests.support import standin, tiny_models

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


LORA = {"content": "per-view", "style_guidance": 1.0, "content_guidance": 1.0}
IP = {"adapter": "ip", "content": "none"}


def paint(tmp_path, change: dict, **more) -> tuple[list[np.ndarray], int]:
    """A later view first, as a resumed sweep has it, then one whose content LoRA takes the first one's place; and the
    bytes on the device while the networks are at hand."""
    seen = [views_of.view(0.0), views_of.view(30.0)]
    paints = painter(tmp_path, seen, change, precision="float32", **more)
    rng = np.random.default_rng(0)
    return [paints(v, p, rng) for v, p in ((seen[1], views_of.half_prior()), (seen[0], None))], standin.bytes_alive()


@pytest.mark.parametrize("change", [LORA, IP], ids=["lora", "ip"])
def test_views_are_painted_on_the_device_offloaded_or_not(tmp_path, monkeypatch, change):
    """LoRAs with guidance, which needs four halves at once, or the IP-Adapter."""
    plain, _ = paint(tmp_path, change)
    with standin.device(monkeypatch):
        (whole, held), (offloaded, less) = (paint(tmp_path, change, offload=offload) for offload in (False, True))
        assert standin.bytes_alive() == 0
    assert np.array_equal(np.stack(whole), np.stack(offloaded)), "offloading changes no number"
    assert less < 0.7 * held, "offloading keeps less on the device"
    np.testing.assert_allclose(np.stack(whole), np.stack(plain), atol=2e-3)


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


def test_nothing_is_left_on_the_device_when_a_stage_asks_what_is_free(tmp_path, monkeypatch):
    """Sweep with its training, then repair, as a job runs them: every question is asked of an empty device, and the
    training has given its memory back before the stylizer loads."""
    from mistyle.stylization.pipeline import stylize as pipeline
    from mistyle.stylization.pipeline.sweep import swept

    chosen = {"steps": 1, "repeats": 1, "refinement": 0.0, "content": "shared"}
    training = {"rank": 4, "steps": 1, "style_steps": 1, "switch": 0, "resolution": 16}
    texture = {"size": 32, "overlap": 8, "steps": 1}
    place = {"folder": str(tiny_models.folder()), "precision": "float32"}
    said = {"stylizer": "diffusion", "inpainter": "paint3d", "models": place, "diffusion": chosen, "train": training}
    settings = resolve("standard", None, said | {"paint3d": texture, "fit": {"refine": "off"}}, {})
    job = Job(Path("mesh.obj"), Path("wave.png"), tmp_path, settings, "x")
    style = Picture(views_of.picture(), None, Path("wave.png"))
    asset, maps = asset_of(atlas_of.mesh()), (flat_maps(32, albedo=0.3),)
    texels = rasterise(asset.mesh, 0, 32)
    atlas, baked, nothing = Atlas((texels,), maps), Baked(maps, (np.ones((32, 32), int),)), (np.zeros((32, 32)),)
    fitted = Fit(maps, nothing, nothing, {}, {}, {}, ())
    masks = [atlas_of.middle() & texels.covered]
    held: list[int] = []
    left: list[int] = []
    load = diffusion._pipeline
    monkeypatch.setattr(diffusion, "_pipeline", lambda job: left.append(standin.bytes_alive()) or load(job))

    def report(done: float) -> None:
        held.append(standin.bytes_alive())

    with standin.device(monkeypatch) as found, Run(job, Progress(quiet=True), STAGES) as run:
        run.keys["surface"] = "k"
        swept(run, asset, style, atlas, [views_of.view()], report)
        assert len(found) == 2 and max(held) > 0 == standin.bytes_alive(), "stylizer and training asked"
        assert left == [0]
        monkeypatch.setattr(pipeline, "settle_relief", lambda *a: held.append(standin.bytes_alive()) or a[2])
        pipeline.repair(asset, style, atlas, baked, [], fitted, masks, settings, report)
        assert len(found) == 3 and held[-2] > held[-1] == 0 == standin.bytes_alive()
    assert not any(found)


@pytest.mark.parametrize(
    ("device", "card", "chosen"), [("cpu", None, "float32"), ("cuda", True, "bfloat16"), ("cuda", False, "float16")]
)
def test_bfloat16_only_where_the_card_has_it(monkeypatch, device, card, chosen):
    monkeypatch.setattr(torch.cuda, "is_bf16_supported", lambda including_emulation=True: card or including_emulation)
    assert models_load.precision_of(ModelSettings(), device) == getattr(torch, chosen)
    assert models_load.precision_of(ModelSettings(), "mps") == torch.float16
    if card is False:
        with pytest.raises(EnvironmentMissing, match="this device does not support it"):
            models_load.precision_of(ModelSettings(precision="bfloat16"), device)


def test_what_decides_nothing_is_in_no_key(tmp_path):
    style, seen = Picture(views_of.picture(), None, Path("wave.png")), [views_of.view()]
    plain = {"folder": str(tiny_models.folder()), "device": "cpu"}

    def keys(paint: dict, **more) -> tuple:
        s = resolve("standard", None, {"inpainter": "paint3d", "models": plain | more, "paint3d": paint}, {})
        job = diffusion.DiffusionJob(s.models, s.train, s.diffusion, style.rgb, "wave", tmp_path, 0)
        image = consislora_make.TrainingImage("style", "wave", style.rgb, "[v]")
        trained = consislora_make.lora_key(image, s.train, s.models, 0)
        return diffusion.key(job, seen), trained, inpainter_inputs(s, style)

    base = keys({})
    assert keys({}, offload=True) == keys({}, device="auto") == keys({}, memory=3) == base
    for other in ({"precision": "float16"}, {"prediction": "v_prediction"}):
        assert keys({}, **other)[:2] != base[:2]
    repaired = keys({"precision": "float16"})
    assert repaired[:2] == base[:2] and repaired[2] != base[2], "the repair's precision repaints no view"
    assert keys({"precision": "float16"}, precision="float16")[2] == keys({}, precision="float16")[2]
