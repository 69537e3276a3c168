"""`mistyle export`, and the last step of every job: a finished asset in the formats of other programs.

OUT/<name>.glb .usda .usdz .mtlx .obj/.mtl         the requested formats
OUT/<mesh>_look.usda                               instead of .usda and .usdz, where the mesh came as USD
OUT/textures/<name>_<map>[.<udim>].<ext>           packed for the target
OUT/<name>.export.json                             every file with sha256, colour space and channels

Deliveries of several names share the folder; a new delivery of the same name replaces only its own files. The folder's
lock admits one export at a time, so that no two take the same version or mix their files.
"""

import json
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mistyle.core.errors import UsageError
from mistyle.core.names import ASSET, FILE_NAME, folded, safe_name, shortened
from mistyle.deliver.colour import key_of, light_space, picture_space
from mistyle.deliver.exclusive import hold
from mistyle.deliver.files import Delivery, fields_for, write_delivery
from mistyle.deliver.read_asset import FinishedAsset, read_finished, read_listing
from mistyle.io.images.packing import TARGETS
from mistyle.io.sandbox.bounds import USD
from mistyle.io.store.atomic import LOCK, atomic_write, digest, sha256_file
from mistyle.io.store.output import claim, keep_folder, read_written, real, replace_files
from mistyle.io.store.trusted_json import read_own
from mistyle.jobs.deliver_settings import FORMATS, TEXTURES, ColourSettings, checked_name, checked_textures, fields_of
from mistyle.jobs.stages import program


@dataclass(frozen=True)
class DeliveryRequest:
    """One delivery to a target.

    name             pattern of the delivered name: {asset} {mesh} {style} {target}, and {v}, one more than the highest
                     version in the folder; the latest version stays for the same asset, settings and program
    names            pattern of texture files: {asset} (the delivered name), {map}, {ext}, and {udim} for tiles
    metres_per_unit  metresPerUnit of USD
    source           path of the mesh file of a USD look, if it was moved
    """

    formats: Sequence[str]
    target: str = "blender"
    name: str = "{asset}"
    names: str = TEXTURES
    metres_per_unit: float = 1.0
    colour: ColourSettings = ColourSettings()
    source: Path | None = None


def export(
    place: Path,
    out: Path,
    request: DeliveryRequest,
    *,
    overwrite: bool = False,
    note: Callable[..., None] = lambda *sentences: None,
    say: Callable[[str], None] = lambda text: None,
) -> list[Path]:
    """Deliver the asset at `place` into the folder `out`; returns the delivery's files.

    `note` receives notes about the files, `say` a sentence where another export must be waited for. UsageError for an
    unknown format, target or name pattern.
    """
    _check_request(request)
    formats, target, source = tuple(request.formats), request.target, request.source
    folder, manifest = read_listing(place)
    files = [p for p in sorted(folder.rglob("*")) if p.is_file() and p.name != "done.json"]
    of = digest(
        [
            program(),
            files,
            list(formats),
            target,
            request.names,
            request.metres_per_unit,
            key_of(request.colour),
            source,
        ]
    )
    fields, space = fields_for(manifest, target), light_space(request.colour)
    inputs = [place, folder, *([source] if source else [])]
    called, version = _versioned_name(out, request.name, fields, of)
    if not _is_current(out, called, of):
        claim(out, named_files(formats, called), inputs=inputs, overwrite=overwrite)
        with hold(real(out) / LOCK, say):
            # Another export may have taken the name while this one waited.
            called, version = _versioned_name(out, request.name, fields, of)
            if not _is_current(out, called, of):
                claim(out, named_files(formats, called), inputs=inputs, overwrite=overwrite)
                chosen = Delivery(
                    formats, target, called, version, request.names, request.metres_per_unit, space, source
                )
                finished = read_finished(place)
                replace_files(
                    out, f"export {called}", lambda new: _deliver(new, out, finished, chosen, of), inputs=inputs,
                    overwrite=overwrite, lasting=lambda name: name.endswith("_look.usda"),
                )  # fmt: skip
    record = read_own(out / f"{called}.export.json")
    note(*record.get("notes", ()))
    return sorted([out / f"{called}.export.json", *(out / str(e["file"]) for e in record["files"])])


def _check_request(request: DeliveryRequest) -> None:
    unknown = [f for f in request.formats if f not in FORMATS]
    if unknown or request.target not in TARGETS:
        offered = f"formats {', '.join(FORMATS)}; targets {', '.join(TARGETS)}"
        raise UsageError(f"'{unknown[0] if unknown else request.target}' cannot be written; expected {offered}")
    try:
        checked_name(request.name)
        checked_textures(request.names)
    except ValueError as error:
        raise UsageError(str(error)) from None


def _versioned_name(out: Path, pattern: str, fields: Mapping[str, str], of: str) -> tuple[str, int | None]:
    """The name, and its version where the pattern has one: the latest for an equal delivery, else the next."""

    most = 9999  # the longest version
    plain = {field: safe_name(text, FILE_NAME) for field, text in fields.items()}
    short = shortened(pattern, plain | {"v": most}, ("asset", "mesh", "style"), ASSET)

    def filled(v: object) -> str:
        return safe_name(pattern.format(**short | {"v": v}))

    if "v" not in fields_of(pattern):
        return filled(0), None
    if len(pattern.format(**short | {"v": most}).encode()) > ASSET:
        raise UsageError(f"--name {pattern!r}: {filled(1)} is cut off before its version; choose a shorter name")
    # A placeholder marks the version while safe_name works on the rest.
    mark = "0VERSION0"
    shape = safe_name(re.sub(r"\{v[^}]*\}", mark, pattern).format(**short), FILE_NAME)
    versioned = re.compile(re.escape(shape).replace(mark, r"(\d+)", 1).replace(mark, r"\d+") + r"(?!\d)")
    matches = [versioned.match(p.name) for p in out.iterdir()] if out.is_dir() else []
    last = max((int(m[1]) for m in matches if m), default=0)
    if last and _is_current(out, filled(last), of):
        return filled(last), last
    return filled(last + 1), last + 1


def _is_current(out: Path, name: str, of: str) -> bool:
    """Whether the folder holds this very delivery with every file unchanged."""
    try:
        record = read_own(out / f"{name}.export.json")
        files = record["files"] if record["of"] == of else None
        return files is not None and all(
            (out / e["file"]).is_file() and (e.get("shared") or sha256_file(out / e["file"]) == e["sha256"])
            for e in files
        )
    except (OSError, ValueError, KeyError, TypeError):
        return False


def _deliver(new: Path, out: Path, finished: FinishedAsset, chosen: Delivery, of: str) -> None:
    """Write the delivery into `new`. UsageError where it would replace a file of another one."""
    record: dict[str, Any] = write_delivery(new, out, finished, chosen) | {"of": of}
    path = new / f"{chosen.name}.export.json"
    atomic_write(path, (json.dumps(record, indent=1) + "\n").encode())
    own = {e["file"] for e in record["files"] if not e.get("shared")}
    written = read_written(out).files
    others = {folded(file) for file, entry in written.items() if entry.by != f"export {chosen.name}"}
    colliding = sorted(file for file in own if folded(file) in others)
    if colliding:
        raise UsageError(
            f"{out}: {colliding[0]} is another delivery's file; put {{asset}} into --texture-name, or "
            "deliver into another folder"
        )


def named_files(formats: Sequence[str], name: str) -> list[str]:
    """The files of a delivery that have its name; the names of textures depend on the asset."""
    endings = {"glb": (".glb",), "usd": (".usda", ".usdz"), "mtlx": (".mtlx",), "obj": (".obj", ".mtl")}
    every = (".export.json", *(e for f in formats for e in endings.get(f, ())))
    return [f"{name}{ending}" for ending in every]


def check(settings: Any) -> None:
    """Check, before a job starts, that its delivery is possible. EnvironmentMissing, UsageError."""
    light_space(settings.colour)
    picture_space(settings.colour)
    if settings.deliver.wanted and "usd" in settings.deliver.formats:
        from mistyle.io.usd.write import library

        library()


def deliver(job: Any, progress: Any) -> dict[str, dict[str, list[str]]]:
    """Deliver a job's asset as its settings require, to OUT/delivered/<target>; {"delivered": {target: files}}."""
    chosen = job.settings.deliver
    if not chosen.wanted:
        return {}
    delivered: dict[str, list[str]] = {}
    with progress.stage("deliver", "write the files for " + ", ".join(chosen.chosen_targets)) as report:
        for target in chosen.chosen_targets:
            keep_folder(job.out, f"delivered/{target}")
            files = export(
                job.out,
                job.out / "delivered" / target,
                DeliveryRequest(
                    formats=chosen.chosen_formats,
                    target=target,
                    name=chosen.name,
                    names=chosen.textures,
                    metres_per_unit=chosen.metres_per_unit,
                    colour=job.settings.colour,
                    source=job.mesh if job.mesh.suffix.lower() in USD else None,
                ),
                overwrite=job.overwrite,
                note=progress.note,
                say=progress.say,
            )
            delivered[target] = [str(path) for path in files]
            report(len(delivered) / len(chosen.chosen_targets))
    return {"delivered": delivered}
