"""Texture-space records. Row 0 of every map is v = 1: texel (row r, column c) of an (H, W) map has its centre at
u = (c + 0.5) / W, v = 1 - (r + 0.5) / H."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate, pairwise

import numpy as np
from jaxtyping import Bool, Float, Int


@dataclass(frozen=True)
class Texels:
    """One rasterised texture set: the surface point of each texel (paper 4.1.4).

    position and normal are in the working space (zero where not covered); `island` numbers the UV islands from 0,
    `face` the mesh's faces; both are -1 where no face covers the texel's centre.
    """

    position: Float[np.ndarray, "h w 3"]
    normal: Float[np.ndarray, "h w 3"]
    covered: Bool[np.ndarray, "h w"]
    island: Int[np.ndarray, "h w"]
    face: Int[np.ndarray, "h w"]


@dataclass(frozen=True)
class Maps:
    """The material of one texture set.

    albedo     linear Rec.709, 0..1
    normal     unit tangent-space normal, -1..1, +Y (OpenGL) convention; flat is (0, 0, 1)
    roughness  perceptual roughness, 0..1 (GGX alpha = roughness squared)
    metallic   0..1
    known      whether a view that sees the texel painted its albedo
    """

    albedo: Float[np.ndarray, "h w 3"]
    normal: Float[np.ndarray, "h w 3"]
    roughness: Float[np.ndarray, "h w"]
    metallic: Float[np.ndarray, "h w"]
    known: Bool[np.ndarray, "h w"]


@dataclass(frozen=True)
class OwnMaps(Maps):
    """Maps as a file has them, each of its own size, for renderers that take each as a separate texture."""

    albedo: Float[np.ndarray, "h w 3"]
    normal: Float[np.ndarray, "hn wn 3"]
    roughness: Float[np.ndarray, "hr wr"]
    metallic: Float[np.ndarray, "hm wm"]
    known: Bool[np.ndarray, "hk wk"]


@dataclass(frozen=True)
class Heights:
    """Displacement along the normal, one map per texture set, in the units of the mesh's file.

    `scale` is the range of 16-bit files: a value v (0..1) is the displacement (v - 0.5) scale.
    """

    maps: tuple[Float[np.ndarray, "_ _"], ...]
    scale: float


FINER = 4  # texels along a side of the atlas per pixel along a side of the picture, beyond which nothing is gained


def coarser(size: int, pixels: int) -> int:
    """The power of two by which maps of `size` texels a side can shrink for pictures of `pixels` a side. The result
    keeps at least FINER times as many texels a side."""
    by = 1
    while size // (2 * by) >= FINER * pixels and size % (2 * by) == 0:
        by *= 2
    return by


def flat_maps(size: int, albedo: float = 0.5, roughness: float = 0.5, metallic: float = 0.0) -> Maps:
    """Constant maps: grey, flat, half rough, not metallic, nothing known."""
    normal = np.zeros((size, size, 3), np.float32)
    normal[..., 2] = 1
    return Maps(
        albedo=np.full((size, size, 3), albedo, np.float32),
        normal=normal,
        roughness=np.full((size, size), roughness, np.float32),
        metallic=np.full((size, size), metallic, np.float32),
        known=np.zeros((size, size), bool),
    )


def rows_of(sizes: Sequence[tuple[int, int]]) -> list[slice]:
    """Rows of each texture set in one table of texels, which lists set after set, row by row."""
    ends = accumulate((height * width for height, width in sizes), initial=0)
    return [slice(begin, end) for begin, end in pairwise(ends)]


def place_of(row: int, sizes: Sequence[tuple[int, int]]) -> tuple[int, int, int]:
    """Texture set of a row of that table, and the texel's row and column in the set."""
    for part, (rows, (_, width)) in enumerate(zip(rows_of(sizes), sizes, strict=True)):
        if row < rows.stop:
            y, x = divmod(row - rows.start, width)
            return part, y, x
    raise IndexError(f"Row {row} is past the texels of sets of {list(sizes)}.")
