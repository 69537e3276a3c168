"""The main job on a small mesh, end to end: what it writes, that a killed run ends as an uninterrupted one, and that
nothing is redone without need."""

import hashlib
import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

import mistyle
from mistyle.core.errors import InputRefused, Stopped, UsageError
from mistyle.jobs.progress import Progress
from mistyle.stylization.pipeline import painting
from mistyle.stylization.pipeline import stylize as pipeline
from mistyle.stylization.pipeline.job import FIRST, REFINING, STAGES, Job
from mistyle.stylization.settings import resolve

TINY = {
    "rig": {"resolution": 64},
    "draw": {"spp": 2},
    "surface": {"samples": 3000},
    "atlas": {"size": 128, "padding": 4},
    "fit": {"refine": "all", "iterations1": 4, "iterations2": 4, "crops": 1, "crop_size": 32},
    "report": {"frames": 4, "resolution": 64, "spp": 2},
    "threads": 2,
}


@pytest.fixture(scope="module")
def inputs(tmp_path_factory) -> tuple[Path, Path]:
    """A dumb-bell without UVs and a painting of diagonal strokes."""
    folder = tmp_path_factory.mktemp("inputs")
    ball = trimesh.creation.icosphere(subdivisions=2)
    ball.vertices *= 1 + 0.5 * np.cos(np.arctan2(ball.vertices[:, 1], 0.7) * 2)[:, None]
    ball.export(folder / "bell.obj")
    y, x = np.mgrid[:96, :128] / 16
    stripes = np.stack([np.sin(x + y) * 0.4 + 0.5, np.sin(x + y + 1) * 0.3 + 0.4, np.cos(x - y) * 0.2 + 0.3], axis=-1)
    Image.fromarray((stripes * 255).astype(np.uint8)).save(folder / "strokes.png")
    return folder / "bell.obj", folder / "strokes.png"


def job(inputs: tuple[Path, Path], out: Path, **more) -> Job:
    return Job(inputs[0], inputs[1], out, resolve("draft", None, TINY, {}), "bell", **more)


def hashes(out: Path) -> dict[str, str]:
    """Every file of the asset and the stylized views, and the stored maps, but not the report, which holds times."""
    found = [
        p for part in ("asset", "stylized", "views", "work") for p in sorted((out / part).rglob("*")) if p.is_file()
    ]
    return {
        str(p.relative_to(out)): hashlib.sha256(p.read_bytes()).hexdigest() for p in found if not p.name.startswith(".")
    }


@pytest.fixture(scope="module")
def whole(inputs, tmp_path_factory) -> Path:
    """An uninterrupted run."""
    out = tmp_path_factory.mktemp("whole")
    pipeline.stylize(job(inputs, out), Progress(quiet=True))
    return out


def test_everything_promised_is_there(whole):
    names = {f"bell_{kind}.{ending}" for kind in ("albedo", "normal", "roughness", "orm") for ending in ("png", "exr")}
    assert names == {p.name for p in (whole / "asset" / "textures").iterdir()}
    assert len(list((whole / "views").glob("*.exr"))) == len(list((whole / "stylized").glob("*.png"))) == 16
    assert (whole / "report" / "index.html").stat().st_size > 10_000
    run = json.loads((whole / "run.json").read_text())
    assert set(run["seconds"]) == {*STAGES, *FIRST} and run["peak_gb"] > 0
    assert run["settings"]["surface"]["samples"] == 3000 and run["versions"]["mitsuba"].startswith("3.9")


def test_an_independent_reader_opens_the_asset(whole, inputs):
    ours = trimesh.load(whole / "asset" / "bell.glb", force="mesh", process=False)
    theirs = trimesh.load(inputs[0], force="mesh", process=False)
    np.testing.assert_allclose(ours.bounds, theirs.bounds, atol=1e-5)
    assert len(ours.faces) == len(theirs.faces)
    picture = np.asarray(ours.visual.material.baseColorTexture.convert("RGB"), float)
    assert picture.std(axis=(0, 1)).min() > 5, "the albedo holds the painting, not a constant"


def test_the_fit_moved_the_maps(whole):
    from mistyle.io.store.records import load_record

    start, final = (load_record(whole / "work" / name / "record").maps[0] for name in ("bake", "repair"))
    assert not np.array_equal(start.normal, final.normal)
    assert final.roughness.std() > 1e-5 and np.isfinite(final.normal).all()


def test_a_run_stopped_in_three_stages_resumes_to_the_same_bytes(inputs, whole, tmp_path, monkeypatch):
    """Stopped in the middle of a stage, again in two later ones, then run to the end: asset, stylized views and maps
    have the same bytes, and no run makes again what one before it had finished."""

    def stop(*arguments, **keywords):
        raise Stopped("on request")

    stops = {"surface": (painting, "paint"), "fit": (pipeline, "fit"), "asset": (pipeline, "write_asset")}
    done = set()
    for stage, (module, function) in stops.items():
        progress = Progress(quiet=True)
        with monkeypatch.context() as patch:
            patch.setattr(module, function, stop)
            with pytest.raises(Stopped):
                pipeline.stylize(job(inputs, tmp_path), progress)
        assert (tmp_path / "asset").exists() == (stage != "surface"), "the first asset is there once it is baked"
        assert set(progress.reused) == done, "what was finished before is taken over"
        done = set(progress.seconds) & set(STAGES) - {stage}
    progress = Progress(quiet=True)
    pipeline.stylize(job(inputs, tmp_path), progress)
    assert set(progress.reused) == done
    assert hashes(tmp_path) == hashes(whole)


def test_a_painted_surface_is_final_by_default(inputs, whole, tmp_path):
    """Goes on from what was painted: no fit, no masks, no repair, no asset that another replaces; --from goes on behind
    what was left out."""
    from mistyle.io.store.records import load_record

    painted = shutil.ignore_patterns("masks", "asset", "report", "stylized", "fit", "repair")
    made, progress = job(inputs, shutil.copytree(whole, tmp_path / "out", ignore=painted)), Progress(quiet=True)
    unfitted = made.settings.model_copy(update={"fit": made.settings.fit.model_copy(update={"refine": "auto"})})
    made = replace(made, settings=unfitted)
    summary = pipeline.stylize(made, progress)
    assert list(progress.seconds) == [name for name in STAGES if name not in REFINING]
    assert summary["figures"]["repaired_share"] == 0 and not (made.out / "masks").exists()
    baked = load_record(made.out / "work" / "bake" / "record").maps[0]
    covered = load_record(made.out / "work" / "texels" / "record").texels[0].covered
    assert np.abs(baked.normal[covered, :2]).mean() > 0.02 and baked.roughness[covered].std() > 0.005
    normal = np.asarray(Image.open(made.out / "asset" / "textures" / "bell_normal.png"), float)[..., :2] / 255 * 2 - 1
    assert np.abs(normal[covered] - baked.normal[covered, :2]).mean() < 0.02
    assert "--refine all" in (made.out / "report" / "index.html").read_text()
    again = Progress(quiet=True)
    pipeline.stylize(replace(made, redo_from="repair"), again)
    assert "bake" in again.reused and "asset" not in again.reused


def test_a_second_run_takes_everything_over_and_from_redoes(inputs, whole):
    before = hashes(whole)
    progress = Progress(quiet=True)
    pipeline.stylize(job(inputs, whole), progress)
    assert progress.reused == list(STAGES)
    progress = Progress(quiet=True)
    pipeline.stylize(job(inputs, whole, redo_from="repair"), progress)
    assert "fit" in progress.reused and "repair" not in progress.reused and "asset" not in progress.reused
    assert hashes(whole) == before


def test_unknown_stages_and_busy_folders_are_refused(inputs, tmp_path):
    with pytest.raises(UsageError, match="there is no such stage"):
        pipeline.stylize(job(inputs, tmp_path / "a", redo_from="paint"), Progress(quiet=True))


@pytest.mark.parametrize("name", ["style_mask", "protect", "direction_map"])
def test_pictures_of_the_coat_that_are_not_there_end_it_at_once(inputs, tmp_path, name):
    settings = resolve("draft", None, {**TINY, "paint": {name: str(tmp_path / "no.png")}}, {})
    with pytest.raises(InputRefused, match=r"no\.png: found nothing; expected a picture"):
        pipeline.stylize(Job(inputs[0], inputs[1], tmp_path / "a", settings, "bell"), Progress(quiet=True))
    assert not (tmp_path / "a").exists()


def test_the_python_call_does_the_same(inputs, whole):
    summary = mistyle.stylize(*inputs, whole, preset="draft", name="bell", **TINY)
    assert Path(summary["asset"]).is_file() and summary["figures"]["painted_share"] > 0.99
