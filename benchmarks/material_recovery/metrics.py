"""How right a fitted material is: per texel against known maps, and relit against known pictures.

Texel figures are weighted means over an atlas: a texel's weight is the surface area it stands for where it counts
(`texel_areas`, times whoever decides what counts) and 0 elsewhere. A figure over no texels is NaN. Picture figures take
linear radiance and are over the object's pixels. Higher is better for PSNR and SSIM, lower for all others.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
from jaxtyping import Bool, Float

from mistyle.core.image import erode, srgb_from_linear
from mistyle.core.maps import Maps, Texels
from mistyle.core.mesh import Mesh, face_areas
from mistyle.measure.metrics import psnr
from mistyle.measure.pictures.flip_bands import flip_map
from mistyle.measure.pictures.metrics import PPD, ssim

HDR_CLIP = 4.0


@dataclass(frozen=True)
class MapErrors:
    """Fitted maps against true ones.

    albedo_psnr          dB, linear Rec.709, peak 1, mean over the channels
    albedo_psnr_aligned  the same after the factor per channel that minimises the squared error
    roughness_mse        mean squared error of perceptual roughness
    roughness_median     median absolute error
    metallic_mse         mean squared error
    metallic_right       share on the true side of 0.5
    normal_*_deg         angle between tangent-space normals, degrees: mean, median, 95th percentile
    """

    albedo_psnr: float
    albedo_psnr_aligned: float
    roughness_mse: float
    roughness_median: float
    metallic_mse: float
    metallic_right: float
    normal_mean_deg: float
    normal_median_deg: float
    normal_p95_deg: float


@dataclass(frozen=True)
class RelightErrors:
    """A relit picture against the true one: `psnr_hdr`, `psnr_ldr`, SSIM and mean FLIP of the sRGB pictures."""

    psnr_h: float
    psnr_l: float
    ssim: float
    flip: float


def texel_areas(mesh: Mesh, texels: Texels) -> Float[np.ndarray, "h w"]:
    """The surface area (working units squared) that each covered texel stands for: its face's area per UV area, times
    the texel's; 0 where no face covers it, and for faces without UV area."""
    uv = mesh.corner_uvs.astype(np.float64)
    e1, e2 = uv[:, 1] - uv[:, 0], uv[:, 2] - uv[:, 0]
    in_uv = np.abs(e1[:, 0] * e2[:, 1] - e1[:, 1] * e2[:, 0]) / 2
    stretch = np.where(in_uv > 0, face_areas(mesh), 0) / np.where(in_uv > 0, in_uv, 1)
    return np.where(texels.covered, stretch[np.maximum(texels.face, 0)] / texels.covered.size, 0)


def confident(
    weights: Float[np.ndarray, "h w"], confidence: Float[np.ndarray, "h w"], share: float = 0.95
) -> Float[np.ndarray, "h w"]:
    """The weights of the most confident texels that make up `share` of the total weight; 0 for the others.

    Equal confidences stay or go together (they stay).
    """
    if not weights.any():
        return weights.copy()
    limit = quantile(confidence, weights, 1 - share)
    return np.where(confidence >= limit, weights, 0)


def quantile(values: Float[np.ndarray, "*n"], weights: Float[np.ndarray, "*n"], q: float) -> float:
    """The smallest value at which the weights of all values up to it reach share `q` of their sum."""
    chosen = weights.ravel() > 0
    v, w = values.ravel()[chosen].astype(np.float64), weights.ravel()[chosen].astype(np.float64)
    if len(v) == 0:
        return float("nan")
    order = np.argsort(v, kind="stable")
    reached = np.cumsum(w[order])
    # A share that is reached up to rounding is reached.
    return float(v[order][min(np.searchsorted(reached, q * reached[-1] * (1 - 1e-12)), len(v) - 1)])


def angles(truth: Float[np.ndarray, "*n 3"], fitted: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n"]:
    """Degrees between unit vectors, exact for small angles too: 2 atan2(|a - b|, |a + b|)."""
    a, b = truth.astype(np.float64), fitted.astype(np.float64)
    return np.degrees(2 * np.arctan2(np.linalg.norm(a - b, axis=-1), np.linalg.norm(a + b, axis=-1)))


def calibration(
    truth: Sequence[Maps],
    fitted: Sequence[Maps],
    spread: Sequence[Mapping[str, Float[np.ndarray, "h w"]]],
    weights: Sequence[Float[np.ndarray, "h w"]],
) -> dict[str, float]:
    """Share of the surface whose error is within the fit's own standard deviation (`Recovered.spread`), per map, and
    "calibration_worst", the largest distance of these shares from 0.683, that of a normal distribution.

    An error is the root mean square over the albedo's channels, or over the two components of the normal's tilt.
    """
    w = np.concatenate([x.ravel() for x in weights]).astype(np.float64)
    result = {}
    for name in ("albedo", "normal", "roughness", "metallic"):
        inside = []
        for a, b, s in zip(truth, fitted, spread, strict=True):
            one, two = getattr(a, name), getattr(b, name)
            if name == "normal":
                error = np.radians(angles(one, two)) / np.sqrt(2)
            else:
                error = np.sqrt(((one - two).reshape(*one.shape[:2], -1) ** 2).mean(axis=-1))
            inside.append((error <= s[name]).ravel())
        result[f"within_{name}"] = float((np.concatenate(inside) * w).sum() / w.sum()) if w.any() else float("nan")
    return result | {"calibration_worst": max(abs(share - 0.683) for share in result.values())}


def map_errors(truth: Sequence[Maps], fitted: Sequence[Maps], weights: Sequence[Float[np.ndarray, "h w"]]) -> MapErrors:
    """All texture sets of an object as one; weights by texel, see the module."""
    w = np.concatenate([x.ravel() for x in weights]).astype(np.float64)
    chosen = w > 0
    w = w[chosen]

    def both(name: str) -> tuple[np.ndarray, np.ndarray]:
        a, b = (
            np.concatenate([getattr(m, name).reshape(x.size, -1) for m, x in zip(maps, weights, strict=True)])[chosen]
            for maps in (truth, fitted)
        )
        return a.astype(np.float64), b.astype(np.float64)

    albedo, roughness, metallic = both("albedo"), both("roughness"), both("metallic")
    angle = angles(*both("normal"))
    return MapErrors(
        albedo_psnr=_decibels(_mean_square(*albedo, w)),
        albedo_psnr_aligned=_decibels(_mean_square(albedo[0], albedo[1] * channel_scale(*albedo, w), w)),
        roughness_mse=_mean_square(*roughness, w),
        roughness_median=quantile(np.abs(roughness[0] - roughness[1])[:, 0], w, 0.5),
        metallic_mse=_mean_square(*metallic, w),
        metallic_right=_share_alike(*metallic, w),
        normal_mean_deg=float((angle * w).sum() / w.sum()) if len(w) else float("nan"),
        normal_median_deg=quantile(angle, w, 0.5),
        normal_p95_deg=quantile(angle, w, 0.95),
    )


def best_constant(truth: Sequence[Maps], weights: Sequence[Float[np.ndarray, "h w"]]) -> list[Maps]:
    """The maps of one value each that come closest to the truth in mean square: its weighted means; the normal is the
    direction of the mean. What any fit has to beat."""
    total = sum(float(w.sum()) for w in weights)
    result = list(truth)
    for name in ("albedo", "normal", "roughness", "metallic"):
        mean = sum(
            np.tensordot(w, getattr(m, name).astype(np.float64), axes=2) for m, w in zip(truth, weights, strict=True)
        )
        mean = np.asarray(mean / total if total else mean)
        if name == "normal":
            length = np.linalg.norm(mean)
            mean = mean / length if length > 1e-9 else np.array([0.0, 0.0, 1.0])
        for k, m in enumerate(truth):
            values = np.broadcast_to(mean, getattr(m, name).shape).astype(np.float32)
            result[k] = replace(result[k], **{name: values})
    return result


def channel_scale(
    truth: Float[np.ndarray, "n c"], fitted: Float[np.ndarray, "n c"], weights: Float[np.ndarray, " n"]
) -> Float[np.ndarray, " c"]:
    """Per channel the factor k that minimises sum w (truth - k fitted)²; 1 where the fitted channel is black."""
    squares = (weights[:, None] * fitted**2).sum(axis=0)
    products = (weights[:, None] * truth * fitted).sum(axis=0)
    return np.where(squares > 0, products / np.where(squares > 0, squares, 1), 1)


def _mean_square(a: np.ndarray, b: np.ndarray, weights: np.ndarray) -> float:
    """Weighted over rows, plain over channels."""
    if len(weights) == 0:
        return float("nan")
    return float((((a - b) ** 2).mean(axis=1) * weights).sum() / weights.sum())


def _share_alike(a: np.ndarray, b: np.ndarray, weights: np.ndarray) -> float:
    """Share of the weight where both are on one side of 0.5."""
    alike = ((a > 0.5) == (b > 0.5)).ravel()
    return float((alike * weights).sum() / weights.sum()) if weights.any() else float("nan")


def _decibels(mean_square: float) -> float:
    return float("inf") if mean_square == 0 else float(-10 * np.log10(mean_square))


def brightening(reference: Float[np.ndarray, "h w 3"], mask: Bool[np.ndarray, "h w"]) -> float:
    """The factor by which Stanford-ORB makes dark linear pictures comparable before its HDR figure: the mean of the
    reference's sRGB values over the mean of its linear values, both clipped to 0..1 (its code calls it a median)."""
    inside = np.clip(reference[mask], 0, 1)
    mean = float(inside.mean()) if inside.size else 0.0
    return float(srgb_from_linear(inside).mean()) / mean if mean > 1e-8 else 1.0


def psnr_hdr(
    reference: Float[np.ndarray, "h w 3"],
    test: Float[np.ndarray, "h w 3"],
    mask: Bool[np.ndarray, "h w"],
    whole: bool = False,
) -> float:
    """PSNR-H: both pictures times `brightening`, clipped to 0..4; -10 log10 of the mean squared error, peak 1.

    The mean is over the mask; `whole` takes it over the whole picture with everything beside the mask equal, as
    Stanford-ORB does, which raises the figure by 10 log10(pixels / pixels of the object).
    """
    scale = brightening(reference, mask)
    return _masked_psnr(
        np.clip(reference * scale, 0, HDR_CLIP), np.clip(np.maximum(test, 0) * scale, 0, HDR_CLIP), mask, whole
    )


def psnr_ldr(
    reference: Float[np.ndarray, "h w 3"],
    test: Float[np.ndarray, "h w 3"],
    mask: Bool[np.ndarray, "h w"],
    whole: bool = False,
) -> float:
    """PSNR-L: of the sRGB-encoded pictures, clipped to 0..1. `whole` as in `psnr_hdr`."""
    return _masked_psnr(srgb_from_linear(reference), srgb_from_linear(test), mask, whole)


def _masked_psnr(a: np.ndarray, b: np.ndarray, mask: np.ndarray, whole: bool) -> float:
    inside = mask[..., None]
    return psnr(a * inside, b * inside) if whole else psnr(a, b, mask)


def align_channels(
    reference: Float[np.ndarray, "h w 3"], test: Float[np.ndarray, "h w 3"], mask: Bool[np.ndarray, "h w"]
) -> Float[np.ndarray, "h w 3"]:
    """`test` times the factor per channel that brings it closest to the reference in linear least squares, as
    Stanford-ORB and TensoIR do where the light's brightness is unknown."""
    a, b = reference[mask].astype(np.float64), test[mask].astype(np.float64)
    return (test * channel_scale(a, b, np.ones(len(a)))).astype(np.float32)


def orb_mask(coverage: Float[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Stanford-ORB's: more than half covered, then eroded by a window of 5 x 5."""
    return erode(coverage > 0.5, 2)


def relight_errors(
    reference: Float[np.ndarray, "h w 3"], test: Float[np.ndarray, "h w 3"], mask: Bool[np.ndarray, "h w"]
) -> RelightErrors:
    """All figures of one picture, linear radiance in; for SSIM and FLIP everything beside the mask is black in both,
    and both are means over the mask."""
    a, b = (srgb_from_linear(p) * mask[..., None] for p in (reference, test))
    if not mask.any():
        return RelightErrors(*[float("nan")] * 4)
    error = float(flip_map(a, b, PPD).sum(dtype=np.float64)) / int(mask.sum())
    return RelightErrors(psnr_hdr(reference, test, mask), psnr_ldr(reference, test, mask), ssim(a, b, mask), error)


def mean_errors(errors: Sequence[RelightErrors]) -> RelightErrors:
    """The plain mean of each figure over pictures (of decibels too, as the published tables have it)."""
    return RelightErrors(*(float(np.mean([getattr(e, f.name) for e in errors])) for f in fields(RelightErrors)))
