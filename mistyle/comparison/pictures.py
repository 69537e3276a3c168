"""Pictures of a comparison's page: both renders, their difference, false colours, error maps, a histogram.

All are WebP. NaN and infinite pixels are magenta in every picture. A render with values above 1 is stored twice: at
exposure 0, and with the curve (x / M)^(1 / WIDE) in 8 bits, which the page's exposure filter inverts. M is the 99.9th
percentile of the reference, within 1..1024.
"""

import io
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from mistyle.comparison.inputs import Planes
from mistyle.core.image import luminance
from mistyle.jobs.report.charts import Chart, svg
from mistyle.jobs.report.false_colour import DIVERGING, RAINBOW, heat, mapped
from mistyle.measure.pictures.metrics import encoded

WIDE = 4.4
LOSSLESS = 2_200_000  # pixels; larger pictures are stored with invisible losses
LONGEST = 4096
THUMB = 200
NOT_A_NUMBER = (255, 0, 255)
STOPS = (-8.0, 6.0)  # of false colours, about middle grey
GREY = 0.18


@dataclass(frozen=True)
class PairPictures:
    """A pair's pictures: M of the wide curve (0: no such picture), the range of the signed difference, and the names of
    the error maps."""

    wide: float
    span: float
    maps: tuple[str, ...]


def write_pictures(folder: Path, planes: Planes, maps: Mapping[str, np.ndarray], high: bool) -> PairPictures:
    """Write a pair's pictures into `folder`; `maps` are error maps (h w) by metric."""
    folder.mkdir(parents=True, exist_ok=True)
    odd = planes.odd
    looks = shown(planes)
    for name, picture in zip(("reference", "test"), looks, strict=True):
        save(folder / f"{name}.webp", picture, odd)
    del looks  # frees the memory of two large pictures
    wide = 0.0
    if high and planes.kind == "colour":
        wide = _most(planes)
        for name, values in (("reference", planes.reference), ("test", planes.test)):
            save(folder / f"{name}_wide.webp", _curve(values, wide), odd)
    for name, values in (("reference", planes.reference), ("test", planes.test)):
        if planes.kind == "colour":
            save(folder / f"{name}_false.webp", false_colours(values), odd)
    gap, span = signed(planes)
    save(folder / "difference.webp", gap, odd)
    for name, values in maps.items():
        save(folder / f"{name}.webp", heat(values, 20.0 if name == "de2000" else 1.0), odd)
    (folder / "histogram.svg").write_text(histogram(planes), encoding="utf-8")
    return PairPictures(wide, span, tuple(maps))


def thumbnail(path: Path, planes: Planes, error: np.ndarray | None) -> None:
    """Reference, test and error beside each other, THUMB pixels wide each."""
    height, width = planes.mask.shape
    size = (THUMB, max(1, min(4 * THUMB, round(height * THUMB / width))))

    def small(values: np.ndarray) -> np.ndarray:
        resized = cv2.resize(np.nan_to_num(values, posinf=1.0, neginf=0.0), size, interpolation=cv2.INTER_AREA)
        return resized.reshape(size[1], size[0], *values.shape[2:])

    # Averaged in linear light, before any computation at the full size.
    odd = small(planes.odd.astype(np.float32)) > 0
    reduced = replace(
        planes,
        reference=small(planes.reference),
        test=small(planes.test),
        mask=np.asarray(small(planes.mask.astype(np.float32)) > 0.5),
        odd=np.asarray(odd),
    )
    looks = [*shown(reduced), heat(small(error)) if error is not None else signed(reduced)[0]]
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(webp(np.concatenate([_eight(p, reduced.odd) for p in looks], axis=1), 88))


def shown(planes: Planes) -> list[np.ndarray]:
    """Both pictures for display, 0..1: colours sRGB-encoded and clipped, vectors as (v + 1) / 2, other data scaled to
    the reference's range."""
    if planes.kind == "colour":
        return [encoded(np.nan_to_num(values, posinf=1.0)) for values in (planes.reference, planes.test)]
    low, high = _range(planes)
    result = []
    for values in (planes.reference, planes.test):
        picture = np.clip((np.nan_to_num(values, posinf=high, neginf=low) - low) / (high - low), 0, 1)
        channels = picture.shape[2]
        extra = np.zeros((*picture.shape[:2], max(0, 3 - channels)), np.float32)
        result.append(np.repeat(picture, 3, axis=2) if channels == 1 else np.concatenate([picture, extra], 2)[..., :3])
    return result


def _range(planes: Planes) -> tuple[float, float]:
    values = planes.reference[planes.mask]
    if planes.reference.shape[2] == 3 and len(values) and values.min() < 0 and np.abs(values).max() <= 1.001:
        return -1.0, 1.0
    low, high = (float(v) for v in np.percentile(values, (0.5, 99.5))) if len(values) else (0.0, 1.0)
    return (low, high) if high > low else (low - 0.5, low + 0.5)


def _most(planes: Planes) -> float:
    finite = planes.reference[planes.mask]
    return float(np.clip(np.percentile(finite, 99.9), 1.0, 1024.0)) if len(finite) else 1.0


def _curve(values: np.ndarray, most: float) -> np.ndarray:
    result = np.empty(values.shape, np.float32)
    for start in range(0, len(values), 64):
        rows = np.nan_to_num(values[start : start + 64], posinf=most)
        result[start : start + 64] = np.clip(rows / most, 0, 1) ** np.float32(1 / WIDE)
    return result


def false_colours(linear: Float[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h w 3"]:
    """Luminance in stops relative to middle grey 0.18, from STOPS[0] (dark blue) to STOPS[1] (dark red)."""
    bright = np.maximum(luminance(np.nan_to_num(linear, posinf=1e6)), 1e-9)
    return mapped((np.log2(bright / GREY) - STOPS[0]) / (STOPS[1] - STOPS[0]), RAINBOW)


def signed(planes: Planes) -> tuple[UInt8[np.ndarray, "h w 3"], float]:
    """Test minus reference (colours: luminance), blue below zero and red above, and the range of the colours."""
    a, b = (np.nan_to_num(v, posinf=0.0, neginf=0.0) for v in (planes.reference, planes.test))
    gap = luminance(b - a) if planes.kind == "colour" else (b - a).mean(axis=-1)
    inside = np.abs(gap[planes.mask])
    span = float(np.percentile(inside, 99.5)) if len(inside) else 1.0
    span = span if span > 0 else float(inside.max()) if len(inside) and inside.max() > 0 else 1.0
    return mapped(gap / (2 * span) + 0.5, DIVERGING), span


def _eight(picture: np.ndarray, odd: np.ndarray | None) -> UInt8[np.ndarray, "h w 3"]:
    if picture.dtype != np.uint8:
        eight = np.empty(picture.shape, np.uint8)
        for start in range(0, len(picture), 64):
            eight[start : start + 64] = np.clip(picture[start : start + 64] * 255 + 0.5, 0, 255)
        picture = eight
    if odd is not None and odd.any():
        picture = picture.copy()
        # Dilated: a single pixel would vanish when a large picture is scaled down.
        picture[cv2.dilate(odd.view(np.uint8), np.ones((3, 3), np.uint8)) > 0] = NOT_A_NUMBER
    return np.ascontiguousarray(picture)


def save(path: Path, picture: np.ndarray, odd: np.ndarray | None = None) -> None:
    """Write a picture of floats 0..1 or bytes as WebP, at most LONGEST pixels wide or high."""
    eight = _eight(picture, odd)
    factor = LONGEST / max(eight.shape[:2])
    if factor < 1:
        size = tuple(max(1, round(s * factor)) for s in eight.shape[1::-1])
        eight = cv2.resize(eight, size, interpolation=cv2.INTER_AREA)
    path.write_bytes(webp(eight, 92 if eight.shape[0] * eight.shape[1] > LOSSLESS else None))


def webp(eight: UInt8[np.ndarray, "h w 3"], quality: int | None) -> bytes:
    """A WebP file; `quality` None is lossless."""
    from PIL import Image

    buffer = io.BytesIO()
    options = dict(lossless=True, quality=0, method=0) if quality is None else dict(quality=quality, method=2)
    Image.fromarray(eight).save(buffer, "WEBP", **options)
    return buffer.getvalue()


def histogram(planes: Planes) -> str:
    """The histogram of both pictures as SVG: colours by luminance in stops relative to 0.18 without black pixels, data
    over the reference's range."""
    sides = []
    for values in (planes.reference[planes.mask], planes.test[planes.mask]):
        if planes.kind == "colour":
            bright = luminance(values)
            sides.append(np.log2(bright[bright > GREY * 2 ** STOPS[0]] / GREY))
        else:
            sides.append(values.mean(axis=-1))
    low, high = STOPS if planes.kind == "colour" else _range(planes)
    edges = np.linspace(low, high, 65)
    label = "stops about middle grey" if planes.kind == "colour" else "value"
    share = {}
    for name, values in zip(("reference", "test"), sides, strict=True):
        counts = np.histogram(np.clip(values, low, high), edges)[0]
        share[name] = (counts / max(len(values), 1)).tolist()
    middles = ((edges[:-1] + edges[1:]) / 2).tolist()
    text = svg(
        Chart(
            "values",
            share,
            x=middles,
            x_label=label,
            y_label="share of pixels that are not black" if planes.kind == "colour" else "share of pixels",
        )
    )
    style = "<style>text{font:11px sans-serif;fill:#777}.grid{stroke:#8884}</style>"
    return text.replace("<svg ", '<svg xmlns="http://www.w3.org/2000/svg" ', 1).replace("</svg>", style + "</svg>")


def worst_regions(
    error: Float[np.ndarray, "h w"], mask: Bool[np.ndarray, "h w"], count: int = 5
) -> tuple[tuple[int, int, int, int, float], ...]:
    """The disjoint windows of largest mean error (side: a sixteenth of the longer side, at least 16 pixels): x, y,
    width, height and mean error."""
    height, width = error.shape
    side = min(max(16, max(height, width) // 16), height, width)
    masked = np.where(mask, error, 0).astype(np.float32)
    means = cv2.boxFilter(masked, -1, (side, side), anchor=(0, 0), borderType=cv2.BORDER_CONSTANT)
    means = means[: height - side + 1, : width - side + 1].copy()
    regions = []
    for _ in range(count):
        y, x = np.unravel_index(int(means.argmax()), means.shape)
        if means[y, x] <= 0:
            break
        regions.append((int(x), int(y), side, side, float(means[y, x])))
        means[max(0, y - side + 1) : y + side, max(0, x - side + 1) : x + side] = -1
    return tuple(regions)
