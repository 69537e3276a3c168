"""Making an environment and calling pip, with stand-ins for what would be fetched."""

import hashlib
import os
import shutil
import subprocess
import sys
import threading
import zipfile
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest

from mistyle.setup import environment, install

FAKE_PIP = """
import sys, pathlib, sysconfig
folder = pathlib.Path(sysconfig.get_paths()["purelib"]) / "pip"
folder.mkdir(parents=True, exist_ok=True)
(folder / "__init__.py").write_text("")
(folder / "__main__.py").write_text("print('pip 99.9')")
"""


@pytest.fixture
def venv(tmp_path: Path) -> Path:
    """A virtual environment as the set-up makes it: with a Python, without pip."""
    folder = tmp_path / ".venv"
    folder.mkdir()
    install.make_venv(folder, folder / "bin/python")
    return folder


def program(path: Path, script: str) -> Path:
    """A stand-in for a program."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(f"#!/bin/sh\n{script}\n")
    path.chmod(0o755)
    return path


def wheel(folder: Path, version: str = "99.9") -> Path:
    """A wheel that can be run as pip's can, and puts a pip into the Python that runs it."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"pip-{version}-py3-none-any.whl"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("pip/__init__.py", "")
        archive.writestr("pip/__main__.py", FAKE_PIP)
    return path


def test_a_new_environment_is_kept_when_it_works(venv):
    python = venv / "bin/python"
    assert install._version_of(python) == sys.version_info[:2]
    assert not install._has_pip(python)
    (venv / "kept").write_text("")
    install.make_venv(venv, python)
    assert (venv / "kept").exists()


def test_ours_is_made_anew_when_it_broke_and_keeps_its_llvm(venv):
    python = venv / "bin/python"
    python.unlink()
    python.symlink_to("/nowhere/python3")
    (venv / "stale").write_text("")
    (venv / "llvm").mkdir()
    install.make_venv(venv, python)
    assert install._version_of(python) == sys.version_info[:2]
    assert not (venv / "stale").exists()
    assert (venv / "llvm").is_dir()


def test_a_folder_of_someone_else_is_left_alone(tmp_path):
    (tmp_path / "precious").write_text("")
    with pytest.raises(environment.SetupError, match="move it away"):
        install.make_venv(tmp_path, tmp_path / "bin/python")
    assert (tmp_path / "precious").exists()


def test_an_environment_of_an_older_python_is_refused(tmp_path):
    python = program(tmp_path / "bin/python", "echo 3 9")
    (tmp_path / "pyvenv.cfg").write_text("version = 3.9.1\n")
    with pytest.raises(environment.SetupError, match=r"Python 3\.9.*3\.11 or newer"):
        install.make_venv(tmp_path, python)


def test_pip_from_a_wheel_on_the_disk(venv, tmp_path, monkeypatch):
    python = venv / "bin/python"
    wheel(tmp_path / "wheels")
    for way in ("_ensurepip", "_other_pip", "_registry", "_debian"):
        monkeypatch.setattr(install, way, lambda *_: iter(()))
    monkeypatch.setattr(install, "_disk", partial(install._disk, folder=tmp_path / "wheels"))
    install.ensure_pip(python, venv)
    assert "99.9" in install._run(str(python), "-m", "pip", "--version").stdout


@pytest.mark.parametrize("honest", [True, False])
def test_pip_from_the_registry_only_with_the_right_hash(venv, tmp_path, monkeypatch, honest):
    page = tmp_path / "www/simple/pip"
    page.mkdir(parents=True)
    links = ""
    for version in ("9.9", "99.9"):
        file = wheel(tmp_path / "www/files", version)
        hashed = hashlib.sha256(file.read_bytes() if honest else b"").hexdigest()
        links += f'<a href="../../files/{file.name}#sha256={hashed}" >{file.name}</a><br/>\n'
    links += f'<a href="../../files/pip-100.0-py3-none-any.whl#sha256={"0" * 64}" data-yanked="">yanked</a>'
    (page / "index.html").write_text(links)
    with ThreadingHTTPServer(("127.0.0.1", 0), partial(Quiet, directory=str(tmp_path / "www"))) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        monkeypatch.setenv("PIP_INDEX_URL", f"http://127.0.0.1:{server.server_port}/simple/")
        monkeypatch.setenv("no_proxy", "127.0.0.1")
        lines = [Path(line[1]).parent.name for line in install._registry(venv / "bin/python", venv)]
        server.shutdown()
    assert lines == (["pip-99.9-py3-none-any.whl"] if honest else [])


class Quiet(SimpleHTTPRequestHandler):
    """A web server that does not write to the terminal."""

    def log_message(self, format: str, *args: object) -> None:
        pass


def test_without_any_way_to_pip_the_command_is_named(venv, monkeypatch):
    for way in ("_ensurepip", "_disk", "_other_pip", "_registry", "_debian"):
        monkeypatch.setattr(install, way, lambda *_: iter(()))
    with pytest.raises(environment.SetupError, match=r"run: .*install.*3\.\d+"):
        install.ensure_pip(venv / "bin/python", venv)


def test_pip_is_kept_inside_the_environment(tmp_path, monkeypatch):
    for name in ("PIP_TARGET", "PIP_PREFIX", "PYTHONPATH"):
        monkeypatch.setenv(name, "/elsewhere")
    monkeypatch.setenv("PIP_USER", "1")
    monkeypatch.setenv("PIP_FIND_LINKS", "/wheels")
    python = program(tmp_path / "python", 'env; echo "arguments: $@"')
    assert install.pip(python, tmp_path, "numpy") == ""
    said = (tmp_path / "setup.log").read_text()
    assert "/elsewhere" not in said
    assert "PIP_USER=0\n" in said and "PIP_REQUIRE_VIRTUALENV=1\n" in said
    assert "PIP_FIND_LINKS=/wheels\n" in said, "where to look for packages is the user's choice"
    assert "-m pip install" in said and said.rstrip().endswith("numpy")


@pytest.mark.parametrize(
    ("output", "sentence"),
    [
        ("WARNING: Retrying after connection broken by 'NewConnectionError(x)'\nERROR: No matching ...", "registry"),
        ("ERROR: Could not install packages due to an OSError: [Errno 28] No space left on device", "disk is full"),
        ("ERROR: No matching distribution found for xatlas==0.0.11", "no xatlas==0.0.11 for Python"),
        (
            "  ERROR: Failed building wheel for flip-evaluator\n  ERROR: Failed building wheel for xatlas\nerror: x",
            "no binary of flip-evaluator, xatlas for Python",
        ),
        ("× Encountered error while generating package metadata.\n╰─> scipy==1.17.1\nerror: x", "C++ compiler"),
        ("noise\nERROR: Cannot unpack file x.\n", "pip failed: Cannot unpack file x"),
        ("", "printed no reason"),
    ],
)
def test_failures_become_one_sentence(tmp_path, output, sentence):
    (tmp_path / "output").write_text(output)
    python = program(tmp_path / "python", f"cat {tmp_path / 'output'}; exit 1")
    said = install.pip(python, tmp_path, "numpy")
    assert sentence in said and "\n" not in said
    assert str(tmp_path / "setup.log") in said


@pytest.mark.parametrize(
    ("gpu", "system", "first", "ways"),
    [
        (False, "linux", "torch==2.13.0+cpu", 3),
        (True, "linux", "torch===2.13.0", 2),
        (False, "darwin", "torch==2.13.0", 1),
        (False, "win32", "torch==2.13.0", 1),
        (True, "win32", "torch==2.13.0", 2),
    ],
)
def test_which_torch_is_tried_first(gpu, system, first, ways):
    tries = [arguments for _, arguments in install.torch_ways("2.13.0", gpu, system)]
    assert tries[0][-1] == first
    assert len(tries) == ways
    assert tries[-1][-1] == "torch==2.13.0", "the plain registry is the last resort"


@pytest.mark.parametrize(("gpu", "way"), [(True, 0), (False, -1)])
def test_the_size_of_the_cuda_build_is_told_before_it_is_fetched(tmp_path, monkeypatch, capsys, gpu, way):
    """2.7 GB and 4.7 GB belong to the pinned torch; the line comes before pip runs."""
    sizes = "2.7 GB to fetch with its packages, 4.7 GB on the disk"
    assert "torch==2.13.0\n" in install.CONSTRAINTS.read_text(), "a new torch has other sizes: CUDA_FETCH_BYTES"
    words, arguments = install.torch_ways("2.13.0", gpu, "linux")[way]
    assert sizes in words and "+cpu" not in arguments[-1]
    others = [w for w, a in install.torch_ways("2.13.0", False, "linux") if "+cpu" in a[-1]]
    assert len(others) == 2 and not any("CUDA" in w for w in others)
    told = []

    def pip(python: Path, venv: Path, *arguments: str) -> str:
        told.append((arguments[-1], capsys.readouterr().err))
        return "not there" if "+cpu" in arguments[-1] else ""

    monkeypatch.setattr(install, "pip", pip)
    monkeypatch.setattr(install, "nvidia", lambda: gpu)
    monkeypatch.setattr(sys, "platform", "linux")
    disk(monkeypatch, 10e9)
    install.install_torch(tmp_path / "bin/python", tmp_path)
    assert sizes in told[-1][1] and "+cpu" not in told[-1][0]
    assert not any(sizes in said for _, said in told[:-1])


def disk(monkeypatch: pytest.MonkeyPatch, free: float) -> None:
    """A disk with so many free bytes, whatever this machine's has."""
    usage = shutil._ntuple_diskusage(20e9, 20e9 - free, free)
    monkeypatch.setattr(install.shutil, "disk_usage", lambda _: usage)


@pytest.mark.parametrize(("gpu", "reason"), [(True, "^"), (False, "^the registry is away; and ")])
def test_the_cuda_build_is_not_begun_on_a_disk_without_room(tmp_path, monkeypatch, gpu, reason):
    """Without a GPU the reason that the CPU build was not taken comes first: it is the one to mend."""

    def pip(python: Path, venv: Path, *arguments: str) -> str:
        assert "+cpu" in arguments[-1], "the CUDA build was begun"
        return "the registry is away"

    monkeypatch.setattr(install, "pip", pip)
    monkeypatch.setattr(install, "nvidia", lambda: gpu)
    monkeypatch.setattr(sys, "platform", "linux")
    disk(monkeypatch, 4e9)
    with pytest.raises(
        environment.SetupError, match=rf"{reason}/.*4\.0 GB of free disk space.*needs 4\.7 GB; make room"
    ):
        install.install_torch(tmp_path / "bin/python", tmp_path)


def test_configured_wheels_come_before_pytorchs_own(tmp_path, monkeypatch):
    """Each failed try leads to the next one, the first that works ends it, and an installed torch is kept."""
    calls = []

    def pip(python: Path, venv: Path, *arguments: str) -> str:
        calls.append("index" if "--index-url" in arguments else arguments[-1])
        return "" if len(calls) == 2 else "not there"

    monkeypatch.setattr(install, "pip", pip)
    monkeypatch.setattr(install, "nvidia", lambda: False)
    monkeypatch.setattr(sys, "platform", "linux")
    install.install_torch(tmp_path / "bin/python", tmp_path)
    version = calls[0].removeprefix("torch==").removesuffix("+cpu")
    assert calls == [f"torch=={version}+cpu", "index"]
    (tmp_path / f"lib/python3.11/site-packages/torch-{version}+cpu.dist-info").mkdir(parents=True)
    install.install_torch(tmp_path / "bin/python", tmp_path)
    assert len(calls) == 2


@pytest.mark.parametrize(("words", "answer"), [("GPU 0: NVIDIA H200 (UUID: x)", True), ("No devices found", False)])
def test_a_gpu_counts_when_it_answers(tmp_path, monkeypatch, words, answer):
    program(tmp_path / "nvidia-smi", f"echo '{words}'")
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    assert install.nvidia() is answer


def test_no_interpreter_is_left_running_when_pip_is_interrupted(tmp_path):
    """SIGTERM to the set-up reaches the pip that it waits for."""
    program(tmp_path / "python", "echo $$ > pid; echo Installing collected packages: numpy; exec sleep 100")
    code = (
        "import sys; from pathlib import Path; from mistyle.setup import bootstrap, install\n"
        "with bootstrap._stoppable(): install.pip(Path('python').absolute(), Path('.').absolute(), 'numpy')"
    )
    variables = {**os.environ, "PYTHONPATH": str(environment.ROOT)}
    line = [sys.executable, "-c", code]
    with subprocess.Popen(line, cwd=tmp_path, env=variables, stderr=subprocess.PIPE, text=True) as child:
        assert child.stderr and "unpacking" in child.stderr.readline()
        child.terminate()
        assert child.wait(timeout=20) == 75
    with pytest.raises(ProcessLookupError):
        os.kill(int((tmp_path / "pid").read_text()), 0)
