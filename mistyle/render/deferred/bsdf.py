"""The two reflectance models in closed form, over Dr.Jit arrays in the tangent frame of a surface point.

Both are isotropic, so a normal map enters through four cosines and no frame is built. Both are linear in the albedo:
f cos(theta_o) = albedo · linear + constant with two scalars (`terms`). Directions are unit vectors that point away from
the surface, `wi` to the camera and `wo` to the light, as in Mitsuba. Everything is linear Rec.709; parameters are 0..1
and not clamped here. All functions take any Dr.Jit float type, are differentiable by its AD, trace about 150 operations
and evaluate nothing. Where the result is 0 the gradient is 0, never NaN, for finite input.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

from mistyle.render.mitsuba.device import dr

# Mitsuba's floor of the GGX alpha; roughness² below it has no effect and no gradient, in both models.
ALPHA_FLOOR = 1e-3

# A dielectric of index 1.5, as glTF fixes it: (0.5 / 2.5)².
GLTF_F0 = 0.04


@dataclass(frozen=True)
class Reflectance:
    """A model ("principled" or "gltf") and its options.

    flip_invalid  the perturbed normal turns to the camera's side, as Mitsuba's flip_invalid_normals
    shadowing     the bump terminator, as Mitsuba's use_shadowing_function
    specular      as in `principled` and `gltf`
    """

    model: str = "principled"
    flip_invalid: bool = False
    shadowing: bool = False
    specular: float = 0.5


class Angles(NamedTuple):
    """Cosines of wi and wo with the normal, of wi with the half vector; squared cosine and sine of the half vector.

    They are finite where `valid` is False: one of the directions is not above the surface there.
    """

    cos_i: Any
    cos_o: Any
    cos_d: Any
    cos2_h: Any
    sin2_h: Any
    valid: Any


def terms(reflectance: Reflectance, wi: Any, wo: Any, normal: Any, roughness: Any, metallic: Any) -> tuple[Any, Any]:
    """Albedo-linear and constant term: f cos(theta_o) is albedo · linear + constant under the tangent-space `normal`
    (-1..1, any length > 0). Several lights can be summed before multiplication by the albedo.

    Equals `mi.BSDF.eval` of twosided(normalmap(principled)) with its options flip_invalid_normals and
    use_shadowing_function: light or camera below the perturbed horizon give 0. `wi`, `wo` in the unperturbed frame, on
    either side of the surface.
    """
    wo_z, wi_z = dr.mulsign(wo.z, wi.z), dr.abs(wi.z)
    x, y, z = normal.x, normal.y, normal.z
    if reflectance.flip_invalid:
        turn = dr.select(dr.fma(wi.x, x, dr.fma(wi.y, y, wi_z * z)) * wi_z <= 0, -1.0, 1.0)
        x, y = x * turn, y * turn
    scale = dr.rsqrt(dr.maximum(dr.fma(x, x, dr.fma(y, y, z * z)), 1e-20))
    n = (x * scale, y * scale, z * scale)
    angles = _angles(n, (wi.x, wi.y, wi_z), (wo.x, wo.y, wo_z), wo_z > 0)
    linear, constant = MODELS[reflectance.model](angles, roughness, metallic, reflectance.specular)
    if reflectance.shadowing:
        shade = _shadow_terminator(n[2], dr.select(angles.valid, wo_z, 1))
        linear, constant = linear * shade, constant * shade
    return dr.select(angles.valid, linear, 0), dr.select(angles.valid, constant, 0)


def upright(wi: Any, wo: Any) -> Angles:
    """The models' cosines of two directions about the unperturbed normal; valid on the front side only."""
    return _angles((0, 0, 1), (wi.x, wi.y, wi.z), (wo.x, wo.y, wo.z), True)


def _angles(n: tuple, wi: tuple, wo: tuple, valid: Any) -> Angles:
    cos_i, cos_o = _dot(n, wi), _dot(n, wo)
    half = (wi[0] + wo[0], wi[1] + wo[1], wi[2] + wo[2])
    length2 = _dot(half, half)
    valid = (cos_i > 0) & (cos_o > 0) & (length2 > 1e-12) & valid
    length2 = dr.select(valid, length2, 1)
    cos_i, cos_o = dr.select(valid, cos_i, 1), dr.select(valid, cos_o, 1)
    # |n x h|² rather than 1 - (n·h)², which loses all significant digits at highlights of smooth surfaces.
    cross = (
        dr.fma(n[1], half[2], -n[2] * half[1]),
        dr.fma(n[2], half[0], -n[0] * half[2]),
        dr.fma(n[0], half[1], -n[1] * half[0]),
    )
    inverse = dr.rcp(length2)
    sin2_h, cos2_h = _dot(cross, cross) * inverse, dr.square(cos_i + cos_o) * inverse
    return Angles(cos_i, cos_o, dr.minimum(0.5 * dr.sqrt(length2), 1), cos2_h, dr.select(valid, sin2_h, 1), valid)


def _principled(a: Angles, roughness: Any, metallic: Any, specular: float) -> tuple[Any, Any]:
    """Mitsuba 3.9.1's `principled` with base_color, roughness, metallic, specular.

    Burley diffuse and retro-reflection, not scaled by 1 - F; GGX with alpha = max(0.001, roughness²), separable Smith,
    exact dielectric Fresnel of eta = 2 / (1 - sqrt(0.08 specular)) - 1, Schlick for the metal. With `specular` 0 plugin
    and function have no specular reflection, not even for metals. Unlike the plugin's, the gradient by metallic at
    exactly 1 includes the diffuse part.
    """
    dielectric = 1 - metallic
    fi, fo = _schlick(a.cos_i), _schlick(a.cos_o)
    retro = 2 * dr.square(a.cos_d) * roughness
    burley = dr.fma(-0.5, fi, 1) * dr.fma(-0.5, fo, 1) + retro * (fi + fo + fi * fo * (retro - 1))
    linear = dielectric * burley * (a.cos_o * (1 / dr.pi))
    if specular == 0:
        return linear, dr.zeros(type(linear))
    alpha2 = _alpha2(roughness)
    root_i, root_o = _smith_root(a.cos_i, alpha2), _smith_root(a.cos_o, alpha2)
    spread = dr.fma(alpha2, a.cos2_h, a.sin2_h)
    lobe = alpha2 * a.cos_o / (dr.pi * dr.square(spread) * ((a.cos_i + root_i) * (a.cos_o + root_o)))
    edge = _schlick(a.cos_d)
    tint, white = _metal(lobe, metallic, edge)
    return linear + tint, dr.fma(lobe * dielectric, _fresnel(a.cos_d, specular), white)


def _gltf(a: Angles, roughness: Any, metallic: Any, specular: float) -> tuple[Any, Any]:
    """glTF 2.0's metallic-roughness material, appendix B.2: mix(dielectric, metal, metallic).

    dielectric = mix(albedo / pi, D V, F(0.04)), metal = D V F(albedo); F(f0) = f0 + (1 - f0)(1 - |wi·h|)^5, D is GGX
    with alpha = max(0.001, roughness²) (the specification leaves roughness 0 to the renderer), V height-correlated
    Smith. `specular` / 0.5 scales the reflection of the dielectric; 0.5 is the specification. The specification's
    second form, one Fresnel term for the mixed f0, differs where 0 < metallic < 1.
    """
    edge, lobe = _schlick(a.cos_d), _lobe(a, _alpha2(roughness))
    tint, white = _metal(lobe, metallic, edge)
    fresnel = (2 * specular) * dr.fma(1 - GLTF_F0, edge, GLTF_F0)
    dielectric = 1 - metallic
    return dr.fma(dielectric, (1 - fresnel) * a.cos_o * (1 / dr.pi), tint), dr.fma(dielectric, fresnel * lobe, white)


def layered(
    a: Angles, albedo: Any, roughness: Any, metallic: Any, f0: Any, f90: float, coat: tuple[float, float]
) -> Any:
    """f cos(theta_o) of glTF's surface with KHR_materials_specular, KHR_materials_ior and KHR_materials_clearcoat.

    `albedo` and `f0` (of the dielectric) are colours; F(f0) = f0 + (f90 - f0)(1 - |wi·h|)^5, and the diffuse lobe loses
    its largest channel. `coat` is (strength, roughness); of index 1.5, it covers the base by its Fresnel term at the
    normal. With f0 = 0.04, f90 = 1 and no coat it is `_gltf`. Finite where `a.valid` is False.
    """
    edge = _schlick(a.cos_d)
    lobe = _lobe(a, _alpha2(roughness))
    fresnel = f0 + (f90 - f0) * edge
    dielectric = (1 - dr.max(fresnel)) * albedo * (a.cos_o * (1 / dr.pi)) + fresnel * lobe
    metal = (albedo + (1 - albedo) * edge) * lobe
    base = dielectric * (1 - metallic) + metal * metallic
    strength, coat_roughness = coat
    if strength == 0:
        return base
    share = strength * dr.fma(1 - GLTF_F0, _schlick(a.cos_i), GLTF_F0)
    return base * (1 - share) + share * _lobe(a, max(coat_roughness**2, ALPHA_FLOOR) ** 2)


def _lobe(a: Angles, alpha2: Any) -> Any:
    """GGX: D V cos(theta_o) with height-correlated Smith."""
    visible = a.cos_o * _smith_root(a.cos_i, alpha2) + a.cos_i * _smith_root(a.cos_o, alpha2)
    spread = dr.fma(alpha2, a.cos2_h, a.sin2_h)
    return alpha2 * a.cos_o / (2 * dr.pi * dr.square(spread) * visible)


MODELS: dict[str, Callable[[Angles, Any, Any, float], tuple[Any, Any]]] = {"principled": _principled, "gltf": _gltf}


def _metal(lobe: Any, metallic: Any, edge: Any) -> tuple[Any, Any]:
    """Schlick's albedo + (1 - albedo) · edge, as its albedo-linear and constant term."""
    weighted = lobe * metallic
    return weighted * (1 - edge), weighted * edge


def _alpha2(roughness: Any) -> Any:
    return dr.square(dr.maximum(dr.square(roughness), ALPHA_FLOOR))


def _smith_root(cosine: Any, alpha2: Any) -> Any:
    """cos · sqrt(1 + alpha² tan²), finite at grazing angles."""
    return dr.sqrt(dr.fma(alpha2, 1 - dr.square(cosine), dr.square(cosine)))


def _fresnel(cosine: Any, specular: float) -> Any:
    """Exact reflectance of a dielectric, unpolarised, from outside."""
    eta2 = (2 / (1 - (0.08 * specular) ** 0.5) - 1) ** 2
    g, inside = dr.sqrt(dr.fma(cosine, cosine, eta2 - 1)), eta2 * cosine
    return 0.5 * (dr.square((g - cosine) / (g + cosine)) + dr.square((inside - g) / (inside + g)))


def _schlick(cosine: Any) -> Any:
    m = 1 - cosine
    return dr.square(dr.square(m)) * m


def _shadow_terminator(normal_z: Any, wo_z: Any) -> Any:
    """Estevez et al. 2019, the bump terminator: attenuation of light at wo on a surface bumped by `normal_z`."""
    z2 = dr.maximum(dr.square(normal_z), 1e-12)
    alpha2 = dr.minimum(0.125 * (1 - z2) / z2, 1)
    return 2 / (1 + dr.sqrt(dr.fma(alpha2, (1 - dr.square(wo_z)) / dr.square(wo_z), 1)))


def _dot(a: tuple, b: tuple) -> Any:
    return dr.fma(a[0], b[0], dr.fma(a[1], b[1], a[2] * b[2]))
