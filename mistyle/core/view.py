"""Rendered views, and the prior colour from earlier views."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from mistyle.core.camera import Camera


@dataclass(frozen=True)
class View:
    """One rendered or stylized picture with its geometry.

    rgb       linear Rec.709, black off the mesh
    depth     metric z in the camera at the pixel centre, infinite off the mesh
    normal    unit shading normal in world space, zero off the mesh
    uv        texture coordinates of the pixel centre (v up), zero off the mesh
    part      which texture set the pixel belongs to, -1 off the mesh
    mask      whether the ray through the pixel centre hits the mesh
    coverage  share of the pixel that the mesh covers, 0..1 (antialiased twin of the mask)
    """

    camera: Camera
    rgb: Float[np.ndarray, "h w 3"]
    depth: Float[np.ndarray, "h w"]
    normal: Float[np.ndarray, "h w 3"]
    uv: Float[np.ndarray, "h w 2"]
    part: Int[np.ndarray, "h w"]
    mask: Bool[np.ndarray, "h w"]
    coverage: Float[np.ndarray, "h w"]


@dataclass(frozen=True)
class Prior:
    """Colour of the next view from the views painted so far: linear Rec.709, and the mask of known pixels."""

    rgb: Float[np.ndarray, "h w 3"]
    known: Bool[np.ndarray, "h w"]
