"""Jobs that are killed again and again, stopped, and run to the end: the bytes are those of an undisturbed one.

`python -m benchmarks.faults --full` does the same fifty times, with larger jobs, `fit` and whole batches.
"""

import os
import shutil
import signal
import sys
import threading
import time
from dataclasses import replace

import numpy as np
import pytest

from benchmarks.faults import jobs
from benchmarks.faults.kills import Moment
from mistyle.batch import engines, shard
from mistyle.batch.pipeline import Choices, describe, planned, summarise
from mistyle.core.paths import scenes
from mistyle.io.store.keeper import Keeper
from mistyle.jobs.progress import Progress

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="kills with POSIX signals")

TINY = {
    "rig.views": 2, "rig.resolution": 48, "surface.samples": 1000, "atlas.size": 64, "fit.iterations1": 2,
    "fit.iterations2": 2, "fit.crop_size": 32, "report.detail": "none",
}  # fmt: skip


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    found = jobs.made(tmp_path_factory.mktemp("inputs"), ("stylize", "fit --scene", "batch"))
    stylize = found["stylize"]
    return found | {"stylize": replace(stylize, words=(*stylize.words, *jobs.sets(TINY)))}


@pytest.mark.parametrize(("name", "kills"), [("stylize", 2), ("fit --scene", 2)])
def test_killed_at_random_moments_stopped_and_run_to_the_end(made, tmp_path, name, kills):
    """Kills and a SIGTERM on the way, each in what the one before left behind."""
    job, whole, out = made[name], tmp_path / "whole", tmp_path / "out"
    start = time.monotonic()
    code, words = jobs.finish(job.line(whole))
    assert code == 0, words
    seconds, rng = time.monotonic() - start, np.random.default_rng(8)
    for turn in range(kills):
        moment = Moment(seconds * (0.3 + 0.4 * rng.random()), int(rng.integers(1, 4)) if turn % 2 else 0)
        child = jobs.begin(job.line(out), tmp_path / "log")
        while not jobs.until(child, moment.reached(out)):
            # It was done before the moment came: the machine is faster now, or less was left to do than thought.
            shutil.rmtree(out)
            moment = moment.earlier()
            child = jobs.begin(job.line(out), tmp_path / "log")
        child.kill()
        child.wait()
    child = jobs.begin(job.line(out), tmp_path / "log")
    log = tmp_path / "log"
    stage = "..." if name == "stylize" else "fit the scene ..."
    while not jobs.until(child, lambda: stage in log.read_text(errors="replace"), pause=0.02):
        # The last kill came when everything was done, and nothing was left to stop.
        shutil.rmtree(out)
        child = jobs.begin(job.line(out), log)
    child.terminate()
    code = child.wait(60)
    assert code == 75 and "Traceback" not in log.read_text(), log.read_text()
    assert name == "stylize" or list((out / "work").glob("checkpoint-*/done.json")), "it ended with a checkpoint"
    code, words = jobs.finish(job.line(out))
    assert code == 0, words
    assert not jobs.differences(jobs.hashes(whole), out)
    assert len(jobs.hashes(out)) > 3


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="looks for processes in /proc")
@pytest.mark.parametrize("number", ["SIGKILL", "SIGTERM"])
def test_the_workers_of_a_batch_go_with_it(made, tmp_path, number):
    """Killed: its shards are gone within a moment, so that the next run does not meet them. Stopped: 75, resumable."""
    out, log = tmp_path / "out", tmp_path / "log"
    child = jobs.begin(made["batch"].line(out), log)
    assert jobs.until(child, lambda: len(jobs.shards(child)) == 2, pause=0.05), log.read_text()
    time.sleep(0.3)
    os.kill(child.pid, getattr(signal, number))
    code = child.wait(60)
    assert code == (75 if number == "SIGTERM" else -9), log.read_text()
    until = time.monotonic() + 3
    while jobs.in_session(child.pid) and time.monotonic() < until:
        time.sleep(0.02)
    assert not jobs.in_session(child.pid)
    assert not list((out / "shards").glob("*.failed.json")), "stopped is not failed"


def test_why_a_process_ended_is_said_in_words():
    assert engines.reason(3) == engines.reason(75) == engines.reason(-signal.SIGTERM) == ""
    assert "crashed in native code (SIGSEGV)" in engines.reason(-signal.SIGSEGV)
    assert "crashed in native code (SIGABRT)" in engines.reason(128 + signal.SIGABRT), "as a shell says it"
    assert "most likely by the system, for lack of memory: run fewer at a time" in engines.reason(-signal.SIGKILL)
    assert "which had run out of memory" in engines.reason(-signal.SIGKILL, memory=True)


def ended(tmp_path, monkeypatch, script: str, timeout: float | None = None) -> tuple[engines.Ended, str]:
    """How a stand-in for a shard ended, and its log."""
    toml = tmp_path / "jobs.toml"
    toml.write_text(f'[[job]]\nmesh = "{scenes() / "demo.obj"}"\nstyle = "{scenes() / "demo_style.png"}"\n')
    plan = planned(toml, tmp_path / "out", Choices(threads=1))
    monkeypatch.setattr(engines, "command", lambda plan, index, maps=(): [sys.executable, "-c", script])
    (found,) = engines.local(plan, [0], 1, lambda index, ended: None, timeout)
    return found, engines.log_of(plan, 0).read_text()


def test_a_native_crash_leaves_its_stack_and_is_tried_on_the_plain_path(tmp_path, monkeypatch):
    """The second try records nothing and takes no kernel from the cache that may have crashed the first."""
    script = (
        "import os\n"
        "plain = os.environ.get('MISTYLE_PLAIN')\n"
        "if not plain:\n    os.abort()\n"
        "cache = os.environ['DRJIT_CACHE_DIR']\n"
        "assert os.path.isdir(cache) and not os.listdir(cache)\n"
        "from mistyle.render.mitsuba import device\n"
        "device.use(threads=1)\n"
        "import drjit as dr, mitsuba as mi\n"
        "twice = device.Frozen(lambda x: x * 2)\n"
        "print(twice(mi.Float([1, 2])), twice.n_recordings, 'recordings')\n"
    )
    found, log = ended(tmp_path, monkeypatch, script)
    assert (found.code, found.tries, found.why) == (0, 2, ""), log
    assert "Fatal Python error: Aborted" in log and "once more, on the plain path" in log
    assert "[2, 4] 0 recordings" in log


def test_a_second_death_and_a_timeout_are_reported(tmp_path, monkeypatch):
    found, log = ended(tmp_path, monkeypatch, "import ctypes; ctypes.string_at(0)")
    assert found.code == -signal.SIGSEGV and found.tries == 2
    assert found.why == "the process crashed in native code (SIGSEGV), twice (the second time on the plain path)"
    assert log.count("Fatal Python error: Segmentation fault") == 2
    plan = planned(tmp_path / "jobs.toml", tmp_path / "out", Choices(threads=1))
    summary = summarise(plan, {0: found}, 1.0, 0)
    (row,) = summary["rows"]
    assert row["state"] == "failed" and row["error"] == found.why and "in string_at" in row["last_lines"]
    assert "in string_at" in describe(summary)
    found, _ = ended(tmp_path, monkeypatch, "import time; time.sleep(60)", timeout=0.5)
    assert found.tries == 1 and found.why == "it took longer than 0.5 s and was stopped"


def test_a_shard_waits_for_the_one_that_still_ends_in_its_folder(tmp_path, monkeypatch):
    said = []
    progress = Progress(quiet=True)
    monkeypatch.setattr(progress, "say", said.append)
    keeper = Keeper(tmp_path / "job")
    threading.Timer(0.6, keeper.close).start()
    start = time.monotonic()
    shard._wait_for_folder(tmp_path / "job", progress)
    assert time.monotonic() - start > 0.5 and len(said) == 1 and "waiting" in said[0]
    shard._wait_for_folder(tmp_path / "job", progress)
    with Keeper(tmp_path / "job"):
        shard._wait_for_folder(tmp_path / "job", progress, seconds=0.3)
    assert len(said) == 2, "and not for ever: the run itself then refuses"
