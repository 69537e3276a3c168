"""Recovering materials from pictures that Mitsuba drew of maps that are known."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from mistyle.atlas.frames import texel_frames
from mistyle.atlas.neighbours import of_islands
from mistyle.atlas.texels import rasterise
from mistyle.core.camera import by_camera, look_at, of_corners, pixel_centres, world_from_px
from mistyle.core.capture import in_memory, subset
from mistyle.core.errors import InputRefused
from mistyle.core.image import erode, gaussian
from mistyle.core.light import Directional, Environment, Point
from mistyle.core.maps import Maps
from mistyle.render.deferred import image_samples as collecting
from mistyle.render.mitsuba import device, draw
from mistyle.render.mitsuba import scene as scenery
from mistyle.render.mitsuba.emitters import emitters
from mistyle.solver import indirect
from mistyle.solver.indirect import FIREFLY, MOST, Indirect, averaged, enlarged, in_proportion
from mistyle.solver.pictures import descend as recover_pictures
from mistyle.solver.pictures.descend import SHORTEST
from mistyle.solver.prior import NOTHING
from mistyle.solver.recover import recover
from mistyle.solver.settings import RecoverSettings, estimates, passes
from mistyle.solver.table import Atlas
from mistyle.solver.texels import observations as recover_observe
from mistyle.solver.texels.gbuffer import GBuffer, trace_gbuffer
from mistyle.solver.texels.observations import (
    ObservationOptions,
    TexelObservations,
    VisibleTexels,
    collect_observations,
)
from mistyle.solver.texels.solve import TexelEstimate
from mistyle.solver.validate import validate_captures
from tests.render.deferred.test_seam import sphere

SIZE, RESOLUTION, VIEWS = 64, 80, 10
QUICK = RecoverSettings(rounds=3, iterations=300, bounces=0)
LIGHTS = [((0.5, -0.5, -0.7), 2.0), ((-0.6, -0.3, -0.7), 1.5), ((0.0, 0.7, -0.7), 1.0)]


def fibonacci(count, resolution):
    """Cameras evenly around the object."""
    k = np.arange(count) + 0.5
    y, turn = 1 - 2 * k / count, np.pi * (3 - np.sqrt(5)) * k
    eyes = 4 * np.stack([np.sqrt(1 - y**2) * np.cos(turn), y, np.sqrt(1 - y**2) * np.sin(turn)], axis=-1)
    return [look_at(eye.tolist(), fov=30, size=(resolution, resolution), name=f"view{n}") for n, eye in enumerate(eyes)]


def strong_maps(seed=0, size=SIZE, metallic=0.0):
    """Smooth at the texel's scale: tilt 0.12, roughness 0.2..0.9, albedo 0.1..0.8."""
    rng = np.random.default_rng(seed)

    def field():
        noise = gaussian(np.tile(rng.standard_normal((size, size)).astype(np.float32), (3, 3)), 4.0)
        return (noise / noise.std())[size : 2 * size, size : 2 * size]

    def between(low, high):
        return (low + (high - low) * (0.5 + 0.5 * np.tanh(field()))).astype(np.float32)

    xy = np.clip(0.12 * np.stack([field(), field()], axis=-1), -0.5, 0.5)
    normal = np.concatenate([xy, np.sqrt(1 - (xy**2).sum(-1, keepdims=True))], axis=-1).astype(np.float32)
    albedo = np.stack([between(0.1, 0.8) for _ in range(3)], axis=-1)
    return Maps(
        albedo, normal, between(0.2, 0.9), np.full((size, size), metallic, np.float32), np.ones((size, size), bool)
    )


def directional(direction, strength):
    x, y, z = (np.asarray(direction) / np.linalg.norm(direction)).tolist()
    return Directional((x, y, z), (strength, strength, strength), "camera")


def photographs(mesh, maps, cameras, lights, frame, integrator, spp=64):
    """Mitsuba's pictures, one per camera and its lights."""
    import mitsuba

    mi: Any = mitsuba
    shapes = scenery.object_shapes(mesh, maps, frame=frame)
    pictures = []
    for camera, own in zip(cameras, lights, strict=True):
        described = {"type": "scene", "integrator": integrator, "sensor": scenery.sensor_dict(camera, spp), **shapes}
        described |= {f"light{k}": light for k, light in enumerate(emitters(own, camera))}
        drawn = mi.render(mi.load_dict(described, optimize=False), spp=scenery.samples(spp), seed=1)
        pictures.append(np.array(drawn)[..., :3].astype(np.float32))
    return pictures


DIRECT = {"type": "direct", "emitter_samples": 1, "bsdf_samples": 0}


@pytest.fixture(scope="module")
def world():
    """A sphere with strong maps, seen from ten sides under three lights one at a time; MikkTSpace frames."""
    device.use()
    mesh, maps = sphere(), strong_maps()
    cameras = [replace(c, name=f"{c.name}.{k}") for c in fibonacci(VIEWS, RESOLUTION) for k in range(3)]
    lights = [(directional(*light),) for _ in range(VIEWS) for light in LIGHTS]
    pictures = photographs(mesh, [maps], cameras, lights, "mikkt", DIRECT)
    return mesh, maps, rasterise(mesh, 0, SIZE), in_memory(cameras, lights, pictures)


@pytest.fixture(scope="module")
def recovered(world):
    mesh, _, texels, captures = world
    return recover(mesh, [texels], captures, QUICK, 0)


def errors(found, maps, chosen):
    """Degrees between the normals, roughness and albedo differences, of the chosen texels."""
    cosine = (found.normal * maps.normal).sum(-1)[chosen]
    angle = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
    return angle, (found.roughness - maps.roughness)[chosen], (found.albedo - maps.albedo)[chosen]


def test_finds_the_maps(world, recovered):
    _, maps, texels, _ = world
    chosen = texels.covered & (recovered.views[0] >= 3)
    assert chosen.sum() > 0.7 * texels.covered.sum()
    angle, roughness, albedo = errors(recovered.maps[0], maps, chosen)
    assert angle.mean() < 0.5
    assert np.median(np.abs(roughness)) < 0.01
    assert -10 * np.log10((albedo**2).mean()) > 38
    assert np.median(list(recovered.residuals.values())) < 0.02


def test_says_how_sure_it_is(world, recovered):
    """Where it is least sure of the roughness it is most wrong; unseen texels have no confidence."""
    _, maps, texels, _ = world
    chosen = texels.covered & (recovered.seen[0] >= 3)
    _, roughness, _ = errors(recovered.maps[0], maps, chosen)
    spread = recovered.spread[0]["roughness"][chosen]
    most, least = spread <= np.quantile(spread, 0.5), spread >= np.quantile(spread, 0.9)
    assert np.abs(roughness[least]).mean() > 2 * np.abs(roughness[most]).mean()
    assert (recovered.confidence[0][recovered.seen[0] == 0] == 0).all()
    assert not recovered.maps[0].known[~texels.covered].any()


SIDE = 64


def found_texels(values: np.ndarray, noise: float, prior: float, seen: np.ndarray):
    """What a solver would say of an atlas of SIDE² texels without seams: solution, observations, neighbours."""
    from mistyle.solver.texels.levenberg_marquardt import Observations, Points, Rig, Solution

    count = SIDE * SIDE
    priors, alone = np.full(values.shape, 1 / prior**2, np.float32), np.where(seen[:, None] > 0, 1 / noise**2, 1e-9)
    spread = np.broadcast_to(1 / np.sqrt(alone + priors), values.shape).astype(np.float32)
    solution = Solution(values.astype(np.float32), np.zeros(count, np.float32), spread, spread, priors)
    grid = of_islands(np.zeros((SIDE, SIDE), int))
    where = Atlas(((SIDE, SIDE),), (np.ones((SIDE, SIDE), bool),), (np.arange(count),), (grid,))
    start = np.concatenate([[0], np.cumsum(seen)])
    zeros, none = np.zeros(start[-1], np.float32), np.zeros((0, 3), np.float32)
    rgb = np.zeros((start[-1], 3), np.float32)
    observations = Observations(start, zeros.astype(np.int32), rgb, zeros, zeros.astype(np.int32))
    points = Points(np.zeros((count, 3), np.float32), np.zeros((count, 3, 3), np.float32))
    rig = Rig(none, np.zeros(1, np.int32), none, none[:, 0], none)
    return (
        solution,
        TexelObservations(np.arange(count), points, rig, observations, (), np.zeros(count, np.int32)),
        where,
    )


@pytest.mark.parametrize(("variation", "noise"), [(0.0, 0.01), (0.01, 0.01), (0.02, 0.005), (0.2, 0.01)])
def test_smoothness_is_measured_on_the_surface(rng, variation, noise):
    """Texels that differ by `variation`, found with `noise` under a prior that has drawn them to their mean."""
    from mistyle.solver import prior as recover_prior

    mean = np.full((SIDE * SIDE, 7), 0.5, np.float32)
    truth = mean + variation * rng.standard_normal(mean.shape)
    found = truth + noise * rng.standard_normal(mean.shape)
    prior, alone = 0.03**-2, noise**-2
    values = (found * alone + mean * prior) / (alone + prior)
    solution, observed, where = found_texels(values, noise, 0.03, np.full(SIDE * SIDE, 9))
    np.testing.assert_allclose(recover_prior.likelihood(solution)[0], noise, rtol=1e-2)
    own = noise**-2 / (noise**-2 + 0.03**-2)
    np.testing.assert_allclose(recover_prior.data_weight(solution, observed), own, rtol=1e-2)
    firm = 1 / np.sqrt(recover_prior.prior_precision(solution, mean, observed, where, 0.03))
    wanted = np.clip(variation, recover_prior.LEAST, 0.03)
    if variation > 0:
        np.testing.assert_allclose(np.median(firm[:, 3:5]), wanted, rtol=0.1)
    else:
        assert np.median(firm[:, 3:5]) < noise / 3
    np.testing.assert_allclose(firm[:, [0, 1, 2, 5, 6]], 0.03, rtol=1e-5)


@pytest.mark.parametrize("tilt", [0.02, 0.15])
def test_where_nothing_is_known_a_surface_is_level(rng, tilt):
    """The half that nobody saw has wild tilts, as neighbours of badly seen texels get: they are drawn to none, and what
    is left open is how much tilts vary where they are known. The half that was seen keeps its neighbours' mean."""
    from mistyle.solver import prior as recover_prior

    values = np.full((SIDE * SIDE, 7), 0.5, np.float32)
    values[:, 3:5] = np.hypot(tilt, 0.01) * rng.standard_normal((SIDE * SIDE, 2))
    half = np.arange(SIDE * SIDE) < SIDE * SIDE // 2
    values[~half, 3:5] = 0.4
    solution, observed, where = found_texels(values, 0.01, 0.6, np.where(half, 9, 0))
    np.testing.assert_allclose(recover_prior.tilt_variance(solution, observed), tilt**2, rtol=0.15)
    mean, firm = values.copy(), np.full(values.shape, 1 / 0.01**2, np.float32)
    mean[:, 3:5] = np.where(half[:, None], 0.1, 0.4)
    level, prior = recover_prior.shrink_normals(solution, mean, firm, observed, where)
    far = recover_prior.BLUR * SIDE  # rows next to the border have neighbours from both halves
    np.testing.assert_allclose(level[: SIDE * SIDE // 2 - far, 3:5], 0.1, rtol=0.05)
    assert (np.abs(level[SIDE * SIDE // 2 + far :, 3:5]) < 1e-3).all()
    np.testing.assert_allclose(prior[-1, 3:5] ** -0.5, np.hypot(0.01, tilt), rtol=0.1)
    np.testing.assert_array_equal(level[:, [0, 1, 2, 5, 6]], mean[:, [0, 1, 2, 5, 6]])
    solution.cost[:] = 3 * (9 - 7 / 3)  # what does not fit, here 3 times what it should, holds them more firmly
    again = recover_prior.shrink_normals(solution, mean, firm, observed, where)[1]
    np.testing.assert_allclose((again / prior)[: SIDE * SIDE // 2 - far, 3:5], 2, rtol=0.15)
    solution.cost[:] = 0
    # Seen in parts only, it is for the pictures to say what tilts there are, where there are any.
    share = recover_prior.data_weight(solution, observed)
    assert (share[half] > 0.9).all()
    np.testing.assert_allclose(share[~half], tilt**2 / (tilt**2 + recover_prior.KNOWN**2), rtol=0.1)


def test_misfit_is_of_those_that_could_contradict_themselves():
    """A texel seen once has a cost of zero whatever it saw: its misfit is its neighbours'."""
    from mistyle.solver import prior as recover_prior

    seen = np.where(np.arange(SIDE * SIDE) % 2 == 0, 1, 9)
    values = np.full((SIDE * SIDE, 7), 0.5, np.float32)
    solution, observed, where = found_texels(values, 0.01, 0.6, seen)
    solution.cost[seen == 9] = 20.0
    np.testing.assert_allclose(recover_prior.misfit(solution, observed, where), 20 / (9 - 7 / 3), rtol=1e-4)
    solution, observed, where = found_texels(values, 0.01, 0.6, np.ones_like(seen))
    assert (recover_prior.misfit(solution, observed, where) == 0).all()


def test_what_observations_tell_is_measured_by_how_well_they_fit():
    """Unseen: nothing. Fitting as `noise` promises: that, with the margin. Far better: as BEST_FIT. Worse: less."""
    from mistyle.solver import prior as recover_prior

    seen = np.where(np.arange(SIDE * SIDE) < SIDE, 0, 9)
    solution, observed, where = found_texels(np.full((SIDE * SIDE, 7), 0.5, np.float32), 0.01, 0.6, seen)
    for cost, wanted in ((0, recover_prior.BEST_FIT), (1, 1), (4, 4)):
        solution.cost[:] = np.where(seen > 0, 3 * cost * (9 - 7 / 3), 0)
        told = recover_prior.observation_std(solution, observed, where)
        assert (told[seen == 0] == recover_prior.NOTHING).all()
        np.testing.assert_allclose(told[seen > 0] / 0.01, np.sqrt(recover_prior.MARGIN * wanted), rtol=0.02)


@pytest.mark.parametrize(("step", "noise", "most"), [(1, 0.03, 0.7), (3, 0.05, 0.7)])
def test_neighbours_help_against_noise_and_where_little_is_known(world, rng, step, noise, most):
    """Thirty noisy pictures, and ten, where most texels have little but them: normals and roughness gain."""
    mesh, maps, texels, captures = world
    some = subset(captures, range(0, 30, step))
    pictures = [some.load(k) for k in range(len(some))]
    noisy = [(rgb * (1 + noise * rng.standard_normal(rgb.shape))).astype(np.float32) for rgb, _ in pictures]
    doubtful = replace(some, load=lambda k: (noisy[k], pictures[k][1]))
    settings = QUICK.model_copy(update={"iterations": 60, "relative": noise})
    found = []
    for smooth in (False, True):
        result = recover(mesh, [texels], doubtful, settings.model_copy(update={"smooth": smooth}), 0)
        angle, roughness, _ = errors(result.maps[0], maps, texels.covered & (result.views[0] >= 3))
        found.append((float(np.mean(angle)), float(np.mean(roughness**2))))
    (angle, roughness), (smooth_angle, smooth_roughness) = found
    assert smooth_angle < most * angle
    assert smooth_roughness < most * roughness


def test_an_atlas_too_fine_is_solved_at_a_coarser_level(world):
    """Half the texels along each side still find most of the albedo; the note says so."""
    mesh, maps, texels, captures = world
    settings = QUICK.model_copy(update={"iterations": 0, "rounds": 1, "solver_texels": 2000})
    found = recover(mesh, [texels], captures, settings, 0)
    assert any("2 times coarser" in note for note in found.notes)
    assert found.maps[0].albedo.shape == (SIZE, SIZE, 3) and found.seen[0].shape == (SIZE, SIZE)
    angle, _, albedo = errors(found.maps[0], maps, texels.covered & (found.seen[0] >= 3))
    assert -10 * np.log10((albedo**2).mean()) > 20 and np.isfinite(angle).all()


def test_from_pictures_alone_and_from_a_start(world):
    """Adam alone lowers the loss from grey; from the true maps it has nothing to do, and metallic stays the start's."""
    mesh, maps, texels, captures = world
    some = subset(captures, range(0, 30, 5))
    settings = QUICK.model_copy(update={"solver": "pictures", "iterations": 24, "rate": 0.02})
    found = recover(mesh, [texels], some, settings, 0)
    before, after = found.trace["pictures.whole"]
    assert after < 0.7 * before
    start = replace(maps, metallic=np.full_like(maps.metallic, 0.25))
    kept = recover(mesh, [texels], some, settings.model_copy(update={"iterations": 0}), 0, start=[start])
    np.testing.assert_allclose(kept.maps[0].albedo[texels.covered], maps.albedo[texels.covered], atol=1e-6)
    np.testing.assert_allclose(kept.maps[0].metallic[texels.covered], 0.25, atol=1e-6)


def test_light_between_surfaces_is_taken_off(rng):
    """An open box lights itself; with the estimate taken off the pictures its albedo is nearer to the truth."""
    device.use()
    mesh, maps = hollow(), strong_maps(3)
    maps = replace(maps, albedo=0.4 + 0.6 * maps.albedo)
    cameras = [
        look_at([4 * np.sin(a) * s, 4 * np.cos(a) * s, 4 * np.sqrt(1 - s * s)], fov=30, size=(48, 48), name=f"{a}{s}")
        for a in np.arange(6) * np.pi / 3
        for s in (0.25,)
    ]
    lights = [(directional(*LIGHTS[k % 3]),) for k in range(len(cameras))]
    pictures = photographs(mesh, [maps], cameras, lights, "mikkt", {"type": "path", "max_depth": 5}, 64)
    captures, texels = in_memory(cameras, lights, pictures), rasterise(mesh, 0, SIZE)
    wrong = []
    for bounces in (0, 1):
        settings = QUICK.model_copy(update={"iterations": 0, "bounces": bounces, "bounce_samples": 64})
        found = recover(mesh, [texels], captures, settings, 0)
        _, _, albedo = errors(found.maps[0], maps, texels.covered & (found.seen[0] >= 4))
        wrong.append(np.abs(albedo).mean())
    assert wrong[1] < 0.6 * wrong[0]


def hollow():
    """The inside of a deep bowl, open towards +Z."""
    mesh = sphere()
    centre = mesh.positions[mesh.faces].mean(axis=1)
    inside = centre[:, 2] < 0.25
    return replace(
        mesh,
        faces=mesh.faces[inside][:, ::-1],
        corner_normals=-mesh.corner_normals[inside][:, ::-1],
        corner_uvs=mesh.corner_uvs[inside][:, ::-1] * np.array([-1, 1], np.float32) + np.array([1, 0], np.float32),
        part=mesh.part[inside],
    )


@pytest.mark.parametrize("most", [MOST, 32])
def test_indirect_light_is_what_path_sees_beyond_direct(rng, monkeypatch, most):
    """Under delta lights, and under a sky with a lamp in it, in pictures that share their paths."""
    monkeypatch.setattr(indirect, "MOST", most)
    device.use()
    mesh, maps = hollow(), replace(strong_maps(3), roughness=np.full((SIZE, SIZE), 0.7, np.float32))
    camera = look_at([0.6, 0.4, 4], fov=30, size=(64, 63))
    radiance = np.full((16, 32, 3), (0.3, 0.4, 0.5), np.float32)
    radiance[4:7, 2:5] = 20
    many = [(directional(*LIGHTS[0]), Point((1.0, 1.0, 3.0), (4.0, 4.0, 4.0))), (Environment(radiance),)]
    path = {"type": "path", "rr_depth": 100}
    direct, whole = (
        photographs(mesh, [maps], [camera] * 2, many, "mikkt", path | {"max_depth": d}, 256) for d in (2, 5)
    )
    found = [light for light, _ in Indirect(mesh, [maps]).pictures(camera, many, 256, 3)]
    for part, all_of_it, coarse in zip(direct, whole, found, strict=True):
        difference = all_of_it - part
        assert coarse.shape[:2] == ((64, 63) if most == MOST else (32, 32))
        estimate = enlarged(coarse, camera.size)
        assert estimate.shape == difference.shape
        # Pixels on the silhouette show less of what the estimate says of the surface.
        inside = erode(difference.sum(-1) > 0.01, 1)
        assert inside.mean() > 0.1
        wrong = gaussian((difference - estimate) * inside[..., None], 2.0)[inside]
        assert np.sqrt((wrong**2).mean()) < 0.05 * np.sqrt((difference[inside] ** 2).mean())
        np.testing.assert_allclose(estimate[inside].mean(axis=0), difference[inside].mean(axis=0), rtol=0.02)


def test_what_mirrors_show_of_other_surfaces_is_in_the_estimate():
    """A patch of smooth metal in a bowl of paint, against paths: what it mirrors is no blur."""
    device.use()
    mesh, maps = hollow(), strong_maps(3)
    texels = rasterise(mesh, 0, SIZE)
    patch = (texels.position[..., 2] < -0.8) & texels.covered
    roughness, metallic = np.where(patch, 0.1, 0.8).astype(np.float32), patch.astype(np.float32)
    maps = replace(maps, roughness=roughness, metallic=metallic)
    camera, many = look_at([0.6, 0.4, 4], fov=30, size=(64, 64)), [(directional(*LIGHTS[0]),)]
    path = {"type": "path", "rr_depth": 100}
    direct, whole = (
        photographs(mesh, [maps], [camera], many, "mikkt", path | {"max_depth": depth}, 1024)[0] for depth in (2, 5)
    )
    estimate = Indirect(mesh, [maps]).pictures(camera, many, 256, 3)[0][0]
    shown = trace_gbuffer(draw.tracer(mesh), camera, []).position[..., 2] < -0.85
    difference = gaussian((whole - direct - estimate) * shown[..., None], 1.0)[shown]
    assert shown.sum() > 50
    assert np.sqrt((difference**2).mean()) < 0.1 * np.sqrt(((whole - direct)[shown] ** 2).mean())


def test_an_estimate_is_brought_into_proportion():
    """Twice as bright with the direct light as the picture: halved, however noisy the picture; right: as it was. Beside
    the object, and where nothing is shown, it stays; a picture coarser by two says the same."""
    light, direct = np.full((24, 24, 3), (0.1, 0.2, 0.3), np.float32), np.full((48, 48, 3), 0.5, np.float32)
    direct[:, :16] = 0
    both = np.where(direct > 0, direct + light[0, 0], 0)
    noise = 1 + 0.2 * np.random.default_rng(0).standard_normal(both.shape)
    np.testing.assert_allclose(in_proportion(light, direct, both), light, rtol=1e-5)
    halved = in_proportion(light, direct, (0.5 * both * noise).astype(np.float32))
    np.testing.assert_allclose(halved[:, 12:], 0.5 * light[:, 12:], rtol=0.05)
    np.testing.assert_array_equal(in_proportion(light, 0 * direct, 0 * both), light)


def test_pictures_of_one_place_share_their_paths(monkeypatch):
    """One camera under more lights than go into one kernel, each as if it were alone."""
    monkeypatch.setattr(indirect, "TOGETHER", 2)
    device.use()
    mesh, maps = hollow(), strong_maps(3)
    camera = look_at([0.6, 0.4, 4], fov=30, size=(32, 32))
    many = [(directional(*light),) for light in LIGHTS[:3]]
    estimate = Indirect(mesh, [maps])
    found = [light for light, _ in estimate.pictures(camera, many, 16, 3)]
    assert len(found) == len(many)
    for own, picture in zip(many, found, strict=True):
        np.testing.assert_allclose(picture, estimate.pictures(camera, [own], 16, 3)[0][0], rtol=1e-3, atol=1e-5)
    assert np.abs(found[0] - found[1]).max() > 0.01


def test_with_light_between_surfaces_known_the_solver_begins_anew(world, monkeypatch):
    """Once before any estimate and after each among the rounds, always from the same start, and then with targets from
    which the estimate is taken off, and not those that rounds have corrected. The last target is that of the stated
    deviations."""
    from mistyle.solver.texels import rounds as recover_solve
    from mistyle.solver.texels import solve as recover_texels
    from mistyle.solver.texels.levenberg_marquardt import Problem

    mesh, _, texels, captures = world
    some = subset(captures, range(0, 30, 5))
    events, targets, light = [], [], 0.01
    solve, retarget = recover_solve.first_solve, Problem.retarget

    def spied(problem, begin, *rest):
        events.append(("solve", begin[0].tobytes()))
        return solve(problem, begin, *rest)

    def heard(problem, rgb):
        events.append(("target",))
        targets.append(rgb.copy())
        retarget(problem, rgb)

    def estimated(context, renderer, table, sampling, progress):
        events.append(("estimate", sampling[0]))
        for k, camera in enumerate(context.captures.cameras):
            yield k, np.full((*camera.size, 3), light, np.float32), None

    monkeypatch.setattr(recover_solve, "first_solve", spied)
    monkeypatch.setattr(Problem, "retarget", heard)
    monkeypatch.setattr(recover_texels, "estimate_indirect", estimated)
    settings = QUICK.model_copy(update={"iterations": 0, "rounds": 1, "bounces": 2, "bounce_samples": 16})
    recover(mesh, [texels], some, settings, 0)
    begun = next(e for e in events if e[0] == "solve")
    one = ("target",)
    assert events == [begun, one, ("estimate", 2), one, begun, one, ("estimate", 16), one, begun, one, one, one, one]
    tangents = collecting.tangents_of(mesh, settings.frame)
    first = collect_observations(
        draw.tracer(mesh), [texels], some, tangents, ObservationOptions(facing=settings.facing)
    ).observations.rgb
    for target in (targets[1], targets[3]):
        np.testing.assert_allclose(target, first - light, atol=1e-6)


def test_the_last_estimates_have_most_of_the_samples():
    assert estimates(RecoverSettings(), 48) == ([16, 128, 128], [16, 16, 16])
    assert passes(RecoverSettings(), 48) == [(240, 0)] * 5 + [(240, 16), (240, 16), (480, 16)]
    assert passes(RecoverSettings(joint=0), 48) == [(240, 0)] * 5 + [(240, 16), (240, 16), (480, 128)]
    assert estimates(RecoverSettings(bounces=0), 48) == ([], [])
    assert estimates(RecoverSettings(bounces=1, bounce_samples=5), 48) == ([5], [])
    assert estimates(RecoverSettings(bounces=2, bounce_samples=5, joint=0), 48) == ([5], [5])
    assert passes(RecoverSettings(bounces=2, iterations=37), 6) == [(12, 0), (25, 16)]
    assert passes(RecoverSettings(), 1080) == [(2160, 0)]
    for alone in ({"solver": "texels"}, {"iterations": 0}, {"iterations": 100}):
        assert estimates(RecoverSettings(bounces=3, **alone), 48) == ([16, 128, 128], [])


def test_whole_pictures_leave_no_texel_as_open_as_the_solver_did():
    """The usual noise stays what it is; a multiple beyond LEFT, and what nothing was told of, end at LEFT times it."""
    noise = np.full((6, 7), 0.002, np.float32)
    noise[4], noise[5] = 0.06, NOTHING
    seen = np.array([9, 9, 9, 9, 3, 0])
    found = TexelEstimate(np.zeros((6, 8), np.float32), noise, np.ones(6, np.float32), noise, seen, seen, True)
    left = recover_pictures._unconstrained_std(found)
    np.testing.assert_allclose(left[:4, :6], 0.002, rtol=0.03)
    bound = recover_pictures.LEFT[:6] * 0.002
    assert (left[4:, :6] < bound).all() and (left[4:, :6] > 0.95 * bound).all()
    np.testing.assert_array_equal(left[:, 6], noise[:, 6])


def test_what_is_believed_of_metals_is_one_prior(rng: np.random.Generator):
    """The neighbours' prior, metal or not, and how much metals reflect: their sum is the one prior and its constant."""
    from mistyle.solver import prior as recover_prior

    x, mean, prior = (rng.uniform(0.1, 2, (20, 7)).astype(np.float32) for _ in range(3))
    metal = np.repeat([0, 1], 10).astype(np.float32)
    around, weight, constant = recover_prior.combine_class_prior(mean, prior, metal)
    wanted = ((x - mean) ** 2 * prior).sum(axis=1) + (x[:, 6] - metal) ** 2 / recover_prior.METAL_SPREAD**2
    wanted += metal * ((x[:, :3] - recover_prior.METAL_ALBEDO) ** 2).sum(axis=1) / recover_prior.METAL_ALBEDOS**2
    np.testing.assert_allclose(((x - around) ** 2 * weight).sum(axis=1) + constant, wanted, rtol=1e-4)


def test_black_that_no_gloss_shows_on_is_what_the_setting_says():
    """Smooth black paint that is seen often costs more or less than a metal, and nothing where its gloss shows."""
    from mistyle.solver.prior import OFTEN, log_prior_penalty

    values = np.zeros((4, 7), np.float32)
    values[:, 5] = 0.1, 0.8, 0.1, 0.1
    values[2, 6], seen = 1, np.array([OFTEN, OFTEN, OFTEN, 1])
    smooth, matt, metal, once = log_prior_penalty(values, seen, "metal")
    assert matt == 0 < once < metal < smooth
    smooth, matt, metal, once = log_prior_penalty(values, seen, "plastic")
    assert matt == 0 < once < smooth < metal


@pytest.mark.parametrize("unlike", [0.0, 0.5])
def test_where_texels_and_pictures_differ_observations_count_for_less(world, monkeypatch, unlike):
    """By what the picture drawn of the texels differs from their own radiance; no less where they agree."""
    from mistyle.solver.texels import rounds as recover_solve
    from mistyle.solver.texels.levenberg_marquardt import Problem

    mesh, _, texels, captures = world
    few, tangents = subset(captures, range(0, 30, 5)), collecting.tangents_of(mesh, "mikkt")
    heard = {"targets": [], "weights": []}
    for name, kept in (("retarget", "targets"), ("reweight", "weights")):
        real = getattr(Problem, name)
        monkeypatch.setattr(Problem, name, lambda own, x, f=real, kept=kept: (heard[kept].append(x), f(own, x))[1])
    monkeypatch.setattr(recover_solve, "UNLIKE", unlike)
    recover(mesh, [texels], few, QUICK.model_copy(update={"iterations": 0, "rounds": 1}), 0)
    seen = collect_observations(
        draw.tracer(mesh), [texels], few, tangents, ObservationOptions(facing=QUICK.facing)
    ).observations
    apart = np.abs(heard["targets"][0] - seen.rgb).max(axis=1)
    assert np.quantile(apart * seen.weight, 0.9) > 1
    np.testing.assert_allclose(1 / heard["weights"][0], 1 / seen.weight + unlike * apart, rtol=1e-4)


def test_steps_are_as_long_as_the_noise():
    """Twice the usual noise, twice the step, but no longer ones of roughness; a texel never seen takes the longest, a
    tilt that its neighbours decided hardly moves, and what is not covered keeps the pace of what lies beside it."""
    noise = np.full((6, 7), 0.02, np.float32)
    noise[1], noise[2], noise[3], noise[5] = 0.04, 0.0001, NOTHING, NOTHING
    seen, decided = np.array([9, 9, 9, 0, 9, 0]), np.array([1, 1, 1, 1, 0.25, 1], np.float32)
    found = TexelEstimate(np.zeros((6, 8), np.float32), noise, decided, noise, seen, seen, True)
    where = Atlas(((1, 6),), (np.arange(6)[None] < 5,), (np.array([0, 1, 2, 3, 4, 4]),))
    shares = recover_pictures._rate_factors(found, where)
    np.testing.assert_array_equal(shares[5], shares[4])
    np.testing.assert_allclose(shares[:4, 0], [1, 2, SHORTEST, 3], rtol=1e-6)
    np.testing.assert_allclose(shares[:5, 3], [1, 2, SHORTEST, 3, 0.5], rtol=1e-6)
    np.testing.assert_allclose(shares[:4, 5], [1, 1, SHORTEST, 1], rtol=1e-6)


def test_cameras_of_one_place_are_found():
    one, other = look_at([0, 0, 4], fov=30, size=(32, 32)), look_at([0, 1, 4], fov=30, size=(32, 32))
    wider = replace(one, size=(32, 40))
    assert by_camera([one, other, replace(one, name="again"), wider]) == [[0, 2], [1], [3]]


def test_averages_stay_on_their_surface(rng):
    """A constant stays, noise gets less, and nothing crosses a step in depth, a crease or the silhouette."""
    rows, columns = np.mgrid[0:40, 0:40].astype(np.float32)
    depth = np.where(columns < 20, 0, 30) - 0.75 * np.maximum(rows - 19.5, 0)
    position = np.stack([columns, rows, depth], axis=-1).astype(np.float32)
    normal = np.zeros((40, 40, 3), np.float32)
    normal[:20, :, 2], normal[20:] = 1, (0, 0.6, 0.8)
    inside = rows > 4
    level = np.where(columns < 20, 1, 3) + np.where(rows < 20, 0, 5)
    light = np.repeat(level[..., None], 3, axis=2).astype(np.float32)
    light[~inside] = 100
    unit = np.ones((40, 40), np.float32)
    np.testing.assert_allclose(averaged(light, position, normal, unit, inside)[inside], light[inside], rtol=1e-4)
    noisy = light * (1 + 0.2 * rng.standard_normal(light.shape)).astype(np.float32)
    smooth = averaged(noisy, position, normal, unit, inside)
    # The weights 1, 1/2 and 1/4 leave 0.375 of it, more at the borders.
    assert 0.3 < (smooth - light)[inside].std() / (noisy - light)[inside].std() < 0.42
    light[30, 30] = 1000  # brought down to FIREFLY times the 8 around it, of which it is a quarter then
    expected = 8 * (FIREFLY + 3) / 4
    np.testing.assert_allclose(averaged(light, position, normal, unit, inside)[30, 30], expected, rtol=0.01)


def test_metal_is_told_from_dark_paint():
    """Stripes of metal and of paint so dark that it is little more than its gloss, which dull metal can have too."""
    device.use()
    mesh, maps = sphere(), strong_maps(1)
    metal = np.tile((np.arange(SIZE) // 16 % 2).astype(np.float32), (SIZE, 1))
    albedo = maps.albedo * np.where(metal > 0.5, 1, 0.08)[..., None].astype(np.float32)
    maps = replace(maps, albedo=albedo, metallic=metal, roughness=np.clip(maps.roughness, 0.3, 0.8))
    cameras = [replace(c, name=f"{c.name}.{k}") for c in fibonacci(VIEWS, RESOLUTION) for k in range(3)]
    lights = [(directional(*light),) for _ in range(VIEWS) for light in LIGHTS]
    captures = in_memory(cameras, lights, photographs(mesh, [maps], cameras, lights, "mikkt", DIRECT, 16))
    texels = rasterise(mesh, 0, SIZE)
    settings = QUICK.model_copy(update={"metallic": True, "solver": "texels"})
    found = recover(mesh, [texels], captures, settings, 0)
    chosen = texels.covered & (found.views[0] >= 3)
    right, wrong = (found.maps[0].metallic > 0.5) == (metal > 0.5), np.abs(found.maps[0].metallic - metal)
    for kind, least in ((metal > 0.5, 0.95), (metal < 0.5, 0.82)):
        assert right[chosen & kind].mean() > least
        assert np.median(wrong[chosen & kind]) < 0.05


@pytest.mark.parametrize("frame", ["mikkt", "mitsuba"])
def test_texel_frames_are_those_of_the_rays(world, frame):
    mesh, _, texels, captures = world
    tangents = collecting.tangents_of(mesh, frame)
    traced = draw.tracer(mesh)
    from mistyle.render.deferred import integrator as deferred

    surface = deferred.trace(traced, [captures.cameras[0]], tangents)
    on = np.flatnonzero(surface.mask)
    face = draw.gbuffer(traced, captures.cameras[0]).face.ravel()[on]
    ours = texel_frames(mesh, face, surface.position[on], surface.normal[on], tangents)
    theirs = np.stack([np.array(axis).T[on] for axis in (surface.frame.s, surface.frame.t, surface.frame.n)], axis=1)
    np.testing.assert_allclose(ours, theirs, atol=2e-3)


def test_observations_are_the_pictures_at_the_texels(world):
    """What is observed is what the model of the true material predicts, up to the pixels' size."""
    from mistyle.solver.texels.levenberg_marquardt import Options, Problem

    mesh, maps, texels, captures = world
    observed = collect_observations(draw.tracer(mesh), [texels], captures, collecting.tangents_of(mesh, "mikkt"))
    problem = Problem(observed.points, observed.rig, observed.observations, Options())
    parts = [maps.albedo.reshape(-1, 3), maps.normal.reshape(-1, 3)[:, :2], maps.roughness.reshape(-1, 1)]
    true = np.concatenate([*parts, maps.metallic.reshape(-1, 1)], axis=1)[observed.texel]
    wrong = problem.predict(true) - observed.observations.rgb
    assert len(wrong) > 5 * len(observed.texel)
    assert np.median(np.abs(wrong)) < 0.01 * np.abs(observed.observations.rgb).max()
    assert (observed.views <= observed.seen).all() and (observed.views * 3 >= observed.seen).all()


def test_a_look_up_moves_to_the_pixels_that_count():
    """Between four pixels at (0.2, 0.3): by hand, for each set of those that count."""
    ramp = np.add.outer(10.0 * np.arange(8), np.arange(8))[..., None].repeat(3, axis=-1).astype(np.float32)
    right_dark = np.ones((8, 8), np.int8)
    right_dark[:, 4] = 0
    edge = np.where(np.arange(8) == 3, -1, 1).astype(np.int8) * np.ones((8, 1), np.int8)

    def seen(own, lit=(), usable=None, soft=True, move=1.5):
        place = np.array([3 * 8 + 3]), np.float32([0.2]), np.float32([0.3])
        visible = VisibleTexels(np.array([7]), *place, np.array(own, bool)[:, None], np.ones(1, np.float32))
        usable = np.ones((8, 8), bool) if usable is None else usable
        return recover_observe._observe(ramp, usable, lit, soft, visible, move)

    whole, left, top = (1, 1, 1, 1), (1, 0, 1, 0), (1, 1, 0, 0)
    for own, place in (
        (whole, (0.2, 0.3)), (left, (0, 0.3)), (top, (0.2, 0)), ((1, 1, 1, 0), (0, 0.3)), ((1, 0, 0, 1), (0, 0)),
        ((0, 1, 0, 1), (1, 0.3)), ((0, 0, 1, 1), (0.2, 1)), ((0, 0, 0, 1), (1, 1)),
    ):  # fmt: skip
        near, rgb, bits, chosen, u, v, share = seen(own)
        assert (near.item(), bits.item(), chosen.item()) == (7, 0, 0)
        np.testing.assert_allclose((u[0], v[0]), place, atol=1e-6)
        np.testing.assert_allclose(rgb[0], 33 + place[0] + 10 * place[1], rtol=1e-6)
        moved = (place[0] - 0.2) ** 2 + (place[1] - 0.3) ** 2
        np.testing.assert_allclose(share[0], 1 / (1 + recover_observe.MOVED * moved), rtol=1e-6)
        assert len(seen(own, move=0.0)[0]) == (own == whole)
    assert len(seen((0, 0, 0, 0))[0]) == 0
    # Pixels in another light than the nearest are as good as none; so are those with a shadow's edge in them.
    assert seen(whole, [right_dark])[4].item() == 0 and seen(whole, [right_dark])[2].item() == 1
    assert seen(whole, [edge, right_dark])[4].item() == 1 and seen(whole, [edge, right_dark])[2].item() == 1
    assert len(seen(whole, [0 * right_dark], soft=False)[0]) == 0 and len(seen(whole, [0 * right_dark])[0]) == 1
    # What the picture's own mask leaves out, and its neighbours, is not looked at.
    hidden = np.ones((8, 8), bool)
    hidden[3, 1] = False
    assert seen(whole, usable=hidden)[4].item() == pytest.approx(0.2)
    hidden[3, 2] = False
    assert seen(whole, usable=hidden)[4].item() == 1


def test_pixels_with_an_edge_in_them_do_not_count():
    """A plane with a step in depth through column 4: pixels whose corners lie on both sides are mixtures."""
    camera = look_at([0, 0, 4], [0, 0, 0], fov=30, size=(8, 8), name="front")

    def plane(at, step):
        depth = np.where(pixel_centres(at.size)[..., 0] > step, 4.5, 4.0).ravel()
        position = world_from_px(at, pixel_centres(at.size).reshape(-1, 2), depth).reshape(*at.size, 3)
        normal = np.broadcast_to(np.float32([0, 0, 1]), position.shape)
        lit = pixel_centres(at.size)[..., 1] > step - 2
        return GBuffer(position.astype(np.float32), normal, np.ones(at.size, bool), (lit,))

    # The picture of the corners begins half a pixel further out.
    seen, corners = plane(camera, 4.3), plane(of_corners(camera), 4.8)
    wanted = np.ones((8, 8), bool)
    wanted[:, 4] = False
    assert np.array_equal(recover_observe.unmixed_pixels(camera, seen, corners), wanted)
    steady = recover_observe._uniform_light(seen.lit[0], corners.lit[0])
    assert np.array_equal(steady, np.repeat([0, 0, -1, 1, 1, 1, 1, 1], 8).reshape(8, 8))
    hole = corners.mask.copy()
    hole[2, 2] = False
    wanted[1:3, 1:3] = False
    assert np.array_equal(recover_observe.unmixed_pixels(camera, seen, replace(corners, mask=hole)), wanted)


def test_pictures_that_say_nothing(world):
    mesh, _, _, captures = world
    away = look_at([0, 0, 4], [0, 0, 8], fov=30, size=(RESOLUTION, RESOLUTION), name="away")
    cameras = [*captures.cameras[:9], away]
    pictures = [captures.load(k)[0] for k in range(9)] + [np.ones((RESOLUTION, RESOLUTION, 3), np.float32)]
    masks = [np.ones((RESOLUTION, RESOLUTION), bool)] * 10
    pictures[1] = np.zeros_like(pictures[1])
    masks[2] = np.zeros_like(masks[2])
    notes: list[str] = []
    kept = validate_captures(mesh, in_memory(cameras, captures.lights[:10], pictures, masks), notes)
    assert len(kept) == 7
    assert any("'view0.1'" in n and "all black" in n for n in notes)
    assert any("'view0.2'" in n and "saturated" in n for n in notes)
    assert any("'away'" in n and "cannot see the mesh" in n for n in notes)
    few: list[str] = []
    validate_captures(mesh, subset(captures, [0, 1, 3]), few)
    assert any("2 different view(s)" in n and "singular" in n for n in few)
    with pytest.raises(InputRefused, match="None of 2"):
        validate_captures(mesh, in_memory([away, away], captures.lights[:2], pictures[:2]), [])
    with pytest.raises(InputRefused, match="80x80"):
        validate_captures(mesh, in_memory(cameras[:1], captures.lights[:1], [np.ones((40, 30, 3), np.float32)]), [])
    with pytest.raises(InputRefused, match="three views"):
        validate_captures(mesh, subset(captures, []), [])


def test_a_gradient_that_is_no_number_stops_at_its_texel():
    import drjit as dr
    import mitsuba as mi

    from mistyle.solver.pictures.adam import Descent, table_on_device

    device.use()
    descent = Descent([(4, 4), (2, 2)], (1, 1, 1, 1, 1, 1, 0, 0))
    table = np.full((20, 8), 0.5, np.float32)
    gradient = np.ones((20, 8), np.float32)
    gradient[17, 5] = np.nan
    x = table_on_device(table)
    for picture in (3, 4):
        x = descent.step(x, mi.Float(gradient.ravel()), 0.01, picture)
    result = np.array(x).reshape(-1, 8)
    assert descent.stopped() == [(17, "roughness", 3)]
    np.testing.assert_array_equal(result[17], table[17])
    rest = np.delete(result, 17, axis=0)
    np.testing.assert_allclose(rest[:, :6], 0.48, atol=1e-5)
    np.testing.assert_array_equal(rest[:, 6:], 0.5)
    assert dr.width(x) == 160


@pytest.mark.parametrize("levels", [1, 3])
def test_descent_is_adam_with_masked_updates(rng, levels):
    """Against Adam in NumPy on every level; levels see sums of 2 x 2 and move by bilinear interpolation."""
    import mitsuba as mi

    from mistyle.core.image import resize
    from mistyle.solver.pictures.adam import AdamOptions, Descent, table_on_device

    device.use()
    size = (32, 32)
    shares = rng.random((32 * 32, 8)).astype(np.float32)
    descent = Descent([size], (1, 1, 1, 1, 1, 1, 1, 0), AdamOptions(levels=levels), shares=shares)
    table = np.full((32 * 32, 8), 0.5, np.float32)
    x, wanted = table_on_device(table), table[:, :7].reshape(*size, 7).astype(np.float64)
    first, second, age = ([np.zeros((32 >> k, 32 >> k, c)) for k in range(levels)] for c in (7, 7, 1))
    for _ in range(3):
        gradient = rng.standard_normal((32 * 32, 8)).astype(np.float32)
        gradient[rng.random(32 * 32) < 0.3] = 0
        x = descent.step(x, mi.Float(gradient.ravel()), 0.01, 0)
        level = gradient[:, :7].reshape(*size, 7).astype(np.float64)
        for k in range(levels):
            if k:
                level = level[::2, ::2] + level[::2, 1::2] + level[1::2, ::2] + level[1::2, 1::2]
            on = (level != 0).any(-1, keepdims=True)
            age[k] += on
            first[k] = np.where(on, 0.9 * first[k] + 0.1 * level, first[k])
            second[k] = np.where(on, 0.99 * second[k] + 0.01 * level**2, second[k])
            with np.errstate(divide="ignore", invalid="ignore"):
                step = first[k] / (1 - 0.9 ** age[k]) / (np.sqrt(second[k] / (1 - 0.99 ** age[k])) + 1e-12)
            step = np.where(on, step, 0).astype(np.float32)
            wanted -= 0.01 * (resize(step, size) if k else step) * shares[:, :7].reshape(*size, 7)
    np.testing.assert_allclose(np.array(x).reshape(*size, 8)[..., :7], wanted, atol=2e-5)
