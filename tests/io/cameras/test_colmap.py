"""COLMAP models: text and binary give the same, projections agree with COLMAP's own formulas, damage is named."""

import struct
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.photographs import undistort
from mistyle.core.camera import Camera, pixel_centres, px_from_world
from mistyle.core.errors import InputRefused
from mistyle.core.image import srgb_from_linear
from mistyle.geometry.lens import distort
from mistyle.io.cameras.captures import camera_space, read_captures, read_shots
from mistyle.io.cameras.colmap import find_model, read_model, read_points
from mistyle.io.cameras.reading_notes import reading_notes
from mistyle.io.cameras.sparse_points import sparse_points
from mistyle.io.images.write import write_png

# By COLMAP's documentation: number, name, parameters for a picture of 64 x 48.
KINDS = (
    (0, "SIMPLE_PINHOLE", (90.0, 31.5, 23.0)),
    (1, "PINHOLE", (90.0, 92.0, 31.5, 23.0)),
    (2, "SIMPLE_RADIAL", (90.0, 31.5, 23.0, -0.1)),
    (3, "RADIAL", (90.0, 31.5, 23.0, -0.1, 0.02)),
    (4, "OPENCV", (90.0, 92.0, 31.5, 23.0, -0.1, 0.02, 0.003, -0.001)),
)


@dataclass
class Model:
    """What the two writers below write: cameras by number, images (pose, camera, name, observations), points."""

    cameras: dict[int, tuple[int, str, tuple[float, ...]]] = field(default_factory=dict)
    images: list[tuple[np.ndarray, np.ndarray, int, str, int]] = field(default_factory=list)
    points: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))
    size: tuple[int, int] = (64, 48)


def model(rng: np.random.Generator) -> Model:
    made = Model({k + 1: kind for k, kind in enumerate(KINDS)}, points=rng.normal(size=(7, 3)))
    for k in range(len(KINDS)):
        quaternion = np.roll(Rotation.random(random_state=k).as_quat(), 1)  # w first
        made.images.append((quaternion, rng.normal(size=3) + [0, 0, 5], k + 1, f"set a/{k}.png", k % 3))
    return made


def write_bin(folder: Path, made: Model) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    data = struct.pack("<Q", len(made.cameras))
    for number, (kind, _, values) in made.cameras.items():
        data += struct.pack("<iiQQ", number, kind, *made.size) + struct.pack(f"<{len(values)}d", *values)
    (folder / "cameras.bin").write_bytes(data)
    data = struct.pack("<Q", len(made.images))
    for k, (quaternion, shift, camera, name, seen) in enumerate(made.images):
        data += struct.pack("<i4d3di", k + 1, *quaternion, *shift, camera) + name.encode() + b"\0"
        data += struct.pack("<Q", seen) + struct.pack("<ddq", 1.0, 2.0, -1) * seen
    (folder / "images.bin").write_bytes(data)
    data = struct.pack("<Q", len(made.points))
    for k, point in enumerate(made.points):
        data += (
            struct.pack("<QdddBBBd", k, *point, 1, 2, 3, 0.5 + k) + struct.pack("<Q", k) + struct.pack("<ii", 1, 0) * k
        )
    (folder / "points3D.bin").write_bytes(data)
    return folder


def write_txt(folder: Path, made: Model) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    lines = ["# Camera list with one line of data per camera:"]
    for number, (_, name, values) in made.cameras.items():
        lines.append(" ".join(map(str, (number, name, *made.size, *values))))
    (folder / "cameras.txt").write_text("\n".join(lines) + "\n")
    lines = ["# Image list with two lines of data per image:"]
    for k, (quaternion, shift, camera, name, seen) in enumerate(made.images):
        lines.append(" ".join(map(str, (k + 1, *map(float, quaternion), *map(float, shift), camera, name))))
        lines.append(" ".join(["1.0 2.0 -1"] * seen))
    (folder / "images.txt").write_text("\n".join(lines) + "\n")
    lines = ["# 3D point list"]
    for k, point in enumerate(made.points):
        lines.append(" ".join(map(str, (k, *map(float, point), 1, 2, 3, 0.5 + k))) + " 1 0" * k)
    (folder / "points3D.txt").write_text("\n".join(lines) + "\n")
    return folder


def test_text_and_binary_hold_the_same(tmp_path, rng):
    made = model(rng)
    first, second = write_bin(tmp_path / "a", made), write_txt(tmp_path / "b", made)
    for old, new in zip(read_model(first), read_model(second), strict=True):
        assert (old.name, old.picture, old.lens) == (new.name, new.picture, new.lens)
        assert np.array_equal(old.world_from_cam, new.world_from_cam)
    points, others = read_points(first), read_points(second)
    assert points is not None and others is not None
    assert np.array_equal(points, made.points) and np.array_equal(others, made.points)
    (first / "points3D.bin").unlink()
    assert read_points(first) is None


def colmaps_pixel(kind: str, values: tuple[float, ...], point: np.ndarray) -> tuple[float, float]:
    """COLMAP's documented projection of a point in the camera, written out per model."""
    u, v = point[0] / point[2], point[1] / point[2]
    r2 = u * u + v * v
    if kind == "SIMPLE_PINHOLE":
        f, cx, cy = values
        return f * u + cx, f * v + cy
    if kind == "PINHOLE":
        fx, fy, cx, cy = values
        return fx * u + cx, fy * v + cy
    if kind == "SIMPLE_RADIAL":
        f, cx, cy, k = values
        return f * u * (1 + k * r2) + cx, f * v * (1 + k * r2) + cy
    if kind == "RADIAL":
        f, cx, cy, k1, k2 = values
        scale = 1 + k1 * r2 + k2 * r2**2
        return f * u * scale + cx, f * v * scale + cy
    fx, fy, cx, cy, k1, k2, p1, p2 = values
    du = u * (k1 * r2 + k2 * r2**2) + 2 * p1 * u * v + p2 * (r2 + 2 * u * u)
    dv = v * (k1 * r2 + k2 * r2**2) + 2 * p2 * u * v + p1 * (r2 + 2 * v * v)
    return fx * (u + du) + cx, fy * (v + dv) + cy


def test_points_land_where_colmap_puts_them(tmp_path, rng):
    made = model(rng)
    frames = {frame.picture: frame for frame in read_model(write_bin(tmp_path, made))}
    assert len(frames) == len(KINDS)
    for quaternion, shift, camera, name, _ in made.images:
        frame = frames[name]
        _, kind, values = made.cameras[camera]
        cam = np.array([0.4, -0.3, 2.0])
        world = Rotation.from_quat(np.roll(quaternion, -1)).inv().apply(cam - shift)
        seen = Camera(frame.world_from_cam, 1.0, (0.0, 0.0), (1, 1))
        tangents, depth = px_from_world(seen, world)
        px = distort(frame.lens, tangents) * frame.lens.focal + frame.lens.centre
        assert depth == pytest.approx(2.0) and px == pytest.approx(colmaps_pixel(kind, values, cam))


@pytest.mark.parametrize("write", [write_bin, write_txt])
def test_a_project_with_its_images(tmp_path, rng, write):
    made = model(rng)
    write(tmp_path / "sparse" / "0", made)
    (tmp_path / "images" / "set a").mkdir(parents=True)
    for _, _, _, name, _ in made.images:
        write_png(tmp_path / "images" / name, np.full((48, 64, 3), 0.5, np.float32))
    for path in (tmp_path, tmp_path / "sparse", tmp_path / "sparse" / "0"):
        captures = read_captures(path, lights="unknown")
        assert [c.name for c in captures.cameras] == ["0", "1", "2", "3", "4"]
        assert camera_space(path) == "own" and sparse_points(path) is not None
    assert read_captures(tmp_path, lights="unknown", pictures=tmp_path / "images").load(0)[1].all()
    # 92 / 90 longer: the square-pixelled picture is wider.
    assert captures.cameras[1].focal == 92 and captures.cameras[1].size == (48, 65)
    assert all(captures.load(k)[1].all() for k in range(5))  # barrels: nothing of the pinhole's picture is unseen
    (tmp_path / "images" / "set a" / "3.png").unlink()
    with pytest.raises(InputRefused, match="no picture 'set a/3.png'"):
        read_captures(tmp_path, lights="unknown")
    (tmp_path / "images").rename(tmp_path / "pictures")
    with pytest.raises(InputRefused, match="no folder 'images'"):
        read_captures(tmp_path, lights="unknown")


def test_a_photographed_grid_is_straight(tmp_path, rng):
    """A distorted picture of the tangent x, read back, is the pinhole's x."""
    made = model(rng)
    made.images = [(np.array([1.0, 0, 0, 0]), np.zeros(3), 4, "x.png", 0)]
    frame = read_model(write_bin(tmp_path / "sparse", made))[0]
    tangents = undistort(frame.lens, (pixel_centres((48, 64)) - frame.lens.centre) / frame.lens.focal)
    (tmp_path / "images").mkdir()
    encoded = np.repeat(0.5 + tangents[..., :1], 3, axis=2)
    write_png(tmp_path / "images" / "x.png", encoded.astype(np.float32), 16)
    captures = read_captures(tmp_path, lights="unknown")
    rgb, counts = captures.load(0)
    x = (pixel_centres((48, 64))[..., 0] - 31.5) / 90 + 0.5
    # The sRGB curve bends between pixels: its second derivative over its first, times the step of 1/90 squared over 8.
    bend = 1.4 / (x.min() + 0.055) / 90**2 / 8
    assert counts.sum() > 2500 and np.abs(srgb_from_linear(rgb)[..., 0] - x)[counts].max() < 1.1 * bend


def test_other_models_are_refused_by_name(tmp_path, rng):
    made = model(rng)
    for number, name, count in ((5, "OPENCV_FISHEYE", 8), (6, "FULL_OPENCV", 12), (7, "FOV", 5)):
        made.cameras[2] = (number, name, (1.0,) * count)
        for write in (write_bin, write_txt):
            with pytest.raises(InputRefused, match=f"{name}; expected one of SIMPLE_PINHOLE.*image_undistorter"):
                read_model(write(tmp_path / f"{name}{write.__name__}", made))


def test_every_cut_is_noticed(tmp_path, rng):
    made = model(rng)
    write_bin(tmp_path, made)
    for name in ("cameras.bin", "images.bin", "points3D.bin"):
        whole = (tmp_path / name).read_bytes()
        for end in (0, 5, 20, len(whole) // 2, len(whole) - 1):
            (tmp_path / name).write_bytes(whole[:end])
            with pytest.raises(InputRefused, match=f"{name}: found a damaged or cut-off file"):
                read_points(tmp_path) if name == "points3D.bin" else read_model(tmp_path)
        (tmp_path / name).write_bytes(struct.pack("<Q", 2**60) + whole[8:])
        with pytest.raises(InputRefused, match=name):
            read_points(tmp_path) if name == "points3D.bin" else read_model(tmp_path)
        (tmp_path / name).write_bytes(whole)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda m: replace(m, images=[(*m.images[0][:2], 99, "a.png", 0)]), "camera 99 of the image 'a.png'"),
        (lambda m: replace(m, images=[(np.zeros(4), *m.images[0][1:])]), "an invalid pose"),
        (lambda m: replace(m, images=[(m.images[0][0], np.full(3, np.nan), *m.images[0][2:])]), "an invalid pose"),
        (lambda m: replace(m, images=[]), "0 registered images"),
        (lambda m: replace(m, size=(0, 48)), "0 x 48 pixels"),
        (lambda m: replace(m, cameras={1: (0, "SIMPLE_PINHOLE", (-5.0, 1.0, 1.0))}), "focal length of -5"),
        (lambda m: replace(m, cameras={1: (0, "SIMPLE_PINHOLE", (np.inf, 1.0, 1.0))}), "finite"),
        (lambda m: replace(m, points=np.full((1, 3), np.inf)), "points at NaN"),
    ],
)
def test_what_is_wrong_is_named(tmp_path, rng, change, reason):
    for write in (write_bin, write_txt):
        folder = write(tmp_path / write.__name__, change(model(rng)))
        with pytest.raises(InputRefused, match=reason):
            read_model(folder)
            read_points(folder)


def test_models_are_found_or_not(tmp_path, rng):
    assert find_model(tmp_path) is None
    write_txt(tmp_path / "sparse" / "0", model(rng))
    assert find_model(tmp_path) == tmp_path / "sparse" / "0" == find_model(tmp_path / "sparse")
    (tmp_path / "sparse" / "0" / "images.txt").unlink()
    assert find_model(tmp_path) is None


@pytest.mark.parametrize("write", [write_bin, write_txt])
def test_the_largest_of_several_models_is_read(tmp_path, rng, write):
    """COLMAP writes a model for each connected part; the first one need not be the largest."""
    whole, sparse = model(rng), tmp_path / "sparse"
    for number, count in (("0", 1), ("1", len(whole.images)), ("10", 2)):
        write(sparse / number, replace(whole, images=whole.images[:count]))
        if write is write_txt:
            file = sparse / number / "images.txt"
            file.write_text(f"# Number of images: {count}, mean observations per image: 1\n" + file.read_text())
    assert find_model(tmp_path) == find_model(sparse) == sparse / "1"
    assert find_model(sparse / "0") == sparse / "0"
    for _, _, _, name, _ in whole.images:
        (tmp_path / "images" / name).parent.mkdir(parents=True, exist_ok=True)
        write_png(tmp_path / "images" / name, np.zeros((48, 64, 3), np.float32))
    (note,) = reading_notes(tmp_path, read_shots(tmp_path))
    assert "3 models: 1 (5 pictures), 10 (2 pictures), 0 (1 pictures). The largest, 1, was read" in note
    notes = reading_notes(sparse / "0", read_shots(sparse / "0"))
    assert any("4 pictures in " in note and "have no camera and were left out" in note for note in notes)
