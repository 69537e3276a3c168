"""Warping of finished views into a colour prior for the next view (paper 4.1.3, "cumulative view warping").

Every finished view is lifted to the surface by its metric depth and scattered into the next view, nearer points over
farther ones; among several views the one with the smallest camera angle wins. Where the paper is ambiguous, or uses
8-bit depth and integer pixels, this module does the following (`stylization/mvst/lift.py` selects the source pixels):

- pixel centres lie at +0.5, depth is float32: a point lands on the pixel where the renderer sees it;
- a point counts only where it agrees with the depth of its target pixel: nothing shows through gaps of the scattering,
  and a hole takes the nearest colour of its own surface only;
- the scattered point selects the source pixel; the colour is then sampled at the projection of the target's own point;
- a surface that the source saw at a much smaller cosine than the view is repainted;
- exp(-angle) falls with the angle: nearest-view-wins is the smallest angle between camera positions;
- the directional erosion cuts from both rims of an occlusion shadow (the region behind a near surface that the source
  does not see), along the line away from the projected source camera. It acts only where the source has a depth
  discontinuity, since a stylized outline may differ from the true one there. Edges from grazing angles or from the
  source's frame stay.
"""

from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int

from mistyle.atlas.texels import threaded
from mistyle.core.camera import Camera
from mistyle.core.image import bilinear, dilate, erode
from mistyle.core.view import Prior, View
from mistyle.stylization.mvst.lift import Lifted, cosines, depth_tolerance, lift, transformed
from mistyle.stylization.mvst.settings import WarpSettings

__all__ = ["Lifted", "angle", "composite", "lift", "splat"]

EROSION = 20  # the paper's, for `erosion` unset
EROSION_AT = 1024  # view width to which `erosion` refers
EMPTY = np.uint64(2**64 - 1)


def splat(
    source: Lifted, view: View, settings: WarpSettings, inside: Bool[np.ndarray, "h w"] | None = None
) -> tuple[Int[np.ndarray, "h w"], Bool[np.ndarray, "h w"]]:
    """Index of the `source` point at each pixel of `view` (-1: none), and the valid ones after fill and erosion.

    `inside` (default: the view's mask) bounds the result. Points that disagree with the view's depth are hidden there
    or off the mesh, and never count.
    """
    depth = np.where(view.mask if inside is None else inside & view.mask, view.depth, np.inf).astype(np.float32)
    winner = _scatter(source, view.camera, depth, settings)
    _fill(winner, depth, view.camera, settings)
    known = winner >= 0
    _drop_stretched(winner, known, view, source, settings)
    erosion = EROSION if settings.erosion is None else settings.erosion
    reach = round(erosion * view.camera.size[1] / EROSION_AT)
    if reach > 0 and known.any():
        known &= ~_shadow_rims(winner, known, depth, source, view.camera, reach, settings)
    return winner, known


def _drop_stretched(winner: np.ndarray, known: np.ndarray, view: View, source: Lifted, settings: WarpSettings) -> None:
    """Clear in `known`, in place, the pixels that the source saw at a much smaller cosine than the view does."""
    if settings.sharpness == 0:
        return
    pixel = np.flatnonzero(known)
    point = winner.reshape(-1)[pixel]
    normals = np.ascontiguousarray(view.normal.reshape(-1, 3)[pixel].T)
    facing = cosines(view.camera, source.points.take(point, axis=1), normals)
    known.reshape(-1)[pixel] = source.cosine[point] >= settings.sharpness * facing


def composite(
    sources: Sequence[Lifted], view: View, settings: WarpSettings, inside: Bool[np.ndarray, "h w"] | None = None
) -> Prior:
    """The finished views as a prior for `view`: each pixel from the view nearest in angle that knows it."""
    height, width = view.camera.size
    rgb, known = np.zeros((height * width, 3), np.float32), np.zeros((height, width), bool)
    nearest = sorted(sources, key=lambda s: angle(s.camera, view.camera))
    winners: list[tuple[np.ndarray, np.ndarray]] = [(np.empty(0), np.empty(0))] * len(nearest)

    def work(k: int) -> None:
        winner, counts = splat(nearest[k], view, settings, inside)
        at = np.flatnonzero(counts)
        winners[k] = at, winner.reshape(-1)[at]

    threaded(work, len(nearest))
    for source, (at, winner) in zip(nearest, winners, strict=True):
        new = ~known.reshape(-1)[at]
        rgb[at[new]] = _colours(source, view, at[new], winner[new], settings)
        known.reshape(-1)[at] = True
    return Prior(rgb.reshape(height, width, 3), known)


def _colours(
    source: Lifted, view: View, pixel: Int[np.ndarray, " n"], winner: Int[np.ndarray, " n"], settings: WarpSettings
) -> Float[np.ndarray, "n 3"]:
    """The colours of the view's pixels: those of the scattered points or, with `look_up`, samples of the source at the
    projections of the pixels' own surface points.

    A scattered point is up to half a pixel off centre; repeated warps of its colour would fray the picture. A look-up
    stays next to the winner, within lifted pixels and at the point's own depth: the same surface, no mixed colours.
    """
    result = source.colour.take(winner, axis=0)
    if not settings.look_up or not len(pixel):
        return result
    camera, source_camera = view.camera, source.camera
    rows, columns = np.divmod(pixel, camera.size[1])
    depth = view.depth.reshape(-1)[pixel].astype(np.float64)
    x, y = ((n + 0.5 - c) / camera.focal * depth for n, c in zip((columns, rows), camera.centre, strict=True))
    x, y, z = transformed(source_camera.cam_from_world @ camera.world_from_cam, np.stack([x, y, depth]))
    px = np.stack(
        [x / z * source_camera.focal + source_camera.centre[0], y / z * source_camera.focal + source_camera.centre[1]],
        axis=1,
    )
    row, column = np.divmod(source.pixel[winner], source.camera.size[1])
    beside = (np.abs(px[:, 0] - column - 0.5) < 2) & (np.abs(px[:, 1] - row - 0.5) < 2)
    samples = bilinear(source.picture, px[beside])
    samples[:, :4] /= np.maximum(samples[:, 4:], 1e-6)
    same = np.abs(samples[:, 3] - z[beside]) <= depth_tolerance(source.camera, z[beside], settings)
    valid = same & (samples[:, 4] > 0.5)
    result[np.flatnonzero(beside)[valid]] = samples[valid, :3]
    return result


def angle(a: Camera, b: Camera) -> float:
    """Angle in radians between two camera positions, seen from the origin (the paper rig's target)."""
    p, q = a.position / np.linalg.norm(a.position), b.position / np.linalg.norm(b.position)
    return float(np.arctan2(np.linalg.norm(np.cross(p, q)), p @ q))


def _scatter(
    source: Lifted, camera: Camera, depth: Float[np.ndarray, "h w"], settings: WarpSettings
) -> Int[np.ndarray, "h w"]:
    """The nearest agreeing point in each pixel, the first of equals; -1 for none."""
    height, width = depth.shape
    k = np.array([[camera.focal, 0, camera.centre[0]], [0, camera.focal, camera.centre[1]], [0, 0, 1]])
    x, y, z = transformed(k @ camera.cam_from_world[:3], source.points)
    with np.errstate(divide="ignore", invalid="ignore"):
        scale = 1 / z
        x *= scale
        y *= scale
    ahead = np.flatnonzero((z > 1e-6) & (x >= 0) & (x < width) & (y >= 0) & (y < height))
    pixel = y[ahead].astype(np.int32) * width + x[ahead].astype(np.int32)
    z = z[ahead]
    with np.errstate(invalid="ignore"):
        agrees = np.abs(depth.reshape(-1).take(pixel) - z) <= depth_tolerance(camera, z, settings)
    pixel, z, ahead = pixel[agrees], z[agrees], ahead[agrees]
    # Positive floats order like their bits: one integer holds depth first, then the point's number.
    key = (z.view(np.uint32).astype(np.uint64) << np.uint64(32)) | ahead.astype(np.uint64)
    best = np.full(height * width, EMPTY)
    np.minimum.at(best, pixel, key)
    winner = np.where(best == EMPTY, -1, (best & np.uint64(0xFFFFFFFF)).astype(np.int64)).astype(np.int32)
    return winner.reshape(height, width)


def _fill(winner: Int[np.ndarray, "h w"], depth: Float[np.ndarray, "h w"], camera: Camera, settings: WarpSettings):
    """Fill holes near a painted pixel, in place, with the nearest one of their own surface."""
    covered = winner >= 0
    height, width = winner.shape
    holes = np.flatnonzero(np.isfinite(depth) & ~covered & dilate(covered, settings.fill))
    flat, depths, known = winner.reshape(-1), depth.reshape(-1), covered.reshape(-1)
    for dy, dx in _disc(settings.fill):
        if not len(holes):
            return
        row, column = holes // width + dy, holes % width + dx
        near = np.clip(row, 0, height - 1) * width + np.clip(column, 0, width - 1)
        own = depths[holes]
        same = np.abs(depths[near] - own) <= depth_tolerance(camera, own, settings) * max(1.0, np.hypot(dy, dx))
        take = known[near] & same & (row >= 0) & (row < height) & (column >= 0) & (column < width)
        flat[holes[take]] = flat[near[take]]
        holes = holes[~take]


def _disc(radius: int) -> list[tuple[int, int]]:
    """Offsets (row, column) within a disc, nearest first."""
    around = range(-radius, radius + 1)
    steps = [(dy, dx) for dy in around for dx in around if 0 < dy * dy + dx * dx <= radius * radius]
    return sorted(steps, key=lambda s: (s[0] ** 2 + s[1] ** 2, s))


def _shadow_rims(
    winner: Int[np.ndarray, "h w"],
    known: Bool[np.ndarray, "h w"],
    depth: Float[np.ndarray, "h w"],
    source: Lifted,
    camera: Camera,
    reach: int,
    settings: WarpSettings,
) -> Bool[np.ndarray, "h w"]:
    """Known pixels within `reach` of an occlusion shadow, counted along the line to the projected source camera.

    From each rim pixel it marches away from the shadow until it leaves the surface, the known pixels or the reach.
    """
    height, width = winner.shape
    rim = np.flatnonzero(known & ~erode(known, 1))
    rim = rim[source.near_edge[winner.reshape(-1)[rim]]]
    px = np.stack([rim % width, rim // width], axis=1) + 0.5
    away = _away_from(source.camera, camera, px)
    marked = np.zeros(height * width, np.uint8)
    flat, depths = known.reshape(-1), depth.reshape(-1)

    def at(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        cell = np.floor(points).astype(np.int64)
        within = ((cell >= 0) & (cell < (width, height))).all(axis=1)
        index = np.clip(cell[:, 1], 0, height - 1) * width + np.clip(cell[:, 0], 0, width - 1)
        return index, within & flat[index]

    for side in (1.0, -1.0):
        open_side = ~at(px + side * away)[1] & away.any(axis=1)
        points, step = px[open_side], -side * away[open_side]
        index = rim[open_side]
        for _ in range(reach):
            marked[index] = 1
            before = depths[index]
            points = points + step
            index, inside = at(points)
            with np.errstate(invalid="ignore"):
                # A diagonal step is longer than a pixel's side; the tolerance of one pixel covers it.
                go_on = inside & (np.abs(depths[index] - before) <= depth_tolerance(camera, before, settings))
            points, step, index = points[go_on], step[go_on], index[go_on]
            if not len(index):
                break
    # Marches from a slanted rim leave single pixels between them.
    closed = cv2.morphologyEx(marked.reshape(height, width), cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
    return (closed > 0) & known


def _away_from(source: Camera, camera: Camera, px: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
    """Unit image directions of points that move straight away from the source camera.

    With c the source's position in this camera, a point at z (u, v, 1) moves along c_z (u, v) - c_xy, independent of z;
    zero where the source is exactly behind or before the pixel.
    """
    c = camera.cam_from_world[:3, :3] @ source.position + camera.cam_from_world[:3, 3]
    direction = (px - np.asarray(camera.centre)) / camera.focal * c[2] - c[:2]
    length = np.linalg.norm(direction, axis=1, keepdims=True)
    return np.where(length > 1e-6, direction / np.maximum(length, 1e-12), 0)
