"""What a user may choose about the painting of the surface."""

from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field


class PlainSettings(BaseModel):
    """The embedded stylizer's choices that do not depend on the painting."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    samples: int = Field(default=250_000, ge=500, le=4_000_000, description="surface samples of the finest level")
    stroke_scale: float = Field(
        default=1.0,
        ge=0.1,
        le=10.0,
        description="stroke size: 2 paints strokes twice as wide, for any `samples`",
    )
    relief: float = Field(
        default=1.7,
        ge=0.0,
        le=6.0,
        description="contrast of those strokes, in standard deviations of the painting's own",
    )
    glaze: float = Field(
        default=0.0,
        ge=0.0,
        le=1.0,
        description="share of what the strokes still lack in light and dark that is laid over them, where the painting "
        "has middle tones; 0 leaves the painting's own colours untouched",
    )
    keep_content: float = Field(
        default=0.5,
        ge=0.0,
        le=1.0,
        description="how much the light and dark of the asset's own texture count, against those of its shape",
    )
    liveliness: float = Field(
        default=0.8,
        ge=0.0,
        le=1.0,
        description="0 uses colours as often as the painting does, 1 prefers where it has strokes",
    )
    palette_mix: float = Field(
        default=0.0,
        ge=0.0,
        le=1.0,
        description="0 leaves colours the areas they have in the painting, 1 gives rare ones as much as common ones",
    )
    largest_piece: float = Field(
        default=1.0,
        gt=0.0,
        le=1.0,
        description="about how large a piece of the painting may be copied as it is, in shares of its long side: 0.1 "
        "breaks up faces, houses and lettering; 1 sets no bound",
    )
    variety: float = Field(
        default=0.016, ge=0.0, le=0.05, description="price of using a part of the painting more often than the others"
    )
    orientation: float = Field(
        default=0.02, ge=0.0, le=0.5, description="how strictly strokes follow the line field of the surface"
    )
    direction: Literal["curvature", "up", "around"] = Field(
        default="curvature",
        description="direction of strokes: the form, the vertical, or level lines around the object",
    )
    form: float = Field(
        default=0.0,
        ge=0.0,
        le=1.0,
        description="how much sky light and openness are painted into the albedo, for hand-painted looks; 0 keeps "
        "light out of it: parts take colours of their own, creases and ridges take strokes",
    )
    bake_light: float = Field(
        default=0.0,
        ge=0.0,
        le=1.0,
        description="share of a fixed key light, against the sky's, in the light that `form` paints",
    )


Levels = Annotated[int, Field(ge=2, le=8)]
Detail = Annotated[float, Field(ge=0.0, le=16.0)]
Palette = Annotated[float, Field(ge=0.0, le=8.0)]
Coherence = Annotated[float, Field(ge=0.0, le=0.2)]
Modelling = Annotated[float, Field(ge=0.0, le=1.0)]
LookUp = Literal["nearest", "bilinear"]
Borders = Literal["cut", "blend"]
Share = Annotated[float, Field(ge=0.0, le=0.4)]
Crop = Share | tuple[Share, Share, Share, Share]


class SurfaceSettings(PlainSettings):
    """The embedded stylizer's choices. Weights belong to the cost of `mistyle.stylization.surface.synthesis`.

    What is None is read from the painting (`mistyle.stylization.surface.exemplar.chosen.resolved`).
    """

    levels: Levels | None = Field(
        default=None,
        description="levels of the hierarchy at 250,000 samples; one more or less per factor of four of the samples or "
        "two of the strokes; unset: from the painting (5, or 6 for large units)",
    )
    detail: Detail | None = Field(
        default=None,
        description="how strongly creases and ridges demand dark and light strokes; unset: from the painting "
        "(4, down to 3 for flat ones)",
    )
    palette: Palette | None = Field(
        default=None,
        description="how strictly a place takes the colour that optimal transport gave it; unset: from the painting "
        "(0.2, down to 0.05 for graphic ones)",
    )
    stroke_coherence: Coherence | None = Field(
        default=None,
        description="price of leaving a stroke: higher copies larger pieces of the painting; unset: from the painting "
        "(0.08 for brushwork, up to 0.1 for graphic ones)",
    )
    modelling: Modelling | None = Field(
        default=None,
        description="how much every hollow and bump attracts dark and light strokes, beside creases and ridges; unset: "
        "from the painting (1 for brushwork, down to 0 for graphic ones)",
    )
    look_up: LookUp | None = Field(
        default=None,
        description="how pixels of the painting are looked up; unset: nearest for pixel art, else bilinear",
    )
    borders: Borders | None = Field(
        default=None,
        description="how pieces of the painting meet: cut along an edge, or blended; unset: cut for graphic paintings, "
        "else blend",
    )
    crop: Crop | None = Field(
        default=None,
        description="share of the picture left out along each border (frames, paper), or four of them: top, left, "
        "bottom, right; unset: the borders that the picture shows",
    )


class ResolvedSettings(PlainSettings):
    """`SurfaceSettings` with every choice made."""

    levels: Levels
    detail: Detail
    palette: Palette
    stroke_coherence: Coherence
    modelling: Modelling
    look_up: LookUp
    borders: Borders
    crop: tuple[Share, Share, Share, Share]


class PaintSettings(BaseModel):
    """Where the paint goes and what it leaves."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    slots: tuple[str, ...] = Field(
        default=(),
        description="further pictures: SLOT=PICTURE, SLOT being a material of the mesh or a mask picture in its UVs",
    )
    style_mask: Path | None = Field(default=None, description="picture as large as the style: dark parts are not used")
    direction_map: Path | None = Field(
        default=None,
        description="picture in the mesh's UVs: red and green are the strokes' direction along u and v, as in engines' "
        "flow maps; mid grey and transparent parts leave it to `surface.direction`",
    )
    protect: Path | None = Field(default=None, description="picture in the mesh's UVs: light parts keep their own look")
    stroke_size: float | None = Field(
        default=None,
        gt=0,
        description="width of a stroke in the mesh's own units, a 32nd of the picture's long side; sets stroke_scale",
    )
    height: float | None = Field(
        default=None,
        ge=0,
        le=1,
        description="slope (root mean square) of the painting's relief in the normal map; 0.15 by default",
    )
    gloss: float | None = Field(
        default=None,
        ge=0,
        le=2,
        description="how much grooves and crests change the roughness; 1 by default",
    )
