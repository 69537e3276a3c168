"""Samples of a picture: surface points and visible lights, traced once and stored in packed arrays.

Geometry, cameras and lights are fixed while materials are fitted. `collect` traces a fixed grid of rays a pixel. It
stores each lit sample that hits the mesh inside the picture's mask: texture footprint, directions to the camera and to
the lights in the tangent frame, and each light's attenuation. The work is split into blocks of rows, so that a picture
of any size needs bounded memory.

Bytes: 29 a sample and 16 more per delta light (pixel 4, texel 4, step 1, position in the texel 8, wi 12; wo 12 and
strength 4 per light), 32 a sample for the transpose, 12 per texel read, 8 a pixel; soft light adds 37 a sample and one
bit per cell of the sky.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from jaxtyping import Bool, Float, Int, Integer

from mistyle.core.camera import Camera, px_from_world
from mistyle.core.drjit_arrays import aligned
from mistyle.core.light import Directional, Lights, Point, SceneLights, direction_in_world, position_in_world
from mistyle.core.mesh import Mesh
from mistyle.geometry.tangents import corner_tangents
from mistyle.render.deferred import integrator as deferred
from mistyle.render.deferred.sky import VARIANTS, Sky, sky
from mistyle.render.mitsuba import device
from mistyle.render.mitsuba.device import dr, mi
from mistyle.render.mitsuba.draw import Tracer

FrameKind = Literal["mikkt", "mitsuba"]

# Rays per block: tracing needs about 500 bytes a ray.
BLOCK_RAYS = 1 << 20


@dataclass(frozen=True)
class TexturedMesh:
    """A mesh to trace, the sizes (rows, columns) of its texture sets, and the frames of its normal maps.

    `tangents` as of `tangents_of`.
    """

    traced: Tracer
    sizes: Sequence[tuple[int, int]]
    tangents: Float[np.ndarray, "f 3 4"] | None = None


@dataclass(frozen=True)
class Sampling:
    """Sampling of a picture: a square number of `subsamples` a pixel, and whether the mesh casts `shadows` on itself.

    Without `gradients` blocks have no transpose: they only render pictures, and build faster.
    """

    subsamples: int = 4
    shadows: bool = True
    gradients: bool = True


DEFAULT_SAMPLING = Sampling()


@dataclass(frozen=True)
class Samples:
    """n lit samples of a block, pixel after pixel, padded with samples of no strength (Dr.Jit arrays only).

    slot      the block's lit pixel that the sample belongs to
    texel     row of the table of texels: top left of the bilinear fetch
    step      row of `steps(sizes)`: offsets to the texels on the right and below
    x, y      position between them, 0..1
    wi        unit direction to the camera, in the tangent frame, z > 0 (a back side is mirrored, as `twosided` does)
    wo        per delta light the unit direction to it, in the same frame
    strength  per delta light 0 where it is hidden or below the horizon, else 1 (directional) or 1 / distance² (point)
    frame     the tangent frame's axes (s, t, n) in the world, n mirrored with wi; None without soft light
    variant   part of the sky's cells that the sample sees (`sky.VARIANTS`)
    visible   UInt32 words: bit k of sample j's word i (at i · n + j) is set if it sees cell 32 i + k
    """

    slot: Any
    texel: Any
    step: Any
    x: Any
    y: Any
    wi: Any
    wo: tuple[Any, ...]
    strength: tuple[Any, ...]
    frame: tuple[Any, Any, Any] | None
    variant: Any
    visible: Any


@dataclass(frozen=True)
class Pixels:
    """p lit pixels of a block, ascending, padded with pixels without samples: Dr.Jit arrays only.

    index   row · width + column in the picture
    first   its first sample
    count   its number of samples
    """

    index: Any
    first: Any
    count: Any


@dataclass(frozen=True)
class Transpose:
    """The transpose of the bilinear fetch: the samples that read each of t texels (Dr.Jit arrays only).

    texel ascends; texel k is read by `sample[begin[k]:end[k]]`, with the bilinear `weight`. Padding has begin = end.
    """

    texel: Any
    begin: Any
    end: Any
    sample: Any
    weight: Any


@dataclass(frozen=True)
class SampleBlock:
    """One block of a picture. `counts` are the samples, pixels and texels without padding.

    transpose only if gradients were requested
    lights    colour of each delta light (irradiance, or intensity of a point), linear Rec.709
    sky       the soft light
    covered   number of samples on the mesh per pixel of the block, lit or not; row 0 of it is row `row` of the picture
    dark      covered pixels of the picture that no light reaches
    bytes     of the Dr.Jit arrays
    """

    samples: Samples
    pixels: Pixels
    transpose: Transpose | None
    lights: Float[np.ndarray, "l 3"]
    sky: Sky | None
    row: int
    covered: Integer[np.ndarray, "rows w"]
    dark: Integer[np.ndarray, " d"]
    counts: tuple[int, int, int]
    bytes: int


def tangents_of(mesh: Mesh, frame: FrameKind) -> Float[np.ndarray, "f 3 4"] | None:
    """Tangents of a frame for `collect`: MikkTSpace's per face corner, or None for Mitsuba's own."""
    return None if frame == "mitsuba" else corner_tangents(mesh)


def grid(subsamples: int) -> Float[np.ndarray, "s 2"]:
    """Centres (x, y) of a square grid of samples in a pixel; `subsamples` is a square number."""
    side = round(subsamples**0.5)
    if side < 1 or side * side != subsamples:
        raise ValueError(f"subsamples is {subsamples}; expected a square number: 1, 4, 9, 16, …")
    line = (np.arange(side) + 0.5) / side
    return np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2).astype(np.float32)


def steps(sizes: Sequence[tuple[int, int]]) -> Int[np.ndarray, "k 2"]:
    """Offsets (rows of the table) of the right and the lower texel: rows 4 · set + 2 · wraps down + wraps right."""
    table = []
    for rows, columns in sizes:
        for down in (columns, columns - rows * columns):
            table += [(right, down) for right in (1, 1 - columns)]
    return np.array(table, np.int32)


def bilinear_taps(
    texel: Int[np.ndarray, " n"],
    step: Int[np.ndarray, " n"],
    place: Float[np.ndarray, "n 2"],
    sizes: Sequence[tuple[int, int]],
) -> tuple[Int[np.ndarray, "n 4"], Float[np.ndarray, "n 4"]]:
    """The four texels (rows of the table) of each footprint, and their bilinear weights."""
    right, down = steps(sizes)[step].astype(np.int64).T
    index = texel[:, None] + np.stack([np.zeros_like(right), right, down, right + down], axis=1)
    x, y = place.T
    return index, np.stack([(1 - x) * (1 - y), x * (1 - y), (1 - x) * y, x * y], axis=1)


def bilinear_footprint(
    uv: Float[np.ndarray, "n 2"], part: Int[np.ndarray, " n"], sizes: Sequence[tuple[int, int]]
) -> tuple[Int[np.ndarray, " n"], Int[np.ndarray, " n"], Float[np.ndarray, "n 2"]]:
    """Bilinear fetch from texture sets of `sizes` (rows, columns), all texels one after the other, row by row.

    Top left texel, its row of `steps`, and the position (x, y) between the texels, 0..1. Texel centres at +0.5, row 0
    is v = 1, textures repeat: exactly as in Mitsuba's bitmap texture. `uv` is v up.
    """
    offsets = np.cumsum([0] + [rows * columns for rows, columns in sizes])
    rows, columns = np.asarray(sizes, np.int64)[part].T
    place = np.stack([uv[:, 0].astype(np.float64) * columns, (1 - uv[:, 1].astype(np.float64)) * rows], axis=1) - 0.5
    whole = np.floor(place)
    column, row = whole.astype(np.int64).T % np.stack([columns, rows])
    step = 4 * part.astype(np.int64) + 2 * (row == rows - 1) + (column == columns - 1)
    return offsets[part] + row * columns + column, step, place - whole


def collect(
    surface: TexturedMesh,
    camera: Camera,
    lights: Lights,
    mask: Bool[np.ndarray, "h w"],
    sampling: Sampling = DEFAULT_SAMPLING,
    soft: Sky | None = None,
) -> Iterator[SampleBlock]:
    """The blocks of one picture, top to bottom, without those that see nothing of the mesh.

    `soft` is `sky.sky(lights)`, built here by default. Shadow rays start where Mitsuba's start. Raises ValueError for
    lights that only a scene file describes.
    """
    device.use()
    if mask.shape != camera.size:
        raise ValueError(f"{camera.name}: found a mask of {mask.shape} pixels; expected the camera's {camera.size}")
    known = [light for light in lights if isinstance(light, Directional | Point)]
    if any(isinstance(light, SceneLights) for light in lights):
        raise ValueError(f"{camera.name}: lights that only a scene file describes are not supported")
    soft = soft or sky(lights)
    down, across = window(surface.traced.mesh, camera)
    near = np.zeros_like(mask)
    near[down, across] = mask[down, across]
    rows = max(1, BLOCK_RAYS // (max(1, across.stop - across.start) * sampling.subsamples))
    for row in range(down.start, down.stop, rows):
        part = near[row : min(row + rows, down.stop)]
        block = _block(surface, camera, known, part, row, sampling, soft)
        if block is not None:
            yield block


def window(mesh: Mesh, camera: Camera) -> tuple[slice, slice]:
    """Rows and columns of the picture that can show the mesh: all, if part of it is behind the camera."""
    px, depth = px_from_world(camera, mesh.positions.astype(np.float64))
    if len(px) == 0 or not (depth > 0).all():
        return slice(0, camera.size[0]), slice(0, camera.size[1])
    # A margin of one pixel covers the rounding of single precision.
    low, high = np.floor(px.min(axis=0)) - 1, np.ceil(px.max(axis=0)) + 1
    (left, top), (right, bottom) = (np.clip(edge, 0, camera.size[::-1]).astype(int).tolist() for edge in (low, high))
    return slice(top, bottom), slice(left, right)


@dataclass(frozen=True)
class _Traced:
    """Hits of a block's rays: Mitsuba's surface points and frames, and a mask of valid rays (Dr.Jit).

    `side` is -1 where the surface's back is seen; `wo` and `strength` per delta light as in `Samples`.
    """

    point: Any
    frame: Any
    wi: Any
    side: Any
    valid: Any
    lit: Any
    wo: list[Any]
    strength: list[Any]


def _block(
    surface: TexturedMesh,
    camera: Camera,
    lights: Sequence[Directional | Point],
    mask: Bool[np.ndarray, "rows w"],
    row: int,
    sampling: Sampling,
    soft: Sky | None,
) -> SampleBlock | None:
    """The block of a picture's rows from `row` on; `mask` selects its pixels. None without any sample."""
    width, subsamples = camera.size[1], sampling.subsamples
    chosen = np.flatnonzero(mask) + row * width
    if len(chosen) == 0:
        return None
    pixel, offset = np.repeat(chosen.astype(np.uint32), subsamples), np.tile(grid(subsamples), (len(chosen), 1))
    places = (mi.Float(aligned(offset[:, axis])) for axis in (0, 1))
    ray = camera_rays(camera, mi.UInt32(aligned(pixel, np.uint32)), *places)
    rays = _trace(surface, camera, lights, ray, sampling.shadows, soft is not None)
    point = rays.point
    face = mi.UInt32(point.prim_index)
    later = () if soft is None else (point.p, point.n, rays.frame)  # otherwise traced again for each component
    dr.eval(rays.valid, rays.lit, rays.wi, rays.wo, rays.strength, face, point.uv, *later)
    on, lit_rays = np.array(rays.valid), np.flatnonzero(np.array(rays.lit)).astype(np.uint32)
    hit = np.bincount(pixel[on] - row * width, minlength=mask.size).reshape(mask.shape)
    if not on.any():
        return None
    part = surface.traced.mesh.part[np.array(face)[lit_rays]]
    uv = np.array(point.uv).T[lit_rays]
    uv = np.stack([uv[:, 0], 1 - uv[:, 1].astype(np.float64)], axis=1)
    texel, step, place = bilinear_footprint(uv, part, surface.sizes)
    size = padded(len(lit_rays))
    # Samples are ordered by pixel.
    begins = np.concatenate([[True], np.diff(pixel[lit_rays]) > 0])[: len(lit_rays)]
    first, slot = np.flatnonzero(begins), np.cumsum(begins) - 1
    lit_pixels, count = pixel[lit_rays][first], np.diff(first, append=len(lit_rays))
    variant = sky_parts(pixel[lit_rays], lit_rays % subsamples, subsamples, width)
    samples = _samples(surface, rays, lit_rays, (slot, texel, step, place), variant, soft, sampling.shadows)
    p = padded(len(lit_pixels))
    pixels = Pixels(*(own(mi.UInt32, _pad(a.astype(np.uint32), p)) for a in (lit_pixels, first, count)))
    transpose, touched = _transpose(texel, step, place, surface.sizes, size) if sampling.gradients else (None, 0)
    dr.make_opaque(samples, pixels, transpose)
    dark = hit.ravel() > 0
    dark[lit_pixels - np.uint32(row * width)] = False
    soft_bytes = 37 + 4 * -(-len(soft.direction) // 32) if soft is not None else 0
    return SampleBlock(
        samples=samples,
        pixels=pixels,
        transpose=transpose,
        lights=np.array([_colour(light) for light in lights], np.float32).reshape(-1, 3),
        sky=soft,
        row=row,
        covered=hit.astype(np.uint16),
        dark=np.flatnonzero(dark) + row * width,
        counts=(len(lit_rays), len(lit_pixels), touched),
        bytes=size * (29 + 16 * len(lights) + soft_bytes)
        + 12 * p
        + (0 if transpose is None else 32 * size + 12 * padded(touched)),
    )


def _trace(
    surface: TexturedMesh,
    camera: Camera,
    lights: Sequence[Directional | Point],
    ray: Any,
    shadows: bool,
    soft: bool,
) -> _Traced:
    point, frame = deferred.intersect(surface.traced, ray, surface.tangents)
    wi = frame.to_local(-ray.d)
    valid = point.is_valid() & (wi.z != 0)
    side = dr.mulsign(mi.Float(1), wi.z)
    lit, wo, strength = valid & soft, [], []
    for light in lights:
        direction, arriving = _arriving(surface.traced, point, light, camera, valid, shadows)
        local = frame.to_local(direction)
        local.z *= side
        arriving = dr.select(valid & (local.z > 0), arriving, 0)
        lit |= arriving > 0
        wo.append(local)
        strength.append(arriving)
    wi.z *= side
    return _Traced(point, frame, wi, side, valid, lit, wo, strength)


def _samples(
    surface: TexturedMesh,
    rays: _Traced,
    lit_rays: Integer[np.ndarray, " n"],
    columns: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray],
    variants: Integer[np.ndarray, " n"],
    soft: Sky | None,
    shadows: bool,
) -> Samples:
    """The rays `lit_rays`, padded; `columns` are their slots, texels, steps and positions, see `Samples`."""
    slot, texel, step, place = columns
    size = padded(len(lit_rays))
    where = own(mi.UInt32, _pad(lit_rays, size))
    real = dr.arange(mi.UInt32, size) < len(lit_rays)
    axes: Any = None
    variant, visible = None, None
    if soft is not None:
        point, frame = rays.point, rays.frame
        axes = tuple(dr.gather(mi.Vector3f, mi.Vector3f(a), where) for a in (frame.s, frame.t, frame.n * rays.side))
        position, normal = (dr.gather(mi.Vector3f, mi.Vector3f(a), where) for a in (point.p, point.n))
        variant = own(mi.UInt8, _pad(variants, size))
        visible = _visible(surface.traced, (position, normal, axes[2]), variant, soft, shadows)
    return Samples(
        slot=own(mi.UInt32, _pad(slot.astype(np.uint32), size)),
        texel=own(mi.UInt32, _pad(texel.astype(np.uint32), size)),
        step=own(mi.UInt8, _pad(step.astype(np.uint8), size)),
        x=own(mi.Float, _pad(place[:, 0].astype(np.float32), size)),
        y=own(mi.Float, _pad(place[:, 1].astype(np.float32), size)),
        wi=dr.gather(mi.Vector3f, rays.wi, where),
        wo=tuple(dr.gather(mi.Vector3f, w, where) for w in rays.wo),
        strength=tuple(dr.select(real, dr.gather(mi.Float, s, where), 0) for s in rays.strength),
        frame=axes,
        variant=variant,
        visible=visible,
    )


def padded(count: int) -> int:
    """The next of eight sizes per octave: frozen functions are recorded once per size, so sizes must be few."""
    unit = max(64, 1 << max(0, (count - 1).bit_length() - 4))
    return max(unit, -(-count // unit) * unit)


def own(kind: Any, values: np.ndarray) -> Any:
    """A Dr.Jit array in its own memory: NumPy's alignment varies, and frozen functions depend on alignment."""
    return kind(aligned(values, values.dtype)) + dr.opaque(kind, 0)


def _pad(values: np.ndarray, size: int) -> np.ndarray:
    result = np.zeros(size, values.dtype)
    result[: len(values)] = values
    return result


def camera_rays(camera: Camera, pixel: Any, x: Any, y: Any) -> Any:
    """Rays through the positions (x, y), 0..1, in the pixels (UInt32, row · width + column); unit directions."""
    width = camera.size[1]  # all else is opaque: one kernel for all cameras of this width
    scale, *centre = (dr.opaque(mi.Float, float(v)) for v in (1 / np.float32(camera.focal), *camera.centre))
    x = (mi.Float(pixel % width) + x - centre[0]) * scale
    y = (mi.Float(pixel // width) + y - centre[1]) * scale
    right, down, forward, eye = (dr.opaque(mi.Vector3f, axis.tolist()) for axis in camera.world_from_cam[:3].T)
    return mi.Ray3f(mi.Point3f(eye), dr.normalize(right * x + down * y + forward))


def _arriving(traced, point, light, camera: Camera, valid, shadows: bool) -> tuple[Any, Any]:
    """World direction to a delta light, and the share of its colour that arrives."""
    if isinstance(light, Directional):
        direction = dr.opaque(mi.Vector3f, direction_in_world(light, camera).tolist())
        strength, shadow = mi.Float(1), point.spawn_ray(direction)
    else:
        position = dr.opaque(mi.Point3f, position_in_world(light, camera).tolist())
        away = position - point.p
        strength = dr.rcp(dr.squared_norm(away))
        direction, shadow = away * dr.sqrt(strength), point.spawn_ray_to(position)
    if shadows:
        strength = dr.select(traced.scene.ray_test(shadow, active=valid), 0, strength)
    return direction, strength


def sky_parts(pixel, subsample, subsamples: int, width: int) -> Integer[np.ndarray, " n"]:
    """The parts of the sky's cells that samples see (`sky.VARIANTS`). They differ between close pixels: those of every
    4 x 4 with one sample, of every 2 x 2 with four, see all of them."""
    x, y = pixel % width, pixel // width
    dither = 2 * (x % 2) + y % 2 + 4 * (2 * (x // 2 % 2) + y // 2 % 2)
    return ((subsample * max(1, VARIANTS // subsamples) + dither) % VARIANTS).astype(np.uint8)


def _visible(traced: Tracer, points: tuple[Any, Any, Any], variant: Any, soft: Sky, shadows: bool) -> Any:
    """The words of `Samples.visible`; `points`: position, geometric normal, shading normal on the camera's side."""
    position, normal, up = points
    point = dr.zeros(mi.SurfaceInteraction3f, dr.width(position))
    point.p, point.n = position, normal
    words, directions = [], mi.Float(aligned(soft.direction.ravel()))
    for first in range(0, len(soft.direction), 32):
        word = mi.UInt32(0)
        for k in range(min(32, len(soft.direction) - first)):
            # Opaque: one kernel for all directions.
            start = dr.opaque(mi.UInt32, (first + k) * VARIANTS)
            towards = dr.gather(mi.Vector3f, directions, start + mi.UInt32(variant))
            seen = dr.dot(up, towards) > 0
            if shadows:
                seen &= ~traced.scene.ray_test(point.spawn_ray(towards), active=seen)
            word |= dr.select(seen, dr.opaque(mi.UInt32, 1 << k), mi.UInt32(0))
            dr.eval(word)
        words.append(word)
    return dr.concat(words)


def _colour(light: Directional | Point) -> tuple[float, float, float]:
    return light.irradiance if isinstance(light, Directional) else light.intensity


def _transpose(texel, step, place, sizes, size: int) -> tuple[Transpose, int]:
    """A counting sort by texel; samples of one texel stay in order, so its sum has a fixed order."""
    import scipy.sparse as sparse

    index, weight = bilinear_taps(texel, step, place, sizes)
    total = sum(rows * columns for rows, columns in sizes)
    shape = (len(texel), total)
    by_sample = sparse.csr_matrix(
        (np.arange(index.size, dtype=np.uint32), index.ravel(), np.arange(0, index.size + 1, 4)), shape=shape
    )
    by_texel: Any = by_sample.tocsc()
    touched = np.flatnonzero(np.diff(by_texel.indptr))
    t = padded(len(touched))
    begin, end = (_pad(by_texel.indptr[touched + k].astype(np.uint32), t) for k in (0, 1))
    weight = weight.ravel()[by_texel.data]
    integers = (_pad(touched.astype(np.uint32), t), begin, end, _pad(by_texel.data // 4, 4 * size))
    first, begins, ends, sample = (own(mi.UInt32, a) for a in integers)
    return Transpose(first, begins, ends, sample, own(mi.Float, _pad(weight.astype(np.float32), 4 * size))), len(
        touched
    )
