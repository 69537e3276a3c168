"""`mistyle converge SCENE --with A,B`: error over samples and over seconds, from independent seeds.

OUT/converge.json and .csv   every measurement; slopes, efficiency and their intervals
OUT/index.html               the same with plots
"""

import csv
import io
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from jaxtyping import Float

from mistyle.core.errors import InputRefused, UsageError
from mistyle.io.store.atomic import atomic_write
from mistyle.io.store.output import claim, replace_files
from mistyle.jobs.progress import Progress
from mistyle.jobs.report.charts import Chart
from mistyle.jobs.report.html import csp_hash, template
from mistyle.jobs.versions import versions
from mistyle.measure.pictures.metrics import definitions, measure_colour
from mistyle.measure.pictures.statistics import interval, slope
from mistyle.render.external.render_files import RenderView, Subject
from mistyle.render.external.renderers import Renderer, left_out, renderer, shots, subject

FILES = ("converge.json", "converge.csv", "index.html")
METRICS = ("relmse", "smape", "flip")
FIRST_SEED = 1_000_003  # of the reference: none of the measured renders shares its samples


@dataclass(frozen=True)
class Measurement:
    """One render: its renderer, samples per pixel, seed, wall seconds of the render call, and its errors."""

    renderer: str
    spp: int
    seed: int
    seconds: float
    values: dict[str, float]


@dataclass(frozen=True)
class Converged:
    """Statistics of one renderer. Per spp: mean and 95 % half-width of the errors and seconds. Over seeds: mean and
    half-width of the slope of log error over log samples. Per seed: log efficiency, log 1 / (relMSE · seconds)."""

    renderer: str
    spp: tuple[int, ...]
    errors: dict[str, tuple[tuple[float, float], ...]]
    seconds: tuple[tuple[float, float], ...]
    slopes: dict[str, tuple[float, float]]
    efficiency: tuple[float, ...]


@dataclass(frozen=True)
class ConvergeJob:
    """A convergence measurement: the scene, the renderers, samples and seeds, and the output folder.

    renderers      as on the command line, such as mitsuba:path
    lights         of an asset: the name of a light, or a file
    sensor         of a scene file: the number of its sensor
    defines        of a scene file: its parameters
    reference      the converged picture; None: the first renderer draws it with `reference_spp` samples per pixel
    reference_spp  0: 16 times max_spp
    threads        of blender:cycles, 0: all
    blender        the Python that has bpy
    """

    scene: Path
    renderers: tuple[str, ...]
    out: Path
    max_spp: int
    seeds: int
    size: int
    lights: str
    sensor: int
    defines: Mapping[str, str]
    reference: Path | None = None
    reference_spp: int = 0
    threads: int = 0
    blender: str | None = None
    overwrite: bool = False


def converge(job: ConvergeJob, progress: Progress) -> dict[str, Any]:
    """Measure and write; returns the content of converge.json."""
    chosen = [renderer(text, job.blender) for text in job.renderers]
    inputs = [path for path in (job.scene, job.reference) if path is not None]
    claim(job.out, FILES, inputs=inputs, overwrite=job.overwrite)
    counts = [2**k for k in range(int(math.log2(job.max_spp)) + 1)]
    with TemporaryDirectory(prefix="mistyle-") as work:
        path = _defined(job.scene, job.defines, Path(work))
        scene = subject(path, Path(work), chosen, job.threads)
        shot = shots(scene, [job.lights], 1, job.size)[job.sensor]
        reference, origin = _reference(job, scene, shot, chosen[0], progress)
        measurements, renderer_versions = measure(scene, shot, chosen, counts, job.seeds, reference, progress)
    missing = left_out(scene) if any("mitsuba" in r.kind for r in chosen) else []
    if missing:
        progress.note(f"Mitsuba does not draw {', '.join(missing)} of {job.scene.name}.")
    record = summary(measurements, [r.name for r in chosen], counts) | {
        "scene": str(job.scene),
        "defines": [f"{name}={value}" for name, value in job.defines.items()],
        "shot": shot.name,
        "reference": origin,
        "definitions": definitions_of(),
        "renderers": renderer_versions,
        "versions": versions(),
        "notes": progress.notes,
    }
    options = {"inputs": inputs, "overwrite": job.overwrite}
    replace_files(job.out, "converge", lambda folder: write(folder, record, measurements), **options)
    return record


def _defined(scene: Path, defines: Mapping[str, str], work: Path) -> Path:
    """The scene file with its defines resolved, for every renderer; `scene` itself without defines."""
    if not defines:
        return scene
    from mistyle.io.scene_source import resolved

    if scene.suffix.lower() != ".xml":
        name, value = next(iter(defines.items()))
        option = f"-D {name}={value}"
        raise UsageError(f"{option}: {scene.name} has no parameters; -D belongs to Mitsuba scene files (.xml)")
    if not scene.is_file():
        raise InputRefused(f"{scene}: found nothing; expected a Mitsuba scene file. Check the path.")
    path = work / scene.name
    path.write_bytes(resolved(scene, defines, path))
    return path


def _reference(job: ConvergeJob, scene: Subject, shot: RenderView, first: Renderer, progress: Progress):
    """The reference picture (linear), and a sentence about its origin."""
    if job.reference is not None:
        from mistyle.io.read import read_frame

        layer = read_frame(job.reference).layer("beauty")
        if layer is None:
            raise InputRefused(f"{job.reference}: found no R, G and B; expected the converged picture.")
        return layer.values(), f"{job.reference.name}, from a file"
    spp = job.reference_spp or 16 * job.max_spp
    with progress.stage("reference", f"reference: {first.name}, {spp} samples a pixel"):
        parts = max(1, spp // 1024)
        seeds = [FIRST_SEED + k for k in range(parts)]
        pictures = first.draw(scene, shot, max(1, spp // parts), seeds).pictures
    mean = np.mean(np.stack(pictures).astype(np.float64), axis=0)[..., :3].astype(np.float32)
    return mean, f"{first.name} with {spp} samples a pixel and seeds of its own"


def measure(
    scene: Subject,
    shot: RenderView,
    chosen: Sequence[Renderer],
    counts: Sequence[int],
    seeds: int,
    reference: Float[np.ndarray, "h w 3"],
    progress: Progress,
) -> tuple[list[Measurement], dict[str, str]]:
    """Every render with its errors, and each renderer's version. At every spp, a warm-up render is left out."""
    result: list[Measurement] = []
    renderer_versions: dict[str, str] = {}
    whole = np.ones(reference.shape[:2], bool)
    with progress.stage("converge", f"{len(chosen)} renderers, {counts[-1]} samples a pixel at most") as report:
        done, total = 0.0, len(chosen) * sum(counts)
        for j, engine in enumerate(chosen):
            for spp in counts:
                numbers = [1 + 1000 * j + s for s in range(seeds)]
                rendered = engine.draw(scene, shot, spp, [FIRST_SEED - 1, *numbers])
                renderer_versions[engine.name] = rendered.version
                drawn = zip(numbers, rendered.pictures[1:], rendered.seconds[1:], strict=True)
                for seed, picture, seconds in drawn:
                    test = picture[..., :3]
                    if test.shape != reference.shape:
                        raise InputRefused(f"{engine.name}: found {test.shape} pixels; expected {reference.shape}.")
                    counted = whole & np.isfinite(test).all(axis=-1)
                    values = dict(measure_colour(reference, test, counted, METRICS).values)
                    result.append(Measurement(engine.name, spp, seed, seconds, values))
                done += spp
                report(done / total)
    return result, renderer_versions


def converged(measurements: Sequence[Measurement], name: str, counts: Sequence[int]) -> Converged:
    """The curves, slopes and efficiencies of one renderer."""
    own = [m for m in measurements if m.renderer == name]
    by_spp = {spp: [m for m in own if m.spp == spp] for spp in counts}
    seeds = sorted({m.seed for m in own})
    errors = {k: tuple(interval([m.values[k] for m in by_spp[spp]]) for spp in counts) for k in METRICS}
    slopes = {}
    for key in METRICS:
        each = [[next(m.values[key] for m in by_spp[spp] if m.seed == seed) for spp in counts] for seed in seeds]
        slopes[key] = interval([slope(counts, line) for line in each])
    last = by_spp[counts[-1]]
    efficiency = tuple(-math.log(max(m.values["relmse"] * m.seconds, 1e-300)) for m in last)
    seconds = tuple(interval([m.seconds for m in by_spp[spp]]) for spp in counts)
    return Converged(name, tuple(counts), errors, seconds, slopes, efficiency)


def summary(measurements: Sequence[Measurement], names: Sequence[str], counts: Sequence[int]) -> dict[str, Any]:
    """The record: curves per renderer, and the efficiency of each renderer relative to the first."""
    curves = [converged(measurements, name, counts) for name in names]
    ratios = {}
    for curve in curves[1:]:
        a, b = (np.array(c.efficiency) for c in (curves[0], curve))
        mean = float(b.mean() - a.mean())
        half = math.hypot(interval(a.tolist())[1], interval(b.tolist())[1])
        ratios[curve.renderer] = {"ratio": math.exp(mean), "low": math.exp(mean - half), "high": math.exp(mean + half)}
    rows = [
        {
            "renderer": c.renderer,
            "spp": list(c.spp),
            "seconds": [list(v) for v in c.seconds],
            **{k: [list(v) for v in c.errors[k]] for k in METRICS},
            "slope": {k: list(v) for k, v in c.slopes.items()},
        }
        for c in curves
    ]
    return {"curves": rows, "efficiency": ratios, "first": names[0]}


def definitions_of() -> dict[str, str]:
    from mistyle.measure.pictures.metrics import Viewing

    return definitions(Viewing(), METRICS) | {
        "slope": "least squares of log error over log samples, per seed; mean and 95 % interval over seeds (Student's "
        "t); the curve of a biased renderer levels off",
        "efficiency": "1 / (relMSE · seconds) at the most samples, relative to the first renderer; its interval joins "
        "both renderers' 95 % intervals of its logarithm",
        "seconds": "wall time of the render call; loading and compilation happen before",
    }


def write(out: Path, record: dict[str, Any], measurements: Sequence[Measurement]) -> None:
    """Write converge.json, converge.csv and the page."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["renderer", "spp", "seed", "seconds", *METRICS])
    for m in measurements:
        writer.writerow([m.renderer, m.spp, m.seed, repr(m.seconds), *(repr(m.values[k]) for k in METRICS)])
    atomic_write(out / "converge.csv", text.getvalue().encode())
    atomic_write(out / "converge.json", (json.dumps(without_nan(record), indent=1, allow_nan=False) + "\n").encode())
    atomic_write(out / "index.html", page(record).encode())


def without_nan(value: Any) -> Any:
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, dict):
        return {k: without_nan(v) for k, v in value.items()}
    return [without_nan(v) for v in value] if isinstance(value, list) else value


def charts(record: dict[str, Any]) -> list[Chart]:
    """Each error over samples and over seconds, on logarithmic axes."""
    result = []
    for key in METRICS:
        for label, axis in (("samples a pixel, log2", "spp"), ("seconds, log2", "seconds")):
            result += [_chart(record, key, label, axis)]
    return result


def _chart(record: dict[str, Any], key: str, label: str, axis: str) -> Chart:
    """One chart. Renderers differ in their seconds: every curve is interpolated on the union of the axes."""
    places = {}
    for row in record["curves"]:
        x = [math.log2(max(v[0] if axis == "seconds" else v, 1e-9)) for v in row[axis]]
        places[row["renderer"]] = (x, [math.log10(max(v[0], 1e-300)) for v in row[key]])
    grid = sorted({x for xs, _ in places.values() for x in xs})
    series = {}
    for name, (xs, ys) in places.items():
        order = np.argsort(xs)
        line = np.interp(grid, np.array(xs)[order], np.array(ys)[order], left=math.nan, right=math.nan)
        series[name] = [10**v if math.isfinite(v) else math.nan for v in line.tolist()]
    return Chart(f"{key} over {axis}", series, x=grid, x_label=label, y_label=key, log=True)


def page(record: dict[str, Any]) -> str:
    """The page as HTML; every text is escaped, its policy forbids scripts and connections."""
    from markupsafe import Markup

    from mistyle.comparison.page import figure
    from mistyle.jobs.report.charts import svg

    folder = Path(__file__).parent

    def number(value: Any) -> str:
        return figure(None if isinstance(value, float) and not math.isfinite(value) else value)

    style = (folder / "compare.css").read_text(encoding="utf-8")
    return template(folder / "converge.html.j2", figure=number).render(
        record=record,
        metrics=METRICS,
        charts=[Markup(svg(chart)) for chart in charts(record)],  # the chart escapes its own texts
        style=Markup(style),
        style_hash=csp_hash(style),
    )
