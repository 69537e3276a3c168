"""Cameras by their definition: projection and its inverse, frames, the pixel convention, the paper's rig."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mistyle.core.camera import (
    MITSUBA_FROM_OPENCV,
    OPENGL_FROM_OPENCV,
    Camera,
    in_frame,
    look_at,
    of_corners,
    orbit,
    pixel_centres,
    px_from_world,
    resized,
    rig,
    visiting_order,
    world_from_px,
    zoom,
)
from mistyle.core.settings import RigSettings

# float64 projections of points a few units away: rounding only.
EXACT = 1e-9

angles = st.tuples(st.floats(-360, 360), st.floats(-90, 90))
points = st.tuples(*[st.floats(-1, 1)] * 3)


def camera_at(azimuth: float, elevation: float, size: tuple[int, int] = (48, 64)) -> Camera:
    return orbit(azimuth, elevation, distance=4.0, fov=30.0, size=size)


@given(angles, points)
def test_lifting_a_projected_point_gives_the_point(angle, point) -> None:
    camera, world = camera_at(*angle), np.array(point)
    px, depth = px_from_world(camera, world)
    assert np.abs(world_from_px(camera, px, depth) - world).max() < EXACT


@given(angles)
def test_every_camera_is_a_right_handed_rigid_motion_that_looks_at_the_origin(angle) -> None:
    camera = camera_at(*angle)
    rotation = camera.world_from_cam[:3, :3]
    assert np.abs(rotation @ rotation.T - np.eye(3)).max() < EXACT
    assert np.linalg.det(rotation) == pytest.approx(1)
    assert np.abs(camera.cam_from_world @ camera.world_from_cam - np.eye(4)).max() < EXACT
    px, depth = px_from_world(camera, np.zeros(3))
    assert px == pytest.approx(camera.centre)
    assert depth == pytest.approx(4)


@given(st.floats(-360, 360), st.floats(-89.4, 89.4))
def test_up_in_the_world_is_up_in_the_picture(azimuth, elevation) -> None:
    above, _ = px_from_world(camera_at(azimuth, elevation), np.array([0, 0.01, 0]))
    assert above[1] < 24
    assert above[0] == pytest.approx(32)


def test_azimuth_and_elevation_mean_what_they_say() -> None:
    assert camera_at(0, 0).position == pytest.approx([0, 0, 4])
    assert camera_at(90, 0).position == pytest.approx([4, 0, 0])
    assert camera_at(0, 90).position == pytest.approx([0, 4, 0])
    right, _ = px_from_world(camera_at(0, 0), np.array([0.5, 0, 0]))
    assert right[0] > 32


def test_pixel_centres_lie_at_a_half() -> None:
    centres = pixel_centres((3, 5))
    assert centres.shape == (3, 5, 2)
    assert centres[0, 0].tolist() == [0.5, 0.5]
    assert centres[2, 4].tolist() == [4.5, 2.5]
    camera = camera_at(20, 10, (3, 5))
    assert in_frame(camera, centres).all()
    assert not in_frame(camera, np.array([[5.0, 1.0], [-0.1, 1.0], [1.0, 3.0]])).any()


def test_the_field_of_view_spans_the_width() -> None:
    camera = camera_at(0, 0)
    edge = 4 * np.tan(np.radians(15))
    px, _ = px_from_world(camera, np.array([[edge, 0, 0], [-edge, 0, 0]]))
    assert px[:, 0] == pytest.approx([64, 0])
    assert camera.fov == pytest.approx(30)


@given(angles, points, st.floats(0, 40), st.floats(0, 30), st.floats(4, 30))
def test_a_zoomed_camera_sees_the_window(angle, point, x, y, width) -> None:
    camera, world = camera_at(*angle), np.array(point)
    px, depth = px_from_world(camera, world)
    near, near_depth = px_from_world(zoom(camera, x, y, width, (100, 100)), world)
    assert near == pytest.approx((px - [x, y]) * (100 / width), abs=1e-6)
    assert near_depth == depth


def test_corners_are_half_a_pixel_further_out() -> None:
    camera, world = camera_at(30, 20), np.array([0.3, -0.2, 0.6])
    corners = of_corners(camera)
    assert corners.size == (camera.size[0] + 1, camera.size[1] + 1)
    assert px_from_world(corners, world)[0] == pytest.approx(px_from_world(camera, world)[0] + 0.5)


def test_resizing_keeps_the_picture_and_refuses_another_shape() -> None:
    camera, world = camera_at(70, -20), np.array([0.3, -0.2, 0.6])
    larger = resized(camera, (96, 128))
    assert px_from_world(larger, world)[0] == pytest.approx(2 * px_from_world(camera, world)[0])
    with pytest.raises(ValueError, match="aspect"):
        resized(camera, (48, 48))


def test_opengl_and_mitsuba_axes() -> None:
    ahead, right, up = np.array([0, 0, 1, 0]), np.array([1, 0, 0, 0]), np.array([0, -1, 0, 0])
    assert (OPENGL_FROM_OPENCV @ ahead).tolist() == [0, 0, -1, 0]
    assert (OPENGL_FROM_OPENCV @ up).tolist() == [0, 1, 0, 0]
    assert (MITSUBA_FROM_OPENCV @ right).tolist() == [-1, 0, 0, 0]
    assert (MITSUBA_FROM_OPENCV @ up).tolist() == [0, 1, 0, 0]
    assert (MITSUBA_FROM_OPENCV @ ahead).tolist() == [0, 0, 1, 0]


def test_the_papers_rig() -> None:
    cameras = rig(RigSettings.model_validate({"resolution": 64}))
    seen = [(round(c.azimuth), round(c.elevation)) for c in cameras]
    assert len(seen) == len(set(seen)) == 16
    assert {(30 * k, 0) for k in range(1, 13)} <= set(seen)
    assert {(30, e) for e in (45, -45, 89, -89)} <= set(seen)
    assert seen[0] == (30, 0)
    costs = [abs(a) + abs(e) for a, e in seen]
    assert costs == sorted(costs)
    assert [c.name for c in visiting_order(cameras)] == [c.name for c in cameras]
    assert all(np.linalg.norm(c.position) == pytest.approx(4) and c.fov == pytest.approx(30) for c in cameras)


def test_a_camera_on_its_target_is_refused() -> None:
    with pytest.raises(ValueError, match="target"):
        look_at((1, 2, 3), (1, 2, 3), fov=30, size=(8, 8))
