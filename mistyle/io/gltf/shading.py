"""glTF material properties besides base colour, metalness, roughness and normal map; every number is checked."""

import math
from typing import Any

from mistyle.core.asset import Shading
from mistyle.io.gltf.infos import shadeless

Tree = dict[str, Any]
Triple = tuple[float, float, float]
MAX_RADIANCE = 1e6
GLOSSY = "KHR_materials_pbrSpecularGlossiness"
# Material extensions that become maps and factors, and those whose factors only renders of the file show.
READ = ("KHR_materials_unlit", "KHR_materials_emissive_strength", GLOSSY)
DRAWN = ("KHR_materials_ior", "KHR_materials_specular", "KHR_materials_clearcoat", "KHR_materials_transmission")


def shading_of(entry: Tree, through: bool) -> Shading:
    """The factors of a material of the file's checked JSON; `through`: its alpha applies (infos.py `sees_through`).

    F0 and F90 are those of KHR_materials_ior and KHR_materials_specular, or the specular colour of
    KHR_materials_pbrSpecularGlossiness.
    """
    extensions = entry.get("extensions", {})
    glossy, pbr = extension(extensions, GLOSSY), entry.get("pbrMetallicRoughness", {})
    unlit = "KHR_materials_unlit" in extensions
    has_surface = GLOSSY in extensions or unlit or "pbrMetallicRoughness" in entry
    ior = number(extension(extensions, "KHR_materials_ior"), "ior", 1.5, 0.0, 10.0)
    specular, edge = _reflectance(extensions, ior)
    alpha = (glossy.get("diffuseFactor") if GLOSSY in extensions else pbr.get("baseColorFactor")) or [1, 1, 1, 1]
    masked = through and entry["alphaMode"] == "MASK"
    coat, glass = extension(extensions, "KHR_materials_clearcoat"), extension(extensions, "KHR_materials_transmission")
    volume = extension(extensions, "KHR_materials_volume")
    return Shading(
        opacity=_bounded(alpha[3] if len(alpha) == 4 else 1.0, 1.0, 0.0, 1.0) if through else 1.0,
        cutoff=number(entry, "alphaCutoff", 0.5, 0.0, MAX_RADIANCE) if masked else None,
        emission=_emission(entry, extensions),
        specular=specular,
        edge=edge,
        coat=number(coat, "clearcoatFactor", 0.0, 0.0, 1.0),
        coat_roughness=number(coat, "clearcoatRoughnessFactor", 0.0, 0.0, 1.0) if coat else 0.0,
        # A texture masks the glass; it is not read, so no part is glass.
        transmission=0.0 if "transmissionTexture" in glass else number(glass, "transmissionFactor", 0.0, 0.0, 1.0),
        ior=ior,
        thin=number(volume, "thicknessFactor", 0.0, 0.0, math.inf) == 0,
        unlit=unlit,
        black=shadeless(entry) and not unlit,
        stated="surface" if has_surface else "colour",
    )


def _reflectance(extensions: Tree, ior: float) -> tuple[Triple, float]:
    if GLOSSY in extensions:
        return triple(extension(extensions, GLOSSY), "specularFactor", (1.0, 1.0, 1.0), 1.0), 1.0
    specular = extension(extensions, "KHR_materials_specular")
    weight = number(specular, "specularFactor", 1.0, 0.0, 1.0)
    normal = 1.0 if ior == 0 else round(((ior - 1) / (ior + 1)) ** 2, 12)  # 0.04 for 1.5, the default
    red, green, blue = triple(specular, "specularColorFactor", (1.0, 1.0, 1.0), MAX_RADIANCE)
    return (min(normal * red, 1) * weight, min(normal * green, 1) * weight, min(normal * blue, 1) * weight), weight


def _emission(entry: Tree, extensions: Tree) -> Triple:
    strength = number(
        extension(extensions, "KHR_materials_emissive_strength"), "emissiveStrength", 1.0, 0.0, MAX_RADIANCE
    )
    red, green, blue = triple(entry, "emissiveFactor", (0.0, 0.0, 0.0), MAX_RADIANCE)
    return red * strength, green * strength, blue * strength


def extension(extensions: Tree, name: str) -> Tree:
    """An extension's object; empty where it is missing or of another type."""
    entry = extensions.get(name)
    return entry if isinstance(entry, dict) else {}


def number(entry: Tree, name: str, default: float, low: float, high: float) -> float:
    """A number of the JSON between bounds; `default` where it is missing or of another type."""
    return _bounded(entry.get(name), default, low, high)


def triple(entry: Tree, name: str, default: Triple, high: float) -> Triple:
    """Three numbers of the JSON from 0 to `high`."""
    values = entry.get(name)
    if not isinstance(values, list) or len(values) < 3:
        return default
    red, green, blue = (_bounded(c, o, 0.0, high) for c, o in zip(values[:3], default, strict=True))
    return red, green, blue


def _bounded(value: Any, default: float, low: float, high: float) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or math.isnan(value):
        return default
    return min(max(float(value), low), high)
