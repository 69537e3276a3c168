"""Metrics by the definitions of published evaluation code: Stanford-ORB, TensoIR, OIIO's idiff."""

import math
from collections.abc import Mapping

import cv2
import numpy as np
from jaxtyping import Bool, Float

from mistyle.core.image import erode

PROTOCOLS: Mapping[str, str] = {
    "stanford-orb": "Stanford-ORB's image similarity. Mask: reference alpha (or --mask) above 0.5, eroded by a 5 x 5 "
    "window; both pictures are black outside. psnr_h: linear, both first multiplied by mean(sRGB(reference)) / "
    "mean(reference) over the clipped picture, the test scaled per channel by least squares, clipped to 0..4; psnr_l: "
    "the test scaled likewise, clipped to 0..1 and sRGB-encoded. Peak 1; the squared error is averaged over the whole "
    "frame, black surroundings included, and never below that of constant 0.5. ssim: Gaussian window of 3 px, standard "
    "deviation 1.5, mirrored, on psnr_l's pictures. Its LPIPS (VGG) is not measured. "
    "A reference four times as large is reduced by area averages",
    "tensoir": "TensoIR's relighting metrics, on sRGB-encoded pictures in 0..1 over white. psnr: peak 1, all pixels. "
    "ssim: Gaussian window of 11 px, standard deviation 1.5, variances kept from below zero, only where the window "
    "lies inside the picture, mean over channels",
    "idiff": "OpenImageIO's idiff on the values as stored, all channels, missing ones and missing pixels 0, over the "
    "display window: mean_error, rms_error, peak_snr = 20 log10(M / rms_error) with M the largest value of "
    "either but at least 1, max_error, over: pixels with a channel off by more than 1e-6",
}
PROTOCOL_BETTER = {
    "psnr_h": "higher",
    "psnr_l": "higher",
    "psnr": "higher",
    "ssim": "higher",
    "mean_error": "lower",
    "rms_error": "lower",
    "peak_snr": "higher",
    "max_error": "lower",
    "over": "lower",
}


def stanford_orb(
    reference: Float[np.ndarray, "h w 3"],
    test: Float[np.ndarray, "h w 3"],
    coverage: Float[np.ndarray, "h w"],
) -> dict[str, float]:
    """psnr_h, psnr_l and ssim of linear pictures; `coverage` is the reference's."""
    mask = erode(np.asarray(coverage > 0.5), 2)
    high = _orb_pair(reference, test, mask, most=4.0, brighten=True)
    low = [_orb_encoded(picture) for picture in _orb_pair(reference, test, mask, most=1.0, brighten=False)]
    values = {
        "psnr_h": _orb_psnr(high[0], high[1], mask),
        "psnr_l": _orb_psnr(low[0], low[1], mask),
        "ssim": _orb_ssim(low[0] * mask[..., None], low[1] * mask[..., None]),
    }
    return values


def _orb_pair(reference, test, mask: Bool[np.ndarray, "h w"], most: float, brighten: bool) -> list[np.ndarray]:
    inside = mask[..., None]
    gt, pred = np.maximum(reference * inside, 0).astype(np.float64), (test * inside).astype(np.float64)
    if brighten:
        clipped = np.clip(gt, 0, 1)
        if clipped.mean() > 1e-8:
            factor = _orb_encoded(clipped).mean() / clipped.mean()
            gt, pred = gt * factor, pred * factor
    a, b = gt[mask], pred[mask]
    b = np.where((b**2).sum(axis=0) <= 1e-6, 1.0, b)
    scale = (a * b).sum(axis=0) / np.maximum((b**2).sum(axis=0), 1e-300)
    return [np.clip(gt, 0, most), np.clip(pred * scale, 0, most)]


def _orb_encoded(linear: np.ndarray) -> np.ndarray:
    """The sRGB curve, extended above 1."""
    return np.where(linear > 0.0031308, 1.055 * np.maximum(linear, 0.0031308) ** (1 / 2.4) - 0.055, 12.92 * linear)


def _orb_psnr(reference: np.ndarray, test: np.ndarray, mask: np.ndarray) -> float:
    grey = 0.5 * mask[..., None] - reference
    return max(_decibels(((test - reference) ** 2).mean()), _decibels((grey**2).mean()))


def _orb_ssim(reference: np.ndarray, test: np.ndarray) -> float:
    weights = np.exp(-(np.arange(-1, 2) ** 2) / (2 * 1.5**2))
    weights /= weights.sum()

    def smooth(picture: np.ndarray) -> np.ndarray:
        return cv2.sepFilter2D(picture, cv2.CV_64F, weights, weights, borderType=cv2.BORDER_REFLECT_101)

    index = _similarity(reference, test, smooth, clamp=False)
    return float(1 - 2 * np.clip((1 - index) / 2, 0, 1).mean())


def tensoir(reference: Float[np.ndarray, "h w 3"], test: Float[np.ndarray, "h w 3"]) -> dict[str, float]:
    """psnr and ssim of sRGB-encoded pictures over white; ssim is NaN where the window of 11 px does not fit."""
    a, b = np.clip(reference, 0, 1).astype(np.float64), np.clip(test, 0, 1).astype(np.float64)
    weights = np.exp(-(np.arange(-5, 6) ** 2) / (2 * 1.5**2))
    weights /= weights.sum()

    def smooth(picture: np.ndarray) -> np.ndarray:
        return cv2.sepFilter2D(picture, cv2.CV_64F, weights, weights)[5:-5, 5:-5]

    similar = float(_similarity(a, b, smooth, clamp=True).mean()) if min(a.shape[:2]) >= 11 else math.nan
    return {"psnr": _decibels(((a - b) ** 2).mean()), "ssim": similar}


def _similarity(a: np.ndarray, b: np.ndarray, smooth, clamp: bool) -> np.ndarray:
    """The SSIM map with peak 1, K = 0.01 and 0.03; `clamp` limits (co)variances to their valid range."""
    ma, mb = smooth(a), smooth(b)
    va, vb, vab = smooth(a * a) - ma**2, smooth(b * b) - mb**2, smooth(a * b) - ma * mb
    if clamp:
        va, vb = np.maximum(va, 0), np.maximum(vb, 0)
        vab = np.sign(vab) * np.minimum(np.sqrt(va * vb), np.abs(vab))
    c1, c2 = 0.01**2, 0.03**2
    return (2 * ma * mb + c1) * (2 * vab + c2) / ((ma**2 + mb**2 + c1) * (va + vb + c2))


def idiff(reference: Float[np.ndarray, "h w c"], test: Float[np.ndarray, "h w c"]) -> dict[str, float]:
    """mean_error, rms_error, peak_snr, max_error and over; NaN matches NaN and infinity matches infinity."""
    a, b = reference.astype(np.float64), test.astype(np.float64)
    finite = np.isfinite(a) & np.isfinite(b)
    alike = (np.isnan(a) & np.isnan(b)) | (np.isinf(a) & np.isinf(b))
    gap = np.where(finite, np.abs(np.where(finite, a, 0) - np.where(finite, b, 0)), 0)
    broken = ~finite & ~alike
    rms = math.sqrt(float((gap**2).mean()))
    largest = max(1.0, float(np.where(finite, np.maximum(a, b), 0).max()))
    return {
        "mean_error": float(gap.mean()),
        "rms_error": rms,
        "peak_snr": math.inf if rms == 0 else 20 * math.log10(largest / rms),
        "max_error": math.inf if broken.any() else float(gap.max()),
        "over": float(((gap > 1e-6) | broken).any(axis=-1).sum()),
    }


def _decibels(mean_square: float) -> float:
    return math.inf if mean_square == 0 else -10 * math.log10(mean_square)
