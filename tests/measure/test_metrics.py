"""Every figure by a value known beforehand."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.consistency import metrics as consistency
from mistyle.core.camera import orbit, pixel_centres
from mistyle.core.image import gaussian
from mistyle.core.view import View
from mistyle.measure import colour_difference, metrics
from mistyle.measure.overlap import overlap


def noise(rng, size=96, sigma=1.5, mean=0.5):
    """Smooth coloured noise about `mean`, standard deviation 0.15."""
    field = gaussian(rng.normal(size=(size, size, 3)).astype(np.float32), sigma)
    return np.clip(mean + 0.15 * field / field.std(), 0, 1).astype(np.float32)


WHOLE = np.ones((96, 96), bool)


def test_psnr_by_hand():
    a = np.full((4, 4, 3), 0.5, np.float32)
    assert metrics.psnr(a, a + 0.1) == pytest.approx(20, abs=1e-4)
    assert metrics.psnr(a, a) == float("inf")
    half = a.copy()
    half[:2] += 0.1
    mask = np.zeros((4, 4), bool)
    mask[:2] = True
    assert metrics.psnr(a, half) == pytest.approx(20 + 10 * np.log10(2), abs=1e-4)
    assert metrics.psnr(a, half, mask) == pytest.approx(20, abs=1e-4)


def test_ciede2000_reproduces_published_pairs():
    """Pairs 1, 7 and 25 of Sharma, Wu and Dalal (2005)."""
    first = np.array([[50, 2.6772, -79.7751], [50, 0, 0], [60.2574, -34.0099, 36.2677]])
    second = np.array([[50, 0, -82.7485], [50, -1, 2], [60.4626, -34.1751, 39.4387]])
    np.testing.assert_allclose(colour_difference.delta_e(first, second), [2.0425, 2.3669, 1.2644], atol=1e-4)


def test_lab_of_known_colours():
    colours = np.array([[1, 1, 1], [0, 0, 0], [1, 0, 0]], np.float32)
    expected = [[100, 0, 0], [0, 0, 0], [53.24, 80.09, 67.20]]
    np.testing.assert_allclose(colour_difference.lab(colours), expected, atol=0.02)
    lab = colour_difference.lab(colours)
    assert colour_difference.delta_e(lab[:1], lab[:1]) == 0
    assert colour_difference.delta_e(lab[:1], lab[1:2]) == pytest.approx(100, abs=0.01)


def test_patch_distance_knows_a_style_from_another(rng):
    fine, coarse = noise(rng, sigma=1), noise(rng, sigma=5)
    assert metrics.PatchReference([WHOLE], [fine], [WHOLE]).distance([fine]) == pytest.approx(0, abs=1e-5)
    half = WHOLE[:, :48]
    halves = metrics.PatchReference([half], [fine[:, 48:]], [half]).distance([fine[:, :48]])
    assert halves < 0.6 * metrics.PatchReference([WHOLE], [coarse], [WHOLE]).distance([fine])
    # A shift of lightness by 10 of 100 moves each projection by 0.1 times the sum of the axis' 25 L weights.
    left, right = (np.full((40, 40, 3), value, np.float32) for value in (0.46633, 0.5669))  # L = 50 and 60
    shift = metrics.PatchReference([WHOLE[:40, :40]], [right], [WHOLE[:40, :40]]).distance([left])
    rng = np.random.default_rng(0)
    axes = rng.normal(size=(75, 64))
    axes /= np.linalg.norm(axes, axis=0)
    assert shift == pytest.approx(100 * 0.1 * np.abs(axes[::3].sum(axis=0)).mean(), rel=0.02)


def test_gram_distance_forgets_places(rng):
    fine, coarse = noise(rng, sigma=1), noise(rng, sigma=5)
    one, turned, other = (metrics.pooled_gram([p], [WHOLE]) for p in (fine, fine[::-1, ::-1], coarse))
    assert metrics.gram_distance(one, one) == 0
    assert metrics.gram_distance(one, turned) < 0.2 * metrics.gram_distance(one, other)
    assert metrics.StyleReference([WHOLE], [fine], [WHOLE]).distance([fine]) == pytest.approx(0, abs=1e-5)


def test_detail_correlation(rng):
    a = noise(rng, sigma=2)
    assert consistency.detail_correlation(a, a, WHOLE) == pytest.approx(1, abs=1e-6)
    assert consistency.detail_correlation(a, np.clip(0.3 + 0.4 * a, 0, 1), WHOLE) > 0.97
    assert consistency.detail_correlation(a, 1 - a, WHOLE) < -0.95
    assert abs(consistency.detail_correlation(a, noise(rng, sigma=2), WHOLE)) < 0.25
    light = np.linspace(0.6, 1, 96, dtype=np.float32)[None, :, None]
    assert consistency.detail_correlation(a * light, a, WHOLE) > 0.95


def test_edge_recall_gives_noise_no_credit(rng):
    steps = np.zeros((96, 96, 3), np.float32)
    steps[:, 30:60] = 1
    steps[40:50] = 0.5
    assert consistency.edge_recall(steps, steps, WHOLE) > 0.8
    assert consistency.edge_recall(np.full((96, 96, 3), 0.5, np.float32), steps, WHOLE) == 0
    speckle = rng.random((96, 96, 3)).astype(np.float32)
    assert abs(consistency.edge_recall(speckle, steps, WHOLE)) < 0.25
    assert np.isnan(consistency.edge_recall(steps, np.full((96, 96, 3), 0.5, np.float32), WHOLE))


def plane_view(azimuth, size=96):
    """The square |x|, |y| < 1 in the plane z = 0, by intersecting the rays of an orbiting camera."""
    camera = orbit(azimuth, 0, distance=4, fov=30, size=(size, size))
    px = pixel_centres(camera.size)
    local = np.concatenate([(px - np.array(camera.centre)) / camera.focal, np.ones((size, size, 1))], axis=-1)
    world = local @ camera.world_from_cam[:3, :3].T
    depth = -camera.position[2] / world[..., 2]  # local z is 1, so the factor is the depth
    points = camera.position + world * depth[..., None]
    mask = (np.abs(points[..., :2]) < 0.9).all(axis=-1)
    uv = np.where(mask[..., None], points[..., :2] / 2 + 0.5, 0).astype(np.float32)
    return View(
        camera=camera,
        rgb=np.zeros((size, size, 3), np.float32),
        depth=np.where(mask, depth, np.inf).astype(np.float32),
        normal=np.where(mask[..., None], np.array([0, 0, 1], np.float32), 0).astype(np.float32),
        uv=uv,
        part=np.where(mask, 0, -1).astype(np.int32),
        mask=mask,
        coverage=mask.astype(np.float32),
    )


def test_warp_error_is_small_for_one_painting_and_by_hand_for_two_colours():
    a, b = plane_view(0), plane_view(30)

    def painted(view):
        waves = 0.5 + 0.3 * np.sin(view.uv[..., :1] * 12) * np.cos(view.uv[..., 1:] * 9)
        return np.repeat(waves, 3, axis=-1).astype(np.float32)

    # Bilinear lookups in a wave of about 50 pixels.
    assert metrics.warp_error(overlap(a, b), painted(a), painted(b)) < 0.3
    assert metrics.warp_error(overlap(a, b), painted(a), painted(b)[:, ::-1]) > 5
    grey, lighter = (np.full((96, 96, 3), v, np.float32) for v in (0.46633, 0.5669))  # L = 50 and 60, a = b = 0
    assert metrics.warp_error(overlap(a, b), grey, lighter) == pytest.approx(10, abs=0.05)


def test_warp_error_leaves_out_what_the_other_view_cannot_see():
    a, b = plane_view(0), plane_view(30)
    hidden = replace(b, depth=(b.depth - 0.5).astype(np.float32))
    picture = np.zeros((96, 96, 3), np.float32)
    assert np.isnan(metrics.warp_error(overlap(a, hidden), picture, picture))


def test_seam_ratio_sees_a_step_at_a_seam_only(rng):
    view = plane_view(0)
    uv = view.uv.copy()
    uv[:, 48:, 0] = uv[:, 48:, 0] + 0.3  # another island right of column 48
    seamed = replace(view, uv=uv)
    picture = 0.5 + 0.02 * rng.normal(size=(96, 96, 3)).astype(np.float32)
    assert np.isnan(consistency.seam_ratio(view, picture))
    assert consistency.seam_ratio(seamed, picture) == pytest.approx(1, abs=0.15)
    stepped = picture.copy()
    stepped[:, 48:] += 0.2
    # Three channels differ by 0.2 on top of noise of 0.02 times 2/sqrt(pi) = 0.0226 each.
    assert consistency.seam_ratio(seamed, stepped) == pytest.approx(0.2 / 0.0226, rel=0.15)


def test_a_view_without_the_mesh_is_no_number():
    empty = replace(plane_view(0), mask=np.zeros((96, 96), bool))
    picture = np.zeros((96, 96, 3), np.float32)
    assert np.isnan(metrics.warp_error(overlap(empty, plane_view(30)), picture, picture))
    assert np.isnan(consistency.seam_ratio(empty, picture))
