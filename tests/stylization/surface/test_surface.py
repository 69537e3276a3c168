"""The weight-free stylizer: samples, frames, guides, search, look-up and the whole of it on small shapes."""

from dataclasses import fields, replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial import KDTree

from mistyle.core.asset import Picture
from mistyle.core.errors import InputRefused
from mistyle.core.mesh import Mesh, face_areas
from mistyle.io.store.records import load_record, save_record
from mistyle.render.mitsuba import device, occlusion
from mistyle.stylization.surface import field, kernels, lookup, samples, synthesis
from mistyle.stylization.surface.exemplar import exemplar as style
from mistyle.stylization.surface.guides import creases, guides, linefield
from mistyle.stylization.surface.settings import SurfaceSettings
from tests.support.helpers import data, fixed_surface


def mesh_of(positions, faces, normals=None) -> Mesh:
    """A mesh with the given corner normals (one per vertex), else flat ones."""
    positions, faces = np.asarray(positions, np.float32), np.asarray(faces, np.int32)
    if normals is None:
        corners = positions[faces]
        flat = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        flat /= np.maximum(np.linalg.norm(flat, axis=1, keepdims=True), 1e-20)
        normals = np.repeat(flat[:, None], 3, axis=1)
    else:
        normals = np.asarray(normals, np.float32)[faces]
    count = len(faces)
    uvs = np.zeros((count, 3, 2), np.float32)
    return Mesh(positions, faces, normals.astype(np.float32), uvs, np.zeros(count, np.int32), ("only",))


def grid_faces(rows: int, columns: int, wrap: bool = False) -> np.ndarray:
    """Triangles of a grid of vertices, row by row; `wrap` joins the last column to the first."""
    r, c = np.meshgrid(np.arange(rows - 1), np.arange(columns if wrap else columns - 1), indexing="ij")
    a, b = r * columns + c, r * columns + (c + 1) % columns
    return np.concatenate([np.stack([a, b, a + columns], -1), np.stack([b, b + columns, a + columns], -1)]).reshape(
        -1, 3
    )


def sheet(size: int = 9) -> Mesh:
    """The square -0.7..0.7 in the plane y = 0, front up."""
    z, x = np.meshgrid(*[np.linspace(-0.7, 0.7, size)] * 2, indexing="ij")
    faces = grid_faces(size, size)[:, ::-1]
    return mesh_of(np.stack([x, np.zeros_like(x), z], -1).reshape(-1, 3), faces)


def dented_ball() -> Mesh:
    """A sphere with hollows and bumps, poles left open."""
    theta, phi = np.meshgrid(np.linspace(0.05, np.pi - 0.05, 60), np.arange(100) * 2 * np.pi / 100, indexing="ij")
    radius = 0.85 + 0.1 * np.sin(4 * theta) * np.cos(4 * phi)
    unit = np.stack([np.sin(theta) * np.cos(phi), np.cos(theta), np.sin(theta) * np.sin(phi)], -1).reshape(-1, 3)
    faces = grid_faces(60, 100, wrap=True)
    positions = unit * radius.reshape(-1, 1)
    corners = positions[faces]
    flat = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    if (flat * corners.mean(axis=1)).sum() < 0:
        faces, flat = faces[:, ::-1], -flat
    normals = np.stack([np.bincount(faces.reshape(-1), np.repeat(flat[:, k], 3), len(unit)) for k in range(3)], 1)
    return mesh_of(positions, faces, normals / np.linalg.norm(normals, axis=1, keepdims=True))


def box(x: float, y: float, z: float) -> Mesh:
    corners = np.array([[i, j, k] for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)]) * np.array([x, y, z]) / 2
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    return mesh_of(corners, [t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))])


def open_sky(positions, normals):
    return np.ones(len(positions), np.float32)


def solved(mesh, rgb, settings, seed, alpha=None, progress=lambda done: None):
    """A mesh painted with a picture (encoded sRGB) under an open sky."""
    picture, sky = Picture(rgb, alpha, Path("picture.png")), synthesis.SurfaceFields(open_sky)
    return synthesis.solve(mesh, picture, sky, settings, seed, progress)


def strokes(size=(96, 128), seed=5) -> np.ndarray:
    """A painting of short level strokes in warm and cool colours on a vertical gradient, encoded sRGB."""
    rng = np.random.default_rng(seed)
    picture = np.linspace(0.25, 0.75, size[0])[:, None, None] * np.ones((*size, 3)) * np.array([0.7, 0.8, 1.0])
    for _ in range(500):
        y, x, length = rng.integers(0, size[0]), rng.integers(0, size[1]), rng.integers(6, 16)
        hue = np.array([1.0, 0.8, 0.3]) if rng.random() < 0.3 else np.array([0.3, 0.5, 1.0])
        picture[y : y + 2, x : x + length] = np.clip(hue * rng.uniform(0.2, 1.0), 0, 1)
    return picture.astype(np.float32)


@pytest.fixture(scope="module")
def dj():
    device.use("llvm_ad_rgb")
    return kernels.module("llvm")


SMALL = fixed_surface(samples=1500)


@pytest.fixture(scope="module")
def painted(dj):
    """A small solved case: mesh, painting and solution."""
    mesh, painting = dented_ball(), strokes()
    return mesh, painting, solved(mesh, painting, SMALL, 0)


def spread_on(mesh, count, seed=0):
    return samples.spread(mesh, samples.sample_normals(mesh), count, np.random.default_rng(seed))


@pytest.mark.parametrize("shape", [sheet(), dented_ball(), box(1.0, 1.0, 1.0)], ids=["sheet", "ball", "box"])
def test_samples_are_blue_noise(shape):
    count = 4000
    points = spread_on(shape, count)
    area = float(face_areas(shape).sum())
    n = len(points.positions)
    assert n == pytest.approx(samples.YIELD * count, rel=0.2)
    assert points.spacing == pytest.approx(np.sqrt(area / n), rel=1e-6)
    distance, other = KDTree(points.positions).query(points.positions, k=2)
    same_side = (points.normals * points.normals[other[:, 1]]).sum(axis=1) > 0
    assert distance[same_side, 1].min() >= 0.999 * samples.SPACING * np.sqrt(area / count)
    assert np.allclose(np.linalg.norm(points.normals, axis=1), 1, atol=1e-5)


def test_samples_follow_the_area_evenly():
    points = spread_on(sheet(), 6400)
    cells = np.floor((points.positions[:, [0, 2]] + 0.7) / 1.4 * 16).clip(0, 15).astype(int)
    counts = np.bincount(cells[:, 0] * 16 + cells[:, 1], minlength=256)
    # Independent points would have a variance equal to the mean; blue noise is far below.
    assert counts.var() < 0.35 * counts.mean()


def test_samples_survive_degenerate_faces_and_coinciding_layers():
    plain = box(1, 1, 1)
    empty = np.full((4, 3), 3, np.int32)
    with_empty = mesh_of(plain.positions, np.concatenate([plain.faces[:6], empty, plain.faces[6:], empty]))
    assert len(spread_on(with_empty, 1000).positions) == pytest.approx(800, rel=0.2)
    layers = mesh_of(np.tile(plain.positions, (30, 1)), np.concatenate([plain.faces + 8 * k for k in range(30)]))
    points = spread_on(layers, 1000)
    # Thirty boxes in one place: as many points as asked for, at the spacing of the one surface that is seen.
    assert 500 < len(points.positions) < 1200
    assert points.spacing == pytest.approx(np.sqrt(6 / len(points.positions)), rel=0.25)
    with pytest.raises(InputRefused, match="area"):
        spread_on(mesh_of(np.zeros((3, 3)), [[0, 1, 2]]), 100)


def test_normals_take_the_side_of_the_shading_normals():
    ball = dented_ball()
    turned = Mesh(
        ball.positions, ball.faces[:, ::-1], ball.corner_normals[:, ::-1], ball.corner_uvs, ball.part, ball.parts
    )
    np.testing.assert_allclose(samples.sample_normals(turned)[:, ::-1], samples.sample_normals(ball), atol=1e-6)
    assert (samples.sample_normals(ball) * ball.positions[ball.faces]).sum(axis=2).min() > 0


def plane_level(dj, side=21, flip=False):
    """A regular grid in the plane z = 0 facing +z with tangents along x: across runs down, along -y."""
    x, y = np.meshgrid(np.arange(side), -np.arange(side))
    positions = np.stack([x, y, np.zeros_like(x)], -1).reshape(-1, 3) * 0.1
    normals = np.tile([0.0, 0.0, 1.0], (side * side, 1))
    tangent = np.tile(np.array([1.0, 0.0, 0.0], np.float32), (side * side, 1))
    if flip:
        tangent[positions[:, 0] > 1.05] *= -1
    points = samples.as_points(positions, normals, 0.1)
    return samples.with_tables(points, tangent, np.ones(side * side, np.float32), dj)


def test_tables_on_a_plane_are_the_grid(dj):
    level = plane_level(dj)
    index = np.arange(21 * 21).reshape(21, 21)
    for k, (dx, dy) in enumerate(samples.GRID.astype(int)):
        expected = index[2 + dy : 19 + dy, 2 + dx : 19 + dx]
        inner = index[2:19, 2:19]
        assert (level.neighbours[inner, k] == expected).all()
        # The sample as its neighbour sees it lies the other way.
        np.testing.assert_allclose(level.offsets[inner, k], np.broadcast_to([-dx, -dy], (17, 17, 2)), atol=1e-4)
    assert not level.turned.any()
    np.testing.assert_allclose(level.across, np.broadcast_to([0, -1, 0], level.across.shape), atol=1e-6)


def test_tables_know_neighbours_that_are_upside_down(dj):
    level = plane_level(dj, flip=True)
    right = level.points.positions[:, 0] > 1.05
    np.testing.assert_array_equal(level.turned, right[:, None] != right[level.neighbours])


def test_neighbours_agree_with_the_plain_search(dj):
    points = spread_on(dented_ball(), 1500)
    tangent = linefield.any_tangent(points.normals).astype(np.float32)
    level = samples.with_tables(points, tangent, np.ones(len(tangent), np.float32), dj)
    h = points.spacing
    for k, (dx, dy) in enumerate(samples.GRID):
        goal = points.positions + h * (dx * tangent + dy * level.across)
        square = ((goal[:, None] - points.positions) ** 2).sum(2)
        square += 9 * h**2 * ((points.normals[:, None] - points.normals) ** 2).sum(2)
        chosen = square[np.arange(len(goal)), level.neighbours[:, k]]
        # The candidates fill a disc of 4 spacings: a corner of the grid on a curved part may lie out.
        assert np.mean(chosen > square.min(axis=1) + 1e-5 * h**2) < (0.01 if k != samples.CENTRE else 1e-9)


def test_thin_wall_does_not_mix_its_sides(dj):
    wall = box(1.2, 1.2, 0.002)
    points = spread_on(wall, 3000)
    level = samples.with_tables(
        points, linefield.any_tangent(points.normals).astype(np.float32), points.normals[:, 0], dj
    )
    flat = np.abs(points.normals[:, 2]) > 0.9
    sides = points.normals[:, 2] > 0
    assert 0.4 < sides[flat].mean() < 0.6
    neighbours = level.neighbours[flat]
    assert (sides[neighbours] == sides[flat][:, None])[flat[neighbours]].all()
    # Paint one side red and the other blue: no query may see the other side's colour.
    painting = np.zeros((8, 16, 3), np.float32)
    painting[:, :8, 0], painting[:, 8:, 2] = 1, 1
    centre = np.where(points.normals[:, 2:] > 0, [[4.0, 4.0]], [[12.0, 4.0]]).astype(np.float32)
    zero = np.zeros(len(flat), np.int32)
    solution = lookup.PaintedSurface(
        points.positions,
        points.normals,
        level.tangent,
        zero,
        centre,
        points.spacing,
        (0.5, 0.5),
        painting,
        0 * centre[:, 0],
        zero,
        8.0,
        False,
    )
    rng = np.random.default_rng(3)
    xy = rng.uniform(-0.55, 0.55, (500, 2))
    for sign, channel in ((1, 0), (-1, 2)):
        p = np.concatenate([xy, np.full((500, 1), sign * 0.001)], axis=1).astype(np.float32)
        n = np.tile(np.array([0, 0, sign], np.float32), (500, 1))
        colour = lookup.colour(solution, p, n)
        assert colour[:, channel].min() > 0.999 and colour[:, 2 - channel].max() < 1e-3


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_lines_run_along_a_cylinder(axis):
    angle, height = np.meshgrid(np.arange(64) * 2 * np.pi / 64, np.linspace(-0.9, 0.9, 40))
    around = [0.3 * np.cos(angle), 0.3 * np.sin(angle)]
    coordinates = np.stack([*around, height], -1).reshape(-1, 3)
    positions = np.roll(coordinates, axis + 1, axis=1)
    normals = positions.copy()
    normals[:, axis] = 0
    faces = grid_faces(40, 64, wrap=True)
    pipe = mesh_of(positions, faces, normals / 0.3)
    points = spread_on(pipe, 3000)
    tangent, sure = linefield.directions(linefield.line_field(points), points)
    inside = np.abs(points.positions[:, axis]) < 0.7
    # A level cylinder is also lit from above, whose lines of equal tone run along it too; 0.97 is 14 degrees.
    assert np.quantile(np.abs(tangent[inside, axis]), 0.05) > 0.97
    assert sure[inside].mean() > 0.6
    np.testing.assert_allclose((tangent * points.normals).sum(axis=1), 0, atol=1e-4)


def test_transport_reproduces_the_palette(rng):
    palette = np.concatenate([rng.normal([0.3, 0.1, -0.3], 0.05, (3000, 3)), rng.normal([0.8, 0, 0.3], 0.1, (1500, 3))])
    points = spread_on(dented_ball(), 6000)
    tone = 0.5 + 0.5 * points.normals[:, 1]
    places = np.stack([tone, points.positions[:, 0], points.positions[:, 2]], axis=1).astype(np.float32)
    field = guides.colour_field(tone, places, np.ones(len(tone), bool), palette, rng)
    share = np.linspace(0.02, 0.98, 25)
    for direction in np.concatenate([np.eye(3), rng.normal(size=(5, 3))]):
        got, wanted = np.quantile(field @ direction, share), np.quantile(palette @ direction, share)
        # Exact on the axes (the last step); elsewhere iterated transport leaves a few per cent of the spread.
        assert np.abs(got - wanted).max() < 0.08 * (palette @ direction).std() * np.linalg.norm(direction) + 0.01
    rank = np.corrcoef(np.argsort(np.argsort(tone)), np.argsort(np.argsort(field[:, 0])))[0, 1]
    assert rank > 0.8  # light places are light


def test_hidden_places_take_no_share_of_the_palette(rng):
    points = spread_on(dented_ball(), 3000)
    palette = rng.normal([0.5, 0, 0], [0.2, 0.1, 0.1], (2000, 3))
    shown = points.normals[:, 1] > 0
    field = guides.colour_field(points.normals[:, 1], points.normals[:, [1, 0, 2]], shown, palette, rng)
    np.testing.assert_allclose(np.median(field[shown, 0]), np.median(palette[:, 0]), atol=0.01)
    assert field[~shown, 0].min() >= field[shown, 0].min()


def test_stroke_direction_of_stripes():
    x = np.arange(64)
    upright = np.tile(0.5 + 0.4 * np.sin(x * 0.8), (48, 1)).astype(np.float32)
    found = style.grain(upright)[8:-8, 8:-8]
    np.testing.assert_allclose(found[..., 0], -1, atol=0.02)  # 90 degrees, doubled: cos 180
    np.testing.assert_allclose(found[..., 1], 0, atol=0.02)
    slanted = (0.5 + 0.4 * np.sin((x[None] - x[:48, None]) * 0.6)).astype(np.float32)  # runs right and down
    np.testing.assert_allclose(style.grain(slanted)[8:-8, 8:-8, 1], 1, atol=0.05)
    exemplar = style.exemplar(style.prepare(np.repeat(upright[..., None], 3, 2)), 64, 0.5)
    level = style.page(exemplar, exemplar.grain, 1)[20:-20, 20:-20, 0]
    np.testing.assert_allclose(level, 1, atol=0.02)  # a quarter turn lays the stripes down


@pytest.mark.parametrize("turn", range(4))
def test_pages_and_solution_agree_on_quarter_turns(dj, turn):
    # Grey enough for the sharpened one to stay within 0..1.
    painting = 0.35 + 0.3 * np.random.default_rng(1).random((9, 13, 3)).astype(np.float32)
    page = np.rot90(style.for_bilinear(painting), turn)
    level = plane_level(dj, side=7)
    far = samples.as_points(level.points.positions * 20, level.points.normals, 0.1)
    level = replace(level, points=far)
    rng = np.random.default_rng(2)
    x, y = rng.integers(1, page.shape[1] - 1, 49), rng.integers(1, page.shape[0] - 1, 49)
    at = field.NearestNeighbourField(np.full(49, turn), x.astype(float), y.astype(float))
    made = lookup.painted_surface(level, at, (9, 13), painting)
    for u, v in ((0, 0), (1, 0), (0, 1), (-1, -1)):
        p = far.positions + 0.1 * (u * level.tangent + v * level.across)
        np.testing.assert_allclose(lookup.colour(made, p, far.normals), page[y + v, x + u], atol=2e-3)


def plain_weights(square: np.ndarray, piece: np.ndarray, crisp: float) -> np.ndarray:
    """Weights of eight samples, piece by piece: the piece's share of the votes to the power `crisp`, and within it the
    nearest; the four largest count."""
    votes, weight = np.exp(-(square - square[0]) / (2 * 0.9**2)), np.zeros(8)
    for label in np.unique(piece):
        mine = piece == label
        near = np.exp(-(square[mine] - square[mine].min()) / (2 * 0.25**2))
        weight[mine] = near / near.sum() * (votes[mine].sum() / votes.sum()) ** crisp
    weight[np.argsort(-weight)[4:]] = 0
    return weight / weight.sum()


def test_a_border_between_pieces_is_smooth_and_crisp():
    rng = np.random.default_rng(0)
    at = np.stack(np.meshgrid(np.arange(12.0), np.arange(12.0)), -1).reshape(-1, 2) + rng.uniform(-0.3, 0.3, (144, 2))
    piece = (at[:, 0] + 0.8 * (np.arange(144) % 2) > 6).astype(np.int32)  # a zigzag about x = 5.6
    query = np.stack(np.meshgrid(np.linspace(3, 8, 101), np.linspace(3, 8, 40)), -1).reshape(-1, 2)
    distance = np.linalg.norm(query[:, None] - at, axis=2)
    index = np.argsort(distance, axis=1)[:, :8]
    near = np.take_along_axis(distance, index, axis=1)
    roughness = {}
    for crisp in (2.0, 8.0):
        chosen, weight = lookup.blended(near, index, piece, crisp)
        share = (weight * piece[chosen]).sum(axis=1).reshape(40, 101)
        roughness[crisp] = float(((share > 0.1) & (share < 0.9)).mean())
        voted = (share > 0.5).argmax(axis=1)
    single = (piece[index[:, 0]].reshape(40, 101) > 0).argmax(axis=1)
    assert np.abs(np.diff(voted)).mean() < 0.6 * np.abs(np.diff(single)).mean()
    assert roughness[8.0] < 0.5 * roughness[2.0]


def test_lookup_agrees_with_the_plain_formula(painted, rng):
    mesh, _, solution = painted
    face = rng.integers(0, len(mesh.faces), 300)
    bary = rng.dirichlet([1, 1, 1], 300)
    p = np.einsum("nk,nkc->nc", bary, mesh.positions[mesh.faces[face]]).astype(np.float32)
    n = samples.unit(np.einsum("nk,nkc->nc", bary, mesh.corner_normals[face])).astype(np.float32)
    h, across = solution.spacing, np.cross(solution.tangent, solution.normals)
    square = ((p[:, None] - solution.positions) ** 2).sum(2) + 9 * h**2 * ((n[:, None] - solution.normals) ** 2).sum(2)
    nearest = np.argsort(square, axis=1)[:, :8]
    weight = np.array(
        [
            plain_weights(s / h**2, solution.piece[j], solution.crisp)
            for s, j in zip([s[j] for s, j in zip(square, nearest, strict=True)], nearest, strict=True)
        ]
    )
    expected = np.zeros((300, 3))
    size, sharp = solution.painting.shape[:2], style.for_bilinear(solution.painting)
    for k in range(8):
        j = nearest[:, k]
        step = p - solution.positions[j]
        u, v = (step * solution.tangent[j]).sum(1) / h, (step * across[j]).sum(1) / h
        t = solution.turn[j]
        right, down = np.choose(t, [u, -v, -u, v]), np.choose(t, [v, u, -v, -u])
        x = (solution.centre[j, 0] + right * solution.scale[0] - 0.5).clip(0, size[1] - 1)
        y = (solution.centre[j, 1] + down * solution.scale[1] - 0.5).clip(0, size[0] - 1)
        picked = cv2.remap(
            sharp,
            x.astype(np.float32)[None],
            y.astype(np.float32)[None],
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_REPLICATE,
        )[0]
        expected += weight[:, k : k + 1] * picked
    expected = expected.clip(0, 1)
    # cv2.remap rounds positions to 1/32 px, which moves a colour by at most 1/32 of the step between two pixels.
    assert np.abs(lookup.colour(solution, p, n) - expected).mean() < 5e-3
    assert np.abs(lookup.colour(solution, p, n) - expected).max() < 0.07


def test_lookups_between_pixels_come_nearer_to_the_picture(rng):
    """A random field known everywhere: bilinear lookups of its samples blur, those of `for_bilinear` much less."""
    field = np.fft.irfft2(np.fft.rfft2(rng.normal(size=(512, 512))) * (np.hypot(*np.meshgrid(
        np.fft.rfftfreq(512), np.fft.fftfreq(512))) < 0.06)).astype(np.float32)  # fmt: skip
    samples_of = np.ascontiguousarray(field[::4, ::4])  # up to 0.24 cycles a pixel
    y, x = rng.integers(16, 496, (2, 4000))

    def wrong(picture):
        at = (x / 4).astype(np.float32)[None], (y / 4).astype(np.float32)[None]
        return np.sqrt(np.mean((cv2.remap(picture, *at, cv2.INTER_LINEAR)[0] - field[y, x]) ** 2)) / field.std()

    plain, better = wrong(samples_of), wrong(style.for_bilinear(samples_of))
    assert better < 0.6 * plain, (plain, better)
    ramp = np.tile(np.arange(20, dtype=np.float32), (20, 1))
    np.testing.assert_allclose(style.for_bilinear(ramp)[:, 2:-2], ramp[:, 2:-2], atol=1e-5)


def test_footprint_averages(painted):
    _, _, solution = painted
    sharp = lookup.colour(solution, solution.positions, solution.normals)
    soft = lookup.colour(solution, solution.positions, solution.normals, footprint=4 * solution.spacing)
    assert soft.std(axis=0).mean() < 0.8 * sharp.std(axis=0).mean()
    np.testing.assert_allclose(soft.mean(axis=0), sharp.mean(axis=0), atol=0.03)


def small_search(dj, rng):
    """A level of the dented ball with random guides, its book and random places."""
    points = spread_on(dented_ball(), 600)
    tangent, sure = linefield.directions(linefield.line_field(points), points)
    level = samples.with_tables(points, tangent, sure, dj)
    exemplar = style.exemplar(style.prepare(strokes()), 40, 0.5)
    count = len(sure)
    described = rng.normal(0, 0.1, (len(exemplar.lab), kernels.WIDTH)).astype(np.float32)
    asked = rng.normal(0, 0.1, (count, kernels.WIDTH)).astype(np.float32)
    described[:, 22:], asked[:, 23] = 0, 0
    asked[:, 22] = rng.uniform(0.2, 1, count)
    weight = rng.random(count).astype(np.float32)
    start = field.from_pixels(exemplar, np.sort(rng.choice(np.flatnonzero(exemplar.allowed), count)))
    arrays = field.exemplar_arrays(dj, exemplar, kernels.floats(dj, exemplar.lab), described)
    return level, exemplar, described, asked, weight, start, arrays


def plain_cost(level, exemplar, described, asked, weight, use, choice, at, coherence, variety, full=2.0):
    """The search cost of places `at`, neighbours standing at `choice`; see mistyle.stylization.surface.synthesis."""
    pixel = (
        exemplar.starts[at.page] + np.rint(at.y).astype(int) * exemplar.shapes[at.page, 1] + np.rint(at.x).astype(int)
    )
    gap = asked - described[pixel]
    cost = (gap[:, :21] ** 2).sum(1) + weight * gap[:, 21] ** 2 + variety * use[exemplar.origin[pixel]]
    for k in (7, 11, 13, 17):
        j, turned = level.neighbours[:, k], level.turned[:, k]
        page = choice.page[j]
        x, y = choice.x[j] + level.offsets[:, k, 0], choice.y[j] + level.offsets[:, k, 1]
        height, width = exemplar.shapes[page].T
        x, y = np.where(turned, width - 1 - x, x), np.where(turned, height - 1 - y, y)
        page = np.where(turned, (page + 2) % 4, page)
        jump = np.minimum((x - at.x) ** 2 + (y - at.y) ** 2, 4) / 4
        height, width = exemplar.shapes[page].T
        column, row = np.rint(np.clip(x, 2, width - 3)).astype(int), np.rint(np.clip(y, 2, height - 3)).astype(int)
        other = described[exemplar.starts[page] + row * width + column]
        apart = ((described[pixel] - other)[:, :8] ** 2).sum(axis=1)
        seam = 0.3 + 0.7 * np.minimum(apart / full, 1)
        cost = cost + coherence * asked[:, 22] * seam * np.where(page == at.page, jump, 1)
    return cost


def test_search_lowers_the_cost_it_states(dj, rng):
    level, exemplar, described, asked, weight, start, arrays = small_search(dj, rng)
    table = kernels.tables(dj, level.neighbours, level.turned, level.offsets)
    used = field.usage(exemplar, start)
    use, targets = (
        kernels.floats(dj, used),
        kernels.TargetDescriptors(kernels.floats(dj, asked), kernels.floats(dj, weight)),
    )
    prices = kernels.floats(dj, np.array([0.005, 0.003, 1 / 2.0]))
    place = field.on_device(dj, start)
    cost, found = kernels.search(dj, table, arrays, place, targets, kernels.Prices(prices, use))
    found = field.on_host(found)
    args = (level, exemplar, described, asked, weight, used, start)
    before, after = plain_cost(*args, start, 0.005, 0.003), plain_cost(*args, found, 0.005, 0.003)
    np.testing.assert_allclose(cost.numpy(), after, atol=1e-5)
    assert (after <= before + 1e-6).all() and after.mean() < 0.7 * before.mean()
    size = exemplar.shapes[found.page]
    assert (found.y >= 2).all() and (found.x >= 2).all()
    assert (found.y <= size[:, 0] - 3).all() and (found.x <= size[:, 1] - 3).all()


def test_exhaustive_search_finds_the_least_cost(dj, rng):
    _, exemplar, described, asked, weight, _, _ = small_search(dj, rng)
    extra = rng.random(len(described)).astype(np.float32) * 0.05
    found = synthesis.exhaustive(asked, weight, described, extra, exemplar)
    gap = asked[:, None] - described[None, exemplar.allowed]
    costs = (gap[..., :21] ** 2).sum(2) + weight[:, None] * gap[..., 21] ** 2 + extra[exemplar.allowed]
    best = field.from_pixels(exemplar, np.flatnonzero(exemplar.allowed)[costs.argmin(axis=1)])
    same = (found.page == best.page) & (found.x == best.x) & (found.y == best.y)
    assert same.mean() > 0.99  # rounding may decide between equals


def test_patches_of_samples_and_pixels_are_described_alike(dj, rng):
    """A plane whose samples show a page pixel by pixel has that page's own descriptors."""
    level = plane_level(dj)
    picture = rng.random((21, 21, 3)).astype(np.float32)
    exemplar = style.exemplar(style.prepare(picture), 21, 0.5)
    basis = style.patch_basis(exemplar, rng)
    axes, mean, lab = kernels.floats(dj, basis.axes), kernels.floats(dj, basis.mean), kernels.floats(dj, exemplar.lab)
    of_pixels = kernels.describe_pixels(dj, lab, exemplar.shapes, axes, mean).numpy().reshape(-1, 16)
    table = kernels.tables(dj, level.neighbours, level.turned, level.offsets)
    shown = style.page(exemplar, exemplar.lab, 0)
    of_samples = kernels.describe(dj, table, kernels.floats(dj, shown), axes, mean).numpy().reshape(21, 21, 16)
    inner = style.page(exemplar, of_pixels, 0)[2:-2, 2:-2]
    np.testing.assert_allclose(of_samples[2:-2, 2:-2], inner, atol=1e-5)
    patch = np.stack([shown[10 + dy, 10 + dx] for dx, dy in samples.GRID.astype(int)]).reshape(-1)
    np.testing.assert_allclose(of_samples[10, 10], (patch - basis.mean) @ basis.axes, atol=1e-5)
    # Every sample votes for what its neighbours show: a page laid out pixel by pixel votes for itself.
    x, y = np.meshgrid(np.arange(21.0), np.arange(21.0))
    choice = field.NearestNeighbourField(
        np.zeros(441, np.int32), x.reshape(-1).astype(np.float32), y.reshape(-1).astype(np.float32)
    )
    arrays = field.exemplar_arrays(dj, exemplar, lab, np.zeros((len(exemplar.lab), kernels.WIDTH), np.float32))
    voted = kernels.vote(dj, table, arrays, field.on_device(dj, choice)).numpy().reshape(21, 21, 3)
    np.testing.assert_allclose(voted[4:-4, 4:-4], shown[4:-4, 4:-4], atol=1e-3)


def test_constant_painting_gives_a_constant_colour():
    grey = np.full((20, 30, 3), 0.4, np.float32)
    solution = solved(dented_ball(), grey, fixed_surface(samples=800), 0)
    np.testing.assert_allclose(lookup.colour(solution, solution.positions, solution.normals), 0.4, atol=1e-6)


def test_colours_are_mixtures_of_neighbouring_pixels():
    """A painting of pure red and pure blue: every answer lies on the line between the two."""
    rng = np.random.default_rng(4)
    red = cv2.resize((rng.random((12, 12)) > 0.5).astype(np.float32), (96, 96), interpolation=cv2.INTER_NEAREST)
    painting = np.stack([red, np.zeros_like(red), 1 - red], axis=2)
    solution = solved(dented_ball(), painting, fixed_surface(samples=1500), 0)
    colour = lookup.colour(solution, solution.positions, solution.normals)
    np.testing.assert_allclose(colour.sum(axis=1), 1, atol=1e-5)
    assert colour[:, 1].max() == 0 and 0.2 < colour[:, 0].mean() < 0.8
    assert np.mean((colour[:, 0] > 0.95) | (colour[:, 0] < 0.05)) > 0.6  # and most are the painting's own, unmixed


def test_transparent_parts_are_never_used():
    painting = strokes()
    alpha = np.ones(painting.shape[:2], np.float32)
    painting[:, :60], alpha[:, :60] = [1.0, 0.0, 1.0], 0
    solution = solved(dented_ball(), painting, fixed_surface(samples=1500), 0, alpha=alpha)
    assert solution.centre[:, 0].min() > 60
    colour = lookup.colour(solution, solution.positions, solution.normals)
    assert (np.abs(colour - [1.0, 0.0, 1.0]).max(axis=1) > 0.2).all()


def test_same_seed_same_bytes_other_seed_other_picture(painted):
    mesh, painting, first = painted
    done = []
    again = solved(mesh, painting, SMALL, 0, progress=done.append)
    for part in fields(first):
        one, other = (np.asarray(getattr(surface, part.name)) for surface in (first, again))
        assert one.tobytes() == other.tobytes(), part.name
    assert done == sorted(done) and done[-1] == pytest.approx(1.0)
    other = solved(mesh, painting, SMALL, 1)
    answers = [lookup.colour(s, mesh.positions[:500], mesh.corner_normals[:500, 0]) for s in (first, other)]
    assert np.abs(answers[0] - answers[1]).mean() > 0.02


def test_solution_survives_saving(painted, tmp_path):
    _, _, solution = painted
    save_record(tmp_path / "s", solution)
    back = load_record(tmp_path / "s")
    p, n = solution.positions[:100], solution.normals[:100]
    assert lookup.colour(back, p, n).tobytes() == lookup.colour(solution, p, n).tobytes()
    assert back.spacing == solution.spacing and back.scale == solution.scale


def test_detail_puts_dark_strokes_into_hollows(dj):
    mesh, painting = dented_ball(), strokes()
    darker = {}
    for weight in (0.0, 4.0):
        settings = fixed_surface(samples=3000, detail=weight, palette=0.3)
        solution = solved(mesh, painting, settings, 0)
        levels = synthesis.hierarchy(mesh, settings, 0, dj)
        wanted, depth = creases.creases(levels)[-1], creases.cavity_of(levels[-1])
        colour = lookup.colour(solution, solution.positions, solution.normals, footprint=2 * solution.spacing)
        darker[weight] = colour.mean() - colour[wanted < -0.8].mean()
        sunk, raised = depth > np.percentile(depth, 97), depth < np.percentile(depth, 3)
        assert wanted[sunk].mean() < -0.3 and wanted[raised].mean() > 0 and np.mean(np.abs(wanted) < 0.3) > 0.5
    assert darker[4.0] > 0.04 and darker[4.0] > darker[0.0] + 0.03


def test_strokes_keep_their_size_when_samples_change():
    sizes = [synthesis.finest_size(fixed_surface(samples=n)) for n in (15_625, 62_500, 250_000)]
    assert sizes == [128, 256, 512]  # the painting spans as many spacings as it has pixels; spacing falls as sqrt(1/n)
    assert synthesis.finest_size(fixed_surface(stroke_scale=2.0)) == 1024
    assert [synthesis.level_count(fixed_surface(samples=n)) for n in (1000, 62_500, 250_000, 1_000_000)] == [
        2,
        4,
        5,
        6,
    ]


@pytest.mark.parametrize(
    "picture",
    [strokes((16, 16)), strokes((20, 400)), np.repeat(strokes()[..., :1], 3, 2), strokes((4, 4))[:1, :1]],
    ids=["tiny", "strip", "grey", "one-pixel"],
)
def test_any_picture_will_do(picture):
    prepared = style.prepare(picture)
    assert min(prepared.opaque.shape) >= 8 and max(prepared.opaque.shape) <= 3 * min(prepared.opaque.shape) + 8
    solution = solved(sheet(), picture, fixed_surface(samples=600), 0)
    assert np.isfinite(lookup.colour(solution, solution.positions, solution.normals)).all()


def test_large_pictures_shrink_and_bad_ones_are_refused():
    assert style.prepare(np.zeros((1500, 4000, 3), np.float32)).rgb.shape == (768, 2048, 3)
    with pytest.raises(InputRefused, match="NaN"):
        style.prepare(np.full((10, 10, 3), np.nan, np.float32))
    with pytest.raises(InputRefused, match="transparent"):
        style.prepare(strokes(), alpha=np.zeros((96, 128), np.float32))


def test_occlusion_has_its_closed_forms():
    """The middle of a box's floor sees the open top under the form factor of a square above its centre."""
    room = box(1.0, 1.0, 1.0)
    keep = (
        np.abs(room.positions[room.faces][:, :, 1] - 0.5).max(axis=1) > 1e-6
    )  # all but the lid, which lies at y = 0.5
    open_box = mesh_of(room.positions, room.faces[keep])
    p, n = (
        np.array([[0.0, -0.499, 0.0], [0.0, 0.5, 0.0]], np.float32),
        np.tile(np.array([0.0, 1, 0], np.float32), (2, 1)),
    )
    got = occlusion.open_sky(open_box, p, n, rays=4096, distance=10)[:, 3]
    half = 0.5 / (0.999 - 0.002)  # half the side over the height left after the rays' lift
    corner = half / np.sqrt(1 + half**2) * np.arctan(half / np.sqrt(1 + half**2)) / np.pi
    assert got[0] == pytest.approx(4 * corner, abs=0.01)  # 4096 rays of a lattice: better than 1 / sqrt(4096)
    assert got[1] == 1.0
    assert occlusion.open_sky(open_box, p, n, rays=64, distance=0.3)[0, 3] == 1.0  # nothing within reach
    again = occlusion.open_sky(open_box, p, n, seed=7)
    assert (again == occlusion.open_sky(open_box, p, n, seed=7)).all()


def test_a_real_pair_shows_palette_strokes_and_form():
    import trimesh

    from mistyle.core.asset import Picture
    from mistyle.stylization.surface.painter import solve_surface

    loaded = trimesh.load(data("meshes/plain/spot.obj"), force="mesh")
    loaded.merge_vertices(merge_tex=True, merge_norm=True)
    positions = loaded.vertices - (loaded.vertices.max(0) + loaded.vertices.min(0)) / 2
    positions = positions / np.linalg.norm(positions, axis=1).max()
    mesh = mesh_of(positions, loaded.faces)
    path = data("styles/starry_night.jpg")
    picture = cv2.cvtColor(cv2.imread(str(path)), cv2.COLOR_BGR2RGB).astype(np.float32) / 255
    solution = solve_surface(mesh, Picture(picture, None, path), SurfaceSettings(samples=15_000), 0)
    colour = style.lab_from_srgb(lookup.colour(solution, solution.positions, solution.normals)[None])[0]
    reference = style.lab_from_srgb(style.resized(solution.painting, (102, 128))).reshape(-1, 3)
    # The palette: mean colour and spread within a fifth of the painting's lightness range.
    np.testing.assert_allclose(colour.mean(axis=0), reference.mean(axis=0), atol=0.1)
    assert 0.6 < colour[:, 0].std() / reference[:, 0].std() < 1.4
    # Strokes: places a pixel apart differ as neighbouring pixels do, neither blurred nor noise.
    light = style.lab_from_srgb(solution.painting)[..., 0]
    pixel = solution.spacing / max(solution.scale) * solution.tangent
    places = solution.positions + np.random.default_rng(0).random((len(colour), 1), np.float32) * pixel
    one, other = (lookup.colour(solution, p, solution.normals) for p in (places, places + pixel))
    one, other = (style.lab_from_srgb(c[None])[0, :, 0] for c in (one, other))
    assert 0.6 < np.abs(one - other).mean() / np.abs(np.diff(light, axis=1)).mean() < 1.1
    # And neighbouring samples as pixels that far apart.
    distance, near = KDTree(solution.positions).query(solution.positions, k=2)
    apart = round(float(distance[:, 1].mean()) / (solution.spacing / max(solution.scale)))
    step = np.abs(light[:, apart:] - light[:, :-apart]).mean()
    assert 0.5 < np.abs(colour[near[:, 1], 0] - colour[:, 0]).mean() / step < 2.0
    # No light: as light above as below. Form: hollows are darker than ridges.
    up = solution.normals[:, 1]
    assert abs(colour[up > 0.5, 0].mean() - colour[up < -0.5, 0].mean()) < 0.08
    around = KDTree(solution.positions).query(solution.positions, k=25)[1]
    height = (
        ((solution.positions[around] - solution.positions[:, None]) * solution.normals[:, None]).sum(axis=2).mean(1)
    )
    low, high = np.percentile(height, (10, 90))
    assert colour[height > high, 0].mean() < colour[height < low, 0].mean() - 0.05
