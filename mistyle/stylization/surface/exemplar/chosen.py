"""Settings derived from a painting's measures: the table of `mistyle/stylization/README.md` as functions."""

import numpy as np
from jaxtyping import Float

from mistyle.stylization.surface.exemplar.reading import StyleReading, read_style
from mistyle.stylization.surface.settings import ResolvedSettings, SurfaceSettings

FROM_PAINTING = ("levels", "detail", "palette", "stroke_coherence", "modelling", "look_up", "borders", "crop", "omit")
FLAT_SHARE = 0.2  # share of flat area at which `flat` reaches 1
FEW_TONES = 2
LINED = (0.6, 0.75)  # line-likeness at which its term of `graphic` is 0 and 1
RIGHT_ANGLED = (0.1, 0.3)  # the same for `rectilinear`
CLEAR = (0.25, 0.5)  # the same for the clarity of its unit
TILED = (0.12, 0.3)  # the same for `tiled`
GRAPHIC = 0.5  # value of `graphic` from which pieces are cut
LARGE_UNIT = 0.2  # in long sides: a unit too large for five levels
COHERENCE = (0.08, 0.1)  # brushwork, graphic
DETAIL = (4.0, 3.0)  # modelled, flat
PALETTE = (0.2, 0.05)  # brushwork, graphic


def flat(reading: StyleReading) -> float:
    """Flatness 0..1 of a painting: areas of one colour, few tones, or pixel art."""
    if min(reading.pixel_grid) > 0 or reading.tones <= FEW_TONES:
        return 1.0
    return float(np.clip(reading.flatness / FLAT_SHARE, 0, 1))


def graphic(reading: StyleReading) -> float:
    """Graphic structure 0..1 of a painting: flat areas, lines, right angles, tiles, a clear unit."""
    lined = np.interp(reading.line_likeness, LINED, (0, 1))
    square = np.interp(reading.rectilinear, RIGHT_ANGLED, (0, 1))
    clear = np.interp(reading.clarity, CLEAR, (0, 1))
    tiles = np.interp(reading.tiled, TILED, (0, 1))
    return float(max(flat(reading), lined, square, tiles, clear))


def from_painting(reading: StyleReading) -> dict[str, object]:
    """The derived value of every setting of FROM_PAINTING."""
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
        "omit": reading.lettering,
    }


def between(ends: tuple[float, float], share: float) -> float:
    """Geometric interpolation between two ends, rounded to three digits."""
    return float(f"{ends[0] * (ends[1] / ends[0]) ** share:.3g}")


def is_open(settings: SurfaceSettings | ResolvedSettings) -> bool:
    """Whether any setting is derived from the painting."""
    return any(getattr(settings, name) is None for name in FROM_PAINTING)


def resolved(settings: SurfaceSettings, reading: StyleReading | None) -> ResolvedSettings:
    """The settings with unset ones derived from the reading; it may be None if all are set."""
    own: dict[str, object] = {name: value for name, value in settings.model_dump().items() if value is not None}
    if isinstance(own.get("crop"), float):
        own["crop"] = (own["crop"],) * 4
    if is_open(settings):
        if reading is None:
            raise ValueError("some settings are unset, so a reading of the painting is needed")
        own = from_painting(reading) | own
    return ResolvedSettings.model_validate(own)


def settled(
    rgb: Float[np.ndarray, "h w 3"],
    alpha: Float[np.ndarray, "h w"] | None,
    settings: SurfaceSettings | ResolvedSettings,
    reading: StyleReading | None = None,
) -> ResolvedSettings:
    """The settings with unset ones derived; measures the picture (encoded sRGB) if needed and `reading` is None."""
    if isinstance(settings, ResolvedSettings):
        return settings
    if reading is None and is_open(settings):
        reading = read_style(rgb, alpha)
    return resolved(settings, reading)
