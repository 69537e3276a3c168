"""Reader of USD materials: UsdPreviewSurface, its constants, and its textures, decoded on demand."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
from jaxtyping import Float

from mistyle.core.asset import SHOWN, Shading
from mistyle.core.errors import InputRefused
from mistyle.geometry.retexture import Wrap
from mistyle.io.images.read import MAX_PICTURE_BYTES, Budget, alpha_map, decode
from mistyle.io.meshes.parsed_mesh import Maps, RawMap, RawMaterial, no_textures
from mistyle.io.sandbox.asset_folders import MeshFolders
from mistyle.io.usd.layers import PackagedFile, bytes_of, locate, place_of
from mistyle.io.usd.mtlx import UNREAD as UNREAD_NOTES

CHANNELS = {"r": (0,), "g": (1,), "b": (2,), "rgb": (0, 1, 2), "a": ()}
INPUTS = {"albedo": "diffuseColor", "roughness": "roughness", "metallic": "metallic", "normal": "normal"}
# Inputs that are drawn and not painted.
SHADING = {"opacity": "opacity", "emission": "emissiveColor", "specular": "specularColor"}
WRAPS: dict[str, Wrap] = {"repeat": "repeat", "mirror": "mirror", "clamp": "clamp", "black": "clamp"}
PLAIN = Shading()
COLOURS = ("albedo", "emission", "specular")
OUTSIDE = 1e-3  # UVs that leave the unit square by less do not show the outside
# Inputs that change the appearance and are not read, unless they have this value.
UNREAD = {"displacement": 0.0}
UNPAINTED = {"emissiveColor": 0.0, "clearcoat": 0.0, "opacity": 1.0, "ior": 1.5}
DEFAULTS = {"albedo": (0.18, 0.18, 0.18), "roughness": 0.5, "metallic": 0.0}


@dataclass(frozen=True)
class UsdTexture:
    """A UsdUVTexture: its file as named by the layer at `anchor`, value = scale * texel + bias, the channels used."""

    file: str
    anchor: PackagedFile
    space: str
    scale: tuple[float, ...] | None
    bias: tuple[float, ...] | None
    channel: str
    primvar: str
    transform: Float[np.ndarray, "3 3"] | None
    wrap: tuple[str, str] = ("useMetadata", "useMetadata")


@dataclass(frozen=True)
class UsdMaterial:
    """A material, the UV primvar of its first texture (None: it has none), the primvar of its albedo (None: another
    source), and the textures by map."""

    material: RawMaterial
    primvar: str | None
    colour: str | None = None
    textures: Mapping[str, UsdTexture] = field(default_factory=dict)

    def others(self) -> dict[str, str]:
        """The UV primvar of every map with another one than the first."""
        return {kind: t.primvar for kind, t in self.textures.items() if t.primvar != self.primvar}


def at_own_coordinates(usd_material: UsdMaterial, sets: Mapping[str, Float[np.ndarray, "f 3 2"]]) -> RawMaterial:
    """The material with its maps' own UV primvars; `sets` has the corners' coordinates by primvar."""
    map_uvs = {kind: sets[name] for kind, name in usd_material.others().items() if name in sets}
    return (
        replace(usd_material.material, load=partial(_moved, usd_material.material.load, map_uvs))
        if map_uvs
        else usd_material.material
    )


def _moved(load: Any, map_uvs: dict[str, np.ndarray], tile: int) -> tuple[Maps, tuple[str, ...]]:
    maps, notes = load(tile)
    return {k: replace(m, uvs=map_uvs[k]) if k in map_uvs else m for k, m in maps.items()}, notes


def plain(
    name: str,
    albedo: tuple[float, float, float] = (1.0, 1.0, 1.0),
    colour: str | None = None,
    shading: Shading = PLAIN,
) -> UsdMaterial:
    """A material without textures; `colour` is the primvar of its albedo, `shading` its other properties."""
    return UsdMaterial(RawMaterial(name, no_textures, None, albedo, 0.5, 0.0, shading), None, colour)


def outside(usd_material: UsdMaterial, uvs: Float[np.ndarray, "n 3 2"] | None) -> list[str]:
    """Notes on textures that are used outside the unit square and are black there, by their wrap mode or without
    one."""
    notes = []
    if uvs is None or not np.isfinite(uvs).any():
        return notes
    for texture in usd_material.textures.values():
        if texture.primvar != usd_material.primvar:
            continue
        matrix = np.eye(3) if texture.transform is None else texture.transform
        lookup = uvs.astype(np.float64) @ matrix[:2, :2].T + matrix[:2, 2]
        leaves = (np.nanmin(lookup, axis=(0, 1)) < -OUTSIDE) | (np.nanmax(lookup, axis=(0, 1)) > 1 + OUTSIDE)
        modes = {mode for mode, out in zip(texture.wrap, leaves, strict=True) if out}
        if "black" in modes:
            notes.append(f"Texture {texture.file} is black outside the unit square; its border texels were used there.")
        if modes - set(WRAPS):
            notes.append(f"Texture {texture.file} has no wrap mode and was repeated outside the unit square.")
    return notes


def read_material(
    pxr: Any, material: Any, folders: MeshFolders, budget: Budget, time: Any, notes: list[str]
) -> UsdMaterial:
    """The preview surface of a UsdShade.Material; a plain material, and a note, where it has none."""
    name = material.GetPrim().GetName()
    notes += [str(note) for note in material.GetPrim().GetCustomDataByKey(UNREAD_NOTES) or ()]
    surface = material.ComputeSurfaceSource()[0]
    if not surface or surface.GetShaderId() != "UsdPreviewSurface":
        notes.append(f"Material '{name}' has no UsdPreviewSurface and was read as plain.")
        return plain(name)
    textures: dict[str, UsdTexture] = {}
    constants: dict[str, Any] = dict(DEFAULTS)
    colour = None
    for kind, input_name in INPUTS.items():
        value = _source(pxr, surface.GetInput(input_name), time)
        if isinstance(value, UsdTexture):
            textures[kind] = value
        elif isinstance(value, Primvar):
            if kind == "albedo" and value.kind.startswith("UsdPrimvarReader_") and value.name:
                colour = value.name
            else:
                notes.append(f"The {input_name} of material '{name}' comes from a {value.kind}, which was not read.")
        elif value is not None and kind != "normal":
            constants[kind] = value
    shading = _shading(pxr, surface, textures, time)
    unread = [n for n in UNREAD if _differs(_source(pxr, surface.GetInput(n), time), UNREAD[n])]
    if unread:
        notes.append(f"The {' and '.join(unread)} of material '{name}' was not read.")
    unpainted = [n for n in UNPAINTED if _differs(_source(pxr, surface.GetInput(n), time), UNPAINTED[n])]
    if unpainted:
        notes.append(
            f"The {' and '.join(unpainted)} of material '{name}' {SHOWN}; views, paintings and finished assets omit it."
        )
    if _source(pxr, surface.GetInput("useSpecularWorkflow"), time):
        notes.append(f"Material '{name}' has the specular workflow: it is drawn so, and painted as not metallic.")
        textures.pop("metallic", None)
        constants["metallic"] = 0.0
    white = "albedo" in textures or colour is not None
    albedo = (1.0, 1.0, 1.0) if white else tuple(float(np.clip(c, 0, 1)) for c in constants["albedo"])
    tiled = any("<UDIM>" in t.file for t in textures.values())
    raw = RawMaterial(
        name,
        partial(_load, textures, folders, budget) if textures else no_textures,
        tiled if textures else None,
        (albedo[0], albedo[1], albedo[2]),
        1.0 if "roughness" in textures else float(np.clip(constants["roughness"], 0, 1)),
        1.0 if "metallic" in textures else float(np.clip(constants["metallic"], 0, 1)),
        shading,
    )
    return UsdMaterial(raw, next((t.primvar for t in textures.values()), None), colour, textures)


def _shading(pxr: Any, surface: Any, textures: dict[str, UsdTexture], time: Any) -> Shading:
    """The preview surface's properties besides the painted maps; adds their textures to `textures`."""

    def constant(name: str, default: Any) -> Any:
        value = _source(pxr, surface.GetInput(name), time)
        return default if value is None or isinstance(value, UsdTexture | Primvar) else value

    glossy = bool(_source(pxr, surface.GetInput("useSpecularWorkflow"), time))
    for kind, name in SHADING.items():
        value = _source(pxr, surface.GetInput(name), time)
        if isinstance(value, UsdTexture) and (kind != "specular" or glossy):
            textures[kind] = value
    ior, threshold = float(constant("ior", 1.5)), float(constant("opacityThreshold", 0.0))
    f0 = [((1 - ior) / (1 + ior)) ** 2] * 3 if ior > 0 else [1.0] * 3
    if glossy:
        f0 = [1.0] * 3 if "specular" in textures else list(constant("specularColor", (0.0, 0.0, 0.0)))
    glow = [1.0] * 3 if "emission" in textures else list(constant("emissiveColor", (0.0, 0.0, 0.0)))
    red, green, blue = (float(c) for c in np.clip(np.nan_to_num(f0), 0, 1))
    coat = float(np.clip(constant("clearcoat", 0.0), 0, 1))
    return Shading(
        opacity=1.0 if "opacity" in textures else float(np.clip(constant("opacity", 1.0), 0, 1)),
        cutoff=threshold if threshold > 0 else None,
        emission=(max(float(glow[0]), 0), max(float(glow[1]), 0), max(float(glow[2]), 0)),
        specular=(red, green, blue) if glossy or ior != 1.5 else Shading().specular,
        coat=coat,
        coat_roughness=float(np.clip(constant("clearcoatRoughness", 0.01), 0, 1)) if coat else 0.0,
    )


def _differs(value: Any, neutral: float) -> bool:
    """Whether an input differs from its neutral value."""
    if value is None:
        return False
    return isinstance(value, UsdTexture | Primvar) or bool((np.array(value, float) != neutral).any())


@dataclass(frozen=True)
class Primvar:
    """An input from a shader of another `kind` than a texture; `name`: the primvar that it reads."""

    kind: str
    name: str


def _source(pxr: Any, shader_input: Any, time: Any) -> Any:
    """A constant, a UsdTexture, another shader as a Primvar, or None without a value."""
    if not shader_input:
        return None
    producing = shader_input.GetValueProducingAttributes()
    if not producing:
        return None
    attribute = producing[0]
    shader = pxr.UsdShade.Shader(attribute.GetPrim())
    if not shader or not attribute.GetName().startswith("outputs:"):
        return attribute.Get(time)
    if shader.GetShaderId() != "UsdUVTexture":
        return Primvar(
            str(shader.GetShaderId() or "shader of another kind"), str(_value(shader, "varname", time) or "")
        )
    return _texture(pxr, shader, attribute.GetName().removeprefix("outputs:"), time)


def _texture(pxr: Any, shader: Any, channel: str, time: Any) -> UsdTexture | None:
    file = _attribute(shader, "file")
    asset = file.Get(time) if file else None
    if asset is None or channel not in CHANNELS:
        return None
    layer = file.GetPropertyStack(time)[0].layer
    primvar, transform = _lookup(pxr, shader.GetInput("st"), time)
    space, scale, bias = (_value(shader, name, time) for name in ("sourceColorSpace", "scale", "bias"))
    wrap = [str(_value(shader, name, time) or "useMetadata") for name in ("wrapS", "wrapT")]
    return UsdTexture(
        asset.path, place_of(layer), str(space or "auto"), None if scale is None else tuple(scale),
        None if bias is None else tuple(bias), channel, primvar, transform, (wrap[0], wrap[1]),
    )  # fmt: skip


def _attribute(shader: Any, name: str) -> Any:
    """The attribute that provides an input's value: its own, or a connected one."""
    shader_input = shader.GetInput(name)
    producing = shader_input.GetValueProducingAttributes() if shader_input else []
    return producing[0] if producing else None


def _value(shader: Any, name: str, time: Any) -> Any:
    attribute = _attribute(shader, name)
    return attribute.Get(time) if attribute else None


def _lookup(pxr: Any, shader_input: Any, time: Any) -> tuple[str, Float[np.ndarray, "3 3"] | None]:
    """The primvar's name and the product of UsdTransform2d nodes (translation * rotation * scale), v up."""
    transform = None
    for _ in range(8):
        producing = shader_input.GetValueProducingAttributes() if shader_input else []
        shader = pxr.UsdShade.Shader(producing[0].GetPrim()) if producing else None
        kind = shader.GetShaderId() if shader else None
        if kind == "UsdTransform2d":
            turn = np.radians(float(_value(shader, "rotation", time) or 0))
            scale = _value(shader, "scale", time) or (1, 1)
            move = _value(shader, "translation", time) or (0, 0)
            c, s = np.cos(turn), np.sin(turn)
            matrix = np.array([[c, -s, move[0]], [s, c, move[1]], [0, 0, 1]]) @ np.diag([scale[0], scale[1], 1.0])
            transform = matrix if transform is None else transform @ matrix
            shader_input = shader.GetInput("in") if shader else None
            continue
        name = _value(shader, "varname", time) if kind == "UsdPrimvarReader_float2" else None
        return str(name or "st"), transform
    return "st", transform


def _load(
    textures: dict[str, UsdTexture], folders: MeshFolders, budget: Budget, tile: int
) -> tuple[Maps, tuple[str, ...]]:
    maps: dict[str, RawMap] = {}
    notes: list[str] = []
    for kind, texture in textures.items():
        name = texture.file.replace("<UDIM>", str(tile))
        try:
            values = _texels(kind, texture, locate(folders, texture.anchor, name), budget, notes)
        except InputRefused as error:
            notes.append(f"Texture {name} was left out: {error}")
            continue
        if values is not None:
            wrap = (WRAPS.get(texture.wrap[0], "repeat"), WRAPS.get(texture.wrap[1], "repeat"))
            maps[kind] = RawMap(values, transform=texture.transform, wrap=wrap)
    return maps, tuple(notes)


def _texels(kind: str, texture: UsdTexture, place: PackagedFile, budget: Budget, notes: list[str]) -> np.ndarray | None:
    """One map as `Material` has it; None with a note where it is missing or unusable."""
    chosen = CHANNELS[texture.channel]
    if not chosen:
        return _alpha(texture, place, notes)
    if place.file.suffix.lower() == ".exr" or place.inner.lower().endswith(".exr"):
        pixels = _light(place, notes)
    else:
        data = bytes_of(place, MAX_PICTURE_BYTES)
        if data is None:
            notes.append(f"Texture {texture.file} is not there and was left out.")
        decoded = texture.space != "raw" if kind in COLOURS else texture.space == "sRGB" and kind != "normal"
        pixels = None if data is None else decode(data, str(place), budget, "colour" if decoded else "data")
    if pixels is None:
        return None
    return _converted(kind, texture, pixels, chosen)


def _alpha(texture: UsdTexture, place: PackagedFile, notes: list[str]) -> Float[np.ndarray, "h w"] | None:
    """A texture's alpha as a map; 1 where it has none."""
    data = bytes_of(place, MAX_PICTURE_BYTES)
    if data is None:
        notes.append(f"Texture {texture.file} is not there and was left out.")
        return None
    scale, bias = ((value or (default,) * 4)[3] for value, default in ((texture.scale, 1.0), (texture.bias, 0.0)))
    return np.clip(alpha_map(data, str(place)) * np.float32(scale) + np.float32(bias), 0, 1)


def _light(place: PackagedFile, notes: list[str]) -> np.ndarray | None:
    """An EXR texture's first three channels; a single one is repeated."""
    from mistyle.io.images.hdr import read_exr

    if place.inner or not place.file.is_file():
        why = "lies inside a package" if place.inner else "is not there"
        notes.append(f"Texture {place} {why} and was left out.")
        return None
    planes = read_exr(place.file)
    names = [c for c in "RGB" if c in planes] or sorted(planes)[:1]
    return np.stack([planes[names[min(k, len(names) - 1)]] for k in range(3)], axis=-1)


def _converted(kind: str, texture: UsdTexture, pixels: np.ndarray, chosen: tuple[int, ...]) -> np.ndarray:
    """scale * texel + bias in the used channels; normals as unit vectors, 2 c - 1 by default."""
    has_range = texture.scale is not None or texture.bias is not None
    scale = np.array((texture.scale or (1, 1, 1, 1))[:3], np.float32)
    bias = np.array((texture.bias or (0, 0, 0, 0))[:3], np.float32)
    if kind == "normal" and not has_range:
        scale, bias = np.full(3, 2, np.float32), np.full(3, -1, np.float32)
    values = pixels * scale + bias
    if kind == "normal":
        values[..., 2] = np.maximum(values[..., 2], 1e-3)
        return (values / np.linalg.norm(values, axis=-1, keepdims=True)).astype(np.float32)
    values = np.clip(values, 0, 1)
    if kind in COLOURS:
        return np.ascontiguousarray(values[..., list(chosen * 3 if len(chosen) == 1 else chosen)])
    return np.ascontiguousarray(values[..., chosen[0]])
