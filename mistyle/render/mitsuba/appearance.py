"""An asset's full material: glTF's surface with F0, F90 and a clear coat, opacity, emission, unlit materials.

Four Python plugins for Mitsuba; plain materials do not need them (`object_shapes`):

- a BSDF `LayeredSurface`: `mistyle_gltf` with F0 as a texture, F90, and a clear coat (`bsdf.layered`);
- a texture `Cut`: 1 where another one reaches a cutoff, else 0 (glTF's MASK);
- an emitter `Glow`: radiance of a mesh to either side, times its opacity. Light paths find it by BSDF sampling, not by
  emitter sampling: directly visible emission has no noise, and no sample of the environment is lost to it;
- an integrator `Path`: Mitsuba's `path` with hidden emitters, but it hides only the environment, and surfaces that a
  path passes through do not count as bounces. Where the asset has opacity, shadow rays pass through it as in `volpath`.
"""

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
from jaxtyping import Float

from mistyle.core.asset import Asset, Material, Shading
from mistyle.core.maps import OwnMaps
from mistyle.geometry.tangents import corner_tangents
from mistyle.render.deferred import bsdf
from mistyle.render.mitsuba import device, plugins
from mistyle.render.mitsuba import scene as scenery
from mistyle.render.mitsuba.device import dr, mi

PASSED = 32  # most surfaces that a path passes through, and most that one of its shadow rays passes through
LABELS = ("sampler", "ray", "active", "depth", "passed", "result", "throughput", "before", "pdf", "delta", "valid")
LEAST_INDEX = 1.001  # Mitsuba rejects a solid with the index of air
ROUNDING = 1e-4  # of an interpolated opacity: one equal to its cutoff is opaque
BARE = 0.8  # albedo of a mesh without material, as in Blender


def is_plain(material: Material) -> bool:
    """Whether albedo, normal, roughness and metalness describe a material fully."""
    maps = (material.opacity, material.emission, material.specular)
    return material.shading == Shading() and all(m is None for m in maps)


def shape_of(asset: Asset, part: int, maps: OwnMaps, tangents: Float[np.ndarray, "f 3 4"]) -> Any:
    """A loaded Mitsuba mesh of one texture set whose material is not plain."""
    device.use()
    plugins.register()
    material = asset.materials[part]
    shading, plugin_types = material.shading, classes(mi.variant())
    if shading.stated == "nothing":
        maps = replace(maps, albedo=np.full((2, 2, 3), BARE, np.float32))
    elif shading.stated == "colour":
        maps = replace(maps, roughness=np.ones((2, 2), np.float32), metallic=np.ones((2, 2), np.float32))
    glow = _radiance(material, maps)
    if shading.unlit or shading.black:
        maps = replace(maps, albedo=np.zeros((2, 2, 3), np.float32))
    described: dict[str, Any] = {"type": "twosided", "bsdf": _surface_bsdf(material, maps, plugin_types)}
    if shading.transmission > 0:
        described = _glass(shading, maps)
    opacity = _opacity(material, plugin_types)
    if opacity is not None:
        described = {"type": "mask", "opacity": opacity, "nested": described}
    emitter = None if glow is None else plugin_types["Glow"](_loaded(glow), opacity)
    return scenery.mitsuba_mesh(
        asset.mesh, part, mi.load_dict(described), f"part{part}", tangents=tangents, emitter=emitter
    )


def shapes(asset: Asset, maps: list[OwnMaps]) -> dict[str, Any]:
    """Every texture set as one loaded shape, by name."""
    device.use()
    tangents = corner_tangents(asset.mesh)
    present = [p for p in range(len(asset.mesh.parts)) if (asset.mesh.part == p).any()]
    plain = [p for p in present if is_plain(asset.materials[p])]
    result = {}
    for p in plain:
        surface = mi.load_dict(scenery.bsdf_dict(maps[p], True, model="gltf", frame="mikkt"))
        result[f"part{p}"] = scenery.mitsuba_mesh(asset.mesh, p, surface, f"part{p}", tangents=tangents)
    result |= {f"part{p}": shape_of(asset, p, maps[p], tangents) for p in present if p not in plain}
    return {f"part{p}": result[f"part{p}"] for p in present}


def needs_path(shapes: dict[str, Any]) -> bool:
    """Whether a shape emits or transmits light, which Mitsuba's own integrators would not render correctly."""
    return _has_alpha(shapes) or any(s.is_emitter() for s in _loaded_shapes(shapes))


def integrator(depth: int, shapes: dict[str, Any]) -> Any:
    """A `Path` of at most `depth` vertices, the light's included. Shadow rays pass through surfaces if `shapes` have
    alpha."""
    return classes(mi.variant())["Path"](depth, _has_alpha(shapes))


def _has_alpha(shapes: dict[str, Any]) -> bool:
    return any(mi.has_flag(s.bsdf().flags(), mi.BSDFFlags.Null) for s in _loaded_shapes(shapes))


def _loaded_shapes(shapes: dict[str, Any]) -> list[Any]:
    return [s for s in shapes.values() if isinstance(s, mi.Shape)]


def _surface_bsdf(material: Material, maps: OwnMaps, plugin_types: dict[str, type]) -> dict[str, Any]:
    """The normal map over the surface."""
    shading = material.shading
    bare = shading.unlit or shading.stated == "nothing"
    f0 = np.zeros(3, np.float32) if bare else np.array(shading.specular, np.float32)
    specular = np.broadcast_to(f0, (2, 2, 3)) if material.specular is None else material.specular * f0
    surface = plugin_types["Surface"](
        {
            "base_color": _loaded(maps.albedo),
            "roughness": _loaded(maps.roughness[..., None]),
            "metallic": _loaded(maps.metallic[..., None]),
            "specular": _loaded(np.ascontiguousarray(specular, np.float32)),
        },
        0.0 if bare else shading.edge,
        0.0 if bare else shading.coat,
        shading.coat_roughness,
    )
    normal = scenery.texture_dict(scenery.encoded(maps.normal))
    return {"type": plugins.NORMALMAP, "normalmap": normal, "flip_invalid_normals": True, "bsdf": surface}


def _glass(shading: Shading, maps: OwnMaps) -> dict[str, Any]:
    """Transmission by Mitsuba's own material: with a volume a refracting solid, else a thin sheet."""
    parameters: dict[str, Any] = {
        "base_color": scenery.texture_dict(maps.albedo),
        "roughness": scenery.texture_dict(maps.roughness[..., None]),
        "spec_trans": shading.transmission,
        "eta": max(shading.ior, LEAST_INDEX),
    }
    if shading.thin:
        return {"type": "principledthin", **parameters}
    metallic = scenery.texture_dict(maps.metallic[..., None])
    normal = scenery.texture_dict(scenery.encoded(maps.normal))
    inner = {"type": "principled", "metallic": metallic, **parameters}
    return {"type": plugins.NORMALMAP, "normalmap": normal, "bsdf": inner}


def _radiance(material: Material, maps: OwnMaps) -> Float[np.ndarray, "h w 3"] | None:
    """Emitted radiance of a material, linear; None without emission."""
    shading = material.shading
    if shading.unlit:
        return maps.albedo
    factor = np.array(shading.emission, np.float32)
    if not factor.any():
        return None
    texture = material.albedo if shading.black else material.emission
    return np.broadcast_to(factor, (2, 2, 3)) if texture is None else texture * factor


def _opacity(material: Material, plugin_types: dict[str, type]) -> Any:
    """The opacity as a texture; None if all is opaque."""
    shading = material.shading
    if shading.opacity == 1 and material.opacity is None and (shading.cutoff or 0) <= 1:
        return None
    values = np.full((2, 2), shading.opacity, np.float32)
    if material.opacity is not None:
        values = np.clip(material.opacity * np.float32(shading.opacity), 0, 1)
    texture = _loaded(values[..., None])
    return texture if shading.cutoff is None else plugin_types["Cut"](texture, shading.cutoff)


def _loaded(values: Float[np.ndarray, "h w c"]) -> Any:
    return mi.load_dict(scenery.texture_dict(np.ascontiguousarray(values)))


@cache
def classes(variant: str) -> dict[str, type]:
    """The plugins as classes derived from the current variant's base classes."""
    return {"Surface": _surface_class(), "Cut": _cut_class(), "Glow": _glow_class(), "Path": _path_class()}


def _cut_class() -> type:
    class Cut(mi.Texture):
        def __init__(self, nested, cutoff):
            super().__init__(mi.Properties())
            self.nested, self.cutoff = nested, cutoff

        def eval_1(self, si, active=True):
            return dr.select(self.nested.eval_1(si, active) >= self.cutoff - ROUNDING, mi.Float(1), mi.Float(0))

        def eval(self, si, active=True):
            return mi.Color3f(self.eval_1(si, active))

        def mean(self):
            return self.nested.mean()

        def is_spatially_varying(self):
            return True

        def to_string(self):
            return f"Cut[{self.nested}, {self.cutoff}]"

    return Cut


def _glow_class() -> type:
    class Glow(mi.Emitter):
        def __init__(self, radiance, opacity):
            props = mi.Properties()
            props["sampling_weight"] = 0.0
            super().__init__(props)
            self.radiance, self.opacity = radiance, opacity
            self.m_flags = mi.EmitterFlags.Surface | mi.EmitterFlags.SpatiallyVarying

        def eval(self, si, active=True):
            value = self.radiance.eval(si, active)
            return value if self.opacity is None else value * self.opacity.eval_1(si, active)

        def sample_direction(self, it, sample, active=True):
            return dr.zeros(mi.DirectionSample3f), mi.Color3f(0)

        def pdf_direction(self, it, ds, active=True):
            return mi.Float(0)

        def eval_direction(self, it, ds, active=True):
            return mi.Color3f(0)

        def to_string(self):
            return f"Glow[{self.radiance}]"

    return Glow


def _path_class() -> type:
    class Path(mi.SamplingIntegrator):
        def __init__(self, depth, alpha):
            super().__init__(mi.Properties())
            self.depth, self.alpha = depth, alpha

        def sample(self, scene, sampler, ray, medium=None, active=True):
            state = (
                sampler,
                mi.Ray3f(ray),
                mi.Bool(active),
                mi.UInt32(0),  # bounces
                mi.UInt32(0),  # surfaces passed
                mi.Color3f(0),
                mi.Color3f(1),
                dr.zeros(mi.Interaction3f),
                mi.Float(1),
                mi.Bool(True),
                mi.Bool(False),
            )

            def step(*state):
                return _next_surface(scene, self.depth, self.alpha, state)

            state = dr.while_loop(state, lambda *s: s[2], step, labels=LABELS)
            return state[5], state[10], []

        def to_string(self):
            return f"Path[{self.depth}, {self.alpha}]"

    return Path


def _power_heuristic(a: Any, b: Any) -> Any:
    """Veach's power heuristic for a sample of density a that a strategy of density b could have generated."""
    total = dr.fma(a, a, b * b)
    return dr.select(total > 0, a * a / dr.select(total > 0, total, 1), 0)


def _transmittance(scene: Any, si: Any, ds: Any, active: Any) -> Any:
    """The share of a sampled emitter's light that crosses the surfaces between it and `si`; 0 behind an opaque one and
    beyond PASSED surfaces."""

    def going(ray, active, passed, share):
        return active

    def step(ray, active, passed, share):
        crossed = scene.ray_intersect(ray, mi.RayFlags.All, coherent=False, active=active)
        hit = active & crossed.is_valid()
        clear = crossed.bsdf(ray).eval_null_transmission(crossed, hit & (passed < PASSED))
        share = dr.select(hit, share * dr.select(passed < PASSED, clear, 0), share)
        return crossed.spawn_ray_to(ds.p), hit & dr.any(share != 0), passed + 1, share

    state = (si.spawn_ray_to(ds.p), mi.Bool(active), mi.UInt32(0), mi.Color3f(1))
    return dr.while_loop(state, going, step, labels=("ray", "active", "passed", "share"))[3]


def _next_surface(scene: Any, most: int, alpha: bool, state: tuple[Any, ...]) -> tuple[Any, ...]:
    """Extends a path of at most `most` vertices by one surface: its emission, its direct light, and the next ray.

    With `alpha`, light that crosses surfaces is found by both strategies, so the weight of a later emitter is that of
    the last surface which scattered. Without, nothing passes.
    """
    sampler, ray, active, depth, passed, result, throughput, before, pdf, delta, valid = state
    ctx = mi.BSDFContext()
    si = scene.ray_intersect(ray, mi.RayFlags.All, coherent=depth == 0, active=active)
    # The environment lights the asset but is invisible.
    lit = active & (si.is_valid() | (depth > 0))
    ds = mi.DirectionSample3f(scene, si, before)
    density = scene.pdf_emitter_direction(before, ds, lit & ~delta)
    share = dr.select(delta, 1, _power_heuristic(pdf, density))
    result = result + dr.select(lit, throughput * share * ds.emitter.eval(si, lit), 0)
    hit = active & si.is_valid()
    goes = hit & (depth + 1 < most) & (passed < PASSED)
    surface = si.bsdf(ray)
    direct = goes & mi.has_flag(surface.flags(), mi.BSDFFlags.Smooth)
    ds, weight = scene.sample_emitter_direction(si, sampler.next_2d(goes), not alpha, direct)
    direct = direct & (ds.pdf != 0)
    value, at = surface.eval_pdf(ctx, si, si.to_local(ds.d), direct)
    if alpha:
        weight = weight * _transmittance(scene, si, ds, direct & dr.any(value * weight != 0))
    share = dr.select(ds.delta, 1, _power_heuristic(ds.pdf, at))
    result = result + dr.select(direct, throughput * value * weight * share, 0)
    sampled, weight = surface.sample(ctx, si, sampler.next_1d(goes), sampler.next_2d(goes), goes)
    null = goes & mi.has_flag(sampled.sampled_type, mi.BSDFFlags.Null)
    valid = valid | (hit & ~null)
    throughput = dr.select(goes, throughput * weight, throughput)
    at, by = mi.Interaction3f(si), (sampled.pdf, mi.has_flag(sampled.sampled_type, mi.BSDFFlags.Delta))
    if alpha:
        at, by = dr.select(null, before, at), (dr.select(null, pdf, by[0]), dr.select(null, delta, by[1]))
    return (
        sampler,
        si.spawn_ray(si.to_world(sampled.wo)),
        goes & dr.any(throughput != 0),
        depth + dr.select(null, mi.UInt32(0), mi.UInt32(1)),
        passed + dr.select(null, mi.UInt32(1), mi.UInt32(0)),
        result,
        throughput,
        at,
        *by,
        valid,
    )


def _surface_class() -> type:
    class LayeredSurface(mi.BSDF):
        def __init__(self, textures, edge, coat, coat_roughness):
            super().__init__(mi.Properties())
            self.textures, self.edge, self.coat, self.coat_roughness = textures, edge, coat, coat_roughness
            front = mi.BSDFFlags.FrontSide
            self.m_components = [mi.BSDFFlags.DiffuseReflection | front, mi.BSDFFlags.GlossyReflection | front]
            self.m_flags = self.m_components[0] | self.m_components[1]

        def eval(self, ctx, si, wo, active=True):
            return self._eval(si, wo, active, self._values(si, active))

        def pdf(self, ctx, si, wo, active=True):
            return _density(self, si, wo, active, self._values(si, active))

        def eval_pdf(self, ctx, si, wo, active=True):
            values = self._values(si, active)
            return self._eval(si, wo, active, values), _density(self, si, wo, active, values)

        def sample(self, ctx, si, sample1, sample2, active=True):
            values = self._values(si, active)
            shiny, coated, spread, coat = _strategy(self, values)
            above = mi.Vector3f(si.wi.x, si.wi.y, dr.abs(si.wi.z))
            half, _ = spread.sample(above, sample2)
            outer, _ = coat.sample(above, sample2)
            glossy = sample1 < shiny + coated
            half = dr.select(sample1 < coated, outer, half)
            wo = dr.select(glossy, mi.reflect(si.wi, mi.Normal3f(half)), mi.warp.square_to_cosine_hemisphere(sample2))
            sampled = plugins.reflected(wo, glossy)
            sampled.pdf = _density(self, si, wo, active, values)
            usable = active & (sampled.pdf > 0)
            value = self._eval(si, wo, active, values)
            return sampled, dr.select(usable, value / dr.select(usable, sampled.pdf, 1), 0)

        def eval_diffuse_reflectance(self, si, active=True):
            return self.textures["base_color"].eval(si, active)

        def to_string(self):
            return f"LayeredSurface[{self.textures}, {self.edge}, {self.coat}, {self.coat_roughness}]"

        def _values(self, si, active) -> Any:
            return (
                self.textures["base_color"].eval(si, active),
                self.textures["roughness"].eval_1(si, active),
                self.textures["metallic"].eval_1(si, active),
                self.textures["specular"].eval(si, active),
            )

        def _eval(self, si, wo, active, values):
            angles = bsdf.upright(si.wi, wo)
            albedo, roughness, metallic, f0 = values
            coat = (self.coat, self.coat_roughness)
            value = bsdf.layered(angles, albedo, roughness, metallic, f0, self.edge, coat)
            return dr.select(active & angles.valid, value, 0)

    return LayeredSurface


def _strategy(layers: Any, values: Any) -> tuple[Any, Any, Any, Any]:
    """The shares of samples from the visible normals of base and coat, and their distributions."""
    _, roughness, metallic, specular = values
    alpha = dr.maximum(dr.square(roughness), bsdf.ALPHA_FLOOR)
    shine = dr.clip(dr.maximum(metallic, dr.max(specular)), 0, 1)
    shine = 0.5 + 0.5 * shine if layers.edge > 0 else dr.clip(metallic, 0, 1)
    coated = 0.3 * layers.coat
    kind = mi.MicrofacetType.GGX
    coat = mi.MicrofacetDistribution(kind, max(layers.coat_roughness**2, bsdf.ALPHA_FLOOR), sample_visible=True)
    spread = mi.MicrofacetDistribution(kind, alpha, sample_visible=True)
    return shine * (1 - coated), mi.Float(coated), spread, coat


def _density(layers: Any, si: Any, wo: Any, active: Any, values: Any) -> Any:
    """The density of directions from a LayeredSurface's `sample`."""
    shiny, coated, spread, coat = _strategy(layers, values)
    above = active & (si.wi.z > 0) & (wo.z > 0)
    wi = dr.select(above, si.wi, mi.Vector3f(0, 0, 1))
    half = dr.normalize(dr.select(above, si.wi + wo, mi.Vector3f(0, 0, 1)))
    lobes = shiny * spread.pdf(wi, half) + coated * coat.pdf(wi, half)
    lobes /= 4 * dr.select(above, dr.dot(wo, half), 1)
    return dr.select(above, dr.fma(1 - shiny - coated, wo.z / dr.pi, lobes), 0)
