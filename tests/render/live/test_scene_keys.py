"""The parameters of a scene by name: aliases, reasons why one cannot be fitted, globs, ranges, scene files."""

import numpy as np
import pytest

from mistyle.core.errors import InputRefused, UsageError
from mistyle.io.images.write import write_exr, write_png
from mistyle.render.live import parameters as scene_keys
from mistyle.render.live import xml as scene_xml
from mistyle.render.mitsuba import device

SCENE = """<?xml version="1.0" encoding="utf-8"?>
<!-- the user's own words -->
<scene version="3.0.0">
  <default name="size" value="16"/>
  <integrator type="path"><integer name="max_depth" value="2"/></integrator>
  <sensor type="perspective" id="cam">
    <transform name="to_world"><lookat origin="0,1,4" target="0,0,0" up="0,1,0"/></transform>
    <film type="hdrfilm"><integer name="width" value="$size"/><integer name="height" value="$size"/>
      <string name="pixel_format" value="rgb"/><rfilter type="box"/></film>
  </sensor>
  <emitter type="envmap" id="sky"><string name="filename" value="sky.exr"/></emitter>
  <emitter type="directional"><vector name="direction" x="0" y="-1" z="-1"/></emitter>
  <texture type="bitmap" id="grain"><string name="filename" value="grain.png"/></texture>
  <bsdf type="principled" id="wood">
    <ref id="grain" name="base_color"/>
    <texture type="bitmap" name="roughness"><string name="filename" value="rough.exr"/>
      <boolean name="raw" value="true"/></texture>
  </bsdf>
  <shape type="sphere" id="chair"><ref id="wood"/></shape>
  <shape type="rectangle" id="wall"><transform name="to_world"><scale value="2"/><translate z="-2"/></transform>
    <bsdf type="twosided"><bsdf type="principled"><float name="roughness" value="0.5"/>
      <rgb name="base_color" value="0.2,0.3,0.4"/></bsdf></bsdf></shape>
  <shape type="sphere" id="mirror"><point name="center" x="3" y="0" z="0"/>
    <bsdf type="principled"><float name="roughness" value="0.01"/></bsdf></shape>
  <shape type="disk"><transform name="to_world"><translate x="1" z="-1"/></transform>
    <bsdf type="normalmap"><texture type="bitmap" name="normalmap"><string name="filename" value="bumps.png"/>
      <boolean name="raw" value="true"/></texture><bsdf type="diffuse"/></bsdf></shape>
</scene>"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    device.use()
    place = tmp_path_factory.mktemp("scene")
    rng = np.random.default_rng(0)
    write_png(place / "grain.png", rng.random((8, 8, 3)))
    bumps = np.stack([*rng.uniform(-0.3, 0.3, (2, 8, 8)), np.ones((8, 8))], axis=-1)
    write_png(place / "bumps.png", bumps / np.linalg.norm(bumps, axis=-1, keepdims=True) / 2 + 0.5, 16)
    write_exr(place / "rough.exr", {"Y": rng.uniform(0.02, 0.9, (8, 8))})
    write_exr(place / "sky.exr", {c: rng.uniform(0.1, 1, (4, 8)) for c in "RGB"})
    (place / "scene.xml").write_text(SCENE, encoding="utf-8")
    return place


@pytest.fixture(scope="module")
def plain(folder):
    """The scene as Mitsuba itself loads it."""
    import mitsuba as mi

    return mi.load_file(str(folder / "scene.xml"), optimize=False)


@pytest.fixture(scope="module")
def loaded(folder):
    return scene_xml.load_scene_for_fit(folder / "scene.xml", {"size": 20})


def named(listed):
    return {name: p for p in listed for name in p.names}


def test_every_key_of_the_scene_is_listed(plain):
    import mitsuba as mi

    listed = scene_keys.parameters(plain)
    assert [p.key for p in listed] == list(mi.traverse(plain).keys())


def test_a_shared_texture_is_known_by_every_user(plain):
    p = named(scene_keys.parameters(plain))["chair.bsdf.base_color.data"]
    assert p.key.startswith("object_")
    assert p.name == "wood.base_color.data"
    assert (p.owner, p.role, p.shape, p.storage) == ("Principled", "base_color", (8, 8, 3), "uint8")
    assert not any("object_" in name for name in p.names)


@pytest.mark.parametrize(
    ("key", "reason"),
    [
        ("chair.bsdf.base_color.data", '<string name="format" value="variant"/>'),
        ("mirror.bsdf.roughness.value", "gradient of exactly zero"),
        ("chair.to_world", "geometry"),
        ("cam.x_fov", "camera"),
        ("wood.base_color.to_uv", "not an array of real numbers"),
        ("wall.bsdf.brdf_0.roughness.value", None),
        ("wood.roughness.data", None),
        ("wall.bsdf.base_color.value", None),
    ],
)
def test_reasons(plain, key, reason):
    found = named(scene_keys.parameters(plain))[key].reason
    assert (found is None) if reason is None else (reason in found)


def test_float16_and_what_lies_below_the_floor_are_noted(plain):
    listed = named(scene_keys.parameters(plain))
    (bumps,) = {p for p in listed.values() if p.role == "normalmap" and p.kind == "texture"}
    assert bumps.storage == "float16" and any("16 bits" in note for note in bumps.notes)
    assert any("below 0.04" in note for note in listed["wood.roughness.data"].notes)


@pytest.mark.parametrize(
    ("patterns", "keys"),
    [
        (["chair.*.base_color"], ["wood.base_color.data"]),
        (["chair.*.base_color.data"], ["wood.base_color.data"]),
        (["wall.bsdf.roughness"], ["wall.bsdf.brdf_0.roughness.value"]),
        (["wall*base_color", "*.base_color"], ["wood.base_color.data", "wall.bsdf.brdf_0.base_color.value"]),
        (["disk1.bsdf.normalmap"], ["disk1.bsdf.normalmap.data"]),
    ],
)
def test_globs(loaded, patterns, keys):
    found = [p.key for p in scene_keys.match(loaded.scene, patterns)]
    assert set(keys) <= set(found)
    if len(patterns) == 1:
        assert found == keys


def test_an_unknown_pattern_names_the_nearest_keys(loaded):
    with pytest.raises(UsageError, match=r"'wall.bsdf.ruoghness' matches no parameter.*wall.bsdf.roughness"):
        scene_keys.match(loaded.scene, ["wall.bsdf.ruoghness"])


def test_a_pattern_for_what_cannot_move_says_why(plain, loaded):
    with pytest.raises(UsageError, match="8 bits"):
        scene_keys.match(plain, ["chair.*.base_color"])
    with pytest.raises(UsageError, match="geometry"):
        scene_keys.match(loaded.scene, ["chair.to_world"])
    with pytest.raises(UsageError, match="literal, one value for the whole surface"):
        scene_keys.match(loaded.scene, ["wall.bsdf.roughness.data"])
    with pytest.raises(UsageError, match="no parameter to optimise"):
        scene_keys.match(loaded.scene, [])


def test_values_are_brought_into_their_ranges(loaded, rng):
    listed = named(scene_keys.parameters(loaded.scene))
    wild = rng.normal(0, 2, (8, 8, 3)).astype(np.float32)
    colour = scene_keys.project(listed["wood.base_color.data"], wild)
    assert colour.min() == 0 and colour.max() == 1
    assert scene_keys.project(listed["wood.roughness.data"], wild).min() == np.float32(0.04)
    assert scene_keys.limits(listed["sky.data"]) == (0, np.inf)
    normal = scene_keys.project(listed["disk1.bsdf.normalmap.data"], wild) * 2 - 1
    assert np.allclose(np.linalg.norm(normal, axis=-1), 1, atol=1e-5)
    assert np.linalg.norm(normal[..., :2], axis=-1).max() < 0.951 and normal[..., 2].min() > 0


def test_loading_for_a_fit_keeps_the_picture(folder, loaded):
    import mitsuba as mi

    assert [note.split(" were")[0] for note in loaded.notes] == ["3 bitmaps"]
    mine = np.array(mi.render(loaded.scene, spp=4, seed=1))
    theirs = np.array(mi.render(mi.load_file(str(folder / "scene.xml"), size="20"), spp=4, seed=1))
    assert mine.shape == (20, 20, 3)
    assert np.abs(mine - theirs).max() < 1e-3  # the normal map has 16 bits, which Mitsuba rounds to half floats
    listed = named(scene_keys.parameters(loaded.scene))
    assert listed["wood.base_color.data"].storage == listed["disk1.bsdf.normalmap.data"].storage == "float32"


def test_a_scene_with_exr_files_loads_with_one_thread(folder):
    import drjit as dr

    before = dr.thread_count()
    dr.set_thread_count(1)
    try:
        assert scene_xml.load_scene_for_fit(folder / "scene.xml").scene is not None
        assert dr.thread_count() == 1
    finally:
        dr.set_thread_count(before)


def test_a_file_that_is_no_scene_is_refused(folder, tmp_path):
    with pytest.raises(InputRefused, match="no such scene file"):
        scene_xml.load_scene_for_fit(tmp_path / "none.xml")
    (tmp_path / "bad.xml").write_text('<scene version="3.0.0"><shape type="nothing"/></scene>', encoding="utf-8")
    with pytest.raises(InputRefused, match="Mitsuba cannot load this scene"):
        scene_xml.load_scene_for_fit(tmp_path / "bad.xml")
    (tmp_path / "open.xml").write_text('<scene version="3.0.0"><integer name="x" value="$spp"/></scene>')
    with pytest.raises(InputRefused, match="-D spp=VALUE"):
        scene_xml.load_scene_for_fit(tmp_path / "open.xml")
    with pytest.raises(InputRefused, match="unused"):
        scene_xml.load_scene_for_fit(folder / "scene.xml", {"sise": 3})


def test_where_direct_light_needs_no_monte_carlo(loaded):
    import mitsuba as mi

    lamp = {"type": "point", "position": [0, 0, 3]}
    ball = {"type": "sphere", "bsdf": {"type": "twosided", "bsdf": {"type": "principled"}}}
    plate = {"type": "disk", "bsdf": {"type": "diffuse"}}
    scene = {"type": "scene", "ball": ball, "plate": plate, "lamp": lamp}
    direct, deep = ({"type": "prb", "max_depth": depth} for depth in (2, 3))
    found = scene_keys.fast_shapes(mi.load_dict(scene | {"integrator": direct}))
    assert found["ball"] is None and "SmoothDiffuse" in found["plate"]
    assert "renders indirect light" in scene_keys.fast_shapes(mi.load_dict(scene | {"integrator": deep}))["ball"]
    assert "EnvironmentMapEmitter" in scene_keys.fast_shapes(loaded.scene)["wall"]
