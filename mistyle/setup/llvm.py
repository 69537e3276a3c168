"""Search for an LLVM that Dr.Jit can use: on the system, else downloaded privately. Standard library only.

Version numbers do not decide: Dr.Jit 1.5 refuses LLVM 14, while 15 and 16 abort the process when the first kernel is
compiled, which Python cannot catch. So a child process tries every candidate: it renders and back-propagates one pixel.
"""

import os
import platform
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple
from urllib.parse import unquote

from mistyle.setup.environment import with_llvm

Say = Callable[[str], None]

# The newest tested version first; a distribution offers one or two of them.
PACKAGES = ("libllvm19", "libllvm20", "libllvm21", "libllvm22", "libllvm18", "libllvm17t64", "libllvm17")
RETRIES = ("-o", "Acquire::Retries=3")
PLACES = (
    "/usr/lib/*-linux-gnu/libLLVM*.so*",
    "/usr/lib/llvm-*/lib/libLLVM*.so*",
    "/usr/lib/llvm*/lib64/libLLVM*.so*",
    "/usr/lib/llvm/*/lib*/libLLVM*.so*",
    "/usr/lib64/libLLVM*.so*",
    "/usr/lib/libLLVM*.so*",
    "/usr/local/lib/libLLVM*.so*",
    "/opt/homebrew/opt/llvm*/lib/libLLVM*.dylib",
    "/usr/local/opt/llvm*/lib/libLLVM*.dylib",
    "C:/Program Files/LLVM/bin/LLVM-C.dll",
)
PROBE = """
import sys, drjit as dr, mitsuba as mi
mi.set_variant(sys.argv[1])
texture = {"type": "bitmap", "data": dr.full(mi.TensorXf, 0.5, (2, 2, 3)), "raw": True}
scene = mi.load_dict({
    "type": "scene", "integrator": {"type": "prb", "max_depth": 3}, "light": {"type": "constant"},
    "camera": {"type": "perspective", "film": {"type": "hdrfilm", "width": 1, "height": 1}},
    "box": {"type": "cube", "to_world": mi.ScalarTransform4f().translate([0, 0, 4]),
            "bsdf": {"type": "principled", "base_color": texture, "roughness": 0.4, "metallic": 0.1}}})
params = mi.traverse(scene)
key = "box.bsdf.base_color.data"
dr.enable_grad(params[key])
params.update()
image = mi.render(scene, params, spp=4)
dr.backward(dr.mean(image, axis=None))
shown, felt = dr.mean(image.array), dr.sum(dr.grad(params[key]).array)
version = ".".join(map(str, dr.detail.llvm_version())) if sys.argv[1].startswith("llvm") else ""
print("pixel", "good" if 0.1 < shown[0] < 2 and felt[0] > 0 else "wrong", version)
"""


class Answer(NamedTuple):
    """The result of one probe; `why` is its last error line where it fails."""

    works: bool
    version: str = ""
    why: str = ""


class Variant(NamedTuple):
    """A Mitsuba variant; `library` and `folders` are Dr.Jit's LLVM settings ("" and none on a GPU)."""

    variant: str
    library: str = ""
    folders: tuple[str, ...] = ()
    version: str = ""


def probe(python: str, variant: Variant, timeout: float = 120) -> Answer:
    """Render and back-propagate one pixel with `python` in a process of its own, which may abort."""
    with tempfile.TemporaryDirectory() as scratch:
        # A separate cache: otherwise Dr.Jit loads a kernel that another LLVM compiled, and never tries this one.
        environment = with_llvm(variant.library, variant.folders, {**os.environ, "DRJIT_CACHE_DIR": scratch})
        try:
            done = subprocess.run(
                [python, "-I", "-c", PROBE, variant.variant],
                env=environment,
                cwd=scratch,
                capture_output=True,
                text=True,
                errors="replace",
                timeout=timeout,
                preexec_fn=_no_core_file if os.name == "posix" else None,
            )
        except subprocess.TimeoutExpired:
            return Answer(False, why=f"no answer in {timeout:g} s")
    match = re.search(r"^pixel good ?(\S*)$", done.stdout, re.MULTILINE)
    if done.returncode == 0 and match:
        return Answer(True, version=match[1])
    return Answer(False, why=_why(done.returncode, done.stdout + done.stderr))


def _no_core_file() -> None:
    import resource

    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))


def _why(code: int, output: str) -> str:
    for pattern in (
        "LLVM ERROR: [^:]*",
        "LLVM version .* is too old",
        ".*cannot open shared object.*",
        ".*could not be found.*",
    ):
        if line := re.search(pattern, output):
            return line[0].strip()[:200]
    lines = [line.strip() for line in output.splitlines() if line.strip()]
    return lines[-1][:200] if lines else f"ended with code {code}"


def candidates(home: Path, requested: str | None, places: tuple[str, ...] = PLACES) -> list[Path]:
    """Libraries to probe: that of DRJIT_LIBLLVM_PATH, our private one, then the system's, newest first."""
    private = sorted(_glob(str(home / "llvm/usr/lib/*-linux-gnu/libLLVM*.so*")))
    system = {Path(os.path.realpath(p)) for pattern in places for p in _glob(pattern)}
    ordered = [Path(requested)] if requested else []
    ordered += [p for p in private if not p.is_symlink()] + sorted(system, key=_version, reverse=True)
    return list(dict.fromkeys(p for p in ordered if p.is_file()))


def _glob(pattern: str) -> Iterator[Path]:
    anchor = Path(pattern).anchor
    return Path(anchor).glob(pattern[len(anchor) :]) if Path(anchor).is_dir() else iter(())


def _version(path: Path) -> tuple[int, str]:
    """The version in the file's name; a name without one (libLLVM.dylib) is the package manager's newest."""
    number = re.search(r"(?:libLLVM-?|so\.)(\d+)", path.name)
    return (int(number[1]) if number else 999, path.as_posix())


def find(python: str, home: Path, say: Say) -> Variant | None:
    """The first variant that works: CUDA, Metal, then LLVM with each candidate library."""
    gpu = Variant("metal_ad_rgb" if sys.platform == "darwin" else "cuda_ad_rgb")
    if has_gpu() and probe(python, gpu).works:
        return gpu
    requested = os.environ.get("DRJIT_LIBLLVM_PATH")
    private = tuple(
        str(p) for p in [*_glob(str(home / "llvm/usr/lib/*-linux-gnu")), *_glob(str(home / "llvm/lib/*-linux-gnu"))]
    )
    for library in candidates(home, requested):
        for folders in ((), private) if private else ((),):
            variant = Variant("llvm_ad_rgb", str(library), folders)
            answer = probe(python, variant)
            if answer.works:
                return variant._replace(version=answer.version)
        say(f"{library} cannot be used: {answer.why}")
    return None


def has_gpu() -> bool:
    """Whether a GPU is worth a probe: a Mac, or a machine with NVIDIA's driver."""
    return sys.platform == "darwin" or bool(shutil.which("nvidia-smi"))


def fetch(home: Path, say: Say) -> bool:
    """Unpack Debian's or Ubuntu's libllvm, libatomic1 and their dependencies into `home`/llvm, without root.

    Nothing outside `home` is changed: where the system's package lists are missing or stale, private ones are made.
    """
    if not (shutil.which("apt-get") and shutil.which("dpkg-deb")):
        return False
    lists = home / "apt" / "lists"
    private = ["-o", f"Dir::State::lists={lists}", "-o", f"Dir::Cache={home / 'apt'}", "-o", "Debug::NoLocking=1"]
    try:
        for options in ([], private):
            if options:
                (lists / "partial").mkdir(parents=True, exist_ok=True)
                say("reading Debian's package lists into a private folder")
                _run(["apt-get", *options, "-q", "update"])
            for package in PACKAGES:
                if _download(home, package, options, say):
                    return True
        return False
    finally:
        shutil.rmtree(home / "apt", ignore_errors=True)


def _download(home: Path, package: str, options: list[str], say: Say) -> bool:
    install = ["apt-get", *options, "-qq", "--print-uris", "--no-install-recommends", "-y", "install"]
    planned = _run([*install, package, "libatomic1"])
    if planned.returncode != 0:
        return False
    # Each line names a package that this system lacks: 'URI' libllvm19_1%3a19.1.7-3_amd64.deb SIZE HASH.
    files = [line.split()[1].split("_") for line in planned.stdout.splitlines() if line.startswith("'")]
    packages = [f"{name}={unquote(version)}" for name, version, _ in files if not name.startswith("libc6")]
    if not packages:
        return False
    say(f"fetching {' '.join(name for name, _, _ in files)} into {home / 'llvm'} (the system is not changed)")
    with tempfile.TemporaryDirectory(dir=home) as scratch:
        os.chmod(scratch, 0o755)  # apt-get downloads as its own user when root calls it
        if _run(["apt-get", *options, *RETRIES, "-q", "download", *packages], cwd=scratch).returncode != 0:
            return False
        for deb in sorted(Path(scratch).glob("*.deb")):
            if _run(["dpkg-deb", "-x", str(deb), str(Path(scratch) / "llvm")]).returncode != 0:
                return False
        shutil.rmtree(home / "llvm", ignore_errors=True)
        os.replace(Path(scratch) / "llvm", home / "llvm")
    return True


def install(say: Say) -> bool:
    """Install LLVM on the system with apt-get, as root or through sudo (option --system)."""
    if not shutil.which("apt-get"):
        return False
    root = [] if os.geteuid() == 0 else ["sudo"]
    if root and not shutil.which("sudo"):
        return False
    subprocess.run([*root, "apt-get", "-q", "update"], stdout=sys.stderr)
    for package in PACKAGES:
        if _run(["apt-cache", "show", package]).returncode == 0:
            say(f"installing {package} and libatomic1 on the system")
            line = [*root, "apt-get", "-q", "install", "-y", "--no-install-recommends", package, "libatomic1"]
            quiet = {**os.environ, "DEBIAN_FRONTEND": "noninteractive"}
            return subprocess.run(line, stdout=sys.stderr, env=quiet).returncode == 0
    return False


def _run(line: list[str], cwd: str | None = None) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        line, cwd=cwd, env=dict(os.environ, LC_ALL="C"), stdin=subprocess.DEVNULL, capture_output=True, text=True
    )


def command() -> str:
    """The exact command that installs an LLVM on this system."""
    if sys.platform == "darwin":
        return "brew install llvm"
    if sys.platform == "win32":
        return "winget install LLVM.LLVM   (or set DRJIT_LIBLLVM_PATH to a LLVM-C.dll of version 19)"
    try:
        release = platform.freedesktop_os_release()
    except OSError:
        release = {}
    family = {release.get("ID", ""), *release.get("ID_LIKE", "").split()}
    if family & {"debian", "ubuntu"}:
        if shutil.which("apt-cache") and not _run(["apt-cache", "show", *PACKAGES]).stdout:
            return (
                "sudo apt-get update && sudo apt-get install -y libllvm19 libatomic1   (where the distribution has no "
                "libllvm19: curl -fsSL https://apt.llvm.org/llvm.sh | sudo bash -s -- 19)"
            )
        return "sudo apt-get update && sudo apt-get install -y libllvm19 libatomic1"
    if family & {"fedora", "rhel", "centos"}:
        return "sudo dnf install -y llvm-libs libatomic"
    if "arch" in family:
        return "sudo pacman -S --needed llvm-libs"
    if family & {"suse", "opensuse"}:
        return "sudo zypper install -y libLLVM19 libatomic1"
    return "install LLVM 19 with the system's package manager and set DRJIT_LIBLLVM_PATH to its libLLVM.so"
