"""Points of reconstructions other than COLMAP's (tests/io/cameras/test_colmap.py), in the space of the cameras read."""

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mistyle.core.camera import px_from_world
from mistyle.core.errors import InputRefused
from mistyle.io.cameras.captures import read_shots
from mistyle.io.cameras.sparse_points import sparse_points
from mistyle.io.images.write import write_png
from tests.support.helpers import point_cloud

SIZE = (48, 64)
APPLIED = [[0.0, 2, 0, 0.3], [0, 0, 2, -1], [2, 0, 0, 0.5]]


def nerfstudio(folder: Path, points: np.ndarray, **changes) -> np.ndarray:
    """A folder of one view; returns its matrix as stored (OpenGL axes)."""
    stored = np.eye(4)
    stored[:3, :3], stored[:3, 3] = Rotation.from_euler("y", 40, degrees=True).as_matrix(), [0.5, 0.1, 2]
    lens = {"fl_x": 50.0, "fl_y": 50.0, "cx": 31.5, "cy": 24.0, "w": SIZE[1], "h": SIZE[0]}
    frame = {"file_path": "a.png", "transform_matrix": stored.tolist()}
    tree = lens | {"frames": [frame], "ply_file_path": "sparse_pc.ply", "applied_transform": APPLIED} | changes
    folder.mkdir(exist_ok=True)
    (folder / "transforms.json").write_text(json.dumps(tree))
    write_png(folder / "a.png", np.full((*SIZE, 3), 0.5, np.float32))
    point_cloud(folder / "sparse_pc.ply", points)
    return stored


@pytest.mark.parametrize("scale", [1.0, 0.25])
def test_nerfstudios_points_are_seen_where_its_cameras_see_them(tmp_path, rng, scale):
    """Whatever transform was applied to both, a point keeps its pixel."""
    points = rng.normal(0, 0.2, (20, 3))
    stored = nerfstudio(tmp_path, points, applied_scale=scale)
    local = (points - stored[:3, 3]) @ stored[:3, :3]
    expected = 50 * local[:, :2] * [1, -1] / -local[:, 2:] + [31.5, 24]
    (shot,) = read_shots(tmp_path)
    found = sparse_points(tmp_path)
    assert found is not None
    np.testing.assert_allclose(px_from_world(shot.camera, found)[0], expected, atol=1e-3)


@pytest.mark.parametrize("name", ["/home/someone/scene/sparse_pc.ply", "C:\\scans\\sparse_pc.ply", "./sparse_pc.ply"])
def test_a_folder_that_was_moved_keeps_its_points(tmp_path, rng, name):
    nerfstudio(tmp_path, rng.normal(size=(5, 3)), ply_file_path=name)
    found = sparse_points(tmp_path)
    assert found is not None and len(found) == 5


@pytest.mark.parametrize("name", ["absent.ply", "../outside.ply", "", None, 7])
def test_points_that_are_not_there_or_elsewhere_are_not_read(tmp_path, rng, name):
    point_cloud(tmp_path / "outside.ply", rng.normal(size=(5, 3)))
    nerfstudio(tmp_path / "scene", rng.normal(size=(5, 3)), ply_file_path=name)
    assert sparse_points(tmp_path / "scene") is None


def test_an_empty_cloud_is_none_and_a_damaged_one_is_named(tmp_path):
    nerfstudio(tmp_path, np.zeros((0, 3)))
    assert sparse_points(tmp_path) is None
    (tmp_path / "sparse_pc.ply").write_text(
        "ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nend_header\n1\n2"
    )
    with pytest.raises(InputRefused, match=r"sparse_pc\.ply: found no vertices with x, y and z"):
        sparse_points(tmp_path)


def test_landmarks_of_an_sfm_data_are_its_points(tmp_path):
    """Numbers are texts there; `cameras.sfm` of Meshroom holds no landmarks."""
    tree = {"views": [], "intrinsics": [], "structure": [{"landmarkId": "1", "X": ["1", "-2.5", "3"]}]}
    file = tmp_path / "sfm.json"
    file.write_text(json.dumps(tree))
    found = sparse_points(file)
    assert found is not None and np.array_equal(found, [[1, -2.5, 3]])
    file.write_text(json.dumps(tree | {"structure": []}))
    assert sparse_points(file) is None
    file.write_text(json.dumps(tree | {"structure": [{"X": ["1", "2"]}]}))
    with pytest.raises(InputRefused, match=r"sfm\.json: found a structure without points X"):
        sparse_points(file)
