"""`--variations N`: a contact sheet of quick variations of one style picture on a mesh."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from mistyle.core.camera import rig
from mistyle.core.settings import RigSettings
from mistyle.io.store.output import claim, replace_files
from mistyle.jobs.progress import Progress
from mistyle.stylization.pipeline.preview import ATLAS, lit_views, painted_maps, reduced, rows_of
from mistyle.stylization.settings import Settings

SAMPLES, RESOLUTION = 40_000, 384
VIEWS = (0, 13)  # of the paper's rig: front right and front left
STROKES = (1.0, 1.6, 0.7)  # alternating factors of the stroke size
COLUMNS = 4
SHEET = "variations.png"


@dataclass(frozen=True)
class Variation:
    """Settings of one picture of the sheet, and their command-line label."""

    label: str
    settings: Settings


def variations(settings: Settings, count: int) -> list[Variation]:
    """The job's settings first, then other seeds; every second variation has another stroke size."""
    result = []
    for k in range(count):
        factor = STROKES[(k // 2 + 1) % len(STROKES)] if k % 2 else 1.0
        scale = float(np.clip(settings.surface.stroke_scale * factor, 0.1, 10))
        surface = {"samples": min(settings.surface.samples, SAMPLES), "stroke_scale": scale}
        changed: Mapping[str, Any] = {
            "seed": settings.seed + k,
            "surface": settings.surface.model_copy(update=surface),
            "atlas": settings.atlas.model_copy(update={"size": min(settings.atlas.size, ATLAS)}),
        }
        label = f"--seed {settings.seed + k} --stroke-scale {scale:g}"
        result.append(Variation(label, settings.model_copy(update=changed)))
    return result


def sheet(
    mesh: Path, style: Path, out: Path, settings: Settings, count: int, progress: Progress, *, overwrite: bool = False
) -> dict[str, Any]:
    """Write OUT/variations.png; returns its path and the options of each picture."""
    from mistyle.deliver.colour import read_style
    from mistyle.jobs import start
    from mistyle.jobs.inputs import input_files
    from mistyle.stylization.pipeline import start as stylize_start

    inputs = [*input_files(mesh), style]
    claim(out, [SHEET], inputs=inputs, overwrite=overwrite)
    picture = read_style(style, settings.colour)
    start.start_engines(settings)
    cameras = [rig(RigSettings(resolution=RESOLUTION))[k] for k in VIEWS]
    with progress.stage("mesh", "read the mesh") as report:
        asset = start.read(mesh, settings.read, ATLAS, report)
    progress.note(*asset.source.notes, *picture.notes)
    tiles, labels, atlas = [], [], stylize_start.lay_out(asset, reduced(settings), lambda done: None)
    drawn = lit_views(asset, settings.seed)
    for variation in variations(settings, count):
        with progress.stage("surface", f"paint with {variation.label}") as report:
            maps = painted_maps(asset, picture, atlas, variation.settings, report)
            tiles.append(np.concatenate(drawn(maps, cameras), axis=1))
        labels.append(variation.label)
    fill = partial(_write_sheet, tiles)
    replace_files(out, "variations", fill, inputs=inputs, overwrite=overwrite)
    return {"sheet": str(out / SHEET), "variations": labels, "notes": list(progress.notes)}


def _write_sheet(tiles: list[Float[np.ndarray, "h w 3"]], folder: Path) -> None:
    from mistyle.io.images.write import write_png

    write_png(folder / SHEET, rows_of(tiles, min(COLUMNS // len(VIEWS), len(tiles))))
