"""Meshes far from their origin, as surveyors have them, keep a millimetre in every format; a turned OBJ is noted."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from mistyle.core.mesh import local_origin
from mistyle.deliver.asset import write_asset
from mistyle.deliver.export import DeliveryRequest, export
from mistyle.io.read_mesh import read_mesh
from mistyle.io.usd.write import library
from tests.support.gltf_cases import no_texels, quarters

# Where the middle is, and how far the mesh reaches from there: UTM, and a national grid with a wide tile.
PLACES = {
    "utm": ([500000.0, 4649776.0, 100.0], 2.0),
    "utm, negative": ([-552341.37, 5803217.82, -97.4866], 0.5),
    "wide tile": ([155000.0, 463000.0, 12.0], 15000.0),
    "near": ([0.3, 0.2, 0.1], 1.0),
}


def grid(middle: list[float], reach: float) -> np.ndarray:
    """25 points whose coordinates are whole millimetres."""
    x, y = np.meshgrid(np.linspace(-1, 1, 5), np.linspace(-1, 1, 5))
    local = np.stack([x, y, 0.1 * np.sin(3 * x + y)], axis=-1).reshape(-1, 3) * reach
    return np.round(np.array(middle) + local, 3)


def write_obj(path: Path, points: np.ndarray) -> Path:
    lines = [f"v {x:.3f} {y:.3f} {z:.3f}" for x, y, z in points]
    lines += [f"vt {k % 5 / 4} {k // 5 / 4}" for k in range(25)]
    for k in (5 * row + column for row in range(4) for column in range(4)):
        lines.append("f " + " ".join(f"{n}/{n}" for n in (k + 1, k + 2, k + 7, k + 6)))
    path.write_text("\n".join(lines) + "\n")
    return path


def delivered(folder: Path, points: np.ndarray, up: Any = "y") -> Path:
    asset = read_mesh(write_obj(folder / "site.obj", points), uv="keep", up=up)
    ones = np.ones((16, 16), np.float32)
    write_asset(folder / "asset", "site", asset, [quarters()], [ones], [no_texels()], provenance={})
    export(folder, folder / "out", DeliveryRequest(formats=["usd", "obj", "glb"]))
    return folder / "out"


def usd_points(path: Path) -> np.ndarray:
    pxr = library()

    stage = pxr.Usd.Stage.Open(str(path))
    (mesh,) = [p for p in stage.Traverse() if p.IsA(pxr.UsdGeom.Mesh)]
    world = pxr.UsdGeom.XformCache().GetLocalToWorldTransform(mesh)
    points = pxr.UsdGeom.Mesh(mesh).GetPointsAttr().Get()
    low, high = pxr.UsdGeom.Mesh(mesh).GetExtentAttr().Get()
    np.testing.assert_array_equal([low, high], [np.min(points, axis=0), np.max(points, axis=0)])
    return np.array([world.Transform(pxr.Gf.Vec3d(*map(float, p))) for p in points])


def obj_points(path: Path) -> np.ndarray:
    return np.array([row.split()[1:] for row in path.read_text().splitlines() if row.startswith("v ")], float)


def glb_points(path: Path) -> np.ndarray:
    scene: Any = trimesh.load(path, process=False, force="scene")
    (name,) = scene.graph.nodes_geometry
    matrix, geometry = scene.graph[name]
    local = scene.geometry[geometry].vertices
    return local.astype(np.float64) @ matrix[:3, :3].T + matrix[:3, 3]


@pytest.mark.parametrize("place", PLACES)
def test_a_millimetre_stays_wherever_the_mesh_lies(tmp_path, place):
    pytest.importorskip("pxr")
    points = grid(*PLACES[place])
    out = delivered(tmp_path, points)
    # Half a step of float32 about a local origin is the least that USD and glTF allow.
    step = max(2e-4, PLACES[place][1] * 2.0**-23)
    assert step < 2.5e-3
    np.testing.assert_allclose(usd_points(out / "site.usda"), points, rtol=0, atol=step)
    np.testing.assert_allclose(usd_points(out / "site.usdz"), points, rtol=0, atol=step)
    np.testing.assert_allclose(obj_points(out / "site.obj"), points, rtol=0, atol=step)
    found = glb_points(out / "site.glb")
    assert len(found) >= 25
    distance = np.abs(found[:, None] - points[None]).max(axis=-1).min(axis=1)
    assert distance.max() < step
    # What is read again is the mesh once more.
    again = read_mesh(out / "site.usda", uv="keep")
    np.testing.assert_allclose(again.source.user_positions, points, rtol=0, atol=step)


def test_the_local_origin_is_whole_and_only_for_meshes_that_need_it():
    cube = np.array([[-1.0, -1, -1], [1, 1, 1]])
    assert not local_origin(cube + [5, -5, 5]).any()
    origin = local_origin(cube + [500000.4, 0, 0])
    assert origin.tolist() == [500000, 0, 0]


def test_a_delivered_obj_that_was_turned_says_so(tmp_path):
    pytest.importorskip("pxr")
    said: list[str] = []
    points = grid([1.0, 2, 3], 1.0)
    out = delivered(tmp_path, points, up="z")
    np.testing.assert_allclose(obj_points(out / "site.obj"), points[:, [0, 2, 1]] * [1, 1, -1], atol=1e-6)
    for formats, count in ((["obj"], 1), (["glb"], 0)):
        export(tmp_path, tmp_path / "again", DeliveryRequest(formats=formats), note=lambda *s: said.extend(s))
        assert len(said) == count
        assert json.loads((tmp_path / "again" / "site.export.json").read_text())["notes"] == said
        said.clear()
    export(tmp_path, tmp_path / "again", DeliveryRequest(formats=["obj"]), note=lambda *s: said.extend(s))
    assert "site.obj has Y up" in said[0] and "from Z up to Y up" in said[0]
