"""Pieces of the painting that are copied as they stand: found, measured, and kept from growing."""

import numpy as np
import pytest

from mistyle.render.mitsuba import device
from mistyle.stylization.surface import field, kernels, pieces, synthesis
from mistyle.stylization.surface.exemplar import exemplar as style
from mistyle.stylization.surface.guides import guides
from tests.stylization.surface.test_surface import plain_cost, plane_level, small_search
from tests.support.helpers import fixed_surface


@pytest.fixture(scope="module")
def dj():
    device.use("llvm_ad_rgb")
    return kernels.module("llvm")


def faces_of_a_picture(size=128) -> np.ndarray:
    """Sixteen unlike "faces", each a 32 pixel square with shapes of its own, encoded sRGB."""
    rng = np.random.default_rng(3)
    picture = np.full((size, size, 3), 0.8, np.float32)
    for row in range(0, size, 32):
        for column in range(0, size, 32):
            picture[row + 4 : row + 28, column + 4 : column + 28] = rng.uniform(0.1, 0.9, 3)
            for _ in range(4):
                y, x = rng.integers(6, 22, 2)
                picture[row + y : row + y + 5, column + x : column + x + 5] = rng.uniform(0, 1, 3)
    return picture


@pytest.mark.parametrize("flip", [False, True])
def test_a_picture_laid_down_whole_is_one_piece(dj, flip):
    level = plane_level(dj, flip=flip)
    exemplar = style.exemplar(style.prepare(faces_of_a_picture()), 64, 0.5)
    row, column = np.divmod(np.arange(21 * 21), 21)
    page, x, y = np.zeros(21 * 21, np.int32), 10.0 + column, 20.0 + row
    if flip:  # there the tangents point the other way, and the same picture stands on the page turned over
        over = level.tangent[:, 0] < 0
        height, width = exemplar.size
        page, x, y = np.where(over, 2, page), np.where(over, width - 1 - x, x), np.where(over, height - 1 - y, y)
    choice = field.NearestNeighbourField(page, x, y)
    label = pieces.labels(level, exemplar, choice)
    assert (label == label[0]).all()
    at = pieces.on_picture(exemplar, field.pixels(exemplar, choice))
    np.testing.assert_allclose(at, np.stack([10 + column, 20 + row], 1) / 64, atol=1e-6)
    far = pieces.reach(label, at)
    assert far.max() == pytest.approx(np.hypot(10, 10) / 64, abs=1e-4) and far.min() < 0.2 / 64
    # Where the picture is cut and moved on by three pixels, another piece begins.
    x = np.where(column > 10, x + (-3 if flip else 3), x)
    assert len(np.unique(pieces.labels(level, exemplar, field.NearestNeighbourField(page, x, y)))) == 2


def test_near_the_end_of_a_piece_the_search_pays_for_staying(dj, rng):
    level, exemplar, described, asked, weight, start, arrays = small_search(dj, rng)
    table = kernels.tables(dj, level.neighbours, level.turned, level.offsets)
    used = field.usage(exemplar, start)
    use, targets = (
        kernels.floats(dj, used),
        kernels.TargetDescriptors(kernels.floats(dj, asked), kernels.floats(dj, weight)),
    )
    prices, place = kernels.floats(dj, np.array([0.005, 0.003, 1 / 2.0])), field.on_device(dj, start)

    def found(end: np.ndarray):
        limit = kernels.PatchSizeLimit(kernels.floats(dj, end.astype(np.float32)), kernels.floats(dj, np.array([6.0])))
        cost, chosen = kernels.search(dj, table, arrays, place, targets, kernels.Prices(prices, use, limit))
        return cost.numpy(), field.on_host(chosen)

    none = np.zeros(len(asked), bool)
    cost, chosen = found(none)
    plain, same = kernels.search(dj, table, arrays, place, targets, kernels.Prices(prices, use))
    assert np.array_equal(cost, plain.numpy()) and np.array_equal(chosen.x, field.on_host(same).x)
    cost, chosen = found(~none)
    expected = plain_cost(level, exemplar, described, asked, weight, used, start, chosen, 0.0, 0.003)
    for k in kernels.BESIDE:
        j, turned = level.neighbours[:, k], level.turned[:, k]
        height, width = exemplar.shapes[start.page[j]].T
        x, y = start.x[j] + level.offsets[:, k, 0], start.y[j] + level.offsets[:, k, 1]
        x, y = np.where(turned, width - 1 - x, x), np.where(turned, height - 1 - y, y)
        page = np.where(turned, (start.page[j] + 2) % 4, start.page[j])
        near = np.maximum(1 - ((x - chosen.x) ** 2 + (y - chosen.y) ** 2) / 36, 0) * (page == chosen.page)
        expected = expected + kernels.STAY * near
    np.testing.assert_allclose(cost, expected, atol=1e-5)


def test_a_picture_laid_down_whole_is_broken_up_where_that_is_wanted(dj):
    level = plane_level(dj, side=41)
    exemplar = style.exemplar(style.prepare(faces_of_a_picture()), 64, 0.5)
    row, column = np.divmod(np.arange(41 * 41), 41)
    start = field.NearestNeighbourField(np.zeros(41 * 41, np.int32), 10.0 + column, 10.0 + row)
    none = np.zeros(41 * 41, np.float32)
    there = field.pixels(exemplar, start)
    guide = guides.Guide(colour=exemplar.broad[there], detail=none, directed=none)

    def widths(largest: float) -> np.ndarray:
        settings = fixed_surface(largest_piece=largest, stroke_coherence=0.1)
        rng = np.random.default_rng(0)
        task = synthesis.LevelTask(level, guide, exemplar, 6)
        found = synthesis.paint_level(task, start, settings, rng, dj)
        label = pieces.labels(level, exemplar, found)
        return 2 * pieces.reach(label, pieces.on_picture(exemplar, field.pixels(exemplar, found)))

    whole, broken = widths(1.0), widths(0.2)
    # The sheet of 41 x 41 samples stays one piece of the 64 pixels: its widest is its diagonal.
    assert np.quantile(whole, 0.9) > 0.4 and whole.max() == pytest.approx(40 * np.sqrt(2) / 64, abs=0.02)
    assert np.quantile(broken, 0.9) < 0.2 and broken.max() < 0.3
