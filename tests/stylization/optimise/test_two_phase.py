"""The truth of `benchmarks.two_phase`, the lit path of the fit, and what the repair finds of planted contradictions."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.material_recovery.metrics import map_errors, texel_areas
from benchmarks.two_phase import struggle
from benchmarks.two_phase import truth as known
from benchmarks.two_phase.__main__ import light_left
from mistyle.atlas.texels import rasterise
from mistyle.core.asset import Asset, Picture, Source
from mistyle.core.light import Directional, lights
from mistyle.core.maps import flat_maps
from mistyle.core.paths import scenes
from mistyle.render.deferred.material_table import pack
from mistyle.render.deferred.renderer import MaterialRenderer, RenderOptions
from mistyle.render.mitsuba import device
from mistyle.render.mitsuba.draw import tracer
from mistyle.stylization.inpaint.settings import RepairSettings
from mistyle.stylization.optimise import lit_views as fit_lit
from mistyle.stylization.optimise import settings as fit_settings
from mistyle.stylization.optimise import two_phase as stages_fit
from mistyle.stylization.optimise.lit_views import lit_phases
from mistyle.stylization.optimise.settings import FitSettings
from mistyle.stylization.optimise.two_phase import Fit, FitStart, FitTargets, two_phase, view_mask
from mistyle.stylization.pipeline import stylize as pipeline
from mistyle.stylization.pipeline.generative import lights_of_views
from mistyle.stylization.records import Atlas, Baked
from mistyle.stylization.report.summary import MEANINGS
from mistyle.stylization.settings import Settings, resolve
from tests.render.deferred.test_seam import sphere

SIZE, RESOLUTION, SLOPE = 48, 56, 0.2
IDENTITY = np.eye(4, dtype=np.float32)
LIT = FitSettings(painted="with-light", iterations1=8, iterations2=8, crops=2, crop_size=48, refine="all")


@pytest.fixture(scope="module")
def scene():
    """A sphere of known paint, without a painting: its lightness says nothing of the relief."""
    device.use()
    mesh = sphere()
    texels, rng = rasterise(mesh, 0, SIZE), np.random.default_rng(3)
    x, y, z = np.moveaxis(texels.position, -1, 0)
    tone = 0.3 + 0.2 * np.sin(5 * x + 2 * z)[..., None] * np.cos(4 * y)[..., None] * np.array([1.0, 0.8, 0.5])
    flat = replace(flat_maps(SIZE), albedo=tone.astype(np.float32))
    asset = Asset("sphere", mesh, (), Source(Path("sphere.obj"), "obj", (), mesh.positions, IDENTITY, None, "new", ()))
    side = float(np.sqrt(4 * np.pi / texels.covered.sum()))
    guess = rng.normal(size=(int(texels.covered.sum()), 3)).astype(np.float32) * 1e-6
    truth = known.true_maps(asset, texels, flat, guess, side, SLOPE, np.random.default_rng(5))
    parts = (flat,), (flat,), (texel_areas(mesh, texels),)
    return known.Painted(asset, Atlas((texels,), (flat,)), (truth,), *parts)


def views_of(scene, light, count=16, spp=16):
    return known.lit_views(scene, scene.truth, known.cameras_of(RESOLUTION, count), light, spp)


def inside(scene):
    """Weights without the poles, where the sphere's texels crowd."""
    texels = scene.atlas.texels[0]
    return [scene.areas[0] * (texels.covered & (np.abs(texels.normal[..., 1]) < 0.8))]


def test_the_true_relief_has_its_slope_and_the_paint_is_wet_or_dry(scene):
    truth, (weight,) = scene.truth[0], inside(scene)
    slope = np.linalg.norm(truth.normal[..., :2], axis=-1) / truth.normal[..., 2]
    assert np.isclose(np.sqrt(np.average(slope**2, weights=weight)), SLOPE, rtol=0.15)
    rough = truth.roughness[weight > 0]
    assert rough.min() >= known.WET - 0.01 and rough.max() <= known.DRY + 0.01
    assert (np.abs(rough - known.WET) < 0.1).mean() > 0.1 and (np.abs(rough - known.DRY) < 0.1).mean() > 0.1


@pytest.mark.parametrize("name", ["phase1", "paper"])
def test_the_true_maps_redraw_the_views_and_flat_ones_do_not(scene, name):
    """By the fit's own renderer, which shares no code with Mitsuba's `path`; a sphere has no light between surfaces."""
    from mistyle.core.capture import in_memory

    light, texels = lights(name), scene.atlas.texels[0]
    views = views_of(scene, light, count=2, spp=64)
    captures = in_memory([v.camera for v in views], [light] * 2, [v.rgb for v in views], [view_mask(v) for v in views])
    options = RenderOptions(subsamples=9, gradients=False)
    renderer = MaterialRenderer(tracer(scene.asset.mesh), captures, [texels.covered.shape], options)

    def wrong(maps):
        table = pack(maps)
        pairs = [(v.rgb, renderer.image(table, k), view_mask(v)) for k, v in enumerate(views)]
        return float(np.mean([np.abs(a - b)[m].mean() / a[m].mean() for a, b, m in pairs]))

    assert wrong(scene.truth) < 0.03
    assert wrong(scene.flat) > 3 * wrong(scene.truth)


def test_lit_views_tell_relief_gloss_and_paint(scene, monkeypatch):
    """From the baked views, flat and half rough; the paper's own phases, from the same, stay where they were. With few
    steps, and no estimate of light between surfaces, of which a sphere has none."""
    for name, value in {"ITERATIONS": 32, "BOUNCES": 0}.items():
        monkeypatch.setattr(fit_settings, name, value)
    light, mesh, texels = lights("phase1"), scene.asset.mesh, scene.atlas.texels
    views = views_of(scene, light)
    baked = known.baked(scene, views)
    fit = lit_phases(mesh, baked, views, texels, light, LIT, 0)
    paper = two_phase(mesh, FitStart(baked), FitTargets(views), texels, LIT.model_copy(update={"judge": False}), 0)
    weight = inside(scene)
    before, after, adam = (map_errors(scene.truth, maps, weight) for maps in (baked, fit.maps, paper.maps))
    assert {name.rpartition(".")[2] for name in fit.figures} <= set(MEANINGS)
    assert fit.kept["phase1"] and fit.figures["phase1.residual"][1] < 0.5 * fit.figures["phase1.residual"][0]
    assert after.normal_mean_deg < 0.5 * before.normal_mean_deg < adam.normal_mean_deg
    assert after.roughness_mse < 0.25 * before.roughness_mse
    assert light_left(weight, scene.truth, baked, fit.maps)[0] < 0.2
    assert light_left(weight, scene.truth, baked, baked) == (pytest.approx(1), pytest.approx(1))


def test_planted_places_are_where_views_contradict(scene):
    views = known.unlit_views(scene, known.cameras_of(RESOLUTION, 16))
    planted, texels = struggle.plant(scene, views, 0), scene.atlas.texels[0]
    changed = [not np.array_equal(a.rgb, b.rgb) for a, b in zip(planted.views, views, strict=True)]
    assert any(changed) and not all(changed)
    one, other = (known.baked(scene, planted.views[k::2])[0] for k in (0, 1))
    apart = np.abs(one.albedo - other.albedo).max(axis=-1)
    at = planted.where[0]
    assert 0.01 < at.sum() / texels.covered.sum() < 0.5
    assert np.mean(apart[at] > 0.05) > 3 * np.mean(apart[texels.covered & ~at] > 0.05)


def test_precision_and_recall_are_those_of_a_known_mask(scene):
    views = known.unlit_views(scene, known.cameras_of(RESOLUTION, 16))
    planted, (texels,) = struggle.plant(scene, views, 0), scene.atlas.texels
    looks, nothing = texels.covered.astype(np.float32), np.zeros(texels.covered.shape, np.float32)
    seen = [np.where(texels.covered, 3, 0).astype(np.int32)]
    exact = RepairSettings(smooth=0, dilation=0)

    def figures(where):
        made = Fit(scene.flat, (10 * where.astype(np.float32) + looks,), (looks,), {}, {}, {}, (), (nothing,))
        return struggle.precision_and_recall(struggle.found(scene, made, seen, planted, exact))

    at = planted.where[0]
    assert figures(at) == {"precision": pytest.approx(1), "recall": pytest.approx(1)}
    assert figures(np.roll(at, len(at) // 2, axis=1))["recall"] < 0.5


def test_the_light_of_the_views_is_known_or_not(tmp_path):
    assert lights_of_views(Settings()) == lights("paper")
    ours = Settings.model_validate({"draw": {"scene": scenes() / "phase1_directional.xml"}})
    assert all(isinstance(light, Directional) for light in lights_of_views(ours) or (None,))
    other = Settings.model_validate({"draw": {"scene": tmp_path / "phase1_directional.xml"}})
    assert lights_of_views(other) is None
    assert not resolve("paper", None, {}).fit.solve and Settings().fit.solve


@pytest.mark.parametrize(("more", "asked"), [({}, True), ({"solve": False}, False), ({"painted": "auto"}, False)])
def test_a_job_solves_lit_views_under_their_light(scene, monkeypatch, more, asked):
    """The views' own, of the paper's scene; not where the preset `paper` says so, nor where views show no light."""
    called: list[str] = []
    monkeypatch.setattr(fit_lit, "lit_phases", lambda *a, **k: called.append("solve") or a[4])
    monkeypatch.setattr(stages_fit, "two_phase", lambda *a, **k: called.append("adam") or None)
    settings = Settings.model_validate({"fit": {"painted": "with-light", "refine": "all"} | more})
    style = Picture(np.zeros((4, 4, 3), np.float32), None, Path("style.png"))
    baked = Baked(scene.flat, tuple(np.ones(t.covered.shape, np.int32) for t in scene.atlas.texels))
    made = pipeline.fit(scene.asset, style, scene.atlas, baked, [], settings, known.silent)
    assert called == (["solve"] if asked else ["adam"])
    assert made == (lights("paper") if asked else None)
