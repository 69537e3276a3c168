"""Every metric of `mistyle compare` by a hand-computed, published or closed-form value."""

import math

import flip_evaluator
import numpy as np
import pytest

from mistyle.core.image import gaussian
from mistyle.measure.pictures import flip_bands, metrics, protocols
from mistyle.measure.pictures.metrics import COLOUR, Viewing, measure_colour, measure_data

WHOLE = np.ones((40, 40), bool)


def flat(value, size=40):
    return np.full((size, size, 3), value, np.float32)


def smooth(rng, height=96, width=80, scale=1.0):
    field = gaussian(rng.random((height, width, 3)).astype(np.float32), 2)
    return (scale * (field - field.min()) / np.ptp(field)).astype(np.float32)


def test_squared_and_relative_errors_by_hand():
    found = measure_colour(flat(0.4), flat(0.5), WHOLE, ["psnr_linear", "relmse", "smape"], Viewing(peak=2)).values
    assert found["psnr_linear"] == pytest.approx(10 * math.log10(4 / 0.01), abs=1e-4)
    assert found["relmse"] == pytest.approx(0.01 / (0.16 + 0.01), rel=1e-5)
    assert found["smape"] == pytest.approx(0.1 / (0.9 + 0.01), rel=1e-5)
    # Highlights beyond 1 are not clipped: an error of 1 on a highlight of 9.
    assert measure_colour(flat(9), flat(10), WHOLE, ["relmse"]).values["relmse"] == pytest.approx(1 / 81.01, rel=1e-5)


def test_encoded_psnr_by_hand():
    # Linear 0.2140411 is sRGB 0.5 and 0.0512695 is 0.25.
    found = measure_colour(flat(0.2140411), flat(0.0508761), WHOLE, ["psnr"]).values["psnr"]
    assert found == pytest.approx(-10 * math.log10(0.25**2), abs=1e-3)
    assert measure_colour(flat(1), flat(3), WHOLE, ["psnr"]).values["psnr"] == math.inf  # clipped


def test_only_the_mask_counts(rng):
    mask = np.zeros((96, 80), bool)
    mask[:, :40] = True
    a = smooth(rng, scale=3)
    outside = a.copy()
    outside[:, 40:] += 5
    found = measure_colour(a, outside, mask).values
    for name in set(COLOUR) - {"lpips"}:
        assert found[name] == (1 if name == "ssim" else math.inf if "psnr" in name else pytest.approx(0, abs=1e-6)), (
            name
        )
    half = a.copy()
    half[:20, :40] += 0.1
    square = 10 * math.log10(1 / (0.01 * 20 / 96))
    assert measure_colour(a, half, mask, ["psnr_linear"]).values["psnr_linear"] == pytest.approx(square, abs=1e-3)
    assert all(math.isnan(v) for v in measure_colour(a, half, np.zeros_like(mask)).values.values())


def test_pixels_that_are_not_finite_are_no_business_of_metrics(rng):
    a, b = smooth(rng), smooth(rng)
    b[3, 3] = np.nan
    with pytest.raises(ValueError, match="NaN"):
        measure_colour(a, b, np.ones((96, 80), bool))
    mask = np.ones((96, 80), bool)
    mask[3, 3] = False
    assert all(math.isfinite(v) for k, v in measure_colour(a, b, mask).values.items() if k != "lpips")


def test_ssim_of_flat_pictures_has_a_closed_form(rng):
    # Without structure: (2 x y + C1) / (x² + y² + C1), C1 = 0.01²; sRGB 0.5 and 0.25.
    found = measure_colour(flat(0.2140411), flat(0.0508761), WHOLE, ["ssim"]).values["ssim"]
    assert found == pytest.approx((0.25 + 1e-4) / (0.3125 + 1e-4), rel=1e-4)
    assert math.isnan(measure_colour(flat(0.2, 10), flat(0.2, 10), WHOLE[:10, :10], ["ssim"]).values["ssim"])


def test_ssim_in_bands_is_ssim(rng):
    from skimage.metrics import structural_similarity

    a = smooth(rng, 1100, 40)
    b = np.clip(a + 0.1 * rng.normal(size=a.shape), 0, 1).astype(np.float32)
    how = dict(data_range=1.0, channel_axis=-1, gaussian_weights=True, use_sample_covariance=False, full=True)
    whole = structural_similarity(metrics.encoded(a), metrics.encoded(b), **how)[1].mean()
    found = measure_colour(a, b, np.ones(a.shape[:2], bool), ["ssim"]).values["ssim"]
    assert found == pytest.approx(float(whole), abs=1e-6)


def test_colour_difference_of_known_colours():
    # White against black is 100 whatever the formula's details; mean and 95th percentile part where few pixels differ.
    a, b = flat(0), flat(0)
    b[0, :2] = 1
    found = measure_colour(a, b, WHOLE, ["de2000", "de2000_p95"]).values
    assert found["de2000"] == pytest.approx(100 * 2 / 1600, rel=1e-4)
    assert found["de2000_p95"] == 0
    # Greys of L* 50 and 60: only the lightness term is left, 10 / (1 + 0.015 (55 - 50)² / sqrt(20 + (55 - 50)²)).
    found = measure_colour(flat(0.18418652), flat(0.28123), WHOLE, ["de2000"]).values["de2000"]
    assert found == pytest.approx(10 / (1 + 0.015 * 25 / math.sqrt(45)), rel=1e-3)


def test_flip_is_the_packages_bit_for_bit(rng):
    a = smooth(rng, 500, 300)
    b = np.clip(a + 0.05 * rng.normal(size=a.shape), 0, 1).astype(np.float32)
    theirs = flip_evaluator.evaluate(a, b, "LDR", applyMagma=False, parameters={"ppd": 67.02})
    assert flip_bands.reach(67.02) > 19
    ours = flip_bands.flip_map(a, b, 67.02)  # in bands, in two processes
    assert np.array_equal(ours, theirs[0][..., 0])
    known = {"ppd": 67.02, "startExposure": -2.0, "stopExposure": 1.0, "numExposures": 3}
    theirs = flip_evaluator.evaluate(3 * a, 3 * b, "HDR", applyMagma=False, parameters=known)[0][..., 0]
    assert np.array_equal(flip_bands.flip_map(3 * a, 3 * b, 67.02, (-2.0, 1.0, 3)), theirs)


def test_flip_and_its_default_viewing(rng):
    a, b = smooth(rng), smooth(rng)
    found = measure_colour(a, b, np.ones((96, 80), bool), ["flip"]).values["flip"]
    encoded = [metrics.encoded(p) for p in (a, b)]
    assert found == pytest.approx(flip_evaluator.evaluate(*encoded, "LDR", applyMagma=False)[1], abs=1e-6)
    # Green against blue is the largest difference that FLIP knows.
    green, blue = flat(0, 64), flat(0, 64)
    green[..., 1], blue[..., 2] = 1, 1
    assert measure_colour(green, blue, np.ones((64, 64), bool), ["flip"]).values["flip"] > 0.95


def test_exposures_come_from_the_reference_alone(rng):
    a = (smooth(rng, scale=2) ** 3 * 4).astype(np.float32)
    theirs = flip_evaluator.evaluate(a, a, "HDR", applyMagma=False)[2]
    first, last, count = metrics.flip_exposures(a)
    assert (first, last, count) == pytest.approx([theirs[f"{n}Exposure"] for n in ("start", "stop")] + [count])
    assert count == theirs["numExposures"]
    whole = np.ones(a.shape[:2], bool)
    found = [measure_colour(a, b, whole, ["hdr_flip"]) for b in (a * 0.9, a * 20)]
    assert found[0].exposures == found[1].exposures == (first, last, count)
    theirs = flip_evaluator.evaluate(a, (a * 0.9).astype(np.float32), "HDR", applyMagma=False)[1]
    assert found[0].values["hdr_flip"] == pytest.approx(theirs, abs=1e-5)


def test_empty_surroundings_ask_for_no_extra_exposures(rng):
    a = np.zeros((96, 96, 3), np.float32)
    a[30:60, 30:60] = smooth(rng, 30, 30) + 0.2
    assert metrics.flip_exposures(a) == metrics.flip_exposures(a[30:60, 30:60])
    assert metrics.flip_exposures(np.zeros_like(a)) == (0, 0, 2)
    # With one exposure the package answers 0 for anything.
    assert measure_colour(np.zeros_like(a), a, np.ones((96, 96), bool), ["hdr_flip"]).values["hdr_flip"] > 0.02


def test_data_layers_by_hand():
    a, b = np.zeros((4, 4, 3), np.float32), np.zeros((4, 4, 3), np.float32)
    a[..., 2], b[..., 2] = 1, 1
    b[..., 0] = 1  # 45 degrees
    found = measure_data(a, b, np.ones((4, 4), bool)).values
    assert found["angle"] == pytest.approx(45, abs=1e-5)
    assert found["rmse"] == pytest.approx(math.sqrt(1 / 3)) and found["mae"] == pytest.approx(1 / 3)
    assert found["max_error"] == 1
    assert measure_data(a, a, np.ones((4, 4), bool)).values["angle"] == 0
    assert "angle" not in measure_data(a[..., :1], b[..., :1], np.ones((4, 4), bool)).values


def test_every_definition_is_filled_in():
    texts = metrics.definitions(Viewing(exposures=(-1.0, 2.0, 4)), list(metrics.METRICS))
    assert "67.02 pixels per degree" in texts["flip"] and "4 exposures from -1.00 to +2.00" in texts["hdr_flip"]
    assert not any("{" in text for text in texts.values())


def formula():
    """The pictures that idiff 3.2.2 was run on."""
    y, x = np.mgrid[0:24, 0:32].astype(np.float64)
    a = np.stack([x / 8, y / 12, (x + y) / 28], -1).astype(np.float32)
    b = (a + 0.05 * np.sin(x * y)[..., None] * np.array([1, -1, 0.5])).astype(np.float32)
    b[0] = a[0]
    return a, b


def test_idiff_prints_the_same():
    """`idiff -v` of OpenImageIO 3.2.2: mean 0.0239852, RMS 0.0291081, SNR 42.5955, max 0.0499995, 713 pixels."""
    found = protocols.idiff(*formula())
    expected = {
        "mean_error": 0.0239852,
        "rms_error": 0.0291081,
        "peak_snr": 42.5955,
        "max_error": 0.0499995,
        "over": 713,
    }
    assert found == pytest.approx(expected, rel=2e-6)
    a, b = formula()
    a[0, 0], b[0, 0], a[1, 1, 0] = np.nan, np.nan, np.inf
    found = protocols.idiff(a, b)
    assert found["max_error"] == math.inf and found["over"] == 713 + (b[1, 1] == a[1, 1]).all()


def slow_ssim(a, b, size, sigma):
    """The window as a sum over its pixels, only where it fits."""
    k = np.exp(-((np.arange(size) - size // 2) ** 2) / (2 * sigma**2))
    k = np.outer(k, k) / np.outer(k, k).sum()
    values = []
    for y in range(a.shape[0] - size + 1):
        for x in range(a.shape[1] - size + 1):
            u, v = (p[y : y + size, x : x + size].reshape(-1, 3) for p in (a, b))
            w = k.reshape(-1, 1)
            mu, mv = (w * u).sum(0), (w * v).sum(0)
            uu, vv, uv = (w * u * u).sum(0) - mu**2, (w * v * v).sum(0) - mv**2, (w * u * v).sum(0) - mu * mv
            values.append((2 * mu * mv + 1e-4) * (2 * uv + 9e-4) / ((mu**2 + mv**2 + 1e-4) * (uu + vv + 9e-4)))
    return float(np.mean(values))


def test_tensoir_against_sums_written_out(rng):
    a, b = rng.random((2, 20, 18, 3)).astype(np.float32)
    found = protocols.tensoir(a, b)
    assert found["psnr"] == pytest.approx(-10 * math.log10(float(((a - b).astype(np.float64) ** 2).mean())), abs=1e-6)
    assert found["ssim"] == pytest.approx(slow_ssim(a.astype(np.float64), b.astype(np.float64), 11, 1.5), abs=1e-6)


def test_stanford_orb_forgives_a_colour_per_channel_and_counts_the_background(rng):
    gt = 0.2 + 0.5 * smooth(rng, 32, 32)
    full = np.ones((32, 32), np.float32)
    tinted = (gt * np.array([2, 0.5, 1.5])).astype(np.float32)
    assert protocols.stanford_orb(gt, tinted, full)["psnr_h"] > 100
    noisy = np.clip(gt + 0.05 * rng.normal(size=gt.shape), 0, None).astype(np.float32)
    half = full.copy()
    half[:, 16:] = 0
    # The mask's border of two pixels is eroded away; the error is spread over the whole frame.
    inside = np.zeros((32, 32), bool)
    inside[:, :14] = True
    a, b = gt[inside].astype(np.float64), noisy[inside].astype(np.float64)
    b *= (a * b).sum(0) / (b * b).sum(0)
    curve = np.vectorize(lambda x: 12.92 * x if x <= 0.0031308 else 1.055 * x ** (1 / 2.4) - 0.055)
    low = ((curve(np.clip(b, 0, 1)) - curve(np.clip(a, 0, 1))) ** 2).sum() / (3 * 32 * 32)
    whole = np.where(inside[..., None], gt, 0).astype(np.float64)
    factor = curve(np.clip(whole, 0, 1)).mean() / np.clip(whole, 0, 1).mean()
    high = ((np.clip(factor * b, 0, 4) - np.clip(factor * a, 0, 4)) ** 2).sum() / (3 * 32 * 32)
    found = protocols.stanford_orb(gt, noisy, half)
    assert found["psnr_l"] == pytest.approx(-10 * math.log10(low), abs=1e-4)
    assert found["psnr_h"] == pytest.approx(-10 * math.log10(high), abs=1e-4)


def test_stanford_orb_ssim_window_of_three(rng):
    a = rng.random((30, 26, 3)).astype(np.float32)
    found = protocols._orb_ssim(a.astype(np.float64), (a[::-1] * 0.7).astype(np.float64))
    padded = [np.pad(p.astype(np.float64), ((1, 1), (1, 1), (0, 0)), mode="reflect") for p in (a, a[::-1] * 0.7)]
    assert found == pytest.approx(slow_ssim(*padded, 3, 1.5), abs=1e-5)
    black = protocols.stanford_orb(0.5 + 0.4 * a, np.zeros_like(a), np.ones((30, 26), np.float32))
    grey = -10 * math.log10(float(((0.5 - protocols._orb_encoded(np.float64(0.5) + 0.4 * a)) ** 2).mean()))
    assert black["psnr_l"] == pytest.approx(grey, abs=1e-4)  # never below that of constant grey


def test_ssim_is_one_for_equal_pictures_and_by_hand_for_flat_ones(rng):
    a, whole = smooth(rng, 96, 96), np.ones((96, 96), bool)
    assert metrics.ssim(a, a, whole) == pytest.approx(1)
    assert metrics.ssim(a, smooth(rng, 96, 96), whole) < 0.5
    # Without structure only the luminance term is left: (2 x y + C1) / (x² + y² + C1), C1 = 0.01².
    x, y = np.full((32, 32, 3), 0.4, np.float32), np.full((32, 32, 3), 0.8, np.float32)
    assert metrics.ssim(x, y, whole[:32, :32]) == pytest.approx((0.64 + 1e-4) / (0.8 + 1e-4), rel=1e-4)


def test_flip_runs_from_zero_to_one(rng):
    a = smooth(rng, 96, 96)
    assert flip_bands.flip_map(a, a, metrics.PPD).mean() == pytest.approx(0, abs=1e-6)
    # The largest colour difference that FLIP knows is blue against green.
    blue, green = np.zeros((64, 64, 3), np.float32), np.zeros((64, 64, 3), np.float32)
    blue[..., 2], green[..., 1] = 1, 1
    assert flip_bands.flip_map(blue, green, metrics.PPD).mean() > 0.95
    small = flip_bands.flip_map(a, np.clip(a + 0.02, 0, 1), metrics.PPD).mean()
    assert 0 < small < 0.2
