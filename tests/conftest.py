"""What holds for every test: the LLVM that the set-up found, a seeded generator, and no silent skips in CI."""

import os
import sys
from pathlib import Path

import numpy as np
import pytest
import scipy.linalg  # noqa: F401  (loads SciPy's own BLAS)
from hypothesis import settings
from threadpoolctl import threadpool_limits

from mistyle.setup import environment
from tests.support.browser import NO_BROWSER
from tests.support.helpers import NO_DATA

# Skips that CI accepts, by the beginning of their reason, and why. Where the environment variable CI is set, any
# other skip fails the run: a test that never runs proves nothing.
ALLOWED_SKIPS = {
    NO_DATA: "real meshes and paintings stand under other people's licences and are not in the repository",
    NO_BROWSER: "a browser comes with the system, and .ci/run installs one where it may",
}
skipped: list[tuple[str, str]] = []

environment.use_llvm()
# Tests import torch before a job tells OpenMP how to wait (mistyle/process/cores.py): threads that spin on two busy
# cores made a small network's operations eight times slower.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
# Workers of the tests share the cores, on which threads of a BLAS wait for one another (mistyle/process/cores.py). The
# variable is for processes that tests start.
os.environ["OPENBLAS_NUM_THREADS"] = "1"
threadpool_limits(limits=1, user_api="blas")
# Compiled modules are kept: each of the many processes that tests start would compile the package anew.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False
# Read when Ray is imported: the engine sets it, but here tests may import Ray before the engine does.
os.environ["RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER"] = "0"
settings.register_profile("mistyle", deadline=None, derandomize=True, database=None)
settings.load_profile("mistyle")


@pytest.fixture
def rng() -> np.random.Generator:
    """The same random numbers in every test and every run."""
    return np.random.default_rng(0)


@pytest.fixture
def props(tmp_path) -> Path:
    """A folder with two meshes and two pictures, for batches."""
    from tests.support.batch_parts import write_props

    return write_props(tmp_path / "props")


@pytest.fixture(scope="session")
def verb_inputs(tmp_path_factory) -> Path:
    """A folder with what every verb that writes can be given (tests/support/verbs.py); not to be changed."""
    from tests.support.verbs import write_inputs

    folder = tmp_path_factory.mktemp("verbs") / "inputs"
    write_inputs(folder)
    return folder


def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    note(report)


def pytest_collectreport(report: pytest.CollectReport) -> None:
    note(report)


def note(report: pytest.TestReport | pytest.CollectReport) -> None:
    """Keep a skip's reason; an expected failure (xfail) is no skip."""
    if report.skipped and not hasattr(report, "wasxfail"):
        reason = report.longrepr[2] if isinstance(report.longrepr, tuple) else str(report.longrepr)
        skipped.append((report.nodeid, reason.removeprefix("Skipped: ")))


def refused() -> list[tuple[str, str]]:
    """The skips that fail this run."""
    in_ci = os.environ.get("CI", "").lower() not in ("", "0", "false")
    return [s for s in skipped if in_ci and not s[1].startswith(tuple(ALLOWED_SKIPS))]


def pytest_sessionfinish(session: pytest.Session, exitstatus: int) -> None:
    if refused() and exitstatus == pytest.ExitCode.OK:
        session.exitstatus = pytest.ExitCode.TESTS_FAILED


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    for test, reason in refused():
        terminalreporter.write_line(f"CI does not accept this skip: {test}: {reason}", red=True)
