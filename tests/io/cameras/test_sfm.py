"""Meshroom's cameras: read as AliceVision describes them, and refused by name where a lens is unknown."""

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mistyle.core.camera import px_from_world
from mistyle.core.errors import InputRefused
from mistyle.io.cameras.captures import camera_space, read_captures, read_shots
from mistyle.io.cameras.sfm import read_sfm
from mistyle.io.images.write import write_png

SIZE = (48, 64)


def sfm(**changes) -> dict:
    """A file of two views with texts as numbers, as Meshroom writes it; the second view has no pose."""
    turn = Rotation.from_euler("xyz", [20, 30, -10], degrees=True).as_matrix()  # camera from world
    intrinsic = {
        "intrinsicId": "7",
        "width": str(SIZE[1]),
        "height": str(SIZE[0]),
        "sensorWidth": "36",
        "sensorHeight": "27",
        "type": "pinhole",
        "focalLength": "45",
        "pixelRatio": "1",
        "principalPoint": ["1.5", "-2"],
        "distortionParams": "",
    } | changes
    views = [
        {"viewId": str(k), "poseId": str(k), "intrinsicId": "7", "path": f"D:/castle/images/IMG_{k}.png"}
        for k in range(2)
    ]
    transform = {"rotation": [repr(float(v)) for v in turn.T.ravel()], "center": ["1", "2", "-3"]}
    return {
        "version": ["1", "2", "6"],
        "views": views,
        "intrinsics": [intrinsic],
        "poses": [{"poseId": "0", "pose": {"transform": transform, "locked": "0"}}],
    }


def written(folder: Path, tree: dict) -> Path:
    file = folder / "cameras.sfm"
    file.write_text(json.dumps(tree))
    write_png(folder / "IMG_0.png", np.full((*SIZE, 3), 0.5, np.float32))
    return file


def test_a_point_projects_by_alicevisions_formula(tmp_path):
    (frame,) = read_sfm(written(tmp_path, sfm()))
    turn = Rotation.from_euler("xyz", [20, 30, -10], degrees=True).as_matrix()
    point = np.array([0.3, -0.2, 4.0])
    x, y, z = turn @ (point - [1, 2, -3])
    focal = 45 / 36 * SIZE[1]
    expected = focal * np.array([x, y]) / z + np.array(SIZE[::-1]) / 2 + [1.5, -2]
    (shot,) = read_shots(tmp_path)
    px, depth = px_from_world(shot.camera, point)
    assert np.allclose(px, expected) and depth == pytest.approx(z)
    assert frame.name == "IMG_0" and frame.pixels == "stored"


def test_a_folder_with_cameras_sfm_is_a_set_of_references(tmp_path):
    written(tmp_path, sfm())
    captures = read_captures(tmp_path, lights="unknown")
    assert [camera.name for camera in captures.cameras] == ["IMG_0"] and captures.load(0)[1].all()
    assert camera_space(tmp_path) == "own"


def test_old_files_count_from_the_corner_and_in_pixels(tmp_path):
    old = sfm(principalPoint=["30", "25"], pxFocalLength="80", focalLength=None) | {"version": ["1", "0", "0"]}
    (frame,) = read_sfm(written(tmp_path, old))
    assert frame.lens.focal == (80, 80) and frame.lens.centre == (30, 25)


def test_distortion_is_browns(tmp_path):
    (frame,) = read_sfm(written(tmp_path, sfm(type="radial3", distortionParams=["0.1", "0.05", "-0.001"])))
    assert frame.lens.radial == (0.1, 0.05, -0.001) and frame.lens.tangential == (0, 0)
    both = sfm(type="pinhole", distortionType="brown", distortionParams=["0.1", "0", "0", "0.002", "0.003"])
    (frame,) = read_sfm(written(tmp_path, both))
    assert frame.lens.radial == (0.1, 0, 0) and frame.lens.tangential == (0.002, 0.003)


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"type": "equidistant"}, "equidistant"),
        ({"distortionType": "3deanamorphic4"}, "3deanamorphic4"),
        ({"pixelRatio": "2"}, "pixelRatio 2"),
        ({"focalLength": None}, "no focal length"),
        ({"width": "many"}, "intrinsics.0.width"),
    ],
)
def test_what_is_not_supported_is_named(tmp_path, changes, named):
    with pytest.raises(InputRefused, match=named):
        read_sfm(written(tmp_path, sfm(**changes)))


def test_cameras_without_poses_are_refused(tmp_path):
    with pytest.raises(InputRefused, match="StructureFromMotion"):
        read_sfm(written(tmp_path, sfm() | {"poses": []}))


def test_arkit_apps_transforms_are_read_as_they_write_them(tmp_path):
    """Polycam and Record3D by nerfstudio's converters: intrinsics in each frame, OpenGL axes, no distortion."""
    turn = Rotation.from_euler("y", 40, degrees=True).as_matrix()
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = turn, [0.5, 0.1, 2]
    frame = {
        "file_path": "./images/frame_00001.png", "fl_x": 50.0, "fl_y": 50.0, "cx": 31.5, "cy": 24.0, "w": SIZE[1],
        "h": SIZE[0], "transform_matrix": matrix.tolist(), "depth_file_path": "./depth/frame_00001.png",
    }  # fmt: skip
    (tmp_path / "images").mkdir()
    write_png(tmp_path / "images" / "frame_00001.png", np.full((*SIZE, 3), 0.5, np.float32))
    tree = {"camera_model": "OPENCV", "frames": [frame], "ply_file_path": "sparse_pc.ply"}
    (tmp_path / "transforms.json").write_text(json.dumps(tree))
    (shot,) = read_shots(tmp_path)
    ahead = np.array([0.5, 0.1, 2]) - 3 * turn[:, 2]  # OpenGL looks along -z
    px, depth = px_from_world(shot.camera, ahead)
    assert np.allclose(px, (31.5, 24)) and depth == pytest.approx(3)


@pytest.mark.parametrize(
    ("name", "text", "named", "way"),
    [
        ("scene.nvm", "NVM_V3\n", "VisualSFM", "transforms.json"),
        ("bundle.out", "# Bundle file v0.3\n", "Bundler", "transforms.json"),
        ("scene.mvs", "MVSI", "OpenMVS", "COLMAP model"),
        ("sfm_data.json", '{"sfm_data_version": "0.3", "views": [], "intrinsics": []}', "OpenMVG", "openMVG2Colmap"),
        ("reconstruction.json", '[{"cameras": {}, "shots": {}}]', "OpenSfM", "export_colmap"),
        ("trajectory.json", '{"class_name": "PinholeCameraTrajectory"}', "Open3D", "transforms.json"),
        ("cameras.json", '[{"id": 0, "img_name": "a", "fx": 1}]', "Gaussian splatting", "COLMAP model"),
    ],
)
def test_cameras_of_other_programs_are_named(tmp_path, name, text, named, way):
    (tmp_path / name).write_text(text)
    (tmp_path / "other.json").write_text('{"images": []}')
    for path in (tmp_path, tmp_path / name):
        with pytest.raises(InputRefused, match=named) as refusal:
            read_shots(path)
        assert way in str(refusal.value) and name in str(refusal.value)
    with pytest.raises(InputRefused, match="an object of images"):
        read_shots(tmp_path / "other.json")
