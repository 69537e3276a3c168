"""Vertex colours of mesh files: sRGB by convention, 0..255 or 0..1."""

from dataclasses import replace
from functools import cache

import numpy as np
from jaxtyping import Float, Int, Shaped

from mistyle.core.image import linear_from_srgb
from mistyle.io.meshes.parsed_mesh import RawMaterial

UNUSED = "Vertex colours were left out where a material has a texture of colours."


def linear_colours(values: Shaped[np.ndarray, "n c"], top: float | None = None) -> Float[np.ndarray, "n 3"]:
    """Linear colours 0..1 of sRGB values whose white is `top`: 1, or 255 where any is larger, by default.
    Values that are not finite become white."""
    with np.errstate(invalid="ignore", over="ignore"):  # signalling NaN, doubles beyond float32
        raw = np.asarray(values[:, :3], np.float32)
    finite = np.isfinite(raw)
    if top is None:
        top = 255.0 if (raw[finite] > 1).any() else 1.0
    return linear_from_srgb(np.clip(np.where(finite, raw / np.float32(top), 1), 0, 1).astype(np.float32))


def coloured(
    colours: Float[np.ndarray, "f 3 3"], material: Int[np.ndarray, " f"], materials: tuple[RawMaterial, ...]
) -> tuple[Float[np.ndarray, "f 3 3"], tuple[RawMaterial, ...], list[str]]:
    """Corner colours, materials and notes. The colours are the albedo of materials without an albedo texture, without
    any other factor; they are white where a texture exists."""
    materials = tuple(replace(m, load=cache(m.load)) for m in materials)  # textures are loaded again later
    textured = np.array(["albedo" in m.load(1001)[0] for m in materials])
    shown = np.where(textured[material][:, None, None], np.float32(1), colours)
    tinted = tuple(
        m if t else replace(m, albedo_factor=(1.0, 1.0, 1.0)) for m, t in zip(materials, textured, strict=True)
    )
    return shown, tinted, [UNUSED] if textured[material].any() else []
