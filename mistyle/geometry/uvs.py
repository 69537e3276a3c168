"""Analysis of authored UVs: islands, whole-face shifts into the unit square, UDIM tiles, overlaps."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from mistyle.core.rows import distinct_integers
from mistyle.geometry.raster import fragments

# UVs are float32: a coordinate this close to a tile's border lies on it.
BORDER = 1e-5
# Below this a UV triangle has no area in float32 (both coordinates near 1, spacing 6e-8).
NO_AREA = 1e-13
RASTER = 512
MAX_DEGENERATE = 0.01  # share of the surface without UV area
MAX_OVERLAP = 0.01  # share of covered texels with unintended overlaps
MIN_COVERAGE = 0.002  # share of the square in use; colour-swatch UVs stay below it
SPILL = 0.1  # of a UDIM tile, by which an island may leave the tile that it stays in as a whole
COINCIDE = 0.97  # islands that cover each other this far coincide


@dataclass(frozen=True)
class Verdict:
    """Whether one texture set's UVs can be painted. `reason` is the reason why not; the shares are of the covered
    texels (overlap, shared) and of the UV area (mirrored, coverage of the square)."""

    usable: bool
    reason: str
    overlap: float = 0.0
    shared: float = 0.0
    mirrored: float = 0.0
    coverage: float = 0.0


@dataclass(frozen=True)
class Layout:
    """UVs in working layout: whole faces moved by integers. `tile` is the UDIM tile of each face (1001 + u + 10 v),
    1001 for all where the set is not tiled; `verdicts` has one entry per tile in ascending order. `beyond` counts the
    faces that reach beyond their tile, `astray` the faces that lie in no tile of a set whose textures are tiles."""

    uvs: Float[np.ndarray, "f 3 2"]
    tile: Int[np.ndarray, " f"]
    verdicts: tuple[Verdict, ...]
    beyond: int = 0
    astray: int = 0

    @property
    def usable(self) -> bool:
        return all(v.usable for v in self.verdicts)


def signed_areas(uvs: Float[np.ndarray, "f 3 2"]) -> Float[np.ndarray, " f"]:
    """UV area of every face; negative where the chart is mirrored (faces are counter-clockwise in space)."""
    a, b, c = (uvs[:, k].astype(np.float64) for k in range(3))
    return ((b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (c[:, 0] - a[:, 0]) * (b[:, 1] - a[:, 1])) / 2


def group_rows(*columns: np.ndarray) -> Int[np.ndarray, " n"]:
    """A number per row, equal for equal rows, ascending with the rows' order (last column first)."""
    order = np.lexsort(columns)
    new = np.zeros(len(order), bool)
    for column in columns:
        ordered = column[order]
        new[1:] |= ordered[1:] != ordered[:-1]
    result = np.empty(len(order), np.int64)
    result[order] = np.cumsum(new)
    return result


def corner_nodes(points: Int[np.ndarray, "f 3"], uvs: Float[np.ndarray, "f 3 2"]) -> Int[np.ndarray, "f 3"]:
    """A number per face corner, equal where both the point in space and the UV are equal."""
    flat = uvs.reshape(-1, 2) + 0.0
    return group_rows(points.reshape(-1), flat[:, 0], flat[:, 1]).reshape(-1, 3)


def islands(points: Int[np.ndarray, "f 3"], uvs: Float[np.ndarray, "f 3 2"]) -> Int[np.ndarray, " f"]:
    """Number the UV islands from 0 in face order: faces that share a point with the same UV belong together."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    count = len(points)
    if count == 0:
        return np.zeros(0, np.int64)
    nodes = corner_nodes(points, uvs).reshape(-1)
    face = np.repeat(np.arange(count), 3)
    size = count + int(nodes.max()) + 1
    graph = coo_matrix((np.ones(len(face), np.int8), (face, count + nodes)), shape=(size, size))
    label = connected_components(graph, directed=False)[1][:count]
    _, first, inverse = np.unique(label, return_index=True, return_inverse=True)
    rank = np.empty(len(first), np.int64)
    rank[np.argsort(first)] = np.arange(len(first))
    return rank[inverse]


def island_boxes(uvs: Float[np.ndarray, "f 3 2"], island: Int[np.ndarray, " f"]) -> tuple[np.ndarray, np.ndarray]:
    """Lowest and highest UV of every island, two (islands, 2) arrays."""
    order = np.argsort(island, kind="stable")
    starts = np.flatnonzero(np.concatenate([[True], np.diff(island[order]) != 0]))
    lo = np.minimum.reduceat(uvs.min(axis=1)[order], starts, axis=0)
    hi = np.maximum.reduceat(uvs.max(axis=1)[order], starts, axis=0)
    return lo.astype(np.float64), hi.astype(np.float64)


def shift(uvs: Float[np.ndarray, "f 3 2"], island: Int[np.ndarray, " f"]) -> Float[np.ndarray, "f 3 2"]:
    """Move whole faces by integers towards the unit square.

    An island that fits one tile moves into the square as a whole. One that fits the square's size but crosses a tile
    border moves until its middle is inside, so coordinates stay in [-0.5, 1.5]. In a larger one every face moves by its
    own middle (the texture repeats anyway). UVs that need no move stay bit-equal.
    """
    lo, hi = island_boxes(uvs, island)
    corner = np.floor(lo + BORDER)
    whole = hi - corner <= 1 + BORDER
    middle = np.floor((lo + hi) / 2)
    base = np.where(whole, corner, middle)[island]
    large = (hi - lo > 1 + BORDER)[island]
    own = np.floor((uvs.min(axis=1).astype(np.float64) + uvs.max(axis=1)) / 2)
    base = np.where(large, own, base)
    return _moved(uvs, base)


def _moved(uvs: Float[np.ndarray, "f 3 2"], base: Float[np.ndarray, "f 2"]) -> Float[np.ndarray, "f 3 2"]:
    moved = (uvs.astype(np.float64) - base[:, None]).astype(uvs.dtype)
    return np.where((base == 0)[:, None], uvs, moved)


def tiles(uvs: Float[np.ndarray, "f 3 2"], island: Int[np.ndarray, " f"]) -> Int[np.ndarray, "f 2"] | None:
    """The UDIM tile (u, v) of every face, or None where the UVs are not a UDIM layout: every island must lie inside one
    tile with u in 0..9 and v in 0..9."""
    lo, hi = island_boxes(uvs, island)
    corner = np.floor(lo + BORDER)
    if (hi - corner > 1 + BORDER).any() or (corner < 0).any() or (corner > 9).any():
        return None
    return corner.astype(np.int64)[island]


def nearest_tiles(
    uvs: Float[np.ndarray, "f 3 2"], island: Int[np.ndarray, " f"]
) -> tuple[Int[np.ndarray, "f 2"], Bool[np.ndarray, " f"]]:
    """The UDIM tile (u, v) in which every face lies mostly, in 0..9, and whether the face lies in no such tile.

    An island that leaves the tile of its middle by SPILL at most stays whole; the faces of others go by their own
    middle. Faces in no tile get the nearest.
    """
    lo, hi = island_boxes(uvs, island)
    tile = np.floor((lo + hi) / 2)
    low, high = uvs.min(axis=1).astype(np.float64), uvs.max(axis=1).astype(np.float64)
    whole = np.maximum(tile - lo, hi - tile - 1).max(axis=1) <= SPILL
    tile = np.where(whole[island, None], tile[island], np.floor((low + high) / 2)).astype(np.int64)
    nearest = np.clip(tile, 0, 9)
    return nearest, (nearest != tile).any(axis=1)


def arrange(
    points: Int[np.ndarray, "f 3"], uvs: Float[np.ndarray, "f 3 2"], area: Float[np.ndarray, " f"], udim: bool | None
) -> Layout:
    """The working layout of authored UVs, and their verdicts.

    `area` is each face's area in space. `udim`: True when the material's textures are named as tiles, False when one
    texture repeats over every tile, None when unknown. Then islands in several tiles count as a UDIM layout,
    unless they coincide exactly in the square (shells moved one tile away to share texels). Named tiles hold unless
    most of the area lies in none of them.
    """
    single = np.full(len(uvs), 1001)
    if not np.isfinite(uvs).all():
        return Layout(np.nan_to_num(uvs), single, (Verdict(False, "some faces have no or infinite UVs"),))
    if np.abs(uvs).max(initial=0) > 1e4:
        return Layout(uvs, single, (Verdict(False, "UVs reach further than 10000 tiles"),))
    island = islands(points, uvs)
    tile, astray = None if udim is False else tiles(uvs, island), 0
    if tile is None and udim:
        tile, outside = nearest_tiles(uvs, island)
        astray = int(outside.sum())
        tile = None if area[outside].sum() > area.sum() / 2 else tile
    if tile is not None and (udim or len(np.unique(tile, axis=0)) > 1):
        number = 1001 + tile[:, 0] + 10 * tile[:, 1]
        moved = _moved(uvs, tile.astype(np.float64))
        merged = None if udim else judge(points, moved, area)
        if merged is None or not merged.usable or merged.shared == 0:
            numbers = np.unique(number)
            verdicts = tuple(judge(points[number == n], moved[number == n], area[number == n]) for n in numbers)
            beyond = ((moved.min(axis=1) < -BORDER) | (moved.max(axis=1) > 1 + BORDER)).any(axis=1)
            return Layout(moved, number, verdicts, int(beyond.sum()), astray)
        return Layout(moved, single, (merged,))
    moved = shift(uvs, island)
    return Layout(moved, single, (judge(points, moved, area),), astray=astray)


def judge(points: Int[np.ndarray, "f 3"], uvs: Float[np.ndarray, "f 3 2"], area: Float[np.ndarray, " f"]) -> Verdict:
    """Whether one set of UVs (taken modulo 1) can be painted: enough area, and no texel that two faces cover
    unintentionally. Sampled at RASTER² texel centres."""
    flat = signed_areas(uvs)
    total = area.sum()
    degenerate = area[np.abs(flat) <= NO_AREA].sum() / total if total > 0 else 1.0
    if degenerate > MAX_DEGENERATE:
        return Verdict(False, f"{degenerate:.0%} of the surface has no area in UV space")
    if np.abs(flat).sum() > 64 or (np.ptp(uvs, axis=1) > 4).any():
        return Verdict(False, "the texture repeats many times over the surface")
    mirrored = float(np.abs(flat[flat < 0]).sum() / np.abs(flat).sum())
    distinct_faces = _first_of_twins(points, uvs)
    face, texel = fragments(uvs[distinct_faces].astype(np.float64) * RASTER, RASTER)
    covered = np.count_nonzero(np.bincount(texel, minlength=RASTER**2))
    coverage = covered / RASTER**2
    overlap, shared = _overlaps(points[distinct_faces], uvs[distinct_faces], face, texel)
    shared = max(shared, 1 - len(distinct_faces) / len(uvs))
    numbers = dict(overlap=overlap, shared=shared, mirrored=mirrored, coverage=coverage)
    if overlap > MAX_OVERLAP:
        return Verdict(False, f"{overlap:.0%} of its texels are claimed by faces that do not share them", **numbers)
    if coverage < MIN_COVERAGE:
        return Verdict(False, f"it uses only {coverage:.2%} of the texture", **numbers)
    return Verdict(True, "", **numbers)


def _first_of_twins(points: Int[np.ndarray, "f 3"], uvs: Float[np.ndarray, "f 3 2"]) -> Int[np.ndarray, " k"]:
    """Faces without those that repeat an earlier face's three points and UVs (double-sided copies)."""
    nodes = np.sort(corner_nodes(points, uvs), axis=1)
    group = group_rows(nodes[:, 2], nodes[:, 1], nodes[:, 0])
    return np.sort(np.unique(group, return_index=True)[1])


def _overlaps(
    points: Int[np.ndarray, "f 3"],
    uvs: Float[np.ndarray, "f 3 2"],
    face: Int[np.ndarray, " n"],
    texel: Int[np.ndarray, " n"],
) -> tuple[float, float]:
    """Shares of the covered texels with unintended and with intended overlaps."""
    counts = np.bincount(texel, minlength=RASTER * RASTER)
    covered = np.count_nonzero(counts)
    several = counts[texel] > 1
    if not several.any():
        return 0.0, 0.0
    island = islands(points, uvs)
    # By texel, island and face: fragments come in face order.
    order = np.argsort(texel[several] * (int(island.max()) + 1) + island[face[several]], kind="stable")
    f, t = face[several][order], texel[several][order]
    same = t[1:] == t[:-1]
    first, second, where = f[:-1][same], f[1:][same], t[1:][same]
    intended = _stacked(points, uvs)
    fine = intended[first] & intended[second] & (first != second)
    a, b = island[first], island[second]
    fine |= (a != b) & _coincident(a, b, island[face], texel)
    bad = np.count_nonzero(np.bincount(where[~fine], minlength=1))
    all_shared = np.count_nonzero(counts > 1)
    return bad / covered, (all_shared - bad) / covered


def _coincident(
    a: Int[np.ndarray, " p"], b: Int[np.ndarray, " p"], island: Int[np.ndarray, " n"], texel: Int[np.ndarray, " n"]
) -> Bool[np.ndarray, " p"]:
    """Whether the two islands of each overlap cover (nearly) the same texels."""
    size = np.bincount(distinct_integers(island * (RASTER * RASTER) + texel) // (RASTER * RASTER))
    pair = group_rows(a, b)
    common = np.bincount(pair)[pair]
    return common >= COINCIDE * np.maximum(size[a], size[b])


def _stacked(points: Int[np.ndarray, "f 3"], uvs: Float[np.ndarray, "f 3 2"]) -> Bool[np.ndarray, " f"]:
    """Faces whose corners all lie on corners of other points in UV space, or on the line where an island folds over:
    the mark of intentionally stacked shells."""
    flat = signed_areas(uvs)
    edges = np.linalg.norm(uvs - np.roll(uvs, 1, axis=1), axis=2)
    cells = int(np.ceil(max(2048.0, 10 / max(float(np.median(edges)), 1e-5))))
    nodes = corner_nodes(points, uvs).reshape(-1)
    unique_nodes, first = np.unique(nodes, return_index=True)
    uv, point = uvs.reshape(-1, 2)[first].astype(np.float64) % 1, points.reshape(-1)[first]
    stacked = np.zeros(len(unique_nodes), np.bool_)
    for offset in ((0, 0), (0.5, 0), (0, 0.5), (0.5, 0.5)):
        x, y = (np.floor(uv * cells + offset).astype(np.int64) % cells).T
        cell = group_rows(x, y)
        pair = group_rows(point, cell)
        distinct = np.unique(pair, return_index=True)[1]
        stacked |= (np.bincount(cell[distinct], minlength=cell.max() + 1) > 1)[cell]
    signs = np.repeat(np.sign(flat), 3)
    plus = np.bincount(nodes, weights=signs > 0)
    minus = np.bincount(nodes, weights=signs < 0)
    fold = (plus > 0) & (minus > 0)
    return np.asarray((stacked | fold)[nodes].reshape(-1, 3).all(axis=1))
