"""The closed-form models against Mitsuba, the formulae in float64, finite differences and conservation laws."""

import numpy as np
import pytest

from mistyle.core.drjit_arrays import aligned
from mistyle.render.deferred import bsdf
from mistyle.render.mitsuba import device
from tests.support.helpers import from_front

COUNT = 8000
UP = np.array([0, 0, 1], np.float32)
PARAMETERS = ("x", "y", "r", "g", "b", "roughness", "metallic")


def unit(v):
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def cases(rng, count=COUNT, roughness=(0.0, 1.0), both_sides=True):
    """Directions over the sphere, half of the lights near the mirror direction of the bumped normal."""
    wi, wo = unit(rng.normal(size=(count, 3))), unit(rng.normal(size=(count, 3)))
    normal = rng.normal(size=(count, 3)) * 0.3 + [0, 0, 1]
    half, n = count // 2, unit(normal)
    mirror = 2 * (wi * n).sum(-1, keepdims=True) * n - wi
    wo[:half] = unit(mirror + rng.normal(size=(count, 3)) * 0.05)[:half]
    if not both_sides:
        wi[:, 2], wo[:, 2] = np.abs(wi[:, 2]), np.abs(wo[:, 2])
    given = {"wi": wi, "wo": wo, "normal": normal, "albedo": rng.uniform(0, 1, (count, 3))}
    given |= {"roughness": rng.uniform(*roughness, count), "metallic": rng.uniform(0, 1, count)}
    return {name: value.astype(np.float32) for name, value in given.items()}


def loaded(given):
    """As Dr.Jit arrays of the current variant."""
    import mitsuba as mi

    kinds = {"wi": mi.Vector3f, "wo": mi.Vector3f, "normal": mi.Vector3f, "albedo": mi.Color3f}
    return {name: kinds.get(name, mi.Float)(np.ascontiguousarray(value.T)) for name, value in given.items()}


def mitsubas(given, flip, shadow, specular=0.5):
    """twosided(normalmap(principled)) with one texel per case, and the interaction that reads it."""
    import drjit as dr
    import mitsuba as mi

    count = len(given["wi"])

    def texture(values):
        data = mi.TensorXf(aligned(values.reshape(2, count // 2, -1)))
        return {"type": "bitmap", "data": data, "raw": True, "filter_type": "nearest"}

    inner = {"type": "principled", "specular": specular, "base_color": texture(given["albedo"])}
    inner |= {name: texture(given[name]) for name in ("roughness", "metallic")}
    options = {"flip_invalid_normals": flip, "use_shadowing_function": shadow}
    outer = {"type": "normalmap", "normalmap": texture(given["normal"] * 0.5 + 0.5), **options, "bsdf": inner}
    point = dr.zeros(mi.SurfaceInteraction3f, count)
    point.wi = mi.Vector3f(given["wi"].T)
    column, row = np.arange(count) % (count // 2), np.arange(count) // (count // 2)
    point.uv = mi.Point2f(np.float32((column + 0.5) / (count // 2)), np.float32((row + 0.5) / 2))
    point.sh_frame = mi.Frame3f(mi.Vector3f(0, 0, 1))
    return mi.load_dict({"type": "twosided", "bsdf": outer}), point


# The formulae once more, spelled out with explicit frames in float64: Burley 2012 as `principled` has it, and glTF 2.0
# appendix B as its text has it.


def fresnel(cosine, eta):
    cos_t = np.sqrt(1 - (1 - cosine**2) / eta**2)
    s = (cosine - eta * cos_t) / (cosine + eta * cos_t)
    p = (cos_t - eta * cosine) / (cos_t + eta * cosine)
    return 0.5 * (s**2 + p**2)


def ggx(h, alpha):
    return 1 / (np.pi * alpha**2 * (h[:, 0] ** 2 / alpha**2 + h[:, 1] ** 2 / alpha**2 + h[:, 2] ** 2) ** 2)


def principled64(wi, wo, albedo, roughness, metallic, eta=1.5):
    h = unit(wi + wo)
    d = (wi * h).sum(-1)
    alpha = np.maximum(0.001, roughness**2)

    def g1(v):
        return 2 / (1 + np.sqrt(1 + alpha**2 * (v[:, 0] ** 2 + v[:, 1] ** 2) / v[:, 2] ** 2))

    edge, fi, fo = (1 - d) ** 5, (1 - wi[:, 2]) ** 5, (1 - wo[:, 2]) ** 5
    metal = albedo + (1 - albedo) * edge[:, None]
    f = metallic[:, None] * metal + ((1 - metallic) * fresnel(d, eta))[:, None]
    shine = f * (ggx(h, alpha) * g1(wi) * g1(wo) / (4 * wi[:, 2] * wo[:, 2]))[:, None]
    r = 2 * roughness * d**2
    burley = (1 - fi / 2) * (1 - fo / 2) + r * (fo + fi + fo * fi * (r - 1))
    return (shine + albedo * ((1 - metallic) * burley / np.pi)[:, None]) * wo[:, 2:]


def gltf64(wi, wo, albedo, roughness, metallic):
    h = unit(wi + wo)
    nl, nv, nh, vh = wo[:, 2], wi[:, 2], h[:, 2], (wi * h).sum(-1)
    a2 = np.maximum(0.001, roughness**2) ** 2
    spread = a2 / (np.pi * (nh**2 * (a2 - 1) + 1) ** 2)
    visible = 0.5 / (nl * np.sqrt(nv**2 * (1 - a2) + a2) + nv * np.sqrt(nl**2 * (1 - a2) + a2))
    specular = (visible * spread)[:, None]
    edge = ((1 - np.abs(vh)) ** 5)[:, None]
    metal = specular * (albedo + (1 - albedo) * edge)
    fr = 0.04 + (1 - 0.04) * edge
    dielectric = (1 - fr) * albedo / np.pi + fr * specular
    return ((1 - metallic[:, None]) * dielectric + metallic[:, None] * metal) * wo[:, 2:]


MODELS64 = {"principled": principled64, "gltf": gltf64}


def reference64(model, given, flip=False, shadow=False):
    """Two sides, the bumped frame and its horizon, in float64 and with frames in full."""
    albedo, roughness, metallic = (np.asarray(given[name], np.float64) for name in ("albedo", "roughness", "metallic"))
    inner_i, inner_o, wo, n = framed(given, flip)
    seen = (inner_i[:, 2] > 0) & (inner_o[:, 2] > 0) & (wo[:, 2] > 0)
    up = np.array([0.0, 0, 1])
    value = MODELS64[model](*(np.where(seen[:, None], w, up) for w in (inner_i, inner_o)), albedo, roughness, metallic)
    if shadow:
        alpha2 = np.minimum(0.125 * (1 - n[:, 2] ** 2) / n[:, 2] ** 2, 1)
        tan2 = (1 - wo[:, 2] ** 2) / wo[:, 2] ** 2
        value *= (2 / (1 + np.sqrt(1 + alpha2 * tan2)))[:, None]
    return np.where(seen[:, None], value, 0)


def heights(given, flip):
    """The smallest of the three cosines that must be positive for light to be seen."""
    inner_i, inner_o, wo, _ = framed(given, flip)
    return np.minimum(np.minimum(inner_i[:, 2], inner_o[:, 2]), wo[:, 2])


def framed(given, flip):
    """wi and wo in the bumped frame; wo and the normal in the plain one, on the camera's side."""
    wi, wo, n = (np.asarray(given[name], np.float64) for name in ("wi", "wo", "normal"))
    wi, wo, n = wi.copy(), wo.copy(), n.copy()
    wo[:, 2] *= np.where(wi[:, 2] < 0, -1, 1)
    wi[:, 2] = np.abs(wi[:, 2])
    if flip:
        n[(wi * n).sum(-1) <= 0, :2] *= -1
    n = unit(n)
    s = unit(np.array([1.0, 0, 0]) - n * n[:, :1])
    frame = np.stack([s, np.cross(n, s), n], axis=1)
    return *(np.einsum("kij,kj->ki", frame, w) for w in (wi, wo)), wo, n


def relative(got, expected):
    """Largest relative error of the three channels, 0 where both are 0."""
    size = np.where(expected == 0, 1e-30, np.abs(expected))
    return (np.abs(got - expected) / size).max(-1)


def evaluate(reflectance, wi, wo, normal, albedo, roughness, metallic):
    """f cos(theta_o), of both terms."""
    import drjit as dr

    linear, constant = bsdf.terms(reflectance, wi, wo, normal, roughness, metallic)
    return dr.fma(albedo, linear, constant)


def ours(model, given, **options):
    return np.array(evaluate(bsdf.Reflectance(model, **options), **loaded(given))).T


@pytest.mark.parametrize("flip", [False, True])
@pytest.mark.parametrize("shadow", [False, True])
def test_principled_equals_mitsubas_plugin(rng, flip, shadow):
    device.use()
    import mitsuba as mi

    given = cases(rng)
    plugin, point = mitsubas(given, flip, shadow)
    theirs = np.array(plugin.eval(mi.BSDFContext(), point, mi.Vector3f(given["wo"].T))).T
    # The texture holds float32 of (n + 1) / 2: the same rounding for both.
    given["normal"] = (given["normal"] * np.float32(0.5) + np.float32(0.5)) * 2 - 1
    mine = ours("principled", given, flip_invalid=flip, shadowing=shadow)
    seen = (mine > 0).any(-1)
    assert 0.5 < seen.mean() < 0.6
    np.testing.assert_array_equal(mine == 0, theirs == 0)
    # A narrow lobe or a direction on the horizon magnifies the roundings of the directions themselves. Most of what is
    # left is Mitsuba's (1.6e-5 at roughness 0.1): it builds the bumped frame, we take cosines.
    exact, height = reference64("principled", given, flip, shadow), heights(given, flip)
    error, their_error = relative(mine, exact), relative(theirs, exact)
    plain, both = (
        seen & (height > 0.02) & (given["roughness"] > 0.1),
        seen & (height > 0.02) & (given["roughness"] > 0.2),
    )
    assert plain.sum() > 0.85 * seen.sum() and both.sum() > 0.75 * seen.sum()
    assert relative(mine, theirs)[both].max() < 1e-5
    assert error[plain].max() < 1e-5
    assert error.max() < 2e-4 and error[seen].mean() < their_error[seen].mean()


@pytest.mark.parametrize("specular", [0.0, 0.2, 1.0])
def test_specular_equals_mitsubas(rng, specular):
    """0 too, where the plugin has no reflection at the surface at all."""
    device.use()
    import mitsuba as mi

    given = cases(rng, 2000, roughness=(0.2, 1.0))
    given["normal"] = np.tile(UP, (2000, 1))
    plugin, point = mitsubas(given, False, False, specular)
    theirs = np.array(plugin.eval(mi.BSDFContext(), point, mi.Vector3f(given["wo"].T))).T
    assert relative(ours("principled", given, specular=specular), theirs).max() < 1e-5
    # Without a normal map and on the front only: the plain function.
    front = cases(rng, 2000, both_sides=False) | {"normal": given["normal"]}
    plain = {name: value for name, value in loaded(front).items() if name != "normal"}
    value = np.array(from_front("principled", **plain, specular=specular)).T
    np.testing.assert_allclose(value, ours("principled", front, specular=specular), rtol=1e-6, atol=0)


def test_gltf_equals_the_specification(rng):
    device.use()
    given = cases(rng)
    mine, exact = ours("gltf", given), reference64("gltf", given)
    np.testing.assert_array_equal(mine == 0, exact == 0)
    # A cosine is rounded by float32's 6e-8, whatever its size: what it is relative to is the cosine's own height.
    error, seen = relative(mine, exact), (exact > 0).any(-1)
    assert (error[seen] < 2e-5 + 6e-8 / heights(given, False)[seen]).all()
    assert np.quantile(error, 0.998) < 1e-5
    front = cases(rng, 2000, both_sides=False) | {"normal": np.tile(UP, (2000, 1))}
    plain = {name: value for name, value in loaded(front).items() if name != "normal"}
    np.testing.assert_allclose(np.array(from_front("gltf", **plain)).T, ours("gltf", front), rtol=1e-6, atol=0)


def gradients(model, given, **options):
    """By reverse AD, of the three channels' sum: (cases, PARAMETERS)."""
    import drjit as dr

    arrays = loaded(given)
    for name in ("normal", "albedo", "roughness", "metallic"):
        dr.enable_grad(arrays[name])
    dr.backward(dr.sum(dr.sum(evaluate(bsdf.Reflectance(model, **options), **arrays))))
    rows = [dr.grad(arrays["normal"])[:2], dr.grad(arrays["albedo"]), dr.grad(arrays["roughness"])]
    rows.append(dr.grad(arrays["metallic"]))
    return np.concatenate([np.array(row).reshape(-1, len(given["wi"])) for row in rows]).T.astype(np.float64)


def differences(model, given, step, **options):
    """Central, of the float64 formulae."""
    places = [("normal", 0), ("normal", 1), ("albedo", 0), ("albedo", 1), ("albedo", 2), ("roughness",), ("metallic",)]
    result = []
    for name, *channel in places:
        ends = []
        for sign in (1, -1):
            moved = {key: value.astype(np.float64) for key, value in given.items()}
            moved[name][(slice(None), *channel)] += sign * step
            ends.append(reference64(model, moved, **options).sum(-1))
        result.append((ends[0] - ends[1]) / (2 * step))
    return np.stack(result, -1)


@pytest.mark.parametrize("model", list(bsdf.MODELS))
@pytest.mark.parametrize(("flip", "shadow"), [(False, False), (True, True)])
def test_gradients_equal_finite_differences(rng, model, flip, shadow):
    device.use()
    # A step from the horizon or the floor of alpha the difference straddles a kink, so neither comes near them.
    given = cases(rng, roughness=(0.06, 1.0))
    given["metallic"] = given["metallic"] * np.float32(0.99) + np.float32(0.005)
    value = reference64(model, given, flip, shadow)
    steps = 1e-6
    expected = differences(model, given, steps, flip=flip, shadow=shadow)
    wider = differences(model, given, 10 * steps, flip=flip, shadow=shadow)
    smooth = np.abs(expected - wider).max(-1) <= 1e-4 * np.abs(expected).max(-1) + 1e-9
    assert smooth.mean() > 0.98
    assert (np.abs(expected[value.any(-1)]) > 1e-6).mean(0).min() > 0.9
    got = gradients(model, given, flip_invalid=flip, shadowing=shadow)
    assert np.isfinite(got).all()
    assert (got[(value == 0).all(-1)] == 0).all()
    error = np.abs(got - expected)[smooth]
    for k, name in enumerate(PARAMETERS):
        # Against the largest derivative of the case: one that passes through zero has no relative error.
        size = np.abs(expected[smooth][:, k]) + 0.05 * np.abs(value[smooth]).sum(-1)
        assert np.max(error[:, k] / (size + 1e-6)) < 1e-3, name


def test_gradients_equal_mitsubas(rng):
    """Through the plugin's four textures, one texel per case."""
    device.use()
    import drjit as dr
    import mitsuba as mi

    given = cases(rng, 4000, roughness=(0.06, 1.0))
    plugin, point = mitsubas(given, False, False)
    keys = {"normal": "brdf_0.normalmap.data", "albedo": "brdf_0.nested_bsdf.base_color.data"}
    keys |= {name: f"brdf_0.nested_bsdf.{name}.data" for name in ("roughness", "metallic")}
    textures = mi.traverse(plugin)
    for key in keys.values():
        dr.enable_grad(textures[key])
    textures.update()
    value = plugin.eval(mi.BSDFContext(), point, mi.Vector3f(given["wo"].T))
    dr.backward(dr.sum(dr.sum(value)))
    theirs = np.concatenate([np.array(dr.grad(textures[key])).reshape(4000, -1) for key in keys.values()], -1)
    theirs = np.delete(
        theirs * [0.5, 0.5, 0.5, 1, 1, 1, 1, 1], 2, axis=1
    )  # the texture holds (n + 1) / 2; z is not asked
    mine = gradients("principled", given)
    size = np.abs(theirs) + 0.05 * np.abs(np.array(value).T).sum(-1, keepdims=True) + 1e-6
    assert np.quantile(np.abs(mine - theirs) / size, 0.999) < 1e-3


@pytest.mark.parametrize("model", list(bsdf.MODELS))
def test_roughness_below_its_floor_has_no_gradient_by_alpha(model, rng):
    """Principled's diffuse part does read the roughness there; a metal does not."""
    device.use()
    given = cases(rng, 2000, roughness=(0.0, 0.99 * bsdf.ALPHA_FLOOR**0.5))
    given["metallic"][:] = 1
    seen = reference64(model, given).any(-1)
    assert seen.mean() > 0.5
    assert (gradients(model, given)[:, 5] == 0).all()
    given["roughness"][:] = 1.05 * bsdf.ALPHA_FLOOR**0.5
    assert (gradients(model, given)[seen, 5] != 0).mean() > 0.99


@pytest.mark.parametrize("model", list(bsdf.MODELS))
def test_extreme_input_gives_finite_values_and_gradients(model):
    """Grazing and opposite directions, black and mirror-like materials, normals on the horizon, of length 0, inside."""
    device.use()
    axes = np.array([[0, 0, 1], [0, 0, -1], [1, 0, 0], [-1, 0, 0], [1, 0, 1e-7], [-1, 0, 1e-7], [0, 1, -0.0]])
    normals = np.array([[0, 0, 1], [0, 0, 0], [1, 0, 0], [0, 0, -1], [0.7, 0, 0.7], [-1, 0, 1e-6]])
    levels = np.array([0.0, 1.0])
    grid = np.meshgrid(*(np.arange(len(v)) for v in (axes, axes, normals, levels, levels, levels)), indexing="ij")
    wi, wo, n, albedo, roughness, metallic = (index.ravel() for index in grid)
    given = {"wi": axes[wi], "wo": axes[wo], "normal": normals[n], "albedo": np.repeat(levels[albedo, None], 3, 1)}
    given |= {"roughness": levels[roughness], "metallic": levels[metallic]}
    given = {name: value.astype(np.float32) for name, value in given.items()}
    for options in ({}, {"flip_invalid": True, "shadowing": True}):
        value = ours(model, given, **options)
        assert np.isfinite(value).all() and (value >= 0).all()
        assert np.isfinite(gradients(model, given, **options)).all()


@pytest.mark.parametrize("model", list(bsdf.MODELS))
def test_reciprocity(model, rng):
    device.use()
    given = cases(rng, 4000, roughness=(0.2, 1.0), both_sides=False)
    given["normal"][:] = (0, 0, 1)
    swapped = given | {"wi": given["wo"], "wo": given["wi"]}
    there = ours(model, given) * given["wi"][:, 2:]
    back = ours(model, swapped) * given["wo"][:, 2:]
    np.testing.assert_allclose(there, back, rtol=2e-5, atol=1e-9)


def albedo_of(model, cos_i, colour, roughness, metallic, side=256):
    """The share of light that is reflected towards one direction, by a midpoint rule over GGX-warped directions."""
    import mitsuba as mi

    u, v = (np.stack(np.meshgrid(*[(np.arange(side) + 0.5) / side] * 2)).reshape(2, -1)).astype(np.float64)
    wi = np.array([np.sqrt(1 - cos_i**2), 0, cos_i])
    total = np.zeros(3)
    # Half of the points follow the cosine, half GGX about the mirror direction; the balance heuristic joins them.
    a2 = roughness**4
    angle = 2 * np.pi * v
    cosine = np.stack([np.sqrt(u) * np.cos(angle), np.sqrt(u) * np.sin(angle), np.sqrt(1 - u)], -1)
    z = np.sqrt((1 - u) / (1 + (a2 - 1) * u))
    h = np.stack([np.sqrt(1 - z**2) * np.cos(angle), np.sqrt(1 - z**2) * np.sin(angle), z], -1)
    mirror = 2 * (h @ wi)[:, None] * h - wi
    for wo in (cosine, mirror):
        up = wo[:, 2] > 1e-6
        half = unit(wi + np.where(up[:, None], wo, [0, 0, 1]))
        lobe = a2 / (np.pi * (half[:, 2] ** 2 * (a2 - 1) + 1) ** 2) * half[:, 2] / (4 * np.abs(half @ wi) + 1e-12)
        density = np.maximum(wo[:, 2], 0) / np.pi + lobe
        count = len(wo)
        wide = [np.full(count, value, np.float32) for value in (*wi, *colour, roughness, metallic)]
        value = from_front(
            model,
            mi.Vector3f(*wide[:3]),
            mi.Vector3f(wo.T.astype(np.float32)),
            mi.Color3f(*wide[3:6]),
            *map(mi.Float, wide[6:]),
        )
        total += (np.where(up, np.array(value) / density, 0)).mean(-1)
    return total


@pytest.mark.parametrize("cos_i", [1.0, 0.7, 0.2])
def test_gltf_reflects_no_more_than_it_receives(cos_i):
    """White furnace. The specification's dielectric may: its 1 - F is of the half vector, and the lobe comes on top."""
    device.use()
    white = (1.0, 1.0, 1.0)
    metal = [albedo_of("gltf", cos_i, white, roughness, 1.0)[0] for roughness in (0.2, 0.5, 1.0)]
    assert 1.001 > metal[0] > metal[1] > metal[2]  # what single scattering loses grows with the roughness
    assert metal[0] > 0.97
    for roughness in (0.2, 0.5, 1.0):
        clear, plain = (albedo_of("gltf", cos_i, (c, c, c), roughness, 0.0)[0] for c in (0.0, 1.0))
        assert 0.01 < clear < (0.05 if cos_i > 0.5 else 0.4)
        assert 0.9 < plain < 1.002 + (0 if cos_i > 0.5 else clear)
        half = albedo_of("gltf", cos_i, white, roughness, 0.5)[0]
        whole = albedo_of("gltf", cos_i, white, roughness, 1.0)[0]
        assert abs(half - (plain + whole) / 2) < 1e-4


def test_principled_has_the_furnace_values_of_mitsuba():
    """Known to gain energy at grazing angles; the values are Mitsuba's own, integrated."""
    device.use()
    assert 1.01 < albedo_of("principled", 1.0, (1, 1, 1), 0.5, 0.0)[0] < 1.06
    np.testing.assert_allclose(albedo_of("principled", 0.999, (1, 1, 1), 0.5, 1.0)[0], 0.915, atol=0.02)
    np.testing.assert_allclose(albedo_of("principled", 0.999, (1, 1, 1), 0.8, 1.0)[0], 0.554, atol=0.02)
