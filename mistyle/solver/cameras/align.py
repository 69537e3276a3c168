"""Registration of cameras and mesh by silhouettes and, where materials are known, by shading.

A silhouette's residual is a distance in pixels. At every rim pixel of the rendered mesh, d_seen is the observed mask's
signed distance and d_drawn the rendered mask's. The rim must move by d_seen - d_drawn along the gradient of d_seen.
A motion moves the rim through its surface points (to first order the rim keeps the same points). Gauss-Newton over all
rims gives the motion: seven parameters for a similarity of all cameras, six for the pose of one camera.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

from mistyle.core.camera import Camera, px_by_cam
from mistyle.core.errors import InputRefused
from mistyle.core.image import luminance
from mistyle.core.mesh import Mesh
from mistyle.geometry.contours import block_means, contour_distance, rim_of, signed_distance, slope_of
from mistyle.geometry.icp import align_points, in_masks, visual_hull
from mistyle.geometry.similarity import moved_camera, similarity
from mistyle.render.mitsuba.draw import Tracer, gbuffer, tracer

MOST = 200_000  # points of a reconstruction; of more, evenly many
LEVELS = (96, 256)  # pixels along the longer side, coarse to fine
WAYS = 3  # registrations of the visual hull that are compared by silhouettes
STEPS = 12  # at most, per level
FAR = 0.05  # RMS distance of points from the mesh, in its radii; errors of a correct reconstruction are smaller
STILL = 0.01  # pixels of rim motion per step at which iteration stops
# Prior standard deviations of a camera's error; they regularise motions that neither silhouette nor shading constrains.
TURN, SHIFT = np.radians(3.0), 0.03

_View = tuple[Camera, np.ndarray, int]  # shrunk camera, its mask, downsampling factor

# Linear radiance of the mesh as camera k (of any size) should see it.
Predict = Callable[[Camera, int], Float[np.ndarray, "h w 3"]]


@dataclass(frozen=True)
class Alignment:
    """A similarity to the working space, and each view's contour error: mean distance in pixels of the full picture,
    before and after refinement. NaN where a view shows nothing."""

    work_from_cams: Float[np.ndarray, "4 4"]
    before: tuple[float, ...]
    after: tuple[float, ...]


@dataclass(frozen=True)
class Poses:
    """Refined cameras and each one's mean contour distance in pixels, before and after."""

    cameras: tuple[Camera, ...]
    before: tuple[float, ...]
    after: tuple[float, ...]


def align_by_points(
    mesh: Mesh,
    points: Float[np.ndarray, "n 3"],
    cameras: Sequence[Camera],
    masks: Sequence[Bool[np.ndarray, "h w"]] | None,
    rng: np.random.Generator,
) -> Alignment:
    """The similarity from a reconstruction's points (those inside the masks, if any), then from the silhouettes.

    Without masks all points must lie on the object. Raises InputRefused when they do not fit the mesh, or when two
    registrations fit equally well and no masks can decide.
    """
    points = points[:: 1 + len(points) // MOST]
    own = points if masks is None else points[in_masks(points, cameras, masks)]
    if len(own) < 20:
        raise InputRefused(
            f"--align: found {len(own)} of {len(points)} points on the object; expected at least 20. "
            "Check the masks, or reconstruct with more pictures."
        )
    registration, *_ = align_points(mesh, own, rng)
    if registration.residual > FAR:
        raise InputRefused(
            f"--align: found points {registration.residual:.3f} mesh radii from the mesh; expected less than {FAR}. "
            "Pass masks (some points lie on other objects), or check that the pictures show this mesh."
        )
    if masks is None:
        if registration.rival < 1.1:
            raise InputRefused(
                "--align: found two registrations of the points that fit equally well (the mesh is symmetric); "
                "expected one. Pass masks, or align the cameras by hand."
            )
        return Alignment(registration.work_from_cams, (), ())
    return align_by_masks(mesh, cameras, masks, rng, start=registration.work_from_cams)


def align_by_masks(
    mesh: Mesh,
    cameras: Sequence[Camera],
    masks: Sequence[Bool[np.ndarray, "h w"]],
    rng: np.random.Generator,
    start: Float[np.ndarray, "4 4"] | None = None,
    levels: Sequence[int] = LEVELS,
) -> Alignment:
    """The similarity from the cameras' space to the working space that best fits silhouettes to masks.

    Without a `start`, the visual hull of the masks is registered to the mesh first; that needs views from around the
    object. A `start` may be off by some 20 degrees and a third of the size.
    """
    if not any(mask.any() for mask in masks):
        raise InputRefused("--align: found only empty masks; expected the object's. Check that the object is white.")
    traced = tracer(mesh)
    coarse = [shrunk(camera, mask, levels[0]) for camera, mask in zip(cameras, masks, strict=True)]
    if start is None:
        start = _register_hull(mesh, traced, cameras, masks, coarse, rng)
    matrix = _descend(traced, coarse, start)
    for side in levels[1:]:
        small = [shrunk(camera, mask, side) for camera, mask in zip(cameras, masks, strict=True)]
        matrix = _descend(traced, small, matrix)
    finest = [shrunk(camera, mask, levels[-1]) for camera, mask in zip(cameras, masks, strict=True)]
    return Alignment(matrix, _distances(traced, finest, start), _distances(traced, finest, matrix))


def _register_hull(
    mesh: Mesh,
    traced: Tracer,
    cameras: Sequence[Camera],
    masks: Sequence[Bool[np.ndarray, "h w"]],
    coarse: Sequence[_View],
    rng: np.random.Generator,
) -> Float[np.ndarray, "4 4"]:
    """The registration of the visual hull whose silhouettes fit best. A hull from few views has humps that the mesh
    lacks, so its own residual may favour another registration."""
    try:
        shell = visual_hull(cameras, masks)
    except ValueError as error:
        raise InputRefused(f"--align: found that {error}; expected one object in all. Check the masks.") from error
    ways = [registration.work_from_cams for registration in align_points(mesh, shell, rng, trim=0.8)]
    misfits = [_misfit(traced, coarse, way) for way in ways]
    order = np.argsort(misfits)[:WAYS]
    close = [ways[k] for k in order if misfits[k] <= 2 * misfits[order[0]]]
    if len(close) == 1:
        return close[0]
    return min((_descend(traced, coarse, way) for way in close), key=lambda way: _misfit(traced, coarse, way))


def _misfit(traced: Tracer, views: Sequence[_View], matrix: np.ndarray) -> float:
    """Mean contour distance over the views; infinite where a view shows nothing of the mesh."""
    distances = _distances(traced, views, matrix)
    return float(np.mean(np.nan_to_num(distances, nan=np.inf)))


def refine_poses(
    mesh: Mesh,
    cameras: Sequence[Camera],
    masks: Sequence[Bool[np.ndarray, "h w"]],
    *,
    pictures: Callable[[int], tuple[Float[np.ndarray, "h w 3"], Bool[np.ndarray, "h w"]]] | None = None,
    predict: Predict | None = None,
    levels: Sequence[int] = (*LEVELS, 768),
    progress: Callable[[float], None] = lambda done: None,
) -> Poses:
    """Rotate and translate every camera (working space) so that the mesh's silhouette fits its mask.

    With `pictures` (`Captures.load`) and `predict`, luminance is aligned too (up to a factor per view): it constrains
    motions that silhouettes do not. Unconstrained motions and focal lengths stay unchanged. A view keeps its camera if
    its contours would fit worse or if it shows nothing of the mesh.
    """
    if (pictures is None) != (predict is None):
        raise ValueError("shading needs both, the pictures and their prediction")
    traced = tracer(mesh)
    refined, before, after = [], [], []
    for k, (camera, mask) in enumerate(zip(cameras, masks, strict=True)):
        shading = None
        if pictures is not None and predict is not None:
            shading = _Shading(*pictures(k), lambda seen, k=k: predict(seen, k))
        pose = camera
        for side in levels:
            pose = _refine_pose(traced, pose, mask, side, shading)
        finest = levels[-1]
        old, new = (_distance(traced, *shrunk(which, mask, finest)[:2]) for which in (camera, pose))
        times = shrunk(camera, mask, finest)[2]
        worse = not np.isfinite(new) or (shading is None and new > old)
        refined.append(camera if worse else pose)
        before.append(old * times)
        after.append((old if worse else new) * times)
        progress((k + 1) / len(cameras))
    return Poses(tuple(refined), tuple(before), tuple(after))


@dataclass(frozen=True)
class _Shading:
    """A picture (linear, with its mask of valid pixels) and the predicted radiance."""

    picture: Float[np.ndarray, "h w 3"]
    counts: Bool[np.ndarray, "h w"]
    predict: Callable[[Camera], Float[np.ndarray, "h w 3"]]


def shrunk(camera: Camera, mask: np.ndarray, side: int) -> tuple[Camera, np.ndarray, int]:
    """Camera and mask downsampled to about `side` pixels along the longer side, and the factor. The factor is odd, so
    that no pixel is half covered; that would shift all contours outwards or inwards."""
    if mask.shape != camera.size:
        raise ValueError(f"a mask of {mask.shape} for a camera of {camera.size}")
    times = 2 * round((max(camera.size) / side - 1) / 2) + 1 if max(camera.size) > side else 1
    small = block_means(mask.astype(np.float32), times) >= 0.5
    focal, centre = camera.focal / times, (camera.centre[0] / times, camera.centre[1] / times)
    return replace(camera, focal=focal, centre=centre, size=small.shape), small, times


def _distance(traced: Tracer, camera: Camera, mask: np.ndarray) -> float:
    return contour_distance(gbuffer(traced, camera).mask, mask)


def _distances(traced: Tracer, views: Sequence[_View], matrix: np.ndarray) -> tuple[float, ...]:
    return tuple(times * _distance(traced, moved_camera(camera, matrix), mask) for camera, mask, times in views)


def _rotation_jacobian(points: np.ndarray) -> np.ndarray:
    """d (w x p) / d w = -[p]x, (n 3 3)."""
    x, y, z = points.T
    zero = np.zeros_like(x)
    return np.stack([np.stack([zero, z, -y], 1), np.stack([-z, zero, x], 1), np.stack([y, -x, zero], 1)], axis=1)


def _rim_rows(
    traced: Tracer, camera: Camera, seen: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray] | None:
    """The rim's points (n 3, working space), their camera coordinates, the residuals (n) and the residuals' derivatives
    by the camera coordinates (n 3). None where the mesh or the mask shows no rim."""
    hits = gbuffer(traced, camera)
    rim = rim_of(hits.mask)
    if not rim.any() or not seen.any():
        return None
    distance = signed_distance(seen)
    slope = slope_of(distance)[rim]
    residual = (distance - signed_distance(hits.mask))[rim]
    points = hits.position[rim].astype(float)
    cam, moves = px_by_cam(camera, points)
    return points, cam, residual, np.einsum("nk,nkj->nj", slope, moves)


def _weights(residual: np.ndarray) -> np.ndarray:
    """Huber's weights: a hole in a mask or a cable beside the object pulls no more than an error of one pixel."""
    limit = max(1.0, 1.5 * float(np.median(np.abs(residual))))
    return limit / np.maximum(np.abs(residual), limit)


def _descend(traced: Tracer, views: Sequence[_View], matrix: np.ndarray) -> np.ndarray:
    """Gauss-Newton on the similarity: the mesh rotates, translates and scales in its own space, with all cameras."""
    for _ in range(STEPS):
        lhs, rhs, rows = np.zeros((7, 7)), np.zeros(7), []
        for camera, seen, _ in views:
            placed = moved_camera(camera, matrix)
            rim = _rim_rows(traced, placed, seen)
            if rim is None:
                continue
            points, _, residual, by_cam = rim
            by_world = by_cam @ placed.cam_from_world[:3, :3]
            turning = np.einsum("nj,njk->nk", by_world, _rotation_jacobian(points))
            jacobian = np.concatenate([turning, by_world, (by_world * points).sum(axis=1, keepdims=True)], axis=1)
            weight = _weights(residual)
            lhs += (jacobian * weight[:, None]).T @ jacobian
            rhs += (jacobian * weight[:, None]).T @ residual
            rows.append(jacobian)
        if not rows:
            break
        step = -np.linalg.solve(lhs + np.diag(1e-4 * lhs.diagonal() + 1e-9), rhs)
        step /= max(1.0, float(np.abs(step).max()) / 0.3)
        motion = similarity(float(np.exp(step[6])), Rotation.from_rotvec(step[:3]).as_matrix(), step[3:6])
        # A motion of the mesh is the inverse motion of the cameras.
        matrix = np.linalg.inv(motion) @ matrix
        if np.sqrt(np.mean((np.concatenate(rows) @ step) ** 2)) < STILL:
            break
    return matrix


def _refine_pose(traced: Tracer, camera: Camera, mask: np.ndarray, side: int, shading: _Shading | None) -> Camera:
    """Gauss-Newton on one camera's pose at one size."""
    small, seen, times = shrunk(camera, mask, side)
    depth = max(float(np.linalg.norm(camera.position)), 1e-6)
    prior = np.diag(1 / np.array([TURN] * 3 + [SHIFT * depth] * 3) ** 2)
    total = np.zeros(6)
    for _ in range(STEPS):
        rim = _rim_rows(traced, small, seen)
        if rim is None:
            break
        _, cam, residual, by_cam = rim
        jacobian = np.concatenate([np.einsum("nj,njk->nk", by_cam, _rotation_jacobian(cam)), by_cam], axis=1)
        if shading is not None:
            more = _shading_rows(traced, small, times, shading)
            jacobian, residual = np.concatenate([jacobian, more[0]]), np.concatenate([residual, more[1]])
        weight = _weights(residual)
        lhs = (jacobian * weight[:, None]).T @ jacobian + prior
        step = -np.linalg.solve(lhs, (jacobian * weight[:, None]).T @ residual + prior @ total)
        total += step
        motion = similarity(1.0, Rotation.from_rotvec(step[:3]).as_matrix(), step[3:])
        small = replace(small, world_from_cam=small.world_from_cam @ np.linalg.inv(motion))
        if np.sqrt(np.mean((jacobian @ step) ** 2)) < STILL:
            break
    return replace(camera, world_from_cam=small.world_from_cam)


def _shading_rows(traced: Tracer, camera: Camera, times: int, shading: _Shading) -> tuple[np.ndarray, np.ndarray]:
    """Luminance residuals in pixels (divided by the picture's mean slope), and their derivatives by the camera's
    motion.

    A point of the mesh keeps its luminance from the rendered view; its position in the picture moves.
    """
    hits = gbuffer(traced, camera)
    drawn = luminance(shading.predict(camera))
    counts = block_means(shading.counts.astype(np.float32), times) > 0.999
    seen = luminance(block_means(shading.picture, times))
    inner = hits.mask & counts & (signed_distance(hits.mask & counts) > 2) & np.isfinite(drawn)
    if inner.sum() < 50:
        return np.zeros((0, 6)), np.zeros(0)
    gain = float((seen[inner] * drawn[inner]).sum() / max((drawn[inner] ** 2).sum(), 1e-12))
    slope = slope_of(seen)[inner]
    scale = float(np.sqrt((slope**2).sum(axis=1).mean()))
    if scale < 1e-9:
        return np.zeros((0, 6)), np.zeros(0)
    cam, moves = px_by_cam(camera, hits.position[inner].astype(float))
    by_cam = np.einsum("nk,nkj->nj", slope, moves) / scale
    jacobian = np.concatenate([np.einsum("nj,njk->nk", by_cam, _rotation_jacobian(cam)), by_cam], axis=1)
    return jacobian, (seen - gain * drawn)[inner] / scale
