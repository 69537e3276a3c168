"""The files of one delivery: textures packed for a program, and the materials that refer to them."""

import re
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from mistyle.core.errors import InputRefused, UsageError
from mistyle.files.bounds import USD
from mistyle.files.materialx import Look, write_materialx
from mistyle.files.obj_write import write_obj
from mistyle.files.ocio import ColourSpace, exr_tags
from mistyle.files.packing import TARGETS, Target, TextureSet, write_slot
from mistyle.files.store import sha256_file
from mistyle.files.textures import safe_name
from mistyle.run.finished import Finished

# What materials in files refer to: every map by itself, whatever the target packs.
SINGLE = ("albedo", "normal", "roughness", "metallic")


@dataclass(frozen=True)
class Delivery:
    """One delivery: what is written, for whom, under which name. `source` is the mesh file that the look lies on."""

    formats: tuple[str, ...]
    target: str
    name: str
    version: int | None
    textures: str
    unit: float
    space: ColourSpace | None
    source: Path | None


def fields_for(manifest: Mapping[str, Any], target: str) -> dict[str, str]:
    """What a pattern for delivered names is filled with."""
    told = manifest.get("provenance", {})
    mesh = Path(str(told.get("mesh") or manifest.get("source") or manifest["name"])).stem
    style = Path(str(told.get("style") or told.get("references") or "")).stem
    return {"asset": str(manifest["name"]), "mesh": mesh, "style": style or "look", "target": target}


def write_delivery(folder: Path, out: Path, finished: Finished, chosen: Delivery) -> dict[str, Any]:
    """Write one delivery; returns its record."""
    target = TARGETS[chosen.target]
    referring = any(f in chosen.formats for f in ("usd", "mtlx", "obj"))
    slots = _slots(chosen.formats, target, referring)
    written: list[dict[str, Any]] = []
    for textures in finished.sets:
        for slot in slots:
            # A material in a file wants +Y whatever the target's own normal map is.
            down = slot.map == "normal" and slot in target.slots and target.normal == "-Y"
            kind = "normal_dx" if down and referring else slot.map
            file = texture_name(chosen.textures, chosen.name, finished, textures, kind, slot.ext)
            write_slot(folder / "textures" / file, slot, textures, chosen.space)
            about = {"map": slot.map, "colour": slot.colour, "bits": slot.bits, "set": textures.name}
            about |= {"space": exr_tags(chosen.space)["colorInteropID"]} if slot.colour == "linear" else {}
            about |= {"normal": "-Y (DirectX)" if down else "+Y (OpenGL)"} if slot.map == "normal" else {}
            written.append({"file": f"textures/{file}", **about})
    shared = []
    if referring:
        shared = _materials(folder, out, finished, chosen, {(s.map, s.ext) for s in slots})
    if "glb" in chosen.formats:
        shutil.copy2(finished.folder / f"{finished.manifest['name']}.glb", folder / f"{chosen.name}.glb")
    told = {e["file"]: e for e in written}
    files = []
    for path in sorted(p for p in folder.rglob("*") if p.is_file()):
        file = path.relative_to(folder).as_posix()
        said = {"shared": True} if file in shared else {"sha256": sha256_file(path), "bytes": path.stat().st_size}
        files.append(told.get(file, {"file": file}) | said)
    record = {"name": chosen.name, "asset": finished.manifest["name"], "version": chosen.version}
    record |= {"target": chosen.target, "about": target.about, "formats": list(chosen.formats), "files": files}
    return record | {"provenance": finished.manifest.get("provenance", {})}


def _slots(formats: Sequence[str], target: Target, referring: bool) -> list[Any]:
    """The textures to write: the target's, and single maps where materials in files refer to them."""
    slots = [*target.slots] if "maps" in formats or referring else []
    if referring:
        there = {slot.map for slot in slots if slot.map != "normal" or target.normal == "+Y"}
        extra = {s.map: s for s in TARGETS["blender"].slots}
        slots += [extra[m] for m in SINGLE if m not in there]
    return slots


def texture_name(names: str, name: str, finished: Finished, chosen: TextureSet, kind: str, ext: str) -> str:
    """The file of one map: `<name>[_<set>]_<map>[.<udim>].<ext>` by default."""
    tiles = {s.tile for s in finished.sets}
    pattern = names
    if len(tiles) > 1 and "{udim}" not in pattern:
        pattern = pattern.replace(".{ext}", ".{udim}.{ext}")
    return safe_name(pattern.format(asset=_set_name(name, finished, chosen), map=kind, ext=ext, udim=chosen.tile))


def _set_name(name: str, finished: Finished, chosen: TextureSet) -> str:
    """The delivered name, with the material's where several have textures; tiles of one material share it."""
    base = re.sub(r"\.1\d{3}$", "", chosen.name)
    others = {re.sub(r"\.1\d{3}$", "", s.name) for s in finished.sets}
    return name if len(others) == 1 else name + base.removeprefix(str(finished.manifest["name"]))


def _materials(folder: Path, out: Path, finished: Finished, chosen: Delivery, kinds: set) -> list[str]:
    """USD, MaterialX and OBJ, which all refer to the single maps; returns the files that deliveries share."""
    exr = ("albedo", "exr") in kinds
    ext = "exr" if exr else "png"
    looks, tiles = [], []
    for part, textures in enumerate(finished.sets):
        named = {m: texture_name(chosen.textures, chosen.name, finished, textures, m, ext) for m in SINGLE}
        label = identifier(finished.asset.mesh.parts[part])
        looks.append(Look(label, *(f"textures/{named[m]}" for m in SINGLE), srgb=not exr, space=chosen.space))
        tiles.append(textures.tile)
    mesh, positions = finished.asset.mesh, finished.asset.source.user_positions
    if "obj" in chosen.formats:
        write_obj(folder / f"{chosen.name}.obj", mesh, positions, tiles, looks)
    if "mtlx" in chosen.formats:
        write_materialx(folder / f"{chosen.name}.mtlx", looks)
    if "usd" in chosen.formats and Path(str(finished.manifest.get("source", ""))).suffix.lower() in USD:
        return _look_layer(folder, out, finished, chosen, looks)
    if "usd" in chosen.formats:
        from mistyle.files.usd import write_usd, write_usdz

        stage = folder / f"{chosen.name}.usda"
        write_usd(stage, identifier(chosen.name), mesh, positions, looks, metres_per_unit=chosen.unit)
        write_usdz(stage.with_suffix(".usdz"), stage)
    return []


def identifier(name: str) -> str:
    """A name as USD and MaterialX take them: letters, digits and '_', no digit first."""
    plain = re.sub(r"\W+", "_", name, flags=re.ASCII) or "material"
    return f"_{plain}" if plain[0].isdigit() else plain


def _look_layer(folder: Path, out: Path, finished: Finished, chosen: Delivery, looks: Sequence[Look]) -> list[str]:
    """A USD mesh gets its look as a layer over the file it came from, one variant per style."""
    from mistyle.files.records import load_record
    from mistyle.files.usd_look import write_look

    record = finished.folder.parent / "work" / "mesh" / "record"
    if not record.is_dir():
        raise InputRefused(
            f"{record}: found nothing, expected the mesh as the run read it; a look layer needs the whole run folder"
        )
    asset = load_record(record)
    source = chosen.source or asset.source.path
    if not source.is_file():
        raise UsageError(f"{source}: the USD file that this run read is not there; say where it is with --source")
    layer = f"{identifier(source.stem)}_look.usda"
    fields = fields_for(finished.manifest, chosen.target)
    variant = identifier(fields["style"]) + (f"_v{chosen.version:03}" if chosen.version is not None else "")
    before = (out / layer).read_text(encoding="utf-8") if (out / layer).is_file() else None
    asset = replace(asset, source=replace(asset.source, path=source.resolve()))
    write_look(folder / layer, before, asset, looks, variant, beside=out.resolve())
    return [layer]
