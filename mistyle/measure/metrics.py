"""Metrics for the report, the benchmarks and the fit's own checks; each function defines its metric.

Pictures are float arrays (h, w, 3), sRGB-encoded 0..1 unless a name contains linear; masks are bool. A metric over no
pixels is NaN. Higher is better for psnr, detail_correlation and coverage; lower for the others.
"""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from mistyle.core.image import erode, gaussian, resize
from mistyle.core.view import View
from mistyle.measure.colour_difference import lab
from mistyle.measure.overlap import Overlap, overlap, seen_here, seen_there

PATCH = 5
SCALES = (1, 2, 4)
QUANTILES = 256


def psnr(reference: Float[np.ndarray, "*n"], test: Float[np.ndarray, "*n"], mask: np.ndarray | None = None) -> float:
    """10 log10(1 / mean squared error), in dB, over the mask; infinite for equal pictures."""
    squares = (np.asarray(reference, np.float64) - test) ** 2
    error = float(squares[mask].mean() if mask is not None else squares.mean())
    return float("inf") if error == 0 else float(-10 * np.log10(error))


def patch_distance(
    pictures: Sequence[Float[np.ndarray, "h w 3"]],
    masks: Sequence[Bool[np.ndarray, "h w"]],
    style: Sequence[Float[np.ndarray, "i j 3"]],
    style_masks: Sequence[Bool[np.ndarray, "i j"]] | None = None,
    projections: int = 64,
    samples: int = 20_000,
    seed: int = 0,
) -> float:
    """Sliced Wasserstein-1 distance of 5x5 Lab patches (L / 100), mean over full, half and quarter scale; times 100.

    Patches are pooled over all pictures and all style pictures; each random unit direction compares QUANTILES
    quantiles. Only patches fully inside a mask count. Noise with the right histogram alone scores well: read it beside
    the detail correlation.
    """
    inside = style_masks or [np.ones(s.shape[:2], bool) for s in style]
    return PatchReference(masks, style, inside, projections, samples, seed).distance(pictures)


class PatchReference:
    """`patch_distance` to one style, whose patches are sorted once, for pictures with the same masks."""

    def __init__(self, masks, style, style_masks, projections: int = 64, samples: int = 20_000, seed: int = 0) -> None:
        self._scales = []
        for scale in SCALES:
            rng = np.random.default_rng(seed)
            axes = rng.normal(size=(PATCH * PATCH * 3, projections)).astype(np.float32)
            axes /= np.linalg.norm(axes, axis=0)
            mine, theirs = (_places(m, scale, samples, rng) for m in (masks, style_masks))
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


def _places(masks, scale: int, samples: int, rng: np.random.Generator) -> list[np.ndarray]:
    """Positions of about `samples` patches at one scale, drawn evenly from the pictures: flat pixel numbers of each."""
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
            places = rng.choice(places, min(len(places), samples // len(masks)), replace=False)
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


def gram_distance(
    pictures: Sequence[Float[np.ndarray, "h w 3"]],
    masks: Sequence[Bool[np.ndarray, "h w"]],
    style: Sequence[Float[np.ndarray, "i j 3"]],
    style_masks: Sequence[Bool[np.ndarray, "i j"]] | None = None,
    features: Callable[[Any], list[Any]] | None = None,
) -> float:
    """Relative distance |G - G_style| / |G_style| (Frobenius) of the features' Gram matrices, mean over levels.

    `features` as in `measure.features` (None: the filter bank). Gram matrices are pooled over the pixels in the
    pictures' masks; outside, a masked picture has its mean colour, so that the silhouette contributes little.
    """
    inside = style_masks or [np.ones(s.shape[:2], bool) for s in style]
    return _gram_ratio(_pooled_gram(pictures, masks, features), _pooled_gram(style, inside, features))


def _gram_ratio(mine: Sequence[np.ndarray], theirs: Sequence[np.ndarray]) -> float:
    return float(np.mean([np.linalg.norm(a - b) / np.linalg.norm(b) for a, b in zip(mine, theirs, strict=True)]))


def _pooled_gram(pictures, masks, features) -> list[np.ndarray]:
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


def style_distance(pictures, masks, style, style_masks=None, seed: int = 0) -> float:
    """`patch_distance` plus ten times `gram_distance`: about equal shares for a painting's left half and its right."""
    inside = style_masks or [np.ones(s.shape[:2], bool) for s in style]
    return StyleReference(masks, style, inside, seed).distance(pictures)


class StyleReference:
    """`style_distance` to one style, whose statistics are computed once, for pictures with the same masks."""

    def __init__(self, masks, style, style_masks, seed: int = 0) -> None:
        self._masks = masks
        self._patches = PatchReference(masks, style, style_masks, seed=seed)
        self._grams = _pooled_gram(style, style_masks, None)

    def distance(self, pictures: Sequence[Float[np.ndarray, "h w 3"]]) -> float:
        return self._patches.distance(pictures) + 10 * _gram_ratio(
            _pooled_gram(pictures, self._masks, None), self._grams
        )


def detail(
    picture: Float[np.ndarray, "h w 3"], mask: Bool[np.ndarray, "h w"], fine: float = 1.0, coarse: float = 8.0
) -> Float[np.ndarray, "h w"]:
    """Band-pass lightness: difference of Gaussians of `fine` and `coarse` pixels inside the mask, 0 outside."""
    light = lab(picture)[..., 0]
    weight = mask.astype(np.float32)

    def smooth(sigma: float) -> np.ndarray:
        return gaussian(light * weight, sigma) / np.maximum(gaussian(weight, sigma), 1e-3)

    return (smooth(fine) - smooth(coarse)) * mask


def detail_correlation(
    picture: Float[np.ndarray, "h w 3"], reference: Float[np.ndarray, "h w 3"], mask: Bool[np.ndarray, "h w"]
) -> float:
    """Correlation of the pictures' `detail` over the mask, -1..1: agreement of strokes or shapes in position."""
    return band_correlation(detail(picture, mask), detail(reference, mask), mask)


def band_correlation(
    one: Float[np.ndarray, "h w"], other: Float[np.ndarray, "h w"], mask: Bool[np.ndarray, "h w"]
) -> float:
    """`detail_correlation` of two pictures' `detail`."""
    inner = erode(mask, 2)
    a, b = one[inner], other[inner]
    scale = np.sqrt(float((a * a).sum()) * float((b * b).sum()))
    return float((a * b).sum() / scale) if scale > 0 else float("nan")


def warp_error(
    view: View, other: View, picture: Float[np.ndarray, "h w 3"], other_picture: Float[np.ndarray, "h w 3"]
) -> float:
    """View-to-view error: mean |Delta L| + |Delta a| + |Delta b| (Lab / 100, times 100) of points both views see.

    Every pixel of `view` is reprojected by its depth into `other`. It counts where the depths agree and both are three
    pixels inside their masks, at the coarser of the two pixels (`overlap`).
    """
    return shared_error(overlap(view, other), picture, other_picture)


def shared_error(
    shared: Overlap, picture: Float[np.ndarray, "h w 3"], other_picture: Float[np.ndarray, "h w 3"]
) -> float:
    """`warp_error` of views whose `overlap` is known."""
    if not shared.both.any():
        return float("nan")
    return float(np.abs(lab(seen_here(shared, picture)) - lab(seen_there(shared, other_picture))).sum(axis=1).mean())


def coverage(known: Bool[np.ndarray, "h w"], covered: Bool[np.ndarray, "h w"]) -> float:
    """Share of the covered texels that a view sees and paints."""
    return float(known[covered].mean()) if covered.any() else float("nan")
