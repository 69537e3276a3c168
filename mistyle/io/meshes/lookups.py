"""Resolution of texture transforms, wrap modes and extra UV sets to one UV set with repeating textures.

Formats allow more than the working material: texture transforms, textures that are mirrored or clamped outside the unit
square, another UV set for one map. They are resolved here, so that later stages read the material at `Mesh.corner_uvs`
modulo 1.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from jaxtyping import Bool, Float

from mistyle.geometry.retexture import REPEAT, Wrap, Wraps, wrapped
from mistyle.io.meshes.parsed_mesh import Maps, Raw, RawMap, RawMaterial
from mistyle.io.sandbox.bounds import WORK_TEXTURE

# UVs that leave the unit square by less do not show the outside.
OUTSIDE = 1e-3
FARTHEST = 1e4  # tiles
ORDER = ("albedo", "roughness", "metallic", "normal")
WORDS = {"mirror": "mirrored", "clamp": "clamped"}
Spans = tuple[tuple[float, float], tuple[float, float]]  # along u and along v
SQUARE: Spans = ((0.0, 1.0), (0.0, 1.0))


@dataclass(frozen=True)
class _Plain:
    """The lookup of a material's first map, and the part of its plane that becomes one tile of the plain texture."""

    base: RawMap
    wrap: Wraps
    spans: Spans


def plain_lookups(raw: Raw) -> Raw:
    """The mesh with UVs at which its materials' base maps repeat: transforms applied, other wrap modes unrolled.

    A material's base map is its albedo, or the first map that it has. Maps with the base map's lookup keep
    their texels; the others keep their own lookup, which `_placed` in io/meshes/prepare.py resamples. Materials of UDIM
    tiles, whose UVs select the texture, stay unchanged.
    """
    uvs, materials, notes = raw.uvs, list(raw.materials), list(raw.notes)
    for m, material in enumerate(raw.materials):
        maps = {} if material.udim else material.load(1001)[0]
        base = next((maps[name] for name in ORDER if name in maps), None)
        rows = raw.material == m
        if base is None or (base.uvs is None and base.transform is None and base.wrap == REPEAT):
            continue
        lookup = looked_up(base, raw.uvs, rows)
        if lookup is not None and not np.nanmax(np.abs(lookup)) < FARTHEST:
            continue  # too far to unroll; the maps are resampled from their own lookup
        wrap = REPEAT if lookup is None else effective(base.wrap, lookup)
        if lookup is None or (base.uvs is None and base.transform is None and wrap == REPEAT):
            continue
        plain = _Plain(base, wrap, _spans(lookup, wrap, base.values.shape[:2]))
        low, high = np.array(plain.spans).T
        if uvs is None:
            uvs = np.full((len(raw.faces), 3, 2), np.nan, np.float32)
        elif uvs is raw.uvs:
            uvs = uvs.copy()
        uvs[rows] = (lookup - low) / (high - low)
        materials[m] = replace(material, load=partial(_load, material.load, plain, raw.uvs, rows))
        notes += _notes(material, plain)
    if uvs is raw.uvs:
        return raw
    return replace(raw, uvs=uvs, authored=raw.uvs, materials=tuple(materials), notes=tuple(notes))


def looked_up(
    entry: RawMap, uvs: Float[np.ndarray, "f 3 2"] | None, rows: np.ndarray
) -> Float[np.ndarray, "n 3 2"] | None:
    """Lookup coordinates of a map on the faces `rows`: v up, transform applied, NaN where a face has no UVs; None where
    none has. `uvs` are those of the mesh."""
    own = uvs if entry.uvs is None else entry.uvs
    if own is None or not np.isfinite(own[rows]).any():
        return None
    lookup = own[rows]
    if entry.transform is not None:
        lookup = lookup.astype(np.float64) @ entry.transform[:2, :2].T + entry.transform[:2, 2]
    return lookup


def effective(wrap: Wraps, lookup: Float[np.ndarray, "n 3 2"]) -> Wraps:
    """The wrap modes that the lookup reaches: "repeat" along an axis on which it stays inside the unit square."""
    low, high = np.nanmin(lookup, axis=(0, 1)), np.nanmax(lookup, axis=(0, 1))
    inside = (low >= -OUTSIDE) & (high <= 1 + OUTSIDE)

    def mode(axis: int) -> Wrap:
        return "repeat" if inside[axis] or wrap[axis] not in WORDS else wrap[axis]

    return mode(0), mode(1)


def framed(entry: RawMap) -> RawMap:
    """A normal map with normals in the frame of its lookup coordinates (rotated by the transform)."""
    if entry.transform is None or entry.tangents == "looked up":
        return entry
    u, _, v = np.linalg.svd(entry.transform[:2, :2])
    turn = u @ v
    if np.allclose(turn, np.eye(2)):
        return replace(entry, tangents="looked up")
    done = entry.finished()
    values = done.values.copy()
    values[..., :2] = values[..., :2] @ turn.T
    return replace(done, values=values.astype(np.float32), tangents="looked up")


def _spans(lookup: Float[np.ndarray, "n 3 2"], wrap: Wraps, shape: tuple[int, ...]) -> Spans:
    """The UV range of one tile of the plain texture: two tiles of a mirrored texture; for a clamped one the range of
    its lookup and a texel more on either side."""

    def span(axis: int) -> tuple[float, float]:
        if wrap[axis] == "mirror":
            return 0.0, 2.0
        if wrap[axis] == "clamp":
            count = shape[1 - axis]
            low, high = np.nanmin(lookup[..., axis]), np.nanmax(lookup[..., axis])
            return float(np.floor(low * count) - 1) / count, float(np.ceil(high * count) + 1) / count
        return 0.0, 1.0

    return span(0), span(1)


def _load(
    load: Callable[[int], tuple[Maps, tuple[str, ...]]],
    plain: _Plain,
    uvs: Float[np.ndarray, "f 3 2"] | None,
    rows: Bool[np.ndarray, " f"],
    tile: int,
) -> tuple[Maps, tuple[str, ...]]:
    """The `load` of a material with plain UVs; `uvs` are the original ones."""
    maps, notes = load(tile)
    result: dict[str, RawMap] = {}
    for name, entry in maps.items():
        entry = framed(entry) if name == "normal" else entry
        if _alike(entry, plain, uvs, rows):
            result[name] = _unrolled(entry, plain, name == "normal")
        else:
            result[name] = replace(entry, uvs=uvs if entry.uvs is None else entry.uvs)
    return result, notes


def _alike(entry: RawMap, plain: _Plain, uvs: Float[np.ndarray, "f 3 2"] | None, rows: Bool[np.ndarray, " f"]) -> bool:
    """Whether a map has the base map's lookup."""
    own, base = (uvs if e.uvs is None else e.uvs for e in (entry, plain.base))
    same_set = own is base or (own is not None and base is not None and np.array_equal(own, base, equal_nan=True))
    move, base_move = (np.eye(3) if e.transform is None else e.transform for e in (entry, plain.base))
    if not same_set or not np.array_equal(move, base_move):
        return False
    lookup = looked_up(entry, uvs, rows)
    return lookup is not None and effective(entry.wrap, lookup) == plain.wrap


def _unrolled(entry: RawMap, plain: _Plain, unit: bool) -> RawMap:
    """A map whose unit square covers the base's spans. Texels between those of the original map are interpolated
    (normals are then normalised)."""
    place = dict(uvs=None, transform=None, wrap=REPEAT)
    if plain.spans == SQUARE:
        return replace(entry, **place)
    steps = [_texels(entry.values.shape[1 - axis], plain.spans[axis], axis) for axis in (0, 1)]
    if any(between.any() for _, between in steps):
        entry = entry.finished()
        steps = [_texels(entry.values.shape[1 - axis], plain.spans[axis], axis) for axis in (0, 1)]
    values = entry.values
    for axis, (first, between) in enumerate(steps):
        side, count = 1 - axis, entry.values.shape[1 - axis]
        new = values.take(wrapped(first, count, plain.wrap[axis]), axis=side)
        if between.any():
            share = between.reshape([-1 if k == side else 1 for k in range(values.ndim)])
            new = new * (1 - share) + values.take(wrapped(first + 1, count, plain.wrap[axis]), axis=side) * share
        values = new
    if unit and values.dtype.kind == "f":
        values = values / np.maximum(np.linalg.norm(values, axis=-1, keepdims=True), 1e-6)
    return replace(entry, values=values, **place)


def _texels(count: int, span: tuple[float, float], axis: int) -> tuple[np.ndarray, Float[np.ndarray, " n"]]:
    """For every texel of the unrolled axis: the texel of the map, of `count`, at or before its centre, and the
    fraction (0 up to 1) of the way to the next. Rows begin at the span's upper end, columns at its lower."""
    low, high = span if axis == 0 else (1 - span[1], 1 - span[0])
    new = int(np.clip(round((high - low) * count), 1, WORK_TEXTURE))
    place = (low + (np.arange(new) + 0.5) / new * (high - low)) * count - 0.5
    first = np.floor(place + 1e-6)
    between = np.where(np.abs(place - first) < 1e-5, 0, place - first)
    return first.astype(np.int64), between.astype(np.float32)


def _notes(material: RawMaterial, plain: _Plain) -> list[str]:
    words = sorted({WORDS[mode] for mode in plain.wrap if mode != "repeat"})
    if not words:
        return []
    widest = max(high - low for low, high in plain.spans)
    coarse = widest * max(plain.base.values.shape[:2]) > WORK_TEXTURE
    return [
        f"The textures of material '{material.name}' are {' and '.join(words)} outside the unit square: their copies "
        "were written out and its UVs rescaled to them" + (", at a lower resolution." if coarse else ".")
    ]
