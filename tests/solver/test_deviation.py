"""Stated standard deviations."""

import numpy as np
import pytest

from mistyle.atlas.neighbours import of_islands
from mistyle.solver.deviation import class_std
from mistyle.solver.table import Atlas

SIZE = 48
COUNT = SIZE * SIZE


def grid() -> Atlas:
    whole = np.ones((SIZE, SIZE), bool)
    return Atlas(((SIZE, SIZE),), (whole,), (np.arange(COUNT),), (of_islands(np.zeros((SIZE, SIZE), int)),))


@pytest.mark.parametrize("scatter", [0.003, 0.05])
def test_the_deviation_of_metallic_is_its_scatter_about_the_class(scatter: float) -> None:
    rng = np.random.default_rng(0)
    metal = np.arange(COUNT) % SIZE >= SIZE // 2
    away = np.abs(rng.normal(0, scatter, COUNT)).astype(np.float32)
    metallic = np.where(metal, 1 - away, away)
    std = class_std(metallic, np.full(COUNT, 0.1, np.float32), np.ones(COUNT, bool), grid())
    assert abs((away <= std).mean() - 0.683) < 0.02
    np.testing.assert_allclose(np.median(std), scatter, rtol=0.1)
