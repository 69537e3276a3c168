"""Cameras' RAW files: linear, the same development for all, upright or as stored, saturated where the sensor is."""

import json
import sys

import numpy as np
import pytest

from benchmarks.faults.corpus import dng
from mistyle.core.camera import orbit
from mistyle.core.errors import InputRefused
from mistyle.io.cameras.camera_files import transforms
from mistyle.io.cameras.captures import read_captures, read_shots
from mistyle.io.cameras.reading_notes import reading_notes
from mistyle.io.images.raw import read_raw as read_here
from mistyle.io.read import read_exposure, read_raw, read_size, read_stored_size

SIZE = (64, 96)
INNER = (slice(4, -4), slice(4, -4))  # demosaicing extrapolates at the border


def ramp() -> np.ndarray:
    y, x = np.mgrid[: SIZE[0], : SIZE[1]]
    return np.stack([0.1 + 0.8 * x / SIZE[1], 0.2 + 0.5 * y / SIZE[0], 0.5 - 0.3 * x / SIZE[1]], axis=-1)


def written(folder, rgb, orientation=1):
    path = folder / "a.dng"
    path.write_bytes(dng(np.round(65535 * np.clip(rgb, 0, 1)).astype(np.uint16), orientation))
    return path


@pytest.mark.parametrize("exposure", [1.0, 0.25, 0.03])
def test_values_are_linear_and_no_exposure_is_adjusted(tmp_path, exposure):
    found = read_raw(written(tmp_path, exposure * ramp())) / 65535
    assert np.abs(found - exposure * ramp())[INNER].max() < 2e-4


def test_a_file_is_turned_only_where_upright_pixels_are_wanted(tmp_path):
    path = written(tmp_path, ramp(), orientation=6)
    assert read_stored_size(path) == (*SIZE, 6) and read_size(path) == SIZE[::-1]
    stored, upright = read_raw(path), read_raw(path, "upright")
    assert np.array_equal(np.rot90(stored, -1), upright)


def references(folder, rgb):
    (folder / "images").mkdir()
    written(folder / "images", rgb)
    camera = orbit(0, 10, distance=4, fov=30, size=SIZE)
    (folder / "transforms.json").write_text(json.dumps(transforms([camera], ["images/a.dng"])))
    return folder


def test_references_are_raw_files(tmp_path):
    rgb = ramp()
    rgb[20:30, 30:40] = 1.5
    folder = references(tmp_path, rgb)
    found, valid = read_captures(folder, lights="unknown").load(0)
    assert not valid[22:28, 32:38].any() and valid[40:60, 10:90].all()
    assert np.abs(found - rgb)[40:60, 10:90].max() < 2e-4
    assert any("1 RAW pictures" in note for note in reading_notes(folder, read_shots(folder)))
    assert np.isnan(read_exposure(folder / "images" / "a.dng")).all()


def test_damaged_files_are_refused(tmp_path):
    path = written(tmp_path, ramp())
    path.write_bytes(path.read_bytes()[:300])
    with pytest.raises(InputRefused, match="RAW"):
        read_raw(path)
    path.write_bytes(b"no picture")
    with pytest.raises(InputRefused, match="LibRaw does not read"):
        read_stored_size(path)


def test_without_the_extra_the_fix_is_named(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "rawpy", None)
    with pytest.raises(InputRefused, match=r"mistyle\[raw\]"):
        read_here(written(tmp_path, ramp()))
