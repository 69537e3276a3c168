"""The report of a scene fit: the table of values before and after, figures, and the page."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np

from mistyle.fitting.report.material import difference, encoded
from mistyle.jobs.report.charts import Chart
from mistyle.jobs.report.page import BeforeAfter, Figure, Note, Report, ReportPicture, Step, write_report
from mistyle.jobs.versions import versions

MEANINGS: dict[str, tuple[str, Literal["higher", "lower", ""]]] = {
    "psnr_before": ("mean PSNR of the sensors' pictures before the fit (sRGB, peak 1), dB", "higher"),
    "psnr_after": ("mean PSNR of the sensors' pictures after the fit (sRGB, peak 1), dB", "higher"),
    "render_noise": ("share of the remaining squared difference that is noise of one step's render, 0..1", ""),
    "unconverged": ("parameters that still moved at the end", "lower"),
    "bad_gradients": ("gradients that were not finite; their texels did not change in that step", "lower"),
}


def figures(fitted: Any) -> dict[str, float]:
    before, after = (np.mean([r.psnr[k] for r in fitted.residuals]) for k in (0, 1))
    return {
        "psnr_before": float(before),
        "psnr_after": float(after),
        "render_noise": float(np.mean([r.noise[1] for r in fitted.residuals])),
        "unconverged": float(len(fitted.unconverged)),
        "bad_gradients": float(len(fitted.bad)),
    }


def changes(fitted: Any) -> list[dict[str, Any]]:
    """One row per parameter: its values before and after and their standard errors (None where unknown).

    Textures and attributes appear as the means of their channels.
    """
    from mistyle.solver.scene.result import brief

    rows = []
    for p in fitted.parameters:
        start, end = (brief(p, values[p.key]) for values in (fitted.start, fitted.values))
        row = {"name": p.name, "kind": p.kind, "mean_of": int(np.prod(p.shape)) // max(len(end), 1)}
        errors = [float(e) if np.isfinite(e) else None for e in np.atleast_1d(fitted.errors[p.key])]
        rows.append(row | {"start": start.tolist(), "fitted": end.tolist(), "standard_error": errors})
    return rows


def row_text(row: dict[str, Any]) -> str:
    """'0.5 0.5 0.5 → 0.886 ± 0.001 0.699 ± 0.001 …'"""
    before = " ".join(f"{v:.4g}" for v in row["start"])
    after = [
        f"{v:.4g}" + (f" ± {e:.1g}" if e is not None else "")
        for v, e in zip(row["fitted"], row["standard_error"], strict=True)
    ]
    kind = "" if row["mean_of"] == 1 else " (mean)"
    return f"{before} → {', '.join(after)}{kind}"


def noise_text(fitted: Any) -> str:
    """The share of render noise in the residuals, as a sentence."""
    shares = [r.noise[1] for r in fitted.residuals]
    between = f"{min(shares):.0%}" if len(shares) == 1 else f"{min(shares):.0%} to {max(shares):.0%}"
    return (
        f"{between} of the difference between a step's picture and its reference is render noise (measured from two "
        "renders). The rest is noise of the reference and error that the parameters cannot explain."
    )


def write_page(
    path: Path, scene: str, folder: str, fitted: Any, pictures: Sequence[tuple[str, Any, Any]], summary: dict[str, Any]
) -> None:
    """Write the page: predictions beside references, the loss, fitted values. `pictures`: name, reference, render."""
    pairs, errors = [], []
    for (name, rgb, picture), residual in zip(pictures, fitted.residuals, strict=True):
        caption = f"{name}: {residual.psnr[0]:.1f} dB → {residual.psnr[1]:.1f} dB"
        pairs.append(
            BeforeAfter(
                ReportPicture(encoded(rgb, rgb), "reference"), ReportPicture(encoded(picture, rgb), "fitted"), caption
            )
        )
        errors.append(ReportPicture(difference(rgb, picture), f"{name}: error", "ten times as bright"))
    textures = tuple(
        ReportPicture(np.clip(values if values.ndim == 3 else values[..., None], 0, 1), p.name)
        for p in fitted.parameters
        if (values := fitted.values[p.key]).ndim == 3 and values.shape[2] in (1, 3)
    )
    name, reference, drawn = pictures[0]
    first = encoded(reference, reference)
    about = "± is a standard error: of the render noise and, for numbers, of the references' noise too."
    page = Report(
        title=summary["name"],
        mesh=scene,
        style=f"{len(pictures)} pictures of {folder}",
        relation="fitted to",
        painting=ReportPicture(first, f"A reference: {name}"),
        turntable=(encoded(drawn, reference),),
        made=f"mistyle {versions()['mistyle']}, seed {summary['settings']['seed']}",
        facts=(("parameters", str(len(fitted.parameters))), ("sensors", str(len(pictures)))),
        notes=tuple(Note(text) for text in summary["notes"]),
        steps=(
            Step("Fitted values", about, facts=tuple((row["name"], row_text(row)) for row in summary["values"])),
            Step("References and predictions", pairs=tuple(pairs[:16]), shots=tuple(errors[:16])),
            Step(
                "Convergence",
                noise_text(fitted),
                charts=(Chart("loss", {"loss": fitted.trace}, x_label="step", log=True),),
            ),
            Step("Fitted textures", "As stored: data, not colour-converted.", shots=textures, columns=3),
        ),
        figures=tuple(Figure(k, f"{v:.4g}", *MEANINGS[k]) for k, v in summary["figures"].items()),
        versions=tuple(versions().items()),
    )
    write_report(path, page)
