"""Colour spaces at the edges: matrices against the standards' own numbers, tags, names that do not exist."""

import copy
import json
import os
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
from PIL import Image

from mistyle.core.capture import Captures
from mistyle.core.errors import UsageError
from mistyle.core.image import linear_from_srgb, srgb_from_linear
from mistyle.core.light import Directional, Environment
from mistyle.deliver.asset import write_asset
from mistyle.deliver.colour import in_working_space, key_of, read_style
from mistyle.deliver.export import DeliveryRequest, export
from mistyle.io.images.write import write_exr
from mistyle.jobs.deliver_settings import ColourSettings
from tests.support.gltf_cases import no_texels, quad, quarters

pytest.importorskip("PyOpenColorIO")
from mistyle.io.images.ocio import KNOWN, colour_space, exr_tags

CONFIG = "ocio://cg-config-v1.0.0_aces-v1.3_ocio-v2.1"
# ACEScg (AP1, D60) from linear Rec.709 (D65), adapted by Bradford's transform as the ACES configs have it.
AP1_FROM_REC709 = np.array(
    [
        [0.6130974, 0.3395231, 0.0473795],
        [0.0701937, 0.9163539, 0.0134524],
        [0.0206156, 0.1095698, 0.8698147],
    ]
)


def test_acescg_is_the_published_matrix(rng):
    space = colour_space("ACEScg", CONFIG)
    rgb = rng.uniform(0, 4, (7, 5, 3)).astype(np.float32)
    converted = space.from_working(rgb)
    np.testing.assert_allclose(converted, rgb @ AP1_FROM_REC709.T, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(space.to_working(converted), rgb, rtol=1e-5, atol=1e-5)
    # Grey stays grey, and the argument stays as it was.
    np.testing.assert_allclose(space.from_working(np.full((1, 3), 0.18, np.float32)), 0.18, rtol=1e-4)


def test_names_aliases_and_roles_mean_one_space():
    for name in ("ACEScg", "acescg", "lin_ap1", "scene_linear"):
        assert colour_space(name, CONFIG).name == "ACEScg"
    assert colour_space("lin_rec709", CONFIG).interop == "lin_rec709_scene"
    assert colour_space("ACEScg", None).interop == "lin_ap1_scene"  # opencolorio's own config


@pytest.mark.parametrize("interop", sorted(KNOWN))
def test_chromaticities_are_those_of_the_conversion(interop):
    """The tagged primaries and whites, by SMPTE RP 177 and Bradford's adaptation, give the config's own matrix."""
    from mistyle.io.images.write import REC709_CHROMATICITIES

    bradford = np.array([[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]])

    def xyz_from(chromaticities):
        xy = np.array(chromaticities).reshape(4, 2)
        xyz = np.concatenate([xy, 1 - xy.sum(1, keepdims=True)], 1)
        white = xyz[3] / xyz[3, 1]
        return xyz[:3].T * np.linalg.solve(xyz[:3].T, white), bradford @ white

    name, chromaticities = KNOWN[interop]
    (there, white), (home, d65) = xyz_from(chromaticities), xyz_from(REC709_CHROMATICITIES)
    adapted = np.linalg.solve(bradford, np.diag(d65 / white) @ bradford @ there)
    found = colour_space(name, CONFIG).to_working(np.eye(3, dtype=np.float32)).T
    np.testing.assert_allclose(np.linalg.solve(home, adapted), found, atol=1e-3)


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("acesg", r"no such space; did you mean 'ACEScg'"),
        ("lin_rec_709", r"did you mean .*'Linear Rec.709 \(sRGB\)'"),
        ("zzzz", r"linear ones are 'ACES2065-1', 'ACEScg'"),
        ("Raw", "holds data"),
        ("sRGB - Texture", "not linear"),
    ],
)
def test_unknown_and_unsuited_spaces_are_refused_with_names(name, words):
    with pytest.raises(UsageError, match=words):
        colour_space(name, CONFIG)


def test_a_config_that_is_none(tmp_path):
    with pytest.raises(UsageError, match="not an OpenColorIO config"):
        colour_space("ACEScg", str(tmp_path / "none.ocio"))
    (tmp_path / "odd.ocio").write_text("rubbish")
    with pytest.raises(UsageError, match="not an OpenColorIO config"):
        colour_space("ACEScg", str(tmp_path / "odd.ocio"))


def test_a_studio_config_of_its_own(tmp_path):
    """A file with one linear space of other primaries, which no standard names."""
    import PyOpenColorIO as ocio

    config = copy.deepcopy(ocio.Config.CreateFromBuiltinConfig(CONFIG.removeprefix("ocio://")))
    made = ocio.ColorSpace(ocio.REFERENCE_SPACE_SCENE, "Show Linear", aliases=["show"])
    made.setTransform(
        ocio.MatrixTransform([2, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]), ocio.COLORSPACE_DIR_TO_REFERENCE
    )
    config.addColorSpace(made)
    path = tmp_path / "show.ocio"
    path.write_text(config.serialize())
    space = colour_space("show", str(path))
    assert space.interop == "" and exr_tags(space) == {
        "colorInteropID": "unknown",
        "mistyle:colorspace": "Show Linear",
    }
    rgb = np.array([[0.2, 0.4, 0.6]], np.float32)
    np.testing.assert_allclose(space.to_working(space.from_working(rgb)), rgb, atol=1e-5)
    before = key_of(ColourSettings(space="show", config=str(path)))
    assert before == ["show", None, path]  # which the digest takes by content


def header(path: Path) -> dict:
    return OpenEXR.File(str(path), header_only=True).header()


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("run")
    ones = np.ones((16, 16), np.float32)
    write_asset(folder / "asset", "tile", quad(), [quarters()], [ones], [no_texels()], provenance={})
    return folder


def planes(path: Path) -> np.ndarray:
    with OpenEXR.File(str(path), separate_channels=True) as file:
        return np.stack([np.asarray(file.channels()[c].pixels, np.float32) for c in "RGB"], -1)


def test_delivered_textures_are_converted_and_tagged(run, tmp_path):
    colour = ColourSettings(space="ACEScg", config=CONFIG)
    export(run, tmp_path / "aces", DeliveryRequest(formats=["maps", "mtlx"], target="houdini", colour=colour))
    export(run, tmp_path / "plain", DeliveryRequest(formats=["maps", "mtlx"], target="houdini"))
    aces, flat = (planes(tmp_path / k / "textures" / "tile_albedo.exr") for k in ("aces", "plain"))
    np.testing.assert_allclose(aces, flat @ AP1_FROM_REC709.T, atol=2e-3)
    told = header(tmp_path / "aces" / "textures" / "tile_albedo.exr")
    assert told["colorInteropID"] == "lin_ap1_scene"
    np.testing.assert_allclose(told["chromaticities"], KNOWN["lin_ap1_scene"][1], atol=1e-6)
    assert header(tmp_path / "plain" / "textures" / "tile_albedo.exr")["colorInteropID"] == "lin_rec709_scene"
    for kind in ("normal", "roughness", "metallic"):
        said = header(tmp_path / "aces" / "textures" / f"tile_{kind}.exr")
        assert said["colorInteropID"] == "data" and "chromaticities" not in said
        same = [(tmp_path / k / "textures" / f"tile_{kind}.exr").read_bytes() for k in ("aces", "plain")]
        assert same[0] == same[1]
    assert 'colorspace="lin_ap1"' in (tmp_path / "aces" / "tile.mtlx").read_text()
    record = json.loads((tmp_path / "aces" / "tile.export.json").read_text())
    assert {e.get("space") for e in record["files"]} == {None, "lin_ap1_scene"}


def test_usd_says_what_its_float_textures_are(run, tmp_path):
    pytest.importorskip("pxr")
    from mistyle.io.usd.write import complaints, library

    export(
        run, tmp_path / "out", DeliveryRequest(formats=["usd"], target="houdini", colour=ColourSettings(space="ACEScg"))
    )
    assert complaints(tmp_path / "out" / "tile.usda") == []
    stage = library().Usd.Stage.Open(str(tmp_path / "out" / "tile.usda"))
    albedo = next(p for p in stage.Traverse() if p.GetName() == "diffuseColor")
    assert albedo.GetAttribute("inputs:file").GetColorSpace() == "lin_ap1_scene"


def test_style_pictures_come_in_through_their_space(tmp_path, rng):
    rgb = rng.uniform(0, 1, (6, 8, 3)).astype(np.float32)
    stored = colour_space("ACEScg", CONFIG).from_working(rgb)
    write_exr(tmp_path / "style.exr", dict(zip("RGB", np.moveaxis(stored, -1, 0), strict=True)))
    found = read_style(tmp_path / "style.exr", ColourSettings(space="ACEScg", config=CONFIG))
    np.testing.assert_allclose(found.rgb, srgb_from_linear(rgb), atol=1e-5)
    assert "'ACEScg'" in found.notes[0]
    plain = read_style(tmp_path / "style.exr", ColourSettings())
    np.testing.assert_allclose(plain.rgb, srgb_from_linear(stored), atol=1e-5)
    # An 8-bit picture is sRGB whatever the linear space, unless its own space is named.
    Image.fromarray(np.round(rgb * 255).astype(np.uint8)).save(tmp_path / "style.png")
    eight = np.round(rgb * 255).astype(np.float32) / 255
    assert np.abs(read_style(tmp_path / "style.png", ColourSettings(space="ACEScg")).rgb - eight).max() < 1e-6
    gamma = read_style(tmp_path / "style.png", ColourSettings(pictures="g22_rec709", config=CONFIG))
    np.testing.assert_allclose(gamma.rgb, srgb_from_linear(eight**2.2), atol=2e-4)


def test_references_and_their_environment_maps_come_in_too(rng):
    from types import SimpleNamespace

    rgb = rng.uniform(0, 2, (4, 4, 3)).astype(np.float32)
    space = colour_space("ACEScg", CONFIG)
    counts = np.ones((4, 4), bool)
    sky = Environment(space.from_working(rgb), file="sky.exr")
    sun = Directional((0.0, 1.0, 0.0), (1.0, 1.0, 1.0))
    stored = [space.from_working(rgb), linear_from_srgb(rgb / 2) / np.float32(4)]
    given = Captures((), ((sky, sun), (sky,)), lambda k: (stored[k], counts))
    shots = [SimpleNamespace(picture=Path("a.exr"), factor=1.0), SimpleNamespace(picture=Path("b.png"), factor=4.0)]
    linear = in_working_space(given, shots, ColourSettings(space="ACEScg", config=CONFIG))
    np.testing.assert_allclose(linear.load(0)[0], rgb, atol=1e-5)
    np.testing.assert_array_equal(linear.load(1)[0], stored[1])
    assert linear.lights[0][1] is sun and linear.lights[0][0] is linear.lights[1][0]
    np.testing.assert_allclose(linear.lights[0][0].radiance, rgb, atol=1e-5)
    encoded = in_working_space(given, shots, ColourSettings(pictures="g22_rec709", config=CONFIG))
    np.testing.assert_allclose(encoded.load(1)[0], (rgb / 2) ** 2.2 / 4, atol=1e-4)
    assert in_working_space(given, shots, ColourSettings()) is given


def test_the_environment_names_the_config(monkeypatch):
    from mistyle.jobs.job_settings import ReadSettings
    from mistyle.jobs.settings import resolve as settings_of
    from mistyle.stylization.settings import resolve

    assert resolve("draft", None, {}, {"OCIO": CONFIG}).colour.config == CONFIG
    assert resolve("draft", None, {}, {}).colour.config is None
    # Kinds of job without colour spaces of their own are left alone.
    assert (
        settings_of("standard", None, {}, {"OCIO": CONFIG}, root=ReadSettings, presets={"standard": {}})
        == ReadSettings()
    )
    # Unnamed spaces leave the result as it is: the config is no part of its key then.
    assert key_of(ColourSettings(config=CONFIG)) == key_of(ColourSettings())


def test_without_opencolorio_the_sentence_says_what_to_install(monkeypatch):
    import sys

    from mistyle.core.errors import EnvironmentMissing

    monkeypatch.setitem(sys.modules, "PyOpenColorIO", None)
    with pytest.raises(EnvironmentMissing, match=r"pip install 'mistyle\[ocio\]'"):
        colour_space("ACEScg", CONFIG)


def test_the_command_line_refuses_an_unknown_space_before_the_work(tmp_path, capsys):
    from mistyle.cli.main import main

    Image.new("RGB", (8, 8)).save(tmp_path / "style.png")
    (tmp_path / "m.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    arguments = ["stylize", str(tmp_path / "m.obj"), str(tmp_path / "style.png"), "-o", str(tmp_path / "out")]
    assert main([*arguments, "--colorspace", "acesg"]) == 2
    assert "did you mean 'ACEScg'" in capsys.readouterr().err
    assert not os.path.exists(tmp_path / "out")
