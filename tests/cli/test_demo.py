"""`mistyle demo`: its paintings and meshes, --all and its sheet."""

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from mistyle.cli.demo_inputs import MESHES, PAINTINGS, ROW, demo_files
from mistyle.cli.main import main
from mistyle.core.paths import scenes
from mistyle.stylization.pipeline import stylize as pipeline


@pytest.fixture
def jobs(monkeypatch):
    """The jobs that would run: each leaves a picture of its own brightness and size where a run leaves it."""
    seen = []

    def stylize(job, progress):
        progress.note(f"a note of {job.out.name}")
        picture = job.out / "report" / "overview.png"
        picture.parent.mkdir(parents=True)
        Image.new("RGB", (300 + 100 * len(seen), 200), (50 * len(seen),) * 3).save(picture)
        seen.append(job)
        return {"asset": "a", "report": "r", "picture": str(picture), "notes": list(progress.notes)}

    monkeypatch.setattr(pipeline, "stylize", stylize)
    return seen


def test_every_file_that_the_demo_names_is_there():
    for style in [None, *PAINTINGS]:
        for mesh in [None, *MESHES]:
            assert all(path.is_file() for path in demo_files(style, mesh))
    assert {painting.mesh for painting in PAINTINGS.values()} == set(MESHES), "no mesh is left out by default"


@pytest.mark.parametrize(
    ("words", "mesh", "style"),
    [
        ([], "demo.obj", "demo_mosaic.jpg"),
        (["--style", "oil"], "demo.obj", "demo_style.png"),
        (["--style", "pixel"], "robot.obj", "demo_pixel.png"),
        (["--mesh", "robot"], "robot.obj", "demo_mosaic.jpg"),
        (["--style", "hatched", "--mesh", "elephant"], "demo.obj", "demo_hatched.png"),
    ],
)
def test_style_and_mesh_choose_what_is_painted(tmp_path, monkeypatch, words, mesh, style):
    chosen = []
    summary = dict.fromkeys(("asset", "textures", "report", "picture", "views", "stylized"), "")
    monkeypatch.setattr(pipeline, "stylize", lambda job, progress: chosen.append(job) or summary)
    assert main(["demo", "-o", str(tmp_path / "out"), *words]) == 0
    (job,) = chosen
    assert (job.mesh, job.style) == (scenes() / mesh, scenes() / style)
    assert job.out == tmp_path / "out" and job.name == "demo"
    assert job.settings.surface.samples == 150_000, "the preset demo"


def test_all_runs_four_jobs_and_lays_their_pictures_on_one_sheet(tmp_path, jobs, capsys):
    out = tmp_path / "demos"
    assert main(["demo", "--all", "-o", str(out), "--json", "--seed", "7", "--atlas", "512"]) == 0
    made = json.loads(capsys.readouterr().out)
    assert [job.out for job in jobs] == [out / name for name in PAINTINGS]
    assert [(job.mesh, job.style) for job in jobs] == [demo_files(name, None) for name in PAINTINGS]
    assert all(job.settings.seed == 7 and job.settings.atlas.size == 512 for job in jobs)
    assert len({job.name for job in jobs}) == 4, "four assets can lie in one folder"
    assert made["notes"] == [f"a note of {name}" for name in PAINTINGS]
    assert made["runs"][2]["notes"] == ["a note of hatched"], "a run's notes are its own"
    sheet = np.asarray(Image.open(made["sheet"]))
    assert Path(made["sheet"]) == out / "demo.png" and sheet.shape == (4 * ROW, round(600 * ROW / 200), 3)
    for k in range(4):
        assert (sheet[k * ROW : (k + 1) * ROW, : round((300 + 100 * k) * ROW / 200) - 2] == 50 * k).all()
    assert (sheet[:ROW, -10:] == 255).all()


def test_all_with_one_mesh(tmp_path, jobs):
    assert main(["demo", "--all", "--mesh", "robot", "-o", str(tmp_path / "out")]) == 0
    assert {job.mesh for job in jobs} == {scenes() / "robot.obj"} and len({job.style for job in jobs}) == 4


def test_all_plans_without_running(tmp_path, jobs, capsys):
    assert main(["demo", "--all", "-o", str(tmp_path / "out"), "--dry-run", "--json"]) == 0
    assert set(json.loads(capsys.readouterr().out)) == set(PAINTINGS)
    assert not jobs and not (tmp_path / "out").exists()


@pytest.mark.parametrize("words", [["--style", "oil"], ["--variations", "2"]])
def test_all_does_not_go_with_a_choice(tmp_path, jobs, words, capsys):
    assert main(["demo", "--all", "-o", str(tmp_path / "out"), *words]) == 2
    assert words[0] in capsys.readouterr().err and not jobs


def test_a_sheet_of_someone_else_is_not_covered(tmp_path, jobs, capsys):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "demo.png").write_bytes(b"mine")
    assert main(["demo", "--all", "-o", str(tmp_path / "out")]) == 2
    assert "demo.png" in capsys.readouterr().err and not jobs


def test_unknown_names_are_refused_with_the_known_ones(capsys):
    with pytest.raises(SystemExit) as ended:
        main(["demo", "--style", "watercolour"])
    said = capsys.readouterr().err
    assert ended.value.code == 2 and all(name in said for name in PAINTINGS)


def test_help_has_examples(capsys):
    with pytest.raises(SystemExit):
        main(["demo", "--help"])
    said = capsys.readouterr().out
    assert "mistyle demo --all" in said and "mistyle demo --style pixel" in said
