"""A batch folder that was moved, copied or taken apart: where its jobs run next."""

import shutil
from pathlib import Path

import pytest

from mistyle.batch.pipeline import Choices, opening_notes, planned, run_batch
from mistyle.batch.plan import PLAN, read_plan, write_plan
from mistyle.core.errors import InputRefused, UsageError
from tests.support.batch_parts import done_by_hand, jobs_file, stand_in

ONE = Choices(threads=1)
NOT_RUN = "import sys; sys.exit(9)"


@pytest.fixture
def batch(props, tmp_path) -> Path:
    """A batch of four jobs, all done; the mesh of one lies in the batch's own folder."""
    out = tmp_path / "old"
    (out / "in").mkdir(parents=True)
    shutil.copy(props / "meshes" / "cube.obj", out / "in" / "own.obj")
    text = '[[grid]]\nmeshes = ["meshes/*.obj", "../old/in/own.obj"]\nstyles = ["styles/wave.png"]\n'
    plan = planned(jobs_file(props, text), out, ONE)
    for index in range(len(plan.jobs)):
        done_by_hand(plan, index)
    write_plan(plan)
    return out


def test_a_moved_batch_continues_where_it_lies(batch, monkeypatch):
    stand_in(monkeypatch, NOT_RUN)
    new = batch.rename(batch.with_name("new"))
    plan = planned(new, None, ONE)
    assert plan.out == new and plan.jobs[2].mesh == new / "in" / "own.obj"
    assert plan.jobs[0].mesh.is_relative_to(batch.parent / "props")
    (note,) = opening_notes(plan)
    assert str(batch) in note and str(new) in note
    summary = run_batch(plan, ONE)
    assert (summary["reused"], summary["done"], summary["out"]) == (3, 3, str(new)) and not batch.exists()
    # Its plan names the new place now.
    assert not opening_notes(planned(new, None, ONE)) and planned(new, new, ONE).out == new
    with pytest.raises(UsageError, match="leave out -o"):
        planned(new, batch, ONE)


def test_a_copied_batch_works_in_the_copy_and_a_link_is_the_same_folder(batch, monkeypatch):
    stand_in(monkeypatch, NOT_RUN)
    copy = batch.with_name("copy")
    shutil.copytree(batch, copy)
    before = (batch / PLAN).read_bytes()
    assert run_batch(planned(copy / PLAN, None, ONE), ONE)["out"] == str(copy)
    assert (batch / PLAN).read_bytes() == before and not (batch / "batch.json").exists()
    link = batch.with_name("link")
    link.symlink_to(batch)
    assert read_plan(link).out == batch and not opening_notes(planned(link, None, ONE))


def test_what_cannot_follow_is_refused_with_both_places(batch, props):
    alone = batch.with_name("alone")
    alone.mkdir()
    shutil.copy(batch / PLAN, alone)
    with pytest.raises(UsageError, match="copy of a plan") as refused:
        planned(alone, None, ONE)
    assert str(batch) in str(refused.value) and str(alone) in str(refused.value)
    assert read_plan(alone / PLAN).out == batch, "a shard whose queue copied the plan writes into the batch"
    new = batch.rename(batch.with_name("new"))
    props.rename(props.with_name("elsewhere"))
    with pytest.raises(InputRefused, match="3 of its inputs are not") as lost:
        planned(new, None, ONE)
    assert str(batch) in str(lost.value) and str(new) in str(lost.value)


def test_a_project_that_moved_with_its_batch_keeps_its_jobs(props, tmp_path, monkeypatch):
    stand_in(monkeypatch, NOT_RUN)
    plan = planned(props, props / "out", ONE)
    for index in range(len(plan.jobs)):
        done_by_hand(plan, index)
    write_plan(plan)
    new = props.rename(tmp_path / "moved")
    assert run_batch(planned(new / "out", None, ONE), ONE)["reused"] == 4
    assert planned(new, new / "out", ONE).jobs == planned(new / "out", None, ONE).jobs
