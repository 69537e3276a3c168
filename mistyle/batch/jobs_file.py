"""Jobs files of a batch: a list, a grid or a folder, resolved to records that are checked before any job runs.

    # jobs.toml (or .yaml with the same keys); paths, also those in settings, are relative to the file
    preset = "draft"                       # default of every job
    settings = { "report.frames" = 12 }

    [[job]]                                # one line each ...
    mesh = "spot.obj"
    style = "great_wave.jpg"

    [[job]]                                # ... or a fit to pictures
    mesh = "chair.glb"
    references = "photographs/"

    [[grid]]                               # every mesh with every style with every variant
    meshes = ["props/*.glb"]
    styles = ["starry_night.jpg", "woodcut.jpg"]
    variants = [{ seed = 0 }, { seed = 1 }]

A folder is a grid of the meshes and the pictures in it: folder_jobs.py. Names of jobs without `name`: names.py.
"""

import itertools
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, get_args

from pydantic import BaseModel, Field

from mistyle.batch.folder_jobs import folder_jobs
from mistyle.batch.names import Before, JobSource, job_names, why_not
from mistyle.core.errors import InputRefused, MistyleError, UsageError
from mistyle.core.names import folded
from mistyle.core.settings import FrozenModel
from mistyle.io.read_mesh import MESHES
from mistyle.jobs.inputs import input_files
from mistyle.jobs.settings import merge, validate

MOST_JOBS = 100_000
MOST_LISTED = 20


class BatchJob(FrozenModel):
    """One job of a jobs file: a mesh with a style picture, or with references for a fit."""

    mesh: Path
    style: Path | None = None
    references: Path | None = None
    lights: str | None = None
    """lights of a fit: a lights.json, or 'unknown'"""
    masks: Path | None = None
    exposure: Path | None = None
    name: str | None = None
    """name of the asset and of the job's folder"""
    preset: str | None = None
    settings: dict[str, Any] = {}
    """nested, or with dotted names as for --set"""


class Grid(FrozenModel):
    """Every mesh with every style, preset and variant."""

    meshes: list[str] = Field(min_length=1)
    styles: list[str] = Field(min_length=1)
    presets: list[str] = []
    variants: list[dict[str, Any]] = []


class JobsFile(FrozenModel):
    """A jobs file; `preset` and `settings` are the defaults of every job."""

    preset: str = "standard"
    settings: dict[str, Any] = {}
    job: list[BatchJob] = []
    grid: list[Grid] = []


Kind = Literal["stylize", "fit"]


class Record(FrozenModel):
    """One resolved job for `mistyle shard`. Paths are absolute, settings complete."""

    name: str
    kind: Kind
    mesh: Path
    style: Path | None = None
    references: Path | None = None
    lights: str | None = None
    masks: Path | None = None
    exposure: Path | None = None
    settings: dict[str, Any]


def read_jobs(path: Path, threads: int, before: Before | None = None) -> tuple[Record, ...]:
    """Every job of a jobs file or a folder; see `read_file` and `resolve`."""
    return resolve(read_file(path)[0], path, threads, before)


def read_file(path: Path) -> tuple[JobsFile, tuple[str, ...]]:
    """A jobs file as it stands, or a folder as one, with sentences on what of the folder is left out.

    Raises UsageError or InputRefused.
    """
    if not path.is_dir():
        return _file_jobs(path), ()
    found = folder_jobs(path)
    meshes, styles = ([str(p.relative_to(path)) for p in paths] for paths in (found.meshes, found.styles))
    return JobsFile(grid=[Grid(meshes=meshes, styles=styles)]), found.left_out


def resolve(file: JobsFile, path: Path, threads: int, before: Before | None = None) -> tuple[Record, ...]:
    """Every job of the jobs file or folder `path`, checked before any job runs; one error lists all refused jobs.

    `threads` is the default of each job's settings. Jobs of the plan `before` keep their names. Raises UsageError or
    InputRefused.
    """
    # Absolute, so that all paths below it are absolute and joining them again changes nothing.
    base = (path if path.is_dir() else path.parent).absolute()
    listed = [(job, _source(job, base)) for job in file.job]
    listed += itertools.chain.from_iterable(_grid_jobs(grid, base, str(path)) for grid in file.grid)
    if not listed:
        raise UsageError(
            f"{path}: found no job; expected [[job]] or [[grid]] entries, or a folder of meshes and pictures"
        )
    if len(listed) > MOST_JOBS:
        raise UsageError(f"{path}: found {len(listed)} jobs; expected {MOST_JOBS} at most. Split the file.")
    records, refusals, code = [], [], UsageError
    names = job_names([source for _, source in listed], base, before)
    known = {folded(name) for name in names}
    for (job, _), name in zip(listed, names, strict=True):
        try:
            if reason := why_not(name, known):
                raise UsageError(reason)
            records.append(_record(job, name, file, base, threads))
        except MistyleError as error:
            refusals.append(f"{name}: {error}")
            code = InputRefused if isinstance(error, InputRefused) else code
    if refusals:
        more = f"\n  and {len(refusals) - MOST_LISTED} more" if len(refusals) > MOST_LISTED else ""
        raise code(
            f"{path}: {len(refusals)} of {len(listed)} jobs cannot run; nothing was started\n  "
            + "\n  ".join(refusals[:MOST_LISTED])
            + more
        )
    return tuple(records)


def _file_jobs(path: Path) -> JobsFile:
    from mistyle.io.read import read_toml, read_yaml

    if not path.is_file():
        raise InputRefused(f"{path}: found nothing, expected a jobs file (.toml, .yaml) or a folder")
    try:
        values = (read_yaml if path.suffix.lower() in (".yaml", ".yml") else read_toml)(path)
    except InputRefused as error:
        raise UsageError(f"{path}: cannot be read: {error}") from None
    if not isinstance(values, dict):
        raise UsageError(f"{path}: found a {type(values).__name__}, expected keys such as job, grid, preset, settings")
    for key in ("job", "grid"):
        if isinstance(values.get(key), dict):  # [grid] for [[grid]]
            values[key] = [values[key]]
    return validate(values, str(path), JobsFile)


def source_of(job: Record) -> JobSource:
    """What a resolved job is named after."""
    return JobSource(job.mesh, job.style if job.style is not None else (job.references or Path()) / "fit")


def _source(job: BatchJob, base: Path, rest: tuple[str, ...] = ()) -> JobSource:
    second = job.style if job.style is not None else (job.references or Path()) / "fit"
    return JobSource(base / job.mesh, base / second, rest, job.name)


def _grid_jobs(grid: Grid, base: Path, origin: str) -> list[tuple[BatchJob, JobSource]]:
    """The jobs of a grid, meshes first."""
    meshes, styles = _expanded(grid.meshes, base, origin), _expanded(grid.styles, base, origin)
    result = []
    for mesh, style in itertools.product(meshes, styles):
        for preset in grid.presets or [None]:
            for k, variant in enumerate(grid.variants or [{}]):
                rest = (preset,) if preset is not None and len(grid.presets) > 1 else ()
                rest += (f"v{k}",) if len(grid.variants) > 1 else ()
                job = BatchJob(mesh=mesh, style=style, preset=preset, settings=variant)
                result.append((job, _source(job, base, rest)))
    return result


def _expanded(patterns: Sequence[str], base: Path, origin: str) -> list[Path]:
    paths: list[Path] = []
    for pattern in patterns:
        # A file may have brackets in its name: what exists is that file.
        if any(c in pattern for c in "*?[") and not os.path.isfile(base / pattern):
            place = Path(pattern)
            root, inner = (
                (Path(place.anchor), place.relative_to(place.anchor)) if place.is_absolute() else (base, place)
            )
            try:
                matches = sorted(p for p in root.glob(str(inner)) if p.is_file())
            except (ValueError, NotImplementedError, OSError) as error:
                raise InputRefused(f"{origin}: '{pattern[:200]}' is not a pattern of file names ({error})") from None
            if not matches:
                raise InputRefused(f"{origin}: '{pattern}' matches no file in {base}; check the pattern")
            paths += matches
        else:
            paths.append(base / pattern)
    return list(dict.fromkeys(paths))


def _record(job: BatchJob, name: str, file: JobsFile, base: Path, threads: int) -> Record:
    if (job.style is None) == (job.references is None):
        raise UsageError("expected either a style (stylize) or references (fit), found " + _both_or_neither(job))
    if job.style is not None and (job.lights or job.masks or job.exposure):
        raise UsageError("lights, masks and exposure belong to a fit to references; this job has a style")

    def placed(path: Path | None) -> Path | None:
        return None if path is None else base / path

    mesh, style, references = placed(job.mesh), placed(job.style), placed(job.references)
    assert mesh is not None
    input_files(mesh)
    if mesh.suffix.lower() not in MESHES:
        raise InputRefused(f"{mesh}: found a {mesh.suffix or 'file without suffix'}, expected {' '.join(MESHES)}")
    if style is not None and not style.is_file():
        raise InputRefused(f"{style}: found nothing, expected a picture; check the path")
    if references is not None and not references.is_dir():
        raise InputRefused(f"{references}: found no folder, expected one with cameras and pictures; check the path")
    lights = job.lights if job.lights in (None, "unknown") else str(placed(Path(job.lights)))
    chosen = merge(nested(file.settings), nested(job.settings))
    kind: Kind = "stylize" if style is not None else "fit"
    return Record(
        name=name,
        kind=kind,
        mesh=mesh,
        style=style,
        references=references,
        lights=lights,
        masks=placed(job.masks),
        exposure=placed(job.exposure),
        settings=resolved(kind, job.preset or file.preset, chosen, threads, base),
    )


def _both_or_neither(job: BatchJob) -> str:
    return "both" if job.style is not None else "neither"


def nested(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Settings with dotted names as nested dictionaries."""
    result: dict[str, Any] = {}
    for key, value in settings.items():
        leaf: Any = nested(value) if isinstance(value, Mapping) else value
        for name in reversed(key.split(".")):
            leaf = {name: leaf}
        result = merge(result, leaf)
    return result


def resolved(kind: Kind, preset: str, chosen: Mapping[str, Any], threads: int, base: Path) -> dict[str, Any]:
    """All settings of a job as JSON values, with `threads` as the default.

    Files in `chosen` are relative to `base`, those of the environment to the working folder; all become absolute.
    """
    from mistyle.jobs.settings import resolve

    root: type[BaseModel]
    if kind == "fit":
        from mistyle.fitting.settings.material import MATERIAL_PRESETS, MaterialSettings

        root, presets = MaterialSettings, MATERIAL_PRESETS
    else:
        from mistyle.stylization.settings import PRESETS, Settings

        root, presets = Settings, PRESETS
    settings = resolve(preset, None, placed_files(chosen, root, base), root=root, presets=presets)
    values = placed_files(settings.model_dump(mode="json"), root, Path.cwd())
    return values | {"threads": values["threads"] or threads}


def placed_files(values: Mapping[str, Any], model: type[BaseModel], base: Path) -> dict[str, Any]:
    """Settings of `model` with their relative files joined to `base`; absolute ones stay.

    In a style slot (SLOT=PICTURE) the picture is a file, and SLOT is one if `base` has a file of that name.
    """
    result = dict(values)
    for name, field in model.model_fields.items():
        value, kind = result.get(name), field.annotation
        if isinstance(value, Mapping) and isinstance(kind, type) and issubclass(kind, BaseModel):
            result[name] = placed_files(value, kind, base)
        elif isinstance(value, str) and (Path in (kind, *get_args(kind)) or name == "config" and "://" not in value):
            result[name] = str(base / value)  # colour.config is a file or a config's ocio:// name
        elif name == "slots" and isinstance(value, (list, tuple)):
            result[name] = [_placed_slot(slot, base) for slot in value]
    return result


def _placed_slot(slot: Any, base: Path) -> Any:
    slot_name, equals, picture = str(slot).rpartition("=")
    if not equals or not slot_name or not picture:
        return slot  # refused with the job's other settings
    mask = base / slot_name
    return f"{mask if mask.is_file() else slot_name}={base / picture}"
