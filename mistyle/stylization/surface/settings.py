"""Settings of the surface painter."""

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field

from mistyle.core.settings import FrozenModel


class PlainSettings(FrozenModel):
    """Settings of the embedded stylizer that do not depend on the painting."""

    samples: int = Field(default=250_000, ge=500, le=4_000_000)
    """surface samples of the finest level"""
    stroke_scale: float = Field(default=1.0, ge=0.1, le=10.0)
    """stroke size: 2 paints strokes twice as wide, for any `samples`"""
    relief: float = Field(default=1.7, ge=0.0, le=6.0)
    """contrast of detail strokes, in standard deviations of the painting's own"""
    glaze: float = Field(default=0.0, ge=0.0, le=1.0)
    """share of the strokes' tone error that a smooth glaze corrects, if the painting has middle tones; 0 keeps the
    painting's own colours"""
    keep_content: float = Field(default=0.5, ge=0.0, le=1.0)
    """weight of the own texture's light and dark, against those of the shape"""
    liveliness: float = Field(default=0.8, ge=0.0, le=1.0)
    """0 uses colours as often as the painting does, 1 prefers areas with strokes"""
    palette_mix: float = Field(default=0.0, ge=0.0, le=1.0)
    """0 keeps each colour's share of the painting's area, 1 gives rare colours as much as common ones"""
    largest_piece: float = Field(default=1.0, gt=0.0, le=1.0)
    """approximate largest copied piece of the painting, in shares of its long side: 0.1 breaks up faces, houses and
    lettering; 1 sets no bound"""
    variety: float = Field(default=0.016, ge=0.0, le=0.05)
    """price of using a part of the painting more often than the others"""
    orientation: float = Field(default=0.02, ge=0.0, le=0.5)
    """weight of the surface's line field in the strokes' direction"""
    direction: Literal["curvature", "up", "around"] = "curvature"
    """direction of strokes: the form, the vertical, or level lines around the object"""
    form: float = Field(default=0.0, ge=0.0, le=1.0)
    """share of sky light and openness in the albedo, for hand-painted looks; 0: no light, so parts take colours of
    their own, creases and ridges take strokes"""
    bake_light: float = Field(default=0.0, ge=0.0, le=1.0)
    """share of a fixed key light, against the sky's, in the light that `form` paints"""


Levels = Annotated[int, Field(ge=2, le=8)]
Detail = Annotated[float, Field(ge=0.0, le=16.0)]
Palette = Annotated[float, Field(ge=0.0, le=8.0)]
Coherence = Annotated[float, Field(ge=0.0, le=0.2)]
Modelling = Annotated[float, Field(ge=0.0, le=1.0)]
LookUp = Literal["nearest", "bilinear"]
Borders = Literal["cut", "blend"]
Share = Annotated[float, Field(ge=0.0, le=0.4)]
Crop = Share | tuple[Share, Share, Share, Share]
Place = Annotated[float, Field(ge=0.0, le=1.0)]
Boxes = tuple[tuple[Place, Place, Place, Place], ...]


class SurfaceSettings(PlainSettings):
    """Settings of the embedded stylizer. Weights refer to the cost of `mistyle.stylization.surface.synthesis`.

    None: derived from the painting (`mistyle.stylization.surface.exemplar.chosen.resolved`).
    """

    levels: Levels | None = None
    """levels of the hierarchy at 250,000 samples; one more or less per factor of four of the samples or two of the
    strokes; unset: from the painting (5, or 6 for large units)"""
    detail: Detail | None = None
    """weight of dark and light strokes at creases and ridges; unset: from the painting (4, down to 3 for flat ones)"""
    palette: Palette | None = None
    """weight of the colour that optimal transport assigns to a place; unset: from the painting (0.2, down to 0.05 for
    graphic ones)"""
    stroke_coherence: Coherence | None = None
    """price of leaving a stroke: higher copies larger pieces of the painting; unset: from the painting (0.08 for
    brushwork, up to 0.1 for graphic ones)"""
    modelling: Modelling | None = None
    """weight of dark and light strokes at all hollows and bumps, besides creases and ridges; unset: from the painting
    (1 for brushwork, down to 0 for graphic ones)"""
    look_up: LookUp | None = None
    """filter of look-ups in the painting; unset: nearest for pixel art, else bilinear"""
    borders: Borders | None = None
    """borders between pieces of the painting: cut along an edge, or blended; unset: cut for graphic paintings, else
    blend"""
    crop: Crop | None = None
    """share of the picture left out along each border (frames, paper), or four of them: top, left, bottom, right;
    unset: the detected borders"""
    omit: Boxes | None = None
    """boxes of the picture that are not copied: top, left, bottom, right, in shares of its height and width; unset:
    detected titles, signatures and cartouches; [] copies everything"""


class ResolvedSettings(PlainSettings):
    """`SurfaceSettings` without None."""

    levels: Levels
    detail: Detail
    palette: Palette
    stroke_coherence: Coherence
    modelling: Modelling
    look_up: LookUp
    borders: Borders
    crop: tuple[Share, Share, Share, Share]
    omit: Boxes


class PaintSettings(FrozenModel):
    """Placement of pictures, protected areas, stroke size, relief and gloss."""

    slots: tuple[str, ...] = ()
    """further pictures: SLOT=PICTURE, where SLOT is a material of the mesh or a mask picture in its UVs"""
    style_mask: Path | None = None
    """picture as large as the style: dark parts are not used"""
    direction_map: Path | None = None
    """picture in the mesh's UVs: red and green are the strokes' direction along u and v, as in engines' flow maps; mid
    grey and transparent parts use `surface.direction`"""
    protect: Path | None = None
    """picture in the mesh's UVs: light parts keep their own look"""
    stroke_size: float | None = Field(default=None, gt=0)
    """width of a stroke in the mesh's own units, a 32nd of the picture's long side; sets stroke_scale"""
    height: float | None = Field(default=None, ge=0, le=1)
    """slope (root mean square) of the painting's relief in the normal map; 0.15 by default"""
    gloss: float | None = Field(default=None, ge=0, le=2)
    """weight of the roughness change at grooves and crests; 1 by default"""
