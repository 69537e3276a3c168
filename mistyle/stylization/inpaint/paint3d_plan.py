"""Inputs of the texture inpainter's model: position maps, atlas crops, resampling within UV islands."""

import numpy as np
from jaxtyping import Bool, Float, Shaped

from mistyle.atlas.gaps import island_boxes
from mistyle.core.image import bilinear, nearest, resize
from mistyle.core.maps import Texels
from mistyle.core.mesh import Mesh


def position_map(
    texels: Texels, centre: Float[np.ndarray, "3"], radius: float, scale: float = 0.6, height: float = 0.25
) -> Float[np.ndarray, "h w 3"]:
    """Paint3D's UV position map: each texel's position as a colour 0..1, black where no face covers it.

    The mesh is centred on the mean of its vertices and scaled: its farthest vertex has the radius `scale` (0.6). It is
    then raised by `height` (0.25) along y. x, y, z of [-1, 1] become red, green, blue of [0, 1], truncated (not
    rounded) to 8 bits. Row 0 is v = 1, axes are the mesh's own (y up). Scale and height come from a demo of Paint3D;
    its training code was never published.
    """
    placed = (texels.position - centre) / max(radius, 1e-12) * scale
    placed = placed + np.array([0.0, height, 0.0])
    colour = np.floor((np.clip(placed, -1, 1) / 2 + 0.5) * 255) / 255
    return np.where(texels.covered[..., None], colour, 0).astype(np.float32)


def centre_and_radius(mesh: Mesh) -> tuple[Float[np.ndarray, "3"], float]:
    """The mean of the mesh's vertices and the distance of the farthest from it."""
    centre = mesh.positions.mean(axis=0, dtype=np.float64)
    return centre.astype(np.float32), float(np.linalg.norm(mesh.positions - centre, axis=1).max())


def crops(hole: Bool[np.ndarray, "h w"], size: int, overlap: int) -> list[tuple[int, int]]:
    """Top left corners of square crops of side `size` that together cover every hole texel.

    Where the atlas has room, a hole texel lies at least half of `overlap` inside some crop. So crops share `overlap`
    texels, and each hole has context. Holes are visited from the top, left to right.
    """
    rows, columns = hole.shape
    if rows <= size and columns <= size:
        return [(0, 0)] if hole.any() else []
    margin = min(overlap, size - 1) // 2
    inner = size - 2 * margin
    left, corners = hole.copy(), []
    while left.any():
        top = int(np.argmax(left.any(axis=1)))
        band = left[top : top + inner].any(axis=0)
        first = int(np.argmax(band))
        r = int(np.clip(top - margin, 0, max(rows - size, 0)))
        c = int(np.clip(first - margin, 0, max(columns - size, 0)))
        corners.append((r, c))
        left[top : top + inner, first : first + inner] = False
    return corners


def feather(size: int, overlap: int) -> Float[np.ndarray, "s s"]:
    """Weight of a crop where crops overlap: 1 inside, falling to nearly 0 at its border."""
    distance = np.minimum(np.arange(size) + 0.5, size - np.arange(size) - 0.5)
    ramp = np.clip(distance / max(overlap / 2, 1), 1e-3, 1)
    return np.minimum.outer(ramp, ramp).astype(np.float32)


def sampled(values: Shaped[np.ndarray, "h w *c"], size: tuple[int, int]) -> Shaped[np.ndarray, "h2 w2 *c"]:
    """Nearest samples at the pixel centres of a smaller (or larger) atlas: labels and positions must not be blended."""
    rows, columns = (((np.arange(n) + 0.5) * have / n).astype(int) for n, have in zip(size, values.shape, strict=False))
    return values[rows[:, None], columns[None, :]]


def spread_islands(
    small: Float[np.ndarray, "h w 3"],
    texels: Texels,
    hole: Bool[np.ndarray, "H W"],
    fallback: Float[np.ndarray, "H W 3"],
) -> Float[np.ndarray, "H W 3"]:
    """`fallback` with the hole's texels taken from a smaller atlas, each island from its own pixels only.

    Pixels whose centre belongs to another island, or to none, are first replaced by the island's nearest own one. An
    island too small to own a pixel keeps `fallback`.
    """
    result = fallback.copy()
    labels = sampled(texels.island, (small.shape[0], small.shape[1]))
    fr, fc = (n / have for n, have in zip(small.shape[:2], hole.shape, strict=True))
    for island, box in island_boxes(texels.island, np.unique(texels.island[hole & texels.covered])):
        target = hole[box] & (texels.island[box] == island)
        rows, columns = box
        # The same box in the smaller atlas, with a border for the interpolation.
        top, bottom = max(int(rows.start * fr) - 2, 0), min(int(np.ceil(rows.stop * fr)) + 2, small.shape[0])
        left, right = max(int(columns.start * fc) - 2, 0), min(int(np.ceil(columns.stop * fc)) + 2, small.shape[1])
        own = labels[top:bottom, left:right] == island
        if not own.any():
            continue
        index = nearest(own)[0]
        pure = small[top:bottom, left:right].reshape(-1, 3)[index]
        r, c = np.nonzero(target)
        y = (r + rows.start + 0.5) * fr - 0.5 - top
        x = (c + columns.start + 0.5) * fc - 0.5 - left
        result[box][target] = bilinear(pure, np.stack([x, y], axis=1) + 0.5)
    return result


def filled(
    encoded: Float[np.ndarray, "h w 3"], hole: Bool[np.ndarray, "h w"], texels: Texels
) -> Float[np.ndarray, "h w 3"]:
    """The atlas with holes and background filled from known texels, so that the encoder sees no black there."""
    known = texels.covered & ~hole
    if not known.any():
        return np.full_like(encoded, 0.5)
    index = nearest(known)[0]
    return encoded.reshape(-1, 3)[index]


def shrink(encoded: Float[np.ndarray, "h w 3"], size: tuple[int, int]) -> Float[np.ndarray, "h2 w2 3"]:
    """An atlas at the model's size."""
    return np.clip(resize(encoded, size), 0, 1)
