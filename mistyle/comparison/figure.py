"""The inset figure of --crop: the whole reference with a frame, and the crop of every picture."""

import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8

from mistyle.comparison.frames import Match
from mistyle.comparison.inputs import Planes, chosen_layers, planes
from mistyle.comparison.pictures import shown
from mistyle.comparison.records import CompareJob
from mistyle.core.errors import UsageError
from mistyle.io.store.atomic import atomic_write
from mistyle.jobs.report.false_colour import heat
from mistyle.measure.pictures.flip_bands import flip_map

CROP = 360  # pixels of a crop's longer side in the figure
GAP, TEXT = 10, 46
FRAME = (255, 150, 0)


def inset(job: CompareJob, pairs: Sequence[Match], folder: Path) -> None:
    """Write inset.png and inset.pdf of the first picture that all tests have, with job.crop framed."""
    from mistyle.io.read import read_frame

    if job.crop is None:
        raise ValueError("an inset figure needs a crop")
    whole = [m for m in pairs if m.reference is not None and m.test is not None]
    if not whole:
        raise UsageError("--crop: the reference and the tests have no picture in common")
    cells = []
    for match in (m for m in whole if m.name == whole[0].name):
        if match.reference is None or match.test is None:
            continue
        reference, test = read_frame(match.reference), read_frame(match.test)
        both = planes(reference, test, chosen_layers(reference, test, job.layers)[0][0], job.window, None)
        cells.append((match.test_name, both))
    figure = draw(cells, job.crop, job.viewing.ppd)
    buffer = io.BytesIO()
    figure.save(buffer, "PNG")
    atomic_write(folder / "inset.png", buffer.getvalue())
    buffer = io.BytesIO()
    figure.save(buffer, "PDF", resolution=300.0, title=whole[0].name)
    atomic_write(folder / "inset.pdf", buffer.getvalue())


def draw(cells: Sequence[tuple[str, Planes]], crop: tuple[int, int, int, int], ppd: float) -> Any:
    """The figure as a Pillow image: the reference, then a column per picture with the crop, its LDR-FLIP map (data
    layers: absolute difference), and the mean of that map."""
    from PIL import Image, ImageDraw

    x, y, width, height = crop
    rows, columns = cells[0][1].mask.shape
    if x < 0 or y < 0 or width < 1 or height < 1 or x + width > columns or y + height > rows:
        raise UsageError(f"--crop {x},{y},{width},{height}: expected a window inside {columns} x {rows} pixels")
    window = (slice(y, y + height), slice(x, x + width))
    scale = CROP / max(width, height)
    size = (max(1, round(width * scale)), max(1, round(height * scale)))
    tall = 2 * size[1] + GAP
    reference = _bytes(shown(cells[0][1])[0])
    left = Image.fromarray(reference).resize((max(1, round(columns * tall / rows)), tall), Image.Resampling.LANCZOS)
    factor = tall / rows
    ImageDraw.Draw(left).rectangle(
        [x * factor, y * factor, (x + width) * factor, (y + height) * factor], outline=FRAME, width=3
    )
    picked = [("reference", reference, None, "")]
    picked += [(name, _bytes(shown(both)[1]), *_error(both, window, ppd)) for name, both in cells]
    canvas = Image.new("RGB", (left.width + (GAP + size[0]) * len(picked), tall + TEXT), (255, 255, 255))
    canvas.paste(left, (0, 0))
    pen = ImageDraw.Draw(canvas)
    for k, (name, picture, error, value) in enumerate(picked):
        at = left.width + GAP + k * (GAP + size[0])
        canvas.paste(Image.fromarray(picture[window]).resize(size, Image.Resampling.NEAREST), (at, 0))
        if error is not None:
            canvas.paste(Image.fromarray(error).resize(size, Image.Resampling.NEAREST), (at, size[1] + GAP))
        _write(pen, (at, tall + 4), name, size[0])
        _write(pen, (at, tall + 24), value, size[0])
    return canvas


def _error(both: Planes, window: tuple[slice, slice], ppd: float) -> tuple[UInt8[np.ndarray, "h w 3"], str]:
    """The error map of the crop, and its mean as text; FLIP is computed on the whole picture, then cropped."""
    if both.kind == "colour":
        error = flip_map(*shown(both), ppd=ppd)[window]
        return heat(error), f"FLIP {error.mean():.4f}"
    gap = np.abs(np.nan_to_num(both.test) - np.nan_to_num(both.reference)).mean(axis=-1).astype(np.float32)[window]
    return heat(gap, max(float(gap.max()), 1e-9)), f"mean |difference| {gap.mean():.4g}"


def _bytes(picture: np.ndarray) -> UInt8[np.ndarray, "h w 3"]:
    return np.ascontiguousarray(np.round(np.clip(picture, 0, 1) * 255).astype(np.uint8))


def _write(pen: Any, at: tuple[int, int], text: str, width: int) -> None:
    """Draw text, truncated to `width` pixels."""
    from PIL import ImageFont

    font = ImageFont.load_default(16)
    while text and pen.textlength(text, font=font) > width:
        text = text[:-2] + "…" if len(text) > 2 else ""
    pen.text(at, text, fill=(20, 20, 20), font=font)
