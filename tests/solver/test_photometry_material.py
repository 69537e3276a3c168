"""Photometry solved with a material: its system against differences, and what was done to pictures of gloss."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.material_recovery import pictures as drawing
from mistyle.core.camera import pixel_centres
from mistyle.core.capture import in_memory
from mistyle.core.image import gaussian
from mistyle.core.light import Environment
from mistyle.core.maps import flat_maps
from mistyle.fitting.pipeline.times import explaining_seconds
from mistyle.render.deferred.material_table import pack
from mistyle.render.deferred.renderer import MaterialRenderer, RenderOptions
from mistyle.render.mitsuba.draw import tracer
from mistyle.solver.photometry import material
from mistyle.solver.photometry.explain import explained
from mistyle.solver.photometry.record import Gains, coordinates, fall_terms, unchanged, with_gains
from mistyle.solver.texels.levenberg_marquardt import Options
from tests.render.deferred.test_seam import sphere
from tests.solver.test_photometry import FALL, gains

SIDE, VIEWS, TEXELS = 96, 24, 64
EACH = 100  # observations of a picture: a third of the usual number


@pytest.fixture(scope="module", autouse=True)
def few():
    """An eighth of the usual observations, which the solver's time is proportional to."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(material, "OBSERVATIONS", EACH * VIEWS)
        patch.setattr(material, "LEAST_EACH", EACH)
        yield


@pytest.fixture(scope="module")
def glossy():
    """A tracer and linear pictures of a dark, glossy sphere with metal patches under a known sky."""
    mesh, rng = sphere(), np.random.default_rng(3)
    maps = [flat_maps(TEXELS, 0.5, roughness=0.35)]
    field = gaussian(rng.standard_normal((TEXELS, TEXELS)).astype(np.float32), 5.0)
    maps[0].albedo[...] = 0.03 + 0.1 * rng.random((TEXELS, TEXELS, 3))
    metal = field > 0.5 * field.std()
    maps[0].metallic[metal], maps[0].albedo[metal] = 1, (0.8, 0.6, 0.4)
    rows, columns = np.mgrid[0:32, 0:64]
    sun = 6 * np.exp(-(((rows - 9) / 5.0) ** 2) - ((columns - 40) / 7.0) ** 2)
    sky = Environment((0.5 + sun[..., None] * np.array([1.0, 0.85, 0.6])).astype(np.float32))
    cameras, traced = drawing.fibonacci(VIEWS, SIDE), tracer(mesh)
    captures = in_memory(cameras, [(sky,)] * VIEWS, [np.zeros((SIDE, SIDE, 3), np.float32)] * VIEWS)
    renderer = MaterialRenderer(traced, captures, [(TEXELS, TEXELS)], RenderOptions(subsamples=4, memory=0))
    pictures = [renderer.image_and_coverage(pack(maps), k) for k in range(VIEWS)]
    return traced, replace(captures, load=lambda k: (pictures[k][0], pictures[k][1] > 0.999))


def photographed(glossy, done: Gains):
    """The pictures with these gains and this vignetting."""
    captures = glossy[1]

    def load(k: int):
        rgb, valid = captures.load(k)
        camera = captures.cameras[k]
        fall = fall_terms(coordinates(camera, pixel_centres(camera.size))) @ done.vignetting
        return (rgb * np.exp(done.gain[k] + fall[..., None])).astype(np.float32), valid

    return replace(captures, load=load)


def samples_of(glossy, done: Gains):
    """Their observations."""
    return material.material_samples(glossy[0], photographed(glossy, done), None)


def test_the_reduced_system_is_that_of_the_model(glossy):
    """Its gradient against differences of the cost, the texels answering each time."""
    samples = material.material_samples(*glossy, None)
    samples = replace(samples, regions=None)
    problem = material.Problem(samples.points, samples.rig, samples.observations, Options())
    work = material._Solve(samples, problem)
    rng = np.random.default_rng(0)
    start = Gains(rng.normal(0, 0.05, (VIEWS, 3)), np.array([0.05, 0.0, 0.0]))
    work.target(start)
    values = work.texels(work.anew(), 60).values
    system = material.reduced_system(samples, problem, values, work.y, work.weight)
    step = 0.002 * system.gradient / np.abs(system.gradient).max()
    costs = []
    for sign in (-1, 1):
        # The model moves, not the pictures, so that their weights stay.
        moved = np.exp(material.log_gain(samples, Gains(np.zeros((VIEWS, 3)), np.zeros(3)).moved(sign * step)))
        problem.retarget((work.y / moved).astype(np.float32))
        problem.reweight((work.weight * moved.mean(axis=1)).astype(np.float32))
        costs.append(work.cost(work.texels(values, 60)))
    assert (costs[1] - costs[0]) / 2 == pytest.approx(-2 * system.gradient @ step, rel=0.15)
    assert np.linalg.eigvalsh(system.matrix)[0] > -1e-6 * np.trace(system.matrix)


def test_pictures_are_decoded_once(glossy, monkeypatch):
    """Also where the coarse atlas is laid out twice: decoding photographs takes longer than all else."""
    traced, captures = glossy
    loaded: list[int] = []

    def load(k: int):
        loaded.append(k)
        return captures.load(k)

    monkeypatch.setattr(material, "OBSERVATIONS", 2000)
    monkeypatch.setattr(material, "LEAST_EACH", 50)
    material.material_samples(traced, replace(captures, load=load), None)
    assert sorted(loaded) == list(range(VIEWS))
    with_sky = sum(explaining_seconds(80, 40.0, unknown=True)) - sum(explaining_seconds(80, 0.0, unknown=True))
    assert with_sky == pytest.approx(40 + 40 * 48 / 80) and sum(explaining_seconds(9, 7.0, unknown=False)) > 7


def test_exposures_of_metal_and_dark_gloss_are_found(glossy):
    """Within 2 % (root mean square). The goal of 2 % for the largest error is missed: 3.4 % in the darkest pictures."""
    exposure, balance = gains(1)
    done = Gains(exposure[:, None] + balance, FALL)
    found, together = explained(samples_of(glossy, done), unchanged(glossy[1], ()), Options())
    assert together
    assert found.applied and "those solved with it are used" in found.notes[0]
    solved = found.exposure[:, None] + found.balance
    wrong = np.expm1(solved - done.gain)
    assert np.sqrt((wrong**2).mean()) < 0.02 and np.abs(wrong).max() < 0.04
    assert 0.65 < found.reach < 0.66
    seen = np.linspace(0, 0.4, 5)[:, None] * np.array([[1.0, 0.0]])  # the object does not reach the corners
    assert np.abs(np.expm1(fall_terms(seen) @ (found.vignetting - FALL))).max() < 0.02


def test_equal_exposures_of_gloss_are_recognised(glossy):
    """Also where points alone took its highlights for exposures."""
    exposure, balance = gains(2)
    wrong = with_gains(unchanged(glossy[1], ()), Gains(exposure[:, None] + balance, FALL), (1.0, 0.5))
    found, together = explained(material.material_samples(*glossy, None), wrong, Options())
    assert not found.applied and not together and "nothing was corrected" in found.notes[0]
    assert not np.abs(found.exposure).any() and not np.abs(found.vignetting).any()
