"""The seam against Mitsuba's own way (full textures, `direct`) and against finite differences."""

import numpy as np
import pytest
import torch

from mistyle.core.camera import Camera, orbit, zoom
from mistyle.core.light import Ambient, Directional
from mistyle.core.maps import Maps
from mistyle.core.mesh import Mesh
from mistyle.geometry.tangents import mikktspace
from mistyle.render.deferred import integrator as deferred
from mistyle.render.deferred import torch_bridge
from mistyle.render.mitsuba import device, draw
from mistyle.render.mitsuba import scene as scenery
from tests.support.helpers import recordings

KEY = Directional((-0.5, -0.5, -0.7071), (2.0, 1.5, 1.0), "camera")
SIZES = [(24, 40), (32, 32)]


def torus(rings: int = 24, sides: int = 16, parts: int = 2, bumps: float = 0.1) -> Mesh:
    """A bumpy torus (it shadows itself) with a wrapped uv grid; `parts` texture sets cut it along u."""
    u, v = np.meshgrid(np.arange(rings + 1) / rings, np.arange(sides + 1) / sides, indexing="ij")

    def surface(u, v):
        a, b = 2 * np.pi * u, 2 * np.pi * v
        small = 0.28 * (1 + bumps * np.sin(3 * a + 2 * b))
        return np.stack(
            [(0.7 + small * np.cos(b)) * np.cos(a), small * np.sin(b), -(0.7 + small * np.cos(b)) * np.sin(a)], -1
        )

    h = 1e-4
    normals = np.cross(surface(u + h, v) - surface(u - h, v), surface(u, v + h) - surface(u, v - h))
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    index = np.arange((rings + 1) * (sides + 1)).reshape(rings + 1, sides + 1)
    a, b, c, d = index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]
    faces = np.concatenate([np.stack([a, b, c], -1).reshape(-1, 3), np.stack([a, c, d], -1).reshape(-1, 3)])
    uvs = np.stack([u, v], -1).reshape(-1, 2)[faces]
    part = np.minimum((uvs[:, :, 0].mean(1) * parts).astype(np.int32), parts - 1)
    points = surface(u, v).reshape(-1, 3)
    return Mesh(
        points.astype(np.float32),
        faces.astype(np.int32),
        normals.reshape(-1, 3)[faces].astype(np.float32),
        uvs.astype(np.float32),
        part,
        tuple(f"set{k}" for k in range(parts)),
    )


def random_maps(rng, sizes, tilt=0.3, roughness=(0.3, 0.9)) -> list[Maps]:
    result = []
    for rows, columns in sizes:
        xy = rng.uniform(-tilt, tilt, (rows, columns, 2))
        normal = np.concatenate([xy, np.sqrt(1 - (xy**2).sum(-1, keepdims=True))], -1)
        result.append(
            Maps(
                albedo=rng.uniform(0.1, 0.9, (rows, columns, 3)).astype(np.float32),
                normal=normal.astype(np.float32),
                roughness=rng.uniform(*roughness, (rows, columns)).astype(np.float32),
                metallic=rng.uniform(0, 0.5, (rows, columns)).astype(np.float32),
                known=np.ones((rows, columns), bool),
            )
        )
    return result


def tables(maps) -> dict[str, np.ndarray]:
    return {
        name: np.concatenate([getattr(m, name).reshape(-1, channels) for m in maps])
        for name, channels in torch_bridge.CHANNELS.items()
    }


class Path:
    """From tables to picture, the way the fit goes."""

    def __init__(self, mesh, cameras, lights, sizes=SIZES, tangents=None, shadows=True, **options):
        traced = draw.tracer(mesh)
        surface = deferred.trace(traced, cameras, tangents)
        self.lit = deferred.light(traced, surface, lights, shadows=shadows)
        self.taps = torch_bridge.taps(surface, sizes)
        self.shader = torch_bridge.Shader(self.lit.size, **options)

    def leaves(self, tables, moving=("albedo", "normal", "roughness")):
        return {
            name: torch.from_numpy(table[self.taps.texels].copy()).requires_grad_(name in moving)
            for name, table in tables.items()
        }

    def draw(self, leaves):
        pixels = torch_bridge.fetch(torch.cat(list(leaves.values()), dim=1), self.taps)
        return self.shader(self.lit, pixels, [name for name, leaf in leaves.items() if leaf.requires_grad])


def crop(size=48) -> Camera:
    return zoom(orbit(40, 30, distance=4, fov=30, size=(256, 256)), 60.3, 71.9, 120.0, (size, size))


def plain_scene(mesh, maps, camera, light):
    """The same through Mitsuba alone: full bilinear textures, rays through pixel centres, one delta light."""
    import mitsuba as mi

    world = deferred.direction_in_world(light, camera)
    sensor = scenery.sensor_dict(camera)
    sensor["principal_point_offset_x"] = 0.5 - camera.centre[0] / camera.size[1]
    sensor["principal_point_offset_y"] = 0.5 - camera.centre[1] / camera.size[0]
    # Without jitter and with one sample per pixel the stratified sampler stays in the pixel's centre.
    sensor["sampler"] = {"type": "stratified", "sample_count": 1, "jitter": False}
    emitter = {"type": "directional", "direction": (-world).tolist()}
    emitter["irradiance"] = {"type": "rgb", "value": list(light.irradiance)}
    parts = scenery.object_shapes(mesh, maps)
    integrator = {"type": "direct", "emitter_samples": 1, "bsdf_samples": 0}
    return mi.load_dict({"type": "scene", "integrator": integrator, "sensor": sensor, "light": emitter, **parts})


BOTH = pytest.mark.parametrize("bridge", ["frozen", "wrap"])


@pytest.mark.parametrize("gloss", [True, False])
@pytest.mark.parametrize("moving", [("albedo", "normal", "roughness"), ("normal",), tuple(torch_bridge.CHANNELS)])
def test_the_frozen_split_equals_its_twin_behind_wrap(rng, gloss, moving):
    """Same loss, same gradients, replayed and not recorded again for other values."""
    device.use()
    lights = (KEY, Ambient((0.3, 0.2, 0.4)))
    ways = {b: Path(torus(), [crop(), crop()], lights, gloss=gloss, bridge=b) for b in ("frozen", "wrap")}
    counted = []
    for _ in range(3):
        values = tables(random_maps(rng, SIZES))
        found = {}
        for name, way in ways.items():
            leaves = way.leaves(values, moving)
            picture = way.draw(leaves)
            loss = (picture - 0.2).square().mean()
            loss.backward()
            found[name] = picture.detach().numpy(), float(loss.detach()), {k: leaves[k].grad.numpy() for k in moving}
        picture, loss, gradients = found["frozen"]
        np.testing.assert_allclose(picture, found["wrap"][0], atol=2e-6, rtol=1e-5)
        assert loss == pytest.approx(found["wrap"][1], rel=1e-6)
        for name in moving:
            theirs = found["wrap"][2][name]
            assert np.linalg.norm(gradients[name] - theirs) < 2e-5 * np.linalg.norm(theirs) + 1e-9, name
        counted.append(recordings(ways["frozen"].shader._bridge))
    assert counted[1] == counted[2]


@BOTH
def test_picture_and_gradient_equal_mitsubas_own(rng, bridge):
    device.use()
    import drjit as dr
    import mitsuba as mi

    mesh, maps, camera = torus(), random_maps(rng, SIZES), crop()
    ours = Path(mesh, [camera], (KEY,), bridge=bridge)
    leaves = ours.leaves(tables(maps), tuple(torch_bridge.CHANNELS))
    picture = ours.draw(leaves)
    adjoint = rng.normal(size=picture.shape).astype(np.float32)
    (picture * torch.from_numpy(adjoint)).sum().backward()

    scene = plain_scene(mesh, maps, camera, KEY)
    parameters = mi.traverse(scene)
    names = {(part, name): key for part in (0, 1) for name, key in scenery.parameters(part).items()}
    parameters.keep(list(names.values()))
    for key in names.values():
        dr.enable_grad(parameters[key])
    parameters.update()
    twin = mi.render(scene, parameters, spp=1, seed=0)[..., :3]
    dr.backward(dr.sum(twin * mi.TensorXf(adjoint)))

    theirs = np.array(twin)
    shadowed = 1 - (theirs[..., 0] > 0).mean()
    assert 0.1 < shadowed < 0.9  # there is something to see, and something in shadow or beside the object
    # A ray may fall on the other side of a shadow's edge when the light is spelled with other roundings.
    different = np.abs(picture.detach().numpy() - theirs).max(-1) > 2e-4
    assert different.mean() < 1e-3
    for name, channels in torch_bridge.CHANNELS.items():
        scale = 2 if name == "normal" else 1  # their texture holds (n + 1) / 2
        full = np.concatenate([np.array(dr.grad(parameters[names[p, name]])).reshape(-1, channels) for p in (0, 1)])
        mine = np.zeros_like(full)
        mine[ours.taps.texels] = leaves[name].grad.numpy() * scale
        # Sums of a few hundred terms of order 1 in float32, in different orders.
        assert np.linalg.norm(mine - full) < 2e-3 * np.linalg.norm(full) + 1e-6, name


def slope(path, values, name, direction, adjoint, step):
    """Central difference of sum(picture * adjoint) along a direction of one table, in float64 sums."""
    ends = []
    for sign in (1, -1):
        moved = {k: v.detach().clone() for k, v in values.items()}
        moved[name] = moved[name] + sign * step * direction
        ends.append(float((path.draw(moved).double() * adjoint).sum()))
    return (ends[0] - ends[1]) / (2 * step)


@BOTH
@pytest.mark.parametrize("name, step", [("albedo", 1e-2), ("normal", 2e-3), ("roughness", 2e-3), ("metallic", 1e-2)])
def test_gradient_equals_central_differences(rng, name, step, bridge):
    device.use()
    path = Path(
        torus(bumps=0),
        [crop(32), orbit(200, 10, distance=4, fov=30, size=(32, 32))],
        (KEY, Ambient((0.3, 0.3, 0.3))),
        bridge=bridge,
    )
    leaves = path.leaves(tables(random_maps(rng, SIZES, tilt=0.2)), (name,))
    adjoint = torch.from_numpy(rng.normal(size=(64, 32, 3)))
    (path.draw(leaves).double() * adjoint).sum().backward()
    for _ in range(3):
        direction = torch.from_numpy(rng.normal(size=leaves[name].shape).astype(np.float32))
        analytic = float((leaves[name].grad * direction).double().sum())
        numeric = slope(path, leaves, name, direction, adjoint, step)
        # Against the size of the whole gradient: a random direction may happen to be nearly level.
        typical = float(leaves[name].grad.norm())
        assert abs(analytic - numeric) < 0.02 * typical, (analytic, numeric, typical)


def test_roughness_has_no_gradient_below_its_floor_and_one_above(rng):
    """Mitsuba clamps alpha = roughness² at 0.001, so a roughness below 0.0316 never moves; the fit stays at 0.05."""
    device.use()
    path = Path(torus(bumps=0), [crop(32)], (KEY,))
    sizes = {}
    for roughness in (0.025, 0.05):
        values = tables(random_maps(rng, SIZES, tilt=0.0, roughness=(roughness, roughness)))
        values["metallic"][:] = 1  # the diffuse lobe's retro-reflection also depends on roughness
        leaves = path.leaves(values, ("roughness",))
        path.draw(leaves).sum().backward()
        sizes[roughness] = float(leaves["roughness"].grad.abs().max())
    assert sizes[0.025] < 1e-6 < 1e-2 < sizes[0.05]


def test_same_bytes_at_any_thread_count(rng):
    import drjit as dr

    device.use()
    maps, threads = random_maps(rng, SIZES), dr.thread_count()
    made = []
    try:
        for count in (1, 2, 2):
            device.use(threads=count)
            path = Path(torus(), [crop(40), crop(40)], (KEY, Ambient((0.1, 0.1, 0.1))))
            leaves = path.leaves(tables(maps))
            picture = path.draw(leaves)
            picture.square().sum().backward()
            made.append(
                [picture.detach().numpy().tobytes()] + [leaves[k].grad.numpy().tobytes() for k in ("albedo", "normal")]
            )
    finally:
        device.use(threads=threads)
    assert made[0] == made[1] == made[2]


def test_ambient_light_is_the_mean_over_the_hemisphere(rng):
    """Against Mitsuba's `constant` emitter on a convex object, many samples."""
    device.use()
    import mitsuba as mi

    mesh, camera = sphere(), orbit(20, 10, distance=4, fov=30, size=(24, 24))
    kinds = (((3,), 0.5), ((3,), 0), ((), 0.5), ((), 0))
    values = [np.full((4, 4, *tail), value, np.float32) for tail, value in kinds]
    maps = [Maps(*values, known=np.ones((4, 4), bool))]
    maps[0].normal[..., 2] = 1
    ours = Path(mesh, [camera], (Ambient((0.8, 0.8, 0.8)),), [(4, 4)])
    picture = ours.draw(ours.leaves(tables(maps), ())).numpy()
    sensor = scenery.sensor_dict(camera)
    scene = {"type": "scene", "integrator": {"type": "path", "max_depth": 2}, "sensor": sensor}
    scene |= {
        "light": {"type": "constant", "radiance": {"type": "rgb", "value": [0.8] * 3}},
        **scenery.object_shapes(mesh, maps),
    }
    reference = np.array(mi.render(mi.load_dict(scene), spp=512, seed=0))
    inside = draw.gbuffer(draw.tracer(mesh), camera)
    inner = inside.mask & (inside.normal @ camera.world_from_cam[:3, 2] < -0.6)
    error = np.abs(picture - reference[..., :3])[inner]
    assert inner.sum() > 100
    # Sixteen directions leave 0.02 of the radiance; 512 samples of the reference about 0.01.
    assert error.mean() < 0.025 * 0.8 and error.max() < 0.06 * 0.8


def sphere(rings: int = 48, sides: int = 24) -> Mesh:
    u, v = np.meshgrid(np.arange(rings + 1) / rings, np.arange(sides + 1) / sides, indexing="ij")
    a, b = 2 * np.pi * u, np.pi * (v - 0.5)
    points = np.stack([np.cos(b) * np.sin(a), np.sin(b), np.cos(b) * np.cos(a)], -1).reshape(-1, 3)
    index = np.arange((rings + 1) * (sides + 1)).reshape(rings + 1, sides + 1)
    a, b, c, d = index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]
    faces = np.concatenate([np.stack([a, b, c], -1).reshape(-1, 3), np.stack([a, c, d], -1).reshape(-1, 3)])
    uvs = np.stack([u, v], -1).reshape(-1, 2)[faces]
    p = points.astype(np.float32)
    return Mesh(
        p, faces.astype(np.int32), p[faces], uvs.astype(np.float32), np.zeros(len(faces), np.int32), ("sphere",)
    )


def test_tangents_give_the_frame_of_the_normal_map():
    """On a sphere with longitude as u, a map tilted by +x leans east and one tilted by +y leans to the north pole."""
    device.use()
    mesh, camera = sphere(), orbit(0, 0, distance=4, fov=30, size=(33, 33))
    positions, corners = mesh.positions, mesh.faces
    separate = np.arange(corners.size).reshape(-1, 3).astype(np.int32)
    normals, uvs = mesh.corner_normals.reshape(-1, 3), mesh.corner_uvs.reshape(-1, 2)
    tangents = mikktspace(positions[corners.ravel()], normals, uvs, separate)
    for given in (None, tangents):
        surface = deferred.trace(draw.tracer(mesh), [camera], given)
        middle = 33 * 16 + 16
        frame = {axis: np.array(getattr(surface.frame, axis))[:, middle] for axis in "stn"}
        np.testing.assert_allclose(frame["n"], [0, 0, 1], atol=0.02)
        np.testing.assert_allclose(frame["s"], [1, 0, 0], atol=0.02)
        np.testing.assert_allclose(frame["t"], [0, 1, 0], atol=0.02)
    # A mirrored chart: u runs west, so its sign is negative and the bitangent still points north.
    mirrored = Mesh(
        mesh.positions, mesh.faces, mesh.corner_normals, mesh.corner_uvs * [-1, 1] + [1, 0], mesh.part, mesh.parts
    )
    mirrored = Mesh(**{**vars(mirrored), "corner_uvs": mirrored.corner_uvs.astype(np.float32)})
    flipped = tangents * np.float32([-1, -1, -1, -1])
    surface = deferred.trace(draw.tracer(mirrored), [camera], flipped)
    np.testing.assert_allclose(np.array(surface.frame.s)[:, middle], [-1, 0, 0], atol=0.02)
    np.testing.assert_allclose(np.array(surface.frame.t)[:, middle], [0, 1, 0], atol=0.02)


def test_fetch_is_bilinear_with_repeat_and_its_gradient_is_the_transpose(rng):
    device.use()
    import mitsuba as mi

    rows, columns = 5, 7
    table = rng.random((rows * columns, 2)).astype(np.float32)
    uv = rng.uniform(-0.2, 1.2, (50, 2)).astype(np.float32)
    mask = np.arange(50) % 5 > 0
    part, zeros = np.where(mask, 0, -1).astype(np.int32), np.zeros((50, 3), np.float32)
    surface = deferred.Surface((), uv, part, mask, np.ones(50, np.float32), zeros, zeros, None, None, None)
    where = torch_bridge.taps(surface, [(rows, columns)])
    leaf = torch.from_numpy(table[where.texels]).requires_grad_()
    pixels = torch_bridge.fetch(leaf, where)
    for channel in (0, 1):
        texture = mi.load_dict(scenery.texture_dict(table[:, channel].reshape(rows, columns, 1)))
        point = mi.SurfaceInteraction3f()
        point.uv = mi.Point2f(uv[:, 0], 1 - uv[:, 1])
        expected = np.where(mask, np.array(texture.eval_1(point)), 0)
        np.testing.assert_allclose(pixels.detach().numpy()[:, channel], expected, atol=1e-5)
    adjoint = rng.normal(size=pixels.shape).astype(np.float32)
    pixels.backward(torch.from_numpy(adjoint))
    np.testing.assert_allclose(leaf.grad.numpy(), where.matrix.toarray().T @ adjoint, atol=1e-5)


def test_a_film_of_another_size_is_refused():
    device.use()
    path = Path(torus(8, 8), [crop(8)], (KEY,))
    with pytest.raises(ValueError, match="film has"):
        torch_bridge.Shader((4, 4))(path.lit, torch.zeros(64, 8))
