"""Next-best-view rigs: the choice on problems whose answer is known, visibility on spheres, the rig end to end."""

from itertools import combinations

import numpy as np
import pytest
import trimesh

from mistyle.core.camera import orbit
from mistyle.core.errors import InputRefused
from mistyle.core.mesh import Mesh
from mistyle.core.settings import RigSettings
from mistyle.geometry import next_best_view as rigs
from mistyle.render.mitsuba.draw import tracer
from mistyle.render.mitsuba.rigs import next_best_views, sample_surface
from mistyle.render.mitsuba.visible import face_on
from mistyle.stylization.pipeline.start import cameras_of
from mistyle.stylization.settings import resolve


def as_mesh(solid: trimesh.Trimesh, inward: bool = False) -> Mesh:
    """Smooth normals, no UVs; scaled into the unit sphere by the caller."""
    faces = np.asarray(solid.faces, np.int32)
    normals = np.asarray(solid.vertex_normals, np.float32)[faces] * (-1 if inward else 1)
    uvs = np.zeros((len(faces), 3, 2), np.float32)
    positions = np.asarray(solid.vertices, np.float32)
    return Mesh(positions, faces, normals, uvs, np.zeros(len(faces), np.int32), ("solid",))


def ball(radius: float = 1.0, centre=(0.0, 0.0, 0.0)) -> trimesh.Trimesh:
    solid = trimesh.creation.icosphere(subdivisions=4, radius=radius)
    solid.apply_translation(centre)
    return solid


def sphere_weights(candidates: int = 200, points: int = 3000) -> tuple[np.ndarray, np.ndarray]:
    """n . d of a sphere seen from far away, and the directions."""

    def spiral(count: int) -> np.ndarray:
        y = 1 - (2 * np.arange(count) + 1) / count
        turn = np.radians(rigs.GOLDEN_ANGLE) * np.arange(count)
        return np.stack([np.sqrt(1 - y * y) * np.sin(turn), y, np.sqrt(1 - y * y) * np.cos(turn)], axis=1)

    directions = spiral(candidates)
    return np.maximum(directions @ spiral(points).T, 0).astype(np.float32), directions


def test_a_sphere_needs_five_caps_of_66_degrees():
    """Four equal caps cover a sphere from 70.53 degrees on, five from 63.43: cos 0.4 is 66.42 degrees."""
    weight, _ = sphere_weights()
    chosen = rigs.choose(weight, least=0.4, least_overlap=0.0)
    assert chosen.reachable.all() and chosen.covered.all()
    assert 5 <= len(chosen.order) <= 6
    assert len(rigs.choose(weight, least=0.2, least_overlap=0.0).order) == 4  # 78.5 degrees


def test_overlap_of_two_directions_on_a_sphere():
    weight, directions = sphere_weights(points=20_000)
    found = rigs.overlaps(weight, 1e-6)
    # The half discs: (1 + cos) / 2 of a picture is seen by a camera turned by that angle.
    np.testing.assert_allclose(found, (1 + directions @ directions.T) / 2, atol=0.01)


def test_neighbours_overlap_and_the_rig_grows_with_the_demand():
    weight, _ = sphere_weights()
    counts = []
    for least_overlap in (0.0, 0.4, 0.7):
        chosen = rigs.choose(weight, 0.4, least_overlap)
        assert chosen.covered.all()
        assert np.isnan(chosen.overlap[0]) and (chosen.overlap[1:] >= least_overlap).all()
        share = rigs.overlaps(weight, 0.4)
        for k in range(1, len(chosen.order)):
            assert chosen.overlap[k] == share[chosen.order[k], chosen.order[:k]].max()
        counts.append(len(chosen.order))
    assert counts[0] < counts[1] < counts[2]


def test_greedy_falls_into_the_trap_from_the_largest_set_only():
    """Two rows of 7: greedy takes the columns 4 + 2 + 1, three sets; the two rows suffice, another start finds them."""
    weight = np.zeros((5, 14), np.float32)
    weight[0, :7], weight[1, 7:] = 1, 1
    for row, columns in zip((2, 3, 4), (range(0, 4), range(4, 6), range(6, 7)), strict=True):
        weight[row, [*columns, *(c + 7 for c in columns)]] = 1
    linked = np.ones((5, 5), bool)
    assert len(rigs.greedy(weight.T, np.ones(14, np.float32), linked, 32, 2)) == 3
    assert sorted(rigs.choose(weight, 0.4, 0.0).order) == [0, 1]


def test_small_problems_are_solved_as_well_as_by_trying_all(rng):
    """Random covers of 12 points by 9 sets: never more than one set above the least, mostly the least."""
    extra = 0
    for _ in range(40):
        weight = (rng.random((9, 12)) < 0.3).astype(np.float32)
        reachable = weight.any(axis=0)
        sizes = (
            n
            for n in range(1, 10)
            for c in combinations(range(9), n)
            if weight[list(c)].any(0).sum() == reachable.sum()
        )
        chosen = rigs.choose(weight, 0.5, 0.0)
        assert (chosen.covered == reachable).all()
        extra += len(chosen.order) - next(sizes)
    assert extra <= 2


def test_a_distant_view_is_reached_through_others():
    """A chain: candidate k sees points k and k + 1, so only neighbours overlap (by half). The ends need the middle."""
    weight = np.zeros((6, 7), np.float32)
    for k in range(6):
        weight[k, k : k + 2] = 1
    assert len(rigs.choose(weight, 0.5, 0.0).order) == 4
    linked = rigs.choose(weight, 0.5, 0.5)
    assert len(linked.order) == 6 and linked.covered.all() and (linked.overlap[1:] == 0.5).all()


def test_the_cap_takes_the_most_and_says_what_is_left():
    weight, _ = sphere_weights()
    chosen = rigs.choose(weight, 0.4, 0.0, most=2)
    assert len(chosen.order) == 2
    # Two opposite caps that do not meet: 2 (1 - 0.4) / 2 of the sphere.
    assert chosen.covered.mean() == pytest.approx(0.6, abs=0.01)
    assert chosen.reachable.all()


def test_a_part_that_overlaps_with_nothing_stays_uncovered_and_is_reported():
    weight = np.zeros((3, 10), np.float32)
    weight[0, :6], weight[1, 3:8], weight[2, 8:] = 1, 1, 1
    chosen = rigs.choose(weight, 0.5, 0.4)
    assert sorted(chosen.order) == [0, 1] and chosen.covered.sum() == 8 and chosen.reachable.all()


def test_weights_of_a_sphere_are_cosines():
    mesh = as_mesh(ball())
    cameras = [orbit(a, e, distance=4, fov=30, size=(64, 64)) for a, e in ((0, 0), (70, 40), (200, -89))]
    points = sample_surface(mesh, 4000)
    found = face_on(tracer(mesh), cameras, points.positions, points.normals, points.fronts)
    for camera, row in zip(cameras, found, strict=True):
        away = camera.position - points.positions
        cosine = (points.normals * away).sum(axis=1) / np.linalg.norm(away, axis=1)
        # Facets and lifted starts blur the horizon by a few degrees.
        clear = np.abs(cosine) > 0.08
        np.testing.assert_allclose(row[clear], np.maximum(cosine, 0)[clear], atol=2e-3)


def test_what_stands_before_a_point_hides_it_and_frames_end():
    mesh = as_mesh(ball(0.3, (0, 0, 0.6)) + ball(0.3, (0, 0, -0.6)))
    points = sample_surface(mesh, 4000)
    near = points.positions[:, 2] > 0
    camera = orbit(0, 0, distance=4, fov=30, size=(64, 64))
    row = face_on(tracer(mesh), [camera], points.positions, points.normals, points.fronts)[0]
    assert (row[near] > 0.4).mean() > 0.25
    # The near ball's cone of shadow is 0.423 wide at the far ball: all of it is hidden.
    assert not row[~near].any()
    narrow = orbit(0, 0, distance=4, fov=3, size=(64, 64))  # 0.09 about the axis at the near ball's front
    row = face_on(tracer(mesh), [narrow], points.positions, points.normals, points.fronts)[0]
    assert row.any() and np.abs(points.positions[row > 0][:, :2]).max() < 0.1


def test_the_rig_of_a_sphere_end_to_end():
    settings = RigSettings(kind="nbv", resolution=64, candidates=200)
    mesh = as_mesh(ball())
    planned = next_best_views(mesh, settings)
    assert planned.covered == 1 and planned.reachable == 1 and planned.overlap >= settings.overlap
    assert 6 <= len(planned.cameras) < 14
    again = next_best_views(mesh, settings)
    assert [c.name for c in again.cameras] == [c.name for c in planned.cameras]
    assert "100.00 %" in planned.sentence() and "uncovered" not in planned.sentence()
    few = next_best_views(mesh, settings.model_copy(update={"most_views": 3}))
    assert len(few.cameras) == 3 and "left uncovered" in few.sentence()


def test_a_sheet_needs_one_view_and_an_inside_out_ball_is_refused():
    corners = np.array([[-0.5, -0.5, 0], [0.5, -0.5, 0], [0.5, 0.5, 0], [-0.5, 0.5, 0]])
    sheet = as_mesh(trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]], process=False))
    planned = next_best_views(sheet, RigSettings(kind="nbv", resolution=64, candidates=200))
    assert len(planned.cameras) == 1 and planned.covered == 1 and np.isnan(planned.overlap)
    assert planned.cameras[0].position[2] > 0
    with pytest.raises(InputRefused, match="outwards"):
        next_best_views(as_mesh(ball(), inward=True), RigSettings(kind="nbv", resolution=64, candidates=200))


def test_the_pipeline_takes_the_rig_and_says_what_it_sees():
    said: list[str] = []
    settings = resolve("draft", None, {"rig": {"kind": "nbv", "resolution": 32, "candidates": 100}}, {})
    cameras = cameras_of(settings, as_mesh(ball()), said.append)
    assert len({c.name for c in cameras}) == len(cameras) > 4 and all(c.size == (32, 32) for c in cameras)
    assert len(said) == 1 and f"{len(cameras)} views see" in said[0]
    with pytest.raises(ValueError, match="next_best_views"):
        from mistyle.core.camera import rig

        rig(settings.rig)
