"""The atlas: coverage, interpolation, wrapping, padding and start maps, against areas and closed forms."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import Delaunay

from mistyle.atlas import texels as atlas
from mistyle.atlas.texels import pad, pad_maps, rasterise, sharpen_in_place, start_maps
from mistyle.core.asset import Material
from mistyle.core.errors import InputRefused
from mistyle.core.maps import Maps, Texels, place_of, rows_of
from mistyle.core.mesh import Mesh
from mistyle.geometry.raster import fragments

# Float32 positions of size 1, interpolated from three corners.
ROUNDING = 2e-6


def centres(size: int) -> np.ndarray:
    """UV of every texel centre, rows from v = 1 down."""
    x = (np.arange(size) + 0.5) / size
    return np.stack(np.meshgrid(x, 1 - x), axis=-1)


def flat_mesh(uvs: np.ndarray, faces: np.ndarray, lift=lambda uv: np.c_[uv, np.zeros(len(uv))]) -> Mesh:
    """A mesh whose points are a function of their UV; each UV vertex is a vertex of the mesh."""
    corner_normals = np.broadcast_to(np.float32([0, 0, 1]), (*faces.shape, 3)).copy()
    positions = lift(uvs).astype(np.float32)
    return Mesh(
        positions, faces, corner_normals, uvs[faces].astype(np.float32), np.zeros(len(faces), np.int32), ("part",)
    )


def triangulation(seed: int, count: int) -> tuple[np.ndarray, np.ndarray]:
    """The unit square cut into random triangles; a third of the points lie on texel centres and borders of 1/16."""
    generator = np.random.default_rng(seed)
    points = generator.random((count, 2))
    points[::3] = np.round(points[::3] * 32) / 32
    points = np.unique(np.concatenate([[[0, 0], [0, 1], [1, 0], [1, 1]], points]).astype(np.float32), axis=0)
    return points, Delaunay(points.astype(np.float64)).simplices.astype(np.int64)


@given(seed=st.integers(0, 2**32 - 1), count=st.integers(1, 60))
@settings(max_examples=40)
def test_triangles_meet_without_gaps_or_overlaps(seed, count):
    uvs, faces = triangulation(seed, count)
    turned = faces[np.random.default_rng(seed).permutation(len(faces))]
    turned[::2] = turned[::2, ::-1]  # mirrored charts count like the others
    assert rasterise(flat_mesh(uvs, turned), 0, 16).covered.all()
    _, texel = fragments(uvs[turned].astype(np.float64) * 16, 16)
    assert len(np.unique(texel)) == len(texel) == 256


@given(seed=st.integers(0, 2**32 - 1), size=st.sampled_from([17, 64]))
@settings(max_examples=20)
def test_interpolation_reproduces_affine_functions_of_uv(seed, size):
    uvs, faces = triangulation(seed, 12)
    slope = np.array([[0.3, -0.2, 0.5], [0.1, 0.7, -0.4]])
    mesh = flat_mesh(uvs, faces, lambda uv: uv @ slope + 0.1)
    texels = rasterise(mesh, 0, size)
    assert np.abs(texels.position - (centres(size) @ slope + 0.1)).max() < ROUNDING


def test_normals_are_interpolated_and_unit():
    uvs = np.array([[0, 0], [1, 0], [0, 1]], np.float32)
    mesh = flat_mesh(uvs, np.array([[0, 1, 2]]))
    corner = np.eye(3, dtype=np.float32)[None]
    mesh = Mesh(mesh.positions, mesh.faces, corner, mesh.corner_uvs, mesh.part, mesh.parts)
    texels = rasterise(mesh, 0, 8)
    uv = centres(8)[texels.covered]
    expected = np.stack([1 - uv.sum(axis=1), uv[:, 0], uv[:, 1]], axis=1)
    expected /= np.linalg.norm(expected, axis=1, keepdims=True)
    assert np.abs(texels.normal[texels.covered] - expected).max() < ROUNDING
    assert not texels.normal[~texels.covered].any() and not texels.position[~texels.covered].any()


@given(seed=st.integers(0, 2**32 - 1))
@settings(max_examples=30)
def test_coverage_is_the_uv_area_within_the_border(seed):
    corners = np.random.default_rng(seed).random((1, 3, 2))
    uvs = corners[0].astype(np.float32)
    covered = rasterise(flat_mesh(uvs, np.array([[0, 1, 2]])), 0, 128).covered.sum()
    (ax, ay), (bx, by), (cx, cy) = uvs.astype(np.float64) * 128
    area = abs((bx - ax) * (cy - ay) - (cx - ax) * (by - ay)) / 2
    border = sum(np.hypot(*(np.roll(uvs, 1, axis=0) - uvs).T)) * 128
    # Texels that the border does not cross are counted exactly; it crosses at most sqrt(2) a texel's length, plus ends.
    assert abs(covered - area) <= 1.5 * border + 3


def test_rows_go_down_from_v_1():
    # A triangle in the corner u = 1, v = 1 covers the top right of the picture.
    uvs = np.array([[1, 0.5], [1, 1], [0.5, 1]], np.float32)
    covered = rasterise(flat_mesh(uvs, np.array([[0, 1, 2]])), 0, 8).covered
    assert covered[0, 7] and not covered[7].any() and not covered[:, 0].any()


def test_faces_outside_the_square_wrap_whole():
    square = np.array([[0.1, 0.2], [0.6, 0.2], [0.6, 0.9], [0.1, 0.9]], np.float32)
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    here = rasterise(flat_mesh(square, faces), 0, 40)
    for du, dv in ((-0.5, 0), (0.75, 0), (0, -0.75), (0.5, 0.5), (-1, 1)):
        # The surface stays the same, only its texels move; shifts by quarters keep the centres where they were.
        shifted = flat_mesh(square + np.float32([du, dv]), faces, lambda uv, d=(du, dv): np.c_[uv - d, 0 * uv[:, 0]])
        there = rasterise(shifted, 0, 40)
        shift = (round(-dv * 40), round(du * 40))
        assert np.array_equal(there.covered, np.roll(here.covered, shift, axis=(0, 1)))
        assert np.abs(there.position - np.roll(here.position, shift, axis=(0, 1))).max() < ROUNDING


def test_the_first_face_has_shared_texels():
    uvs = np.array([[0, 0], [1, 0], [0, 1], [0, 0], [1, 0], [1, 1]], np.float32)
    mesh = flat_mesh(uvs, np.array([[0, 1, 2], [3, 4, 5]]), lambda uv: np.c_[uv, np.repeat([0.0, 0.5], 3)])
    texels = rasterise(mesh, 0, 32)
    assert texels.face[28, 16] == 0 and texels.position[28, 16, 2] == 0  # under both
    assert texels.face[16, 30] == 1 and texels.face[16, 2] == 0
    swapped = Mesh(mesh.positions, mesh.faces[::-1], mesh.corner_normals, mesh.corner_uvs[::-1], mesh.part, mesh.parts)
    assert rasterise(swapped, 0, 32).position[28, 16, 2] == 0.5


def test_only_the_part_is_drawn_and_faces_keep_their_numbers():
    uvs, faces = triangulation(3, 5)
    mesh = flat_mesh(uvs, np.concatenate([faces, faces]))
    part = np.repeat([0, 1], len(faces)).astype(np.int32)
    mesh = Mesh(mesh.positions, mesh.faces, mesh.corner_normals, mesh.corner_uvs, part, ("a", "b"))
    assert set(np.unique(rasterise(mesh, 1, 32).face)) <= set(range(len(faces), 2 * len(faces)))


def test_islands_are_cut_by_seams_in_uv():
    # A strip of two quads; the second one's UVs are moved away, so the points they share do not join them.
    positions = np.array([[x, y, 0] for x in (0, 1, 2) for y in (0, 1)], np.float32)
    faces = np.array([[0, 2, 3], [0, 3, 1], [2, 4, 5], [2, 5, 3]])
    uvs = positions[:, :2][faces] / 4
    uvs[2:, :, 1] += 0.5
    normals = np.broadcast_to(np.float32([0, 0, 1]), (4, 3, 3)).copy()
    mesh = Mesh(positions, faces, normals, uvs.astype(np.float32), np.zeros(4, np.int32), ("part",))
    texels = rasterise(mesh, 0, 32)
    assert np.array_equal(texels.island >= 0, texels.covered)
    assert set(np.unique(texels.island[texels.covered])) == {0, 1}
    assert (texels.island[texels.face == 0] == 0).all() and (texels.island[texels.face == 3] == 1).all()


def test_an_island_thinner_than_a_texel_still_gets_one():
    uvs = np.array([[0.1, 0.1], [0.4, 0.1], [0.4, 0.4], [0.701, 0.701], [0.702, 0.701], [0.702, 0.702]], np.float32)
    mesh = flat_mesh(uvs, np.array([[0, 1, 2], [3, 4, 5]]))
    texels = rasterise(mesh, 0, 20)
    own = texels.face == 1
    assert own.sum() == 1 and (texels.island[own] == 1).all()
    assert np.abs(texels.position[own][0] - [0.7015, 0.7015, 0]).max() < 0.001  # on the face, not at the texel's centre


@pytest.mark.parametrize("wrong", [np.nan, np.inf, 2.5, -1.1])
def test_unusable_uvs_are_refused(wrong):
    uvs = np.array([[0, 0], [1, 0], [wrong, 1]], np.float32)
    with pytest.raises(InputRefused, match="--uv new"):
        rasterise(flat_mesh(uvs, np.array([[0, 1, 2]])), 0, 8)


def test_the_thread_count_does_not_matter(monkeypatch):
    uvs, faces = triangulation(5, 40)
    mesh = flat_mesh(uvs, faces)
    monkeypatch.setattr(atlas, "ROWS", 256)
    many = rasterise(mesh, 0, 128)
    monkeypatch.setattr("os.sched_getaffinity", lambda _: {0}, raising=False)
    one = rasterise(mesh, 0, 128)
    for name in ("position", "normal", "face", "island"):
        assert getattr(many, name).tobytes() == getattr(one, name).tobytes()


def islands_at(size: int, *boxes: tuple[int, int, int, int]) -> Texels:
    """Texels with rectangular islands (top, bottom, left, right)."""
    island = np.full((size, size), -1, np.int32)
    for k, (top, bottom, left, right) in enumerate(boxes):
        island[top:bottom, left:right] = k
    zero = np.zeros((size, size, 3), np.float32)
    return Texels(zero, zero, island >= 0, island, island)


def test_padding_continues_islands_as_far_as_asked():
    texels = islands_at(100, (30, 60, 30, 60))
    values = np.where(texels.covered[..., None], np.float32([0.2, 0.4, 0.6]), np.float32(9))
    padded = pad(values, texels, 16)
    rows, columns = np.indices((100, 100))
    away = np.hypot(np.clip(30 - rows, 0, None) + np.clip(rows - 59, 0, None), 0)
    across = np.clip(30 - columns, 0, None) + np.clip(columns - 59, 0, None)
    distance = np.hypot(away, across)
    assert (padded[distance <= 16] == np.float32([0.2, 0.4, 0.6])).all()
    assert (padded[distance > 19] == 9).all()
    assert np.array_equal(values, np.where(texels.covered[..., None], np.float32([0.2, 0.4, 0.6]), np.float32(9)))


def test_padding_continues_what_an_island_has_of_its_own(rng):
    texels = islands_at(60, (20, 40, 20, 40))
    maps = Maps(*(rng.random((60, 60, *c)).astype(np.float32) for c in ((3,), (3,), (), ())), texels.covered)
    padded = pad_maps(maps, texels, 8, own=1)
    for name in ("albedo", "normal", "roughness", "metallic"):
        before, after = getattr(maps, name), getattr(padded, name)
        np.testing.assert_array_equal(after[19:41, 19:41], before[19:41, 19:41])
        np.testing.assert_array_equal(after[12:19, 30], np.broadcast_to(before[19, 30], after[12:19, 30].shape))


def test_padding_takes_the_nearest_texel_and_leaves_covered_ones(rng):
    texels = islands_at(60, (5, 25, 5, 55), (32, 55, 5, 55))
    values = rng.random((60, 60)).astype(np.float32)
    padded = pad(values, texels, 16)
    assert np.array_equal(padded[texels.covered], values[texels.covered])
    assert np.array_equal(padded[25:28, 5:55], np.broadcast_to(values[24, 5:55], (3, 50)))
    assert np.array_equal(padded[29:32, 5:55], np.broadcast_to(values[32, 5:55], (3, 50)))
    assert np.array_equal(pad(values, texels, 0), values)


def test_sharpening_stays_within_islands_and_knows_no_bands(rng, monkeypatch):
    texels = islands_at(60, (5, 25, 5, 55), (25, 55, 5, 55), (0, 3, 0, 60))
    was = (0.4 + 0.2 * rng.random((60, 60, 3))).astype(np.float32)
    once = was.copy()
    sharpen_in_place(once, texels)
    assert np.array_equal(once[~texels.covered], was[~texels.covered])
    # Where all neighbours are of the island: less a twelfth of the second differences.
    second = was[1:-1, :-2] + was[1:-1, 2:] + was[:-2, 1:-1] + was[2:, 1:-1] - 4 * was[1:-1, 1:-1]
    inner = np.s_[6:24, 6:54]
    np.testing.assert_allclose(once[inner], was[inner] - second[5:23, 5:53] / 12, atol=1e-6)
    # A border of islands is no edge: what lies beyond does not count.
    other = was.copy()
    other[25:] = rng.random((35, 60, 3))
    sharpen_in_place(other, texels)
    assert np.array_equal(other[:25], once[:25]) and not np.array_equal(other[25:55], once[25:55])
    # Rows of any number at a time, and one channel.
    monkeypatch.setattr(
        atlas, "bands", lambda height, width: (slice(k, min(k + 7, height)) for k in range(0, height, 7))
    )
    again = was.copy()
    sharpen_in_place(again, texels)
    assert np.array_equal(again, once)
    grey = was[..., 0].copy()
    sharpen_in_place(grey, texels)
    assert np.array_equal(grey, once[..., 0])
    step = np.where(np.arange(60) < 30, 0.0, 1.0).astype(np.float32) * np.ones((60, 1), np.float32)
    sharpen_in_place(step, texels)
    assert step.min() == 0 and step.max() == 1


MATERIAL = Material("m", None, None, None, None, np.array([0.2, 0.4, 0.6], np.float32), 0.7, 0.3)


def test_start_maps_without_pictures_are_the_factors():
    maps = start_maps(MATERIAL, islands_at(8), 8)
    assert np.allclose(maps.albedo, [0.2, 0.4, 0.6]) and np.allclose(maps.roughness, 0.7)
    assert np.allclose(maps.metallic, 0.3) and np.array_equal(maps.normal[2, 3], [0, 0, 1])
    assert not maps.known.any()
    assert not start_maps(MATERIAL, islands_at(8), 8, "zero").metallic.any()


def test_start_maps_take_the_asset_s_own_pictures(rng):
    albedo, rough = rng.random((16, 16, 3)).astype(np.float32), rng.random((32, 32)).astype(np.float32)
    normal = rng.normal(size=(8, 8, 3)).astype(np.float32)
    normal[..., 2] = 2
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    material = Material("m", albedo, normal, rough, None, np.ones(3, np.float32), 0.5, 0.0)
    maps = start_maps(material, islands_at(16), 16)
    assert np.array_equal(maps.albedo, albedo)  # same size: the very picture, not flipped
    assert np.allclose(maps.roughness, 0.5 * rough.reshape(16, 2, 16, 2).mean(axis=(1, 3)), atol=1e-6)
    assert np.allclose(np.linalg.norm(maps.normal, axis=-1), 1, atol=1e-5)
    assert maps.metallic.shape == (16, 16) and not maps.metallic.any()
    # Enlarged by two: a texel lies a quarter of a pixel from its picture's pixel, along both axes.
    corner = 0.75 * 0.75 * normal[3, 3] + 0.1875 * (normal[2, 3] + normal[3, 2]) + 0.0625 * normal[2, 2]
    assert np.allclose(maps.normal[6, 6], corner / np.linalg.norm(corner), atol=1e-5)


def test_pad_maps_pads_every_map(rng):
    texels = islands_at(32, (8, 24, 8, 24))
    maps = start_maps(MATERIAL, texels, 32)
    maps.roughness[:] = rng.random((32, 32))
    padded = pad_maps(maps, texels, 4)
    assert np.array_equal(padded.roughness[6, 10:20], maps.roughness[8, 10:20])
    assert np.array_equal(padded.roughness, pad(maps.roughness, texels, 4))


def test_a_row_of_the_table_of_all_sets_is_found_again_in_its_own():
    sizes = [(2, 3), (4, 1), (1, 5)]
    numbers = np.arange(15)
    for part, (rows, size) in enumerate(zip(rows_of(sizes), sizes, strict=True)):
        for (y, x), row in np.ndenumerate(numbers[rows].reshape(size)):
            assert place_of(int(row), sizes) == (part, y, x)
    assert rows_of(sizes)[-1].stop == 15
    with pytest.raises(IndexError, match="Row 15 "):
        place_of(15, sizes)
