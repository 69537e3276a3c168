"""`run.json`: what a job was told, what it stood on, how long it took, and how good it is."""

import json
import platform
from importlib.metadata import PackageNotFoundError, version
from typing import Any, Literal

from mistyle import __version__
from mistyle.core import memory
from mistyle.files.output import write_file
from mistyle.files.own import read_own
from mistyle.measure.baked_light import BakedLight
from mistyle.run.progress import Progress
from mistyle.run.stages import Run

PACKAGES = (
    "mitsuba",
    "drjit",
    "torch",
    "numpy",
    "scipy",
    "trimesh",
    "xatlas",
    "OpenEXR",
    "opencv-contrib-python-headless",
    "pillow",
)


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


def report_files(job: Any) -> dict[str, str]:
    """Where the report and its picture lie; nothing where none is wanted."""
    if job.settings.report.detail == "none":
        return {}
    folder = job.out / "report"
    return {"report": str(folder / "index.html"), "picture": str(folder / "overview.png")}


def old_report(job: Any) -> tuple[str, ...]:
    """A note where this run writes no report and an earlier one's lies there."""
    folder = job.out / "report"
    if job.settings.report.detail != "none" or not folder.exists():
        return ()
    return (f"{folder} shows an earlier run: --report none wrote no new one.",)


def write_record(job: Any, record: dict[str, Any], progress: Progress) -> None:
    """Write the job's `run.json`; an edited one is set aside, and that is said."""
    aside = write_file(job.out, "run.json", (json.dumps(record, indent=1) + "\n").encode(), overwrite=job.overwrite)
    if aside is not None:
        progress.note(f"run.json was edited: your version now lies in {aside}.")


def earlier(path: Any) -> dict[str, Any]:
    """The `run.json` of the run before, or nothing."""
    try:
        return read_own(path)
    except (OSError, ValueError):
        return {}


def merged_seconds(path: Any, run: Run) -> dict[str, float]:
    """The time of every stage; a stage that was taken over keeps the time that it took when it was made."""
    before = earlier(path).get("seconds", {})
    now = run.progress.seconds
    return {name: round(before.get(name, 0.0) if name in run.progress.reused else now[name], 3) for name in now}


def merged_peaks(path: Any, run: Run) -> dict[str, float]:
    """The most memory that each stage needed, GB; as with the times, a stage that was taken over keeps its own."""
    before = earlier(path).get("peaks_gb", {})
    now = run.progress.peaks | {name: before[name] for name in run.progress.reused if name in before}
    return {name: round(now[name], 3) for name in run.progress.seconds if name in now}


def peak_gb() -> float:
    """Peak resident memory of this process or of its largest child, GB."""
    return memory.highest() / 1e9


def versions() -> dict[str, str]:
    """What the result was made with."""
    found = {"mistyle": __version__, "python": platform.python_version(), "system": platform.platform()}
    for name in PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "missing"
    return found


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
