"""The atlas (paper 4.1.4): surface point of every texel, initial maps, and padding around islands.

A texel (row r, column c) of a `size` x `size` map has its centre at u = (c + 0.5) / size, v = 1 - (r + 0.5) / size.
The paper maps rows as r = (1 - v) H and states that glTF puts (0, 0) at the bottom left. In memory v points up and the
row formula holds, but glTF files have their origin at the top left (glTF 2.0, 3.8.4): the writers flip it.
"""

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Int

from mistyle.core.asset import Material
from mistyle.core.errors import InputRefused
from mistyle.core.image import dilate, nearest, resize
from mistyle.core.maps import Maps, Texels
from mistyle.core.mesh import Mesh
from mistyle.geometry.normals import same_points
from mistyle.geometry.raster import fragment_pieces
from mistyle.geometry.uvs import islands
from mistyle.process import memory
from mistyle.process.cores import cores

ROWS = 2**17  # texels per task; the intermediate arrays then fit the cache
BAND_TEXELS = 2**20  # texels per band where only the memory of temporaries matters


def bands(height: int, width: int, count: int = BAND_TEXELS) -> Iterator[slice]:
    """Row ranges of a map with about `count` texels each, which bound the temporaries of texelwise work."""
    step = max(1, count // max(width, 1))
    return (slice(top, min(top + step, height)) for top in range(0, height, step))


def threaded(work: Callable[[int], None], count: int, progress: Callable[[float], None] = lambda done: None) -> None:
    """Call work(0) … work(count - 1), each writing its own part of a result, on all cores, in any order."""
    with ThreadPoolExecutor(max_workers=max(1, min(cores(), 8))) as pool:
        for k, _ in enumerate(pool.map(work, range(count))):
            progress((k + 1) / count)


def beside(island: Int[np.ndarray, "h w"]) -> tuple[Bool[np.ndarray, "h v"], Bool[np.ndarray, "u w"]]:
    """Whether a texel shares its UV island with the right one, and with the lower one (v = w - 1, u = h - 1)."""
    inside = island >= 0
    return (island[:, :-1] == island[:, 1:]) & inside[:, 1:], (island[:-1] == island[1:]) & inside[1:]


def rasterise(mesh: Mesh, part: int, size: int) -> Texels:
    """Position, normal, island and face of every texel of texture set `part` whose centre a UV triangle covers.

    P = sum l_i v_i and n = normalised sum l_i n_i with the barycentric coordinates l of the texel's centre. A centre on
    an edge belongs to exactly one of the two triangles. Where several faces cover a centre, the first one in order is
    used. UVs outside the unit square wrap (see core/asset.py). An island is a set of faces joined by points with equal
    position and UV; islands are numbered in face order. An island too thin to cover any centre takes the free texels at
    its corners and face centres, each with the surface point there. It therefore never shows a neighbour's colours.

    Raises InputRefused for UVs that are not finite or farther than one tile outside the square.
    """
    chosen = np.flatnonzero(mesh.part == part)
    uv = mesh.corner_uvs[chosen].astype(np.float64)
    if not np.isfinite(uv).all() or (uv.size and (uv.min() < -1 or uv.max() > 2)):
        raise InputRefused(
            f"texture set '{mesh.parts[part]}': its UVs reach from {uv.min():.3g} to {uv.max():.3g}, expected"
            " values within one tile of the unit square; unwrap the mesh again with --uv new"
        )
    corners = np.stack([uv[..., 0] * size, (1 - uv[..., 1]) * size], axis=-1)
    local = np.full(size * size, -1, np.int32)
    drawn = np.zeros(len(chosen), bool)
    for face, texel in fragment_pieces(corners, size):
        drawn[face] = True
        free = local[texel] < 0
        # Faces that share a texel overwrite each other; writing backwards keeps the first.
        local[texel[free][::-1]] = face[free][::-1]
    island = islands(same_points(mesh.positions)[mesh.faces[chosen]], mesh.corner_uvs[chosen])
    _claim_slivers(local, corners, drawn, island, size)
    return _interpolate(mesh, chosen, corners, local, island, size)


def _claim_slivers(
    local: Int[np.ndarray, " t"],
    corners: Float[np.ndarray, "f 3 2"],
    drawn: Bool[np.ndarray, " f"],
    island: Int[np.ndarray, " f"],
    size: int,
) -> None:
    """Give islands without covered texels the free texels under their corners and face centres."""
    has = np.zeros(int(island.max(initial=-1)) + 1, bool)
    has[island[drawn]] = True
    faces = np.flatnonzero(~has[island])[::-1]
    points = np.concatenate([corners[faces], corners[faces].mean(axis=1, keepdims=True)], axis=1)
    column, row = np.moveaxis(np.floor(points).astype(np.int64) % size, -1, 0)
    texel = (row * size + column).ravel()
    free = local[texel] < 0
    local[texel[free]] = np.repeat(faces, 4)[free]


def _interpolate(
    mesh: Mesh,
    chosen: Int[np.ndarray, " f"],
    corners: Float[np.ndarray, "f 3 2"],
    local: Int[np.ndarray, " t"],
    island: Int[np.ndarray, " f"],
    size: int,
) -> Texels:
    """The barycentric interpolation, row by row; `local` holds indices into `chosen`."""
    frame = _frames(corners)
    vertices = np.concatenate(
        [mesh.positions[mesh.faces[chosen]], mesh.corner_normals[chosen]], axis=-1, dtype=np.float32
    )
    columns = np.ascontiguousarray(vertices.reshape(len(chosen), 18).T)  # numpy gathers from rows of one number fastest
    wraps = (corners.min(axis=(1, 2)) < 0) | (corners.max(axis=(1, 2)) > size)
    position, normal = memory.zeros((size * size, 3)), memory.zeros((size * size, 3))
    face, islanded = memory.empty(size * size, np.int32), memory.empty(size * size, np.int32)
    face.fill(-1)
    islanded.fill(-1)
    rows = max(1, ROWS // size)

    def work(chunk: int) -> None:
        start, stop = chunk * rows * size, min((chunk + 1) * rows, size) * size
        inside = start + np.flatnonzero(local[start:stop] >= 0)
        if len(inside) == 0:
            return
        f = local[inside]
        face[inside], islanded[inside] = chosen[f], island[f]
        weights = _weights(frame, f, (inside % size) + 0.5, (inside // size) + 0.5, wraps, size)
        values = columns.take(f, axis=1)
        mixed = values[:6] * weights[0] + values[6:12] * weights[1] + values[12:] * weights[2]
        n = mixed[3:]
        length = np.sqrt(n[0] ** 2 + n[1] ** 2 + n[2] ** 2)
        n /= np.where(length > 0, length, 1)
        position[inside], normal[inside] = mixed[:3].T, n.T

    threaded(work, -(-size // rows))
    return Texels(
        position=position.reshape(size, size, 3),
        normal=normal.reshape(size, size, 3),
        covered=face.reshape(size, size) >= 0,
        island=islanded.reshape(size, size),
        face=face.reshape(size, size),
    )


def _frames(corners: Float[np.ndarray, "f 3 2"]) -> Float[np.ndarray, "f 6"]:
    """First corner and the inverse of the edge matrix: (l1, l2) = M (x - x0, y - y0); zero for degenerate triangles."""
    a, e1, e2 = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    area = e1[:, 0] * e2[:, 1] - e1[:, 1] * e2[:, 0]
    inverse = np.where(area != 0, 1, 0) / np.where(area != 0, area, 1)
    rows = [e2[:, 1] * inverse, -e2[:, 0] * inverse, -e1[:, 1] * inverse, e1[:, 0] * inverse]
    return np.concatenate([a, np.stack(rows, axis=1)], axis=1)


def _weights(frame, face, x, y, wraps, size) -> list[Float[np.ndarray, " n"]]:
    """Barycentric coordinates of the points (x, y) in their faces, clamped to the triangle (which only matters for
    slivers); a face that extends outside the square is tried in the nine tiles around it."""
    m = frame.take(face, axis=0)
    dx, dy = x - m[:, 0], y - m[:, 1]
    l1, l2 = m[:, 2] * dx + m[:, 3] * dy, m[:, 4] * dx + m[:, 5] * dy
    if wraps.any():
        again = np.flatnonzero(wraps[face])
        best = np.full(len(again), -np.inf)
        g, chosen = m[again], np.zeros((2, len(again)))
        for du in (0, -size, size):
            for dv in (0, -size, size):
                sx, sy = dx[again] + du, dy[again] + dv
                t1, t2 = g[:, 2] * sx + g[:, 3] * sy, g[:, 4] * sx + g[:, 5] * sy
                inside = np.minimum(np.minimum(t1, t2), 1 - t1 - t2)
                better = inside > best
                best = np.where(better, inside, best)
                chosen = np.where(better, np.stack([t1, t2]), chosen)
        l1[again], l2[again] = chosen
    l1, l2 = np.clip(l1, 0, 1), np.clip(l2, 0, 1)
    total = np.maximum(l1 + l2, 1)
    l1, l2 = l1 / total, l2 / total
    return [(1 - l1 - l2).astype(np.float32), l1.astype(np.float32), l2.astype(np.float32)]


def corner_weights(
    mesh: Mesh, texels: Texels
) -> tuple[Int[np.ndarray, " n"], Int[np.ndarray, " n"], Int[np.ndarray, " n"], Float[np.ndarray, "n 3"]]:
    """Row, column, face and barycentric weights of every covered texel; weights at a sliver's rim are clipped to it."""
    rows, columns = np.nonzero(texels.covered)
    face = texels.face[rows, columns]
    height, width = texels.covered.shape
    point = np.stack([(columns + 0.5) / width, 1 - (rows + 0.5) / height], axis=1)
    uvs = mesh.corner_uvs[face].astype(np.float64)
    # UVs are modulo 1: a face that crosses the border covers texels on the other side of the square.
    point += np.rint((uvs.min(axis=1) + uvs.max(axis=1)) / 2 - point)
    return rows, columns, face, _barycentric(uvs, point)


def _barycentric(uvs: Float[np.ndarray, "n 3 2"], point: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 3"]:
    """Weights of the corners, clipped to the face (a texel at its rim lies outside by less than its own size)."""
    a, b, c = uvs[:, 0], uvs[:, 1] - uvs[:, 0], uvs[:, 2] - uvs[:, 0]
    p = point - a
    area = b[:, 0] * c[:, 1] - b[:, 1] * c[:, 0]
    safe = np.where(area == 0, 1, area)
    s = (p[:, 0] * c[:, 1] - p[:, 1] * c[:, 0]) / safe
    t = (b[:, 0] * p[:, 1] - b[:, 1] * p[:, 0]) / safe
    weights = np.clip(np.stack([1 - s - t, s, t], axis=1), 0, 1)
    return weights / weights.sum(axis=1, keepdims=True)


def start_maps(material: Material, texels: Texels, size: int, metallic: Literal["keep", "zero"] = "keep") -> Maps:
    """The material's own maps at the atlas's size, factors applied; flat where it has none (paper 4.2 starts there).

    Larger pictures are averaged over each texel's area, smaller ones interpolated, both as repeating textures; normals
    are renormalised. `known` is False everywhere, since nothing is painted yet. `texels` only sets the size.
    """
    if texels.covered.shape != (size, size):
        raise ValueError(f"the atlas has {texels.covered.shape} texels, not {size} x {size}")
    albedo = _resampled(material.albedo, material.albedo_factor, size)
    normal = memory.zeros((size, size, 3))
    normal[..., 2] = 1
    if material.normal is not None:
        mean = resize(material.normal, (size, size), "repeat")
        for rows in bands(size, size):
            length = np.linalg.norm(mean[rows], axis=-1, keepdims=True)
            normal[rows] = np.where(length > 1e-6, mean[rows] / np.maximum(length, 1e-6), normal[rows])
    metal = memory.zeros((size, size))
    if metallic == "keep":
        metal = _resampled(material.metallic, material.metallic_factor, size)
    roughness = _resampled(material.roughness, material.roughness_factor, size)
    return Maps(albedo, normal, roughness, metal, memory.zeros((size, size), bool))


def _resampled(picture: np.ndarray | None, factor: np.ndarray | float, size: int) -> np.ndarray:
    scale = np.asarray(factor, np.float32)
    result = memory.empty((size, size, *scale.shape))
    if picture is None:
        result[...] = np.clip(scale, 0, 1)
        return result
    resized = resize(picture, (size, size), "repeat")
    for rows in bands(size, size):
        result[rows] = np.clip(resized[rows] * scale, 0, 1)
    return result


def pad(values: Float[np.ndarray, "h w *c"], texels: Texels, padding: int) -> Float[np.ndarray, "h w *c"]:
    """Continue islands outwards: every texel within `padding` texels of a covered one takes the nearest one's values.

    Covered texels and clearly farther ones keep their values (distances are those of `core.image.nearest`, and the ring
    is never narrower than `padding`). Filtered look-ups and mip levels near an island's border then do not mix in
    foreign colours (Blender's bake calls this its margin).
    """
    result = memory.copied(values)
    pad_in_place([result], texels, padding)
    return result


def sharpen_in_place(values: Float[np.ndarray, "h w *c"], texels: Texels) -> None:
    """Sharpen values 0..1 so that bilinear lookups of covered texels best match their sampled function.

    As `exemplar.for_bilinear`, along both axes: minus a twelfth of the second difference, within an island. For
    point-sampled values only; area averages need no sharpening.
    """
    height, width = texels.covered.shape
    above = None  # the original last row of the previous band
    for rows in bands(height, width):
        wide = slice(max(rows.start - 1, 0), min(rows.stop + 1, height))
        was = values[wide].reshape(wide.stop - wide.start, width, -1).copy()
        if above is not None:
            was[0] = above
        above = was[rows.stop - 1 - wide.start].copy()
        island, sharp = texels.island[wide], was.copy()
        for one, following in ((np.s_[:-1], np.s_[1:]), (np.s_[:, :-1], np.s_[:, 1:])):
            joined = (island[one] == island[following])[..., None]
            step = np.where(joined, was[following] - was[one], 0) / 12
            sharp[one] -= step
            sharp[following] += step
        covered = texels.covered[rows]
        inner = sharp[rows.start - wide.start : rows.stop - wide.start]
        values[rows][covered] = np.clip(inner[covered], 0, 1).reshape(-1, *values.shape[2:])


def pad_maps(maps: Maps, texels: Texels, padding: int, own: int = 0) -> Maps:
    """`pad` for albedo, normal, roughness and metallic, with one search for the nearest texels. A ring of `own` texels
    around each island counts as its own: these keep their values, and texels beyond take them."""
    arrays = {name: memory.copied(getattr(maps, name)) for name in ("albedo", "normal", "roughness", "metallic")}
    pad_in_place(list(arrays.values()), texels, padding, own)
    return replace(maps, **arrays)


def pad_in_place(maps: Sequence[np.ndarray], texels: Texels, padding: int, own: int = 0) -> None:
    """`pad_maps` for several arrays of one atlas, written into them."""
    if padding <= 0 or texels.covered.all() or not texels.covered.any():
        return
    index, distance = nearest(dilate(texels.covered, own))
    ring = np.flatnonzero((distance > 0) & (distance <= 1.05 * padding))
    del distance
    source = index.reshape(-1)[ring]
    del index
    for values in maps:
        flat = values.reshape(texels.covered.size, -1)
        flat[ring] = flat.take(source, axis=0)
