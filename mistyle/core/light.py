"""Lights as records, the rigs that `scenes/` describes, and `lights.json`.

`lights.json` (written beside the views, read by the fit) is one object; a light is in one of six forms:

    {"version": 1, "axes": "world Y up; camera x right, y down, z forward",
     "lights": [
       {"type": "directional", "direction": [x, y, z], "irradiance": [r, g, b], "frame": "world" | "camera"},
       {"type": "point", "position": [x, y, z], "intensity": [r, g, b], "frame": "world" | "camera"},
       {"type": "environment", "file": "studio.hdr", "turn": degrees, "scale": s},
       {"type": "ambient", "radiance": [r, g, b]},
       {"type": "spherical_gaussian", "axis": [x, y, z], "sharpness": s, "amplitude": [r, g, b]},
       {"type": "scene", "file": "studio.xml"}],
     "views": {"name of a view": [light, ...]}}

`lights` shine in every view that `views` does not name; a view that it names has its own list instead. One of the two
is enough. "frame" is "world" where it is left out, "turn" 0 and "scale" 1.

Directions and axes are unit vectors that point TOWARDS the light. Colours are linear Rec.709. `irradiance` is what a
surface that faces the light receives; a point light of `intensity` i at distance d gives irradiance i / d²; one at the
camera's origin is a co-located flash; `radiance` arrives from every direction; an environment is a latitude-longitude
picture of linear radiance times `scale` in the layout of `environment_directions`, turned by `turn` degrees about +Y
(from +Z towards +X); its file (.exr or .hdr) lies beside `lights.json`; a spherical Gaussian (world
frame) sends amplitude · exp(sharpness · (axis · w - 1)) from direction w; "scene" means that only the named Mitsuba
scene file describes the light. The world is the cameras' world, and lengths are in its units.
"""

import json
import math
import reprlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, TypeGuard
from xml.etree import ElementTree

import numpy as np
from jaxtyping import Float

from mistyle.core.camera import Camera, look_at
from mistyle.core.errors import InputRefused
from mistyle.core.image import bilinear
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
class Point:
    """A delta light at a place, in the world or in the camera's (OpenCV) axes; (0, 0, 0) there is a co-located flash.

    Irradiance of a surface that faces it from distance d is intensity / d². Lengths are working units.
    """

    position: Vector
    intensity: Colour
    frame: Literal["world", "camera"] = "world"


@dataclass(frozen=True, eq=False)
class Environment:
    """Light from infinitely far, by a latitude-longitude map of linear radiance (rows of `environment_directions`).

    `turn` rotates the map about +Y by degrees, from +Z towards +X. `file` is its source, for `lights.json`.
    """

    radiance: Float[np.ndarray, "eh ew 3"]
    turn: float = 0.0
    scale: float = 1.0
    file: str = ""


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


Light = Directional | Point | Environment | Ambient | SphericalGaussian | SceneLights
Lights = tuple[Light, ...]
DELTA = (Directional, Point)
SOFT = (Environment, Ambient, SphericalGaussian)
# Gives the radiance of an environment's file, as named in lights.json.
Load = Callable[[str], Float[np.ndarray, "eh ew 3"]]
NAMES = {
    Directional: "directional",
    Point: "point",
    Environment: "environment",
    Ambient: "ambient",
    SphericalGaussian: "spherical_gaussian",
    SceneLights: "scene",
}


def has_soft(many: Iterable[Lights]) -> bool:
    """Whether any of the lights is SOFT."""
    return any(isinstance(light, SOFT) for lights in many for light in lights)


def lights(name: str) -> Lights:
    """The lights of a scene of ours: "paper", "phase1", "phase2", or any other template's name or scene file.

    The numbers are stored once: the paper's three spherical Gaussians in `scenes/paper_lights.json`, the lights of both
    fit phases in their scene files. Every other scene is named by its file.
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


def position_in_world(light: Point, camera: Camera) -> Float[np.ndarray, "3"]:
    """World position of a point light that is fixed to the world or to `camera`."""
    position = np.asarray(light.position, float)
    return camera.world_from_cam[:3, :3] @ position + camera.position if light.frame == "camera" else position


def spherical_gaussian(light: SphericalGaussian, directions: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
    """Radiance from unit world directions."""
    lobe = np.exp(light.sharpness * (directions @ np.asarray(light.axis) - 1))
    return lobe[..., None] * np.asarray(light.amplitude)


def environment_radiance(light: Environment, directions: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
    """Radiance from unit world directions: the turned map's bilinear value, times its scale."""
    height, width = light.radiance.shape[:2]
    x, y, z = np.moveaxis(np.asarray(directions, float) @ turn_about_y(light.turn), -1, 0)
    # Rows lie at theta = 0 .. pi, the first and the last at the poles; columns' middles are half a column in.
    row = np.arccos(np.clip(y, -1, 1)) / np.pi * (height - 1) + 0.5
    column = np.arctan2(x, -z) / (2 * np.pi) % 1.0 * width
    padded = np.concatenate([light.radiance[:, -1:], light.radiance, light.radiance[:, :1]], axis=1)
    px = np.stack([column + 1, row], axis=-1).reshape(-1, 2)
    return bilinear(padded.astype(np.float32), px).reshape(directions.shape) * np.float32(light.scale)


def turn_about_y(degrees: float) -> Float[np.ndarray, "3 3"]:
    """The rotation about +Y that takes +Z towards +X; columns are the turned axes."""
    cos, sin = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    return np.array([[cos, 0, sin], [0, 1, 0], [-sin, 0, cos]])


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
    """Latitude-longitude radiance (width twice the height) of soft lights; ValueError for others."""
    return soft_radiance(rig, environment_directions(height, 2 * height)).astype(np.float32)


def soft_radiance(rig: Sequence[Light], directions: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
    """Radiance of soft lights from unit world directions; ValueError for other lights."""
    total = np.zeros(directions.shape)
    for light in rig:
        if isinstance(light, SphericalGaussian):
            total += spherical_gaussian(light, directions)
        elif isinstance(light, Ambient):
            total += np.asarray(light.radiance)
        elif isinstance(light, Environment):
            total += environment_radiance(light, directions)
        else:
            raise ValueError(f"{type(light).__name__} is not a soft light")
    return total


def to_json(rig: Lights, views: Mapping[str, Lights] | None = None) -> dict[str, Any]:
    """The content of `lights.json`; `views` names the views that have lights of their own.

    An environment is written by its file's name; ValueError where it has none.
    """
    own = {"views": {name: _plain(lights) for name, lights in views.items()}} if views else {}
    return {"version": 1, "axes": AXES, "lights": _plain(rig), **own}


def from_json(data: dict[str, Any], where: str = "lights.json", load: Load | None = None) -> Lights:
    """The lights of `lights.json`'s content; InputRefused names the entry that is wrong. Directions are normalised.

    `load` reads the file that an environment names; without it environments are refused. Lights of single views are
    ignored here (`lights_of_views`).
    """
    return _list(data.get("lights"), f"{where}: lights", load)


def lights_of_views(
    data: dict[str, Any], names: Sequence[str], where: str = "lights.json", load: Load | None = None
) -> tuple[Lights, ...]:
    """The lights of each of the views `names`, from the lists "views" and "lights".

    InputRefused: a view without lights; and, where a common list would hide the mistake, a name in "views" that none of
    the views has.
    """
    own = data.get("views", {})
    if not isinstance(own, dict):
        raise InputRefused(f'{where}: "views" is a {type(own).__name__}; expected an object: view name -> [lights].')
    common = from_json(data, where, load) if "lights" in data or not own else None
    unknown = sorted(set(own) - set(names))
    if unknown and common is not None:
        raise InputRefused(
            f'{where}: "views" names {unknown[0]!r}, which is not one of the {len(names)} views ({names[0]!r}, ...). '
            "Write the view's name as in the camera file."
        )
    missing = [name for name in names if name not in own]
    if common is None and missing:
        raise InputRefused(
            f"{where}: no lights for the view {missing[0]!r} ({len(missing)} of {len(names)} views have none). "
            'Add it to "views", or write "lights" for all views that are not named there.'
        )
    read = {name: _list(own[name], f"{where}: views[{name!r}]", load) for name in names if name in own}
    return tuple(read[name] if name in read else common or () for name in names)


def _plain(rig: Lights) -> list[dict[str, Any]]:
    return [{"type": NAMES[type(light)], **_fields(light)} for light in rig]


def _fields(light: Light) -> dict[str, Any]:
    if isinstance(light, Environment):
        if not light.file:
            raise ValueError("an environment without a file's name cannot be written to lights.json")
        return {"file": light.file, "turn": light.turn, "scale": light.scale}
    return {key: list(value) if isinstance(value, tuple) else value for key, value in vars(light).items()}


def _list(entries: Any, where: str, load: Load | None) -> Lights:
    if not isinstance(entries, list):
        file, _, key = where.rpartition(": ")
        raise InputRefused(f"{file}: expected an object with a list at {key}; found {type(entries).__name__}.")
    return tuple(_light(entry, f"{where}[{k}]", load) for k, entry in enumerate(entries))


def _light(entry: Any, where: str, load: Load | None) -> Light:
    kind = entry.get("type") if isinstance(entry, dict) else None
    if kind == "directional":
        colour = _triple(entry, "irradiance", where, 0.0)
        return Directional(_unit(entry, "direction", where), colour, _frame(entry, where))
    if kind == "point":
        colour = _triple(entry, "intensity", where, 0.0)
        return Point(_triple(entry, "position", where), colour, _frame(entry, where))
    if kind == "environment":
        return _environment(entry, where, load)
    if kind == "ambient":
        return Ambient(_triple(entry, "radiance", where, 0.0))
    if kind == "spherical_gaussian":
        sharpness = entry.get("sharpness")
        if not _number(sharpness) or not 0 <= sharpness < 1e6:
            raise InputRefused(f"{where}: sharpness is {_quoted(sharpness)}; expected a number from 0 to a million.")
        axis, amplitude = _unit(entry, "axis", where), _triple(entry, "amplitude", where, 0.0)
        return SphericalGaussian(axis, float(sharpness), amplitude)
    if kind == "scene" and isinstance(entry.get("file"), str):
        return SceneLights(entry["file"])
    raise InputRefused(f"{where}: type is {_quoted(kind)}; expected one of {', '.join(NAMES.values())}.")


def _frame(entry: dict, where: str) -> Literal["world", "camera"]:
    frame = entry.get("frame", "world")
    if frame not in ("world", "camera"):
        raise InputRefused(f'{where}: frame is {_quoted(frame)}; expected "world" or "camera".')
    return frame


def _environment(entry: dict, where: str, load: Load | None) -> Environment:
    file, turn, scale = entry.get("file"), entry.get("turn", 0.0), entry.get("scale", 1.0)
    if not isinstance(file, str) or not file or load is None:
        expected = "lights without files here" if load is None else "the name of an .exr or .hdr beside lights.json"
        raise InputRefused(f"{where}: file is {_quoted(file)}; expected {expected}.")
    if not _number(turn) or not _number(scale) or scale < 0:
        raise InputRefused(
            f"{where}: turn is {_quoted(turn)}, scale is {_quoted(scale)}; expected degrees and a number >= 0."
        )
    return Environment(load(file), float(turn), float(scale), file)


def _triple(entry: dict, key: str, where: str, least: float = -math.inf) -> Vector:
    value = entry.get(key)
    if not isinstance(value, list) or len(value) != 3 or not all(_number(v) and v >= least for v in value):
        expected = f"three finite numbers{' >= 0' if least == 0 else ''}"
        raise InputRefused(f"{where}: {key} is {_quoted(value)}; expected {expected}.")
    return (float(value[0]), float(value[1]), float(value[2]))


def _quoted(value: Any) -> str:
    """A file's value, shortened for an error message."""
    return reprlib.repr(value)[:120]


def _number(value: Any) -> TypeGuard[float]:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _unit(entry: dict, key: str, where: str) -> Vector:
    vector = np.asarray(_triple(entry, key, where))
    length = math.hypot(*vector)
    if not 1e-9 <= length < 1e150:
        raise InputRefused(f"{where}: {key} has the length {length:g}; expected a direction.")
    # A unit vector keeps its bits, so that writing and reading again changes nothing.
    x, y, z = (vector if abs(length - 1) < 1e-12 else vector / length).tolist()
    return (x, y, z)


def _numbers(element: ElementTree.Element, tag: str, name: str) -> list[float]:
    child = element.find(f"{tag}[@name='{name}']")
    values = [float(v) for v in (child.get("value", "") if child is not None else "").replace(",", " ").split()]
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
            # Mitsuba's direction is the direction of travel of the light.
            towards = -np.asarray(_numbers(emitter, "vector", "direction"))
            towards /= np.linalg.norm(towards)
            fixed = emitter.get("id", "").startswith("camera_")
            x, y, z = (to_camera @ towards if fixed else towards).tolist()
            red, green, blue = _numbers(emitter, "rgb", "irradiance")
            rig.append(Directional((x, y, z), (red, green, blue), "camera" if fixed else "world"))
    return tuple(rig)
