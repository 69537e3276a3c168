"""Pictures for the report: small WebP files as data URIs, and a painting's palette."""

import base64
import io
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Shaped, UInt8

BAND = 256  # rows


@dataclass(frozen=True)
class Sizes:
    """Longest side in pixels of each kind of picture, at `scale` of the usual."""

    scale: float = 1.0

    def of(self, kind: str) -> int:
        usual = {"painting": 960, "frame": 560, "view": 420, "pair": 900, "picture": 720, "map": 1280, "texture": 1024}
        return max(48, round(usual[kind] * self.scale))


def kind_in_step(columns: int) -> str:
    """The kind of a picture in a row of `columns`."""
    return "view" if columns > 2 else "picture"


def kind_of_maps(sets: int) -> str:
    """The kind of the maps of a mesh with `sets` texture sets."""
    return "map" if sets < 3 else "picture"


def eight_bit(picture: Shaped[np.ndarray, "h w *c"]) -> UInt8[np.ndarray, "h w n"]:
    """Any picture of the report as uint8 rgb or rgba: floats and bools from 0..1, grey spread over three channels."""
    if picture.dtype != np.uint8:
        clean = np.nan_to_num(picture.astype(np.float32), nan=0.0, posinf=1.0, neginf=0.0)
        picture = np.round(np.clip(clean, 0, 1) * 255).astype(np.uint8)
    if picture.ndim == 2:
        picture = picture[..., None]
    channels = picture.shape[2]
    if channels not in (1, 2, 3, 4) or 0 in picture.shape:
        raise ValueError(f"a picture of shape {picture.shape}: expected 1 to 4 channels and at least one pixel")
    if channels < 3:
        picture = np.concatenate([np.repeat(picture[..., :1], 3, axis=2), picture[..., 1:]], axis=2)
    return np.ascontiguousarray(picture)


@dataclass(frozen=True)
class Inline:
    """A picture as a data URI, with its size in pixels."""

    uri: str
    width: int
    height: int


def webp(picture: Shaped[np.ndarray, "h w *c"], longest: int, quality: int = 84, sharp: bool = False) -> Inline:
    """The picture as a WebP file, scaled down to `longest` pixels where larger; `sharp` is lossless."""
    from PIL import Image

    image = _fitted(Image.fromarray(eight_bit(picture)), longest, sharp)
    buffer = io.BytesIO()
    image.save(buffer, "WEBP", quality=quality, lossless=sharp, method=4)
    return Inline("data:image/webp;base64," + base64.b64encode(buffer.getvalue()).decode(), *image.size)


# Exponents of a picture's bytes over its pixels, below 1 because a finer picture is smoother.
GROWTH, GROWTH_SHARP = 0.87, 0.8


class Encoder:
    """`webp` for a page: a repeated picture is encoded once. A class because it caches the results."""

    def __init__(self, scale: float) -> None:
        self._scale = scale
        self._made: dict[tuple[Any, ...], tuple[Any, Inline]] = {}

    def __call__(
        self, picture: Shaped[np.ndarray, "h w *c"], longest: int, quality: int = 84, sharp: bool = False
    ) -> Inline:
        key = (id(picture), longest, quality, sharp)
        if key not in self._made:
            self._made[key] = picture, webp(picture, longest, quality, sharp)
        return self._made[key][1]

    def growth(self, scale: float) -> float:
        """The estimated growth of the pictures' bytes at another scale."""
        more = 0.0
        for (_, longest, _, sharp), (picture, inline) in self._made.items():
            side = min(max(picture.shape[:2]), longest * scale / self._scale)
            pixels = (side / max(inline.width, inline.height)) ** 2
            more += len(inline.uri) * (pixels ** (GROWTH_SHARP if sharp else GROWTH) - 1)
        return more


def in_bands(
    shape: tuple[int, int], make: Callable[[slice], np.ndarray], longest: int, sharp: bool = False
) -> UInt8[np.ndarray, "h w n"]:
    """The picture of `shape` (height, width) whose rows `make` gives, as `webp` would show it at `longest` pixels.

    At most BAND rows at a time take more than a byte per channel: maps may be much larger than their pictures.
    """
    from PIL import Image

    whole = None
    for top in range(0, shape[0], BAND):
        band = Image.fromarray(eight_bit(make(slice(top, top + BAND))))
        whole = whole or Image.new(band.mode, (shape[1], shape[0]))
        whole.paste(band, (0, top))
    if whole is None:
        raise ValueError(f"a picture of shape {shape}: expected at least one pixel")
    return np.asarray(_fitted(whole, longest, sharp))


def _fitted(image: Any, longest: int, sharp: bool) -> Any:
    """A Pillow image scaled down to `longest` pixels where larger; `sharp` takes means of whole pixels."""
    from PIL import Image

    factor = longest / max(image.size)
    if factor >= 1:
        return image
    width, height = (max(1, round(side * factor)) for side in image.size)
    return image.resize((width, height), Image.Resampling.BOX if sharp else Image.Resampling.LANCZOS)


def palette(picture: Shaped[np.ndarray, "h w *c"], count: int = 7) -> list[str]:
    """The picture's main colours as '#rrggbb' from dark to light: median cut, then the mean of each box."""
    from PIL import Image

    small = Image.fromarray(eight_bit(picture)[..., :3])
    small.thumbnail((160, 160))
    pixels = np.asarray(small).reshape(-1, 3)
    index = np.asarray(small.quantize(count, Image.Quantize.MEDIANCUT, dither=Image.Dither.NONE)).reshape(-1)
    colours = [np.round(pixels[index == k].mean(axis=0)).astype(int) for k in np.unique(index)]
    colours.sort(key=lambda c: relative_luminance(c))
    return [hexadecimal(c) for c in colours]


def accents(colours: list[str]) -> dict[str, str]:
    """One accent colour for light and one for dark pages: the most vivid of the colours in their readable form.

    Readable means a contrast of 4.5 with the page (WCAG 2, level AA).
    """
    rgb = [np.array([int(c[i : i + 2], 16) for i in (1, 3, 5)], float) for c in colours]

    def best(page: tuple[int, int, int], towards: float) -> str:
        return hexadecimal(max((readable(c, page, towards) for c in rgb), key=np.ptp))

    return {"light": best((250, 248, 244), 0.0), "dark": best((20, 20, 22), 255.0)}


def readable(colour: np.ndarray, page: tuple[int, int, int], towards: float) -> np.ndarray:
    """`colour` mixed with black (towards = 0) or white (255) until its contrast with `page` is 4.5."""
    for share in np.linspace(0, 1, 41):
        mixed = colour * (1 - share) + towards * share
        high, low = sorted((relative_luminance(mixed), relative_luminance(np.array(page))), reverse=True)
        if (high + 0.05) / (low + 0.05) >= 4.5:
            return mixed
    return np.full(3, towards)


def relative_luminance(rgb: np.ndarray) -> float:
    """WCAG 2 relative luminance of an 8-bit sRGB colour."""
    x = np.asarray(rgb, float) / 255
    linear = np.where(x <= 0.04045, x / 12.92, ((x + 0.055) / 1.055) ** 2.4)
    return float(linear @ [0.2126, 0.7152, 0.0722])


def hexadecimal(rgb: np.ndarray) -> str:
    """'#rrggbb' of an 8-bit colour."""
    r, g, b = (int(np.clip(round(float(c)), 0, 255)) for c in rgb)
    return f"#{r:02x}{g:02x}{b:02x}"
