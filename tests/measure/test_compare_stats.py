"""The test of two noisy renders keeps its level, finds what it should, and says where."""

import math

import numpy as np
import pytest

from mistyle.measure.pictures.statistics import interval, same_picture, slope


def renders(rng, count, mean, noise=0.2):
    """Gamma noise: positive and skewed, as light is."""
    shape = 1 / noise**2
    return (mean * rng.gamma(shape, 1 / shape, (count, *mean.shape))).astype(np.float32)


def gradient(height=33, width=46):
    """Sizes that no block divides."""
    return np.broadcast_to(np.linspace(0.1, 3, width)[None, :, None], (height, width, 3)).copy()


def test_the_level_is_kept(rng):
    """At level 0.2 about one in five pairs without a difference may fail: between 8 and 36 of 100 (p = 1e-3 each side,
    the test is conservative with few seeds)."""
    mean = gradient(16, 16)
    failures = sum(not same_picture(*renders(rng, 24, mean).reshape(2, 12, 16, 16, 3), 0.2).passed for _ in range(100))
    assert failures <= 36


def test_it_finds_a_spot_and_says_where(rng):
    mean = gradient()
    other = mean.copy()
    other[10:18, 20:28] *= 1.25
    found = same_picture(renders(rng, 12, mean, 0.1), renders(rng, 12, other, 0.1))
    assert not found.passed and found.rejected[12:16, 22:26].all()
    assert not found.rejected[:6].any() and not found.rejected[:, 36:].any()
    assert found.t.shape == (33, 46) and found.t[14, 24] > 5
    assert same_picture(renders(rng, 12, mean, 0.1), renders(rng, 12, mean, 0.1)).passed


def test_it_finds_a_faint_tint_of_everything(rng):
    mean = gradient()
    found = same_picture(renders(rng, 8, mean), renders(rng, 8, mean * 1.03))
    assert found.whole and not found.passed
    assert found.bias == pytest.approx(0.03, abs=0.01)


def test_pictures_without_noise(rng):
    mean = np.repeat(gradient()[None], 3, axis=0)
    assert same_picture(mean, mean).passed
    assert not same_picture(mean, mean * 1.1).passed
    black = np.zeros_like(mean)
    assert same_picture(black, black).passed and not same_picture(black, mean).passed
    with pytest.raises(ValueError, match="two of each"):
        same_picture(mean[:1], mean)


def test_interval_by_hand():
    """Student's t for two degrees of freedom at 95 % is 4.3027."""
    mean, half = interval([1.0, 2.0, 3.0])
    assert mean == 2 and half == pytest.approx(4.3027 / math.sqrt(3), rel=1e-4)
    assert math.isnan(interval([5.0])[1])


def test_slope_of_a_power():
    assert slope([1, 2, 4, 8], [3, 1.5, 0.75, 0.375]) == pytest.approx(-1)
    assert math.isnan(slope([1, 2], [0, 1]))
