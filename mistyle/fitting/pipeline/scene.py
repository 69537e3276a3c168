"""`mistyle fit --scene`: parameters of any Mitsuba scene, fitted to a picture per sensor.

OUT/scene/<scene>.xml and its textures   the user's own file with the fitted elements replaced
OUT/pictures/<sensor>.exr and .png        the fitted scene from every sensor
OUT/report/index.html, OUT/run.json       with every value before and after
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from mistyle.core.errors import InputRefused, UsageError
from mistyle.fitting.pipeline.scene_references import read_reference, reference_files
from mistyle.fitting.report.scene import changes, figures, noise_text, write_page
from mistyle.fitting.settings.scene import SceneSettings
from mistyle.io.store.atomic import atomic_write, digest
from mistyle.io.store.keeper import Keeper
from mistyle.io.store.output import claim, keep_folder
from mistyle.jobs import checkpoint
from mistyle.jobs.progress import Progress
from mistyle.jobs.run_record import write_record
from mistyle.jobs.stages import program
from mistyle.jobs.start import start_engines
from mistyle.jobs.versions import peak_gb, versions
from mistyle.process import stopping

FOLDERS = ("scene", "pictures", "report", "work")
DRAWN_SPP = 64


@dataclass(frozen=True)
class SceneJob:
    """One fit: a scene file with its defines, the folder of its references, the parameters to fit, and settings.

    sensor  index of the only sensor to fit to; None: all
    """

    scene: Path
    references: Path
    out: Path
    optimize: tuple[str, ...]
    settings: SceneSettings
    name: str
    defines: Mapping[str, str]
    sensor: int | None = None
    overwrite: bool = False


def loaded(scene: Path, defines: Mapping[str, str], settings: SceneSettings) -> Any:
    """The scene file, ready for a fit (`SceneFile`)."""
    from mistyle.render.live.xml import load_scene_for_fit

    if not scene.is_file():
        raise InputRefused(f"{scene}: found nothing, expected a Mitsuba scene file; check the path")
    start_engines(settings)
    return load_scene_for_fit(scene, defines)


def listed(file: Any) -> list[Any]:
    """Every parameter of a loaded scene, under the integrator of the fit."""
    from mistyle.render.live.parameters import parameters
    from mistyle.solver.scene.gradients import ad_integrator

    return parameters(file.scene, ad_integrator(file.scene)[0])


def fit_scene(job: SceneJob, progress: Progress) -> dict[str, Any]:
    """Fit and write; returns the summary."""
    from mistyle.render.live.parameters import choose

    inputs = (job.scene, job.references)
    claim(job.out, ["run.json"], FOLDERS, inputs, aside=True, overwrite=job.overwrite)
    file = loaded(job.scene, job.defines, job.settings)
    chosen = choose(listed(file), job.optimize)
    every = file.scene.sensors()
    if job.sensor is not None and not 0 <= job.sensor < len(every):
        raise UsageError(f"-s {job.sensor}: the scene has {len(every)} sensor(s), numbered from 0")
    numbers = list(range(len(every))) if job.sensor is None else [job.sensor]
    paths = reference_files(job.references, [every[k].id() for k in numbers], len(every), numbers)
    with Keeper(job.out, progress.note, overwrite=job.overwrite) as keeper, Keeper(job.out / "work"):
        keep_folder(job.out, "work")
        return _fit(job, keeper, file, [p.key for p in chosen], numbers, paths, progress)


def _fit(
    job: SceneJob,
    keeper: Keeper,
    file: Any,
    keys: Sequence[str],
    numbers: Sequence[int],
    paths: Sequence[Path],
    progress: Progress,
) -> dict[str, Any]:
    from mistyle.io.images.write import write_exr
    from mistyle.render.live.draw import values
    from mistyle.render.live.xml import write_scene

    read = [read_reference(path, job.settings.channels) for path in paths]
    progress.note(*file.notes, *(note for _, _, notes in read for note in notes))
    settings = job.settings.model_dump(mode="json")
    inputs = [sorted(file.defines.items()), list(keys), list(numbers), list(paths), settings]
    key = digest([program(), values(file.scene), *inputs])
    fitted = _run_fit(job, file, keys, numbers, read, key, progress)
    written: list[Any] = []
    with progress.stage("scene", "write the scene"):
        keeper.put(
            "scene",
            key,
            lambda new: written.append(write_scene(new / f"{job.name}.xml", file, fitted, write_exr, atomic_write)),
        )
    with progress.stage("pictures", "render the sensors") as report:
        drawn = draw(file.scene, numbers, job.settings.seed, report)
        keeper.put("pictures", key, lambda new: write_pictures(new, file.scene, numbers, drawn))
    xml = written[0].xml
    progress.note(*fitted.notes, noise_text(fitted), *written[0].notes)
    summary = {
        "name": job.name,
        "scene": str(job.out / "scene" / xml.name) if xml is not None else None,
        "pictures": str(job.out / "pictures"),
        "report": str(job.out / "report" / "index.html"),
        "fitted": [p.name for p in fitted.parameters],
        "values": changes(fitted),
        "unconverged": list(fitted.unconverged),
        "undone": fitted.undone,
        "seconds": {k: round(v, 3) for k, v in progress.seconds.items()},
        "peak_gb": peak_gb(),
        "figures": figures(fitted),
        "notes": list(progress.notes),
        "settings": job.settings.model_dump(mode="json"),
    }
    shown = [
        (sensor_name(file.scene, k), rgb, picture) for k, (rgb, _, _), picture in zip(numbers, read, drawn, strict=True)
    ]
    arguments = (job.scene.name, job.references.name, fitted, shown, summary)
    keeper.put("report", key, lambda new: write_page(new / "index.html", *arguments))
    record = summary | {"iterations": job.settings.iterations, "seed": job.settings.seed, "versions": versions()}
    write_record(job, record, progress)
    checkpoint.clear(job.out)
    return summary


def _run_fit(job: SceneJob, file: Any, keys, numbers, read, key: str, progress: Progress) -> Any:
    """Run the fit, with checkpoints in the run folder."""
    from mistyle.solver.scene.fit import fit_scene as run

    settings = job.settings
    folder = checkpoint.place(job.out, key)
    with progress.stage("fit", "fit the scene") as report, stopping.at_checkpoints():
        return run(
            file.scene,
            keys,
            list(numbers),
            [rgb for rgb, _, _ in read],
            masks=[mask for _, mask, _ in read],
            iterations=settings.iterations,
            loss=None if settings.loss == "auto" else settings.loss,
            spp=settings.spp,
            spp_grad=settings.spp_grad or None,
            seed=settings.seed,
            save=lambda arrays: checkpoint.save(folder, arrays),
            resume=checkpoint.load(folder, progress.note),
            progress=report,
        )


def describe(listed_parameters: Sequence[Any]) -> str:
    """The parameters as a text table: first those that can be fitted, then the others with the reason."""
    free = [p for p in listed_parameters if p.reason is None]
    fixed = [p for p in listed_parameters if p.reason is not None and p.kind not in ("geometry", "other")]
    wide = max((len(p.name) for p in free), default=0)
    lines = ["can be fitted:"] if free else ["nothing in this scene can be fitted"]
    for p in free:
        size = "x".join(map(str, p.shape)) or "1"
        lines.append(f"  {p.name:<{wide}}  {p.kind:<9} {size:<12} {p.owner}" + "".join(f"; {n}" for n in p.notes))
    if fixed:
        lines.append("cannot:")
        lines += [f"  {p.name}: {p.reason}" for p in fixed]
    return "\n".join(lines)


def list_row(p: Any) -> dict[str, Any]:
    names = ("name", "key", "kind", "storage", "owner", "reason")
    return {name: getattr(p, name) for name in names} | {"shape": list(p.shape)}


def draw(scene: Any, numbers: Sequence[int], seed: int, report: Any) -> list[Float[np.ndarray, "h w 3"]]:
    """The current scene from its sensors, linear, by the integrator of the fit."""
    from mistyle.render.live.draw import sensor_picture
    from mistyle.solver.scene.gradients import ad_integrator

    result = []
    for k in numbers:
        result.append(sensor_picture(scene, k, DRAWN_SPP, seed, ad_integrator(scene)[0]))
        report(len(result) / len(numbers))
    return result


def sensor_name(scene: Any, k: int) -> str:
    """A sensor's id; a generated id becomes `sensor<k>`."""
    name = scene.sensors()[k].id()
    return f"sensor{k}" if not name or name.startswith(("__", "object_")) else name


def write_pictures(folder: Path, scene: Any, numbers: Sequence[int], drawn: Sequence[np.ndarray]) -> None:
    from mistyle.core.image import srgb_from_linear
    from mistyle.io.images.write import write_exr, write_png

    for k, picture in zip(numbers, drawn, strict=True):
        name = sensor_name(scene, k)
        write_exr(folder / f"{name}.exr", dict(zip("RGB", np.moveaxis(picture, -1, 0), strict=True)))
        write_png(folder / f"{name}.png", np.clip(srgb_from_linear(np.nan_to_num(picture)), 0, 1))
