"""Lights as records, the rigs that `scenes/` describes, and `lights.json`.

`lights.json` (written beside the views, read by the fit) is one object:

    {"version": 1, "axes": "world Y up; camera x right, y down, z forward",
     "lights": [
       {"type": "directional", "direction": [x, y, z], "irradiance": [r, g, b], "frame": "world" | "camera"},
       {"type": "ambient", "radiance": [r, g, b]},
       {"type": "spherical_gaussian", "axis": [x, y, z], "sharpness": s, "amplitude": [r, g, b]},
       {"type": "scene", "file": "studio.xml"}]}

Directions and axes are unit vectors that point TOWARDS the light. Colours are linear Rec.709. `irradiance` is what a
surface that faces the light receives; `radiance` arrives from every direction; a spherical Gaussian (world frame)
sends amplitude · exp(sharpness · (axis · w - 1)) from direction w; "scene" means that only the named Mitsuba scene
file describes the light.
"""

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, TypeGuard
from xml.etree import ElementTree

import numpy as np
from jaxtyping import Float

from mistyle.core.camera import Camera, look_at
from mistyle.core.errors import InputRefused
from mistyle.core.paths import scenes

Colour = tuple[float, float, float]
Vector = tuple[float, float, float]

AXES = "world Y up; camera x right, y down, z forward"


@dataclass(frozen=True)
class Directional:
    """A delta light: unit `direction` towards it, in the world or in the camera's (OpenCV) axes."""

    direction: Vector
    irradiance: Colour
    frame: Literal["world", "camera"] = "world"


@dataclass(frozen=True)
class Ambient:
    """The same radiance from everywhere."""

    radiance: Colour


@dataclass(frozen=True)
class SphericalGaussian:
    """A soft light at infinity: amplitude · exp(sharpness · (axis · w - 1)) from world direction w."""

    axis: Vector
    sharpness: float
    amplitude: Colour


@dataclass(frozen=True)
class SceneLights:
    """Light that only a Mitsuba scene file describes."""

    file: str


Light = Directional | Ambient | SphericalGaussian | SceneLights
Lights = tuple[Light, ...]
NAMES = {
    Directional: "directional",
    Ambient: "ambient",
    SphericalGaussian: "spherical_gaussian",
    SceneLights: "scene",
}


def lights(name: str) -> Lights:
    """The lights of a scene of ours: "paper", "phase1", "phase2", or any other template's name or scene file.

    The numbers stand once: the paper's three spherical Gaussians in `scenes/paper_lights.json`, the lights of both fit
    phases in their scene files. Every other scene is named by its file.
    """
    if name in ("paper", "paper_views"):
        return from_json(json.loads((scenes() / "paper_lights.json").read_text(encoding="utf-8")), "paper_lights.json")
    if name in ("phase1", "phase1_directional"):
        return _lights_of_xml(scenes() / "phase1_directional.xml")
    if name in ("phase2", "phase2_ambient"):
        return _lights_of_xml(scenes() / "phase2_ambient.xml")
    return (SceneLights(name if name.endswith(".xml") else f"{name}.xml"),)


def direction_in_world(light: Directional, camera: Camera) -> Float[np.ndarray, "3"]:
    """Unit vector towards the light in the world, for a light fixed to the world or to `camera`."""
    direction = np.asarray(light.direction, float)
    return camera.world_from_cam[:3, :3] @ direction if light.frame == "camera" else direction


def spherical_gaussian(light: SphericalGaussian, directions: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
    """Radiance from unit world directions."""
    lobe = np.exp(light.sharpness * (directions @ np.asarray(light.axis) - 1))
    return lobe[..., None] * np.asarray(light.amplitude)


def environment_directions(height: int, width: int) -> Float[np.ndarray, "h w 3"]:
    """World direction of every pixel of a latitude-longitude map as Mitsuba's `envmap` reads it.

    Row 0 is straight up (+Y), the last row straight down; the middle looks along +Z, the columns to the right of it
    towards -X, each pixel's direction through the middle of its column.
    """
    theta = np.arange(height) / (height - 1) * np.pi
    phi = (np.arange(width) + 0.5) / width * 2 * np.pi
    sin, cos = np.sin(theta)[:, None], np.cos(theta)[:, None]
    return np.stack([np.sin(phi) * sin, np.broadcast_to(cos, (height, width)), -np.cos(phi) * sin], axis=-1)


def bake_environment(rig: Sequence[Light], height: int = 128) -> Float[np.ndarray, "h w 3"]:
    """Latitude-longitude radiance (width twice the height) of spherical Gaussians and ambient light."""
    directions = environment_directions(height, 2 * height)
    total = np.zeros(directions.shape)
    for light in rig:
        if isinstance(light, SphericalGaussian):
            total += spherical_gaussian(light, directions)
        elif isinstance(light, Ambient):
            total += np.asarray(light.radiance)
        else:
            raise ValueError(f"cannot bake {type(light).__name__} into an environment map")
    return total.astype(np.float32)


def to_json(rig: Lights) -> dict[str, Any]:
    """The content of `lights.json`."""
    return {"version": 1, "axes": AXES, "lights": [{"type": NAMES[type(light)], **_plain(light)} for light in rig]}


def from_json(data: dict[str, Any], where: str = "lights.json") -> Lights:
    """Read `lights.json`'s content; InputRefused names the entry that is wrong. Directions are normalised."""
    entries = data.get("lights") if isinstance(data, dict) else None
    if not isinstance(entries, list):
        raise InputRefused(f'{where}: expected an object with a list "lights"; see the schema in the README.')
    return tuple(_light(entry, f"{where}: lights[{k}]") for k, entry in enumerate(entries))


def _plain(light: Light) -> dict[str, Any]:
    return {key: list(value) if isinstance(value, tuple) else value for key, value in vars(light).items()}


def _light(entry: Any, where: str) -> Light:
    kind = entry.get("type") if isinstance(entry, dict) else None
    if kind == "directional":
        frame = entry.get("frame", "world")
        if frame not in ("world", "camera"):
            raise InputRefused(f'{where}: frame is {frame!r}; expected "world" or "camera".')
        return Directional(_unit(entry, "direction", where), _triple(entry, "irradiance", where, 0.0), frame)
    if kind == "ambient":
        return Ambient(_triple(entry, "radiance", where, 0.0))
    if kind == "spherical_gaussian":
        sharpness = entry.get("sharpness")
        if not _number(sharpness) or not 0 <= sharpness < 1e6:
            raise InputRefused(f"{where}: sharpness is {sharpness!r}; expected a number from 0 to a million.")
        axis, amplitude = _unit(entry, "axis", where), _triple(entry, "amplitude", where, 0.0)
        return SphericalGaussian(axis, float(sharpness), amplitude)
    if kind == "scene" and isinstance(entry.get("file"), str):
        return SceneLights(entry["file"])
    raise InputRefused(f"{where}: type is {kind!r}; expected directional, ambient, spherical_gaussian or scene.")


def _triple(entry: dict, key: str, where: str, least: float = -math.inf) -> Vector:
    value = entry.get(key)
    if not isinstance(value, list) or len(value) != 3 or not all(_number(v) and v >= least for v in value):
        expected = f"three finite numbers{' >= 0' if least == 0 else ''}"
        raise InputRefused(f"{where}: {key} is {value!r}; expected {expected}.")
    return (float(value[0]), float(value[1]), float(value[2]))


def _number(value: Any) -> TypeGuard[float]:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _unit(entry: dict, key: str, where: str) -> Vector:
    vector = np.asarray(_triple(entry, key, where))
    length = float(np.linalg.norm(vector))
    if length < 1e-9:
        raise InputRefused(f"{where}: {key} has no length.")
    # What is a unit vector already keeps its bits, so that writing and reading again changes nothing.
    x, y, z = (vector if abs(length - 1) < 1e-12 else vector / length).tolist()
    return (x, y, z)


def _numbers(element: ElementTree.Element, tag: str, name: str) -> list[float]:
    found = element.find(f"{tag}[@name='{name}']")
    values = [float(v) for v in (found.get("value", "") if found is not None else "").replace(",", " ").split()]
    return values * 3 if len(values) == 1 else values


def _lights_of_xml(path: Path) -> Lights:
    """Directional and constant emitters of one of our own scene files; ids "camera_…" belong to the camera's frame."""
    root = ElementTree.parse(path).getroot()
    view = root.find("sensor/transform/lookat")
    if view is None:
        raise ValueError(f"{path}: the sensor needs a lookat")
    origin, target = ([float(v) for v in view.get(key, "").replace(",", " ").split()] for key in ("origin", "target"))
    to_camera = look_at(origin, target, fov=30.0, size=(1, 1)).world_from_cam[:3, :3].T
    rig: list[Light] = []
    for emitter in root.findall("emitter"):
        if emitter.get("type") == "constant":
            red, green, blue = _numbers(emitter, "rgb", "radiance")
            rig.append(Ambient((red, green, blue)))
        elif emitter.get("type") == "directional":
            # Mitsuba's direction is the way the light travels.
            towards = -np.asarray(_numbers(emitter, "vector", "direction"))
            towards /= np.linalg.norm(towards)
            fixed = emitter.get("id", "").startswith("camera_")
            x, y, z = (to_camera @ towards if fixed else towards).tolist()
            red, green, blue = _numbers(emitter, "rgb", "irradiance")
            rig.append(Directional((x, y, z), (red, green, blue), "camera" if fixed else "world"))
    return tuple(rig)
