"""glTF: vertices, UVs and materials as the specification has them, and everything else refused with a sentence."""

import base64
import copy
import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from mistyle.core.asset import Asset
from mistyle.core.errors import InputRefused
from mistyle.io.gltf.read import read_gltf, world_matrices
from mistyle.io.meshes.parsed_mesh import Corners
from mistyle.io.read_mesh import load_gltf, read_mesh
from tests.io.meshes.test_read import check_asset
from tests.support.helpers import data

Tree = dict[str, Any]
TYPES = {"f4": 5126, "u4": 5125, "u2": 5123, "u1": 5121, "i2": 5122, "i1": 5120}
SHAPES = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4", 16: "MAT4"}

POSITION = np.array([[0, 0, 0], [2, 0, 0], [2, 2, 0], [0, 2, 0]], np.float32)
NORMAL = np.tile(np.float32([0, 0, 1]), (4, 1))
UV_DOWN = np.array([[0, 1], [1, 1], [1, 0], [0, 0]], np.float32)  # as glTF stores them: v from the top
INDEX = np.array([0, 1, 2, 0, 2, 3], np.uint16)


class File:
    """A glTF in the making: one buffer as a data URI."""

    def __init__(self) -> None:
        self.bytes = b""
        self.tree: Tree = {"asset": {"version": "2.0"}, "bufferViews": [], "accessors": []}

    def view(self, content: bytes, **more: int) -> int:
        self.tree["bufferViews"].append(
            {"buffer": 0, "byteOffset": len(self.bytes), "byteLength": len(content), **more}
        )
        self.bytes += content + bytes(-len(content) % 4)
        return len(self.tree["bufferViews"]) - 1

    def accessor(self, array: np.ndarray, **more: Any) -> int:
        kind, shape = TYPES[array.dtype.str[1:]], SHAPES[1 if array.ndim == 1 else array.shape[1]]
        view = self.view(np.ascontiguousarray(array).tobytes())
        self.tree["accessors"].append(
            {"bufferView": view, "componentType": kind, "count": len(array), "type": shape, **more}
        )
        return len(self.tree["accessors"]) - 1

    def save(self, path: Path) -> Path:
        uri = "data:application/octet-stream;base64," + base64.b64encode(self.bytes).decode()
        tree = {**self.tree, "buffers": [{"byteLength": len(self.bytes), "uri": uri}]} if self.bytes else self.tree
        path.write_text(json.dumps({k: v for k, v in tree.items() if v != []}))
        return path


def square(**primitive: Any) -> File:
    """One quad with normals, UVs and one node."""
    file = File()
    attributes = {
        "POSITION": file.accessor(POSITION),
        "NORMAL": file.accessor(NORMAL),
        "TEXCOORD_0": file.accessor(UV_DOWN),
    }
    entry = {"attributes": attributes, "indices": file.accessor(INDEX), **primitive}
    file.tree |= {"meshes": [{"primitives": [entry]}], "nodes": [{"mesh": 0}], "scenes": [{"nodes": [0]}], "scene": 0}
    return file


def picture(folder: Path, name: str = "a.png") -> None:
    """Red at the top left, green at the bottom left, black elsewhere."""
    pixels = np.zeros((8, 8, 3), np.uint8)
    pixels[0, 0], pixels[7, 0] = (255, 0, 0), (0, 255, 0)
    Image.fromarray(pixels).save(folder / name)


def textured(file: File, info: Tree | None = None, uri: str = "a.png") -> File:
    material = {"name": "painted", "pbrMetallicRoughness": {"baseColorTexture": {"index": 0, **(info or {})}}}
    file.tree |= {"materials": [material], "textures": [{"source": 0}], "images": [{"uri": uri}]}
    file.tree["meshes"][0]["primitives"][0]["material"] = 0
    return file


def test_v_goes_up_and_row_0_is_v_1(tmp_path: Path) -> None:
    picture(tmp_path)
    asset = read_mesh(textured(square()).save(tmp_path / "a.gltf"), uv="keep")
    check_asset(asset)
    assert asset.source.user_positions.tolist() == POSITION.tolist()
    assert asset.mesh.corner_uvs.tolist() == [[[0, 0], [1, 0], [1, 1]], [[0, 0], [1, 1], [0, 1]]]
    albedo = asset.materials[0].albedo
    assert albedo is not None and asset.mesh.parts == ("painted",)
    assert albedo[0, 0].tolist() == [1, 0, 0]  # (u, v) = (0, 1), the corner at (0, 2, 0)
    assert albedo[7, 0].tolist() == [0, 1, 0]


@pytest.mark.parametrize(
    "file", ["pbr/Avocado/Avocado.gltf", "pbr/WaterBottle/WaterBottle.gltf", "pbr/NormalTangentTest.glb"]
)
def test_real_files_against_an_independent_reader(file: str) -> None:
    path = data(f"meshes/{file}")
    asset = read_mesh(path, uv="keep")
    check_asset(asset)
    other = trimesh.load(path, process=False, force="mesh")
    assert asset.source.user_positions == pytest.approx(np.asarray(other.vertices), abs=1e-6)
    assert np.array_equal(asset.mesh.faces, other.faces)
    assert asset.mesh.corner_uvs == pytest.approx(np.asarray(other.visual.uv)[other.faces], abs=1e-6)
    theirs = other.visual.material.baseColorTexture.convert("RGB")
    mine = asset.materials[0].albedo
    assert mine is not None and mine.shape[:2] == theirs.size[::-1]
    pixel = np.array(theirs)[100, 200] / 255
    expected = np.where(pixel <= 0.04045, pixel / 12.92, ((pixel + 0.055) / 1.055) ** 2.4)
    assert mine[100, 200] == pytest.approx(expected, abs=1e-4)
    roughness = asset.materials[0].roughness
    assert roughness is not None and 0 <= roughness.min() <= roughness.max() <= 1


def test_nodes_move_turn_and_mirror(tmp_path: Path) -> None:
    file = square()
    turn = [0, 0, np.sqrt(0.5), np.sqrt(0.5)]  # 90 degrees about z
    file.tree["nodes"] = [
        {"children": [1, 2], "translation": [10, 0, 0], "rotation": turn},
        {"mesh": 0, "scale": [1, 3, 1]},
        {"mesh": 0, "matrix": [-1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 5, 0, 0, 1]},  # mirrored in x
        {"mesh": 0, "translation": [0, 0, 99]},  # in no scene
    ]
    asset = read_mesh(file.save(tmp_path / "a.gltf"), uv="keep")
    check_asset(asset)
    expected = [[10 - 3 * y, x, z] for x, y, z in POSITION] + [[10 - y, 5 - x, z] for x, y, z in POSITION]
    assert asset.source.user_positions == pytest.approx(np.array(expected))
    assert asset.mesh.faces.tolist() == [[0, 1, 2], [0, 2, 3], [4, 6, 5], [4, 7, 6]]  # the mirrored winding is turned
    assert asset.mesh.corner_normals == pytest.approx(np.tile([0, 0, 1], (4, 3, 1)), abs=1e-6)
    assert [(p.node, p.mesh, p.primitive, p.start, p.stop, p.first_vertex) for p in asset.source.primitives] == [
        (1, 0, 0, 0, 2, 0),
        (2, 0, 0, 2, 4, 4),
    ]
    assert asset.mesh.corner_uvs[2].tolist() == [[0, 0], [1, 1], [1, 0]]
    assert any("several instances" in note for note in asset.source.notes)


def test_normals_go_with_the_inverse_transpose(tmp_path: Path) -> None:
    file = square()
    slope = np.tile(np.float32([np.sqrt(0.5), 0, np.sqrt(0.5)]), (4, 1))
    file.tree["meshes"][0]["primitives"][0]["attributes"]["NORMAL"] = file.accessor(slope)
    file.tree["nodes"][0]["scale"] = [1, 1, 4]
    asset = read_mesh(file.save(tmp_path / "a.gltf"))
    assert asset.mesh.corner_normals[0, 0] == pytest.approx(np.array([4, 0, 1]) / np.sqrt(17), abs=1e-6)


def test_instances_share_new_uvs(tmp_path: Path) -> None:
    file = square()
    del file.tree["meshes"][0]["primitives"][0]["attributes"]["TEXCOORD_0"]
    file.tree["nodes"] = [{"mesh": 0}, {"mesh": 0, "translation": [9, 0, 0]}, {"mesh": 0, "scale": [-1, 1, 1]}]
    file.tree["scenes"][0]["nodes"] = [0, 1, 2]
    asset = read_mesh(file.save(tmp_path / "a.gltf"))
    check_asset(asset)
    uvs = asset.mesh.corner_uvs
    assert asset.source.uv == "new" and np.array_equal(uvs[:2], uvs[2:4])
    assert np.array_equal(uvs[:2][:, [0, 2, 1]], uvs[4:])  # vertex by vertex the same, in the turned winding


def instanced(counts: list[int]) -> File:
    """Nodes with so many instances of the square each, and a plain one."""
    file = square()
    for count in counts:
        places = file.accessor(np.arange(3 * count, dtype=np.float32).reshape(-1, 3))
        extension = {"EXT_mesh_gpu_instancing": {"attributes": {"TRANSLATION": places}}}
        file.tree["nodes"].append({"mesh": 0, "extensions": extension})
    file.tree["nodes"].append(file.tree["nodes"].pop(0))
    file.tree["scenes"][0]["nodes"] = list(range(len(file.tree["nodes"])))
    file.tree["extensionsUsed"] = ["EXT_mesh_gpu_instancing"]
    return file


@pytest.mark.parametrize(
    ("counts", "most", "read"),
    [
        ([10], 100, [10]),
        ([10], 22, [10]),  # 2 faces each, and 2 of the plain node
        ([10], 21, [9]),
        ([10], 3, [1]),
        ([6, 6], 20, [6, 3]),
        ([6, 6], 12, [4, 1]),  # the later nodes' first instances have their room
    ],
)
def test_as_many_instances_are_read_as_fit(counts: list[int], most: int, read: list[int], tmp_path: Path) -> None:
    path = instanced(counts).save(tmp_path / "a.gltf")
    if most < 4:
        with pytest.raises(InputRefused, match="at most 3"):
            read_gltf(path, most)
        return
    raw = read_gltf(path, most).raw
    assert [sum(p.node == k for p in raw.primitives) for k in range(len(counts) + 1)] == [*read, 1]
    told = [f"Only the first {k} of {n} instances" for n, k in zip(counts, read, strict=True) if k < n]
    notes = [note for note in raw.notes if "instances (" in note]
    assert [any(note.startswith(text) for note in notes) for text in told] == [True] * len(told) and (
        len(notes) == len(told) and all("read.max_faces" in note and "of a mesh with 2 faces" in note for note in notes)
    )


def test_the_fixed_limit_of_instances_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("mistyle.io.gltf.read.MAX_INSTANCED", 8)
    raw = read_gltf(instanced([10]).save(tmp_path / "a.gltf"), 1000).raw
    assert len(raw.faces) == 10 and any("up to 8 faces of the scene (a fixed limit)" in note for note in raw.notes)


@pytest.mark.parametrize(
    ("mode", "index", "faces"),
    [
        (4, [0, 1, 2, 0, 2, 3], [[0, 1, 2], [0, 2, 3]]),
        (5, [0, 1, 3, 2], [[0, 1, 3], [1, 2, 3]]),  # glTF 2.0, 3.7.2.1: the second triangle is p1 p3 p2 turned
        (6, [0, 1, 2, 3], [[1, 2, 0], [2, 3, 0]]),
        (5, None, [[0, 1, 2], [1, 3, 2]]),
    ],
)
def test_strips_and_fans(mode: int, index: list[int] | None, faces: list[list[int]], tmp_path: Path) -> None:
    file = square(mode=mode)
    if index is None:
        del file.tree["meshes"][0]["primitives"][0]["indices"]
    else:
        file.tree["meshes"][0]["primitives"][0]["indices"] = file.accessor(np.array(index, np.uint8))
    assert read_gltf(file.save(tmp_path / "a.gltf"), 100).raw.faces.tolist() == faces


def test_points_and_lines_are_left_out(tmp_path: Path) -> None:
    file = square()
    line = copy.deepcopy(file.tree["meshes"][0]["primitives"][0]) | {"mode": 1}
    file.tree["meshes"][0]["primitives"].insert(0, line)
    raw = read_gltf(file.save(tmp_path / "a.gltf"), 100).finished()
    assert len(raw.faces) == 2 and raw.primitives[0].primitive == 1 and "Points and lines" in raw.notes[0]


def test_packed_accessors(tmp_path: Path) -> None:
    """Sparse values, normalised and plain small integers, byte strides."""
    file = square()
    attributes = file.tree["meshes"][0]["primitives"][0]["attributes"]
    where, new = file.view(np.array([2], np.uint8).tobytes()), file.view(np.float32([5, 5, 5]).tobytes())
    sparse = {"count": 1, "indices": {"bufferView": where, "componentType": 5121}, "values": {"bufferView": new}}
    file.tree["accessors"][attributes["POSITION"]]["sparse"] = sparse
    attributes["TEXCOORD_0"] = file.accessor(
        np.array([[0, 255], [255, 255], [255, 0], [0, 51]], np.uint8), normalized=True
    )
    loose = np.zeros((4, 5), np.float32)
    loose[:, :3] = NORMAL
    view = file.view(loose.tobytes(), byteStride=20)
    file.tree["accessors"].append({"bufferView": view, "componentType": 5126, "count": 4, "type": "VEC3"})
    attributes["NORMAL"] = len(file.tree["accessors"]) - 1
    raw = read_gltf(file.save(tmp_path / "a.gltf"), 100).finished()
    assert raw.positions[2].tolist() == [5, 5, 5] and raw.positions[1].tolist() == [2, 0, 0]
    assert raw.uvs is not None and raw.uvs[1] == pytest.approx(np.array([[0, 0], [1, 1], [0, 0.8]]))
    assert raw.normals is not None and raw.normals[1].tolist() == [[0, 0, 1]] * 3


def test_corners_are_sent_as_indices(tmp_path: Path) -> None:
    """Primitives that share positions, one of them without UVs and normals, and an index that no reader would send."""
    file = square()
    first = file.tree["meshes"][0]["primitives"][0]
    bare = copy.deepcopy(first)
    bare["attributes"] = {"POSITION": first["attributes"]["POSITION"]}
    one = read_gltf(file.save(tmp_path / "a.gltf"), 100)
    assert one.normals.index is one.raw.faces and one.uvs is not None and one.uvs.index is one.raw.faces
    file.tree["meshes"][0]["primitives"] = [first, bare, copy.deepcopy(first)]
    found = read_gltf(file.save(tmp_path / "b.gltf"), 100)
    raw, alone = found.finished(), one.finished()
    assert len(raw.positions) == 4 and raw.faces.dtype == np.int32 and np.array_equal(raw.faces[4:], alone.faces)
    for name in ("normals", "uvs"):
        corners, expected = getattr(raw, name), getattr(alone, name)
        assert np.array_equal(corners[:2], expected) and np.array_equal(corners[4:], expected)
    assert raw.uvs is not None and np.isnan(raw.uvs[2:4]).all()
    assert raw.normals is not None and np.allclose(np.abs(raw.normals[2:4] @ alone.normals[0, 0]), 1)
    wild = Corners(found.normals.values, np.array([[0, -5, 10**9]], np.int32))
    assert np.array_equal(wild.finished()[0], found.normals.values[[0, 0, -1]])


def test_missing_normals_are_flat(tmp_path: Path) -> None:
    file = square()
    attributes = file.tree["meshes"][0]["primitives"][0]["attributes"]
    del attributes["NORMAL"]
    attributes["POSITION"] = file.accessor(np.float32([[0, 0, 0], [2, 0, 0], [2, 2, 0.3], [0, 2, 0]]))
    asset = read_mesh(file.save(tmp_path / "a.gltf"), uv="keep")
    corners = asset.mesh.positions[asset.mesh.faces].astype(float)
    flat = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    flat /= np.linalg.norm(flat, axis=1, keepdims=True)
    assert asset.mesh.corner_normals == pytest.approx(np.repeat(flat[:, None], 3, axis=1), abs=1e-5)


def test_a_skinned_mesh_stands_in_its_bind_pose(tmp_path: Path) -> None:
    """The node's own transform has no meaning; the skeleton's root says where the mesh stands, and how large."""
    file = square()
    inverse = np.stack([np.diag([0.5, 0.5, 0.5, 1]).astype(np.float32)] * 2).reshape(2, 16)
    file.tree["skins"] = [{"joints": [2, 1], "inverseBindMatrices": file.accessor(inverse)}]
    file.tree["nodes"] = [
        {"mesh": 0, "skin": 0, "translation": [99, 99, 99]},
        {"children": [2], "translation": [1, 0, 0]},
        {"translation": [0, 7, 0]},
    ]
    file.tree["scenes"][0]["nodes"] = [0, 1]
    raw = read_gltf(file.save(tmp_path / "a.gltf"), 100).finished()
    assert raw.positions == pytest.approx(POSITION * 0.5 + [1, 0, 0])


def test_world_matrices_of_a_chain(rng: np.random.Generator) -> None:
    nodes = [{"children": [i + 1]} for i in range(5)] + [{}]
    for node in nodes:
        node |= {"translation": rng.normal(size=3).tolist(), "scale": rng.uniform(0.5, 2, 3).tolist()}
        quaternion = rng.normal(size=4)
        node["rotation"] = (quaternion / np.linalg.norm(quaternion)).tolist()
    world = world_matrices({"nodes": nodes})
    product = np.eye(4)
    for i, node in enumerate(nodes):
        matrix = trimesh.transformations.quaternion_matrix(np.roll(node["rotation"], 1))
        matrix[:3, :3] *= node["scale"]
        matrix[:3, 3] = node["translation"]
        product = product @ matrix
        assert world[i] == pytest.approx(product)


def test_a_second_uv_set_is_found(tmp_path: Path) -> None:
    picture(tmp_path)
    file = textured(square(), {"texCoord": 1})
    attributes = file.tree["meshes"][0]["primitives"][0]["attributes"]
    attributes["TEXCOORD_1"] = file.accessor(UV_DOWN * np.float32(0.5))
    asset = read_mesh(file.save(tmp_path / "a.gltf"), uv="keep")
    assert asset.source.primitives[0].texcoord == 1
    assert asset.mesh.corner_uvs[0].tolist() == [[0, 0.5], [0.5, 0.5], [0.5, 1]]


def shown(asset: Asset, at: np.ndarray) -> np.ndarray:
    """The albedo that the asset of `square` shows at these places of the quad (x to the right, y down, both 0..1)."""
    uvs, albedo = asset.mesh.corner_uvs, asset.materials[0].albedo
    result = []
    for x, y in at:
        y = 1 - y
        a, b, c = uvs[0] if y <= x else uvs[1]  # corners 00 10 11 and 00 11 01
        uv = a + (x - y) * (b - a) + y * (c - a) if y <= x else a + x * (b - a) + (y - x) * (c - a)
        h, w = albedo.shape[:2]
        result.append(albedo[int(np.floor((1 - uv[1]) * h)) % h, int(np.floor(uv[0] * w)) % w])
    return np.array(result) * asset.materials[0].albedo_factor


def test_texture_transforms_are_applied(tmp_path: Path) -> None:
    """KHR_texture_transform: the quarter of the texture at the top left covers the whole square."""
    pixels = np.zeros((64, 64, 3), np.uint8)
    pixels[:32, :32] = (255, 255, 255)
    Image.fromarray(pixels).save(tmp_path / "a.png")
    moved = {"extensions": {"KHR_texture_transform": {"scale": [0.5, 0.5]}}}
    file = textured(square(), moved)
    file.tree["extensionsRequired"] = ["KHR_texture_transform"]
    asset = read_mesh(file.save(tmp_path / "a.gltf"), uv="keep")
    inner = np.array([[u, v] for u in (0.1, 0.5, 0.9) for v in (0.1, 0.5, 0.9)])
    assert shown(asset, inner).min() > 0.99 and asset.materials[0].albedo.shape == (64, 64, 3)
    file.tree["materials"][0]["pbrMetallicRoughness"]["baseColorTexture"]["extensions"]["KHR_texture_transform"] = {
        "offset": [0.5, 0], "rotation": np.pi / 2, "scale": [0.5, 1]
    }  # fmt: skip
    turned = read_mesh(file.save(tmp_path / "b.gltf"), uv="keep")
    for u, v in ((0.1, 0.1), (0.9, 0.1), (0.1, 0.9), (0.9, 0.9)):  # v from the top
        x, y = 0.5 + v, -0.5 * u  # translation * rotation * scale, as the extension writes it out
        expected = 1.0 if x % 1 < 0.5 and y % 1 < 0.5 else 0.0
        assert shown(turned, np.array([[u, v]]))[0, 0] == pytest.approx(expected, abs=0.01)


def test_factors_and_defaults(tmp_path: Path) -> None:
    file = square(material=0)
    file.tree["materials"] = [
        {"name": "a", "pbrMetallicRoughness": {"baseColorFactor": [0.1, 0.2, 0.3, 1], "metallicFactor": 0.25}},
        {
            "extensions": {
                "KHR_materials_pbrSpecularGlossiness": {"diffuseFactor": [0.5, 0, 0, 1], "glossinessFactor": 0.75}
            }
        },
        {"name": "says nothing"},
    ]
    file.tree["meshes"][0]["primitives"] += [
        {**file.tree["meshes"][0]["primitives"][0], "material": 1},
        {**file.tree["meshes"][0]["primitives"][0], "material": 2},
    ]
    a, b, c = read_mesh(file.save(tmp_path / "a.gltf")).materials
    assert a.albedo_factor == pytest.approx([0.1, 0.2, 0.3]) and (a.roughness_factor, a.metallic_factor) == (1, 0.25)
    assert b.albedo_factor == pytest.approx([0.5, 0, 0]) and (b.roughness_factor, b.metallic_factor) == (0.25, 0)
    assert (b.name, c.name) == ("material_1", "says nothing") and c.metallic_factor == 0


def edit(*path: Any, to: Any) -> Any:
    def change(file: File) -> None:
        at: Any = file.tree
        for step in path[:-1]:
            at = at[step]
        at[path[-1]] = to

    return change


BROKEN = {
    "cycle": (edit("nodes", to=[{"children": [1], "mesh": 0}, {"children": [0]}]), "cycle"),
    "self": (edit("nodes", 0, "children", to=[0]), "below itself"),
    "two parents": (edit("nodes", to=[{"children": [2]}, {"children": [2]}, {"mesh": 0}]), "below two nodes"),
    "deep": (edit("nodes", to=[{"children": [i + 1]} for i in range(300)] + [{"mesh": 0}]), "nested deeper"),
    "no child": (edit("nodes", 0, "children", to=[7]), "child 7"),
    "no mesh": (edit("nodes", 0, "mesh", to=3), "mesh 3"),
    "negative": (edit("nodes", 0, "mesh", to=-1), "nodes.0.mesh"),
    "text": (edit("nodes", 0, "mesh", to="0"), "nodes.0.mesh"),
    "long accessor": (edit("accessors", 0, "count", to=10**9), "accessors.0.count"),
    "longer than its view": (edit("accessors", 3, "count", to=7), "of its view"),
    "offset": (edit("accessors", 0, "byteOffset", to=4), "of its view"),
    "view past the buffer": (edit("bufferViews", 0, "byteLength", to=10**6), "the buffer's length"),
    "type": (edit("accessors", 0, "componentType", to=1), "a type of glTF"),
    "flat positions": (edit("accessors", 0, "type", to="VEC2"), "VEC3"),
    "float indices": (edit("accessors", 3, "componentType", to=5122), "unsigned"),
    "attribute counts": (edit("accessors", 1, "count", to=3), "one number for all"),
    "infinite transform": (edit("nodes", 0, "scale", to=[1e308, 1e308, 1e308]), "not finite"),
    "version": (edit("asset", "version", to="1.0"), "2.0"),
    "glTF 1.0": (edit("accessors", to={"accessor_0": {}}), "glTF 1.0"),
    "draco": (edit("extensionsRequired", to=["KHR_draco_mesh_compression"]), "without compression"),
    "meshopt": (edit("extensionsRequired", to=["EXT_meshopt_compression"]), "without compression"),
    "unknown": (edit("extensionsRequired", to=["ACME_holograms"]), "ACME_holograms"),
    "empty scene": (edit("scenes", 0, "nodes", to=[]), "no triangles"),
    "scene": (edit("scene", to=4), "scene 4"),
    "sampler": (edit("textures", to=[{"sampler": 3}]), "sampler 3"),
    "emission": (edit("materials", to=[{"emissiveTexture": {"index": 2}}]), "texture 2"),
    "emission's colour": (edit("materials", to=[{"emissiveFactor": [1]}]), "materials.0.emissiveFactor"),
    "flat colours": (edit("meshes", 0, "primitives", 0, "attributes", "COLOR_0", to=2), "VEC3 or VEC4"),
}


@pytest.mark.parametrize("name", BROKEN)
def test_broken_files_are_refused(name: str, tmp_path: Path) -> None:
    change, word = BROKEN[name]
    file = square()
    change(file)
    with pytest.raises(InputRefused, match=word) as refusal:
        read_mesh(file.save(tmp_path / "a.gltf"))
    assert "a.gltf" in str(refusal.value) and "expected" in str(refusal.value)


def test_an_index_past_the_vertices_is_refused(tmp_path: Path) -> None:
    file = square()
    file.tree["meshes"][0]["primitives"][0]["indices"] = file.accessor(np.array([0, 1, 9], np.uint16))
    with pytest.raises(InputRefused, match="vertex 9"):
        read_mesh(file.save(tmp_path / "a.gltf"))
    file.tree["accessors"][-1]["sparse"] = {
        "count": 1,
        "indices": {"bufferView": file.view(bytes([200])), "componentType": 5121},
        "values": {"bufferView": file.view(bytes(4))},
    }
    with pytest.raises(InputRefused, match="element 200"):
        load_gltf(file.save(tmp_path / "a.gltf"))


@pytest.mark.parametrize(
    "uri",
    ["http://example.org/a.bin", "//example.org/a.bin", "file:///etc/passwd", "/etc/passwd", "../a.bin", "%2e%2e/a.bin",
     "..\\a.bin", "link.bin", "sub/../../a.bin", "C:/a.bin", ""],
)  # fmt: skip
def test_buffers_come_from_the_folder_only(uri: str, tmp_path: Path) -> None:
    (tmp_path / "a.bin").write_bytes(bytes(1000))
    folder = tmp_path / "mesh"
    folder.mkdir()
    (folder / "link.bin").symlink_to(tmp_path / "a.bin")
    (folder / "a.gltf").write_text(
        json.dumps({"asset": {"version": "2.0"}, "buffers": [{"byteLength": 4, "uri": uri}]})
    )
    with pytest.raises(InputRefused, match="a reference to"):
        load_gltf(folder / "a.gltf")


def test_buffers_beside_the_file(tmp_path: Path) -> None:
    (tmp_path / "sub dir").mkdir()
    (tmp_path / "sub dir" / "ä.bin").write_bytes(b"12345678")
    tree = {"asset": {"version": "2.0"}, "buffers": [{"byteLength": 4, "uri": "sub%20dir/%C3%A4.bin"}]}
    (tmp_path / "a.gltf").write_text(json.dumps(tree))
    assert load_gltf(tmp_path / "a.gltf") == (tree, [b"1234"])
    tree["buffers"][0]["byteLength"] = 9
    (tmp_path / "a.gltf").write_text(json.dumps(tree))
    with pytest.raises(InputRefused, match="8 bytes; expected 9"):
        load_gltf(tmp_path / "a.gltf")


@pytest.mark.parametrize("uri", ["http://example.org/a.png", "../a.png", "/a.png"])
def test_images_come_from_the_folder_only(uri: str, tmp_path: Path) -> None:
    with pytest.raises(InputRefused, match="a reference to"):
        read_mesh(textured(square(), uri=uri).save(tmp_path / "a.gltf"))


def test_a_texture_that_is_not_there_is_told(tmp_path: Path) -> None:
    asset = read_mesh(textured(square()).save(tmp_path / "a.gltf"))
    assert asset.materials[0].albedo is None and any("a.png is not there" in note for note in asset.source.notes)
    (tmp_path / "a.png").write_bytes(b"no picture")
    with pytest.raises(InputRefused, match="a.png: found"):
        read_mesh(tmp_path / "a.gltf")


def glb(tree: Tree, binary: bytes) -> bytes:
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    binary += bytes(-len(binary) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(binary), b"BIN\0") + binary
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def square_glb() -> bytes:
    file = square()
    return glb({**file.tree, "buffers": [{"byteLength": len(file.bytes)}]}, file.bytes)


@pytest.mark.parametrize("cut", [3, 11, 19, 40, 500, -1])
def test_cut_off_files_are_refused(cut: int, tmp_path: Path) -> None:
    content = square_glb()
    (tmp_path / "a.glb").write_bytes(content)
    assert read_mesh(tmp_path / "a.glb", uv="keep").source.kind == "glb"
    (tmp_path / "a.glb").write_bytes(content[:cut])
    with pytest.raises(InputRefused):
        read_mesh(tmp_path / "a.glb")


@given(
    edits=st.lists(st.tuples(st.integers(0, 10**6), st.binary(max_size=3), st.integers(0, 6)), min_size=1, max_size=4)
)
def test_damaged_files_open_or_are_refused(edits: list[tuple[int, bytes, int]], tmp_path_factory) -> None:
    """Never another exception, whatever bytes of the JSON or of the buffer are changed."""
    content = square_glb()
    text, binary = content[20 : content.index(b"BIN\0") - 4], content[content.index(b"BIN\0") + 4 :]
    for at, new, gone in edits:
        if at % 4:
            at %= len(text)
            text = text[:at] + new + text[at + gone :]
        else:
            at %= len(binary)
            binary = binary[:at] + new + binary[at + len(new) :]
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(binary), b"BIN\0") + binary
    path = tmp_path_factory.getbasetemp() / "damaged.glb"
    path.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks)
    try:
        raw = read_gltf(path, 1000).finished()
    except InputRefused:
        return
    assert raw.faces.max(initial=-1) < len(raw.positions)
