"""Decoder of pictures and textures: headers first, sizes bounded, plain arrays as results."""

import io
import math
import warnings
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Shaped

from mistyle.core.asset import Picture, Pixels
from mistyle.core.errors import InputRefused
from mistyle.io.images.float_tiff import holds_floats, tags_of_tiff
from mistyle.io.images.quantisation import Kind, finished, fractions
from mistyle.io.sandbox.asset_folders import MeshFolders
from mistyle.io.sandbox.bounds import MAX_PIXELS, MAX_TEXTURE_PIXELS, WORK_TEXTURE, read_bytes, refuse
from mistyle.io.sandbox.nearby import named_file

FORMATS = ("PNG", "JPEG", "WEBP", "TIFF", "BMP", "GIF", "AVIF", "TGA")
EXPECTED = "a PNG, JPEG, WebP, TIFF, BMP, GIF or TGA picture"
CONVERT = "Save it as PNG or JPEG and try again"
MAX_PICTURE_BYTES = 512 << 20
CHUNKS = 1 << 12  # bytes of a PNG in which chunks of colour lie
ORIENTATION = 0x0112  # the tag of EXIF and TIFF: 1 upright, 2 mirrored, 3 turned by 180 degrees, ... 8
EXIF_IFD, EXPOSURE_TIME, F_NUMBER, ISO_SPEED = 0x8769, 0x829A, 0x829D, 0x8827
# TIFF 6.0; ASSOCIATED: colours are multiplied by alpha.
BITS_PER_SAMPLE, PHOTOMETRIC, PLANES, EXTRA_SAMPLES, ASSOCIATED = 258, 262, 284, 338, 1
UNDONE_BY = {6: 8, 8: 6}  # the other orientations are their own inverses


@dataclass
class Budget:
    """Number of texels that the textures of one mesh have used (state across all decodes)."""

    path: Path
    pixels: int = 0

    def take(self, pixels: int) -> None:
        """Add `pixels`; refuse when the mesh's textures exceed the limit together."""
        self.pixels += pixels
        if self.pixels > MAX_TEXTURE_PIXELS:
            found, most = (
                f"more than {self.pixels / 1e6:.0f} million texels",
                f"at most {MAX_TEXTURE_PIXELS / 1e6:.0f} million",
            )
            raise refuse(self.path, found + " in its textures", most, "Scale its textures down")


def read_pixels(path: Path, pixels: Pixels = "upright") -> tuple[np.ndarray, np.ndarray | None, tuple[str, ...]]:
    """A style or any other picture file as sRGB-encoded 8- or 16-bit rgb (h w 3) and alpha (h w), and notes.

    Size is checked in the header before decoding (at most MAX_PIXELS). Embedded colour profiles are converted to sRGB,
    EXIF orientation is applied (not with `pixels` "stored"), CMYK, palettes, grey and 16-bit files are converted. The
    first of several pictures is read. `notes` lists the conversions. InputRefused for files that are not pictures of a
    known format (such as SVG and PDF), for truncated or damaged files, and for no or too many pixels.
    """
    path = Path(path)
    data = read_bytes(path, MAX_PICTURE_BYTES)
    image, notes = _open(data, str(path))
    if image.format != "TIFF":  # Pillow drops a TIFF's tag when it decodes; a PNG's tag may follow the pixels
        _load(image, str(path))
    orientation = _orientation(image)
    if orientation > 1 and pixels == "upright":
        notes.append("The picture was turned upright by its EXIF orientation.")
    rgb, alpha = _pixels(image, data, str(path), notes)
    rgb, alpha = (
        None if part is None else _oriented(part, orientation, image.format == "TIFF", pixels) for part in (rgb, alpha)
    )
    assert rgb is not None
    return rgb, alpha, tuple(notes)


def picture_of(path: Path, pixels: tuple[np.ndarray, np.ndarray | None, tuple[str, ...]]) -> Picture:
    """The result of `read_pixels` as floats."""
    rgb, alpha, notes = pixels
    return Picture(fractions(rgb), None if alpha is None else fractions(alpha), path, notes)


def size_of_picture(path: Path) -> tuple[int, int, int]:
    """See `read_stored_size` in io/read.py."""
    image, _ = _open(read_bytes(path, MAX_PICTURE_BYTES), str(path))
    # Pillow gives the upright size of a TIFF with this tag (but not with an orientation in XMP).
    swapped = image.format == "TIFF" and image.tag_v2.get(ORIENTATION) in range(5, 9)
    height, width = (image.width, image.height) if swapped else (image.height, image.width)
    return height, width, _orientation(image)


def exposure_of_picture(path: Path) -> tuple[float, float, float]:
    """See `read_exposure` in io/read.py."""
    image, _ = _open(read_bytes(path, MAX_PICTURE_BYTES), str(path))
    try:
        tags = image.getexif().get_ifd(EXIF_IFD)
        values = [_number(tags.get(tag)) for tag in (EXPOSURE_TIME, F_NUMBER, ISO_SPEED)]
    except (OSError, ValueError, SyntaxError, KeyError, TypeError, ZeroDivisionError):
        values = [math.nan] * 3
    return values[0], values[1], values[2]


def _number(value: Any) -> float:
    """An EXIF value (the first of several) as a positive number, else NaN."""
    try:
        number = float(value[0] if isinstance(value, tuple) else value)
    except (TypeError, ValueError, ZeroDivisionError, IndexError):
        return math.nan
    return number if math.isfinite(number) and number > 0 else math.nan


def texture(data: bytes, where: str, budget: Budget) -> Shaped[np.ndarray, "h w 3"]:
    """A mesh's texture as its file has it, 8 or 16 bits a channel. Embedded profiles are ignored, as glTF demands.

    glTF's row 0 is v = 0 counted from the top, which is v = 1 counted up: no texture is ever flipped.
    """
    image, notes = _open(data, where)
    budget.take(image.width * image.height)
    return _pixels(image, data, where, notes, managed=False)[0]


def texture_file(path: Path, budget: Budget) -> tuple[Shaped[np.ndarray, "h w 3"], bool]:
    """A mesh's texture in a file of its own, and whether its values are linear: those of EXR and
    Radiance files are, in unbounded floats. A single channel is repeated three times."""
    from mistyle.io.images import hdr

    head = read_bytes(path, count=10)
    if head[:4] == hdr.EXR_MAGIC:
        height, width = hdr.size_of_exr(path)
        budget.take(height * width)
        return hdr.colour_of_exr(path), True
    if head[:2] == b"#?":
        pixels = hdr.read_hdr(path)
        budget.take(pixels.shape[0] * pixels.shape[1])
        return pixels, True
    return texture(read_bytes(path, MAX_PICTURE_BYTES), str(path), budget), False


def named_texture(
    where: Path, folders: MeshFolders, name: str, budget: Budget, notes: list[str]
) -> tuple[Shaped[np.ndarray, "h w 3"], bool] | None:
    """The `texture_file` that the file `where` names, in the mesh's `folders` or near them (io/sandbox/nearby.py);
    None, with a note, without a usable file."""
    try:
        target, place = named_file(where, folders, name)
        if target is None:
            notes.append(f"Texture {name} is not there and was left out.")
            return None
        pixels = texture_file(target, budget)
    except InputRefused as error:
        notes.append(f"Texture {name} was left out: {error}")
        return None
    if place is not None:
        notes.append(f"Texture {name} was found by its name at {place}.")
    return pixels


def decode(data: bytes, where: str, budget: Budget, kind: Kind, scale: float = 1.0) -> Float[np.ndarray, "h w 3"]:
    """A mesh's texture as `Material` has it (io/images/quantisation.py `finished`), at most WORK_TEXTURE on a side."""
    return finished(texture(data, where, budget), kind, scale, WORK_TEXTURE)


def shrunk(data: bytes, where: str, longest: int, quality: int) -> tuple[bytes, str]:
    """An embedded picture's file scaled down to `longest` pixels where larger, and its MIME type: JPEG of that quality,
    or PNG where it has transparency."""
    from PIL import Image

    image, _ = _open(data, where)
    _load(image, where)
    image = image.convert("RGBA" if image.has_transparency_data else "RGB")
    factor = longest / max(image.size)
    if factor < 1:
        width, height = (max(1, round(side * factor)) for side in image.size)
        image = image.resize((width, height), Image.Resampling.BOX)
    buffer = io.BytesIO()
    if image.mode == "RGBA":
        image.save(buffer, "PNG", optimize=True)
        return buffer.getvalue(), "image/png"
    image.save(buffer, "JPEG", quality=quality, subsampling=0)
    return buffer.getvalue(), "image/jpeg"


def named_alpha(where: Path, folders: MeshFolders, name: str) -> Float[np.ndarray, "h w"] | None:
    """The alpha 0..1 of the texture that `named_texture` found; None where it is opaque."""
    target = named_file(where, folders, name)[0]
    return None if target is None else alpha_of(read_bytes(target, MAX_PICTURE_BYTES), str(target))


def alpha_of(data: bytes, where: str) -> Float[np.ndarray, "h w"] | None:
    """The alpha 0..1 of a texture; None where it has none, is opaque, or is not a picture."""
    try:
        image, _ = _open(data, where)
        if not image.has_transparency_data:
            return None
        _load(image, where)
        alpha = np.asarray(image.convert("RGBA").getchannel("A"), np.float32) / 255
    except (InputRefused, OSError, ValueError):
        return None
    return alpha if (alpha < 1).any() else None


def alpha_map(data: bytes, where: str) -> Float[np.ndarray, "h w"]:
    """The alpha 0..1 of a texture as a map: 1 everywhere where it has none."""
    alpha = alpha_of(data, where)
    return np.ones((2, 2), np.float32) if alpha is None else alpha


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
        (b"sdpx", "a DPX picture"),
        (b"xpds", "a DPX picture"),
        (b"\x80\x2a\x5f\xd7", "a Cineon picture"),
        (b"dds ", "a DDS texture"),
        (b"\0\0\0\x0cjp", "a JPEG 2000 picture"),
        (b"\0\0\1\0", "an icon"),  # else taken for a TGA, which has no mark
    ):
        if head.startswith(mark) or (mark == b"<svg" and b"<svg" in head):
            raise refuse(where, name, EXPECTED, "Export it as PNG from the program that made it")
    heic = data[4:12] in (b"ftypheic", b"ftypheix", b"ftypmif1")
    if heic and not _heic_decoder():
        fix = "Export it as JPEG, or install a decoder beside mistyle (pip install pillow-heif; its codec is GPL)"
        raise refuse(where, "a HEIC photograph", EXPECTED, fix)
    if data[:4] == b"\x76\x2f\x31\x01" or head.startswith(b"#?r"):
        raise refuse(where, "a high-dynamic-range picture", EXPECTED, "Tone-map it and save it as PNG")
    if holds_floats(tags_of_tiff(data)):
        fix = "Save it as a TIFF of 16 bits, or as OpenEXR where linear values are asked for"
        raise refuse(where, "a TIFF of floating-point numbers", EXPECTED, fix)
    Image.init()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)
            image = Image.open(io.BytesIO(data), formats=[f for f in (*FORMATS, *["HEIF"] * heic) if f in Image.OPEN])
            several = bool(getattr(image, "is_animated", False))  # counting the frames may take minutes
    except Image.DecompressionBombError as error:
        raise _too_large(where, "far too many pixels") from error
    except (OSError, ValueError, SyntaxError, EOFError, OverflowError, KeyError, TypeError) as error:
        # Pillow's message for an unknown format names only the buffer.
        why = "" if isinstance(error, Image.UnidentifiedImageError) else f" ({_first(error)})"
        raise refuse(where, f"a file that no decoder takes{why}", EXPECTED, CONVERT) from error
    if image.width < 1 or image.height < 1:
        raise refuse(where, f"{image.width} x {image.height} pixels", "at least one pixel", CONVERT)
    if image.width * image.height > MAX_PIXELS:
        raise _too_large(where, f"{image.width} x {image.height} pixels")
    first_parts = {"MPO": "first picture of the MPO file", "TIFF": "first page"}
    notes = (
        [f"Only the {first_parts.get(str(image.format), 'first frame of the animation')} was read."] if several else []
    )
    return image, [*notes, *_png_notes(image, data)]


def _png_notes(image: Any, data: bytes) -> list[str]:
    """What a PNG without a profile says of its colours besides sRGB; nothing of it is applied."""
    if image.format != "PNG" or "icc_profile" in image.info:
        return []
    gamma, at = image.info.get("gamma"), data[:CHUNKS].find(b"cICP") + 4
    other = gamma is not None and "srgb" not in image.info and abs(gamma - 1 / 2.2) > 0.005
    # ITU-T H.273: primaries 1 are Rec.709, transfer 13 is sRGB and 1 Rec.709.
    coded = at >= 4 and (data[at] != 1 or data[at + 1] not in (1, 13))
    return [f"Its {name} chunk was ignored; colours are taken as sRGB." for name, there in
            (("gAMA", other), ("cICP", coded)) if there]  # fmt: skip


def _heic_decoder() -> bool:
    """Whether the user has installed pillow-heif; it is then registered with Pillow."""
    try:
        pillow_heif: Any = import_module("pillow_heif")
        pillow_heif.register_heif_opener()
    except (ImportError, OSError):
        return False
    return True


def _too_large(where: str, found: str) -> InputRefused:
    return refuse(where, found, f"at most {MAX_PIXELS / 1e6:.0f} million (8192 x 8192)", "Scale the picture down")


def _load(image: Any, where: str) -> None:
    """Decode; a truncated or damaged file is refused."""
    import struct
    import zlib

    try:
        image.load()
    except (OSError, ValueError, SyntaxError, EOFError, IndexError, OverflowError, struct.error, zlib.error) as error:
        found = f"a damaged or cut-off {image.format} file ({_first(error)})"
        raise refuse(where, found, "a complete picture", "Copy or download it again") from error


def _first(error: Exception) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0][:120]


def _orientation(image: Any) -> int:
    """The orientation 1..8 of an opened picture; 1 where it has none or its EXIF data cannot be read."""
    try:
        orientation = image.getexif().get(ORIENTATION, 1)
    except (OSError, ValueError, SyntaxError, KeyError, TypeError):
        return 1
    return orientation if isinstance(orientation, int) and orientation in range(1, 9) else 1


def _oriented(
    pixels: Shaped[np.ndarray, "h w *c"], orientation: int, upright: bool, requested: Pixels
) -> Shaped[np.ndarray, "h2 w2 *c"]:
    """Decoded pixels in the `requested` orientation; `upright` is the state of `pixels`."""
    if upright == (requested == "upright"):
        return pixels
    return np.ascontiguousarray(_turned(pixels, UNDONE_BY.get(orientation, orientation) if upright else orientation))


def _turned(stored: Shaped[np.ndarray, "h w *c"], orientation: int) -> Shaped[np.ndarray, "h2 w2 *c"]:
    """The upright picture of stored pixels (EXIF 2.3, tag 0x0112: positions of row 0 and column 0)."""
    rows, columns = {1: (1, 1), 2: (1, -1), 3: (-1, -1), 4: (-1, 1), 5: (1, 1), 6: (-1, 1), 7: (-1, -1), 8: (1, -1)}[
        orientation
    ]
    mirrored = stored[::rows, ::columns]
    return mirrored if orientation < 5 else mirrored.swapaxes(0, 1)


def _pixels(
    image: Any, data: bytes, where: str, notes: list[str], managed: bool = True
) -> tuple[Shaped[np.ndarray, "h w 3"], Shaped[np.ndarray, "h w"] | None]:
    """Encoded rgb and alpha (None where opaque), 8 or 16 bits, of a picture in any mode."""
    _load(image, where)
    deep = _sixteen_bit(data, image, where, notes)
    if deep is not None:
        rgb, alpha = deep
        if managed:
            rgb = _deep_srgb(image, rgb, where, notes)
    else:
        image, transparency = _plain(image, where, notes)
        alpha = None if transparency is None else np.asarray(transparency)
        if managed:
            image = _to_srgb(image, where, notes)
        if image.mode != "RGB":
            if image.mode == "CMYK":
                notes.append("A CMYK picture without a usable profile was converted plainly; its colours may differ.")
            image = image.convert("RGB")
        rgb = np.asarray(image)
    if alpha is not None and (alpha == np.iinfo(alpha.dtype).max).all():
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
    """Convert through the embedded profile; sRGB's own changes nothing, a damaged one is ignored with a note."""
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
        notes.append(_unusable(error))
        return image
    notes.append(_converted(name))
    return converted


def _deep_srgb(
    image: Any, rgb: Shaped[np.ndarray, "h w 3"], where: str, notes: list[str]
) -> Shaped[np.ndarray, "h w 3"]:
    """As `_to_srgb`, for 16 bits a channel."""
    from PIL import ImageCms

    from mistyle.io.images.icc import Unusable, read_profile, to_srgb

    data = image.info.get("icc_profile")
    if not data:
        return rgb
    grey = image.mode.startswith(("I", "L"))
    try:
        name = ImageCms.getProfileDescription(ImageCms.ImageCmsProfile(io.BytesIO(data))).strip()
        if "srgb" in name.lower() and not grey:
            return rgb
        converted = to_srgb(rgb, read_profile(data), grey)
    except (Unusable, ImageCms.PyCMSError, OSError, ValueError, TypeError) as error:
        notes.append(_unusable(error))
        return rgb
    notes.append(_converted(name))
    return converted


def _unusable(error: Exception) -> str:
    return f"The embedded colour profile could not be used ({_first(error)}); colours are taken as sRGB."


def _converted(name: str) -> str:
    return f"Colours were converted from the embedded profile '{name[:60]}' to sRGB."


def _sixteen_bit(
    data: bytes, image: Any, where: str, notes: list[str]
) -> tuple[Shaped[np.ndarray, "h w 3"], Shaped[np.ndarray, "h w"] | None] | None:
    """Pictures with 16 bits a channel, which Pillow decodes as grey only or at 8 bits; None for all others. The
    orientation is Pillow's: a TIFF upright, a PNG as stored."""
    if image.mode.startswith("I;16") or (image.mode == "I" and image.format == "PNG"):
        grey = np.clip(np.asarray(image), 0, 65535).astype(np.uint16)
        if image.format == "TIFF" and image.tag_v2.get(PHOTOMETRIC) == 0:  # white is 0, which Pillow leaves so
            grey = np.uint16(65535) - grey
        return np.repeat(grey[..., None], 3, axis=2), None
    if image.format == "TIFF":
        return _deep_tiff(data, image, where, notes)
    png16 = data[:8] == b"\x89PNG\r\n\x1a\n" and len(data) > 26 and data[24] == 16
    if not png16:
        return None
    import cv2

    pixels = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    if pixels is None or pixels.dtype != np.uint16:
        raise refuse(where, "a 16-bit PNG that cannot be decoded", "a complete picture", CONVERT)
    values = pixels[..., None] if pixels.ndim == 2 else pixels
    if values.shape[2] in (1, 2):
        return np.repeat(values[..., :1], 3, axis=2), values[..., 1] if values.shape[2] == 2 else None
    return values[..., 2::-1], values[..., 3] if values.shape[2] == 4 else None


def _deep_tiff(
    data: bytes, image: Any, where: str, notes: list[str]
) -> tuple[Shaped[np.ndarray, "h w 3"], Shaped[np.ndarray, "h w"] | None] | None:
    """An RGB TIFF of 16 bits a channel; None, with a note, where only Pillow's 8 bits are available."""
    import cv2

    bits = image.tag_v2.get(BITS_PER_SAMPLE, 8)
    if max(bits if isinstance(bits, tuple) else (bits,)) <= 8:
        return None
    if image.tag_v2.get(PLANES, 1) != 1:
        raise refuse(where, "a TIFF of 16 bits in separate planes", "pixels side by side", CONVERT)
    try:
        known = image.mode in ("RGB", "RGBA")
        pixels = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED) if known else None
    except cv2.error:  # Pillow may still read it
        pixels = None
    if pixels is not None and pixels.dtype == np.uint16 and pixels.ndim == 3:
        values = np.asarray(pixels, np.uint16)[..., [2, 1, 0, 3][: pixels.shape[2]]]
        multiplied = image.tag_v2.get(EXTRA_SAMPLES) == (ASSOCIATED,)
        eight_bit, compared = (
            np.asarray(image),
            slice(3 if multiplied else 0, 4),
        )  # Pillow divides colours by alpha itself
        # Both decoders must agree on the high bytes, and so on the orientation.
        if values.shape == eight_bit.shape and np.array_equal((values // 256)[..., compared], eight_bit[..., compared]):
            return _straight(values, multiplied)
    notes.append("A TIFF with more than 8 bits a channel was read at 8 bits.")
    return None


def _straight(
    values: Shaped[np.ndarray, "h w c"], multiplied: bool
) -> tuple[Shaped[np.ndarray, "h w 3"], Shaped[np.ndarray, "h w"] | None]:
    """Colours and alpha of 16 bits; premultiplied colours are divided by alpha."""
    if values.shape[2] == 3:
        return values, None
    rgb, alpha = values[..., :3], values[..., 3]
    if multiplied:
        divided = rgb.astype(np.float32) * (np.float32(65535) / np.maximum(alpha, 1)[..., None].astype(np.float32))
        rgb = np.rint(np.minimum(divided, 65535)).astype(np.uint16)
    return rgb, alpha
