"""The canvas of a look-dev sheet: linear pictures and text on a dark ground, laid out in rows."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Float

from mistyle.core.image import linear_from_srgb

GROUND, PANEL = 0.0115, 0.0275  # linear greys of the sheet and of a panel
FINE = 3
INK, SOFT = 0.80, 0.33  # linear greys of captions and of details


@dataclass(frozen=True)
class Panel:
    """A linear picture (h w 3) with a caption and a remark after it."""

    picture: Float[np.ndarray, "h w 3"]
    caption: str
    remark: str = ""


@dataclass(frozen=True)
class PanelRow:
    """Panels of one height side by side under a heading."""

    heading: str
    panels: tuple[Panel, ...]


@dataclass(frozen=True)
class Sheet:
    """A title, lines below it, rows of panels, and a line at the foot."""

    title: str
    lines: tuple[str, ...]
    rows: tuple[PanelRow, ...] = field(default_factory=tuple)
    foot: str = ""


def measures(scale: float) -> dict[str, int]:
    """Distances and type sizes in pixels."""
    usual = dict(margin=44, gutter=16, title=46, line=22, heading=22, caption=20, caption_room=42, row_gap=30)
    return {name: max(1, round(value * scale)) for name, value in usual.items()}


def panel_widths(count: int, width: int, gutter: int) -> int:
    """The width in pixels of each of `count` equal panels in a row of `width` pixels."""
    return (width - (count - 1) * gutter) // count


def compose(sheet: Sheet, width: int, scale: float) -> Float[np.ndarray, "h w 3"]:
    """The sheet as a linear picture; `width` is that of the rows."""
    from PIL import Image, ImageDraw

    m = measures(scale)
    heights = [max(p.picture.shape[0] for p in row.panels) for row in sheet.rows]
    head = m["margin"] + round(m["title"] * 1.35) + len(sheet.lines) * round(m["line"] * 1.5) + m["row_gap"]
    each = round(m["heading"] * 1.9) + m["caption_room"] + m["row_gap"]
    total = head + sum(heights) + each * len(sheet.rows) + round(m["line"] * 1.2) + m["margin"] // 2
    canvas = np.full((total, width + 2 * m["margin"], 3), GROUND, np.float32)
    ink, soft = (Image.new("L", (FINE * canvas.shape[1], FINE * total)) for _ in range(2))
    write, whisper = (Pen(ImageDraw.Draw(layer)) for layer in (ink, soft))
    left, right, y = m["margin"], m["margin"] + width, m["margin"]
    write.text((left, y), sheet.title, m["title"])
    y += round(m["title"] * 1.35)
    for line in sheet.lines:
        whisper.text((left, y), fitted(line, m["line"], width), m["line"])
        y += round(m["line"] * 1.5)
    y += m["row_gap"]
    for row, height in zip(sheet.rows, heights, strict=True):
        write.text((left, y), row.heading, m["heading"])
        y += round(m["heading"] * 1.9)
        free = width - sum(p.picture.shape[1] for p in row.panels)
        for k, panel in enumerate(row.panels):
            h, w = panel.picture.shape[:2]
            taken = sum(p.picture.shape[1] for p in row.panels[:k])
            x = left + taken + (free * k // (len(row.panels) - 1) if k else 0)
            canvas[y : y + h, x : x + w] = panel.picture
            below = y + height + m["caption"] // 2
            write.text((x, below), fitted(panel.caption, m["caption"], w), m["caption"])
            if panel.remark:
                beside_it = x + write.width(panel.caption, m["caption"]) + m["caption"] * 2 // 3
                whisper.text((beside_it, below), panel.remark, m["caption"])
        y += height + m["caption_room"] + m["row_gap"]
    whisper.text((left, y), fitted(sheet.foot, m["caption"], right - left), m["caption"])
    for layer, grey in ((ink, INK), (soft, SOFT)):
        # Gamma-decoded coverage of the glyphs: light type on a dark ground keeps its weight.
        layer = layer.reduce(FINE)
        share = linear_from_srgb(np.asarray(layer, np.float32) / 255)[..., None]
        canvas = canvas * (1 - share) + grey * share
    return canvas.astype(np.float32)


class Pen:
    """Writes text on a layer of FINE times the sheet's resolution: small type keeps its spacing."""

    def __init__(self, draw: Any) -> None:
        self.draw = draw

    def text(self, place: tuple[int, int], text: str, size: int) -> None:
        x, y = place
        self.draw.text((FINE * x, FINE * y), text, 255, font=font(FINE * size))

    def width(self, text: str, size: int) -> int:
        """The width of a text in pixels of the sheet."""
        return round(font(FINE * size).getlength(text) / FINE)


def font(size: int):
    """Pillow's built-in font (Aileron), the same on every machine."""
    from PIL import ImageFont

    return ImageFont.load_default(size)


def fitted(text: str, size: int, width: int) -> str:
    """The text, or its beginning and an ellipsis where it is wider than `width` pixels."""
    chosen, width = font(FINE * size), FINE * width
    if chosen.getlength(text) <= width:
        return text
    while text and chosen.getlength(text + "…") > width:
        text = text[:-1]
    return text + "…"


def beside(pictures: Sequence[Float[np.ndarray, "h _ 3"]]) -> Float[np.ndarray, "h _ 3"]:
    """Pictures of one height side by side without a gap."""
    return np.concatenate(list(pictures), axis=1).astype(np.float32)
