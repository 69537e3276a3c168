"""The asset folder, as every job writes it: GLB, textures, and a list of all files.

    <name>.glb                                       the asset with its textures inside
    textures/<name>_{albedo,normal,roughness,orm}.png   8 bits: albedo sRGB, the others linear
    textures/<name>_{albedo,normal,roughness,orm}.exr   16-bit float: albedo linear Rec.709, the others data
    textures/<name>_height.{png,exr}                    on request: 16 bits about 0.5, and float in the mesh's units
    <name>.json                                      every file with its sha256, size, colour space and meaning

With several parts (texture sets) the textures are called <name>_<part>_<map>.
"""

import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from mistyle import __version__
from mistyle.atlas.texels import corner_weights
from mistyle.core.asset import Asset
from mistyle.core.image import nearest_fill
from mistyle.core.maps import Heights, Maps, Texels
from mistyle.core.names import checked
from mistyle.geometry.retexture import fetch
from mistyle.io.gltf.alpha import Cutout, cutouts
from mistyle.io.gltf.write import patch_glb, write_glb
from mistyle.io.images.textures import Pictures, encode_pictures, normal_colours, orm_colours, part_stems
from mistyle.io.images.write import write_exr, write_png
from mistyle.io.store.atomic import atomic_write, sha256_file
from mistyle.io.store.output import put_folder
from mistyle.io.store.trusted_json import read_own

NORMAL_CONVENTION = {
    "space": "tangent",
    "frame": "MikkTSpace",
    "green": "+Y (OpenGL)",
    "encoding": "n = 2 c - 1",
}
COLOUR_SPACES = {
    ("albedo", "png"): "sRGB (IEC 61966-2-1), Rec.709 primaries",
    ("albedo", "exr"): "linear Rec.709 (lin_rec709_scene)",
}
CHANNELS = {
    "albedo": "base colour",
    "normal": "tangent-space normal",
    "roughness": "perceptual roughness (GGX alpha = roughness squared)",
    "orm": "R ambient occlusion (1 is open), G roughness, B metallic",
}
HEIGHT = "displacement along the normal: (value - middle) x scale, in the units of the mesh"


def write_asset(
    folder: Path,
    name: str,
    asset: Asset,
    maps: Sequence[Maps],
    occlusion: Sequence[Float[np.ndarray, "h w"]],
    texels: Sequence[Texels],
    *,
    provenance: dict[str, Any],
) -> dict[str, Any]:
    """`write_sets` for sequences of maps, occlusions and texels, one entry per part of the mesh each."""
    return write_sets(folder, name, asset, zip(maps, occlusion, texels, strict=True), provenance=provenance)


def write_sets(
    folder: Path,
    name: str,
    asset: Asset,
    sets: Iterable[tuple[Maps, Float[np.ndarray, "h w"], Texels]],
    *,
    provenance: dict[str, Any],
    heights: Heights | None = None,
) -> dict[str, Any]:
    """Write GLB, textures and the list of files into `folder`; returns the list (the content of <name>.json).

    `sets` yields maps, occlusion (1 is open) and texels of every part of the mesh in turn. One set is written before
    the next is read; only its PNG files stay in memory. The maps are padded around their islands. A glTF source is
    patched, any other format gets a new GLB. `provenance` holds JSON values that do not change between runs (no
    times): it goes into the GLB and the list, so that equal inputs give equal bytes.

    The folder is filled in a temporary place and moved when complete. Unedited files of an earlier export of the same
    name are removed, all other files stay. UsageError for a name that is not a file name, and where a new file would
    replace a file that no export wrote.
    """
    name = checked(name)
    result: dict[str, Any] = {}

    def fill(new: Path) -> None:
        result.update(_write(new, name, asset, sets, provenance, heights))

    put_folder(folder, fill, lambda target: _earlier(target, name))
    return result


def _write(
    new: Path, name: str, asset: Asset, sets, provenance: dict[str, Any], heights: Heights | None
) -> dict[str, Any]:
    stems = part_stems(name, asset.mesh.parts)
    alpha_by_part = cutouts(asset) if asset.source.kind in ("glb", "gltf") else {}
    pictures: list[Pictures] = []
    files: list[dict[str, Any]] = []
    remaining = iter(sets)
    for part, stem in enumerate(stems):
        # No variable of the loop holds a set: its memory is free before the next one is computed.
        encoded, written = _write_set(new, stem, asset, alpha_by_part.get(part), next(remaining))
        pictures.append(encoded)
        written += [] if heights is None else _write_height(new / "textures", stem, heights.maps[part], heights.scale)
        files += [_entry(new, path, part=asset.mesh.parts[part], **about) for path, about in written]
    write = patch_glb if asset.source.kind in ("glb", "gltf") else write_glb
    glb = new / f"{name}.glb"
    write(glb, asset, (), (), name=name, provenance=provenance, pictures=pictures)
    manifest = {
        "generator": f"mistyle {__version__}",
        "name": name,
        "source": asset.source.path.name,
        "uv": asset.source.uv,
        "parts": [
            {"name": p, "material": m.name, "textures": s}
            for p, m, s in zip(asset.mesh.parts, asset.materials, stems, strict=True)
        ],
        "normal_map": NORMAL_CONVENTION,
        "notes": list(asset.source.notes),
        "provenance": provenance,
        "files": [_entry(new, glb, what="glTF 2.0, textures inside"), *files],
    }
    atomic_write(new / f"{name}.json", (json.dumps(manifest, indent=1, ensure_ascii=False) + "\n").encode())
    return manifest


def asset_names(name: str, parts: Sequence[str]) -> list[str]:
    """The files that `write_asset` writes for an asset with these parts, inside its folder."""
    stems = part_stems(name, parts)
    maps = [f"textures/{stem}_{kind}.{ext}" for stem in stems for kind in CHANNELS for ext in ("png", "exr")]
    return [f"{name}.glb", f"{name}.json", *maps]


def _write_set(
    new: Path, stem: str, asset: Asset, cutout: Cutout | None, texture_set: tuple[Maps, np.ndarray, Texels]
) -> tuple[Pictures, list[tuple[Path, dict[str, Any]]]]:
    """The PNG files of one part for the GLB, and its texture files with their entries for the list."""
    maps, occlusion, texels = texture_set
    alpha = None if cutout is None else _source_alpha(asset, cutout, texels)
    pictures = encode_pictures(maps, occlusion, alpha)
    return pictures, _write_textures(new / "textures", stem, maps, occlusion, alpha, pictures)


def _write_textures(
    folder: Path, stem: str, maps: Maps, occlusion: np.ndarray, alpha: np.ndarray | None, pictures: Pictures
) -> list[tuple[Path, dict[str, Any]]]:
    """The eight texture files of one part, each with its entry for the list."""
    # One at a time: each array of a large atlas takes much memory.
    arrays = {
        "albedo": lambda: maps.albedo if alpha is None else np.concatenate([maps.albedo, alpha[..., None]], axis=-1),
        "normal": lambda: normal_colours(maps.normal),
        "roughness": lambda: maps.roughness,
        "orm": lambda: orm_colours(maps, occlusion),
    }
    result = []
    for kind, make in arrays.items():
        array = make()
        png, exr = folder / f"{stem}_{kind}.png", folder / f"{stem}_{kind}.exr"
        if kind == "roughness":
            write_png(png, array)
        else:
            atomic_write(png, getattr(pictures, kind))
        names = "Y" if array.ndim == 2 else "RGBA"[: array.shape[2]]
        channels = {c: array if array.ndim == 2 else array[..., k] for k, c in enumerate(names)}
        tags = {"mistyle:map": kind} | ({} if kind == "albedo" else {"colorInteropID": "data"})
        write_exr(exr, channels, half=True, attributes=tags)
        about = {"map": kind, "what": CHANNELS[kind], "size": [array.shape[1], array.shape[0]]}
        about |= {"alpha": True} if kind == "albedo" and alpha is not None else {}
        result.append((png, about | {"bits": 8}))
        result.append((exr, about | {"bits": 16}))
    return result


def _write_height(folder: Path, stem: str, height: np.ndarray, scale: float) -> list[tuple[Path, dict[str, Any]]]:
    """The height map of one part: 16-bit PNG about its middle, and float EXR in the units of the mesh."""
    png, exr = folder / f"{stem}_height.png", folder / f"{stem}_height.exr"
    write_png(png, np.clip(height / np.float32(scale) + np.float32(0.5), 0, 1), bits=16)
    write_exr(exr, {"Y": height}, attributes={"mistyle:map": "height", "colorInteropID": "data"})
    about = {"map": "height", "what": HEIGHT, "size": [height.shape[1], height.shape[0]]}
    return [
        (png, about | {"bits": 16, "middle": 0.5, "scale": scale}),
        (exr, about | {"bits": 32, "middle": 0.0, "scale": 1.0}),
    ]


def _entry(folder: Path, path: Path, **about: Any) -> dict[str, Any]:
    entry = {"file": path.relative_to(folder).as_posix(), "sha256": sha256_file(path), "bytes": path.stat().st_size}
    if "map" in about:
        entry["colour_space"] = COLOUR_SPACES.get((about["map"], path.suffix[1:]), "none (linear data)")
    if about.get("map") == "normal":
        entry["normal_map"] = NORMAL_CONVENTION
    return entry | about


def _earlier(folder: Path, name: str) -> set[str]:
    """The unchanged files of an earlier export of this name, by its list."""
    own = f"{name}.json"
    try:
        manifest = read_own(folder / own)
        listed = {str(entry["file"]): entry["sha256"] for entry in manifest["files"]}
        if not str(manifest["generator"]).startswith("mistyle "):
            return set()
    except (OSError, ValueError, LookupError, TypeError):
        return set()
    return {own, *(f for f, value in listed.items() if (folder / f).is_file() and sha256_file(folder / f) == value)}


def _source_alpha(asset: Asset, cutout: Cutout, texels: Texels) -> Float[np.ndarray, "h w"]:
    """The source's alpha at every covered texel, sampled in the source's own UVs; the nearest value elsewhere."""
    rows, columns, face, weights = corner_weights(asset.mesh, texels)
    height, width = texels.covered.shape
    place = (weights[..., None] * cutout.uvs[face]).sum(axis=1)
    alpha = np.ones((height, width), np.float32)
    alpha[rows, columns] = fetch(cutout.alpha[..., None], place, cutout.wrap)[:, 0]
    alpha[rows, columns] *= (weights * cutout.corners[face]).sum(axis=1)
    return nearest_fill(alpha, texels.covered)
