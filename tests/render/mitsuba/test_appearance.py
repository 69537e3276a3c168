"""Pictures of files show what the files say of opacity, emission, unlit and default materials, reflectance and poses.

What is right follows from the specification: radiance 1 from everywhere leaves closed forms for each of them."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from mistyle.core.asset import Asset, Shading
from mistyle.core.camera import orbit
from mistyle.core.light import Ambient
from mistyle.io.gltf.write import patch_glb
from mistyle.io.read_mesh import load_gltf, read_mesh
from mistyle.render.lookdev import scenes as lookdev
from mistyle.render.lookdev.scenes import material_maps
from mistyle.render.mitsuba import appearance
from tests.io.gltf.test_read_gltf import INDEX, NORMAL, POSITION, File, square
from tests.support.helpers import from_front

WHITE = (Ambient((1.0, 1.0, 1.0)),)
DARK = (Ambient((0.0, 0.0, 0.0)),)
SIZE = 16


def asset_of(tmp_path: Path, material: dict | None, pixels: np.ndarray | None = None, **primitive: Any) -> Asset:
    """The square with a material; `pixels` become texture 0."""
    file = square(**({} if material is None else {"material": 0}), **primitive)
    if pixels is not None:
        Image.fromarray(pixels).save(tmp_path / "a.png")
        file.tree |= {"textures": [{"source": 0}], "images": [{"uri": "a.png"}]}
    if material is not None:
        file.tree["materials"] = [material]
        file.tree["extensionsUsed"] = sorted(material.get("extensions", {}))
    return read_mesh(file.save(tmp_path / "a.gltf"), size=64)


def drawn(asset: Asset, lights=WHITE, azimuth: float = 0.0, spp: int = 64) -> np.ndarray:
    """Linear premultiplied, seen straight on: the square fills the middle half of the picture and more."""
    camera = orbit(azimuth, 0.0, distance=4.0, fov=30.0, size=(SIZE, SIZE))
    scene = lookdev.asset_scene(lookdev.asset_shapes(asset), camera, lights, "path")
    return lookdev.drawn(scene, 0, spp, 0)


def middle(picture: np.ndarray) -> np.ndarray:
    return picture[6:10, 6:10].mean(axis=(0, 1))


def rgba(left: tuple[int, ...], right: tuple[int, ...]) -> np.ndarray:
    """A texture of two halves, 8 bits."""
    pixels = np.empty((64, 64, 4), np.uint8)
    pixels[:, :32], pixels[:, 32:] = left, right
    return pixels


def pbr(**more: Any) -> dict:
    return {"metallicFactor": 0.0, "roughnessFactor": 1.0, **more}


def test_a_plain_material_is_drawn_without_further_plugins(tmp_path: Path) -> None:
    asset = asset_of(tmp_path, {"pbrMetallicRoughness": pbr()})
    assert appearance.is_plain(asset.materials[0]) and not appearance.needs_path(lookdev.asset_shapes(asset))


@pytest.mark.parametrize(("alpha", "shown"), [(100, 0), (150, 1)])
def test_masks_are_cut_at_their_cutoff(alpha: int, shown: float, tmp_path: Path) -> None:
    """Alpha times factor against the cutoff: whole or nothing, on either side of the square."""
    base = {"baseColorTexture": {"index": 0}, "baseColorFactor": [1, 1, 1, 0.8]}
    material = {"alphaMode": "MASK", "alphaCutoff": 0.4, "pbrMetallicRoughness": pbr(**base)}
    picture = drawn(asset_of(tmp_path, material, rgba((255, 255, 255, 255), (255, 255, 255, alpha))))
    assert picture[8, 5, 3] == 1 and picture[8, 10, 3] == shown
    assert (picture[8, 10, :3] > 0.5).all() == bool(shown)


def test_an_opacity_equal_to_its_cutoff_is_opaque(tmp_path: Path) -> None:
    """Interpolation rounds an even texture by single bits, which must leave no holes."""
    factor = pbr(baseColorTexture={"index": 0}, baseColorFactor=[1, 1, 1, 0.7])
    material = {"alphaMode": "MASK", "alphaCutoff": 0.7, "pbrMetallicRoughness": factor}
    asset = asset_of(tmp_path, material, rgba((255,) * 4, (255,) * 4))
    assert drawn(asset)[4:12, 4:12, 3].min() == 1


def test_opaque_materials_ignore_their_alpha(tmp_path: Path) -> None:
    material = {"pbrMetallicRoughness": pbr(baseColorTexture={"index": 0}, baseColorFactor=[1, 1, 1, 0.2])}
    assert middle(drawn(asset_of(tmp_path, material, rgba((255,) * 3 + (9,), (255,) * 3 + (9,)))))[3] == 1


@pytest.mark.parametrize("with_colours", [False, True])
def test_blending_covers_by_alpha(with_colours: bool, tmp_path: Path) -> None:
    material = {"alphaMode": "BLEND", "pbrMetallicRoughness": pbr(baseColorFactor=[1, 1, 1, 0.5])}
    file = square(material=0)
    file.tree["materials"] = [material]
    if with_colours:
        colours = np.tile(np.array([1, 1, 1, 0.5], np.float32), (4, 1))
        file.tree["meshes"][0]["primitives"][0]["attributes"]["COLOR_0"] = file.accessor(colours)
    asset = read_mesh(file.save(tmp_path / "a.gltf"), size=64)
    picture = middle(drawn(asset, spp=1024))
    expected = 0.25 if with_colours else 0.5
    assert picture[3] == pytest.approx(expected, abs=0.02)
    whole = middle(drawn(asset_of(tmp_path, {"pbrMetallicRoughness": pbr()})))
    assert picture[:3] == pytest.approx(whole[:3] * expected, abs=0.02)


def test_what_emits_is_seen_from_both_sides_and_lights_nothing_of_itself(tmp_path: Path) -> None:
    strength = {"KHR_materials_emissive_strength": {"emissiveStrength": 4.0}}
    material = {"emissiveFactor": [0.5, 0.25, 0], "extensions": strength, "pbrMetallicRoughness": pbr()}
    asset = asset_of(tmp_path, material)
    for azimuth in (0.0, 180.0):
        assert middle(drawn(asset, DARK, azimuth)) == pytest.approx([2, 1, 0, 1], abs=1e-5)
    assert any("emits light" in note for note in asset.source.notes)


def test_emission_is_textured_and_cut_with_the_surface(tmp_path: Path) -> None:
    pixels = rgba((255, 255, 255, 255), (188, 0, 0, 0))
    material = {
        "alphaMode": "MASK",
        "emissiveFactor": [1, 1, 1],
        "emissiveTexture": {"index": 0},
        "pbrMetallicRoughness": pbr(baseColorTexture={"index": 0}),
    }
    picture = drawn(asset_of(tmp_path, material, pixels), DARK)
    assert picture[8, 5] == pytest.approx([1, 1, 1, 1], abs=1e-5) and not picture[8, 10].any()
    picture = drawn(asset_of(tmp_path, material | {"alphaMode": "OPAQUE"}, pixels), DARK)
    assert picture[8, 10] == pytest.approx([0.503, 0, 0, 1], abs=2e-3)


def test_a_glowing_part_lights_its_neighbour(tmp_path: Path) -> None:
    """Two squares a right angle apart: in the dark, the one that does not glow is seen by the other's light."""
    file = square(material=0)
    wall = {**file.tree["meshes"][0]["primitives"][0], "material": 1}
    file.tree["meshes"].append({"primitives": [wall]})
    file.tree["nodes"].append({"mesh": 1, "rotation": [0, -np.sin(np.pi / 4), 0, np.cos(np.pi / 4)]})
    file.tree["scenes"][0]["nodes"] = [0, 1]
    plain = {"pbrMetallicRoughness": pbr()}
    file.tree["materials"] = [plain, plain | {"emissiveFactor": [1, 1, 1]}]
    asset = read_mesh(file.save(tmp_path / "a.gltf"), size=64)
    glowing = drawn(asset, DARK, 30.0, 256)
    lit = (glowing[..., 3] == 1) & (glowing[..., 0] < 0.9)
    assert lit.sum() > 10 and np.median(glowing[lit][:, 0]) > 0.02


def test_unlit_is_its_base_colour_in_any_light(tmp_path: Path) -> None:
    base = {"baseColorFactor": [0.2, 0.5, 0.8, 1]}
    material = {"extensions": {"KHR_materials_unlit": {}}, "pbrMetallicRoughness": base}
    for lights in (WHITE, DARK):
        assert middle(drawn(asset_of(tmp_path, material), lights)) == pytest.approx([0.2, 0.5, 0.8, 1], abs=1e-5)


def test_a_black_surface_that_emits_shows_its_emission(tmp_path: Path) -> None:
    """Its albedo is the emission for the painting; drawn, it is black and glows."""
    material = {"emissiveFactor": [0.5, 0.2, 0], "pbrMetallicRoughness": pbr(baseColorFactor=[0, 0, 0, 1])}
    asset = asset_of(tmp_path, material)
    assert asset.materials[0].albedo_factor == pytest.approx([0.5, 0.2, 0])
    assert middle(drawn(asset, DARK)) == pytest.approx([0.5, 0.2, 0, 1], abs=1e-5)


def test_an_open_surface_is_rough_metal_and_is_painted_as_a_dielectric(tmp_path: Path) -> None:
    asset = asset_of(tmp_path, {"doubleSided": True})
    said = asset_of(tmp_path, {"pbrMetallicRoughness": {"metallicFactor": 1, "roughnessFactor": 1}})
    assert middle(drawn(asset)) == pytest.approx(middle(drawn(said)), abs=5e-3)
    assert material_maps(asset.materials[0]).metallic.max() == 0


def test_no_material_is_matt_and_grey(tmp_path: Path) -> None:
    assert middle(drawn(asset_of(tmp_path, None)))[:3] == pytest.approx([0.8] * 3, abs=0.01)


def test_specular_colour_is_the_reflectance_of_a_black_surface(tmp_path: Path) -> None:
    """A smooth mirror of F0 (0.9, 0.5, 0.1), seen straight on under radiance 1."""
    glossy = {"diffuseFactor": [0, 0, 0, 1], "specularFactor": [0.9, 0.5, 0.1], "glossinessFactor": 1.0}
    asset = asset_of(tmp_path, {"extensions": {"KHR_materials_pbrSpecularGlossiness": glossy}})
    assert middle(drawn(asset, spp=256))[:3] == pytest.approx([0.9, 0.5, 0.1], abs=0.02)


def test_the_gloss_of_a_texture_is_roughness(tmp_path: Path) -> None:
    pixels = rgba((255, 0, 0, 204), (255, 0, 0, 204))
    said = {"specularGlossinessTexture": {"index": 0}, "glossinessFactor": 0.5}
    asset = asset_of(tmp_path, {"extensions": {"KHR_materials_pbrSpecularGlossiness": said}}, pixels)
    maps = material_maps(asset.materials[0])
    assert maps.roughness == pytest.approx(np.full(maps.roughness.shape, 1 - 0.5 * 0.8), abs=0.01)
    assert asset.materials[0].specular is not None and asset.materials[0].specular[0, 0] == pytest.approx([1, 0, 0])


@pytest.mark.parametrize(
    ("said", "shading"),
    [
        ({"KHR_materials_ior": {"ior": 2.0}}, {"specular": (1 / 9,) * 3, "ior": 2.0}),
        ({"KHR_materials_ior": {"ior": 0}}, {"specular": (1.0,) * 3, "ior": 0.0}),
        ({"KHR_materials_specular": {"specularFactor": 0.5}}, {"specular": (0.02,) * 3, "edge": 0.5}),
        ({"KHR_materials_clearcoat": {"clearcoatFactor": 0.7}}, {"coat": 0.7}),
        ({"KHR_materials_transmission": {"transmissionFactor": 1}}, {"transmission": 1.0}),
        ({"KHR_materials_transmission": {"transmissionFactor": "much"}}, {}),
        ({"KHR_materials_clearcoat": [1]}, {}),
    ],
)
def test_factors_of_extensions(said: dict, shading: dict, tmp_path: Path) -> None:
    found = asset_of(tmp_path, {"extensions": said, "pbrMetallicRoughness": pbr()}).materials[0].shading
    expected = Shading(**shading)
    assert found.specular == pytest.approx(expected.specular)
    assert replace(found, specular=expected.specular) == expected


def test_a_coat_shines_on_a_black_surface(tmp_path: Path) -> None:
    """Straight on, a coat of index 1.5 reflects 4 % of radiance 1 and covers 4 % of the base's own reflection."""
    base = pbr(baseColorFactor=[0, 0, 0, 1], roughnessFactor=0.0)
    coat = {"KHR_materials_clearcoat": {"clearcoatFactor": 1.0}, "KHR_materials_specular": {"specularFactor": 0.0}}
    asset = asset_of(tmp_path, {"extensions": coat, "pbrMetallicRoughness": base})
    assert middle(drawn(asset, spp=256))[:3] == pytest.approx([0.04] * 3, abs=4e-3)


def test_the_layered_surface_is_gltfs_own_where_nothing_is_added() -> None:
    import mitsuba as mi

    from mistyle.render.deferred import bsdf
    from mistyle.render.mitsuba import device

    device.use()
    rng = np.random.default_rng(0)
    pair = rng.normal(size=(2, 3, 64)).astype(np.float32)
    wi, wo = (mi.Vector3f(*(v / np.linalg.norm(v, axis=0))) for v in pair)
    albedo, rough, metal = mi.Color3f(0.2, 0.5, 0.9), mi.Float(0.4), mi.Float(0.3)
    angles = bsdf.upright(wi, wo)
    layered = np.array(bsdf.layered(angles, albedo, rough, metal, mi.Color3f(bsdf.GLTF_F0), 1.0, (0.0, 0.0)))
    own, valid = np.array(from_front("gltf", wi, wo, albedo, rough, metal)), np.array(angles.valid)
    assert valid.sum() > 5 and layered[:, valid] == pytest.approx(own[:, valid], rel=1e-4)


def test_a_clear_pane_lets_all_light_through(tmp_path: Path) -> None:
    """White glass under radiance 1 from everywhere is 1, whatever it lets pass and reflects (energy is kept)."""
    said = {"KHR_materials_transmission": {"transmissionFactor": 1}}
    asset = asset_of(tmp_path, {"extensions": said, "pbrMetallicRoughness": pbr(roughnessFactor=0.3)})
    assert middle(drawn(asset, spp=256))[:3] == pytest.approx([1] * 3, abs=0.06)


# --- poses and instances ---


def bent(tmp_path: Path, weights: np.ndarray) -> Asset:
    """The square on two joints, of which the second is moved by (0, 0, 3)."""
    file = square()
    attributes = file.tree["meshes"][0]["primitives"][0]["attributes"]
    attributes["JOINTS_0"] = file.accessor(np.tile(np.array([0, 1, 0, 0], np.uint8), (4, 1)))
    attributes["WEIGHTS_0"] = file.accessor(weights.astype(np.float32))
    file.tree["skins"] = [{"joints": [1, 2]}]
    file.tree["nodes"] = [{"mesh": 0, "skin": 0}, {"children": [2]}, {"translation": [0, 0, 3]}]
    file.tree["scenes"][0]["nodes"] = [0, 1]
    return read_mesh(file.save(tmp_path / "a.gltf"), size=64)


def test_vertices_follow_their_joints(tmp_path: Path) -> None:
    share = np.array([0, 0, 0.5, 1])
    weights = np.stack([1 - share, share, 0 * share, 0 * share], axis=1)
    asset = bent(tmp_path, weights)
    assert asset.source.user_positions == pytest.approx(POSITION + share[:, None] * [0, 0, 3], abs=1e-6)
    assert any("pose of its joints" in note for note in asset.source.notes)


def test_a_result_of_a_posed_mesh_keeps_the_files_vertices(tmp_path: Path) -> None:
    asset = bent(tmp_path, np.tile([0.0, 1, 0, 0], (4, 1)))
    maps = [material_maps(m) for m in asset.materials]
    patch_glb(tmp_path / "b.glb", asset, maps, [np.ones((2, 2), np.float32)], name="b")
    again = read_mesh(tmp_path / "b.glb", size=64)
    assert again.source.user_positions == pytest.approx(asset.source.user_positions, abs=1e-6)
    assert "skins" in load_gltf(tmp_path / "b.glb")[0]


@pytest.mark.parametrize("on_node", [False, True])
def test_morph_weights_count(on_node: bool, tmp_path: Path) -> None:
    file = square()
    primitive = file.tree["meshes"][0]["primitives"][0]
    step = np.array([[0, 0, 0], [0, 0, 0], [0, 0, 1], [0, 0, 1]], np.float32)
    primitive["targets"] = [{"POSITION": file.accessor(step)}, {"POSITION": file.accessor(step * 5)}]
    file.tree["meshes"][0]["weights"] = [0.0, 0.0] if on_node else [0.5, 0.0]
    if on_node:
        file.tree["nodes"][0]["weights"] = [0.5, 0.0]
    asset = read_mesh(file.save(tmp_path / "a.gltf"), size=64)
    assert asset.source.user_positions == pytest.approx(POSITION + 0.5 * step, abs=1e-6)


def instanced(places: np.ndarray) -> File:
    file = square()
    said = {"attributes": {"TRANSLATION": file.accessor(places.astype(np.float32))}}
    file.tree["nodes"][0]["extensions"] = {"EXT_mesh_gpu_instancing": said}
    file.tree["extensionsUsed"] = ["EXT_mesh_gpu_instancing"]
    return file


def test_all_instances_are_read_and_written_once(tmp_path: Path) -> None:
    places = np.array([[0, 0, 0], [5, 0, 0], [0, 5, 0]])
    asset = read_mesh(instanced(places).save(tmp_path / "a.gltf"), size=64)
    assert len(asset.mesh.faces) == 3 * len(INDEX) // 3
    expected = np.concatenate([POSITION + place for place in places])
    assert asset.source.user_positions == pytest.approx(expected, abs=1e-6)
    assert np.array_equal(asset.mesh.corner_uvs[:2], asset.mesh.corner_uvs[2:4])
    patch_glb(tmp_path / "b.glb", asset, [material_maps(asset.materials[0])], [np.ones((2, 2), np.float32)], name="b")
    tree, _ = load_gltf(tmp_path / "b.glb")
    assert len(tree["nodes"]) == 1 and "EXT_mesh_gpu_instancing" in tree["nodes"][0]["extensions"]
    assert len(read_mesh(tmp_path / "b.glb", size=64).mesh.faces) == len(asset.mesh.faces)


def test_of_too_many_instances_those_that_fit_are_read(tmp_path: Path) -> None:
    path = instanced(np.zeros((100, 3)) + np.arange(100)[:, None]).save(tmp_path / "a.gltf")
    asset = read_mesh(path, size=64, max_faces=50)
    assert len(asset.mesh.faces) == 50
    assert any(note.startswith("Only the first 25 of 100 instances") for note in asset.source.notes)


def test_normals_turn_with_the_joints(tmp_path: Path) -> None:
    from mistyle.io.gltf.pose import turned

    rng = np.random.default_rng(1)
    matrices = np.tile(np.eye(4), (len(NORMAL), 1, 1))
    matrices[:, :3, :3] = rng.normal(size=(len(NORMAL), 3, 3))
    found = turned(NORMAL.astype(float), matrices)
    expected = np.einsum("nji,nj->ni", np.linalg.inv(matrices[:, :3, :3]), NORMAL)
    cosine = (found * expected).sum(axis=1) / np.linalg.norm(found, axis=1) / np.linalg.norm(expected, axis=1)
    assert cosine == pytest.approx(1)
