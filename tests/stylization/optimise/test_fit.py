"""The fit on small scenes whose answer is known, and the parts it is made of."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from mistyle.atlas.texels import rasterise
from mistyle.core.camera import rig
from mistyle.core.image import gaussian, linear_from_srgb, srgb_from_linear
from mistyle.core.light import Directional
from mistyle.core.maps import Maps, Texels, flat_maps
from mistyle.core.settings import RigSettings
from mistyle.core.view import View
from mistyle.render.deferred import integrator as deferred
from mistyle.render.deferred import torch_bridge
from mistyle.render.mitsuba import device, draw
from mistyle.stylization.optimise import judge as fit_judge
from mistyle.stylization.optimise import table as fit_table
from mistyle.stylization.optimise.settings import FitSettings
from mistyle.stylization.optimise.two_phase import FitStart, FitTargets, shrinkage, two_phase
from tests.render.deferred.test_seam import sphere

MAPS = ("albedo", "normal", "roughness", "metallic")

SIZE, RESOLUTION = 128, 112
QUICK = FitSettings(
    iterations1=40, iterations2=40, crops=2, crop_size=64, crop_scale=(0.75, 1.2), radius=6.0, judge=False, refine="all"
)


def painting(points):
    """Crossing waves on the surface, linear rgb: strokes that no view's light explains."""
    x, y, z = np.moveaxis(points, -1, 0)
    waves = np.sin(26 * x + 3 * np.sin(4 * y)) * np.cos(21 * y + 7 * z)
    strokes = (0.5 + 0.3 * np.tanh(2 * waves))[..., None] * np.array([1.0, 0.8, 0.5]) + np.array([0.0, 0.05, 0.15])
    return linear_from_srgb(strokes).astype(np.float32)


@pytest.fixture(scope="module")
def scene():
    """A painted sphere: mesh, baked maps, texels, and what its cameras see without any light."""
    device.use()
    mesh = sphere()
    texels = rasterise(mesh, 0, SIZE)
    maps = replace(flat_maps(SIZE), albedo=painting(texels.position))
    traced = draw.tracer(mesh)
    views = []
    for camera in rig(RigSettings(resolution=RESOLUTION)):
        hits = draw.gbuffer(traced, camera)
        rgb = painting(hits.position) * hits.mask[..., None]
        views.append(
            View(camera, rgb, hits.depth, hits.normal, hits.uv, hits.part, hits.mask, hits.mask.astype(np.float32))
        )
    return mesh, maps, texels, views


@pytest.fixture(scope="module")
def relief(scene):
    """Phase 1 alone, on the painted sphere."""
    mesh, maps, texels, views = scene
    return two_phase(
        mesh, FitStart([maps]), FitTargets(views), [texels], QUICK.model_copy(update={"refine": "normal-roughness"}), 0
    )


def clay(scene, maps: Maps, direction) -> np.ndarray:
    """Luminance of the object as clay under one camera-fixed light, from the first camera of the rig."""
    mesh, _, _, views = scene
    traced, camera = draw.tracer(mesh), views[0].camera
    surface = deferred.trace(traced, [camera])
    vector = np.array(direction) / np.linalg.norm(direction)
    lit = deferred.light(
        traced, surface, (Directional(tuple(vector.tolist()), (2.0, 2.0, 2.0), "camera"),), shadows=False
    )
    where = torch_bridge.taps(surface, [maps.roughness.shape])
    tables = {"albedo": np.full((SIZE * SIZE, 3), 0.25, np.float32), "normal": maps.normal.reshape(-1, 3)}
    tables |= {"roughness": maps.roughness.reshape(-1, 1), "metallic": maps.metallic.reshape(-1, 1)}
    pixels = torch.from_numpy(torch_bridge.bilinear(np.concatenate(list(tables.values()), axis=1), where))
    return torch_bridge.Shader(camera.size)(lit, pixels).numpy()[..., 0]


def relief_shading(scene, maps, direction):
    """What the normal map adds to the shading of the smooth object, relative to it; matt, for highlights hide it."""
    matt = replace(maps, roughness=np.ones_like(maps.roughness))
    plain = clay(scene, flat_maps(SIZE, roughness=1.0), direction)
    return np.where(plain > 0.02, clay(scene, matt, direction) / np.maximum(plain, 0.02) - 1, 0)


def correlation(a, b, where):
    return float(np.corrcoef(a[where], b[where])[0, 1])


def inner(scene, facing_at_least=0.6):
    _, _, _, views = scene
    facing = -(views[0].normal @ views[0].camera.world_from_cam[:3, 2])
    return views[0].mask & (facing > facing_at_least)


def test_phase_1_finds_a_relief_that_follows_the_strokes(scene, relief):
    _, maps, texels, _ = scene
    made = relief.maps[0]
    seen = texels.covered & (np.abs(texels.normal[..., 1]) < 0.8)
    tilt = np.linalg.norm(made.normal[..., :2], axis=-1)
    assert tilt[seen].mean() > 0.05 and made.roughness[seen].std() > 0.01
    np.testing.assert_allclose(np.linalg.norm(made.normal, axis=-1), 1, atol=1e-5)
    assert tilt.max() <= fit_table.TILT_LIMIT + 1e-5 and made.roughness.min() >= fit_table.ROUGHNESS_FLOOR
    # The strokes' brightness stands proud, so the normal leans down its slope: along -d/du and, rows running against
    # v, along +d/row. On the sphere u is stretched by the latitude, which changes lengths but not signs.
    height = gaussian(srgb_from_linear(maps.albedo).mean(axis=-1), 1.0)
    down, across = np.gradient(height)
    assert correlation(made.normal[..., 0], -across, seen) > 0.5
    assert correlation(made.normal[..., 1], down, seen) > 0.5
    strokes = height - gaussian(height, 8)
    assert abs(correlation(gaussian(made.roughness, 1), strokes, seen)) > 0.15
    assert np.array_equal(made.albedo, maps.albedo)


def test_moving_the_key_light_from_left_to_right_flips_the_relief(scene, relief):
    """What stands out is lit on the side of the light; a pattern of brightness or gloss would not turn around."""
    left, right = (relief_shading(scene, relief.maps[0], (side, 0.0, -0.8)) for side in (-0.8, 0.8))
    where = inner(scene, 0.9)
    assert left[where].std() > 0.03
    assert correlation(left, right, where) < -0.5


def test_an_aligned_loss_would_cancel_the_light_and_ours_does_not(scene, relief):
    """On targets painted without light. Shading of the whole object is what a blur over a stroke's length leaves."""
    mesh, maps, texels, views = scene
    key = (Directional((-0.6, -0.5, -0.62), (3.0, 3.0, 3.0), "camera"),)
    grey = replace(maps, albedo=np.full_like(maps.albedo, 0.25))
    flat = [replace(v, rgb=np.repeat(v.mask[..., None] * np.float32(0.15), 3, axis=-1)) for v in views]
    settings = QUICK.model_copy(update={"refine": "normal-roughness", "painted": "with-light", "tv_normal": 0.0})
    aligned = two_phase(mesh, FitStart([grey]), FitTargets(flat, lights=key), [texels], settings, 0).maps[0]
    where = inner(scene)

    def shading(made):
        return gaussian(clay(scene, made, key[0].direction), 5)[where].std()

    plain = shading(flat_maps(SIZE))
    assert shading(aligned) < 0.9 * plain
    assert shading(relief.maps[0]) > 0.94 * plain


def test_phase_2_finds_the_colours_of_the_views(scene):
    mesh, maps, texels, views = scene
    grey = replace(maps, albedo=np.full_like(maps.albedo, 0.3))
    settings = QUICK.model_copy(update={"iterations1": 0, "iterations2": 80, "rate_albedo": 0.04})
    fit = two_phase(mesh, FitStart([grey]), FitTargets(views), [texels], settings, 0)
    seen = texels.covered & (np.abs(texels.normal[..., 1]) < 0.8)
    before = np.abs(grey.albedo - maps.albedo)[seen].mean()
    after = np.abs(fit.maps[0].albedo - maps.albedo)[seen].mean()
    assert after < 0.5 * before
    assert fit.maps[0].albedo.min() >= 0 and fit.maps[0].albedo.max() <= 1
    assert fit.trace["phase2.style"][-1] < 0.5 * fit.trace["phase2.style"][0]
    # Only what a view saw has struggled, and the hidden half of a texel's looks is none.
    struggle, touched = fit.struggle[0], fit.touched[0]
    assert (struggle[touched == 0] == 0).all() and (struggle >= 0).all() and struggle.max() > 0
    assert (touched[seen] > 0).mean() > 0.9


def test_same_seed_same_bytes(scene):
    mesh, maps, texels, views = scene
    settings = QUICK.model_copy(update={"iterations1": 3, "iterations2": 3})
    made = [two_phase(mesh, FitStart([maps]), FitTargets(views), [texels], settings, seed) for seed in (1, 1, 2)]
    bytes_of = [b"".join(getattr(fit.maps[0], n).tobytes() for n in MAPS) for fit in made]
    assert bytes_of[0] == bytes_of[1] != bytes_of[2]
    assert made[0].trace == made[1].trace
    assert made[0].struggle[0].tobytes() == made[1].struggle[0].tobytes()


def test_a_gradient_that_is_no_number_stops_at_the_last_good_state(scene):
    mesh, maps, texels, views = scene
    broken = maps.roughness.copy()
    broken[50, 70] = np.nan
    fit = two_phase(mesh, FitStart([replace(maps, roughness=broken)]), FitTargets(views), [texels], QUICK, 0)
    assert len(fit.notes) == 2 and fit.notes[0].startswith("phase1 stopped before step")
    where = fit.notes[0].partition("texel (row ")[2]
    row, column = int(where.split(",")[0]), int(where.partition("column ")[2].split()[0])
    assert (row, column) == (50, 70)
    assert any(view.camera.name in fit.notes[0] for view in views)
    made = fit.maps[0]
    assert np.isfinite(made.albedo).all() and np.isfinite(made.normal).all()
    assert np.isfinite(np.delete(made.roughness.ravel(), 50 * SIZE + 70)).all()


def test_pixels_of_a_target_that_are_no_number_are_left_out(scene):
    mesh, maps, texels, views = scene
    rgb = views[3].rgb.copy()
    rgb[40:70, 40:70] = np.nan
    poisoned = [*views[:3], replace(views[3], rgb=rgb), *views[4:]]
    settings = QUICK.model_copy(update={"iterations1": 8, "iterations2": 8, "judge": True})
    fit = two_phase(mesh, FitStart([maps]), FitTargets(poisoned), [texels], settings, 0)
    assert all(np.isfinite(getattr(fit.maps[0], name)).all() for name in MAPS)
    assert all(np.isfinite(fit.figures[name]).all() for name in fit.figures)


def test_a_phase_that_makes_things_worse_is_undone(scene):
    mesh, maps, texels, views = scene
    wild = {"iterations1": 0, "iterations2": 4, "rate_albedo": 1.0, "judge": True}
    fit = two_phase(mesh, FitStart([maps]), FitTargets(views), [texels], QUICK.model_copy(update=wild), 0)
    assert fit.kept == {"phase2": False}
    assert "phase2 was undone" in fit.notes[0]
    assert np.array_equal(fit.maps[0].albedo, maps.albedo)
    before, after = fit.figures["phase2.detail"]
    assert after < before
    good = QUICK.model_copy(update={"refine": "normal-roughness", "judge": True, "relief": 0.08})
    fit = two_phase(mesh, FitStart([maps]), FitTargets(views), [texels], good, 0)
    assert fit.kept == {"phase1": True} and not fit.notes
    assert not np.array_equal(fit.maps[0].normal, maps.normal)


def test_phase_1_goes_on_from_a_given_relief_and_leaves_it_where_it_is_undone(scene, monkeypatch):
    """A given relief is nearly what one step ends with, its detail finer than the views included; where the phase is
    undone, it is what stays."""
    mesh, maps, texels, views = scene
    only = QUICK.model_copy(update={"refine": "normal-roughness", "iterations1": 1})
    tilt = np.zeros((SIZE, SIZE, 3), np.float32)
    tilt[..., 0], tilt[..., 2] = 0.3, np.sqrt(1 - 0.09)
    raised = replace(maps, normal=tilt, roughness=np.full_like(maps.roughness, 0.4))
    from_flat, from_relief = (
        two_phase(mesh, FitStart([maps], begin=begin), FitTargets(views), [texels], only, 0).maps[0]
        for begin in ((), [raised])
    )
    covered = texels.covered
    assert np.abs(from_flat.normal[covered, 0]).mean() < 0.06
    assert np.abs(from_relief.normal[covered, 0] - 0.3).mean() < 0.06
    assert np.abs(from_relief.roughness[covered] - 0.4).mean() < 0.06
    assert np.array_equal(from_relief.albedo, from_flat.albedo)
    monkeypatch.setattr(fit_judge, "regressed", lambda old, new, times=1.0: ["style"])
    judged = two_phase(
        mesh, FitStart([maps], begin=[raised]), FitTargets(views), [texels], only.model_copy(update={"judge": True}), 0
    )
    assert not judged.kept["phase1"] and judged.maps[0] is raised


def test_detail_of_a_given_relief_that_is_finer_than_the_views_stays(scene):
    """The fit's table has half the atlas's resolution; stripes of one texel must come through it."""
    mesh, maps, texels, views = scene
    stripes = np.zeros((SIZE, SIZE, 3), np.float32)
    stripes[:, ::2, 0] = 0.3
    stripes[..., 2] = np.sqrt(1 - stripes[..., 0] ** 2)
    striped = replace(maps, normal=stripes)
    only = QUICK.model_copy(update={"refine": "normal-roughness", "iterations1": 1, "texels_per_pixel": 0.3})
    assert shrinkage(mesh, [texels], views, 0.3) > 1
    fitted = (
        two_phase(mesh, FitStart([maps], begin=[striped]), FitTargets(views), [texels], only, 0).maps[0].normal[..., 0]
    )
    across = (fitted[:, ::2] - fitted[:, 1::2])[texels.covered[:, ::2] & texels.covered[:, 1::2]]
    assert across.mean() == pytest.approx(0.3, abs=0.02)


@pytest.mark.parametrize(("detail", "steps"), [(0.80, 4), (0.70, 2)])
def test_a_phase_far_beyond_its_tolerance_is_stopped_on_its_way(scene, monkeypatch, detail, steps):
    """0.9 before and 0.80 on the way may still recover (tolerance 0.06, twice that is hopeless); 0.70 may not."""
    mesh, maps, texels, views = scene
    seen = iter([{"detail": value, "style": 1.0, "views": 1.0} for value in (0.9, 0.9, detail, 0.9)])
    monkeypatch.setattr(fit_judge, "FEWEST", 1)
    monkeypatch.setattr(fit_judge, "evaluate", lambda *_, **__: next(seen))
    chosen = QUICK.model_copy(update={"refine": "normal-roughness", "iterations1": 4, "judge": True})
    fit = two_phase(mesh, FitStart([maps]), FitTargets(views), [texels], chosen, 0)
    assert len(fit.trace["phase1.style"]) == steps and fit.kept == {"phase1": steps == 4}
    if steps == 2:
        assert fit.notes == ("phase1 was undone after 2 of 4 steps: detail got worse.",)
        assert fit.maps[0] is maps and fit.figures["phase1.detail"] == (0.9, detail)


def test_refine_off_changes_nothing_and_metallic_zero_only_that(scene):
    mesh, maps, texels, views = scene
    metal = replace(maps, metallic=np.full_like(maps.metallic, 0.4))
    fit = two_phase(mesh, FitStart([metal]), FitTargets(views), [texels], FitSettings(refine="off"), 0)
    assert fit.maps[0] is metal and fit.struggle[0].max() == 0
    fit = two_phase(mesh, FitStart([metal]), FitTargets(views), [texels], FitSettings(refine="off", metallic="zero"), 0)
    assert fit.maps[0].metallic.max() == 0 and fit.maps[0].albedo is metal.albedo


def test_metallic_moves_only_when_asked(scene):
    mesh, maps, texels, views = scene
    metal = replace(maps, metallic=np.full_like(maps.metallic, 0.4))
    for choice in ("keep", "fit"):
        settings = QUICK.model_copy(update={"metallic": choice, "refine": "normal-roughness", "iterations1": 3})
        made = two_phase(mesh, FitStart([metal]), FitTargets(views), [texels], settings, 0).maps[0]
        assert np.array_equal(made.metallic, metal.metallic) == (choice == "keep")


def test_texels_outside_the_given_masks_keep_their_bytes(scene):
    mesh, maps, texels, views = scene
    only = np.zeros((SIZE, SIZE), bool)
    only[40:80, 20:90] = True
    settings = QUICK.model_copy(update={"iterations1": 4, "iterations2": 4})
    made = two_phase(mesh, FitStart([maps], only=[only]), FitTargets(views), [texels], settings, 0).maps[0]
    for name in ("albedo", "normal", "roughness"):
        a, b = getattr(made, name), getattr(maps, name)
        assert a[~only].tobytes() == b[~only].tobytes()
        assert not np.array_equal(a[only], b[only])


def blank_texels(island) -> Texels:
    height, width = island.shape
    zeros = np.zeros((height, width, 3), np.float32)
    return Texels(zeros, zeros, island >= 0, island.astype(np.int32), np.where(island >= 0, 0, -1).astype(np.int32))


def random_maps(rng, size) -> Maps:
    tilt = rng.uniform(-0.4, 0.4, (size, size, 2))
    normal = np.concatenate([tilt, np.sqrt(1 - (tilt**2).sum(-1, keepdims=True))], -1).astype(np.float32)
    return Maps(
        rng.random((size, size, 3)).astype(np.float32),
        normal,
        rng.uniform(0.1, 0.9, (size, size)).astype(np.float32),
        rng.random((size, size)).astype(np.float32),
        np.ones((size, size), bool),
    )


def test_the_table_averages_covered_texels_and_gives_back_what_it_was_given(rng):
    maps, island = random_maps(rng, 16), np.zeros((16, 16), int)
    island[:, 8:] = 1
    island[4, 4] = -1
    table = fit_table.build([maps], [blank_texels(island)], 2)
    assert table.sizes == ((8, 8),)
    block = maps.albedo[4:6, 4:6].reshape(4, 3)[1:]  # without the uncovered texel
    np.testing.assert_allclose(table.values["albedo"].reshape(8, 8, 3)[2, 2], block.mean(axis=0), rtol=1e-5)
    same = fit_table.finished(table, [maps])[0]
    assert all(np.array_equal(getattr(same, name), getattr(maps, name)) for name in MAPS)
    # The islands' common border, between columns 3 and 4 of the table, joins nothing.
    assert not table.right.reshape(8, 8)[:, 3].any() and table.right.reshape(8, 8)[:, [0, 4]].all()
    table.values["albedo"] += 0.1
    lighter = fit_table.finished(table, [maps])[0].albedo
    np.testing.assert_allclose(lighter, np.clip(maps.albedo + 0.1, 0, 1), atol=1e-5)


def test_steps_are_those_of_adam_and_still_texels_stand(rng, monkeypatch):
    monkeypatch.setattr(fit_table, "DAMPING", 0.0)
    maps = random_maps(rng, 4)
    table = fit_table.build([maps], [blank_texels(np.zeros((4, 4), int))], 1)
    leaf = torch.from_numpy(table.values["albedo"] * 0.5 + 0.25).requires_grad_()
    table.values["albedo"] = leaf.detach().numpy().copy()
    theirs = torch.optim.Adam([leaf], lr=0.01, betas=(fit_table.BETA1, fit_table.BETA2), eps=fit_table.EPSILON)
    everywhere = np.arange(16)
    for _ in range(5):
        gradient = rng.normal(size=(16, 3)).astype(np.float32)
        leaf.grad = torch.from_numpy(gradient.copy())
        theirs.step()
        fit_table.step(table, "albedo", everywhere, gradient, 0.01)
    np.testing.assert_allclose(table.values["albedo"], leaf.detach().numpy(), atol=1e-6)
    # A texel without a gradient does not move, although its moments would push it.
    before = table.values["albedo"].copy()
    gradient[7] = 0
    fit_table.step(table, "albedo", everywhere, gradient, 0.01)
    moved = (table.values["albedo"] != before).any(axis=1)
    assert not moved[7] and moved.sum() == 15


def test_texels_with_little_gradient_move_little(rng):
    """Plain Adam would move them all alike."""
    table = fit_table.build([random_maps(rng, 4)], [blank_texels(np.zeros((4, 4), int))], 1)
    table.values["albedo"] = np.full_like(table.values["albedo"], 0.5)
    gradient = np.full((16, 3), 1.0, np.float32)
    gradient[3] = 0.05
    for _ in range(4):
        fit_table.step(table, "albedo", np.arange(16), gradient, 0.01)
    moved = 0.5 - table.values["albedo"][:, 0]
    assert moved[0] == pytest.approx(0.04 / 1.3, rel=0.05)
    assert moved[3] == pytest.approx(0.04 * 0.05 / (0.05 + 0.3), rel=0.1)


def test_variation_by_hand_and_against_finite_differences(rng):
    maps, island = random_maps(rng, 6), np.zeros((6, 6), int)
    island[:, 3:] = 1
    table = fit_table.build([maps], [blank_texels(island)], 1)
    chosen = np.sort(rng.choice(36, 28, replace=False))
    value, gradient = fit_table.variation(table, "albedo", fit_table.pairs(table, chosen))
    grid = table.values["albedo"].reshape(6, 6, 3)
    inside = np.isin(np.arange(36), chosen).reshape(6, 6)
    across, down = inside[:, 1:] & inside[:, :-1], inside[1:] & inside[:-1]
    across[:, 2] = False  # the border between the islands
    by_hand = np.abs(np.diff(grid, axis=1))[across].mean() + np.abs(np.diff(grid, axis=0))[down].mean()
    assert value == pytest.approx(float(by_hand), rel=1e-5)
    step, direction = 1e-4, rng.normal(size=gradient.shape).astype(np.float32)
    ends = []
    for sign in (1, -1):
        moved = replace(table, values=table.values | {"albedo": table.values["albedo"].copy()})
        moved.values["albedo"][chosen] += sign * step * direction
        ends.append(fit_table.variation(moved, "albedo", fit_table.pairs(moved, chosen))[0])
    assert (ends[0] - ends[1]) / (2 * step) == pytest.approx(float((gradient * direction).sum()), rel=0.02, abs=1e-4)


def test_the_fit_works_at_the_resolution_of_the_views(scene):
    mesh, _, texels, views = scene
    coarse = shrinkage(mesh, [texels], views, 1.25)
    assert coarse == 1  # a texel is wider than a pixel here
    finer = rasterise(mesh, 0, 4 * SIZE)
    assert shrinkage(mesh, [finer], views, 1.25) == 2
    assert shrinkage(mesh, [finer], views, 0.7) == 4


def test_the_judge_names_what_got_worse():
    before = {"detail": 0.9, "style": 2.0, "views": 1.0}
    assert fit_judge.regressed(before, before) == []
    assert fit_judge.regressed(before, {"detail": 0.99, "style": 1.0, "views": 0.5}) == []
    assert fit_judge.regressed(before, {"detail": 0.8, "style": 2.0, "views": 1.0}, fit_judge.HOPELESS) == []
    assert fit_judge.checks(40) == (10, 20) and fit_judge.checks(200) == (50, 100) and fit_judge.checks(12) == ()
    assert fit_judge.regressed(before, {"detail": 0.7, "style": 2.5, "views": 1.0}) == ["detail", "style"]


def test_settings_refuse_what_cannot_be():
    for wrong in ({"iterations1": -1}, {"refine": "some"}, {"unknown": 1}, {"crop_size": 3}):
        with pytest.raises(ValueError):
            FitSettings(**wrong)
