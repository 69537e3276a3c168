"""`mistyle fit` that ends after passes, minutes or a stop request, and continues; time left; the plan's stages."""

import hashlib
import json
import signal

import numpy as np
import pytest

import mistyle
from mistyle.cli.main import main
from mistyle.core.capture import in_memory
from mistyle.core.errors import Stopped
from mistyle.fitting.pipeline import material, passes
from mistyle.fitting.pipeline.job import MATERIAL_STAGES
from mistyle.fitting.pipeline.pictures import watched
from mistyle.fitting.pipeline.times import closing_seconds
from mistyle.fitting.settings.material import MaterialSettings
from mistyle.io.read import read_picture
from mistyle.io.read_mesh import read_mesh
from mistyle.jobs import plan as jobs_plan
from mistyle.jobs import progress as jobs_progress
from mistyle.process import stopping
from mistyle.solver.schedule import TYPICAL
from tests.fitting.test_material import SIDE, SIZE, bowl, one_by_one, orbit

BRIEF = {"iterations": 24, "rounds": 1, "solver_iterations": 6, "bounces": 1, "bounce_samples": 4, "joint": 1}
SETTINGS = {"recover": BRIEF | {"joint_subsamples": 4}, "report": {"detail": "none"}, "atlas": {"size": SIZE}}


@pytest.fixture(scope="module")
def shots(tmp_path_factory):
    """The mesh and eight references."""
    folder = tmp_path_factory.mktemp("passes")
    bowl(folder / "bowl.obj")
    one_by_one(folder / "shots", read_mesh(folder / "bowl.obj", size=SIZE).mesh, orbit(4, 0.55, SIDE // 2))
    return folder


def fit(shots, out, **more):
    return mistyle.fit(shots / "bowl.obj", shots / "shots", out, **(SETTINGS | more))


def hashes(out) -> dict[str, str]:
    files = sorted(p for p in (out / "asset").rglob("*") if p.is_file() and p.name != "done.json")
    return {str(p.relative_to(out)): hashlib.sha256(p.read_bytes()).hexdigest() for p in files}


@pytest.fixture(scope="module")
def whole(shots):
    summary = fit(shots, shots / "whole")
    assert summary["passes"]["done"] == summary["passes"]["planned"] > 4
    return hashes(shots / "whole")


def test_passes_are_recorded_and_give_the_same_bytes_again(shots, whole, tmp_path):
    summary = fit(shots, tmp_path / "minutes", minutes=1e-6)
    done, planned = summary["passes"]["done"], summary["passes"]["planned"]
    assert done == 1 and any(f"after 1 of {planned} passes" in note for note in summary["notes"])
    assert json.loads((tmp_path / "minutes" / "run.json").read_text())["passes"] == summary["passes"]
    again = fit(shots, tmp_path / "passes", passes=done)
    assert again["passes"] == summary["passes"]
    assert hashes(tmp_path / "passes") == hashes(tmp_path / "minutes") != whole
    assert list((tmp_path / "passes" / "work").glob("checkpoint-*"))
    more = fit(shots, tmp_path / "passes")
    assert more["passes"]["done"] == planned and hashes(tmp_path / "passes") == whole
    assert not list((tmp_path / "passes" / "work").glob("checkpoint-*"))


def test_a_stop_request_writes_the_asset_so_far(shots, whole, tmp_path, monkeypatch):
    write, states = passes.write_preliminary, []

    def asked(run, asset, texels, reached, key):
        write(run, asset, texels, reached, key)
        states.append(json.loads((tmp_path / "run.json").read_text()))
        if len(states) == 1:
            signal.raise_signal(signal.SIGTERM)

    monkeypatch.setattr(passes, "write_preliminary", asked)
    with stopping.listening(), pytest.raises(Stopped, match=r"stopped on request after 1 of \d+ passes; .*asset holds"):
        fit(shots, tmp_path)
    assert len(states) == 2 and all(s["finished"] is False and s["passes"]["done"] == 1 for s in states)
    marker = json.loads((tmp_path / "asset" / "done.json").read_text())
    assert marker["passes"] == 1 and (tmp_path / "asset" / "bowl.glb").is_file()
    monkeypatch.setattr(passes, "write_preliminary", write)
    summary = fit(shots, tmp_path)
    assert hashes(tmp_path) == whole and summary["passes"]["done"] == summary["passes"]["planned"]
    assert not any("set aside" in note for note in summary["notes"])


def test_an_asset_of_the_pictures_exists_before_the_first_pass(shots, tmp_path, monkeypatch):
    def stopped(*_):
        raise Stopped("stopped before the first pass")

    monkeypatch.setattr(material, "recovered_maps", stopped)
    with pytest.raises(Stopped):
        fit(shots, tmp_path)
    marker, albedo = tmp_path / "asset" / "done.json", tmp_path / "asset" / "textures" / "bowl_albedo.png"
    assert json.loads(marker.read_text())["first"] is True and (tmp_path / "asset" / "bowl.glb").is_file()
    assert read_picture(albedo, "stored").rgb.std() > 0.02
    written = marker.stat().st_mtime_ns
    with pytest.raises(Stopped):
        fit(shots, tmp_path)
    assert marker.stat().st_mtime_ns == written


def test_the_command_line_takes_both_limits(shots, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(jobs_plan, "slowness", lambda threads: threads / 2)
    words = ["fit", str(shots / "bowl.obj"), str(shots / "shots"), "-o", str(tmp_path / "out"), "--dry-run", "--json"]
    plans = []
    for more in ([], ["--passes", "1"], ["--minutes", "1"], ["--light", "unknown", "--photometry", "full"]):
        assert main([*words, *more]) == 0
        rows = json.loads(capsys.readouterr().out)["stages"]
        plans.append({row["stage"]: row["seconds"] for row in rows})
    assert plans[1]["recover"] < plans[0]["recover"] and sum(plans[2].values()) <= 61
    assert list(plans[3]) == list(MATERIAL_STAGES) and plans[3]["exposures"] > 5
    assert [stage for stage in MATERIAL_STAGES if stage not in plans[0]] == ["photometry", "exposures", "light"]


def test_a_plan_is_that_of_the_machine_as_it_is(shots, tmp_path, capsys, monkeypatch):
    """Half the speed takes twice as long, and `--minutes` then leaves half the work, and twice the time after it."""
    words = ["fit", str(shots / "bowl.obj"), str(shots / "shots"), "-o", str(tmp_path / "out"), "--dry-run", "--json"]
    plans, limited, closing = [], [], []
    for slow in (1.0, 2.0):
        monkeypatch.setattr(jobs_plan, "slowness", lambda threads, slow=slow: slow * threads / 2)
        for kept, more in ((plans, []), (limited, ["--minutes", "0.5"])):
            assert main([*words, *more]) == 0
            kept.append(json.loads(capsys.readouterr().out))
        closing.append(closing_seconds(MaterialSettings(), [256**2], [], False, TYPICAL))
    assert plans[1]["seconds"] == pytest.approx(2 * plans[0]["seconds"], abs=1)
    assert limited[1]["seconds"] <= 31 < limited[0]["seconds"] + 2
    assert closing[1] == pytest.approx(2 * closing[0])


def test_the_time_left_grows_by_a_quarter_at_most(monkeypatch):
    now = [0.0]
    monkeypatch.setattr(jobs_progress.time, "perf_counter", lambda: now[0])
    remaining = jobs_progress.Remaining()
    assert remaining(0.0) is None
    left = []
    for seconds, done in ((10, 0.1), (20, 0.2), (200, 0.21), (400, 0.22), (410, 0.9), (420, 0.99)):
        now[0] = seconds
        left.append(remaining(done))
    assert left[:2] == [pytest.approx(90), pytest.approx(80)]
    assert all(round(b) <= 1.25 * round(a) for a, b in zip(left[:-1], left[1:], strict=True))
    assert left[-1] < 6
    remaining.end_in(2)
    assert remaining(0.99) == pytest.approx(2)


def test_parts_of_a_stage_and_loaded_pictures_report_their_shares():
    told = []
    light, reading, nothing, solving = jobs_progress.parts(told.append, (3.0, 1.0, 0.0, 4.0))
    captures = in_memory(orbit(4, 0.55, 2), [()] * 4, [np.zeros((2, 2, 3), np.float32)] * 4)
    seen = watched(captures, 2, reading)
    for k in (0, 0, 3):
        assert np.array_equal(seen.load(k)[0], captures.load(k)[0])
    assert told == [3.5 / 8, 3.5 / 8, 4 / 8]
    light(0.5)
    nothing(0.5)
    solving(0.25)
    assert told[3:] == [1.5 / 8, 4 / 8, 5 / 8]


def test_a_resumed_stage_counts_from_where_it_began(monkeypatch):
    now = [100.0]
    monkeypatch.setattr(jobs_progress.time, "perf_counter", lambda: now[0])
    lines = []
    report = jobs_progress._lines("fit the material", lines.append)
    report.begin_at(0.5)
    now[0] += 30
    report(0.6)
    assert lines == ["  fit the material: 60 %, about 120 s left"]
