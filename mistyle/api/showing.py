"""Pictures and maps side by side, as one PNG for a notebook or a file."""

import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8

from mistyle.api import html
from mistyle.api.drawing import Views, straight
from mistyle.core.image import linear_from_srgb, srgb_from_linear
from mistyle.core.maps import Maps
from mistyle.core.view import View

GROUND = 0.0275  # linear grey behind pictures with alpha


@dataclass(frozen=True)
class Gallery:
    """A finished sheet: 8-bit sRGB (h, w, 3)."""

    pixels: UInt8[np.ndarray, "h w 3"]

    def _repr_png_(self) -> bytes:
        from PIL import Image

        buffer = io.BytesIO()
        Image.fromarray(self.pixels).save(buffer, "PNG", optimize=True)
        return buffer.getvalue()

    def save(self, path: str | PathLike) -> Path:
        """Write the sheet as a PNG file, replacing an existing one; returns its path."""
        from mistyle.io.store.atomic import atomic_write

        atomic_write(Path(path), self._repr_png_())
        return Path(path)


def gallery(rows: Mapping[str, Any], size: int = 160, *, names: Sequence[str] = (), exposure: float = 1.0) -> Gallery:
    """Rows of pictures under their headings.

    rows      by heading: a `Maps` record (albedo, normal, roughness, metallic), `Views`, or a sequence of `View`s and
              arrays. Arrays (h, w, 3) are linear Rec.709; (h, w) are data 0..1, shown unchanged
    size      pixels of the longer side of every picture; larger pictures are averaged, smaller ones enlarged
    names     captions of the arrays, column by column
    exposure  factor of the radiance of views and colour arrays

    Colours above 1 clip, without a tone curve.
    """
    from mistyle.deliver.lookdev.canvas import Panel, PanelRow, Sheet, compose, measures

    scale = size / 200
    gutter = measures(scale)["gutter"]
    panel_rows = []
    for heading, content in rows.items():
        panels = [Panel(_fitted(picture, size), name) for name, picture in _pictures(content, names, exposure)]
        panel_rows.append(PanelRow(heading, tuple(panels)))
    widths = [sum(p.picture.shape[1] for p in row.panels) + gutter * (len(row.panels) - 1) for row in panel_rows]
    # Equal gutters: a shorter row is padded to the width of the longest.
    full = [
        PanelRow(row.heading, (*row.panels, *_blank(row, max(widths) - width, gutter)))
        for row, width in zip(panel_rows, widths, strict=True)
    ]
    sheet = compose(Sheet("", (), tuple(full)), max(widths), scale)
    m = measures(scale)
    # The sheet's title and foot, which are empty.
    head = m["margin"] + round(m["title"] * 1.35) + m["row_gap"] - m["gutter"]
    foot = round(m["line"] * 1.2) + m["row_gap"]
    return Gallery(np.round(srgb_from_linear(np.clip(sheet[head:-foot], 0, 1)) * 255).astype(np.uint8))


def _blank(row: Any, missing: int, gutter: int) -> tuple[Any, ...]:
    from mistyle.deliver.lookdev.canvas import GROUND as BETWEEN
    from mistyle.deliver.lookdev.canvas import Panel

    if missing <= gutter or not row.panels:
        return ()
    height = row.panels[0].picture.shape[0]
    return (Panel(np.full((height, missing - gutter, 3), BETWEEN, np.float32), ""),)


def _pictures(content: Any, names: Sequence[str], exposure: float) -> list[tuple[str, np.ndarray]]:
    """Captions and sRGB pictures, with or without alpha."""
    if isinstance(content, Maps):
        return list(html.map_pictures(content).items())
    pictures = []
    for k, one in enumerate(content.views if isinstance(content, Views) else content):
        caption = names[k] if k < len(names) else one.camera.name if isinstance(one, View) else ""
        if isinstance(one, View):
            scaled = View(**{**vars(one), "rgb": (one.rgb * np.float32(exposure)).astype(np.float32)})
            pictures.append((caption, straight(scaled)))
        elif one.ndim == 2:
            pictures.append((caption, one.astype(np.float32)))
        else:
            pictures.append((caption, srgb_from_linear(np.asarray(one[..., :3] * exposure, np.float32))))
    return pictures


def _fitted(picture: np.ndarray, size: int) -> np.ndarray:
    """An sRGB picture as linear rgb on the ground, its longer side `size` pixels."""
    from mistyle.core.image import resize

    values = picture[..., None] if picture.ndim == 2 else picture
    alpha = values[..., 3:] if values.shape[2] == 4 else np.ones((*values.shape[:2], 1), np.float32)
    rgb = np.broadcast_to(values[..., :3], (*values.shape[:2], 3)).astype(np.float32)
    linear = linear_from_srgb(np.clip(rgb, 0, 1)) * alpha + np.float32(GROUND) * (1 - alpha)
    height, width = (max(1, round(side * size / max(rgb.shape[:2]))) for side in rgb.shape[:2])
    return resize(linear.astype(np.float32), (height, width))
