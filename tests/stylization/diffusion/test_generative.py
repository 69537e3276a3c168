"""The whole job with the generative backends, from models on disk to an asset, and what is refused before it starts."""

import json
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

from mistyle.cli.main import main
from mistyle.core.camera import rig
from mistyle.core.paths import scenes
from mistyle.io.cameras.views import read_views
from mistyle.io.store.records import load_record
from mistyle.stylization.diffusion import consislora
from mistyle.stylization.pipeline.generative import opaque, watcher
from tests.support import tiny_models

SETTINGS = {
    "rig.views": 3,
    "rig.resolution": 64,
    "draw.spp": 1,
    "atlas.size": 128,
    "atlas.padding": 4,
    "fit.iterations1": 2,
    "fit.solve": "false",
    "fit.iterations2": 2,
    "fit.crops": 1,
    "fit.crop_size": 32,
    "report.frames": 4,
    "report.resolution": 64,
    "report.spp": 1,
    "train.rank": 4,
    "train.steps": 2,
    "train.style_steps": 2,
    "train.switch": 1,
    "train.resolution": 32,
    "diffusion.steps": 2,
    "diffusion.block": 1,
    "diffusion.repeats": 2,
    "diffusion.refinement": 0.5,
    "paint3d.size": 64,
    "paint3d.overlap": 16,
    "paint3d.steps": 2,
    "models.device": "cpu",
}


def stylize(out: Path, *more: str, folder: Path | None = None, **changes) -> int:
    """`mistyle stylize` of the demo's mesh and painting with both generative backends."""
    words = ["stylize", str(scenes() / "demo.obj"), str(scenes() / "demo_style.png"), "-o", str(out), "--json"]
    words += ["--stylizer", "diffusion", "--inpainter", "paint3d", "--models", str(folder or tiny_models.folder())]
    words += ["--rig", "turntable", "--preset", "draft", "--threads", "2", *more]
    for key, value in (SETTINGS | changes).items():
        words += ["--set", f"{key}={value}"]
    return main(words)


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("generative")
    assert stylize(out) == 0
    return out


def test_the_demo_goes_through_every_network_and_comes_out_as_an_asset(whole):
    asset = trimesh.load(whole / "asset" / "demo_demo_style.glb", force="mesh", process=False)
    picture = np.asarray(asset.visual.material.baseColorTexture.convert("RGB"), float)
    assert picture.std(axis=(0, 1)).min() > 5
    assert len(list((whole / "stylized").glob("*.png"))) == len(list((whole / "views").glob("*.png"))) == 3
    run = json.loads((whole / "run.json").read_text())
    assert run["settings"]["stylizer"] == "diffusion" and run["settings"]["inpainter"] == "paint3d"
    assert (whole / "report" / "index.html").stat().st_size > 10_000


def test_the_papers_cost_is_said_before_it_starts():
    from mistyle.stylization.diffusion.stylizer import announcement
    from mistyle.stylization.settings import resolve

    paper = resolve("paper", None, {}, {})
    text = announcement(paper.models, paper.train, paper.diffusion, 16)
    assert "26,500 training steps" in text and "hours" in text and f"{30 + 15 * 303:,} denoising steps" in text
    ip = resolve("standard", None, {"diffusion": {"adapter": "ip"}}, {})
    assert "no LoRA is trained" in announcement(ip.models, ip.train, ip.diffusion, 16)


def test_loras_were_trained_and_kept(whole):
    loras = sorted((whole / "work" / "loras").glob("*.safetensors"))
    kinds = sorted(consislora.notes_of(p)["mistyle_kind"] for p in loras)
    assert kinds == ["content", "content", "style", "style"], "two halves of the style, two of the first view"
    assert all(v.abs().sum() > 0 for p in loras for v in consislora.read_lora(p).values()), "B has left zero"


def test_stylized_views_are_the_networks_and_keep_the_mesh(whole):
    before, after = read_views(whole / "views"), read_views(whole / "stylized")
    for a, b in zip(before, after, strict=True):
        assert np.array_equal(a.mask, b.mask) and np.abs(a.rgb - b.rgb)[a.mask].mean() > 0.02
        assert not b.rgb[~b.mask & (b.coverage == 0)].any()


def test_the_inpainter_painted_the_repaired_texels_only(whole):
    fitted, repaired = (load_record(whole / "work" / name / "record") for name in ("fit", "repair"))
    mask = repaired.mask[0]
    difference = np.abs(fitted.maps[0].albedo - repaired.maps[0].albedo).max(axis=-1)
    assert 0.01 < mask.mean() < 0.9 and difference[mask].max() > 0.02
    assert (difference[mask] > 1e-3).mean() > 0.5
    from mistyle.core.image import dilate

    assert not difference[~dilate(mask, 2)].any()


REFUSED = [
    ("canny", {}, "mistyle models fetch canny"),
    ("position", {}, "mistyle models fetch position"),
    ("", {"models.memory": 0.001}, "GB may be used"),
]


@pytest.mark.parametrize(("lost", "changes", "words"), REFUSED, ids=["stylizer", "inpainter", "memory"])
def test_what_is_missing_ends_the_job_before_it_renders(tmp_path, monkeypatch, capsys, lost, changes, words):
    monkeypatch.setenv("HF_HUB_CACHE", str(tmp_path / "cache"))
    folder = tiny_models.copy_without(tmp_path / "models", lost)
    assert stylize(tmp_path / "out", folder=folder, **changes) == 4
    told = capsys.readouterr()
    assert words in told.err and json.loads(told.out)["exit_code"] == 4
    assert not (tmp_path / "out").exists()


def test_a_wrong_architecture_and_a_missing_lora_end_it_too(tmp_path, capsys):
    folder = tiny_models.copy_without(tmp_path / "models")
    tiny_models.edit_json(folder / "depth" / "config.json", cross_attention_dim=32)
    assert stylize(tmp_path / "out", folder=folder) == 4
    assert "this is not a ControlNet for SDXL" in capsys.readouterr().err
    assert stylize(tmp_path / "out", "--style-mask", str(scenes() / "demo_style.png")) == 2
    assert "crop the picture instead" in capsys.readouterr().err
    assert stylize(tmp_path / "out", "--direction-map", str(scenes() / "demo_style.png")) == 2
    assert "cannot follow it" in capsys.readouterr().err
    assert stylize(tmp_path / "out", "--style-lora", str(tmp_path / "no.safetensors")) == 3
    assert "check the path" in capsys.readouterr().err and not (tmp_path / "out").exists()


def train(*words: str) -> list[str]:
    numbers = ["train.rank=4", "train.style_steps=2", "train.switch=1", "train.resolution=32", "models.device=cpu"]
    sets = [part for n in numbers for part in ("--set", n)]
    models = str(tiny_models.folder())
    return ["train", *words, "--models", models, "--steps", "2", "--threads", "1", "--json", *sets]


def test_training_on_its_own(tmp_path, capsys):
    assert main(train("style", str(scenes() / "demo_style.png"), "-o", str(tmp_path))) == 0
    told = capsys.readouterr()
    (file,) = json.loads(told.out)["loras"]
    assert Path(file).name.startswith("demo_style-") and file.endswith(".style.safetensors") and Path(file).is_file()
    assert "4 training steps" in told.err and "loss over weight" in told.err
    assert main(train("style", str(scenes() / "demo_style.png"), "-o", str(tmp_path))) == 0
    assert "nothing is trained" in capsys.readouterr().err


def test_training_on_rendered_views(whole, tmp_path, capsys):
    assert main(train("content", str(whole / "views"), "-o", str(tmp_path))) == 0
    files = json.loads(capsys.readouterr().out)["loras"]
    assert len(files) == 3 and all(f.endswith(".content.safetensors") for f in files)


def test_training_asks_for_what_it_needs(tmp_path, capsys):
    assert main(["train", "style"]) == 2 and "-o DIR" in capsys.readouterr().err
    assert main(["train", "--print-config"]) == 0 and "style_steps = 1000" in capsys.readouterr().out
    assert main(["train", "--preset", "draft", "--print-config"]) == 0 and "steps = 500" in capsys.readouterr().out


def test_settings_and_help_name_the_generative_stages(capsys):
    assert main(["stylize", "--preset", "paper", "--print-config"]) == 0
    text = capsys.readouterr().out
    assert 'content = "per-view"' in text and "[paint3d]" in text and "[train]" in text


def test_the_paper_preset_is_the_paper():
    from mistyle.stylization.settings import resolve

    paper, fine = (resolve(name, None, {}, {}) for name in ("paper", "fine"))
    assert (paper.stylizer, paper.inpainter) == ("diffusion", "paint3d")
    assert (paper.atlas.size, paper.rig.resolution, len(rig(paper.rig))) == (4096, 1024, 16)
    assert (paper.sweep.order, paper.sweep.histogram, str(paper.sweep.segmenter)) == ("paper", 1.0, "birefnet")
    assert (str(paper.fit.features), paper.fit.bridge, paper.fit.lights) == ("vgg19", "wrap", "together")
    assert (paper.fit.painted, paper.fit.unlight, paper.fit.tv_from) == ("with-light", 0, "style")
    assert (paper.train.steps, paper.train.style_steps, paper.train.rank, paper.train.switch) == (1500, 1000, 64, 500)
    assert (paper.diffusion.steps, paper.diffusion.block, paper.diffusion.repeats) == (30, 10, 10)
    assert (fine.stylizer, fine.inpainter, fine.atlas.size) == ("embedded", "fill", 4096)


def test_losses_are_spoken_of_now_and_then():
    said, shares = [], []
    watch = watcher(said.append, shares.append)
    for step in range(1, 6):
        watch(step, 5, 0.5)
    assert len(said) == 1 and "step 5 of 5: loss over weight 0.5000" in said[0]
    assert shares == pytest.approx([0.2, 0.4, 0.6, 0.8, 1.0])


def test_transparent_styles_are_laid_on_white(tmp_path):
    from mistyle.io.read import read_picture

    pixels = np.zeros((4, 4, 4), np.uint8)
    pixels[:2] = [255, 0, 0, 255]
    Image.fromarray(pixels, "RGBA").save(tmp_path / "x.png")
    shown = opaque(read_picture(tmp_path / "x.png"))
    np.testing.assert_allclose(shown[0, 0], [1, 0, 0], atol=1e-3)
    np.testing.assert_allclose(shown[3, 3], 1, atol=1e-3)
