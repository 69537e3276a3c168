"""Fitted values in a written scene file: every plugin reads back the numbers that `mi.traverse` had."""

from types import SimpleNamespace

import numpy as np
import pytest

from mistyle.io.images.write import write_exr
from mistyle.render.live import parameters as scene_keys
from mistyle.render.live import xml as scene_xml
from mistyle.render.mitsuba import device
from mistyle.solver.scene import gradients as scene_grad

SCENE = """<scene version="3.0.0"><default name="n" value="1.2"/>
<integrator type="volpath"><integer name="max_depth" value="3"/></integrator>
<sensor type="perspective"><film type="hdrfilm"><integer name="width" value="4"/><integer name="height" value="4"/>
</film></sensor>
{}</scene>"""
BSDFS = {
    "roughplastic": '<bsdf type="roughplastic" id="x"/>',
    "roughplastic in water": '<bsdf type="roughplastic" id="x"><string name="ext_ior" value="water"/></bsdf>',
    "roughdielectric": '<bsdf type="roughdielectric" id="x"><string name="int_ior" value="bk7"/>'
    '<float name="ext_ior" value="$n"/></bsdf>',
    "roughdielectric, two alphas": '<bsdf type="roughdielectric" id="x"><float name="int_ior" value="1.7"/>'
    '<float name="alpha_u" value="0.2"/><float name="alpha_v" value="0.3"/></bsdf>',
    "thindielectric": '<bsdf type="thindielectric" id="x"/>',
    "pplastic": '<bsdf type="pplastic" id="x"><float name="alpha" value="0.2"/></bsdf>',
    "plastic": '<bsdf type="plastic" id="x"/>',
    "hair": '<bsdf type="hair" id="x"><rgb name="sigma_a" value="0.2,0.3,0.4"/></bsdf>',
    "conductor": '<bsdf type="conductor" id="x"><string name="material" value="Au"/></bsdf>',
    "conductor, by numbers": '<bsdf type="conductor" id="x"><rgb name="eta" value="2 1 3"/></bsdf>',
    "roughconductor": '<bsdf type="roughconductor" id="x"><string name="material" value="Cu"/>'
    '<rgb name="specular_reflectance" value="0.9"/></bsdf>',
    "roughconductor, none": '<bsdf type="roughconductor" id="x"/>',
    "principled": '<bsdf type="principled" id="x"/>',
    "principled by eta": '<bsdf type="principled" id="x"><float name="eta" value="1.4"/>'
    '<float name="spec_trans" value="0.4"/></bsdf>',
    "principledthin": '<bsdf type="principledthin" id="x"/>',
    "blendbsdf": '<bsdf type="blendbsdf" id="x"><float name="weight" value="0.3"/><bsdf type="diffuse"/>'
    '<bsdf type="roughconductor"><string name="material" value="Cu"/></bsdf></bsdf>',
    "mask": '<bsdf type="mask" id="x"><bsdf type="twosided"><bsdf type="roughplastic"/></bsdf></bsdf>',
    "bumpmap": '<bsdf type="bumpmap" id="x"><texture type="checkerboard"/><bsdf type="diffuse"/></bsdf>',
    "polarizer": '<bsdf type="polarizer" id="x"/>',
    "retarder": '<bsdf type="retarder" id="x"/>',
    "circular": '<bsdf type="circular" id="x"/>',
}
OTHERS = {
    "d65": '<emitter type="constant" id="x"><spectrum type="d65" name="radiance"><float name="scale" value="3"/>'
    "</spectrum></emitter>",
    "spectrum": '<emitter type="constant" id="x"><spectrum name="radiance" value="400:1,500:2,700:3"/></emitter>',
    "spot": '<emitter type="spot" id="x"><float name="cutoff_angle" value="30"/></emitter>',
    "projector": '<emitter type="projector" id="x"><texture type="checkerboard" name="irradiance"/></emitter>',
    "point": '<emitter type="point" id="x"/>',
    "directional": '<emitter type="directional" id="x"><vector name="direction" x="0" y="0" z="1"/></emitter>',
    "area": '<shape type="sphere" id="x"><bsdf type="diffuse"/><emitter type="area"/></shape>',
    "medium": '<shape type="sphere" id="x"><bsdf type="null"/><medium type="homogeneous" name="interior">'
    '<rgb name="albedo" value="0.2,0.3,0.4"/><phase type="hg"><float name="g" value="0.2"/></phase></medium></shape>',
    "volume": '<shape type="sphere" id="x"><bsdf type="null"/><medium type="heterogeneous" name="exterior">'
    '<volume name="albedo" type="constvolume"><rgb name="value" value="0.2 0.3 0.4"/></volume><phase type="blendphase">'
    '<float name="weight" value="0.3"/><phase type="hg"/><phase type="tabphase">'
    '<string name="values" value="0.1,0.2,0.3,0.2"/></phase></phase></medium></shape>',
}


def moved(p, value):
    """Other values of a parameter, inside its range."""
    low, high = scene_keys.limits(p) or (0, np.inf)
    value = np.array(value, np.float32).reshape(p.shape)
    return np.clip(value * 0.9 + np.float32(0.03), low + 0.01, high - 0.01).astype(np.float32)


def written(folder, text, without="", only=""):
    """Load a scene, change numbers (all but one, or one), write it; the result, live table and parameters."""
    import mitsuba as mi

    device.use()
    (folder / "scene.xml").write_text(SCENE.format(text), "utf-8")
    loaded = scene_xml.load_scene_for_fit(folder / "scene.xml")
    table = mi.traverse(loaded.scene)
    chosen = [p for p in scene_keys.parameters(loaded.scene) if p.kind == "value" and p.name != without]
    chosen = [p for p in chosen if only in ("", p.name)]
    chosen = [p for p in chosen if p.reason is None or "gradient" in p.reason]
    values = {p.key: moved(p, table[p.key]) for p in chosen}
    scene_grad.put(table, chosen, values)
    fitted = SimpleNamespace(parameters=chosen, values=values)
    return scene_xml.write_scene(folder / "out" / "new.xml", loaded, fitted, write_exr), table, chosen


@pytest.mark.parametrize("name", [*BSDFS, *OTHERS])
def test_every_plugin_reads_what_was_fitted(tmp_path, name):
    import mitsuba as mi

    text = OTHERS.get(name) or BSDFS[name] + '<shape type="sphere" id="s"><ref id="x"/></shape>'
    # Pigments exclude an absorption, and a spot light's texture is a bitmap.
    result, live, chosen = written(tmp_path, text, {"spot": "x.texture.value"}.get(name, ""))
    left_out = [note.split()[0] for note in result.notes if "is not in" in note]
    assert chosen and result.xml is not None and left_out == ["x.eumelanin", "x.pheomelanin"] * (name == "hair")
    again = mi.traverse(mi.load_file(str(result.xml), optimize=False))
    for p in chosen:
        ours, theirs = (np.array(table[p.key]).ravel() for table in (live, again))
        assert p.name in left_out or np.allclose(ours, theirs, rtol=1e-5, atol=1e-7), p.key


def test_a_scene_that_holds_no_fitted_value_is_not_kept(tmp_path):
    text = '<emitter type="constant" id="y"/><shape type="sphere" id="x"/>'
    result, _, chosen = written(tmp_path, text, "y.radiance.value")
    assert [p.name for p in chosen] == ["x.bsdf.reflectance.value"] and result.xml is None
    assert "x.bsdf.reflectance.value is not in new.xml" in result.notes[0] and not any((tmp_path / "out").iterdir())


def test_a_lone_value_that_mitsuba_does_not_read_leaves_no_file(tmp_path):
    text = BSDFS["hair"] + '<shape type="sphere" id="s"><ref id="x"/></shape>'
    result, _, _ = written(tmp_path, text, only="x.eumelanin")
    assert result.xml is None and "x.eumelanin is not in new.xml: Mitsuba does not load" in result.notes[0]
    assert not any((tmp_path / "out").iterdir())
