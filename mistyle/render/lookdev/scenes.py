"""Look-dev scenes: one asset, one camera and one light, equal for every renderer.

Lights are records of core/light.py. Mitsuba reads them through `emitters`. Blender gets the directional ones as suns of
zero size and all soft lights as one latitude-longitude picture in its own layout.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from mistyle.core.asset import Asset, Material
from mistyle.core.camera import Camera
from mistyle.core.errors import InputRefused
from mistyle.core.light import (
    SOFT,
    Ambient,
    Directional,
    Environment,
    Light,
    Lights,
    direction_in_world,
    soft_radiance,
)
from mistyle.core.maps import OwnMaps
from mistyle.core.paths import PACKAGE, scenes
from mistyle.process import stopping
from mistyle.render.mitsuba import appearance, device
from mistyle.render.mitsuba.device import mi
from mistyle.render.mitsuba.emitters import emitters
from mistyle.render.mitsuba.scene import passes, sensor_dict

DEPTH = 6  # most vertices of a path, the light's included
OWN = {"path": DEPTH, "direct": 2}  # path vertices of `appearance.integrator`, which replaces them
ROWS = 512
# Programs for other environments' Pythons, which do not import mistyle.
EXTERNAL = PACKAGE / "render" / "external"
CYCLES_WORKER, MITSUBA_WORKER = (str(EXTERNAL / f"{n}_worker.py") for n in ("cycles", "mitsuba"))


def light_rig(name: str, read: Any) -> Lights:
    """One of these, or an .hdr or .exr environment map read by `read(path)`.

    studio   the softboxes of scenes/studio.xml
    key      a hard light of irradiance 2.5 from the upper left, ambient radiance 0.15
    grazing  a hard light of irradiance 4 from the right, 8 degrees above the horizon, ambient radiance 0.05
    """
    if name == "studio":
        return (Environment(read(scenes() / "studio_lights.exr"), file="studio_lights.exr"),)
    if name == "key":
        return (Directional((-0.5773503, 0.5773503, 0.5773503), (2.5, 2.5, 2.5)), Ambient((0.15, 0.15, 0.15)))
    if name == "grazing":
        return (Directional((0.9902681, 0.1391731, 0.0), (4.0, 4.0, 4.0)), Ambient((0.05, 0.05, 0.05)))
    return (Environment(read(Path(name)), file=Path(name).name),)


def material_maps(material: Material, metallic: Literal["keep", "zero"] = "keep") -> OwnMaps:
    """The maps of a material for a renderer: each at the file's resolution with its factor applied, and 2 x 2 texels
    (the renderer's least) where the file has no texture. "zero" ignores the file's metalness."""

    def full(texture: np.ndarray | None, factor: float | np.ndarray, channels: int) -> np.ndarray:
        if texture is None:
            constant = np.clip(np.asarray(factor, np.float32), 0, 1)
            return np.broadcast_to(constant, (2, 2, channels) if channels else (2, 2)).copy()
        if np.all(np.asarray(factor) == 1):
            return texture
        scaled = np.multiply(texture, np.asarray(factor, np.float32), dtype=np.float32)
        return np.clip(scaled, 0, 1, out=scaled)

    flat = np.zeros((2, 2, 3), np.float32) + np.array([0, 0, 1], np.float32)
    albedo = full(material.albedo, material.albedo_factor, 3)
    metal = (material.metallic, material.metallic_factor) if metallic == "keep" else (None, 0.0)
    return OwnMaps(
        albedo=albedo,
        normal=flat if material.normal is None else material.normal,
        roughness=full(material.roughness, material.roughness_factor, 0),
        metallic=full(*metal, 0),
        known=np.ones(albedo.shape[:2], bool),
    )


def asset_shapes(asset: Asset) -> dict[str, Any]:
    """The asset's shapes with the file's material: glTF's own reflectance model, normal maps in MikkTSpace frames, and
    the features of render/mitsuba/appearance.py: opacity, emission, reflectance, coats."""
    return appearance.shapes(asset, [material_maps(m) for m in asset.materials])


def asset_scene(shapes: dict[str, Any], camera: Camera, lights: Sequence[Light], integrator: str) -> Any:
    """A loaded `mi.Scene` whose environment lights the asset but is invisible. `integrator` is "path" or "direct"."""
    device.use()
    own = integrator in OWN and appearance.needs_path(shapes)
    chosen = appearance.integrator(OWN[integrator], shapes) if own else integrator_dict(integrator)
    described: dict[str, Any] = {"type": "scene", "integrator": chosen}
    described["sensor"] = sensor_dict(camera, 64)
    for k, emitter in enumerate(emitters(lights, camera)):
        described[f"light{k}"] = emitter
    return mi.load_dict(described | shapes, optimize=False)


def integrator_dict(name: str) -> dict[str, Any]:
    """`path` of DEPTH vertices, or `direct` light alone; another name is that plugin with its defaults."""
    if name == "path":
        return {"type": "path", "max_depth": DEPTH, "hide_emitters": True}
    if name == "direct":
        return {"type": "direct", "hide_emitters": True}
    return {"type": name}


def file_scene(path: Path) -> Any:
    """A Mitsuba scene file as `mi.load_file` loads it. The file is trusted: Mitsuba opens all files that it names."""
    device.use()
    try:
        with device.file_threads():
            scene = mi.load_file(str(path))
    except RuntimeError as error:
        stopping.check()
        raise InputRefused(f"{path}: Mitsuba cannot load this scene. {error}") from error
    if not isinstance(scene, mi.Scene) or not scene.sensors():
        raise InputRefused(f"{path}: found no scene with a sensor; expected a Mitsuba scene file.")
    return scene


def drawn(
    scene: Any, sensor: int, spp: int, seed: int, integrator: dict[str, Any] | None = None
) -> Float[np.ndarray, "h w c"]:
    """Linear Rec.709 and the film's alpha, if any; exactly `spp` samples for powers of two.

    `integrator` None: the scene's own.
    """
    device.use()
    times, each = passes(spp)
    total: Any = 0
    with device.plain_errors("the scene was rendered"):
        more: dict[str, Any] = {} if integrator is None else {"integrator": mi.load_dict(integrator)}
        for k in range(times):
            picture = mi.render(scene, sensor=sensor, spp=each, seed=(seed + k * 0x9E3779B1) % 2**32, **more)
            total = total + np.array(picture, dtype=np.float64)
    return np.ascontiguousarray((total / times).astype(np.float32)[..., :4])


def suns(lights: Sequence[Light], camera: Camera) -> list[dict[str, list[float]]]:
    """The directional lights in Blender's job format: `direction` towards them in the world, `irradiance`."""
    return [
        {"direction": direction_in_world(x, camera).tolist(), "irradiance": list(x.irradiance)}
        for x in lights
        if isinstance(x, Directional)
    ]


def blender_environment(lights: Sequence[Light]) -> Float[np.ndarray, "h w 3"]:
    """The soft lights as one picture in Blender's equirectangular layout, for a Y-up world rotated by its importer.

    Cycles: u = 0.5 - atan2(y, x) / 2π, v = 0.5 + asin(z) / π with Z up; the importer takes (x, y, z) to (x, -z, y).
    """
    soft = [x for x in lights if isinstance(x, SOFT)]
    height = max([ROWS, *(len(x.radiance) for x in soft if isinstance(x, Environment))])
    if all(isinstance(x, Ambient) for x in soft):
        height = 4
    u, v = (np.arange(2 * height) + 0.5) / (2 * height), 1 - (np.arange(height) + 0.5) / height
    turn, rise = (0.5 - u) * 2 * np.pi, ((v - 0.5) * np.pi)[:, None]
    x, y, z = np.cos(turn) * np.cos(rise), np.sin(turn) * np.cos(rise), np.sin(rise) + 0 * turn
    return soft_radiance(soft, np.stack([x, z, -y], axis=-1)).astype(np.float32)
