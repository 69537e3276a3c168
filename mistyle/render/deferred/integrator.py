"""A Mitsuba integrator that shades known surface points under known lights, without noise.

Geometry, cameras and lights are fixed while materials are fitted, so rays are traced once (`trace`). Each pixel stores
the BSDF's inputs: the directions to the camera and to each light in its own tangent frame. The integrator
`mistyle_deferred` then sums BSDF times irradiance over all lights exactly, one sample per pixel. Each pixel reads its
own texel of textures as large as the film. The gradient of a texture therefore has one summand per texel, with the same
bytes in every run and at any number of threads.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from mistyle.core.camera import Camera
from mistyle.core.drjit_arrays import aligned
from mistyle.core.light import Ambient, Directional, Lights, Point, direction_in_world, position_in_world
from mistyle.render.mitsuba import device
from mistyle.render.mitsuba.device import dr, mi
from mistyle.render.mitsuba.draw import Tracer

INTEGRATOR = "mistyle_deferred"
# Directions in which ambient light is sampled: half follow the cosine, half a lobe about the mirror direction.
AMBIENT_DIRECTIONS = 16
# GGX alpha of that lobe. Measured against 200,000 samples: roughness 0.3 and more stays within 0.015 of the mean
# radiance of a dielectric, 0.15 within 0.03; a wider lobe misses glossy surfaces, a narrower one rough ones.
LOBE_ALPHA = 0.12

_registered: set[str] = set()


@dataclass(frozen=True)
class Surface:
    """Surface points of the pixels of several equal cameras, camera after camera, row by row (n = cameras · h · w).

    uv is v up (meant modulo 1), part is -1 and facing 0 off the mesh; facing is the cosine between the direction to the
    camera and the shading normal, negative where the surface's back is seen. `frame` and `towards` (Dr.Jit, world) are
    the tangent frame and the direction to the camera; `point` is Mitsuba's surface interaction, for shadow rays.
    """

    cameras: tuple[Camera, ...]
    uv: Float[np.ndarray, "n 2"]
    part: Int[np.ndarray, " n"]
    mask: Bool[np.ndarray, " n"]
    facing: Float[np.ndarray, " n"]
    position: Float[np.ndarray, "n 3"]
    normal: Float[np.ndarray, "n 3"]
    frame: Any
    towards: Any
    point: Any


@dataclass(frozen=True)
class Lit:
    """A film's pixels with their lights, in their tangent frames: the integrator's input.

    `size` is (rows, columns) of the film; `directional` holds (direction, irradiance as seen from the pixel) pairs,
    `ambient` one radiance or None.
    """

    size: tuple[int, int]
    wi: Any
    mask: Any
    directional: tuple[tuple[Any, Any], ...]
    ambient: tuple[float, float, float] | None


def trace(traced: Tracer, cameras: Sequence[Camera], tangents: Float[np.ndarray, "f 3 4"] | None = None) -> Surface:
    """One exact ray through every pixel centre of every camera (all of one size).

    `tangents` (per face corner, xyz and handedness, as MikkTSpace makes them) give the frame of the normal map that
    glTF viewers use. Without them it is Mitsuba's own: dp/du of each face, made perpendicular to the shading normal.
    """
    device.use()
    if len({camera.size for camera in cameras}) != 1:
        raise ValueError(f"found cameras of sizes {sorted({camera.size for camera in cameras})}; expected one size")
    point, frame = intersect(traced, ray := _rays(cameras), tangents)
    valid = point.is_valid()
    towards = -ray.d
    u, v = dr.select(valid, point.uv.x, 0), dr.select(valid, 1 - point.uv.y, 0)
    face = dr.select(valid, mi.Int32(point.prim_index), -1)
    facing = dr.select(valid, dr.dot(frame.n, towards), 0)
    position, normal = point.p & valid, frame.n & valid
    dr.eval(point, frame, towards, u, v, face, facing, position, normal)
    faces = np.array(face)
    return Surface(
        cameras=tuple(cameras),
        uv=np.stack([np.array(u), np.array(v)], axis=1),
        part=np.where(faces >= 0, traced.mesh.part[np.maximum(faces, 0)], -1).astype(np.int32),
        mask=faces >= 0,
        facing=np.array(facing),
        position=np.ascontiguousarray(np.array(position).T),
        normal=np.ascontiguousarray(np.array(normal).T),
        frame=frame,
        towards=towards,
        point=point,
    )


def intersect(traced: Tracer, ray: Any, tangents: Float[np.ndarray, "f 3 4"] | None) -> tuple[Any, Any]:
    """First hits of rays on the mesh: Mitsuba's surface interaction, and the frame of the normal map (see `trace`)."""
    first = traced.scene.ray_intersect_preliminary(ray, coherent=True)
    point = first.compute_surface_interaction(ray, mi.RayFlags.All)
    if tangents is None:
        return point, point.sh_frame
    return point, tangent_frame(point, first.prim_uv, mi.Float(aligned(tangents).ravel()))


def light(traced: Tracer, surface: Surface, lights: Lights, *, shadows: bool = True) -> Lit:
    """Light that all cameras share: directional and point lights, one shadow ray each (`shadows`), and unoccluded
    ambient light.

    Ambient light has no occlusion, so an albedo fitted under it does not turn bright in cavities. Its radiance is
    summed over AMBIENT_DIRECTIONS fixed directions per pixel. Raises ValueError for other kinds of light.
    """
    beams, ambient = [], np.zeros(3)
    for source in lights:
        if isinstance(source, (Directional, Point)):
            beams.append([source] * len(surface.cameras))
        elif isinstance(source, Ambient):
            ambient += source.radiance
        else:
            raise ValueError(
                f"{type(source).__name__} cannot be summed exactly; expected directional, point or ambient light"
            )
    glow = (float(ambient[0]), float(ambient[1]), float(ambient[2])) if ambient.any() else None
    return light_rows(traced, surface, beams, glow, shadows)


def light_rows(
    traced: Tracer,
    surface: Surface,
    beams: Sequence[Sequence[Directional] | Sequence[Point]],
    ambient: tuple[float, float, float] | None,
    shadows: bool,
) -> Lit:
    """As `light`; `beams` holds rows of one light per camera."""
    height, width = surface.cameras[0].size
    valid = surface.point.is_valid()
    camera_of = dr.arange(mi.UInt32, len(surface.mask)) // (height * width)
    wi = surface.frame.to_local(surface.towards)
    directional = []
    for row in beams:
        world, strength, ray = _beam(surface, row, camera_of)
        seen = mi.Bool(valid)
        if shadows:
            seen &= ~traced.scene.ray_test(ray, active=valid)
        directional.append((surface.frame.to_local(world), dr.select(seen, strength, 0)))
    dr.eval(wi, directional, valid)
    return Lit((height * len(surface.cameras), width), wi, valid, tuple(directional), ambient)


def _beam(surface: Surface, row: Sequence[Directional] | Sequence[Point], camera_of: Any) -> tuple[Any, Any, Any]:
    """For one light per camera: unit directions towards it, irradiance at normal incidence, and shadow rays."""
    both = list(zip(row, surface.cameras, strict=True))
    if isinstance(row[0], Directional):
        towards = [direction_in_world(beam, camera) for beam, camera in both if isinstance(beam, Directional)]
        world = _each(mi.Vector3f, np.stack(towards), camera_of)
        strength = [beam.irradiance for beam in row if isinstance(beam, Directional)]
        return world, _each(mi.Color3f, np.array(strength), camera_of), surface.point.spawn_ray(world)
    places = [position_in_world(point, camera) for point, camera in both if isinstance(point, Point)]
    place = _each(mi.Point3f, np.stack(places), camera_of)
    intensity = _each(mi.Color3f, np.array([point.intensity for point in row if isinstance(point, Point)]), camera_of)
    way = place - surface.point.p
    squared = dr.squared_norm(way)
    return way * dr.rsqrt(squared), intensity / squared, surface.point.spawn_ray_to(place)


def ambient_directions(wi: Any) -> list[tuple[Any, Any]]:
    """Directions and weights with which a constant radiance sums to the light scattered towards `wi` (tangent frame).

    Spherical Fibonacci points: half follow the cosine about the shading normal, half a GGX lobe of LOBE_ALPHA about the
    mirror direction; each weight is one over the combined density (the balance heuristic). They are constant, so the
    sum has an error but no noise.
    """
    side = dr.mulsign(mi.Float(1), wi.z)
    wi = mi.Vector3f(wi.x, wi.y, wi.z * side)
    count = AMBIENT_DIRECTIONS
    lobes, cosines = count // 2, count - count // 2
    golden, a2 = np.pi * (3 - np.sqrt(5)), LOBE_ALPHA**2
    directions = []
    for k in range(cosines):
        radius = np.sqrt((k + 0.5) / cosines)
        x, y = radius * np.cos(golden * k), radius * np.sin(golden * k)
        directions.append(mi.Vector3f(float(x), float(y), float(np.sqrt(1 - radius**2))))
    for k in range(lobes):
        u = (k + 0.5) / lobes
        cosine = np.sqrt((1 - u) / (1 + (a2 - 1) * u))
        sine = np.sqrt(1 - cosine**2)
        half = mi.Vector3f(float(sine * np.cos(golden * k + 1)), float(sine * np.sin(golden * k + 1)), float(cosine))
        directions.append(2 * dr.dot(wi, half) * half - wi)
    result = []
    for wo in directions:
        half = dr.normalize(wi + wo)
        spread = a2 / (dr.pi * dr.square(dr.square(half.z) * (a2 - 1) + 1))
        lobe = spread * half.z / (4 * dr.maximum(dr.dot(wi, half), 1e-4))
        density = (cosines * dr.maximum(wo.z, 0) / dr.pi + lobes * lobe) / count
        weight = dr.select((wo.z > 1e-4) & (density > 1e-6), 1 / (count * dr.maximum(density, 1e-6)), 0)
        result.append((mi.Vector3f(wo.x, wo.y, wo.z * side), weight))
    return result


def register() -> None:
    """Register the plugin `mistyle_deferred` with the current variant of Mitsuba."""
    variant = device.use()
    if variant not in _registered:
        mi.register_integrator(INTEGRATOR, _integrator_class())
        _registered.add(variant)


def _integrator_class() -> type:
    """The integrator, as a class of the current variant's base."""

    class Deferred(mi.SamplingIntegrator):
        """Sums BSDF times irradiance at the points of `lit` (set before rendering) for the film's only shape."""

        lit: Lit | None = None

        def sample(self, scene, sampler, ray, medium=None, active=True):
            """Radiance of the film's pixels in order; the ray is ignored. Needs one sample per pixel."""
            lit = self.lit
            if lit is None:
                raise RuntimeError(f"{INTEGRATOR}: set `lit` before rendering")
            rows, columns = lit.size
            if dr.width(ray.d) != rows * columns:
                raise RuntimeError(f"{INTEGRATOR}: expected a film of {columns}x{rows} pixels at 1 spp")
            pixel = dr.arange(mi.UInt32, rows * columns)
            point = dr.zeros(mi.SurfaceInteraction3f, rows * columns)
            point.wi = lit.wi
            column, row = mi.Float(pixel % columns), mi.Float(pixel // columns)
            point.uv = mi.Point2f((column + 0.5) / columns, (row + 0.5) / rows)
            bsdf = scene.shapes()[0].bsdf()
            terms = list(lit.directional)
            if lit.ambient is not None:
                radiance = mi.Color3f(*lit.ambient)
                terms += [(wo, radiance * weight) for wo, weight in ambient_directions(lit.wi)]
            total = mi.Color3f(0)
            for wo, irradiance in terms:
                total += bsdf.eval(mi.BSDFContext(), point, wo, lit.mask) * irradiance
            return total, lit.mask, []

    return Deferred


def _rays(cameras: Sequence[Camera]) -> Any:
    """Rays with unit directions through the pixel centres of equal cameras, camera after camera, row by row."""
    height, width = cameras[0].size
    lane = dr.arange(mi.UInt32, len(cameras) * height * width)
    camera_of, pixel = lane // (height * width), lane % (height * width)
    # (column + 0.5 - centre) / focal = column · a + b, with b from float64: a crop's centre may lie far outside it.
    scales = np.array([[1 / c.focal, (0.5 - c.centre[0]) / c.focal, (0.5 - c.centre[1]) / c.focal] for c in cameras])
    scale = _each(mi.Vector3f, scales, camera_of)
    x, y = dr.fma(pixel % width, scale.x, scale.y), dr.fma(pixel // width, scale.x, scale.z)
    axes = np.stack([camera.world_from_cam[:3, :3].T for camera in cameras])
    right, down, forward = (_each(mi.Vector3f, axes[:, k], camera_of) for k in range(3))
    origin = _each(mi.Point3f, np.stack([camera.position for camera in cameras]), camera_of)
    return mi.Ray3f(origin, dr.normalize(x * right + y * down + forward))


def _each(kind: Any, values: Float[np.ndarray, "c 3"], camera_of: Any) -> Any:
    """A vector per camera, for each of its pixels."""
    return dr.gather(kind, mi.Float(aligned(values).ravel()), camera_of)


def tangent_frame(point: Any, barycentric: Any, corners: Any) -> Any:
    """Interpolated tangent, made perpendicular to the shading normal; bitangent = handedness · (normal x tangent).

    `corners` holds the tangents of all face corners (xyz and handedness), one after the other.
    """
    valid = point.is_valid()
    tangent, hand = mi.Vector3f(0), mi.Float(1)
    weights = (1 - barycentric.x - barycentric.y, barycentric.x, barycentric.y)
    for k, weight in enumerate(weights):
        corner = dr.gather(mi.Vector4f, corners, point.prim_index * 3 + k, valid)
        tangent += weight * mi.Vector3f(corner.x, corner.y, corner.z)
        hand = dr.mulsign(mi.Float(1), corner.w)
    normal = point.sh_frame.n
    s = tangent - normal * dr.dot(normal, tangent)
    usable = valid & (dr.squared_norm(s) > 1e-12)
    s = dr.select(usable, dr.normalize(s), point.sh_frame.s)
    t = dr.select(usable, dr.cross(normal, s) * hand, point.sh_frame.t)
    return mi.Frame3f(s, t, normal)
