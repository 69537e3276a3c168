"""The light left in a finished albedo: said right for an albedo with a known light in it."""

from dataclasses import replace

import numpy as np
import pytest

from mistyle.atlas.texels import rasterise
from mistyle.core.maps import flat_maps
from mistyle.stylization.optimise.light_left import light_left
from tests.stylization.surface.test_surface import dented_ball


@pytest.mark.parametrize(("lit", "ratio"), [(0.0, 1.0), (0.8, 3.0)])
def test_a_known_light_is_found(lit, ratio):
    ball = dented_ball()
    corners = ball.positions[ball.faces]
    uvs = np.stack([np.arctan2(corners[..., 0], corners[..., 2]) / 7 + 0.5, corners[..., 1] * 0.45 + 0.5], axis=-1)
    ball = replace(ball, corner_uvs=uvs.astype(np.float32))
    texels = rasterise(ball, 0, 96)
    maps = flat_maps(96)
    albedo = np.repeat((0.5 * (1 + lit * texels.normal[..., 1:2])).astype(np.float32), 3, axis=2)
    found = light_left(ball, [texels], [replace(maps, albedo=albedo)])
    assert found is not None and found.ratio is not None
    assert found.ratio > ratio if lit else found.ratio == pytest.approx(1, abs=1e-6)
    assert found.y > 0.9 if lit else found.strongest == 0
    nothing = replace(texels, covered=np.zeros_like(texels.covered))
    assert light_left(ball, [nothing], [maps]) is None
