"""Depth that follows the silhouette (paper 6.1.2, where landmark features failed).

A stylizer may move the outline of what it paints. Depth belongs to the old outline; here it is moved to the new one by
a smooth displacement found from the two masks alone: their signed distance fields are laid onto each other near the
outline, coarse to fine, and the inside follows. No features are compared, so the style does not matter; what moved
inside the silhouette without moving the outline is not seen.
"""

from dataclasses import replace

import cv2
import numpy as np
from jaxtyping import Bool, Float, Shaped

from mistyle.core.image import distance_to, gaussian, nearest
from mistyle.core.view import View

SCALES = (1 / 24, 1 / 48, 1 / 96, 1 / 192)  # widths of the smoothing, in sides of the picture
ROUNDS = 12  # steps at each
LEAST_SIGMA = 3.0  # pixels; with less, concave corners tear
FAR = 1e-3  # weight under which a place is too far from the outline to be moved with it


def signed(mask: Bool[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    """Distance to the outline in pixels, positive inside; the outline runs half way between pixel centres.

    Where there is no outline (an empty or a full mask) it lies at an infinite distance.
    """
    return np.where(mask, distance_to(~mask) - 0.5, 0.5 - distance_to(mask)).astype(np.float32)


def displacement(was: Bool[np.ndarray, "h w"], now: Bool[np.ndarray, "h w"]) -> Float[np.ndarray, "h w 2"]:
    """A smooth field u (x, y in pixels) with was(p + u(p)) = now(p): where each pixel of the new outline came from.

    Gradient steps on the difference of the signed distances, weighted by nearness to the new outline and smoothed, with
    ever less smoothing. It fades out away from the outline; zero where a mask is empty or full. Parts thinner than
    about the shift may be taken for others.
    """
    field = np.zeros((*was.shape, 2), np.float32)
    if was.all() or now.all() or not was.any() or not now.any():
        return field
    old, new = signed(was), signed(now)
    down, right = np.gradient(gaussian(old, 1.0))
    slope = np.stack([right, down], axis=-1)
    rows, columns = np.indices(was.shape, np.float32)
    for scale in SCALES:
        sigma = max(LEAST_SIGMA, scale * max(was.shape))
        weight = np.exp(-((new / (2 * sigma + 2)) ** 2) / 2)
        share = gaussian(weight, sigma)[..., None]
        reach = np.float32(2 * sigma + 2)
        for _ in range(ROUNDS):
            x, y = columns + field[..., 0], rows + field[..., 1]
            # cv2.remap rounds places to 1/32 pixel, which is nothing beside an outline's own pixels.
            warped = cv2.remap(old, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
            uphill = cv2.remap(slope, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
            gap = np.clip(new - warped, -reach, reach)[..., None]
            step = gap * uphill / ((uphill**2).sum(axis=-1, keepdims=True) + 0.1)
            field += gaussian(weight[..., None] * step, sigma) / (share + FAR)
    return field


def carried(values: Shaped[np.ndarray, "h w *c"], field: Float[np.ndarray, "h w 2"]) -> Shaped[np.ndarray, "h w *c"]:
    """values(p + u(p)), the nearest pixel's: nothing is mixed across a depth step."""
    height, width = field.shape[:2]
    rows, columns = np.indices((height, width))
    row = np.clip(np.rint(rows + field[..., 1]).astype(np.int64), 0, height - 1)
    column = np.clip(np.rint(columns + field[..., 0]).astype(np.int64), 0, width - 1)
    return values[row, column]


def follow(view: View, mask: Bool[np.ndarray, "h w"]) -> View:
    """The view with its geometry (depth, normal, uv, part) moved to the outline of `mask`, which becomes its mask.

    The colours stay. Pixels whose place was off the mesh take the geometry of the nearest pixel on it. A view or mask
    without any foreground is given back with the part that both have.
    """
    if not view.mask.any() or not mask.any():
        both = view.mask & mask
        return replace(view, mask=both, depth=np.where(both, view.depth, np.inf).astype(np.float32))
    field = displacement(view.mask, mask)
    height, width = mask.shape
    inside = nearest(view.mask)[0]
    index = carried(inside, field).reshape(-1)

    def moved(values: np.ndarray, outside: float) -> np.ndarray:
        gathered = values.reshape(height * width, -1)[index].reshape(values.shape)
        where = mask.reshape(height, width, *[1] * (values.ndim - 2))
        return np.where(where, gathered, np.asarray(outside, values.dtype))

    return replace(
        view,
        depth=moved(view.depth, np.inf),
        normal=moved(view.normal, 0),
        uv=moved(view.uv, 0),
        part=moved(view.part, -1),
        mask=mask,
        coverage=mask.astype(np.float32),
    )
