"""Published data sets by their folder layouts, on tiny folders: poses, pixels, lights and truth arrive."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from benchmarks.material_recovery.dataset_readers import read_stanford_orb, read_tensoir
from mistyle.core.camera import OPENGL_FROM_OPENCV, Camera, orbit, pixel_centres, px_from_world
from mistyle.core.capture import in_memory, shrunk
from mistyle.core.errors import InputRefused
from mistyle.core.image import linear_from_srgb
from mistyle.core.light import Environment, environment_radiance
from mistyle.io.images.write import write_exr, write_png
from mistyle.io.read import read_npy

SIZE = (8, 8)


def cameras(count: int, first: float = 0.0) -> list[Camera]:
    """About an object whose Z is up, as Blender has it."""
    z_up = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
    ring = [orbit(first + 50.0 * k, 25, distance=4.0, fov=30.0, size=SIZE) for k in range(count)]
    return [Camera(z_up @ c.world_from_cam, c.focal, c.centre, c.size) for c in ring]


def exr(path: Path, rgb: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    write_exr(path, dict(zip("RGB", np.moveaxis(rgb.astype(np.float32), -1, 0), strict=True)))


def png(path: Path, values: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    write_png(path, values.astype(np.float32))


def frame(camera: Camera, file: str, **more) -> dict:
    return {"file_path": file, "transform_matrix": (camera.world_from_cam @ OPENGL_FROM_OPENCV).tolist(), **more}


def sky(towards: np.ndarray) -> np.ndarray:
    """Smooth radiance > 0 by direction."""
    return 2 + towards @ np.array([[1.0, 0.2, -0.3], [0.1, -0.9, 0.4], [-0.4, 0.3, 0.8]])


def orb_map(camera: Camera, height: int = 64) -> np.ndarray:
    """The sky as Stanford-ORB stores it: latitude-longitude in the camera's OpenGL axes, up +Y, the left edge +Z
    (behind the camera), the middle -Z, a quarter to the right of it +X."""
    theta = np.linspace(0, np.pi, height)[:, None]
    phi = (np.arange(2 * height) + 0.5) / (2 * height) * 2 * np.pi - np.pi
    local = np.stack(np.broadcast_arrays(np.sin(phi) * np.sin(theta), np.cos(theta), -np.cos(phi) * np.sin(theta)), -1)
    return sky(local @ (camera.world_from_cam @ OPENGL_FROM_OPENCV)[:3, :3].T)


MASK = np.zeros(SIZE, np.float32)
MASK[2:7, 1:6] = 1


@pytest.fixture
def orb(tmp_path, rng) -> Path:
    """Two scenes with one object, two pictures a split; the second's test pictures are novel to the first."""
    for scene, start in (("baking_scene001", 0.0), ("baking_scene002", 120.0)):
        home, truth = tmp_path / "blender_HDR" / scene, tmp_path / "ground_truth" / scene
        poses = cameras(4, start)
        for split, chosen in (("train", poses[:2]), ("test", poses[2:])):
            frames = [frame(c, f"{split}/{k + 1:04d}") for k, c in enumerate(chosen)]
            angle = 2 * np.arctan(SIZE[1] / 2 / chosen[0].focal)
            home.mkdir(parents=True, exist_ok=True)
            (home / f"transforms_{split}.json").write_text(json.dumps({"camera_angle_x": angle, "frames": frames}))
            for k, camera in enumerate(chosen):
                exr(home / split / f"{k + 1:04d}.exr", np.full((*SIZE, 3), 0.1 * (k + 1) + start))
                png(home / f"{split}_mask" / f"{k + 1:04d}.png", MASK)
                if split == "test":
                    exr(truth / "env_map" / f"{k + 1:04d}.exr", orb_map(camera))
    novel = [
        frame(c, f"test/{k + 1:04d}", scene_name="baking_scene002", camera_angle_x=0.3 + 0.1 * k)
        for k, c in enumerate(cameras(4, 120.0)[2:])
    ]
    (tmp_path / "blender_HDR" / "baking_scene001" / "transforms_novel.json").write_text(json.dumps({"frames": novel}))
    return tmp_path


def test_stanford_orb(orb):
    for split, poses in (("train", cameras(2)), ("test", cameras(4)[2:])):
        found = read_stanford_orb(orb, "baking_scene001", split)
        assert found.mesh is None and len(found.captures) == 2
        for k, (old, new) in enumerate(zip(poses, found.captures.cameras, strict=True)):
            assert new.world_from_cam == pytest.approx(old.world_from_cam) and new.focal == pytest.approx(old.focal)
            assert (new.size, new.name) == (SIZE, f"{k + 1:04d}")
            rgb, counts = found.captures.load(k)
            assert np.array_equal(counts, MASK > 0) and rgb[counts] == pytest.approx(0.1 * (k + 1))


def test_stanford_orbs_lights_stand_in_the_world(orb, rng):
    directions = rng.normal(size=(200, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    for split in ("train", "test"):
        for rig in read_stanford_orb(orb, "baking_scene001", split, light_of=1).captures.lights:
            (light,) = rig
            assert isinstance(light, Environment)
            # Twice bilinear at 2.8 degrees; the sky's second derivative is at most about 1.
            assert np.abs(environment_radiance(light, directions) - sky(directions)).max() < 0.005


def test_stanford_orbs_novel_pictures_come_from_their_own_scene(orb, rng):
    found = read_stanford_orb(orb, "baking_scene001", "novel")
    assert [c.name for c in found.captures.cameras] == ["baking_scene002_0001", "baking_scene002_0002"]
    up = np.array([0.6, 0.0, 0.8])
    for k, camera in enumerate(found.captures.cameras):
        assert camera.focal == pytest.approx(SIZE[1] / 2 / np.tan((0.3 + 0.1 * k) / 2))
        rgb, counts = found.captures.load(k)
        assert rgb[counts] == pytest.approx(0.1 * (k + 1) + 120)
        (light,) = found.captures.lights[k]
        assert isinstance(light, Environment)
        assert environment_radiance(light, up) == pytest.approx(sky(up), abs=0.005)
    path = orb / "blender_HDR" / "baking_scene001" / "transforms_novel.json"
    tree = json.loads(path.read_text())
    tree["frames"][0]["scene_name"] = "../baking_scene002"
    path.write_text(json.dumps(tree))
    with pytest.raises(InputRefused, match="scene_name = '../baking_scene002' in frame 0"):
        read_stanford_orb(orb, "baking_scene001", "novel")


def test_stanford_orbs_truth(orb, rng):
    truth = orb / "ground_truth" / "baking_scene001"
    assert read_stanford_orb(orb, "baking_scene001", "test").truth(0).normal is None
    camera = cameras(4)[2]
    world = rng.normal(size=(*SIZE, 3))
    world /= np.linalg.norm(world, axis=-1, keepdims=True)
    local = world @ (camera.world_from_cam @ OPENGL_FROM_OPENCV)[:3, :3]
    depth = np.where(MASK > 0, 3.5, -1).astype(np.float32)
    for folder, values in (("surface_normal", local), ("z_depth", depth[..., None])):
        (truth / folder).mkdir(parents=True)
        np.save(truth / folder / "0001.npy", values)
    png(truth / "pseudo_gt_albedo" / "0001.png", np.full((*SIZE, 3), 0.5))
    (truth / "mesh_blender").mkdir()
    (truth / "mesh_blender" / "mesh.obj").write_text("v 0 0 0\n")
    found = read_stanford_orb(orb, "baking_scene001", "test")
    known = found.truth(0)
    assert found.mesh == truth / "mesh_blender" / "mesh.obj" and np.array_equal(known.mask, MASK > 0)
    assert known.normal is not None and known.depth is not None and known.albedo is not None
    assert (
        known.normal[known.mask] == pytest.approx(world[known.mask], abs=1e-6) and not known.normal[~known.mask].any()
    )
    assert (known.depth[known.mask] == 3.5).all() and np.isinf(known.depth[~known.mask]).all()
    assert known.albedo == pytest.approx(float(linear_from_srgb(np.array([128 / 255]))[0]), abs=1e-6)
    np.save(truth / "surface_normal" / "0001.npy", np.zeros((3, 3, 3)))
    with pytest.raises(InputRefused, match=r"an array of \(3, 3, 3\)"):
        found.truth(0)


def test_stanford_orbs_low_dynamic_range(orb):
    for k in range(2):
        picture = np.full((*SIZE, 3), 0.5)
        picture[4, 4] = 1
        png(orb / "blender_LDR" / "baking_scene001" / "train" / f"{k + 1:04d}.png", picture)
        png(orb / "blender_LDR" / "baking_scene001" / "train_mask" / f"{k + 1:04d}.png", MASK)
    file = "transforms_train.json"
    source = orb / "blender_HDR" / "baking_scene001" / file
    (orb / "blender_LDR" / "baking_scene001" / file).write_text(source.read_text())
    captures = read_stanford_orb(orb, "baking_scene001", "train", hdr=False).captures
    counts = captures.load(0)[1]
    assert counts.sum() == MASK.sum() - 1 and not counts[4, 4] and captures.lights == ((), ())
    png(orb / "blender_LDR" / "baking_scene001" / "train_mask" / "0002.png", np.zeros((4, 4)))
    with pytest.raises(InputRefused, match="4 x 4 pixels; expected 8 x 8"):
        read_stanford_orb(orb, "baking_scene001", "train", hdr=False)


@pytest.fixture
def tensoir(tmp_path) -> Path:
    for split in ("train", "test"):
        for k, camera in enumerate(cameras(3)):
            place = tmp_path / "lego" / f"{split}_{k:03d}"
            matrix = (camera.world_from_cam @ OPENGL_FROM_OPENCV).ravel()
            meta = {
                "imw": SIZE[1],
                "imh": SIZE[0],
                "cam_angle_x": 2 * np.arctan(SIZE[1] / 2 / camera.focal),
                "cam_transform_mat": ",".join(map(str, matrix.tolist())),
                "envmap": "sunset",
            }
            place.mkdir(parents=True)
            (place / "metadata.json").write_text(json.dumps(meta))
            rgba = np.full((*SIZE, 4), 0.25 * (k + 1))
            rgba[..., 3] = MASK
            png(place / "rgba_sunset.png", rgba)
            png(place / "albedo.png", np.concatenate([np.full((*SIZE, 3), 0.6), MASK[..., None]], axis=2))
            normal = np.broadcast_to(np.array([0.6, 0, 0.8]) / 2 + 0.5, (*SIZE, 3))
            png(place / "normal.png", np.concatenate([normal, MASK[..., None]], axis=2))
    return tmp_path


def test_tensoir(tensoir, rng):
    height = 64
    maps = tensoir / "maps"
    maps.mkdir()
    # Blender's world: the middle looks along +X, columns to the right of it towards -Y, rows from +Z down.
    latitude = (0.5 - (np.arange(height) + 0.5) / height)[:, None] * np.pi
    angle = np.pi - (np.arange(2 * height) + 0.5) / (2 * height) * 2 * np.pi
    towards = np.stack(
        np.broadcast_arrays(np.cos(angle) * np.cos(latitude), np.sin(angle) * np.cos(latitude), np.sin(latitude)), -1
    )
    cv2.imwrite(str(maps / "sunset.hdr"), sky(towards).astype(np.float32)[..., ::-1])
    found = read_tensoir(tensoir / "lego", "test", maps=maps)
    assert [c.name for c in found.captures.cameras] == ["test_000", "test_001", "test_002"] and found.mesh is None
    directions = rng.normal(size=(200, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    (light,) = found.captures.lights[1]
    assert isinstance(light, Environment)
    # RGBE keeps 8 bits of the largest channel.
    assert np.abs(environment_radiance(light, directions) - sky(directions)).max() < 4 / 256 + 0.005
    for k, (old, new) in enumerate(zip(cameras(3), found.captures.cameras, strict=True)):
        px, _ = px_from_world(new, np.zeros((1, 3)))
        assert px[0] == pytest.approx([4, 4]) and new.world_from_cam == pytest.approx(old.world_from_cam)
        rgb, counts = found.captures.load(k)
        encoded = np.rint(np.array([0.25 * (k + 1)]) * 255) / 255
        if k < 3 and encoded[0] < 1:
            assert np.array_equal(counts, MASK > 0)
            assert rgb[counts] == pytest.approx(float(linear_from_srgb(encoded)[0]), rel=1e-5)
    known = found.truth(0)
    assert known.albedo is not None and known.normal is not None and known.depth is None
    assert known.albedo[known.mask] == pytest.approx(0.6, abs=1e-6)
    assert known.normal[known.mask] == pytest.approx(np.array([[0.6, 0, 0.8]] * int(MASK.sum())), abs=0.008)
    assert not known.normal[~known.mask].any() and np.array_equal(known.mask, MASK > 0)


def test_tensoir_refusals(tensoir):
    assert read_tensoir(tensoir / "lego").captures.lights == ((), (), ())
    for call, reason in (
        (lambda: read_tensoir(tensoir), "no folders train_000"),
        (lambda: read_tensoir(tensoir / "lego", light="city"), "rgba_city.png"),
        (lambda: read_tensoir(tensoir / "lego", maps=tensoir), "no sunset.hdr"),
    ):
        with pytest.raises(InputRefused, match=reason):
            call()
    meta = tensoir / "lego" / "train_001" / "metadata.json"
    whole = json.loads(meta.read_text())
    for change, reason in (
        ({"imw": 0}, "imw"),
        ({"cam_transform_mat": "1,2,3"}, "reshape"),
        ({"cam_transform_mat": ",".join(["1"] * 16)}, "not a rotation"),
        ({"cam_angle_x": 4}, "cam_angle_x"),
    ):
        meta.write_text(json.dumps(whole | change))
        with pytest.raises(InputRefused, match=reason):
            read_tensoir(tensoir / "lego")


def test_shrunk_pictures_see_the_same(rng):
    camera = orbit(30, 10, distance=4.0, fov=30.0, size=(10, 13))
    picture, counts = rng.random((10, 13, 3)).astype(np.float32), np.ones((10, 13), bool)
    counts[4, 4] = False
    small = shrunk(in_memory([camera], [()], [picture], [counts]), [3])
    rgb, left = small.load(0)
    assert small.cameras[0].size == (3, 4) == left.shape
    assert rgb[2, 3] == pytest.approx(picture[6:9, 9:12].mean(axis=(0, 1)), rel=1e-5)
    assert not left[1, 1] and left.sum() == 11
    points = rng.normal(size=(5, 3)) * 0.3
    assert px_from_world(small.cameras[0], points)[0] * 3 == pytest.approx(px_from_world(camera, points)[0])
    assert pixel_centres((3, 4)).shape == (3, 4, 2)


def test_arrays_of_strangers(tmp_path):
    np.save(tmp_path / "a.npy", np.arange(6.0).reshape(2, 3))
    assert read_npy(tmp_path / "a.npy").shape == (2, 3)
    np.save(tmp_path / "o.npy", np.array([{"a": 1}], object), allow_pickle=True)
    np.save(tmp_path / "s.npy", np.array(["text"]))
    (tmp_path / "t.npy").write_bytes((tmp_path / "a.npy").read_bytes()[:-9])
    (tmp_path / "e.npy").write_bytes(b"")
    for name in ("o", "s", "t", "e"):
        with pytest.raises(InputRefused, match=f"{name}.npy"):
            read_npy(tmp_path / f"{name}.npy")
