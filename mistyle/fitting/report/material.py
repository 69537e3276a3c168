"""The report of `mistyle fit`: the page, and `run.json`."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np

from mistyle.core.image import luminance, srgb_from_linear
from mistyle.fitting.pipeline.job import MATERIAL_STAGES
from mistyle.fitting.report.photometry import photometry_steps
from mistyle.jobs.progress import Progress
from mistyle.jobs.report import overlays as report_overlays
from mistyle.jobs.report.charts import Chart
from mistyle.jobs.report.draw import draw
from mistyle.jobs.report.model import page_model
from mistyle.jobs.report.page import (
    BeforeAfter,
    Figure,
    MapSet,
    Note,
    Report,
    ReportPicture,
    Step,
    Timing,
    write_report,
)
from mistyle.jobs.report.parts import file_list, heat, map_shots, setting_groups, side_by_side
from mistyle.jobs.report.pictures import Sizes, kind_in_step, kind_of_maps
from mistyle.jobs.report.turntable import write_turn
from mistyle.jobs.run_record import earlier, merged_peaks, merged_seconds, report_files, write_record
from mistyle.jobs.stages import Run
from mistyle.jobs.versions import peak_gb, versions
from mistyle.solver.photometry.record import as_json

MEANINGS: dict[str, tuple[str, Literal["higher", "lower", ""]]] = {
    "seen_share": ("share of the covered texels that at least one reference sees", "higher"),
    "confident_share": ("share of the covered texels whose material the references determine well", "higher"),
    "psnr_fitted": ("mean PSNR (sRGB, peak 1) of the pictures that the material was fitted to, dB", "higher"),
    "psnr_held_out": ("mean PSNR (sRGB, peak 1) of the pictures that were held out of the fit, dB", "higher"),
    "conversion_error": (
        "mean relative difference of the same maps under the other material model",
        "lower",
    ),
    "outline_overlap": ("mean overlap of the mesh's outline with alpha or masks, intersection over union", "higher"),
    "outline_overlap_least": ("the least overlap of a picture", "higher"),
    "align_px": ("distance of the mesh's outline from the masks' after alignment, pixels", "lower"),
    "pose_px_before": (
        "distance of the mesh's outline from the masks' before the cameras were refined, pixels",
        "lower",
    ),
    "pose_px_after": ("distance of the mesh's outline from the masks' after the cameras were refined, pixels", "lower"),
}


def material_report(folder: Path, results: Any, progress: Progress, report: Callable[[float], None]) -> None:
    """Draw the pictures and write `index.html` and `overview.png` into `folder`; a full report adds `beauty.png` and
    the turntable."""
    from mistyle.io.images.write import write_png

    settings, maps = results.job.settings, results.recovered.maps
    full = settings.report.detail == "full"
    drawn = draw(results.asset, [maps], settings, lambda done: report(0.8 * done), path_traced=full)
    beauty = drawn.close[0] if drawn.traced is None else drawn.traced
    _, reference, predicted = results.measured.worst[0]
    if full:
        write_turn(folder / "turntable", drawn.turns[0])
        write_png(folder / "beauty.png", beauty)
    shots = [encoded(reference, reference), encoded(predicted, reference), beauty]
    write_png(folder / "overview.png", side_by_side(shots))
    report(0.9)
    measured = figures(results)
    page = Report(
        title=results.job.name,
        mesh=results.job.mesh.name,
        style=f"{len(results.captures)} pictures of {results.job.references.name}",
        relation="fitted to",
        painting=ReportPicture(
            encoded(reference, reference), f"A reference: {results.measured.names[results.measured.worst[0][0]]}"
        ),
        turntable=tuple(drawn.turns[0]),
        made=f"mistyle {versions()['mistyle']}, seed {settings.seed}",
        facts=facts(results),
        notes=tuple(Note(text) for text in progress.notes),
        steps=steps(results),
        maps=map_sets(results),
        model=page_model(results.folder / f"{results.job.name}.glb"),
        timings=tuple(Timing(MATERIAL_STAGES.get(k, k), v, k in progress.reused) for k, v in progress.seconds.items()),
        figures=tuple(Figure(k, f"{v:.4g}", *MEANINGS[k]) for k, v in measured.items()),
        settings=setting_groups(settings),
        versions=tuple(versions().items()),
        files=file_list(results.folder, results.job.name),
    )
    write_report(folder / "index.html", page)


def encoded(picture: np.ndarray, exposed_by: np.ndarray) -> np.ndarray:
    """A linear picture in sRGB, exposed so that the 99th percentile of `exposed_by`'s luminance is white."""
    light = luminance(exposed_by)
    bright = float(np.percentile(light[light > 0], 99)) if (light > 0).any() else 1.0
    return srgb_from_linear(np.clip(picture / max(bright, 1e-6), 0, 1).astype(np.float32))


def facts(results: Any) -> tuple[tuple[str, str], ...]:
    mesh = results.asset.mesh
    return (
        ("faces", f"{len(mesh.faces):,}"),
        ("texture sets", str(len(mesh.parts))),
        ("texture size", f"{results.job.settings.atlas.size}²"),
        ("pictures", str(len(results.captures))),
        ("held out", str(sum(results.measured.held))),
        ("material", results.job.settings.recover.model),
        ("passes", f"{results.recovered.passes} of {results.recovered.planned}"),
    )


def steps(results: Any) -> tuple[Step, ...]:
    measured = results.measured
    pairs = tuple(
        BeforeAfter(
            ReportPicture(encoded(reference, reference), "reference"),
            ReportPicture(encoded(predicted, reference), "predicted"),
            f"{measured.names[k]}: {measured.psnr[k]:.1f} dB{', held out' if measured.held[k] else ''}",
        )
        for k, reference, predicted in measured.worst
    )
    differences = tuple(
        ReportPicture(
            difference(reference, predicted), f"{measured.names[k]}: error", "white: 0.1 of the picture's white"
        )
        for k, reference, predicted in measured.worst
    )
    compare = Step(
        "References and predictions",
        "References beside predictions from the same camera under the same light.",
        pairs=pairs,
        shots=differences,
        columns=4,
    )
    curves = Step(
        "Convergence", "The loss of the fit, step by step.", charts=tuple(curve_charts(results.recovered.trace))
    )
    series = {
        label: [p if h == held else float("nan") for p, h in zip(measured.psnr, measured.held, strict=True)]
        for label, held in (("fitted", False), ("held out", True))
        if held in measured.held
    }
    bars = Step(
        "Every picture",
        "PSNR of each prediction (sRGB, peak 1).",
        charts=(Chart("PSNR by picture", series, x_label="picture", y_label="dB", bars=True),),
    )
    parts, longest = list(zip(results.asset.mesh.parts, results.texels, strict=True)), Sizes().of(kind_in_step(2))
    trust = Step(
        "Confidence",
        "Confidence of each texel's material (dark blue: undetermined, yellow: well determined), and the number of "
        "pictures that see it.",
        shots=tuple(
            ReportPicture(picture, f"{name}: {what}", sharp=True)
            for k, (name, t) in enumerate(parts)
            for what, picture in (
                ("confidence", heat(results.recovered.confidence[k], 1, t, longest)),
                ("seen", heat(results.recovered.seen[k], len(results.captures), t, longest)),
            )
        ),
        columns=2,
    )
    return (compare, *photometry_steps(results), curves, bars, trust)


def curve_charts(trace: dict[str, list[float]]) -> list[Chart]:
    return [Chart(name, {name: values}, x_label="step", log=True) for name, values in trace.items() if len(values) > 2]


def difference(reference: np.ndarray, predicted: np.ndarray) -> np.ndarray:
    """|difference| in sRGB, times 10; zero where the reference is black."""
    apart = np.abs(encoded(predicted, reference) - encoded(reference, reference))
    return np.clip(10 * np.where((reference > 0).any(axis=-1, keepdims=True), apart, 0), 0, 1)


def map_sets(results: Any) -> tuple[MapSet, ...]:
    """The fitted maps of every texture set, with confidence and coverage as overlays."""
    sets, longest = [], Sizes().of(kind_of_maps(len(results.asset.mesh.parts)))
    for k, (name, texels) in enumerate(zip(results.asset.mesh.parts, results.texels, strict=True)):
        over = (
            report_overlays.confidence(results.recovered.confidence[k], texels, longest),
            report_overlays.coverage(results.recovered.seen[k], len(results.captures), texels, longest),
        )
        sets.append(MapSet(name, map_shots(results.recovered.maps[k], longest), over))
    return tuple(sets)


def figures(results: Any) -> dict[str, float]:
    covered = [t.covered for t in results.texels]
    total = max(sum(int(c.sum()) for c in covered), 1)

    def share(masks: Sequence[np.ndarray]) -> float:
        return sum(int((m & c).sum()) for m, c in zip(masks, covered, strict=True)) / total

    def mean(held: bool) -> float:
        values = [p for p, h in zip(results.measured.psnr, results.measured.held, strict=True) if h == held]
        return float(np.nanmean(values)) if np.isfinite(values).any() else float("nan")

    table = {
        "seen_share": share([s > 0 for s in results.recovered.seen]),
        "confident_share": share([c > 0.5 for c in results.recovered.confidence]),
        "psnr_fitted": mean(False),
        "psnr_held_out": mean(True),
        "conversion_error": results.measured.conversion,
        **results.placed.figures,
    }
    return {name: value for name, value in table.items() if np.isfinite(value)}


def _or_null(value: float) -> float | None:
    return value if np.isfinite(value) else None


def write_summary(results: Any, run: Run) -> dict[str, Any]:
    """Write `run.json`; returns its summary: paths, times, memory, figures and notes."""
    job = results.job
    path = job.out / "run.json"
    summary = {
        "name": job.name,
        "asset": str(job.out / "asset" / f"{job.name}.glb"),
        "textures": str(job.out / "asset" / "textures"),
        "scene": str(job.out / "scene" / f"{job.name}.xml"),
        **report_files(job),
        "seconds": merged_seconds(path, run),
        "peak_gb": max(peak_gb(), earlier(path).get("peak_gb", 0.0) if run.progress.reused else 0.0),
        "peaks_gb": merged_peaks(path, run),
        "figures": figures(results),
        "passes": {"done": results.recovered.passes, "planned": results.recovered.planned},
        "notes": list(run.progress.notes),
    }
    record = summary | {
        "inputs": {"mesh": job.mesh.name, "references": job.references.name},
        "pictures": [
            {"name": n, "held_out": h, "psnr": _or_null(p), "outline_overlap": _or_null(o)}
            for n, h, p, o in zip(
                results.measured.names,
                results.measured.held,
                results.measured.psnr,
                results.placed.overlap,
                strict=True,
            )
        ],
        **({} if results.photometry is None else {"photometry": as_json(results.photometry)}),
        "seed": job.settings.seed,
        "settings": job.settings.model_dump(mode="json"),
        "versions": versions(),
    }
    write_record(job, record, run.progress)
    return summary
