"""Virtual environment and installation of the pinned packages. Standard library only."""

import hashlib
import os
import platform
import re
import shutil
import subprocess
import sys
import tempfile
import time
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path
from urllib.parse import urljoin

from mistyle.setup.environment import CONSTRAINTS, ROOT, SetupError, in_clone, say, write_record

NEEDED_BYTES = 3_000_000_000
CPU_WHEELS = "https://download.pytorch.org/whl/cpu"
CUDA_WHEELS = "https://download.pytorch.org/whl/cu130"  # only Windows needs it: its plain wheels have no CUDA
REGISTRY = "https://pypi.org/simple"
UNREACHABLE = (
    "NameResolutionError|Temporary failure in name resolution|Could not resolve|NewConnectionError|Connection refused"
    "|Network is unreachable|ConnectTimeout|ReadTimeout|timed out|Connection reset|ProxyError|SSLError|IncompleteRead"
    "|RemoteDisconnected|Connection aborted"
)


def packages(venv: Path, python: Path, extras: set[str]) -> None:
    """Make `venv` unless it works already, and install mistyle with its pinned dependencies and `extras` into it."""
    if not in_clone():
        return _check_installed()
    make_venv(venv, python)
    ensure_pip(python, venv)
    install_torch(python, venv)
    names = f"[{','.join(sorted(extras))}]" if extras else ""
    say(f"installing the packages{' for ' + ', '.join(sorted(extras)) if extras else ''}")
    failure = pip(python, venv, "-c", str(CONSTRAINTS), "-e", f"{ROOT}{names}")
    if failure:
        raise SetupError(failure)


def _check_installed() -> None:
    from importlib.util import find_spec

    missing = [name for name in ("mitsuba", "torch", "trimesh", "numpy", "pydantic") if find_spec(name) is None]
    if missing:
        raise SetupError(
            f"{sys.prefix} has no {', '.join(missing)}; run: {sys.executable} -m pip install -c {CONSTRAINTS} mistyle"
        )


def make_venv(venv: Path, python: Path) -> None:
    """Create a virtual environment without pip. A working one is kept, whoever made it. A broken one of mistyle's own
    (its Python is missing or has another version) is recreated."""
    version = _version_of(python)
    config = (venv / "pyvenv.cfg").read_text(encoding="utf-8") if (venv / "pyvenv.cfg").is_file() else ""
    created_for = re.search(r"^version(?:_info)? = (\d+)\.(\d+)", config, re.MULTILINE)
    if version and created_for and version == (int(created_for[1]), int(created_for[2])):
        if version < (3, 11):
            raise SetupError(f"{venv} has Python {version[0]}.{version[1]}, mistyle needs 3.11 or newer; move it away")
        return
    ours = {"mistyle.json", "mistyle.json.part", "mistyle.lock", "llvm"}
    if not (venv / "mistyle.json").exists() and {p.name for p in venv.iterdir()} - ours:
        raise SetupError(f"{venv} is not a working virtual environment, and mistyle did not make it; move it away")
    if shutil.disk_usage(venv).free < NEEDED_BYTES:
        raise SetupError(f"{venv} needs {NEEDED_BYTES / 1e9:.0f} GB of free disk space for the packages; make room")
    for path in venv.iterdir():
        if path.name not in ours:
            shutil.rmtree(path) if path.is_dir() and not path.is_symlink() else path.unlink()
    try:
        from venv import EnvBuilder
    except ImportError:
        raise SetupError(f"this Python has no venv module; run: {_python_command()}") from None
    write_record(venv, {})
    EnvBuilder(symlinks=os.name != "nt", with_pip=False).create(venv)


def _version_of(python: Path) -> tuple[int, int] | None:
    try:
        done = _run(str(python), "-I", "-c", "import sys; print(*sys.version_info[:2])")
    except OSError:
        return None
    numbers = done.stdout.split()
    return (int(numbers[0]), int(numbers[1])) if done.returncode == 0 and len(numbers) == 2 else None


def _python_command() -> str:
    version = f"{sys.version_info[0]}.{sys.version_info[1]}"
    if shutil.which("apt-get"):
        return f"sudo apt-get install -y python{version}-venv"
    return f"install Python {version} from python.org with its pip and venv"


def _compiler_command() -> str:
    commands = {"apt-get": "sudo apt-get install -y g++ python3-dev", "dnf": "sudo dnf install gcc-c++ python3-devel"}
    return next((command for tool, command in commands.items() if shutil.which(tool)), "with your system's tools")


# pip, where Python lacks it (Debian and Ubuntu ship ensurepip in python3-venv)


def ensure_pip(python: Path, venv: Path) -> None:
    """Make sure that `python` has pip: ensurepip, a wheel on this disk, another pip, the registry, Debian's package."""
    ways: list[Callable[[Path, Path], Iterator[list[str]]]] = [_ensurepip, _disk, _other_pip, _registry, _debian]
    if _has_pip(python):
        return
    for way in ways:
        for line in way(python, venv):
            if _run(*line).returncode == 0 and _has_pip(python):
                return
    raise SetupError(f"no way to get pip into {venv} (no ensurepip, registry not reachable); run: {_python_command()}")


def _has_pip(python: Path) -> bool:
    return _run(str(python), "-I", "-m", "pip", "--version").returncode == 0


def _ensurepip(python: Path, venv: Path) -> Iterator[list[str]]:
    yield [str(python), "-I", "-m", "ensurepip", "--upgrade", "--default-pip"]


def _disk(python: Path, venv: Path, folder: Path = Path("/usr/share/python-wheels")) -> Iterator[list[str]]:
    for wheel in sorted(folder.glob("pip-*.whl"), reverse=True):
        # Python can run a wheel (a zip), so pip can install itself.
        yield [str(python), f"{wheel}/pip", "install", "--no-index", "--no-deps", str(wheel)]


def _other_pip(python: Path, venv: Path) -> Iterator[list[str]]:
    for interpreter in dict.fromkeys(filter(None, [sys.executable, shutil.which("python3")])):
        yield [interpreter, "-m", "pip", "--python", str(python), "install", "--no-deps", "pip"]


def _registry(python: Path, venv: Path) -> Iterator[list[str]]:
    """pip's newest wheel straight from the registry's page, its hash checked."""
    page = os.environ.get("PIP_INDEX_URL", REGISTRY).rstrip("/") + "/pip/"
    try:
        links = re.findall(r"<a ([^>]*)>", _download(page).decode(errors="replace"))
        wheels = [
            re.search(r'href="([^"#]*/(pip-([\d.]+)-py3-none-any\.whl))#sha256=(\w{64})"', link) for link in links
        ]
        usable = [w for link, w in zip(links, wheels, strict=True) if w and "data-yanked" not in link]
        newest = max(usable, key=lambda w: [int(n) for n in w[3].split(".")])
        content = _download(urljoin(page, newest[1]))
    except (OSError, ValueError):
        return
    if hashlib.sha256(content).hexdigest() != newest[4]:
        return
    with tempfile.TemporaryDirectory(dir=venv) as scratch:
        (Path(scratch) / newest[2]).write_bytes(content)
        yield from _disk(python, venv, Path(scratch))


def _download(address: str) -> bytes:
    with urllib.request.urlopen(address, timeout=30) as answer:
        return answer.read(50_000_000)


def _debian(python: Path, venv: Path) -> Iterator[list[str]]:
    if not (shutil.which("apt-get") and shutil.which("dpkg-deb")):
        return
    with tempfile.TemporaryDirectory(dir=venv) as scratch:
        _run("apt-get", "-q", "download", "python3-pip-whl", cwd=scratch)
        for deb in Path(scratch).glob("*.deb"):
            _run("dpkg-deb", "-x", str(deb), scratch)
        yield from _disk(python, venv, Path(scratch) / "usr/share/python-wheels")


# torch, whose build depends on the machine

# torch 2.13.0 for Linux with the packages of CUDA that constraints.txt pins: sums of their wheels' sizes, packed and
# unpacked, from the registry and the wheels' own directories. A new pin needs new numbers.
CUDA_FETCH_BYTES, CUDA_DISK_BYTES = 2.7e9, 4.7e9
CUDA_SIZE = f"{CUDA_FETCH_BYTES / 1e9:.1f} GB to fetch with its packages, {CUDA_DISK_BYTES / 1e9:.1f} GB on the disk"


def install_torch(python: Path, venv: Path) -> None:
    """The pinned torch: on a machine with an NVIDIA GPU the CUDA build, else one without gigabytes of CUDA packages.

    pip looks for a CPU build in its configured index, then among PyTorch's own CPU wheels. The plain registry comes
    last (on Linux its torch includes CUDA, and works without a GPU). The dependencies of torch are installed with the
    other packages, and pinned like them.
    """
    pin = re.search(r"^torch==([\w.]+)$", CONSTRAINTS.read_text(encoding="utf-8"), re.MULTILINE)
    assert pin, f"{CONSTRAINTS} has no line torch==VERSION"
    if list(venv.glob(f"[Ll]ib*/**/site-packages/torch-{pin[1]}*.dist-info")):
        return
    failure = ""
    for where, arguments in torch_ways(pin[1], nvidia(), sys.platform):
        say(f"installing torch {pin[1]} ({where})")
        if sys.platform == "linux" and "+cpu" not in arguments[-1]:
            _check_room(venv, CUDA_DISK_BYTES, "the CUDA build of torch", failure)
        failure = pip(python, venv, "--no-deps", *arguments)
        if not failure:
            return
    raise SetupError(failure)


def _check_room(venv: Path, needed: float, part: str, before: str) -> None:
    """Raise a SetupError that tells the room that is missing, after the reason why a smaller build was not taken."""
    free = shutil.disk_usage(venv).free
    if free < needed:
        reason = f"{before}; and " if before else ""
        raise SetupError(
            f"{reason}{venv} has {free / 1e9:.1f} GB of free disk space, {part} needs {needed / 1e9:.1f} GB; make "
            "room and run the same command again"
        )


def torch_ways(version: str, gpu: bool, system: str) -> list[tuple[str, list[str]]]:
    """Attempts in order: a description, and pip's arguments."""
    heavy = f"; no CPU build was found, so this is the CUDA build: {CUDA_SIZE}" if system == "linux" else ""
    plain = (f"the plain registry{heavy}", [f"torch=={version}"])
    if gpu and system == "win32":
        return [("PyTorch's CUDA wheels", ["--index-url", CUDA_WHEELS, f"torch=={version}"]), plain]
    if gpu:
        # "===" compares the exact string, so that a CPU build (2.13.0+cpu) in a configured folder is not taken.
        description = f"an NVIDIA GPU answers, so this is the CUDA build: {CUDA_SIZE}"
        return [(description, [f"torch==={version}"]), ("any build", [f"torch=={version}"])]
    if system != "linux":
        return [plain]
    quick, cpu = ["--retries", "1", "--timeout", "20"], f"torch=={version}+cpu"
    return [
        ("a CPU build, as pip is configured", [*quick, cpu]),
        ("PyTorch's CPU wheels", [*quick, "--index-url", CPU_WHEELS, cpu]),
        plain,
    ]


def nvidia() -> bool:
    """Whether an NVIDIA GPU answers."""
    if not shutil.which("nvidia-smi"):
        return False
    try:
        return "GPU 0" in _run("nvidia-smi", "-L", timeout=30).stdout
    except subprocess.TimeoutExpired:
        return False


def pip(python: Path, venv: Path, *arguments: str) -> str:
    """`pip install` into `venv`; returns "" or a one-sentence error message. The output is in setup.log."""
    line = [
        str(python),
        "-I",
        "-u",
        "-m",
        "pip",
        "install",
        "--disable-pip-version-check",
        "--no-input",
        "--prefer-binary",
    ]
    # Settings that redirect the installation are dropped; settings of the package index are kept.
    environment = {
        k: v for k, v in os.environ.items() if k not in ("PIP_TARGET", "PIP_PREFIX", "PIP_ROOT", "PYTHONPATH")
    }
    environment |= {"PIP_USER": "0", "PIP_REQUIRE_VIRTUALENV": "1"}
    log, begun, output = venv / "setup.log", time.monotonic(), []
    with open(log, "a", encoding="utf-8") as log_file:
        log_file.write(f"\n$ {' '.join([*line, *arguments])}\n")
        with subprocess.Popen(
            [*line, "--progress-bar", "off", *arguments],
            env=environment,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            encoding="utf-8",
            errors="replace",
        ) as child:
            try:
                for text in child.stdout or ():
                    log_file.write(text)
                    output.append(text)
                    if news := _news(text):
                        say(f"  {time.monotonic() - begun:4.0f} s  {news}")
            finally:
                child.terminate()
    return "" if child.returncode == 0 else f"{_sentence(''.join(output))}. The whole output is in {log}"


def _news(line: str) -> str:
    if size := re.match(r"\s*(Downloading|Using cached) (\S+?)(?:\.metadata)? \(([\d.]+) (MB|GB)\)", line):
        big = float(size[3]) * (1000 if size[4] == "GB" else 1) >= 10
        return f"{size[1].lower()} {size[2].split('/')[-1].split('-')[0]} ({size[3]} {size[4]})" if big else ""
    if line.startswith("Installing collected packages:"):
        return f"unpacking {line.count(',') + 1} packages"
    return ""


def _sentence(output: str) -> str:
    """pip's failure as one sentence, for a user who has never seen pip fail."""
    if "No space left on device" in output:
        return "the disk is full; make room and run the same command again"
    if cause := re.search(UNREACHABLE, output):
        return (
            f"pip cannot reach its package registry ({cause[0]}); check the network, the proxy and `pip config list`, "
            "then rerun to resume"
        )
    system = f"Python {platform.python_version()} on {platform.system()} {platform.machine()}"
    # pip prints the second message for a single package that is pinned twice and does not exist.
    if missing := re.search(r"No matching distribution found for (\S+)|Cannot install (\S+) because", output):
        return (
            f"the registry cannot be reached or has no {missing[1] or missing[2]} for {system} (mistyle is tested with "
            "3.11, 3.13 and 3.14)"
        )
    if unbuilt := re.findall(r"Failed building wheel for (\S+)|generating package metadata\.?\s+╰─> (\S+)", output):
        names = ", ".join(dict.fromkeys(wheel or source for wheel, source in unbuilt))
        return (
            f"the registry has no binary of {names} for {system}, and it could not be compiled; install a C++ compiler "
            f"and Python's headers ({_compiler_command()}), or use Python 3.11 to 3.13"
        )
    errors = re.findall(r"^\s*(?:ERROR|error): (.+)$", output, re.MULTILINE)
    return f"pip failed: {errors[-1].strip().rstrip('.') if errors else 'it printed no reason'}"


def _run(*line: str, cwd: str | None = None, timeout: float | None = None) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        line, cwd=cwd, stdin=subprocess.DEVNULL, capture_output=True, text=True, errors="replace", timeout=timeout
    )
