"""What is offered for a fit, the files of a fitted scene, references with many channels, and the verb."""

import json

import numpy as np
import pytest

from mistyle.cli import main as cli
from mistyle.core.errors import InputRefused, Stopped, UsageError
from mistyle.fitting.pipeline.scene_references import choose_channels
from mistyle.io import scene_source
from mistyle.process import stopping
from mistyle.render.live import parameters as scene_keys
from mistyle.render.live import xml as scene_xml
from mistyle.render.mitsuba import device
from mistyle.solver.scene import fit as scene_fit
from mistyle.solver.scene import gradients as scene_grad

GREY = {"type": "rgb", "value": [0.5, 0.5, 0.5]}
DIFFUSE = {"type": "diffuse", "reflectance": GREY}


def lit(size=12, integrator=None, **more):
    """A sky and a camera, and what else is given."""
    import mitsuba as mi

    device.use()
    scene = {
        "type": "scene",
        "integrator": integrator or {"type": "path", "max_depth": 3},
        "sky": {"type": "constant", "radiance": {"type": "rgb", "value": [0.8, 0.8, 0.8]}},
        "cam": {
            "type": "perspective",
            "fov": 40,
            "to_world": mi.ScalarTransform4f().look_at([0, 0, 4], [0, 0, 0], [0, 1, 0]),
            "film": {
                "type": "hdrfilm",
                "width": size,
                "height": size,
                "pixel_format": "rgb",
                "rfilter": {"type": "box"},
            },
        },
    }
    return mi.load_dict(scene | more, optimize=False)


def wall(bsdf):
    return {"type": "rectangle", "bsdf": bsdf}


def offered(scene, engine=None):
    """Reason by name, of what is no geometry."""
    return {p.name: p.reason for p in scene_keys.parameters(scene, engine) if p.kind not in ("geometry", "other")}


MASK = {"type": "mask", "opacity": 0.5, "nested": {"type": "twosided", "bsdf": DIFFUSE}}
ROUGH = {"type": "roughconductor", "alpha": 0.3, "specular_reflectance": GREY}
BLEND = {"type": "blendbsdf", "weight": 0.5, "a": DIFFUSE}


@pytest.mark.parametrize(
    ("bsdf", "name", "free"),
    [
        (MASK, "wall.bsdf.opacity.value", False),
        (MASK, "wall.bsdf.nested_bsdf.brdf_0.reflectance.value", True),
        ({"type": "conductor", "specular_reflectance": GREY}, "wall.bsdf.specular_reflectance.value", False),
        (ROUGH, "wall.bsdf.specular_reflectance.value", True),
        (ROUGH, "wall.bsdf.alpha.value", True),
        ({"type": "plastic", "diffuse_reflectance": GREY}, "wall.bsdf.diffuse_reflectance.value", True),
        ({"type": "thindielectric", "specular_transmittance": GREY}, "wall.bsdf.specular_transmittance.value", False),
        (BLEND | {"b": {"type": "plastic"}}, "wall.bsdf.weight.value", False),
        (BLEND | {"b": ROUGH}, "wall.bsdf.weight.value", True),
    ],
)
def test_what_has_no_true_gradient_is_not_offered(bsdf, name, free):
    """Offered parameters have the gradient that finite differences give; of the others it is another, or none.

    Of a plastic's colour `prb` also counts mirrored light, some percent too much; the solution stays in its place.
    """
    import mitsuba as mi

    scene = lit(wall=wall(bsdf), light={"type": "point", "position": [0.5, 1, 3], "intensity": 5.0})
    reason = offered(scene)[name]
    assert (reason is None) == free
    p = next(p for p in scene_keys.parameters(scene) if p.name == name)
    table, engine, sensor = mi.traverse(scene), scene_grad.ad_integrator(scene)[0], scene.sensors()[0]
    table.properties = {p.key: table.properties[p.key]}
    values = {p.key: scene_grad.array(table[p.key], p)}
    ones = {p.key: np.ones(p.shape, np.float32)}
    ends = []
    for step in (0.02, -0.02):
        scene_grad.put(table, [p], {p.key: values[p.key] + np.float32(step)})
        ends.append(np.array(scene_grad.picture(scene, engine, sensor, 1024, 3))[..., :3].mean())
    difference = (ends[0] - ends[1]) / 0.04
    try:
        ours = scene_grad.derivative(
            scene_grad.LiveScene(scene, table, [p], engine), values, ones, sensor, 256, 4
        ).mean()
    except RuntimeError:
        ours = 0.0  # Mitsuba says itself that nothing is attached
    wrong = abs(ours - difference)
    assert wrong < 0.15 * abs(difference) if free else wrong > 0.5 * abs(difference)


def test_direct_has_gradients_of_a_mirrors_colour_and_of_no_mask():
    engine = {"type": "direct"}
    mirror = lit(integrator=engine, wall=wall({"type": "conductor", "specular_reflectance": GREY}))
    masked = lit(integrator=engine, wall=wall(MASK))
    assert offered(mirror, mirror.integrator())["wall.bsdf.specular_reflectance.value"] is None
    assert "probabilities of the lobes" in offered(masked, masked.integrator())["wall.bsdf.opacity.value"]


def mesh(attribute, bsdf):
    import mitsuba as mi

    device.use()
    props = mi.Properties()
    props["bsdf"] = mi.load_dict(bsdf)
    made = mi.Mesh("sheet", 4, 2, props=props)
    table = mi.traverse(made)
    table["vertex_positions"] = mi.Float([-1, -1, 0, 1, -1, 0, 1, 1, 0, -1, 1, 0])
    table["faces"] = mi.UInt32([0, 1, 2, 0, 2, 3])
    table.update()
    made.add_attribute(attribute, 3, [0.5] * 12)
    made.set_id("sheet")
    return made


def test_attributes_are_offered_where_a_material_reads_them_and_keep_its_range():
    read = {"type": "diffuse", "reflectance": {"type": "mesh_attribute", "name": "vertex_paint"}}
    scene = lit(sheet=mesh("vertex_paint", read))
    p = next(p for p in scene_keys.parameters(scene) if p.kind == "attribute")
    assert p.reason is None and scene_keys.limits(p) == (0.0, 1.0) and p.channels == 3
    other = lit(sheet=mesh("vertex_other", read | {"reflectance": GREY}))
    assert offered(other)["sheet.vertex_other"] == "no material of its shape reads vertex_other."
    with pytest.raises(UsageError, match="no material of its shape reads"):
        scene_fit.fit_scene(other, ["sheet.vertex_other"], None, [np.full((12, 12, 3), 0.5)])
    # A picture brighter than the sky: the colours would have to be above 1.
    bright = np.linspace(1.2, 1.4, 432).reshape(12, 12, 3)
    fitted = scene_fit.fit_scene(scene, ["sheet.vertex_paint"], None, [bright], iterations=60, rate=0.05, spp=2)
    assert 0.95 < fitted.values["sheet.vertex_paint"].max() <= 1


def test_what_nothing_uses_is_not_offered():
    scene = lit(wall=wall(DIFFUSE), spare={"type": "diffuse", "id": "spare", "reflectance": GREY})
    assert offered(scene)["spare.reflectance.value"] == "neither a shape nor a light uses it."


def test_a_scene_without_a_gradient_ends_in_a_sentence(monkeypatch):
    """Of what no camera sees Mitsuba says that nothing is attached, in a traceback of Dr.Jit's."""
    import mitsuba as mi

    behind = wall(DIFFUSE) | {"to_world": mi.ScalarTransform4f().translate([0, 0, 9])}
    scene = lit(behind=behind, integrator={"type": "prb", "max_depth": 3})
    picture = np.array(mi.render(scene, spp=4))

    def fails(*given):
        raise RuntimeError("dr.while_loop(): failed") from ValueError("it is not attached to the AD graph! Raising …")

    monkeypatch.setattr(scene_grad, "gradients", fails)
    with pytest.raises(InputRefused, match="no gradient reaches the chosen parameters"):
        scene_fit.fit_scene(scene, ["behind.bsdf.reflectance"], None, [picture], iterations=2, spp=2, solver="adam")
    monkeypatch.undo()
    fitted = scene_fit.fit_scene(scene, ["behind.bsdf.reflectance"], None, [picture], iterations=8, spp=2)
    assert any("never had a gradient" in note for note in fitted.notes)
    assert (fitted.values["behind.bsdf.reflectance.value"] == 0.5).all()


def test_a_request_to_stop_inside_mitsuba_stays_one(monkeypatch):
    """Dr.Jit wraps what a signal raises inside a loop."""
    monkeypatch.setattr(stopping, "_state", stopping._State(asked=15))
    with pytest.raises(Stopped), device.plain_errors("the scene was rendered"):
        raise RuntimeError("dr.while_loop(): encountered an exception") from Stopped("stopped on request")
    monkeypatch.undo()
    with pytest.raises(InputRefused, match="while the scene was rendered: out of memory"):
        with device.plain_errors("the scene was rendered"):
            raise RuntimeError("out of memory.")


HOUSE = """<scene version="3.0.0"><default name="size" value="12"/><default name="paint" value="paint"/>
<integrator type="path"><integer name="max_depth" value="3"/></integrator>
<sensor type="perspective" id="cam"><float name="fov" value="40"/>
<transform name="to_world"><lookat origin="0,0,4" target="0,0,0" up="0,1,0"/></transform>
<film type="hdrfilm"><integer name="width" value="$size"/><integer name="height" value="$size"/>
<string name="pixel_format" value="rgb"/><rfilter type="box"/></film></sensor>
<emitter type="constant" id="sky"><rgb name="radiance" value="$light"/></emitter>
<include filename="parts/$paint.xml"/>
<shape type="shapegroup" id="group"><shape type="sphere"><float name="radius" value="0.4"/>
<bsdf type="diffuse"><rgb name="reflectance" value="0.5"/></bsdf></shape></shape>
<shape type="instance"><ref id="group"/><transform name="to_world"><translate y="0.6"/></transform></shape>
<shape type="sphere" id="ball"><point name="center" x="-0.6" y="-0.5" z="0"/><float name="radius" value="0.4"/>
<ref id="paint"/></shape>
<shape type="ply" id="sheet"><string name="filename" value="sheet.ply"/><transform name="to_world">
<scale value="0.5"/><translate x="0.6" y="-0.5"/></transform>
<bsdf type="twosided"><bsdf type="diffuse"><texture type="mesh_attribute" name="reflectance">
<string name="name" value="vertex_color"/></texture></bsdf></bsdf></shape>
</scene>"""
PAINT = '<scene version="3.0.0"><bsdf type="diffuse" id="paint"><rgb name="reflectance" value="0.5"/></bsdf></scene>'
SHEET = """ply
format ascii 1.0
element vertex 4
property float x
property float y
property float z
property float r
property float g
property float b
element face 2
property list uchar int vertex_indices
end_header
-1 -1 0 .5 .5 .5
1 -1 0 .5 .5 .5
1 1 0 .5 .5 .5
-1 1 0 .5 .5 .5
3 0 1 2
3 0 2 3
"""


@pytest.fixture
def house(tmp_path):
    """A scene file with an include, an instance and a mesh whose colours are read; its folder."""
    folder = tmp_path / "in"
    (folder / "parts").mkdir(parents=True)
    (folder / "house.xml").write_text(HOUSE)
    (folder / "parts" / "paint.xml").write_text(PAINT)
    (folder / "sheet.ply").write_text(SHEET)
    return folder


def test_every_value_is_printed_and_written_where_mitsuba_finds_it(house, tmp_path, capsys):
    """In an included file, in a group of instances, in a mesh; on the console, in run.json, in the report."""
    import mitsuba as mi

    from mistyle.io.images.write import write_exr

    device.use()
    true = {"paint.reflectance.value": [0.2, 0.6, 0.3], "group.shape.bsdf.reflectance.value": [0.7, 0.3, 0.4]}
    scene = scene_xml.load_scene_for_fit(house / "house.xml", {"light": "1"}).scene
    table = mi.traverse(scene)
    for key, value in true.items():
        table[key] = mi.Color3f(value)
    table["sheet.vertex_color"] = mi.Float([0.1, 0.3, 0.5, 0.7] * 3)
    table.update()
    picture = np.array(mi.render(scene, spp=256))
    shots = tmp_path / "shots"
    shots.mkdir()
    # As an `aov` integrator names it, beside a depth.
    planes = {f"image.{c}": picture[..., k] for k, c in enumerate("RGB")} | {"dd.T": picture[..., 0]}
    write_exr(shots / "cam.exr", planes)
    words = ["fit", "--scene", house / "house.xml", "--references", shots, "-o", tmp_path / "out", "-D", "light=1"]
    words += ["--optimize", "*.reflectance", "sheet.vertex_color", "--iterations", "72", "--spp", "4"]
    assert cli.main([str(w) for w in words]) == 0
    told = capsys.readouterr().err
    record = json.loads((tmp_path / "out" / "run.json").read_text())
    page = (tmp_path / "out" / "report" / "index.html").read_text("utf-8")
    rows = {row["name"]: row for row in record["values"]}
    assert record["settings"]["spp"] == 4 and record["settings"]["loss"] == "auto"
    assert any("image.RGB are used" in note for note in record["notes"])
    assert any("is render noise" in note for note in record["notes"])
    shown = mi.traverse(mi.load_file(record["scene"], optimize=False))
    for key, value in true.items():
        assert np.allclose(rows[key]["start"], 0.5)
        assert np.allclose(rows[key]["fitted"], value, atol=0.05)
        assert np.allclose(np.array(shown[key]).ravel(), rows[key]["fitted"], rtol=1e-5)
        assert f"{key}: 0.5 0.5 0.5 →" in told and key in page
    assert rows["sheet.vertex_color"]["kind"] == "attribute" and "(mean)" in told
    found = np.array(shown["sheet.vertex_color"]).reshape(4, 3)
    assert np.allclose(found.mean(axis=0), rows["sheet.vertex_color"]["fitted"], rtol=1e-5)
    assert (tmp_path / "out" / "scene" / "house_sheet.vertex_color.ply").is_file()
    assert np.abs(np.array(mi.render(mi.load_file(record["scene"]), spp=64)) - picture).mean() < 0.02


def test_the_text_with_its_parameters_loads_as_the_file_with_them(house, tmp_path):
    """`converge -D`: also parameters without a default, and an include whose name is one."""
    import mitsuba as mi

    device.use()
    out = tmp_path / "copy" / "house.xml"
    out.parent.mkdir()
    out.write_bytes(scene_source.resolved(house / "house.xml", {"light": "0.25", "size": "8"}, out))
    ours = np.array(mi.render(mi.load_file(str(out)), spp=4, seed=1))
    assert np.allclose(
        ours, np.array(mi.render(mi.load_file(str(house / "house.xml"), light="0.25", size="8"), spp=4, seed=1))
    )
    assert ours.shape[:2] == (8, 8)
    (house / "broken.xml").write_text("<scene")
    with pytest.raises(InputRefused, match="not XML"):
        scene_source.resolved(house / "broken.xml", {}, out)


def test_converge_takes_the_scenes_parameters(house, tmp_path):
    words = ["converge", house / "house.xml", "--with", "mitsuba:path", "-o", tmp_path / "out", "-D", "light=1"]
    words += ["-D", "size=6", "--max-spp", "2", "--seeds", "2", "--reference-spp", "4"]
    assert cli.main([str(w) for w in words]) == 0
    assert json.loads((tmp_path / "out" / "converge.json").read_text())["scene"].endswith("house.xml")
    assert cli.main([str(w) for w in [*words[:6], "-D", "size"]]) == 2
    assert (
        cli.main(
            ["converge", str(house / "sheet.ply"), "--with", "mitsuba:path", "-o", str(tmp_path / "o"), "-D", "a=1"]
        )
        == 2
    )


RGB = ("R", "G", "B")


@pytest.mark.parametrize(
    ("names", "wanted", "found"),
    [
        ("R G B A", "", "R G B"),
        ("R G B image.R image.G image.B", "", "R G B"),
        ("image.R image.G image.B image.A dd.T nn.X nn.Y nn.Z", "", "image.R image.G image.B"),
        ("a.R a.G a.B m2_a.R m2_a.G m2_a.B", "", "a.R a.G a.B"),
        ("a.X a.Y a.Z m2_a.X m2_a.Y m2_a.Z", "", "a.X a.Y a.Z"),
        ("R G B a.R a.G a.B", "a", "a.R a.G a.B"),
        ("ch0 ch1 ch2 ch3", "ch0,ch1,ch2", "ch0 ch1 ch2"),
        ("a.R a.G a.B b.R b.G b.B", "", None),
        ("nn.X nn.Y nn.Z dd.T", "", None),
        ("R G B", "b", None),
        ("R G B", "R,G,Q", None),
    ],
)
def test_channels_of_a_reference(names, wanted, found, tmp_path):
    planes = dict.fromkeys(names.split(), np.zeros((2, 2), np.float32))
    if found is None:
        with pytest.raises(InputRefused, match="found channels .*expected"):
            choose_channels(tmp_path / "a.exr", planes, wanted)
        return
    chosen, notes = choose_channels(tmp_path / "a.exr", planes, wanted)
    assert chosen == tuple(found.split()) and bool(notes) == (not wanted and chosen != RGB)


def test_the_picture_inside_aov_and_moment_gives_the_integrator():
    inner = {"type": "path", "max_depth": 4, "hide_emitters": True}
    for outer in ({"type": "aov", "aovs": "dd:depth", "image": inner}, {"type": "moment", "image": inner}):
        engine, notes = scene_grad.ad_integrator(lit(integrator=outer, wall=wall(DIFFUSE)))
        assert "max_depth = 4" in str(engine) and engine.hide_emitters and "prb replaces it" in notes[0]
    held = {"type": "aov", "aovs": "dd:depth", "image": {"type": "prb", "max_depth": 3}}
    engine, notes = scene_grad.ad_integrator(lit(integrator=held, wall=wall(DIFFUSE)))
    assert "PRB" in str(engine) and "PRB" not in "".join(notes)[:0] and len(notes) == 1
