"""Light in an albedo: known ratios and correlations of albedos made by a known light."""

import numpy as np
import pytest

from mistyle.measure.baked_light import baked_light, correlation, texel_areas


def sphere(rng, count: int = 40_000) -> np.ndarray:
    normals = rng.normal(size=(count, 3))
    return normals / np.linalg.norm(normals, axis=1, keepdims=True)


def measured(light, normals, openness=None, area=None):
    n = len(normals)
    albedo = np.repeat(np.asarray(light, np.float64)[:, None], 3, axis=1)
    return baked_light(
        albedo, normals, np.ones(n) if openness is None else openness, np.ones(n) if area is None else area
    )


def test_a_flat_albedo_holds_no_light(rng):
    normals = sphere(rng)
    found = measured(np.full(len(normals), 0.3), normals, rng.random(len(normals)))
    assert found.ratio == pytest.approx(1) and found.strongest == 0


def test_a_painting_that_knows_nothing_of_the_surface_holds_no_light(rng):
    normals = sphere(rng)
    found = measured(rng.uniform(0.05, 0.9, len(normals)), normals, rng.random(len(normals)))
    # Four standard errors of a correlation of so many samples.
    assert found.ratio == pytest.approx(1, abs=0.03) and found.strongest < 4 / np.sqrt(len(normals))


def test_sky_light_is_the_ratio_of_its_means(rng):
    """Light 0.5 + 0.5 n_y: over n_y in (0.5, 1), evenly distributed on a sphere, the mean is 0.875; below 0.125."""
    normals = sphere(rng)
    found = measured(0.5 + 0.5 * normals[:, 1], normals)
    assert found.ratio == pytest.approx(7, rel=0.03)
    assert found.y > 0.8 and abs(found.x) < 0.03 and abs(found.z) < 0.03


def test_an_axis_of_the_normal_that_decides_the_logarithm_correlates_fully(rng):
    normals = sphere(rng)
    found = measured(np.exp(-1.5 * normals[:, 0] - 2), normals)
    assert found.x == pytest.approx(-1, abs=1e-6) and found.strongest == pytest.approx(1, abs=1e-6)
    open_sky = rng.random(len(normals))
    assert measured(np.exp(open_sky - 2), normals, open_sky).openness == pytest.approx(1, abs=1e-6)


def test_samples_count_by_their_area():
    """Two places face up, 0.8 and 0.2, one down, 0.2; the dark one above has three times the area of the light one."""
    normals = np.array([[0, 1, 0], [0, 1, 0], [0, -1, 0]], float)
    light, area = [0.8, 0.2, 0.2], np.array([1.0, 3.0, 1.0])
    assert measured(light, normals, area=area).ratio == pytest.approx((0.8 + 3 * 0.2) / 4 / 0.2)
    assert measured(light, normals).ratio == pytest.approx(0.5 / 0.2)


def test_a_surface_that_never_faces_down_has_no_ratio():
    normals = np.array([[0, 1, 0], [1, 0, 0]], float)
    assert measured([0.5, 0.2], normals).ratio is None


def test_weights_are_repetitions(rng):
    a, b, times = rng.random(50), rng.random(50), rng.integers(1, 5, 50)
    repeated = np.corrcoef(np.repeat(a, times), np.repeat(b, times))[0, 1]
    assert correlation(a, b, times.astype(float)) == pytest.approx(repeated)


def test_texels_share_the_area_of_their_face():
    areas = texel_areas(np.array([0, 0, 2, 0, 2]), np.array([3.0, 5.0, 1.0]))
    np.testing.assert_allclose(areas, [1, 1, 0.5, 1, 0.5])
