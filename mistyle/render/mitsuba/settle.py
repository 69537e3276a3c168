"""Denoised path tracing with few samples: detail from a noise-free guide, light and shadow from the path tracer.

The guide is the same picture without noise (`render/lookdev/studio.py`). On the asset, the result is the guide times
the ratio of both pictures' local means; on the background, it is the path-traced picture's own local mean. Real-time
path tracers use the same demodulation: effects that the guide lacks (cast shadows, contact) are smooth, and the guide
has the details that the filter would blur (texture, outlines).
"""

from collections.abc import Iterable

import numpy as np
from jaxtyping import Float

from mistyle.core.image import gaussian, resize, srgb_from_linear

SIGMA = 1 / 180  # standard deviation of the filter, in picture heights
# Factor of the filter's width on the bare backdrop, and the distance from the asset at which it narrows.
WIDE, FADE = 6, 3
Rgb = Float[np.ndarray, "h w 3"]


def settled(
    passes: Iterable[Float[np.ndarray, "h w 4"]], guide: Float[np.ndarray, "h w 4"], error: float, most: int
) -> tuple[Rgb, Rgb, int]:
    """(picture, background, number of passes), linear, from independent `passes` of one picture.

    Two halves of the passes are filtered separately. Half the mean difference of their sRGB is the standard error of
    their mean. When it is at most `error` (0..1), or after `most` passes, the picture is built from both.
    """
    halves: list[Rgb] = [np.zeros(guide[..., :3].shape, np.float32) for _ in range(2)]
    count = 0
    for count, one in enumerate(passes, start=1):
        halves[count % 2] += one[..., :3]
        if count % 2 == 0:
            shown = [srgb_from_linear(filtered(half * np.float32(2 / count), guide)[0]) for half in halves]
            if count >= most or 0.5 * float(np.abs(shown[0] - shown[1]).mean()) <= error:
                break
    return *filtered((halves[0] + halves[1]) / np.float32(max(count, 1)), guide), count


def filtered(picture: Rgb, guide: Float[np.ndarray, "h w 4"]) -> tuple[Rgb, Rgb]:
    """The denoised picture, and the background, continued under the asset; `guide` is premultiplied."""
    sigma = SIGMA * picture.shape[0]
    share = guide[..., 3:]
    away = (share == 0).astype(np.float32)
    whole = (share > 0.999).astype(np.float32)
    behind = _background(picture, away, sigma)
    least = 1e-4 * gaussian(whole, sigma) + 1e-8
    ratio = (gaussian(picture * whole, sigma) + least) / (gaussian(guide[..., :3] * whole, sigma) + least)
    return np.maximum(guide[..., :3] * ratio + (1 - share) * behind, 0), behind


def _background(picture: Rgb, away: Float[np.ndarray, "h w 1"], sigma: float) -> Rgb:
    """The local mean of the background: with `sigma` close to the asset, with WIDE times that farther away."""
    height, width = picture.shape[:2]
    small = max(1, height // WIDE), max(1, width // WIDE)
    planes = np.concatenate([picture * away, away], axis=-1)
    close = gaussian(planes, sigma)
    far = resize(gaussian(resize(planes, small), sigma), (height, width))
    # Far inside the asset the background is neither known nor visible.
    close, wide = (p[..., :3] / np.maximum(p[..., 3:], 1e-6) for p in (close, far))
    share = np.clip(FADE * (1 - far[..., 3:]), 0, 1)
    return (share * close + (1 - share) * wide).astype(np.float32)
