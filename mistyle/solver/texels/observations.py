"""Observations of the per-texel solver: radiance of each texel, sampled from the pictures.

A texel's reference value is the picture at the projection of the texel's centre, interpolated bilinearly between those
of the four nearest pixels that are valid. A pixel is valid where its centre and its corners show the texel's own
surface and are all lit or all in shadow: pixels on the edge of a shadow or a silhouette are mixtures that no material
explains.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, UInt

from mistyle.atlas.frames import texel_frames
from mistyle.atlas.texels import beside, rasterise
from mistyle.core.camera import Camera, by_camera, of_corners
from mistyle.core.capture import Captures
from mistyle.core.image import erode
from mistyle.core.light import DELTA, has_soft
from mistyle.core.maps import Texels
from mistyle.render.mitsuba.draw import Tracer
from mistyle.solver.texels.gbuffer import GBuffer, open_sky, rig, trace_gbuffer
from mistyle.solver.texels.levenberg_marquardt import Observations, Points, Rig

REACH = 2.5  # largest distance of the four pixels from the texel, in pixel widths on the surface
LIFT = 0.5  # largest distance from its tangent plane, in the same unit
MOVED = 4.0  # a look-up that moved by d pixels has 1 + MOVED d² times the standard deviation
PERCENTILE = 95.0  # percentile of the observed radiance, the unit of the noise
COARSEST = 16  # texels a side of a set in `coarse_observations`, at least


@dataclass(frozen=True)
class ImageSamples:
    """One picture's observations: rows of the Observations, top left pixel, and position between the four, 0..1."""

    rows: Int[np.ndarray, " n"]
    pixel: Int[np.ndarray, " n"]
    x: Float[np.ndarray, " n"]
    y: Float[np.ndarray, " n"]


@dataclass(frozen=True)
class TexelObservations:
    """All observations of t covered texels (of all sets, one set after the other).

    texel     flat index of each into the concatenated sets
    per_image per picture
    views     number of different cameras that observed each texel
    """

    texel: Int[np.ndarray, " t"]
    points: Points
    rig: Rig
    observations: Observations
    per_image: tuple[ImageSamples, ...]
    views: Int[np.ndarray, " t"]

    @property
    def seen(self) -> Int[np.ndarray, " t"]:
        """Number of pictures that observed each texel in the light."""
        return np.diff(self.observations.start)


@dataclass(frozen=True)
class ObservationOptions:
    """Options of observing pictures.

    facing    least cosine between the texel's normal and the camera
    noise     with `relative`: the standard deviation of an observation of radiance y is noise · (PERCENTILE of
    radiance)
              + relative · y. It is larger at grazing angles, and where the texel is smaller than the pixel, which then
              constrains its neighbours more.
    skies     False omits the sky's visibility per texel, which only the solver needs
    move      most pixels that a look-up may move, 0 to require all four valid. A moved look-up shows a point beside the
              texel; only the rounds correct that.
    """

    facing: float = 0.2
    noise: float = 0.0005
    relative: float = 0.01
    skies: bool = True
    move: float = 1.5


DEFAULT_OPTIONS = ObservationOptions()


def collect_observations(
    traced: Tracer,
    texels: Sequence[Texels],
    captures: Captures,
    tangents: Float[np.ndarray, "f 3 4"] | None,
    options: ObservationOptions = DEFAULT_OPTIONS,
    progress: Callable[[float], None] = lambda done: None,
) -> TexelObservations:
    """All observations of all pictures. Raises ValueError for lights that only a scene file describes."""
    texel = covered_rows(texels)
    position, normal, face = points_of(texels)
    size = np.concatenate([texel_sizes(t) for t in texels])[texel]
    soft = [has_soft([own]) for own in captures.lights]
    sky = open_sky(traced, position, normal) if options.skies and any(soft) else None
    points = Points(position, texel_frames(traced.mesh, face, position, normal, tangents), sky)
    parts: list[tuple] = []
    views = np.zeros(len(texel), np.int32)
    for done, group in enumerate(by_camera(captures.cameras)):
        camera = captures.cameras[group[0]]
        beams = [light for k in group for light in captures.lights[k] if isinstance(light, DELTA)]
        seen, corners = trace_gbuffer(traced, camera, beams), trace_gbuffer(traced, of_corners(camera), beams)
        pure = unmixed_pixels(camera, seen, corners)
        visible = _visible(camera, seen, pure, (position, normal, size), options.facing)
        any_light, first = np.zeros(len(visible.texel), bool), 0
        for k in group:
            count = sum(isinstance(light, DELTA) for light in captures.lights[k])
            lit = [_uniform_light(seen.lit[j], corners.lit[j]) for j in range(first, first + count)]
            first += count
            rgb, usable = captures.load(k)
            ids, values, bits, chosen, *place, share = _observe(rgb, usable, lit, soft[k], visible, options.move)
            any_light[chosen] = True
            # These arrays are most of a fit's memory, so they have the smallest sufficient types.
            where = visible.pixel[chosen].astype(np.int32)
            parts.append((k, ids.astype(np.int32), values, bits, where, *place, visible.worth[chosen] * share))
        views[visible.texel[any_light]] += 1
        progress((done + 1) / max(len(captures) / max(len(group), 1), 1))
    return _assemble(texel, points, captures, parts, views, options)


def coarse_observations(
    traced: Tracer,
    captures: Captures,
    tangents: Float[np.ndarray, "f 3 4"] | None,
    options: ObservationOptions,
    side: int,
    most: int,
) -> tuple[list[Texels], TexelObservations]:
    """A coarse atlas and its observations: about `side` x `side` texels, all sets together, fewer where `most`
    observations allow less; each set has at least COARSEST texels a side."""
    mesh = traced.mesh

    def observed_at(size: int) -> tuple[list[Texels], TexelObservations]:
        texels = [rasterise(mesh, part, size) for part in range(len(mesh.parts))]
        return texels, collect_observations(traced, texels, captures, tangents, options)

    each = max(COARSEST, int(side / len(mesh.parts) ** 0.5))
    texels, observed = observed_at(each)
    count = len(observed.observations.rgb)
    return (texels, observed) if count <= most else observed_at(max(COARSEST, int(each * (most / count) ** 0.5)))


def covered_rows(texels: Sequence[Texels]) -> Int[np.ndarray, " n"]:
    """The covered texels of all sets, rows of the table."""
    return np.flatnonzero(np.concatenate([t.covered.ravel() for t in texels]))


def points_of(texels: Sequence[Texels]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Positions, normals and faces of the covered texels."""
    position, normal, face = (
        np.concatenate([getattr(t, name)[t.covered] for t in texels]) for name in ("position", "normal", "face")
    )
    return position, normal, face


def sample_image(image: Float[np.ndarray, "h w 3"], at: ImageSamples) -> Float[np.ndarray, "n 3"]:
    """An image of the observations' camera, sampled at the observations."""
    return _bilinear(image, at.pixel, at.x, at.y)


def with_extra_std(weight: Float[np.ndarray, " n"], more: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Weights (1 / standard deviation) after `more` is added to the standard deviation."""
    return weight / (1 + weight * more)


def observation_std(level: Float[np.ndarray, " n"], noise: float, relative: float) -> Float[np.ndarray, " n"]:
    """Standard deviations of observations with radiance `level`: noise · (PERCENTILE of `level`) + relative · level."""
    unit = float(np.percentile(level, PERCENTILE)) if len(level) else 1.0
    return noise * max(unit, 1e-6) + relative * level


def texel_sizes(texels: Texels) -> Float[np.ndarray, " n"]:
    """The shorter side of every texel on the surface, from its neighbours in the island; 0 without any."""
    right, below = beside(texels.island)
    shortest = np.full(texels.island.shape, np.inf, np.float32)
    columns = shortest.T, texels.position.transpose(1, 0, 2), right.T
    for side, p, same in ((shortest, texels.position, below), columns):
        length = np.where(same, np.sqrt(((p[1:] - p[:-1]) ** 2).sum(axis=-1)), np.inf)
        side[:-1] = np.minimum(side[:-1], length)
        side[1:] = np.minimum(side[1:], length)
    smallest = shortest.ravel()
    return np.where(np.isfinite(smallest), smallest, 0).astype(np.float32)


def unmixed_pixels(camera: Camera, seen: GBuffer, corners: GBuffer) -> Bool[np.ndarray, "h w"]:
    """Pixels whose corners show the same surface as their centre: no silhouette or crease crosses them."""
    p, n = seen.position, seen.normal
    away = camera.position.astype(np.float32) - p
    unit = away @ -camera.world_from_cam[:3, 2].astype(np.float32) / np.float32(camera.focal)
    cosine = np.clip((away * n).sum(axis=-1) / np.maximum(np.sqrt((away**2).sum(axis=-1)), 1e-12), 0.05, 1)
    pure, width = seen.mask.copy(), unit / cosine
    for corner in _corners(seen.mask.shape):
        pure &= corners.mask[corner]
        pure &= _one_surface(p, n, width, corners.position[corner], corners.normal[corner])
    return pure


def _one_surface(p: np.ndarray, n: np.ndarray, width: np.ndarray, q: np.ndarray, m: np.ndarray) -> np.ndarray:
    """Whether points q with normals m continue the surface at p with normals n; `width` is a pixel's on it."""
    d = q - p
    near = ((d * d).sum(axis=-1) <= (REACH * width) ** 2) & (np.abs((d * n).sum(axis=-1)) <= LIFT * width)
    return near & ((m * n).sum(axis=-1) > 0.5)


def _corners(size: tuple[int, int]) -> list[tuple[slice, slice]]:
    """Values at each pixel's top left, top right, bottom left and bottom right corner, from an image of all corners."""
    height, width = size
    return [np.s_[r : r + height, c : c + width] for r in (0, 1) for c in (0, 1)]


def _uniform_light(lit: Bool[np.ndarray, "h w"], corners: Bool[np.ndarray, "H W"]) -> Int[np.ndarray, "h w"]:
    """1 where a pixel's centre and corners are all lit, 0 where none is, -1 where a shadow's edge crosses it."""
    count = lit.astype(np.int8)
    for corner in _corners(lit.shape):
        count += corners[corner]
    return np.where(count == 5, 1, np.where(count == 0, 0, -1)).astype(np.int8)


class VisibleTexels(NamedTuple):
    """Texels whose own surface a picture shows: index, top left of the four nearest pixels, position between them,
    which of the four show it, and the observation's weight, 0..1."""

    texel: Int[np.ndarray, " n"]
    pixel: Int[np.ndarray, " n"]
    x: Float[np.ndarray, " n"]
    y: Float[np.ndarray, " n"]
    own: Bool[np.ndarray, "4 n"]
    worth: Float[np.ndarray, " n"]


def _visible(camera: Camera, seen: GBuffer, pure, points: tuple[np.ndarray, ...], facing: float) -> VisibleTexels:
    """Texels whose own surface at least one of their four nearest pixels shows; `points`: positions, normals, sizes."""
    position, normal, size = points
    height, width = camera.size
    eye = camera.position.astype(np.float32)
    away = eye - position
    distance = np.sqrt((away**2).sum(axis=1))
    cosine = (away * normal).sum(axis=1) / np.maximum(distance, 1e-12)
    local = (position - eye) @ camera.world_from_cam[:3, :3].astype(np.float32)
    depth = np.maximum(local[:, 2], 1e-6)
    x = local[:, 0] / depth * np.float32(camera.focal) + np.float32(camera.centre[0] - 0.5)
    y = local[:, 1] / depth * np.float32(camera.focal) + np.float32(camera.centre[1] - 0.5)
    inside = (cosine > facing) & (local[:, 2] > 0) & (x >= 0) & (y >= 0) & (x < width - 1) & (y < height - 1)
    near = np.flatnonzero(inside)
    left, top = np.floor(x[near]), np.floor(y[near])
    pixel = (top * width + left).astype(np.int64)
    p, n = position[near], normal[near]
    unit = depth[near] / np.float32(camera.focal)
    own = np.zeros((4, len(near)), bool)
    hit, front = seen.position.reshape(-1, 3), seen.normal.reshape(-1, 3)
    for k, step in enumerate((0, 1, width, width + 1)):
        surface = hit.take(pixel + step, axis=0), front.take(pixel + step, axis=0)
        own[k] = pure.ravel().take(pixel + step) & _one_surface(p, n, unit / cosine[near], *surface)
    good = own.any(axis=0)
    chosen = near[good]
    worth = np.sqrt(cosine[chosen]) * np.minimum(size[chosen] / unit[good], 1)
    return VisibleTexels(chosen, pixel[good], (x[near] - left)[good], (y[near] - top)[good], own[:, good], worth)


def _observe(rgb, usable, lit, soft: bool, visible: VisibleTexels, move: float) -> tuple[np.ndarray, ...]:
    """Texels that one picture observes in the light: index, radiance, light bits, rows of `visible`, position of the
    look-up, and its factor of the weight. Soft light, if the picture has any, is taken to reach all of them.

    Where not all four pixels are valid, the look-up moves to the nearest valid ones, with a smaller weight.
    """
    near, pixel, x, y, own, _ = visible
    usable = erode(usable & np.isfinite(rgb).all(axis=-1), 1)
    rgb, width = np.where(usable[..., None], rgb, 0), rgb.shape[1]
    corners = [pixel + step for step in (0, 1, width, width + 1)]
    good, code = own.copy(), np.zeros(own.shape, np.uint32)
    for j, corner in enumerate(corners):
        good[j] &= usable.ravel().take(corner)
        for k, state in enumerate(lit):
            lit_state = state.ravel().take(corner)
            good[j] &= lit_state >= 0
            code[j] |= np.where(lit_state == 1, np.uint32(1 << k), np.uint32(0)).astype(np.uint32)
    bits, u, v = _nearest_valid(good, code, x, y)
    moved = (u - x) ** 2 + (v - y) ** 2
    share = 1 / (1 + np.float32(MOVED) * moved)
    chosen = np.flatnonzero(good.any(axis=0) & (moved <= move**2) & ((bits != 0) | soft))
    u, v = u[chosen], v[chosen]
    values = _bilinear(rgb, pixel[chosen], u, v)
    return near[chosen], values, bits[chosen], chosen, u, v, share[chosen]


def _nearest_valid(good: Bool[np.ndarray, "4 n"], code: UInt[np.ndarray, "4 n"], x, y) -> tuple[np.ndarray, ...]:
    """The light bits of the nearest `good` pixel of the four, and the position (u, v) nearest to (x, y) that needs only
    good pixels in the same light: all four, two side by side or stacked, or the nearest alone."""
    across, down = np.stack([x, 1 - x, x, 1 - x]), np.stack([y, y, 1 - y, 1 - y])
    nearest = np.where(good, across**2 + down**2, np.inf).argmin(axis=0)  # its lowest bit: right; the next: below
    every = np.arange(len(x))
    bits = code[nearest, every]
    same = good & (code == bits)
    whole, beside, above = same.all(axis=0), same[nearest ^ 1, every], same[nearest ^ 2, every]
    keep_y = whole | (above & (~beside | (across[nearest, every] <= down[nearest, every])))
    keep_x = whole | (beside & ~keep_y)
    u, v = np.where(keep_x, x, nearest & 1), np.where(keep_y, y, nearest >> 1)
    return bits, u.astype(np.float32), v.astype(np.float32)


def _bilinear(image: Float[np.ndarray, "h w 3"], pixel, x, y) -> Float[np.ndarray, "n 3"]:
    flat, width = image.reshape(-1, 3), image.shape[1]
    x, y = x[:, None], y[:, None]
    top = flat.take(pixel, axis=0) * (1 - x) + flat.take(pixel + 1, axis=0) * x
    bottom = flat.take(pixel + width, axis=0) * (1 - x) + flat.take(pixel + width + 1, axis=0) * x
    return top * (1 - y) + bottom * y


def _assemble(texel, points, captures: Captures, parts, views, options: ObservationOptions) -> TexelObservations:
    """Sort the observations by texel, then by picture. `parts` is empty afterwards."""
    parts.sort(key=lambda part: -part[0])
    count = np.zeros(len(texel), np.int64)
    for part in parts:
        count[part[1]] += 1
    start = np.concatenate([[0], np.cumsum(count)])
    filled, total = start[:-1].copy(), int(start[-1])
    picture, lit = np.zeros(total, np.int32), np.zeros(total, np.uint32)
    rgb, worth = np.zeros((total, 3), np.float32), np.ones(total, np.float32)
    nothing = np.zeros(0, np.int64)
    per_image = [ImageSamples(nothing, nothing, nothing.astype(np.float32), nothing.astype(np.float32))] * len(captures)
    index = np.int32 if total <= np.iinfo(np.int32).max else np.int64
    while parts:
        k, ids, values, bits, pixel, x, y, share = parts.pop()
        rows = filled[ids].astype(index)
        filled[ids] += 1
        picture[rows], lit[rows], rgb[rows], worth[rows] = k, bits, values, share
        per_image[k] = ImageSamples(rows, pixel, x, y)
    level = np.maximum(rgb.max(axis=1, initial=0), 0)
    weight = worth / observation_std(level, options.noise, options.relative)
    observations = Observations(start, picture, rgb, weight.astype(np.float32), lit)
    return TexelObservations(
        texel, points, rig(captures.cameras, captures.lights), observations, tuple(per_image), views
    )
