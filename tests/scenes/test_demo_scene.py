"""The demo's mesh and painting: what the files hold, and that the scripts beside them are what made them."""

import importlib

import numpy as np
import pytest
from PIL import Image
from scipy.ndimage import gaussian_filter, zoom
from scipy.spatial import ConvexHull

from tests.support.helpers import ROOT

SCENES = ROOT / "scenes"


@pytest.fixture(scope="module")
def obj():
    """Positions, uvs, normals and corner indices (f, 3, 3) of demo.obj, read by these ten lines."""
    rows = {"v": [], "vt": [], "vn": [], "f": []}
    for line in (SCENES / "demo.obj").read_text(encoding="ascii").splitlines():
        kind, *words = line.split()
        if kind == "f":
            rows["f"].append([[int(k) - 1 for k in word.split("/")] for word in words])
        elif kind in rows:
            rows[kind].append([float(w) for w in words])
    return tuple(np.array(rows[k]) for k in ("v", "vt", "vn", "f"))


@pytest.fixture
def scripts(monkeypatch):
    """The modules beside the scenes."""
    monkeypatch.syspath_prepend(str(SCENES))
    return lambda name: importlib.import_module(name)


def corners(obj):
    positions, _, _, faces = obj
    return positions[faces[..., 0]]


def cross2(a, b):
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def test_the_mesh_is_small_closed_and_right_side_out(obj):
    _, _, _, faces = obj
    f = faces[..., 0]
    assert (SCENES / "demo.obj").stat().st_size < 1_500_000
    assert 8_000 <= len(f) <= 15_000
    directed = np.concatenate([f[:, [0, 1]], f[:, [1, 2]], f[:, [2, 0]]])
    edges = {tuple(e) for e in directed.tolist()}
    assert len(edges) == len(directed) and all((b, a) in edges for a, b in edges)
    assert len(np.unique(f)) - len(edges) // 2 + len(f) == 2  # Euler: one piece, no handle
    a, b, c = corners(obj).transpose(1, 0, 2)
    assert (np.cross(a, b) * c).sum() / 6 > 0.5  # cubic metres, positive: faces look outwards


def test_the_mesh_is_a_shape_with_hollows_and_thin_parts(obj):
    a, b, c = corners(obj).transpose(1, 0, 2)
    volume = (np.cross(a, b) * c).sum() / 6
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2
    assert 36 * np.pi * volume**2 / area**3 < 0.15  # 1 for a sphere
    assert volume / ConvexHull(obj[0]).volume < 0.5


def test_it_stands_on_its_feet(obj):
    positions = obj[0]
    assert abs(positions[:, 1].min()) < 1e-4
    ground = positions[positions[:, 1] < 0.01][:, [0, 2]]
    assert len(ground) > 100
    a, b, c = corners(obj).transpose(1, 0, 2)
    weight = (np.cross(a, b) * c).sum(axis=1)
    centre = ((a + b + c) / 4 * weight[:, None]).sum(axis=0) / weight.sum()
    hull = ConvexHull(ground)
    assert (hull.equations[:, :2] @ centre[[0, 2]] + hull.equations[:, 2]).max() < -0.1  # 10 cm inside


def test_normals_are_unit_and_lean_with_their_faces(obj):
    _, _, normals, faces = obj
    assert np.abs(np.linalg.norm(normals, axis=1) - 1).max() < 2e-4  # four decimals in the file
    a, b, c = corners(obj).transpose(1, 0, 2)
    flat = np.cross(b - a, c - a)
    flat /= np.linalg.norm(flat, axis=1, keepdims=True)
    lean = (flat[:, None] * normals[faces[..., 2]]).sum(axis=2)
    assert np.mean(lean > 0.5) > 0.99 and np.mean(lean > 0) > 0.999


def test_uvs_fill_the_square_unmirrored_and_without_overlap(obj):
    _, uvs, _, faces = obj
    uv = uvs[faces[..., 1]]
    assert uv.min() >= 0 and uv.max() <= 1
    area = cross2(uv[:, 1] - uv[:, 0], uv[:, 2] - uv[:, 0]) / 2
    assert (area > 0).all()
    assert area.sum() > 0.45
    size = 1024
    count = np.zeros((size, size), int)
    for t in uv * size:
        x0, y0 = np.ceil(t.min(axis=0) - 0.5).astype(int)
        x1, y1 = np.floor(t.max(axis=0) - 0.5).astype(int)
        if x1 < x0 or y1 < y0:
            continue
        p = np.stack(np.meshgrid(np.arange(x0, x1 + 1), np.arange(y0, y1 + 1)), axis=-1) + 0.5
        sides = np.stack([cross2(t[(k + 1) % 3] - t[k], p - t[k]) for k in range(3)])
        count[y0 : y1 + 1, x0 : x1 + 1] += (sides > 1e-9).all(axis=0)
    assert np.count_nonzero(count > 1) < 1e-4 * size**2  # a chart may lie on itself at a crease, by a few texels
    assert abs(count.mean() - area.sum()) < 0.01


def test_texels_are_shared_out_evenly(obj):
    _, uvs, _, faces = obj
    a, b, c = corners(obj).transpose(1, 0, 2)
    uv = uvs[faces[..., 1]]
    surface = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    ratio = cross2(uv[:, 1] - uv[:, 0], uv[:, 2] - uv[:, 0]) / surface
    low, high = np.quantile(np.repeat(ratio, np.ceil(surface / np.median(surface)).astype(int)), [0.05, 0.95])
    assert high / low < 2


def test_the_mesh_is_the_scripts_shape(obj, scripts):
    """Every vertex lies on the zero of the distance function, up to the softening and the shift onto the ground."""
    distance = scripts("elephant").elephant(obj[0] + [0, 0.005, 0])
    assert np.mean(np.abs(distance)) < 0.003
    assert np.quantile(np.abs(distance), 0.99) < 0.011  # one cell of the grid


def test_the_reader_takes_the_mesh_as_it_is(obj):
    from mistyle.io.read_mesh import read_mesh

    asset = read_mesh(SCENES / "demo.obj")
    assert asset.source.uv == "kept" and not asset.source.notes
    assert asset.mesh.parts == ("elephant",)
    assert np.array_equal(asset.mesh.faces, obj[3][..., 0])
    assert np.allclose(asset.mesh.corner_uvs, obj[1][obj[3][..., 1]], atol=1e-6)


def test_marching_cubes_of_a_known_shape(scripts):
    sculpt = scripts("sculpt")

    def shape(p):
        return sculpt.ellipsoid(p, (0.1, 0, 0), (0.5, 0.3, 0.4))

    clay = sculpt.sample(shape, (-1, -1, -1), (1, 1, 1), 0.03, 0.3)
    vertices, faces = clay.polygonise()
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    volume = (np.cross(a, b) * c).sum() / 6
    assert volume == pytest.approx(4 / 3 * np.pi * 0.5 * 0.3 * 0.4, rel=0.02)  # chords cut the corners
    assert np.abs(clay(sculpt.settle(clay, vertices, 0.03))).max() < 1e-3


def test_blends_and_lenses_do_what_they_say(scripts, rng):
    sculpt, make_demo = scripts("sculpt"), scripts("make_demo")
    a, b = rng.normal(size=(2, 1000))
    soft = sculpt.blend(a, b, 0.3)
    assert (soft <= np.minimum(a, b)).all() and np.abs(soft - np.minimum(a, b)).max() <= 0.3 / 4 + 1e-12
    apart = np.abs(a - b) > 0.3
    assert np.array_equal(soft[apart], np.minimum(a, b)[apart])
    assert np.array_equal(sculpt.carve(a, b, 0.3), -sculpt.blend(-a, b, 0.3))
    p = rng.normal(size=(500, 3))
    seen = make_demo.lens(p, np.array([0.2, 0, 0]), 0.9, 1.4)
    assert np.allclose(make_demo.lens(seen, np.array([0.2, 0, 0]), 0.9, 1.4, inverse=True), p, atol=1e-5)
    far = np.linalg.norm(p - [0.2, 0, 0], axis=1) > 0.9
    assert np.allclose(seen[far], p[far], rtol=0, atol=1e-12)


@pytest.fixture(scope="module")
def painting():
    return np.asarray(Image.open(SCENES / "demo_style.png"))


def coherence(grey: np.ndarray, sigma: float) -> float:
    """How much the gradients within `sigma` pixels share one direction, weighted by their energy: 0 none, 1 all."""
    gy, gx = np.gradient(gaussian_filter(grey, 1.0))
    xx, yy, xy = (gaussian_filter(g, sigma) for g in (gx * gx, gy * gy, gx * gy))
    return float(np.hypot(xx - yy, 2 * xy).sum() / (xx + yy).sum())


def test_the_painting_has_strokes_and_is_no_noise(painting, rng):
    assert painting.dtype == np.uint8 and painting.shape[2] == 3 and min(painting.shape[:2]) >= 1024
    assert (SCENES / "demo_style.png").stat().st_size < 2_000_000
    grey = painting.mean(axis=2)
    noise = gaussian_filter(rng.normal(size=grey.shape), 1.5)
    assert coherence(grey, 8) > 0.45 > 0.25 > coherence(noise, 8)


def test_the_painting_has_a_palette_of_opposites(painting):
    small = painting[::8, ::8].reshape(-1, 3) / 255
    chroma = np.ptp(small, axis=1)
    angle = np.arctan2(np.sqrt(3) * (small[:, 1] - small[:, 2]), 2 * small[:, 0] - small[:, 1] - small[:, 2])
    hue = np.degrees(angle)[chroma > 0.25] % 360
    warm, cold = np.mean((hue < 65) | (hue > 330)), np.mean((hue > 170) & (hue < 260))
    assert warm > 0.2 and cold > 0.2
    assert np.quantile(small.mean(axis=1), 0.98) - np.quantile(small.mean(axis=1), 0.02) > 0.6


def test_the_painting_is_the_scripts_composition(painting, scripts):
    paint, sunset = scripts("paint"), scripts("sunset")
    size = (205, 256)
    plan = paint.srgb_from_oklab(sunset.compose(size, 1889).colour)
    shown = zoom(painting / 255, (size[0] / painting.shape[0], size[1] / painting.shape[1], 1), order=1)
    blurred = [gaussian_filter(x, (6, 6, 0)).ravel() for x in (plan, shown)]
    assert np.corrcoef(*blurred)[0, 1] > 0.85


def test_equal_seeds_paint_equal_pictures(scripts):
    sunset = scripts("sunset")
    first, again, other = (sunset.painting((72, 90), seed) for seed in (5, 5, 6))
    assert np.array_equal(first, again)
    assert np.abs(first.astype(int) - other).mean() > 3


def test_a_stroke_paints_where_it_lies_and_nowhere_else(scripts, rng):
    paint = scripts("paint")
    canvas = paint.Canvas(np.zeros((80, 120, 3)), np.zeros((80, 120)))
    wet = (np.zeros((8, 8)), np.zeros((8, 8)))
    paint.stroke(canvas, (60, 40), np.radians(30), 0.0, (30, 6), np.array([0.8, 0.1, 0.0]), wet, 3.0)
    y, x = np.mgrid[:80, :120] + 0.5
    along = (x - 60) * np.cos(np.radians(30)) + (y - 40) * np.sin(np.radians(30))
    across = -(x - 60) * np.sin(np.radians(30)) + (y - 40) * np.cos(np.radians(30))
    # The tip's half ellipse begins 0.55 half widths before the length's end; a pixel's edge is antialiased.
    outside = (np.abs(along) > 30 + 0.45 * 6 + 1) | (np.abs(across) > 6 + 1)
    assert not canvas.thickness[outside].any()
    core = (np.abs(along) < 15) & (np.abs(across) < 3)
    assert np.abs(canvas.colour[core] - [0.8, 0.1, 0.0]).max() < 0.2 and (canvas.thickness[core] > 0).all()


def test_oklab_is_oklab(scripts, rng):
    """Ottosson's own examples (XYZ to OKLab, three decimals) and the way back."""
    paint = scripts("paint")
    xyz = np.array([[0.950, 1.000, 1.089], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    lab = np.cbrt(xyz @ paint.OKLAB_LMS.T) @ paint.OKLAB_LAB.T
    expected = [[1.000, 0.000, 0.000], [0.450, 1.236, -0.019], [0.922, -0.671, 0.263], [0.153, -1.415, -0.449]]
    assert np.allclose(lab, expected, atol=1.1e-3)
    rgb = rng.random((100, 3))
    assert np.allclose(paint.srgb_from_oklab(paint.oklab_from_srgb(rgb)), rgb, atol=1e-3)
