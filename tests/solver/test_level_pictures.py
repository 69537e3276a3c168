"""Pictures that are averaged for a coarse level of the per-texel solver, and how coarse that level is."""

import numpy as np

from mistyle.atlas.texels import rasterise
from mistyle.core.capture import shrunk
from mistyle.solver import indirect
from mistyle.solver.recover import recover
from mistyle.solver.schedule import OBSERVED, SEEN, solver_level
from mistyle.solver.settings import RecoverSettings
from mistyle.solver.texels import level_pictures
from tests.solver.test_recover import SIZE, errors, world  # noqa: F401  (a fixture)
from tests.support.helpers import assert_same

SMALL = 20  # pixels of an estimate of indirect light: blocks of four pixels


def lower_limits(monkeypatch) -> None:
    monkeypatch.setattr(level_pictures, "LARGE", 1000)
    monkeypatch.setattr(level_pictures, "MOST", SMALL)
    monkeypatch.setattr(indirect, "MOST", SMALL)


def test_averages_are_kept_where_memory_allows(world, monkeypatch):  # noqa: F811
    mesh, _, _, captures = world
    texels = [rasterise(mesh, 0, SIZE // 4)]
    assert level_pictures.level_captures(texels, captures, 1e9) == (captures, 1e9)  # small pictures stay
    lower_limits(monkeypatch)
    small, left = level_pictures.level_captures(texels, captures, 1e9)
    by = captures.cameras[0].size[0] // small.cameras[0].size[0]
    assert by in (2, 4) and left == 1e9 - sum(12 * c.size[0] * c.size[1] for c in small.cameras)
    wanted = shrunk(captures, [by] * len(captures))
    for _ in range(2):
        for got, expected in zip(small.load(3), wanted.load(3), strict=True):
            valid = wanted.load(3)[1]
            np.testing.assert_array_equal(got[valid], expected[valid])
    poor, left = level_pictures.level_captures(texels, captures, 1.0)
    assert left == 1.0
    assert_same(poor.cameras, small.cameras)


def test_a_coarse_level_finds_as_much_on_averages(world, monkeypatch):  # noqa: F811
    """Less than 1 dB of albedo is lost, with pictures of 80² averaged to 20²; with estimates of indirect light."""
    mesh, maps, texels, captures = world
    chosen = RecoverSettings(iterations=0, rounds=1, bounces=1, bounce_samples=8, solver_texels=300)
    found = []
    for lower in (False, True):
        if lower:
            lower_limits(monkeypatch)
        result = recover(mesh, [texels], captures, chosen, 0)
        _, _, albedo = errors(result.maps[0], maps, texels.covered & (result.seen[0] >= 3))
        found.append(-10 * np.log10((albedo**2).mean()))
    assert found[1] > found[0] - 1


def test_a_level_is_bounded_by_texels_and_by_observations():
    chosen = RecoverSettings(solver_texels=1_000_000)
    assert solver_level(chosen, 1e6, 10, soft=False) == 1
    assert solver_level(chosen, 1.1e6, 10, soft=False) == 2
    assert solver_level(chosen, 1e6, 10, soft=True) == 4
    most = OBSERVED / (SEEN * 400)
    assert solver_level(chosen, most, 400, soft=False) == 1 and solver_level(chosen, 1.1 * most, 400, soft=False) == 2
