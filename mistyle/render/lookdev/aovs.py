"""AOVs of an asset from one camera: albedo, normal, roughness, metallic, position, a UV checker, texel density, and any
other map per texel."""

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float

from mistyle.core.asset import Asset
from mistyle.core.camera import Camera, resized
from mistyle.core.image import bilinear, srgb_from_linear
from mistyle.core.maps import Maps
from mistyle.core.mesh import Mesh, face_areas
from mistyle.geometry.tangents import corner_tangents
from mistyle.render.lookdev.scenes import material_maps
from mistyle.render.mitsuba.draw import Hits, gbuffer

FINE = 2  # rays along each side of a pixel
CHECKS = 16  # squares of the checker along a texture


def aovs(
    asset: Asset, camera: Camera, extra: Mapping[str, Sequence[Float[np.ndarray, "_ _ 3"]]] | None = None
) -> dict[str, Float[np.ndarray, "h w 4"]]:
    """Pictures by name as straight sRGB-encoded colours and alpha; `extra` are encoded colours per texture set.

    Data (normal, roughness, position, …) are stored without encoding: a roughness of 0.5 is a value of 0.5. Normals are
    in the camera's axes (x right, y up, z towards it), normal map included, as (n + 1) / 2. Positions run from 0 to 1
    through the asset's bounding box.
    """
    height, width = camera.size
    fine = resized(camera, (height * FINE, width * FINE))
    hits = gbuffer(asset.mesh, fine)
    maps = [material_maps(m) for m in asset.materials]
    low, high = asset.mesh.positions.min(axis=0), asset.mesh.positions.max(axis=0)
    roughness, metallic = (
        np.repeat(per_texel(hits, [getattr(m, n)[..., None] for m in maps]), 3, axis=-1)
        for n in ("roughness", "metallic")
    )
    layers = {
        "albedo": srgb_from_linear(per_texel(hits, [m.albedo for m in maps])),
        "normal": normals(asset.mesh, hits, maps, camera) * 0.5 + 0.5,
        "roughness": roughness,
        **({"metallic": metallic} if metallic[hits.mask].max(initial=0) > 0 else {}),
        "position": (hits.position - low) / np.maximum(high - low, 1e-9),
        "UV checker": checker(hits),
        "texel density": density(asset.mesh, hits, maps)[0],
        **{name: per_texel(hits, pictures) for name, pictures in (extra or {}).items()},
    }
    return {name: _small(rgb, hits) for name, rgb in layers.items()}


def per_texel(hits: Hits, maps: Sequence[Float[np.ndarray, "_ _ c"]]) -> Float[np.ndarray, "h w c"]:
    """The maps of its texture set at each hit; zero off the mesh."""
    result = np.zeros((*hits.mask.shape, maps[0].shape[2]), np.float32)
    for part, values in enumerate(maps):
        at = hits.part == part
        if at.any():
            size = np.array(values.shape[1::-1])
            px = np.stack([hits.uv[at][:, 0], 1 - hits.uv[at][:, 1]], axis=1) * size
            result[at] = bilinear(values.astype(np.float32), px, edge="repeat")
    return result


def normals(mesh: Mesh, hits: Hits, maps: Sequence[Maps], camera: Camera) -> Float[np.ndarray, "h w 3"]:
    """Unit normals with the normal maps in MikkTSpace frames, in the camera's axes x right, y up, z backwards."""
    inner = per_texel(hits, [m.normal for m in maps])
    at = hits.mask
    weights = barycentric(mesh, hits.face[at], hits.position[at])
    corner = corner_tangents(mesh)[hits.face[at]]
    tangent = (weights[..., None] * corner[..., :3]).sum(axis=1)
    normal = hits.normal[at]
    bitangent = corner[:, :1, 3] * np.cross(normal, tangent)
    local = inner[at]
    world = tangent * local[:, :1] + bitangent * local[:, 1:2] + normal * local[:, 2:]
    world /= np.maximum(np.linalg.norm(world, axis=1, keepdims=True), 1e-9)
    result = np.zeros((*at.shape, 3), np.float32)
    result[at] = (world @ camera.world_from_cam[:3, :3]) * np.array([1, -1, -1])
    return result


def barycentric(mesh: Mesh, face: np.ndarray, position: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Weights of the three corners of each point's face."""
    a, b, c = (mesh.positions[mesh.faces[face, k]].astype(np.float64) for k in range(3))
    u, v, w = b - a, c - a, position - a
    uu, uv, vv = (u * u).sum(1), (u * v).sum(1), (v * v).sum(1)
    wu, wv = (w * u).sum(1), (w * v).sum(1)
    scale = np.maximum(uu * vv - uv * uv, 1e-30)
    second, third = (vv * wu - uv * wv) / scale, (uu * wv - uv * wu) / scale
    return np.clip(np.stack([1 - second - third, second, third], axis=1), 0, 1)


def checker(hits: Hits) -> Float[np.ndarray, "h w 3"]:
    """A checker of CHECKS x CHECKS squares a texture, red growing with u and green with v."""
    uv = hits.uv % 1
    dark = (np.floor(uv * CHECKS).astype(int).sum(axis=-1) % 2).astype(np.float32)
    colours = np.stack([0.25 + 0.75 * uv[..., 0], 0.25 + 0.75 * uv[..., 1], np.full(uv.shape[:2], 0.45)], axis=-1)
    return (colours * (1 - 0.62 * dark[..., None])).astype(np.float32)


def density(mesh: Mesh, hits: Hits, maps: Sequence[Maps]) -> tuple[Float[np.ndarray, "h w 3"], float]:
    """Texels per length of surface as colours: blue a quarter of the median or less, white the median, red four times;
    and the median, texels per unit (the asset's bounding sphere has radius 1)."""
    a, b, c = (mesh.corner_uvs[:, k].astype(np.float64) for k in range(3))
    u, v = (b - a).T, (c - a).T
    flat = 0.5 * np.abs(u[0] * v[1] - u[1] * v[0])
    size = np.array([m.albedo.shape[0] * m.albedo.shape[1] for m in maps], float)
    areas = face_areas(mesh)
    texels = np.sqrt(flat * size[mesh.part] / np.maximum(areas, 1e-12))
    order = np.argsort(texels)
    total = np.cumsum(areas[order])
    median = float(texels[order[np.searchsorted(total, total[-1] / 2)]])
    stops = np.clip(np.log2(np.maximum(texels, 1e-9) / max(median, 1e-9)) / 2, -1, 1)[np.maximum(hits.face, 0)]
    cold, hot, middle = (np.array(c) for c in ((0.13, 0.35, 0.75), (0.80, 0.16, 0.16), (0.93, 0.93, 0.91)))
    towards = np.where(stops[..., None] < 0, cold, hot)
    return (middle + (towards - middle) * np.abs(stops)[..., None]).astype(np.float32), median


def _small(rgb: Float[np.ndarray, "h w 3"], hits: Hits) -> Float[np.ndarray, "h2 w2 4"]:
    """The mean over FINE x FINE rays, straight colours and alpha."""
    height, width = hits.mask.shape
    alpha = hits.mask[..., None].astype(np.float32)
    both = np.concatenate([np.clip(rgb, 0, 1) * alpha, alpha], axis=-1)
    both = both.reshape(height // FINE, FINE, width // FINE, FINE, 4).mean(axis=(1, 3))
    return np.concatenate([both[..., :3] / np.maximum(both[..., 3:], 1e-6), both[..., 3:]], axis=-1)
