"""Shared surface points of two views, compared at the coarser of their pixels.

A pixel shows the mean over its footprint on the surface. Where one view sees a place from nearer or less obliquely than
the other, its pixels are finer, and two consistent pictures of one painting differ there. Each picture is therefore
averaged over the other's pixel where that is larger: its footprint under the Jacobian of the mapping (Heckbert,
Fundamentals of Texture Mapping and Image Warping, 1989).
"""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float

from mistyle.core.camera import Camera, in_frame, pixel_centres, px_from_world, world_from_px
from mistyle.core.image import erode
from mistyle.core.view import View

DEPTH_TOLERANCE = 0.01  # working units: two views see the same point
INSIDE = 3  # excluded pixels at the rim of a mask: mixed colours, and pixels whose lookups would reach them
FLAT = 0.05  # least cosine between normal and ray; more oblique surfaces are clamped
WIDEST = 4.0  # pixels; wider footprints are clipped, since they would reach over the rim
LOOKS = 4  # lookups along either axis of a footprint


@dataclass(frozen=True)
class Overlap:
    """The n surface points that both views see.

    both                       mask of these pixels in the first view, in row order
    here, there                their positions in the two pictures, in pixels (centres at +0.5)
    around_here, around_there  columns: half-axes of the lookups' footprint there, in pixels; 0 where pixels are not
    finer
    """

    both: Bool[np.ndarray, "h w"]
    here: Float[np.ndarray, "n 2"]
    there: Float[np.ndarray, "n 2"]
    around_here: Float[np.ndarray, "n 2 2"]
    around_there: Float[np.ndarray, "n 2 2"]


def overlap(view: View, other: View) -> Overlap:
    """The pixels of `view`, INSIDE from the rim of its mask, whose surface points `other` also sees INSIDE its own
    mask, at a depth that agrees within DEPTH_TOLERANCE. A pixel without a normal is assumed to face its camera."""
    chosen = erode(view.mask, INSIDE)
    here, depth = pixel_centres(view.camera.size)[chosen], view.depth[chosen].astype(np.float64)
    there, z = px_from_world(other.camera, world_from_px(view.camera, here, depth))
    seen, both = _visible_in(other, there, z), np.zeros(chosen.shape, bool)
    both[chosen] = seen
    here, there, depth = here[seen], there[seen], depth[seen]
    steps = pixel_steps(view.camera, other.camera, here, depth, view.normal[both])
    (a, b), (c, d) = np.moveaxis(steps, 0, -1)
    area = a * d - b * c
    area = np.where(np.abs(area) > 1e-6, area, 1e-6)
    back = np.moveaxis(np.array([[d, -b], [-c, a]]) / area, -1, 0)
    return Overlap(both, here, there, _axes(back), _axes(steps))


def seen_here(shared: Overlap, picture: Float[np.ndarray, "h w c"]) -> Float[np.ndarray, "n c"]:
    """The first view's picture, of up to four channels, at the shared points."""
    return _means(picture, shared.here, shared.around_here)


def seen_there(shared: Overlap, picture: Float[np.ndarray, "h w c"]) -> Float[np.ndarray, "n c"]:
    """The other view's picture, of up to four channels, at the shared points."""
    return _means(picture, shared.there, shared.around_there)


def pixel_steps(
    camera: Camera,
    other: Camera,
    px: Float[np.ndarray, "n 2"],
    depth: Float[np.ndarray, " n"],
    normal: Float[np.ndarray, "n 3"],
) -> Float[np.ndarray, "n 2 2"]:
    """The Jacobian of pixels of `other` by pixels of `camera` at surface points with these depths and normals.

    A point P = z d on the plane n.P = const moves by dP = z d' - z (n.d' / n.d) d when its pixel does, d' = e / f.
    """
    d = np.concatenate([(px - np.asarray(camera.centre)) / camera.focal, np.ones((len(px), 1))], axis=1)
    n = normal.astype(np.float64) @ camera.cam_from_world[:3, :3].T
    n = np.where(n.any(axis=1, keepdims=True), n, -d / np.linalg.norm(d, axis=1, keepdims=True))
    along = (n * d).sum(axis=1)
    along = np.where(np.abs(along) < FLAT, np.copysign(FLAT, along), along)
    move = -(n[:, None, :2] / along[:, None, None]) * d[:, :, None]  # -n_k d / (n.d), one column for each k
    move[:, :2] += np.eye(2)
    move *= (depth / camera.focal)[:, None, None]
    over = other.cam_from_world @ camera.world_from_cam
    p, move = (d * depth[:, None]) @ over[:3, :3].T + over[:3, 3], over[:3, :3] @ move
    u = p[:, :2, None] / p[:, 2:, None]
    return other.focal * (move[:, :2] - u * move[:, 2:]) / p[:, 2:, None]


def _axes(steps: Float[np.ndarray, "n 2 2"]) -> Float[np.ndarray, "n 2 2"]:
    """Axes that widen a pixel to the footprint of one step: the square root of J J' - 1, with its eigenvalues clipped
    to 0 .. WIDEST."""
    square = steps @ steps.transpose(0, 2, 1)
    a, b, c = square[:, 0, 0], square[:, 0, 1], square[:, 1, 1]
    mean, half = (a + c) / 2, np.hypot((a - c) / 2, b)
    turn = np.arctan2(2 * b, a - c) / 2
    long, short = (np.sqrt(np.clip(each - 1, 0, WIDEST**2 - 1)) for each in (mean + half, mean - half))
    rows = [np.cos(turn) * long, -np.sin(turn) * short], [np.sin(turn) * long, np.cos(turn) * short]
    return np.moveaxis(np.array(rows), -1, 0)


def _means(picture: np.ndarray, px: np.ndarray, axes: np.ndarray) -> Float[np.ndarray, "n c"]:
    """Means of LOOKS x LOOKS lookups over the parallelogram of `axes` around `px`.

    Bicubic: bilinear lookups blur, and every sharp picture would appear inconsistent. Bicubic ones overshoot at edges,
    and OpenCV rounds positions to 1/32 pixel.
    """
    # OpenCV's maps have at least one row, and at most 32,767 rows and columns.
    count, width = len(px), 4096
    places = np.zeros((count // width + 1, width, 2), np.float32)
    flat, total = np.ascontiguousarray(picture, np.float32), np.zeros((count, picture.shape[2]), np.float32)
    offsets = (np.arange(LOOKS) + 0.5) / LOOKS - 0.5
    for step in np.stack(np.meshgrid(offsets, offsets), axis=-1).reshape(-1, 2):
        places.reshape(-1, 2)[:count] = px - 0.5 + axes @ step
        x, y = places[..., 0].copy(), places[..., 1].copy()
        values = cv2.remap(flat, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
        total += values.reshape(-1, picture.shape[2])[:count]
    return total / LOOKS**2


def _visible_in(view: View, px: Float[np.ndarray, "n 2"], z: Float[np.ndarray, " n"]) -> Bool[np.ndarray, " n"]:
    inside = (z > 0) & in_frame(view.camera, px)
    column, row = np.where(inside[:, None], px, 0).astype(np.int64).T
    depth = np.where(np.isfinite(view.depth), view.depth, 1e9)[row, column]
    return inside & erode(view.mask, INSIDE)[row, column] & (np.abs(depth - z) < DEPTH_TOLERANCE)
