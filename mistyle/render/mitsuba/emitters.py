"""Light records as Mitsuba emitters."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from mistyle.core.camera import Camera
from mistyle.core.light import (
    SOFT,
    Ambient,
    Directional,
    Environment,
    Light,
    Point,
    bake_environment,
    direction_in_world,
    position_in_world,
)
from mistyle.render.mitsuba.device import mi

ROWS = 256  # rows of the map that combines several soft lights


def emitters(lights: Sequence[Light], camera: Camera) -> list[dict[str, Any]]:
    """Emitter dictionaries of a picture's lights, in the world, for a picture of `camera`; linear Rec.709.

    A Mitsuba scene has at most one environment and no spherical Gaussians. Soft lights other than a single map or
    ambient light are baked into one map of ROWS rows. Raises ValueError for a light that only a scene file describes.
    """
    soft = [light for light in lights if isinstance(light, SOFT)]
    result = [_delta(light, camera) for light in lights if not isinstance(light, SOFT)]
    if len(soft) == 1 and isinstance(soft[0], Ambient):
        result.append({"type": "constant", "radiance": _colour(soft[0].radiance)})
    elif len(soft) == 1 and isinstance(soft[0], Environment):
        result.append(_map(soft[0].radiance * np.float32(soft[0].scale), soft[0].turn))
    elif soft:
        finest = max((len(light.radiance) for light in soft if isinstance(light, Environment)), default=0)
        result.append(_map(bake_environment(soft, max(ROWS, finest)), 0.0))
    return result


def _delta(light: Light, camera: Camera) -> dict[str, Any]:
    if isinstance(light, Directional):
        towards = direction_in_world(light, camera)
        return {"type": "directional", "direction": (-towards).tolist(), "irradiance": _colour(light.irradiance)}
    if isinstance(light, Point):
        position = position_in_world(light, camera)
        return {"type": "point", "position": position.tolist(), "intensity": _colour(light.intensity)}
    raise ValueError(f"{type(light).__name__} cannot be an emitter of a scene")


def _colour(values: Any) -> dict[str, Any]:
    return {"type": "rgb", "value": [float(v) for v in values]}


def _map(radiance: np.ndarray, turn: float) -> dict[str, Any]:
    bitmap = mi.Bitmap(np.ascontiguousarray(radiance, np.float32))
    return {"type": "envmap", "bitmap": bitmap, "to_world": mi.ScalarTransform4f().rotate([0, 1, 0], float(turn))}
