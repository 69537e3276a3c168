"""Registration of depth to a moved silhouette (paper 6.1.2, where landmark features failed).

A stylizer may move an object's outline, while depth belongs to the rendered one. A smooth displacement warps the depth
to the new outline. It registers the two masks' signed distance fields near the outline, coarse to fine, and extends
into the inside. It compares no features, so the style does not matter; motion inside the silhouette is not detected.
"""

from dataclasses import replace

import cv2
import numpy as np
from jaxtyping import Bool, Float, Shaped

from mistyle.core.image import distance_to, gaussian, nearest
from mistyle.core.view import View

SCALES = (1 / 24, 1 / 48, 1 / 96, 1 / 192)  # smoothing widths, in sides of the picture
ROUNDS = 12  # steps at each width
LEAST_SIGMA = 3.0  # pixels; below it, concave corners tear
FAR = 1e-3  # weight under which a pixel is too far from the outline to move with it


def signed(mask: Bool[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    """Signed distance to the outline in pixels, positive inside; the outline is half way between pixel centres.

    For an empty or a full mask the distance is infinite.
    """
    return np.where(mask, distance_to(~mask) - 0.5, 0.5 - distance_to(mask)).astype(np.float32)


def displacement(was: Bool[np.ndarray, "h w"], now: Bool[np.ndarray, "h w"]) -> Float[np.ndarray, "h w 2"]:
    """A smooth field u (x, y in pixels) with was(p + u(p)) = now(p): where each pixel of the new outline came from.

    Gradient steps on the difference of the signed distances, weighted by nearness to the new outline, with decreasing
    smoothing. The field fades out away from the outline and is zero where a mask is empty or full. Parts thinner than
    about the shift may be matched wrongly.
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
            # cv2.remap rounds coordinates to 1/32 pixel, which is negligible for an outline.
            warped = cv2.remap(old, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
            uphill = cv2.remap(slope, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
            gap = np.clip(new - warped, -reach, reach)[..., None]
            step = gap * uphill / ((uphill**2).sum(axis=-1, keepdims=True) + 0.1)
            field += gaussian(weight[..., None] * step, sigma) / (share + FAR)
    return field


def carried(values: Shaped[np.ndarray, "h w *c"], field: Float[np.ndarray, "h w 2"]) -> Shaped[np.ndarray, "h w *c"]:
    """values(p + u(p)) of the nearest pixel, so that nothing is blended across a depth step."""
    height, width = field.shape[:2]
    rows, columns = np.indices((height, width))
    row = np.clip(np.rint(rows + field[..., 1]).astype(np.int64), 0, height - 1)
    column = np.clip(np.rint(columns + field[..., 0]).astype(np.int64), 0, width - 1)
    return values[row, column]


def follow(view: View, mask: Bool[np.ndarray, "h w"]) -> View:
    """The view with its geometry (depth, normal, uv, part) warped to the outline of `mask`, which becomes its mask.

    The colours stay. Pixels whose source is off the mesh take the geometry of the nearest pixel on it. A view or mask
    without any foreground is returned with the intersection of both masks.
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
