"""MikkTSpace tangents: the frame of glTF's and our normal maps.

The algorithm is Morten Mikkelsen's ("Simulation of Wrinkled Surfaces Revisited", 2008, chapter on tangent space, and
its public reference implementation): corners with equal position, normal and uv are one vertex; around it, faces
joined by shared edges and of one uv handedness form a group; a group's tangent is the angle-weighted sum of the
faces' tangents, each projected into the plane of the vertex normal. Decisions (uv area, handedness, degeneracy) are
computed in float32 like the reference, so that borderline faces fall on the same side.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from mistyle.core.mesh import Mesh, weld
from mistyle.core.rows import distinct_integers, sums

_TINY = np.finfo(np.float32).tiny


def mikktspace(
    positions: Float[np.ndarray, "w 3"],
    normals: Float[np.ndarray, "w 3"],
    uvs: Float[np.ndarray, "w 2"],
    faces: Int[np.ndarray, "f 3"],
) -> Float[np.ndarray, "f 3 4"]:
    """Per-corner tangent (unit) and sign; the bitangent is sign * cross(normal, tangent) and follows growing v.

    With v up, as in all our records, the result is glTF's TANGENT for its own (v down) texture coordinates. Normals are
    unit vectors.

    Where the reference has no result (no uv area around the vertex, or tangents that cancel) it returns (1, 0, 0)
    or zero; here such a corner gets a unit vector perpendicular to its normal, and sign -1 without uv
    area. The reference's angular threshold is at its default of 180 degrees, and groups are not split where two
    tangents are exactly opposite.
    """
    result = _perpendicular(normals.astype(np.float32))[faces]
    result = np.concatenate([result, np.full((*faces.shape, 1), -1, np.float32)], axis=-1)
    if len(faces) == 0:
        return result
    vertex, chosen = _shared_vertices(positions, normals, uvs)
    corners = vertex[faces]
    position, normal, uv = (x[chosen].astype(np.float32) for x in (positions, normals, uvs))
    point = _point_ids(position)[corners]
    good = (point[:, 0] != point[:, 1]) & (point[:, 1] != point[:, 2]) & (point[:, 2] != point[:, 0])
    valid_faces = np.flatnonzero(good)
    if len(valid_faces) == 0:
        return result
    valid_corners = corners[valid_faces]
    frames = _face_frames(position[valid_corners], uv[valid_corners])
    group, positive = _groups(valid_corners, frames)
    tangent, valid = _group_tangents(valid_corners, position, normal, frames, group)
    inside = group >= 0
    use = np.zeros_like(inside)
    use[inside] = valid[group[inside]]
    tangents = result[valid_faces]
    tangents[use, :3] = tangent[group[use]]
    tangents[inside, 3] = np.where(positive[inside], 1, -1)
    result[valid_faces] = tangents
    _copy_to_degenerate(result, corners, good)
    return result


@dataclass(frozen=True)
class _Frames:
    """Per face: unit tangent along growing u, whether its uvs keep the orientation, whether it has no tangent."""

    tangent: Float[np.ndarray, "f 3"]
    positive: Bool[np.ndarray, " f"]
    silent: Bool[np.ndarray, " f"]


def corner_tangents(mesh: Mesh) -> Float[np.ndarray, "f 3 4"]:
    """`mikktspace` of a whole mesh, per face corner."""
    welded = weld(mesh)
    return mikktspace(welded.positions, welded.normals, welded.uvs, welded.faces)


def _shared_vertices(positions, normals, uvs) -> tuple[np.ndarray, np.ndarray]:
    """Number the distinct (position, normal, uv): the number of every input row, and one row of every number."""
    # Adding 0 turns -0.0 into 0.0: the reference compares values, not bits.
    rows = np.concatenate([positions, normals, uvs], axis=1).astype(np.float32) + np.float32(0)
    _, chosen, vertex = np.unique(_as_keys(rows), return_index=True, return_inverse=True)
    return vertex.reshape(-1), chosen


def _point_ids(positions: np.ndarray) -> np.ndarray:
    return np.unique(_as_keys(positions + np.float32(0)), return_inverse=True)[1].reshape(-1)


def _as_keys(rows: np.ndarray) -> np.ndarray:
    rows = np.ascontiguousarray(rows)
    return rows.view(np.dtype((np.void, rows.dtype.itemsize * rows.shape[1]))).reshape(-1)


def _face_frames(p: Float[np.ndarray, "f 3 3"], t: Float[np.ndarray, "f 3 2"]) -> _Frames:
    """First-order derivative of the position along u on every face (all of it float32)."""
    t21, t31, d1, d2 = t[:, 1] - t[:, 0], t[:, 2] - t[:, 0], p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]
    area = t21[:, 0] * t31[:, 1] - t21[:, 1] * t31[:, 0]
    along_u = t31[:, 1:] * d1 - t21[:, 1:] * d2
    along_v = t21[:, :1] * d2 - t31[:, :1] * d1
    length_u, length_v = _length(along_u), _length(along_v)
    positive = area > 0
    has_area = np.abs(area) > _TINY
    safe = np.where(has_area, np.abs(area), np.float32(1))
    with np.errstate(over="ignore"):
        has_tangent = has_area & (length_u / safe > _TINY) & (length_v / safe > _TINY)
    sign = np.where(positive, np.float32(1), np.float32(-1))
    tangent = along_u * (sign / np.where(length_u > _TINY, length_u, np.float32(1)))[:, None]
    return _Frames(np.where(has_area[:, None], tangent, np.float32(0)), positive, ~has_tangent)


def _groups(corners: Int[np.ndarray, "f 3"], frames: _Frames) -> tuple[Int[np.ndarray, "f 3"], Bool[np.ndarray, "f 3"]]:
    """Group number of every corner (-1: none) and the handedness of its group."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    links = _corner_links(corners)
    face = links // 3
    has_tangent = ~frames.silent[face].any(axis=1)
    joined = links[has_tangent & (frames.positive[face[:, 0]] == frames.positive[face[:, 1]])]
    count = corners.size
    graph = coo_array((np.ones(len(joined), bool), (joined[:, 0], joined[:, 1])), shape=(count, count))
    label = connected_components(graph, directed=False)[1].astype(np.int64)
    label[np.repeat(frames.silent, 3)] = -1
    positive = np.repeat(frames.positive, 3)
    if frames.silent.any():
        _join_silent(corners.reshape(-1), links, frames, label, positive)
    used = label >= 0
    label[used] = np.unique(label[used], return_inverse=True)[1]
    return label.reshape(-1, 3), positive.reshape(-1, 3)


def _corner_links(corners: Int[np.ndarray, "f 3"]) -> Int[np.ndarray, "k 2"]:
    """Pairs of corners of one vertex in two faces that share an edge at it, in opposite directions.

    More than two faces at an edge are paired in order of their numbers, as in the reference.
    """
    start = np.arange(corners.size)
    end = (start // 3) * 3 + (start + 1) % 3
    a, b = corners.reshape(-1), corners.reshape(-1)[end]
    low, high = np.minimum(a, b), np.maximum(a, b)
    order = np.lexsort((start // 3, high, low))
    new = np.r_[True, (low[order][1:] != low[order][:-1]) | (high[order][1:] != high[order][:-1])]
    first = np.flatnonzero(new)
    size = np.diff(np.r_[first, len(order)])
    two = first[size == 2]
    x, y = order[two], order[two + 1]
    opposite = a[x] == b[y]
    pairs = [np.stack([x, y], axis=1)[opposite]]
    for begin, number in zip(first[size > 2], size[size > 2], strict=True):
        rest = order[begin : begin + number].tolist()
        while rest:
            edge = rest.pop(0)
            match = next((e for e in rest if a[edge] == b[e]), None)
            if match is not None:
                rest.remove(match)
                pairs.append(np.array([[edge, match]]))
    x, y = np.concatenate(pairs).T
    return np.concatenate([np.stack([x, end[y]], axis=1), np.stack([end[x], y], axis=1)])


def _join_silent(vertex, links, frames: _Frames, label: np.ndarray, positive: np.ndarray) -> None:
    """Redo the grouping, group by group, at vertices of faces without a tangent of their own.

    Such a face joins any group and takes the handedness of the first that reaches it, so the order matters. It is
    the reference's (faces and corners ascending). Changes `label` and `positive` of these corners in place.
    """
    silent = frames.silent
    touched = np.isin(vertex, distinct_integers(vertex.reshape(-1, 3)[silent]))
    near: dict[int, list[int]] = {}
    for a, b in links[touched[links[:, 0]]].tolist():
        near.setdefault(a, []).append(b)
        near.setdefault(b, []).append(a)
    side: dict[int, bool | None] = {int(f): None for f in np.flatnonzero(silent)}
    label[touched] = -1
    fresh = int(label.max(initial=0)) + len(label)
    for corner in np.flatnonzero(touched & ~np.repeat(silent, 3)).tolist():
        if label[corner] >= 0:
            continue
        fresh, waiting, hand = fresh + 1, [corner], bool(positive[corner])
        while waiting:
            c = waiting.pop()
            f = c // 3
            if label[c] >= 0:
                continue
            if f in side and side[f] is None:
                side[f] = hand
            if (side[f] if f in side else bool(frames.positive[f])) != hand:
                continue
            label[c], positive[c] = fresh, hand
            waiting.extend(near.get(c, ()))


def _group_tangents(corners, position, normal, frames: _Frames, group) -> tuple[np.ndarray, np.ndarray]:
    """Angle-weighted, projected sum of the faces' tangents per group, and whether it is valid (does not cancel)."""
    used = (group >= 0) & ~frames.silent[:, None]
    face, corner = np.nonzero(used)
    vertex = corners[face, corner]
    n = normal[vertex]
    to_previous = _flattened(position[corners[face, (corner + 2) % 3]] - position[vertex], n)
    to_next = _flattened(position[corners[face, (corner + 1) % 3]] - position[vertex], n)
    # The 1e-9 matters only where all angles round to 0 (needles); the reference returns a zero vector there.
    angle = np.arccos(np.clip(_dot(to_previous, to_next), -1, 1).astype(np.float64)) + 1e-9
    tangent = _flattened(frames.tangent[face], n)
    number = int(group.max(initial=-1)) + 1
    index = group[face, corner]
    total = sums(index, angle[:, None] * tangent, number)
    length = np.linalg.norm(total, axis=1)
    # A sum that cancels leaves rounding noise, not a direction.
    valid = length > 1e-6 * np.bincount(index, angle, minlength=number)
    return (total / np.where(valid, length, 1)[:, None]).astype(np.float32), valid & (length > 0)


def _copy_to_degenerate(result: np.ndarray, corners: np.ndarray, good: np.ndarray) -> None:
    """A face with two equal positions takes, at each vertex, the tangent of the first other face."""
    if good.all():
        return
    where = np.flatnonzero(good)
    vertices, first = np.unique(corners[where].reshape(-1), return_index=True)
    bad = corners[~good]
    place = np.minimum(np.searchsorted(vertices, bad), len(vertices) - 1)
    known = vertices[place] == bad
    copied = result[where].reshape(-1, 4)[first[place]]
    result[~good] = np.where(known[..., None], copied, result[~good])


def _perpendicular(n: Float[np.ndarray, "w 3"]) -> Float[np.ndarray, "w 3"]:
    """Some unit vector perpendicular to each normal: (1, 0, 0), or where that is too close (0, 0, 1), projected."""
    axis = np.where(np.abs(n[:, :1]) < 0.9, np.array([1, 0, 0], np.float32), np.array([0, 0, 1], np.float32))
    return _flattened(axis, n)


def _flattened(v: np.ndarray, n: np.ndarray) -> np.ndarray:
    """Projected into the plane of n and normalised where the length is not zero."""
    v = v - _dot(n, v)[:, None] * n
    length = _length(v)
    return np.where((length > _TINY)[:, None], v / np.where(length > _TINY, length, np.float32(1))[:, None], v)


def _length(v: np.ndarray) -> np.ndarray:
    return np.sqrt(_dot(v, v))


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return a[..., 0] * b[..., 0] + a[..., 1] * b[..., 1] + a[..., 2] * b[..., 2]
