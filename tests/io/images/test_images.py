"""Pictures read back by readers that are not ours: Pillow (PNG, 8 bits), OpenCV (16 bits), OpenEXR's own reader."""

import io
import json

import cv2
import numpy as np
import pytest
from PIL import Image

from mistyle.core.camera import orbit
from mistyle.core.errors import InputRefused, MistyleError
from mistyle.fitting.pipeline.scene_references import read_reference
from mistyle.io.cameras.camera_files import camera_entry
from mistyle.io.cameras.captures import read_captures
from mistyle.io.images.ocio import KNOWN
from mistyle.io.images.write import LINEAR_REC709, REC709_CHROMATICITIES, encode_png, write_exr, write_png
from mistyle.io.read import read_exr, read_radiance


@pytest.mark.parametrize("channels", [(), (3,), (4,)])
def test_png_8_bits_in_pillow(tmp_path, rng, channels):
    codes = rng.integers(0, 256, (5, 7, *channels))
    write_png(tmp_path / "a.png", (codes / 255).astype(np.float32))
    image = Image.open(tmp_path / "a.png")
    assert image.mode == {(): "L", (3,): "RGB", (4,): "RGBA"}[channels] and image.size == (7, 5)
    np.testing.assert_array_equal(np.asarray(image), codes)


@pytest.mark.parametrize("channels", [(), (3,), (4,)])
def test_png_16_bits_in_opencv(tmp_path, rng, channels):
    codes = rng.integers(0, 65536, (5, 7, *channels))
    write_png(tmp_path / "a.png", (codes / 65535).astype(np.float32), bits=16)
    back = cv2.imread(str(tmp_path / "a.png"), cv2.IMREAD_UNCHANGED)
    assert back.dtype == np.uint16
    np.testing.assert_array_equal(back[..., [2, 1, 0, 3][: back.shape[2]]] if channels else back, codes)


def test_png_is_clipped_rounded_and_upright():
    values = np.array([[-1.0, 0.0, 0.4999 / 255, 0.5001 / 255], [1.0, 2.0, 0.9, 1.0]], np.float32)
    pixels = np.asarray(Image.open(io.BytesIO(encode_png(values))))
    assert pixels.tolist() == [[0, 0, 0, 1], [255, 255, 230, 255]]


def test_png_refuses(rng):
    with pytest.raises(ValueError, match="shape"):
        encode_png(np.zeros((4, 4, 2), np.float32))
    with pytest.raises(ValueError, match="NaN"):
        encode_png(np.full((4, 4), np.nan, np.float32))
    with pytest.raises(ValueError, match="bits"):
        encode_png(np.zeros((4, 4), np.float32), bits=10)


def read(path):
    import OpenEXR

    with OpenEXR.File(str(path), separate_channels=True) as file:
        return {k: np.array(v.pixels) for k, v in file.channels().items()}, dict(file.header())


def test_exr_layers_come_back_bit_for_bit(tmp_path, rng):
    names = ("R", "G", "B", "A", "normal.X", "normal.Y", "uv.U")
    image = {k: rng.normal(size=(6, 9)).astype(np.float32) for k in names}
    image["depth.Z"] = np.where(rng.random((6, 9)) < 0.5, np.inf, 4.0).astype(np.float32)
    write_exr(tmp_path / "a.exr", image)
    pixels, header = read(tmp_path / "a.exr")
    assert set(pixels) == set(image)
    for name, values in image.items():
        assert pixels[name].dtype == np.float32
        np.testing.assert_array_equal(pixels[name], values)
    assert header["colorInteropID"] == LINEAR_REC709
    np.testing.assert_allclose(header["chromaticities"], REC709_CHROMATICITIES, atol=1e-6)
    assert header["compression"].name == "ZIP_COMPRESSION"


def test_exr_tags_data_and_takes_attributes(tmp_path):
    rough = np.full((4, 4), 0.25, np.float32)
    write_exr(tmp_path / "a.exr", {"Y": rough}, half=True, attributes={"mistyle:map": "roughness"})
    pixels, header = read(tmp_path / "a.exr")
    assert pixels["Y"].dtype == np.float16 and header["colorInteropID"] == "data"
    assert "chromaticities" not in header and header["mistyle:map"] == "roughness"
    write_exr(tmp_path / "b.exr", dict.fromkeys("RGB", rough), attributes={"colorInteropID": "data"})
    assert "chromaticities" not in read(tmp_path / "b.exr")[1]


def test_exr_refuses_mixed_shapes(tmp_path):
    with pytest.raises(ValueError, match="one shape"):
        write_exr(tmp_path / "a.exr", {"R": np.zeros((4, 4)), "G": np.zeros((4, 5))})
    with pytest.raises(ValueError, match="one shape"):
        write_exr(tmp_path / "a.exr", {})


def test_the_same_pixels_give_the_same_bytes(tmp_path, rng):
    image = rng.random((64, 48, 3)).astype(np.float32)
    for name in ("a", "b"):
        write_png(tmp_path / f"{name}.png", image, bits=16)
        write_exr(tmp_path / f"{name}.exr", {c: image[..., k] for k, c in enumerate("RGB")})
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()
    assert (tmp_path / "a.exr").read_bytes() == (tmp_path / "b.exr").read_bytes()
    shuffled = {c: image[..., "RGB".index(c)] for c in "BRG"}
    write_exr(tmp_path / "b.exr", shuffled)
    assert (tmp_path / "a.exr").read_bytes() == (tmp_path / "b.exr").read_bytes()


def test_a_full_disk_is_a_sentence(monkeypatch, tmp_path):
    import errno
    from pathlib import Path

    def full(self, data):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full)
    for write in (lambda: write_png(tmp_path / "a.png", np.zeros((4, 4), np.float32)),
                  lambda: write_exr(tmp_path / "a.exr", {"Y": np.zeros((4, 4), np.float32)})):  # fmt: skip
        with pytest.raises(MistyleError, match="disk is full"):
            write()
    assert list(tmp_path.iterdir()) == []


ACES = {"colorInteropID": "lin_ap1_scene", "chromaticities": KNOWN["lin_ap1_scene"][1]}
COLOURS = {
    "an environment": read_radiance,
    "a reference of a scene": read_reference,
    "a reference of a mesh": lambda path: captured(path.parent),
}


def captured(folder):
    entry = camera_entry(orbit(0.0, 0, distance=5.0, fov=30.0, size=(8, 16))) | {"exr": "a.exr"}
    (folder / "camera.json").write_text(json.dumps({"views": [entry]}))
    lamp = {"type": "directional", "direction": [0, 1, 0], "irradiance": [3, 3, 3]}
    (folder / "lights.json").write_text(json.dumps({"lights": [lamp]}))
    return read_captures(folder).load(0)


@pytest.mark.parametrize("kind", COLOURS)
def test_colours_of_other_primaries_are_refused(tmp_path, rng, kind):
    planes = {c: rng.random((8, 16)).astype(np.float32) for c in "RGB"}
    write_exr(tmp_path / "a.exr", planes)
    COLOURS[kind](tmp_path / "a.exr")
    write_exr(tmp_path / "a.exr", planes, attributes=ACES)
    with pytest.raises(InputRefused, match=r"a\.exr: found colours of other primaries \(0.7130 .*Rec.709"):
        COLOURS[kind](tmp_path / "a.exr")
    assert set(read_exr(tmp_path / "a.exr")) == set("RGB")


@pytest.mark.parametrize("ending", [".exr", ".hdr"])
@pytest.mark.parametrize(("shape", "right"), [((8, 16), True), ((8, 17), True), ((16, 16), False), ((48, 8), False)])
def test_an_environment_is_twice_as_wide_as_high(tmp_path, ending, shape, right):
    path, values = tmp_path / f"a{ending}", np.ones(shape, np.float32)
    if ending == ".exr":
        write_exr(path, dict.fromkeys("RGB", values))
    else:
        cv2.imwrite(str(path), np.dstack([values] * 3))
    if right:
        assert read_radiance(path).shape == (*shape, 3)
    else:
        with pytest.raises(InputRefused, match=f"{shape[1]} x {shape[0]} pixels; expected a latitude-longitude map"):
            read_radiance(path)
