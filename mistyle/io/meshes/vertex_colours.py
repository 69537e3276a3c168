"""Vertex colours of formats that have them beside textures: sRGB by custom, 0..255 or 0..1."""

from dataclasses import replace
from functools import cache

import numpy as np
from jaxtyping import Float, Int, Shaped

from mistyle.core.image import linear_from_srgb
from mistyle.io.meshes.parsed_mesh import RawMaterial

UNUSED = "Vertex colours were left out where a material has a texture of colours."


def linear_colours(values: Shaped[np.ndarray, "n c"], top: float | None = None) -> Float[np.ndarray, "n 3"]:
    """Linear colours 0..1 of sRGB values whose white is `top`: 1, or 255 where any is larger, if nothing is said. What
    is not finite is white."""
    with np.errstate(invalid="ignore", over="ignore"):  # signalling NaN, doubles beyond float32
        found = np.asarray(values[:, :3], np.float32)
    finite = np.isfinite(found)
    if top is None:
        top = 255.0 if (found[finite] > 1).any() else 1.0
    return linear_from_srgb(np.clip(np.where(finite, found / np.float32(top), 1), 0, 1).astype(np.float32))


def coloured(
    colours: Float[np.ndarray, "f 3 3"], material: Int[np.ndarray, " f"], materials: tuple[RawMaterial, ...]
) -> tuple[Float[np.ndarray, "f 3 3"], tuple[RawMaterial, ...], list[str]]:
    """Corner colours, materials and notes where the colours are the albedo of all materials without a texture of it:
    white where one has it, and beside the colours no other factor counts."""
    materials = tuple(replace(m, load=cache(m.load)) for m in materials)  # textures are asked for again later
    textured = np.array(["albedo" in m.load(1001)[0] for m in materials])
    shown = np.where(textured[material][:, None, None], np.float32(1), colours)
    made = tuple(
        m if t else replace(m, albedo_factor=(1.0, 1.0, 1.0)) for m, t in zip(materials, textured, strict=True)
    )
    return shown, made, [UNUSED] if textured[material].any() else []
