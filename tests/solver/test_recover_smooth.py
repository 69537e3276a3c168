"""The neighbours' last word on tilt and roughness: what it minimises, what it leaves alone, and that it helps."""

from dataclasses import replace

import numpy as np
import pytest

from mistyle.atlas.neighbours import NONE, Links, Seam, of_islands, within
from mistyle.solver import smoothing
from mistyle.solver.table import Atlas

FLOOR = 0.04


def atlas(covered: np.ndarray, island: np.ndarray | None = None) -> Atlas:
    from mistyle.core.image import nearest

    island = np.where(covered, 0, -1) if island is None else island
    size = covered.shape[0], covered.shape[1]
    return Atlas((size,), (covered,), (nearest(covered)[0].ravel(),), (of_islands(island),))


def cut(covered: np.ndarray, column: int) -> Links:
    """A grid whose halves left and right of `column` are two islands that a seam joins where both are covered."""
    island = np.where(covered, (np.arange(covered.shape[1]) >= column).astype(int), -1)
    number = np.arange(covered.size).reshape(covered.shape)
    both = covered[:, column - 1] & covered[:, column]
    left, right = number[both, column - 1], number[both, column]
    all_ = np.ones(len(left), np.float32)
    seams = Seam(left, right, all_), Seam(right, left, all_), NONE, NONE
    return replace(atlas(covered, island).links[0], seams=seams)


def tables(tilt: np.ndarray, error: float | np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    table = np.zeros((tilt.size, 8), np.float32)
    table[:, :3], table[:, 5] = 0.5, 0.5
    table[:, 3] = tilt.ravel()
    return table, np.broadcast_to(np.asarray(error, np.float32).reshape(-1, 1), (tilt.size, 7)).astype(np.float32)


def waves(side: int, length: float) -> np.ndarray:
    y, x = np.mgrid[:side, :side] * (2 * np.pi / length)
    return 0.15 * np.sin(x) * np.cos(y + 0.4 * x)


def test_the_result_is_the_minimum_that_is_promised(rng: np.random.Generator):
    """Against the full matrix, with holes and a seam, over which differences count by 1 / WIDER."""
    size, column = (9, 12), 7
    covered = rng.random(size) < 0.9
    covered[:4, column - 2 : column + 2] = True
    found = rng.normal(0, 0.1, size).astype(np.float32)
    error = rng.uniform(0.01, 0.1, size).astype(np.float32)
    variance = rng.uniform(0.01, 0.02, size).astype(np.float32) ** 2
    number = np.arange(found.size).reshape(size)
    held = rng.uniform(0, 500, size).astype(np.float32)
    matrix, over = np.diag(1 / error.ravel().astype(np.float64) ** 2 + held.ravel()), 0
    for at, of, seams in ((number, variance, (column - 1, column)), (number.T, variance.T, ())):
        inside = covered.ravel()[at]
        for line, middle in np.argwhere(inside[:, :-2] & inside[:, 1:-1] & inside[:, 2:]) + (0, 1):
            row = np.zeros(number.size)
            row[at[line, middle - 1 : middle + 2]] = 0.5, -1, 0.5
            matrix += np.outer(row, row) / of[line, middle] / (smoothing.WIDER if middle in seams else 1)
            over += middle in seams
    assert over >= 8
    wanted = np.linalg.solve(matrix, (found / error.astype(np.float64) ** 2).ravel())
    field = smoothing.Field(slice(0, found.size), found, error, variance, held, cut(covered, column))
    got = smoothing._map_estimate(field).ravel()
    assert np.abs(got - wanted).max() < 2e-3 * np.abs(wanted - found.ravel()).max()


def test_a_seam_is_a_border_of_tilts_but_not_of_roughness():
    """Beside a seam roughness loses as much noise as within a chart, and without the seam less; tilts stay apart."""
    size, column, noise = (96, 64), 32, 0.03
    covered, true = np.ones(size, bool), 0.5 + waves(96, 40)[:, :64]

    def wrong(among: Links) -> tuple[float, np.ndarray]:
        noisy = true + np.random.default_rng(3).normal(0, noise, size)
        table, error = tables(noisy, noise)
        table[:, 5] = noisy.ravel()
        result = smoothing.map_smoothing(table, error, replace(atlas(covered), links=(among,)), FLOOR, True)
        beside = (result[:, 5].reshape(size) - true)[:, column - 1 : column + 1]
        return float(np.sqrt((beside**2).mean())), result[:, 3]

    sewn = cut(covered, column)
    (joined, tilt), (apart, same), (whole, _) = map(wrong, (sewn, within(sewn), atlas(covered).links[0]))
    assert joined < 1.1 * whole < 0.8 * apart
    assert np.array_equal(tilt, same)


def test_a_large_set_is_solved_in_bands_with_the_same_result(rng: np.random.Generator, monkeypatch):
    """With holes, unobserved regions and a seam along which both sides lie in every band."""
    size, column = (400, 48), 20
    covered = rng.random(size) < 0.97
    table, error = tables(0.1 * rng.normal(size=size) + waves(400, 90)[:, :48], 0.05)
    table[:, 5] = 0.5 + rng.normal(0, 0.05, covered.size)
    error[rng.random(len(error)) < 0.3] = 1.0
    where = replace(atlas(covered), links=(cut(covered, column),))
    whole = smoothing.map_smoothing(table, error, where, FLOOR, True)
    monkeypatch.setattr(smoothing, "WHOLE", 0)
    monkeypatch.setattr(smoothing, "BAND", 60 * 48)
    banded = smoothing.map_smoothing(table, error, where, FLOOR, True)
    moved = np.abs(whole - table).max()
    assert 0 < np.abs(banded - whole).max() < 2e-3 * moved


def test_noise_on_a_smooth_surface_goes(rng: np.random.Generator):
    true, noise = waves(96, 40), 0.03
    table, error = tables(true + rng.normal(0, noise, true.shape), noise)
    result = smoothing.map_smoothing(table, error, atlas(np.ones(true.shape, bool)), FLOOR, True)
    left = result[:, 3].reshape(true.shape) - true
    assert np.sqrt((left**2).mean()) < 0.5 * noise
    assert np.abs(result[:, [0, 1, 2, 6]] - table[:, [0, 1, 2, 6]]).max() < 1e-6


def test_noise_of_the_albedo_goes_but_a_print_that_is_known_stays(rng: np.random.Generator):
    noise, y = 0.03, np.mgrid[:96, :96][0]
    wavy, printed = 0.4 + waves(96, 40), np.where(y // 8 % 2, 0.7, 0.2)
    for true, error, most in ((wavy, noise, 0.5), (printed, 0.005, 1.05)):
        table, errors = tables(np.zeros(true.shape), error)
        table[:, :3] = (true + rng.normal(0, error, true.shape)).reshape(-1, 1)
        result = smoothing.map_smoothing(table, errors, atlas(np.ones(true.shape, bool)), FLOOR, True)
        assert np.sqrt(((result[:, :3] - true.reshape(-1, 1)) ** 2).mean()) < most * error


def test_metallic_that_is_left_open_is_none_or_all():
    """What is known stays, as does what lies far from both; diffuse reflectance stays, and a metal's colour."""
    table, noise = np.full((5, 8), 0.5, np.float32), np.full((5, 7), 0.5, np.float32)
    table[:, 6] = [0.1, 0.9, 0.1, 0.5, 1.0]
    noise[2, 6] = 0.001
    result = smoothing.binarise_metallic(table, noise)
    assert result[0, 6] < 0.02 and result[1, 6] > 0.98 and result[4, 6] == 1
    np.testing.assert_allclose(result[2:4, 6], [0.1, 0.5], atol=1e-4)
    dielectric = [0, 2]
    np.testing.assert_allclose(
        (result[:, :3] * (1 - result[:, 6:7]))[dielectric], (table[:, :3] * (1 - table[:, 6:7]))[dielectric], rtol=1e-5
    )
    assert (result[[1, 4], :3] == 0.5).all()


def test_a_rough_surface_that_is_known_stays(rng: np.random.Generator):
    true, noise = rng.normal(0, 0.15, (64, 64)), 0.01
    table, error = tables(true + rng.normal(0, noise, true.shape), noise)
    result = smoothing.map_smoothing(table, error, atlas(np.ones(true.shape, bool)), FLOOR, True)
    assert np.sqrt(((result[:, 3] - true.ravel()) ** 2).mean()) < 1.1 * noise


def test_what_nothing_was_seen_of_follows_the_slope_around_it(rng: np.random.Generator):
    true = waves(64, 60)
    error = np.full(true.shape, 0.003, np.float32)
    error[30:33, 20:40] = np.inf
    wrong = np.where(np.isinf(error), 0, true)
    table, error = tables(wrong, error)
    result = smoothing.map_smoothing(table, error, atlas(np.ones(true.shape, bool)), FLOOR, True)[:, 3].reshape(
        true.shape
    )
    hole = np.isinf(error[:, 3].reshape(true.shape))
    assert np.abs(result - true)[hole].mean() < 0.15 * np.abs(true)[hole].mean()
    assert np.abs(result - true)[~hole].max() < 0.01


def test_where_nothing_was_seen_tilts_do_not_lean_more_than_those_that_are_known(rng: np.random.Generator):
    """Steps on pictures moved them there; of roughness, whose mean is not known, what they found stays."""
    known = np.broadcast_to(np.abs(np.arange(64) - 32) > 8, (64, 64))
    found = np.where(known, rng.normal(0, 0.05, known.shape), 0.4)
    table, error = tables(found, np.where(known, 0.003, np.inf))
    table[:, 5] = 0.5 + table[:, 3]
    result = smoothing.map_smoothing(table, error, atlas(np.ones(known.shape, bool)), FLOOR, True)
    tilt, roughness = (result[:, c].reshape(known.shape) for c in (3, 5))
    assert np.abs(tilt[~known]).mean() < 0.06 and roughness[~known].mean() > 0.6
    assert np.abs(tilt - found)[known].max() < 0.005


def test_islands_do_not_mix_and_uncovered_texels_move_as_their_nearest(rng: np.random.Generator):
    side = 40
    island = np.full((side, side), -1)
    island[:, :18], island[:, 22:] = 0, 1
    true = np.where(island == 0, 0.2, -0.2)
    table, error = tables(true + rng.normal(0, 0.02, true.shape), 0.02)
    where = atlas(island >= 0, island)
    result = smoothing.map_smoothing(table, error, where, FLOOR, True)[:, 3].reshape(side, side)
    assert np.abs(result - true)[island >= 0].mean() < 0.01
    links = where.links[0]
    one = replace(links, right=links.right & (island[:, 1:] == 0), below=links.below & (island[1:] == 0))
    alone = replace(where, links=(one,))
    half = smoothing.map_smoothing(table, error, alone, FLOOR, True)[:, 3].reshape(side, side)
    assert np.allclose(half[:, :18], result[:, :18], atol=2e-4)
    moved = (result - table[:, 3].reshape(side, side)).ravel()
    uncovered = (island < 0).ravel()
    assert np.allclose(moved[uncovered], moved[where.closest[0][uncovered]], atol=1e-6)


@pytest.mark.parametrize("found", [0.0, 1.2])
def test_roughness_stays_what_it_may_be(found: float):
    table, error = tables(np.zeros((16, 16)), 0.01)
    table[:, 5] = found
    result = smoothing.map_smoothing(table, error, atlas(np.ones((16, 16), bool)), FLOOR, False)
    assert result[:, 5].min() >= FLOOR and result[:, 5].max() <= 1
