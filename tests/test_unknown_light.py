"""An unknown environment: found where it shines from, by conventions that are kept, from pictures Mitsuba made."""

import numpy as np
import pytest
from helpers import ROOT

from benchmarks import recovery_pictures as drawing
from mistyle.core.capture import in_memory
from mistyle.core.image import luminance, resize
from mistyle.core.light import Environment
from mistyle.core.maps import flat_maps
from mistyle.files.read import read_mesh
from mistyle.stages import unknown_light
from mistyle.stages.recover_settings import RecoverSettings

ALBEDO = (0.3, 0.45, 0.6)


@pytest.fixture(scope="module")
def mesh():
    return read_mesh(ROOT / "scenes" / "demo.obj").mesh


@pytest.fixture(scope="module")
def sky() -> Environment:
    """A dim sky with one broad, warm sun half-way up at one side."""
    rows, columns = np.mgrid[0:32, 0:64]
    sun = 12 * np.exp(-(((rows - 9) / 4.0) ** 2) - ((columns - 40) / 6.0) ** 2)
    radiance = 0.3 + sun[..., None] * np.array([1.0, 0.8, 0.5])
    return Environment(radiance.astype(np.float32))


@pytest.fixture(scope="module")
def found(mesh, sky):
    maps = [flat_maps(64, 0.5, roughness=0.4)]
    maps[0].albedo[...] = ALBEDO
    cameras = drawing.fibonacci(8, 48)
    shots = [drawing.Shot(camera, (sky,)) for camera in cameras]
    pictures = drawing.render(mesh, maps, shots, frame="mikkt", spp=16)
    captures = in_memory(
        cameras, [()] * len(cameras), [p[..., :3] for p in pictures], [p[..., 3] > 0.999 for p in pictures]
    )
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(unknown_light, "ROUNDS", 2)
        patch.setattr(unknown_light, "STEPS", 40)
        return unknown_light.find_light(mesh, captures, RecoverSettings(), 0)


def test_the_light_is_found_where_it_is(found, sky):
    shape = found.light.radiance.shape[:2]
    true = luminance(resize(sky.radiance, shape))
    mine = luminance(found.light.radiance)
    mine = resize(mine[..., None], shape)[..., 0]
    brightest, guess = (np.unravel_index(np.argmax(m), shape) for m in (true, mine))
    apart = min(abs(brightest[1] - guess[1]), shape[1] - abs(brightest[1] - guess[1]))
    assert abs(brightest[0] - guess[0]) <= 2 and apart <= 2
    assert np.corrcoef(true.ravel(), mine.ravel())[0, 1] > 0.7
    turned = np.roll(mine, shape[1] // 2, axis=1)
    assert np.corrcoef(true.ravel(), turned.ravel())[0, 1] < 0.3


def test_scale_and_colour_are_the_stated_conventions(found):
    _, angles = unknown_light._grid()
    mean = (found.light.radiance * angles[..., None]).sum(axis=(0, 1)) / angles.sum()
    assert np.ptp(mean) < 0.02 * mean.mean()
    seen = found.maps[0].known
    bright = np.quantile(luminance(found.maps[0].albedo[seen]), 0.95)
    assert bright == pytest.approx(unknown_light.BRIGHT, abs=0.05)


def test_light_and_materials_explain_the_pictures(found):
    assert found.residuals[-1] < 0.15
    assert found.residuals[-1] <= found.residuals[0]
