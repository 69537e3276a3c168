"""The rule of output folders, verb by verb: mistyle replaces only files that it wrote itself.

Each verb that writes is run into folders that hold strangers' files and its own inputs, that it wrote before, that were
edited, and that an older version left without a record. What is not mistyle's must stay as it was, bit for bit.
"""

import os
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path

import pytest

from mistyle.batch import engines
from mistyle.cli.main import main
from mistyle.io.store import output
from tests.support.verbs import ATLAS, PAINT, VERBS, line

# What a second call would put in the place of a file that was edited since: refused, or set aside in a run folder.
EDITS = {
    "render": "az000.0_el+15.0.png", "bake": "textures/baked_albedo.png", "stylize": "run.json", "demo": "run.json",
    "fit": "run.json", "fit --scene": "run.json", "batch": "plan.json", "shard": "one/run.json", "farm": "plan.json",
    "compare": "index.html", "converge": "index.html", "export": "square_style.glb", "lookdev": "lookdev.png",
    "verify": "verify.json", "pack": "install.sh", "variations": "variations.png",
}  # fmt: skip
ASIDE = ("stylize", "demo", "fit", "fit --scene", "batch", "shard", "farm")


@pytest.fixture(autouse=True)
def no_network(monkeypatch):
    """A pack without its wheels: what it collects is its own business, where it goes is tested here."""
    from mistyle.batch import pack

    def fill(folder: Path, *_: object) -> None:
        for name in ("install.sh", "constraints.txt", "SHA256SUMS"):
            (folder / name).write_text(name)

    monkeypatch.setattr(pack, "_fill", fill)
    monkeypatch.setattr(pack, "llvm_files", lambda: (Path("lib"), []))


@pytest.fixture
def shards_at_hand(monkeypatch):
    """A batch's shards run here; that they are processes of their own is tested in tests/batch."""

    def run(plan: engines.BatchPlan, todo: Sequence[int], workers: int, watch: engines.Watch, timeout: float | None):
        ended = []
        for index in todo:
            watch(index, None)
            ended.append(engines.Ended(index, main(engines.command(plan, index)[3:]), 1))
            watch(index, ended[-1])
        return ended

    monkeypatch.setattr(engines, "local", run)


def strangers(folder: Path) -> None:
    """Files, folders and links of somebody else's."""
    (folder / "notes" / "empty").mkdir(parents=True)
    (folder / "empty").mkdir()
    for name in ("IMG_0001.JPG", "notes/plan.txt", ".hidden", "木材.txt"):
        (folder / name).write_text(f"mine: {name}")
        os.utime(folder / name, (1_000_000_000, 1_000_000_000))
    (folder / "link").symlink_to("IMG_0001.JPG")
    (folder / "elsewhere").symlink_to(folder.parent, target_is_directory=True)
    (folder / "dangling").symlink_to("nothing")


def everything(folder: Path) -> dict[str, object]:
    """Names, kinds, bytes, times and targets of all that lies in a folder."""
    found: dict[str, object] = {}
    for path in sorted(folder.rglob("*")):
        name, stat = path.relative_to(folder).as_posix(), path.lstat()
        if path.is_symlink():
            found[name] = ("link", os.readlink(path))
        else:
            found[name] = "folder" if path.is_dir() else (path.read_bytes(), stat.st_mtime_ns, stat.st_ino)
    return found


def unchanged(before: dict[str, object], folder: Path) -> None:
    after = everything(folder)
    assert {name: after.get(name) for name in before} == before


def plant(folder: Path, name: str) -> None:
    """A stranger's file of this name, or with '/' at its end a folder that holds one."""
    path = folder / (f"{name}mine.txt" if name.endswith("/") else name)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("mine")


@pytest.mark.parametrize(("verb", "name"), [(v, name) for v in VERBS for name in VERBS[v].covers])
def test_what_is_not_ours_is_refused_before_any_work(verb_inputs, tmp_path, monkeypatch, capsys, verb, name):
    out = tmp_path / "out"
    out.mkdir()
    strangers(out)
    plant(out, name)
    before, words = everything(out), VERBS[verb].words(verb_inputs, out)

    def works(*_: object) -> None:
        raise AssertionError("work began")

    monkeypatch.setattr("mistyle.render.mitsuba.device.use", works)
    assert main(words) == 2
    said = capsys.readouterr().err
    assert name.split("/")[0] in said and "-o" in said and "mistyle: " in said and "Traceback" not in said
    unchanged(before, out)
    # A shard notes for its queue why it failed, in the folder of the batch's own.
    left = everything(out).keys() - before.keys()
    assert not left or verb == "shard" and left == {output.RECORD, "shards", "shards/one.failed.json"}


@pytest.mark.parametrize("verb", ["render", "bake", "stylize", "demo", "fit"])
def test_a_dry_run_refuses_what_the_run_would(verb_inputs, tmp_path, capsys, verb):
    out = tmp_path / "out"
    plant(out, VERBS[verb].covers[0])
    before = everything(out)
    assert main([*VERBS[verb].words(verb_inputs, out), "--dry-run"]) == 2
    assert "mistyle did not" in capsys.readouterr().err and everything(out) == before


@pytest.mark.parametrize("verb", [v for v in VERBS if VERBS[v].older])
def test_a_folder_of_an_older_version_is_refused_with_that_reason(verb_inputs, tmp_path, capsys, verb):
    out = tmp_path / "out"
    for name in VERBS[verb].older:
        plant(out, name)
    (out / "done.json").write_text("{}")
    before = everything(out)
    assert main(VERBS[verb].words(verb_inputs, out)) == 2
    assert "older version" in capsys.readouterr().err and everything(out) == before


@pytest.mark.parametrize("verb", VERBS)
def test_strangers_files_stay_in_every_run(verb_inputs, tmp_path, capsys, shards_at_hand, verb):
    """Into the folder of the inputs, through a link, again, over an edited file, without the record, by force."""
    place = tmp_path / "disk" / "inputs"
    shutil.copytree(verb_inputs, place, symlinks=True)
    strangers(place)
    out = tmp_path / "out"
    out.symlink_to(place, target_is_directory=True)
    inputs = place if verb != "compare" else verb_inputs  # a comparison's own folder is refused, see test_compare.py
    before, words = everything(place), VERBS[verb].words(inputs, out)
    assert main(words) == 0, capsys.readouterr().err
    unchanged(before, place)
    assert out.is_symlink()

    # What it wrote before: only its own files change.
    assert main(words) == 0, capsys.readouterr().err
    unchanged(before, place)

    edited = place / EDITS[verb]
    edited.write_bytes(b"mine")
    capsys.readouterr()
    code, aside = main(words), edited.with_stem(f"{edited.stem}.edited-1")
    if verb in ASIDE:
        # A shard that is done is taken over and writes nothing.
        assert code == 0 and (edited if verb == "shard" else aside).read_bytes() == b"mine"
    else:
        assert code == 2 and edited.read_bytes() == b"mine"
        assert "edited after mistyle wrote it" in capsys.readouterr().err
        assert main([*words, "--overwrite"]) == 0 and edited.read_bytes() != b"mine"
    unchanged(before, place)
    assert not list(place.rglob(".*.tmp-*")) and not list(place.rglob(".*.old-*"))


@pytest.mark.parametrize("verb", ["render", "stylize", "fit --scene", "export"])
def test_force_replaces_colliding_names_and_nothing_else(verb_inputs, tmp_path, capsys, verb):
    out = tmp_path / "out"
    out.mkdir()
    strangers(out)
    before = everything(out)
    for name in VERBS[verb].covers:
        if not name.endswith("/") and "." in name or verb == "stylize":
            plant(out, name if name != "views" else "views/")
    words = VERBS[verb].words(verb_inputs, out)
    assert main(words) == 2
    assert main([*words, "--overwrite"]) == 0, capsys.readouterr().err
    unchanged(before, out)
    if verb == "stylize":
        assert all((out / name / "mine.txt").read_text() == "mine" for name in ("views", "work", "asset", "report"))


def test_an_input_is_never_replaced(verb_inputs, tmp_path, capsys):
    """Also not by force, and also not where mistyle wrote it in an earlier step."""
    out = tmp_path / "out"
    shutil.copytree(verb_inputs / "run", out, symlinks=True)
    glb = out / "asset" / "square_style.glb"
    before = everything(out)
    for more in ([], ["--overwrite"]):
        assert main(line("stylize", glb, verb_inputs / "style.png", "-o", out, *PAINT, *more)) == 2
        assert "this input is in asset/" in capsys.readouterr().err and everything(out) == before
    baked = tmp_path / "baked"
    words = VERBS["bake"].words(verb_inputs, baked)
    assert main(words) == 0
    again = line("bake", baked / "baked.glb", verb_inputs / "shots", "-o", baked, *ATLAS, "--overwrite")
    before = everything(baked)
    assert main(again) == 2 and "would be replaced" in capsys.readouterr().err and everything(baked) == before
    # Its own files of another name go, but not the one that was read.
    assert main([*again, "--name", "other"]) == 0
    unchanged({"baked.glb": before["baked.glb"]}, baked)
    assert not (baked / "baked.json").exists()


def test_approved_pictures_are_replaced_and_others_are_not(verb_inputs, tmp_path, capsys):
    golden = tmp_path / "golden"
    golden.mkdir()
    strangers(golden)
    shutil.copy(verb_inputs / "a.png", golden / "b.tif")
    before = everything(golden)
    words = line("compare", "--baseline", golden, verb_inputs, "--approve", "b")
    assert main(words) == 2 and "no approval wrote this picture" in capsys.readouterr().err
    assert everything(golden) == before
    (golden / "b.tif").unlink()
    assert main(words) == 0 and (golden / "b.png").read_bytes() == (verb_inputs / "b.png").read_bytes()
    unchanged({k: v for k, v in before.items() if k != "b.tif"}, golden)
    assert main(words) == 0
    (golden / "b.png").write_bytes((verb_inputs / "a.png").read_bytes())
    assert main(words) == 2 and main([*words, "--overwrite"]) == 0


def test_models_and_loras_that_were_put_there_by_hand_stay(tmp_path, monkeypatch, capsys):
    import torch
    from safetensors.torch import save_file

    from mistyle.core.errors import UsageError
    from mistyle.stylization.diffusion import lora_files as consislora_make

    place = tmp_path / "models" / "position"
    place.mkdir(parents=True)
    pickle = tmp_path / "position.bin"
    torch.save({"w": torch.zeros(3)}, pickle)
    save_file({"w": torch.ones(3)}, place / "diffusion_pytorch_model.safetensors")
    before = everything(place)
    words = line("models", "convert", "position", pickle, "--models", tmp_path / "models")
    assert main(words) == 2 and "--overwrite" in capsys.readouterr().err and everything(place) == before
    assert main([*words, "--overwrite"]) == 0
    halves = consislora_make.paths(tmp_path, "style", "0123456789abcdef")
    save_file({"w": torch.ones(3)}, halves.style)
    with pytest.raises(UsageError, match="mistyle did not train this LoRA"):
        consislora_make.refuse_unknown([halves])


def test_a_kill_while_files_are_moved_in_leaves_none_unknown(tmp_path, monkeypatch):
    """Between two files the record knows old and new contents: the next call neither refuses nor forgets them."""
    root = tmp_path / "out"
    root.mkdir()
    (root / "mine.txt").write_text("mine")

    def write(text: str) -> Callable[[Path], object]:
        return lambda folder: [(folder / f"{k}.txt").write_text(text) for k in range(4)]

    output.replace_files(root, "verb", write("one"))
    move, moved = output.move, []

    def dies(source: Path, target: Path) -> None:
        if len(moved) == 2:
            raise KeyboardInterrupt
        moved.append(target)
        move(source, target)

    monkeypatch.setattr(output, "move", dies)
    with pytest.raises(KeyboardInterrupt):
        output.replace_files(root, "verb", write("two"))
    assert {p.read_text() for p in root.glob("?.txt")} == {"one", "two"}
    monkeypatch.setattr(output, "move", move)
    output.replace_files(root, "verb", lambda folder: (folder / "0.txt").write_text("three"))
    assert sorted(p.name for p in root.glob("*.txt")) == ["0.txt", "mine.txt"]
    assert output.read_written(root).files.keys() == {"0.txt"}


def test_a_folder_of_ours_alone_is_swapped_and_a_damaged_record_is_named(tmp_path):
    from mistyle.core.errors import UsageError

    root = tmp_path / "out"
    for text in ("one", "two"):
        inode = root.stat().st_ino if root.exists() else 0
        output.replace_files(root, "verb", lambda folder, text=text: (folder / "a.txt").write_text(text))
        assert root.stat().st_ino != inode and (root / "a.txt").read_text() == text
    (root / output.RECORD).write_bytes(b"{")
    with pytest.raises(UsageError, match="the list of what it wrote here, is damaged"):
        output.claim(root, ["a.txt"])
    assert sorted(p.name for p in root.iterdir()) == [output.RECORD, "a.txt"]
