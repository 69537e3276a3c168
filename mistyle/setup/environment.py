"""Paths of the installation and the record of the set-up: virtual environment, pins, LLVM. Standard library only.

The set-up (`bootstrap.py`, `install.py`, `llvm.py`) writes the record. The renderer, `mistyle doctor` and `mistyle
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
    """The environment cannot be made; the message is one sentence with the fix. Exit code 4."""


def say(line: str) -> None:
    """One line of progress. Always on stderr: stdout belongs to --json."""
    print(f"mistyle: {line}", file=sys.stderr, flush=True)


def in_clone() -> bool:
    """Whether this package lies in its repository (else it was installed as a wheel)."""
    project = ROOT / "pyproject.toml"
    return project.is_file() and '\nname = "mistyle"' in project.read_text(encoding="utf-8")


def home() -> Path:
    """Folder of the set-up's record and of a private LLVM: .venv, or the user's cache for an installed wheel."""
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
    """The record of an earlier set-up: key, extras, llvm (variant, library, folders, version, size, mtime)."""
    with contextlib.suppress(OSError, ValueError):
        record = json.loads((folder / "mistyle.json").read_text(encoding="utf-8"))
        return record if isinstance(record, dict) else {}
    return {}


def write_record(folder: Path, record: dict[str, Any]) -> None:
    """Replace the record of the set-up atomically."""
    part = folder / "mistyle.json.part"
    part.write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")
    os.replace(part, folder / "mistyle.json")


def key(folder: Path) -> str:
    """Hash of everything that determines the installation: the pins, the project, the path, the Python."""
    digest = hashlib.sha256(CONSTRAINTS.read_bytes())
    if in_clone():
        project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
        digest.update(json.dumps(project, sort_keys=True).encode())
    else:
        from importlib.metadata import distributions

        digest.update(str([d.version for d in distributions(name="drjit")]).encode())
    # A virtual environment's symlink may point to another version after a system upgrade.
    digest.update(f"{PACKAGE} {os.path.basename(os.path.realpath(python_of(folder)))}".encode())
    return digest.hexdigest()


def ready(folder: Path, extras: set[str]) -> bool:
    """Whether the set-up is complete. Takes a few milliseconds: compares hashes, starts no process."""
    record = read_record(folder)
    return packages_ready(folder, record, extras) and llvm_ready(record)


def packages_ready(folder: Path, record: dict[str, Any], extras: set[str]) -> bool:
    """Whether the packages and `extras` were installed for the current pins and Python."""
    if "key" not in record or not python_of(folder).exists():
        return False
    return record["key"] == key(folder) and extras <= set(record.get("extras", ()))


def llvm_ready(record: dict[str, Any]) -> bool:
    """Whether the recorded LLVM still exists, and the user names no other."""
    llvm = record.get("llvm")
    if not llvm:
        return False
    requested = os.environ.get("DRJIT_LIBLLVM_PATH")
    if requested and llvm["library"] and requested not in (llvm["library"], llvm.get("refused")):
        return False
    return not llvm["library"] or print_of(llvm["library"]) == llvm["print"]


def print_of(library: str) -> list[int]:
    """Fingerprint of a library: size (bytes) and modification time (ns); an empty list where it is missing."""
    with contextlib.suppress(OSError):
        info = os.stat(library)
        return [info.st_size, info.st_mtime_ns]
    return []


def with_llvm(library: str, folders: Sequence[str], base: Mapping[str, str]) -> dict[str, str]:
    """`base` with the variables that make Dr.Jit load `library`; `folders` hold dependencies that the system lacks."""
    result = dict(base)
    if library:
        result["DRJIT_LIBLLVM_PATH"] = library
    if folders:
        inherited = [f for f in result.get("LD_LIBRARY_PATH", "").split(os.pathsep) if f and f not in folders]
        result["LD_LIBRARY_PATH"] = os.pathsep.join([*folders, *inherited])
    return result


def known_llvm() -> str:
    """Path of the LLVM that the set-up found; empty where it no longer exists."""
    record = read_record(home())
    return record["llvm"]["library"] if llvm_ready(record) else ""


def use_llvm() -> bool:
    """Set the LLVM that the set-up found for Dr.Jit in this process; for scripts and tests that start without it.

    Returns whether an LLVM is set. Must run before the first import of drjit or mitsuba. Changes nothing where
    DRJIT_LIBLLVM_PATH is set already.
    """
    record = read_record(home())
    if os.environ.get("DRJIT_LIBLLVM_PATH") or not llvm_ready(record):
        return bool(os.environ.get("DRJIT_LIBLLVM_PATH"))
    os.environ.update(with_llvm(record["llvm"]["library"], record["llvm"]["folders"], os.environ))
    if folders := record["llvm"]["folders"]:
        _preload([path for folder in folders for path in sorted(glob.glob(f"{folder}/*.so.*"))])
    return True


def _preload(libraries: list[str]) -> None:
    """Load libraries from folders outside the loader's search path, dependencies first."""
    import ctypes

    pending = [path for path in libraries if not os.path.islink(path)]
    for _ in range(len(pending)):
        for path in list(pending):
            with contextlib.suppress(OSError):
                ctypes.CDLL(path, mode=ctypes.RTLD_GLOBAL)
                pending.remove(path)
