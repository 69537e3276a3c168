"""The parameters of a live Mitsuba scene by name: which can be fitted, and why the others cannot.

A parameter's key is the one of `mi.traverse`. Mitsuba gives a plugin one key even if several shapes share it, and an
address (`object_9390…`) if it has no id. A parameter therefore has further names here: every path that leads to it
(`chair.bsdf.base_color.data` beside `wood.base_color.data`), the same without the wrappers `brdf_0` and
`nested_bsdf`, and `unnamed1` in place of an address. Patterns are matched against all of them.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from difflib import get_close_matches
from fnmatch import fnmatchcase
from typing import Any

import numpy as np
from jaxtyping import Float

from mistyle.core.errors import UsageError
from mistyle.render.live import reach as scene_reach
from mistyle.render.live import walk as scene_walk
from mistyle.render.mitsuba.device import dr, mi

ROUGHNESS_FLOOR = 0.04
# `principled` clamps alpha = roughness^2 at 0.001; below, its derivative is exactly zero.
DEAD_ROUGHNESS = 0.001**0.5

GEOMETRY = ("vertex_positions", "vertex_normals", "vertex_texcoords", "faces", "to_world", "to_object")
UNIT = {"base_color", "reflectance", "diffuse_reflectance", "specular_reflectance", "specular_transmittance", "albedo"}
UNIT |= {"transmittance", "color0", "color1", "metallic", "specular", "spec_tint", "spec_trans", "anisotropic"}
UNIT |= {"sheen", "sheen_tint", "clearcoat", "clearcoat_gloss", "flatness", "diff_trans", "opacity", "weight"}
ROUGH = {"roughness", "alpha", "alpha_u", "alpha_v"}


@dataclass(frozen=True)
class Parameter:
    """One parameter of a scene.

    key      of `mi.traverse`
    names    all names, the most specific first; stable from run to run
    plugin   class of the plugin that holds it ("BitmapTextureImpl[uint8]", "UniformSpectrum", "Principled")
    owner    class of the plugin that uses it ("Principled", "NormalMap", "AreaLight")
    role     its property name in the owner ("base_color")
    kind     "texture" (an image), "value" (one number or colour), "attribute" (of a mesh), "geometry" or "other"
    shape    (h, w, c) of a texture, (n,) of the rest, () if it is not an array
    storage  "float32", "float16", "uint8", …
    reason   why it cannot be fitted; None if it can
    notes    unexpected effects of fitting it
    channels numbers per texel, per vertex or face, or of the value
    """

    key: str
    names: tuple[str, ...]
    plugin: str
    owner: str
    role: str
    kind: str
    shape: tuple[int, ...]
    storage: str
    reason: str | None
    notes: tuple[str, ...] = ()
    channels: int = 1

    @property
    def name(self) -> str:
        return self.names[0]


def parameters(scene: Any, engine: Any = None) -> list[Parameter]:
    """Every parameter of a live `mi.Scene` (or of any other Mitsuba object), in the order of `mi.traverse`.

    `engine` is the integrator for the gradients (`gradients.ad_integrator`); None means `prb`.
    """
    table = mi.traverse(scene)
    children = scene_walk.children(scene)
    ways = scene_walk.ways(scene, children)
    used = scene_reach.drawn(scene, children) if isinstance(scene, mi.Scene) else None
    # If several plugins hold a plugin, a holder other than the scene gives its role.
    holders: dict[Any, tuple[str, Any]] = {}
    for holder, held in children.items():
        for name, child in held:
            if child not in holders or isinstance(holders[child][1], mi.Scene):
                holders[child] = (name, holder)
    result = []
    for key, (_, _, node, flags) in table.properties.items():
        leaf = key.rpartition(".")[2]
        value: Any = table[key]
        held_as = isinstance(node, (mi.Texture, mi.Volume)) and node in holders
        role, owner = holders[node] if held_as else (leaf, node)
        names = scene_walk.names([f"{way}.{leaf}" if way else leaf for way in ways.get(node, ())] or [key])
        shape, storage = tuple(int(n) for n in np.shape(value)), _storage(value)
        if not storage.startswith(("float", "uint", "int")) or storage == "python":
            shape = ()
        kind = _kind(node, leaf, shape)
        reason = _reason(node, owner, role, kind, flags, value, storage)
        if reason is None and used is not None and node not in used:
            reason = "neither a shape nor a light uses it."
        if kind == "attribute":
            role, owner, unread = _reader(node, leaf, children)
            reason = reason or unread
        reason = reason or scene_reach.no_gradient(node, owner, role, engine)
        notes = _notes(node, owner, role, value, storage) if reason is None else ()
        if len(shape) == 2 and kind == "value":
            shape = shape[:1]
        classes = node.class_name(), owner.class_name()
        more = (reason, notes, _channels(node, leaf, kind, shape))
        result.append(Parameter(key, names, *classes, role, kind, shape, storage, *more))
    return _without_ambiguous(result)


def merged(chosen: Sequence[Parameter]) -> tuple[str, ...]:
    """Notes for a live scene on parameters of several shapes, such as those that `mi.load_file` merged."""
    notes = []
    for p in chosen:
        heads = {name.partition(".")[0] for name in p.names if re.search(r"\.(bsdf|emitter)\.", name)}
        if len(heads) > 1:
            shown = ", ".join(sorted(heads)[:5]) + ", …" * (len(heads) > 5)
            notes.append(
                f"{p.name} belongs to {len(heads)} shapes ({shown}): mi.load_file merges equal materials. Load with "
                "`optimize=False`, or give them unequal values, to fit them one by one."
            )
        elif p.name.startswith("unnamed"):
            notes.append(
                f"{p.name} belongs to a shape without a name: mi.load_file merges meshes of equal materials. Load with "
                "`optimize=False` to fit them one by one."
            )
    return tuple(notes)


def _reader(shape: Any, attribute: str, children: scene_reach.Children) -> tuple[str, Any, str | None]:
    """Role and owner of a mesh's attribute by the texture that reads it, and the reason if none does."""
    readers = scene_reach.readers(shape, attribute, children)
    if readers:
        return *readers[0], None
    return attribute, shape, None if readers is None else f"no material of its shape reads {attribute}."


def _channels(node: Any, leaf: str, kind: str, shape: tuple[int, ...]) -> int:
    if kind == "attribute":
        count = node.vertex_count() if leaf.startswith("vertex_") else node.face_count()
        return max(int(np.prod(shape)) // max(int(count), 1), 1)
    return int(shape[-1]) if shape else 1


def match(scene: Any, patterns: Sequence[str], engine: Any = None) -> tuple[Parameter, ...]:
    """The parameters that globs match, each once, in the scene's order; a final `.data` or `.value` may be left out.

    A pattern may match parameters that cannot be fitted if it also matches one that can. Raises UsageError with the
    nearest keys if a pattern matches nothing, and with the reasons if none of its matches can be fitted.
    """
    return choose(parameters(scene, engine), patterns)


def choose(listed: Sequence[Parameter], patterns: Sequence[str]) -> tuple[Parameter, ...]:
    """`match` in the list from `parameters`."""
    if not patterns:
        raise UsageError("no parameter to optimise: name one or more keys or globs (`--list` shows them).")
    chosen: set[str] = set()
    for pattern in patterns:
        hits = [p for p in listed if any(fnmatchcase(name, pattern) for name in _spellings(p))]
        if not hits:
            raise UsageError(_unknown(listed, pattern))
        usable = [p.key for p in hits if p.reason is None]
        if not usable:
            reasons = [f"{p.name}: {p.reason}" for p in hits[:5]]
            more = f" (and {len(hits) - 5} more)" if len(hits) > 5 else ""
            raise UsageError(f"'{pattern}' matches no parameter that can be optimised. {' '.join(reasons)}{more}")
        chosen.update(usable)
    return tuple(p for p in listed if p.key in chosen)


def limits(parameter: Parameter) -> tuple[float, float] | None:
    """The range of a parameter's values; None without one. `project` handles a normal map's range."""
    if parameter.role in ROUGH:
        return ROUGHNESS_FLOOR, 1.0
    if parameter.role in UNIT:
        return 0.0, 1.0
    if parameter.kind == "attribute" and re.search("colou?r", parameter.role):
        return 0.0, 1.0
    light = parameter.owner.endswith(("Emitter", "Light"))
    if light or any(word in parameter.role for word in ("radiance", "intensity", "emittance")):
        return 0.0, np.inf
    # A spectrum in an unknown role, for example in a user's plugin.
    return (0.0, np.inf) if parameter.kind == "value" and "Spectrum" in parameter.plugin else None


def project(parameter: Parameter, values: Float[np.ndarray, "..."], tilt: float = 0.95) -> Float[np.ndarray, "..."]:
    """The nearest admissible values: inside the range; a normal map's texels are unit vectors tilted by at most
    asin(tilt).

    A normal map holds (n + 1) / 2; the tilt is limited because a normal that faces away has no gradient. The columns
    that an environment map repeats at its ends stay equal to their originals.
    """
    if parameter.owner == "NormalMap" and values.ndim == 3 and values.shape[-1] == 3:
        normal = values.astype(np.float64) * 2 - 1
        normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-12)
        across = np.linalg.norm(normal[..., :2], axis=-1, keepdims=True)
        xy = normal[..., :2] * np.minimum(1, tilt / np.maximum(across, 1e-12))
        z = np.sqrt(np.maximum(1 - (xy**2).sum(axis=-1, keepdims=True), 0))
        return (np.concatenate([xy, z], axis=-1) * 0.5 + 0.5).astype(np.float32)
    if parameter.owner == "EnvironmentMapEmitter" and values.ndim == 3:
        # Mitsuba repeats the last column before the first, and the first after the last.
        values = values.copy()
        values[:, 0], values[:, -1] = values[:, -2], values[:, 1]
    bounds = limits(parameter)
    return values if bounds is None else np.clip(values, np.float32(bounds[0]), np.float32(bounds[1]))


def fast_shapes(scene: Any, integrator: Any = None) -> dict[str, str | None]:
    """Shapes whose direct light needs no Monte Carlo (`render/deferred/renderer.py`): None by shape id, or the reason
    against it.

    They have a plain `principled`, alone or in `twosided` and `normalmap`. All lights are points or directions, and the
    integrator renders direct light only (max_depth 2).
    """
    children = scene_walk.children(scene)
    engine = scene.integrator() if integrator is None else integrator
    depth = getattr(engine, "max_depth", None)
    if depth is None:
        printed = re.search(r"max_depth = (\d+)", str(engine))
        depth = int(printed[1]) if printed else (2 if engine.class_name() == "DirectIntegrator" else -1)
    delta = mi.EmitterFlags.DeltaDirection | mi.EmitterFlags.DeltaPosition
    wide = [e.class_name() for e in scene.emitters() if not int(e.flags()) & int(delta)]
    everywhere = f"{wide[0]} is neither a point nor a direction." if wide else None
    if everywhere is None and not 0 <= depth <= 2:
        everywhere = "the integrator renders indirect light (its max_depth is above 2)."
    result = {}
    for shape in scene.shapes():
        bsdf: Any = shape.bsdf()
        while bsdf is not None and bsdf.class_name() in ("TwoSidedBRDF", "NormalMap"):
            bsdf = next((child for _, child in children[bsdf] if isinstance(child, mi.BSDF)), None)
        plain = bsdf is not None and bsdf.class_name() == "Principled"
        result[shape.id()] = everywhere if plain else f"its material is {shape.bsdf().class_name()}, not `principled`."
    return result


def _spellings(parameter: Parameter) -> list[str]:
    full = list(dict.fromkeys((*parameter.names, parameter.key)))
    return full + [re.sub(r"\.(data|value)$", "", name) for name in full if name.endswith((".data", ".value"))]


def _unknown(listed: Sequence[Parameter], pattern: str) -> str:
    stem = pattern.removesuffix(".data")
    if stem != pattern:
        literal = [p for p in listed if any(fnmatchcase(name, f"{stem}.value") for name in p.names)]
        if literal:
            return (
                f"'{pattern}': {literal[0].name} is a literal, one value for the whole surface, not a texture. Name "
                f"'{stem}.value' to fit that value, or put a texture of the size to be fitted in its place in the "
                'scene file (<texture type="bitmap"> with a float image).'
            )
    usable = list(dict.fromkeys(name for p in listed if p.reason is None for name in p.names))
    everything = list(dict.fromkeys(name for p in listed for name in p.names))
    near = get_close_matches(pattern, usable, 5, 0.4) or get_close_matches(pattern, everything, 5, 0.4) or usable[:5]
    message = f"The nearest keys: {', '.join(near)}." if near else "Nothing in this scene can be optimised."
    if any(name.startswith("unnamed") for name in everything):
        message += (
            " Shapes without a name may have been merged by mi.load_file or mi.load_dict; `optimize=False` keeps them."
        )
    return f"'{pattern}' matches no parameter of the scene. {message}"


def _kind(node: Any, leaf: str, shape: tuple[int, ...]) -> str:
    if isinstance(node, mi.Shape):
        attribute = leaf.startswith(("vertex_", "face_")) and leaf not in GEOMETRY
        return "attribute" if attribute else "geometry"
    if isinstance(node, (mi.Sensor, mi.Film, mi.Sampler, mi.Integrator, mi.Scene)) or not shape:
        return "other"
    return "texture" if len(shape) >= 3 else "value"


def _storage(value: Any) -> str:
    """The numbers' type; "python" for numbers outside Dr.Jit, else the class's name."""
    kind = type(value)
    if isinstance(value, (bool, int, float, str)):
        return "python"
    if not dr.is_jit_v(kind) or dr.is_special_v(kind):
        return kind.__name__
    return dr.type_v(kind).name.lower()


def _reason(node: Any, owner: Any, role: str, kind: str, flags: Any, value: Any, storage: str) -> str | None:
    if kind == "geometry":
        return "it is geometry; only materials and lights can be fitted."
    if isinstance(node, (mi.Sensor, mi.Film, mi.Sampler, mi.Integrator, mi.Scene)):
        return "it belongs to a camera or to the rendering; only materials and lights can be fitted."
    if storage in ("uint8", "int8"):
        return (
            "its texture is stored with 8 bits (uint8), which has no gradient; load it with "
            '<string name="format" value="variant"/>.'
        )
    if storage not in ("float16", "float32", "float64"):
        return f"it is not an array of real numbers ({type(value).__name__})."
    if int(flags) & int(mi.ParamFlags.ReadOnly):
        return "Mitsuba marks it as read-only."
    if int(flags) & int(mi.ParamFlags.NonDifferentiable):
        return "Mitsuba marks it as not differentiable."
    if np.size(value) == 0:
        return "it is empty."
    if owner.class_name().startswith("Principled") and role == "roughness":
        largest = float(np.max(np.asarray(value)))
        if largest < DEAD_ROUGHNESS:
            return (
                f"its largest value, {largest:.3g}, lies below {DEAD_ROUGHNESS:.4f}, where the roughness of "
                f"'principled' has a gradient of exactly zero; start at {ROUGHNESS_FLOOR} or more."
            )
    return None


def _notes(node: Any, owner: Any, role: str, value: Any, storage: str) -> tuple[str, ...]:
    notes = []
    if "BitmapTexture" in node.class_name() and re.search(r"\braw = 0\b", str(node)):
        notes.append(
            'raw is false: every step waits for a check of its range; <boolean name="raw" value="true"/> is '
            "faster if the file holds linear values."
        )
    if storage == "float16":
        notes.append('its texture is stored with 16 bits; format "variant" stores the result in full precision.')
    if role in ROUGH:
        low = float(np.mean(np.asarray(value) < ROUGHNESS_FLOOR))
        if low:
            notes.append(f"{low:.1%} of its values lie below {ROUGHNESS_FLOOR} and are raised to it.")
    return tuple(notes)


def _without_ambiguous(listed: list[Parameter]) -> list[Parameter]:
    """The parameters without ambiguous short names."""
    count: dict[str, int] = {}
    for parameter in listed:
        for name in parameter.names:
            count[name] = count.get(name, 0) + 1
    result = []
    for parameter in listed:
        names = tuple(name for name in parameter.names if count[name] == 1 or name == parameter.key)
        result.append(replace(parameter, names=names or (parameter.key,)))
    return result
