"""PLY, OFF and STL as scanners and data sets write them, and vertex colours of all text formats."""

import struct
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from mistyle.core.errors import InputRefused
from mistyle.core.image import linear_from_srgb
from mistyle.geometry.retexture import fetch
from mistyle.io.meshes.obj_read import read_obj
from mistyle.io.meshes.parsed_mesh import Raw
from mistyle.io.meshes.ply_read import read_ply
from mistyle.io.meshes.stl_off_read import read_off, read_stl
from mistyle.io.read_mesh import read_mesh, read_references

POINTS = ["-1 -1 0", "1 -1 0", "1 1 0", "-1 1 0"]
BYTES = np.array([[255, 0, 0], [0, 255, 0], [0, 0, 255], [128, 64, 200]])
LINEAR = linear_from_srgb((BYTES / 255).astype(np.float32))
FACES = [[0, 1, 2], [0, 2, 3]]


def off(first: str, head: str = "OFF") -> str:
    return f"{head}{first}" + "\n".join(POINTS) + "\n4 0 1 2 3\n"


@pytest.mark.parametrize("counts", ["4 1 0\n", "\n4 1 0\n", " 4 1 0\n", "\r\n4 1 0\r\n", "\n4 1\n"])
@pytest.mark.parametrize("mark", ["utf-8", "utf-8-sig"])
def test_off_headers(counts: str, mark: str, tmp_path: Path) -> None:
    path = tmp_path / "a.off"
    path.write_bytes(off(counts).encode(mark))
    assert read_off(path, 10).faces.tolist() == FACES


def ascii_stl(text: str) -> bytes:
    facets = "".join(
        f"facet normal 0 0 1\nouter loop\n{''.join(f'vertex {POINTS[k]}' + chr(10) for k in face)}endloop\nendfacet\n"
        for face in FACES
    )
    whole = f"solid x\n{facets}endsolid x\n"
    return (whole.upper() if text == "capitals" else whole.replace("\n", "\r\n")).encode(
        "utf-8-sig" if text == "marked" else "ascii"
    )


def binary_stl(header: bytes = b"", attribute: int = 0) -> bytes:
    rows = [[float(x) for k in face for x in POINTS[k].split()] for face in FACES]
    facets = b"".join(struct.pack("<12fH", 0, 0, 1, *row, attribute) for row in rows)
    return struct.pack("<80sI", header, len(FACES)) + facets


STL = {
    "capitals": ascii_stl("capitals"),
    "marked": ascii_stl("marked"),
    "two bytes more": binary_stl() + b"\0\0",
    "padded": binary_stl() + bytes(512),
    "solid, but binary": binary_stl(b"solid facet"),
    "solid, binary and two bytes more": binary_stl(b"solid name") + b"\r\n",
}


@pytest.mark.parametrize("kind", STL)
def test_stl_as_it_comes(kind: str, tmp_path: Path) -> None:
    path = tmp_path / "a.stl"
    path.write_bytes(STL[kind])
    raw = read_stl(path, 10)
    assert raw.faces.tolist() == FACES
    assert any("were ignored" in note for note in raw.notes) == ("more" in kind or kind == "padded")


def test_colours_of_stl_are_told(tmp_path: Path) -> None:
    (tmp_path / "a.stl").write_bytes(binary_stl(attribute=0x8123))
    (tmp_path / "b.stl").write_bytes(binary_stl(b"COLOR=\1\2\3\4"))
    for name in ("a.stl", "b.stl"):
        assert "Face colours (STL attributes) were not read." in read_stl(tmp_path / name, 10).notes


# --- vertex colours ---


def ply(kind: str, colours: np.ndarray, more: str = "", faces: tuple[str, ...] = ("4 0 1 2 3",)) -> str:
    head = "ply\nformat ascii 1.0\n" + more + "element vertex 4\n"
    head += "".join(f"property float {n}\n" for n in "xyz")
    head += "".join(f"property {kind} {n}\n" for n in ("red", "green", "blue"))
    head += f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    rows = (f"{point} {' '.join(map(str, c))}" for point, c in zip(POINTS, colours.tolist(), strict=True))
    return head + "\n".join([*rows, *faces]) + "\n"


def obj(colours: np.ndarray) -> str:
    rows = (f"v {point} {' '.join(map(str, c))}" for point, c in zip(POINTS, colours.tolist(), strict=True))
    return "\n".join(rows) + "\nf 1 2 3 4\n"


def coff(colours: np.ndarray, head: str = "COFF", normal: str = "", alpha: str = "") -> str:
    rows = (
        f"{point}{normal} {' '.join(map(str, c))}{alpha}" for point, c in zip(POINTS, colours.tolist(), strict=True)
    )
    return f"{head}\n4 1 0\n" + "\n".join(rows) + "\n4 0 1 2 3\n"


READERS = {".ply": read_ply, ".obj": read_obj, ".off": read_off}
COLOURED = {
    "bytes.ply": ply("uchar", BYTES),
    "words.ply": ply("ushort", BYTES * 257),
    "floats.ply": ply("float", BYTES / 255),
    "large_floats.ply": ply("float", BYTES * 1.0),
    "floats.obj": obj(BYTES / 255),
    "bytes.obj": obj(BYTES),
    "bytes.off": coff(BYTES),
    "floats.off": coff(BYTES / 255, alpha=" 1"),
    "normals.off": coff(BYTES, "CNOFF", " 0 0 1", " 255"),
}


@pytest.mark.parametrize("name", COLOURED)
def test_vertex_colours_are_srgb(name: str, tmp_path: Path) -> None:
    (tmp_path / name).write_text(COLOURED[name])
    raw: Raw = READERS[Path(name).suffix](tmp_path / name, 10)
    assert raw.colours is not None
    assert raw.colours == pytest.approx(LINEAR[np.array(FACES)], abs=1e-5)
    assert (raw.normals is not None) == name.startswith("normals") and raw.materials[0].albedo_factor == (1, 1, 1)


def test_missing_vertex_colours_are_white(tmp_path: Path) -> None:
    (tmp_path / "a.obj").write_text("v -1 -1 0 1 0 0\nv 1 -1 0\nv 1 1 0 nan nan nan\nf 1 2 3\n")
    raw = read_obj(tmp_path / "a.obj", 10)
    assert raw.colours is not None and raw.colours.tolist() == [[[1, 0, 0], [1, 1, 1], [1, 1, 1]]]


def test_face_colours(tmp_path: Path) -> None:
    (tmp_path / "a.off").write_text("OFF\n4 2 0\n" + "\n".join(POINTS) + "\n3 0 1 2 255 0 0\n3 0 2 3 128 64 200 255\n")
    text = ply("uchar", BYTES, faces=("3 0 1 2 255 0 0", "3 0 2 3 128 64 200"))
    colours = "".join(f"property uchar {n}\n" for n in ("red", "green", "blue"))
    text = text.replace(colours, "").replace("end_header", colours + "end_header")
    for point, colour in zip(POINTS, BYTES.tolist(), strict=True):
        text = text.replace(f"{point} {' '.join(map(str, colour))}\n", f"{point}\n")
    (tmp_path / "a.ply").write_text(text)
    for raw in (read_off(tmp_path / "a.off", 10), read_ply(tmp_path / "a.ply", 10)):
        assert raw.colours is not None
        assert raw.colours == pytest.approx(np.repeat(LINEAR[[0, 3]][:, None], 3, axis=1), abs=1e-5)


def test_vertex_colours_become_the_albedo(tmp_path: Path) -> None:
    """Whatever UVs the mesh gets, the middle of an edge shows the mean of its ends."""
    (tmp_path / "m.mtl").write_text("newmtl a\nKd 0.5 0.5 0.5\n")
    (tmp_path / "a.obj").write_text("mtllib m.mtl\nusemtl a\n" + obj(BYTES / 255))
    asset = read_mesh(tmp_path / "a.obj", size=64)
    (material,) = asset.materials
    assert material.albedo is not None and material.albedo_factor.tolist() == [1, 1, 1]
    for k in range(3):
        ends = [k, (k + 1) % 3]
        uv = asset.mesh.corner_uvs[0, ends] * 0.8 + asset.mesh.corner_uvs[0].mean(axis=0) * 0.2
        expected = LINEAR[np.array(FACES[0])[ends]].mean(axis=0) * 0.8 + LINEAR[FACES[0]].mean(axis=0) * 0.2
        assert fetch(material.albedo, uv.mean(axis=0, keepdims=True).astype(np.float64))[0] == pytest.approx(
            expected, abs=0.02
        )


def test_a_texture_comes_before_vertex_colours(tmp_path: Path) -> None:
    Image.new("RGB", (4, 4), (0, 255, 0)).save(tmp_path / "a.png")
    (tmp_path / "m.mtl").write_text("newmtl a\nmap_Kd a.png\n")
    uvs = "vt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\n"
    text = "mtllib m.mtl\nusemtl a\n" + uvs + obj(BYTES / 255).replace("f 1 2 3 4", "f 1/1 2/2 3/3 4/4")
    (tmp_path / "a.obj").write_text(text)
    asset = read_mesh(tmp_path / "a.obj", uv="keep")
    assert asset.materials[0].albedo is not None
    assert asset.materials[0].albedo[0, 0].tolist() == [0, 1, 0]
    assert any("Vertex colours were left out" in note for note in asset.source.notes)


# --- pictures and strips of PLY ---


def textured(files: list[str], faces: tuple[str, ...] = ("4 0 1 2 3",), more: str = "") -> str:
    head = "ply\nformat ascii 1.0\n" + "".join(f"comment TextureFile {f}\n" for f in files) + "element vertex 4\n"
    head += "".join(f"property float {n}\n" for n in ("x", "y", "z", "s", "t"))
    head += f"element face {len(faces)}\nproperty list uchar int vertex_indices\n{more}end_header\n"
    rows = [f"{p} {u}" for p, u in zip(POINTS, ("0 0", "1 0", "1 1", "0 1"), strict=True)]
    return head + "\n".join([*rows, *faces]) + "\n"


@pytest.mark.parametrize("mark", ["utf-8", "utf-8-sig"])
@pytest.mark.parametrize("named", ["a b.png", "C:\\scans\\a b.png"])
def test_texture_files_of_ply(named: str, mark: str, tmp_path: Path) -> None:
    Image.new("RGB", (4, 4), (0, 255, 0)).save(tmp_path / "a b.png")
    (tmp_path / "a.ply").write_bytes(textured([named]).encode(mark))
    asset = read_mesh(tmp_path / "a.ply", uv="keep")
    assert asset.mesh.parts == ("a b",)
    assert asset.materials[0].albedo is not None and asset.materials[0].albedo[0, 0].tolist() == [0, 1, 0]
    assert any("found by its name" in note for note in asset.source.notes) == (named != "a b.png")
    assert [p.name for p in read_references(tmp_path / "a.ply")] == ["a b.png"]


def test_several_texture_files_of_ply(tmp_path: Path) -> None:
    for name, colour in (("a.png", (255, 0, 0)), ("b.png", (0, 0, 255))):
        Image.new("RGB", (4, 4), colour).save(tmp_path / name)
    faces, path = ("3 0 1 2 1", "3 0 2 3 0"), tmp_path / "a.ply"
    path.write_text(textured(["a.png", "b.png"], faces, "property int texnumber\n"))
    asset = read_mesh(path, uv="keep")
    assert asset.mesh.parts == ("a", "b") and asset.mesh.part.tolist() == [1, 0]
    path.write_text(textured(["a.png", "b.png"]))
    assert any("no texnumber" in note for note in read_ply(path, 10).notes)
    path.write_text(textured(["c.png"]))
    asset = read_mesh(path)
    assert asset.materials[0].albedo is None and "Texture c.png is not there and was left out." in asset.source.notes


STRIPS = {
    "4 0 1 2 3": [[0, 1, 2], [2, 1, 3]],
    "7 0 1 2 -1 1 2 3": [[0, 1, 2], [1, 2, 3]],
    "8 -1 0 1 2 2 3 1 -1": [[0, 1, 2], [3, 2, 1]],
    "2 0 1": [],
    "0": [],
}


@pytest.mark.parametrize("strip", STRIPS)
def test_strips_of_ply(strip: str, tmp_path: Path) -> None:
    """Every second triangle is turned; repeated corners give none, but turn."""
    head = "ply\nformat ascii 1.0\nelement vertex 4\n" + "".join(f"property float {n}\n" for n in "xyz")
    head += "element tristrips 2\nproperty list int int vertex_indices\nend_header\n"
    (tmp_path / "a.ply").write_text(head + "\n".join([*POINTS, strip, "3 1 2 3"]) + "\n")
    assert read_ply(tmp_path / "a.ply", 10).faces.tolist() == [*STRIPS[strip], [1, 2, 3]]


def face_rows(row: str, count: int = 2) -> str:
    head = "ply\nformat ascii 1.0\nelement vertex 4\n" + "".join(f"property float {n}\n" for n in "xyz")
    head += f"element face {count}\nproperty list uchar int vertex_indices\nproperty uchar red\nend_header\n"
    return head + "\n".join(POINTS) + "\n" + row.format(*[" ".join(map(str, (3, *face))) for face in FACES])


@pytest.mark.parametrize(
    ("rows", "told"),
    [
        ("{0} 9\n{1} 9\n", ""),
        ("{0}\n9 {1}\n9", ""),  # lines broken elsewhere
        ("{0} 9 4 1 1 1 1\n\n{1} 9 2 1 1\n", "2 lines have more numbers than the header describes"),
        ("{0} 9 1\n{1} 9\n", "1 lines have more numbers than the header describes"),
    ],
)
def test_rows_of_ascii_ply(rows: str, told: str, tmp_path: Path) -> None:
    (tmp_path / "a.ply").write_text(face_rows(rows))
    raw = read_ply(tmp_path / "a.ply", 10)
    assert raw.faces.tolist() == FACES and told in " ".join(raw.notes)
    assert bool(told) == any("header describes" in note for note in raw.notes)


@pytest.mark.parametrize(
    ("rows", "found"),
    [
        ("{0} 9\n{1}\n", "a line of 4 numbers"),
        ("{0} 9\n{1} 9\n5 5\n", "numbers"),  # a line too many
        ("{0} 9 {1} 9 5\n", "numbers"),
        ("{0} 9 9\nx{1}\n", "'x3'"),
        ("{0} 9 9\n-{1} 9\n", "a list of"),
    ],
)
def test_ascii_ply_that_is_not_as_described_is_refused(rows: str, found: str, tmp_path: Path) -> None:
    (tmp_path / "a.ply").write_text(face_rows(rows))
    with pytest.raises(InputRefused, match=found):
        read_ply(tmp_path / "a.ply", 10)


@pytest.mark.parametrize("corner", ["{0}//{0}", "{0}/{0}", "{0}/{0}/{0}", "-{0}//-{0}"])
def test_faces_of_obj_may_name_what_the_file_lacks(corner: str, tmp_path: Path) -> None:
    numbers = (4, 3, 2) if corner.startswith("-") else (1, 2, 3)
    vertices = "".join(f"v {point}\n" for point in POINTS)
    (tmp_path / "a.obj").write_text(f"{vertices}f {' '.join(corner.format(n) for n in numbers)}\n")
    raw = read_obj(tmp_path / "a.obj", 10)
    assert raw.faces.tolist() == FACES[:1] and raw.normals is None and raw.uvs is None
    assert "the file has none" in raw.notes[0]
    (tmp_path / "a.obj").write_text(f"{vertices}vt 0 0\nvn 0 0 1\nf 1/2/1 2/1/1 3/1/1\n")
    with pytest.raises(InputRefused, match="texture coordinate 2"):
        read_obj(tmp_path / "a.obj", 10)
