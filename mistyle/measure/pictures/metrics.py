"""Standard picture metrics of rendering, each with its definition.

Pictures are linear Rec.709, premultiplied, float32 (h w 3); masks are bool (h w). Outside the mask the test takes the
reference's pixels before a windowed metric, so that only differences inside count; means are over the mask. Nothing is
rescaled or tone-mapped unless the definition states it.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from jaxtyping import Bool, Float

from mistyle.core.image import luminance, srgb_from_linear
from mistyle.measure.colour_difference import delta_e, lab
from mistyle.measure.pictures.flip_bands import FlipPair, flip_maps

PPD = 3840 * math.pi / 180  # 0.7 m from a display of 3840 pixels and 0.7 m
SMALL = 1e-2  # keeps relative errors of black pixels finite
LPIPS_SMALLEST = 32  # pixels along each side
ROWS = 32  # rows of a large picture per task: the temporaries then fit the processor's cache


@dataclass(frozen=True)
class Metric:
    """A metric's name, better direction, unit, and full definition."""

    name: str
    better: Literal["lower", "higher"]
    unit: str
    definition: str
    kind: Literal["colour", "data"] = "colour"


METRICS = {
    m.name: m
    for m in (
        Metric(
            "flip",
            "lower",
            "0..1",
            "LDR-FLIP (Andersson et al. 2020; NVIDIA's flip-evaluator), mean over the mask, of both pictures clipped "
            "to 0..1 and sRGB-encoded, at {ppd:.2f} pixels per degree",
        ),
        Metric(
            "hdr_flip",
            "lower",
            "0..1",
            "HDR-FLIP (Andersson et al. 2021; NVIDIA's flip-evaluator), mean over the mask of the largest LDR-FLIP "
            "over exposures, linear Rec.709 (negative values count as 0), ACES curve, {ppd:.2f} pixels per degree, "
            "{exposures}; they are fixed for all tests by the reference (its largest and median luminance inside the "
            "mask, black pixels aside)",
        ),
        Metric(
            "psnr",
            "higher",
            "dB",
            "10 log10(1 / MSE), MSE over mask and channels of both pictures clipped to 0..1 and sRGB-encoded; peak 1",
        ),
        Metric(
            "psnr_linear",
            "higher",
            "dB",
            "10 log10(peak² / MSE), MSE over mask and channels of linear Rec.709, not clipped; peak {peak:g}",
        ),
        Metric(
            "ssim",
            "higher",
            "-1..1",
            "SSIM (Wang et al. 2004; scikit-image), Gaussian window of 1.5 px cut at 11 px, K 0.01 and 0.03, peak 1, "
            "per channel of the sRGB-encoded pictures clipped to 0..1, mirrored at the border, mean over the mask",
        ),
        Metric(
            "de2000",
            "lower",
            "ΔE00",
            "mean over the mask of CIEDE2000 (colour-science; kL = kC = kH = 1) between CIELAB colours, white D65, of "
            "the pictures clipped to 0..1",
        ),
        Metric("de2000_p95", "lower", "ΔE00", "95th percentile over the mask of CIEDE2000"),
        Metric(
            "relmse",
            "lower",
            "",
            "mean over mask and channels of (test - reference)² / (reference² + 0.01), linear Rec.709, not clipped",
        ),
        Metric(
            "smape",
            "lower",
            "",
            "mean over mask and channels of |test - reference| / (|reference| + |test| + 0.01), linear Rec.709, not "
            "clipped",
        ),
        Metric(
            "lpips", "lower", "", "LPIPS (Zhang et al. 2018), {lpips}, of the sRGB-encoded pictures clipped to 0..1"
        ),
        Metric("rmse", "lower", "", "root of the mean squared difference over mask and channels, as stored", "data"),
        Metric("mae", "lower", "", "mean absolute difference over mask and channels, as stored", "data"),
        Metric("max_error", "lower", "", "largest absolute difference over mask and channels, as stored", "data"),
        Metric("differing", "lower", "0..1", "share of the mask's pixels of which any stored channel differs", "data"),
        Metric("angle", "lower", "degrees", "mean angle between vectors of three channels longer than 1e-6", "data"),
    )
}
COLOUR = tuple(m.name for m in METRICS.values() if m.kind == "colour")
ENCODED = {"flip", "psnr", "ssim", "de2000", "de2000_p95", "lpips"}
DATA = tuple(m.name for m in METRICS.values() if m.kind == "data")


@dataclass(frozen=True)
class Viewing:
    """Inputs of metrics besides the pictures.

    exposures   first and last exposure in stops and their number for HDR-FLIP; None: computed from the reference
    lpips       (reference, test, mask) -> distance, of sRGB-encoded pictures; None: LPIPS is not measured
    lpips_text  description of that function
    """

    ppd: float = PPD
    peak: float = 1.0
    exposures: tuple[float, float, int] | None = None
    lpips: Callable[[np.ndarray, np.ndarray, np.ndarray], float] | None = None
    lpips_text: str = "not measured: no weights were given"


@dataclass(frozen=True)
class MetricValues:
    """Values by metric, error maps (h w) by metric (flip, hdr_flip, de2000), and HDR-FLIP's exposures."""

    values: Mapping[str, float]
    maps: Mapping[str, Float[np.ndarray, "h w"]] = field(default_factory=dict)
    exposures: tuple[float, float, int] | None = None


def definitions(viewing: Viewing, names: Sequence[str]) -> dict[str, str]:
    """The definition of every metric in `names`, with the numbers of `viewing`."""
    if viewing.exposures is None:
        exposures = "as many exposures as the reference needs"
    else:
        first, last, count = viewing.exposures
        exposures = f"{count} exposures from {first:+.2f} to {last:+.2f} stops"
    known = dict(ppd=viewing.ppd, peak=viewing.peak, exposures=exposures, lpips=viewing.lpips_text)
    return {name: METRICS[name].definition.format(**known) for name in names}


def measure_colour(
    reference: Float[np.ndarray, "h w 3"],
    test: Float[np.ndarray, "h w 3"],
    mask: Bool[np.ndarray, "h w"],
    names: Sequence[str] = COLOUR,
    viewing: Viewing | None = None,
    progress: Callable[[float], None] = lambda done: None,
) -> MetricValues:
    """The metrics `names` of two linear pictures that are finite inside the mask. NaN for an empty mask.

    Raises ValueError if a pixel inside the mask is not finite.
    """
    viewing = viewing or Viewing()
    values, maps = dict.fromkeys(names, math.nan), {}
    if not mask.any():
        return MetricValues(values, maps, viewing.exposures)
    a, b = _inside(reference, test, mask)
    if not (np.isfinite(a).all() and np.isfinite(b).all()):
        raise ValueError("a pixel inside the mask is NaN or infinite")
    exposures = viewing.exposures
    jobs: dict[str, FlipPair] = {}
    if "hdr_flip" in names:
        exposures = exposures or flip_exposures(a, mask)
        jobs["hdr_flip"] = FlipPair(a, b, exposures)
    looks = (encoded(a), encoded(b)) if set(names) & ENCODED else None
    if "flip" in names and looks is not None:
        jobs["flip"] = FlipPair(*looks)

    def other_metrics() -> None:
        values.update(_linear(a, b, mask, names, viewing))
        progress(0.1)
        if looks is not None:
            values.update(_encoded(*looks, mask, names, viewing, maps))
        progress(0.4)

    if jobs:
        maps |= flip_maps(jobs, viewing.ppd, other_metrics)
        values |= {k: float(maps[k][mask].mean(dtype=np.float64)) for k in jobs}
    else:
        other_metrics()
    progress(1.0)
    return MetricValues(values, maps, exposures)


def _linear(a, b, mask, names: Sequence[str], viewing: Viewing) -> dict[str, float]:
    """The metrics on linear pictures."""
    values: dict[str, float] = {}
    if "psnr_linear" in names:
        values["psnr_linear"] = _decibels(_mean_square(a, b, mask), viewing.peak)
    if "relmse" in names or "smape" in names:
        values |= {k: v for k, v in _relative(a, b, mask).items() if k in names}
    return values


def _encoded(a, b, mask, names: Sequence[str], viewing: Viewing, maps: dict[str, np.ndarray]) -> dict[str, float]:
    """The metrics on sRGB-encoded pictures, except FLIP; fills `maps`."""
    values: dict[str, float] = {}
    if "psnr" in names:
        values["psnr"] = _decibels(_mean_square(a, b, mask), 1.0)
    if "ssim" in names:
        values["ssim"] = ssim(a, b, mask)
    if "de2000" in names or "de2000_p95" in names:
        maps["de2000"] = ciede_map(a, b)
        inside = maps["de2000"][mask]
        figures = {"de2000": float(inside.mean(dtype=np.float64)), "de2000_p95": float(np.percentile(inside, 95))}
        values |= {k: v for k, v in figures.items() if k in names}
    if "lpips" in names and viewing.lpips is not None and min(mask.shape) >= LPIPS_SMALLEST:
        values["lpips"] = float(viewing.lpips(a, b, mask))
    return values


def measure_data(
    reference: Float[np.ndarray, "h w c"],
    test: Float[np.ndarray, "h w c"],
    mask: Bool[np.ndarray, "h w"],
    names: Sequence[str] = DATA,
) -> MetricValues:
    """The metrics of non-colour layers (`angle`: of three channels); finite inside the mask."""
    values = {n: math.nan for n in names if n in DATA and (n != "angle" or reference.shape[2] == 3)}
    if not mask.any():
        return MetricValues(values)
    a, b = reference[mask].astype(np.float64), test[mask].astype(np.float64)
    gap = np.abs(a - b)
    figures = {
        "rmse": np.sqrt((gap**2).mean()),
        "mae": gap.mean(),
        "max_error": gap.max(),
        "differing": gap.any(axis=1).mean(),
    }
    if "angle" in values:
        figures["angle"] = _angle(a, b)
    return MetricValues({n: float(figures[n]) for n in values})


def _angle(a: Float[np.ndarray, "n 3"], b: Float[np.ndarray, "n 3"]) -> float:
    """By the half-angle formula: an arc cosine loses precision where vectors agree."""
    lengths = np.linalg.norm(a, axis=1), np.linalg.norm(b, axis=1)
    usable = (lengths[0] > 1e-6) & (lengths[1] > 1e-6)
    if not usable.any():
        return math.nan
    u, v = a[usable] / lengths[0][usable, None], b[usable] / lengths[1][usable, None]
    return float(np.degrees(2 * np.arctan2(np.linalg.norm(u - v, axis=1), np.linalg.norm(u + v, axis=1))).mean())


def encoded(linear: Float[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h w 3"]:
    """`srgb_from_linear` (clipped to 0..1) in rows, so that the temporaries of large pictures stay small."""
    result = np.empty(linear.shape, np.float32)
    for start in range(0, len(linear), ROWS):
        result[start : start + ROWS] = srgb_from_linear(linear[start : start + ROWS])
    return result


def flip_exposures(
    reference: Float[np.ndarray, "h w 3"], mask: Bool[np.ndarray, "h w"] | None = None
) -> tuple[float, float, int]:
    """First and last exposure (stops) and their number by HDR-FLIP's rule for a linear reference.

    The rule uses the largest and the median luminance. Here they are over the pixels inside the mask that are not
    black, so that an empty background does not add exposures of noise only. (0, 0, 2) without any light.
    """
    import flip_evaluator

    light = np.maximum(reference if mask is None else reference[mask], 0).reshape(-1, 3)
    bright = luminance(light)
    light, bright = light[bright > 0], bright[bright > 0]
    if len(light) == 0:
        return 0.0, 0.0, 2
    # A small picture with the same two luminances: FLIP takes seconds for a large one.
    middle = light[np.argpartition(bright, len(bright) // 2)[len(bright) // 2]]
    strip = np.tile(middle, (8, 8, 1)).astype(np.float32)
    strip[0, 0] = light[bright.argmax()]
    rule: Any = flip_evaluator.evaluate(strip, strip, "HDR", applyMagma=False, computeMeanError=False)[2]
    first, last, count = float(rule["startExposure"]), float(rule["stopExposure"]), int(rule["numExposures"])
    # With one exposure the package always returns 0.
    return (first, last, max(count, 2)) if math.isfinite(first) and math.isfinite(last) else (0.0, 0.0, 2)


def ciede_map(a: Float[np.ndarray, "h w 3"], b: Float[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h w"]:
    """CIEDE2000 of every pixel of two sRGB-encoded pictures."""
    result = np.zeros(a.shape[:2], np.float32)
    for start in range(0, len(a), ROWS):
        rows = slice(start, start + ROWS)
        result[rows] = delta_e(lab(a[rows]), lab(b[rows]))
    return result


def _inside(reference, test, mask) -> tuple[np.ndarray, np.ndarray]:
    """Both pictures, with the test equal to the reference outside the mask, and both 0 where that is not finite."""
    a, b = (picture.astype(np.float32, copy=False) for picture in (reference, test))
    if mask.all():
        return a, b
    a = np.where(mask[..., None] | np.isfinite(a).all(axis=-1, keepdims=True), a, np.float32(0))
    return a, np.where(mask[..., None], b, a)


def _mean_square(a, b, mask) -> float:
    total = 0.0
    for start in range(0, len(a), ROWS):
        rows = slice(start, start + ROWS)
        gap = (b[rows].astype(np.float64) - a[rows])[mask[rows]]
        total += float((gap**2).sum())
    return total / (3 * int(mask.sum()))


def _decibels(mean_square: float, peak: float) -> float:
    return math.inf if mean_square == 0 else 10 * math.log10(peak**2 / mean_square)


def _relative(a, b, mask) -> dict[str, float]:
    square, absolute = 0.0, 0.0
    for start in range(0, len(a), ROWS):
        rows = slice(start, start + ROWS)
        r, t = a[rows].astype(np.float64)[mask[rows]], b[rows].astype(np.float64)[mask[rows]]
        gap = np.abs(t - r)
        square += float((gap**2 / (r**2 + SMALL)).sum())
        absolute += float((gap / (np.abs(r) + np.abs(t) + SMALL)).sum())
    count = 3 * int(mask.sum())
    return {"relmse": square / count, "smape": absolute / count}


def ssim(a: Float[np.ndarray, "h w 3"], b: Float[np.ndarray, "h w 3"], mask: Bool[np.ndarray, "h w"]) -> float:
    """SSIM of two sRGB-encoded pictures, mean over the mask; NaN where the window of 11 pixels does not fit.

    Bands overlap by the window, so that large pictures need little memory.
    """
    from skimage.metrics import structural_similarity

    if min(a.shape[:2]) < 11:
        return math.nan
    total, reach, band = 0.0, 5, 512
    for start in range(0, len(a), band):
        low, high = max(0, start - reach), min(len(a), start + band + reach)
        if high - low < 11:
            low = max(0, high - 11)
        result: Any = structural_similarity(
            a[low:high],
            b[low:high],
            data_range=1.0,
            channel_axis=-1,
            gaussian_weights=True,
            use_sample_covariance=False,
            full=True,
        )
        own = result[1][start - low : min(start + band, len(a)) - low]
        total += float(own[mask[start : start + band]].sum(dtype=np.float64))
    return total / (3 * int(mask.sum()))
