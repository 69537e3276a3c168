"""The albedo's detail where the texels were solved on a coarser level."""

from dataclasses import replace

import numpy as np
import pytest

from mistyle.atlas.texels import rasterise
from mistyle.core.capture import in_memory
from mistyle.render.mitsuba import device
from mistyle.solver.recover import recover
from mistyle.solver.texels import detail
from mistyle.solver.texels.detail import bands
from tests.render.deferred.test_seam import sphere
from tests.solver.test_recover import (
    DIRECT,
    LIGHTS,
    QUICK,
    SIZE,
    directional,
    errors,
    fibonacci,
    photographs,
    strong_maps,
)

COARSE = QUICK.model_copy(update={"iterations": 0, "rounds": 1, "solver_texels": 1000})


@pytest.fixture(scope="module")
def checks():
    """A sphere whose albedo changes from texel to texel, and its pictures under three lights one at a time."""
    device.use()
    mesh, maps = sphere(), strong_maps()
    fine = np.random.default_rng(1).random((SIZE // 2, SIZE // 2)).repeat(2, 0).repeat(2, 1)
    maps = replace(maps, albedo=np.clip(maps.albedo * (0.6 + 0.6 * fine[..., None]), 0, 1).astype(np.float32))
    cameras = [replace(c, name=f"{c.name}.{k}") for c in fibonacci(8, 128) for k in range(3)]
    lights = [(directional(*light),) for _ in range(8) for light in LIGHTS]
    return mesh, maps, rasterise(mesh, 0, SIZE), in_memory(cameras, lights, photographs(
        mesh, [maps], cameras, lights, "mikkt", DIRECT
    ))  # fmt: skip


def test_the_albedo_has_the_detail_of_the_pictures_and_the_rest_stays(checks, monkeypatch):
    mesh, maps, texels, captures = checks
    plain, fine = (
        recover(mesh, [texels], captures, COARSE.model_copy(update={"detail": chosen}), 0) for chosen in (False, True)
    )
    seen = texels.covered & (plain.seen[0] >= 3)
    before, after = (float(np.sqrt((errors(f.maps[0], maps, seen)[2] ** 2).mean())) for f in (plain, fine))
    assert after < 0.6 * before
    for name in ("normal", "roughness", "metallic"):
        assert np.array_equal(getattr(plain.maps[0], name), getattr(fine.maps[0], name))
    # Bands of the atlas differ by the units of their noise alone.
    monkeypatch.setattr(detail, "DETAILED", int(texels.covered.sum()) * len(captures) // 3)
    again = recover(mesh, [texels], captures, COARSE.model_copy(update={"detail": True}), 0)
    assert len(bands([texels], len(captures))) > 2
    assert np.abs(again.maps[0].albedo - fine.maps[0].albedo)[texels.covered].mean() < 1e-3
