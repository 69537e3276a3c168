"""References of a fit: every layout gives the same cameras and linear pixels, and what does not fit is named."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from benchmarks.photographs import undistort
from mistyle.core.camera import Camera, orbit, pixel_centres
from mistyle.core.capture import in_memory
from mistyle.core.errors import InputRefused
from mistyle.core.image import linear_from_srgb
from mistyle.core.light import Ambient, Directional, Environment, Point
from mistyle.core.view import View
from mistyle.geometry.lens import Lens, distort, pinhole, px_in_photograph, resample
from mistyle.io.cameras.camera_files import camera_entry, transforms
from mistyle.io.cameras.captures import (
    camera_space,
    check_pixels,
    read_captures,
    read_shots,
    silhouette,
)
from mistyle.io.cameras.reading_notes import matte_note, reading_notes
from mistyle.io.cameras.sparse_points import sparse_points
from mistyle.io.cameras.views import write_views
from mistyle.io.images.write import write_exr, write_png
from mistyle.io.read import read_size

SIZE = (12, 16)
LENS = Lens((80.0, 84.0), (33.0, 22.5), (48, 64), (-0.21, 0.06, -0.01), (0.003, -0.002))


def cameras(count: int = 3) -> list[Camera]:
    ring = [orbit(70.0 * k, 20, distance=4.0, fov=30.0, size=SIZE) for k in range(count)]
    return [replace(camera, name=f"v{k}") for k, camera in enumerate(ring)]


def ours(folder: Path, rng: np.random.Generator) -> list[View]:
    """A folder as `mistyle render` writes it: a disc of the object in the middle, half covered at its border."""
    views = []
    for camera in cameras():
        coverage = np.zeros(SIZE, np.float32)
        coverage[3:9, 4:12] = 1
        coverage[3] = coverage[3] * 0.5
        rgb = (rng.random((*SIZE, 3)) * 3).astype(np.float32) * coverage[..., None]
        nothing = np.zeros((*SIZE, 3), np.float32)
        far = np.full(SIZE, np.inf, np.float32)
        part = np.full(SIZE, -1, np.int32)
        views.append(View(camera, rgb, far, nothing, nothing[..., :2], part, coverage > 0, coverage))
    write_views(folder, views, (Ambient((1.0, 1.0, 1.0)),))
    return views


def nerf(folder: Path, pictures: list[np.ndarray], bits: int = 8, **extra) -> list[Camera]:
    """A transforms.json with encoded pictures as PNG, and lights."""
    chosen = cameras(len(pictures))
    tree = transforms(chosen, [f"./images/{c.name}.png" for c in chosen])
    del tree["space"]
    (folder / "images").mkdir(parents=True)
    (folder / "transforms.json").write_text(json.dumps({**tree, **extra}))
    (folder / "lights.json").write_text('{"lights": [{"type": "ambient", "radiance": [1, 1, 1]}]}')
    for camera, picture in zip(chosen, pictures, strict=True):
        write_png(folder / "images" / f"{camera.name}.png", picture, bits)
    return chosen


def grey(value: float = 0.5, channels: int = 3) -> np.ndarray:
    return np.full((*SIZE, channels), value, np.float32)


def test_our_own_folder(tmp_path, rng):
    views = ours(tmp_path, rng)
    captures = read_captures(tmp_path)
    assert [c.name for c in captures.cameras] == ["v0", "v1", "v2"] and camera_space(tmp_path) == "working"
    assert captures.lights == ((Ambient((1.0, 1.0, 1.0)),),) * 3
    for k, view in enumerate(views):
        rgb, counts = captures.load(k)
        assert np.array_equal(counts, view.coverage == 1)
        assert rgb[counts] == pytest.approx(view.rgb[counts]) and not rgb[~counts].any()
    # Told so, pixels that are covered in part count too, as bright as what covers them.
    rgb, counts = read_captures(tmp_path, coverage=0.4).load(0)
    assert np.array_equal(counts, views[0].coverage > 0)
    assert rgb[3, 4:12] == pytest.approx(views[0].rgb[3, 4:12] / 0.5)


def test_an_edited_picture_wins(tmp_path, rng):
    ours(tmp_path, rng)
    write_png(tmp_path / "v1.png", grey(0.25))
    captures = read_captures(tmp_path)
    rgb, counts = captures.load(1)
    (expected,) = linear_from_srgb(np.array([np.rint(0.25 * 255) / 255]))
    # It has no alpha: that of the EXR beside it still says where the object is.
    assert counts.sum() == 5 * 8 and rgb[counts] == pytest.approx(float(expected))
    assert captures.load(0)[0].max() > 1


@pytest.mark.parametrize("bits", [8, 16])
def test_encoded_pictures_are_linearised_exactly(tmp_path, rng, bits):
    levels = 2**bits - 1
    values = rng.integers(0, levels, (*SIZE, 3))
    nerf(tmp_path, [(values / levels).astype(np.float32)] * 3, bits)
    rgb, counts = read_captures(tmp_path).load(2)
    encoded = values / levels
    linear = np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)
    assert counts.all() and rgb == pytest.approx(linear, rel=2e-6, abs=1e-7)


@pytest.mark.parametrize("bits", [8, 16])
def test_saturated_pixels_do_not_count(tmp_path, bits):
    picture = grey(0.9)
    picture[2, 3, 1] = 1.0
    nerf(tmp_path, [picture] * 3, bits)
    counts = read_captures(tmp_path).load(0)[1]
    assert not counts[2, 3] and counts.sum() == counts.size - 1
    with pytest.raises(InputRefused, match="3 without a valid pixel, of 3"):
        check_pixels(read_captures(tmp_path, saturation=0.85))


def test_alpha_is_a_mask(tmp_path):
    picture = grey(0.5, 4)
    picture[..., 3] = 1
    picture[:4, :, 3], picture[4, :, 3] = 0, 0.5
    nerf(tmp_path, [picture] * 3)
    rgb, counts = read_captures(tmp_path).load(0)
    assert not counts[:5].any() and counts[5:].all() and not rgb[:5].any()
    # Straight alpha: half-covered pixels are as bright as whole ones.
    rgb, counts = read_captures(tmp_path, coverage=0.4).load(0)
    assert counts[4].all() and rgb[4] == pytest.approx(rgb[5])
    assert np.array_equal(silhouette(read_shots(tmp_path)[0]), picture[..., 3] >= 0.5)


@pytest.mark.parametrize(("inside", "border", "counted"), [(254, 240, 7), (253, 250, 8), (255, 250, 7), (200, 200, 0)])
def test_mattes_that_never_reach_one(tmp_path, inside, border, counted):
    """Background removers write 254 of 255 inside: such pixels count; rendered alphas and translucency stay strict."""
    picture = grey(0.5, 4)
    picture[..., 3] = np.float32(inside) / 255
    picture[:4, :, 3], picture[4, :, 3] = 0, np.float32(border) / 255
    nerf(tmp_path, [picture] * 3)
    counts = read_captures(tmp_path).load(0)[1]
    assert counts.any(axis=1).sum() == counted and not counts[:4].any()
    inner: list[float] = []
    silhouette(read_shots(tmp_path)[0], inner.append)
    assert inner == [pytest.approx(inside / 255, abs=1e-6)]
    notes = matte_note(inner)
    assert len(notes) == (250 < inside < 255) and all("background removers" in note for note in notes)


def test_masks_by_view_or_by_picture(tmp_path):
    nerf(tmp_path / "a", [grey()] * 3)
    for folder, names in (("view", ["v0.png", "v1.png", "v2.png"]), ("file", [f"v{k}.png.png" for k in range(3)])):
        (tmp_path / folder).mkdir()
        for name in names:
            mask = np.zeros(SIZE, np.float32)
            mask[:, :5] = 1
            write_png(tmp_path / folder / name, mask)
        counts = read_captures(tmp_path / "a", masks=tmp_path / folder).load(1)[1]
        assert counts[:, :5].all() and not counts[:, 5:].any()
        assert np.array_equal(silhouette(read_shots(tmp_path / "a", masks=tmp_path / folder)[1]), counts)
    (tmp_path / "nested").mkdir()
    (tmp_path / "file").rename(tmp_path / "nested" / "images")
    assert not read_captures(tmp_path / "a", masks=tmp_path / "nested").load(1)[1][:, 5:].any()
    (tmp_path / "view" / "v1.png").unlink()
    with pytest.raises(InputRefused, match="no mask for the view 'v1'"):
        read_captures(tmp_path / "a", masks=tmp_path / "view")
    write_png(tmp_path / "view" / "v1.png", np.zeros((5, 5), np.float32))
    with pytest.raises(InputRefused, match="5 x 5 pixels; expected 16 x 12"):
        read_captures(tmp_path / "a", masks=tmp_path / "view")
    with pytest.raises(InputRefused, match="neither an alpha channel nor a mask"):
        silhouette(read_shots(tmp_path / "a")[0])


def test_exposures(tmp_path):
    nerf(tmp_path, [grey()] * 3)
    plain = read_captures(tmp_path).load(0)[0]
    (tmp_path / "ev.json").write_text('{"v0": 1.5, "v1": -1, "v2": 0}')
    captures = read_captures(tmp_path, exposure=tmp_path / "ev.json")
    for k, stops in enumerate((1.5, -1, 0)):
        assert captures.load(k)[0] == pytest.approx(plain / 2**stops)
    (tmp_path / "f.json").write_text('{"factor": {"v0": 4, "v1": 0.5, "v2": 1}}')
    assert read_captures(tmp_path, exposure=tmp_path / "f.json").load(0)[0] == pytest.approx(plain / 4)
    for table, reason in (
        ({"v0": 1}, "for the view './images/v1.png'"),
        ({"factor": {"v0": 0, "v1": 1, "v2": 1}}, "factor > 0"),
    ):
        (tmp_path / "bad.json").write_text(json.dumps(table))
        with pytest.raises(InputRefused, match=reason):
            read_captures(tmp_path, exposure=tmp_path / "bad.json")


def test_lights_of_every_kind_beside_or_elsewhere(tmp_path):
    nerf(tmp_path, [grey()] * 3)
    assert camera_space(tmp_path) == "own" and sparse_points(tmp_path) is None
    sky = np.random.default_rng(0).random((4, 8, 3)).astype(np.float32)
    (tmp_path / "rig").mkdir()
    write_exr(tmp_path / "rig" / "sky.exr", dict(zip("RGB", np.moveaxis(sky, -1, 0), strict=True)))
    flash = {"type": "point", "position": [0, 0, 0], "intensity": [5, 5, 5], "frame": "camera"}
    tree = {"lights": [{"type": "environment", "file": "sky.exr", "turn": 20}], "views": {"v1": [flash]}}
    (tmp_path / "rig" / "night.json").write_text(json.dumps(tree))
    first, second, third = read_captures(tmp_path, lights=tmp_path / "rig" / "night.json").lights
    assert second == (Point((0.0, 0.0, 0.0), (5.0, 5.0, 5.0), "camera"),)
    for (light,) in (first, third):
        assert isinstance(light, Environment) and light.turn == 20 and np.array_equal(light.radiance, sky)
    assert read_captures(tmp_path, lights="unknown").lights == ((), (), ())
    tree["lights"][0]["file"] = "../lights.json"
    (tmp_path / "rig" / "night.json").write_text(json.dumps(tree))
    with pytest.raises(InputRefused, match="inside"):
        read_captures(tmp_path, lights=tmp_path / "rig" / "night.json")
    (tmp_path / "lights.json").unlink()
    with pytest.raises(InputRefused, match='the light of each picture.*"views": {"./images/v0.png": .*directional'):
        read_captures(tmp_path)
    (tmp_path / "lights.json").write_text(json.dumps({"views": {"v0": [flash]}}))
    with pytest.raises(InputRefused, match="no lights for the view './images/v1.png' .2 of 3"):
        read_captures(tmp_path)


def test_pictures_are_loaded_one_at_a_time(tmp_path, monkeypatch):
    import mistyle.io.cameras.captures as module

    nerf(tmp_path, [grey(0.1), grey(0.2), grey(0.3)])
    read: list[str] = []
    real = module.read_stored_pixels
    monkeypatch.setattr(module, "read_stored_pixels", lambda path, pixels: read.append(path.name) or real(path, pixels))
    captures = read_captures(tmp_path)
    assert read == []
    captures.load(1), captures.load(1), captures.load(2)
    assert read == ["v1.png", "v2.png"]
    with pytest.raises(ValueError, match="read-only"):
        captures.load(1)[0][:] = 0


def test_missing_and_misfitting_pictures_are_refused(tmp_path):
    nerf(tmp_path, [grey()] * 3)
    write_png(tmp_path / "images" / "v1.png", np.zeros((24, 32, 3), np.float32))
    with pytest.raises(InputRefused, match="v1.png: found 32 x 24 pixels; expected 16 x 12"):
        read_captures(tmp_path)
    (tmp_path / "images" / "v1.png").unlink()
    shots = read_shots(tmp_path)
    assert [shot.camera.name for shot in shots] == ["v0", "v2"]
    assert reading_notes(tmp_path, shots) == ("1 of 3 views of transforms.json have no picture and were left out.",)
    (tmp_path / "images" / "v2.png").unlink()
    with pytest.raises(InputRefused, match="no picture './images/v1.png'"):
        read_captures(tmp_path)
    (tmp_path / "empty").mkdir()
    for place, reason in (("empty", "COLMAP"), ("nowhere", "found nothing"), ("images/v0.png", "ending in '.png'")):
        with pytest.raises(InputRefused, match=reason):
            read_captures(tmp_path / place)
    tree = json.loads((tmp_path / "transforms.json").read_text())
    for file in ("../secret.png", "/etc/passwd", "http://x/y.png"):
        tree["frames"][0]["file_path"] = file
        (tmp_path / "transforms.json").write_text(json.dumps(tree))
        with pytest.raises(InputRefused, match="inside|relative"):
            read_captures(tmp_path)


def test_black_and_empty_pictures_are_named():
    chosen = cameras()
    black = np.zeros((*SIZE, 3), np.float32)
    good = black + 0.5
    lights = [(Ambient((1.0, 1.0, 1.0)),)] * 3
    nothing = np.zeros(SIZE, bool)
    notes = check_pixels(in_memory(chosen, lights, [black, good, good], [~nothing, ~nothing, nothing]))
    assert (
        notes[0].startswith("v0: all valid pixels are black")
        and notes[1].startswith("v2: no valid pixel")
        and len(notes) == 2
    )
    assert "fewer than 3" in check_pixels(in_memory(chosen[:2], lights[:2], [good, good]))[0]
    with pytest.raises(InputRefused, match="3 pictures that are black and 0 without"):
        check_pixels(in_memory(chosen, lights, [black] * 3))


def test_blender_folders(tmp_path):
    """As NeRF's synthetic scenes: no endings, no size, a field of view, `transforms_train.json`."""
    chosen = nerf(tmp_path, [grey()] * 3)
    tree = json.loads((tmp_path / "transforms.json").read_text())
    frames = [
        {"file_path": f["file_path"].removesuffix(".png"), "rotation": 0.1, "transform_matrix": f["transform_matrix"]}
        for f in tree["frames"]
    ]
    (tmp_path / "transforms.json").unlink()
    blender = {"camera_angle_x": np.radians(30.0), "frames": frames}
    (tmp_path / "transforms_train.json").write_text(json.dumps(blender))
    for path in (tmp_path, tmp_path / "transforms_train.json"):
        captures = read_captures(path)
        for old, new in zip(chosen, captures.cameras, strict=True):
            assert (new.size, new.name) == (SIZE, old.name) and new.focal == pytest.approx(old.focal)
            assert np.abs(new.world_from_cam - old.world_from_cam).max() < 1e-12


def two_folders(place):
    """A capture of two pictures of one name, each in a folder of its own."""
    nerf(place, [grey(0.25), grey(0.75)])
    tree = json.loads((place / "transforms.json").read_text())
    for k, frame in enumerate(tree["frames"]):
        frame["file_path"] = f"cam{k}/0001.png"
        (place / f"cam{k}").mkdir()
        (place / "images" / f"v{k}.png").rename(place / f"cam{k}" / "0001.png")
    (place / "transforms.json").write_text(json.dumps(tree))


def test_pictures_of_one_name_in_several_folders(tmp_path):
    two_folders(tmp_path)
    captures = read_captures(tmp_path)
    assert [c.name for c in captures.cameras] == ["cam0_0001", "cam1_0001"]
    assert captures.load(0)[0].mean() < captures.load(1)[0].mean()


@pytest.mark.parametrize(
    "spelling", ["cam{}/0001.png", "cam{}/0001", "./cam{}/0001.png", "cam{}\\0001.PNG", "cam{}_0001"]
)
def test_lights_and_exposures_by_the_camera_files_names(tmp_path, spelling):
    two_folders(tmp_path)
    rigs = [[{"type": "ambient", "radiance": [k + 1.0] * 3}] for k in range(2)]
    lights = tmp_path / "lights.json"
    lights.write_text(json.dumps({"lights": [], "views": {spelling.format(k): rigs[k] for k in range(2)}}))
    captures = read_captures(tmp_path, exposure={spelling.format(k): float(k) for k in range(2)})
    assert [rig[0].radiance[0] for rig in captures.lights] == [1.0, 2.0]
    plain = read_captures(tmp_path)
    assert captures.load(1)[0] == pytest.approx(plain.load(1)[0] / 2)
    lights.write_text(json.dumps({"lights": [], "views": {"0001": rigs[0]}}))
    with pytest.raises(InputRefused, match="names '0001', which is not one of the 2 views .'cam0/0001.png'"):
        read_captures(tmp_path)
    lights.write_text(json.dumps({"views": {spelling.format(0): rigs[0]}}))
    with pytest.raises(InputRefused, match="no lights for the view 'cam1/0001.png'"):
        read_captures(tmp_path)
    lights.write_text(json.dumps({"views": {spelling.format(0): rigs[0], "cam0/0001.jpg": rigs[1]}}))
    with pytest.raises(InputRefused, match="'cam0/0001.jpg' for the view 'cam0/0001.png'"):
        read_captures(tmp_path)


def test_the_lens_is_opencvs(rng):
    """Against an independent implementation."""
    tangents = rng.uniform(-0.35, 0.35, (200, 2))
    coefficients = np.array([*LENS.radial[:2], *LENS.tangential, LENS.radial[2]])
    matrix = np.array([[80.0, 0, 33.0], [0, 84.0, 22.5], [0, 0, 1]])
    points = np.concatenate([tangents, np.ones((200, 1))], axis=1)
    theirs, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix, coefficients)
    ours_px = distort(LENS, tangents) * LENS.focal + LENS.centre
    assert ours_px == pytest.approx(theirs[:, 0], abs=1e-9)
    assert undistort(LENS, distort(LENS, tangents)) == pytest.approx(tangents, abs=1e-8)


def test_beyond_its_reach_a_lens_sees_nothing():
    lens = Lens((100.0, 100.0), (50.0, 50.0), (100, 100), (-0.5, 0.0, 0.0))
    # r (1 - r²/2) rises until r² = 2/3.
    assert np.isfinite(distort(lens, np.array([0.81, 0.0]))).all()
    assert np.isnan(distort(lens, np.array([0.82, 0.0]))).all()
    assert np.isnan(undistort(lens, np.array([0.6, 0.0]))).all()


def scene(tangents: np.ndarray) -> np.ndarray:
    """Smooth colours 0.2..0.8 by direction in the camera."""
    waves = np.array([[9.0, 4.0], [-5.0, 8.0], [3.0, -10.0]])
    return 0.5 + 0.3 * np.sin(tangents @ waves.T)


def photograph(lens: Lens) -> np.ndarray:
    tangents = undistort(lens, (pixel_centres(lens.size) - np.asarray(lens.centre)) / np.asarray(lens.focal))
    assert np.isfinite(tangents).all()
    return scene(tangents).astype(np.float32)


def test_a_photograph_becomes_a_pinhole_picture():
    focal, centre, size = pinhole(LENS)
    assert focal == 84.0 and centre == pytest.approx((33 * 84 / 80, 22.5)) and size == (48, 67)
    counts = np.ones(LENS.size, bool)
    counts[10, 10] = False
    picture, whole = resample(LENS, photograph(LENS), counts)
    expected = scene((pixel_centres(size) - np.asarray(centre)) / focal)
    # Bilinear: the waves' second derivative, 0.3 · 10² / 84² per pixel², over 8 and twice (two axes).
    assert whole.mean() > 0.9 and np.abs(picture - expected)[whole].max() < 2 * 0.3 * 116 / 80**2 / 8
    hole = ~whole & ~np.isnan(px_in_photograph(LENS, pixel_centres(size))).any(axis=-1)
    assert 4 <= hole[5:20, 5:20].sum() <= 12  # what is mixed from the one pixel that does not count


def test_a_distorted_transforms_json(tmp_path):
    fields = dict(zip(("k1", "k2", "k3"), LENS.radial, strict=True)) | dict(
        zip(("p1", "p2"), LENS.tangential, strict=True)
    )
    fields |= {"fl_x": 80.0, "fl_y": 84.0, "cx": 33.0, "cy": 22.5, "w": 64, "h": 48, "camera_model": "OPENCV"}
    camera = cameras(1)[0]
    frame = {"file_path": "a.png", "transform_matrix": transforms([camera], [""])["frames"][0]["transform_matrix"]}
    (tmp_path / "transforms.json").write_text(json.dumps({**fields, "frames": [frame]}))
    write_png(tmp_path / "a.png", photograph(LENS), 16)
    captures = read_captures(tmp_path, lights="unknown")
    seen = captures.cameras[0]
    assert seen.size == (48, 67) and seen.focal == 84.0
    rgb, counts = captures.load(0)
    encoded = scene((pixel_centres(seen.size) - np.asarray(seen.centre)) / seen.focal)
    # The picture is linearised before it is resampled.
    assert counts.mean() > 0.9 and np.abs(rgb - linear_from_srgb(encoded))[counts].max() < 0.01
    (tmp_path / "transforms.json").write_text(json.dumps({**fields, "k4": 0.1, "frames": [frame]}))
    assert read_shots(tmp_path)[0].lens.k4 == 0.1
    for change in ({"camera_model": "OPENCV_FISHEYE"}, {"is_fisheye": True, "k4": 0.1}):
        (tmp_path / "transforms.json").write_text(json.dumps({**fields, **change, "frames": [frame]}))
        with pytest.raises(InputRefused, match="PINHOLE or OPENCV"):
            read_captures(tmp_path, lights="unknown")


def test_masks_that_a_transforms_json_names(tmp_path):
    nerf(tmp_path, [grey()])
    tree = json.loads((tmp_path / "transforms.json").read_text())
    tree["frames"][0]["mask_path"] = "masks/one.png"
    (tmp_path / "masks").mkdir()
    mask = np.zeros(SIZE, np.float32)
    mask[6:] = 1
    write_png(tmp_path / "masks" / "one.png", mask)
    (tmp_path / "transforms.json").write_text(json.dumps(tree))
    assert np.array_equal(read_captures(tmp_path).load(0)[1], mask > 0)


def test_sizes_come_from_headers(tmp_path):
    write_exr(tmp_path / "a.exr", {"R": np.zeros((3, 7), np.float32)})
    write_png(tmp_path / "a.png", np.zeros((4, 9, 3), np.float32))
    assert read_size(tmp_path / "a.exr") == (3, 7) and read_size(tmp_path / "a.png") == (4, 9)
    from PIL import Image

    turned = Image.Exif()
    turned[0x0112] = 6
    Image.new("RGB", (9, 4)).save(tmp_path / "t.jpg", exif=turned)
    assert read_size(tmp_path / "t.jpg") == (9, 4)
    for name in ("b.exr", "b.png"):
        (tmp_path / name).write_bytes(b"nothing of the kind")
        with pytest.raises(InputRefused, match=name):
            read_size(tmp_path / name)


def test_a_camera_json_by_its_file_and_its_refusals(tmp_path):
    camera = cameras(1)[0]
    (tmp_path / "camera.json").write_text(json.dumps({"views": [camera_entry(camera)]}))
    with pytest.raises(InputRefused, match="no picture for the view 'v0'"):
        read_captures(tmp_path / "camera.json", lights="unknown")
    write_png(tmp_path / "v0.png", grey())
    (tmp_path / "lights.json").write_text(
        '{"lights": [{"type": "directional", "direction": [0, 0, 2], "irradiance": [1, 1, 1]}]}'
    )
    captures = read_captures(tmp_path / "camera.json")
    assert captures.lights == ((Directional((0.0, 0.0, 1.0), (1.0, 1.0, 1.0)),),) and captures.load(0)[1].all()
    write_exr(tmp_path / "v0.exr", {"Y": np.zeros(SIZE, np.float32)})
    (tmp_path / "v0.png").unlink()
    with pytest.raises(InputRefused, match="channels Y; expected R, G and B"):
        read_captures(tmp_path / "camera.json").load(0)
