"""Inputs of `mistyle demo`, the meshes and paintings of `scenes/`; and its sheet of all four results."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mistyle.core.paths import scenes

SHEET = "demo.png"
ROW = 480  # pixels of a row of the sheet


@dataclass(frozen=True)
class DemoPainting:
    """A painting of `scenes/`: its file, its default mesh, and a short description."""

    file: str
    mesh: str
    words: str


MESHES = {"elephant": "demo.obj", "robot": "robot.obj"}
PAINTINGS = {
    "oil": DemoPainting("demo_style.png", "elephant", "an evening over the sea"),
    "mosaic": DemoPainting("demo_mosaic.jpg", "elephant", "fish in stone and glass"),
    "hatched": DemoPainting("demo_hatched.png", "robot", "a still life in ink"),
    "pixel": DemoPainting("demo_pixel.png", "robot", "a castle, cell by cell"),
}
DEFAULT = "mosaic"


def demo_files(style: str | None, mesh: str | None) -> tuple[Path, Path]:
    """The files of a mesh and a painting by name; None: the default."""
    painting = PAINTINGS[style or DEFAULT]
    return scenes() / MESHES[mesh or painting.mesh], scenes() / painting.file


def run_all(jobs: Sequence[Any], out: Path, progress: Any, *, overwrite: bool = False) -> dict[str, Any]:
    """Run the jobs one after another and write OUT/demo.png, one row per job: mesh, painting, result.

    Returns the sheet's path ("" where no job wrote a report) and the summaries.
    """
    from mistyle.io.store.output import claim, replace_files
    from mistyle.jobs.progress import Progress
    from mistyle.stylization.pipeline.stylize import stylize

    inputs = [path for job in jobs for path in (job.mesh, job.style)]
    claim(out, [SHEET], inputs=inputs, overwrite=overwrite)
    runs = []
    for job in jobs:
        progress.say(f"{job.out.name}: {job.mesh.name} in the style of {job.style.name}")
        own = Progress(progress.quiet)  # its own timings and notes go into its own run.json
        runs.append(stylize(job, own))
        progress.note(*own.notes)
    rows = [Path(run["picture"]) for run in runs if run.get("picture") and Path(run["picture"]).is_file()]
    if rows:
        replace_files(out, "demo", lambda folder: _write_sheet(rows, folder), inputs=inputs, overwrite=overwrite)
    return {"sheet": str(out / SHEET) if rows else "", "runs": runs, "notes": list(progress.notes)}


def _write_sheet(rows: Sequence[Path], folder: Path) -> None:
    """Write the sheet: the pictures in a column on white, each ROW pixels high."""
    import numpy as np
    from PIL import Image

    from mistyle.io.read import read_picture

    pictures = []
    for path in rows:
        picture = Image.fromarray(np.round(read_picture(path).rgb * 255).astype(np.uint8))
        pictures.append(picture.resize((round(picture.width * ROW / picture.height), ROW), Image.Resampling.LANCZOS))
    sheet = Image.new("RGB", (max(p.width for p in pictures), ROW * len(pictures)), "white")
    for k, picture in enumerate(pictures):
        sheet.paste(picture, (0, k * ROW))
    sheet.save(folder / SHEET)
