"""Islands, whole-face shifts, tiles and overlaps, and the rasteriser that they are judged with."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mistyle.geometry.raster import fragments
from mistyle.geometry.uvs import arrange, group_rows, islands, judge, shift, signed_areas, tiles
from mistyle.io.read_mesh import read_mesh
from tests.support.helpers import data

# A shift adds an integer of at most a few tiles in float32: half a unit in the last place at 16.
SHIFT_ROUNDING = 1e-6


def grid(n: int, jitter: float = 0.0, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """The unit square as 2 n² triangles with inner vertices moved by up to `jitter` cells; points and corner UVs."""
    rng = np.random.default_rng(seed)
    x, y = np.meshgrid(np.arange(n + 1.0), np.arange(n + 1.0))
    at = np.stack([x, y], axis=-1)
    at[1:-1, 1:-1] += rng.uniform(-jitter, jitter, at[1:-1, 1:-1].shape)
    index = np.arange((n + 1) ** 2).reshape(n + 1, n + 1)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]
    faces = np.concatenate([np.stack([a, b, c], -1).reshape(-1, 3), np.stack([a, c, d], -1).reshape(-1, 3)])
    return faces, (at.reshape(-1, 2) / n)[faces].astype(np.float32)


def square(low: float, high: float, first: int) -> tuple[np.ndarray, np.ndarray]:
    """Two triangles over [low, high]² with points first, first + 1, ..."""
    faces, uvs = grid(1)
    return faces + first, (uvs * (high - low) + low).astype(np.float32)


def together(*parts: tuple[np.ndarray, np.ndarray]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points, UVs and equal areas."""
    points, uvs = (np.concatenate(x) for x in zip(*parts, strict=True))
    return points, uvs, np.ones(len(points))


@given(n=st.integers(1, 9), size=st.integers(3, 40), seed=st.integers(0, 1000))
def test_a_partition_of_the_square_covers_every_texel_once(n: int, size: int, seed: int) -> None:
    _, uvs = grid(n, 0.3, seed)
    _, texel = fragments(uvs.astype(np.float64) * size, size)
    assert np.array_equal(np.sort(texel), np.arange(size * size))


@given(st.integers(0, 10_000))
def test_fragments_are_the_centres_inside(seed: int) -> None:
    """Against the half-plane test; random corners leave no centre on an edge."""
    size = 24
    triangle = np.random.default_rng(seed).uniform(0, size, (1, 3, 2))
    a, b, c = triangle[0]
    x, y = np.meshgrid(np.arange(size) + 0.5, np.arange(size) + 0.5)

    def side(p: np.ndarray, q: np.ndarray) -> np.ndarray:
        return (q[0] - p[0]) * (y - p[1]) - (q[1] - p[1]) * (x - p[0])

    sides = np.stack([side(a, b), side(b, c), side(c, a)])
    inside = (sides > 0).all(axis=0) | (sides < 0).all(axis=0)
    assert np.array_equal(np.sort(fragments(triangle, size)[1]), np.flatnonzero(inside))


@given(st.integers(-3, 3), st.integers(-3, 3))
def test_fragments_repeat_with_the_texture(u: int, v: int) -> None:
    triangle = np.array([[[1.2, 2.1], [13.7, 3.3], [6.1, 14.2]]])
    moved = fragments(triangle + np.array([u, v]) * 16.0, 16)
    assert np.array_equal(np.sort(moved[1]), np.sort(fragments(triangle, 16)[1]))


def test_group_rows_numbers_equal_rows_alike(rng: np.random.Generator) -> None:
    rows = rng.integers(0, 4, (200, 3))
    group = group_rows(*rows.T)
    same = (rows[:, None] == rows[None]).all(axis=2)
    assert np.array_equal(group[:, None] == group[None], same)


def test_islands_are_separated_by_uv_seams() -> None:
    points, uvs = grid(4)
    halves = uvs.copy()
    halves[uvs.mean(axis=1)[:, 0] > 0.5] += [0.5, 0]  # same points, other UVs: a seam in the middle
    assert islands(points, uvs).max() == 0
    assert islands(points, halves).max() == 1
    assert islands(points, halves)[0] == 0  # numbered in face order


@given(
    st.lists(st.tuples(st.floats(-6, 6), st.floats(-6, 6), st.floats(0.05, 1.4)), min_size=1, max_size=6),
    st.integers(1, 3),
)
def test_shift_moves_whole_faces_by_integers(boxes: list[tuple[float, float, float]], n: int) -> None:
    faces, uvs = grid(n)
    points = np.concatenate([faces + 100 * k for k in range(len(boxes))])
    corner_uvs = np.concatenate([(uvs * w + np.array([u, v])).astype(np.float32) for u, v, w in boxes])
    island = islands(points, corner_uvs)
    moved = shift(corner_uvs, island)
    step = moved.astype(np.float64) - corner_uvs
    assert np.abs(step - np.round(step)).max() <= SHIFT_ROUNDING
    assert np.abs(np.round(step) - np.round(step)[:, :1]).max() == 0  # all corners of a face alike: none is torn
    assert np.abs(np.diff(moved, axis=1) - np.diff(corner_uvs, axis=1)).max() <= 2 * SHIFT_ROUNDING  # shapes stay
    assert moved.min() >= -1 and moved.max() <= 2
    for k in range(island.max() + 1):
        box = corner_uvs[island == k]
        if (np.ptp(box.reshape(-1, 2), axis=0) <= 1).all():
            assert len(np.unique(np.round(step[island == k]).reshape(-1, 2), axis=0)) == 1  # islands stay whole


def test_shift_leaves_what_lies_well_bit_equal() -> None:
    points, uvs, _ = together(square(0, 1, 0), square(-0.05, 0.9, 10))
    assert np.array_equal(shift(uvs, islands(points, uvs)), uvs)


def test_an_island_one_tile_away_comes_home() -> None:
    points, uvs, _ = together(square(0, 1, 0))
    assert shift(uvs + np.float32([3, -2]), islands(points, uvs)) == pytest.approx(uvs, abs=SHIFT_ROUNDING)


def test_separate_islands_can_be_painted() -> None:
    verdict = judge(*together(square(0.0, 0.45, 0), square(0.5, 0.95, 10)))
    assert verdict.usable and verdict.overlap == 0 and verdict.shared == 0
    assert verdict.coverage == pytest.approx(2 * 0.45**2, abs=0.003)  # 512² texel centres


@pytest.mark.parametrize(
    ("part", "reason"),
    [
        (square(0.2, 0.7, 10), "claimed by faces"),  # partly over the first
        (square(0.1, 0.3, 10), "claimed by faces"),  # wholly inside the first
        ((square(0, 1, 10)[0], np.full((2, 3, 2), 0.5, np.float32)), "no area"),
        ((square(0, 1, 10)[0], square(0, 3, 10)[1]), "claimed by faces"),  # repeats over itself
        ((square(0, 1, 10)[0], square(0, 30, 10)[1]), "repeats many times"),
    ],
)
def test_unusable_uvs_are_told(part: tuple[np.ndarray, np.ndarray], reason: str) -> None:
    verdict = judge(*together(square(0.0, 0.5, 0), part))
    assert not verdict.usable and reason in verdict.reason


def test_colour_swatches_are_unusable() -> None:
    verdict = judge(*together(square(0.5, 0.51, 0)))
    assert not verdict.usable and "of the texture" in verdict.reason


def test_stacked_and_mirrored_shells_share() -> None:
    faces, uvs = grid(6, 0.2)
    mirrored = uvs[:, [0, 2, 1]]  # the other side of a symmetric model: other points, turned winding, same UVs
    points, both, area = together((faces, uvs), (faces[:, [0, 2, 1]] + 1000, mirrored))
    verdict = judge(points, both, area)
    assert verdict.usable and verdict.overlap == 0
    assert verdict.shared == pytest.approx(1)
    assert verdict.mirrored == pytest.approx(0.5)


def test_mirrored_halves_cut_along_other_diagonals_share() -> None:
    """Quads of a mirrored half are usually split the other way."""
    faces, uvs = square(0.1, 0.9, 0)
    a, b, c, d = uvs[0, 0], uvs[0, 1], uvs[0, 2], uvs[1, 2]
    other = np.stack([np.stack([b, c, d]), np.stack([b, d, a])])
    points = np.concatenate([faces, np.array([[11, 12, 13], [11, 13, 10]])])
    verdict = judge(points, np.concatenate([uvs, other]), np.ones(4))
    assert verdict.usable and verdict.shared > 0.9


def test_an_island_folded_over_its_seam_shares() -> None:
    """Both halves of a symmetric body sewn together at the middle line: one island that lies on itself."""
    faces, uvs = grid(8)
    folded = uvs.copy()
    folded[..., 0] = np.abs(folded[..., 0] - 0.5)
    verdict = judge(faces, folded, np.ones(len(faces)))
    assert islands(faces, folded).max() == 0
    assert verdict.usable and verdict.shared > 0.9 and verdict.mirrored == pytest.approx(0.5)


def test_a_front_projection_of_a_closed_shape_is_unusable() -> None:
    """Front and back lie on top of each other, but no corner on another: nobody meant them to share."""
    faces, uvs = grid(8, 0.3, 1)
    back_faces, back_uvs = grid(7, 0.3, 2)
    border = np.float32(0.02)
    points, both, area = together((faces, uvs), (back_faces + 500, back_uvs[:, [0, 2, 1]] * (1 - 2 * border) + border))
    verdict = judge(points, both, area)
    assert not verdict.usable


def test_faces_stored_twice_share() -> None:
    faces, uvs = square(0.1, 0.9, 0)
    verdict = judge(np.concatenate([faces, faces[:, [0, 2, 1]]]), np.concatenate([uvs, uvs[:, [0, 2, 1]]]), np.ones(4))
    assert verdict.usable and verdict.shared == pytest.approx(0.5)


def test_udim_tiles_stay_one_set_each() -> None:
    points, uvs, area = together(square(0.05, 0.9, 0), square(0.1, 0.8, 10))
    uvs[2:] += np.float32([1, 1])  # tile 1012
    layout = arrange(points, uvs, area, None)
    assert layout.usable and layout.tile.tolist() == [1001, 1001, 1012, 1012]
    assert layout.uvs[2:] == pytest.approx(square(0.1, 0.8, 10)[1], abs=SHIFT_ROUNDING)
    assert not arrange(
        points, uvs, area, False
    ).usable  # one texture that repeats: they would claim each other's texels


def test_shells_parked_one_tile_away_share() -> None:
    faces, uvs = grid(4, 0.2)
    points, both, area = together((faces, uvs), (faces + 100, uvs + np.float32([1, 0])))
    layout = arrange(points, both, area, None)
    assert layout.usable and (layout.tile == 1001).all() and layout.verdicts[0].shared > 0.9
    assert np.unique(arrange(points, both, area, True).tile).tolist() == [1001, 1002]  # the textures are named so


def test_islands_across_tile_borders_are_no_udim() -> None:
    points, uvs, _ = together(square(0.5, 1.4, 0))
    assert tiles(uvs, islands(points, uvs)) is None


@pytest.mark.parametrize("over", [(-0.04, 0), (0.04, 0), (0, -0.04), (0, 0.04), (-0.04, 0.04)])
def test_an_island_a_little_beyond_a_named_tile_stays_in_it(over: tuple[float, float]) -> None:
    """Over each border of tile 1012, also where its corners all lie beyond it."""
    for size in (0.5, 1.06):
        points, uvs, area = together(square(0.05, 0.9, 0), square(0.0, size, 10))
        uvs[2:] += np.float32([1, 1]) + np.float32(over) + np.float32([0.5 * (k > 0) * (size < 1) for k in over])
        assert tiles(uvs, islands(points, uvs)) is None
        layout = arrange(points, uvs, area, True)
        assert layout.tile.tolist() == [1001, 1001, 1012, 1012] and layout.beyond > 0 and layout.astray == 0
        assert layout.uvs[2:] == pytest.approx(uvs[2:] - 1, abs=SHIFT_ROUNDING)
        assert (arrange(points, uvs, area, None).tile == 1001).all()  # no textures that say so


def test_named_tiles_hold_on_their_borders_and_for_a_single_tile() -> None:
    points, uvs, area = together(square(0.0, 1.0, 0))
    for tile in ((0, 0), (1, 0), (0, 1), (9, 9)):
        layout = arrange(points, uvs + np.float32(tile), area, True)
        assert (layout.tile == 1001 + tile[0] + 10 * tile[1]).all() and layout.beyond == layout.astray == 0
        assert layout.usable and layout.uvs == pytest.approx(uvs, abs=SHIFT_ROUNDING)


def test_the_faces_of_an_island_over_two_named_tiles_go_by_their_middles() -> None:
    points, uvs = grid(8)
    uvs = uvs * np.float32([2, 1])
    layout = arrange(points, uvs, np.ones(len(uvs)), True)
    assert np.array_equal(layout.tile, 1001 + (uvs[:, :, 0].mean(axis=1) > 1)) and layout.beyond == 0 and layout.usable
    layout = arrange(points, uvs + np.float32([0.1, 0]), np.ones(len(uvs)), True)
    assert set(layout.tile) == {1001, 1002} and 0 < layout.beyond < len(uvs)


def test_faces_in_no_named_tile_are_counted() -> None:
    points, uvs, area = together(square(0.1, 0.9, 0), square(0.1, 0.9, 10))
    uvs[:2] -= np.float32([3, 0])
    uvs[2:] += np.float32([1, 0])
    layout = arrange(points, uvs, np.array([1.0, 1, 3, 3]), True)
    assert layout.tile.tolist() == [1001, 1001, 1002, 1002] and layout.astray == 2
    layout = arrange(points, uvs, np.array([3.0, 3, 1, 1]), True)
    assert (layout.tile == 1001).all() and layout.astray == 2  # most of the area: the tiles are given up


def test_missing_uvs_are_told() -> None:
    points, uvs, area = together(square(0, 1, 0))
    uvs[1, 0, 0] = np.nan
    layout = arrange(points, uvs, area, None)
    assert not layout.usable and "no or infinite" in layout.verdicts[0].reason


def test_signed_areas_tell_mirrored_charts() -> None:
    _, uvs = grid(3)
    assert (signed_areas(uvs) > 0).all() and signed_areas(uvs).sum() == pytest.approx(1)
    assert signed_areas(uvs * np.float32([-1, 1])) == pytest.approx(-signed_areas(uvs))


@pytest.mark.parametrize(
    ("file", "how", "shared"),
    [
        ("meshes/plain/spot.obj", "kept", 0.0),  # one island spans u -0.05..0.99
        ("meshes/pbr/Avocado/Avocado.gltf", "kept", 0.0),
        ("meshes/pbr/Suzanne/02_suzanne.gltf", "kept", 0.0),
        ("meshes/pbr/WaterBottle/WaterBottle.gltf", "kept", 0.0),
        ("meshes/pbr/DamagedHelmet/DamagedHelmet.glb", "shifted", 1.0),  # v in 1..2, inner and outer shells share
    ],
)
def test_authored_uvs_survive(file: str, how: str, shared: float) -> None:
    asset = read_mesh(data(file), uv="keep")
    old = asset.source.old_uvs
    assert asset.source.uv == how and old is not None
    step = asset.mesh.corner_uvs - old
    assert np.abs(step - np.round(step)).max() <= SHIFT_ROUNDING
    assert (np.round(step) == np.round(step)[:, :1]).all()
    assert any("share 100%" in note for note in asset.source.notes) == (shared == 1.0)
