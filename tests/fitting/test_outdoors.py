"""The sun's direction from shading and shadows, its cell beside the sky's, and the gauge by a known albedo."""

import argparse
from pathlib import Path

import numpy as np
import pytest

from benchmarks.material_recovery import pictures as drawing
from mistyle.cli.fit import known_albedo
from mistyle.core.capture import in_memory
from mistyle.core.errors import InputRefused, UsageError
from mistyle.core.light import Ambient, Directional, Environment
from mistyle.core.maps import flat_maps
from mistyle.fitting.light import cells as light_cells
from mistyle.fitting.light import outdoors, unknown_light
from mistyle.fitting.light.gauge import gauged
from mistyle.fitting.light.unknown_light import FoundLight
from mistyle.io.read_mesh import read_mesh
from mistyle.render.deferred.material_table import pack
from mistyle.render.deferred.renderer import MaterialRenderer, RenderOptions
from mistyle.render.mitsuba.draw import gbuffer, tracer
from mistyle.solver.settings import RecoverSettings
from tests.support.helpers import ROOT

SIDE, VIEWS, TEXELS = 96, 8, 64
SUN = np.array([0.6, 0.7, 0.39]) / np.linalg.norm([0.6, 0.7, 0.39])


@pytest.fixture(scope="module")
def mesh():
    return read_mesh(ROOT / "scenes" / "demo.obj").mesh


def observed(mesh, lights):
    """Texel observations of a patterned object under these lights, and the texels' normals."""
    rng = np.random.default_rng(3)
    maps = [flat_maps(TEXELS, 0.5, roughness=0.7) for _ in mesh.parts]
    for each in maps:
        coarse = rng.uniform(0.2, 0.6, (16, 16, 3)).astype(np.float32)
        each.albedo[...] = np.kron(coarse, np.ones((TEXELS // 16, TEXELS // 16, 1), np.float32))
    cameras, traced = drawing.fibonacci(VIEWS, SIDE), tracer(mesh)
    blank = in_memory(cameras, [lights] * VIEWS, [np.zeros((SIDE, SIDE, 3), np.float32)] * VIEWS)
    renderer = MaterialRenderer(traced, blank, [(TEXELS, TEXELS)] * len(maps), RenderOptions(subsamples=4, memory=0))
    drawn = [renderer.image_and_coverage(pack(maps), k) for k in range(VIEWS)]
    captures = in_memory(cameras, [()] * VIEWS, [p for p, _ in drawn], [c > 0.999 for _, c in drawn])
    noise = unknown_light.NOISE, unknown_light.RELATIVE
    _, texels, seen = unknown_light._observations(traced, captures, RecoverSettings(), np.arange(VIEWS), noise)
    return traced, seen, np.concatenate([t.normal[t.covered] for t in texels])


def test_shading_and_shadows_give_the_suns_direction(mesh):
    sun = Directional(tuple(SUN.tolist()), (3.0, 2.8, 2.4))
    found = outdoors.find_sun(*observed(mesh, (Ambient((0.5, 0.6, 0.8)), sun)))
    assert found is not None and found.direction @ SUN > np.cos(np.radians(6))


def test_without_a_sun_none_is_found(mesh):
    assert outdoors.find_sun(*observed(mesh, (Ambient((0.5, 0.6, 0.8)),))) is None


def test_the_suns_cell_comes_back_as_a_directional_light():
    cells = light_cells.even_cells()
    radiance = np.random.default_rng(0).random((len(cells.angle), 3))
    whole, more = outdoors.with_sun(cells, radiance, outdoors.Sun(SUN, 0.5))
    more[-1] = (300.0, 200.0, 100.0)
    sky, rest, sun = outdoors.without_sun(whole, more)
    assert (sky.direction == cells.direction).all() and (rest == radiance).all()
    assert np.allclose(sun.direction, SUN) and np.allclose(sun.irradiance, np.array([3.0, 2.0, 1.0]))


def test_a_grey_card_fixes_scale_and_colour(mesh):
    maps = tuple(flat_maps(32, 0.5) for _ in mesh.parts)
    for each in maps:
        each.albedo[...] = (0.2, 0.3, 0.4)
    found = FoundLight(Environment(np.ones((8, 16, 3), np.float32)), (), maps)
    camera = drawing.fibonacci(1, 48)[0]
    everything = np.ones(camera.size, bool)
    assert gbuffer(mesh, camera).mask.any()
    scaled, factor = gauged(mesh, found, camera, everything, (0.18, 0.18, 0.18))
    assert np.allclose(factor, [0.9, 0.6, 0.45]) and np.allclose(scaled.maps[0].albedo, 0.18)
    assert np.allclose(scaled.light.radiance[0, 0], 1 / np.array(factor))
    with pytest.raises(InputRefused, match="0 pixels of the mesh"):
        gauged(mesh, found, camera, ~everything, (0.18, 0.18, 0.18))


def test_the_options_form_is_checked():
    def options(text: str, light: str = "unknown") -> argparse.Namespace:
        return argparse.Namespace(albedo_of=text, light=light)

    assert known_albedo(options("card/IMG_1.png=0.18")) == (Path("card/IMG_1.png"), (0.18, 0.18, 0.18))
    assert known_albedo(options("a.png=0.1,0.2,0.3", "outdoors"))[1] == (0.1, 0.2, 0.3)
    for text in ("a.png", "a.png=", "a.png=1,2", "a.png=18", "=0.18"):
        with pytest.raises(UsageError, match="MASK=VALUE"):
            known_albedo(options(text))
    with pytest.raises(UsageError, match="known light"):
        known_albedo(options("a.png=0.18", "known"))
