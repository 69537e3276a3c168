"""Cameras mean what they mean: which pixels they describe, in whose space, and which files they name; for every layout.

Each capture is built here: pictures of four flat quadrants that no turn and no mirror leaves as they are.
"""

import json
import struct
import zlib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from mistyle.core.asset import Pixels
from mistyle.core.camera import Camera, orbit
from mistyle.core.errors import InputRefused
from mistyle.core.image import srgb_from_linear
from mistyle.io.cameras.camera_files import camera_entry, read_cameras, read_frames, transforms
from mistyle.io.cameras.captures import load_shot, outline_of, read_captures, read_shots
from mistyle.io.cameras.colmap import read_model
from mistyle.io.cameras.reading_notes import reading_notes
from mistyle.io.cameras.views import read_views
from mistyle.io.images.write import write_exr
from mistyle.io.read import read_picture, read_size, read_stored_size
from tests.io.cameras.test_colmap import Model, write_bin, write_txt
from tests.io.images.test_read_pictures import png16

TALL, WIDE = 32, 48  # of the stored pixels
FOCAL = 60.0
COLOURS = np.array([[[200, 40, 40], [40, 180, 40]], [[40, 40, 190], [210, 200, 60]]], np.uint8)
# By Pillow's own list: what makes the upright picture of stored pixels.
UPRIGHT = {
    2: Image.Transpose.FLIP_LEFT_RIGHT,
    3: Image.Transpose.ROTATE_180,
    4: Image.Transpose.FLIP_TOP_BOTTOM,
    5: Image.Transpose.TRANSPOSE,
    6: Image.Transpose.ROTATE_270,
    7: Image.Transpose.TRANSVERSE,
    8: Image.Transpose.ROTATE_90,
}
ENDINGS = {"jpg": {"quality": 98, "subsampling": 0}, "png": {}, "tif": {}, "webp": {"lossless": True}}


def quadrants() -> np.ndarray:
    return np.repeat(np.repeat(COLOURS, TALL // 2, axis=0), WIDE // 2, axis=1)


def first_quadrant() -> np.ndarray:
    mask = np.zeros((TALL, WIDE), np.uint8)
    mask[: TALL // 2, : WIDE // 2] = 255
    return mask


def upright(pixels: np.ndarray, orientation: int) -> np.ndarray:
    image = Image.fromarray(pixels)
    return np.asarray(image.transpose(UPRIGHT[orientation]) if orientation in UPRIGHT else image)


def save(path: Path, pixels: np.ndarray, orientation: int = 1) -> None:
    exif = Image.Exif()
    if orientation > 1:
        exif[0x0112] = orientation
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(pixels).save(path, exif=exif.tobytes(), **ENDINGS.get(path.suffix[1:], {}))


def cameras(count: int, size: tuple[int, int] = (TALL, WIDE)) -> list[Camera]:
    ring = [orbit(60.0 * k, 20, distance=5.0, fov=30.0, size=size) for k in range(count)]
    return [
        replace(c, name=f"v{k}", focal=FOCAL, centre=(size[1] / 2 + 1, size[0] / 2 - 2)) for k, c in enumerate(ring)
    ]


def colmap(folder: Path, chosen: list[Camera], names: list[str], write: Callable = write_txt) -> Path:
    made = Model(size=(chosen[0].size[1], chosen[0].size[0]))
    made.cameras[1] = (1, "PINHOLE", (FOCAL, FOCAL, *chosen[0].centre))
    for camera, name in zip(chosen, names, strict=True):
        pose = camera.cam_from_world
        quaternion = np.roll(Rotation.from_matrix(pose[:3, :3]).as_quat(), 1)
        made.images.append((quaternion, pose[:3, 3], 1, name, 0))
    write(folder / "sparse" / "0", made)
    return folder / "images"


def nerf(folder: Path, chosen: list[Camera], names: list[str]) -> Path:
    tree = transforms(chosen, names)
    del tree["space"]
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "transforms.json").write_text(json.dumps(tree))
    return folder


def own(folder: Path, chosen: list[Camera], names: list[str]) -> Path:
    entries = [camera_entry(c) | {"png": name} for c, name in zip(chosen, names, strict=True)]
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "camera.json").write_text(json.dumps({"views": entries}))
    return folder


# Writers of cameras: each gives the folder that names are relative to. And the pixels that they describe.
KINDS: dict[str, tuple[Callable[..., Path], str]] = {
    "colmap.txt": (colmap, "stored"),
    "colmap.bin": (lambda *rest: colmap(*rest, write=write_bin), "stored"),
    "transforms.json": (nerf, "stored"),
    "camera.json": (own, "upright"),
}


@pytest.mark.parametrize("ending", [*ENDINGS, "png with 16 bits"])
@pytest.mark.parametrize("kind", ["colmap.txt", "transforms.json", "camera.json"])
def test_a_camera_describes_stored_or_upright_pixels(tmp_path, kind, ending):
    write, pixels = KINDS[kind]
    for orientation in range(1, 9):
        home, name = tmp_path / str(orientation), f"v0.{ending[:4].strip()}"
        seen, inside = quadrants(), first_quadrant()
        if pixels == "upright":
            seen, inside = upright(seen, orientation), upright(inside, orientation)
        place = write(home, cameras(1, seen.shape[:2]), [name])
        if "16" in ending:
            place.mkdir(parents=True, exist_ok=True)
            (place / name).write_bytes(tagged(png16(quadrants().astype(np.uint16) * 257), orientation))
        else:
            save(place / name, quadrants(), orientation)
        save(home / "masks" / "v0.png", first_quadrant(), orientation)
        (shot,) = read_shots(home, masks=home / "masks")
        rgb, counts = load_shot(replace(shot, mask=None))
        assert counts.all() and shot.camera.size == seen.shape[:2]
        assert np.abs(srgb_from_linear(rgb) * 255 - seen).max() < (12 if ending == "jpg" else 1e-2), orientation
        assert np.array_equal(load_shot(shot)[1], inside > 0)
        found = outline_of(shot)
        assert found is not None and np.array_equal(found, inside > 0)
        assert shot.pixels == pixels and shot.orientation == (orientation, orientation)
        notes = " ".join(reading_notes(home, [shot]))
        assert ("EXIF orientation: 1 pictures, 1 masks" in notes) == (orientation > 1)
        assert orientation == 1 or ("ignored" if pixels == "stored" else "turned upright") in notes


def tagged(png: bytes, orientation: int) -> bytes:
    """The PNG with an orientation, written by hand behind its pixels."""
    exif = struct.pack(">2sHIHHHIHHI", b"MM", 42, 8, 1, 0x0112, 3, 1, orientation, 0, 0)
    chunk = struct.pack(">I", len(exif)) + b"eXIf" + exif + struct.pack(">I", zlib.crc32(b"eXIf" + exif))
    return png[:-12] + chunk + png[-12:]


@pytest.mark.parametrize("ending", ["jpg", "png", "tif", "webp"])
def test_pictures_are_read_stored_or_upright(tmp_path, ending):
    for orientation in range(1, 9):
        save(tmp_path / f"a.{ending}", quadrants(), orientation)
        path, turned = tmp_path / f"a.{ending}", upright(quadrants(), orientation)
        assert read_stored_size(path) == (TALL, WIDE, orientation)
        assert read_size(path) == turned.shape[:2] and read_size(path, "stored") == (TALL, WIDE)
        for pixels, expected in zip(get_args(Pixels), (quadrants(), turned), strict=True):
            found = read_picture(path, pixels)
            assert np.abs(found.rgb * 255 - expected).max() < (12 if ending == "jpg" else 1e-2)
            assert any("EXIF" in note for note in found.notes) == (orientation > 1 and pixels == "upright")


def test_alpha_turns_with_its_picture(tmp_path):
    pixels = np.dstack([quadrants(), first_quadrant()])
    for orientation in range(1, 9):
        nerf(tmp_path, cameras(1), ["a.png"])
        save(tmp_path / "a.png", pixels, orientation)
        found = outline_of(read_shots(tmp_path)[0])
        assert found is not None and np.array_equal(found, first_quadrant() > 0)


def test_views_of_a_transforms_json_are_stored_pixels_too(tmp_path):
    nerf(tmp_path, cameras(1), ["v0.png"])
    save(tmp_path / "v0.png", quadrants(), 6)
    (view,) = read_views(tmp_path)
    assert np.allclose(srgb_from_linear(view.rgb) * 255, quadrants(), atol=0.01)
    own(tmp_path, cameras(1, (WIDE, TALL)), ["v0.png"])
    (view,) = read_views(tmp_path)
    assert np.allclose(srgb_from_linear(view.rgb) * 255, upright(quadrants(), 6), atol=0.01)


@pytest.mark.parametrize("kind", KINDS)
def test_swapped_sides_name_exif_rotation(tmp_path, kind):
    write, pixels = KINDS[kind]
    size = (WIDE, TALL) if pixels == "stored" else (TALL, WIDE)
    place = write(tmp_path, cameras(1, size), ["v0.jpg"])
    save(place / "v0.jpg", quadrants(), 6)
    with pytest.raises(InputRefused, match=f"EXIF rotation.*{pixels} pixels.*orientation is 6"):
        read_shots(tmp_path)
    save(place / "v0.jpg", quadrants()[:-1, :-1])
    with pytest.raises(InputRefused) as refusal:
        read_shots(tmp_path)
    assert "EXIF" not in str(refusal.value) and "neither scaled nor cropped" in str(refusal.value)


# --- images.txt ---

NAMES = ("a.jpg", "set a/b  c.jpg", "12", "1 2 3.png", "100%20.jpg", "7 8.png")


def observations(k: int) -> str:
    return " ".join(["10.5 20.25 -1", "3 4 17"] * (k + 1))


FORMS: dict[str, Callable[[list[str]], str]] = {
    "blank second lines": lambda rows: "\n\n".join(rows) + "\n\n",
    "no second lines": lambda rows: "\n".join(rows) + "\n",
    "no second lines, no last line end": lambda rows: "\n".join(rows),
    "observations": lambda rows: "".join(f"{row}\n{observations(k)}\n" for k, row in enumerate(rows)),
    "observations here, blank or no lines there": lambda rows: "".join(
        row + ("\n", "\n\n", f"\n{observations(1)}\n")[k % 3] for k, row in enumerate(rows)
    ),
    "comments between": lambda rows: "".join(f"# one\n{row}\n  # two\n{observations(0)}\n" for row in rows),
    "blank lines between": lambda rows: "".join(f"\n\n{row}\n\n\n" for row in rows),
    "spaces and tabs": lambda rows: "".join(f" \t{row} \t\n  \n" for row in rows),
}


@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
@pytest.mark.parametrize("mark", ["", "\ufeff"])
@pytest.mark.parametrize("form", FORMS)
def test_images_txt_in_every_form_is_what_the_binary_is(tmp_path, form, mark, end):
    chosen = cameras(len(NAMES))
    colmap(tmp_path / "bin", chosen, list(NAMES), write_bin)
    expected = read_model(tmp_path / "bin" / "sparse" / "0")
    folder = tmp_path / "txt"
    colmap(folder, chosen, list(NAMES))
    folder = folder / "sparse" / "0"
    rows = [line for line in (folder / "images.txt").read_text().splitlines() if line and line[0] != "#"]
    assert len(rows) == len(NAMES)
    text = "# Image list\n" + FORMS[form](rows)
    (folder / "images.txt").write_bytes((mark + text).replace("\n", end).encode())
    listed = (folder / "cameras.txt").read_text() + "\n"
    (folder / "cameras.txt").write_bytes((mark + listed).replace("\n", end).encode())
    found = read_model(folder)
    assert [f.picture for f in found] == [f.picture for f in expected] == sorted(NAMES)
    for old, new in zip(expected, found, strict=True):
        assert old.lens == new.lens and np.array_equal(old.world_from_cam, new.world_from_cam)


# --- names ---


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", ["shot%2000.png", "100%.png", "%41.png", "a%2Fb.png", "a:b.png", "x y.png"])
def test_every_character_of_a_name_is_a_letter(tmp_path, kind, name):
    place = KINDS[kind][0](tmp_path, [replace(cameras(1)[0], name=name[:-4])], [name])
    save(place / name, quadrants())
    save(place / "A.png", np.zeros((TALL, WIDE, 3), np.uint8))  # what %41 would be in a URI
    save(tmp_path / "masks" / name, first_quadrant())
    shots = read_shots(tmp_path, masks=tmp_path / "masks")
    assert shots[0].picture.name == name and shots[0].mask is not None and shots[0].mask.name == name


def test_names_of_lights_and_frames_masks_are_letters_too(tmp_path):
    nerf(tmp_path, cameras(1), ["a.png"])
    tree = json.loads((tmp_path / "transforms.json").read_text())
    tree["frames"][0]["mask_path"] = "masks/%20.png"
    (tmp_path / "transforms.json").write_text(json.dumps(tree))
    save(tmp_path / "a.png", quadrants())
    save(tmp_path / "masks" / "%20.png", first_quadrant())
    write_exr(tmp_path / "sky%20.exr", {c: np.ones((2, 4), np.float32) for c in "RGB"})
    lights = {"lights": [{"type": "environment", "file": "sky%20.exr"}]}
    (tmp_path / "lights.json").write_text(json.dumps(lights))
    assert np.array_equal(read_captures(tmp_path).load(0)[1], first_quadrant() > 0)


def test_backslashes_separate_folders(tmp_path):
    nerf(tmp_path, cameras(2), [".\\train\\r_0", "train\\r_1.png"])
    for k in range(2):
        save(tmp_path / "train" / f"r_{k}.png", quadrants())
    assert [shot.picture.name for shot in read_shots(tmp_path)] == ["r_0.png", "r_1.png"]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("above", ["../shots/", "..\\shots\\", "/somewhere/shots/", "C:\\shots\\"])
def test_pictures_above_the_folder_are_refused_with_the_true_cause(tmp_path, kind, above):
    home, elsewhere = tmp_path / "model", tmp_path / "shots"
    (home / "images").mkdir(parents=True)
    KINDS[kind][0](home, cameras(2), [f"{above}v{k}.png" for k in range(2)])
    for k in range(2):
        save(elsewhere / f"v{k}.png", quadrants())
    with pytest.raises(InputRefused, match=r"v0\.png.*folder.*--pictures DIR") as refusal:
        read_shots(home)
    assert "mesh" not in str(refusal.value)
    for folder in (elsewhere, tmp_path) if kind != "camera.json" else (elsewhere,):
        shots = read_shots(home, pictures=folder)
        assert [shot.picture for shot in shots] == [elsewhere / f"v{k}.png" for k in range(2)]
    with pytest.raises(InputRefused, match="no folder"):
        read_shots(home, pictures=tmp_path / "nowhere")
    (elsewhere / "v1.png").unlink()
    with pytest.raises(InputRefused, match="v1"):
        read_shots(home, pictures=elsewhere)


@pytest.mark.parametrize("kind", sorted(set(KINDS) - {"camera.json"}))
@pytest.mark.parametrize("where", ["/home/someone/job/", "C:\\job\\", "../job/", "data/job/"])
@pytest.mark.parametrize("ending", ["png", "tif"])
def test_pictures_of_files_that_were_made_elsewhere(tmp_path, kind, where, ending):
    """Paths of another machine or folder, and pictures whose background was removed, which changed their ending."""
    home = tmp_path / "model"
    KINDS[kind][0](home, cameras(2), [f"{where}shots/v{k}.png" for k in range(2)])
    folder = home / "images" if kind.startswith("colmap") else home
    for k in range(3):
        save(folder / "shots" / f"v{k}.{ending}", quadrants())
    shots = read_shots(home)
    assert [shot.picture for shot in shots] == [folder / "shots" / f"v{k}.{ending}" for k in range(2)]
    found, rest = reading_notes(home, shots)
    assert found.startswith(f"2 of 2 pictures were found by the end of their names (v0.{ending} for {where}")
    assert rest.startswith("1 pictures in ") and rest.endswith(f"left out, such as v2.{ending}.")
    save(folder / "shots" / f"v0.{'webp' if ending == 'tif' else 'tif'}", quadrants())
    if ending == "tif":  # which of the two is unknown
        with pytest.raises(InputRefused, match="v0"):
            read_shots(home)
    else:
        assert [shot.picture for shot in read_shots(home)] == [shot.picture for shot in shots]


def test_names_that_become_one_are_refused(tmp_path):
    nerf(tmp_path / "model", cameras(2), ["../cam0/0001.png", "../cam1/0001.png"])
    save(tmp_path / "shots" / "0001.png", quadrants())
    with pytest.raises(InputRefused, match="0001.png alone for the views 'cam0_0001' and 'cam1_0001'"):
        read_shots(tmp_path / "model", pictures=tmp_path / "shots")
    for k in range(2):
        save(tmp_path / "shots" / f"cam{k}" / "0001.png", quadrants())
    shots = read_shots(tmp_path / "model", pictures=tmp_path / "shots")
    assert [shot.picture.parent.name for shot in shots] == ["cam0", "cam1"]


def test_masks_above_the_folder_give_way_to_masks_that_are_handed_in(tmp_path):
    nerf(tmp_path / "model", cameras(1), ["a.png"])
    file = tmp_path / "model" / "transforms.json"
    tree = json.loads(file.read_text())
    tree["frames"][0]["mask_path"] = "../masks/a.png"
    file.write_text(json.dumps(tree))
    save(tmp_path / "model" / "a.png", quadrants())
    save(tmp_path / "masks" / "a.png", first_quadrant())
    with pytest.raises(InputRefused, match="--masks DIR") as refusal:
        read_shots(tmp_path / "model")
    assert "mesh" not in str(refusal.value)
    (shot,) = read_shots(tmp_path / "model", masks=tmp_path / "masks")
    assert shot.mask == tmp_path / "masks" / "a.png"


def test_links_out_of_the_folder_are_refused_as_such(tmp_path):
    save(tmp_path / "secret.png", quadrants())
    place = nerf(tmp_path / "model", cameras(1), ["a.png"])
    (place / "a.png").symlink_to(tmp_path / "secret.png")
    with pytest.raises(InputRefused, match="which is .*secret.png; expected a file inside the folder"):
        read_shots(place)


def test_a_folder_of_masks_that_is_not_used_is_named(tmp_path):
    place = nerf(tmp_path, cameras(1), ["a.png"])
    save(place / "a.png", quadrants())
    save(place / "masks" / "a.png", first_quadrant())
    assert "--masks" in reading_notes(place, read_shots(place))[0]
    assert reading_notes(place, read_shots(place, masks=place / "masks")) == ()


# --- transforms.json ---


def changed(place: Path, change: Callable[[dict], object]) -> Path:
    file = place / "transforms.json"
    tree = json.loads(file.read_text())
    change(tree)
    file.write_text(json.dumps(tree))
    return file


def frames(place: Path) -> list:
    return read_frames(place / "transforms.json", lambda name: (TALL, WIDE))


TURN = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])  # as nerfstudio's


@pytest.mark.parametrize("rows", [3, 4])
@pytest.mark.parametrize("scale", [None, 1.0, 0.25])
@pytest.mark.parametrize("matrix", [None, TURN, "moved", "scaled"])
def test_what_nerfstudio_applied_is_undone(tmp_path, matrix, scale, rows):
    applied = np.eye(4) if matrix is None else np.array(TURN if isinstance(matrix, str) else matrix)
    if isinstance(matrix, str):
        applied[:3, 3] = [0.3, -2.0, 5.0]
        applied[:3, :3] = Rotation.from_rotvec([0.3, 1.0, -0.2]).as_matrix() * (3.0 if matrix == "scaled" else 1.0)
    chosen = cameras(3)
    moved = []
    for camera in chosen:
        pose = applied @ camera.world_from_cam
        pose[:3, :3] /= np.cbrt(np.linalg.det(applied[:3, :3]))
        pose[:3, 3] *= scale or 1.0
        moved.append(replace(camera, world_from_cam=pose))
    place = nerf(tmp_path, moved, [f"{c.name}.png" for c in chosen])

    def apply(tree: dict) -> None:
        if matrix is not None:
            tree["applied_transform"] = applied[:rows].tolist()
        if scale is not None:
            tree["applied_scale"] = scale

    changed(place, apply)
    for camera, frame in zip(chosen, frames(place), strict=True):
        assert np.abs(frame.world_from_cam - camera.world_from_cam).max() < 1e-9
    for camera, other in zip(chosen, read_cameras(place / "transforms.json"), strict=True):
        assert np.abs(other.world_from_cam - camera.world_from_cam).max() < 1e-9
    for camera in chosen:
        save(place / f"{camera.name}.png", quadrants())
    notes = " ".join(reading_notes(place, read_shots(place)))
    assert ("applied_transform" in notes) == (matrix is not None) and ("applied_scale" in notes) == (scale is not None)


@pytest.mark.parametrize(
    ("fields", "reason"),
    [
        ({"applied_scale": 0}, "applied_scale = 0"),
        ({"applied_scale": "2"}, "applied_scale = '2'"),
        ({"applied_transform": [[1, 0, 0, 0], [0, 1, 0, 0]]}, "3 or 4 rows of 4"),
        ({"applied_transform": [[1, 0, 0, 0], [0, 1, 0], [0, 0, 1, 0]]}, "3 or 4 rows of 4"),
        ({"applied_transform": "none"}, "3 or 4 rows of 4"),
        ({"applied_transform": np.diag([1, 1, -1, 1]).tolist()}, "mirrors"),
        ({"applied_transform": np.diag([0, 1, 1, 1]).tolist()}, "mirrors"),
        ({"applied_transform": np.diag([1, 2, 3, 1]).tolist()}, "not a rotation in applied_transform"),
        ({"applied_transform": (np.eye(4) * 2).tolist()}, "projective matrix in applied_transform"),
    ],
)
def test_what_cannot_have_been_applied_is_named(tmp_path, fields, reason):
    changed(nerf(tmp_path, cameras(1), ["a.png"]), lambda tree: tree.update(fields))
    with pytest.raises(InputRefused, match=reason):
        frames(tmp_path)


def test_matrices_of_three_rows(tmp_path):
    chosen = cameras(2)
    place = nerf(tmp_path, chosen, ["a.png", "b.png"])
    changed(place, lambda tree: [f.update(transform_matrix=f["transform_matrix"][:3]) for f in tree["frames"]])
    for camera, frame in zip(chosen, frames(place), strict=True):
        assert np.allclose(frame.world_from_cam, camera.world_from_cam)
    for wrong in (None, [], [[1, 0, 0]] * 3, [[1, 0, 0, 0]] * 2, [[1, 0, 0, "x"]] * 3, [[1, 0, 0, 0]] * 5):
        changed(place, lambda tree, wrong=wrong: tree["frames"][1].update(transform_matrix=wrong))
        with pytest.raises(InputRefused, match="view 'b'; expected 3 or 4 rows of 4 finite numbers"):
            frames(place)


def test_a_frames_own_intrinsics_go_before_those_above(tmp_path):
    """Of the whole file, of each frame, and of both; a focal length above does not overrule a frame's field of view."""
    angle = 2 * np.arctan(WIDE / (2 * FOCAL))
    above = {"fl_x": 99.0, "fl_y": 98.0, "cx": 1.0, "cy": 2.0, "w": WIDE, "h": TALL, "k1": 0.1}
    mine = {"fl_x": FOCAL, "fl_y": FOCAL, "cx": 24.0, "cy": 16.0, "k1": 0.2}
    bare = ["fl_x", "fl_y", "cx", "cy", "w", "h", "camera_angle_x", "camera_angle_y"]
    for frame, expected in (
        ({}, (99.0, 98.0, 1.0, 0.1)),
        (mine, (FOCAL, FOCAL, 24.0, 0.2)),
        ({"camera_angle_x": angle}, (FOCAL, FOCAL, 1.0, 0.1)),
        ({"fl_x": FOCAL}, (FOCAL, FOCAL, 1.0, 0.1)),
    ):

        def write(tree: dict, frame: dict = frame) -> None:
            for entry in (tree, *tree["frames"]):
                for key in bare:
                    entry.pop(key, None)
            tree.update(above)
            tree["frames"][0].update(frame)

        changed(nerf(tmp_path, cameras(1), ["a.png"]), write)
        (found,) = frames(tmp_path)
        assert (*found.lens.focal, found.lens.centre[0], found.lens.radial[0]) == pytest.approx(expected)
        assert found.lens.size == (TALL, WIDE)


def test_what_is_no_capture_stays_refused(tmp_path):
    """A 3D Gaussian splatting `cameras.json`, by itself and in its folder."""
    (tmp_path / "cameras.json").write_text('[{"id": 0, "img_name": "a", "width": 4, "height": 4}]')
    with pytest.raises(InputRefused, match="cameras.json"):
        read_shots(tmp_path / "cameras.json")
    with pytest.raises(InputRefused, match="expected a folder with camera.json, transforms.json, a COLMAP model"):
        read_shots(tmp_path)


def test_several_pictures_in_a_file_are_no_animation(tmp_path):
    first, other = Image.fromarray(quadrants()), Image.fromarray(quadrants()[::-1])
    first.save(tmp_path / "a.jpg", format="MPO", save_all=True, append_images=[other])
    Image.fromarray(quadrants()).save(tmp_path / "a.tif", save_all=True, append_images=[Image.fromarray(quadrants())])
    for name, what in (("a.jpg", "MPO"), ("a.tif", "first page")):
        found = read_picture(tmp_path / name)
        assert what in found.notes[0] and "animation" not in found.notes[0]
        assert np.abs(found.rgb * 255 - quadrants()).mean() < 5
