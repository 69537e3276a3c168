"""`--align` by the points of a reconstruction whose world has Z up, as nerfstudio and Blender write it."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.material_recovery import pictures as drawing
from mistyle.core.mesh import spread_points
from mistyle.fitting.pipeline.job import MaterialJob
from mistyle.fitting.pipeline.material import place, references_of
from mistyle.fitting.settings.material import MaterialSettings, ReferenceSettings
from mistyle.geometry.similarity import degrees_between, moved_camera, similarity
from mistyle.io.cameras.camera_files import transforms
from mistyle.io.cameras.captures import read_shots
from mistyle.io.cameras.sparse_points import sparse_points
from mistyle.io.images.write import write_png
from mistyle.io.read_mesh import read_mesh
from tests.support.helpers import ROOT, point_cloud

MESH = ROOT / "scenes" / "demo.obj"


def scene(folder: Path, rng: np.random.Generator) -> tuple:
    """References of opaque pictures in another space, the mesh, and the true cameras."""
    asset = read_mesh(MESH, size=16)
    cameras = drawing.fibonacci(6, 24)
    turn = Rotation.from_euler("xyz", [80, 15, 40], degrees=True).as_matrix()
    away = similarity(1.7, turn, np.array([0.3, -0.8, 0.2]))
    strange = [replace(moved_camera(c, away), name=f"v{k}") for k, c in enumerate(cameras)]
    tree = transforms(strange, [f"{c.name}.png" for c in strange]) | {"ply_file_path": "points.ply"}
    tree.pop("space", None)
    (folder / "transforms.json").write_text(json.dumps(tree))
    for camera in strange:
        write_png(folder / f"{camera.name}.png", np.full((24, 24, 3), 0.5, np.float32))
    points = spread_points(asset.mesh.positions, asset.mesh.faces, 3000, rng).position
    point_cloud(folder / "points.ply", points @ away[:3, :3].T + away[:3, 3])
    return asset, cameras


@pytest.mark.parametrize("up", ["y", "z"])
def test_points_without_masks_place_the_cameras(tmp_path, rng, up):
    """The world's own up axis turns points and cameras alike, so that it changes nothing here."""
    asset, cameras = scene(tmp_path, rng)
    settings = MaterialSettings(references=ReferenceSettings(align=True, up=up))
    job = MaterialJob(MESH, tmp_path, tmp_path / "out", settings, "demo", lights="unknown")
    placed = place(job, asset, references_of(job), read_shots(tmp_path), lambda done: None, sparse_points(tmp_path))
    assert any("aligned to the reconstruction's points alone" in note for note in placed.notes)
    for found, true in zip(placed.cameras, cameras, strict=True):
        assert degrees_between(found.world_from_cam, true.world_from_cam) < 1
        assert np.linalg.norm(found.position - true.position) < 0.05
