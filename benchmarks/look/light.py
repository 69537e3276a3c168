"""Pictures of painted assets for `benchmarks.look`: under real light, without light, and their figures."""

from collections.abc import Sequence
from dataclasses import replace
from functools import cache as once
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.common import DATA
from mistyle.measure.baked_light import BakedLight

HDRIS = ("venice_sunset_1k.hdr", "studio_small_03_1k.hdr")
SIDES = ((35.0, 15.0), (215.0, -12.0))  # azimuth, elevation; the second shows the underside
SIZE, SPP = 372, 32
DISTANCE, MARGIN = 4.5, 1.06  # of the camera from the middle, and of the picture around the object
GROUND = (0.35, 0.35, 0.35)  # linear, behind the asset
ATLAS = 1024


@once
def sky(name: str) -> Any:
    """An environment, exposed so that a grey ball in it has a mean luminance of 0.18."""
    from mistyle.io.read import read_radiance
    from mistyle.render.lookdev.scenes import light_rig
    from mistyle.render.lookdev.sheet import LightRig, exposed

    return exposed(LightRig(name, light_rig(str(DATA / "hdri" / name), read_radiance)[0])).light


def lit(glb: Path, size: int = SIZE, spp: int = SPP) -> list[np.ndarray]:
    """The asset under every environment from every side, (size, size, 3) uint8 sRGB; kept beside the GLB."""
    kept = glb.with_name(f"{glb.name}.lit-{size}-{spp}.npy")
    if not kept.exists():
        from mistyle.io.read_mesh import read_mesh
        from mistyle.render.lookdev.scenes import asset_scene, asset_shapes, drawn

        asset, pictures = read_mesh(glb), []
        shapes = asset_shapes(asset)
        for name in HDRIS:
            for azimuth, elevation in SIDES:
                camera = close_camera(asset.mesh.positions, azimuth, elevation, size)
                # The light stands still about the camera: the asset is turned, not the photographer.
                light = replace(sky(name), turn=sky(name).turn + azimuth)
                pictures.append(encoded(drawn(asset_scene(shapes, camera, (light,), "path"), 0, spp, 0)))
        np.save(kept, np.stack(pictures))
    return list(np.load(kept))


def close_camera(positions: np.ndarray, azimuth: float, elevation: float, size: int) -> Any:
    """A camera on the orbit of radius DISTANCE, aimed and zoomed so that the object fills the picture."""
    from mistyle.core.camera import look_at, orbit

    far = orbit(azimuth, elevation, distance=DISTANCE, fov=30.0, size=(size, size))
    eye, axes = far.position, far.world_from_cam[:3, :3]
    target = (positions.min(axis=0) + positions.max(axis=0)) / 2
    seen = (positions - eye) @ axes
    middle = (target - eye) @ axes
    reach = np.abs(seen[:, :2] / seen[:, 2:] - middle[:2] / middle[2]).max()
    fov = float(np.degrees(2 * np.arctan(reach * MARGIN)))
    return look_at(eye.tolist(), target.tolist(), fov=fov, size=(size, size))


def encoded(picture: np.ndarray) -> np.ndarray:
    """A linear premultiplied picture with alpha, over GROUND, as uint8 sRGB."""
    from mistyle.core.image import srgb_from_linear
    from mistyle.render.lookdev.sheet import over

    return np.round(255 * srgb_from_linear(np.clip(over(picture, GROUND), 0, 1))).astype(np.uint8)


def light_of(glb: Path) -> BakedLight:
    """What the albedo of a kept GLB says about light, over all its texels."""
    from mistyle.atlas.texels import rasterise, start_maps
    from mistyle.io.read_mesh import read_mesh
    from mistyle.stylization.optimise.light_left import light_left

    asset = read_mesh(glb)
    texels = [rasterise(asset.mesh, part, ATLAS) for part in range(len(asset.materials))]
    maps = [start_maps(material, one, ATLAS) for material, one in zip(asset.materials, texels, strict=True)]
    found = light_left(asset.mesh, texels, maps, most=len(texels) * ATLAS**2)
    if found is None:
        raise SystemExit(f"{glb}: no texel of it is covered")
    return found


def mean_light(lights: Sequence[Sequence[BakedLight]]) -> dict[str, float]:
    """The figures of `light.*` from what was measured, style by style, each on every mesh.

    ratio_mean    geometric mean of up/down over the styles (of a style: over its meshes)
    ratio_spread  the same of the ratio or its inverse, whichever is above 1: opposite ratios do not cancel
    ratio_worst   the style furthest from 1, as a factor above 1
    correlation   the largest of the mean sizes of the four correlations
    """
    logs = [[np.log(one.ratio) for one in style if one.ratio is not None] for style in lights]
    styles = np.array([np.mean(values) for values in logs if values])
    sizes = np.array([[[abs(v) for v in (a.x, a.y, a.z, a.openness)] for a in style] for style in lights])
    means = sizes.reshape(-1, 4).mean(axis=0)
    figures = {
        "light.ratio_mean": float(np.exp(styles.mean())),
        "light.ratio_spread": float(np.exp(np.abs(styles).mean())),
        "light.ratio_worst": float(np.exp(np.abs(styles).max())),
        "light.correlation": float(means.max()),
    }
    return figures | {
        f"light.correlation.{n}": float(v) for n, v in zip(("x", "y", "z", "openness"), means, strict=True)
    }


def piece_of_asset(glb: Path, unit: float, pixels: int, seed: int) -> np.ndarray:
    """A flat, wholly visible piece of the asset's surface without light: (pixels, pixels, 3) sRGB 0..1.

    `unit` is the side of a pixel on the surface, in working units. Of many places chosen by the seed the flattest few
    count, and of those one is taken.
    """
    from mistyle.core.camera import look_at
    from mistyle.core.image import srgb_from_linear
    from mistyle.core.maps import flat_maps
    from mistyle.core.mesh import face_areas, face_normals
    from mistyle.io.read_mesh import read_mesh
    from mistyle.render.lookdev.scenes import material_maps
    from mistyle.render.mitsuba.draw import gbuffer, tracer
    from mistyle.render.mitsuba.unlit import unlit

    asset, rng, distance = read_mesh(glb), np.random.default_rng(seed), 4.0
    mesh, traced, tries = asset.mesh, tracer(asset.mesh), []
    areas, normals = face_areas(mesh).astype(np.float64), face_normals(mesh)
    for face in rng.choice(len(mesh.faces), 60, p=areas / areas.sum()):
        target, normal = mesh.positions[mesh.faces[face]].mean(axis=0), normals[face]
        fov = float(np.degrees(2 * np.arctan(unit * pixels / 2 / distance)))
        camera = look_at((target + distance * normal).tolist(), target.tolist(), fov=fov, size=(pixels, pixels))
        hits = gbuffer(traced, camera)
        near = np.abs(hits.depth - distance) < unit * pixels
        facing = np.where(hits.mask & near, hits.normal @ normal, -1.0)
        tries.append((float(np.percentile(facing, 2)), len(tries), camera))
    best = sorted(tries, key=lambda one: (-one[0], one[1]))[:8]
    camera = best[int(rng.integers(len(best)))][2]
    albedos = [material_maps(material).albedo for material in asset.materials]
    maps = [replace(flat_maps(len(albedo)), albedo=albedo) for albedo in albedos]
    rgb, _ = unlit(traced, maps, [camera], fine=4)[0]
    return srgb_from_linear(np.clip(rgb, 0, 1))
