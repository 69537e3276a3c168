"""Alignment: known motions come back, moved references show the same pictures, what cannot be found is refused."""

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mistyle.core.camera import Camera, orbit, px_from_world
from mistyle.core.capture import in_memory
from mistyle.core.errors import InputRefused
from mistyle.core.light import (
    Ambient,
    Directional,
    Environment,
    Point,
    SphericalGaussian,
    bake_environment,
    direction_in_world,
    environment_directions,
    environment_radiance,
    spherical_gaussian,
)
from mistyle.core.mesh import Mesh
from mistyle.geometry.icp import align_points, in_masks, visual_hull
from mistyle.geometry.similarity import (
    Y_FROM_Z,
    fit_similarity,
    moved,
    moved_camera,
    moved_lights,
    scale_of,
    similarity,
    turned,
    upright,
)
from mistyle.io.cameras.camera_files import transforms
from mistyle.io.cameras.captures import read_captures
from mistyle.io.images.write import write_png
from mistyle.io.read_mesh import read_mesh
from mistyle.render.mitsuba.draw import gbuffer, tracer
from mistyle.solver.cameras.align import align_by_masks, align_by_points, refine_poses
from tests.support.helpers import ROOT

SCALE = 3.7
TRUE = similarity(
    SCALE, Rotation.from_euler("xyz", [40, -110, 75], degrees=True).as_matrix(), np.array([4.0, -2.0, 7.0])
)
VIEWS = ((0, 0), (75, 25), (150, -30), (215, 35), (290, -10))


@pytest.fixture(scope="module")
def mesh() -> Mesh:
    return read_mesh(ROOT / "scenes" / "demo.obj").mesh


@pytest.fixture(scope="module")
def cameras() -> list[Camera]:
    return [replace(orbit(a, e, distance=4.0, fov=30.0, size=(192, 192)), name=f"v{a}") for a, e in VIEWS]


@pytest.fixture(scope="module")
def masks(mesh, cameras) -> list[np.ndarray]:
    traced = tracer(mesh)
    return [gbuffer(traced, camera).mask for camera in cameras]


def surface(mesh: Mesh, count: int, rng: np.random.Generator) -> np.ndarray:
    """Points on the mesh: of random faces, so denser where the faces are small."""
    corners = mesh.positions[mesh.faces[rng.integers(0, len(mesh.faces), count)]]
    weight = rng.dirichlet(np.ones(3), count)
    return (corners * weight[:, :, None]).sum(axis=1)


def applied(matrix: np.ndarray, points: np.ndarray) -> np.ndarray:
    return points @ matrix[:3, :3].T + matrix[:3, 3]


def off(found: np.ndarray, truth: np.ndarray) -> tuple[float, float, float]:
    """What is left of found · truth: relative scale, degrees, shift in working units."""
    left = found @ truth
    turn = Rotation.from_matrix(left[:3, :3] / scale_of(left)).magnitude()
    return abs(scale_of(left) - 1), float(np.degrees(turn)), float(np.linalg.norm(left[:3, 3]))


def test_similarities():
    assert scale_of(TRUE) == pytest.approx(SCALE)
    points = np.random.default_rng(0).normal(size=(30, 3))
    assert fit_similarity(points, applied(TRUE, points)) == pytest.approx(TRUE)
    # Points in a plane leave a mirror open: a rotation is found.
    flat = points * [1, 1, 0]
    assert fit_similarity(flat, applied(TRUE, flat)) == pytest.approx(TRUE)
    for wrong in (np.diag([1.0, 1, -1, 1]), np.diag([1.0, 1, 2, 1]), np.diag([1.0, 1, 1, 2])):
        with pytest.raises(ValueError, match="not a similarity"):
            scale_of(wrong)


def test_a_moved_camera_sees_the_moved_world_as_before(cameras, rng):
    points = rng.normal(size=(50, 3)) * 0.5
    for camera in cameras:
        px, depth = px_from_world(camera, points)
        there, far = px_from_world(moved_camera(camera, TRUE), applied(TRUE, points))
        assert there == pytest.approx(px) and far == pytest.approx(SCALE * depth)
        turn = moved_camera(camera, TRUE).world_from_cam[:3, :3]
        assert turn @ turn.T == pytest.approx(np.eye(3))


def irradiance(light: Directional | Point, camera: Camera, point: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """What a surface with a normal at a point of the world receives."""
    if isinstance(light, Directional):
        return np.maximum(direction_in_world(light, camera) @ normal, 0) * np.asarray(light.irradiance)
    place = np.asarray(light.position)
    if light.frame == "camera":
        place = camera.world_from_cam[:3, :3] @ place + camera.position
    way = place - point
    return np.maximum(way @ normal, 0) / np.linalg.norm(way) ** 3 * np.asarray(light.intensity)


def test_moved_lights_light_the_moved_surface_as_before(cameras, rng):
    rig = (
        Directional((0.6, 0.0, 0.8), (1.0, 2.0, 3.0)),
        Directional((0.0, -0.6, -0.8), (3.0, 2.0, 1.0), "camera"),
        Point((0.5, 2.0, -1.0), (4.0, 5.0, 6.0)),
        Point((0.2, 0.0, 0.1), (6.0, 5.0, 4.0), "camera"),
    )
    camera = cameras[1]
    after = moved_camera(camera, TRUE)
    for light, other in zip(rig, moved_lights(rig, TRUE), strict=True):
        for _ in range(20):
            point, normal = rng.normal(size=3), rng.normal(size=3)
            normal /= np.linalg.norm(normal)
            before = irradiance(light, camera, point, normal)
            now = irradiance(other, after, applied(TRUE, point[None])[0], TRUE[:3, :3] @ normal / SCALE)
            assert now == pytest.approx(before)
    lobe = SphericalGaussian((0.6, 0.0, 0.8), 5.0, (1.0, 2.0, 3.0))
    turn = TRUE[:3, :3] / SCALE
    directions = environment_directions(32, 64)
    sky = Environment(bake_environment((lobe,), 128), turn=25.0, scale=2.0)
    new_lobe, new_sky, ambient = moved_lights((lobe, sky, Ambient((1.0, 1.0, 1.0))), TRUE)
    assert isinstance(new_lobe, SphericalGaussian) and isinstance(new_sky, Environment)
    assert ambient == Ambient((1.0, 1.0, 1.0))
    assert spherical_gaussian(new_lobe, directions @ turn.T) == pytest.approx(spherical_gaussian(lobe, directions))
    before = environment_radiance(sky, directions)
    assert np.abs(environment_radiance(new_sky, directions @ turn.T) - before).max() < 0.01 * before.max()


def test_an_environment_turned_about_y_keeps_its_texels(rng):
    sky = Environment(rng.random((4, 8, 3)).astype(np.float32), turn=10.0)
    after = turned(sky, Rotation.from_euler("y", 30, degrees=True).as_matrix())
    assert after.radiance is sky.radiance and after.turn == pytest.approx(40)
    directions = rng.normal(size=(9, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    there = directions @ Rotation.from_euler("y", 30, degrees=True).as_matrix().T
    assert environment_radiance(after, there) == pytest.approx(environment_radiance(sky, directions), rel=1e-4)


def test_references_in_the_meshs_own_units(tmp_path, mesh, cameras, masks):
    """A transforms.json about a mesh in its own units: the mesh's normalisation brings the cameras to it."""
    asset = read_mesh(ROOT / "scenes" / "demo.obj", up="z")
    user_from_work = np.linalg.inv(asset.source.work_from_user)
    own = [moved_camera(camera, user_from_work) for camera in cameras[:2]]
    tree = transforms(own, ["v0.png", "v1.png"])
    del tree["space"]
    (tmp_path / "transforms.json").write_text(json.dumps(tree))
    for k in range(2):
        write_png(tmp_path / f"v{k}.png", np.full((192, 192, 3), 0.5, np.float32))
    read = moved(read_captures(tmp_path, lights="unknown"), asset.source.work_from_user)
    for old, new in zip(cameras, read.cameras, strict=False):
        assert new.world_from_cam == pytest.approx(old.world_from_cam, abs=1e-9)
    assert read.load(0)[1].all()


def test_moved_references_share_their_moved_lights(cameras):
    rig = (Environment(np.ones((4, 8, 3), np.float32)),)
    pictures = [np.ones((192, 192, 3), np.float32)] * 3
    after = moved(in_memory(cameras[:3], [rig, rig, (Ambient((1.0, 1.0, 1.0)),)], pictures), TRUE)
    assert after.lights[0] is after.lights[1] and after.load(2)[0] is pictures[2]


def test_a_world_with_z_up_is_stood_up(cameras, rng):
    """What Blender says of its world: the point over the origin, a light from there, and a picture all around."""
    sky = Environment(rng.random((32, 64, 3)).astype(np.float32), turn=90)
    rig = (Directional((0.0, 0.0, 1.0), (1.0, 1.0, 1.0)), Point((1.0, 2.0, 3.0), (4.0, 4.0, 4.0)), sky)
    before = in_memory(cameras[:2], [rig, rig], [np.ones((192, 192, 3), np.float32)] * 2)
    after = upright(before)
    sun, lamp, same = after.lights[0]
    assert after.lights[0] is after.lights[1] and same is sky
    assert isinstance(sun, Directional) and isinstance(lamp, Point)
    assert sun.direction == pytest.approx((0, 1, 0)) and lamp.position == pytest.approx((1, 3, -2))
    assert lamp.intensity == pytest.approx((4, 4, 4))
    there = (px_from_world(c, np.array([[0.1, -0.2, 0.3]]))[0] for c in before.cameras)
    here = (px_from_world(c, np.array([[0.1, 0.3, 0.2]]))[0] for c in after.cameras)
    assert np.array(list(there)) == pytest.approx(np.array(list(here)))
    # Cycles: u = 0.5 - atan2(y, x) / 2 pi, v = 0.5 + asin(z) / pi, of its own axes.
    towards = np.array([[0.6, 0.0, 0.8], [0.0, -0.6, 0.8]])  # u = 0.5 and 0.75
    seen = environment_radiance(sky, towards @ Y_FROM_Z.T)
    row = np.degrees(np.arccos(0.8)) / 180 * 31
    for value, column in zip(seen, (32, 48), strict=True):
        ends = sky.radiance[[int(row), int(row) + 1], column - 1 : column + 1].mean(axis=1)
        assert value == pytest.approx(ends[0] * (1 - row % 1) + ends[1] * (row % 1), rel=1e-4)


def test_points_are_laid_on_the_mesh(mesh, rng):
    """Uneven, noisy points with outliers, in a space that is 3.7 times as large, turned and shifted."""
    points = surface(mesh, 1200, rng)
    points = points[rng.random(len(points)) < np.where(points[:, 1] < -0.5, 0.1, 1)]
    points += rng.normal(size=points.shape) * 0.005
    strays = rng.uniform(-2, 2, (80, 3))
    found, *_ = align_points(mesh, applied(TRUE, np.concatenate([points, strays])), rng)
    scale, degrees, shift = off(found.work_from_cams, TRUE)
    assert scale < 0.005 and degrees < 0.5 and shift < 0.01
    # Nine tenths of the points count; the noise along the normal is what is left.
    assert found.residual == pytest.approx(0.005, rel=0.3) and found.rival > 3
    assert found.kept[: len(points)].mean() > 0.95 and found.kept[len(points) :].mean() < 0.1
    with pytest.raises(ValueError, match="at least 20"):
        align_points(mesh, points[:19], rng)


def box() -> Mesh:
    """A box of 1 x 1 x 1.4: turned by a quarter about its long axis it is the same again."""
    import trimesh

    made = trimesh.creation.box((1.0, 1.4, 1.0))
    faces = np.asarray(made.faces, np.int32)
    positions = np.asarray(made.vertices, np.float32) / np.float32(np.linalg.norm([0.5, 0.7, 0.5]))
    nothing = np.zeros((len(faces), 3, 3), np.float32)
    return Mesh(positions, faces, nothing, nothing[..., :2], np.zeros(len(faces), np.int32), ("box",))


def test_a_symmetric_mesh_is_not_aligned_by_luck(rng):
    points = applied(TRUE, surface(box(), 150, rng))
    found, again = (align_points(box(), points, np.random.default_rng(2))[0] for _ in range(2))
    assert np.array_equal(found.work_from_cams, again.work_from_cams)
    assert found.rival < 1.1 and abs(scale_of(found.work_from_cams @ TRUE) - 1) < 0.01
    with pytest.raises(InputRefused, match="two registrations"):
        align_by_points(box(), points, [], None, rng)


def test_other_points_are_refused(mesh, rng):
    with pytest.raises(InputRefused, match="mesh radii from the mesh"):
        align_by_points(mesh, rng.uniform(-3, 3, (150, 3)), [], None, rng)


def test_masks_take_the_background_out(mesh, cameras, masks, rng):
    points, strays = surface(mesh, 300, rng), rng.uniform(-3, 3, (300, 3))
    kept = in_masks(np.concatenate([points, strays]), cameras, masks)
    assert kept[:300].mean() > 0.98 and kept[300:].mean() < 0.05
    assert not in_masks(np.array([[0.0, 0.0, 40.0]]), cameras[:1], masks[:1]).any()  # behind the camera
    with pytest.raises(InputRefused, match="of 300 points on the object"):
        align_by_points(mesh, strays, cameras, masks, rng)


def test_the_hull_surrounds_the_mesh(mesh, cameras, masks):
    shell = visual_hull(cameras, masks)
    cell = np.diff(np.unique(shell[:, 0].round(6))).min()
    # It is what all masks allow: as large as the mesh, or larger, but for the grid's cells.
    assert (shell.max(axis=0) > mesh.positions.max(axis=0) - 1.5 * cell).all()
    assert (shell.min(axis=0) < mesh.positions.min(axis=0) + 1.5 * cell).all()
    # Five cameras allow humps beside the mesh, but most of the hull is near it.
    assert np.median(np.linalg.norm(shell, axis=1)) < 1
    apart = [np.zeros_like(mask) for mask in masks]
    for k, mask in enumerate(apart):
        mask[:20, :20] = k % 2 == 0
        mask[-20:, -20:] = k % 2 == 1
    with pytest.raises(ValueError, match="nothing in common"):
        visual_hull(cameras, apart)


def test_masks_give_the_similarity_from_a_rough_start(mesh, cameras, masks, rng):
    foreign = [moved_camera(camera, TRUE) for camera in cameras]
    nudge = similarity(
        1.12, Rotation.from_euler("xyz", [9, -7, 6], degrees=True).as_matrix(), np.array([0.1, 0, -0.08])
    )
    start = nudge @ np.linalg.inv(TRUE)
    found = align_by_masks(mesh, foreign[:3], masks[:3], rng, start=start, levels=(64, 192))
    scale, degrees, shift = off(found.work_from_cams, TRUE)
    assert scale < 0.005 and degrees < 0.5 and shift < 0.01
    assert min(found.before) > 1.5 and max(found.after) < 0.2


def test_masks_alone_give_the_similarity(mesh, cameras, masks, rng):
    foreign = [moved_camera(camera, TRUE) for camera in cameras]
    found = align_by_masks(mesh, foreign, masks, rng, levels=(64,))
    scale, degrees, shift = off(found.work_from_cams, TRUE)
    assert scale < 0.005 and degrees < 0.5 and shift < 0.01
    with pytest.raises(InputRefused, match="only empty masks"):
        align_by_masks(mesh, foreign, [np.zeros((192, 192), bool)] * 5, rng)


def perturbed(camera: Camera, rng: np.random.Generator) -> Camera:
    """Turned by 1 degree and shifted by 1 % of its distance, both in a random direction."""
    axis, way = rng.normal(size=(2, 3))
    turn = Rotation.from_rotvec(np.radians(1) * axis / np.linalg.norm(axis)).as_matrix()
    motion = similarity(1.0, turn, 0.01 * np.linalg.norm(camera.position) * way / np.linalg.norm(way))
    return replace(camera, world_from_cam=camera.world_from_cam @ motion)


def px_error(mesh: Mesh, a: Camera, b: Camera) -> float:
    points = mesh.positions.astype(float)
    return float(np.sqrt(((px_from_world(a, points)[0] - px_from_world(b, points)[0]) ** 2).sum(axis=1).mean()))


def test_poses_come_back_from_silhouettes(mesh, cameras, masks, rng):
    wrong = [perturbed(camera, rng) for camera in cameras[:3]]
    torn = [mask.copy() for mask in masks[:3]]
    torn[1][:, 88:91] = False  # a cable in front of the object
    before = [px_error(mesh, *pair) for pair in zip(cameras, wrong, strict=False)]
    found = refine_poses(mesh, wrong, torn, levels=(64, 192))
    after = [px_error(mesh, *pair) for pair in zip(cameras, found.cameras, strict=False)]
    assert min(before) > 1 and max(after) < 1
    assert after[0] < 0.2 and after[2] < 0.2
    assert all(new < old for old, new in zip(found.before, found.after, strict=True))
    # A mask that shows nothing says nothing: the camera stays.
    kept = refine_poses(mesh, wrong[:1], [np.zeros((192, 192), bool)], levels=(64,))
    assert kept.cameras[0] is wrong[0] and np.isnan(kept.before[0])


def ball() -> Mesh:
    """A sphere, whose silhouette says nothing about its turning."""
    import trimesh

    made = trimesh.creation.icosphere(subdivisions=4)
    faces, positions = np.asarray(made.faces, np.int32), np.asarray(made.vertices, np.float32)
    normals = positions[faces]
    return Mesh(positions, faces, normals, normals[..., :2] * 0, np.zeros(len(faces), np.int32), ("ball",))


def test_shading_shows_what_silhouettes_do_not():
    """A camera that circled about a sphere: the same silhouette, another side of the pattern."""
    sphere = ball()
    traced = tracer(sphere)
    true = orbit(20, 10, distance=4.0, fov=30.0, size=(128, 128))
    wrong = orbit(21, 9.5, distance=4.0, fov=30.0, size=(128, 128))

    def predict(camera: Camera, k: int) -> np.ndarray:
        hits = gbuffer(traced, camera)
        waves = 0.5 + 0.4 * np.sin(hits.position @ np.array([[9.0, 2, 3], [-2, 8, 1], [3, -1, 9]]))
        return np.where(hits.mask[..., None], waves, 0).astype(np.float32)

    mask = gbuffer(traced, true).mask
    picture = 1.7 * predict(true, 0)  # another exposure
    blind = refine_poses(sphere, [wrong], [mask], levels=(128,)).cameras[0]
    seeing = refine_poses(sphere, [wrong], [mask], levels=(128,), pictures=lambda k: (picture, mask), predict=predict)
    near = sphere
    assert px_error(near, true, blind) > 0.5
    assert px_error(near, true, seeing.cameras[0]) < 0.1
    with pytest.raises(ValueError, match="needs both"):
        refine_poses(sphere, [wrong], [mask], predict=predict)
