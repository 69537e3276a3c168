"""The neighbours' last word on tilt and roughness: what it minimises, what it leaves alone, and that it helps."""

from dataclasses import replace

import numpy as np
import pytest

from mistyle.stages import recover_smooth as smoothing
from mistyle.stages.recover_solve import Atlas

FLOOR = 0.04


def atlas(covered: np.ndarray, island: np.ndarray | None = None) -> Atlas:
    from mistyle.core.image import nearest

    island = np.where(covered, 0, -1) if island is None else island
    return Atlas(
        sizes=((covered.shape[0], covered.shape[1]),),
        covered=(covered,),
        right=((island[:, :-1] == island[:, 1:]) & (island[:, 1:] >= 0),),
        below=((island[:-1] == island[1:]) & (island[1:] >= 0),),
        closest=(nearest(covered)[0].ravel(),),
    )


def tables(tilt: np.ndarray, error: float | np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    table = np.zeros((tilt.size, 8), np.float32)
    table[:, :3], table[:, 5] = 0.5, 0.5
    table[:, 3] = tilt.ravel()
    return table, np.broadcast_to(np.asarray(error, np.float32).reshape(-1, 1), (tilt.size, 7)).astype(np.float32)


def waves(side: int, length: float) -> np.ndarray:
    y, x = np.mgrid[:side, :side] * (2 * np.pi / length)
    return 0.15 * np.sin(x) * np.cos(y + 0.4 * x)


def test_the_result_is_the_minimum_that_is_promised(rng: np.random.Generator):
    covered = rng.random((9, 12)) < 0.9
    where, found = atlas(covered), rng.normal(0, 0.1, (9, 12)).astype(np.float32)
    error = rng.uniform(0.01, 0.1, (9, 12)).astype(np.float32)
    variance = (rng.uniform(0.01, 0.02, (9, 10)) ** 2, rng.uniform(0.01, 0.02, (12, 7)) ** 2)
    right, below = where.right[0], where.below[0]
    links = (right[:, :-1] & right[:, 1:], (below[:-1] & below[1:]).T)
    number = np.arange(9 * 12).reshape(9, 12)
    matrix = np.diag(1 / error.ravel().astype(np.float64) ** 2)
    for grid, link, of in ((number, links[0], variance[0]), (number.T, links[1], variance[1])):
        for line, middle in zip(*np.nonzero(link), strict=True):
            row = np.zeros(number.size)
            row[grid[line, middle : middle + 3]] = 0.5, -1, 0.5
            matrix += np.outer(row, row) / of[line, middle]
    wanted = np.linalg.solve(matrix, (found / error.astype(np.float64) ** 2).ravel())
    got = smoothing._likely(found, error, variance, links).ravel()
    assert np.abs(got - wanted).max() < 2e-3 * np.abs(wanted - found.ravel()).max()


def test_noise_on_a_smooth_surface_goes(rng: np.random.Generator):
    true, noise = waves(96, 40), 0.03
    table, error = tables(true + rng.normal(0, noise, true.shape), noise)
    result = smoothing.smoothed(table, error, atlas(np.ones(true.shape, bool)), FLOOR)
    left = result[:, 3].reshape(true.shape) - true
    assert np.sqrt((left**2).mean()) < 0.5 * noise
    assert np.array_equal(result[:, [0, 1, 2, 6]], table[:, [0, 1, 2, 6]])


def test_a_rough_surface_that_is_known_stays(rng: np.random.Generator):
    true, noise = rng.normal(0, 0.15, (64, 64)), 0.01
    table, error = tables(true + rng.normal(0, noise, true.shape), noise)
    result = smoothing.smoothed(table, error, atlas(np.ones(true.shape, bool)), FLOOR)
    assert np.sqrt(((result[:, 3] - true.ravel()) ** 2).mean()) < 1.1 * noise


def test_what_nothing_was_seen_of_follows_the_slope_around_it(rng: np.random.Generator):
    true = waves(64, 60)
    error = np.full(true.shape, 0.003, np.float32)
    error[30:33, 20:40] = np.inf
    wrong = np.where(np.isinf(error), 0, true)
    table, error = tables(wrong, error)
    result = smoothing.smoothed(table, error, atlas(np.ones(true.shape, bool)), FLOOR)[:, 3].reshape(true.shape)
    hole = np.isinf(error[:, 3].reshape(true.shape))
    assert np.abs(result - true)[hole].mean() < 0.15 * np.abs(true)[hole].mean()
    assert np.abs(result - true)[~hole].max() < 0.01


def test_islands_do_not_mix_and_uncovered_texels_move_as_their_nearest(rng: np.random.Generator):
    side = 40
    island = np.full((side, side), -1)
    island[:, :18], island[:, 22:] = 0, 1
    true = np.where(island == 0, 0.2, -0.2)
    table, error = tables(true + rng.normal(0, 0.02, true.shape), 0.02)
    where = atlas(island >= 0, island)
    result = smoothing.smoothed(table, error, where, FLOOR)[:, 3].reshape(side, side)
    assert np.abs(result - true)[island >= 0].mean() < 0.01
    alone = replace(where, right=(where.right[0] & (island[:, 1:] == 0),), below=(where.below[0] & (island[1:] == 0),))
    half = smoothing.smoothed(table, error, alone, FLOOR)[:, 3].reshape(side, side)
    assert np.allclose(half[:, :18], result[:, :18], atol=2e-4)
    moved = (result - table[:, 3].reshape(side, side)).ravel()
    uncovered = (island < 0).ravel()
    assert np.allclose(moved[uncovered], moved[where.closest[0][uncovered]], atol=1e-6)


@pytest.mark.parametrize("found", [0.0, 1.2])
def test_roughness_stays_what_it_may_be(found: float):
    table, error = tables(np.zeros((16, 16)), 0.01)
    table[:, 5] = found
    result = smoothing.smoothed(table, error, atlas(np.ones((16, 16), bool)), FLOOR)
    assert result[:, 5].min() >= FLOOR and result[:, 5].max() <= 1
