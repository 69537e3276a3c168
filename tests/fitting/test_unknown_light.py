"""An unknown environment: found where it shines from, as bright as it is, from pictures that Mitsuba made."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.material_recovery import pictures as drawing
from mistyle.atlas.texels import rasterise
from mistyle.core.asset import Material
from mistyle.core.capture import Captures, in_memory
from mistyle.core.errors import InputRefused
from mistyle.core.image import luminance, resize
from mistyle.core.light import Environment, environment_directions
from mistyle.core.maps import Maps, flat_maps
from mistyle.core.mesh import Mesh
from mistyle.fitting.light import cells as light_cells
from mistyle.fitting.light import solve as light_solve
from mistyle.fitting.light import unknown_light
from mistyle.fitting.light.texel_prior import first_mean
from mistyle.io.read_mesh import read_mesh
from mistyle.render.deferred.sky import bin_environment, even_directions
from mistyle.render.mitsuba.draw import tracer
from mistyle.solver import prior as recover_prior
from mistyle.solver.settings import RecoverSettings
from mistyle.solver.texels.levenberg_marquardt import Options
from mistyle.solver.texels.observations import ObservationOptions, collect_observations
from tests.support.helpers import ROOT

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
def own() -> Maps:
    maps = flat_maps(64, 0.5, roughness=0.4)
    maps.albedo[...] = ALBEDO
    return maps


@pytest.fixture(scope="module")
def captures(mesh, sky, own):
    return photographed(mesh, sky, own)


def photographed(mesh: Mesh, sky: Environment, maps: Maps) -> Captures:
    """Pictures by direct light, which is all that the model has."""
    cameras = drawing.fibonacci(10, 96)
    shots = [drawing.Shot(c, (sky,)) for c in cameras]
    pictures = drawing.render(mesh, [maps], shots, frame="mikkt", spp=16, depth=2)
    return in_memory(
        cameras, [()] * len(cameras), [p[..., :3] for p in pictures], [p[..., 3] > 0.999 for p in pictures]
    )


@pytest.fixture(scope="module")
def found(mesh, captures):
    return unknown_light.find_light(mesh, captures, RecoverSettings())


def total(light: Environment) -> np.ndarray:
    return bin_environment((light,), even_directions(128)).irradiance.sum(axis=0)


def test_the_light_is_found_where_it_is(found, sky):
    directions = even_directions(128)
    close = (directions @ directions.T > np.cos(0.35)).astype(float)
    true, mine = (close @ luminance(bin_environment((e,), directions).irradiance) for e in (sky, found.light))
    assert np.corrcoef(true, mine)[0, 1] > 0.9
    assert directions[true.argmax()] @ directions[mine.argmax()] > np.cos(np.radians(20))
    turned = close @ luminance(bin_environment((replace(found.light, turn=180.0),), directions).irradiance)
    assert np.corrcoef(true, turned)[0, 1] < 0.3


def test_highlights_tell_how_bright_and_how_warm_it_is(found, sky):
    """By convention alone the albedo would be grey, and the light too blue."""
    albedo = np.median(found.maps[0].albedo[found.maps[0].known], axis=0)
    assert albedo[0] < 0.9 * albedo[1] < 0.9 * albedo[2]
    assert brightness(found.light, sky) == pytest.approx(1, rel=0.2)
    warm = total(found.light) / total(sky)
    assert warm.max() / warm.min() < 1.2 < 0.9 * total(sky)[0] / total(sky)[2]


def brightness(light: Environment, sky: Environment) -> float:
    there = luminance(np.array([total(light), total(sky)], np.float32))
    return float(there[0] / there[1])


def test_dark_surfaces_are_not_taken_for_white_ones_in_dim_light(mesh, sky, own, found):
    """The convention's albedo is nearly three times theirs."""
    dark = replace(own, albedo=(own.albedo * 0.4).astype(np.float32))
    light = unknown_light.find_light(mesh, photographed(mesh, sky, dark), RecoverSettings()).light
    assert brightness(light, sky) == pytest.approx(brightness(found.light, sky), rel=0.3)


def test_metals_do_not_brighten_the_light(mesh, sky, own):
    """Half of the texture is metal; a dielectric would need a light many times as bright for its reflections."""
    maps = replace(own, metallic=np.where(np.arange(64)[None] < 32, 1, own.metallic).astype(np.float32))
    captures = photographed(mesh, sky, maps)
    fitted = unknown_light.find_light(mesh, captures, RecoverSettings(metallic=True))
    assert brightness(fitted.light, sky) == pytest.approx(1, rel=0.25)
    known, metal = fitted.maps[0].known, fitted.maps[0].metallic > 0.5
    half = metal.shape[1] // 2
    left, right = metal[:, :half][known[:, :half]], metal[:, half:][known[:, half:]]
    assert left.mean() > 0.5 > 3 * right.mean()


def test_a_metallic_that_is_not_fitted_is_the_material_s(mesh, sky, own):
    metal = replace(own, metallic=np.ones_like(own.metallic))
    captures, material = photographed(mesh, sky, metal), Material("m", None, None, None, None, np.ones(3), 1.0, 1.0)
    kept = unknown_light.find_light(mesh, captures, RecoverSettings(), materials=(material,))
    assert (kept.maps[0].metallic[kept.maps[0].known] > 0.99).all()
    assert brightness(kept.light, sky) == pytest.approx(1, rel=0.3)


def test_light_and_materials_explain_the_pictures(found):
    assert found.residuals[-1] < 0.02 and found.residuals[-1] < 0.7 * found.residuals[0]


def test_pictures_that_show_nothing_are_refused(mesh, captures):
    away = [replace(c, world_from_cam=c.world_from_cam @ np.diag([-1.0, 1, -1, 1])) for c in captures.cameras]
    with pytest.raises(InputRefused, match="found no place of the mesh that 3 of the pictures show"):
        unknown_light.find_light(mesh, replace(captures, cameras=tuple(away)), RecoverSettings())


def test_cells_and_their_map_hold_the_same_light(sky):
    cells = light_cells.even_cells()
    assert cells.angle.sum() == pytest.approx(4 * np.pi, rel=1e-3)
    assert np.abs(cells.angle * light_cells.CELLS / (4 * np.pi) - 1).max() < 0.2
    rng = np.random.default_rng(2)
    radiance = rng.random((light_cells.CELLS, 3)) ** 8 * 50
    energy = (radiance * cells.angle[:, None]).sum(axis=0)
    np.testing.assert_allclose(total(light_cells.environment_of(cells, radiance)), energy, rtol=0.02)
    finer, spread = light_cells.refined(cells, radiance)
    np.testing.assert_allclose((spread * finer.angle[:, None]).sum(axis=0), energy, rtol=1e-6)
    assert len(finer.angle) == light_cells.CELLS + light_cells.FINE
    brightest = cells.direction[luminance(radiance).argmax()]
    inside = finer.direction @ brightest > np.cos(0.17)
    assert inside.sum() >= 4 and finer.angle[inside].mean() < 0.6 * cells.angle.mean()
    same = light_cells.environment_of(finer, spread).radiance
    towards = environment_directions(*same.shape[:2])
    assert same.shape == (*towards.shape[:2], 3) and np.isfinite(same).all()


def bundled(mesh, captures):
    """The problem of the pictures on a very coarse atlas."""
    texels, traced = rasterise(mesh, 0, 32), tracer(mesh)
    lit = replace(captures, lights=tuple((Environment(np.ones((8, 16, 3), np.float32)),) for _ in captures.cameras))
    observed = collect_observations(traced, [texels], lit, None, ObservationOptions(noise=0.01, relative=0.03))
    cells = light_cells.even_cells()
    options = Options("principled", False, floor=0.1)
    return light_solve.bundle(traced, observed, texels.normal[texels.covered], cells, options, first_mean([texels], ()))


def test_the_light_s_system_is_that_of_the_model(mesh, captures):
    """The gradient against differences of the cost, the texels answering each time; and what pictures cannot tell."""
    own = bundled(mesh, captures)
    radiance = np.random.default_rng(0).uniform(0.5, 1.5, (len(own.cells.angle), 3))
    state = light_solve.texels_under(own, radiance, own.mean, 60)
    matrix, gradient = light_solve._system(own, state, follow=True)
    alone, _ = light_solve._system(own, state, follow=False)
    uphill = gradient.reshape(3, -1).T
    step = 0.005 * np.sqrt((radiance**2).mean() / (uphill**2).mean()) * uphill
    low, high = (light_solve.texels_under(own, radiance + s * step, state.values, 60).cost for s in (-1, 1))
    assert (high - low) / 2 == pytest.approx(-2 * gradient @ step.T.ravel(), rel=0.05)
    assert np.linalg.eigvalsh(alone - matrix)[0] > -1e-6 * np.trace(alone) / len(alone)
    brighter = radiance.T.ravel()  # which darker albedo makes up for, but for the highlights
    assert brighter @ matrix @ brighter < 0.01 * brighter @ alone @ brighter


def test_texels_are_eliminated_as_from_the_whole_matrix(mesh, captures):
    own = bundled(mesh, captures)
    rng, cells, count = np.random.default_rng(3), len(own.cells.angle), len(own.observed.texel)
    rows = len(own.owner)
    by_texel = rng.normal(0, 1, (rows, 3, 7)).astype(np.float32) * own.used[:, None, None]
    by_texel[:, :, own.free :] = 0
    by_texel[:, :, :3] *= np.eye(3)  # a channel depends on its own albedo alone
    by_light = [rng.random((rows, cells)).astype(np.float32) * own.used[:, None] for _ in range(3)]
    wrong = rng.normal(0, 1, (rows, 3)) * own.used[:, None]
    values = own.mean + rng.normal(0, 0.1, (count, 7)).astype(np.float32)
    lost, slope = light_solve._schur_terms(own, values, by_texel, by_light, wrong)
    told = np.flatnonzero(own.observed.seen >= recover_prior.LEAST_SEEN)
    expected, pulled = np.zeros((3 * cells, 3 * cells)), np.zeros(3 * cells)
    prior = np.diag(np.array(light_solve.SPREAD) ** -2.0)
    for texel in told:
        mine = own.owner == texel
        j = by_texel[mine].reshape(-1, 7).astype(float)
        g = np.zeros((mine.sum(), 3, 3 * cells))
        for c in range(3):
            g[:, c, c * cells : (c + 1) * cells] = by_light[c][mine]
        g = g.reshape(-1, 3 * cells)
        inverse = np.linalg.inv(j.T @ j + prior)
        pull = j.T @ wrong[mine].ravel() - prior @ (values[texel] - np.array(light_solve.MEAN))
        expected += g.T @ j @ inverse @ j.T @ g
        pulled += g.T @ j @ inverse @ pull
    assert len(told) > 50 and np.abs(lost - expected).max() < 1e-5 * np.abs(expected).max()
    assert np.abs(slope - pulled).max() < 1e-4 * np.abs(pulled).max()


@pytest.mark.parametrize("size", [12, 90])
def test_light_at_least_zero_is_the_optimum_that_scipy_finds(size):
    from scipy.optimize import nnls

    rng = np.random.default_rng(size)
    root = rng.normal(size=(size + 5, size)) * np.exp(rng.normal(size=size))
    matrix, rhs = root.T @ root, 3 * rng.normal(size=size)
    level = light_solve.LEAST_CURVATURE * np.trace(matrix) / size
    factor = np.linalg.cholesky(matrix + level * np.eye(size))
    expected = nnls(factor.T, np.linalg.solve(factor, rhs))[0]
    assert 0 < (expected > 0).sum() < size
    for near in (np.zeros((size // 3, 3)), rng.random((size // 3, 3))):
        found = light_solve._least_squares(matrix.copy(), rhs, near)[0].T.ravel()
        np.testing.assert_allclose(found, expected, atol=1e-6 * expected.max())


def test_shares_add_up_to_the_prediction(mesh, captures):
    from mistyle.solver.texels.light_transport import light_transport_matrix

    own = bundled(mesh, captures)
    rng = np.random.default_rng(1)
    radiance = rng.random((len(own.cells.angle), 3))
    values = own.mean
    values[:, :3], values[:, 5] = rng.random((len(values), 3)), rng.uniform(0.2, 0.9, len(values))
    light_solve._relight(own, radiance)
    linear, constant = light_transport_matrix(own.problem, values, len(own.owner), len(own.cells.angle))
    energy = radiance * own.cells.angle[:, None]
    expected = values[own.owner, :3] * (linear @ energy) + constant @ energy
    np.testing.assert_allclose(own.problem.predict(values), expected, rtol=2e-4, atol=1e-5)


def test_small_pictures_are_means_over_what_counts(captures):
    rgb, mask = captures.load(0)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(unknown_light, "SIDE", 48)
        camera, small, counts = unknown_light._downsampled(captures, 0)
    assert camera.size == (48, 48) and counts.any() and not counts.all()
    means = resize(np.where(mask[..., None], rgb, 0), (48, 48))
    assert np.abs(small - means)[counts].max() < 0.05 * max(float(rgb.max()), 1)
