"""Engines that run the shards of a plan: processes of this machine, or a Ray cluster.

Each shard is a process of its own (`mistyle shard`), so that a native crash of one takes nothing else along; the
engine only starts it, waits, and starts it once more where it crashed, then on the plain path: no kernel is recorded
(`MISTYLE_PLAIN`), and none is taken from Dr.Jit's cache on disk. A shard ends when its engine does, however that ended.
"""

import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from mistyle.batch.plan import PLAN, BatchPlan
from mistyle.batch.shard import SHARDS
from mistyle.core.errors import EnvironmentMissing, MistyleError
from mistyle.process.children import PARENT

# Exit codes that a program gives itself; a shell reports a signal as 128 + its number.
CRASHES = tuple(128 + n for n in (4, 6, 7, 8, 9, 11))
PATIENCE = 30.0  # seconds that a stopped shard gets to write its checkpoint
STOPPED = 75
PLAIN = "MISTYLE_PLAIN"
ONCE_MORE = "--- the process crashed; once more, on the plain path ---"
LOOPBACK = "127.0.0.1"


@dataclass(frozen=True)
class Ended:
    """How a shard's process ended, after how many tries, and why where its own words do not say."""

    index: int
    code: int
    tries: int
    why: str = ""


# Called when a shard begins and when it has ended (None while it runs).
Watch = Callable[[int, Ended | None], None]


def command(plan: BatchPlan, index: int, maps: Sequence[tuple[str, str]] = ()) -> list[str]:
    """The process of one shard."""
    options = [part for source, target in maps for part in ("--path-map", f"{source}={target}")]
    options += ["--overwrite"] * plan.overwrite
    return [sys.executable, "-m", "mistyle", "shard", str(plan.out / PLAN), "--index", str(index), *options]


def log_of(plan: BatchPlan, index: int) -> Path:
    """Where a shard's words go."""
    return plan.out / SHARDS / f"{plan.jobs[index].name}.log"


def crashed(code: int) -> bool:
    """Whether the process was ended by a signal that nobody sent on purpose."""
    return code in CRASHES or (code < 0 and -code not in (signal.SIGTERM, signal.SIGINT))


def local(
    plan: BatchPlan, todo: Sequence[int], workers: int, watch: Watch, timeout: float | None = None
) -> list[Ended]:
    """Run shards as processes of this machine, `workers` at a time; their threads are a setting of each job.

    On Ctrl-C or a request to stop, every shard is asked to stop and given time for its checkpoint.
    """
    children = _Children()

    def one(index: int) -> Ended:
        watch(index, None)
        ended = _tried(index, lambda plain: children.run(plan, index, plain, timeout), timeout)
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


def _tried(index: int, run: Callable[[bool], int], timeout: float | None) -> Ended:
    """Run a shard; a crash is followed by another try on the plain path, a timeout is not."""
    killed, code, late, tries = _killed_for_memory(), 0, False, 0
    for plain in (False, True):
        start, tries = time.monotonic(), tries + 1
        try:
            code = run(plain)
        except OSError as error:
            return Ended(index, 1, tries, f"the process could not be started: {error}")
        late = timeout is not None and code != 0 and time.monotonic() - start >= timeout
        if late or not crashed(code):
            break
    if late:
        return Ended(index, code, tries, f"it took longer than {timeout:g} s and was stopped")
    why = reason(code, _killed_for_memory() > killed)
    return Ended(index, code, tries, f"{why}, twice (the second time on the plain path)" if why else "")


def reason(code: int, memory: bool = False) -> str:
    """What a crash's exit code says, in words; nothing for other codes. `memory`: the system has since killed some
    process for lack of memory."""
    if not crashed(code):
        return ""
    name = signal.Signals(-code if code < 0 else code - 128).name
    if name != "SIGKILL":
        return f"the process crashed in native code ({name})"
    by = "by the system, which had run out of memory" if memory else "most likely by the system, for lack of memory"
    return f"the process was killed ({name}), {by}: run fewer at a time (--workers), or use a smaller atlas"


def _killed_for_memory() -> int:
    """How many processes this machine has ended for lack of memory so far, where it tells."""
    try:
        lines = Path("/proc/vmstat").read_text().splitlines()
    except OSError:
        return 0
    return next((int(line.split()[1]) for line in lines if line.startswith("oom_kill ")), 0)


@dataclass
class _Children:
    """The processes that run now."""

    running: set = field(default_factory=set)
    stopping: bool = False
    lock: threading.Lock = field(default_factory=threading.Lock)

    def run(self, plan: BatchPlan, index: int, plain: bool, timeout: float | None) -> int:
        with _surroundings(plain) as environment:
            with self.lock:
                if self.stopping:
                    return STOPPED
                child = _started(command(plan, index), log_of(plan, index), environment)
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
            _ask(child)
        for child in left:
            stopped(child)


def _ask(child: subprocess.Popen) -> None:
    """Ask a process to stop. Windows knows no SIGTERM: Ctrl-Break, which reaches the child's own group."""
    if sys.platform == "win32":
        child.send_signal(signal.CTRL_BREAK_EVENT)
    else:
        child.terminate()


def stopped(child: subprocess.Popen) -> int:
    """Ask a process to stop, wait for its checkpoint, then end it."""
    _ask(child)
    try:
        return child.wait(PATIENCE)
    except subprocess.TimeoutExpired:
        child.kill()
        return child.wait()


@contextmanager
def _surroundings(plain: bool) -> Iterator[dict[str, str]]:
    """What a shard finds in its environment; on the plain path it has an empty kernel cache of its own."""
    # Python's stack stands in the log when a library ends the process.
    environment = os.environ | {PARENT: str(os.getpid()), "PYTHONFAULTHANDLER": "1"}
    if not plain:
        yield environment
        return
    with tempfile.TemporaryDirectory(prefix="mistyle-kernels-", ignore_cleanup_errors=True) as folder:
        yield environment | {PLAIN: "1", "DRJIT_CACHE_DIR": folder}


def _started(line: list[str], log: Path, environment: dict[str, str]) -> subprocess.Popen:
    """A shard's process, its words in the log; a second try goes on in the log of the first.

    It is a group of its own: Ctrl-C reaches the engine only, which asks each shard once.
    """
    log.parent.mkdir(parents=True, exist_ok=True)
    plain = PLAIN in environment
    apart: dict[str, Any] = (
        {"process_group": 0} if sys.platform != "win32" else {"creationflags": subprocess.CREATE_NEW_PROCESS_GROUP}
    )
    with open(log, "ab" if plain else "wb") as out:
        if plain:
            out.write(f"\n{ONCE_MORE}\n".encode())
            out.flush()
        given: dict[str, Any] = {"stdin": subprocess.DEVNULL, "stdout": out, "stderr": out, "env": environment}
        return subprocess.Popen(line, **(given | apart))


def _waited(child: subprocess.Popen, timeout: float | None) -> int:
    """Its exit code; one that takes longer is asked to stop."""
    try:
        return child.wait(timeout)
    except subprocess.TimeoutExpired:
        return stopped(child)


def last_lines(plan: BatchPlan, index: int, count: int = 5) -> str:
    """The end of a shard's log, for a person; where it crashed, Python's innermost calls. The last try's."""
    try:
        text = log_of(plan, index).read_text(encoding="utf-8", errors="replace")
    except OSError:
        return ""
    lines = [line[:300] for line in text.rpartition(ONCE_MORE)[2].splitlines() if line.strip()]
    crash = max((k for k, line in enumerate(lines) if line.startswith("Fatal Python error")), default=None)
    return "\n".join(lines[-count:] if crash is None else lines[max(crash - 2, 0) : crash + count])


@dataclass(frozen=True)
class RayCluster:
    """A Ray cluster and the share of it that each shard takes.

    address  of a running cluster ("auto"); None starts one on this machine
    threads  cores of a shard
    gpus     GPUs of a shard; fractions are allowed
    wait     seconds after which a cluster that has begun no shard counts as unable to serve
    """

    address: str | None = None
    threads: int = 1
    gpus: float = 0.0
    wait: float = 300.0


def ray(
    plan: BatchPlan, todo: Sequence[int], cluster: RayCluster, watch: Watch, timeout: float | None = None
) -> list[Ended]:
    """Run shards on a Ray cluster.

    A lost worker's shard is started again, three times at most. MistyleError where no shard has begun after
    `cluster.wait` seconds. A cluster of our own listens on the loopback address only and asks for a token. All machines
    must see the plan's folder at the same place.
    """
    address = cluster.address
    if address is None:
        # Read when Ray is imported; without it Ray takes 127.0.0.1 for the machine's own address and listens on all.
        os.environ["RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER"] = "0"
        # Ray's workers step back behind everything else by default: a shard is no less urgent here than by itself.
        os.environ.setdefault("RAY_worker_niceness", "0")
    try:
        import ray as library
    except ImportError:
        raise EnvironmentMissing("the engine 'ray' needs Ray: pip install 'mistyle[ray]'") from None
    if address is None:
        library.init(_node_ip_address=LOOPBACK, include_dashboard=False, log_to_driver=False, num_cpus=os.cpu_count())
        if (where := library.util.get_node_ip_address()) != LOOPBACK:
            library.shutdown()
            raise MistyleError(
                f"Ray's cluster listens on {where}, not on {LOOPBACK} alone, as Ray was imported before; "
                "start a cluster yourself and name it with --address, or use --engine processes"
            )
    else:
        library.init(address=address, log_to_driver=False)
    try:
        return _on_ray(library, plan, todo, cluster, watch, timeout)
    finally:
        library.shutdown()


def _on_ray(
    library: Any, plan: BatchPlan, todo: Sequence[int], cluster: RayCluster, watch: Watch, timeout: float | None
) -> list[Ended]:
    """`ray` on the cluster that `library` is connected to."""
    threads, gpus, wait = cluster.threads, cluster.gpus, cluster.wait
    offered = library.cluster_resources()
    for name, asked in (("CPU", threads), ("GPU", gpus)):
        if asked > offered.get(name, 0):
            raise MistyleError(
                f"the Ray cluster offers {offered.get(name, 0):g} {name}s, each shard needs {asked:g}: it would "
                "wait for ever. Add machines, or request less (--threads, --gpus)"
            )
    task = library.remote(num_cpus=threads, num_gpus=gpus, max_retries=3)(_ray_shard)
    begun = {index: _begun(plan, index) for index in todo}
    for path in begun.values():
        path.unlink(missing_ok=True)
    waiting = {task.remote(k, command(plan, k), str(log_of(plan, k)), str(begun[k]), timeout): k for k in todo}
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
                ended.append(library.get(reference))
            except library.exceptions.RayError as error:
                ended.append(Ended(index, 1, 1, f"the Ray worker was lost: {type(error).__name__}"))
            watch(index, ended[-1])
            begun[index].unlink(missing_ok=True)
        if not started and not ended and time.monotonic() - since > wait:
            raise MistyleError(
                f"no shard has begun within {wait:g} s on the Ray cluster: it is busy, or no machine has {threads} "
                f"free cores and {gpus:g} GPUs. Look at `ray status`, request less, or raise --wait"
            )
    return ended


def _ray_shard(index: int, line: list[str], log: str, begun: str, timeout: float | None) -> Ended:
    """What a Ray worker does: the same process as everywhere, and once more where it crashes."""
    Path(begun).parent.mkdir(parents=True, exist_ok=True)
    Path(begun).touch()

    def run(plain: bool) -> int:
        with _surroundings(plain) as environment:
            return _waited(_started(line, Path(log), environment), timeout)

    return _tried(index, run, timeout)


def _begun(plan: BatchPlan, index: int) -> Path:
    return plan.out / SHARDS / f".{plan.jobs[index].name}.begun"
