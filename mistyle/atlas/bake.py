"""Baking views into the atlas (paper 4.1.4): view selection and colour per texel."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from mistyle.atlas.gaps import fill_in_place
from mistyle.atlas.settings import BakeSettings
from mistyle.atlas.texels import threaded
from mistyle.core.camera import Camera
from mistyle.core.maps import Texels
from mistyle.core.mesh import Mesh
from mistyle.core.view import View
from mistyle.geometry.normals import area_vectors
from mistyle.process import memory

DEPTH_NOISE = 0.0005  # error of depth maps: float32 through a file and another projection
STEEP = 4.0  # tan of the steepest view angle, 76 degrees
BAND = 64  # rows of a view per task
ROWS = 2**16  # texels per task; their intermediate arrays then fit the cache


@dataclass(frozen=True)
class Backprojection:
    """Baked atlas; zero, False, -1 and 0 where no view sees a texel.

    albedo  linear Rec.709, from the views
    known   whether a view painted the texel
    view    the index of that view
    seen    number of views that accept the texel
    """

    albedo: Float[np.ndarray, "h w 3"]
    known: Bool[np.ndarray, "h w"]
    view: Int[np.ndarray, "h w"]
    seen: Int[np.ndarray, "h w"]


def backproject(
    views: Sequence[View],
    texels: Texels,
    settings: BakeSettings,
    progress: Callable[[float], None] = lambda done: None,
    *,
    mesh: Mesh | None = None,
) -> Backprojection:
    """Paint every texel from the accepted view that faces it most: w = max(0, n . (c - P) / |c - P|), first of equals.

    The paper accepts a view when the projection is in bounds with z > 0, when the depth map max-pooled over 5x5 "to
    handle silhouette boundaries" matches z within 0.05, and when the mask holds. Taken literally, the pooled test
    paints a texel hidden up to two pixels behind a silhouette with the occluder's colour. It also rejects a texel in
    front when something farther begins beside it. Our reading separates the threshold from its purpose:

    - visibility: the mask holds, and z agrees with that pixel's own depth within 0.05. It agrees more closely with the
      plane that continues the pixel's surface, so that one of two sheets 0.01 apart does not paint the other;
    - silhouettes: pixels with mixed colours (coverage below 1, or a depth step beside them) take the colour of the
      nearest pure pixel of their own surface in the 5x5 window before sampling;
    - colour: bilinear over those of the four pixels inside the mask with matching depth, weights renormalised.

    A view never paints a texel whose normal, or (with `mesh`) whose face, turns away from its camera; the face's front
    is the side of its corner normals. Views may differ in size. The result does not depend on the thread count.
    """
    chosen, seen = accepted(views, texels, settings, lambda done: progress(0.7 * done), mesh=mesh)
    position = texels.position.reshape(-1, 3)
    albedo = memory.zeros((chosen.size, 3))

    def paint(k: int) -> None:
        _paint(albedo, views[k], np.flatnonzero(chosen == k), position, settings)

    threaded(paint, len(views), lambda done: progress(0.7 + 0.3 * done))
    shape = texels.covered.shape
    return Backprojection(
        albedo.reshape(*shape, 3), (chosen >= 0).reshape(shape), chosen.reshape(shape), seen.reshape(shape)
    )


def accepted(
    views: Sequence[View],
    texels: Texels,
    settings: BakeSettings,
    progress: Callable[[float], None] = lambda done: None,
    *,
    mesh: Mesh | None = None,
) -> tuple[Int[np.ndarray, " t"], Int[np.ndarray, " t"]]:
    """`backproject` without the colours: per texel, row by row, the view that would paint it (-1: none), and the number
    of views that accept it."""
    if not views:
        raise ValueError("found no views to bake; expected at least one")
    towards = None if mesh is None else _faces_towards(mesh, [view.camera for view in views])
    tables = _depth_tables(views, settings)
    covered = texels.covered.reshape(-1)
    chosen, seen = memory.empty(covered.size, np.int16), memory.zeros(covered.size, np.int16)
    chosen.fill(-1)
    position, normal = texels.position.reshape(-1, 3), texels.normal.reshape(-1, 3)
    face = texels.face.reshape(-1)

    def work(chunk: int) -> None:
        inside = chunk * ROWS + np.flatnonzero(covered[chunk * ROWS : (chunk + 1) * ROWS])
        if len(inside):
            own = None if towards is None else face.take(inside)
            points, normals = position.take(inside, axis=0), normal.take(inside, axis=0)
            chosen[inside], seen[inside] = _best(views, tables, points, normals, towards, own)

    threaded(work, -(-covered.size // ROWS), progress)
    return chosen, seen


def _faces_towards(mesh: Mesh, cameras: Sequence[Camera]) -> Bool[np.ndarray, "c f"]:
    """Faces that show each camera their front, the side of the corner normals."""
    n = area_vectors(mesh.positions, mesh.faces)
    side = np.sign(np.einsum("fi,fki->f", n, mesh.corner_normals, optimize=True))
    n *= side[:, None]
    origin = np.einsum("fi,fi->f", n, mesh.positions[mesh.faces[:, 0]])
    return np.stack([n @ camera.position > origin for camera in cameras])


def _depth_tables(views: Sequence[View], settings: BakeSettings) -> list[Float[np.ndarray, "_ 4"]]:
    """`_depth_band` over every view, row after row, with an empty frame of one pixel around it."""
    sizes = [(view.camera.size[0] + 2, view.camera.size[1] + 2) for view in views]
    starts = np.cumsum([0] + [h * w for h, w in sizes])
    # One array for all: freed memory of this size returns to the system, small pieces may not.
    together = memory.empty((int(starts[-1]), 4))
    together.fill(-1)
    tables = [together[a:b] for a, b in zip(starts[:-1], starts[1:], strict=True)]

    bands = [(k, top) for k, (rows, _) in enumerate(sizes) for top in range(0, rows - 2, BAND)]

    def work(n: int) -> None:
        k, top = bands[n]
        band = _depth_band(views[k], top, min(top + BAND, sizes[k][0] - 2), settings.depth_tolerance)
        tables[k].reshape(*sizes[k], 4)[top + 1 : top + 1 + len(band), 1:-1] = band

    threaded(work, len(bands))
    return tables


def _depth_band(view: View, top: int, bottom: int, tolerance: float) -> Float[np.ndarray, "h w 4"]:
    """The plane z = a + b x + c y (x, y in pixels) that continues each pixel's surface, and the largest accepted
    distance of a texel's depth from it: a, b, c, allowance; for the rows from top to bottom. The allowance is -1
    outside the mask.

    The smaller one of the steps to the two neighbours belongs to the surface, unless it is large too: then other
    surfaces lie on both sides. The plane ignores curvature, so the allowance is a quarter of its steps plus a tenth of
    a pixel's width. Steps and allowance together stay within the depth tolerance. With coarse pixels (below about 256²)
    the depth step of a surface seen at 76° across a pixel is larger and takes its place. Half the depth bounds the
    allowance, so that no point behind the camera agrees.
    """
    first, last = max(top - 1, 0), min(bottom + 1, len(view.depth))
    depth, mask = view.depth[first:last], view.mask[first:last]
    depth = np.where(mask & np.isfinite(depth) & (depth > 0), depth, np.inf).astype(np.float32)
    with np.errstate(invalid="ignore"):
        across, down = (np.diff(depth, axis=k, prepend=np.inf, append=np.inf) for k in (1, 0))
    own = slice(top - first, bottom - first)
    depth, across = depth[own], across[own]
    down = down[top - first : bottom - first + 1]
    footprint = depth * np.float32(1 / view.camera.focal)
    limit = np.maximum(0.7 * tolerance, STEEP * footprint)
    dx, dy = _smaller(across[:, :-1], across[:, 1:], limit), _smaller(down[:-1], down[1:], limit)
    allowance = 0.25 * (np.abs(dx) + np.abs(dy)) + 0.1 * footprint + DEPTH_NOISE
    allowance = np.minimum(np.minimum(allowance, 0.3 * tolerance), depth / 2)
    seen = np.isfinite(depth)
    x = np.arange(depth.shape[1], dtype=np.float32) + 0.5
    y = np.arange(top, bottom, dtype=np.float32)[:, None] + 0.5
    table = np.empty((*depth.shape, 4), np.float32)
    table[..., 0] = np.where(seen, depth, 0) - dx * x - dy * y
    table[..., 1], table[..., 2], table[..., 3] = dx, dy, np.where(seen, allowance, -1)
    return table


def _smaller(a: np.ndarray, b: np.ndarray, limit: np.ndarray) -> np.ndarray:
    """The smaller one of two steps; 0 if it reaches the limit or is not finite."""
    step = np.where(np.abs(a) < np.abs(b), a, b)
    step = np.where(np.isfinite(step), step, a)
    return np.where(np.abs(step) < limit, step, 0)


def _best(
    views: Sequence[View],
    tables: Sequence[np.ndarray],
    position: Float[np.ndarray, "n 3"],
    normal: Float[np.ndarray, "n 3"],
    towards: Bool[np.ndarray, "v f"] | None,
    face: Int[np.ndarray, " n"] | None,
) -> tuple[Int[np.ndarray, " n"], Int[np.ndarray, " n"]]:
    """For each texel the accepted view with the largest face-on weight (-1: none) and the number of accepted ones."""
    points, normals = np.ascontiguousarray(position.T), np.ascontiguousarray(normal.T)
    plane = (points * normals).sum(axis=0)
    best = np.zeros(len(position), np.float32)
    chosen, seen = np.full(len(position), -1, np.int16), np.zeros(len(position), np.int16)
    for k, (view, table) in enumerate(zip(views, tables, strict=True)):
        eye = view.camera.position.astype(np.float32)
        height = normals[0] * eye[0] + normals[1] * eye[1] + normals[2] * eye[2] - plane
        facing = height > 0
        if towards is not None and face is not None:
            facing &= towards[k].take(face)
        near = np.flatnonzero(facing)
        p = points.take(near, axis=1)
        x, y, z = _project(view.camera, p)
        width = view.camera.size[1] + 2
        column = np.clip(x + 1, 0, width - 1).astype(np.int32)
        row = np.clip(y + 1, 0, view.camera.size[0] + 1).astype(np.int32)
        a, b, c, allowance = table.take(row * width + column, axis=0).T
        accepted = np.abs(a + b * x + c * y - z) <= allowance
        seen[near] += accepted
        distance = np.sqrt((eye[0] - p[0]) ** 2 + (eye[1] - p[1]) ** 2 + (eye[2] - p[2]) ** 2)
        weight = height.take(near) * accepted / distance
        better = np.flatnonzero(weight > best.take(near))
        winners = near.take(better)
        best[winners], chosen[winners] = weight.take(better), k
    return chosen, seen


def _project(camera: Camera, points: Float[np.ndarray, "3 n"]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """`px_from_world` in float32 on coordinate rows: pixel x, y (meaningless for z <= 0) and metric z."""
    k = np.array([[camera.focal, 0, camera.centre[0]], [0, camera.focal, camera.centre[1]], [0, 0, 1]])
    m = (k @ camera.cam_from_world[:3]).astype(np.float32)
    x, y, z = (m[r, 0] * points[0] + m[r, 1] * points[1] + m[r, 2] * points[2] + m[r, 3] for r in range(3))
    scale = 1 / np.maximum(z, np.float32(1e-6))
    return x * scale, y * scale, z


def _paint(
    albedo: Float[np.ndarray, "t 3"],
    view: View,
    texel: Int[np.ndarray, " n"],
    position: Float[np.ndarray, "t 3"],
    settings: BakeSettings,
) -> None:
    """Write the view's colours into the texels that selected it."""
    if len(texel) == 0:
        return
    height, width = view.camera.size
    pixels = np.full((height + 2, width + 2, 4), (0, 0, 0, np.inf), np.float32)
    pixels[1:-1, 1:-1, :3] = pure_colours(view, settings)
    pixels[1:-1, 1:-1, 3] = np.where(view.mask, view.depth, np.inf)
    pixels = pixels.reshape(-1, 4)
    for start in range(0, len(texel), ROWS):
        part = texel[start : start + ROWS]
        x, y, z = _project(view.camera, np.ascontiguousarray(position.take(part, axis=0).T))
        # Most that `_depth_band` may bridge between a pixel's centre and a texel in it.
        tolerance = np.maximum(1.001 * settings.depth_tolerance, 1.5 * STEEP / view.camera.focal * z)
        albedo[part] = _fetch(pixels, width + 2, x + 1, y + 1, z, tolerance)


def _fetch(pixels: Float[np.ndarray, "p 4"], width: int, x, y, z, tolerance) -> Float[np.ndarray, "n 3"]:
    """Bilinear colour over the pixels (rgb and depth, rows of `width`) whose depth matches.

    The pixel at the projection weighs at least 1/4 and matches, since its view was accepted.
    """
    low_x, low_y = np.floor(x - 0.5), np.floor(y - 0.5)
    tx, ty = x - 0.5 - low_x, y - 0.5 - low_y
    first = low_y.astype(np.int32) * width + low_x.astype(np.int32)
    total, colour = np.zeros(len(x), np.float32), np.zeros((3, len(x)), np.float32)
    for step, weight in (
        (0, (1 - tx) * (1 - ty)),
        (1, tx * (1 - ty)),
        (width, (1 - tx) * ty),
        (width + 1, tx * ty),
    ):
        r, g, b, depth = pixels.take(first + step, axis=0).T
        weight = weight * (np.abs(depth - z) <= tolerance)
        total += weight
        for channel, value in enumerate((r, g, b)):
            colour[channel] += value * weight
    colour /= total
    return np.ascontiguousarray(colour.T)


def pure_colours(view: View, settings: BakeSettings) -> Float[np.ndarray, "h w 3"]:
    """The view's rgb with mixed pixels replaced by the nearest pure one of their own surface within the window.

    A masked pixel is mixed if the mesh covers it in part, or if its depth deviates from the line between its
    neighbours' by more than the tolerance: one neighbour then belongs to another surface. If the window has no pure
    pixel of matching depth (thin parts), the colour is divided by coverage instead.
    """
    depth = np.where(view.mask, view.depth, np.nan).astype(np.float32)
    bend = np.zeros(depth.shape, bool)
    for part, values in ((bend, depth), (bend.T, depth.T)):
        part[1:-1] |= np.abs(values[2:] - 2 * values[1:-1] + values[:-2]) > settings.depth_tolerance
    mixed = view.mask & (bend | (view.coverage < 0.995))
    pure = view.mask & ~mixed
    rgb = view.rgb.copy()
    rows, columns = np.nonzero(mixed)
    left = np.arange(len(rows))
    for dy, dx in _offsets(settings.window):
        r, c = rows[left] + dy, columns[left] + dx
        inside = (r >= 0) & (c >= 0) & (r < depth.shape[0]) & (c < depth.shape[1])
        r, c = np.where(inside, r, 0), np.where(inside, c, 0)
        centre = depth[rows[left], columns[left]]
        good = inside & pure[r, c] & (np.abs(depth[r, c] - centre) <= settings.depth_tolerance)
        rgb[rows[left[good]], columns[left[good]]] = view.rgb[r[good], c[good]]
        left = left[~good]
    rgb[rows[left], columns[left]] /= np.clip(view.coverage[rows[left], columns[left]], 0.1, 1)[:, None]
    return rgb


def _offsets(window: int) -> list[tuple[int, int]]:
    """The offsets of a window around its centre, nearest first, without the centre."""
    reach = range(-(window // 2), window // 2 + 1)
    return sorted(((y, x) for y in reach for x in reach if (y, x) != (0, 0)), key=lambda o: (o[0] ** 2 + o[1] ** 2, o))


def fill(baked: Backprojection, texels: Texels) -> Float[np.ndarray, "h w 3"]:
    """Albedo with every covered texel coloured: unpainted ones take the nearest painted texel's colour, in the atlas
    and inside their own island; if an island has none, the nearest on the surface (3-D distance).

    The paper's distance transform leaks colours between islands that lie side by side in the atlas. Texels outside the
    islands stay unchanged (`texels.pad`). Nothing is filled if no view painted any texel.
    """
    albedo = memory.copied(baked.albedo)
    fill_in_place(albedo, baked.known, texels)
    return albedo
