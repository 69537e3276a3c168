"""Names made safe: one rule, over everything that names files, prims, materials and textures."""

import io
import json
import re
import socket
import zipfile
from argparse import Namespace
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from hypothesis import example, given, settings
from hypothesis import strategies as st
from PIL import Image

from mistyle.batch.names import JobSource, job_names
from mistyle.cli.main import main
from mistyle.cli.options import asset_name
from mistyle.core import names
from mistyle.core.errors import UsageError
from mistyle.deliver import files as deliver_files
from mistyle.deliver.asset import write_asset
from mistyle.deliver.export import DeliveryRequest, export
from mistyle.deliver.read_asset import FinishedAsset
from mistyle.io.images.packing import TARGETS, TextureSet
from mistyle.io.images.textures import part_stems
from mistyle.io.store import atomic
from mistyle.io.usd.write import library
from mistyle.jobs.deliver_settings import TEXTURES
from tests.support.gltf_cases import bumpy_sphere, material, no_texels, quarters

FORMATS = ["glb", "usd", "mtlx", "obj", "maps"]
LONG = "木" * 82
# Letters of several scripts, both cases, marks, what no file may have in its name, and what Windows reserves.
TEXT = st.text(alphabet='aAbB1._- /\\:*?"<>|\0\n木石ée\u0301ßॐ\u094d😀', max_size=200)
WORDS = st.sampled_from(["wood", "Wood", "wood_2", "wood.1001", "Wood.1002", "con", "", "木材", LONG, LONG + "a"])
NAMES = st.lists(TEXT | WORDS, min_size=1, max_size=12)


@settings(max_examples=40)
@given(TEXT, st.sampled_from([16, 40, names.ASSET, names.STEM]))
@example("aux" + "_" * 40 + "b", 40)
@example("con", 16)
def test_a_safe_name_is_safe_short_and_stays(text, limit):
    safe = names.safe_name(text, limit)
    assert names.is_safe(safe, limit) and names.safe_name(safe, limit) == safe
    assert len(safe.encode()) <= limit and not set(safe) & set('/\\:*?"<>|\0\n ')
    assert not re.fullmatch(r"(?i)(con|prn|aux|nul)(\..*)?", safe) and safe[0] != "." and safe[-1] != "."


def test_letters_stay_and_what_else_there_is_can_be_told_apart():
    kept = ["木材", "größe", "हिन्दी", "дерево", "a-b.c_d"]
    assert [names.safe_name(n) for n in kept] == kept
    assert names.safe_name("e\u0301") == "é" and names.safe_name("😀") != names.safe_name("🎉")
    assert names.cut("木材", 5) == "木"


@settings(max_examples=40)
@given(NAMES, st.sampled_from([None, 24, names.STEM]), st.sampled_from(["_", "-"]))
def test_distinct_names_differ_without_case_keep_their_tile_and_stay(texts, limit, joint):
    made = names.distinct(texts, limit=limit, joint=joint)
    assert made == names.distinct(list(texts), limit=limit, joint=joint)
    assert len({names.folded(m) for m in made}) == len(made) == len(texts)
    assert [names.split_tile(m)[1] for m in made] == [names.split_tile(t)[1] for t in texts]
    assert limit is None or all(len(m.encode()) <= limit for m in made)
    assert names.distinct(made, limit=limit, joint=joint) == made
    assert made[0] == texts[0] or limit is not None


@settings(max_examples=40)
@given(NAMES)
def test_identifiers_are_those_of_usd_and_materialx(texts):
    pxr = pytest.importorskip("pxr.Sdf")
    mx = pytest.importorskip("MaterialX")
    made = names.distinct([names.identifier(t) for t in texts], limit=names.IDENTIFIER)
    assert len({m.lower() for m in made}) == len(made)
    for name in made:
        assert pxr.Path.IsValidIdentifier(name) and mx.isValidName(name) and name.isascii()
        assert names.identifier(name) == name and len(name) <= names.IDENTIFIER


def test_identifiers_of_other_scripts_differ():
    assert names.identifier("木材") != names.identifier("石头") and names.identifier("häuser") == "hauser"
    assert names.identifier("upper/half") == "upper_half" and names.identifier("1a") == "_1a"


@settings(max_examples=40)
@given(st.text(alphabet="a木", min_size=1, max_size=300), NAMES.filter(lambda texts: len(texts) > 1))
def test_every_map_of_every_part_has_a_file_and_room_for_its_temporary_name(name, parts):
    endings = [f"_{m}.{e}" for m in ("albedo", "normal", "roughness", "orm") for e in ("png", "exr")]
    stems = part_stems(names.asset_name(None, name), parts)
    files = [stem + ending for stem in stems for ending in endings]
    assert len({names.folded(f) for f in files}) == len(files)
    assert all(len(f.encode()) <= names.WRITTEN for f in files)
    assert all(names.safe_name(f, names.WRITTEN) == f for f in files)


def test_the_temporary_name_of_the_longest_file_fits(monkeypatch, tmp_path):
    monkeypatch.setattr(socket, "gethostname", lambda: "h" * 64)
    path = tmp_path / ("x" * (names.WRITTEN - 5) + ".usda")
    assert len(atomic.hidden(path, 10**6, "tmp", ".usda").name) <= names.FILE_NAME
    atomic.atomic_write(path, b"1")
    assert path.read_bytes() == b"1"
    endings = [f"_{slot.map}.1001.{slot.ext}" for t in TARGETS.values() for slot in t.slots]
    assert max(map(len, endings)) <= names.ENDING
    assert max((s.map for t in TARGETS.values() for s in t.slots), key=len) == deliver_files.LONGEST_MAP


def asset_with(*parts: str):
    """A sphere of two materials, and maps whose albedo tells them apart: the first red, the second blue."""
    asset = bumpy_sphere(4)
    asset = replace(asset, mesh=replace(asset.mesh, parts=parts), materials=tuple(material(p) for p in parts))
    colours = np.eye(3, dtype=np.float32)[[0, 2]]
    return asset, [replace(quarters(8), albedo=np.broadcast_to(c, (8, 8, 3)).copy()) for c in colours]


def written(folder: Path, name: str, *parts: str) -> Path:
    asset, maps = asset_with(*parts)
    ones = [np.ones((8, 8), np.float32)] * 2
    write_asset(folder / "asset", name, asset, maps, ones, [no_texels(8)] * 2, provenance={})
    return folder


def hue(picture: Any) -> str:
    """Which of the two albedos a picture is."""
    with picture if isinstance(picture, Image.Image) else Image.open(picture) as opened:
        red, _, blue = np.asarray(opened.convert("RGB")).mean(axis=(0, 1))
    return "red" if red > blue else "blue"


def in_usd(path: Path) -> dict[str, tuple[str, int]]:
    """Hue of the albedo and number of faces, by the name that is shown."""
    pxr = library()

    stage = pxr.Usd.Stage.Open(str(path))
    (mesh,) = [pxr.UsdGeom.Mesh(p) for p in stage.Traverse() if p.IsA(pxr.UsdGeom.Mesh)]
    found = {}
    for subset in pxr.UsdShade.MaterialBindingAPI(mesh.GetPrim()).GetMaterialBindSubsets():
        bound = pxr.UsdShade.MaterialBindingAPI(subset.GetPrim()).ComputeBoundMaterial()[0].GetPrim()
        texture = stage.GetPrimAtPath(f"{bound.GetPath()}/diffuseColor").GetAttribute("inputs:file").Get()
        shown = bound.GetDisplayName() or bound.GetName()
        data = pxr.Ar.GetResolver().OpenAsset(pxr.Ar.ResolvedPath(texture.resolvedPath)).GetBuffer()
        found[shown] = (hue(io.BytesIO(bytes(data))), len(subset.GetIndicesAttr().Get()))
    return found


def in_obj(path: Path) -> dict[str, tuple[str, int]]:
    faces: dict[str, int] = {}
    for line in path.read_text(encoding="utf-8").splitlines():
        if line.startswith("usemtl "):
            current = line[7:]
        elif line.startswith("f "):
            faces[current] = faces.get(current, 0) + 1
    blocks = path.with_suffix(".mtl").read_text(encoding="utf-8").split("newmtl ")[1:]
    files = {b.splitlines()[0]: re.findall(r"^map_Kd (.*)$", b, re.MULTILINE)[0] for b in blocks}
    assert set(faces) == set(files) and len(blocks) == len(files)
    return {name: (hue(path.parent / file), faces[name]) for name, file in files.items()}


def in_materialx(path: Path) -> dict[str, str]:
    mx: Any = import_module("MaterialX")
    document = mx.createDocument()
    mx.readFromXmlFile(document, str(path))
    found = {}
    for node in document.getMaterialNodes():
        surface = node.getConnectedNode("surfaceshader")
        graph = document.getNodeGraph(surface.getInput("base_color").getNodeGraphString())
        file = graph.getNode("image_albedo").getInput("file").getValueString()
        found[node.getDocString() or node.getName()] = hue(path.parent / file)
    return found


def in_glb(path: Path) -> dict[str, tuple[str, int]]:
    scene: Any = trimesh.load(path, process=False, force="scene")
    shown = [(g.visual.material, len(g.faces)) for g in scene.geometry.values()]
    return {m.name: (hue(m.baseColorTexture), faces) for m, faces in shown}


@pytest.mark.parametrize(
    "parts",
    [
        ("木材", "石头"),
        (f"{LONG}材", f"{LONG}头"),
        ("Wood", "wood"),
        ("a b", "a/b"),
        ("SR_a", "a"),
        ("x_normal", "x"),
    ],
    ids=["chinese", "83 characters", "case only", "punctuation", "reserved prefix", "map in the name"],
)
def test_two_materials_stay_two_in_every_format(tmp_path, parts):
    pytest.importorskip("pxr")
    pytest.importorskip("MaterialX")
    name = names.asset_name(None, "木" * 42, "石" * 41)
    run = written(tmp_path / "run", name, *parts)
    files = export(run, run / "delivered", DeliveryRequest(formats=FORMATS, target="unreal"))
    assert len({names.folded(str(p)) for p in files}) == len(files)
    out = run / "delivered"
    below, above = np.bincount(bumpy_sphere(4).mesh.part).tolist()
    wanted = {("red", below), ("blue", above)}
    assert in_glb(out / f"{name}.glb") == dict(zip(parts, [("red", below), ("blue", above)], strict=True))
    found = in_usd(out / f"{name}.usda"), in_usd(out / f"{name}.usdz"), in_obj(out / f"{name}.obj")
    for shown in found:
        assert len(shown) == 2 and set(shown.values()) == wanted
    assert set(in_materialx(out / f"{name}.mtlx").values()) == {"red", "blue"}
    with zipfile.ZipFile(out / f"{name}.usdz") as package:
        named = set(package.namelist())
    assert {p.relative_to(out).as_posix() for p in files if p.parent.name == "textures"} >= named - {f"{name}.usda"}
    if parts == ("木材", "石头"):
        assert all(set(shown) == set(parts) for shown in (*found, in_materialx(out / f"{name}.mtlx")))
    record = json.loads((out / f"{name}.export.json").read_text())
    assert len(record["sets"]) == 2 and all(e["sha256"] for e in record["files"])


def test_a_pattern_that_lets_two_maps_be_one_file_is_refused(tmp_path):
    run = written(tmp_path / "run", "ball", "a", "b")
    with pytest.raises(UsageError, match=r"two maps would both be albedo\.png; put \{asset\} and \{udim\} into it"):
        export(run, tmp_path / "out", DeliveryRequest(formats=["maps"], names="{map}.{ext}"))
    with pytest.raises(UsageError, match="--texture-name 'y+.*expected at most"):
        export(run, tmp_path / "out", DeliveryRequest(formats=["maps"], names="y" * 150 + "{asset}_{map}.{ext}"))
    assert not (tmp_path / "out").exists()
    made = export(
        run, tmp_path / "out", DeliveryRequest(formats=["maps"], names="y" * 80 + "{asset}{map}{asset}.{ext}")
    )
    files = [p.name for p in made if p.suffix == ".png"]
    assert len(files) == 10 and all(len(f) <= names.WRITTEN for f in files)


@settings(max_examples=40)
@given(
    st.lists(st.sampled_from(["x", "X", "x.1001", "x.1002", "X.1001", "x_2", LONG, LONG + "b"]), min_size=2),
    st.sampled_from([TEXTURES, "{udim}_{map}_{asset}.{ext}", "v7-{asset}-{map}.{udim}.{ext}"]),
)
def test_no_two_sets_of_a_delivery_share_a_file(parts, pattern):
    parts = names.distinct(parts, key=str)
    tiles = [int(names.split_tile(part)[1][1:] or 1001) for part in parts]
    planes = (np.zeros((1, 1, 3), np.float32),) * 2 + (np.zeros((1, 1), np.float32),) * 3
    sets = tuple(TextureSet(s, t, *planes) for s, t in zip(part_stems("ball", parts), tiles, strict=True))
    finished = FinishedAsset(bumpy_sphere(4), sets, {"name": "ball"}, Path())
    pattern = deliver_files._tiled(pattern, finished.sets)
    labels = deliver_files.set_labels(pattern, "木" * 26, finished)
    for target in TARGETS.values():
        files = deliver_files._texture_files(pattern, labels, finished.sets, target.slots, target, True)
        flat = [f for row in files for f in row]
        assert len({names.folded(f) for f in flat}) == len(flat)
        assert all(len(f.encode()) <= names.WRITTEN and f.endswith((".png", ".exr")) for f in flat)


def test_a_version_survives_long_names(tmp_path):
    asset, maps = asset_with("木材", "石头")
    told = {"mesh": f"{'木' * 60}.obj", "style": f"{'石' * 60}.png"}
    ones = [np.ones((8, 8), np.float32)] * 2
    write_asset(tmp_path / "asset", "a", asset, maps, ones, [no_texels(8)] * 2, provenance=told)
    pattern, out = "{mesh}_{style}_v{v:03}", tmp_path / "out"
    made = [
        export(tmp_path, out, DeliveryRequest(formats=["glb"], name=pattern, target=t)) for t in ("blender", "unreal")
    ]
    glbs = [next(p.stem for p in files if p.suffix == ".glb") for files in made]
    assert [g[-5:] for g in glbs] == ["_v001", "_v002"] and all(len(g.encode()) <= names.ASSET for g in glbs)
    assert "木" in glbs[0] and "石" in glbs[0]


def test_names_of_assets_and_jobs_are_file_names_before_the_work_begins(tmp_path, capsys):
    assert asset_name(Namespace(name=None), "my chair", "木" * 83) == names.safe_name(f"my_chair_{'木' * 23}")
    assert asset_name(Namespace(name="{mesh}_v{v}"), "a", "b") == "a_b" and asset_name(Namespace(name="x"), "a") == "x"
    (tmp_path / "m.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    Image.new("RGB", (8, 8)).save(tmp_path / "s.png")
    command = ["stylize", str(tmp_path / "m.obj"), str(tmp_path / "s.png"), "-o", str(tmp_path / "out")]
    assert main([*command, "--name", "木" * 83]) == 2
    assert "249 bytes of UTF-8, expected" in capsys.readouterr().err and not (tmp_path / "out").exists()
    called = [LONG, LONG, "Chair", "chair", "my chair", "con", "con"]
    made = job_names(
        [JobSource(Path(f"{k}.obj"), Path("s.png"), chosen=name) for k, name in enumerate(called)], tmp_path
    )
    assert len({n.lower() for n in made}) == len(made) and all(names.is_safe(n) for n in made)
    assert made[2:5] == ["Chair", "chair-2", "my-chair"]
