"""PNG files of one texture set for glTF."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from mistyle.core.image import srgb_from_linear
from mistyle.core.maps import Maps
from mistyle.core.names import STEM, distinct, safe_name, split_tile
from mistyle.io.gltf.glb import Builder, Tree
from mistyle.io.images.write import encode_png


@dataclass(frozen=True)
class Pictures:
    """The PNG files of one texture set, 8 bits each.

    albedo  sRGB, with linear alpha where the material is cut out or blended
    normal  tangent space (MikkTSpace), +Y, (n + 1) / 2
    orm     linear: occlusion, roughness, metallic in red, green, blue
    """

    albedo: bytes
    normal: bytes
    orm: bytes


def part_stems(name: str, parts: Sequence[str]) -> list[str]:
    """File name stems of each part: `name` for a single part, else `name_part`. They are distinct even without case,
    and short enough for every ending (core/names.py)."""
    if len(parts) == 1:
        return [name]
    split = [split_tile(part) for part in parts]
    return distinct([f"{name}_{safe_name(base)}{tile}" for base, tile in split], limit=STEM)


def srgb_colours(albedo: Float[np.ndarray, "h w c"]) -> Float[np.ndarray, "h w c"]:
    """sRGB of linear colours; a fourth channel is alpha and stays."""
    encoded = srgb_from_linear(albedo[..., :3])
    return encoded if albedo.shape[2] == 3 else np.concatenate([encoded, albedo[..., 3:]], axis=-1)


def normal_colours(normal: Float[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h w 3"]:
    """(n + 1) / 2: flat is (0.5, 0.5, 1)."""
    return (normal * np.float32(0.5) + np.float32(0.5)).astype(np.float32)


def orm_colours(maps: Maps, occlusion: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w 3"]:
    """Occlusion (1 is open), roughness and metallic as red, green and blue."""
    return np.stack([occlusion, maps.roughness, maps.metallic], axis=-1).astype(np.float32)


def encode_pictures(
    maps: Maps, occlusion: Float[np.ndarray, "h w"], alpha: Float[np.ndarray, "h w"] | None = None
) -> Pictures:
    """Encode one texture set; `alpha` (0..1, same size) is added to the albedo where given."""
    albedo = maps.albedo
    if alpha is not None:
        albedo = np.concatenate([albedo, alpha[..., None]], axis=-1).astype(np.float32)
    return Pictures(
        albedo=encode_png(albedo, encode=srgb_colours),
        normal=encode_png(maps.normal, encode=normal_colours),
        orm=encode_png(orm_colours(maps, occlusion)),
    )


def add_textures(builder: Builder, pictures: Pictures, stem: str, *, repeat: bool) -> dict[str, int]:
    """Add images and textures of one set, named `<stem>_albedo` and so on; map name to texture index.

    The sampler clamps at the border unless `repeat` (texture coordinates outside the unit square).
    """
    sampler = builder.sampler(repeat=repeat)
    result = {}
    for name in ("albedo", "normal", "orm"):
        image = builder.png(getattr(pictures, name), f"{stem}_{name}")
        result[name] = builder.put("textures", {"name": f"{stem}_{name}", "sampler": sampler, "source": image})
    return result


def drop_emission(material: Tree) -> None:
    """Remove a material's emission, which its albedo now contains (io/gltf/infos.py `shadeless`)."""
    for key in ("emissiveTexture", "emissiveFactor"):
        material.pop(key, None)
    drop_extension(material, "KHR_materials_emissive_strength")


def drop_extension(item: Tree, name: str) -> Any:
    """Remove an extension from an object; returns its value, or None."""
    extensions = item.get("extensions", {})
    value = extensions.pop(name, None)
    if value is not None and not extensions:
        del item["extensions"]
    return value


def set_textures(material: Tree, textures: dict[str, int], texcoord: int = 0) -> None:
    """Set a material's textures without scaling: factors, normal scale and occlusion strength are 1.

    One image serves occlusion and metallic-roughness. All other properties stay; the base colour keeps its alpha
    factor. Texture transforms of the replaced textures are removed, and so is the older specular-glossiness model,
    which viewers would prefer to these textures.
    """

    def info(name: str) -> Tree:
        return {"index": textures[name]} | ({"texCoord": texcoord} if texcoord else {})

    glossy = drop_extension(material, "KHR_materials_pbrSpecularGlossiness")
    if glossy is not None or "pbrMetallicRoughness" not in material:
        material["pbrMetallicRoughness"] = {"baseColorFactor": (glossy or {}).get("diffuseFactor", [1, 1, 1, 1])}
    surface = material["pbrMetallicRoughness"]
    alpha = float(surface.pop("baseColorFactor", [1, 1, 1, 1])[3])
    if alpha != 1:
        surface["baseColorFactor"] = [1, 1, 1, alpha]
    for factor in ("metallicFactor", "roughnessFactor"):
        surface.pop(factor, None)  # 1 is glTF's default
    surface |= {"baseColorTexture": info("albedo"), "metallicRoughnessTexture": info("orm")}
    material |= {"normalTexture": info("normal"), "occlusionTexture": info("orm")}
