"""Batches: what a jobs file becomes, what a plan is, what a shard skips, how a farm's files look."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from mistyle.batch import engines
from mistyle.batch.farm import ShardNeeds, export
from mistyle.batch.jobs_file import read_jobs
from mistyle.batch.page import write_page
from mistyle.batch.pipeline import Choices, describe, describe_dry_run, dry_run, planned, run_batch, summarise
from mistyle.batch.plan import PLAN, indices, path_maps, read_plan, replaced, write_plan
from mistyle.batch.shard import finished, marker, outcome
from mistyle.core.errors import InputRefused, MistyleError, UsageError
from tests.support.batch_parts import CUBE, done_by_hand, jobs_file, stand_in


def test_a_folder_is_a_grid_of_what_lies_in_it(props):
    records = read_jobs(props, 2)
    assert [r.name for r in records] == ["box_ink", "box_wave", "cube_ink", "cube_wave"]
    assert all(r.mesh.is_file() and r.style is not None and r.style.is_file() for r in records)
    assert all(r.settings["threads"] == 2 for r in records)


LIST = """[[job]]
mesh = "meshes/cube.obj"
style = "styles/wave.png"
[[job]]
mesh = "meshes/box.obj"
style = "styles/ink.jpg"
"""
GRID = '[[grid]]\nmeshes = ["meshes/cube.obj", "meshes/b*.obj"]\nstyles = ["styles/*"]\n'
EVERY = {"list": ["cube_wave", "box_ink"], "grid": ["cube_ink", "cube_wave", "box_ink", "box_wave"]}
EVERY["folder"] = ["box_ink", "box_wave", "cube_ink", "cube_wave"]


@pytest.mark.parametrize("kind", ["list", "grid", "folder"])
@pytest.mark.parametrize("where", ["beside", "elsewhere", "inside", "absolute"])
def test_paths_are_those_of_the_jobs_file_or_folder_wherever_one_stands(props, kind, where, monkeypatch, capsys):
    from mistyle.cli.main import main

    jobs = props if kind == "folder" else jobs_file(props, {"list": LIST, "grid": GRID}[kind])
    (props.parent / "elsewhere").mkdir()
    stand = {"beside": props.parent, "elsewhere": props.parent / "elsewhere", "inside": props}.get(where, Path("/"))
    monkeypatch.chdir(stand)
    named = str(jobs) if where == "absolute" else os.path.relpath(jobs, stand)
    out = str(props.parent / "out") if where == "absolute" else os.path.relpath(props.parent / "out", stand)
    assert main(["batch", named, "-o", out, "--dry-run", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert [row["name"] for row in told["jobs"]] == EVERY[kind]
    assert not any(row["refused"] for row in told["jobs"]) and all(row["memory_gb"] > 0 for row in told["jobs"])
    assert main(["farm", "export", named, "-o", out, "--as", "openjd"]) == 0
    # Read where a worker stands, from the plan alone.
    monkeypatch.chdir("/")
    records = read_plan(props.parent / "out").jobs
    assert [r.name for r in records] == EVERY[kind]
    meshes = {
        f"{name}_{style}": props / "meshes" / f"{name}.obj" for name in ("cube", "box") for style in ("wave", "ink")
    }
    for record in records:
        assert record.style is not None and record.mesh.is_absolute() and record.style.is_absolute()
        assert record.mesh.samefile(meshes[record.name]) and record.style.stem == record.name.partition("_")[2]
    listed = json.loads((props.parent / "out" / "farm" / "asset_references.yaml").read_text())["assetReferences"]
    assert all(Path(name).is_file() for name in listed["inputs"]["filenames"])


def test_files_in_settings_are_placed_like_the_others(props, monkeypatch):
    for name in ("mask.png", "weights.pth", "gold.png"):
        (props / name).write_bytes(b"")
    settings = """
        { "paint.protect" = "mask.png", fit = { features = "/abs/w.pth" }, "rig.file" = "../cameras.json",
          "paint.slots" = ["wood=gold.png", "mask.png=gold.png"], "colour.config" = "ocio://default" }
    """
    jobs_file(props, LIST + f"settings = {' '.join(settings.split())}\n")
    monkeypatch.chdir(props.parent)
    monkeypatch.setenv("MISTYLE_VGG", "here.pth")
    first, second = (r.settings for r in read_jobs(Path("props/jobs.toml"), 1))
    # The environment speaks of where one stands.
    assert first["fit"]["features"] == str(props.parent / "here.pth") and first["paint"]["protect"] is None
    assert second["paint"]["protect"] == str(props / "mask.png") and second["fit"]["features"] == "/abs/w.pth"
    assert second["rig"]["file"] == str(props / "../cameras.json")
    assert second["paint"]["slots"] == [f"wood={props}/gold.png", f"{props}/mask.png={props}/gold.png"]
    assert second["colour"]["config"] == "ocio://default"


def test_a_list_a_grid_and_what_holds_for_all(props):
    path = jobs_file(
        props,
        """
        preset = "draft"
        settings = { "report.frames" = 5, fit = { refine = "off" } }
        [[job]]
        mesh = "meshes/cube.obj"
        style = "styles/wave.png"
        name = "my cube/1"
        settings = { "fit.crops" = 3, threads = 1 }
        [[grid]]
        meshes = ["meshes/*.obj"]
        styles = ["styles/ink.jpg"]
        presets = ["draft", "standard"]
        variants = [{}, { seed = 7 }]
        """,
    )
    records = read_jobs(path, 4)
    assert [r.name for r in records][:3] == ["my-cube-1", "box_ink_draft_v0", "box_ink_draft_v1"]
    assert len(records) == 1 + 2 * 1 * 2 * 2
    first = records[0].settings
    assert (first["report"]["frames"], first["fit"]["refine"], first["fit"]["crops"]) == (5, "off", 3)
    assert first["threads"] == 1 and records[1].settings["threads"] == 4
    assert first["rig"]["resolution"] == 512  # of the preset
    assert records[2].settings["seed"] == 7
    assert records[3].settings["rig"]["resolution"] == 1024


def test_a_file_with_brackets_in_its_name_is_that_file(props, tmp_path):
    (props / "meshes" / "[v2] cube.obj").write_text(CUBE)
    (props / "styles" / "wave?*.png").write_bytes((props / "styles" / "wave.png").read_bytes())
    text = '[[grid]]\nmeshes = ["meshes/[v2] cube.obj", "meshes/[b]*.obj"]\nstyles = ["styles/wave?*.png"]\n'
    records = read_jobs(jobs_file(props, text), 1)
    assert [record.mesh.name for record in records] == ["[v2] cube.obj", "box.obj"]
    assert all(record.style is not None and record.style.name == "wave?*.png" for record in records)
    # A folder names its own files.
    assert {record.mesh.name for record in read_jobs(props, 1)} == {"[v2] cube.obj", "box.obj", "cube.obj"}
    with pytest.raises(InputRefused, match="matches no file"):
        read_jobs(jobs_file(props, text.replace("[v2]", "[v3]")), 1)


def test_yaml_says_the_same(props):
    toml = jobs_file(props, '[grid]\nmeshes = ["meshes/cube.obj"]\nstyles = ["styles/ink.jpg", "styles/wave.png"]\n')
    yaml = jobs_file(
        props, "grid:\n  meshes: [meshes/cube.obj]\n  styles: [styles/ink.jpg, styles/wave.png]\n", "j.yaml"
    )
    assert read_jobs(toml, 1) == read_jobs(yaml, 1)


def test_a_fit_to_references_is_a_job_too(props):
    (props / "photographs").mkdir()
    path = jobs_file(props, '[[job]]\nmesh = "meshes/cube.obj"\nreferences = "photographs"\nlights = "unknown"\n')
    (record,) = read_jobs(path, 2)
    assert record.kind == "fit" and record.name == "cube_fit" and record.lights == "unknown"
    assert "recover" in record.settings


def test_all_that_is_wrong_is_told_before_anything_runs(props):
    path = jobs_file(
        props,
        """
        [[job]]
        mesh = "meshes/none.obj"
        style = "styles/wave.png"
        [[job]]
        mesh = "meshes/cube.obj"
        style = "styles/none.png"
        [[job]]
        mesh = "meshes/cube.obj"
        [[job]]
        mesh = "meshes/cube.obj"
        style = "styles/wave.png"
        settings = { "fit.itrations1" = 3 }
        """,
    )
    with pytest.raises(InputRefused) as refused:
        read_jobs(path, 1)
    text = str(refused.value)
    for words in ("4 of 4 jobs", "none.obj", "none.png", "neither", "did you mean 'fit.iterations1'"):
        assert words in text


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "found no job"),
        ("jobs = 3\n", "there is no setting 'jobs'"),
        ("[[job]\n", "cannot be read"),
        ('[[grid]]\nmeshes = ["m/*.obj"]\nstyles = ["styles/*"]\n', "matches no file"),
        ("preset = 3\n", "preset"),
    ],
)
def test_a_wrong_jobs_file_is_refused(props, text, words):
    with pytest.raises(MistyleError, match=words):
        read_jobs(jobs_file(props, text), 1)
    with pytest.raises(MistyleError):
        read_jobs(props / "nothing.toml", 1)


def test_a_yaml_file_builds_no_objects(props):
    with pytest.raises(UsageError, match="cannot be read"):
        read_jobs(jobs_file(props, "job: !!python/object/apply:os.system ['true']\n", "j.yaml"), 1)


def test_equal_names_are_told_apart(props):
    text = '[[job]]\nmesh = "meshes/cube.obj"\nstyle = "styles/wave.png"\n'
    assert [r.name for r in read_jobs(jobs_file(props, text * 3), 1)] == ["cube_wave", "cube_wave-2", "cube_wave-3"]


def test_a_plan_comes_back_as_it_was_and_moves_with_its_paths(props, tmp_path):
    plan = planned(props, tmp_path / "out", Choices(threads=1))
    path = write_plan(plan)
    before = path.read_bytes()
    assert read_plan(tmp_path / "out") == plan and write_plan(read_plan(path)).read_bytes() == before
    moved = read_plan(path, path_maps([f"{tmp_path}=/vol/show", f"{props}=/vol/props"]))
    assert moved.out == Path("/vol/show/out")
    assert str(moved.jobs[0].mesh) == "/vol/props/meshes/box.obj"
    assert planned(tmp_path / "out", None, Choices()) == plan
    with pytest.raises(UsageError, match="leave out -o"):
        planned(path, tmp_path / "other", Choices())
    path.write_text(json.dumps({"version": 99}))
    with pytest.raises(InputRefused, match="version"):
        read_plan(path)


def test_path_maps_take_whole_folders_and_the_longest_first():
    maps = (("/mnt/a", "/x"), ("/mnt/a/b", "/y"))
    assert replaced("/mnt/a/c", maps) == "/x/c"
    assert replaced("/mnt/a/b/c", maps) == "/y/c"
    assert replaced("/mnt/ab", maps) == "/mnt/ab"
    assert replaced("C:\\show\\cube.obj", (("C:\\show", "/vol"),)) == "/vol/cube.obj"
    for wrong in ("a=b", "/a", "/a="):
        with pytest.raises(UsageError, match="FROM=TO"):
            path_maps([wrong])


def test_indices():
    assert indices("3", 4) == (3,) and indices("0-2,1,5", 6) == (0, 1, 2, 5)
    for wrong in ("4", "x", "1-", "0-9"):
        with pytest.raises(UsageError):
            indices(wrong, 4)


def test_a_shard_is_done_only_while_its_key_and_its_files_hold(props, tmp_path):
    plan = planned(props, tmp_path / "out", Choices(threads=1))
    job = plan.jobs[0]
    assert finished(plan, job) is None
    done_by_hand(plan, 0)
    assert finished(plan, job) is not None and outcome(plan, job).state == "done"
    changed = job.model_copy(update={"settings": job.settings | {"seed": 5}})
    assert finished(plan, changed) is None
    (plan.out / job.name / "asset" / "a.glb").write_bytes(b"broken")
    assert finished(plan, job) is None
    (plan.out / job.name / "asset" / "a.glb").write_bytes(b"glTF")
    assert finished(plan, job) is not None
    job.mesh.write_text(CUBE + "v 0 0 0\n")
    assert finished(plan, job) is None


def test_one_failing_shard_does_not_stop_the_others(props, tmp_path, monkeypatch):
    """Number 1 ends with an error, number 2 crashes twice, number 3 crashes once and is done on the plain path."""
    plan = planned(props, tmp_path / "out", Choices(threads=1))
    tries = tmp_path / "tries"
    script = (
        "import os,sys,signal\nk=int(sys.argv[1])\nplain=os.environ.get('MISTYLE_PLAIN','')\n"
        f"open({str(tries)!r},'a').write(f'{{k}}{{plain}} ')\n"
        "print('words of', k, flush=True)\n"
        "if k==1: sys.exit(3)\n"
        "if k==2 or (k==3 and not plain): os.kill(os.getpid(), signal.SIGSEGV)\n"
    )
    stand_in(monkeypatch, script)
    for index in (0, 3):
        done_by_hand(plan, index)
        marker(plan, plan.jobs[index]).rename(tmp_path / f"{index}.json")
    seen = []
    ended = engines.local(plan, range(4), 2, lambda k, e: seen.append((k, e)))
    assert {e.index: (e.code, e.tries) for e in ended} == {0: (0, 1), 1: (3, 1), 2: (-11, 2), 3: (0, 2)}
    assert sorted(tries.read_text().split()) == ["0", "1", "2", "21", "3", "31"]
    assert len(seen) == 8
    for index in (0, 3):
        (tmp_path / f"{index}.json").rename(marker(plan, plan.jobs[index]))
    summary = summarise(plan, {e.index: e for e in ended}, 5.0, 0)
    assert [r["state"] for r in summary["rows"]] == ["done", "failed", "failed", "done"]
    assert "words of 1" in summary["rows"][1]["last_lines"] and "twice" in summary["rows"][2]["error"]
    assert summary["retry"] == f"mistyle batch {plan.out / PLAN} --only box_wave cube_ink"
    text = describe(summary)
    assert "2 of 4 done" in text and "retry" in text


def test_a_shard_that_takes_too_long_is_stopped(props, tmp_path, monkeypatch):
    plan = planned(props, tmp_path / "out", Choices(threads=1))
    stand_in(monkeypatch, "import time; time.sleep(60)")
    (ended,) = engines.local(plan, [0], 1, lambda k, e: None, timeout=1.0)
    assert ended.code == -15


def test_an_interrupted_batch_stops_its_shards(props, tmp_path, monkeypatch):
    plan = planned(props, tmp_path / "out", Choices(threads=1))
    pids = tmp_path / "pids"
    stand_in(monkeypatch, f"import os,time; open({str(pids)!r},'a').write(f'{{os.getpid()}} '); time.sleep(60)")

    def interrupt(index, ended):
        if index == 1:
            import time

            while not pids.exists():
                time.sleep(0.05)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        engines.local(plan, range(4), 2, interrupt)
    for pid in pids.read_text().split():
        with pytest.raises(ProcessLookupError):
            os.kill(int(pid), 0)


def test_what_is_done_is_not_begun_again_and_unknown_names_are_refused(props, tmp_path, monkeypatch):
    plan = planned(props, tmp_path / "out", Choices(threads=1))
    for index in range(3):
        done_by_hand(plan, index)
    stand_in(monkeypatch, "import sys; sys.exit(0 if sys.argv[1] == '3' else 9)")
    summary = run_batch(plan, Choices(threads=1))
    assert (summary["reused"], summary["done"], summary["open"], summary["failed"]) == (3, 3, 1, 0)
    with pytest.raises(UsageError, match="no such job"):
        run_batch(plan, Choices(only=("nobody",)))


def test_the_page_escapes_names_and_allows_no_connection(props, tmp_path):
    plan = planned(props, tmp_path / "out", Choices(threads=1))
    done_by_hand(plan, 0)
    picture = plan.out / plan.jobs[0].name / "report" / "beauty.png"
    picture.parent.mkdir(parents=True)
    Image.new("RGB", (640, 480), (200, 30, 30)).save(picture)
    ended = {1: engines.Ended(1, 3, 1)}
    summary = summarise(plan, ended, 1.0, 0)
    summary["rows"][1]["error"] = "<script>alert(1)</script>"
    text = write_page(plan, summary).read_text()
    assert "<script>alert" not in text and "&lt;script&gt;alert" in text
    assert "default-src 'none'" in text and "http://" not in text and "https://" not in text
    assert text.count("data:image/webp") == 1 and 'data-value="0.5"' in text


def test_the_dry_run_adds_up(props, tmp_path):
    plan = planned(props, tmp_path / "out", Choices(threads=1, workers=2))
    done_by_hand(plan, 0)
    told = dry_run(plan, Choices(threads=1, workers=2))
    assert [row["done"] for row in told["jobs"]] == [True, False, False, False]
    assert told["seconds"] == round(sum(r["seconds"] for r in told["jobs"][1:]) / 2)
    assert told["memory_gb"] == pytest.approx(2 * told["jobs"][1]["memory_gb"], abs=0.1)


def test_the_dry_run_knows_fits_and_what_will_be_refused(props, tmp_path):
    for name in ("shots", "empty"):
        (props / name).mkdir()
    image = Image.fromarray(np.full((96, 128, 3), 90, np.uint8))
    frames = []
    for k in range(4):
        image.save(props / "shots" / f"p{k}.png")
        matrix = np.eye(4)
        matrix[2, 3] = 4.0 + k
        frames.append({"file_path": f"p{k}.png", "transform_matrix": matrix.tolist()})
    (props / "shots" / "transforms.json").write_text(json.dumps({"camera_angle_x": 0.6, "frames": frames}))
    sun = {"type": "directional", "direction": [0, 0, 1], "irradiance": [3, 3, 3]}
    (props / "shots" / "lights.json").write_text(json.dumps({"lights": [sun]}))
    text = "".join(
        f'[[job]]\nmesh = "meshes/cube.obj"\nname = "{name}"\nreferences = "{name}"\n' for name in ("shots", "empty")
    )
    plan = planned(jobs_file(props, text), tmp_path / "out", Choices(threads=2))
    told = dry_run(plan, Choices(threads=2))
    good, bad = told["jobs"]
    assert good["seconds"] > 10 and good["memory_gb"] > 0.5 and good["refused"] is None
    assert bad["seconds"] == 0 and "camera.json" in bad["refused"]
    assert told["seconds"] == good["seconds"]
    assert f"about {good['seconds']} s" in describe_dry_run(told) and "will be refused: " in describe_dry_run(told)


def test_slurm_and_command_lines_name_every_shard(props, tmp_path):
    plan = planned(props, tmp_path / "out with space", Choices(threads=1))
    maps = ((str(tmp_path), "/vol"),)
    (lines,) = export(plan, tmp_path / "farm", "commands", ShardNeeds(threads=2, maps=maps))
    assert len(lines.read_text().splitlines()) == 4
    assert "'/vol/out with space/plan.json' --index 3 --path-map" in lines.read_text()
    (script,) = export(plan, tmp_path / "farm", "sbatch", ShardNeeds(threads=2, memory_gb=6, gpus=1))
    text = script.read_text()
    for words in ("--array=0-3", "--cpus-per-task=2", "--mem=6144M", "--gres=gpu:1", "${SLURM_ARRAY_TASK_ID}"):
        assert words in text
    assert subprocess.run(["bash", "-n", str(script)]).returncode == 0


def test_the_bundle_is_a_valid_job_template(props, tmp_path):
    """Open Job Description's own program checks it."""
    pytest.importorskip("openjd.cli")
    plan = planned(props, tmp_path / "out", Choices(threads=1))
    files = export(plan, tmp_path / "farm", "openjd", ShardNeeds(threads=2, memory_gb=6, gpus=1, chunk=2))
    assert [f.name for f in files] == ["template.yaml", "parameter_values.yaml", "asset_references.yaml"]
    openjd = Path(sys.executable).with_name("openjd")
    checked = subprocess.run(
        [openjd, "check", files[0], "--extensions", "TASK_CHUNKING"], capture_output=True, text=True
    )
    assert checked.returncode == 0, checked.stdout + checked.stderr
    references = json.loads(files[2].read_text())["assetReferences"]
    assert len(references["inputs"]["filenames"]) == 4
