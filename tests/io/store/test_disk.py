"""Full disks, missing rights, files that vanish: one sentence, the right exit code, nothing half-written, and what was
finished before stays."""

import argparse
import errno
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from mistyle.batch import engines
from mistyle.batch.pipeline import Choices, planned, summarise
from mistyle.cli import exits
from mistyle.cli.main import main
from mistyle.core.errors import InputRefused, MistyleError, UsageError
from mistyle.core.paths import PACKAGE, scenes
from mistyle.io.images.write import write_png
from mistyle.io.store import atomic, output
from mistyle.io.store.atomic import atomic_folder, atomic_write
from mistyle.io.store.keeper import Keeper
from mistyle.process import disk_errors

ROOT = Path(__file__).parents[3]


def names(folder: Path) -> list[str]:
    return sorted(p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.name != atomic.LOCK)


def text(content: str):
    def write(folder: Path) -> None:
        (folder / "a.txt").write_text(content)

    return write


def fails(code: int, where: str = ""):
    """A writer that the system stops with this error."""

    def write(folder: Path) -> None:
        (folder / "half.bin").write_bytes(b"half")
        raise OSError(code, os.strerror(code), str(folder / where) if where else None)

    return write


@pytest.mark.parametrize(
    ("code", "where", "kind", "words"),
    [
        (errno.ENOSPC, "", MistyleError, "disk is full.*Free some space"),
        (errno.EDQUOT, "x", MistyleError, "disk is full"),
        (errno.EFBIG, "", MistyleError, "exceeded the allowed size.*ulimit"),
        (errno.EROFS, "x", UsageError, "cannot be written.*Choose another output folder"),
        (errno.EACCES, "x", UsageError, "cannot be written"),
        (errno.EIO, "x", MistyleError, "the disk, or the connection to it, failed"),
        (errno.EEXIST, "x", UsageError, "in the way"),
    ],
)
def test_every_trouble_with_a_disk_is_a_sentence_and_leaves_nothing(tmp_path, code, where, kind, words):
    with Keeper(tmp_path / "run") as keeper:
        keeper.put("fit", "k", text("kept"))
        before = names(tmp_path)
        with pytest.raises(kind, match=words) as told:
            keeper.put("fit", "k2", fails(code, where))
        assert ".tmp-" not in str(told.value), "the place is named as the user knows it"
        assert keeper.get("fit", "k") is not None and names(tmp_path) == before


def test_what_is_no_trouble_with_the_disk_passes_through(tmp_path):
    """An input that vanished, a library's own failure, a mistake of ours: none of them is blamed on the disk."""
    for error in (FileNotFoundError(errno.ENOENT, "gone", "/elsewhere/input.png"), RuntimeError("odd"), OSError("odd")):

        def write(folder: Path, error=error) -> None:
            raise error

        with pytest.raises(type(error)) as told:
            atomic_folder(tmp_path / "out", write)
        assert told.value is error and names(tmp_path) == []


LIMITED = """
import json, resource, sys
import numpy as np
from pathlib import Path
from mistyle.core.errors import MistyleError
from mistyle.io.images.write import write_exr, write_png
from mistyle.io.store.records import save_record
from mistyle.io.store.keeper import Keeper
from mistyle.io.store.atomic import atomic_write
root = Path(sys.argv[1])
noise = np.random.default_rng(0).random((200, 200)).astype(np.float32)
writers = {
    "record": lambda f: save_record(f / "record", {"table": noise}),
    "exr": lambda f: write_exr(f / "a.exr", {"Y": noise}),
    "png": lambda f: write_png(f / "a.png", noise, bits=16),
    "array": lambda f: atomic_write(f / "a.npy", lambda path: np.save(path, noise)),
}
said = {}
with Keeper(root) as keeper:
    for name, write in writers.items():
        keeper.put(name, "old", write)
    resource.setrlimit(resource.RLIMIT_FSIZE, (20000, 20000))
    for name, write in writers.items():
        try:
            keeper.put(name, "new", write)
        except MistyleError as error:
            said[name] = str(error)
print(json.dumps(said))
"""


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no limit on the size of a file")
def test_writers_that_hide_the_reason_are_asked_again(tmp_path):
    """A real limit: NumPy says "N requested and M written" without the system's number; the sentence names it."""
    done = subprocess.run(
        [sys.executable, "-B", "-c", LIMITED, str(tmp_path)], cwd=ROOT, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    said = json.loads(done.stdout)
    assert set(said) == {"record", "exr", "png", "array"}
    assert all("ulimit -f" in text and ".tmp-" not in text for text in said.values()), said
    with Keeper(tmp_path) as keeper:
        assert all(keeper.get(name, "old") is not None for name in said)
        assert not [p for p in tmp_path.rglob(".*") if p.name not in (atomic.LOCK, output.RECORD)]


FORBIDDEN = """
import os, sys
from pathlib import Path
from mistyle.core.errors import MistyleError
from mistyle.io.store.keeper import Keeper
from mistyle.io.store.atomic import atomic_folder, atomic_write
place = Path(sys.argv[1])
if os.getuid() == 0:
    os.setgroups([]); os.setgid(65534); os.setuid(65534)
for attempt in (
    lambda: atomic_write(place / "a.txt", b"x"),
    lambda: atomic_write(place / "new" / "a.txt", b"x"),
    lambda: atomic_folder(place / "out", lambda folder: None),
    lambda: Keeper(place),
    lambda: Keeper(place / "run"),
):
    try:
        attempt()
    except MistyleError as error:
        print(error.exit_code, error)
"""


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has other rights")
def test_a_folder_without_the_right_to_write_is_refused(tmp_path):
    place = tmp_path / "theirs"
    place.mkdir(mode=0o555)
    for folder in (tmp_path, *tmp_path.parents):
        if folder.stat().st_uid == os.getuid() and folder != Path(folder.anchor) and "pytest" in folder.name:
            folder.chmod(folder.stat().st_mode | 0o011)
    done = subprocess.run([sys.executable, "-c", FORBIDDEN, str(place)], cwd=ROOT, capture_output=True, text=True)
    lines = done.stdout.splitlines()
    assert len(lines) == 5, done.stderr
    assert all(line.startswith("2 ") and "cannot be written (Permission denied)" in line for line in lines), lines
    assert names(place) == []


def test_compare_keeps_the_earlier_page_when_the_disk_fills(tmp_path, capsys):
    picture, out = str(tmp_path / "small.png"), tmp_path / "out"
    write_png(tmp_path / "small.png", np.random.default_rng(0).random((32, 32, 3)).astype(np.float32))
    assert main(["compare", picture, picture, "-o", str(out), "--metrics", "psnr"]) == 0
    before = {name: (out / name).read_bytes() for name in names(out) if (out / name).is_file()}
    code = (
        "import resource, sys; resource.setrlimit(resource.RLIMIT_FSIZE, (3000, 3000));"
        "from mistyle.cli.main import main; sys.exit(main(sys.argv[1:]))"
    )
    line = [sys.executable, "-B", "-c", code, "compare", picture, picture, "-o", str(out), "--metrics", "psnr"]
    done = subprocess.run(line, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 1 and "exceeded the allowed size" in done.stderr and "Traceback" not in done.stderr, (
        done.stderr
    )
    assert {name: (out / name).read_bytes() for name in names(out) if (out / name).is_file()} == before
    assert sorted(p.name for p in tmp_path.iterdir()) == ["out", "small.png"]


def ends(error: Exception, capsys) -> tuple[int, str]:
    """Exit code and sentence of a command that meets this error."""

    def command(options: argparse.Namespace) -> int:
        raise error

    return exits.run(command, argparse.Namespace()), capsys.readouterr().err


def test_an_input_that_vanished_is_a_sentence_and_a_mistake_of_ours_is_not(tmp_path, capsys):
    gone = tmp_path / "gone.png"
    code, words = ends(FileNotFoundError(errno.ENOENT, "No such file", str(gone)), capsys)
    assert code == 3 and f"{gone}: found nothing; it was removed or renamed" in words
    code, words = ends(PermissionError(errno.EACCES, "Permission denied", str(gone)), capsys)
    assert code == 3 and "cannot be opened" in words
    code, words = ends(OSError(errno.ENOSPC, "No space left"), capsys)
    assert code == 1 and "disk is full" in words
    code, words = ends(OSError("2446080 requested and 718 written"), capsys)
    assert code == 1 and "TMPDIR" in words
    with pytest.raises(FileNotFoundError):
        ends(FileNotFoundError(errno.ENOENT, "No such file", str(PACKAGE / "jobs" / "lost.j2")), capsys)
    assert isinstance(disk_errors.unexpected(OSError(errno.ENOENT, "x", str(gone))), InputRefused)


def test_a_shard_that_cannot_be_started_does_not_stop_the_batch(tmp_path, monkeypatch):
    mesh = tmp_path / "cube.obj"
    mesh.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    jobs = tmp_path / "jobs.toml"
    jobs.write_text(f'[[grid]]\nmeshes = ["cube.obj"]\nstyles = ["{(scenes() / "demo_style.png").as_posix()}"]\n'
                    "variants = [{ seed = 0 }, { seed = 1 }]\n")  # fmt: skip
    plan = planned(jobs, tmp_path / "out", Choices(threads=1))
    monkeypatch.setattr(engines, "command", lambda plan, index, maps=(): [sys.executable, "-c", "pass"])
    engines.log_of(plan, 0).mkdir(parents=True)  # its log cannot be opened
    ended = {e.index: e for e in engines.local(plan, range(2), 1, lambda k, e: None)}
    assert ended[1].code == 0 and ended[0].code == 1 and "could not be started" in ended[0].why
    assert "could not be started" in summarise(plan, ended, 1.0, 0)["rows"][0]["error"]


def test_fetching_models_names_the_full_disk_and_not_the_network(tmp_path, monkeypatch, capsys):
    from mistyle.stylization.models import fetch as models_fetch

    def full(model, revision, place, known) -> dict[str, str]:
        (place / models_fetch.PARTIAL).mkdir(parents=True)
        (place / models_fetch.PARTIAL / "part").write_bytes(b"so far")
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(models_fetch, "_download", full)
    assert main(["models", "fetch", "depth", "--models", str(tmp_path / "models"), "--allow-download"]) == 1
    words = capsys.readouterr().err
    assert "No space left" in words and "rerun to resume" in words and "network" not in words
    assert (tmp_path / "models" / "depth" / models_fetch.PARTIAL / "part").read_bytes() == b"so far"


def test_a_single_file_that_cannot_be_written_stays_as_it_was(tmp_path):
    atomic_write(tmp_path / "a.npy", lambda path: np.save(path, np.zeros(3)))
    before = (tmp_path / "a.npy").read_bytes()
    with pytest.raises(MistyleError, match=r"a\.npy: the disk is full"):
        atomic_write(tmp_path / "a.npy", lambda path: (_ for _ in ()).throw(OSError(errno.ENOSPC, "full")))
    assert (tmp_path / "a.npy").read_bytes() == before and names(tmp_path) == ["a.npy"]
