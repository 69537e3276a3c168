"""Vertex displacements that bring a mesh's silhouettes to given outlines (paper 6.2.2).

Gauss-Newton on the total displacement x of the welded points. It minimises

    sum_i l_i w_i (n_i . J_i x - r_i)^2 + s^3 x' (S M^-1 S + M HOLD) x

over outline points i with length l_i and Huber weight w_i. n_i . J_i x is the motion of the outline along its normal in
working units (`outlines.py`), r_i its distance from the target's contour; s is `smooth`. The thin plate carries the
motion from the outlines over the surface. Every step is checked (`checks.py`). The result is deterministic: rows are
gathered and solved in one order. Mitsuba's projective integrator, whose gradients vary between runs, judges the result
(`projective.py`) and does not find it.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import scipy.sparse as sp
from jaxtyping import Bool, Float
from scipy.sparse.linalg import LinearOperator, cg, splu
from scipy.spatial import KDTree

from mistyle.core.camera import Camera, pixel_centres
from mistyle.core.image import dilate, erode
from mistyle.core.mesh import Mesh
from mistyle.core.rows import distinct_integers
from mistyle.render.mitsuba.draw import misses, tracer
from mistyle.solver.shape.checks import checked_step, start_of
from mistyle.solver.shape.outlines import Contour, Silhouette, contour_of, silhouette_of
from mistyle.solver.shape.projective import silhouette_loss
from mistyle.solver.shape.settings import DisplaceSettings
from mistyle.solver.shape.surface import WeldedSurface, mass_of, normals_of, plate, surface_of

AGREES = 0.25  # pixels: smaller distances of an outline are errors of its contour
NEAR = 3  # pixels around a changed pixel in which the outline counts
ALIKE = 0.3  # cosine between the normals of an outline point and of its counterpart
COARSE, FINER = 0.08, 0.7  # the first step's `smooth`, at least, and its factor from step to step
STRIDE = 6.0  # pixels that an outline may move in a step
LIMIT = 8.0  # pixels beyond which a distance pulls no more (Huber)
KEEP = 3.0  # weight of an outline that keeps its place
PULL, SPACING = 0.3, 0.75  # weight of a contour point that pulls the outline, and its length in pixels
BAND = 12  # pixels around the counting ones in which right and wrong pixels are counted
PATIENCE = 8  # steps without fewer wrong pixels after which the descent ends
SLACK = 1.02  # pixel counts are coarse: so much above the fewest wrong pixels, the later displacement is better
LEAST = 1e-6  # working units: smaller motions of a point in a step are left out
STILL = 0.02  # pixels of outline motion per step at which iteration stops
HOLD = 40.0  # inverse fourth power of the length over which a displacement fades, 0.4 radii
NEARBY, ELSEWHERE = 0.3, 0.6  # radii from a moving outline: beyond them points are held faster, and do not move
FAR_HOLD = 1e3  # how much faster points are held just before ELSEWHERE
ACCURACY, ROUNDS = 1e-4, 200  # of a linear solve


@dataclass(frozen=True)
class TargetOutline:
    """A view whose outline the mesh should have: its camera, its coverage (0..1), and the mask of pixels at which it
    counts. Elsewhere the mesh keeps its own outline."""

    camera: Camera
    coverage: Float[np.ndarray, "h w"]
    counts: Bool[np.ndarray, "h w"]


@dataclass(frozen=True)
class Displaced:
    """The displaced positions (working space, order of `Mesh.positions`) and the account of the descent.

    distance  root mean square distance of the outlines from their targets in pixels, before and after
    wrong     pixels near the outlines on the wrong side, over all views, before and after
    loss      mean squared difference of the rendered coverage from the targets (`projective.py`), before and after
    moved     root mean square over the moved points and largest displacement, in working units
    held      points whose step the checks shortened
    steps     Gauss-Newton steps
    """

    positions: Float[np.ndarray, "v 3"]
    distance: tuple[float, float]
    wrong: tuple[int, int]
    loss: tuple[float, float]
    moved: tuple[float, float]
    held: int
    steps: int


@dataclass(frozen=True)
class _Target:
    """A view's contour, ready for nearest points, where it counts, and the pixels around that with the wanted mask."""

    camera: Camera
    contour: Contour
    tree: KDTree
    counts: Bool[np.ndarray, "h w"]
    band: Float[np.ndarray, "b 2"]
    inside: Bool[np.ndarray, " b"]


@dataclass(frozen=True)
class _Best:
    """The latest displacement with about the fewest wrong pixels."""

    x: Float[np.ndarray, "n 3"]
    distance: float
    wrong: int
    held: int


@dataclass(frozen=True)
class _Rows:
    """Equations jacobian x = residual of the total displacement (working units), the outlines' distances (pixels), and
    the count of pixels in the bands on the wrong side of the outlines."""

    jacobian: Any
    residual: Float[np.ndarray, " m"]
    weight: Float[np.ndarray, " m"]
    distance: Float[np.ndarray, " k"]
    scale: Float[np.ndarray, " m"]
    wrong: int


def displace(
    mesh: Mesh,
    outlines: Sequence[TargetOutline],
    settings: DisplaceSettings,
    progress: Callable[[float], None] = lambda done: None,
) -> Displaced:
    """Displace the mesh to the outlines, by at most `settings.most` (working units) per point.

    Boundary points stay. No triangle turns by 90 degrees or more from its start, and no two triangles intersect that
    did not before. Parts without influence on an outline follow the thin plate. A displacement after which Mitsuba's
    silhouettes do not come closer to the outlines is undone.
    """
    surface = surface_of(mesh)
    normals = normals_of(surface, surface.points)
    targets, start = [t for t in map(_target, outlines) if t is not None], start_of(surface)
    x, steps, since = np.zeros_like(surface.points), 0, 0
    rows = _rows(mesh, surface, x, targets)
    best = first = _Best(x, _rms(rows.distance), rows.wrong, 0)
    least = first.wrong
    reach = _reach(surface, rows)
    stiff = plate(surface) + sp.diags_array(HOLD * (1 + FAR_HOLD * reach**2) * mass_of(surface))
    basis = _basis(surface, reach < 1, normals if settings.along == "normal" else None)
    while basis.shape[1] and steps < settings.steps and rows.distance.any() and since < PATIENCE:
        smooth = max(settings.smooth, COARSE * FINER**steps)
        wanted = (basis @ _solved(rows, smooth**3 * stiff, basis, x)).reshape(-1, 3)
        length = np.linalg.norm(wanted, axis=1, keepdims=True)
        wanted *= np.minimum(1, settings.most / np.maximum(length, 1e-30))
        wanted = np.where(np.abs(wanted - x).max(axis=1, keepdims=True) < LEAST, x, wanted)
        step = checked_step(start, surface, x, wanted)
        motion = rows.jacobian @ (step.displacement - x).reshape(-1) / rows.scale
        x, steps = step.displacement, steps + 1
        rows = _rows(mesh, surface, x, targets)
        since = 0 if rows.wrong < least else since + 1
        least = min(least, rows.wrong)
        if rows.wrong <= min(SLACK * least, first.wrong - 1):
            best = _Best(x, _rms(rows.distance), rows.wrong, step.held)
        progress(steps / settings.steps)
        if _rms(motion) < STILL:
            break
    losses = [_loss(surface, y, outlines) for y in (first.x, best.x)] if best.x.any() else [0.0, 0.0]
    best = best if losses[1] < losses[0] else first
    size = np.linalg.norm(best.x, axis=1)
    return Displaced(
        positions=moved_positions(mesh, surface, best.x),
        distance=(first.distance, best.distance),
        loss=(losses[0], min(losses)),
        wrong=(first.wrong, best.wrong),
        moved=(_rms(size[size > 0]), float(size.max(initial=0.0))),
        held=best.held,
        steps=steps,
    )


def _loss(surface: WeldedSurface, x: Float[np.ndarray, "n 3"], outlines: Sequence[TargetOutline]) -> float:
    """The judge: mean squared difference of Mitsuba's silhouettes from the outlines."""
    cameras, coverages = [o.camera for o in outlines], [o.coverage for o in outlines]
    return silhouette_loss(surface.points + x, surface.faces, cameras, coverages)[0]


def moved_positions(mesh: Mesh, surface: WeldedSurface, x: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "v 3"]:
    """Positions of the mesh with displaced points; those of other points keep their bits."""
    points: Any = x.any(axis=1)
    moved = points[surface.of_vertex]
    new = (surface.points + x)[surface.of_vertex].astype(mesh.positions.dtype)
    return np.where(moved[:, None], new, mesh.positions)


def _target(outline: TargetOutline) -> _Target | None:
    """The contour of an outline; None where it has none."""
    contour = contour_of(outline.coverage)
    if not len(contour.points) or not outline.counts.any():
        return None
    inside = outline.coverage > 0.5
    band = dilate(outline.counts, BAND) | (dilate(inside, NEAR) & ~erode(inside, NEAR))
    px = pixel_centres(outline.camera.size)[band]
    tree, counts = KDTree(contour.points), dilate(outline.counts, NEAR)
    return _Target(outline.camera, contour, tree, counts, px, inside[band])


def _reach(surface: WeldedSurface, rows: _Rows) -> Float[np.ndarray, " n"]:
    """How far a point lies from every outline that must move: 0 up to NEARBY, 1 from ELSEWHERE on."""
    pulled = distinct_integers(rows.jacobian[rows.residual != 0].indices // 3)
    if not len(pulled):
        return np.ones(len(surface.points))
    distance = KDTree(surface.points[pulled]).query(surface.points)[0]
    return np.clip((distance - NEARBY) / (ELSEWHERE - NEARBY), 0, 1)


def _basis(surface: WeldedSurface, movable: Bool[np.ndarray, " n"], normals: Float[np.ndarray, "n 3"] | None) -> Any:
    """The displacements that may vary, as columns: three of every free point, or one along its normal."""
    count = len(surface.points)
    free = np.flatnonzero(~surface.fixed & movable)
    if normals is None:
        rows = (3 * free[:, None] + np.arange(3)).reshape(-1)
        return sp.csc_array((np.ones(len(rows)), (rows, np.arange(len(rows)))), (3 * count, len(rows)))
    free = free[normals[free].any(axis=1)]
    rows, columns = (3 * free[:, None] + np.arange(3)).reshape(-1), np.repeat(np.arange(len(free)), 3)
    return sp.csc_array((normals[free].reshape(-1), (rows, columns)), (3 * count, len(free)))


def _solved(rows: _Rows, stiff: Any, basis: Any, x: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " k"]:
    """The minimum of the energy in the basis, by conjugate gradients from the displacement `x`.

    The preconditioner is the factorised energy with the data's diagonal, which couples no directions.
    """
    weighted = sp.diags_array(rows.weight) @ rows.jacobian
    inner = rows.jacobian @ basis
    energy = basis.T @ sp.kron(stiff, sp.eye_array(3)) @ basis
    lhs = (inner.T @ sp.diags_array(rows.weight) @ inner + energy).tocsr()
    rhs = basis.T @ (weighted.T @ rows.residual)
    data = lhs.diagonal() - energy.diagonal()
    per = 3 if inner.shape[1] == 3 * len(distinct_integers(basis.indices // 3)) else 1
    if per == 3:
        data = data.reshape(-1, 3).mean(axis=1)
        energy = energy.tocsr()[::3, ::3]
    options = {"SymmetricMode": True}
    factor = splu((energy + sp.diags_array(data)).tocsc(), "MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options)
    shape = (len(rhs) // per, per)
    operator: Any = LinearOperator  # its stub knows no plain call
    around = operator(lhs.shape, lambda v: factor.solve(v.reshape(shape)).reshape(-1), dtype=float)
    return cg(lhs, rhs, basis.T @ x.reshape(-1), rtol=ACCURACY, maxiter=ROUNDS, M=around)[0]


def _rows(mesh: Mesh, surface: WeldedSurface, x: Float[np.ndarray, "n 3"], targets: Sequence[_Target]) -> _Rows:
    """The equations of all views at the displacement `x`."""
    points = surface.points + x
    traced = tracer(replace(mesh, positions=moved_positions(mesh, surface, x)))
    blocks: list[tuple[np.ndarray, ...]] = []
    distances, wrong = [np.zeros(0)], 0
    for target in targets:
        wrong += int((misses(traced, target.camera, target.band) == target.inside).sum())
        seen = silhouette_of(surface, points, target.camera, partial(misses, traced, target.camera))
        if len(seen.place):
            own, distance = _towards(seen, target)
            blocks += [own, _pulled(seen, target)]
            distances.append(distance)
    if not blocks:
        none = np.zeros(0)
        return _Rows(sp.csr_array((0, x.size)), none, none, none, none, wrong)
    ends, vector, gap, weight, scale, again = (np.concatenate(part) for part in zip(*blocks, strict=True))
    place = (3 * ends[:, :, None] + np.arange(3)).reshape(len(ends), -1)
    index = (np.repeat(np.arange(len(ends)), 6), place.reshape(-1))
    jacobian = sp.csr_array((vector.reshape(-1), index), (len(ends), x.size))
    # Gaps are distances yet to go; holding rows go back to the start (`again` is 0).
    return _Rows(jacobian, gap + again * (jacobian @ x.reshape(-1)), weight, np.concatenate(distances), scale, wrong)


def _towards(seen: Silhouette, target: _Target) -> tuple[tuple[np.ndarray, ...], Float[np.ndarray, " k"]]:
    """Rows of every silhouette point: towards the contour's nearest point with a similar normal, along that normal.

    Points at which the outline does not count stay where they were at the start.
    """
    column, row = np.floor(seen.place).astype(np.int64).T
    counts = target.counts[row, column]
    reach = min(8, len(target.contour.points))
    near = target.tree.query(seen.place, k=np.arange(1, reach + 1))[1]
    alike = (target.contour.normals[near] * seen.normal[:, None]).sum(axis=2) > ALIKE
    chosen = near[np.arange(len(near)), np.argmax(alike, axis=1)]
    found, normal = alike.any(axis=1), target.contour.normals[chosen]
    gap = ((target.contour.points[chosen] - seen.place) * normal).sum(axis=1)
    gap = np.where(np.abs(gap) < AGREES, 0, gap)
    direction = np.where((counts & found)[:, None], normal, seen.normal)
    weight = seen.length * np.where(counts, np.minimum(1, LIMIT / np.maximum(np.abs(gap), LIMIT)), KEEP)
    weight[counts & ~found] = 0
    gap = np.where(counts & found, gap, 0)
    rows = _along(seen, direction, np.clip(gap, -STRIDE, STRIDE), weight, np.where(counts, 1.0, 0.0))
    return rows, gap[counts & found]


def _pulled(seen: Silhouette, target: _Target) -> tuple[np.ndarray, ...]:
    """Rows of contour points from which the outline is far: each pulls the nearest silhouette point, both ways.

    They move a silhouette into spikes, whose sides are nearer than their tips.
    """
    column, row = np.floor(target.contour.points).astype(np.int64).T
    height, width = target.counts.shape
    chosen = np.flatnonzero(target.counts[np.clip(row, 0, height - 1), np.clip(column, 0, width - 1)])
    distance, nearest = map(np.asarray, KDTree(seen.place).query(target.contour.points[chosen]))
    facing = (target.contour.normals[chosen] * seen.normal[nearest]).sum(axis=1) > -ALIKE
    far = (distance > 1) & facing
    chosen, nearest, distance = chosen[far], nearest[far], distance[far]
    gap = (target.contour.points[chosen] - seen.place[nearest]) * np.minimum(1, STRIDE / distance)[:, None]
    part = _part(seen, nearest)
    weight = PULL * SPACING * part.pixel * np.minimum(1, LIMIT / np.maximum(distance, LIMIT))
    both = [_along(part, np.broadcast_to(axis, gap.shape), gap @ axis, weight, np.ones(len(gap))) for axis in np.eye(2)]
    first, second = both
    return tuple(np.concatenate(pair) for pair in zip(first, second, strict=True))


def _part(seen: Silhouette, index: np.ndarray) -> Silhouette:
    return Silhouette(*(getattr(seen, name)[index] for name in Silhouette.__dataclass_fields__))


def _along(
    seen: Silhouette, direction: np.ndarray, gap: np.ndarray, weight: np.ndarray, again: np.ndarray
) -> tuple[np.ndarray, ...]:
    """Rows: the motion of silhouette points along image directions (k 2), in working units."""
    vector = np.einsum("ka,kai->ki", direction, seen.jacobian) * seen.pixel[:, None]
    shares = np.stack([1 - seen.share, seen.share], axis=1)
    return seen.ends, shares[:, :, None] * vector[:, None], gap * seen.pixel, weight, seen.pixel, again


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2))) if values.size else 0.0
