"""Places on the surface: parts take colours of their own, and nothing in them is explained by a light."""

import numpy as np
import pytest
from scipy.spatial import KDTree

from mistyle.stylization.surface import kernels, samples, synthesis
from mistyle.stylization.surface.guides import creases, places
from tests.stylization.surface.test_surface import dented_ball, mesh_of, solved, strokes
from tests.support.helpers import fixed_surface


@pytest.fixture(scope="module")
def dj():
    return kernels.module("llvm")


@pytest.fixture(scope="module")
def ball_levels(dj):
    return synthesis.hierarchy(dented_ball(), fixed_surface(samples=6000, levels=4), 0, dj)


def test_no_light_explains_the_places(ball_levels):
    level = ball_levels[-1]
    openness = np.random.default_rng(0).random(len(level.directed)).astype(np.float32)
    fields = places.place_fields(level, openness)
    explained = np.concatenate([level.points.normals, openness[:, None]], axis=1)
    for field in fields.T:
        assert field.std() == pytest.approx(1, abs=1e-3)
        assert max(abs(np.corrcoef(field, column)[0, 1]) for column in explained.T) < 1e-3
        up, down = level.points.normals[:, 1] > 0.5, level.points.normals[:, 1] < -0.5
        assert abs(field[up].mean() - field[down].mean()) < 0.05
    assert np.abs(np.corrcoef(fields.T) - np.eye(3)).max() < 0.7  # three different fields


def level_on(positions, normals, grid, count, dj):
    """Samples on a surface of rows of points, each closed to a ring."""
    rows, columns = grid
    quads = [
        (r * columns + c, r * columns + (c + 1) % columns, (r + 1) * columns + c, (r + 1) * columns + (c + 1) % columns)
        for r in range(rows - 1)
        for c in range(columns)
    ]
    faces = np.array([face for a, b, c, d in quads for face in ((a, c, b), (b, c, d))])
    mesh = mesh_of(positions, faces, normals)
    points = samples.spread(mesh, samples.sample_normals(mesh), count, np.random.default_rng(0), dj)
    tangent = samples.unit(np.cross(points.normals, [0.3, 0.5, 0.8])).astype(np.float32)
    return samples.with_tables(points, tangent, np.ones(len(tangent), np.float32), dj)


def two_balls(dj):
    """Samples on two balls that touch in a narrow neck, one above the other."""
    turn, height = np.meshgrid(np.arange(48) * 2 * np.pi / 48, np.linspace(-1.95, 1.95, 80))
    radius = np.sqrt(np.maximum(1 - (np.abs(height) - 1) ** 2, 0.01))
    positions = np.stack([radius * np.cos(turn), height, radius * np.sin(turn)], -1).reshape(-1, 3) / 2
    return level_on(positions, positions - np.sign(positions[:, 1:2]) * np.array([0, 0.5, 0]), (80, 48), 3000, dj)


def snake(dj):
    """Samples on a tube along x with three humps."""
    turn, along = np.meshgrid(np.arange(24) * 2 * np.pi / 24, np.linspace(-3, 3, 120))
    out = np.stack([0 * turn, np.cos(turn), np.sin(turn)], -1).reshape(-1, 3)
    middle = np.stack([along, 0.6 * np.cos(2 * along), 0 * along], -1).reshape(-1, 3)
    return level_on(middle + 0.3 * out, out, (120, 24), 3000, dj)


def test_lightness_follows_height_unless_the_normals_tell_it(dj, ball_levels):
    for level, follows in ((snake(dj), True), (ball_levels[-1], False)):
        openness = np.ones(len(level.directed), np.float32)
        first = places.place_fields(level, openness)[:, 0]
        lit = places.light(level.points.normals, openness)
        modes = places.without(places.laplacian_modes(level, places.MODES), lit)
        mode = modes[:, modes.std(axis=0) >= places.FIRM][:, 0]
        assert (np.corrcoef(first, level.points.positions[:, 1])[0, 1] > 0.6) == follows
        assert (abs(np.corrcoef(first, mode)[0, 1]) > 0.999) != follows


def test_vibrations_step_where_the_surface_is_narrow(dj):
    """The lowest vibration has one sign on each ball."""
    level = two_balls(dj)
    first = places.laplacian_modes(level, 4)[:, 0]
    upper = level.points.positions[:, 1] > 0
    assert np.mean((first > 0) == upper) > 0.98 or np.mean((first > 0) == ~upper) > 0.98
    assert np.abs(first).min() > 0.1 * np.abs(first).max() or np.percentile(np.abs(first), 5) > 0.5


@pytest.mark.parametrize("lopsided", [False, True])
def test_mirror_images_have_one_colour(dj, lopsided):
    """A body with two horns about an axis that is none of the world's; or with two humps that no plane mirrors."""
    turn, height = np.meshgrid(np.arange(64) * 2 * np.pi / 64, np.linspace(-1, 1, 60))
    ring = np.sqrt(np.maximum(1 - height**2, 0.003))
    out = np.stack([ring * np.cos(turn), height, 0.8 * ring * np.sin(turn)], -1).reshape(-1, 3)
    bumps, wide = [(-0.6, 0.7, 0.2), (0.6, 0.7, 0.2)], 0.06
    if lopsided:
        bumps, wide = [(1, 0.2, 0.4), (-0.3, 0.9, -0.6)], 0.3
    grown = 1 + sum(np.exp(-((out - at) ** 2).sum(axis=1) / wide) for at in bumps)
    angle = np.radians(30)
    axes = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    positions = (out * grown[:, None] * [1.0, 1.0, 1.3]) @ axes
    level = level_on(positions, positions, (60, 64), 2500, dj)
    fields = places.place_fields(level, np.ones(len(level.directed), np.float32))
    upright = level.points.positions @ axes.T
    twin = KDTree(upright).query(upright * [-1, 1, 1])[1]
    alike = [np.corrcoef(field, field[twin])[0, 1] for field in fields.T]
    assert (places.mirrored(level).nnz == 0) == lopsided
    assert min(alike) < 0.5 if lopsided else min(alike) > 0.9


def test_the_painting_of_a_ball_holds_no_light():
    from mistyle.stylization.surface import lookup

    ratio = {}
    for form in (0.0, 1.0):
        chosen = fixed_surface(samples=6000, form=form)
        made = solved(dented_ball(), strokes(), chosen, 0)
        light = lookup.colour(made, made.positions, made.normals, footprint=made.spacing).mean(axis=1)
        up, down = made.normals[:, 1] > 0.5, made.normals[:, 1] < -0.5
        ratio[form] = light[up].mean() / light[down].mean()
    assert 0.8 < ratio[0.0] < 1.25 and ratio[1.0] > 1.5 * ratio[0.0]


def test_creases_are_few(ball_levels):
    asked = creases.creases(ball_levels)
    assert [len(a) for a in asked] == [len(level.directed) for level in ball_levels]
    assert asked[-1].min() < -0.8 and np.mean(np.abs(asked[-1]) < 0.3) > 0.6
