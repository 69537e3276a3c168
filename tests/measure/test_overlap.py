"""What two views share: which places, how large their pixels are there, and that only contradictions count."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.consistency import metrics as consistency
from mistyle.core.camera import px_from_world, world_from_px
from mistyle.measure.overlap import _axes, overlap, pixel_steps, seen_here, seen_there
from tests.measure.test_metrics import plane_view

FINER = 8  # lookups along each side of a pixel, which make its mean


def striped(angle: float, phase: float = 0.0, period: float = 6.0) -> np.ndarray:
    """A view's picture of upright stripes on the plane, each `period` pixels of the frontal view wide."""
    fine = plane_view(angle, 96 * FINER)
    width = 2 * fine.camera.focal / FINER / 4  # of the plane in the frontal view, in pixels
    wave = np.where(fine.mask, 0.5 + 0.4 * np.sin(2 * np.pi * (fine.uv[..., 0] * width / period) + phase), 0)
    small = wave.reshape(96, FINER, 96, FINER).mean(axis=(1, 3))
    return np.repeat(small[..., None], 3, axis=-1).astype(np.float32)


@pytest.mark.parametrize("angle", [-50, 0, 65])
def test_steps_are_those_of_the_plane(angle):
    """Against differences of where points of the plane half a pixel on either side lie."""
    a, b = plane_view(20), plane_view(angle)
    shared = overlap(a, b)
    depth = a.depth[shared.both].astype(np.float64)
    steps = pixel_steps(a.camera, b.camera, shared.here, depth, a.normal[shared.both])
    for k in range(2):
        sides = []
        for half in (-0.5, 0.5):
            px = shared.here + half * np.eye(2)[k]
            one, two = (world_from_px(a.camera, px, np.full(len(px), z)) for z in (1.0, 2.0))
            share = one[:, 2] / (one[:, 2] - two[:, 2])  # of the way from the one to the two, where the plane is
            sides.append(px_from_world(b.camera, one + share[:, None] * (two - one))[0])
        np.testing.assert_allclose(steps[:, :, k], sides[1] - sides[0], atol=2e-3)


def test_a_pixel_without_a_normal_faces_its_camera():
    a, b = plane_view(0), plane_view(0)
    shared = overlap(replace(a, normal=np.zeros_like(a.normal)), b)
    assert np.abs(shared.around_there).max() < 0.2 and np.abs(shared.around_here).max() < 0.2


def test_footprints_have_the_spread_that_is_missing():
    """Twice as wide and half as high: it spreads along the first only, by what makes 1 to 2², turned with the pixel."""
    wide, turn = np.diag([2.0, 0.5]), np.array([[0.8, -0.6], [0.6, 0.8]])
    axes = _axes(np.stack([wide, turn @ wide, wide @ turn, np.eye(2), np.diag([50.0, 50.0])]))
    np.testing.assert_allclose(axes[0] @ axes[0].T, np.diag([3, 0]), atol=1e-12)
    np.testing.assert_allclose(axes[1] @ axes[1].T, turn @ np.diag([3, 0]) @ turn.T, atol=1e-12)
    np.testing.assert_allclose(axes[2] @ axes[2].T, np.diag([3, 0]), atol=1e-12)
    assert np.abs(axes[3]).max() < 1e-6 and np.allclose(axes[4] @ axes[4].T, 15 * np.eye(2))


@pytest.mark.parametrize(("first", "second"), [(0, 60), (-35, 50)])
def test_one_painting_agrees_with_itself_and_two_do_not(first, second):
    views = [plane_view(first), plane_view(second)]
    one, other = [striped(a) for a in (first, second)], [striped(first), striped(second, np.pi / 2)]
    chosen = consistency.pairs(views, (0, 95))
    shared = overlap(*views)
    there = seen_there(replace(shared, around_there=0 * shared.around_there), one[1])
    naive = np.sqrt(((there - one[0][shared.both]) ** 2).mean())
    agrees, contradicts = (consistency.warp_rmse(views, pictures, chosen) for pictures in (one, other))
    assert agrees < 0.6 * naive and contradicts > 10 * agrees


def test_what_the_other_view_cannot_see_is_not_shared():
    a, b = plane_view(0), plane_view(30)
    light = np.full((96, 96, 3), 0.5, np.float32)
    none = overlap(a, replace(b, depth=(b.depth - 0.5).astype(np.float32)))
    assert not none.both.any() and seen_there(none, light).shape == (0, 3)
    shared = overlap(a, b)
    assert shared.both.sum() > 0.6 * a.mask.sum() and not (shared.both & ~a.mask).any()
    assert np.allclose(seen_there(shared, light), 0.5) and np.allclose(seen_here(shared, light), 0.5)
