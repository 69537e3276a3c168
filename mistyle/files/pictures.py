"""Pictures and textures: headers first, sizes bounded, everything turned into plain float arrays."""

import io
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from mistyle.core.asset import Picture
from mistyle.core.errors import InputRefused
from mistyle.core.image import linear_from_srgb
from mistyle.files.bounds import MAX_PIXELS, MAX_TEXTURE_PIXELS, WORK_TEXTURE, read_bytes, refuse

FORMATS = ("PNG", "JPEG", "WEBP", "TIFF", "BMP", "GIF", "AVIF", "TGA")
EXPECTED = "a PNG, JPEG, WebP, TIFF, BMP, GIF or TGA picture"
CONVERT = "Save it as PNG or JPEG and try again"
MAX_PICTURE_BYTES = 512 << 20


@dataclass
class Budget:
    """How many texels the textures of one mesh have used up (state: it outlives every decode)."""

    path: Path
    pixels: int = 0

    def take(self, pixels: int) -> None:
        """Count, and refuse when the mesh's textures get too many together."""
        self.pixels += pixels
        if self.pixels > MAX_TEXTURE_PIXELS:
            found, most = (
                f"more than {self.pixels / 1e6:.0f} million texels",
                f"at most {MAX_TEXTURE_PIXELS / 1e6:.0f} million",
            )
            raise refuse(self.path, found + " in its textures", most, "Scale its textures down")


def read_picture(path: Path) -> Picture:
    """A style or any other picture file as sRGB-encoded float32 0..1, upright.

    Size is checked in the header before anything is decoded (at most MAX_PIXELS). Embedded colour profiles are
    converted to sRGB, EXIF orientation is applied, CMYK, palettes, grey and 16-bit files are converted, of an animation
    the first frame is taken; `notes` says so. Refused with a sentence: files that are no picture of a known format
    (SVG and PDF among them), cut-off or damaged ones, ones of no or too many pixels.
    """
    path = Path(path)
    data = read_bytes(path, MAX_PICTURE_BYTES)
    image, notes = _open(data, str(path))
    image, turned = _upright(image, str(path))
    if turned:
        notes.append("The picture was turned upright as its EXIF orientation says.")
    rgb, alpha = _colour(image, data, str(path), notes)
    return Picture(rgb=rgb, alpha=alpha, path=path, notes=tuple(notes))


def size_of_picture(path: Path) -> tuple[int, int]:
    """See `read_size` in files/read.py."""
    image, _ = _open(read_bytes(path, MAX_PICTURE_BYTES), str(path))
    try:
        turned = image.getexif().get(0x0112, 1) in range(5, 9)
    except (OSError, ValueError, SyntaxError, KeyError, TypeError):
        turned = False  # as in `_upright`
    return (image.width, image.height) if turned else (image.height, image.width)


Kind = Literal["colour", "normal", "data"]


def decode(data: bytes, where: str, budget: Budget, kind: Kind, scale: float = 1.0) -> Float[np.ndarray, "h w 3"]:
    """A mesh's texture as `Material` has it: linear colour, unit normals (x and y times `scale`) or plain data in three
    channels. Embedded profiles are ignored, as glTF demands. Halved until no side exceeds WORK_TEXTURE.

    glTF's row 0 is v = 0 counted from the top, which is v = 1 counted up: no texture is ever flipped.
    """
    image, notes = _open(data, where)
    budget.take(image.width * image.height)
    rgb, _ = _colour(image, data, where, notes, managed=False)
    if kind == "colour":
        rgb = _linear(rgb)
    elif kind == "normal":
        rgb = rgb * 2 - 1
    while max(rgb.shape[:2]) > WORK_TEXTURE:
        rgb = _halved(rgb)
    return _unit(rgb, scale) if kind == "normal" else rgb


def _open(data: bytes, where: str) -> tuple[Any, list[str]]:
    """The opened (not decoded) image after the header checks."""
    from PIL import Image

    if not data:
        raise refuse(where, "an empty file", EXPECTED, "Check the file")
    head = data[:1024].lstrip().lower()
    for mark, name in (
        (b"<svg", "an SVG drawing"),
        (b"<?xml", "an XML file"),
        (b"%pdf", "a PDF"),
        (b"8bps", "a Photoshop file"),
    ):
        if head.startswith(mark) or (mark == b"<svg" and b"<svg" in head):
            raise refuse(where, name, EXPECTED, "Export it as PNG from the program that made it")
    if data[4:12] in (b"ftypheic", b"ftypheix", b"ftypmif1"):
        raise refuse(where, "a HEIC photograph", EXPECTED, CONVERT)
    if data[:4] == b"\x76\x2f\x31\x01" or head.startswith(b"#?r"):
        raise refuse(where, "a high-dynamic-range picture", EXPECTED, "Tone-map it and save it as PNG")
    Image.init()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)
            image = Image.open(io.BytesIO(data), formats=[f for f in FORMATS if f in Image.OPEN])
            frames = getattr(image, "n_frames", 1)
    except Image.DecompressionBombError as error:
        raise _too_large(where, "far too many pixels") from error
    except (OSError, ValueError, SyntaxError, EOFError, OverflowError, KeyError, TypeError) as error:
        # Pillow's own words for an unknown format name only the buffer.
        why = "" if isinstance(error, Image.UnidentifiedImageError) else f" ({_first(error)})"
        raise refuse(where, f"a file that no decoder takes{why}", EXPECTED, CONVERT) from error
    if image.width < 1 or image.height < 1:
        raise refuse(where, f"{image.width} x {image.height} pixels", "at least one pixel", CONVERT)
    if image.width * image.height > MAX_PIXELS:
        raise _too_large(where, f"{image.width} x {image.height} pixels")
    notes = ["Of the animation only the first frame was taken."] if frames > 1 else []
    return image, notes


def _too_large(where: str, found: str) -> InputRefused:
    return refuse(where, found, f"at most {MAX_PIXELS / 1e6:.0f} million (8192 x 8192)", "Scale the picture down")


def _load(image: Any, where: str) -> None:
    """Decode; a cut-off or damaged file is refused."""
    import struct
    import zlib

    try:
        image.load()
    except (OSError, ValueError, SyntaxError, EOFError, IndexError, OverflowError, struct.error, zlib.error) as error:
        found = f"a damaged or cut-off {image.format} file ({_first(error)})"
        raise refuse(where, found, "a complete picture", "Copy or download it again") from error


def _first(error: Exception) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0][:120]


def _upright(image: Any, where: str) -> tuple[Any, bool]:
    from PIL import ImageOps

    _load(image, where)
    try:
        orientation = image.getexif().get(0x0112, 1)
        turned = ImageOps.exif_transpose(image) if orientation in range(2, 9) else image
    except (OSError, ValueError, SyntaxError, KeyError, TypeError):
        return image, False  # EXIF data that cannot be read: the pixels are all the same fine
    return turned, turned is not image


def _colour(
    image: Any, data: bytes, where: str, notes: list[str], managed: bool = True
) -> tuple[Float[np.ndarray, "h w 3"], Float[np.ndarray, "h w"] | None]:
    """Encoded rgb 0..1 and alpha (None where opaque) of a picture in whatever mode."""
    _load(image, where)
    deep = _sixteen_bit(data, image, where)
    if deep is not None:
        rgb, alpha = deep
    else:
        image, transparency = _plain(image, where, notes)
        alpha = None if transparency is None else np.asarray(transparency, np.float32) / 255
        if managed:
            image = _to_srgb(image, where, notes)
        if image.mode != "RGB":
            if image.mode == "CMYK":
                notes.append("A CMYK picture without a usable profile was converted plainly; its colours may differ.")
            image = image.convert("RGB")
        rgb = np.asarray(image, np.float32) / 255
    if alpha is not None and (alpha >= 1).all():
        alpha = None
    return np.ascontiguousarray(rgb), alpha


def _plain(image: Any, where: str, notes: list[str]) -> tuple[Any, Any | None]:
    """A picture in mode L, RGB, CMYK or LAB, and its alpha as a mode L picture or None. Profiles stay attached."""
    profile = image.info.get("icc_profile")
    alpha = None
    if image.mode == "P":
        image = image.convert("RGBA" if "transparency" in image.info else "RGB")
    elif image.mode in ("L", "RGB") and "transparency" in image.info:
        image = image.convert("RGBA")
    if image.mode in ("RGBA", "LA", "PA", "La", "RGBa"):
        image = image.convert("LA" if image.mode == "La" else "RGBA" if image.mode in ("PA", "RGBa") else image.mode)
        alpha = image.getchannel("A")
        image = image.convert(image.mode[:-1])
    elif image.mode == "1":
        image = image.convert("L")
    elif image.mode in ("YCbCr", "HSV", "RGBX"):
        image = image.convert("RGB")
    if image.mode not in ("L", "RGB", "CMYK", "LAB"):
        found = f"pixels of kind {image.mode}"
        raise refuse(where, found, "8- or 16-bit grey, RGB or CMYK", "Save it as an 8-bit PNG")
    if profile:
        image.info["icc_profile"] = profile
    return image, alpha


def _to_srgb(image: Any, where: str, notes: list[str]) -> Any:
    """Convert through the embedded profile; sRGB's own changes nothing, a damaged one is passed over with a note."""
    from PIL import ImageCms

    data = image.info.get("icc_profile")
    if not data:
        return image
    try:
        profile = ImageCms.ImageCmsProfile(io.BytesIO(data))
        name = ImageCms.getProfileDescription(profile).strip()
        if "srgb" in name.lower() and image.mode == "RGB":
            return image
        converted = ImageCms.profileToProfile(image, profile, ImageCms.createProfile("sRGB"), outputMode="RGB")
    except (ImageCms.PyCMSError, OSError, ValueError, TypeError) as error:
        notes.append(f"The embedded colour profile could not be used ({_first(error)}); colours are taken as sRGB.")
        return image
    notes.append(f"Colours were converted from the embedded profile '{name[:60]}' to sRGB.")
    return converted


def _sixteen_bit(
    data: bytes, image: Any, where: str
) -> tuple[Float[np.ndarray, "h w 3"], Float[np.ndarray, "h w"] | None] | None:
    """Pictures with 16 bits a channel, which Pillow has as grey only or cuts to 8 bits; None for all others.

    Their colour profile is not applied.
    """
    if image.mode.startswith("I;16") or (image.mode == "I" and image.format == "PNG"):
        grey = np.asarray(image).astype(np.float32) / 65535
        return np.repeat(grey[..., None], 3, axis=2), None
    png16 = data[:8] == b"\x89PNG\r\n\x1a\n" and len(data) > 26 and data[24] == 16
    if not png16:
        return None
    import cv2

    pixels = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    if pixels is None or pixels.dtype != np.uint16:
        raise refuse(where, "a 16-bit PNG that cannot be decoded", "a complete picture", CONVERT)
    values = pixels.astype(np.float32) / 65535
    if values.ndim == 2:
        values = values[..., None]
    if values.shape[2] in (1, 2):
        return np.repeat(values[..., :1], 3, axis=2), values[..., 1] if values.shape[2] == 2 else None
    return values[..., 2::-1], values[..., 3] if values.shape[2] == 4 else None


def _linear(rgb: Float[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h w 3"]:
    """sRGB to linear in rows, so that the powers' temporaries stay small."""
    result = np.empty_like(rgb)
    for start in range(0, len(rgb), 256):
        result[start : start + 256] = linear_from_srgb(rgb[start : start + 256])
    return result


def _halved(values: Float[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h2 w2 3"]:
    """Means of 2 x 2 texels; an odd last row or column is repeated."""
    h, w = values.shape[:2]
    padded = np.pad(values, ((0, h % 2), (0, w % 2), (0, 0)), mode="edge")
    return (padded[::2, ::2] + padded[1::2, ::2] + padded[::2, 1::2] + padded[1::2, 1::2]) / 4


def _unit(normal: Float[np.ndarray, "h w 3"], scale: float) -> Float[np.ndarray, "h w 3"]:
    """Unit normals that point outwards; texels without a direction become (0, 0, 1)."""
    scaled = normal * np.array([scale, scale, 1], np.float32)
    scaled[..., 2] = np.maximum(scaled[..., 2], 1e-3)
    return (scaled / np.linalg.norm(scaled, axis=2, keepdims=True)).astype(np.float32)
