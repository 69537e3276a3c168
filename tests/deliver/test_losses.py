"""Features of a glTF that a delivered format lacks stand in its notes; those that it can hold are written."""

import json
from pathlib import Path

import numpy as np
import pytest

from mistyle.atlas.texels import rasterise
from mistyle.cli.main import main
from mistyle.deliver.asset import write_asset
from mistyle.deliver.export import DeliveryRequest, export
from mistyle.deliver.losses import LABELS, LACKS, MESH, SURFACE, losses, mesh_features
from mistyle.io.gltf.glb import Builder
from mistyle.io.gltf.variants import variant_notes, variants
from tests.support.gltf_cases import from_gltf, glb_parts, quarters, strange_gltf

FORMATS = ["glb", "usd", "obj", "mtlx", "maps"]
VARIANTS = {"variants": [{"name": "plain"}, {"name": "red"}]}


def rich_gltf(path: Path) -> Path:
    """The strange file with light, animation, glass that glows, and a second variant."""
    tree, binary = glb_parts(strange_gltf(path))
    glass = tree["materials"][1]
    glass |= {"emissiveFactor": [0, 0.5, 1], "pbrMetallicRoughness": {"baseColorFactor": [1, 1, 1, 0.5]}}
    glass["extensions"] = {"KHR_materials_transmission": {"transmissionFactor": 1}, "KHR_materials_ior": {"ior": 1.2}}
    tree["materials"].append({"name": "rosso", "pbrMetallicRoughness": {"baseColorFactor": [1, 0, 0, 1]}})
    tree["extensions"] = {"KHR_lights_punctual": {"lights": [{"type": "point"}]}, "KHR_materials_variants": VARIANTS}
    mapping = [{"material": 0, "variants": [0]}, {"material": 2, "variants": [1]}]
    tree["meshes"][0]["primitives"][0]["extensions"] = {"KHR_materials_variants": {"mappings": mapping}}
    own = ["KHR_lights_punctual", "KHR_materials_variants", "KHR_materials_transmission", "KHR_materials_ior"]
    tree["extensionsUsed"] += own
    path.write_bytes(Builder(tree, [binary]).pack())
    return path


@pytest.fixture(scope="module")
def rich(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("rich")
    asset = from_gltf(rich_gltf(folder / "rich.glb"))
    texels = [rasterise(asset.mesh, p, 16) for p in range(2)]
    ones = [np.ones((16, 16), np.float32)] * 2
    write_asset(folder / "run" / "asset", "rich", asset, [quarters()] * 2, ones, texels, provenance={})
    return folder / "run"


def notes_of(rich: Path, out: Path, formats: list[str]) -> list[str]:
    export(rich, out, DeliveryRequest(formats=formats, target="blender"))
    return json.loads((out / "rich.export.json").read_text())["notes"]


def test_each_format_says_what_it_lacks(rich, tmp_path, capsys):
    pytest.importorskip("pxr")
    assert main(["export", str(rich), "-o", str(tmp_path / "out"), "--formats", *FORMATS]) == 0
    told = capsys.readouterr().err
    notes = json.loads((tmp_path / "out" / "rich.export.json").read_text())["notes"]
    mesh, surface = "USD and OBJ lack ", "USD, OBJ, MaterialX and the maps lack "
    for text in (
        f"{mesh}the hierarchy of 4 nodes with their names and pivots, which the GLB has.",
        f"{mesh}the instancing of 2 nodes (the faces are copied), which the GLB has.",
        f"{mesh}the skin (the mesh has one pose), which the GLB has.",
        f"{mesh}the morph targets (the mesh has one shape), which the GLB has.",
        f"{mesh}the cameras (1), which the GLB has.",
        f"{mesh}the lights (1), which the GLB has.",
        f"{mesh}the points and lines, which the GLB has.",
        "OBJ and MaterialX lack the alpha of material 'leaf', which the GLB has.",
        "OBJ, MaterialX and the maps lack the opacity factor of materials 'leaf' and 'glass', which the GLB has.",
        "MaterialX and the maps lack the emission of material 'glass', which the GLB has.",
        f"{surface}the emission texture of material 'leaf', which the GLB has.",
        f"{surface}the transmission of material 'glass', which the GLB has.",
        f"{surface}the double-sidedness of material 'leaf', which the GLB has.",
        f"{surface}all variants but the default one ('red'), which the GLB has.",
        f"{surface}KHR_materials_ior of material 'glass', which the GLB has.",
    ):
        assert text in notes, (text, notes)
        assert f"note      {text}" in told
    assert len(notes) == 15


def test_a_glb_alone_lacks_nothing_and_maps_lack_no_mesh(rich, tmp_path):
    assert notes_of(rich, tmp_path / "glb", ["glb"]) == []
    maps = notes_of(rich, tmp_path / "maps", ["maps"])
    assert maps and all(note.startswith("The maps lack ") for note in maps)
    assert not any(word in note for note in maps for word in ("hierarchy", "skin", "the alpha"))


def test_usd_holds_opacity_threshold_and_emission(rich, tmp_path):
    pytest.importorskip("pxr")
    from pxr import Usd, UsdShade

    from mistyle.io.usd.write import complaints

    notes_of(rich, tmp_path, ["usd"])
    stage = Usd.Stage.Open(str(tmp_path / "rich.usda"))
    surface = {n: UsdShade.Shader.Get(stage, f"/rich/Materials/{n}/Surface") for n in ("leaf", "glass")}
    source = surface["leaf"].GetInput("opacity").GetConnectedSources()[0][0]
    assert source.sourceName == "a" and source.source.GetPath().name == "diffuseColor"
    assert UsdShade.Shader(source.source.GetPrim()).GetInput("scale").Get()[3] == 0.75
    assert surface["leaf"].GetInput("opacityThreshold").Get() == 0.25
    assert not surface["leaf"].GetInput("emissiveColor")
    assert surface["glass"].GetInput("opacity").Get() == 0.5
    assert tuple(surface["glass"].GetInput("emissiveColor").Get()) == (0, 0.5, 1)
    assert not surface["glass"].GetInput("opacityThreshold")
    assert complaints(tmp_path / "rich.usda") == []


def test_obj_holds_a_constant_emission(rich, tmp_path):
    notes_of(rich, tmp_path, ["obj"])
    text = (tmp_path / "rich.mtl").read_text()
    assert "newmtl glass\nKd 1 1 1\nKe 0 0.5 1\n" in text and text.count("Ke ") == 1


def test_a_plain_glb_has_no_features():
    tree = {"nodes": [{"mesh": 0}], "meshes": [{"primitives": [{"attributes": {}}]}], "scenes": [{"nodes": [0]}]}
    assert mesh_features(tree) == {}
    assert losses({}, FORMATS) == ()


def test_instances_that_were_not_read_are_told():
    node = {"mesh": 0, "extensions": {"EXT_mesh_gpu_instancing": {}}}
    tree = {"nodes": [node], "meshes": [{"primitives": []}]}
    notes = ["Only the first 3 of 12 instances (EXT_mesh_gpu_instancing) of a mesh with 8 faces were read: ..."]
    assert losses(mesh_features(tree, notes), ["usd"]) == (
        "USD lacks all but the first 3 of 12 instances, which the GLB has.",
    )
    assert "instancing on the GPU" in mesh_features(tree)["unread instances"]


def test_every_kind_is_in_the_table():
    assert set(LACKS) == set(LABELS) == set(FORMATS) - {"glb"}
    assert all(lacks <= {*MESH, *SURFACE} for lacks in LACKS.values())


@pytest.mark.parametrize("damage", [None, 3, [], {"mappings": 3}, {"mappings": [3, {"material": "a"}]}])
def test_damaged_variants_are_no_variants(damage):
    primitive = {"material": 0, "extensions": {"KHR_materials_variants": damage}}
    tree = {
        "extensions": {"KHR_materials_variants": VARIANTS},
        "materials": [{}, {}],
        "meshes": [{"primitives": [primitive]}],
    }
    assert variants(tree) == []


def test_a_variant_whose_material_is_not_painted_is_told(tmp_path):
    asset = from_gltf(rich_gltf(tmp_path / "rich.glb"))
    sentence = "Variant 'red' was not painted: its material 'rosso' stays in the GLB as it is."
    assert sentence in asset.source.notes
    tree, _ = glb_parts(tmp_path / "rich.glb")
    assert variant_notes(tree, {0, 1}) == [sentence] and variant_notes(tree, {0, 1, 2}) == []


def test_a_run_says_that_alpha_stays_in_the_glb(tmp_path):
    from mistyle.io.read_mesh import read_mesh

    asset = read_mesh(strange_gltf(tmp_path / "strange.glb"))
    told = [note for note in asset.source.notes if "by its alpha" in note]
    assert told and all("which stays in the GLB" in note and "take it as opaque" in note for note in told)
    # A look-dev sheet draws alpha and emission, so that its notes do not name them.
    assert not any("alpha" in note or "emits" in note for note in asset.notes_of_pictures())
