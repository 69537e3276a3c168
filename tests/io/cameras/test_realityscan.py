"""RealityScan's cameras: a table or XMP files, read by Epic's paper, and refused by name where a lens is unknown."""

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mistyle.core.camera import px_from_world
from mistyle.core.errors import InputRefused
from mistyle.geometry.lens import px_in_photograph
from mistyle.io.cameras.captures import camera_space, read_captures, read_shots
from mistyle.io.cameras.reading_notes import reading_notes
from mistyle.io.cameras.realityscan import cam_from_world
from mistyle.io.cameras.realityscan_files import columns_of, in_pixels
from mistyle.io.images.write import write_png
from mistyle.io.read import read_realityscan

SIZE = (48, 64)
HEADER = "#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2"
NEWER = "#name,x,y,alt,yaw,pitch,roll,f_35mm,px_norm,py_norm,k1,k2,k3,k4,t1,t2"
CENTRE, ANGLES = np.array([1.0, 2.0, -3.0]), (163.5, 83.25, -20.5)
FOCAL, MIDDLE = 45.0, (0.02, -0.03)
RADIAL, T1, T2 = (0.1, -0.05, 0.02, 0.3), 0.004, -0.007
XMP = """<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">
<rdf:Description xmlns:xcr="http://www.capturingreality.com/ns/xcr/1.1#" xcr:Version="3" xcr:Coordinates="absolute"
 xcr:DistortionModel="brown4t2" xcr:FocalLength35mm="45" xcr:Skew="0" xcr:AspectRatio="1" xcr:PrincipalPointU="0.02"
 xcr:PrincipalPointV="-0.03"><xcr:Rotation>{rotation}</xcr:Rotation><xcr:Position>1 2 -3</xcr:Position>
<xcr:DistortionCoeficients>{lens}</xcr:DistortionCoeficients></rdf:Description></rdf:RDF></x:xmpmeta>"""


def axes(heading: float, pitch: float, roll: float) -> np.ndarray:
    """Camera from world by the paper's section 5.1: an aircraft turned in north, east, down; the camera below it."""
    ned_from_body = Rotation.from_euler("ZYX", [heading, pitch, roll], degrees=True).as_matrix()
    enu_from_ned = np.array([[0, 1, 0], [1, 0, 0], [0, 0, -1]])
    body_from_camera = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]])  # right: the right wing; down: the tail
    return (enu_from_ned @ ned_from_body @ body_from_camera).T


def projected(point: np.ndarray, size: tuple[int, int], lens: tuple[float, ...]) -> np.ndarray:
    """The pixel of a point by the paper's formulas (9), (31), (34), (43) and its footnote 6."""
    k1, k2, k3, k4, t1, t2 = lens
    x, y, z = axes(*ANGLES) @ (point - CENTRE)
    x, y = x / z, y / z
    r2 = x * x + y * y
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3 + k4 * r2**4
    bent = [x * radial + t1 * (r2 + 2 * x * x) + 2 * t2 * x * y, y * radial + t2 * (r2 + 2 * y * y) + 2 * t1 * x * y]
    side = max(size)
    return side * (FOCAL / 36 * np.array(bent) + MIDDLE) + np.array(size[::-1]) / 2


def row(name="IMG_0.png", lens=(0.0,) * 6) -> str:
    return ",".join([name, *(repr(float(v)) for v in (*CENTRE, *ANGLES, FOCAL, *MIDDLE, *lens))])


def table(*rows: str, header: str = HEADER) -> str:
    return "\n".join([header, *(rows or (row(),)), ""])


def written(folder: Path, text: str, pictures: str = ".", size: tuple[int, int] = SIZE) -> Path:
    file = folder / "cameras.csv"
    file.write_text(text, encoding="utf-8")
    (folder / pictures).mkdir(exist_ok=True)
    write_png(folder / pictures / "IMG_0.png", np.full((*size, 3), 0.5, np.float32))
    return file


def sidecar(folder: Path, text: str | None = None, name: str = "IMG_0") -> Path:
    rotation = " ".join(repr(float(v)) for v in axes(*ANGLES).ravel())
    lens = " ".join(str(v) for v in (*RADIAL, T1, T2))
    (folder / f"{name}.xmp").write_text((text or XMP).format(rotation=rotation, lens=lens))
    write_png(folder / f"{name}.png", np.full((*SIZE, 3), 0.5, np.float32))
    return folder


def test_angles_and_rotation_of_a_published_camera_agree():
    """The same camera as XMP and as CSV (forums.unrealengine.com, topic 710449)."""
    published = [
        [0.982594073038806, 0.185426733553445, -0.0112166890261935],
        [-0.032113633044729, 0.11008102707942, -0.993403685341366],
        [-0.18296885582437, 0.976472781986697],
    ]
    found = cam_from_world(163.736597399311, 83.4154313461628, 174.386496244756)
    for ours, theirs in zip(found, published, strict=True):
        assert np.allclose(ours[: len(theirs)], theirs, atol=1e-6)


@pytest.mark.parametrize("angles", [(0, 0, 0), (30, 0, 0), (0, 40, 0), (0, 0, 50), (200, -70, 110)])
def test_angles_turn_an_aircraft(angles):
    assert np.allclose(cam_from_world(*angles), axes(*angles))


@pytest.mark.parametrize("size", [SIZE, SIZE[::-1]])
@pytest.mark.parametrize("pictures", [".", "images"])
@pytest.mark.parametrize(
    "header", [HEADER, NEWER, f"#cameras 1\n{HEADER}", f"\ufeff{HEADER}", HEADER.replace(",", ", ")]
)
def test_a_point_projects_by_the_papers_formula(tmp_path, size, pictures, header):
    written(tmp_path, table(header=header), pictures, size)
    point = CENTRE + axes(*ANGLES).T @ [0.5, -0.3, 4.0]
    (shot,) = read_shots(tmp_path)
    px, depth = px_from_world(shot.camera, point)
    assert np.allclose(px, projected(point, size, (0.0,) * 6)) and depth == pytest.approx(4)
    captures = read_captures(tmp_path, lights="unknown")
    assert [camera.name for camera in captures.cameras] == ["IMG_0"] and captures.load(0)[1].all()
    assert camera_space(tmp_path) == "own" and reading_notes(tmp_path, [shot]) == ()


@pytest.mark.parametrize("kind", ["table", "xmp"])
def test_distortion_is_the_papers(tmp_path, kind):
    lens = (*RADIAL, T1, T2)
    path = written(tmp_path, table(row(lens=lens))) if kind == "table" else sidecar(tmp_path)
    (frame,) = [in_pixels(each, SIZE) for each in read_realityscan(path)]
    inside = np.array([0.3, -0.2, 1.0])
    point = CENTRE + axes(*ANGLES).T @ inside
    assert np.allclose(frame.world_from_cam[:3, :3].T, axes(*ANGLES))
    found = px_in_photograph(frame.lens, frame.lens.focal[0] * inside[:2] + frame.lens.centre)
    assert np.allclose(found, projected(point, SIZE, lens))


def test_columns_are_found_by_name(tmp_path):
    header = "#name,f,roll,pitch,heading,alt,y,x,accuracy"
    values = [FOCAL, *ANGLES[::-1], *CENTRE[::-1], 7]
    file = written(tmp_path, table("IMG_0.png," + ",".join(str(v) for v in values), header=header))
    (shot,) = read_shots(file)
    assert np.allclose(shot.camera.cam_from_world[:3, :3], axes(*ANGLES))
    assert np.allclose(shot.camera.position, CENTRE) and shot.camera.centre == (32, 24)
    first, second = reading_notes(file, [shot])
    assert "accuracy" in first and "px, py, k1, k2, k3, k4, t1, t2" in second


@pytest.mark.parametrize(
    ("text", "named"),
    [
        *[(table(header=HEADER.replace(f",{name},", f",other_{name},")), f"no column {name}")
          for name in ("x", "y", "alt", "heading", "pitch", "roll", "f")],
        ("#name,tx,ty,tz,R00,f_pix\n", "no column x, y, alt, heading, pitch, roll, f"),
        (table().replace(",", ";"), "separated by commas"),
        (table(row().replace("45.0", "45,0")), "17 fields in line 2.*decimal points"),
        (table(row().replace("45.0", "4x")), "f = '4x' in line 2"),
        (table(row().replace("45.0", "nan")), "f = 'nan'"),
        (table(row().replace("45.0", "1.25")), "focal length of 1.25"),
        (table(row()[:-8]), "fields in line 2"),
        (table(row("")), "no name in line 2"),
        (table(row(), row()), "two cameras of 'IMG_0.png'"),
        (table(header=f"{HEADER[:-3]},k1"), "two columns k1"),
        (table(header=f"#cameras 2\n{HEADER}"), "1 cameras; expected 2"),
        (f"{HEADER}\n", "0 cameras"),
        (table(row(lens=(0.1, 0, 0, 0, 0, 0))), "division model"),
        (table(row("other.png")), "no picture 'other.png'"),
    ],
)  # fmt: skip
def test_what_cannot_be_read_is_named(tmp_path, text, named):
    with pytest.raises(InputRefused, match=named):
        read_shots(written(tmp_path, text))


def test_text_that_is_not_utf8_is_refused(tmp_path):
    file = written(tmp_path, table())
    file.write_bytes(file.read_bytes().replace(b"IMG_0", b"IMG_\xe9"))
    with pytest.raises(InputRefused, match="damaged"):
        read_shots(file)


@pytest.mark.parametrize(
    ("old", "new", "named"),
    [
        ("brown4t2", "division", "division"),
        ("brown4t2", "rationalP2D1", "rationalP2D1"),
        ('Skew="0"', 'Skew="0.1"', "square pixels"),
        ('AspectRatio="1"', 'AspectRatio="1.1"', "square pixels"),
        ("xcr:FocalLength35mm", "xcr:FocalLength", "FocalLength35mm"),
        ("1 2 -3", "1 2", "2 numbers of Position"),
        ("1 2 -3", "1 2 far", "Position = 'far'"),
        ("{rotation}", "1 0 0 0 1 0 0 0 -1", "not a rotation"),
        ("</x:xmpmeta>", "", "damaged"),
        ("<x:xmpmeta", "<!DOCTYPE a [<!ENTITY b 'c'>]><x:xmpmeta", "document type"),
    ],
)
def test_what_cannot_be_read_of_an_xmp_file_is_named(tmp_path, old, new, named):
    with pytest.raises(InputRefused, match=named):
        read_shots(sidecar(tmp_path, XMP.replace(old, new)))


def test_xmp_files_are_those_of_aligned_pictures(tmp_path):
    """Attributes count as elements do; calibrations alone and sidecars of other programs are no cameras."""
    sidecar(tmp_path)
    moved = XMP.replace("<xcr:Position>1 2 -3</xcr:Position>", "").replace("xcr:Skew", 'xcr:Position="1 2 -3" xcr:Skew')
    sidecar(tmp_path, moved, "IMG_1")
    (tmp_path / "_common.xmp").write_text(XMP.split("<xcr:Rotation>")[0] + "</rdf:Description></rdf:RDF></x:xmpmeta>")
    (tmp_path / "IMG_2.xmp").write_text('<x:xmpmeta xmlns:x="adobe:ns:meta/"/>')
    for path in (tmp_path, tmp_path / "IMG_0.xmp"):
        shots = read_shots(path)
        assert [shot.picture.name for shot in shots] == ["IMG_0.png", "IMG_1.png"]
        assert all(np.allclose(shot.camera.position, CENTRE) for shot in shots)
    with pytest.raises(InputRefused, match=r"\.xmp"):
        read_shots(tmp_path / "IMG_2.xmp")


def test_of_two_tables_a_note_names_the_one_not_read(tmp_path):
    written(tmp_path, table())
    (tmp_path / "later.csv").write_text(table())
    notes = reading_notes(tmp_path, read_shots(tmp_path))
    assert notes == ("cameras.csv was read, and not later.csv.",)


@pytest.mark.parametrize("text", ["name,price\nchair,3\n", "", "\x00\x01,2", HEADER + "\n" + row()])
def test_a_table_beside_cameras_does_not_disturb(tmp_path, text):
    written(tmp_path, table(), "elsewhere")
    written(tmp_path, text)
    view = {"name": "IMG_0", "width": 64, "height": 48, "fx": 80, "fy": 80, "cx": 32, "cy": 24, "png": "IMG_0.png"}
    view["opencv"] = {"R": np.eye(3).tolist(), "t": [0, 0, 4]}
    (tmp_path / "camera.json").write_text(json.dumps({"views": [view]}))
    (shot,) = read_shots(tmp_path)
    assert shot.camera.focal == 80
    (tmp_path / "camera.json").unlink()
    if not columns_of(tmp_path / "cameras.csv"):
        for path in (tmp_path, tmp_path / "cameras.csv"):
            with pytest.raises(InputRefused, match="RealityScan's CSV"):
                read_shots(path)
