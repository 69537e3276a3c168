"""The pictures of the benchmark: references to fit to, and relit ones to judge by; Mitsuba's `path`, kept on disk.

Shadows and interreflection are on (DEPTH vertices). Light adds up, so several lights are rendered one after the other
and summed: no light is chosen at random, and with a delta light only bounces and pixel borders are noisy. Renders with
equal seeds share their random numbers.
"""

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from mistyle.core.camera import MITSUBA_FROM_OPENCV, Camera, look_at, rig
from mistyle.core.light import (
    Ambient,
    Directional,
    Environment,
    Light,
    Lights,
    direction_in_world,
    lights,
    turn_about_y,
)
from mistyle.core.maps import Maps
from mistyle.core.mesh import Mesh
from mistyle.core.settings import RigSettings
from mistyle.io.read import read_hdr
from mistyle.render.mitsuba import device
from mistyle.render.mitsuba.scene import Frame, object_shapes, passes, sensor_dict

DEPTH = 6
DISTANCE, FOV = 4.0, 30.0
HDRI_MEAN = 0.6  # mean radiance that the studio's map is brought to


@dataclass(frozen=True)
class Shot:
    """One picture to take."""

    camera: Camera
    lights: Lights


def fibonacci(views: int, resolution: int, turn: float = 0.0) -> list[Camera]:
    """Evenly spread cameras at DISTANCE; `turn` (0..1) turns the spiral by that share of one step."""
    k = np.arange(views) + 0.5
    polar, azimuth = np.arccos(1 - 2 * k / views), np.pi * (1 + 5**0.5) * (k + turn)
    eyes = DISTANCE * np.stack(
        [np.sin(polar) * np.cos(azimuth), np.cos(polar), np.sin(polar) * np.sin(azimuth)], axis=1
    )
    size = (resolution, resolution)
    return [look_at(eye.tolist(), fov=FOV, size=size, name=f"view{i:03d}") for i, eye in enumerate(eyes)]


def one_at_a_time(cameras: Sequence[Camera]) -> list[Shot]:
    """Every camera under each of the three camera-fixed directional lights of `scenes/phase1_directional.xml`."""
    shots = []
    for camera in cameras:
        for k, light in enumerate(lights("phase1")):
            shots.append(Shot(replace(camera, name=f"{camera.name}_light{k}"), (light,)))
    return shots


def together(shots: Sequence[Shot], pictures: Sequence[np.ndarray]) -> tuple[list[Shot], list[np.ndarray]]:
    """The pictures of `one_at_a_time` summed by camera: all three lights on."""
    sums = [sum(pictures[k : k + 3][1:], pictures[k]) for k in range(0, len(shots), 3)]
    every = [tuple(light for s in shots[k : k + 3] for light in s.lights) for k in range(0, len(shots), 3)]
    cameras = [replace(s.camera, name=s.camera.name.rsplit("_", 1)[0]) for s in shots[::3]]
    return [Shot(c, lit) for c, lit in zip(cameras, every, strict=True)], sums


def paper_cameras(resolution: int) -> list[Camera]:
    """The paper's rig of 16 (4.1.1)."""
    return rig(RigSettings(resolution=resolution))


def turned(cameras: Sequence[Camera], hdri: Path, times: int = 3) -> list[Shot]:
    """Every camera under an environment alone, which stands in `times` positions about the object."""
    radiance = read_hdr(hdri)
    scale = HDRI_MEAN / float(radiance.mean())
    skies = [Environment(radiance, turn=360.0 * k / times, scale=scale, file=hdri.name) for k in range(times)]
    return [Shot(replace(c, name=f"{c.name}_sky{k}"), (sky,)) for c in cameras for k, sky in enumerate(skies)]


def unseen(hdri: Path, resolution: int, views: int) -> dict[str, list[Shot]]:
    """The four lights of no reference, from cameras between those of the references: a studio's environment map, a key
    from the side, a light that grazes what faces the camera, and a warm and a cool one over a dim blue sky."""
    radiance = read_hdr(hdri)
    scale = HDRI_MEAN / float(radiance.mean())
    warm, cool = _towards((-0.75, 0.35, -0.55), (2.4, 1.1, 0.3)), _towards((0.6, -0.7, -0.4), (0.25, 0.8, 2.2))
    rigs: dict[str, Lights] = {
        "studio": (Environment(radiance, turn=70.0, scale=scale, file=hdri.name),),
        "side": (_towards((0.97, -0.2, -0.14), (2.5, 2.5, 2.5)),),
        "grazing": (_towards((-0.15, -0.985, 0.08), (3.0, 3.0, 3.0)),),
        "coloured": (warm, cool, Ambient((0.04, 0.06, 0.1))),
    }
    cameras = fibonacci(views, resolution, turn=0.37)
    return {name: [Shot(c, rig) for c in cameras] for name, rig in rigs.items()}


def _towards(direction: tuple[float, float, float], irradiance: tuple[float, float, float]) -> Directional:
    x, y, z = (np.array(direction) / np.linalg.norm(direction)).tolist()
    return Directional((x, y, z), irradiance, "camera")


def render(
    mesh: Mesh,
    maps: Sequence[Maps],
    shots: Sequence[Shot],
    *,
    frame: Frame,
    spp: int,
    seed: int = 0,
    depth: int = DEPTH,
    cache: Path | None = None,
    progress: Callable[[float], None] = lambda done: None,
) -> list[np.ndarray]:
    """Linear radiance (premultiplied) and coverage, (h, w, 4) float32, of every shot. Environment light takes four
    times the `spp` of a delta light. With `cache`, what was rendered once is read from there."""
    file = cache / f"{_key(mesh, maps, shots, frame, spp, seed, depth)}.npy" if cache else None
    if file is not None and file.is_file():
        return list(np.load(file, allow_pickle=False))
    device.use()
    shapes = object_shapes(mesh, maps, frame=frame)
    result = []
    for k, shot in enumerate(shots):
        result.append(_render(shapes, shot, spp, seed, depth))
        progress((k + 1) / len(shots))
    if file is not None:
        file.parent.mkdir(parents=True, exist_ok=True)
        partial = file.with_suffix(".partial.npy")
        np.save(partial, np.stack(result))
        partial.replace(file)
    return result


def _render(shapes: dict[str, Any], shot: Shot, spp: int, seed: int, depth: int) -> np.ndarray:
    import mitsuba

    mi: Any = mitsuba  # its type stubs know one variant only
    total: Any = None
    for light in shot.lights:
        samples = spp if isinstance(light, Directional) else 4 * spp
        times, each = passes(samples)
        integrator = {"type": "path", "max_depth": depth, "hide_emitters": True}
        scene: Any = mi.load_dict(
            {"type": "scene", "integrator": integrator, "light": emitter(light, shot.camera), **shapes}
        )
        sensor: Any = mi.load_dict(sensor_dict(shot.camera, each, seed))
        picture = np.zeros((*shot.camera.size, 4), np.float32)
        for k in range(times):
            picture += np.array(mi.render(scene, sensor=sensor, spp=each, seed=seed + k * 7919), np.float32) / times
        if total is None:
            total = picture
        else:
            total[..., :3] += picture[..., :3]
    return total


def emitter(light: Light, camera: Camera) -> dict[str, Any]:
    """A Mitsuba emitter for one picture."""
    import mitsuba

    mi: Any = mitsuba
    if isinstance(light, Directional):
        direction = (-direction_in_world(light, camera)).tolist()
        return {"type": "directional", "direction": direction, "irradiance": _rgb(light.irradiance)}
    if isinstance(light, Ambient):
        return {"type": "constant", "radiance": _rgb(light.radiance)}
    if isinstance(light, Environment):
        turn = np.eye(4)
        turn[:3, :3] = turn_about_y(light.turn)
        bitmap = mi.Bitmap(np.ascontiguousarray(light.radiance * np.float32(light.scale), np.float32))
        return {"type": "envmap", "bitmap": bitmap, "to_world": mi.ScalarTransform4f(turn)}
    raise ValueError(f"{type(light).__name__} is not among the benchmark's lights")


def _rgb(colour: Sequence[float]) -> dict[str, Any]:
    return {"type": "rgb", "value": list(colour)}


def sensor_to_world(camera: Camera) -> np.ndarray:
    """The 4 x 4 matrix of a Mitsuba sensor."""
    return camera.world_from_cam @ MITSUBA_FROM_OPENCV


def _key(mesh: Mesh, maps: Sequence[Maps], shots: Sequence[Shot], frame: str, spp: int, seed: int, depth: int) -> str:
    """A hash of everything that decides the pictures."""
    import mitsuba as mi

    digest = hashlib.sha256(repr((mi.__version__, depth, frame, spp, seed, mesh.parts)).encode())

    def add(value: Any) -> None:
        if isinstance(value, np.ndarray):
            digest.update(repr((value.shape, str(value.dtype))).encode())
            digest.update(np.ascontiguousarray(value).tobytes())
        elif isinstance(value, tuple):
            for item in value:
                add(item)
        else:
            digest.update(repr(value).encode())

    add((mesh.positions, mesh.faces, mesh.corner_normals, mesh.corner_uvs, mesh.part))
    for m in maps:
        add((m.albedo, m.normal, m.roughness, m.metallic))
    for shot in shots:
        camera = shot.camera
        add((camera.world_from_cam, camera.focal, camera.centre, camera.size))
        for light in shot.lights:
            add((type(light).__name__, *(value for name, value in vars(light).items() if name != "file")))
    return digest.hexdigest()[:32]
