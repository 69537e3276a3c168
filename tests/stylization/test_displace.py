"""`--displace` and `--height-map`, as their users meet them: a horn drawn into a view, skins, shared meshes, files."""

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from PIL import Image

from mistyle.core.errors import UsageError
from mistyle.io.read import read_exr, read_picture
from mistyle.io.read_mesh import load_gltf, read_mesh
from mistyle.jobs.progress import Progress
from mistyle.solver.shape.moved import displaced_asset
from mistyle.stylization.pipeline import stylize as pipeline
from mistyle.stylization.pipeline.job import Job
from mistyle.stylization.settings import resolve
from tests.support.helpers import data

TINY = {
    "rig": {"resolution": 96},
    "surface": {"samples": 3000},
    "atlas": {"size": 128, "padding": 4},
    "report": {"detail": "page", "frames": 4, "resolution": 64, "spp": 2},
    "threads": 2,
}
HORN = (200, 40, 30)


@pytest.fixture(scope="module")
def inputs(tmp_path_factory) -> tuple[Path, Path]:
    """An upright egg of bounding radius 2 and a painting of diagonal strokes."""
    folder = tmp_path_factory.mktemp("inputs")
    ball = trimesh.creation.icosphere(subdivisions=4, radius=2.0)
    ball.vertices *= [0.6, 1, 0.6]
    ball.export(folder / "ball.obj")
    y, x = np.mgrid[:96, :128] / 16
    stripes = np.stack([np.sin(x + y) * 0.4 + 0.5, np.sin(x + y + 1) * 0.3 + 0.4, np.cos(x - y) * 0.2 + 0.3], axis=-1)
    Image.fromarray((stripes * 255).astype(np.uint8)).save(folder / "strokes.png")
    return folder / "ball.obj", folder / "strokes.png"


def job(inputs: tuple[Path, Path], out: Path, **settings) -> Job:
    chosen = resolve("draft", None, TINY | settings, {})
    return Job(inputs[0], inputs[1], out, chosen, "ball")


def draw_horn(picture: Path) -> None:
    """An opaque horn on the right of the object."""
    image = np.array(Image.open(picture))
    rows, columns = np.nonzero(image[..., 3] > 128)
    tip = columns.max() + 9
    row = int(rows[columns.argmax()])
    for k in range(13):
        half = k // 2
        image[row - half : row + half + 1, tip - k] = (*HORN, 255)
    Image.fromarray(image).save(picture)


@pytest.fixture(scope="module")
def undisplaced(inputs, tmp_path_factory) -> Path:
    """A run without displacement; other runs go on from a copy of its folder."""
    out = tmp_path_factory.mktemp("undisplaced") / "out"
    pipeline.stylize(job(inputs, out), Progress(quiet=True))
    return out


@pytest.fixture(scope="module")
def horned(inputs, undisplaced, tmp_path_factory) -> tuple[Path, dict, Path]:
    """A run, and the same run again after a horn was drawn; the mesh of the first."""
    out = shutil.copytree(undisplaced, tmp_path_factory.mktemp("run") / "out")
    first = pipeline.stylize(job(inputs, out, displace={"most": "20%"}), Progress(quiet=True))
    assert any("no vertex moved" in note for note in first["notes"])
    plain = tmp_path_factory.mktemp("kept") / "ball.glb"
    plain.write_bytes((out / "asset" / "ball.glb").read_bytes())
    draw_horn(out / "stylized" / "az030.0_el+00.0.png")
    return out, pipeline.stylize(job(inputs, out, displace={"most": "20%"}), Progress(quiet=True)), plain


def test_without_a_drawn_outline_the_asset_is_that_of_no_displacement(undisplaced, horned):
    assert (undisplaced / "asset" / "ball.glb").read_bytes() == horned[2].read_bytes()


def test_a_drawn_horn_grows_and_keeps_its_paint(horned):
    out, summary, plain = horned
    assert summary["figures"]["displace.overlap_after"] > summary["figures"]["displace.overlap_before"]
    before, after = read_mesh(plain, uv="keep"), read_mesh(out / "asset" / "ball.glb", uv="keep")
    assert (before.mesh.faces == after.mesh.faces).all()
    assert (before.mesh.corner_uvs == after.mesh.corner_uvs).all()
    step = np.linalg.norm(after.source.user_positions - before.source.user_positions, axis=1)
    assert 0.1 < step.max() <= 0.4 + 1e-5  # 20 % of a radius of 2
    assert (step == 0).mean() > 0.3
    # An independent reader sees the same.
    other: Any = trimesh.load(out / "asset" / "ball.glb", force="mesh", process=False)
    assert np.abs(np.sort(other.vertices[:, 0])[-1] - after.source.user_positions[:, 0].max()) < 1e-5
    albedo = read_picture(out / "asset" / "textures" / "ball_albedo.png").rgb
    assert (np.abs(albedo - np.array(HORN) / 255).max(axis=-1) < 0.1).sum() > 5
    page = (out / "report" / "index.html").read_text("utf-8")
    assert "Clay under a key light" in page and "6.2.2" in page


def test_a_second_run_takes_the_displacement_over(inputs, horned):
    progress = Progress(quiet=True)
    pipeline.stylize(job(inputs, horned[0], displace={"most": "20%"}), progress)
    assert {"displace", "retouch", "asset", "report"} <= set(progress.reused)


def test_paint_apart_from_the_object_is_left_out(inputs, horned, tmp_path):
    from mistyle.io.cameras.views import read_views
    from mistyle.stylization.displace.outlines import coverages, outline_of

    mesh = read_mesh(inputs[0]).mesh
    view = read_views(horned[0] / "views")[0]
    (own,) = coverages(mesh, [view])
    signed = own.copy()
    signed[2:8, 2:12] = 1
    assert outline_of(view, signed, own) == (None, 1)


def test_a_skinned_mesh_keeps_its_skin(tmp_path):
    from mistyle.core.maps import flat_maps
    from mistyle.io.gltf.write import patch_glb

    asset = read_mesh(data("meshes/nasty/Fox.glb"), uv="keep")
    rng = np.random.default_rng(0)
    step = 0.02 * rng.standard_normal(asset.mesh.positions.shape).astype(np.float32)
    # Copies of a point at seams move as one.
    from mistyle.geometry.normals import same_points

    step = step[same_points(asset.mesh.positions)]
    step[asset.mesh.positions[:, 1] < 0] = 0
    moved = displaced_asset(asset, asset.mesh.positions + step)
    ones = [np.ones((4, 4), np.float32)] * len(asset.mesh.parts)
    maps = [flat_maps(4)] * len(asset.mesh.parts)
    for name, one in (("still", asset), ("moved", moved)):
        patch_glb(tmp_path / f"{name}.glb", one, maps, ones, name=name)
    still, again = (read_mesh(tmp_path / f"{name}.glb", uv="keep") for name in ("still", "moved"))
    size = np.ptp(asset.source.user_positions, axis=0).max()
    corners = [a.source.user_positions[a.mesh.faces] for a in (moved, again)]
    assert np.abs(corners[0] - corners[1]).max() < 1e-5 * size
    assert (still.mesh.corner_uvs == again.mesh.corner_uvs).all()
    trees = [load_gltf(tmp_path / f"{name}.glb")[0] for name in ("still", "moved")]
    assert trees[0]["skins"] and len(trees[0]["skins"][0]["joints"]) == len(trees[1]["skins"][0]["joints"])
    assert len(trees[0]["animations"]) == len(trees[1]["animations"])


def test_a_mesh_that_is_shown_twice_is_refused(inputs, tmp_path):
    ball = trimesh.creation.icosphere(subdivisions=1)
    scene = trimesh.Scene()
    scene.add_geometry(ball, node_name="one", geom_name="ball")
    scene.graph.update(frame_to="two", geometry="ball", matrix=np.eye(4) + 3 * np.eye(4, k=3))
    scene.export(tmp_path / "two.glb")
    twice = replace(job(inputs, tmp_path / "out", displace={"most": 0.1}), mesh=tmp_path / "two.glb")
    with pytest.raises(UsageError, match="single-user"):
        pipeline.stylize(twice, Progress(quiet=True))


def test_the_height_map_has_the_reliefs_slope_and_the_meshs_units(inputs, undisplaced, tmp_path):
    chosen = job(
        inputs,
        shutil.copytree(undisplaced, tmp_path / "out"),
        displace={"height_map": True},
        report={"detail": "none"},
        deliver={"formats": ["maps", "mtlx"], "target": ["blender", "houdini"]},
    )
    pipeline.stylize(chosen, Progress(quiet=True))
    textures = tmp_path / "out" / "asset" / "textures"
    listed = json.loads((tmp_path / "out" / "asset" / "ball.json").read_text())["files"]
    entry = next(e for e in listed if e["file"] == "textures/ball_height.png")
    coded = np.array(Image.open(textures / "ball_height.png")).astype(float) / 65535
    exact = read_exr(textures / "ball_height.exr")["Y"]
    assert np.abs((coded - entry["middle"]) * entry["scale"] - exact).max() < entry["scale"] / 65535
    assert np.abs(exact).max() < 0.1 * 2.0  # thin against the ball's radius
    for target, ending in (("blender", "png"), ("houdini", "exr")):
        folder = tmp_path / "out" / "delivered" / target
        assert (folder / "textures" / f"ball_height.{ending}").is_file()
        assert "displacementshader" in (folder / "ball.mtlx").read_text()


def test_the_heights_gradient_is_the_reliefs(tmp_path):
    from mistyle.deliver.colour import read_style
    from mistyle.stylization.settings import Settings
    from mistyle.stylization.surface.lookup import height, relief
    from mistyle.stylization.surface.painter import solve_surface

    trimesh.creation.icosphere(subdivisions=4).export(tmp_path / "ball.obj")
    y, x = np.mgrid[:192, :256] / 32
    stripes = np.stack([np.sin(x + y) * 0.4 + 0.5, np.sin(x + y + 1) * 0.3 + 0.4, np.cos(x - y) * 0.2 + 0.3], axis=-1)
    Image.fromarray((stripes * 255).astype(np.uint8)).save(tmp_path / "strokes.png")
    settings = resolve("draft", None, TINY | {"surface": {"samples": 8000}}, {})
    mesh, style = read_mesh(tmp_path / "ball.obj").mesh, read_style(tmp_path / "strokes.png", Settings().colour)
    painted = solve_surface(mesh, style, settings.surface)
    rng = np.random.default_rng(0)
    points = rng.standard_normal((4000, 3))
    points = (points / np.linalg.norm(points, axis=1, keepdims=True)).astype(np.float32)
    along = np.cross(points, rng.standard_normal((4000, 3))).astype(np.float32)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    step = np.float32(painted.spacing / max(painted.scale))  # a pixel of the painting
    ends = [height(painted, points + s * step * along, points) for s in (1, -1)]
    measured = (ends[0] - ends[1]) / (2 * step)
    expected = (relief(painted, points, points)[0] * along).sum(axis=1)
    # Steps between pieces are no slope of the relief: most points lie inside one.
    inside = np.abs(measured - expected) < 0.1 * np.abs(expected).max()
    assert inside.mean() > 0.8
    assert np.polyfit(expected[inside], measured[inside], 1)[0] == pytest.approx(1, abs=0.05)


@pytest.mark.parametrize(
    ("settings", "match"),
    [
        ({"displace": {"height_map": True}, "paint": {"height": 0}}, "paint is flat"),
        ({"displace": {"height_map": True}, "stylizer": "embedded-view"}, "have no relief"),
    ],
)
def test_a_height_map_without_relief_is_refused(inputs, tmp_path, settings, match):
    with pytest.raises(UsageError, match=match):
        pipeline.stylize(job(inputs, tmp_path / "out", **settings), Progress(quiet=True))
