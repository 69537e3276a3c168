"""Where mistyle stands and what the set-up left there: places, notes, the LLVM for Dr.Jit. Standard library only.

The set-up (`bootstrap.py`, `install.py`, `llvm.py`) writes it. The renderer, `mistyle doctor` and `mistyle
pack` read it.
"""

import contextlib
import glob
import hashlib
import json
import os
import sys
import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

PACKAGE = Path(__file__).resolve().parents[1]
ROOT = PACKAGE.parent
VENV = ROOT / ".venv"
CONSTRAINTS = PACKAGE / "constraints.txt"


class SetupError(Exception):
    """The environment cannot be made; the message is one sentence with the way out. Exit code 4."""


def say(line: str) -> None:
    """One line of progress. Always on stderr: stdout belongs to --json."""
    print(f"mistyle: {line}", file=sys.stderr, flush=True)


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


def inside() -> bool:
    """Whether this Python is the one to run with."""
    return not in_clone() or os.path.realpath(sys.prefix) == os.path.realpath(VENV)


def read_record(folder: Path) -> dict[str, Any]:
    """What an earlier set-up noted: key, extras, llvm (variant, library, folders, version, size, mtime)."""
    with contextlib.suppress(OSError, ValueError):
        record = json.loads((folder / "mistyle.json").read_text(encoding="utf-8"))
        return record if isinstance(record, dict) else {}
    return {}


def write_record(folder: Path, record: dict[str, Any]) -> None:
    """Replace the note of the set-up as a whole."""
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
    return packages_ready(folder, record, extras) and llvm_ready(record)


def packages_ready(folder: Path, record: dict[str, Any], extras: set[str]) -> bool:
    """Whether the packages and `extras` were installed for the pins and the Python of today."""
    if "key" not in record or not python_of(folder).exists():
        return False
    return record["key"] == key(folder) and extras <= set(record.get("extras", ()))


def llvm_ready(record: dict[str, Any]) -> bool:
    """Whether the LLVM of the note is still there, and the user names no other."""
    llvm = record.get("llvm")
    if not llvm:
        return False
    asked = os.environ.get("DRJIT_LIBLLVM_PATH")
    if asked and llvm["library"] and asked not in (llvm["library"], llvm.get("refused")):
        return False
    return not llvm["library"] or print_of(llvm["library"]) == llvm["print"]


def print_of(library: str) -> list[int]:
    """Size and time of change of a library (bytes, ns), by which the next run knows it; nothing where it is gone."""
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
    return record["llvm"]["library"] if llvm_ready(record) else ""


def use_llvm() -> bool:
    """Tell Dr.Jit in this process about the LLVM that the set-up found; for scripts and tests that start without it.

    Returns whether there is one. Has to run before the first import of drjit or mitsuba; changes nothing where
    DRJIT_LIBLLVM_PATH is set already.
    """
    record = read_record(home())
    if os.environ.get("DRJIT_LIBLLVM_PATH") or not llvm_ready(record):
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
