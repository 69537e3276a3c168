"""What a user may choose about the painting of the surface."""

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
        default=2.0, ge=0.0, le=8.0, description="how strongly cavities and ridges demand dark and light strokes"
    )
    relief: float = Field(
        default=1.8,
        ge=0.0,
        le=4.0,
        description="contrast of those strokes, in standard deviations of the painting's own",
    )
    palette: float = Field(
        default=1.0, ge=0.0, le=8.0, description="how strictly a place takes the colour that optimal transport gave it"
    )
    liveliness: float = Field(
        default=0.8,
        ge=0.0,
        le=1.0,
        description="0 uses colours as often as the painting does, 1 prefers where it has strokes",
    )
    stroke_coherence: float = Field(
        default=0.005,
        ge=0.0,
        le=0.05,
        description="price of leaving a stroke: higher copies larger pieces of the painting",
    )
    variety: float = Field(
        default=0.003, ge=0.0, le=0.05, description="price of using a part of the painting more often than the others"
    )
    orientation: float = Field(
        default=0.02, ge=0.0, le=0.5, description="how strictly strokes follow the line field of the surface"
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
