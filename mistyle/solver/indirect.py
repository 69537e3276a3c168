"""Indirect light by path tracing: radiance that reaches the camera over more than one surface point.

The solver fits direct light only, so this radiance is subtracted from the pictures. Paths begin at the pixels and
sample the reflectance; from the second point on, every vertex samples the lights. Path throughput does not depend on
the lights, so pictures of one camera under several lights share their paths, which are most of the cost. Incident light
is smooth along the surface, so few samples suffice: they are divided by the albedo, averaged over pixels of the same
surface, and multiplied again (Dammertz et al. 2010).
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from mistyle.core.camera import Camera, binned
from mistyle.core.image import gaussian, nearest_fill, resize
from mistyle.core.light import Lights
from mistyle.core.maps import Maps
from mistyle.core.mesh import Mesh
from mistyle.render.mitsuba import device
from mistyle.render.mitsuba import scene as scenery
from mistyle.render.mitsuba.device import dr, mi
from mistyle.render.mitsuba.emitters import emitters

MOST = 512  # pixels along the longer side of the estimate at most; smaller pictures keep their size
TOGETHER = 6  # pictures of one camera that share their paths; larger batches make the kernel long
ROUGH = 0.25  # least roughness past the first point: mirror paths are few bright samples
DEPTH = 5  # path segments: up to four surface points
ALIKE = 0.15  # bilateral scale of the difference of two unit normals
LEVEL = 0.7  # bilateral scale of the distance from the tangent plane, in pixel widths on the surface
PALE = 0.04  # added to the albedo before division: specular reflectance, which has no colour
LIKE = 8  # pixels: Gaussian window of the comparison between estimate and picture
BRIGHTER = 2.0  # largest scale factor of that comparison
GRAZING = 0.1  # cosine below which the vector irradiance is attenuated: grazing paths are few with large weights
FIREFLY = 20.0  # largest ratio of a pixel of the estimate to its surroundings


class Indirect:
    """Indirect light of pictures of one object. Constructing another instance replaces this one's maps."""

    def __init__(
        self, mesh: Mesh, maps: Sequence[Maps], *, model: scenery.Model = "principled", frame: scenery.Frame = "mikkt"
    ) -> None:
        device.use()
        matt = [replace(m, roughness=np.maximum(m.roughness, np.float32(ROUGH))) for m in maps]
        shapes = scenery.object_shapes(mesh, matt, model=model, frame=frame)
        self.scene = mi.load_dict({"type": "scene", **shapes}, optimize=False)
        sharp = {f"part{p}": scenery.bsdf_dict(m, model=model, frame=frame) for p, m in enumerate(maps)}
        self.sharp = [(shape, mi.load_dict(sharp[name])) for name, shape in shapes.items()]

    def pictures(
        self, camera: Camera, many: Sequence[Lights], samples: int, seed: int, *, vectors: bool = False
    ) -> list[tuple[Float[np.ndarray, "h w 3"], Float[np.ndarray, "h w 9"] | None]]:
        """Indirect radiance, linear Rec.709, in pictures of at most MOST pixels a side, under each of `many` lights.
        With `vectors` also the vector irradiance E of indirect light at the first surface point: (9,) per pixel, world
        x, y, z of red, then of green and blue; else None.

        Pixels beside the object have the value of the nearest pixel on it. `samples` are per pixel of the estimate. A
        diffuse surface of normal n and reflectance a has the radiance a / π E · n while n stays near the mapped
        normal. E excludes light from below the mapped normal's horizon and attenuates grazing light (GRAZING).
        Raises ValueError for lights of a scene file.
        """
        pairs = []
        for k in range(0, len(many), TOGETHER):
            pairs += self._pictures(camera, many[k : k + TOGETHER], samples, seed, vectors)
        return pairs

    def _pictures(
        self, camera: Camera, many: Sequence[Lights], samples: int, seed: int, vectors: bool
    ) -> list[tuple[Any, Any]]:
        by = -(-max(camera.size) // MOST)
        # Partial pixels at the picture's border belong to the estimate.
        small = replace(binned(camera, by), size=(-(-camera.size[0] // by), -(-camera.size[1] // by)))
        lit = [[mi.load_dict(light) for light in emitters(lights, camera)] for lights in many]
        for emitter in (e for own in lit for e in own):
            emitter.set_scene(self.scene)
        times, each = scenery.passes(samples)
        sensor = mi.load_dict(scenery.sensor_dict(small, each))
        options = (self.scene, self.sharp, sensor, lit, each)
        passes = [_trace_paths(*options, seed + k * 7919, vectors) for k in range(times)]
        whole = np.mean(passes, axis=0)
        share = whole[..., 0]
        inside = np.isfinite(whole).all(axis=-1) & (share > 0)
        if not inside.any():
            return [(np.zeros((*small.size, 3), np.float32), np.zeros((*small.size, 9), np.float32)) for _ in many]
        covered = np.where(inside, np.maximum(share, 0.05), 1)[..., None]
        position, normal, albedo, *light = (whole[..., k : k + 3] / covered for k in range(1, whole.shape[-1], 3))
        albedo = np.maximum(np.nan_to_num(albedo), 0) + PALE
        unit = np.linalg.norm(position - camera.position.astype(np.float32), axis=-1) / small.focal

        def smooth(light: np.ndarray) -> np.ndarray:
            irradiance = np.where(inside[..., None], light, 0) / albedo
            radiance = averaged(irradiance.astype(np.float32), position, normal, unit, inside) * albedo
            return nearest_fill(np.ascontiguousarray(radiance, np.float32), inside)

        def smooth_vector(axes: Sequence[np.ndarray]) -> np.ndarray:
            shown = [np.where(inside[..., None], axis, 0).astype(np.float32) for axis in axes]
            mean = [averaged(axis, position, normal, unit, inside, most=np.inf) for axis in shown]
            return nearest_fill(np.stack(mean, axis=-1).reshape(*small.size, 9), inside)

        count = len(many)
        arriving = [smooth_vector(light[k : k + 3]) for k in range(count, len(light), 3)] or [None] * count
        return list(zip(map(smooth, light[:count]), arriving, strict=True))


def _trace_paths(
    scene: Any,
    sharp: Sequence[tuple[Any, Any]],
    sensor: Any,
    lit: Sequence[Sequence[Any]],
    each: int,
    seed: int,
    vectors: bool,
) -> np.ndarray:
    """(h, w, 10 + 3 n) float32, means of `each` samples a pixel: coverage, then position, shading normal and diffuse
    albedo of the first surface point, then indirect radiance under each of n = len(lit) sets of emitters. With
    `vectors`, 9 n more: world x, y, z of each set's vector irradiance. `sharp`: each shape's reflectance at the first
    point."""
    sampler, pixel, ray = _camera_samples(sensor, each, seed)
    context = mi.BSDFContext()
    first = scene.ray_intersect(ray)
    seen, surface = first.is_valid(), first.bsdf()
    for shape, reflectance in sharp:
        surface = dr.select(first.shape == mi.ShapePtr(shape), mi.BSDFPtr(reflectance), surface)

    def onward(si: Any, surface: Any, through: Any, active: Any, sampler: Any) -> tuple[Any, ...]:
        """The next ray, its throughput, density, origin, and whether the path continues."""
        sample, weight = surface.sample(context, si, sampler.next_1d(active), sampler.next_2d(active), active)
        through = dr.select(active, through * weight, 0)
        ray = si.spawn_ray(si.to_world(sample.wo))
        return ray, through, mi.Float(sample.pdf), mi.Interaction3f(si), active & (dr.max(through) > 0)

    def body(*state: Any) -> tuple[Any, ...]:
        k, ray, through, density, last, active, sampler, *sums = state
        si = scene.ray_intersect(ray, active)
        # A ray that escapes from the first point carries direct light. The last segment only tests for escape.
        escaped, hit = active & ~si.is_valid() & (k > 0), active & si.is_valid() & (k < points)
        segment = PathSegment(ray, si, last, density, escaped, hit)
        arriving = (sum((_emitter_radiance(scene, e, segment, sampler) for e in own), mi.Color3f(0)) for own in lit)
        more = (total + through * light for total, light in zip(sums, arriving, strict=True))
        return k + 1, *onward(si, si.bsdf(), through, hit, sampler), sampler, *more

    points, soft = DEPTH - 2, any(emitter.is_environment() for own in lit for emitter in own)
    start = (
        mi.UInt32(0),
        *onward(first, surface, mi.Color3f(1), seen, sampler),
        sampler,
        *(mi.Color3f(0) for _ in lit),
    )
    ended = dr.while_loop(start, lambda k, *rest: rest[4] & (k < points + soft), body, label="indirect")
    albedo = first.bsdf().eval_diffuse_reflectance(first, seen)
    values = [mi.Float(1)]
    arriving = _vector_irradiance(first, start[1:4], ended[7:]) if vectors else []
    for vector in (first.p, first.sh_frame.n, albedo, *ended[7:], *arriving):
        values += [vector.x, vector.y, vector.z]
    width, height = (int(n) for n in sensor.film().size())
    return _pixels(values, pixel, seen, width * height, each).reshape(height, width, -1)


def _camera_samples(sensor: Any, each: int, seed: int) -> tuple[Any, Any, Any]:
    """The seeded sampler, and pixel and ray of each of `each` samples a pixel."""
    width, height = (int(n) for n in sensor.film().size())
    count = width * height * each
    sampler = sensor.sampler()
    sampler.set_samples_per_wavefront(each)
    sampler.seed(seed, count)
    pixel = dr.arange(mi.UInt32, count) // each
    row = pixel // width
    place = mi.Point2f(mi.Float(pixel - row * width), mi.Float(row)) + sampler.next_2d()
    ray, _ = sensor.sample_ray(0.0, 0.0, place / mi.Point2f(width, height), mi.Point2f(0.5))
    return sampler, pixel, ray


def _vector_irradiance(first: Any, begin: Sequence[Any], totals: Sequence[Any]) -> list[Any]:
    """x, y and z of the vector irradiance at the points `first`, under each set of emitters.

    `begin` is the first ray, its throughput and its density; `totals` are radiance · reflectance · cosine / density.
    """
    ray, reflected, density = begin
    cosine = dr.abs(dr.dot(ray.d, first.sh_frame.n))
    share = dr.minimum(1, cosine / GRAZING) / dr.maximum(density, 1e-9)
    vectors = []
    for total in totals:
        radiance = dr.select(first.is_valid() & (reflected > 1e-6), total / reflected, 0) * share
        vectors += [radiance * ray.d.x, radiance * ray.d.y, radiance * ray.d.z]
    return vectors


def _pixels(values: Sequence[Any], pixel: Any, seen: Any, count: int, each: int) -> np.ndarray:
    """(count, n) float32: means over each pixel's `each` samples of n values; 0 where not `seen`."""
    sums = [dr.zeros(type(values[0]), count) for _ in values]
    for total, value in zip(sums, values, strict=True):
        dr.scatter_add(total, value / each, pixel, seen)
    dr.eval(sums)
    return np.stack([np.array(total) for total in sums], axis=-1)


class PathSegment(NamedTuple):
    """A ray that left the surface point `last` with a density, and either `hit` a point `si` or `escaped`."""

    ray: Any
    si: Any
    last: Any
    density: Any
    escaped: Any
    hit: Any


def _emitter_radiance(scene: Any, emitter: Any, segment: PathSegment, sampler: Any) -> Any:
    """Radiance of one emitter along the ray: reflected at the surface point `si`, or directly where the ray escaped.

    Environment light uses both sampling strategies, weighted by the power heuristic (Veach and Guibas 1995).
    """
    ray, si, last, density, escaped, hit = segment
    soft = emitter.is_environment()
    place = sampler.next_2d(hit) if soft else mi.Point2f(0.5)
    towards, power = emitter.sample_direction(si, place, hit)
    free = hit & (towards.pdf > 0)
    free &= ~scene.ray_test(si.spawn_ray_to(towards.p), free)
    reflected, bsdf_pdf = si.bsdf().eval_pdf(mi.BSDFContext(), si, si.to_local(towards.d), free)
    if not soft:
        return dr.select(free, reflected * power, 0)
    along = dr.zeros(mi.DirectionSample3f)
    along.d = ray.d
    past = emitter.eval(si, escaped) * _heuristic(density, emitter.pdf_direction(last, along, escaped))
    return dr.select(free, reflected * power * _heuristic(towards.pdf, bsdf_pdf), 0) + dr.select(escaped, past, 0)


def _heuristic(own: Any, other: Any) -> Any:
    return own**2 / (own**2 + other**2)


def enlarged(light: Float[np.ndarray, "h w c"], size: tuple[int, int]) -> Float[np.ndarray, "H W c"]:
    """An estimate of `Indirect.pictures`, upsampled to the picture's size."""
    by = max(-(-whole // part) for whole, part in zip(size, light.shape, strict=False))
    return resize(light, (light.shape[0] * by, light.shape[1] * by))[: size[0], : size[1]]


def in_proportion(
    light: Float[np.ndarray, "h w 3"], direct: Float[np.ndarray, "H W 3"], picture: Float[np.ndarray, "H W 3"]
) -> Float[np.ndarray, "h w 3"]:
    """An estimate scaled so that direct plus indirect light matches the picture's local brightness.

    `direct` is rendered from the same maps. Maps that were fitted before this light was subtracted are too bright, and
    interreflection doubles that error: unscaled, concave places would lose it nearly twice. Where direct light and
    estimate are black, the estimate stays unchanged.
    """
    size = light.shape[0], light.shape[1]
    shown = resize(direct, size)
    rendered = gaussian(shown + np.where(shown > 0, light, 0), LIKE)
    observed = gaussian(np.where(shown > 0, resize(picture, size), 0), LIKE)
    return light * np.where(rendered > 1e-9, np.clip(observed / np.maximum(rendered, 1e-9), 0, BRIGHTER), 1)


def averaged(
    light: Float[np.ndarray, "h w 3"],
    position: Float[np.ndarray, "h w 3"],
    normal: Float[np.ndarray, "h w 3"],
    unit: Float[np.ndarray, "h w"],
    inside: Bool[np.ndarray, "h w"],
    most: float = FIREFLY,
) -> Float[np.ndarray, "h w 3"]:
    """Bilateral mean over 3 x 3 pixels of the same surface; `unit` is a pixel's width on it. A wider window would blur
    more of the light than it removes noise.

    Pixels more than `most` times brighter than their surroundings are clamped first.
    """
    normal = normal / np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-6)
    position, normal = (np.where(inside[..., None], field, 0).astype(np.float32) for field in (position, normal))
    total, weights = _neighbour_sums(light, position, normal, unit, inside)
    if np.isfinite(most):
        brightest = most * (total / np.maximum(weights, 1e-6)[..., None])
        light = np.where(weights[..., None] > 1e-6, np.minimum(light, brightest), light)
    return (light + total) / (1 + weights)[..., None]


def _neighbour_sums(
    light: np.ndarray, position: np.ndarray, normal: np.ndarray, unit: np.ndarray, inside: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Weighted sum and weights of each pixel's eight neighbours."""
    total, weights = np.zeros_like(light), np.zeros(inside.shape, np.float32)
    for dy in (-1, 0, 1):
        for dx in (-1, 0, 1):
            if not (dy or dx):
                continue
            rows, columns = _shifted_slices(inside.shape[0], dy), _shifted_slices(inside.shape[1], dx)
            centre, neighbour = (rows[0], columns[0]), (rows[1], columns[1])
            lift = ((position[neighbour] - position[centre]) * normal[centre]).sum(axis=-1) / (LEVEL * unit[centre])
            turn2 = ((normal[neighbour] - normal[centre]) ** 2).sum(axis=-1)
            likeness = np.exp(-(lift**2) - turn2 / ALIKE**2) * (0.25 if dy and dx else 0.5)
            weight = np.where(inside[centre] & inside[neighbour], likeness, 0)
            total[centre] += weight[..., None] * light[neighbour]
            weights[centre] += weight
    return total, weights


def _shifted_slices(size: int, step: int) -> tuple[slice, slice]:
    """Slices of the rows with a neighbour `step` further on, and of those neighbours."""
    return slice(max(0, -step), size - max(0, step)), slice(max(0, step), size + min(0, step))
