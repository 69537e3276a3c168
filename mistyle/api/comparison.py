"""Image metrics of a test picture against a reference, in memory."""

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
    """A mapping from metrics to figures.

    values_by_metric  figures; NaN without pixels to compare
    maps         error maps (h, w) by metric: flip, hdr_flip (0..1) and de2000 (ΔE00)
    definitions  definition of each figure
    pixels       number of compared pixels
    bad          number of NaN and of infinite pixels of the reference and of the test; they are left out
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
    """The metrics of `mistyle compare` for `test` against `reference`.

    reference, test  paths of pictures, views, or arrays (h, w, 3): linear Rec.709, premultiplied (a fourth channel is
                     alpha and not compared). Data may have any number of channels, or none: (h, w)
    mask             pixels to compare; None: all
    kind             "colour": FLIP, HDR-FLIP, PSNR, SSIM, ΔE00, relMSE, sMAPE. "data" (roughness, normals, depth):
                     rmse, mae, max_error, and for three channels the angle in degrees
    metrics          names of metrics; empty: all of the kind
    layer            layer of EXR files with several

    HDR-FLIP is left out where both pictures lie within 0..1; LPIPS needs weights: `mistyle compare --lpips`. Nothing
    is resampled, exposed or tone-mapped. Raises InputRefused where sizes or layers differ, UsageError for unknown
    metrics.
    """
    from mistyle.comparison.inputs import planes
    from mistyle.core.errors import UsageError
    from mistyle.measure.pictures import metrics as measure

    frames = [_frame(picture, label, kind, layer) for picture, label in ((reference, "reference"), (test, "test"))]
    both = planes(frames[0], frames[1], layer, "display", mask)
    known = measure.COLOUR if both.kind == "colour" else measure.DATA
    unknown = [name for name in metrics if name not in known or name == "lpips"]
    if unknown:
        usable = ", ".join(name for name in known if name != "lpips")
        raise UsageError(f"compare: found the metric {unknown[0]!r}, expected some of {usable} for {both.kind}.")
    viewing = measure.Viewing()
    if both.kind == "data":
        measured = measure.measure_data(both.reference, both.test, both.mask, metrics or known)
    else:
        high = any(frame.high for frame in frames)
        names = metrics or [n for n in known if n != "lpips" and (high or n != "hdr_flip")]
        measured = measure.measure_colour(both.reference, both.test, both.mask, names, viewing)
    return Comparison(
        measured.values,
        measured.maps,
        measure.definitions(viewing, list(measured.values)),
        int(both.mask.sum()),
        both.bad,
    )


def _frame(picture: Any, label: str, kind: Literal["colour", "data"], layer: str) -> LayeredPicture:
    """A picture file, a view or an array as a `LayeredPicture`."""
    if isinstance(picture, str | PathLike):
        from mistyle.io.read import read_frame

        return read_frame(Path(picture))
    values = np.asarray(picture.rgb if isinstance(picture, View) else picture)
    values = values[..., None] if values.ndim == 2 else values
    if kind == "colour" and values.ndim == 3 and values.shape[2] == 4:
        values = values[..., :3]
    if values.ndim != 3 or (kind == "colour" and values.shape[2] != 3):
        expected = "(h, w, 3)" if kind == "colour" else "(h, w) or (h, w, channels)"
        raise InputRefused(f"{label}: found an array of the shape {values.shape}, expected {expected}. kind='data' "
                           "compares other data than colours.")  # fmt: skip
    whole = (0, 0, values.shape[1], values.shape[0])
    names = ("R", "G", "B") if kind == "colour" else tuple(map(str, range(values.shape[2])))
    planes = tuple(np.moveaxis(values, -1, 0))
    finite = values[np.isfinite(values)]
    high = bool(finite.size and (finite.max() > 1 or finite.min() < 0))
    return LayeredPicture(Path(label), (Layer(layer, names, planes, kind, whole, whole),), high)
