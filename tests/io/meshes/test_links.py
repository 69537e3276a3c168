"""Meshes that are reached through a link: what they name lies beside the link, or beside the file that it leads to."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from mistyle.core.errors import InputRefused
from mistyle.io.read_mesh import read_mesh, read_references, read_usd_files
from mistyle.io.sandbox.bounds import beside

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="links need a privilege on Windows")
RED, BLUE = (255, 0, 0), (0, 0, 255)


def picture(path: Path, colour: tuple[int, int, int]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.full((4, 4, 3), colour, np.uint8)).save(path)


def obj(folder: Path) -> Path:
    corners = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\n"
    (folder / "box.obj").write_text(f"mtllib box.mtl\n{corners}usemtl m\nf 1/1 2/2 3/3 4/4\n")
    (folder / "box.mtl").write_text("newmtl m\nmap_Kd maps/red.png\n")
    picture(folder / "maps" / "red.png", RED)
    return folder / "box.obj"


def gltf(folder: Path) -> Path:
    numbers = [np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], "f4"), np.array([[0, 0], [1, 0], [0, 1]], "f4")]
    (folder / "box.bin").write_bytes(b"".join(n.tobytes() for n in numbers))
    views = [{"buffer": 0, "byteOffset": 0, "byteLength": 36}, {"buffer": 0, "byteOffset": 36, "byteLength": 24}]
    accessors = [{"bufferView": k, "componentType": 5126, "count": 3, "type": f"VEC{3 - k}"} for k in (0, 1)]
    accessors[0] |= {"min": [0, 0, 0], "max": [1, 1, 0]}
    texture = {"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}
    primitive = {"attributes": {"POSITION": 0, "TEXCOORD_0": 1}, "material": 0}
    tree = {
        "asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": [0]}], "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [primitive]}], "materials": [texture], "textures": [{"source": 0}],
        "images": [{"uri": "maps/red.png"}], "buffers": [{"uri": "box.bin", "byteLength": 60}], "bufferViews": views,
        "accessors": accessors,
    }  # fmt: skip
    (folder / "box.gltf").write_text(json.dumps(tree))
    picture(folder / "maps" / "red.png", RED)
    return folder / "box.gltf"


def usda(folder: Path) -> Path:
    (folder / "box.usda").write_text(
        """#usda 1.0
        (
            defaultPrim = "box"
            upAxis = "Y"
        )
        def Mesh "box" (prepend apiSchemas = ["MaterialBindingAPI"])
        {
            int[] faceVertexCounts = [4]
            int[] faceVertexIndices = [0, 1, 2, 3]
            point3f[] points = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)]
            texCoord2f[] primvars:st = [(0, 0), (1, 0), (1, 1), (0, 1)] (
                interpolation = "vertex"
            )
            rel material:binding = </box/m>
            def Material "m"
            {
                token outputs:surface.connect = </box/m/s.outputs:surface>
                def Shader "s"
                {
                    uniform token info:id = "UsdPreviewSurface"
                    color3f inputs:diffuseColor.connect = </box/m/t.outputs:rgb>
                    token outputs:surface
                }
                def Shader "t"
                {
                    uniform token info:id = "UsdUVTexture"
                    asset inputs:file = @maps/red.png@
                    float2 inputs:st.connect = </box/m/r.outputs:result>
                    float3 outputs:rgb
                }
                def Shader "r"
                {
                    uniform token info:id = "UsdPrimvarReader_float2"
                    string inputs:varname = "st"
                    float2 outputs:result
                }
            }
        }"""
    )
    picture(folder / "maps" / "red.png", RED)
    return folder / "box.usda"


def colour(mesh: Path) -> list[int]:
    albedo = read_mesh(mesh).materials[0].albedo
    assert albedo is not None, "the texture was not found"
    return np.rint(255 * albedo[0, 0]).astype(int).tolist()


@pytest.mark.parametrize("make", [obj, gltf, usda])
def test_what_a_linked_mesh_names_lies_beside_the_file(tmp_path, make):
    (tmp_path / "store").mkdir()
    (tmp_path / "scene").mkdir()
    mesh = make(tmp_path / "store")
    link = tmp_path / "scene" / mesh.name
    link.symlink_to(mesh)
    assert colour(link) == list(RED)
    # What a key is made of are the same files.
    files = read_usd_files(link) if mesh.suffix == ".usda" else read_references(link)
    assert tmp_path / "store" / "maps" / "red.png" in files


@pytest.mark.parametrize("make", [obj, gltf])
def test_what_lies_beside_the_link_comes_first(tmp_path, make):
    (tmp_path / "store").mkdir()
    mesh = make(tmp_path / "store")
    scene = tmp_path / "scene"
    picture(scene / "maps" / "red.png", BLUE)
    (scene / mesh.name).symlink_to(mesh)
    if make is obj:
        (scene / "box.mtl").write_text("newmtl m\nmap_Kd maps/red.png\n")
    assert colour(scene / mesh.name) == list(BLUE)


def test_a_link_leads_nowhere_else(tmp_path):
    for name in ("store", "scene", "other"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "t.png").write_bytes(b"x")
    (tmp_path / "store" / "box.obj").write_text("")
    link = tmp_path / "scene" / "box.obj"
    link.symlink_to(tmp_path / "store" / "box.obj")
    # Each of the two folders is the mesh's own, however it is spelled; all others are not.
    assert beside(link, "t.png") == tmp_path / "scene" / "t.png"
    assert beside(link, "../store/t.png") == tmp_path / "store" / "t.png"
    assert beside(link, "absent.png") == tmp_path / "scene" / "absent.png"
    (tmp_path / "scene" / "out.png").symlink_to(tmp_path / "other" / "t.png")
    (tmp_path / "store" / "out.png").symlink_to(tmp_path / "other" / "t.png")
    for name in ("../other/t.png", "../t.png", "out.png", str(tmp_path / "other" / "t.png")):
        with pytest.raises(InputRefused, match="a file inside the mesh's own folder"):
            beside(link, name)
    loop = tmp_path / "scene" / "loop"
    loop.symlink_to(loop)
    with pytest.raises(InputRefused):
        beside(link, "loop/t.png")
