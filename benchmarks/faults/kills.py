"""Jobs that are killed with -9 at random moments, run again, and compared with what an undisturbed one makes."""

import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.faults.jobs import Job, begin, differences, finish, hashes, in_session, made, shards, until

MOST_WRITES = 12  # a moment in the middle of writing is the appearance of one of the first so many hidden names
ORPHANS = 3.0  # seconds within which the workers of a killed batch have to be gone


@dataclass(frozen=True)
class Whole:
    """An undisturbed job: its files and how long it took."""

    job: Job
    hashes: dict[str, str]
    seconds: float


@dataclass(frozen=True)
class Kill:
    """One kill: whom, when, and what was wrong afterwards (nothing where it was survived)."""

    name: str
    moment: str
    wrong: str


def undisturbed(job: Job, out: Path) -> Whole:
    """Run the job to the end, twice: the first one compiles kernels, and the second must make the same bytes."""
    code, words = finish(job.line(out))
    if code != 0:
        raise SystemExit(f"{job.name}: the undisturbed job ended with {code}:\n{words[-2000:]}")
    first = hashes(out)
    shutil.rmtree(out)
    start = time.monotonic()
    finish(job.line(out))
    seconds = time.monotonic() - start
    if hashes(out) != first:
        raise SystemExit(f"{job.name}: two undisturbed jobs differ: {differences(first, out)}")
    return Whole(job, first, seconds)


@dataclass(frozen=True)
class Moment:
    """When to kill: after some seconds, or (with `write`) when so many hidden names have appeared."""

    seconds: float
    write: int

    def reached(self, out: Path) -> Callable[[], bool]:
        start, seen = time.monotonic(), set()
        if self.write:
            return lambda: len(_hidden(out, seen)) >= self.write
        return lambda: time.monotonic() - start > self.seconds

    def earlier(self) -> "Moment":
        return Moment(self.seconds * 0.8, (self.write + 1) // 2)

    def __str__(self) -> str:
        return f"in write {self.write}" if self.write else f"after {self.seconds:.1f} s"


def drawn(rng: np.random.Generator, seconds: float) -> Moment:
    """A random moment of a job of so many seconds."""
    writing = rng.random() < 0.5
    return Moment(rng.random() * seconds, int(rng.integers(1, MOST_WRITES + 1)) if writing else 0)


def kill(whole: Whole, out: Path, rng: np.random.Generator) -> Kill:
    """Kill the job once, run it again, compare."""
    job, log = whole.job, out.with_suffix(".log")
    moment = drawn(rng, whole.seconds)
    of_shard = job.name == "batch" and rng.random() < 0.5
    while True:
        child = begin(job.line(out), log)
        if until(child, moment.reached(out)):
            break
        shutil.rmtree(out)  # it was done before the moment came
        moment = moment.earlier()
    if of_shard:
        wrong = _shard_killed(child)
        code, words = child.wait(300), log.read_text(errors="replace")
    else:
        wrong = _killed(child)
        code, words = finish(job.line(out))
    wrong += f"; the run after it ended with {code}: {words.strip()[-300:]}" if code else ""
    found = "" if code else differences(whole.hashes, out)
    wrong = "; ".join(part for part in (wrong.strip("; "), found) if part)
    if not wrong:
        shutil.rmtree(out)
    return Kill(job.name, f"{moment}, one shard" if of_shard else str(moment), wrong)


def _hidden(out: Path, seen: set[str]) -> set[str]:
    for folder in (out, out / "work", *out.glob("*/work"), *(p.parent for p in out.glob("*/work"))):
        try:
            seen.update(f"{folder}/{e.name}" for e in os.scandir(folder) if ".tmp-" in e.name)
        except OSError:
            continue
    return seen


def _killed(child: subprocess.Popen) -> str:
    """Kill the job; its workers have to go with it."""
    os.kill(child.pid, signal.SIGKILL)
    child.wait()
    since = time.monotonic()
    while (left := in_session(child.pid)) and time.monotonic() - since < ORPHANS:
        time.sleep(0.05)
    return f"outlived it by {ORPHANS:g} s: {'; '.join(left.values())}" if left else ""


def _shard_killed(child: subprocess.Popen) -> str:
    """Kill one shard of a batch, as soon as there is one."""
    until(child, lambda: bool(shards(child)), pause=0.02)
    found = shards(child)
    if found:
        os.kill(found[0], signal.SIGKILL)
    return "" if found else "there was no shard to kill"


def run(count: int, folder: Path, names: tuple[str, ...], workers: int, seed: int = 0) -> list[Kill]:
    """`count` kills, the jobs in turn, `workers` at a time; progress on stderr."""
    jobs = made(folder / "inputs", names)
    wholes = {name: undisturbed(job, folder / f"whole{k}") for k, (name, job) in enumerate(jobs.items())}
    for name, whole in wholes.items():
        print(f"{name}: {whole.seconds:.1f} s undisturbed", file=sys.stderr, flush=True)

    def one(number: int) -> Kill:
        found = kill(wholes[names[number % len(names)]], folder / f"k{number}", np.random.default_rng([seed, number]))
        print(
            f"kill {number + 1}: {found.name}, {found.moment}: {found.wrong or 'survived'}", file=sys.stderr, flush=True
        )
        return found

    with ThreadPoolExecutor(workers) as pool:
        return list(pool.map(one, range(count)))
