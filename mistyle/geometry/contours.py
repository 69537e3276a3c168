"""Contours of masks: signed distances, rims, and the distance of two masks' contours."""

import numpy as np
from jaxtyping import Bool, Float

from mistyle.core.image import distance_to


def signed_distance(mask: Bool[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    """Signed distance from the mask's contour in pixels, positive inside; about a diagonal where the mask has no
    contour."""
    far = float(np.hypot(*mask.shape))
    inside = np.minimum(distance_to(~mask), far) if not mask.all() else np.full(mask.shape, far)
    outside = np.minimum(distance_to(mask), far) if mask.any() else np.full(mask.shape, far)
    return np.where(mask, inside - 0.5, 0.5 - outside)


def rim_of(mask: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Pixels of the mask next to its outside; the picture's border, which cuts the object, does not count."""
    padded = np.pad(mask, 1, constant_values=True)
    inner = padded[:-2, 1:-1] & padded[2:, 1:-1] & padded[1:-1, :-2] & padded[1:-1, 2:]
    rim = mask & ~inner
    rim[[0, -1]] = False
    rim[:, [0, -1]] = False
    return rim


def contour_distance(drawn: Bool[np.ndarray, "h w"], seen: Bool[np.ndarray, "h w"]) -> float:
    """Mean distance of two masks' contours from one another, both ways, in pixels."""
    gap = np.abs(signed_distance(drawn) - signed_distance(seen))
    rims = [gap[rim] for rim in (rim_of(drawn), rim_of(seen)) if rim.any()]
    return float(np.concatenate(rims).mean()) if drawn.any() and seen.any() and rims else float("nan")


def block_means(image: Float[np.ndarray, "h w *c"], times: int) -> Float[np.ndarray, "h2 w2 *c"]:
    """Means of blocks of `times` x `times` pixels; the remainder at the right and the bottom is dropped."""
    height, width = (n // times * times for n in image.shape[:2])
    rest = image.shape[2:]
    return image[:height, :width].reshape(height // times, times, width // times, times, *rest).mean(axis=(1, 3))


def slope_of(image: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w 2"]:
    """Change per pixel along x and y, (h w 2)."""
    down, right = np.gradient(image)
    return np.stack([right, down], axis=-1)
