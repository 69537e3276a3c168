"""The struggle mask, the blend and the repair, against values worked out by hand."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import ndimage

from mistyle.core.maps import Maps, Texels, flat_maps
from mistyle.stylization.inpaint.fill import from_paint
from mistyle.stylization.inpaint.repair import blend_weights, radius, repair, struggle_mask
from mistyle.stylization.inpaint.settings import RepairSettings

BARE = RepairSettings(dilation=0, blend=0, smooth=0, outlier=0, agreement=0.3)


def texels_of(island: np.ndarray, position: np.ndarray | None = None) -> Texels:
    """An atlas lying flat in space, one unit a texel, unless told otherwise."""
    flat = np.stack([*np.indices(island.shape), np.zeros(island.shape)], axis=-1)
    place = (flat if position is None else position).astype(np.float32)
    normal = np.broadcast_to(np.float32([0, 0, 1]), place.shape).copy()
    return Texels(place, normal, island >= 0, island.astype(np.int32), island.astype(np.int32))


def one_island(size: int) -> Texels:
    return texels_of(np.zeros((size, size), int))


def two_islands(size: int) -> Texels:
    """Left and right of a gap two texels wide."""
    column = np.arange(size)[None, :] * np.ones((size, 1))
    return texels_of(np.where(column < size // 2 - 1, 0, np.where(column > size // 2, 1, -1)))


def disk(size: int, row: float, column: float, r: float) -> np.ndarray:
    rows, columns = np.indices((size, size))
    return np.hypot(rows - row, columns - column) < r


def random_maps(rng: np.random.Generator, size: int) -> Maps:
    maps = flat_maps(size)
    return replace(maps, albedo=rng.random((size, size, 3)).astype(np.float32), known=np.ones((size, size), bool))


def test_radius_is_a_share_of_the_atlas():
    assert [radius(0.004, size) for size in (64, 1024, 4096)] == [1, 4, 16]
    assert radius(0, 4096) == 0


def test_the_threshold_is_mean_plus_half_a_deviation():
    texels, seen = texels_of(np.array([[0, 0, 0, 0, -1]])), np.ones((1, 5), np.int32)

    def masked(*values: float, choice: RepairSettings = BARE) -> list[bool]:
        return struggle_mask(np.array([values], np.float32), seen.astype(np.float32), seen, texels, choice)[0].tolist()

    # Mean 3, std sqrt(11) = 3.317, threshold 4.658; what is not covered (1000) neither counts nor is masked.
    assert masked(0, 0, 4, 8, 1000) == [False, False, False, True, False]
    # Mean 3.25, std sqrt(11.6875) = 3.419, threshold 4.959.
    assert masked(0, 0, 5, 8, 1000) == [False, False, True, True, False]
    assert masked(0, 0, 4, 8, 0, choice=RepairSettings(deviations=0, dilation=0, smooth=0, outlier=0)) == [
        False,
        False,
        True,
        True,
        False,
    ]
    assert masked(7, 7, 7, 7, 7) == [False] * 5


def test_texels_looked_at_more_often_do_not_struggle_for_that():
    looks = np.arange(4, 13, dtype=np.float32).reshape(3, 3)
    seen, texels = np.ones((3, 3), int), one_island(3)
    assert not struggle_mask(0.25 * looks, looks, seen, texels, BARE).any()
    gradient = 0.25 * looks
    gradient[0, 0] = 4.0
    assert struggle_mask(gradient, looks, seen, texels, BARE).tolist() == [[True, False, False]] + [[False] * 3] * 2


def test_one_chance_look_says_little_and_none_nothing():
    looks = np.full((1, 6), 8, np.float32)
    looks[0, :2] = 0.1, 0  # of the median 8, a quarter (2) counts at least
    gradient = 0.25 * looks
    gradient[0, 0], gradient[0, 1], gradient[0, 5] = 1.0, 9.0, 16.0
    mask = struggle_mask(gradient, looks, np.ones((1, 6), int), texels_of(np.zeros((1, 6), int)), BARE)
    # Means 0.5, -, 0.25 three times, 2: only the last is above 0.65 + 0.5 * 0.68.
    assert mask.tolist() == [[False, False, False, False, False, True]]


def test_never_seen_texels_join_the_mask_and_stay_out_of_the_statistics():
    gradient, seen = np.array([[1, 1, 1, 2, 0]], np.float32), np.array([[1, 1, 1, 1, 0]])
    mask = struggle_mask(gradient, seen.astype(np.float32), seen, texels_of(np.array([[0, 0, 0, 0, 0]])), BARE)
    # Mean 1.25, std 0.433: 2 is above 1.47. With the unseen zero the mean would be 1, and 2 still above 1.32.
    assert mask.tolist() == [[False, False, False, True, True]]
    assert struggle_mask(
        gradient, 0.0 * gradient, 0 * seen, texels_of(np.array([[0, 0, 0, 0, -1]])), BARE
    ).tolist() == [[True] * 4 + [False]]


def test_the_mask_grows_by_its_share_and_stays_in_its_island():
    texels = two_islands(256)
    gradient = np.zeros((256, 256), np.float32)
    gradient[100, 124] = 1e4
    ones = np.ones((256, 256), int)
    mask = struggle_mask(gradient, ones.astype(np.float32), ones, texels, RepairSettings(dilation=3 / 256, smooth=0))
    expected = np.zeros_like(mask)
    expected[97:104, 121:127] = True  # a square of side 7, cut off where the island ends
    assert np.array_equal(mask, expected)


def test_a_place_struggles_and_noise_does_not(rng):
    """Twice the gradient over a patch, in noise of the same strength: thresholded texel by texel it would drown."""
    gradient = rng.exponential(1.0, (256, 256)).astype(np.float32)
    gradient[100:140, 60:110] += 1.0
    ones = np.ones((256, 256), int)
    texels, looks = one_island(256), ones.astype(np.float32)
    inside = np.zeros_like(ones, bool)
    inside[100:140, 60:110] = True
    alone = struggle_mask(gradient, looks, ones, texels, RepairSettings(smooth=0, dilation=0, outlier=0))
    around = struggle_mask(gradient, looks, ones, texels, RepairSettings(smooth=0.015, dilation=0, outlier=0))
    assert alone[~inside].mean() > 0.15 and around[~inside].mean() < 0.1
    assert around[inside].mean() > 0.95 > alone[inside].mean()


def test_blend_is_one_inside_zero_outside_and_falls_between():
    size, side = 200, 4
    texels, mask = one_island(size), disk(size, 100, 100, 40)
    weights = blend_weights(mask, np.ones_like(mask), texels, RepairSettings(blend=side / size))
    window = np.ones((2 * side + 1,) * 2, bool)
    outer, inner = ndimage.binary_dilation(mask, window), ndimage.binary_erosion(mask, window)
    assert (weights[inner] == 1).all() and (weights[~outer] == 0).all()
    band = outer & ~inner
    assert 0.3 < weights[band].mean() < 0.7
    profile = weights[100, 100:]
    assert (np.diff(profile) <= 0).all() and np.abs(np.diff(profile)).max() < 1.6 / (2 * side)


def test_the_border_of_an_island_is_no_edge_of_the_mask():
    texels = two_islands(100)
    mask = (texels.island == 0) & (np.indices((100, 100))[1] > 30)
    weights = blend_weights(mask, np.ones_like(mask), texels, RepairSettings(blend=0.03))
    assert (weights[:, 35:49] == 1).all()  # up to the seam
    assert not weights[texels.island == 1].any() and not weights[~texels.covered].any()
    assert ((weights[:, 29:31] > 0) & (weights[:, 29:31] < 1)).all()


def test_what_nobody_saw_is_replaced_whole():
    mask = disk(100, 50, 50, 20)
    known = ~disk(100, 50, 50, 20)
    weights = blend_weights(mask, known, one_island(100), RepairSettings(blend=0.05))
    assert (weights[mask] == 1).all() and 0 < weights[50, 71] < 1


@given(seed=st.integers(0, 2**32 - 1))
@settings(max_examples=10)
def test_texels_outside_the_dilated_mask_keep_their_bits(seed):
    generator = np.random.default_rng(seed)
    texels, maps = two_islands(96), random_maps(generator, 96)
    mask = disk(96, *generator.uniform(0, 96, 2), generator.uniform(1, 30)) & texels.covered
    choice = RepairSettings(blend=0.03)
    holes = []

    def paint(albedo, hole, atlas, rng):
        holes.append(hole)
        return np.full_like(albedo, 2.0)  # writes everywhere, hole or not

    fixed = repair(maps, mask, texels, paint, choice)
    outside = ~ndimage.binary_dilation(mask, np.ones((7, 7)))
    assert fixed.albedo[outside].tobytes() == maps.albedo[outside].tobytes()
    assert fixed.normal is maps.normal and fixed.roughness is maps.roughness and fixed.known is maps.known
    if mask.any():
        assert (holes[0] >= mask).all() and not holes[0][outside].any()
        assert (fixed.albedo[ndimage.binary_erosion(mask | ~texels.covered, np.ones((7, 7))) & mask] == 2).all()
        other = texels.island == 1 - texels.island[mask][0]
        if not (mask & other).any():
            assert fixed.albedo[other].tobytes() == maps.albedo[other].tobytes()


def test_an_empty_mask_changes_nothing(rng):
    maps = random_maps(rng, 16)
    paint = from_paint(np.zeros((16, 16, 3), np.float32))
    assert repair(maps, np.zeros((16, 16), bool), one_island(16), paint, RepairSettings()) is maps


@pytest.mark.parametrize("answer", [np.zeros((8, 8, 3), np.float32), np.full((16, 16, 3), np.nan, np.float32)])
def test_a_useless_inpainter_is_refused(rng, answer):
    with pytest.raises(ValueError, match="inpainter"):
        repair(random_maps(rng, 16), disk(16, 8, 8, 4), one_island(16), lambda *_: answer, RepairSettings())


def test_of_views_that_agree_nothing_stands_out():
    seen, texels = np.ones((1, 6), np.int32), texels_of(np.array([[0] * 6]))
    looks, limited = seen.astype(np.float32), BARE.model_copy(update={"outlier": 4.0})

    def masked(last: float, choice: RepairSettings) -> list[bool]:
        return struggle_mask(np.array([[1, 1, 1, 1, 1, last]], np.float32), looks, seen, texels, choice)[0].tolist()

    # Mean and deviation always find a largest one; it has to be four times the median.
    assert masked(3.9, BARE) == masked(4.1, BARE) == masked(4.1, limited) == [False] * 5 + [True]
    assert masked(3.9, limited) == [False] * 6


def test_a_large_gradient_that_all_looks_agree_on_is_no_contradiction():
    seen, texels = np.ones((1, 5), np.int32), texels_of(np.array([[0, 0, 0, 0, 0]]))
    gradient, looks = np.array([[1, 1, 1, 9, 9]], np.float32), seen.astype(np.float32)
    # The fourth is pulled one way by all its looks, the fifth to and fro; the first contradicts itself, but faintly.
    agreed = np.array([[0.1, 1, 1, 9, 2.7]], np.float32)
    assert struggle_mask(gradient, looks, seen, texels, BARE, agreed).tolist() == [[False] * 4 + [True]]
    paper = BARE.model_copy(update={"agreement": 1.0})
    assert struggle_mask(gradient, looks, seen, texels, paper, agreed).tolist() == [[False] * 3 + [True] * 2]
