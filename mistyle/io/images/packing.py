"""Packing of maps into the texture files of a target program: channels, normal convention, bit depth.

The layout follows each program's own documentation: glTF and Unreal pack occlusion, roughness and metallic
(Unreal's normals are DirectX's, green down). Unity stores smoothness = 1 - roughness in alpha, beside metallic (URP) or
in a mask map of metallic, occlusion, detail, smoothness (HDRP). Film renderers read one float EXR a map.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float

from mistyle.core.image import srgb_from_linear
from mistyle.io.images.ocio import ColourSpace, exr_tags
from mistyle.io.images.write import DATA, write_exr, write_png

Image = Float[np.ndarray, "h w"] | Float[np.ndarray, "h w c"]


@dataclass(frozen=True)
class TextureSet:
    """The finished maps of one texture set, row 0 = v 1; `tile` is its UDIM tile (1001 for a single tile).

    albedo linear Rec.709; normal encoded (n + 1) / 2, +Y; roughness, metallic and occlusion 0..1; alpha or None;
    height (or None) in the mesh's units, of which 16-bit files hold the range `height_scale` about their middle
    """

    name: str
    tile: int
    albedo: Float[np.ndarray, "h w 3"]
    normal: Float[np.ndarray, "h w 3"]
    roughness: Float[np.ndarray, "h w"]
    metallic: Float[np.ndarray, "h w"]
    occlusion: Float[np.ndarray, "h w"]
    alpha: Float[np.ndarray, "h w"] | None = None
    height: Float[np.ndarray, "h w"] | None = None
    height_scale: float = 1.0


@dataclass(frozen=True)
class Slot:
    """One texture file: `map` is its name's suffix, `colour` the encoding of its values."""

    map: str
    pixels: Callable[[TextureSet], Image]
    colour: Literal["srgb", "linear", "data"]
    bits: Literal[8, 16]
    ext: Literal["png", "exr"] = "png"


@dataclass(frozen=True)
class Target:
    """The texture files of a program; `normal` is "+Y" (OpenGL) or "-Y" (DirectX)."""

    slots: tuple[Slot, ...]
    normal: Literal["+Y", "-Y"]
    about: str


def _albedo(s: TextureSet) -> Image:
    return s.albedo if s.alpha is None else np.concatenate([s.albedo, s.alpha[..., None]], axis=-1)


def _encoded(s: TextureSet) -> Image:
    colour = srgb_from_linear(s.albedo)
    return colour if s.alpha is None else np.concatenate([colour, s.alpha[..., None]], axis=-1).astype(np.float32)


def _down(s: TextureSet) -> Image:
    return _stacked(s.normal[..., 0], 1 - s.normal[..., 1], s.normal[..., 2])


def _stacked(*planes: Image) -> Image:
    return np.stack(planes, axis=-1).astype(np.float32)


def _orm(s: TextureSet) -> Image:
    return _stacked(s.occlusion, s.roughness, s.metallic)


def _urp(s: TextureSet) -> Image:
    return _stacked(s.metallic, s.metallic, s.metallic, 1 - s.roughness)


def _hdrp(s: TextureSet) -> Image:
    return _stacked(s.metallic, s.occlusion, np.zeros_like(s.metallic), 1 - s.roughness)


def _height(s: TextureSet) -> Image:
    return _in_units(s) / np.float32(s.height_scale) + np.float32(0.5)


def _in_units(s: TextureSet) -> Image:
    assert s.height is not None
    return s.height


# For assets with a height map: 16 bits about 0.5, or the mesh's units for film renderers.
HEIGHT, FILM_HEIGHT = Slot("height", _height, "data", 16), Slot("height", _in_units, "data", 16, "exr")
ALBEDO = Slot("albedo", _encoded, "srgb", 8)
NORMAL = Slot("normal", lambda s: s.normal, "data", 8)
OCCLUSION = Slot("occlusion", lambda s: s.occlusion, "data", 8)
FINE = (
    Slot("normal", lambda s: s.normal, "data", 16),
    Slot("roughness", lambda s: s.roughness, "data", 16),
    Slot("metallic", lambda s: s.metallic, "data", 8),
)
FILM = (
    Slot("albedo", _albedo, "linear", 16, "exr"),
    Slot("normal", lambda s: s.normal, "data", 16, "exr"),
    Slot("roughness", lambda s: s.roughness, "data", 16, "exr"),
    Slot("metallic", lambda s: s.metallic, "data", 16, "exr"),
)

TARGETS = {
    "blender": Target((ALBEDO, *FINE, OCCLUSION), "+Y", "single maps; normal and roughness with 16 bits"),
    "unreal": Target(
        (ALBEDO, Slot("normal", _down, "data", 8), Slot("orm", _orm, "data", 8)),
        "-Y",
        "ORM (switch sRGB off), normal map of DirectX",
    ),
    "unity-urp": Target(
        (ALBEDO, NORMAL, Slot("metallicsmoothness", _urp, "data", 8), OCCLUSION),
        "+Y",
        "metallic with smoothness in alpha",
    ),
    "unity-hdrp": Target(
        (ALBEDO, NORMAL, Slot("mask", _hdrp, "data", 8)), "+Y", "mask map: metallic, occlusion, 0, smoothness"
    ),
    "houdini": Target(FILM, "+Y", "16-bit float EXR, albedo linear Rec.709"),
    "arnold": Target(FILM, "+Y", "16-bit float EXR, albedo linear Rec.709"),
}


def write_slot(path: Path, slot: Slot, textures: TextureSet, space: ColourSpace | None = None) -> None:
    """Write one texture file; linear colours are converted to `space` and tagged as such."""
    pixels = slot.pixels(textures)
    if slot.colour == "linear" and space is not None:
        pixels = np.concatenate([space.from_working(pixels[..., :3]), pixels[..., 3:]], axis=-1)
    if slot.ext == "png":
        write_png(path, np.clip(pixels, 0, 1), bits=slot.bits)
        return
    names = "Y" if pixels.ndim == 2 else "RGBA"[: pixels.shape[2]]
    channels = {c: pixels if pixels.ndim == 2 else pixels[..., k] for k, c in enumerate(names)}
    tags = {"mistyle:map": slot.map} | (exr_tags(space) if slot.colour == "linear" else {"colorInteropID": DATA})
    write_exr(path, channels, half=slot.bits == 16, attributes=tags)
