"""The per-texel solver under soft light: cells of the sky, what hides them, the model's plain twin, and a recovery."""

from dataclasses import replace

import numpy as np
import pytest

from mistyle.atlas.texels import rasterise
from mistyle.core.camera import look_at
from mistyle.core.capture import in_memory
from mistyle.core.light import Ambient, Directional, Environment, SphericalGaussian
from mistyle.render.deferred import sky
from mistyle.render.mitsuba import device
from mistyle.render.mitsuba.draw import tracer
from mistyle.solver.recover import recover
from mistyle.solver.settings import RecoverSettings
from mistyle.solver.texels.gbuffer import SKY_CELLS, open_sky, rig
from mistyle.solver.texels.levenberg_marquardt import Observations, Options, Points, Problem
from tests.render.deferred.test_seam import sphere
from tests.solver.test_recover import errors, fibonacci, photographs, strong_maps

SUN = SphericalGaussian(axis=(0.0, 0.6, 0.8), sharpness=400.0, amplitude=(30.0, 20.0, 10.0))
EVEN = Ambient((0.5, 1.0, 2.0))


def test_cells_hold_all_the_light():
    middles = sky.even_directions(SKY_CELLS)
    np.testing.assert_allclose(np.linalg.norm(middles, axis=1), 1, atol=1e-6)
    even = sky.bin_environment((EVEN, Directional((0, 1, 0), (9, 9, 9))), middles)
    np.testing.assert_allclose(even.irradiance.sum(axis=0), 4 * np.pi * np.array(EVEN.radiance), rtol=1e-3)
    # Evenly lit cells have nearly one size: that of a disc of 1/128 of the sphere, and its spread.
    radius2 = 4 / SKY_CELLS
    assert np.abs(even.irradiance[:, 1] * SKY_CELLS / (4 * np.pi) - 1).max() < 0.15
    assert even.width2.mean() == pytest.approx(radius2 / 4, rel=0.1)
    assert (even.direction * middles).sum(axis=1).min() > 0.998
    sun = sky.bin_environment((SUN,), middles)
    brightest = sun.irradiance[:, 0].argmax()
    assert sun.irradiance[brightest, 0] > 0.3 * sun.irradiance[:, 0].sum()
    assert sun.direction[brightest] @ np.array(SUN.axis) > middles[brightest] @ np.array(SUN.axis) - 1e-6
    total = (sun.direction * sun.irradiance[:, :1]).sum(axis=0)
    assert total @ np.array(SUN.axis) / np.linalg.norm(total) > 0.9999
    assert sun.width2[brightest] < even.width2.mean()


def test_the_sky_is_open_where_nothing_hides_it():
    device.use("llvm_ad_rgb")
    ball = sphere()
    traced = tracer(ball)
    middles = sky.even_directions(SKY_CELLS)
    corners = ball.positions[ball.faces[::3]]
    position = corners.mean(axis=1)
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal = (normal / np.linalg.norm(normal, axis=1, keepdims=True)).astype(np.float32)
    words = open_sky(traced, position, normal)
    free = ((words[:, np.arange(SKY_CELLS) // 32] >> (np.arange(SKY_CELLS) % 32).astype(np.uint32)) & 1).astype(bool)
    assert not free[normal @ middles.T < -0.1].any() and 0.2 < free.mean() <= 0.55
    far = position + 10 * normal
    assert (open_sky(traced, far, normal) == np.uint32(2**32 - 1)).mean() > 0.9


def problem(options: Options, rng: np.random.Generator, texels=40):
    """Texels about the origin, seen by four cameras under a sky each, one of them with a lamp too."""
    cameras = [look_at(e, fov=30, size=(8, 8)) for e in ((0, 0, 4), (3, 1, 3), (-3, 1, 3), (0, 3, 3))]
    lights = [(EVEN,), (SUN, EVEN), (EVEN, Directional((0.36, 0.48, 0.8), (2, 2, 2), "world")), (SUN,)]
    own = rig(cameras, lights)
    normal = np.tile([0.0, 0.0, 1.0], (texels, 1)) + rng.normal(0, 0.2, (texels, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    tangent = np.cross([0.0, 1.0, 0.0], normal)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    frame = np.stack([tangent, np.cross(normal, tangent), normal], axis=1).astype(np.float32)
    words = rng.integers(0, 2**32, (texels, SKY_CELLS // 32), dtype=np.uint32)
    points = Points(rng.normal(0, 0.1, (texels, 3)).astype(np.float32), frame, words)
    count = texels * len(cameras)
    lit = np.zeros(count, np.uint32)
    lit[2::4] = rng.integers(0, 2, texels)
    seen = Observations(
        np.arange(texels + 1) * 4, np.tile(np.arange(4), texels).astype(np.int32), np.zeros((count, 3), np.float32),
        np.ones(count, np.float32), lit,
    )  # fmt: skip
    return Problem(points, own, seen, options), points, own, seen


def values(rng: np.random.Generator, texels=40) -> np.ndarray:
    x = rng.uniform(0.1, 0.9, (texels, 7)).astype(np.float32)
    x[:, 3:5] = rng.normal(0, 0.15, (texels, 2))
    return x


@pytest.mark.parametrize("model", ["principled", "gltf"])
def test_the_model_is_the_sum_over_cells(rng, model):
    import mitsuba as mi

    from mistyle.render.deferred import bsdf

    solver, points, own, seen = problem(Options(model, metallic=True), rng)
    x = values(rng)
    found = solver.predict(x)
    assert own.cells is not None and own.width2 is not None and points.open is not None
    expected = np.zeros((len(seen.rgb), 3))
    for row, picture in enumerate(seen.picture):
        texel = row // 4
        lamps = range(own.first[picture], own.first[picture + 1])
        cells = own.cells[picture]
        shines = [
            (points.open[texel, (k - cells) // 32] >> np.uint32((k - cells) % 32)) & 1
            if k >= cells
            else (seen.lit[row] >> np.uint32(k - own.first[picture])) & 1
            for k in lamps
        ]
        wi = points.frame[texel] @ (own.eye[picture] - points.position[texel])
        wi = wi / np.linalg.norm(wi)
        wo = (own.vector[lamps.start : lamps.stop] @ points.frame[texel].T).astype(np.float32)
        tilt = x[texel, 3:5]
        normal = mi.Vector3f(float(tilt[0]), float(tilt[1]), float(np.sqrt(1 - (tilt**2).sum())))
        rough = (x[texel, 5] ** 4 + 0.5 * own.width2[lamps.start : lamps.stop]) ** 0.25
        linear, constant = bsdf.terms(
            bsdf.Reflectance(model), mi.Vector3f(*map(float, wi)), mi.Vector3f(*(mi.Float(c) for c in wo.T)), normal,
            mi.Float(rough.astype(np.float32)), mi.Float(float(x[texel, 6])),
        )  # fmt: skip
        light = own.irradiance[lamps.start : lamps.stop] * np.array(shines)[:, None]
        parts = np.array(linear)[:, None] * x[texel, :3] + np.array(constant)[:, None]
        expected[row] = (light * parts).sum(axis=0)
    np.testing.assert_allclose(found, expected, rtol=2e-4, atol=2e-5)


def test_derivatives_under_a_sky_are_those_of_differences(rng):
    truth, start = values(rng), values(rng)
    answers = []
    for differences in (False, True):
        solver, _, _, seen = problem(Options("principled", True, differences=differences), np.random.default_rng(5))
        solver.retarget(solver.predict(truth))
        prior = np.full((40, 7), 1e-3, np.float32)
        answers.append([solver.solve(start, start, prior, steps).values for steps in (1, 6)])
    # From one step on they go ways of their own, where little decides.
    apart = np.abs(answers[0][0] - answers[1][0])
    assert np.quantile(apart, 0.95) < 1e-3 and np.abs(answers[0][0] - start).mean() > 0.05
    wrong = ((answers[0][1] - truth)[:, :3] ** 2).mean() / ((start - truth)[:, :3] ** 2).mean()
    assert wrong < 0.3


def test_a_turned_environment_tells_albedo_and_normals():
    """The same ball as under delta lights, under one environment in three positions."""
    rows = np.linspace(0, 1, 16)[:, None, None] * np.ones((16, 32, 3))
    radiance = np.where(np.arange(32)[None, :, None] < 6, 6.0, 0.2) * (0.3 + rows)
    cameras = [replace(c, name=f"{c.name}.{k}") for c in fibonacci(8, 64) for k in range(3)]
    lights = [(Environment(radiance.astype(np.float32), turn=120.0 * k),) for _ in range(8) for k in range(3)]
    mesh, maps, texels = sphere(), strong_maps(size=40), rasterise(sphere(), 0, 40)
    pictures = photographs(mesh, [maps], cameras, lights, "mikkt", {"type": "direct"}, 32)
    settings = RecoverSettings(solver="texels", bounces=0, solver_iterations=8, rounds=2)
    found = recover(mesh, [texels], in_memory(cameras, lights, pictures), settings, 0)
    chosen = texels.covered & (found.views[0] >= 2)
    assert chosen.sum() > 0.6 * texels.covered.sum() and not found.notes
    angle, roughness, albedo = errors(found.maps[0], maps, chosen)
    flat = np.degrees(np.arccos(maps.normal[..., 2]))[chosen]
    psnr = -10 * np.log10((albedo**2).mean())
    assert psnr > 30 and angle.mean() < 0.4 * flat.mean() and np.median(np.abs(roughness)) < 0.05
