"""Meshes of every format that name one red texture, through files of their own: libraries, buffers, layers."""

import json
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from mistyle.core.errors import InputRefused
from mistyle.io.read_mesh import read_mesh, read_references, read_usd_files

RED, BLUE = (255, 0, 0), (0, 0, 255)


def picture(path: Path, colour: tuple[int, int, int]) -> None:
    """A plain picture."""
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.full((4, 4, 3), colour, np.uint8)).save(path)


def obj(folder: Path, texture: str = "maps/red.png", library: str = "box.mtl") -> Path:
    """A square with a material library and its texture."""
    corners = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\n"
    (folder / "box.obj").write_text(f"mtllib {library}\n{corners}usemtl m\nf 1/1 2/2 3/3 4/4\n")
    (folder / library).write_text(f"newmtl m\nmap_Kd {texture}\n")
    picture((folder / library).parent / texture, RED)
    return folder / "box.obj"


def gltf(folder: Path, texture: str = "maps/red.png", buffer: str = "box.bin") -> Path:
    """A triangle with a buffer and a texture."""
    numbers = [np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], "f4"), np.array([[0, 0], [1, 0], [0, 1]], "f4")]
    (folder / buffer).write_bytes(b"".join(n.tobytes() for n in numbers))
    views = [{"buffer": 0, "byteOffset": 0, "byteLength": 36}, {"buffer": 0, "byteOffset": 36, "byteLength": 24}]
    accessors = [{"bufferView": k, "componentType": 5126, "count": 3, "type": f"VEC{3 - k}"} for k in (0, 1)]
    accessors[0] |= {"min": [0, 0, 0], "max": [1, 1, 0]}
    look = {"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}
    primitive = {"attributes": {"POSITION": 0, "TEXCOORD_0": 1}, "material": 0}
    tree = {
        "asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": [0]}], "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [primitive]}], "materials": [look], "textures": [{"source": 0}],
        "images": [{"uri": texture}], "buffers": [{"uri": buffer, "byteLength": 60}], "bufferViews": views,
        "accessors": accessors,
    }  # fmt: skip
    (folder / "box.gltf").write_text(json.dumps(tree))
    picture(folder / texture, RED)
    return folder / "box.gltf"


def ply(folder: Path, texture: str = "maps/red.png") -> Path:
    """A square with a texture."""
    head = f"ply\nformat ascii 1.0\ncomment TextureFile {texture}\nelement vertex 4\n"
    head += "".join(f"property float {n}\n" for n in "xyzst")
    head += "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
    (folder / "box.ply").write_text(head + "0 0 0 0 0\n1 0 0 1 0\n1 1 0 1 1\n0 1 0 0 1\n4 0 1 2 3\n")
    picture(folder / texture, RED)
    return folder / "box.ply"


def usda(folder: Path, texture: str = "maps/red.png") -> Path:
    """A square with a preview surface and its texture."""
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
        }""".replace("maps/red.png", texture)
    )
    picture(folder / texture, RED)
    return folder / "box.usda"


def colour(mesh: Path) -> list[int]:
    """The first texel of a mesh's texture."""
    albedo = read_mesh(mesh).materials[0].albedo
    assert albedo is not None, "the texture was not found"
    return np.rint(255 * albedo[0, 0]).astype(int).tolist()


def usd_layer(folder: Path, layer: str) -> Path:
    """A stage that references a square in another layer."""
    usda((folder / layer).parent, "red.png").rename(folder / layer)
    (folder / "top.usda").write_text(
        f'#usda 1.0\n(\n    defaultPrim = "top"\n    upAxis = "Y"\n)\ndef "top" ( references = @{layer}@ ) {{}}\n'
    )
    return folder / "top.usda"


def usd_materialx(folder: Path, document: str, texture: str = "red.png") -> Path:
    """A square with a material of a MaterialX document, which names a texture."""
    pytest.importorskip("MaterialX")
    text = usda(folder).read_text().replace("</box/m>", "</box/looks/m>")
    start = text.index('def Material "m"')
    scope = f'def Scope "looks" ( prepend references = @{document}@</MaterialX/Materials> ) {{}}'
    (folder / "box.usda").write_text(text[:start] + scope + "\n}")
    (folder / document).write_text(
        f"""<?xml version="1.0"?>
        <materialx version="1.38" colorspace="lin_rec709">
          <image name="i" type="color3">
            <input name="file" type="filename" value="{texture}" colorspace="srgb_texture"/>
          </image>
          <standard_surface name="s" type="surfaceshader">
            <input name="base_color" type="color3" nodename="i"/>
          </standard_surface>
          <surfacematerial name="m" type="material">
            <input name="surfaceshader" type="surfaceshader" nodename="s"/>
          </surfacematerial>
        </materialx>"""
    )
    picture((folder / document).parent / texture, RED)
    return folder / "box.usda"


def files(mesh: Path) -> list[Path]:
    """The files that a stage key hashes besides the mesh; none where the mesh is refused."""
    with suppress(InputRefused):
        return read_usd_files(mesh) if mesh.suffix == ".usda" else read_references(mesh)
    return []
