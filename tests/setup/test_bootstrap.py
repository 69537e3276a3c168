"""The set-up's own decisions, with small stand-ins for the environment; the real one runs whenever the tests do."""

import ast
import json
import os
import re
import resource
import shutil
import signal
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest
from packaging.requirements import Requirement

from mistyle.setup import bootstrap, environment
from tests import conftest
from tests.support.helpers import ROOT

HEAVY = {"numpy", "pydantic", "rich", "torch", "mitsuba", "trimesh", "cv2", "scipy"}
HELP_SECONDS = 0.5  # of processor time, which other programs on the machine do not lengthen


@pytest.fixture
def clone(tmp_path: Path) -> Path:
    """A copy of the repository without its .venv."""
    root = tmp_path / "clone"
    shutil.copytree(ROOT / "mistyle", root / "mistyle", ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copy(ROOT / "pyproject.toml", root)
    return root


@pytest.fixture
def place(clone: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The set-up works in that copy; its .venv has a Python that is a link to this one."""
    package = clone / "mistyle"
    for name, value in {"PACKAGE": package, "ROOT": clone, "VENV": clone / ".venv"}.items():
        monkeypatch.setattr(environment, name, value)
    monkeypatch.setattr(environment, "CONSTRAINTS", package / "constraints.txt")
    for name in ("DRJIT_LIBLLVM_PATH", "LD_LIBRARY_PATH", "VIRTUAL_ENV", "CONDA_PREFIX"):
        monkeypatch.delenv(name, raising=False)
    (clone / ".venv/bin").mkdir(parents=True)
    (clone / ".venv/bin/python").symlink_to(sys.executable)
    return clone / ".venv"


def finished(venv: Path, **changed: object) -> dict:
    """The record that a finished set-up leaves."""
    library = venv / "libLLVM.so.19.1"
    library.write_bytes(b"library")
    llvm = {"variant": "llvm_ad_rgb", "library": str(library), "folders": [], "version": "19.1.7"}
    llvm["print"] = environment.print_of(str(library))
    record = {"key": environment.key(venv), "extras": ["test"], "llvm": llvm, **changed}
    environment.write_record(venv, record)
    return record


def bare(clone: Path, *line: str, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run a Python without any package in a clean environment."""
    return subprocess.run(
        [sys.executable, "-B", "-S", *line],
        cwd=clone,
        env={"HOME": str(clone), "PATH": "/usr/bin:/bin", **environment},
        capture_output=True,
        text=True,
        timeout=200,
    )


def test_help_answers_on_a_bare_python_without_set_up(clone):
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    done = bare(clone, "-m", "mistyle", "--help")
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    assert done.returncode == 0
    assert "mistyle" in done.stdout
    assert not done.stderr
    assert not (clone / ".venv").exists()
    assert after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime < HELP_SECONDS


def test_nothing_heavy_is_imported_before_a_command_runs(clone):
    setup = [f"setup.{name}" for name in ("bootstrap", "environment", "install", "llvm", "facts")]
    names = ["__main__", *setup, "cli.doctor", "cli.main"]
    code = (
        f"import sys; sys.path.insert(0, '.'); {'; '.join(f'import mistyle.{n}' for n in names)}; print(*sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=clone, capture_output=True, text=True, check=True)
    assert not HEAVY & set(done.stdout.split())


def test_ready_only_as_long_as_nothing_changed(place):
    assert not environment.ready(place, set())
    finished(place)
    assert environment.ready(place, set())
    assert environment.ready(place, {"test"})
    assert not environment.ready(place, {"diffusion"})


@pytest.mark.parametrize("change", ["constraints", "dependencies", "library", "python", "record"])
def test_a_change_calls_for_the_set_up(place, change):
    finished(place)
    project = place.parent / "pyproject.toml"
    if change == "constraints":
        environment.CONSTRAINTS.write_text("numpy==2.0\n")
    if change == "dependencies":
        project.write_text(project.read_text().replace('"numpy>=2,<3"', '"numpy>=2.1,<3"'))
    if change == "library":
        os.utime(place / "libLLVM.so.19.1", (0, 0))
    if change == "python":
        (place / "bin/python").unlink()
    if change == "record":
        (place / "mistyle.json").write_text("{")
    assert not environment.ready(place, set())


def test_lint_settings_call_for_nothing(place):
    finished(place)
    project = place.parent / "pyproject.toml"
    project.write_text(project.read_text().replace("line-length = 120", "line-length = 100"))
    assert environment.ready(place, set())


def test_another_llvm_that_the_user_names_is_looked_at_once(place, monkeypatch):
    record = finished(place)
    monkeypatch.setenv("DRJIT_LIBLLVM_PATH", "/elsewhere/libLLVM.so")
    assert not environment.ready(place, set())
    environment.write_record(place, {**record, "llvm": {**record["llvm"], "refused": "/elsewhere/libLLVM.so"}})
    assert environment.ready(place, set())


def test_the_verb_goes_over_to_the_other_python(place, monkeypatch, capsys):
    record = finished(place)
    monkeypatch.setenv("PYTHONPATH", "/foreign")
    monkeypatch.setenv("CONDA_PREFIX", "/opt/conda")
    went = []
    monkeypatch.setattr(bootstrap, "_hand_over", lambda *call: went.append(call) or 5)
    with pytest.raises(SystemExit, match="5"):
        bootstrap.enter(["stylize", "a.obj"], extras=set())
    line, environment = went[0]
    assert line == [str(place / "bin/python"), "-P", "-m", "mistyle", "stylize", "a.obj"]
    assert environment["DRJIT_LIBLLVM_PATH"] == record["llvm"]["library"]
    assert "PYTHONPATH" not in environment
    words = capsys.readouterr()
    assert not words.out
    assert words.err.count("\n") == 1 and "/opt/conda" in words.err


def test_it_stays_where_it_was_sent(place, monkeypatch):
    finished(place)
    monkeypatch.setattr(sys, "prefix", str(place))
    monkeypatch.setattr(bootstrap, "_hand_over", lambda *_: pytest.fail("went over again"))
    monkeypatch.setenv(bootstrap.ENTERED, str(place))
    bootstrap.enter(["stylize"], extras=set())
    assert bootstrap.ENTERED not in os.environ, "a child would believe that it was sent"
    bootstrap.enter(["stylize"], extras=set())
    assert os.environ["DRJIT_LIBLLVM_PATH"] == str(place / "libLLVM.so.19.1")


def without_llvm() -> dict[str, str]:
    """An environment that tells nothing of LLVM."""
    return {k: v for k, v in os.environ.items() if k not in ("DRJIT_LIBLLVM_PATH", "LD_LIBRARY_PATH")}


@pytest.mark.skipif(not environment.known_llvm(), reason="the set-up found a GPU or was not run")
def test_benchmarks_know_the_llvm_before_they_import_dr_jit():
    script = "import benchmarks, drjit, mitsuba; mitsuba.set_variant('llvm_ad_rgb'); print(drjit.detail.llvm_version())"
    line = [sys.executable, "-c", script]
    done = subprocess.run(line, env=without_llvm(), cwd=ROOT, capture_output=True, text=True, check=True)
    assert int(done.stdout.strip("()[] \n").split(",")[0]) >= 17


def test_dr_jit_that_came_too_early_is_said(monkeypatch):
    import drjit  # noqa: F401  # with its LLVM, before the variable that names it goes

    from mistyle.render.mitsuba import device

    monkeypatch.delenv("DRJIT_LIBLLVM_PATH", raising=False)
    monkeypatch.setattr(device, "known_llvm", lambda: "/l/libLLVM.so.19.1")
    assert "/l/libLLVM.so.19.1" in device._missing("llvm_ad_rgb")
    assert "mistyle.setup.environment.use_llvm()" in device._missing("llvm_ad_rgb")


def test_private_folders_come_first_and_once():
    once = environment.with_llvm("/l/libLLVM.so", ["/l"], {"LD_LIBRARY_PATH": "/a:/b", "HOME": "/h"})
    assert once == {"DRJIT_LIBLLVM_PATH": "/l/libLLVM.so", "LD_LIBRARY_PATH": "/l:/a:/b", "HOME": "/h"}
    assert environment.with_llvm("/l/libLLVM.so", ["/l"], once) == once
    assert environment.with_llvm("", [], {"HOME": "/h"}) == {"HOME": "/h"}


@pytest.mark.parametrize(("script", "code"), [("exit 7", 7), ("kill -TERM $$", -signal.SIGTERM)])
def test_exit_codes_and_signals_are_the_verbs_own(place, script, code):
    """The whole way: a bare Python, a finished record, and a shell script in place of .venv's Python."""
    (place / "bin/python").unlink()
    (place / "bin/python").write_text(f"#!/bin/sh\n{script}\n")
    (place / "bin/python").chmod(0o755)
    finished(place)
    assert bare(place.parent, "-m", "mistyle", "stylize").returncode == code


def test_without_a_network_one_sentence_and_exit_4(clone):
    """A real set-up up to the first download, with every index behind a proxy that refuses."""
    nowhere = "http://127.0.0.1:9"
    quick = {"PIP_RETRIES": "1", "PIP_CONFIG_FILE": os.devnull, "PIP_NO_CACHE_DIR": "1"}
    done = bare(clone, "-m", "mistyle", "demo", HTTP_PROXY=nowhere, HTTPS_PROXY=nowhere, **quick)
    assert done.returncode == 4, done.stderr
    assert "Traceback" not in done.stderr
    assert "pip cannot reach its package registry" in done.stderr.splitlines()[-1]
    assert done.stderr.startswith("mistyle: setting up")
    assert not done.stdout


def test_doctor_reports_even_when_the_set_up_fails(clone, tmp_path):
    (clone / ".venv").write_text("in the way")
    done = bare(clone, "-m", "mistyle", "doctor", "--json")
    assert done.returncode == 4
    report = json.loads(done.stdout)
    assert not report["works"]
    assert {"packages", "torch"} <= {row["name"] for row in report["rows"] if row["state"] == "missing"}


def test_older_pythons_get_a_sentence(clone):
    """The version check stands before anything that an older Python cannot read."""
    code = textwrap.dedent("""
        import sys, runpy
        sys.version_info = (3, 8, 10)
        sys.path.insert(0, ".")
        runpy.run_module("mistyle", run_name="__main__")
    """)
    done = bare(clone, "-c", code, PATH="/nowhere")
    assert done.returncode == 4
    assert "3.11 or newer" in done.stderr and "3.8" in done.stderr


def test_older_pythons_can_import_the_package_to_get_that_sentence():
    """Below 3.10 an annotation like `str | None` fails when it is evaluated; the future import leaves it alone."""
    for name in ("__init__.py", "__main__.py"):
        tree = ast.parse((ROOT / "mistyle" / name).read_text(encoding="utf-8"), feature_version=(3, 7))
        futures = [node for node in tree.body if isinstance(node, ast.ImportFrom) and node.module == "__future__"]
        annotated = [node for node in ast.walk(tree) if isinstance(node, (ast.arg, ast.AnnAssign)) and node.annotation]
        assert futures or not annotated, f"mistyle/{name} needs `from __future__ import annotations`"


def test_every_dependency_has_an_exact_pin_in_its_range():
    import tomllib

    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    lines = re.findall(r"^[^#\s].*$", (ROOT / "mistyle/constraints.txt").read_text(encoding="utf-8"), re.MULTILINE)
    pins = {re.sub(r"[-_.]+", "-", name).lower(): version for name, version in (line.split("==") for line in lines)}
    wanted = [*project["dependencies"], *(r for extra in project["optional-dependencies"].values() for r in extra)]
    for requirement in map(Requirement, wanted):
        assert pins[re.sub(r"[-_.]+", "-", requirement.name).lower()] in requirement.specifier, requirement
    assert "+" not in pins["torch"]


def test_ci_refuses_skips_that_are_not_on_the_list(monkeypatch):
    monkeypatch.setattr(conftest, "skipped", [("a", "no time"), ("b", f"{conftest.NO_DATA}: bunny.obj")])
    monkeypatch.setenv("CI", "true")
    assert conftest.refused() == [("a", "no time")]
    monkeypatch.delenv("CI")
    assert not conftest.refused()
