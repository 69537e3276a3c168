"""Facts of `mistyle doctor`: installed parts, missing parts, and the command that fixes each. Standard library only.

It runs on a Python without any package, too. Versions come from the packages' metadata, and each Mitsuba variant is
tried in a process of its own.
"""

import os
import platform
import re
import shutil
import subprocess
import sys
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec
from pathlib import Path
from typing import Literal, NamedTuple

from mistyle import __version__
from mistyle.setup import environment, install, llvm

State = Literal["ok", "missing", "optional"]

VARIANTS = ("llvm_ad_rgb", "metal_ad_rgb" if sys.platform == "darwin" else "cuda_ad_rgb")
# Each optional feature: its imports, and the packages to install. The main job needs none of them.
OPTIONAL = {
    "diffusion stylizers": (("diffusers", "transformers", "peft"), "diffusers transformers peft accelerate"),
    "ray": (("ray",), "ray"),
    "render farm": (("openjd",), "openjd-cli"),
    "usd": (("pxr", "MaterialX"), "usd-core MaterialX"),
}


class Row(NamedTuple):
    """One finding. `fix` is a command (or a short instruction), empty where nothing can be done."""

    name: str
    found: str
    state: State
    fix: str = ""


def rows(cores: int) -> list[Row]:
    """All findings in display order; `cores` is the number of processor cores to report. Takes a second or two."""
    return [*_machine(cores), *_packages(), *_renderers(), *_torch(), *_optional()]


def works(findings: Sequence[Row]) -> bool:
    """Whether the main job can run."""
    return all(row.state != "missing" for row in findings)


def _machine(cores: int) -> list[Row]:
    system = f"{platform.system()} {platform.machine()}"
    if hasattr(platform, "freedesktop_os_release"):
        try:
            system = f"{platform.freedesktop_os_release()['PRETTY_NAME']}, {system}"
        except (OSError, KeyError):
            pass
    memory = _memory()
    return [
        Row("mistyle", f"{__version__} in {environment.PACKAGE}", "ok"),
        Row("Python", f"{platform.python_version()} ({sys.executable})", "ok"),
        Row("system", f"{system}, {cores} cores{f', {memory:.0f} GB' if memory else ''}", "ok"),
    ]


def _memory() -> float:
    """Gigabytes of main memory; 0 where unknown."""
    try:
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 1e9
    except (AttributeError, ValueError, OSError):
        return 0.0


def _packages() -> list[Row]:
    pins = re.findall(r"^([\w.-]+)==([\w.]+)$", environment.CONSTRAINTS.read_text(encoding="utf-8"), re.MULTILINE)
    installed = {name: _version(name) for name, _ in pins}
    missing = [name for name in ("mitsuba", "torch", "numpy", "trimesh", "pydantic") if not installed.get(name)]
    if missing:
        return [
            Row("packages", f"missing: {', '.join(missing)}", "missing", "python3 -m mistyle doctor   (installs them)")
        ]
    differing = [
        f"{n} {installed[n]} for {pin}" for n, pin in pins if installed[n] and installed[n].split("+")[0] != pin
    ]
    if differing:
        project = f"-e {environment.ROOT}" if environment.in_clone() else "mistyle"
        fix = f"{sys.executable} -m pip install -c {environment.CONSTRAINTS} {project}"
        return [Row("packages", f"not the tested versions: {', '.join(differing)}", "optional", fix)]
    return [Row("packages", f"{sum(map(bool, installed.values()))} as pinned", "ok")]


def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return ""


def _renderers() -> list[Row]:
    if not _version("mitsuba"):
        return [Row("mitsuba", "not installed", "missing")]
    library = os.environ.get("DRJIT_LIBLLVM_PATH", "")
    variants = [llvm.Variant(v, library if v.startswith("llvm") else "") for v in VARIANTS]
    with ThreadPoolExecutor() as pool:
        answers = dict(zip(VARIANTS, pool.map(lambda v: llvm.probe(sys.executable, v), variants), strict=True))
    any_works = any(answer.works for answer in answers.values())
    result = [Row("mitsuba", _version("mitsuba"), "ok")]
    for variant, answer in answers.items():
        state: State = "ok" if answer.works else "optional" if any_works else "missing"
        if answer.works or variant.startswith("llvm"):
            state_text = "renders and back-propagates" if answer.works else f"does not work: {answer.why}"
            result.append(Row(f"  {variant}", state_text, state, "" if any_works else llvm.command()))
        else:
            result.append(Row(f"  {variant}", "does not answer", "optional"))
    if answers["llvm_ad_rgb"].works:
        result.append(Row("LLVM", f"{answers['llvm_ad_rgb'].version} ({library or 'found by Dr.Jit'})", "ok"))
    else:
        examined = ", ".join(map(str, llvm.candidates(environment.home(), None))) or "none"
        result.append(Row("LLVM", f"none that works; looked at {examined}", "optional" if any_works else "missing"))
    return result


def _torch() -> list[Row]:
    gpu = _gpu()
    result = [Row("GPU", gpu or "none; everything runs on the CPU", "ok" if gpu else "optional")]
    number = _version("torch")
    if not number:
        return [*result, Row("torch", "not installed", "missing")]
    cuda = _torch_cuda()
    row = Row("torch", f"{number} ({f'CUDA {cuda}' if cuda else 'CPU build'})", "ok")
    if gpu and not cuda and install.nvidia():
        row = Row("torch", f"{row.found}: an NVIDIA GPU answers, torch cannot use it", "optional", _afresh())
    return [*result, row]


def _afresh() -> str:
    return f"rm -r {environment.VENV} && python3 -m mistyle doctor   (sets up again, with the CUDA build)"


def _torch_cuda() -> str:
    """The CUDA version that torch was built for, read from its files: importing it takes seconds."""
    spec = find_spec("torch")
    file = Path(spec.origin).with_name("version.py") if spec and spec.origin else None
    text = file.read_text(encoding="utf-8") if file and file.is_file() else ""
    number = re.search(r"^cuda\b[^=]*= ['\"]([\d.]+)", text, re.MULTILINE)
    return number[1] if number else ""


def _gpu() -> str:
    if sys.platform == "darwin" and platform.machine() == "arm64":
        return "Apple (Metal)"
    if not shutil.which("nvidia-smi"):
        return ""
    line = ["nvidia-smi", "--query-gpu=name,memory.total,driver_version", "--format=csv,noheader"]
    return "; ".join(_words(*line).splitlines())


def _words(*line: str) -> str:
    """A program's standard output; empty when it fails or times out."""
    try:
        done = subprocess.run(line, capture_output=True, text=True, timeout=30)
    except (OSError, subprocess.TimeoutExpired):
        return ""
    return done.stdout.strip() if done.returncode == 0 else ""


def _optional() -> list[Row]:
    pip = f"{environment.python_of(environment.home())} -m pip install -c {environment.CONSTRAINTS}"
    result = []
    for name, (modules, packages) in OPTIONAL.items():
        missing = [module for module in modules if find_spec(module) is None]
        text = f"not installed: {', '.join(missing)}" if missing else "installed"
        result.append(Row(name, text, "optional" if missing else "ok", f"{pip} {packages}" if missing else ""))
    result += [_weights(), *_asset_folders()]
    node = _words("node", "--version") if shutil.which("node") else ""
    fix = "" if node else "install Node.js (nodejs.org); only the tests' glTF validator uses it"
    return [*result, Row("node", node or "not installed", "ok" if node else "optional", fix)]


def _asset_folders() -> list[Row]:
    """The folders in which meshes may name each other's files; no row without the variable."""
    entries = [entry.strip() for entry in os.environ.get("MISTYLE_ASSETS", "").split(os.pathsep) if entry.strip()]
    wrong = [entry for entry in entries if not os.path.isabs(entry) or not os.path.isdir(entry)]
    fix = f"MISTYLE_ASSETS takes absolute paths of folders, separated by '{os.pathsep}'"
    if wrong:
        return [Row("asset folders", f"MISTYLE_ASSETS names no folder: {', '.join(wrong)}", "missing", fix)]
    return [Row("asset folders", os.pathsep.join(entries), "ok")] if entries else []


def _weights() -> Row:
    path = os.environ.get("MISTYLE_VGG", "")
    if path and Path(path).is_file():
        return Row("VGG-19 weights", path, "ok")
    fix = (
        "put VGG-19 anywhere (.safetensors or .pth, in torchvision's layer order or the normalised one of Li et al.) "
        "and name it: export MISTYLE_VGG=FILE, or mistyle stylize … --vgg FILE"
    )
    if path:
        return Row("VGG-19 weights", f"MISTYLE_VGG names {path}, which does not exist", "optional", fix)
    return Row("VGG-19 weights", "none; the embedded features need none", "optional", fix)
