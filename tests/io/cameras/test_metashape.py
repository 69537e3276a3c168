"""Metashape's cameras: read by its manual's formulas, and refused by name where a lens is unknown."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mistyle.core.errors import InputRefused
from mistyle.geometry.lens import distort, is_distorted, is_pinhole, pinhole, px_in_photograph, resample
from mistyle.io.cameras.captures import camera_space, read_captures, read_shots
from mistyle.io.images.write import write_png
from mistyle.io.read import read_metashape

SIZE = (48, 64)
TURN = Rotation.from_euler("xyz", [20, 30, -10], degrees=True).as_matrix()
SPACE = Rotation.from_euler("zyx", [50, -15, 5], degrees=True).as_matrix()
SHIFT, SCALE = np.array([10.0, -4.0, 2.0]), 2.5
PINHOLE = {"f": 80.0, "cx": 1.5, "cy": -2.0}


def words(values) -> str:
    return " ".join(repr(float(v)) for v in np.ravel(values))


def xml(lens=None, *, kind="frame", space=True, group=False) -> str:
    """An export of two cameras, of which the second is not aligned."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = TURN, [1, 2, -3]
    numbers = "".join(f"<{name}>{value}</{name}>" for name, value in (lens or PINHOLE).items())
    size = f'<resolution width="{SIZE[1]}" height="{SIZE[0]}"/>'
    placed = (
        f"<rotation locked='false'>{words(SPACE)}</rotation><translation locked='false'>{words(SHIFT)}</translation>"
        f"<scale locked='false'>{SCALE}</scale>"
    )
    component = f'<component id="0"><transform>{placed}</transform></component>' if space else '<component id="0"/>'
    cameras = (
        f'<camera id="0" sensor_id="0" component_id="0" label="IMG_0"><transform>{words(pose)}</transform></camera>'
        '<camera id="1" sensor_id="0" component_id="0" label="IMG_1"/>'
    )
    cameras = f"<group>{cameras}</group>" if group else cameras
    return (
        f'<?xml version="1.0" encoding="UTF-8"?>\n<document version="2.0.0"><chunk label="Chunk 1" enabled="true">'
        f'<sensors><sensor id="0" type="{kind}">{size}<calibration type="{kind}" class="initial">{size}<f>1</f>'
        f'</calibration><calibration type="{kind}" class="adjusted">{size}{numbers}</calibration></sensor></sensors>'
        f"<components>{component}</components><cameras>{cameras}</cameras></chunk></document>"
    )


def written(folder: Path, text: str, pictures: str = ".") -> Path:
    file = folder / "cameras.xml"
    file.write_text(text)
    (folder / pictures).mkdir(exist_ok=True)
    write_png(folder / pictures / "IMG_0.png", np.full((*SIZE, 3), 0.5, np.float32))
    return file


@pytest.mark.parametrize("group", [False, True])
@pytest.mark.parametrize("pictures", [".", "images"])
def test_a_point_of_the_exported_mesh_projects_by_the_manuals_formula(tmp_path, pictures, group):
    from mistyle.core.camera import px_from_world

    written(tmp_path, xml(group=group), pictures)
    tangents, depth = np.array([0.21, -0.13]), 4.0
    in_chunk = TURN @ [*(depth * tangents), depth] + [1, 2, -3]
    (shot,) = read_shots(tmp_path)
    px, far = px_from_world(shot.camera, SCALE * SPACE @ in_chunk + SHIFT)
    assert np.allclose(px, 80 * tangents + np.array(SIZE[::-1]) / 2 + [1.5, -2])
    assert far == pytest.approx(SCALE * depth)
    captures = read_captures(tmp_path, lights="unknown")
    assert [camera.name for camera in captures.cameras] == ["IMG_0"] and captures.load(0)[1].all()
    assert camera_space(tmp_path) == "own"


def test_without_a_reference_cameras_are_in_the_chunks_space(tmp_path):
    (frame,) = read_metashape(written(tmp_path, xml(space=False)))
    assert np.allclose(frame.world_from_cam[:3, 3], [1, 2, -3])


def test_distortion_is_the_manuals(tmp_path):
    """Metashape's p1 and p2 are OpenCV's p2 and p1."""
    k1, k2, k3, k4, p1, p2, b1, b2 = 0.1, -0.05, 0.01, 0.2, 0.002, -0.003, 4.0, -1.5
    lens = PINHOLE | {"k1": k1, "k2": k2, "k3": k3, "k4": k4, "p1": p1, "p2": p2, "b1": b1, "b2": b2}
    (frame,) = read_metashape(written(tmp_path, xml(lens)))
    x, y = 0.3, -0.2
    r2 = x * x + y * y
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3 + k4 * r2**4
    expected = [
        x * radial + p1 * (r2 + 2 * x * x) + 2 * p2 * x * y,
        y * radial + p2 * (r2 + 2 * y * y) + 2 * p1 * x * y,
    ]
    assert np.allclose(distort(frame.lens, np.array([x, y])), expected)
    assert frame.lens.focal == (84, 80)
    focal, centre, _ = pinhole(frame.lens)
    found = px_in_photograph(frame.lens, focal * np.array([x, y]) + centre)
    middle = np.array(SIZE[::-1]) / 2 + [PINHOLE["cx"], PINHOLE["cy"]]
    assert np.allclose(found, middle + [expected[0] * (80 + b1) + expected[1] * b2, expected[1] * 80])


def test_skewed_pixels_alone_are_resampled(tmp_path):
    (frame,) = read_metashape(written(tmp_path, xml(PINHOLE | {"b2": 8.0})))
    assert not is_distorted(frame.lens) and not is_pinhole(frame.lens)
    picture = np.broadcast_to(np.arange(SIZE[1], dtype=np.float32)[:, None] + 0.5, (*SIZE, 1))
    straight, counts = resample(frame.lens, picture, np.ones(SIZE, bool))
    rows, columns = np.nonzero(counts)
    expected = columns + 0.5 + 8 * (rows + 0.5 - frame.lens.centre[1]) / 80
    inner = (expected > 0.5) & (expected < SIZE[1] - 0.5)
    assert np.allclose(straight[rows, columns, 0][inner], expected[inner], atol=1e-4) and inner.mean() > 0.9


@pytest.mark.parametrize(
    ("text", "named"),
    [
        (xml(kind="fisheye"), "fisheye"),
        (xml(PINHOLE | {"p3": 0.1}), "p3"),
        (xml(PINHOLE | {"p4": 0.1}), "p4"),
        (xml({"cx": 0}), "focal length"),
        (xml(PINHOLE | {"f": "wide"}), "damaged"),
        (xml().replace('label="IMG_0"><transform>', 'label="IMG_0"><transform>1 '), "17 numbers"),
        (xml().replace('sensor_id="0"', 'sensor_id="9"'), "sensor"),
        (xml().replace('label="IMG_0"', 'label="IMG_0" enabled="false"'), "0 chunks"),
        (xml().replace("<scale locked='false'>2.5", "<scale locked='false'>-1"), "scale"),
        (xml()[:-30], "damaged"),
        ("<!DOCTYPE a [<!ENTITY b 'c'>]>" + xml().split("\n")[1], "document type"),
    ],
)
def test_what_cannot_be_read_is_named(tmp_path, text, named):
    with pytest.raises(InputRefused, match=named):
        read_metashape(written(tmp_path, text))


def test_other_xml_files_are_no_references(tmp_path):
    (tmp_path / "scene.xml").write_text('<scene version="3.0.0"/>')
    with pytest.raises(InputRefused, match="Metashape"):
        read_shots(tmp_path)
    with pytest.raises(InputRefused, match=r"\.xml"):
        read_shots(tmp_path / "scene.xml")
