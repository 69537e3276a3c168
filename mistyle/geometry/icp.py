"""Registration of a mesh to points of another space: COLMAP's points, or the visual hull of the silhouettes."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from mistyle.core.camera import Camera, in_frame, px_from_world
from mistyle.core.image import dilate
from mistyle.core.mesh import Mesh, spread_points
from mistyle.geometry.similarity import degrees_between, fit_similarity, scale_of, similarity

COARSE_POINTS, COARSE_STEPS, COARSE_SURFACE = 250, 12, 5000
FINE_POINTS, FINE_STEPS, FINE_SURFACE = 5000, 25, 40_000  # points sampled on the mesh's surface
FINALISTS = 6
SPACING = 1e-3  # working units: residuals below it carry no information, since the surface is sampled
CONVERGED = 1e-5  # the step (working units, radians) at which point to plane has converged
CELLS = 40  # along the diagonal of the grid that equalises the points' density
HULL = 48  # cells along each side of the grid from which the visual hull is carved
TURNS = 36  # random starting rotations beside the 24 that align the principal axes
DISTINCT_DEGREES = 15.0  # degrees beyond which two alignments are distinct


@dataclass(frozen=True)
class PointAlignment:
    """The similarity that aligns points with a mesh.

    work_from_cams  takes the points' space to the working space
    residual        root mean square distance of the inliers from the surface, in working units
    kept            mask of the inliers
    rival           residual of the best other alignment over this one's, in the points' units (1: the points do not
                    distinguish them; infinite: no other alignment)
    """

    work_from_cams: Float[np.ndarray, "4 4"]
    residual: float
    kept: Bool[np.ndarray, " n"]
    rival: float


def in_masks(
    points: Float[np.ndarray, "n 3"],
    cameras: Sequence[Camera],
    masks: Sequence[Bool[np.ndarray, "h w"]],
    share: float = 0.9,
    slack: int = 2,
    framed: float = 0.34,
) -> Bool[np.ndarray, " n"]:
    """Mask of the points inside the object's mask, or within `slack` pixels of it, in at least `share` of the cameras
    whose frame contains them.

    This removes a scene's background from a COLMAP model. A point in the frames of less than `framed` of the cameras is
    removed: the cameras look at the object.
    """
    inside, seen = np.zeros(len(points)), np.zeros(len(points))
    for camera, mask in zip(cameras, masks, strict=True):
        px, z = px_from_world(camera, points)
        framed_points = in_frame(camera, px) & (z > 0)
        column, row = np.floor(px[framed_points]).astype(np.int64).T
        inside[framed_points] += dilate(mask, slack)[row, column]
        seen += framed_points
    return (seen > 0) & (seen >= framed * len(cameras)) & (inside >= share * seen)


def visual_hull(
    cameras: Sequence[Camera], masks: Sequence[Bool[np.ndarray, "h w"]], cells: int = HULL
) -> Float[np.ndarray, "n 3"]:
    """Points on the surface of the visual hull, in the cameras' space. The grid is centred at the point closest to the
    rays through the masks' middles. ValueError where the masks' cones do not intersect."""
    rays = [_middle(camera, mask) for camera, mask in zip(cameras, masks, strict=True) if mask.any()]
    # The point closest to all rays: sum of (I - d dᵀ)(x - o) = 0.
    lhs, rhs = np.zeros((3, 3)), np.zeros(3)
    for origin, direction, _ in rays:
        across = np.eye(3) - np.outer(direction, direction)
        lhs, rhs = lhs + across, rhs + across @ origin
    centre = np.linalg.lstsq(lhs, rhs, rcond=None)[0]
    reach = float(np.median([angle * np.linalg.norm(centre - origin) for origin, _, angle in rays])) * 1.2
    axis = (np.arange(cells) + 0.5) / cells * 2 - 1
    grid = centre + reach * np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    full = np.pad(in_masks(grid, cameras, masks, share=1.0, slack=0, framed=0.67).reshape(cells, cells, cells), 1)
    core = full[1:-1, 1:-1, 1:-1]
    buried = core.copy()
    for shift in (-1, 1):
        for k in range(3):
            buried &= np.roll(full, shift, axis=k)[1:-1, 1:-1, 1:-1]
    shell = grid[(core & ~buried).reshape(-1)]
    if len(shell) < 20:
        raise ValueError("the masks have nothing in common that all cameras see")
    return shell


def _middle(camera: Camera, mask: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """Origin and direction of the ray through the mask's middle, and the angle (radians) from it to the mask's farthest
    pixel."""
    rows, columns = np.nonzero(mask)
    middle = np.array([columns.mean() + 0.5, rows.mean() + 0.5])
    direction = np.append((middle - camera.centre) / camera.focal, 1.0)
    reach = np.hypot(columns + 0.5 - middle[0], rows + 0.5 - middle[1]).max() / camera.focal
    return camera.position, camera.world_from_cam[:3, :3] @ direction / np.linalg.norm(direction), float(reach)


def align_points(
    mesh: Mesh, points: Float[np.ndarray, "n 3"], rng: np.random.Generator, trim: float = 0.9
) -> tuple[PointAlignment, ...]:
    """Similarities that align `points` (of another space, with outliers) with the mesh's surface, the best first; they
    differ from one another by more than 15 degrees.

    Trimmed ICP from many starts, then point to plane. Every step uses the closest `trim` of the points. The mesh moves
    to the points, since points that move to a mesh may collapse. ValueError for fewer than 20 points. Unreliable where
    the points cover only a small part of the mesh; a symmetric mesh takes any of its symmetric poses (`rival` is then
    about 1). Remove a scene's background first (`in_masks`).
    """
    if len(points) < 20:
        raise ValueError(f"{len(points)} points; an alignment needs at least 20")
    even = _equalised(points)
    few = even[rng.permutation(len(even))[:COARSE_POINTS]]
    many = even[rng.permutation(len(even))[:FINE_POINTS]]
    rough, fine = _surface(mesh, COARSE_SURFACE, rng), _surface(mesh, FINE_SURFACE, rng)
    coarse = []
    for matrix in _starts(fine.position, even, rng):
        for _ in range(COARSE_STEPS):
            matrix = _closest_step(matrix, few, rough, trim)
        coarse.append((_error(matrix, few, rough, trim), matrix))
    refined = []
    for _, matrix in _distinct(coarse)[:FINALISTS]:
        for _ in range(FINE_STEPS):
            matrix, step = _plane_step(matrix, many, fine, trim)
            if step < CONVERGED:
                break
        refined.append((_error(matrix, many, fine, trim), matrix))
    refined = _distinct(refined)
    result = []
    for k, (error, matrix) in enumerate(refined):
        residual = error / scale_of(matrix)
        inliers = np.abs(_offsets(matrix, points, fine)) <= 3 * max(residual, 1e-9)
        others = [value for j, (value, _) in enumerate(refined) if j != k]
        floor = SPACING * scale_of(matrix)
        rival = max(min(others, default=np.inf), floor) / max(error, floor)
        result.append(PointAlignment(np.linalg.inv(matrix), residual, inliers, rival))
    return tuple(result)


def _distinct(candidates: list[tuple[float, np.ndarray]]) -> list[tuple[float, np.ndarray]]:
    """Candidates in order of error, without rotations close to that of a better one."""
    chosen: list[tuple[float, np.ndarray]] = []
    for error, matrix in sorted(candidates, key=lambda pair: pair[0]):
        if all(degrees_between(matrix, other) > DISTINCT_DEGREES for _, other in chosen):
            chosen.append((error, matrix))
    return chosen


def _equalised(points: np.ndarray) -> np.ndarray:
    """The points without outliers, one for each cell of a grid, so that dense regions weigh no more than others.

    An outlier is more than three times the median distance from its eighth neighbour.
    """
    distance = np.asarray(KDTree(points).query(points, k=9)[0])[:, -1]
    dense = points[distance <= 3 * np.median(distance)]
    cell = np.linalg.norm(np.quantile(dense, 0.95, axis=0) - np.quantile(dense, 0.05, axis=0)) / CELLS
    _, first = np.unique(np.floor(dense / max(cell, 1e-300)).astype(np.int64), axis=0, return_index=True)
    return dense[np.sort(first)] if len(first) >= 20 else points


@dataclass(frozen=True)
class _Surface:
    """Points distributed evenly over a mesh, the normals of their faces, and their k-d tree."""

    position: Float[np.ndarray, "n 3"]
    normal: Float[np.ndarray, "n 3"]
    tree: KDTree


def _surface(mesh: Mesh, count: int, rng: np.random.Generator) -> _Surface:
    points = spread_points(mesh.positions, mesh.faces, count, rng)
    return _Surface(points.position, points.normal, KDTree(points.position))


def _starts(surface: np.ndarray, points: np.ndarray, rng: np.random.Generator) -> list[np.ndarray]:
    """Similarities from the mesh to the points: medians and median distances coincide, the axes in many rotations."""
    (centre_m, axes_m, size_m), (centre_p, axes_p, size_p) = _frame(surface), _frame(points)
    turns = [axes_p @ turn @ axes_m.T for turn in Rotation.create_group("O").as_matrix()]
    turns += list(Rotation.random(TURNS, rng).as_matrix())
    scale = size_p / size_m
    return [similarity(scale, turn, centre_p - scale * turn @ centre_m) for turn in turns]


def _frame(points: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """A centre, right-handed principal axes (columns) and a size, robust to a tenth of outliers."""
    centre = np.median(points, axis=0)
    distance = np.linalg.norm(points - centre, axis=1)
    near = points[distance <= 2 * np.median(distance)]
    axes = np.linalg.eigh(np.cov((near - centre).T))[1]
    return centre, axes * np.array([1, 1, np.sign(np.linalg.det(axes))]), float(np.median(distance))


def _matched(matrix: np.ndarray, points: np.ndarray, surface: _Surface) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The points in the mesh's space, their distance from its surface, and the nearest surface point."""
    back = np.linalg.inv(matrix)
    local = points @ back[:3, :3].T + back[:3, 3]
    distance, index = surface.tree.query(local)
    return local, np.asarray(distance), np.asarray(index)


def _inliers(distance: np.ndarray, trim: float) -> np.ndarray:
    return distance <= np.quantile(distance, trim)


def _closest_step(matrix: np.ndarray, points: np.ndarray, surface: _Surface, trim: float) -> np.ndarray:
    _, distance, index = _matched(matrix, points, surface)
    inliers = _inliers(distance, trim)
    return fit_similarity(surface.position[index[inliers]], points[inliers])


def _offsets(matrix: np.ndarray, points: np.ndarray, surface: _Surface) -> np.ndarray:
    """Distance of the points from the mesh, in its units: from the nearest surface point's plane, which is finer than
    the points' spacing. Where the plane, extended beyond an edge, is much closer, it is the distance from that
    point."""
    local, distance, index = _matched(matrix, points, surface)
    plane = ((local - surface.position[index]) * surface.normal[index]).sum(axis=1)
    return np.where(np.abs(plane) < distance / 2 - 0.02, distance, plane)


def _plane_step(matrix: np.ndarray, points: np.ndarray, surface: _Surface, trim: float) -> tuple[np.ndarray, float]:
    """One Gauss-Newton step of the mesh's similarity (rotation, translation and scale in its own space) on the planes'
    offsets, and its greatest component."""
    local, distance, index = _matched(matrix, points, surface)
    inliers = _inliers(distance, trim)
    m, n = surface.position[index[inliers]], surface.normal[index[inliers]]
    offset = ((local[inliers] - m) * n).sum(axis=1)
    rows = np.concatenate([np.cross(m, n), n, (n * m).sum(axis=1, keepdims=True)], axis=1)
    # Directions that the surface does not constrain (a sphere's rotations) must not diverge.
    step = np.linalg.solve(rows.T @ rows + 1e-6 * len(rows) * np.eye(7), rows.T @ offset)
    step /= max(1.0, float(np.abs(step).max()) / 0.2)
    turn = Rotation.from_rotvec(step[:3]).as_matrix()
    return matrix @ similarity(float(np.exp(step[6])), turn, step[3:6]), float(np.abs(step).max())


def _error(matrix: np.ndarray, points: np.ndarray, surface: _Surface, trim: float) -> float:
    """Root mean square offset of the closest `trim` of the points, in the points' units: in the mesh's units
    an extremely large mesh would fit best."""
    offset = np.abs(_offsets(matrix, points, surface))
    return scale_of(matrix) * float(np.sqrt(np.mean(offset[_inliers(offset, trim)] ** 2)))
