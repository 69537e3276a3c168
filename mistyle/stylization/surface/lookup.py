"""Look-up of colour and relief at any point of a painted surface, at the painting's own resolution."""

from collections.abc import Iterator
from dataclasses import dataclass
from types import ModuleType
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from mistyle.render.mitsuba.device import dr
from mistyle.stylization.surface import kernels
from mistyle.stylization.surface.exemplar import exemplar as style
from mistyle.stylization.surface.exemplar import relief as reliefs
from mistyle.stylization.surface.field import NearestNeighbourField
from mistyle.stylization.surface.samples import Level, as_points, lifted, workers

CHUNK = 1 << 19
BLEND = 0.25  # of the Gaussian between the nearest samples of a piece, in spacings
AROUND = 8  # samples that vote on a point's piece of the painting
VOTE = 0.9  # of the vote's Gaussian, in spacings
NEAREST = 4  # samples whose pictures are blended
CRISP = {"cut": 8.0, "blend": 2.0}  # power of a piece's share of the votes, by kind of border


@dataclass(frozen=True)
class PaintedSurface:
    """The place of each surface sample in the painting.

    positions, normals  of the samples, working space
    tangent             unit, the picture's x at quarter turn 0; y is tangent x normal
    turn                quarter turns (counter-clockwise) of the painting at this sample
    centre              (x, y) in pixels of the unturned painting, pixel centres at +0.5
    spacing             mean distance h of samples
    scale               pixels of the painting per spacing, along its x and y
    painting            encoded sRGB, 0..1
    glaze               offset of the painting's lightness at this sample (Lab / 100), smooth over the surface
    piece               label of the sample's piece: samples that continue one another's picture have equal labels
    crisp               power of a piece's share of the votes around a point, at borders of pieces
    whole_pixels        the painting's pixels are squares of one colour (no bilinear look-up)
    """

    positions: Float[np.ndarray, "n 3"]
    normals: Float[np.ndarray, "n 3"]
    tangent: Float[np.ndarray, "n 3"]
    turn: Int[np.ndarray, " n"]
    centre: Float[np.ndarray, "n 2"]
    spacing: float
    scale: tuple[float, float]
    painting: Float[np.ndarray, "h w 3"]
    glaze: Float[np.ndarray, " n"]
    piece: Int[np.ndarray, " n"]
    crisp: float
    whole_pixels: bool


@dataclass(frozen=True)
class Canvas:
    """A painted surface on the device, and the painting with its size."""

    position: Any
    tangent: Any
    across: Any
    turn: Any
    centre: Any
    scale: Any
    painting: Any
    height: Any
    width: Any


@dataclass(frozen=True)
class Neighbours:
    """The nearest samples of n surface points and their weights, for look-ups of several pictures."""

    index: Int[np.ndarray, "n k"]
    weight: Float[np.ndarray, "n k"]


def painted_surface(
    level: Level, field: NearestNeighbourField, size: tuple[int, int], painting: Float[np.ndarray, "h w 3"]
) -> PaintedSurface:
    """A surface painted by the field of an exemplar of `size` (height, width): one piece, no glaze."""
    height, width = size
    # Page k is np.rot90(picture, k): undo it for pixel corners, where page 1 has (x, y) at picture (width - y, x).
    page, x, y = field.page, field.x + 0.5, field.y + 0.5
    across = np.choose(page, [x, width - y, width - x, y])
    down = np.choose(page, [y, x, height - y, height - x])
    scale = (painting.shape[1] / width, painting.shape[0] / height)
    return PaintedSurface(
        positions=level.points.positions,
        normals=level.points.normals,
        tangent=level.tangent,
        turn=page.astype(np.int32),
        centre=np.stack([across * scale[0], down * scale[1]], axis=1).astype(np.float32),
        spacing=level.points.spacing,
        scale=scale,
        painting=painting,
        glaze=np.zeros(len(page), np.float32),
        piece=np.zeros(len(page), np.int32),
        crisp=CRISP["cut"],
        whole_pixels=False,
    )


def colour(
    surface: PaintedSurface,
    positions: Float[np.ndarray, "n 3"],
    normals: Float[np.ndarray, "n 3"],
    *,
    footprint: float = 0.0,
    near: Neighbours | None = None,
) -> Float[np.ndarray, "n 3"]:
    """Encoded sRGB (0..1) at surface points with unit normals; `near` is `neighbours` of them, if known.

    The three samples nearest in [p, 3 h n] each continue their piece of the painting to the point; their colours are
    blended by exp(-(d^2 - d0^2) / (2 (0.25 h)^2)). `footprint` is the distance between neighbouring queries (a texel, a
    pixel) in working units; the painting is blurred to it, 0: no blur. A point off the surface gets the colour of the
    nearest sample's tangent plane.
    """
    glazed = bool(surface.glaze.any())
    out = np.empty((len(positions), 3), np.float32)
    near = near or neighbours(surface, positions, normals)
    for part, shown in looked_up(surface, positions, near, surface.painting, footprint):
        values = np.clip(shown[:, :3], 0, 1)
        if glazed:
            glaze = surface.glaze[near.index[part]] * near.weight[part]
            values = style.lightened(values, glaze.sum(axis=1, dtype=np.float32))
        out[part] = values
    return out


def relief(
    surface: PaintedSurface,
    positions: Float[np.ndarray, "n 3"],
    normals: Float[np.ndarray, "n 3"],
    *,
    footprint: float = 0.0,
    near: Neighbours | None = None,
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, " n"]]:
    """The gradient of the painted height along the surface (world vectors, root mean square about 1), and the
    painting's offset of the roughness. A height h tilts the unit normal n to the direction of n - grad h. `near` as in
    `colour`."""
    own = reliefs.relief(surface.painting)
    picture = np.concatenate([own.slope, own.dull[..., None]], axis=2)
    gradient, dull = np.empty((len(positions), 3), np.float32), np.empty(len(positions), np.float32)
    near = near or neighbours(surface, positions, normals)
    for part, values in looked_up(surface, positions, near, picture, footprint, slopes=True):
        gradient[part], dull[part] = values[:, :3], values[:, 3]
    return gradient, dull


def neighbours(
    surface: PaintedSurface, positions: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"]
) -> Neighbours:
    """The samples near surface points with unit normals, as `blended` selects and weights them."""
    tree = as_points(surface.positions, surface.normals, surface.spacing).tree
    count = min(AROUND, len(surface.positions))
    keep = min(NEAREST, count)
    index, weight = np.empty((len(positions), keep), np.int64), np.empty((len(positions), keep))
    for low in range(0, len(positions), CHUNK):
        part = slice(low, low + CHUNK)
        asked = lifted(positions[part], normals[part], surface.spacing)
        distance, found = tree.query(asked, k=np.arange(1, count + 1), workers=workers())
        index[part], weight[part] = blended(distance / surface.spacing, found, surface.piece, surface.crisp)
    return Neighbours(index, weight)


def height(
    surface: PaintedSurface,
    positions: Float[np.ndarray, "n 3"],
    normals: Float[np.ndarray, "n 3"],
    *,
    footprint: float = 0.0,
) -> Float[np.ndarray, " n"]:
    """The painted height in working units whose gradient along the surface is that of `relief`, where one piece of the
    painting continues. Pieces meet with a step, as their pictures do."""
    pixel = surface.spacing / float(np.mean(surface.scale))
    picture = np.repeat(reliefs.relief(surface.painting).height[..., None], 3, axis=2)
    result = np.empty(len(positions), np.float32)
    near = neighbours(surface, positions, normals)
    for part, values in looked_up(surface, positions, near, picture, footprint):
        result[part] = values[:, 0] * pixel
    return result


def looked_up(
    surface: PaintedSurface,
    positions: Float[np.ndarray, "n 3"],
    near: Neighbours,
    picture: Float[np.ndarray, "h w 3"],
    footprint: float,
    *,
    slopes: bool = False,
) -> Iterator[tuple[slice, Float[np.ndarray, "m 4"]]]:
    """Samples of a picture of the painting's size at surface points, in chunks: points and values. With `slopes`, the
    first two channels are a vector along the picture's x and y."""
    dj = kernels.module()
    pixel = surface.spacing / max(surface.scale)  # one pixel of the painting on the surface
    if footprint > pixel:
        picture = style.blurred(picture, 0.4 * footprint / pixel)
    if not surface.whole_pixels:
        picture = style.for_bilinear(picture)
    canvas = on_canvas(dj, surface, picture)
    whole_pixels = surface.whole_pixels and footprint <= pixel
    for low in range(0, len(positions), CHUNK):
        part = slice(low, min(low + CHUNK, len(positions)))
        index, weight = near.index[part], near.weight[part]
        yield part, paint(dj, canvas, positions[part], index, weight, slopes, whole_pixels)


def blended(
    distance: Float[np.ndarray, "n k"], index: Int[np.ndarray, "n k"], piece: Int[np.ndarray, " m"], crisp: float
) -> tuple[Int[np.ndarray, "n j"], Float[np.ndarray, "n j"]]:
    """Selected nearest samples (distances in spacings, ascending) of a point, and their weights.

    The samples around a point vote on its piece of the painting. So a border between pieces is a smooth line, not the
    zigzag of single samples; within a piece the nearest sample dominates.
    """
    keep = min(NEAREST, distance.shape[1])
    near = distance**2 - distance[:, :1] ** 2
    weight = np.exp(-near / (2 * BLEND**2))
    label = piece[index]
    mixed = np.flatnonzero((label != label[:, :1]).any(axis=1))
    if len(mixed):
        label, near = label[mixed], near[mixed]
        votes = np.exp(-near / (2 * VOTE**2))
        same = label[:, :, None] == label[:, None, :]
        share = np.einsum("nij,nj->ni", same, votes) / votes.sum(axis=1, keepdims=True)
        first = np.where(same, near[:, None, :], np.inf).min(axis=2)
        within = np.exp(-(near - first) / (2 * BLEND**2))
        weight[mixed] = within / np.einsum("nij,nj->ni", same, within) * share**crisp
        order = np.argsort(-weight[mixed], axis=1, kind="stable")
        index = index.copy()
        index[mixed] = np.take_along_axis(index[mixed], order, axis=1)
        weight[mixed] = np.take_along_axis(weight[mixed], order, axis=1)
    index, weight = index[:, :keep], weight[:, :keep]
    return index, weight / weight.sum(axis=1, keepdims=True)


def on_canvas(dj: ModuleType, surface: PaintedSurface, picture: Float[np.ndarray, "h w 3"]) -> Canvas:
    """A painted surface on the device; `picture` has its painting's size. Scales are pixels per working unit."""
    scale = np.array(surface.scale) / surface.spacing
    return Canvas(
        position=kernels.floats(dj, surface.positions),
        tangent=kernels.floats(dj, surface.tangent),
        across=kernels.floats(dj, np.cross(surface.tangent, surface.normals)),
        turn=kernels.whole(dj, surface.turn),
        centre=kernels.floats(dj, surface.centre),
        scale=dj.Array2f(dr.opaque(dj.Float, float(scale[0])), dr.opaque(dj.Float, float(scale[1]))),
        painting=kernels.floats(dj, picture),
        height=dr.opaque(dj.Float, float(picture.shape[0])),
        width=dr.opaque(dj.Float, float(picture.shape[1])),
    )


def paint(
    dj: ModuleType,
    canvas: Canvas,
    positions: Float[np.ndarray, "n 3"],
    index: Int[np.ndarray, "n k"],
    weight: Float[np.ndarray, "n k"],
    slopes: bool = False,
    whole_pixels: bool = False,
) -> Float[np.ndarray, "n 4"]:
    """Blend the pictures of the samples `index` at `positions`: bilinear in the painting, or nearest pixels.

    Coordinates are clamped to it. Returns three channels and 0; with `slopes` the first two as a world vector, and the
    third.
    """
    count, reach = index.shape
    samples, weights = kernels.whole(dj, index), kernels.floats(dj, weight)
    i = dr.arange(dj.UInt, count)
    point = dr.gather(dj.Array3f, kernels.floats(dj, positions), i)

    def body(k: Any, total: Any) -> tuple[Any, ...]:
        j = dr.gather(dj.UInt, samples, i * reach + k)
        step = point - dr.gather(dj.Array3f, canvas.position, j)
        u = dr.dot(step, dr.gather(dj.Array3f, canvas.tangent, j))
        v = dr.dot(step, dr.gather(dj.Array3f, canvas.across, j))
        turn = dr.gather(dj.UInt, canvas.turn, j)
        # A step (u, v) on the page turned k times is this step in the picture itself.
        right = dr.select(turn == 0, u, dr.select(turn == 1, -v, dr.select(turn == 2, -u, v)))
        down = dr.select(turn == 0, v, dr.select(turn == 1, u, dr.select(turn == 2, -v, -u)))
        centre = dr.gather(dj.Array2f, canvas.centre, j)
        x = dr.clip(centre[0] + right * canvas.scale[0] - 0.5, 0, canvas.width - 1)
        y = dr.clip(centre[1] + down * canvas.scale[1] - 0.5, 0, canvas.height - 1)
        if whole_pixels:
            x, y = dr.round(x), dr.round(y)
        left, top = dr.floor(x), dr.floor(y)
        row = dj.UInt(canvas.width)
        next_x = dj.UInt(dr.minimum(left + 1, canvas.width - 1))
        next_row = dj.UInt(dr.minimum(top + 1, canvas.height - 1)) * row
        first, first_row = dj.UInt(left), dj.UInt(top) * row

        def texel(offset: Any) -> Any:
            return dr.gather(dj.Array3f, canvas.painting, offset)

        upper = dr.lerp(texel(first_row + first), texel(first_row + next_x), x - left)
        lower = dr.lerp(texel(next_row + first), texel(next_row + next_x), x - left)
        shown = dr.lerp(upper, lower, y - top)
        value = dj.Array4f(shown[0], shown[1], shown[2], 0)
        if slopes:
            # The inverse of the turns above.
            sx, sy = shown[0], shown[1]
            gu = dr.select(turn == 0, sx, dr.select(turn == 1, sy, dr.select(turn == 2, -sx, -sy)))
            gv = dr.select(turn == 0, sy, dr.select(turn == 1, -sx, dr.select(turn == 2, -sy, sx)))
            world = dr.gather(dj.Array3f, canvas.tangent, j) * gu + dr.gather(dj.Array3f, canvas.across, j) * gv
            value = dj.Array4f(world[0], world[1], world[2], shown[2])
        return k + 1, total + value * dr.gather(dj.Float, weights, i * reach + k)

    _, total = dr.while_loop((dj.UInt(0), dj.Array4f(0)), lambda k, *rest: k < reach, body)
    return np.array(dr.ravel(total)).reshape(count, 4)
