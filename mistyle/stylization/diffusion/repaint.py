"""RePaint as a sampler over any denoiser (paper 4.1.3, equations 1 to 3), independent of the network.

Variance-exploding coordinates: a latent at level sigma is the clean one plus sigma times standard normal noise. It is
not scaled for a network's input: a denoiser that needs x / sqrt(sigma^2 + 1) divides itself.

The paper re-noises a block "before the final resample". With one re-noising in ten repeats, the other eight start from
latents with less noise than sigma. The variance of the result then falls below half of the true one. Here, as in
RePaint itself, every repeat but the first is re-noised. tests/stylization/diffusion/test_repaint.py compares both with
a closed form.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

Array = Any  # a NumPy array, or a torch tensor; then `rng` is a torch.Generator
Denoiser = Callable[[Array, float], Array]  # (latent, sigma) -> estimate of the clean latent


@dataclass(frozen=True)
class Resampling:
    """Resampling: blocks of `L` steps, each `r` times, and the share of steps repeated at the end without the prior."""

    L: int = 10
    r: int = 10
    refine: float = 0.1


def sample(
    denoise: Denoiser,
    prior: Array | None,
    mask: Array | None,
    sigmas: Sequence[float],
    resampling: Resampling = Resampling(),
    *,
    rng: Any,
    like: Array | None = None,
) -> Array:
    """A latent that equals `prior` under `mask` (1: known) and is sampled consistently with it elsewhere.

    `sigmas` falls from the noisiest level to 0, one step between neighbours. Steps run in blocks of `L`, each block `r`
    times. After every step the known part is set to the prior at the next level (eq. 1 and 2); before every repeat the
    block's noise is added again (eq. 3). With `prior` None (the first view) nothing is pinned, L and r count as 1, and
    `like` gives the latent's shape and type.

    The result then passes the last int(refine * steps) steps again without the prior, which smooths the border. With
    refine = 0 the known part is the prior exactly. Calls `denoise` steps * r + int(refine * steps) times. The same
    generator state gives the same result.
    """
    L, r, refine = resampling.L, resampling.r, resampling.refine
    levels = [float(s) for s in sigmas]
    if len(levels) < 2 or levels[-1] != 0 or any(a <= b for a, b in zip(levels, levels[1:], strict=False)):
        raise ValueError("sigmas must fall from step to step and end with 0; pass the sampler's noise levels")
    if L < 1 or r < 1 or not 0 <= refine <= 1:
        raise ValueError(f"L = {L} and r = {r} must be at least 1, refine = {refine} within 0..1")
    template = like if prior is None else prior
    if template is None or (prior is not None and mask is None):
        raise ValueError("a first view needs `like` for the shape of the latent, a later view a prior and its mask")
    block, repeats = (L, r) if prior is not None else (1, 1)
    x = levels[0] * normal(rng, template)
    for first in range(0, len(levels) - 1, block):
        last = min(first + block, len(levels) - 1)
        for repeat in range(repeats):
            if repeat > 0:
                x = x + float(np.sqrt(levels[first] ** 2 - levels[last] ** 2)) * normal(rng, x)
            for k in range(first, last):
                x = step(denoise, x, levels[k], levels[k + 1])
                if prior is not None and mask is not None:
                    x = mask * (prior + levels[k + 1] * normal(rng, x)) + (1 - mask) * x
    return refined(denoise, x, levels, refine, rng)


def refined(denoise: Denoiser, x: Array, levels: Sequence[float], strength: float, rng: Any) -> Array:
    """Repeat the last int(strength * steps) steps from the finished latent with their noise added."""
    steps = len(levels) - 1
    first = steps - int(strength * steps + 1e-9)
    if first == steps:
        return x
    x = x + levels[first] * normal(rng, x)
    for k in range(first, steps):
        x = step(denoise, x, levels[k], levels[k + 1])
    return x


def step(denoise: Denoiser, x: Array, sigma: float, following: float) -> Array:
    """Euler's step of the probability flow dx = (x - D(x, sigma)) / sigma dsigma."""
    return x + (x - denoise(x, sigma)) * ((following - sigma) / sigma)


def normal(rng: Any, like: Array) -> Array:
    """Standard normal noise of the shape, dtype and device of `like`."""
    if isinstance(like, np.ndarray):
        return rng.standard_normal(like.shape).astype(like.dtype, copy=False)
    import torch

    return torch.randn(like.shape, generator=rng, device=rng.device, dtype=like.dtype).to(like.device)
