"""Material libraries of Wavefront OBJ (MTL, with its extension for physically based materials)."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float, Shaped

from mistyle.core.asset import SHOWN, Shading
from mistyle.core.paths import real_path
from mistyle.geometry.retexture import REPEAT
from mistyle.io.images.quantisation import Kind, fractions, linear_rows
from mistyle.io.images.read import Budget, named_alpha, named_texture
from mistyle.io.meshes.parsed_mesh import Maps, RawMap, RawMaterial, no_textures
from mistyle.io.sandbox.asset_folders import MeshFolders, shared_folders
from mistyle.io.sandbox.bounds import read_bytes
from mistyle.io.sandbox.nearby import decoded, unmarked

MAX_LIBRARY_BYTES = 16 << 20
TEXTURES = {"map_kd": "albedo", "map_pr": "roughness", "map_pm": "metallic", "norm": "normal"}
TEXTURES |= {"map_d": "opacity", "map_ke": "emission"}
BUMPS = ("map_bump", "bump")
NAMING = {*TEXTURES, *BUMPS}  # statements whose pictures are opened
# Options of a texture statement and their numbers of values; the file name follows them.
OPTIONS = {"-mm": 2, "-o": 3, "-s": 3, "-t": 3, "-blendu": 1, "-blendv": 1, "-boost": 1, "-texres": 1}
OPTIONS |= {"-clamp": 1, "-bm": 1, "-imfchan": 1, "-type": 1, "-cc": 1, "-colorspace": 1}
# Statements without a note: read, or without effect on a ray-traced surface.
READ = {*NAMING, "kd", "pr", "pm", "d", "tr", "ke", "ka", "ni", "illum", "sharpness", "map_aat"}
NEUTRAL = {"tf": 1.0, "ks": 0.0, "ps": 0.0, "pc": 0.0, "pcr": 0.0, "aniso": 0.0, "anisor": 0.0}
NUMBERS = {"kd": 3, "ke": 3, "d": 1, "tr": 1}  # values of the statements whose odd forms get a note
# Names of linear colour spaces; all others are read as sRGB, with a note for names that are not sRGB.
LINEAR = ("linear", "raw", "lin_rec709", "lin_srgb", "non-color", "data", "none")
SRGB = ("srgb", "srgb_texture", "auto", "gamma22", "rec709")
FLAT_GREY = 8  # of 255: the largest difference between the channels of a grey picture (JPEG)


@dataclass(frozen=True)
class Statement:
    """A texture statement: (u, v) -> scale * (u, v) + offset, then value -> base + gain * value."""

    file: str
    scale: tuple[float, float] = (1.0, 1.0)
    offset: tuple[float, float] = (0.0, 0.0)
    turbulence: bool = False
    clamp: bool = False
    strength: float = 1.0
    base: float = 0.0
    gain: float = 1.0
    channel: str = ""
    space: str = ""

    @property
    def transform(self) -> Float[np.ndarray, "3 3"] | None:
        """The UV transform for v up; None for the identity."""
        if self.scale == (1, 1) and self.offset == (0, 0):
            return None
        return np.array([[self.scale[0], 0, self.offset[0]], [0, self.scale[1], self.offset[1]], [0, 0, 1.0]])


@dataclass(frozen=True)
class MtlEntry:
    """One material of a library: the last value of every statement by its lower-case keyword.

    folders  those of the mesh; texture names are relative to the library's own folder, then to the mesh's
    spelled  the keywords as the file spells them
    """

    name: str
    library: Path
    folders: MeshFolders
    values: dict[str, str]
    spelled: dict[str, str]


def read_library(library: Path, mesh: Path) -> tuple[dict[str, MtlEntry], tuple[str, ...]]:
    """The materials by name, and notes. A file that is not UTF-8 is read as Windows-1252 (or Latin-1)."""
    lines = unmarked(read_bytes(library, MAX_LIBRARY_BYTES)).splitlines()
    texts, plain = decoded(*lines)
    anchors = tuple(dict.fromkeys((real_path(library.parent), real_path(mesh.parent))))
    folders = MeshFolders(mesh, anchors, shared_folders(mesh))
    entries: dict[str, MtlEntry] = {}
    current = MtlEntry("", library, folders, {}, {})
    for line in texts:
        keyword, *rest = line.split(None, 1)[:2] or ("#",)
        if keyword.startswith("#") or not rest:
            continue
        if keyword.lower() == "newmtl":
            name = rest[0].strip()
            current = entries.setdefault(name, MtlEntry(name, library, folders, {}, {}))
        else:
            current.values[keyword.lower()] = rest[0].strip()
            current.spelled[keyword.lower()] = keyword
    notes = () if plain else (f"{library.name} is not UTF-8; its names were read as Windows-1252.",)
    return entries, notes


def material(entry: MtlEntry, budget: Budget) -> RawMaterial:
    """The raw material. Kd applies only without map_Kd (many exporters write Kd 0 or 0.8 beside a texture), as do Pr,
    Pm, d and Ke without their textures."""
    named = {TEXTURES[k]: statement(v) for k, v in entry.values.items() if k in TEXTURES}
    bump = next((statement(entry.values[k]) for k in BUMPS if k in entry.values), None)
    textures = named | ({"bump": bump} if bump is not None else {})
    colour = [1.0, 1.0, 1.0] if "albedo" in named else _triple(entry, "kd", 1.0)
    rough = 1.0 if "roughness" in named else _numbers(entry, "pr", [0.5])[0]
    metal = 1.0 if "metallic" in named else _numbers(entry, "pm", [0.0])[0]
    tiled = any(tile_name(texture.file, 1001) is not None for texture in textures.values())
    red, green, blue = (float(np.clip(c, 0, 1)) for c in colour)
    return RawMaterial(
        entry.name,
        partial(_load, textures, entry, budget) if textures else no_textures,
        (tiled or False) if textures else None,
        (red, green, blue),
        float(np.clip(rough, 0, 1)),
        float(np.clip(metal, 0, 1)),
        _shading(entry, named),
    )


def _shading(entry: MtlEntry, named: Mapping[str, Statement]) -> Shading:
    """Opacity (d, or 1 - Tr where d is absent) and emission (Ke, which may exceed 1)."""
    opacity = _numbers(entry, "d", [1.0 - _numbers(entry, "tr", [0.0])[0]])[0]
    red, green, blue = [1.0] * 3 if "emission" in named else (max(c, 0.0) for c in _triple(entry, "ke", 0.0))
    return Shading(opacity=1.0 if "opacity" in named else float(np.clip(opacity, 0, 1)), emission=(red, green, blue))


def unread(entries: Sequence[MtlEntry]) -> list[str]:
    """Notes on the statements of materials that change how they look and were not read, or are not painted."""
    notes, skipped = [], {}
    for entry in entries:
        shading, textures = _shading(entry, {}), [key for key in ("map_d", "map_ke") if key in entry.values]
        drawn = ["opacity"] * (shading.opacity < 1 or "map_d" in textures)
        drawn += ["emission"] * (any(shading.emission) or "map_ke" in textures)
        if drawn:
            notes.append(
                f"The {' and '.join(drawn)} of material '{entry.name}' {SHOWN}; "
                "views, paintings and finished assets omit it."
            )
        if {"d", "tr"} <= set(entry.values):
            dissolve, transparency = (_numbers(entry, key, [np.nan])[0] for key in ("d", "tr"))
            if abs(dissolve + transparency - 1) > 0.01:
                notes.append(f"Material '{entry.name}' states both d and Tr, which disagree; d was read.")
        for key in entry.values:
            ignored = key not in READ and _changes(entry, key)
            # Odd: a spectrum, or a halo.
            odd = key in NUMBERS and f"map_{key}" not in entry.values and _is_odd(entry, key)
            if ignored or odd:
                skipped.setdefault(entry.library.name, {})[entry.spelled[key]] = None
    sentences = (f"{library}: these statements were not read: {', '.join(keys)}." for library, keys in skipped.items())
    return [*notes, *sentences]


def _changes(entry: MtlEntry, key: str) -> bool:
    if key not in entry.values:
        return False
    if key == "ns":  # the exponent of Ks; Pr takes precedence
        return _changes(entry, "ks")
    if key == "ks" and {"pr", "map_pr", "pm", "map_pm"} & set(entry.values):
        return False
    if key == "map_ka":
        return entry.values[key] != entry.values.get("map_kd")
    try:
        return any(float(word) != NEUTRAL[key] for word in entry.values[key].split())
    except (KeyError, ValueError):
        return True


def _triple(entry: MtlEntry, key: str, default: float) -> list[float]:
    """A colour: three numbers, or one for all."""
    count = 1 if len(entry.values.get(key, "").split()) == 1 else 3
    return _numbers(entry, key, [default] * count) * (3 // count)


def _is_odd(entry: MtlEntry, key: str) -> bool:
    """Whether a statement's values are no numbers."""
    count = min(NUMBERS[key], len(entry.values[key].split()))
    return bool(np.isnan(_numbers(entry, key, [np.nan] * count)[0]))


def _numbers(entry: MtlEntry, key: str, default: list[float]) -> list[float]:
    try:
        values = [float(x) for x in entry.values.get(key, "").split()[: len(default)]]
    except ValueError:
        return default
    return values if len(values) == len(default) and np.isfinite(values).all() else default


def statement(text: str) -> Statement:
    """A texture statement's options, and the file name behind them, which may hold spaces."""
    rest, options = text, {}
    while (parts := rest.split(None, 1)) and parts[0].lower() in OPTIONS and len(parts) == 2:
        option, rest = parts[0].lower(), parts[1]
        values: list[str] = []
        for k in range(OPTIONS[option]):
            pieces = rest.split(None, 1)
            if len(pieces) < 2 or (k > 0 and not re.fullmatch(r"[-+.\deE]+", pieces[0])):
                break
            values.append(pieces[0])
            rest = pieces[1]
        options[option] = values

    def numbers(option: str, default: tuple[float, ...]) -> tuple[float, ...]:
        try:
            floats = [float(x) for x in options.get(option, ())][: len(default)]
        except ValueError:
            return default
        return (*floats, *default[len(floats) :]) if np.isfinite(floats).all() else default

    scale, offset, mm = numbers("-s", (1.0, 1.0)), numbers("-o", (0.0, 0.0)), numbers("-mm", (0.0, 1.0))
    first = {option: (options.get(option) or [""])[0].lower() for option in ("-clamp", "-imfchan", "-colorspace")}
    return Statement(
        rest.strip(), (scale[0], scale[1]), (offset[0], offset[1]), any(numbers("-t", (0.0, 0.0, 0.0))),
        first["-clamp"] == "on", numbers("-bm", (1.0,))[0], mm[0], mm[1], first["-imfchan"], first["-colorspace"],
    )  # fmt: skip


def tile_name(file: str, tile: int) -> str | None:
    """The file of a UDIM tile, where the name marks tiles (<UDIM>, or 1001 between dots or underscores); else None."""
    if "<UDIM>" in file:
        return file.replace("<UDIM>", str(tile))
    marked = r"(?<=[._])1001(?=[._][^/\\]*$)"
    return re.sub(marked, str(tile), file) if re.search(marked, file) else None


def _load(textures: dict[str, Statement], entry: MtlEntry, budget: Budget, tile: int) -> tuple[Maps, tuple[str, ...]]:
    maps: dict[str, RawMap] = {}
    notes: list[str] = []
    for name, stmt in textures.items():
        file = tile_name(stmt.file, tile) or stmt.file
        if name == "bump" and "normal" in maps:
            if stmt.file != textures["normal"].file:
                notes.append(f"Bump map {file} was left out beside the normal map of material '{entry.name}'.")
            continue
        pixels = named_texture(entry.library, entry.folders, file, budget, notes)
        if pixels is None:
            continue
        if name == "opacity":
            maps[name] = _opacity(stmt, *pixels, named_alpha(entry.library, entry.folders, file), notes)
            continue
        entry_map = _converted("normal" if name == "bump" else name, stmt, *pixels, notes)
        if name == "bump" and not _is_normal_map(pixels[0]):
            notes.append(f"Bump map {file} holds heights, not normals, and was left out.")
            continue
        maps["normal" if name == "bump" else name] = entry_map
    return maps, tuple(notes)


def _converted(name: str, stmt: Statement, pixels: np.ndarray, linear: bool, notes: list[str]) -> RawMap:
    """One map with its statement's options applied."""
    if stmt.turbulence:
        notes.append(f"The turbulence (-t) of texture {stmt.file} was not read.")
    if stmt.space and stmt.space not in (*LINEAR, *SRGB):
        notes.append(f"The colour space {stmt.space} of texture {stmt.file} is not known and was not read.")
    colour = name in ("albedo", "emission")
    kind: Kind = "colour" if colour else "normal" if name == "normal" else "data"
    if colour and (linear or stmt.space in LINEAR):
        kind, pixels = "data", np.clip(fractions(pixels), 0, 1)
    elif kind == "data":
        pixels = np.clip(pixels, 0, 1) if linear else pixels
        pixels = _channel(linear_rows(pixels) if stmt.space in SRGB and stmt.space != "auto" else pixels, stmt, notes)
    if (stmt.base, stmt.gain) != (0, 1) and kind != "normal":
        pixels = np.clip(fractions(pixels) * np.float32(stmt.gain) + np.float32(stmt.base), 0, 1)
    return RawMap(
        pixels,
        transform=stmt.transform,
        kind=kind,
        scale=stmt.strength if kind == "normal" else 1.0,
        wrap=("clamp", "clamp") if stmt.clamp else REPEAT,
    )


def _opacity(
    stmt: Statement, pixels: np.ndarray, linear: bool, alpha: Float[np.ndarray, "h w"] | None, notes: list[str]
) -> RawMap:
    """The coverage of a map_d: the channel that it names, else the picture's alpha, else its luminance.

    MTL's default is the luminance, but a picture with transparency is nearly always meant by its alpha: a note says so.
    """
    if alpha is None or stmt.channel not in ("", "m"):
        by_channel = replace(stmt, channel="l" if stmt.channel in ("", "m") else stmt.channel)
        return _converted("opacity", by_channel, pixels, linear, notes)
    if not stmt.channel:
        notes.append(f"The opacity of texture {stmt.file} was read from its alpha channel.")
    return _converted("opacity", replace(stmt, channel="", space=""), np.repeat(alpha[..., None], 3, 2), True, notes)


def _channel(pixels: Shaped[np.ndarray, "h w 3"], stmt: Statement, notes: list[str]) -> Shaped[np.ndarray, "h w"]:
    """The channel that `-imfchan` names; red where it names none."""
    if stmt.channel in ("m", "z"):
        notes.append(f"Channel {stmt.channel} of texture {stmt.file} is not read; red was used.")
    if stmt.channel == "l":
        return fractions(pixels) @ np.array([0.2126, 0.7152, 0.0722], np.float32)
    return np.ascontiguousarray(pixels[..., {"g": 1, "b": 2}.get(stmt.channel, 0)])


def _is_normal_map(pixels: Shaped[np.ndarray, "h w 3"]) -> bool:
    """Whether the colours of a picture are unit vectors that point outwards; heights are grey."""
    colours = fractions(pixels[:: max(1, len(pixels) // 512), :: max(1, pixels.shape[1] // 512)])
    apart = colours.max(axis=2) - colours.min(axis=2)
    if np.quantile(apart, 0.99) <= FLAT_GREY / 255:
        return False
    length = np.linalg.norm(colours * 2 - 1, axis=2)
    return bool(colours[..., 2].mean() > 0.5 and np.median(np.abs(length - 1)) < 0.2)
