"""Collected samples: what they cost, what they leave out, and that lights arrive as Mitsuba's do."""

import numpy as np
import pytest
import scipy.sparse as sparse

from mistyle.core.capture import in_memory
from mistyle.core.light import Ambient, Directional, Environment, Point, SceneLights, SphericalGaussian
from mistyle.render.deferred import image_samples, renderer
from mistyle.render.deferred import sky as skies
from mistyle.render.deferred.material_table import pack
from mistyle.render.mitsuba import device, draw
from mistyle.render.mitsuba import scene as scenery
from tests.render.deferred.test_seam import KEY, SIZES, crop, random_maps, torus


@pytest.fixture(scope="module")
def traced():
    device.use()
    return draw.tracer(torus())


def collected(traced, camera, lights, mask=None, **options) -> list[image_samples.SampleBlock]:
    mask = np.ones(camera.size, bool) if mask is None else mask
    soft, sampling = options.pop("soft", None), image_samples.Sampling(**options)
    return list(image_samples.collect(image_samples.TexturedMesh(traced, SIZES), camera, lights, mask, sampling, soft))


def test_only_samples_on_the_mesh_inside_the_mask_and_lit_are_kept(traced, rng):
    camera = crop(24)
    mask = rng.random(camera.size) < 0.6
    (block,) = collected(traced, camera, (KEY,), mask, subsamples=4)
    seen = draw.gbuffer(traced, camera).mask
    pixels = np.array(block.pixels.index)[: block.counts[1]]
    assert mask.ravel()[pixels].all() and mask.ravel()[block.dark].all()
    assert not set(pixels.tolist()) & set(block.dark.tolist())
    assert block.covered[~mask].max() == 0 and block.covered.max() == 4
    inside = seen & mask
    assert (block.covered[inside] > 0).mean() > 0.97  # a pixel's centre is none of its four samples
    assert len(block.dark) + len(pixels) == (block.covered > 0).sum()
    strength = np.array(block.samples.strength[0])
    assert (strength[: block.counts[0]] == 1).all() and (strength[block.counts[0] :] == 0).all()
    assert (np.array(block.samples.wo[0].z)[: block.counts[0]] > 0).all()
    assert (np.array(block.samples.wi.z)[: block.counts[0]] > 0).all()


def test_the_transpose_lists_every_fetch_once(traced):
    (block,) = collected(traced, crop(24), (KEY,), subsamples=4)
    n, _, t = block.counts
    texel, step = np.array(block.samples.texel)[:n].astype(int), np.array(block.samples.step)[:n]
    right, down = image_samples.steps(SIZES)[step].T
    read = np.stack([texel, texel + right, texel + down, texel + right + down], axis=1)
    assert read.min() >= 0 and read.max() < sum(a * b for a, b in SIZES)
    back = block.transpose
    begin, end, rows = (np.array(a)[:t] for a in (back.begin, back.end, back.texel))
    assert (np.diff(rows.astype(int)) > 0).all() and (end > begin).all()
    sample, weight = np.array(back.sample)[: 4 * n], np.array(back.weight)[: 4 * n]
    x, y = np.array(block.samples.x)[:n], np.array(block.samples.y)[:n]
    weights = np.stack([(1 - x) * (1 - y), x * (1 - y), (1 - x) * y, x * y], axis=1)
    forth = sparse.coo_matrix((weights.ravel(), (read.ravel(), np.repeat(np.arange(n), 4)))).toarray()
    there = sparse.coo_matrix((weight, (np.repeat(rows, end - begin), sample)), shape=forth.shape).toarray()
    np.testing.assert_allclose(there, forth, atol=1e-6)


def test_cells_repeat_at_the_borders():
    uv = np.array([[0.0, 1.0], [0.999, 0.001], [1.25, -0.3]], np.float32)
    texel, step, place = image_samples.bilinear_footprint(uv, np.array([1, 1, 0]), [(4, 8), (2, 3)])
    # In the first texel's own corner the fetch begins at the last texel of the set, which has 2 rows of 3.
    assert texel[0] == 32 + 5 and image_samples.steps([(4, 8), (2, 3)])[step[0]].tolist() == [-2, -3]
    assert texel[1] == 32 + 5 and texel[2] == 1
    assert image_samples.steps([(4, 8), (2, 3)])[step[2]].tolist() == [1, 8]
    np.testing.assert_allclose(place[2], [0.5, 0.7], atol=1e-5)


@pytest.mark.parametrize("lights", [(KEY,), (KEY, Point((1, 2, 3), (1, 1, 1))), (Ambient((1, 1, 1)), KEY)])
def test_the_docstring_says_the_bytes(traced, lights):
    (block,) = collected(traced, crop(32), lights, subsamples=4, soft=skies.sky(lights, 32))
    n, p, t = (image_samples.padded(c) for c in block.counts)

    def held(value) -> int:
        if isinstance(value, tuple):
            return sum(map(held, value))
        if value is None:
            return 0
        return np.array(value).nbytes

    parts = (block.samples, block.pixels, block.transpose)
    assert sum(held(v) for part in parts for v in vars(part).values()) == block.bytes
    delta, soft = len(block.lights), 37 + 4 if block.sky is not None else 0
    assert block.bytes == n * (29 + 16 * delta + 32 + soft) + 12 * t + 12 * p


@pytest.mark.parametrize(
    "light",
    [
        Point((1.5, 1.0, 0.5), (4.0, 3.0, 2.0)),
        Point((0.0, 0.0, 0.0), (9.0, 9.0, 9.0), "camera"),
        Point((0.3, -0.4, 2.5), (1.0, 2.0, 1.0), "camera"),
        Directional((0.0, 0.8, 0.6), (1.0, 2.0, 3.0)),
    ],
)
def test_delta_lights_arrive_as_mitsubas_do(traced, rng, light):
    import mitsuba as mi

    camera, maps = crop(), random_maps(rng, SIZES)
    captures = in_memory([camera], [(light,)], [np.zeros((*camera.size, 3), np.float32)])
    options = renderer.RenderOptions(frame="mitsuba", subsamples=1)
    ours = renderer.MaterialRenderer(traced, captures, SIZES, options)
    sensor = scenery.sensor_dict(camera)
    sensor["film"]["pixel_format"] = "rgb"
    sensor["sampler"] = {"type": "stratified", "sample_count": 1, "jitter": False}
    if isinstance(light, Point):
        place = np.asarray(light.position, float)
        if light.frame == "camera":
            place = camera.world_from_cam[:3, :3] @ place + camera.position
        emitter = {"type": "point", "position": place.tolist()}
        emitter["intensity"] = {"type": "rgb", "value": list(light.intensity)}
    else:
        direction = (-np.asarray(light.direction)).tolist()
        emitter = {"type": "directional", "direction": direction}
        emitter["irradiance"] = {"type": "rgb", "value": list(light.irradiance)}
    scene = {"type": "scene", "integrator": {"type": "direct", "bsdf_samples": 0}, "sensor": sensor, "light": emitter}
    twin = np.array(mi.render(mi.load_dict({**scene, **scenery.object_shapes(traced.mesh, maps)}), spp=1))
    lit = (twin > 0).any(axis=-1).mean()
    assert 0.1 < lit < 0.97
    # At a shadow's edge the two rays may fall on different sides.
    assert (np.abs(ours.image(pack(maps), 0) - twin).max(axis=-1) > 2e-4 * twin.max()).mean() < 2e-3


def test_a_grid_of_samples_is_square():
    np.testing.assert_allclose(image_samples.grid(4), [[0.25, 0.25], [0.75, 0.25], [0.25, 0.75], [0.75, 0.75]])
    with pytest.raises(ValueError, match="square number"):
        image_samples.grid(8)


def test_what_cannot_be_collected_is_refused(traced):
    camera = crop(8)
    with pytest.raises(ValueError, match="scene file"):
        collected(traced, camera, (SceneLights("studio.xml"),))
    with pytest.raises(ValueError, match="mask of"):
        collected(traced, camera, (KEY,), np.ones((4, 4), bool))
    assert collected(traced, camera, (KEY,), np.zeros((8, 8), bool)) == []


def test_a_sky_keeps_the_energy_and_knows_where_it_comes_from(rng):
    ambient, gaussian = Ambient((0.5, 1.0, 2.0)), SphericalGaussian((0.6, 0.0, 0.8), 50.0, (3.0, 2.0, 1.0))
    made = skies.sky((ambient, gaussian), 64)
    assert made is not None and made.direction.shape == (64, skies.VARIANTS, 3)
    lobe = 2 * np.pi * (1 - np.exp(-2 * 50.0)) / 50.0
    expected = 4 * np.pi * np.array(ambient.radiance) + lobe * np.array(gaussian.amplitude)
    np.testing.assert_allclose(made.energy.astype(float).sum(axis=(0, 1)) / skies.VARIANTS, expected, rtol=2e-3)
    np.testing.assert_allclose(made.angle.sum(), 4 * np.pi, rtol=1e-5)
    np.testing.assert_allclose(np.linalg.norm(made.direction, axis=-1), 1, atol=1e-5)
    # Light from the whole sphere cancels, the lobe remains.
    flow = (made.direction * made.energy[..., :1]).sum(axis=(0, 1))
    assert flow @ np.array(gaussian.axis) > 0.99 * np.linalg.norm(flow)
    assert skies.sky((KEY,), 64) is None


def test_a_turned_environment_turns_the_sky():
    radiance = np.zeros((32, 64, 3), np.float32)
    radiance[15:17, 31:33] = 100.0  # the map's middle looks along +Z
    for turn, expected in ((0, (0, 0, 1)), (90, (1, 0, 0)), (180, (0, 0, -1))):
        made = skies.sky((Environment(radiance, turn=turn),), 32)
        assert made is not None
        flow = (made.direction * made.energy[..., :1]).sum(axis=(0, 1))
        np.testing.assert_allclose(flow / np.linalg.norm(flow), expected, atol=0.02)


@pytest.mark.parametrize(("subsamples", "across"), [(1, 4), (4, 2), (16, 1)])
def test_close_pixels_see_all_parts_of_the_sky(subsamples: int, across: int) -> None:
    """Rows that saw the same parts would be stripes, which a fit takes for relief."""
    width, each = 8, np.arange(subsamples)
    pixel = np.repeat(np.arange(width * width), subsamples)
    seen = image_samples.sky_parts(pixel, np.tile(each, width * width), subsamples, width)
    blocks = seen.reshape(width // across, across, width // across, across, subsamples).transpose(0, 2, 1, 3, 4)
    for block in blocks.reshape(-1, skies.VARIANTS):
        assert sorted(block.tolist()) == list(range(skies.VARIANTS))
