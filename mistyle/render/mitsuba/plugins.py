"""Two Python BSDFs for Mitsuba: glTF's metallic-roughness model, and normal maps in MikkTSpace frames.

`register` registers them with the current variant. They replace `principled` and `normalmap` inside `twosided`, with
the same names in `mi.traverse`, under any integrator and under AD:

- `mistyle_gltf`: textures `base_color`, `roughness`, `metallic`, float `specular` (0.5: the specification; see
  `bsdf.gltf`). The front side reflects, the back is black. At least half of the samples follow GGX's visible normals,
  the rest the cosine. A `BSDFContext` that selects one component gets both.
- `mistyle_normalmap`: texture `normalmap` holding (n + 1) / 2 and one nested BSDF. n is relative to the mesh attributes
  `vertex_tangent` (3 floats, world space) and `vertex_handedness` (1 or -1): the interpolated tangent, orthogonalised
  to the interpolated normal, and bitangent = handedness · (normal x tangent). Without these attributes or a shape, the
  frame of the surface interaction is used. `flip_invalid_normals` (default False) as in Mitsuba's `normalmap`; its
  shadowing function is omitted, as in glTF viewers.
"""

from typing import Any

import numpy as np
from jaxtyping import Float

from mistyle.core.mesh import Welded
from mistyle.core.rows import corner_rows, distinct
from mistyle.render.deferred import bsdf
from mistyle.render.mitsuba import device
from mistyle.render.mitsuba.device import dr, mi

GLTF, NORMALMAP = "mistyle_gltf", "mistyle_normalmap"
TANGENT, HANDEDNESS = "vertex_tangent", "vertex_handedness"

_registered: set[str] = set()


def register() -> None:
    """Register both plugins with Mitsuba's current variant (any; by default that of `device.use`)."""
    variant = mi.variant() or device.use()
    if variant not in _registered:
        mi.register_bsdf(GLTF, _gltf_class())
        mi.register_bsdf(NORMALMAP, _normalmap_class())
        _registered.add(variant)


def with_tangents(welded: Welded, tangents: Float[np.ndarray, "f 3 4"]) -> tuple[Welded, dict[str, np.ndarray]]:
    """Split the indices whose corners differ in tangent; returns the attributes of the new indices too."""
    index, corners = welded.faces.reshape(-1), tangents.reshape(-1, 4).astype(np.float32)
    first, inverse = distinct(corner_rows(index, corners))
    old, attributes = index[first], corners[first]
    split = Welded(
        positions=welded.positions[old],
        normals=welded.normals[old],
        uvs=welded.uvs[old],
        faces=inverse.reshape(-1, 3).astype(np.int32),
        vertex=welded.vertex[old],
    )
    return split, {TANGENT: attributes[:, :3], HANDEDNESS: np.sign(attributes[:, 3:])}


def _gltf_class() -> type:
    """The BSDF as a class derived from `mi`'s current variant."""

    class Gltf(mi.BSDF):
        def __init__(self, props):
            super().__init__(props)
            self.base_color = props.get_texture("base_color", 0.5)
            self.roughness = props.get_texture("roughness", 0.5)
            self.metallic = props.get_texture("metallic", 0.0)
            self.specular = float(props.get("specular", 0.5))
            front = mi.BSDFFlags.FrontSide
            self.m_components = [mi.BSDFFlags.DiffuseReflection | front, mi.BSDFFlags.GlossyReflection | front]
            self.m_flags = self.m_components[0] | self.m_components[1]

        def traverse(self, cb):
            for name in ("base_color", "roughness", "metallic"):
                cb.put(name, getattr(self, name), mi.ParamFlags.Differentiable)

        def eval(self, ctx, si, wo, active=True):
            return self._eval(si, wo, active, self.metallic.eval_1(si, active), self.roughness.eval_1(si, active))

        def pdf(self, ctx, si, wo, active=True):
            return _density(si, wo, active, self.metallic.eval_1(si, active), self.roughness.eval_1(si, active))

        def eval_pdf(self, ctx, si, wo, active=True):
            metallic, roughness = self.metallic.eval_1(si, active), self.roughness.eval_1(si, active)
            value = self._eval(si, wo, active, metallic, roughness)
            return value, _density(si, wo, active, metallic, roughness)

        def sample(self, ctx, si, sample1, sample2, active=True):
            metallic, roughness = self.metallic.eval_1(si, active), self.roughness.eval_1(si, active)
            shiny, spread = _strategy(metallic, roughness)
            glossy = sample1 < shiny
            half, _ = spread.sample(mi.Vector3f(si.wi.x, si.wi.y, dr.abs(si.wi.z)), sample2)
            wo = dr.select(glossy, mi.reflect(si.wi, half), mi.warp.square_to_cosine_hemisphere(sample2))
            sampled = reflected(dr.detach(wo), glossy)
            sampled.pdf = _density(si, sampled.wo, active, metallic, roughness)
            value = self._eval(si, sampled.wo, active, metallic, roughness)
            usable = active & (sampled.pdf > 0)
            return sampled, dr.select(usable, value / dr.select(usable, sampled.pdf, 1), 0)

        def eval_diffuse_reflectance(self, si, active=True):
            return self.base_color.eval(si, active)

        def to_string(self):
            parts = ", ".join(f"{name}={getattr(self, name)}" for name in ("base_color", "roughness", "metallic"))
            return f"{GLTF}[{parts}, specular={self.specular}]"

        def _eval(self, si, wo, active, metallic, roughness):
            albedo = self.base_color.eval(si, active)
            angles = bsdf.upright(si.wi, wo)
            linear, constant = bsdf.MODELS["gltf"](angles, roughness, metallic, self.specular)
            return dr.select(active & angles.valid, dr.fma(albedo, linear, constant), 0)

    return Gltf


def _strategy(metallic: Any, roughness: Any) -> tuple[Any, Any]:
    """The share of samples that follow GGX's visible normals, and that distribution; the rest is cosine."""
    alpha = dr.maximum(dr.square(dr.detach(roughness)), bsdf.ALPHA_FLOOR)
    share = 0.5 + 0.5 * dr.clip(dr.detach(metallic), 0, 1)
    return share, mi.MicrofacetDistribution(mi.MicrofacetType.GGX, alpha, sample_visible=True)


def _density(si: Any, wo: Any, active: Any, metallic: Any, roughness: Any) -> Any:
    """The density of directions from `sample`."""
    shiny, spread = _strategy(metallic, roughness)
    above = active & (si.wi.z > 0) & (wo.z > 0)
    half = dr.normalize(dr.select(above, si.wi + wo, mi.Vector3f(0, 0, 1)))
    visible = spread.pdf(dr.select(above, si.wi, mi.Vector3f(0, 0, 1)), half)
    lobe = visible / (4 * dr.select(above, dr.dot(wo, half), 1))
    return dr.select(above, dr.lerp(wo.z / dr.pi, lobe, shiny), 0)


def reflected(wo: Any, glossy: Any) -> Any:
    """A sample of reflection towards `wo`, of the glossy component or the diffuse one; its density is not set."""
    sampled = dr.zeros(mi.BSDFSample3f)
    sampled.wo = wo
    sampled.eta = mi.Float(1)
    diffuse, gloss = mi.UInt32(+mi.BSDFFlags.DiffuseReflection), mi.UInt32(+mi.BSDFFlags.GlossyReflection)
    sampled.sampled_type = dr.select(glossy, gloss, diffuse)
    sampled.sampled_component = dr.select(glossy, mi.UInt32(1), mi.UInt32(0))
    return sampled


def _normalmap_class() -> type:
    """The BSDF as a class derived from `mi`'s current variant."""

    class NormalMap(mi.BSDF):
        def __init__(self, props):
            super().__init__(props)
            nested = [child for _, child in props.objects() if isinstance(child, mi.BSDF)]
            if len(nested) != 1:
                raise RuntimeError(f"{NORMALMAP}: found {len(nested)} nested BSDFs; expected exactly one")
            self.nested = nested[0]
            self.normalmap = props.get_texture("normalmap")
            self.flip = bool(props.get("flip_invalid_normals", False))
            self.m_components = [self.nested.flags(k) for k in range(self.nested.component_count())]
            self.m_flags = self.nested.flags()

        def traverse(self, cb):
            cb.put("nested_bsdf", self.nested, mi.ParamFlags.Differentiable)
            cb.put("normalmap", self.normalmap, mi.ParamFlags.Differentiable | mi.ParamFlags.Discontinuous)

        def eval(self, ctx, si, wo, active=True):
            tilted, frame = _tilted(self.normalmap, self.flip, si, active)
            inner = frame.to_local(wo)
            active = active & (wo.z * inner.z > 0)
            return dr.select(active, self.nested.eval(ctx, tilted, inner, active), 0)

        def pdf(self, ctx, si, wo, active=True):
            tilted, frame = _tilted(self.normalmap, self.flip, si, active)
            inner = frame.to_local(wo)
            active = active & (wo.z * inner.z > 0)
            return dr.select(active, self.nested.pdf(ctx, tilted, inner, active), 0)

        def eval_pdf(self, ctx, si, wo, active=True):
            tilted, frame = _tilted(self.normalmap, self.flip, si, active)
            inner = frame.to_local(wo)
            active = active & (wo.z * inner.z > 0)
            value, pdf = self.nested.eval_pdf(ctx, tilted, inner, active)
            return dr.select(active, value, 0), dr.select(active, pdf, 0)

        def sample(self, ctx, si, sample1, sample2, active=True):
            tilted, frame = _tilted(self.normalmap, self.flip, si, active)
            sampled, weight = self.nested.sample(ctx, tilted, sample1, sample2, active)
            outer = frame.to_world(sampled.wo)
            active = active & (sampled.wo.z * outer.z > 0)
            sampled.pdf = dr.select(active, sampled.pdf, 0)
            sampled.wo = outer
            return sampled, dr.select(active, weight, 0)

        def sh_frame(self, si, active=True):
            return _tilted(self.normalmap, self.flip, si, active)[0].sh_frame

        def eval_diffuse_reflectance(self, si, active=True):
            return self.nested.eval_diffuse_reflectance(si, active)

        def to_string(self):
            return f"{NORMALMAP}[nested_bsdf={self.nested}, normalmap={self.normalmap}]"

    return NormalMap


def _tilted(normalmap: Any, flip: bool, si: Any, active: Any) -> tuple[Any, Any]:
    """The interaction in the bumped frame, and that frame relative to `si.sh_frame`."""
    s, t = _tangents(si, active)
    encoded = normalmap.eval_3(si, active)
    x, y, z = 2 * encoded.x - 1, 2 * encoded.y - 1, 2 * encoded.z - 1
    x, y = x * s.x + y * t.x, x * s.y + y * t.y
    if flip:
        turn = dr.select(dr.dot(si.wi, mi.Vector3f(x, y, z)) * si.wi.z <= 0, -1.0, 1.0)
        x, y = x * turn, y * turn
    n = dr.normalize(mi.Normal3f(x, y, z))
    along = mi.Vector3f(s.x, s.y, 0)
    frame = mi.Frame3f()
    frame.n = n
    frame.s = dr.normalize(along - n * dr.dot(n, along))
    frame.t = dr.cross(n, frame.s)
    tilted = mi.SurfaceInteraction3f(si)
    tilted.sh_frame = mi.Frame3f(si.to_world(frame.s), si.to_world(frame.t), si.to_world(frame.n))
    tilted.wi = frame.to_local(si.wi)
    return tilted, frame


def _tangents(si: Any, active: Any) -> tuple[Any, Any]:
    """The normal map's two axes in the tangent plane of `si.sh_frame`, 2D."""
    # No `&=` here: Dr.Jit would change the caller's mask.
    valid = active
    if dr.is_jit_v(mi.Float):
        valid = valid & (si.shape != None)  # noqa: E711
        valid = valid & si.shape.has_attribute(TANGENT, valid)
    elif not (active and si.shape is not None and si.shape.has_attribute(TANGENT)):
        return mi.Vector2f(1, 0), mi.Vector2f(0, 1)
    world = si.shape.eval_attribute_3(TANGENT, si, valid)
    hand = dr.mulsign(mi.Float(1), si.shape.eval_attribute_1(HANDEDNESS, si, valid))
    local = si.to_local(mi.Vector3f(world.x, world.y, world.z))
    s = mi.Vector2f(local.x, local.y)
    valid = valid & (dr.squared_norm(s) > 1e-12)
    s = dr.select(valid, dr.normalize(dr.select(valid, s, 1)), mi.Vector2f(1, 0))
    return s, mi.Vector2f(-s.y, s.x) * dr.select(valid, hand, 1)
