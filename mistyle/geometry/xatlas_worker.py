"""Worker process for xatlas: reads arrays from one .npz file and writes arrays to another.

xatlas reports no progress, cannot be interrupted and may abort the process on broken meshes, so it never runs in the
main process: `python -m mistyle.geometry.xatlas_worker IN.npz OUT.npz`.
"""

import sys
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from jaxtyping import Float, Int

from mistyle.core.rows import distinct, distinct_integers
from mistyle.geometry.raster import fragments
from mistyle.geometry.uvs import signed_areas
from mistyle.process.children import end_with_parent
from mistyle.process.cores import cores

# Chart cost at which a new chart begins. xatlas's default of 2 gives 61 % more charts for
# less than 1 % less stretch (measured on the bunny: 1053 charts against 653).
MAX_COST = 4.0
FIRST_RESOLUTION = 1024
PACK_TRIES = 4
FULLNESS = 0.9  # first guess of how much of the square the charts' padded boxes can fill
MIN_PADDING = 2
# Padding is halved where it would shrink the charts below this scale.
MAX_SHRINK = 0.7
OVERLAP_TEXELS = 2_000_000
CHART_TEXELS = 100_000
MOST_THREADS = 4  # each takes some 0.3 GB
MOST_CELLS = 4 * OVERLAP_TEXELS  # above this, covered texels are sorted instead of counted in the charts' boxes


def run(source: str, target: str) -> None:
    """Unwrap every mesh of `source` that has no uvs_i yet, mend and pack them all: positions_i and faces_i give uvs_i
    (f, 3, 2) in the unit square and chart_i; `resolution` and `padding` are in texels."""
    with np.load(source, allow_pickle=False) as stored:
        data = {name: stored[name] for name in stored.files}
    resolution, padding = int(data["resolution"]), int(data["padding"])

    def unwrapped(i: int) -> tuple[np.ndarray, np.ndarray]:
        positions, faces = data[f"positions_{i}"], data[f"faces_{i}"]
        if f"uvs_{i}" in data:
            uvs, chart = data[f"uvs_{i}"], data[f"chart_{i}"]
        else:
            uvs, chart = charts(positions, faces)
        corners = positions[faces]
        uvs, chart = mend(uvs, chart, corners)
        chart = cut_overlaps(uvs, chart)
        return pack(landscape(uvs, chart), chart, resolution, padding), chart

    result = {}
    # xatlas and sorting release Python's lock. No mesh depends on another, so threads do not change the result.
    with ThreadPoolExecutor(min(MOST_THREADS, cores())) as pool:
        for i, (uvs, chart) in enumerate(pool.map(unwrapped, range(int(data["count"])))):
            result[f"uvs_{i}"], result[f"chart_{i}"] = uvs, chart
    np.savez(target, **result)


def charts(
    positions: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]
) -> tuple[Float[np.ndarray, "f 3 2"], Int[np.ndarray, " f"]]:
    """Cut a mesh into charts: corner UVs (f, 3, 2) in common units and the chart of every face, -1 where xatlas left
    the face out (no area). Charts may be mirrored and lie anywhere."""
    import xatlas

    options, packing = xatlas.ChartOptions(), xatlas.PackOptions()
    options.max_cost = MAX_COST
    packing.resolution = FIRST_RESOLUTION
    packing.rotate_charts = False
    atlas = xatlas.Atlas()
    atlas.add_mesh(np.ascontiguousarray(positions, np.float32), np.ascontiguousarray(faces, np.uint32))
    atlas.generate(options, packing)
    _, index, uv = atlas[0]
    page, chart = atlas.get_mesh_vertex_assignment(0)
    number = chart.astype(np.int64)[index[:, 0]]
    number[page.view(np.int32)[index[:, 0]] < 0] = -1
    return uv[index].astype(np.float64) * np.array([atlas.width, atlas.height]), number


def mend(
    uvs: Float[np.ndarray, "f 3 2"], chart: Int[np.ndarray, " f"], corners: Float[np.ndarray, "f 3 3"]
) -> tuple[Float[np.ndarray, "f 3 2"], Int[np.ndarray, " f"]]:
    """Un-mirror charts, and give faces with positive area in space but not in UV space a chart of their own.

    A chart whose UV area is negative is reflected in u; afterwards a face without positive area is cut out and laid
    flat at the charts' scale. Faces without area in space keep chart -1 and collapse to a point.
    """
    uvs, chart = unmirror(uvs, chart), chart.copy()
    edge1, edge2 = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    area = np.linalg.norm(np.cross(edge1.astype(np.float64), edge2.astype(np.float64)), axis=1) / 2
    flat = signed_areas(uvs)
    placed = chart >= 0
    scale = np.sqrt(np.abs(flat[placed]).sum() / area[placed].sum()) if area[placed].sum() > 0 else 1.0
    real = area > 1e-12 * area.sum() / max(len(area), 1)
    invalid = np.flatnonzero(real & ((flat <= 1e-9 * scale**2 * area) | ~placed))
    uvs[~real & ~placed] = 0
    uvs[invalid] = lay_flat(corners[invalid]) * scale
    chart[invalid] = chart.max(initial=-1) + 1 + np.arange(len(invalid))
    chart[~real & ~placed] = -1
    return uvs, chart


def unmirror(uvs: Float[np.ndarray, "f 3 2"], chart: Int[np.ndarray, " f"]) -> Float[np.ndarray, "f 3 2"]:
    """Reflect every chart whose summed UV area is negative in its own bounding box (u -> lowest + highest - u)."""
    uvs, placed = uvs.copy(), np.flatnonzero(chart >= 0)
    if len(placed) == 0:
        return uvs
    order = placed[np.argsort(chart[placed], kind="stable")]
    starts = np.flatnonzero(np.concatenate([[True], np.diff(chart[order]) != 0]))
    total = np.add.reduceat(signed_areas(uvs)[order], starts)
    low = np.minimum.reduceat(uvs[order, :, 0].min(axis=1), starts)
    high = np.maximum.reduceat(uvs[order, :, 0].max(axis=1), starts)
    which = np.repeat(np.arange(len(starts)), np.diff(np.append(starts, len(order))))
    mirrored = total[which] < 0
    faces = order[mirrored]
    uvs[faces, :, 0] = (low + high)[which][mirrored][:, None] - uvs[faces, :, 0]
    return uvs


def landscape(uvs: Float[np.ndarray, "f 3 2"], chart: Int[np.ndarray, " f"]) -> Float[np.ndarray, "f 3 2"]:
    """Turn (never reflect) every chart that is taller than wide by 90 degrees: the packer may not rotate charts, since
    its rotation is a reflection, and packs tighter when charts share an orientation."""
    uvs, placed = uvs.copy(), np.flatnonzero(chart >= 0)
    if len(placed) == 0:
        return uvs
    order = placed[np.argsort(chart[placed], kind="stable")]
    starts = np.flatnonzero(np.concatenate([[True], np.diff(chart[order]) != 0]))
    extent = np.maximum.reduceat(uvs[order].max(axis=1), starts) - np.minimum.reduceat(uvs[order].min(axis=1), starts)
    which = np.repeat(np.arange(len(starts)), np.diff(np.append(starts, len(order))))
    faces = order[(extent[:, 1] > extent[:, 0])[which]]
    uvs[faces] = np.stack([-uvs[faces, :, 1], uvs[faces, :, 0]], axis=-1)
    return uvs


def lay_flat(corners: Float[np.ndarray, "n 3 3"]) -> Float[np.ndarray, "n 3 2"]:
    """Triangles (n, 3, 3) laid into the plane at true size, counter-clockwise, the longest edge along u."""
    sides = np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=2)
    first = sides.argmax(axis=1)
    rows = np.arange(len(corners))
    a, b, c = (corners[rows, (first + k) % 3].astype(np.float64) for k in range(3))
    base = np.linalg.norm(b - a, axis=1)
    along = ((b - a) * (c - a)).sum(axis=1) / np.where(base > 0, base, 1)
    height = np.sqrt(np.maximum(((c - a) ** 2).sum(axis=1) - along**2, 0))
    flat = np.zeros((len(corners), 3, 2))
    flat[rows, (first + 1) % 3, 0] = base
    flat[rows, (first + 2) % 3] = np.stack([along, height], axis=-1)
    return flat


def cut_overlaps(uvs: Float[np.ndarray, "f 3 2"], chart: Int[np.ndarray, " f"]) -> Int[np.ndarray, " f"]:
    """Give the part of a chart that overlaps an earlier part a chart of its own, until no chart overlaps itself.

    xatlas accepts charts whose border crosses itself a little; two surface points would share texels. "Earlier" counts
    the steps from face to face across the chart, so that the cut part is connected.
    """
    chart = chart.copy()
    for _ in range(12):
        folded = _folded_charts(uvs, chart)
        if len(folded) == 0:
            break
        for number in folded:
            faces = np.flatnonzero(chart == number)
            steps = _steps(uvs[faces])
            flat = uvs[faces] - uvs[faces].min(axis=(0, 1))
            scale = np.sqrt(CHART_TEXELS / np.abs(signed_areas(flat)).sum())
            face, texel = fragments(flat * scale, 1 << 20, wrap=False)
            order = np.lexsort((steps[face], texel))
            again = np.concatenate([[False], texel[order][1:] == texel[order][:-1]])
            chart[faces[distinct_integers(face[order][again])]] = chart.max() + 1
    return chart


def _steps(uvs: Float[np.ndarray, "f 3 2"]) -> Int[np.ndarray, " f"]:
    """Breadth-first rank of each face from the first one across common UVs; unreachable faces come last."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import breadth_first_order

    count = len(uvs)
    node = distinct(uvs.reshape(-1, 2))[1]
    size = count + int(node.max()) + 1
    face = np.repeat(np.arange(count), 3)
    graph = coo_matrix((np.ones(len(face), np.int8), (face, count + node)), shape=(size, size)).tocsr()
    reached = breadth_first_order(graph, 0, directed=False, return_predecessors=False)
    rank = np.full(size, size)
    rank[reached] = np.arange(len(reached))
    return rank[:count]


def _folded_charts(uvs: Float[np.ndarray, "f 3 2"], chart: Int[np.ndarray, " f"]) -> Int[np.ndarray, " c"]:
    """Charts of several faces in which more than one texel in a thousand (and more than two) is covered twice."""
    faces = np.flatnonzero(chart >= 0)
    if len(faces) == 0:
        return faces
    order = faces[np.argsort(chart[faces], kind="stable")]
    starts = np.flatnonzero(np.concatenate([[True], np.diff(chart[order]) != 0]))
    which = np.repeat(np.arange(len(starts)), np.diff(np.append(starts, len(order))))
    origin = np.minimum.reduceat(uvs[order].min(axis=1), starts)
    scale = np.sqrt(OVERLAP_TEXELS / np.abs(signed_areas(uvs[order])).sum())
    size = 1 << 20
    face, texel = fragments((uvs[order] - origin[which][:, None]) * scale, size, wrap=False)
    high = np.maximum.reduceat(uvs[order].max(axis=1), starts)
    sides = np.minimum(np.ceil((high - origin) * scale) + 1, size)
    texels, double = _covered_texels(which[face], texel % size, texel // size, sides)
    members = np.bincount(which, minlength=len(starts))
    return chart[order[starts]][(double > np.maximum(2, texels / 1000)) & (members > 1)]


def _covered_texels(
    chart: Int[np.ndarray, " n"], column: Int[np.ndarray, " n"], row: Int[np.ndarray, " n"], sides: np.ndarray
) -> tuple[Int[np.ndarray, " c"], Int[np.ndarray, " c"]]:
    """How many texels each chart covers, and how many of them at least twice. `sides` (c, 2) are the width and height
    of the charts' boxes in texels, which begin at 0."""
    cells = sides[:, 0] * sides[:, 1]
    if cells.sum() > MOST_CELLS:  # Long slanted charts: sorted by chart (2^23), row and column (2^20 each).
        place, count = np.unique((chart << 40) + (row << 20) + column, return_counts=True)
        owner = place >> 40
        return np.bincount(owner, minlength=len(sides)), np.bincount(owner[count > 1], minlength=len(sides))
    begin = np.concatenate([[0], np.cumsum(cells[:-1])]).astype(np.int64)
    width = sides[:, 0].astype(np.int64)
    count = np.bincount(begin[chart] + row * width[chart] + column, minlength=int(cells.sum()))
    return np.add.reduceat(count > 0, begin, dtype=np.int64), np.add.reduceat(count > 1, begin, dtype=np.int64)


def pack(
    uvs: Float[np.ndarray, "f 3 2"], chart: Int[np.ndarray, " f"], resolution: int, padding: int
) -> Float[np.ndarray, "f 3 2"]:
    """Move and scale the charts (no rotation, no reflection) into the unit square, `padding` texels apart in an atlas
    of resolution²; less padding where many small charts need more room for padding than for themselves. Faces of chart
    -1 collapse to the square's middle."""
    placed = chart >= 0
    result = np.full(uvs.shape, 0.5)
    if not placed.any():
        return result
    faces = uvs[placed]
    keys = np.concatenate([np.repeat(chart[placed], 3)[:, None], faces.reshape(-1, 2)], axis=1)
    first, index = distinct(keys)
    result[placed] = _pack_to(keys[first, 1:], index.reshape(-1, 3), chart[placed], resolution, padding)
    return result


def _pack_to(
    vertices: Float[np.ndarray, "w 2"],
    index: Int[np.ndarray, "f 3"],
    chart: Int[np.ndarray, " f"],
    resolution: int,
    padding: int,
) -> Float[np.ndarray, "f 3 2"]:
    """Search the largest scale at which the charts fit the atlas.

    Packing costs much more than estimating: a chart of w x h at scale s takes about (w s + padding) (h s + padding)
    texels. This gives the scale for a target area. The packer's result then corrects the target area.
    """
    boxes = _boxes(vertices[index], chart)
    aim = FULLNESS * resolution**2
    bare = _scale(boxes, MIN_PADDING, aim)
    while padding > MIN_PADDING and _scale(boxes, padding, aim) < MAX_SHRINK * bare:
        padding //= 2
    best, best_scale = None, 0.0
    packed, size = vertices[index], resolution
    for attempt in range(3 * PACK_TRIES):
        scale = _scale(boxes, padding, aim)
        packed, size = _pack_once(vertices * scale, index, chart, padding)
        if size <= resolution and scale > best_scale:
            best, best_scale = packed / resolution, scale
        if best is not None and (attempt + 1 >= PACK_TRIES or 0.985 * resolution < size <= resolution):
            return best
        aim *= (0.995 * resolution / size) ** 2
    # More charts than the atlas holds at one padded texel each: shrink them until texels are shared.
    return packed / float(max(size, resolution)) if best is None else best


def _boxes(uvs: Float[np.ndarray, "f 3 2"], chart: Int[np.ndarray, " f"]) -> Float[np.ndarray, "c 2"]:
    """Width and height of every chart."""
    order = np.argsort(chart, kind="stable")
    starts = np.flatnonzero(np.concatenate([[True], np.diff(chart[order]) != 0]))
    return np.maximum.reduceat(uvs[order].max(axis=1), starts) - np.minimum.reduceat(uvs[order].min(axis=1), starts)


def _scale(boxes: Float[np.ndarray, "c 2"], padding: int, aim: float) -> float:
    """The scale at which padded boxes cover `aim` texels; tiny where the padding alone exceeds it."""
    a, b = (boxes[:, 0] * boxes[:, 1]).sum(), (padding + 1) * boxes.sum()
    c = len(boxes) * (padding + 1) ** 2 - aim
    floor = 1e-3 * np.sqrt(aim / a)
    return float(max((-b + np.sqrt(max(b * b - 4 * a * c, 0.0))) / (2 * a), floor))


def _pack_once(
    vertices: Float[np.ndarray, "w 2"], index: Int[np.ndarray, "f 3"], chart: Int[np.ndarray, " f"], padding: int
) -> tuple[Float[np.ndarray, "f 3 2"], int]:
    """Charts packed at one texel a unit: corner positions in texels and the side of the enclosing square."""
    import xatlas

    packing = xatlas.PackOptions()
    packing.texels_per_unit = 1.0
    packing.padding = padding
    packing.bilinear = True
    packing.rotate_charts = False
    packing.rotate_charts_to_axis = False
    atlas = xatlas.Atlas()
    material = np.ascontiguousarray(chart[:, None], np.uint32)  # separates charts that touch or overlap
    atlas.add_uv_mesh(np.ascontiguousarray(vertices, np.float32), np.ascontiguousarray(index, np.uint32), material)
    atlas.generate(pack_options=packing)
    _, order, uv = atlas[0]
    return uv[order].astype(np.float64) * np.array([atlas.width, atlas.height]), max(atlas.width, atlas.height)


if __name__ == "__main__":
    end_with_parent()
    run(sys.argv[1], sys.argv[2])
