"""HTML for notebooks: tables and thumbnails of results, self-contained."""

from collections.abc import Iterable, Mapping, Sequence
from html import escape
from typing import Any

import numpy as np
from jaxtyping import Float, Shaped

from mistyle.core.image import srgb_from_linear
from mistyle.core.maps import Maps

THUMBNAIL = 144  # pixels


def number(value: Any) -> str:
    """Four digits of a float; other values as text."""
    return f"{value:.4g}" if isinstance(value, float | np.floating) else str(value)


def table(head: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    """A table; every cell is escaped, numbers are right-aligned."""
    top = "".join(f"<th style='text-align:left'>{escape(name)}</th>" for name in head)
    body = []
    for row in rows:
        cells = [
            f"<td style='text-align:{'right' if isinstance(cell, float | int) else 'left'}'>{escape(number(cell))}</td>"
            for cell in row
        ]
        body.append(f"<tr>{''.join(cells)}</tr>")
    return f"<table><thead><tr>{top}</tr></thead><tbody>{''.join(body)}</tbody></table>" if body else ""


def thumbnails(pictures: Mapping[str, Shaped[np.ndarray, "h w *c"]], longest: int = THUMBNAIL) -> str:
    """Pictures (sRGB 0..1, or 8 bit) in a row with their names below, as data URIs of WebP files."""
    from mistyle.jobs.report.pictures import webp

    figures = []
    for name, picture in pictures.items():
        small = webp(picture, longest)
        image = f"<img src='{small.uri}' width='{small.width}' height='{small.height}' alt='{escape(name)}'>"
        figures.append(f"<td style='text-align:center;vertical-align:bottom'>{image}<br>{escape(name)}</td>")
    return f"<table><tbody><tr>{''.join(figures)}</tr></tbody></table>" if figures else ""


def page(title: str, *parts: str, notes: Sequence[str] = ()) -> str:
    """A title, parts and notes in one block."""
    items = "".join(f"<li>{escape(note)}</li>" for note in notes)
    listed = f"<ul>{items}</ul>" if items else ""
    return f"<div><strong>{escape(title)}</strong>{''.join(parts)}{listed}</div>"


def map_pictures(maps: Maps) -> dict[str, Float[np.ndarray, "_ _ *c"]]:
    """The maps of a texture set as sRGB pictures; the normal map as (n + 1) / 2, data maps as they are."""
    normal = (maps.normal * np.float32(0.5) + np.float32(0.5)).astype(np.float32)
    encoded = {"albedo": srgb_from_linear(maps.albedo), "normal": normal}
    return encoded | {"roughness": maps.roughness, "metallic": maps.metallic}
