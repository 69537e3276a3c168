"""Which settings a painting asks for: the table of `mistyle/stylization/README.md` as functions of its reading."""

import numpy as np
from jaxtyping import Float

from mistyle.stylization.surface.exemplar.reading import StyleReading, read_style
from mistyle.stylization.surface.settings import ResolvedSettings, SurfaceSettings

FROM_PAINTING = ("levels", "detail", "palette", "stroke_coherence", "modelling", "look_up", "borders", "crop")
FLAT_SHARE = 0.2  # of the area in flat regions from which on a painting is wholly flat
FEW_TONES = 2
LINED = (0.6, 0.75)  # line-likeness at which a painting begins to be graphic, and at which it wholly is
RIGHT_ANGLED = (0.1, 0.3)  # the same for how rectilinear it is
CLEAR = (0.25, 0.5)  # the same for the clarity of its unit
GRAPHIC = 0.5  # from which on pieces are cut
LARGE_UNIT = 0.2  # in long sides: a unit that five levels do not see
COHERENCE = (0.08, 0.1)  # brushwork, graphic
DETAIL = (4.0, 3.0)  # modelled, flat
PALETTE = (0.2, 0.05)  # brushwork, graphic


def flat(reading: StyleReading) -> float:
    """How flat a painting is, 0..1: areas of one colour, few tones, or pixel art."""
    if min(reading.pixel_grid) > 0 or reading.tones <= FEW_TONES:
        return 1.0
    return float(np.clip(reading.flatness / FLAT_SHARE, 0, 1))


def graphic(reading: StyleReading) -> float:
    """How much a painting lives by structure, 0..1: flat areas, lines, right angles, a clear unit."""
    lined = np.interp(reading.line_likeness, LINED, (0, 1))
    square = np.interp(reading.rectilinear, RIGHT_ANGLED, (0, 1))
    clear = np.interp(reading.clarity, CLEAR, (0, 1))
    return float(max(flat(reading), lined, square, clear))


def from_painting(reading: StyleReading) -> dict[str, object]:
    """The value of every setting of FROM_PAINTING that the painting asks for."""
    share = graphic(reading)
    return {
        "levels": 6 if reading.unit > LARGE_UNIT else 5,
        "detail": between(DETAIL, flat(reading)),
        "palette": between(PALETTE, share),
        "stroke_coherence": between(COHERENCE, share),
        "modelling": round(1 - share, 2),
        "look_up": "nearest" if min(reading.pixel_grid) > 0 else "bilinear",
        "borders": "cut" if share >= GRAPHIC else "blend",
        "crop": reading.border,
    }


def between(ends: tuple[float, float], share: float) -> float:
    """From the first end to the second, geometrically, to three digits."""
    return float(f"{ends[0] * (ends[1] / ends[0]) ** share:.3g}")


def is_open(settings: SurfaceSettings | ResolvedSettings) -> bool:
    """Whether a setting is left to the painting."""
    return any(getattr(settings, name) is None for name in FROM_PAINTING)


def resolved(settings: SurfaceSettings, reading: StyleReading | None) -> ResolvedSettings:
    """The settings with all that was left open taken from the reading; none is needed where nothing is open."""
    own: dict[str, object] = {name: value for name, value in settings.model_dump().items() if value is not None}
    if isinstance(own.get("crop"), float):
        own["crop"] = (own["crop"],) * 4
    if is_open(settings):
        if reading is None:
            raise ValueError("settings are open, so a reading of the painting is needed")
        own = from_painting(reading) | own
    return ResolvedSettings.model_validate(own)


def settled(
    rgb: Float[np.ndarray, "h w 3"],
    alpha: Float[np.ndarray, "h w"] | None,
    settings: SurfaceSettings | ResolvedSettings,
    reading: StyleReading | None = None,
) -> ResolvedSettings:
    """The settings with every choice made; reads the picture (encoded sRGB) where one is open and no reading given."""
    if isinstance(settings, ResolvedSettings):
        return settings
    if reading is None and is_open(settings):
        reading = read_style(rgb, alpha)
    return resolved(settings, reading)
