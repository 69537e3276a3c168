"""The deformation to outlines: its derivatives against Mitsuba's and finite differences, its target, its bounds, and
checks that can fail."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from mistyle.core.camera import Camera, orbit, px_from_world, rig
from mistyle.core.mesh import Mesh
from mistyle.core.settings import RigSettings
from mistyle.geometry.intersections import self_intersections
from mistyle.render.mitsuba.draw import misses, tracer
from mistyle.render.mitsuba.unlit import unlit
from mistyle.solver.shape.checks import checked_step, flipped, new_intersections, start_of
from mistyle.solver.shape.displace import TargetOutline, displace
from mistyle.solver.shape.moved import turned_normals
from mistyle.solver.shape.outlines import contour_of, silhouette_of
from mistyle.solver.shape.projective import silhouette_loss
from mistyle.solver.shape.settings import DisplaceSettings
from mistyle.solver.shape.surface import surface_of

AXES = np.array([1.0, 0.82, 0.9])


def mesh_of(points: np.ndarray, faces: np.ndarray) -> Mesh:
    normals = points / np.maximum(np.linalg.norm(points, axis=1, keepdims=True), 1e-9)
    corners = normals[faces].astype(np.float32)
    none = np.zeros((len(faces), 3, 2), np.float32)
    return Mesh(
        points.astype(np.float32), faces.astype(np.int32), corners, none, np.zeros(len(faces), np.int32), ("a",)
    )


def sphere(rounds: int, radius: float = 0.9) -> Mesh:
    ball = trimesh.creation.icosphere(rounds, radius)
    return mesh_of(np.array(ball.vertices), np.array(ball.faces))


def coverage(mesh: Mesh, camera: Camera) -> np.ndarray:
    from mistyle.core.maps import flat_maps

    return unlit(mesh, [flat_maps(2)], [camera])[0][1]


def bent(points: np.ndarray) -> np.ndarray:
    """A smooth field of displacements."""
    x, y, _ = points.T
    return np.stack([np.sin(3 * y) * x, 0.5 * y, 0.3 * np.cos(2 * x)], axis=1)


def test_the_projective_gradient_is_that_of_finite_differences():
    mesh, camera = sphere(2), orbit(20, 10, distance=4, fov=30, size=(96, 96))
    points, step = mesh.positions.astype(float), 5e-3
    target = coverage(mesh_of(points * AXES, mesh.faces), camera)

    def loss(p: np.ndarray) -> float:
        return float(np.mean([silhouette_loss(p, mesh.faces, [camera], [target], 256, seed)[0] for seed in range(2)]))

    gradient = silhouette_loss(points, mesh.faces, [camera], [target], 256, gradient=True)[1]
    expected = (loss(points + step * bent(points)) - loss(points - step * bent(points))) / (2 * step)
    # With the film's border, Mitsuba's own gradient would be 8 % too large at this size.
    assert (gradient * bent(points)).sum() == pytest.approx(expected, rel=0.03)
    again = silhouette_loss(points, mesh.faces, [camera], [target], 256, gradient=True)[1]
    assert np.abs(again - gradient).max() < 1e-4 * np.abs(gradient).max()


def test_an_outlines_derivative_is_its_motion():
    mesh, camera = sphere(4), orbit(20, 10, distance=4, fov=30, size=(256, 256))
    surface, step = surface_of(mesh), 0.02
    traced = tracer(mesh)
    seen = silhouette_of(surface, surface.points, camera, lambda px: misses(traced, camera, px))
    field = step * bent(surface.points)
    share = seen.share[:, None]
    moves = field[seen.ends[:, 0]] * (1 - share) + field[seen.ends[:, 1]] * share
    predicted = (np.einsum("kai,ki->ka", seen.jacobian, moves) * seen.normal).sum(axis=1)
    contour = contour_of(coverage(mesh_of(surface.points + field, surface.faces), camera))
    gap = contour.points[None] - seen.place[:, None]
    nearest = np.argmin((gap**2).sum(axis=2), axis=1)
    measured = (gap[np.arange(len(nearest)), nearest] * contour.normals[nearest]).sum(axis=1)
    assert np.abs(predicted).max() > 1.5
    assert np.sqrt(np.mean((predicted - measured) ** 2)) < 0.15


def test_a_sphere_becomes_the_ellipsoid_of_its_outlines():
    begun, cameras = sphere(4), rig(RigSettings(resolution=256))
    wanted = sphere(5, 1.0)
    wanted = mesh_of(wanted.positions * AXES, wanted.faces)
    outlines = []
    for camera in cameras:
        target, own = coverage(wanted, camera), coverage(begun, camera)
        outlines.append(TargetOutline(camera, target, np.abs(target - own) > 0.3))
    result = displace(begun, outlines, DisplaceSettings(most=0.2))
    # The distance of a point near the ellipsoid, to first order: |f| / |grad f| of its implicit function.
    scaled = result.positions / AXES
    error = np.abs((scaled**2).sum(axis=1) - 1) / np.linalg.norm(2 * scaled / AXES, axis=1)
    assert error.max() < 0.005
    assert result.loss[1] < 0.05 * result.loss[0]
    surface = surface_of(begun)
    assert not flipped(start_of(surface), surface, result.positions.astype(float)).any()


def test_the_bound_the_normal_and_the_far_side_hold():
    mesh, camera = sphere(4), orbit(0, 0, distance=4, fov=30, size=(256, 256))
    own = coverage(mesh, camera)
    target = own.copy()
    target[8:60, 118:138] = 1  # a post on the top
    outline = TargetOutline(camera, target, np.abs(target - own) > 0.5)
    result = displace(mesh, [outline], DisplaceSettings(most=0.05, along="normal"))
    again = displace(mesh, [outline], DisplaceSettings(most=0.05, along="normal"))
    assert again.positions.tobytes() == result.positions.tobytes()
    step = result.positions - mesh.positions
    assert 0.03 < result.moved[1] <= 0.05 + 1e-6
    along = step - (step * mesh.positions).sum(axis=1, keepdims=True) * mesh.positions / 0.81
    assert np.abs(along).max() < 1e-3 * 1.5  # vertex normals of the mesh and of the sphere differ a little
    far = mesh.positions[:, 1] < 0
    assert (result.positions[far] == mesh.positions[far]).all()
    assert result.wrong[1] < result.wrong[0]


def test_boundaries_stay_and_seams_move_as_one():
    ball = sphere(4)
    kept = ball.positions[ball.faces].mean(axis=1)[:, 1] > -0.3
    faces = ball.faces[kept]
    # Every face has its own vertices: all edges are seams.
    mesh = mesh_of(ball.positions[faces.reshape(-1)], np.arange(3 * len(faces)).reshape(-1, 3))
    camera = orbit(0, 0, distance=4, fov=30, size=(128, 128))
    own = coverage(mesh, camera)
    target = np.maximum(own, np.roll(own, -6, axis=0))
    result = displace(mesh, [TargetOutline(camera, target, np.abs(target - own) > 0.5)], DisplaceSettings(most=0.2))
    surface = surface_of(mesh)
    assert surface.fixed.any() and not surface.fixed.all()
    places = np.stack([np.bincount(surface.of_vertex, result.positions[:, k]) for k in range(3)], axis=1)
    places /= np.bincount(surface.of_vertex)[:, None]
    assert np.abs(places[surface.of_vertex] - result.positions).max() < 1e-6
    still = surface.fixed[surface.of_vertex]
    assert (result.positions[still] == mesh.positions[still]).all()
    assert result.moved[1] > 0.05


@pytest.mark.parametrize("along", ["any", "normal"])
def test_a_mesh_of_boundaries_stays(along):
    ball = sphere(2)
    apart = ball.positions[ball.faces] * 0.99 + 0.01 * ball.positions[ball.faces].mean(axis=1, keepdims=True)
    mesh = mesh_of(apart.reshape(-1, 3), np.arange(3 * len(ball.faces)).reshape(-1, 3))
    camera = orbit(0, 0, distance=4, fov=30, size=(96, 96))
    target = coverage(sphere(2, 1.0), camera)
    outline = TargetOutline(camera, target, np.ones(target.shape, bool))
    result = displace(mesh, [outline], DisplaceSettings(most=0.2, along=along))
    assert result.positions.tobytes() == mesh.positions.tobytes()


def test_a_step_that_folds_is_held_back():
    mesh = sphere(2)
    surface = surface_of(mesh)
    start, none = start_of(surface), np.zeros_like(surface.points)
    folding = none.copy()
    folding[0] = -1.9 * surface.points[0]  # through the opposite side
    there = surface.points + folding
    assert flipped(start, surface, there).any() or len(new_intersections(start, surface, there))
    step = checked_step(start, surface, none, folding)
    there = surface.points + step.displacement
    assert step.held > 0 and step.displacement.any()
    assert not flipped(start, surface, there).any() and not len(new_intersections(start, surface, there))


def test_a_step_into_another_part_is_held_back():
    one, two = sphere(2, 0.3), sphere(2, 0.3)
    away = np.array([0.7, 0, 0], np.float32)
    mesh = mesh_of(
        np.concatenate([one.positions - away / 2, two.positions + away / 2]),
        np.concatenate([one.faces, two.faces + len(one.positions)]),
    )
    surface = surface_of(mesh)
    start, none = start_of(surface), np.zeros_like(surface.points)
    into = none.copy()
    into[surface.points[:, 0] < 0] = [0.3, 0, 0]  # a rigid motion turns nothing over
    assert not flipped(start, surface, surface.points + into).any()
    assert len(new_intersections(start, surface, surface.points + into)) > 0
    step = checked_step(start, surface, none, into)
    assert len(new_intersections(start, surface, surface.points + step.displacement)) == 0


def test_intersections_are_those_of_every_pair(rng):
    points = rng.random((60, 3))
    faces = np.arange(60).reshape(-1, 3)
    found = {tuple(pair) for pair in self_intersections(points, faces).tolist()}

    def crosses(a: int, b: int) -> bool:
        """An edge of a through b, by the intersection of line and plane (Moller and Trumbore 1997)."""
        o, u, v = points[faces[b, 0]], *(points[faces[b, k]] - points[faces[b, 0]] for k in (1, 2))
        for k in range(3):
            p, q = points[faces[a, k]], points[faces[a, (k + 1) % 3]]
            s, t, w = np.linalg.solve(np.stack([u, v, p - q], axis=1), p - o)
            if min(s, t, 1 - s - t, w, 1 - w) > 0:
                return True
        return False

    pairs = [(a, b) for a in range(20) for b in range(a + 1, 20)]
    assert found == {(a, b) for a, b in pairs if crosses(a, b) or crosses(b, a)}
    assert len(found) > 5
    chosen = np.zeros(20, bool)
    chosen[3] = True
    some = {tuple(pair) for pair in self_intersections(points, faces, chosen).tolist()}
    assert some == {pair for pair in found if 3 in pair}


def test_normals_turn_with_the_surface():
    mesh = sphere(4)
    moved = (mesh.positions * AXES).astype(np.float32)
    exact = moved / AXES**2
    exact /= np.linalg.norm(exact, axis=1, keepdims=True)
    turned = turned_normals(mesh, moved)
    assert np.degrees(np.arccos(np.clip((turned * exact[mesh.faces]).sum(axis=2), -1, 1))).max() < 1.0
    still = turned_normals(mesh, mesh.positions)
    assert still.tobytes() == mesh.corner_normals.tobytes()


def test_a_mesh_without_evidence_keeps_its_bits():
    mesh, camera = sphere(2), orbit(0, 0, distance=4, fov=30, size=(96, 96))
    own = coverage(mesh, camera)
    result = displace(mesh, [TargetOutline(camera, own, np.zeros(own.shape, bool))], DisplaceSettings(most=0.1))
    assert result.positions.tobytes() == mesh.positions.tobytes()
    # Outlines that count everywhere but agree move nothing either.
    result = displace(mesh, [TargetOutline(camera, own, np.ones(own.shape, bool))], DisplaceSettings(most=0.1))
    assert np.abs(result.positions - mesh.positions).max() < 1e-3


def test_pixels_and_rays_agree():
    mesh, camera = sphere(3), orbit(0, 0, distance=4, fov=30, size=(64, 64))
    out, _ = px_from_world(camera, np.array([[0.0, 0.0, 0.0], [0.0, 1.5, 0.0]]))
    assert misses(tracer(mesh), camera, out).tolist() == [False, True]
    assert replace(mesh, positions=mesh.positions).positions is mesh.positions
