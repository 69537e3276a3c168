"""Our BSDFs in Mitsuba: sampling against densities, renders against the deferred sum, gradients against differences."""

from typing import Any

import numpy as np
import pytest

from mistyle.core.light import direction_in_world
from mistyle.core.mesh import Mesh, weld
from mistyle.geometry.tangents import mikktspace
from mistyle.render.deferred import bsdf
from mistyle.render.deferred import integrator as deferred
from mistyle.render.mitsuba import device, draw, plugins
from mistyle.render.mitsuba import scene as scenery
from tests.render.deferred.test_bsdf import albedo_of, cases, evaluate, loaded
from tests.render.deferred.test_seam import KEY, Path, crop, random_maps, tables, torus
from tests.support.helpers import from_front

SIZE = (32, 32)


def gltf_dict(colour=(0.8, 0.5, 0.2), roughness=0.4, metallic=0.3, **more):
    base = {"type": "rgb", "value": list(colour)}
    return {"type": plugins.GLTF, "base_color": base, "roughness": roughness, "metallic": metallic, **more}


def charts() -> Mesh:
    """The torus with its quarters' charts as they are, mirrored, turned by 90 degrees, turned by 30 and mirrored."""
    mesh = torus(parts=1)
    quarter = np.minimum((mesh.corner_uvs[:, :, 0].mean(1) * 4).astype(int), 3)
    c, s = np.cos(np.pi / 6), np.sin(np.pi / 6)
    turns = np.array([[[1, 0], [0, 1]], [[-1, 0], [0, 1]], [[0, -1], [1, 0]], [[c, s], [s, -c]]])
    uvs = np.einsum("fij,fcj->fci", turns[quarter], mesh.corner_uvs)
    return Mesh(**{**vars(mesh), "corner_uvs": uvs.astype(np.float32)})


def tangents_of(mesh):
    welded = weld(mesh)
    return mikktspace(welded.positions, welded.normals, welded.uvs, welded.faces)


def scene_of(mesh, maps, camera, light, integrator=None, **options):
    """Rays through pixel centres and one delta light: no noise. `options` go to `object_shapes`."""
    import mitsuba as mi

    sensor = scenery.sensor_dict(camera)
    # Without jitter and with one sample per pixel the stratified sampler stays in the pixel's centre.
    sensor["sampler"] = {"type": "stratified", "sample_count": 1, "jitter": False}
    emitter = {"type": "directional", "direction": (-direction_in_world(light, camera)).tolist()}
    emitter["irradiance"] = {"type": "rgb", "value": list(light.irradiance)}
    described = {"type": "scene", "sensor": sensor, "light": emitter}
    described["integrator"] = integrator or {"type": "direct", "emitter_samples": 1, "bsdf_samples": 0}
    return mi.load_dict(described | scenery.object_shapes(mesh, maps, **options))


def picture(scene, **options):
    import mitsuba as mi

    chosen: dict[str, Any] = {"spp": 1, "seed": 0} | options
    return np.array(mi.render(scene, **chosen))[..., :3]


def points(given):
    """Interactions at uv (0.5, 0.5) in the plane z = 0, without a shape."""
    import drjit as dr
    import mitsuba as mi

    point = dr.zeros(mi.SurfaceInteraction3f, len(given["wi"]))
    point.wi, point.sh_frame = mi.Vector3f(given["wi"].T), mi.Frame3f(mi.Vector3f(0, 0, 1))
    point.uv = mi.Point2f(0.5, 0.5)
    return point


@pytest.mark.parametrize("specular", [0.5, 0.0])
def test_gltf_plugin_equals_the_function(rng, specular):
    device.use()
    import mitsuba as mi

    plugins.register()
    plugins.register()  # twice is once
    given = cases(rng, 4000)
    plugin = mi.load_dict(gltf_dict(specular=specular))
    value = np.array(plugin.eval(mi.BSDFContext(), points(given), mi.Vector3f(given["wo"].T))).T
    arrays = loaded(given)
    expected = from_front("gltf", arrays["wi"], arrays["wo"], mi.Color3f(0.8, 0.5, 0.2), 0.4, 0.3, specular=specular)
    np.testing.assert_allclose(value, np.array(expected).T, rtol=1e-5, atol=1e-9)
    assert 0.25 < (value > 0).any(-1).mean() < 0.4  # both directions in front


@pytest.mark.parametrize("name", [plugins.GLTF, plugins.NORMALMAP])
@pytest.mark.parametrize("wi", [(0.0, 0.0, 1.0), (0.48, -0.6, 0.64), (0.8, 0.5, 0.3317)])
@pytest.mark.parametrize(("roughness", "metallic"), [(0.5, 0.0), (0.3, 1.0)])
def test_samples_follow_the_density(name, wi, roughness, metallic, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # a test that fails leaves its data there
    device.use()
    import mitsuba as mi
    from mitsuba.chi2 import BSDFAdapter, ChiSquareTest, SphericalDomain

    plugins.register()
    described = gltf_dict(roughness=roughness, metallic=metallic)
    if name == plugins.NORMALMAP:
        normal = {"type": "rgb", "value": [0.62, 0.45, 0.95]}
        described = {"type": name, "normalmap": normal, "bsdf": described}
    sample, density = BSDFAdapter(name, described, wi=mi.ScalarVector3f(wi))
    test = ChiSquareTest(SphericalDomain(), sample, density, sample_dim=3, sample_count=200_000, res=51, ires=32)
    assert test.run(0.01 / 12)


@pytest.mark.parametrize("two_sided", [False, True])
def test_sample_weights_are_value_over_density(rng, two_sided):
    device.use()
    import mitsuba as mi

    plugins.register()
    given = cases(rng, 4000)
    nested = {"type": plugins.NORMALMAP, "normalmap": {"type": "rgb", "value": [0.6, 0.45, 0.95]}, "bsdf": gltf_dict()}
    plugin = mi.load_dict({"type": "twosided", "bsdf": nested} if two_sided else nested)
    point, context = points(given), mi.BSDFContext()
    u = rng.random((3, 4000)).astype(np.float32)
    sampled, weight = plugin.sample(context, point, mi.Float(u[0]), mi.Point2f(u[1:]))
    value, density = plugin.eval_pdf(context, point, sampled.wo)
    np.testing.assert_allclose(np.array(value), np.array(plugin.eval(context, point, sampled.wo)), rtol=1e-6)
    np.testing.assert_allclose(np.array(density), np.array(plugin.pdf(context, point, sampled.wo)), rtol=1e-6)
    usable = np.array(sampled.pdf) > 0
    assert abs(usable.mean() - (0.9 if two_sided else 0.45)) < 0.08
    np.testing.assert_allclose(np.array(sampled.pdf)[usable], np.array(density)[usable], rtol=2e-3)
    np.testing.assert_allclose(
        (np.array(weight) * np.array(sampled.pdf))[:, usable], np.array(value)[:, usable], rtol=2e-3, atol=1e-6
    )
    assert (np.array(weight)[:, ~usable] == 0).all()


@pytest.mark.parametrize("integrator", ["path", "direct", "prb"])
def test_furnace_through_an_integrator(integrator):
    """A plane under light from everywhere reflects what the integral of the closed form says, by any sampling."""
    device.use()
    import mitsuba as mi

    plugins.register()
    colour, roughness, metallic, cosine = (0.9, 0.5, 0.1), 0.4, 0.6, 0.6
    origin = [float(np.sqrt(1 - cosine**2)) * 1e3, 0.0, cosine * 1e3]
    film = {"type": "hdrfilm", "width": 32, "height": 32, "rfilter": {"type": "box"}}
    look = mi.ScalarTransform4f().look_at(origin, [0, 0, 0], [0, 1, 0])
    scene = mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": integrator},
            "sensor": {"type": "perspective", "fov": 0.01, "to_world": look, "film": film},
            "plane": {
                "type": "rectangle",
                "bsdf": {"type": "twosided", "bsdf": gltf_dict(colour, roughness, metallic)},
            },
            "light": {"type": "constant", "radiance": {"type": "rgb", "value": 1.0}},
        }
    )
    found = picture(scene, spp=256).mean((0, 1))
    np.testing.assert_allclose(found, albedo_of("gltf", cosine, colour, roughness, metallic), rtol=4e-3)


@pytest.mark.parametrize("model", ["principled", "gltf"])
def test_mikkt_frame_equals_the_deferred_sum(rng, model):
    """On charts that are mirrored and turned. What Mitsuba's own frame shows there is another picture."""
    device.use()
    mesh, maps, camera = charts(), random_maps(rng, [SIZE]), crop()
    tangents = tangents_of(mesh)
    assert 0.2 < (tangents[..., 3] > 0).mean() < 0.8
    through_mitsuba = picture(scene_of(mesh, maps, camera, KEY, model=model, frame="mikkt"))
    if model == "principled":
        ours = Path(mesh, [camera], (KEY,), [SIZE], tangents)
        deferred_sum = ours.draw(ours.leaves(tables(maps), ())).numpy()
    else:
        deferred_sum = shaded(mesh, maps[0], camera, tangents)
    assert 0.3 < (through_mitsuba > 0).any(-1).mean() < 0.9
    # A ray may fall on the other side of a shadow's edge when the light is spelled with other roundings.
    assert (np.abs(through_mitsuba - deferred_sum).max(-1) > 3e-4).mean() < 2e-3
    other = picture(scene_of(mesh, maps, camera, KEY, model=model))
    assert (np.abs(through_mitsuba - other).max(-1) > 0.01).mean() > 0.2


def shaded(mesh, maps, camera, tangents):
    """`evaluate` of the traced surface under KEY, by the deferred trace and the textures' bilinear taps."""
    import mitsuba as mi

    ours = Path(mesh, [camera], (KEY,), [SIZE], tangents)
    table = tables([maps])
    fetched = {n: ours.taps.matrix @ v[ours.taps.texels] for n, v in table.items()}
    albedo, normal = (
        k(np.ascontiguousarray(fetched[n].T)) for n, k in (("albedo", mi.Color3f), ("normal", mi.Vector3f))
    )
    rest = (mi.Float(fetched[name].ravel()) for name in ("roughness", "metallic"))
    ((wo, irradiance),) = ours.lit.directional
    value = evaluate(bsdf.Reflectance("gltf"), ours.lit.wi, wo, normal, albedo, *rest) * irradiance
    return np.array(value).T.reshape(*ours.lit.size, 3)


def test_mitsubas_frame_is_what_it_was(rng):
    """The defaults give Mitsuba's own plugins; ours without tangents, and flipping, show the same picture."""
    device.use()
    import mitsuba as mi

    mesh, camera = charts(), crop()
    maps = random_maps(rng, [SIZE], tilt=0.65)
    plain = scenery.bsdf_dict(maps[0])
    assert plain["bsdf"]["type"] == "normalmap" and plain["bsdf"]["bsdf"]["type"] == "principled"
    assert plain["bsdf"]["flip_invalid_normals"] is False and plain["bsdf"]["use_shadowing_function"] is False
    for flip in (False, True):
        own = picture(scene_of(mesh, maps, camera, KEY, flip_invalid=flip))
        described = scenery.bsdf_dict(maps[0], flip, frame="mikkt")
        assert described["bsdf"]["type"] == plugins.NORMALMAP
        scene = scene_of(mesh, maps, camera, KEY)
        shape = scenery.mitsuba_mesh(mesh, 0, mi.load_dict(described), "part0")
        replaced = mi.load_dict(
            {
                "type": "scene",
                "integrator": scene.integrator(),
                "sensor": scene.sensors()[0],
                "light": scene.emitters()[0],
                "part0": shape,
            }
        )
        difference = np.abs(picture(replaced) - own).max(-1)
        assert (difference > 1e-4).mean() < 1e-3
        black = ((own == 0).all(-1)).mean()
    assert black < (picture(scene_of(mesh, maps, camera, KEY)) == 0).all(-1).mean() - 0.01


def test_parameters_name_the_textures_of_every_model_and_frame(rng):
    device.use()
    import mitsuba as mi

    mesh, maps = torus(parts=2), random_maps(rng, [SIZE, SIZE])
    for model in ("principled", "gltf"):
        for frame in ("mitsuba", "mikkt"):
            found = mi.traverse(
                mi.load_dict({"type": "scene"} | scenery.object_shapes(mesh, maps, model=model, frame=frame))
            )
            for part in (0, 1):
                for name, key in scenery.parameters(part).items():
                    expected = getattr(maps[part], name)
                    expected = expected * 0.5 + 0.5 if name == "normal" else expected
                    np.testing.assert_allclose(np.array(found[key]).reshape(expected.shape), expected, atol=1e-6)


def test_tangents_split_vertices_and_keep_faces():
    device.use()
    import mitsuba as mi

    mesh = charts()
    tangents = tangents_of(mesh)
    # Turned in one face only: its corners need vertices of their own.
    tangents[7, :, :3] = np.roll(tangents[7, :, :3], 1, axis=-1)
    plain, split = scenery.mitsuba_mesh(mesh, None), scenery.mitsuba_mesh(mesh, None, tangents=tangents)
    assert split.vertex_count() > plain.vertex_count()
    values = mi.traverse(split)
    faces = np.array(values["faces"]).reshape(-1, 3)
    positions = np.array(values["vertex_positions"]).reshape(-1, 3)
    np.testing.assert_array_equal(positions[faces], mesh.positions[mesh.faces])
    np.testing.assert_array_equal(np.array(values[plugins.TANGENT]).reshape(-1, 3)[faces], tangents[..., :3])
    np.testing.assert_array_equal(np.array(values[plugins.HANDEDNESS])[faces], tangents[..., 3])


def moved(scene, parameters, directions, step, **options):
    """The picture, float64, with textures moved by `step` times `directions` (of the same keys), and put back."""
    # Copies: assigning to a parameter writes into the array it holds.
    start = {key: type(parameters[key])(parameters[key]) for key in directions}
    for key, direction in directions.items():
        parameters[key] = start[key] + step * type(start[key])(direction)
    parameters.update()
    result = picture(scene, **options).astype(np.float64)
    for key, value in start.items():
        parameters[key] = value
    parameters.update()
    return result


def test_prb_gradient_of_every_map_equals_central_differences(rng):
    """Under one delta light and without a further bounce the picture has no noise."""
    device.use()
    import drjit as dr
    import mitsuba as mi

    mesh, maps, camera = charts(), random_maps(rng, [SIZE], roughness=(0.4, 0.9)), crop(32)
    tangents = tangents_of(mesh)
    facing = deferred.trace(draw.tracer(mesh), [camera], tangents).facing.reshape(32, 32, 1)
    # Where a bump tips the surface over the camera's horizon the picture jumps, and no derivative says so.
    adjoint = (rng.normal(size=(32, 32, 3)) * (facing > 0.5)).astype(np.float32)
    scene = scene_of(mesh, maps, camera, KEY, {"type": "prb", "max_depth": 2}, model="gltf", frame="mikkt")
    parameters: Any = mi.traverse(scene)
    keys = scenery.parameters(0)
    parameters.keep(list(keys.values()))
    for key in keys.values():
        dr.enable_grad(parameters[key])
    parameters.update()
    dr.backward(dr.sum(mi.render(scene, parameters, spp=1, seed=mi.UInt32(0))[..., :3] * mi.TensorXf(adjoint)))
    gradients = {key: np.array(dr.grad(parameters[key])) for key in keys.values()}
    for key in keys.values():
        dr.disable_grad(parameters[key])
    for group in (["normal"], ["albedo", "roughness", "metallic"]):
        directions = {keys[name]: rng.normal(size=gradients[keys[name]].shape).astype(np.float32) for name in group}
        slope = sum(float((gradients[key] * direction).sum()) for key, direction in directions.items())
        up, down = (moved(scene, parameters, directions, sign * 2e-3) for sign in (1, -1))
        expected = ((up - down) * adjoint).sum() / 4e-3
        assert abs(slope - expected) < 0.01 * abs(expected) + 0.01, (group, slope, expected)
    assert all(np.linalg.norm(gradient) > 1 for gradient in gradients.values())


def test_gradient_through_reflected_light(rng):
    """prb with bounces and light from everywhere: the gradient of the normal map is the pictures' difference."""
    device.use()
    import drjit as dr
    import mitsuba as mi

    mesh, maps, camera = charts(), random_maps(rng, [(2, 2)], tilt=0.2), crop(16)
    described = {"type": "scene", "integrator": {"type": "prb", "max_depth": 3}}
    described["sensor"] = scenery.sensor_dict(camera, 64)
    described["light"] = {"type": "constant", "radiance": {"type": "rgb", "value": 1.0}}
    described["key"] = {"type": "directional", "direction": [0.3, -1.0, -0.5]}
    scene = mi.load_dict(described | scenery.object_shapes(mesh, maps, model="gltf", frame="mikkt"))
    key = scenery.parameters(0)["normal"]
    parameters: Any = mi.traverse(scene)
    dr.enable_grad(parameters[key])
    parameters.update()
    dr.backward(dr.sum(mi.render(scene, parameters, spp=64, seed=mi.UInt32(1))[..., :3]))
    gradient = np.array(dr.grad(parameters[key]))
    dr.disable_grad(parameters[key])
    directions = {key: np.sign(gradient).astype(np.float32)}
    up, down = (moved(scene, parameters, directions, sign * 0.02, spp=64, seed=2).sum() for sign in (1, -1))
    slope, expected = (gradient * directions[key]).sum(), (up - down) / 0.04
    assert abs(slope - expected) < 0.1 * abs(expected), (slope, expected)


@pytest.mark.parametrize("variant", ["scalar_rgb", "llvm_ad_spectral"])
def test_other_variants(variant):
    """Registered for whichever variant is current; the picture is that of the first."""
    first = device.use()
    import mitsuba as mi

    means = []
    try:
        for each in (first, variant):
            mi.set_variant(each)
            plugins.register()
            normal = {"type": "rgb", "value": [0.5, 0.5, 1.0]}
            material = {"type": plugins.NORMALMAP, "normalmap": normal, "bsdf": gltf_dict((0.5, 0.5, 0.5))}
            if "spectral" in each:
                material = gltf_dict((0.5, 0.5, 0.5))  # a normal map is no spectrum
            film = {"type": "hdrfilm", "width": 6, "height": 6}
            look = mi.ScalarTransform4f().look_at([0, 0, 4], [0, 0, 0], [0, 1, 0])
            scene = mi.load_dict(
                {
                    "type": "scene",
                    "integrator": {"type": "path", "max_depth": 2},
                    "sensor": {"type": "perspective", "to_world": look, "film": film},
                    "shape": {"type": "sphere", "bsdf": {"type": "twosided", "bsdf": material}},
                    "light": {"type": "constant", "radiance": {"type": "rgb", "value": 1.0}},
                }
            )
            means.append(picture(scene, spp=16).mean())
    finally:
        mi.set_variant(first)
    assert abs(means[0] - means[1]) < 0.02 * means[0]
