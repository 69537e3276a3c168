"""Pixels that no light reaches, and how light between surfaces depends on the surface that the camera sees: against
estimates of that light with moved maps."""

from dataclasses import replace

import numpy as np
import pytest

from mistyle.atlas.texels import rasterise
from mistyle.core.camera import look_at
from mistyle.core.capture import in_memory
from mistyle.core.image import gaussian
from mistyle.render.deferred import image_samples as collecting
from mistyle.render.deferred.material_table import pack, unpack
from mistyle.render.mitsuba import device, draw
from mistyle.solver.context import FitContext
from mistyle.solver.indirect import Indirect
from mistyle.solver.joint import pixels as joint_pixels
from mistyle.solver.table import linked
from tests.solver.test_recover import LIGHTS, QUICK, SIZE, directional, hollow, strong_maps

SAMPLES = 256


@pytest.fixture(scope="module")
def bowl():
    """The inside of a bowl that is lit from aslant: part of it is in its own shadow."""
    device.use()
    mesh = hollow()
    maps = strong_maps(3)
    maps = replace(maps, roughness=np.full((SIZE, SIZE), 0.8, np.float32), albedo=0.3 + 0.6 * maps.albedo)
    cameras = [look_at([0.6, 0.4, 4], fov=30, size=(48, 48), name=name) for name in "ab"]
    cameras.append(look_at([-0.9, 0.2, 4], fov=30, size=(48, 48), name="c"))
    lights = [(directional(*LIGHTS[k]),) for k in range(3)]
    captures = in_memory(cameras, lights, [np.zeros((48, 48, 3), np.float32)] * 3)
    texels = [rasterise(mesh, 0, SIZE)]
    settings = QUICK.model_copy(update={"bounces": 1})
    tangents = collecting.tangents_of(mesh, "mikkt")
    context = FitContext(draw.tracer(mesh), tangents, texels, linked(mesh, texels), captures, settings)
    return context, context.renderer(subsamples=9), pack([maps])


def test_every_pixel_that_shows_the_mesh_is_there_once(bowl):
    """Where light between surfaces is looked for; the lit ones are the same as without."""
    context, renderer, table = bowl
    pictures, unknown, left = joint_pixels.image_footprints(context, renderer)
    alone = replace(context, settings=context.settings.model_copy(update={"bounces": 0}))
    lit, fewer, more_left = joint_pixels.image_footprints(alone, renderer)
    assert left < more_left and len(fewer.rows) <= len(unknown.rows)
    for k, (pixels, only) in enumerate(zip(pictures, lit, strict=True)):
        shown = renderer.image_and_coverage(table, k)[1].ravel() > 0
        dark = pixels.lit == 0
        assert 0.02 * shown.sum() < dark.sum() < 0.98 * shown.sum()
        # A flash shows less than a camera where the surface is seen from its very edge.
        assert set(pixels.index) <= set(np.flatnonzero(shown)) and len(set(pixels.index)) == len(pixels.index)
        assert len(pixels.index) > 0.995 * shown.sum()
        np.testing.assert_array_equal(pixels.index[~dark], only.index)
        np.testing.assert_array_equal(pixels.lit[~dark], only.lit)
        np.testing.assert_allclose(pixels.fetch.sum(axis=1), 1, atol=1e-5)


@pytest.mark.parametrize(
    ("columns", "far", "metallic"),
    [((3,), 0.1, 0.0), ((4,), 0.1, 0.0), ((0, 1, 2), 0.05, 0.0), ((0, 1, 2), 0.05, 1.0)],
)
def test_light_between_surfaces_follows_what_reflects_it(bowl, columns, far, metallic):
    """By tilt and albedo: against estimates of maps that are moved in a patch, which hardly lights itself."""
    context, renderer, table = bowl
    table = table.copy()
    table[:, 6] = metallic
    pictures, unknown, _ = joint_pixels.image_footprints(context, renderer)
    axes, camera, many = (
        joint_pixels.unknown_frames(context, unknown),
        context.captures.cameras[0],
        [context.captures.lights[0]],
    )
    mesh, sizes = context.traced.mesh, context.atlas.sizes
    (light, vectors), *_ = Indirect(mesh, unpack(table, sizes)).pictures(camera, many, SAMPLES, 3, vectors=True)
    derivative = joint_pixels.indirect_jacobian(pictures[0], light, vectors, camera.size, table[unknown.rows], axes)
    place = context.texels[0].position.reshape(-1, 3)
    lowest = context.texels[0].covered.ravel() & (place[:, 2] < -0.7)
    assert 0.03 < lowest.sum() / context.texels[0].covered.sum() < 0.3
    moves = np.zeros_like(table)
    moves[np.ix_(lowest, columns)] = far
    real = []
    for moved in (table + moves, table - moves):
        real.append(Indirect(mesh, unpack(moved, sizes)).pictures(camera, many, SAMPLES, 3)[0][0])
    real = ((real[0] - real[1]) / 2).reshape(-1, 3)
    told = np.zeros_like(real)
    told[pictures[0].index] = joint_pixels.indirect_delta(pictures[0], derivative, moves[unknown.rows])
    inside = np.zeros(len(real), bool)
    inside[pictures[0].index] = pictures[0].fetch @ lowest[unknown.rows].astype(np.float32) > 0.999
    assert inside.sum() > 50
    real, told = (
        gaussian(a.reshape(48, 48, 3) * inside.reshape(48, 48, 1), 1.0).reshape(-1, 3)[inside] for a in (real, told)
    )
    assert np.linalg.norm(real - told) < 0.3 * np.linalg.norm(real)
