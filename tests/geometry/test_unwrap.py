"""New UVs: what must hold of every unwrapping, and of its steps."""

import subprocess
import sys

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from scipy.ndimage import maximum_filter, minimum_filter

from mistyle.core.errors import InputRefused
from mistyle.geometry import decimated, xatlas_worker
from mistyle.geometry import unwrap as unwrapping
from mistyle.geometry.normals import area_vectors, same_points
from mistyle.geometry.raster import fragments
from mistyle.geometry.retexture import carry, fetch, turn_normals
from mistyle.geometry.unwrap import estimated_seconds, unwrap
from mistyle.geometry.uvs import islands, signed_areas
from mistyle.geometry.xatlas_worker import cut_overlaps, landscape, lay_flat, mend, pack, unmirror
from mistyle.io.read_mesh import read_mesh
from tests.support.helpers import data

SIZE = 1024
# xatlas lets borders that cross each other by less than a texel in a thousand through.
SHARED_TEXELS = 1e-4


def check_unwrapped(positions: np.ndarray, faces: np.ndarray, uvs: np.ndarray, padding: int) -> None:
    """The promises of `unwrap`: inside the square, never mirrored, no shared texels, charts apart."""
    assert uvs.shape == (len(faces), 3, 2) and np.isfinite(uvs).all()
    assert uvs.min() >= 0 and uvs.max() <= 1
    area, flat = np.linalg.norm(area_vectors(positions, faces), axis=1), signed_areas(uvs)
    assert (flat >= 0).all()
    assert (flat[area > 1e-9 * area.max()] > 0).all()
    face, texel = fragments(uvs.astype(np.float64) * SIZE, SIZE)
    count = np.bincount(texel, minlength=SIZE * SIZE)
    assert np.count_nonzero(count > 1) <= SHARED_TEXELS * np.count_nonzero(count)
    island = np.full(SIZE * SIZE, -1)
    island[texel] = islands(same_points(positions)[faces], uvs)[face]
    apart(island.reshape(SIZE, SIZE), padding)


def apart(island: np.ndarray, padding: int) -> None:
    """No texel of another island within `padding` texels (less one, for centres) of a texel of an island.

    Islands that were cut from one chart may touch where no more than a texel in a thousand is concerned.
    """
    covered = island >= 0
    reach = 2 * ((padding - 1) // 2) + 1
    highest = maximum_filter(np.where(covered, island, -1), reach)
    lowest = minimum_filter(np.where(covered, island, 2**30), reach)
    near = covered & ((highest != island) | (lowest != island))
    assert np.count_nonzero(near) <= 1e-3 * np.count_nonzero(covered)


@pytest.mark.parametrize("file", ["nasty/suzanne_open.obj", "plain/spot.obj"])
def test_real_meshes_unwrap_cleanly_and_repeatably(file: str) -> None:
    asset = read_mesh(data(f"meshes/{file}"), uv="new", size=SIZE)
    again = read_mesh(data(f"meshes/{file}"), uv="new", size=SIZE)
    assert asset.source.uv == "new"
    check_unwrapped(asset.mesh.positions, asset.mesh.faces, asset.mesh.corner_uvs, SIZE // 256)
    assert asset.mesh.corner_uvs.tobytes() == again.mesh.corner_uvs.tobytes()


def test_several_shapes_at_once() -> None:
    """A torus, a capsule, a box and triangles that do not touch, each in a square of its own."""
    torus, capsule, box = trimesh.creation.torus(1, 0.4), trimesh.creation.capsule(), trimesh.creation.box()
    soup = np.random.default_rng(1).normal(size=(30, 3))
    meshes = [(np.asarray(m.vertices), np.asarray(m.faces)) for m in (torus, capsule, box)]
    meshes.append((soup, np.arange(30).reshape(-1, 3)))
    heard: list[float] = []
    for (positions, faces), uvs in zip(meshes, unwrap(meshes, size=SIZE, progress=heard.append), strict=True):
        check_unwrapped(positions, faces, uvs, SIZE // 256)
        share = signed_areas(uvs) / signed_areas(uvs).sum()
        area = np.linalg.norm(area_vectors(positions, faces), axis=1)
        density = np.sqrt(share / (area / area.sum()))
        assert np.quantile(density, 0.05) > 0.6 and np.quantile(density, 0.95) < 1.6  # even texels, but for stretch
    assert heard == sorted(heard) and heard[-1] == 1


def test_double_sided_and_degenerate_faces() -> None:
    """Both sides of a double-sided model get texels of their own; faces without area get a point."""
    ball = trimesh.creation.icosphere(2)
    positions, faces = np.asarray(ball.vertices), np.asarray(ball.faces)
    both = np.concatenate([faces, faces[:, ::-1], [[0, 0, 1], [2, 2, 2]]])
    (uvs,) = unwrap([(positions, both)], size=SIZE)
    check_unwrapped(positions, both, uvs, SIZE // 256)
    assert signed_areas(uvs)[-2:] == pytest.approx(0)
    assert islands(both, uvs).max() < 60  # not a chart for every face


def test_units_do_not_matter() -> None:
    """xatlas drops faces below an absolute area; meshes in kilometres or micrometres must unwrap alike."""
    ball = trimesh.creation.icosphere(2)
    positions, faces = np.asarray(ball.vertices), np.asarray(ball.faces)
    small, large = unwrap([(positions * 1e-6, faces), (positions * 1e6 + 5e6, faces)], size=256)
    check_unwrapped(positions, faces, small, 2)
    check_unwrapped(positions, faces, large, 2)


def test_large_meshes_go_through_a_proxy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(unwrapping, "PROXY_ABOVE", 1000)
    monkeypatch.setattr(unwrapping, "PROXY_FACES", 600)
    knot = trimesh.creation.torus(1, 0.35, major_sections=64, minor_sections=32)
    positions = np.asarray(knot.vertices) * (1 + 0.05 * np.sin(9 * np.asarray(knot.vertices)[:, :1]))
    faces = np.asarray(knot.faces)
    (uvs,) = unwrap([(positions, faces)], size=SIZE)
    check_unwrapped(positions, faces, uvs, SIZE // 256)
    assert islands(faces, uvs).max() < 60


def test_closest_points_on_triangles(rng: np.random.Generator) -> None:
    """Against a dense search over each triangle."""
    corners, point = rng.normal(size=(40, 2, 3, 3)), rng.normal(size=(40, 1, 3))
    weights, squared = decimated.closest(point, corners)
    found = np.einsum("nkc,nkcd->nkd", weights, corners)
    assert (weights >= -1e-12).all() and weights.sum(axis=2) == pytest.approx(1)
    assert ((found - point) ** 2).sum(axis=2) == pytest.approx(squared)
    s, t = (x.reshape(-1) for x in np.meshgrid(np.linspace(0, 1, 81), np.linspace(0, 1, 81)))
    dense = np.stack([1 - s - t, s, t], axis=1)[s + t <= 1]
    least = ((np.einsum("mc,nkcd->nkmd", dense, corners) - point[:, :, None]) ** 2).sum(axis=3).min(axis=2)
    assert (squared <= least + 1e-12).all() and np.sqrt(squared) == pytest.approx(np.sqrt(least), abs=0.05)


@given(st.integers(0, 1000), st.integers(1, 8))
def test_unmirror_turns_every_chart_and_keeps_its_shape(seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    chart = np.sort(rng.integers(0, count, 30))
    triangles = rng.uniform(size=(30, 3, 2)) + chart[:, None, None]
    turned = np.where((signed_areas(triangles) < 0)[:, None, None], triangles[:, ::-1], triangles)
    flip = rng.integers(0, 2, count).astype(bool)[chart]
    given_uvs = np.where(flip[:, None, None], turned * [-1, 1], turned)
    uvs = unmirror(given_uvs, chart)
    assert (signed_areas(uvs) > 0).all()
    assert np.abs(signed_areas(uvs)) == pytest.approx(np.abs(signed_areas(given_uvs)))
    for k in np.unique(chart):
        assert uvs[chart == k].min(axis=(0, 1)) == pytest.approx(given_uvs[chart == k].min(axis=(0, 1)))
        assert uvs[chart == k].max(axis=(0, 1)) == pytest.approx(given_uvs[chart == k].max(axis=(0, 1)))
    assert np.array_equal(uvs[~flip], given_uvs[~flip])
    assert signed_areas(landscape(uvs, chart)) == pytest.approx(signed_areas(uvs))  # a rotation, no reflection


def test_triangles_are_laid_flat_at_true_size(rng: np.random.Generator) -> None:
    corners = rng.normal(size=(50, 3, 3))
    flat = lay_flat(corners)
    for a in range(3):
        space = np.linalg.norm(corners[:, a] - corners[:, a - 1], axis=1)
        assert np.linalg.norm(flat[:, a] - flat[:, a - 1], axis=1) == pytest.approx(space)
    assert (signed_areas(flat) > 0).all()


def test_faces_that_the_chart_folds_over_are_cut_out() -> None:
    corners = np.array(
        [[[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[1, 0, 0], [1, 1, 0], [0, 1, 0]], [[0, 1, 0], [1, 1, 0], [0, 2, 0]]]
    )
    uvs = corners[:, :, :2].astype(float)
    uvs[2] = uvs[2][::-1]  # folded back
    fixed, chart = mend(uvs, np.zeros(3, int), corners.astype(float))
    assert (signed_areas(fixed) > 0).all() and chart.tolist() == [0, 0, 1]


def test_charts_that_lie_on_themselves_are_cut() -> None:
    """A strip that winds round one and a quarter turns."""
    angle = np.linspace(0, 2.5 * np.pi, 60)
    inner, outer = (np.stack([r * np.cos(angle), r * np.sin(angle), 0.1 * angle], axis=1) for r in (1, 2))
    quads = np.stack([inner[:-1], outer[:-1], outer[1:], inner[1:]], axis=1)
    corners = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    chart = cut_overlaps(corners[:, :, :2].copy(), np.zeros(len(corners), int))
    assert 1 <= chart.max() <= 4
    packed = pack(corners[:, :, :2].copy(), chart, 512, 4)
    count = np.bincount(fragments(packed * 512, 512)[1])
    assert (count <= 1).all()


def test_estimates_grow_with_the_mesh() -> None:
    faces = [100, 5000, 19_000, 69_000, 200_000, 5_000_000]
    seconds = [estimated_seconds(n) for n in faces]
    assert seconds == sorted(seconds) and seconds[0] < 3 and seconds[-1] < 600


def test_an_interrupt_ends_the_child(monkeypatch: pytest.MonkeyPatch) -> None:
    children: list[subprocess.Popen] = []
    start = subprocess.Popen

    def spy(*args, **kwargs) -> subprocess.Popen:
        children.append(start(*args, **kwargs))
        return children[-1]

    def interrupt(done: float) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(unwrapping.subprocess, "Popen", spy)
    ball = trimesh.creation.icosphere(4)
    with pytest.raises(KeyboardInterrupt):
        unwrap([(np.asarray(ball.vertices), np.asarray(ball.faces))], progress=interrupt)
    assert len(children) == 1 and children[0].poll() is not None


def test_a_child_that_fails_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(unwrapping.sys, "executable", sys.executable)
    monkeypatch.setenv("PYTHONHOME", "/nowhere")  # the child's interpreter cannot start
    box = trimesh.creation.box()
    with pytest.raises(InputRefused, match="12 faces with xatlas ended with code"):
        unwrap([(np.asarray(box.vertices), np.asarray(box.faces))])


def test_a_texture_is_carried_to_other_uvs() -> None:
    """A smooth picture on a plane, looked up at the same points of the plane before and after."""
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    plane = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32)[faces]
    old = plane * 0.5 + np.float32([0.2, 1.3])  # somewhere in the repeating texture
    new = (plane @ np.float32([[0, 1], [-1, 0]])) * 0.6 + np.float32([0.8, 0.1])  # turned by 90 degrees
    y, x = np.mgrid[0:128, 0:128] / 128
    picture = np.stack([np.sin(2 * np.pi * x), np.cos(2 * np.pi * y), np.sin(2 * np.pi * (x + y))], -1).astype(
        np.float32
    )
    carried, face = carry(picture, old, new.astype(np.float32), 256)
    weights = np.random.default_rng(0).dirichlet([2, 2, 2], 200)
    for k in range(2):
        before = fetch(picture, np.einsum("nk,kc->nc", weights, old[k].astype(np.float64)))
        after = fetch(carried, np.einsum("nk,kc->nc", weights, new[k].astype(np.float64)))
        assert after == pytest.approx(before, abs=0.05)  # two bilinear lookups of a wave 128 texels long
    assert (face >= 0).mean() == pytest.approx(0.36, abs=0.01)
    assert np.isfinite(carried).all() and np.abs(carried).max() <= 1


@pytest.mark.parametrize("mirrored", [False, True])
def test_carried_normals_point_the_same_way_in_space(mirrored: bool) -> None:
    """One tilt in space, seen from frames that are turned or mirrored against each other."""
    positions = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    plane = positions[:, :2].astype(np.float32)
    old = (plane * np.float32([-1, 1]) if mirrored else plane)[faces]
    turn = np.radians(30)
    spin = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]], np.float32)
    new = (plane @ spin.T)[faces]
    tilt = np.array([0.6, 0.0, 0.8])  # in space, towards +x
    before = tilt * [-1, 1, 1] if mirrored else tilt
    normal = np.tile(before.astype(np.float32), (2, 2, 1))
    face = np.array([[0, 1], [1, -1]])
    result = turn_normals(normal, face, positions, faces, old, new)
    # u of the new frame runs along (cos, -sin) in space, v along (sin, cos).
    expected = [tilt[0] * np.cos(turn), tilt[0] * np.sin(turn), 0.8]
    assert result[face >= 0] == pytest.approx(np.tile(expected, (3, 1)), abs=1e-5)
    assert result[1, 1] == pytest.approx(before, abs=1e-6)


def test_texels_of_charts_are_counted_as_they_are_sorted(
    rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    chart, sides = rng.integers(0, 5, 4000), np.array([[9, 40], [40, 3], [1, 1], [20, 20], [5, 5]], float)
    column, row = (rng.integers(0, sides[chart, k].astype(int)) for k in (0, 1))
    used = chart != 2  # a chart that covers no texel
    counted = xatlas_worker._covered_texels(chart[used], column[used], row[used], sides)
    monkeypatch.setattr(xatlas_worker, "MOST_CELLS", 0)
    for fast, plain in zip(
        counted, xatlas_worker._covered_texels(chart[used], column[used], row[used], sides), strict=True
    ):
        np.testing.assert_array_equal(fast, plain)
    assert counted[0][2] == 0 and (counted[1] > 0).sum() == 4
