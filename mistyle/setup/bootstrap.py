"""Set-up of mistyle on a bare Python: creates .venv, installs the pins, finds LLVM. Standard library only.

`start` is what `python3 -m mistyle` runs. Everything lands in `.venv` beside the package (never in an active conda, uv
or other environment); `.venv/mistyle.json` records the set-up, so that a later run only compares a hash.
A wheel installed elsewhere runs in the environment that it was installed into.
"""

import contextlib
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from mistyle.setup.environment import (
    ROOT,
    SetupError,
    home,
    in_clone,
    inside,
    key,
    llvm_ready,
    packages_ready,
    print_of,
    python_of,
    read_record,
    ready,
    say,
    with_llvm,
    write_record,
)

ENTERED = "_MISTYLE_ENTERED"  # set in the environment of the process that replaces the set-up
HELP = "mistyle: one mesh and one style picture in; the same mesh with stylized, physically based textures out.\n"


def start(arguments: Sequence[str], command_line: Callable[[list[str]], int], doctor: Callable[[bool], int]) -> int:
    """Complete the set-up, switch to .venv's Python, run the verb there and return its exit code.

    `--system` lets apt-get install LLVM on the system; every other argument belongs to the verb. `command_line` runs a
    verb. `doctor` prints what is missing, as JSON or as a table, where the set-up failed.
    """
    system = "--system" in arguments
    arguments = [a for a in arguments if a != "--system"]
    verb = next((a for a in arguments if not a.startswith("-")), "")
    if not verb or (verb != "test" and {"-h", "--help"} & set(arguments)):
        return _help(arguments, command_line)
    if verb == "test" and not in_clone():
        say("the tests are in the source repository, not in the installed package; run this in a clone")
        return 2
    try:
        enter(arguments, extras={"test"} if verb == "test" else set(), system=system)
    except SetupError as error:
        say(str(error))
        if verb != "doctor":
            return 4
        if not inside() and packages_ready(home(), read_record(home()), set()):
            return _over(arguments, dict(os.environ))
        return doctor("--json" in arguments)
    except KeyboardInterrupt:
        say("interrupted; rerun to resume the set-up")
        return 130
    return _tests(arguments) if verb == "test" else command_line(arguments)


def _help(arguments: list[str], command_line: Callable[[list[str]], int]) -> int:
    """Print the help, on a bare Python too; set up the packages only where the command line cannot be imported."""
    try:
        return command_line(arguments)
    except ImportError as error:
        if not ready(home(), set()):
            print(f"{HELP}Not set up yet ({error}). `python3 -m mistyle doctor` or any other verb sets it up.")
            return 0
    enter(arguments, extras=set())
    return command_line(arguments)


def _tests(arguments: list[str]) -> int:
    # Most tests use one core. A file's tests run in one worker: they share its fixtures.
    whole = ["--numprocesses=auto", "--maxprocesses=4", "--dist=loadfile"]
    chosen = arguments[arguments.index("test") + 1 :] or whole
    return _hand_over([sys.executable, "-m", "pytest", *chosen], dict(os.environ), ROOT)


def enter(arguments: Sequence[str], *, extras: set[str], system: bool = False) -> None:
    """Set up what is missing; return only inside the right Python with LLVM's variables set, else run it instead."""
    folder, right_python = home(), inside()
    if os.environ.pop(ENTERED, "") == str(folder) and right_python:
        return
    if system or not ready(folder, extras):
        set_up(folder, extras, system)
    record = read_record(folder)
    say(_banner(folder, record))
    environment = with_llvm(record["llvm"]["library"], record["llvm"]["folders"], os.environ)
    if right_python and environment.get("LD_LIBRARY_PATH") == os.environ.get("LD_LIBRARY_PATH"):
        os.environ.update(environment)
        return
    sys.exit(_over(arguments, environment))


def _over(arguments: Sequence[str], environment: dict[str, str]) -> int:
    """Run the same verb with .venv's Python."""
    # Another environment's packages must not precede ours on the path.
    clean = {k: v for k, v in environment.items() if k not in ("PYTHONHOME", "PYTHONPATH", "__PYVENV_LAUNCHER__")}
    folder = home()
    return _hand_over([str(python_of(folder)), "-P", "-m", "mistyle", *arguments], {**clean, ENTERED: str(folder)})


def _hand_over(line: list[str], environment: dict[str, str], folder: Path | None = None) -> int:
    """Replace this process by another program, so that signals and the exit code are its own; Windows waits for it."""
    sys.stdout.flush()
    sys.stderr.flush()
    if os.name == "nt":
        with contextlib.suppress(KeyboardInterrupt):
            return subprocess.call(line, env=environment, cwd=folder)
        return 130
    if folder:
        os.chdir(folder)
    os.execve(line[0], line, environment)


def _banner(folder: Path, record: dict[str, Any]) -> str:
    from mistyle import __version__

    compiler = f"LLVM {record['llvm']['version']}" if record["llvm"]["library"] else record["llvm"]["variant"]
    where = f"{folder}, " if in_clone() else ""
    active = os.environ.get("CONDA_PREFIX") or os.environ.get("VIRTUAL_ENV")
    foreign = bool(active) and in_clone() and os.path.realpath(active or "") != os.path.realpath(folder)
    return f"{__version__} ({where}{compiler}{f'; not the active environment {active}' if foreign else ''})"


# The set-up


def set_up(folder: Path, extras: set[str], system: bool) -> None:
    """Make the virtual environment, install the packages, find LLVM; existing parts are kept."""
    from mistyle.setup import install, llvm

    begun = time.monotonic()
    say(f"setting up {folder}")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with _alone(folder), _stoppable():
            record = read_record(folder)
            extras = extras | set(record.get("extras", ()))
            if not packages_ready(folder, record, extras):
                if in_clone():
                    say("installing the packages: on a bare machine about 1 GB to download and 2 GB on the disk")
                    say(f"with the CUDA build of torch (a GPU, or no CPU build available) it adds {install.CUDA_SIZE}")
                if record:
                    write_record(folder, {k: v for k, v in record.items() if k != "key"})
                install.packages(folder, python_of(folder), extras)
                record = {"key": key(folder), "extras": sorted(extras)}
                write_record(folder, record)
            if system and not llvm.install(say):
                raise SetupError(f"apt-get could not install LLVM on the system; by hand: {llvm.command()}")
            if system or not llvm_ready(record):
                write_record(folder, {**record, "llvm": _find_llvm(folder)})
    except OSError as error:
        raise SetupError(f"cannot set up {folder}: {error}; check the rights and the space there") from error
    say(f"set up in {time.monotonic() - begun:.0f} s")


def _find_llvm(folder: Path) -> dict[str, Any]:
    from mistyle.setup import llvm

    say("looking for an LLVM that compiles (each is tried on one pixel)")
    python = str(python_of(folder))
    variant = llvm.find(python, folder, say)
    if not variant and llvm.fetch(folder, say):
        variant = llvm.find(python, folder, say)
    if not variant:
        raise SetupError(
            f"no LLVM that Dr.Jit can use (17 or newer), and no GPU answers. Run: {llvm.command()}"
            + ("; or the same verb with --system" if os.path.exists("/usr/bin/apt-get") else "")
        )
    requested = os.environ.get("DRJIT_LIBLLVM_PATH")
    refused = {"refused": requested} if requested and requested != variant.library else {}
    return {**variant._asdict(), "print": print_of(variant.library), **refused}


@contextlib.contextmanager
def _alone(folder: Path) -> Iterator[None]:
    """Two set-ups in the same folder wait for each other (not on Windows)."""
    try:
        import fcntl
    except ImportError:
        yield
        return
    with open(folder / "mistyle.lock", "w") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            say("another process sets up the same folder; waiting for it")
            fcntl.flock(lock, fcntl.LOCK_EX)
        yield


@contextlib.contextmanager
def _stoppable() -> Iterator[None]:
    """SIGTERM ends the set-up and its child program with exit code 75; rerun to resume."""

    # The handler prints nothing: it may have interrupted another print.
    before = signal.signal(signal.SIGTERM, lambda *_: sys.exit(75))
    try:
        yield
    except SystemExit:
        say("stopped; rerun to resume the set-up")
        raise
    finally:
        signal.signal(signal.SIGTERM, before)
