"""The same plan through three engines, a worker killed in each: the same bytes come out."""

import json
import os
import re
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from types import SimpleNamespace

import pytest

from benchmarks.faults.jobs import BATCH
from mistyle.batch import engines
from mistyle.batch.farm import ShardNeeds, export
from mistyle.batch.pipeline import Choices, planned, run_batch
from mistyle.batch.plan import PLAN
from mistyle.batch.shard import marker
from mistyle.core.paths import scenes
from mistyle.io.sandbox.asset_folders import ASSETS


def plan_in(folder: Path):
    jobs = folder.parent / "jobs.toml"
    text = BATCH.format(mesh=scenes() / "demo.obj", style=scenes() / "demo_style.png")
    jobs.write_text(re.sub("report = {.*?}", 'report = { detail = "none" }', text, count=1))
    return planned(jobs, folder, Choices(workers=2, threads=1))


def test_a_shard_on_ray_has_the_asset_folders_of_its_batch(tmp_path, monkeypatch):
    """A worker of a running cluster has the environment of its machine, not of the command."""
    monkeypatch.delenv(ASSETS, raising=False)
    line = [sys.executable, "-c", f"import os; print(os.environ.get('{ASSETS}'))"]
    for value, shown in (("/show/assets", "/show/assets"), ("", "None")):
        ended = engines._ray_shard(0, line, str(tmp_path / "log"), str(tmp_path / "begun"), None, value)
        assert ended.code == 0 and (tmp_path / "log").read_text().strip() == shown


def hashes(plan) -> dict[str, str]:
    """Every file of the assets and its hash, as the markers have them; the reports hold times and are left out."""
    told = [json.loads(marker(plan, job).read_text())["files"] for job in plan.jobs]
    return {name: value for files in told for name, value in files.items() if "/asset/" in name}


class Killer(threading.Thread):
    """Ends the first process that runs shard 0 of a plan, once, with the signal that nobody can catch."""

    def __init__(self, plan) -> None:
        super().__init__(daemon=True)
        self.words = [str(plan.out / PLAN).encode(), b"--index", b"0"]
        self.stage = plan.out / plan.jobs[0].name / "work" / "mesh"
        self.killed = 0

    def run(self) -> None:
        until = time.monotonic() + 120
        while time.monotonic() < until and not self.killed:
            for entry in Path("/proc").glob("[0-9]*"):
                try:
                    words = (entry / "cmdline").read_bytes().split(b"\0")
                except OSError:
                    continue
                # In the middle: its first stage is done.
                if b"shard" in words and all(w in words for w in self.words) and self.stage.is_dir():
                    os.kill(int(entry.name), signal.SIGKILL)
                    self.killed = int(entry.name)
                    return
            time.sleep(0.05)


@pytest.fixture(scope="module")
def local(tmp_path_factory):
    """What processes of this machine make, one of them killed on the way and tried again by itself."""
    plan = plan_in(tmp_path_factory.mktemp("local") / "out")
    killer = Killer(plan)
    killer.start()
    summary = run_batch(plan, Choices(workers=2, threads=1))
    assert killer.killed
    assert (summary["done"], summary["failed"]) == (2, 0), summary
    assert "crashed; once more" in engines.log_of(plan, 0).read_text()
    assert "reused from an earlier run" in engines.log_of(plan, 0).read_text()
    return hashes(plan)


needs_proc = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="finds its victim in /proc")


@needs_proc
def test_open_job_description_makes_the_same_bytes(local, tmp_path):
    pytest.importorskip("openjd.cli")
    plan = plan_in(tmp_path / "out")
    python = f"{sys.executable} -m mistyle"
    template = export(plan, tmp_path / "farm", "openjd", ShardNeeds(threads=1, chunk=2, program=python))[0]
    line = [
        Path(sys.executable).with_name("openjd"), "run", template, "--step", "Shards",
        "--job-param", f"Plan={plan.out / PLAN}", "--extensions", "TASK_CHUNKING",
    ]  # fmt: skip
    killer = Killer(plan)
    killer.start()
    first = subprocess.run(line, capture_output=True, text=True)
    # The farm is told of the lost shard, the other one of its chunk was still run; submitted again, the rest is done.
    assert killer.killed and first.returncode != 0
    assert marker(plan, plan.jobs[1]).is_file()
    second = subprocess.run(line, capture_output=True, text=True)
    assert second.returncode == 0, second.stdout[-2000:]
    assert "openjd_progress: " in first.stdout
    assert hashes(plan) == local


@needs_proc
def test_ray_makes_the_same_bytes(local, tmp_path):
    pytest.importorskip("ray")
    plan = plan_in(tmp_path / "out")
    killer = Killer(plan)
    killer.start()
    summary = run_batch(plan, Choices(engine="ray", workers=2, threads=1))
    assert killer.killed
    assert (summary["done"], summary["failed"]) == (2, 0), summary
    assert hashes(plan) == local


@needs_proc
def test_ray_that_cannot_serve_says_so_instead_of_waiting(tmp_path):
    pytest.importorskip("ray")
    from mistyle.core.errors import MistyleError

    plan = plan_in(tmp_path / "out")
    with pytest.raises(MistyleError, match="offers .* GPUs, each shard needs 2"):
        run_batch(plan, Choices(engine="ray", threads=1, gpus=2))


def test_a_cluster_that_does_not_start_is_a_sentence():
    """Ray raises a plain exception, for example where /dev/shm may not be written to."""
    from mistyle.core.errors import MistyleError

    def init(**_: object) -> None:
        raise Exception("The node timed out\nduring startup.")

    ended: list[bool] = []
    with pytest.raises(MistyleError, match="did not start on this machine: The node timed out during startup.*local"):
        engines._start_cluster(SimpleNamespace(init=init, shutdown=lambda: ended.append(True)))
    assert ended
