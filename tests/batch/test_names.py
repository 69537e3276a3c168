"""Names of jobs: what tells equal ones apart, and that a mesh keeps its name when others come and go."""

import json
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import pytest

from mistyle.batch.names import OWN, JobSource, job_names
from mistyle.batch.page import write_page
from mistyle.batch.pipeline import Choices, dry_run, opening_notes, planned, run_batch
from mistyle.batch.plan import PLAN, SHARDS, write_plan
from mistyle.cli.main import main
from mistyle.core.errors import UsageError
from mistyle.core.names import ASSET, is_safe
from tests.support.batch_parts import CUBE, done_by_hand, jobs_file, stand_in

ONE = Choices(threads=1)
BASE = Path("/show")


def named(*files: str, style: str = "s/style.png", before=None) -> list[str]:
    return job_names([JobSource(BASE / file, BASE / style) for file in files], BASE, before)


@pytest.mark.parametrize(
    ("files", "names"),
    [
        (["a/cube.obj", "b/box.obj"], ["cube_style", "box_style"]),
        (["bench/model.obj", "chair/model.obj"], ["bench_model_style", "chair_model_style"]),
        (["bench/geo/model.obj", "chair/geo/model.obj"], ["bench_model_style", "chair_model_style"]),
        (["a/v1/m.obj", "a/v2/m.obj", "b/v1/m.obj"], ["a_v1_m_style", "a_v2_m_style", "b_v1_m_style"]),
        (["p/a.obj", "p/a.ply"], ["a_obj_style", "a_ply_style"]),
        (["p/a.obj", "p/a.ply", "q/a.obj"], ["p_a_obj_style", "p_a_ply_style", "q_a_style"]),
        (["m.obj", "x/m.obj"], ["show_m_style", "x_m_style"]),
        (["p/a.obj"] * 3, ["a_style", "a_style-2", "a_style-3"]),
        (["p/a.obj", "q/a.obj", "p/a.obj"], ["p_a_style", "q_a_style", "p_a_style-2"]),
    ],
)
def test_equal_names_are_told_apart_by_folder_or_ending(files, names):
    assert named(*files) == names
    # The place in the list decides nothing but the number of a file that is listed again.
    assert sorted(named(*reversed(files))) == sorted(names)


def test_styles_and_references_tell_apart_too():
    sources = [JobSource(BASE / "a.obj", BASE / f"{kind}/wave.png") for kind in ("ink", "oil")]
    assert job_names(sources, BASE) == ["a_ink_wave", "a_oil_wave"]
    sources += [JobSource(BASE / "p/a.obj", BASE / "ink/wave.png")]
    assert job_names(sources, BASE) == ["show_a_ink_wave", "show_a_oil_wave", "p_a_ink_wave"]
    fits = [JobSource(BASE / "chair.glb", BASE / shots / "fit") for shots in ("day", "night")]
    assert job_names(fits, BASE) == ["chair_day_fit", "chair_night_fit"]
    variants = [JobSource(BASE / f"{k}/m.obj", BASE / "s.png", (v,)) for k in "ab" for v in ("v0", "v1")]
    assert job_names(variants, BASE) == ["a_m_s_v0", "a_m_s_v1", "b_m_s_v0", "b_m_s_v1"]


def test_what_no_name_tells_apart_gets_a_digest_that_does_not_depend_on_the_others():
    upper, lower = names = named("p/Case.obj", "p/case.obj")
    assert upper.startswith("Case_style-") and lower.startswith("case_style-") and upper[-6:] != lower[-6:]
    assert named("p/case.obj", "p/CASE.obj", "p/Case.obj")[::2] == names[::-1]
    # A name that another job has by itself stays there.
    single, *others = named("z/bench_model.obj", "bench/model.obj", "chair/model.obj")
    assert single == "bench_model_style" and others[0].startswith("bench_model_style-")
    long = named(*(f"p/{'x' * 90}{end}.obj" for end in "ab"))
    assert len(set(long)) == 2 and all(is_safe(name) and len(name) <= ASSET for name in long)


def test_a_name_of_the_user_comes_first():
    sources = [JobSource(BASE / "a.obj", BASE / "s.png"), JobSource(BASE / "b.obj", BASE / "s.png", chosen="a_s")]
    first, second = job_names(sources, BASE)
    assert second == "a_s" and first.startswith("a_s-") and not first.endswith("-2")
    before = {sources[1].files(): ["b_s"], sources[0].files(): ["a_s"]}
    assert job_names(sources, BASE, before)[1] == "a_s"


def test_names_of_the_plan_before_stay():
    def files(file: str) -> tuple[str, str]:
        return JobSource(BASE / file, BASE / "s/style.png").files()

    before = {files("bench/model.obj"): ["model_style"], files("chair/model.obj"): ["model_style-2"]}
    three = ["sofa/model.obj", "bench/model.obj", "chair/model.obj"]
    assert named(*three, before=before) == ["sofa_model_style", "model_style", "model_style-2"]
    assert named("chair/model.obj", before=before) == ["model_style-2"]
    # Names of other words are not those of this job.
    assert named("bench/model.obj", before={files("bench/model.obj"): ["hero", "model_style_v1"]}) == ["model_style"]


@pytest.mark.parametrize("name", ["batch.html", "PLAN.json", "batch.json", "shards", "farm", "Shards ", "a.failed"])
def test_names_of_the_batchs_own_files_are_refused_before_anything(props, tmp_path, name, capsys):
    text = "".join(f'[[job]]\nmesh = "meshes/cube.obj"\nstyle = "styles/wave.png"\nname = "{n}"\n' for n in ("a", name))
    jobs = str(jobs_file(props, text))
    for rest in (["--dry-run"], []):
        assert main(["batch", jobs, "-o", str(tmp_path / "out"), *rest]) == 2
        assert "1 of 2 jobs cannot run" in (said := capsys.readouterr().err) and "Choose another name" in said
    assert not (tmp_path / "out").exists()
    # A plan of an older version may have such a name.
    plan = planned(jobs_file(props, text.replace(f'"{name}"', '"b"')), tmp_path / "out", ONE)
    write_plan(replace(plan, jobs=(plan.jobs[0], plan.jobs[1].model_copy(update={"name": name.strip()}))))
    with pytest.raises(UsageError, match="Choose another name in the jobs file"):
        planned(tmp_path / "out", None, ONE)


def test_names_that_only_look_like_the_batchs_own_are_taken(props, tmp_path):
    assert set(OWN) >= {PLAN, SHARDS}
    text = '[[job]]\nmesh = "meshes/cube.obj"\nstyle = "styles/wave.png"\nname = "{}"\n'
    names = ["plan", "batch", "shards_2", "b.failed"]
    jobs = jobs_file(props, "".join(map(text.format, names)))
    assert [job.name for job in planned(jobs, tmp_path / "out", ONE).jobs] == names


def test_the_printed_retry_works_in_a_shell(props, tmp_path, monkeypatch, capsys):
    text = '[[job]]\nmesh = "meshes/cube.obj"\nstyle = "styles/wave.png"\nname = "{}"\n'
    jobs = jobs_file(props, "".join(map(text.format, ["-b", "a", "木", "--json", "done"])))
    plan = planned(jobs, tmp_path / "out of it's", ONE)
    write_plan(plan)
    stand_in(monkeypatch, "import sys; sys.exit(0 if sys.argv[1] == '4' else 9)")
    retry = run_batch(plan, ONE)["retry"]
    shell = subprocess.run(
        ["sh", "-c", f'mistyle() {{ printf "%s\\n" "$@"; }}; {retry}'], capture_output=True, text=True
    )
    words = shell.stdout.splitlines()
    assert words == ["batch", str(plan.out / PLAN), "--only", "a", "木", "--only=-b", "--only=--json"]
    assert main([*words, "--threads", "1", "--json"]) == 1
    rows = json.loads(capsys.readouterr().out)["rows"]
    assert [row["state"] for row in rows] == ["failed"] * 4 + ["open"]


@pytest.fixture
def assets(props) -> Path:
    """A jobs file of meshes that are all called model.obj; two there, bench and chair."""
    for name in ("bench", "chair"):
        place = props / "assets" / name
        place.mkdir(parents=True)
        (place / "model.obj").write_text(CUBE + f"# {name}\n")
    return jobs_file(props, '[[grid]]\nmeshes = ["assets/*/model.obj"]\nstyles = ["styles/wave.png"]\n')


def test_a_mesh_keeps_its_folder_when_others_come_and_go(assets, tmp_path):
    out, props = tmp_path / "out", assets.parent

    def jobs() -> dict[str, str]:
        plan = planned(assets, out, ONE)
        assert not opening_notes(plan)
        write_plan(plan)
        return {job.mesh.parent.name: job.name for job in plan.jobs}

    chair = props / "assets" / "chair"
    away = props / "chair"
    shutil.move(chair, away)
    assert jobs() == {"bench": "model_wave"}
    done_by_hand(planned(assets, out, ONE), 0)
    shutil.move(away, chair)
    assert jobs() == {"bench": "model_wave", "chair": "chair_model_wave"}
    shutil.copytree(chair, props / "assets" / "arch")
    every = jobs()
    assert every == {"arch": "arch_model_wave", "bench": "model_wave", "chair": "chair_model_wave"}
    shutil.rmtree(props / "assets" / "bench")
    assert jobs() == {"arch": "arch_model_wave", "chair": "chair_model_wave"}


def test_a_folder_of_another_mesh_is_noted_before_anything_runs(props, tmp_path, capsys):
    def listed(mesh: str) -> Path:
        return jobs_file(props, f'[[job]]\nmesh = "meshes/{mesh}.obj"\nstyle = "styles/wave.png"\nname = "hero"\n')

    (props / "meshes" / "box.obj").write_text(CUBE + "# box\n")
    out = tmp_path / "out"
    plan = planned(listed("cube"), out, ONE)
    done_by_hand(plan, 0)
    write_plan(plan)
    assert not planned(listed("cube"), out, ONE).notes
    (note,) = planned(listed("box"), out, ONE).notes
    assert note.startswith("hero: ") and "cube.obj" in note and "box.obj" in note
    assert main(["batch", str(props / "jobs.toml"), "-o", str(out), "--threads", "1", "--dry-run"]) == 0
    assert note in capsys.readouterr().err
    # A plan without the job is forgotten, the mark of the finished job is not.
    write_plan(replace(plan, jobs=()))
    assert planned(listed("box"), out, ONE).notes == (note,)
    # The same content at another path is not another mesh: the job is done.
    shutil.copy(props / "meshes" / "cube.obj", props / "meshes" / "copy.obj")
    assert not planned(listed("copy"), out, ONE).notes


def test_the_summary_and_the_page_name_the_files(props, tmp_path, monkeypatch):
    stand_in(monkeypatch, "import sys; sys.exit(9)")
    plan = planned(props, tmp_path / "out", ONE)
    summary = run_batch(plan, ONE)
    told = json.loads((plan.out / "batch.json").read_text())["rows"]
    assert [(row["mesh"], row["style"]) for row in told] == [(str(j.mesh), str(j.style)) for j in plan.jobs]
    text = write_page(plan, summary).read_text()
    assert all(str(job.mesh) in text and str(job.style) in text for job in plan.jobs)
    assert dry_run(plan, ONE)["jobs"][0]["mesh"] == str(plan.jobs[0].mesh)
