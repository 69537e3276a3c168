"""Linear algebra of the joint Gauss–Newton steps (`joint/gauss_newton.py`): normal equations of pictures linearised in
texels, and conjugate gradients (Nocedal and Wright, Numerical Optimization, 2006, section 5.1)."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

STEPS, CLOSE = 60, 1e-4  # most iterations of conjugate gradients, and the relative r' M r at which they stop

Unknowns = Float[np.ndarray, "t 6"]
Blocks = Float[np.ndarray, "t 6 6"]


@dataclass(frozen=True)
class LinearisedImage:
    """A picture linearised at the maps: bilinear weights (B, sparse, pixels x texels), derivatives of its channels by
    their own albedo, tilt (2) and roughness (D), channel weights (W), and reference - picture."""

    fetch: Any
    derivative: Float[np.ndarray, "p 3 4"]
    weight: Float[np.ndarray, "p 3"]
    residual: Float[np.ndarray, "p 3"]


def _full(derivative: Float[np.ndarray, "p 3 4"]) -> Float[np.ndarray, "p 3 6"]:
    """Derivatives by all six unknowns; each channel depends on its own albedo only."""
    full = np.zeros((len(derivative), 3, 6), np.float32)
    full[:, range(3), range(3)], full[:, :, 3:] = derivative[:, :, 0], derivative[:, :, 1:]
    return full


def diagonal_blocks(images: Sequence[LinearisedImage], count: int) -> Blocks:
    """Block diagonal of the normal matrix, one block a texel: sum of b² D' W D."""
    above = np.triu_indices(6)
    total = np.zeros((count, len(above[0])), np.float32)
    for each in images:
        full, square = _full(each.derivative), each.fetch.copy()
        square.data = square.data**2
        own = np.stack(
            [(full[:, :, i] * full[:, :, j] * each.weight).sum(axis=1) for i, j in zip(*above, strict=True)], axis=1
        )
        total += square.T @ own
    blocks = np.zeros((count, 6, 6), np.float32)
    blocks[:, above[0], above[1]] = blocks[:, above[1], above[0]] = total
    return blocks


def normal_matvec(images: Sequence[LinearisedImage], v: Unknowns) -> Unknowns:
    """B' D' W D B v."""
    total = np.zeros_like(v)
    for each in images:
        pixels, d = each.fetch @ v, each.derivative
        change = d[:, :, 0] * pixels[:, :3] + np.einsum("pcj,pj->pc", d[:, :, 1:], pixels[:, 3:])
        total += apply_transpose(each, change)
    return total


def rhs(images: Sequence[LinearisedImage], count: int) -> Unknowns:
    """B' D' W (reference - picture)."""
    return sum((apply_transpose(each, each.residual) for each in images), np.zeros((count, 6), np.float32))


def apply_transpose(each: LinearisedImage, channels: Float[np.ndarray, "p 3"]) -> Unknowns:
    """B' D' W applied to values of a picture's channels."""
    weighted, d = each.weight * channels, each.derivative
    pixels = np.concatenate([d[:, :, 0] * weighted, np.einsum("pcj,pc->pj", d[:, :, 1:], weighted)], axis=1)
    return each.fetch.T @ pixels


def pcg(applied: Callable[[Unknowns], Unknowns], right: Unknowns, inverse: Blocks) -> Unknowns:
    """Conjugate gradients from zero; `inverse` is the block-diagonal preconditioner."""

    def dot(a: np.ndarray, b: np.ndarray) -> float:
        return float((a * b).sum(dtype=np.float64))

    x, left = np.zeros_like(right), right
    towards = np.einsum("tij,tj->ti", inverse, left)
    first = size = dot(left, towards)
    for _ in range(STEPS):
        if not size > CLOSE * first:
            break
        product = applied(towards)
        length = np.float32(size / max(dot(towards, product), 1e-30))
        x, left = x + length * towards, left - length * product
        better = np.einsum("tij,tj->ti", inverse, left)
        size, last = dot(left, better), size
        towards = better + np.float32(size / last) * towards
    return x
