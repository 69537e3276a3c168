"""Depth that follows a moved outline, on outlines that were moved by a known field."""

from dataclasses import replace

import numpy as np
import pytest

from mistyle.core.image import dilate, erode, gaussian
from mistyle.stylization.mvst.outline import carried, displacement, distance_to, follow, signed
from tests.stylization.mvst.test_warp import at, see

SIZE = 192


def thing(size: int = SIZE) -> np.ndarray:
    """A body with four limbs, none thinner than the largest shift."""
    y, x = np.mgrid[:size, :size] / size
    mask = np.zeros((size, size), bool)
    for cx, cy, r in ((0.5, 0.5, 0.2), (0.65, 0.35, 0.1), (0.35, 0.4, 0.09), (0.42, 0.72, 0.08), (0.6, 0.72, 0.08)):
        mask |= (x - cx) ** 2 + (y - cy) ** 2 < r * r
    return mask


def outline_error(a: np.ndarray, b: np.ndarray) -> float:
    """Mean distance between two outlines in pixels: that of each outline pixel to the other outline, both ways."""
    total, count = 0.0, 0
    for one, other in ((a, b), (b, a)):
        rim = one & (distance_to(~one) < 1.5)
        total += float(np.maximum(np.abs(signed(other)[rim]) - 0.5, 0).sum())
        count += int(rim.sum())
    return total / count if count else 0.0


def waves(shift: float, rng: np.random.Generator) -> np.ndarray:
    """A smooth displacement of at most `shift` pixels."""
    field = gaussian(rng.normal(size=(SIZE, SIZE, 2)).astype(np.float32), 0.07 * SIZE)
    return field * np.float32(shift / np.linalg.norm(field, axis=2).max())


def moved(kind: str, shift: float, rng: np.random.Generator) -> np.ndarray:
    mask = thing()
    if kind == "waves":
        return carried(mask, waves(shift, rng))
    if kind == "across":
        return carried(mask, np.full((SIZE, SIZE, 2), shift / np.sqrt(2), np.float32))
    return signed(mask) > (-shift if kind == "fatter" else min(shift, 8))


@pytest.mark.parametrize("shift", [2.0, 5.0, 10.0, 15.0])
@pytest.mark.parametrize("kind", ["waves", "across", "fatter", "thinner"])
def test_the_outline_is_followed_to_under_a_pixel(kind, shift, rng):
    was, now = thing(), moved(kind, shift, rng)
    before, after = outline_error(was, now), outline_error(carried(was, displacement(was, now)), now)
    assert after < 0.5 and after < before


@pytest.mark.parametrize("kind", ["waves", "across"])
def test_the_field_is_smooth(kind, rng):
    """Neighbours on the thing stay in order; nothing moves where nothing moved."""
    now = moved(kind, 5.0, rng)
    field = displacement(thing(), now)
    stretch = [np.diff(field[..., 0], axis=1)[now[:, 1:]], np.diff(field[..., 1], axis=0)[now[1:]]]
    assert all(s.min() > -0.9 and s.max() < 1 for s in stretch)
    assert np.abs(displacement(thing(), thing())).max() < 0.1


def test_outline_error_of_a_known_shift():
    """A half plane moved by seven pixels; the same mask; a mask that is not there."""
    a, b = np.zeros((40, 40), bool), np.zeros((40, 40), bool)
    a[:, :20], b[:, :27] = True, True
    assert outline_error(a, b) == pytest.approx(7, abs=1.01)
    assert outline_error(a, a) == 0
    assert signed(a)[5, 19] == 0.5 and signed(a)[5, 20] == -0.5 and signed(a)[5, 24] == -4.5


def test_depth_goes_with_a_shifted_picture():
    """A stylizer that draws the thing six pixels to the right: the outline's depth is that of six to the left."""
    balls = [(0.0, 0.0, 0.0, 0.6), (0.5, 0.3, 0.6, 0.25)]
    view = see(at(0, size=128), balls)
    mask = np.roll(view.mask, 6, axis=1)
    truth = np.roll(view.depth, 6, axis=1)
    followed = follow(view, mask)
    assert np.array_equal(followed.mask, mask)
    assert np.isfinite(followed.depth[mask]).all() and np.isinf(followed.depth[~mask]).all()
    assert not followed.normal[~mask].any() and (followed.part[~mask] == -1).all()
    rim = mask & ~erode(mask, 6)
    both = rim & view.mask
    was, now = (np.abs(d[both] - truth[both]) for d in (view.depth, followed.depth))
    assert np.median(now) < 0.25 * np.median(was)
    # Every value is one of the view's own: nothing was averaged across a depth step.
    assert np.isin(followed.depth[mask], view.depth[view.mask]).all()


def test_masks_without_an_outline():
    view = see(at(0, size=32), [(0, 0, 0, 0.6)])
    nothing = np.zeros_like(view.mask)
    assert not displacement(view.mask, nothing).any() and not displacement(~nothing, view.mask).any()
    empty = follow(view, nothing)
    assert not empty.mask.any() and np.isinf(empty.depth).all()
    assert not follow(replace(view, mask=nothing), view.mask).mask.any()
    assert outline_error(nothing, nothing) == 0


def test_the_same_mask_changes_nothing_inside():
    view = see(at(0, size=64), [(0, 0, 0, 0.8)])
    followed = follow(view, view.mask)
    inner = erode(view.mask, 4)
    assert np.array_equal(followed.depth[inner], view.depth[inner])
    assert np.array_equal(followed.rgb, view.rgb)
    assert (dilate(view.mask, 1) >= followed.mask).all()
