"""Computed normals and which vertices are one point."""

import numpy as np
import pytest
import trimesh

from mistyle.geometry.normals import MAX_VALENCE, crease_normals, same_points, usable_normals

# An icosphere of 5,120 faces: vertex normals are exact up to the mesh's own unevenness.
SPHERE_COSINE = 0.9995


def test_a_cube_has_hard_edges() -> None:
    box = trimesh.creation.box()
    positions, faces = np.asarray(box.vertices), np.asarray(box.faces)
    normals = crease_normals(positions, faces, same_points(positions))
    assert normals == pytest.approx(np.repeat(np.asarray(box.face_normals)[:, None], 3, axis=1), abs=1e-6)


def test_a_sphere_is_smooth_whether_split_or_not() -> None:
    ball = trimesh.creation.icosphere(4)
    positions, faces = np.asarray(ball.vertices), np.asarray(ball.faces)
    whole = crease_normals(positions, faces, same_points(positions))
    assert (whole * positions[faces]).sum(axis=2).min() > SPHERE_COSINE
    split = positions[faces].reshape(-1, 3)  # every face with vertices of its own, as at UV seams
    apart = crease_normals(split, np.arange(len(split)).reshape(-1, 3), same_points(split))
    assert apart == pytest.approx(whole, abs=1e-6)


@pytest.mark.parametrize(("angle", "smooth"), [(40, True), (60, False)])
def test_the_crease_angle_decides(angle: float, smooth: bool) -> None:
    """Two squares that meet at an edge: their normals enclose `angle`."""
    c, s = np.cos(np.radians(angle)), np.sin(np.radians(angle))
    positions = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [1 + c, 0, s], [1 + c, 1, s]])
    faces = np.array([[0, 1, 2], [0, 2, 3], [1, 4, 5], [1, 5, 2]])
    normals = crease_normals(positions, faces, same_points(positions), 50)
    between = np.array([-np.sin(np.radians(angle / 2)), 0, np.cos(np.radians(angle / 2))])
    # Around point 1 lie one triangle of the first and two of the second square, so the mean leans over.
    expected = np.array([0, 0, 1.0]) + 2 * np.array([-s, 0, c])
    assert normals[0, 1] == pytest.approx(expected / np.linalg.norm(expected) if smooth else [0, 0, 1], abs=1e-6)
    assert (normals[0, 1] @ between > 0.99) == smooth


def test_large_faces_count_more() -> None:
    positions = np.array([[0, 0, 0], [10, 0, 0], [0, 10, 0], [0.0, -0.1, 0.03], [0.1, 0, 0]])
    faces = np.array([[0, 1, 2], [0, 3, 4]])
    normals = crease_normals(positions, faces, same_points(positions))
    assert normals[1, 0] @ [0, 0, 1] > 0.9999


def test_degenerate_faces_and_poles_have_normals_too() -> None:
    n = 4 * MAX_VALENCE  # a pole with more faces than are compared pair by pair
    angle = np.linspace(0, 2 * np.pi, n, endpoint=False)
    positions = np.concatenate([[[0, 0.2, 0]], np.stack([np.cos(angle), 0 * angle, -np.sin(angle)], axis=1)])
    ring = np.arange(n)
    faces = np.stack([0 * ring, ring + 1, (ring + 1) % n + 1], axis=1)
    normals = crease_normals(positions, np.concatenate([faces, [[1, 1, 2]]]), same_points(positions))
    assert normals[:-1, 0] == pytest.approx(np.tile([0, 1, 0], (n, 1)), abs=1e-6)
    assert np.linalg.norm(normals, axis=2) == pytest.approx(1, abs=1e-6)
    assert crease_normals(positions[:1], np.zeros((1, 3), int), np.zeros(1, int))[0] == pytest.approx(
        np.tile([0, 1, 0], (3, 1))
    )


def test_same_points_are_bit_equal_and_numbered_as_they_appear(rng: np.random.Generator) -> None:
    rows = rng.integers(-1, 2, (300, 3)).astype(float)
    rows[::7] *= -0.0  # zeros of both signs are one point
    number = same_points(rows)
    assert np.array_equal(number[:, None] == number[None], (rows[:, None] == rows[None]).all(axis=2))
    first = np.unique(number, return_index=True)[1]
    assert (np.diff(first) > 0).all()


def test_usable_normals() -> None:
    normals = np.array([[[0, 0, 1], [0, 0, 0], [np.nan, 0, 1]], [[np.inf, 0, 0], [3, 0, 0], [1e-9, 0, 0]]])
    assert usable_normals(normals).tolist() == [[True, False, False], [False, True, False]]
