"""Renderers behind one call, look-dev lights that mean the same everywhere, and what is said of them."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest

from mistyle.cli.main import main
from mistyle.core.errors import EnvironmentMissing, InputRefused, UsageError
from mistyle.core.light import Ambient, Directional, Environment, environment_directions
from mistyle.core.paths import scenes
from mistyle.io.read import read_exr, read_radiance
from mistyle.io.read_mesh import read_mesh
from mistyle.render.external.render_files import Subject, write_asset_glb
from mistyle.render.external.renderers import features, left_out, renderer, shots, subject
from mistyle.render.lookdev import scenes as lookdev
from mistyle.render.mitsuba.draw import gbuffer
from tests.support.helpers import data

CORNER = """<scene version="3.9.0">
  <integrator type="path"><integer name="max_depth" value="4"/></integrator>
  <sensor type="perspective" id="front">
    <float name="fov" value="40"/>
    <transform name="to_world"><lookat origin="0,1,4" target="0,0.6,0" up="0,1,0"/></transform>
    <film type="hdrfilm"><integer name="width" value="24"/><integer name="height" value="20"/>
      <rfilter type="box"/></film>
  </sensor>
  <shape type="rectangle"><transform name="to_world"><scale value="2"/><rotate x="1" angle="-90"/></transform>
    <bsdf type="diffuse"><rgb name="reflectance" value="0.8, 0.3, 0.2"/></bsdf></shape>
  <shape type="rectangle"><transform name="to_world"><scale value="2"/><translate z="-1"/></transform>
    <bsdf type="diffuse"><rgb name="reflectance" value="0.7"/></bsdf></shape>
  <shape type="sphere"><point name="center" x="0.8" y="2.2" z="1"/><float name="radius" value="0.5"/>
    <emitter type="area"><rgb name="radiance" value="{light}"/></emitter></shape>
</scene>
"""


@pytest.fixture
def corner(tmp_path):
    path = tmp_path / "corner.xml"
    path.write_text(CORNER.replace("{light}", "6"))
    return path


@pytest.fixture(scope="module")
def demo(tmp_path_factory):
    """The demo mesh as a GLB of ours."""
    path = tmp_path_factory.mktemp("demo") / "demo.glb"
    write_asset_glb(path, read_mesh(scenes() / "demo.obj"))
    return path


def said(capsys, *words):
    code = main([*map(str, words), "--json"])
    out, err = capsys.readouterr()
    return code, json.loads(out) if out else {}, err


def test_names_of_renderers(tmp_path, monkeypatch):
    monkeypatch.delenv("MISTYLE_BLENDER_PYTHON", raising=False)
    for wrong in ("mitsuba", "cycles", "mitsuba:a b", "mine=render {scene}", "a b=x {scene} {out}"):
        with pytest.raises(UsageError, match="expected"):
            renderer(wrong)
    with pytest.raises(EnvironmentMissing, match="bpy"):
        renderer("blender:cycles")
    with pytest.raises(EnvironmentMissing, match="no python"):
        renderer(f"mitsuba@{tmp_path}:path")
    assert renderer("mine=render {scene} {out}").kind == "command"


def test_one_scene_by_its_own_mitsuba_by_another_and_by_a_command(corner, tmp_path):
    """The other environment is this one, in a process that knows nothing of mistyle: the same bytes."""
    command = tmp_path / "render.py"
    command.write_text(
        "import sys, numpy as np, OpenEXR\n"
        "rgb = np.full((20, 24, 3), int(sys.argv[3]) + 0.25 * int(sys.argv[4]), np.float32)\n"
        "assert sys.argv[1].endswith('corner.xml')\n"
        "OpenEXR.File({}, {'RGB': rgb}).write(sys.argv[2])\n"
    )
    texts = [
        "mitsuba:scene",
        f"mitsuba@{sys.prefix}:scene",
        f"mine={sys.executable} {command} {{scene}} {{out}} 7 {{spp}}",
    ]
    chosen = [renderer(text) for text in texts]
    what = subject(corner, tmp_path / "work", chosen)
    (shot,) = shots(what, ["studio"], 1, 64)
    assert shot.name == "front"
    own, other, mine = (how.draw(what, shot, 4, [5, 6]) for how in chosen)
    assert own.pictures[0].shape == (20, 24, 3) and len(other.seconds) == 2
    for a, b in zip(own.pictures, other.pictures, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-6)
    assert np.abs(own.pictures[0] - own.pictures[1]).max() > 0.01
    assert (mine.pictures[0] == 8).all()


def test_compare_finds_that_direct_light_is_not_all_light(corner, tmp_path, capsys):
    words = (
        "compare",
        "--render",
        corner,
        "--with",
        "mitsuba:path",
        "--with",
        "mitsuba:path",
        "--with",
        "mitsuba:direct",
    )
    out = tmp_path / "out"
    code, record, _ = said(capsys, *words, "-o", out, "--spp", 16, "--seeds", 6)
    assert code == 0
    same, different = (f["text"] for f in record["figures"])
    assert same.startswith("same picture at 1 %") and different.startswith("different in ")
    assert (out / "ztest" / "001.webp").is_file() and record["reference"] == "corner.xml by mitsuba:path"
    first, second = (row["values"] for row in record["rows"] if row["layer"] == "beauty")
    assert first["relmse"] < 0.5 * second["relmse"]
    kept = {p.name for p in (out / "renders").iterdir()}
    assert kept == {"0_mitsuba_path", "1_mitsuba_path", "2_mitsuba_direct"}
    assert said(capsys, *words, "-o", out, "--spp", 4, "--seeds", 2, "--max", "relmse=1e-9")[0] == 5


def test_converge_finds_the_monte_carlo_slope(corner, tmp_path, capsys):
    words = ("converge", corner, "--with", "mitsuba:path,mitsuba:direct", "-o", tmp_path / "out")
    code, record, _ = said(capsys, *words, "--max-spp", 32, "--seeds", 3, "--reference-spp", 2048)
    assert code == 0
    path, direct = record["curves"]
    # Variance falls with 1 / N; an integrator that converges to another picture levels off.
    assert path["slope"]["relmse"][0] == pytest.approx(-1, abs=0.15) and path["slope"]["relmse"][1] < 0.2
    assert direct["slope"]["relmse"][0] > path["slope"]["relmse"][0] + 0.1
    assert path["spp"] == [1, 2, 4, 8, 16, 32] and len(path["flip"]) == 6
    assert set(record["efficiency"]) == {"mitsuba:direct"} and record["efficiency"]["mitsuba:direct"]["ratio"] < 1
    page = (tmp_path / "out" / "index.html").read_text()
    assert page.count("<polyline") == 12 and "<script" not in page
    lines = (tmp_path / "out" / "converge.csv").read_text().splitlines()
    assert len(lines) == 1 + 2 * 6 * 3


def test_an_asset_of_ours_is_a_run_folder(demo, tmp_path):
    (tmp_path / "asset").mkdir()
    with pytest.raises(InputRefused, match="found 0 .glb files"):
        subject(tmp_path, tmp_path / "work", [])
    (tmp_path / "asset" / "chair.glb").write_bytes(demo.read_bytes())
    found = subject(tmp_path, tmp_path / "work", [])
    assert found.path.name == "chair.glb" and left_out(found) == []
    helmet = data("meshes/pbr/DamagedHelmet/DamagedHelmet.glb")
    assert features(Subject(helmet, tmp_path)) == ["emission"] and left_out(Subject(helmet, tmp_path)) == []
    assert left_out(Subject(helmet, tmp_path, export=True)) == ["emission"]


def test_a_scene_file_is_not_for_cycles(corner, tmp_path):
    with pytest.raises(UsageError, match="no Mitsuba scenes"):
        subject(corner, tmp_path, [renderer("blender:cycles", "python")])


def test_the_asset_is_lit_by_what_the_rigs_say(demo, tmp_path):
    chosen = [renderer("mitsuba:path")]
    what = subject(demo, tmp_path, chosen)
    found = {s.name: s for s in shots(what, ["studio", "key", "grazing"], 1, 24)}
    assert set(found) == {"studio", "key", "grazing"}
    pictures = {name: chosen[0].draw(what, shot, 16, [1]).pictures[0] for name, shot in found.items()}
    for picture in pictures.values():
        assert picture.shape == (24, 24, 4) and 0.2 < picture[..., 3].mean() < 0.9
        assert (picture[..., :3][picture[..., 3] == 0] == 0).all()
    # What faces the hard light is bright, what turns away from it has the weak light from everywhere.
    for name in ("key", "grazing"):
        sun = next(x for x in found[name].lights if isinstance(x, Directional))
        hits = gbuffer(what.asset.mesh, found[name].camera)
        facing = np.where(hits.mask, hits.normal @ np.array(sun.direction, np.float32), np.nan)
        bright = pictures[name][..., :3].mean(axis=-1)
        assert bright[facing > 0.6].mean() > 2 * bright[facing < -0.2].mean() > 0
    four = shots(what, ["key"], 4, 24)
    assert [s.name for s in four] == ["key_0", "key_1", "key_2", "key_3"]
    np.testing.assert_allclose([np.linalg.norm(s.camera.position) for s in four], 4)


def test_exported_scene_of_an_asset_renders_where_only_mitsuba_is(demo, tmp_path):
    """Every Mitsuba reads the same file when another one takes part."""
    chosen = [renderer("mitsuba:path"), renderer(f"mitsuba@{sys.prefix}:path")]
    what = subject(demo, tmp_path, chosen)
    (shot,) = shots(what, ["key"], 1, 24)
    own, other = (how.draw(what, shot, 4, [3]).pictures[0] for how in chosen)
    np.testing.assert_allclose(own, other, rtol=1e-4, atol=1e-5)
    assert 0.2 < own[..., 3].mean() < 0.9


def test_blenders_sky_shows_each_direction_where_cycles_looks_for_it():
    """Cycles: u = 0.5 - atan2(y, x) / 2π, Z up; the glTF importer takes (x, y, z) to (x, -z, y)."""
    directions = environment_directions(64, 128)
    for towards, u, v in (
        ((1, 0, 0), 0.5, 0.5),
        ((0, 0, 1), 0.75, 0.5),
        ((0, 0, -1), 0.25, 0.5),
        ((0, 1, 0), None, 1.0),
    ):
        spot = np.exp(60 * (directions @ np.array(towards, float) - 1))[..., None] * np.ones(3)
        sky = lookdev.blender_environment([Environment(spot.astype(np.float32))])[..., 0]
        row, column = np.unravel_index(sky.argmax(), sky.shape)
        assert 1 - (row + 0.5) / sky.shape[0] == pytest.approx(v, abs=0.02)
        assert u is None or (column + 0.5) / sky.shape[1] == pytest.approx(u, abs=0.02)
    assert (lookdev.blender_environment([Ambient((1, 2, 3)), Directional((0, 1, 0), (9, 9, 9))]) == [1, 2, 3]).all()


def test_studio_is_the_studio_of_the_reports():
    (light,) = lookdev.light_rig("studio", read_radiance)
    planes = read_exr(scenes() / "studio_lights.exr")
    assert np.array_equal(light.radiance, np.stack([planes[c] for c in "RGB"], axis=-1))
    (file,) = lookdev.light_rig(str(scenes() / "studio_lights.exr"), read_radiance)
    assert np.array_equal(file.radiance, light.radiance)
    assert Path(lookdev.CYCLES_WORKER).is_file() and Path(lookdev.MITSUBA_WORKER).is_file()
