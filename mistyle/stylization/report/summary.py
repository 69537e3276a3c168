"""`run.json` of `stylize`: its inputs and settings, how long it took, and how good it is."""

from typing import Any, Literal

from mistyle.jobs.run_record import earlier, merged_peaks, merged_seconds, report_files, write_record
from mistyle.jobs.stages import Run
from mistyle.jobs.versions import peak_gb, versions
from mistyle.measure.baked_light import BakedLight


def write_summary(made: Any, run: Run) -> dict[str, Any]:
    """Write `run.json` and return what the caller wants to know: paths, figures, timings."""
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
        "figures": figures(made),
        "notes": list(run.progress.notes),
    }
    record = summary | {
        "inputs": {"mesh": job.mesh.name, "style": job.style.name},
        "style": [look.record() for look in made.looks],
        "seed": job.settings.seed,
        "settings": job.settings.model_dump(mode="json"),
        "versions": versions(),
    }
    write_record(job, record, run.progress)
    return summary


# What each figure of `figures` means, and which way is up; those of the fit are named <phase>.<figure>.
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
    "style_before": ("distance of VGG-19's statistics to the painting's, on crops that no step used, before", "lower"),
    "style_after": ("the same after the finish", "lower"),
    "moved": ("root mean square change of the albedo by the finish, sRGB units", ""),
    "detail": ("correlation of the render's fine lightness with the stylized views' after this phase", "higher"),
    "style": ("patch and Gram distance of the render to the stylized views after this phase", "lower"),
    "views": ("difference of a surface point between neighbouring views, over the picture's own detail", "lower"),
}


def light_figures(light: BakedLight | None) -> dict[str, float]:
    """How much light the finished albedo holds; nothing where it cannot be said."""
    if light is None:
        return {}
    ratio = {} if light.ratio is None else {"light_up_over_down": light.ratio}
    return ratio | {"light_correlation": light.strongest}


def finish_figures(made: Any) -> dict[str, float]:
    """What the finish did to the style loss and to the albedo; nothing where there was none."""
    if made is None:
        return {}
    return {"finish.style_before": made.style[0], "finish.style_after": made.style[1], "finish.moved": made.moved}


def figures(made: Any) -> dict[str, float]:
    """How good the result is, over all texture sets. Of a phase that was undone, the figures are those before it."""
    covered = [t.covered for t in made.atlas.texels]
    total = max(sum(int(c.sum()) for c in covered), 1)

    def share(masks: Any) -> float:
        return sum(int((m & c).sum()) for m, c in zip(masks, covered, strict=True)) / total

    return {
        "painted_share": share([m.known for m in made.repaired.maps]),
        "seen_share": share([s > 0 for s in made.baked.seen]),
        "repaired_share": share(made.repaired.mask),
        **light_figures(made.light),
        **finish_figures(made.finishing),
        **{name: pair[made.fit.kept[name.partition(".")[0]]] for name, pair in made.fit.figures.items()},
    }
