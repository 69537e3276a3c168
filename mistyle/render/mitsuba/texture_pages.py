"""One material for a mesh of many texture sets: their maps are stacked, and each face has a page number.

A renderer compiles every BSDF of a scene, so twenty materials take twenty times as long until the first ray. Here the
mesh is one shape with one BSDF for any number of materials. The pictures are those of `scene.object_shapes` up to
rounding; there are no parameters to optimise.
"""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from mistyle.core.drjit_arrays import LANES, aligned
from mistyle.core.maps import Maps
from mistyle.core.mesh import Mesh
from mistyle.geometry.tangents import corner_tangents
from mistyle.process import memory
from mistyle.render.mitsuba import device, plugins
from mistyle.render.mitsuba import scene as scenery
from mistyle.render.mitsuba.device import dr, mi

PAGE = "face_page"  # face attribute with the page number


def paged_shapes(mesh: Mesh, maps: Sequence[Maps], flip_invalid: bool = False) -> dict[str, Any]:
    """The mesh with all its texture sets as one loaded shape, normal maps in MikkTSpace frames; for pictures only."""
    device.use()
    if len(maps) != len(mesh.parts):
        raise ValueError(
            f"{len(maps)} maps for {len(mesh.parts)} texture sets; expected one for each ({', '.join(mesh.parts)})"
        )
    plugins.register()
    pages = _pages_class()
    slots = {"base_color": "albedo", "roughness": "roughness", "metallic": "metallic"}
    textures = {slot: _texture(pages, [getattr(m, name) for m in maps]) for slot, name in slots.items()}
    bsdf = {"type": "principled", **textures, "specular": 0.5}
    relief = {
        "type": plugins.NORMALMAP,
        "normalmap": _texture(pages, [m.normal for m in maps], scenery.encoded_into),
        "flip_invalid_normals": flip_invalid,
        "bsdf": bsdf,
    }
    loaded = mi.load_dict({"type": "twosided", "bsdf": relief})
    shape = scenery.mitsuba_mesh(mesh, None, loaded, tangents=corner_tangents(mesh))
    shape.add_attribute(PAGE, 1, aligned(mesh.part))
    return {"part0": shape}


def table(values: Sequence[Float[np.ndarray, "_h _w *c"]]) -> tuple[Int[np.ndarray, " p"], Int[np.ndarray, "p 2"]]:
    """Offset, height and width of each map in the table of all their texels."""
    sizes = np.array([v.shape[:2] for v in values], np.int64)
    return np.concatenate([[0], np.cumsum(sizes.prod(axis=1))[:-1]]), sizes


def _texture(
    pages: type,
    values: Sequence[np.ndarray],
    fill: Callable[[np.ndarray, np.ndarray], object] = lambda to, values: np.copyto(to, values),
) -> Any:
    """The texture of one kind of map; `fill(to, values)` writes the values in texture encoding."""
    start, sizes = table(values)
    channels = 1 if values[0].ndim == 2 else values[0].shape[2]
    count = int(sizes.prod(axis=1).sum()) * channels
    texels = memory.empty(-(-count // LANES) * LANES)  # full vectors, since Dr.Jit reads it in place
    texels[count:] = 0
    for first, (height, width), one in zip(start, sizes, values, strict=True):
        page = texels[channels * first : channels * (first + height * width)]
        fill(page.reshape(one.shape), one)
    return pages(mi.Float(texels), *(mi.UInt32(aligned(n, np.uint32)) for n in (start, *sizes.T)), channels)


def _pages_class() -> type:
    """The texture as a class derived from `mi`'s current variant."""

    class Pages(mi.Texture):
        """Bilinear lookups in the page of the hit face; pages repeat."""

        def __init__(self, texels, start, height, width, channels):
            super().__init__(mi.Properties())
            self.texels, self.start, self.height, self.width, self.channels = texels, start, height, width, channels

        def eval(self, si, active=True):
            return mi.Color3f(self._lookup(si, active))

        eval_3 = eval

        def eval_1(self, si, active=True):
            return self._lookup(si, active)

        def mean(self):
            return dr.mean(self.texels)

        def is_spatially_varying(self):
            return True

        def to_string(self):
            return f"Pages[{len(self.start)}]"

        def _lookup(self, si, active):
            page = mi.UInt32(si.shape.eval_attribute_1(PAGE, si, active))
            start = dr.gather(mi.UInt32, self.start, page, active)
            height, width = (dr.gather(mi.UInt32, size, page, active) for size in (self.height, self.width))
            left, right, tx = _neighbours(si.uv.x, width)
            above, below, ty = _neighbours(si.uv.y, height)
            kind = mi.Float if self.channels == 1 else mi.Color3f

            def texel(row, column):
                return dr.gather(kind, self.texels, start + row * width + column, active)

            upper = dr.lerp(texel(above, left), texel(above, right), tx)
            lower = dr.lerp(texel(below, left), texel(below, right), tx)
            return dr.lerp(upper, lower, ty)

    def _neighbours(place, count):
        """The two texels of `count` around a repeating coordinate, and its distance from the first one."""
        at = place * mi.Float(count) - 0.5
        low = dr.floor(at)
        first = mi.Int32(low) - mi.Int32(dr.floor(low / mi.Float(count))) * mi.Int32(count)
        # Rounding of the quotient may exceed the last row by one.
        first = mi.UInt32(dr.clip(first, 0, mi.Int32(count) - 1))
        second = dr.select(first + 1 < count, first + 1, 0)
        return first, second, at - low

    return Pages
