"""Pictures that observe no texel of the mesh are refused before anything is solved, whatever kind they are."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mistyle.cli.main import main
from mistyle.core.camera import Camera, orbit
from mistyle.core.light import Ambient, Lights, Point, to_json
from mistyle.fitting.pipeline.unseen import distances, looked_at
from mistyle.io.cameras.camera_files import camera_entry, transforms
from mistyle.io.images.write import write_exr, write_png
from mistyle.io.read_mesh import read_mesh
from mistyle.render.mitsuba.draw import gbuffer, tracer

SIDE = 48
QUADS = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]


def box(path: Path, unit: float) -> Path:
    """A box of one unit, beside the origin as scanned objects are, with an island for every side."""
    corners = [(x, y, z) for x in (-0.3, 0.7) for y in (-0.4, 0.6) for z in (-0.5, 0.5)]
    lines = [f"v {x * unit} {y * unit} {z * unit}" for x, y, z in corners]
    for k in range(6):
        u, v = (k % 3) / 3, (k // 3) / 2
        lines += [f"vt {u + a} {v + b}" for a, b in ((0.05, 0.05), (0.3, 0.05), (0.3, 0.45), (0.05, 0.45))]
    lines += ["f " + " ".join(f"{i + 1}/{4 * k + j + 1}" for j, i in enumerate(quad)) for k, quad in enumerate(QUADS)]
    path.write_text("\n".join(lines) + "\n")
    return path


def colmap(folder: Path, cameras: list[Camera], names: list[str]) -> None:
    model = folder / "sparse" / "0"
    model.mkdir(parents=True)
    (model / "points3D.txt").write_text("")
    (model / "cameras.txt").write_text(f"1 PINHOLE {SIDE} {SIDE} {cameras[0].focal} {cameras[0].focal} 24 24\n")
    rows = []
    for k, (camera, name) in enumerate(zip(cameras, names, strict=True)):
        pose = camera.cam_from_world
        numbers = [*np.roll(Rotation.from_matrix(pose[:3, :3]).as_quat(), 1), *pose[:3, 3]]
        rows.append(f"{k + 1} {' '.join(map(repr, map(float, numbers)))} 1 {name}\n\n")
    (model / "images.txt").write_text("".join(rows))


def nerf(folder: Path, cameras: list[Camera], names: list[str]) -> None:
    tree = transforms(cameras, [f"images/{name}" for name in names])
    del tree["space"]
    (folder / "transforms.json").write_text(json.dumps(tree))


def own(folder: Path, cameras: list[Camera], names: list[str]) -> None:
    views = [
        camera_entry(c) | {Path(name).suffix[1:]: f"images/{name}"} for c, name in zip(cameras, names, strict=True)
    ]
    (folder / "camera.json").write_text(json.dumps({"views": views}))


KINDS = {"colmap": colmap, "transforms.json": nerf, "camera.json": own}


def captured(folder: Path, kind: str, ending: str, rig: Lights, scale: float = 1.0, valid: bool = True) -> Path:
    """Pictures of the unit box from around; in cameras' files, their distances are `scale` times the true ones."""
    asset = read_mesh(box(folder / "unit.obj", 1.0), size=32)
    traced = tracer(asset.mesh)
    user_from_work = np.linalg.inv(asset.source.work_from_user)
    shots = folder / "shots"
    (shots / "images").mkdir(parents=True)
    cameras, names = [], []
    for k in range(4):
        camera = orbit(90.0 * k + 20, 25, distance=4.0, fov=30.0, size=(SIDE, SIDE))
        mask = gbuffer(traced, camera).mask.astype(np.float32) * valid
        name = f"p{k}{ending}"
        if ending == ".exr":
            write_exr(shots / "images" / name, {**dict.fromkeys("RGB", 0.4 * mask), "A": mask})
        else:
            write_png(shots / "images" / name, np.stack([0.4 * mask] * 3 + [mask], axis=-1))
        pose = camera.world_from_cam.copy()
        if kind != "camera.json":  # in the box's own units
            pose[:3, 3] = user_from_work[:3, :3] @ pose[:3, 3] + user_from_work[:3, 3]
        pose[:3, 3] *= scale
        cameras.append(replace(camera, world_from_cam=pose, name=f"p{k}"))
        names.append(name)
    KINDS[kind](shots, cameras, names)
    (shots / "lights.json").write_text(json.dumps(to_json(rig)))
    return shots


def fit(mesh: Path, shots: Path, out: Path, *more: str) -> int:
    words = ["--atlas", "32", "--report", "none", "--passes", "1", "--hold-out", "1", "--preset", "draft", *more]
    return main(["fit", str(mesh), str(shots), "-o", str(out), *words])


SKY: Lights = (Ambient((1.0, 1.0, 1.0)),)


@pytest.mark.parametrize("ending", [".png", ".exr"])
@pytest.mark.parametrize("kind", ["colmap", "transforms.json"])
@pytest.mark.parametrize("light", ["known", "unknown"])
def test_a_mesh_in_millimetres_is_refused_with_its_size(tmp_path, capsys, kind, ending, light):
    shots = captured(tmp_path, kind, ending, SKY)
    mesh = box(tmp_path / "box.obj", 1000.0)
    assert fit(mesh, shots, tmp_path / "out", "--light", light) == 3
    said = capsys.readouterr().err
    assert "no picture shows a texel of box.obj" in said and "The mesh is 1730 across" in said
    assert "A factor near 1000 suggests a mesh in millimetres and cameras in metres." in said
    assert "--align" in said and "scale the mesh" in said and "match the exposures" not in said
    assert not (tmp_path / "out" / "asset").exists() and not (tmp_path / "out" / "run.json").exists()


def test_cameras_in_millimetres_are_refused_too(tmp_path, capsys):
    shots = captured(tmp_path, "transforms.json", ".exr", SKY, scale=1000.0)
    assert fit(tmp_path / "unit.obj", shots, tmp_path / "out") == 3
    assert "A factor near 1000 suggests a mesh in metres and cameras in millimetres." in capsys.readouterr().err


def test_cameras_in_working_space_are_judged_there(tmp_path, capsys):
    shots = captured(tmp_path, "camera.json", ".png", SKY, scale=0.01)
    assert fit(tmp_path / "unit.obj", shots, tmp_path / "out") == 3
    said = capsys.readouterr().err
    assert "The mesh is 2 across" in said and "0.04 from its centre, inside" in said and "factor near 100 " in said
    assert "bounding sphere of radius 1" in said


def test_a_light_that_reaches_nothing_is_named(tmp_path, capsys):
    below: Lights = (Point((0.2, -5.0, 0.0), (1.0, 1.0, 1.0)),)
    shots = captured(tmp_path, "transforms.json", ".exr", below)
    assert fit(tmp_path / "unit.obj", shots, tmp_path / "out") == 3
    said = capsys.readouterr().err
    assert "all that they see is in shadow" in said and "lights.json" in said


def test_pictures_without_a_valid_pixel_are_refused_as_such(tmp_path, capsys):
    shots = captured(tmp_path, "transforms.json", ".png", SKY, valid=False)
    assert fit(tmp_path / "unit.obj", shots, tmp_path / "out") == 3
    assert "without a valid pixel" in capsys.readouterr().err


def test_distances_are_in_one_unit():
    cameras = [orbit(90.0 * k, 20, distance=4.0, fov=30.0, size=(SIDE, SIDE)) for k in range(3)]
    assert "4 across" in distances(cameras, 0.5) and "8 from its centre" in distances(cameras, 0.5)
    assert "factor" not in distances(cameras, 0.5) and "inside" not in distances(cameras, 0.5)
    moved = [replace(c, world_from_cam=np.vstack([c.world_from_cam[:3] + [[0, 0, 0, 9]], [[0, 0, 0, 1]]]))
             for c in cameras]  # fmt: skip
    assert np.allclose(looked_at(moved), 9) and np.allclose(looked_at([cameras[0]] * 2), 0)
    far = [orbit(90.0 * k, 20, distance=4000.0, fov=30.0, size=(SIDE, SIDE)) for k in range(3)]
    assert "a mesh in metres and cameras in millimetres" in distances(far, 1.0)
