"""The store by what it promises: whole files, hashes that hold, one run at a time, nothing left of a killed run."""

import dataclasses
import errno
import hashlib
import json
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from pydantic import BaseModel

from mistyle.core.errors import MistyleError, UsageError
from mistyle.io.store import atomic, lock, output
from mistyle.io.store.atomic import atomic_folder, atomic_write, digest, sha256_file
from mistyle.io.store.keeper import Keeper
from mistyle.jobs import checkpoint
from mistyle.process import disk_errors

ROOT = Path(__file__).parents[3]


def names(folder: Path) -> list[str]:
    return sorted(p.name for p in folder.iterdir() if p.name not in (atomic.LOCK, output.RECORD))


def text(content: str):
    return lambda folder: (folder / "a.txt").write_text(content)


def dead_pid() -> int:
    child = subprocess.Popen([sys.executable, "-c", ""])
    child.wait()
    return child.pid


# --- single files ---


def test_atomic_write_takes_bytes_and_writers(tmp_path):
    atomic_write(tmp_path / "new" / "a.bin", b"one")
    assert (tmp_path / "new" / "a.bin").read_bytes() == b"one"
    atomic_write(tmp_path / "new" / "a.bin", lambda p: p.write_text(p.suffix))
    assert (tmp_path / "new" / "a.bin").read_text() == ".bin"
    assert names(tmp_path / "new") == ["a.bin"]
    assert sha256_file(tmp_path / "new" / "a.bin") == hashlib.sha256(b".bin").hexdigest()


def test_failed_write_keeps_the_old_file(tmp_path):
    atomic_write(tmp_path / "a.txt", b"old")

    def fails(path: Path) -> None:
        path.write_text("half")
        raise RuntimeError("stop")

    with pytest.raises(RuntimeError, match="stop"):
        atomic_write(tmp_path / "a.txt", fails)
    assert (tmp_path / "a.txt").read_bytes() == b"old" and names(tmp_path) == ["a.txt"]


def full_disk(path: Path) -> None:
    target = path / "x.bin" if path.is_dir() else path
    target.write_bytes(b"half")
    raise OSError(errno.ENOSPC, "No space left on device")


def test_full_disk_is_a_sentence_and_leaves_nothing(tmp_path):
    with pytest.raises(MistyleError, match="disk is full.*Free some space"):
        atomic_write(tmp_path / "a.txt", full_disk)
    with Keeper(tmp_path / "run") as keeper:
        keeper.put("fit", "k", text("kept"))
        with pytest.raises(MistyleError, match="disk is full"):
            keeper.put("fit", "k2", full_disk)
        assert keeper.get("fit", "k") is not None
        assert names(tmp_path) == ["run"] and names(tmp_path / "run") == ["fit"]


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="/dev/full is a Linux device")
def test_real_full_device():
    with pytest.raises(MistyleError, match="disk is full"):
        with disk_errors.translated(Path("x")), open("/dev/full", "wb") as file:
            file.write(b"x" * 100_000)


# --- folders of stages ---


def test_put_then_get(tmp_path):
    with Keeper(tmp_path) as keeper:
        assert keeper.get("bake", "k") is None
        folder = keeper.put("bake", "k", lambda f: (f / "deep").mkdir() or (f / "deep" / "b").write_text("x"))
        assert folder == tmp_path / "bake" == keeper.get("bake", "k")
        assert json.loads((folder / "done.json").read_text())["files"] == {"deep/b": hashlib.sha256(b"x").hexdigest()}
        assert keeper.get("bake", "other") is None and folder.exists(), "another key leaves the folder alone"


@pytest.mark.parametrize("damage", ["changed", "missing", "no_marker", "cut_marker", "odd_marker", "deep_marker"])
def test_broken_stage_is_set_aside_not_deleted(tmp_path, damage):
    with Keeper(tmp_path) as keeper:
        for round_ in (1, 2):
            folder = keeper.put("bake", "k", text("content"))
            marker, file = folder / "done.json", folder / "a.txt"
            contents = {"changed": b"Content", "cut_marker": marker.read_bytes()[:30], "odd_marker": b"[1]"}
            contents["deep_marker"] = b"[" * 100_000
            if damage in contents:
                (file if damage == "changed" else marker).write_bytes(contents[damage])
            else:
                (file if damage == "missing" else marker).unlink()
            assert keeper.get("bake", "k") is None
            assert (tmp_path / f"bake.broken-{round_}").is_dir() and not folder.exists()


def test_older_result_stays_until_the_new_one_is_complete(tmp_path):
    with Keeper(tmp_path) as keeper:
        keeper.put("fit", "old", text("old"))

        def write(folder: Path) -> None:
            assert keeper.get("fit", "old") is not None
            (folder / "b.txt").write_text("new")

        keeper.put("fit", "new", write)
        assert names(tmp_path / "fit") == ["b.txt", "done.json"] and names(tmp_path) == ["fit"]

        with pytest.raises(RuntimeError):
            keeper.put("fit", "newer", lambda f: (_ for _ in ()).throw(RuntimeError()))
        assert keeper.get("fit", "new") is not None and names(tmp_path) == ["fit"]


def test_what_a_user_did_in_a_stage_is_not_lost(tmp_path):
    with Keeper(tmp_path) as keeper:
        folder = keeper.put("asset", "1", lambda f: (text("one")(f), (f / "gone.txt").write_text("ours")))
        (folder / "notes").mkdir()
        (folder / "notes" / "mine.txt").write_text("mine")
        assert keeper.get("asset", "1") is not None, "a foreign file does no harm"
        keeper.put("asset", "2", text("two"))
        assert (folder / "notes" / "mine.txt").read_text() == "mine" and not (folder / "gone.txt").exists()
        assert keeper.get("asset", "2") is not None and (folder / "a.txt").read_text() == "two"

        (folder / "a.txt").write_text("retouched by hand")
        keeper.put("asset", "3", text("three"))
        assert (tmp_path / "asset.broken-1" / "a.txt").read_text() == "retouched by hand"
        assert names(folder) == ["a.txt", "done.json", "notes"], "what is not ours stays in its place"


def test_a_linked_folder_stays_linked(tmp_path):
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "asset").symlink_to(tmp_path / "elsewhere")
    for content in ("one", "two"):
        atomic_folder(tmp_path / "asset", text(content))
        assert (tmp_path / "elsewhere" / "a.txt").read_text() == content and (tmp_path / "asset").is_symlink()
    assert names(tmp_path) == ["asset", "elsewhere"]


def test_stage_names_cannot_leave_the_folder(tmp_path):
    with Keeper(tmp_path) as keeper, pytest.raises(ValueError, match="not a valid stage name"):
        keeper.put("../x", "k", text(""))


@pytest.mark.parametrize("moment", ["writing", "swapping"])
def test_killed_run_leaves_nothing(tmp_path, moment):
    """kill -9 while a stage is written, and between the two renames of the swap (then the new result is complete)."""
    code = f"""
import os, signal
from pathlib import Path
from mistyle.io.store.keeper import Keeper
keeper = Keeper(Path({str(tmp_path)!r}))
keeper.put("bake", "old", lambda f: (f / "a").write_text("old"))
def write(f):
    (f / "a").write_text("new")
    if {moment == "writing"}:
        os.kill(os.getpid(), signal.SIGKILL)
rename = os.rename
def rename_then_die(a, b):
    rename(a, b)
    os.kill(os.getpid(), signal.SIGKILL)
if {moment == "swapping"}:
    os.rename = rename_then_die
keeper.put("bake", "new", write)
"""
    child = subprocess.run([sys.executable, "-c", code], cwd=Path(__file__).parents[3])
    assert child.returncode == -9 and len(names(tmp_path)) == 2
    with Keeper(tmp_path) as keeper:
        assert names(tmp_path) == ["bake"]
        assert keeper.get("bake", "old" if moment == "writing" else "new") is not None


def test_leftovers_of_living_and_foreign_runs_stay(tmp_path):
    host, dead = lock.this_host(), dead_pid()
    for tag in (f"{host}-{os.getppid()}-0", f"elsewhere-{dead}-0", f"{host}-{dead}-0"):
        (tmp_path / f".asset.tmp-{tag}").mkdir()
    (tmp_path / ".asset.mine").touch()
    atomic_folder(tmp_path / "asset", text("x"))
    left = [f".asset.tmp-{host}-{os.getppid()}-0", f".asset.tmp-elsewhere-{dead}-0", ".asset.mine", "asset"]
    assert names(tmp_path) == sorted(left)
    Keeper(tmp_path).close()
    assert names(tmp_path) == [".asset.mine", "asset"], "the holder of the lock clears all of them"


# --- the lock ---


def test_second_run_is_refused_and_the_lock_goes(tmp_path):
    keeper = Keeper(tmp_path)
    with pytest.raises(UsageError, match=f"process {os.getpid()} has been working in this folder"):
        Keeper(tmp_path)
    keeper.close()
    keeper.close()
    second = Keeper(tmp_path)
    del second
    assert not (tmp_path / atomic.LOCK).exists(), "a forgotten keeper releases its lock"


def lock_of(path: Path, **changes: object) -> None:
    parent = os.getppid()
    owner = {"pid": parent, "host": lock.this_host(), "started": lock.started_at(parent), "time": 0.0}
    (path / atomic.LOCK).write_text(json.dumps(owner | changes))


def test_lock_of_a_living_process_another_host_and_the_dead(tmp_path):
    lock_of(tmp_path)
    with pytest.raises(UsageError, match=str(os.getppid())):
        Keeper(tmp_path)
    lock_of(tmp_path, host="elsewhere")
    with pytest.raises(UsageError, match=r"computer 'elsewhere'.*remove .*\.mistyle\.lock"):
        Keeper(tmp_path)
    lock_of(tmp_path, pid=dead_pid())
    Keeper(tmp_path).close()
    assert names(tmp_path) == []


HOLDS = """
import sys, time
from pathlib import Path
from mistyle.io.store.keeper import Keeper
keeper = Keeper(Path(sys.argv[1]))
print("holds", flush=True)
time.sleep(60)
"""


def test_a_living_holder_is_known_from_another_container_and_a_killed_one_gives_way_at_once(tmp_path):
    """Another host's name and another process's number on the same kernel: the kernel's own lock decides."""
    child = subprocess.Popen([sys.executable, "-c", HOLDS, str(tmp_path)], cwd=ROOT, stdout=subprocess.PIPE)
    assert child.stdout is not None and child.stdout.readline() == b"holds\n"
    owner = json.loads((tmp_path / atomic.LOCK).read_text())
    assert owner["flock"]
    with open(tmp_path / atomic.LOCK, "r+") as file:  # in place: the file that the child has locked
        file.write(json.dumps(owner | {"host": "elsewhere", "pid": dead_pid()}))
        file.truncate()
    assert lock.busy(tmp_path / atomic.LOCK)
    with pytest.raises(UsageError, match="has been working in this folder"):
        Keeper(tmp_path)
    child.kill()  # and not yet collected: a zombie holds nothing
    until = time.monotonic() + 5
    while lock.busy(tmp_path / atomic.LOCK) and time.monotonic() < until:
        time.sleep(0.02)
    Keeper(tmp_path).close()
    child.wait()
    assert names(tmp_path) == []


def test_a_zombie_is_not_alive():
    child = subprocess.Popen([sys.executable, "-c", ""])
    until = time.monotonic() + 5
    while lock.alive(child.pid) and time.monotonic() < until:
        time.sleep(0.02)
    assert child.returncode is None and not lock.alive(child.pid)
    child.wait()


TAKES = """
import sys
from pathlib import Path
from mistyle.core.errors import UsageError
from mistyle.io.store.keeper import Keeper
root, mark = Path(sys.argv[1]), Path(sys.argv[2])
for turn in range(60):
    try:
        with Keeper(root):
            mark.mkdir()  # fails where another is inside
            mark.rmdir()
    except UsageError:
        pass
"""


def test_a_dead_lock_is_taken_over_by_one_only(tmp_path):
    """Four processes that take the folder again and again, a dead lock in it each time it is free."""
    root, mark = tmp_path / "run", tmp_path / "inside"
    root.mkdir()
    line = [sys.executable, "-c", TAKES, str(root), str(mark)]
    children = [subprocess.Popen(line, cwd=ROOT, stderr=subprocess.PIPE, text=True) for _ in range(4)]
    dead = dead_pid()
    while any(child.poll() is None for child in children):
        if not (root / atomic.LOCK).exists():
            lock_of(tmp_path, pid=dead)
            try:
                os.link(tmp_path / atomic.LOCK, root / atomic.LOCK)
            except FileExistsError:
                pass
        time.sleep(0.001)
    for child in children:
        assert child.communicate()[1] == "" and child.returncode == 0


REPLACES = """
import sys
from pathlib import Path
from mistyle.core.errors import UsageError
from mistyle.io.store.atomic import atomic_folder
name, target = sys.argv[1], Path(sys.argv[2])
def write(folder):
    for k in range(3):
        (folder / f"{k}.txt").write_text(name)
for turn in range(100):
    try:
        atomic_folder(target, write)
    except UsageError as error:
        assert "another run is in the way" in str(error)
"""


def test_two_that_replace_one_folder_never_mix(tmp_path):
    line = [sys.executable, "-c", REPLACES]
    children = [
        subprocess.Popen([*line, name, str(tmp_path / "out")], cwd=ROOT, stderr=subprocess.PIPE, text=True)
        for name in "ab"
    ]
    for child in children:
        assert child.communicate()[1] == "" and child.returncode == 0
    assert len({p.read_text() for p in (tmp_path / "out").iterdir()}) == 1
    assert len(list((tmp_path / "out").iterdir())) == 3
    atomic_folder(tmp_path / "out", text("alone"))
    assert names(tmp_path) == ["out"] and names(tmp_path / "out") == ["a.txt"]


def test_a_folder_that_is_taken_away_ends_the_run_and_is_not_made_again(tmp_path):
    root = tmp_path / "run"
    with Keeper(root) as keeper:
        keeper.put("mesh", "k", text("kept"))

        def write(folder: Path) -> None:
            shutil.rmtree(root)
            (folder / "a.txt").write_text("late")

        with pytest.raises(MistyleError, match="removed while it was being written"):
            keeper.put("fit", "k", write)
        assert not root.exists()
        with pytest.raises(MistyleError, match="was removed while a run worked there"):
            keeper.get("mesh", "k")
        with Keeper(root) as second, pytest.raises(MistyleError, match="was removed while a run worked there"):
            second.put("mesh", "k2", text("another run's"))
            keeper.put("mesh", "k", text("mixed"))
        assert (root / "mesh" / "a.txt").read_text() == "another run's"


def test_what_is_set_aside_is_said(tmp_path):
    said: list[str] = []
    with Keeper(tmp_path, said.append) as keeper:
        (keeper.put("mesh", "k", text("whole")) / "a.txt").write_text("torn")
        assert keeper.get("mesh", "k") is None
    assert len(said) == 1 and "set aside as mesh.broken-1" in said[0]


@pytest.mark.parametrize("damage", ["cut", "empty", "gone", "unsealed"])
def test_a_damaged_checkpoint_is_not_taken_up(tmp_path, damage):
    place, said = checkpoint.place(tmp_path, "k" * 64), []
    assert checkpoint.load(place, said.append) is None and not said, "none there yet"
    checkpoint.save(place, {"table": np.arange(100.0), "iteration": np.array(3)})
    loaded = checkpoint.load(place)
    assert loaded is not None and loaded["iteration"] == 3
    array = next(p for p in sorted((place / "record").glob("*.npy")) if p.stat().st_size > 500)
    match damage:
        case "cut":
            array.write_bytes(array.read_bytes()[:300])
        case "empty":
            array.write_bytes(b"")
        case "gone":
            array.unlink()
        case "unsealed":
            (place / atomic.DONE).unlink()
    assert checkpoint.load(place, said.append) is None
    assert len(said) == 1 and "damaged" in said[0]


@pytest.mark.skipif(lock.started_at(os.getpid()) is None, reason="this system does not tell when a process began")
def test_a_process_number_used_again_is_another_process(tmp_path):
    lock_of(tmp_path, started="another boot 1")
    Keeper(tmp_path).close()


def test_a_lock_cut_off_by_a_crash_is_taken_over(tmp_path):
    (tmp_path / atomic.LOCK).write_text('{"pid"')
    past = time.time() - 60
    os.utime(tmp_path / atomic.LOCK, (past, past))
    Keeper(tmp_path).close()


# --- hashes and arrays ---


class Settings(BaseModel):
    size: int = 4
    rate: float = 0.1
    file: Path | None = None


@dataclasses.dataclass(frozen=True)
class Record:
    values: np.ndarray
    name: str


def test_digest_tells_apart_what_differs(tmp_path):
    (tmp_path / "a").write_text("x")
    (tmp_path / "b").write_text("x")
    a = np.arange(6, dtype=np.float32)
    different = [
        Settings(), Settings(size=5), Settings(rate=0.1 + 1e-12), {"size": 4}, {1: 2}, {"1": 2}, [1, 2], {1, 2}, 1, 1.0,
        True, None, "1", b"1", a, a.reshape(2, 3), a.astype(np.float64), a + 1, Record(a, "n"), Record(a, "m"),
        tmp_path / "a", Path("absent"), Settings(file=tmp_path / "a"), tmp_path,
    ]  # fmt: skip
    assert len({digest(x) for x in different}) == len(different)
    assert digest(tmp_path / "a") == digest(tmp_path / "b"), "a file counts by its content"
    assert digest({"x": 1, "y": 2}) == digest({"y": 2, "x": 1})
    assert digest(a[::2]) == digest(a[::2].copy())
    with pytest.raises(TypeError, match="object"):
        digest(object())


def test_digest_is_the_same_in_another_process(tmp_path):
    code = "from mistyle.io.store.atomic import digest; print(digest({'a': {'x', 'y', 'z'}, 'b': 0.1}))"
    for seed in ("1", "2"):
        out = subprocess.run(
            [sys.executable, "-c", code], cwd=Path(__file__).parents[3], env=os.environ | {"PYTHONHASHSEED": seed},
            capture_output=True, text=True, check=True,
        )  # fmt: skip
        assert out.stdout.strip() == digest({"a": {"x", "y", "z"}, "b": 0.1})
