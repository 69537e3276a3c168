"""The fast path against Mitsuba, finite differences and itself."""

import subprocess
import sys
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

from mistyle.core.camera import orbit
from mistyle.core.capture import in_memory
from mistyle.core.light import Ambient, Directional, Environment, Point
from mistyle.render.deferred import image_samples
from mistyle.render.deferred import renderer as shade
from mistyle.render.deferred.material_table import pack, unpack
from mistyle.render.mitsuba import device, draw
from mistyle.render.mitsuba import scene as scenery
from tests.render.deferred.test_seam import KEY, SIZES, crop, plain_scene, random_maps, torus
from tests.support.helpers import recordings

RIM = Directional((0.8, 0.36, 0.48), (0.6, 1.2, 2.0))
LAMP = Point((1.5, 1.0, 1.5), (3.0, 2.5, 2.0))
PARAMETERS = {"albedo": slice(0, 3), "tilt": slice(3, 5), "roughness": slice(5, 6), "metallic": slice(6, 7)}


@pytest.fixture(scope="module")
def traced():
    device.use()
    return draw.tracer(torus())


@dataclass
class Drawn:
    """A renderer, and the table that it draws here."""

    renderer: shade.MaterialRenderer
    table: Any

    def image(self, k):
        return self.renderer.image(self.table, k)

    def image_and_coverage(self, k):
        return self.renderer.image_and_coverage(self.table, k)

    def step(self, pictures, loss="log_srgb_l1"):
        return self.renderer.step(self.table, pictures, loss)

    def pull(self, k, adjoint):
        return self.renderer.pull(self.table, k, adjoint)


def made(traced, rng, cameras, lights, subsamples=1, maps=None, weights=None, **options) -> Drawn:
    """One picture per camera, all under the same lights, with random references."""
    pictures = [rng.uniform(0, 1, (*camera.size, 3)).astype(np.float32) for camera in cameras]
    captures = in_memory(cameras, [lights] * len(cameras), pictures)
    chosen = shade.RenderOptions(**{"frame": "mitsuba", "subsamples": subsamples} | options)
    renderer = shade.MaterialRenderer(traced, captures, SIZES, chosen, weights)
    return Drawn(renderer, pack(maps or random_maps(rng, SIZES, tilt=0.2)))


def scene_of(traced, maps, camera, lights, integrator):
    """The same object under the same lights for mi.render."""
    import mitsuba as mi

    sensor = scenery.sensor_dict(camera)
    sensor["film"]["pixel_format"] = "rgb"
    sensor["sampler"] = {"type": "independent"}
    described = {"type": "scene", "integrator": integrator, "sensor": sensor}
    for k, light in enumerate(lights):
        if isinstance(light, Directional):
            value = {"type": "directional", "direction": (-np.asarray(light.direction)).tolist()}
            value["irradiance"] = {"type": "rgb", "value": list(light.irradiance)}
        elif isinstance(light, Point):
            value = {"type": "point", "position": list(light.position)}
            value["intensity"] = {"type": "rgb", "value": list(light.intensity)}
        elif isinstance(light, Ambient):
            value = {"type": "constant", "radiance": {"type": "rgb", "value": list(light.radiance)}}
        else:
            turned = mi.ScalarTransform4f().rotate([0, 1, 0], light.turn)
            value = {"type": "envmap", "bitmap": mi.Bitmap(light.radiance * light.scale), "to_world": turned}
        described[f"light{k}"] = value
    return mi.load_dict({**described, **scenery.object_shapes(traced.mesh, maps)})


DIRECT = {"type": "direct", "emitter_samples": 1, "bsdf_samples": 0}


def test_picture_equals_mitsubas_through_the_pixel_centres(traced, rng):
    import mitsuba as mi

    maps, camera = random_maps(rng, SIZES), crop()
    ours = made(traced, rng, [camera], (KEY,), maps=maps)
    twin = np.array(mi.render(plain_scene(traced.mesh, maps, camera, KEY), spp=1, seed=0))[..., :3]
    assert 0.1 < (twin > 0).mean() < 0.9
    assert (np.abs(ours.image(0) - twin).max(axis=-1) > 2e-4).mean() < 1e-3


def accepted(image, passes) -> float:
    """Share of values that a z-test does not reject, at 1 % for the picture as a whole (Šidák)."""
    from scipy.stats import norm

    mean, count = passes.mean(axis=0), len(passes)
    # Where hardly any sample fell on the lit part of a pixel, its variance is not known: it has a floor.
    deviation = np.sqrt(np.maximum(passes.var(axis=0, ddof=1), 1e-5) / count)
    p = 2 * norm.sf(np.abs(image - mean) / deviation)
    return float((p > 1 - (1 - 0.01) ** (1 / p.size)).mean())


def test_picture_equals_mitsubas_under_delta_lights(traced, rng):
    """Mitsuba's `direct` picks one light a sample at random; 64 independent pictures of 16 samples tell its noise."""
    import mitsuba as mi

    maps, camera, lights = random_maps(rng, SIZES), crop(32), (RIM, LAMP, Directional((0.0, 0.8, 0.6), (1.0, 0.5, 0.2)))
    ours = made(traced, rng, [camera], lights, 64, maps=maps)
    scene = scene_of(traced, maps, camera, lights, DIRECT)
    passes = np.stack([np.array(mi.render(scene, spp=16, seed=k)) for k in range(64)])
    assert accepted(ours.image(0), passes) >= 0.9975
    # The test has teeth: two hundredths of roughness more, and it fails.
    ours.table = ours.table + np.float32([0, 0, 0, 0, 0, 0.02, 0, 0])
    assert accepted(ours.image(0), passes) < 0.9975


ENVIRONMENT = Environment(np.kron(np.random.default_rng(3).random((8, 16, 3)) ** 3, np.ones((8, 8, 1))), 40.0, 1.5)


@pytest.mark.parametrize("light", [Ambient((0.8, 0.7, 0.6)), ENVIRONMENT])
def test_picture_equals_mitsubas_under_soft_light(traced, rng, light):
    """Relative RMSE of 1 %; the noise of Mitsuba's 2 · 2,048 samples drops out of the product of two errors."""
    import mitsuba as mi

    light = Environment(light.radiance.astype(np.float32), light.turn, light.scale) if light is ENVIRONMENT else light
    maps, camera = random_maps(rng, SIZES, tilt=0.2, roughness=(0.2, 0.9)), crop(24)
    ours = made(traced, rng, [camera], (light,), 64, maps=maps, directions=256).image(0)
    scene = scene_of(traced, maps, camera, (light,), {"type": "direct", "hide_emitters": True})
    one, two = (np.mean([mi.render(scene, spp=512, seed=4 * s + k) for k in range(4)], axis=0) for s in (0, 1))
    error = ((ours - one) * (ours - two)).mean() / (one * two).mean()
    assert error < 0.01**2
    assert abs(ours.mean() / ((one + two).mean() / 2) - 1) < 0.005


@pytest.mark.parametrize("loss", ["l2", "log_srgb_l1"])
@pytest.mark.parametrize("model, subsamples", [("principled", 1), ("gltf", 4)])
def test_gradient_of_each_map_equals_finite_differences(traced, rng, loss, model, subsamples):
    cameras = [crop(32), orbit(200, 10, distance=4, fov=30, size=(32, 32))]
    # A normal that turns away from the camera goes dark at once: where that may happen there is no derivative.
    facing = [facing_pixels(traced, camera) for camera in cameras]
    ours = made(traced, rng, cameras, (KEY, LAMP), subsamples, model=model, weights=facing.__getitem__)
    if loss == "log_srgb_l1":  # which has a kink where picture and reference agree
        pictures = [ours.image(k) for k in (0, 1)]
        apart = [np.where(np.abs(r - p) < 0.05, p + 0.1, r) for p, r in zip(pictures, references(ours), strict=True)]
        ours.renderer.captures = in_memory(cameras, ours.renderer.captures.lights, apart)
        ours.renderer._cache.clear()
    start = ours.table.astype(np.float64)
    gradient = np.array(ours.step([0, 1], loss)[1]).astype(np.float64)
    assert (gradient[:, 7] == 0).all()
    for name, channels in PARAMETERS.items():
        for _ in range(2):
            direction = np.zeros_like(start)
            direction[:, channels] = rng.normal(size=start[:, channels].shape)
            ends = []
            for sign in (1, -1):
                ours.table = start + sign * 1e-3 * direction
                ends.append(loss_of(ours, loss, [0, 1], facing))
            numeric, analytic = (ends[0] - ends[1]) / 2e-3, float((gradient * direction).sum())
            # Against the size of the whole gradient: a random direction may happen to be nearly level.
            assert abs(numeric - analytic) < 0.02 * np.linalg.norm(gradient[:, channels]), (name, numeric, analytic)


def references(ours) -> list[np.ndarray]:
    return [ours.renderer.captures.load(k)[0] for k in range(len(ours.renderer.captures))]


def facing_pixels(traced, camera) -> np.ndarray:
    """1 where the surface is seen at less than 60 degrees, else 0."""
    seen = draw.gbuffer(traced, camera)
    towards = camera.position - seen.position
    cosine = (towards * seen.normal).sum(-1) / np.linalg.norm(towards, axis=-1)
    return (seen.mask & (cosine > 0.5)).astype(np.float32)


def log_srgb(x):
    """sRGB's curve without an end at 1."""
    x = np.log1p(x)
    return np.where(x <= 0.0031308, 12.92 * x, 1.055 * np.maximum(x, 1e-9) ** (1 / 2.4) - 0.055)


def loss_of(ours, loss, pictures, weights) -> float:
    """The loss as `step` describes it, in float64 NumPy."""
    total = 0.0
    for k in pictures:
        image, coverage = ours.image_and_coverage(k)
        image, covered = image.astype(np.float64), coverage > 0
        reference = ours.renderer.captures.load(k)[0].astype(np.float64)
        if loss == "l2":
            lost = (image - reference) ** 2
        else:
            lost = np.abs(log_srgb(image) - log_srgb(reference))
        total += float((lost * (covered * weights[k])[..., None]).sum() / lost.size / len(pictures))
    return total


@pytest.mark.parametrize("loss", ["l2", "log_srgb_l1"])
@pytest.mark.parametrize("subsamples", [1, 4])
def test_loss_counts_covered_pixels_of_the_mask_with_their_weights(traced, rng, loss, subsamples):
    camera = crop(32)
    weight = rng.random(camera.size).astype(np.float32)
    ours = made(traced, rng, [camera], (KEY,), subsamples, weights=lambda k: weight)
    image, coverage = ours.image_and_coverage(0)
    dark = ((image == 0).all(axis=-1) & (coverage > 0)).mean()
    assert dark > 0.02  # pixels in shadow count as well
    assert float(ours.step([0], loss)[0][0]) == pytest.approx(loss_of(ours, loss, [0], [weight]), rel=2e-5)
    mask = rng.random(camera.size) < 0.5
    captures = in_memory([camera], [(KEY,)], [ours.renderer.captures.load(0)[0]], [mask])
    options = shade.RenderOptions(frame="mitsuba", subsamples=subsamples)
    half = Drawn(shade.MaterialRenderer(traced, captures, SIZES, options), ours.table)
    np.testing.assert_array_equal(half.image(0), np.where(mask[..., None], ours.image(0), 0))
    assert float(half.step([0], loss)[0][0]) == pytest.approx(loss_of(half, loss, [0], [1.0]), rel=2e-5)


@pytest.mark.parametrize("lights, subsamples", [((KEY, LAMP), 1), ((KEY, LAMP), 4), ((Ambient((1, 1, 1)), KEY), 4)])
def test_gradient_of_a_given_derivative_is_the_same_one(traced, rng, lights, subsamples):
    ours = made(traced, rng, [crop(24)], lights, subsamples, directions=32)
    image, reference = ours.image(0), ours.renderer.captures.load(0)[0]
    adjoint = 2 * (image - reference) / image.size
    fused, pulled = np.array(ours.step([0], "l2")[1]), np.array(ours.pull(0, adjoint))
    assert np.abs(fused).max() > 0
    np.testing.assert_allclose(pulled, fused, atol=1e-5 * np.abs(fused).max())


@pytest.mark.parametrize("lights", [(RIM, LAMP), (ENVIRONMENT,)])
def test_gradient_equals_mitsubas_average(traced, rng, lights):
    """Against two independent averages through `mi.render`; their noise drops out of the product of two errors."""
    import drjit as dr
    import mitsuba as mi

    if lights[0] is ENVIRONMENT:
        lights = (Environment(ENVIRONMENT.radiance.astype(np.float32), 40.0, 1.5),)
    maps, camera = random_maps(rng, SIZES, tilt=0.2, roughness=(0.3, 0.9)), crop(24)
    ours = made(traced, rng, [camera], lights, 64, maps=maps, directions=256)
    adjoint = rng.uniform(0.5, 1.5, (*camera.size, 3)).astype(np.float32)
    mine = np.array(ours.pull(0, adjoint)).astype(np.float64)
    # `prb` holds its directions fast; `direct` under AD moves them with the normals and so across shadows' edges.
    integrator = DIRECT if len(lights) == 2 else {"type": "prb", "max_depth": 2, "hide_emitters": True}
    scene = scene_of(traced, maps, camera, lights, integrator)
    parameters = mi.traverse(scene)
    names = {(part, name): key for part in (0, 1) for name, key in scenery.parameters(part).items()}
    parameters.keep(list(names.values()))
    halves = []
    for half in (0, 1):
        found = dict.fromkeys(names.values(), np.float64(0))
        for k in range(4):
            for key in names.values():
                parameters[key] = dr.detach(parameters[key])
                dr.enable_grad(parameters[key])
            parameters.update()
            twin = mi.render(scene, parameters, spp=256, seed=8 * half + 2 * k)
            dr.backward(dr.sum(twin * mi.TensorXf(adjoint)))
            found = {key: found[key] + np.array(dr.grad(parameters[key]), np.float64) / 4 for key in found}
        rows = []
        for p, m in enumerate(maps):
            albedo, normal, roughness, metallic = (found[names[p, name]] for name in scenery.parameters(p))
            # Their texture holds (n + 1) / 2, and z is free in it.
            tilt = 0.5 * (normal[..., :2] - normal[..., 2:] * m.normal[..., :2] / m.normal[..., 2:])
            rows.append(np.concatenate([albedo, tilt, roughness, metallic], axis=-1).reshape(-1, 7))
        halves.append(np.concatenate(rows))
    one, two = halves
    limit = 0.02 if len(lights) == 2 else 0.03
    for name, c in PARAMETERS.items():
        error = ((mine[:, c] - one[:, c]) * (mine[:, c] - two[:, c])).sum() / (one[:, c] * two[:, c]).sum()
        assert error < limit**2, (name, error)


@pytest.mark.parametrize("lights, subsamples", [((KEY, LAMP), 1), ((KEY, LAMP), 4), ((Ambient((1, 1, 1)),), 4)])
def test_same_bytes_frozen_kept_recomputed_and_again(traced, lights, subsamples, monkeypatch):
    monkeypatch.setattr(image_samples, "BLOCK_RAYS", 40 * 8 * subsamples)  # five blocks a picture
    cameras, results = [crop(40), orbit(200, 10, distance=4, fov=30, size=(40, 40))], []
    for options in ({}, {}, {"memory": 0}, {"freeze": False}):
        rng = np.random.default_rng(1)
        ours = made(traced, rng, cameras, lights, subsamples, directions=32, **options)
        for _ in range(2):
            value, gradient = ours.step([1, 0], "log_srgb_l1")
        adjoint = rng.normal(size=(40, 40, 3)).astype(np.float32)
        found = [value, gradient, ours.pull(1, adjoint), *ours.image_and_coverage(1)]
        results.append([np.array(v).tobytes() for v in found])
        assert bool(ours.renderer._cache) == ("memory" not in options)
    assert all(result == results[0] for result in results[1:])


@pytest.mark.parametrize("memory", [1e9, 0])
def test_without_gradients_pictures_are_the_same_and_take_less(traced, memory):
    found = []
    for options in ({}, {"gradients": False}):
        ours = made(traced, np.random.default_rng(1), [crop(40)], (KEY, LAMP), 4, memory=memory, **options)
        pictures = [ours.image(0) for _ in range(2)]
        list(ours.renderer.blocks(0))
        found.append((ours.renderer.held(), *(p.tobytes() for p in pictures)))
    assert found[0][1:] == found[1][1:]
    assert found[1][0] <= 0.7 * found[0][0] and (found[1][0] > 0) == (memory > 0)


def test_same_bytes_at_any_thread_count(traced):
    import drjit as dr

    threads, results = dr.thread_count(), []
    try:
        for count in (1, 2):
            device.use(threads=count)
            ours = made(traced, np.random.default_rng(1), [crop(40)], (KEY, LAMP), 4)
            value, gradient = ours.step([0], "l2")
            results.append((np.array(value).tobytes(), np.array(gradient).tobytes()))
    finally:
        device.use(threads=threads)
    assert results[0] == results[1]


def test_the_loop_traces_nothing_waits_for_nothing_and_records_rarely(traced, rng, monkeypatch):
    import drjit as dr
    import mitsuba as mi

    cameras = [orbit(60 * k, 20, distance=4, fov=30, size=(32, 32)) for k in range(6)]
    ours = made(traced, rng, cameras, (KEY, LAMP), 4)
    adjoint = mi.TensorXf(rng.normal(size=(32, 32, 3)).astype(np.float32))
    collected = [ours.image(k) for k in range(6)]
    monkeypatch.setattr(image_samples, "collect", None)
    counts, start, table = [], recordings(ours.renderer), ours.table
    uploaded = ours.renderer.upload(table)
    with dr.scoped_set_flag(dr.JitFlag.ForbidSynchronization, True):
        for _ in range(4):
            value, gradient = ours.step(range(6), "log_srgb_l1")
            pulled = ours.pull(3, adjoint)
            ours.table = mi.TensorXf(uploaded - 0.01 * gradient.array, (len(table), 8))
            uploaded = ours.table.array
            counts.append(recordings(ours.renderer) - start)
    # At most two for each of six pictures' sizes and the one that is pulled, all of them at the beginning.
    assert len(collected) == 6 and counts[1] == counts[-1] <= 14
    assert np.isfinite(np.array(gradient)).all() and np.isfinite(np.array(pulled)).all() and float(value[0]) > 0


def test_one_step_along_the_gradient_is_downhill(traced, rng):
    ours = made(traced, rng, [crop(32)], (KEY,), 4, frame="mikkt")
    value, gradient = ours.step([0], "l2")
    step = np.array(gradient)
    ours.table = ours.table - np.float32(1e-3 * float(value[0]) / (step**2).sum()) * step
    assert float(ours.step([0], "l2")[0][0]) == pytest.approx(0.999 * float(value[0]), rel=1e-4)


def test_maps_survive_the_table(rng):
    maps = random_maps(rng, SIZES)
    for before, after in zip(maps, unpack(pack(maps), SIZES), strict=True):
        for name in ("albedo", "normal", "roughness", "metallic"):
            np.testing.assert_allclose(getattr(after, name), getattr(before, name), atol=1e-6)


def test_misuse_is_refused(traced, rng):
    ours = made(traced, rng, [crop(8)], (KEY,))
    with pytest.raises(ValueError, match="a table of"):
        ours.renderer.image(np.zeros((3, 8), np.float32), 0)
    with pytest.raises(ValueError, match="model is"):
        made(traced, rng, [crop(8)], (KEY,), model="phong")
    with pytest.raises(ValueError, match="texture sets"):
        shade.MaterialRenderer(traced, ours.renderer.captures, SIZES[:1])


def test_arrays_let_go_while_a_function_is_recorded_do_no_harm():
    """In a process of its own: where the collector runs during the recording, Dr.Jit aborts."""
    code = """
import gc
import numpy as np
from mistyle.render.mitsuba import device
device.use()
import drjit as dr
import mitsuba as mi

class Ring:
    pass

def leave():
    ring = Ring()
    ring.self, ring.array = ring, mi.Float(np.ones(4096, np.float32))
    dr.eval(ring.array)

def traced(x):
    if gc.isenabled():
        gc.collect()  # what may happen at any time
    dr.eval(x)
    return x * 2 + 40

gc.collect()
leave()
print(np.array(device.Frozen(traced)(mi.Float(np.ones(64, np.float32))))[0])
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0 and done.stdout.strip() == "42.0", done.stderr
