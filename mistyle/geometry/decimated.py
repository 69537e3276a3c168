"""UVs from a decimated proxy: decimate, then transfer the proxy's charts to the full mesh."""

from collections.abc import Callable

import numpy as np
from jaxtyping import Bool, Float, Int

from mistyle.core.rows import unit
from mistyle.geometry.normals import area_vectors
from mistyle.geometry.uvs import corner_nodes, group_rows

NEIGHBOURS = 12
CHUNK = 200_000
SMOOTHING = 6


def decimate(
    positions: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"], target: int
) -> tuple[Float[np.ndarray, "w 3"], Int[np.ndarray, "g 3"]]:
    """About `target` faces of the same shape (quadric edge collapse), without faces that lost their area."""
    import fast_simplification

    points, index = fast_simplification.simplify(
        np.ascontiguousarray(positions, np.float64), np.ascontiguousarray(faces, np.int32), target_count=target
    )[:2]
    index = index[np.linalg.norm(area_vectors(points, index), axis=1) > 0]
    return points.astype(np.float32), index.astype(np.int32)


def transfer(
    positions: Float[np.ndarray, "v 3"],
    faces: Int[np.ndarray, "f 3"],
    proxy_positions: Float[np.ndarray, "w 3"],
    proxy_faces: Int[np.ndarray, "g 3"],
    proxy_uvs: Float[np.ndarray, "g 3 2"],
    proxy_chart: Int[np.ndarray, " g"],
    tick: Callable[[], None] = lambda: None,
) -> tuple[Float[np.ndarray, "f 3 2"], Int[np.ndarray, " f"]]:
    """Corner UVs and chart of every face of the full mesh.

    A face takes the chart of the proxy face nearest to its middle (nearest in space, with a penalty for another
    direction). Its corners map to the closest point of that chart, by the barycentric coordinates of the proxy face at
    that point. Beyond the chart's border the coordinates extrapolate, so that faces across it keep their area. One
    corner has one UV per chart, so charts stay connected. Faces may still fold over where the proxy is much coarser
    than the mesh: the caller mends and packs again.
    """
    tree, sample_face = _samples(proxy_positions, proxy_faces)
    corners = proxy_positions[proxy_faces].astype(np.float64)
    normals = unit(area_vectors(proxy_positions, proxy_faces))
    home = _nearest_faces(positions, faces, tree, sample_face, corners, normals, tick)
    home = _smooth(home, proxy_chart, faces)
    chart = proxy_chart[home]
    # One entry per (vertex, chart) in use; the home face of one of its corners is a candidate that always fits.
    key = faces.reshape(-1).astype(np.int64) * (int(proxy_chart.max()) + 2) + np.repeat(chart, 3) + 1
    _, first, back = np.unique(key, return_index=True, return_inverse=True)
    vertex, own = faces.reshape(-1)[first], np.repeat(home, 3)[first]
    border = _border(proxy_faces, proxy_uvs, proxy_chart)
    uvs = np.empty((len(first), 2))
    for start in range(0, len(first), CHUNK):
        part = slice(start, start + CHUNK)
        point = positions[vertex[part]].astype(np.float64)
        near = sample_face[tree.query(point, k=NEIGHBOURS)[1]]
        candidates = np.concatenate([own[part][:, None], near], axis=1)
        weights, distance = closest(point[:, None], corners[candidates])
        distance[proxy_chart[candidates] != proxy_chart[own[part]][:, None]] = np.inf
        best = distance.argmin(axis=1)
        rows = np.arange(len(point))
        face, weight = candidates[rows, best], weights[rows, best]
        beyond = np.any(border[face] & (weight <= 1e-9), axis=1)
        free = _barycentric(point, corners[face])
        beyond &= (free > -1).all(axis=1)  # at slivers the plane's coordinates diverge
        weight = np.where(beyond[:, None], free, weight)
        uvs[part] = np.einsum("nk,nkc->nc", weight, proxy_uvs[face])
        tick()
    return uvs[back].reshape(-1, 3, 2), chart


def _samples(positions: np.ndarray, faces: np.ndarray):
    """A k-d tree over points spread on the faces (more on larger ones), and the face of each point."""
    from scipy.spatial import KDTree

    area = np.linalg.norm(area_vectors(positions, faces), axis=1)
    count = np.clip(np.ceil(4 * area / area.mean()), 1, 64).astype(np.int64)
    face = np.repeat(np.arange(len(faces)), count)
    step = np.arange(len(face)) - np.repeat(np.cumsum(count) - count, count) + 0.5
    # The additive recurrence of the plastic number fills the square evenly; the upper half is folded into the triangle.
    s, t = (step * 0.7548776662466927) % 1, (step * 0.5698402909980532) % 1
    over = s + t > 1
    s, t = np.where(over, 1 - s, s), np.where(over, 1 - t, t)
    single = count[face] == 1
    s, t = np.where(single, 1 / 3, s), np.where(single, 1 / 3, t)
    a, b, c = (positions[faces[face, k]].astype(np.float64) for k in range(3))
    return KDTree(a + (b - a) * s[:, None] + (c - a) * t[:, None]), face


def _nearest_faces(positions, faces, tree, sample_face, corners, normals, tick) -> Int[np.ndarray, " f"]:
    """The proxy face that lies nearest to each face's middle; a different orientation adds distance."""
    result = np.empty(len(faces), np.int64)
    reach = np.sqrt(
        np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).mean()
    )
    for start in range(0, len(faces), CHUNK):
        part = faces[start : start + CHUNK]
        middle = positions[part].mean(axis=1).astype(np.float64)
        candidates = sample_face[tree.query(middle, k=NEIGHBOURS)[1]]
        distance = closest(middle[:, None], corners[candidates])[1]
        direction = unit(area_vectors(positions, part))
        turned = 1 - np.einsum("nc,nkc->nk", direction, normals[candidates])
        best = (distance + (0.5 * reach * turned) ** 2).argmin(axis=1)
        result[start : start + CHUNK] = candidates[np.arange(len(part)), best]
        tick()
    return result


def _smooth(home: Int[np.ndarray, " f"], chart: Int[np.ndarray, " g"], faces: Int[np.ndarray, "f 3"]) -> np.ndarray:
    """Majority vote over the three neighbours' charts, SMOOTHING times: borders become straighter, and single faces
    do not become charts."""
    a, b = faces[:, [1, 2, 0]].reshape(-1), faces[:, [2, 0, 1]].reshape(-1)
    edge = group_rows(np.maximum(a, b), np.minimum(a, b))
    order = np.argsort(edge, kind="stable")
    pairs = np.flatnonzero(np.bincount(edge)[edge[order]] == 2)
    neighbour = np.full(len(edge), -1)
    one, two = order[pairs[::2]], order[pairs[1::2]]
    neighbour[one], neighbour[two] = two // 3, one // 3
    neighbour = neighbour.reshape(-1, 3)
    for _ in range(SMOOTHING):
        around = np.where(neighbour >= 0, chart[home[neighbour]], -2)
        joined = home.copy()
        for k in range(3):
            first, second = around[:, k], around[:, (k + 1) % 3]
            outvoted = (first == second) & (first >= 0) & (first != chart[home])
            joined = np.where(outvoted, home[neighbour[:, k]], joined)
        home = joined
    return home


def closest(
    point: Float[np.ndarray, "n one 3"], corners: Float[np.ndarray, "n k 3 3"]
) -> tuple[Float[np.ndarray, "n k 3"], Float[np.ndarray, "n k"]]:
    """Barycentric coordinates of the point of each triangle closest to `point`, and the squared distance to it."""
    inside = _barycentric(point, corners)
    weights = np.where((inside >= 0).all(axis=-1, keepdims=True), inside, 0)
    gap = ((np.einsum("nkc,nkcd->nkd", weights, corners) - point) ** 2).sum(axis=-1)
    gap[(inside < 0).any(axis=-1)] = np.inf
    for k in range(3):
        a, b = corners[..., k, :], corners[..., (k + 1) % 3, :]
        along = b - a
        length = (along**2).sum(axis=-1)
        t = np.clip(((point - a) * along).sum(axis=-1) / np.where(length > 0, length, 1), 0, 1)
        edge_gap = ((a + along * t[..., None] - point) ** 2).sum(axis=-1)
        nearer = edge_gap < gap
        edge = np.zeros_like(weights)
        edge[..., k], edge[..., (k + 1) % 3] = 1 - t, t
        weights = np.where(nearer[..., None], edge, weights)
        gap = np.where(nearer, edge_gap, gap)
    return weights, gap


def _barycentric(point: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Barycentric coordinates of the point's projection onto each triangle's plane; (1, 0, 0) without area."""
    a = corners[..., 0, :]
    e1, e2, p = corners[..., 1, :] - a, corners[..., 2, :] - a, point - a
    d11, d12, d22 = (e1 * e1).sum(-1), (e1 * e2).sum(-1), (e2 * e2).sum(-1)
    p1, p2 = (p * e1).sum(-1), (p * e2).sum(-1)
    det = d11 * d22 - d12 * d12
    fine = det > 0
    det = np.where(fine, det, 1)
    v = np.where(fine, (d22 * p1 - d12 * p2) / det, 0)
    w = np.where(fine, (d11 * p2 - d12 * p1) / det, 0)
    return np.stack([1 - v - w, v, w], axis=-1)


def _border(faces: np.ndarray, uvs: np.ndarray, chart: np.ndarray) -> Bool[np.ndarray, "g 3"]:
    """Whether the edge opposite to each corner is a border of its chart: no other face of the chart continues there
    with the same UVs."""
    nodes = corner_nodes(faces, uvs)
    a, b = nodes[:, [1, 2, 0]].reshape(-1), nodes[:, [2, 0, 1]].reshape(-1)
    edge = group_rows(np.maximum(a, b), np.minimum(a, b), np.repeat(chart, 3))
    return (np.bincount(edge)[edge] == 1).reshape(-1, 3)
