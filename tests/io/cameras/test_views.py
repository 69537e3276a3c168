"""Folders of views: what we write is what others read, and what others write is read or refused with a reason."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mistyle.core.camera import Camera, orbit, px_from_world, zoom
from mistyle.core.errors import InputRefused
from mistyle.core.image import linear_from_srgb, srgb_from_linear
from mistyle.core.light import Ambient, Directional, SceneLights, SphericalGaussian, from_json, lights, to_json
from mistyle.core.view import View
from mistyle.io.cameras.camera_files import camera_entry, read_entries, transforms
from mistyle.io.cameras.views import paper_depth, read_cameras, read_lights, read_views, write_views
from mistyle.io.images.write import write_png

# Rotations go through a transpose, translations through one product in float64.
ROUNDING = 1e-12
# Eight bits of sRGB, and linear values rise by up to 2.4 times as fast.
EIGHT_BITS = 0.5 / 255 * 2.5


def a_view(rng: np.random.Generator, camera: Camera) -> View:
    height, width = camera.size
    mask = np.zeros(camera.size, bool)
    mask[2 : height - 2, 1 : width - 3] = True
    coverage = mask.astype(np.float32)
    coverage[2] *= 0.25
    normal = rng.normal(size=(height, width, 3)).astype(np.float32)
    return View(
        camera=camera,
        rgb=(rng.random((height, width, 3)).astype(np.float32) * coverage[..., None]).astype(np.float32),
        depth=np.where(mask, 3 + rng.random(camera.size), np.inf).astype(np.float32),
        normal=normal * mask[..., None],
        uv=rng.random((height, width, 2)).astype(np.float32) * mask[..., None],
        part=np.where(mask, 2, -1).astype(np.int32),
        mask=mask,
        coverage=coverage,
    )


@pytest.fixture
def views(rng: np.random.Generator) -> list[View]:
    square = orbit(30, 0, distance=4.0, fov=30.0, size=(16, 16))
    wide = replace(zoom(orbit(200, -89, distance=4.0, fov=30.0, size=(40, 40)), 3, 5, 20, (12, 20)), name="wide")
    return [a_view(rng, square), a_view(rng, wide)]


def same(a: Camera, b: Camera) -> None:
    assert np.abs(a.world_from_cam - b.world_from_cam).max() < ROUNDING
    assert (a.focal, a.centre, a.size, a.name) == (b.focal, b.centre, b.size, b.name)


def test_views_come_back_as_they_were(tmp_path: Path, views: list[View]) -> None:
    heard: list[float] = []
    write_views(tmp_path, views, lights("phase1"), progress=heard.append)
    assert heard == [0.5, 1.0]
    for old, new in zip(views, read_views(tmp_path), strict=True):
        same(old.camera, new.camera)
        assert new.camera.azimuth == pytest.approx(old.camera.azimuth, nan_ok=True)
        for field in ("rgb", "depth", "normal", "uv", "part", "mask", "coverage"):
            before, after = getattr(old, field), getattr(new, field)
            assert before.dtype == after.dtype and np.array_equal(before, after), field


def test_the_same_views_give_the_same_bytes(tmp_path: Path, views: list[View]) -> None:
    for folder in ("a", "b"):
        write_views(tmp_path / folder, views, lights("paper"), paper_files=True)
    files = sorted(path.name for path in (tmp_path / "a").iterdir())
    assert len(files) == 3 + 2 * 4
    assert all((tmp_path / "a" / f).read_bytes() == (tmp_path / "b" / f).read_bytes() for f in files)


def test_other_programs_can_read_the_pictures(tmp_path: Path, views: list[View]) -> None:
    """Independent readers: the OpenEXR package and OpenCV."""
    import OpenEXR

    write_views(tmp_path, views, (), paper_files=True)
    view = views[0]
    with OpenEXR.File(str(tmp_path / f"{view.camera.name}.exr"), separate_channels=True) as file:
        planes = {name: channel.pixels for name, channel in file.channels().items()}
    layers = {"normal.X", "normal.Y", "normal.Z", "uv.U", "uv.V", "depth.Z", "part.index"}
    assert set(planes) == {"R", "G", "B", "A"} | layers
    assert np.array_equal(planes["G"], view.rgb[..., 1]) and np.array_equal(planes["depth.Z"], view.depth)
    png = cv2.imread(str(tmp_path / f"{view.camera.name}.png"), cv2.IMREAD_UNCHANGED)
    assert png is not None and png.dtype == np.uint8 and png.shape == (16, 16, 4)
    solid = view.coverage == 1
    expected = np.rint(srgb_from_linear(view.rgb)[..., ::-1] * 255)
    assert np.abs(png[..., :3] - expected)[solid].max() <= 1
    assert np.abs(png[..., 3] - view.coverage * 255).max() <= 0.5
    # Not premultiplied: a quarter-covered pixel keeps its full colour.
    edge = view.coverage == 0.25
    straight = srgb_from_linear(view.rgb / 0.25)[..., ::-1] * 255
    assert np.abs(png[..., :3] - straight)[edge].max() <= 1


def test_the_papers_files(tmp_path: Path, views: list[View]) -> None:
    write_views(tmp_path, views, (), paper_files=True)
    view = views[0]
    depth = cv2.imread(str(tmp_path / f"{view.camera.name}_depth.png"), cv2.IMREAD_UNCHANGED)
    near, far = view.depth[view.mask].min(), view.depth[view.mask].max()
    assert depth is not None and depth.dtype == np.uint8 and depth.ndim == 2
    assert not depth[~view.mask].any()
    # The paper's own formula, solved for p: d = -(z_min + p / 255 (z_max - z_min)) with OpenGL's negative z.
    recovered = -(-far + depth / 255 * (far - near))
    assert np.abs(recovered - view.depth)[view.mask].max() <= (far - near) / 255 * 0.51
    assert depth[view.mask].max() == 255
    edges = cv2.imread(str(tmp_path / f"{view.camera.name}_canny.png"), cv2.IMREAD_UNCHANGED)
    assert edges is not None
    eight = np.rint(srgb_from_linear(view.rgb) * 255).astype(np.uint8)
    assert np.array_equal(edges, cv2.Canny(cv2.cvtColor(eight, cv2.COLOR_RGB2GRAY), 100, 200))
    constant = np.where(view.mask, 3.0, np.inf).astype(np.float32)
    assert paper_depth(constant)[view.mask].min() == 1 and not paper_depth(np.full((2, 2), np.inf, np.float32)).any()


def test_camera_json_holds_both_conventions(views: list[View]) -> None:
    view = views[0]
    entry = json.loads(json.dumps(camera_entry(view.camera, view.depth)))
    world = np.array([0.3, 0.4, -0.2])
    px, z = px_from_world(view.camera, world)
    cv, gl = (np.array(entry[c]["R"]) @ world + entry[c]["t"] for c in ("opencv", "opengl"))
    assert cv[2] == pytest.approx(z) and gl[2] == pytest.approx(-z)
    assert entry["fx"] * cv[0] / cv[2] + entry["cx"] == pytest.approx(px[0])
    assert entry["cy"] - entry["fy"] * gl[1] / -gl[2] == pytest.approx(px[1])
    near, far = view.depth[view.mask].min(), view.depth[view.mask].max()
    assert (entry["opencv"]["z_min"], entry["opencv"]["z_max"]) == (near, far)
    assert (entry["opengl"]["z_min"], entry["opengl"]["z_max"]) == (-far, -near)
    assert camera_entry(view.camera)["opencv"]["z_min"] is None


@given(st.floats(-360, 360), st.floats(-90, 90), st.floats(5, 100))
def test_transforms_json_is_the_blender_convention(azimuth: float, elevation: float, fov: float) -> None:
    camera = orbit(azimuth, elevation, distance=4.0, fov=fov, size=(24, 32))
    tree = transforms([camera], ["./a.png"])
    matrix = np.array(tree["frames"][0]["transform_matrix"])
    # Blender's camera looks along its own -Z, Y up, and stands at the last column.
    assert matrix[:3, 3] == pytest.approx(camera.position)
    assert -matrix[:3, 2] * 4 == pytest.approx(-camera.position, abs=1e-9)
    assert np.linalg.det(matrix[:3, :3]) == pytest.approx(1)
    assert tree["fl_x"] == pytest.approx(16 / np.tan(tree["camera_angle_x"] / 2))
    assert np.degrees(tree["camera_angle_x"]) == pytest.approx(fov)


def test_cameras_from_either_file_are_the_same(tmp_path: Path, views: list[View]) -> None:
    write_views(tmp_path, views, ())
    for name in ("camera.json", "transforms.json"):
        for old, new in zip(views, read_cameras(tmp_path / name), strict=True):
            same(old.camera, new)
    tree = json.loads((tmp_path / "camera.json").read_text())
    for entry in tree["views"]:
        del entry["opencv"]
    (tmp_path / "camera.json").write_text(json.dumps(tree))
    for old, new in zip(views, read_cameras(tmp_path / "camera.json"), strict=True):
        same(old.camera, new)


def test_a_plain_nerf_file_is_enough(tmp_path: Path) -> None:
    camera = orbit(50, 20, distance=4.0, fov=39.0, size=(800, 800))
    matrix = transforms([camera], ["x"])["frames"][0]["transform_matrix"]
    tree = {"camera_angle_x": np.radians(39.0), "frames": [{"file_path": "./train/r_0", "transform_matrix": matrix}]}
    (tmp_path / "transforms.json").write_text(json.dumps(tree))
    read = read_cameras(tmp_path / "transforms.json", (800, 800))[0]
    same(replace(read, focal=camera.focal), replace(camera, name="r_0"))
    assert read.focal == pytest.approx(camera.focal)


def edited(folder: Path, view: View, colour: tuple[float, float, float], side: int | None = None) -> None:
    height, width = view.camera.size
    picture = np.broadcast_to(np.array(colour, np.float32), (side or height, side or width, 3)).copy()
    write_png(folder / f"{view.camera.name}.png", picture)


def test_an_edited_picture_wins_and_an_untouched_one_does_not(tmp_path: Path, views: list[View]) -> None:
    write_views(tmp_path, views, ())
    edited(tmp_path, views[0], (0.8, 0.2, 0.4))
    first, second = read_views(tmp_path)
    expected = linear_from_srgb(np.array([0.8, 0.2, 0.4], np.float32)) * views[0].coverage[..., None]
    assert np.abs(first.rgb - expected).max() < EIGHT_BITS
    assert np.array_equal(first.depth, views[0].depth) and np.array_equal(first.mask, views[0].mask)
    assert np.array_equal(second.rgb, views[1].rgb)


def test_a_picture_with_alpha_is_a_mask(tmp_path: Path, views: list[View]) -> None:
    write_views(tmp_path, views, ())
    picture = np.full((16, 16, 4), 0.5, np.float32)
    picture[:, :8, 3] = 0
    picture[:, 8:, 3] = 1
    write_png(tmp_path / f"{views[0].camera.name}.png", picture)
    read = read_views(tmp_path)[0]
    assert not read.mask[:, :8].any() and np.array_equal(read.mask[:, 8:], views[0].mask[:, 8:])
    assert not read.rgb[:, :8].any()


def test_a_folder_that_others_made(tmp_path: Path, views: list[View]) -> None:
    camera = views[0].camera
    tree = {"views": [{**camera_entry(camera), "made_by": "someone"}]}
    (tmp_path / "camera.json").write_text(json.dumps(tree))
    with pytest.raises(InputRefused, match="no picture for the view"):
        read_views(tmp_path)
    pixels = np.full((32, 32, 3), 200, np.uint8)
    cv2.imwrite(str(tmp_path / f"{camera.name}.jpg"), pixels)
    view = read_views(tmp_path)[0]
    # Twice the size: the camera follows, so that the same world point stays at the same place of the picture.
    assert view.camera.size == (32, 32) and view.camera.focal == pytest.approx(2 * camera.focal)
    assert view.rgb.shape == (32, 32, 3) and view.mask.all() and np.isinf(view.depth).all() and (view.part == -1).all()
    assert view.rgb.mean() == pytest.approx(float(linear_from_srgb(np.array([200 / 255], np.float32))[0]), abs=0.01)
    edited(tmp_path, views[0], (0, 0, 0))
    with pytest.raises(InputRefused, match="one picture per view"):
        read_views(tmp_path)


def test_a_cropped_picture_is_refused(tmp_path: Path, views: list[View]) -> None:
    write_views(tmp_path, views, ())
    write_png(tmp_path / f"{views[0].camera.name}.png", np.zeros((16, 12, 3), np.float32))
    with pytest.raises(InputRefused, match="12 x 16 pixels.*aspect"):
        read_views(tmp_path)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"fx": 3.0}, "square pixels"),
        ({"fx": -3.0}, "fx"),
        ({"width": 0}, "width"),
        ({"name": "../x"}, "file name"),
        ({"opencv": {"R": [[-1, 0, 0], [0, 1, 0], [0, 0, 1]], "t": [0, 0, 4]}}, "not a rotation"),
        ({"opencv": {"R": [[2, 0, 0], [0, 2, 0], [0, 0, 2]], "t": [0, 0, 4]}}, "not a rotation"),
        ({"opencv": {"R": [[1, 0], [0, 1]], "t": [0, 0, 4]}}, "opencv.R"),
        ({"opencv": None, "opengl": None}, "no pose"),
        ({"exr": "../../secret.exr"}, "inside"),
    ],
)
def test_bad_cameras_are_refused_with_the_reason(tmp_path: Path, views: list[View], change: dict, reason: str) -> None:
    write_views(tmp_path, views[:1], ())
    tree = json.loads((tmp_path / "camera.json").read_text())
    tree["views"][0] |= change
    (tmp_path / "camera.json").write_text(json.dumps(tree))
    with pytest.raises(InputRefused, match=reason):
        read_views(tmp_path)


def test_other_refusals(tmp_path: Path, views: list[View]) -> None:
    with pytest.raises(InputRefused, match="neither camera.json nor transforms.json"):
        read_views(tmp_path)
    twice = {"views": [camera_entry(views[0].camera)] * 2}
    (tmp_path / "camera.json").write_text(json.dumps(twice))
    with pytest.raises(InputRefused, match="two views named"):
        read_entries(tmp_path / "camera.json")
    with pytest.raises(ValueError, match="different names"):
        write_views(tmp_path, [views[0], views[0]], ())
    tree = transforms([views[0].camera], ["./a.png"])
    for change, reason in (({"k1": 0.1}, "distortion"), ({"fl_x": "wide"}, "finite"), ({"w": 10**9}, "pixels")):
        broken = {**tree, "frames": [{**tree["frames"][0], **change}]}
        (tmp_path / "transforms.json").write_text(json.dumps(broken))
        with pytest.raises(InputRefused, match=reason):
            read_cameras(tmp_path / "transforms.json")


def test_lights_json(tmp_path: Path, views: list[View]) -> None:
    rig = (
        Directional((0.6, 0.0, -0.8), (2.0, 1.0, 0.5), "camera"),
        Ambient((1.0, 1.0, 1.0)),
        SphericalGaussian((0.0, 1.0, 0.0), 4.0, (1.0, 0.5, 0.25)),
        SceneLights("studio.xml"),
    )
    write_views(tmp_path, views, rig)
    assert read_lights(tmp_path) == read_lights(tmp_path / "lights.json") == rig
    assert from_json(to_json(lights("phase1"))) == lights("phase1")
    assert [type(light) for light in lights("phase2")] == [Ambient]
    assert lights("studio") == (SceneLights("studio.xml"),)


@pytest.mark.parametrize(
    ("entry", "reason"),
    [
        ({"type": "laser"}, "laser"),
        ({"type": "ambient", "radiance": [1, 1]}, "radiance"),
        ({"type": "ambient", "radiance": [1, -1, 1]}, ">= 0"),
        ({"type": "directional", "direction": [0, 0, 0], "irradiance": [1, 1, 1]}, "length 0"),
        ({"type": "directional", "direction": [0, 0, 1], "irradiance": [1, 1, 1], "frame": "moon"}, "moon"),
        ({"type": "spherical_gaussian", "axis": [0, 1, 0], "sharpness": True, "amplitude": [1, 1, 1]}, "sharpness"),
    ],
)
def test_bad_lights_are_refused_with_the_reason(entry: dict, reason: str) -> None:
    with pytest.raises(InputRefused, match=reason):
        from_json({"lights": [entry]})


@pytest.mark.parametrize(
    ("text", "lit"),
    [
        (None, False),
        ('{"lights": []}', False),
        ('{"lights": [{"type": "ambient", "radiance": [1, 1, 1]}]}', True),
        ('{"views": {"front": [{"type": "ambient", "radiance": [1, 1, 1]}]}}', True),
        ("[3]", False),
        ("torn", False),
    ],
)
def test_a_folder_with_lights_is_lit(text, lit, tmp_path):
    from mistyle.io.cameras.views import is_lit

    if text is not None:
        (tmp_path / "lights.json").write_text(text)
    assert is_lit(tmp_path) == lit
