"""What a user may choose about the painting of the surface."""

from pathlib import Path
from typing import Literal

from pydantic import BaseModel, ConfigDict, Field


class SurfaceSettings(BaseModel):
    """The embedded stylizer's choices. Weights belong to the cost of `mistyle.surface.synthesis`."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    samples: int = Field(
        default=250_000, ge=500, le=4_000_000, description="surface samples asked for on the finest level"
    )
    levels: int = Field(
        default=5,
        ge=2,
        le=8,
        description="levels of the hierarchy at 250,000 samples; one more or less per factor of four",
    )
    style_scale: float = Field(
        default=1.0,
        ge=0.1,
        le=10.0,
        description="stroke size: 2 paints with strokes twice as wide, whatever `samples` says",
    )
    detail: float = Field(
        default=4.0, ge=0.0, le=16.0, description="how strongly cavities and ridges demand dark and light strokes"
    )
    relief: float = Field(
        default=1.7,
        ge=0.0,
        le=6.0,
        description="contrast of those strokes, in standard deviations of the painting's own",
    )
    glaze: float = Field(
        default=0.8,
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
    palette: float = Field(
        default=0.2, ge=0.0, le=8.0, description="how strictly a place takes the colour that optimal transport gave it"
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
    stroke_coherence: float = Field(
        default=0.01,
        ge=0.0,
        le=0.05,
        description="price of leaving a stroke: higher copies larger pieces of the painting",
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
        description="what strokes follow: the form, the vertical, or level lines around the object",
    )
    bake_light: float = Field(
        default=0.0,
        ge=0.0,
        le=1.0,
        description="share of a fixed key light in the tone; 0 keeps light out of the albedo",
    )
    crop: float = Field(
        default=0.0, ge=0.0, le=0.4, description="share of the picture left out along each border (frames, signatures)"
    )


class CoatSettings(BaseModel):
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
        description="width of a stroke in the mesh's own units, a 32nd of the picture's long side; sets style_scale",
    )
    height: float | None = Field(
        default=None,
        ge=0,
        le=1,
        description="slope (root mean square) of the painting's relief in the normal map that the fit begins with, or "
        "that is final where nothing is fitted; 0.15 by default",
    )
    gloss: float | None = Field(
        default=None,
        ge=0,
        le=2,
        description="how much grooves and crests change the first roughness; 0.5 by default, 1 where nothing is fitted",
    )
