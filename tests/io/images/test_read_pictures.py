"""Pictures, OpenEXR and Radiance: what is converted, what is refused, and that headers are believed only so far."""

import io
import struct
import zlib
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
import tifffile
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image, ImageCms

from mistyle.core.errors import InputRefused
from mistyle.core.image import luminance
from mistyle.io.images import hdr
from mistyle.io.images import read as pictures
from mistyle.io.images.read import Budget, decode
from mistyle.io.read import read_exr, read_hdr, read_picture
from tests.support.helpers import data

# One step of an 8-bit channel; lossy codecs stay within a few.
STEP = 1 / 255


def colours(seed: int = 0, size: tuple[int, int] = (5, 7)) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (*size, 3)).astype(np.uint8)


def encoded(image: Image.Image, kind: str, **options: object) -> bytes:
    stream = io.BytesIO()
    image.save(stream, kind, **options)
    return stream.getvalue()


@pytest.mark.parametrize(
    ("kind", "options"), [("PNG", {}), ("BMP", {}), ("TIFF", {}), ("TGA", {}), ("WEBP", {"lossless": True})]
)
def test_lossless_formats_are_exact(kind: str, options: dict, tmp_path: Path) -> None:
    pixels = colours()
    path = tmp_path / f"a.{kind.lower()}"
    Image.fromarray(pixels).save(path, kind, **options)
    picture = read_picture(path)
    assert picture.rgb.dtype == np.float32 and picture.alpha is None and picture.notes == ()
    assert np.array_equal(picture.rgb, pixels.astype(np.float32) / 255)


def test_jpeg_is_close(tmp_path: Path) -> None:
    smooth = np.stack([*np.meshgrid(np.linspace(0, 255, 64), np.linspace(0, 255, 48)), np.full((48, 64), 90.0)], -1)
    Image.fromarray(smooth.astype(np.uint8)).save(tmp_path / "a.jpg", quality=95)
    assert read_picture(tmp_path / "a.jpg").rgb == pytest.approx(smooth / 255, abs=6 * STEP)


def test_alpha_palettes_and_grey(tmp_path: Path) -> None:
    pixels = np.dstack([colours(), np.full((5, 7), 255, np.uint8)])
    pixels[0, 0, 3] = 51
    Image.fromarray(pixels).save(tmp_path / "rgba.png")
    picture = read_picture(tmp_path / "rgba.png")
    assert picture.alpha is not None and picture.alpha[0, 0] == pytest.approx(0.2) and picture.alpha[1:].min() == 1
    assert np.array_equal(picture.rgb, pixels[..., :3].astype(np.float32) / 255)  # not premultiplied
    Image.fromarray(np.dstack([colours(), np.full((5, 7), 255, np.uint8)])).save(tmp_path / "opaque.png")
    assert read_picture(tmp_path / "opaque.png").alpha is None
    grey = colours()[..., 0]
    Image.fromarray(grey).save(tmp_path / "l.png")
    assert np.array_equal(
        read_picture(tmp_path / "l.png").rgb, np.repeat(grey[..., None], 3, 2).astype(np.float32) / 255
    )
    Image.fromarray(grey > 100).save(tmp_path / "1.png")
    assert np.array_equal(read_picture(tmp_path / "1.png").rgb[..., 1], (grey > 100).astype(np.float32))
    palette = Image.fromarray(colours()).quantize(8)
    palette.save(tmp_path / "p.png", transparency=0)
    shown = read_picture(tmp_path / "p.png")
    assert np.array_equal(shown.rgb, np.asarray(palette.convert("RGB"), np.float32) / 255)
    assert shown.alpha is not None and np.array_equal(shown.alpha == 0, np.asarray(palette) == 0)


def png16(pixels: np.ndarray, profile: bytes | None = None) -> bytes:
    """A 16-bit PNG, written by hand."""
    height, width, channels = pixels.shape
    kind = {1: 0, 2: 4, 3: 2, 4: 6}[channels]
    rows = b"".join(b"\0" + row.astype(">u2").tobytes() for row in pixels)

    def chunk(name: bytes, content: bytes) -> bytes:
        return struct.pack(">I", len(content)) + name + content + struct.pack(">I", zlib.crc32(name + content))

    head = struct.pack(">IIBBBBB", width, height, 16, kind, 0, 0, 0)
    colours = b"" if profile is None else chunk(b"iCCP", b"p\0\0" + zlib.compress(profile))
    start = b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + colours
    return start + chunk(b"IDAT", zlib.compress(rows)) + chunk(b"IEND", b"")


@pytest.mark.parametrize("channels", [1, 2, 3, 4])
def test_sixteen_bits_are_kept(channels: int, tmp_path: Path) -> None:
    pixels = np.random.default_rng(0).integers(0, 65536, (4, 6, channels)).astype(np.uint16)
    (tmp_path / "a.png").write_bytes(png16(pixels))
    picture = read_picture(tmp_path / "a.png")
    value = pixels.astype(np.float32) / 65535
    expected = np.repeat(value[..., :1], 3, axis=2) if channels < 3 else value[..., :3]
    if channels != 2:  # 16-bit grey with alpha: Pillow keeps eight bits of it
        assert picture.rgb == pytest.approx(expected, abs=1e-6)
    else:
        assert picture.rgb == pytest.approx(expected, abs=STEP)
    assert (picture.alpha is not None) == (channels in (2, 4))


def test_exif_orientation_is_applied(tmp_path: Path) -> None:
    pixels = colours(size=(4, 6))
    for orientation, turn in (
        (3, lambda x: x[::-1, ::-1]),
        (6, lambda x: np.rot90(x, -1)),
        (8, lambda x: np.rot90(x, 1)),
    ):
        exif = Image.Exif()
        exif[0x0112] = orientation
        Image.fromarray(pixels).save(tmp_path / "a.png", exif=exif)
        picture = read_picture(tmp_path / "a.png")
        assert np.array_equal(picture.rgb, turn(pixels).astype(np.float32) / 255)
        assert "EXIF" in picture.notes[0]


def test_profiles_and_cmyk_are_converted(tmp_path: Path) -> None:
    pixels = colours(1, (6, 6))
    srgb = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    Image.fromarray(pixels).save(tmp_path / "srgb.png", icc_profile=srgb)
    assert np.array_equal(read_picture(tmp_path / "srgb.png").rgb, pixels.astype(np.float32) / 255)
    lab = ImageCms.ImageCmsProfile(ImageCms.createProfile("LAB")).tobytes()
    Image.fromarray(pixels).save(tmp_path / "wrong.png", icc_profile=lab)  # a profile of another colour space
    wrong = read_picture(tmp_path / "wrong.png")
    assert "could not be used" in wrong.notes[0] and np.array_equal(wrong.rgb, pixels.astype(np.float32) / 255)
    Image.fromarray(pixels).save(tmp_path / "junk.png", icc_profile=b"junk")
    assert "could not be used" in read_picture(tmp_path / "junk.png").notes[0]
    flat = Image.new("CMYK", (4, 4), (0, 255, 255, 0))  # magenta and yellow ink: red
    flat.save(tmp_path / "cmyk.jpg")
    red = read_picture(tmp_path / "cmyk.jpg")
    assert red.rgb[2, 2] == pytest.approx([1, 0, 0], abs=8 * STEP) and "CMYK" in red.notes[0]


def wide_gamut(curve: bytes = b"curv\0\0\0\0\0\0\0\0") -> bytes:
    """A minimal matrix profile: sRGB's primaries with red and green exchanged, gamma 1 or another curve."""
    columns = {b"rXYZ": (0.3851, 0.7169, 0.0971), b"gXYZ": (0.4361, 0.2225, 0.0139), b"bXYZ": (0.1431, 0.0606, 0.7141)}
    tags = {b"wtpt": (0.9642, 1.0, 0.8249), **columns}
    fixed = {k: b"XYZ \0\0\0\0" + struct.pack(">3i", *(round(x * 65536) for x in v)) for k, v in tags.items()}
    text = b"swapped\0"
    fixed[b"desc"] = b"desc\0\0\0\0" + struct.pack(">I", len(text)) + text + bytes(79)
    fixed[b"cprt"] = b"text\0\0\0\0none\0\0\0\0"
    fixed[b"rTRC"] = fixed[b"gTRC"] = fixed[b"bTRC"] = curve
    table, body = b"", b""
    start = 128 + 4 + 12 * len(fixed)
    for name, content in fixed.items():
        content += bytes(-len(content) % 4)
        table += name + struct.pack(">II", start + len(body), len(content))
        body += content
    head = (
        struct.pack(">I4sI4s4s4s", start + len(body), b"lcms", 0x02100000, b"mntr", b"RGB ", b"XYZ ")
        + bytes(12)
        + b"acsp"
    )
    head += bytes(28) + struct.pack(">3i", 63190, 65536, 54061)
    return head.ljust(128, b"\0") + struct.pack(">I", len(fixed)) + table + body


def test_an_embedded_profile_changes_the_colours(tmp_path: Path) -> None:
    pixels = np.zeros((2, 2, 3), np.uint8)
    pixels[..., 0] = 255  # red, by the profile green
    Image.fromarray(pixels).save(tmp_path / "a.png", icc_profile=wide_gamut())
    picture = read_picture(tmp_path / "a.png")
    assert picture.rgb[0, 0] == pytest.approx([0, 1, 0], abs=6 * STEP) and "'swapped'" in picture.notes[0]


def parametric() -> bytes:
    """`wide_gamut` with curves of sRGB's kind and other numbers: type 3, ((x + 0.1) / 1.1)^2, below 0.1 x / 4."""
    numbers = struct.pack(">5i", *(round(x * 65536) for x in (2, 1 / 1.1, 0.1 / 1.1, 0.25, 0.1)))
    return wide_gamut(b"para\0\0\0\0\0\3\0\0" + numbers)


def tabled() -> bytes:
    table = np.rint(np.linspace(0, 1, 257) ** 1.8 * 65535).astype(">u2").tobytes()
    return wide_gamut(b"curv\0\0\0\0" + struct.pack(">I", 257) + table)


PROFILES = [wide_gamut(), parametric(), tabled(), wide_gamut(b"curv\0\0\0\0\0\0\0\1\1\x80\0\0")]


@pytest.mark.parametrize("profile", PROFILES, ids=["linear", "parametric", "table", "gamma 1.5"])
def test_profiles_of_16_bits_as_those_of_8(profile: bytes, tmp_path: Path) -> None:
    """The same values with the same profile are the same picture, in PNG and TIFF (littleCMS converts 8 bits)."""
    values = colours(3, (24, 16))
    Image.fromarray(values).save(tmp_path / "a.png", icc_profile=profile)
    expected = read_picture(tmp_path / "a.png")
    deep = values.astype(np.uint16) * 257
    (tmp_path / "b.png").write_bytes(png16(deep, profile))
    tifffile.imwrite(tmp_path / "b.tif", deep, photometric="rgb", iccprofile=profile)
    for name in ("b.png", "b.tif"):
        found = read_picture(tmp_path / name)
        assert found.notes == expected.notes and "'swapped'" in found.notes[0]
        assert found.rgb == pytest.approx(expected.rgb, abs=1.1 * STEP)
        assert np.abs(found.rgb - expected.rgb).mean() < 0.3 * STEP


def test_a_profile_of_16_bits_that_does_not_fit(tmp_path: Path) -> None:
    deep = np.full((4, 4, 1), 30000, np.uint16)
    for name, profile in (("a.png", wide_gamut()), ("b.png", b"junk"), ("c.png", wide_gamut()[:200])):
        (tmp_path / name).write_bytes(png16(deep, profile))
        picture = read_picture(tmp_path / name)
        assert "could not be used" in picture.notes[0] and picture.rgb[0, 0] == pytest.approx([30000 / 65535] * 3)


@pytest.mark.parametrize("orientation", range(1, 9))
def test_tiff_of_16_bits(orientation: int, tmp_path: Path) -> None:
    pixels = np.random.default_rng(0).integers(0, 65536, (4, 6, 3)).astype(np.uint16)
    extra = [(274, "H", 1, orientation, True)]
    tifffile.imwrite(tmp_path / "a.tif", pixels, photometric="rgb", byteorder=">", extratags=extra)
    tifffile.imwrite(tmp_path / "b.tif", (pixels >> 8).astype(np.uint8), photometric="rgb", extratags=extra)
    for how in ("upright", "stored"):
        deep, eight = (read_picture(tmp_path / name, how) for name in ("a.tif", "b.tif"))
        assert np.array_equal(np.rint(deep.rgb * 65535) // 256, np.rint(eight.rgb * 255)) and deep.notes == eight.notes
        assert len(np.unique(deep.rgb)) == len(np.unique(pixels))


@pytest.mark.parametrize("kind", ["unassalpha", "assocalpha"])
def test_alpha_of_tiff_of_16_bits(kind: str, tmp_path: Path) -> None:
    straight = np.array([[[40000, 20000, 999, 32768], [65535, 1, 2, 65535]]], np.uint16)
    stored = straight.copy()
    if kind == "assocalpha":
        stored[..., :3] = np.rint(straight[..., :3] * (straight[..., 3:] / 65535))
    tifffile.imwrite(tmp_path / "a.tif", stored, photometric="rgb", extrasamples=[kind])
    picture = read_picture(tmp_path / "a.tif")
    assert picture.rgb == pytest.approx(straight[..., :3] / 65535, abs=2e-5)
    assert picture.alpha == pytest.approx(straight[..., 3] / 65535, abs=1e-6)


def test_what_is_cut_to_8_bits_is_said(tmp_path: Path) -> None:
    pixels = np.random.default_rng(0).integers(0, 65536, (4, 6, 4)).astype(np.uint16)
    tifffile.imwrite(tmp_path / "a.tif", pixels, photometric="separated")
    assert "A TIFF with more than 8 bits a channel was read at 8 bits." in read_picture(tmp_path / "a.tif").notes
    # Both decoders mix up planes that stand one after another.
    tifffile.imwrite(tmp_path / "b.tif", np.moveaxis(pixels[..., :3], 2, 0), photometric="rgb", planarconfig="separate")
    with pytest.raises(InputRefused, match="separate planes"):
        read_picture(tmp_path / "b.tif")


def test_animations_show_their_first_frame(tmp_path: Path) -> None:
    frames = [Image.new("RGB", (4, 4), c) for c in ((255, 0, 0), (0, 255, 0))]
    frames[0].save(tmp_path / "a.gif", save_all=True, append_images=frames[1:])
    picture = read_picture(tmp_path / "a.gif")
    assert picture.rgb[0, 0].tolist() == [1, 0, 0] and "first frame" in picture.notes[0]


PNG = encoded(Image.fromarray(colours(size=(40, 40))), "PNG")
JPEG = encoded(Image.fromarray(colours(size=(40, 40))), "JPEG")
REFUSED = {
    "cut.png": (PNG[: len(PNG) // 2], "cut-off"),
    "cut.jpg": (JPEG[: len(JPEG) // 2], "cut-off"),
    "head.png": (PNG[:20], "no decoder"),
    "empty.png": (b"", "an empty file"),
    "text.png": (b"hello", "no decoder"),
    "a.svg": (b"<svg xmlns='http://www.w3.org/2000/svg'/>", "SVG"),
    "b.svg": (b"<?xml version='1.0'?><!-- x --><svg/>", "SVG|XML"),
    "a.pdf": (b"%PDF-1.4", "PDF"),
    "a.eps": (b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 1 1\n", "no decoder"),  # Pillow would start Ghostscript
    "a.heic": (b"\0\0\0\x18ftypheic", "HEIC"),
    "a.exr": (b"\x76\x2f\x31\x01\x02\0\0\0", "high-dynamic-range"),
    "a.psd": (b"8BPS\0\x01", "Photoshop"),
    "a.dpx": (b"SDPX" + bytes(2000), "DPX"),
    "a.cin": (b"\x80\x2a\x5f\xd7" + bytes(2000), "Cineon"),
    "a.dds": (b"DDS " + bytes(200), "DDS"),
    "a.jp2": (b"\0\0\0\x0cjP  \r\n\x87\n", "JPEG 2000"),
    "a.ico": (b"\0\0\1\0\1\0" + bytes(200), "icon"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_is_no_picture_is_refused(name: str, tmp_path: Path) -> None:
    content, word = REFUSED[name]
    (tmp_path / name).write_bytes(content)
    with pytest.raises(InputRefused, match=word) as refusal:
        read_picture(tmp_path / name)
    assert name in str(refusal.value) and "expected" in str(refusal.value)


@pytest.mark.parametrize(("width", "height"), [(20_000, 20_000), (8_193, 8_192), (2**31 - 1, 2), (0, 5)])
def test_sizes_are_checked_before_decoding(width: int, height: int, tmp_path: Path) -> None:
    """Headers that promise more than the file holds: refused for the size, not for the missing pixels."""
    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    fixed = PNG[:16] + header + struct.pack(">I", zlib.crc32(b"IHDR" + header)) + PNG[33:]
    (tmp_path / "bomb.png").write_bytes(fixed)
    with pytest.raises(InputRefused, match="million|pixel|no decoder"):
        read_picture(tmp_path / "bomb.png")


@given(st.lists(st.tuples(st.integers(0, 10**6), st.binary(min_size=1, max_size=4)), min_size=1, max_size=4))
def test_damaged_pictures_open_or_are_refused(edits: list[tuple[int, bytes]]) -> None:
    for content in (PNG, JPEG):
        for at, new in edits:
            at %= len(content)
            content = content[:at] + new + content[at + len(new) :]
        try:
            decode(content, "damaged", Budget(Path("mesh")), "colour")
        except InputRefused:
            pass


def test_textures_become_what_materials_hold(monkeypatch: pytest.MonkeyPatch) -> None:
    pixels = np.array([[[0, 128, 255], [188, 128, 128]], [[128, 128, 255], [128, 128, 0]]], np.uint8)
    png, budget = encoded(Image.fromarray(pixels), "PNG"), Budget(Path("mesh"))
    linear = decode(png, "t", budget, "colour")
    assert linear[0, 0] == pytest.approx([0, 0.2158605, 1], abs=1e-5)  # sRGB 128 is 0.2158605 linear
    assert np.array_equal(decode(png, "t", budget, "data"), pixels.astype(np.float32) / 255)
    normal = decode(png, "t", budget, "normal", scale=0.5)
    assert np.linalg.norm(normal, axis=2) == pytest.approx(1)
    x, y, z = pixels[0, 1] / 255 * 2 - 1
    assert normal[0, 1] / normal[0, 1, 2] == pytest.approx([x / 2 / z, y / 2 / z, 1], rel=1e-4)
    assert (normal[..., 2] > 0).all()
    monkeypatch.setattr(pictures, "WORK_TEXTURE", 2)
    large = decode(encoded(Image.fromarray(colours(size=(5, 8))), "PNG"), "t", budget, "data")
    assert large.shape == (2, 2, 3)
    monkeypatch.setattr(pictures, "MAX_TEXTURE_PIXELS", 50)
    with pytest.raises(InputRefused, match="mesh: found more than"):
        decode(encoded(Image.fromarray(colours(size=(5, 8))), "PNG"), "t", budget, "data")


# --- high dynamic range ---


def exr(path: Path, header: dict | None = None, **channels: np.ndarray) -> Path:
    full = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, **(header or {})}
    OpenEXR.File(full, channels).write(str(path))
    return path


def test_exr_channels_by_name(tmp_path: Path) -> None:
    z = np.random.default_rng(0).normal(size=(3, 4)).astype(np.float32)
    half = z.astype(np.float16)
    planes = read_exr(exr(tmp_path / "a.exr", None, **{"R": z, "normal.X": z + 1, "h": half, "id": np.uint32(z > 0)}))
    assert sorted(planes) == ["R", "h", "id", "normal.X"]
    assert all(plane.dtype == np.float32 and plane.shape == (3, 4) for plane in planes.values())
    assert np.array_equal(planes["R"], z) and np.array_equal(planes["normal.X"], z + 1)
    assert np.array_equal(planes["h"], half.astype(np.float32)) and np.array_equal(planes["id"], z > 0)


def window(x0: int, y0: int, x1: int, y1: int) -> tuple[np.ndarray, np.ndarray]:
    return np.array([x0, y0], np.int32), np.array([x1, y1], np.int32)


def test_exr_windows(tmp_path: Path) -> None:
    ones = np.arange(6, dtype=np.float32).reshape(2, 3) + 1
    header = {"dataWindow": window(1, 2, 3, 3), "displayWindow": window(0, 0, 2, 4)}
    shown = read_exr(exr(tmp_path / "a.exr", header, Z=ones))["Z"]
    expected = np.zeros((5, 3), np.float32)
    expected[2:4, 1:] = ones[:, :2]
    assert np.array_equal(shown, expected)


def test_forged_and_damaged_exr_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    good = exr(tmp_path / "a.exr", None, Z=np.ones((30, 40), np.float32)).read_bytes()
    at = good.index(b"dataWindow\0box2i\0") + len(b"dataWindow\0box2i\0") + 4
    forged = bytearray(good)
    for right, bottom in ((199_999, 199_999), (2**31 - 1, 5), (-5, 3), (40, 29)):
        struct.pack_into("<4i", forged, at, 0, 0, right, bottom)
        (tmp_path / "b.exr").write_bytes(bytes(forged))
        with pytest.raises(InputRefused, match="b.exr"):
            read_exr(tmp_path / "b.exr")
    for content in (b"", good[:40], good[:-15], b"\x76\x2f\x31\x01\x02\0\0\0abc", b"#?RADIANCE"):
        (tmp_path / "c.exr").write_bytes(content)
        with pytest.raises(InputRefused, match="c.exr"):
            read_exr(tmp_path / "c.exr")
    monkeypatch.setattr(hdr, "MAX_CHANNELS", 0)
    with pytest.raises(InputRefused, match="1 channels"):
        read_exr(tmp_path / "a.exr")


def test_radiance_files(tmp_path: Path) -> None:
    head = b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 1 +X 2\n"
    path = tmp_path / "a.hdr"
    path.write_bytes(head + bytes([128, 64, 0, 129]) + bytes([255, 0, 128, 137]))  # mantissa / 256 * 2^(e - 128)
    assert read_hdr(path)[0] == pytest.approx(np.array([[1, 0.5, 0], [510, 0, 256]]))
    path.write_bytes(head.replace(b"-Y 1 +X 2", b"-Y 99999 +X 99999"))
    with pytest.raises(InputRefused, match="99999 x 99999"):
        read_hdr(path)
    path.write_bytes(head)
    with pytest.raises(InputRefused, match="cannot be decoded"):
        read_hdr(path)
    path.write_bytes(b"hello")
    with pytest.raises(InputRefused, match="no Radiance header"):
        read_hdr(path)


def runs(row: bytes) -> bytes:
    """One component of a row, run-length encoded as Radiance has it."""
    result, at = b"", 0
    while at < len(row):
        same = next((k for k in range(at, len(row)) if row[k] != row[at]), len(row)) - at
        count = min(same, 127)
        result += bytes([128 + count, row[at]]) if count > 2 else bytes([1, row[at]])
        at += count if count > 2 else 1
    return result


@pytest.mark.parametrize("width", [3, 40])
def test_radiance_files_of_xyz(width: int, tmp_path: Path) -> None:
    """Rows that are plain and rows that are run-length encoded; white of D65 is (1, 1, 1)."""
    quads = np.full((2, width, 4), (122, 128, 139, 129), np.uint8)
    quads[:, width // 2 :] = (64, 32, 2, 130)
    quads[1, 0] = 0
    head = f"#?RADIANCE\nFORMAT=32-bit_rle_xyze\n\n-Y 2 +X {width}\n".encode()
    marks = bytes([2, 2, 0, width])
    coded = [marks + b"".join(runs(row[:, k].tobytes()) for k in range(4)) for row in quads]
    rows = coded if width > 8 else [row.tobytes() for row in quads]
    path = tmp_path / "a.hdr"
    path.write_bytes(head + b"".join(rows))
    found = read_hdr(path)
    assert found[0, 0] == pytest.approx([1, 1, 1], abs=0.02) and found[1, 0].tolist() == [0, 0, 0]
    x, y, z = np.array([64, 32, 2]) / 64
    red, blue = 3.2406 * x - 1.5372 * y - 0.4986 * z, max(0.0557 * x - 0.204 * y + 1.057 * z, 0)
    assert found[0, -1] == pytest.approx([red, 0, blue], rel=1e-3)
    for cut in (1, 4, 5):
        path.write_bytes((head + b"".join(rows))[:-cut])
        with pytest.raises(InputRefused, match="XYZE"):
            read_hdr(path)


def test_a_real_environment_map() -> None:
    radiance = read_hdr(data("hdri/studio_small_03_1k.hdr"))
    assert radiance.shape == (512, 1024, 3) and np.isfinite(radiance).all()
    assert luminance(radiance).max() == pytest.approx(3352, rel=1e-3)  # as Mitsuba reads it
