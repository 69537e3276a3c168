"""Losses of the map optimisation (paper 4.2): style on jittered masked crops, total variation, sliced Wasserstein.

Pictures are (n, c, h, w) sRGB-encoded 0..1, masks (n, 1, h, w) bool or 0..1; every loss is a scalar tensor. Means
replace the paper's sums, so that a weight is independent of resolution.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
import torch.nn.functional as functional
from jaxtyping import Bool, Float, Int

from mistyle.measure.features import Features

Statistic = Literal["gram", "mean-std", "swd"]

# Directions and pixels of a crop in the comparison of the features' distributions ("swd").
SWD_PROJECTIONS, SWD_SAMPLES = 16, 4096
# Pixels of a crop that suffice for its statistics.
DENSE = 128 * 128
# Least standard deviation (sRGB units) in the division by contrast, so that a flat crop is not amplified to noise.
FAINT = 0.02
# Cosine below which a light grazes the surface, and shading is not proportional to slope.
GRAZING_LIGHT = 0.25
# The mean difference of neighbouring pixels at which the adaptive weight is a half.
REFERENCE_GRADIENT = 0.05


@dataclass(frozen=True)
class Crop:
    """A square window of a view: top left corner and side, in the view's pixels (real numbers)."""

    view: int
    x: float
    y: float
    width: float


def sample_crops(
    rng: np.random.Generator,
    masks: Sequence[Bool[np.ndarray, "h w"]],
    count: int,
    size: int,
    scale: tuple[float, float] = (0.5, 1.0),
    covered: float = 0.4,
    views: Sequence[int] | None = None,
) -> list[Crop]:
    """Random crops with spatial and scaling jitter (paper 4.2, phase 1).

    The crops of one call share their side: `size` times a log-uniform factor from `scale`, at most the view's own. Each
    position is the first of a few uniform draws whose mask covers the share `covered`, else the fullest. Views are
    drawn uniformly, or come from `views` in turn. Positions are continuous: the caller samples the target and moves the
    camera alike.
    """
    crops = []
    factor = float(np.exp(rng.uniform(np.log(scale[0]), np.log(scale[1]))))
    for k in range(count):
        view = int(views[k % len(views)]) if views else int(rng.integers(len(masks)))
        mask = masks[view]
        height, width = mask.shape
        side = min(size * factor, float(width), float(height))
        best, best_share = None, -1.0
        for _ in range(12):
            x, y = float(rng.uniform(0, width - side)), float(rng.uniform(0, height - side))
            step = max(int(side) // 32, 1)
            share = float(mask[int(y) : int(y + side) : step, int(x) : int(x + side) : step].mean())
            if share > best_share:
                best, best_share = Crop(view, x, y, side), share
            if share >= covered:
                break
        assert best is not None
        crops.append(best)
    return crops


def crop_picture(picture: Float[torch.Tensor, "c h w"], crop: Crop, size: int) -> Float[torch.Tensor, "c s s"]:
    """The window of a picture, bilinear, `size` pixels along each side; pixel centres at +0.5 in both."""
    height, width = picture.shape[1:]
    at = (torch.arange(size, dtype=torch.float32) + 0.5) / size * crop.width
    x, y = (at + crop.x) / width * 2 - 1, (at + crop.y) / height * 2 - 1
    grid = torch.stack(torch.meshgrid(x, y, indexing="xy"), dim=-1)[None]
    return functional.grid_sample(picture[None], grid, mode="bilinear", padding_mode="border", align_corners=False)[0]


def style_aligned(maps: Sequence[torch.Tensor], targets: Sequence[torch.Tensor], mask: torch.Tensor) -> torch.Tensor:
    """sum_l mean |Phi_l(R * M_R) - Phi_l(T * M_T)|² (paper 4.2).

    `maps` are the features of the masked render, `targets` of the masked target. The loss is meaningful only if both
    show the same place: crops of the stylized view of the same camera. The pictures are masked before feature
    extraction (`masked_features`), so pixels outside have no influence at all. The sum is divided by the mask's share,
    so that a half-empty crop weighs as much per pixel as a full one.
    """
    total = maps[0].new_zeros(())
    for a, b in zip(maps, targets, strict=True):
        total = total + functional.mse_loss(a, b)
    return total / mask.to(total.dtype).mean().clamp_min(1e-3)


def style_statistics(
    maps: Sequence[torch.Tensor],
    targets: Sequence[torch.Tensor],
    mask: torch.Tensor,
    target_mask: torch.Tensor,
    kind: Statistic = "gram",
    rng: np.random.Generator | None = None,
) -> torch.Tensor:
    """Squared distance of the features' global statistics, relative to the target's mean energy per map.

    `kind`: "gram", mean over the entries of the Gram matrices (relative to the energy squared); "mean-std", mean over
    means and standard deviations of the maps; "swd", sliced Wasserstein distance of the pixels' features, for which
    `rng` draws directions and pixels. All ignore positions within a crop, so render and target need not show the same
    place and may differ in size. The masks are shrunk with the features; each crop counts alike. Maps as large as the
    mask and larger than DENSE are subsampled to every second row and column.
    """
    total = maps[0].new_zeros(())
    whole = mask, target_mask
    for a, b in zip(maps, targets, strict=True):
        (a, mask), (b, target_mask) = (_subsampled(*each) for each in zip((a, b), whole, strict=True))
        if kind == "gram":
            mine, theirs = gram(a, mask), gram(b, target_mask)
            energy = theirs.diagonal(dim1=1, dim2=2).mean(dim=1).clamp_min(1e-8)
            distance = ((mine - theirs) / energy[:, None, None]).square().mean()
        elif kind == "mean-std":
            mine, theirs = _moments(a, mask), _moments(b, target_mask)
            energy = theirs.square().sum(dim=1).mean(dim=1).clamp_min(1e-8)
            distance = ((mine - theirs).square().mean(dim=(1, 2)) / energy).mean()
        else:
            distance = _feature_swd(a, b, mask, target_mask, rng or np.random.default_rng(0))
        total = total + distance
    return total


def _subsampled(maps: torch.Tensor, mask: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    if maps.shape[2:] != mask.shape[2:] or maps[0, 0].numel() <= DENSE:
        return maps, mask
    return maps[:, :, ::2, ::2], mask[:, :, ::2, ::2]


def _shares(maps: torch.Tensor, mask: torch.Tensor) -> Float[torch.Tensor, "n 1 p"]:
    """The mask's share of each pixel of `maps`."""
    return functional.interpolate(mask.to(maps), size=maps.shape[2:], mode="area").flatten(2)


def _moments(maps: torch.Tensor, mask: torch.Tensor) -> Float[torch.Tensor, "n 2 k"]:
    """Mean and standard deviation of every map over the mask; the sum of their squares is the mean square."""
    share, flat = _shares(maps, mask), maps.flatten(2)
    share = share / share.sum(dim=2, keepdim=True).clamp_min(1e-6)
    mean = (flat * share).sum(dim=2)
    variance = ((flat - mean[:, :, None]).square() * share).sum(dim=2)
    return torch.stack([mean, variance.clamp_min(1e-12).sqrt()], dim=1)


def _feature_swd(a, b, mask, target_mask, rng: np.random.Generator) -> torch.Tensor:
    """Mean over the crops with pixels in both masks."""
    inside = [_shares(maps, m)[:, 0] > 0.5 for maps, m in ((a, mask), (b, target_mask))]
    distances = []
    for k in range(len(a)):
        mine, theirs = (maps[k].flatten(1).T[chosen[k]] for maps, chosen in zip((a, b), inside, strict=True))
        if len(mine) and len(theirs):
            distance = sliced_wasserstein(mine, theirs, rng, SWD_PROJECTIONS, SWD_SAMPLES)
            distances.append(distance / theirs.square().mean().clamp_min(1e-8))
    return torch.stack(distances).mean() if distances else a.new_zeros(())


def masked_features(
    features: Features, render: torch.Tensor, target: torch.Tensor, mask: torch.Tensor, mask_target: torch.Tensor
) -> tuple[list[torch.Tensor], list[torch.Tensor]]:
    """Phi(R * M_R), with its gradient, and Phi(T * M_T), without."""
    with torch.no_grad():
        targets = features(target * mask_target)
    return features(render * mask), targets


def gram(maps: Float[torch.Tensor, "n k h w"], mask: torch.Tensor) -> Float[torch.Tensor, "n k k"]:
    """Mean over the mask of the outer product of the features of a pixel."""
    share, flat = _shares(maps, mask), maps.flatten(2)
    return (flat * share) @ flat.transpose(1, 2) / share.sum(dim=2, keepdim=True).clamp_min(1e-6)


def without_light(
    picture: Float[torch.Tensor, "n 1 h w"], mask: torch.Tensor, radius: float, standard: bool = False
) -> Float[torch.Tensor, "n 1 h w"]:
    """A grey picture without its local mean and, if `standard`, without its contrast: the relative detail.

    The local mean (Gaussian of `radius` pixels inside the mask) is divided out, which removes smooth shading, bright or
    dark: x / mean - 1. `standard` divides by each crop's standard deviation over the mask (faint crops stay faint).
    Zero outside the mask.
    """
    mask = mask.to(picture)
    weight = blur(mask, radius).clamp_min(1e-3)
    mean = blur(picture * mask, radius) / weight
    detail = (picture / mean.clamp_min(1e-2) - 1) * mask
    return detail / deviation(detail, mask).clamp_min(FAINT) if standard else detail


def deviation(values: Float[torch.Tensor, "n c h w"], mask: torch.Tensor) -> Float[torch.Tensor, "n 1 1 1"]:
    """Root mean square length of the pixels' values over each crop's mask."""
    squares = (values.square() * mask).sum(dim=(1, 2, 3), keepdim=True)
    return (squares / mask.sum(dim=(1, 2, 3), keepdim=True).clamp_min(1)).sqrt()


def stroke_shading(
    strokes: Float[torch.Tensor, "n 1 h w"],
    position: Float[torch.Tensor, "n 3 h w"],
    normal: Float[torch.Tensor, "n 3 h w"],
    towards_light: Float[torch.Tensor, "n 3"],
    mask: torch.Tensor,
    slope: float,
) -> tuple[Float[torch.Tensor, "n 1 h w"], Float[torch.Tensor, "n 1 h w"]]:
    """Shading of strokes in relief, bright ones highest, under a light, and the mask where it is valid.

    With the strokes' brightness s as height, the surface's normal turns by minus its gradient along the surface, and
    Lambert's shading changes by the factor 1 - (l . grad s) / (l . n) to first order. The gradient along the surface
    follows from differences between pixels of s and of `position`. It is scaled so that its root mean square over each
    crop is `slope` (less for faint crops). The mask selects pixels whose neighbours lie on the surface too and that the
    light does not graze.
    """
    inside = 1 - functional.max_pool2d(functional.pad(1 - mask.to(strokes), (1, 1, 1, 1), value=1.0), 3, stride=1)
    across, down = _differences(position)
    s_across, s_down = _differences(strokes)
    xx, yy, xy = (across * across).sum(1, True), (down * down).sum(1, True), (across * down).sum(1, True)
    area = (xx * yy - xy * xy).clamp_min(1e-20)
    along_x, along_y = (yy * s_across - xy * s_down) / area, (xx * s_down - xy * s_across) / area
    gradient = (along_x * across + along_y * down) * inside
    light = towards_light[:, :, None, None]
    cosine = (light * normal).sum(1, True)
    valid = inside * (cosine > GRAZING_LIGHT)
    faint = (deviation(strokes, inside) / FAINT).clamp_max(1)
    gradient = gradient * (slope * faint / deviation(gradient, inside).clamp_min(1e-6))
    shading = -(light * gradient).sum(1, True) / cosine.clamp_min(GRAZING_LIGHT)
    return shading.clamp(-0.9, 0.9) * valid, valid


def _differences(values: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Central differences to the right and downwards, per pixel; only half of a difference at the border."""
    padded = _pad_edge(values)
    return (padded[:, :, 1:-1, 2:] - padded[:, :, 1:-1, :-2]) / 2, (
        padded[:, :, 2:, 1:-1] - padded[:, :, :-2, 1:-1]
    ) / 2


def _pad_edge(values: torch.Tensor) -> torch.Tensor:
    return functional.pad(values, (1, 1, 1, 1), mode="replicate")


def mean_gradient(picture: Float[np.ndarray, "h w 3"], mask: Bool[np.ndarray, "h w"] | None = None) -> float:
    """Mean absolute difference of neighbouring pixels (both axes, all channels), of pairs inside the mask."""
    inside = np.ones(picture.shape[:2], bool) if mask is None else mask
    across = np.abs(np.diff(picture, axis=1))[inside[:, 1:] & inside[:, :-1]]
    down = np.abs(np.diff(picture, axis=0))[inside[1:] & inside[:-1]]
    both = np.concatenate([across, down])
    return float(both.mean(dtype=np.float64)) if both.size else 0.0


def adaptive_tv_weight(gradient: float, largest: float) -> float:
    """The total-variation weight of phase 2 for a style of this `mean_gradient` (sRGB) (paper 4.2).

    largest / (1 + gradient / REFERENCE_GRADIENT): `largest` for a flat style, less with more texture. The paper
    describes the adaptation without a formula.
    """
    return float(largest / (1 + gradient / REFERENCE_GRADIENT))


def sliced_wasserstein(
    render: Float[torch.Tensor, "n k"],
    target: Float[torch.Tensor, "m k"],
    rng: np.random.Generator,
    projections: int = 32,
    samples: int | None = None,
) -> torch.Tensor:
    """E over directions of mean (sort(R.d) - sort(T.d))², in RGB (paper 4.2, L_color) or any k numbers a pixel.

    Directions are uniform on the sphere. Both sides are subsampled to the same number of pixels (`samples`, or the
    smaller side), without replacement.
    """
    count = min(len(render), len(target), samples or len(render))
    directions = rng.normal(size=(render.shape[1], projections))
    directions /= np.linalg.norm(directions, axis=0)
    axes = torch.from_numpy(directions).to(render)
    a, b = (_draw(pixels, count, rng) @ axes for pixels in (render, target))
    a, b = a.T.contiguous(), b.T.contiguous()
    return functional.mse_loss(a.gather(1, _order(a)), b.gather(1, _order(b)))


def _order(rows: Float[torch.Tensor, "k n"]) -> Int[torch.Tensor, "k n"]:
    """The stable order that sorts each row.

    NumPy sorts integers ten times faster than torch sorts with indices. Each key is the value's bits, mapped to be
    monotonic, above its index.
    """
    bits = np.ascontiguousarray(rows.detach().cpu().numpy(), np.float32).view(np.int32)
    rising = bits ^ ((bits >> 31) & 0x7FFFFFFF)
    keys = np.sort((rising.astype(np.int64) << 32) | np.arange(rows.shape[1]), axis=1)
    return torch.from_numpy(keys & 0xFFFFFFFF).to(rows.device)


def _draw(pixels: torch.Tensor, count: int, rng: np.random.Generator) -> torch.Tensor:
    if len(pixels) == count:
        return pixels
    return pixels[torch.from_numpy(rng.choice(len(pixels), count, replace=False))]


def blur(x: Float[torch.Tensor, "n c h w"], radius: float) -> Float[torch.Tensor, "n c h w"]:
    """Gaussian of standard deviation `radius` (pixels), zero beyond the border, at half resolution for large radii."""
    shrink = max(int(radius // 4), 1)
    size = x.shape[2:]
    if shrink > 1:
        x = functional.avg_pool2d(x, shrink, ceil_mode=True, count_include_pad=False)
    sigma = radius / shrink
    at = torch.arange(-int(3 * sigma + 0.5), int(3 * sigma + 0.5) + 1, dtype=x.dtype)
    row = torch.exp(-(at**2) / (2 * sigma**2))
    row = row / row.sum()
    half, channels = len(row) // 2, x.shape[1]
    across, down = (row.view(shape).expand(channels, -1, -1, -1) for shape in ((1, 1, 1, -1), (1, 1, -1, 1)))
    x = functional.conv2d(x, across, padding=(0, half), groups=channels)
    x = functional.conv2d(x, down, padding=(half, 0), groups=channels)
    return functional.interpolate(x, size=size, mode="bilinear", align_corners=False) if shrink > 1 else x


def srgb_from_linear(linear: torch.Tensor) -> torch.Tensor:
    """The sRGB transfer function on tensors; linear below 0, extended above 1 (so that gradients exist)."""
    curve = 1.055 * linear.clamp_min(0.0031308).pow(1 / 2.4) - 0.055
    return torch.where(linear <= 0.0031308, 12.92 * linear, curve)


def linear_from_srgb(encoded: torch.Tensor) -> torch.Tensor:
    """The inverse of `srgb_from_linear`."""
    curve = ((encoded.clamp_min(0.04045) + 0.055) / 1.055).pow(2.4)
    return torch.where(encoded <= 0.04045, encoded / 12.92, curve)


def luminance(linear: Float[torch.Tensor, "n 3 h w"]) -> Float[torch.Tensor, "n 1 h w"]:
    """Relative luminance of linear Rec.709, as one channel."""
    weights = linear.new_tensor([0.2126, 0.7152, 0.0722]).view(1, 3, 1, 1)
    return (linear * weights).sum(dim=1, keepdim=True)
