"""`run.json` of `stylize`: inputs, settings, timings, memory peaks and quality metrics."""

from typing import Any, Literal

from mistyle.jobs.run_record import earlier, merged_peaks, merged_seconds, report_files, write_record
from mistyle.jobs.stages import Run
from mistyle.jobs.versions import peak_gb, versions
from mistyle.measure.baked_light import BakedLight


def write_summary(result: Any, run: Run) -> dict[str, Any]:
    """Write `run.json` and return paths, metrics, timings and notes."""
    job = run.job
    path = job.out / "run.json"
    seconds = merged_seconds(path, run)
    summary = {
        "name": job.name,
        "finished": True,
        "asset": str(job.out / "asset" / f"{job.name}.glb"),
        "textures": str(job.out / "asset" / "textures"),
        **report_files(job),
        "views": str(job.out / "views"),
        "stylized": str(job.out / "stylized"),
        "seconds": seconds,
        "peak_gb": max(peak_gb(), earlier(path).get("peak_gb", 0.0) if run.progress.reused else 0.0),
        "peaks_gb": merged_peaks(path, run),
        "figures": figures(result),
        "notes": list(run.progress.notes),
    }
    record = summary | {
        "inputs": {"mesh": job.mesh.name, "style": job.style.name},
        "style": [look.record() for look in result.looks],
        "seed": job.settings.seed,
        "settings": job.settings.model_dump(mode="json"),
        "versions": versions(),
    }
    write_record(job, record, run.progress)
    return summary


# Meaning and better direction of each metric of `figures`; the fit's are named <phase>.<metric>.
MEANINGS: dict[str, tuple[str, Literal["higher", "lower", ""]]] = {
    "residual": ("residual of lit views under their own light, relative to the views", "lower"),
    "painted_share": ("share of the covered texels whose albedo was painted", "higher"),
    "seen_share": ("share of the covered texels that at least one view sees", "higher"),
    "repaired_share": ("share of the covered texels that were painted again after the fit", ""),
    "light_up_over_down": (
        "mean albedo facing up over mean albedo facing down; 1: without light from above",
        "",
    ),
    "light_correlation": (
        "largest correlation of the log albedo with an axis of the normal or with openness",
        "lower",
    ),
    "style_before": ("distance of VGG-19's statistics to the painting's, on held-out crops, before", "lower"),
    "style_after": ("the same after the finish", "lower"),
    "moved": ("root mean square change of the albedo by the finish, sRGB units", ""),
    "overlap_before": (
        "intersection over union of changed outlines with the mesh's, before displacing it",
        "higher",
    ),
    "overlap_after": ("the same after the displacement", "higher"),
    "most": ("largest displacement of a vertex, in bounding radii", ""),
    "detail": ("correlation of the render's fine lightness with the stylized views' after this phase", "higher"),
    "style": ("patch and Gram distance of the render to the stylized views after this phase", "lower"),
    "views": ("difference of a surface point between neighbouring views, over the picture's own detail", "lower"),
}


def light_figures(light: BakedLight | None) -> dict[str, float]:
    """Baked light left in the finished albedo; empty where it is not measurable."""
    if light is None:
        return {}
    ratio = {} if light.ratio is None else {"light_up_over_down": light.ratio}
    return ratio | {"light_correlation": light.strongest}


def finish_figures(finishing: Any) -> dict[str, float]:
    """Style loss before and after the finish, and the albedo's change; empty without a finish."""
    if finishing is None:
        return {}
    return {
        "finish.style_before": finishing.style[0],
        "finish.style_after": finishing.style[1],
        "finish.moved": finishing.moved,
    }


def shape_figures(reshaped: Any) -> dict[str, float]:
    """Overlap with the changed outlines before and after, and the largest displacement; empty where no vertex moved."""
    if reshaped is None or not reshaped.shape.changed:
        return {}
    (before, after), most = reshaped.shape.overlap, reshaped.shape.result.moved[1]
    return {"displace.overlap_before": before, "displace.overlap_after": after, "displace.most": most}


def figures(result: Any) -> dict[str, float]:
    """Quality metrics over all texture sets. An undone phase reports its metrics from before it."""
    covered = [t.covered for t in result.atlas.texels]
    total = max(sum(int(c.sum()) for c in covered), 1)

    def share(masks: Any) -> float:
        return sum(int((m & c).sum()) for m, c in zip(masks, covered, strict=True)) / total

    return {
        "painted_share": share([m.known for m in result.repaired.maps]),
        "seen_share": share([s > 0 for s in result.baked.seen]),
        "repaired_share": share(result.repaired.mask),
        **light_figures(result.light),
        **finish_figures(result.finishing),
        **shape_figures(result.reshaped),
        **{name: pair[result.fit.kept[name.partition(".")[0]]] for name, pair in result.fit.figures.items()},
    }
