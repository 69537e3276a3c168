"""Noise and scenes: losses and gradients without bias, Gauss–Newton on few numbers, and results that are undone."""

import inspect

import numpy as np
import pytest

import mistyle
from mistyle.core.errors import UsageError
from mistyle.render.deferred import pyramid
from mistyle.render.live import parameters as scene_keys
from mistyle.render.mitsuba import device
from mistyle.solver.scene import fit as scene_fit
from mistyle.solver.scene import gauss_newton as scene_newton
from mistyle.solver.scene import gradients as scene_grad
from mistyle.solver.scene import state as scene_job
from tests.solver.test_scene_fit import CAMERAS, COLOUR, TRUE_COLOUR, flat, references, root_diffuse, wall

WHITE, GREEN, RED = (f"{name}.reflectance.value" for name in ("white", "green", "red"))
TRUE = {WHITE: [0.88, 0.7, 0.66], GREEN: [0.11, 0.38, 0.08], RED: [0.57, 0.05, 0.05]}


def box(values, size=20):
    """The Cornell box: light from surface to surface, so that renders are noisy."""
    import mitsuba as mi

    device.use()
    scene = mi.cornell_box()
    scene["sensor"]["film"] |= {"width": size, "height": size, "rfilter": {"type": "box"}}
    scene["integrator"] = {"type": "path", "max_depth": 4}
    for key, value in values.items():
        scene[key.partition(".")[0]]["reflectance"] = {"type": "rgb", "value": list(value)}
    return mi.load_dict(scene, optimize=False)


@pytest.fixture(scope="module")
def picture():
    return references(box(TRUE), spp=4096)


def test_the_weights_do_not_know_the_pixel_or_its_neighbours(rng):
    reference = rng.uniform(0.1, 2, (12, 15, 3))
    used = np.ones((12, 15), bool)
    used[2, 3] = False
    before = scene_grad.relative_weights(reference, used)
    changed = reference.copy()
    changed[6, 7] = 50.0
    after = scene_grad.relative_weights(changed, used)
    assert np.allclose(after[5:8, 6:9], before[5:8, 6:9], rtol=1e-3)  # the median moves by next to nothing
    assert (after[6, 9] < before[6, 9]).all() and (after[3, 4] < before[3, 4]).all()
    changed = reference.copy()
    changed[2, 3] = 1e6  # a masked pixel
    assert np.allclose(scene_grad.relative_weights(changed, used), before)
    inner = reference[3:10, 4:11] ** 2
    wanted = (inner.sum(axis=(0, 1)) - inner[2:5, 2:5].sum(axis=(0, 1))) / 40
    dark = (0.1 * np.median(reference[used])) ** 2
    assert np.allclose(1 / before[6, 7], wanted + dark, rtol=1e-5)


def slope(scene, view, loss, spp, seeds):
    """Gradients along the common scale of the colours at the truth, one a seed."""
    import mitsuba as mi

    chosen = scene_keys.match(scene, list(TRUE))
    table = mi.traverse(scene)
    table.properties = {p.key: table.properties[p.key] for p in chosen}
    values = {k: np.array(v, np.float32) for k, v in TRUE.items()}
    engine, _ = scene_grad.ad_integrator(scene)
    found = []
    for n in seeds:
        live = scene_grad.LiveScene(scene, table, chosen, engine)
        gradient = scene_grad.gradients(live, values, view, loss, (spp, 64), scene_grad.seeds(n))[1]
        found.append(sum(float((gradient[k] * values[k]).sum()) for k in TRUE))
    return np.array(found)


def test_noise_does_not_move_the_minimum_of_the_relative_loss(picture):
    """At the truth the mean gradient is zero at 4 samples a pixel as at 16; that of the log loss is not."""
    scene = box(TRUE)
    view = scene_grad.sight(scene.sensors()[0], picture[0], None, "cam")
    brighter = scene_grad.sight(scene.sensors()[0], 1.05 * picture[0], None, "cam")
    for spp, count in ((4, 40), (16, 16)):
        at = slope(scene, view, scene_grad.loss_of("relative", view), spp, range(count))
        error = at.std(ddof=1) / np.sqrt(len(at))
        # With the same samples, the difference is what 5 % more light make.
        five = slope(scene, brighter, scene_grad.loss_of("relative", brighter), spp, range(6)) - at[:6]
        assert abs(at.mean()) < 3 * error < 0.6 * abs(five.mean())
    at = slope(scene, view, scene_grad.loss_of("log_srgb_l1", view), 4, range(24))
    assert abs(at.mean()) > 6 * at.std(ddof=1) / np.sqrt(len(at))


def test_fair_steps_do_not_drift_under_skewed_noise(rng):
    """Gradients of mean zero, mostly small and negative, seldom large: Adam drifts, a fair step does not."""
    moved = {True: 0.0, False: 0.0}
    noise = np.where(rng.random((2000, 400)) < 0.05, 19.0, -1.0)
    for fair in moved:
        moments = pyramid.start((400,), pyramid=False)
        steps = [pyramid.change(moments, g.astype(np.float32), 1.0, fair=fair) for g in noise]
        moved[fair] = float(np.mean(steps[200:]))
    assert abs(moved[True]) < 0.25 * abs(moved[False])
    assert moved[False] > 0.01


def test_derivatives_equal_finite_differences(picture):
    import mitsuba as mi

    scene = box(TRUE)
    chosen = scene_keys.match(scene, list(TRUE))
    table, engine = mi.traverse(scene), scene_grad.ad_integrator(scene)[0]
    table.properties = {p.key: table.properties[p.key] for p in chosen}
    values = {k: np.array(v, np.float32) for k, v in TRUE.items()}
    direction = {k: np.full(3, n + 1, np.float32) for n, k in enumerate(TRUE)}
    sensor = scene.sensors()[0]
    ours = scene_grad.derivative(scene_grad.LiveScene(scene, table, chosen, engine), values, direction, sensor, 64, 5)
    ends = []
    for step in (0.01, -0.01):
        scene_grad.put(table, chosen, {k: values[k] + np.float32(step) * direction[k] for k in TRUE})
        ends.append(np.array(scene_grad.picture(scene, engine, sensor, 64, 5))[..., :3])
    theirs = (ends[0] - ends[1]) / 0.02
    assert np.allclose(ours.mean(axis=(0, 1)), theirs.mean(axis=(0, 1)), rtol=0.02)
    assert np.corrcoef(ours.ravel(), theirs.ravel())[0, 1] > 0.98


def test_nine_reflectances_are_found_within_their_errors(picture):
    start = box(dict.fromkeys(TRUE, (0.5, 0.5, 0.5)))
    fitted = scene_fit.fit_scene(start, ["white.*", "green.*", "red.*"], None, picture, iterations=64, spp=16)
    for key, true in TRUE.items():
        wrong = np.abs(fitted.values[key] - true)
        assert (wrong < 4 * fitted.errors[key] + 1e-3).all()
        assert (fitted.errors[key] < 0.05 * np.array(true) + 0.002).all()
        assert (fitted.start[key] == 0.5).all()
    residual = fitted.residuals[0]
    assert not fitted.undone and not fitted.unconverged and residual.loss[1] < residual.loss[0] / 50
    assert residual.noise[0] < 0.7 < residual.noise[1] <= 1  # what is left is noise


def test_a_resumed_fit_of_numbers_ends_with_the_same_bytes(picture):
    import drjit as dr

    threads = dr.thread_count()
    dr.set_thread_count(1)
    try:
        saved = []
        given = ([WHITE, RED], None, picture)
        options = {"iterations": 20, "spp": 2}

        def start():
            return box({**TRUE, WHITE: (0.5, 0.5, 0.5)})

        whole = scene_fit.fit_scene(start(), *given, **options)
        scene_fit.fit_scene(start(), *given, **options, save=saved.append, callback=lambda k, *_: k >= 13)
        done = scene_fit.fit_scene(start(), *given, **options, resume=saved[0])
    finally:
        dr.set_thread_count(threads)
    assert int(saved[0]["iteration"]) < 20 and done.trace == whole.trace
    for key in (WHITE, RED):
        assert np.array_equal(done.values[key], whole.values[key])
        assert np.array_equal(done.errors[key], whole.errors[key])


def test_a_step_out_of_a_plugins_domain_is_taken_back():
    """The square root of a colour: the linear step leads far below zero, where the picture is NaN."""
    plugin = root_diffuse()

    def scene(value):
        import mitsuba as mi

        paint = mi.load_dict({"type": "rgb", "value": value})
        return wall({"type": plugin, "paint": paint}, CAMERAS[:2], size=12)

    fitted = scene_fit.fit_scene(
        scene([0.5] * 3), ["*.paint"], None, references(scene([0.4, 0.1, 0.02])), iterations=40
    )
    assert np.allclose(fitted.values["wall.bsdf.paint.value"], [0.4, 0.1, 0.02], rtol=0.02)


def test_a_result_worse_than_its_start_is_undone(picture):
    """A regularizer that pulls away from the truth, where the fit starts."""
    true = {key: np.array(value, np.float32) for key, value in TRUE.items()}
    fitted = scene_fit.fit_scene(
        scene := box(TRUE), [RED], None, picture, iterations=8, rate=0.1, regularizers=[lambda v: 9 * -v[RED][0]]
    )
    assert fitted.undone and any("undone" in note for note in fitted.notes)
    assert np.array_equal(fitted.values[RED], true[RED]) and fitted.residuals[0].loss[0] == fitted.residuals[0].loss[1]
    import mitsuba as mi

    assert np.allclose(np.array(mi.traverse(scene)[RED]).ravel(), true[RED])


def test_bounds_hold_and_the_rest_is_solved_with_them():
    class Job:
        free = {"a": np.ones(2, bool)}
        scales = {"a": 1.0}
        chosen = (scene_keys.Parameter("a", ("a",), "", "", "reflectance", "value", (2,), "float32", None),)

    matrix = np.array([[2.0, 1.0], [1.0, 2.0]])
    # Unbounded: (1.2, 0.7). With the first number at 1, the second follows.
    right = matrix @ np.array([1.2, 0.7])
    found = scene_newton._bounded(Job, np.array([0.9, 0.6]), matrix, right)
    assert np.allclose(found, [1.0, (right[1] - 1.0) / 2])


def test_outliers_of_derivatives_are_clipped_and_small_things_stay(rng):
    shape = (20, 20, 3)
    smooth = np.tile(np.linspace(1, 2, 20)[:, None, None], (1, 20, 3)).reshape(1, -1)
    assert np.allclose(scene_newton._without_outliers(smooth, shape), smooth)
    spiked = smooth.copy()
    spiked[0, 600] = 1e4
    assert scene_newton._without_outliers(spiked, shape)[0, 600] < 60
    alone = np.zeros((1, 1200))
    alone[0, [100, 700]] = 1.0, 2.0
    kept = scene_newton._without_outliers(alone, shape)
    assert (kept[0, [100, 700]] > 0).all() and np.count_nonzero(kept) == 2


@pytest.mark.parametrize(
    ("options", "why"),
    [
        ({"keys": [COLOUR]}, "textures and attributes have too many numbers"),
        ({"keys": ["lamp.*"], "loss": "log_srgb_l1"}, "the loss is not a square"),
        ({"keys": ["lamp.*"], "regularizers": [lambda v: 0.0]}, "regularizers came"),
    ],
)
def test_gauss_newton_says_why_it_cannot(options, why):
    given = {"sensors": None, "references": [np.full((24, 24, 3), 0.3)], "fast": False, "solver": "gauss-newton"}
    with pytest.raises(UsageError, match=why):
        scene_fit.fit_scene(flat(cameras=CAMERAS[:1]), **given | options)


def test_what_has_not_arrived_is_said():
    """Three steps of the rate do not reach from 0.5 to the texture; drift over the last steps shows it."""
    refs = [np.full((24, 24, 3), 0.02, np.float32)]
    scene = flat(cameras=CAMERAS[:1])
    fitted = scene_fit.fit_scene(scene, [COLOUR], None, refs, iterations=60, spp=2, rate=0.002, pyramid=False)
    assert fitted.unconverged == (COLOUR,) and any("still moved at the end" in note for note in fitted.notes)


def test_the_function_says_what_it_takes():
    """help(mistyle.fit_scene) has every argument of the function behind it, and text for each."""
    ours, behind = (inspect.signature(f).parameters for f in (mistyle.fit_scene, scene_fit.fit_scene))
    assert set(ours) == set(behind) | {"channels"} and "options" not in ours
    text = inspect.getdoc(mistyle.fit_scene) or ""
    assert all(name in text for name in ours)


def test_pictures_by_path_and_shapes_that_share_a_material_are_noted(tmp_path):
    import mitsuba as mi

    from mistyle.io.images.write import write_exr

    device.use()
    same = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.4, 0.4, 0.4]}}
    up = mi.ScalarTransform4f().translate([0, 0, -0.5])
    scene = wall(same, CAMERAS[:1], size=8, second={"type": "sphere", "to_world": up, "bsdf": dict(same)})
    picture = references(scene, 16)[0]
    planes = dict(zip(("image.R", "image.G", "image.B"), np.moveaxis(picture, -1, 0), strict=True))
    write_exr(tmp_path / "0.exr", planes)
    given = {"references": [tmp_path / "0.exr"], "iterations": 2, "spp": 2}
    fitted = mistyle.fit_scene(scene, "wall.bsdf.reflectance", **given, channels="image")
    said = " ".join(fitted.notes)
    assert "belongs to 2 shapes (second, wall): mi.load_file merges equal materials" in said
    assert np.allclose(fitted.values[fitted.parameters[0].key], 0.4, atol=0.1)


def test_a_named_loss_of_a_texture_is_that_of_the_noisy_path():
    evidence = scene_job.Evidence([np.full((24, 24, 3), 0.3)])
    plan = scene_job.FitPlan(1, 1, None, 0.02, True, 1, 0)
    scene, unknowns = flat(cameras=CAMERAS[:1]), scene_job.Unknowns([COLOUR])
    job, notes = scene_job.prepare(scene, unknowns, evidence, scene_job.Objective(), plan, fast=False)
    assert job.loss == "relative" and not job.newton and TRUE_COLOUR.shape == job.chosen[0].shape
    assert not any("log_srgb_l1" in note for note in notes)


def test_a_roughness_is_found_from_both_sides():
    """At 0.06 the sampled derivative by alpha has a spread far above its mean; at 0.3 a full step overshoots."""

    def scene(alpha):
        import mitsuba as mi

        device.use()
        paint = {
            "type": "roughplastic",
            "alpha": alpha,
            "diffuse_reflectance": {"type": "rgb", "value": [0.6, 0.2, 0.1]},
        }
        lamp = mi.ScalarTransform4f().translate([1, 3, 1]).rotate([1, 0, 0], 90).scale(0.7)
        light = {"type": "area", "radiance": {"type": "rgb", "value": [8.0, 6.0, 4.0]}}
        extra = {"lamp": {"type": "rectangle", "to_world": lamp, "emitter": light}, "sky": {"type": "constant"}}
        ball = {"type": "sphere", "radius": 0.6, "bsdf": paint}
        return mi.load_dict({"type": "scene", "integrator": {"type": "path"}, "ball": ball, **cameras(), **extra})

    def cameras():
        import mitsuba as mi

        film = {"type": "hdrfilm", "width": 32, "height": 32, "rfilter": {"type": "box"}}
        return {
            f"cam{k}": {
                "type": "perspective",
                "fov": 20,
                "film": film,
                "to_world": mi.ScalarTransform4f().look_at(origin=place, target=[0, 0, 0], up=[0, 1, 0]),
            }
            for k, place in enumerate(([1.3, 2.0, 6.0], [4.0, 1.5, 4.0]))
        }

    truth = references(scene(0.15), spp=1024)
    for start in (0.3, 0.06):
        fitted = scene_fit.fit_scene(scene(start), ["ball.bsdf.alpha"], None, truth, iterations=40)
        assert abs(fitted.values["ball.bsdf.alpha"][0] - 0.15) < 0.03 and not fitted.unconverged, start
