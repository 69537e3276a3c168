"""Every figure by a value worked out by hand."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.material_recovery import metrics as mm
from mistyle.atlas.texels import rasterise
from mistyle.core.maps import Maps, flat_maps
from mistyle.core.mesh import Mesh


def tilted(size: int, degrees: np.ndarray) -> np.ndarray:
    """Unit normals turned from +Z towards +X."""
    a = np.radians(degrees) * np.ones((size, size))
    return np.stack([np.sin(a), np.zeros_like(a), np.cos(a)], axis=-1).astype(np.float32)


def two_texel_maps(albedo: list[list[float]], roughness: list[float], degrees: list[float]) -> Maps:
    """A 2 x 2 atlas whose first row holds the two given texels; the second row repeats them."""
    both = [0, 1, 0, 1]
    return replace(
        flat_maps(2),
        albedo=np.array(albedo, np.float32)[both].reshape(2, 2, 3),
        roughness=np.array(roughness, np.float32)[both].reshape(2, 2),
        normal=tilted(2, np.array(degrees)[both].reshape(2, 2)),
    )


FIRST_ROW = np.array([[1.0, 3.0], [0.0, 0.0]])


def test_map_errors_are_weighted_by_area_and_blind_where_the_weight_is_zero():
    truth = two_texel_maps([[0.5] * 3] * 2, [0.5, 0.5], [0, 0])
    fitted = two_texel_maps([[0.6] * 3, [0.5] * 3], [0.7, 0.4], [8, 4])
    spoiled = fitted.albedo.copy()
    spoiled[1] = 1.0
    found = mm.map_errors([truth], [replace(fitted, albedo=spoiled)], [FIRST_ROW])
    # A quarter of the area is off by 0.1: mean square 0.0025.
    assert found.albedo_psnr == pytest.approx(-10 * np.log10(0.0025), abs=1e-4)
    assert found.roughness_mse == pytest.approx((0.04 + 3 * 0.01) / 4, rel=1e-5)
    assert found.roughness_median == pytest.approx(0.1, rel=1e-5)
    assert found.metallic_mse == 0
    assert found.normal_mean_deg == pytest.approx(5, abs=1e-4)
    assert found.normal_median_deg == pytest.approx(4, abs=1e-4)
    assert found.normal_p95_deg == pytest.approx(8, abs=1e-4)


def test_several_texture_sets_count_as_one_surface():
    truth = flat_maps(2)
    off = replace(truth, roughness=truth.roughness + np.float32(0.2), metallic=truth.metallic + np.float32(0.5))
    found = mm.map_errors([truth, truth], [truth, off], [np.ones((2, 2)), np.full((2, 2), 3.0)])
    assert found.roughness_mse == pytest.approx(0.75 * 0.04, rel=1e-5)
    assert found.metallic_mse == pytest.approx(0.75 * 0.25, rel=1e-6)
    assert found.albedo_psnr == float("inf")


def test_alignment_forgives_a_factor_per_channel_and_nothing_else():
    truth = two_texel_maps([[0.2, 0.4, 0.6], [0.4, 0.2, 0.3]], [0.5, 0.5], [0, 0])
    scaled = replace(truth, albedo=truth.albedo * np.array([0.5, 1.0, 1.25], np.float32))
    found = mm.map_errors([truth], [scaled], [np.ones((2, 2))])
    assert found.albedo_psnr < 25
    assert found.albedo_psnr_aligned > 120
    # Truth 1 and 2 against 1 and 1: the factor is 1.5, what remains is 0.25 everywhere.
    k = mm.channel_scale(np.array([[1.0], [2.0]]), np.ones((2, 1)), np.ones(2))
    assert k == pytest.approx([1.5])
    assert mm.channel_scale(np.ones((2, 1)), np.zeros((2, 1)), np.ones(2)) == pytest.approx([1.0])


def test_small_and_large_angles():
    degrees = np.array([1e-4, 0.5, 90, 179.9])
    a = np.radians(degrees)
    turned = np.stack([np.sin(a), 0 * a, np.cos(a)], axis=1)
    assert mm.angles(np.tile([0, 0, 1.0], (4, 1)), turned) == pytest.approx(degrees, rel=1e-6)


def test_best_constant_is_the_area_weighted_mean_and_no_constant_beats_it(rng):
    truth = two_texel_maps([[0.2] * 3, [0.6] * 3], [0.1, 0.5], [-20, 20])
    best = mm.best_constant([truth], [FIRST_ROW])[0]
    assert best.albedo[0, 0] == pytest.approx([0.5] * 3)
    assert best.roughness[1, 1] == pytest.approx(0.4)
    # (1 tilt(-20) + 3 tilt(20)): x = 2 sin 20, z = 4 cos 20.
    expected = np.degrees(np.arctan2(2 * np.sin(np.radians(20)), 4 * np.cos(np.radians(20))))
    assert mm.angles(np.array([[0, 0, 1.0]]), best.normal[:1, 0]) == pytest.approx(expected, abs=1e-4)
    least = mm.map_errors([truth], [best], [FIRST_ROW])
    for _ in range(20):
        other = replace(best, roughness=best.roughness + rng.normal(0, 0.05, (1, 1)).astype(np.float32))
        assert mm.map_errors([truth], [other], [FIRST_ROW]).roughness_mse >= least.roughness_mse


def test_quantile_and_confident_share():
    values = np.array([3.0, 1.0, 2.0])
    weights = np.array([1.0, 1.0, 2.0])
    assert [mm.quantile(values, weights, q) for q in (0.2, 0.25, 0.5, 0.75, 0.8, 1.0)] == [1, 1, 2, 2, 3, 3]
    assert np.isnan(mm.quantile(values, np.zeros(3), 0.5))
    area = np.ones((10, 10))
    area[0] = 0
    confidence = np.arange(100, dtype=float).reshape(10, 10)
    kept = mm.confident(area, confidence, 0.9)
    assert kept.sum() == 82 and not kept[:1].any() and not kept.ravel()[:18].any()
    assert mm.confident(area, np.ones((10, 10))).sum() == 90


def test_texels_stand_for_their_share_of_the_surface():
    """Two triangles of one square in UV; in space one of them is four times as large."""
    positions = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 2], [2, 0, 2], [0, 2, 2]], np.float32)
    uvs = np.array([[[0, 0], [1, 0], [0, 1]], [[1, 1], [0, 1], [1, 0]]], np.float32)
    normals = np.zeros((2, 3, 3), np.float32)
    normals[..., 2] = 1
    mesh = Mesh(positions, np.array([[0, 1, 2], [3, 4, 5]], np.int32), normals, uvs, np.zeros(2, np.int32), ("a",))
    texels = rasterise(mesh, 0, 64)
    area = mm.texel_areas(mesh, texels)
    assert area[texels.face == 0] == pytest.approx(1 / 64**2)
    assert area[texels.face == 1] == pytest.approx(4 / 64**2)
    assert area.sum() == pytest.approx(2.5, rel=0.02)


def picture(value: float, size: int = 32) -> np.ndarray:
    return np.full((size, size, 3), value, np.float32)


def half(size: int = 32) -> np.ndarray:
    mask = np.zeros((size, size), bool)
    mask[: size // 2] = True
    return mask


def test_psnr_hdr_brightens_then_clips_at_four():
    mask = half()
    # sRGB(0.25) = 1.055 * 0.25^(1/2.4) - 0.055 = 0.53710; the factor is 2.14840.
    k = (1.055 * 0.25 ** (1 / 2.4) - 0.055) / 0.25
    assert mm.brightening(picture(0.25), mask) == pytest.approx(k, rel=1e-5)
    off = mm.psnr_hdr(picture(0.25), picture(0.35), mask)
    assert off == pytest.approx(-20 * np.log10(0.1 * k), abs=1e-3)
    # Both beyond the clip are equal; one of them is at 4.
    assert mm.psnr_hdr(picture(9.0), picture(20.0), mask) == float("inf")
    # The factor of a picture that is 9 everywhere is 1: its clipped mean is.
    assert mm.psnr_hdr(picture(9.0), picture(3.0), mask) == pytest.approx(0, abs=1e-5)
    assert mm.psnr_hdr(picture(0.0), picture(-1.0), mask) == float("inf")


def test_psnr_ldr_by_hand_and_over_the_whole_picture():
    mask = half()
    a, b = picture(0.2140411), picture(0.5)  # sRGB 0.5 and 0.735357
    found = mm.psnr_ldr(a, b, mask)
    assert found == pytest.approx(-20 * np.log10(0.735357 - 0.5), abs=1e-3)
    outside = b.copy()
    outside[~mask] = 0
    assert mm.psnr_ldr(a, outside, mask) == pytest.approx(found)
    assert mm.psnr_ldr(a, outside, mask, whole=True) == pytest.approx(found + 10 * np.log10(2), abs=1e-4)


def test_alignment_of_pictures_uses_the_object_only():
    mask = half()
    test = picture(0.2)
    test[~mask] = 5
    aligned = mm.align_channels(picture(0.6) * np.array([1, 0.5, 2], np.float32), test, mask)
    assert aligned[mask][0] == pytest.approx([0.6, 0.3, 1.2])


def test_relight_errors_of_equal_and_of_different_pictures(rng):
    a = rng.uniform(0, 1, (48, 48, 3)).astype(np.float32)
    mask = half(48)
    beside = a.copy()
    beside[~mask] += 1
    same = mm.relight_errors(a, beside, mask)
    assert same.psnr_h == same.psnr_l == float("inf")
    assert same.ssim == pytest.approx(1) and same.flip == pytest.approx(0, abs=1e-6)
    worse = mm.relight_errors(a, np.clip(a + rng.normal(0, 0.2, a.shape), 0, None).astype(np.float32), mask)
    assert 5 < worse.psnr_l < 20 and worse.ssim < 0.95 and worse.flip > 0.1
    mean = mm.mean_errors([worse, mm.RelightErrors(10, 20, 0.5, 0.1)])
    assert mean.psnr_l == pytest.approx((worse.psnr_l + 20) / 2)
    assert np.isnan(mm.relight_errors(a, a, np.zeros((48, 48), bool)).psnr_l)


def test_stanford_orb_erodes_the_mask():
    coverage = np.zeros((16, 16), np.float32)
    coverage[4:12, 4:12] = 0.6
    assert mm.orb_mask(coverage).sum() == 4 * 4
    assert not mm.orb_mask(coverage * 0.8).any()
