"""Image-based lighting in one kernel, against closed forms, and the path-traced picture that is settled with it."""

import numpy as np
import pytest
import trimesh

from mistyle.core.camera import orbit
from mistyle.core.maps import flat_maps
from mistyle.core.mesh import Mesh
from mistyle.render.mitsuba import settle


@pytest.fixture(scope="module")
def ball() -> Mesh:
    ball = trimesh.creation.icosphere(subdivisions=4)
    points, faces = np.asarray(ball.vertices, np.float32), np.asarray(ball.faces, np.int32)
    uv = np.stack([np.arctan2(points[:, 0], points[:, 2]) / (2 * np.pi) % 1, points[:, 1] / 2 + 0.5], axis=1)
    return Mesh(points, faces, points[faces], uv[faces].astype(np.float32), np.zeros(len(faces), np.int32), ("ball",))


def drawn(mesh, radiance, azimuth=30.0, **maps):
    from mistyle.render.lookdev.studio import Studio, StudioSky, prefiltered
    from mistyle.render.mitsuba.draw import tracer

    traced, page = tracer(mesh), np.zeros((1, 64, 64, 4), np.float32)
    rows = np.arcsin(np.linspace(1 - 1 / 64, -1 + 1 / 64, 64))[:, None]
    columns = ((np.arange(64) + 0.5) / 64 * 2 * np.pi)[None]
    side, none = np.cos(rows), np.zeros((64, 64))
    page[0] = np.stack([np.sin(columns) * side, np.sin(rows) + none, np.cos(columns) * side, 1 + none], axis=-1)
    studio = Studio(traced, prefiltered(radiance), StudioSky(64, page), [[flat_maps(16, **maps)]])
    return next(studio.pictures([orbit(azimuth, 15, distance=4, fov=30, size=(64, 64))], (0,), 16))[0]


def test_constant_light_stays_constant_and_a_furnace_gives_the_albedo(ball):
    from mistyle.render.lookdev.studio import prefiltered

    light = np.full((32, 64, 3), (0.5, 1.0, 2.0), np.float32)
    np.testing.assert_allclose(prefiltered(light)[..., :3], np.broadcast_to((0.5, 1, 2), (6, 64, 128, 3)), rtol=1e-3)
    picture = drawn(ball, np.ones((32, 64, 3), np.float32), albedo=0.5, roughness=1.0)
    middle = picture[28:36, 28:36]
    # The diffuse part is the albedo; the coating of index 1.5 adds at most F0 and the fit's error.
    assert (middle[..., 3] > 0.999).all() and middle[..., :3].min() > 0.495 and middle[..., :3].max() < 0.56
    np.testing.assert_array_equal(picture[0, 0], 0)
    mirror = drawn(ball, np.ones((32, 64, 3), np.float32), albedo=0.9, roughness=0.0, metallic=1.0)[28:36, 28:36, :3]
    np.testing.assert_allclose(mirror, 0.9, atol=0.05)


def test_the_light_turns_with_the_camera_and_falls_where_it_comes_from(ball):
    light = np.zeros((64, 128, 3), np.float32)
    light[:20] = 1.0  # from above
    above = [drawn(ball, light, azimuth=a, albedo=0.8, roughness=1.0) for a in (30, 210)]
    np.testing.assert_allclose(above[0], above[1], atol=0.02)
    assert above[0][18, 32, 0] > 3 * above[0][46, 32, 0]


def test_cosine_weighted_irradiance():
    """Light of radiance max(0, y): irradiance / pi towards +Y is the mean of y under the cosine, 2/3."""
    from mistyle.core.light import environment_directions
    from mistyle.render.lookdev.studio import prefiltered

    sky = np.repeat(np.maximum(environment_directions(64, 128)[..., 1:2], 0), 3, axis=-1).astype(np.float32)
    np.testing.assert_allclose(prefiltered(sky)[-1, 0, :, :3], 2 / 3, rtol=0.01)


def test_open_sky_of_a_wedge():
    """Between a floor and a wall that meet at a right angle, half of the sky is open and its mean leans away."""
    from mistyle.render.mitsuba.occlusion import open_sky

    corners = [[-9, 0, -9], [9, 0, -9], [9, 0, 9], [-9, 0, 9], [0, 0, -9], [0, 0, 9], [0, 9, 9], [0, 9, -9]]
    points = np.array(corners, np.float32)
    faces = np.array([[0, 2, 1], [0, 3, 2], [4, 5, 6], [4, 6, 7]], np.int32)
    area = np.cross(points[faces[:, 1]] - points[faces[:, 0]], points[faces[:, 2]] - points[faces[:, 0]])
    normals = np.repeat((area / np.linalg.norm(area, axis=1, keepdims=True))[:, None], 3, axis=1).astype(np.float32)
    mesh = Mesh(points, faces, normals, np.zeros((4, 3, 2), np.float32), np.zeros(4, np.int32), ("wedge",))
    place, up = np.array([[0.02, 0, 0], [5, 0, 0]], np.float32), np.array([[0, 1, 0], [0, 1, 0]], np.float32)
    found = open_sky(mesh, place, up, rays=1024)
    np.testing.assert_allclose(found[:, 3], [0.5, 1.0], atol=0.03)
    assert found[0, 0] > 0.3 and abs(found[1, 0]) < 0.02


def test_settled_pictures_take_the_samples_that_they_need():
    rng = np.random.default_rng(1)
    y, x = np.mgrid[:180, :180] / 180
    guide = np.zeros((180, 180, 4), np.float32)
    inside = np.hypot(x - 0.5, y - 0.5) < 0.3
    guide[inside, 3] = 1
    guide[inside, :3] = (0.3 + 0.2 * np.sin(90 * x[inside]))[:, None]
    shade = np.where(x < 0.5, 0.5, 1.0)[..., None]
    truth = np.where(inside[..., None], guide[..., :3] * shade, 0.4).astype(np.float32)

    def passes(noise):
        while True:
            rgb = truth * rng.gamma(1 / noise**2, noise**2, (180, 180, 1)) if noise else truth
            yield np.concatenate([rgb, np.ones((180, 180, 1))], axis=-1).astype(np.float32)

    exact, behind, count = settle.settled(passes(0), guide, 1e-3, 16)
    assert count == 2 and np.abs(behind - 0.4)[~inside].max() < 1e-3
    away = np.abs(x - 0.5) > 0.05  # of the shadow's edge, which the filter softens
    assert np.abs(exact - truth)[inside & away].mean() < 0.01
    _, _, some = settle.settled(passes(0.5), guide, 4e-3, 64)
    noisy, _, most = settle.settled(passes(0.5), guide, 0, 8)
    assert 2 < some < 64 and most == 8
    raw = np.mean([next(passes(0.5))[..., :3] for _ in range(8)], axis=0)
    assert np.abs(noisy - truth)[away].mean() < 0.25 * np.abs(raw - truth)[away].mean()
