"""Figures of how far one picture is from another."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Bool, Float

from mistyle.api import html
from mistyle.core.errors import InputRefused
from mistyle.core.view import View
from mistyle.io.images.layers import BEAUTY, Layer, LayeredPicture


@dataclass(frozen=True)
class Comparison(Mapping[str, float]):
    """The figures by metric; a mapping of them.

    values_by_metric  figures; NaN where nothing could be compared
    maps         error maps (h, w) by metric: flip, hdr_flip (0..1) and de2000 (ΔE00)
    definitions  what each figure is
    pixels       how many pixels were compared
    bad          how many pixels were NaN or infinite, of the reference and of the test; they are left out
    """

    values_by_metric: Mapping[str, float]
    maps: Mapping[str, Float[np.ndarray, "h w"]]
    definitions: Mapping[str, str]
    pixels: int
    bad: Mapping[str, int]

    def __getitem__(self, metric: str) -> float:
        return self.values_by_metric[metric]

    def __iter__(self) -> Iterator[str]:
        return iter(self.values_by_metric)

    def __len__(self) -> int:
        return len(self.values_by_metric)

    def _repr_html_(self) -> str:
        from mistyle.measure.pictures.metrics import METRICS

        rows = [(n, v, METRICS[n].unit, METRICS[n].better) for n, v in self.items()]
        most = {name: float(m.max()) or 1.0 for name, m in self.maps.items()}
        shown = {f"{name}, white: {most[name]:.2g}": np.clip(m / most[name], 0, 1) for name, m in self.maps.items()}
        notes = [f"{count} pixels left out: {name}" for name, count in self.bad.items() if count]
        head = ("metric", "value", "unit", "better")
        return html.page(f"{self.pixels:,} pixels", html.table(head, rows), html.thumbnails(shown), notes=notes)


def compare(
    reference: str | PathLike | np.ndarray | View,
    test: str | PathLike | np.ndarray | View,
    mask: Bool[np.ndarray, "h w"] | None = None,
    *,
    kind: Literal["colour", "data"] = "colour",
    metrics: Sequence[str] = (),
    layer: str = BEAUTY,
) -> Comparison:
    """How far `test` is from `reference`, by the metrics of `mistyle compare`.

    reference, test  paths of pictures, views, or arrays (h, w, 3): linear Rec.709, premultiplied (a fourth channel is
                     alpha and not compared). Data may have any number of channels, or none: (h, w)
    mask             pixels that count; None: all
    kind             "colour": FLIP, HDR-FLIP, PSNR, SSIM, ΔE00, relMSE, sMAPE. "data" (roughness, normals, depth):
                     rmse, mae, max_error, and of three channels the angle in degrees
    metrics          the names of some of them; empty: all
    layer            of EXR files with several

    HDR-FLIP is left out where both pictures lie within 0..1; LPIPS needs weights: `mistyle compare --lpips`. Nothing
    is resampled, exposed or tone-mapped. Raises InputRefused where sizes or layers differ, UsageError for metrics that
    do not exist.
    """
    from mistyle.comparison.inputs import planes
    from mistyle.core.errors import UsageError
    from mistyle.measure.pictures import metrics as measure

    frames = [_frame(given, who, kind, layer) for given, who in ((reference, "reference"), (test, "test"))]
    both = planes(frames[0], frames[1], layer, "display", mask)
    known = measure.COLOUR if both.kind == "colour" else measure.DATA
    wrong = [name for name in metrics if name not in known or name == "lpips"]
    if wrong:
        usable = ", ".join(name for name in known if name != "lpips")
        raise UsageError(f"compare: found the metric {wrong[0]!r}, expected some of {usable} for {both.kind}.")
    viewing = measure.Viewing()
    if both.kind == "data":
        found = measure.measure_data(both.reference, both.test, both.mask, metrics or known)
    else:
        high = any(frame.high for frame in frames)
        names = metrics or [n for n in known if n != "lpips" and (high or n != "hdr_flip")]
        found = measure.measure_colour(both.reference, both.test, both.mask, names, viewing)
    return Comparison(
        found.values, found.maps, measure.definitions(viewing, list(found.values)), int(both.mask.sum()), both.bad
    )


def _frame(given: Any, who: str, kind: Literal["colour", "data"], layer: str) -> LayeredPicture:
    """A file's frame, or an array as one."""
    if isinstance(given, str | PathLike):
        from mistyle.io.read import read_frame

        return read_frame(Path(given))
    values = np.asarray(given.rgb if isinstance(given, View) else given)
    values = values[..., None] if values.ndim == 2 else values
    if kind == "colour" and values.ndim == 3 and values.shape[2] == 4:
        values = values[..., :3]
    if values.ndim != 3 or (kind == "colour" and values.shape[2] != 3):
        expected = "(h, w, 3)" if kind == "colour" else "(h, w) or (h, w, channels)"
        raise InputRefused(f"{who}: found an array of the shape {values.shape}, expected {expected}. kind='data' "
                           "compares what is not colours.")  # fmt: skip
    whole = (0, 0, values.shape[1], values.shape[0])
    names = ("R", "G", "B") if kind == "colour" else tuple(map(str, range(values.shape[2])))
    planes = tuple(np.moveaxis(values, -1, 0))
    finite = values[np.isfinite(values)]
    high = bool(finite.size and (finite.max() > 1 or finite.min() < 0))
    return LayeredPicture(Path(who), (Layer(layer, names, planes, kind, whole, whole),), high)
