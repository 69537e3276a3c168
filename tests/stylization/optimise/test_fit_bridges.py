"""The fit by either bridge between torch and Dr.Jit, under either way of lighting, and with the real VGG-19."""

from dataclasses import replace

import numpy as np
import pytest

from mistyle.atlas.texels import rasterise
from mistyle.core.camera import rig
from mistyle.core.image import gaussian, srgb_from_linear
from mistyle.core.light import Directional
from mistyle.core.maps import flat_maps
from mistyle.core.settings import RigSettings
from mistyle.core.view import View
from mistyle.render.mitsuba import device, draw
from mistyle.stylization.optimise import phase as fit_run
from mistyle.stylization.optimise import table as fit_table
from mistyle.stylization.optimise import two_phase as fitting
from mistyle.stylization.optimise.two_phase import FitStart, FitTargets, two_phase
from mistyle.stylization.settings import PRESETS
from tests.render.deferred.test_seam import sphere
from tests.stylization.optimise.test_fit import QUICK, RESOLUTION, SIZE, correlation, painting
from tests.support.helpers import data, recordings

VGG = "weights/vgg19_normalised_relu3_1.pth"


@pytest.fixture(scope="module")
def scene():
    device.use()
    mesh = sphere(24, 12)
    texels = rasterise(mesh, 0, SIZE)
    maps = replace(flat_maps(SIZE), albedo=painting(texels.position))
    traced, views = draw.tracer(mesh), []
    for camera in rig(RigSettings(resolution=RESOLUTION)):
        hits = draw.gbuffer(traced, camera)
        rgb = painting(hits.position) * hits.mask[..., None]
        inside = hits.mask.astype(np.float32)
        views.append(View(camera, rgb, hits.depth, hits.normal, hits.uv, hits.part, hits.mask, inside))
    return mesh, maps, texels, views


def phases(scene, settings):
    """Both phases of a fit, ready to step on one table."""
    mesh, maps, texels, views = scene
    scene, table = fitting._scene(mesh, views, settings), fit_table.build([maps], [texels], 1)
    for phase in fitting._phases(settings, fitting.FitTargets(views)):
        yield fit_run.PhaseRunner(scene, table, phase, settings, np.random.default_rng(3))


@pytest.mark.parametrize("painted", ["without-light", "with-light"])
def test_both_bridges_give_the_same_losses_and_gradients(scene, painted):
    ways = [QUICK.model_copy(update={"bridge": bridge, "painted": painted}) for bridge in ("frozen", "wrap")]
    for ours, theirs in zip(*(phases(scene, settings) for settings in ways), strict=True):
        found = []
        for run in (ours, theirs):
            rng = np.random.default_rng(5)
            for name, values in run.table.values.items():
                run.table.values[name] = fit_table.project(name, values + rng.normal(0, 0.05, values.shape)).astype(
                    "f4"
                )
            crops = run._crops()
            found.append((*run._gradients(crops), run.trace))
        assert np.array_equal(found[0][0], found[1][0])
        for name, values in found[1][4].items():
            assert found[0][4][name] == pytest.approx(values, rel=1e-5), name
        for name, gradient in found[1][1].items():
            assert np.abs(gradient).max() > 0
            # Sums in float32, in different orders.
            assert np.linalg.norm(found[0][1][name] - gradient) < 1e-4 * np.linalg.norm(gradient), name


def test_frozen_functions_are_recorded_once_per_phase(scene):
    for run in phases(scene, QUICK):
        counts = []
        for k in range(6):
            assert run.step(k) == ""
            counts.append(recordings(run.shader._bridge))
        assert counts[2] == counts[-1]


@pytest.mark.parametrize("choice", ["together", "one-per-view"])
def test_a_relief_is_found_under_either_way_of_lighting(scene, choice):
    mesh, maps, texels, views = scene
    settings = QUICK.model_copy(update={"refine": "normal-roughness", "iterations1": 20, "lights": choice})
    made = two_phase(mesh, FitStart([maps]), FitTargets(views), [texels], settings, 0).maps[0]
    seen = texels.covered & (np.abs(texels.normal[..., 1]) < 0.8)
    down, across = np.gradient(gaussian(srgb_from_linear(maps.albedo).mean(axis=-1), 1.0))
    assert correlation(made.normal[..., 0], -across, seen) > 0.3
    assert correlation(made.normal[..., 1], down, seen) > 0.3


@pytest.mark.parametrize("kind", ["gram", "mean-std", "swd"])
def test_statistics_may_join_both_phases(scene, kind):
    settings = QUICK.model_copy(update={"statistic": kind, "statistics": 0.01, "statistics2": 0.01})
    for run in phases(scene, settings):
        assert run.step(0) == ""
        assert run.trace["statistics"][0] > 0


def test_all_lights_together_shade_like_one_from_their_mean_direction(rng):
    camera = rig(RigSettings(resolution=16))[5]
    beams = [
        Directional(tuple(v / np.linalg.norm(v)), (s, s, s), "camera")
        for v, s in zip(rng.normal(size=(3, 3)) * 0.4 - [0, 0, 1], (2.0, 1.0, 0.5), strict=True)
    ]
    normal = -camera.world_from_cam[:3, 2]
    towards = [fit_run._mean_direction([beam], camera) for beam in beams]
    summed = sum(s * (d @ normal) for d, s in zip(towards, (2.0, 1.0, 0.5), strict=True))
    strength = np.linalg.norm(sum(s * d for d, s in zip(towards, (2.0, 1.0, 0.5), strict=True)))
    assert fit_run._mean_direction(beams, camera) @ normal * strength == pytest.approx(summed, rel=1e-5)


def test_the_papers_preset_lights_all_together():
    assert PRESETS["fine"]["fit"]["lights"] == PRESETS["paper"]["fit"]["lights"] == "together"


def test_both_phases_run_with_the_real_vgg(scene):
    mesh, maps, texels, views = scene
    weights = data(VGG)
    grey = replace(maps, albedo=np.full_like(maps.albedo, 0.3))
    settings = QUICK.model_copy(update={"features": weights, "iterations1": 4, "iterations2": 24, "rate_albedo": 0.05})
    fit = two_phase(mesh, FitStart([grey]), FitTargets(views), [texels], settings, 0)
    assert not fit.notes and fit.kept == {"phase1": True, "phase2": True}
    assert all(np.isfinite(values).all() for values in fit.trace.values())
    made, seen = fit.maps[0], texels.covered & (np.abs(texels.normal[..., 1]) < 0.8)
    assert np.abs(made.normal - grey.normal)[seen].max() > 0.01
    assert np.mean(fit.trace["phase2.style"][-3:]) < 0.8 * np.mean(fit.trace["phase2.style"][:3])
    before, after = (np.abs(m.albedo - maps.albedo)[seen].mean() for m in (grey, made))
    assert after < 0.9 * before


def test_a_whole_job_with_the_real_vgg(tmp_path):
    """Mesh and picture in, textures out, at the smallest size."""
    import cv2

    import mistyle
    from mistyle.core.paths import PACKAGE

    style = tmp_path / "style.png"
    cv2.imwrite(str(style), cv2.resize(cv2.imread(str(data("styles/great_wave.jpg"))), (160, 96)))
    mesh = PACKAGE.parent / "scenes" / "demo.obj"
    small = {
        "rig": {"kind": "turntable", "views": 4, "resolution": 64},
        "draw": {"spp": 1},
        "surface": {"samples": 1000},
        "atlas": {"size": 128},
        "fit": {"features": str(data(VGG)), "iterations1": 3, "iterations2": 3, "crops": 1, "crop_size": 48},
        "report": {"detail": "none"},
    }
    summary = mistyle.stylize(mesh, style, tmp_path / "out", preset="draft", name="bell", **small)
    assert {"phase1.style", "phase2.style"} <= set(summary["figures"])
    assert list((tmp_path / "out" / "asset").glob("*.glb"))
