"""Metrics for the report, the benchmarks and the fit's own checks; each function defines its metric.

Pictures are float arrays (h, w, 3), sRGB-encoded 0..1 unless a name contains linear; masks are bool. A metric over no
pixels is NaN. Higher is better for psnr and band_correlation; lower for the others.
"""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from mistyle.core.image import erode, gaussian, resize
from mistyle.measure.colour_difference import lab
from mistyle.measure.overlap import Overlap, seen_here, seen_there

PATCH = 5
SCALES = (1, 2, 4)
QUANTILES = 256
PROJECTIONS, SAMPLES = 64, 20_000  # random directions, and patches at a scale


def psnr(reference: Float[np.ndarray, "*n"], test: Float[np.ndarray, "*n"], mask: np.ndarray | None = None) -> float:
    """10 log10(1 / mean squared error), in dB, over the mask; infinite for equal pictures."""
    squares = (np.asarray(reference, np.float64) - test) ** 2
    error = float(squares[mask].mean() if mask is not None else squares.mean())
    return float("inf") if error == 0 else float(-10 * np.log10(error))


class PatchReference:
    """Sliced Wasserstein-1 distance to one style, for pictures with the same masks: 5x5 Lab patches (L / 100), mean
    over full, half and quarter scale, times 100.

    Patches are pooled over all pictures and all style pictures; the style's are sorted once. Each random unit direction
    compares QUANTILES quantiles. Only patches fully inside a mask count. Noise with the right histogram alone scores
    well: read it beside the detail correlation.
    """

    def __init__(self, masks, style, style_masks) -> None:
        self._scales = []
        for scale in SCALES:
            rng = np.random.default_rng(0)
            axes = rng.normal(size=(PATCH * PATCH * 3, PROJECTIONS)).astype(np.float32)
            axes /= np.linalg.norm(axes, axis=0)
            mine, theirs = (_places(m, scale, rng) for m in (masks, style_masks))
            if any(len(chosen) for chosen in mine) and any(len(chosen) for chosen in theirs):
                quantiles = _quantiles(_patches(style, theirs, scale) @ axes)
                self._scales.append((scale, axes, mine, quantiles))

    def distance(self, pictures: Sequence[Float[np.ndarray, "h w 3"]]) -> float:
        total = [
            float(np.abs(_quantiles(_patches(pictures, places, scale) @ axes) - theirs).mean())
            for scale, axes, places, theirs in self._scales
        ]
        return 100 * float(np.mean(total)) if total else float("nan")


def _quantiles(values: Float[np.ndarray, "n k"]) -> Float[np.ndarray, "k q"]:
    """QUANTILES evenly spread quantiles of each column, linear between the sorted values."""
    # Rows in memory: NumPy sorts them several times faster than it selects from columns.
    ordered = np.sort(np.ascontiguousarray(values.T), axis=1)
    at = (np.arange(QUANTILES) + 0.5) / QUANTILES * (ordered.shape[1] - 1)
    low = np.floor(at).astype(np.int64)
    below, above = ordered[:, low], ordered[:, np.minimum(low + 1, ordered.shape[1] - 1)]
    return below + (above - below) * (at - low).astype(np.float32)


def _places(masks, scale: int, rng: np.random.Generator) -> list[np.ndarray]:
    """Positions of about SAMPLES patches at one scale, drawn evenly from the pictures: flat pixel numbers of each."""
    places_by_picture = []
    for mask in masks:
        size = (mask.shape[0] // scale, mask.shape[1] // scale)
        if min(size) < PATCH:
            places_by_picture.append(np.zeros(0, np.int64))
            continue
        whole = erode(resize(mask.astype(np.float32), size) > 0.999, PATCH // 2)
        edge = PATCH // 2
        whole[:edge], whole[-edge:], whole[:, :edge], whole[:, -edge:] = False, False, False, False
        places = np.flatnonzero(whole)
        if len(places):
            places = rng.choice(places, min(len(places), SAMPLES // len(masks)), replace=False)
        places_by_picture.append(places)
    return places_by_picture


def _patches(pictures, places: Sequence[np.ndarray], scale: int) -> Float[np.ndarray, "n k"]:
    """The patches about chosen pixels of pictures at one scale, rows of Lab / 100."""
    patches = []
    for picture, chosen in zip(pictures, places, strict=True):
        if len(chosen) == 0:
            continue
        size = (picture.shape[0] // scale, picture.shape[1] // scale)
        small = lab(resize(picture, size)) / 100
        row, column = chosen // size[1], chosen % size[1]
        offsets = np.arange(-(PATCH // 2), PATCH // 2 + 1)
        window = small[row[:, None, None] + offsets[:, None], column[:, None, None] + offsets]
        patches.append(window.reshape(len(chosen), -1))
    return np.concatenate(patches)


def gram_distance(mine: Sequence[np.ndarray], theirs: Sequence[np.ndarray]) -> float:
    """Relative distance |G - G_style| / |G_style| (Frobenius) of Gram matrices, mean over levels."""
    return float(np.mean([np.linalg.norm(a - b) / np.linalg.norm(b) for a, b in zip(mine, theirs, strict=True)]))


def pooled_gram(pictures, masks, features: Callable[[Any], list[Any]] | None = None) -> list[np.ndarray]:
    """Gram matrices of features, as in `measure.features` (None: the filter bank), pooled over the masks' pixels.

    Outside its mask a picture has its mean colour, so that the silhouette contributes little.
    """
    import torch

    from mistyle.measure.features import filter_bank
    from mistyle.measure.losses import gram

    totals: list[np.ndarray] = []
    weights = [float(mask.sum()) for mask in masks]
    for picture, mask, weight in zip(pictures, masks, weights, strict=True):
        if weight == 0:
            continue
        filled = np.where(mask[..., None], picture, picture[mask].mean(axis=0))
        image = torch.from_numpy(np.ascontiguousarray(filled.transpose(2, 0, 1), np.float32))[None]
        inside = torch.from_numpy(erode(mask, 3).astype(np.float32))[None, None]
        with torch.no_grad():
            grams = [
                gram(maps, inside)[0].numpy() * (weight / sum(weights)) for maps in (features or filter_bank)(image)
            ]
        totals = grams if not totals else [a + b for a, b in zip(totals, grams, strict=True)]
    if not totals:
        raise ValueError("no picture has a pixel in its mask")
    return totals


class StyleReference:
    """Distance to one style, for pictures with the same masks: `PatchReference`'s plus ten times `gram_distance`, about
    equal shares for a painting's left half and its right. The style's statistics are computed once."""

    def __init__(self, masks, style, style_masks) -> None:
        self._masks, self._patches = masks, PatchReference(masks, style, style_masks)
        self._grams = pooled_gram(style, style_masks)

    def distance(self, pictures: Sequence[Float[np.ndarray, "h w 3"]]) -> float:
        return self._patches.distance(pictures) + 10 * gram_distance(pooled_gram(pictures, self._masks), self._grams)


def detail(
    picture: Float[np.ndarray, "h w 3"], mask: Bool[np.ndarray, "h w"], fine: float = 1.0, coarse: float = 8.0
) -> Float[np.ndarray, "h w"]:
    """Band-pass lightness: difference of Gaussians of `fine` and `coarse` pixels inside the mask, 0 outside."""
    light = lab(picture)[..., 0]
    weight = mask.astype(np.float32)

    def smooth(sigma: float) -> np.ndarray:
        return gaussian(light * weight, sigma) / np.maximum(gaussian(weight, sigma), 1e-3)

    return (smooth(fine) - smooth(coarse)) * mask


def band_correlation(
    one: Float[np.ndarray, "h w"], other: Float[np.ndarray, "h w"], mask: Bool[np.ndarray, "h w"]
) -> float:
    """Correlation of two pictures' `detail` over the mask, -1..1: agreement of strokes or shapes in position."""
    inner = erode(mask, 2)
    a, b = one[inner], other[inner]
    scale = np.sqrt(float((a * a).sum()) * float((b * b).sum()))
    return float((a * b).sum() / scale) if scale > 0 else float("nan")


def warp_error(
    shared: Overlap, picture: Float[np.ndarray, "h w 3"], other_picture: Float[np.ndarray, "h w 3"]
) -> float:
    """View-to-view error: mean |Delta L| + |Delta a| + |Delta b| (Lab / 100, times 100) of the points that both views
    see, at the coarser of their two pixels."""
    if not shared.both.any():
        return float("nan")
    return float(np.abs(lab(seen_here(shared, picture)) - lab(seen_there(shared, other_picture))).sum(axis=1).mean())
