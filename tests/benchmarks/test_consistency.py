"""View-to-view figures by values known beforehand."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.consistency import metrics as consistency
from mistyle.core.image import gaussian
from mistyle.measure import metrics
from mistyle.measure.overlap import overlap
from tests.measure.test_metrics import noise, plane_view

GREY, LIGHT = (np.full((96, 96, 3), v, np.float32) for v in (0.4, 0.5))


def waves(view):
    """A painting of the plane with waves of about 50 pixels."""
    field = 0.5 + 0.3 * np.sin(view.uv[..., :1] * 12) * np.cos(view.uv[..., 1:] * 9)
    return np.repeat(field, 3, axis=-1).astype(np.float32)


def test_pairs_by_angle():
    views = [plane_view(a) for a in (0, 30, 60, 120)]
    assert consistency.pairs(views, (0, 46)) == [(0, 1), (1, 0), (1, 2), (2, 1)]
    assert set(consistency.pairs(views, (46, 95))) == {(0, 2), (2, 0), (1, 3), (3, 1), (2, 3), (3, 2)}


def test_warp_rmse_by_hand():
    views = [plane_view(0), plane_view(30)]
    chosen = consistency.pairs(views, consistency.SHORT)
    assert consistency.warp_rmse(views, [GREY, LIGHT], chosen) == pytest.approx(0.1, abs=1e-6)
    assert consistency.warp_rmse(views, [GREY, GREY], chosen) < 1e-6
    own = [waves(view) for view in views]
    assert consistency.warp_rmse(views, own, chosen) < 0.003
    assert consistency.warp_rmse(views, [own[0], own[1][:, ::-1]], chosen) > 0.05
    assert np.isnan(consistency.warp_rmse(views, own, []))


def test_a_round_trip_knows_nothing_of_the_other_picture(rng):
    views = [plane_view(0), plane_view(60)]
    chosen = consistency.pairs(views, consistency.LONG)
    assert consistency.round_trip_rmse(views, [GREY, LIGHT], chosen) < 1e-6
    smooth, fine = [waves(view) for view in views], [noise(rng, sigma=0.4)] * 2
    assert consistency.round_trip_rmse(views, smooth, chosen) < 0.002
    assert consistency.round_trip_rmse(views, fine, chosen) > 0.04
    assert np.isnan(consistency.round_trip_rmse(views, smooth, []))


def test_pairs_are_pooled_by_pixels():
    """One view sees half of the plane: its pairs count half as many pixels."""
    half = plane_view(30)
    mask = half.mask & (half.uv[..., 0] < 0.5)
    views = [plane_view(0), plane_view(20), replace(half, mask=mask)]
    chosen = [(0, 1), (0, 2)]
    counts = [int(overlap(views[0], views[j]).both.sum()) for j in (1, 2)]
    assert 0.4 < counts[1] / counts[0] < 0.6
    wanted = np.sqrt((counts[0] * 0.01 + counts[1] * 0.04) / sum(counts))
    found = consistency.warp_rmse(views, [GREY, LIGHT, GREY + 0.2], chosen)
    assert found == pytest.approx(wanted, rel=1e-4)


def test_warp_lpips_asks_over_the_shared_pixels_and_takes_the_mean():
    views = [plane_view(0), plane_view(30)]
    seen = []

    def distance(reference, test, mask):
        seen.append(mask)
        return float(np.abs(reference - test)[mask].mean())

    found = consistency.warp_lpips(views, [GREY, LIGHT], [(0, 1), (1, 0)], distance)
    assert found == pytest.approx(0.1, abs=1e-6) and len(seen) == 2
    assert all((mask == overlap(views[i], views[1 - i]).both).all() for i, mask in enumerate(seen))


def test_guide_correlation(rng):
    mask = np.ones((512, 512), bool)
    guide = gaussian(rng.normal(size=(512, 512)).astype(np.float32), 3)
    guide *= 1.5 / np.abs(guide).max()
    follows = np.repeat((0.5 + 0.2 * guide)[..., None], 3, axis=-1)
    assert consistency.guide_correlation([follows], [guide], [mask]) > 0.9
    assert consistency.guide_correlation([1 - follows], [guide], [mask]) < -0.9
    other = noise(rng, size=512, sigma=3)
    assert abs(consistency.guide_correlation([other], [guide], [mask])) < 0.1
    # A change of brightness over the whole object says nothing about its detail.
    tilted = np.clip(follows + np.linspace(-0.2, 0.2, 512, dtype=np.float32)[:, None, None], 0, 1)
    assert consistency.guide_correlation([tilted], [guide], [mask]) > 0.85
    both = consistency.guide_correlation([follows, 1 - follows], [guide, guide], [mask, mask])
    assert abs(both) < 0.05


def test_border_ratio_sees_steps_where_the_view_changes_and_only_there(rng):
    label = np.zeros((96, 96), np.int32)
    label[:, 48:] = 1
    island = np.zeros((96, 96), np.int32)
    albedo = (0.5 + 0.02 * rng.normal(size=(96, 96, 3))).astype(np.float32)
    assert consistency.border_ratio(albedo, label, island) == pytest.approx(1, abs=0.15)
    stepped = albedo.copy()
    stepped[:, 48:] += 0.2
    # 0.2 in each channel over noise of 0.02 times 2 / sqrt(pi).
    assert consistency.border_ratio(stepped, label, island) == pytest.approx(0.2 / 0.0226, rel=0.15)
    island[:, 48:] = 1
    assert np.isnan(consistency.border_ratio(stepped, label, island)), "the border of an island is no border of views"
    assert np.isnan(consistency.border_ratio(stepped, np.zeros_like(label), island))


def test_gram_distance_takes_other_features(rng):
    picture, mask = noise(rng), np.ones((96, 96), bool)
    asked = []

    def means(image):
        asked.append(image.shape)
        return [image]

    one, half = (metrics.pooled_gram([p], [mask], means) for p in (picture, picture / 2))
    assert metrics.gram_distance(one, one) == 0
    # With the colours themselves as features, twice the value has four times the Gram matrix.
    assert metrics.gram_distance(one, half) == pytest.approx(3, rel=1e-4)
    assert asked[0] == (1, 3, 96, 96)
