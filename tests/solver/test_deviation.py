"""Stated standard deviations, and tilts that they explain."""

import numpy as np
import pytest

from mistyle.atlas.neighbours import of_islands
from mistyle.solver.deviation import class_std, shrunk_tilts
from mistyle.solver.table import Atlas

SIZE = 48
COUNT = SIZE * SIZE


def grid() -> Atlas:
    whole = np.ones((SIZE, SIZE), bool)
    return Atlas(((SIZE, SIZE),), (whole,), (np.arange(COUNT),), (of_islands(np.zeros((SIZE, SIZE), int)),))


@pytest.mark.parametrize(("tilt", "least", "most"), [(0.0, 0.0, 0.25), (0.02, 0.4, 0.6), (0.2, 0.97, 1.0)])
def test_tilts_shrink_by_what_errors_explain(tilt: float, least: float, most: float) -> None:
    rng = np.random.default_rng(0)
    table = np.zeros((COUNT, 8), np.float32)
    table[:, 3:5] = rng.normal(0, np.hypot(tilt, 0.02), (COUNT, 2))
    std = np.full((COUNT, 7), 0.02, np.float32)
    found = shrunk_tilts(table, std, np.ones(COUNT, bool), grid())
    ratio = found[:, 3:5].std() / table[:, 3:5].std()
    assert least <= ratio <= most
    assert (found[:, [0, 1, 2, 5, 6, 7]] == table[:, [0, 1, 2, 5, 6, 7]]).all()


@pytest.mark.parametrize("scatter", [0.003, 0.05])
def test_the_deviation_of_metallic_is_its_scatter_about_the_class(scatter: float) -> None:
    rng = np.random.default_rng(0)
    metal = np.arange(COUNT) % SIZE >= SIZE // 2
    away = np.abs(rng.normal(0, scatter, COUNT)).astype(np.float32)
    metallic = np.where(metal, 1 - away, away)
    std = class_std(metallic, np.full(COUNT, 0.1, np.float32), np.ones(COUNT, bool), grid())
    assert abs((away <= std).mean() - 0.683) < 0.02
    np.testing.assert_allclose(np.median(std), scatter, rtol=0.1)
