"""Delivered files, opened by readers that are not ours: Pillow, trimesh, MaterialX, USD."""

import json
import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import trimesh
from PIL import Image

from mistyle.batch.jobs_file import Record
from mistyle.batch.plan import BatchPlan, with_delivery
from mistyle.cli.main import main, parser
from mistyle.cli.options import DELIVERY_OPTIONS, asset_name, given_settings
from mistyle.core.errors import InputRefused, UsageError
from mistyle.core.image import srgb_from_linear
from mistyle.deliver.asset import write_asset
from mistyle.deliver.export import DeliveryRequest, deliver, export
from mistyle.deliver.read_asset import read_finished
from mistyle.io.images.packing import TARGETS
from mistyle.io.store import output
from mistyle.jobs.deliver_settings import FORMATS
from mistyle.jobs.progress import Progress
from mistyle.stylization.settings import Settings, resolve
from tests.support.gltf_cases import bumpy_sphere, no_texels, quad, quarters

OCCLUSION = np.linspace(0.2, 1, 256, dtype=np.float32).reshape(16, 16)


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Path:
    """A run folder with an asset of two texture sets."""
    folder = tmp_path_factory.mktemp("run")
    asset = bumpy_sphere()
    write_asset(
        folder / "asset", "ball", asset, [quarters()] * 2, [OCCLUSION] * 2, [no_texels()] * 2, provenance={"seed": 1}
    )
    return folder


@pytest.fixture(scope="module")
def single(tmp_path_factory) -> Path:
    """One of a single set."""
    folder = tmp_path_factory.mktemp("single")
    write_asset(folder / "asset", "tile", quad(), [quarters()], [OCCLUSION], [no_texels()], provenance={})
    return folder


def pixels(path: Path) -> np.ndarray:
    with Image.open(path) as picture:
        return np.asarray(picture).astype(np.float64) / 255


def test_what_was_written_is_read_back(made):
    finished = read_finished(made)
    maps = quarters()
    assert len(finished.sets) == 2 and finished.manifest["name"] == "ball"
    for found in finished.sets:
        np.testing.assert_allclose(found.albedo, maps.albedo, atol=1e-3)
        np.testing.assert_allclose(found.normal * 2 - 1, maps.normal, atol=2e-3)
        np.testing.assert_allclose(found.roughness, maps.roughness, atol=1e-3)
        np.testing.assert_allclose(found.metallic, maps.metallic, atol=1e-3)
        np.testing.assert_allclose(found.occlusion, OCCLUSION, atol=1e-3)
    assert read_finished(made / "asset").manifest == read_finished(made / "asset" / "ball.json").manifest


def test_an_edited_albedo_is_what_is_delivered(single, tmp_path):
    shutil.copytree(single, tmp_path / "edited")
    picture = tmp_path / "edited" / "asset" / "textures" / "tile_albedo.png"
    Image.new("RGB", (16, 16), (255, 0, 0)).save(picture)
    found = read_finished(tmp_path / "edited").sets[0]
    np.testing.assert_allclose(found.albedo, np.broadcast_to([1, 0, 0], (16, 16, 3)), atol=1e-6)


@pytest.mark.parametrize("target", sorted(TARGETS))
def test_every_target_writes_what_its_program_reads(single, tmp_path, target):
    maps = quarters()
    files = {p.name: p for p in export(single, tmp_path / "out", DeliveryRequest(formats=["maps"], target=target))}
    record = json.loads(files["tile.export.json"].read_text())
    assert {Path(e["file"]).name for e in record["files"]} == set(files) - {"tile.export.json"}
    if target in ("houdini", "arnold"):
        assert set(files) == {
            "tile.export.json",
            *(f"tile_{m}.exr" for m in ("albedo", "normal", "roughness", "metallic")),
        }
        return
    step = 1 / 255
    np.testing.assert_allclose(pixels(files["tile_albedo.png"]), srgb_from_linear(maps.albedo), atol=step)
    if target != "blender":
        green = pixels(files["tile_normal.png"])[..., 1]
        wanted = maps.normal[..., 1] * (-1 if target == "unreal" else 1) * 0.5 + 0.5
        np.testing.assert_allclose(green, wanted, atol=step)
    if target == "unreal":
        packed = np.stack([OCCLUSION, maps.roughness, maps.metallic], axis=-1)
        np.testing.assert_allclose(pixels(files["tile_orm.png"]), packed, atol=step)
    if target == "unity-hdrp":
        packed = np.stack([maps.metallic, OCCLUSION, np.zeros((16, 16)), 1 - maps.roughness], axis=-1)
        np.testing.assert_allclose(pixels(files["tile_mask.png"]), packed, atol=step)
    if target == "unity-urp":
        found = pixels(files["tile_metallicsmoothness.png"])
        np.testing.assert_allclose(found[..., 3], 1 - maps.roughness, atol=step)
        np.testing.assert_allclose(found[..., 0], maps.metallic, atol=step)


def test_names_follow_the_pattern_and_tell_sets_apart(made, tmp_path):
    files = [p.name for p in export(made, tmp_path / "a", DeliveryRequest(formats=["maps"], target="arnold"))]
    assert "ball_lower_half_albedo.exr" in files and "ball_upper_half_normal.exr" in files
    named = export(
        made,
        tmp_path / "b",
        DeliveryRequest(formats=["maps"], target="arnold", names="x_{asset}-{map}_v003.{udim}.{ext}"),
    )
    assert "x_ball_lower_half-albedo_v003.1001.exr" in [p.name for p in named]
    for wrong in ("{asset}.{ext}", "{map}.{ext}/..", "{map}.{ext}{0}", "{asset}_{map}"):
        with pytest.raises(UsageError, match="--texture-name"):
            export(made, tmp_path / "c", DeliveryRequest(formats=["maps"], names=wrong))


@pytest.mark.parametrize("target", ["blender", "unreal", "houdini"])
def test_usd_has_nothing_against_it_and_shows_the_mesh(made, tmp_path, target):
    pytest.importorskip("pxr")
    from mistyle.io.usd import write as usd

    export(made, tmp_path / "out", DeliveryRequest(formats=["usd"], target=target))
    stage_file = tmp_path / "out" / "ball.usda"
    assert usd.complaints(stage_file) == []
    pxr = usd.library()
    finished = read_finished(made)
    for path in (stage_file, tmp_path / "out" / "ball.usdz"):
        stage = pxr.Usd.Stage.Open(str(path))
        mesh = pxr.UsdGeom.Mesh(stage.GetPrimAtPath("/ball/Mesh"))
        np.testing.assert_allclose(
            np.array(mesh.GetPointsAttr().Get()), finished.asset.source.user_positions, atol=1e-6
        )
        st = pxr.UsdGeom.PrimvarsAPI(mesh).GetPrimvar("st").Get()
        np.testing.assert_allclose(np.array(st).reshape(-1, 3, 2), finished.asset.mesh.corner_uvs, atol=1e-6)
        subsets = pxr.UsdGeom.Subset.GetAllGeomSubsets(mesh)
        assert sum(len(s.GetIndicesAttr().Get()) for s in subsets) == len(finished.asset.mesh.faces)
        textures = [p for p in stage.Traverse() if p.GetAttribute("inputs:file")]
        assert len(textures) == 8
        assert all(p.GetAttribute("inputs:file").Get().resolvedPath for p in textures)
        spaces = {p.GetName(): p.GetAttribute("inputs:sourceColorSpace").Get() for p in textures}
        assert spaces["normal"] == "raw" and spaces["diffuseColor"] == ("raw" if target == "houdini" else "sRGB")


@pytest.mark.parametrize("target", ["blender", "arnold"])
def test_materialx_validates(made, tmp_path, target):
    mx = pytest.importorskip("MaterialX")
    export(made, tmp_path / "out", DeliveryRequest(formats=["mtlx"], target=target))
    document = mx.createDocument()
    mx.readFromXmlFile(document, str(tmp_path / "out" / "ball.mtlx"))
    library = mx.createDocument()
    mx.loadLibraries(mx.getDefaultDataLibraryFolders(), mx.getDefaultDataSearchPath(), library)
    document.setDataLibrary(library)
    valid, message = document.validate()
    assert valid, message
    surfaces = [n for n in document.getNodes() if n.getCategory() == "open_pbr_surface"]
    assert len(surfaces) == 2
    for node in surfaces:
        definition = node.getNodeDef()
        assert definition is not None
        for chosen in node.getInputs():
            assert definition.getActiveInput(chosen.getName()).getType() == chosen.getType()
    ours = [graph for graph in document.getNodeGraphs() if graph.getName().startswith("NG_")]
    assert len([n for g in ours for n in g.getNodes() if n.getCategory() == "image"]) >= 8
    for graph in ours:
        if not graph.getNode("image_albedo"):
            continue  # one of the library's own
        for node in graph.getNodes():
            assert node.getNodeDef() is not None, node.getName()
            if node.getCategory() == "image":
                assert (tmp_path / "out" / node.getInput("file").getValueString()).is_file()


def test_obj_comes_back_as_the_same_mesh(made, tmp_path):
    export(made, tmp_path / "out", DeliveryRequest(formats=["obj"], target="blender"))
    finished = read_finished(made)
    loaded: Any = trimesh.load(tmp_path / "out" / "ball.obj", process=False, force="mesh")
    area = np.linalg.norm(np.cross(*np.diff(loaded.vertices[loaded.faces], axis=1).transpose(1, 0, 2)), axis=1).sum()
    corners = finished.asset.source.user_positions[finished.asset.mesh.faces]
    ours = np.linalg.norm(np.cross(*np.diff(corners, axis=1).transpose(1, 0, 2)), axis=1).sum()
    assert area == pytest.approx(ours, rel=1e-5)
    lines = (tmp_path / "out" / "ball.obj").read_text().splitlines()
    positions = np.array([list(map(float, row.split()[1:])) for row in lines if row.startswith("v ")])
    np.testing.assert_allclose(positions, finished.asset.source.user_positions, rtol=1e-6, atol=1e-7)
    materials = (tmp_path / "out" / "ball.mtl").read_text()
    for word in ("map_Kd", "map_Pr", "map_Pm", "norm"):
        files = [row.split()[1] for row in materials.splitlines() if row.startswith(f"{word} ")]
        assert len(files) == 2 and all((tmp_path / "out" / f).is_file() for f in files)


def test_all_formats_at_once_and_again(single, tmp_path):
    pytest.importorskip("pxr")
    out = tmp_path / "out"
    first = {
        p.relative_to(out): p.read_bytes()
        for p in export(single, out, DeliveryRequest(formats=FORMATS, target="unreal"))
    }
    names = {p.name for p in first}
    assert {"tile.glb", "tile.usda", "tile.usdz", "tile.mtlx", "tile.obj", "tile.mtl"} <= names
    # Unreal's own normal map beside the one that the materials in files want.
    assert {"tile_normal_dx.png", "tile_normal.png", "tile_orm.png", "tile_roughness.png"} <= names
    again = {
        p.relative_to(out): p.read_bytes()
        for p in export(single, out, DeliveryRequest(formats=FORMATS, target="unreal"))
    }
    assert again.keys() == first.keys()
    assert [str(p) for p in first if again[p] != first[p] and p.suffix != ".usdz"] == []


def test_what_cannot_be_delivered_is_refused(made, tmp_path):
    with pytest.raises(InputRefused, match="found no asset"):
        export(tmp_path, tmp_path / "out", DeliveryRequest(formats=["glb"]))
    with pytest.raises(UsageError, match="'fbx' cannot be written"):
        export(made, tmp_path / "out", DeliveryRequest(formats=["fbx"]))
    with pytest.raises(UsageError, match="'maya' cannot be written"):
        export(made, tmp_path / "out", DeliveryRequest(formats=["glb"], target="maya"))
    mine = tmp_path / "mine"
    mine.mkdir()
    (mine / "ball.glb").write_text("mine")
    with pytest.raises(UsageError, match="mistyle did not write this file"):
        export(made, mine, DeliveryRequest(formats=["glb"]))
    assert (mine / "ball.glb").read_text() == "mine" and len(list(mine.iterdir())) == 1
    (tmp_path / "broken.json").write_text("{}")
    with pytest.raises(InputRefused, match="not the list"):
        export(tmp_path / "broken.json", tmp_path / "out", DeliveryRequest(formats=["glb"]))
    elsewhere = {"name": "ball", "parts": [{"name": "ball", "textures": "../../secret"}], "files": []}
    (tmp_path / "broken.json").write_text(json.dumps(elsewhere))
    with pytest.raises(InputRefused, match="not a file name"):
        export(tmp_path / "broken.json", tmp_path / "out", DeliveryRequest(formats=["glb"]))
    (tmp_path / "broken.json").write_text("[" * 100_000)
    with pytest.raises(InputRefused, match="nested without end"):
        export(tmp_path / "broken.json", tmp_path / "out", DeliveryRequest(formats=["glb"]))
    assert not (tmp_path / "out").exists()


def contents(folder: Path) -> dict[Path, bytes]:
    return {p: p.read_bytes() for p in folder.rglob("*") if p.is_file() and p.name != output.RECORD}


def test_versions_go_up_and_nothing_delivered_is_overwritten(single, tmp_path):
    run, out = Path(shutil.copytree(single, tmp_path / "run")), tmp_path / "out"
    first = export(run, out, DeliveryRequest(formats=["glb", "maps"], name="{mesh}_{style}_v{v:03}"))
    assert {p.name for p in first} >= {"thing_look_v001.glb", "thing_look_v001_albedo.png"}
    kept = contents(out)
    # The same asset again is the same delivery.
    assert export(run, out, DeliveryRequest(formats=["glb", "maps"], name="{mesh}_{style}_v{v:03}")) == first
    assert contents(out) == kept
    # Another program, or an edited texture, is a new one; the earlier files stay as they are.
    export(run, out, DeliveryRequest(formats=["glb", "maps"], name="{mesh}_{style}_v{v:03}", target="unreal"))
    Image.new("RGB", (16, 16), (255, 0, 0)).save(run / "asset" / "textures" / "tile_albedo.png")
    third = export(run, out, DeliveryRequest(formats=["glb", "maps"], name="{mesh}_{style}_v{v:03}"))
    assert "thing_look_v003.glb" in {p.name for p in third}
    assert all(p.read_bytes() == content for p, content in kept.items())
    # A gap is not filled, and a file without its list counts too.
    (out / "thing_look_v003.export.json").unlink()
    assert "thing_look_v004.glb" in {
        p.name for p in export(run, out, DeliveryRequest(formats=["glb"], name="{mesh}_{style}_v{v:03}"))
    }


def test_other_deliveries_in_the_folder_stay_and_are_not_replaced(made, single, tmp_path):
    out = tmp_path / "out"
    export(made, out, DeliveryRequest(formats=["glb", "maps"]))
    before = contents(out)
    export(single, out, DeliveryRequest(formats=["glb", "maps"]))
    assert all(p.read_bytes() == content for p, content in before.items())
    # The same name again replaces its own files only.
    export(made, out, DeliveryRequest(formats=["glb"]))
    left = {p.relative_to(out).as_posix() for p in out.rglob("*") if p.is_file()}
    assert "textures/tile_albedo.png" in left and "textures/ball_lower_half_albedo.png" not in left
    export(single, tmp_path / "plain", DeliveryRequest(formats=["maps"], names="{map}.{ext}"))
    with pytest.raises(UsageError, match="another delivery's file"):
        export(single, tmp_path / "plain", DeliveryRequest(formats=["maps"], names="{map}.{ext}", name="second"))
    assert (tmp_path / "plain" / "textures" / "albedo.png").is_file()


@pytest.mark.parametrize("name", ["{x}", "{v.__class__}", "a/{v}", "", "{asset!r}", "{v:>9999}", "{0}", "{"])
def test_names_are_plain_patterns(single, tmp_path, name):
    with pytest.raises(UsageError, match="--name"):
        export(single, tmp_path / "out", DeliveryRequest(formats=["glb"], name=name))
    with pytest.raises(UsageError, match="cut off before its version"):
        export(single, tmp_path / "out", DeliveryRequest(formats=["glb"], name="x" * 90 + "_v{v}"))


def settings_of(deliver: dict[str, Any], environment=None) -> Settings:
    return resolve("draft", None, {"deliver": deliver}, environment or {})


def test_a_job_delivers_what_its_settings_say(single, tmp_path):
    run = Path(shutil.copytree(single, tmp_path / "run"))
    quiet = Progress(quiet=True)

    def job(**deliver):
        return SimpleNamespace(settings=settings_of(deliver), out=run, mesh=Path("thing.obj"), overwrite=False)

    assert deliver(job(), quiet) == {} and not (run / "delivered").exists()
    told = deliver(job(formats="maps,glb", target=["unreal,blender"], name="{asset}_v{v}"), quiet)["delivered"]
    assert set(told) == {"unreal", "blender"}
    assert (run / "delivered" / "unreal" / "tile_v1.glb").is_file()
    assert (run / "delivered" / "unreal" / "textures" / "tile_v1_orm.png").is_file()
    assert str(run / "delivered" / "blender" / "textures" / "tile_v1_roughness.png") in told["blender"]
    assert deliver(job(target="unreal", name="{asset}_v{v}"), quiet)["delivered"]["unreal"] == told["unreal"]


def options_of(*arguments: str):
    return parser().parse_args(["stylize", "m.obj", "s.png", "-o", "out", *arguments])


def test_the_command_line_says_it_for_stylize_fit_and_batch(tmp_path):
    from mistyle.cli.fit import material_settings
    from mistyle.cli.main import _settings

    said = _settings(options_of("--formats", "glb,usd", "--target", "unreal,houdini", "--colorspace", "ACEScg"))
    assert said.deliver.chosen_formats == ("glb", "usd") and said.deliver.chosen_targets == ("unreal", "houdini")
    assert said.colour.space == "ACEScg" and not _settings(options_of()).deliver.wanted
    only = _settings(options_of("--target", "unreal")).deliver
    assert (only.chosen_formats, only.chosen_targets) == (("maps", "glb"), ("unreal",))
    # A pattern names what is delivered, a plain name the asset.
    options = options_of("--name", "{mesh}_{style}_v{v:03}")
    assert _settings(options).deliver.name == "{mesh}_{style}_v{v:03}" and asset_name(options, "m_s") == "m_s"
    plain = options_of("--name", "chair")
    assert not _settings(plain).deliver.wanted and asset_name(plain, "m_s") == "chair"
    with pytest.raises(UsageError, match="fbx"):
        _settings(options_of("--formats", "glb,fbx"))
    fit = parser().parse_args(["fit", "m.obj", "r", "-o", "out", "--target", "arnold", "--formats", "maps"])
    assert material_settings(fit).deliver.chosen_targets == ("arnold",)
    batch = parser().parse_args(["batch", "jobs.toml", "-o", "out", "--target", "arnold", "--name", "x_v{v}"])
    said = given_settings(batch, DELIVERY_OPTIONS)
    jobs = (Record(name="a", kind="stylize", mesh=Path("m.obj"), settings=settings_of({}).model_dump(mode="json")),)
    changed = with_delivery(BatchPlan(tmp_path, jobs), said)
    assert changed.jobs[0].settings["deliver"]["target"] == ["arnold"]
    assert Settings.model_validate(changed.jobs[0].settings).deliver.name == "x_v{v}"
    plan = BatchPlan(tmp_path, jobs)
    assert with_delivery(plan, {}) is plan
    with pytest.raises(SystemExit):
        parser().parse_args(["batch", "jobs.toml", "--name", "alike"])


def test_the_verb_export_takes_commas_and_several_targets(single, tmp_path, capsys):
    arguments = ["export", str(single), "-o", str(tmp_path / "out"), "--formats", "maps,glb", "--json"]
    assert main([*arguments, "--target", "unreal,unity-urp"]) == 0
    files = json.loads(capsys.readouterr().out)["files"]
    assert {Path(f).relative_to(tmp_path / "out").parts[0] for f in files} == {"unreal", "unity-urp"}
    assert main([*arguments[:-1], "--name", "{nothing}"]) == 2
    assert "--name" in capsys.readouterr().err


def test_objects_of_an_obj_keep_their_names(tmp_path):
    from mistyle.io.meshes.obj_read import read_obj
    from mistyle.io.read_mesh import read_mesh

    rows = [(x, y, z) for z in (0, 1, 2) for x, y in ((0, 0), (1, 0), (0, 1))]
    lines = [f"v {x} {y} {z}" for x, y, z in rows] + ["vt 0 0", "vt 1 0", "vt 0 1"]
    lines += ["g left arm", "usemtl a", "f 1/1 2/2 3/3", "g head", "usemtl b", "f 4/1 5/2 6/3", "usemtl a"]
    lines += ["f 7/1 8/2 9/3"]
    source = tmp_path / "three.obj"
    source.write_text("\n".join(lines) + "\n")
    asset = read_mesh(source, uv="auto", size=16)
    parts = len(asset.mesh.parts)
    write_asset(
        tmp_path / "run" / "asset", "three", asset, [quarters()] * parts, [OCCLUSION] * parts, [no_texels()] * parts,
        provenance={},
    )  # fmt: skip
    export(tmp_path / "run", tmp_path / "out", DeliveryRequest(formats=["obj"], target="blender"))
    text = (tmp_path / "out" / "three.obj").read_text().splitlines()
    assert [line for line in text if line.startswith(("o ", "usemtl "))] == [
        "o left arm", "usemtl a", "o head", "usemtl a", "usemtl b",
    ]  # fmt: skip
    found = read_obj(tmp_path / "out" / "three.obj", 100)
    assert [p.name for p in found.primitives if p.stop > p.start] == ["left arm", "head", "head"]
    heights = {p.name: set(found.positions[found.faces[p.start : p.stop]][..., 2].ravel()) for p in found.primitives}
    assert len(found.faces) == 3 and heights["left arm"] == {0}


@pytest.mark.parametrize(
    ("name", "line"), [("a\nv 1", "o a v 1"), ("back\\", "o back"), ("\ud800", "o object"), ("Nase ö", "o Nase ö")]
)
def test_a_name_of_an_object_stays_on_its_line(name, line, tmp_path):
    from mistyle.io.materialx import TexturedMaterial
    from mistyle.io.meshes.obj_write import write_obj

    mesh, look = (
        quad().mesh,
        TexturedMaterial("m", "albedo.png", "normal.png", "roughness.png", "metallic.png"),
    )
    write_obj(tmp_path / "a.obj", mesh, mesh.positions, [1001], [look], (np.zeros(len(mesh.faces), np.int32), [name]))
    lines = (tmp_path / "a.obj").read_text(encoding="utf-8").splitlines()
    assert line in lines and sum(each.startswith("v ") for each in lines) == len(mesh.positions)
