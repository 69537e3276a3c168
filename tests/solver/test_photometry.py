"""Photometry of pictures: what was done to them is found, from pictures of a textured shape with soft highlights."""

import json
from dataclasses import replace

import numpy as np
import pytest

from benchmarks.material_recovery import pictures as drawing
from mistyle.core.camera import pixel_centres
from mistyle.core.capture import Captures, in_memory
from mistyle.core.errors import InputRefused
from mistyle.core.image import linear_from_srgb, srgb_from_linear
from mistyle.core.light import Environment
from mistyle.core.maps import flat_maps
from mistyle.fitting.pipeline.photometry import summary
from mistyle.fitting.report.photometry import _fall
from mistyle.io.read_mesh import read_mesh
from mistyle.io.store.records import load_record, save_record
from mistyle.render.deferred.material_table import pack
from mistyle.render.deferred.renderer import MaterialRenderer, RenderOptions
from mistyle.render.mitsuba.draw import tracer
from mistyle.solver.photometry import solve as photometry
from mistyle.solver.photometry.ignored import ignored_cells
from mistyle.solver.photometry.record import (
    EVERYWHERE,
    as_json,
    at_size,
    coordinates,
    corrected,
    fall_terms,
    reach_of,
    response,
    unchanged,
    with_gains,
)
from mistyle.solver.photometry.solve import PointSamples, Response, _with_exif, solve_photometry
from tests.support.helpers import ROOT

SIDE, VIEWS, TEXELS = 112, 24, 64
LEVELS, OBSERVATIONS, ATLAS = 8_000, 80_000, 200  # of usually 40,000, 200,000 and 320


@pytest.fixture(scope="module", autouse=True)
def few():
    """The solver's time is proportional to its observations."""
    with pytest.MonkeyPatch.context() as patch:
        for name in ("LEVELS", "OBSERVATIONS", "ATLAS"):
            patch.setattr(photometry, name, globals()[name])
        yield


FALL = np.array([-0.25, -0.1, np.log(0.7) + 0.35])


@pytest.fixture(scope="module")
def scene():
    """A tracer, cameras, and linear pictures of a mesh with a textured, slightly glossy material."""
    mesh = read_mesh(ROOT / "scenes" / "demo.obj").mesh
    rng = np.random.default_rng(3)
    maps = [flat_maps(TEXELS, 0.5, roughness=0.6) for _ in mesh.parts]
    for each in maps:
        coarse = rng.uniform(0.15, 0.7, (32, 32, 3)).astype(np.float32)
        each.albedo[...] = np.kron(coarse, np.ones((TEXELS // 32, TEXELS // 32, 1), np.float32))
    rows, columns = np.mgrid[0:32, 0:64]
    sun = 6 * np.exp(-(((rows - 9) / 5.0) ** 2) - ((columns - 40) / 7.0) ** 2)
    sky = Environment((0.5 + sun[..., None] * np.array([1.0, 0.85, 0.6])).astype(np.float32))
    cameras, traced = drawing.fibonacci(VIEWS, SIDE), tracer(mesh)
    blank = in_memory(cameras, [(sky,)] * VIEWS, [np.zeros((SIDE, SIDE, 3), np.float32)] * VIEWS)
    renderer = MaterialRenderer(traced, blank, [(TEXELS, TEXELS)] * len(maps), RenderOptions(subsamples=4, memory=0))
    pictures = [renderer.image_and_coverage(pack(maps), k) for k in range(VIEWS)]
    level = 0.3 / np.quantile(np.concatenate([p[c > 0.99] for p, c in pictures]), 0.9)
    return traced, cameras, [(level * p, c > 0.999) for p, c in pictures]


def photographed(scene, gain: np.ndarray, fall: np.ndarray, veil: np.ndarray | None = None) -> Captures:
    """8-bit pictures with these log gains and fall-off, and additive light per picture."""
    _, cameras, pictures = scene
    result, masks = [], []
    for k, (picture, mask) in enumerate(pictures):
        radiance = picture if veil is None else picture + veil[k]
        x = coordinates(cameras[k], pixel_centres(cameras[k].size))
        taken = radiance * np.exp(gain[k] + (fall_terms(x) @ fall)[..., None])
        bits = np.round(255 * srgb_from_linear(np.clip(taken, 0, 1).astype(np.float32)))
        result.append(linear_from_srgb((bits / 255).astype(np.float32)))
        masks.append(mask & (bits < 255).all(axis=-1))
    return in_memory(cameras, [()] * len(cameras), result, masks)


def gains(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Exposures of ±1 EV with mean 0, and balances of ±10 % in the gauge."""
    rng = np.random.default_rng(seed)
    exposure = rng.uniform(-1, 1, VIEWS) * np.log(2)
    balance = rng.uniform(np.log(0.9), np.log(1.1), (VIEWS, 3))
    balance -= balance.mean(axis=1, keepdims=True)
    return exposure - exposure.mean(), balance - balance.mean(axis=0)


@pytest.fixture(scope="module")
def found(scene):
    exposure, balance = gains(1)
    captures = photographed(scene, exposure[:, None] + balance, FALL)
    return captures, solve_photometry(scene[0], captures)


def test_exposure_white_balance_and_vignetting_are_found_within_two_percent(found):
    """Root mean square of the exposures: sheen under a light from one side shifts single ones by up to 3 %."""
    _, solved = found
    exposure, balance = gains(1)
    assert np.sqrt(np.mean(np.expm1(solved.exposure - exposure) ** 2)) < 0.02
    assert np.abs(np.expm1(solved.balance - balance)).max() < 0.02
    seen = np.linspace(0, 0.4, 5)[:, None] * np.array([[1.0, 0.0]])  # the object does not reach the corners
    assert np.abs(np.expm1(fall_terms(seen) @ (solved.vignetting - FALL))).max() < 0.02
    assert solved.applied and not np.abs(solved.veil).max()
    assert solved.spread[1] < 0.2 * solved.spread[0]


def test_the_fall_off_is_reported_as_far_as_it_is_seen(scene):
    """The object covers the middle third of all pictures; the polynomial beyond would make 24 % of the corners 52 %."""
    traced, cameras, pictures = scene
    wide = [replace(c, size=(2 * SIDE, 2 * SIDE), centre=tuple(np.array(c.centre) + SIDE / 2)) for c in cameras]
    padded = [(np.pad(p, ((SIDE // 2,) * 2, (SIDE // 2,) * 2, (0, 0))), np.pad(m, SIDE // 2)) for p, m in pictures]
    (exposure, balance), fall = gains(1), 4 * FALL
    solved = solve_photometry(traced, photographed((traced, wide, padded), exposure[:, None] + balance, fall))
    radius, log_edge = solved.gains.edge
    at = [coordinates(c, pixel_centres(c.size))[mask] for c, (_, mask) in zip(wide, padded, strict=True)]
    r = np.hypot(*np.concatenate(at).T)
    assert radius == solved.reach < 0.35 and 0 < (r > radius).mean() < 0.005
    assert np.exp(log_edge) == pytest.approx(np.exp(fall_terms(np.array([radius, 0.0])) @ fall), abs=0.04)
    ends = np.array([[radius, 0.0], [0.0, 0.7], [0.8, 0.6], [1.0, 1.0]])
    assert np.allclose(response(solved, 0, ends)[0], response(solved, 0, ends[0])[0])
    (sentence,) = summary(solved, 0)
    assert f"{100 * np.exp(log_edge):.0f} % of the centre's light at {100 * radius:.0f} % of the half" in sentence
    assert "corners" not in sentence and len(_fall(solved)) == int(20 * radius) + 1
    assert as_json(solved)["edge"] == {"radius": round(radius, 3), "transmission": round(float(np.exp(log_edge)), 4)}


def test_pictures_that_are_covered_show_the_corners(scene):
    camera = scene[1][0]
    x = coordinates(camera, pixel_centres(camera.size)).reshape(-1, 2)
    assert reach_of(x) == EVERYWHERE and reach_of(x[:0]) == 0
    assert reach_of(np.concatenate([x[np.hypot(*x.T) < 0.3], x[-20:]])) < 0.3  # a few stray observations
    none = unchanged(Captures(tuple(scene[1]), ((),) * VIEWS, lambda k: scene[2][k]), ())
    covered = with_gains(none, replace(none.gains, vignetting=FALL), (0.3, 0.1))
    assert (response(covered, 0, x)[0] == np.exp(fall_terms(x) @ FALL)[:, None]).all()
    assert "corners at 70 % of the centre" in summary(covered, 0)[0] and len(_fall(covered)) == 21


def test_a_record_without_the_reach_is_not_taken_over(tmp_path):
    """Nor does a fit look at it: the stage's key holds the program."""
    one = unchanged(Captures((), (), lambda k: None), ())  # type: ignore[arg-type]
    save_record(tmp_path, one)
    assert load_record(tmp_path).reach == EVERYWHERE
    tree = json.loads((tmp_path / "record.json").read_text())
    del tree["fields"]["reach"]
    (tmp_path / "record.json").write_text(json.dumps(tree))
    with pytest.raises(InputRefused, match="reach"):
        load_record(tmp_path)


def test_the_gauge_is_mean_exposure_zero_and_neutral_balance(found):
    _, solved = found
    assert solved.exposure.mean() == pytest.approx(0, abs=1e-9)
    assert np.abs(solved.balance.mean(axis=0)).max() < 1e-9 and np.abs(solved.balance.mean(axis=1)).max() < 1e-9


def test_corrected_pictures_equal_clean_ones(scene, found):
    captures, solved = found
    clean = photographed(scene, np.zeros((VIEWS, 3)), np.zeros(3))
    ratios = []
    for k in range(VIEWS):
        (mine, valid), (true, also) = corrected(captures, solved).load(k), clean.load(k)
        both = valid & also & (true.min(axis=-1) > 0.05)
        ratios.append(np.log(mine[both] / true[both]))
    assert np.median(np.abs(np.concatenate(ratios))) < 0.03


def test_pictures_that_agree_are_left_as_they_are(scene):
    captures = photographed(scene, np.zeros((VIEWS, 3)), np.zeros(3))
    solved = solve_photometry(scene[0], captures)
    assert not solved.applied and "nothing was corrected" in solved.notes[-1]
    assert (corrected(captures, solved).load(0)[0] == captures.load(0)[0]).all()


def test_contrast_finds_exposures_under_veiling_light(scene):
    exposure, balance = gains(2)
    veil = np.zeros((VIEWS, 1, 1, 1))
    veil[3], veil[8] = 0.12, 0.05
    solved = solve_photometry(scene[0], photographed(scene, exposure[:, None] + balance, np.zeros(3), veil))
    assert np.abs(solved.veil).max() > 0
    assert np.abs(solved.exposure - exposure).max() < 0.06
    assert solved.veil[3, 0].mean() == pytest.approx(0.12, abs=0.03)


def test_reflections_of_a_common_light_are_not_taken_for_exposures(rng):
    """Points of a ball whose bright side reflects more: pictures from that side are not exposed longer."""
    points, each, pictures = 600, 8, 16
    normal, view = (rng.normal(size=(n, 3)) for n in (points, pictures))
    normal, view = (v / np.linalg.norm(v, axis=1, keepdims=True) for v in (normal, view))
    seen = np.argsort(-(normal @ view.T), axis=1)[:, :each]
    point, picture = np.repeat(np.arange(points), each), seen.ravel()
    cosine = (normal[point] * view[picture]).sum(axis=1)
    point, picture, cosine = (a[cosine > 0.4] for a in (point, picture, cosine))
    mirrored = 2 * cosine[:, None] * normal[point] - view[picture]
    slant = 1 - cosine
    albedo = rng.uniform(0.1, 0.5, (points, 3))[point]
    shine = 0.05 * (1 + mirrored[:, :1]) * (1 + 24 * slant[:, None] ** 5)
    exposure = rng.uniform(-0.5, 0.5, pictures)
    exposure -= exposure.mean()
    rgb = (albedo + shine) * np.exp(exposure)[picture, None]
    region = (np.floor(2 * normal[point]) @ [100, 10, 1]).astype(int)
    patch = np.unique(region, return_inverse=True)[1]
    x = np.zeros((len(point), 2))
    samples = PointSamples(rgb, picture, point, patch, patch, slant, view[picture], mirrored, x, pictures, 1)
    found, (before, reflected, after) = photometry._levels(samples, full=True)
    gain = found.gain.mean(axis=1)
    assert np.abs(gain - gain.mean() - exposure).max() < 0.02
    assert after < 0.2 * reflected and after < 0.2 * before


def test_exif_is_a_prior_of_its_own_width():
    """An exposure that the points do not measure is EXIF's; a well measured one stays. The common level is free."""
    unsure = np.full(4, 1e-4)
    unsure[3] = 4.0
    covariance = np.zeros((15, 15))
    covariance[:12, :12] = np.kron(np.diag(unsure), np.ones((3, 3)))
    start = Response(np.repeat(np.array([0.1, -0.2, 0.1, 0.0])[:, None], 3, axis=1), np.zeros(3), covariance)
    stated = np.array([0.1, -0.2, 0.1, 1.5]) + 7
    found = _with_exif(start, stated).gain.mean(axis=1)
    assert np.abs(found[:3] - start.gain[:3, 0]).max() < 0.01
    assert found[3] == pytest.approx(1.5, abs=0.05)
    assert (_with_exif(start, np.array([np.nan, np.nan, np.nan, 1.0])).gain == start.gain).all()


def test_cells_that_other_pictures_show_otherwise_are_ignored():
    rng = np.random.default_rng(0)
    share = rng.random((20000, 2))
    picture = rng.integers(0, 2, 20000)
    behind = (picture == 1) & (share < 0.25).all(axis=1)
    residual = np.where(behind[:, None], 1.5, rng.normal(0, 0.05, (20000, 3)))
    cells = ignored_cells(residual, 0.05, picture, share, ((300, 400), (300, 400)))
    assert not cells[0].any()
    whole = at_size(cells[1], (300, 400))
    assert whole[:70, :95].mean() > 0.97 and not whole[100:, :].any() and not whole[:, 130:].any()
