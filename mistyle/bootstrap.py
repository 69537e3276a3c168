"""From a bare Python to a working mistyle: makes .venv, installs the pins, makes sure of LLVM. Standard library only.

`start` is what `python3 -m mistyle` runs. Everything lands in `.venv` beside the package (never in an active conda, uv
or other environment); `.venv/mistyle.json` remembers what was done, so that a later run only compares a hash.
A wheel that is installed somewhere else runs in the environment that it was installed into.
"""

import contextlib
import glob
import hashlib
import json
import os
import signal
import subprocess
import sys
import time
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from mistyle.core.children import end_with_asker

PACKAGE = Path(__file__).resolve().parent
ROOT = PACKAGE.parent
VENV = ROOT / ".venv"
CONSTRAINTS = PACKAGE / "constraints.txt"
ENTERED = "_MISTYLE_ENTERED"  # set for the process that the set-up hands over to
HELP = "mistyle: one mesh and one style picture in; the same mesh with stylized, physically based textures out.\n"
NEEDED_BYTES = 3_000_000_000


class SetupError(Exception):
    """The environment cannot be made; the message is one sentence with the way out. Exit code 4."""


def say(line: str) -> None:
    """One line of progress. Always on stderr: stdout belongs to --json."""
    print(f"mistyle: {line}", file=sys.stderr, flush=True)


def start(arguments: Sequence[str]) -> int:
    """Make sure of everything, go over into .venv's Python, run the verb there and return its exit code.

    `--system` lets apt-get install LLVM on the system; every other argument belongs to the verb.
    """
    system = "--system" in arguments
    arguments = [a for a in arguments if a != "--system"]
    verb = next((a for a in arguments if not a.startswith("-")), "")
    if not verb or (verb != "test" and {"-h", "--help"} & set(arguments)):
        return _help(arguments)
    if verb == "test" and not in_clone():
        say("the tests are in the source repository, not in the installed package; run this in a clone")
        return 2
    try:
        enter(arguments, extras={"test"} if verb == "test" else set(), system=system)
    except SetupError as error:
        say(str(error))
        if verb != "doctor":
            return 4
        if not _inside() and _packages_ready(home(), read_record(home()), set()):
            return _over(arguments, dict(os.environ))
        from mistyle.run import doctor

        return doctor.main("--json" in arguments)
    except KeyboardInterrupt:
        say("interrupted; rerun to resume the set-up")
        return 130
    return _tests(arguments) if verb == "test" else _command_line(arguments)


def _help(arguments: list[str]) -> int:
    """Answer at once, on a bare Python too: only where the command line cannot be imported it needs the packages."""
    try:
        return _command_line(arguments)
    except ImportError as error:
        if not ready(home(), set()):
            print(f"{HELP}Not set up yet ({error}). `python3 -m mistyle doctor` or any other verb sets it up.")
            return 0
    enter(arguments, extras=set())
    return _command_line(arguments)


def _command_line(arguments: list[str]) -> int:
    # Before the imports, which take seconds on a busy machine: a shard whose batch is gone must not linger in them.
    end_with_asker()
    try:
        from mistyle.run.cli import main
    except KeyboardInterrupt:
        return 130
    return main(arguments)


def _tests(arguments: list[str]) -> int:
    # Most tests keep one core busy. A file's tests stay together: they share what its fixtures made.
    whole = ["--numprocesses=auto", "--maxprocesses=4", "--dist=loadfile"]
    chosen = arguments[arguments.index("test") + 1 :] or whole
    return _hand_over([sys.executable, "-m", "pytest", *chosen], dict(os.environ), ROOT)


def in_clone() -> bool:
    """Whether this package stands in its repository (else it was installed as a wheel)."""
    project = ROOT / "pyproject.toml"
    return project.is_file() and '\nname = "mistyle"' in project.read_text(encoding="utf-8")


def home() -> Path:
    """Where the set-up keeps its notes and a private LLVM: .venv, or the user's cache for an installed wheel."""
    if in_clone():
        return VENV
    cache = os.environ.get("LOCALAPPDATA") or os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(cache) / "mistyle"


def python_of(folder: Path) -> Path:
    """The Python to run with: the virtual environment's, or this one for an installed wheel."""
    if not in_clone():
        return Path(sys.executable)
    return folder / ("Scripts/python.exe" if os.name == "nt" else "bin/python")


def enter(arguments: Sequence[str], *, extras: set[str], system: bool = False) -> None:
    """Set up what is missing; return only inside the right Python with LLVM's variables set, else run it instead."""
    folder, inside = home(), _inside()
    if os.environ.pop(ENTERED, "") == str(folder) and inside:
        return
    if system or not ready(folder, extras):
        set_up(folder, extras, system)
    record = read_record(folder)
    say(_banner(folder, record))
    environment = told(record["llvm"]["library"], record["llvm"]["folders"], os.environ)
    if inside and environment.get("LD_LIBRARY_PATH") == os.environ.get("LD_LIBRARY_PATH"):
        os.environ.update(environment)
        return
    sys.exit(_over(arguments, environment))


def _inside() -> bool:
    return not in_clone() or os.path.realpath(sys.prefix) == os.path.realpath(VENV)


def _over(arguments: Sequence[str], environment: dict[str, str]) -> int:
    """Run the same verb with .venv's Python."""
    # Another environment's packages must not be found before ours.
    kept = {k: v for k, v in environment.items() if k not in ("PYTHONHOME", "PYTHONPATH", "__PYVENV_LAUNCHER__")}
    folder = home()
    return _hand_over([str(python_of(folder)), "-P", "-m", "mistyle", *arguments], {**kept, ENTERED: str(folder)})


def _hand_over(line: list[str], environment: dict[str, str], folder: Path | None = None) -> int:
    """Become another program, so that signals and the exit code are its own; Windows can only wait for it."""
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


# What is there already


def read_record(folder: Path) -> dict[str, Any]:
    """What an earlier set-up noted: key, extras, llvm (variant, library, folders, version, size, mtime)."""
    with contextlib.suppress(OSError, ValueError):
        record = json.loads((folder / "mistyle.json").read_text(encoding="utf-8"))
        return record if isinstance(record, dict) else {}
    return {}


def write_record(folder: Path, record: dict[str, Any]) -> None:
    part = folder / "mistyle.json.part"
    part.write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")
    os.replace(part, folder / "mistyle.json")


def key(folder: Path) -> str:
    """Changes when what has to be installed changes: the pins, the project, the place, the Python."""
    digest = hashlib.sha256(CONSTRAINTS.read_bytes())
    if in_clone():
        project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
        digest.update(json.dumps(project, sort_keys=True).encode())
    else:
        from importlib.metadata import distributions

        digest.update(str([d.version for d in distributions(name="drjit")]).encode())
    # The link of a virtual environment may lead to another version after a system upgrade.
    digest.update(f"{PACKAGE} {os.path.basename(os.path.realpath(python_of(folder)))}".encode())
    return digest.hexdigest()


def ready(folder: Path, extras: set[str]) -> bool:
    """Whether nothing is left to do. A few milliseconds: compares hashes, starts no process."""
    record = read_record(folder)
    return _packages_ready(folder, record, extras) and _llvm_ready(record)


def _packages_ready(folder: Path, record: dict[str, Any], extras: set[str]) -> bool:
    if "key" not in record or not python_of(folder).exists():
        return False
    return record["key"] == key(folder) and extras <= set(record.get("extras", ()))


def _llvm_ready(record: dict[str, Any]) -> bool:
    llvm = record.get("llvm")
    if not llvm:
        return False
    asked = os.environ.get("DRJIT_LIBLLVM_PATH")
    if asked and llvm["library"] and asked not in (llvm["library"], llvm.get("refused")):
        return False
    return not llvm["library"] or _print_of(llvm["library"]) == llvm["print"]


def _print_of(library: str) -> list[int]:
    with contextlib.suppress(OSError):
        info = os.stat(library)
        return [info.st_size, info.st_mtime_ns]
    return []


def told(library: str, folders: Sequence[str], base: Mapping[str, str]) -> dict[str, str]:
    """`base` with what makes Dr.Jit load `library`; `folders` hold libraries that LLVM needs and the system lacks."""
    result = dict(base)
    if library:
        result["DRJIT_LIBLLVM_PATH"] = library
    if folders:
        there = [f for f in result.get("LD_LIBRARY_PATH", "").split(os.pathsep) if f and f not in folders]
        result["LD_LIBRARY_PATH"] = os.pathsep.join([*folders, *there])
    return result


def known_llvm() -> str:
    """The LLVM that the set-up found, where it is still there; else nothing."""
    record = read_record(home())
    return record["llvm"]["library"] if _llvm_ready(record) else ""


def use_llvm() -> bool:
    """Tell Dr.Jit in this process about the LLVM that the set-up found; for scripts and tests that start without it.

    Returns whether there is one. Has to run before the first import of drjit or mitsuba; changes nothing where
    DRJIT_LIBLLVM_PATH is set already.
    """
    record = read_record(home())
    if os.environ.get("DRJIT_LIBLLVM_PATH") or not _llvm_ready(record):
        return bool(os.environ.get("DRJIT_LIBLLVM_PATH"))
    os.environ.update(told(record["llvm"]["library"], record["llvm"]["folders"], os.environ))
    if folders := record["llvm"]["folders"]:
        _preload([path for folder in folders for path in sorted(glob.glob(f"{folder}/*.so.*"))])
    return True


def _preload(libraries: list[str]) -> None:
    """Load libraries whose folder the loader was not told of at its start, each after those that it needs."""
    import ctypes

    left = [path for path in libraries if not os.path.islink(path)]
    for _ in range(len(left)):
        for path in list(left):
            with contextlib.suppress(OSError):
                ctypes.CDLL(path, mode=ctypes.RTLD_GLOBAL)
                left.remove(path)


# The set-up


def set_up(folder: Path, extras: set[str], system: bool) -> None:
    """Make the virtual environment, install the packages, make sure of LLVM; whatever is there already is kept."""
    from mistyle import install, llvm

    begun = time.monotonic()
    say(f"setting up {folder}")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with _alone(folder), _stoppable():
            record = read_record(folder)
            extras = extras | set(record.get("extras", ()))
            if not _packages_ready(folder, record, extras):
                if in_clone():
                    say("the packages come first: on a bare machine about 1 GB to fetch and 2 GB on the disk")
                    say(f"with the CUDA build of torch (a GPU, or no CPU build to be had) it adds {install.CUDA_SIZE}")
                if record:
                    write_record(folder, {k: v for k, v in record.items() if k != "key"})
                install.packages(folder, python_of(folder), extras)
                record = {"key": key(folder), "extras": sorted(extras)}
                write_record(folder, record)
            if system and not llvm.install(say):
                raise SetupError(f"apt-get could not install LLVM on the system; by hand: {llvm.command()}")
            if system or not _llvm_ready(record):
                write_record(folder, {**record, "llvm": _find_llvm(folder)})
    except OSError as error:
        raise SetupError(f"cannot set up {folder}: {error}; check the rights and the space there") from error
    say(f"set up in {time.monotonic() - begun:.0f} s")


def _find_llvm(folder: Path) -> dict[str, Any]:
    from mistyle import llvm

    say("looking for an LLVM that compiles (each is tried on one pixel)")
    python = str(python_of(folder))
    found = llvm.find(python, folder, say)
    if not found and llvm.fetch(folder, say):
        found = llvm.find(python, folder, say)
    if not found:
        raise SetupError(
            f"no LLVM that Dr.Jit can use (17 or newer), and no GPU answers. Run: {llvm.command()}"
            + ("; or the same verb with --system" if os.path.exists("/usr/bin/apt-get") else "")
        )
    asked = os.environ.get("DRJIT_LIBLLVM_PATH")
    refused = {"refused": asked} if asked and asked != found.library else {}
    return {**found._asdict(), "print": _print_of(found.library), **refused}


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
    """SIGTERM ends the set-up and the program that it waits for with exit code 75: it can be taken up again."""

    # Nothing is said in the handler: it may have interrupted another line being said.
    before = signal.signal(signal.SIGTERM, lambda *_: sys.exit(75))
    try:
        yield
    except SystemExit:
        say("stopped; rerun to resume the set-up")
        raise
    finally:
        signal.signal(signal.SIGTERM, before)
