"""`mistyle export`: a finished asset in the files that other programs want.

OUT/<asset>.glb .usda .usdz .mtlx .obj/.mtl        the formats asked for
OUT/textures/<asset>_<map>[.<udim>].<ext>          packed as the target wants them
OUT/<asset>.export.json                            every file with sha256, colour space and channels
"""

import json
import re
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mistyle.core.asset import Asset
from mistyle.core.errors import InputRefused, UsageError
from mistyle.core.image import linear_from_srgb
from mistyle.files.materialx import Look, write_materialx
from mistyle.files.obj_write import write_obj
from mistyle.files.packing import TARGETS, Target, TextureSet, write_slot
from mistyle.files.store import atomic_folder, atomic_write, sha256_file
from mistyle.files.textures import safe_name

FORMATS = ("glb", "usd", "mtlx", "obj", "maps")
NAMES = "{asset}_{map}.{ext}"
# What materials in files refer to: every map by itself, whatever the target packs.
SINGLE = ("albedo", "normal", "roughness", "metallic")


@dataclass(frozen=True)
class Finished:
    """An asset folder of ours, read back: the mesh, its texture sets, and what its list says."""

    asset: Asset
    sets: tuple[TextureSet, ...]
    manifest: dict[str, Any]
    folder: Path


def read_finished(place: Path) -> Finished:
    """The asset of a run folder, an asset folder or a <name>.json. Raises InputRefused."""
    from mistyle.files.read import read_mesh

    listing = _listing(place)
    try:
        manifest = json.loads(listing.read_text(encoding="utf-8"))
        stems = [(str(part["name"]), str(part["textures"])) for part in manifest["parts"]]
        name = str(manifest["name"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputRefused(
            f"{listing}: not the list of an asset of ours ({error}); export what mistyle wrote"
        ) from None
    folder = listing.parent
    glb = folder / f"{name}.glb"
    if not glb.is_file():
        raise InputRefused(f"{glb}: found nothing, expected the asset that {listing.name} lists")
    asset = read_mesh(glb, uv="keep")
    if len(asset.mesh.parts) != len(stems):
        raise InputRefused(
            f"{glb}: found {len(asset.mesh.parts)} texture sets, {listing.name} lists {len(stems)}; run the job again"
        )
    sets = [_texture_set(folder / "textures", part, stem) for part, stem in stems]
    return Finished(asset, tuple(sets), manifest, folder)


def _listing(place: Path) -> Path:
    if place.suffix == ".json":
        return place
    for folder in (place / "asset", place):
        found = [p for p in sorted(folder.glob("*.json")) if p.name != "done.json"] if folder.is_dir() else []
        if found:
            return found[0]
    raise InputRefused(
        f"{place}: found no asset; expected a run folder of mistyle, its asset folder, or its <name>.json"
    )


def _texture_set(folder: Path, part: str, stem: str) -> TextureSet:
    from mistyle.files.read import read_exr, read_picture

    def planes(kind: str) -> Mapping[str, np.ndarray]:
        return read_exr(folder / f"{stem}_{kind}.exr")

    albedo, normal, roughness, orm = (planes(kind) for kind in ("albedo", "normal", "roughness", "orm"))
    tile = re.search(r"\.(1\d{3})$", part)
    rgb = np.stack([albedo[c] for c in "RGB"], axis=-1)
    # The PNG is what everyone else sees, edits included; a changed one takes the EXR's place.
    shown = linear_from_srgb(read_picture(folder / f"{stem}_albedo.png").rgb)
    if shown.shape == rgb.shape and np.abs(shown - np.clip(rgb, 0, 1)).max() > 0.02:
        rgb = shown
    return TextureSet(
        name=stem,
        tile=int(tile[1]) if tile else 1001,
        albedo=rgb.astype(np.float32),
        normal=np.stack([normal[c] for c in "RGB"], axis=-1).astype(np.float32),
        roughness=roughness["Y"],
        metallic=orm["B"],
        occlusion=orm["R"],
        alpha=albedo.get("A"),
    )


def export(
    place: Path,
    out: Path,
    *,
    formats: Sequence[str],
    target: str = "blender",
    names: str = NAMES,
    metres_per_unit: float = 1.0,
) -> list[Path]:
    """Write the asset found at `place` into the folder `out`; returns the files. The folder is replaced as a whole.

    `names` is the pattern of texture files: {asset}, {map}, {ext}, and {udim} where the asset has tiles.
    """
    wrong = [f for f in formats if f not in FORMATS]
    if wrong or target not in TARGETS:
        offered = f"formats {', '.join(FORMATS)}; targets {', '.join(TARGETS)}"
        raise UsageError(f"'{wrong[0] if wrong else target}' cannot be written; expected {offered}")
    _check_names(names)
    if out.exists() and any(out.iterdir()) and not list(out.glob("*.export.json")):
        raise UsageError(f"{out}: this folder holds other things; choose an empty or new one")
    finished = read_finished(place)
    atomic_folder(out, lambda new: _fill(new, finished, formats, TARGETS[target], target, names, metres_per_unit))
    return sorted(p for p in out.rglob("*") if p.is_file())


def _check_names(names: str) -> None:
    known = {"asset", "map", "ext", "udim"}
    fields = set(re.findall(r"\{(\w*)\}", names))
    if not {"map", "ext"} <= fields or fields - known or "/" in names or "\\" in names:
        raise UsageError(
            f"--name {names!r}: expected a file name with {{map}} and {{ext}}, and maybe {{asset}}, {{udim}}"
        )


def _fill(
    folder: Path, finished: Finished, formats: Sequence[str], target: Target, label: str, names: str, unit: float
) -> None:
    name = str(finished.manifest["name"])
    textures = folder / "textures"
    written: list[dict[str, Any]] = []
    referring = any(f in formats for f in ("usd", "mtlx", "obj"))
    slots = [*target.slots] if "maps" in formats or referring else []
    if referring:
        there = {slot.map for slot in slots if slot.map != "normal" or target.normal == "+Y"}
        extra = {s.map: s for s in TARGETS["blender"].slots}
        slots += [extra[m] for m in SINGLE if m not in there]
    for chosen in finished.sets:
        for slot in slots:
            # A material in a file wants +Y whatever the target's own normal map is.
            down = slot.map == "normal" and slot in target.slots and target.normal == "-Y"
            file = texture_name(
                names, name, finished, chosen, "normal_dx" if down and referring else slot.map, slot.ext
            )
            write_slot(textures / file, slot, chosen)
            about = {"map": slot.map, "colour": slot.colour, "bits": slot.bits, "set": chosen.name}
            about |= {"normal": "-Y (DirectX)" if down else "+Y (OpenGL)"} if slot.map == "normal" else {}
            written.append({"file": f"textures/{file}", **about})
    if referring:
        _materials(folder, finished, formats, names, name, unit, {(s.map, s.ext) for s in slots})
    if "glb" in formats:
        shutil.copy2(finished.folder / f"{name}.glb", folder / f"{name}.glb")
    told = {e["file"]: e for e in written}
    files = [
        told.get(p.relative_to(folder).as_posix(), {"file": p.relative_to(folder).as_posix()})
        | {"sha256": sha256_file(p), "bytes": p.stat().st_size}
        for p in sorted(folder.rglob("*"))
        if p.is_file()
    ]
    record = {"name": name, "target": label, "about": target.about, "formats": list(formats), "files": files}
    record |= {"provenance": finished.manifest.get("provenance", {})}
    atomic_write(folder / f"{name}.export.json", (json.dumps(record, indent=1) + "\n").encode())


def texture_name(names: str, name: str, finished: Finished, chosen: TextureSet, kind: str, ext: str) -> str:
    """The file of one map: `<asset>[_<set>]_<map>[.<udim>].<ext>` by default."""
    tiles = {s.tile for s in finished.sets}
    asset = _set_name(name, finished, chosen)
    pattern = names
    if len(tiles) > 1 and "{udim}" not in pattern:
        pattern = pattern.replace(".{ext}", ".{udim}.{ext}")
    return safe_name(pattern.format(asset=asset, map=kind, ext=ext, udim=chosen.tile))


def _set_name(name: str, finished: Finished, chosen: TextureSet) -> str:
    """The asset's name, with the material's where several have textures; tiles of one material share it."""
    base = re.sub(r"\.1\d{3}$", "", chosen.name)
    others = {re.sub(r"\.1\d{3}$", "", s.name) for s in finished.sets}
    return name if len(others) == 1 else base


def _materials(folder, finished: Finished, formats, names: str, name: str, unit: float, kinds: set) -> None:
    """USD, MaterialX and OBJ, which all refer to the single maps."""
    exr = ("albedo", "exr") in kinds
    ext = "exr" if exr else "png"
    looks, tiles = [], []
    for part, chosen in enumerate(finished.sets):
        files = {m: f"textures/{texture_name(names, name, finished, chosen, m, ext)}" for m in SINGLE}
        label = re.sub(r"\W+", "_", finished.asset.mesh.parts[part]) or "material"
        label = label if not label[0].isdigit() else f"_{label}"
        looks.append(Look(label, *(files[m] for m in SINGLE), srgb=not exr))
        tiles.append(chosen.tile)
    mesh, positions = finished.asset.mesh, finished.asset.source.user_positions
    if "obj" in formats:
        write_obj(folder / f"{name}.obj", mesh, positions, tiles, looks)
    if "mtlx" in formats:
        write_materialx(folder / f"{name}.mtlx", looks)
    if "usd" in formats:
        from mistyle.files.usd import write_usd, write_usdz

        prim = re.sub(r"\W+", "_", name)
        prim = prim if not prim[0].isdigit() else f"_{prim}"
        write_usd(folder / f"{name}.usda", prim, mesh, positions, looks, metres_per_unit=unit)
        write_usdz(folder / f"{name}.usdz", folder / f"{name}.usda")
