"""Equal rows against NumPy's own way."""

import numpy as np
import pytest

from mistyle.core.rows import distinct


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
