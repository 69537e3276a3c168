"""`mistyle verify`: what it says of good files, of damaged ones, and of readers that are not there."""

import json
import os
import shutil
import stat
from pathlib import Path

import numpy as np
import pytest

from mistyle.cli.main import main
from mistyle.core.errors import InputRefused, UsageError
from mistyle.deliver import verify_checks
from mistyle.deliver.asset import write_asset
from mistyle.deliver.export import DeliveryRequest, export
from mistyle.deliver.verify import Rendering, compared, file_checks, table, verify
from mistyle.deliver.verify_surfaces import surface_checks
from mistyle.io.store.atomic import sha256_file
from mistyle.render.external.blender import blender_command, find_blender
from tests.support.gltf_cases import bumpy_sphere, no_texels, quarters
from tests.support.node_tools import modules

FORMATS = ["glb", "usd", "mtlx", "obj", "maps"]


@pytest.fixture(scope="module")
def good(tmp_path_factory) -> Path:
    """A run folder with an asset of two texture sets, delivered in every format."""
    pytest.importorskip("pxr")
    folder = tmp_path_factory.mktemp("run")
    ones = np.ones((16, 16), np.float32)
    write_asset(
        folder / "asset", "ball", bumpy_sphere(), [quarters()] * 2, [ones] * 2, [no_texels()] * 2, provenance={}
    )
    export(folder, folder / "delivered" / "blender", DeliveryRequest(formats=FORMATS, target="blender"))
    return folder


@pytest.fixture
def run(good, tmp_path) -> Path:
    return Path(shutil.copytree(good, tmp_path / "run"))


@pytest.fixture(autouse=True)
def no_blender(monkeypatch):
    """Whether this machine has one must not matter."""
    monkeypatch.delenv("MISTYLE_BLENDER_PYTHON", raising=False)
    monkeypatch.setattr("mistyle.render.external.blender.which", lambda name: None)


def outcomes(told: dict, *words: str) -> set[str]:
    """The outcomes of the rows that have all the words in them."""
    rows = [c for c in told["checks"] if all(w in f"{c['file']} {c['check']} {c['said']}" for w in words)]
    assert rows, words
    return {c["outcome"] for c in rows}


def test_good_files_pass_every_reader_that_is_there(run, monkeypatch):
    home = modules()
    if isinstance(home, Path):
        # Validators are looked for by the name that packages have.
        monkeypatch.setenv("NODE_PATH", str(home))
    told = verify(run)
    assert told["failed"] == 0, table(told)
    for words in (("ball.json", "sha256"), ("ball.export.json", "sha256"), ("ball.glb", "trimesh"),
                  ("ball.obj", "trimesh"), ("ball.usda", "UsdValidation"), ("ball.usdz", "UsdValidation"),
                  ("ball.mtlx", "MaterialX"), ("*.png", "Pillow"), ("ball.glb", "2 materials, 2 maps"),
                  ("ball.usda", "2 materials, 8 maps"), ("ball.usdz", "2 materials, 8 maps"),
                  ("ball.obj", "2 materials, 8 maps"), ("ball.mtlx", "2 materials, 8 maps"),
                  ("asset/ball.json", "2 texture sets"), ("ball.export.json", "2 texture sets")):  # fmt: skip
        assert outcomes(told, *words) == {"passed"}, words
    validator = {"passed"} if isinstance(home, Path) else {"not checked"}
    assert outcomes(told, "ball.glb", "glTF validator") == validator
    assert outcomes(told, "ball.usda", "Blender") == {"not checked"}
    assert json.loads((run / "verify" / "verify.json").read_text()) == told
    assert "not checked" in table(told) and "Blender not found" in table(told)
    assert verify(run)["failed"] == 0  # its own folder is no part of what it checks


def test_readers_that_are_not_there_are_plain_rows(run, monkeypatch):
    monkeypatch.setattr(verify_checks, "which", lambda name: None)
    told = verify(run / "asset" / "ball.glb", run / "checked")
    assert outcomes(told, "glTF validator") == {"not checked"} and "node not found" in table(told)
    assert told["failed"] == 0 and told["not_checked"] == 2


def damaged_texture(run: Path) -> tuple[str, ...]:
    path = run / "asset" / "textures" / "ball_lower_half_albedo.png"
    path.write_bytes(path.read_bytes()[:-20])
    return "ball.json", "ball_lower_half_albedo.png has changed"


def cut_png(run: Path) -> tuple[str, ...]:
    path = run / "asset" / "textures" / "ball_lower_half_albedo.png"
    path.write_bytes(path.read_bytes()[:60])
    return "asset/textures/*.png", "Pillow"


def missing_file(run: Path) -> tuple[str, ...]:
    (run / "delivered" / "blender" / "ball.obj").unlink()
    return "ball.export.json", "ball.obj is missing"


def lost_usd_texture(run: Path) -> tuple[str, ...]:
    (run / "delivered" / "blender" / "textures" / "ball_lower_half_normal.png").unlink()
    return "ball.usda", "ball_lower_half_normal.png is not there"


def wrong_usd(run: Path) -> tuple[str, ...]:
    path = run / "delivered" / "blender" / "ball.usda"
    path.write_text(path.read_text().replace('kind = "component"', 'kind = "component"\n    displayName = 3', 1))
    return "ball.usda", "UsdValidation"


def wrong_materialx(run: Path) -> tuple[str, ...]:
    path = run / "delivered" / "blender" / "ball.mtlx"
    path.write_text(path.read_text().replace('<normalmap name="normal_in_world" type="vector3"', '<nothing name="normal_in_world" type="vector3"').replace("</normalmap>", "</nothing>"))  # fmt: skip # noqa: E501
    return "ball.mtlx", "has no definition"


def cut_list(run: Path) -> tuple[str, ...]:
    path = run / "asset" / "ball.json"
    path.write_bytes(path.read_bytes()[:200])
    return "asset/ball.json", "no JSON"


def broken_glb(run: Path) -> tuple[str, ...]:
    path = run / "asset" / "ball.glb"
    path.write_bytes(path.read_bytes()[:2000])
    return "asset/ball.glb", "trimesh"


def replaced(path: Path, old: str, new: str) -> None:
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))


def one_obj_material(run: Path) -> tuple[str, ...]:
    for ending in ("obj", "mtl"):
        replaced(run / "delivered" / "blender" / f"ball.{ending}", "upper_half\n", "lower_half\n")
    return "ball.obj", "1 materials on its faces, expected 2"


def shared_obj_map(run: Path) -> tuple[str, ...]:
    replaced(run / "delivered" / "blender" / "ball.mtl", "upper_half_albedo", "Lower_half_albedo")
    return "ball.obj", "ball_lower_half_albedo.png is several maps of lower_half and upper_half"


def one_usd_material(run: Path) -> tuple[str, ...]:
    replaced(run / "delivered" / "blender" / "ball.usda", "/Materials/upper_half>", "/Materials/lower_half>")
    return "ball.usda", "1 materials on its faces, expected 2"


def shared_usd_map(run: Path) -> tuple[str, ...]:
    replaced(run / "delivered" / "blender" / "ball.usda", "upper_half_roughness.png", "upper_half_metallic.png")
    return "ball.usda", "ball_upper_half_metallic.png is several maps of /ball/Materials/upper_half"


def one_materialx_surface(run: Path) -> tuple[str, ...]:
    path = run / "delivered" / "blender" / "ball.mtlx"
    text = path.read_text()
    start, end = text.index('<surfacematerial name="upper_half"'), text.rindex("</surfacematerial>")
    path.write_text(text[:start] + text[end + len("</surfacematerial>") :])
    return "ball.mtlx", "1 materials on its faces, expected 2"


def shared_materialx_map(run: Path) -> tuple[str, ...]:
    replaced(run / "delivered" / "blender" / "ball.mtlx", "upper_half_normal.png", "lower_half_normal.png")
    return "ball.mtlx", "ball_lower_half_normal.png is several maps of"


def one_glb_material(run: Path) -> tuple[str, ...]:
    path = run / "asset" / "ball.glb"
    path.write_bytes(path.read_bytes().replace(b'"material":1', b'"material":0'))
    return "asset/ball.glb", "1 materials on its faces, expected 2"


def shared_glb_map(run: Path) -> tuple[str, ...]:
    path = run / "asset" / "ball.glb"
    data = path.read_bytes()
    assert b'"baseColorTexture":{"index":3}' in data
    path.write_bytes(data.replace(b'"baseColorTexture":{"index":3}', b'"baseColorTexture":{"index":0}'))
    return "asset/ball.glb", "1 base colour images, expected 2"


def overwritten_map(run: Path) -> tuple[str, ...]:
    """A delivery of an older version, in which a second set has written over the first one's albedo."""
    path = run / "delivered" / "blender" / "ball.export.json"
    record = json.loads(path.read_text())
    record["files"] = [e for e in record["files"] if not e["file"].endswith("lower_half_albedo.png")]
    del record["sets"], record["maps"]
    path.write_text(json.dumps(record))
    return "ball.export.json", "ball_lower_half has no file for its albedo"


def twice_listed_map(run: Path) -> tuple[str, ...]:
    replaced(run / "asset" / "ball.json", "ball_upper_half_orm.png", "ball_lower_half_orm.png")
    return "asset/ball.json", "ball_lower_half_orm.png is orm of ball_lower_half and orm of ball_upper_half"


def lost_layer(run: Path) -> tuple[str, ...]:
    replaced(run / "delivered" / "blender" / "ball.usda", "upAxis =", "subLayers = [ @./gone.usda@ ]\n    upAxis =")
    return "ball.usda", "UsdValidation", "gone.usda"


@pytest.mark.parametrize(
    "spoil",
    [
        damaged_texture,
        cut_png,
        missing_file,
        lost_usd_texture,
        wrong_usd,
        wrong_materialx,
        cut_list,
        broken_glb,
        lost_layer,
    ],
)
def test_damage_is_found_and_ends_with_5(run, spoil, capfd):
    words = spoil(run)
    assert main(["verify", str(run), "--no-render"]) == 5
    told = json.loads((run / "verify" / "verify.json").read_text())
    assert "failed" in outcomes(told, *words), table(told)
    said = capfd.readouterr().err
    # USD's own words are in the rows only, not on stderr between them.
    assert "failed" in said and "Warning: in" not in said


@pytest.mark.parametrize(
    "spoil",
    [
        one_obj_material,
        shared_obj_map,
        one_usd_material,
        shared_usd_map,
        one_materialx_surface,
        shared_materialx_map,
        one_glb_material,
        shared_glb_map,
        overwritten_map,
        twice_listed_map,
    ],
)
def test_lost_materials_and_shared_maps_are_found(run, spoil):
    path, words = spoil(run)
    files = sorted(p for p in run.rglob("*") if p.is_file())
    rows = {r.file: r for r in surface_checks(files, lambda p: p.relative_to(run).as_posix())}
    (found,) = [r for name, r in rows.items() if name.endswith(path) and r.outcome == "failed"]
    assert words in found.said


def test_the_validator_finds_what_trimesh_lets_pass(run, monkeypatch):
    home = modules()
    if isinstance(home, str):
        pytest.skip(home)
    monkeypatch.setenv("NODE_PATH", str(home))
    path = run / "asset" / "ball.glb"
    path.write_bytes(path.read_bytes().replace(b'"mimeType":"image/png"', b'"mimeType":"image/xyz"'))
    rows = list(file_checks(path, [path], None))
    assert [r.outcome for r in rows if "validator" in r.check] == ["failed"]


def test_blender_is_asked_as_the_program_or_as_a_python(run, monkeypatch, tmp_path):
    assert blender_command("/x/bin/python", "s.py") == ["/x/bin/python", "s.py"]
    assert blender_command("/opt/blender-5/blender", "s.py")[-3:] == ["--python", "s.py", "--"]
    monkeypatch.setattr("mistyle.render.external.blender.which", lambda name: f"/usr/bin/{name}")
    assert find_blender(None, {}) == "/usr/bin/blender" and find_blender("p", {}) == "p"
    # A program that answers as our worker does: a mesh in the GLB, nothing in the OBJ, a missing image in the USD.
    program = tmp_path / "blender"
    program.write_text(
        "#!/usr/bin/env python3\nimport json, sys\npath = sys.argv[-1]\nfound = []\n"
        "for name in json.load(open(path))['files']:\n"
        "    empty, lost = name.endswith('obj'), ['skin.png'] if name.endswith('usda') else []\n"
        "    found.append({'meshes': int(not empty), 'triangles': 12 * (not empty), 'materials': 1, 'images': 1,\n"
        "                  'missing': lost})\n"
        "json.dump({'blender': '9.9', 'found': found}, open(path + '.done', 'w'))\n"
    )
    program.chmod(program.stat().st_mode | stat.S_IXUSR)
    told = verify(run, blender=str(program))
    assert outcomes(told, "ball.glb", "Blender 9.9") == {"passed"}
    assert outcomes(told, "ball.obj", "Blender 9.9", "no mesh") == {"failed"}
    assert outcomes(told, "ball.usda", "skin.png is missing") == {"failed"}
    gone = verify(run, blender=os.devnull)
    assert outcomes(gone, "ball.glb", "Blender") == {"failed"}


def test_assets_with_emission_or_alpha_are_not_compared_with_cycles(tmp_path, run):
    from tests.support.gltf_cases import strange_gltf

    path = strange_gltf(tmp_path / "strange.glb")
    told = verify(path, tmp_path / "out", blender=os.devnull, rendering=Rendering(1, 16, 1))
    assert outcomes(told, "Cycles against Mitsuba", "emission, transparency") == {"not checked"}


def test_the_figures_of_two_renders(rng):
    picture = np.zeros((32, 48, 4), np.float32)
    picture[4:28, 6:30, :3] = rng.uniform(0.1, 0.9, (24, 24, 3))
    picture[4:28, 6:30, 3] = 1
    same, error = compared("a", picture, picture)
    assert (same.flip, same.overlap, same.correlation, same.brightness) == (0, 1, pytest.approx(1), 1)
    assert error.shape == (32, 48)
    brighter = picture * np.array([1.2, 1.2, 1.2, 1], np.float32)
    found, _ = compared("a", picture, brighter)
    assert found.brightness == pytest.approx(1.2, rel=1e-4) and found.correlation == pytest.approx(1)
    turned, _ = compared("a", picture, np.ascontiguousarray(picture[:, ::-1]))
    assert turned.overlap < 0.5 and turned.flip > 0.15
    upside, _ = compared("a", picture, np.ascontiguousarray(picture[::-1]))
    assert upside.overlap == 1 and upside.correlation < 0.5


def test_what_cannot_be_verified_is_refused(tmp_path, run):
    with pytest.raises(InputRefused, match="found nothing"):
        verify(tmp_path / "gone")
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputRefused, match="none of our files"):
        verify(tmp_path / "empty")
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "verify.json").write_text("mine")
    with pytest.raises(UsageError, match="mistyle did not write this file"):
        verify(run, tmp_path / "mine")


@pytest.fixture
def batch(good, tmp_path) -> Path:
    """A batch folder of two finished jobs, one of which has an edited asset that was set aside."""
    folder = tmp_path / "batch"
    (folder / "shards").mkdir(parents=True)
    (folder / "plan.json").write_text("{}")
    for name in ("one", "two"):
        run = Path(shutil.copytree(good, folder / name))
        files = {p.relative_to(folder).as_posix(): sha256_file(p) for p in (run / "asset").rglob("*") if p.is_file()}
        (folder / "shards" / f"{name}.json").write_text(json.dumps({"name": name, "key": "k", "files": files}))
    aside = Path(shutil.copytree(good / "asset", folder / "one" / "asset.edited-1"))
    (aside / "textures" / "ball_skin_albedo.png").write_bytes(b"painted over")
    (aside / "done.json").write_text(json.dumps({"key": "k", "files": {"ball.glb": "0" * 64}}))
    (folder / "shards" / "three.failed.json").write_text(json.dumps({"name": "three", "exit_code": 1}))
    return folder


def test_a_healthy_batch_folder_passes(batch):
    told = verify(batch)
    assert told["failed"] == 0, table(told)
    assert outcomes(told, "shards/one.json", "sha256") == outcomes(told, "shards/two.json", "sha256") == {"passed"}
    assert outcomes(told, "two/asset/ball.glb", "trimesh") == {"passed"}
    assert not any("edited" in row["file"] for row in told["checks"])
    assert verify(batch / "one")["failed"] == 0 and verify(batch / "shards" / "one.json")["failed"] == 0
    assert verify(batch / "one" / "asset.edited-1")["failed"] > 0  # by its own name it is checked


def test_damage_in_a_batch_is_found(batch):
    (batch / "two" / "asset" / "ball.glb").unlink()
    told = verify(batch)
    assert outcomes(told, "shards/two.json") == {"failed"} and outcomes(told, "shards/one.json") == {"passed"}


def test_a_batch_is_exported_job_by_job(batch, tmp_path, capsys):
    assert main(["export", str(batch), "-o", str(tmp_path / "out")]) == 3
    told = capsys.readouterr().err
    assert "a batch folder with 2 finished assets" in told and f"for example {batch / 'one'}" in told
    assert not (tmp_path / "out").exists()


def test_an_earlier_version_may_have_fewer_sets_than_the_asset(run):
    listing = run / "delivered" / "blender" / "ball.export.json"
    record = json.loads(listing.read_text())
    first = record["sets"][0]
    record["sets"] = [first]
    record["files"] = [e for e in record["files"] if e.get("set", first) == first and not e["file"].endswith(".glb")]
    record["files"] = [e for e in record["files"] if not e["file"].endswith((".obj", ".usda", ".usdz", ".mtlx"))]
    listing.write_text(json.dumps(record))
    told = {c.file: c for c in surface_checks([run / "asset" / "ball.json", listing], str)}
    assert told[str(listing)].outcome == "passed" and "1 texture sets" in told[str(listing)].said
