"""The differentiable renderer of the fits: known surface samples, known lights, one texture fetch, no noise.

Nothing is traced while materials move: `hits.collect` has stored what each sample needs, and a picture is

    I_p = 1/S Σ_s Σ_l f(wi, wo_l; material at s) cos θ_l · strength_l · colour_l      (box filter over S samples)

summed over delta lights exactly. Materials are rows of one table of texels, all texture sets one after the other, row
by row, 8 floats each: albedo 3 (linear), tilt 2 (x and y of the unit tangent-space normal), roughness, metallic, one
spare. A fetch interpolates (x, y, z) of the normals, as Mitsuba and viewers do, and z follows from the tilt.

Gradients by the table are gathers: each sample's eight derivatives are written in one packet, then each texel sums
those of the samples that read it, in a fixed order. The same bytes come out at any run and any number of threads. Of
the ways that `benchmarks/fit_speed.py` compares this is the fastest that gives the same picture: 1.3 ms where packed
atomic adds take 11 ms (14 in the order of the texels, as neighbours then meet) and the sparse product of SciPy 2.0 ms
and a wait for it; shading texels instead of pixels would be another picture.
"""

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from mistyle.core.capture import Captures
from mistyle.core.lanes import aligned
from mistyle.core.light import SOFT, Lights
from mistyle.core.maps import Maps, rows_of
from mistyle.render import bsdf, device, shading
from mistyle.render import hits as collecting
from mistyle.render.draw import Tracer
from mistyle.render.sky import Sky, sky

Loss = Literal["l2", "log_srgb_l1"]
Table = Float[np.ndarray, "t 8"]


def pack(maps: Sequence[Maps]) -> Table:
    """The table of some texture sets' maps; normals of any length, z > 0."""
    rows = []
    for m in maps:
        tilt = m.normal[..., :2] / np.linalg.norm(m.normal, axis=-1, keepdims=True)
        parts = (m.albedo, tilt, m.roughness[..., None], m.metallic[..., None], np.zeros((*m.roughness.shape, 1)))
        rows.append(np.concatenate(parts, axis=-1, dtype=np.float32).reshape(-1, 8))
    return np.concatenate(rows)


def unpack(table: Table, sizes: Sequence[tuple[int, int]]) -> list[Maps]:
    """`pack` undone; `known` is True everywhere."""
    result = []
    for part, size in zip(rows_of(sizes), sizes, strict=True):
        rows = table[part].reshape(*size, 8).astype(np.float32)
        z = np.sqrt(np.maximum(1 - (rows[..., 3:5] ** 2).sum(-1, keepdims=True), shading.LEAST_Z**2))
        normal = np.concatenate([rows[..., 3:5], z], axis=-1)
        normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
        albedo, roughness, metallic = (np.ascontiguousarray(rows[..., k]) for k in (slice(0, 3), 5, 6))
        result.append(Maps(albedo, normal, roughness, metallic, np.ones(size, bool)))
    return result


class Shade:
    """Pictures of known cameras under known lights as a function of the materials, with gradients.

    Built once for a fit. Samples of pictures are collected when they are first asked for and kept while `memory` bytes
    (hits and references of all kept pictures) last; those of the others are collected again each time, with the same
    result. One object is for one thread.
    """

    def __init__(
        self,
        traced: Tracer,
        captures: Captures,
        sizes: Sequence[tuple[int, int]],
        *,
        model: str = "principled",
        frame: collecting.FrameKind = "mikkt",
        subsamples: int = 4,
        shadows: bool = True,
        flip_invalid: bool = False,
        shadowing: bool = False,
        directions: int = 128,
        specular: float = 0.5,
        weights: Callable[[int], Float[np.ndarray, "h w"]] | None = None,
        memory: float = 4e9,
        gradients: bool = True,
        freeze: bool = True,
    ) -> None:
        """`sizes` (rows, columns) of the texture sets; `weights` gives picture k's pixels a factor in the loss.

        `flip_invalid`, `shadowing` and `specular` as in `bsdf.evaluate`; `subsamples` a square number of samples a
        pixel; `directions` how many cells soft light comes from; without `gradients` there are pictures only, and what
        is kept of them takes a third less; without `freeze` every call is traced anew, which is slow and good for
        looking into it.
        """
        device.use()
        if len(sizes) != len(traced.mesh.parts):
            raise ValueError(f"{len(sizes)} sizes came for {len(traced.mesh.parts)} texture sets")
        if model not in bsdf.MODELS:
            raise ValueError(f"model is {model!r}; expected one of {', '.join(bsdf.MODELS)}")
        self.traced, self.captures, self.sizes = traced, captures, tuple(sizes)
        self.subsamples, self.shadows, self.weights, self.memory = subsamples, shadows, weights, memory
        self.directions, self.gradients = directions, gradients
        self.texels = sum(rows * columns for rows, columns in sizes)
        self._tangents = collecting.tangents_of(traced.mesh, frame)
        options = {"flip_invalid": flip_invalid, "shadowing": shadowing, "specular": specular}
        self._terms = partial(bsdf.terms, model, **options)
        self._steps = _steps(self.sizes)
        self._kept: dict[int, list[Block]] = {}
        self._too_large: set[int] = set()
        self._skies: dict[Any, tuple[Sky | None, Any]] = {}
        self._frozen: dict[Any, Any] = {}
        self._freeze = freeze
        self._table: Any = None
        self.table = pack([_neutral(size) for size in self.sizes])

    @property
    def table(self) -> Table:
        """The materials (texels, 8), a copy."""
        return np.array(self._table).reshape(-1, 8)

    @table.setter
    def table(self, values: Any) -> None:
        import drjit as dr
        import mitsuba as mi

        if isinstance(values, mi.TensorXf):
            values = values.array
        elif not isinstance(values, mi.Float):
            array = np.ascontiguousarray(values, np.float32)
            if array.shape != (self.texels, 8):
                raise ValueError(f"a table of {array.shape} came; expected {(self.texels, 8)}")
            values = collecting.own(mi.Float, array.ravel())
        dr.eval(values)
        self._table = values

    def image(self, picture: int) -> Float[np.ndarray, "h w 3"]:
        """Picture k, linear Rec.709: the mean over all samples of a pixel, those beside the mesh black.

        Pixels that do not count for the fit (outside the picture's mask) are black.
        """
        return self.image_and_coverage(picture)[0]

    def image_and_coverage(self, picture: int) -> tuple[Float[np.ndarray, "h w 3"], Float[np.ndarray, "h w"]]:
        """`image`, and which share of each pixel's samples meets the mesh, 0..1 (0 outside the picture's mask)."""
        size = self.captures.cameras[picture].size
        rgb, share = np.zeros((size[0] * size[1], 3), np.float32), np.zeros(size, np.float32)
        for block in self.blocks(picture, gradients=False):
            run = self._function(block, "image", shading.image, self._terms, self.subsamples)
            lit, row, covered = block.hits.counts[1], block.hits.row, block.hits.covered
            found = np.array(run(self._textures, block.hits.samples, block.hits.pixels, block.lights)).reshape(-1, 4)
            rgb[block.pixel] = found[:lit, :3]
            share[row : row + len(covered)] = covered / np.float32(self.subsamples)
        return rgb.reshape(*size, 3), share

    def step(self, pictures: Sequence[int], loss: Loss = "log_srgb_l1") -> tuple[Any, Any]:
        """(loss, gradient by the table) over some pictures, both Dr.Jit and not yet waited for.

        loss = mean over pictures of 1/(3 h w) Σ_pixels weight Σ_channels ρ(I, R), over the covered pixels that count;
        ρ is (I - R)² for "l2" and |g(I) - g(R)| for "log_srgb_l1", where g(x) = sRGB(log(1 + max(x, 0))) (nvdiffrec,
        eq. 7). The gradient is a TensorXf (texels, 8), its spare channel 0.
        """
        if loss not in shading.LOSSES:
            raise ValueError(f"loss is {loss!r}; expected one of {', '.join(shading.LOSSES)}")
        import drjit as dr
        import mitsuba as mi

        gradient, total = self._empty_gradient(), mi.Float(0)
        for k in pictures:
            for block in self.blocks(k):
                run = self._function(block, loss, shading.step, self._terms, self.subsamples, loss)
                scale = self._scale(1 / (3 * np.prod(self.captures.cameras[k].size) * len(pictures)))
                h = block.hits
                assert h.transpose is not None
                value, rows = run(self._textures, h.samples, h.pixels, h.transpose, block.lights, block.target, scale)
                total += value + block.dark[loss] * scale
                shading.add_rows(gradient, rows, h.transpose)
        dr.eval(total, gradient)
        return total, mi.TensorXf(gradient, (self.texels, 8))

    def pull(self, picture: int, adjoint: Any) -> Any:
        """Gradient by the table, TensorXf (texels, 8), of a loss whose derivative by image k is `adjoint` (h, w, 3).

        `adjoint` is NumPy, torch (on the CPU) or a Dr.Jit tensor.
        """
        import mitsuba as mi

        gradient = self._empty_gradient()
        values = mi.Float(mi.TensorXf(adjoint).array)
        for block in self.blocks(picture):
            run = self._function(block, "pull", shading.pull, self._terms, self.subsamples)
            h = block.hits
            assert h.transpose is not None
            rows = run(self._textures, h.samples, h.pixels, h.transpose, block.lights, values)
            shading.add_rows(gradient, rows, h.transpose)
        return mi.TensorXf(gradient, (self.texels, 8))

    @property
    def _textures(self) -> Any:
        return self._table, *self._steps

    @property
    def recordings(self) -> int:
        """How many times a frozen function has been recorded so far."""
        return sum(f.n_recordings for f in self._frozen.values())

    def _empty_gradient(self) -> Any:
        import drjit as dr
        import mitsuba as mi

        gradient = dr.zeros(mi.Float, 8 * self.texels)
        dr.make_opaque(gradient)
        return gradient

    def _scale(self, value: float) -> Any:
        """An opaque number: a literal in a frozen function would be recorded again for each value."""
        import drjit as dr
        import mitsuba as mi

        return dr.opaque(mi.Float, float(value))

    def _function(self, block: "Block", name: str, function: Callable, *fixed: Any) -> Any:
        """`function` with its fixed arguments, frozen once per size of arrays (sizes are constants of a recording)."""

        if not self._freeze:
            return lambda *arguments: function(*fixed, *arguments)
        key = (name, *block.widths)
        if key not in self._frozen:
            self._frozen[key] = device.Frozen(lambda *arguments: function(*fixed, *arguments))
        return self._frozen[key]

    def blocks(self, picture: int, gradients: bool = True) -> Iterator["Block"]:
        """What is kept of a picture, top to bottom; collected now if it is not kept, then perhaps for pictures only."""
        if picture in self._kept:
            yield from self._kept[picture]
            return
        camera, lights = self.captures.cameras[picture], self.captures.lights[picture]
        rgb, mask = self.captures.load(picture)
        weights = self.weights(picture) if self.weights is not None else np.ones(camera.size, np.float32)
        soft, soft_light = self._sky(lights)
        options = {"subsamples": self.subsamples, "shadows": self.shadows, "soft": soft}
        kept: list[Block] | None = [] if self.memory and picture not in self._too_large else None
        options["gradients"] = self.gradients and (gradients or kept is not None)
        for hits in collecting.collect(self.traced, camera, lights, mask, self.sizes, self._tangents, **options):
            block = Block(hits, soft_light, rgb, weights)
            if kept is not None:
                kept.append(block)
                if self.held() + sum(b.bytes for b in kept) > self.memory:
                    kept = None
                    self._too_large.add(picture)
            yield block
        if kept is not None:
            self._kept[picture] = kept

    def kept(self, picture: int) -> Sequence["Block"]:
        """The blocks of a picture that is kept; of others none."""
        return self._kept.get(picture, ())

    def _sky(self, lights: Lights) -> tuple[Sky | None, Any]:
        """The soft light, as cells and as the arrays that shade; made once for pictures of the same records."""
        soft = tuple(light for light in lights if isinstance(light, SOFT))
        key = tuple(map(id, soft))
        if key not in self._skies:
            made = sky(soft, self.directions)
            self._skies[key] = (made, None if made is None else shading.upload(made))
        return self._skies[key]

    def held(self) -> int:
        """Bytes of what is kept of the pictures' samples."""
        return sum(block.bytes for blocks in self._kept.values() for block in blocks)


class Block:
    """Hits of a block of a picture, with the pixels of its reference."""

    def __init__(self, hits: collecting.Hits, soft_light: Any, rgb: np.ndarray, weights: np.ndarray) -> None:
        import drjit as dr
        import mitsuba as mi

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
        # A pixel that no light reaches stays black whatever the materials: its share of the loss is a constant.
        black, weight = rgb.reshape(-1, 3)[hits.dark].astype(np.float64), weights.ravel()[hits.dark]
        self.dark = {name: _dark(name, black, weight) for name in shading.LOSSES}
        self.bytes = hits.bytes + target.nbytes + self.pixel.nbytes + hits.covered.nbytes


def _steps(sizes: Sequence[tuple[int, int]]) -> tuple[Any, Any]:
    import drjit as dr
    import mitsuba as mi

    right, down = (mi.Int32(aligned(column, np.int32)) for column in collecting.steps(sizes).T)
    dr.make_opaque(right, down)
    return right, down


def _neutral(size: tuple[int, int]) -> Maps:
    grey, normal = np.full(size, 0.5, np.float32), np.zeros((*size, 3), np.float32)
    normal[..., 2] = 1
    return Maps(np.repeat(grey[..., None], 3, axis=-1), normal, grey, np.zeros_like(grey), np.ones(size, bool))


def _dark(loss: str, reference: Float[np.ndarray, "d 3"], weight: Float[np.ndarray, " d"]) -> float:
    """Σ weight · ρ(0, R)."""
    if loss == "l2":
        lost = reference**2
    else:
        x = np.log1p(np.maximum(reference, 0))
        lost = np.where(x <= 0.0031308, 12.92 * x, 1.055 * np.maximum(x, 0.0031308) ** (1 / 2.4) - 0.055)
    return float((lost.sum(axis=1) * weight).sum())
