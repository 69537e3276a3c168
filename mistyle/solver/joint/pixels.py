"""Footprints of pixels for the joint steps (`joint/gauss_newton.py`), and derivatives of indirect light.

The first surface point reflects indirect light as albedo / π E · n by Lambert's law. n is the mapped normal and E the
vector irradiance (Gershun, The Light Field, 1939): incident radiance integrated along its directions. E is smooth along
the surface and independent of n, so the pixel's derivatives by n and albedo are known. Metals reflect in proportion to
their albedo. Places without direct light are constrained by this light alone. Highlights of indirect light, and the
change of a metal's reflection with its tilt, are treated as constant.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from mistyle.atlas.frames import texel_frames
from mistyle.core.camera import Camera, by_camera
from mistyle.core.light import Point
from mistyle.render.deferred.image_samples import SampleBlock, Sampling, TexturedMesh, bilinear_taps, collect
from mistyle.render.deferred.material_table import ALBEDO, METALLIC, TILT
from mistyle.render.deferred.renderer import MaterialRenderer
from mistyle.solver.context import FitContext
from mistyle.solver.indirect import PALE, enlarged
from mistyle.solver.schedule import JOINT_PIXEL, joint_bytes
from mistyle.solver.table import fill
from mistyle.solver.texels.observations import covered_rows, points_of

WEIGHT = 8  # bytes of a bilinear weight
LEAST_Z = 0.2  # least z of a mapped normal
FLASH = (Point((0.0, 0.0, 0.0), (1.0, 1.0, 1.0), "camera"),)

Frames = Float[np.ndarray, "t 9"]


@dataclass(frozen=True)
class ImageFootprint:
    """Pixels of one picture: flat indices, the share of lit samples, and mean bilinear weights over the lit samples, a
    sparse matrix of pixels x unknown texels. Where no sample is lit, the mean is over all samples."""

    index: Int[np.ndarray, " p"]
    lit: Float[np.ndarray, " p"]
    fetch: Any


@dataclass(frozen=True)
class UnknownTexels:
    """The solved texels, as rows of the table: those that are covered or that a picture shows (`seen`)."""

    rows: Int[np.ndarray, " t"]
    seen: Bool[np.ndarray, " t"]


def image_footprints(
    context: FitContext, renderer: MaterialRenderer
) -> tuple[list[ImageFootprint], UnknownTexels, float] | None:
    """All pictures' lit pixels and, if indirect light is estimated, the other pixels of the mesh; the unknown texels;
    and the bytes of memory that remain. None if the memory does not suffice."""
    settings, cameras = context.settings, context.captures.cameras
    left, images, seen = settings.memory * 1e9, dict[int, ImageFootprint](), np.zeros(renderer.texels, bool)
    left -= joint_bytes(renderer.texels)
    for group in by_camera(cameras):
        every = _covered_pixels(context, renderer, cameras[group[0]]) if settings.bounces else None
        for k in group:
            lit = _footprint((block.hits for block in renderer.blocks(k)), renderer.sizes, renderer.subsamples)
            images[k] = lit if every is None else _with_unlit(lit, every)
            fetch = images[k].fetch
            seen[fetch.indices] = True
            left -= JOINT_PIXEL * fetch.shape[0] + WEIGHT * fetch.nnz
            if left < 0:
                return None
    result = [images[k] for k in range(len(cameras))]
    rows = np.flatnonzero(seen | np.concatenate([c.ravel() for c in context.atlas.covered]))
    number = np.zeros(renderer.texels, np.int32)
    number[rows] = np.arange(len(rows), dtype=np.int32)
    for pixels in result:
        pixels.fetch.indices = number[pixels.fetch.indices]
        pixels.fetch.resize(pixels.fetch.shape[0], len(rows))
    return result, UnknownTexels(rows, seen[rows]), left


def _covered_pixels(context: FitContext, renderer: MaterialRenderer, camera: Camera) -> ImageFootprint:
    """Pixels of the mesh, rendered with a flash at the camera, which casts no visible shadow."""
    surface = TexturedMesh(context.traced, renderer.sizes, context.tangents)
    sampling = Sampling(renderer.subsamples, shadows=False, gradients=False)
    blocks = collect(surface, camera, FLASH, np.ones(camera.size, bool), sampling)
    return _footprint(blocks, renderer.sizes, renderer.subsamples)


def _footprint(blocks: Iterable[SampleBlock], sizes: Sequence[tuple[int, int]], subsamples: int) -> ImageFootprint:
    from scipy.sparse import csr_array, vstack

    texels_of_all = sum(rows * columns for rows, columns in sizes)
    index, lit = [np.zeros(0, int)], [np.zeros(0, np.float32)]
    fetches = [csr_array((0, texels_of_all), dtype=np.float32)]
    for hits in blocks:
        samples, (count, pixels, _) = hits.samples, hits.counts
        slot, texel, step = (np.array(a)[:count].astype(np.int64) for a in (samples.slot, samples.texel, samples.step))
        place = np.stack([np.array(samples.x)[:count], np.array(samples.y)[:count]], axis=1)
        texels, weights = bilinear_taps(texel, step, place, sizes)
        number = np.bincount(slot, minlength=pixels)
        weights = weights / number[slot][:, None]
        entries = (np.repeat(slot, 4).astype(np.int32), texels.ravel().astype(np.int32))
        fetches.append(csr_array((weights.ravel().astype(np.float32), entries), shape=(pixels, texels_of_all)))
        index.append(np.array(hits.pixels.index)[:pixels].astype(int))
        lit.append((number / subsamples).astype(np.float32))
    return ImageFootprint(np.concatenate(index), np.concatenate(lit), vstack(fetches, format="csr"))


def _with_unlit(pixels: ImageFootprint, every: ImageFootprint) -> ImageFootprint:
    """`pixels`, then the pixels of `every` that they lack."""
    from scipy.sparse import vstack

    dark = np.flatnonzero(~np.isin(every.index, pixels.index))
    return ImageFootprint(
        np.concatenate([pixels.index, every.index[dark]]),
        np.concatenate([pixels.lit, np.zeros(len(dark), np.float32)]),
        vstack([pixels.fetch, every.fetch[dark]], format="csr"),
    )


def unknown_frames(context: FitContext, unknown: UnknownTexels) -> Frames:
    """Tangent, bitangent and normal of the unknown texels; uncovered texels take those of the nearest covered one."""
    position, normal, face = points_of(context.texels)
    every = np.zeros((context.atlas.count, 9), np.float32)
    own = texel_frames(context.traced.mesh, face, position, normal, context.tangents)
    every[covered_rows(context.texels)] = own.reshape(-1, 9)
    return fill(every, context.atlas)[unknown.rows]


def indirect_jacobian(
    pixels: ImageFootprint,
    light: Float[np.ndarray, "h w 3"],
    vectors: Float[np.ndarray, "h w 9"],
    size: tuple[int, int],
    values: Float[np.ndarray, "t 8"],
    axes: Frames,
) -> Float[np.ndarray, "p 3 3"]:
    """Derivatives of indirect light in a picture of `size`: of each channel by its own albedo and by the tilt (2).
    `light` and `vectors` as from `Indirect.pictures`; `values` and `axes` of the unknown texels."""
    arriving = enlarged(vectors, size).reshape(-1, 3, 3)[pixels.index]
    frame = (pixels.fetch @ axes).reshape(-1, 3, 3)
    frame /= np.maximum(np.linalg.norm(frame, axis=2, keepdims=True), 1e-6)
    x, y, z = np.einsum("pca,pja->jpc", arriving, frame)
    fetched = pixels.fetch @ values
    metallic = fetched[:, METALLIC, None]
    tilt, diffuse = fetched[:, TILT], (1 - metallic) / np.float32(np.pi)
    mirrored = metallic * enlarged(light, size).reshape(-1, 3)[pixels.index] / (fetched[:, ALBEDO] + PALE)
    up = np.sqrt(np.maximum(1 - (tilt**2).sum(axis=1), LEAST_Z**2))[:, None]
    along, across = tilt[:, :1], tilt[:, 1:]
    albedo = diffuse * fetched[:, ALBEDO]
    by = (
        diffuse * np.maximum(along * x + across * y + up * z, 0) + mirrored,
        albedo * (x - along / up * z),
        albedo * (y - across / up * z),
    )
    return np.stack(by, axis=2).astype(np.float32)


def indirect_delta(
    pixels: ImageFootprint, derivative: Float[np.ndarray, "p 3 3"], moved: Float[np.ndarray, "t 8"]
) -> Float[np.ndarray, "p 3"]:
    """Linear change of indirect light when the unknown texels move."""
    fetched = pixels.fetch @ moved[:, : TILT.stop]
    return derivative[:, :, 0] * fetched[:, ALBEDO] + np.einsum("pcj,pj->pc", derivative[:, :, 1:], fetched[:, TILT])
