"""Finding, trying and fetching an LLVM. The system's own libraries are stand-ins here; one real probe runs."""

import os
import platform
import sys
from pathlib import Path

import pytest

from mistyle.setup import environment, llvm
from tests.setup.test_install import program

# A system that lacks libllvm and libatomic1, as apt-get describes it.
APT = """
echo "$@" >> {log}
case "$*" in
*update*) touch {lists}/fresh ;;
*print-uris*)
  case "$*" in
  *libllvm19*)
    if [ {fresh_only} = 1 ] && ! [ -e {lists}/fresh ]; then exit 100; fi
    echo "'http://d/a' libllvm19_1%3a19.1.7-3~deb12u1_amd64.deb 25913856 SHA256:0"
    echo "'http://d/b' libatomic1_12.2.0-14_amd64.deb 9000 SHA256:0"
    echo "'http://d/c' libc6_2.36-9_amd64.deb 9000 SHA256:0" ;;
  *) exit 100 ;;
  esac ;;
*download*) touch libllvm19.deb libatomic1.deb ;;
esac
"""
DPKG = """
mkdir -p "$3/usr/lib/x86_64-linux-gnu"
case "$2" in *llvm19*) touch "$3/usr/lib/x86_64-linux-gnu/libLLVM.so.19.1" ;; esac
"""


@pytest.fixture
def private(tmp_path: Path) -> Path:
    """Where the set-up keeps a fetched LLVM; has one."""
    folder = tmp_path / "home/llvm/usr/lib/x86_64-linux-gnu"
    folder.mkdir(parents=True)
    (folder / "libLLVM.so.19.1").touch()
    (folder / "libLLVM-19.so").symlink_to("libLLVM.so.19.1")
    return tmp_path / "home"


@pytest.fixture
def system(tmp_path: Path) -> str:
    """A pattern that finds the system's libraries: 14, 15 and 21, the last under two names."""
    for name in ("libLLVM-14.so.1", "libLLVM-15.so.1", "libLLVM.so.21.1"):
        (tmp_path / name).touch()
    (tmp_path / "libLLVM-21.so").symlink_to("libLLVM.so.21.1")
    return f"{tmp_path}/libLLVM*.so*"


def test_the_installed_llvm_draws_a_pixel_and_garbage_does_not(tmp_path):
    record = environment.read_record(environment.home()).get("llvm") or {"variant": "llvm_ad_rgb", "folders": []}
    library = os.environ.get("DRJIT_LIBLLVM_PATH", record.get("library", ""))
    answer = llvm.probe(sys.executable, llvm.Variant(record["variant"], library, tuple(record["folders"])))
    assert answer.works, answer.why
    if not library:
        return
    assert int(answer.version.split(".")[0]) >= 17
    garbage = tmp_path / "libLLVM.so.19.1"
    garbage.write_bytes(b"no library")
    answer = llvm.probe(sys.executable, llvm.Variant("llvm_ad_rgb", str(garbage)))
    assert not answer.works
    assert answer.why


@pytest.mark.parametrize(
    ("script", "why"),
    [
        ("echo 'LLVM ERROR: Cannot select: f32 = fminimum' >&2; kill -ABRT $$", "LLVM ERROR: Cannot select"),
        ("exit 3", "code 3"),
        ("echo pixel wrong", "pixel wrong"),
        ("exec sleep 60", "no answer in 0.5 s"),
    ],
)
def test_a_probe_survives_what_the_library_does(tmp_path, script, why):
    answer = llvm.probe(str(program(tmp_path / "python", script)), llvm.Variant("llvm_ad_rgb", "/x"), timeout=0.5)
    assert not answer.works
    assert why in answer.why


def test_a_probe_is_told_the_library_and_has_a_kernel_cache_of_its_own(tmp_path, monkeypatch):
    """With a shared cache a kernel that another LLVM compiled would be loaded, and this one never tried."""
    monkeypatch.setenv("DRJIT_CACHE_DIR", "/shared")
    script = '[ "$DRJIT_CACHE_DIR" != /shared ] && echo pixel good "$DRJIT_LIBLLVM_PATH:$LD_LIBRARY_PATH"'
    found = llvm.Variant("llvm_ad_rgb", "/l/libLLVM.so", ("/l",))
    monkeypatch.delenv("LD_LIBRARY_PATH", raising=False)
    answer = llvm.probe(str(program(tmp_path / "python", script)), found)
    assert answer == llvm.Answer(True, "/l/libLLVM.so:/l")


def test_candidates_asked_first_then_private_then_newest(private, system, tmp_path):
    names = [path.name for path in llvm.candidates(private, None, (system,))]
    assert names == ["libLLVM.so.19.1", "libLLVM.so.21.1", "libLLVM-15.so.1", "libLLVM-14.so.1"]
    asked = str(tmp_path / "libLLVM-15.so.1")
    assert str(llvm.candidates(private, asked, (system,))[0]) == asked
    assert llvm.candidates(tmp_path, "/nowhere/libLLVM.so", ()) == []


def test_every_candidate_is_tried_until_one_works(private, monkeypatch, tmp_path):
    libraries = [tmp_path / "a", tmp_path / "b", tmp_path / "c"]
    tried = []

    def probe(python: str, found: llvm.Variant, timeout: float = 0) -> llvm.Answer:
        tried.append((found.library, bool(found.folders)))
        works = found.library.endswith("b") and bool(found.folders)
        return llvm.Answer(works, "19.1.7" if works else "", "LLVM ERROR: Cannot select")

    monkeypatch.setattr(llvm, "probe", probe)
    monkeypatch.setattr(llvm, "candidates", lambda *_: libraries)
    monkeypatch.setattr(llvm, "has_gpu", lambda: False)
    said: list[str] = []
    found = llvm.find("python", private, said.append)
    assert found and found.library == str(tmp_path / "b") and found.version == "19.1.7"
    assert [Path(library).name for library, _ in tried] == ["a", "a", "b", "b"]
    assert len(said) == 1 and "Cannot select" in said[0]


def test_a_gpu_that_answers_needs_no_llvm(private, monkeypatch):
    monkeypatch.setattr(llvm, "has_gpu", lambda: True)
    monkeypatch.setattr(llvm, "probe", lambda *_: llvm.Answer(True))
    found = llvm.find("python", private, print)
    assert found and found.library == "" and found.variant in ("cuda_ad_rgb", "metal_ad_rgb")


@pytest.mark.parametrize("stale", [False, True])
def test_fetched_privately_without_touching_the_system(tmp_path, monkeypatch, stale):
    """apt-get is asked what this system lacks; where its lists are missing, private ones are made."""
    home, log = tmp_path / "home", tmp_path / "log"
    home.mkdir()
    script = APT.format(log=log, lists=home / "apt/lists", fresh_only=int(stale))
    program(tmp_path / "bin/apt-get", script)
    program(tmp_path / "bin/dpkg-deb", DPKG)
    monkeypatch.setenv("PATH", f"{tmp_path / 'bin'}:{os.environ['PATH']}")
    assert llvm.fetch(home, print)
    assert [path.name for path in llvm.candidates(home, None, ())] == ["libLLVM.so.19.1"]
    assert sorted(path.name for path in home.iterdir()) == ["llvm"]
    calls = log.read_text().splitlines()
    download = next(line for line in calls if " download " in line)
    assert "libllvm19=1:19.1.7-3~deb12u1 libatomic1=12.2.0-14" in download
    assert "libc6" not in download, "a second C library beside the system's crashes everything"
    updates = [line for line in calls if "update" in line]
    assert len(updates) == stale
    assert all(f"Dir::State::lists={home / 'apt/lists'}" in line for line in updates)


def test_nothing_is_fetched_where_it_cannot_be(tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    assert not llvm.fetch(tmp_path, print)
    program(tmp_path / "apt-get", "exit 100")
    program(tmp_path / "dpkg-deb", "exit 0")
    assert not llvm.fetch(tmp_path, print)


@pytest.mark.parametrize(
    ("system", "release", "words"),
    [
        ("linux", {"ID": "debian"}, "apt-get install -y libllvm19 libatomic1"),
        ("linux", {"ID": "pop", "ID_LIKE": "ubuntu debian"}, "apt-get install -y libllvm19 libatomic1"),
        ("linux", {"ID": "fedora"}, "dnf install -y llvm-libs libatomic"),
        ("linux", {"ID": "arch"}, "pacman -S --needed llvm-libs"),
        ("linux", {"ID": "opensuse-leap", "ID_LIKE": "suse opensuse"}, "zypper install"),
        ("linux", {}, "DRJIT_LIBLLVM_PATH"),
        ("darwin", {}, "brew install llvm"),
        ("win32", {}, "winget install LLVM.LLVM"),
    ],
)
def test_the_command_for_each_system(monkeypatch, system, release, words):
    monkeypatch.setattr(sys, "platform", system)
    monkeypatch.setattr(platform, "freedesktop_os_release", lambda: release)
    monkeypatch.setenv("PATH", "/nowhere")
    assert words in llvm.command()
