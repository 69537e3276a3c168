"""Rendering: exact surface hits through pixel centres, the views of a job, and pictures for reports."""

import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from mistyle.core.camera import Camera, pixel_centres
from mistyle.core.drjit_arrays import aligned
from mistyle.core.image import resize
from mistyle.core.maps import Maps, coarser
from mistyle.core.mesh import Mesh
from mistyle.core.view import View
from mistyle.process import memory
from mistyle.render.mitsuba import device
from mistyle.render.mitsuba import scene as scenery
from mistyle.render.mitsuba.device import dr, mi
from mistyle.render.mitsuba.scene import STUDIO, Staging
from mistyle.render.mitsuba.texture_pages import paged_shapes

# Seeds of passes must differ from those of a neighbouring seed: an odd step visits every number once.
SEED_STEP = 0x9E3779B1


@dataclass(frozen=True)
class Hits:
    """First hits of the rays through the pixel centres; zero, -1 or infinity without a hit.

    position  world
    normal    interpolated shading normal, world, unit, without normal map; it belongs to the surface's front and is
              not turned towards the camera
    uv        v up, as in `Mesh.corner_uvs` (modulo 1)
    part      texture set of the face
    face      index into `Mesh.faces`
    depth     metric z in the camera
    """

    position: Float[np.ndarray, "h w 3"]
    normal: Float[np.ndarray, "h w 3"]
    uv: Float[np.ndarray, "h w 2"]
    part: Int[np.ndarray, "h w"]
    face: Int[np.ndarray, "h w"]
    depth: Float[np.ndarray, "h w"]
    mask: Bool[np.ndarray, "h w"]


@dataclass(frozen=True)
class Tracer:
    """A mesh ready for tracing, reusable for any number of cameras."""

    mesh: Mesh
    scene: Any


def tracer(mesh: Mesh) -> Tracer:
    """Build the ray tracing structure of a mesh (all texture sets in one shape)."""
    device.use()
    return Tracer(mesh, mi.load_dict({"type": "scene", "object": scenery.mitsuba_mesh(mesh, None)}))


def gbuffer(mesh: Mesh | Tracer, camera: Camera) -> Hits:
    """One exact ray through each pixel centre of `camera`; a Tracer avoids rebuilding the structure."""
    device.use()
    traced = mesh if isinstance(mesh, Tracer) else tracer(mesh)
    height, width = camera.size
    directions, cosines = _directions(camera, pixel_centres(camera.size).reshape(-1, 2))
    # Opaque: a literal would compile one kernel per camera.
    origin = mi.Point3f(*(dr.opaque(mi.Float, float(v)) for v in camera.position))
    ray = mi.Ray3f(origin, mi.Vector3f(aligned(directions.T)))
    hit = traced.scene.ray_intersect(ray, mi.RayFlags.All, coherent=True)
    valid = hit.is_valid()
    face = dr.select(valid, mi.Int32(hit.prim_index), -1)
    position, normal, uv = hit.p & valid, hit.sh_frame.n & valid, hit.uv
    v = dr.select(valid, 1 - uv.y, 0)
    u = dr.select(valid, uv.x, 0)
    distance = dr.select(valid, hit.t, dr.inf)
    dr.eval(face, position, normal, u, v, distance)

    def image(*channels) -> np.ndarray:
        return np.stack([np.array(c) for c in channels], axis=-1).reshape(height, width, -1)

    faces = image(face)[..., 0].astype(np.int32)
    return Hits(
        position=image(position.x, position.y, position.z),
        normal=image(normal.x, normal.y, normal.z),
        uv=image(u, v),
        part=np.where(faces >= 0, traced.mesh.part[np.maximum(faces, 0)], -1).astype(np.int32),
        face=faces,
        depth=(image(distance)[..., 0] * cosines.reshape(height, width)).astype(np.float32),
        mask=faces >= 0,
    )


def misses(traced: Tracer, camera: Camera, px: Float[np.ndarray, "n 2"]) -> Bool[np.ndarray, " n"]:
    """Whether the rays through pixel coordinates (x, y) miss the mesh."""
    origin = mi.Point3f(*(dr.opaque(mi.Float, float(v)) for v in camera.position))
    ray = mi.Ray3f(origin, mi.Vector3f(aligned(_directions(camera, px)[0].T)))
    return ~np.array(traced.scene.ray_test(ray)).astype(bool)


def _directions(
    camera: Camera, px: Float[np.ndarray, "n 2"]
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, " n"]]:
    """Unit world directions through pixels (x, y), and their cosine with the optical axis."""
    x, y = ((px - np.asarray(camera.centre)) / camera.focal).T
    cosines = 1 / np.sqrt(1 + x * x + y * y)
    # Written out: for so small a matrix, waking the BLAS's threads dominates.
    rows = [(a * x + b * y + c) * cosines for a, b, c in camera.world_from_cam[:3, :3]]
    return np.stack(rows, axis=1).astype(np.float32), cosines.astype(np.float32)


def draw_views(
    mesh: Mesh,
    maps: Sequence[Maps] | None,
    cameras: Sequence[Camera],
    template: str | Path = "paper_views",
    spp: int = 8,
    seed: int = 0,
    progress: Callable[[float], None] = lambda done: None,
) -> list[View]:
    """Render the mesh with its maps (None: neutral grey) from every camera (paper 4.1.1).

    `rgb` is linear and premultiplied by `coverage`, the share of a pixel's `spp` samples that hit the object; the
    environment is invisible. Depth, normal, uv, part and mask belong to the ray through the pixel centre. The same seed
    and thread count give the same bytes. `spp` is rounded up to a power of two.
    """
    traced = tracer(mesh)
    pictures = _pictures(mesh, maps, cameras, Staging(template, spp, seed, backdrop=False))
    views = []
    for k, (camera, picture) in enumerate(zip(cameras, pictures, strict=True)):
        views.append(memory.away(view_of(traced, camera, picture)))
        progress((k + 1) / len(cameras))
    return views


def view_of(traced: Tracer, camera: Camera, picture: Float[np.ndarray, "h w 4"]) -> View:
    """A premultiplied linear picture of `camera` with its alpha as coverage, and the geometry at pixel centres."""
    hits = gbuffer(traced, camera)
    return View(
        camera=camera,
        rgb=np.ascontiguousarray(picture[..., :3]),
        depth=hits.depth,
        normal=hits.normal,
        uv=hits.uv,
        part=hits.part,
        mask=hits.mask,
        coverage=np.ascontiguousarray(picture[..., 3]),
    )


def as_fine_as(maps: Maps, pixels: int) -> Maps:
    """Maps at the mip level that pictures of this many pixels a side resolve (`coarser`): means over squares of texels,
    with normals renormalised. Finer maps would only cost memory and time. Each map is treated by its own size."""
    small = {name: _coarse(getattr(maps, name), pixels) for name in ("albedo", "normal", "roughness", "metallic")}
    if small["normal"] is not maps.normal:
        length = np.linalg.norm(small["normal"], axis=-1, keepdims=True)
        small["normal"] = np.where(
            length > 1e-6, small["normal"] / np.maximum(length, 1e-6), np.array([0, 0, 1], np.float32)
        )
    by = coarser(min(maps.known.shape), pixels)
    return replace(maps, **small, known=maps.known[::by, ::by])


def _coarse(values: np.ndarray, pixels: int) -> np.ndarray:
    """The mip level of a map (h w *c) that pictures of this many pixels a side resolve; possibly the map itself."""
    by = coarser(min(values.shape[:2]), pixels)
    return values if by == 1 else resize(values, (values.shape[0] // by, values.shape[1] // by))


def picture(
    mesh: Mesh, maps: Sequence[Maps] | None, camera: Camera, staging: Staging = STUDIO
) -> Float[np.ndarray, "h w 4"]:
    """One picture for a report: linear rgb (premultiplied) and alpha; with a backdrop alpha is 1 nearly everywhere."""
    return next(iter(_pictures(mesh, maps, [camera], staging)))


def pictures(
    mesh: Mesh,
    maps: Sequence[Maps] | None,
    cameras: Sequence[Camera],
    staging: Staging = STUDIO,
    progress: Callable[[float], None] = lambda done: None,
) -> list[Float[np.ndarray, "h w 4"]]:
    """`picture` for several cameras; object and textures are loaded once."""
    result = []
    for image in _pictures(mesh, maps, cameras, staging):
        result.append(image)
        progress(len(result) / len(cameras))
    device.give_back()
    return result


def passes(mesh: Mesh, maps: Sequence[Maps], camera: Camera, staging: Staging) -> Iterator[Float[np.ndarray, "h w 4"]]:
    """An endless iterator of independent `picture`s; the scene is loaded once."""
    device.use()
    shapes = _shapes(mesh, maps, max(camera.size))
    described = scenery.scene_dict(mesh, maps, camera, staging, shapes)
    scene = mi.load_dict(described, optimize=False)
    for k in itertools.count():
        yield np.array(mi.render(scene, spp=staging.spp, seed=(staging.seed + k * SEED_STEP) % 2**32), dtype=np.float32)


def _shapes(mesh, maps, pixels):
    """The object for pictures of this many pixels a side."""
    chosen = None if maps is None else [as_fine_as(m, pixels) for m in maps]
    if chosen is not None and len(chosen) > 1:
        shapes = paged_shapes(mesh, chosen, flip_invalid=True)
    else:
        shapes = scenery.object_shapes(mesh, chosen, flip_invalid=True, frame="mikkt")
    del chosen
    memory.let_go()
    return shapes


def _pictures(mesh, maps, cameras, staging):
    """Render camera after camera; the object is loaded once, a template that follows the camera for each."""
    device.use()
    shapes = _shapes(mesh, maps, max(max(c.size) for c in cameras))

    def loaded(camera):
        described = scenery.scene_dict(mesh, maps, camera, staging, shapes)
        return mi.load_dict(described, optimize=False)

    spp, seed = staging.spp, staging.seed
    standing = loaded(cameras[0]) if cameras and not scenery.follows_camera(staging.template) else None

    def drawn(camera):
        # A function, so that each scene is freed before the next: with two alive, other kernels have to be compiled.
        scene = loaded(camera) if standing is None else standing
        sensor = scene.sensors()[0] if standing is None else mi.load_dict(scenery.sensor_dict(camera, spp, seed))
        return mean_of_passes(scene, sensor, camera.size, spp, seed)

    yield from map(drawn, cameras)


def mean_of_passes(scene: Any, sensor: Any, size: tuple[int, int], spp: int, seed: int) -> Float[np.ndarray, "h w 4"]:
    """A picture of a loaded scene with at least `spp` samples a pixel, in passes of independent seeds."""
    times, each = scenery.passes(spp)
    total = np.zeros((*size, 4), np.float32)
    for k in range(times):
        step = (seed + k * SEED_STEP) % 2**32
        total += np.array(mi.render(scene, sensor=sensor, spp=each, seed=step), dtype=np.float32)
    return total / np.float32(times)
