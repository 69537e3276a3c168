"""`mistyle pack`: an offline installer of mistyle in one folder.

    DIR/wheels/       mistyle and its dependencies, in the exact versions of mistyle/constraints.txt
    DIR/llvm/         the libLLVM of this machine, with its own libraries
    DIR/install.sh    ./install.sh /opt/mistyle: no network, no root; the installed folder may be read-only
    DIR/SHA256SUMS    of every file

The installed program writes nothing into its own folder: kernels and caches go to $MISTYLE_SCRATCH (default
$TMPDIR/mistyle-UID), which should be a local disk. A pack fits the system, processor and Python version that built it.
"""

import os
import platform
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from mistyle import __version__
from mistyle.core.errors import EnvironmentMissing, MistyleError
from mistyle.core.paths import real_path
from mistyle.io.store.atomic import sha256_file
from mistyle.io.store.output import claim, replace_files
from mistyle.jobs.progress import Progress
from mistyle.setup.environment import CONSTRAINTS, ROOT, home, in_clone, read_record

INSTALL = """#!/bin/sh
# Installs mistyle {version} from this folder into TARGET. Needs no network and no root.
set -eu
target=${{1:?usage: ./install.sh TARGET}}
here=$(CDPATH= cd -- "$(dirname -- "$0")" && pwd)
python=${{PYTHON:-python{python}}}
command -v "$python" > /dev/null || {{ echo "mistyle: $python is needed (set PYTHON)" >&2; exit 4; }}
(cd "$here" && sha256sum --check --quiet SHA256SUMS)
"$python" -m venv "$target"
"$target/bin/python" -m pip install --quiet --no-index --find-links "$here/wheels" -c "$here/constraints.txt" \\
    'mistyle{extras}=={version}'
mkdir -p "$target/llvm"
cp -R "$here/llvm/." "$target/llvm/"
cat > "$target/mistyle" << 'END'
{start}END
chmod +x "$target/mistyle"
"$target/bin/python" -m compileall -q "$target/lib" || true
echo "installed: $target/mistyle"
"""

START = """#!/bin/sh
# mistyle in a folder that may be read-only; caches go to local scratch.
here=$(CDPATH= cd -- "$(dirname -- "$(readlink -f -- "$0")")" && pwd)
scratch=${{MISTYLE_SCRATCH:-${{TMPDIR:-/tmp}}/mistyle-$(id -u)}}
mkdir -p "$scratch"
export XDG_CACHE_HOME="$scratch" DRJIT_CACHE_DIR="${{DRJIT_CACHE_DIR:-$scratch/drjit}}" PYTHONDONTWRITEBYTECODE=1
export DRJIT_LIBLLVM_PATH="$here/llvm/{library}" LD_LIBRARY_PATH="$here/llvm${{LD_LIBRARY_PATH:+:$LD_LIBRARY_PATH}}"
exec "$here/bin/python" -m mistyle "$@"
"""


def pack(folder: Path, extras: Sequence[str], progress: Progress, *, overwrite: bool = False) -> Path:
    """Write the pack's files; needs the network on this machine.

    Raises EnvironmentMissing without a libLLVM, UsageError where a file in `folder` is not ours.
    """
    library, beside = llvm_files()
    claim(folder, ["install.sh", "constraints.txt", "SHA256SUMS"], overwrite=overwrite)
    with progress.stage("pack", "collect the wheels"):
        replace_files(folder, "pack", lambda new: _fill(new, extras, library, beside), overwrite=overwrite)
    return folder


def llvm_files() -> tuple[Path, list[Path]]:
    """The libLLVM in use, and the libraries that the set-up downloaded with it."""
    record = read_record(home()).get("llvm") or {}
    library = os.environ.get("DRJIT_LIBLLVM_PATH") or record.get("library")
    if not library or not Path(library).is_file():
        raise EnvironmentMissing("a pack includes the libLLVM in use, and none was found; see mistyle doctor")
    folders = [Path(f) for f in record.get("folders", ())]
    beside = [p for f in folders for p in sorted(f.glob("*.so*")) if not p.is_symlink()]
    return real_path(Path(library)), [p for p in beside if real_path(p) != real_path(Path(library))]


def scripts(extras: Sequence[str], library: str) -> str:
    """The text of install.sh."""
    version = ".".join(platform.python_version_tuple()[:2])
    names = f"[{','.join(sorted(extras))}]" if extras else ""
    return INSTALL.format(version=__version__, python=version, extras=names, start=START.format(library=library))


def _fill(folder: Path, extras: Sequence[str], library: Path, beside: Sequence[Path]) -> None:
    wheels = folder / "wheels"
    wheels.mkdir()
    names = f"[{','.join(sorted(extras))}]" if extras else ""
    if in_clone():
        _pip("wheel", "--no-deps", "-w", str(wheels), str(ROOT))
        mistyle = next(wheels.glob("mistyle-*.whl"))
        _pip("download", "-d", str(wheels), "-c", str(CONSTRAINTS), f"{mistyle}{names}")
    else:
        _pip("download", "-d", str(wheels), "-c", str(CONSTRAINTS), f"mistyle{names}=={__version__}")
    # A source archive could not be built offline.
    sources = [p.name for p in wheels.iterdir() if p.suffix != ".whl"]
    if sources:
        raise MistyleError(f"no wheel for this system of {', '.join(sources)}; pack on a system that has one")
    shutil.copy2(CONSTRAINTS, folder / "constraints.txt")
    (folder / "llvm").mkdir()
    for path in (library, *beside):
        shutil.copy2(path, folder / "llvm" / path.name)
    (folder / "install.sh").write_text(scripts(extras, library.name))
    (folder / "install.sh").chmod(0o755)
    files = sorted(p for p in folder.rglob("*") if p.is_file())
    lines = [f"{sha256_file(p)}  {p.relative_to(folder).as_posix()}\n" for p in files]
    (folder / "SHA256SUMS").write_text("".join(lines))


def _pip(*arguments: str) -> None:
    command = [sys.executable, "-m", "pip", "--disable-pip-version-check", "--quiet", *arguments]
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode != 0:
        errors = [row for row in done.stderr.splitlines() if row.strip()]
        raise MistyleError(f"pip {arguments[0]} failed: {errors[-1] if errors else done.returncode}")
