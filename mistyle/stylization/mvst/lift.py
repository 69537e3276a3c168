"""Lifting of finished views to coloured surface points, which `stylization/mvst/warp.py` warps into other views."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from mistyle.core.camera import Camera
from mistyle.core.image import dilate
from mistyle.core.view import View
from mistyle.stylization.mvst.settings import WarpSettings

STEEP = 4.0  # depth per width of a surface seen at 76 degrees
NEAR_EDGE = 3  # pixels about a depth step of the source in which a rim counts as one of occlusion
PURE = 0.995  # coverage from which a pixel shows one surface only


@dataclass(frozen=True)
class Lifted:
    """The pixels of one view that may be warped, lifted to the surface.

    points     world positions, one column a pixel
    colour     linear Rec.709
    near_edge  whether a depth discontinuity of the view is within a few pixels
    cosine     between the normal and the line to the camera, 1 where the view has no normals
    pixel      flat pixel index of each point in the view
    picture    colour, depth and validity (0 or 1) of the view's lifted pixels, zero elsewhere
    """

    camera: Camera
    points: Float[np.ndarray, "3 n"]
    colour: Float[np.ndarray, "n 3"]
    near_edge: Bool[np.ndarray, " n"]
    cosine: Float[np.ndarray, " n"]
    pixel: Int[np.ndarray, " n"]
    picture: Float[np.ndarray, "h w 5"]


def lift(view: View, settings: WarpSettings, mask: Bool[np.ndarray, "h w"] | None = None) -> Lifted:
    """The foreground of a finished view as coloured points.

    Excluded are pixels off `mask` (default: the view's), pixels of mixed colour (partly covered, or beside a depth
    step) and those with a cosine under `settings.facing`. The view needs its depth; without normals the angle is
    ignored.
    """
    usable = view.mask & np.isfinite(view.depth) & (view.depth > 0) & (view.coverage > PURE)
    if mask is not None:
        usable &= mask
    steps = discontinuities(view, settings)
    usable &= ~steps
    rows, columns = np.nonzero(usable)
    flat = rows * view.depth.shape[1] + columns
    depth = view.depth.reshape(-1)[flat]
    camera = view.camera
    x = (columns + (0.5 - camera.centre[0])).astype(np.float32) * depth / np.float32(camera.focal)
    y = (rows + (0.5 - camera.centre[1])).astype(np.float32) * depth / np.float32(camera.focal)
    points = transformed(camera.world_from_cam, np.stack([x, y, depth]))
    near_edge = dilate(steps | ~view.mask, NEAR_EDGE).reshape(-1)[flat]
    colour = view.rgb.reshape(-1, 3)[flat]
    cosine = cosines(camera, points, view.normal.reshape(-1, 3)[flat].T)
    seen = cosine >= settings.facing
    if not seen.all():
        points, colour, near_edge, cosine = points[:, seen], colour[seen], near_edge[seen], cosine[seen]
        flat = flat[seen]
    picture = np.zeros((*view.depth.shape, 5), np.float32)
    own = view.depth.reshape(-1)[flat]
    picture.reshape(-1, 5)[flat] = np.concatenate([colour, np.stack([own, np.ones_like(own)], axis=1)], axis=1)
    return Lifted(camera, np.ascontiguousarray(points), colour, near_edge, cosine, flat, picture)


def transformed(matrix: Float[np.ndarray, "r 4"], points: Float[np.ndarray, "3 n"]) -> Float[np.ndarray, "3 n"]:
    """The first three rows of an affine or projective map, applied to points.

    Written out: a threaded matrix product would make the last bit depend on the machine's load.
    """
    m = matrix.astype(points.dtype)
    x, y, z = points
    return np.stack([m[r, 0] * x + m[r, 1] * y + m[r, 2] * z + m[r, 3] for r in range(3)])


def cosines(
    camera: Camera, points: Float[np.ndarray, "3 n"], normals: Float[np.ndarray, "3 n"]
) -> Float[np.ndarray, " n"]:
    """|cosine| between normals and the lines to the camera; 1 where a normal is zero."""
    ray = camera.position.astype(np.float32)[:, None] - points
    along = np.abs(ray[0] * normals[0] + ray[1] * normals[1] + ray[2] * normals[2])
    cosine = along / np.sqrt(ray[0] * ray[0] + ray[1] * ray[1] + ray[2] * ray[2])
    cosine[~normals.any(axis=0)] = 1
    return cosine


def depth_tolerance(camera: Camera, depth: np.ndarray, settings: WarpSettings) -> Float[np.ndarray, "..."]:
    """Largest depth difference of one surface within a pixel: the setting, or a steep surface's change."""
    return np.maximum(np.float32(settings.depth_tolerance), depth * np.float32(STEEP / camera.focal))


def discontinuities(view: View, settings: WarpSettings) -> Bool[np.ndarray, "h w"]:
    """Pixels of the mesh with a depth step, or background, at one of their four neighbours."""
    depth = np.where(view.mask, view.depth, np.inf).astype(np.float32)
    result = np.zeros(depth.shape, bool)
    for marks, values in ((result, depth), (result.T, depth.T)):
        low, high = np.minimum(values[1:], values[:-1]), np.maximum(values[1:], values[:-1])
        with np.errstate(invalid="ignore"):  # infinity minus infinity: background on both sides
            step = high - low > depth_tolerance(view.camera, low, settings)
        marks[1:] |= step
        marks[:-1] |= step
    return result & view.mask
