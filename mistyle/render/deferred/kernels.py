"""The kernels of `render/deferred/renderer.py`: pure functions of Dr.Jit arrays without ray tracing or host syncs.

Every function can be frozen. Array sizes are constants of a recording, so there is one recording per size. `textures`
is (table, steps to the right, steps down), `terms` a `bsdf.terms` with its model and options, `lights` the colours of
the delta lights and the soft light, or None.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from mistyle.core.drjit_arrays import aligned
from mistyle.render.deferred.image_samples import Pixels, Samples, Transpose
from mistyle.render.deferred.material_table import (
    ALBEDO,
    COLUMNS,
    FETCHED_METALLIC,
    FETCHED_ROUGHNESS,
    LEAST_Z,
    METALLIC,
    NORMAL,
    ROUGHNESS,
    TILT_X,
    TILT_Y,
)
from mistyle.render.deferred.sky import VARIANTS, Sky
from mistyle.render.mitsuba.device import dr, mi


@dataclass(frozen=True)
class BlockArrays:
    """One block's arrays as the kernels read them; `transpose` is None in blocks without gradients."""

    samples: Samples
    pixels: Pixels
    transpose: Transpose | None
    lights: tuple[Any, Any]


def _fetch(textures: Any, samples: Samples, moved: Sequence[Any] = (0, 0, 0)) -> list[Any]:
    """Interpolated albedo 3, normal 3, roughness, metallic of each sample; `moved` is added to tilt and roughness."""
    table, right, down = textures
    step = mi.UInt32(samples.step)
    right, down = dr.gather(mi.Int32, right, step), dr.gather(mi.Int32, down, step)
    corner = mi.Int32(samples.texel)
    x, y = samples.x, samples.y
    result: list[Any] = [mi.Float(0)] * 8
    for far_y, wy in ((0, 1 - y), (1, y)):
        for far_x, wx in ((0, 1 - x), (1, x)):
            index = corner + (right if far_x else 0) + (down if far_y else 0)
            row = dr.gather(mi.ArrayXf, table, mi.UInt32(index), shape=(8, dr.width(index)))
            x_y = row[TILT_X] + moved[0], row[TILT_Y] + moved[1]
            values = [row[0], row[1], row[2], *x_y, _tilted_z(*x_y), row[ROUGHNESS] + moved[2], row[METALLIC]]
            weight = wx * wy
            result = [dr.fma(weight, value, sum_) for value, sum_ in zip(values, result, strict=True)]
    return result


def _tilted_z(x: Any, y: Any) -> Any:
    return dr.sqrt(dr.maximum(1 - dr.fma(x, x, y * y), LEAST_Z**2))


def _delta_light(terms: Callable, values: list[Any], samples: Samples, colours: tuple) -> tuple[Any, Any]:
    """Albedo-linear and constant term of all delta lights: the radiance is albedo · linear + constant."""
    linear, constant = mi.Color3f(0), mi.Color3f(0)
    for wo, strength, colour in zip(samples.wo, samples.strength, colours, strict=True):
        p, g = terms(samples.wi, wo, mi.Vector3f(*values[NORMAL]), values[FETCHED_ROUGHNESS], values[FETCHED_METALLIC])
        light = colour * strength
        linear += light * p
        constant += light * g
    return linear, constant


def _colour(terms: Callable, values: list[Any], samples: Samples, lights: tuple) -> Any:
    """Radiance of each sample towards the camera; differentiable only without soft light."""
    linear, constant = _delta_light(terms, values, samples, lights[0])
    if lights[1] is not None:
        soft = soft_light(terms, values, samples, lights[1])
        linear, constant = linear + soft[0], constant + soft[1]
    return mi.Color3f(*values[ALBEDO]) * linear + constant


def image(terms, subsamples: int, textures, samples, pixels, lights) -> Any:
    """Packets (r, g, b, 0) of the lit pixels."""
    rgb = _resolve(_colour(terms, _fetch(textures, samples), samples, lights), pixels, subsamples)
    return dr.ravel(mi.Vector4f(rgb.x, rgb.y, rgb.z, 0))


def slopes(terms, subsamples: int, textures, samples, pixels, lights) -> tuple[Any, ...]:
    """Packets (r, g, b, 0) of the lit pixels under delta lights, and of their derivatives by a change that all texels
    share: of each channel by its own albedo, of all by both tilts and roughness. By forward mode: where reflectance is
    discontinuous they are those of its branch."""
    values = _fetch(textures, samples)
    linear, constant = _delta_light(terms, values, samples, lights[0])
    results = [mi.Color3f(*values[ALBEDO]) * linear + constant, linear]
    for k in range(3):
        moved = [mi.Float(0), mi.Float(0), mi.Float(0)]
        dr.enable_grad(moved[k])
        colour = _colour(terms, _fetch(textures, samples, moved), samples, (lights[0], None))
        dr.forward(moved[k])
        results.append(dr.grad(colour))
    means = (_resolve(colour, pixels, subsamples) for colour in results)
    return tuple(dr.ravel(mi.Vector4f(c.x, c.y, c.z, 0)) for c in means)


def _resolve(colour: Any, pixels: Pixels, subsamples: int) -> Any:
    """Mean over the samples of a pixel, in their order; samples that are not stored are black."""
    if subsamples == 1:
        return colour
    packed = dr.ravel(mi.Vector4f(colour.x, colour.y, colour.z, 0))
    total = mi.Vector4f(0)
    for k in range(subsamples):
        total += dr.gather(mi.Vector4f, packed, pixels.first + k, active=k < pixels.count)
    return mi.Color3f(total.x, total.y, total.z) / subsamples


def step(terms, subsamples, loss, textures, block: BlockArrays, goal) -> Any:
    """Loss over a block, and its rows of the gradient; `goal` is (packets of reference and weight, their factor)."""
    samples, pixels, lights = block.samples, block.pixels, block.lights
    values, (target, scale) = _fetch(textures, samples), goal
    packet = dr.gather(mi.Vector4f, target, dr.arange(mi.UInt32, dr.width(pixels.index)))
    reference, weight = mi.Color3f(packet.x, packet.y, packet.z), packet.w * scale
    if subsamples == 1 and lights[1] is None:
        dr.enable_grad(values)
        lost = LOSSES[loss](_colour(terms, values, samples, lights), reference) * weight
        dr.backward(lost)
        packed = dr.ravel(mi.ArrayXf(dr.grad(values)))
    else:
        image = _resolve(_colour(terms, values, samples, lights), pixels, subsamples)
        dr.enable_grad(image)
        lost = LOSSES[loss](image, reference) * weight
        dr.backward(lost)
        adjoint = dr.grad(image) / subsamples
        packed = dr.ravel(mi.Vector4f(adjoint.x, adjoint.y, adjoint.z, 0))
        packed = _derivatives(terms, textures, samples, lights, dr.gather(mi.Vector4f, packed, samples.slot))
    lost = dr.detach(lost)
    # Both at once: one kernel that shades each sample once.
    dr.eval(lost, packed)
    return dr.sum(lost), _to_texels(textures[0], packed, block.transpose)


def pull(terms, subsamples, textures, block: BlockArrays, adjoint) -> Any:
    """A block's rows of the gradient of a loss whose derivative by the picture is `adjoint`."""
    pixel = dr.gather(mi.UInt32, block.pixels.index, block.samples.slot)
    at = dr.gather(mi.Vector3f, adjoint, pixel) / subsamples
    derivatives = _derivatives(terms, textures, block.samples, block.lights, at)
    return _to_texels(textures[0], derivatives, block.transpose)


def _derivatives(terms, textures, samples, lights, adjoint) -> Any:
    """Gradient of Σ adjoint · colour by the eight fetched values of each sample, in packets."""
    values = _fetch(textures, samples)
    derivatives: list[Any] = [mi.Float(0)] * 8
    if lights[0]:
        dr.enable_grad(values)
        linear, constant = _delta_light(terms, values, samples, lights[0])
        colour = mi.Color3f(*values[ALBEDO]) * linear + constant
        dr.backward(colour.x * adjoint.x + colour.y * adjoint.y + colour.z * adjoint.z)
        derivatives = dr.grad(values)
    if lights[1] is not None:
        more = _soft_derivatives(terms, dr.detach(values), samples, lights[1], adjoint)
        derivatives = [a + b for a, b in zip(derivatives, more, strict=True)]
    return dr.ravel(mi.ArrayXf(derivatives))


def _to_texels(table, packed, transpose) -> Any:
    """Per texel, the sum of weight · derivative over the samples that read it; then from (x, y, z) to the tilt."""
    width = dr.width(transpose.texel)
    total = dr.zeros(mi.ArrayXf, (8, width))

    def add(k, total):
        weight, sample = dr.gather(mi.Float, transpose.weight, k), dr.gather(mi.UInt32, transpose.sample, k)
        return k + 1, dr.fma(weight, dr.gather(mi.ArrayXf, packed, sample, shape=(8, width)), total)

    _, total = dr.while_loop((mi.UInt32(transpose.begin), total), lambda k, total: k < transpose.end, add)
    x, y = (dr.gather(mi.Float, table, transpose.texel * COLUMNS + c) for c in (TILT_X, TILT_Y))
    z = _tilted_z(x, y)
    lean = dr.select(z > LEAST_Z, total[5] / z, 0)
    rows = [total[0], total[1], total[2], total[3] - lean * x, total[4] - lean * y, total[6], total[7], mi.Float(0)]
    return dr.ravel(mi.ArrayXf(rows))


def add_rows(gradient: Any, rows: Any, transpose: Transpose) -> None:
    """Not frozen: a frozen function would copy the gradient, since the caller holds it too."""
    width = dr.width(transpose.texel)
    values = dr.gather(mi.ArrayXf, rows, dr.arange(mi.UInt32, width), shape=(8, width))
    used = transpose.begin < transpose.end
    dr.scatter_add(gradient, values, transpose.texel, active=used, mode=dr.ReduceMode.NoConflicts)


def _log_srgb(x: Any) -> Any:
    x = dr.log(1 + dr.maximum(x, 0))
    dark = x <= 0.0031308
    return dr.select(dark, 12.92 * x, 1.055 * dr.power(dr.select(dark, 1, x), 1 / 2.4) - 0.055)


LOSSES: dict[str, Callable[[Any, Any], Any]] = {
    "l2": lambda image, reference: dr.sum(dr.square(image - reference)),
    "log_srgb_l1": lambda image, reference: dr.sum(dr.abs(_log_srgb(image) - _log_srgb(reference))),
}


# Directions per sample about the mirror direction, in addition to the sky's cells, and the lobe's least GGX alpha.
LOBE_DIRECTIONS = 16
LEAST_ALPHA = 0.01


def upload(sky: Sky) -> tuple[Any, ...]:
    """A sky as Dr.Jit arrays: packets (direction 3, energy 3, solid angle, 0) of the cells' parts; packets (radiance 3,
    solid angle of the cell) of the map's pixels, and their cells; the numbers of cells and rows."""
    angle = np.broadcast_to(sky.angle[:, None, None], (*sky.direction.shape[:2], 1))
    cells = np.concatenate([sky.direction, sky.energy, angle, np.zeros_like(angle)], axis=-1)
    pixels = np.concatenate([sky.radiance, sky.angle[sky.cell][..., None]], axis=-1)
    arrays = [mi.Float(aligned(a).ravel()) for a in (cells, pixels)]
    cell = mi.UInt32(aligned(sky.cell, np.uint32).ravel())
    dr.make_opaque(arrays, cell)
    return *arrays, cell, len(sky.angle), len(sky.cell)


def soft_light(terms: Callable, values: list[Any], samples: Samples, sky: tuple) -> tuple[Any, Any]:
    """(linear, constant) of the sky: its visible cells, and a GGX lobe of the sample's own normal and roughness.

    Both strategies cover all of the light; the balance heuristic combines them, with a cell's density 1 / solid angle.
    The lobe takes radiance from the map and visibility from the cell of the direction.
    """

    def add(total, wo, light):
        p, g = terms(samples.wi, wo, mi.Vector3f(*values[NORMAL]), values[FETCHED_ROUGHNESS], values[FETCHED_METALLIC])
        return [total[0] + light * p, total[1] + light * g]

    linear, constant = _over_sky(values, samples, sky, [mi.Color3f(0), mi.Color3f(0)], add)
    return linear, constant


def _soft_derivatives(terms, values: list[Any], samples: Samples, sky: tuple, adjoint: Any) -> list[Any]:
    """Gradient of Σ adjoint · colour by the fetched values, with fixed directions."""
    albedo = mi.Color3f(*values[ALBEDO])

    def add(total, wo, light):
        at = mi.Color3f(adjoint.x, adjoint.y, adjoint.z) * light
        moving = [mi.Float(v) for v in values[3:]]
        dr.enable_grad(moving)
        p, g = terms(samples.wi, wo, mi.Vector3f(*moving[:3]), moving[3], moving[4])
        dr.backward(p * dr.sum(at * albedo) + g * dr.sum(at))
        by_albedo = at * dr.detach(p)
        return [t + d for t, d in zip(total, [*by_albedo, *dr.grad(moving)], strict=True)]

    return _over_sky(values, samples, sky, [mi.Float(0)] * 8, add)


def _over_sky(values: list[Any], samples: Samples, sky: tuple, total: list[Any], add: Callable) -> list[Any]:
    """`add(total, wo, light)` for every direction of incident light; light is zero where it is hidden."""
    cells, pixels, cell_of, count, rows = sky
    n = dr.width(samples.wi)
    s, t, up = samples.frame  # pyright: ignore[reportGeneralTypeIssues]
    lane, variant = dr.arange(mi.UInt32, n), mi.UInt32(samples.variant)
    lobe = _Lobe(values, samples)

    def seen(cell):
        word = dr.gather(mi.UInt32, samples.visible, (cell >> 5) * n + lane)
        return ((word >> (cell & 31)) & 1) != 0

    def cell(k, total):
        row = dr.gather(mi.ArrayXf, cells, k * VARIANTS + variant, shape=(8, n))
        world = mi.Vector3f(row[0], row[1], row[2])
        wo = mi.Vector3f(dr.dot(s, world), dr.dot(t, world), dr.dot(up, world))
        share = dr.rcp(1 + row[6] * LOBE_DIRECTIONS * lobe.density(wo))
        return k + 1, add(total, wo, mi.Color3f(row[3], row[4], row[5]) * dr.select(seen(k) & (wo.z > 0), share, 0))

    def glossy(k, total):
        wo, density = lobe.direction(k)
        world = s * wo.x + t * wo.y + up * wo.z
        pixel = _pixel(world, rows)
        light = dr.gather(mi.Vector4f, pixels, pixel)
        share = dr.rcp(dr.rcp(light.w) + LOBE_DIRECTIONS * density)
        active = seen(dr.gather(mi.UInt32, cell_of, pixel)) & (wo.z > 0) & (density > 0)
        return k + 1, add(total, wo, mi.Color3f(light.x, light.y, light.z) * dr.select(active, share, 0))

    for body, number in ((cell, count), (glossy, LOBE_DIRECTIONS)):
        _, total = dr.while_loop((mi.UInt32(0), total), lambda k, _, last=number: k < last, body)
    return total


class _Lobe:
    """GGX's visible normals about the mapped normal at fixed points; everything in the tangent frame, detached."""

    def __init__(self, values: list[Any], samples: Samples) -> None:
        self.normal = dr.normalize(mi.Vector3f(*values[NORMAL]))
        self.alpha = dr.maximum(dr.square(values[FETCHED_ROUGHNESS]), LEAST_ALPHA)
        wi = self.wi = samples.wi
        self.variant = mi.Float(samples.variant)
        cosine = dr.clip(dr.dot(wi, self.normal), 1e-3, 1)
        side = wi - self.normal * dr.dot(wi, self.normal)
        # At normal incidence any azimuth will do.
        tangent = mi.Vector3f(1, 0, 0) - self.normal * self.normal.x
        self.x = dr.normalize(dr.select(dr.squared_norm(side) > 1e-8, side, tangent))
        self.y = dr.cross(self.normal, self.x)
        self.cosine, self.sine = cosine, dr.sqrt(dr.maximum(1 - cosine * cosine, 0))

    def density(self, wo: Any) -> Any:
        """Per solid angle of wo: D(h) G1(wi) / (4 cos θ_i)."""
        half = dr.normalize(self.wi + wo)
        c2, a2 = dr.square(dr.dot(half, self.normal)), dr.square(self.alpha)
        spread = a2 / (dr.pi * dr.square(dr.fma(c2, a2 - 1, 1)))
        root = dr.sqrt(dr.fma(a2, dr.square(self.sine), dr.square(self.cosine)))
        return spread / (2 * (self.cosine + root))

    def direction(self, k: Any) -> tuple[Any, Any]:
        """The k-th of LOBE_DIRECTIONS fixed directions and its density (Dupuy and Benyoub 2023, spherical caps)."""
        v = dr.normalize(mi.Vector3f(self.alpha * self.sine, 0, self.cosine))
        along = (mi.Float(k) + (self.variant + 0.5) / VARIANTS) / LOBE_DIRECTIONS
        z = dr.fma(1 - along, 1 + v.z, -v.z)
        turn = (mi.Float(k) * VARIANTS + self.variant * 7) * float(np.pi * (3 - np.sqrt(5)))
        sine = dr.sqrt(dr.maximum(1 - z * z, 0))
        sin, cos = dr.sincos(turn)
        half = dr.normalize(
            mi.Vector3f(self.alpha * dr.fma(sine, cos, v.x), self.alpha * sine * sin, dr.maximum(z + v.z, 1e-6))
        )
        half = self.x * half.x + self.y * half.y + self.normal * half.z
        wo = 2 * dr.dot(self.wi, half) * half - self.wi
        return wo, dr.select(dr.dot(wo, self.normal) > 0, self.density(wo), 0)


def _pixel(world: Any, rows: int) -> Any:
    """Radiance of the sky's map (`render/deferred/sky.py`) in the direction `world`."""
    row = dr.acos(dr.clip(world.y, -1, 1)) * (rows / dr.pi)
    turn = dr.atan2(world.x, -world.z) * (rows / dr.pi)
    column = dr.select(turn < 0, turn + 2 * rows, turn)
    row, column = dr.minimum(mi.UInt32(row), rows - 1), dr.minimum(mi.UInt32(column), 2 * rows - 1)
    return row * (2 * rows) + column
