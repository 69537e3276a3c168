"""The files of one delivery: textures packed for a target program, and materials that refer to them."""

import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from mistyle.core.asset import TURNED, Material
from mistyle.core.errors import InputRefused, UsageError
from mistyle.core.names import (
    IDENTIFIER,
    STEM,
    WRITTEN,
    distinct,
    folded,
    identifier,
    safe_name,
    split_tile,
    uses,
)
from mistyle.core.paths import real_path
from mistyle.deliver.losses import features, losses, source_losses, suffix_of_source
from mistyle.deliver.read_asset import FinishedAsset
from mistyle.io.images.ocio import ColourSpace, exr_tags
from mistyle.io.images.packing import FILM_HEIGHT, HEIGHT, TARGETS, Target, TextureSet, write_slot
from mistyle.io.materialx import HeightFile, TexturedMaterial, Transparency, write_materialx
from mistyle.io.meshes.obj_write import write_obj
from mistyle.io.meshes.objects import objects
from mistyle.io.sandbox.bounds import USD
from mistyle.io.store.atomic import sha256_file

# The maps that materials in files refer to: unpacked, whatever the target packs.
SINGLE = ("albedo", "normal", "roughness", "metallic")
LONGEST_MAP = "metallicsmoothness"
SHORTEST = 24  # bytes of a texture's name that make sets distinct


@dataclass(frozen=True)
class Delivery:
    """One delivery: formats, target and name. `source` is the USD file below a look layer."""

    formats: tuple[str, ...]
    target: str
    name: str
    version: int | None
    textures: str
    unit: float
    space: ColourSpace | None
    source: Path | None


def fields_for(manifest: Mapping[str, Any], target: str) -> dict[str, str]:
    """The values of the fields of a name pattern."""
    provenance = manifest.get("provenance", {})
    mesh = Path(str(provenance.get("mesh") or manifest.get("source") or manifest["name"])).stem
    style = Path(str(provenance.get("style") or provenance.get("references") or "")).stem
    return {"asset": str(manifest["name"]), "mesh": mesh, "style": style or "look", "target": target}


def write_delivery(folder: Path, out: Path, finished: FinishedAsset, chosen: Delivery) -> dict[str, Any]:
    """Write one delivery; returns its record."""
    target = TARGETS[chosen.target]
    referring = any(f in chosen.formats for f in ("usd", "mtlx", "obj"))
    slots = _slots(chosen.formats, target, referring)
    if slots and all(s.height is not None for s in finished.sets):
        slots.append(FILM_HEIGHT if target.slots[0].ext == "exr" else HEIGHT)
    pattern = _tiled(chosen.textures, finished.sets)
    labels = set_labels(pattern, chosen.name, finished)
    files = _texture_files(pattern, labels, finished.sets, slots, target, referring)
    written: list[dict[str, Any]] = []
    for textures, names in zip(finished.sets, files, strict=True):
        for slot, file in zip(slots, names, strict=True):
            down = _is_down(slot, target)
            write_slot(folder / "textures" / file, slot, textures, chosen.space)
            about = {"map": slot.map, "colour": slot.colour, "bits": slot.bits, "set": textures.name}
            about |= {"space": exr_tags(chosen.space)["colorInteropID"]} if slot.colour == "linear" else {}
            about |= height_of(slot, textures)
            about |= {"normal": "-Y (DirectX)" if down else "+Y (OpenGL)"} if slot.map == "normal" else {}
            written.append({"file": f"textures/{file}", **about})
    shared, found = [], features(finished) if set(chosen.formats) != {"glb"} else {}
    if referring:
        looks = _looks(finished, chosen, pattern, labels, slots)
        shared = _materials(folder, out, finished, chosen, looks, "double sides" in found)
    if "glb" in chosen.formats:
        shutil.copy2(finished.folder / f"{finished.manifest['name']}.glb", folder / f"{chosen.name}.glb")
    textures_by_file = {e["file"]: e for e in written}
    listed = []
    for path in sorted(p for p in folder.rglob("*") if p.is_file()):
        file = path.relative_to(folder).as_posix()
        checksum = {"shared": True} if file in shared else {"sha256": sha256_file(path), "bytes": path.stat().st_size}
        listed.append(textures_by_file.get(file, {"file": file}) | checksum)
    record = {"name": chosen.name, "asset": finished.manifest["name"], "version": chosen.version}
    record |= {"target": chosen.target, "about": target.about, "formats": list(chosen.formats), "files": listed}
    record |= {"sets": [s.name for s in finished.sets], "maps": sorted({s.map for s in slots})}
    record |= {"notes": list(notes(finished, chosen, found))}
    return record | {"provenance": finished.manifest.get("provenance", {})}


def _slots(formats: Sequence[str], target: Target, referring: bool) -> list[Any]:
    """The textures of the delivery: the target's, and unpacked maps where materials in files refer to them."""
    slots = [*target.slots] if "maps" in formats or referring else []
    if referring:
        present = {slot.map for slot in slots if slot.map != "normal" or target.normal == "+Y"}
        extra = {s.map: s for s in TARGETS["blender"].slots}
        slots += [extra[m] for m in SINGLE if m not in present]
    return slots


def notes(finished: FinishedAsset, chosen: Delivery, found: Mapping[str, str]) -> tuple[str, ...]:
    """Notes about the delivered files: a turned mesh, and the features `found` that a format lacks."""
    turned = [text for text in finished.manifest.get("notes", ()) if TURNED in text][: "obj" in chosen.formats]
    up = [f"{chosen.name}.obj has Y up, which OBJ cannot state. {text}" for text in turned]
    layered = suffix_of_source(finished) in USD  # a look layer lies over its source, which has everything
    kept = losses(found, [f for f in chosen.formats if not (f == "usd" and layered)])
    return (*up, *source_losses(finished.manifest.get("notes", ()), chosen.formats), *kept)


def height_of(slot: Any, textures: TextureSet) -> dict[str, float]:
    """Middle and scale of a height map: displacement = (value - middle) x scale in the mesh's units."""
    if slot.map != "height":
        return {}
    return {"middle": 0.5, "scale": textures.height_scale} if slot.ext == "png" else {"middle": 0.0, "scale": 1.0}


def _is_down(slot: Any, target: Target) -> bool:
    """Whether the slot is the target's own DirectX normal map (-Y); materials in files need +Y."""
    return slot.map == "normal" and slot in target.slots and target.normal == "-Y"


def _tiled(pattern: str, sets: Sequence[TextureSet]) -> str:
    """The pattern of texture files, with {udim} before the ending where the asset has tiles."""
    if len({s.tile for s in sets}) > 1 and "{udim}" not in pattern:
        return pattern.replace(".{ext}", ".{udim}.{ext}")
    return pattern


def set_labels(pattern: str, name: str, finished: FinishedAsset) -> list[str]:
    """The {asset} of every texture set: the delivered name, with the material's name where there are several.

    Tiles of one material share a label. All others differ even without case, and leave room for the rest of the
    pattern. UsageError where the pattern leaves too little room.
    """
    split = [split_tile(s.name) for s in finished.sets]
    groups = list(dict.fromkeys((base, bool(tile)) for base, tile in split))
    own = str(finished.manifest["name"])
    names = [name if len(groups) == 1 else name + base.removeprefix(own) for base, _ in groups]
    rest = len(pattern.format(asset="", map=LONGEST_MAP, ext="png", udim=1001).encode())
    room = (WRITTEN - rest) // max(uses(pattern, "asset"), 1)
    if room < SHORTEST:
        raise UsageError(f"--texture-name {pattern[:60]!r}: found {rest} bytes, expected at most {WRITTEN - SHORTEST}")
    labels = dict(zip(groups, distinct(names, limit=min(room, STEM)), strict=True))
    return [labels[base, bool(tile)] for base, tile in split]


def texture_name(pattern: str, label: str, tile: int, kind: str, ext: str) -> str:
    """The file of one map: `<label>_<map>[.<udim>].<ext>` by default."""
    return safe_name(pattern.format(asset=label, map=kind, ext=ext, udim=tile), WRITTEN)


def _texture_files(
    pattern: str, labels: Sequence[str], sets: Sequence[TextureSet], slots: Sequence[Any], target: Target, both: bool
) -> list[list[str]]:
    """The file of every slot of every set; `both` where both kinds of normal map are written. UsageError where two maps
    would share a file."""
    kinds = ["normal_dx" if both and _is_down(slot, target) else slot.map for slot in slots]
    files = [
        [texture_name(pattern, label, s.tile, kind, slot.ext) for kind, slot in zip(kinds, slots, strict=True)]
        for label, s in zip(labels, sets, strict=True)
    ]
    flat = [(folded(file), file) for names in files for file in names]
    clash = next((file for k, (key, file) in enumerate(flat) if key in {earlier for earlier, _ in flat[:k]}), None)
    if clash is not None:
        lacking = [f"{{{f}}}" for f in ("asset", "udim") if f"{{{f}}}" not in pattern]
        raise UsageError(
            f"--texture-name {pattern!r}: two maps would both be {clash}; "
            f"put {' and '.join(lacking) or 'something between its fields'} into it"
        )
    return files


def _looks(
    finished: FinishedAsset, chosen: Delivery, pattern: str, labels: Sequence[str], slots: Sequence[Any]
) -> list[TexturedMaterial]:
    """The material of every part with the files of its unpacked maps."""
    exr = any((s.map, s.ext) == ("albedo", "exr") for s in slots)
    parts = finished.asset.mesh.parts
    names = distinct([identifier(part) for part in parts], limit=IDENTIFIER)
    titles = distinct([safe_name(part, STEM) for part in parts], limit=STEM)
    looks = []
    for part, (name, title, label, textures) in enumerate(zip(names, titles, labels, finished.sets, strict=True)):
        files = [f"textures/{texture_name(pattern, label, textures.tile, m, 'exr' if exr else 'png')}" for m in SINGLE]
        raised = next((slot for slot in slots if slot.map == "height"), None)
        bump = None
        if raised is not None:
            file = f"textures/{texture_name(pattern, label, textures.tile, 'height', raised.ext)}"
            bump = HeightFile(file, **height_of(raised, textures))
        light = _light(finished.asset.materials[part], textures)
        looks.append(
            TexturedMaterial(name, *files, srgb=not exr, space=chosen.space, title=title, height=bump, light=light)
        )
    return looks


def _light(material: Material, textures: TextureSet) -> Transparency:
    """The opacity and the emission of a material of the GLB. An emission texture has UVs of its own and is left out."""
    shading = material.shading
    glow = shading.emission if material.emission is None else (0.0, 0.0, 0.0)
    return Transparency(textures.alpha is not None, shading.opacity, shading.cutoff, glow)


def _materials(
    folder: Path,
    out: Path,
    finished: FinishedAsset,
    chosen: Delivery,
    looks: Sequence[TexturedMaterial],
    double_sided: bool,
) -> list[str]:
    """Write USD, MaterialX and OBJ, which refer to the unpacked maps; returns the files that deliveries share."""
    tiles = [textures.tile for textures in finished.sets]
    mesh, positions = finished.asset.mesh, finished.asset.source.user_positions
    if "obj" in chosen.formats:
        write_obj(folder / f"{chosen.name}.obj", mesh, positions, tiles, looks, objects(finished.asset))
    if "mtlx" in chosen.formats:
        write_materialx(folder / f"{chosen.name}.mtlx", looks)
    if "usd" in chosen.formats and suffix_of_source(finished) in USD:
        return _look_layer(folder, out, finished, chosen, looks)
    if "usd" in chosen.formats:
        from mistyle.io.usd.write import write_usd, write_usdz

        stage = folder / f"{chosen.name}.usda"
        scale: Any = {"metres_per_unit": chosen.unit, "double_sided": double_sided}
        write_usd(stage, identifier(chosen.name), mesh, positions, looks, **scale)
        write_usdz(stage.with_suffix(".usdz"), stage)
    return []


def _look_layer(
    folder: Path, out: Path, finished: FinishedAsset, chosen: Delivery, looks: Sequence[TexturedMaterial]
) -> list[str]:
    """Write the look of a USD mesh as a layer over its source file, one variant per style."""
    from mistyle.io.store.records import load_record
    from mistyle.io.usd.look import write_look

    record = finished.folder.parent / "work" / "mesh" / "record"
    if not record.is_dir():
        raise InputRefused(
            f"{record}: found nothing, expected the run's record of its mesh; a look layer needs the whole run folder"
        )
    asset = load_record(record)
    source = chosen.source or asset.source.path
    if not source.is_file():
        raise UsageError(f"{source}: the USD file of this run is missing; give its path with --source")
    layer = f"{identifier(source.stem)}_look.usda"
    fields = fields_for(finished.manifest, chosen.target)
    variant = identifier(fields["style"]) + (f"_v{chosen.version:03}" if chosen.version is not None else "")
    before = (out / layer).read_text(encoding="utf-8") if (out / layer).is_file() else None
    asset = replace(asset, source=replace(asset.source, path=real_path(source)))
    write_look(folder / layer, before, asset, looks, variant, beside=real_path(out))
    return [layer]
