"""What was left out, guessed or repaired is said: on the console, in --json, in run.json and in the report."""

import json
import time
from types import SimpleNamespace

import pytest

from mistyle.cli.main import main
from mistyle.jobs import progress as jobs_progress
from mistyle.jobs.progress import Progress, grouped
from mistyle.stylization.optimise.judge import TOLERANCE, regressed, undone_where
from mistyle.stylization.report import summary
from mistyle.stylization.report.page import fit_facts
from tests.support.verbs import VERBS

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
