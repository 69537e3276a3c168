"""`mistyle fit --scene`: texture parameters of any Mitsuba scene, fitted to a picture per sensor.

OUT/scene/<scene>.xml and its textures   the user's own file with the fitted elements replaced
OUT/pictures/<sensor>.exr and .png        the fitted scene from every sensor
OUT/report/index.html, OUT/run.json
"""

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from mistyle.core import stopping
from mistyle.core.errors import InputRefused, UsageError
from mistyle.core.image import linear_from_srgb
from mistyle.core.names import asset_name
from mistyle.files.keeper import Keeper
from mistyle.files.output import claim, keep_folder
from mistyle.files.store import atomic_write, digest
from mistyle.run import checkpoint
from mistyle.run.charts import Chart
from mistyle.run.material_report import difference, encoded
from mistyle.run.progress import Progress
from mistyle.run.report import Figure, Note, Pair, Report, Shot, Step, write_report
from mistyle.run.stages import program
from mistyle.run.summary import peak_gb, versions, write_record

PICTURES = (".exr", ".png", ".tif", ".tiff", ".jpg", ".jpeg", ".webp")
FOLDERS = ("scene", "pictures", "report", "work")
ITERATIONS = {"draft": 64, "standard": 256}


def run_scene(options: argparse.Namespace) -> int:
    """The whole verb: list, or fit and write."""
    from mistyle.render import device
    from mistyle.render.scene_keys import choose, parameters
    from mistyle.render.scene_xml import load_scene_for_fit

    if not options.scene.is_file():
        raise InputRefused(f"{options.scene}: found nothing, expected a Mitsuba scene file; check the path")
    if options.out is not None and not options.list:
        inputs = [path for path in (options.scene, options.shots) if path is not None]
        claim(options.out, ["run.json"], FOLDERS, inputs, aside=True, overwrite=options.overwrite)
    device.use(options.variant, options.threads)
    file = load_scene_for_fit(options.scene, _defines(options.defines))
    listed = parameters(file.scene)
    if options.list:
        print(json.dumps([_row(p) for p in listed]) if options.json else describe(listed))
        return 0
    missing = [n for n, v in (("--references DIR", options.shots), ("-o OUT", options.out)) if v is None]
    if missing:
        raise UsageError(f"fit --scene needs {' and '.join(missing)}; --list shows what can be fitted")
    chosen = choose(listed, options.optimize)
    every = file.scene.sensors()
    if options.sensor is not None and not 0 <= options.sensor < len(every):
        raise UsageError(f"-s {options.sensor}: the scene has {len(every)} sensor(s), numbered from 0")
    numbers = list(range(len(every))) if options.sensor is None else [options.sensor]
    paths = reference_files(options.shots, [every[k].id() for k in numbers], len(every), numbers)
    progress = Progress()
    with Keeper(options.out, progress.note, overwrite=options.overwrite) as keeper, Keeper(options.out / "work"):
        keep_folder(options.out, "work")
        summary = _fit(options, keeper, file, [p.key for p in chosen], numbers, paths, progress)
    if options.json:
        print(json.dumps(summary))
    else:
        for label in ("scene", "pictures", "report"):
            print(f"{label:<9} {summary[label]}", file=sys.stderr)
    progress.tell_notes()
    return 0


def _fit(
    options: argparse.Namespace,
    keeper: Keeper,
    file: Any,
    keys: Sequence[str],
    numbers: Sequence[int],
    paths: Sequence[Path],
    progress: Progress,
) -> dict[str, Any]:
    from mistyle.files.images import write_exr
    from mistyle.render.scene_draw import values
    from mistyle.render.scene_fit import fit_scene
    from mistyle.render.scene_xml import write_scene

    name = asset_name(options.name, options.scene.stem)
    read = [read_reference(path) for path in paths]
    iterations = options.iterations or ITERATIONS[options.preset or "standard"]
    seed = options.seed or 0
    inputs = [sorted(file.defines.items()), list(keys), list(numbers), list(paths), iterations, seed, options.threads]
    key = digest([program(), values(file.scene), *inputs])
    folder = checkpoint.place(options.out, key)
    with progress.stage("fit", "fit the scene") as report, stopping.at_checkpoints():
        fitted = fit_scene(
            file.scene,
            keys,
            list(numbers),
            [rgb for rgb, _ in read],
            masks=[mask for _, mask in read],
            iterations=iterations,
            seed=seed,
            save=lambda arrays: checkpoint.save(folder, arrays),
            resume=checkpoint.load(folder, progress.note),
            progress=report,
        )
    written: list[Any] = []
    with progress.stage("scene", "write the scene"):
        keeper.put(
            "scene",
            key,
            lambda new: written.append(write_scene(new / f"{name}.xml", file, fitted, write_exr, atomic_write)),
        )
    with progress.stage("pictures", "render the sensors") as report:
        drawn = draw(file.scene, numbers, seed, report)
        keeper.put("pictures", key, lambda new: write_pictures(new, file.scene, numbers, drawn))
    xml = written[0].xml
    progress.note(*file.notes, *fitted.notes, *written[0].notes)
    summary = {
        "name": name,
        "scene": str(options.out / "scene" / xml.name) if xml is not None else str(options.out / "scene"),
        "pictures": str(options.out / "pictures"),
        "report": str(options.out / "report" / "index.html"),
        "fitted": [p.name for p in fitted.parameters],
        "seconds": {k: round(v, 3) for k, v in progress.seconds.items()},
        "peak_gb": peak_gb(),
        "figures": figures(fitted),
        "notes": list(progress.notes),
    }
    names = [every_name(file.scene, k) for k in numbers]
    keeper.put("report", key, lambda new: write_page(new, options, fitted, read, drawn, names, summary, seed))
    write_record(options, summary | {"iterations": iterations, "seed": seed, "versions": versions()}, progress)
    checkpoint.clear(options.out)
    return summary


def _defines(pairs: Sequence[str]) -> dict[str, str]:
    result = {}
    for pair in pairs:
        name, equals, value = pair.partition("=")
        if not equals or not name:
            raise UsageError(f"-D {pair}: expected NAME=VALUE, as the mitsuba command has it")
        result[name] = value
    return result


def describe(listed: Sequence[Any]) -> str:
    """The parameters as a table for people: what can be fitted first, then why the rest cannot."""
    free = [p for p in listed if p.reason is None]
    fixed = [p for p in listed if p.reason is not None and p.kind not in ("geometry", "other")]
    wide = max((len(p.name) for p in free), default=0)
    lines = ["can be fitted:"] if free else ["nothing in this scene can be fitted"]
    for p in free:
        size = "x".join(map(str, p.shape)) or "1"
        lines.append(f"  {p.name:<{wide}}  {p.kind:<9} {size:<12} {p.owner}" + "".join(f"; {n}" for n in p.notes))
    if fixed:
        lines.append("cannot:")
        lines += [f"  {p.name}: {p.reason}" for p in fixed]
    return "\n".join(lines)


def _row(p: Any) -> dict[str, Any]:
    return {
        "name": p.name,
        "key": p.key,
        "kind": p.kind,
        "shape": list(p.shape),
        "storage": p.storage,
        "owner": p.owner,
        "reason": p.reason,
    }


def reference_files(folder: Path, names: Sequence[str], sensors: int, numbers: Sequence[int]) -> list[Path]:
    """The picture of each sensor: the file called like its id, else the pictures in order where there is one each."""
    if not folder.is_dir():
        raise InputRefused(f"{folder}: found no folder, expected one with a picture for each sensor; check the path")
    files = sorted(p for p in folder.iterdir() if p.suffix.lower() in PICTURES)
    by_name = {p.stem: p for p in reversed(files)}
    if all(name in by_name for name in names):
        return [by_name[name] for name in names]
    if len(files) == sensors:
        return [files[k] for k in numbers]
    if len(files) == len(names):
        return files
    raise InputRefused(
        f"{folder}: found {len(files)} pictures for {len(names)} sensor(s) ({', '.join(names[:4])}, ...); expected one "
        "called like each sensor's id, or as many as sensors, in their order"
    )


def read_reference(path: Path) -> tuple[Float[np.ndarray, "h w 3"], np.ndarray]:
    """Linear radiance and which pixels count: finite, and in encoded pictures not saturated."""
    from mistyle.files.read import read_exr, read_picture

    if path.suffix.lower() == ".exr":
        planes = read_exr(path)
        if not {"R", "G", "B"} <= set(planes):
            raise InputRefused(f"{path}: found channels {', '.join(sorted(planes))[:200]}, expected R, G and B")
        rgb = np.stack([planes[c] for c in "RGB"], axis=-1)
        counts = np.isfinite(rgb).all(axis=-1)
        return np.where(np.asarray(counts)[..., None], rgb, 0).astype(np.float32), np.asarray(counts)
    picture = read_picture(path)
    counts = (picture.rgb < 1).all(axis=-1)
    return linear_from_srgb(picture.rgb).astype(np.float32), np.asarray(counts)


def draw(scene: Any, numbers: Sequence[int], seed: int, report: Any, spp: int = 64) -> list[Float[np.ndarray, "h w 3"]]:
    """The scene as it is now from its sensors, linear."""
    from mistyle.render.scene_draw import sensor_picture

    result = []
    for k in numbers:
        result.append(sensor_picture(scene, k, spp, seed))
        report(len(result) / len(numbers))
    return result


def every_name(scene: Any, k: int) -> str:
    """A sensor's id; Mitsuba's made-up ones become numbers."""
    name = scene.sensors()[k].id()
    return f"sensor{k}" if not name or name.startswith(("__", "object_")) else name


def write_pictures(folder: Path, scene: Any, numbers: Sequence[int], drawn: Sequence[np.ndarray]) -> None:
    from mistyle.core.image import srgb_from_linear
    from mistyle.files.images import write_exr, write_png

    for k, picture in zip(numbers, drawn, strict=True):
        name = every_name(scene, k)
        write_exr(folder / f"{name}.exr", dict(zip("RGB", np.moveaxis(picture, -1, 0), strict=True)))
        write_png(folder / f"{name}.png", np.clip(srgb_from_linear(np.nan_to_num(picture)), 0, 1))


def figures(fitted: Any) -> dict[str, float]:
    before, after = (np.mean([r.psnr[k] for r in fitted.residuals]) for k in (0, 1))
    return {"psnr_before": float(before), "psnr_after": float(after), "bad_gradients": float(len(fitted.bad))}


MEANINGS: dict[str, tuple[str, Literal["higher", "lower", ""]]] = {
    "psnr_before": ("mean PSNR of the sensors' pictures before the fit (sRGB, peak 1), dB", "higher"),
    "psnr_after": ("mean PSNR of the sensors' pictures after the fit (sRGB, peak 1), dB", "higher"),
    "bad_gradients": ("gradients that were no numbers; their texels stayed as they were in that step", "lower"),
}


def write_page(folder: Path, options, fitted, read, drawn, names, summary: dict[str, Any], seed: int) -> None:
    """The report: predictions beside references, the loss, what was fitted."""
    pairs, errors = [], []
    for (rgb, _), picture, name, residual in zip(read, drawn, names, fitted.residuals, strict=True):
        said = f"{name}: {residual.psnr[0]:.1f} dB → {residual.psnr[1]:.1f} dB"
        pairs.append(Pair(Shot(encoded(rgb, rgb), "reference"), Shot(encoded(picture, rgb), "fitted"), said))
        errors.append(Shot(difference(rgb, picture), f"{name}: error", "ten times as bright"))
    textures = tuple(
        Shot(np.clip(values if values.ndim == 3 else values[..., None], 0, 1), p.name)
        for p in fitted.parameters
        if (values := fitted.values[p.key]).ndim == 3 and values.shape[2] in (1, 3)
    )
    first = encoded(read[0][0], read[0][0])
    page = Report(
        title=summary["name"],
        mesh=options.scene.name,
        style=f"{len(read)} pictures of {options.shots.name}",
        relation="fitted to",
        painting=Shot(first, f"A reference: {names[0]}"),
        turntable=(encoded(drawn[0], read[0][0]),),
        made=f"mistyle {versions()['mistyle']}, seed {seed}",
        facts=(("parameters", str(len(fitted.parameters))), ("sensors", str(len(read)))),
        notes=tuple(Note(text) for text in summary["notes"]),
        steps=(
            Step("References and predictions", pairs=tuple(pairs[:16]), shots=tuple(errors[:16])),
            Step("Convergence", charts=(Chart("loss", {"loss": fitted.trace}, x_label="step", log=True),)),
            Step("Fitted textures", "As stored: data, not colour-converted.", shots=textures, columns=3),
        ),
        figures=tuple(Figure(k, f"{v:.4g}", *MEANINGS[k]) for k, v in summary["figures"].items()),
        versions=tuple(versions().items()),
    )
    write_report(folder / "index.html", page)
