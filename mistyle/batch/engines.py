"""Engines that run the shards of a plan: processes of this machine, or a Ray cluster.

Each shard is a separate process (`mistyle shard`), so that a native crash affects no other. The engine starts it and
waits. After a crash it retries once on the plain path, without frozen kernels (`MISTYLE_PLAIN`) and with an empty
Dr.Jit kernel cache. A shard ends with its engine, however the engine ended.
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
from mistyle.io.sandbox.asset_folders import ASSETS
from mistyle.process.children import PARENT

# Exit codes of crashes: a shell reports a signal as 128 + its number.
CRASHES = tuple(128 + n for n in (4, 6, 7, 8, 9, 11))
PATIENCE = 30.0  # seconds that a stopped shard gets to write its checkpoint
STOPPED = 75
PLAIN = "MISTYLE_PLAIN"
ONCE_MORE = "--- the process crashed; once more, on the plain path ---"
LOOPBACK = "127.0.0.1"


@dataclass(frozen=True)
class Ended:
    """The end of a shard's process: exit code, number of tries, and the reason where its log has none."""

    index: int
    code: int
    tries: int
    why: str = ""


# Called at the start (with None) and at the end of a shard.
Watch = Callable[[int, Ended | None], None]


def command(plan: BatchPlan, index: int, maps: Sequence[tuple[str, str]] = ()) -> list[str]:
    """The command line of one shard."""
    options = [part for source, target in maps for part in ("--path-map", f"{source}={target}")]
    options += ["--overwrite"] * plan.overwrite
    return [sys.executable, "-m", "mistyle", "shard", str(plan.out / PLAN), "--index", str(index), *options]


def log_of(plan: BatchPlan, index: int) -> Path:
    """The log file of a shard."""
    return plan.out / SHARDS / f"{plan.jobs[index].name}.log"


def crashed(code: int) -> bool:
    """Whether the exit code reports a signal other than SIGTERM and SIGINT."""
    return code in CRASHES or (code < 0 and -code not in (signal.SIGTERM, signal.SIGINT))


def local(
    plan: BatchPlan, todo: Sequence[int], workers: int, watch: Watch, timeout: float | None = None
) -> list[Ended]:
    """Run shards as processes of this machine, `workers` at a time; their threads are a setting of each job.

    On Ctrl-C or a request to stop, every shard receives a stop request and has PATIENCE seconds for its checkpoint.
    """
    children = _Children()

    def one(index: int) -> Ended:
        watch(index, None)
        ended = _run_with_retry(index, lambda plain: children.run(plan, index, plain, timeout), timeout)
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


def _run_with_retry(index: int, run: Callable[[bool], int], timeout: float | None) -> Ended:
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
    """The message for a crash's exit code; empty for other codes. `memory`: the system has since killed a process for
    lack of memory."""
    if not crashed(code):
        return ""
    name = signal.Signals(-code if code < 0 else code - 128).name
    if name != "SIGKILL":
        return f"the process crashed in native code ({name})"
    cause = "by the system, which had run out of memory" if memory else "most likely by the system, for lack of memory"
    return f"the process was killed ({name}), {cause}: run fewer at a time (--workers), or use a smaller atlas"


def _killed_for_memory() -> int:
    """The number of processes that the kernel has killed for lack of memory so far; 0 where unknown."""
    try:
        lines = Path("/proc/vmstat").read_text().splitlines()
    except OSError:
        return 0
    return next((int(line.split()[1]) for line in lines if line.startswith("oom_kill ")), 0)


@dataclass
class _Children:
    """The running processes; mutable, shared between threads under `lock`."""

    running: set = field(default_factory=set)
    stopping: bool = False
    lock: threading.Lock = field(default_factory=threading.Lock)

    def run(self, plan: BatchPlan, index: int, plain: bool, timeout: float | None) -> int:
        with _shard_environment(plain) as environment:
            with self.lock:
                if self.stopping:
                    return STOPPED
                child = _start(command(plan, index), log_of(plan, index), environment)
                self.running.add(child)
            try:
                return _wait(child, timeout)
            finally:
                self.running.discard(child)

    def stop(self) -> None:
        with self.lock:
            self.stopping = True
            remaining = list(self.running)
        for child in remaining:
            _request_stop(child)
        for child in remaining:
            stopped(child)


def _request_stop(child: subprocess.Popen) -> None:
    """Send a stop request: SIGTERM, on Windows Ctrl-Break to the child's own process group."""
    if sys.platform == "win32":
        child.send_signal(signal.CTRL_BREAK_EVENT)
    else:
        child.terminate()


def stopped(child: subprocess.Popen) -> int:
    """Request a process to stop, wait for its checkpoint, then kill it; returns the exit code."""
    _request_stop(child)
    try:
        return child.wait(PATIENCE)
    except subprocess.TimeoutExpired:
        child.kill()
        return child.wait()


@contextmanager
def _shard_environment(plain: bool) -> Iterator[dict[str, str]]:
    """The environment variables of a shard; on the plain path with an empty kernel cache."""
    # faulthandler writes Python's stack to the log when a library ends the process.
    environment = os.environ | {PARENT: str(os.getpid()), "PYTHONFAULTHANDLER": "1"}
    if not plain:
        yield environment
        return
    with tempfile.TemporaryDirectory(prefix="mistyle-kernels-", ignore_cleanup_errors=True) as folder:
        yield environment | {PLAIN: "1", "DRJIT_CACHE_DIR": folder}


def _start(arguments: list[str], log: Path, environment: dict[str, str]) -> subprocess.Popen:
    """Start a shard's process with its output in `log`; a second try appends to the log.

    It has its own process group: Ctrl-C reaches only the engine, which stops each shard once.
    """
    log.parent.mkdir(parents=True, exist_ok=True)
    plain = PLAIN in environment
    group: dict[str, Any] = (
        {"process_group": 0} if sys.platform != "win32" else {"creationflags": subprocess.CREATE_NEW_PROCESS_GROUP}
    )
    with open(log, "ab" if plain else "wb") as out:
        if plain:
            out.write(f"\n{ONCE_MORE}\n".encode())
            out.flush()
        streams: dict[str, Any] = {"stdin": subprocess.DEVNULL, "stdout": out, "stderr": out, "env": environment}
        return subprocess.Popen(arguments, **(streams | group))


def _wait(child: subprocess.Popen, timeout: float | None) -> int:
    """The exit code of a process; after `timeout` seconds it is stopped."""
    try:
        return child.wait(timeout)
    except subprocess.TimeoutExpired:
        return stopped(child)


def last_lines(plan: BatchPlan, index: int, count: int = 5) -> str:
    """The last lines of a shard's log, from the last try; after a crash, Python's innermost calls."""
    try:
        text = log_of(plan, index).read_text(encoding="utf-8", errors="replace")
    except OSError:
        return ""
    lines = [line[:300] for line in text.rpartition(ONCE_MORE)[2].splitlines() if line.strip()]
    crash = max((k for k, line in enumerate(lines) if line.startswith("Fatal Python error")), default=None)
    return "\n".join(lines[-count:] if crash is None else lines[max(crash - 2, 0) : crash + count])


@dataclass(frozen=True)
class RayCluster:
    """A Ray cluster and the resources of each shard.

    address  of a running cluster ("auto"); None starts one on this machine
    threads  cores of a shard
    gpus     GPUs of a shard; fractions are allowed
    wait     seconds without a started shard after which the batch fails
    """

    address: str | None = None
    threads: int = 1
    gpus: float = 0.0
    wait: float = 300.0


def ray(
    plan: BatchPlan, todo: Sequence[int], cluster: RayCluster, watch: Watch, timeout: float | None = None
) -> list[Ended]:
    """Run shards on a Ray cluster.

    A lost worker's shard is retried, three times at most. MistyleError where no shard has started after
    `cluster.wait` seconds. Our own cluster listens only on the loopback address and requires a token. All machines must
    see the plan's folder under the same path.
    """
    address = cluster.address
    if address is None:
        # Ray reads this at import; without it Ray replaces 127.0.0.1 by the machine's address and listens on all.
        os.environ["RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER"] = "0"
        # Ray's workers run at low priority by default; a shard gets normal priority, as with the engine 'local'.
        os.environ.setdefault("RAY_worker_niceness", "0")
    try:
        import ray as library
    except ImportError:
        raise EnvironmentMissing("the engine 'ray' needs Ray: pip install 'mistyle[ray]'") from None
    if address is None:
        _start_cluster(library)
        if (listening := library.util.get_node_ip_address()) != LOOPBACK:
            library.shutdown()
            raise MistyleError(
                f"Ray's cluster listens on {listening}, not on {LOOPBACK} alone, since Ray was imported before; "
                "start a cluster yourself and name it with --address, or use --engine local"
            )
    else:
        library.init(address=address, log_to_driver=False)
    try:
        return _on_ray(library, plan, todo, cluster, watch, timeout)
    finally:
        library.shutdown()


def _start_cluster(library: Any) -> None:
    """Start Ray's own cluster on this machine. MistyleError, with Ray's reason, where it does not start."""
    try:
        library.init(_node_ip_address=LOOPBACK, include_dashboard=False, log_to_driver=False, num_cpus=os.cpu_count())
    except Exception as error:  # Ray raises plain exceptions
        library.shutdown()
        raise MistyleError(
            f"Ray's cluster did not start on this machine: {' '.join(str(error).split())} Its logs are in "
            "/tmp/ray/session_latest/logs. Ray needs shared memory, a /dev/shm that it may write to; --engine local "
            "needs no cluster"
        ) from error


def _on_ray(
    library: Any, plan: BatchPlan, todo: Sequence[int], cluster: RayCluster, watch: Watch, timeout: float | None
) -> list[Ended]:
    """`ray` on the cluster that `library` is connected to."""
    threads, gpus, wait = cluster.threads, cluster.gpus, cluster.wait
    offered = library.cluster_resources()
    for name, needed in (("CPU", threads), ("GPU", gpus)):
        if needed > offered.get(name, 0):
            raise MistyleError(
                f"the Ray cluster offers {offered.get(name, 0):g} {name}s, each shard needs {needed:g}: no shard could "
                "start. Add machines, or request less (--threads, --gpus)"
            )
    task = library.remote(num_cpus=threads, num_gpus=gpus, max_retries=3)(_ray_shard)
    begun = {index: _begun_file(plan, index) for index in todo}
    for path in begun.values():
        path.unlink(missing_ok=True)
    assets = os.environ.get(ASSETS, "")  # workers of a running cluster have their own environment
    waiting = {task.remote(k, command(plan, k), str(log_of(plan, k)), str(begun[k]), timeout, assets): k for k in todo}
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
                f"no shard has started within {wait:g} s on the Ray cluster: it is busy, or no machine has {threads} "
                f"free cores and {gpus:g} GPUs. Check `ray status`, request less, or raise --wait"
            )
    return ended


def _ray_shard(
    index: int, arguments: list[str], log: str, begun: str, timeout: float | None, assets: str = ""
) -> Ended:
    """The task of a Ray worker: run the shard's process, with one retry after a crash."""
    Path(begun).parent.mkdir(parents=True, exist_ok=True)
    Path(begun).touch()

    def run(plain: bool) -> int:
        with _shard_environment(plain) as environment:
            environment |= {ASSETS: assets} if assets else {}
            return _wait(_start(arguments, Path(log), environment), timeout)

    return _run_with_retry(index, run, timeout)


def _begun_file(plan: BatchPlan, index: int) -> Path:
    return plan.out / SHARDS / f".{plan.jobs[index].name}.begun"
