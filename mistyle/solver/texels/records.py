"""Inputs and outputs of the per-texel solver (`texels/levenberg_marquardt.py`)."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int, Integer

UNKNOWNS = ("albedo_r", "albedo_g", "albedo_b", "tilt_x", "tilt_y", "roughness", "metallic")


@dataclass(frozen=True)
class Points:
    """Surface points of t texels: position and tangent frame (rows: tangent, bitangent, normal; unit), in the world.

    open  bit k % 32 of word k // 32 is set where cell k of the sky reaches the point; None without soft light
    """

    position: Float[np.ndarray, "t 3"]
    frame: Float[np.ndarray, "t 3 3"]
    open: Integer[np.ndarray, "t w"] | None = None


@dataclass(frozen=True)
class Rig:
    """Cameras and lights of pictures. Picture v has the lights first[v] : first[v + 1].

    eye         world position of the camera
    vector      unit direction towards the light, or the light's position where `near`, in the world
    near        1 for a point light, whose irradiance is that at distance 1
    irradiance  linear Rec.709
    cells       index of picture v's first light that is a cell of the sky; cells follow in order; None without soft
    light width2      of such a cell, see `sky.EnvironmentCells`; 0 for other lights
    """

    eye: Float[np.ndarray, "v 3"]
    first: Int[np.ndarray, " v1"]
    vector: Float[np.ndarray, "l 3"]
    near: Float[np.ndarray, " l"]
    irradiance: Float[np.ndarray, "l 3"]
    cells: Int[np.ndarray, " v"] | None = None
    width2: Float[np.ndarray, " l"] | None = None

    @property
    def single(self) -> bool:
        """Whether every picture has exactly one light, a delta light."""
        return self.cells is None and bool((np.diff(self.first) == 1).all())


@dataclass(frozen=True)
class Observations:
    """Observations of t texels, sorted by texel: those of texel i are start[i] : start[i + 1].

    rgb     linear radiance from the texel towards the camera
    weight  1 / its standard deviation
    lit     bit l is set where light l of the picture (counted within the picture) reaches the texel; cells of the sky
    use
            the points' `open` instead
    """

    start: Int[np.ndarray, " t1"]
    picture: Int[np.ndarray, " o"]
    rgb: Float[np.ndarray, "o 3"]
    weight: Float[np.ndarray, " o"]
    lit: Integer[np.ndarray, " o"]


@dataclass(frozen=True)
class Solution:
    """`values` (t, 7) in the order of UNKNOWNS; `cost` without the prior; `spread` (t, 7), standard deviations.

    spread² is the diagonal of the inverse of normal matrix + prior: the posterior variance. `diagonal` is that of the
    normal matrix alone, `prior` the given weights.
    """

    values: Float[np.ndarray, "t 7"]
    cost: Float[np.ndarray, " t"]
    spread: Float[np.ndarray, "t 7"]
    diagonal: Float[np.ndarray, "t 7"]
    prior: Float[np.ndarray, "t 7"]


@dataclass(frozen=True)
class Options:
    """Options of the solver. `huber` is in standard deviations; `floor` is the least roughness; `tilt` bounds |tilt|.

    With `metallic` False metallic keeps its value. `differences` selects central differences instead of AD.
    """

    model: str = "principled"
    metallic: bool = False
    huber: float = 3.0
    floor: float = 0.04
    tilt: float = 0.95
    differences: bool = False
