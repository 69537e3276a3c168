"""Edit and go on: a view, a mask or a map of a finished run is painted over and the same command run again. Only what
depends on it is made anew; the edit stays; a run without edits ends as before."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

from mistyle.core.camera import look_at
from mistyle.core.errors import InputRefused
from mistyle.core.view import View
from mistyle.io.read import read_exr, read_picture
from mistyle.io.store.records import load_record
from mistyle.jobs.progress import Progress
from mistyle.stylization.pipeline import stylize as pipeline
from mistyle.stylization.pipeline.job import STAGES, Job
from mistyle.stylization.pipeline.retouch import EXACT, LOSSY, differs
from mistyle.stylization.settings import resolve

TINY = {
    "rig": {"kind": "turntable", "views": 6, "resolution": 96},
    "draw": {"spp": 1},
    "surface": {"samples": 1000},
    "atlas": {"size": 128, "padding": 4},
    "fit": {"refine": "all", "iterations1": 1, "iterations2": 1, "crops": 1, "crop_size": 32, "judge": False},
    "report": {"frames": 4, "resolution": 64, "spp": 1},
    "threads": 2,
}
RED = np.array([230, 20, 30], np.uint8)


class Heard(Progress):
    """Keeps what is said."""

    def __init__(self) -> None:
        super().__init__()
        self.said: list[str] = []

    def say(self, text: str) -> None:
        self.said.append(text)

    def note(self, *texts: str) -> None:
        super().note(*texts)
        self.said += texts


@pytest.fixture(scope="module")
def inputs(tmp_path_factory) -> tuple[Path, Path]:
    """A ball without UVs and a painting of blue and green stripes."""
    folder = tmp_path_factory.mktemp("inputs")
    trimesh.creation.icosphere(subdivisions=2).export(folder / "ball.obj")
    y, x = np.mgrid[:64, :64] / 9
    stripes = np.stack([np.full_like(x, 0.1), np.sin(x + y) * 0.3 + 0.5, np.cos(x - y) * 0.3 + 0.6], axis=-1)
    Image.fromarray((stripes * 255).astype(np.uint8)).save(folder / "stripes.png")
    return folder / "ball.obj", folder / "stripes.png"


def run(inputs: tuple[Path, Path], out: Path, **more) -> Heard:
    heard = Heard()
    pipeline.stylize(Job(*inputs, out, resolve("draft", None, TINY, {}), "ball", **more), heard)
    return heard


@pytest.fixture(scope="module")
def finished(inputs, tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("finished") / "out"
    run(inputs, out)
    return out


@pytest.fixture
def out(finished, tmp_path) -> Path:
    """A finished run folder of one's own."""
    return shutil.copytree(finished, tmp_path / "out")


def redone(heard: Heard) -> list[str]:
    return [name for name in heard.seconds if name not in heard.reused]


def bytes_of(folder: Path) -> dict[str, bytes]:
    return {p.relative_to(folder).as_posix(): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def test_a_view_that_was_painted_over_is_laid_into_the_texture(inputs, out):
    view = sorted((out / "stylized").glob("*.png"))[3]
    original, asset = view.read_bytes(), bytes_of(out / "asset")
    picture = np.asarray(Image.open(view)).copy()
    centre = slice(picture.shape[0] * 3 // 10, picture.shape[0] * 7 // 10)
    picture[centre, centre, :3] = RED
    Image.fromarray(picture).save(view)
    mine, before = view.read_bytes(), read_exr(out / "asset" / "textures" / "ball_albedo.exr")
    heard = run(inputs, out)
    assert redone(heard) == ["retouch", "fit", "masks", "repair", "asset", "report"]
    assert any(s.startswith(f"stylized/{view.name} was edited") for s in heard.said), heard.said
    assert f"stylized/{view.name} was edited" in (out / "report" / "index.html").read_text()
    assert view.read_bytes() == mine
    made = load_record(out / "work" / "retouch" / "record")
    albedo, earlier = made.baked.maps[0].albedo, load_record(out / "work" / "bake" / "record").maps[0].albedo
    red = (albedo[..., 0] > 0.6) & (albedo[..., 1] < 0.05)
    # The patch is a thirtieth of the ball; a texel of it is as red as it was painted, all others keep their colour.
    assert 0.01 < red.mean() < 0.05
    changed = np.abs(albedo - earlier).max(axis=-1) > 1e-3
    assert changed.mean() < 1.3 * red.mean()
    k = sorted((out / "stylized").glob("*.png")).index(view)
    others = [v for j, v in enumerate(made.views) if j != k]
    assert max((v.rgb[..., 0] > 0.5).mean() for v in others) > 0.005, "neighbours see the patch as well"
    after = read_exr(out / "asset" / "textures" / "ball_albedo.exr")
    assert np.abs(after["R"].astype(float) - before["R"].astype(float)).max() > 0.3
    again = run(inputs, out)
    assert redone(again) == [] and any("kept" in s for s in again.said)
    view.write_bytes(original)
    assert redone(run(inputs, out)) == ["fit", "masks", "repair", "asset", "report"]
    assert bytes_of(out / "asset") == asset, "an edit that is taken back leaves nothing"


def test_a_mask_that_was_painted_over_decides_what_is_repaired(inputs, out):
    mask = out / "masks" / "ball.png"
    wanted = np.zeros_like(np.asarray(Image.open(mask)))
    wanted[20:60, 20:60] = 255
    Image.fromarray(wanted).save(mask)
    heard = run(inputs, out)
    assert redone(heard) == ["repair", "asset", "report"]
    assert "masks/ball.png was edited: repair, asset and report are redone." in heard.said
    assert np.array_equal(np.asarray(Image.open(mask)), wanted)
    repaired = load_record(out / "work" / "repair" / "record").mask[0]
    assert repaired.any() and not (repaired & (wanted == 0)).any()


@pytest.mark.parametrize("ending", ["png", "exr"])
def test_a_map_that_was_painted_over_is_in_the_asset(inputs, out, ending):
    textures = out / "asset" / "textures"
    if ending == "png":
        picture = np.asarray(Image.open(textures / "ball_albedo.png")).copy()
        picture[10:40, 10:40] = RED
        Image.fromarray(picture).save(textures / "ball_albedo.png")
    else:
        from mistyle.io.images.write import write_exr

        planes = dict(read_exr(textures / "ball_albedo.exr"))
        for name, value in zip("RGB", (0.791, 0.007, 0.013), strict=True):
            planes[name] = planes[name].copy()
            planes[name][10:40, 10:40] = value
        write_exr(textures / "ball_albedo.exr", planes, half=True)
    normal = (textures / "ball_normal.png").read_bytes()
    heard = run(inputs, out)
    assert redone(heard) == ["asset", "report"]
    assert f"asset/textures/ball_albedo.{ending} was edited: the asset and the report are redone." in heard.said
    patch = np.asarray(Image.open(textures / "ball_albedo.png"))[10:40, 10:40]
    assert np.abs(patch.astype(int) - RED).max() <= 1
    linear = read_exr(textures / "ball_albedo.exr")
    assert abs(float(linear["R"][20, 20]) - 0.791) < 0.01 and float(linear["G"][20, 20]) < 0.01
    assert (textures / "ball_normal.png").read_bytes() == normal
    inside = trimesh.load(out / "asset" / "ball.glb", force="mesh", process=False).visual.material.baseColorTexture
    assert np.abs(np.asarray(inside.convert("RGB"))[10:40, 10:40].astype(int) - RED).max() <= 1
    listed = json.loads((out / "asset" / "ball.json").read_text())
    assert listed["provenance"]["edited"] == [f"textures/ball_albedo.{ending}"]
    assert redone(run(inputs, out)) == []
    # A second edit keeps the first.
    shine = np.full(np.asarray(Image.open(textures / "ball_roughness.png")).shape, 51, np.uint8)
    Image.fromarray(shine).save(textures / "ball_roughness.png")
    assert redone(run(inputs, out)) == ["asset", "report"]
    assert np.abs(np.asarray(Image.open(textures / "ball_albedo.png"))[10:40, 10:40].astype(int) - RED).max() <= 1
    assert np.abs(np.asarray(Image.open(textures / "ball_orm.png"))[..., 1].astype(int) - 51).max() <= 1


def test_edits_are_set_aside_and_said_where_what_they_stand_on_is_made_anew(inputs, out):
    albedo = out / "asset" / "textures" / "ball_albedo.png"
    picture = np.asarray(Image.open(albedo)).copy()
    picture[:] = RED
    Image.fromarray(picture).save(albedo)
    heard = run(inputs, out, redo_from="repair")
    assert (np.asarray(Image.open(out / "asset.edited-1" / "textures" / "ball_albedo.png")) == RED).all()
    assert not (np.asarray(Image.open(albedo)) == RED).all()
    assert any("asset.edited-1" in s for s in heard.said)


def test_what_may_not_be_edited_is_made_again(inputs, out):
    glb = out / "asset" / "ball.glb"
    whole = glb.read_bytes()
    glb.write_bytes(whole[:-8] + bytes(8))
    assert redone(run(inputs, out)) == ["asset"]
    assert glb.read_bytes() == whole and (out / "asset.broken-1").is_dir()


def test_an_edit_of_another_size_is_refused(inputs, out):
    mask = out / "masks" / "ball.png"
    Image.fromarray(np.zeros((50, 70), np.uint8)).save(mask)
    with pytest.raises(InputRefused, match="found 70 x 50 pixels, expected 128 x 128"):
        run(inputs, out)
    assert read_picture(mask).rgb.shape == (50, 70, 3)


def test_a_finished_run_lists_every_stage_once(inputs, finished):
    again = run(inputs, finished)
    assert again.reused == list(STAGES) and not any("edited" in s for s in again.said)


def test_single_pixels_of_a_lossy_view_are_not_taken_for_painting():
    size, none = (40, 40), np.zeros((40, 40), np.float32)
    camera = look_at([0, 0, 4], fov=30, size=size)
    rgb = np.full((*size, 3), 0.4, np.float32)
    drawn = View(camera, rgb, none, rgb, np.zeros((*size, 2), np.float32), none.astype(int), none == 0, none + 1)
    painted = rgb.copy()
    painted[10, 10] = painted[20:22, 20:22] = painted[30:33, 30:32] = 0.8
    view = replace(drawn, rgb=painted)
    assert differs(view, drawn, *EXACT).sum() == 11
    lossy = differs(view, drawn, *LOSSY)
    assert lossy.sum() == 6 and lossy[30:33, 30:32].all()


def test_views_of_another_size_and_lossy_ones_are_taken(inputs, out):
    """A view saved twice as large, and a .jpg without transparency beside another: both patches are laid in."""
    views = sorted((out / "stylized").glob("*.png"))
    large = Image.open(views[1]).resize((192, 192), Image.Resampling.LANCZOS)
    large.paste(tuple(RED), (70, 70, 120, 120))
    large.save(views[1])
    flat = Image.open(views[4]).convert("RGB")
    flat.paste(tuple(RED), (35, 35, 60, 60))
    flat.save(views[4].with_suffix(".jpg"), quality=90)
    heard = run(inputs, out)
    assert redone(heard) == ["retouch", "fit", "masks", "repair", "asset", "report"]
    made, earlier = (load_record(out / "work" / stage / "record") for stage in ("retouch", "bake"))
    albedo, before = made.baked.maps[0].albedo, earlier.maps[0].albedo
    red = (albedo[..., 0] > 0.3) & (albedo[..., 1] < 0.05)  # more paint than what lay there, where it is laid in softly
    assert 0.01 < red.mean() < 0.04
    # Resampling and compression alter every pixel a little; that is not taken for painting.
    assert (np.abs(albedo - before).max(axis=-1) > 1e-3).mean() < 1.5 * red.mean()
    assert {view.camera.size for view in made.views} == {(96, 96)}
