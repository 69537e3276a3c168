"""Metal or dielectric by regions: labels of the field, and black plastic beside metal."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.material_recovery.metrics import calibration
from mistyle.atlas.neighbours import of_islands
from mistyle.atlas.texels import rasterise
from mistyle.core.capture import in_memory
from mistyle.core.image import gaussian
from mistyle.core.maps import Maps
from mistyle.render.mitsuba import device
from mistyle.solver.recover import Recovered, recover
from mistyle.solver.settings import RecoverSettings
from mistyle.solver.table import Atlas
from mistyle.solver.texels.classes import metal_regions
from tests.render.deferred.test_seam import sphere
from tests.solver.test_recover import DIRECT, LIGHTS, SIZE, directional, fibonacci, photographs, strong_maps


def labels(evidence: np.ndarray, apparent: np.ndarray) -> np.ndarray:
    """The field's labels on a grid without holes."""
    size = (evidence.shape[0], evidence.shape[1])
    whole = np.ones(size, bool)
    atlas = Atlas((size,), (whole,), (np.arange(whole.size),), (of_islands(np.zeros(size, int)),))
    colours = np.repeat(apparent.reshape(-1, 1), 3, axis=1).astype(np.float32)
    return metal_regions(evidence.ravel().astype(np.float32), colours, np.arange(whole.size), atlas).reshape(size)


def test_a_highlight_decides_its_region() -> None:
    """Few texels with evidence on either side, none elsewhere, and another colour from the middle."""
    evidence, apparent = np.zeros((8, 32)), np.zeros((8, 32))
    evidence[3:5, 3:6], evidence[3:5, 18:21], apparent[:, 14:] = 60, -60, 0.4
    expected = np.zeros((8, 32), bool)
    expected[:, :14] = True
    assert (labels(evidence, apparent) == expected).all()


def test_strong_evidence_of_single_texels_stays() -> None:
    evidence, apparent = np.full((16, 16), -60.0), np.zeros((16, 16))
    evidence[8, 8], apparent[8, 8] = 60, 0.5
    assert labels(evidence, apparent)[8, 8] and labels(evidence, apparent).sum() == 1


def dark(metal: np.ndarray) -> Maps:
    """Black glossy plastic (albedo 0.001, roughness 0.11), and smooth metal where `metal`."""
    start = strong_maps()
    tilt = 0.4 * start.normal[..., :2]
    normal = np.concatenate([tilt, np.sqrt(1 - (tilt**2).sum(-1, keepdims=True))], axis=-1)
    albedo = np.where(metal[..., None], (0.6, 0.55, 0.5), 0.001).astype(np.float32)
    roughness = np.where(metal, 0.2, 0.11).astype(np.float32)
    return Maps(albedo, normal.astype(np.float32), roughness, metal.astype(np.float32), np.ones((SIZE, SIZE), bool))


def recovered(maps: Maps) -> Recovered:
    device.use()
    mesh = sphere()
    cameras = [replace(c, name=f"{c.name}.{k}") for c in fibonacci(12, 80) for k in range(3)]
    lights = [(directional(*light),) for _ in range(12) for light in LIGHTS]
    pictures = photographs(mesh, [maps], cameras, lights, "mikkt", DIRECT)
    settings = RecoverSettings(metallic=True, black_gloss="plastic", bounces=0, solver="texels")
    return recover(mesh, [rasterise(mesh, 0, SIZE)], in_memory(cameras, lights, pictures), settings, 0)


@pytest.mark.parametrize("share", [0.0, 0.3])
def test_black_plastic_is_no_metal(share: float) -> None:
    """Off the highlight both look alike; the costs of single texels alone made all of it metal."""
    noise = gaussian(np.random.default_rng(1).standard_normal((SIZE, SIZE)).astype(np.float32), 5.0)
    metal = noise > np.quantile(noise, 1 - share) if share else np.zeros((SIZE, SIZE), bool)
    truth = dark(metal)
    found = recovered(truth)
    seen = found.views[0] >= 3
    wrong = ((found.maps[0].metallic > 0.5) != metal)[seen].mean()
    assert wrong < (0.15 if share else 0.005), wrong
    apart = (found.maps[0].albedo - truth.albedo)[seen & ~metal]
    assert np.sqrt((apart**2).mean()) < (0.25 if share else 0.01)
    shares = calibration([truth], found.maps, found.spread, [seen.astype(float)])
    assert abs(shares["within_metallic"] - 0.683) < 0.1, shares
    # Metal without a highlight is uncertain, though its neighbours agree.
    assert shares["within_albedo"] > 0.58, shares
