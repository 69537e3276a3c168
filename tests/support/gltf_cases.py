"""Assets made by hand for the tests of what is written."""

import json
from pathlib import Path

import numpy as np

from mistyle.core.asset import Asset, Material, Primitive, Source
from mistyle.core.maps import Maps, Texels
from mistyle.core.mesh import Mesh

RED, GREEN, BLUE, WHITE = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0), (1.0, 1.0, 1.0)


def material(name: str) -> Material:
    return Material(name, None, None, None, None, np.ones(3), 1.0, 0.0)


def asset_of(positions, faces, normals, uvs, *, part=None, parts=("skin",), user=None) -> Asset:
    """An asset whose working space is the user's, unless `user` (4 4) takes working positions to the user's."""
    positions = np.asarray(positions, np.float32)
    part = np.zeros(len(faces), np.int32) if part is None else np.asarray(part, np.int32)
    user = np.eye(4) if user is None else user
    mesh = Mesh(
        positions=positions,
        faces=np.asarray(faces, np.int32),
        corner_normals=np.asarray(normals, np.float32),
        corner_uvs=np.asarray(uvs, np.float32),
        part=part,
        parts=tuple(parts),
    )
    source = Source(
        path=Path("thing.obj"),
        kind="obj",
        primitives=(Primitive(-1, -1, -1, 0, len(faces), -1, -1, 0 if len(parts) == 1 else -1),),
        user_positions=positions.astype(np.float64) @ user[:3, :3].T + user[:3, 3],
        work_from_user=np.linalg.inv(user),
        old_uvs=None,
        uv="kept",
        notes=(),
    )
    return Asset("thing", mesh, tuple(material(p) for p in parts), source)


def quad(**changes) -> Asset:
    """A square in the plane z = 0 seen from +Z, u to the right, v up."""
    corners = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], np.float32)
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    uvs = (corners[faces][..., :2] + 1) / 2
    return asset_of(corners, faces, np.broadcast_to([0.0, 0, 1], (2, 3, 3)), uvs, **changes)


def quarters(size: int = 16) -> Maps:
    """Row 0 is v = 1: red top left, green top right, blue bottom left, white bottom right; ORM tells corners too."""
    half = size // 2
    albedo = np.zeros((size, size, 3), np.float32)
    albedo[:half, :half], albedo[:half, half:], albedo[half:, :half], albedo[half:, half:] = RED, GREEN, BLUE, WHITE
    normal = np.zeros((size, size, 3), np.float32)
    normal[..., 2] = 1
    normal[:half, :, :] = np.array([0, 0.6, 0.8], np.float32)
    rough = np.linspace(0, 1, size, dtype=np.float32)[:, None].repeat(size, 1)
    return Maps(albedo, normal, rough, rough.T.copy(), np.ones((size, size), bool))


def no_texels(size: int = 16) -> Texels:
    """Texels of a texture whose every texel belongs to face 0 (enough where nothing looks at them)."""
    zeros = np.zeros((size, size, 3), np.float32)
    where = np.zeros((size, size), np.int32)
    return Texels(zeros, zeros, np.ones((size, size), bool), where, where)


def bumpy_sphere(rings: int = 12) -> Asset:
    """A closed surface with a UV seam, poles, two parts and normals of its own."""
    u, v = np.meshgrid(np.linspace(0, 1, 2 * rings + 1), np.linspace(0, 1, rings + 1))
    longitude, latitude = u * 2 * np.pi, (v - 0.5) * np.pi
    x, y, z = np.sin(longitude) * np.cos(latitude), np.sin(latitude), np.cos(longitude) * np.cos(latitude)
    points = np.stack([x, y, z], -1).reshape(-1, 3).round(12)
    grid = np.arange(points.shape[0]).reshape(u.shape)
    a, b, c, d = grid[:-1, :-1], grid[:-1, 1:], grid[1:, 1:], grid[1:, :-1]
    faces = np.concatenate([np.stack([a, b, c], -1).reshape(-1, 3), np.stack([a, c, d], -1).reshape(-1, 3)])
    uvs = np.stack([u, v], -1).reshape(-1, 2)[faces]
    normals = points[faces]
    unique, inverse = np.unique(points, axis=0, return_inverse=True)
    faces = inverse.reshape(-1)[faces]
    part = (unique[faces].mean(1)[:, 1] > 0).astype(np.int32)
    bumps = unique * (1 + 0.1 * np.sin(7 * unique[:, :1]))
    return asset_of(bumps, faces, normals, uvs, part=part, parts=("lower half", "upper/half"))


def from_gltf(path: Path, *, new_uvs: bool = False) -> Asset:
    """A glTF file as it is, one part per material; with `new_uvs` every face gets a cell of its own in the square."""
    from mistyle.io.gltf.read import read_gltf

    raw = read_gltf(path, 1_000_000).finished()
    uvs, kind = raw.uvs, "kept"
    if new_uvs:
        side = int(np.ceil(np.sqrt(len(raw.faces))))
        cell = np.stack(np.divmod(np.arange(len(raw.faces)), side), axis=1)[:, None]
        uvs, kind = (cell + np.array([[0.1, 0.1], [0.9, 0.1], [0.1, 0.9]])) / side, "new"
    parts = tuple(m.name for m in raw.materials)
    mesh = Mesh(
        positions=raw.positions.astype(np.float32),
        faces=raw.faces.astype(np.int32),
        corner_normals=raw.normals.astype(np.float32),
        corner_uvs=(uvs % 1 if path.name == "DamagedHelmet.glb" else uvs).astype(np.float32),
        part=raw.material.astype(np.int32),
        parts=parts,
    )
    source = Source(path, raw.kind, raw.primitives, raw.positions, np.eye(4), raw.uvs, kind, raw.notes)
    return Asset(path.stem, mesh, tuple(material(p) for p in parts), source)


def glb_parts(path: Path) -> tuple[dict, bytes]:
    """JSON and binary chunk of a .glb, read by the letter of the specification."""
    data = Path(path).read_bytes()
    magic, version, total, length = np.frombuffer(data[:16], "<u4").tolist()
    assert (magic, version, total) == (0x46546C67, 2, len(data)) and data[16:20] == b"JSON" and length % 4 == 0
    rest = data[20 + length :]
    assert rest[4:8] == b"BIN\0" and int.from_bytes(rest[:4], "little") == len(rest) - 8
    return json.loads(data[20 : 20 + length]), rest[8:]


def accessor(tree: dict, binary: bytes, index: int) -> np.ndarray:
    """An accessor as numbers, by the letter of the specification; normalised integers stay as they are stored."""
    item = tree["accessors"][index]
    view = tree["bufferViews"][item["bufferView"]]
    kind = np.dtype({5121: "u1", 5123: "<u2", 5125: "<u4", 5126: "<f4"}[item["componentType"]])
    width = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}[item["type"]]
    stride = view.get("byteStride", kind.itemsize * width)
    start = view.get("byteOffset", 0) + item.get("byteOffset", 0)
    if stride == kind.itemsize * width:
        return np.frombuffer(binary, kind, item["count"] * width, start).reshape(-1, width)
    rows = [binary[start + k * stride : start + k * stride + kind.itemsize * width] for k in range(item["count"])]
    return np.frombuffer(b"".join(rows), kind).reshape(-1, width)


def strange_gltf(path: Path) -> Path:
    """A glTF with what real files carry and simple tests forget.

    One mesh whose vertices are shared by two triangle primitives of different materials (the mirrored half of the
    first needs tangents of its own) and by lines; skinned, with a morph target, bytes as colours and as a custom
    attribute, a sparse accessor; shown by two nodes, one of which mirrors space. Materials: one cut out by the alpha
    of an external image, with a texture transform on the base colour, an emissive texture and extras; one blended.
    """
    from mistyle.io.images.write import encode_png

    x, y = np.meshgrid(np.linspace(-1, 1, 5), np.linspace(0, 1, 3))
    positions = np.stack([x, y, 0.2 * np.cos(3 * x)], -1).reshape(-1, 3).astype(np.float32)
    count = len(positions)
    a = (np.arange(2)[:, None] * 5 + np.arange(4)).reshape(-1)
    faces = np.stack([a, a + 1, a + 6, a, a + 6, a + 5], 1).reshape(-1, 3)
    uvs = np.stack([np.abs(positions[:, 0]), 1 - positions[:, 1]], 1)
    normals = np.tile([0, 0, 1], (count, 1)).astype(np.float32)
    tree: dict = {
        "asset": {"version": "2.0", "generator": "by hand", "copyright": "nobody", "extras": {"mine": 1}},
        "extensionsUsed": ["KHR_texture_transform"],
        "scene": 0,
        "scenes": [{"nodes": [0, 1, 2, 3], "name": "set"}],
        "nodes": [
            {"mesh": 0, "skin": 0, "name": "left", "extras": {"side": "l"}},
            {"mesh": 0, "name": "right", "scale": [-1, 1, 1], "translation": [5, 0, 0]},
            {"name": "bone", "rotation": [0, 0.6, 0, 0.8]},
            {"name": "eye", "camera": 0, "translation": [0, 0, 9]},
        ],
        "cameras": [{"type": "perspective", "perspective": {"yfov": 1.0, "znear": 0.1}}],
        "skins": [{"joints": [2]}],
        "textures": [{"source": 0}, {"source": 1}],
        "images": [{"uri": "cut%20out.png", "name": "cut"}, {"uri": "glow.png", "name": "glow"}],
        "materials": [
            {
                "name": "leaf",
                "alphaMode": "MASK",
                "alphaCutoff": 0.25,
                "doubleSided": True,
                "pbrMetallicRoughness": {
                    "baseColorFactor": [0.5, 0.5, 0.5, 0.75],
                    "baseColorTexture": {
                        "index": 0,
                        "extensions": {"KHR_texture_transform": {"offset": [0.5, 0], "scale": [1, 2]}},
                    },
                    "metallicFactor": 0.1,
                    "roughnessFactor": 0.2,
                },
                "normalTexture": {"index": 0, "scale": 3},
                "emissiveTexture": {"index": 1},
                "emissiveFactor": [1, 0.5, 0],
                "extras": {"kept": True},
            },
            {"name": "glass", "alphaMode": "BLEND"},
        ],
    }
    builder = _strange_mesh(tree, positions, normals, uvs, faces)
    white = np.ones((4, 4, 3), np.float32)
    alpha = np.linspace(0, 1, 16, dtype=np.float32).reshape(4, 4, 1)
    (path.parent / "cut out.png").write_bytes(encode_png(np.concatenate([white, alpha], -1)))
    (path.parent / "glow.png").write_bytes(encode_png(white))
    path.write_bytes(builder.pack())
    return path


def _strange_mesh(tree: dict, positions, normals, uvs, faces):
    from mistyle.io.gltf.glb import ARRAY_BUFFER, Builder

    builder, count = Builder(tree, []), len(positions)

    def raw(array: np.ndarray, component: int, kind: str, **more) -> int:
        like = {"componentType": component, "type": kind, **more}
        return builder.raw_attribute(array.view(np.uint8).reshape(count, -1), like)

    numbers = np.arange(count, dtype=np.uint8)
    morph = np.zeros_like(positions)
    morph[:, 2] = 1
    normal = builder.attribute(normals)
    attributes = {
        "POSITION": builder.attribute(positions, bounds=True),
        "NORMAL": normal,
        "TEXCOORD_0": builder.attribute(uvs),
        "COLOR_0": raw(np.repeat(numbers, 3) * 10, 5121, "VEC3", normalized=True),
        "JOINTS_0": raw(np.zeros((count, 4), np.uint8), 5121, "VEC4"),
        "WEIGHTS_0": builder.attribute(np.tile([1, 0, 0, 0], (count, 1))),
        "_NUMBER": raw(numbers, 5121, "SCALAR", name="numbers"),
    }
    target = {"POSITION": builder.attribute(morph, bounds=True), "TANGENT": builder.attribute(morph)}
    # Sparse: the normal of vertex 7 is tilted.
    index = builder.view(np.array([7, 0], np.uint16).tobytes())
    tilted = builder.view(np.array([0.6, 0, 0.8], np.float32).tobytes())
    tree["accessors"][normal]["sparse"] = {
        "count": 1,
        "indices": {"bufferView": index, "componentType": 5123},
        "values": {"bufferView": tilted},
    }
    assert tree["bufferViews"][0]["target"] == ARRAY_BUFFER
    lines = builder.indices(np.array([0, 1, 1, 2]))
    shared = {"attributes": attributes, "targets": [target]}
    tree["meshes"] = [
        {
            "name": "sheet",
            "weights": [0.0],
            "primitives": [
                {**shared, "indices": builder.indices(faces[:8]), "material": 0},
                {**shared, "indices": lines, "mode": 1},
                {**shared, "indices": builder.indices(faces[8:]), "material": 1},
            ],
        }
    ]
    return builder
