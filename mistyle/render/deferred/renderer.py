"""The differentiable renderer of the fits: known surface samples, known lights, one texture fetch, no noise.

Nothing is traced while materials change: `image_samples.collect` stores each sample's geometry, and a picture is

    I_p = 1/S Σ_s Σ_l f(wi, wo_l; material at s) cos θ_l · strength_l · colour_l      (box filter over S samples)

summed over delta lights exactly. Materials are rows of one table of texels (`material_table.py`). A fetch interpolates
(x, y, z) of the normals, as Mitsuba and viewers do, and z follows from the tilt.

Gradients by the table are gathers: each sample's eight derivatives are written in one packet, then each texel sums
those of the samples that read it, in a fixed order. Bytes are equal in any run and at any number of threads. Of the
methods in `benchmarks/fit_speed` this is the fastest that gives the same picture: 1.3 ms. Packed atomic adds take 11 ms
(14 in texel order, where neighbours collide), and SciPy's sparse product 2.0 ms plus a sync. Shading texels instead of
pixels would give a different picture.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from mistyle.core.capture import Captures
from mistyle.core.drjit_arrays import aligned
from mistyle.core.light import SOFT, Lights
from mistyle.render.deferred import bsdf, kernels
from mistyle.render.deferred import image_samples as collecting
from mistyle.render.deferred.material_table import COLUMNS
from mistyle.render.deferred.sky import Sky, sky
from mistyle.render.mitsuba import device
from mistyle.render.mitsuba.device import dr, mi
from mistyle.render.mitsuba.draw import Tracer

Loss = Literal["l2", "log_srgb_l1"]
Weights = Callable[[int], Float[np.ndarray, "h w"]]


@dataclass(frozen=True)
class RenderOptions:
    """Rendering and memory options of a MaterialRenderer.

    model, flip_invalid, shadowing, specular  as in `bsdf.Reflectance`
    frame       of the normal maps
    subsamples  samples a pixel, a square number
    shadows     whether the mesh shadows itself
    directions  number of cells of soft light
    memory      bytes of cached samples and references
    gradients   False: pictures only, with a third less memory
    freeze      False: every call is traced anew, which is slow and eases debugging
    """

    model: str = "principled"
    frame: collecting.FrameKind = "mikkt"
    subsamples: int = 4
    shadows: bool = True
    flip_invalid: bool = False
    shadowing: bool = False
    specular: float = 0.5
    directions: int = 128
    memory: float = 4e9
    gradients: bool = True
    freeze: bool = True


DEFAULT_OPTIONS = RenderOptions()


class MaterialRenderer:
    """Pictures of known cameras under known lights as a function of a material table, with gradients.

    Built once for a fit. A picture's samples are collected at its first use and cached within `options.memory` bytes;
    the others are collected again each time, with the same result. A table is a `MaterialTable`, or its Dr.Jit array
    from `upload`, which saves copies when several pictures are rendered from it. One object is for one thread.
    """

    def __init__(
        self,
        traced: Tracer,
        captures: Captures,
        sizes: Sequence[tuple[int, int]],
        options: RenderOptions = DEFAULT_OPTIONS,
        weights: Weights | None = None,
    ) -> None:
        """`sizes` (rows, columns) of the texture sets; `weights` gives picture k's pixels a factor in the loss."""
        device.use()
        if len(sizes) != len(traced.mesh.parts):
            raise ValueError(f"found {len(sizes)} sizes for {len(traced.mesh.parts)} texture sets")
        if options.model not in bsdf.MODELS:
            raise ValueError(f"model is {options.model!r}; expected one of {', '.join(bsdf.MODELS)}")
        self.traced, self.captures, self.weights = traced, captures, weights
        self.sizes, self.options = tuple(sizes), options
        self.texels = sum(rows * columns for rows, columns in sizes)
        self._tangents = collecting.tangents_of(traced.mesh, options.frame)
        reflectance = bsdf.Reflectance(options.model, options.flip_invalid, options.shadowing, options.specular)
        self._terms = partial(bsdf.terms, reflectance)
        self._steps = _steps(self.sizes)
        self._cache: dict[int, list[Block]] = {}
        self._too_large: set[int] = set()
        self._skies: dict[Any, tuple[Sky | None, Any]] = {}
        self._frozen: dict[Any, Any] = {}

    @property
    def subsamples(self) -> int:
        """Samples a pixel."""
        return self.options.subsamples

    def upload(self, table: Any) -> Any:
        """The table (NumPy, TensorXf or Float) as a Dr.Jit Float, for the other methods."""
        if isinstance(table, mi.TensorXf):
            table = table.array
        elif not isinstance(table, mi.Float):
            array = np.ascontiguousarray(table, np.float32)
            if array.shape != (self.texels, COLUMNS):
                raise ValueError(f"found a table of {array.shape}; expected {(self.texels, COLUMNS)}")
            table = collecting.own(mi.Float, array.ravel())
        dr.eval(table)
        return table

    def retarget(self, captures: Captures, weights: Weights | None, pictures: Iterable[int] | None = None) -> None:
        """Replace references and weights; cached samples of `pictures` (default: all) are updated now.

        Cameras, lights and masks of `captures` must be unchanged.
        """
        self.captures, self.weights = captures, weights
        for k in self._cache if pictures is None else pictures:
            if k not in self._cache:
                continue
            rgb, weight = captures.load(k)[0].reshape(-1, 3), self._weight(k).ravel()
            for block in self._cache[k]:
                target = np.array(block.target).reshape(-1, 4)
                target[: len(block.pixel), :3] = rgb[block.pixel]
                target[: len(block.pixel), 3] = weight[block.pixel]
                block.target = mi.Float(aligned(target.ravel()))

    def with_memory(self, memory: float) -> "MaterialRenderer":
        """The same renderer with an empty cache of `memory` bytes."""
        twin = copy(self)
        twin.options, twin._cache, twin._too_large = replace(self.options, memory=memory), {}, set()
        return twin

    def with_model(self, model: str) -> "MaterialRenderer":
        """The same renderer, cached samples included, with another reflectance."""
        twin, o = copy(self), replace(self.options, model=model)
        twin.options, twin._frozen = o, {}
        twin._terms = partial(bsdf.terms, bsdf.Reflectance(model, o.flip_invalid, o.shadowing, o.specular))
        return twin

    def image(self, table: Any, picture: int) -> Float[np.ndarray, "h w 3"]:
        """Picture k, linear Rec.709: the mean over all samples of a pixel; samples beside the mesh are black.

        Pixels outside the picture's mask are black.
        """
        return self.image_and_coverage(table, picture)[0]

    def image_and_coverage(
        self, table: Any, picture: int
    ) -> tuple[Float[np.ndarray, "h w 3"], Float[np.ndarray, "h w"]]:
        """`image`, and the share of each pixel's samples that hit the mesh, 0..1 (0 outside the picture's mask)."""
        size, textures = self.captures.cameras[picture].size, self._textures(table)
        rgb, share = np.zeros((size[0] * size[1], 3), np.float32), np.zeros(size, np.float32)
        for block in self.blocks(picture, gradients=False):
            run = self._function(block, "image", kernels.image, self._terms, self.subsamples)
            lit, row, covered = block.hits.counts[1], block.hits.row, block.hits.covered
            shown = np.array(run(textures, block.hits.samples, block.hits.pixels, block.lights)).reshape(-1, 4)
            rgb[block.pixel] = shown[:lit, :3]
            share[row : row + len(covered)] = covered / np.float32(self.subsamples)
        return rgb.reshape(*size, 3), share

    def image_and_slopes(
        self, table: Any, picture: int
    ) -> tuple[Float[np.ndarray, "h w 3"], Float[np.ndarray, "h w 3 4"]]:
        """`image`, and the derivatives of its channels by their own albedo, both tilts and roughness if all texels
        change alike. Delta lights only."""
        size, textures = self.captures.cameras[picture].size, self._textures(table)
        result = np.zeros((5, size[0] * size[1], 3), np.float32)
        for block in self.blocks(picture, gradients=False):
            run = self._function(block, "slopes", kernels.slopes, self._terms, self.subsamples)
            lit = block.hits.counts[1]
            for k, packets in enumerate(run(textures, block.hits.samples, block.hits.pixels, block.lights)):
                result[k, block.pixel] = np.array(packets).reshape(-1, 4)[:lit, :3]
        result = result.reshape(5, *size, 3)
        return result[0], np.moveaxis(result[1:], 0, -1)

    def step(self, table: Any, pictures: Sequence[int], loss: Loss = "log_srgb_l1") -> tuple[Any, Any]:
        """(loss, gradient by the table) over some pictures, both Dr.Jit arrays that are not yet synchronised.

        loss = mean over pictures of 1/(3 h w) Σ_pixels weight Σ_channels ρ(I, R), over the valid covered pixels;
        ρ is (I - R)² for "l2" and |g(I) - g(R)| for "log_srgb_l1", where g(x) = sRGB(log(1 + max(x, 0))) (nvdiffrec,
        eq. 7). The gradient is a TensorXf (texels, 8), its spare channel 0.
        """
        if loss not in kernels.LOSSES:
            raise ValueError(f"loss is {loss!r}; expected one of {', '.join(kernels.LOSSES)}")
        gradient, total, textures = self._empty_gradient(), mi.Float(0), self._textures(table)
        for k in pictures:
            for block in self.blocks(k):
                run = self._function(block, loss, kernels.step, self._terms, self.subsamples, loss)
                # Opaque: a literal in a frozen function would be recorded again for each value.
                scale = dr.opaque(mi.Float, float(1 / (3 * np.prod(self.captures.cameras[k].size) * len(pictures))))
                assert block.arrays.transpose is not None
                value, rows = run(textures, block.arrays, (block.target, scale))
                total += value + block.dark[loss] * scale
                kernels.add_rows(gradient, rows, block.arrays.transpose)
        dr.eval(total, gradient)
        return total, mi.TensorXf(gradient, (self.texels, COLUMNS))

    def pull(self, table: Any, picture: int, adjoint: Any) -> Any:
        """Gradient by the table, TensorXf (texels, 8), of a loss whose derivative by image k is `adjoint` (h, w, 3).

        `adjoint` is NumPy, torch (on the CPU) or a Dr.Jit tensor.
        """
        gradient, textures = self._empty_gradient(), self._textures(table)
        values = mi.Float(mi.TensorXf(adjoint).array)
        for block in self.blocks(picture):
            run = self._function(block, "pull", kernels.pull, self._terms, self.subsamples)
            assert block.arrays.transpose is not None
            rows = run(textures, block.arrays, values)
            kernels.add_rows(gradient, rows, block.arrays.transpose)
        return mi.TensorXf(gradient, (self.texels, COLUMNS))

    def _textures(self, table: Any) -> Any:
        return self.upload(table), *self._steps

    def _empty_gradient(self) -> Any:
        gradient = dr.zeros(mi.Float, COLUMNS * self.texels)
        dr.make_opaque(gradient)
        return gradient

    def _function(self, block: "Block", name: str, function: Callable, *fixed: Any) -> Any:
        """`function` with its fixed arguments, frozen once per size of arrays (sizes are constants of a recording)."""
        if not self.options.freeze:
            return lambda *arguments: function(*fixed, *arguments)
        key = (name, *block.widths)
        if key not in self._frozen:
            self._frozen[key] = device.Frozen(lambda *arguments: function(*fixed, *arguments))
        return self._frozen[key]

    def blocks(self, picture: int, gradients: bool = True) -> Iterator["Block"]:
        """The cached blocks of a picture, top to bottom, collected now if missing; then possibly for pictures only."""
        if picture in self._cache:
            yield from self._cache[picture]
            return
        camera, lights = self.captures.cameras[picture], self.captures.lights[picture]
        rgb, mask = self.captures.load(picture)
        weights = self._weight(picture)
        soft, soft_light = self._sky(lights)
        cached: list[Block] | None = [] if self.options.memory and picture not in self._too_large else None
        sampling = collecting.Sampling(
            self.subsamples, self.options.shadows, self.options.gradients and (gradients or cached is not None)
        )
        surface = collecting.TexturedMesh(self.traced, self.sizes, self._tangents)
        for hits in collecting.collect(surface, camera, lights, mask, sampling, soft):
            block = Block(hits, soft_light, rgb, weights)
            if cached is not None:
                cached.append(block)
                if self.held() + sum(b.bytes for b in cached) > self.options.memory:
                    cached = None
                    self._too_large.add(picture)
            yield block
        if cached is not None:
            self._cache[picture] = cached

    def _weight(self, picture: int) -> Float[np.ndarray, "h w"]:
        if self.weights is not None:
            return self.weights(picture)
        return np.ones(self.captures.cameras[picture].size, np.float32)

    def _sky(self, lights: Lights) -> tuple[Sky | None, Any]:
        """The soft light, as cells and as shading arrays; built once per set of light records."""
        soft = tuple(light for light in lights if isinstance(light, SOFT))
        key = tuple(map(id, soft))
        if key not in self._skies:
            cells = sky(soft, self.options.directions)
            self._skies[key] = (cells, None if cells is None else kernels.upload(cells))
        return self._skies[key]

    def held(self) -> int:
        """Bytes of the cached samples."""
        return sum(block.bytes for blocks in self._cache.values() for block in blocks)


class Block:
    """Hits of a block of a picture, with the pixels of its reference."""

    def __init__(self, hits: collecting.SampleBlock, soft_light: Any, rgb: np.ndarray, weights: np.ndarray) -> None:
        lit = hits.counts[1]
        self.hits = hits
        self.pixel = np.array(hits.pixels.index)[:lit]
        self.widths = (
            dr.width(hits.samples.slot),
            dr.width(hits.pixels.index),
            dr.width(hits.transpose.texel) if hits.transpose is not None else 0,
            len(hits.lights),
            len(hits.sky.direction) if hits.sky is not None else 0,
        )
        target = np.zeros((self.widths[1], 4), np.float32)
        target[:lit, :3] = rgb.reshape(-1, 3)[self.pixel]
        target[:lit, 3] = weights.ravel()[self.pixel]
        self.target = collecting.own(mi.Float, target.ravel())
        colours = tuple(mi.Color3f(*(dr.opaque(mi.Float, float(c)) for c in colour)) for colour in hits.lights)
        dr.eval(self.target)
        self.lights = (colours, soft_light)
        self.arrays = kernels.BlockArrays(hits.samples, hits.pixels, hits.transpose, self.lights)
        # An unlit pixel is black for all materials: its part of the loss is constant.
        black, weight = rgb.reshape(-1, 3)[hits.dark].astype(np.float64), weights.ravel()[hits.dark]
        self.dark = {name: _dark(name, black, weight) for name in kernels.LOSSES}
        self.bytes = hits.bytes + target.nbytes + self.pixel.nbytes + hits.covered.nbytes


def _steps(sizes: Sequence[tuple[int, int]]) -> tuple[Any, Any]:
    right, down = (mi.Int32(aligned(column, np.int32)) for column in collecting.steps(sizes).T)
    dr.make_opaque(right, down)
    return right, down


def _dark(loss: str, reference: Float[np.ndarray, "d 3"], weight: Float[np.ndarray, " d"]) -> float:
    """Σ weight · ρ(0, R)."""
    if loss == "l2":
        lost = reference**2
    else:
        x = np.log1p(np.maximum(reference, 0))
        lost = np.where(x <= 0.0031308, 12.92 * x, 1.055 * np.maximum(x, 0.0031308) ** (1 / 2.4) - 0.055)
    return float((lost.sum(axis=1) * weight).sum())
