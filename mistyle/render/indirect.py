"""Light that reaches the camera by way of more than one surface point: what a fit under direct light must take off.

Mitsuba's `path` renders every picture twice with the same samples, once with all its bounces and once without; the
difference is the indirect light, free of the noise that both share, and of most of what smooth surfaces mirror of each
other. What arrives is smooth along the surface, so a coarse picture of few samples says enough, once it is divided by
the albedo, averaged over pixels that show the same surface, and multiplied again (Dammertz et al. 2010).
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from mistyle.core.camera import Camera, binned
from mistyle.core.image import nearest_fill, resize
from mistyle.core.lanes import aligned
from mistyle.core.light import Lights
from mistyle.core.maps import Maps
from mistyle.core.mesh import Mesh
from mistyle.render import device
from mistyle.render import scene as scenery
from mistyle.render.emitters import emitters

COARSER = 2  # pixels along a side of the picture that one pixel of the estimate covers
LEAST = 128  # pixels along a side of the estimate, at least, where the picture has so many
MOST = 256  # and at most along the longer side, however large the picture is
ROUGH = 0.25  # least roughness: light that mirrors carry comes in few bright samples and adds little
DEPTH = 5  # path segments: light comes over up to four surface points
ALIKE = 0.15  # length of the difference of two unit normals at which pixels hardly belong together any more
LEVEL = 0.7  # and how far, in widths of a pixel, one may lie above or below the other's tangent plane
PALE = 0.04  # joins the albedo that light is divided by: what a surface reflects without taking its colour
FIREFLY = 4.0  # times its surroundings: the brightest that a pixel of the estimate may be


class Indirect:
    """The indirect light of pictures of one object; its maps stand until another object of this class is made."""

    def __init__(
        self, mesh: Mesh, maps: Sequence[Maps], *, model: scenery.Model = "principled", frame: scenery.Frame = "mikkt"
    ) -> None:
        device.use()
        import mitsuba

        mi: Any = mitsuba
        matt = [replace(m, roughness=np.maximum(m.roughness, np.float32(ROUGH))) for m in maps]
        self.shapes = scenery.object_shapes(mesh, matt, model=model, frame=frame)
        direct, whole = (
            {"type": "path", "max_depth": depth, "rr_depth": 100, "hide_emitters": True} for depth in (2, DEPTH)
        )
        guides = {"type": "aov", "aovs": "p:position,n:sh_normal,a:albedo", "nested": direct}
        self.integrators = [mi.load_dict(guides), mi.load_dict(whole)]

    def picture(self, camera: Camera, lights: Lights, samples: int, seed: int) -> Float[np.ndarray, "h w 3"]:
        """Indirect radiance, linear Rec.709, of a coarser picture of the camera, for `enlarged`; beside the object
        that of the nearest pixel on it.

        Lights of a scene file raise ValueError. `samples` are those of a pixel of the coarse
        picture.
        """
        import mitsuba

        mi: Any = mitsuba
        by = max(COARSER if min(camera.size) >= COARSER * LEAST else 1, -(-max(camera.size) // MOST))
        # Pixels that begin inside the picture and end beside it belong to the estimate.
        small = replace(binned(camera, by), size=(-(-camera.size[0] // by), -(-camera.size[1] // by)))
        count = scenery.samples(samples)
        described = {"type": "scene", "sensor": scenery.sensor_dict(small, count), **self.shapes}
        described |= {f"light{k}": light for k, light in enumerate(emitters(lights, camera))}
        scene = mi.load_dict(described, optimize=False)
        direct, whole = (
            np.array(mi.render(scene, integrator=integrator, spp=count, seed=seed)) for integrator in self.integrators
        )
        share = whole[..., 3:4]
        inside = np.isfinite(whole).all(axis=-1) & (share[..., 0] > 0)
        light = np.where(inside[..., None], np.maximum(whole[..., :3] - direct[..., :3], 0), 0).astype(np.float32)
        if not inside.any():
            return np.zeros((*small.size, 3), np.float32)
        covered = np.where(inside, np.maximum(share[..., 0], 0.05), 1)[..., None]
        position, normal, albedo = (direct[..., k : k + 3] / covered for k in (4, 7, 10))
        albedo = np.maximum(np.nan_to_num(albedo), 0) + PALE
        unit = np.linalg.norm(position - camera.position.astype(np.float32), axis=-1) / small.focal
        smooth = averaged(light / covered / albedo, position, normal, unit, inside) * albedo
        return nearest_fill(np.ascontiguousarray(smooth, np.float32), inside)


def enlarged(light: Float[np.ndarray, "h w 3"], size: tuple[int, int]) -> Float[np.ndarray, "H W 3"]:
    """What `Indirect.picture` made, as large as the picture that it is of."""
    by = max(-(-whole // part) for whole, part in zip(size, light.shape, strict=False))
    return resize(light, (light.shape[0] * by, light.shape[1] * by))[: size[0], : size[1]]


def averaged(
    light: Float[np.ndarray, "h w 3"],
    position: Float[np.ndarray, "h w 3"],
    normal: Float[np.ndarray, "h w 3"],
    unit: Float[np.ndarray, "h w"],
    inside: Bool[np.ndarray, "h w"],
) -> Float[np.ndarray, "h w 3"]:
    """Mean of each pixel and the eight around it that show the same surface; `unit` is the width of a pixel there.

    Pixels that are more than FIREFLY times brighter than those around them are first brought down to that.
    """
    normal = normal / np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-6)
    position, normal = (np.where(inside[..., None], field, 0).astype(np.float32) for field in (position, normal))
    total, weights = np.zeros_like(light), np.zeros(inside.shape, np.float32)
    for dy in (-1, 0, 1):
        for dx in (-1, 0, 1):
            if not (dy or dx):
                continue
            rows, columns = _overlap(inside.shape[0], dy), _overlap(inside.shape[1], dx)
            here, there = (rows[0], columns[0]), (rows[1], columns[1])
            lift = ((position[there] - position[here]) * normal[here]).sum(axis=-1) / (LEVEL * unit[here])
            turn2 = ((normal[there] - normal[here]) ** 2).sum(axis=-1)
            likeness = np.exp(-(lift**2) - turn2 / ALIKE**2) * (0.25 if dy and dx else 0.5)
            weight = np.where(inside[here] & inside[there], likeness, 0)
            total[here] += weight[..., None] * light[there]
            weights[here] += weight
    brightest = FIREFLY * (total / np.maximum(weights, 1e-6)[..., None])
    light = np.where(weights[..., None] > 1e-6, np.minimum(light, brightest), light)
    return (light + total) / (1 + weights)[..., None]


def _overlap(size: int, step: int) -> tuple[slice, slice]:
    """Rows that have another one `step` further on, and those others."""
    return slice(max(0, -step), size - max(0, step)), slice(max(0, step), size + min(0, step))


def retarget(shade: Any, picture: int, rgb: Float[np.ndarray, "h w 3"], weight: Float[np.ndarray, "h w"]) -> None:
    """Give a picture of a `Shade` another reference and other weights; pictures it does not keep load theirs again."""
    import mitsuba

    mi: Any = mitsuba
    for block in shade.kept(picture):
        target = np.array(block.target).reshape(-1, 4)
        target[: len(block.pixel), :3] = rgb.reshape(-1, 3)[block.pixel]
        target[: len(block.pixel), 3] = weight.ravel()[block.pixel]
        block.target = mi.Float(aligned(target.ravel()))
