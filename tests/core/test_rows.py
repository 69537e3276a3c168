"""Equal rows against NumPy's own way, rows evenly chosen, medians of groups."""

import numpy as np
import pytest

from mistyle.core.rows import distinct, distinct_integers, evenly, weighted_medians


@pytest.mark.parametrize("kind", [np.int32, np.int64, np.float64])
@pytest.mark.parametrize("shape", [(0, 3), (1, 1), (500, 1), (3000, 4)])
def test_as_numpy_finds_them(rng, kind, shape):
    rows = rng.integers(-3, 3, shape).astype(kind)
    first, inverse = distinct(rows)
    if len(rows):
        expected = np.unique(rows, axis=0, return_index=True, return_inverse=True)
        np.testing.assert_array_equal(rows[first], expected[0])
        np.testing.assert_array_equal(first, expected[1])
        np.testing.assert_array_equal(inverse, expected[2].reshape(-1))
    else:
        assert first.size == inverse.size == 0


def test_zero_has_no_sign():
    first, inverse = distinct(np.array([[0.0, 1.0], [-0.0, 1.0]]))
    assert first.tolist() == [0] and inverse.tolist() == [0, 0]


def test_weighted_medians_by_group():
    group, values = np.array([2, 0, 2, 0, 2, 5]), np.array([0.9, 0.1, 0.2, 0.3, 0.5, 0.7], np.float32)
    rows, found = weighted_medians(group, values, np.array([1, 1, 1, 3, 1, 2.0]))
    assert rows.tolist() == [0, 2, 5] and np.allclose(found, [0.3, 0.5, 0.7])
    rows, found = weighted_medians(group[:0], values[:0], values[:0])
    assert len(rows) == len(found) == 0


def test_rows_are_chosen_evenly():
    assert evenly(0, 4) == [] and evenly(1, 4) == [0] and evenly(3, 8) == [0, 1, 2]
    assert evenly(11, 4) == [0, 3, 7, 10] and len(evenly(100, 48)) == 48


@pytest.mark.parametrize("values", [[], [3], [2, 2, 2], [5, -1, 5, 2**62, -1], [[4, 1], [1, 9]]])
def test_distinct_integers_are_those_of_unique(values):
    values = np.array(values, np.int64)
    assert np.array_equal(distinct_integers(values), np.unique(values))


def test_distinct_integers_of_many():
    values = np.random.default_rng(0).integers(-(10**12), 10**12, 50_000) // 10**8
    assert np.array_equal(distinct_integers(values), np.unique(values))
