"""Requests to stop: exit codes, nothing lost inside finalizers, loops that finish their checkpoint, processes that do
not outlive their parent."""

import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from mistyle.core.errors import Stopped
from mistyle.process import stopping

ROOT = Path(__file__).parents[2]
VERB = """
import argparse, os, signal, sys, time
from pathlib import Path
from mistyle.process import stopping
from mistyle.cli import exits
def command(options):
    print("ready", flush=True)
    BODY
    return 0
sys.exit(exits.run(command, argparse.Namespace()))
"""
SLEEP = "\n    ".join(["for _ in range(200):", "    time.sleep(0.05)"])
IN_FINALIZER = "\n    ".join(
    [
        "class Busy:",
        "    def __del__(self):",
        "        signal.raise_signal(signal.SIGNUM)",
        "        for _ in range(10): time.sleep(0.001)",
        "Busy()",
        "for _ in range(200): time.sleep(0.05)",
    ]
)
AT_CHECKPOINT = "\n    ".join(
    [
        "with stopping.at_checkpoints():",
        "    print('looping', flush=True)",
        "    while not stopping.asked(): time.sleep(0.01)",
        "    time.sleep(0.2)",
        "    print('checkpoint written', flush=True)",
        "print('not reached')",
    ]
)
BETWEEN_TRIES = "\n    ".join(
    [
        "try:",
        "    print('trying', flush=True)",
        "    time.sleep(10)",
        "except KeyboardInterrupt:",
        "    print('held', flush=True)",
        "    time.sleep(60)",
    ]
)


def run(body: str, *signals: int, wait: str = "ready") -> tuple[int, str]:
    """A command with this body that gets the signals: exit code and words."""
    # A background job of a shell has interrupts ignored, and its children inherit that.
    heard = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)\n"
    child = subprocess.Popen(
        [sys.executable, "-c", heard + VERB.replace("BODY", body)], cwd=ROOT, text=True,
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
    )  # fmt: skip
    assert child.stdout is not None
    words = ""
    while wait not in words:
        words += child.stdout.readline()
    for number in signals:
        child.send_signal(number)
        time.sleep(0.3)
    words += child.stdout.read()
    return child.wait(20), words


@pytest.mark.parametrize(
    ("number", "code", "said"), [("SIGTERM", 75, "stopped on request"), ("SIGINT", 130, "interrupted")]
)
def test_a_request_ends_with_its_code_and_a_sentence(number, code, said):
    for body in (SLEEP, IN_FINALIZER.replace("SIGNUM", number)):
        sent = [getattr(signal, number)] if body is SLEEP else []
        ended, words = run(body, *sent)
        assert ended == code and said in words and "Traceback" not in words and "Exception ignored" not in words


def test_a_second_interrupt_ends_at_once_and_a_second_stop_changes_nothing():
    code, words = run(BETWEEN_TRIES, signal.SIGINT, signal.SIGINT, wait="trying")
    assert code == 130 and "held" in words and "Traceback" not in words
    code, words = run(AT_CHECKPOINT, signal.SIGTERM, wait="looping")
    assert code == 75 and "checkpoint written" in words and "not reached" not in words


def test_an_interrupt_that_is_ignored_stays_so():
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        with stopping.listening():
            assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN
            signal.raise_signal(signal.SIGINT)
            with pytest.raises(Stopped):
                signal.raise_signal(signal.SIGTERM)
            signal.raise_signal(signal.SIGTERM)  # on its way already
            assert stopping.asked()
            with pytest.raises(Stopped):
                stopping.check()
        assert not stopping.asked()
    finally:
        signal.signal(signal.SIGINT, before)


def test_a_process_ends_with_its_parent_and_not_before_it(tmp_path):
    worker = (
        "from mistyle.process.children import end_with_asker as end; end()\n"
        "import time; print('on', flush=True); time.sleep(60)"
    )
    parent = (
        "import os, subprocess, sys\n"
        f"child = subprocess.Popen([sys.executable, '-c', {worker!r}], stdout=subprocess.PIPE,"
        " env=os.environ | {'MISTYLE_PARENT': str(os.getpid())})\n"
        "child.stdout.readline(); print(child.pid, flush=True); child.wait()"
    )
    process = subprocess.Popen([sys.executable, "-c", parent], stdout=subprocess.PIPE, text=True, cwd=ROOT)
    assert process.stdout is not None
    pid = int(process.stdout.readline())
    time.sleep(0.2)
    assert alive(pid)
    process.kill()
    process.wait()
    until = time.monotonic() + 3
    while alive(pid) and time.monotonic() < until:
        time.sleep(0.02)
    assert not alive(pid)


def alive(pid: int) -> bool:
    from mistyle.io.store.lock import alive

    return alive(pid)


def test_a_parent_that_is_gone_counts():
    code = "from mistyle.process.children import end_with_parent as end; end(0); print('on')"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 75 and not done.stdout
