"""What was left out, guessed or repaired is said: on the console, in --json, in run.json and in the report."""

import json
import time
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

from mistyle.cli.main import main
from mistyle.jobs import progress as jobs_progress
from mistyle.jobs.progress import Progress, grouped
from mistyle.stylization.optimise.judge import TOLERANCE, regressed, undone_where
from mistyle.stylization.report import summary
from mistyle.stylization.report.page import fit_facts
from tests.support.verbs import VERBS


def read_albedo(mesh) -> np.ndarray:
    """The colour of the file's one material, in sRGB of 8 bits."""
    from mistyle.core.image import srgb_from_linear
    from mistyle.io.read_mesh import read_mesh

    return np.round(255 * srgb_from_linear(np.array(read_mesh(mesh).materials[0].albedo_factor)))


NOTE = "The mesh has no normals"  # of the square: smooth ones are computed


@pytest.mark.parametrize("verb", ["render", "bake", "stylize", "fit", "lookdev", "variations", "shard"])
def test_notes_of_the_mesh_are_printed_at_the_end_and_in_json(verb_inputs, tmp_path, capsys, verb):
    words = VERBS[verb].words(verb_inputs, tmp_path / "out")
    assert main([*words, *(["--json"] if verb != "shard" else [])]) == 0
    captured = capsys.readouterr()
    last = captured.err.splitlines()
    lines = [line for line in last if line.startswith("note      ")]
    assert sum(NOTE in line for line in lines) == 1 and last[-len(lines) :] == lines
    if verb != "shard":
        assert any(NOTE in text for text in json.loads(captured.out)["notes"])
    if verb in ("stylize", "fit"):
        told = json.loads((tmp_path / "out" / "run.json").read_text())["notes"]
        assert [f"note      {' '.join(text.split())}" for text in told] == lines
        assert NOTE in (tmp_path / "out" / "report" / "index.html").read_text()
        # A run that takes everything over says the same.
        assert main(words) == 0
        again = capsys.readouterr().err.splitlines()
        assert [line for line in again if line.startswith("note      ")] == lines


@pytest.mark.parametrize("lights", [True, False])
def test_lit_views_are_noted_and_unlit_ones_keep_the_albedo(tmp_path, capsys, lights):
    """The sequence of the README: `render`, then `bake`."""
    mesh, views, out = tmp_path / "plate.obj", tmp_path / "views", tmp_path / "out"
    corners = "v -1 -1 0\nv 1 -1 0\nv 1 1 0\nv -1 1 0\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\n"
    mesh.write_text(f"mtllib plate.mtl\n{corners}usemtl paint\nf 1/1 2/2 3/3 4/4\n")
    (tmp_path / "plate.mtl").write_text("newmtl paint\nKd 1 0.6867 0\n")
    unlit = [] if lights else ["--unlit"]
    assert main(["render", str(mesh), "-o", str(views), "--resolution", "64", *unlit]) == 0
    assert bool(json.loads((views / "lights.json").read_text())["lights"]) == lights
    capsys.readouterr()
    assert main(["bake", str(mesh), str(views), "-o", str(out), "--atlas", "64", "--json"]) == 0
    with Image.open(out / "textures" / "plate_albedo.png") as picture:
        middle = np.asarray(picture.convert("RGB"), int)[16:48, 16:48].reshape(-1, 3)
    assert (np.abs(middle - read_albedo(mesh)).max() <= 1) == (not lights)
    captured = capsys.readouterr()
    assert any("lights.json" in text and "mistyle fit" in text for text in json.loads(captured.out)["notes"]) == lights
    assert ("note      The folder of the pictures has lights.json" in captured.err) == lights


def test_a_note_made_in_a_stage_is_said_again_where_the_stage_is_taken_over(tmp_path):
    from mistyle.jobs.stages import Run
    from mistyle.stylization.pipeline.job import STAGES, Job
    from mistyle.stylization.settings import resolve

    job = Job(tmp_path / "m.obj", tmp_path / "s.png", tmp_path / "out", resolve("draft", None, {}, {}), "x")
    for _ in range(2):
        progress = Progress(quiet=True)
        with Run(job, progress, STAGES) as run:
            run.stage("views", [], [], lambda folder, report, say=progress.note: say("a part was left out"))
        assert progress.notes == ["a part was left out"]
    assert progress.reused == ["views"]


def test_notes_of_many_are_one_line_each():
    assert grouped([("a", "x"), ("b", "x"), ("c", "y"), ("d", "x"), ("e", "x")]) == ["a, b, d and 1 more: x", "c: y"]


def test_the_figures_of_an_undone_phase_are_those_before_it(monkeypatch):
    """Else `run.json` would praise or blame maps that nobody has."""
    figures = {"phase1.detail": (0.9, 0.4), "phase2.style": (5.0, 3.0)}
    fit = SimpleNamespace(figures=figures, kept={"phase1": False, "phase2": True})
    empty = SimpleNamespace(texels=(), maps=(), seen=(), mask=())
    made = SimpleNamespace(fit=fit, atlas=empty, repaired=empty, baked=empty, light=None, finishing=None, reshaped=None)
    found = summary.figures(made)
    assert found["phase1.detail"] == 0.9 and found["phase2.style"] == 3.0


def test_the_sentence_about_undone_phases_states_the_tolerances_that_decide():
    before = {"detail": 0.8, "style": 2.0, "views": 0.5}
    sentence = undone_where()
    for name, (share, absolute) in TOLERANCE.items():
        change = share * before[name] + absolute
        sign = -1 if name == "detail" else 1
        assert regressed(before, before | {name: before[name] + sign * 0.99 * change}) == []
        assert regressed(before, before | {name: before[name] + sign * 1.01 * change}) == [name]
        part = next(p for p in sentence.replace(" or ", ", ").split(", ") if name in p)
        assert all(f"{value:.0%}" in part for value in [share] if value)
        assert all(f"{value:g}" in part for value in [absolute] if value)


def test_a_kept_phase_says_what_got_worse_within_the_tolerance():
    figures = {"detail": (0.90, 0.88), "style": (2.0, 1.5), "views": (0.5, 0.5)}
    judged = SimpleNamespace(kept={"phase1": True}, figures={f"phase1.{name}": pair for name, pair in figures.items()})
    assert dict(fit_facts(judged))["phase1"] == "kept; worse within the tolerance: detail"
    judged.figures["phase1.detail"] = (0.88, 0.90)
    assert dict(fit_facts(judged))["phase1"] == "kept; no figure got worse"
    assert dict(fit_facts(SimpleNamespace(kept={"phase1": True}, figures={})))["phase1"] == "kept, not judged"


def test_unlit_views_have_no_scene(tmp_path, capsys):
    scene = tmp_path / "room.xml"
    scene.write_text('<scene version="3.0.0"/>')
    words = ["render", str(tmp_path / "a.obj"), "-o", str(tmp_path / "out"), "--unlit", "--scene", str(scene)]
    assert main(words) == 2 and "--unlit" in capsys.readouterr().err


def test_a_silent_stage_shows_that_it_goes_on():
    said = []
    with jobs_progress._signs_of_life("read the asset", said.append, every=0.1) as say:
        say("first")
        time.sleep(0.5)
    assert said[0] == "first" and 1 <= len(said) - 1 <= 4
    assert all(line == "  read the asset: 0 s so far" for line in said[1:])
    count = len(said)
    time.sleep(0.2)
    assert len(said) == count
