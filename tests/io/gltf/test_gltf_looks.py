"""What a glTF says about its looks: vertex colours, wrap modes, texture transforms, hidden nodes, emission; each is
obeyed or said in a note. What is right is worked out here with numpy, pixel by pixel."""

import io
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from PIL import Image

from mistyle.atlas.texels import rasterise, start_maps
from mistyle.core.asset import Asset
from mistyle.core.camera import orbit
from mistyle.core.errors import InputRefused
from mistyle.core.image import linear_from_srgb, srgb_from_linear
from mistyle.deliver.asset import write_asset
from mistyle.geometry.retexture import Wraps, fetch
from mistyle.io.gltf.write import patch_glb
from mistyle.io.meshes import lookups
from mistyle.io.read_mesh import read_extent, read_mesh
from mistyle.render.mitsuba.draw import draw_views
from tests.io.gltf.test_read_gltf import File, Tree, glb, shown, square, textured
from tests.io.meshes.test_read import check_asset
from tests.support.gltf_cases import glb_parts, quarters

SIDE = 8
INNER = np.array([[x, y] for x in (0.13, 0.38, 0.61, 0.9) for y in (0.07, 0.3, 0.55, 0.84)])
MODES = {"repeat": 10497, "mirror": 33648, "clamp": 33071}
PAD = {"repeat": "wrap", "mirror": "symmetric", "clamp": "edge"}


def noise(folder: Path, seed: int = 0, name: str = "a.png") -> np.ndarray:
    """A texture of random texels, written; linear."""
    pixels = np.random.default_rng(seed).integers(0, 256, (SIDE, SIDE, 3), dtype=np.uint8)
    Image.fromarray(pixels).save(folder / name)
    return linear_from_srgb(pixels.astype(np.float32) / 255)


def read(file: File, folder: Path, **how: Any) -> Asset:
    asset = read_mesh(file.save(folder / "a.gltf"), **{"size": 64, **how})
    check_asset(asset)
    return asset


def noted(asset: Asset, *words: str) -> bool:
    return any(all(word in note for word in words) for note in asset.source.notes)


def attributes(file: File) -> Tree:
    return file.tree["meshes"][0]["primitives"][0]["attributes"]


def base(file: File) -> Tree:
    return file.tree["materials"][0]["pbrMetallicRoughness"]["baseColorTexture"]


def with_uvs(file: File, uv_down: np.ndarray, **more: Any) -> File:
    attributes(file)["TEXCOORD_0"] = file.accessor(uv_down, **more)
    return file


def moved(**transform: Any) -> Tree:
    return {"extensions": {"KHR_texture_transform": transform}}


def written(asset: Asset, path: Path) -> tuple[Tree, bytes]:
    parts = len(asset.mesh.parts)
    patch_glb(path, asset, [quarters()] * parts, [np.ones((16, 16), np.float32)] * parts, name="look")
    return glb_parts(path)


# --- vertex colours ---

CORNERS = np.array([[0.1, 0.5, 0.9], [1, 0.2, 0], [0, 0, 1], [0.4, 1, 0.6]], np.float32)  # 00 10 11 01


def between(at: np.ndarray) -> np.ndarray:
    """CORNERS at places of the quad, y down, interpolated in the triangles 0 1 2 and 0 2 3."""
    x, y = at[:, :1], 1 - at[:, 1:]
    lower = (1 - x) * CORNERS[0] + (x - y) * CORNERS[1] + y * CORNERS[2]
    return np.where(y <= x, lower, (1 - y) * CORNERS[0] + x * CORNERS[2] + (y - x) * CORNERS[3])


@pytest.mark.parametrize(
    "colours",
    [
        dict(array=CORNERS),
        dict(array=np.rint(np.c_[CORNERS, [0, 1, 0, 1]] * 255).astype(np.uint8), normalized=True),
        dict(array=np.rint(CORNERS * 65535).astype(np.uint16), normalized=True),
    ],
    ids=["float", "bytes with alpha", "words"],
)
@pytest.mark.parametrize("picture", [False, True], ids=["alone", "times texture"])
def test_vertex_colours_are_linear_and_multiply_the_base_colour(colours: dict, picture: bool, tmp_path: Path) -> None:
    file = textured(square()) if picture else square()
    texels = noise(tmp_path) if picture else np.ones((SIDE, SIDE, 3))
    attributes(file)["COLOR_0"] = file.accessor(**colours)
    asset = read(file, tmp_path, uv="keep", size=128)
    centres = (np.rint(INNER * 128 - 0.5) + 0.5) / 128  # of the albedo's texels
    picture_there = fetch(texels.astype(np.float32), np.c_[centres[:, 0], 1 - centres[:, 1]])
    assert shown(asset, centres) == pytest.approx(picture_there * between(centres), abs=0.01)
    assert noted(asset, "vertex colours", "albedo")


def test_one_vertex_colour_is_a_factor(tmp_path: Path) -> None:
    noise(tmp_path)
    file = textured(square())
    attributes(file)["COLOR_0"] = file.accessor(np.tile(np.float32([0.5, 0.25, 1]), (4, 1)))
    asset = read(file, tmp_path)
    assert asset.materials[0].albedo_factor == pytest.approx([0.5, 0.25, 1])
    assert asset.materials[0].albedo is not None and asset.materials[0].albedo.shape == (SIDE, SIDE, 3)
    attributes(file)["COLOR_0"] = file.accessor(np.ones((4, 3), np.float32))
    assert not noted(read(file, tmp_path), "vertex colours")


def test_shared_texels_need_shared_vertex_colours(tmp_path: Path) -> None:
    """A second square on the same texels: with the same colours it stays there, with others it gets its own."""
    noise(tmp_path)
    file = textured(square())
    first = file.tree["meshes"][0]["primitives"][0]
    other = {**first, "attributes": {**first["attributes"], "POSITION": file.accessor(np.float32(
        [[3, 0, 0], [5, 0, 0], [5, 2, 0], [3, 2, 0]]))}}  # fmt: skip
    file.tree["meshes"][0]["primitives"].append(other)
    first["attributes"]["COLOR_0"] = other["attributes"]["COLOR_0"] = file.accessor(CORNERS)
    assert read(file, tmp_path).source.uv == "kept"
    other["attributes"]["COLOR_0"] = file.accessor(CORNERS[::-1].copy())
    asset = read(file, tmp_path)
    assert asset.source.uv == "new" and noted(asset, "unwrapped anew", "different vertex colours")
    assert noted(read(file, tmp_path, uv="keep"), "each texel takes those of its first face")


def test_results_have_no_vertex_colours_and_carry_their_alpha(tmp_path: Path) -> None:
    """Viewers multiply what is written by COLOR_0 and its alpha: both are in the texture, once."""
    file = square(material=0)
    alpha = np.array([0, 1, 1, 0], np.float32)  # rises with x
    attributes(file)["COLOR_0"] = file.accessor(np.c_[CORNERS, alpha].astype(np.float32))
    file.tree["materials"] = [{"alphaMode": "BLEND"}]
    asset = read(file, tmp_path, uv="keep")
    texels = rasterise(asset.mesh, 0, 16)
    maps = start_maps(asset.materials[0], texels, 16)
    write_asset(tmp_path / "out", "a", asset, [maps], [np.ones((16, 16), np.float32)], [texels], provenance={})
    tree, _ = glb_parts(tmp_path / "out" / "a.glb")
    assert "COLOR_0" not in tree["meshes"][0]["primitives"][0]["attributes"]
    albedo = np.asarray(Image.open(tmp_path / "out" / "textures" / "a_albedo.png"), np.float32) / 255
    centre = (np.arange(16) + 0.5) / 16
    grid = np.stack(np.meshgrid(centre, centre), -1).reshape(-1, 2)
    expected = srgb_from_linear(between(grid).astype(np.float32)).reshape(16, 16, 3)
    # The albedo has 64 texels along a side, of which each of the 16 is a mean.
    assert albedo[..., 3] == pytest.approx(np.tile(centre, (16, 1)), abs=0.01)
    assert np.abs(albedo[..., :3] - expected).mean() < 0.01


# --- wrap modes ---


@pytest.mark.parametrize("along_u", MODES)
@pytest.mark.parametrize("along_v", MODES)
def test_lookups_outside_the_square(along_u: str, along_v: str, rng: np.random.Generator) -> None:
    texels = rng.random((5, 4, 3), dtype=np.float32)
    wrap: Any = (along_u, along_v)
    rows = np.pad(texels, ((10, 10), (0, 0), (0, 0)), mode=PAD[along_v])  # type: ignore[arg-type]
    wide = np.pad(rows, ((0, 0), (12, 12), (0, 0)), mode=PAD[along_u])  # type: ignore[arg-type]
    uv = rng.uniform([-2.5, -1.5], [3.5, 2.5], (200, 2))
    inner = np.stack([(uv[:, 0] * 4 + 12) / 28, 1 - ((1 - uv[:, 1]) * 5 + 10) / 25], axis=1)
    assert fetch(texels, uv, wrap) == pytest.approx(fetch(wide, inner), abs=1e-5)


@pytest.mark.parametrize("wrap", [("mirror", "mirror"), ("clamp", "clamp"), ("clamp", "mirror"), ("mirror", "clamp")])
@pytest.mark.parametrize("transform", [None, dict(offset=[0.5, -0.5], scale=[1, 0.5], rotation=np.pi / 2)])
def test_wrap_modes_are_as_the_sampler_says(wrap: Wraps, transform: dict | None, tmp_path: Path) -> None:
    """UVs from -0.5 to 1.5: kept, exact to the texel, with a note."""
    texels = noise(tmp_path)
    uv = np.array([[-0.5, 1.5], [1.5, 1.5], [1.5, -0.5], [-0.5, -0.5]], np.float32)
    file = with_uvs(textured(square(), moved(**transform) if transform else None), uv)
    file.tree["samplers"] = [{"wrapS": MODES[wrap[0]], "wrapT": MODES[wrap[1]]}]
    file.tree["textures"][0]["sampler"] = 0
    asset = read(file, tmp_path, uv="keep")
    place = -0.5 + 2 * INNER  # v down
    if transform:  # turned by 90 degrees: the extension's own matrix, written out
        place = np.stack([0.5 + 0.5 * place[:, 1], -0.5 - place[:, 0]], axis=1)
    index = np.floor(place * SIDE).astype(int)
    expected, there_and_back = [], [*range(SIDE), *reversed(range(SIDE))]
    for x, y in index:
        at = [
            min(max(k, 0), SIDE - 1) if mode == "clamp" else there_and_back[k % 16]
            for k, mode in zip((x, y), wrap, strict=True)
        ]
        expected.append(texels[at[1], at[0]])
    assert shown(asset, INNER) == pytest.approx(np.array(expected), abs=1e-6)
    assert noted(asset, "outside the unit square", *{lookups.WORDS[m] for m in wrap})
    assert asset.mesh.corner_uvs.min() >= -0.5 and asset.mesh.corner_uvs.max() <= 1.5


def test_wrap_modes_that_do_not_show_change_nothing(tmp_path: Path) -> None:
    noise(tmp_path)
    file = textured(square())
    file.tree["samplers"] = [{"wrapS": MODES["mirror"], "wrapT": MODES["clamp"]}]
    file.tree["textures"][0]["sampler"] = 0
    asset = read(file, tmp_path, uv="keep")
    assert asset.source.uv == "kept" and asset.source.notes == () and asset.materials[0].albedo.shape == (SIDE, SIDE, 3)


def test_wide_clamped_textures_are_bounded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    texels = noise(tmp_path)
    monkeypatch.setattr(lookups, "WORK_TEXTURE", 32)
    uv = np.array([[-7, 8], [8, 8], [8, -7], [-7, -7]], np.float32)
    file = with_uvs(textured(square()), uv)
    file.tree |= {"samplers": [{"wrapS": MODES["clamp"], "wrapT": MODES["clamp"]}]}
    file.tree["textures"][0]["sampler"] = 0
    asset = read(file, tmp_path, uv="keep")
    assert asset.materials[0].albedo.shape == (32, 32, 3) and noted(asset, "lower resolution")
    corners = np.array([[0.02, 0.02], [0.98, 0.02], [0.02, 0.98], [0.98, 0.98]])
    assert shown(asset, corners) == pytest.approx(texels[[0, 0, -1, -1], [0, -1, 0, -1]], abs=1e-6)


def test_a_mirrored_texture_and_vertex_colours_are_rendered(tmp_path: Path) -> None:
    """Through the renderer, in pixels: mirrored rows are R R G G G G R R, halved in green by the vertex colours."""
    pixels = np.zeros((4, 4, 3), np.uint8)
    pixels[:, :2, 0] = pixels[:, 2:, 1] = 255
    Image.fromarray(pixels).save(tmp_path / "a.png")
    uv = np.array([[0, 2], [2, 2], [2, 0], [0, 0]], np.float32)
    file = with_uvs(textured(square()), uv)
    file.tree |= {"samplers": [{"wrapS": MODES["mirror"]}]}
    file.tree["textures"][0]["sampler"] = 0
    attributes(file)["COLOR_0"] = file.accessor(np.tile(np.float32([1, 0.5, 1]), (4, 1)))
    asset = read(file, tmp_path)
    maps = start_maps(asset.materials[0], rasterise(asset.mesh, 0, 32), 32)
    camera = orbit(0, 0, distance=4, fov=30, size=(32, 32))
    view = draw_views(asset.mesh, [maps], [camera], spp=16)[0]
    columns = np.flatnonzero(view.mask.any(axis=0))
    rows = np.flatnonzero(view.mask.any(axis=1))
    places = columns[0] + (np.arange(8) + 0.5) / 8 * (columns[-1] + 1 - columns[0])
    seen = view.rgb[rows[len(rows) // 2], places.astype(int)]
    assert "".join("RG"[int(g > r)] for r, g, _ in seen) == "RRGGGGRR"
    assert seen[3, 1] == pytest.approx(seen[1, 0] / 2, rel=0.15)


# --- texture transforms and quantised UVs ---


@pytest.mark.parametrize(
    ("stored", "scale", "more"),
    [
        ([[0, 255], [255, 255], [255, 0], [0, 0]], 1, dict(array=np.uint8, normalized=True)),
        ([[0, 4095], [4095, 4095], [4095, 0], [0, 0]], 65535 / 4095, dict(array=np.uint16, normalized=True)),
        ([[0, 4095], [4095, 4095], [4095, 0], [0, 0]], 1 / 4095, dict(array=np.uint16)),
        ([[0, 100], [100, 100], [100, 0], [0, 0]], 127 / 100, dict(array=np.int8, normalized=True)),
        ([[0, 100], [100, 100], [100, 0], [0, 0]], 1 / 100, dict(array=np.int8)),
    ],
)
def test_quantised_uvs_are_the_ones_they_stand_for(stored: list, scale: float, more: dict, tmp_path: Path) -> None:
    """KHR_mesh_quantization: kept with --uv keep, and written so that any viewer finds the same texels."""
    texels = noise(tmp_path)
    kind = more["array"]
    uv = np.zeros((4, 4 // np.dtype(kind).itemsize), kind)  # padded to four bytes a vertex
    uv[:, :2] = stored
    file = textured(square(), moved(scale=[scale, scale]) if scale != 1 else None)
    view = file.view(uv.tobytes(), byteStride=4)
    component = {"uint8": 5121, "uint16": 5123, "int8": 5120}[np.dtype(kind).name]
    entry = {"bufferView": view, "componentType": component, "count": 4, "type": "VEC2"}
    file.tree["accessors"].append(entry | {"normalized": "normalized" in more})
    attributes(file)["TEXCOORD_0"] = len(file.tree["accessors"]) - 1
    file.tree["extensionsRequired"] = file.tree["extensionsUsed"] = ["KHR_mesh_quantization", "KHR_texture_transform"]
    asset = read(file, tmp_path, uv="keep")
    right = np.array([[[0, 0], [1, 0], [1, 1]], [[0, 0], [1, 1], [0, 1]]])
    assert asset.mesh.corner_uvs == pytest.approx(right, abs=1e-5)
    assert asset.materials[0].albedo == pytest.approx(texels, abs=1e-5), "no resampling"
    assert rasterise(asset.mesh, 0, 16).covered.all()
    tree, _ = written(asset, tmp_path / "out.glb")
    assert "KHR_texture_transform" not in str(tree)
    mesh = trimesh.load(tmp_path / "out.glb", process=False, force="mesh")
    info = tree["materials"][0]["pbrMetallicRoughness"]["baseColorTexture"]
    name = f"TEXCOORD_{info.get('texCoord', 0)}"
    assert name == ("TEXCOORD_0" if scale == 1 else "TEXCOORD_1")
    assert len(mesh.faces) == 2


def test_maps_with_other_lookups_are_resampled_and_said(tmp_path: Path) -> None:
    """The base colour's transform decides; roughness without it is shown where the file shows it."""
    noise(tmp_path)
    rough = noise(tmp_path, 1, "b.png")
    file = textured(square(), moved(scale=[0.5, 0.5], offset=[0.5, 0]))
    file.tree["images"].append({"uri": "b.png"})
    file.tree["textures"].append({"source": 1})
    file.tree["materials"][0]["pbrMetallicRoughness"]["metallicRoughnessTexture"] = {"index": 1}
    asset = read(file, tmp_path, uv="keep", size=256)
    uvs, found = asset.mesh.corner_uvs, asset.materials[0]
    assert uvs[0].tolist() == [[0.5, 0.5], [1, 0.5], [1, 1]]  # v up: the texture's upper right quarter
    assert noted(asset, "metallic and roughness", "resampled") and found.roughness is not None
    encoded = srgb_from_linear(rough[..., 1:2])  # data is not sRGB
    for x, y in INNER:
        row, column = (int(c * len(found.roughness)) for c in (y / 2, 0.5 + x / 2))
        centre = 2 * (np.array([column, row]) + 0.5) / len(found.roughness) - [1, 0]
        expected = fetch(encoded, np.array([[centre[0], 1 - centre[1]]]))[0, 0]
        assert found.roughness[row, column] == pytest.approx(expected, abs=0.005)


def test_a_tiled_texture_leaves_good_uvs_alone(tmp_path: Path) -> None:
    """A transform that repeats the texture over UVs that are unique: those are painted, the texture is resampled."""
    texels = noise(tmp_path)
    asset = read(textured(square(), moved(scale=[4, 4])), tmp_path, uv="keep", size=256)
    assert asset.source.uv == "kept" and noted(asset, "keeps its UVs as authored", "resampled")
    albedo = asset.materials[0].albedo
    place = (np.indices(albedo.shape[:2])[::-1].reshape(2, -1).T + 0.5) / len(albedo)
    expected = fetch(texels.astype(np.float32), np.c_[4 * place[:, 0], 1 - 4 * place[:, 1]])
    assert albedo.reshape(-1, 3) == pytest.approx(expected, abs=1e-4)


@pytest.mark.parametrize("tangents", [False, True])
@pytest.mark.parametrize("alike", [False, True])
def test_normals_stand_in_the_frame_of_the_lookup_or_of_tangent(tangents: bool, alike: bool, tmp_path: Path) -> None:
    """A normal leaning along the texture's u, the texture turned by 90 degrees: without TANGENT it leans along the
    turned u (as three.js and Khronos' viewer draw it), with TANGENT along what the file says."""
    noise(tmp_path)
    Image.fromarray(np.full((8, 8, 3), (255, 128, 128), np.uint8)).save(tmp_path / "b.png")
    turn = moved(rotation=np.pi / 2, offset=[0, 1])
    file = textured(square(), turn if alike else None)
    file.tree["images"].append({"uri": "b.png"})
    file.tree["textures"].append({"source": 1})
    file.tree["materials"][0]["normalTexture"] = {"index": 1, **turn}
    if tangents:
        attributes(file)["TANGENT"] = file.accessor(np.tile(np.float32([1, 0, 0, 1]), (4, 1)))
    asset = read(file, tmp_path, uv="keep")
    normal = asset.materials[0].normal[4, 4]
    a, b, c = asset.mesh.positions[asset.mesh.faces[0]].astype(float)
    step = (asset.mesh.corner_uvs[0, 1:] - asset.mesh.corner_uvs[0, 0]).astype(float)
    along_u, along_v = np.linalg.solve(step, np.stack([b - a, c - a]))
    seen = normal[0] * along_u / np.linalg.norm(along_u) + normal[1] * along_v / np.linalg.norm(along_v)
    # u' = v_down, so u grows downwards in the square.
    assert seen == pytest.approx([1, 0, 0] if tangents else [0, -1, 0], abs=0.02)


@pytest.mark.parametrize("kind", ["mirrored", "tiled", "tinted", "quantised"])
def test_the_extent_is_that_of_the_asset(kind: str, tmp_path: Path) -> None:
    """What is said of memory before a job begins counts the maps as reading makes them."""
    noise(tmp_path)
    scale = {"tiled": 4, "quantised": 1 / 255}.get(kind, 1)
    file = textured(square(), moved(scale=[scale, scale]) if scale != 1 else None)
    top = {"mirrored": 2, "quantised": 255}.get(kind, 1)
    with_uvs(file, np.array([[0, top], [top, top], [top, 0], [0, 0]], np.float32))
    file.tree |= {"samplers": [{"wrapS": MODES["mirror"], "wrapT": MODES["repeat"]}]}
    if kind == "mirrored":
        file.tree["textures"][0]["sampler"] = 0
        attributes(file)["TEXCOORD_0"] = file.accessor(np.array([[0, 1], [2, 1], [2, 0], [0, 0]], np.float32))
    if kind == "tinted":
        attributes(file)["COLOR_0"] = file.accessor(CORNERS)
    found = read_extent(file.save(tmp_path / "a.gltf"), uv="keep", size=64)
    (material,) = read(file, tmp_path, uv="keep").materials
    assert material.albedo is not None and found.own == material.albedo.nbytes and found.unwrapped == 0


# --- nodes ---


def test_hidden_nodes_neither_count_nor_go(tmp_path: Path) -> None:
    """KHR_node_visibility hides a node and all below it; names, meshes and materials stay in the result."""
    file = square(material=0)
    hide = {"extensions": {"KHR_node_visibility": {"visible": False}}}
    file.tree["materials"] = [{"name": "seen"}, {"name": "unseen", "emissiveFactor": [1, 1, 1]}]
    plate = {**file.tree["meshes"][0]["primitives"][0], "material": 1}
    file.tree["meshes"].append({"primitives": [plate]})
    shown_one = {"extensions": {"KHR_node_visibility": {"visible": True}}}
    file.tree["nodes"] = [{"mesh": 0, **shown_one}, {"children": [2], **hide}, {"mesh": 1, "translation": [50, 0, 0]}]
    file.tree["scenes"][0]["nodes"] = [0, 1]
    file.tree["extensionsUsed"] = ["KHR_node_visibility"]
    asset = read(file, tmp_path)
    assert len(asset.mesh.faces) == 2 and asset.mesh.parts == ("seen",) and noted(asset, "Hidden nodes")
    assert np.abs(asset.mesh.positions).max() > 0.7, "framed without the hidden plate"
    tree, _ = written(asset, tmp_path / "out.glb")
    assert tree["nodes"] == file.tree["nodes"] and tree["materials"][1] == file.tree["materials"][1]
    file.tree["nodes"][0] |= hide
    with pytest.raises(InputRefused, match="no triangles"):
        read(file, tmp_path)


@pytest.mark.parametrize("scale", [[0, 0, 0], [0, 0, 1], [1, 0, 0]])
def test_nodes_scaled_to_nothing_do_not_count(scale: list[float], tmp_path: Path) -> None:
    """The first instance of a mesh is the one that is painted: it must not be one without an area."""
    file = square()
    file.tree["nodes"] = [{"mesh": 0, "scale": scale, "translation": [9, 9, 9]}, {"mesh": 0}]
    file.tree["scenes"][0]["nodes"] = [0, 1]
    asset = read(file, tmp_path, uv="keep")
    assert len(asset.mesh.faces) == 2 and noted(asset, "scaled to a point or a line")
    assert np.abs(asset.mesh.positions).max() > 0.7
    assert written(asset, tmp_path / "out.glb")[0]["nodes"] == file.tree["nodes"]


def test_faces_without_area_do_not_count_for_framing(tmp_path: Path) -> None:
    (tmp_path / "a.obj").write_text("v 0 0 0\nv 2 0 0\nv 0 2 0\nv 90 90 90\nf 1 2 3\nf 4 4 4\n")
    assert np.abs(read_mesh(tmp_path / "a.obj", size=64).mesh.positions[:3]).max() > 0.5


# --- emission and unlit ---


def test_what_shows_its_emission_alone_has_it_as_albedo(tmp_path: Path) -> None:
    """The old way to say "unlit"; in the result the emission does not lie over the painting."""
    texels = noise(tmp_path)
    file = square(material=0)
    file.tree |= {"textures": [{"source": 0}], "images": [{"uri": "a.png"}]}
    file.tree["extensionsUsed"] = ["KHR_materials_emissive_strength"]
    file.tree["materials"] = [{
        "pbrMetallicRoughness": {"baseColorFactor": [0, 0, 0, 1]},
        "emissiveTexture": {"index": 0}, "emissiveFactor": [1, 0.5, 1],
        "extensions": {"KHR_materials_emissive_strength": {"emissiveStrength": 2}},
    }]  # fmt: skip
    asset = read(file, tmp_path, uv="keep")
    index = (INNER * SIDE).astype(int)
    assert shown(asset, INNER) == pytest.approx(texels[index[:, 1], index[:, 0]] * [1, 0.5, 1], abs=1e-5)
    assert noted(asset, "only its emission")
    assert "missive" not in str(written(asset, tmp_path / "out.glb")[0])


def test_lamps_keep_their_light_and_unlit_goes_when_asked(tmp_path: Path) -> None:
    file = square(material=0)
    file.tree["materials"] = [{"emissiveFactor": [1, 0, 0], "extensions": {"KHR_materials_unlit": {}}}]
    file.tree["extensionsUsed"] = ["KHR_materials_unlit"]
    asset = read(file, tmp_path)
    assert noted(asset, "emits light", "stays") and noted(asset, "unlit", "--lit")
    kept = written(asset, tmp_path / "out.glb")[0]
    assert kept["materials"][0]["emissiveFactor"] == [1, 0, 0] and kept["extensionsUsed"] == ["KHR_materials_unlit"]
    assert "unlit" not in str(written(read(file, tmp_path, lit=True), tmp_path / "lit.glb")[0])


# --- what is noted and not drawn ---


@pytest.mark.parametrize(
    ("material", "words"),
    [
        ({"alphaMode": "BLEND", "pbrMetallicRoughness": {"baseColorFactor": [1, 1, 1, 0.5]}}, ("blended", "stays")),
        ({"alphaMode": "MASK", "pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}, ("cut out", "stays")),
        (
            {"pbrMetallicRoughness": {}, "extensions": {"KHR_materials_sheen": {}, "KHR_materials_clearcoat": {}}},
            ("KHR_materials_sheen", "stays", "renders here leave it out"),
        ),
        ({"pbrMetallicRoughness": {}, "extensions": {"KHR_materials_clearcoat": {}}}, ("clearcoat", "paintings")),
        (
            {"pbrMetallicRoughness": {}, "extensions": {"KHR_materials_clearcoat": {"clearcoatTexture": {"index": 0}}}},
            ("KHR_materials_clearcoat", "not the textures"),
        ),
        ({"extensions": {"KHR_materials_pbrSpecularGlossiness": {}}}, ("specular colour",)),
        ({"doubleSided": True}, ("rough metal",)),
        (None, ("no material", "rough metal")),
    ],
)
def test_what_is_not_drawn_is_noted(material: Tree | None, words: tuple[str, ...], tmp_path: Path) -> None:
    noise(tmp_path)
    file = square(**({} if material is None else {"material": 0}))
    file.tree |= {"textures": [{"source": 0}], "images": [{"uri": "a.png"}]}
    file.tree["materials"] = [material or {}]
    file.tree["extensionsUsed"] = sorted(file.tree["materials"][0].get("extensions", {}))
    assert noted(read(file, tmp_path), *words)


@pytest.mark.parametrize(("filtering", "said"), [(9728, True), (9729, False), (None, False)])
def test_nearest_lookups_are_noted(filtering: int | None, said: bool, tmp_path: Path) -> None:
    noise(tmp_path)
    file = textured(square(material=0))
    file.tree["samplers"] = [{} if filtering is None else {"magFilter": filtering}]
    file.tree["textures"][0]["sampler"] = 0
    assert noted(read(file, tmp_path), "nearest texel") == said


@pytest.mark.parametrize("alpha", ["OPAQUE", "BLEND", "MASK"])
def test_nothing_is_noted_of_a_plain_material(alpha: str, tmp_path: Path) -> None:
    """An alpha mode without an alpha changes nothing."""
    file = square(material=0)
    file.tree["materials"] = [{"alphaMode": alpha, "pbrMetallicRoughness": {"roughnessFactor": 0.3}}]
    assert read(file, tmp_path).source.notes == ()


# --- containers and codecs ---


def compressed(required: bool = False, plain: bool = True) -> File:
    file = square()
    primitive = file.tree["meshes"][0]["primitives"][0]
    view = file.view(b"not really Draco")
    primitive["extensions"] = {"KHR_draco_mesh_compression": {"bufferView": view, "attributes": {"POSITION": 0}}}
    file.tree["extensionsUsed"] = ["KHR_draco_mesh_compression"]
    if required:
        file.tree["extensionsRequired"] = ["KHR_draco_mesh_compression"]
    if not plain:
        del file.tree["accessors"][primitive["attributes"]["POSITION"]]["bufferView"]
    return file


def test_optional_compression_is_left_out(tmp_path: Path) -> None:
    asset = read(compressed(), tmp_path, uv="keep")
    assert len(asset.mesh.faces) == 2 and noted(asset, "compressed copy", "KHR_draco_mesh_compression")
    assert "draco" not in str(written(asset, tmp_path / "out.glb")[0])
    for file in (compressed(required=True), compressed(plain=False)):
        with pytest.raises(InputRefused, match="without compression"):
            read(file, tmp_path)


@pytest.mark.parametrize("there", [True, False])
def test_optional_meshopt_is_read_where_its_fallback_is_there(there: bool, tmp_path: Path) -> None:
    file = square()
    file.tree["extensionsUsed"] = ["EXT_meshopt_compression"]
    stub = {"buffer": 0, "byteLength": 4, "byteStride": 4, "count": 1, "mode": "ATTRIBUTES"}
    file.tree["bufferViews"][0]["extensions"] = {"EXT_meshopt_compression": stub}
    if not there:
        file.tree["bufferViews"][0]["buffer"] = 1
    path = file.save(tmp_path / "a.gltf")
    if not there:
        import json

        tree = json.loads(path.read_text())
        tree["buffers"].append({"byteLength": 1000, "extensions": {"EXT_meshopt_compression": {"fallback": True}}})
        path.write_text(json.dumps(tree))
        with pytest.raises(InputRefused, match="without compression"):
            read_mesh(path, size=64)
        return
    assert noted(read_mesh(path, size=64), "EXT_meshopt_compression")


def test_json_padded_with_zero_bytes(tmp_path: Path) -> None:
    file = square()
    content = glb({**file.tree, "buffers": [{"byteLength": len(file.bytes)}]}, file.bytes)
    length = struct.unpack_from("<I", content, 12)[0]
    text = content[20 : 20 + length].rstrip()
    text += b" " * (3 - len(text) % 4) + b"\0"
    text += b"\0" * (-len(text) % 4)
    rest = content[20 + length :]
    head = struct.pack("<4sIII4s", b"glTF", 2, 20 + len(text) + len(rest), len(text), b"JSON")
    (tmp_path / "a.glb").write_bytes(head + text + rest)
    assert noted(read_mesh(tmp_path / "a.glb", uv="keep", size=64), "zero bytes")


def test_avif_textures(tmp_path: Path) -> None:
    buffer = io.BytesIO()
    colours = np.zeros((16, 16, 3), np.uint8)
    colours[:8, :8], colours[8:, 8:] = (255, 0, 0), (0, 0, 255)
    Image.fromarray(colours).save(buffer, "AVIF", quality=100)
    file = textured(square())
    view = file.view(buffer.getvalue())
    file.tree["images"] = [{"bufferView": view, "mimeType": "image/avif"}]
    file.tree["textures"] = [{"extensions": {"EXT_texture_avif": {"source": 0}}}]
    file.tree["extensionsUsed"] = file.tree["extensionsRequired"] = ["EXT_texture_avif"]
    asset = read(file, tmp_path, uv="keep")
    assert shown(asset, np.array([[0.2, 0.2], [0.8, 0.8]])) == pytest.approx(np.eye(3)[[0, 2]], abs=0.05)
    tree, _ = written(asset, tmp_path / "out.glb")
    assert "extensionsRequired" not in tree, "the result needs no AVIF"
