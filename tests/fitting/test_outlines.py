"""The outlines of a mesh in its pictures tell right cameras from wrong ones, and which axis points up."""

from dataclasses import replace
from typing import get_args

import numpy as np
import pytest

from mistyle.core.asset import UpAxis
from mistyle.core.camera import orbit
from mistyle.core.mesh import Mesh
from mistyle.fitting.pipeline.outlines import UPWARDS, camera_advice, upright_note
from mistyle.fitting.settings.material import ReferenceSettings
from mistyle.geometry.similarity import moved_camera, similarity
from mistyle.io.meshes.prepare import Y_FROM
from mistyle.render.mitsuba.draw import gbuffer, tracer
from mistyle.solver.cameras.outline_check import Outlines, check_outlines, overlap_line, overlap_notes

TURN = np.array([[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1.0]])


def wedge() -> Mesh:
    """A box with a corner drawn out: no turn and no mirror leaves its outlines as they are."""
    corners = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.3, 0.3) for z in (-0.4, 0.4)], np.float32)
    corners[-1] = (0.9, 0.7, 0.4)
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))], np.int32)
    points = corners[faces]
    normals = np.cross(points[:, 1] - points[:, 0], points[:, 2] - points[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    corner_normals = np.repeat(normals[:, None], 3, axis=1).astype(np.float32)
    uvs = np.tile(np.array([[0, 0], [1, 0], [0, 1]], np.float32), (len(faces), 1, 1))
    return Mesh(corners, faces, corner_normals, uvs, np.zeros(len(faces), np.int32), ("m",))


def test_outlines_tell_right_frames_from_wrong_ones():
    mesh = wedge()
    seen = [orbit(100.0 * k, 25, distance=4.0, fov=30.0, size=(96, 120)) for k in range(3)]
    traced = tracer(mesh)
    masks = [gbuffer(traced, camera).mask for camera in seen]
    names = ["v0", "v1", "v2"]

    def moved(matrix: np.ndarray) -> Outlines:
        return check_outlines(mesh, [replace(c, world_from_cam=matrix @ c.world_from_cam) for c in seen], masks)

    right = moved(np.eye(4))
    assert min(right.overlap) > 0.97 and overlap_notes(names, right, 0.8, "fix") == ()
    assert "v0 1.00, v1 " in overlap_line(names, right.overlap)
    shifted = np.eye(4)
    shifted[:3, 3] = (0.5, 0.2, 0)
    wrong = {
        "shifted": (moved(shifted), None),
        "Z up": (moved(TURN), "turned by 90 degrees about X"),
        "upside down": (moved(np.diag([1.0, -1, -1, 1])), "turned by 180 degrees about X"),
        "mirrored": (check_outlines(mesh, seen, [mask[:, ::-1] for mask in masks]), None),
        "turned in the picture": (check_outlines(mesh, seen, [mask[::-1, ::-1] for mask in masks]), None),
    }
    for name, (found, hint) in wrong.items():
        assert min(found.overlap) < 0.75, name
        (note,) = overlap_notes(names, found, 0.8, "Try --align")
        assert note.startswith("Warning: the cameras do not fit the mesh") and "Try --align" in note, name
        assert (hint or "") in note and (hint is not None) == ("With the cameras turned" in note), name
    blender = moved(TURN.T)
    chosen = ReferenceSettings()
    assert "--set references.up=z" in camera_advice(chosen, blender)
    for settings, found in ((chosen.model_copy(update={"up": "z"}), blender), (chosen, moved(TURN)), (chosen, right)):
        assert "--align" in camera_advice(settings, found)


def test_a_mesh_with_z_up_is_named_wherever_the_origin_of_its_file_lies():
    """The file's axes turn about its origin, not about the mesh."""
    mesh, origin = wedge(), np.array([0.5, -0.4, 0.7])
    seen = [orbit(100.0 * k, 25, distance=4.0, fov=30.0, size=(96, 120)) for k in range(3)]
    masks = [gbuffer(tracer(mesh), camera).mask for camera in seen]
    about = similarity(1.0, TURN[:3, :3], origin - TURN[:3, :3] @ origin)
    cameras = [moved_camera(camera, about) for camera in seen]
    found = check_outlines(mesh, cameras, masks, origin=origin)
    (note,) = overlap_notes(["v0", "v1", "v2"], found, 0.8, camera_advice(ReferenceSettings(), found))
    assert "turned by 90 degrees about X" in note and "The mesh's file has Z up" in note and "--align" in note
    assert "Z up" not in camera_advice(ReferenceSettings(), check_outlines(mesh, cameras, masks))


def test_outlines_that_do_not_show_a_turn_are_said():
    """A cube looks the same under the turns that take one convention for another."""
    cube = wedge()
    cube = replace(cube, positions=np.sign(cube.positions) * np.float32(0.5))
    seen = [orbit(60.0 * k, 25, distance=4.0, fov=30.0, size=(90, 90)) for k in range(3)]
    masks = [gbuffer(tracer(cube), camera).mask for camera in seen]
    found = check_outlines(cube, seen, masks)
    (note,) = overlap_notes(["a", "b", "c"], found, 0.8, "")
    assert "do not show whether the frame is the right one" in note and note.count("degrees") == 3
    assert overlap_notes(["a", "b", "c"], found, 0.8, "", trusted=True) == ()


@pytest.mark.parametrize("up", get_args(UpAxis))
@pytest.mark.parametrize("tag", range(1, 9))
def test_cameras_show_which_axis_of_a_mesh_points_up(up, tag):
    """COLMAP's world often has Y down. People hold cameras upright, whatever their pictures' EXIF orientation is."""
    turn = Y_FROM[up].T  # the file's axes from an upright world
    x, y = UPWARDS[tag - 1]
    stored = np.eye(4)
    stored[:2, :2] = [[-y, x], [-x, -y]]  # turns upwards of the stored pixels to upwards of the camera

    def seen(elevation: float) -> tuple[str, ...]:
        ring = [orbit(40.0 * k, elevation, distance=4.0, fov=30.0, size=(8, 8)) for k in range(9)]
        cameras = [moved_camera(camera, similarity(1.0, turn, np.zeros(3))) for camera in ring]
        cameras = [replace(camera, world_from_cam=camera.world_from_cam @ stored) for camera in cameras]
        return upright_note(cameras, [tag] * 9, np.eye(3) * 0.2, "y")

    notes = seen(30.0)
    assert len(notes) == (up != "y") and all(f"by the cameras {up.upper()} of its file" in note for note in notes)
    assert any("references.up=z" in note for note in notes) == (up == "z")
    assert seen(80.0) == ()  # from above, upwards is anywhere
    ring = [orbit(40.0 * k, 30.0, distance=4.0, fov=30.0, size=(8, 8)) for k in range(9)]
    assert upright_note(ring, [1] * 9, Y_FROM[up] * 3, up) == ()


def test_pictures_without_an_outline_are_not_judged():
    mesh, camera = wedge(), orbit(0, 25, distance=4.0, fov=30.0, size=(60, 60))
    everything = np.ones((60, 60), bool)
    found = check_outlines(mesh, [camera] * 3, [None, everything, ~everything])
    assert np.isnan(found.overlap).all()
    (note,) = overlap_notes(["a", "b", "c"], found, 0.8, "")
    assert "neither alpha nor masks" in note and "not checked" in note
