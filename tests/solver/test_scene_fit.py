"""Fitting a live Mitsuba scene: gradients against finite differences, recovery, masks, resuming, refusals, files."""

import numpy as np
import pytest

from mistyle.core.errors import InputRefused, UsageError
from mistyle.render.deferred import pyramid
from mistyle.render.live import parameters as scene_keys
from mistyle.render.live import xml as scene_xml
from mistyle.render.mitsuba import device
from mistyle.solver.scene import fit as scene_fit
from mistyle.solver.scene import gradients as scene_grad

COLOUR, ROUGH = "wall.bsdf.base_color.data", "wall.bsdf.roughness.data"
CAMERAS = ((0.0, 0.0), (1.2, 0.3), (-1.2, -0.2), (0.2, 1.2), (-0.3, -1.2), (0.9, -0.9))


def smooth(size, channels, low, high, seed):
    """A random texture without high frequencies."""
    rng = np.random.default_rng(seed)
    coarse = rng.random((size // 4, size // 4, channels)).astype(np.float32)
    fine = pyramid.enlarge(pyramid.enlarge(coarse, (size // 2, size // 2)), (size, size))
    return (low + (high - low) * fine).astype(np.float32)


def bitmap(values, **more):
    import mitsuba as mi

    device.use()
    data = mi.TensorXf(np.ascontiguousarray(values, np.float32))
    return {"type": "bitmap", "data": data, "raw": True, "wrap_mode": "clamp", **more}


def wall(bsdf, cameras=CAMERAS, size=24, **more):
    """A square that fills every film, under one point light: nothing but the pixels' own jitter is random."""
    import mitsuba as mi

    device.use()
    scene = {
        "type": "scene",
        "integrator": {"type": "prb", "max_depth": 2},
        "lamp": {"type": "point", "position": [0.4, 0.5, 1.5], "intensity": {"type": "rgb", "value": [6, 6, 6]}},
        "wall": {"type": "rectangle", "bsdf": bsdf},
    }
    for k, (x, y) in enumerate(cameras):
        scene[f"cam{k}"] = {
            "type": "perspective",
            "fov": 26,
            "to_world": mi.ScalarTransform4f().look_at([x, y, 3], [0, 0, 0], [0, 1, 0]),
            "film": {
                "type": "hdrfilm",
                "width": size,
                "height": size,
                "pixel_format": "rgb",
                "rfilter": {"type": "box"},
            },
        }
    return mi.load_dict(scene | more)


def principled(colour, rough):
    return {"type": "principled", "base_color": bitmap(colour), "roughness": bitmap(rough)}


def references(scene, spp=256):
    import mitsuba as mi

    return [np.array(mi.render(scene, sensor=s, spp=spp, seed=50 + k)) for k, s in enumerate(scene.sensors())]


TRUE_COLOUR = smooth(16, 3, 0.1, 0.8, 1)
TRUE_ROUGH = smooth(16, 1, 0.25, 0.7, 2)


@pytest.fixture(scope="module")
def truth():
    return references(wall(principled(TRUE_COLOUR, TRUE_ROUGH)))


def flat(**more):
    return wall(principled(np.full_like(TRUE_COLOUR, 0.5), np.full_like(TRUE_ROUGH, 0.5)), **more)


@pytest.mark.parametrize("shape", [(8, 8, 3), (7, 5, 1), (2, 9, 3), (1, 1, 3)])
def test_reduce_is_the_transpose_of_enlarge(shape, rng):
    coarse = rng.random(((shape[0] + 1) // 2, (shape[1] + 1) // 2, shape[2])).astype(np.float32)
    fine = rng.random(shape).astype(np.float32)
    left, right = (pyramid.enlarge(coarse, shape[:2]) * fine).sum(), (coarse * pyramid.reduce(fine)).sum()
    assert left == pytest.approx(right, rel=1e-5)
    assert np.allclose(pyramid.enlarge(np.ones_like(coarse), shape[:2]), 1)


def test_one_level_is_adam_with_masked_updates(rng):
    """Against the textbook, number by number, where half of the gradients are missing."""
    moments = pyramid.start((4, 4, 1), pyramid=False)
    first, second, steps = np.zeros((4, 4, 1)), np.zeros((4, 4, 1)), np.zeros((4, 4, 1))
    for _ in range(5):
        g = rng.normal(size=(4, 4, 1)) * (rng.random((4, 4, 1)) < 0.5)
        on = g != 0
        steps += on
        first = np.where(on, 0.9 * first + 0.1 * g, first)
        second = np.where(on, 0.99 * second + 0.01 * g**2, second)
        with np.errstate(invalid="ignore", divide="ignore"):
            wanted = -0.1 * (first / (1 - 0.9**steps)) / np.sqrt(second / (1 - 0.99**steps))
        step = pyramid.change(moments, g.astype(np.float32), 0.1)
        assert np.allclose(step, np.where(on, wanted, 0), rtol=1e-4)


def test_a_pyramid_moves_the_neighbours_of_the_only_texel_with_a_gradient():
    gradient = np.zeros((8, 8, 1), np.float32)
    gradient[3, 3] = 1
    assert (pyramid.change(pyramid.start((8, 8, 1)), gradient, 0.1) < 0).all()
    assert np.count_nonzero(pyramid.change(pyramid.start((8, 8, 1), pyramid=False), gradient, 0.1)) == 1


@pytest.mark.parametrize("name", ["log_srgb_l1", "l2"])
def test_gradients_equal_finite_differences(name, truth, rng):
    """Along one random direction of all texels of both textures."""
    import mitsuba as mi

    scene = flat()
    chosen = scene_keys.match(scene, [COLOUR, ROUGH])
    table = mi.traverse(scene)
    values = {p.key: scene_grad.array(table[p.key], p) for p in chosen}
    # Brighter than the truth all over: the absolute value has no kink then.
    values[COLOUR] += 0.4
    loss, view = scene_grad.LOSSES[name], scene_grad.sight(scene.sensors()[1], truth[1], None, "cam")
    engine = scene.integrator()
    _, gradient, broken = scene_grad.gradients(
        scene_grad.LiveScene(scene, table, chosen, engine), values, view, loss, (64, 64), (1, 2)
    )
    assert not broken
    for key in (COLOUR, ROUGH):
        direction = rng.uniform(0.5, 1, values[key].shape).astype(np.float32)
        ends = []
        for step in (0.01, -0.01):
            moved = {**values, key: values[key] + step * direction}
            scene_grad.put(table, chosen, moved)
            ends.append(scene_grad.compare(scene_grad.picture(scene, engine, view.sensor, 64, 1), view, loss)[0])
        difference = (ends[0] - ends[1]) / 0.02
        assert float((gradient[key] * direction).sum()) == pytest.approx(difference, rel=0.02)


def test_colour_and_roughness_are_recovered(truth):
    steps = []
    fitted = scene_fit.fit_scene(
        flat(),
        ["wall.bsdf.base_color", "wall.*.roughness"],
        references=truth,
        loss="log_srgb_l1",  # nothing but jitter is random here
        iterations=48,
        callback=lambda step, loss, values: steps.append((step, loss)),
    )
    seen = fitted.seen[COLOUR].min(axis=-1) > 0
    error = np.abs(fitted.values[COLOUR] - TRUE_COLOUR)[seen].mean()
    assert seen.mean() > 0.9
    for residual in fitted.residuals:
        assert residual.loss[1] < residual.loss[0] / 10
        assert residual.psnr[1] > residual.psnr[0] + 15
    assert error < 0.02 < 0.1 < np.abs(0.5 - TRUE_COLOUR)[seen].mean()
    assert np.abs(fitted.values[ROUGH] - TRUE_ROUGH)[seen].mean() < 0.85 * np.abs(0.5 - TRUE_ROUGH)[seen].mean()
    assert [step for step, _ in steps] == list(range(48)) and [loss for _, loss in steps] == list(fitted.trace)
    assert not fitted.bad and not fitted.unconverged and len(fitted.notes) == 2
    assert "not from the fast path" in fitted.notes[0] and "not linear in the picture" in fitted.notes[1]


def test_from_few_views_the_pyramid_gets_further_than_plain_adam(truth):
    """The same number of steps; plain Adam may choose the better of two rates."""
    left = {}
    for levels, rate in ((True, 0.02), (False, 0.02), (False, 0.05)):
        big = np.full((64, 64, 3), 0.5)
        scene = wall(principled(big, np.full((16, 16, 1), 0.5)), CAMERAS[:3], size=24)
        fitted = scene_fit.fit_scene(scene, [COLOUR], None, truth[:3], iterations=12, rate=rate, pyramid=levels, spp=8)
        wanted = pyramid.enlarge(pyramid.enlarge(TRUE_COLOUR, (32, 32)), (64, 64))
        left[levels, rate] = np.abs(fitted.values[COLOUR] - wanted)[16:-16, 16:-16].mean()
    assert left[True, 0.02] < 0.7 * min(left[False, 0.02], left[False, 0.05])


def test_single_values_are_fitted():
    literal = {"type": "twosided", "bsdf": {"type": "principled", "roughness": 0.3}}
    literal["bsdf"]["base_color"] = {"type": "rgb", "value": [0.7, 0.4, 0.2]}
    refs = references(wall(literal, CAMERAS[:3]))
    literal["bsdf"] |= {"roughness": 0.45, "base_color": {"type": "rgb", "value": [0.5, 0.5, 0.5]}}
    fitted = scene_fit.fit_scene(
        wall(literal, CAMERAS[:3]), ["wall.bsdf.roughness", "wall.*base_color"], None, refs, iterations=32, rate=0.03
    )
    colour, rough = "wall.bsdf.brdf_0.base_color.value", "wall.bsdf.brdf_0.roughness.value"
    assert np.allclose(fitted.values[colour], [0.7, 0.4, 0.2], atol=0.02)
    assert fitted.values[rough] == pytest.approx([0.3], abs=0.03)


def root_diffuse():
    """A BSDF of a user's own: diffuse, its reflectance the square root of a texture. Registered once."""
    import drjit as dr
    import mitsuba as mi

    device.use()

    class RootDiffuse(mi.BSDF):
        def __init__(self, props):
            mi.BSDF.__init__(self, props)
            self.paint = props["paint"]
            flags = mi.BSDFFlags.DiffuseReflection | mi.BSDFFlags.FrontSide
            self.m_components = [flags]
            self.m_flags = flags

        def traverse(self, callback):
            callback.put("paint", self.paint, mi.ParamFlags.Differentiable)

        def sample(self, ctx, si, sample1, sample2, active=True):
            sample = mi.BSDFSample3f()
            sample.wo = mi.warp.square_to_cosine_hemisphere(sample2)
            sample.pdf = mi.warp.square_to_cosine_hemisphere_pdf(sample.wo)
            sample.eta = 1.0
            sample.sampled_type = mi.UInt32(+mi.BSDFFlags.DiffuseReflection)
            sample.sampled_component = mi.UInt32(0)
            return sample, dr.sqrt(self.paint.eval(si, active)) & (active & (si.wi.z > 0))

        def eval(self, ctx, si, wo, active=True):
            up = active & (si.wi.z > 0) & (wo.z > 0)
            return dr.sqrt(self.paint.eval(si, active)) * dr.inv_pi * wo.z & up

        def pdf(self, ctx, si, wo, active=True):
            return dr.select((si.wi.z > 0) & (wo.z > 0), mi.warp.square_to_cosine_hemisphere_pdf(wo), 0)

        def eval_pdf(self, ctx, si, wo, active=True):
            return self.eval(ctx, si, wo, active), self.pdf(ctx, si, wo, active)

    try:
        mi.register_bsdf("root_diffuse_of_a_test", RootDiffuse)
    except RuntimeError as error:
        assert "already" in str(error)
    return "root_diffuse_of_a_test"


def test_a_registered_bsdf_is_fitted_and_a_gradient_that_is_no_number_stops_at_its_texel():
    plugin = root_diffuse()
    true = smooth(8, 3, 0.2, 0.7, 3)
    refs = references(wall({"type": plugin, "paint": bitmap(true, filter_type="nearest")}, CAMERAS[:3]))
    start = np.full_like(true, 0.4)
    start[4, 2] = 0  # d sqrt(x) / dx is infinite there
    scene = wall({"type": plugin, "paint": bitmap(start, filter_type="nearest")}, CAMERAS[:3])
    only = np.ones((8, 8), bool)
    only[0] = False
    fitted = scene_fit.fit_scene(scene, ["wall.*.paint"], None, refs, iterations=24, rate=0.03, only={"*paint": only})
    value = fitted.values["wall.bsdf.paint.data"]
    assert (value[4, 2] == 0).all()
    assert {b.texel[:2] for b in fitted.bad} == {(4, 2)}
    assert {b.key for b in fitted.bad} == {"wall.bsdf.paint.data"} and {b.sensor for b in fitted.bad} <= {0, 1, 2}
    assert any("were not finite" in note and "[4, 2, " in note for note in fitted.notes)
    assert (value[0] == start[0]).all()
    moved = only.copy()
    moved[4, 2] = False
    assert np.abs(value - true)[moved].mean() < 0.4 * np.abs(start - true)[moved].mean()


def test_masked_pixels_have_no_say(truth):
    """What they hold, NaN or nonsense, changes nothing; what only they see stays."""
    mask = np.zeros((24, 24), bool)
    mask[:, :10] = True
    fits = []
    for nonsense in (np.nan, 7.0):
        wrong = [np.where(mask[..., None], r, np.float32(nonsense)) for r in truth[:1]]
        fits.append(
            scene_fit.fit_scene(
                flat(cameras=CAMERAS[:1]), [COLOUR], None, wrong, masks=[mask], iterations=3, spp=4, pyramid=False
            )
        )
    assert fits[0].trace == pytest.approx(fits[1].trace, rel=1e-5)
    assert np.allclose(fits[0].values[COLOUR], fits[1].values[COLOUR], atol=1e-4)
    unseen = fits[0].seen[COLOUR] == 0
    assert 0.3 < unseen.mean() < 0.8
    assert (fits[0].values[COLOUR][unseen] == 0.5).all()


def test_a_resumed_fit_ends_with_the_same_bytes(truth):
    import drjit as dr

    threads = dr.thread_count()
    dr.set_thread_count(1)
    try:
        saved = []
        options = {"iterations": 6, "spp": 4, "sensors_per_step": 2}
        keys, cameras = [COLOUR, ROUGH], CAMERAS[:3]
        whole = scene_fit.fit_scene(flat(cameras=cameras), keys, None, truth[:3], **options)
        part = scene_fit.fit_scene(
            flat(cameras=cameras), keys, None, truth[:3], **options, save=saved.append, callback=lambda k, *_: k == 2
        )
        assert len(part.trace) == 3 and len(saved) == 1
        done = scene_fit.fit_scene(flat(cameras=cameras), keys, None, truth[:3], **options, resume=saved[0])
    finally:
        dr.set_thread_count(threads)
    assert done.trace == whole.trace and done.residuals == whole.residuals
    for key in (COLOUR, ROUGH):
        assert np.array_equal(done.values[key], whole.values[key])
    assert not np.array_equal(part.values[COLOUR], whole.values[COLOUR])
    with pytest.raises(UsageError, match="belongs to another fit"):
        scene_fit.fit_scene(flat(cameras=cameras), keys, None, truth[:3], iterations=7, spp=4, resume=saved[0])


def test_regularizers_smooth_what_they_are_told_to(truth):
    import drjit as dr

    def total_variation(values):
        (texture,) = values.values()
        down, across = texture[1:] - texture[:-1], texture[:, 1:] - texture[:, :-1]
        return 5 * (dr.mean(dr.abs(down), axis=None) + dr.mean(dr.abs(across), axis=None))

    start = np.random.default_rng(0).uniform(0.3, 0.7, TRUE_COLOUR.shape)
    rough = []
    for penalties in ((), (total_variation,)):
        scene = wall(principled(start, np.full_like(TRUE_ROUGH, 0.5)), CAMERAS[:1])
        fitted = scene_fit.fit_scene(scene, [COLOUR], None, truth[:1], iterations=4, spp=4, regularizers=penalties)
        rough.append(np.abs(np.diff(fitted.values[COLOUR], axis=0)).mean())
    assert rough[1] < 0.8 * rough[0]


def test_what_is_doubtful_is_noted(truth):
    import mitsuba as mi

    hidden = {
        "type": "rectangle",
        "to_world": mi.ScalarTransform4f().translate([0, 0, -1]),
        "bsdf": principled(np.full((4, 4, 3), 0.5), np.full((4, 4, 1), 0.5)),
    }
    scene = flat(cameras=CAMERAS[:1], hidden=hidden, integrator={"type": "path", "max_depth": 2})
    fitted = scene_fit.fit_scene(scene, [COLOUR, "hidden.bsdf.base_color"], None, truth[:1], iterations=2, spp=4)
    said = " ".join(fitted.notes)
    assert "1 view given: with fewer than 3 the fit is singular" in said
    assert "PathIntegrator has no gradients; prb replaces it with max_depth 2" in said
    assert "hidden.bsdf.base_color.data never had a gradient" in said
    assert COLOUR + " never" not in said


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"references": [np.ones((20, 24, 3))]}, InputRefused, "24 x 20 pixels, its film 24 x 24"),
        ({"references": [np.ones((24, 24))]}, InputRefused, r"expected \(rows, columns, 3\)"),
        ({"references": [np.zeros((24, 24, 3))]}, InputRefused, "black everywhere"),
        ({"references": [np.ones((24, 24, 3))]}, InputRefused, "saturated everywhere"),
        ({"references": [np.full((24, 24, 3), np.nan)]}, InputRefused, "576 pixels that are NaN"),
        ({"masks": [np.zeros((24, 24), bool)]}, InputRefused, "leaves no pixel"),
        ({"masks": [np.ones((4, 4), bool)]}, InputRefused, "the mask of sensor 0"),
        ({"references": []}, UsageError, "found 0 references for 1 sensors"),
        ({"sensors": [3]}, UsageError, "sensor 3 does not exist"),
        ({"loss": "l3"}, UsageError, "the loss 'l3'"),
        ({"iterations": 0}, UsageError, "1 or more"),
        ({"integrator": "prbb"}, UsageError, "the integrator 'prbb'"),
        ({"keys": ["wall.bsdf.base"]}, UsageError, "nearest keys"),
        ({"only": {COLOUR: np.ones((3, 3), bool)}}, UsageError, "expected"),
    ],
)
def test_refusals(truth, change, error, message):
    scene = flat(cameras=CAMERAS[:1])
    given = {"keys": [COLOUR], "sensors": None, "references": truth[:1]} | change
    with pytest.raises(error, match=message):
        scene_fit.fit_scene(scene, **given)


def test_the_written_scene_shows_the_fitted_picture(tmp_path, truth):
    """A user's file with a shared texture and literals, given and not; `mi.load_file` renders what was fitted."""
    import mitsuba as mi

    from mistyle.io.images.write import write_exr, write_png

    device.use()
    (tmp_path / "in").mkdir()
    write_png(tmp_path / "in" / "paint.png", np.full((8, 8, 3), 0.5))
    (tmp_path / "in" / "scene.xml").write_text(
        """<scene version="3.0.0"><!-- kept --><default name="size" value="8"/>
        <integrator type="prb"><integer name="max_depth" value="2"/></integrator>
        <sensor type="perspective"><float name="fov" value="26"/>
        <transform name="to_world"><lookat origin="0,0,3" target="0,0,0" up="0,1,0"/></transform>
        <film type="hdrfilm"><integer name="width" value="$size"/><integer name="height" value="$size"/>
        <rfilter type="box"/></film></sensor>
        <emitter type="point" id="lamp"><point name="position" x="0.4" y="0.5" z="1.5"/>
        <rgb name="intensity" value="6"/></emitter>
        <texture type="bitmap" id="paint"><string name="filename" value="paint.png"/></texture>
        <shape type="rectangle" id="wall"><bsdf type="principled"><ref name="base_color" id="paint"/></bsdf></shape>
        </scene>""",
        encoding="utf-8",
    )
    loaded = scene_xml.load_scene_for_fit(tmp_path / "in" / "scene.xml", {"size": 24})
    keys = ["wall.bsdf.base_color", "wall.bsdf.roughness", "wall.bsdf.specular", "lamp.intensity"]
    fitted = scene_fit.fit_scene(loaded.scene, keys, None, truth[:1], iterations=3, spp=4)
    written = scene_xml.write_scene(tmp_path / "out" / "wall.xml", loaded, fitted, write_exr)
    assert written.xml == tmp_path / "out" / "wall.xml" and "<!-- kept -->" in written.xml.read_text("utf-8")
    assert [p.name for p in written.textures.values()] == ["wall_wall.bsdf.base_color.exr"]
    shown = np.array(mi.render(mi.load_file(str(written.xml)), spp=4, seed=9))
    assert shown.shape[:2] == (24, 24)
    assert np.allclose(shown, np.array(mi.render(loaded.scene, spp=4, seed=9)), atol=1e-5)
    live = scene_xml.write_scene(tmp_path / "live" / "wall.xml", loaded.scene, fitted, write_exr)
    assert live.xml is None and "does not come from a file" in live.notes[0] and len(live.textures) == 1
