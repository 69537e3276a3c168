"""The last steps through `prb`, on a place where light between surfaces matters; light records as emitters."""

from typing import Any

import numpy as np
import pytest

from mistyle.core.camera import look_at
from mistyle.core.capture import in_memory
from mistyle.core.image import gaussian
from mistyle.core.light import Ambient, Directional, Environment, Point, SceneLights, SphericalGaussian
from mistyle.core.maps import Maps
from mistyle.core.mesh import Mesh
from mistyle.render.mitsuba import device
from mistyle.render.mitsuba import scene as scenery
from mistyle.render.mitsuba.emitters import emitters
from mistyle.solver.pictures.polish import PolishSettings, polish

SIZE, RESOLUTION = 24, 48


def corner() -> Mesh:
    """Three squares that meet in a corner and face each other, one third of the atlas each."""
    positions, faces, normals, uvs = [], [], [], []
    for axis in range(3):
        u, v = np.eye(3)[(axis + 1) % 3], np.eye(3)[(axis + 2) % 3]
        first = len(positions)
        positions += [np.full(3, -0.35) + 0.8 * (a * u + b * v) for a, b in ((0, 0), (1, 0), (1, 1), (0, 1))]
        square = [((axis + 0.1 + 0.8 * a) / 3, 0.1 + 0.8 * b) for a, b in ((0, 0), (1, 0), (1, 1), (0, 1))]
        for face in ((0, 1, 2), (0, 2, 3)):
            faces.append([first + k for k in face])
            uvs.append([square[k] for k in face])
            normals.append([np.eye(3)[axis]] * 3)
    arrays = [np.array(values, np.float32) for values in (positions, normals, uvs)]
    return Mesh(arrays[0], np.array(faces, np.int32), arrays[1], arrays[2], np.zeros(6, np.int32), ("all",))


def plain(albedo) -> Maps:
    size = (SIZE, SIZE)
    normal = np.zeros((*size, 3), np.float32)
    normal[..., 2] = 1
    colour = np.broadcast_to(np.float32(albedo), (*size, 3)).copy()
    return Maps(colour, normal, np.full(size, 0.7, np.float32), np.zeros(size, np.float32), np.ones(size, bool))


def coloured() -> Maps:
    """Each wall of another bright colour, with a stripe."""
    maps = plain((0.8, 0.8, 0.8))
    third = SIZE // 3
    for k, colour in enumerate(((0.9, 0.3, 0.3), (0.85, 0.85, 0.85), (0.3, 0.4, 0.9))):
        maps.albedo[:, k * third : (k + 1) * third] = colour
    maps.albedo[SIZE // 2 : SIZE // 2 + 4] *= 0.6
    return maps


def scene_of(mesh, maps, camera, lights) -> Any:
    import mitsuba as mi

    shapes = scenery.object_shapes(mesh, [maps], frame="mikkt")
    described = {"type": "scene", "sensor": scenery.sensor_dict(camera, 16), **shapes}
    described |= {f"light{k}": light for k, light in enumerate(emitters(lights, camera))}
    return mi.load_dict(described, optimize=False)


def picture(mesh, maps, camera, lights, spp=256, depth=6, seed=5) -> np.ndarray:
    import mitsuba as mi

    path: Any = mi.load_dict({"type": "path", "max_depth": depth, "hide_emitters": True})
    scene = scene_of(mesh, maps, camera, lights)
    drawn: Any = mi
    return np.array(drawn.render(scene, integrator=path, spp=spp, seed=seed))[..., :3].astype(np.float32)


@pytest.fixture(scope="module")
def room():
    device.use()
    mesh, maps = corner(), coloured()
    eyes = ((2.5, 2, 2.2), (1.5, 3, 2), (3, 1.4, 1.5), (2, 1.5, 3))
    size = (RESOLUTION, RESOLUTION)
    cameras = [look_at(eye, fov=22, size=size, name=f"v{k}") for k, eye in enumerate(eyes)]
    lights = [(Directional((0.577, 0.577, 0.577), (2.5, 2.5, 2.5)),)] * len(cameras)
    pictures = [picture(mesh, maps, c, rig) for c, rig in zip(cameras, lights, strict=True)]
    return mesh, maps, in_memory(cameras, lights, pictures)


def seen(mesh) -> np.ndarray:
    from mistyle.atlas.texels import rasterise

    return rasterise(mesh, 0, SIZE).covered


def test_light_between_walls_leaves_the_albedo(room):
    """A fit to direct light alone takes the colour that the walls throw at each other for albedo; this takes it off."""
    mesh, truth, captures = room
    at = seen(mesh)
    baked = plain((0.5, 0.5, 0.5))
    direct_only = [picture(mesh, truth, captures.cameras[0], captures.lights[0], depth=d) for d in (2, 6)]
    gain = direct_only[1][direct_only[1] > 0.05].mean() / direct_only[0][direct_only[0] > 0.05].mean()
    assert gain > 1.2  # otherwise this scene would show nothing
    start = Maps(np.clip(truth.albedo * np.float32(gain), 0, 1), *(getattr(baked, n) for n in _REST))
    done = polish(mesh, [start], captures, PolishSettings(40, rate=0.03, spp=16, spp_grad=4))

    def wrong(maps):
        return float(np.abs(maps.albedo - truth.albedo)[at].mean())

    assert done.loss[1] < 0.5 * done.loss[0]
    assert wrong(done.maps[0]) < 0.4 * wrong(start), (wrong(start), wrong(done.maps[0]))


_REST = ("normal", "roughness", "metallic", "known")


def test_what_is_not_fitted_stays_and_a_worse_result_is_dropped(room):
    mesh, truth, captures = room
    done = polish(mesh, [truth], captures, PolishSettings(3, rate=0.5, spp=4))
    assert done.loss[1] > done.loss[0]
    for name in ("albedo", *_REST):
        np.testing.assert_array_equal(getattr(done.maps[0], name), getattr(truth, name))
    kept = polish(mesh, [plain((0.2, 0.2, 0.2))], captures, PolishSettings(2, rate=0.02, spp=4)).maps[0]
    np.testing.assert_array_equal(kept.metallic, 0)
    assert not np.array_equal(kept.albedo, plain((0.2, 0.2, 0.2)).albedo)


@pytest.mark.parametrize(
    "lights",
    [
        (Ambient((0.5, 0.4, 0.3)),),
        (SphericalGaussian((0.0, 0.0, 1.0), 4.0, (2.0, 1.0, 0.5)),),
        (Ambient((0.2, 0.2, 0.2)), SphericalGaussian((0.6, 0.0, 0.8), 3.0, (1.0, 1.0, 1.0))),
        (
            Environment(np.random.default_rng(3).random((8, 16, 3)).astype(np.float32), 40.0, 1.5),
            Ambient((0.1, 0.1, 0.1)),
        ),
        (Point((0.5, 0.6, 1.5), (3.0, 3.0, 2.0)), Directional((0.0, 0.6, 0.8), (1.0, 1.0, 1.0), "camera")),
    ],
)
def test_emitters_light_a_surface_as_the_records_say(lights):
    """The same picture as the deferred renderer, which sums the records themselves."""
    from mistyle.render.deferred.material_table import pack
    from mistyle.render.deferred.renderer import MaterialRenderer, RenderOptions
    from mistyle.render.mitsuba.draw import tracer

    device.use()
    mesh, maps = corner(), coloured()
    camera = look_at((2.5, 2, 2.2), fov=22, size=(RESOLUTION, RESOLUTION), name="v")
    shown = picture(mesh, maps, camera, lights, spp=1024, depth=2)
    captures = in_memory([camera], [lights], [shown])
    renderer = MaterialRenderer(tracer(mesh), captures, [(SIZE, SIZE)], RenderOptions(directions=512))
    image, coverage = renderer.image_and_coverage(pack([maps]), 0)
    inside = coverage > 0.999
    # Each pixel sees a few of the soft light's directions, its neighbours others: their mean is what has to agree.
    blurred = [gaussian(np.where(inside[..., None], p, 0).astype(np.float32), 2.0)[inside] for p in (image, shown)]
    wrong = np.sqrt(((blurred[0] - blurred[1]) ** 2).mean() / (blurred[1] ** 2).mean())
    assert wrong < 0.01
    # A light that is turned the wrong way, or counted twice, is another picture altogether.
    assert abs(blurred[0].mean() / blurred[1].mean() - 1) < 0.005


def test_lights_of_a_scene_file_are_refused():
    camera = look_at((0, 0, 4), fov=30, size=(8, 8), name="v")
    with pytest.raises(ValueError, match="SceneLights"):
        emitters((SceneLights("studio.xml"),), camera)


def test_recover_ends_with_it_when_asked(room):
    """The fit of direct light first, then the steps through prb; what they lower is in the trace."""
    from mistyle.atlas.texels import rasterise
    from mistyle.solver.recover import recover
    from mistyle.solver.settings import RecoverSettings

    mesh, truth, captures = room
    texels = rasterise(mesh, 0, SIZE)
    quick = RecoverSettings(rounds=1, iterations=0, bounces=1, polish=24, polish_rate=0.02)
    found = recover(mesh, [texels], captures, quick, 0)
    before, after = found.trace["polish.whole"]
    assert after < before and len(found.trace["polish.loss"]) == 24
    plain_fit = recover(mesh, [texels], captures, quick.model_copy(update={"polish": 0}), 0)
    wrong = [np.abs(f.maps[0].albedo - truth.albedo)[texels.covered].mean() for f in (plain_fit, found)]
    assert wrong[1] < wrong[0]
