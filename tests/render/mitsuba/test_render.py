"""The renderer against theory: where points land, what rays meet, which way textures and normal maps stand."""

import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mistyle.core.camera import Camera, orbit, pixel_centres, px_from_world, world_from_px, zoom
from mistyle.core.drjit_arrays import aligned
from mistyle.core.errors import EnvironmentMissing, InputRefused
from mistyle.core.light import (
    Directional,
    SphericalGaussian,
    bake_environment,
    direction_in_world,
    environment_directions,
    lights,
    spherical_gaussian,
)
from mistyle.core.maps import Maps, flat_maps
from mistyle.core.mesh import Mesh
from mistyle.render.mitsuba import device, draw, scene
from mistyle.render.mitsuba.scene import Staging
from tests.support.helpers import ROOT

# Ray tracing in float32 about four units away.
TRACED = 2e-5
TEMPLATES = ("paper_views", "phase1_directional", "phase2_ambient", "studio", "hdri")

DIRECTIONAL = """<scene version="3.0.0">
    <integrator type="direct"><boolean name="hide_emitters" value="true"/></integrator>
    <emitter type="directional">
        <vector name="direction" value="{direction}"/><rgb name="irradiance" value="1, 1, 1"/>
    </emitter>
    <shape type="{shape}" id="{name}"/>
</scene>"""


def camera_at(azimuth: float, elevation: float, side: int = 64, distance: float = 4.0) -> Camera:
    return orbit(azimuth, elevation, distance=distance, fov=30.0, size=(side, side))


def quad(half: float = 0.5) -> Mesh:
    """A square in the plane z = 0 that faces +Z; u to the right, v up."""
    positions = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], np.float32) * half
    faces = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    uvs = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32)
    normals = np.broadcast_to(np.array([0, 0, 1], np.float32), (2, 3, 3)).copy()
    return Mesh(positions, faces, normals, uvs[faces], np.zeros(2, np.int32), ("quad",))


def sphere(rings: int = 48, parts: int = 1) -> Mesh:
    """A latitude-longitude sphere of radius 1; faces are dealt to the parts in turn."""
    v, u = np.meshgrid(np.linspace(0, 1, rings + 1), np.linspace(0, 1, 2 * rings + 1), indexing="ij")
    theta, phi = np.pi * (1 - v), 2 * np.pi * u
    grid = np.stack([np.sin(theta) * np.sin(phi), np.cos(theta), np.sin(theta) * np.cos(phi)], axis=-1).reshape(-1, 3)
    index = np.arange(grid.shape[0]).reshape(v.shape)
    a, b, c, d = (index[rows, columns].ravel() for rows, columns in _corners())
    faces = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)]).astype(np.int32)
    area = np.linalg.norm(
        np.cross(grid[faces[:, 1]] - grid[faces[:, 0]], grid[faces[:, 2]] - grid[faces[:, 0]]), axis=1
    )
    faces = faces[area > 1e-9]
    uvs = np.stack([u, v], axis=-1).reshape(-1, 2)[faces].astype(np.float32)
    normals = (grid / np.linalg.norm(grid, axis=1, keepdims=True))[faces].astype(np.float32)
    part = (np.arange(len(faces)) % parts).astype(np.int32)
    return Mesh(grid.astype(np.float32), faces, normals, uvs, part, tuple(f"p{k}" for k in range(parts)))


def _corners() -> list[tuple[slice, slice]]:
    low, high = slice(None, -1), slice(1, None)
    return [(low, low), (low, high), (high, high), (high, low)]


def maps(albedo=0.5, normal=(0, 0, 1), roughness=1.0) -> Maps:
    flat = flat_maps(2, roughness=roughness)
    unit = np.asarray(normal, np.float32) / np.linalg.norm(normal)
    colours = np.broadcast_to(np.asarray(albedo, np.float32), (2, 2, 3)).copy()
    return replace(flat, albedo=colours, normal=np.broadcast_to(unit, (2, 2, 3)).astype(np.float32))


def lit(folder: Path, direction: str, material: Maps, camera: Camera) -> np.ndarray:
    """The quad under one light that travels along `direction`, through a scene file as a user would write it."""
    path = folder / "light.xml"
    path.write_text(DIRECTIONAL.format(direction=direction, shape="sphere", name="object"))
    return draw.picture(quad(), [material], camera, Staging(path, spp=4))


@pytest.mark.parametrize(
    "camera",
    [
        camera_at(30, 0),
        camera_at(200, 45),
        camera_at(30, 89),
        camera_at(30, -89),
        camera_at(75, 90),
        zoom(camera_at(30, -45), 10, 20, 40, (64, 64)),
        orbit(310, 20, distance=4.0, fov=40.0, size=(48, 80)),
        zoom(orbit(310, 20, distance=4.0, fov=40.0, size=(48, 80)), 8, 2, 40, (64, 64)),
    ],
)
def test_a_small_bright_emitter_lands_where_we_project_it(camera: Camera) -> None:
    import mitsuba as mi

    device.use()
    # The centre of the picture moved up, to the right and forward: every kind of flip would show.
    aim = np.array([camera.size[1] * 0.62, camera.size[0] * 0.35])
    world = world_from_px(camera, aim, np.array(3.7))
    ball = {
        "type": "sphere",
        "center": world.tolist(),
        "radius": 0.04,
        "light": {"type": "area", "radiance": {"type": "rgb", "value": 1.0}},
    }
    made = mi.load_dict(
        {"type": "scene", "integrator": {"type": "direct"}, "ball": ball, "sensor": scene.sensor_dict(camera, 64)}
    )
    image = np.array(mi.render(made, spp=64))[..., 0]
    found = (pixel_centres(camera.size) * image[..., None]).sum(axis=(0, 1)) / image.sum()
    # The issue asks for half a pixel; sampling noise of the centroid stays far below a tenth.
    assert np.abs(found - px_from_world(camera, world)[0]).max() < 0.1


@pytest.mark.parametrize(("azimuth", "elevation"), [(0, 0), (30, 45), (30, -89)])
def test_hits_of_a_sphere(azimuth: float, elevation: float) -> None:
    camera = camera_at(azimuth, elevation)
    hits = draw.gbuffer(sphere(), camera)
    px = pixel_centres(camera.size)
    along = world_from_px(camera, px, np.ones(camera.size)) - camera.position
    along /= np.linalg.norm(along, axis=-1, keepdims=True)
    b = along @ camera.position
    inside = b**2 - (camera.position @ camera.position - 1)
    exact = (-b - np.sqrt(np.maximum(inside, 0))) * (along @ camera.world_from_cam[:3, 2])
    clear = inside > 0.05
    # The chords of 48 rings lie up to 0.0021 below the sphere, more along slanted rays.
    assert np.abs(hits.depth - exact)[clear].max() < 0.012
    assert np.isinf(hits.depth[inside < 0]).all() and not hits.mask[inside < 0].any()
    assert hits.mask[clear].all()
    lifted = world_from_px(camera, px[hits.mask], hits.depth[hits.mask].astype(float))
    assert np.abs(lifted - hits.position[hits.mask]).max() < TRACED
    radial = hits.position / np.maximum(np.linalg.norm(hits.position, axis=-1, keepdims=True), 1e-9)
    assert (hits.normal * radial).sum(axis=-1)[hits.mask].min() > 0.9995


def test_hits_name_the_face_the_part_and_the_uv() -> None:
    mesh = sphere(24, parts=3)
    hits = draw.gbuffer(mesh, camera_at(130, 20))
    at = hits.mask
    corners = mesh.positions[mesh.faces[hits.face[at]]].astype(float)
    p = hits.position[at].astype(float)
    edges = np.stack([corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]], axis=-1)
    weights = (np.linalg.pinv(edges) @ (p - corners[:, 0])[..., None])[..., 0]
    share = np.concatenate([1 - weights.sum(axis=1, keepdims=True), weights], axis=1)
    assert share.min() > -1e-4
    assert np.abs((share[..., None] * corners).sum(axis=1) - p).max() < TRACED
    assert np.abs((share[..., None] * mesh.corner_uvs[hits.face[at]]).sum(axis=1) - hits.uv[at]).max() < 1e-4
    smooth = (share[..., None] * mesh.corner_normals[hits.face[at]]).sum(axis=1)
    smooth /= np.linalg.norm(smooth, axis=1, keepdims=True)
    assert np.abs(smooth - hits.normal[at]).max() < 1e-4
    assert (hits.part[at] == mesh.part[hits.face[at]]).all()
    assert set(np.unique(hits.part)) == {-1, 0, 1, 2}
    for off in (hits.face[~at] + 1, hits.part[~at] + 1, hits.uv[~at], hits.normal[~at], hits.position[~at]):
        assert not off.any()


def test_texture_row_zero_is_up_and_column_zero_left() -> None:
    """Four colours, no symmetry: mirrored, turned or flipped textures all fail."""
    colours = np.array([[[0.8, 0.1, 0.1], [0.1, 0.8, 0.1]], [[0.1, 0.1, 0.8], [0.8, 0.8, 0.1]]], np.float32)
    albedo = np.kron(colours, np.ones((8, 8, 1), np.float32))
    painted = replace(flat_maps(16, roughness=1.0), albedo=albedo)
    image = draw.picture(quad(), [painted], camera_at(0, 0, 32, 2.0), Staging("phase2_ambient", spp=16))[..., :3]
    # The square fills the middle 30 of 32 pixels; sample the middle of each quarter.
    seen = image[8::16, 8::16]
    assert (seen / seen.max(axis=-1, keepdims=True) > 0.5).tolist() == (colours > 0.5).tolist()
    repeated = quad()
    repeated = replace(repeated, corner_uvs=repeated.corner_uvs + np.array([-1, 1], np.float32))
    again = draw.picture(repeated, [painted], camera_at(0, 0, 32, 2.0), Staging("phase2_ambient", spp=16))[..., :3]
    assert np.abs(again[8::16, 8::16] - seen).max() < 0.02


def test_green_of_the_normal_map_points_up_and_red_to_the_right(tmp_path: Path) -> None:
    camera = camera_at(0, 0, 16)
    middle = (slice(6, 10), slice(6, 10))
    up, right, flat = maps(normal=(0, 0.5, 1)), maps(normal=(0.5, 0, 1)), maps()
    from_above, from_right = "0, -1, -1", "-1, 0, -1"
    plain = lit(tmp_path, from_above, flat, camera)[middle][..., 0].mean()
    assert lit(tmp_path, from_above, up, camera)[middle][..., 0].mean() > 1.1 * plain
    assert lit(tmp_path, "0, 1, -1", up, camera)[middle][..., 0].mean() < 0.9 * plain
    assert lit(tmp_path, from_right, right, camera)[middle][..., 0].mean() > 1.1 * plain
    assert lit(tmp_path, "1, 0, -1", right, camera)[middle][..., 0].mean() < 0.9 * plain


def test_normals_that_face_away_are_black_for_gradients_and_lit_in_pictures() -> None:
    import mitsuba as mi

    device.use()
    camera, away = camera_at(60, 0, 16), maps(normal=(-1, 0, 0.5))
    strict = scene.scene_dict(quad(), [away], camera, Staging("phase2_ambient", spp=4))
    assert np.array(mi.render(mi.load_dict(strict), spp=4))[8, 8, :3].max() == 0
    assert draw.picture(quad(), [away], camera, Staging("phase2_ambient", spp=4))[8, 8, :3].min() > 0.1


def test_both_sides_of_a_surface_are_lit_and_irradiance_is_what_it_says(tmp_path: Path) -> None:
    front = lit(tmp_path, "0, 0, -1", maps(albedo=0.6), camera_at(0, 0, 16))[6:10, 6:10, 0].mean()
    back = lit(tmp_path, "0, 0, 1", maps(albedo=0.6), camera_at(180, 0, 16))[6:10, 6:10, 0].mean()
    assert front == pytest.approx(back, rel=1e-3)
    # Burley diffuse at head-on light and view: albedo / pi, and a rough dielectric's highlight of about 4 % / 4 pi.
    assert front == pytest.approx(0.6 / np.pi + 0.04 / (4 * np.pi), rel=0.03)


def test_the_slot_of_a_scene_file(tmp_path: Path) -> None:
    camera = camera_at(0, 0, 8)
    path = tmp_path / "scene.xml"
    path.write_text(DIRECTIONAL.format(direction="0, 0, -1", shape="sphere", name="ball"))
    with pytest.raises(InputRefused, match='id="object".*ball'):
        draw.picture(quad(), None, camera, Staging(path))
    path.write_text("<scene version='3.0.0'><shape")
    with pytest.raises(InputRefused, match="cannot load"):
        draw.picture(quad(), None, camera, Staging(path))
    with pytest.raises(InputRefused, match="no scene"):
        draw.picture(quad(), None, camera, Staging(tmp_path / "absent.xml"))
    with pytest.raises(InputRefused, match="accepts no environment map"):
        draw.picture(quad(), None, camera, Staging("phase1_directional", hdri=np.ones((4, 8, 3), np.float32)))


def test_an_environment_map_colours_the_object() -> None:
    red = np.zeros((8, 16, 3), np.float32)
    red[..., 0] = 1
    image = draw.picture(quad(), [maps()], camera_at(0, 0, 8, 2.0), Staging("hdri", spp=4, hdri=red))
    assert image[4, 4, 0] > 0.3 and image[4, 4, 1:3].max() < 1e-6 and image[4, 4, 3] == pytest.approx(1)


@pytest.mark.parametrize("template", TEMPLATES)
def test_every_template_draws_the_object(template: str) -> None:
    image = draw.picture(sphere(16), None, camera_at(30, 15, 32), Staging(template, spp=4, backdrop=False))
    assert np.isfinite(image).all()
    assert image[16, 16, :3].min() > 0.02 and image[16, 16, 3] == pytest.approx(1)
    assert not image[0, 0].any(), "the environment must not be seen"
    from_below = draw.picture(sphere(16), None, camera_at(30, -89, 32), Staging(template, spp=4))
    assert from_below[16, 16, :3].min() > 0.005


def test_the_studio_has_a_floor_for_cameras_above_it() -> None:
    with_floor = draw.picture(sphere(16), None, camera_at(30, 15, 32), Staging(spp=4))
    assert with_floor[..., 3].min() > 0.99
    turned = draw.picture(sphere(16), None, camera_at(210, 15, 32), Staging(spp=4))
    # The studio turns with the camera, and a sphere looks the same from everywhere.
    assert np.abs(with_floor - turned).mean() < 0.05


def test_the_scene_files_render_as_they_stand(tmp_path: Path) -> None:
    """All five through Mitsuba's own command line, in a copy of the folder: they need nothing beside it."""
    variant = device.use()
    out = shutil.copytree(ROOT / "scenes", tmp_path / "scenes", ignore=shutil.ignore_patterns("__pycache__", "*.png"))
    command = [str(Path(sys.executable).with_name("mitsuba")), "-m", variant, "-D", "resolution=12", "-D", "spp=2"]
    files = [str(out / f"{name}.xml") for name in TEMPLATES]
    subprocess.run([*command, *files], check=True, capture_output=True, timeout=120)
    import OpenEXR

    for name in TEMPLATES:
        with OpenEXR.File(str(out / f"{name}.exr")) as file:
            pixels = file.channels()["RGBA"].pixels
        assert pixels.shape == (12, 12, 4) and pixels[..., :3].max() > 0.05


@pytest.mark.parametrize("template", TEMPLATES)
def test_the_demo_mesh_stands_in_the_slot_as_in_the_working_space(template: str) -> None:
    from mistyle.io.read_mesh import read_mesh

    expected = read_mesh(ROOT / "scenes" / "demo.obj").mesh.positions
    slot = next(s for s in scene.read_template(template).shapes() if s.id() == "object")
    box = slot.bbox()
    # Four digits in the scene files; a demo mesh that was made anew and differs needs new ones.
    assert np.array(box.min) == pytest.approx(expected.min(axis=0), abs=0.01)
    assert np.array(box.max) == pytest.approx(expected.max(axis=0), abs=0.01)


def test_phase_one_lights_are_fixed_to_the_camera() -> None:
    """A sphere looks the same from everywhere under them; the key stands at the upper left."""
    ball = sphere(64)
    first, second = (
        draw.picture(ball, None, camera_at(a, e, 32), Staging("phase1_directional", spp=64))[..., 0]
        for a, e in ((0, 0), (130, 40))
    )
    inner = draw.gbuffer(ball, camera_at(0, 0, 32)).normal[..., 2] > 0.4
    assert np.abs(first - second)[inner].max() < 0.02
    assert first[:16, :16].mean() > 1.3 * first[16:, 16:].mean()


def test_the_records_of_the_lights_are_those_of_the_scene_file() -> None:
    import mitsuba as mi

    device.use()
    camera = camera_at(77, -33, 16)
    loaded = mi.load_dict(scene.scene_dict(sphere(8), None, camera, Staging("phase1_directional")), optimize=False)
    rig = [light for light in lights("phase1") if isinstance(light, Directional)]
    assert len(rig) == len(loaded.emitters()) == 3
    reference = mi.Interaction3f()
    reference.p = mi.Point3f(0, 0, 0)
    for record, emitter in zip(rig, loaded.emitters(), strict=True):
        sample, weight = emitter.sample_direction(reference, mi.Point2f(0.5, 0.5))
        assert np.array(sample.d).ravel() == pytest.approx(direction_in_world(record, camera), abs=1e-5)
        assert np.array(weight).ravel() == pytest.approx(record.irradiance, rel=1e-5)
    directions = np.array([light.direction for light in rig])
    assert abs(np.linalg.det(directions)) > 0.3, "three lights in a plane do not tell normals apart"


def test_the_papers_environment_is_its_spherical_gaussians(rng: np.random.Generator) -> None:
    import mitsuba as mi

    device.use()
    rig = [light for light in lights("paper") if isinstance(light, SphericalGaussian)]
    assert len(rig) == 3
    directions = rng.normal(size=(500, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    directions = directions[np.abs(directions[:, 1]) < 0.97]
    exact = sum(spherical_gaussian(light, directions) for light in rig)
    loaded = mi.load_file(str(ROOT / "scenes" / "paper_views.xml"), optimize=False, spp="1")
    ray = mi.Ray3f(mi.Point3f(0), mi.Vector3f(aligned(directions.T)))
    hit = mi.Scene.ray_intersect(mi.load_dict({"type": "scene", "e": loaded.environment()}), ray)
    seen = np.array(loaded.environment().eval(hit)).T
    # Half floats and linear interpolation between texels of 2.8 degrees.
    assert np.abs(seen - exact).max() < 0.01 * np.max(exact)
    at = environment_directions(16, 32)
    assert bake_environment(rig, 16) == pytest.approx(sum(spherical_gaussian(light, at) for light in rig), rel=1e-5)


def test_the_same_seed_gives_the_same_bytes() -> None:
    mesh, cameras = sphere(24), [camera_at(30, 0, 48), camera_at(30, 89, 48)]
    first, again, other = (draw.draw_views(mesh, None, cameras, spp=17, seed=seed) for seed in (1, 1, 2))
    for a, b, c in zip(first, again, other, strict=True):
        assert a.rgb.tobytes() == b.rgb.tobytes() and a.coverage.tobytes() == b.coverage.tobytes()
        assert a.depth.tobytes() == b.depth.tobytes() == c.depth.tobytes()
        assert a.rgb.tobytes() != c.rgb.tobytes()


def test_views_hold_what_they_say() -> None:
    heard: list[float] = []
    camera = camera_at(30, 0, 48)
    view = draw.draw_views(sphere(24), None, [camera, camera], spp=16, progress=heard.append)[0]
    assert heard == [0.5, 1.0]
    assert (view.coverage[view.mask] > 0).all()
    inside = np.abs(np.linalg.norm(pixel_centres(camera.size) - 24, axis=-1)) < 20
    assert view.coverage[inside].min() == 1
    assert not view.rgb[view.coverage == 0].any()
    assert view.rgb.dtype == view.depth.dtype == np.float32
    # A disc of radius f / sqrt(15) pixels.
    assert view.coverage.sum() == pytest.approx(np.pi * camera.focal**2 / 15, rel=0.01)


def test_parameters_name_textures_that_can_be_optimised() -> None:
    import drjit as dr
    import mitsuba as mi

    device.use()
    mesh = sphere(8, parts=2)
    maps = [flat_maps(4), flat_maps(8)]
    made = mi.load_dict(scene.scene_dict(mesh, maps, None, Staging("phase2_ambient")), optimize=False)
    found = mi.traverse(made)
    for part, side in ((0, 4), (1, 8)):
        for name, key in scene.parameters(part).items():
            values: Any = found[key]
            assert values.shape == (side, side, 3 if name in ("albedo", "normal") else 1)
            dr.enable_grad(values)
            assert dr.grad_enabled(values)


def test_samples_come_in_passes_that_threads_do_not_share() -> None:
    assert [scene.passes(n) for n in (1, 2, 3, 8, 9, 17, 64, 65)] == [
        (1, 1), (1, 2), (1, 4), (1, 8), (1, 16), (2, 16), (1, 64), (2, 64),
    ]  # fmt: skip
    assert [scene.samples(n) for n in (1, 2, 3, 8, 9, 17, 65)] == [1, 2, 4, 8, 16, 64, 256]
    with pytest.raises(ValueError, match="spp"):
        scene.samples(0)
    ball, camera = sphere(16), camera_at(30, 15, 24)
    few, many, reference = (draw.picture(ball, None, camera, Staging("paper_views", spp=n)) for n in (16, 128, 1024))
    error = [float(np.sqrt(((image - reference) ** 2).mean())) for image in (few, many)]
    # Eight times the samples halve the error at the very least, if the passes differ.
    assert error[1] < 0.5 * error[0]


def test_maps_must_match_the_parts() -> None:
    with pytest.raises(ValueError, match="texture sets"):
        scene.object_shapes(sphere(4, parts=2), [flat_maps(2)])


def test_an_unknown_variant_is_an_environment_error() -> None:
    with pytest.raises(EnvironmentMissing, match="expected one of"):
        device.use("scalar_rgb")
    assert device.use() == device.use(device.use())


def test_a_scene_with_an_exr_loads_on_one_thread():
    """In a process of its own, with a limit: on one thread Mitsuba's EXR reader waits for ever."""
    code = (
        "from mistyle.render.mitsuba import device; from mistyle.render.mitsuba import scene; device.use(threads=1);"
        "import drjit as dr; scene.read_template('studio', turn=0, floor=-1); assert dr.thread_count() == 1"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=120)


def test_a_template_that_does_not_follow_the_camera_is_loaded_once_and_gives_the_same_picture(monkeypatch):
    assert [scene.follows_camera(name) for name in TEMPLATES] == [False, True, False, True, False]
    ball, cameras = sphere(12), [orbit(angle, 10, distance=4.0, fov=30.0, size=(24, 24)) for angle in (0, 90, 200)]
    loads: list[int] = []
    load = scene.read_template
    monkeypatch.setattr(scene, "read_template", lambda *a, **k: (loads.append(1), load(*a, **k))[1])
    once = draw.pictures(ball, None, cameras, Staging("paper_views", spp=4))
    assert len(loads) == 1
    monkeypatch.setattr(scene, "follows_camera", lambda template: True)
    each = draw.pictures(ball, None, cameras, Staging("paper_views", spp=4))
    assert len(loads) == 4
    for one, other in zip(once, each, strict=True):
        assert np.array_equal(one, other)
