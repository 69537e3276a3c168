"""Resampling, masks and filters against closed forms and against scipy, which shares no code with OpenCV."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import ndimage

from mistyle.core.camera import pixel_centres
from mistyle.core.image import (
    bilinear,
    canny,
    dilate,
    dilate_within,
    distance_to,
    erode,
    gaussian,
    linear_from_srgb,
    luminance,
    nearest,
    nearest_fill,
    resize,
    srgb_from_linear,
)

ROUNDING = 2e-6  # float32 arithmetic on numbers up to 1
CHAMFER = 1.04  # what the 5x5 chamfer mask may lengthen a distance by (Borgefors 1986: 2 %; labels follow it)


def test_srgb_matches_the_standard():
    # IEC 61966-2-1 at the joint of its two pieces, at mid grey and at the ends.
    linear = np.array([0.0, 0.0031308, 0.21404114, 1.0], np.float32)
    encoded = np.array([0.0, 0.04045, 0.5, 1.0], np.float32)
    assert np.allclose(srgb_from_linear(linear), encoded, atol=1e-5)
    assert np.allclose(linear_from_srgb(encoded), linear, atol=1e-5)


def test_srgb_round_trip_and_clipping(rng):
    x = rng.uniform(0, 1, 1000).astype(np.float32)
    assert np.abs(linear_from_srgb(srgb_from_linear(x)) - x).max() < ROUNDING
    assert srgb_from_linear(np.array([-1.0, 2.0])).tolist() == [0, 1]


def test_luminance_of_the_primaries():
    assert np.allclose(luminance(np.eye(3, dtype=np.float32)), [0.2126, 0.7152, 0.0722])


def test_bilinear_at_pixel_centres_is_the_picture(rng):
    image = rng.uniform(size=(5, 7, 3)).astype(np.float32)
    centres = pixel_centres((5, 7)).reshape(-1, 2)
    for edge in ("clamp", "repeat"):
        assert np.abs(bilinear(image, centres, edge) - image.reshape(-1, 3)).max() < ROUNDING


def test_bilinear_reproduces_linear_functions(rng):
    centres = pixel_centres((8, 9))
    plane = (0.03 * centres[..., 0] - 0.05 * centres[..., 1] + 0.4).astype(np.float32)
    px = rng.uniform([0.5, 0.5], [8.5, 7.5], (200, 2))
    assert np.abs(bilinear(plane, px) - (0.03 * px[:, 0] - 0.05 * px[:, 1] + 0.4)).max() < ROUNDING


def test_bilinear_beyond_the_border():
    row = np.array([[1.0, 2.0, 4.0]], np.float32)
    px = np.array([[-3.0, 0.5], [0.0, 0.5], [3.0, 0.5], [4.5, 0.5]])
    assert bilinear(row, px, "clamp").tolist() == [1, 1, 4, 4]
    assert bilinear(row, px, "repeat").tolist() == [2.5, 2.5, 2.5, 2.0]


def test_resize_averages_areas(rng):
    image = rng.uniform(size=(12, 8, 3)).astype(np.float32)
    blocks = image.reshape(4, 3, 4, 2, 3).mean(axis=(1, 3))
    assert np.abs(resize(image, (4, 4)) - blocks).max() < ROUNDING
    # 5 pixels into 2: the middle one is shared half and half.
    assert np.allclose(
        resize(np.arange(5, dtype=np.float32)[None] * np.ones((5, 1), np.float32), (2, 2))[0], [0.8, 3.2]
    )


def test_resize_keeps_mean_and_copies_at_equal_size(rng):
    image = rng.uniform(size=(30, 30)).astype(np.float32)
    assert abs(resize(image, (7, 11)).mean() - image.mean()) < 1e-5
    same = resize(image, (30, 30))
    assert np.array_equal(same, image) and same is not image


def test_enlarging_a_repeating_picture_commutes_with_shifting_it(rng):
    image = rng.uniform(size=(6, 6, 2)).astype(np.float32)
    large = resize(image, (18, 18), "repeat")
    shifted = resize(np.roll(image, (2, -1), axis=(0, 1)), (18, 18), "repeat")
    assert np.abs(np.roll(large, (6, -3), axis=(0, 1)) - shifted).max() < ROUNDING
    assert np.abs(resize(image, (18, 18))[:, 0] - large[:, 0]).max() > 0.01  # clamping differs at the border


def test_gaussian_spreads_an_impulse_by_its_variance():
    image = np.zeros((61, 61), np.float32)
    image[30, 30] = 1
    blurred = gaussian(image, 4.0)
    offset = np.arange(61) - 30
    assert abs(blurred.sum() - 1) < 1e-5
    # Cut off at 3 sigma a Gaussian keeps 97.3 % of its variance.
    assert abs((blurred.sum(axis=0) * offset**2).sum() - 0.973 * 16) < 0.2
    assert np.array_equal(gaussian(image, 0), image)
    assert np.abs(gaussian(np.full((9, 9), 0.7, np.float32), 3) - 0.7).max() < ROUNDING


@given(seed=st.integers(0, 2**32 - 1), radius=st.integers(0, 4))
def test_dilate_and_erode_are_rank_filters(seed, radius):
    mask = np.random.default_rng(seed).random((23, 17)) < 0.2
    size = 2 * radius + 1
    assert np.array_equal(dilate(mask, radius), ndimage.maximum_filter(mask, size, mode="constant", cval=False))
    assert np.array_equal(erode(mask, radius), ndimage.minimum_filter(mask, size, mode="constant", cval=True))


@given(seed=st.integers(0, 2**32 - 1), radius=st.integers(0, 3))
def test_dilate_within_two_regions(seed, radius):
    # Two regions and a gap, with the mask in either: exact whenever a window meets at most two labels.
    generator = np.random.default_rng(seed)
    label = np.where(np.arange(20) < 9, 0, np.where(np.arange(20) < 11, -1, 1)) * np.ones((20, 1), int)
    mask = generator.random((20, 20)) < 0.1
    expected = np.zeros_like(mask)
    for k in (0, 1):
        expected |= dilate(mask & (label == k), radius) & (label == k)
    assert np.array_equal(dilate_within(mask, label, radius), expected)


@given(seed=st.integers(0, 2**32 - 1), share=st.floats(0.001, 0.5))
def test_nearest_finds_a_valid_pixel_about_as_near_as_can_be(seed, share):
    generator = np.random.default_rng(seed)
    valid = generator.random((40, 50)) < share
    valid[generator.integers(40), generator.integers(50)] = True
    index, distance = nearest(valid)
    row, column = np.unravel_index(index, valid.shape)
    exact = ndimage.distance_transform_edt(~valid)
    rows, columns = np.indices(valid.shape)
    found = np.hypot(rows - row, columns - column)
    assert valid[row, column].all()
    assert np.array_equal(index[valid], np.flatnonzero(valid))
    assert (found <= CHAMFER * exact + 0.5).all()
    assert np.abs(distance - exact).max() <= 0.04 * exact.max() + 0.5


def test_nearest_needs_something_valid():
    with pytest.raises(ValueError, match="no pixel"):
        nearest(np.zeros((3, 3), bool))


def test_nearest_fill(rng):
    values = rng.uniform(size=(6, 30, 3)).astype(np.float32)
    valid = np.zeros((6, 30), bool)
    valid[:, 10] = True
    filled = nearest_fill(values, valid)
    assert np.array_equal(filled[:, 10], values[:, 10])
    assert np.array_equal(filled, np.broadcast_to(values[:, 10:11], values.shape))
    assert np.array_equal(nearest_fill(values, np.zeros_like(valid)), values)


def test_distance_to_is_euclidean(rng):
    mask = rng.random((60, 70)) < 0.01
    assert np.abs(distance_to(mask) - ndimage.distance_transform_edt(~mask)).max() < 1e-3
    assert np.isinf(distance_to(np.zeros((4, 4), bool))).all()


def test_canny_finds_the_step_and_nothing_else():
    picture = np.full((40, 40, 3), 0.2, np.float32)
    assert not canny(picture).any()
    picture[:, 25:] = 0.9
    rows, columns = np.nonzero(canny(picture))
    assert set(columns) <= {24, 25} and len(set(rows)) >= 38
    # Steps whose Sobel gradient (4 times the step) stays below the lower threshold of 100 are not edges.
    weak = np.full((40, 40, 3), 0.2, np.float32)
    weak[:, 25:] = 0.2 + 20 / 255
    assert not canny(weak).any()
