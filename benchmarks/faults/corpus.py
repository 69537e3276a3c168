"""Small files of every format that mistyle reads, made here. benchmarks/faults/damage.py damages them."""

import json
import struct
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

SQUARE = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0.2\nv 0.5 0.5 1\n"
SQUARE_UV = "vt 0.1 0.1\nvt 0.9 0.1\nvt 0.9 0.9\nvt 0.1 0.9\nvt 0.5 0.5\n"
OBJ = SQUARE + SQUARE_UV + "vn 0 0 1\nmtllib a.mtl\no thing\nusemtl red\nf 1/1/1 2/2/1 5/5/1\nf 2/2/1 3/3/1 5/5/1\n"
OBJ += "g other\nusemtl blue\nf -3/-3/-1 -2/-2/-1 -1/-1/-1\n"
MTL = "newmtl red\nKd 0.8 0.1 0.1\nmap_Kd -s 1 1 1 a.png\nPr 0.4\nnewmtl blue\nKd 0 0 1\nnorm a.png\nmap_Pr a.png\n"
POINTS = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0.2], [0.5, 0.5, 1]], np.float32)
FACES = np.array([[0, 1, 4], [1, 2, 4], [2, 3, 4]], np.int32)
UVS = np.array([[0.1, 0.1], [0.9, 0.1], [0.9, 0.9], [0.1, 0.9], [0.5, 0.5]], np.float32)


@dataclass(frozen=True)
class Seed:
    """The files of one input; `kind` of reader that they are for, `entry`: the one to hand in ("." the folder)."""

    name: str
    kind: str
    files: dict[str, bytes]
    entry: str


def seeds() -> list[Seed]:
    """Every format once or more."""
    return [*_meshes(), *_usd(), *_pictures(), *_cameras(), *_colmap(), *_photogrammetry(), *_settings(), *_arrays()]


# --- the files ---


def png(bits: int = 8, channels: int = 3) -> bytes:
    from mistyle.io.images.write import encode_png

    rng = np.random.default_rng(0)
    return encode_png(rng.random((12, 16, channels) if channels > 1 else (12, 16)).astype(np.float32), bits)


def gltf_parts() -> tuple[dict[str, Any], bytes]:
    """A glTF tree without buffer URIs and its binary: one textured mesh under a node, a child node, a camera-less
    scene."""
    blobs = [
        POINTS.tobytes(),
        np.tile(np.array([[0, 0, 1]], np.float32), (5, 1)).tobytes(),
        UVS.tobytes(),
        FACES.astype("<u2").tobytes() + b"\0\0",
        png(),
    ]
    at, views = 0, []
    for blob in blobs:
        views.append({"buffer": 0, "byteOffset": at, "byteLength": len(blob)})
        at += len(blob) + -len(blob) % 4
    data = b"".join(blob + b"\0" * (-len(blob) % 4) for blob in blobs)
    vectors = {"componentType": 5126, "count": 5}
    tree = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "children": [1], "rotation": [0, 0, 0, 1]}, {"translation": [1, 0, 0], "mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0, "NORMAL": 1, "TEXCOORD_0": 2}, "indices": 3}]}],
        "materials": [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}, "alphaMode": "MASK"}],
        "textures": [{"source": 0}],
        "images": [{"bufferView": 4, "mimeType": "image/png"}],
        "accessors": [
            {"bufferView": 0, "type": "VEC3", "min": [0, 0, 0], "max": [1, 1, 1], **vectors},
            {"bufferView": 1, "type": "VEC3", **vectors},
            {"bufferView": 2, "type": "VEC2", **vectors},
            {"bufferView": 3, "type": "SCALAR", "componentType": 5123, "count": 9},
        ],
        "bufferViews": views,
        "buffers": [{"byteLength": len(data)}],
    }
    tree["meshes"][0]["primitives"][0]["material"] = 0
    return tree, data


def glb(tree: Any, data: bytes) -> bytes:
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    data += b"\0" * (-len(data) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(data), b"BIN\0") + data
    return b"glTF" + struct.pack("<II", 2, 12 + len(chunks)) + chunks


def _meshes() -> list[Seed]:
    head = "ply\nformat {}\nelement vertex 5\nproperty float x\nproperty float y\nproperty float z\nproperty float u\n"
    head += "property float v\nelement face 3\nproperty list uchar int vertex_indices\nend_header\n"
    rows = "".join(f"{x} {y} {z} {u} {v}\n" for (x, y, z), (u, v) in zip(POINTS, UVS, strict=True))
    ascii_ply = head.format("ascii 1.0") + rows + "".join("3 {} {} {}\n".format(*f) for f in FACES)
    little = head.format("binary_little_endian 1.0").encode() + np.hstack([POINTS, UVS]).astype("<f4").tobytes()
    ragged = head.format("binary_big_endian 1.0").encode() + np.hstack([POINTS, UVS]).astype(">f4").tobytes()
    corners = POINTS[FACES]
    facet = np.dtype([("n", "<f4", 3), ("c", "<f4", (3, 3)), ("a", "<u2")])
    table = np.zeros(len(FACES), facet)
    table["c"] = corners
    text = "solid a\n"
    for triangle in corners:
        text += "facet normal 0 0 1\nouter loop\n"
        text += "".join("vertex {} {} {}\n".format(*p) for p in triangle) + "endloop\nendfacet\n"
    off = "OFF\n5 3 0\n" + "".join("{} {} {}\n".format(*p) for p in POINTS)
    off += "".join("3 {} {} {}\n".format(*f) for f in FACES)
    tree, data = gltf_parts()
    apart = json.loads(json.dumps(tree))
    apart["buffers"][0]["uri"] = "a.bin"
    apart["images"][0] = {"uri": "a.png"}
    return [
        Seed("obj", "mesh", {"a.obj": OBJ.encode(), "a.mtl": MTL.encode(), "a.png": png()}, "a.obj"),
        Seed("ply ascii", "mesh", {"a.ply": ascii_ply.encode()}, "a.ply"),
        Seed("ply", "mesh", {"a.ply": little + b"".join(struct.pack("<B3i", 3, *f) for f in FACES)}, "a.ply"),
        Seed(
            "ply ragged",
            "mesh",
            {"a.ply": ragged + struct.pack(">B3iB4iB2i", 3, 0, 1, 4, 4, 0, 1, 2, 3, 2, 0, 1)},
            "a.ply",
        ),
        Seed("stl", "mesh", {"a.stl": b" " * 80 + struct.pack("<I", len(FACES)) + table.tobytes()}, "a.stl"),
        Seed("stl ascii", "mesh", {"a.stl": (text + "endsolid a\n").encode()}, "a.stl"),
        Seed("off", "mesh", {"a.off": off.encode()}, "a.off"),
        Seed("glb", "mesh", {"a.glb": glb(tree, data)}, "a.glb"),
        Seed("gltf", "mesh", {"a.gltf": json.dumps(apart).encode(), "a.bin": data, "a.png": png(channels=4)}, "a.gltf"),
    ]


def _usd() -> list[Seed]:
    """The same mesh as text, as crate and as package; none without usd-core."""
    try:
        from pxr import Sdf, UsdUtils  # pyright: ignore[reportMissingImports]
    except ImportError:
        return []
    import tempfile

    points = ", ".join("({}, {}, {})".format(*p) for p in POINTS)
    uvs = ", ".join("({}, {})".format(*p) for p in UVS[FACES].reshape(-1, 2))
    text = f"""#usda 1.0
(
    defaultPrim = "root"
    upAxis = "Y"
)
def Xform "root" {{
    def Mesh "thing" {{
        int[] faceVertexCounts = [3, 3, 3]
        int[] faceVertexIndices = {FACES.reshape(-1).tolist()}
        point3f[] points = [{points}]
        texCoord2f[] primvars:st = [{uvs}] (interpolation = "faceVarying")
        rel material:binding = </root/red>
    }}
    def Material "red" {{
        token outputs:surface.connect = </root/red/shader.outputs:surface>
        def Shader "shader" {{
            uniform token info:id = "UsdPreviewSurface"
            color3f inputs:diffuseColor.connect = </root/red/picture.outputs:rgb>
            token outputs:surface
        }}
        def Shader "picture" {{
            uniform token info:id = "UsdUVTexture"
            asset inputs:file = @./a.png@
            float3 outputs:rgb
        }}
    }}
}}
"""
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        (place / "a.png").write_bytes(png())
        (place / "a.usda").write_text(text)
        Sdf.Layer.FindOrOpen(str(place / "a.usda")).Export(str(place / "a.usdc"))
        UsdUtils.CreateNewUsdzPackage(str(place / "a.usdc"), str(place / "a.usdz"))
        crate, package = (place / "a.usdc").read_bytes(), (place / "a.usdz").read_bytes()
    return [
        Seed("usda", "mesh", {"a.usda": text.encode(), "a.png": png()}, "a.usda"),
        Seed("usdc", "mesh", {"a.usdc": crate, "a.png": png()}, "a.usdc"),
        Seed("usdz", "mesh", {"a.usdz": package}, "a.usdz"),
    ]


def _pictures() -> list[Seed]:
    from PIL import Image

    rng = np.random.default_rng(1)
    pixels = Image.fromarray(rng.integers(0, 255, (24, 32, 3), np.uint8))
    found = {"png": png(), "png grey": png(channels=1), "png alpha": png(channels=4), "png 16": png(16)}
    exif = Image.Exif()
    exif[0x0112] = 6
    for name, kind, options in (
        ("jpg", "JPEG", {"exif": exif}),
        ("webp", "WEBP", {}),
        ("tif", "TIFF", {"compression": "tiff_deflate"}),
        ("tif packbits", "TIFF", {"compression": "packbits"}),
        ("bmp", "BMP", {}),
        ("gif", "GIF", {}),
        ("tga", "TGA", {}),
    ):
        file = BytesIO()
        (pixels.convert("P") if kind == "GIF" else pixels).save(file, kind, **options)
        found[name] = file.getvalue()
    result = [
        Seed(name, "picture", {f"a.{name[:4].strip()}": data}, f"a.{name[:4].strip()}") for name, data in found.items()
    ]
    result += [Seed(f"exr {name}", "exr", {"a.exr": data}, "a.exr") for name, data in _exrs().items()]
    import cv2

    done, hdr = cv2.imencode(".hdr", rng.random((16, 32, 3)).astype(np.float32) * 9)
    assert done
    return [*result, Seed("hdr", "hdr", {"a.hdr": hdr.tobytes()}, "a.hdr")]


def _exrs() -> dict[str, bytes]:
    import OpenEXR

    rng = np.random.default_rng(2)
    planes = {c: rng.random((20, 40)).astype(np.float32) for c in ("R", "G", "B", "A", "depth.Z")}
    halves = {c: p.astype(np.float16) for c, p in planes.items()}
    found = {}
    for name, compression, channels in (
        ("zip", OpenEXR.ZIP_COMPRESSION, planes),
        ("piz half", OpenEXR.PIZ_COMPRESSION, halves),
        ("dwaa", OpenEXR.DWAA_COMPRESSION, halves),
        ("b44", OpenEXR.B44_COMPRESSION, halves),
        ("rle", OpenEXR.RLE_COMPRESSION, halves),
        ("pxr24", OpenEXR.PXR24_COMPRESSION, planes),
        ("none", OpenEXR.NO_COMPRESSION, planes),
    ):
        file = BytesIO()
        OpenEXR.File({"compression": compression, "type": OpenEXR.scanlineimage}, channels).write(file)
        found[name] = file.getvalue()
    file = BytesIO()
    tiles = OpenEXR.TileDescription()
    tiles.xSize = tiles.ySize = 16
    OpenEXR.File(
        {"compression": OpenEXR.ZIPS_COMPRESSION, "type": OpenEXR.tiledimage, "tiles": tiles}, {"Y": planes["R"]}
    ).write(file)
    found["tiles"] = file.getvalue()
    parts = [
        OpenEXR.Part({"type": OpenEXR.scanlineimage, "name": n}, {c: planes[c] for c in "RGB"}, n) for n in ("a", "b")
    ]
    file = BytesIO()
    OpenEXR.File(parts).write(file)
    return found | {"parts": file.getvalue()}


def _cameras() -> list[Seed]:
    from mistyle.core.camera import orbit
    from mistyle.core.light import lights, to_json
    from mistyle.io.cameras.camera_files import SPACE, camera_entry, transforms

    cameras = [orbit(a, 10, distance=4, fov=30, size=(12, 16)) for a in (0, 90)]
    own = {"version": 1, "space": SPACE, "views": [camera_entry(c) for c in cameras]}
    nerf = transforms(cameras, [f"{c.name}.png" for c in cameras])
    shown = {f"{c.name}.png": png() for c in cameras}
    listed = to_json(lights("paper"))
    lit = [
        *({"type": "directional", "direction": [0, 1, 0], "irradiance": [3, 3, 3]},),
        *({"type": "ambient", "radiance": [0.1, 0.2, 0.3]}, {"type": "environment", "file": "a.hdr"}),
        {"type": "point", "position": [0, 2, 0], "intensity": [1, 1, 1]},
    ]
    hdr = next(seed.files["a.hdr"] for seed in _pictures() if seed.name == "hdr")
    return [
        Seed("camera.json", "cameras", {"camera.json": json.dumps(own).encode()}, "camera.json"),
        Seed("transforms.json", "cameras", {"transforms.json": json.dumps(nerf).encode()}, "transforms.json"),
        Seed("captures", "captures", {"transforms.json": json.dumps(nerf).encode(), **shown}, "."),
        Seed("lights.json", "lights", {"lights.json": json.dumps(listed).encode()}, "lights.json"),
        Seed("lights", "lights", {"lights.json": json.dumps({"lights": lit}).encode(), "a.hdr": hdr}, "lights.json"),
    ]


def _colmap() -> list[Seed]:
    camera = struct.pack("<QIiQQ4d", 1, 1, 1, 16, 12, 20.0, 20.0, 8.0, 6.0)
    image = struct.pack("<QI7dI", 1, 1, 1, 0, 0, 0, 0, 0, 4, 1) + b"a.png\0" + struct.pack("<Q2dq", 1, 3, 4, 1)
    point = struct.pack("<QQ3d3BdQ2i", 1, 1, 0.1, 0.2, 0.3, 9, 9, 9, 0.5, 1, 1, 0)
    text = {
        "cameras.txt": b"# cameras\n1 OPENCV 16 12 20 20 8 6 0.1 0.01 0 0\n",
        "images.txt": b"# images\n1 1 0 0 0 0 0 4 1 a.png\n3 4 1\n",
        "points3D.txt": b"# points\n1 0.1 0.2 0.3 9 9 9 0.5 1 0\n",
    }
    return [
        Seed("colmap", "colmap", {"cameras.bin": camera, "images.bin": image, "points3D.bin": point}, "."),
        Seed("colmap text", "colmap", text, "."),
    ]


def _photogrammetry() -> list[Seed]:
    """Cameras of Meshroom, Metashape and RealityScan, with their picture."""
    pose = "1 0 0 0 0 1 0 0 0 0 1 -4 0 0 0 1"
    size, lens = '<resolution width="16" height="12"/>', "<f>20</f><cx>0.5</cx><cy>0</cy><k1>0.1</k1><p1>0.01</p1>"
    agisoft = (
        f'<document version="2.0.0"><chunk><sensors><sensor id="0" type="frame">{size}<calibration type="frame" '
        f'class="adjusted">{size}{lens}</calibration></sensor></sensors><components><component id="0"><transform>'
        "<rotation>1 0 0 0 1 0 0 0 1</rotation><translation>0 0 0</translation><scale>2</scale></transform></component>"
        '</components><cameras><camera id="0" sensor_id="0" component_id="0" label="a"><transform>'
        f"{pose}</transform></camera></cameras></chunk></document>"
    )
    transform = {"rotation": ["1", "0", "0", "0", "1", "0", "0", "0", "1"], "center": ["0", "0", "-4"]}
    sfm = {
        "version": ["1", "2", "6"],
        "views": [{"viewId": "1", "poseId": "1", "intrinsicId": "1", "path": "a.png"}],
        "intrinsics": [{"intrinsicId": "1", "width": "16", "height": "12", "type": "pinhole", "sensorWidth": "36",
                        "focalLength": "45", "principalPoint": ["0", "0"]}],
        "poses": [{"poseId": "1", "pose": {"transform": transform}}],
    }  # fmt: skip
    table = (
        "#cameras 1\n#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2\n"
        "a.png,1.5,2,-3,163.5,83.25,-20.5,45,0.02,-0.03,0.1,-0.05,0.02,0,0.004,-0.007\n"
    )
    xmp = (
        '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
        '<rdf:Description xmlns:xcr="http://www.capturingreality.com/ns/xcr/1.1#" xcr:DistortionModel="brown3t2" '
        'xcr:FocalLength35mm="45" xcr:PrincipalPointU="0.02"><xcr:Rotation>1 0 0 0 0 -1 0 1 0</xcr:Rotation>'
        "<xcr:Position>0 -4 0.5</xcr:Position><xcr:DistortionCoeficients>0.1 -0.05 0.02 0 0.004 -0.007"
        "</xcr:DistortionCoeficients></rdf:Description></rdf:RDF></x:xmpmeta>"
    )
    # LibRaw refuses files of a few pixels.
    larger = agisoft.replace(size, '<resolution width="32" height="24"/>')
    return [
        Seed("metashape", "captures", {"cameras.xml": agisoft.encode(), "a.png": png()}, "."),
        Seed("raw", "captures", {"cameras.xml": larger.encode(), "a.dng": dng(np.full((24, 32, 3), 30000))}, "."),
        Seed("meshroom", "captures", {"cameras.sfm": json.dumps(sfm).encode(), "a.png": png()}, "."),
        Seed("realityscan", "captures", {"cameras.csv": table.encode(), "a.png": png()}, "."),
        Seed("realityscan xmp", "captures", {"a.xmp": xmp.encode(), "a.png": png()}, "."),
    ]


def dng(values: np.ndarray, orientation: int = 1) -> bytes:
    """A DNG of linear Rec.709 values (h w 3, uint16) behind a Bayer filter RGGB, as a sensor of sRGB's primaries.

    Tags are those of TIFF 6.0, TIFF/EP and DNG 1.4, little-endian.
    """
    height, width, _ = values.shape
    mosaic = np.empty((height, width), "<u2")
    for k, (row, column) in enumerate(((0, 0), (0, 1), (1, 0), (1, 1))):
        mosaic[row::2, column::2] = values[row::2, column::2, (0, 1, 1, 2)[k]]
    rgb_from_xyz = (3.2405, -1.5371, -0.4985, -0.9693, 1.8760, 0.0416, 0.0556, -0.2040, 1.0572)
    short, long, byte, text = "H", "I", "B", "s"  # struct's letters of TIFF types
    tags: dict[int, tuple[int, str, list]] = {
        254: (4, long, [0]), 256: (4, long, [width]), 257: (4, long, [height]), 258: (3, short, [16]),
        259: (3, short, [1]), 262: (3, short, [32803]), 271: (2, text, [b"mistyle\0"]), 272: (2, text, [b"test\0"]),
        273: (4, long, [0]), 274: (3, short, [orientation]), 277: (3, short, [1]), 278: (4, long, [height]),
        279: (4, long, [mosaic.nbytes]), 33421: (3, short, [2, 2]), 33422: (1, byte, [0, 1, 1, 2]),
        50706: (1, byte, [1, 4, 0, 0]), 50708: (2, text, [b"mistyle test\0"]), 50714: (3, short, [0]),
        50717: (3, short, [65535]), 50721: (10, "i", [n for v in rgb_from_xyz for n in (round(v * 10000), 10000)]),
        50728: (5, long, [1, 1, 1, 1, 1, 1]), 50778: (3, short, [21]),
    }  # fmt: skip
    start = 8 + 2 + 12 * len(tags) + 4
    directory, beyond = struct.pack("<H", len(tags)), b""
    sizes = {1: 1, 2: 1, 3: 2, 4: 4, 5: 8, 10: 8}
    raw = {tag: items[0] if kind == text else struct.pack(f"<{len(items)}{kind}", *items)
           for tag, (_, kind, items) in tags.items()}  # fmt: skip
    longer = sum(len(data) + len(data) % 2 for data in raw.values() if len(data) > 4)
    raw[273] = struct.pack("<I", start + longer)
    for tag, (number, _, _) in tags.items():
        data = raw[tag]
        held = data.ljust(4, b"\0") if len(data) <= 4 else struct.pack("<I", start + len(beyond))
        beyond += data.ljust(len(data) + len(data) % 2, b"\0") if len(data) > 4 else b""
        directory += struct.pack("<HHI", tag, number, len(data) // sizes[number]) + held
    return b"II*\0" + struct.pack("<I", 8) + directory + struct.pack("<I", 0) + beyond + mosaic.tobytes()


def _settings() -> list[Seed]:
    toml = b'preset = "draft"\nseed = 3\n[rig]\nkind = "turntable"\nviews = 4\nfov = 30.0\n[fit]\nrefine = "off"\n'
    jobs = b'preset = "draft"\n[[job]]\nmesh = "a.obj"\nstyle = "a.png"\n'
    jobs += b'[[grid]]\nmeshes = ["*.obj"]\nstyles = ["a.png"]\n'
    yaml = b"preset: draft\njob:\n- &one {mesh: a.obj, style: a.png}\n- *one\n"
    yaml += b"grid:\n- meshes: ['*.obj']\n  styles: [a.png]\n"
    beside = {"a.obj": OBJ.encode(), "a.png": png()}
    limits = b'[limits.max]\nflip = 0.05\n[images."shot_*".min]\npsnr = 38\n[layers.normal.max]\nangle = 0.5\n'
    return [
        Seed("toml settings", "settings", {"job.toml": toml}, "job.toml"),
        Seed("toml jobs", "jobs", {"jobs.toml": jobs, **beside}, "jobs.toml"),
        Seed("yaml jobs", "jobs", {"jobs.yaml": yaml, **beside}, "jobs.yaml"),
        Seed("toml limits", "limits", {"compare.toml": limits}, "compare.toml"),
    ]


def _arrays() -> list[Seed]:
    rng = np.random.default_rng(3)
    file = BytesIO()
    np.save(file, rng.random((5, 6)).astype(np.float32))
    one, two = rng.random((3, 4)).astype(np.float32), np.arange(6, dtype=np.int64)
    table = {
        "__metadata__": {"format": "pt"},
        "a.weight": {"dtype": "F32", "shape": [3, 4], "data_offsets": [0, 48]},
        "b": {"dtype": "I64", "shape": [6], "data_offsets": [48, 96]},
    }
    head = json.dumps(table).encode()
    tensors = len(head).to_bytes(8, "little") + head + one.tobytes() + two.tobytes()
    return [
        Seed("npy", "npy", {"a.npy": file.getvalue()}, "a.npy"),
        Seed("safetensors", "weights", {"a.safetensors": tensors}, "a.safetensors"),
    ]


def write(files: dict[str, bytes], folder: Path) -> None:
    """Put the files into a folder, in the place of what was there."""
    folder.mkdir(parents=True, exist_ok=True)
    for old in folder.iterdir():
        old.unlink()
    for name, data in files.items():
        (folder / name).write_bytes(data)
