"""OBJ, PLY, STL and OFF: order kept, bounds kept, and every broken file either opens with a note or is refused."""

import struct
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from mistyle.core.asset import Asset, UpAxis
from mistyle.core.errors import InputRefused
from mistyle.io.meshes.obj_read import read_obj
from mistyle.io.meshes.ply_read import read_ply
from mistyle.io.meshes.polygons import fan, triangulate
from mistyle.io.meshes.stl_off_read import read_off, read_stl
from mistyle.io.read import read_json
from mistyle.io.read_mesh import read_mesh
from mistyle.io.sandbox import bounds
from tests.support.helpers import data

# float32 positions in the unit sphere
FLOAT32 = 1e-6
FOUR = "v 0 0 0\nv 2 0 0\nv 2 2 0\nv 0 2 0\n"
SQUARE = FOUR + "vt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\n"

# What every mesh of the collection of nasty ones does: faces (and a word from the notes), or a word of the refusal.
NASTY = {
    "Fox.glb": (576, "pose of its joints"),
    "capsule.obj": (10200, "capsule.mtl is not there"),
    "chair_model.obj": (12756, "repeats many times"),
    "empty.obj": "no faces",
    "nancolor.obj": (12, "were taken into its albedo"),
    "no_indices_3storybuilding.glb": (72, "has no UVs"),
    "notenoughindices.obj": (1, "fewer than three corners"),
    "obj_points.obj": "8 vertices and no faces",
    "polygonfaces.obj": (3, "no normals"),
    "quadknot.obj": (2880, "no area in UV space"),
    "singlevn.obj": (2, "surface.mtl is not there"),
    "soup.stl": (100, "300 corners at equal positions were joined to 300"),
    "suzanne_open.obj": (968, "has no UVs"),
    "two_objects.obj": (16, "has no UVs"),
    "wallhole.obj": (66, "mirrored"),
}


def check_asset(asset: Asset) -> None:
    """What holds of everything that was read."""
    mesh, source = asset.mesh, asset.source
    count = len(mesh.faces)
    assert np.isfinite(mesh.positions).all() and np.isfinite(mesh.corner_uvs).all()
    used = mesh.positions[np.unique(mesh.faces)].astype(np.float64)
    assert np.linalg.norm(used, axis=1).max() == pytest.approx(1, abs=FLOAT32)
    assert (used.min(axis=0) + used.max(axis=0)) / 2 == pytest.approx(np.zeros(3), abs=FLOAT32)
    work = source.user_positions @ source.work_from_user[:3, :3].T + source.work_from_user[:3, 3]
    assert work == pytest.approx(mesh.positions, abs=FLOAT32)
    assert np.linalg.norm(mesh.corner_normals, axis=2) == pytest.approx(1, abs=1e-4)
    assert mesh.corner_uvs.min() >= -1 and mesh.corner_uvs.max() <= 2
    assert np.array_equal(np.unique(mesh.part), np.arange(len(mesh.parts))) and len(set(mesh.parts)) == len(mesh.parts)
    assert len(asset.materials) == len(mesh.parts)
    assert [p.start for p in source.primitives] == [0, *(p.stop for p in source.primitives[:-1])]
    assert source.primitives[-1].stop == count
    for p in source.primitives:
        assert p.part < 0 or (mesh.part[p.start : p.stop] == p.part).all()


@pytest.mark.parametrize("name", NASTY)
def test_nasty_meshes(name: str) -> None:
    path, expected = data(f"meshes/nasty/{name}"), NASTY[name]
    if isinstance(expected, str):
        with pytest.raises(InputRefused, match=expected) as refusal:
            read_mesh(path)
        assert str(path) in str(refusal.value) and "expected" in str(refusal.value)
        assert refusal.value.exit_code == 3
    else:
        asset = read_mesh(path)
        check_asset(asset)
        assert len(asset.mesh.faces) == expected[0]
        assert expected[1] in " ".join(asset.source.notes)


@pytest.mark.parametrize("name", ["plain/spot.obj", "plain/teapot.obj", "nasty/wallhole.obj", "nasty/quadknot.obj"])
def test_real_meshes_against_an_independent_reader(name: str) -> None:
    path = data(f"meshes/{name}")
    raw = read_obj(path, 10**6)
    other = trimesh.load(path, process=False, force="mesh")
    sides = raw.positions[raw.faces]
    area = np.linalg.norm(np.cross(sides[:, 1] - sides[:, 0], sides[:, 2] - sides[:, 0]), axis=1).sum() / 2
    assert len(raw.faces) == len(other.faces)
    if name != "nasty/wallhole.obj":  # trimesh cuts its concave polygons into fans that leave them
        assert area == pytest.approx(other.area, rel=1e-9)
    lines = [line.split()[1:4] for line in path.read_text().splitlines() if line.startswith("v ")]
    assert np.array_equal(raw.positions, np.array(lines, float))  # the file's vertices in the file's order


@pytest.mark.parametrize("ending", ["ply", "stl", "off", "obj", "glb"])
def test_formats_agree(ending: str, tmp_path: Path) -> None:
    """Other people's writer, our reader: the same triangles in the same order, whatever the format."""
    shape = trimesh.creation.annulus(0.4, 1.0, 0.5, sections=16)
    path = tmp_path / f"ring.{ending}"
    shape.export(path)
    asset = read_mesh(path, uv="auto")
    check_asset(asset)
    assert asset.name == "ring" and asset.source.kind == ending
    corners = asset.source.user_positions[asset.mesh.faces]
    assert corners == pytest.approx(shape.vertices[shape.faces], abs=1e-6)  # STL and GLB store float32
    if ending != "stl":
        assert asset.source.user_positions == pytest.approx(shape.vertices, abs=1e-6)


@pytest.mark.parametrize(("up", "tip"), [("z", (0, 0, 8)), ("-z", (0, 0, -8)), ("-y", (0, -8, 0))])
def test_another_axis_up_is_turned(tmp_path: Path, up: UpAxis, tip: tuple) -> None:
    path = tmp_path / "tower.obj"
    corners = np.roll(np.eye(3), np.flatnonzero(tip)[0] + 1, axis=1)[:2]
    faces = "f 1 3 2\nf 1 2 4\nf 2 3 4\nf 3 1 4\n" if sum(tip) > 0 else "f 1 2 3\nf 1 4 2\nf 2 4 3\nf 3 4 1\n"
    rows = [(0, 0, 0), *corners, tip]
    path.write_text("".join(f"v {x:g} {y:g} {z:g}\n" for x, y, z in rows) + faces)
    asset = read_mesh(path, up=up)
    check_asset(asset)
    assert asset.mesh.positions[3, 1] == asset.mesh.positions[:, 1].max()  # the tip is up now
    corners = asset.mesh.positions[asset.mesh.faces].astype(float)
    assert np.einsum("ij,ij->i", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])).sum() > 0  # not mirrored
    assert np.linalg.det(asset.source.work_from_user[:3, :3]) > 0
    assert f"The mesh was turned from {up.upper()} up to Y up, as requested." in asset.source.notes


def test_obj_corners_keep_their_own_uvs_and_normals(tmp_path: Path) -> None:
    path = tmp_path / "a.obj"
    path.write_text(SQUARE + "vn 0 0 1\nvn 0 0 2\nf 1/1/1 2/2/1 3/3/2 4/4\n")
    raw = read_obj(path, 100)
    assert raw.uvs is not None and raw.normals is not None
    assert raw.faces.tolist() == [[0, 1, 2], [0, 2, 3]]
    assert raw.uvs.tolist() == [[[0, 0], [1, 0], [1, 1]], [[0, 0], [1, 1], [0, 1]]]
    assert raw.normals[0].tolist() == [[0, 0, 1], [0, 0, 1], [0, 0, 2]] and np.isnan(raw.normals[1, 2]).all()
    asset = read_mesh(path)
    assert asset.source.uv == "kept" and np.array_equal(asset.mesh.corner_uvs, raw.uvs)
    assert any("1 of 6 corner normals" in note for note in asset.source.notes)


@pytest.mark.parametrize(
    "faces",
    ["f 1 2 3 4", "f -4 -3 -2 -1", "f 1/1 2/2 3/3 4/4", "f -4/-4 -3/-3 -2/-2 -1/-1", "f 1// 2// 3// 4//",
     "f 1 2/2 3 4/", "f 1 2 \\\n 3 4", "f 1 2 3 4 # a comment", "  f\t1 2  3 4  \r"],
)  # fmt: skip
def test_obj_spellings_of_one_square(faces: str, tmp_path: Path) -> None:
    path = tmp_path / "a.obj"
    path.write_text(SQUARE + faces + "\nl 1 2\np 1\ncurv 0 1 1 2\n")
    assert read_obj(path, 100).faces.tolist() == [[0, 1, 2], [0, 2, 3]]


def test_obj_materials_become_parts(tmp_path: Path) -> None:
    (tmp_path / "sub dir").mkdir()
    picture = np.zeros((4, 4, 3), np.uint8)
    picture[0, 0] = [255, 0, 0]  # top left: u = 0, v = 1
    Image.fromarray(picture).save(tmp_path / "sub dir" / "a b.png")
    (tmp_path / "m.mtl").write_text(
        "newmtl red\nKd 0 0 0\nmap_Kd -s 1 1 1 -clamp on sub dir/a b.png\nPr 0.25\nPm 1\n"
        "newmtl grey one\nKd .5 .25 .125\n"
    )
    path = tmp_path / "a.obj"
    path.write_text(
        SQUARE
        + "mtllib m.mtl\nusemtl grey one\nf 1/1 2/2 3/3\nusemtl red\nf 1/1 3/3 4/4\nusemtl grey one\nf 1/1 2/2 4/4\n"
    )
    asset = read_mesh(path, uv="keep")
    check_asset(asset)
    assert asset.mesh.parts == ("grey one", "red") and asset.mesh.part.tolist() == [0, 1, 0]
    assert [(p.start, p.stop, p.part) for p in asset.source.primitives] == [(0, 1, 0), (1, 2, 1), (2, 3, 0)]
    grey, red = asset.materials
    assert grey.albedo is None and grey.albedo_factor == pytest.approx([0.5, 0.25, 0.125])
    assert red.albedo is not None and red.albedo[0, 0] == pytest.approx([1, 0, 0]) and red.albedo[3, 3].max() == 0
    assert red.albedo_factor == pytest.approx([1, 1, 1])  # Kd 0 beside a texture means nothing
    assert (red.roughness_factor, red.metallic_factor) == (0.25, 1)


def test_several_libraries_and_a_material_without_area(tmp_path: Path) -> None:
    (tmp_path / "a b.mtl").write_text("newmtl a\nKd 1 0 0\n")
    (tmp_path / "c.mtl").write_text("newmtl c\nKd 0 1 0\n")
    (tmp_path / "d.mtl").write_text("newmtl d\nKd 0 0 1\n")
    path = tmp_path / "a.obj"
    statements = "mtllib a b.mtl\nmtllib c.mtl d.mtl\nusemtl a\nf 1 2 3\nusemtl c\nf 1 1 2\nusemtl d\nf 1 3 4\n"
    path.write_text(FOUR + statements)
    asset = read_mesh(path)
    check_asset(asset)
    assert [m.albedo_factor.tolist() for m in asset.materials] == [[1, 0, 0], [0, 1, 0], [0, 0, 1]]


def test_udim_textures(tmp_path: Path) -> None:
    for tile, colour in ((1001, (255, 0, 0)), (1002, (0, 255, 0))):
        Image.new("RGB", (2, 2), colour).save(tmp_path / f"skin.{tile}.png")
    (tmp_path / "m.mtl").write_text("newmtl skin\nmap_Kd skin.<UDIM>.png\n")
    more = "v 4 0 0\nv 4 2 0\nvt 1.1 0.1\nvt 1.9 0.1\nvt 1.9 0.9\nvt 1.1 0.9\n"
    path = tmp_path / "a.obj"
    path.write_text(SQUARE + more + "mtllib m.mtl\nusemtl skin\nf 1/1 2/2 3/3 4/4\nf 2/5 5/6 6/7 3/8\n")
    asset = read_mesh(path, uv="keep")
    check_asset(asset)
    assert asset.mesh.parts == ("skin.1001", "skin.1002") and asset.mesh.part.tolist() == [0, 0, 1, 1]
    assert asset.source.uv == "shifted" and asset.source.primitives[0].part == -1
    first, second = (m.albedo for m in asset.materials)
    assert first is not None and first[0, 0].tolist() == [1, 0, 0]
    assert second is not None and second[0, 0].tolist() == [0, 1, 0]
    assert asset.mesh.corner_uvs[2:].min() == pytest.approx(0.1, abs=1e-6)


def test_each_material_moves_the_progress(tmp_path: Path) -> None:
    path = tmp_path / "a.obj"
    path.write_text(SQUARE + "".join(f"usemtl m{k}\nf 1/1 2/2 3/3\n" for k in range(8)))
    done: list[float] = []
    read_mesh(path, progress=done.append)
    assert done == sorted(done) and done[-1] == pytest.approx(1) and len(done) >= 16
    assert max(np.diff([0, *done])) < 0.16
    done.clear()
    read_mesh(path, uv="new", progress=done.append)
    assert done == sorted(done) and done[-1] == pytest.approx(1)


@pytest.mark.parametrize(
    ("left", "parts", "note"),
    [
        (1.0, [0, 0, 1, 1], ""),
        (0.95, [0, 0, 1, 1], "2 of 4 faces of material 'skin' reach beyond their UDIM tile"),
        (-9.0, [0, 0, 0, 0], "2 of 4 faces of material 'skin' lie in no UDIM tile"),
    ],
)
def test_udim_islands_over_a_border(left: float, parts: list[int], note: str, tmp_path: Path) -> None:
    for tile, colour in ((1001, (255, 0, 0)), (1002, (0, 255, 0))):
        Image.new("RGB", (2, 2), colour).save(tmp_path / f"skin.{tile}.png")
    (tmp_path / "m.mtl").write_text("newmtl skin\nmap_Kd skin.<UDIM>.png\n")
    more = f"v 4 0 0\nv 4 2 0\nvt {left} 0.1\nvt 1.9 0.1\nvt 1.9 0.9\nvt {left} 0.9\n"
    path = tmp_path / "a.obj"
    path.write_text(SQUARE + more + "mtllib m.mtl\nusemtl skin\nf 1/1 2/2 3/3 4/4\nf 2/5 5/6 6/7 3/8\n")
    asset = read_mesh(path)
    notes = " ".join(asset.source.notes)
    assert asset.mesh.part.tolist() == parts
    assert (note in notes) and ("UDIM" in notes) == bool(note)
    last = asset.materials[-1].albedo
    assert last is not None and last[0, 0].tolist() == ([0, 1, 0] if parts[-1] else [1, 0, 0])


@pytest.mark.parametrize("name", ["../secret.png", "/etc/passwd", "http://example.org/a.png", "link.png", "C:\\a.png"])
def test_textures_outside_the_folder_are_not_read(name: str, tmp_path: Path) -> None:
    Image.new("RGB", (2, 2), (255, 0, 0)).save(tmp_path / "secret.png")
    folder = tmp_path / "mesh"
    folder.mkdir()
    (folder / "link.png").symlink_to(tmp_path / "secret.png")
    (folder / "m.mtl").write_text(f"newmtl a\nmap_Kd {name}\n")
    (folder / "a.obj").write_text(SQUARE + "mtllib m.mtl\nusemtl a\nf 1/1 2/2 3/3 4/4\n")
    asset = read_mesh(folder / "a.obj")
    assert asset.materials[0].albedo is None
    assert any("left out" in note for note in asset.source.notes)


BROKEN_OBJ = {
    "f 1 2 9": "vertex 9",
    "f 0 1 2": "vertex 0",
    "f -9 1 2": "before the first",
    "f 1/7 2/2 3/3": "texture coordinate 7",
    "vn 0 0 1\nf 1//2 2//1 3//1": "normal 2",
    "f a b c": "a face that is not indices",
    "v 1 2\nf 1 2 3": "2 numbers",
    "v 1 x 2\nf 1 2 3": "'x'",
    "v nan 0 0\nf 1 2 5": "not finite",
    "v 1e300 0 0\nf 1 2 5": "coordinates up to",
    "f 1 1 1": "all at one point",
    "f 1 1 2": "without area",
    "f 1 2": "no triangles",
}


@pytest.mark.parametrize("lines", BROKEN_OBJ)
def test_broken_obj_is_refused(lines: str, tmp_path: Path) -> None:
    path = tmp_path / "a.obj"
    path.write_text(SQUARE + lines + "\n")
    with pytest.raises(InputRefused, match=BROKEN_OBJ[lines]):
        read_mesh(path)


def test_uv_modes(tmp_path: Path) -> None:
    good, bad, none = tmp_path / "good.obj", tmp_path / "bad.obj", tmp_path / "none.obj"
    good.write_text(SQUARE + "f 1/1 2/2 3/3 4/4\n")
    bad.write_text(SQUARE + "v 0 0 2\nv 2 0 2\nv 2 2 2\nvt 1 .5\nf 1/1 2/2 3/3 4/4\nf 5/1 6/2 7/5\n")
    none.write_text(FOUR + "f 1 2 3 4\n")
    assert read_mesh(good).source.uv == read_mesh(good, uv="keep").source.uv == "kept"
    new = read_mesh(good, uv="new")
    assert new.source.uv == "new" and new.source.old_uvs is not None and new.source.old_uvs[0, 2].tolist() == [1, 1]
    for path, authored in ((bad, True), (none, False)):
        source = read_mesh(path).source
        assert source.uv == "new" and (source.old_uvs is not None) == authored
    for path in (bad, none):
        with pytest.raises(InputRefused, match="--uv auto"):
            read_mesh(path, uv="keep")


def test_a_material_is_carried_to_new_uvs(tmp_path: Path) -> None:
    """The left half of the square is red whatever its UVs are."""
    picture = np.zeros((64, 64, 3), np.uint8)
    picture[:, :32, 0] = 255
    Image.fromarray(picture).save(tmp_path / "a.png")
    (tmp_path / "m.mtl").write_text("newmtl a\nmap_Kd a.png\n")
    path = tmp_path / "a.obj"
    path.write_text(SQUARE + "mtllib m.mtl\nusemtl a\nf 1/1 2/2 3/3\nf 1/1 3/3 4/4\n")
    asset = read_mesh(path, uv="new", size=256)
    albedo = asset.materials[0].albedo
    assert albedo is not None
    for weights in ([0.8, 0.1, 0.1], [0.1, 0.1, 0.8], [0.1, 0.8, 0.1]):
        for face in (0, 1):
            x = weights @ asset.source.user_positions[asset.mesh.faces[face], 0]
            u, v = weights @ asset.mesh.corner_uvs[face].astype(float)
            texel = albedo[int((1 - v) * len(albedo)), int(u * albedo.shape[1])]
            assert texel == pytest.approx([1.0 if x < 1 else 0.0, 0, 0], abs=0.01)


# --- polygons ---


@given(st.lists(st.integers(0, 7), min_size=1, max_size=12))
def test_fans_have_two_triangles_less_than_corners(sizes: list[int]) -> None:
    triangles = fan(np.array(sizes))
    assert len(triangles) == sum(max(n - 2, 0) for n in sizes)
    start = np.repeat(np.cumsum(sizes) - sizes, np.maximum(np.array(sizes) - 2, 0))
    assert np.array_equal(triangles[:, 0], start) and (triangles[:, 2] == triangles[:, 1] + 1).all()


@given(st.integers(0, 500), st.integers(5, 24))
def test_concave_polygons_are_covered_once(seed: int, n: int) -> None:
    """A star-shaped polygon somewhere in space: its triangles' areas, all turned one way, sum up to its own."""
    rng = np.random.default_rng(seed)
    angle = np.sort(rng.uniform(0, 2 * np.pi, n))
    if np.diff(np.append(angle, angle[0] + 2 * np.pi)).max() > 3 or np.diff(angle).min() < 1e-3:
        return  # the middle has to lie inside, and corners apart
    flat = np.stack([np.cos(angle), np.sin(angle)], axis=1) * rng.uniform(0.2, 1, (n, 1))
    frame = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    points = flat @ frame[:2]
    triangles = triangulate(np.array([n]), points)
    a, b, c = (flat[triangles[:, k]] for k in range(3))
    areas = ((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]) / 2
    x, y = flat.T
    whole = (x * np.roll(y, -1) - y * np.roll(x, -1)).sum() / 2
    assert (areas > -1e-9).all() and areas.sum() == pytest.approx(whole)
    assert np.array_equal(np.unique(triangles), np.arange(n))


# --- PLY, STL, OFF ---

PLY_VERTICES = ["0 0 0 0 0", "2 0 0 1 0", "2 2 0 1 1", "0 2 0 0 1", "4 0 0 0.5 0"]


def ply_ascii(faces: list[str], extra: str = "") -> str:
    head = "ply\nformat ascii 1.0\ncomment x\nelement vertex 5\n"
    head += "".join(f"property float {n}\n" for n in ("x", "y", "z", "s", "t"))
    head += f"element face {len(faces)}\nproperty list uchar int vertex_indices\n{extra}end_header\n"
    return head + "\n".join(PLY_VERTICES + faces) + "\n"


def ply_binary(order: str) -> bytes:
    """A quad and a triangle, with a colour between the lists: rows of different length."""
    name = {"<": "little", ">": "big"}[order]
    head = f"ply\nformat binary_{name}_endian 1.0\nelement vertex 5\n"
    head += "".join(f"property float {n}\n" for n in ("x", "y", "z", "s", "t"))
    head += "element face 2\nproperty uchar red\nproperty list uchar int vertex_index\nend_header\n"
    rows = b"".join(struct.pack(f"{order}5f", *map(float, line.split())) for line in PLY_VERTICES)
    faces = struct.pack(f"{order}BB4i", 7, 4, 0, 1, 2, 3) + struct.pack(f"{order}BB3i", 7, 3, 1, 4, 2)
    return head.encode() + rows + faces


def test_ply_polygons_of_any_size(tmp_path: Path) -> None:
    (tmp_path / "a.ply").write_text(ply_ascii(["4 0 1 2 3", "3 1 4 2"]))
    (tmp_path / "l.ply").write_bytes(ply_binary("<"))
    (tmp_path / "b.ply").write_bytes(ply_binary(">"))
    for name in ("a.ply", "l.ply", "b.ply"):
        raw = read_ply(tmp_path / name, 100)
        assert raw.faces.tolist() == [[0, 1, 2], [0, 2, 3], [1, 4, 2]]
        assert raw.positions.tolist() == [[float(x) for x in line.split()[:3]] for line in PLY_VERTICES]
        assert raw.uvs is not None and raw.uvs[2].tolist() == [[1, 0], [0.5, 0], [1, 1]]


def test_ply_uvs_of_face_corners(tmp_path: Path) -> None:
    extra = "property list uchar float texcoord\n"
    faces = ["4 0 1 2 3 8 .1 .1 .9 .1 .9 .9 .1 .9", "3 1 4 2 0"]
    (tmp_path / "a.ply").write_text(ply_ascii(faces, extra))
    raw = read_ply(tmp_path / "a.ply", 100)
    assert raw.uvs is not None and len(raw.positions) == 5
    assert raw.uvs[:2] == pytest.approx(
        np.array([[[0.1, 0.1], [0.9, 0.1], [0.9, 0.9]], [[0.1, 0.1], [0.9, 0.9], [0.1, 0.9]]])
    )
    assert np.isnan(raw.uvs[2]).all()


def test_stl_of_both_kinds(tmp_path: Path) -> None:
    box = trimesh.creation.box()
    (tmp_path / "b.stl").write_bytes(box.export(file_type="stl"))
    (tmp_path / "a.stl").write_text(box.export(file_type="stl_ascii"))
    for name in ("a.stl", "b.stl"):
        raw = read_stl(tmp_path / name, 100)
        assert len(raw.positions) == 8
        assert raw.positions[raw.faces] == pytest.approx(np.asarray(box.triangles))
        assert raw.faces.reshape(-1)[np.unique(raw.faces, return_index=True)[1]].tolist() == list(range(8))
        assert np.array_equal(
            np.sort(np.unique(raw.faces, return_index=True)[1]), np.unique(raw.faces, return_index=True)[1]
        )


def test_off_with_polygons_and_comments(tmp_path: Path) -> None:
    (tmp_path / "a.off").write_text(
        "COFF # colours\n4 2 0\n0 0 0 255 0 0\n1 0 0 0 0 0\n1 1 0 0 0 0\n# x\n0 1 0 0 0 0\n4 0 1 2 3\n2 0 1\n"
    )
    raw = read_off(tmp_path / "a.off", 100)
    assert raw.faces.tolist() == [[0, 1, 2], [0, 2, 3]] and "fewer than three" in raw.notes[0]


BROKEN = {
    "a.ply": b"ply\nformat ascii 1.0\nelement vertex 999999999999\nproperty float x\nend_header\n",
    "b.ply": ply_binary("<")[:-5],
    "c.ply": ply_ascii(["3 0 1 9"]).encode(),
    "d.ply": ply_ascii(["3 0 1"]).encode(),
    "e.ply": ply_ascii(["-1 0 1 2"]).encode(),
    "f.ply": b"ply\nformat ascii 1.0\nelement vertex 1\nproperty quaternion x\nend_header\n",
    "g.ply": b"ply\nformat binary_little_endian 1.0\nelement vertex 3\nproperty float x\n",
    "h.ply": ply_ascii(["2 0 1"]).replace("comment x", "comment TextureFile a.png").encode(),
    "a.stl": struct.pack("<80sI", b"", 3) + bytes(100),
    "b.stl": b"solid a\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nendloop\nendfacet\nendsolid\n",
    "c.stl": b"",
    "e.stl": b"solid a\nfacet\nvertex 0 0 0\n".ljust(34),  # as long as a binary one of -1 faces
    "d.stl": struct.pack("<80sI", b"", 1) + struct.pack("<12fH", *([float("nan")] * 12), 0),
    "a.off": b"OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 7\n",
    "b.off": b"OFF\n3 1 0\n0 0 0\n1 0 0\n",
    "c.off": b"OFF\nx y\n",
    "d.off": b"OFF BINARY\n",
    "e.off": b"OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n5 0 1 2\n",
    "a.fbx": b"Kaydara FBX Binary",
    "nothing": b"v 0 0 0",
}


@pytest.mark.parametrize("name", BROKEN)
def test_broken_files_are_refused(name: str, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(BROKEN[name])
    with pytest.raises(InputRefused, match="expected") as refusal:
        read_mesh(tmp_path / name)
    assert name in str(refusal.value)


def test_bounds_are_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.obj"
    path.write_text(SQUARE + "f 1 2 3\nf 1 3 4\nf 2 3 4\n")
    with pytest.raises(InputRefused, match="3 faces; expected at most 2. .*--max-faces"):
        read_mesh(path, max_faces=2)
    with pytest.raises(InputRefused, match="4 vertices; expected at most 3. .*--max-faces"):
        read_mesh(path, max_faces=1)
    with pytest.raises(InputRefused, match="found nothing"):
        read_mesh(tmp_path / "b.obj")
    (tmp_path / "c.obj").mkdir()
    with pytest.raises(InputRefused, match="not a plain file"):
        read_mesh(tmp_path / "c.obj")
    monkeypatch.setattr(bounds, "MAX_FILE_BYTES", 10)
    with pytest.raises(InputRefused, match="MiB"):
        read_mesh(path)


def test_json_is_bounded(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    for text, word in (
        ("[" * 100_000, "nested without end|deeper"),
        ("{" + '"a":{' * 300 + "}" * 301, "deeper than"),
        ("[1]", "a JSON list"),
        ('{"a": NaN}', "NaN"),
        ('{"a": 1', "no JSON"),
        ("\xff", "no JSON"),
    ):
        path.write_text(text, encoding="latin-1")
        with pytest.raises(InputRefused, match=word):
            read_json(path)
    path.write_text('{"a": [1, {"b": 2.5}]}')
    assert read_json(path) == {"a": [1, {"b": 2.5}]}


OBJ_SEED = (SQUARE + "vn 0 0 1\nmtllib m.mtl\nusemtl a\nf 1/1/1 2/2/1 3/3/1 4/4/1\nf -1 -2 -3\n").encode()
SEEDS = {
    "a.obj": OBJ_SEED,
    "a.ply": ply_ascii(["4 0 1 2 3", "3 1 4 2"]).encode(),
    "b.ply": ply_binary("<"),
    "a.stl": trimesh.creation.box().export(file_type="stl"),
    "a.off": b"OFF\n4 1 0\n0 0 0\n1 0 0\n1 1 0\n0 1 0\n4 0 1 2 3\n",
}


@pytest.mark.parametrize("name", SEEDS)
@given(
    edits=st.lists(st.tuples(st.integers(0, 10**6), st.binary(max_size=4), st.integers(0, 9)), min_size=1, max_size=4)
)
def test_damaged_files_open_or_are_refused(name: str, edits: list[tuple[int, bytes, int]], tmp_path_factory) -> None:
    """Never another exception, whatever bytes are replaced, inserted or cut."""
    content = SEEDS[name]
    for at, new, gone in edits:
        at %= len(content) + 1
        content = content[:at] + new + content[at + gone :]
    path = tmp_path_factory.getbasetemp() / f"damaged-{name}"
    path.write_bytes(content)
    reader = {".obj": read_obj, ".ply": read_ply, ".stl": read_stl, ".off": read_off}[path.suffix]
    try:
        raw = reader(path, 1000)
    except InputRefused:
        return
    assert raw.faces.min(initial=0) >= 0 and raw.faces.max(initial=-1) < len(raw.positions)
