"""Frozen forward and adjoint kernels around torch's loss, over the pixels of a lit film.

Dr.Jit replays a recorded function several times faster than it traces it, but no gradient flows through a replay. The
computation is therefore split at the picture. A frozen forward renders it, torch gives the loss and dL/dI, and a frozen
backward turns dL/dI into gradients of each pixel's own material. The reflectance is the closed form of
`render/deferred/bsdf.py`, as in `render/deferred/renderer.py`; the sum over lights is that of `integrator.py`, its
reference implementation.

Materials are packed, 8 floats a pixel: albedo 3 (linear), normal 3 (tangent space, any length), roughness, metallic.
"""

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import numpy as np
from jaxtyping import Float

from mistyle.render.deferred import bsdf
from mistyle.render.deferred import integrator as deferred
from mistyle.render.deferred.image_samples import own
from mistyle.render.deferred.material_table import ALBEDO, FETCHED_METALLIC, FETCHED_ROUGHNESS, NORMAL
from mistyle.render.mitsuba import device
from mistyle.render.mitsuba.device import dr, mi

COLUMNS = {
    "albedo": ALBEDO,
    "normal": NORMAL,
    "roughness": slice(FETCHED_ROUGHNESS, FETCHED_ROUGHNESS + 1),
    "metallic": slice(FETCHED_METALLIC, FETCHED_METALLIC + 1),
}


class Split:
    """Pictures of lit films and their gradients; one recording per kind of light and per set of optimised maps.

    `gloss` False omits the specular reflection. One object is for one thread.
    """

    def __init__(self, *, gloss: bool = True) -> None:
        device.use()
        self._terms = partial(bsdf.terms, bsdf.Reflectance("principled", specular=0.5 if gloss else 0.0))
        self._frozen: dict[Any, device.Frozen] = {}

    def image(self, lit: deferred.Lit, materials: Float[np.ndarray, "n 8"]) -> Float[np.ndarray, "n 3"]:
        """Linear radiance of the film's pixels in order."""
        run = self._function("image", lit, _image)
        return np.array(run(*_arrays(lit, materials))).reshape(-1, 3)

    def pull(
        self,
        lit: deferred.Lit,
        materials: Float[np.ndarray, "n 8"],
        adjoint: Float[np.ndarray, "n 3"],
        moving: tuple[str, ...],
    ) -> Float[np.ndarray, "n 8"]:
        """Gradient by the materials of a loss whose derivative by the picture is `adjoint`; 0 for maps not `moving`."""
        run = self._function(("pull", moving), lit, _pull, moving)
        return np.array(run(*_arrays(lit, materials), own(mi.Float, adjoint.ravel()))).reshape(-1, 8)

    def _function(self, name: Any, lit: deferred.Lit, function: Callable, *fixed: Any) -> device.Frozen:
        key = (name, lit.size, len(lit.directional), lit.ambient is None)
        if key not in self._frozen:
            terms = self._terms
            self._frozen[key] = device.Frozen(lambda *arguments: function(terms, *fixed, *arguments))
        return self._frozen[key]


def radiance(lit: deferred.Lit, packed: Any) -> Any:
    """`Split.image` traced anew, for Dr.Jit's own gradients: packed materials (8n floats) to radiance (3n floats).

    Both are Dr.Jit arrays, ordered by pixel. Each pixel reads its own material, so the gradient sums nothing.
    """
    return _image(partial(bsdf.terms, bsdf.Reflectance("principled", specular=0.5)), _film(lit), packed)


def _arrays(lit: deferred.Lit, materials: Float[np.ndarray, "n 8"]) -> tuple[Any, ...]:
    return _film(lit), own(mi.Float, np.ascontiguousarray(materials, np.float32).ravel())


def _film(lit: deferred.Lit) -> tuple[Any, Any, Any, Any]:
    """(wi, mask, directional lights, ambient light) of a lit film."""
    # Opaque, since a literal would be a constant of the recording.
    ambient = None if lit.ambient is None else mi.Color3f(*(dr.opaque(mi.Float, c) for c in lit.ambient))
    return lit.wi, lit.mask, list(lit.directional), ambient


def _lights(wi: Any, directional: list[Any], ambient: Any) -> Iterator[tuple[Any, Any]]:
    """(direction, irradiance) of every light, ambient light as its fixed directions."""
    yield from directional
    if ambient is not None:
        yield from ((wo, ambient * weight) for wo, weight in deferred.ambient_directions(wi))


def _image(terms: Callable, film: tuple, packed) -> Any:
    """`film` is (wi, mask, directional lights, ambient light), as in `integrator.Lit`."""
    wi, mask, directional, ambient = film
    v = _values(packed, wi)
    linear, constant = mi.Color3f(0), mi.Color3f(0)
    for wo, light in _lights(wi, directional, ambient):
        p, g = terms(wi, wo, mi.Vector3f(*v[NORMAL]), v[FETCHED_ROUGHNESS], v[FETCHED_METALLIC])
        linear, constant = linear + light * p, constant + light * g
    return dr.ravel(dr.select(mask, mi.Color3f(*v[ALBEDO]) * linear + constant, 0))


def _pull(terms: Callable, moving: tuple[str, ...], film: tuple, packed, adjoint) -> Any:
    """Light by light, so that each has its own short gradient; directions are fixed."""
    wi, mask, directional, ambient = film
    v = _values(packed, wi)
    albedo, lane = mi.Color3f(*v[ALBEDO]), dr.arange(mi.UInt32, dr.width(wi))
    at = dr.select(mask, dr.gather(mi.Color3f, adjoint, lane), 0)
    by_albedo, by_rest = mi.Color3f(0), [mi.Float(0)] * 5
    for wo, light in _lights(wi, directional, ambient):
        rest, weighted = [mi.Float(x) for x in v[3:]], at * light
        for name in moving:
            if name != "albedo":
                dr.enable_grad(rest[COLUMNS[name].start - 3 : COLUMNS[name].stop - 3])
        p, g = terms(wi, wo, mi.Vector3f(*rest[:3]), rest[3], rest[4])
        by_albedo += weighted * dr.detach(p)
        value = p * dr.sum(weighted * albedo) + g * dr.sum(weighted)
        if dr.grad_enabled(value):
            dr.backward(value)
            by_rest = [total + dr.grad(x) for total, x in zip(by_rest, rest, strict=True)]
    result = [*(by_albedo if "albedo" in moving else mi.Color3f(0)), *by_rest]
    width = dr.width(wi)
    return dr.ravel(mi.ArrayXf([x + dr.zeros(mi.Float, width) for x in result]))


def _values(packed: Any, wi: Any) -> list[Any]:
    lane = dr.arange(mi.UInt32, dr.width(wi))
    row = dr.gather(mi.ArrayXf, packed, lane, shape=(8, dr.width(wi)))
    return [row[k] for k in range(8)]
