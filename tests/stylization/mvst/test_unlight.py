"""Light in stylized views: what the known shading explains is divided out, and nothing of what it does not."""

from dataclasses import replace

import numpy as np
import pytest

from mistyle.stylization.mvst import unlight
from tests.stylization.diffusion.test_diffusion import view


def shading(seen) -> np.ndarray:
    """A ball under one lamp from the side, and a little light from everywhere."""
    lamp = np.array([0.8, 0.1, 0.6]) / np.linalg.norm([0.8, 0.1, 0.6])
    return np.where(seen.mask, 0.15 + np.maximum(seen.normal @ lamp, 0), 0).astype(np.float32)


def painted(side: int, strength: float, seed: int = 0):
    """A painting of noise in large flecks, lit by `shading` to the power of `strength`; and the painting alone."""
    from mistyle.core.image import gaussian

    seen = view(size=(side, side))
    flecks = gaussian(np.random.default_rng(seed).normal(size=(side, side, 3)).astype(np.float32), side / 24)
    paint = np.where(seen.mask[..., None], 0.4 * np.exp(flecks / flecks.std() * 0.25), 0).astype(np.float32)
    light = np.where(seen.mask, np.maximum(shading(seen), 1e-3) ** strength, 0)[..., None]
    return replace(seen, rgb=(paint * light).astype(np.float32)), replace(seen, rgb=paint)


def left(seen, truth) -> float:
    inside = truth.mask & (truth.rgb.min(axis=-1) > 0)
    return float(np.std(np.log(seen.rgb[inside].mean(axis=-1) / truth.rgb[inside].mean(axis=-1))))


@pytest.mark.parametrize("strength", [1.0, 0.6])
def test_known_light_is_taken_out(strength):
    lit, truth = zip(*(painted(128, strength, seed) for seed in range(4)), strict=True)
    bare = [shading(one) for one in lit]
    found = unlight.share(lit, bare)
    assert found == pytest.approx(strength, abs=0.12)
    plain = unlight.unlit(lit, [unlight.gain(one, each, found) for one, each in zip(lit, bare, strict=True)])
    assert left(plain[0], truth[0]) < 0.3 * left(lit[0], truth[0])
    assert unlight.share(lit, bare, 0.3) == pytest.approx(min(found, 0.3))


def test_views_without_that_light_stay_as_they_are():
    _, truth = zip(*(painted(128, 1.0, seed) for seed in range(4)), strict=True)
    bare = [shading(one) for one in truth]
    assert unlight.share(truth, bare) == 0
    gains = [unlight.gain(one, each, 0.0) for one, each in zip(truth, bare, strict=True)]
    assert all(np.array_equal(a.rgb, b.rgb) for a, b in zip(unlight.unlit(truth, gains), truth, strict=True))
    # Lighter above than below is the painter's own, and another lamp than the known one explains nothing.
    above = [replace(t, rgb=t.rgb * np.exp(t.normal[..., 1:2])) for t in truth]
    assert unlight.share(above, bare) == 0
    other = [replace(t, rgb=t.rgb * shading(t)[:, ::-1, None]) for t in truth]
    assert unlight.share(other, bare) == 0


def test_the_factor_is_bounded_and_keeps_the_mean():
    lit, _ = painted(64, 1.0)
    dark = shading(lit) * np.where(np.arange(64) < 32, 1e-6, 1)
    factor = unlight.gain(lit, dark.astype(np.float32), 1.0)
    assert 1 / unlight.BOUND <= factor.min() and factor.max() <= unlight.BOUND and (factor[~lit.mask] == 1).all()
    mean = np.log(unlight.gain(lit, shading(lit), 1.0)[lit.mask]).mean()
    assert abs(mean) < 0.05


def test_nothing_to_compare_is_no_light():
    lit, _ = painted(64, 1.0)
    assert unlight.share([lit], [np.zeros_like(lit.coverage)]) == 0
    assert unlight.share([], []) == 0
