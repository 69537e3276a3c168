"""Engines that run the shards of a plan: processes of this machine, or a Ray cluster.

Each shard is a process of its own (`mistyle shard`), so that a native crash of one takes nothing else along; the
engine only starts it, waits, and starts it once more where it crashed, then on the plain path (`MISTYLE_PLAIN`).
"""

import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass, field
from pathlib import Path

from mistyle.core.errors import EnvironmentMissing, MistyleError
from mistyle.run.batch_plan import PLAN, Plan
from mistyle.run.shard import SHARDS

# Exit codes that a program gives itself; a shell reports a signal as 128 + its number.
CRASHES = tuple(128 + n for n in (4, 6, 7, 8, 9, 11))
PATIENCE = 30.0  # seconds that a stopped shard gets to write its checkpoint
STOPPED = 75


@dataclass(frozen=True)
class Ended:
    """How a shard's process ended, after how many tries."""

    index: int
    code: int
    tries: int


# Called when a shard begins and when it has ended (None while it runs).
Watch = Callable[[int, Ended | None], None]


def command(plan: Plan, index: int, maps: Sequence[tuple[str, str]] = ()) -> list[str]:
    """The process of one shard."""
    options = [part for source, target in maps for part in ("--path-map", f"{source}={target}")]
    return [sys.executable, "-m", "mistyle", "shard", str(plan.out / PLAN), "--index", str(index), *options]


def log_of(plan: Plan, index: int) -> Path:
    """Where a shard's words go."""
    return plan.out / SHARDS / f"{plan.jobs[index].name}.log"


def crashed(code: int) -> bool:
    """Whether the process was ended by a signal that nobody sent on purpose."""
    return code in CRASHES or (code < 0 and -code not in (signal.SIGTERM, signal.SIGINT))


def local(plan: Plan, todo: Sequence[int], workers: int, watch: Watch, timeout: float | None = None) -> list[Ended]:
    """Run shards as processes of this machine, `workers` at a time; their threads are a setting of each job.

    On Ctrl-C or a request to stop, every shard is asked to stop and given time for its checkpoint.
    """
    children = _Children()

    def one(index: int) -> Ended:
        watch(index, None)
        ended = Ended(index, *_tried(lambda plain: children.run(plan, index, plain, timeout)))
        watch(index, ended)
        return ended

    with ThreadPoolExecutor(max_workers=workers) as pool:
        futures = [pool.submit(one, index) for index in todo]
        try:
            return [future.result() for future in as_completed(futures)]
        except BaseException:
            for future in futures:
                future.cancel()
            children.stop()
            raise


def _tried(run: Callable[[bool], int]) -> tuple[int, int]:
    """Exit code and number of tries: a crash is followed by another try on the plain path."""
    code = run(False)
    return (run(True), 2) if crashed(code) else (code, 1)


@dataclass
class _Children:
    """The processes that run now."""

    running: set = field(default_factory=set)
    stopping: bool = False
    lock: threading.Lock = field(default_factory=threading.Lock)

    def run(self, plan: Plan, index: int, plain: bool, timeout: float | None) -> int:
        with self.lock:
            if self.stopping:
                return STOPPED
            child = _started(command(plan, index), log_of(plan, index), plain)
            self.running.add(child)
        try:
            return _waited(child, timeout)
        finally:
            self.running.discard(child)

    def stop(self) -> None:
        with self.lock:
            self.stopping = True
            left = list(self.running)
        for child in left:
            child.terminate()
        for child in left:
            _ended(child)


def _ended(child: subprocess.Popen) -> int:
    """Ask a process to stop, wait for its checkpoint, then end it."""
    child.terminate()
    try:
        return child.wait(PATIENCE)
    except subprocess.TimeoutExpired:
        child.kill()
        return child.wait()


def _started(line: list[str], log: Path, plain: bool) -> subprocess.Popen:
    """A shard's process, its words in the log; a second try goes on in the log of the first."""
    log.parent.mkdir(parents=True, exist_ok=True)
    environment = os.environ | ({"MISTYLE_PLAIN": "1"} if plain else {})
    with open(log, "ab" if plain else "wb") as out:
        if plain:
            out.write(b"\n--- the process crashed; once more, on the plain path ---\n")
            out.flush()
        return subprocess.Popen(line, stdin=subprocess.DEVNULL, stdout=out, stderr=out, env=environment)


def _waited(child: subprocess.Popen, timeout: float | None) -> int:
    """Its exit code; one that takes longer is asked to stop."""
    try:
        return child.wait(timeout)
    except subprocess.TimeoutExpired:
        return _ended(child)


def last_lines(plan: Plan, index: int, count: int = 5) -> str:
    """The end of a shard's log, for a person."""
    try:
        text = log_of(plan, index).read_text(encoding="utf-8", errors="replace")
    except OSError:
        return ""
    return "\n".join([line for line in text.splitlines() if line.strip()][-count:])


def ray(
    plan: Plan,
    todo: Sequence[int],
    threads: int,
    watch: Watch,
    *,
    address: str | None = None,
    gpus: float = 0.0,
    wait: float = 300.0,
    timeout: float | None = None,
) -> list[Ended]:
    """Run shards on a Ray cluster: `address` of a running one ("auto"), or None for one of this machine's own.

    Each takes `threads` cores and `gpus` (a share is allowed). A lost worker's shard is started again, three times at
    most. Where nothing has begun after `wait` seconds the cluster cannot serve what is asked for: MistyleError, instead
    of waiting for ever. A cluster of our own listens on the loopback address only and asks for a token. All machines
    must see the plan's folder at the same place.
    """
    try:
        import ray as library
    except ImportError:
        raise EnvironmentMissing("the engine 'ray' needs Ray: pip install 'mistyle[ray]'") from None
    if address is None:
        library.init(
            _node_ip_address="127.0.0.1", include_dashboard=False, log_to_driver=False, num_cpus=os.cpu_count()
        )
    else:
        library.init(address=address, log_to_driver=False)
    try:
        return _on_ray(library, plan, todo, threads, gpus, watch, wait, timeout)
    finally:
        library.shutdown()


def _on_ray(library, plan, todo, threads, gpus, watch, wait, timeout) -> list[Ended]:
    import time

    offered = library.cluster_resources()
    for name, asked in (("CPU", threads), ("GPU", gpus)):
        if asked > offered.get(name, 0):
            raise MistyleError(
                f"the Ray cluster offers {offered.get(name, 0):g} {name}s, each shard asks for {asked:g}: it would "
                "wait for ever. Add machines, or ask for less (--threads, --gpus)"
            )
    task = library.remote(num_cpus=threads, num_gpus=gpus, max_retries=3)(_ray_shard)
    begun = {index: _begun(plan, index) for index in todo}
    for path in begun.values():
        path.unlink(missing_ok=True)
    waiting = {task.remote(command(plan, k), str(log_of(plan, k)), str(begun[k]), timeout): k for k in todo}
    started: set[int] = set()
    ended, since = [], time.monotonic()
    while waiting:
        ready, _ = library.wait(list(waiting), num_returns=1, timeout=0.5)
        for index in set(waiting.values()) - started:
            if begun[index].exists():
                started.add(index)
                watch(index, None)
        for reference in ready:
            index = waiting.pop(reference)
            try:
                code, tries = library.get(reference)
            except library.exceptions.RayError as error:
                _append(log_of(plan, index), f"the Ray worker was lost: {type(error).__name__}")
                code, tries = 1, 1
            ended.append(Ended(index, code, tries))
            watch(index, ended[-1])
            begun[index].unlink(missing_ok=True)
        if not started and not ended and time.monotonic() - since > wait:
            raise MistyleError(
                f"no shard has begun within {wait:g} s on the Ray cluster: it is busy, or no machine has {threads} "
                f"free cores and {gpus:g} GPUs. Look at `ray status`, ask for less, or raise --wait"
            )
    return ended


def _ray_shard(line: list[str], log: str, begun: str, timeout: float | None) -> tuple[int, int]:
    """What a Ray worker does: the same process as everywhere, and once more where it crashes."""
    Path(begun).parent.mkdir(parents=True, exist_ok=True)
    Path(begun).touch()
    return _tried(lambda plain: _waited(_started(line, Path(log), plain), timeout))


def _begun(plan: Plan, index: int) -> Path:
    return plan.out / SHARDS / f".{plan.jobs[index].name}.begun"


def _append(path: Path, text: str) -> None:
    with open(path, "a", encoding="utf-8") as log:
        log.write(text + "\n")
