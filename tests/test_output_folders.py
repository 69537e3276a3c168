"""The rule of output folders, verb by verb: mistyle replaces only files that it wrote itself.

Each verb that writes is run into folders that hold strangers' files and its own inputs, that it wrote before, that were
edited, and that an older version left without a record. What is not mistyle's must stay as it was, bit for bit.
"""

import json
import os
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from mistyle.files import output
from mistyle.run.cli import main

SQUARE = """v -1 0 -1
v 1 0 -1
v 1 0.5 1
v -1 0 1
vt 0 0
vt 1 0
vt 1 1
vt 0 1
f 1/1 4/4 3/3 2/2
"""
SCENE = """<scene version="3.0.0"><integrator type="path"><integer name="max_depth" value="2"/></integrator>
<sensor type="perspective" id="front"><float name="fov" value="30"/>
<transform name="to_world"><lookat origin="0,0,3" target="0,0,0" up="0,1,0"/></transform>
<film type="hdrfilm"><integer name="width" value="16"/><integer name="height" value="16"/></film>
<sampler type="independent"><integer name="sample_count" value="1"/></sampler></sensor>
<emitter type="constant"/><shape type="rectangle" id="wall"><bsdf type="diffuse" id="paint">
<rgb name="reflectance" value="0.5,0.4,0.3"/></bsdf></shape></scene>
"""
LIGHTS = {"type": "directional", "direction": [0, 1, 0], "irradiance": [1, 1, 1], "frame": "camera"}


def settings(**values: object) -> list[str]:
    return [word for name, value in values.items() for word in ("--set", f"{name.replace('__', '.')}={value}")]


RIG = settings(rig__kind="turntable", rig__views=2, rig__resolution=32, draw__spp=1)
ATLAS = settings(atlas__size=32, atlas__padding=2)
REPORT = settings(report__frames=4, report__resolution=64, report__spp=1)
PAINT = ["--preset", "draft", *RIG, *ATLAS, *REPORT, *settings(surface__samples=500, fit__refine="off")]
FIT = [
    *ATLAS,
    *REPORT,
    *settings(recover__solver="pictures", recover__iterations=2, recover__bounces=0, recover__joint=0),
]
JOBS = """[[job]]
mesh = "square.obj"
style = "style.png"
name = "one"
"""


@dataclass(frozen=True)
class Verb:
    """A verb that writes.

    words   its command line, given the folder of the inputs and the output folder
    covers  a stranger's files and folders that stand where it writes: each must be refused
    older   what an older version, which kept no record, would have left
    """

    words: Callable[[Path, Path], list[str]]
    covers: tuple[str, ...]
    older: tuple[str, ...]


def line(verb: str, *words: object) -> list[str]:
    return [verb, *map(str, words)]


RUN = ("run.json", "views/", "work/", "asset/", "report/")
VERBS = {
    "render": Verb(
        lambda i, o: line("render", i / "square.obj", "-o", o, *RIG),
        ("transforms.json", "az000.0_el+15.0.png", "camera.json/"),
        ("camera.json", "az000.0_el+15.0.png"),
    ),
    "bake": Verb(
        lambda i, o: line("bake", i / "square.obj", i / "shots", "-o", o, "--name", "baked", *ATLAS),
        ("baked.glb", "baked.json", "textures", "textures/baked_orm.png"),
        ("baked.json", "baked.glb"),
    ),
    "stylize": Verb(
        lambda i, o: line("stylize", i / "square.obj", i / "style.png", "-o", o, *PAINT), (*RUN, "views", "masks/"), RUN
    ),
    "demo": Verb(lambda i, o: line("demo", "-o", o, *PAINT), ("run.json", "stylized/", "work/"), RUN),
    "fit": Verb(
        lambda i, o: line("fit", i / "square.obj", i / "shots", "-o", o, "--lights", i / "lamps.json", *FIT),
        ("run.json", "scene/", "work/", "asset/", "report/"),
        ("run.json", "scene/", "asset/"),
    ),
    "fit --scene": Verb(
        lambda i, o: line(
            "fit", "--scene", i / "room.xml", "--references", i / "references", "--optimize", "*.reflectance.value",
            "--iterations", 2, "-o", o,
        ),
        ("run.json", "scene/", "pictures/", "report/", "work/"),
        ("run.json", "scene/", "pictures/"),
    ),
    "batch": Verb(
        lambda i, o: line("batch", i / "jobs.toml", "-o", o, "--threads", 2),
        ("plan.json", "batch.json", "batch.html", "shards/", "one/views/", "one/run.json"),
        ("plan.json", "batch.json", "shards/"),
    ),
    "shard": Verb(lambda i, o: line("shard", planned(i, o), "--index", 0), ("one/views/", "one/run.json"), ()),
    "farm": Verb(
        lambda i, o: line("farm", "export", i / "jobs.toml", "-o", o, "--as", "sbatch"),
        ("plan.json", "farm/mistyle.sbatch", "shards/", "one/asset/"),
        ("plan.json", "farm/mistyle.sbatch"),
    ),
    "compare": Verb(
        lambda i, o: line("compare", i / "a.png", i / "b.png", "-o", o, "--metrics", "psnr"),
        ("index.html", "compare.json", "compare.csv", "junit.xml", "pairs"),
        ("compare.json", "index.html"),
    ),
    "converge": Verb(
        lambda i, o: line("converge", i / "room.xml", "--with", "mitsuba:path", "--max-spp", 2, "--seeds", 2, "-o", o),
        ("converge.json", "converge.csv", "index.html"),
        ("converge.json", "index.html"),
    ),
    "export": Verb(
        lambda i, o: line("export", i / "run", "-o", o, "--formats", "maps", "glb", "obj"),
        ("square_style.glb", "square_style.mtl", "textures/square_style_normal.png"),
        ("square_style.export.json", "square_style.glb"),
    ),
    "lookdev": Verb(
        lambda i, o: line(
            "lookdev", i / "square.obj", "-o", o, "--size", 64, "--spp", 1, "--turntable", 2, "--frame", 32,
        ),
        ("lookdev.png", "lookdev.json", "turntable/001.png", "turntable.webp"),
        ("lookdev.json", "lookdev.png"),
    ),
    "verify": Verb(
        lambda i, o: line("verify", i / "run", "-o", o, "--no-render"),
        ("verify.json", "verify.json/"),
        ("verify.json",),
    ),
    "pack": Verb(lambda i, o: line("pack", "-o", o), ("install.sh", "SHA256SUMS"), ("SHA256SUMS", "install.sh")),
    "variations": Verb(
        lambda i, o: line("stylize", i / "square.obj", i / "style.png", "-o", o, "--variations", 1, *PAINT),
        ("variations.png", "variations.png/"),
        (),
    ),
}  # fmt: skip
# What a second call would put in the place of a file that was edited since: refused, or set aside in a run folder.
EDITS = {
    "render": "az000.0_el+15.0.png", "bake": "textures/baked_albedo.png", "stylize": "run.json", "demo": "run.json",
    "fit": "run.json", "fit --scene": "run.json", "batch": "plan.json", "shard": "one/run.json", "farm": "plan.json",
    "compare": "index.html", "converge": "index.html", "export": "square_style.glb", "lookdev": "lookdev.png",
    "verify": "verify.json", "pack": "install.sh", "variations": "variations.png",
}  # fmt: skip
ASIDE = ("stylize", "demo", "fit", "fit --scene", "batch", "shard", "farm")


def planned(inputs: Path, out: Path) -> Path:
    """A plan of one job, as `mistyle batch` resolves it, that lies beside the inputs and works in `out`."""
    from dataclasses import replace

    from mistyle.run.batch import Choices, planned
    from mistyle.run.batch_plan import write_plan

    place = inputs.parent / f"plan of {out.name}"
    if not (place / "plan.json").is_file():
        plan = planned(inputs / "jobs.toml", out, Choices(threads=2))
        told = json.loads(write_plan(replace(plan, out=place)).read_text())
        (place / "plan.json").write_text(json.dumps(told | {"out": str(out)}))
    return place / "plan.json"


@pytest.fixture(scope="module")
def given(tmp_path_factory) -> Path:
    """A folder with one input of every kind."""
    folder = tmp_path_factory.mktemp("given") / "inputs"
    folder.mkdir()
    (folder / "square.obj").write_text(SQUARE)
    noise = np.random.default_rng(0)
    for name in ("style", "a", "b"):
        Image.fromarray((noise.random((32, 32, 3)) * 255).astype(np.uint8)).save(folder / f"{name}.png")
    (folder / "room.xml").write_text(SCENE)
    (folder / "references").mkdir()
    Image.fromarray(np.full((16, 16, 3), 128, np.uint8)).save(folder / "references" / "front.png")
    (folder / "lamps.json").write_text(json.dumps({"version": 1, "lights": [LIGHTS]}))
    words = [w for w in PAINT if w not in ("--set", "--preset", "draft")]
    chosen = "".join(
        f"{key} = {json.dumps(value) if value.isalpha() else value}\n"
        for key, _, value in (w.partition("=") for w in words)
    )
    (folder / "jobs.toml").write_text(f'{JOBS}preset = "draft"\n[job.settings]\n{chosen}')
    assert main(line("render", folder / "square.obj", "-o", folder / "shots", *RIG)) == 0
    assert main(line("stylize", folder / "square.obj", folder / "style.png", "-o", folder / "run", *PAINT)) == 0
    return folder


@pytest.fixture(autouse=True)
def no_network(monkeypatch):
    """A pack without its wheels: what it collects is its own business, where it goes is tested here."""
    from mistyle.run import pack

    def fill(folder: Path, *_: object) -> None:
        for name in ("install.sh", "constraints.txt", "SHA256SUMS"):
            (folder / name).write_text(name)

    monkeypatch.setattr(pack, "_fill", fill)
    monkeypatch.setattr(pack, "llvm_files", lambda: (Path("lib"), []))


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
def test_what_is_not_ours_is_refused_before_any_work(given, tmp_path, monkeypatch, capsys, verb, name):
    out = tmp_path / "out"
    out.mkdir()
    strangers(out)
    plant(out, name)
    before, words = everything(out), VERBS[verb].words(given, out)

    def works(*_: object) -> None:
        raise AssertionError("work began")

    monkeypatch.setattr("mistyle.render.device.use", works)
    assert main(words) == 2
    said = capsys.readouterr().err
    assert name.split("/")[0] in said and "-o" in said and "mistyle: " in said and "Traceback" not in said
    unchanged(before, out)
    # A shard notes for its queue why it failed, in the folder of the batch's own.
    left = everything(out).keys() - before.keys()
    assert not left or verb == "shard" and left == {output.RECORD, "shards", "shards/one.failed.json"}


@pytest.mark.parametrize("verb", [v for v in VERBS if VERBS[v].older])
def test_a_folder_of_an_older_version_is_refused_with_that_reason(given, tmp_path, capsys, verb):
    out = tmp_path / "out"
    for name in VERBS[verb].older:
        plant(out, name)
    (out / "done.json").write_text("{}")
    before = everything(out)
    assert main(VERBS[verb].words(given, out)) == 2
    assert "older version" in capsys.readouterr().err and everything(out) == before


@pytest.mark.parametrize("verb", VERBS)
def test_strangers_files_stay_in_every_run(given, tmp_path, capsys, verb):
    """Into the folder of the inputs, through a link, again, over an edited file, without the record, by force."""
    place = tmp_path / "disk" / "inputs"
    shutil.copytree(given, place, symlinks=True)
    strangers(place)
    out = tmp_path / "out"
    out.symlink_to(place, target_is_directory=True)
    inputs = place if verb != "compare" else given  # a comparison's own folder is refused, see test_compare.py
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
def test_force_replaces_colliding_names_and_nothing_else(given, tmp_path, capsys, verb):
    out = tmp_path / "out"
    out.mkdir()
    strangers(out)
    before = everything(out)
    for name in VERBS[verb].covers:
        if not name.endswith("/") and "." in name or verb == "stylize":
            plant(out, name if name != "views" else "views/")
    words = VERBS[verb].words(given, out)
    assert main(words) == 2
    assert main([*words, "--overwrite"]) == 0, capsys.readouterr().err
    unchanged(before, out)
    if verb == "stylize":
        assert all((out / name / "mine.txt").read_text() == "mine" for name in ("views", "work", "asset", "report"))


def test_an_input_is_never_replaced(given, tmp_path, capsys):
    """Also not by force, and also not where mistyle wrote it in an earlier step."""
    out = tmp_path / "out"
    shutil.copytree(given / "run", out, symlinks=True)
    glb = out / "asset" / "square_style.glb"
    before = everything(out)
    for more in ([], ["--overwrite"]):
        assert main(line("stylize", glb, given / "style.png", "-o", out, *PAINT, *more)) == 2
        assert "this input is in asset/" in capsys.readouterr().err and everything(out) == before
    baked = tmp_path / "baked"
    words = VERBS["bake"].words(given, baked)
    assert main(words) == 0
    again = line("bake", baked / "baked.glb", given / "shots", "-o", baked, *ATLAS, "--overwrite")
    before = everything(baked)
    assert main(again) == 2 and "would be replaced" in capsys.readouterr().err and everything(baked) == before
    # Its own files of another name go, but not the one that was read.
    assert main([*again, "--name", "other"]) == 0
    unchanged({"baked.glb": before["baked.glb"]}, baked)
    assert not (baked / "baked.json").exists()


def test_approved_pictures_are_replaced_and_others_are_not(given, tmp_path, capsys):
    golden = tmp_path / "golden"
    golden.mkdir()
    strangers(golden)
    shutil.copy(given / "a.png", golden / "b.tif")
    before = everything(golden)
    words = line("compare", "--baseline", golden, given, "--approve", "b")
    assert main(words) == 2 and "no approval wrote this picture" in capsys.readouterr().err
    assert everything(golden) == before
    (golden / "b.tif").unlink()
    assert main(words) == 0 and (golden / "b.png").read_bytes() == (given / "b.png").read_bytes()
    unchanged({k: v for k, v in before.items() if k != "b.tif"}, golden)
    assert main(words) == 0
    (golden / "b.png").write_bytes((given / "a.png").read_bytes())
    assert main(words) == 2 and main([*words, "--overwrite"]) == 0


def test_models_and_loras_that_were_put_there_by_hand_stay(tmp_path, monkeypatch, capsys):
    import torch
    from safetensors.torch import save_file

    from mistyle.backends import consislora_make
    from mistyle.core.errors import UsageError

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
