"""What is to be recovered: real assets or strong synthetic maps, at the resolution that the pictures can show.

Resolution: the finest power of two whose texel side on the surface (square root of area per texel) is no smaller than
the side of a pixel that faces it at the object's distance, 2 d tan(fov / 2) / pixels: what is finer, no picture shows.
The asset's maps are averaged down to it: over each new texel's area, weighted by what the surface covers of it, normals
made unit length again; texels without surface take their nearest neighbour's values. Emission is left out, metallic is
kept.

Strong maps are smooth at the scale of a texel, whatever the atlas: Gaussian random fields in space (WAVES plane waves
of 16 to 64 texel sides): tilt of standard deviation 0.15 per axis, roughness and albedo uniform over their ranges.
Their metallic is 0 everywhere; the fit does not know that.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from benchmarks.material_recovery.metrics import texel_areas
from mistyle.atlas.texels import rasterise, start_maps
from mistyle.core.camera import Camera, in_frame, px_from_world
from mistyle.core.drjit_arrays import aligned
from mistyle.core.errors import InputRefused
from mistyle.core.image import nearest_fill
from mistyle.core.maps import Maps, Texels
from mistyle.core.mesh import Mesh, face_areas
from mistyle.io.read_mesh import read_mesh

UV = Literal["auto", "new"]
# File below the folder of meshes, and whose UVs: the helmet's own lie on top of each other.
ASSETS: dict[str, tuple[str, UV]] = {
    "avocado": ("Avocado/Avocado.gltf", "auto"),
    "waterbottle": ("WaterBottle/WaterBottle.gltf", "auto"),
    "suzanne": ("Suzanne/02_suzanne.gltf", "auto"),
    "damagedhelmet": ("DamagedHelmet/DamagedHelmet.glb", "new"),
}
WAVES = 96
TILT, TILT_LIMIT = 0.15, 0.6
ROUGHNESS, ALBEDO = (0.15, 0.95), (0.1, 0.8)
LEAST_COSINE = 0.1
LEAST_VIEWS = 3
LIFT = 1e-3


@dataclass(frozen=True)
class Truth:
    """An object with the maps to be found, one per texture set, and the surface each of its texels stands for."""

    name: str
    mesh: Mesh
    texels: tuple[Texels, ...]
    maps: tuple[Maps, ...]
    areas: tuple[np.ndarray, ...]


def find_asset(name: str, folder: Path) -> Path:
    """The file of one of ASSETS below a folder laid out as the real data (or `python -m benchmarks.data`) is."""
    file = folder / "meshes" / "pbr" / ASSETS[name][0]
    if not file.is_file():
        raise InputRefused(
            f"{file}: not there; expected the asset '{name}'. Fetch the free ones with `python -m benchmarks.data "
            "--out FOLDER` and give --data FOLDER, or name others with --assets."
        )
    return file


def truth(
    file: Path, name: str, camera: Camera, uv: UV = "auto", strong: bool = False, seed: int = 0, tone: float = 1.0
) -> Truth:
    """Read a textured mesh and lay its maps, or strong synthetic ones, into atlases that match `camera`'s pixels.

    The camera looks at the origin; `tone` scales the resolution (0.5: half).
    """
    asset = read_mesh(file, uv=uv)
    mesh, pixel = asset.mesh, footprint(camera) / tone
    sizes = [fitted_size(mesh, p, pixel) for p in range(len(mesh.parts))]
    texels = tuple(rasterise(mesh, p, size) for p, size in enumerate(sizes))
    areas = tuple(texel_areas(mesh, t) for t in texels)
    if strong:
        maps = tuple(strong_maps(t, pixel, seed) for t in texels)
    else:
        maps = tuple(_averaged(mesh, asset.materials[p], p, t) for p, t in enumerate(texels))
    return Truth(f"{name}_strong" if strong else name, mesh, texels, maps, areas)


def footprint(camera: Camera) -> float:
    """Side of a pixel, in working units, on a plane through the origin that faces the camera."""
    return float(np.linalg.norm(camera.position)) / camera.focal


def fitted_size(mesh: Mesh, part: int, pixel: float) -> int:
    """See the module: 64 to 4096 texels along each side."""
    coarse = rasterise(mesh, part, 512)
    share = float(coarse.covered.mean())
    area = float(face_areas(mesh)[mesh.part == part].sum())
    wanted = np.sqrt(area / max(share, 1e-6)) / pixel
    return int(2 ** np.clip(np.floor(np.log2(wanted)), 6, 12))


def _averaged(mesh: Mesh, material, part: int, texels: Texels) -> Maps:
    size = len(texels.covered)
    given = [m for m in (material.albedo, material.normal, material.roughness, material.metallic) if m is not None]
    # A power of two times the fitted size that has at least the file's texels.
    factor = max([1, *(2 ** int(np.ceil(np.log2(max(m.shape[:2]) / size))) for m in given)])
    fine_texels = texels if factor == 1 else rasterise(mesh, part, size * factor)
    fine = start_maps(material, fine_texels, size * factor)
    return average(fine, fine_texels.covered, factor, texels.covered)


def average(fine: Maps, covered: np.ndarray, factor: int, wanted: np.ndarray) -> Maps:
    """The mean over blocks of factor x factor texels, weighted by `covered`; normals unit; blocks without any covered
    texel take the nearest block's values. `wanted` becomes `known`."""
    blocks = covered.reshape(len(covered) // factor, factor, -1, factor)
    weight = blocks.mean(axis=(1, 3), dtype=np.float64)

    def mean(values: np.ndarray) -> np.ndarray:
        channels = values.reshape(len(weight), factor, len(weight), factor, -1) * blocks[..., None]
        total = channels.mean(axis=(1, 3), dtype=np.float64) / np.maximum(weight, 1e-12)[..., None]
        filled = nearest_fill(total.astype(np.float32), weight > 0)
        return filled if values.ndim == 3 else filled[..., 0]

    normal = mean(fine.normal)
    length = np.linalg.norm(normal, axis=-1, keepdims=True)
    flat = np.array([0, 0, 1], np.float32)
    unit = np.where(length > 1e-6, normal / np.maximum(length, 1e-6), flat).astype(np.float32)
    return Maps(mean(fine.albedo), unit, mean(fine.roughness), mean(fine.metallic), wanted.copy())


def strong_maps(texels: Texels, side: float, seed: int) -> Maps:
    """Strong synthetic maps for an atlas whose texels have about `side` (working units); see the module."""
    rng = np.random.default_rng(seed)
    points = texels.position[texels.covered]
    tilts = [TILT * _field(points, side, rng) for _ in range(2)]
    uniform = [_normal_cdf(_field(points, side, rng)) for _ in range(4)]
    xy = np.stack(tilts, axis=1)
    xy *= np.minimum(1, TILT_LIMIT / np.maximum(np.linalg.norm(xy, axis=1, keepdims=True), 1e-9))
    normal = np.concatenate([xy, np.sqrt(1 - (xy**2).sum(axis=1, keepdims=True))], axis=1)
    albedo = ALBEDO[0] + (ALBEDO[1] - ALBEDO[0]) * np.stack(uniform[:3], axis=1)
    roughness = ROUGHNESS[0] + (ROUGHNESS[1] - ROUGHNESS[0]) * uniform[3]

    def spread(values: np.ndarray) -> np.ndarray:
        result = np.zeros((*texels.covered.shape, *values.shape[1:]), np.float32)
        result[texels.covered] = values
        return nearest_fill(result, texels.covered)

    metallic = np.zeros(texels.covered.shape, np.float32)
    return Maps(spread(albedo), spread(normal), spread(roughness), metallic, texels.covered.copy())


def _field(points: np.ndarray, side: float, rng: np.random.Generator) -> np.ndarray:
    """About N(0, 1) at every point: plane waves of random direction, phase and length (16 to 64 sides, by octaves)."""
    direction = rng.normal(size=(WAVES, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    length = side * 2 ** rng.uniform(4, 6, WAVES)
    phase = rng.uniform(0, 2 * np.pi, WAVES)
    waves = (direction * (2 * np.pi / length)[:, None]).T.astype(np.float32)
    # From the object's middle, where float32 holds the phases to 1e-4.
    rows = [
        np.cos(p @ waves + phase.astype(np.float32)).sum(axis=1)
        for p in np.array_split(points, 1 + len(points) // 2**16)
    ]
    return np.concatenate(rows) * np.sqrt(2 / WAVES)


def _normal_cdf(x: np.ndarray) -> np.ndarray:
    from scipy.special import ndtr

    return ndtr(x)


def observed_areas(truth: Truth, counts: Sequence[np.ndarray]) -> list[np.ndarray]:
    """The surface of the texels that at least LEAST_VIEWS cameras see, of `counts` from `seen`; 0 for the others."""
    return [area * (count >= LEAST_VIEWS) for area, count in zip(truth.areas, counts, strict=True)]


def seen(truth: Truth, cameras: Sequence[Camera]) -> tuple[np.ndarray, ...]:
    """How many of the cameras see each texel's surface point: in the picture, not hidden, and met at an angle whose
    cosine with the face's own normal exceeds LEAST_COSINE."""
    import mitsuba

    from mistyle.core.mesh import face_normals
    from mistyle.render.mitsuba.draw import tracer

    scene = tracer(truth.mesh).scene
    mi: Any = mitsuba  # its type stubs know one variant only
    normals = face_normals(truth.mesh).astype(np.float32)
    result = []
    for texels in truth.texels:
        count = np.zeros(texels.covered.shape, np.int32)
        points, n = texels.position[texels.covered], normals[texels.face[texels.covered]]
        origin = points + LIFT * n
        for camera in cameras:
            to = camera.position.astype(np.float32) - origin
            distance = np.linalg.norm(to, axis=1)
            to /= distance[:, None]
            px, z = px_from_world(camera, points)
            facing = ((to * n).sum(axis=1) > LEAST_COSINE) & in_frame(camera, px) & (z > 0)
            ray = mi.Ray3f(mi.Point3f(aligned(origin.T)), mi.Vector3f(aligned(to.T)))
            ray.maxt = mi.Float(aligned(distance * 0.999))
            count[texels.covered] += facing & ~np.array(scene.ray_test(ray))
        result.append(count)
    return tuple(result)
