"""Bridge between torch's and Dr.Jit's gradients: maps (torch) ⇄ image (torch), by frozen kernels or one `dr.wrap`.

Torch owns the maps of every texture set, as one table of texels. A picture is rendered in two steps, each with a
gradient whose bytes are the same in every run at any thread count:

1. `taps` computes, once per traced surface, the four texels and weights of every pixel's bilinear fetch; `fetch` is a
   sparse matrix product, its gradient the product with the transpose, summed in a fixed order.
2. A `Shader` shades the pixels' own materials, one texel per pixel: by the recorded functions of
   `render/deferred/split.py`, or as textures as large as the film on the BSDF of `render/mitsuba/scene.py`, by the
   integrator of `render/deferred/integrator.py`.

Mitsuba's own gradient of a shared texture is summed by atomics, in varying order.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import scipy.sparse as sparse
from jaxtyping import Float, Int

from mistyle.core.drjit_arrays import LANES, aligned
from mistyle.core.maps import flat_maps
from mistyle.render.deferred import integrator as deferred
from mistyle.render.deferred import split
from mistyle.render.deferred.image_samples import bilinear_footprint, bilinear_taps
from mistyle.render.mitsuba import device
from mistyle.render.mitsuba import scene as scenery
from mistyle.render.mitsuba.device import dr, mi

CHANNELS = {"albedo": 3, "normal": 3, "roughness": 1, "metallic": 1}
Bridge = Literal["frozen", "wrap"]


@dataclass(frozen=True)
class Taps:
    """A bilinear fetch by n pixels from a table of texels (all texture sets one after the other, row by row).

    `texels` (sorted, each once) are the referenced rows of the table; `matrix` (n, texels) holds the weights, at most
    four per row, none for pixels off the mesh.
    """

    texels: Int[np.ndarray, " t"]
    matrix: Any


def taps(surface: deferred.Surface, sizes: Sequence[tuple[int, int]]) -> Taps:
    """The bilinear fetch of every pixel of `surface` from texture sets of `sizes` (rows, columns)."""
    on, count = np.flatnonzero(surface.mask), sum(rows * columns for rows, columns in sizes)
    index, weight = bilinear_taps(*bilinear_footprint(surface.uv[on], surface.part[on], sizes), sizes)
    touched = np.zeros(count, bool)
    touched[index] = True
    texels = np.flatnonzero(touched)
    local = np.zeros(count, np.int32)
    local[texels] = np.arange(len(texels), dtype=np.int32)
    pointer = np.concatenate([[0], np.cumsum(np.where(surface.mask, 4, 0))])
    values = weight.astype(np.float32).ravel(), local[index].ravel(), pointer
    return Taps(texels, sparse.csr_matrix(values, shape=(len(surface.mask), len(texels))))


def fetch(values: Any, where: Taps) -> Any:
    """Texel values (t, c), in the order of `where.texels`, to pixel values (n, c), torch to torch with a gradient."""
    return _functions()["sparse"].apply(values, where.matrix)


class Shader:
    """Shades a film of `size` pixels by one of two bridges between torch and Dr.Jit that give the same numbers.

    "frozen" replays a recorded forward and a recorded backward (`render/deferred/split.py`). "wrap" is its reference:
    Mitsuba's own BSDF and `mi.render` behind one `dr.wrap`, traced anew at each call. A shader is reused, because
    building one costs more than rendering. One picture at a time: its gradient must be computed before the next call.
    """

    def __init__(self, size: tuple[int, int], *, gloss: bool = True, bridge: Bridge = "frozen") -> None:
        """`gloss` False omits the specular reflection of dielectrics: only the diffuse colour remains."""
        if bridge not in ("frozen", "wrap"):
            raise ValueError(f"bridge is {bridge!r}; expected 'frozen' or 'wrap'")
        self.size = size
        self._bridge: Any = _Wrapped(size, gloss) if bridge == "wrap" else split.Split(gloss=gloss)

    def __call__(self, lit: deferred.Lit, pixels: Any, moving: Sequence[str] = ()) -> Any:
        """Linear radiance (rows, columns, 3) of the lit film, a torch tensor, with a gradient for the maps `moving`.

        `pixels` (n, 8) holds the maps of CHANNELS side by side: albedo 3 and metallic linear 0..1, normal 3 a
        tangent-space vector of any length, roughness.
        """
        if lit.size != self.size:
            raise ValueError(f"the film has {self.size} pixels, the lit surface {lit.size}")
        if isinstance(self._bridge, _Wrapped):
            return self._bridge(lit, pixels, moving)
        if not moving:
            pixels = pixels.detach()
        return _functions()["shaded"].apply(pixels, self._bridge, lit, tuple(moving)).reshape(*self.size, 3)


class _Wrapped:
    """A Mitsuba scene with textures as large as the film, differentiated through `dr.wrap`."""

    def __init__(self, size: tuple[int, int], gloss: bool) -> None:
        device.use()
        deferred.register()
        bsdf = scenery.bsdf_dict(flat_maps(2))
        _each(bsdf, "bitmap", {"filter_type": "nearest"})
        if not gloss:
            _each(bsdf, "principled", {"specular": 0.0})
        film = {"type": "hdrfilm", "width": size[1], "height": size[0], "pixel_format": "rgb"}
        film |= {"component_format": "float32", "rfilter": {"type": "box"}}
        self.size = size
        self.scene = mi.load_dict(
            {
                "type": "scene",
                "integrator": {"type": deferred.INTEGRATOR},
                "sensor": {"type": "perspective", "film": film, "sampler": {"type": "independent", "sample_count": 1}},
                "part0": {"type": "rectangle", "bsdf": bsdf},
            }
        )
        self.integrator = self.scene.integrator()
        self.names = scenery.parameters(0)
        self.parameters = mi.traverse(self.scene)
        self.parameters.keep(list(self.names.values()))
        self._render = dr.wrap(source="torch", target="drjit")(self._draw)

    def __call__(self, lit: deferred.Lit, pixels: Any, moving: Sequence[str]) -> Any:
        import torch

        self.integrator.lit = lit
        optimised = {}
        for name, values in zip(CHANNELS, pixels.split(list(CHANNELS.values()), dim=1), strict=True):
            image = values.reshape(*self.size, -1)
            if name == "normal":
                image = image * 0.5 + 0.5
            if name in moving:
                # A new tensor: Dr.Jit reads and writes torch's memory, also beyond its end (core/drjit_arrays.py), and
                # does not recognise nn.Parameter.
                optimised[name] = torch.nn.functional.pad(image.reshape(-1), (0, LANES))[: image.numel()].view_as(image)
            else:
                self.parameters[self.names[name]] = mi.TensorXf(aligned(image.detach().numpy()))
        if not optimised:
            return self._still()
        # Dr.Jit's wrapper enables gradients of every float argument, so only optimised maps are arguments.
        return self._render(optimised).clone()

    def _draw(self, moving: dict[str, Any]) -> Any:
        for name, values in moving.items():
            self.parameters[self.names[name]] = mi.TensorXf(values)
        self.parameters.update()
        return mi.render(self.scene, self.parameters, spp=1, seed=mi.UInt32(0))

    def _still(self) -> Any:
        import torch

        self.parameters.update()
        return torch.from_numpy(np.array(mi.render(self.scene, spp=1, seed=mi.UInt32(0))))


def bilinear(maps: Float[np.ndarray, "t c"], where: Taps) -> Float[np.ndarray, "n c"]:
    """`fetch` without gradient, from the whole table."""
    return where.matrix @ maps[where.texels]


def _each(description: Any, plugin: str, changes: Mapping[str, Any]) -> None:
    """Change every plugin of one type inside a nested scene description."""
    if isinstance(description, dict):
        if description.get("type") == plugin:
            description.update(changes)
        for value in description.values():
            _each(value, plugin, changes)


def _functions() -> dict[str, Any]:
    """torch's Functions for `matrix @ values` and for the frozen split; built at the first use, because importing torch
    takes seconds."""
    if not _cached:
        import torch

        class SparseProduct(torch.autograd.Function):
            @staticmethod
            def forward(ctx: Any, values: Any, matrix: Any) -> Any:
                ctx.matrix = matrix
                return torch.from_numpy(matrix @ values.detach().numpy())

            @staticmethod
            def backward(ctx: Any, *grads: Any) -> Any:
                return torch.from_numpy(ctx.matrix.T @ grads[0].numpy()), None

        class Shaded(torch.autograd.Function):
            @staticmethod
            def forward(ctx: Any, packed: Any, split: Any, lit: Any, moving: Any) -> Any:
                ctx.arguments = split, lit, packed.detach().numpy(), moving
                return torch.from_numpy(split.image(lit, ctx.arguments[2]))

            @staticmethod
            def backward(ctx: Any, *grads: Any) -> Any:
                split, lit, packed, moving = ctx.arguments
                gradient = split.pull(lit, packed, grads[0].contiguous().numpy(), moving)
                return torch.from_numpy(gradient), None, None, None

        _cached.update(sparse=SparseProduct, shaded=Shaded)
    return _cached


_cached: dict[str, Any] = {}
